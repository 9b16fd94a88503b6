"""Atomic writes, hashes, locks, and safe reading of files from other people.

Files that may come from other people are always read or checked by this module first. Such a file
must be a regular file of limited size, and the sizes that it declares must match its actual size.
Functions that read a file raise `FileNotFoundError` if it does not exist, and `UserError` if it is
not a regular file or if its content is rejected.
"""

from __future__ import annotations

import errno
import fcntl
import functools
import hashlib
import json
import math
import os
import shutil
import socket
import stat
import zipfile
import zlib
from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, cast

from flame_mdm.errors import UserError, first_line, say
from flame_mdm.safe_io.paths import check_within, open_in_place, remove_abandoned, temporary_beside

if TYPE_CHECKING:  # `--help` must not import NumPy
    import numpy as np

MEBIBYTE = 2**20
TEXT_LIMIT = 512 * MEBIBYTE
"""Maximum size of a text or JSON file.

The largest known file, which contains BABEL's annotations, is 175 MiB.
"""
YAML_LIMIT = MEBIBYTE // 4
"""Maximum size of a YAML file. It is low, because parsing YAML is slow.

Recipes, skeletons, protocols and table specifications are far smaller.
"""
# Maximum number of keys and values in a YAML file after its aliases are expanded
YAML_NODES = 100_000
YAML_DIGITS = 20  # maximum number of characters of an integer in a YAML file; 2^63 has 19
ARRAYS_LIMIT = 128 * MEBIBYTE
"""Total size that is always permitted for the arrays in a compressed file.

Larger arrays may have at most `INFLATION` times the size of the file. Compression reduces motion
data by a factor of less than 10.
"""
INFLATION = 20
# Beginning of a pointer file, which Git LFS stores instead of the file itself
GIT_LFS = b"version https://git-lfs.github.com/spec/"
POINTER_LIMIT = 1024  # pointer files have fewer bytes than this

ZIP_ERRORS = (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError)
"""Errors raised by `zipfile` for damaged, encrypted and unusually compressed archives."""
DIRECTORY_LIMIT = 16 * MEBIBYTE
"""Maximum size of the directory of a zip archive in bytes. Each entry becomes a Python object."""
# Maximum number of members of an archive. HumanML3D, the largest data set in archives, has 90,000
# members.
MAX_MEMBERS = 200_000
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)  # error numbers of a full disk


@contextmanager
def atomic_write(path: str | Path, *, within: str | Path | None = None) -> Iterator[Path]:
    """Yields a temporary path next to `path`; the file is renamed to `path` at the end.

    No files are left behind after a failure. The temporary name is unique, so several processes can
    write the same file; the last one wins. If `path` is a link, the link is replaced, and its
    target is not changed. Before this process writes its first file to the folder, it removes
    temporary files left behind by killed processes.

    Args:
        path: file to write.
        within: folder that contains `path` and may contain files from other people. Links must not
            point outside this folder.

    Raises:
        UserError: If a link points outside `within`, if `path` is a pipe or a device, or if the
            file cannot be written, for example because the disk is full.
    """
    path = Path(path)
    if within is not None:
        check_within(path.parent, within)
    with _temporary(path) as temporary:
        if path.exists() and not (path.is_file() or path.is_dir()):
            raise UserError(
                f"{path}: this is a pipe, a socket or a device, not a regular file. Choose another name"
            )
        yield temporary
        temporary.replace(path)


@contextmanager
def atomic_folder(path: str | Path, *, within: str | Path | None = None) -> Iterator[Path]:
    """Yields a temporary folder whose files are moved to the folder `path` at the end.

    Either all files are moved, or none are. If `path` exists, files with the same names are
    replaced, and all other files are kept. Temporary folders left behind by killed processes are
    removed. Links must not point outside the folder `within`. Raises the same errors as
    `atomic_write`.
    """
    path = Path(path)
    if within is not None:
        check_within(path, within)
    if path.exists() and not path.is_dir():
        raise UserError(f"{path}: this is a file, not a folder. Choose another folder")
    remove_abandoned(path.parent, path)
    with _temporary(path) as temporary:
        temporary.mkdir()
        yield temporary
        try:
            temporary.rename(path)
        except OSError:
            if not path.is_dir():
                raise
            for file in sorted(temporary.iterdir()):
                file.replace(path / file.name)


