"""Speed of both ways to load batches compared to a training step: `python benchmarks/loading.py [clips batches]`.

A synthetic data set is packed into a temporary folder. Batches gathered from memory (data.resident=true), batches of
the data loader in the training process, and forward, backward and update of the small MDM encoder are measured in
processor time of one core, which excludes other programs on the machine. Loading with workers is measured in wall time,
which includes passing batches between processes and the load of the machine. Gives medians over the rounds.
"""

import itertools
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial

import torch
from sections import Row, Section, section, show

from flame_mdm.batch import Condition, MotionBatch
from flame_mdm.data.crops import Units
from flame_mdm.data.datamodule import MotionDataModule
from flame_mdm.data.synthetic import Synthetic
from flame_mdm.denoisers.mdm import MDMEncoder
from flame_mdm.losses import masked_mse
from flame_mdm.representations.humanml import HumanML

BATCH, ROUNDS = 64, 5
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


def measure(*words: str) -> Section:
    """Measures with the numbers of clips and of batches per round in `words`."""
    clips, count = (int(word) for word in words or (1000, 60))
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
        load = median(lambda: next(loader), count, time.process_time)
        data.resident = True
        data.setup("fit")
        gathered = iter(data.train_dataloader())
        gather = median(lambda: next(gathered), count, time.process_time)
        lengths = torch.cat([batch.lengths for batch in batches]).float().mean()
        frames = statistics.mean(batch.x.shape[1] for batch in batches)
        rows = [row("resident, one core", gather, wait, 1), row("loader, one core", load, wait, 1)]
        size = batches[0].x.shape[2]
        data.resident = False
        data.setup("fit")
        for workers in (1, 2):
            data.num_workers = workers
            loader = iter(data.train_dataloader())
            for _ in range(count):  # starts the workers
                next(loader)
            taken = median(partial(next, loader), count, time.perf_counter)
            rows.append(row(f"loader, {workers} worker{'s' * (workers > 1)}, wall time", taken, wait, workers))

    return section(
        "Loading of batches",
        f"{BATCH} clips per batch, {lengths:.0f} frames of {size} features on average, padded to {frames:.0f}. "
        "Resident batches (`data.resident=true`) are gathered from memory; the loader collates clips, in the training "
        f"process or in workers. A training step of the small MDM encoder takes {1000 * wait:.0f} ms of one core. The "
        f"target is {GOAL:,} clips per second and worker. Median of {ROUNDS} rounds of {count} batches.",
        f"A resident batch is ready {load / gather:.1f} times as fast as one of the loader, and takes "
        f"{gather / wait:.1%} of the time of a small training step.",
        batches=rows,
    )


def row(name: str, seconds: float, step: float, workers: int) -> Row:
    """Returns the speed of one loader, and its ratios to a training step and to the target."""
    rate = BATCH / seconds
    return {
        "batches": name,
        "ms per batch": 1000 * seconds,
        "share of a step": f"{seconds / step:.1%}",
        "clips per second": rate,
        "ratio to the target": rate / workers / GOAL,
    }


if __name__ == "__main__":
    show(measure(*sys.argv[1:]))
