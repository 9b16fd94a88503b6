"""Motions relative to a root on the floor, with feet that stay where they are planted.

In game engines, a root on the floor moves the character, and the rest of the motion is played
relative to this root. Motions are cut in this representation, so that the last pose of one clip can
be the first pose of the next. Afterward, the path of the root is added back, and inverse kinematics
keeps each foot in place while it is on the floor.

Arrays contain the positions of the 22 SMPL joints in F frames, in meters, with y up. Angles are in
radians; positive angles turn to the left.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import binary_closing, binary_opening, gaussian_filter1d, maximum_filter1d

from flame_mdm.formats.cleanup import REACH, bend
from flame_mdm.representations.skeleton import JOINT, SMPL22

# Seconds over which the path of the root is smoothed, so that it does not follow individual steps
SMOOTHNESS = 0.15
# A toe counts as in contact up to this height, in meters, above its lowest position
LOW = 0.05
# Maximum horizontal speed of a planted toe in m/s
SLOW = 0.25
# Contacts and gaps between contacts are ignored if they are shorter than this many seconds
SHORT = 0.1
# Seconds over which the body is lowered if a leg is too short
LOWERING = 0.2
# Number of repetitions of a loop in which toes are planted together, so that the middle repetition
# has neighbors on both sides
COPIES = 3
FEET = tuple(
    tuple(JOINT[f"{side}_{name}"] for name in ("hip", "knee", "ankle", "foot"))
    for side in ("left", "right")
)
"""Joints of the legs. The left leg is first."""


@dataclass(frozen=True, eq=False)
class GroundedMotion:
    """A motion, stored as the path of a root on the floor and the joints relative to this root.

    Attributes:
        local: (F, 22, 3), joint positions relative to the root, which faces +z.
        path: (F, 2), x and z coordinates of the root.
        heading: (F,), direction of the root; 0 = facing +z.
        contacts: (F, 2), whether the left and right toes are planted.
        fps: frames per second.
    """

    local: np.ndarray
    path: np.ndarray
    heading: np.ndarray
    contacts: np.ndarray
    fps: float

    def __len__(self) -> int:
        return len(self.local)

    def world(self) -> np.ndarray:
        """Returns the world joint positions (F, 22, 3)."""
        joints = turned(self.local, self.heading[:, None])
        joints[..., [0, 2]] += self.path[:, None]
        return joints

    def with_world(self, joints: np.ndarray) -> "GroundedMotion":
        """Returns the motion with the same root, but with new world joint positions (F, 22, 3)."""
        local = joints.copy()
        local[..., [0, 2]] -= self.path[:, None]
        return replace(self, local=turned(local, -self.heading[:, None]))

    def cut(self, first: int, last: int) -> "GroundedMotion":
        """Returns the frames from `first` to `last` (inclusive).

        The root begins at the origin and faces +z.
        """
        frames = slice(first, last + 1)
        start, heading = self.path[first], self.heading[first]
        away = np.zeros((last + 1 - first, 3))
        away[:, [0, 2]] = self.path[frames] - start
        path = turned(away, -heading)[:, [0, 2]]
        return GroundedMotion(
            self.local[frames].copy(),
            path,
            self.heading[frames] - heading,
            self.contacts[frames].copy(),
            self.fps,
        )


def turned(points: np.ndarray, angles: np.ndarray | float) -> np.ndarray:
    """Rotates points (..., 3) about the vertical axis by angles (...)."""
    cosine, sine = np.cos(angles), np.sin(angles)
    x, y, z = np.moveaxis(points, -1, 0)
    return np.stack([cosine * x + sine * z, y + 0 * cosine, cosine * z - sine * x], -1)


def facing(joints: np.ndarray) -> np.ndarray:
    """Returns the direction in which the hips and shoulders face, as unwrapped angles (F,)."""
    right_hip, left_hip, right_shoulder, left_shoulder = (
        joints[:, joint] for joint in SMPL22.facing
    )
    left = left_hip - right_hip + left_shoulder - right_shoulder
    return np.unwrap(np.arctan2(-left[:, 2], left[:, 0]))


def grounded(joints: np.ndarray, fps: float) -> GroundedMotion:
    """Adds a root on the floor, beneath the pelvis, to joint positions (F, 22, 3).

    The path and the direction of the root are smoothed over time.
    """
    # The root is the pelvis, projected onto the floor and smoothed in time. In an engine, the sway
    # of a walk belongs to the pose, not to the path.
    joints = joints.astype(float)
    frames = SMOOTHNESS * fps
    path = gaussian_filter1d(joints[:, 0][:, [0, 2]], frames, axis=0, mode="nearest")
    heading = gaussian_filter1d(facing(joints), frames, mode="nearest")
    motion = GroundedMotion(joints, path, heading, planted_toes(joints, fps), fps)
    return motion.with_world(joints)


def planted_toes(joints: np.ndarray, fps: float) -> np.ndarray:
    """Returns whether the left and right toes are planted, with shape (F, 2).

    The result is based on the height and speed of the toes.
    """
    # A toe is planted in a frame if it is low, and slow before or after the frame. Gaps and
    # contacts shorter than `SHORT` are removed.
    toes = joints[:, [leg[-1] for leg in FEET]]
    steps = np.linalg.norm(np.diff(toes[..., [0, 2]], axis=0), axis=-1) * fps
    steps = np.concatenate([steps[:1], steps, steps[-1:]])
    speed = np.minimum(steps[:-1], steps[1:])
    floor = np.percentile(toes[..., 1].min(1), 10)
    contacts = (speed < SLOW) & (toes[..., 1] < floor + LOW)
    span = np.ones((max(2, round(SHORT * fps)), 1))
    padding = len(span)
    padded = np.pad(contacts, ((padding, padding), (0, 0)), mode="edge")
    filtered = binary_opening(binary_closing(padded, span), span)
    return filtered[padding:-padding]


def anchored(
    motion: GroundedMotion, pose: np.ndarray, seconds: float, *, at_end: bool
) -> GroundedMotion:
    """Replaces the first or last pose of a motion and fades the change out over `seconds`.

    `pose` (22, 3) is relative to the root. Bones keep their lengths.
    """
    # The difference from the pose is added with a weight that falls smoothly from 1 to 0: 3 w^2 - 2
    # w^3.
    frames = np.arange(len(motion)) / max(1.0, min(seconds * motion.fps, len(motion) - 1))
    share = np.clip(1 - (frames[::-1] if at_end else frames), 0, 1)
    weight = share**2 * (3 - 2 * share)
    change = pose - motion.local[-1 if at_end else 0]
    local = motion.local + weight[:, None, None] * change
    return replace(motion, local=with_lengths(local, pose))


def with_lengths(joints: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Returns a copy of the joints (F, 22, 3) with the bone lengths of a pose (22, 3).

    The bones keep their directions.
    """
    out = joints.copy()
    for parent, joint in SMPL22.edges:
        bone = joints[:, joint] - joints[:, parent]
        length = np.linalg.norm(pose[joint] - pose[parent])
        out[:, joint] = out[:, parent] + bone * length / np.maximum(
            np.linalg.norm(bone, axis=-1, keepdims=True), 1e-9
        )
    return out


