"""Models the mannequin that pictures and files show: `python tools/mannequin.py`.

The script writes flame_mdm/visualize/mannequin.npz and requires the packages in
tools/requirements.txt. The figure contains no third-party data. Its parts have elliptic cross
sections along the bones of `ADULT`, with the widths and depths of an adult who is 1.78 m tall.
Smooth unions join the parts into one surface. The left half is triangulated and simplified, and the
right half is its mirror image.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import fast_simplification
import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation
from skimage import measure

from flame_mdm.formats.people import hairline, packed, smooth, with_helpers
from flame_mdm.formats.posture import orthonormal
from flame_mdm.representations.skeleton import JOINT, SMPL22
from flame_mdm.representations.smpl import ADULT
from flame_mdm.visualize.body import (
    HAIR,
    HELPERS,
    MANNEQUIN,
    SHIRT,
    SHOES,
    SKIN,
    TROUSERS,
    TWISTED,
)

A_POSE = {"shoulder": (0, 0, -46), "elbow": (0, -14, 0), "hip": (0, 0, 4), "ankle": (0, 0, -4)}
"""Rotations of the joints on the left side from SMPL's rest pose to the stored pose, in degrees about x, y and z.

In the stored pose, the arms are lowered. Because the arms hang down in most motions, the skin is
stretched less than it would be from a pose with outstretched arms.
"""
KNUCKLES, CURL = 0.088, 0.034
"""Distance from the wrist to the knuckles, and radius of the finger arc, in meters."""
CELL = 0.005
VERTICES = 1150
"""Number of vertices in the left half, before it is mirrored."""
SOLE = -0.981
"""Height of the soles relative to the pelvis, in meters."""
LIPS, EYES = (192, 138, 120), (92, 74, 64)
"""RGB colors of the lips and the eyes, from 0 to 255."""
Field = Callable[[np.ndarray], np.ndarray]
ORIGIN, UP = np.zeros(3), np.array([[0, 1, 0], [1, 0, 0], [0, 0, 1.0]])


def tube(origin: np.ndarray, axes: np.ndarray, stations: str, power: float = 2.0) -> Field:
    """Returns the approximate signed distance field of a tube with elliptic cross sections and round ends.

    Args:
                origin: the point (3,) on the tube's axis at length 0, in meters.
        axes: array (3, 3) whose rows are the directions of the tube and of its two half widths.
        stations: cross sections, separated by semicolons. Each cross section consists of the
            position along the tube, the two coordinates of the center and the two half widths, in
            millimeters. Cross sections between them are interpolated without overshoot.
        power: exponent of the cross section. 2 gives ellipses, and larger values give shapes that
            are closer to rectangles.
    """
    table = np.array(stations.replace(";", " ").split(), float).reshape(-1, 5) / 1000
    shape = PchipInterpolator(table[:, 0], table[:, 1:])

    def field(points: np.ndarray) -> np.ndarray:
        length, u, v = np.moveaxis((points - origin) @ axes.T, -1, 0)
        inside = np.clip(length, table[0, 0], table[-1, 0])
        center_u, center_v, half_u, half_v = np.moveaxis(shape(inside), -1, 0)
        thin = np.minimum(half_u, half_v)
        ratio = (np.abs(u - center_u) / half_u) ** power + (np.abs(v - center_v) / half_v) ** power
        ratio += (np.abs(length - inside) / thin) ** power
        return (ratio ** (1 / power) - 1) * thin

    return field


def ellipsoid(center: Sequence[float], radii: Sequence[float]) -> Field:
    """Returns the approximate signed distance field of an ellipsoid with axes along x, y and z."""
    middle, size = np.array(center), np.array(radii)
    return lambda points: (np.linalg.norm((points - middle) / size, axis=-1) - 1) * size.min()


def union(first: np.ndarray, second: np.ndarray, blend: float) -> np.ndarray:
    """Returns the signed distances from the union of two shapes, given the distances from each shape.

    Surfaces that are closer together than `blend` meters are blended smoothly.
    """
    share = np.maximum(blend - np.abs(first - second), 0) / blend
    return np.minimum(first, second) - share**2 * blend / 4


def pose() -> tuple[np.ndarray, np.ndarray]:
    """Returns the joint positions (22, 3) in the stored pose, pelvis at 0, and the world rotations (22, 3, 3)."""
    joints, turned = np.zeros((22, 3)), np.tile(np.eye(3), (22, 1, 1))
    for joint, parent in enumerate(SMPL22.parents):
        side, _, name = SMPL22.joints[joint].rpartition("_")
        angles = np.array(A_POSE.get(name, (0, 0, 0))) * (1 if side == "left" else (1, -1, -1))
        turn = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
        if parent >= 0:
            joints[joint] = joints[parent] + turned[parent] @ np.array(ADULT[joint])
            turned[joint] = turned[parent] @ turn
    return joints, turned


def bone(start: str, end: str, u: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """Returns the origin and the axes of a tube along the bone between two joints.

    Args:
        start: name of the joint at which the bone begins.
        end: name of the joint at which the bone ends.
        u: direction (3,) of the tube's first half width, relative to the first joint.
    """
    joints, turned = pose()
    at = JOINT[start]
    return joints[at], orthonormal(joints[JOINT[end]] - joints[at], turned[at] @ np.array(u, float))


def model() -> dict[str, Field]:
    """Returns the distance fields of the parts of the left half: trunk, left leg, left arm and head."""
    return {**trunk(), **leg(), **arm(), "head": head()}


def trunk() -> dict[str, Field]:
    """Returns the distance fields of torso, buttock, breast, shoulder blade, trapezius and neck."""
    return {
        "torso": tube(
            ORIGIN,
            UP,
            "-135 0 -5 110 80; -85 0 -8 160 108; -20 0 -8 163 112; 60 0 0 148 102; 130 0 4 137 95; "
            "200 0 4 141 100; 280 0 4 157 112; 350 0 2 168 117; 410 0 -12 166 106; 455 0 -28 150 80; "
            "490 0 -38 105 55; 515 0 -42 60 45",
            2.3,
        ),
        "buttock": ellipsoid((0.075, -0.075, -0.068), (0.072, 0.080, 0.058)),
        "breast": ellipsoid((0.075, 0.335, 0.080), (0.075, 0.058, 0.036)),
        "blade": ellipsoid((0.085, 0.385, -0.085), (0.065, 0.085, 0.030)),
        "trapezius": tube(
            np.array([0.0, 0.53, -0.050]),
            orthonormal(np.array([0.2, -0.062, -0.005]), np.array([0, 1.0, 0])),
            "0 0 0 40 46; 80 -4 0 36 46; 180 -4 4 42 50",
        ),
        "neck": tube(
            np.array([0, 0.47, -0.045]),
            orthonormal(np.array([0, 0.17, 0.045]), np.array([1.0, 0, 0])),
            "-20 0 0 75 50; 40 0 0 56 56; 90 0 0 51 55; 170 0 0 52 58",
        ),
    }


def leg() -> dict[str, Field]:
    """Returns the distance fields of thigh, calf and foot, whose axes point down, left and forward."""
    joints, _ = pose()
    parts = {}
    thigh = bone("left_hip", "left_knee", (1, 0, 0))
    parts["thigh"] = tube(
        *thigh,
        "-30 22 0 74 85; 40 22 2 81 91; 120 14 8 79 86; 220 6 8 68 75; 320 0 3 55 61; 385 0 4 50 57; 410 0 4 48 55",
    )
    parts["calf"] = tube(
        *bone("left_knee", "left_ankle", (1, 0, 0)),
        "-15 0 5 47 53; 50 0 -4 48 53; 130 3 -14 53 59; 200 2 -13 48 54; 300 0 -6 36 42; "
        "380 0 -4 31 37; 430 0 -4 33 40",
    )
    ankle = joints[JOINT["left_ankle"]]
    ahead = joints[JOINT["left_foot"]] - ankle
    forward = orthonormal(ahead * [1, 0, 1], np.array([1.0, 0, 0]))
    forward[2] = [0, 1, 0]
    shoe = tube(
        ankle * [1, 0, 1] + [0, SOLE, 0],
        forward,
        "-45 0 32 30 34; -10 0 40 35 44; 30 0 42 37 46; 70 0 34 42 38; 120 -2 25 48 29; "
        "160 -5 21 46 24; 185 -10 19 36 20",
        2.4,
    )

    def foot(points: np.ndarray) -> np.ndarray:
        return -union(-shoe(points), -(SOLE - points[..., 1]), 0.012)

    parts["foot"] = foot
    return parts


def arm() -> dict[str, Field]:
    """Returns the distance fields of upper arm, forearm and hand, whose axes point left, up and forward."""
    joints, turned = pose()
    parts = {}
    parts["arm"] = tube(
        *bone("left_shoulder", "left_elbow", (0, 1, 0)),
        "-30 -14 2 40 46; 20 -10 2 50 56; 70 -4 3 50 54; 140 -2 4 43 48; 210 -1 0 36 41; 270 0 0 34 37",
    )
    parts["forearm"] = tube(
        *bone("left_elbow", "left_wrist", (0, 1, 0)),
        "-10 0 0 34 37; 50 0 3 37 42; 110 0 2 34 40; 190 0 0 26 32; 250 0 0 21 28; 275 0 0 20 28",
    )
    wrist = JOINT["left_wrist"]
    hand_axes = axes_of_hand(turned[wrist])
    palm = tube(
        joints[wrist],
        hand_axes,
        "-10 0 0 19 28; 30 0 2 18.5 36; 80 1 0 17 42; 105 0 0 14.5 41",
        2.4,
    )
    fingers = [
        tube(joints[wrist], hand_axes, stations)
        for stations in (
            "80 0 31.5 9.6 9.6; 115 -1 36 9.6 9.6; 142 -7 38.7 9.1 9.1; 170 -20 40.5 7.7 7.7",
            "80 0 10.8 10.2 10.2; 115 -1 12.3 10.2 10.2; 149 -7 13.2 9.7 9.7; 183 -20 13.8 8.2 8.2",
            "80 0 -10.5 9.6 9.6; 115 -1 -12 9.6 9.6; 144 -7 -12.9 9.1 9.1; 174 -20 -13.5 7.7 7.7",
            "80 0 -31 8.6 8.6; 115 -1 -36 8.6 8.6; 133 -7 -39 8.2 8.2; 152 -20 -41 6.9 6.9",
        )
    ]
    thumb_axes = orthonormal(hand_axes.T @ np.array([0.80, -0.25, 0.62]), hand_axes[1])
    thumb = tube(
        joints[wrist] + hand_axes.T @ np.array([0.018, -0.004, 0.016]),
        thumb_axes,
        "0 0 0 15 17; 35 0 0 14.5 15.5; 65 0 -4 11.5 12; 88 0 -10 9 9.5",
    )

    def hand(points: np.ndarray) -> np.ndarray:
        distance = palm(points)
        for finger in fingers:
            distance = union(distance, finger(points), 0.008)
        return union(distance, thumb(points), 0.014)

    parts["hand"] = hand
    return parts


def axes_of_hand(wrist: np.ndarray) -> np.ndarray:
    return orthonormal(wrist @ np.array([1, -0.06, -0.04]), wrist @ np.array([0, 1.0, 0]))


def curled(points: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bends the fingers of the left half into a loose fist. Returns the new points and normals (V, 3)."""
    joints, turned = pose()
    wrist, axes = joints[JOINT["left_wrist"]], axes_of_hand(turned[JOINT["left_wrist"]])
    local = (points - wrist) @ axes.T
    # The thumb remains straight
    fingers = (np.linalg.norm(local, axis=1) < 0.25) & (local[:, 2] < 0.06)
    beyond = np.where(fingers, np.maximum(local[:, 0] - KNUCKLES, 0), 0)
    angle = beyond / CURL
    bend = Rotation.from_rotvec(-angle[:, None] * [0, 0, 1]).as_matrix()
    radius = (CURL + local[:, 1])[:, None] * np.stack([np.sin(angle), np.cos(angle)], 1)
    bent = np.column_stack([local[:, 0] - beyond + radius[:, 0], radius[:, 1] - CURL, local[:, 2]])
    moved = beyond[:, None] > 0
    return np.where(moved, wrist + bent @ axes, points), np.where(
        moved, (bend @ (normals @ axes.T)[..., None])[..., 0] @ axes, normals
    )


