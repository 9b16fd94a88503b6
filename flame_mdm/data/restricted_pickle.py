"""Restricted reader of pickles: arrays, numbers, text and plain containers; other content is never executed.

Two action data sets are published as pickles, a format in which a file can name any function and have it called. Even
NumPy's own functions are not safe to call with untrusted arguments (a wrong byte in a dtype crashes the interpreter),
so this module constructs arrays from their bytes.

Python's C unpickler allocates as much memory as a file of ten bytes requests. Therefore this reader is based on the
unpickler in Python: no read may request more bytes than are left in the file, and repeated content counts each time.
"""

from __future__ import annotations

import math
import pickle
import re
import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np

from flame_mdm.errors import first_line
from flame_mdm.safe_io import ARRAYS_LIMIT, INFLATION, regular_file

DTYPE = re.compile(r"[biufcSU]\d{1,9}|O8?")
NODE = 32
"""Minimum memory in bytes of a value in a container."""
MAX_NODES = 200_000
"""Number of values that is always allowed. Larger files may have one value per byte, which is exceeded only by
repetition."""
MAX_DEPTH = 20
"""Maximum depth of nested tuples: deallocating a tuple nested 100,000 times crashes the process."""
KEYS = (str, bytes, int, float, np.integer, np.floating, type(None))
"""Allowed types of dictionary keys and set members. For other types, a file could contain many values with the same
hash, which makes reading quadratic."""


OBJECTS = frozenset({"copy_reg._reconstructor", "copyreg._reconstructor", "__builtin__.object", "builtins.object"})
"""What pickles of old protocols name to make an object of a class."""


class _DType:
    """Placeholder of a dtype: a code such as f4, then the byte order."""

    def __init__(self, code: str, align: bool = False, copy: bool = False):
        if not DTYPE.fullmatch(code):
            raise pickle.UnpicklingError(f"an array of dtype {code[:40]!r}")
        self.dtype = np.dtype(code)

    def __setstate__(self, state: tuple) -> None:
        if state[1] in ("<", ">"):
            self.dtype = self.dtype.newbyteorder(state[1])


class _Array:
    """Placeholder of an array, whose content comes after other objects may already refer to it."""

    def __init__(self, kind: Any, shape: Any, code: Any):
        self.state: tuple = ()

    def __setstate__(self, state: tuple) -> None:
        self.state = state


ALLOWED: dict[str, Any] = {
    "numpy.ndarray": None,
    "numpy.dtype": _DType,
    **{f"numpy.{core}.multiarray._reconstruct": _Array for core in ("core", "_core")},
    **{f"numpy.{core}.multiarray.scalar": "scalar" for core in ("core", "_core")},
    **{f"numpy.{core}.numeric._frombuffer": "from_buffer" for core in ("core", "_core")},
    "_codecs.encode": "encode",
    **{f"{builtins}.{kind}": kind for builtins in ("builtins", "__builtin__") for kind in ("set", "frozenset")},
    **{f"{builtins}.complex": complex for builtins in ("builtins", "__builtin__")},
}
"""All globals that a pickle may name: arrays and numbers under NumPy's old and new paths, and plain values. A text NAME
refers to the method `make_NAME` of `_ArrayUnpickler`."""


class _Opaque:
    """Stands for an object of a class that is not loaded. Only its state is kept."""

    def __init__(self, *_: Any):
        self.state: Any = None

    def __setstate__(self, state: Any) -> None:
        self.state = state


class _File:
    """A file whose reads must not request more bytes than are left."""

    def __init__(self, file: IO[bytes], size: int):
        self.file, self.left = file, size

    def read(self, size: int) -> bytes:
        if size > self.left:
            raise EOFError("it ends too early")
        self.left -= size
        return self.file.read(size)

    def readline(self) -> bytes:
        line = self.file.readline()
        self.left -= len(line)
        return line


