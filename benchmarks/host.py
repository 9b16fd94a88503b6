"""Cost of the framework per training step, compared to bare Lightning: `python benchmarks/host.py [steps]`.

A transformer of one layer and width 16 is trained by the complete framework (loading, averaged weights, clipped
gradients, checkpoints; progress bar off), so that most of the time is spent outside of the network. Bare Lightning
trains one linear layer on a constant batch and logs a loss. Both run on one thread, alternate several times, and give
the median time between the ends of two steps.
"""

from __future__ import annotations

import itertools
import statistics
import sys
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

import torch
from lightning import Callback, LightningModule, Trainer
from torch import Tensor
from torch.utils.data import DataLoader

from flame_mdm.config import compose
from flame_mdm.training import fit as training

WARM, ROUNDS = 50, 3
WORDS = sys.argv[2:]
TINY = [
    *("data.source.clips=200", "data.batch_size=4", "denoiser.latent_dim=16", "denoiser.ff_size=16"),
    *("denoiser.num_layers=1", "denoiser.num_heads=2", "trainer.accelerator=cpu"),
    *("trainer.enable_progress_bar=false", "trainer.val_check_interval=1000000", "callbacks.samples=null"),
    *("callbacks.best=null", "callbacks.checkpoints.every_n_steps=1000000", "losses.velocity=0", "logger=csv"),
]


class Clock(Callback):
    """Records the time after every step."""

    def __init__(self) -> None:
        self.times: list[float] = []

    def on_train_batch_end(self, *_: Any) -> None:
        self.times.append(time.perf_counter())

    def median(self) -> float:
        """Returns the median milliseconds between steps, without the first ones."""
        times = self.times[WARM:]
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
    trainer.fit(Bare(), DataLoader([torch.ones(16)] * (4 * steps), batch_size=4))
    return clock.median()


def framework(steps: int, folder: Path, number: int, *words: str) -> float:
    """Returns milliseconds per step of a recipe trained by the framework."""
    run = folder / f"run{number}"
    words = (*WORDS, "data_root=" + str(folder / "data"), f"run.dir={run}", f"trainer.max_steps={steps}", *words)
    clock = Clock()
    config = compose("quickstart", [*TINY, *words])
    config["callbacks"]["clock"] = {"_target_": f"{__name__}.clock"}
    globals()["clock"] = lambda: clock
    run.mkdir()
    training.fit(run, config)
    return clock.median()


def main(steps: int) -> None:
    warnings.filterwarnings("ignore")
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        rows: list[tuple[float, ...]] = []
        for n in range(ROUNDS):
            averaged, plain = (framework(steps, folder, 2 * n + k, *w) for k, w in enumerate(((), ("ema=null",))))
            rows.append((bare(steps, folder), averaged, plain))
    lightning, averaged, plain = (statistics.median(column) for column in zip(*rows, strict=True))
    print(f"milliseconds per step: bare Lightning {lightning:.2f}, framework {averaged:.2f}, without EMA {plain:.2f}")
    print(f"ratio {averaged / lightning:.2f}, without EMA {plain / lightning:.2f}")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 400)
