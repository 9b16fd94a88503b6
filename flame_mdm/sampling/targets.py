"""Targets in the world: way points of the root, joint positions, and whole poses at given times."""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from flame_mdm.batch import Edit
from flame_mdm.errors import UserError, did_you_mean
from flame_mdm.formats.motion import Motion
from flame_mdm.processes.guidance import Positions, reach, steer
from flame_mdm.representations import Representation, rotation
from flame_mdm.safe_io import MEBIBYTE, read_text
from flame_mdm.sampling.reading import read_motion

SMOOTHNESS = 0.2  # seconds over which a correction fades; see docs/targets.md
MAX_SPEED = 8.0  # meters per second that way points may require
REACH = 2.5  # maximum height of a joint above the floor, and its maximum distance from where the body stands, in meters
MAX_COORDINATES = 600  # maximum number of coordinates; they are solved for together in every step
KEYS = {
    "root": ({"time", "position"}, set[str]()),
    "joints": ({"time", "joint", "position"}, set[str]()),
    "poses": ({"time", "file"}, {"frame", "position", "heading"}),
}
"""Kinds of targets, with the keys that each entry must have and those that it may have."""


class Goal(NamedTuple):
    """A position (3,) in meters that a joint should have in a frame, NaN = free; `source` names it in messages."""

    source: str
    frame: int
    joint: int
    position: np.ndarray


@dataclass(frozen=True)
class PositionGuide:
    """Leads motions to positions in the world; a `flame_mdm.batch.Guide`."""

    representation: Representation  # decodes motions as joints
    positions: Positions  # the goal
    bones: Tensor  # (3, N) frame, parent and child of the bones that keep their lengths
    poses: Tensor  # (1, F, D) features that are imposed in any case
    keep: Tensor  # and where

    def steer(self, clean: Callable[[Tensor], Tensor], x_t: Tensor) -> Tensor:
        return steer(clean, x_t, self.representation.to_joints, self.positions)

    def reach(self, x0_hat: Tensor) -> Tensor:
        imposed, free = torch.where(self.keep, self.poses, x0_hat), ~self.keep.expand_as(x0_hat)
        sigma = SMOOTHNESS * self.representation.fps
        return reach(imposed, self.representation.to_joints, self.positions, self.bones, free, sigma)


@dataclass(frozen=True)
class Targets:
    """What motions should reach."""

    positions: Positions  # coordinates in the world
    # frames and features (D,), in the data's units, of poses that may be anywhere on the floor
    poses: tuple[tuple[int, Tensor], ...]

    def edit(self, representation: Representation, lengths: Sequence[int], device: torch.device) -> Edit:
        """Returns the edit of motions of these lengths: poses are imposed, positions guide the clean estimates."""
        last = max([0, *self.positions.frames.tolist(), *(frame for frame, _ in self.poses)])
        if last >= min(lengths):
            fps = representation.fps
            raise UserError(
                f"targets: {last / fps:g} seconds is after the end of the motion, whose last frame is at "
                f"{(min(lengths) - 1) / fps:g} seconds. Give an earlier time, or more seconds"
            )
        imposed = torch.zeros(1, max(lengths), representation.features, device=device)
        keep = torch.zeros_like(imposed, dtype=torch.bool)
        for frame, features in self.poses:
            imposed[0, frame] = representation.normalize(features.to(device))
            keep[0, frame] = representation.joint_features(range(1, len(representation.skeleton))).to(device)
        positions = Positions(*(x.to(device) for x in vars(self.positions).values()))
        stretched = sorted(set(self.positions.frames[self.positions.joints > 0].tolist()))  # not by moving the root
        edges = [(frame, *edge) for frame in stretched for edge in representation.skeleton.edges]
        bones = torch.tensor(edges, dtype=torch.long, device=device).reshape(-1, 3).T
        guide = PositionGuide(representation, positions, bones, imposed, keep)
        return Edit(imposed, keep, guide=guide if len(positions.values) else None)


def errors(motion: Motion, targets: Targets) -> np.ndarray:
    """Returns the distance in meters of a motion from each target position, along the coordinates that are not free."""
    goal = targets.positions
    off = goal.of(torch.from_numpy(motion.joints)) - goal.values
    targeted, index = torch.stack([goal.frames, goal.joints], 1).unique(dim=0, return_inverse=True)
    return torch.zeros(len(targeted)).index_add(0, index, off**2).sqrt().numpy()


