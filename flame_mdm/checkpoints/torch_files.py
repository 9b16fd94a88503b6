"""Reads files written by `torch.save` after checking their sizes, checksums and keys."""

import io
import pickle
from _compat_pickle import IMPORT_MAPPING, NAME_MAPPING
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import IO, Any

from flame_mdm.errors import UserError
from flame_mdm.safe_io import ZIP_ERRORS, naming, opened_zip, regular_file

LARGEST_KEY = 2**60
"""Integer keys must be smaller than this, because arbitrarily many larger integers may share one hash."""
# Files from PyTorch before 1.6, which are not archives, begin with this number of pickles
LEGACY_PICKLES = 5
# Names of the codec with which PyTorch writes bytes. Other codecs may take quadratic time.
CODECS = ("latin1", "latin-1")


def read_torch(path: Path) -> Any:
    """Returns the plain values and tensors in a file written by `torch.save`, without executing code in the file."""
    import torch

    check_torch(path)
    check_keys(path)
    with naming(path, Exception, prefix="damaged, or not a file of plain values and tensors: "):
        return torch.load(path, map_location="cpu", weights_only=True)


def check_torch(path: Path) -> None:
    """Checks the sizes and checksums in an archive from `torch.save`; `torch.load` ignores them."""
    size = regular_file(path)
    if not _is_archive(path):
        return
    damage = naming(
        path,
        *ZIP_ERRORS,
        OSError,
        ValueError,
        prefix="damaged, or not a file written by torch.save: ",
    )
    with damage, path.open("rb") as file, opened_zip(file) as archive:
        members = archive.infolist()
        if (
            any(member.compress_type for member in members)
            or sum(m.file_size for m in members) > size
        ):
            raise UserError(
                "damaged: its parts are compressed or overlap, unlike the parts that torch.save writes"
            )
        if (spoiled := archive.testzip()) is not None:
            raise UserError(f"damaged: the checksum of {spoiled} is wrong")


def check_keys(path: Path) -> None:
    """Raises `UserError` if many keys in a file could have the same hash.

    With `torch.load(weights_only=True)`, loading a dictionary with such keys takes quadratic time:
    hours for a file of one megabyte. Strings are safe because their hashes are randomized. Small
    integers are safe because their hashes are distinct. If the pickle names an object that PyTorch
    refuses, the check stops there without an error, because PyTorch stops at the same place and
    names the object.
    """
    regular_file(path)
    damage = naming(path, Exception, prefix="damaged, or not a file of plain values and tensors: ")
    with damage, path.open("rb") as file:
        if not _is_archive(path):
            for _ in range(LEGACY_PICKLES):
                if not _KeyCheck(file).passes():
                    break
            return
        with opened_zip(file) as archive:
            for member in archive.infolist():
                if member.filename.lower().endswith("data.pkl"):  # PyTorch ignores case
                    _KeyCheck(io.BytesIO(archive.read(member))).passes()


