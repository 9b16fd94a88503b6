"""Two real processes that prepare the same data at once, and signals in libraries that hide them."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator

import pytest
from support.runs import spawn

from flame_mdm.config import guarded
from flame_mdm.data.store import Store
from flame_mdm.progress import ProgressBar

pytestmark = pytest.mark.slow

STORE = "synthetic-humanml-clean-smpl22"


@pytest.fixture
def both(tmp_path) -> Iterator[tuple[subprocess.Popen[str], subprocess.Popen[str]]]:
    """One process that is halted while it prepares, and another that waits for it."""
    line = ["flame_mdm", "prepare", "data=synthetic", "data.source.clips=100", f"data_root={tmp_path}"]
    first = spawn(line)
    end = time.monotonic() + 60
    while not any(tmp_path.glob(f".{STORE}.*")):
        assert first.poll() is None, first.communicate()
        assert time.monotonic() < end, "it never prepares"
        time.sleep(0.002)
    first.send_signal(signal.SIGSTOP)
    second = spawn(line)
    assert second.stdout is not None
    assert "another process is preparing it" in second.stdout.readline()
    yield first, second
    for process in (first, second):
        process.kill()
        process.communicate()


def test_two_processes_prepare_the_same_data_once(both, tmp_path):
    first, second = both
    first.send_signal(signal.SIGCONT)
    outputs = [process.communicate(timeout=120) for process in both]
    assert [first.returncode, second.returncode] == [0, 0], outputs
    assert [path.name for path in tmp_path.iterdir()] == [STORE]
    assert ["preparing" in err for _, err in outputs] == [True, False], "one opens what the other has written"
    assert outputs[0][0].splitlines()[-1] == outputs[1][0].splitlines()[-1], "the fingerprint is the same"
    Store(tmp_path / STORE).verify()


def test_the_second_process_takes_over_from_one_that_is_killed(both, tmp_path):
    first, second = both
    first.kill()
    out, err = second.communicate(timeout=120)
    assert second.returncode == 0, err
    assert "preparing" in err
    assert [path.name for path in tmp_path.iterdir()] == [STORE], out
    Store(tmp_path / STORE).verify()


@pytest.mark.parametrize(
    ("signum", "code", "fails"), [(signal.SIGTERM, 143, True), (signal.SIGINT, 130, True), (signal.SIGINT, 130, False)]
)
def test_a_library_that_fails_after_a_signal_does_not_hide_it(signum, code, fails, capsys):
    def command() -> None:
        try:
            os.kill(os.getpid(), signum)
            time.sleep(1)
        finally:
            if fails:
                raise OSError("cannot close the file")

    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # shells ignore it for jobs in the background
    handlers = list(map(signal.getsignal, (signal.SIGINT, signal.SIGTERM)))
    try:
        assert guarded(command, (signal.SIGINT, signal.SIGTERM)) == code
        assert list(map(signal.getsignal, (signal.SIGINT, signal.SIGTERM))) == handlers
    finally:
        signal.signal(signal.SIGINT, before)
    assert "cannot close" not in capsys.readouterr().err


@pytest.mark.parametrize("advance", [lambda bar: [None for _ in bar], lambda bar: bar.update()])
def test_a_signal_that_a_library_swallows_stops_the_next_step_of_a_progress_bar(advance, capsys):
    class Unfinished:
        def __del__(self) -> None:
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(1)

    reached = []

    def command() -> None:
        bar = ProgressBar(range(3))
        Unfinished()  # Python swallows exceptions of __del__, and prints them
        reached.append("bar")
        advance(bar)
        reached.append("end")

    before = sys.unraisablehook
    assert guarded(command, (signal.SIGTERM,)) == 143
    assert reached == ["bar"]
    assert "Traceback" not in capsys.readouterr().err
    assert sys.unraisablehook is before
    assert list(ProgressBar(range(3))) == [0, 1, 2], "the next command is not stopped"


def test_an_ignored_signal_stays_ignored():
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)  # as a shell does for a job in the background
    try:
        assert guarded(lambda: os.kill(os.getpid(), signal.SIGINT), (signal.SIGINT,)) == 0
    finally:
        signal.signal(signal.SIGINT, before)
