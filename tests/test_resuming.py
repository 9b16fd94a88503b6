"""Resuming a run: damaged and foreign checkpoints, other data, bad losses, and one run per directory."""

import copy
import itertools
import json
import multiprocessing
import shutil
import time
from collections.abc import Callable
from contextlib import suppress
from functools import reduce
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
import torch
from support.refusals import one_error
from support.runs import TINY

from flame_mdm.__main__ import main
from flame_mdm.checkpoints.loading import load
from flame_mdm.checkpoints.model_files import FORMAT_KEY, read_checkpoint
from flame_mdm.commands import train
from flame_mdm.data.folder import Folder
from flame_mdm.data.store import Store
from flame_mdm.data.synthetic import Synthetic
from flame_mdm.errors import UserError
from flame_mdm.processes.diffusion import GaussianDiffusion
from flame_mdm.training.checkpointing import LAST, PREVIOUS, AtomicCheckpoints, newest
from flame_mdm.training.guards import only_run

pytestmark = pytest.mark.slow

STORE = "synthetic-humanml-clean-smpl22"
QUICK = ["callbacks.samples=null", "logger=tensorboard", "trainer.val_check_interval=2"]
QUICK += ["callbacks.checkpoints.every_n_steps=2"]


@pytest.fixture(scope="module")
def run(tmp_path_factory, data_root) -> Path:
    """A run of 4 steps with a decaying learning rate, averaged weights and a best checkpoint."""
    folder = tmp_path_factory.mktemp("run")
    assert main(["train", *words(folder, data_root), "trainer.max_steps=4"]) == 0
    return folder


def words(folder: Path, data_root: Path) -> list[str]:
    return [
        "quickstart",
        *TINY,
        *QUICK,
        "lr_decay=0.5",
        f"data_root={data_root}",
        f"run.dir={folder}",
    ]


@pytest.fixture
def resume(run, tmp_path, data_root) -> Callable[..., int]:
    """Resumes a copy of the run, `tmp_path / "run"`, after other content is written to its last checkpoint."""
    folder = tmp_path / "run"
    shutil.copytree(run, folder)
    config = folder / "config.yaml"
    config.write_text(config.read_text().replace(str(run), str(folder)))

    def to_step_6(content: dict[str, Any] | None = None) -> int:
        if content is not None:
            torch.save(content, folder / "checkpoints" / LAST)
        return main(["train", *words(folder, data_root), "trainer.max_steps=6"])

    return to_step_6


@pytest.fixture
def best(run) -> tuple[dict[str, Any], dict[str, Any]]:
    """The content of the last checkpoint, and in it the state of the callback that keeps the best one."""
    content = read_checkpoint(run / "checkpoints" / LAST)
    return content, next(
        state for name, state in content["callbacks"].items() if name.startswith("ModelCheckpoint")
    )


def test_a_foreign_checkpoint_removes_no_other_files(resume, best, tmp_path, subtests):
    content, state = best
    folder, infinite = tmp_path / "run" / "checkpoints", torch.tensor(float("inf"))
    (tmp_path / "victim.txt").write_text("mine")
    for name in ("../../victim.txt", "../checkpoints/../../victim.txt", "link/victim.txt"):
        with subtests.test(name=name):
            if name.startswith("link"):  # a link out of the run is refused before anything is read
                (folder / "link").symlink_to(tmp_path)
            path = f"{folder}/{name}"
            state |= {f"{kind}_model_path": path for kind in ("best", "kth_best", "last")}
            state |= {
                "dirpath": str(folder),
                "best_k_models": {path: infinite},
                "kth_value": infinite,
            }
            assert resume(content) == int(name.startswith("link"))
            assert (tmp_path / "victim.txt").read_text() == "mine"
            assert (folder / "best.ckpt").is_file()


