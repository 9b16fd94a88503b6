"""Properties that every denoiser of `experiments/denoiser` must have."""

from dataclasses import replace
from functools import partial
from inspect import signature
from pathlib import Path
from typing import Any

import pytest
import torch
from hydra.utils import instantiate
from support.fixtures import ROOT
from torch import Tensor, nn
from torch.nn import functional

from flame_mdm.batch import Condition, length_mask
from flame_mdm.denoisers import Denoiser
from flame_mdm.denoisers.flame import FLAME, cosine_first_sinusoid
from flame_mdm.denoisers.gru import MDMGRU
from flame_mdm.denoisers.layers import TransformerLayer
from flame_mdm.denoisers.mdm import MDMDecoder, MDMEncoder
from flame_mdm.denoisers.target_encoders import TARGET_ENCODERS
from flame_mdm.denoisers.unet import MaskedGroupNorm, MDMUNet, ResidualBlock
from flame_mdm.errors import UserError
from flame_mdm.safe_io import read_package_yaml

CONFIGS = sorted((ROOT / "experiments" / "denoiser").glob("*.yaml"))
TRANSFORMER = {"latent_dim": 16, "ff_size": 24, "num_layers": 2, "num_heads": 2, "dropout": 0.0}
TINY = {**TRANSFORMER, "channels": [8, 8, 16], "num_groups": 4, "context_frames": 3}
D, C, LENGTHS = 7, 12, [11, 8, 1]


def tiny(path: str | Path, out_features: int = D, **options) -> Denoiser:
    """The denoiser of a YAML in the smallest sizes, in float64 so that only real differences show."""
    torch.manual_seed(0)
    config = read_package_yaml(ROOT / "experiments/denoiser" / path)
    config |= {key: value for key, value in TINY.items() if key in config}
    return instantiate(config, D, out_features, C, **options).double().eval()


def batch(lengths: list[int] = LENGTHS, frames: int | None = None, tokens: int = 5):
    """x_t, t, mask, cond; noise stands past the end of the motions and in masked tokens."""
    size, normal = (
        len(lengths),
        partial(torch.randn, generator=torch.Generator().manual_seed(1), dtype=torch.float64),
    )
    x_t, t = normal(size, max(lengths), D), torch.tensor([0.0, 437.25, 999.0])[:size]
    pooled, text = normal(size, C), normal(size, tokens, C)
    mask = length_mask(torch.tensor(lengths), frames)
    x_t = torch.cat([x_t, 100 * normal(size, mask.shape[1] - x_t.shape[1], D)], 1)
    token_mask = length_mask(torch.arange(size) % max(tokens, 1) + 1, tokens)
    null = Condition(normal(1, C), normal(1, tokens, C), torch.ones(1, tokens).bool())
    # Denoisers without a context or a target encoder read neither.
    normal = partial(torch.randn, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    prefix, target = normal(size, TINY["context_frames"], D), normal(size, 8, 4)
    return x_t, t, mask, Condition(pooled, text, token_mask, null, prefix, target)


def assert_same(actual: torch.Tensor, expected: torch.Tensor) -> None:
    torch.testing.assert_close(actual, expected, rtol=0, atol=1e-10)


each_denoiser = pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)


@each_denoiser
def test_shape_determinism_and_padding(path: Path) -> None:
    denoiser, inputs = tiny(path, out_features=2 * D, dropout=0.5), batch()
    torch.manual_seed(1)
    y = denoiser(*inputs)
    assert y.shape == (len(LENGTHS), max(LENGTHS), 2 * D)
    assert y.isfinite().all()
    torch.manual_seed(2)
    assert torch.equal(denoiser(*inputs), y)

    # The padded length and what stands in it change nothing in real frames, nor does the rest of the batch.
    x_t, t, mask, cond = inputs
    y_longer = denoiser(*batch(frames=max(LENGTHS) + 6))
    for i, length in enumerate(LENGTHS):
        assert_same(y_longer[i, :length], y[i, :length])
        row, tokens = slice(i, i + 1), i % 5 + 1
        alone = cond.select(torch.tensor([i]))
        alone = replace(
            alone,
            tokens=alone.tokens[:, :tokens],
            token_mask=torch.ones(1, tokens, dtype=torch.bool),
        )
        y_alone = denoiser(x_t[row, :length], t[row], mask[row, :length], alone)
        assert_same(y_alone[0], y[i, :length])


