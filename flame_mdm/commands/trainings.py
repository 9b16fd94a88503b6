"""Training runs of a benchmark, each in its own process; several can run in parallel."""

import os
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

from flame_mdm.config import compose, flatten
from flame_mdm.data.parallel import cores
from flame_mdm.errors import UserError, say
from flame_mdm.safe_io.paths import open_in_place

GIB_PER_JOB = 2.0
"""Free memory, in GiB, required to start another training run in parallel."""
POLL = 0.2
"""Time in seconds between two checks of the running processes."""


@dataclass
class Training:
    """A training run of a benchmark.

    Attributes:
        words: arguments of `flame-mdm train`.
        folder: the run directory.
        needs: indices of earlier training runs whose files this run reads.
    """

    words: Sequence[str]
    folder: str
    needs: set[int] = field(default_factory=set)

    @property
    def title(self) -> str:
        """The arguments, joined into one line."""
        return " ".join(self.words)


def plan(entries: Sequence[Sequence[str]], data_root: str) -> list[Training]:
    """Returns the training runs of a benchmark.

    A run depends on an earlier run if its configuration contains a path in that run's directory.
    """
    root = [f"data_root={data_root}"] if data_root else []
    trainings: list[Training] = []
    for name, *overrides in entries:
        config = compose(name, [*overrides, *root])
        texts = [value for value in flatten(config).values() if isinstance(value, str)]
        needs = {
            number
            for number, earlier in enumerate(trainings)
            if any(
                text == earlier.folder or text.startswith(f"{earlier.folder}/") for text in texts
            )
        }
        trainings.append(Training([name, *overrides, *root], config["run"]["dir"], needs))
    return trainings


def run_trainings(trainings: Sequence[Training], jobs: int, logs: Path) -> None:
    """Trains the models of a benchmark, at most `jobs` at a time.

    With several jobs, each run gets an equal share of the cores and writes its output to a file in
    `logs`. A run starts in parallel with others only if at least `GIB_PER_JOB` GiB of memory are
    free. The batches and random draws of a run do not depend on other runs.

    Raises:
        UserError: If a run fails. The other runs are stopped and can be resumed.
        SystemExit: If a run is interrupted.
    """
    environment = dict(os.environ)
    if jobs > 1:
        environment.setdefault("OMP_NUM_THREADS", str(max(1, cores() // jobs)))
    waiting, ended = dict(enumerate(trainings)), set[int]()
    running: dict[int, subprocess.Popen[bytes]] = {}
    with ExitStack() as files:
        try:
            while waiting or running:
                ready = [number for number, job in waiting.items() if job.needs <= ended]
                for number in ready:
                    if len(running) >= jobs or (running and not _has_memory()):
                        break
                    job = waiting.pop(number)
                    say(f"== training {job.title}")
                    output = None
                    if jobs > 1:
                        path = logs / f"{number + 1}_{job.words[0].replace('/', '_')}.log"
                        say(f"   output: {path}")
                        output = files.enter_context(open_in_place(path))
                    command = [sys.executable, "-m", "flame_mdm", "train", *job.words]
                    running[number] = subprocess.Popen(
                        command, env=environment, stdout=output, stderr=output
                    )
                for number, process in list(running.items()):
                    if process.poll() is not None:
                        del running[number]
                        _check(trainings[number], process.returncode)
                        ended.add(number)
                time.sleep(POLL)
        finally:
            for process in running.values():
                process.terminate()  # saves a checkpoint
            for process in running.values():
                process.wait()


def _has_memory() -> bool:
    import torch

    from flame_mdm.data.resident import free_memory

    return free_memory(torch.device("cpu")) >= GIB_PER_JOB * 2**30


def _check(training: Training, code: int) -> None:
    if code >= 128 or code < 0:
        raise SystemExit(code if code > 0 else 128 - code)
    if code:
        raise UserError(
            f"training of {training.title} failed (see its output). Run the benchmark again to continue"
        )
