"""Cleans up generated motions.

Cleanup smooths the paths of joints, makes bone lengths constant, keeps feet in place and above the
floor, and moves hands out of the body.
"""

from collections.abc import Sequence
from dataclasses import replace
from math import comb

import numpy as np
from scipy.linalg import solveh_banded
from scipy.ndimage import gaussian_filter1d, maximum_filter1d

from flame_mdm.formats.faults import depths, unit
from flame_mdm.formats.motion import Motion
from flame_mdm.formats.poses import BoneRotations
from flame_mdm.representations.skeleton import Skeleton

# Weight of the squared third differences of a joint's path, relative to the squared change of the
# path. Third differences are changes in acceleration, so the steady accelerations of fast motions
# are preserved.
SMOOTHNESS = 0.034
# Distance in meters from the smooth path at which the weight of a position is halved
OUTLIER = 0.03
# Height in meters above which a toe counts as off the floor
LOW = 0.07
# Horizontal speed in m/s above which a low toe counts as off the floor, while the body stands
# still
SLOW = 0.5
SHARE, SHARE_PINNED = 0.5, 0.4
"""Fractions of the body's speed that are added to `SLOW`.

The first is used before the body is moved to follow its feet, and the second afterward.

In generated motion, a foot on the floor may slide along with the body. A swinging foot is faster
than the body.
"""
DRIFT = 0.2
"""Maximum speed in m/s at which the body may slide over its feet while the legs compensate.

Above 1.5 times this speed, the body follows its feet entirely.
"""
# A hand begins to avoid the body this many seconds before it would enter the body
CLEAR = 0.15
# Depth in meters below the floor from which a toe is lifted
DEEP = 0.01
# Maximum distance from hip to ankle, as a fraction of the length of the straight leg, unless the
# distance was already larger
REACH = 0.999


def cleaned(motion: Motion, contacts: np.ndarray | None = None) -> Motion:
    """Returns the motion with smooth joint paths, constant bone lengths and feet that do not slide.

    See `cleanup` for the changes. The result contains no features, rotations or contacts, because
    they would no longer match the joints.

    Args:
        motion: the motion.
        contacts: (F, N), probability that each of `skeleton.feet` is on the floor. If None, the
            contacts are estimated from the joints.

    Example:
        >>> motion = Motion(joints=np.zeros((3, 22, 3)), fps=20)
        >>> cleaned(motion).cleanup
        True
    """
    joints = cleanup(motion.joints, motion.fps, motion.skeleton, contacts)
    none = np.zeros((0, 0), np.float32)
    return replace(
        motion,
        joints=joints,
        features=none,
        representation="",
        poses=None,
        bones=BoneRotations(),
        contacts=None,
        cleanup=True,
    )


def cleanup(
    joints: np.ndarray, fps: float, skeleton: Skeleton, contacts: np.ndarray | None = None
) -> np.ndarray:
    """Corrects pops, bone lengths, sliding feet, toes below the floor, and hands inside the body.

    The height of the lowest toe is measured in each frame. The floor is at the 10th percentile of
    these heights, or at 0 if this percentile is positive.

    Args:
        joints: (F, J, 3), joint positions in meters, with y up. Motions with fewer than 4 frames
            are returned unchanged.
        fps: frames per second.
        skeleton: skeleton of the joints.
        contacts: (F, N), probability that each of `skeleton.feet` stays on the floor until the next
            frame. With some representations, models predict these probabilities. If None, the
            contacts are estimated from the height and speed of the toes.

    Returns:
        The new joint positions (F, J, 3), float32.
    """
    # Joint paths are smoothed, and bones are set to their median lengths. Then, the body is moved
    # over the ground so that its feet in contact stand still on average. The remaining sliding is
    # corrected by two-bone inverse kinematics: the legs keep each toe in place during its contacts.
    # Inverse kinematics also moves the arms out of the trunk and thighs.
    if len(joints) < 4:
        return np.array(joints, np.float32)
    smooth = _smooth(np.asarray(joints, float))
    motion = _constant_bones(smooth, skeleton)
    _keep_heights(motion, smooth, skeleton)
    toes = [chain[-1] for chain in skeleton.chains[:2]]
    motion = _follow_feet(motion, toes, fps)
    if contacts is None:
        contact = _contacts(motion[:, toes], motion[:, 0], fps, SHARE_PINNED)
    else:
        contact = np.clip(2 * contacts[:-1, [skeleton.feet.index(toe) for toe in toes]] - 0.5, 0, 1)
    for chain, weight in zip(skeleton.chains[:2], contact.T, strict=True):
        # Between contacts, the horizontal shift of a foot fades from one to the next.
        toe = motion[:, chain[-1]]
        shift = np.zeros((len(motion), 3))
        still = -np.diff(toe[:, [0, 2]], axis=0)
        shift[:, [0, 2]] = _least_squares(
            len(toe), (1, 30 * weight, still), (0, 0.03, 0.0), (2, 0.1, 0.0)
        )
        bend(motion, chain[1:], shift)
    floor = min(np.percentile(motion[:, toes, 1].min(1), 10), 0.0)
    for chain in skeleton.chains[:2]:
        _lift(motion, chain[1:], floor)
    for side in ("left", "right"):
        _push_out(motion, skeleton, side, fps)
    return motion.astype(np.float32)


