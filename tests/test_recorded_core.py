"""Values of representations, rotations, skeletons, losses and batches, as recorded."""

from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any, cast

import numpy as np
import pytest
import torch
from support.recorded import REFUSALS, Case, cases_of, check, combinations, record
from torch import Tensor

from flame_mdm.batch import (
    Condition,
    Constant,
    Edit,
    MotionBatch,
    ceil_div,
    collate,
    length_mask,
    pad_to,
    padded_length,
    sent,
)
from flame_mdm.losses import MotionLosses, bone_lengths, masked_mean, masked_mse
from flame_mdm.representations import (
    Frames,
    Representation,
    check_finite,
    grouped_statistics,
    moments,
    rotation,
    skeleton,
)
from flame_mdm.representations.essential import Essential
from flame_mdm.representations.humanml import HumanML
from flame_mdm.representations.motion272 import Motion272, face_forward
from flame_mdm.representations.rifke import Rifke, upsample
from flame_mdm.representations.rot6d import Rot6D
from flame_mdm.representations.skeleton import SKELETONS
from flame_mdm.representations.smpl import ADULT, SMPL, read_pose

NAME = "core"
CPU = torch.device("cpu")
OTHER_OFFSETS = (np.array(ADULT) * 1.3 + 0.01).tolist()


def numbers(seed: int, *shape: int) -> Tensor:
    """Normal float64 numbers."""
    return torch.from_numpy(np.random.default_rng(seed).normal(size=shape))


def refusal(call: Callable[[], Any]) -> str:
    """The text of the error that a call raises, or "accepted"."""
    try:
        call()
    except REFUSALS as error:
        return f"{type(error).__name__}: {error}"
    return "accepted"


def smooth(seed: int, frames: int, *shape: int) -> Tensor:
    """Sums of three sines with random phases, (frames, *shape)."""
    rng = np.random.default_rng(seed)
    time = np.arange(frames).reshape(-1, *[1] * len(shape))
    waves = [
        rng.normal(size=shape) * np.sin(rng.uniform(0.05, 0.5, shape) * time + rng.uniform(0, 6,
        shape))
        for _ in range(3)
    ]  # fmt: skip
    return torch.from_numpy(sum(waves))


@cache
def body(name: str, frames: int, seed: int, turn: float = 5.0) -> Tensor:
    """Joint positions of a body that sways, walks and turns by `turn` radians, in meters."""
    tree = SKELETONS[name]
    bones = torch.tensor(tree.raw_offsets, dtype=torch.float64) * (
        0.2 + 0.05 * numbers(seed, len(tree), 1).abs()
    )
    bones = bones + 0.04 * smooth(seed + 1, frames, len(tree), 3) * (frames > 0)
    bones[:, 0] = 0
    root = smooth(seed + 2, frames, 3) * torch.tensor([0.2, 0.03, 0.2])
    root = root + torch.arange(frames)[:, None] * torch.tensor([0.03, 0.0, 0.02])
    joints = tree.assemble(bones, root + torch.tensor([1.5, 0.9, -2.0]))
    angles = 1.0 + torch.linspace(0, turn, frames, dtype=torch.float64)
    return rotation.rotate_y(joints, angles[:, None])


@cache
def pose(joints: int, frames: int, seed: int) -> Tensor:
    """Raw SMPL motion: translations and axis-angle vectors of some joints."""
    angles = 0.6 * smooth(seed, frames, joints, 3)
    angles[:, 0, 2] += torch.linspace(1.5, 4.5, frames)
    return torch.cat([smooth(seed + 1, frames, 3) + 1.0, angles.flatten(1)], 1)


@cache
def quaternions(seed: int, *shape: int) -> Tensor:
    values = numbers(seed, *shape, 4)
    return values / values.norm(dim=-1, keepdim=True)


# Rotations


