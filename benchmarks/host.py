"""Times the framework's share of a training step: `python benchmarks/host.py`.

The network is a transformer with one layer of width 16 and no text encoder, so most of the time is
spent outside the network. The framework is compared with bare Lightning, which trains the same
network with the same masked loss, fused optimizer and gradient clipping on batches in memory. Bare
Lightning logs nothing and has no averaged weights, loggers or checkpoints.

Each training has its own process with one thread. After the first `WARM` steps, the processes take
turns: one of them trains for as many steps as lie between two logs, while the others wait. On
Linux, all turns use the same core. A turn takes a fraction of a second, so a processor that becomes
slower or faster affects all trainings alike. The time of a step is the mean over a turn. It
therefore includes work that is done once for several steps, such as planning batches, logging
values and checking losses. Times are thread times, which exclude waiting. The parts of the
framework's step are timed one by one, without Lightning.
"""

import io
import itertools
import multiprocessing
import os
import statistics
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from functools import partial
from multiprocessing import connection
from operator import truediv
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch
from hydra.utils import get_class
from lightning import Callback, LightningModule, Trainer
from sections import Row, Section, Settings, section, show
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel
from torch.utils.data import DataLoader

from flame_mdm.batch import MotionBatch
from flame_mdm.config import compose, instantiate
from flame_mdm.seeds import seed_generator
from flame_mdm.task import GeneratorTask
from flame_mdm.training.averaging import MovingAverage
from flame_mdm.training.fit import fit

WARM = 50  # number of initial steps that are not counted
TINY = [
    "trainer.accelerator=cpu",
    "trainer.val_check_interval=1000000",
    "callbacks.checkpoints.every_n_steps=1000000",
    "data.source.clips=200",
    "data.source.workers=1",
    "data.batch_size=4",
    "denoiser.latent_dim=16",
    "denoiser.ff_size=16",
    "denoiser.num_layers=1",
    "denoiser.num_heads=2",
    "losses={velocity: 0, foot_contact: 0, bone_length: 0}",
    "lr_decay=0",
    "speed=reference",
    "condition=none",
]
BARE = "bare Lightning, the same network"
PLAIN = "framework without averaged weights"
FRAMEWORK = "framework, complete"
LOOP = "plain PyTorch loop"
BATCHES = 16  # distinct batches for bare Lightning and for the plain loop


class Measured(Exception):
    """Raised to end training as soon as the last step has been timed."""


@dataclass(frozen=True)
class Turns:
    """The turns of one of several processes.

    Attributes:
        length: number of steps in a turn.
        semaphore: released when the turn of this process begins.
        next_semaphore: the semaphore of the process whose turn is next.
    """

    length: int
    semaphore: Any
    next_semaphore: Any

    def wait(self) -> None:
        """Waits until the turn of this process begins. On Linux, all turns use the same core."""
        self.semaphore.acquire()
        # Another program may slow down one of the cores.
        if hasattr(os, "sched_setaffinity"):
            os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})

    def end(self) -> None:
        """Lets the next process train."""
        self.next_semaphore.release()


