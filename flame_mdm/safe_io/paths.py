"""Checked and temporary paths for writing to a folder that may contain files from other people.

Links must not point outside the folder. A file that is written in place must not have additional
hard links. The names of temporary files are unique.
"""

from __future__ import annotations

import functools
import hashlib
import os
import re
import secrets
import shutil
import socket
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from flame_mdm.errors import UserError

SECOND_NAME = (
    "a file with a second name (hard link), which would also be changed. Replace it with a copy"
)

WANDB_LINKS = re.compile(r"wandb/(latest-run|debug[\w-]*\.log|[\w-]+/logs/debug[\w-]*\.log)")
"""Links that wandb creates from a run directory to its logs.

wandb replaces these links, and writes a resumed run to another folder.
"""

_tokens: set[str] = set()
"""Random parts in the names of temporary files and folders that this process is writing."""


def check_within(path: str | Path, root: str | Path) -> None:
    """Raises `UserError` if any link along a path points outside the folder `root`."""
    target = os.path.realpath(path)
    if not Path(target).is_relative_to(os.path.realpath(root)):
        raise UserError(
            f"{path}: a link points outside {root}, to {target}, so nothing is written there. Remove the link"
        )


def check_tree(folder: Path) -> None:
    """Checks a folder from another person before libraries write to it.

    Libraries open files in place, so they could change files outside the folder. Raises `UserError`
    if the folder contains a pipe, a device, a link that points outside the folder, or a file with
    additional hard links.
    """
    for parent, folders, files in os.walk(folder):
        for name in (*folders, *files):
            path = Path(parent, name)
            status = path.lstat()
            if stat.S_ISLNK(status.st_mode):
                if not WANDB_LINKS.fullmatch(path.relative_to(folder).as_posix()):
                    check_within(path, folder)
            elif (
                stat.S_ISFIFO(status.st_mode)
                or stat.S_ISBLK(status.st_mode)
                or stat.S_ISCHR(status.st_mode)
            ):
                raise UserError(f"{path}: this is a pipe or a device. Remove it")
            elif stat.S_ISREG(status.st_mode) and status.st_nlink > 1:
                raise UserError(f"{path}: this is {SECOND_NAME}")


def open_in_place(path: Path) -> IO[str]:
    """Opens a text file for reading and appending, and creates it if it does not exist.

    Writing in place would change the target of a link, so links are not followed. Raises
    `UserError` if the path is a link or is not a regular file, or if the file has additional hard
    links.
    """
    flags = os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    try:
        descriptor = os.open(path, flags, 0o666)
    except OSError as error:
        if path.is_symlink():
            raise UserError(
                f"{path}: this is a link, and links are not followed when writing. Remove the link"
            ) from error
        raise
    status = os.fstat(descriptor)
    if not stat.S_ISREG(status.st_mode) or status.st_nlink > 1:
        os.close(descriptor)
        kind = (
            SECOND_NAME
            if stat.S_ISREG(status.st_mode)
            else "a pipe, a socket or a device, not a regular file. Remove it"
        )
        raise UserError(f"{path}: this is {kind}")
    return os.fdopen(descriptor, "a+", encoding="utf-8")


@contextmanager
def temporary_beside(path: Path) -> Iterator[Path]:
    """Yields a unique path next to `path`, and removes the file at this path at the end."""
    token = secrets.token_hex(8)
    temporary = path.with_name(f".{path.stem[:80]}.{_machine()}-{os.getpid()}-{token}{path.suffix}")
    _tokens.add(token)
    try:
        yield temporary
    finally:
        _remove(temporary)
        _tokens.discard(token)


@functools.cache
def _machine() -> str:
    """Returns eight hexadecimal digits that identify the host and its process namespace."""
    numbering = ""
    with suppress(OSError):  # a system without /proc
        numbering = str(Path("/proc/self/ns/pid").readlink())
    return hashlib.sha256(f"{socket.gethostname()} {numbering}".encode()).hexdigest()[:8]


def remove_abandoned(folder: Path, path: Path | None = None, *, is_locked: bool = False) -> None:
    """Removes temporary files and folders left behind by dead processes.

    Args:
        folder: the folder that contains the temporary files and folders.
        path: the file or folder whose temporary files are removed, or None for all temporary files
            in the folder.
        is_locked: whether this process holds the lock that is required for writing such files. If
            it does, files from processes on other machines are also removed. Otherwise, these files
            are kept, because their processes may still be alive.
    """
    if not folder.is_dir():
        return
    stem = r".+" if path is None else re.escape(path.stem[:80])
    suffix = r"(\.\w+)?" if path is None else re.escape(path.suffix)
    pattern = re.compile(rf"\.{stem}\.([0-9a-f]{{8}})-(\d{{1,10}})-([0-9a-f]{{16}}){suffix}")
    for entry in folder.iterdir():
        match = pattern.fullmatch(entry.name)
        if (
            match
            and match[3] not in _tokens
            and (is_locked or (match[1] == _machine() and not _lives(int(match[2]))))
        ):
            with suppress(PermissionError):  # a file of another user
                _remove(entry)


def _lives(process: int) -> bool:
    """Returns whether an id belongs to another process that is running on this machine."""
    if process == os.getpid():
        return False
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:  # a process of another user
        return True
    return True


def _remove(path: Path) -> None:
    """Removes a temporary file, folder or link. The target of a link is not removed."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)
