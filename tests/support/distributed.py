"""Processes joined by gloo, for tests of what several processes compute together.

That the processes cannot start or do not answer is a failure of the test, never a reason to skip it.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import tempfile
import traceback
from collections.abc import Callable
from datetime import timedelta
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Self

import torch

SECONDS = 120


class GlooPool:
    """A process group of `size` processes of this machine, which run functions of test modules.

    Use as a context manager. Each process computes with one thread, as the tests do.
    """

    def __init__(self, size: int = 2):
        self.size = size

    def __enter__(self) -> Self:
        self.folder = tempfile.TemporaryDirectory()
        rendezvous = Path(self.folder.name) / "rendezvous"
        spawn = multiprocessing.get_context("spawn")
        self.connections: list[Connection] = []
        self.processes = []
        for rank in range(self.size):
            here, there = spawn.Pipe()
            process = spawn.Process(target=_work, args=(there, rank, self.size, f"file://{rendezvous}"), daemon=True)
            process.start()
            there.close()
            self.connections.append(here)
            self.processes.append(process)
        if self.run(_rank_and_size) != [(rank, self.size) for rank in range(self.size)]:
            raise RuntimeError("the processes do not see one another")
        return self

    def __exit__(self, *_: object) -> None:
        for connection in self.connections:
            connection.close()
        for process in self.processes:
            process.join(10)
            if process.is_alive():
                process.kill()
        self.folder.cleanup()

    def run(self, function: Callable[..., Any], *arguments: tuple[Any, ...]) -> list[Any]:
        """Runs `function(*arguments[rank])` in every process.

        Args:
            function: a function at the top of a module.
            arguments: one tuple a process, or none for a function without arguments.

        Returns:
            The results in the order of the ranks.

        Raises:
            RuntimeError: a process raised, ended, or did not answer within two minutes.
        """
        for rank, connection in enumerate(self.connections):
            connection.send_bytes(pickle.dumps((function, arguments[rank] if arguments else ())))
        results = []
        for rank, connection in enumerate(self.connections):
            try:
                if not connection.poll(SECONDS):
                    raise RuntimeError(f"process {rank} did not answer within {SECONDS} s")
                error, result = pickle.loads(connection.recv_bytes())
            except (EOFError, ConnectionResetError) as ended:
                raise RuntimeError(f"process {rank} ended") from ended
            if error:
                raise RuntimeError(f"process {rank}: {error}")
            results.append(result)
        return results


def _work(connection: Connection, rank: int, size: int, rendezvous: str) -> None:
    os.environ["GLOO_SOCKET_IFNAME"] = "lo"
    torch.set_num_threads(1)
    torch.distributed.init_process_group(
        "gloo", init_method=rendezvous, rank=rank, world_size=size, timeout=timedelta(seconds=SECONDS)
    )
    while True:
        try:
            function, arguments = pickle.loads(connection.recv_bytes())
        except (EOFError, ConnectionResetError):  # the tests are over
            break
        try:
            answer = None, function(*arguments)
        except Exception:
            answer = traceback.format_exc(), None
        connection.send_bytes(pickle.dumps(answer))
    torch.distributed.destroy_process_group()


def _rank_and_size() -> tuple[int, int]:
    return torch.distributed.get_rank(), torch.distributed.get_world_size()