@each_denoiser
def test_dropped_condition_is_the_null_and_time_is_continuous(path: Path) -> None:
    denoiser = tiny(path)
    x_t, t, mask, cond = batch()
    null, size = cond.null, len(x_t)
    assert null is not None
    all_real = torch.ones(size, 5, dtype=torch.bool)
    nothing = {"pooled": null.pooled.expand(size, -1), "tokens": null.tokens.expand(size, -1, -1)}
    everywhere = replace(cond, **nothing, token_mask=all_real)
    y, y_null = denoiser(x_t, t, mask, cond), denoiser(x_t, t, mask, everywhere)
    mixed = denoiser(x_t, t, mask, cond.drop(torch.tensor([False, True, False])))
    assert_same(mixed[1], y_null[1])
    assert_same(mixed[::2], y[::2])
    assert ((y - y_null)[mask].abs() > 1e-6).any(), "the condition has no effect"
    later, much_later = (
        (denoiser(x_t, t + more, mask, cond) - y)[mask].abs().max() for more in (1e-4, 0.5)
    )
    assert 100 * later < much_later > 1e-6


def test_paper_sizes(subtests) -> None:
    sizes = {"mdm_encoder": 17_880_327, "mdm_decoder": 26_293_511, "mdm_decoder_token": 26_293_511}
    sizes |= {"dip": 26_424_583, "dip_target": 26_704_135}
    # The paper states 23.47M for the U-Net.
    sizes |= {
        "mdm_gru": 4_472_071,
        "mdm_unet": 23_565_959,
        "flame": 64_905_766,
    }
    for name, parameters in sizes.items():
        with subtests.test(name=name):
            with torch.device("meta"):
                config = read_package_yaml(ROOT / "experiments" / "denoiser" / f"{name}.yaml")
                widths = {
                    "flame": (147, 294, 768),
                    "dip": (263, 263, 768),
                    "dip_target": (263, 263, 768),
                }
                denoiser = instantiate(config, *widths.get(name, (263, 263, 512)))
            assert sum(p.numel() for p in denoiser.parameters()) == parameters, name


@each_denoiser
def test_runs_under_bf16_autocast(path: Path) -> None:
    denoiser, (x_t, t, mask, cond) = tiny(path).float(), batch()
    assert cond.prefix is not None
    assert cond.target is not None
    single = {
        name: getattr(cond, name).float() for name in ("pooled", "tokens", "prefix", "target")
    }
    inputs = x_t.float(), t, mask, replace(cond, **single, null=None)
    exact = denoiser(*inputs)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        error = (denoiser(*inputs).float() - exact)[mask]
    assert error.square().mean().sqrt() < 0.05 * exact[mask].std()


@pytest.mark.parametrize(
    "path", [path for path in CONFIGS if "gru" not in path.stem], ids=lambda path: path.stem
)
def test_the_compiler_traces_a_denoiser_as_one_graph(path: Path) -> None:
    """Each break of the graph costs calls between its parts. Torch does not trace `nn.GRU`."""
    torch.compiler.reset()
    denoiser, inputs = tiny(path), batch()
    traced = torch.compile(denoiser, backend="eager", fullgraph=True)
    assert torch.equal(traced(*inputs), denoiser(*inputs))


def test_group_norm_without_padding_is_torchs() -> None:
    norm, x = MaskedGroupNorm(8, 4), torch.randn(2, 8, 5)
    norm.load_state_dict({"weight": torch.randn(8), "bias": torch.randn(8)})
    expected = torch.nn.functional.group_norm(x, 4, norm.weight, norm.bias)
    torch.testing.assert_close(norm(x, torch.ones(2, 1, 5)), expected)


@pytest.mark.parametrize("length_token", [True, False])
@pytest.mark.parametrize("cross_attention", [True, False])
def test_flame_ablations(length_token: bool, cross_attention: bool) -> None:
    """Table 4: what is left out leaves no weights, and text tokens act through cross-attention alone."""
    options = {"length_token": length_token, "cross_attention": cross_attention}
    flame = FLAME(D, D, C, **TRANSFORMER, max_frames=20, **options).double()
    x_t, t, mask, cond = batch()
    y = flame(x_t, t, mask, cond)
    y[mask].square().sum().backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in flame.parameters())
    names = " ".join(flame.state_dict())
    assert ("length_embedding" in names) == length_token
    assert ("cross_attention" in names) == ("token_projection" in names) == cross_attention
    other = Condition(cond.pooled, cond.tokens + 1, cond.token_mask)
    assert torch.equal(flame(x_t, t, mask, other), y) != cross_attention


