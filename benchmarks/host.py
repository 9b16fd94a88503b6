"""Cost of the framework per training step, compared to bare Lightning: `python benchmarks/host.py [steps]`.

A transformer of one layer and width 16 without a text encoder is trained by the complete framework (loading, averaged
weights, clipped gradients, checkpoints; progress bar off), so that most of the time is spent outside of the network.
Bare Lightning trains one linear layer on a constant batch, clips its gradients and logs a loss. A loop in plain PyTorch
trains the framework's network on one batch. All run on one thread, alternate several times, and give the median time
between the ends of two steps. The parts of the framework's step are timed one by one, without Lightning.
"""

from __future__ import annotations

import itertools
import statistics
import sys
import tempfile
import time
import warnings
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch
from hydra.utils import get_class
from lightning import Callback, LightningModule, Trainer
from sections import Section, section, show
from torch import Tensor
from torch.optim.swa_utils import AveragedModel
from torch.utils.data import DataLoader

from flame_mdm.config import compose, instantiate
from flame_mdm.seeds import seed_generator
from flame_mdm.training import fit as training
from flame_mdm.training.averaging import MovingAverage

WARM, ROUNDS = 50, 3
QUIET = [
    *("trainer.accelerator=cpu", "trainer.enable_progress_bar=false", "trainer.val_check_interval=1000000"),
    *("callbacks.samples=null", "callbacks.best=null", "callbacks.checkpoints.every_n_steps=1000000", "logger=csv"),
]
TINY = [
    *("data.source.clips=200", "data.batch_size=4", "denoiser.latent_dim=16", "denoiser.ff_size=16"),
    *("denoiser.num_layers=1", "denoiser.num_heads=2", "losses.velocity=0", "speed=reference", "condition=none"),
]