def head() -> Field:
    """Returns the distance field of the head, with face, ear and hair."""
    skull = ellipsoid((0, 0.712, 0.003), (0.074, 0.089, 0.095))
    face = tube(
        ORIGIN,
        UP,
        "592 0 58 33 28; 605 0 50 46 43; 635 0 40 57 57; 670 0 32 63 67; 710 0 20 69 80; 745 0 12 66 80",
    )
    nose = tube(
        np.array([0, 0.708, 0.098]),
        orthonormal(np.array([0, -0.045, 0.022]), np.array([1.0, 0, 0])),
        "0 0 0 7 8; 30 0 0 9 10; 47 0 1 13 11",
    )
    brow = ellipsoid((0.030, 0.716, 0.089), (0.032, 0.008, 0.013))
    eye = ellipsoid((0.031, 0.699, 0.106), (0.019, 0.012, 0.018))
    cheek = ellipsoid((0.043, 0.668, 0.068), (0.022, 0.020, 0.020))
    lips = ellipsoid((0, 0.637, 0.087), (0.026, 0.010, 0.012))
    chin = ellipsoid((0, 0.604, 0.074), (0.022, 0.017, 0.018))
    ear = tube(
        np.array([0.0745, 0.690, -0.004]),
        orthonormal(np.array([0.08, -1, 0.25]), np.array([1.0, 0, 0.4])),
        "-24 0 0 8 14; 0 0 0 9 16; 26 -3 0 7 9",
    )
    crown = ellipsoid((0, 0.719, -0.004), (0.081, 0.094, 0.101))

    def bald(points: np.ndarray) -> np.ndarray:
        distance = union(skull(points), face(points), 0.03)
        distance = union(union(distance, brow(points), 0.014), cheek(points), 0.03)
        distance = -union(-distance, eye(points), 0.014)
        distance = union(
            union(union(distance, nose(points), 0.014), lips(points), 0.010), chin(points), 0.025
        )
        return union(distance, ear(points), 0.006)

    def haired(points: np.ndarray) -> np.ndarray:
        return union(bald(points), -union(-crown(points), hairline(points), 0.012), 0.004)

    return haired