@contextmanager
def _temporary(path: Path) -> Iterator[Path]:
    """Yields a unique path next to `path`, and removes the file at this path at the end.

    The folder is created if necessary. Error messages contain `path` instead of the unique path. An
    `OSError` for either path, or for a parent folder, is converted to a `UserError`.
    """
    temporary = path
    try:
        with made_folder(path.parent), temporary_beside(path) as temporary:
            _remove_abandoned_once(path.parent.absolute())
            yield temporary
    except UserError as error:
        if str(temporary) not in str(error):
            raise
        raise UserError(str(error).replace(str(temporary), str(path))) from error
    except OSError as error:
        name = Path(str(error.filename or temporary))
        within = (
            name.is_relative_to(temporary) or name.is_relative_to(path) or path.is_relative_to(name)
        )
        if error.errno is None or not within:
            raise
        raise UserError(f"{path}: cannot be written: {write_failure(error, path)}") from error


@functools.cache
def _remove_abandoned_once(folder: Path) -> None:
    """Removes temporary files left behind by killed processes.

    Each process does this only once per folder, because listing the folder again for each of
    thousands of files would take too long.
    """
    with suppress(PermissionError):  # a folder that cannot be listed
        remove_abandoned(folder)


def write_failure(error: BaseException, path: Path) -> str:
    """Explains why a file could not be written, including the free space if the disk may be full."""
    reason = getattr(error, "strerror", None) or first_line(error)
    if getattr(error, "errno", None) not in FULL:
        return reason
    folder = next(parent for parent in path.absolute().parents if parent.exists())
    return (
        f"{reason}. {_size(shutil.disk_usage(folder).free)} is free on the disk that contains "
        f"{folder}"
    )


