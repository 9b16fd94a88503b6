"""Trains an experiment: `python -m flame_mdm.train NAME key=value ...`"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flame_mdm.config import Config, UserError, flatten, instantiate, run

if TYPE_CHECKING:
    from flame_mdm.task import Task

USAGE = """
usage: python -m flame_mdm.train NAME [key=value ...] [--multirun]

Trains the experiment NAME (a file of experiments/, or the path of a recipe or of a saved config.yaml).
key=value changes one key (trainer.max_steps=1000), part=name swaps a part (denoiser=mdm_decoder).
The same command in the same folder resumes; run.name=other starts another run.
"""

FREE = (
    "data.num_workers",
    "data.root",
    "data.source.path",
    "data.source.workers",
    "data_root",
    "callbacks",
    "logger",
    "trainer.max_steps",
    "trainer.max_time",
    "trainer.devices",
    "trainer.num_nodes",
    "trainer.accelerator",
    "trainer.strategy",
    "trainer.log_every_n_steps",
    "trainer.val_check_interval",
    "trainer.limit_val_batches",
    "trainer.enable_progress_bar",
)
"""Keys that may differ when a run is resumed."""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    return run(train, sys.argv[1:] if argv is None else argv, usage=USAGE)


def train(config: Config) -> None:
    """Trains the composed experiment, resuming what its folder holds.

    Raises:
        UserError: the folder holds a run of another configuration, or the data or the recipe is unusable.
        SystemExit: interrupted; the checkpoint is written and the code is 128 + the signal's number.
    """
    folder = Path(config["run"]["dir"])
    _same_run(folder, config)

    from lightning.pytorch.utilities import rank_zero_only

    from flame_mdm.guards import only_run

    with only_run(folder) if rank_zero_only.rank == 0 else nullcontext():
        _fit(folder, config)


def _fit(folder: Path, config: Config) -> None:
    import torch
    from hydra.utils import get_class
    from lightning import Callback, Trainer, seed_everything
    from lightning.fabric.plugins.environments.slurm import SLURMEnvironment
    from lightning.fabric.plugins.environments.torchelastic import TorchElasticEnvironment
    from lightning.pytorch.callbacks import EMAWeightAveraging

    from flame_mdm.callbacks import Interrupted, Measurements, Progress, Report
    from flame_mdm.dashboards import History
    from flame_mdm.guards import WholeCheckpoints, newest, out_of_memory
    from flame_mdm.provenance import Provenance

    _quiet()
    torch.set_float32_matmul_precision("high")
    checkpoint, step = newest(folder / "checkpoints")
    most = config["trainer"]["max_steps"]
    if 0 <= most <= step:
        print(f"{folder} is trained to step {step} already: raise trainer.max_steps, or start anew with run.name=...")
        return
    seed_everything(config["seed"], verbose=False)
    representation = instantiate(config["representation"])
    data = instantiate(config["data"], representation=representation, seed=config["seed"])
    task: Task = get_class(config["task"]["_target_"]).build(config, representation, actions=data.actions)
    callbacks: list[Callback] = [Provenance(config)]
    if config["ema"]:
        # Before those that look at averaged weights in validation. Buffers are copied, not averaged.
        callbacks.append(EMAWeightAveraging(use_buffers=False, **config["ema"]))
    callbacks += [instantiate(c) for c in config["callbacks"].values() if c]
    if config["trainer"].get("enable_progress_bar", True):
        callbacks.append(Progress())
    callbacks += [Measurements(), Report(folder)]
    loggers = [instantiate(config["logger"])] if config["logger"] else []
    plugins: list[Any] = [WholeCheckpoints()]
    if SLURMEnvironment.detect() and not TorchElasticEnvironment.detect():
        # Lightning would save in the middle of a step, to a file that it then prefers to ours.
        plugins.append(SLURMEnvironment(auto_requeue=False))
    trainer: Trainer = instantiate(
        config["trainer"],
        logger=[*loggers, History(folder, step)],
        callbacks=callbacks,
        plugins=plugins,
        default_root_dir=str(folder),
        enable_model_summary=False,
    )
    try:
        trainer.fit(task, data, ckpt_path=checkpoint, weights_only=True)
    except Interrupted as stop:
        if (
            not trainer.is_global_zero
        ):  # the first process tells; what starts processes takes any other code for a crash
            return
        print(f"stopped at step {stop.step}; the same command goes on from there")
        if stop.signum in (signal.SIGUSR1, signal.SIGUSR2):
            _requeue()
        raise SystemExit(128 + stop.signum) from None
    except Exception as error:
        if trainer.strategy.launcher is not None:  # else the processes it started wait for this one for half an hour
            trainer.strategy.launcher.kill(signal.SIGKILL)
        if told := out_of_memory(error, callbacks, trainer.global_step):
            raise told from error
        raise


def _requeue() -> None:
    """Puts the SLURM job that this is back into the queue."""
    job = os.environ.get("SLURM_JOB_ID")
    if job is None:
        return
    command = ["scontrol", "requeue", job]
    try:
        result = subprocess.run(command, capture_output=True, text=True, check=False)
        failure = result.stderr.strip() if result.returncode else None
    except OSError as error:
        failure = str(error)
    if failure is None:
        print(f"job {job} is in the queue again")
    else:
        print(f"error: {' '.join(command)}: {failure}; submit the job again", file=sys.stderr)


def _same_run(folder: Path, config: Config) -> None:
    """Refuses a folder that holds a run of another configuration."""
    if not (folder / "config.yaml").exists():
        return
    from omegaconf import OmegaConf

    saved = flatten(OmegaConf.to_container(OmegaConf.load(folder / "config.yaml"), resolve=True))
    wanted = flatten(config)
    differing = [
        f"{key} ({saved.get(key, 'absent')} there, {wanted.get(key, 'absent')} here)"
        for key in sorted(saved.keys() | wanted.keys())
        if saved.get(key) != wanted.get(key) and not key.startswith(FREE)
    ]
    if differing:
        raise UserError(
            f"{folder} holds a run of another configuration: {'; '.join(differing)}. Give this one a name of its own "
            "with run.name=..., or delete that folder"
        )


def _quiet() -> None:
    """Silences what Lightning says about choices that are made on purpose here."""
    import logging
    import warnings

    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    for message in (
        ".*does not have many workers.*",
        ".*Checkpoint directory .* exists and is not empty.*",
        ".*sync_dist=True.*",  # the metrics are means over all processes already
    ):
        warnings.filterwarnings("ignore", message)


if __name__ == "__main__":
    sys.exit(main())