def surface(parts: dict[str, Field], points: np.ndarray) -> np.ndarray:
    """Returns the signed distances (N,) of points with x >= 0 from the entire body."""
    mirrored = points * [-1, 1, 1]
    leg = union(
        union(parts["thigh"](points), parts["calf"](points), 0.02), parts["foot"](points), 0.03
    )
    seat = union(parts["torso"](points), parts["buttock"](points), 0.05)
    body = union(seat, parts["breast"](points), 0.04)
    body = union(union(body, parts["blade"](points), 0.05), parts["trapezius"](points), 0.05)
    body = union(union(body, leg, 0.05), parts["thigh"](mirrored), 0.05)
    arm = union(parts["arm"](points), parts["forearm"](points), 0.02)
    body = union(union(body, arm, 0.05), parts["hand"](points), 0.015)
    return union(union(body, parts["neck"](points), 0.05), parts["head"](points), 0.025)


def gradient(distance: Field, points: np.ndarray) -> np.ndarray:
    """Returns the gradients (N, 3) of a distance field at points, computed by central differences."""
    steps = 1e-4 * np.eye(3)
    return (
        np.stack([distance(points + step) - distance(points - step) for step in steps], -1) / 2e-4
    )


def magnified(points: np.ndarray, inverse: bool = False) -> np.ndarray:
    """Enlarges head and hand and shrinks their surroundings, so that head and hand keep more vertices."""
    joints, turned = pose()
    hand = joints[JOINT["left_wrist"]] + turned[JOINT["left_wrist"]] @ np.array([0.09, 0, 0])
    radii = np.linspace(0, 3, 6001)
    for center, reach, growth in (((0, 0.67, 0.07), 0.13, 1.6), (hand, 0.12, 0.9))[
        :: -1 if inverse else 1
    ]:
        slope = np.where(radii < reach, growth, np.where(radii < reach * (1 + 2 * growth), -0.5, 0))
        grown = radii + np.cumsum(slope) * radii[1]
        offset = points - np.array(center)
        distance = np.linalg.norm(offset, axis=1, keepdims=True)
        before, after = (grown, radii) if inverse else (radii, grown)
        points = np.array(center) + offset * np.interp(distance, before, after) / np.maximum(
            distance, 1e-9
        )
    return points


