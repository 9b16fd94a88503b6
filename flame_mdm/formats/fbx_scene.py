"""Motions in FBX files: the models of a scene, evaluated in each frame of an animation.

According to the documentation of Autodesk's FBX SDK ("Computing transformation matrices"), the
transform of a model is

    T  Roff  Rp  Rpre  R  Rpost^-1  Rp^-1  Soff  Sp  S  Sp^-1

where T is the translation, R is the rotation and S is the scale. Roff and Soff are the offsets of
rotation and scale, Rp and Sp are their pivots, and Rpre and Rpost are the pre- and post-rotation.
"""

import math
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from flame_mdm.errors import UserError
from flame_mdm.formats import fbx
from flame_mdm.formats.animated import LARGEST, AnimatedNodes, choose, parents_first, world_matrices
from flame_mdm.formats.resampling import MAX_FRAMES, RATES

# Units of time per second in FBX files
TICKS = 46_186_158_000
# Meters per centimeter; `UnitScaleFactor` is the number of centimeters per unit
CENTIMETER = 0.01
# Maximum number of models in a scene
MAX_MODELS = 4096
# Maximum number of frames times models
MAX_CELLS = 4_000_000

# Order of Euler angles by `RotationOrder`, as in scipy: "xyz" rotates about the fixed axes x, y
# and z, in this order.
ORDERS = ("xyz", "xzy", "yzx", "yxz", "zxy", "zyx", "xyz")

# Frames per second by `TimeMode`; 0 and 14 mean the rate in `CustomFrameRate`
TIME_MODES = {
    1: 120.0,
    2: 100.0,
    3: 60.0,
    4: 50.0,
    5: 48.0,
    6: 30.0,
    7: 30.0,
    8: 30000 / 1001,
    9: 30000 / 1001,
    10: 25.0,
    11: 24.0,
    12: 1000.0,
    13: 24000 / 1001,
    15: 96.0,
    16: 72.0,
    17: 60000 / 1001,
    18: 120000 / 1001,
}

# Bits of `KeyAttrFlags`; without them, interpolation is linear
CONSTANT, CUBIC = 0x2, 0x8
# Bit for a constant segment that takes the value of the next key
NEXT_VALUE = 0x100
# A frame takes the value of a key that is up to this many seconds after the frame
UNSTEPPED = 1e-6

ZERO, ONE = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)


@dataclass(frozen=True, eq=False)
class Curve:
    """An animation curve: a number that depends on time.

    Attributes:
        times: (K,), times of the keys in seconds, in increasing order.
        values: (K,), value at each of these times.
        flags: (K,), method of interpolation from each key to the next.
        slopes: (K, 2), for cubic segments, the slopes per second after each key and before the next
            key.
    """

    times: np.ndarray
    values: np.ndarray
    flags: np.ndarray
    slopes: np.ndarray

    def at(self, times: np.ndarray) -> np.ndarray:
        """Returns the values (F,) at times (F,) in seconds.

        Before the first key, the result is the value of the first key. After the last key, the
        result is the value of the last key.
        """
        if len(self.times) == 1:
            return np.full(len(times), self.values[0])
        inside = np.clip(times, self.times[0], self.times[-1])
        segment = np.searchsorted(self.times, inside + UNSTEPPED, side="right") - 1
        segment = np.clip(segment, 0, len(self.times) - 2)
        begin, end = self.values[segment], self.values[segment + 1]
        seconds = self.times[segment + 1] - self.times[segment]
        share = np.clip((inside - self.times[segment]) / seconds, 0, 1)

        flags = self.flags[segment]
        linear = begin + share * (end - begin)
        held = np.where(flags & NEXT_VALUE, end, begin)
        held = np.where(share == 1, end, held)
        slopes = self.slopes[segment] * seconds[:, None]
        cubic = hermite(begin, end, slopes[:, 0], slopes[:, 1], share)
        values = np.where(flags & CUBIC, cubic, np.where(flags & CONSTANT, held, linear))
        return np.where(times < self.times[0], self.values[0], values)


