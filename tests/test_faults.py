"""Full disks, loading processes that die or stop, kills at random moments; what the start of a command imports."""

import io
import json
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
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from support.runs import TINY, finish, spawn

from flame_mdm.checkpoints.model_files import read_checkpoint
from flame_mdm.commands import prepare, train
from flame_mdm.conditions.text import CaptionCache
from flame_mdm.data.store import Store, write_store
from flame_mdm.data.synthetic import Synthetic
from flame_mdm.errors import UserError
from flame_mdm.representations.humanml import HumanML
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
            assert prepare.main(prepared(tmp_path / "data", 60)) == 1
        line = capsys.readouterr().err.splitlines()[-1]
        file = tmp_path / "data" / STORE / "features.npy"
        assert line.startswith(f"error: {file}: cannot be written: File too large. ")
        assert f" are free on the disk of {tmp_path / 'data'}" in line
        assert list(tmp_path.iterdir()) == []


def test_a_cache_of_captions_without_room_leaves_nothing(tmp_path):
    encoded = [(np.zeros(384), np.zeros((4, 384)))] * 100
    message = r"text/model: cannot be written: File too large\. .* are free on the disk of"
    with file_limit(10_000), pytest.raises(UserError, match=message):
        CaptionCache.write(tmp_path / "text" / "model", [str(n) for n in range(100)], encoded, 384)
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def small_disk(tmp_path) -> Iterator[Path]:
    """A disk of 2 MiB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=2m", "tmpfs", str(folder)]
    if shutil.which("mount") is None or subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("mounting is not permitted here")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


@pytest.mark.robustness
def test_a_full_disk_ends_a_preparation_in_one_line(small_disk):
    """In a process of its own: one that writes through a memory map is killed (SIGBUS)."""
    code, _, err = finish(spawn(["flame_mdm", "prepare", *prepared(small_disk / "data", 25)]))
    assert code == 0, f"the disk has room for the data once: {err}"
    shutil.rmtree(small_disk / "data")
    code, _, err = finish(spawn(["flame_mdm", "prepare", *prepared(small_disk / "data", 100)]))
    assert code == 1, err
    line = err.splitlines()[-1]
    assert line.startswith(f"error: {small_disk / 'data' / STORE / 'features.npy'}: cannot be written: No space left")
    assert " are free on the disk of " in line
    assert list(small_disk.iterdir()) == []


def test_the_packed_array_is_the_one_that_numpy_writes(tmp_path):
    store = write_store(tmp_path / "store", Synthetic(clips=3), HumanML())
    np.save(tmp_path / "other.npy", np.array(store.features))
    assert (tmp_path / "store" / "features.npy").read_bytes() == (tmp_path / "other.npy").read_bytes()


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


@pytest.mark.robustness
def test_a_second_sigterm_ends_a_run_whose_loading_processes_hang(training):
    process, workers = training
    for pid in workers:
        os.kill(pid, signal.SIGSTOP)
    time.sleep(0.5)  # the batches that are loaded already are used up
    for _ in range(2):  # `timeout` sends two together, which is one request
        process.send_signal(signal.SIGTERM)
    time.sleep(1.2)
    assert process.poll() is None
    process.send_signal(signal.SIGTERM)
    code, out, err = finish(process)
    assert code == 143, err
    assert "Traceback" not in err
    assert "press Ctrl-C or send SIGTERM again to stop immediately" in out
    assert "stopped immediately. Run the same command to resume" in out
    assert not running(workers)


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
    for message, how in (
        ("DataLoader worker (pid 12) is killed by signal: Killed. ", "was killed (signal: Killed), as happens"),
        ("DataLoader worker (pid(s) 12, 13) exited unexpectedly", "ended unexpectedly"),
        ("DataLoader worker (pid 12) exited unexpectedly with exit code 1. Details", "ended unexpectedly"),
    ):
        assert str(lost_worker(RuntimeError(message))).startswith(f"a data loading process {how}")

        def interrupted(*_: object, message: str = message) -> None:
            raise RuntimeError(message)

        monkeypatch.setattr("torch.save", interrupted)
        with pytest.raises(UserError) as caught:
            AtomicCheckpoints(tmp_path).save_checkpoint({"global_step": 1}, tmp_path / LAST)
        assert how in str(lost_worker(caught.value))
        assert list(tmp_path.iterdir()) == []


# Kills ----------------------------------------------------------------------------------------------------------------

KILLS = int(os.environ.get("FLAME_MDM_KILLS", "4"))
"""Kills of each command, half of them SIGKILL and half SIGTERM."""


def work(command: str, line: list[str], log: Path, signum: int, seconds: float, writing: bool) -> None:
    """Runs a command in this process until a signal: after some seconds, or while it writes the next checkpoint."""
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
        code = import_module(f"flame_mdm.commands.{command}").main(line)
        sys.stdout.flush()
    os._exit(code)


def killed(*arguments: Any, log: Path, signum: int = 0, seconds: float = 0, writing: bool = False) -> bool:
    """Runs a command in a process forked from one that has imported everything; returns whether the signal ended it."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["flame_mdm.training.fit", "evaluators.evaluation"])
    process = context.Process(target=work, args=(*arguments, log, signum, seconds, writing))
    process.start()
    process.join()
    expected = (0, -signum, 128 + signum) if signum else (0,)
    assert process.exitcode in expected, f"exit code {process.exitcode}: {log.read_text()}"
    return process.exitcode != 0


