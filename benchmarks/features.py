"""Speed of HumanML3D's features on one core, compared to a loop over frames and joints.

Run with `python benchmarks/features.py [rounds]`.
"""

import statistics
import sys
import time
from collections.abc import Callable

import numpy as np
import torch
from sections import Section, section, show
from torch import Tensor

from flame_mdm.representations import rotation
from flame_mdm.representations.humanml import HumanML
from flame_mdm.representations.skeleton import SMPL22, forward_kinematics

FRAMES, CLIPS = 90, 16


def motion(seed: int) -> Tensor:
    """Returns joints (FRAMES, 22, 3) in meters of a body that bends its joints while moving in a circle."""
    rng = torch.Generator().manual_seed(seed)
    time = torch.linspace(0, 2 * torch.pi, FRAMES, dtype=torch.float64)
    bend = 0.2 * torch.randn(22, 3, generator=rng, dtype=torch.float64) * torch.sin(3 * time)[:, None, None]
    bend[:, 0, 1] = time
    root = torch.stack([torch.sin(time), torch.ones_like(time), torch.cos(time)], -1)
    offsets = 0.25 * torch.tensor(SMPL22.raw_offsets, dtype=torch.float64)
    return forward_kinematics(SMPL22, rotation.axis_angle_to_matrix(bend), offsets, root)


def loop(joints: np.ndarray, heading: np.ndarray) -> np.ndarray:
    """Computes clean features of canonical joints with known headings, one frame and one joint at a time."""
    rest = np.array(SMPL22.raw_offsets, dtype=np.float64)
    rows = []
    for t in range(len(joints) - 1):
        c, s = np.cos(heading[t]), np.sin(heading[t])
        to_body = np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])
        local = [to_body @ (joint - joints[t, 0] * [1, 0, 1]) for joint in joints[t]]
        velocity = [to_body @ (after - before) for before, after in zip(joints[t], joints[t + 1], strict=True)]
        arcs = [np.eye(3)]
        for joint, parent in enumerate(SMPL22.parents[1:], 1):
            bone = local[joint] - local[parent]
            axis = np.cross(rest[joint], bone / np.linalg.norm(bone))
            cosine = rest[joint] @ bone / np.linalg.norm(bone)
            cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
            arcs.append(np.eye(3) + cross + cross @ cross / (1 + cosine))
        row = [heading[t + 1] - heading[t], velocity[0][0], velocity[0][2], joints[t, 0, 1], *np.concatenate(local[1:])]
        for joint, parent in enumerate(SMPL22.parents[1:], 1):
            row += (arcs[parent].T @ arcs[joint]).T[:2].ravel().tolist()
        row += np.concatenate(velocity).tolist()
        row += [float(v @ v < 0.002) for v in (joints[t + 1, foot] - joints[t, foot] for foot in SMPL22.feet)]
        rows.append(row)
    return np.array(rows)


def rate(run: Callable[[], object], frames: int, rounds: int) -> float:
    """Returns the median frames per second of processor time, which excludes other programs on the machine."""
    run()
    seconds = []
    for _ in range(rounds):
        start = time.process_time()
        run()
        seconds.append(time.process_time() - start)
    return frames / statistics.median(seconds)


def measure(*words: str) -> Section:
    """Measures with the number of rounds in `words`."""
    rounds = int(words[0]) if words else 15
    torch.set_num_threads(1)
    motions = [motion(seed) for seed in range(CLIPS)]
    clean = HumanML()
    legacy = HumanML(variant="legacy", bone_lengths=[0.0] + [0.25] * 21)
    joints = clean.canonicalize(motions[0])
    heading = clean._heading(joints).numpy()
    difference = np.abs(loop(joints.numpy(), heading) - clean.encode(motions[0]).numpy()).max()
    if difference > 1e-5:
        raise SystemExit(f"the features of the loop and of the representation differ by {difference:.1e}")
    features = torch.stack(clean.encode_many(motions))
    runs: dict[str, tuple[Callable[[], object], int]] = {
        "encode, loop over frames and joints": (lambda: loop(joints.numpy(), heading), FRAMES),
        "encode clean, one clip": (lambda: clean.encode(motions[0]), FRAMES),
        f"encode clean, {CLIPS} clips": (lambda: clean.encode_many(motions), CLIPS * FRAMES),
        "encode legacy, one clip": (lambda: legacy.encode(motions[0]), FRAMES),
        f"encode legacy, {CLIPS} clips": (lambda: legacy.encode_many(motions), CLIPS * FRAMES),
        f"decode, {CLIPS} clips": (lambda: clean.decode(features), CLIPS * FRAMES),
    }
    rates = {name: rate(run, frames, rounds) for name, (run, frames) in runs.items()}
    slow, _, fast, *_ = rates.values()
    return section(
        "HumanML3D's features",
        f"Joint positions to 263 features and back, {FRAMES} frames per clip, one core, median of {rounds} rounds of "
        "processor time, compared to a loop over frames and joints in NumPy.",
        f"Features of {CLIPS} clips are computed {fast / slow:.0f} times as fast as in a loop over frames and joints.",
        features=[{"what": k, "frames per second": v, "ratio": v / slow} for k, v in rates.items()],
    )


if __name__ == "__main__":
    show(measure(*sys.argv[1:]))
