import math
import time
from multiprocessing import active_children

import pytest

from flame_mdm.data.parallel import in_order


@pytest.mark.parametrize("workers", [1, 2])
def test_results_come_in_the_order_of_the_tasks(workers):
    assert list(in_order(math.sqrt, (float(n * n) for n in range(40)), workers)) == list(range(40))


def threads(_: int) -> int:
    import torch

    return torch.get_num_threads()


@pytest.mark.slow
def test_each_process_has_one_thread(monkeypatch):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    assert list(in_order(threads, [0], workers=2)) == [1]


def test_an_error_ends_the_other_tasks():
    before = active_children()
    start = time.monotonic()
    with pytest.raises(ValueError, match="non-negative"):
        list(in_order(time.sleep, [-1, 100, 100, 100], workers=2))
    assert time.monotonic() - start < 60
    while left := [child for child in active_children() if child not in before]:
        # Ended, but the pool's thread may be about to note it.
        assert time.monotonic() - start < 60, left
        time.sleep(0.01)
