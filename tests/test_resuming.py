"""Resuming a run: damaged and foreign checkpoints, full disks, bad losses, and one run per directory."""

import copy
import json
import os
import resource
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning import Trainer
from support.runs import TINY

from flame_mdm.__main__ import main
from flame_mdm.checkpoints.loading import load
from flame_mdm.checkpoints.model_files import FORMAT_KEY, read_checkpoint
from flame_mdm.config import instantiate
from flame_mdm.errors import UserError
from flame_mdm.processes.diffusion import GaussianDiffusion
from flame_mdm.task import MotionGeneration
from flame_mdm.training.averaging import MovingAverage
from flame_mdm.training.checkpointing import (
    LAST,
    PREVIOUS,
    AtomicCheckpoints,
    Resumed,
    check_training_state,
    directly_in,
    newest,
)
from flame_mdm.training.guards import only_run

pytestmark = pytest.mark.slow

QUICK = [
    "callbacks.samples=null",
    "logger=tensorboard",
    "callbacks.checkpoints.every_n_steps=2",
    "trainer.val_check_interval=2",
]


@pytest.fixture(scope="module")
def run(tmp_path_factory, data_root) -> Path:
    """A run of 4 steps with a decaying learning rate, averaged weights and a best checkpoint."""
    folder = tmp_path_factory.mktemp("run")
    assert main(["train", *words(folder, data_root), "trainer.max_steps=4"]) == 0
    return folder


def words(folder: Path, data_root: Path) -> list[str]:
    return ["quickstart", *TINY, *QUICK, "lr_decay=0.5", f"data_root={data_root}", f"run.dir={folder}"]


@pytest.fixture
def resume(run, tmp_path, data_root) -> Callable[..., int]:
    """Resumes a copy of the run in `tmp_path / "run"`, of whose last checkpoint other content was written."""

    def to_step_6(content: dict[str, Any] | None = None, *more: str) -> int:
        folder = tmp_path / "run"
        if not folder.exists():
            subprocess.run(["cp", "-r", run, folder], check=True)
            config = folder / "config.yaml"
            config.write_text(config.read_text().replace(str(run), str(folder)))
        if content is not None:
            torch.save(content, folder / "checkpoints" / LAST)
        return main(["train", *words(folder, data_root), "trainer.max_steps=6", *more])

    return to_step_6


def one_error(capsys: pytest.CaptureFixture[str]) -> str:
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ")
    return line


# Foreign checkpoints --------------------------------------------------------------------------------------------------


@pytest.fixture
def best(run) -> tuple[dict[str, Any], dict[str, Any]]:
    """The content of the last checkpoint, and in it the state of the callback that keeps the best one."""
    content = read_checkpoint(run / "checkpoints" / LAST)
    return content, next(state for name, state in content["callbacks"].items() if name.startswith("ModelCheckpoint"))


@pytest.mark.parametrize("name", ["../../victim", "../../victim.txt", "../checkpoints/../../victim", "link/victim.txt"])
def test_a_foreign_checkpoint_removes_no_other_files(resume, best, tmp_path, name):
    content, state = best
    folder, infinite = tmp_path / "run" / "checkpoints", torch.tensor(float("inf"))
    (tmp_path / "victim").mkdir()
    for file in (tmp_path / "victim" / "file.txt", tmp_path / "victim.txt"):
        file.write_text("mine")
    path = f"{folder}/{name}"
    state |= {f"{kind}_model_path": path for kind in ("best", "kth_best", "last")}
    state |= {"dirpath": str(folder), "best_k_models": {path: infinite}, "kth_value": infinite}
    assert resume() == 0
    (folder / "link").symlink_to(tmp_path)
    assert resume(content, "trainer.max_steps=8") == 0
    assert (tmp_path / "victim" / "file.txt").read_text() == (tmp_path / "victim.txt").read_text() == "mine"
    assert (folder / "best.ckpt").is_file()