def _is_archive(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(4) == b"PK\3\4"


class _Named:
    """A function or class that a pickle names, or an object that the pickle would create.

    The function or class is never called.
    """

    def __init__(self, name: str):
        self.name = name


class _Refused(Exception):
    """Raised when the pickle names an object that PyTorch refuses."""


CONTAINERS = ("collections.OrderedDict", "collections.Counter", "builtins.set")
PLAIN = (*CONTAINERS, "_codecs.encode", "builtins.bytearray", "builtins.complex")
"""Names outside of PyTorch's modules that PyTorch accepts in a pickle."""


class _KeyCheck(pickle._Unpickler):
    """Reads a pickle as PyTorch's restricted reader does, without keeping the content of containers."""

    stack: list[Any]
    append: Callable[[Any], None]
    pop_mark: Callable[[], list[Any]]

    def __init__(self, file: IO[bytes]):
        super().__init__(file, encoding="bytes")

    def passes(self) -> bool:
        """Reads the pickle, and returns whether it contains no refused object."""
        try:
            self.load()
        except _Refused:
            return False
        return True

    def find_class(self, module_name: str, global_name: str, /) -> _Named:
        # PyTorch writes Python 2's names, as required by protocol 2, and maps them in the same way.
        if (module_name, global_name) in NAME_MAPPING:
            module_name, global_name = NAME_MAPPING[module_name, global_name]
        name = f"{IMPORT_MAPPING.get(module_name, module_name)}.{global_name}"
        if name not in PLAIN and not name.startswith("torch."):
            raise _Refused
        return _Named(name)

    def persistent_load(self, pid: Any) -> _Named:
        for part in pid if isinstance(pid, tuple) else [pid]:
            if not isinstance(part, _Named):
                _check_key(part)
        return _Named("storage")

    def _load_item(self) -> None:
        del self.stack[-1]
        _check_key(self.stack.pop())

    def _load_items(self) -> None:
        for key in self.pop_mark()[::2]:
            _check_key(key)

    def _load_reduce(self) -> None:
        arguments = self.stack.pop()
        name = self.stack.pop().name
        self.append(_Named(name))
        if name in CONTAINERS:
            _check_container(name, arguments)
        elif name == "builtins.bytearray" and not all(
            isinstance(value, bytes | _Named) for value in arguments
        ):
            raise pickle.UnpicklingError("an array of bytes without content")
        elif name == "_codecs.encode" and _text(arguments[1]) not in CODECS:
            raise pickle.UnpicklingError("bytes in an unknown encoding")

    def _load_object(self) -> None:
        arguments = self.stack.pop()
        if arguments != ():
            raise pickle.UnpicklingError(
                "an object with arguments, which torch.save does not write"
            )

    def _load_build(self) -> None:
        del self.stack[-1]

    def _load_set(self) -> None:
        self.append(_Named("builtins.set"))

    # These are exactly the instructions of PyTorch's own reader, so that PyTorch can read every
    # file that passes.
    dispatch = {  # pyright: ignore[reportAssignmentType]
        code[0]: pickle._Unpickler.dispatch[code[0]]
        for code in (
            pickle.GLOBAL,
            pickle.MARK,
            pickle.TUPLE,
            pickle.TUPLE1,
            pickle.TUPLE2,
            pickle.TUPLE3,
            pickle.NONE,
            pickle.NEWFALSE,
            pickle.NEWTRUE,
            pickle.EMPTY_TUPLE,
            pickle.EMPTY_LIST,
            pickle.BININT,
            pickle.BININT1,
            pickle.BININT2,
            pickle.BINFLOAT,
            pickle.BINUNICODE,
            pickle.SHORT_BINSTRING,
            pickle.BINPERSID,
            pickle.BINGET,
            pickle.LONG_BINGET,
            pickle.BINPUT,
            pickle.LONG_BINPUT,
            pickle.LONG1,
            pickle.PROTO,
            pickle.APPEND,
            pickle.APPENDS,
            pickle.EMPTY_DICT,
            pickle.STOP,
        )
    } | {
        pickle.SETITEM[0]: _load_item,
        pickle.SETITEMS[0]: _load_items,
        pickle.REDUCE[0]: _load_reduce,
        pickle.NEWOBJ[0]: _load_object,
        pickle.BUILD[0]: _load_build,
        pickle.EMPTY_SET[0]: _load_set,
    }


def _check_container(name: str, arguments: Sequence[Any]) -> None:
    """Checks the keys in the arguments from which a container is created.

    Examples are OrderedDict([(key, value), ...]) and set([key, ...]).
    """
    for content in arguments:
        if name == "collections.Counter" and not isinstance(content, dict):
            raise pickle.UnpicklingError("a counter that is not made from a dictionary")
        if isinstance(content, list | tuple):
            for item in content:
                _check_key(item[0] if name == "collections.OrderedDict" else item)


def _check_key(key: Any) -> None:
    is_small = isinstance(key, int) and -LARGEST_KEY < key < LARGEST_KEY
    if not (is_small or key is None or isinstance(key, str | bytes)):
        shown = str(key)[:40] if isinstance(key, int) else f"a {type(key).__name__}"
        raise pickle.UnpicklingError(f"a key is {shown}, not text or a small whole number")


def _text(value: Any) -> str:
    return value.decode("latin1") if isinstance(value, bytes) else str(value)
