"""Full disks, signals, kills at random moments, loading processes that die, and two that prepare the same data."""

import io
import multiprocessing
import os
import random
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout, suppress
from multiprocessing import active_children
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
import torch
from support.runs import TINY, finish, no_children, spawn

from flame_mdm.__main__ import main
from flame_mdm.checkpoints.model_files import read_checkpoint
from flame_mdm.commands import train
from flame_mdm.config import guarded
from flame_mdm.data.datamodule import Clips
from flame_mdm.data.store import Store
from flame_mdm.data.synthetic import Synthetic
from flame_mdm.errors import UserError
from flame_mdm.progress import ProgressBar
from flame_mdm.signals import StopRequest, raise_received, stoppable
from flame_mdm.training.checkpointing import LAST, AtomicCheckpoints, newest
from flame_mdm.training.guards import lost_worker

pytestmark = pytest.mark.slow

STORE = "synthetic-humanml-clean-smpl22"
QUIET = [
    "callbacks.samples=null",
    "callbacks.best=null",
    "logger=csv",
    "callbacks.checkpoints.every_n_steps=2",
]


def words(root: Path, run: Path, *more: str) -> list[str]:
    return ["quickstart", *TINY, *QUIET, f"data_root={root}", f"run.dir={run}", *more]


@contextmanager
def file_limit(size: int) -> Iterator[None]:
    """Sets the size that files may have; writing more fails as on a full disk."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def test_a_full_disk_leaves_the_checkpoint_before(tmp_path):
    checkpoints = AtomicCheckpoints(tmp_path)
    checkpoints.save_checkpoint(
        {"global_step": 1, "config": {}, "facts": {}, "state_dict": {}}, tmp_path / LAST
    )
    before = (tmp_path / LAST).read_bytes()
    message = r"last\.ckpt: the checkpoint of step 2 cannot be written .*File too large"
    with file_limit(100_000), pytest.raises(UserError, match=message):
        checkpoints.save_checkpoint(
            {"global_step": 2, "state_dict": {"a": torch.zeros(100_000)}}, tmp_path / LAST
        )
    assert [path.name for path in tmp_path.iterdir()] == [LAST]
    assert (tmp_path / LAST).read_bytes() == before


def test_a_preparation_without_room_leaves_nothing(tmp_path, capsys, subtests):
    for size in (0, 100_000):
        with subtests.test(size=size):
            with file_limit(size):
                assert (
                    main(
                        [
                            "prepare",
                            "data=synthetic",
                            "data.source.clips=60",
                            f"data_root={tmp_path / 'data'}",
                        ]
                    )
                    == 1
                )
            line = capsys.readouterr().err.splitlines()[-1]
            assert line.startswith(
                f"error: {tmp_path / 'data' / STORE}: cannot be written: File too large. "
            )
            assert f" is free on the disk that contains {tmp_path / 'data'}" in line
            assert list(tmp_path.iterdir()) == []


# PyTorch reports the death by an exception in a signal handler, which may interrupt the writing of
# a checkpoint between opening its temporary file and the code that closes it.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_killed_loading_process_is_named_in_one_line(tmp_path, data_root, monkeypatch, capsys):
    load, parent = Clips.__getitems__, os.getpid()

    def killed(self: Clips, draws: Any) -> Any:
        if os.getpid() != parent and (tmp_path / "run" / "checkpoints" / LAST).exists():
            os.kill(os.getpid(), signal.SIGKILL)
        return load(self, draws)

    monkeypatch.setattr(Clips, "__getitems__", killed)
    line = words(data_root, tmp_path / "run", "data.num_workers=2", "data.resident=false")
    children = active_children()
    assert train.main([*line, "trainer.max_steps=1000"]) == 1
    assert "\nerror: a data loading process was killed, " in f"\n{capsys.readouterr().err}"
    assert no_children(children)
    assert not (tmp_path / "run" / "run.lock").exists()
    monkeypatch.undo()
    resumed = newest(tmp_path / "run" / "checkpoints")
    assert resumed is not None
    assert train.main([*line, f"trainer.max_steps={resumed.step + 2}"]) == 0


def test_which_second_signal_ends_a_run_at_once(monkeypatch, subtests):
    request = StopRequest()
    monkeypatch.setattr("flame_mdm.signals.kill_children", lambda: None)
    for signum in (signal.SIGUSR1, signal.SIGTERM, signal.SIGTERM):
        request.note(signum, None)
    request.time -= 2
    for signum, code in ((signal.SIGTERM, "143"), (signal.SIGINT, "130")):
        with subtests.test(signum=signum, code=code), pytest.raises(SystemExit, match=code):
            request.note(signum, None)


@pytest.mark.parametrize(
    ("first", "second", "seconds", "stops"),
    [
        (signal.SIGINT, signal.SIGINT, 0.0, True),
        (signal.SIGTERM, signal.SIGINT, 0.0, True),
        (signal.SIGUSR1, signal.SIGINT, 0.0, True),
        (signal.SIGTERM, signal.SIGTERM, 0.9, False),
        (signal.SIGTERM, signal.SIGTERM, 1.1, True),
        (signal.SIGINT, signal.SIGTERM, 9.0, False),
        (signal.SIGUSR1, signal.SIGTERM, 9.0, False),
        (signal.SIGUSR1, signal.SIGUSR1, 9.0, False),
        (signal.SIGTERM, signal.SIGUSR2, 9.0, False),
    ],
)
def test_a_signal_after_another_one_ends_a_run_at_once_or_is_noted(
    monkeypatch, first: signal.Signals, second: signal.Signals, seconds: float, stops: bool
):
    times, killed = iter([100.0, 100.0 + seconds, 100.0 + seconds]), []
    monkeypatch.setattr("flame_mdm.signals.time.monotonic", lambda: next(times))
    monkeypatch.setattr("flame_mdm.signals.kill_children", lambda: killed.append(True))
    request = StopRequest()
    request.note(first, None)
    assert request.signum == first
    if stops:
        with pytest.raises(SystemExit) as stopped:
            request.note(second, None)
        assert stopped.value.code == 128 + second
    else:
        request.note(second, None)
        assert request.signum == second
    assert killed == [True] * stops


@pytest.fixture
def usual_signals():
    """Signals have their usual handlers, also if the tests run in the background or under nohup."""
    usual = {
        signal.SIGINT: signal.default_int_handler,
        signal.SIGTERM: signal.SIG_DFL,
        signal.SIGHUP: signal.SIG_DFL,
    }
    before = {signum: signal.signal(signum, handler) for signum, handler in usual.items()}
    yield
    for signum, handler in before.items():
        signal.signal(signum, handler)


@pytest.mark.usefixtures("usual_signals")
def test_a_command_ends_with_the_number_of_its_signal_also_if_a_library_reports_another_error():
    def received(signum: signal.Signals, kind: str) -> int:
        with stoppable([signal.SIGTERM, signal.SIGHUP]):
            try:
                signal.raise_signal(signum)
            except SystemExit:
                if kind == "swallowed":
                    raise_received()
                elif kind == "replaced":
                    raise OSError("the cleanup failed") from None
                raise
        return 0

    before = [signal.getsignal(signum) for signum in (signal.SIGTERM, signal.SIGHUP)]
    for signum in (signal.SIGTERM, signal.SIGHUP):
        for kind in ("raised", "swallowed", "replaced"):
            with pytest.raises(SystemExit) as stopped:
                received(signum, kind)
            assert stopped.value.code == 128 + signum, kind
            assert [
                signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGHUP)
            ] == before
            raise_received()  # nothing is left of a signal that has ended its command
    with pytest.raises(OSError, match="no signal"), stoppable([signal.SIGTERM]):
        raise OSError("no signal")


@pytest.mark.usefixtures("usual_signals")
def test_ignored_signals_stay_ignored_and_an_interrupt_is_a_keyboard_interrupt():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with stoppable([signal.SIGHUP, signal.SIGTERM]):
            signal.raise_signal(signal.SIGHUP)
            assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
        with pytest.raises(KeyboardInterrupt), stoppable([signal.SIGINT]):
            signal.raise_signal(signal.SIGINT)
    finally:
        signal.signal(signal.SIGHUP, before)


def test_torch_messages_about_lost_workers_are_understood(tmp_path, monkeypatch, subtests):
    assert lost_worker(RuntimeError("Caught ValueError in DataLoader worker process 0.")) is None
    assert "ended unexpectedly" in str(
        lost_worker(ConnectionResetError(104, "Connection reset by peer"))
    )
    for message in (
        "DataLoader worker (pid 12) is killed by signal: Killed. ",
        "DataLoader worker (pid(s) 12, 13) exited unexpectedly",
        "DataLoader worker (pid 12) exited unexpectedly with exit code 1. Details",
    ):
        with subtests.test(message=message):
            assert str(lost_worker(RuntimeError(message))).startswith(
                "a data loading process was killed"
            )
            monkeypatch.setattr("torch.save", Mock(side_effect=RuntimeError(message)))
            with pytest.raises(UserError) as caught:
                AtomicCheckpoints(tmp_path).save_checkpoint({"global_step": 1}, tmp_path / LAST)
            assert lost_worker(caught.value) is not None
            assert list(tmp_path.iterdir()) == []


def prepare(folder: Path, log: Path) -> None:
    """Prepares data in this process, once the file `go` is there."""

    def clips(self: Synthetic, fps: float) -> Any:
        (folder / "begun").touch()
        while not (folder / "go").exists():
            time.sleep(0.01)
        return original(self, fps)

    original, Synthetic.clips = Synthetic.clips, clips  # type: ignore[method-assign]
    with log.open("w", buffering=1) as file, redirect_stdout(file), redirect_stderr(file):
        code = main(
            ["prepare", "data=synthetic", "data.source.clips=100", f"data_root={folder / 'data'}"]
        )
    os._exit(code)


@pytest.mark.parametrize("dies", [False, True])
def test_two_processes_prepare_the_same_data_once_and_one_takes_over_if_the_other_dies(
    dies, tmp_path
):
    context, logs = multiprocessing.get_context("fork"), [tmp_path / "first", tmp_path / "second"]
    first, second = (
        context.Process(target=prepare, args=(tmp_path, log), daemon=True) for log in logs
    )
    first.start()
    while not (tmp_path / "begun").exists():
        time.sleep(0.01)
    second.start()
    while not logs[1].exists() or "another process is preparing it" not in logs[1].read_text():
        time.sleep(0.01)
    if dies:
        first.kill()
        first.join()
    (tmp_path / "go").touch()
    second.join(60)
    first.join(60)
    assert [first.exitcode, second.exitcode] == [-signal.SIGKILL if dies else 0, 0], logs[
        1
    ].read_text()
    assert [path.name for path in (tmp_path / "data").iterdir()] == [STORE]
    assert ("preparing synthetic" in logs[1].read_text()) == dies, (
        "otherwise it opens what the other has written"
    )
    assert len({log.read_text().splitlines()[-1] for log in logs[dies:]}) == 1, (
        "the fingerprint is the same"
    )
    Store(tmp_path / "data" / STORE).verify()


@pytest.mark.parametrize(
    ("signum", "code", "fails"),
    [(signal.SIGTERM, 143, True), (signal.SIGINT, 130, True), (signal.SIGINT, 130, False)],
)
def test_a_library_that_fails_after_a_signal_does_not_hide_it(signum, code, fails, capsys):
    def command() -> None:
        try:
            os.kill(os.getpid(), signum)
            time.sleep(1)
        finally:
            if fails:
                raise OSError("cannot close the file")

    # Shells ignore it for jobs in the background
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
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


def test_progress_in_a_log_file_is_lines_half_a_minute_apart(monkeypatch):
    file = io.StringIO()
    clock = [0.0]
    monkeypatch.setattr("tqdm.std.time", lambda: clock[0])
    bar = ProgressBar(total=100, desc="training", file=file)
    for clock[0] in range(1, 101):
        bar.update()
    bar.close()
    lines = file.getvalue().split("\n")
    assert [line.split("|")[0].strip() for line in lines[:-1]] == [
        f"training: {share:3}%" for share in (0, 30, 60, 90, 100)
    ]
    assert lines[-1] == ""
    assert "100/100" in lines[-2]


def test_an_ignored_signal_stays_ignored():
    # As a shell does for a job in the background
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        assert guarded(lambda: os.kill(os.getpid(), signal.SIGINT), (signal.SIGINT,)) == 0
    finally:
        signal.signal(signal.SIGINT, before)


KILLS = int(os.environ.get("FLAME_MDM_KILLS", "4"))
"""Kills, half of them SIGKILL and half SIGTERM."""


def result(folder: Path) -> Any:
    """Results that must be the same after a run was killed and resumed."""
    content = read_checkpoint(folder / "checkpoints" / LAST)
    states = content["state_dict"], content["current_model_state"]
    return content["global_step"], [
        {name: x.numpy().tobytes() for name, x in state.items()} for state in states
    ]


@pytest.mark.robustness
def test_kills_at_random_moments_change_nothing(data_root, tmp_path):
    """Of a training; tests/test_evaluate.py kills an evaluation, tests/test_prepare.py interrupts a preparation."""
    often = [
        "trainer.val_check_interval=50",
        "callbacks.checkpoints.every_n_steps=10",
        "trainer.max_steps=500",
    ]

    def start(folder: Path) -> subprocess.Popen[str]:
        return spawn(
            ["flame_mdm", "train", *words(data_root, folder, "denoiser.dropout=0.1", *often)]
        )

    draw, begin = random.Random(0), time.monotonic()
    assert finish(start(tmp_path / "whole"))[0] == 0
    longest = time.monotonic() - begin
    for number in range(KILLS):
        signum = signal.SIGTERM if number % 2 else signal.SIGKILL
        process = start(tmp_path / "killed")
        with suppress(subprocess.TimeoutExpired):
            process.wait(draw.uniform(0.3, 0.9) * longest)
        process.send_signal(signum)
        code, _, err = finish(process)
        assert code in (0, -signum, 128 + signum), err
    assert finish(start(tmp_path / "killed"))[0] == 0
    assert result(tmp_path / "killed") == result(tmp_path / "whole")