def test_only_files_in_the_folder_of_the_checkpoints_are_removed(tmp_path):
    folder = tmp_path / "run" / "checkpoints"
    (folder / "of_user").mkdir(parents=True)
    files = [folder / "step.ckpt", folder / "of_user" / "step.ckpt", tmp_path / "step.ckpt"]
    for file in files:
        file.write_text("weights")
        AtomicCheckpoints(folder).remove_checkpoint(file)
    assert [file.exists() for file in files] == [False, True, True]


def test_only_the_last_checkpoint_has_a_previous_one(tmp_path):
    folder = tmp_path / "checkpoints"
    writer = AtomicCheckpoints(folder)
    for step, name in enumerate((LAST, "best.ckpt", "best.ckpt", LAST, LAST)):
        writer.save_checkpoint({"global_step": step}, folder / name)
    steps = {path.name: torch.load(path)["global_step"] for path in folder.iterdir()}
    assert steps == {LAST: 4, PREVIOUS: 3, "best.ckpt": 2}


HUGE = torch.zeros(1, dtype=torch.float64).expand(2**31, 16)
JUNK: list[tuple[tuple[Any, ...], Any]] = [
    *((("pytorch-lightning_version",), version) for version in (None, "1.0.0")),
    *(
        (("global_step",), True),
        (("callbacks",), 3),
        (("lr_schedulers",), [3]),
        (("state_dict",), {}),
    ),
    (("loops", "fit_loop", "epoch_progress"), None),
    (("optimizer_states",), [3]),
    (("optimizer_states", 0, "param_groups", 0, "params"), []),
    (("optimizer_states", 0, "state", 0, "exp_avg"), HUGE),
    (("optimizer_states", 0, "param_groups", 0, "lr"), "x"),
    (("optimizer_states", 0, "param_groups", 0, "lr"), float("nan")),
    (("optimizer_states", 0, "param_groups", 0, "betas"), (0.9, "x")),
    (("optimizer_states", 0, "param_groups", 0, "amsgrad"), "x"),
    (("optimizer_states", 0, "param_groups"), ["x"]),
    (("optimizer_states", 0, "state", 0, "exp_avg"), "x"),
    (("optimizer_states", 0, "state", 0), 3),
    (("lr_schedulers", 0, "base_lrs"), ["x"]),
    (("averaging_state",), {"n_averaged": "x"}),
    (("current_model_state",), {"x": torch.zeros(3)}),
]


def test_junk_in_the_state_of_training_is_one_line(resume, best, tmp_path, capsys, subtests):
    (tmp_path / "run" / "checkpoints" / PREVIOUS).unlink()
    config = (tmp_path / "run" / "config.yaml").read_bytes()
    for keys, value in JUNK:
        with subtests.test(keys=keys, value=value):
            changed: Any = copy.deepcopy(best[0])
            *above, last = keys
            reduce(lambda node, key: node[key], above, changed)[last] = value
            capsys.readouterr()
            assert resume(changed) == 1, keys
            assert LAST in one_error(capsys), keys
    assert (tmp_path / "run" / "config.yaml").read_bytes() == config


def test_files_of_version_0_1_are_one_line(best, tmp_path):
    content, file = best[0], tmp_path / "old.ckpt"
    torch.save({key: value for key, value in content.items() if key != FORMAT_KEY}, file)
    with pytest.raises(
        UserError, match=r"old\.ckpt: written by flame_mdm 0\.1, .* Train or import the"
    ):
        load(file)
    torch.save(content | {FORMAT_KEY: 3}, file)
    with pytest.raises(UserError, match="has format 3, but this version reads format 2"):
        load(file)


def test_a_checkpoint_does_not_switch_compilation_on(best, tmp_path, monkeypatch):
    content, _ = best
    content["config"]["task"]["compile"] = True
    torch.save(content, tmp_path / "compiled.ckpt")
    monkeypatch.setattr(torch.nn.Module, "compile", lambda *_, **__: pytest.fail("compiled"))
    assert load(tmp_path / "compiled.ckpt").config["task"]["compile"]


