"""Scaling of DDP: seconds per step of two gloo processes and of one, `python benchmarks/ddp.py [runs]`.

Both train on the same batches of 16 clips, one process with all 16 and two processes with 8 each, one thread per
process. With one core per process, the ideal ratio is 0.5; two processes on one core cannot be below 1. The overhead is
reducing the gradients and waiting for the slower process. Times are between steps, so they do not include imports.
"""

import json
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

from sections import Section, section, show

STEPS, WARM = 50, 10
SMALL = [
    *("data.source.clips=60", "denoiser.latent_dim=128", "denoiser.ff_size=256", "denoiser.num_layers=4"),
    *("denoiser.num_heads=4", "trainer.accelerator=cpu", "trainer.enable_progress_bar=false", "logger=csv"),
    *("callbacks.samples=null", "callbacks.best=null", f"trainer.max_steps={STEPS}", "data_root=data"),
    *("trainer.val_check_interval=1000", f"callbacks.checkpoints.every_n_steps={STEPS}"),
    f"+callbacks.clock={{_target_: clock.Clock, warm: {WARM}}}",
]
CLOCK = """
import json
import time

from lightning import Callback


class Clock(Callback):
    def __init__(self, warm: int):
        self.warm, self.times = warm, []

    def on_train_batch_end(self, trainer, *_):
        self.times.append(time.perf_counter())

    def on_train_end(self, trainer, *_):
        if trainer.is_global_zero:
            steps = [b - a for a, b in zip(self.times[self.warm :], self.times[self.warm + 1 :])]
            open("steps.json", "w").write(json.dumps(steps))
"""


def step_seconds(folder: Path, processes: int, run: int) -> float:
    """Returns the median time between steps in seconds."""
    words = ["quickstart", *SMALL, f"data.batch_size={16 // processes}", f"run.dir=run{processes}-{run}"]
    words += ["trainer.devices=2", "trainer.strategy=ddp"] if processes == 2 else []
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(folder), "GLOO_SOCKET_IFNAME": "lo"}
    done = subprocess.run(
        [sys.executable, "-m", "flame_mdm", "train", *words],
        capture_output=True,
        text=True,
        cwd=folder,
        env=environment,
        check=False,
    )
    if done.returncode:
        raise SystemExit(done.stdout + done.stderr)
    return statistics.median(json.loads((folder / "steps.json").read_text()))


def measure(*words: str) -> Section:
    """Measures with the number of runs in `words`."""
    runs = int(words[0]) if words else 2
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "clock.py").write_text(CLOCK)
        pairs = [(step_seconds(folder, 1, run), step_seconds(folder, 2, run)) for run in range(runs)]
    one, two = (statistics.median(values) for values in zip(*pairs, strict=True))
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    ratio = statistics.median(two / one for one, two in pairs)
    return section(
        "Two processes",
        "The same batches of 16 clips, by one process and by two with 8 clips each (DDP, gloo), one thread per "
        f"process, on {cores} cores. With one core per process, the ideal ratio is 0.5. Median of {runs} "
        "alternating runs.",
        f"Two processes take {ratio:.2f} times the time of one for the same batch.",
        steps=[
            {"processes": "one", "ms per step": 1000 * one, "ratio": 1},
            {"processes": "two", "ms per step": 1000 * two, "ratio": ratio},
        ],
    )


if __name__ == "__main__":
    show(measure(*sys.argv[1:]))