def triangulate(distance: Field) -> tuple[np.ndarray, np.ndarray]:
    """Returns vertices (V, 3) and outward-facing triangles (T, 3) of the left half, whose border is at x = 0."""
    axes = [np.arange(low, high, CELL) for low, high in ((0, 0.76), (-1.01, 0.84), (-0.18, 0.22))]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    values = np.concatenate(
        [distance(part.reshape(-1, 3)).reshape(part.shape[:3]) for part in np.split(grid, 8)]
    )
    points, triangles, _, _ = measure.marching_cubes(values, 0.0, spacing=(CELL,) * 3)
    points = points + [axis[0] for axis in axes]
    share = 1 - 2 * VERTICES / len(triangles)
    # The result depends on the order of the axes. This order keeps the border closed.
    order = np.array([1, 2, 0])
    points, triangles = fast_simplification.simplify(
        np.ascontiguousarray(magnified(points)[:, order], np.float32),
        triangles.astype(np.int32),
        share,
        agg=3,
    )
    points = magnified(points[:, np.argsort(order)].astype(float), inverse=True)
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), 1)
    pairs, count = np.unique(edges, axis=0, return_counts=True)
    border = np.unique(pairs[count == 1])
    for step in range(12):
        if step < 6:  # even out the triangles along the surface
            sums, degree = np.zeros_like(points), np.zeros(len(points))
            for a, b in (pairs.T, pairs.T[::-1]):
                np.add.at(sums, a, points[b])
                np.add.at(degree, a, 1)
            points = points + 0.35 * (sums / degree[:, None] - points)
        points[border, 0] = 0
        slope = gradient(distance, points)
        slope[border, 0] = 0
        points = points - (distance(points) / np.maximum((slope**2).sum(1), 0.2))[:, None] * slope
    volume = np.einsum(
        "ij,ij->i",
        points[triangles[:, 0]],
        np.cross(points[triangles[:, 1]], points[triangles[:, 2]]),
    )
    return points, triangles if volume.sum() > 0 else triangles[:, ::-1]