def prepared(root: Path, clips: int, *more: str) -> list[str]:
    return ["data=synthetic", f"data.source.clips={clips}", f"data_root={root}", *more]


def tree(*folders: Path) -> dict[Path, bytes]:
    return {
        path: path.read_bytes()
        for folder in folders
        for path in folder.rglob("*")
        if path.is_file()
    }


def test_a_run_does_not_resume_on_other_data(run, tmp_path, data_root, capsys, monkeypatch):
    """The store changes, and the recipe does not: the same options, but other files or another version of the code."""
    original, root = Synthetic.clips, tmp_path / "data"
    monkeypatch.setattr(Synthetic, "clips", lambda self, fps: list(original(self, fps))[:59])
    assert main(["prepare", *prepared(root, 120)]) == 0
    capsys.readouterr()
    before = tree(run, root)
    assert train.main([*words(run, root), "trainer.max_steps=6"]) == 1
    line = one_error(capsys)
    fingerprints = [Store(folder / STORE).fingerprint for folder in (data_root, root)]
    assert all(part in line for part in (f"{run}/checkpoints/last.ckpt", *fingerprints))
    assert tree(run, root) == before


def test_a_store_of_other_options_is_refused_everywhere(tmp_path, trained, capsys, subtests):
    root, run = tmp_path / "data", tmp_path / "run"
    assert main(["prepare", *prepared(root, 61)]) == 0
    capsys.readouterr()
    before = tree(root)
    message = f"error: {root / STORE}: prepared with clips=61, but the recipe specifies clips=120. Prepare it again"
    for line in (
        ["train", *words(run, root), "trainer.max_steps=2"],
        ["prepare", *prepared(root, 120)],
        ["prepare", *prepared(root, 120, "verify=true")],
        ["browse", *prepared(root, 120, f"out={tmp_path / 'page.html'}")],
        ["evaluate", f"ckpt={trained}", "extractor=none", "quick=true", f"data_root={root}"],
    ):
        with subtests.test(line=line):
            assert main(line) == 1
            assert one_error(capsys).startswith(message)
    assert tree(root) == before
    assert [path.name for path in tmp_path.iterdir()] == ["data"]
    assert main(["prepare", *prepared(root, 120, "force=true")]) == 0
    assert main(["prepare", *prepared(root, 120)]) == 0


def test_options_that_decide_the_data_count_but_paths_do_not():
    source = Folder("here", mirror=True, exclude=("b", "a"))
    assert source.options == {"motion": "joints", "mirror": True, "exclude": ["b", "a"]}
    assert Folder("there", "joints", True, ["b", "a"]).options == source.options
    assert Synthetic(3).options == {"clips": 3, "seed": 0}