class _ArrayUnpickler(pickle._Unpickler):
    """Reads the pickle in a file of `size` bytes."""

    dispatch = dict(pickle._Unpickler.dispatch)  # noqa: RUF012
    stack: list[Any]
    memo: dict[int, Any]
    append: Callable[[Any], None]
    read: Callable[[int], bytes]

    def __init__(self, file: IO[bytes], size: int, opaque: tuple[str, ...] = ()):
        super().__init__(_File(file, size), encoding="latin1")  # as Python 2 wrote the bytes of arrays
        self.opaque = opaque
        self.size, self.budget = size, max(ARRAYS_LIMIT, INFLATION * size)
        self.nodes = max(MAX_NODES, size)
        self.depths: dict[int, tuple[int, tuple]] = {}

    def content(self) -> Any:
        """Returns the content of the pickle, in which placeholders are replaced by arrays."""
        value = self.load()
        self.memo.clear()
        self.depths.clear()
        return self._plain(value)

    def find_class(self, module_name: str, global_name: str, /) -> Any:
        name = f"{module_name}.{global_name}"
        if self.opaque and (name.startswith(self.opaque) or name in OBJECTS):
            return _Opaque
        if name not in ALLOWED:
            raise pickle.UnpicklingError(
                f"it names {name[:200]}, but only arrays, numbers, text and plain containers are read (anything else "
                "could run code); download the file from its owners"
            )
        allowed = ALLOWED[name]
        return getattr(self, f"make_{allowed}") if isinstance(allowed, str) else allowed

    def make_scalar(self, dtype: _DType, data: bytes) -> Any:
        """Returns a NumPy number."""
        return self._array(dtype, data, (1,), "C")[0]

    def make_from_buffer(self, data: bytes, dtype: _DType, shape: Sequence[int], order: Any) -> np.ndarray:
        """Returns an array in the encoding of protocol 5."""
        return self._array(dtype, data, shape, order)

    def make_encode(self, text: str, encoding: str) -> bytes:
        """Returns bytes in the encoding of protocols below 3."""
        if encoding != "latin1":
            raise pickle.UnpicklingError(f"bytes encoded as {encoding[:40]!r}")
        self._spend(len(text))
        return text.encode("latin1")

    def make_set(self, items: Sequence[Any] = ()) -> set:
        """Returns a set."""
        self._spend(NODE * len(items))
        return set(_keys(items))

    def make_frozenset(self, items: Sequence[Any] = ()) -> frozenset:
        """Returns a frozen set."""
        self._spend(NODE * len(items))
        return frozenset(_keys(items))

    def _spend(self, size: int) -> None:
        self.budget -= size
        if self.budget < 0:
            raise pickle.UnpicklingError("it unpacks to far more than its size; motion data does not")

    def _array(self, dtype: _DType, data: Any, shape: Sequence[int], order: Any) -> np.ndarray:
        """Returns an array of this type and shape from bytes or a list of objects."""
        if dtype.dtype != object:
            data = data.encode("latin1") if isinstance(data, str) else data
            self._spend(len(data))
            return np.frombuffer(data, dtype.dtype).reshape(shape, order=order).copy()
        if math.prod(shape) != len(data):
            raise pickle.UnpicklingError(f"{len(data)} objects in an array of shape {tuple(shape)}")
        self._spend(NODE * len(data))
        array = np.empty(len(data), object)
        for index, value in enumerate(data):
            array[index] = self._plain(value)
        return array.reshape(shape, order=order)

    def _plain(self, value: Any) -> Any:
        """Returns the value with placeholders replaced by arrays."""
        self.nodes -= 1
        if self.nodes < 0:
            self._spend(self.budget + 1)
        if isinstance(value, _Array):
            _, shape, dtype, is_fortran, data = value.state
            return self._array(dtype, data, shape, "F" if is_fortran else "C")
        if isinstance(value, _Opaque):
            return self._plain(value.state)
        if isinstance(value, dict):
            return {self._plain(key): self._plain(item) for key, item in value.items()}
        if isinstance(value, (list, tuple)):
            return type(value)(self._plain(item) for item in value)
        return value

    def _load_build(self) -> None:
        if not isinstance(self.stack[-2], (_DType, _Array, _Opaque)):
            raise pickle.UnpicklingError("it sets attributes of an object that is not an array")
        super().load_build()  # pyright: ignore[reportAttributeAccessIssue]

    def _load_bytearray8(self) -> None:
        self.append(bytearray(self.read(struct.unpack("<Q", self.read(8))[0])))

    def _check_tuple(self) -> None:
        made = self.stack[-1]
        depth = 1 + max((self.depths.get(id(part), (0,))[0] for part in made if isinstance(part, tuple)), default=0)
        if depth > MAX_DEPTH:
            raise pickle.UnpicklingError("nested too deeply")
        self.depths[id(made)] = depth, made  # the reference also keeps the id valid

    def _check_integer(self) -> None:
        if self.stack[-1].bit_length() > 64:  # arbitrarily many larger integers can have the same hash
            raise pickle.UnpicklingError("an integer of more than 64 bits")


