"""Full disks, loading processes that die or stop, kills at random moments; what the start of a command imports."""

import io
import multiprocessing
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import torch
from support.runs import TINY, finish, spawn

from flame_mdm.__main__ import main
from flame_mdm.checkpoints.model_files import read_checkpoint
from flame_mdm.commands import train
from flame_mdm.errors import UserError
from flame_mdm.signals import StopRequest
from flame_mdm.training.checkpointing import LAST, AtomicCheckpoints, newest
from flame_mdm.training.guards import lost_worker

pytestmark = pytest.mark.slow

STORE = "synthetic-humanml-clean-smpl22"
QUIET = ["callbacks.samples=null", "callbacks.best=null", "logger=csv", "callbacks.checkpoints.every_n_steps=2"]


def words(root: Path, run: Path, *more: str) -> list[str]:
    return ["quickstart", *TINY, *QUIET, f"data_root={root}", f"run.dir={run}", *more]


def prepared(root: Path, clips: int) -> list[str]:
    return ["data=synthetic", f"data.source.clips={clips}", f"data_root={root}"]


# Full disks -----------------------------------------------------------------------------------------------------------


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
    checkpoints.save_checkpoint({"global_step": 1, "config": {}, "facts": {}, "state_dict": {}}, tmp_path / LAST)
    before = (tmp_path / LAST).read_bytes()
    message = r"last\.ckpt: the checkpoint of step 2 cannot be written .*File too large"
    with file_limit(100_000), pytest.raises(UserError, match=message):
        checkpoints.save_checkpoint({"global_step": 2, "state_dict": {"a": torch.zeros(100_000)}}, tmp_path / LAST)
    assert [path.name for path in tmp_path.iterdir()] == [LAST]
    assert (tmp_path / LAST).read_bytes() == before


def test_a_preparation_without_room_leaves_nothing(tmp_path, capsys):
    for size in (0, 100_000):
        with file_limit(size):
            assert main(["prepare", *prepared(tmp_path / "data", 60)]) == 1
        line = capsys.readouterr().err.splitlines()[-1]
        assert line.startswith(f"error: {tmp_path / 'data' / STORE}: cannot be written: File too large. ")
        assert f" are free on the disk of {tmp_path / 'data'}" in line
        assert list(tmp_path.iterdir()) == []


# Loading processes ----------------------------------------------------------------------------------------------------


def running(pids: list[int]) -> list[int]:
    return [pid for pid in pids if Path(f"/proc/{pid}").exists()]


@pytest.fixture
def training(tmp_path, data_root) -> Iterator[tuple[subprocess.Popen[str], list[int]]]:
    """A run with two loading processes, after its first checkpoint, and the ids of these."""
    line = words(data_root, tmp_path / "run", "data.num_workers=2", "data.resident=false", "trainer.max_steps=1000000")
    process = spawn(["flame_mdm", "train", *line], PYTHONWARNINGS="ignore")  # Lightning's own
    end = time.monotonic() + 60
    while not (tmp_path / "run" / "checkpoints" / LAST).exists():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < end
        time.sleep(0.02)
    workers = [int(pid) for pid in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()]
    yield process, workers
    for pid in running([process.pid, *workers]):
        os.kill(pid, signal.SIGKILL)
    process.communicate()


@pytest.mark.robustness
def test_a_killed_loading_process_is_named_in_one_line(training, tmp_path, data_root):
    process, workers = training
    assert len(workers) >= 2
    os.kill(workers[-1], signal.SIGKILL)
    code, out, err = finish(process)
    assert code == 1
    # Python's own thread that shares files between processes may print one.
    assert err.count("Traceback") <= err.count("resource_sharer.py")
    line = next(line for line in err.splitlines() if line.startswith("error: "))
    assert line.startswith("error: a data loading process ")  # "was killed", unless its silence shows first
    assert "data.num_workers=0" in line
    assert not running(workers), out
    assert not (tmp_path / "run" / "run.lock").exists()
    resumed = newest(tmp_path / "run" / "checkpoints")
    assert resumed is not None
    assert train.main(words(data_root, tmp_path / "run", f"trainer.max_steps={resumed.step + 2}")) == 0


