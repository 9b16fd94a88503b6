"""Reader of zip and tar archives of motion data without unpacking: regular files only, with size limits."""

from __future__ import annotations

import bz2
import gzip
import lzma
import tarfile
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from flame_mdm.errors import first_line
from flame_mdm.safe_io import MEBIBYTE, ZIP_ERRORS, check_expansion, check_member, regular_file

MEMBER_LIMIT = 512 * MEBIBYTE
"""Maximum size of one unpacked member in bytes. Motions, captions and arrays are far smaller."""
HEADER_LIMIT = MEBIBYTE // 16
"""Maximum size in bytes of a header that describes the next member or all later ones."""
MAX_GLOBAL_VALUES = 100
"""Maximum number of header values that apply to all later members; each member copies them."""
_UNPACKERS = {b"\x1f\x8b": gzip.open, b"BZ": bz2.open, b"\xfd7zXZ": lzma.open}
_HEADERS = (tarfile.XHDTYPE, tarfile.XGLTYPE, tarfile.SOLARIS_XHDTYPE, tarfile.GNUTYPE_LONGNAME)
_HEADERS += (tarfile.GNUTYPE_LONGLINK,)


def members(path: Path) -> Iterator[tuple[str, Callable[[], bytes]]]:
    """Yields the name of each member of a zip or tar archive, except folders, and a function that reads it.

    A member must be read before the next one is requested.

    Raises:
        ValueError: the file is damaged or not an archive, a member that is read is a link, a sparse file or encrypted,
            or the content expands disproportionately. The message names the archive.
    """
    size = regular_file(path)
    with _named(path), path.open("rb") as file:
        is_zip = file.read(2) == b"PK" or zipfile.is_zipfile(path)
    with _named(path):
        yield from _zip_members(path, size) if is_zip else _tar_members(path, size)


def read_member(path: Path, name: str) -> bytes:
    """Returns the bytes of one member of a zip archive; raises the errors of `members`."""
    size = regular_file(path)
    with _named(path), zipfile.ZipFile(path) as archive:
        try:
            return _read(archive, archive.getinfo(name), size)
        except KeyError as error:
            raise ValueError(f"contains no {name}") from error


def _zip_members(path: Path, size: int) -> Iterator[tuple[str, Callable[[], bytes]]]:
    with zipfile.ZipFile(path) as archive:
        infos = [info for info in archive.infolist() if not info.is_dir()]
        check_expansion(sum(info.file_size for info in infos), size)
        for info in infos:
            yield info.filename, lambda info=info: _within(path, lambda: _read(archive, info, size))


def _read(archive: zipfile.ZipFile, info: zipfile.ZipInfo, size: int) -> bytes:
    check_member(info)
    check_expansion(info.file_size, size)
    if info.file_size > MEMBER_LIMIT:
        raise ValueError(f"{info.filename}: {info.file_size:,} bytes, too many for a motion")
    return archive.read(info)


def _tar_members(path: Path, size: int) -> Iterator[tuple[str, Callable[[], bytes]]]:
    with path.open("rb") as raw:
        head = raw.read(6)
        raw.seek(0)
        unpack: Any = next((opener for magic, opener in _UNPACKERS.items() if head.startswith(magic)), None)
        with unpack(raw) if unpack else raw as unpacked:
            stream: Any = _Bounded(unpacked, size)
            try:
                archive: Any = tarfile.open(  # noqa: SIM115 - closed below
                    mode="r|", fileobj=stream, bufsize=MEBIBYTE // 4, tarinfo=_Member
                )
            except tarfile.ReadError as error:
                if str(error) == "empty file" or stream.total < tarfile.BLOCKSIZE or unpack is None:
                    raise NoArchiveError(f"{path}: neither a folder nor a zip or tar archive") from error
                raise
            with archive:
                while (member := archive.next()) is not None:
                    if not member.isdir():
                        yield member.name, lambda member=member: _within(path, lambda: _extract(archive, member))
                    archive.members = []  # a million empty members take a gigabyte


def _extract(archive: tarfile.TarFile, member: tarfile.TarInfo) -> bytes:
    if not member.isreg() or member.issparse():
        raise ValueError(f"{member.name}: a link or another special file, not a regular file")
    if member.size > MEMBER_LIMIT:
        raise ValueError(f"{member.name}: {member.size:,} bytes, too many for a motion")
    file = archive.extractfile(member)
    assert file is not None
    return file.read()


class NoArchiveError(ValueError):
    """The file is neither a zip nor a tar archive."""


class _Member(tarfile.TarInfo):
    """A tar member that rejects large headers and sparse files before it reads them."""

    def _proc_member(self, archive: tarfile.TarFile) -> Any:
        if self.type == tarfile.GNUTYPE_SPARSE:
            raise ValueError(f"{self.name}: a sparse file")
        if self.type in _HEADERS and self.size > HEADER_LIMIT:
            raise ValueError(f"a header of {self.size:,} bytes")
        if (values := len(archive.pax_headers)) > MAX_GLOBAL_VALUES:
            raise ValueError(f"{values:,} header values apply to all members")
        return super()._proc_member(archive)  # pyright: ignore[reportAttributeAccessIssue]

    def _proc_gnusparse_10(self, *_: Any) -> None:
        raise ValueError(f"{self.name}: a sparse file")


class _Bounded:
    """The unpacked content of a compressed file, limited in size.

    Args:
        file: the unpacked content.
        packed: size of the compressed file in bytes.
    """

    def __init__(self, file: IO[bytes], packed: int):
        self.file, self.packed, self.total, self.ended = file, packed, 0, 0

    def read(self, size: int) -> bytes:
        data = self.file.read(size)
        self.total += len(data)
        self.ended += not data
        if self.ended > 2:  # tarfile would go on to the end of a member that declares any size
            raise EOFError("it ends too early")
        check_expansion(self.total, self.packed)
        return data


def _within(path: Path, read: Callable[[], bytes]) -> bytes:
    with _named(path):
        return read()


@contextmanager
def _named(path: Path) -> Iterator[None]:
    """Adds the name of the archive to errors raised for damaged archives."""
    try:
        yield
    except NoArchiveError:
        raise
    except (*ZIP_ERRORS, tarfile.TarError, lzma.LZMAError, OSError, ValueError) as error:
        if str(error).startswith(str(path)):
            raise
        raise ValueError(f"{path}: damaged archive: {first_line(error)}; download it again") from error