def skin(points: np.ndarray, parts: dict[str, Field]) -> np.ndarray:
    """Returns the skinning weights (V, 22) of points on the left half."""
    joints, turned = pose()

    def beyond(name: str, normal: Sequence[float] | np.ndarray, width: float) -> np.ndarray:
        """Returns how far points are beyond a joint: 0.5 on the plane through it, 0 or 1 at `width` meters from it."""
        unit = np.array(normal, float) / np.linalg.norm(normal)
        return smooth(-width, width, (points - joints[JOINT[name]]) @ unit)

    def along(name: str, local: Sequence[float]) -> np.ndarray:
        return turned[JOINT[name]] @ np.array(local, float)

    x, y = points[:, 0], points[:, 1]
    arm = np.minimum(
        np.minimum(parts["arm"](points), parts["forearm"](points)), parts["hand"](points)
    )
    on_arm = smooth(-0.045, 0.015, parts["torso"](points) - arm) * (x > 0.08)
    bend = along("left_shoulder", (1, 0, 0)) + along("left_collar", (0.8, 0.3, 0))
    half_elbow = along("left_elbow", (1, 0, 0)) + along("left_shoulder", (1, 0, 0))
    leg = (y < 0.1) * smooth(-0.05, 0.05, x) * (1 - on_arm)
    throat = smooth(0.52, 0.57, y)
    share = {
        "left_hip": leg * beyond("left_hip", (0.42, -0.9, 0), 0.075),
        "right_hip": (y < 0.1)
        * smooth(-0.05, 0.05, -x)
        * beyond("right_hip", (-0.42, -0.9, 0), 0.075),
        "spine1": beyond("spine1", (0, 1, 0), 0.08),
        "spine2": beyond("spine2", (0, 1, 0), 0.08),
        "spine3": beyond("spine3", (0, 1, 0), 0.06),
        "neck": beyond("neck", (0, 1, 0.3), 0.05) * (1 - smooth(0.06, 0.11, x) * (1 - throat)),
        "head": beyond("head", (0, 0.8, 0.6), 0.035),
        "left_collar": beyond("left_collar", (1, 0.15, 0), 0.07)
        * smooth(0.30, 0.44, y - on_arm)
        * (1 - throat),
        "left_shoulder": beyond("left_shoulder", bend, 0.07) * on_arm,
        "left_elbow": beyond("left_elbow", half_elbow, 0.05),
        "left_wrist": beyond("left_wrist", along("left_wrist", (1, 0, 0)), 0.03),
        "left_knee": beyond("left_knee", along("left_knee", (0, -1, -0.05)), 0.065),
        "left_ankle": beyond("left_ankle", (0.0, -0.9, 0.45), 0.04),
        "left_foot": beyond("left_foot", along("left_foot", (0.1, 0.15, 1)), 0.03),
    }
    for name in ("spine1", "spine2", "spine3", "left_collar"):
        share[name] = np.maximum(share[name], on_arm)
    whole = np.zeros((len(points), 22))  # weight of a joint and of all its descendants
    whole[:, 0] = 1
    for joint, parent in enumerate(SMPL22.parents):
        if parent >= 0 and SMPL22.joints[joint] in share:
            whole[:, joint] = whole[:, parent] * share[SMPL22.joints[joint]]
    weights = whole.copy()
    for joint in reversed(range(22)):
        children = [child for child, parent in enumerate(SMPL22.parents) if parent == joint]
        below = whole[:, children].sum(1)
        too_much = np.maximum(1, below / np.maximum(whole[:, joint], 1e-9))
        # In the middle of the body, the left and the right joint share the weight of their parent
        for child in children:
            for joint_below in descendants(child):
                weights[:, joint_below] /= too_much
        weights[:, joint] = whole[:, joint] - below / too_much
    return weights


