"""Startup time of commands: `python benchmarks/startup.py [runs]`, medians of 2 runs by default.

`--help` and a misspelled key answer without importing torch. The work itself is minimal (one training step, one motion,
one replication of eight motions), so that mainly imports and preparation are measured. Ratios are relative to
`python -c "import torch"`, to compare machines.
"""

import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from sections import Row, Section, section, show

TINY = [
    *("data.source.clips=60", "data.batch_size=8", "denoiser.latent_dim=16", "denoiser.ff_size=16"),
    *("denoiser.num_layers=1", "denoiser.num_heads=2", "condition.features=16", "process.num_train_timesteps=10"),
    *("task.num_inference_steps=5", "trainer.accelerator=cpu", "trainer.enable_progress_bar=false", "logger=csv"),
    *("callbacks.samples=null", "callbacks.best=null", "trainer.max_steps=1", "data_root=data"),
]
CKPT = "ckpt=first/checkpoints/last.ckpt"


def seconds(folder: Path, *words: str) -> float:
    """Returns the duration of one process."""
    begin = time.monotonic()
    done = subprocess.run([sys.executable, *words], capture_output=True, text=True, cwd=folder, check=False)
    if "Traceback" in done.stderr:
        raise SystemExit(done.stderr)
    return time.monotonic() - begin


def measure(*words: str) -> Section:
    """Measures with the number of runs in `words`."""
    runs = int(words[0]) if words else 2
    os.environ["OMP_NUM_THREADS"] = "1"
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        seconds(folder, "-m", "flame_mdm", "train", "quickstart", *TINY, "run.dir=first")  # also prepares the data
        evaluation = ["protocol=synthetic", "extractor=none", "quick=true", "replications=1", "samples=8"]
        work: dict[str, tuple[list[str], list[str]]] = {  # the second list differs from run to run
            "train": (["quickstart", *TINY], ["run.dir=run{}"]),
            "sample": ([CKPT, "text=a person walks", "samples=1", "seconds=0.5"], ["out=samples{}"]),
            "evaluate": ([CKPT, *evaluation, "data_root=data"], ["seed={}", "out=result{}.json"]),
        }
        lines = {"python -c 'import torch'": (["-c", "import torch"], list[str]())}
        for command, (line, varying) in work.items():
            module = ["-m", "flame_mdm", command]
            lines[f"{command} --help"] = ([*module, "--help"], [])
            lines[f"{command}, misspelled key"] = ([*module, *line[: command == "train"], "seeed=1"], [])
            lines[f"{command}, minimal work"] = ([*module, *line], varying)
        rows: list[Row] = []
        times: list[float] = []
        for name, (line, varying) in lines.items():
            runs_of = ([*line, *(word.format(number) for word in varying)] for number in range(runs))
            times.append(statistics.median(seconds(folder, *run) for run in runs_of))
            rows.append({"command": f"`{name}`", "seconds": times[-1], "ratio": times[-1] / times[0]})
    return section(
        "Start of the commands",
        "From the start of a process to its end, one thread. The work is minimal (one training step, one motion, one "
        f"replication of eight motions), so that mainly imports are measured. Median of {runs}; "
        "ratios to importing torch.",
        f"`--help` answers in {times[1]:.1f} s, and a training starts in {times[3] / times[0]:.1f} times the time of "
        "importing torch.",
        commands=rows,
    )


if __name__ == "__main__":
    show(measure(*sys.argv[1:]))