def test_only_files_directly_in_the_folder_are_removed(tmp_path):
    folder, io = tmp_path / "checkpoints", AtomicCheckpoints(tmp_path / "checkpoints")
    for name in ("a.ckpt", "below/b.ckpt"):
        (folder / name).parent.mkdir(exist_ok=True, parents=True)
        (folder / name).touch()
    (tmp_path / "c.ckpt").touch()
    for name in ("a.ckpt", "below", "below/b.ckpt", "..", ".", "../c.ckpt", "below/../../c.ckpt", "\0"):
        io.remove_checkpoint(f"{folder}/{name}")
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["b.ckpt", "below", "c.ckpt", "checkpoints"]
    assert directly_in(folder, folder / "below" / ".." / "new.ckpt")


LOOP = ("loops", "fit_loop")
JUNK: list[tuple[tuple[Any, ...], list[Any]]] = [
    (("pytorch-lightning_version",), [None, "x", "1.0.0", 3]),
    (("loops",), [None, 3, {}, {"fit_loop": 3}, {"fit_loop": {}}]),
    ((*LOOP, "epoch_progress"), [None, {"total": 3, "current": {}}]),
    ((*LOOP, "epoch_progress", "current", "ready"), ["x", None, -1, True, 1.5, 10**30]),
    ((*LOOP, "epoch_loop.batch_progress", "is_last_batch"), ["x", 1]),
    ((*LOOP, "epoch_loop.state_dict"), [{}, {"_batches_that_stepped": "x"}]),
    (("callbacks",), [None, 3, [], {"x": 3}]),
    (("callbacks", "best"), [3, {"best_model_path": ""}]),
    (("callbacks", "best", "best_model_path"), [None, 3, []]),
    (("callbacks", "best", "best_k_models"), [None, 3, {3: torch.tensor(0.0)}, {"a": "x"}]),
    (("callbacks", "best", "best_model_score"), ["x", torch.zeros(2)]),
    (("callbacks", "MovingAverage"), [3, {"latest_update_step": "x"}, {"x": 3}]),
    (("optimizer_states",), [None, 3, [], [3], [{}], [{"state": {}, "param_groups": 3}]]),
    (("optimizer_states", 0, "state"), [None, {"x": {}}, {10**6: {}}, {0: 3}]),
    (("optimizer_states", 0, "state", 0), [{}, {"exp_avg": torch.zeros(7, 7, 7)}]),
    (("optimizer_states", 0, "state", 0, "exp_avg"), [torch.zeros(7, 7, 7), "x", torch.zeros(33, 16).long()]),
    (("optimizer_states", 0, "state", 0, "step"), ["x", torch.zeros(3)]),
    (("optimizer_states", 0, "param_groups", 0, "lr"), ["x", None, [], float("nan"), float("inf")]),
    (("optimizer_states", 0, "param_groups", 0, "betas"), ["x", (0.9,), (0.9, "x"), (2.0, 3.0)]),
    (("optimizer_states", 0, "param_groups", 0, "params"), [[], [0] * 3, "x"]),
    (("optimizer_states", 0, "param_groups", 0, "capturable"), [True, "x"]),
    (("lr_schedulers",), [None, 3, [], [3], [{}]]),
    (("lr_schedulers", 0, "last_epoch"), ["x", None]),
    (("lr_schedulers", 0, "base_lrs"), ["x", [], ["x"]]),
    (("lr_schedulers", 0, "step"), [3]),
    (("averaging_state",), [None, 3, {}, {"n_averaged": "x"}, {"n_averaged": torch.zeros(3)}]),
    (("current_model_state",), [None, 3, {}, {"x": torch.zeros(3)}]),
    (("state_dict",), [{}, {"x": torch.zeros(3)}]),
]  # fmt: skip


def test_junk_in_the_state_of_training_is_named(run, best):
    content, state = best
    task, trainer = parts(content["config"])
    names = {"best": next(key for key, value in content["callbacks"].items() if value is state)}

    def check(content: dict[str, Any]) -> None:
        check_training_state(Resumed(run / "checkpoints" / LAST, 4, content), task, trainer)

    check(content)
    assert state["best_model_path"], "paths of the run itself are kept"
    accepted = []
    for keys, values in JUNK:
        for value in values:
            changed: Any = copy.deepcopy(content)
            *above, last = (names.get(key, key) for key in keys)
            node = changed
            for key in above:
                node = node[key]
            node[last] = value
            try:
                check(changed)
            except UserError as error:
                one_line = str(error).startswith(f"{run}/checkpoints/{LAST}: damaged: ") and "\n" not in str(error)
                accepted += [] if one_line else [error]
            else:
                accepted.append((keys, value))
    assert not accepted


