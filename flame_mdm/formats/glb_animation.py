"""Motions in animated .glb, .vrm and .vrma files: the positions of all nodes in each frame.

Sources: Khronos Group, "glTF 2.0 Specification", section 3.11 and appendix C (interpolation); VRM
consortium, "VRMC_vrm_animation 1.0", https://github.com/vrm-c/vrm-specification
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, FailFast, Field, ValidationError
from scipy.spatial.transform import Rotation

from flame_mdm.errors import UserError
from flame_mdm.formats import glb
from flame_mdm.formats.animated import LARGEST, AnimatedNodes, choose, world_matrices
from flame_mdm.formats.fbx_scene import hermite
from flame_mdm.formats.resampling import MAX_FRAMES, RATES

# Maximum number of frames times nodes
MAX_CELLS = 4_000_000
# Keys with a lower rate than this are assumed to have been set by hand. Sampled motions have denser
# keys.
SPARSE_RATE = 24.0
# Frame rate at which motions with hand-set keys are sampled
USUAL_RATE = 30.0
# Numbers per key, for the properties that move nodes
WIDTHS = {
    "translation": 3,
    "rotation": 4,
    "scale": 3,
}

# SMPL joint that corresponds to each bone of VRM's humanoid
HUMANOID = {
    "hips": "pelvis",
    "spine": "spine1",
    "chest": "spine2",
    "upperChest": "spine3",
    "neck": "neck",
    "head": "head",
}
_SIDED = {
    "Shoulder": "collar",
    "UpperArm": "shoulder",
    "LowerArm": "elbow",
    "Hand": "wrist",
    "UpperLeg": "hip",
    "LowerLeg": "knee",
    "Foot": "ankle",
    "Toes": "foot",
}
HUMANOID |= {
    side + bone: f"{side}_{joint}" for side in ("left", "right") for bone, joint in _SIDED.items()
}

Index = Annotated[int, Field(ge=0, lt=2**40)]


class _Object(BaseModel):
    model_config = ConfigDict(strict=True)


class _Target(_Object):
    node: Index = -1
    path: str


class _Channel(_Object):
    sampler: Index
    target: _Target


class _Sampler(_Object):
    input: Index
    output: Index
    interpolation: Literal["LINEAR", "STEP", "CUBICSPLINE"] = "LINEAR"


class _Animation(_Object):
    name: Annotated[str, Field(max_length=1000)] = ""
    channels: Annotated[list[_Channel], Field(max_length=glb.MAX_ITEMS), FailFast()]
    samplers: Annotated[list[_Sampler], Field(max_length=glb.MAX_ITEMS), FailFast()]


@dataclass(frozen=True, eq=False)
class Track:
    """A property of a node over time.

    Attributes:
        times: (K,), times of the keys in seconds, in increasing order.
        values: (K, C), value at each of these times.
        interpolation: method of interpolation between the keys, such as "LINEAR".
        slopes: (2, K, C), slopes per second before and after each key; used only for CUBICSPLINE.
    """

    times: np.ndarray
    values: np.ndarray
    interpolation: str
    slopes: np.ndarray

    def at(self, times: np.ndarray) -> np.ndarray:
        """Returns the values (F, C) at times (F,). Rotations are not normalized.

        Before the first key, the result is the value of the first key. After the last key, the
        result is the value of the last key.
        """
        # Each time lies in a segment between two keys. CUBICSPLINE stores slopes per second, which
        # are converted to slopes per segment.
        if len(self.times) == 1:
            return np.tile(self.values[0], (len(times), 1))
        inside = np.clip(times, self.times[0], self.times[-1])
        segment = np.searchsorted(self.times, inside + 1e-6, side="right") - 1
        segment = np.clip(segment, 0, len(self.times) - 2)
        seconds = (self.times[segment + 1] - self.times[segment])[:, None]
        share = np.clip((inside - self.times[segment])[:, None] / seconds, 0, 1)
        begin, end = self.values[segment], self.values[segment + 1]

        if self.interpolation == "STEP":
            return np.where(share == 1, end, begin)
        if self.interpolation == "CUBICSPLINE":
            leaving = self.slopes[1, segment] * seconds
            arriving = self.slopes[0, segment + 1] * seconds
            return hermite(begin, end, leaving, arriving, share)
        if self.values.shape[1] == 4:
            return slerp(begin, end, share)
        return (1 - share) * begin + share * end


def slerp(begin: np.ndarray, end: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Interpolates unit quaternions (F, 4) on the sphere, along the shorter arc.

    `share` (F, 1) is between 0 and 1.
    """
    # q and -q are the same rotation. The one that is closer to `begin` is on the shorter arc. For
    # nearly equal rotations, sin(angle) is 0, and linear interpolation is exact enough.
    cosine = (begin * end).sum(1, keepdims=True)
    end = np.where(cosine < 0, -end, end)
    angle = np.arccos(np.clip(np.abs(cosine), 0, 1))
    near = angle < 1e-6
    sine = np.where(near, 1, np.sin(angle))
    first = np.where(near, 1 - share, np.sin((1 - share) * angle) / sine)
    second = np.where(near, share, np.sin(share * angle) / sine)
    return first * begin + second * end