def axis_angles_and_quaternions() -> Any:
    vectors = numbers(0, 8, 3) * torch.tensor([0.0, 1e-10, 1e-4, 0.5, 1.0, 2.0, 3.0, 6.0])[:, None]
    both_signs = torch.cat([quaternions(1, 6), -quaternions(2, 6)])
    near_identity = torch.tensor(
        [[1.0, 0.0, 0.0, 0.0], [-1.0, 1e-9, 0.0, 2e-9], [1.0, 1e-7, -3e-7, 0.0], [0.0, 0.6, 0.0,
        0.8]]
    ).double()  # fmt: skip
    return {
        "to quaternion": list(rotation.axis_angle_to_quaternion(vectors)),
        "to matrix": list(rotation.axis_angle_to_matrix(vectors)),
        "back": list(rotation.quaternion_to_axis_angle(both_signs)),
        "near identity": [
            [x * 1e6 for x in row]
            for row in rotation.quaternion_to_axis_angle(near_identity[:3]).tolist()
        ],
        "half turn": rotation.quaternion_to_axis_angle(near_identity[3]),
        "float32": rotation.quaternion_to_axis_angle(near_identity.float())[2] * 1e6,
        "standardized": list(rotation.standardize(both_signs)),
        "of any length": list(rotation.quaternion_to_matrix(both_signs[:3] * 2.5)),
    }


def matrices() -> Any:
    vectors = torch.cat([torch.eye(3).double() * 3.0 + 0.1, numbers(3, 6, 3)])
    turns = rotation.axis_angle_to_matrix(vectors)
    half_turns = [torch.diag(2 * row - 1) for row in torch.eye(3).double()]
    return {
        "half turns": [rotation.matrix_to_quaternion(turn) for turn in half_turns],
        "quaternions": list(rotation.matrix_to_quaternion(turns)),
        "axis angles": list(rotation.matrix_to_axis_angle(turns)),
        "rows": list(rotation.matrix_to_rot6d(turns, "rows")),
        "columns": list(rotation.matrix_to_rot6d(turns, "columns")),
    }


def six_d_vectors() -> Any:
    first, second = numbers(4, 3), numbers(5, 3)
    zero = torch.zeros(3).double()
    pairs = {
        "usual": [first, second], "long": [first * 50, second * 0.01], "no first": [zero, second],
        "no second": [first, zero], "none": [zero, zero], "parallel": [first, first * -2],
        "nearly parallel": [first, first + 1e-10 * second],
        "not quite parallel": [first, first + 1e-6 * second], "tiny": [first * 1e-14, second],
        "tiny second": [first, second * 1e-9], "NaN": [first * float("nan"), second],
    }  # fmt: skip
    results = {}
    for name, pair in pairs.items():
        vector = torch.cat(pair)
        results[name] = [
            *(rotation.rot6d_to_matrix(vector, kind) for kind in ("rows", "columns")),
            rotation.is_degenerate(vector[None]),
            rotation.is_degenerate(vector.float()[None, None]),
            rotation._completed(vector),
        ]
    many = torch.stack([torch.cat(pair) for pair in pairs.values()])[:-1]
    return results, rotation.rot6d_to_matrix(many[None], "rows"), rotation.is_degenerate(many)


def euler_angles() -> Any:
    turns = rotation.axis_angle_to_matrix(numbers(6, 5, 3))
    locked = []
    for order in ("XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX"):
        middle = torch.zeros(3).double()
        middle["XYZ".index(order[1])] = torch.pi / 2
        first, half = torch.zeros(3).double(), rotation.axis_angle_to_matrix(middle)
        first["XYZ".index(order[0])] = 0.7
        both = [rotation.axis_angle_to_matrix(first) @ turn for turn in (half, half.mT)]
        locked.append(rotation.matrix_to_euler(torch.stack(both), order))
    return {
        "orders": [
            list(rotation.matrix_to_euler(turns, order))
            for order in ("XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX")
        ],
        "locked": [list(pair) for pair in locked],
        "refused": [
            refusal(lambda order=order: rotation.matrix_to_euler(turns, order))
            for order in ("XYX", "xyz", "XY", "")
        ],
    }