def parts(config: dict[str, Any]) -> tuple[MotionGeneration, Trainer]:
    """The task of a recipe, and a trainer with its callbacks that have a state."""
    task = MotionGeneration.build(config, instantiate(config["representation"]))
    callbacks = [MovingAverage(**config["ema"]), instantiate(config["callbacks"]["best"])]
    options = {"logger": False, "callbacks": callbacks, "enable_model_summary": False, "enable_progress_bar": False}
    return task, instantiate(config["trainer"] | {"max_steps": 6}, **options)


def test_junk_is_one_line_of_the_command(resume, best, capsys, tmp_path):
    content, _ = best
    for key, value in (("loops", None), ("global_step", "x"), ("optimizer_states", [3])):
        capsys.readouterr()
        assert resume(content | {key: value}) == 1
        assert f"{LAST}: damaged: " in one_error(capsys)
        (tmp_path / "run" / "checkpoints" / PREVIOUS).unlink(missing_ok=True)


def test_files_of_version_0_1_are_one_line(resume, best, run, tmp_path, capsys):
    content, _ = best
    old = {key: value for key, value in content.items() if key != FORMAT_KEY}
    torch.save(old, tmp_path / "old.ckpt")
    with pytest.raises(UserError, match=r"old\.ckpt: written by version 0\.1 of flame_mdm, .* Train or import the"):
        load(tmp_path / "old.ckpt")
    torch.save(content | {FORMAT_KEY: 3}, tmp_path / "new.ckpt")
    with pytest.raises(UserError, match="has format 3, but this version reads 2"):
        load(tmp_path / "new.ckpt")


def test_a_checkpoint_does_not_switch_compilation_on(best, tmp_path, monkeypatch):
    content, _ = best
    content["config"]["task"]["compile"] = True
    torch.save(content, tmp_path / "compiled.ckpt")
    monkeypatch.setattr(torch.nn.Module, "compile", lambda *_, **__: pytest.fail("compiled"))
    assert load(tmp_path / "compiled.ckpt").config["task"]["compile"]


def test_other_code_and_other_seeds_are_named(resume, tmp_path, capsys):
    assert resume(None, "trainer.max_steps=4") == 0  # copies the run
    path = tmp_path / "run" / "provenance.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"commit": "0" * 40}))
    capsys.readouterr()
    assert resume(None, "seed=5") == 1
    assert "seed (0 there, 5 here)" in one_error(capsys)
    assert resume() == 0
    assert "resuming with different code: results may differ" in capsys.readouterr().out


# Damage, full disks, bad losses ---------------------------------------------------------------------------------------


