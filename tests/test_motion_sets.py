"""Sets of motions for game engines: clips whose ends fit together, feet that stay in place, files and descriptions."""

import json
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter1d
from support.motions import posed
from support.npm import node
from support.refusals import error_of
from support.usd import opened

import flame_mdm
from flame_mdm.__main__ import main
from flame_mdm.commands.sample import SampleSettings
from flame_mdm.data.synthetic import Attributes, example
from flame_mdm.errors import UserError
from flame_mdm.formats import fbx, fbx_scene, glb, glb_animation
from flame_mdm.formats.cleanup import bend
from flame_mdm.formats.gaits import (
    Clip,
    closed,
    find_cycle,
    gait,
    loop,
    moving,
    passing,
    progress,
    straightened,
    turn,
    with_neighbors,
)
from flame_mdm.formats.grounding import (
    FEET,
    GroundedMotion,
    _lack,
    _shift,
    anchored,
    grounded,
    jolt,
    pivot,
    planted,
    planted_toes,
    repeated,
    slide,
)
from flame_mdm.formats.motion import Motion
from flame_mdm.representations.skeleton import JOINT, SMPL22
from flame_mdm.safe_io import read_yaml
from flame_mdm.sampling import motion_sets
from flame_mdm.sampling.motion_sets import (
    SetMotion,
    make_set,
    read_set,
    rig_clips,
    write_set,
)
from flame_mdm.sampling.reading import decoded, with_features
from flame_mdm.visualize.body import mannequin

CENTIMETER = 0.01
SMALL = """
stand: Idle
fps: 30
candidates: 1
prefix: Hero_
motions:
  Idle: {kind: loop, text: a person stands, seconds: 2}
  Walk: {kind: gait, text: a person walks, seconds: 3}
  Turn: {kind: turn, text: a person turns, degrees: 90}
  Strafe: {kind: gait, text: a person walks, degrees: 90}
"""


ATTRIBUTES: dict[str, Attributes] = {
    "a person stands": {"action": "stand"},
    "a person walks": {"action": "walk", "direction": "forward", "speed": "fast"},
    "a person waves": {"action": "wave"},
    "a person turns": {"action": "turn", "direction": "left", "amount": "quarter"},
}


@cache
def synthetic(text: str) -> Motion:
    """A synthetic motion of three seconds."""
    return Motion(example(ATTRIBUTES[text]), 20.0, text=text, id=text)


@pytest.fixture(scope="module")
def walk() -> GroundedMotion:
    """A person who stands, walks forward, and stands."""
    return grounded(synthetic("a person walks").joints, 20)


@pytest.fixture(scope="module")
def parts(walk: GroundedMotion) -> list[GroundedMotion]:
    """Start, loop and stop of the walk; the person stands as in its first frame."""
    cycle = find_cycle(walk, 0)
    assert cycle is not None
    return gait(walk, cycle, 0, walk.local[0])


def test_a_motion_on_a_root_is_the_same_motion(walk: GroundedMotion):
    np.testing.assert_allclose(walk.world(), synthetic("a person walks").joints, atol=1e-6)
    cut = walk.cut(10, 30)
    np.testing.assert_allclose(cut.path[0], 0)
    assert cut.heading[0] == 0
    np.testing.assert_allclose(cut.local, walk.local[10:31])


def test_a_walk_becomes_a_start_a_loop_and_a_stop_that_fit_together(
    walk: GroundedMotion, parts: list[GroundedMotion], subtests
):
    start, loop, stop = parts
    np.testing.assert_array_equal(loop.local[-1], loop.local[0])
    np.testing.assert_allclose(start.local[-1], loop.local[0], atol=1e-5)
    np.testing.assert_allclose(stop.local[0], loop.local[0], atol=1e-5)
    np.testing.assert_allclose(start.local[0], walk.local[0], atol=1e-5)
    np.testing.assert_allclose(stop.local[-1], walk.local[0], atol=1e-5)
    # a straight path, at a constant speed in the loop
    for name, part in (("start", start), ("loop", loop), ("stop", stop)):
        with subtests.test(part=name):
            assert np.abs(part.path[:, 0]).max() < 1e-9
            assert np.abs(part.heading).max() == 0
            assert slide(part) < CENTIMETER
    steps = np.diff(loop.path[:, 1])
    np.testing.assert_allclose(steps, steps[0])
    assert 1.5 < steps[0] * 20 < 2


def test_no_joint_jumps_where_clips_meet(parts: list[GroundedMotion], subtests):
    start, loop, stop = parts
    steps = np.abs(np.diff(repeated(loop).world(), axis=0)).max()
    for before, after in ((start, loop), (loop, stop)):
        with subtests.test(before=before, after=after):
            move = after.local[1] - after.local[0]
            assert np.abs(move - (before.local[-1] - before.local[-2])).max() < steps


def test_a_gait_in_another_direction_is_not_taken(walk: GroundedMotion):
    assert find_cycle(walk, 90) is None
    assert find_cycle(walk, 180) is None
    assert find_cycle(grounded(synthetic("a person waves").joints, 20), 0) is None


def test_a_turn_has_exactly_the_angle_and_begins_and_ends_standing():
    source = synthetic("a person turns")
    motion = grounded(source.joints, 20)
    degrees = float(np.degrees(motion.heading[-1] - motion.heading[0]))
    wanted = 1.1 * degrees
    clip = turn(motion, wanted, motion.local[0])
    assert clip is not None
    assert np.degrees(clip.heading[-1]) == pytest.approx(wanted)
    np.testing.assert_allclose(clip.local[0], motion.local[0], atol=1e-9)
    np.testing.assert_allclose(clip.local[-1], motion.local[0], atol=1e-9)
    assert slide(clip) < CENTIMETER
    assert turn(motion, -wanted, motion.local[0]) is None
    assert turn(motion, 3 * degrees, motion.local[0]) is None