def result(command: str, folder: Path) -> Any:
    """What must be the same after kills: weights, data, values."""
    if command == "prepare":
        return Store(folder / STORE).info, [path.name for path in folder.iterdir()]
    if command == "train":
        content = read_checkpoint(folder / "checkpoints" / LAST)
        states = content["state_dict"], content["current_model_state"]
        return content["global_step"], [{name: x.numpy().tobytes() for name, x in state.items()} for state in states]
    report = json.loads((folder / "result.json").read_text())
    report["checkpoint"].pop("path")
    for key in ("command", "commit", "changed"):  # the code may be edited meanwhile
        report["environment"].pop(key)
    report["cost"].pop("seconds_per_sample")
    return report


@pytest.mark.robustness
@pytest.mark.parametrize("command", ["train", "prepare", "evaluate"])
def test_kills_at_random_moments_change_nothing(command, trained, data_root, tmp_path):
    log, draw = tmp_path / "log", random.Random(0)

    def line(folder: Path) -> list[str]:
        if command == "prepare":
            return prepared(folder, 150)
        if command == "train":
            often = ["trainer.val_check_interval=50", "callbacks.checkpoints.every_n_steps=10"]
            return words(data_root, folder, "denoiser.dropout=0.1", *often, "trainer.max_steps=120")
        folder.mkdir(exist_ok=True)
        shutil.copy(trained, folder)
        options = [
            "protocol=synthetic",
            "extractor=none",
            "replications=3",
            "split=train",
            "batch_size=4",
            "samples=16",
        ]
        return [f"ckpt={folder / LAST}", *options, f"data_root={data_root}", f"out={folder / 'result.json'}"]

    whole, folder = tmp_path / "whole", tmp_path / "killed"
    begin = time.monotonic()
    killed(command, line(whole), log=log)
    longest = time.monotonic() - begin
    for number in range(KILLS):
        signum, writing = signal.SIGTERM if number % 2 else signal.SIGKILL, command == "train" and number % 4 == 2
        while not killed(
            command, line(folder), log=log, signum=signum, seconds=draw.uniform(0, longest), writing=writing
        ):
            shutil.rmtree(folder)  # too late
        left = sorted(path.name for path in folder.rglob("*")) if folder.exists() else []
        print(f"{command} {number + 1}: {signal.Signals(signum).name}{', writing' * writing} leaves {left}")
        assert STORE not in left or Store(folder / STORE).info == result(command, whole)[0], "not complete"
    killed(command, line(folder), log=log)
    assert result(command, folder) == result(command, whole)


def test_help_and_misspelled_keys_do_not_wait_for_torch(tmp_path):
    code = """
import sys
from importlib import import_module
def run(command, words):
    try:
        return import_module(f"flame_mdm.commands.{command}").main(words)
    except SystemExit as stop:
        return stop.code
for command in "train sample edit evaluate prepare browse convert export".split():
    assert run(command, ["--help"]) == 0, command
    assert run(command, (["quickstart"] if command == "train" else []) + ["seeed=1"]) in (1, 2), command
    assert not {"torch", "lightning", "transformers", "scipy"} & set(sys.modules), command
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path, check=False)
    assert done.returncode == 0, done.stderr
