# pyright: standard
"""Divides evaluation work among the ranks of a process group.

Without a process group, everything runs in one process.
"""

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta
from typing import Any, TypeVar

import torch
import torch.distributed as dist

from flame_mdm.checkpoints.loading import check_device

T = TypeVar("T")
Item = TypeVar("Item")


def world_size() -> int:
    """Returns the number of ranks, or 1 if there is no process group."""
    return dist.get_world_size() if dist.is_available() and dist.is_initialized() else 1


def is_first() -> bool:
    """Returns whether this is the first process.

    The first process computes metrics, writes files and shows progress.
    """
    return world_size() == 1 or dist.get_rank() == 0


def shared(value: T) -> T:
    """Returns rank 0's value on every rank."""
    box = [value]
    if world_size() > 1:
        dist.broadcast_object_list(box)
    return box[0]


def dealt(function: Callable[[Item], T], items: Sequence[Item]) -> list[T]:
    """Returns the results for all items on every rank. Each of N ranks computes every N-th result."""
    count = world_size()
    if count == 1:
        return [function(item) for item in items]
    parts: list[Any] = [None] * count
    dist.all_gather_object(parts, [function(item) for item in items[dist.get_rank() :: count]])
    results: list[Any] = [None] * len(items)
    for number, part in enumerate(parts):
        results[number::count] = part
    return results


@contextmanager
def processes(device: str | None) -> Iterator[str]:
    """Joins the process group that torchrun started, if any, and yields the device.

    By default, the device is a GPU if this machine has one. Raises `UserError` if this machine does
    not have the requested device.
    """
    if device is None:
        local = int(os.environ.get("LOCAL_RANK", 0))
        device = f"cuda:{local % torch.cuda.device_count()}" if torch.cuda.is_available() else "cpu"
    check_device(device)
    if int(os.environ.get("WORLD_SIZE", 1)) == 1:
        yield device
        return
    # This import must precede the creation of the group. Otherwise, the default arguments of its
    # functions would keep the group and its gloo threads alive, and a live thread can abort the
    # process while Python shuts down.
    from torch.distributed.nn import functional  # noqa: F401

    # Motions are gathered once per replication, on the CPU. A process that finishes early may have
    # to wait for hours.
    dist.init_process_group("gloo", timeout=timedelta(days=7))
    try:
        yield device
    finally:
        dist.destroy_process_group()
