"""Kills training, preparation and evaluation at random times and resumes them.

Usage: `python tests/support/kill_resume.py [kills]`, by default 20 kills of each command. Signals alternate between
SIGKILL and SIGTERM; every fourth kill of training is a SIGKILL halfway through writing a checkpoint. Training is killed
after a random number of steps plus up to 50 ms, the other commands at a random time up to the duration of an
uninterrupted run; kills that come too late do not count. The final outputs must equal those of uninterrupted runs:
weights bit for bit, the fingerprint of the data, the JSON of the evaluation except for measured times. Otherwise the
exit code is 1. Processes are forked from one that has imported everything.
"""

from __future__ import annotations

import contextlib
import io
import json
import multiprocessing
import os
import random
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from flame_mdm.checkpoints.model_files import read_checkpoint
from flame_mdm.commands import evaluate, prepare, train
from flame_mdm.data.store import Store
from flame_mdm.task import MotionGeneration
from flame_mdm.training import callbacks, checkpointing

STEPS = 400
RECIPE = [
    *("data.source.clips=60", "data.batch_size=4", "denoiser.latent_dim=16", "denoiser.ff_size=16"),
    *("denoiser.num_layers=1", "denoiser.num_heads=2", "denoiser.dropout=0.1", "condition.features=16"),
    *("process.num_train_timesteps=10", "task.num_inference_steps=5", "trainer.accelerator=cpu", "logger=csv"),
    *("trainer.enable_progress_bar=false", "trainer.val_check_interval=50", "callbacks.samples=null"),
    *("callbacks.best=null", "callbacks.checkpoints.every_n_steps=10", f"trainer.max_steps={STEPS}"),
]
STORE = "synthetic-humanml-clean-smpl22"