@pytest.mark.parametrize("at_end", [False, True])
def test_the_end_of_a_clip_takes_a_pose_and_fades_into_the_motion(at_end: bool):
    pose = posed().joints[0].astype(float)
    # Bones keep their lengths, so that a motion of the whole body shows the weights.
    motion = GroundedMotion(
        np.tile(pose, (9, 1, 1)), np.zeros((9, 2)), np.zeros(9), np.ones((9, 2), bool), 10.0
    )
    raised = pose + np.array([0, 0.1, 0])
    changed = anchored(motion, raised, 0.4, at_end=at_end).local - pose
    frames = np.arange(9)[:: -1 if at_end else 1]
    share = np.clip(1 - frames / 4, 0, 1)
    expected = 0.1 * (3 * share**2 - 2 * share**3)
    np.testing.assert_allclose(changed[:, 0, 1], expected, atol=1e-12)
    np.testing.assert_allclose(changed[..., [0, 2]], 0, atol=1e-12)
    # The change ends within a clip that is shorter than the time.
    short = anchored(motion, raised, 60.0, at_end=at_end).local - pose
    assert short[0 if at_end else -1, 0, 1] == 0
    assert short[4, 0, 1] == pytest.approx(0.05)


def test_progress_is_the_speed_along_a_direction_relative_to_the_heading():
    frames = np.arange(11)
    # A root that faces +x (90 degrees to the left) walks sideways, toward +z: to its right
    motion = GroundedMotion(
        np.zeros((11, 22, 3)),
        np.stack([0 * frames, 0.1 * frames], 1),
        np.full(11, np.pi / 2),
        np.ones((11, 2), bool),
        20.0,
    )
    for degrees, speeds in {0: (0, -2), 90: (-2, 0), -90: (2, 0), 180: (0, 2)}.items():
        along, aside = progress(motion, degrees)
        np.testing.assert_allclose(along, speeds[0], atol=1e-9)
        np.testing.assert_allclose(aside, speeds[1], atol=1e-9)


def test_toes_pass_the_root_at_the_time_between_two_frames():
    local, frames = np.zeros((11, 22, 3)), np.arange(11)
    local[:, JOINT["left_foot"], 2] = 0.35 - 0.1 * frames  # at 0 after 3.5 frames
    local[:, JOINT["right_foot"], 2] = 0.62 - 0.1 * frames
    contacts = np.ones((11, 2), bool)
    contacts[6:8, 1] = False  # in the air while it passes
    path = np.stack([0 * frames, 0.1 * frames], 1)
    motion = GroundedMotion(local, path, np.zeros(11), contacts, 10.0)
    assert passing(motion) == [pytest.approx(0.35), None]
    still = GroundedMotion(local, 0.05 * path, np.zeros(11), contacts, 10.0)
    assert passing(still) == [None, None]


def test_movement_is_cut_with_a_margin():
    joints = np.zeros((60, 22, 3))
    joints[:, JOINT["left_wrist"], 1] = 0.2 * np.clip(np.arange(60) - 20, 0, 10)  # at 4 m/s
    motion = GroundedMotion(joints, np.zeros((60, 2)), np.zeros(60), np.ones((60, 2), bool), 20.0)
    begin, end = moving(motion)  # frames 20 to 30 and, at each end, 0.15 s and the smoothing
    assert 13 <= begin <= 17
    assert (begin + end) / 2 == 25
    still = GroundedMotion(
        0 * joints, np.zeros((60, 2)), np.zeros(60), np.ones((60, 2), bool), 20.0
    )
    assert moving(still) == (0, 59)


def test_repetitions_of_a_loop_continue_in_the_direction_in_which_it_ends():
    # a quarter of a circle to the left with radius 2, in four steps
    angles = np.linspace(0, np.pi / 2, 5)
    path = 2 * np.stack([1 - np.cos(angles), np.sin(angles)], 1)
    local = np.zeros((5, 22, 3))
    local[:4, 0, 1] = np.arange(4)
    contacts = np.arange(10).reshape(5, 2) % 3 == 0
    circle = repeated(GroundedMotion(local, path, angles, contacts, 10.0), 4)
    whole = np.linspace(0, 2 * np.pi, 17)
    np.testing.assert_allclose(circle.heading, whole)
    np.testing.assert_allclose(
        circle.path, 2 * np.stack([1 - np.cos(whole), np.sin(whole)], 1), atol=1e-12
    )
    assert circle.local[:, 0, 1].tolist() == [*[0, 1, 2, 3] * 4, 0]
    np.testing.assert_array_equal(circle.contacts[4:8], contacts[:4])
    np.testing.assert_array_equal(circle.contacts[-1], contacts[-1])


def test_planted_feet_stay_where_a_fixed_pose_has_them(walk: GroundedMotion, subtests):
    """A root that moves 5 % farther would let the feet slide."""
    farther = GroundedMotion(walk.local, 1.05 * walk.path, walk.heading, walk.contacts, walk.fps)
    assert slide(farther) > 0.5 * CENTIMETER
    fixed = planted(farther, fixed_start=True, fixed_end=True)
    assert slide(fixed) < 0.2 * CENTIMETER
    for frame in (0, -1):
        with subtests.test(frame=frame):
            np.testing.assert_allclose(fixed.world()[frame], farther.world()[frame], atol=1e-5)


@pytest.mark.parametrize("at_end", [False, True])
def test_a_foot_that_lands_right_after_a_fixed_pose_does_not_jump(
    walk: GroundedMotion, at_end: bool
):
    local = np.tile(walk.local[:1], (20, 1, 1))
    # the right foot is in the air in the two frames next to the fixed pose, 5 cm from where it is
    # on average
    contacts = np.ones((20, 2), bool)
    contacts[slice(-2, None) if at_end else slice(None, 2), 1] = False
    drift = np.linspace(0.1, 0, 20)[:: -1 if at_end else 1]
    local[:, [JOINT["right_ankle"], JOINT["right_foot"]], 2] += drift[:, None]
    drifting = GroundedMotion(local, np.zeros((20, 2)), np.zeros(20), contacts, 30.0)
    fixed = planted(drifting, fixed_start=not at_end, fixed_end=at_end)
    assert slide(fixed) < 0.2 * CENTIMETER
    assert jolt(fixed) < 6


def test_toes_are_not_below_the_floor(walk: GroundedMotion):
    sunk = walk.local.copy()
    sunk[10:40, :, 1] -= 0.03
    motion = GroundedMotion(sunk, walk.path, walk.heading, walk.contacts, walk.fps)
    toes = [JOINT["left_foot"], JOINT["right_foot"]]
    assert motion.world()[:, toes, 1].min() < -CENTIMETER
    assert planted(motion).world()[:, toes, 1].min() > -0.001


