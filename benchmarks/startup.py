"""Times how long commands take to start: `python benchmarks/startup.py`.

Commands answer `--help` and report misspelled keys without importing torch. Otherwise, the work is
minimal (one training step, one motion, one replication of eight motions), so that mainly imports and
setup are measured. So that machines can be compared, times are also given relative to the time of
`python -c "import torch"`.
"""

import itertools
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

from sections import Row, Section, Settings, section, show, take_turns

TINY = [
    "data.source.clips=60",
    "data.batch_size=8",
    "denoiser.latent_dim=16",
    "denoiser.ff_size=16",
    "denoiser.num_layers=1",
    "denoiser.num_heads=2",
    "condition.features=16",
    "condition.pretrain_steps=0",
    "process.num_train_timesteps=10",
    "task.num_inference_steps=5",
    "trainer.accelerator=cpu",
    "trainer.enable_progress_bar=false",
    "logger=csv",
    "callbacks.samples=null",
    "callbacks.best=null",
    "trainer.max_steps=1",
    "data_root=data",
]
CHECKPOINT = "ckpt=first/checkpoints/last.ckpt"
EVALUATION = [
    "protocol=synthetic",
    "extractor=none",
    "quick=true",
    "replications=1",
    "samples=8",
    "data_root=data",
]
WORK: dict[str, tuple[list[str], list[str]]] = {
    "train": (["quickstart", *TINY], ["run.dir=run{}"]),
    "sample": ([CHECKPOINT, "text=a person walks", "samples=1", "seconds=0.5"], ["out=samples{}"]),
    "evaluate": ([CHECKPOINT, *EVALUATION], ["seed={}", "out=result{}.json"]),
}
"""Arguments of each command. Those in the second list contain the number of the run."""
TORCH = "python -c 'import torch'"


def run(folder: Path, *words: str) -> None:
    """Runs Python with the given arguments in a folder, and waits until the process ends."""
    command = [sys.executable, *words]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    finished = subprocess.run(
        command, capture_output=True, text=True, cwd=folder, env=environment, check=False
    )
    if "Traceback" in finished.stderr:
        raise SystemExit(finished.stderr)


def minimal_work(folder: Path, command: str, numbers: itertools.count) -> None:
    """Runs a command that does as little work as possible."""
    words, varying = WORK[command]
    number = next(numbers)
    run(folder, "-m", "flame_mdm", command, *words, *(word.format(number) for word in varying))


def measure(settings: Settings) -> Section:
    """Times the startup of commands and returns the page section."""
    commands = ["sample"] if settings.quick else list(WORK)
    rounds = 1 if settings.quick else 2
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        # The training also prepares the data for the other commands.
        run(folder, "-m", "flame_mdm", "train", "quickstart", *TINY, "run.dir=first")

        turns: dict[str, Callable[[], object]] = {TORCH: partial(run, folder, "-c", "import torch")}
        for command in commands:
            recipe = ["quickstart"] if command == "train" else []
            module = ["-m", "flame_mdm", command]
            turns[f"{command} --help"] = partial(run, folder, *module, "--help")
            turns[f"{command}, misspelled key"] = partial(run, folder, *module, *recipe, "seeed=1")
            turns[f"{command}, minimal work"] = partial(
                minimal_work, folder, command, itertools.count()
            )
        times = take_turns(turns, rounds, warm_up=False)

    rows: list[Row] = [
        {"command": f"`{name}`", "seconds": taken, "ratio": taken / times[TORCH]}
        for name, taken in times.items()
    ]
    answered = times[f"{commands[0]} --help"]
    started = times[f"{commands[0]}, minimal work"] / times[TORCH]
    return section(
        "Startup of the commands",
        f"""Times are measured from the start of a process to its end, with one thread. The work is minimal (one
        training step, one motion, one replication of eight motions), so that the times consist mainly of imports.
        Values are medians over {rounds} runs, and ratios are relative to the time for importing torch.""",
        f"`--help` takes {answered:.1f} s, and `{commands[0]}` with minimal work takes {started:.1f} times as "
        "long as importing torch.",
        {"commands": rows},
    )


if __name__ == "__main__":
    show(measure(Settings()))
