"""Skeletons as data (stub; the representations work fills this in)."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Skeleton:
    """A tree of joints."""

    name: str
    joints: tuple[str, ...]
    parents: tuple[int, ...]
