"""Sequences of actions: texts with parts, windows that cover them, continued motions, loops and candidates."""

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
import torch
from support.motions import synthetic

import flame_mdm
from evaluators.selection import text_fit
from flame_mdm.__main__ import main
from flame_mdm.batch import Condition, MotionBatch
from flame_mdm.errors import UserError
from flame_mdm.formats.faults import find_faults
from flame_mdm.processes.windows import Windows, blended, spans, window_tensors
from flame_mdm.sampling.generation import best
from flame_mdm.sampling.request import read_parts
from flame_mdm.sampling.sequences import overlap

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def model() -> flame_mdm.MotionGenerator:
    return flame_mdm.load("quickstart")


@pytest.mark.parametrize("lengths", [[40], [30, 50, 24], [100], [200, 24, 61]])
@pytest.mark.parametrize("loop", [False, True])
def test_windows_cover_every_frame_and_share_the_overlap(lengths, loop):
    windows = spans(lengths, longest=60, overlap=16, loop=loop)
    total = sum(lengths)
    assert max(size for *_, size in windows) <= 60
    assert {part for part, _, _ in windows} == set(range(len(lengths)))
    if not loop:
        assert windows[0][1] == 0
        assert windows[-1][1] + windows[-1][2] == total
    for (_, first, size), (_, after, _) in itertools.pairwise(windows):
        assert first + size - after >= 16
    rows, frames, mask, weights = window_tensors([(0, *window[1:]) for window in windows], [total], 16, 60, CPU)
    sums = torch.zeros(1, total).index_put((rows[:, None].expand_as(frames), frames), weights, accumulate=True)
    torch.testing.assert_close(sums, torch.ones(1, total))
    assert not weights[~mask].any()


def test_one_window_changes_nothing_and_two_are_averaged():
    x, t, mask = torch.randn(2, 20, 3), torch.tensor([5.0, 7.0]), torch.ones(2, 20, dtype=torch.bool)
    cond = Condition(torch.zeros(3, 1), torch.zeros(3, 0, 1), None)

    def covered(spans: list[tuple[int, int, int]]) -> Windows:
        rows, frames, real, weights = window_tensors(spans, [20, 20], 4, 20, CPU)
        return Windows(MotionBatch(torch.zeros(*real.shape, 0), real, ["a"] * len(rows)), rows, frames, weights)

    def denoise(x_t, t, mask, cond):
        return x_t * t[:, None, None]

    whole = blended(denoise, covered([(0, 0, 20), (1, 0, 20)]))
    assert torch.equal(whole(x, t, mask, cond), denoise(x, t, mask, cond))
    number = torch.tensor([1.0, 2.0, 3.0])
    three = covered([(0, 0, 12), (0, 8, 12), (1, 0, 20)])
    several = blended(lambda x_t, *_: number[:, None, None].expand_as(x_t), three)(x, t, mask, cond)[..., 0]
    expected = torch.tensor([1.0] * 8 + [1 + np.sin(np.pi / 16 * n) ** 2 for n in (1, 3, 5, 7)] + [2.0] * 8).float()
    torch.testing.assert_close(several[0], expected)
    torch.testing.assert_close(several[1], torch.full((20,), 3.0))


def test_a_sequence_is_one_motion_of_which_a_part_is_changed_by_its_text(model):
    options = {"seconds": 1.5, "num_inference_steps": 5, "shared_noise": True}
    texts = [f"a person walks forward @2 | a person {what}" for what in ("bows", "jumps")]
    bow, jump = flame_mdm.generate(model, texts, **options)
    assert len(bow.joints) == len(jump.joints) == 70
    assert bow.text == "a person walks forward @2 | a person bows"
    moved = np.abs(bow.features - jump.features).mean(1)
    assert moved[:30].max() < 0.2 * moved[50:].mean()


def test_a_part_longer_than_training_and_one_as_long_as_training(model):
    text = "a person walks forward"
    options: dict[str, Any] = {"num_inference_steps": 5, "shared_noise": True}
    long = flame_mdm.generate(model, f"{text} @20", num_inference_steps=5)[0]
    assert len(long.joints) == 400
    assert np.isfinite(long.joints).all()
    same = flame_mdm.generate(model, f"{text} @2", **options)[0]
    plain = flame_mdm.generate(model, text, seconds=2, **options)[0]
    np.testing.assert_allclose(same.joints, plain.joints, atol=1e-5)
    with pytest.raises(UserError, match="'walks @20'"):
        flame_mdm.generate(model, text, seconds=20)