def test_which_second_signal_ends_a_run_at_once(monkeypatch):
    request = StopRequest()
    monkeypatch.setattr("flame_mdm.signals.kill_children", lambda: None)
    for signum in (signal.SIGUSR1, signal.SIGTERM, signal.SIGTERM):
        request.note(signum, None)
    request.time -= 2
    for signum, code in ((signal.SIGTERM, "143"), (signal.SIGINT, "130")):
        with pytest.raises(SystemExit, match=code):
            request.note(signum, None)


def test_torch_messages_about_lost_workers_are_understood(tmp_path, monkeypatch):
    assert lost_worker(RuntimeError("Caught ValueError in DataLoader worker process 0.")) is None
    assert "ended unexpectedly" in str(lost_worker(ConnectionResetError(104, "Connection reset by peer")))
    for message in (
        "DataLoader worker (pid 12) is killed by signal: Killed. ",
        "DataLoader worker (pid(s) 12, 13) exited unexpectedly",
        "DataLoader worker (pid 12) exited unexpectedly with exit code 1. Details",
    ):
        assert str(lost_worker(RuntimeError(message))).startswith("a data loading process was killed")

        def interrupted(*_: object, message: str = message) -> None:
            raise RuntimeError(message)

        monkeypatch.setattr("torch.save", interrupted)
        with pytest.raises(UserError) as caught:
            AtomicCheckpoints(tmp_path).save_checkpoint({"global_step": 1}, tmp_path / LAST)
        assert lost_worker(caught.value) is not None
        assert list(tmp_path.iterdir()) == []


# Kills ----------------------------------------------------------------------------------------------------------------

KILLS = int(os.environ.get("FLAME_MDM_KILLS", "4"))
"""Kills, half of them SIGKILL and half SIGTERM."""


def work(line: list[str], log: Path, signum: int, seconds: float, writing: bool) -> None:
    """Trains in this process until a signal: after some seconds, or while it writes the next checkpoint."""
    save = torch.save

    def half(checkpoint: object, file: io.BufferedWriter) -> None:
        whole = io.BytesIO()
        save(checkpoint, whole)
        file.write(whole.getvalue()[: len(whole.getvalue()) // 2])
        file.flush()
        os.kill(os.getpid(), signum)

    def kill() -> None:
        if writing:
            torch.save = half
        else:
            os.kill(os.getpid(), signum)

    torch.set_num_threads(1)
    with log.open("w") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
        timer = threading.Timer(seconds, kill)
        timer.daemon = True
        if signum:
            timer.start()
        code = train.main(line)
        sys.stdout.flush()
    os._exit(code)


def killed(line: list[str], log: Path, signum: int = 0, seconds: float = 0, writing: bool = False) -> bool:
    """Trains in a process forked from one that has imported everything; returns whether the signal ended it."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["flame_mdm.training.fit"])
    process = context.Process(target=work, args=(line, log, signum, seconds, writing))
    process.start()
    process.join()
    expected = (0, -signum, 128 + signum) if signum else (0,)
    assert process.exitcode in expected, f"exit code {process.exitcode}: {log.read_text()}"
    return process.exitcode != 0


def result(folder: Path) -> Any:
    """What must be the same after kills."""
    content = read_checkpoint(folder / "checkpoints" / LAST)
    states = content["state_dict"], content["current_model_state"]
    return content["global_step"], [{name: x.numpy().tobytes() for name, x in state.items()} for state in states]


@pytest.mark.robustness
def test_kills_at_random_moments_change_nothing(data_root, tmp_path):
    """Of a training; tests/test_evaluate.py kills an evaluation, tests/test_prepare.py interrupts a preparation."""
    log, draw = tmp_path / "log", random.Random(0)

    def line(folder: Path) -> list[str]:
        often = ["trainer.val_check_interval=50", "callbacks.checkpoints.every_n_steps=10"]
        return words(data_root, folder, "denoiser.dropout=0.1", *often, "trainer.max_steps=120")

    whole, folder = tmp_path / "whole", tmp_path / "killed"
    begin = time.monotonic()
    killed(line(whole), log)
    longest = time.monotonic() - begin
    for number in range(KILLS):
        signum = signal.SIGTERM if number % 2 else signal.SIGKILL
        while not killed(line(folder), log, signum, draw.uniform(0, longest), writing=number % 4 == 2):
            shutil.rmtree(folder)  # too late
    killed(line(folder), log)
    assert result(folder) == result(whole)
