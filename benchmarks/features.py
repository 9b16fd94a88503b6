"""Times the encoding and decoding of HumanML3D's features: `python benchmarks/features.py`.

The framework is compared with a NumPy loop over frames and joints.
"""

import time
from collections.abc import Callable

import numpy as np
import torch
from sections import Row, Section, Settings, section, show, take_turns
from torch import Tensor

from flame_mdm.representations import rotation
from flame_mdm.representations.humanml import HumanML
from flame_mdm.representations.skeleton import SMPL22, forward_kinematics

FRAMES, CLIPS = 90, 16
STILL = 0.002  # squared displacement of a foot that is in contact with the floor, in m²


def motion(seed: int) -> Tensor:
    """Returns joint positions (`FRAMES`, 22, 3), in meters, of a body that moves in a circle.

    Args:
        seed: seed for the random bends of the joints.
    """
    rng = torch.Generator().manual_seed(seed)
    phase = torch.linspace(0, 2 * torch.pi, FRAMES, dtype=torch.float64)
    bend = (
        0.2
        * torch.randn(22, 3, generator=rng, dtype=torch.float64)
        * torch.sin(3 * phase)[:, None, None]
    )
    bend[:, 0, 1] = phase
    root = torch.stack([torch.sin(phase), torch.ones_like(phase), torch.cos(phase)], -1)
    offsets = 0.25 * torch.tensor(SMPL22.raw_offsets, dtype=torch.float64)
    return forward_kinematics(SMPL22, rotation.axis_angle_to_matrix(bend), offsets, root)


def arc(rest: np.ndarray, bone: np.ndarray) -> np.ndarray:
    """Returns the smallest rotation (3, 3) that turns a bone from its direction at rest to its current direction.

    Args:
        rest: direction of the bone at rest (3,), of length 1.
        bone: vector along the bone (3,), of any length.
    """
    direction = bone / np.linalg.norm(bone)
    axis, cosine = np.cross(rest, direction), rest @ direction
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + cross + cross @ cross / (1 + cosine)


def loop(joints: np.ndarray, heading: np.ndarray) -> np.ndarray:
    """Computes HumanML3D's features (F - 1, 263), without the errors in the published ones, frame by frame.

    Args:
        joints: joint positions (F, 22, 3) in meters. The motion starts at the origin and faces +z.
        heading: heading of the body in each frame (F,), in radians.
    """
    rest = np.array(SMPL22.raw_offsets, dtype=np.float64)
    bones = list(enumerate(SMPL22.parents[1:], 1))
    rows = []
    for t in range(len(joints) - 1):
        c, s = np.cos(heading[t]), np.sin(heading[t])
        to_body = np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])
        local = [to_body @ (joint - joints[t, 0] * [1, 0, 1]) for joint in joints[t]]
        velocity = [
            to_body @ (after - before)
            for before, after in zip(joints[t], joints[t + 1], strict=True)
        ]
        arcs = [np.eye(3)] + [
            arc(rest[joint], local[joint] - local[parent]) for joint, parent in bones
        ]

        row = [
            heading[t + 1] - heading[t],
            velocity[0][0],
            velocity[0][2],
            joints[t, 0, 1],
            *np.concatenate(local[1:]),
        ]
        for joint, parent in bones:
            row += (arcs[parent].T @ arcs[joint]).T[:2].ravel().tolist()
        row += np.concatenate(velocity).tolist()
        for foot in SMPL22.feet:
            displacement = joints[t + 1, foot] - joints[t, foot]
            row.append(float(displacement @ displacement < STILL))
        rows.append(row)
    return np.array(rows)


def measure(settings: Settings) -> Section:
    """Times the encoding and decoding of features and returns the page section."""
    rounds = 1 if settings.quick else 15
    torch.set_num_threads(1)
    motions = [motion(seed) for seed in range(CLIPS)]
    clean = HumanML()
    legacy = HumanML(variant="legacy", bone_lengths=[0.0] + [0.25] * 21)
    joints, _ = HumanML._canonical(clean, motions[:1])
    heading = HumanML._heading(clean, joints).numpy()
    difference = np.abs(loop(joints.numpy(), heading) - clean.encode(motions[0]).numpy()).max()
    if difference > 1e-5:
        raise SystemExit(
            f"the features from the loop and from the representation differ by {difference:.1e}"
        )

    features = torch.stack(clean.encode_many(motions))
    runs: dict[str, tuple[Callable[[], object], int]] = {
        "encode, loop over frames and joints": (lambda: loop(joints.numpy(), heading), 1),
        "encode clean, one clip": (lambda: clean.encode(motions[0]), 1),
        f"encode clean, {CLIPS} clips": (lambda: clean.encode_many(motions), CLIPS),
        "encode legacy, one clip": (lambda: legacy.encode(motions[0]), 1),
        f"encode legacy, {CLIPS} clips": (lambda: legacy.encode_many(motions), CLIPS),
        f"decode, {CLIPS} clips": (lambda: clean.decode(features), CLIPS),
    }
    times = take_turns(
        {name: turn for name, (turn, _) in runs.items()}, rounds, clock=time.process_time
    )
    rates = {name: runs[name][1] * FRAMES / taken for name, taken in times.items()}

    slow, fast = rates["encode, loop over frames and joints"], rates[f"encode clean, {CLIPS} clips"]
    rows: list[Row] = [
        {"features": name, "frames per second": rate, "ratio": rate / slow}
        for name, rate in rates.items()
    ]
    return section(
        "HumanML3D's features",
        f"""Joint positions are converted to 263 features and back, with {FRAMES} frames per clip on one core. CPU
        times are medians over {rounds} rounds, and ratios are relative to a NumPy loop over frames and
        joints.""",
        f"Features of {CLIPS} clips are computed {fast / slow:.0f} times as fast as in a loop over frames and joints.",
        {"features": rows},
    )


if __name__ == "__main__":
    show(measure(Settings()))
