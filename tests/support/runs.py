"""Training runs of several processes, and the weights that one process makes of the same batches."""

from __future__ import annotations

import multiprocessing
import os
import random
import runpy
import signal
import socket
import subprocess
import sys
import time
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout, suppress
from multiprocessing import active_children
from multiprocessing.process import BaseProcess
from pathlib import Path

import pytest
import torch
from hydra.utils import get_class

from flame_mdm.batch import MotionBatch, collate
from flame_mdm.config import Config, compose, instantiate
from flame_mdm.data.datamodule import MotionDataModule, TrainingBatches
from flame_mdm.generator import MotionGenerator
from flame_mdm.task import GeneratorTask
from flame_mdm.training.distillation import DistillationTask

SECONDS = 240
"""How long a fork of this process may take."""
LAUNCHED = 900
"""How long processes may take that import torch, several after one another, on a machine with other work."""

TINY = [
    *(
        "data.source.clips=120",
        "data.batch_size=8",
        "denoiser.latent_dim=16",
        "denoiser.ff_size=16",
    ),
    *("denoiser.num_layers=1", "denoiser.num_heads=2", "process.num_train_timesteps=10"),
    *("task.num_inference_steps=5", "trainer.accelerator=cpu", "trainer.enable_progress_bar=false"),
    *("condition.features=16", "condition.pretrain_steps=10"),
    # Pictures of all prompts and of seconds would take most of the time
    "callbacks.samples.seconds=0.5",
    "callbacks.samples.prompts.count=3",
    "lr_decay=0",  # it depends on trainer.max_steps, which tests raise to resume
]
"""Overrides that make the quick-start experiment train in a second."""

# With SGD: Adam scales gradients that are 0 except for rounding up to full steps.
RUN = [
    "speed=reference",
    *(
        "data.batch_size=1",
        "ema=null",
        "logger=csv",
        "callbacks.best=null",
        "callbacks.checkpoints.every_n_steps=2",
    ),
    *(
        "trainer.val_check_interval=2",
        "trainer.log_every_n_steps=2",
        "trainer.gradient_clip_val=0.5",
    ),
    *("optimizer._target_=torch.optim.SGD", "optimizer.lr=0.05"),
]
"""Overrides of a run whose weights `reference` computes."""

TINY_DIP = [
    "denoiser.latent_dim=16",
    "denoiser.ff_size=16",
    "denoiser.num_layers=1",
    "denoiser.num_heads=2",
]
TINY_DIP += ["condition.features=16", "process.num_train_timesteps=4", "task.num_inference_steps=4"]
"""Overrides of the smallest model of `synthetic/dip`."""

SMALL = ["data.source.clips=120", "data.batch_size=4", "trainer.accelerator=cpu"]
WIDTHS = ["denoiser.latent_dim=16", "denoiser.ff_size=16", "denoiser.num_layers=1"]
WIDTHS += ["denoiser.num_heads=2"]
RECIPES = {
    "quickstart": TINY,
    "synthetic/flame": [*SMALL, *WIDTHS, "condition=learned"],
    "synthetic/mdm_decoder": [*SMALL, *WIDTHS, "condition=learned"],
    "synthetic/mdm_gru": [*SMALL, "condition=none"],
    "synthetic/mdm_unet": [*SMALL, "condition=none"],
    "synthetic/mfm": [*SMALL, *WIDTHS, "condition=none"],
    "synthetic/dip": [
        *SMALL,
        *TINY_DIP,
        "task=generation_targets",
        "+denoiser.target_encoder=single",
    ],
}
"""One recipe of each kind of model -> overrides of its smallest model."""

TWO = ["trainer.devices=2", "trainer.strategy=ddp"]

ALARM = """
import os
import signal

from lightning import Callback


class Alarm(Callback):
    def __init__(self, step: int, rank: int, attempt: int, counter: str, signal: str, parent: bool = False):
        self.step, self.rank, self.attempt, self.counter = step, rank, attempt, counter
        self.signal, self.parent = signal, parent

    def on_train_batch_end(self, trainer, *_):
        here = (trainer.global_step, trainer.global_rank, int(os.environ[self.counter]))
        if here == (self.step, self.rank, self.attempt):
            os.kill(os.getppid() if self.parent else os.getpid(), getattr(signal, self.signal))
"""
"""A module with a callback that sends a signal, to its process or what started it, at the end of a step."""


def alarm(folder: Path, name: str, **arguments: object) -> list[str]:
    """Overrides that add the callback, whose module is written to a folder of the Python path."""
    (folder / "alarm.py").write_text(ALARM)
    values = {"_target_": "alarm.Alarm", **arguments}
    return [f"+callbacks.{name}.{key}={value}" for key, value in values.items()]


