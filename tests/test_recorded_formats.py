"""Values of motions that are checked, cleaned up, cut, fitted and drawn, as recorded."""

from collections import Counter
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from support.motions import posed, sway
from support.recorded import Case, bodies, cases_of, check, outcome, record, some_bodies
from support.traits import traits

from flame_mdm.formats import (
    body,
    checks,
    cleanup,
    conversion,
    faults,
    gaits,
    grounding,
    layouts,
    poses,
    posture,
    resampling,
    retarget,
    rig,
    rigged,
)
from flame_mdm.formats.motion import Motion, motion_of_poses
from flame_mdm.representations.motion272 import Motion272
from flame_mdm.representations.rifke import Rifke
from flame_mdm.representations.rot6d import Rot6D
from flame_mdm.representations.skeleton import KIT21, SKELETONS, SMPL22
from flame_mdm.representations.smpl import ADULT, SMPL
from flame_mdm.visualize.body import mannequin

NAME = "formats"
RATES = (12.5, 20.0, 30.0, 59.94)
AXES = {"x": [1.0, 0, 0], "y": [0, 1.0, 0], "z": [0, 0, 1.0]}


def spoiled(joints: np.ndarray, kind: str, seed: int = 0) -> np.ndarray:
    """A body with a fault."""
    rng = np.random.default_rng(seed)
    out, frames = joints.copy(), len(joints)
    if kind == "pops":
        for joint in rng.permutation(22)[:5]:
            out[int(rng.integers(1, frames - 1)), joint] += rng.normal(0, 0.3, 3)
    elif kind == "stretched":
        out *= 1 + 0.15 * np.sin(np.arange(frames) / 7)[:, None, None]
    elif kind == "sunk":
        out[..., 1] -= rng.uniform(0.03, 0.2)
    elif kind == "sliding":
        out += np.linspace(0, 1, frames)[:, None, None] * [2.1, 0, -1.3]
    elif kind == "high":
        out[frames // 3 :, :, 1] += 0.3
    elif kind == "frozen":
        out[frames // 4 :] = out[frames // 4]
    elif kind == "hands inside":
        for side, share in (("left", 1.0), ("right", 0.7)):
            hand = SMPL22.joints.index(f"{side}_wrist")
            out[5:25, hand] += share * (out[5:25, 6] - out[5:25, hand])
    elif kind == "knees":
        knee = SMPL22.joints.index("left_knee" if seed % 2 else "right_knee")
        out[8:20, knee] += [0, 0.05, -0.25]
        out[4:9, 20] = out[4:9, 16] + [0.03, 0.01, 0.02]
    elif kind == "fast":
        out[frames // 2 :] += [1.5, 0, 0.4]
        out[10:14, 8] += [0.2, 1.4, 0.3]
    return out


KINDS = (
    "none",
    "pops",
    "stretched",
    "sunk",
    "sliding",
    "high",
    "frozen",
    "hands inside",
    "knees",
    "fast",
)


@cache
def spoiled_bodies(count: int, fps: float, seed: int = 0) -> dict[str, np.ndarray]:
    return {
        f"{name}, {KINDS[number % len(KINDS)]}": spoiled(joints, KINDS[number % len(KINDS)], number)
        for number, (name, joints) in enumerate(some_bodies(count, fps, seed).items())
    }


def cleanups_of_spoiled_bodies() -> Any:
    return {
        f"{name} {fps}": [traits(cleanup.cleanup(joints, fps, SMPL22) - joints), traits(joints)]
        for fps, count in ((20.0, 20), (30.0, 8), (12.5, 6))
        for name, joints in spoiled_bodies(count, fps, 3).items()
    }


def cleanups_with_contacts_and_skeletons() -> Any:
    rng = np.random.default_rng(4)
    results: dict[str, Any] = {}
    for name, joints in spoiled_bodies(6, 20.0, 8).items():
        contacts = rng.uniform(0, 1, (len(joints), 4))
        results[name] = traits(cleanup.cleanup(joints, 20.0, SMPL22, contacts) - joints)
        hands = joints[:, 20:22] + 0.4 * (joints[:, 20:22] - joints[:, 18:20])
        both = np.concatenate([joints, hands], 1)
        results[name + " hands"] = traits(cleanup.cleanup(both, 20, SKELETONS["smpl24"]) - both)
        kit = conversion.kit_joints(joints)
        results[name + " kit"] = traits(cleanup.cleanup(kit, 20, KIT21, contacts[:, :4]) - kit)
    motion = sway(12, contacts=True, text="a text", id="an id")
    results["cleaned"] = [repr(cleanup.cleaned(motion)), vars(cleanup.cleaned(motion))]
    for frames in (1, 3, 4, 5):
        short = cleanup.cleanup(joints[:frames], 20.0, SMPL22)
        results[f"{frames} frames"] = [str(short.dtype), traits(short)]
    return results


def steps_of_cleanup() -> Any:
    rng = np.random.default_rng(6)
    results: dict[str, Any] = {}
    for name, joints in spoiled_bodies(6, 20.0, 12).items():
        toes = joints[:, [10, 11]]
        shift = np.array([0.0, 0.1, -0.2]) + rng.normal(0, 0.1, (len(joints), 3))
        legs = {str(leg): joints.copy() for leg in ((1, 4, 7, 10), (17, 19, 21), (5, 2, 8))}
        for leg, moved in zip(((1, 4, 7, 10), (17, 19, 21), (5, 2, 8)), legs.values(), strict=True):
            cleanup.bend(moved, leg, shift)
        lifted, pushed, kept = joints.copy(), joints.copy(), joints.copy()
        cleanup._lift(lifted, (2, 5, 8, 11), 0.12)
        cleanup._push_out(pushed, SMPL22, "left", 30.0)
        cleanup._push_out(pushed, SMPL22, "right", 12.5)
        bones = cleanup._constant_bones(joints, SMPL22)
        cleanup._keep_heights(kept, joints + [0, 0.05, 0] * rng.uniform(-1, 1, (22, 1)), SMPL22)
        results[name] = [
            {leg: traits(moved - joints) for leg, moved in legs.items()},
            traits(lifted - joints),
            traits(pushed - joints),
            traits(kept - joints),
            traits(bones - joints),
            traits(cleanup._smooth(joints) - joints),
            *(
                traits(cleanup._contacts(toes, joints[:, 0], fps, share))
                for fps, share in ((20.0, 0.4), (30.0, 0.5), (5.0, 0.5))
            ),
            *(traits(cleanup._follow_feet(joints, [10, 11], fps) - joints) for fps in (20.0, 8.0)),
        ]
    for frames, width in ((1.0, 9), (2.6, 30), (0.4, 7)):
        results[f"faded {frames}"] = cleanup._faded(rng.uniform(0, 1, (width, 2)), frames)
    terms = [(0, rng.uniform(0.1, 1, 9), rng.normal(size=(9, 2))), (1, 0.4, 0.2), (3, 0.7, 0.1)]
    results["least squares"] = cleanup._least_squares(9, *terms).tolist()
    return results


def faults_of_spoiled_bodies() -> Any:
    results: dict[str, Any] = {}
    for fps, count in ((20.0, 60), (30.0, 20), (12.5, 20)):
        for name, joints in spoiled_bodies(count, fps, 5).items():
            lines = faults.find_faults(Motion(joints, fps))
            results[f"{name} {fps}"] = [
                Counter(line.kind for line in lines),
                [str(line) for line in lines[:3]],
                sum(line.start for line in lines),
                sum(line.end for line in lines),
                float(sum(line.worst for line in lines)),
            ]
    for frames in (1, 2, 3):
        motion = Motion(np.array([0, 0.2, 0]) + bodies()["walk, turned"][:frames], 20)
        results[f"{frames} frames"] = [str(line) for line in faults.find_faults(motion)]
    kit = Motion(conversion.kit_joints(bodies()["kick"]), 20, KIT21)
    results["kit"] = [str(outcome(faults.find_faults, kit))[:500]]
    return results


def depths_of_arms() -> Any:
    return {
        name: [
            traits(joints_of_side)
            for side in ("left", "right")
            for joints_of_side in faults.depths(joints, SMPL22.joints, side)
        ]
        + [traits(values) for values in faults._bends(joints, SMPL22.joints)]
        + [traits(values) for values in faults._stretched(joints, SMPL22.edges)]
        for name, joints in spoiled_bodies(16, 20.0, 9).items()
    }


TURNS = {
    "none": Rotation.identity(),
    "lying": Rotation.from_euler("x", 90, degrees=True),
    "head down": Rotation.from_euler("x", 175, degrees=True),
    "prone": Rotation.from_euler("x", -80, degrees=True),
    "tilted": Rotation.from_euler("zx", [50, 30], degrees=True),
    "on the side": Rotation.from_euler("z", 95, degrees=True),
}


def checks_of_bodies() -> Any:
    results: dict[str, Any] = {}
    for number, (name, joints) in enumerate(spoiled_bodies(20, 20.0, 11).items()):
        turn, scale = (
            list(TURNS)[number % len(TURNS)],
            (1.0, 0.4, 100.0, 0.01, 0.65, 3.1)[number % 6],
        )
        moved = scale * (joints @ TURNS[turn].as_matrix().T)
        results[name + turn] = [
            checks.uprightness(moved),
            checks.below_floor(moved),
            layouts.leg_length(moved),
            layouts.head_height(moved),
            *(checks.lying(moved, up, np.array(layouts.UP[up], float)) for up in layouts.UP),
            *(checks.jump(moved, fps) for fps in (3.0, 20.0, 120.0)),
            *(
                outcome(
                    checks.check_body,
                    moved,
                    layouts.Layout.model_validate({"unit": unit, "up": up, "children": children}),
                )
                for unit, up, children in (
                    (1.0, "y", False),
                    (0.01, "z", True),
                    (0.0254, "-y", True),
                )
            ),
        ]
    return results


def sizes_at_limits() -> Any:
    adult = posed().joints.astype(float)
    leg, results = layouts.leg_length(adult), []
    for length in (
        0.1,
        0.2499,
        0.2501,
        0.4,
        0.599,
        0.601,
        0.9,
        1.199,
        1.201,
        8.3,
        33,
        83,
        830,
        9e4,
    ):
        for unit, children, doubt in ((1.0, False, ""), (0.01, True, "a doubt"), (0.3, False, "x")):
            results.append(outcome(layouts.check_size, adult * length / leg, unit, children, doubt))
    results += [layouts._usual_unit(value, 2.0) for value in (0.0, 1.0, 1e-300, np.inf)]
    for depth in (0.0199, 0.0201, 0.3):
        results.append(checks.below_floor(adult - [0, adult[..., 1].min() + depth, 0]))
    return results


def checks_of_feet_and_order() -> Any:
    results: list[Any] = []
    for number, joints in enumerate(some_bodies(12, 20.0, 21).values()):
        backwards, short = joints.copy(), joints.copy()
        for ankle, toe in ((7, 10), (8, 11))[: 1 + number % 2]:
            backwards[: 12 + 6 * number, toe] -= (
                2 * (joints[:, toe] - joints[:, ankle])[: 12 + 6 * number]
            )
        short[:, 10 + number % 2] = short[:, 7 + number % 2] + [
            0,
            0,
            0.0199 + 0.0002 * (number % 3),
        ]
        results += [outcome(layouts.check_feet, motion) for motion in (joints, backwards, short)]
        shuffled = joints[:, np.random.default_rng(number).permutation(22)]
        uneven, changing = joints.copy(), joints.copy()
        uneven[:, [4, 7, 18, 20]] += (0.05 * number) * np.array([0.3, -1.0, 0.2])
        changing[::2] *= 1 + 0.06 * number
        results += [
            outcome(layouts.check_order, motion, 22 + number, "a skeleton")
            for motion in (joints, shuffled, uneven, changing)
        ]
    return results


def rest_poses_in_front() -> Any:
    results: dict[str, Any] = {}
    bent = {"left_elbow": [0, 60.0, 0]}
    low = {"left_shoulder": [0, 0, -70.0], "right_shoulder": [0, 0, 70.0]}
    uneven = {"left_shoulder": [0, 0, -40.0]}
    sitting = {"left_hip": [-60.0, 0, 0]}
    starts = {
        "T": {},
        "bent": bent,
        "low": low,
        "uneven": uneven,
        "sitting": sitting,
        "A": {"left_shoulder": [0, 0, -45.0], "right_shoulder": [0, 0, 48.0]},
    }
    for name, turns in starts.items():
        pose = posed(**turns, heading=1.0).joints[0]
        for number, motion in enumerate(some_bodies(3, 20.0, 31).values()):
            for blend, fps in ((0, 20.0), (1, 30.0), (2, 59.94), (4, 120.0), (6, 120.0), (3, 20.0)):
                shares = np.linspace(0, 1, blend + 2)[:-1, None, None]
                joints = np.concatenate([(1 - shares) * pose + shares * motion[0], motion])
                results[f"{name} {number} {blend} {fps}"] = checks.rest_frames(joints, fps)
        results[f"{name} is rest"] = checks._is_rest_pose(pose.astype(float))
        results[f"{name} short"] = [
            checks.rest_frames(np.concatenate([pose[None], motion])[:count], 20)
            for count in (1, 2, 3)
        ]
    return results


@cache
def grounded_bodies() -> dict[str, grounding.GroundedMotion]:
    walks = [
        name
        for name in bodies()
        if name.split(",")[0]
        in ("walk", "run", "march", "strafe", "turn", "hop", "wave", "waltz", "sneak", "limp")
    ]
    return {name: grounding.grounded(bodies()[name], 20.0) for name in walks}


def described(motion: grounding.GroundedMotion | None) -> Any:
    if motion is None:
        return None
    return [
        len(motion),
        traits(motion.local),
        traits(motion.path),
        traits(motion.heading, 2),
        traits(motion.contacts),
        motion.fps,
    ]


def grounded_motions() -> Any:
    results: dict[str, Any] = {}
    for number, (name, motion) in enumerate(grounded_bodies().items()):
        joints = bodies()[name]
        first, last = 5 + number % 7, 30 + number % 13
        cut = motion.cut(first, last)
        results[name] = [
            described(motion),
            described(cut),
            traits(motion.world()),
            described(motion.with_world(joints * 1.1)),
            traits(grounding.facing(joints)),
            grounding.slide(motion),
            grounding.pivot(motion),
            grounding.jolt(motion),
            [grounding.runs(motion.contacts[:, foot]) for foot in range(2)],
        ]
        if number % 3 == 0:
            for fixed_start, fixed_end in (
                (False, False),
                (True, False),
                (False, True),
                (True, True),
            ):
                high = grounding.GroundedMotion(
                    np.array([0, 0.1 * (number % 4) - 0.05, 0]) + cut.local,
                    cut.path,
                    cut.heading,
                    cut.contacts,
                    cut.fps,
                )
                ends = {"fixed_start": fixed_start, "fixed_end": fixed_end}
                results[f"{name} {ends}"] = traits(grounding.planted(high, **ends).world())
            for at_end, seconds in ((True, 0.5), (False, 0.01), (True, 9.0)):
                pose = motion.local[40]
                results[f"{name} {at_end} {seconds}"] = traits(
                    grounding.anchored(cut, pose, seconds, at_end=at_end).local
                )
            results[f"{name} loops"] = [
                described(grounding.repeated(cut)),
                described(grounding.repeated(cut, 2)),
                described(grounding.planted_loop(cut)),
            ]
    for fps in RATES:
        rows = [grounding.planted_toes(joints, fps) for joints in some_bodies(8, fps, 41).values()]
        results[f"toes {fps}"] = [traits(flags) for flags in rows]
    return results


def shifts_of_toes() -> Any:
    rng = np.random.default_rng(17)
    results = []
    for number in range(24):
        toe, flags = rng.normal(0, 1, (30, 3)), np.zeros(30, bool)
        for _ in range(number % 4):
            begin = int(rng.integers(0, 27))
            flags[begin : begin + int(rng.integers(2, 12))] = True
        flags[0], flags[-1] = number % 3 == 0, number % 5 < 2
        flags |= number == 23
        start, end, near = bool(number & 1), bool(number & 2), (0, 2, 4)[number % 3]
        results.append(traits(grounding._shift(toe, flags, start, end, near), 3))
    joints = bodies()["walk, noisy"]
    shift = rng.normal(0, 0.15, (len(joints), 3))
    results += [grounding._lack(joints, leg, shift) for leg in grounding.FEET]
    results += [traits(grounding.with_lengths(joints, 1.1 * joints[4]))]
    return results


def gaits_of_bodies() -> Any:
    results: dict[str, Any] = {}
    for number, (name, motion) in enumerate(grounded_bodies().items()):
        stand = motion.local[number]
        for degrees in (0.0, 30.0, 90.0, 180.0, -90.0):
            cycle = gaits.find_cycle(motion, degrees)
            results[f"{name} {degrees}"] = [cycle]
            if number % 2 == 0 and degrees in (0.0, -90.0):
                results[f"{name} {degrees}"] += [
                    [traits(values, 3) for values in gaits.progress(motion, degrees)],
                    described(gaits.straightened(motion, degrees)),
                ]
            if cycle and number % 2 == 0:
                parts = gaits.gait(motion, cycle, degrees, stand)
                results[f"{name} {degrees}"] += [described(part) for part in parts]
                results[f"{name} {degrees}"] += [gaits.passing(part) for part in parts]
        results[name] = [
            gaits.moving(motion),
            [described(gaits.turn(motion, angle, stand)) for angle in (90.0, -90.0, 30.0)],
            described(gaits.loop(motion)),
            described(gaits.loop(motion.cut(3, 21))),
            described(gaits.closed(motion.cut(2, 17))),
            gaits.passing(motion),
            gaits.passing(gaits.loop(motion)),
        ]
    clips = [
        gaits.Clip(kind, kind, motion.cut(4, 16 + number), "text")
        for number, (motion, kind) in enumerate(
            zip(grounded_bodies().values(), ("loop", "start", "stop", "turn", "loop"), strict=False)
        )
    ]
    for frames in (0, 3, 12, 13, 31):
        joints, slices = gaits.with_neighbors(clips, frames)
        results[f"neighbors {frames}"] = [traits(joints), slices]
    return results


def solved_poses() -> Any:
    results: dict[str, Any] = {}
    for fps, count in ((20.0, 14), (59.94, 2), (12.5, 4)):
        for name, joints in some_bodies(count, fps, 51).items():
            solved = poses.solve(torch.from_numpy(joints), fps)
            results[f"{name} {fps}"] = [
                traits(solved.offsets),
                traits(solved.rotations),
                traits(solved.root),
                traits(solved.rest()),
                traits(solved.joints().numpy() - joints),
                *(traits(part) for part in vars(solved.resampled(fps, 30.0)).values()),
            ]
    arm = bodies()["stand"].copy()
    arm[:, 20] = arm[:, 18] + (arm[:, 18] - arm[:, 16])
    for frames in (1, 2, 60):
        results[f"{frames} frames"] = traits(poses.solve(torch.tensor(arm[:frames]), 20).rotations)
    arm[:, 15] = arm[:, 12]
    wrong = [arm, arm[:0], arm[:, :21], arm[0]]
    results["refusals"] = [outcome(poses.solve, torch.tensor(value), 20) for value in wrong]
    rng = np.random.default_rng(3)
    results["fit"] = [
        poses._fit(torch.tensor(rng.normal(size=(3, 3))), torch.tensor(rng.normal(size=(4, 3, 3)))),
        poses._fit(torch.ones(3, 3).double(), torch.zeros(2, 3, 3).double()),
        *(
            poses._smooth(torch.tensor(rng.normal(size=(9, 2))), frames)
            for frames in (0.5, 2.0, 3.3)
        ),
    ]
    return results


def postures() -> Any:
    rng = np.random.default_rng(23)
    results: dict[str, Any] = {}
    for number, (name, joints) in enumerate(some_bodies(14, 20.0, 61).items()):
        turn = list(TURNS.values())[number % len(TURNS)].as_matrix()
        moved = (joints @ turn.T if number % 3 == 0 else joints) + [0, 0.02 * number, 0]
        solved = poses.solve(torch.from_numpy(moved), 20)
        world = posture.world_rotations(solved.rotations.numpy())
        parts = posture.complete(moved, solved.offsets.numpy(), world)
        results[name] = [traits(part) for part in parts]
        for side in (0, 1):
            height = moved[:, 10 + side, 1] - 0.03
            toes = posture._toes(world[:, 7 + side] @ turn, height)
            foot = posture._flat_foot(moved[:, 7 + side], moved[:, 10 + side], rng.normal(size=3))
            results[name] += [traits(toes), foot]
    vectors = rng.normal(size=(2, 7, 3))
    vectors[1, 0], vectors[1, 1] = vectors[0, 0], 2 * vectors[0, 1]
    results["turns"] = [
        posture.shortest_turns(*vectors).tolist(),
        posture.orthonormal(*vectors[:, 3]).tolist(),
        posture.rotations_about(
            poses.F.normalize(torch.tensor(vectors[0]), dim=-1).numpy(), rng.normal(0, 3, 7)
        ).tolist(),
    ]
    return results


def fitted_bodies() -> Any:
    rng = np.random.default_rng(29)
    results: dict[str, Any] = {}
    for number, (name, joints) in enumerate(some_bodies(7, 20.0, 71).items()):
        scaled = joints * rng.uniform(0.7, 1.4, 3)
        fitted = body.fit_body(Motion(scaled, 20))
        results[name] = [
            traits(values)
            for values in (
                fitted.fit,
                fitted.joints,
                fitted.points,
                fitted.neutral,
                fitted.turns,
                fitted.starts,
                *fitted.skinned(number * 8),
                body.local_rotations(fitted),
            )
        ] + [fitted.lift]
    known = posed(
        4,
        1.2,
        heading=2.0,
        left_wrist=[170.0, 30, 0],
        right_hip=[0, 100.0, 10],
        left_shoulder=[100.0, 0, -30],
        right_elbow=[20.0, 190, 0],
        spine1=[30.0, 0, 5],
    )
    fitted = body.fit_body(known, mannequin())
    results["known"] = [traits(fitted.turns), traits(fitted.points), traits(fitted.fit)]
    adult = np.array(ADULT[:22])
    for seed in range(12):
        offsets = adult * rng.uniform(*((0.3, 3.0), (0.6, 1.7), (0.8, 1.3))[seed % 3], (22, 1))
        parts = outcome(body.proportions, mannequin(), offsets)
        results[f"proportions {seed}"] = (
            parts if isinstance(parts, str) else [traits(parts[0], 22), parts[1]]
        )
    figures = {
        "kit": sway(4, skeleton=KIT21),
        "smpl24": sway(4, skeleton=SKELETONS["smpl24"]),
        "tiny": Motion(0.1 * bodies()["walk"], 20),
        "sheared": known.resampled(20),
    }
    for matrix, frame, joint in (
        (np.diag([1, 1, -1.0]), 1, 5),
        (1.06 * np.eye(3), 2, 0),
        (np.diag([1.04] * 3), 0, 1),
    ):
        world = known.posed().rotations.clone()
        world[frame, joint] = torch.tensor(matrix)
        changed = poses.Poses(known.posed().offsets, world, known.posed().root)
        figures[f"matrix {joint}"] = Motion(known.joints, 20, poses=changed)
    for name, figure in figures.items():
        fit, reason = figure.try_fit()
        results[name] = [fit is None, reason]
    return results


def rigs_of_programs() -> Any:
    results: dict[str, Any] = {}
    source = posed(
        5,
        0.9,
        heading=np.linspace(2, 4, 5),
        left_shoulder=[20.0, 10, -60],
        neck=[9.0, 40, 3],
        right_knee=[70.0, 4, 0],
        spine2=[5.0, 20, 8],
        left_foot=[-20.0, 0, 0],
    ).posed()
    for number, name in enumerate((None, *retarget.presets())):
        skeleton = retarget.preset(name, source)
        turns, hips = retarget.retarget(source, skeleton)
        clip = rigged.rigged(source, "clip", 20, skeleton)
        results[str(name)] = [
            skeleton.joints,
            skeleton.parents,
            skeleton.sources,
            skeleton.orders,
            skeleton.unit,
            skeleton.hips,
            *(
                traits(values)
                for values in (
                    skeleton.positions,
                    skeleton.turns,
                    skeleton.neutral,
                    skeleton.offsets(),
                    skeleton.rest(),
                    turns,
                    hips,
                    *clip.world(),
                    skeleton.assembled(
                        skeleton.turned(posture.world_rotations(source.rotations.numpy())), hips
                    ),
                    retarget.continuous_euler(torch.tensor(turns), skeleton.orders),
                )
            ),
        ]
        if number % 2:
            fitted = body.fit_body(motion_of_poses(source, 20))
            whole = rigged.rigged(source, "person", 20, skeleton, fitted, False)
            skin, (offsets, moves) = whole.skins[0], whole.on_soles()
            results[str(name)] += [
                skin.ordered,
                whole.root,
                whole.lift,
                *(
                    traits(values)
                    for values in (
                        skin.points,
                        skin.normals,
                        skin.materials,
                        skin.bones,
                        skin.weights,
                        skin.binds,
                        whole.turns,
                        offsets,
                        *moves.values(),
                    )
                ),
            ]
        moving = outcome(rigged.rigged, source, "path", 20, skeleton, root_motion=True)
        results[f"{name} root"] = moving
        path, heading = np.arange(10.0).reshape(5, 2), np.linspace(2, 5, 5)
        clips = [clip] if isinstance(moving, str) else [clip, moving]
        for part in clips:
            carried = part.on_path(path, heading).part(slice(1, 4), "part", np.eye(3, 2) > 0)
            results[f"{name} root"] = [
                carried.name,
                carried.contact_changes(),
                *map(traits, carried.world()),
                *(traits(moved) for moved in carried.moves.values()),
                list(carried.moves),
                *(traits(moved) for moved in carried.on_soles()[1].values()),
            ]
    results["unknown"] = outcome(retarget.preset, "mixamoo", source)
    flags = np.random.default_rng(2).uniform(size=(14, 2)) > 0.5
    results["events"] = [rigged.contact_events(flags, fps) for fps in (20.0, 59.94)]
    turning = Rotation.from_euler("zyx", np.linspace([0, 0, 0], [9, 2.5, -8], 40)).as_matrix()
    results["euler"] = [
        retarget.continuous_euler(torch.tensor(turning[:, None]), (order,)).tolist()[::6]
        for order in ("XYZ", "YZX", "ZXY", "ZYX")
    ]
    return results


def characters_that_follow() -> Any:
    results: dict[str, Any] = {}
    rng = np.random.default_rng(37)
    for number, name in enumerate(("mixamo", "unreal", "soma", "rigify", "lafan1")):
        solved = list(some_bodies(5, 20.0, 81).values())[number]
        motion = Motion(np.array([0, (0.0, 0.05, 0.099, 0.101, -0.3)[number], 0]) + solved, 20)
        skeleton = retarget.preset(name, motion.posed())
        joints = {SMPL22.joints[s]: k for k, s in enumerate(skeleton.sources) if s >= 0}
        if number % 2:
            joints = {
                key: value for key, value in joints.items() if "foot" not in key and key != "spine3"
            }
        turn = Rotation.from_euler("y", (0, 5, 30, 9, -100)[number], degrees=True).as_matrix()
        scale = rng.uniform(0.5, 2)
        positions = scale * skeleton.positions @ turn.T + rng.normal(
            0, 0.01, skeleton.positions.shape
        )
        arguments = (skeleton.joints, skeleton.parents, positions, turn @ skeleton.turns, joints)
        rest = rig.rest_pose("a file", *arguments, positions, (0, 1, 0))
        fitted = body.fit_body(motion)
        world = posture.world_rotations(body.local_rotations(fitted)) @ fitted.neutral
        offsets = motion.posed().offsets.numpy()
        turned, moved, followed = rig.follow(rest, motion.joints, offsets, fitted.neutral, world)
        results[name] = [
            rest.floor,
            rest.map,
            rest.rig.sources,
            traits(rest.rig.positions),
            traits(rest.rig.frame, 3),
            traits(turned),
            traits(moved),
            traits(followed.neutral),
            rest.position("left_knee"),
            traits(followed.offsets()),
        ]
        for axis, degrees in (("x", 44), ("x", 46), ("z", 120), ("y", 180)):
            tilt = Rotation.from_rotvec(np.radians(degrees) * np.array(AXES[axis])).as_matrix()
            result = outcome(
                rig.rest_pose,
                "tilted",
                skeleton.joints,
                skeleton.parents,
                positions @ tilt.T,
                skeleton.turns,
                joints,
                positions,
                (0, 1, 0),
            )
            results[f"{name} {axis} {degrees}"] = (
                result if isinstance(result, str) else traits(result.rig.frame, 3)
            )
        swapped = joints | {
            "left_hip": joints["right_hip"],
            "right_hip": joints["left_hip"],
            "left_shoulder": joints["right_shoulder"],
            "right_shoulder": joints["left_shoulder"],
        }
        for label, change in (
            ("swapped", swapped),
            ("same", joints | {"left_knee": joints["left_hip"]}),
            (
                "middle",
                joints
                | {"left_hip": joints["right_hip"], "left_shoulder": joints["right_shoulder"]},
            ),
        ):
            result = outcome(rig.rest_pose, label, *arguments[:4], change, positions, (0, 1, 0))
            results[f"{name} {label}"] = result if isinstance(result, str) else "usable"
    hip, knee, ankle, target, forward = rng.normal(0, 0.5, (5, 12, 3))
    results["bent"] = rig._bent(hip, knee, ankle, target, forward).tolist()
    return results


def rates_and_frames() -> Any:
    values = (
        0.1,
        0.0999,
        1000,
        1000.1,
        20,
        12.5,
        "20",
        None,
        True,
        np.array([30.0]),
        np.array([[30]]),
        np.array([20, 30]),
        float("nan"),
        20j,
        np.float32(59.94),
    )
    rng = np.random.default_rng(43)
    results: list[Any] = [outcome(resampling.frame_rate, value, "a rate") for value in values]
    results += [outcome(resampling.check_frames, count) for count in (500_000, 500_001)]
    for frames, joints, size in (
        (1000, 1000, 9),
        (1001, 1000, 9),
        (500, 9000, 20_000_000),
        (3000, 9000, 10**9),
        (2000, 1500, 11_999_999),
        (2778, 9000, 10**9),
    ):
        results.append(outcome(resampling.check_tree, frames, joints, size))
    for frames in (1, 2, 7, 31):
        for rate, fps in ((20, 20), (20, 30), (30, 20), (59.94, 12.5), (29.97, 30), (24, 120)):
            moved = rng.normal(size=(frames, 3, 3))
            pairs = resampling.frame_pairs(frames, rate, fps, 3, 0.0 if frames % 2 else 1e-6)
            results += [traits(pair, 2) for pair in pairs]
            results += [
                traits(resampling.resample(moved, rate, fps, cubic), 2) for cubic in (False, True)
            ]
            results.append(traits(resampling.resample(moved[:, 0], rate, fps), 2))
    results += [
        outcome(resampling.frame_pairs, frames, rate, fps, joints)
        for frames, rate, fps, joints in (
            (5000, 0.1, 1000, 20),
            (100, 1, 100, 101),
            (500_001, 1, 1, 1),
        )
    ]
    wide = rng.normal(size=(5, 30_000, 3))
    results += [
        traits(part) if not isinstance(part, str) else part
        for fps in (130.0, 140.0, 200.0)
        for part in [outcome(resampling.resample, wide, 20.0, fps)]
    ]
    return results


def conversions() -> Any:
    kinds = (Rifke(), SMPL(20.0), Rot6D(), Motion272())
    results: dict[str, Any] = {"rotations": [conversion.needs_rotations(kind) for kind in kinds]}
    bones = poses.BoneRotations
    for number, (name, joints) in enumerate(some_bodies(4, 30.0, 91).items()):
        motion = Motion(joints * (0.8 + 0.15 * number), 30)
        if number == 1:
            motion.bones = bones(motion.posed())
        elif number == 2:
            motion.bones = bones(reason="a reason")
        elif number == 3:
            motion.poses = posed(len(joints), 1.1, heading=2.0).posed()
        for axes, fps in ((conversion.CAMERA_AXES, 20.0), (conversion.AMASS_AXES, 30.0)):
            raw = conversion._rotations(motion, fps, axes)
            results[f"{name} {fps}"] = [traits(raw.values), raw.note, raw.error]
        results[f"{name} kit"] = traits(conversion.kit_joints(joints))
        raws = [conversion.raw_motion(motion, kind) for kind in kinds]
        results[f"{name} raw"] = [[traits(raw.values), raw.note, raw.error] for raw in raws]
    results["refused"] = outcome(
        conversion._rotations, sway(3, skeleton=KIT21), 20.0, conversion.CAMERA_AXES
    )
    return results


CASES = cases_of(globals())


@pytest.mark.parametrize("case", CASES)
def test_results_are_as_recorded(case: Case):
    check(NAME, case)


if __name__ == "__main__":
    record(NAME, CASES)