def _least_squares(
    frames: int, *terms: tuple[int, np.ndarray | float, np.ndarray | float]
) -> np.ndarray:
    """Returns the x (frames, N) that minimizes the sum of all terms.

    A term (n, weight, target) stands for the sum of weight * (d - target)^2, where d are the n-th
    differences of x. The weight is a number or an array of shape (frames - n,). The target is a
    number or an array of shape (frames - n, N), and at least one target must be an array.
    """
    # An n-th difference has binomial coefficients with alternating signs. It couples frames that
    # are at most three apart. The normal equations are therefore a banded matrix, and solving
    # them takes time linear in the number of frames.
    width = next(target.shape[1] for _, _, target in terms if isinstance(target, np.ndarray))
    matrix, right = np.zeros((4, frames)), np.zeros((frames, width))
    for order, weight, target in terms:
        stencil = [(-1) ** (order - k) * comb(order, k) for k in range(order + 1)]
        count = frames - order
        weights = np.broadcast_to(np.asarray(weight, float), count)
        for i, factor in enumerate(stencil):
            right[i : i + count] += factor * weights[:, None] * target
            for j in range(i, order + 1):
                matrix[j - i, i : i + count] += factor * stencil[j] * weights
    return solveh_banded(matrix, right, lower=True)


def _smooth(motion: np.ndarray) -> np.ndarray:
    """Returns smooth joint paths (Whittaker 1923).

    Positions that jump for a few frames have little influence on the paths.
    """
    # After each fit, positions far from the path are given a lower weight, as in iteratively
    # reweighted least squares. A pop of a few frames is thus cut off instead of being spread over
    # its neighbors. Four fits are sufficient.
    smooth = motion.copy()
    for joint in range(motion.shape[1]):
        path, weight = motion[:, joint], np.ones(len(motion))
        for _ in range(4):
            smooth[:, joint] = _least_squares(len(path), (0, weight, path), (3, SMOOTHNESS, 0.0))
            weight = 1 / (1 + (np.linalg.norm(path - smooth[:, joint], axis=-1) / OUTLIER) ** 2)
    return smooth


def _constant_bones(motion: np.ndarray, skeleton: Skeleton) -> np.ndarray:
    """Returns a copy of the motion in which each bone has its median length in all frames.

    The bones keep their directions.
    """
    out = motion.copy()
    for parent, joint in skeleton.edges:
        bone = motion[:, joint] - motion[:, parent]
        length = np.linalg.norm(bone, axis=-1, keepdims=True)
        out[:, joint] = out[:, parent] + bone * np.median(length) / np.maximum(length, 1e-6)
    return out


def _keep_heights(motion: np.ndarray, before: np.ndarray, skeleton: Skeleton) -> None:
    """Bends limbs whose foot or hand moved down when the bone lengths were changed.

    When a sequence changes between two very different poses, for example from a crawl to a walk,
    the poses in between are averages of the two and have short bones. With bones of full length,
    the limbs would pass through the floor.
    """
    legs = [chain[1:] for chain in skeleton.chains[:2]]
    for limb in (*legs, *(_arm(skeleton, side) for side in ("left", "right"))):
        end = limb[2:]
        lowered = before[:, end, 1].min(1) - motion[:, end, 1].min(1)
        shift = np.zeros((len(motion), 3))
        shift[:, 1] = np.maximum(lowered, 0)
        if shift.any():
            bend(motion, limb, shift)


def _arm(skeleton: Skeleton, side: str) -> list[int]:
    """Returns the shoulder, elbow and wrist on one side and, if the skeleton has one, the hand."""
    arm = [skeleton.joints.index(f"{side}_{name}") for name in ("shoulder", "elbow", "wrist")]
    return arm + [joint for joint, name in enumerate(skeleton.joints) if name == f"{side}_hand"]


def _contacts(toes: np.ndarray, root: np.ndarray, fps: float, share: float) -> np.ndarray:
    """Returns the confidences (F - 1, 2), from 0 to 1, that the toes stay on the floor.

    A frame's confidences refer to the time until the next frame. `toes` (F, 2, 3) are the positions
    of the toes.
    """
    # A toe is on the floor if it is both low and slow. The faster the body travels, the faster a
    # toe may slide, because feet in generated motions are carried along with the body.
    speed = np.linalg.norm(np.diff(toes[..., [0, 2]], axis=0), axis=-1) * fps
    travel = np.linalg.norm(np.diff(root[:, [0, 2]], axis=0), axis=-1) * fps
    travel = gaussian_filter1d(travel, 0.15 * fps, mode="nearest")
    height = toes[..., 1] - np.percentile(toes[..., 1].min(1), 10)
    height = np.maximum(np.maximum(height[1:], height[:-1]), 0)
    relative = np.stack([height / LOW, speed / (SLOW + share * travel[:, None])])
    return (np.clip(1 - relative**2, 0, 1) ** 2).prod(0)


