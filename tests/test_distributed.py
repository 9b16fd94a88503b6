"""Two real processes train what one would; that they cannot start is a failure."""

import csv
import os
import re
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest
import torch
from torchmetrics import MeanMetric

from flame_mdm import train
from flame_mdm.config import compose, instantiate
from flame_mdm.data.datamodule import TrainingBatches
from flame_mdm.motion import MotionBatch, collate
from flame_mdm.task import MotionGeneration, read_checkpoint

RECIPE = [
    *("data.batch_size=1", "ema=null", "logger=csv", "trainer.val_check_interval=2", "trainer.log_every_n_steps=2"),
    *(
        "optimizer._target_=torch.optim.SGD",
        "optimizer.lr=0.05",
        "trainer.gradient_clip_val=null",
    ),  # Adam makes much of what rounds to nothing
]
TWO = ["trainer.devices=2", "trainer.strategy=ddp", "callbacks.checkpoints.every_n_steps=2", "callbacks.best=null"]
SECONDS = 100


def reference(words: list[str], steps: int) -> dict[str, torch.Tensor]:
    """Weights of one process that averages the gradients of both processes' batches."""
    config = compose("quickstart", words)
    torch.manual_seed(config["seed"])
    representation = instantiate(config["representation"])
    data = instantiate(config["data"], representation=representation, seed=config["seed"])
    data.setup("fit")
    torch.manual_seed(config["seed"])
    task = MotionGeneration.build(config, representation)
    rank = 0
    task.__class__ = type("OfRank", (MotionGeneration,), {"global_rank": property(lambda self: rank)})
    task.log_dict = lambda *_, **__: None  # type: ignore[method-assign]
    optimizer = task.configure_optimizers()
    streams = [
        iter(TrainingBatches(data.train.lengths, data.batch_size, seed=config["seed"], first=0, rank=r, world=2))
        for r in range(2)
    ]
    for step in range(steps):
        optimizer.zero_grad()
        for rank, stream in enumerate(streams):  # noqa: B007 (the property above reads it)
            batch: MotionBatch = collate([data.train[draw] for draw in next(stream)])
            (task.training_step(batch, step) / 2).backward()
        optimizer.step()
    return task.state_dict()


def values(folder: Path) -> list[float]:
    with (folder / "csv" / "metrics.csv").open() as file:
        return [float(row["val/loss"]) for row in csv.DictReader(file) if row.get("val/loss")]


def spawn(words: list[str]) -> subprocess.Popen[str]:
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "GLOO_SOCKET_IFNAME": "lo"}
    return subprocess.Popen(
        [sys.executable, "-m", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
        start_new_session=True,
    )


def finish(process: subprocess.Popen[str]) -> tuple[int, str, str]:
    try:
        out, err = process.communicate(timeout=SECONDS)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        out, err = process.communicate()
        pytest.fail(f"the processes hang\n{out}\n{err}")
    return process.returncode, out, err


def test_two_processes_are_one_with_both_batches(tiny, tmp_path):
    """Launched by Lightning to the end, then resumed by torchrun and ended by SIGTERM."""
    words = [*tiny, *RECIPE]
    ours = ["callbacks.samples.every_n_steps=2", "trainer.max_steps=4"]
    code, out, err = finish(spawn(["flame_mdm.train", "quickstart", *words, *TWO, *ours]))
    assert code == 0, err
    assert out.count("see the motions") == 1
    checkpoints = tmp_path / "run" / "checkpoints"
    wanted = reference(words, 4)
    torch.testing.assert_close(read_checkpoint(checkpoints / "last.ckpt")["state_dict"], wanted, rtol=1e-3, atol=1e-5)

    # Validation: 3 clips in batches of one, so 2 batches on one process, 1 on the other.
    task = MotionGeneration.build(
        compose("quickstart", words), instantiate(compose("quickstart", words)["representation"])
    )
    task.load_state_dict(wanted)
    config = compose("quickstart", words)
    data = instantiate(config["data"], representation=task.representation, seed=config["seed"])
    data.setup("fit")
    with torch.no_grad():
        for index, batch in enumerate(data.val_dataloader()):
            task.eval().validation_step(batch, index)
    assert len(data.val) == 3
    assert values(tmp_path / "run")[-1] == pytest.approx(
        float(cast(MeanMetric, task.val_losses["loss"]).compute()), rel=1e-4
    )

    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    torchrun = ["torch.distributed.run", "--nproc-per-node=2", f"--master-port={port}", "-m", "flame_mdm.train"]
    process = spawn(
        [*torchrun, "quickstart", *words, *TWO, "trainer.max_steps=100000", "callbacks.samples.every_n_steps=2"]
    )
    deadline = time.monotonic() + SECONDS
    before = (checkpoints / "last.ckpt").stat().st_mtime_ns
    while (checkpoints / "last.ckpt").stat().st_mtime_ns == before and process.poll() is None:
        assert time.monotonic() < deadline
        time.sleep(0.02)
    process.send_signal(signal.SIGTERM)
    _, out, err = finish(process)
    assert out.count("the same command goes on from there") == 1, err
    step = int(re.findall(r"stopped at step (\d+)", out)[0])
    checkpoint = read_checkpoint(checkpoints / "last.ckpt")
    assert checkpoint["global_step"] == step > 4
    torch.testing.assert_close(checkpoint["state_dict"], reference(words, step), rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize(("world", "batches"), [(1, 3), (2, 2), (5, 3)])
def test_no_process_is_without_a_validation_batch(tiny, world, batches):
    config = compose("quickstart", [*tiny, "data.batch_size=1"])
    data = instantiate(config["data"], representation=instantiate(config["representation"]), seed=0)
    data.prepare_data()
    data.setup("fit")
    data.trainer = SimpleNamespace(global_rank=0, world_size=world)  # type: ignore[assignment]
    assert len(data.val_dataloader()) == batches
    data.trainer.global_rank = world - 1  # type: ignore[union-attr]
    assert len(data.val_dataloader()) >= 1


def test_processes_are_started_with_the_words_of_one_job(tiny, tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr(train, "train", lambda config: seen.append((sys.argv[1:], config["run"]["dir"])))
    monkeypatch.setattr(sys, "argv", ["train"])
    folder = f"run.dir={tmp_path / 'sweep'}"
    assert train.main(["quickstart", *tiny[:-1], folder, "seed=1,2", "--multirun"]) == 0
    assert len(seen) == 2
    for number, (words, directory) in enumerate(seen, 1):
        assert words[0] == "quickstart"
        assert f"seed={number}" in words
        again = compose(words[0], words[1:])
        assert again["run"]["dir"] == directory
