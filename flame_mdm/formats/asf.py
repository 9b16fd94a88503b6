"""ASF/AMC motion capture files (Acclaim, CMU): one file per skeleton, and one per motion.

An ASF file lists the bones of a subject. For each bone, it contains the bone's direction in world
coordinates and its length, both in the standing rest pose. It also contains the axes C of the
coordinate system in which the bone turns, and the bone's degrees of freedom. An AMC file contains
the angles of these degrees of freedom in each frame. If M is the rotation given by these angles,
the bone turns by C M C^-1 relative to its parent. With the order XYZ, for example, the rotation
about x is applied first: C = Rz Ry Rx.
"""

from __future__ import annotations

import warnings
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from flame_mdm.errors import UserError
from flame_mdm.formats.bvh import CHANNELS, MAX_JOINTS, Bvh, Lines, read_lines
from flame_mdm.formats.resampling import check_tree, frame_rate
from flame_mdm.safe_io import naming

MOVES = ("TX", "TY", "TZ")
TURNS = ("RX", "RY", "RZ")
_POSITIONS, _ROTATIONS = CHANNELS[:3], CHANNELS[:2:-1]


class Bone(NamedTuple):
    """A bone in an ASF file.

    Attributes:
        vector: (3,), from the start of the bone to its end.
        axes: the axes C, as a rotation.
        order: order of the axes, such as "XYZ".
        freedoms: names of the degrees of freedom, such as "RX", in the order in which the file
            lists them.
    """

    vector: np.ndarray
    axes: Rotation
    order: str
    freedoms: tuple[str, ...]


def read(path: Path, fps: float | None) -> Bvh:
    """Reads an AMC file and its skeleton as a tree of joints.

    Each bone becomes a joint with the bone's name, located at the start of the bone. The frame rate
    `fps` is required, because AMC files do not contain it. Most of CMU's recordings were captured
    at 120 frames per second.
    """
    lines = read_lines(path)
    bones, parents = read_skeleton(skeleton_of(path))
    if fps is None:
        raise UserError(
            f"{path}: AMC files contain no frame rate. Set fps=120, or add `fps: 120` to skeleton.yaml"
        )
    names = tuple(bones)
    inner = set(parents.values())
    parents |= {f"{name}.end": name for name in names if name not in inner}
    angles = _angles(lines, bones, 1 + len(parents))
    columns, channels = [], []
    for name, bone in bones.items():
        values = dict(zip(bone.freedoms, angles[name].T, strict=True))
        if name == "root":
            columns += [values.get(move, np.zeros(len(angles[name])))[:, None] for move in MOVES]
        if turns := [f"R{axis}" for axis in bone.order if f"R{axis}" in values]:
            order = "".join(turn[1] for turn in turns).lower()  # lower case: about fixed axes
            turned = Rotation.from_euler(
                order, np.stack([values[turn] for turn in turns], 1), degrees=True
            )
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # in gimbal lock, any third angle is equally good
                columns.append((bone.axes * turned * bone.axes.inv()).as_euler("ZYX", degrees=True))
        positions = _POSITIONS if name == "root" else ()
        channels.append(positions + (_ROTATIONS if turns else ()))
    numbers = {name: number for number, name in enumerate(names)}
    return Bvh(
        joints=("root", *parents),
        parents=(-1, *(numbers[parent] for parent in parents.values())),
        offsets=np.stack([np.zeros(3), *(bones[parent].vector for parent in parents.values())]),
        channels=(*channels, *[()] * (1 + len(parents) - len(names))),
        frames=np.concatenate(columns, 1),
        fps=frame_rate(fps),
    )


def skeleton_of(path: Path) -> Path:
    """Returns the ASF file that belongs to an AMC file in the same folder.

    The ASF file is named after the AMC file or its subject (02.asf), or is the only ASF file in the
    folder.

    Raises:
        UserError: If there is no such file.
    """
    candidates = (path.with_suffix(".asf"), path.with_name(path.stem.partition("_")[0] + ".asf"))
    files = sorted(path.parent.glob("*.asf"))
    chosen = next(
        (file for file in candidates if file.exists()), files[0] if len(files) == 1 else None
    )
    if chosen is None:
        raise UserError(
            f"{path}: found no skeleton {candidates[1].name} next to it. Put the ASF file into the same folder"
        )
    return chosen


