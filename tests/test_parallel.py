"""Work in several processes, with results in order."""

import math
import os
from collections.abc import Iterator
from itertools import islice

import pytest

from flame_mdm.data import parallel
from flame_mdm.data.parallel import in_order


@pytest.mark.parametrize("workers", [1, 2])
def test_results_come_in_the_order_of_the_tasks(workers):
    assert list(in_order(math.sqrt, (float(n * n) for n in range(40)), workers)) == list(range(40))


def process(_: int) -> int:
    return os.getpid()


def test_nested_calls_share_their_processes():
    inner = in_order(process, range(100), workers=2)

    def tasks() -> Iterator[int]:
        yield from islice(inner, 50)
        inner.close()
        yield from [0] * 50

    tried: list[int] = []
    outer = list(in_order(process, (tried.append(task) or task for task in tasks()), workers=2))
    assert len(outer) == 100
    assert len({*tried[:50], *outer}) <= 2
    assert os.getpid() not in outer


def test_processes_start_once_the_work_takes_long(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(parallel, "cores", lambda: 2)
    assert set(in_order(process, range(5))) == {os.getpid()}
    monkeypatch.setattr(parallel, "PATIENCE", 0.0)
    assert os.getpid() not in set(in_order(process, range(5)))
    monkeypatch.setattr(parallel, "cores", lambda: 1)
    assert set(in_order(process, range(5))) == {os.getpid()}


@pytest.mark.slow
def test_each_process_has_one_thread(monkeypatch):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    assert list(in_order(eval, ["__import__('torch').get_num_threads()"], workers=2)) == [1]
