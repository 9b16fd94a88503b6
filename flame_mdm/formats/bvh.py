"""BVH motion capture files: reading, forward kinematics, resampling and writing.

A BVH file contains a tree of joints with offsets, and a table of numbers with one row per frame and
one column per channel. The rotation channels of a joint are intrinsic Euler angles in degrees, in
the listed order: `Zrotation Xrotation Yrotation` means R = Rz Rx Ry on column vectors. Position
channels replace the joint's offset.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import NoReturn

import numpy as np
from scipy.spatial.transform import Rotation

from flame_mdm.errors import UserError
from flame_mdm.formats.resampling import MAX_FRAMES, RATES, check_tree, frame_pairs, interpolate
from flame_mdm.safe_io import TEXT_LIMIT, naming, regular_file, write_text

CHANNELS = tuple(f"{axis}{kind}" for kind in ("position", "rotation") for axis in "XYZ")
# Maximum number of joints and end sites in a file
MAX_JOINTS = 4096
# Maximum sum of the absolute values of the numbers in a line
LARGEST = 1e9


@dataclass(frozen=True, eq=False)
class Bvh:
    """A skeleton and its motion, with J joints, F frames and C channels.

    Lengths are in the unit of the file.
    """

    # Names of the J joints. The end site of a joint counts as a joint without channels and is
    # called `NAME.end`.
    joints: tuple[str, ...]
    # Index of each joint's parent, smaller than the joint's own index, or -1 for a root
    parents: tuple[int, ...]
    # (J, 3) float64, rest position of each joint in its parent's frame
    offsets: np.ndarray
    # For each joint, the names of its channels (see `CHANNELS`) in the order of the columns
    channels: tuple[tuple[str, ...], ...]
    # (F, C) float64, the channels of all joints in joint order; angles in degrees
    frames: np.ndarray
    fps: float  # frames per second

    def columns(self) -> list[slice]:
        """Returns the columns of `frames` that contain each joint's channels."""
        ends = list(itertools.accumulate(map(len, self.channels)))
        return [
            slice(end - len(names), end) for end, names in zip(ends, self.channels, strict=True)
        ]

    def rotations(self) -> np.ndarray:
        """Returns the joint rotations relative to the joints' parents, with shape (F, J, 3, 3)."""
        rotations = np.tile(np.eye(3), (len(self.frames), len(self.joints), 1, 1))
        for joint, (names, column) in enumerate(zip(self.channels, self.columns(), strict=True)):
            turning = [k for k, name in enumerate(names) if name.endswith("rotation")]
            if turning:
                order = "".join(names[k][0] for k in turning)
                angles = self.frames[:, column][:, turning]
                rotations[:, joint] = Rotation.from_euler(order, angles, degrees=True).as_matrix()
        return rotations

    def translations(self) -> np.ndarray:
        """Returns the joint positions in the parents' coordinates, with shape (F, J, 3).

        Positions are read from the position channels. A joint without position channels stays at
        its offset.
        """
        translations = np.tile(self.offsets, (len(self.frames), 1, 1))
        for joint, (names, column) in enumerate(zip(self.channels, self.columns(), strict=True)):
            for k, name in enumerate(names):
                if name.endswith("position"):
                    translations[:, joint, "XYZ".index(name[0])] = self.frames[:, column.start + k]
        return translations

    def positions(self) -> np.ndarray:
        """Returns the world positions of the joints, with shape (F, J, 3)."""
        return forward_kinematics(self.parents, self.rotations(), self.translations())[0]

    def resample(self, fps: float, cubic: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """Resamples the motion at times 0, 1/fps, ... up to the last frame.

        Returns rotations (F', J, 3, 3) and translations (F', J, 3). Rotations are interpolated on
        the sphere (slerp), so that bones keep their lengths. Translations are interpolated
        linearly, or by cubic splines if `cubic` is set.
        """
        before, after, share = frame_pairs(
            len(self.frames), self.fps, fps, len(self.joints), slack=0
        )
        translations = self.translations()
        share = share[:, None, None]
        if cubic:
            moved = interpolate(translations, before + share[:, 0, 0])
        else:
            moved = (1 - share) * translations[before] + share * translations[after]
        rotations = self.rotations()
        turn = rotations[before].mT @ rotations[after]
        vectors = Rotation.from_matrix(turn.reshape(-1, 3, 3)).as_rotvec().reshape(turn.shape[:3])
        part = (
            Rotation.from_rotvec((share * vectors).reshape(-1, 3)).as_matrix().reshape(turn.shape)
        )
        return rotations[before] @ part, moved


def forward_kinematics(
    parents: Sequence[int], rotations: np.ndarray, translations: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Returns world positions (F, J, 3) and world rotations (F, J, 3, 3).

    G_j = G_p R_j and p_j = p_p + G_p t_j, where p is the parent of j.

    Args:
        parents: index of each joint's parent, or -1 for a root. Parents precede their children.
        rotations: (F, J, 3, 3), relative to the parents.
        translations: (F, J, 3), in the parents' coordinates.
    """
    positions, turned = translations.copy(), rotations.copy()
    for joint, parent in enumerate(parents):
        if parent >= 0:
            turned[:, joint] = turned[:, parent] @ rotations[:, joint]
            bone = turned[:, parent] @ translations[:, joint, :, None]
            positions[:, joint] = positions[:, parent] + bone[..., 0]
    return positions, turned


def read_lines(path: str | Path) -> Lines:
    """Reads a text file. Raises `UserError` if the file is too large or not UTF-8."""
    regular_file(path, TEXT_LIMIT)
    return Lines(Path(path).read_bytes(), str(path))


def read(path: str | Path) -> Bvh:
    """Reads a BVH file.

    If the file is incomplete or invalid, raises a `UserError` that names the file and the line.
    """
    source = read_lines(path)
    if [word.upper() for word in next(iter(source), [])] != ["HIERARCHY"]:
        source.fail("not a BVH file (it must begin with HIERARCHY)")
    nodes: list[_Node] = []
    blocks: list[int] = []  # indices of the nodes whose braces are open

    while (keyword := source.word().upper()) != "MOTION":
        parent = blocks[-1] if blocks else -1
        node = nodes[parent] if blocks else _Node("", -1, ("ROOT",))
        if keyword not in node.keywords:
            source.fail(f"unexpected {keyword[:40]}")
        if len(nodes) > MAX_JOINTS:
            source.fail(f"more than {MAX_JOINTS} joints and end sites")
        if keyword == "OFFSET":
            node.offset = source.numbers([source.word() for _ in range(3)], 3)
        elif keyword == "CHANNELS":
            node.channels = tuple(
                source.word().capitalize()
                for _ in range(int(source.numbers([source.word()], 1)[0]))
            )
            if len(set(node.channels)) < len(node.channels) or not set(node.channels) <= set(
                CHANNELS
            ):
                names = " ".join(node.channels)[:80]
                source.fail(
                    f"channels must be distinct and among {', '.join(CHANNELS)}, found {names}"
                )
        elif keyword == "}":
            if not node.offset:
                source.fail("a joint or end site has no OFFSET")
            blocks.pop()
        else:
            name = source.word("SITE") if keyword == "END" else source.name_of_joint()
            blocks.append(len(nodes))
            nodes.append(
                _Node(f"{node.name}.end", parent, _IN_END)
                if keyword == "END"
                else _Node(name, parent)
            )
            source.word("{")
    if blocks or not nodes or source.row[-1].upper() != "MOTION":
        source.fail("expected MOTION after the hierarchy, as the last word on its line")

    count = int(source.labeled(r"Frames:\s*(\d{1,18})", "Frames: and a number"))
    # The number of digits is limited, because Python needs quadratic time to parse long numbers.
    pattern = r"Frame Time:\s*((?:\d{1,9}(?:\.\d{1,30})?|\.\d{1,30})(?:E[-+]?\d{1,3})?)"
    seconds = source.labeled(pattern, "Frame Time: and a number of seconds")
    time = float(seconds)
    if not 1 / RATES[1] <= time <= 1 / RATES[0]:
        source.fail(f"the frame time must be between {1 / RATES[1]:g} and {1 / RATES[0]:g} seconds")
    # A rounded time such as 0.0333333 (1/30) is read as an integer frame rate. Otherwise,
    # resampling could move the last frame past the end.
    whole, last_digit = max(round(1 / time), 1), 10.0 ** int(Decimal(seconds).as_tuple().exponent)
    fps = float(whole) if abs(1 / whole - time) < min(last_digit, 0.01 * time) else 1 / time
    width = sum(len(node.channels) for node in nodes)
    rows = (np.array(source.numbers(words, width)) for words in source)
    frames = list(itertools.islice(rows, MAX_FRAMES + 1))
    with naming(source.name):
        check_tree(len(frames), len(nodes), source.size)
    if len(frames) != count or not frames:
        source.fail(f"the file contains {len(frames)} frames, but declares {count}")
    return Bvh(
        tuple(node.name for node in nodes),
        tuple(node.parent for node in nodes),
        np.array([node.offset for node in nodes], float),
        tuple(node.channels for node in nodes),
        np.array(frames),
        fps,
    )


_IN_JOINT, _IN_END = ("OFFSET", "CHANNELS", "JOINT", "END", "}"), ("OFFSET", "}")


@dataclass
class _Node:
    """A joint or end site in a hierarchy, and the keywords allowed inside its braces."""

    name: str
    parent: int
    keywords: tuple[str, ...] = _IN_JOINT
    offset: Sequence[float] = ()
    channels: tuple[str, ...] = ()


class Lines:
    """Splits the lines of a text file into words, and skips blank lines and comments (#).

    The current line number is kept for error messages.
    """

    def __init__(self, data: bytes, name: str):
        self.name, self.size, self.line, self.row = name, len(data), 1, list[str]()
        try:
            lines = data.decode("utf-8-sig").splitlines()
        except UnicodeDecodeError as error:
            self.line = data.count(b"\n", 0, error.start) + 1
            self.fail("not UTF-8 text")
        self.lines = (
            (number, line.split())
            for number, line in enumerate(lines, 1)
            if not line.startswith("#")
        )
        # Words of the current line that have not been read yet, in reverse order
        self.pending: list[str] = []

    def __iter__(self) -> Iterator[list[str]]:
        for number, words in self.lines:
            if words:
                self.line, self.row = number, words
                yield words

    def fail(self, fault: str) -> NoReturn:
        """Raises a `UserError` that names the file and the current line."""
        raise UserError(f"{self.name}, line {self.line}: {fault}")

    def word(self, expected: str = "") -> str:
        """Returns the next word of the hierarchy.

        If `expected` is not empty, the word must match `expected`, ignoring case.
        """
        if not self.pending:
            self.pending = next(iter(self), [])[::-1]
        if not self.pending:
            self.fail("the file ends inside the hierarchy")
        word = self.pending.pop()
        if expected and word.upper() != expected:
            self.fail(f"expected {expected}, found {word[:40]}")
        return word

    def name_of_joint(self) -> str:
        """Returns the name of a joint: the rest of the line up to a brace.

        Names may contain spaces.
        """
        words = [self.word()]
        while self.pending and self.pending[-1] != "{":
            words.append(self.pending.pop())
        return " ".join(words)

    def numbers(self, words: Sequence[str], count: int) -> list[float]:
        """Converts the words to `count` finite numbers."""
        try:
            values = [float(word) for word in words]
        except ValueError:
            values = [math.nan]
        if len(values) != count or not sum(map(abs, values)) <= LARGEST:
            self.fail(f"expected {count} finite number(s), found {' '.join(words)[:40]}")
        return values

    def labeled(self, pattern: str, expected: str) -> str:
        """Returns the part of the next line that matches the first group of `pattern`."""
        line = " ".join(next(iter(self), []))
        if not (match := re.fullmatch(pattern, line, re.IGNORECASE)):
            self.fail(f"expected {expected}, found {line[:40] or 'the end of the file'}")
        return match[1]


def write(bvh: Bvh, path: str | Path) -> None:
    """Writes a BVH file. Reading the file with `read` returns the same numbers.

    Joints are written in depth-first order.
    """
    children: list[list[int]] = [[] for _ in bvh.joints]
    for joint, parent in enumerate(bvh.parents):
        if parent >= 0:
            children[parent].append(joint)
    lines, order, columns = ["HIERARCHY"], list[int](), bvh.columns()
    stack = [(0, joint, False) for joint, parent in enumerate(bvh.parents) if parent < 0][::-1]
    while stack:
        depth, joint, closing = stack.pop()
        indent, name, channels = "\t" * depth, bvh.joints[joint], bvh.channels[joint]
        if closing:
            lines.append(f"{indent}}}")
            continue
        is_end = name.endswith(".end") and not channels and not children[joint]
        head = "End Site" if is_end else f"{'JOINT' if depth else 'ROOT'} {name}"
        lines += [
            f"{indent}{head}",
            f"{indent}{{",
            f"{indent}\tOFFSET {_numbers(bvh.offsets[joint])}",
        ]
        if not is_end:
            lines.append(" ".join([f"{indent}\tCHANNELS", str(len(channels)), *channels]))
        order.append(joint)
        stack.append((depth, joint, True))
        stack += [(depth + 1, child, False) for child in reversed(children[joint])]
    lines += ["MOTION", f"Frames: {len(bvh.frames)}", f"Frame Time: {1 / bvh.fps!r}"]
    lines += map(_numbers, bvh.frames[:, np.r_[tuple(columns[joint] for joint in order)]])
    write_text(path, "\n".join(lines) + "\n")


def _numbers(row: np.ndarray) -> str:
    return " ".join(map(repr, row.tolist()))