def products_of_quaternions() -> Any:
    a, b, vectors = quaternions(7, 5), quaternions(8, 5), numbers(9, 5, 3)
    return {
        "product": list(rotation.multiply(a, b)),
        "inverse": list(rotation.inverse(a)),
        "rotated": list(rotation.rotate(a, vectors)),
        "all by all": rotation.rotate(a[:, None], vectors),
        "about y": list(rotation.rotate_y(vectors, torch.tensor([0.3, -1.0, 2.0, 4.0, 0.0]))),
        "broadcast": rotation.rotate_y(vectors, numbers(10, 3, 1)),
    }


def shortest_arcs() -> Any:
    a, b = numbers(11, 5, 3), numbers(12, 5, 3)
    x, zero = torch.tensor([0.3, -2.0, 1.1]).double(), torch.zeros(3).double()
    special = {
        "opposite": (x, -3 * x), "same": (x, 2 * x), "no first": (zero, x), "no second": (x, zero),
        "none": (zero, zero), "tiny": (x * 1e-200, a[0] * 1e-200), "huge": (x * 1e200,
        a[0] * 1e200),
        "nearly opposite": (x, -x + 1e-4 * a[0]), "opposite y": (a[1], -a[1]),
    }  # fmt: skip
    pairs = [torch.stack(column) for column in zip(*special.values(), strict=True)]
    return {
        "usual": list(rotation.between(a, b)),
        "special": {name: rotation.between(*pair) for name, pair in special.items()},
        "in one call": list(rotation.between(*pairs)),
        "broadcast": rotation.between(a[:, None], b),
        "scaled": list(rotation._scaled(torch.stack([x, zero, x * 1e-300]))),
    }


def interpolated_rotations() -> Any:
    a, b = quaternions(13, 6), quaternions(14, 6)
    return {
        "numbers": [list(rotation.slerp(a, b, t)) for t in (0.0, 0.25, 0.9, 1.0)],
        "tensor": list(rotation.slerp(a, b, torch.linspace(0.1, 0.8, 6)[:, None])),
        "same": rotation.slerp(a[0], a[0], 0.3),
        "negative": rotation.slerp(a[0], -a[0], 0.3),
        "continuous": [list(rotation.continuous(quaternions(15, 7), 0))],
        "other axis": rotation.continuous(quaternions(16, 3, 6), 1),
        "first axis": rotation.continuous(quaternions(16, 3, 6), 0),
    }


# Skeletons


def tables_of_skeletons() -> Any:
    return {
        name: [
            len(tree), tree.joints, tree.parents, tree.chains, tree.raw_offsets, tree.facing,
            tree.feet, tree.leg, tree.edges, tree.chain_parents, tree.mirrored,
            skeleton.part_names(tree),
        ]
        for name, tree in SKELETONS.items()
    }  # fmt: skip


def positions_of_skeletons() -> Any:
    results = []
    for number, (name, tree) in enumerate(SKELETONS.items()):
        joints = body(name, 4, number)
        turns = rotation.axis_angle_to_matrix(numbers(20 + number, 2, len(tree), 3))
        offsets, root = numbers(23 + number, len(tree), 3), numbers(26 + number, 2, 3)
        results.append(
            [
                tree.mirror(joints), tree.bones(joints), tree.assemble(tree.bones(joints),
                root[:1]),
                skeleton.forward_kinematics(tree, turns, offsets, root),
                skeleton.global_rotations(turns, tree.parents),
                *skeleton.forward_kinematics(tree, turns, offsets, root)[1],
            ]
        )  # fmt: skip
    return results, skeleton.JOINT


def joints_by_name() -> Any:
    chosen = [
        "left_arm", ["right_leg", "head"], ("legs", "left_foot"), "lower_body", ["upper_body"], [],
        "left_hnad", ["left_arm", "lfet_knee"], [3], 5, None, "arms",
    ]  # fmt: skip
    results = []
    for tree in SKELETONS.values():
        for names in chosen:
            try:
                results.append(skeleton.find_joints(tree, names))  # type: ignore[arg-type]
            except REFUSALS as error:
                results.append(str(error))
    return results


# Representations


