"""`Body`: a motion with a normalized frame rate and size, for measuring claims."""

from functools import cached_property

import numpy as np
from scipy.ndimage import gaussian_filter1d, minimum_filter1d

from flame_mdm.errors import UserError
from flame_mdm.formats.resampling import resample
from flame_mdm.representations.skeleton import JOINT

# Frames per second at which motions are measured
RATE = 30.0
# Standard deviation, in seconds, of the filter that smooths motions over time
SMOOTHING = 0.05
# Leg length from hip to ankle, in meters, to which bodies are scaled
LEG = 0.8
# Length, in seconds, of a window in which the lowest foot must touch the floor. Jumps are shorter.
FLOOR_WINDOW = 1.6


def pair(name: str) -> list[int]:
    """Returns the indices of a pair of joints: "wrist" means left_wrist and right_wrist."""
    return [JOINT[f"left_{name}"], JOINT[f"right_{name}"]]


PELVIS, NECK, HEAD, CHEST = (JOINT[name] for name in ("pelvis", "neck", "head", "spine3"))
HIPS, KNEES, ANKLES, TOES = (pair(name) for name in ("hip", "knee", "ankle", "foot"))
SHOULDERS, ELBOWS, WRISTS = (pair(name) for name in ("shoulder", "elbow", "wrist"))


class Body:
    """A motion that was resampled, smoothed and scaled for measurement.

    The frame rate is `RATE`, and the legs are `LEG` meters long. All distances are measured on the
    scaled body, in meters. Body coordinates have the axes left, up and forward, relative to the
    heading of the body; their origin is the point on the floor below the pelvis.

    Args:
        joints: (F, 22, 3) positions of SMPL's joints in meters, with y up.
        fps: frames per second.

    Raises:
        UserError: If `joints` has the wrong shape or contains NaN, or if the legs have length 0.
    """

    def __init__(self, joints: np.ndarray, fps: float):
        joints = np.asarray(joints, np.float64)
        if joints.ndim != 3 or joints.shape[1:] != (22, 3) or not len(joints):
            raise UserError(
                f"joints have shape {joints.shape}. The referee requires shape (frames, 22, 3)"
            )
        if not np.isfinite(joints).all():
            raise UserError("joints contain NaN or infinity. Did the model diverge?")
        thigh = np.linalg.norm(joints[:, KNEES] - joints[:, HIPS], axis=-1)
        shin = np.linalg.norm(joints[:, ANKLES] - joints[:, KNEES], axis=-1)
        leg = float(np.median(thigh + shin))
        if leg < 1e-3:
            raise UserError("the legs have length 0. The referee requires positions in meters")
        if len(joints) > 1:
            joints = resample(joints, fps, RATE, cubic=len(joints) > 3)
        self.scale = LEG / leg
        self.joints = gaussian_filter1d(
            joints * self.scale, SMOOTHING * RATE, axis=0, mode="nearest"
        )

    def __len__(self) -> int:
        return len(self.joints)

    @property
    def seconds(self) -> float:
        return len(self) / RATE

    @cached_property
    def floor(self) -> np.ndarray:
        """Height (F,) of the floor in meters: the height of the lowest joint within `FLOOR_WINDOW`.

        The height may change during a motion, because floors may have steps.
        """
        lowest = self.joints[..., 1].min(1)
        return minimum_filter1d(lowest, max(1, round(FLOOR_WINDOW * RATE)), mode="nearest")

    @cached_property
    def height(self) -> np.ndarray:
        """Heights (F, 22) of all joints above the floor, in meters."""
        return self.joints[..., 1] - self.floor[:, None]

    @cached_property
    def forward(self) -> np.ndarray:
        """Direction (F, 2) that the body faces, as x and z, based on the hips and shoulders."""
        across = self.joints[:, HIPS[0]] - self.joints[:, HIPS[1]]
        across = across + self.joints[:, SHOULDERS[0]] - self.joints[:, SHOULDERS[1]]
        left = gaussian_filter1d(across[:, [0, 2]], 0.1 * RATE, axis=0, mode="nearest")
        left = left / np.maximum(np.linalg.norm(left, axis=-1, keepdims=True), 1e-9)
        return np.stack([-left[:, 1], left[:, 0]], -1)

    @property
    def left(self) -> np.ndarray:
        """Direction (F, 2) to the left of the body."""
        return np.stack([self.forward[:, 1], -self.forward[:, 0]], -1)

    @cached_property
    def yaw(self) -> np.ndarray:
        """Heading (F,) in degrees, unwrapped.

        Turns to the left are positive.
        """
        return np.degrees(np.unwrap(np.arctan2(self.forward[:, 0], self.forward[:, 1])))

    @cached_property
    def seen(self) -> np.ndarray:
        """Joint positions (F, 22, 3) in body coordinates: left, up, forward."""
        offset = (self.joints - self.joints[:, [PELVIS]])[..., [0, 2]]
        aside = (offset * self.left[:, None]).sum(-1)
        ahead = (offset * self.forward[:, None]).sum(-1)
        return np.stack([aside, self.height, ahead], -1)

    @cached_property
    def velocity(self) -> np.ndarray:
        """Leftward and forward velocity (F, 2) of the pelvis, in m/s.

        The sway of individual steps is filtered out.
        """
        ground = gaussian_filter1d(
            self.joints[:, PELVIS][:, [0, 2]], 0.15 * RATE, axis=0, mode="nearest"
        )
        step = rate_of(ground)
        return np.stack([(step * self.left).sum(-1), (step * self.forward).sum(-1)], -1)

    @cached_property
    def speed(self) -> np.ndarray:
        """Horizontal speed (F,) of the pelvis, in m/s."""
        return np.linalg.norm(self.velocity, axis=-1)

    @cached_property
    def tilt(self) -> np.ndarray:
        """Angle (F,) between the trunk and the vertical, in degrees."""
        trunk = self.joints[:, NECK] - self.joints[:, PELVIS]
        return np.degrees(np.arctan2(np.linalg.norm(trunk[:, [0, 2]], axis=-1), trunk[:, 1]))

    @cached_property
    def hand_speed(self) -> np.ndarray:
        """Speed (F, 2) of the wrists relative to the chest in body coordinates, in m/s."""
        hands = self.seen[:, WRISTS] - self.seen[:, [CHEST]]
        return np.linalg.norm(rate_of(hands), axis=-1)

    @cached_property
    def foot_speed(self) -> np.ndarray:
        """Speed (F, 2) of the ankles relative to the pelvis in body coordinates, in m/s."""
        feet = self.seen[:, ANKLES] - self.seen[:, [PELVIS]]
        return np.linalg.norm(rate_of(feet), axis=-1)

    @cached_property
    def reach(self) -> float:
        """Arm length from shoulder to wrist, in meters."""
        upper = np.linalg.norm(self.joints[:, ELBOWS] - self.joints[:, SHOULDERS], axis=-1)
        fore = np.linalg.norm(self.joints[:, WRISTS] - self.joints[:, ELBOWS], axis=-1)
        return float(np.median(upper + fore))


def rate_of(values: np.ndarray) -> np.ndarray:
    """Returns the rate of change of values (F, ...) per second."""
    if len(values) < 2:
        return np.zeros_like(values)
    return np.gradient(values, 1 / RATE, axis=0)
