"""Trains a recipe: assembles data, task, callbacks and trainer, and handles errors."""

import logging
import os
import signal
import subprocess
import warnings
from pathlib import Path
from typing import Any

import torch
from hydra.utils import get_class
from lightning import Callback, Trainer, seed_everything
from lightning.fabric.plugins.environments.slurm import SLURMEnvironment
from lightning.fabric.plugins.environments.torchelastic import TorchElasticEnvironment
from lightning.pytorch.utilities import rank_zero_only

from flame_mdm.checkpoints.adapters import attach, copy_matching_weights, copy_weights
from flame_mdm.checkpoints.loading import NO_GPU
from flame_mdm.config import Config, instantiate
from flame_mdm.data.datamodule import MotionDataModule
from flame_mdm.errors import UserError, first_line, say
from flame_mdm.task import GeneratorTask, Task
from flame_mdm.training.averaging import MovingAverage
from flame_mdm.training.callbacks import Interrupted, Measurements, Progress, Report
from flame_mdm.training.checkpointing import AtomicCheckpoints, Resumed, check_optimizers, newest
from flame_mdm.training.guards import lost_worker, out_of_memory
from flame_mdm.training.loggers import History
from flame_mdm.training.overhead import NoProfiler, skip_empty_hooks, skip_exchange_of_signals
from flame_mdm.training.provenance import WriteProvenance
from flame_mdm.training.speed import accelerate

SHARDING = ("fsdp", "deepspeed", "modelparallel")
"""Substrings of the names of strategies that shard a model."""


def fit(folder: Path, config: Config) -> None:
    """Trains a recipe in its run directory.

    Resumes from the newest checkpoint if there is one.
    """
    _quiet()
    check_devices(config["trainer"])
    torch.set_float32_matmul_precision("high")
    resumed = newest(folder / "checkpoints")
    step = resumed.step if resumed else 0
    if 0 <= config["trainer"]["max_steps"] <= step:
        say(
            f"{folder}: already trained for {step} steps. Increase trainer.max_steps, or start a new "
            "run with run.name=..."
        )
        return
    seed_everything(config["seed"], verbose=False)
    representation = instantiate(config["representation"])
    data: MotionDataModule = instantiate(
        config["data"], representation=representation, seed=config["seed"]
    )
    if resumed:
        _check_same_data(resumed, data)
    task: Task = get_class(config["task"]["_target_"]).build(
        config, representation, actions=data.actions
    )
    if isinstance(task, GeneratorTask):
        if config.get("adapter"):
            attach(task.generator, config["adapter"])
        if config.get("base") and not resumed:
            copy_weights(task.generator, config["base"])
        if config.get("initial_weights") and not resumed:
            _start_from(task, config["initial_weights"])
    precision = config["trainer"]["precision"]
    if config["run"].get("speed") == "fast":
        precision = accelerate(task, data, config)
    measurements, checkpoints = Measurements(), AtomicCheckpoints(folder / "checkpoints", resumed)
    callbacks: list[Callback] = [WriteProvenance(config)]
    if config["ema"]:
        # This callback comes before those that use the averaged weights in validation.
        callbacks.append(MovingAverage(**config["ema"]))
    callbacks += [instantiate(c) for c in config["callbacks"].values() if c]
    # The progress bar shows values that `measurements` has logged.
    shown = [Progress()] if config["trainer"].get("enable_progress_bar", True) else []
    callbacks += [measurements, *shown, Report(folder)]
    loggers = [instantiate(config["logger"])] if config["logger"] else []
    plugins: list[Any] = [checkpoints]
    if SLURMEnvironment.detect() and not TorchElasticEnvironment.detect():
        # Lightning would save during a step, to a file that it would then prefer to `last.ckpt`.
        plugins.append(SLURMEnvironment(auto_requeue=False))
    unless_chosen = {} if config["trainer"].get("profiler") else {"profiler": NoProfiler()}
    trainer: Trainer = instantiate(
        config["trainer"]
        | {"precision": precision, "enable_progress_bar": False},  # replaced with `Progress`
        **unless_chosen,
        logger=[*loggers, History(folder, step)],
        callbacks=callbacks,
        plugins=plugins,
        default_root_dir=str(folder),
        enable_model_summary=False,
    )
    skip_empty_hooks(trainer, task)
    skip_exchange_of_signals(trainer)
    try:
        if resumed:
            check_optimizers(resumed, task.make_optimizer())
        trainer.fit(task, data, ckpt_path=resumed.path if resumed else None, weights_only=True)
    except Interrupted as stop:
        # The first process reports the error. Launchers treat any other exit code as a crash.
        if not trainer.is_global_zero:
            return
        say(f"stopped at step {stop.step}. Run the same command to resume")
        if stop.signum in (signal.SIGUSR1, signal.SIGUSR2) and (
            job := os.environ.get("SLURM_JOB_ID")
        ):
            _requeue(job)
        raise SystemExit(128 + stop.signum) from None
    except (Exception, SystemExit) as error:
        # Otherwise, the other processes would wait half an hour for this process.
        if trainer.strategy.launcher is not None:
            trainer.strategy.launcher.kill(signal.SIGKILL)
        if isinstance(error, SystemExit):  # a second signal
            say("stopped immediately. Run the same command to resume from the last checkpoint")
        if explained := (data.num_workers and lost_worker(error)) or out_of_memory(
            error, trainer.global_step
        ):
            raise explained from error
        is_restoring = checkpoints.resumed is None and not measurements.begin
        if resumed and is_restoring and not isinstance(error, UserError | OSError | SystemExit):
            raise UserError(
                f"{resumed.path} is damaged: it does not match the recipe ({first_line(error)}). "
                "Delete this file to resume from another checkpoint"
            ) from error
        raise


