"""Words of texts, sequences of actions, windows that cover them, continued motions, loops, and targets."""

import itertools
import json
import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from support.refusals import error_of, one_line_error

import flame_mdm
from flame_mdm.__main__ import main
from flame_mdm.batch import Condition
from flame_mdm.checkpoints.model_files import read_checkpoint
from flame_mdm.conditions import vocabulary
from flame_mdm.conditions.tokens import LearnedTokens
from flame_mdm.data.synthetic import Synthetic
from flame_mdm.errors import UserError
from flame_mdm.formats.motion import Motion
from flame_mdm.losses import bone_lengths
from flame_mdm.processes.guidance import Positions, reach
from flame_mdm.processes.windows import blended, cover, spans
from flame_mdm.representations.rotation import rotate_y
from flame_mdm.sampling import targets as targets_module
from flame_mdm.sampling.motion_request import SamplingRequest, read_parts
from flame_mdm.sampling.sequences import overlap, part_frames, windows
from flame_mdm.sampling.targets import Targets, errors, read_targets

CPU, TEXT = torch.device("cpu"), "a person walks forward"


@pytest.fixture(scope="module")
def model() -> flame_mdm.MotionGenerator:
    return flame_mdm.load("quickstart")


@pytest.mark.parametrize("lengths", [[40], [30, 50, 24], [100], [200, 24, 61]])
@pytest.mark.parametrize("loop", [False, True])
def test_windows_cover_every_frame_and_share_the_overlap(lengths, loop, subtests):
    windows = spans(lengths, longest=60, overlap=16, loop=loop)
    total = sum(lengths)
    assert max(size for *_, size in windows) <= 60
    assert {part for part, _, _ in windows} == set(range(len(lengths)))
    if not loop:
        assert windows[0][1] == 0
        assert windows[-1][1] + windows[-1][2] == total
    for (_, first, size), (_, after, _) in itertools.pairwise(windows):
        with subtests.test(first=first):
            assert first + size - after >= 16
    covered = cover([(0, *window[1:]) for window in windows], [total], 16, 60, CPU)
    index = covered.rows[:, None].expand_as(covered.frames), covered.frames
    sums = torch.zeros(1, total).index_put(index, covered.weights, accumulate=True)
    torch.testing.assert_close(sums, torch.ones(1, total))
    assert not covered.weights[~covered.batch.mask].any()


def test_windows_of_motions_of_different_lengths_have_weights_that_sum_to_one():
    lengths, overlap = [[10, 10], [7], [12, 9, 30]], 4
    positions = [
        (row, first, size)
        for row, parts in enumerate(lengths)
        for _, first, size in spans(parts, 16, overlap)
    ]
    totals = [sum(parts) for parts in lengths]
    windows = cover(positions, totals, overlap, 16, torch.device("cpu"))
    for row, total in enumerate(totals):
        of_row = windows.rows == row
        sums = torch.zeros(total).index_add(
            0, windows.frames[of_row].flatten(), windows.weights[of_row].flatten()
        )
        torch.testing.assert_close(sums, torch.ones(total))
        # A frame that only one window contains has weight 1
        assert windows.weights[of_row][0, 0] == 1


def test_windows_of_a_long_part_are_evenly_spaced():
    """Starts are rounded to the nearest frame."""
    assert spans([200], longest=60, overlap=16) == [
        (0, 0, 53),
        (0, 37, 53),
        (0, 74, 53),
        (0, 110, 53),
        (0, 147, 53),
    ]
    assert spans([30, 100], longest=60, overlap=10, loop=True) == [
        (0, -5, 40),
        (1, 25, 60),
        (1, 75, 60),
    ]


@pytest.mark.parametrize(
    ("fps", "longest", "context", "frames"),
    [
        (20, 60, 0, 10),
        (30, 200, 0, 16),
        (25, 200, 0, 12),
        (60, 400, 0, 30),
        (20, 20, 0, 6),
        (20, 22, 0, 8),
        (20, 60, 10, 0),
    ],
)
def test_windows_share_half_a_second_but_at_most_a_third_of_the_longest_motion(
    fps, longest, context, frames
):
    """The number of frames is even, so that a window extends equally far into both neighbors."""
    assert overlap(sized(fps, longest, context)) == frames


def sized(fps: float, longest: int, context: int = 0) -> Any:
    """A model of motions of up to `longest` frames, which determine the lengths of parts."""
    return SimpleNamespace(
        representation=SimpleNamespace(fps=fps),
        facts={"max_frames": longest},
        denoiser=SimpleNamespace(context_frames=context),
    )


@pytest.mark.parametrize(
    ("model", "usual", "frames"),
    [
        (sized(20, 80), 29.8, 30),
        (sized(20, 80), 29.2, 29),
        (sized(20, 80), 80.4, 80),
        (sized(20, 80), 1.6, 2),
        (sized(20, 80), None, 60),
        (sized(20, 50), None, 50),
        (sized(30, 200), None, 90),
    ],
)
def test_a_motion_has_the_nearest_number_of_frames_and_three_seconds_by_default(
    model, usual, frames
):
    parts = [("walks", None)]
    assert part_frames(model, "walks", parts, [usual], is_sequence=False, loop=False) == [frames]