def hermite(begin: Any, end: Any, leaving: Any, arriving: Any, share: Any) -> Any:
    """Evaluates the cubic Hermite spline between two keys at the fraction `share`, from 0 to 1.

    `leaving` and `arriving` are the slopes at the two keys, per segment.
    """
    squared, cubed = share**2, share**3
    return (
        (2 * cubed - 3 * squared + 1) * begin
        + (cubed - 2 * squared + share) * leaving
        + (3 * squared - 2 * cubed) * end
        + (cubed - squared) * arriving
    )


@dataclass(eq=False)
class _Model:
    """A node of the scene: its properties, and its animation curves, keyed by property and axis."""

    name: str
    properties: dict[str, tuple[float, ...]]
    parent: int = 0  # id of the parent model; 0 = the scene
    curves: dict[str, dict[int, Curve]] = field(default_factory=dict)

    def vector(self, name: str, default: tuple[float, float, float] = ZERO) -> np.ndarray:
        value = self.properties.get(name, default)
        return np.array(value if len(value) == 3 else default, float)

    def number(self, name: str) -> int:
        value = self.properties.get(name, (0,))
        return int(value[0]) if value and abs(value[0]) < 1000 else 0

    def animated(
        self, name: str, default: tuple[float, float, float], times: np.ndarray
    ) -> np.ndarray:
        """Returns a property's values (F, 3) at times (F,)."""
        values = np.tile(self.vector(name, default), (len(times), 1))
        for axis, curve in self.curves.get(name, {}).items():
            values[:, axis] = curve.at(times)
        return values

    def local(self, times: np.ndarray) -> np.ndarray:
        """Returns the matrices (F, 4, 4) from local to parent coordinates at times (F,)."""
        active = bool(self.number("RotationActive"))
        order = ORDERS[self.number("RotationOrder") % len(ORDERS)] if active else "xyz"
        before = euler("xyz", self.vector("PreRotation")) if active else np.eye(3)
        after = euler("xyz", self.vector("PostRotation")) if active else np.eye(3)
        pivot, offset = self.vector("RotationPivot"), self.vector("RotationOffset")
        size_pivot, size_offset = self.vector("ScalingPivot"), self.vector("ScalingOffset")

        turns = before @ euler(order, self.animated("Lcl Rotation", ZERO, times)) @ after.T
        scaled = turns * self.animated("Lcl Scaling", ONE, times)[:, None, :]
        matrices = np.zeros((len(times), 4, 4))
        matrices[:, :3, :3] = scaled
        matrices[:, 3, 3] = 1
        moved = self.animated("Lcl Translation", ZERO, times) + offset + pivot
        moved += turns @ (size_offset + size_pivot - pivot) - scaled @ size_pivot
        matrices[:, :3, 3] = moved
        return matrices


def euler(order: str, degrees: np.ndarray) -> np.ndarray:
    """Returns rotations (..., 3, 3) for angles (..., 3), in degrees, about x, y and z.

    The rotations are applied in `order`.
    """
    angles = degrees[..., ["xyz".index(axis) for axis in order]]
    return Rotation.from_euler(order, angles, degrees=True).as_matrix()


def read(path: Path, animation: str | int | None = None) -> AnimatedNodes:
    """Reads a motion from a binary FBX file of version 7.

    Args:
        path: the file.
        animation: name or 1-based number of the take, or None for the first take that contains
            keys.

    Raises:
        UserError: If the file is damaged, contains no animation, or contains several animation
            layers with keys.
    """
    root = fbx.read(path)
    try:
        return _Scene(root).motion(animation)
    except UserError as error:
        raise UserError(f"{path}: {error}") from error
    except (ValueError, TypeError, IndexError, OverflowError) as error:
        raise UserError(f"{path}: damaged FBX file ({error})") from error


def animations(path: Path) -> list[str]:
    """Returns the names of those takes in an FBX file that contain keys."""
    root = fbx.read(path)
    try:
        return [name for name, _ in _Scene(root).takes()]
    except (ValueError, TypeError, IndexError) as error:
        raise UserError(f"{path}: damaged FBX file ({error})") from error