def check_devices(trainer: Config) -> None:
    """Raises `UserError` if this machine lacks the devices that a recipe requires, or if the recipe shards the model.

    A recipe for the CPU may use at most one process per core.
    """
    _check_strategy(trainer.get("strategy", "auto"))
    accelerator, devices = trainer.get("accelerator", "auto"), trainer.get("devices", 1)
    has_mps = torch.backends.mps.is_available() and accelerator in ("auto", "gpu")
    gpus, cores = 1 if has_mps else torch.cuda.device_count(), os.cpu_count() or 1
    if accelerator in ("gpu", "cuda") and not gpus:
        raise UserError(
            f"trainer.accelerator={accelerator}: {NO_GPU}. Remove this key to train on the CPU"
        )
    most = gpus if gpus and accelerator != "cpu" else cores
    if accelerator in ("gpu", "cuda", "auto") and isinstance(devices, int) and devices > most:
        there = f"this machine has {most} " + (
            f"GPU{'s' * (most > 1)}" if gpus else f"CPU cores, and {NO_GPU}"
        )
        raise UserError(f"trainer.devices={devices}: {there}. Use at most trainer.devices={most}")


def _check_strategy(strategy: str | Config) -> None:
    name = strategy if isinstance(strategy, str) else str(strategy.get("_target_"))
    if any(kind in name.lower().replace("_", "") for kind in SHARDING):
        raise UserError(
            f"trainer.strategy={name}: models cannot be divided among processes, because averaging and exact resuming "
            "need whole weights. Use trainer.strategy=ddp; docs/memory.md lists how much memory models need"
        )


def _start_from(task: GeneratorTask, source: str) -> None:
    try:
        copied, count = copy_matching_weights(task.generator, source)
    except FileNotFoundError as error:
        raise UserError(
            f"initial_weights={error}. Train it first, choose another model, or start from random weights: "
            "initial_weights=null"
        ) from error
    say(f"initial weights: {copied} of {count} tensors from {source}")


def _requeue(job: str) -> None:
    try:
        subprocess.run(["scontrol", "requeue", job], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError) as error:
        say(
            f"error: job {job} cannot be requeued: {getattr(error, 'stderr', error)}. Submit it again",
            error=True,
        )
    else:
        say(f"job {job} was requeued")


def _check_same_data(resumed: Resumed, data: MotionDataModule) -> None:
    if rank_zero_only.rank:
        return
    data.prepare_data()
    before, now = resumed.content["facts"].get("fingerprint"), data.open().fingerprint
    if before not in (None, now):
        raise UserError(
            f"{resumed.path}: trained on data with fingerprint {before}, but {data.folder} has fingerprint {now}. "
            "Start another run with run.name=..., or prepare the original data again"
        )


def _quiet() -> None:
    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    for message in (
        ".*isinstance\\(treespec, LeafSpec\\).*",  # warnings from Lightning
        ".*does not have many workers.*",
        ".*module\\(s\\) in eval mode at the start of training.*",  # a student without dropout
        ".*Checkpoint directory .* exists and is not empty.*",
        # Lightning warns if the run directory was moved. The next validation determines the best
        # checkpoint again.
        "The dirpath has changed.*",
        ".*sync_dist=True.*",  # the metrics are already means over all processes
    ):
        warnings.filterwarnings("ignore", message)
