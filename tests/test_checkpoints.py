"""Released weights in our networks give the authors' outputs."""

import json

import pytest
import torch
from fixtures import GOLDEN, Arrays, golden, meta
from hydra.utils import instantiate

from flame_mdm.denoisers import Denoiser
from flame_mdm.motion import Condition
from flame_mdm.released import Released, import_flame, import_mdm, released_state

MDM = [
    "mdm_trans_enc",
    "mdm_trans_dec",
    "mdm_trans_dec_emb",
    "mdm_trans_dec_bert",
    "mdm_gru",
    "mdm_action_rot6d",
    "mdm_uncond_rot6d",
    "mfm",
]
DTYPES = [torch.float32, torch.float64]


def weights(arrays: Arrays) -> dict[str, torch.Tensor]:
    return {key.removeprefix("state/"): torch.from_numpy(v) for key, v in arrays.items() if key.startswith("state/")}


def build(released: Released, dtype: torch.dtype) -> Denoiser:
    denoiser = instantiate(released.config, *released.features)
    denoiser.load_state_dict(released.state)
    return denoiser.to(dtype).eval()


def import_case(arrays: Arrays, case: str) -> Released:
    """The fixture's network with the flags of `case`: `cond`, `cond_maskframes`, `legacy_cond` ..."""
    config = meta(arrays)["config"]
    args = {key: config[key] for key in ("arch", "emb_trans_dec", "text_encoder_type") if key in config}
    args["mask_frames"] = case.endswith("_maskframes")
    heads = config.get("num_heads", config.get("heads"))
    return import_mdm(weights(arrays), args, num_heads=heads, time_token="legacy" not in case)


def condition(arrays: Arrays, released: Released, dtype: torch.dtype) -> Condition:
    """The fixture's condition, its null included: zeros in place of the embedding."""
    batch = len(arrays["in/x_t"])
    pooled, tokens, token_mask = torch.zeros(batch, released.features[2]), torch.zeros(batch, 0, 0), None
    if released.action_embedding is not None:
        pooled = released.action_embedding[torch.from_numpy(arrays["in/action"])[:, 0]]
    elif "in/text_mask" in arrays:
        tokens = torch.from_numpy(arrays["in/text_embed"]).transpose(0, 1)
        token_mask = ~torch.from_numpy(arrays["in/text_mask"])
        pooled = tokens[:, 0]
    elif "in/text_embed" in arrays:
        pooled = torch.from_numpy(arrays["in/text_embed"]).reshape(batch, -1)
    pooled, tokens = pooled.to(dtype), tokens.to(dtype)
    null = Condition(torch.zeros_like(pooled[:1]), torch.zeros_like(tokens[:1]), None)
    return Condition(pooled, tokens, token_mask, null)


def frames_last(arrays: Arrays, y: torch.Tensor) -> torch.Tensor:
    """(B, F, D) -> the authors' (B, joints, features, F)."""
    return y.transpose(1, 2).unflatten(1, arrays["in/x_t"].shape[1:3])


def tolerance(arrays: Arrays, key: str) -> float:
    """Ten times what the authors' float32 differs from their float64; where they give none, that of the condition."""
    differences = meta(arrays)["max_abs_diff_f32_vs_f64"]
    difference = differences.get(key) or differences["out/cond"]
    # A float64 time a hair off one of MFM's table rows makes its own float64 differ: that says nothing on float32.
    return 10 * min(difference[0] if isinstance(difference, list) else difference, 1e-5)


def mdm_cases() -> list:
    names = ("cond", "uncond", "cfg", "train_cond_drop", "cond_last_sample_alone", "legacy_cond", "legacy_uncond")
    names += ("cond_maskframes", "uncond_maskframes", "cfg_maskframes", "cond_scalar_t")
    return [
        pytest.param(stem, name, id=f"{stem}-{name}")
        for stem in MDM
        for name in names
        if (GOLDEN / f"{stem}.npz").is_file() and f"out/{name}" in golden(stem)
    ]