def descendants(joint: int) -> list[int]:
    """Returns the indices of a joint and of all its descendants in the skeleton."""
    return [joint] + [
        j for child, p in enumerate(SMPL22.parents) if p == joint for j in descendants(child)
    ]


def paint(points: np.ndarray) -> np.ndarray:
    """Returns colors (V, 3), 0 to 255, for a half: hair, skin, shirt, trousers and shoes, blended at their borders."""
    joints, turned = pose()

    def mixed(below: np.ndarray, above: tuple[int, int, int], share: np.ndarray) -> np.ndarray:
        return below + share[:, None] * (np.array(above) - below)

    elbow = (
        (points - joints[JOINT["left_elbow"]])
        @ turned[JOINT["left_shoulder"]]
        @ np.array([1.0, 0, 0])
    )
    hand = smooth(-0.115, -0.07, elbow) * (points[:, 0] > 0.2)
    color = mixed(np.tile(np.array(SHIRT, float), (len(points), 1)), SKIN, hand)
    neck = points[:, 1] - 0.535 + 0.28 * points[:, 2]
    color = mixed(color, SKIN, smooth(-0.024, 0.024, neck) * (points[:, 0] < 0.2))
    color = mixed(color, HAIR, smooth(-0.006, 0.006, hairline(points)) * (points[:, 1] > 0.6))
    for center, size, shade in (
        ((0, 0.637, 0.1), (0.026, 0.009, 0.03), LIPS),
        ((0.031, 0.699, 0.1), (0.017, 0.008, 0.04), EYES),
    ):
        color = mixed(color, shade, smooth(-0.003, 0.003, -ellipsoid(center, size)(points)))
    belt = (points[:, 0] < 0.25) * smooth(-0.03, 0.03, 0.035 - points[:, 1])
    color = mixed(color, TROUSERS, belt)
    return mixed(color, SHOES, smooth(-0.016, 0.016, -0.888 - points[:, 1]))


def make() -> dict[str, np.ndarray]:
    """Returns the arrays in mannequin.npz, which describe the left half of the figure and its mirror image."""
    parts = model()

    def distance(points: np.ndarray) -> np.ndarray:
        return surface(parts, points)

    points, triangles = triangulate(distance)
    normals = gradient(distance, points)
    normals[points[:, 0] == 0, 0] = 0
    joints, turned = pose()
    weights = with_helpers(points, skin(points, parts), joints)
    beside = points[:, 0] > 0
    copies = np.arange(len(points))
    copies[beside] = len(points) + np.arange(beside.sum())
    flip = np.array([-1, 1, 1])
    half = len(TWISTED)
    mirrored = [*SMPL22.mirrored, *(22 + (k + half) % len(HELPERS) for k in range(len(HELPERS)))]
    triangles = np.concatenate([triangles, copies[triangles[:, ::-1]]])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    colors = paint(points)
    points, normals = curled(points, normals)
    normals = np.concatenate([normals, normals[beside] * flip])
    near = normals[triangles].sum(1)
    # In folds, these normals are softer than the gradient of the surface
    np.add.at(normals, triangles.ravel(), np.repeat(near, 3, axis=0))
    return packed(
        np.concatenate([points, points[beside] * flip]),
        normals,
        np.concatenate([weights, weights[beside][:, mirrored]]),
        np.concatenate([colors, colors[beside]]),
        triangles,
        joints,
        turned,
    )


if __name__ == "__main__":
    np.savez_compressed(MANNEQUIN, allow_pickle=False, **make())
