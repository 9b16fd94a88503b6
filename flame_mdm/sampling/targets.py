# pyright: standard
"""World-space targets: waypoints of the root, joint positions, and poses at given times."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from flame_mdm.batch import Edit
from flame_mdm.errors import UserError, did_you_mean
from flame_mdm.formats.motion import Motion
from flame_mdm.processes.guidance import Positions, reach, steer
from flame_mdm.representations import Representation, rotation
from flame_mdm.sampling.reading import read_motion
from flame_mdm.schemas import ClosedSchema, check_shape, read_json

# Time in seconds over which a correction fades; see docs/targets.md
SMOOTHNESS = 0.2
# Maximum speed, in meters per second, that waypoints may require
MAX_SPEED = 8.0
# Maximum height of a joint above the floor and maximum horizontal distance from the body, in meters
REACH = 2.5
# Maximum number of coordinates of all targets. Every sampling step solves for all of them together.
MAX_COORDINATES = 600
# Coordinate in meters, or None if it is free
Coordinate = Annotated[float, Field(ge=-1e4, le=1e4)] | None
# x and z of a position on the floor
OnFloor = Annotated[Sequence[Coordinate], Field(min_length=2, max_length=2)]


class Timed(ClosedSchema):
    """A target at a given time."""

    time: Annotated[float, Field(ge=0, le=1e4)]  # seconds


class Waypoint(Timed):
    """A position on the floor that the root should reach."""

    position: OnFloor


class JointTarget(Timed):
    """A world position that a joint should reach."""

    position: Annotated[Sequence[Coordinate], Field(min_length=3, max_length=3)]
    joint: str


class PoseTarget(Timed):
    """A frame of a motion file, whose pose should be reached at a given position or anywhere.

    `heading` is in degrees.
    """

    position: OnFloor | None = None
    file: str
    frame: Annotated[int, Field(ge=0)] = 0
    heading: Annotated[float, Field(ge=-1e4, le=1e4)] | None = None


class TargetFile(ClosedSchema):
    """Contents of a JSON file with targets; see docs/targets.md."""

    root: Sequence[Waypoint] = ()
    joints: Sequence[JointTarget] = ()
    poses: Sequence[PoseTarget] = ()


class Goal(NamedTuple):
    """A position (3,) in meters that a joint should reach in a given frame.

    NaN marks a free coordinate. `source` names the target in error messages.
    """

    source: str
    frame: int
    joint: int
    position: np.ndarray


@dataclass(frozen=True)
class PositionGuide:
    """A `flame_mdm.batch.Guide` that leads joints to world positions."""

    # Converts normalized features (..., F, D) to world joint positions (..., F, J, 3)
    to_joints: Callable[[Tensor], Tensor]
    fps: float
    positions: Positions
    # (3, N) frame, parent joint and child joint of each bone whose length is kept
    bones: Tensor
    # (1, F, D) features of the poses, which are always imposed
    poses: Tensor
    # (1, F, D) bool, True if this feature is imposed
    keep: Tensor

    def steer(self, clean: Callable[[Tensor], Tensor], x_t: Tensor) -> Tensor:
        """Returns a version of `x_t` whose clean estimate is closer to the positions."""
        return steer(clean, x_t, self.to_joints, self.positions)

    def reach(self, x0_hat: Tensor) -> Tensor:
        """Returns the clean estimate (B, F, D), changed to reach the positions and keep the poses.

        Frames after the motion, which some models receive as padding, are not changed.
        """
        frames = self.keep.shape[1]
        motion, padding = x0_hat[:, :frames], x0_hat[:, frames:]
        imposed, free = torch.where(self.keep, self.poses, motion), ~self.keep.expand_as(motion)
        reached = reach(
            imposed, self.to_joints, self.positions, self.bones, free, SMOOTHNESS * self.fps
        )
        return torch.cat([reached, padding], dim=1)


@dataclass(frozen=True)
class Targets:
    """Positions and poses that motions should reach."""

    # World coordinates that joints should reach
    positions: Positions
    # (frame, features (D,)) of each pose that may be reached anywhere. The features are not
    # normalized.
    poses: tuple[tuple[int, Tensor], ...]

    def check_end(self, frames: int, fps: float) -> None:
        """Raises `UserError` if a motion with this number of frames ends before a target."""
        last = max([0, *self.positions.frames.tolist(), *(frame for frame, _ in self.poses)])
        if last >= frames:
            raise UserError(
                f"targets: {last / fps:g} seconds is past the end of the motion, whose last frame is at "
                f"{(frames - 1) / fps:g} seconds. Use an earlier time, or a longer motion"
            )

    def window(self, begin: int, frames: int, here: Sequence[float]) -> "Targets":
        """Returns the targets in the window of `frames` frames that starts at `begin`.

        Frames are counted from the beginning of the window. If the root has a target after the
        window, a target is added at the end of the window. This added target is the point that the
        root reaches by then if the root moves toward the later target at a constant speed. This
        movement starts at the root's last target in the window or, if there is none, at `here`.

        Args:
            begin: first frame of the window.
            frames: number of frames in the window.
            here: x and z of the root at the beginning of the window.
        """
        end = begin + frames
        positions, inside = (
            self.positions,
            (self.positions.frames >= begin) & (self.positions.frames < end),
        )
        columns = [
            positions.frames[inside] - begin,
            positions.joints[inside],
            positions.axes[inside],
        ]
        values = positions.values[inside]
        for axis, start in ((0, here[0]), (2, here[1])):
            of_root = (positions.joints == 0) & (positions.axes == axis)
            later = of_root & (positions.frames >= end)
            if not later.any() or (of_root & (positions.frames == end - 1)).any():
                continue
            goal = positions.frames.masked_fill(~later, int(positions.frames.max()) + 1).argmin()
            since = begin - 1
            if (passed := of_root & inside).any():
                last = positions.frames.masked_fill(~passed, -1).argmax()
                since, start = int(positions.frames[last]), float(positions.values[last])
            share = (end - 1 - since) / (int(positions.frames[goal]) - since)
            entry = (frames - 1, 0, axis)
            columns = [
                torch.cat([x, x.new_tensor([value])])
                for x, value in zip(columns, entry, strict=True)
            ]
            between = start + share * (float(positions.values[goal]) - start)
            values = torch.cat([values, values.new_tensor([between])])
        poses = tuple(
            (frame - begin, features) for frame, features in self.poses if begin <= frame < end
        )
        return Targets(Positions(columns[0], columns[1], columns[2], values), poses)

    def edit(
        self,
        representation: Representation,
        frames: int,
        device: torch.device,
        to_joints: Callable[[Tensor], Tensor] | None = None,
    ) -> Edit:
        """Returns the edit (1, F, D) that leads to the targets.

        Poses are imposed, and positions guide the clean estimates. `to_joints` maps normalized
        features to world joint positions. By default, the positions are computed for a motion that
        begins at the origin.
        """
        imposed = torch.zeros(1, frames, representation.features, device=device)
        keep = torch.zeros_like(imposed, dtype=torch.bool)
        for frame, features in self.poses:
            imposed[0, frame] = representation.normalize(features.to(device))
            keep[0, frame] = representation.joint_features(
                range(1, len(representation.skeleton))
            ).to(device)
        positions = Positions(*(x.to(device) for x in vars(self.positions).values()))
        # Joints whose targets are reached by stretching the body, not by moving the root
        stretched = sorted(set(self.positions.frames[self.positions.joints > 0].tolist()))
        edges = [(frame, *edge) for frame in stretched for edge in representation.skeleton.edges]
        bones = torch.tensor(edges, dtype=torch.long, device=device).reshape(-1, 3).T
        to_joints = representation.to_joints if to_joints is None else to_joints
        guide = PositionGuide(to_joints, representation.fps, positions, bones, imposed, keep)
        return Edit(imposed, keep, guide=guide if len(positions.values) else None)


def errors(motion: Motion, targets: Targets) -> np.ndarray:
    """Returns the distance in meters between each target position and the motion.

    Free coordinates are ignored.
    """
    goal = targets.positions
    off = goal.of(torch.from_numpy(motion.joints)) - goal.values
    targeted, index = torch.stack([goal.frames, goal.joints], 1).unique(dim=0, return_inverse=True)
    return torch.zeros(len(targeted)).index_add(0, index, off**2).sqrt().numpy()


def read_targets(representation: Representation, source: str | Path | Mapping[str, Any]) -> Targets:
    """Reads targets from a JSON file or from the contents of such a file; see docs/targets.md.

    Raises:
        UserError: If the targets are invalid.
    """
    if isinstance(source, Mapping):
        name, folder = "targets", Path()
        try:
            content = check_shape(dict(source), TargetFile)
        except ValueError as error:
            raise UserError(f"targets: {error}; see docs/targets.md") from error
    else:
        name, folder = f"targets={source}", Path(source).parent
        content = read_json(Path(source), TargetFile, "see docs/targets.md")
    fps, names = representation.fps, representation.skeleton.joints
    goals: list[Goal] = []
    poses = []
    for number, point in enumerate(content.root):
        x, z = point.position
        position = np.array([x, None, z], dtype=float)
        goals.append(Goal(f"{name}: root[{number}]", round(point.time * fps), 0, position))
    for number, entry in enumerate(content.joints):
        where, frame = f"{name}: joints[{number}]", round(entry.time * fps)
        if entry.joint not in names:
            raise UserError(f"{where}: no joint '{entry.joint}'.{did_you_mean(entry.joint, names)}")
        goals.append(
            Goal(where, frame, names.index(entry.joint), np.array(entry.position, dtype=float))
        )
    for number, entry in enumerate(content.poses):
        where, frame = f"{name}: poses[{number}]", round(entry.time * fps)
        pose, features = _pose(representation, entry, folder, where)
        if entry.position is None:
            poses.append((frame, features))
            goals.append(Goal(where, frame, 0, np.array([math.nan, pose[0, 1], math.nan])))
        else:
            x, z = entry.position
            placed = pose + np.array([x, 0.0, z], dtype=float)
            goals += [Goal(where, frame, joint, position) for joint, position in enumerate(placed)]
    _check_reach(goals, fps)
    positions = np.array([goal.position for goal in goals]).reshape(-1, 3)
    numbers, axes = np.nonzero(~np.isnan(positions))
    if len(numbers) > MAX_COORDINATES:
        raise UserError(
            f"{name}: the targets have {len(numbers)} coordinates. Use at most {MAX_COORDINATES}"
        )
    frames, joints = (
        np.array([(goal.frame, goal.joint) for goal in goals], dtype=int).reshape(-1, 2)[numbers].T
    )
    frames, joints, axes = (torch.from_numpy(index) for index in (frames, joints, axes))
    values = torch.from_numpy(positions[numbers, axes]).float()
    return Targets(Positions(frames, joints, axes, values), tuple(poses))


def _pose(
    representation: Representation, entry: PoseTarget, folder: Path, where: str
) -> tuple[np.ndarray, Tensor]:
    """Returns the joint positions (J, 3) and features (D,) of a pose whose root is at x = z = 0."""
    motion = read_motion(
        representation, folder / entry.file if Path(entry.file).suffix else entry.file
    )
    if entry.frame >= len(motion.joints):
        raise UserError(
            f"{where}.frame={entry.frame}: {entry.file} has frames 0 to {len(motion.joints) - 1}"
        )
    pose = motion.joints[entry.frame].astype(float)
    pose[:, [0, 2]] -= pose[0, [0, 2]]
    if entry.heading is not None:
        right_hip, left_hip, right_shoulder, left_shoulder = pose[
            list(representation.skeleton.facing)
        ]
        left = left_hip - right_hip + left_shoulder - right_shoulder
        turn = torch.tensor(math.radians(entry.heading) - math.atan2(-left[2], left[0]))
        pose = rotation.rotate_y(torch.from_numpy(pose), turn).numpy()
    return pose, torch.from_numpy(motion.features[entry.frame])


def _check_reach(goals: list[Goal], fps: float) -> None:
    before, start, begin = "the start", np.zeros(2), 0
    for goal in sorted(goals, key=lambda goal: goal.frame):
        height, floor = goal.position[1], goal.position[[0, 2]]
        if not (np.isnan(height) or -0.1 <= height <= REACH):
            raise UserError(
                f"{goal.source}: a height of {height:g} m is out of reach. Use 0 to {REACH:g} m above the floor"
            )
        if np.isnan(floor).any():
            continue
        distance, seconds = float(np.linalg.norm(floor - start)), (goal.frame - begin) / fps
        if distance > MAX_SPEED * seconds + REACH:
            raise UserError(
                f"{goal.source}: {distance:.1f} m from {before} in {seconds:g} seconds is too far. Use a later time "
                "or a nearer position"
            )
        before, start, begin = goal.source, floor, goal.frame