def read_skeleton(path: Path) -> tuple[dict[str, Bone], dict[str, str]]:
    """Returns the bones in an ASF file, and the parent of every bone except the root.

    Parents precede their children.
    """
    lines = read_lines(path)
    read = {"root": Bone(np.zeros(3), Rotation.identity(), "XYZ", (*MOVES, *TURNS))}
    parents: dict[str, str] = {}
    section, fields = "", dict[str, list[str]]()
    for words in lines:
        word = words[0].lower()
        if word.startswith(":"):
            section = word
        elif section == ":units" and words == ["angle", "rad"]:
            lines.fail("angles in radians are not supported")
        elif section == ":root" and word == "order":
            freedoms = tuple(word.upper() for word in words[1:])
            read["root"] = read["root"]._replace(freedoms=freedoms)
        elif section == ":root" and word == "axis":
            read["root"] = read["root"]._replace(order=_order(lines, words[1:]))
        elif (
            section == ":root"
            and word in ("position", "orientation")
            and any(lines.numbers(words[1:], 3))
        ):
            lines.fail(f"a root whose {word} is not 0 0 0 is not supported")
        elif section == ":bonedata" and word == "begin":
            fields = {}
        elif section == ":bonedata" and word == "end":
            read[fields.get("name", [""])[0]] = _bone(lines, fields)
            if len(read) > MAX_JOINTS:
                lines.fail(f"more than {MAX_JOINTS} bones")
        elif section == ":bonedata":
            fields[word] = words[1:]
        elif section == ":hierarchy" and word not in ("begin", "end"):
            for child in words[1:]:
                has_parent = words[0] == "root" or words[0] in parents
                if child not in read or not has_parent or child == "root" or child in parents:
                    lines.fail(
                        f"bone {child[:40]} is unknown, has two parents, or precedes its parent"
                    )
                parents[child] = words[0]
    if not parents:
        lines.fail("not an ASF file (no bones in a :hierarchy)")
    return {name: read[name] for name in ("root", *parents)}, parents


def _bone(lines: Lines, fields: dict[str, list[str]]) -> Bone:
    if missing := [
        name for name in ("name", "direction", "length", "axis") if not fields.get(name)
    ]:
        lines.fail(f"a bone has no {missing[0]}")
    freedoms = tuple(word.upper() for word in fields.get("dof", ()))
    if not set(freedoms) <= set(TURNS) or len(set(freedoms)) < len(freedoms):
        lines.fail(
            f"degrees of freedom must be among rx, ry and rz, found {' '.join(fields['dof'])[:40]}"
        )
    direction, (length,) = lines.numbers(fields["direction"], 3), lines.numbers(fields["length"], 1)
    axis, order = lines.numbers(fields["axis"][:3], 3), _order(lines, fields["axis"][3:])
    axes = Rotation.from_euler(
        order.lower(), [axis["XYZ".index(letter)] for letter in order], degrees=True
    )
    return Bone(np.array(direction) * length, axes, order, freedoms)


def _order(lines: Lines, words: list[str]) -> str:
    order = "".join(words).upper()
    if sorted(order) != list("XYZ"):
        lines.fail(f"expected an axis order such as XYZ, found {order[:40]}")
    return order


def _angles(lines: Lines, bones: dict[str, Bone], joints: int) -> dict[str, np.ndarray]:
    """Returns each bone's angles (F, N) in degrees, where N is its number of degrees of freedom.

    Raises:
        UserError: If the file has too many frames for this number of `joints`.
    """
    rows: dict[str, list[list[float]]] = {name: [] for name, bone in bones.items() if bone.freedoms}
    frames = 0
    for words in chain(lines, [["0"]]):
        if words[0].upper() == ":RADIANS":
            lines.fail("angles in radians are not supported")
        elif words[0].startswith(":"):
            continue
        elif len(words) == 1 and words[0].isdigit():
            if absent := [name for name, values in rows.items() if len(values) != frames]:
                lines.fail(f"frame {frames} ends without {', '.join(absent)[:80]}")
            frames += 1
        elif words[0] not in rows or len(rows[words[0]]) != frames - 1:
            lines.fail(
                f"{words[0][:40]} is not a moving bone of the skeleton, is outside a frame, or occurs twice"
            )
        else:
            rows[words[0]].append(lines.numbers(words[1:], len(bones[words[0]].freedoms)))
    if frames < 2:
        lines.fail("not an AMC file (no frames)")
    with naming(lines.name):
        check_tree(frames, joints, lines.size)
    nothing = np.zeros((frames - 1, 0))
    return {name: np.array(rows[name], float) if name in rows else nothing for name in bones}
