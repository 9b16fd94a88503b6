"""Arms inside the body: how deep elbows, wrists and hands are in the trunk or a thigh, and the way out."""

from collections.abc import Sequence

import numpy as np

PALM = 0.3
"""Distance from the wrist to the middle of the hand, relative to the forearm, whose direction the hand continues."""
TRUNK, WIDTH, THIGH = 0.18, 1.4, 0.17
"""Radius of the trunk from front to back, relative to its length from pelvis to neck; how many times as wide as deep
the trunk is; and radius of a thigh, relative to its length."""


def depths(joints: np.ndarray, names: Sequence[str], side: str) -> tuple[np.ndarray, np.ndarray]:
    """Measures the left or right arm against capsules about trunk and thighs, whose sizes follow from the bones.

    Returns:
        Depth (F, 3) in meters of the elbow, the wrist and the middle of the hand, negative outside; and unit vectors
        (F, 3, 3) from the axis of the part in which a point is deepest; of joints (F, J, 3) in meters.
    """
    at = {name: joints[:, number] for number, name in enumerate(names)}
    elbow, wrist = at[f"{side}_elbow"], at[f"{side}_wrist"]
    points = np.stack([elbow, wrist, wrist + PALM * (wrist - elbow)], 1)
    across = unit(at["left_shoulder"] - at["right_shoulder"])
    trunk = _away(points, joints[:, 0], at["neck"])
    lateral = (trunk * across[:, None]).sum(-1, keepdims=True) * across[:, None]
    away = [trunk - (1 - 1 / WIDTH) * lateral]
    sizes = [TRUNK * _length(at["neck"] - joints[:, 0])]
    for leg in ("left", "right"):
        hip, knee = at[f"{leg}_hip"], at[f"{leg}_knee"]
        away.append(_away(points, hip, knee))
        sizes.append(THIGH * _length(knee - hip))
    depth = np.stack([size - np.linalg.norm(way, axis=-1) for size, way in zip(sizes, away, strict=True)])
    deepest = depth.argmax(0)[None]
    way = np.take_along_axis(np.stack(away), deepest[..., None], 0)[0]
    return np.take_along_axis(depth, deepest, 0)[0], unit(way)


def _away(points: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Returns vectors (F, P, 3) to points (F, P, 3) from the nearest point of a segment with ends (F, 3)."""
    axis, points = (end - start)[:, None], points - start[:, None]
    share = (points * axis).sum(-1, keepdims=True) / np.maximum((axis**2).sum(-1, keepdims=True), 1e-9)
    return points - np.clip(share, 0, 1) * axis


def _length(bones: np.ndarray) -> float:
    return float(np.median(np.linalg.norm(bones, axis=-1)))


def unit(vectors: np.ndarray) -> np.ndarray:
    """Returns vectors (..., 3) of length 1, or 0 for a vector of no length."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-9)