@pytest.mark.golden
@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize(("stem", "case"), mdm_cases())
@torch.no_grad()
def test_mdm_outputs(stem: str, case: str, dtype: torch.dtype) -> None:
    arrays = golden(stem)
    released = import_case(arrays, case)
    denoiser = build(released, dtype)
    cond = condition(arrays, released, dtype)
    x_t = torch.from_numpy(arrays["in/x_t"]).flatten(1, 2).transpose(1, 2).to(dtype)
    t = torch.from_numpy(arrays["in/t"])
    # MFM's network takes a row number cut from its time in [0, 1].
    t = (t * 1000).floor() if t.is_floating_point() else t.float()
    mask = torch.from_numpy(arrays["in/mask"])[:, 0, 0]
    if case == "cond_scalar_t":
        t = t[:1].expand(len(t))
    if case == "cond_last_sample_alone":
        cond = Condition(cond.pooled[-1:], cond.tokens[-1:], None)
        x_t, t, mask = x_t[-1:], t[-1:], mask[-1:]
    if "uncond" in case:
        cond = cond.drop(torch.ones(len(x_t), dtype=torch.bool))
    if case == "train_cond_drop":
        cond = cond.drop(torch.from_numpy(arrays["in/cond_drop"]).bool())
    y = denoiser(x_t, t, mask, cond)
    if "cfg" in case:
        # The two halves run apart: in a batch of 2B the recurrence over the batch axis would join them.
        null = denoiser(x_t, t, mask, cond.drop(torch.ones(len(x_t), dtype=torch.bool)))
        y = null + torch.from_numpy(arrays["in/scale"]).to(dtype)[:, None, None] * (y - null)
    expected = torch.from_numpy(arrays[f"out/{case}"]).to(dtype)
    torch.testing.assert_close(frames_last(arrays, y), expected, rtol=0, atol=tolerance(arrays, f"out/{case}"))


@pytest.mark.golden
@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize("case", ["model", "model_null_text", "cfg_model_fn"], ids=lambda c: f"flame_text2motion-{c}")
@torch.no_grad()
def test_flame_outputs(case: str, dtype: torch.dtype) -> None:
    arrays = golden("flame_text2motion")
    released = import_flame(weights(arrays), num_heads=meta(arrays)["config"]["heads"])
    denoiser = build(released, dtype)
    pooled = torch.from_numpy(arrays["lm/pooler_output"]).to(dtype)
    tokens = torch.from_numpy(arrays["lm/last_hidden_state"]).to(dtype)
    everywhere = torch.ones(tokens.shape[:2], dtype=torch.bool)  # the authors attend to the padding of the text
    null = Condition(pooled[-1:], tokens[-1:], everywhere[-1:])
    cond = Condition(pooled[:-1], tokens[:-1], everywhere[:-1], null)
    batch = len(cond.pooled)
    if case == "cfg_model_fn":
        x_t = torch.from_numpy(arrays["cfg/x_t"])[:batch].transpose(1, 2).to(dtype)
        t = torch.from_numpy(arrays["cfg/t"])[:batch]
        mask = torch.ones(x_t.shape[:2], dtype=torch.bool)
        both = denoiser(x_t.repeat(2, 1, 1), t.repeat(2), mask.repeat(2, 1), cond.with_null())
        y, without = both.chunk(2)
        mean = slice(0, x_t.shape[-1])
        scale = meta(arrays)["config"]["scale"]
        y[..., mean] = without[..., mean] + scale * (y[..., mean] - without[..., mean])
    else:
        x_t = torch.from_numpy(arrays["in/motion"]).transpose(1, 2).to(dtype)
        t, mask = torch.from_numpy(arrays["in/t"]), torch.from_numpy(arrays["in/mask"])
        if case == "model_null_text":
            cond = cond.drop(torch.ones(batch, dtype=torch.bool))
        y = denoiser(x_t, t, mask, cond)
    expected = torch.from_numpy(arrays[f"out/{case}"]).to(dtype)
    torch.testing.assert_close(y.transpose(1, 2), expected, rtol=0, atol=tolerance(arrays, f"out/{case}"))


def manifest() -> dict:
    path = GOLDEN / "state_dict_manifest.json"
    return json.loads(path.read_text()) if path.is_file() else {}


