"""Restricted reader of pickles: arrays, numbers, text, lists, tuples and dictionaries with text keys.

Some data sets are published as pickles, a format in which a file can name any function and have it called. This reader
calls none: each object is kept as its name, arguments and state, and arrays are made from the bytes among them. Not
even NumPy's own functions would be safe, because a wrong byte in a dtype crashes the interpreter.

Python's C unpickler allocates as much memory as a file of ten bytes requests. Therefore this reader is based on the
unpickler in Python: no read may request more bytes than are left in the file, and repeated content counts each time.
"""

import pickle
import re
import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np

from flame_mdm.errors import UserError, first_line
from flame_mdm.safe_io import check_expansion, regular_file

DTYPE = re.compile(r"[biufcSU]\d{1,9}|O8?")
VALUE = 512  # bytes that each value counts as, so that a small file cannot repeat lists without end


class _Object:
    """An object of a pickle. Nothing is loaded or called to make it."""

    arguments: tuple = ()
    state: Any = None

    def __init__(self, *arguments: Any):
        self.arguments = arguments

    def __setstate__(self, state: Any) -> None:
        self.state = state


ALLOWED = {
    name: type(name, (_Object,), {})
    for name in (
        *("numpy.ndarray", "numpy.dtype", "numpy.core.multiarray._reconstruct", "numpy.core.multiarray.scalar"),
        *("numpy.core.numeric._frombuffer", "_codecs.encode"),
    )
}
"""All globals that a pickle may name -> the class of their objects."""
BASES = frozenset({"copy_reg._reconstructor", "copyreg._reconstructor", "__builtin__.object", "builtins.object"})
"""Globals that old protocols name to make an object of a class."""


class _File:
    """A file whose reads must not request more bytes than are left."""

    def __init__(self, file: IO[bytes], size: int):
        self.file, self.size, self.readline = file, size, file.readline

    def read(self, size: int) -> bytes:
        if size > self.size - self.file.tell():
            raise EOFError("it ends too early")
        return self.file.read(size)


class _Unpickler(pickle._Unpickler):
    """Reads the pickle in a file of `size` bytes; objects of names that begin with one of `opaque` become states."""

    dispatch = dict(pickle._Unpickler.dispatch)  # noqa: RUF012
    stack: list[Any]
    append: Callable[[Any], None]
    read: Callable[[int], bytes]

    def __init__(self, file: IO[bytes], size: int, opaque: tuple[str, ...]):
        super().__init__(_File(file, size), encoding="latin1")  # as Python 2 wrote the bytes of arrays
        self.opaque, self.size, self.expanded = opaque, size, 0

    def find_class(self, module_name: str, global_name: str, /) -> type[_Object]:
        name = f"{module_name}.{global_name}"
        if self.opaque and (name.startswith(self.opaque) or name in BASES):
            return _Object
        kind = ALLOWED.get(name.replace("numpy._core.", "numpy.core."))
        if kind is None:
            raise pickle.UnpicklingError(
                f"it names {name[:200]}, but only arrays, numbers, text and plain containers are read (anything else "
                "could run code); download the file from its owners"
            )
        return kind

    def plain(self, value: Any) -> Any:
        """Returns a value with arrays, numbers and text in place of the objects of the pickle."""
        self.count(VALUE)
        match value:
            case _Object():
                return self.plain_object(type(value).__name__, value)
            case dict():
                return {key: self.plain(item) for key, item in value.items()}
            case list() | tuple():
                return type(value)(self.plain(item) for item in value)
        return value

    def plain_object(self, name: str, value: _Object) -> Any:
        """Returns the array, number or text that an object describes; for opaque objects, their state."""
        if name == "numpy.core.multiarray._reconstruct":
            _, shape, dtype, is_fortran, data = value.state
            return self.array(data, dtype, shape, "F" if is_fortran else "C")
        if name == "numpy.core.numeric._frombuffer":
            return self.array(*value.arguments)
        if name == "numpy.core.multiarray.scalar":
            dtype, data = value.arguments
            return self.array(data, dtype, (1,), "C")[0]
        if name == "_codecs.encode":
            text, encoding = value.arguments
            self.count(len(text))
            if encoding != "latin1":
                raise pickle.UnpicklingError(f"bytes encoded as {encoding[:40]!r}")
            return text.encode("latin1")
        return self.plain(value.state)

    def array(self, data: Any, dtype: _Object, shape: Sequence[int], order: Any) -> np.ndarray:
        """Returns an array: a view of its bytes, or a copy of a list of objects."""
        code, data = dtype.arguments[0], self.plain(data)
        if not DTYPE.fullmatch(code):
            raise pickle.UnpicklingError(f"an array of dtype {code[:40]!r}")
        kind = np.dtype(code)
        if dtype.state and dtype.state[1] in ("<", ">"):
            kind = kind.newbyteorder(dtype.state[1])
        self.count(len(data))
        if kind.hasobject:
            return np.fromiter(data, object, len(data)).reshape(shape, order=order)
        data = data.encode("latin1") if isinstance(data, str) else data
        return np.frombuffer(data, kind).reshape(shape, order=order)

    def count(self, size: int) -> None:
        """Adds to the number of bytes that the content takes."""
        self.expanded += size
        check_expansion(self.expanded, self.size)

    def _load_build(self) -> None:
        if not isinstance(self.stack[-2], _Object):
            raise pickle.UnpicklingError("it sets attributes of a value that is not an object")
        super().load_build()  # pyright: ignore[reportAttributeAccessIssue]

    def _load_bytearray8(self) -> None:
        self.append(bytearray(self.read(struct.unpack("<Q", self.read(8))[0])))

    def _refuse_set(self) -> None:
        raise pickle.UnpicklingError("a set, which no data set contains")


def _with_text_keys(load: Callable[[Any], None], first: int) -> Callable[[_Unpickler], None]:
    """Returns the handler of an opcode that takes keys from index `first`: others than text could share a hash."""

    def checked(self: _Unpickler) -> None:
        if not all(type(key) is str for key in self.stack[first::2]):
            raise pickle.UnpicklingError("a key of a dictionary is not text")
        load(self)

    return checked


_dispatch: Any = _Unpickler.dispatch
for _code, _first in ((pickle.SETITEM, -2), (pickle.SETITEMS, 0), (pickle.DICT, 0)):
    _dispatch[_code[0]] = _with_text_keys(_dispatch[_code[0]], _first)
_dispatch |= {pickle.EMPTY_SET[0]: _Unpickler._refuse_set, pickle.FROZENSET[0]: _Unpickler._refuse_set}
_dispatch |= {pickle.BUILD[0]: _Unpickler._load_build, pickle.BYTEARRAY8[0]: _Unpickler._load_bytearray8}


def read(path: Path, opaque: tuple[str, ...] = ()) -> Any:
    """Returns the content of a pickle of arrays, numbers, text and plain containers; protocols 0 to 5.

    Objects whose names begin with one of `opaque` may be there, too, and are replaced by their state. Raises
    `UserError` if the file is damaged or names other globals.
    """
    size = regular_file(path)
    with path.open("rb") as file:
        try:
            unpickler = _Unpickler(file, size, opaque)
            return unpickler.plain(unpickler.load())
        except RecursionError as error:
            raise UserError(f"{path}: not read as a pickle: nested too deeply") from error
        except Exception as error:  # a damaged pickle can fail in any way
            raise UserError(f"{path}: not read as a pickle: {first_line(error)}") from error
