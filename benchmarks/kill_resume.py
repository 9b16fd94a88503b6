"""Kills training at random moments and resumes it: `python benchmarks/kill_resume.py [kills]`, 20 by default.

Each kill is SIGKILL, every fourth one while a checkpoint is being written. The weights at the end must be those of an
uninterrupted run, bit for bit; exit code 1 otherwise. Processes are forked off one that has imported everything.
"""

import contextlib
import io
import multiprocessing
import os
import random
import signal
import sys
import tempfile
import threading
import time
from pathlib import Path

import torch

from flame_mdm import callbacks, guards, train
from flame_mdm.task import read_checkpoint

STEPS = 400
RECIPE = [
    *("data.source.clips=60", "data.batch_size=4", "denoiser.latent_dim=16", "denoiser.ff_size=16"),
    *("denoiser.num_layers=1", "denoiser.num_heads=2", "denoiser.dropout=0.1", "condition.features=16"),
    *("process.num_train_timesteps=10", "task.num_inference_steps=5", "trainer.accelerator=cpu", "logger=csv"),
    *("trainer.enable_progress_bar=false", "trainer.val_check_interval=50", "callbacks.samples=null"),
    *("callbacks.best=null", "callbacks.checkpoints.every_n_steps=10", f"trainer.max_steps={STEPS}"),
]


def run(words: list[str], seconds: float, writing: bool, out: Path) -> None:
    """Trains in this process, which kills itself after so many seconds; if `writing`, inside the next checkpoint."""
    with out.open("w") as log, contextlib.redirect_stdout(log), contextlib.redirect_stderr(log):
        if writing:
            save = torch.save

            def half(checkpoint: object, file: io.BufferedWriter) -> None:
                if time.monotonic() < begin + seconds:
                    save(checkpoint, file)
                    return
                whole = io.BytesIO()
                save(checkpoint, whole)
                file.write(whole.getvalue()[: len(whole.getvalue()) // 2])
                file.flush()
                os.kill(os.getpid(), signal.SIGKILL)

            guards.torch.save = half
        elif seconds < float("inf"):
            timer = threading.Timer(seconds, os.kill, (os.getpid(), signal.SIGKILL))
            timer.daemon = True
            timer.start()
        begin = time.monotonic()
        code = train.main(["quickstart", *words])
        log.flush()
    os._exit(code)


def main(kills: int) -> int:
    """Prints the table of outcomes; returns the exit code."""
    torch.set_num_threads(1)
    assert callbacks  # imported here, so that no fork imports it again
    fork, draw = multiprocessing.get_context("fork"), random.Random(0)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)

        def train_in(run_dir: str, seconds: float = float("inf"), writing: bool = False) -> tuple[int | None, float]:
            words = [*RECIPE, f"data_root={folder / 'data'}", f"run.dir={folder / run_dir}"]
            begin = time.monotonic()
            process = fork.Process(target=run, args=(words, seconds, writing, folder / "log"))
            process.start()
            process.join()
            return process.exitcode, time.monotonic() - begin

        code, whole = train_in("whole")
        if code:
            print((folder / "log").read_text())
            return 1
        print(f"uninterrupted: {STEPS} steps in {whole:.1f} s\n")
        print("| kill | when | outcome | goes on from |\n|---|---|---|---|")
        for number in range(kills):
            # As long as a few checkpoints take on average, so that all kills come before the end.
            writing, seconds = number % 4 == 3, draw.uniform(0.0, 2 * whole / (kills + 2) + 0.5)
            code, _ = train_in("killed", seconds, writing)
            with contextlib.redirect_stdout(io.StringIO()) as said:
                step = guards.newest(folder / "killed" / "checkpoints")[1]
            outcome = {-signal.SIGKILL: "killed", 0: "was done before"}.get(code or 0, f"exit code {code}")
            when = f"{seconds:.2f} s" + ", writing" * writing
            print(f"| {number + 1} | {when} | {outcome} | step {step} {said.getvalue().strip()} |")
        code, _ = train_in("killed")
        ends = [read_checkpoint(folder / run_dir / "checkpoints" / "last.ckpt") for run_dir in ("whole", "killed")]
        equal = ends[0]["global_step"] == ends[1]["global_step"] and all(
            torch.equal(ends[0][part][key], value)
            for part in ("state_dict", "current_model_state")
            for key, value in ends[1][part].items()
        )
        print(f"\nresumed to the end: exit code {code}; equal bit for bit: {equal}")
        return 0 if equal and code == 0 else 1


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]) if len(sys.argv) > 1 else 20))