@pytest.mark.parametrize(
    ("model", "seconds", "usual", "loop", "frames"),
    [
        # Without a duration, a part fits into one window with its overlap.
        (sized(20, 60), [1.49, None], None, False, [30, 50]),
        (sized(20, 60), [None], None, False, [60]),
        (sized(20, 60), [None], None, True, [50]),
        (sized(20, 200), [None, None], None, False, [60, 60]),
        (sized(20, 60), [1.0, None], 29.8, False, [20, 30]),
        (sized(20, 60), [0.5, 0.52], None, False, [10, 10]),
        (sized(20, 60), [300, 300], None, False, [6000, 6000]),
        (sized(20, 40, 10), [0.05, None], None, False, [1, 60]),
    ],
)
def test_parts_have_their_durations_or_as_many_frames_as_fit_into_a_window(
    model, seconds, usual, loop, frames
):
    parts = [("walks", duration) for duration in seconds]
    lengths = part_frames(model, "walks", parts, [usual] * len(parts), is_sequence=True, loop=loop)
    assert lengths == frames


@pytest.mark.parametrize(
    ("model", "seconds", "usual", "message"),
    [
        (sized(20, 60), [None], 1.4, "0.05 seconds .1 frames. is too short"),
        (sized(20, 60), [None], 61.0, "trained on motions of up to 3 seconds"),
        (sized(20, 60), [2.0, 0.45], None, "a part of 0.45 seconds is too short. .* at least 0.5"),
        (sized(20, 60), [300, 300.1], None, "600.1 seconds is too long. Use at most 600 seconds"),
        (sized(20, 40, 10), [0.02], None, "0 seconds is too short. Use at least 0.05 seconds"),
    ],
)
def test_lengths_out_of_range_are_refused(model, seconds, usual, message):
    parts = [("walks", duration) for duration in seconds]
    timed = seconds != [None]
    with pytest.raises(UserError, match=message):
        part_frames(model, "walks", parts, [usual] * len(parts), is_sequence=timed, loop=False)


def test_one_window_changes_nothing_and_two_are_averaged():
    x, t, mask = (
        torch.randn(2, 20, 3),
        torch.tensor([5.0, 7.0]),
        torch.ones(2, 20, dtype=torch.bool),
    )
    cond = Condition(torch.zeros(3, 1), torch.zeros(3, 0, 1), None)

    def denoise(x_t, t, mask, cond):
        return x_t * t[:, None, None]

    whole = blended(denoise, cover([(0, 0, 20), (1, 0, 20)], [20, 20], 4, 20, CPU))
    assert torch.equal(whole(x, t, mask, cond), denoise(x, t, mask, cond))
    number, three = (
        torch.tensor([1.0, 2.0, 3.0]),
        cover([(0, 0, 12), (0, 8, 12), (1, 0, 20)], [20, 20], 4, 20, CPU),
    )
    several = blended(lambda x_t, *_: number[:, None, None].expand_as(x_t), three)(
        x, t, mask, cond
    )[..., 0]
    expected = torch.tensor(
        [1.0] * 8 + [1 + np.sin(np.pi / 16 * n) ** 2 for n in (1, 3, 5, 7)] + [2.0] * 8
    ).float()
    torch.testing.assert_close(several[0], expected)
    torch.testing.assert_close(several[1], torch.full((20,), 3.0))


FAST: dict[str, Any] = {"num_inference_steps": 5, "shared_noise": True}


def test_a_sequence_is_one_motion_of_which_a_part_is_changed_by_its_text(model):
    texts = [f"{TEXT} @2 | a person {what}" for what in ("bows", "jumps")]
    bow, jump = flame_mdm.generate(model, texts, seconds=1.5, **FAST)
    assert len(bow.joints) == len(jump.joints) == 70
    assert bow.text == texts[0]
    moved = np.abs(bow.features - jump.features).mean(1)
    assert moved[:30].max() < 0.2 * moved[50:].mean()


def test_a_part_longer_than_training_and_one_as_long_as_training(model):
    long, same = (flame_mdm.generate(model, f"{TEXT} @{seconds}", **FAST)[0] for seconds in (20, 2))
    assert len(long.joints) == 400
    plain = flame_mdm.generate(model, TEXT, seconds=2, **FAST)[0]
    np.testing.assert_allclose(same.joints, plain.joints, atol=1e-5)
    with pytest.raises(UserError, match="'walks @20'"):
        flame_mdm.generate(model, TEXT, seconds=20)


def test_a_continued_motion_begins_with_it_and_knows_its_parts(model, tmp_path):
    assert read_parts("walks @3 | turns left| sits @ 2.5s") == [
        ("walks", 3.0),
        ("turns left", None),
        ("sits", 2.5),
    ]
    begin = flame_mdm.generate(model, TEXT, seconds=2, **FAST)[0]
    begin.save(tmp_path / "walk.npz")
    text, after = "a person bows @1 | a person jumps", tmp_path / "walk.npz"
    motion = flame_mdm.generate(model, text, after=after, seconds=1.5, num_inference_steps=5)[0]
    assert motion.parts == (("a person bows", 40, 60), ("a person jumps", 60, 90))
    np.testing.assert_allclose(motion.joints[:40], begin.joints, atol=1e-5)
    step = np.linalg.norm(np.diff(motion.joints, axis=0), axis=-1).max(1)
    assert step[39] < 1.5 * np.delete(step, 39).max()
    with pytest.raises(UserError, match="at least 10 frames"):
        flame_mdm.generate(model, TEXT, after=flame_mdm.generate(model, TEXT, frames=4, **FAST)[0])