def runs(flags: np.ndarray) -> list[tuple[int, int]]:
    """Returns the first and last frames of each series of True values in `flags` (F,)."""
    edges = np.flatnonzero(np.diff(np.r_[0, flags.astype(int), 0]))
    return [(begin, end - 1) for begin, end in edges.reshape(-1, 2).tolist()]


def planted(
    motion: GroundedMotion, *, fixed_start: bool = False, fixed_end: bool = False
) -> GroundedMotion:
    """Returns a copy of the motion in which the toes stay in place during contacts.

    The toes also stay above the floor. If a leg is too short to reach its footprint, the body is
    lowered. With `fixed_start`, the first pose does not change; with `fixed_end`, the last pose
    does not change. A foot that is planted in such a fixed pose keeps its position from this pose.
    """
    # Each toe is moved to one footprint per contact. If a leg is too short for its footprint, the
    # whole body is lowered smoothly for a moment. Then the legs bend to reach the footprints.
    world = motion.world()
    near = round(SHORT * motion.fps)
    shifts = [
        _shift(world[:, leg[-1]], flags, fixed_start, fixed_end, near)
        for leg, flags in zip(FEET, motion.contacts.T, strict=True)
    ]
    # A blend of two standing poses may be lower than both. A fixed pose keeps its height.
    fixed = [0] * fixed_start + [-1] * fixed_end
    for leg, shift in zip(FEET, shifts, strict=True):
        height = world[:, leg[-1], 1]
        shift[:, 1] = np.maximum(min([0.0, *height[fixed]]) - height, 0)
    lack = np.max(
        [_lack(world, leg, shift) for leg, shift in zip(FEET, shifts, strict=True)], axis=0
    )
    if lack.any():
        width = LOWERING * motion.fps
        drop = gaussian_filter1d(
            maximum_filter1d(lack, 2 * round(width) + 1), width / 2, mode="nearest"
        )
        frames = np.arange(len(motion))
        if fixed_start:
            drop *= np.clip(frames / width, 0, 1)
        if fixed_end:
            drop *= np.clip(frames[::-1] / width, 0, 1)
        world[..., 1] -= drop[:, None]
        for shift in shifts:
            shift[:, 1] += drop
    for leg, shift in zip(FEET, shifts, strict=True):
        bend(world, leg, shift)
    return motion.with_world(world)


