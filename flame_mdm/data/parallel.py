"""Parallel processing of files in worker processes, with results in the original order."""

import os
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from multiprocessing import active_children, get_context, parent_process
from multiprocessing.process import BaseProcess
from typing import TypeVar

from flame_mdm.errors import UserError
from flame_mdm.signals import ignore_interrupts

Task = TypeVar("Task")
Result = TypeVar("Result")
# Seconds of work after which processes are started if their number is not set. Starting them takes
# about as long.
PATIENCE = 2.0


def cores() -> int:
    """Returns the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def in_order(
    function: Callable[[Task], Result], tasks: Iterable[Task], workers: int = 0
) -> Generator[Result]:
    """Yields `function(task)` for each task, in the order of the tasks.

    Only a few tasks are read ahead. If `tasks` is the result of another `in_order` call, both calls
    share one pool.

    Args:
        function: function to call with each task. The function, the tasks and the results must be
            picklable.
        tasks: the arguments of the function.
        workers: number of processes. 1 = work in this process. 0 = start one process per core if
            the work takes longer than `PATIENCE` seconds.

    Raises:
        UserError: If a worker process died, for example because the system ran out of memory.
    """
    workers = 1 if not workers and cores() == 1 else workers
    start, remaining = time.monotonic(), iter(tasks)
    while workers == 1 or (not workers and _pool is None and time.monotonic() < start + PATIENCE):
        for task in islice(remaining, 1):
            yield function(task)
            break
        else:
            return
    workers = workers or cores()
    with _shared_pool(workers) as pool:
        pending: deque[Future[Result]] = deque()
        try:
            for task in remaining:
                pending.append(pool.submit(function, task))
                if len(pending) > 2 * workers:
                    yield _first(pending)
            while pending:
                yield _first(pending)
        finally:
            for future in pending:
                future.cancel()


@dataclass
class _Pool:
    executor: ProcessPoolExecutor
    others: list[BaseProcess]  # children of this process that do not belong to the pool
    users: int = 0


_pool: _Pool | None = None  # the pool in use, if any


@contextmanager
def _shared_pool(workers: int) -> Iterator[ProcessPoolExecutor]:
    global _pool
    # Processes are spawned instead of forked. A fork would copy locks that the threads of this
    # process hold, for example if torch was used.
    pool = _pool = _pool or _Pool(
        ProcessPoolExecutor(workers, get_context("spawn"), _start_worker), active_children()
    )
    pool.users += 1
    try:
        yield pool.executor
    # After an error or Ctrl-C, the workers are killed, because their tasks may take half an hour
    except BaseException as error:
        if isinstance(error, GeneratorExit) and pool.users > 1:  # the others still need the pool
            raise
        _pool = None
        pool.executor.shutdown(wait=False, cancel_futures=True)
        for process in set(active_children()) - set(pool.others):
            process.kill()  # a stopped process would not answer SIGTERM
            process.join()
        if isinstance(error, BrokenProcessPool):
            raise UserError(
                "a worker process was killed, perhaps because memory ran out. Use fewer processes. "
                "With data.source.workers=1, the error message also names the file that was being read"
            ) from error
        raise
    finally:
        pool.users -= 1
        if not pool.users:
            _pool = None
            pool.executor.shutdown()


def _first(pending: deque[Future[Result]]) -> Result:
    """Returns the result of the first task, or raises the first error of any task.

    Errors of later tasks are raised immediately, because the first task may take a long time or
    never end.
    """
    while True:
        for future in pending:
            if future.done() and future.exception() is not None:
                future.result()
        if pending[0].done():
            return pending.popleft().result()
        wait([future for future in pending if not future.done()], return_when=FIRST_COMPLETED)


def _start_worker() -> None:
    """Sets up a worker process.

    The process uses a single thread, exits if the parent process dies, and ignores Ctrl-C, which
    the parent process handles.
    """
    # torch reads this variable when a task imports torch. Importing torch here would slow down
    # tasks that do not need it.
    os.environ["OMP_NUM_THREADS"] = "1"

    def follow() -> None:
        parent = parent_process()
        if parent is not None:
            parent.join()
            os._exit(1)

    ignore_interrupts()
    threading.Thread(target=follow, daemon=True).start()