@contextmanager
def made_folder(folder: Path) -> Iterator[None]:
    """Creates a folder and its parents.

    At the end of the context, the created folders are removed if they are empty.
    """
    created = [part for part in (folder, *folder.parents) if not part.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield
    finally:
        for part in created:
            with suppress(OSError):  # it is not empty
                part.rmdir()


def write_text(path: str | Path, text: str, *, within: str | Path | None = None) -> None:
    """Writes a UTF-8 text file atomically. Links must not point outside the folder `within`."""
    with atomic_write(path, within=within) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(
    path: str | Path, content: Any, indent: int | None = 2, *, within: str | Path | None = None
) -> None:
    """Writes a JSON file atomically.

    NaN and infinity raise `ValueError`. Links must not point outside the folder `within`.
    """
    write_text(path, json.dumps(content, indent=indent, allow_nan=False) + "\n", within=within)


@contextmanager
def naming(name: object, *errors: type[Exception], prefix: str = "") -> Iterator[None]:
    """Adds the name of a file to every `UserError` whose message does not contain the name.

    The exceptions in `errors` are converted to `UserError`, and `prefix` is prepended to their
    messages.
    """
    try:
        yield
    except UserError as error:
        if str(name) in str(error):
            raise
        raise UserError(f"{name}: {first_line(error)}") from error
    except errors as error:
        raise UserError(f"{name}: {prefix}{first_line(error)}") from error


@contextmanager
def locked(path: Path, busy: Callable[[str], object], advice: str) -> Iterator[str]:
    """Holds a lock file that names the process and the host.

    Yields the name of the dead process that left the lock file behind, or "" if there is none. If
    another process holds the lock, `busy` is called with the name of that process. Unless `busy`
    raises an error, this function then waits for the lock. `advice` is part of the warning about
    file systems that do not support locks. When the process ends, for whatever reason, the
    operating system releases the lock. The lock is a POSIX record lock. Unlike the locks of
    `filelock`, record locks also work across hosts on NFS and Lustre, but they are not available on
    Windows.
    """
    while True:
        with made_folder(path.parent), open_in_place(path) as file:
            file.seek(0)
            owner = file.read().strip()
            try:
                fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                if error.errno in (errno.EACCES, errno.EAGAIN):
                    busy(owner)
                    fcntl.lockf(file, fcntl.LOCK_EX)
                else:
                    say(
                        f"{path}: this file system does not support locks ({error.strerror}); {advice}"
                    )
            try:
                if not os.path.samestat(os.fstat(file.fileno()), path.stat()):
                    # Another process holds a new lock file
                    continue
            except FileNotFoundError:  # the previous process has removed the file
                continue
            with suppress(OSError):  # a full disk
                file.truncate(0)
                os.write(
                    file.fileno(), f"process {os.getpid()} on {socket.gethostname()}\n".encode()
                )
            try:
                yield owner
            finally:
                path.unlink(missing_ok=True)
            return


def sha256(path: str | Path) -> str:
    """Returns the SHA-256 of a file as 64 hexadecimal digits."""
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def regular_file(path: str | Path, limit: int | None = None) -> int:
    """Returns the size, in bytes, of a regular file or of the target of a link.

    Raises:
        FileNotFoundError: If the file does not exist.
        UserError: If the file cannot be read, is not a regular file, is larger than `limit` bytes,
            or is a Git LFS pointer.
    """
    try:
        status = Path(path).stat()
    except (FileNotFoundError, NotADirectoryError):
        raise FileNotFoundError(f"{path}: no such file") from None
    # Raised for a loop of links, and for names that are too long or contain a null character
    except (
        OSError,
        ValueError,
    ) as error:
        raise UserError(
            f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}"
        ) from error
    if not stat.S_ISREG(status.st_mode):
        kind = "a folder" if stat.S_ISDIR(status.st_mode) else "a pipe, a socket or a device"
        raise UserError(f"{path}: this is {kind}, not a regular file")
    if limit is not None and status.st_size > limit:
        raise UserError(
            f"{path}: the file is {_size(status.st_size)}, but at most {_size(limit)} is allowed"
        )
    if status.st_size < POINTER_LIMIT and _begins(path, GIT_LFS):
        raise UserError(
            f"{path}: this is a Git LFS pointer, not the file itself. Run `git lfs pull` in its repository"
        )
    return status.st_size


def _begins(path: str | Path, content: bytes) -> bool:
    """Returns whether a file is readable and begins with `content`."""
    try:
        with Path(path).open("rb") as file:
            return file.read(len(content)) == content
    except OSError:  # the reader of the file reports the reason
        return False


def read_text(path: str | Path, limit: int = TEXT_LIMIT) -> str:
    """Returns the contents of a UTF-8 text file of at most `limit` bytes.

    Raises `UserError` for all other files.
    """
    regular_file(path, limit)
    with (
        naming(path, UnicodeDecodeError, prefix="not a UTF-8 text file: "),
        naming(path, OSError, prefix="cannot be read: "),
    ):
        return Path(path).read_text(encoding="utf-8")


def read_json(path: str | Path, limit: int = TEXT_LIMIT) -> Any:
    """Returns the contents of a JSON file.

    The file must not contain NaN, infinity or lone surrogates.
    """
    with naming(path, ValueError, prefix="not a JSON file: "):
        return parse_json(read_text(path, limit))


def parse_json(text: str | bytes) -> Any:
    """Returns the parsed content of a JSON string.

    Raises `ValueError` for content that `read_json` rejects.
    """

    def refuse(constant: str) -> None:
        raise ValueError(f"{constant} is not a JSON number")

    try:
        content = json.loads(text, parse_constant=refuse)
        if "\\u" in (text if isinstance(text, str) else text.decode()):
            # Encoding fails for a lone surrogate, which could not be written to a file again
            json.dumps(content, ensure_ascii=False).encode()
    except RecursionError:
        raise ValueError("nested too deeply") from None
    return content