class Clock(Callback):
    """Records the time after every step."""

    def __init__(self) -> None:
        self.times: list[float] = []

    def on_train_batch_end(self, *_: Any) -> None:
        self.times.append(time.perf_counter())

    def median(self) -> float:
        """Returns the median milliseconds between steps, without the first ones."""
        times = self.times[min(WARM, len(self.times) // 2) :]
        return 1000 * statistics.median(b - a for a, b in itertools.pairwise(times))


class Bare(LightningModule):
    """One linear layer."""

    def __init__(self) -> None:
        super().__init__()
        self.layer = torch.nn.Linear(16, 16)

    def training_step(self, batch: Tensor, batch_idx: int) -> Tensor:
        loss = self.layer(batch).square().mean()
        self.log_dict({"loss": loss})
        return loss

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.AdamW(self.parameters(), fused=True)


def bare(steps: int, folder: Path) -> float:
    """Returns milliseconds per step of bare Lightning."""
    clock = Clock()
    trainer = Trainer(
        max_steps=steps,
        accelerator="cpu",
        logger=False,
        callbacks=[clock],
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        default_root_dir=folder,
        gradient_clip_val=1.0,
    )
    trainer.fit(Bare(), DataLoader([torch.ones(16)] * (4 * steps), batch_size=4))  # type: ignore[arg-type]
    return clock.median()


def framework(steps: int, folder: Path, *words: str) -> float:
    """Returns milliseconds per step of the quickstart, trained by the framework with other settings."""
    run = Path(tempfile.mkdtemp(dir=folder))
    words = (*QUIET, f"data_root={folder / 'data'}", f"run.dir={run}", f"trainer.max_steps={steps}", *words)
    clock = Clock()
    config = compose("quickstart", words)
    config["callbacks"]["clock"] = {"_target_": f"{__name__}.clock"}
    globals()["clock"] = lambda: clock
    training.fit(run, config)
    return clock.median()


def built(folder: Path) -> tuple[Any, Any]:
    """Returns data and task of the framework's training."""
    config = compose("quickstart", [*QUIET, *TINY, f"data_root={folder / 'data'}"])
    representation = instantiate(config["representation"])
    data: Any = instantiate(config["data"], representation=representation, seed=0)
    data.prepare_data()
    data.setup("fit")
    return data, get_class(config["task"]["_target_"]).build(config, representation).train()


def loop(steps: int, folder: Path) -> float:
    """Returns milliseconds per step of a plain PyTorch loop that trains the same network on one batch."""
    data, task = built(folder)
    optimizer, parameters = task.make_optimizer(), list(task.parameters())
    batch = next(iter(data.train_dataloader()))
    cond, clock = task.condition(batch), Clock()
    for _ in range(steps):
        task.process.loss(task.denoiser, batch.x, batch.mask, cond)["loss"].mean().backward()
        torch.nn.utils.clip_grad_norm_(parameters, 1.0)
        optimizer.step()
        optimizer.zero_grad()
        clock.on_train_batch_end()
    return clock.median()


def parts(steps: int, folder: Path) -> dict[str, float]:
    """Returns the median milliseconds of each part of a step."""
    data, task = built(folder)
    optimizer, parameters = task.make_optimizer(), list(task.parameters())
    average = MovingAverage(0.998)
    average._average_model = AveragedModel(task)
    average.on_train_start(SimpleNamespace(), task)  # type: ignore[arg-type]
    batches = iter(data.train_dataloader())
    times: dict[str, list[float]] = {}
    for step in range(steps):
        clock = [time.perf_counter()]
        done = {}

        def lap(name: str, clock: list[float] = clock, done: dict[str, float] = done) -> None:
            clock.append(time.perf_counter())
            done[name] = clock[-1] - clock[-2]

        batch = next(batches)
        lap("loading")
        seed_generator(step, torch.device("cpu"))
        lap("seeding")
        cond = task.condition(batch)
        lap("condition")
        loss = task.process.loss(task.denoiser, batch.x, batch.mask, cond, auxiliary=task.losses)["loss"].mean()
        lap("forward pass and loss")
        loss.backward()
        lap("backward pass")
        torch.nn.utils.clip_grad_norm_(parameters, 1.0)
        lap("clipping gradients")
        optimizer.step()
        optimizer.zero_grad()
        lap("optimizer")
        average.on_train_batch_end(SimpleNamespace(global_step=step + 1), task, None, None, 0)  # type: ignore[arg-type]
        lap("averaging weights")
        for name, taken in done.items():
            times.setdefault(name, []).append(taken)
    return {name: 1000 * statistics.median(taken[len(taken) // 4 :]) for name, taken in times.items()}


def measure(*words: str) -> Section:
    """Measures with the number of steps of each run in `words`."""
    steps = int(words[0]) if words else 400
    warnings.filterwarnings("ignore")
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        runs = [
            (
                bare(steps, folder),
                framework(steps, folder, *TINY),
                framework(steps, folder, *TINY, "ema=null"),
                loop(steps, folder),
            )
            for _ in range(ROUNDS)
        ]
        split = parts(2 * steps, folder)
    lightning, averaged, plain, network = (statistics.median(column) for column in zip(*runs, strict=True))
    split["everything else, mostly Lightning"] = averaged - sum(split.values())
    times = {"bare Lightning, one linear layer": lightning, "framework": averaged, "framework without EMA": plain}
    times |= {
        "plain PyTorch loop, the framework's network": network,
        "bare Lightning + plain loop": lightning + network,
    }
    return section(
        "Host cost of a training step",
        "An almost empty network: one transformer layer of width 16, 4 clips per batch, no text encoder. Its step has "
        "almost no arithmetic: it is the time of calling torch, the framework and Lightning. One thread, "
        f"{ROUNDS} alternating runs of {steps} steps, median time between the ends of two steps. The plain loop trains "
        "the framework's network on one batch, without framework and Lightning: together with bare Lightning, it is a "
        "lower limit. The second table times the parts of the framework's step one by one, outside of Lightning.",
        f"An almost empty training step takes {averaged:.1f} ms: {averaged / lightning:.1f} times bare Lightning's, "
        f"and {averaged / (lightning + network):.1f} times that of bare Lightning plus a plain loop of its network.",
        steps=[{"training": k, "ms per step": v, "ratio": v / lightning} for k, v in times.items()],
        parts_of_the_framework=[{"part": k, "ms": v, "share": f"{v / averaged:.0%}"} for k, v in split.items()],
    )


if __name__ == "__main__":
    show(measure(*sys.argv[1:]))
