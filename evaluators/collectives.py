"""Work shared by the processes of an evaluation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import torch

T = TypeVar("T")
Item = TypeVar("Item")


def shared(value: T, world: int) -> T:
    """Returns the value of the first of `world` processes, on all of them."""
    box = [value]
    if world > 1:
        torch.distributed.broadcast_object_list(box)
    return box[0]


def dealt(function: Callable[[Item], T], items: Sequence[Item], rank: int, world: int) -> list[T]:
    """Returns the results for all items, on all of `world` processes; each computes every `world`-th."""
    own = [function(item) for item in items[rank::world]]
    if world == 1:
        return own
    parts: list[Any] = [None] * world
    torch.distributed.all_gather_object(parts, own)
    results: list[Any] = [None] * len(items)
    for number, part in enumerate(parts):
        results[number::world] = part
    return results