def test_flame_returns_zeros_past_the_end_and_knows_lengths_up_to_max_frames() -> None:
    inputs = batch()
    assert torch.equal((tiny("flame.yaml")(*inputs) != 0).all(-1), inputs[2])
    flame = FLAME(D, D, C, **TRANSFORMER, max_frames=11).double()
    assert flame(*batch(frames=14)).isfinite().all()
    with pytest.raises(UserError, match=r"12 frames .* denoiser\.max_frames \(11\)"):
        flame(*batch([12, 3], frames=14))


def test_flame_rounds_lengths_down_to_those_of_its_training(subtests) -> None:
    flame, exact = (
        FLAME(D, D, C, **TRANSFORMER, max_frames=20, length_unit=unit).double() for unit in (4, 1)
    )
    exact.load_state_dict(flame.state_dict())
    whole, other = batch([12, 8, 4], frames=12), batch([12, 3, 15], frames=15)
    assert torch.equal(flame(*whole), exact(*whole))
    assert not torch.equal(flame(*other), exact(*other))
    table = exact.length_embedding.weight.data  # type: ignore[union-attr]
    table[[3, 15]] = table[[4, 12]]
    assert torch.equal(flame(*other), exact(*other))
    for unit in (0, -4, 1.5, "4", True):
        with subtests.test(unit=unit), pytest.raises(UserError, match="length_unit"):
            FLAME(D, D, C, **TRANSFORMER, max_frames=20, length_unit=unit)  # type: ignore[arg-type]


@pytest.mark.parametrize("cond_features", [C, 0])
def test_time_and_condition_can_be_added_to_the_frames_of_flame(cond_features: int) -> None:
    """The sum is the same for all frames of a motion, so that it can be part of the bias of the input."""
    torch.manual_seed(0)
    plain, adding = (
        FLAME(D, D, cond_features, **TRANSFORMER, max_frames=20, condition_frames=added).double()
        for added in (False, True)
    )
    x_t, t, mask, cond = batch([11])
    adding.load_state_dict(plain.state_dict())
    expected = adding(x_t, t + 3, mask, cond)
    added = cosine_first_sinusoid(t + 3, 16).double()[0]
    if plain.pooled_projection is not None:
        added += plain.pooled_projection(cond.pooled)[0]
    plain.input.bias.data += added
    assert_same(plain(x_t, t + 3, mask, cond), expected)


@pytest.mark.parametrize("max_tokens", [0, 5])
def test_the_first_token_can_be_added_to_the_frames_of_the_encoder(max_tokens: int) -> None:
    """The first token is the time and, unless all tokens are read, the condition."""
    torch.manual_seed(0)
    plain, adding = (
        MDMEncoder(D, D, C, **TRANSFORMER, max_tokens=max_tokens, condition_frames=added).double()
        for added in (False, True)
    )
    x_t, t, mask, cond = batch([11])
    adding.load_state_dict(plain.state_dict())
    added = plain.condition.time(t) if max_tokens else plain.condition(t, cond.pooled)
    expected = adding(x_t, t, mask, cond)
    plain.input.bias.data += added[0]
    assert_same(plain(x_t, t, mask, cond), expected)


