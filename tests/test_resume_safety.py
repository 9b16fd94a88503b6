"""Resuming on other data, stores of other options, full disks, and loading processes that die or stop."""

import hashlib
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from support.runs import TINY

from flame_mdm.commands import browse, evaluate, prepare, train
from flame_mdm.conditions.text import CaptionCache
from flame_mdm.data.folder import Folder
from flame_mdm.data.store import Store, write_store
from flame_mdm.data.synthetic import Synthetic
from flame_mdm.errors import UserError
from flame_mdm.representations.humanml import HumanML
from flame_mdm.signals import StopRequest
from flame_mdm.training.checkpointing import AtomicCheckpoints, newest
from flame_mdm.training.guards import lost_worker

pytestmark = pytest.mark.slow

STORE = "synthetic-humanml-clean-smpl22"
QUIET = ["callbacks.samples=null", "callbacks.best=null", "logger=csv", "callbacks.checkpoints.every_n_steps=2"]


def words(root: Path, run: Path, *more: str) -> list[str]:
    return ["quickstart", *TINY, *QUIET, f"data_root={root}", f"run.dir={run}", *more]


def prepared(root: Path, clips: int, *more: str) -> list[str]:
    return ["data=synthetic", f"data.source.clips={clips}", f"data_root={root}", *more]


def error(capsys: pytest.CaptureFixture[str]) -> str:
    """The one line of the error."""
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ")
    return line


def tree(*folders: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for folder in folders for path in folder.rglob("*") if path.is_file()}


# Data -----------------------------------------------------------------------------------------------------------------


def test_a_run_does_not_resume_on_other_data(tmp_path, data_root, capsys, monkeypatch):
    """The store changes, and the recipe does not: the same options, but other files or another version of the code."""
    root, run = tmp_path / "data", tmp_path / "run"
    assert train.main(words(data_root, run, "trainer.max_steps=2")) == 0
    first = Store(data_root / STORE).fingerprint
    monkeypatch.setattr(Synthetic, "count", lambda self: 60)
    original = Synthetic.clips
    monkeypatch.setattr(Synthetic, "clips", lambda self, fps: list(original(self, fps))[:59])
    assert prepare.main(prepared(root, 60)) == 0
    capsys.readouterr()
    before = tree(run, root)
    assert train.main(words(root, run, "trainer.max_steps=4")) == 1
    line = error(capsys)
    assert f"{run}/checkpoints/last.ckpt" in line
    assert first in line
    assert Store(root / STORE).fingerprint in line
    assert "run.name=..." in line
    assert tree(run, root) == before
    assert train.main(words(data_root, run, "trainer.max_steps=4")) == 0


def test_a_store_of_other_options_is_refused_everywhere(tmp_path, data_root, trained, capsys):
    root, run = tmp_path / "data", tmp_path / "run"
    assert prepare.main(prepared(root, 61)) == 0
    capsys.readouterr()
    before = tree(root)
    says = f"error: {root / STORE}: prepared with clips=61, but the recipe has clips=60. Prepare it again with force"
    commands: list[tuple[Callable[[list[str]], int], list[str]]] = [
        (train.main, words(root, run, "trainer.max_steps=2")),
        (prepare.main, prepared(root, 60)),
        (prepare.main, prepared(root, 60, "verify=true")),
        (browse.main, prepared(root, 60, f"out={tmp_path / 'page.html'}")),
        (evaluate.main, [f"ckpt={trained}", "extractor=none", "quick=true", f"data_root={root}"]),
    ]
    for main, line in commands:
        assert main(line) == 1
        assert error(capsys).startswith(says)
    assert not run.exists()
    assert tree(root) == before
    assert [path.name for path in tmp_path.iterdir()] == ["data"]
    assert prepare.main(prepared(root, 60, "force=true")) == 0
    assert prepare.main(prepared(root, 60)) == 0


def test_all_options_but_places_count(tmp_path):
    source = Folder("here", mirror=True, exclude=("b", "a"))
    assert source.options == {"motion": "joints", "mirror": True, "exclude": ["b", "a"]}
    assert Folder("there", "joints", True, ["b", "a"]).options == source.options
    assert Synthetic(3).options == {"clips": 3, "seed": 0, "min_seconds": 2.0, "max_seconds": 3.0}


ODD_STORES = [
    ("store.json", lambda info: info.pop("shape") and info),
    ("store.json", lambda info: info | {"sha256": []}),
    ("store.json", lambda info: info | {"source": [1]}),
    ("store.json", lambda info: info | {"clips": None}),
    ("clips.jsonl", lambda clip: clip | {"unknown": 1}),
    ("clips.jsonl", lambda clip: clip | {"start": 10**9}),
    ("clips.jsonl", lambda clip: clip | {"length": "x"}),
    ("clips.jsonl", lambda clip: clip | {"split": "x"}),
    ("clips.jsonl", lambda clip: [clip]),
]


def test_stores_with_odd_values_are_refused(attacked, tmp_path, data_root):
    folder = tmp_path / STORE
    for name, change in ODD_STORES:
        shutil.copytree(data_root / STORE, folder, dirs_exist_ok=True)
        first, *rest = (folder / name).read_text().splitlines(keepends=True)
        if name == "store.json":
            (folder / name).write_text(json.dumps(change(json.loads("".join([first, *rest])))))
        else:
            (folder / name).write_text("".join([json.dumps(change(json.loads(first))) + "\n", *rest]))
            info = json.loads((folder / "store.json").read_text())
            info["sha256"][name] = hashlib.sha256((folder / name).read_bytes()).hexdigest()
            (folder / "store.json").write_text(json.dumps(info))
        attacked("browse", *prepared(tmp_path, 60), says=f"{folder / name}: damaged: ")