def all_about(representation: Representation) -> Any:
    """The attributes and masks of a representation."""
    size = len(representation.skeleton)
    parts = ([0], [1, 4, 7], [2, size - 1], range(size), [], list(representation.skeleton.feet[1:]))
    return {
        "facts": [
            representation.name, representation.features, representation.fps,
            representation.part_of, representation.relative, representation.skeleton.name,
            {name: str(columns) for name, columns in representation.slices.items()},
            str(representation.pose),
        ],
        "masks": [representation.joint_features(joints) for joints in parts],
        "joint masks": [representation.joint_mask(joints) for joints in parts[:4]],
    }  # fmt: skip


def decoded(representation: Representation, features: Tensor) -> Any:
    """Everything that a representation reads from its features."""
    x = features.double()
    noisy = x + 0.1 * numbers(30, *x.shape)
    batch = torch.stack([x, noisy])
    mean, std = representation.statistics(features)
    representation.mean, representation.std = mean, std
    columns = {name: batch[..., part] for name, part in representation.slices.items()}
    rotations = representation.rotations6d(batch)
    return {
        "features": [features[:, first : first + 20] for first in range(0, features.shape[1], 20)],
        "rows": [features[0], features[-1]],
        "joints": representation.decode(batch),
        "frames": [representation.decode(x)[0], representation.decode(noisy)[-1]],
        "one frame": representation.decode(x[:1]),
        "from normalized": representation.to_joints(representation.normalize(noisy)),
        "normalized": [representation.normalize(noisy), representation.denormalize(noisy)],
        "statistics": [mean, std, mean[:4], std[-4:]],
        "rebased": [representation.rebase(noisy[2:]), representation.rebase(batch[:, 1:])],
        "rebased array": representation.rebase(noisy[2:].numpy()),
        "unchanged": noisy,
        "rotations": rotations if rotations.numel() else list(rotations.shape),
        "contacts": representation.contacts(noisy),
        "columns": columns,
    }


def humanml(options: Mapping[str, Any]) -> HumanML:
    """A representation for some options; `lengths` stands for other bone lengths."""
    settings = dict(options)
    kind = Essential if settings.pop("essential") else HumanML
    size = len(SKELETONS[settings["skeleton"]])
    if settings.pop("lengths"):
        settings["bone_lengths"] = (0.2 + 0.1 * numbers(31, size).abs()).tolist()
    return kind(**settings)


def humanml_features() -> Any:
    results = []
    for number, options in enumerate(
        combinations(
            0, 14, skeleton=tuple(SKELETONS), variant=("clean", "legacy"), fps=(20.0, 30.0, 12.5),
            lengths=(False, True), units_per_metre=(1.0, 640.0), contact_threshold=(0.002, 50.0),
            essential=(False, False, True),
        )
    ):  # fmt: skip
        representation = humanml(options)
        motions = [
            body(options["skeleton"], frames, 40 + number + frames, turn)
            for frames, turn in ((24, 5.0), (3, 0.3), (40, -7.0))
        ]
        clips = representation.encode_many(motions)
        results.append(
            {
                "options": options,
                "lengths": [len(clip) for clip in clips],
                "clips": [[clip, clip.mean(0)[:4], clip[-1]] for clip in clips],
                "contacts": [] if representation.essential else [clip[:, -4:] for clip in clips],
                "steps": representation.root_steps(clips[0]),
                "turn unit": representation.turn_unit,
                **(all_about(representation) if number < 6 else {}),
                **decoded(representation, clips[0]),
            }
        )
    return results