def test_the_unet_is_that_of_ddpm_with_a_scale_and_a_shift() -> None:
    """Plain convolutions and norms of torch, for motions without padding."""
    torch.manual_seed(0)
    sizes: dict[str, Any] = {"latent_dim": 16, "channels": [8, 12], "num_groups": 4, "dropout": 0.0}
    unet = MDMUNet(D, D, C, **sizes).double()
    for weight in unet.parameters():
        weight.data += 0.1 * torch.randn_like(weight)
    x_t, t, mask, cond = batch([10, 10])
    weights = unet.state_dict()

    def conv(name: str, x: Tensor, **options: int) -> Tensor:
        return functional.conv1d(x, weights[f"{name}.weight"], weights[f"{name}.bias"], **options)

    def norm(name: str, x: Tensor) -> Tensor:
        return functional.group_norm(x, 4, weights[f"{name}.weight"], weights[f"{name}.bias"])

    token = functional.silu(unet.condition(t, cond.pooled))

    def block(name: str, x: Tensor) -> Tensor:
        y = conv(f"{name}.conv1", functional.silu(norm(f"{name}.norm1", x)), padding=1)
        line = f"{name}.scale_shift"
        both = functional.linear(token, weights[f"{line}.weight"], weights[f"{line}.bias"])
        scale, shift = both[..., None].chunk(2, 1)
        y = functional.silu(norm(f"{name}.norm2", y) * (1 + scale) + shift)
        y = conv(f"{name}.conv2", y, padding=1)
        return y + (conv(f"{name}.skip", x) if f"{name}.skip.weight" in weights else x)

    fine = block("down.0", conv("input", x_t.transpose(1, 2), padding=1))
    coarse = block("down.1", conv("downsample.0", fine, stride=2, padding=1))
    x = block("middle.1", block("middle.0", coarse))
    x = block("up.1", torch.cat([x, coarse], 1))
    x = conv("upsample.0", functional.interpolate(x, scale_factor=2), padding=1)
    x = functional.silu(norm("output_norm", block("up.0", torch.cat([x, fine], 1))))
    assert_same(unet(x_t, t, mask, cond), conv("output", x, padding=1).transpose(1, 2))


def test_token_positions_do_not_move_the_frames() -> None:
    """Absent tokens shift no frame: masked tokens and fewer tokens are the same."""
    encoder = MDMEncoder(D, D, C, **TRANSFORMER, max_tokens=5).double().eval()
    x_t, t, mask, cond = batch()
    two = torch.tensor([True, True, False, False, False]).expand(3, 5)
    fewer = Condition(cond.pooled, cond.tokens[:, :2], two[:, :2])
    assert_same(
        encoder(x_t, t, mask, Condition(cond.pooled, cond.tokens, two)),
        encoder(x_t, t, mask, fewer),
    )
    with pytest.raises(UserError, match=r"denoiser\.max_tokens=5: captions have up to 6 tokens"):
        encoder(*batch(tokens=6))


def test_the_prefix_acts_on_every_frame_and_has_no_output(subtests) -> None:
    decoder = (
        MDMDecoder(D, D, C, **TRANSFORMER, token_memory=True, context_frames=3).double().eval()
    )
    x_t, t, mask, cond = batch()
    assert cond.prefix is not None
    y, moved = (
        decoder(x_t, t, mask, cond),
        decoder(x_t, t, mask, replace(cond, prefix=cond.prefix + 1)),
    )
    assert y.shape == x_t.shape
    assert ((y - moved).abs().amax(-1)[mask] > 1e-6).all()
    for prefix, frames in ((None, 0), (cond.prefix[:, 1:], 2)):
        with (
            subtests.test(prefix=prefix, frames=frames),
            pytest.raises(
                UserError,
                match=f"the prefix has {frames} frames, but this denoiser requires 3 clean frames",
            ),
        ):
            decoder(x_t, t, mask, replace(cond, prefix=prefix))


def test_guidance_and_dropping_keep_prefix_and_target(subtests) -> None:
    *_, cond = batch()
    cond = replace(cond, target_mask=torch.tensor([True, False, True]))
    assert cond.prefix is not None
    assert cond.target is not None
    assert cond.target_mask is not None
    dropped, twice = cond.drop(torch.ones(3, dtype=torch.bool)), cond.with_null()
    assert torch.equal(dropped.prefix, cond.prefix)  # type: ignore[arg-type]
    assert torch.equal(dropped.target, cond.target)  # type: ignore[arg-type]
    for name in ("prefix", "target", "target_mask"):
        with subtests.test(name=name):
            assert torch.equal(getattr(twice, name), torch.cat([getattr(cond, name)] * 2))


