"""Run provenance: command, code version, machine, package versions and data."""

import platform
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from lightning import Callback, LightningModule, Trainer

from flame_mdm.config import Config, movable, save
from flame_mdm.data.datamodule import MotionDataModule
from flame_mdm.errors import say
from flame_mdm.runs import PROVENANCE, Provenance
from flame_mdm.safe_io import write_json
from flame_mdm.schemas import read_json
from flame_mdm.task import Task
from flame_mdm.training.loggers import log_config

PACKAGES = ("flame-mdm", "torch", "lightning", "torchmetrics", "transformers", "numpy", "scipy")


class WriteProvenance(Callback):
    """Writes and logs the recipe and the provenance when training starts, and prints a summary."""

    def __init__(self, config: Config):
        self.config = config

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Writes the recipe and the provenance to the run directory and the loggers."""
        if not trainer.is_global_zero:
            return
        assert isinstance(pl_module, Task)
        folder = Path(self.config["run"]["dir"])
        save(
            movable(self.config),
            folder / "config.yaml",
            head="The configuration of a run. EXP=path/to/this/file repeats the run.",
        )
        facts = environment() | {
            "device": device_name(trainer),
            "parameters": sum(p.numel() for p in pl_module.parameters() if p.requires_grad),
            "data": {
                k: v
                for k, v in pl_module.facts.items()
                if k not in ("vocabulary", "verbs", "captions")
            },
        }
        if trainer.global_step and (folder / PROVENANCE).exists():
            before: Provenance = read_json(folder / PROVENANCE, Provenance, "delete it to resume")
            kinds = {"commit": "code", "changed": "uncommitted changes", "packages": "packages"}
            if different := [
                kind for name, kind in kinds.items() if getattr(before, name) != facts[name]
            ]:
                say(
                    f"resuming with different {' and '.join(different)}: results may differ from the results "
                    "of an uninterrupted run"
                )
        write_json(folder / PROVENANCE, facts)
        for logger in trainer.loggers:
            log_config(logger, self.config, facts)
        clips = self.config["data"]["batch_size"]
        size = clips * trainer.world_size * trainer.accumulate_grad_batches
        module: MotionDataModule = trainer.datamodule  # type: ignore[attr-defined]
        data, speed = module.store.info, self.config["run"].get("speed", "reference")
        size_in_millions = facts["parameters"] / 1e6
        say(
            f"{self.config['experiment']}: {pl_module.describe()}, {size_in_millions:.2f} M trainable parameters"
        )
        say(f"data: {data['dataset']} as {data['representation']}; {data['hours']} hours")
        say(*module.counts(module.store))
        say(f"device: {facts['device']}, {trainer.precision}, speed={speed}")
        if size > clips:
            times = (
                f"{trainer.world_size} processes x {trainer.accumulate_grad_batches} accumulated"
            )
            lr = self.config["optimizer"].get("lr")
            say(
                f"batch: {size} clips = {clips} x {times}; optimizer.lr={lr} is not scaled with the batch size"
            )
        passes = trainer.max_steps * size / len(module.train)
        say(
            f"steps: {trainer.global_step} to {trainer.max_steps}, {size} clips per step, {passes:.0f} epochs"
        )


def device_name(trainer: Trainer) -> str:
    """Returns the number of processes and their device, such as "1 x AMD EPYC, 2 threads"."""
    where = trainer.strategy.root_device
    name = torch.cuda.get_device_name(where) if where.type == "cuda" else where.type
    if where.type == "cpu":
        threads = torch.get_num_threads()
        processor = torch.cpu.get_capabilities().get("cpu_name") or platform.machine()
        name = f"{processor}, {threads} thread{'s' if threads > 1 else ''}"
    return f"{trainer.world_size} x {name}"


def environment() -> dict[str, Any]:
    """Returns the command, code version, machine and package versions.

    They are recorded with every run and every result.
    """
    return {
        "command": sys.argv,
        "commit": _git("rev-parse", "HEAD"),
        "changed": _git("status", "--porcelain", "--untracked-files=no"),
        "python": platform.python_version(),
        "machine": platform.platform(),
        "packages": {name: version(name) for name in PACKAGES},
    }


def _git(*words: str) -> str | None:
    try:
        folder = Path(__file__).parent
        result = subprocess.run(
            ["git", *words], capture_output=True, text=True, cwd=folder, check=False
        )
    except FileNotFoundError:  # this machine has no git
        return None
    return result.stdout.strip() if result.returncode == 0 else None