def read(path: Path, animation: str | int | None = None) -> AnimatedNodes:
    """Reads a motion from a .glb, .vrm or .vrma file.

    Args:
        path: the file.
        animation: name or 1-based number of the animation, or None for the first animation that
            moves nodes.

    Raises:
        UserError: If the file is damaged or has no such animation.
    """
    file = glb.read(path)
    try:
        return _motion(file, animation)
    except UserError as error:
        raise UserError(f"{path}: {error}") from error
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        location = ".".join(map(str, first["loc"]))
        raise UserError(f"{path}: an animation is damaged: {location}: {first['msg']}") from error
    except (ValueError, OverflowError) as error:
        raise UserError(f"{path} is damaged: {error}") from error


def animations(path: Path) -> list[str]:
    """Returns the names of those animations in a file that move nodes."""
    file = glb.read(path)
    try:
        return [name for name, _ in _animations(file)]
    except ValueError as error:
        raise UserError(f"{path}: an animation is damaged: {error}") from error


def _animations(file: glb.Glb) -> list[tuple[str, _Animation]]:
    parsed = [_Animation.model_validate(item) for item in file.document.get("animations", [])]
    named = [(item.name or f"animation {number}", item) for number, item in enumerate(parsed, 1)]
    return [
        (name, item)
        for name, item in named
        if any(channel.target.path in WIDTHS for channel in item.channels)
    ]


def _motion(file: glb.Glb, animation: str | int | None) -> AnimatedNodes:
    candidates = _animations(file)
    name, chosen = choose(candidates, animation)
    worlds, fps = _worlds(file, chosen, candidates)
    return AnimatedNodes(file.names, file.parents, worlds[..., :3, 3], fps, name, humanoid(file))


def world_matrices_of(path: Path) -> np.ndarray:
    """Returns the nodes' world matrices (F, N, 4, 4) in the first animation of a valid file."""
    file = glb.read(path)
    candidates = _animations(file)
    return _worlds(file, candidates[0][1], candidates)[0]


def _worlds(
    file: glb.Glb, chosen: _Animation, candidates: Sequence[tuple[str, _Animation]]
) -> tuple[np.ndarray, float]:
    """Returns the nodes' world matrices (F, N, 4, 4) in each frame, and the frame rate."""
    tracks = _tracks(file, chosen)
    fps = _rate(file, [item for _, item in candidates])
    last = max(track.times[-1] for properties in tracks.values() for track in properties.values())
    count = math.floor(last * fps + 1e-3) + 1
    if count > MAX_FRAMES or count * len(file.names) > MAX_CELLS:
        raise ValueError(f"{count} frames with {len(file.names)} nodes are too many")
    times = np.arange(count) / fps

    local = np.tile(file.locals, (count, 1, 1, 1))
    nodes = file.document.get("nodes", [])
    for number, properties in tracks.items():
        local[:, number] = _animated(nodes[file.nodes[number]], properties, times)
    with np.errstate(all="ignore"):
        return world_matrices(file.parents, local), fps