def read_yaml(path: str | Path) -> Any:
    """Returns the contents of a YAML file as plain values.

    Interpolations such as `${a}` are kept as text.
    """
    import yaml
    from omegaconf import OmegaConf

    text = read_text(path, YAML_LIMIT)
    try:
        nodes = _nodes(yaml.compose(text, yaml.SafeLoader), {})
        if nodes > YAML_NODES:
            raise ValueError(f"more than {YAML_NODES:,} values after its aliases are expanded")
        # OmegaConf reads numbers such as 1e-4, which are text in YAML 1.1.
        content = OmegaConf.create(text) if text.strip() else None
        return OmegaConf.to_container(content) if content is not None else None
    except Exception as error:  # YAML and OmegaConf raise many kinds of errors for invalid files
        reason = "nested too deeply" if isinstance(error, RecursionError) else first_line(error)
        raise UserError(f"{path}: not a readable YAML file: {reason}") from error


def read_package_yaml(path: Path) -> Any:
    """Returns the contents of a YAML file of this package as plain values.

    With LibYAML, this function is fifteen times as fast as `read_yaml`, but it skips the checks for
    files from other people.
    """
    import yaml

    # PyYAML may be installed without LibYAML
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    return loader(path.read_text(encoding="utf-8")).get_single_data()


def _nodes(node: Any, counted: dict[int, float]) -> float:
    """Returns the number of YAML nodes after aliases are expanded, or infinity if they are cyclic."""
    if id(node) not in counted:
        counted[id(node)] = math.inf
        content = node.value if node is not None else ""
        if getattr(node, "tag", "").endswith(":int") and len(content) > YAML_DIGITS:
            # An attacker could choose large integers as keys that all have the same hash
            raise ValueError(
                f"a whole number of more than {YAML_DIGITS} digits: {content[:YAML_DIGITS]}…"
            )
        if isinstance(content, str):
            content.encode()  # a lone surrogate cannot be written again
        parts = [part for pair in content for part in (pair if isinstance(pair, tuple) else [pair])]
        counted[id(node)] = 1 + sum(
            _nodes(part, counted) for part in parts if hasattr(part, "value")
        )
    return counted[id(node)]


def read_npz(
    source: Path | IO[bytes], *, skip: Collection[str] = (), only: Collection[str] | None = None
) -> dict[str, np.ndarray]:
    """Returns the arrays in an .npz file, keyed by name.

    Args:
        source: the path or an open, seekable file.
        skip: names of the arrays to skip.
        only: names of the arrays to read, or None for all arrays.

    Raises:
        UserError: If the file is damaged, contains objects, or exceeds the limits of this module.
    """
    from numpy.lib import format as npy

    with _opened(source) as (file, size), opened_zip(file) as archive:
        members = {member.filename.removesuffix(".npy"): member for member in archive.infolist()}
        members = {
            n: m for n, m in members.items() if n not in skip and (only is None or n in only)
        }
        check_expansion(sum(member.file_size for member in members.values()), size)
        arrays = {}
        for name, member in members.items():
            check_member(member)
            with archive.open(member) as content:
                _check_array(content, member.file_size, name)
                arrays[name] = npy.read_array(content, allow_pickle=False)
        return arrays


def read_npy(source: Path | IO[bytes], *, mmap: bool = False) -> np.ndarray:
    """Returns the array in an .npy file.

    If `mmap` is set, the file must be given as a path, and it is mapped into memory (read-only)
    instead of being read. Raises `UserError` if the file is damaged, contains objects, or exceeds
    the limits of this module.
    """
    import numpy as np

    with _opened(source) as (file, size):
        count = _check_array(file, size, "the array")
        return np.load(
            source if mmap and count else file, "r" if mmap and count else None, allow_pickle=False
        )


