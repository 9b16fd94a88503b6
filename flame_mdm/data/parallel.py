"""Work on many files in processes of their own, results in order."""

from __future__ import annotations

import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import active_children, get_context, parent_process
from typing import TypeVar

from flame_mdm.errors import UserError

Task = TypeVar("Task")
Result = TypeVar("Result")


def in_order(function: Callable[[Task], Result], tasks: Iterable[Task], workers: int = 0) -> Iterator[Result]:
    """`function(task)` of each task, in the order of the tasks, of which only a few are read ahead.

    Args:
        function: can be pickled, as the tasks and results can.
        tasks: what to do.
        workers: processes; 0 = one a core, 1 = none but this one.

    Raises:
        UserError: a worker died, for instance because the system ran out of memory.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    workers = workers or cores
    if workers == 1:
        yield from map(function, tasks)
        return
    others = active_children()
    # Fresh processes: a fork would copy the threads' locks of a process that may have used torch before.
    with ProcessPoolExecutor(workers, get_context("spawn"), _start_worker) as pool:
        pending: deque[Future[Result]] = deque()
        try:
            for task in tasks:
                pending.append(pool.submit(function, task))
                if len(pending) > 2 * workers:
                    yield _first(pending)
            while pending:
                yield _first(pending)
        except BaseException as error:  # an error or Ctrl-C shall not wait for tasks that may take half an hour
            pool.shutdown(wait=False, cancel_futures=True)
            for process in set(active_children()) - set(others):
                process.kill()  # a stopped process would not answer SIGTERM
                process.join()
            if isinstance(error, BrokenProcessPool):
                raise UserError(
                    "a worker process was killed, perhaps because the memory did not suffice: take fewer processes "
                    "(data.source.workers=1 also names the file)"
                ) from error
            raise


def _first(pending: deque[Future[Result]]) -> Result:
    """Returns the result of the first task, or raises the error of any: the first one may take long, or never end."""
    while True:
        for future in pending:
            if future.done() and future.exception() is not None:
                future.result()
        if pending[0].done():
            return pending.popleft().result()
        wait([future for future in pending if not future.done()], return_when=FIRST_COMPLETED)


def _start_worker() -> None:
    """Leaves Ctrl-C to the process that started this one, and ends with it, even when that is killed; one thread."""
    os.environ["OMP_NUM_THREADS"] = "1"  # read when a task imports torch; importing it for tasks that do not takes long

    def follow() -> None:
        parent = parent_process()
        if parent is not None:
            parent.join()
            os._exit(1)

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=follow, daemon=True).start()