def _lack(world: np.ndarray, leg: tuple[int, ...], shift: np.ndarray) -> np.ndarray:
    """Returns how far (F,) a hip must be lowered so that its foot can move by `shift` (F, 3)."""
    # The hip may be anywhere in a sphere around the ankle. The radius of the sphere is the length
    # of the straight leg, or the distance from hip to ankle in the motion if this distance is
    # longer. `highest` is the height of the sphere above the hip's position on the floor.
    hip, knee, ankle = (world[:, joint] for joint in leg[:3])
    length = np.linalg.norm(knee - hip, axis=1) + np.linalg.norm(ankle - knee, axis=1)
    reach = np.maximum(REACH * length, np.linalg.norm(ankle - hip, axis=1))
    x, height, z = (hip - ankle - shift).T
    highest = np.sqrt(np.maximum(reach**2 - x**2 - z**2, 0))
    return np.maximum(height - highest, 0)


def _shift(
    toe: np.ndarray, flags: np.ndarray, fixed_start: bool, fixed_end: bool, near: int
) -> np.ndarray:
    """Returns the horizontal displacements (F, 3) that keep a toe (F, 3) in place during contacts.

    The displacements change smoothly from one contact to the next.
    """
    # Within a contact, the shift moves the toe to its mean position, or to its position in a fixed
    # pose. Between contacts, one shift is blended into the next. If a contact begins or ends fewer
    # than `near` frames from a fixed pose, there is no time to move the toe. The toe then stays at
    # its position in that pose.
    last = len(toe) - 1
    floor = np.array([1.0, 0.0, 1.0])
    frames, shifts = [], []
    if fixed_start and not flags[0]:
        frames, shifts = [0], [np.zeros(3)]
    for begin, end in runs(flags):
        at_start, at_end = fixed_start and begin < near, fixed_end and last - end < near
        footprint = toe[begin : end + 1].mean(0)
        if at_start or at_end:
            footprint = toe[begin] if at_start else toe[end]
        target = np.tile(footprint, (end + 1 - begin, 1))
        if at_start and at_end:  # the toe cannot stay in place between two given poses
            target = np.linspace(toe[begin], toe[end], len(target))
        frames += range(begin, end + 1)
        shifts += list((target - toe[begin : end + 1]) * floor)
    if fixed_end and not flags[last]:
        frames.append(last)
        shifts.append(np.zeros(3))
    if not frames:
        return np.zeros_like(toe)

    # Between two contacts, the shift changes with zero speed at both ends.
    fixed = np.array(shifts)
    after = np.clip(np.searchsorted(frames, np.arange(last + 1)), 0, len(frames) - 1)
    before = np.maximum(after - 1, 0)
    at = np.array(frames)
    span = np.maximum(at[after] - at[before], 1)
    share = np.clip((np.arange(last + 1) - at[before]) / span, 0, 1)[:, None]
    share = share**2 * (3 - 2 * share)
    return (1 - share) * fixed[before] + share * fixed[after]