def test_a_damaged_checkpoint_gives_way_to_the_one_before(resume, tmp_path, capsys):
    assert resume() == 0
    folder = tmp_path / "run" / "checkpoints"
    whole = (folder / LAST).read_bytes()
    before = newest(folder)
    assert before is not None
    assert (before.path, before.step) == (folder / LAST, 6)
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 1  # in the middle of a weight, where the structure is intact
    for content in (whole[: len(whole) // 2], bytes(flipped), b""):
        (folder / LAST).write_bytes(content)
        capsys.readouterr()
        assert newest(folder)[:2] == (folder / PREVIOUS, 4)  # type: ignore[index]
        assert f"{folder / LAST}: damaged" in capsys.readouterr().out
    assert resume() == 0
    again = read_checkpoint(folder / LAST)
    assert all(torch.equal(again["state_dict"][k], v) for k, v in before.content["state_dict"].items())
    for name in (LAST, PREVIOUS):
        (folder / name).write_bytes(b"")
    with pytest.raises(UserError, match="no other checkpoint"):
        newest(folder)
    assert newest(tmp_path / "absent") is None


@pytest.fixture
def file_limit() -> Iterator[Callable[[int], None]]:
    """Sets the maximum size of files; writing more fails as on a full disk."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield lambda size: resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def test_a_full_disk_leaves_the_checkpoint_before(tmp_path, file_limit):
    io = AtomicCheckpoints(tmp_path)
    io.save_checkpoint({"global_step": 1, "config": {}, "facts": {}, "state_dict": {}}, tmp_path / LAST)
    before = (tmp_path / LAST).read_bytes()
    file_limit(100_000)
    with pytest.raises(UserError, match=r"last\.ckpt: the checkpoint of step 2 cannot be written .*File too large"):
        io.save_checkpoint({"global_step": 2, "state_dict": {"a": torch.zeros(100_000)}}, tmp_path / LAST)
    assert [path.name for path in tmp_path.iterdir()] == [LAST]
    assert (tmp_path / LAST).read_bytes() == before


def break_loss(monkeypatch: pytest.MonkeyPatch, step: int, change: Callable[[torch.Tensor], torch.Tensor]) -> None:
    """Changes the loss terms of a training step."""
    original, count = GaussianDiffusion.loss, [0]

    def loss(self, *args, **kwargs):
        count[0] += kwargs.get("t") is None  # not in validation
        terms = original(self, *args, **kwargs)
        return {name: change(value) for name, value in terms.items()} if count[0] == step else terms

    monkeypatch.setattr(GaussianDiffusion, "loss", loss)


@pytest.mark.parametrize(
    ("change", "reason"), [(lambda v: v * float("nan"), "is nan"), (lambda v: v * 1e6, "(typical: ")]
)
def test_a_bad_loss_stops_before_a_checkpoint_is_spoiled(tmp_path, data_root, monkeypatch, capsys, change, reason):
    break_loss(monkeypatch, 5, change)
    assert main(["train", *words(tmp_path, data_root), "trainer.max_steps=8", "trainer.log_every_n_steps=2"]) == 1
    message = one_error(capsys)
    assert "the loss of step 5 " in message
    assert reason in message
    bad = json.loads((tmp_path / "bad_batch.json").read_text())
    assert (bad["step"], bad["batches"][0]["batch"], len(bad["batches"][0]["ids"])) == (5, 4, 8)
    checkpoint = read_checkpoint(tmp_path / "checkpoints" / LAST)
    assert checkpoint["global_step"] == 4
    assert all(value.isfinite().all() for value in checkpoint["state_dict"].values() if value.is_floating_point())


def test_out_of_memory_names_the_batch(tmp_path, data_root, monkeypatch, capsys):
    def fail(value: torch.Tensor) -> torch.Tensor:
        raise torch.OutOfMemoryError("CUDA out of memory.")

    break_loss(monkeypatch, 3, fail)
    assert main(["train", *words(tmp_path, data_root), "trainer.max_steps=5"]) == 1
    message = one_error(capsys)
    assert message.startswith("error: out of memory at step 2 with a batch of 8 clips, ")
    assert "263 features. Lower data.batch_size" in message


# One run per directory ------------------------------------------------------------------------------------------------

HOLD = """
import sys, pathlib
from flame_mdm.training.guards import only_run
with only_run(pathlib.Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


def test_a_second_run_in_the_folder_is_refused_and_a_dead_one_taken_over(tmp_path, capsys):
    (tmp_path / "checkpoints").mkdir()
    for name in (LAST, "step=0000010.partial"):
        (tmp_path / "checkpoints" / name).touch()
    command = [sys.executable, "-c", HOLD, str(tmp_path)]
    pipe, environment = subprocess.PIPE, {**os.environ, "OMP_NUM_THREADS": "1"}
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, env=environment) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"
        with (
            pytest.raises(UserError, match=f"process {other.pid} on .* is training in this directory"),
            only_run(tmp_path),
        ):
            pass
        other.kill()
    with only_run(tmp_path):
        assert [path.name for path in (tmp_path / "checkpoints").iterdir()] == [LAST], "unfinished ones are removed"
    assert f"process {other.pid} on " in capsys.readouterr().out
    assert not (tmp_path / "run.lock").exists()


def test_the_lock_ends_with_an_error(tmp_path):
    with pytest.raises(ValueError, match="inside"), only_run(tmp_path / "new"):
        raise ValueError("inside")
    assert list(tmp_path.iterdir()) == []