@pytest.mark.golden
@pytest.mark.parametrize("name", sorted(n for n in manifest() if n.startswith(("mdm_", "mfm_", "flame_hml"))))
def test_state_dict_manifest(name: str) -> None:
    """At the released size every weight finds its place, and text encoders are left."""
    entry = manifest()[name]
    state = {key: torch.empty(shape, device="meta") for key, shape in entry["keys"].items()}
    if name.startswith("flame"):
        released = import_flame(state | {"lm.embeddings.word_embeddings.weight": torch.empty(3)})
    else:
        args = {"arch": next((a for a in ("trans_dec", "gru") if a in name), "trans_enc")}
        args |= {"emb_trans_dec": name.endswith("_emb"), "text_encoder_type": "bert" if "bert" in name else "clip"}
        released = import_mdm(state | {"clip_model.positional_embedding": torch.empty(3)}, args)
    action = 0 if released.action_embedding is None else released.action_embedding.numel()
    assert sum(value.numel() for value in released.state.values()) + action == entry["n_params"]


def small_state() -> dict[str, torch.Tensor]:
    """A state dict with the authors' names, from our own network."""
    state = {"input_process.poseEmbedding.weight": torch.ones(8, 3), "input_process.poseEmbedding.bias": torch.ones(8)}
    state |= {"output_process.poseFinal.weight": torch.ones(3, 8), "output_process.poseFinal.bias": torch.ones(3)}
    for i in (0, 2):
        state[f"embed_timestep.time_embed.{i}.weight"] = torch.ones(8, 8)
        state[f"embed_timestep.time_embed.{i}.bias"] = torch.ones(8)
    layer = torch.nn.TransformerEncoderLayer(8, 4, 16)
    state |= {f"seqTransEncoder.layers.0.{key}": value for key, value in layer.state_dict().items()}
    return state


def test_options_come_from_args_and_weights() -> None:
    released = import_mdm(small_state(), {"arch": "trans_enc", "mask_frames": True})
    assert released.features == (3, 3, 0)
    assert released.config == {
        "_target_": "flame_mdm.denoisers.mdm.MDMEncoder",
        "latent_dim": 8,
        "ff_size": 16,
        "num_layers": 1,
        "num_heads": 4,
        "dropout": 0.1,
        "mask_padding": True,
    }
    assert import_mdm(small_state(), {}).config["mask_padding"] is False


def test_every_weight_is_used_or_the_import_fails() -> None:
    state = small_state()
    with pytest.raises(ValueError, match=r"unknown embed_style\.weight"):
        import_mdm(state | {"embed_style.weight": torch.ones(1)}, {})
    with pytest.raises(ValueError, match=r"unknown seqTransEncoder\.layers\.0\.linear1\.bias.* and 7 more"):
        import_mdm(state, {"arch": "trans_dec"})
    with pytest.raises(ValueError, match="arch is trans_enc, trans_dec or gru, not 'mamba'"):
        import_mdm(state, {"arch": "mamba"})
    missing = {key: value for key, value in state.items() if key != "seqTransEncoder.layers.0.linear2.bias"}
    with pytest.raises(ValueError, match=r"nothing for transformer\.layers\.0\.feed_forward\.3\.bias"):
        import_mdm(missing, {})
    with pytest.raises(ValueError, match=r"nothing for output\.weight"):
        import_mdm({}, {})
    short = state | {"seqTransEncoder.layers.0.linear1.bias": torch.ones(2)}
    with pytest.raises(ValueError, match=r"feed_forward\.0\.bias is \(2,\), expected \(16,\)"):
        import_mdm(short, {})


def test_layouts_of_released_files() -> None:
    raw, averaged = {"w": torch.zeros(1)}, {"w": torch.ones(1)}
    assert released_state(raw)["w"] == 0
    assert released_state({"model": raw, "model_avg": averaged})["w"] == 1
    assert released_state({"model": raw, "model_avg": averaged}, ema=False)["w"] == 0
    lightning = {"epoch": 3, "state_dict": {"net.w": raw["w"], "ema_model.model.w": averaged["w"]}}
    assert released_state(lightning) == {"w": averaged["w"]}
    assert released_state(lightning, ema=False) == {"w": raw["w"]}
    with pytest.raises(ValueError, match="found epoch, optimizer"):
        released_state({"epoch": 3, "optimizer": {}})