def _animated(node: dict[str, Any], tracks: dict[str, Track], times: np.ndarray) -> np.ndarray:
    """Returns the matrices (F, 4, 4) from a node's coordinates to its parent's coordinates."""
    rest = {"translation": (0, 0, 0), "rotation": (0, 0, 0, 1), "scale": (1, 1, 1)}
    values = {}
    for name, usual in rest.items():
        fixed = np.tile(np.array(node.get(name, usual), float), (len(times), 1))
        values[name] = tracks[name].at(times) if name in tracks else fixed
    if not (np.linalg.norm(values["rotation"], axis=1) > 1e-12).all():
        raise ValueError("a rotation in an animation is zero")
    matrices = np.zeros((len(times), 4, 4))
    turns = Rotation.from_quat(values["rotation"]).as_matrix()
    matrices[:, :3, :3] = turns * values["scale"][:, None, :]
    matrices[:, :3, 3] = values["translation"]
    matrices[:, 3, 3] = 1
    return matrices


def _tracks(file: glb.Glb, animation: _Animation) -> dict[int, dict[str, Track]]:
    """Returns the tracks of an animation, keyed by node and property."""
    rank = {index: number for number, index in enumerate(file.nodes)}
    tracks: dict[int, dict[str, Track]] = {}
    for channel in animation.channels:
        target = channel.target
        if target.path not in WIDTHS or target.node < 0:
            continue
        if target.node not in rank or channel.sampler >= len(animation.samplers):
            raise ValueError("a channel in an animation has no node or no sampler")
        sampler = animation.samplers[channel.sampler]
        track = _track(file, sampler, WIDTHS[target.path])
        tracks.setdefault(rank[target.node], {})[target.path] = track
    return tracks


def _track(file: glb.Glb, sampler: _Sampler, width: int) -> Track:
    times = glb.numbers(file, sampler.input, "SCALAR")[:, 0]
    values = glb.numbers(file, sampler.output, f"VEC{width}")
    cubic = sampler.interpolation == "CUBICSPLINE"
    if len(values) != len(times) * (3 if cubic else 1):
        raise ValueError("an animation lacks a value for a key")
    if not len(times) or not (np.diff(times) > 0).all() or times[0] < 0 or not times[-1] < 1e5:
        raise ValueError("keys in an animation are not in order, or not finite")
    if not (np.abs(values) < LARGEST).all():
        raise ValueError("values in an animation are not finite, or too large")
    slopes = np.zeros((2, len(times), width))
    if cubic:
        before, values, after = values.reshape(len(times), 3, width).transpose(1, 0, 2)
        slopes = np.stack([before, after])
    return Track(times, values, sampler.interpolation, slopes)


def _rate(file: glb.Glb, items: Sequence[_Animation]) -> float:
    """Returns the frame rate.

    The frame rate is read from `asset.extras.fps` if it is stored there. Otherwise, the frame rate
    is computed from the intervals between keys.
    """
    # glTF stores keys, but no frame rate. In a sampled animation, the median interval between keys
    # determines the frame rate. Times have single precision, so the rate is rounded to a nearly
    # equal integer.
    extras = file.document["asset"].get("extras")
    noted = extras.get("fps") if isinstance(extras, dict) else None
    if isinstance(noted, int | float) and RATES[0] <= noted <= RATES[1]:
        return float(noted)
    spacing = math.inf
    for accessor in {sampler.input for item in items for sampler in item.samplers}:
        times = glb.numbers(file, accessor, "SCALAR")[:, 0]
        gaps = np.diff(times)
        if len(gaps) and (gaps > 0).all():
            spacing = min(spacing, float(np.median(gaps)))
    rate = 1 / spacing if spacing > 0 else math.inf
    whole = round(rate) if rate < RATES[1] else 0
    rate = float(whole) if whole and abs(whole - rate) < 0.01 * rate else rate
    return rate if SPARSE_RATE <= rate <= RATES[1] else USUAL_RATE


def humanoid(file: glb.Glb) -> dict[str, int]:
    """Returns the node index of each SMPL joint, or {} if the file declares no VRM humanoid."""
    extensions = file.document.get("extensions")
    if not isinstance(extensions, dict):
        return {}
    rank = {index: number for number, index in enumerate(file.nodes)}
    for name in ("VRMC_vrm", "VRMC_vrm_animation"):
        try:
            bones = extensions[name]["humanoid"]["humanBones"]
            numbers = {
                HUMANOID[bone]: rank[entry["node"]]
                for bone, entry in bones.items()
                if bone in HUMANOID
            }
        except (KeyError, TypeError, AttributeError):
            continue
        return numbers
    return {}