def humanml_defaults() -> Any:
    motion = body("smpl22", 30, 70)
    alone = HumanML().encode(motion)
    legacy = HumanML(variant="legacy", fps=30.0)
    lying = rotation.rotate(
        torch.tensor([0.5**0.5, 0.5**0.5, 0.0, 0.0]).double(), body("smpl22", 12, 71)
    )
    straight = torch.cat([motion[:1]] * 5)
    joints = torch.cat([motion, motion[:7] * 1.1])
    first = torch.tensor([0, 30])
    clip = torch.tensor([0] * 30 + [1] * 7)
    scaled = HumanML(bone_lengths=(0.1 + 0.1 * numbers(72, 22).abs()).tolist())
    return {
        "features": [alone, legacy.encode(motion), Essential().encode(motion)],
        "float32": HumanML().encode(motion.float()),
        "rows": [*alone[::9]],
        "lying": [HumanML().encode(lying), legacy.encode(lying)],
        "still": HumanML().encode(straight),
        "canonical": [HumanML()._canonical([motion, motion[4:9] + 3.0]),
        scaled._canonical([motion])],
        "retargeted": scaled._retarget(joints, first, clip),
        "facing": [HumanML()._facing(motion), HumanML()._facing(motion, hips=-1.0)],
        "headings": [kind._heading(motion) for kind in (HumanML(), legacy, HumanML(fps=12.5))],
        "rotations": [kind._rotations(motion, numbers(73, 30)) for kind in (HumanML(), legacy)],
        "root": [kind._root(numbers(74, 2, 6, 263)) for kind in (HumanML(), legacy)],
        "about": [all_about(kind) for kind in (HumanML(), legacy, Essential(skeleton="kit21"))],
        "settings": [HumanML().contact_threshold, HumanML().units_per_metre, HumanML().legacy],
    }  # fmt: skip


def humanml_contacts_beside_the_limit() -> Any:
    motion = body("smpl22", 6, 75).clone()
    motion[:, 7] = motion[:1, 7] + torch.arange(6)[:, None] * torch.tensor([0.0446, 0.0, 0.0])
    motion[:, 10] = motion[:1, 10] + torch.arange(6)[:, None] * torch.tensor([0.0, 0.0, 0.0448])
    return [HumanML(contact_threshold=limit).encode(motion)[:, -4:] for limit in (0.002, 0.004)]


def humanml_refusals() -> Any:
    representation, motion = HumanML(), body("smpl22", 6, 76)
    broken = motion.clone()
    broken[3, 4, 1] = float("nan")
    calls = [
        lambda: HumanML(skeleton="smpl23"), lambda: HumanML(bone_lengths=[1.0] * 21),
        lambda: HumanML("kit21", bone_lengths=[1.0] * 22), lambda: HumanML(fps=0.5),
        lambda: HumanML(fps=1000.0).fps, lambda: HumanML(fps=1), lambda: HumanML(fps=1000.1),
        lambda: HumanML(fps=cast(Any, "20")), lambda: representation.encode(motion[:2]),
        lambda: representation.encode(motion[:3]), lambda: representation.encode(motion[:, :21]),
        lambda: representation.encode(motion[0]), lambda: representation.encode(motion[..., :2]),
        lambda: representation.encode(broken),
        lambda: representation.encode_many([motion, motion[:2]]),
        lambda: representation.encode_many([motion, broken]),
        lambda: representation.encode_many([motion, motion, motion.flatten(1)]),
        lambda: Essential("kit21").encode(motion),
    ]  # fmt: skip
    return [refusal(call) for call in calls]


def smpl_features() -> Any:
    kinds: list[type[Any]] = [SMPL, Rot6D, Motion272]
    results = []
    for kind in kinds:
        for number, offsets in enumerate((None, OTHER_OFFSETS)):
            options = {} if offsets is None else {"offsets": offsets, "fps": 59.94}
            representation = kind(**options)
            motion = pose((24, 52)[number], (13, 8)[number], 80 + number)
            results.append(
                {
                    "about": all_about(representation),
                    **decoded(representation, representation.encode(motion)),
                    "many": representation.encode_many([motion, motion[:2] + 0.1]),
                }
            )
    return results


def raw_poses() -> Any:
    broken = pose(24, 5, 82).clone()
    broken[4, 1] = float("inf")
    return {
        "read": [read_pose(pose(joints, 4, 83)) for joints in (24, 52, 55)],
        "float32": read_pose(pose(24, 4, 83).float()),
        "offsets": ADULT,
        "refused": [
            refusal(lambda motion=motion: SMPL().encode(motion))
            for motion in (
                pose(22, 4, 84), pose(24, 4, 84)[0], pose(24, 4, 84)[:0], pose(25, 4, 84), broken,
                pose(24, 1, 84),
            )
        ],
        "too short": refusal(lambda: Motion272().encode(pose(24, 1, 84))),
    }  # fmt: skip