def test_a_loop_has_no_seam(model):
    """The raised arm of a loop comes down again. The window of a loop goes around it."""
    shared = overlap(model)
    ((_, first, size),) = spans([40], 60, shared, loop=True)
    assert (first, size) == (-shared // 2, 40 + shared)

    def seam(loop: bool) -> float:
        features = flame_mdm.generate(model, "a person raises both arms", seconds=2, loop=loop)[
            0
        ].features[:, 4:67]
        return float(
            np.abs(features[0] - features[-1]).max() / np.abs(np.diff(features, axis=0)).max()
        )

    assert seam(loop=True) < 1 < seam(loop=False)


def test_bad_requests_give_one_clear_line(model, subtests):
    cases: list[tuple[Any, dict[str, Any], str]] = [
        ("walks | | sits", {}, "part 2 is empty"),
        ("walks @fast", {}, "duration of a part must be a number"),
        ("walks @0.2 | sits", {}, "'walks': a part of 0.2 seconds is too short"),
        ("walks @9999", {}, "too long"),
        (
            "walks",
            {"after": "walk.npz", "loop": True},
            r"^after=walk\.npz: a motion .* cannot be combined with loop\.",
        ),
        (
            "walks",
            {"after": "walk.npz", "targets": "path.json"},
            r"^after=walk\.npz: .* cannot be combined with targets\.",
        ),
        ("walks", {"after": "notes.txt"}, r"^notes\.txt: not a motion\. Use a file of type \.npz"),
        ("walks", {"seed": 0.5}, "seed=0.5: expected a whole number"),
        ("walks", {"actions": "walk"}, "texts and actions cannot be combined"),
        ("walks", {"second": 3}, "generate has no option second. Did you mean seconds"),
        (None, {"actions": "walk"}, "action=walk: this model was trained on captions"),
        (" ", {}, "the text is empty"),
        ([], {}, "the text is empty"),  # is not an unconditioned motion
        (["walk", 3], {}, r"^text=3 is not a string\. Pass a string"),
    ]
    for text, options, message in cases:
        with subtests.test(message=message), one_line_error(message):
            flame_mdm.generate(model, text, **options)


def bones(motion: flame_mdm.Motion) -> np.ndarray:
    """Lengths (F, N) of all bones, except bones of the root."""
    return np.linalg.norm(
        motion.skeleton.bones(torch.from_numpy(motion.joints)).numpy()[:, 1:], axis=-1
    )


def test_a_linear_decoder_is_solved_exactly_and_changes_least():
    """Two of six features decide on the position: both change by half, and smoothly in time."""
    x, free = torch.zeros(1, 9, 6), torch.ones(1, 9, 6, dtype=torch.bool)

    def to_joints(features: torch.Tensor) -> torch.Tensor:
        position = features[..., 0] + features[..., 1]
        return torch.stack([position, features[..., 2], features[..., 3]], -1)[..., None, :]

    goal = Positions(torch.tensor([4]), torch.tensor([0]), torch.tensor([0]), torch.tensor([2.0]))
    no_bones = torch.zeros(3, 0, dtype=torch.long)
    moved = reach(x, to_joints, goal, no_bones, free, smoothness=1.0)[0]
    assert moved[4, :2].tolist() == pytest.approx([1.0, 1.0], abs=1e-2)
    assert moved[5, 0] == pytest.approx(float(moved[4, 0] * np.exp(-0.5)), rel=1e-4)
    assert not moved[:, 2:].any()
    free[..., 1] = False
    moved = reach(x, to_joints, goal, no_bones, free, smoothness=1.0)[0]
    assert moved[4, :2].tolist() == pytest.approx([2.0, 0.0], abs=1e-2)


def squared(features: torch.Tensor) -> torch.Tensor:
    """One joint (F, 1, 3) whose x is the square of the first feature."""
    return torch.stack([features[:, 0] ** 2, features[:, 1], features[:, 2]], -1)[:, None]


def test_a_search_ends_below_5_mm_or_after_8_steps(subtests):
    """A thousandth of the error remains after each step of a linear decoder."""
    no_bones = torch.zeros(3, 0, dtype=torch.long)
    x, free = torch.zeros(1, 1, 3), torch.ones(1, 1, 3, dtype=torch.bool)
    place = torch.tensor([0])
    for value, reached in ((4.0, 4 / 1.001), (6.0, 6 - 6 / 1001**2)):
        with subtests.test(value=value):
            goal = Positions(place, place, place, torch.tensor([value]))
            moved = reach(x, lambda y: y[:, None], goal, no_bones, free, smoothness=1.0)
            assert moved[0, 0, 0].item() == pytest.approx(reached, abs=1e-5)
    # Newton's method halves the root of a square.
    goal = Positions(place, place, place, torch.tensor([0.0]))
    x[..., 0] = 100.0
    moved = reach(x, squared, goal, no_bones, free, smoothness=1.0)
    assert moved[0, 0, 0].item() == pytest.approx(100 * (1 - 0.5 / 1.001) ** 8, rel=1e-3)


def test_the_prior_of_a_change_ends_after_three_standard_deviations():
    x, free = torch.zeros(1, 11, 3), torch.ones(1, 11, 3, dtype=torch.bool)
    goal = Positions(torch.tensor([5]), torch.tensor([0]), torch.tensor([0]), torch.tensor([2.0]))
    no_bones = torch.zeros(3, 0, dtype=torch.long)
    moved = reach(x, lambda y: y[:, None], goal, no_bones, free, smoothness=1.0)[0, :, 0]
    offsets = torch.arange(11) - 5
    expected = torch.where(offsets.abs() <= 3, torch.exp(-0.5 * offsets**2), 0.0) * 2 / 1.001
    torch.testing.assert_close(moved, expected)


def test_bones_have_their_median_length_in_the_frame_of_a_position_and_nearly_their_own_elsewhere():
    """The bone from joint 0 to joint 1 is 1, 1, 1, 2 and 3 m long, with a median of 1 m."""
    x = torch.zeros(1, 5, 6)
    x[0, :, 3] = torch.tensor([1.0, 1.0, 1.0, 2.0, 3.0])
    free = torch.ones(1, 5, 6, dtype=torch.bool)
    bones = torch.tensor([[2], [0], [1]])
    frame, joint, axis = (torch.tensor([number]) for number in (2, 1, 1))
    goal = Positions(frame, joint, axis, torch.tensor([0.3]))
    moved = reach(x, lambda y: y.unflatten(-1, (2, 3)), goal, bones, free, smoothness=0.5)
    joints = moved[0].unflatten(-1, (2, 3))
    lengths = (joints[:, 1] - joints[:, 0]).norm(dim=-1)
    share = np.exp(-0.5 * (1 / 0.5) ** 2)  # of the neighboring frames
    assert lengths.tolist() == pytest.approx([1, 1, 1, share + (1 - share) * 2, 3], abs=0.006)
    assert joints[2, 1, 1].item() == pytest.approx(0.3, abs=0.006)


def two_joints(features: torch.Tensor) -> torch.Tensor:
    """Joint positions (..., 2, 3) that are the first six of seven features."""
    return features[..., :6].unflatten(-1, (2, 3))


def test_each_motion_of_a_batch_reaches_positions_as_it_does_alone():
    """The motions have bones of 1 m and 2 m, and other features that may change."""
    x = 0.1 * torch.randn(2, 9, 7, generator=torch.Generator().manual_seed(0))
    x[..., 4] += torch.tensor([1.0, 2.0])[:, None]
    free = torch.ones(2, 9, 7, dtype=torch.bool)
    free[0, :, 3], free[1, :, 5] = False, False
    frames, joints, axes = torch.tensor([4, 4, 6]), torch.tensor([1, 1, 0]), torch.tensor([0, 2, 2])
    goal = Positions(frames, joints, axes, torch.tensor([0.5, 0.4, 0.2]))
    bones = torch.tensor([[4, 6], [0, 0], [1, 1]])
    together = reach(x, two_joints, goal, bones, free, smoothness=1.0)
    for row in range(2):
        alone = reach(
            x[row : row + 1], two_joints, goal, bones, free[row : row + 1], smoothness=1.0
        )
        torch.testing.assert_close(together[row], alone[0])
        lengths = bone_lengths(two_joints(x[row]), [(0, 1)])[:, 0]
        moved = bone_lengths(two_joints(together[row]), [(0, 1)])[:, 0]
        assert moved[[4, 6]].tolist() == pytest.approx([lengths.median().item()] * 2, abs=0.006)
        # Features that may not change or do not act on joints keep their values in all frames
        assert torch.equal(together[row][~free[row]], x[row][~free[row]])
        assert torch.equal(together[row, :, 6], x[row, :, 6])


def test_frames_between_two_positions_have_lengths_between_their_own_and_the_median():
    """The bone has a median of 1 m; the frame between two positions is 1.5 m long."""
    x = torch.zeros(1, 7, 7)
    x[0, :, 3] = torch.tensor([1.0, 1.0, 1.0, 1.5, 1.0, 1.0, 1.0])
    free = torch.ones(1, 7, 7, dtype=torch.bool)
    frames, joint, axis = torch.tensor([2, 4]), torch.tensor([1, 1]), torch.tensor([1, 1])
    goal = Positions(frames, joint, axis, torch.tensor([0.1, 0.1]))
    bones = torch.tensor([[2, 4], [0, 0], [1, 1]])
    moved = reach(x, two_joints, goal, bones, free, smoothness=1.0)
    lengths = bone_lengths(two_joints(moved[0]), [(0, 1)])[:, 0]
    share = np.exp(-0.5)  # of the nearest position, not of both together
    assert lengths[3].item() == pytest.approx(share + (1 - share) * 1.5, abs=0.006)


def test_waypoints_joints_and_poses_are_reached(model, tmp_path):
    bow = flame_mdm.generate(model, "a person bows", seconds=2, num_inference_steps=10)[0]
    bow.save(tmp_path / "bow.npz")
    content = {
        "root": [{"time": 1, "position": [0.3, 0.4]}, {"time": 2, "position": [None, 1.2]}],
        "joints": [{"time": 1.5, "joint": "right_wrist", "position": [None, 1.3, None]}],
        "poses": [{"time": 2.4, "file": "bow.npz", "frame": 20}],
    }
    file = tmp_path / "targets.json"
    file.write_text(json.dumps(content))
    targets = read_targets(model.representation, file)
    assert len(targets.positions.values) == 2 + 1 + 1 + 1
    options: dict[str, Any] = {"seconds": 2.5, "num_inference_steps": 10}
    motion, plain = (
        flame_mdm.generate(model, TEXT, targets=source, **options)[0] for source in (file, None)
    )
    assert errors(motion, targets).max() < 0.03 < errors(plain, targets).max()
    local = slice(4, 4 + 21 * 3)
    np.testing.assert_allclose(motion.features[48, local], bow.features[20, local], atol=1e-5)
    arms = np.linalg.norm(motion.joints[:, 18:22] - motion.joints[:, 16:20], axis=-1)
    np.testing.assert_allclose(arms[30], np.median(arms, 0), rtol=0.05)
    targets = {"root": [{"time": t, "position": [0.1 * t, 0.3 * t]} for t in (1, 2, 3, 4)]}
    sequence = flame_mdm.generate(
        model, f"{TEXT} @2.4 | {TEXT} @2.4", targets=targets, num_inference_steps=10
    )[0]
    assert errors(sequence, read_targets(model.representation, targets)).max() < 0.05
    # a pose at a position faces its heading
    entry = {
        "time": 1.0,
        "file": str(tmp_path / "bow.npz"),
        "frame": 5,
        "position": [0.2, 0.5],
        "heading": 90,
    }
    pose = read_targets(model.representation, {"poses": [entry]}).positions.values.reshape(22, 3)
    assert pose[0, [0, 2]].tolist() == pytest.approx([0.2, 0.5])
    left = (pose[1] - pose[2] + pose[16] - pose[17]).numpy()
    assert np.degrees(np.arctan2(-left[2], left[0])) == pytest.approx(90, abs=1e-3)


def root_targets(frames: list[int], axis: int, values: list[float]) -> Targets:
    index = torch.tensor(frames)
    positions = Positions(index, 0 * index, torch.full_like(index, axis), torch.tensor(values))
    return Targets(positions, ((12, torch.zeros(3)), (40, torch.ones(3))))


@pytest.mark.parametrize("axis", [0, 2])
@pytest.mark.parametrize(
    ("begin", "frames", "expected"),
    [
        # From the target in the window, in 19 of the 40 frames to the next one
        (0, 30, [(10, 1.0), (29, 1 + 4 * 19 / 40)]),
        # From the position at the beginning, 2 m, whose frame is the last one before the window
        (20, 20, [(19, 2 + 3 * 20 / 31)]),
        # The last frame of the window has a target.
        (31, 20, [(19, 5.0)]),
        # One frame earlier, the target is after the window.
        (30, 20, [(19, 2 + 3 * 20 / 21)]),
        (60, 20, [(10, 9.0)]),
        (71, 20, []),
    ],
)
def test_a_window_ends_on_the_way_to_the_next_target(axis, begin, frames, expected):
    here = [2.0, -7.0] if axis == 0 else [-7.0, 2.0]
    window = root_targets([10, 50, 70], axis, [1.0, 5.0, 9.0]).window(begin, frames, here)
    positions = window.positions
    assert positions.frames.tolist() == [frame for frame, _ in expected]
    assert positions.values.tolist() == pytest.approx([value for _, value in expected])
    assert set(positions.axes.tolist()) <= {axis}
    poses = [frame - begin for frame in (12, 40) if begin <= frame < begin + frames]
    assert [frame for frame, _ in window.poses] == poses


def test_a_target_may_be_in_the_last_frame():
    targets = root_targets([10, 50, 70], 0, [1.0, 5.0, 9.0])
    targets.check_end(71, 20)
    with pytest.raises(UserError, match=r"3\.5 seconds is past the end .* is at 3\.45 seconds"):
        targets.check_end(70, 20)


@pytest.mark.parametrize(
    ("content", "refused"),
    [
        ({"joints": [(0.0, [None, 2.5, None])]}, None),
        ({"joints": [(0.0, [None, 2.51, None])]}, "2.51 m is out of reach"),
        ({"joints": [(0.0, [None, -0.1, None])]}, None),
        ({"joints": [(0.0, [None, -0.11, None])]}, "-0.11 m is out of reach"),
        # 8 m/s, and 2.5 m for the body
        ({"root": [(1.0, [0.0, 10.5])]}, None),
        ({"root": [(1.0, [0.0, 10.6])]}, "10.6 m from the start in 1 seconds is too far"),
        ({"root": [(1.0, [0.0, 10.0]), (1.5, [6.0, 12.4])]}, None),
        ({"root": [(1.0, [0.0, 10.0]), (1.5, [6.0, 12.6])]}, "6.5 m from .* in 0.5 seconds"),
        ({"root": [(1.0, [0.0, 1.0])] * 300}, None),
        (
            {"root": [(1.0, [0.0, 1.0])] * 300, "joints": [(1.0, [None, 1.0, None])]},
            "the targets have 601 coordinates. Use at most 600",
        ),
    ],
)
def test_targets_have_limits(model, content, refused):
    names = {"root": {}, "joints": {"joint": "head"}}
    listed = {
        kind: [{"time": time, "position": position} | names[kind] for time, position in entries]
        for kind, entries in content.items()
    }
    if refused is None:
        read_targets(model.representation, listed)
    else:
        with pytest.raises(UserError, match=refused):
            read_targets(model.representation, listed)


def test_the_distance_from_a_target_is_that_in_space_over_its_requested_coordinates(model):
    content = {
        "root": [{"time": 0.1, "position": [0.3, 0.4]}, {"time": 0.05, "position": [None, -0.2]}],
        "joints": [{"time": 0.1, "joint": "head", "position": [0.2, 0.3, 0.6]}],
    }
    targets = read_targets(model.representation, content)
    still = flame_mdm.Motion(np.zeros((3, 22, 3), np.float32), 20)
    np.testing.assert_allclose(errors(still, targets), [0.2, 0.5, 0.7], rtol=1e-6)


def test_poses_leave_the_root_free_and_bones_are_kept_where_a_joint_is_led(model, monkeypatch):
    representation = model.representation
    features = torch.randn(263)
    frames = torch.tensor([4, 9])
    positions = Positions(
        frames, torch.tensor([0, 20]), torch.tensor([0, 1]), torch.tensor([0.5, 1.2])
    )
    edit = Targets(positions, ((7, features),)).edit(representation, 12, CPU)
    of_root = representation.joint_features([0])
    assert edit.keep[0, 7].tolist() == (~of_root).tolist()
    assert edit.keep.sum() == (~of_root).sum()
    torch.testing.assert_close(edit.known[0, 7], representation.normalize(features))
    guide: Any = edit.guide
    assert guide.bones.T.tolist() == [[9, *edge] for edge in representation.skeleton.edges]
    # A correction fades over 0.2 seconds.
    smoothness = []
    monkeypatch.setattr(targets_module, "reach", lambda x, *rest: smoothness.append(rest[-1]) or x)
    replace(guide, fps=30.0).reach(torch.zeros(1, 12, 263))
    assert smoothness == [pytest.approx(6)]


def test_a_short_motion_reaches_its_targets_if_the_model_receives_padding():
    model = flame_mdm.load("quickstart")
    model.denoiser.mask_padding = False
    target = {"root": [{"time": 0.5, "position": [0.3, 0.4]}]}
    (motion,) = flame_mdm.generate(model, "a person walks forward", seconds=1, targets=target)
    assert len(motion.joints) == 20
    np.testing.assert_allclose(motion.joints[10, 0, [0, 2]], [0.3, 0.4], atol=0.02)


def test_bad_targets_give_one_clear_line(model, tmp_path, subtests):
    for content, message in (
        ([], r"the file is \[\], not a mapping; see docs/targets.md"),
        ({"roots": []}, "unknown key: roots. Did you mean root, joints"),
        ({"root": [{"time": "1", "position": [0, 1]}]}, 'root.0.time is "1", not a number'),
        ({"root": [{"time": 1, "position": [1]}]}, r"root.0.position is \[1\], not a longer list"),
        (
            {"root": [{"time": 1, "position": [0, 30]}]},
            "30.0 m from the start in 1 seconds is too far",
        ),
        (
            {"root": [{"time": 9, "position": [0, 1]}]},
            "9 seconds is past .* last frame is at 1.95 seconds",
        ),
        (
            {"joints": [{"time": 1, "joint": "left_rist", "position": [0, 1, 0]}]},
            "no joint 'left_rist'.*left_wrist",
        ),
        (
            {"joints": [{"time": 1, "joint": "head", "position": [0, 9, 0]}]},
            "height of 9 m is out of reach",
        ),
        ({"poses": [{"time": 1, "file": "no.npz"}]}, "no.npz"),
        ("{", r"t.json: .*; see docs/targets.md"),
    ):
        with subtests.test(message=message):
            (tmp_path / "t.json").write_text(content if content == "{" else json.dumps(content))
            with one_line_error(message):
                flame_mdm.generate(model, TEXT, seconds=2, targets=tmp_path / "t.json")


def test_the_command_prints_the_distance_and_bad_words_are_one_line(
    tmp_path, monkeypatch, capsys, subtests
):
    monkeypatch.chdir(tmp_path)
    words = [f"text={TEXT}", "samples=1", "seconds=2", "num_inference_steps=4"]
    assert main(["sample", "quickstart", *words, "path=0,0.5 0.5,0.5"]) == 0
    assert "distance from the targets: mean " in capsys.readouterr().out
    (tmp_path / "t.json").write_text("{}")
    for options, message in (
        ([], "nothing to sample. Set text="),
        (["text=walks", "unconditioned=true"], "text and unconditioned cannot be combined"),
        (["text=walks", "path=0,1 2"], "path=0,1 2: expected waypoints as x,z in meters"),
        (["text=walks", "path=0,1", "targets=t.json"], "path and targets cannot be combined"),
    ):
        with subtests.test(options=options, message=message):
            assert message in error_of(capsys, "sample", "quickstart", *options)


@pytest.mark.slow
def test_targets_that_the_text_does_not_suggest_do_not_stretch_bones(model):
    """Steering may not leave what the denoiser was trained on, and bones keep their lengths around a target."""
    target = {"joints": [{"time": 1.5, "joint": "right_wrist", "position": [-0.5, 1.5, 0.2]}]}
    options: dict[str, Any] = {"seconds": 3, "num_inference_steps": 20}
    motions = [
        flame_mdm.generate(model, "a person stands still", targets=t, seed=1, **options)
        for t in (None, target)
    ]
    before, after = (np.median(bones(motion), 0) for (motion,) in motions)
    assert np.abs(after / before - 1).max() < 0.05
    target = {"joints": [{"time": 1.5, "joint": "right_wrist", "position": [None, 1.4, None]}]}
    lengths = bones(flame_mdm.generate(model, TEXT, targets=target, **options)[0])
    # The difference is 0.6 if bone lengths are kept in the frame of the target alone.
    assert np.abs(lengths / np.median(lengths, 0) - 1).max() < 0.15


CAPTIONS = ["A person walks forward.", "a person waves with the left hand", "someone jumps"]


def test_a_vocabulary_holds_every_word_once_and_captions_only_if_they_may_be_shared(trained):
    facts = read_checkpoint(trained)["facts"]
    assert facts["vocabulary"] == sorted(
        {word for caption in facts["captions"] for word in vocabulary.words(caption)}
    )
    assert "walks" in facts["vocabulary"]
    kept = vocabulary.vocabulary([*CAPTIONS, *CAPTIONS])
    assert kept == {"vocabulary": sorted(set(" ".join(CAPTIONS).lower().replace(".", "").split()))}
    assert vocabulary.vocabulary(CAPTIONS, CAPTIONS)["captions"] == sorted(CAPTIONS)
    assert vocabulary.MAX_CAPTIONS == 1000
    many = [f"caption {number:05d}" for number in range(3 * vocabulary.MAX_CAPTIONS)]
    assert vocabulary.vocabulary(many, many)["captions"] == many[::3]
    assert vocabulary.vocabulary([], []) == {"vocabulary": [], "captions": []}


def test_unseen_and_unread_words_are_named_once_with_one_suggestion(subtests):
    facts = vocabulary.vocabulary(CAPTIONS, CAPTIONS)
    # The words are forms of walk, and function words.
    assert vocabulary.advice("A person WAVES, with the hand! They were walking", facts) == []
    (line,) = vocabulary.advice("a person dances the flamenco and dances with the left foot", facts)
    assert line == f"never seen in training: dances, flamenco, foot. Did you mean '{CAPTIONS[1]}'?"
    (line,) = vocabulary.advice("A person wakls forwrad.", facts)
    assert line == "never seen in training: wakls, forwrad. Did you mean 'a person walks forward.'?"
    (line,) = vocabulary.advice("a person walks happily", {"vocabulary": ["walks"]})
    assert line == "never seen in training: happily."
    text = "a person walks forward and then jumps"
    assert vocabulary.advice(text, {}, max_words=5) == [
        "only the first 5 words are read, not 'then jumps'"
    ]
    assert vocabulary.advice(text, {}, max_words=7) == []
    for text, first in (("walks", 0), ("jumps", 2), ("the left hand of a person", 1)):
        with subtests.test(text=text, first=first):
            assert vocabulary.nearest(text, CAPTIONS)[0] == CAPTIONS[first]


def test_a_text_without_a_known_word_is_refused(model, tmp_path, monkeypatch, capsys, subtests):
    monkeypatch.chdir(tmp_path)
    refusals = {
        "un uomo cammina in avanti": "only English prompts are supported",
        "人が歩く": "only English prompts are supported",
        "a person": "no word says what happens. Nearest in meaning",
    }
    for text, line in refusals.items():
        with subtests.test(text=text):
            with pytest.raises(UserError, match=line):
                flame_mdm.generate(model, text)
            vocabulary.check_known(text, {})  # models without a vocabulary read every word
    walk = flame_mdm.generate(model, TEXT, seconds=1, **FAST)[0]
    with pytest.raises(UserError, match="no word says what happens"):
        flame_mdm.edit(model, walk, text, region="prefix")
    assert "no word says what happens" in error_of(capsys, "sample", "quickstart", f"text={text}")
    assert list(tmp_path.iterdir()) == []


def test_captions_are_nearest_if_they_share_the_words_for_what_happens():
    both, one = "a person waves with both hands twice", "a person waves"
    captions = ["a person jumps", one, "cats", "a man with a red hat waves slowly", both, "twice"]
    text = "a person waves twice"
    assert vocabulary.nearest(text, captions) == [both, one, "twice"]
    assert vocabulary.nearest(text, captions, 9)[3:] == ["a man with a red hat waves slowly"]
    # Without such words, all words count
    assert vocabulary.nearest("the person", captions, 2) == ["a person jumps", one]


def test_plain_captions_are_about_a_person_and_short():
    captions = [
        "he sits",
        "a person walks fast",
        "a person sits",
        "a person jogs",
        "a personal walk",
    ]
    assert vocabulary.plainest(captions) == [
        "a person jogs",
        "a person sits",
        "a person walks fast",
        "he sits",
        "a personal walk",
    ]


def test_words_are_read_in_a_known_form_and_unknown_ones_are_dropped():
    forms = {"walks": "walked", "wave": "waving", "hop": "hopping", "ball": "balls", "sits": "sit"}
    assert {vocabulary.known_form(word, forms) for word in forms.values()} == set(forms)
    assert [vocabulary.known_form(word, forms) for word in ("string", "hip", "s", "walkie")] == [
        None
    ] * 4
    tokens = LearnedTokens(features=8, heads=1, buckets=64)
    every = tokens.rows("he walked moonily to the ball")
    tokens.seen = {*forms, "the", "he"}
    assert tokens.rows("he walked moonily to the balls") == tokens.rows("he walks the ball") == [
        every[0], every[1], vocabulary.hashed("walks", 64), every[5], every[6]
    ]  # fmt: skip


SENTENCES = {
    "walks forward. then he sits down. then he waves": ["walks forward", "he sits down", "he waves"],
    "walks forward, turns left and waves": ["walks forward", "turns left", "waves"],
    "First he walks forward. After that he quickly sits down; finally, he claps!":
        ["he walks forward", "he quickly sits down", "he claps"],
    "A man is walking forward and then turns left, and then a woman waves":
        ["A man is walking forward", "turns left", "a woman waves"],
    "raises both hands and waves": None, "bows forward and stands up again": None, "A woman is walking slowly.": None,
    "stands still, waving": None, "walks forward. Slowly, very slowly": None,
    "walks forward, head down": None, "Run!": None,
}  # fmt: skip


def test_sentences_of_several_actions_are_split_at_their_verbs(subtests):
    for text, parts in SENTENCES.items():
        with subtests.test(text=text, parts=parts):
            assert vocabulary.in_parts(text, Synthetic.verbs) == (parts or [text])
    assert vocabulary.in_parts("walks forward, turns left. Then waves", ()) == [
        "walks forward, turns left",
        "waves",
    ]
    assert vocabulary.in_parts("walks, then turns in limp style.", ()) == [
        "walks in limp style",
        "turns in limp style",
    ]


@pytest.mark.parametrize("heading", [None, 0.0, -90.0, 135.0])
def test_a_pose_is_turned_to_its_heading_about_its_root(model, heading, monkeypatch):
    """A pose that faces 30 degrees to the left and stands at (3, 1) is placed at a position."""
    still = np.asarray(Synthetic(clips=1).clip(0, 20.0).motion)[:1]
    turn = torch.tensor(math.radians(30.0) - facing(still[0]))
    joints = rotate_y(torch.from_numpy(still).double(), turn).numpy()
    joints[..., [0, 2]] += np.array([3.0, 1.0]) - joints[:, :1, [0, 2]]
    features = np.arange(263, dtype=np.float32)[None]
    monkeypatch.setattr(
        targets_module, "read_motion", lambda *_: Motion(joints, 20.0, features=features)
    )
    entry = {"time": 0.5, "file": "pose.npz", "position": [0.5, -0.25]}
    entry |= {} if heading is None else {"heading": heading}
    goal = read_targets(model.representation, {"poses": [entry]}).positions
    assert set(goal.frames.tolist()) == {10}
    pose = goal.values.reshape(22, 3).numpy()
    expected = 30.0 if heading is None else heading
    assert math.degrees(facing(pose)) == pytest.approx(expected, abs=1e-3)
    np.testing.assert_allclose(pose[0], [0.5, joints[0, 0, 1], -0.25], atol=1e-5)
    np.testing.assert_allclose(pose[:, 1], joints[0, :, 1], atol=1e-5)
    apart = [np.linalg.norm(x[:, None] - x[None], axis=-1) for x in (pose, joints[0])]
    np.testing.assert_allclose(*apart, atol=1e-5)
    free = read_targets(model.representation, {"poses": [entry | {"position": None}]})
    ((frame, kept),) = free.poses
    assert (frame, kept.tolist()) == (10, features[0].tolist())
    assert free.positions.axes.tolist() == [1]  # the height of the root
    assert float(free.positions.values[0]) == pytest.approx(joints[0, 0, 1], abs=1e-6)
    other = read_targets(model.representation, {"poses": [entry | {"position": [None, 2.0]}]})
    assert 0 not in other.positions.axes.tolist()


def facing(pose: np.ndarray) -> float:
    """The heading of a pose (22, 3) in radians, from its hips and shoulders."""
    left = pose[1] - pose[2] + pose[16] - pose[17]
    return math.atan2(-left[2], left[0])


@pytest.mark.parametrize(
    ("goals", "message"),
    [
        ([(1.0, 10.5), (2.0, 18.6)], None),
        ([(1.0, 10.5), (2.0, 21.1)], r"root\[1\]: 10.6 m from targets: root\[0\] in 1 seconds"),
        ([(2.0, 18.6), (1.0, 10.6)], r"root\[1\]: 10.6 m from the start in 1 seconds is too far"),
        ([(1.0, 0.0), (2.0, 10.5)], None),
        ([(0.0, 2.6)], r"root\[0\]: 2.6 m from the start in 0 seconds is too far"),
        ([(0.0, 2.5)], None),
    ],
)
def test_waypoints_require_eight_meters_per_second_at_most(model, goals, message):
    """The body reaches 2.5 m farther than it runs, from one waypoint to the next in time."""
    content = {"root": [{"time": time, "position": [0, z]} for time, z in goals]}
    if message is None:
        read = read_targets(model.representation, content)
        assert read.positions.values.tolist()[1::2] == pytest.approx([z for _, z in goals])
    else:
        with pytest.raises(UserError, match=message):
            read_targets(model.representation, content)


@pytest.mark.parametrize("fps", [20.0, 30.0])
def test_messages_about_lengths_are_in_seconds_of_the_model(fps: float):
    made: Any = SimpleNamespace(
        representation=SimpleNamespace(fps=fps),
        facts={"max_frames": 90},
        denoiser=SimpleNamespace(context_frames=0),
    )
    longest = {20.0: "4.5", 30.0: "3"}[fps]
    long = {20.0: "5", 30.0: "3.33333"}[fps]
    with pytest.raises(UserError) as error:
        part_frames(made, "a", [("a", None)], [100.0], is_sequence=False, loop=False)
    assert str(error.value) == (
        f"{long} seconds (100 frames) cannot be sampled: the model was trained on motions of up to "
        f"{longest} seconds. To generate a longer motion in overlapping windows, state the seconds "
        f"in the text: 'walks @{long}'"
    )
    shortest = (
        f"0.1 seconds is too short. Use at least {overlap(made) / fps:g} seconds, the overlap"
    )
    with pytest.raises(UserError, match=shortest):
        part_frames(made, "a", [("a", 0.1)], [None], is_sequence=True, loop=False)
    with pytest.raises(UserError, match=r"^'a \| b': 601 seconds is too long. Use at most 600 seconds"):  # fmt: skip
        part_frames(made, "a | b", [("a", 600), ("b", 1)], [None] * 2, is_sequence=True, loop=False)
    window = 90 - overlap(made)
    parts = [("a", 600 - 60 / fps), ("b", None)]
    lengths = part_frames(made, "", parts, [None, 60.0], is_sequence=True, loop=False)
    assert lengths == [600 * fps - 60, 60]
    alone = [("a", None)]
    three = min(90, 3 * fps)
    for loop, several, length in ((False, False, three), (True, False, min(3 * fps, window))):
        usual: list[float | None] = [None]
        assert part_frames(made, "", alone, usual, is_sequence=True, loop=loop) == [length], several


@pytest.mark.parametrize("mask_padding", [True, False])
def test_each_window_has_the_text_or_the_action_of_its_part(mask_padding: bool):
    made: Any = SimpleNamespace(
        representation=SimpleNamespace(fps=20.0),
        facts={"max_frames": 60, "actions": ["sit", "walk", "jump"]},
        denoiser=SimpleNamespace(context_frames=0, mask_padding=mask_padding),
        device=CPU,
    )
    names = [["walk", "sit"], ["jump"]]
    lengths = [[90, 20], [30]]
    for request in (SamplingRequest(actions=["a", "b"]), SamplingRequest(texts=["a", "b"])):
        covered = windows(made, request, names, lengths)
        expected = [
            (row, names[row][part], first, size)
            for row, parts in enumerate(lengths)
            for part, first, size in spans(parts, 60, overlap(made), False)
        ]
        labels = [name for _, name, _, _ in expected]
        assert [name for _, name, _, _ in expected].count("walk") > 1
        if request.kind == "action":
            assert covered.batch.text is None
            assert covered.batch.action is not None
            assert covered.batch.action.tolist() == [made.facts["actions"].index(x) for x in labels]
        else:
            assert covered.batch.text == labels
        sizes = [size for *_, size in expected]
        assert covered.batch.mask.sum(1).tolist() == sizes
        assert covered.batch.mask.shape[1] == (max(sizes) if mask_padding else 60)