def test_a_continued_motion_begins_with_it_and_knows_its_parts(model, tmp_path):
    assert read_parts("walks @3 | turns left| sits @ 2.5s") == [("walks", 3.0), ("turns left", None), ("sits", 2.5)]
    begin = flame_mdm.generate(model, "a person walks forward", seconds=2, num_inference_steps=5)[0]
    begin.save(tmp_path / "walk.npz")
    options = {"after": tmp_path / "walk.npz", "seconds": 1.5, "num_inference_steps": 5}
    motion = flame_mdm.generate(model, "a person bows @1 | a person jumps", **options)[0]
    assert motion.parts == (("a person bows", 40, 60), ("a person jumps", 60, 90))
    assert len(motion.joints) == 40 + 20 + 30
    np.testing.assert_allclose(motion.joints[:40], begin.joints, atol=1e-5)
    step = np.linalg.norm(np.diff(motion.joints, axis=0), axis=-1).max(1)
    assert step[39] < 3 * step.max() / 2
    short = flame_mdm.generate(model, "a person bows", frames=4, num_inference_steps=2)[0]
    with pytest.raises(UserError, match="too short"):
        flame_mdm.generate(model, "a person bows", after=short)


def test_a_loop_has_no_seam(model):
    """The raised arm of a loop comes down again. The window of a loop goes around it."""
    shared = overlap(model)
    ((_, first, size),) = spans([40], 60, shared, loop=True)
    assert (first, size) == (-shared // 2, 40 + shared)

    def seam(loop: bool) -> float:
        text = "a person raises both arms"
        features = flame_mdm.generate(model, text, seconds=2, loop=loop)[0].features[:, 4:67]
        return float(np.abs(features[0] - features[-1]).max() / np.abs(np.diff(features, axis=0)).max())

    assert seam(loop=True) < 1 < seam(loop=False)


def test_bad_requests_give_one_clear_line(model):
    cases: list[tuple[Any, dict[str, Any], str]] = [
        ("walks | | sits", {}, "part 2 is empty"),
        ("walks @fast", {}, "seconds of a part are a number"),
        ("walks @-1", {}, "seconds of a part are a number"),
        ("walks @0.2 | sits", {}, "'walks': a part of 0.2 seconds is too short"),
        ("walks @9999", {}, "too long"),
        ("walks", {"after": "walk.npz", "loop": True}, r"^after=walk\.npz: a motion .* cannot have loop\."),
        ("walks", {"after": "walk.npz", "targets": "path.json"}, r"^after=walk\.npz: .* cannot have targets\."),
        ("walks", {"after": "notes.txt"}, r"^notes\.txt: not a motion\. Give a \.npz"),
        ("walks", {"candidates": 0}, "candidates=0"),
        ("walks", {"candidates": 2, "stages": []}, "single motion"),
        ("walks", {"seed": 0.5}, "seed=0.5: give a whole number"),
        ("walks", {"actions": "walk"}, "texts or actions, not both"),
        ("walks", {"second": 3}, "generate has no option second. Did you mean seconds"),
        (None, {"actions": "walk"}, "action=walk: this model was trained on captions"),
        (" ", {}, "empty text"),
        ([], {}, "empty text"),  # is not an unconditioned motion
        (["walk", 3], {}, r"^text=3 is not a string\. Give a string"),
        ("walks", {"spacing": "even"}, "spacing=even"),
    ]
    for text, options, message in cases:
        with pytest.raises(UserError, match=message) as raised:
            flame_mdm.generate(model, text, **options)
        assert "\n" not in str(raised.value), message


def test_the_best_of_several_candidates_is_kept(model):
    text, options, groups = "a person walks forward", {"seconds": 1.5, "num_inference_steps": 4}, list[int]()

    def score(motions: Sequence[flame_mdm.Motion]) -> list[float]:
        """How far the root goes."""
        groups.append(len(motions))
        return [float(np.linalg.norm(motion.joints[-1, 0])) for motion in motions]

    several = flame_mdm.generate(model, text, samples=6, **options)
    chosen = flame_mdm.generate(model, text, samples=2, candidates=3, score=score, **options)
    assert len(chosen) == len(groups) == 2
    for motion, group in zip(chosen, (several[:3], several[3:]), strict=True):
        faultless = [motion for motion in group if not find_faults(motion)] or group
        np.testing.assert_allclose(motion.joints, faultless[int(np.argmax(score(faultless)))].joints, atol=1e-4)


def test_without_a_score_the_fewest_faulty_frames_decide():
    worse, better = synthetic(), synthetic()
    worse.joints[[5, 9], 3, 0] += 5
    better.joints[5, 3, 0] += 5
    assert best([worse, better]) is better
    assert best([worse, better], lambda motions: [2.0, 1.0]) is worse


def test_bad_words_and_scorers_are_one_line(model, tmp_path, capsys):
    with pytest.raises(FileNotFoundError, match="no such"):
        text_fit(str(tmp_path / "none.ckpt"), model)
    for words, message in (
        ([], "say what to sample: text=..., for example "),
        (["text=walks", "unconditioned=true"], "not text and unconditioned"),
        (["text=walks", "scorer=none.ckpt"], "scorer=none.ckpt chooses among motions for a text"),
        (["text=walks", "scorer=none.ckpt", "candidates=2"], "scorer: none.ckpt: no such checkpoint. Give a run"),
        (["text=walks", "scorer=quickstart", "candidates=2"], "holds a motion generator, not a motion-CLIP"),
    ):
        assert main(["sample", "quickstart", *words]) == 1
        assert message in capsys.readouterr().err
