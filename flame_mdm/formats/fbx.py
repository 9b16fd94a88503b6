"""Binary FBX files as trees of records.

`fbx_scene` reads motions from these trees, and `fbx_writer` writes motions as such trees.

Autodesk does not publish the format. The layout of the records, the arrays and the end of the file
is based on the description by the Blender Foundation
(https://code.blender.org/2013/08/fbx-binary-file-format-specification) and on files written by
Autodesk's own SDK. A record has a name, properties and nested records. Numbers are little-endian.
"""

import struct
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from flame_mdm.errors import UserError
from flame_mdm.safe_io import MEBIBYTE, atomic_write, regular_file

MAGIC = b"Kaydara FBX Binary  \x00\x1a\x00"
# FBX 7.4 from 2014 is the newest version with 32-bit offsets. All programs read it.
VERSION = 7400
# First version whose records have 64-bit offsets
WIDE_VERSION = 7500
# Earlier files store animations in a different structure
OLDEST_VERSION = 7000
# Maximum size of a file that is read
LIMIT = 512 * MEBIBYTE
# Maximum total size in bytes of all decompressed arrays in a file
EXPANDED_LIMIT = 512 * MEBIBYTE
# Maximum nesting depth of records; programs write about 8 levels
MAX_DEPTH = 32
# Maximum number of records in a file
MAX_RECORDS = 1_000_000
# The length of a name is stored in one byte
MAX_NAME = 255

# Format of a number by its type code
SCALARS = {
    "Y": "<h",
    "C": "<?",
    "I": "<i",
    "F": "<f",
    "D": "<d",
    "L": "<q",
}
# Type of an array's items by the array's type code
ARRAYS = {
    "f": "<f4",
    "d": "<f8",
    "l": "<i8",
    "i": "<i4",
    "b": "<u1",
    "c": "<u1",
}
DEFLATED = 128  # arrays of this many bytes or more are compressed

# Constants at the end of each file. All files without a password have the same constants.
FOOTER_ID = bytes.fromhex("fabcab09d0c8d466b176fb831cf7267e")
FOOTER_END = bytes.fromhex("f85a8c6adef5d97eece90ce3758f290b")


@dataclass(eq=False)
class Record:
    """A record in an FBX file.

    Attributes:
        name: name of the record, such as "Model".
        properties: values of type bool, int, float, str or bytes, or one-dimensional arrays.
            `write` stores an int as a 64-bit integer and a float as a double. `Int` and `Short` are
            stored as shorter integers.
        children: nested records.
        block: whether a terminator is written even if the record has no children. Some readers
            require this terminator.
    """

    name: str
    properties: list[Any] = field(default_factory=list)
    children: list["Record"] = field(default_factory=list)
    block: bool = False

    def add(self, name: str, *properties: Any, block: bool = False) -> "Record":
        """Appends a nested record and returns it."""
        record = Record(name, list(properties), block=block)
        self.children.append(record)
        return record

    def all(self, name: str) -> Iterator["Record"]:
        """Yields the nested records with the given name."""
        return (record for record in self.children if record.name == name)

    def first(self, name: str) -> "Record | None":
        """Returns the first nested record with the given name, or None."""
        return next(self.all(name), None)

    def value(self, name: str, default: Any = None) -> Any:
        """Returns the first property of the first nested record with the given name, or `default`."""
        record = self.first(name)
        if record is None or not record.properties:
            return default
        return record.properties[0]


class Int(int):
    """An integer that is stored as 32 bits."""


class Short(int):
    """An integer that is stored as 16 bits."""


def read(path: Path) -> Record:
    """Reads a binary FBX file of version 7 and returns the record that contains all others.

    Raises:
        UserError: If the file is too large or damaged, is an ASCII file, or has an earlier version.
    """
    regular_file(path, LIMIT)
    content = path.read_bytes()
    if not content.startswith(MAGIC[:18]):
        if content.lstrip()[:1] == b";" or b"FBXHeaderExtension" in content[:4096]:
            raise UserError(
                f"{path}: this is an ASCII FBX file. Export it as binary FBX, the default in most programs"
            )
        raise UserError(f"{path}: not an FBX file")
    try:
        (version,) = struct.unpack_from("<I", content, len(MAGIC))
        if not OLDEST_VERSION <= version < 9000:
            raise UserError(
                f"{path}: this is FBX version {version / 1000:g}, but only version 7 can be read. "
                "Export it as FBX 2014 or later"
            )
        return _Reader(content, version).read()
    except (ValueError, struct.error, zlib.error, UnicodeDecodeError) as error:
        if isinstance(error, UserError):
            raise
        raise UserError(f"{path}: damaged FBX file ({error})") from error


