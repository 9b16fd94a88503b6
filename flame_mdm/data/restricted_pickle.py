"""Reader for pickles. It never runs code that a pickle contains.

The reader supports arrays, numbers, text, lists, tuples, and dictionaries with text keys. A pickle
can name any function, and Python calls this function when the pickle is loaded. This reader never
calls these functions: it only records the arguments and the state of each object, and creates
arrays from the recorded bytes. NumPy's own functions are not used to create arrays, because a wrong
byte in a dtype can crash them.

Python's C unpickler allocates as much memory as a file declares, even if the file has only ten
bytes. Therefore, this reader is based on the Python version of the unpickler, and never reads more
bytes than are left in the file. If content is repeated, each repetition counts toward the size
limit.
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
# Number of bytes that each value adds to the expanded size. Otherwise, a file of a few bytes could
# repeat a list endlessly.
VALUE = 512


class _Object:
    """An object that a pickle describes. Nothing is imported or called to create it."""

    state: Any = None

    def __init__(self, *arguments: Any):
        self.arguments = arguments


ARRAY, SCALAR, BUFFER, BYTES = ALLOWED = (
    "numpy.core.multiarray._reconstruct",
    "numpy.core.multiarray.scalar",
    "numpy.core.numeric._frombuffer",
    "_codecs.encode",
)
KINDS = {name: type(name, (_Object,), {}) for name in (*ALLOWED, "numpy.ndarray", "numpy.dtype")}
"""All globals that a pickle may refer to, and the class that represents objects of each."""
BASES = (
    "copy_reg._reconstructor",
    "copyreg._reconstructor",
    "__builtin__.object",
    "builtins.object",
)
"""Globals with which old protocols create an object of a class."""


class _Dictionary(dict[str, Any]):
    """A dictionary that accepts only text keys.

    Keys of other types could be chosen so that they all have the same hash.
    """

    def __setitem__(self, key: Any, value: Any) -> None:
        if type(key) is not str:
            raise pickle.UnpicklingError("a dictionary has a key that is not text")
        super().__setitem__(key, value)


class _Unpickler(pickle._Unpickler):
    """Reads the pickle in a file of `size` bytes.

    `opaque` contains prefixes. If the name of a global begins with one of them, the objects of this
    global are replaced by their state.
    """

    stack: list[Any]
    append: Callable[[Any], None]
    read: Callable[[int], bytes]

    def __init__(self, file: IO[bytes], size: int, opaque: tuple[str, ...]):
        # Python 2 wrote the bytes of arrays in this encoding
        super().__init__(file, encoding="latin1")
        self._file_read = self.read_file
        self.file, self.size, self.opaque, self.expanded = file, size, opaque, 0

    def read_file(self, size: int) -> bytes:
        """Returns `size` bytes.

        Raises:
            EOFError: If the file contains fewer bytes. No memory is allocated in this case.
        """
        if size > self.size - self.file.tell():
            raise EOFError("it ends too early")
        return self.file.read(size)

    def find_class(self, module_name: str, global_name: str, /) -> type[_Object]:
        """Returns the class that stands for a permitted global.

        Raises:
            UnpicklingError: If the global is not permitted.
        """
        name = f"{module_name}.{global_name}".replace("numpy._core.", "numpy.core.")
        if name in KINDS:
            return KINDS[name]
        if self.opaque and name.startswith((*self.opaque, *BASES)):
            return _Object
        raise pickle.UnpicklingError(
            f"it refers to {name[:200]}, but only arrays, numbers, text and plain containers are read, because "
            "anything else could run code. Download the file from its original source"
        )

    def plain(self, value: Any) -> Any:
        """Converts the objects in a value of the pickle to arrays, numbers and text."""
        self.expanded += VALUE + (len(value) if isinstance(value, str | bytes | bytearray) else 0)
        check_expansion(self.expanded, self.size)
        match value:
            case dict():
                return {key: self.plain(item) for key, item in value.items()}
            case list() | tuple():
                return type(value)(self.plain(item) for item in value)
            case _Object():
                # The object contains only the name of its class. Nothing was called to create it.
                return self.plain_object(type(value).__name__, value)
        return value

    def plain_object(self, name: str, value: _Object) -> Any:
        """Returns the array, number or text that an object describes.

        If the object is opaque, its state is returned.
        """
        if name == ARRAY:
            _, shape, dtype, is_fortran, data = value.state
            return self.array(data, dtype, shape, "F" if is_fortran else "C")
        if name == BUFFER:
            return self.array(*value.arguments)
        if name == SCALAR:
            dtype, data = value.arguments
            return self.array(data, dtype, (1,), "C")[0]
        if name == BYTES:
            return self.plain(value.arguments[0]).encode("latin1")
        return self.plain(value.state)

    def array(self, data: Any, dtype: _Object, shape: Sequence[int], order: Any) -> np.ndarray:
        """Returns an array, either as a view of its bytes or as a copy of a list of objects."""
        code, data = dtype.arguments[0], self.plain(data)
        if not DTYPE.fullmatch(code):
            raise pickle.UnpicklingError(
                f"it contains an array of dtype {code[:40]!r}, which cannot be read"
            )
        kind = np.dtype(code)
        if dtype.state and dtype.state[1] in ("<", ">"):
            kind = kind.newbyteorder(dtype.state[1])
        if kind.hasobject:
            return np.fromiter(data, object, len(data)).reshape(shape, order=order)
        data = data.encode("latin1") if isinstance(data, str) else data
        return np.frombuffer(data, kind).reshape(shape, order=order)

    # BUILD would call `__setstate__` or set attributes. This version only stores the state.
    def _load_build(self) -> None:
        state = self.stack.pop()
        if not isinstance(self.stack[-1], _Object):
            raise pickle.UnpicklingError("it sets attributes of a value that is not an object")
        self.stack[-1].state = state

    def _load_dictionary(self) -> None:
        items = self.pop_mark()  # pyright: ignore[reportAttributeAccessIssue]
        self.append(_Dictionary())
        for key, value in zip(items[::2], items[1::2], strict=True):
            self.stack[-1][key] = value

    # Python's version allocates the declared size before it reads any data
    def _load_bytearray8(self) -> None:
        self.append(bytearray(self.read(struct.unpack("<Q", self.read(8))[0])))

    def _refuse_set(self) -> None:
        raise pickle.UnpicklingError("it contains a set, which no supported data set uses")

    dispatch = pickle._Unpickler.dispatch | {
        pickle.BUILD[0]: _load_build,
        pickle.EMPTY_DICT[0]: lambda self: self.append(_Dictionary()),
        pickle.DICT[0]: _load_dictionary,
        pickle.BYTEARRAY8[0]: _load_bytearray8,
        **dict.fromkeys((pickle.EMPTY_SET[0], pickle.FROZENSET[0]), _refuse_set),
    }


def read(path: Path, opaque: tuple[str, ...] = ()) -> Any:
    """Returns the content of a pickle with protocol 0 to 5.

    Globals whose names begin with one of the prefixes in `opaque` are permitted as well. The
    objects of these globals are replaced by their state.

    Raises:
        UserError: If the file is damaged, or refers to other globals.
    """
    size = regular_file(path)
    with path.open("rb") as file:
        try:
            unpickler = _Unpickler(file, size, opaque)
            return unpickler.plain(unpickler.load())
        except Exception as error:  # a damaged pickle can cause any error
            reason = "nested too deeply" if isinstance(error, RecursionError) else first_line(error)
            raise UserError(f"{path}: cannot be read as a pickle: {reason}") from error