def motion272_parts() -> Any:
    representation = Motion272()
    turns = rotation.axis_angle_to_matrix(smooth(85, 9, 22, 3))
    joints, translation = body("smpl22", 9, 86), numbers(87, 9, 3)
    features = representation.features_of(joints, turns).double()
    noisy = features + 0.1 * numbers(88, 9, 272)
    return {
        "features": [features, *features[::4]],
        "poses": [
            representation.poses(x) for x in (features, noisy, noisy[:1], noisy[:6], noisy[None])
        ],
        "root": [
            representation._root(x) for x in (noisy, noisy[:2], torch.stack([noisy, features]))
        ],
        "forward": face_forward(translation, turns),
        "rotations": representation.rotations6d(noisy)[3],
    }


def rifke_features() -> Any:
    results = []
    for number, options in enumerate(({}, {"units_per_metre": 1.0, "fps": 20.0})):
        representation = Rifke(**options)
        motion = body("kit21", 25, 90 + number, 6.0)
        results.append(
            {
                "about": all_about(representation),
                "units": representation.units_per_metre,
                **decoded(representation, representation.encode(motion)),
                "short": [representation.encode(motion[4 : 4 + frames]) for frames in (1, 2)],
                "headings": [representation.heading(motion), *representation.heading(motion)[::6]],
                "floors": [representation.floor(motion * scale) for scale in (1.0, 640.0)],
            }
        )
    wrong = [motion[:, :20], motion[0], motion[:0], motion / 0]
    return results, [refusal(lambda motion=motion: Rifke().encode(motion)) for motion in wrong]


def upsampled_motions() -> Any:
    return [
        upsample(numbers(95, frames, 2, 3), **options)
        for frames in (1, 2, 5)
        for options in ({}, {"factor": 3}, {"factor": 1})
    ]


def statistics_of_frames() -> Any:
    arrays = [
        numbers(96 + number, frames, 5).numpy() * 3 + 1
        for number, frames in enumerate((4, 1, 9, 3))
    ]
    arrays = [array * [1.0, 1.0, 1e-5, 0.0, 1.0] for array in arrays]
    frames = Frames(lambda: arrays, 17)
    groups = [slice(0, 2), slice(2, 4), slice(4, 5)]
    long = numbers(97, 70000, 2)
    long[66000:] += 5.0
    almost = torch.cat([numbers(98, 50, 1) * 0.9e-4, numbers(98, 50, 1) * 1.3e-4], 1)
    everything = torch.from_numpy(np.concatenate(arrays))
    return {
        "parts": [list(frames.split(size)) for size in (1, 4, 5, 17, 20)],
        "length": len(frames),
        "moments": [moments(frames), moments(everything), moments(long)],
        "grouped": [grouped_statistics(frames, groups), grouped_statistics(almost, [slice(0, 1)])],
        "almost": grouped_statistics(almost, [slice(0, 1), slice(1, 2)]),
        "rifke": Rifke().statistics(torch.cat([everything, torch.ones(17, 1)], 1)),
        "unnormalized": [part.sum() for part in Rot6D().statistics(numbers(99, 3, 150))],
    }  # fmt: skip


def motions_that_are_not_finite() -> Any:
    motion = numbers(100, 6, 3, 2)
    infinite = motion.clone()
    infinite[4, 2, 1] = -float("inf")
    infinite[5, 0, 0] = float("nan")
    calls = [
        lambda: check_finite(motion), lambda: check_finite(infinite),
        lambda: check_finite(infinite, "clip 7"), lambda: check_finite(infinite[5:]),
        lambda: check_finite(infinite[:4]),
    ]  # fmt: skip
    return [refusal(call) for call in calls]


# Losses


MASK = length_mask(torch.tensor([7, 1, 4, 0]), 7)


