"""Reader for zip and tar archives of motion data.

Only regular files are read, and their size is limited.
"""

import bz2
import gzip
import lzma
import tarfile
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path, PurePosixPath
from shutil import rmtree
from tempfile import mkdtemp
from typing import IO, Any
from weakref import finalize

from flame_mdm.errors import UserError, show_as
from flame_mdm.safe_io import (
    MEBIBYTE,
    ZIP_ERRORS,
    check_expansion,
    check_member,
    check_members,
    naming,
    opened_zip,
    regular_file,
)

MEMBER_LIMIT = 512 * MEBIBYTE
"""Maximum size of an unpacked member in bytes. Motions, captions and arrays are far smaller."""
HEADER_LIMIT = MEBIBYTE // 16
"""Maximum size in bytes of a tar header that describes the next member."""
_UNPACKERS = {b"\x1f\x8b": gzip.open, b"BZ": bz2.open, b"\xfd7zXZ": lzma.open}
_HEADERS = (tarfile.XHDTYPE, tarfile.XGLTYPE, tarfile.SOLARIS_XHDTYPE, tarfile.GNUTYPE_LONGNAME)
_HEADERS += (tarfile.GNUTYPE_LONGLINK,)
_DAMAGE = (*ZIP_ERRORS, tarfile.TarError, lzma.LZMAError, OSError, ValueError)


def members(path: Path, is_wanted: Callable[[str], bool]) -> Iterator[tuple[str, bytes]]:
    """Yields the names and contents of the files that `is_wanted` selects in a zip or tar archive.

    Raises:
        UserError: If the archive is damaged, expands disproportionately or has too many members,
            or if a wanted file is a link, is sparse or is encrypted.
    """
    size = regular_file(path)
    with path.open("rb") as file:
        head = file.read(262)
        file.seek(0)
        unpack: Any = next(
            (opener for magic, opener in _UNPACKERS.items() if head.startswith(magic)), None
        )
        with naming(path, *_DAMAGE, prefix="damaged archive, download it again: "):
            # A tar archive may end with a file that is itself a zip archive, such as an .npz file
            is_tar = head[257:] == b"ustar"
            if head.startswith(b"PK") or (not is_tar and zipfile.is_zipfile(path)):
                yield from _zip_members(file, size, is_wanted)
                return
            with unpack(file) if unpack else file as unpacked:
                yield from _tar_members(path, _Bounded(unpacked, size), is_wanted)


def as_folder(path: Path, owner: object, is_wanted: Callable[[str], bool]) -> Path:
    """Returns `path` if it is a folder; otherwise, unpacks the archive and returns its folder.

    The `members` of an archive are unpacked into a temporary folder, which is removed when `owner`
    is garbage-collected. The function then returns the deepest folder that contains all members.

    Raises:
        UserError: For the same reasons as in `members`, or if a member would be unpacked outside
            the folder.
    """
    if not path.is_file():
        return path
    temporary = Path(mkdtemp(prefix="flame-mdm-"))
    finalize(owner, rmtree, temporary, ignore_errors=True)
    folder = temporary / path.name
    folder.mkdir()
    show_as(str(folder), str(path))
    for name, content in members(path, is_wanted):
        if ".." in PurePosixPath(name).parts or PurePosixPath(name).is_absolute():
            raise UserError(
                f"{path}: the file {name[:80]} would be unpacked outside the "
                f"folder. Remove it from the archive"
            )
        with naming(path, OSError, ValueError, prefix="cannot be unpacked: "):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(content)
    while len(inside := list(folder.iterdir())) == 1 and inside[0].is_dir():
        folder = inside[0]
    return folder


def _zip_members(
    file: IO[bytes], size: int, is_wanted: Callable[[str], bool]
) -> Iterator[tuple[str, bytes]]:
    with opened_zip(file) as archive:
        check_expansion(sum(info.file_size for info in archive.infolist()), size)
        for info in archive.infolist():
            name = info.filename
            if not name:  # `zipfile` truncates names at a null character
                raise UserError("it contains a file without a name")
            # macOS adds a folder __MACOSX with the attributes of the files
            if not info.is_dir() and "__MACOSX" not in name and is_wanted(name):
                check_member(info)
                _check_size(name, info.file_size)
                yield name, archive.read(info)


def _tar_members(
    path: Path, stream: Any, is_wanted: Callable[[str], bool]
) -> Iterator[tuple[str, bytes]]:
    try:
        archive: Any = tarfile.open(  # noqa: SIM115
            mode="r|", fileobj=stream, bufsize=MEBIBYTE // 4, tarinfo=_Member
        )
    except tarfile.ReadError as error:
        raise UserError(f"{path}: neither a folder nor a zip or tar archive: {error}") from error
    count = 0
    with archive:
        while (member := archive.next()) is not None:
            count += 1
            check_members(count)
            if not member.isdir() and is_wanted(member.name):
                if not member.isreg() or member.issparse():
                    raise UserError(
                        f"{member.name} is a link or another special file, not a regular file"
                    )
                _check_size(member.name, member.size)
                yield member.name, archive.extractfile(member).read()
            # Otherwise, a million empty members would take a gigabyte of memory
            archive.members = []
            # Otherwise, these shared values would be copied for each member
            archive.pax_headers = {}


def _check_size(name: str, size: int) -> None:
    if size > MEMBER_LIMIT:
        raise UserError(f"{name} is {size:,} bytes, which is too large for a motion")


class _Member(tarfile.TarInfo):
    """A tar member.

    Large headers and sparse files are rejected before their content is read.
    """

    def _proc_member(self, archive: tarfile.TarFile) -> Any:
        if self.type == tarfile.GNUTYPE_SPARSE:
            raise UserError(f"{self.name} is a sparse file, which is not supported")
        if self.type in _HEADERS and self.size > HEADER_LIMIT:
            raise UserError(f"a header is {self.size:,} bytes, which is too large")
        return super()._proc_member(archive)  # pyright: ignore[reportAttributeAccessIssue]

    def _proc_gnusparse_10(self, *_: Any) -> None:
        raise UserError(f"{self.name} is a sparse file, which is not supported")


class _Bounded:
    """Reader for the expanded contents of a compressed file, which has `packed` bytes.

    It raises an error if the expanded size is implausible.
    """

    def __init__(self, file: IO[bytes], packed: int):
        self.file, self.packed, self.total, self.ended = file, packed, 0, 0

    def read(self, size: int) -> bytes:
        """Returns up to `size` bytes.

        Raises `EOFError` if the caller keeps reading past the end.
        """
        data = self.file.read(size)
        self.total += len(data)
        self.ended += not data
        # Otherwise, tarfile would read to the end of a member, and a header may declare any size
        if self.ended > 2:
            raise EOFError("it ends too early")
        check_expansion(self.total, self.packed)
        return data
