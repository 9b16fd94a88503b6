"""Compares two ways of loading batches with a training step: `python benchmarks/loading.py`.

A synthetic data set is prepared in a temporary folder. Three measurements alternate: batches
gathered from memory (data.resident=true), batches from a data loader in the training process, and
training steps of the small MDM encoder (forward pass, backward pass and update). Their CPU time on
one core is measured, which excludes other programs on the machine. For data loaders with workers,
wall time is measured instead. Wall time includes passing batches between processes and depends on
the load of the machine.
"""

import itertools
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator

import torch
from sections import Row, Section, Settings, section, show, take_turns

from flame_mdm.batch import Condition, MotionBatch
from flame_mdm.data.crops import Units
from flame_mdm.data.datamodule import MotionDataModule
from flame_mdm.data.synthetic import Synthetic
from flame_mdm.denoisers.mdm import MDMEncoder
from flame_mdm.losses import masked_mse
from flame_mdm.representations.humanml import HumanML

BATCH = 64
GOAL = 5000  # target in clips per second per worker
STEP, LOADER, RESIDENT = "step", "loader, one core", "resident, one core"


def training(features: int) -> Callable[[MotionBatch], None]:
    """Returns a training step (forward pass, backward pass, update) of the small MDM encoder."""
    model = MDMEncoder(
        features, features, 512, latent_dim=128, ff_size=256, num_layers=4, num_heads=4, dropout=0.0
    )
    optimizer = torch.optim.AdamW(model.parameters(), fused=True)

    def step(batch: MotionBatch) -> None:
        cond = Condition(torch.zeros(len(batch), 512), torch.zeros(len(batch), 0, 512), None)
        output = model(torch.randn_like(batch.x), torch.rand(len(batch)) * 1000, batch.mask, cond)
        masked_mse(output, batch.x, batch.mask).mean().backward()
        optimizer.step()
        optimizer.zero_grad()

    return step


def batches_of(data: MotionDataModule, resident: bool, workers: int = 0) -> Iterator[MotionBatch]:
    """Returns an iterator over training batches.

    Args:
        data: the data set.
        resident: True gathers batches from memory, and False loads them with a data loader.
        workers: number of worker processes of the data loader.
    """
    data.resident, data.num_workers = resident, workers
    data.setup("fit")
    return iter(data.train_dataloader())


def measure(settings: Settings) -> Section:
    """Times the loading of batches and returns the page section."""
    clips, count, rounds = (100, 3, 1) if settings.quick else (1000, 20, 5)
    torch.manual_seed(0)
    torch.set_num_threads(1)

    def several(batches: Iterator[MotionBatch]) -> Callable[[], object]:
        return lambda: [next(batches) for _ in range(count)]

    with tempfile.TemporaryDirectory() as folder:
        source, crop = Synthetic(clips), Units(24, 60, 4)
        data = MotionDataModule(
            source, HumanML(), root=folder, name="s", batch_size=BATCH, crop=crop
        )
        data.prepare_data()
        loaded, gathered = batches_of(data, resident=False), batches_of(data, resident=True)

        shown = [next(loaded) for _ in range(8)]
        step, endless = training(shown[0].x.shape[2]), itertools.cycle(shown)
        turns = {
            RESIDENT: several(gathered),
            LOADER: several(loaded),
            STEP: lambda: [step(next(endless)) for _ in range(len(shown))],
        }
        times = take_turns(turns, rounds, clock=time.process_time)
        wait = times.pop(STEP) / len(shown)

        rows = [_row(name, taken / count, wait, 1) for name, taken in times.items()]
        for workers in (1, 2):
            name = f"loader, {workers} worker{'s' if workers > 1 else ''}, wall time"
            taken = take_turns(
                {name: several(batches_of(data, resident=False, workers=workers))}, rounds
            )[name]
            rows.append(_row(name, taken / count, wait, workers))

    lengths = torch.cat([batch.lengths for batch in shown]).float().mean()
    frames = statistics.mean(batch.x.shape[1] for batch in shown)
    gather, load = times[RESIDENT] / count, times[LOADER] / count
    return section(
        "Batch loading",
        f"""A batch contains {BATCH} clips with {shown[0].x.shape[2]} features per frame. The clips have
        {lengths:.0f} frames on average and are padded to {frames:.0f} frames. Resident batches (`data.resident=true`)
        are gathered from memory. The loader collates clips in the training process or in workers. A training step of
        the small MDM encoder takes {1000 * wait:.0f} ms on one core. The target is {GOAL:,} clips per second per
        worker. Values are medians over {rounds} rounds of {count} batches each.""",
        f"Gathering a resident batch is {load / gather:.1f} times as fast as preparing it in the loader, "
        f"and takes {100 * gather / wait:.1f} % of the time of a small training step.",
        {"batches": rows},
    )


def _row(name: str, seconds: float, step: float, workers: int) -> Row:
    """Returns a table row with the speed of one loader, compared with a training step and with the target.

    Args:
        name: label of the loader.
        seconds: time per batch.
        step: time of a training step in seconds.
        workers: number of workers.
    """
    rate = BATCH / seconds
    return {
        "batches": name,
        "ms per batch": 1000 * seconds,
        "share of a step": f"{seconds / step:.1%}",
        "clips per second": rate,
        "ratio to the target": rate / workers / GOAL,
    }


if __name__ == "__main__":
    show(measure(Settings()))