def built(words: list[str], name: str) -> tuple[Config, MotionDataModule, GeneratorTask]:
    """A recipe, its data, which are prepared, and its task with the weights at the start of a run."""
    config = compose(name, words)
    torch.manual_seed(config["seed"])
    representation = instantiate(config["representation"])
    data: MotionDataModule = instantiate(
        config["data"], representation=representation, seed=config["seed"]
    )
    data.prepare_data()
    data.setup("fit")
    torch.manual_seed(config["seed"])
    task: GeneratorTask = get_class(config["task"]["_target_"]).build(config, representation)
    return config, data, task


def reference(words: list[str], steps: int, name: str = "quickstart") -> dict[str, torch.Tensor]:
    """Weights of one process that averages the gradients of both processes' batches."""
    config, data, task = built(words, name)
    if isinstance(task, DistillationTask):
        task.start_from_teacher()
    else:
        task.generator.condition.pretrain([clip.captions for clip in data.train.clips], task.seed)
    rank = 0
    task.__class__ = type("OfRank", (type(task),), {"global_rank": property(lambda self: rank)})  # type: ignore[arg-type]
    optimizer = task.make_optimizer()
    streams = [
        iter(
            TrainingBatches(
                data.train.lengths, data.batch_size, seed=config["seed"], first=0, rank=r, world=2
            )
        )
        for r in range(2)
    ]
    for step in range(steps):
        optimizer.zero_grad()
        for rank, stream in enumerate(streams):  # noqa: B007 (the property above reads it)
            batch: MotionBatch = collate([data.train[draw] for draw in next(stream)])
            (task.training_step(batch, step) / 2).backward()
        torch.nn.utils.clip_grad_norm_(task.parameters(), config["trainer"]["gradient_clip_val"])
        optimizer.step()
    return task.state_dict()


def untrained(words: list[str], max_frames: int, name: str = "quickstart") -> MotionGenerator:
    """The model of a recipe with random weights."""
    config = compose(name, words)
    torch.manual_seed(0)
    model = MotionGenerator.build(config, instantiate(config["representation"]))
    model.facts |= {"max_frames": max_frames, "dataset": "synthetic", "fingerprint": "f00d"}
    return model.eval()


@contextmanager
def inputs_of(module: torch.nn.Module) -> Iterator[list[tuple[torch.Tensor, ...]]]:
    """The inputs of each call of a module in the block."""
    inputs: list[tuple[torch.Tensor, ...]] = []
    hook = module.register_forward_hook(lambda _, arguments, output: inputs.append(arguments))
    yield inputs
    hook.remove()


def free_port() -> int:
    """A port that nobody uses, below those that the system gives to outgoing connections meanwhile."""
    for port in random.sample(range(20_000, 32_000), 100):
        with socket.socket() as free, suppress(OSError):
            free.bind(("127.0.0.1", port))
            return port
    raise OSError("no port is free")


def spawn(words: list[str], **environment: str) -> subprocess.Popen[str]:
    """Starts `python -m words`."""
    return subprocess.Popen(
        [sys.executable, "-m", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1", "GLOO_SOCKET_IFNAME": "lo", **environment},
        start_new_session=True,
    )


def finish(process: subprocess.Popen[str]) -> tuple[int, str, str]:
    """Exit code and what was printed; processes that hang fail the test."""
    try:
        out, err = process.communicate(timeout=LAUNCHED)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        out, err = process.communicate()
        pytest.fail(f"the processes hang\n{out}\n{err}")
    return process.returncode, out, err


def forked(folder: Path, words: list[str]) -> BaseProcess:
    """Starts `python -m words` as a fork of this process, which has imported all already.

    What it prints is in the files `out` and `err` of the folder, also what its children print.
    """
    process = multiprocessing.get_context("fork").Process(target=_module, args=(folder, words))
    process.start()
    return process


def _module(folder: Path, words: list[str]) -> None:
    os.environ |= {"OMP_NUM_THREADS": "1", "GLOO_SOCKET_IFNAME": "lo"}
    warnings.simplefilter("default")
    sys.argv = words
    with ExitStack() as stack:
        for number, name, redirect in ((1, "out", redirect_stdout), (2, "err", redirect_stderr)):
            file = stack.enter_context((folder / name).open("w", buffering=1))
            os.dup2(file.fileno(), number)
            stack.enter_context(redirect(file))
        runpy.run_module(words[0], run_name="__main__", alter_sys=True)


def ended(process: BaseProcess, folder: Path) -> tuple[int | None, str, str]:
    """Exit code and what was printed of a process that `forked` started; one that hangs fails the test."""
    process.join(SECONDS)
    out, err = ((folder / name).read_text() for name in ("out", "err"))
    if process.is_alive():
        process.kill()
        pytest.fail(f"the process hangs\n{out}\n{err}")
    return process.exitcode, out, err


def no_children(before: list[BaseProcess]) -> bool:
    """Whether there are no child processes besides `before`. A process that ended may take a moment to be noticed."""
    for _ in range(500):
        if not set(active_children()) - set(before):
            return True
        time.sleep(0.01)
    return False