def test_a_damaged_checkpoint_gives_way_to_the_one_before(resume, tmp_path, capsys, subtests):
    assert resume() == 0
    folder = tmp_path / "run" / "checkpoints"
    whole = (folder / LAST).read_bytes()
    before = newest(folder)
    assert before is not None
    assert before[:2] == (folder / LAST, 6)
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 1  # in the middle of a weight, where the structure is intact
    for content in (whole[: len(whole) // 2], bytes(flipped), b""):
        with subtests.test(content=content):
            (folder / LAST).write_bytes(content)
            capsys.readouterr()
            assert newest(folder)[:2] == (folder / PREVIOUS, 4)  # type: ignore[index]
            assert f"{folder / LAST}: damaged" in capsys.readouterr().out
    provenance = tmp_path / "run" / "provenance.json"
    provenance.write_text(json.dumps(json.loads(provenance.read_text()) | {"commit": "0" * 40}))
    assert resume() == 0
    assert "resuming with different code: results may differ" in capsys.readouterr().out
    again = read_checkpoint(folder / LAST)
    assert all(
        torch.equal(again["state_dict"][k], v) for k, v in before.content["state_dict"].items()
    )
    for name in (LAST, PREVIOUS):
        (folder / name).write_bytes(b"")
    with pytest.raises(UserError, match="no other checkpoint"):
        newest(folder)
    assert newest(tmp_path / "absent") is None


def break_loss(
    monkeypatch: pytest.MonkeyPatch, step: int, change: Callable[[torch.Tensor], torch.Tensor]
) -> None:
    """Changes the loss terms of a training step."""
    original, count = GaussianDiffusion.loss, itertools.count(1)

    def loss(self, *args, **kwargs):
        terms = original(self, *args, **kwargs)
        is_broken = kwargs.get("t") is None and next(count) == step  # validation gives the times
        return {name: change(value) for name, value in terms.items()} if is_broken else terms

    monkeypatch.setattr(GaussianDiffusion, "loss", loss)


@pytest.mark.parametrize(
    ("factor", "reason"), [(float("nan"), "step 5 is nan"), (1e6, "(typical: ")]
)
def test_a_bad_loss_stops_before_a_checkpoint_is_spoiled(
    tmp_path, data_root, monkeypatch, capsys, factor, reason
):
    break_loss(monkeypatch, 5, lambda value: value * factor)
    assert (
        main(
            [
                "train",
                *words(tmp_path, data_root),
                "trainer.max_steps=8",
                "trainer.log_every_n_steps=2",
            ]
        )
        == 1
    )
    assert reason in one_error(capsys)
    bad = json.loads((tmp_path / "bad_batch.json").read_text())
    assert (bad["step"], bad["batches"][0]["batch"], len(bad["batches"][0]["ids"])) == (5, 4, 8)
    checkpoint = read_checkpoint(tmp_path / "checkpoints" / LAST)
    assert checkpoint["global_step"] == 4
    assert all(
        value.isfinite().all()
        for value in checkpoint["state_dict"].values()
        if value.is_floating_point()
    )


def test_out_of_memory_names_the_step(tmp_path, data_root, monkeypatch, capsys):
    break_loss(monkeypatch, 3, Mock(side_effect=torch.OutOfMemoryError("CUDA out of memory.")))
    assert main(["train", *words(tmp_path, data_root), "trainer.max_steps=5"]) == 1
    assert one_error(capsys).startswith("error: out of memory at step 2. Lower data.batch_size")


def hold(folder: Path, held: Any) -> None:
    with only_run(folder):
        held.set()
        time.sleep(60)


def test_a_second_run_in_the_folder_is_refused_and_a_dead_one_taken_over(tmp_path, capsys):
    (tmp_path / "checkpoints").mkdir()
    for name in (LAST, ".step=0000010.0123abcd-1-0123456789abcdef.ckpt"):
        (tmp_path / "checkpoints" / name).touch()
    context = multiprocessing.get_context("fork")
    held = context.Event()
    other = context.Process(target=hold, args=(tmp_path, held))
    other.start()
    assert held.wait(30)
    with (
        pytest.raises(UserError, match=f"process {other.pid} on .* is training in this dir"),
        only_run(tmp_path),
    ):
        pass
    other.kill()
    other.join()
    with only_run(tmp_path):
        assert [path.name for path in (tmp_path / "checkpoints").iterdir()] == [LAST], (
            "unfinished ones are removed"
        )
    assert f"process {other.pid} on " in capsys.readouterr().out
    assert not (tmp_path / "run.lock").exists()


@pytest.mark.parametrize("content", [None, "notes.txt", "config.yaml"])
def test_a_folder_that_was_there_before_a_failed_start_is_kept(tmp_path, content):
    """A new folder without a configuration contains only the files of loggers."""
    folder = tmp_path / "run"
    if content == "notes.txt":
        folder.mkdir()
        (folder / content).touch()
    with suppress(ZeroDivisionError), only_run(folder):
        (folder / (content or "metrics.jsonl")).touch()
        raise ZeroDivisionError
    assert folder.exists() == bool(content)
    assert not content or [path.name for path in folder.iterdir()] == [content]
