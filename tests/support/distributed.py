"""Processes joined by gloo, for tests of what several processes compute together.

That the processes cannot start or do not answer is a failure of the test, never a reason to skip it.
"""

from __future__ import annotations

import multiprocessing
import os
import tempfile
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from datetime import timedelta
from typing import Any, Self

import torch

SECONDS = 120


class GlooPool:
    """A process group on this machine, which runs functions of test modules. Use as a context manager.

    Each process computes with one thread, as the tests do. The processes are forks of this one, since importing
    torch and the package again takes most of the time of a test.
    """

    def __init__(self, size: int = 2):
        self.size = size

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            url = f"file://{stack.enter_context(tempfile.TemporaryDirectory())}/rendezvous"
            fork = multiprocessing.get_context("fork")
            self.ranks = [
                stack.enter_context(ProcessPoolExecutor(1, fork, _join, (rank, self.size, url)))
                for rank in range(self.size)
            ]
            seen = self.run(_rank_and_size)
            assert seen == [(rank, self.size) for rank in range(self.size)], (
                "the processes do not see one another"
            )
            self.stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        for rank in self.ranks:
            rank.submit(torch.distributed.destroy_process_group)
        self.stack.close()

    def run(self, function: Callable[..., Any], *arguments: tuple[Any, ...]) -> list[Any]:
        """Returns the results of `function(*arguments[rank])` of every process; raises what a process raises.

        Args:
            function: A function at the top of a module.
            arguments: One tuple per process, or none for a function without arguments.
        """
        ranks = zip(self.ranks, arguments or [()] * self.size, strict=True)
        futures = [rank.submit(function, *values) for rank, values in ranks]
        return [future.result(SECONDS) for future in futures]


def _join(rank: int, size: int, url: str) -> None:
    os.environ["GLOO_SOCKET_IFNAME"] = "lo"
    torch.set_num_threads(1)
    torch.distributed.init_process_group(
        "gloo", init_method=url, rank=rank, world_size=size, timeout=timedelta(seconds=SECONDS)
    )


def _rank_and_size() -> tuple[int, int]:
    return torch.distributed.get_rank(), torch.distributed.get_world_size()
