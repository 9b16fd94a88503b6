"""Speed of both ways to load batches compared to a training step: `python benchmarks/loading.py [clips]`.

A synthetic data set is packed into a temporary folder. Batches gathered from memory (data.resident=true), batches of
the data loader in the training process, and forward, backward and update of the small MDM encoder are measured in
processor time of one core, which excludes other programs on the machine. Loading with workers is measured in wall time,
which includes passing batches between processes and the load of the machine. Prints medians over the rounds.
"""

import itertools
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial

import torch

from flame_mdm.data.crops import Units
from flame_mdm.data.datamodule import MotionDataModule
from flame_mdm.data.synthetic import Synthetic
from flame_mdm.denoisers.mdm import MDMEncoder
from flame_mdm.losses import masked_mse
from flame_mdm.motion import Condition, MotionBatch
from flame_mdm.representations.humanml import HumanML

BATCH, BATCHES, ROUNDS = 64, 60, 5
GOAL = 5000
"""Target clips per second and worker."""


def training(features: int) -> Callable[[MotionBatch], None]:
    """Returns a training step (forward, backward, update) of MDM's encoder in its size for CPU runs."""
    model = MDMEncoder(features, features, 512, latent_dim=128, ff_size=256, num_layers=4, num_heads=4, dropout=0.0)
    optimizer = torch.optim.AdamW(model.parameters(), fused=True)

    def step(batch: MotionBatch) -> None:
        cond = Condition(torch.zeros(len(batch), 512), torch.zeros(len(batch), 0, 512), None)
        output = model(torch.randn_like(batch.x), torch.rand(len(batch)) * 1000, batch.mask, cond)
        masked_mse(output, batch.x, batch.mask).mean().backward()
        optimizer.step()
        optimizer.zero_grad()

    return step


def median(run: Callable[[], object], times: int, clock: Callable[[], float]) -> float:
    """Returns the median over rounds of the mean seconds per call in `times` calls."""
    seconds = []
    for _ in range(ROUNDS):
        start = clock()
        for _ in range(times):
            run()
        seconds.append((clock() - start) / times)
    return statistics.median(seconds)


def main(clips: int) -> None:
    torch.manual_seed(0)
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        source, crop = Synthetic(clips), Units(24, 60, 4)
        data = MotionDataModule(source, HumanML(), root=folder, name="s", batch_size=BATCH, crop=crop)
        data.resident = False
        data.prepare_data()
        data.setup("fit")
        loader = iter(data.train_dataloader())
        batches = [next(loader) for _ in range(8)]
        step = training(batches[0].x.shape[2])
        step(batches[0])
        endless = itertools.cycle(batches)
        wait = median(lambda: step(next(endless)), len(batches), time.process_time)
        load = median(lambda: next(loader), BATCHES, time.process_time)
        data.resident = True
        data.setup("fit")
        gathered = iter(data.train_dataloader())
        gather = median(lambda: next(gathered), BATCHES, time.process_time)
        lengths = torch.cat([batch.lengths for batch in batches]).float().mean()
        frames = statistics.mean(batch.x.shape[1] for batch in batches)
        print(
            f"{BATCH} clips per batch, {lengths:.0f} frames of {batches[0].x.shape[2]} features, padded to {frames:.0f}"
        )
        print(f"a training step takes {1000 * wait:.0f} ms of one core")
        print(f"its batch: {gather / wait:.1%} of that if gathered from memory, {load / wait:.1%} if loaded")
        print(f"{'loader':<26}{'ms/batch':>12}{'batches/s':>12}{'clips/s':>10}{'vs. target':>13}")
        row("resident, one core", gather, 1)
        row("loader, one core", load, 1)
        data.resident = False
        data.setup("fit")
        for workers in (1, 2):
            data.num_workers = workers
            loader = iter(data.train_dataloader())
            for _ in range(BATCHES):  # starts the workers
                next(loader)
            load = median(partial(next, loader), BATCHES, time.perf_counter)
            row(f"loader, {workers} worker{'s' * (workers > 1)}, wall", load, workers)


def row(name: str, seconds: float, workers: int) -> None:
    """Prints the speed of one loader and its ratio to the target."""
    rate = BATCH / seconds
    print(f"{name:<26}{1000 * seconds:>12.2f}{1 / seconds:>12.1f}{rate:>10,.0f}{rate / workers / GOAL:>12.2f}x")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 1000)