def test_refused_training_leaves_nothing(attacked, tmp_path, data_root):
    attacked.seconds = 20
    line = [word for word in words(data_root, tmp_path / "runs" / "a", "trainer.max_steps=1") if "logger" not in word]
    for word, says in {
        "data.crop.min_frames=400 data.crop.max_frames=500": "or more",
        "task.sampler=none": "unknown sampler",
        "optimizer.lr=-1": "learning rate",
    }.items():
        attacked("train", *line, *word.split(), says=says)
    assert not (tmp_path / "runs").exists()


# Full disks -----------------------------------------------------------------------------------------------------------


@pytest.fixture
def file_limit() -> Iterator[Callable[[int], None]]:
    """Sets the size that files may have; writing more fails as on a full disk."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield lambda size: resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    resource.setrlimit(resource.RLIMIT_FSIZE, limits)


@pytest.mark.parametrize("size", [0, 100_000])
def test_a_preparation_without_room_leaves_nothing(tmp_path, capsys, file_limit, size):
    file_limit(size)
    assert prepare.main(prepared(tmp_path / "data", 60)) == 1
    line = capsys.readouterr().err.splitlines()[-1]
    assert line.startswith(f"error: {tmp_path / 'data' / STORE / 'features.npy'}: cannot be written: File too large. ")
    assert f" are free on the disk of {tmp_path / 'data'}" in line
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

    def preparation(clips: int) -> subprocess.CompletedProcess[str]:
        line = [sys.executable, "-m", "flame_mdm", "prepare", *prepared(small_disk / "data", clips)]
        return subprocess.run(line, capture_output=True, text=True, check=False)

    done = preparation(25)
    assert done.returncode == 0, "the disk has room for the data once"
    shutil.rmtree(small_disk / "data")
    done = preparation(100)
    assert done.returncode == 1, done
    line = done.stderr.splitlines()[-1]
    assert line.startswith(f"error: {small_disk / 'data' / STORE / 'features.npy'}: cannot be written: No space left")
    assert " are free on the disk of " in line
    assert list(small_disk.iterdir()) == []


def test_the_packed_array_is_the_one_that_numpy_writes(tmp_path):
    store = write_store(tmp_path / "store", Synthetic(clips=3), HumanML())
    packed = np.array(store.features)
    array = np.lib.format.open_memmap(tmp_path / "other.npy", "w+", packed.dtype, packed.shape)
    array[:] = packed
    array.flush()
    assert (tmp_path / "store" / "features.npy").read_bytes() == (tmp_path / "other.npy").read_bytes()


def test_a_cache_of_captions_without_room_leaves_nothing(tmp_path, file_limit):
    encoded = [(np.zeros(384), np.zeros((4, 384)))] * 100
    file_limit(10_000)
    with pytest.raises(UserError, match=r"text/model: cannot be written: File too large\. .* are free on the disk of"):
        CaptionCache.write(tmp_path / "text" / "model", [str(n) for n in range(100)], encoded, 384)
    assert list(tmp_path.iterdir()) == []


# Loading processes ----------------------------------------------------------------------------------------------------


@pytest.fixture
def training(tmp_path, data_root) -> Iterator[tuple[subprocess.Popen[str], list[int]]]:
    """A run with two loading processes, after its first checkpoint, and the ids of these."""
    line = words(data_root, tmp_path / "run", "data.num_workers=2", "data.resident=false", "trainer.max_steps=1000000")
    process = subprocess.Popen(
        [sys.executable, "-m", "flame_mdm", "train", *line],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONWARNINGS": "ignore"},  # Lightning's own
    )
    end = time.monotonic() + 60
    while not (tmp_path / "run" / "checkpoints" / "last.ckpt").exists():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < end
        time.sleep(0.02)
    workers = [int(pid) for pid in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()]
    yield process, workers
    for pid in (process.pid, *workers):
        if Path(f"/proc/{pid}").exists():
            os.kill(pid, signal.SIGKILL)
    process.communicate()


def running(pids: list[int]) -> list[int]:
    return [pid for pid in pids if Path(f"/proc/{pid}").exists()]


@pytest.mark.robustness
def test_a_killed_loading_process_is_named_in_one_line(training, tmp_path, data_root):
    process, workers = training
    assert len(workers) >= 2
    os.kill(workers[-1], signal.SIGKILL)
    out, err = process.communicate(timeout=30)
    assert process.returncode == 1
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


@pytest.mark.parametrize(
    ("message", "how"),
    [
        ("DataLoader worker (pid 12) is killed by signal: Killed. ", "was killed (signal: Killed), as happens"),
        ("DataLoader worker (pid(s) 12, 13) exited unexpectedly", "ended unexpectedly"),
        ("DataLoader worker (pid 12) exited unexpectedly with exit code 1. Details", "ended unexpectedly"),
    ],
)
def test_what_torch_says_of_lost_workers_is_understood(tmp_path, monkeypatch, message, how):
    assert f"error: a data loading process {how}" in f"error: {lost_worker(RuntimeError(message))}"
    assert lost_worker(RuntimeError("Caught ValueError in DataLoader worker process 0.")) is None
    assert "ended unexpectedly" in str(lost_worker(ConnectionResetError(104, "Connection reset by peer")))

    def interrupted(*_: object) -> None:
        raise RuntimeError(message)

    monkeypatch.setattr("torch.save", interrupted)
    with pytest.raises(UserError) as caught:
        AtomicCheckpoints(tmp_path).save_checkpoint({"global_step": 1}, tmp_path / "last.ckpt")
    assert how in str(lost_worker(caught.value))
    assert list(tmp_path.iterdir()) == []


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
    out, err = process.communicate(timeout=10)
    assert process.returncode == 143, err
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