class Clock(Callback):
    """Measures the mean thread time from the end of one step to the end of the next, for each turn.

    Args:
        steps: number of training steps.
    """

    turns: Turns | None = None
    """The turns of this process. None: one turn with all steps after the warm-up steps."""

    def __init__(self, steps: int) -> None:
        self.first = WARM if self.turns else min(WARM, steps // 2)
        self.last = steps
        self.step, self.begin = 0, 0.0
        self.seconds: list[float] = []

    def on_train_batch_end(self, *_: Any) -> None:
        """Times the turns after the warm-up steps, and ends training after the last step."""
        self.step += 1
        length = self.turns.length if self.turns else self.last - self.first
        if self.step < self.first or (self.step - self.first) % length:
            return
        if self.step > self.first:
            self.seconds.append((time.thread_time() - self.begin) / length)
            if self.turns:
                self.turns.end()
        if self.step == self.last:
            raise Measured
        if self.turns:
            self.turns.wait()
        self.begin = time.thread_time()

    @contextmanager
    def ending(self) -> Iterator[None]:
        """Ends the training in its block without an error as soon as the last step is measured."""
        try:
            yield
        except Measured:
            return
        raise AssertionError("training ended before its last step was measured")


def log_interval() -> int:
    """Returns the number of steps after which the framework logs values."""
    return compose("quickstart", TINY)["trainer"]["log_every_n_steps"]


def built(folder: Path) -> tuple[list[MotionBatch], GeneratorTask]:
    """Returns batches drawn by the framework, and the task that it trains."""
    config = compose("quickstart", [*TINY, f"data_root={folder / 'data'}"])
    representation = instantiate(config["representation"])
    data: Any = instantiate(config["data"], representation=representation, seed=0)
    data.prepare_data()
    data.setup("fit")
    task = get_class(config["task"]["_target_"]).build(config, representation).train()
    return list(itertools.islice(data.train_dataloader(), BATCHES)), task


def loss_of(task: GeneratorTask, batch: MotionBatch) -> Tensor:
    """Returns the mean loss of a batch, computed without Lightning."""
    model = task.generator
    cond = model.condition(batch)
    return model.process.loss(model.denoiser, batch.x, batch.mask, cond, auxiliary=task.losses)[
        "loss"
    ].mean()


class Bare(LightningModule):
    """The framework's network, loss and optimizer in a LightningModule."""

    def __init__(self, task: GeneratorTask):
        super().__init__()
        # The list keeps the task's parameters from being registered a second time
        self.denoiser = task.generator.denoiser
        self.task = [task]

    def training_step(self, batch: MotionBatch, batch_idx: int) -> Tensor:
        """Returns the loss."""
        return loss_of(self.task[0], batch)

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """Returns the recipe's optimizer."""
        return self.task[0].make_optimizer()


def bare(steps: int, folder: Path) -> list[float]:
    """Trains with bare Lightning and returns the seconds per step of each turn."""
    batches, task = built(folder)
    stream = itertools.islice(itertools.cycle(batches), steps)
    clock = Clock(steps)
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
    with clock.ending():
        trainer.fit(Bare(task), DataLoader(list(stream), batch_size=None))  # type: ignore[arg-type]
    return clock.seconds


def framework(steps: int, folder: Path, changes: Sequence[str] = ()) -> list[float]:
    """Trains with the complete framework and returns the seconds per step of each turn.

    Args:
        steps: number of training steps.
        folder: folder for the data and the run.
        changes: additional overrides of the recipe.
    """
    run = Path(tempfile.mkdtemp(dir=folder))
    words = [
        *TINY,
        f"data_root={folder / 'data'}",
        f"run.dir={run}",
        f"trainer.max_steps={steps}",
        *changes,
    ]
    clock = Clock(steps)
    config = compose("quickstart", words)
    config["callbacks"]["clock"] = {"_target_": f"{__name__}.clock"}
    globals()["clock"] = lambda: clock
    with clock.ending(), redirect_stderr(io.StringIO()), redirect_stdout(io.StringIO()):
        fit(run, config)
    return clock.seconds


def loop(steps: int, folder: Path) -> list[float]:
    """Trains the same network in a plain PyTorch loop and returns the seconds per step of each turn."""
    batches, task = built(folder)
    optimizer, parameters = task.make_optimizer(), list(task.parameters())
    clock = Clock(steps)
    with clock.ending():
        for batch in itertools.cycle(batches):
            loss_of(task, batch).backward()
            nn.utils.clip_grad_norm_(parameters, 1.0)
            optimizer.step()
            optimizer.zero_grad()
            clock.on_train_batch_end()
    return clock.seconds


def parts(steps: int, folder: Path) -> dict[str, float]:
    """Returns the median time of each part of a step, in seconds."""
    batches, task = built(folder)
    model = task.generator
    optimizer, parameters = task.make_optimizer(), list(task.parameters())
    average: Any = MovingAverage(0.998)
    average._average_model = AveragedModel(task)
    average.on_train_start(SimpleNamespace(), task)
    times: dict[str, list[float]] = {}

    for step, batch in enumerate(itertools.islice(itertools.cycle(batches), steps)):
        laps = {"": time.thread_time()}
        seed_generator(step, torch.device("cpu"))
        laps["seeding"] = time.thread_time()
        cond = model.condition(batch)
        laps["condition"] = time.thread_time()
        loss = model.process.loss(model.denoiser, batch.x, batch.mask, cond, auxiliary=task.losses)[
            "loss"
        ].mean()
        laps["forward pass and loss"] = time.thread_time()
        loss.backward()
        laps["backward pass"] = time.thread_time()
        nn.utils.clip_grad_norm_(parameters, 1.0)
        laps["clipping gradients"] = time.thread_time()
        optimizer.step()
        optimizer.zero_grad()
        laps["optimizer"] = time.thread_time()
        average.on_train_batch_end(SimpleNamespace(global_step=step + 1), task, None, None, 0)
        laps["averaging weights"] = time.thread_time()

        for (_, before), (name, after) in itertools.pairwise(laps.items()):
            times.setdefault(name, []).append(after - before)
    return {name: statistics.median(taken[len(taken) // 4 :]) for name, taken in times.items()}


TRAININGS: dict[str, Callable[[int, Path], list[float]]] = {
    BARE: bare,
    PLAIN: partial(framework, changes=["ema=null"]),
    FRAMEWORK: framework,
    LOOP: loop,
}


def train(name: str, steps: int, folder: Path, turns: Turns, results: Any) -> None:
    """Runs one of `TRAININGS` in its own process, and puts its name and its times into a queue."""
    warnings.filterwarnings("ignore")
    torch.set_num_threads(1)
    Clock.turns = turns
    results.put((name, TRAININGS[name](steps, folder)))


def alternating(count: int, length: int, folder: Path) -> dict[str, list[float]]:
    """Runs all trainings, which take turns, and returns the seconds per step of each turn.

    Args:
        count: number of turns.
        length: number of steps in a turn.
        folder: folder for the data and the runs.
    """
    context = multiprocessing.get_context("spawn")
    semaphores = [context.Semaphore(0) for _ in TRAININGS]
    results = context.Queue()
    processes = []
    for number, name in enumerate(TRAININGS):
        turns = Turns(length, semaphores[number], semaphores[(number + 1) % len(semaphores)])
        arguments = (name, WARM + count * length, folder, turns, results)
        process = context.Process(target=train, args=arguments, name=name, daemon=True)
        process.start()
        processes.append(process)

    semaphores[0].release()
    running = {process.sentinel: process for process in processes}
    while running:
        for sentinel in connection.wait(list(running)):
            process = running.pop(sentinel)
            process.join()
            if process.exitcode:
                # The other processes would wait forever, and trainings do not end at SIGTERM.
                for other in running.values():
                    other.kill()
                raise SystemExit(f"{process.name}: this training failed")
    taken = dict(results.get() for _ in processes)
    return {name: taken[name] for name in TRAININGS}


def measure(settings: Settings) -> Section:
    """Times the framework's share of a step and returns the page section."""
    count, length = (2, 3) if settings.quick else (40, log_interval())
    warnings.filterwarnings("ignore")
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        built(folder)  # prepares the data for all trainings
        taken = alternating(count, length, folder)
        split = parts(count * length // 2, folder)

    times = {name: statistics.median(values) for name, values in taken.items()}
    relative = {
        name: statistics.median(map(truediv, values, taken[BARE])) for name, values in taken.items()
    }
    rows: list[Row] = [
        {"training": name, "ms per step": 1000 * times[name], "ratio": ratio}
        for name, ratio in relative.items()
    ]
    split["everything else, mostly batches and Lightning"] = times[FRAMEWORK] - sum(split.values())
    shares: list[Row] = [
        {"part": name, "ms": 1000 * value, "share": f"{value / times[FRAMEWORK]:.0%}"}
        for name, value in split.items()
    ]
    return section(
        "Host cost of a training step",
        f"""The network is tiny: it has one transformer layer of width 16 and no text encoder, and is trained on batches
        of 4 clips. A step does almost no arithmetic, so its time consists mainly of the call overhead
        of torch, the framework and Lightning. Bare Lightning trains the same network with the same masked loss, fused
        optimizer and gradient clipping on batches in memory. It logs nothing and has no averaged weights, loggers or
        checkpoints. The complete framework cuts and gathers its batches, checks losses, averages weights, shows its
        progress and logs every {log_interval()} steps. Each training has its own process with one thread. The
        processes take turns of {length} steps on one core. The thread time of a step is measured. Times and ratios are
        medians over {count} turns. For the second table, the parts of the framework's step are timed one by one,
        without Lightning.""",
        f"An almost empty training step takes {1000 * times[FRAMEWORK]:.1f} ms, which is {relative[FRAMEWORK]:.2f} "
        "times as long as in bare Lightning with the same network. Without averaged weights, it takes "
        f"{relative[PLAIN]:.2f} times as long.",
        {"steps": rows, "parts of the framework": shares},
    )


if __name__ == "__main__":
    show(measure(Settings()))