class _Scene:
    """The objects of a file, keyed by id, and their connections."""

    def __init__(self, root: fbx.Record) -> None:
        objects = root.first("Objects") or fbx.Record("")
        connections = root.first("Connections") or fbx.Record("")
        self.settings = _properties(root.first("GlobalSettings"))
        defaults = _model_defaults(root)
        self.records = {
            record.properties[0]: record for record in objects.children if _is_object(record)
        }

        self.models: dict[int, _Model] = {}
        for number, record in self.records.items():
            if record.name == "Model":
                self.models[number] = _Model(_name(record), defaults | _properties(record))
        if len(self.models) > MAX_MODELS:
            raise ValueError(f"it has more than {MAX_MODELS} models")

        # For each object id, the ids of the connected objects and the properties to which they
        # are connected
        self.below: dict[int, list[tuple[int, str]]] = defaultdict(list)
        for record in connections.all("C"):
            if len(record.properties) < 3:
                raise ValueError("a connection does not specify its two objects")
            kind, child, parent, *names = record.properties
            self.below[parent].append((child, str(names[0]) if kind == "OP" and names else ""))
            if child in self.models and parent in self.models and kind == "OO":
                self.models[child].parent = parent

    def takes(self) -> list[tuple[str, int]]:
        """Returns the name and the layer id of each animation that contains keys."""
        takes = []
        for number, record in self.records.items():
            if record.name != "AnimationStack":
                continue
            layers = [layer for layer in self._below(number, "AnimationLayer") if self._keys(layer)]
            if len(layers) > 1:
                raise UserError(
                    f"{len(layers)} animation layers in {_name(record)}. Bake or merge them into one"
                )
            takes += [(_name(record), layer) for layer in layers]
        return takes

    def _below(self, number: int, kind: str) -> list[int]:
        ids = [child for child, _ in self.below[number]]
        return [
            child for child in ids if child in self.records and self.records[child].name == kind
        ]

    def _keys(self, layer: int) -> list[tuple[int, int, int]]:
        """Returns each curve in a layer, with its curve node and its axis."""
        axes = {"d|X": 0, "d|Y": 1, "d|Z": 2}
        curves = []
        for node in self._below(layer, "AnimationCurveNode"):
            for curve, name in self.below[node]:
                if (
                    name in axes
                    and curve in self.records
                    and self.records[curve].name == "AnimationCurve"
                ):
                    curves.append((node, axes[name], curve))
        return curves

    def motion(self, animation: str | int | None) -> AnimatedNodes:
        name, layer = choose(self.takes(), animation)
        animated = {  # model and property of each curve node
            node: (model, target)
            for model in self.models
            for node, target in self.below[model]
            if target.startswith("Lcl ")
        }
        curves: list[Curve] = []
        for node, axis, number in self._keys(layer):
            if node in animated:
                model, target = animated[node]
                curves.append(_curve(self.records[number]))
                self.models[model].curves.setdefault(target, {})[axis] = curves[-1]
        if not curves:
            raise UserError(
                "contains no animation for its bones. Export the file with its animation"
            )

        fps = self._rate()
        start = min(curve.times[0] for curve in curves)
        stop = max(curve.times[-1] for curve in curves)
        count = math.floor((stop - start) * fps + 1e-3) + 1
        if count > MAX_FRAMES or count * len(self.models) > MAX_CELLS:
            raise ValueError(f"{count} frames with {len(self.models)} models are too many")
        times = start + np.arange(count) / fps

        numbers = list(self.models)
        rank = {number: index for index, number in enumerate(numbers)}
        above = [rank.get(self.models[number].parent, -1) for number in numbers]
        order = parents_first(above)
        position = {index: number for number, index in enumerate(order)}
        parents = tuple(position[above[index]] if above[index] >= 0 else -1 for index in order)
        models = [self.models[numbers[index]] for index in order]
        with np.errstate(all="ignore"):
            worlds = world_matrices(parents, np.stack([model.local(times) for model in models], 1))
            positions = worlds[..., :3, 3] @ self._axes().T * self._unit()
        if not (np.abs(positions) <= LARGEST).all():
            raise ValueError("numbers are not finite, or too large")
        names = tuple(model.name for model in models)
        return AnimatedNodes(names, parents, positions, fps, name, {}, self._unit())

    def _setting(self, name: str, default: float) -> float:
        value = self.settings.get(name, (default,))
        return value[0] if len(value) == 1 else default

    def _rate(self) -> float:
        custom = self._setting("CustomFrameRate", 0)
        rate = TIME_MODES.get(int(self._setting("TimeMode", 0)), custom)
        return rate if RATES[0] <= rate <= RATES[1] else 30.0

    def _unit(self) -> float:
        scale = self._setting("UnitScaleFactor", 1)
        return CENTIMETER * (scale if 0 < scale < LARGEST else 1)

    def _axes(self) -> np.ndarray:
        """Returns the rotation (3, 3) from the file's axes to x left, y up and z forward."""
        axes = np.zeros((3, 3))
        for row, name, usual in ((0, "Coord", 0), (1, "Up", 1), (2, "Front", 2)):
            axis = int(self._setting(f"{name}Axis", usual))
            sign = self._setting(f"{name}AxisSign", 1)
            if axis not in (0, 1, 2):
                raise ValueError(f"{name}Axis is {axis}")
            axes[row, axis] = -1 if sign < 0 else 1
        if not np.isclose(np.linalg.det(axes), 1):
            return np.eye(3)  # such axes are not right-handed, and programs ignore them
        return axes


