"""Guo et al.'s evaluator to train: its two parts, what it learns, and text-to-motion measured with it."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from support.stores import line, write_folder, write_words

from evaluators.extractors import OwnT2MExtractor
from evaluators.extractors.t2m import LearnedWords, WordVectors
from evaluators.extractors.t2m_training import T2MTask, matching_loss, reconstruction_terms
from evaluators.extractors.training import ExtractorTask
from flame_mdm.__main__ import main
from flame_mdm.data.t2m import T2MFolder
from flame_mdm.errors import UserError
from flame_mdm.runs import read_history

VERBS = ["walks", "runs", "hops", "bows", "waves", "kicks"]
MANNERS = ["slowly", "quickly", "left", "right", "happily", "sadly"]
MOVEMENT = 40
SIZES = {
    "movement_hidden": 32,
    "movement_latent": 32,
    "text_hidden": 32,
    "motion_hidden": 32,
    "embedding": 16,
}
RUN = [
    "data.num_workers=0",
    "data.batch_size=16",
    "trainer.accelerator=cpu",
    "trainer.enable_progress_bar=false",
]
RUN += ["trainer.log_every_n_steps=10", "optimizer.lr=0.003", f"task.movement_steps={MOVEMENT}"]
RUN += [
    *(f"task.network.{name}={size}" for name, size in SIZES.items()),
    "task.network.max_frames=40",
]


@pytest.fixture(scope="module")
def words(tmp_path_factory) -> list[str]:
    """Overrides of a run on 36 captions, each with a motion in every split, which its two words decide."""
    root = tmp_path_factory.mktemp("t2m")
    generator = np.random.default_rng(1)
    patterns = {word: generator.normal(size=251) for word in VERBS + MANNERS}
    texts, captions, splits = {}, {}, {"train": [], "val": [], "test": []}
    for number, (verb, manner) in enumerate((v, m) for v in VERBS for m in MANNERS):
        for split, names in splits.items():
            name = f"{number:02}{split}"
            names.append(name)
            texts[name], captions[name] = (32, [line(f"{verb} {manner}")]), (verb, manner)
    folder = write_folder(root / "KIT-ML", texts, splits, 251, mirror=False)
    np.save(folder / "Mean.npy", np.full(251, 2.0))
    np.save(folder / "Std.npy", np.full(251, 3.0))
    for name, (verb, manner) in captions.items():
        x = patterns[verb] + patterns[manner] + generator.normal(size=(32, 251)) / 3
        np.save(folder / "new_joint_vecs" / f"{name}.npy", (2 + 3 * x).astype(np.float32))
    known = ["unk", "sos", "eos", *VERBS, *MANNERS]
    glove = write_words(
        root / "glove", known, np.random.default_rng(0).normal(size=(len(known), 300))
    )
    return [*RUN, f"data.source.path={folder}", f"data_root={root}", f"task.words={glove}"]


def fit(folder: Path, words: list[str], *more: str) -> Path:
    assert main(["train", "t2m/kit", *words, f"run.dir={folder}", *more]) == 0
    return folder / "checkpoints" / "last.ckpt"


@pytest.fixture(scope="module")
def trained(tmp_path_factory, words) -> Path:
    """Checkpoint of a small evaluator after 160 steps."""
    folder = tmp_path_factory.mktemp("run")
    return fit(folder, words, "trainer.max_steps=160", f"trainer.val_check_interval={MOVEMENT}")


def logged(checkpoint: Path, name: str) -> dict[int, float]:
    return read_history(checkpoint.parent.parent)[name]


@pytest.mark.slow
def test_training_by_recipe_matches_texts_and_motions(trained):
    loss, top3 = logged(trained, "val/loss"), logged(trained, "val/motions_for_text_top3")
    assert list(loss) == list(logged(trained, "val/mm_dist")) == [39, 79, 119, 159]
    assert loss[159] < loss[39] / 4
    assert top3[159] > 0.5  # by chance 3 in 32
    reconstruction = logged(trained, "val/reconstruction")
    assert reconstruction[39] < 0.95 * logged(trained, "train/loss")[9]
    assert reconstruction[39] == reconstruction[159], "the second part leaves it alone"
    network = OwnT2MExtractor(str(trained)).task.network
    assert torch.equal(network.mean, torch.full((251,), 2.0))
    assert torch.equal(network.std, torch.full((251,), 3.0))


def weights(path: Path) -> dict[str, torch.Tensor]:
    return torch.load(path, weights_only=True)["state_dict"]


def same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor], *parts: str) -> set[bool]:
    """Whether the weights whose names begin so agree, all or none."""
    return {
        torch.equal(a[name], b[name]) for name in a if name.startswith(parts) and "bias" not in name
    }


@pytest.mark.slow
def test_a_resumed_run_is_the_uninterrupted_one_and_changes_parts_at_its_step(words, tmp_path):
    options = [*words, "task.movement_steps=3", "trainer.val_check_interval=2"]
    whole = weights(fit(tmp_path / "whole", options, "trainer.max_steps=6"))
    at = {
        most: weights(fit(tmp_path / "run", options, f"trainer.max_steps={most}"))
        for most in (2, 3, 6)
    }
    assert whole.keys() == at[6].keys()
    assert same(whole, at[6], "") == {True}
    movement, matching = ("decoder", "network.movement"), ("network.text", "network.motion")
    assert same(at[2], at[3], *movement) == same(at[3], at[6], *matching) == {False}
    assert same(at[2], at[3], *matching) == same(at[3], at[6], *movement) == {True}


@pytest.mark.slow
def test_it_measures_text_to_motion(trained, words, tmp_path, monkeypatch):
    where = [word for word in words if word.startswith(("data.source", "data_root"))]
    out = tmp_path / "result.json"
    monkeypatch.chdir(tmp_path)
    options = [
        "baseline=shuffled",
        "data=kit",
        "protocol=text_to_motion_t2m_own",
        f"extractor={trained}",
    ]
    options += [
        f"out={out}",
        "device=cpu",
        "replications=1",
        "data.crop.max_frames=40",
        "multimodality=false",
    ]
    assert main(["evaluate", *options, *where]) == 0
    result = json.loads(out.read_text())
    assert result["invalid_because"] == []
    assert result["ground_truth"]["motions_for_text/top3"]["mean"] > 0.5
    assert result["values"]["motions_for_text/top3"]["mean"] < 0.3
    assert result["values"]["mm_dist"]["mean"] > result["ground_truth"]["mm_dist"]["mean"]
    assert result["extractor"]["data"] == result["data"]["fingerprint"]


@pytest.mark.slow
def test_the_checkpoint_needs_no_word_vectors_beside_it(trained):
    extractor = OwnT2MExtractor(str(trained))
    tokens = [["walks/VERB", "slowly/ADV"], ["runs/VERB", "unheard/ADV"]]
    features = extractor.texts(["", ""], tokens)
    assert features.shape == (2, 16)
    assert torch.allclose(extractor.texts([""], tokens[:1]), features[:1], atol=1e-5)
    with pytest.raises(UserError, match="these are not the word vectors that this run began with"):
        extractor.task.set_extra_state(torch.zeros(15, 300))
    with pytest.raises(
        UserError, match="needs tagged words, but the data set has captions without them"
    ):
        extractor.texts(["walks"], [None])
    with pytest.raises(
        UserError, match=r"trained on .* of kit at .*, but the motions are .* of humanml3d"
    ):
        extractor.check(extractor.task.representation, "humanml3d")


@pytest.mark.slow
def test_what_is_missing_is_one_line(words, tmp_path, monkeypatch, capsys):
    def refusal(change: str) -> str:
        assert main(["train", "t2m/kit", *words, f"run.dir={tmp_path / 'run'}", change]) == 1
        return capsys.readouterr().err

    assert "nowhere/our_vab_idx.pkl: no such file" in refusal("task.words=nowhere")
    assert "data.batch_size=1: matching needs at least two motions" in refusal("data.batch_size=1")
    whole = T2MFolder.clips
    monkeypatch.setattr(
        T2MFolder, "clips", lambda *args: (replace(clip, attributes={}) for clip in whole(*args))
    )
    assert "72 clips have no captions with tagged words, such as 00train" in refusal(
        f"data_root={tmp_path}"
    )


def test_the_loss_is_the_published_one_and_a_motion_that_a_text_describes_is_no_wrong_one():
    motion, text = torch.zeros(2, 4), torch.zeros(2, 4)
    motion[1, 0], text[1, 0] = 3.0, 4.0
    # own pairs at 0 and 1; wrong ones at 3 and 4, of a margin of 3.5
    assert matching_loss(motion, text, 3.5).item() == pytest.approx((0 + 1 + 0.5**2 + 0) / 2)

    motion, text = torch.randn(2, 5, 4, generator=torch.Generator().manual_seed(0))
    fits = torch.eye(5, dtype=torch.bool)
    assert matching_loss(motion, text, 3.0, fits) == matching_loss(motion, text, 3.0)
    fits[2, 1] = fits[0, 4] = fits[0, 3] = True
    near = (motion - text).norm(dim=1).square()
    wrong = [(motion[other] - text[i]).norm() for i, other in enumerate((2, 0, 0, 2, 3))]
    expected = torch.stack(
        [n + (3 - far).clamp(min=0) ** 2 for n, far in zip(near, wrong, strict=True)]
    ).mean()
    torch.testing.assert_close(matching_loss(motion, text, 3.0, fits), expected)
    nothing_wrong = torch.ones(5, 5, dtype=torch.bool)
    torch.testing.assert_close(matching_loss(motion, text, 3.0, nothing_wrong), near.mean())


class Quarter(torch.nn.Module):
    """A movement encoder whose vectors are every fourth frame."""

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x[:, ::4]


def batch_of(x: torch.Tensor, lengths: list[int]) -> Any:
    mask = torch.arange(x.shape[1]) < torch.tensor(lengths)[:, None]
    return SimpleNamespace(x=x, mask=mask)


def test_terms_of_the_movements_are_means_over_real_frames_and_whole_units():
    x = torch.randn(2, 14, 5, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    network: Any = SimpleNamespace(used=3, movement_encoder=Quarter())
    terms = reconstruction_terms(
        network, cast(Any, lambda latents: latents.repeat_interleave(4, 1)), batch_of(x, [14, 7])
    )
    for row, frames, units in ((0, 12, 3), (1, 7, 1)):
        real = x[row, :, :3]
        latents = real[: 4 * units : 4]
        rebuilt = real[:12:4].repeat_interleave(4, 0)[:frames]
        assert terms["reconstruction"][row] == pytest.approx(
            (rebuilt - real[:frames]).abs().mean().item()
        )
        assert terms["sparsity"][row] == pytest.approx(latents.abs().mean().item())
        changes = latents.diff(dim=0).abs().mean().item() if units > 1 else 0.0
        assert terms["smoothness"][row] == pytest.approx(changes)


def test_the_loss_of_movements_weights_its_terms(monkeypatch):
    terms = {"reconstruction": [1.0, 3.0], "sparsity": [10.0, 10.0], "smoothness": [0.0, 100.0]}
    values = {name: torch.tensor(x) for name, x in terms.items()}
    monkeypatch.setattr(
        "evaluators.extractors.t2m_training.reconstruction_terms", lambda *_: values
    )
    task: Any = SimpleNamespace(
        network=SimpleNamespace(movement_encoder=torch.nn.Identity()),
        decoder=None, sparsity=0.1, smoothness=0.01, _learns_movement=True,
        seed_step=lambda _: None, report=lambda _: None, _idle=list,
    )  # fmt: skip
    assert float(T2MTask.training_step(task, cast(Any, None), 0)) == pytest.approx(2 + 1 + 0.5)


@pytest.mark.slow
def test_words_are_learned_from_captions_without_tags(words, tmp_path):
    learned = fit(
        tmp_path,
        words,
        "task.words=learned",
        "trainer.max_steps=120",
        "trainer.val_check_interval=120",
    )
    assert logged(learned, "val/motions_for_text_top3")[119] > 0.5  # by chance 3 in 32
    extractor = OwnT2MExtractor(str(learned))
    features = extractor.texts(["Walks slowly.", "runs left"], [None, None])
    assert torch.allclose(
        extractor.texts(["walks slowly"], [["another/VERB"]]), features[:1], atol=1e-5
    )
    assert not torch.allclose(features[0], features[1], atol=0.1)
    assert isinstance(extractor.task.words, LearnedWords)
    text = extractor.task.words([["walks", "slowly"], ["word"] * 30])
    assert text.vectors.shape == (2, 22, 300)
    assert text.lengths.tolist() == [4, 22]
    assert torch.equal(text.vectors[1, 1], text.vectors[1, 20])
    assert not text.parts.any()


def test_the_wrong_motions_of_a_text_are_those_that_it_does_not_describe(monkeypatch):
    seen = []

    def loss(motion: Any, text: Any, margin: float, fits: torch.Tensor) -> torch.Tensor:
        seen.append(fits.tolist())
        return torch.zeros(())

    monkeypatch.setattr("evaluators.extractors.t2m_training.matching_loss", loss)
    captions = {"first": {"walks", "runs"}, "second": {"runs"}, "third": {"hops"}}
    task: Any = SimpleNamespace(
        network=SimpleNamespace(movement_encoder=torch.nn.Identity()),
        tokens=captions, margin=1.0, device="cpu", _learns_movement=False,
        _embed=lambda batch: (None, None), seed_step=lambda _: None, report=lambda _: None, _idle=list,
    )  # fmt: skip
    batch: Any = SimpleNamespace(ids=["first", "second", "third"], text=["walks", "runs", "hops"])
    T2MTask.training_step(task, batch, 0)
    rows = [[True, False, False], [True, True, False], [False, False, True]]
    assert seen == [rows], "rows are texts, columns are motions"


@pytest.mark.parametrize("learned", [False, True])
def test_of_equal_captions_of_a_clip_the_tags_of_the_first_one_count(learned: bool, monkeypatch):
    clips = [
        SimpleNamespace(
            id=name,
            captions=["Walks.", "runs", "Walks."],
            attributes={"tokens": [["walks/VERB"], [f"{name}/VERB"], ["walks/NOUN"]]},
        )
        for name in ("train", "val")
    ]
    data = SimpleNamespace(
        batch_size=2,
        **{clip.id: SimpleNamespace(clips=[clip]) for clip in clips},
    )
    task = T2MTask.__new__(T2MTask)
    torch.nn.Module.__init__(task)
    task.tokens, task.facts, task.word_folder = {}, {}, "x"
    task.words = LearnedWords() if learned else None
    task.network = cast(Any, SimpleNamespace(mean=torch.zeros(2), std=torch.zeros(2)))
    statistics = SimpleNamespace(mean=torch.full((2,), 3.0), std=torch.full((2,), 4.0))
    task.representation = cast(Any, statistics)
    vectors = WordVectors({"walks": 1, "unk": 0}, torch.zeros(2, 300))
    monkeypatch.setattr(WordVectors, "read", lambda folder: vectors)
    monkeypatch.setattr(T2MTask, "trainer", SimpleNamespace(datamodule=data))
    monkeypatch.setattr(ExtractorTask, "setup", lambda self, stage: None)
    task.setup("fit")
    if learned:
        assert task.tokens["train"] == {"Walks.": ["walks"], "runs": ["runs"]}
    else:
        assert task.tokens["val"] == {"Walks.": ["walks/VERB"], "runs": ["val/VERB"]}
        assert task.facts["words"] == {"walks": 1, "unk": 0}
    assert task.tokens.keys() == {"train", "val"}
    assert (task.network.mean.tolist(), task.network.std.tolist()) == ([3.0] * 2, [4.0] * 2)
