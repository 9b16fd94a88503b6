"""Pickles of arrays, read without running what else a pickle can hold.

Two action data sets are handed out as pickles, a format in which a file can name any function and have it called. Even
NumPy's own functions are not safe to call with what a stranger wrote (a wrong byte in a dtype crashes the interpreter),
so arrays are put together here, from their bytes.
"""

from __future__ import annotations

import math
import pickle
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

DTYPE = re.compile(r"[biufcSU]\d+|O8?")


class _DType:
    """Stands for a dtype: a code such as f4, then the order of bytes."""

    def __init__(self, code: str, align: bool = False, copy: bool = False):
        if not DTYPE.fullmatch(code):
            raise pickle.UnpicklingError(f"an array of dtype {code!r}")
        self.dtype = np.dtype(code)

    def __setstate__(self, state: tuple) -> None:
        if state[1] in ("<", ">"):
            self.dtype = self.dtype.newbyteorder(state[1])

    def array(self, data: Any, shape: Sequence[int], order: Any) -> np.ndarray:
        """The array of this type and shape out of bytes, or out of a list of objects."""
        if self.dtype != object:
            return np.frombuffer(data, self.dtype).reshape(shape, order=order).copy()
        if math.prod(shape) != len(data):
            raise pickle.UnpicklingError(f"{len(data)} objects in an array of shape {tuple(shape)}")
        array = np.empty(len(data), object)
        for index, value in enumerate(data):
            array[index] = _plain(value)
        return array.reshape(shape, order=order)


class _Array:
    """Stands for an array that gets its content after other objects may refer to it."""

    def __init__(self, kind: Any, shape: Any, code: Any):
        self.state: tuple = ()

    def __setstate__(self, state: tuple) -> None:
        self.state = state

    def array(self) -> np.ndarray:
        _, shape, dtype, is_fortran, data = self.state
        return dtype.array(data, shape, "F" if is_fortran else "C")


def _from_buffer(data: bytes, dtype: _DType, shape: Sequence[int], order: Any) -> np.ndarray:
    return dtype.array(data, shape, order)


def _scalar(dtype: _DType, data: bytes) -> Any:
    return dtype.array(data, (1,), "C")[0]


def _encode(text: str, encoding: str) -> bytes:
    """How protocols below 3 write bytes."""
    if encoding != "latin1":
        raise pickle.UnpicklingError(f"bytes encoded as {encoding!r}")
    return text.encode("latin1")


ALLOWED: dict[str, Any] = {
    "numpy.ndarray": None,
    "numpy.dtype": _DType,
    **{f"numpy.{core}.multiarray._reconstruct": _Array for core in ("core", "_core")},
    **{f"numpy.{core}.multiarray.scalar": _scalar for core in ("core", "_core")},
    **{f"numpy.{core}.numeric._frombuffer": _from_buffer for core in ("core", "_core")},
    "_codecs.encode": _encode,
    **{f"{builtins}.{kind.__name__}": kind for builtins in ("builtins", "__builtin__") for kind in (set, frozenset)},
    **{f"{builtins}.complex": complex for builtins in ("builtins", "__builtin__")},
}
"""Everything a pickle may name: arrays and numbers under NumPy's old and new paths, and plain values."""


class _ArrayUnpickler(pickle.Unpickler):
    def find_class(self, module_name: str, global_name: str, /) -> Any:
        name = f"{module_name}.{global_name}"
        if name not in ALLOWED:
            raise pickle.UnpicklingError(
                f"it names {name}, but only arrays, numbers, text and plain containers are read (anything else could "
                "run code); take the file from its owners"
            )
        return ALLOWED[name]


def _plain(value: Any) -> Any:
    """The same with arrays in place of what stands for them."""
    if isinstance(value, _Array):
        return value.array()
    if isinstance(value, dict):
        return {_plain(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(_plain(item) for item in value)
    return value


def read(path: Path) -> Any:
    """What a pickle of arrays, numbers, text and builtin containers holds; protocols 0 to 5.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is damaged, or names anything else; the message names the file and the global.
    """
    with path.open("rb") as file:
        try:
            return _plain(_ArrayUnpickler(file).load())
        except Exception as error:  # a damaged pickle can fail in any way, and can ask for any amount of memory
            raise ValueError(f"{path}: not read as a pickle: {error or type(error).__name__}") from error
