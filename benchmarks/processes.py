"""Times training steps with one process and with two gloo processes: `python benchmarks/processes.py`.

Both runs use the same batches of 16 clips. A single process receives all 16 clips, and each of two
processes receives 8 clips. Each process has one thread. With one core per process, the ideal ratio
of the times is 0.5. If two processes share one core, the ratio cannot be below 1. The overhead
consists of reducing the gradients and waiting for the slower process. Times are measured from the
end of one step to the end of the next, so they do not include imports.
"""

import json
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

from sections import QUIET, Section, Settings, ratios, section, show

CLIPS = 16  # number of clips per step
SMALL = [
    "data.source.clips=60",
    "condition.pretrain_steps=0",
    "denoiser.latent_dim=128",
    "denoiser.ff_size=256",
    "denoiser.num_layers=4",
    "denoiser.num_heads=4",
    "data_root=data",
]
CLOCK = """
import itertools
import json
import time
from pathlib import Path

from lightning import Callback


class Clock(Callback):
    def __init__(self, warm: int):
        self.warm, self.times = warm, []

    def on_train_batch_end(self, trainer, *_):
        self.times.append(time.perf_counter())

    def on_train_end(self, trainer, *_):
        if trainer.is_global_zero:
            steps = [after - before for before, after in itertools.pairwise(self.times[self.warm :])]
            Path("steps.json").write_text(json.dumps(steps))
"""


def step_seconds(folder: Path, processes: int, steps: int, number: int) -> float:
    """Trains with one or two processes and returns the median time per step in seconds.

    Args:
        folder: folder for the run, which contains clock.py.
        processes: 1 or 2.
        steps: number of training steps; the first fifth is not counted.
        number: number of the round, for the name of the run.
    """
    words = [
        "quickstart",
        *QUIET,
        *SMALL,
        f"trainer.max_steps={steps}",
        f"run.dir=run{processes}-{number}",
    ]
    words += [
        f"data.batch_size={CLIPS // processes}",
        f"+callbacks.clock={{_target_: clock.Clock, warm: {steps // 5}}}",
    ]
    if processes == 2:
        words += ["trainer.devices=2", "trainer.strategy=ddp"]

    paths = [str(folder), os.environ.get("PYTHONPATH", "")]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(paths)}
    environment |= {"GLOO_SOCKET_IFNAME": "lo"}
    command = [sys.executable, "-m", "flame_mdm", "train", *words]
    finished = subprocess.run(
        command, capture_output=True, text=True, cwd=folder, env=environment, check=False
    )
    if finished.returncode:
        raise SystemExit(finished.stdout + finished.stderr)
    return statistics.median(json.loads((folder / "steps.json").read_text()))


def measure(settings: Settings) -> Section:
    rounds, steps = (1, 10) if settings.quick else (2, 60)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "clock.py").write_text(CLOCK)
        pairs = [
            [step_seconds(folder, count, steps, number) for count in (1, 2)]
            for number in range(rounds)
        ]

    one, two = (statistics.median(values) for values in zip(*pairs, strict=True))
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return section(
        "Two processes",
        f"""The same batches of {CLIPS} clips are processed by one process, and by two processes with {CLIPS // 2} clips
        each (DDP, gloo). Each process has one thread, and the machine has {cores} cores. With one core per process,
        the ideal ratio is 0.5. Values are medians over {rounds} runs of {steps} steps each.""",
        f"For the same batch, two processes take {two / one:.2f} times as long as one process.",
        {"steps": ratios({"one": one, "two": two}, "one", "processes")},
    )


if __name__ == "__main__":
    show(measure(Settings()))
