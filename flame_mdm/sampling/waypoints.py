"""Guides streams along waypoints on the floor.

The path of the person bends toward the waypoints, while the text determines how the person moves.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from flame_mdm.errors import UserError
from flame_mdm.representations.humanml import HumanML
from flame_mdm.sampling.placement import Placement

Point = tuple[float, float]
"""World coordinates (x, z) in meters."""

# The web page that samples in the browser uses the same numbers and the same loop
# (tools/web/waypoints.js). Distance from the root, in meters, within which a waypoint counts as
# reached
NEAR = 0.3
# Maximum bend in radians per second. If the path bent faster, feet on the floor would visibly
# slide.
FASTEST = 1.3
# Minimum radius of a bend in meters. It keeps a standing person from turning.
TIGHTEST = 0.7
# Radius of the circle within which waypoints are too near, relative to the smallest circle on which
# the person can walk. With a value of 1, a runner would circle around a waypoint, because bends
# begin slowly.
ROOM = 1.2
PATIENCE = 0.4  # time constant, in seconds, with which deviations in direction decay
SMOOTHING = (
    0.3  # weight of a frame in the moving average of steps, which removes the sway of a walk
)
FARTHEST = 1e4  # maximum absolute coordinate of a waypoint in meters


def bends(
    turns: Sequence[float],
    steps: Sequence[Point],
    heading: float,
    position: Point,
    points: Sequence[Point],
    fps: float,
) -> list[float]:
    """Returns the angles (F,) to add to the turns so that the root passes through the waypoints.

    The direction of travel approaches the direction of the next waypoint. The added angle, in
    radians, is limited per second and per meter of the path. If a waypoint is beside the person and
    too near, the path stays straight until there is room for a curve.

    Args:
        turns: (F,) turns of the root from each frame to the next, in radians; turns to the left are
            positive.
        steps: (F, 2) displacements of the root from each frame to the next, in meters: to the left
            of the body, and forward.
        heading: direction of the body in the first frame in radians, as in `Placement.turn`.
        position: position of the root in the first frame, in meters.
        points: positions of the waypoints, in order.
        fps: frames per second.

    Example:
        >>> straight = [0.0] * 20, [(0.0, 0.05)] * 20
        >>> added = bends(*straight, heading=0.0, position=(0.0, 0.0), points=[(3.0, 3.0)], fps=20)
        >>> round(math.degrees(sum(added)))  # to the left, towards +x
        45
    """
    left = list(points)
    x, z = position
    added = []
    side, ahead = steps[0]
    for turn, step in zip(turns, steps, strict=True):
        while left and math.hypot(left[0][0] - x, left[0][1] - z) < NEAR:
            left.pop(0)
        side += SMOOTHING * (step[0] - side)
        ahead += SMOOTHING * (step[1] - ahead)
        travel = heading + math.atan2(side, ahead)
        bend = _bend(travel, math.hypot(side, ahead), (x, z), left[0], fps) if left else 0.0
        added.append(bend)

        sine, cosine = math.sin(heading), math.cos(heading)
        x += cosine * step[0] + sine * step[1]
        z += cosine * step[1] - sine * step[0]
        heading += turn + bend
    return added


def _bend(travel: float, length: float, position: Point, goal: Point, fps: float) -> float:
    """Returns the angle in radians to add in a frame; see `bends`.

    Args:
        travel: direction in which the root moves to the next frame, in radians.
        length: distance that the root moves to the next frame, in meters.
        position: position of the root.
        goal: position of the next waypoint.
        fps: frames per second.
    """
    most = min(FASTEST / fps, length / TIGHTEST)
    off = math.atan2(goal[0] - position[0], goal[1] - position[1]) - travel
    off = math.remainder(off, 2 * math.pi)

    radius = ROOM * max(TIGHTEST, length * fps / FASTEST)
    to_side = travel + math.copysign(math.pi / 2, off)
    center = position[0] + radius * math.sin(to_side), position[1] + radius * math.cos(to_side)
    if math.dist(center, goal) < radius - NEAR / 2:
        return 0.0
    return max(-most, min(most, off / (PATIENCE * fps)))


@dataclass(frozen=True)
class RouteGuide:
    """A `flame_mdm.batch.Guide` that bends the path of a block at each sampling step.

    In the following sampling steps, the denoiser sees the bent path and adapts the rest of the
    motion to it.
    """

    representation: HumanML
    placement: Placement
    points: Sequence[Point]

    def steer(self, clean: Callable[[Tensor], Tensor], x_t: Tensor) -> Tensor:
        """Returns the noisy motion `x_t` unchanged."""
        return x_t

    def reach(self, x0_hat: Tensor) -> Tensor:
        """Returns the clean estimate (1, F, D) with its path bent toward the waypoints."""
        representation, column = self.representation, self.representation.slices["turn"].start
        turns, steps = representation.root_steps(representation.denormalize(x0_hat[0].float()))
        added = bends(
            turns.tolist(),
            steps.tolist(),
            float(self.placement.turn[0]),
            (float(self.placement.shift[0, 0]), float(self.placement.shift[0, 2])),
            self.points,
            representation.fps,
        )
        scale = representation.std[column] * representation.turn_unit
        bent = x0_hat.clone()
        bent[0, :, column] += torch.tensor(added).to(x0_hat) / scale
        return bent


class Route:
    """Waypoints of a stream and the frames in which they were reached.

    Attributes:
        points: all waypoints in order.
        reached: indices of the stream frames in which waypoints were reached, in the order of
            `points`.

    Raises:
        UserError: If a point does not consist of two numbers from -`FARTHEST` to `FARTHEST`.
    """

    def __init__(self, points: Sequence[Sequence[float]] = ()):
        for point in points:
            numbers = [x for x in point if isinstance(x, float | int) and not isinstance(x, bool)]
            if len(point) != 2 or len(numbers) != 2 or not all(abs(x) <= FARTHEST for x in numbers):
                raise UserError(
                    f"waypoint {point}: expected x and z in meters, each from {-FARTHEST:,.0f} to {FARTHEST:,.0f}"
                )
        self.points: list[Point] = [(float(x), float(z)) for x, z in points]
        self.reached: list[int] = []

    @property
    def left(self) -> list[Point]:
        """Waypoints that are still ahead."""
        return self.points[len(self.reached) :]

    def follow(self, begin: int, roots: np.ndarray) -> None:
        """Records the waypoints that the root (F, 3) reaches, starting at the frame `begin`."""
        for frame, (x, _, z) in enumerate(roots, begin):
            while self.left and math.dist(self.left[0], (x, z)) < NEAR:
                self.reached.append(frame)

    def go_back(self, frame: int) -> None:
        """Undoes `follow` for all frames from the given frame on."""
        self.reached = [number for number in self.reached if number < frame]