@contextmanager
def _opened(source: Path | IO[bytes]) -> Iterator[tuple[IO[bytes], int]]:
    """Opens a file of arrays for reading, and yields the file and its size.

    Errors caused by damaged content are converted to `UserError`.
    """
    with ExitStack() as stack:
        name = ""
        if isinstance(source, Path):
            regular_file(source)
            name, source = f"{source}: ", stack.enter_context(source.open("rb"))
        size = source.seek(0, os.SEEK_END)
        source.seek(0)
        try:
            yield source, size
        except (*ZIP_ERRORS, OSError, ValueError) as error:
            raise UserError(
                f"{name}damaged, or not a file of plain arrays: {first_line(error)}"
            ) from error


def _check_array(file: IO[bytes], size: int, name: str) -> int:
    """Returns the number of elements in the array of an .npy file.

    The header must match the file's `size` in bytes.
    """
    from numpy.lib import format as npy

    try:
        read_header = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}[
            npy.read_magic(file)
        ]
        shape, _, dtype = read_header(file)
    except Exception as error:  # NumPy parses the header as Python
        raise ValueError(
            f"{name}: not an array of format 1.0 or 2.0: {first_line(error)}"
        ) from error
    if dtype.hasobject:
        raise ValueError(f"{name}: an array of Python objects, which could run code")
    count = math.prod(shape)
    if (
        min(shape, default=0) < 0
        or file.tell() + count * dtype.itemsize != size
        or (not dtype.itemsize and count > 1)
    ):
        raise ValueError(
            f"{name}: its header declares {shape} of {dtype}, which does not match the content"
        )
    file.seek(0)
    return count


@contextmanager
def opened_zip(file: IO[bytes]) -> Iterator[zipfile.ZipFile]:
    """Opens a zip archive for reading.

    Raises `UserError` if the archive has more than `MAX_MEMBERS` members. The size of the archive's
    directory is also limited, because `zipfile` reads the entire directory at once and creates an
    object for each entry, even if the archive declares fewer entries.
    """
    directory = _DirectoryReader(file)
    with zipfile.ZipFile(cast(IO[bytes], directory)) as archive:
        directory.limit = None
        check_members(len(archive.infolist()))
        yield archive


def check_members(count: int) -> None:
    """Raises `UserError` if an archive has more than `MAX_MEMBERS` members."""
    if count > MAX_MEMBERS:
        raise UserError(
            f"more than {MAX_MEMBERS:,} files in one archive. Unpack it, and use the folder instead"
        )


class _DirectoryReader:
    """A file from which at most `limit` bytes can be read at once, or any number if it is None."""

    def __init__(self, file: IO[bytes]):
        self.file, self.limit = file, DIRECTORY_LIMIT
        self.seek, self.tell, self.seekable = file.seek, file.tell, file.seekable

    limit: int | None

    def read(self, size: int = -1) -> bytes:
        if self.limit is not None and size > self.limit:
            check_members(size)  # the directory has at most as many entries as bytes
        return self.file.read(size)


def check_member(member: zipfile.ZipInfo) -> None:
    """Raises `UserError` if a zip member is encrypted, or if it is neither stored nor deflated.

    For any other compression method, `zipfile` does not limit the number of unpacked bytes.
    """
    if member.flag_bits & 1 or member.compress_type not in (
        zipfile.ZIP_STORED,
        zipfile.ZIP_DEFLATED,
    ):
        raise UserError(
            f"{member.filename}: encrypted, or compressed with a method other than deflate"
        )


def check_expansion(expanded: int, packed: int) -> None:
    """Raises `UserError` if compressed content expands disproportionately."""
    if expanded > max(ARRAYS_LIMIT, INFLATION * packed):
        raise UserError(
            f"its {_size(packed)} expand to {_size(expanded)}, which is implausible for motion data"
        )


def _size(count: float) -> str:
    for unit in ("bytes", "KiB", "MiB", "GiB"):
        if count < 999.5:  # so that three digits are enough
            return f"{count:.3g} {unit}"
        count /= 1024
    return f"{count:.3g} TiB"