@pytest.mark.parametrize(
    "options",
    [
        {"input_token": "time"},
        {"input_token": "condition"},
        {"condition_frames": True, "context_frames": 3},
        {"token_memory": True},
        {"token_memory": True, "memory": "concat"},
    ],
)
def test_the_embedding_of_a_target_is_added_to_the_time_wherever_the_time_is_read(
    options: dict[str, Any],
) -> None:
    """A constant embedding can then be part of the last bias of the time."""
    torch.manual_seed(0)
    decoder = MDMDecoder(D, D, C, **TRANSFORMER, target_encoder="single", **options).double()
    x_t, t, mask, cond = batch()
    cond = replace(cond, target=torch.ones(3, 8, 4).double())
    assert decoder.target is not None
    embedding = decoder.target(cond)[0].detach()
    expected = decoder(x_t, t, mask, cond)
    decoder.target, last = None, decoder.condition.time_embedding[-1]
    before = decoder(x_t, t, mask, cond)
    last.bias.data += embedding  # type: ignore[operator, union-attr]
    assert_same(decoder(x_t, t, mask, cond), expected)
    assert (expected - before).abs().max() > 1e-4


def test_options_of_conditions_do_nothing_without_a_condition() -> None:
    inputs = batch()
    for kind, options in (
        (MDMDecoder, {"token_memory": True}),
        (MDMDecoder, {"token_memory": True, "project_condition": False}),
        (MDMEncoder, {"project_condition": False}),
    ):
        plain, with_options = (
            kind(D, D, 0, **TRANSFORMER, **chosen).double()  # type: ignore[arg-type]
            for chosen in ({}, options)
        )
        with_options.load_state_dict(plain.state_dict())
        assert_same(with_options(*inputs), plain(*inputs))


@pytest.mark.parametrize("layers", [1, 2, 3])
def test_target_encoders_have_the_requested_hidden_layers_but_multi_always_has_one(layers: int):
    """A hidden layer consists of an activation and a linear layer of the output's width."""
    for name, count, width in (("single", layers, 16), ("split", layers, 2), ("multi", 1, 16)):
        encoder = TARGET_ENCODERS[name](16, layers)
        networks: Any = [encoder.network] if name == "single" else encoder.networks
        assert len(networks) == (1 if name == "single" else 8)
        for network in networks:
            kinds = [type(layer) for layer in network]
            assert kinds == [nn.Linear, *[nn.SiLU, nn.Linear] * count], name
            assert {layer.out_features for layer in network if type(layer) is nn.Linear} == {width}


@pytest.mark.parametrize("over_batch", [False, True])
def test_the_recurrence_runs_over_earlier_frames_or_over_earlier_motions(over_batch: bool) -> None:
    torch.manual_seed(0)
    options: dict[str, Any] = {"recur_over_batch": True} if over_batch else {}
    gru = MDMGRU(D, D, C, latent_dim=16, num_layers=2, dropout=0.0, **options).double()
    x_t, t, mask, cond = batch([11, 11, 11])
    changed = x_t.clone()
    changed[1, 4] += 1
    moved = (gru(changed, t, mask, cond) - gru(x_t, t, mask, cond)).abs().amax(-1) > 1e-9
    expected = torch.zeros(3, 11, dtype=torch.bool)
    if over_batch:
        expected[1:, 4] = True
    else:
        expected[1, 4:] = True
    assert torch.equal(moved, expected)


def test_bad_options_are_named(subtests) -> None:
    decoder = MDMDecoder(D, D, C, **TRANSFORMER, token_memory=True).double()
    unet = {"latent_dim": 16, "channels": [8], "dropout": 0.0}
    three_heads: dict[str, Any] = TRANSFORMER | {"num_heads": 3}
    for build, message in (
        (lambda: MDMEncoder(D, D, C, **three_heads), r"latent_dim \(16\) .* num_heads \(3\)"),
        (
            lambda: MDMEncoder(D, D, C, **TRANSFORMER, project_condition=False),
            "requires latent_dim=12",
        ),
        (lambda: MDMUNet(D, D, C, **unet, num_groups=3), r"num_groups \(3\)"),
        (lambda: decoder(*batch(tokens=0)), "the condition encoder returns none"),
        (lambda: MDMDecoder(D, D, C, **TRANSFORMER, memory="concat"), "Set token_memory=true"),
        (
            lambda: MDMDecoder(D, D, C, **TRANSFORMER, context_frames=-1),
            "context_frames=-1: expected a number",
        ),
        (
            lambda: MDMDecoder(D, D, C, **TRANSFORMER, target_encoder="single", target_layers=0),
            "target_layers=0",
        ),
    ):
        with subtests.test(message=message), pytest.raises(UserError, match=message):
            build()


