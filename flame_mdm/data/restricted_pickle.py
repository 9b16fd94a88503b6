"""Pickles of arrays, read without running what else a pickle can hold.

Two action data sets are handed out as pickles, a format in which a file can name any function and have it called.
"""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
from numpy._core import multiarray, numeric


def _dtype(code: str, align: bool = False, copy: bool = False) -> np.dtype:
    return np.dtype(code, bool(align), bool(copy))  # old pickles write 0 and 1


def _encode(text: str, encoding: str) -> bytes:
    """How protocol 2 writes bytes."""
    if encoding != "latin1":
        raise pickle.UnpicklingError(f"bytes encoded as {encoding!r}")
    return text.encode("latin1")


ALLOWED: dict[tuple[str, str], Any] = {
    ("numpy", "ndarray"): np.ndarray,
    ("numpy", "dtype"): _dtype,
    ("_codecs", "encode"): _encode,
    **{(builtins, kind.__name__): kind for builtins in ("builtins", "__builtin__") for kind in (set, frozenset)},
    **{(builtins, kind.__name__): kind for builtins in ("builtins", "__builtin__") for kind in (complex, bytearray)},
    **{
        (f"numpy.{core}.{module.__name__.rpartition('.')[2]}", name): getattr(module, name)
        for core in ("core", "_core")
        for module, name in ((multiarray, "_reconstruct"), (multiarray, "scalar"), (numeric, "_frombuffer"))
    },
}
"""Everything a pickle may name: numpy arrays and numbers under the old and the new paths, and plain containers."""


class _ArrayUnpickler(pickle.Unpickler):
    def find_class(self, module_name: str, global_name: str, /) -> Any:
        try:
            return ALLOWED[module_name, global_name]
        except KeyError:
            raise pickle.UnpicklingError(
                f"it names {module_name}.{global_name}, but only arrays, numbers, text and plain containers are read "
                "(anything else could run code); take the file from its owners"
            ) from None


def read(path: Path) -> Any:
    """What a pickle of arrays, numbers, text and builtin containers holds; protocols 0 to 5.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is damaged, or names anything else; the message names the file and the global.
    """
    with path.open("rb") as file:
        try:
            return _ArrayUnpickler(file).load()
        except (MemoryError, OSError):
            raise
        except Exception as error:  # a damaged pickle can fail in any way
            raise ValueError(f"{path}: not read as a pickle: {error or type(error).__name__}") from error