def read_targets(representation: Representation, source: str | Path | Mapping[str, Any]) -> Targets:
    """Reads targets from a JSON file, or from its content (docs/targets.md); raises `UserError` if they are invalid."""
    name, folder = ("targets", Path()) if isinstance(source, Mapping) else (f"targets={source}", Path(source).parent)
    content = source if isinstance(source, Mapping) else _read(source, name)
    if not isinstance(content, Mapping) or not content:
        raise UserError(f"{name}: give an object with {', '.join(KEYS)}, each a list. See docs/targets.md")
    if unknown := [str(key) for key in content if key not in KEYS]:
        raise UserError(f"{name}: unknown key '{unknown[0]}'.{did_you_mean(unknown[0], KEYS)} Use {', '.join(KEYS)}")
    goals: list[Goal] = []
    poses = []
    for kind, entries in content.items():
        if not isinstance(entries, list | tuple):
            raise UserError(f"{name}: {kind} is {entries}, not a list. See docs/targets.md")
        for number, entry in enumerate(entries):
            where = f"{name}: {kind}[{number}]"
            frame = _frame(kind, entry, where, representation.fps)
            if kind == "root":
                x, z = _numbers(entry, "position", where, 2)
                goals.append(Goal(where, frame, 0, np.array([x, math.nan, z])))
            elif kind == "joints":
                joint = _joint(representation, entry["joint"], where)
                goals.append(Goal(where, frame, joint, np.array(_numbers(entry, "position", where, 3))))
            elif entry.get("position") is None:
                pose, features = _pose(representation, entry, folder, where)
                poses.append((frame, features))
                goals.append(Goal(where, frame, 0, np.array([math.nan, pose[0, 1], math.nan])))
            else:
                x, z = _numbers(entry, "position", where, 2)
                pose = _pose(representation, entry, folder, where)[0] + np.array([x, 0.0, z])
                goals += [Goal(where, frame, joint, position) for joint, position in enumerate(pose)]
    _check_reach(goals, representation.fps)
    rows = [
        (goal.frame, goal.joint, axis, float(goal.position[axis]))
        for goal in goals
        for axis in np.flatnonzero(~np.isnan(goal.position)).tolist()
    ]
    if len(rows) > MAX_COORDINATES:
        raise UserError(f"{name}: {len(rows)} coordinates are too many. Give at most {MAX_COORDINATES}")
    frames, joints, axes = torch.tensor([row[:3] for row in rows], dtype=torch.long).reshape(-1, 3).T
    return Targets(Positions(frames, joints, axes, torch.tensor([row[3] for row in rows])), tuple(poses))


def _frame(kind: str, entry: Any, where: str, fps: float) -> int:
    needed, possible = KEYS[kind]
    if not isinstance(entry, Mapping) or not needed <= entry.keys() <= needed | possible:
        optional = f", and possibly {', '.join(sorted(possible))}" if possible else ""
        raise UserError(f"{where} is {entry}. Give an object with {', '.join(sorted(needed))}{optional}")
    (time,) = _numbers(entry, "time", where)
    if not time >= 0:
        raise UserError(f"{where}.time={entry['time']}: give seconds from the start of the motion")
    return round(time * fps)


def _read(source: str | Path, name: str) -> Any:
    try:
        return json.loads(read_text(source, MEBIBYTE))
    except FileNotFoundError:
        raise UserError(f"{name}: no such file. Give a JSON file of targets, see docs/targets.md") from None
    except json.JSONDecodeError as error:
        raise UserError(f"{name}: not JSON: {error}") from None


def _numbers(entry: Mapping[str, Any], key: str, where: str, count: int = 1) -> list[float]:
    listed = entry[key] if isinstance(entry[key], list | tuple) else [entry[key]]
    values = [math.nan if value is None else value for value in listed]
    if len(values) != count or not all(isinstance(v, int | float) and not abs(v) > 1e4 for v in values):
        numbers = f"{count} numbers in meters, null = free" if count > 1 else "a number"
        raise UserError(f"{where}.{key}={entry[key]!r}: give {numbers}")
    return values


def _joint(representation: Representation, name: Any, where: str) -> int:
    joints = representation.skeleton.joints
    if name not in joints:
        raise UserError(f"{where}: no joint '{name}'.{did_you_mean(str(name), joints)} Joints: {', '.join(joints)}")
    return joints.index(name)


def _pose(
    representation: Representation, entry: Mapping[str, Any], folder: Path, where: str
) -> tuple[np.ndarray, Tensor]:
    """Returns joints (J, 3) of a pose with the root at x = z = 0, and its features (D,)."""
    file = str(entry["file"])
    motion = read_motion(representation, folder / file if Path(file).suffix else file)
    number = entry.get("frame", 0)
    if type(number) is not int or not 0 <= number < len(motion.joints):
        raise UserError(f"{where}.frame={number}: {file} has frames 0 to {len(motion.joints) - 1}")
    pose = motion.joints[number].astype(float)
    pose[:, [0, 2]] -= pose[0, [0, 2]]
    if entry.get("heading") is not None:
        (degrees,) = _numbers(entry, "heading", where)
        right_hip, left_hip, right_shoulder, left_shoulder = pose[list(representation.skeleton.facing)]
        left = left_hip - right_hip + left_shoulder - right_shoulder
        turn = torch.tensor(math.radians(degrees) - math.atan2(-left[2], left[0]))
        pose = rotation.rotate_y(torch.from_numpy(pose), turn).numpy()
    return pose, torch.from_numpy(motion.features[number])


def _check_reach(goals: list[Goal], fps: float) -> None:
    before, start, begin = "the start", np.zeros(2), 0
    for goal in sorted(goals, key=lambda goal: goal.frame):
        height, floor = goal.position[1], goal.position[[0, 2]]
        if not (np.isnan(height) or -0.1 <= height <= REACH):
            impossible = f"height {height:g} m is impossible. Give 0 to {REACH:g} meters above the floor"
            raise UserError(f"{goal.source}: {impossible}")
        if np.isnan(floor).any():
            continue
        distance, seconds = float(np.linalg.norm(floor - start)), (goal.frame - begin) / fps
        if distance > MAX_SPEED * seconds + REACH:
            raise UserError(
                f"{goal.source}: {distance:.1f} m from {before} in {seconds:g} seconds is impossible. Give more time, "
                f"or a nearer position: people run at most {MAX_SPEED:g} m/s"
            )
        before, start, begin = goal.source, floor, goal.frame