@pytest.mark.parametrize("start", [0, 100, 165, 180, -170])
def test_a_planted_foot_that_turns_and_a_foot_that_jerks_are_measured(
    walk: GroundedMotion, start: float
):
    standing = walk.cut(0, 10)
    angles = np.radians(start + np.linspace(0, 30, len(standing)))
    turning = GroundedMotion(
        np.tile(standing.local[:1], (len(standing), 1, 1)),
        0 * standing.path,
        angles,
        np.ones_like(standing.contacts),
        10.0,
    )
    assert pivot(turning) == pytest.approx(30)
    local = np.tile(standing.local[:1], (len(standing), 1, 1))
    local[5, JOINT["left_foot"], 1] += 0.01
    jerking = GroundedMotion(local, 0 * turning.path, 0 * angles, turning.contacts, 10.0)
    # 1 cm up and down again: -2 cm per squared tenth of a second
    assert jolt(jerking) == pytest.approx(2)
    assert pivot(jerking) == 0


@pytest.fixture(scope="module")
def model() -> flame_mdm.MotionGenerator:
    return flame_mdm.load("quickstart")


@pytest.fixture(scope="module")
def small(model: flame_mdm.MotionGenerator, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a small set of synthetic motions, so that tests do not depend on what a model has learned."""

    def generate(
        model: flame_mdm.MotionGenerator, text: str, *, samples: int, **options: Any
    ) -> list[Motion]:
        return [with_features(model.representation, synthetic(text)) for _ in range(samples)]

    folder = tmp_path_factory.mktemp("small")
    (folder / "small.yaml").write_text(SMALL)
    content = read_set(str(folder / "small.yaml"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(motion_sets, "generate", generate)
        made = make_set(model, content)
    write_set(folder / "set", made, content, {"seed": 0}, mannequin())
    return folder / "set"


def described(folder: Path) -> dict[str, Any]:
    """The entries of `set.json` by name."""
    return {
        entry["name"]: entry for entry in json.loads((folder / "set.json").read_text())["clips"]
    }


def test_a_set_has_files_with_a_path_and_in_place_and_a_description(small: Path):
    clips = described(small)
    assert list(clips) == ["Idle", "Walk_Start", "Walk_Loop", "Walk_Stop", "Turn"]
    names = [f"Hero_{name}{end}.fbx" for name in clips for end in ("", "_InPlace")]
    assert sorted(path.name for path in small.iterdir()) == sorted(
        [*names, "player.html", "set.json", "set.png"]
    )
    content = json.loads((small / "set.json").read_text())
    assert "goes steadily in the direction of 90 degrees" in content["left_out"]["Strafe"]

    loop = clips["Walk_Loop"]
    assert loop["closure"]["meters"] < CENTIMETER
    assert loop["closure"]["degrees"] < 2
    moving, still = (
        fbx_scene.read(small / loop["files"][key]) for key in ("root_motion", "in_place")
    )
    assert len(still.positions) == len(moving.positions) == loop["frames"]
    root = moving.names.index("root")
    travel = moving.positions[-1, root] - moving.positions[0, root]
    np.testing.assert_allclose(travel, [loop["travel"][0], 0, loop["travel"][1]], atol=1e-4)
    np.testing.assert_allclose(still.positions[-1], still.positions[0], atol=1e-4)
    # in place is the same motion without the path
    bones = [number for number, name in enumerate(still.names) if name != "person"]
    shift = moving.positions[:, root : root + 1] - still.positions[:, root : root + 1]
    np.testing.assert_allclose(
        (moving.positions - shift)[:, bones], still.positions[:, bones], atol=1e-4
    )


def test_the_description_has_meters_seconds_and_degrees(monkeypatch):
    monkeypatch.setattr(motion_sets, "closure", lambda _: (0.0123456, 1.23456))
    path = np.array([[1.0, 2.0], [1.3, 2.4], [1.3, 2.4], [1.3, 2.9], [1.3, 3.0]])
    contacts = np.array([[True, False], [True, False], [False, True], [False, True], [False, True]])
    motion = GroundedMotion(
        np.zeros((5, 22, 3)), path, np.array([0.5, 1, 1, 1, 0.5 + np.pi / 2]), contacts, 30.0
    )
    entry = motion_sets._entry(Clip("Walk", "loop", motion, "walks"), None, {"in_place": "a"})  # type: ignore[arg-type]
    assert (entry["frames"], entry["seconds"]) == (5, round(4 / 30, 4))
    assert (entry["travel"], entry["turn"]) == ([0.3, 1.0], 90.0)
    assert entry["speed"] == [15.0, 3.0]  # 0.5 m and 0.1 m in a thirtieth of a second
    assert entry["closure"] == {"meters": 0.01235, "degrees": 1.235}
    assert entry["planted_at_start"] == {"left": True, "right": False}
    assert [(event["foot"], event["event"], event["frame"]) for event in entry["contacts"]] == [
        ("left", "lift", 2),
        ("right", "plant", 2),
    ]


def test_the_closure_of_a_loop_is_its_farthest_joint_and_its_largest_angle():
    turns = np.tile(np.eye(3), (4, 3, 1, 1))
    for joint, angle in ((1, 10), (2, -25)):
        c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
        turns[-1, joint] = turns[0, joint] @ [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    positions = np.zeros((4, 3, 3))
    positions[-1] = [[0.03, 0.0, 0.04], [0.0, 0.01, 0.0], [0.02, 0.02, 0.0]]
    clip: Any = SimpleNamespace(turns=turns, world=lambda: (positions, None))
    assert motion_sets.closure(clip) == pytest.approx((0.05, 25.0))


@pytest.mark.parametrize(
    ("values", "score"),
    [
        ({}, 0.0),
        ({"slide": [0.01, 0.03, 0.02]}, 200 * 0.03),
        ({"pivot": [1.0, 5.0, 2.0]}, 0.5),
        ({"jolt": [4.0, 1.0, 9.0]}, 0.9),
        ({"faulty": 7}, 3 * 7 * 0.2),
        ({"difference": 0.04}, 4.0),
        ({"slide": [0.01] * 3, "pivot": [1.0] * 3, "difference": 0.01}, 2 + 0.1 + 1),
    ],
)
def test_candidates_are_compared_by_poses_feet_and_faults(monkeypatch, values, score):
    """1 cm between poses counts as 0.5 cm of sliding, 10 degrees, 10 m/s² or 5 faulty frames."""
    cycle = SimpleNamespace(difference=values.get("difference", 0.0))
    monkeypatch.setattr(motion_sets.gaits, "find_cycle", lambda *_: cycle)
    monkeypatch.setattr(motion_sets.gaits, "gait", lambda *_: (0, 1, 2))
    for name in ("slide", "pivot", "jolt"):
        measured = values.get(name, [0.0] * 3)
        monkeypatch.setattr(motion_sets, name, lambda part, measured=measured: measured[part])
    fault = SimpleNamespace(start=3, end=3 + values.get("faulty", 0))
    monkeypatch.setattr(motion_sets, "find_faults", lambda _: [fault])
    monkeypatch.setattr(motion_sets, "motion_of", lambda clip: clip)
    walk: Any = SimpleNamespace(kind="gait", degrees=0.0, text="walks")
    version = motion_sets._clips("Walk", walk, None, np.zeros((0, 3)))  # type: ignore[arg-type]
    assert version is not None
    assert version[0] == pytest.approx(score)
    assert [(clip.name, clip.kind) for clip in version[1]] == [
        ("Walk_Start", "start"),
        ("Walk_Loop", "loop"),
        ("Walk_Stop", "stop"),
    ]


def test_the_best_candidate_is_kept_and_has_the_bones_of_the_standing_body(
    monkeypatch, walk: GroundedMotion
):
    content = motion_sets.MotionSet.model_validate(
        {
            "stand": "Idle",
            "candidates": 3,
            "motions": {
                "Walk": {"text": "walks", "kind": "gait"},
                "Idle": {"text": "stands", "kind": "loop"},
                "Turn": {"text": "turns", "kind": "turn", "degrees": 90.0},
            },
        }
    )
    sizes = {"stands": 1.1, "walks": 0.9, "turns": 0.9}
    scores = {"Idle": [5.0, 2.0, 3.0], "Walk": [4.0, 7.0, None], "Turn": [None] * 3}
    calls: list[Any] = []

    def takes(model: Any, motion: Any, content: Any, seed: int, options: Any) -> list[Any]:
        calls.append((motion.text, seed, options))
        return [replace(walk, local=sizes[motion.text] * walk.local) for _ in range(3)]

    def clips(name: str, motion: Any, take: GroundedMotion, stand: np.ndarray) -> Any:
        score = scores[name].pop(0)
        clip = Clip(f"{name} {score}", motion.kind, take, motion.text)
        return None if score is None else (score, [clip])

    monkeypatch.setattr(motion_sets, "_takes", takes)
    monkeypatch.setattr(motion_sets, "_clips", clips)
    model: Any = SimpleNamespace(representation=SimpleNamespace(skeleton=SMPL22))
    result = make_set(model, content, seed=7, guidance_scale=2.0)
    assert calls == [(text, 7, {"guidance_scale": 2.0}) for text in ("stands", "walks", "turns")]
    assert [clip.name for clip in result.clips] == ["Idle 2.0", "Walk 4.0"]
    assert result.left_out == {"Turn": "none of 3 motions for 'turns' turns by 90 degrees"}

    def lengths(joints: np.ndarray) -> np.ndarray:
        return np.linalg.norm(SMPL22.bones(torch.from_numpy(joints)).numpy(), axis=-1)

    np.testing.assert_allclose(
        lengths(result.clips[1].motion.local),
        np.tile(lengths(1.1 * walk.local[0]), (len(walk), 1)),
        atol=1e-6,
    )


@pytest.mark.parametrize(("kind", "frames"), [("loop", 3 * 40 + 1), ("gait", 40)])
def test_candidates_are_sampled_as_the_set_says_and_loops_are_three_times_as_long(
    monkeypatch, model: flame_mdm.MotionGenerator, kind: str, frames: int
):
    content = motion_sets.MotionSet.model_validate(
        {
            "stand": "Idle",
            "candidates": 2,
            "fps": 40.0,
            "motions": {"Idle": {"text": "stands", "kind": kind, "seconds": 2.0}},
        }
    )
    sampled = decoded(
        model.representation,
        torch.from_numpy(
            with_features(model.representation, synthetic("a person walks")).features[:40]
        ),
        "walks",
        "walk",
    )
    requested: list[Any] = []

    def generate(model: Any, text: str, **options: Any) -> list[Motion]:
        requested.append((text, options))
        return [sampled] * options["samples"]

    monkeypatch.setattr(motion_sets, "generate", generate)
    monkeypatch.setattr(motion_sets, "cleaned", lambda take, contacts: take)
    takes = motion_sets._takes(model, content.motions["Idle"], content, 3, {"eta": 0.5})
    expected = {"samples": 2, "seconds": 2.0, "seed": 3, "loop": kind == "loop", "split": False}
    assert requested == [("stands", {**expected, "eta": 0.5})]
    assert len(takes) == 2
    for take in takes:
        assert take.fps == 40
        # Twice the frame rate: one more frame between each pair of frames
        assert len(take) == 2 * (frames - 1) + 1
        period = 2 * 40
        if kind == "loop":
            heights = take.local[..., 1]
            np.testing.assert_allclose(
                heights[period + 8 : 2 * period], heights[8:period], atol=0.01
            )


def test_contacts_are_in_the_description_and_markers_in_the_files(small: Path, tmp_path: Path):
    start = described(small)["Walk_Start"]
    objects = fbx.read(small / start["files"]["root_motion"]).first("Objects")
    assert objects is not None
    curves = [
        node
        for node in objects.all("AnimationCurveNode")
        if "LeftFootContact" in node.properties[1]
    ]
    assert len(curves) == 1
    events = start["contacts"]
    assert {event["event"] for event in events} == {"plant", "lift"}
    assert [event["time"] for event in events] == sorted(event["time"] for event in events)
    assert all(event["time"] == pytest.approx(event["frame"] / 30, abs=1e-4) for event in events)
    assert start["planted_at_start"] == {"left": True, "right": True}

    motion = grounded(synthetic("a person walks").joints, 20)
    (clip,) = rig_clips([Clip("walk", "start", motion, "a walk")], "unreal")
    motion_sets.WRITERS["glb"](tmp_path / "walk.glb", clip)
    markers = glb.read(tmp_path / "walk.glb").document["animations"][0]["extras"]["markers"]
    assert {(marker["foot"], marker["event"]) for marker in markers} == {
        (foot, event) for foot in ("left", "right") for event in ("plant", "lift")
    }


def test_contacts_are_attributes_of_the_animation_in_usd_files(tmp_path: Path, subtests):
    motion = grounded(synthetic("a person walks").joints, 20)
    (clip,) = rig_clips([Clip("walk", "start", motion, "a walk")], "unreal")
    motion_sets.WRITERS["usdc"](tmp_path / "walk.usdc", clip)
    stage = opened(tmp_path / "walk.usdc")
    animation = stage.GetPrimAtPath("/person/skeleton/animation")
    for foot, name in enumerate(("LeftFootContact", "RightFootContact")):
        with subtests.test(name=name):
            contact = animation.GetAttribute(name)
            # booleans are held between samples
            values = [contact.Get(frame) for frame in range(len(motion))]
            assert values == motion.contacts[:, foot].tolist()
            changes = np.flatnonzero(np.diff(motion.contacts[:, foot])) + 1
            assert contact.GetTimeSamples() == [0, *changes.tolist()]
            assert len(changes) > 2


def test_a_rig_without_a_root_moves_its_hips(tmp_path: Path):
    motion = grounded(synthetic("a person turns").joints, 20)
    (clip,) = rig_clips([Clip("turn", "turn", motion, "")], "mixamo")
    across = []
    for name, variant in (("moving", clip.on_path(motion.path, motion.heading)), ("still", clip)):
        motion_sets.WRITERS["glb"](tmp_path / f"{name}.glb", variant)
        read = glb_animation.read(tmp_path / f"{name}.glb")
        left, right = (
            read.positions[:, read.names.index(f"mixamorig:{side}UpLeg")]
            for side in ("Left", "Right")
        )
        across.append(left - right)
        if name == "moving":
            middle = (left + right)[:, [0, 2]] / 2
            joints = motion.world()[:, [JOINT["left_hip"], JOINT["right_hip"]]].mean(1)
            np.testing.assert_allclose(middle, joints[:, [0, 2]], atol=1e-3)
    angles = [np.degrees(np.unwrap(np.arctan2(-bone[:, 2], bone[:, 0]))) for bone in across]
    np.testing.assert_allclose(angles[0] - angles[1], np.degrees(motion.heading), atol=0.1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"stand: Idle": "stand: Walk"}, "stand is Walk, which is not a loop"),
        ({", degrees: 90}\n  Strafe": "}\n  Strafe"}, "motions.Turn is a turn without degrees"),
        ({"fps: 30": "fps: 0"}, "fps is 0"),
        ({"fps: 30": "rate: 30"}, "unknown key: rate"),
        ({"prefix: Hero_": "prefix: ../up"}, 'prefix is "../up"'),
        ({"  Turn": "  ../Turn"}, "../Turn"),
        ({"fps: 30": "rig: unrael"}, "Did you mean unreal"),
        ({"{kind: loop, text: a person stands, seconds: 2}": "5"}, "motions.Idle is 5"),
        ({"{kind: loop, text: a person stands, seconds: 2}": "[a]"}, "motions.Idle is "),
    ],
)
def test_an_invalid_description_is_refused_in_one_line(
    change, message, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    text = SMALL
    for before, after in change.items():
        assert before in text
        text = text.replace(before, after)
    (tmp_path / "my.yaml").write_text(text)
    assert message in error_of(capsys, "sample", "quickstart", "set=my.yaml", "out=set")
    assert [path.name for path in tmp_path.iterdir()] == ["my.yaml"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["set=locomotoin"], "no such set. Did you mean locomotion?"),
        (
            ["set=locomotion", "text=a person walks"],
            "text=a person walks: a set determines which motions are sampled",
        ),
        (["set=locomotion", "samples=2"], "samples=2: a set determines which motions are sampled"),
        (
            ["set=locomotion", "out=walk.fbx"],
            "out=walk.fbx: a set consists of several files. Use a folder",
        ),
        (["set=locomotion", "format=bvh"], 'format is "bvh"'),
        (["text=a person walks", "format=fbx"], "format=fbx applies only to sets"),
    ],
)
def test_keys_that_do_not_fit_a_set_are_refused(
    words: Sequence[str], message: str, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    assert message in error_of(capsys, "sample", "quickstart", *words)
    assert list(tmp_path.iterdir()) == []


def test_sets_of_different_requests_are_written_to_different_folders(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    loaded = SimpleNamespace(model=flame_mdm.load("quickstart"), body=mannequin())
    monkeypatch.setattr(SampleSettings, "load", lambda settings: loaded)
    empty = SimpleNamespace(clips=[], left_out={})
    monkeypatch.setattr(motion_sets, "make_set", lambda *args, **options: empty)
    folders: list[Path] = []
    monkeypatch.setattr(motion_sets, "write_set", lambda folder, *args: folders.append(folder))
    changes = ("seed=1", "guidance_scale=2", "adapter=a", "adapter=b", "adapter_strength=0.5")
    for change in ("seed=0", *changes):
        assert main(["sample", "quickstart", "set=locomotion", change]) == 0
    assert len(set(folders)) == len(changes) + 1, folders
    assert main(["sample", "quickstart", "set=locomotion"]) == 0
    assert folders[-1] == folders[0], "the same request"


@pytest.fixture(scope="session")
def locomotion(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the package's set, by the package's model."""
    folder = tmp_path_factory.mktemp("locomotion") / "set"
    assert main(["sample", "quickstart", "set=locomotion", f"out={folder}"]) == 0
    return folder


@pytest.fixture(scope="session")
def some(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of one motion of each kind of the package's set, by the package's model."""
    folder = tmp_path_factory.mktemp("some")
    content = read_yaml(motion_sets.SETS / "locomotion.yaml")
    kinds = ("Idle", "Walk_Fwd", "Strafe_Left", "Turn_90_Right")
    content["motions"] = {name: content["motions"][name] for name in kinds}
    (folder / "some.yaml").write_text(json.dumps(content))
    words = [f"set={folder / 'some.yaml'}", f"out={folder / 'set'}"]
    assert main(["sample", "quickstart", *words]) == 0
    return folder / "set"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "count"), [("some", 8), pytest.param("locomotion", 20, marks=pytest.mark.robustness)]
)
def test_the_locomotion_set_of_the_package_closes_its_loops_and_plants_its_feet(
    name: str, count: int, request: pytest.FixtureRequest, subtests
):
    locomotion: Path = request.getfixturevalue(name)
    clips = described(locomotion)
    assert json.loads((locomotion / "set.json").read_text())["left_out"] == {}
    assert len(clips) == count
    stand = fbx_scene.read(locomotion / clips["Idle"]["files"]["in_place"])
    for name, entry in clips.items():
        with subtests.test(name=name):
            moving, still = (
                fbx_scene.read(locomotion / entry["files"][key])
                for key in ("root_motion", "in_place")
            )
            bones = [number for number, bone in enumerate(still.names) if bone != "person"]
            if entry["kind"] == "loop":
                closes = np.abs(still.positions[-1] - still.positions[0])[bones].max()
                assert closes < CENTIMETER, name
                assert entry["closure"]["degrees"] < 2, name
            if entry["kind"] in ("start", "turn"):
                assert np.abs(still.positions[0] - stand.positions[0])[bones].max() < CENTIMETER, (
                    name
                )
            if entry["kind"] in ("stop", "turn"):
                assert np.abs(still.positions[-1] - stand.positions[0])[bones].max() < CENTIMETER, (
                    name
                )
            if entry["kind"] == "turn":
                requested = int(name.split("_")[1]) * (1 if name.endswith("Left") else -1)
                assert entry["turn"] == requested, name
            for foot, bone in (("left", "ball_l"), ("right", "ball_r")):
                toe = moving.positions[:, moving.names.index(bone)][:, [0, 2]]
                for first, last in contacts(entry, foot):
                    moved = np.linalg.norm(toe[first : last + 1] - toe[first], axis=1).max()
                    assert moved < CENTIMETER, (name, foot, first)


def contacts(entry: dict[str, Any], foot: str) -> list[tuple[int, int]]:
    """First and last frame of each contact of a foot."""
    begin = 0 if entry["planted_at_start"][foot] else None
    spans = []
    for event in entry["contacts"]:
        if event["foot"] != foot:
            continue
        if event["event"] == "plant":
            begin = event["frame"]
        elif begin is not None:
            spans.append((begin, event["frame"] - 1))
            begin = None
    return [*spans, (begin, entry["frames"] - 1)] if begin is not None else spans


@pytest.mark.tools
@pytest.mark.slow
def test_in_three_the_clips_blend_without_sliding_feet(
    locomotion: Path, node_modules: Path, subtests
):
    """Stands, starts to walk, walks, runs, stops: a foot that all blended clips have on the floor hardly moves."""
    clips = described(locomotion)
    fps = json.loads((locomotion / "set.json").read_text())["fps"]
    scene = node("three_set.mjs", node_modules, locomotion)
    for foot, name in enumerate(("left", "right")):
        with subtests.test(foot=foot, name=name):
            footprint = None
            for frame in scene["frames"]:
                shown = [
                    (clips[item["name"]], round(item["time"] * fps)) for item in frame["playing"]
                ]
                stands = all(
                    any(first <= time <= last for first, last in contacts(entry, name))
                    for entry, time in shown
                )
                toe = np.array(frame["toes"][foot])[[0, 2]]
                footprint = (toe if footprint is None else footprint) if stands else None
                if footprint is not None:
                    assert np.linalg.norm(toe - footprint) < 3 * CENTIMETER, (
                        name,
                        frame["playing"],
                    )
    assert 4 < scene["place"][2] < 12


def test_a_toe_is_planted_if_it_is_slow_before_or_after_a_frame():
    joints = np.zeros((60, 22, 3))
    stands = np.arange(60)
    # The left toe stands from frame 20 to frame 39, and moves at 2 m/s before and after.
    joints[:, 10, 2] = 0.1 * np.where(stands < 20, stands - 20, np.maximum(stands - 39, 0))
    planted = planted_toes(joints, 20.0)
    assert np.flatnonzero(planted[:, 0]).tolist() == list(range(20, 40))
    assert planted[:, 1].all()


def moving_body(world: np.ndarray, contacts: np.ndarray, fps: float = 30.0) -> GroundedMotion:
    """A motion on a root that stays at the origin."""
    count = len(world)
    return GroundedMotion(world, np.zeros((count, 2)), np.zeros(count), contacts, fps)


def test_a_foot_in_the_air_is_not_planted_and_short_contacts_and_gaps_are_ignored():
    joints = np.zeros((120, 22, 3))
    left, right = JOINT["left_foot"], JOINT["right_foot"]
    joints[:, right, 1] = 0.3
    joints[40:43, left, 1] = 0.2  # 0.05 s at 60 fps
    joints[80:, left, 1] = 0.2
    joints[100:103, left, 1] = 0.0
    planted = planted_toes(joints, 60.0)
    assert not planted[:, 1].any()
    assert np.flatnonzero(planted[:, 0]).tolist() == list(range(80))


@pytest.mark.parametrize(
    ("hip", "shift", "expected"),
    [
        (0.7, 0.0, 0.0),
        (0.79, 0.3, 0.79 - np.sqrt((0.999 * 0.8) ** 2 - 0.09)),
        (0.6, 0.3, 0.0),  # low enough
        (0.85, 0.0, 0.0),  # the leg is longer than its bones already
        (0.85, 0.3, 0.85 - np.sqrt(0.85**2 - 0.09)),
    ],
)
def test_hips_are_lowered_until_the_leg_reaches_the_footprint(
    hip: float, shift: float, expected: float
):
    world = np.zeros((1, 4, 3))
    knee = np.sqrt(0.4**2 - (min(hip, 0.8) / 2) ** 2)
    world[0] = [[0, hip, 0], [0, hip / 2, knee], [0, 0, 0], [0, 0, 0.1]]
    if hip > 0.8:
        world[0, 1] = [0, hip - 0.4, 0]
    lack = _lack(world, (0, 1, 2, 3), np.array([[shift, 0, 0]]))
    length = np.linalg.norm(world[0, 1] - world[0, 0]) + np.linalg.norm(world[0, 1])
    if hip <= 0.8:
        assert length == pytest.approx(0.8)
    assert lack[0] == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("at_end", [False, True])
def test_a_lowered_body_keeps_its_feet_at_their_height_and_a_fixed_pose_unchanged(at_end: bool):
    pose = posed(1, left_knee=(2, 0, 0), right_knee=(2, 0, 0)).joints[0].astype(float)
    world = np.tile(pose, (12, 1, 1))
    away = np.linspace(0, 0.35, 12)[:: 1 if at_end else -1]
    lower = 0.15 * away / 0.35  # the knees bend while the left foot is far away
    world[..., 1] -= lower[:, None]
    for leg, distance in zip(FEET, (away, 0 * away), strict=True):
        bend(world, leg, np.stack([distance, lower, 0 * away], 1))
    motion = moving_body(world, np.ones((12, 2), bool))
    fixed = planted(motion, fixed_start=not at_end, fixed_end=at_end).world()
    frame = -1 if at_end else 0
    np.testing.assert_allclose(fixed[frame], world[frame], atol=1e-6)
    lowered = (world - fixed)[:, 0, 1]
    assert lowered[0 if at_end else -1] > 0.05  # otherwise, the leg would be too short
    toes = fixed[:, JOINT["left_foot"]]
    np.testing.assert_allclose(toes[:, 1], world[:, JOINT["left_foot"], 1], atol=2e-3)
    np.testing.assert_allclose(toes[:, 0], toes[frame, 0], atol=2e-3)


def test_toes_of_a_fixed_pose_stay_as_low_as_they_are():
    world = np.tile(posed(1).joints[0].astype(float), (8, 1, 1))
    world[..., 1] -= world[..., 1].min() + np.linspace(0.0, 0.03, 8)[:, None]
    motion = moving_body(world, np.zeros((8, 2), bool))
    fixed = planted(motion, fixed_end=True).world()
    np.testing.assert_allclose(fixed[-1], world[-1], atol=1e-6)
    free = planted(motion).world()
    assert free[-1, JOINT["left_foot"], 1] == pytest.approx(0, abs=1e-3)


def test_the_shift_of_a_planted_toe_is_horizontal():
    toe = np.zeros((9, 3))
    toe[:, 0] = np.linspace(0, 0.08, 9)
    toe[:, 1] = np.linspace(0, 0.03, 9)
    flags = np.zeros(9, bool)
    flags[2:7] = True
    shift = _shift(toe, flags, False, False, 3)
    np.testing.assert_array_equal(shift[:, 1], 0)
    np.testing.assert_allclose((toe + shift)[2:7, 0], toe[2:7, 0].mean())
    np.testing.assert_allclose(shift[[0, 8]], shift[[2, 6]])  # held before and after the contact


def test_a_foot_slides_as_far_as_it_is_from_where_it_was_planted():
    world = np.zeros((5, 22, 3))
    world[:, JOINT["left_foot"], 0] = [0.5, 0, 0.1, 0.04, 0.5]
    world[:, JOINT["left_foot"], 1] = [0, 0, 9, 0, 0]  # heights do not count
    contacts = np.zeros((5, 2), bool)
    contacts[1:4, 0] = True
    assert slide(moving_body(world, contacts)) == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("degrees", "is_taken"), [(0, True), (30, True), (-30, True), (45, False), (-45, False)]
)
def test_a_gait_may_differ_by_35_degrees_and_begins_with_a_landing_of_the_left_foot(
    walk: GroundedMotion, degrees: float, is_taken: bool
):
    cycle = find_cycle(walk, degrees)
    assert (cycle is not None) == is_taken
    if cycle is not None:
        landed = walk.contacts[cycle.first, 0] and not walk.contacts[cycle.first - 1, 0]
        assert landed
        assert 0.5 <= (cycle.last - cycle.first) / walk.fps <= 1.8


def test_a_straightened_path_is_as_long_as_the_way_in_the_direction():
    times = np.arange(21) / 20
    # The root faces +x and accelerates to its left, which is -z, to 2 m/s.
    motion = GroundedMotion(
        np.zeros((21, 22, 3)),
        np.stack([0.3 * times, -(times**2)], 1),
        np.full(21, np.pi / 2),
        np.ones((21, 2), bool),
        20.0,
    )
    straight = straightened(motion, 90)
    np.testing.assert_allclose(straight.path[:, 0], times**2, atol=0.005)
    np.testing.assert_allclose(straight.path[:, 1], 0, atol=1e-12)
    assert not straight.heading.any()


def test_a_closed_cycle_spreads_the_difference_of_its_ends_around_its_middle():
    local = np.tile(posed(1).joints[0].astype(float), (5, 1, 1))
    local[..., 1] += np.linspace(0, 0.1, 5)[:, None]
    contacts = np.arange(10).reshape(5, 2) % 3 == 0
    cycle = closed(moving_body(local, contacts))
    np.testing.assert_allclose(cycle.local, np.tile(local[2], (5, 1, 1)), atol=1e-12)
    np.testing.assert_array_equal(cycle.contacts[-1], contacts[0])
    np.testing.assert_array_equal(cycle.contacts[:-1], contacts[:-1])


@pytest.mark.parametrize(
    ("meters", "degrees", "is_kept"),
    [(1.5, 0, True), (0, 90, True), (0.2, 24, False)],
)
def test_a_loop_travels_and_turns_at_a_constant_rate_or_stays(
    meters: float, degrees: float, is_kept: bool
):
    frames = np.arange(61)
    motion = GroundedMotion(
        np.tile(posed(1).joints[0].astype(float), (61, 1, 1)),
        np.stack([0 * frames, meters * frames / 60], 1),
        np.radians(degrees) * frames / 60,
        np.ones((61, 2), bool),
        20.0,
    )
    middle = loop(motion)
    share = np.linspace(0, 1 / 3, 21) if is_kept else np.zeros(21)
    np.testing.assert_allclose(middle.path[:, 1], share * meters, atol=1e-9)
    np.testing.assert_allclose(np.degrees(middle.heading), share * degrees, atol=1e-9)


def test_clips_have_neighbors_so_that_filters_do_not_mix_them():
    def of(heights: list[float]) -> GroundedMotion:
        local = np.zeros((len(heights), 22, 3))
        local[:, 0, 1] = heights
        return moving_body(local, np.ones((len(heights), 2), bool))

    clips = [Clip("a", "start", of([1, 2, 3]), ""), Clip("b", "loop", of([5, 6, 7, 5]), "")]
    joints, slices = with_neighbors(clips, 4)
    first = [1, 1, 1, 1, 1, 2, 3, 3, 3, 3, 3]
    second = [7, 5, 6, 7, 5, 6, 7, 5, 6, 7, 5, 6]
    assert joints[:, 0, 1].tolist() == first + second
    assert [joints[part, 0, 1].tolist() for part in slices] == [[1, 2, 3], [5, 6, 7, 5]]


@pytest.mark.parametrize("fps", [20.0, 60.0])
def test_a_planted_toe_is_slower_than_a_quarter_meter_per_second_and_lower_than_5_centimeters(
    fps: float,
):
    left, right = JOINT["left_foot"], JOINT["right_foot"]
    for speed, height, is_planted in (
        (0.24, 0.0, True),
        (0.26, 0.0, False),
        (0.0, 0.049, True),
        (0.0, 0.051, False),
    ):
        joints = np.zeros((90, 22, 3))
        joints[:, left, 0] = speed / fps * np.arange(90)
        joints[:, left, 1] = height
        contacts = planted_toes(joints + np.array([0, 0.3, 0]), fps)  # the floor is at 0.3 m
        assert contacts[:, 0].all() == contacts[:, 0].any() == is_planted, (speed, height)
        assert contacts[:, 1].all()
    # contacts and gaps of a tenth of a second count
    for frames in (round(0.1 * fps) - 1, round(0.1 * fps)):
        joints = np.zeros((90, 22, 3))
        joints[40:, right, 1] = 0.2
        joints[60 : 60 + frames, right, 1] = 0.0
        joints[20 : 20 + frames, left, 1] = 0.2
        long_enough = frames >= 0.1 * fps
        contacts = planted_toes(joints, fps)
        assert contacts[60 : 60 + frames, 1].all() == contacts[60, 1] == long_enough
        assert contacts[20 : 20 + frames, 0].any() != long_enough


@pytest.mark.parametrize("fps", [20.0, 30.0, 60.0])
def test_the_root_is_below_the_pelvis_and_faces_ahead_smoothed_over_seconds(fps: float):
    rng = np.random.default_rng(0)
    headings = np.linspace(0, 9, 80) + np.repeat([0, 0.4], 40)  # more than a whole turn to the left
    pelvis = np.array([1, 0.955, 2]) + rng.normal(0, 0.01, (80, 3)).cumsum(0)
    motion = grounded(posed(80, heading=headings, root=pelvis).joints, fps)
    smooth = {"sigma": 0.15 * fps, "axis": 0, "mode": "nearest"}
    np.testing.assert_allclose(motion.heading, gaussian_filter1d(headings, **smooth), atol=1e-4)
    path = gaussian_filter1d(pelvis[:, [0, 2]], **smooth)
    np.testing.assert_allclose(motion.path, path, atol=1e-5)


@pytest.mark.parametrize(
    ("ratio", "is_taken"), [(0.58, False), (0.62, True), (1.55, True), (1.65, False)]
)
def test_a_turn_may_be_smaller_or_larger_than_requested_within_limits(ratio, is_taken):
    motion = grounded(synthetic("a person turns").joints, 20)
    begin, end = moving(motion)
    angle = np.degrees(motion.heading[end] - motion.heading[begin])
    assert angle > 45  # to the left
    clip = turn(motion, angle / ratio, motion.local[0])
    assert (clip is not None) == is_taken


def test_the_cycle_of_a_gait_is_the_pair_of_frames_that_differ_least(walk: GroundedMotion):
    """From a landing of the left foot, 0.5 to 1.8 s long, at a steady speed."""
    fps, poses, stands = walk.fps, walk.local, walk.contacts[:, 0]
    along, _ = progress(walk, 0)
    even = gaussian_filter1d(along, 0.2 * fps, mode="nearest")
    steady = even > 0.85 * np.percentile(even, 90)
    begin, end = moving(walk)
    speeds = np.gradient(poses, axis=0) * fps
    differences = {}
    for first in range(begin + round(0.5 * fps), end - round(0.5 * fps) + 1):
        for last in range(first + round(0.5 * fps), first + round(1.8 * fps) + 1):
            lands = stands[first] and not stands[first - 1]
            if lands and last <= end - round(0.5 * fps) and steady[first : last + 1].all():
                apart = np.linalg.norm(poses[first] - poses[last], axis=1).mean()
                changed = np.linalg.norm(speeds[first] - speeds[last], axis=1).mean()
                changed += abs(even[first] - even[last])
                differences[first, last] = apart + 0.1 * changed
    assert len(differences) > 5
    cycle = find_cycle(walk, 0)
    assert cycle is not None
    assert (cycle.first, cycle.last) == min(differences, key=lambda pair: differences[pair])
    assert cycle.difference == pytest.approx(min(differences.values()))


def test_a_set_that_states_motions_alone_has_the_documented_values(tmp_path):
    path = tmp_path / "my.yaml"
    path.write_text("stand: Idle\nmotions:\n  Idle: {kind: loop, text: stands}\n")
    content = read_set(str(path))
    assert content.model_dump() == {
        "stand": "Idle",
        "motions": {"Idle": {"text": "stands", "kind": "loop", "seconds": None, "degrees": 0.0}},
        "prefix": "",
        "format": "fbx",
        "rig": "unreal",
        "fps": 30.0,
        "candidates": 8,
    }
    other = motion_sets.changed(content, fps=60.0, rig=None, format="glb")
    assert (other.fps, other.rig, other.format, other.candidates) == (60.0, None, "glb", 8)
    assert other.motions == content.motions
    for values, message in (
        ({"fps": 240.1}, "set: fps is 240.1"),
        ({"fps": 9.9}, "set: fps is 9.9"),
        ({"rig": "unty"}, "rig=unty: unknown. Did you mean unity?"),
    ):
        with pytest.raises(UserError) as error:
            motion_sets.changed(content, **values)
        assert str(error.value).startswith(message)
    assert motion_sets.changed(content, fps=240.0).fps == 240
    assert motion_sets.changed(content, fps=10.0).fps == 10


def test_a_motion_that_no_candidate_shows_is_left_out_with_its_direction_or_angle():
    gait_, turn_ = (SetMotion(text="a", kind=kind, degrees=-45.5) for kind in ("gait", "turn"))
    assert motion_sets._missing(gait_) == "goes steadily in the direction of -45.5 degrees"
    assert motion_sets._missing(turn_) == "turns by -45.5 degrees"