def masked_errors() -> Any:
    results = []
    for shape in ((4, 7, 5), (4, 7, 3, 2), (4, 7, 2, 1, 3)):
        a, b = (numbers(101 + n, *shape).requires_grad_() for n in range(2))
        loss = masked_mse(a, b, MASK)
        (loss * torch.tensor([1.0, 2.0, 3.0, 4.0])).sum().backward()
        results.append([masked_mean(a, MASK), loss, a.grad, b.grad])
    narrow = numbers(103, 1, 7, 1).requires_grad_()
    wide = numbers(104, 4, 7, 3)
    masked_mse(narrow, wide, MASK).sum().backward()
    other = numbers(105, 4, 7, 3).requires_grad_()
    masked_mse(wide, other, MASK).prod().backward()
    masked_mse(wide, other, MASK)[:3].prod().backward()
    return results, narrow.grad, masked_mse(narrow, wide, MASK), other.grad


def lengths_of_bones() -> Any:
    joints = body("smpl22", 3, 106)
    edges = [(0, 1), (1, 4), (12, 15)]
    return [
        bone_lengths(joints, edges), bone_lengths(joints[0], torch.tensor(edges)),
        bone_lengths(joints[None], SKELETONS["smpl22"].edges),
    ]  # fmt: skip


def losses_of_all_options() -> Any:
    x = 0.02 * numbers(107, 4, 7, 15)
    x[:, :, 3:6] *= 0.2
    x = x + 0.3 * numbers(108, 15)
    estimate = x + 0.05 * numbers(109, 4, 7, 15)

    def to_joints(features: Tensor) -> Tensor:
        return (features + 0.1 * features.square()).unflatten(-1, (-1, 3))

    edges = [(0, 1), (1, 3), (0, 4)]
    results = []
    for options in combinations(
        1, 30, joints=(0.0, 1.5), velocity=(0.0, 0.7), foot_contact=(0.0, 40.0),
        bone_length=(0.0, 3.0), root_relative=(False, True), velocity_features=(None, 14, 4),
    ):  # fmt: skip
        losses = MotionLosses(to_joints, [1, 2], edges, **options)
        results.append((options, losses(estimate, x, MASK)))
    plain = MotionLosses(to_joints, [1])
    one = MotionLosses(to_joints, [2], velocity=1.0, foot_contact=1.0, joints=1.0)
    return results, plain(estimate, x, MASK), one(estimate, x, MASK), vars(plain)["joints"]


def feet_at_the_limit_of_contact() -> Any:
    speeds = torch.tensor([0.0, 0.005, 0.0099, 0.0101, 0.02, 0.05]).double()
    x = torch.zeros(1, 7, 6).double()
    x[0, 1:, 4] = speeds.cumsum(0)
    x[0, 1:, 3] = speeds.cumsum(0) * 0.02
    estimate = x + numbers(110, 1, 7, 6)
    losses = MotionLosses(lambda x: x.unflatten(-1, (-1, 3)), [1, 0], foot_contact=1.0)
    return losses(estimate, x, MASK[:1]), losses(x, estimate, MASK[:1])


# Batches


def condition(batch: int, tokens: int, seed: int, **options: Any) -> Condition:
    """Random conditions of width 3."""
    mask = length_mask(torch.arange(batch) % (tokens + 1), tokens) if tokens else None
    values = {"token_mask": mask, **options}
    return Condition(numbers(seed, batch, 3), numbers(seed + 1, batch, tokens, 3), **values)


def dropped_conditions() -> Any:
    extras = {
        "prefix": numbers(120, 4, 2, 5), "target": numbers(121, 4, 8, 4),
        "target_mask": torch.tensor([True, False, True, True]),
    }  # fmt: skip
    longer = condition(1, 6, 122, token_mask=torch.tensor([[True] * 4 + [False] * 2]))
    shorter = condition(1, 2, 123, token_mask=torch.tensor([[True, False]]))
    no_mask = condition(1, 4, 124, token_mask=None)
    no_mask.tokens = no_mask.tokens[:, :1]
    drop = torch.tensor([True, False, False, True])
    conditions = [
        condition(4, 4, 125, null=longer), condition(4, 4, 126, null=shorter, **extras),
        condition(4, 4, 127, null=no_mask), condition(4, 4, 128, null=longer, token_mask=None),
        condition(4, 0, 129, null=condition(1, 0, 130), **extras),
        Condition(numbers(1, 4, 0), numbers(1, 4, 2, 0), None, condition(1, 1, 131)),
    ]  # fmt: skip
    single = Condition(conditions[0].pooled.float(), conditions[0].tokens.float(), None, longer)
    return {
        "dropped": [cond.drop(drop) for cond in conditions],
        "with null": [cond.with_null() for cond in conditions],
        "selected": [cond.select(torch.tensor([2, 0, 2])) for cond in conditions],
        "precision": str(single.drop(drop).pooled.dtype),
        "refused": refusal(lambda: condition(4, 2, 132).drop(drop)),
    }