class Kill:
    """A signal to this process after `steps` of training and `seconds`; with `writing`, inside the next checkpoint."""

    def __init__(self, seconds: float, signum: int, steps: int = 0, writing: bool = False):
        self.seconds, self.signum, self.steps, self.writing = seconds, signum, steps, writing

    def __str__(self) -> str:
        when = f"{self.steps} steps, {1000 * self.seconds:.0f} ms" if self.steps else f"{self.seconds:.2f} s"
        return f"{signal.Signals(self.signum).name} | {when}" + ", writing" * self.writing

    def start(self) -> None:
        timer = threading.Timer(self.seconds, os.kill, (os.getpid(), self.signum))
        timer.daemon = True
        timer.start()

    def step(self) -> None:
        self.steps -= 1
        if self.steps == 0:
            self._break_writing() if self.writing else self.start()

    def _break_writing(self) -> None:
        save = torch.save

        def half(checkpoint: object, file: io.BufferedWriter) -> None:
            whole = io.BytesIO()
            save(checkpoint, whole)
            file.write(whole.getvalue()[: len(whole.getvalue()) // 2])
            file.flush()
            os.kill(os.getpid(), self.signum)

        checkpointing.torch.save = half


def work(main: Callable[[list[str]], int], words: list[str], kill: Kill | None, log: Path) -> None:
    """Runs a command in this process until it is killed."""
    with log.open("w") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
        if kill is not None and main is train.main:
            MotionGeneration.on_train_batch_end = lambda self, outputs, batch, batch_idx: kill.step()
        elif kill is not None:
            kill.start()
        code = main(words)
        sys.stdout.flush()
    os._exit(code)


class Trials:
    """Runs commands in a folder, each in a separate process; prints a table and records whether all went well."""

    def __init__(self, folder: Path):
        self.folder, self.good = folder, True
        self.draw = random.Random(0)

    def run(self, main: Callable[[list[str]], int], words: list[str], kill: Kill | None = None) -> tuple[int, float]:
        """Returns exit code and seconds; without a kill, the command must succeed."""
        begin = time.monotonic()
        arguments = (main, words, kill, self.folder / "log")
        process = multiprocessing.get_context("fork").Process(target=work, args=arguments)
        process.start()
        process.join()
        code = process.exitcode or 0
        if code and kill is None:
            print((self.folder / "log").read_text())
            raise SystemExit(1)
        return code, time.monotonic() - begin

    def kill(self, number: int, longest: float, steps: int = 0, writing: bool = False) -> Kill:
        """Returns the next kill: after up to `longest` seconds, and after 1 to `steps` steps of training if given."""
        seconds = self.draw.uniform(0.0, longest)
        signum = signal.SIGTERM if number % 2 else signal.SIGKILL
        return Kill(seconds, signum, self.draw.randint(1, steps) if steps else 0, writing)

    def row(self, number: int, kill: Kill, code: int, found: str, good: bool = True) -> None:
        names = {-signal.SIGKILL: "killed", -signal.SIGTERM: "ended", 128 + signal.SIGTERM: "stopped"}
        good = good and code in names
        self.good &= good
        print(f"| {number + 1} | {kill} | {names.get(code, f'exit code {code}')} | {found} |" + " WRONG" * (not good))
        if code not in names:
            print((self.folder / "log").read_text())

    def verdict(self, what: str, good: bool) -> None:
        self.good &= good
        print(f"\n{what}: {good}\n")


def head(title: str, found: str) -> None:
    print(f"{title}\n\n| kill | signal | when | outcome | {found} |\n|---|---|---|---|---|")


def training(trials: Trials, kills: int) -> None:
    folder = trials.folder

    def words(name: str) -> list[str]:
        return ["quickstart", *RECIPE, f"data_root={folder / 'data'}", f"run.dir={folder / name}"]

    _, seconds = trials.run(train.main, words("whole"))
    head(f"Training, {STEPS} steps in {seconds:.1f} s without interruption", "resumes from")
    for number in range(kills):
        # So few steps that all kills come before the end.
        kill = trials.kill(number, 0.05, 2 * STEPS // (kills + 6), writing=number % 4 == 2)
        code, _ = trials.run(train.main, words("killed"), kill)
        with contextlib.redirect_stdout(io.StringIO()) as said:
            resumed = checkpointing.newest(folder / "killed" / "checkpoints")
        step = resumed.step if resumed else 0
        trials.row(number, kill, code, f"step {step} {said.getvalue().strip()}")
    trials.run(train.main, words("killed"))
    ends = [read_checkpoint(folder / name / "checkpoints" / "last.ckpt") for name in ("whole", "killed")]
    equal = ends[0]["global_step"] == ends[1]["global_step"] and all(
        torch.equal(ends[0][part][key], value)
        for part in ("state_dict", "current_model_state")
        for key, value in ends[1][part].items()
    )
    trials.verdict("resumed to the end; weights equal bit for bit", equal)


def preparation(trials: Trials, kills: int) -> None:
    def words(root: Path) -> list[str]:
        return ["data=synthetic", "data.source.clips=150", f"data_root={root}"]

    _, seconds = trials.run(prepare.main, words(trials.folder / "prepared"))
    wanted = Store(trials.folder / "prepared" / STORE).info
    head(f"Preparation, {seconds:.1f} s without interruption", "left behind; result of the next run")
    for number in range(kills):
        root = trials.folder / f"prepared{number}"
        code = 0
        while code == 0:
            shutil.rmtree(root, ignore_errors=True)
            kill = trials.kill(number, seconds)
            code, _ = trials.run(prepare.main, words(root), kill)
        left = sorted(path.name for path in root.iterdir()) if root.exists() else []
        # A folder with the name of the store must be complete.
        whole = STORE not in left or Store(root / STORE).info == wanted
        trials.run(prepare.main, words(root))
        same = Store(root / STORE).info == wanted and [path.name for path in root.iterdir()] == [STORE]
        trials.row(
            number, kill, code, f"{', '.join(left) or 'nothing'}; {'the same' if same else 'DIFFERENT'}", whole and same
        )
        shutil.rmtree(root)
    print()


def evaluation(trials: Trials, kills: int) -> None:
    checkpoint = trials.folder / "whole" / "checkpoints" / "last.ckpt"

    def words(name: str) -> list[str]:
        run = trials.folder / name
        if not run.exists():
            run.mkdir()
            shutil.copy(checkpoint, run)
        options = [
            "protocol=synthetic",
            "extractor=none",
            "replications=3",
            "split=train",
            "batch_size=4",
            "samples=16",
        ]
        return [
            f"ckpt={run / 'last.ckpt'}",
            *options,
            f"data_root={trials.folder / 'data'}",
            f"out={run / 'result.json'}",
        ]

    def result(name: str) -> dict[str, Any]:
        report = json.loads((trials.folder / name / "result.json").read_text())
        report["checkpoint"].pop("path")
        for name in ("command", "commit", "changed"):  # the code may be edited meanwhile
            report["environment"].pop(name)
        report["cost"].pop("seconds_per_sample")
        return report

    _, seconds = trials.run(evaluate.main, words("evaluated"))
    wanted = result("evaluated")
    head(f"Evaluation, {seconds:.1f} s without interruption", "replications kept")
    equal, name = True, ""
    for number in range(kills):
        if number % 4 == 0:  # start over, after three runs that resumed from a killed one
            name = f"evaluated{number}"
        code = 0
        while code == 0:
            kill = trials.kill(number, 0.7 * seconds)
            code, _ = trials.run(evaluate.main, words(name), kill)
            if code == 0:
                shutil.rmtree(trials.folder / name)
        kept = [path.name for path in (trials.folder / name).rglob("*.npz") if path.name.startswith("rep_")]
        trials.row(number, kill, code, str(len(kept)))
        if number % 4 == 3 or number == kills - 1:
            trials.run(evaluate.main, words(name))
            equal &= result(name) == wanted
    trials.verdict("evaluated to the end; results equal except for measured times", equal)


def main(kills: int) -> int:
    """Prints the tables of outcomes; returns the exit code."""
    torch.set_num_threads(1)
    assert callbacks  # imported here, so that no fork imports it again
    with tempfile.TemporaryDirectory() as name:
        trials = Trials(Path(name))
        for part in (training, preparation, evaluation):
            part(trials, kills)
    print("all equal to uninterrupted runs" if trials.good else "NOT EQUAL TO UNINTERRUPTED RUNS")
    return 0 if trials.good else 1


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]) if len(sys.argv) > 1 else 20))