class _Reader:
    """Parses the records of a file and limits their total size."""

    def __init__(self, content: bytes, version: int) -> None:
        self.content = content
        self.head = struct.Struct("<QQQB" if version >= WIDE_VERSION else "<IIIB")
        self.records = 0
        self.expanded = 0  # size in bytes of all arrays read so far

    def read(self) -> Record:
        root = Record("")
        position = len(MAGIC) + 4
        while (parsed := self._record(position, len(self.content), 0)) is not None:
            record, position = parsed
            root.children.append(record)
        return root

    def _record(self, start: int, limit: int, depth: int) -> tuple[Record, int] | None:
        """Returns the record at `start` and its end position, or None at the end of a list."""
        end, count, size, length = self.head.unpack_from(self.content, start)
        if end == 0:
            return None
        self.records += 1
        position = start + self.head.size + length
        after = position + size
        if not position <= after <= end <= limit:
            raise ValueError(f"a record at byte {start} ends outside its parent")
        if depth > MAX_DEPTH or self.records > MAX_RECORDS:
            raise ValueError(
                f"it has more than {MAX_DEPTH} nesting levels or {MAX_RECORDS:,} records"
            )

        name = self.content[position - length : position].decode("utf-8", "replace")
        record = Record(name, self._properties(position, after, count))
        position = after
        while position < end:
            parsed = self._record(position, end, depth + 1)
            if parsed is None:
                break
            child, position = parsed
            record.children.append(child)
        return record, end

    def _properties(self, position: int, end: int, count: int) -> list[Any]:
        if count > end - position:
            raise ValueError(f"{count} properties do not fit into {end - position} bytes")
        values = []
        for _ in range(count):
            code = chr(self.content[position])
            position += 1
            if code in SCALARS:
                size = struct.calcsize(SCALARS[code])
                values.append(struct.unpack_from(SCALARS[code], self.content, position)[0])
            elif code in "SR":
                (length,) = struct.unpack_from("<I", self.content, position)
                position, size = position + 4, length
                text = self.content[position : position + size]
                values.append(text.decode("utf-8", "replace") if code == "S" else text)
            elif code in ARRAYS:
                items, encoding, size = struct.unpack_from("<III", self.content, position)
                position += 12
                packed = self.content[position : position + size]
                values.append(self._array(code, items, encoding, packed))
            else:
                raise ValueError(f"unknown property {code!r}")
            position += size
            if position > end:
                raise ValueError("a property ends outside its record")
        return values

    def _array(self, code: str, items: int, encoding: int, packed: bytes) -> np.ndarray:
        kind = np.dtype(ARRAYS[code])
        size = items * kind.itemsize
        self.expanded += size
        if self.expanded > EXPANDED_LIMIT:
            raise ValueError(f"its arrays take more than {EXPANDED_LIMIT // MEBIBYTE} MiB")
        if encoding == 1:
            unpacker = zlib.decompressobj()
            # One byte more than declared is decompressed, so that arrays that are too long are
            # detected.
            packed = unpacker.decompress(packed, size + 1)
        elif encoding != 0:
            raise ValueError(f"an array has the unknown encoding {encoding}")
        if len(packed) != size:
            raise ValueError(f"an array has {len(packed)} bytes, not {size}")
        return np.frombuffer(packed, kind)


def write(path: Path, root: Record) -> None:
    """Writes the records in `root` as a binary FBX file of version 7.4."""
    content = bytearray(MAGIC + struct.pack("<I", VERSION))
    _write_children(content, root.children)
    content += FOOTER_ID + bytes(4)
    content += bytes(16 - len(content) % 16)  # 1 to 16 bytes
    content += struct.pack("<I", VERSION) + bytes(120) + FOOTER_END
    with atomic_write(path) as temporary:
        temporary.write_bytes(content)


def _write_children(content: bytearray, records: Sequence[Record]) -> None:
    for record in records:
        _write_record(content, record)
    content += bytes(13)  # a record without content ends the list


def _write_record(content: bytearray, record: Record) -> None:
    start = len(content)
    name = record.name.encode()
    content += bytes(12) + bytes([len(name)]) + name  # the first 12 bytes are filled in below
    before = len(content)
    for value in record.properties:
        content += _packed(value)
    size = len(content) - before
    if record.children or record.block:
        _write_children(content, record.children)
    struct.pack_into("<III", content, start, len(content), len(record.properties), size)


def _packed(value: Any) -> bytes:
    """Returns a property as bytes."""
    if isinstance(value, bool | np.bool_):
        return b"C" + struct.pack("<?", value)
    if isinstance(value, Short):
        return b"Y" + struct.pack("<h", value)
    if isinstance(value, Int):
        return b"I" + struct.pack("<i", value)
    if isinstance(value, int | np.integer):
        return b"L" + struct.pack("<q", value)
    if isinstance(value, float | np.floating):
        return b"D" + struct.pack("<d", value)
    if isinstance(value, str):
        text = value.encode()
        return b"S" + struct.pack("<I", len(text)) + text
    if isinstance(value, bytes):
        return b"R" + struct.pack("<I", len(value)) + value
    return _packed_array(np.asarray(value))


def _packed_array(values: np.ndarray) -> bytes:
    code = {"f4": "f", "f8": "d", "i8": "l", "i4": "i"}[values.dtype.str[1:]]
    content = np.ascontiguousarray(values, ARRAYS[code]).tobytes()
    encoding = 0
    if len(content) >= DEFLATED:
        encoding, content = 1, zlib.compress(content)
    return code.encode() + struct.pack("<III", values.size, encoding, len(content)) + content