class Shift:
    """A guide that adds numbers."""

    def steer(self, clean: Callable[[Tensor], Tensor], x_t: Tensor) -> Tensor:
        return x_t + 0.1 * clean(x_t)

    def reach(self, x0_hat: Tensor) -> Tensor:
        return x0_hat * 1.5 + 0.25


def edits() -> Any:
    x, keep = numbers(133, 2, 5, 3), numbers(134, 2, 5, 3) > 0
    return {
        "imposed": [Edit(x, keep, guide=guide).impose(x * 2 + 1) for guide in (None, Shift())],
        "steps": [
            [Edit(x, keep, strength=strength).steps(total) for total in (1, 3, 10, 50, 999)]
            for strength in (None, 0.001, 0.25, 0.3333, 0.5, 0.85, 1.0)
        ],
        "defaults": [
            Edit(x, keep).mode, Edit(x, keep).until, Edit(x, keep).blend, Edit(x, keep).resample,
            Edit(x, keep).strength, Edit(x, keep).guide,
        ],
    }  # fmt: skip


def lengths_and_padding() -> Any:
    lengths = torch.tensor([3, 0, 5, 1])
    table = Constant([[1.0, 2.0], [3.0, 5.0]])
    batch = MotionBatch(numbers(136, 4, 5, 2), length_mask(lengths), ["a", "b", "c", "d"])
    with_action = MotionBatch(batch.x, batch.mask, batch.ids, ["w"] * 4, torch.arange(4))
    return {
        "padded": [pad_to(numbers(135, 2, 3, *rest), size) for rest in ((), (2,)) for size in (3,
        6)],
        "padded mask": pad_to(length_mask(torch.tensor([2, 1])), 4),
        "masks": [length_mask(lengths, frames) for frames in (None, 5, 7, 2)],
        "groups": [ceil_div(count, size) for count in (0, 1, 7, 8, 9) for size in (1, 4, 8)],
        "rounded": [
            padded_length(length, multiple, most)
            for length in (1, 7, 8, 9, 40) for multiple in (1, 4, 16) for most in (0, 8, 20)
        ],
        "sent": sent(numbers(137, 3), CPU),
        "constants": [table.on(CPU), table.on(CPU) is table.on(CPU), len(table.tensors)],
        "batches": [batch.to(CPU), with_action.to(CPU), batch.lengths, len(batch),
        len(with_action)],
        "numbers": str(Constant([1, 2]).on(CPU).dtype),
    }  # fmt: skip


def collated_samples() -> Any:
    sets: list[Sequence[tuple[str, Tensor, str | None, int | None]]] = [
        [("a", numbers(140, 4, 3), "walks", 2), ("b", numbers(141, 7, 3), "sits", 0)],
        [("a", numbers(142, 5, 2), None, 3), ("b", numbers(143, 3, 2), "runs", 1), ("c",
        numbers(144, 1, 2), "", 0)],
        [("a", numbers(145, 2, 2), "walks", None), ("b", numbers(146, 6, 2), "jumps", 4)],
    ]  # fmt: skip
    options = ({}, {"multiple": 4}, {"multiple": 5, "most": 8}, {"multiple": 5, "most": 3})
    return [collate(samples, **settings) for samples in sets for settings in options]


CASES = cases_of(globals())


@pytest.mark.parametrize("case", CASES)
def test_results_are_as_recorded(case: Case):
    check(NAME, case)


if __name__ == "__main__":
    record(NAME, CASES)
