"""Two real processes train what one would; that they cannot start is a failure."""

import csv
import os
import re
import sys
from functools import partial
from types import SimpleNamespace
from typing import cast

import pytest
import torch
from support.runs import RUN, TWO, alarm, finish, reference, spawn
from torchmetrics import MeanMetric

from flame_mdm.__main__ import main
from flame_mdm.checkpoints.loading import load_task
from flame_mdm.checkpoints.model_files import read_checkpoint
from flame_mdm.commands import train
from flame_mdm.config import compose, instantiate
from flame_mdm.config.sweeps import run_recipe
from flame_mdm.task import MotionGeneration

pytestmark = pytest.mark.slow


def test_two_processes_are_one_with_both_batches(tiny, tmp_path):
    """Launched by Lightning."""
    words = [*tiny, *RUN, f"data_root={tmp_path / 'data'}"]
    ours = ["callbacks.samples.every_n_steps=2", "trainer.max_steps=4"]
    code, out, err = finish(spawn(["flame_mdm", "train", "quickstart", *words, *TWO, *ours]))
    assert code == 0, err
    assert out.count("player: ") == 1
    batch = "batch: 2 clips = 1 x 2 processes x 1 accumulated; optimizer.lr=0.05 is not scaled with the batch size"
    assert batch in out
    assert out.count("steps: 0 to 4") == err.count("preparing synthetic:   0%") == 1  # the data, too, by one process
    expected = reference(words, 4)
    trained = read_checkpoint(tmp_path / "run" / "checkpoints" / "last.ckpt")["state_dict"]
    torch.testing.assert_close(trained, expected, rtol=1e-4, atol=1e-6)

    # Validation: 5 clips in batches of one, so 3 batches on one process, 2 on the other.
    config = compose("quickstart", words)
    task = load_task(tmp_path / "run" / "checkpoints" / "last.ckpt", MotionGeneration)
    task.load_state_dict(expected)
    data = instantiate(config["data"], representation=task.representation, seed=config["seed"])
    data.setup("fit")
    with torch.no_grad():
        for index, batch in enumerate(data.val_dataloader()):
            task.eval().validation_step(batch, index)
    assert len(data.val) == 5
    with (tmp_path / "run" / "csv" / "metrics.csv").open() as file:
        losses = [float(row["val/loss"]) for row in csv.DictReader(file) if row.get("val/loss")]
    assert losses[-1] == pytest.approx(float(cast(MeanMetric, task.val_losses["loss"]).compute()), rel=1e-4)


def test_torchrun_starts_a_killed_group_again(tiny, tmp_path):
    """The first process dies at step 3 and leaves its lock; then SIGTERM ends torchrun at step 6."""
    words = [*tiny, *RUN, "callbacks.samples=null"]
    counter = "TORCHELASTIC_RESTART_COUNT"
    alarms = [
        *alarm(tmp_path, "kill", step=3, rank=0, attempt=0, counter=counter, signal="SIGKILL"),
        *alarm(tmp_path, "end", step=6, rank=0, attempt=1, counter=counter, signal="SIGTERM", parent=True),
    ]
    torchrun = ["torch.distributed.run", "--nproc-per-node=2", "--max-restarts=1", "--standalone"]
    command = [*torchrun, "-m", "flame_mdm", "train", "quickstart", *words, *TWO, *alarms, "trainer.max_steps=100000"]
    path = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep)
    # Else torchrun keeps its store, and the new group finds the addresses of the dead one in there.
    _, out, err = finish(spawn(command, PYTHONPATH=path, TORCH_DISABLE_SHARE_RDZV_TCP_STORE="1", PYTHONUNBUFFERED="1"))
    assert "steps: 0 to 100000" in out, err
    assert "died; taking over its run directory" in out
    assert "steps: 2 to 100000" in out
    assert out.count("Run the same command to resume") == 1, err
    step = int(re.findall(r"stopped at step (\d+)", out)[0])
    checkpoint = read_checkpoint(tmp_path / "run" / "checkpoints" / "last.ckpt")
    assert checkpoint["global_step"] == step >= 6
    torch.testing.assert_close(checkpoint["state_dict"], reference(words, step), rtol=1e-4, atol=1e-6)
    assert not (tmp_path / "run" / "run.lock").exists()


def test_data_is_prepared_once_and_no_process_is_without_a_validation_batch(tiny):
    config = compose("quickstart", [*tiny, "data.batch_size=1"])
    representation = instantiate(config["representation"])
    data = instantiate(config["data"], representation=representation, seed=0)
    for part in (data, MotionGeneration.build(config, representation)):
        assert part.prepare_data_per_node is False  # by which Lightning asks the first process of the first machine
    data.prepare_data()
    data.setup("fit")
    for world, batches in ((1, 5), (2, 3), (7, 5)):
        data.trainer = SimpleNamespace(global_rank=0, world_size=world)  # type: ignore[assignment]
        assert len(data.val_dataloader()) == batches
        data.trainer.global_rank = world - 1  # type: ignore[union-attr]
        assert len(data.val_dataloader()) >= 1


def test_processes_are_started_with_the_words_of_one_job(tiny, tmp_path, monkeypatch):
    seen = []
    note = lambda config: seen.append((sys.argv[1:], config["run"]["dir"], config))  # noqa: E731
    monkeypatch.setattr(train, "main", partial(run_recipe, note, train.USAGE))
    monkeypatch.setattr(sys, "argv", ["flame-mdm", "train"])
    folder = f"run.dir={tmp_path / 'sweep'}"
    assert main(["train", "quickstart", *tiny[:-1], folder, "seed=1,2", "--multirun"]) == 0
    assert len(seen) == 2
    for number, (words, directory, config) in enumerate(seen, 1):
        assert words[:2] == ["train", "quickstart"]
        assert config["callbacks"]["checkpoints"]["folder"] == f"{directory}/checkpoints"
        assert f"seed={number}" in words
        again = compose(words[1], words[2:])
        assert again["run"]["dir"] == directory == str(tmp_path / "sweep" / f"seed={number}")