def test_dropout_covers_every_sublayer_of_a_transformer_layer():
    torch.manual_seed(0)
    layer = TransformerLayer(8, 16, 2, 1.0, nn.GELU, cross_attention=True).train()
    x, memory = torch.randn(2, 3, 8), torch.randn(2, 4, 8)
    # With a dropout of 1, nothing of a sublayer is added, so only the layer norms remain.
    expected = x
    for norm in (layer.self_norm, layer.cross_norm, layer.feed_forward_norm):
        assert norm is not None
        expected = norm(expected)
    torch.testing.assert_close(layer(x, None, memory, None), expected)


@pytest.mark.parametrize(
    ("kind", "part"), [(MDMEncoder, "transformer"), (MDMDecoder, "transformer"), (MDMGRU, "gru")]
)
def test_dropout_follows_the_positional_encoding_in_training_alone(kind: Any, part: str) -> None:
    """With a dropout of 1, nothing is left of frames, tokens and positions."""
    sizes: dict[str, Any] = {"latent_dim": 16, "num_layers": 1, "dropout": 1.0}
    if kind is not MDMGRU:
        sizes |= {"ff_size": 8, "num_heads": 2}
    network, sequences = kind(D, D, C, **sizes).double(), []
    getattr(network, part).register_forward_pre_hook(lambda _, inputs: sequences.append(inputs[0]))
    for training in (True, False):
        network.train(training)(*batch())
    in_training, otherwise = sequences
    assert not in_training.any()
    assert otherwise.any()


def test_dropout_inside_of_layers_has_its_rate_and_its_place() -> None:
    torch.manual_seed(0)
    layer, rates = TransformerLayer(8, 16, 2, 0.25, nn.GELU, cross_attention=True), []

    def attend(query: Tensor, key: Tensor, value: Tensor, **options: Any) -> Tensor:
        rates.append(options["dropout_p"])
        return functional.scaled_dot_product_attention(query, key, value)

    assert layer.cross_attention is not None
    layer.self_attention.attend = layer.cross_attention.attend = attend
    x, memory = torch.randn(2, 3, 8), torch.randn(2, 4, 8)
    for training in (True, False):
        layer.train(training)(x, None, memory, None)
    assert rates == [0.25, 0.25, 0.0, 0.0]
    # Of the hidden features, all are dropped here, so only the bias of the last layer remains.
    feed_forward = TransformerLayer(8, 16, 2, 1.0, nn.GELU, False).train().feed_forward
    bias = feed_forward[-1].get_parameter("bias")
    torch.testing.assert_close(feed_forward(x), bias.expand(2, 3, 8))
    block = ResidualBlock(8, 12, features=4, num_groups=4, dropout=1.0).train()
    motion = torch.randn(2, 8, 5)
    expected = block.skip(motion) + block.conv2.get_parameter("bias")[:, None]
    torch.testing.assert_close(block(motion, torch.randn(2, 4), torch.ones(2, 1, 5)), expected)


@pytest.mark.parametrize(
    ("kind", "defaults"),
    [
        (
            FLAME,
            {
                **{"length_token": True, "cross_attention": True, "condition_frames": False},
                "length_unit": 1,
            },
        ),
        (MDMGRU, {"project_condition": True, "recur_over_batch": False}),
        (
            MDMEncoder,
            {
                **{"project_condition": True, "max_tokens": 0, "mask_padding": True},
                "condition_frames": False,
            },
        ),
        (
            MDMDecoder,
            {
                **{"project_condition": True, "input_token": "none", "token_memory": False},
                **{"memory": "add", "mask_padding": True, "context_frames": 0},
                **{"target_encoder": "none", "target_layers": 1, "condition_frames": False},
            },
        ),
        (MDMUNet, {"project_condition": True}),
    ],
)
def test_defaults_of_denoisers_do_not_change(kind: Any, defaults: dict[str, Any]) -> None:
    parameters = signature(kind).parameters.values()
    assert {p.name: p.default for p in parameters if p.default is not p.empty} == defaults