def _keys(values: Sequence[Any]) -> Sequence[Any]:
    """Returns the values if all of them have types in `KEYS`."""
    if not all(isinstance(value, KEYS) for value in values):
        raise pickle.UnpicklingError("a key or a member of a set is neither a number nor text")
    return values


def _after_check(
    load: Callable[[Any], None], keys: Callable[[list[Any]], Sequence[Any]]
) -> Callable[[_ArrayUnpickler], None]:
    """Returns the handler of an opcode that takes keys from the stack; checks them first."""

    def checked(self: _ArrayUnpickler) -> None:
        _keys(keys(self.stack))
        load(self)

    return checked


def _then_check(
    load: Callable[[Any], None], check: Callable[[_ArrayUnpickler], None]
) -> Callable[[_ArrayUnpickler], None]:
    """Returns the handler of an opcode that checks the value it reads."""

    def checked(self: _ArrayUnpickler) -> None:
        load(self)
        check(self)

    return checked


_dispatch: Any = _ArrayUnpickler.dispatch
for _code in (pickle.TUPLE, pickle.TUPLE1, pickle.TUPLE2, pickle.TUPLE3):
    _dispatch[_code[0]] = _then_check(_dispatch[_code[0]], _ArrayUnpickler._check_tuple)
for _code in (pickle.LONG1, pickle.LONG4, pickle.LONG, pickle.INT):
    _dispatch[_code[0]] = _then_check(_dispatch[_code[0]], _ArrayUnpickler._check_integer)
_dispatch[pickle.SETITEM[0]] = _after_check(_dispatch[pickle.SETITEM[0]], lambda stack: stack[-2:-1])
for _code in (pickle.DICT, pickle.SETITEMS):
    _dispatch[_code[0]] = _after_check(_dispatch[_code[0]], lambda stack: stack[::2])
for _code in (pickle.ADDITEMS, pickle.FROZENSET):
    _dispatch[_code[0]] = _after_check(_dispatch[_code[0]], lambda stack: stack)
_dispatch[pickle.BUILD[0]] = _ArrayUnpickler._load_build
_dispatch[pickle.BYTEARRAY8[0]] = _ArrayUnpickler._load_bytearray8


def read(path: Path, opaque: tuple[str, ...] = ()) -> Any:
    """Returns the content of a pickle of arrays, numbers, text and builtin containers; protocols 0 to 5.

    Args:
        path: of the file.
        opaque: beginnings of names whose objects the file may hold, too. Nothing of them is loaded or run: the state of
            such an object takes its place.

    Raises:
        FileNotFoundError: the file does not exist.
        UserError: the path is not a regular file.
        ValueError: the file is damaged or names other globals; the message gives the file and the global.
    """
    size = regular_file(path)
    with path.open("rb") as file:
        try:
            return _ArrayUnpickler(file, size, opaque).content()
        except RecursionError as error:
            raise ValueError(f"{path}: not read as a pickle: nested too deeply") from error
        except Exception as error:  # a damaged pickle can fail in any way
            raise ValueError(f"{path}: not read as a pickle: {first_line(error)}") from error