def _is_object(record: fbx.Record) -> bool:
    return len(record.properties) >= 2 and isinstance(record.properties[0], int)


def _name(record: fbx.Record) -> str:
    """Returns the name of an object.

    The file stores the name together with the object's class.
    """
    name = record.properties[1]
    return str(name).partition("\x00")[0] or record.name


def _properties(record: fbx.Record | None) -> dict[str, tuple[float, ...]]:
    """Returns the numeric properties of an object, keyed by name."""
    block = record.first("Properties70") if record else None
    properties = {}
    for entry in block.all("P") if block else ():
        numbers = tuple(entry.properties[4:])
        if numbers and all(
            isinstance(number, int | float) and abs(number) < LARGEST for number in numbers
        ):
            properties[str(entry.properties[0])] = tuple(map(float, numbers))
    return properties


def _model_defaults(root: fbx.Record) -> dict[str, tuple[float, ...]]:
    """Returns the default properties of models, which are stored in the file's template."""
    definitions = root.first("Definitions")
    for kind in definitions.all("ObjectType") if definitions else ():
        if kind.properties[:1] == ["Model"]:
            return _properties(kind.first("PropertyTemplate"))
    return {}


def _curve(record: fbx.Record) -> Curve:
    times = np.atleast_1d(np.asarray(record.value("KeyTime", ()), float)) / TICKS
    values = np.atleast_1d(np.asarray(record.value("KeyValueFloat", ()), float))
    if not len(times) or len(times) != len(values):
        raise ValueError("an animation curve has no keys, or lacks a value for a key")
    if not (np.diff(times) > 0).all() or not (np.abs(values) < LARGEST).all():
        raise ValueError("keys of an animation curve are not in order, or not finite")

    flags = np.atleast_1d(np.asarray(record.value("KeyAttrFlags", ()), np.int64))
    counts = np.atleast_1d(np.asarray(record.value("KeyAttrRefCount", ()), np.int64))
    floats = np.atleast_1d(np.asarray(record.value("KeyAttrDataFloat", ()), float))
    slopes = np.zeros((len(times), 2))
    if not len(flags):
        return Curve(times, values, np.zeros(len(times), np.int64), slopes)
    if len(counts) != len(flags) or (counts < 0).any() or counts.sum() != len(times):
        raise ValueError("attributes of an animation curve do not match its keys")
    if len(floats) == 4 * len(flags):
        slopes = np.repeat(floats.reshape(-1, 4)[:, :2], counts, axis=0)
    return Curve(times, values, np.repeat(flags, counts), slopes)