def _follow_feet(motion: np.ndarray, toes: list[int], fps: float) -> np.ndarray:
    """Moves the body over the ground so that the feet on the floor stand still on average."""
    # The drift of the body is the mean sliding of the feet in contact. It is smooth in time, and
    # almost 0 while no foot is in contact. Once the drift is subtracted from the root trajectory,
    # these feet stand still.
    slides = np.diff(motion[:, toes], axis=0)[..., [0, 2]]
    contact = weights = _contacts(motion[:, toes], motion[:, 0], fps, SHARE)
    drift = np.zeros((len(slides), 2))
    # Feet that move differently from the mean are given a lower weight, until one foot
    # determines the drift.
    for _ in range(10):
        mean = (weights[..., None] * slides).sum(1) / np.maximum(weights.sum(1), 1e-9)[:, None]
        drift = _least_squares(
            len(slides), (0, weights.sum(1), mean), (0, 0.01, 0.0), (1, 1.0, 0.0)
        )
        weights = contact / (
            1 + (np.linalg.norm(slides - drift[:, None], axis=-1) * fps / 0.2) ** 2
        )
    speed = np.linalg.norm(drift, axis=-1, keepdims=True) * fps
    drift = drift * np.clip(2 * speed / DRIFT - 2, 0, 1)
    out = motion.copy()
    out[1:, :, [0, 2]] -= drift.cumsum(0)[:, None]
    return out


def _lift(motion: np.ndarray, leg: Sequence[int], floor: float) -> None:
    """Bends a leg in the frames in which its toe is more than `DEEP` below the floor."""
    # The shift fades in and out within a frame, because the path of the toe is already smooth. The
    # second pass lifts what the fading has left below the floor.
    for _ in range(2):
        depth = np.maximum(floor - DEEP - motion[:, leg[-1], 1], 0)
        if not depth.any():
            return
        shift = np.zeros((len(motion), 3))
        shift[:, 1] = _faded(depth, frames=1.0)
        bend(motion, leg, shift)


def _faded(size: np.ndarray, frames: float) -> np.ndarray:
    """Smooths `size` (F, ...) so that each peak fades in and out within about `frames` frames."""
    return gaussian_filter1d(
        maximum_filter1d(size, 2 * round(frames) + 1, axis=0), frames / 2, axis=0
    )


def _push_out(motion: np.ndarray, skeleton: Skeleton, side: str, fps: float) -> None:
    """Moves a wrist away from the axis of the trunk or thigh until the hand is outside the body."""
    arm = _arm(skeleton, side)
    frames = max(1.0, CLEAR * fps)
    other = skeleton.joints.index("right_shoulder" if side == "left" else "left_shoulder")
    # A hand near the axis is moved to its own side of the body
    aside = unit(motion[:, arm[0]] - motion[:, other])
    # Each pass moves the wrist out of the body where it is deepest. The shift fades in and out
    # within `CLEAR` seconds, so that the hand avoids the body instead of jumping out of it.
    for _ in range(4):
        depth, away = (values[:, 1:] for values in depths(motion, skeleton.joints, side))
        deepest = depth.argmax(1)[:, None]
        size = np.maximum(np.take_along_axis(depth, deepest, 1), 0)
        if not size.any():
            return
        away = size * (np.take_along_axis(away, deepest[..., None], 1)[:, 0] + 0.7 * aside)
        away = unit(gaussian_filter1d(away, frames, axis=0, mode="nearest"))
        bend(motion, arm, _faded(size, frames) * away)


def bend(motion: np.ndarray, leg: Sequence[int], shift: np.ndarray) -> None:
    """Moves the foot of a leg, or the hand of an arm, by `shift` (F, 3).

    `leg` contains the hip, the knee, the ankle and any further joints of the foot, or the
    corresponding joints of the arm.
    """
    # This is two-bone inverse kinematics. The new ankle is on the line from the hip to the
    # requested position, as far as the leg can reach. Thigh, shin and this line form a triangle,
    # which determines the position of the knee along the line. The knee stays on the same side of
    # the line.
    hip, knee, ankle, *foot = (motion[:, joint].copy() for joint in leg)
    thigh, shin = (np.linalg.norm(bone[0]) for bone in (knee - hip, ankle - knee))
    before = np.linalg.norm(ankle - hip, axis=-1, keepdims=True)
    line = ankle + shift - hip
    distance = np.linalg.norm(line, axis=-1, keepdims=True)
    line /= np.maximum(distance, 1e-9)
    reach = np.clip(distance, abs(thigh - shin) + 1e-3, np.maximum(before, REACH * (thigh + shin)))
    forward = knee - hip
    forward -= (forward * line).sum(-1, keepdims=True) * line
    forward /= np.maximum(np.linalg.norm(forward, axis=-1, keepdims=True), 1e-9)
    along = (thigh**2 - shin**2 + reach**2) / (2 * reach)
    motion[:, leg[1]] = hip + along * line + np.sqrt(np.maximum(thigh**2 - along**2, 0)) * forward
    moved = hip + reach * line - ankle
    for joint, position in zip(leg[2:], (ankle, *foot), strict=True):
        motion[:, joint] = position + moved