def repeated(motion: GroundedMotion, copies: int = COPIES) -> GroundedMotion:
    """Returns a motion that repeats a loop several times.

    The last frame of each repetition is the first frame of the next one.
    """
    # Each repetition begins where the previous one ended, in the same direction. Its path is turned
    # and moved accordingly.
    step = turned(np.r_[motion.path[-1] - motion.path[0], 0][[0, 2, 1]], -motion.heading[0])
    turn = motion.heading[-1] - motion.heading[0]
    count = len(motion) - 1
    paths, headings = [], []
    start, heading = motion.path[0].copy(), float(motion.heading[0])
    away = np.zeros((count + 1, 3))
    away[:, [0, 2]] = motion.path - motion.path[0]
    for _ in range(copies):
        paths.append(start + turned(away, heading - motion.heading[0])[:count, [0, 2]])
        headings.append(motion.heading[:count] + heading - motion.heading[0])
        start = start + turned(step, heading)[[0, 2]]
        heading += turn
    return GroundedMotion(
        local=np.concatenate([*[motion.local[:count]] * copies, motion.local[-1:]]),
        path=np.concatenate([*paths, start[None]]),
        heading=np.concatenate([*headings, [heading]]),
        contacts=np.concatenate([*[motion.contacts[:count]] * copies, motion.contacts[-1:]]),
        fps=motion.fps,
    )


def planted_loop(motion: GroundedMotion) -> GroundedMotion:
    """Returns a copy of a loop in which the toes stay in place during contacts.

    The result is still a loop: its last pose equals its first pose.
    """
    # The ends of a single cycle would cut contacts in two. Therefore, several cycles in a row are
    # planted, and the middle one is kept, because its neighbors are also cycles.
    count = len(motion) - 1
    several = planted(repeated(motion))
    middle = several.local[count * (COPIES // 2) : count * (COPIES // 2 + 1) + 1].copy()
    middle[-1] = middle[0]
    return replace(motion, local=middle)


def slide(motion: GroundedMotion) -> float:
    """Returns the maximum distance, in meters, that a toe slides during a single contact."""
    toes = motion.world()[:, [leg[-1] for leg in FEET]][..., [0, 2]]
    distances = [0.0]
    for foot in range(2):
        for begin, end in runs(motion.contacts[:, foot]):
            distances.append(
                float(
                    np.linalg.norm(toes[begin : end + 1, foot] - toes[begin, foot], axis=-1).max()
                )
            )
    return max(distances)


def pivot(motion: GroundedMotion) -> float:
    """Returns the maximum angle, in degrees, by which a foot turns during a single contact.

    Only rotation about the vertical axis is measured.
    """
    joints = motion.world()
    angles = [0.0]
    for foot, (_, _, ankle, toe) in enumerate(FEET):
        x, _, z = (joints[:, toe] - joints[:, ankle]).T
        turned_by = np.degrees(np.unwrap(np.arctan2(x, z)))
        for begin, end in runs(motion.contacts[:, foot]):
            angles.append(float(np.ptp(turned_by[begin : end + 1])))
    return max(angles)


def jolt(motion: GroundedMotion) -> float:
    """Returns the maximum acceleration of the ankles and toes in m/s²."""
    feet = motion.world()[:, [joint for leg in FEET for joint in leg[2:]]]
    changes = np.diff(feet, 2, axis=0) * motion.fps**2
    return float(np.linalg.norm(changes, axis=-1).max(initial=0.0))
