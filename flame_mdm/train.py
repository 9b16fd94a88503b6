"""Trains an experiment: `python -m flame_mdm.train NAME key=value ...`"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flame_mdm.config import Config, UserError, flatten, instantiate, run, save

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
    checkpoint = folder / "checkpoints" / "last.ckpt"
    _same_run(folder, config)

    import torch
    from hydra.utils import get_class
    from lightning import Trainer, seed_everything
    from lightning.pytorch.callbacks import EMAWeightAveraging

    from flame_mdm.callbacks import Interrupted, Progress
    from flame_mdm.task import read_checkpoint

    _quiet()
    torch.set_float32_matmul_precision("high")
    step = read_checkpoint(checkpoint)["global_step"] if checkpoint.exists() else 0
    most = config["trainer"]["max_steps"]
    if 0 <= most <= step:
        print(f"{folder} is trained to step {step} already: raise trainer.max_steps, or start anew with run.name=...")
        return
    seed_everything(config["seed"], verbose=False)
    representation = instantiate(config["representation"])
    data = instantiate(config["data"], representation=representation, seed=config["seed"])
    task: Task = get_class(config["task"]["_target_"]).build(config, representation, actions=data.source.actions)
    data.prepare_data()
    store = data.open()
    task.facts |= {
        "dataset": store.info["dataset"],
        "fingerprint": store.fingerprint,
        "max_frames": data.crop.longest(),
    }
    callbacks = [instantiate(c) for c in config["callbacks"].values() if c]
    if config["ema"]:
        # First in the list: others see averaged weights in validation. Buffers are copied, not averaged.
        callbacks.insert(0, EMAWeightAveraging(use_buffers=False, **config["ema"]))
    if config["trainer"].get("enable_progress_bar", True):
        callbacks.append(Progress())
    logger = instantiate(config["logger"]) if config["logger"] else False
    trainer: Trainer = instantiate(
        config["trainer"],
        logger=logger,
        callbacks=callbacks,
        default_root_dir=str(folder),
        enable_model_summary=False,
    )
    if trainer.is_global_zero:
        save(_movable(config), folder / "config.yaml", head="A saved run: train it again with EXP=path/to/this/file")
        (folder / "provenance.json").write_text(json.dumps(_provenance(task), indent=2) + "\n")
        _introduce(config, task, trainer, store.info, step)
    try:
        trainer.fit(task, data, ckpt_path=str(checkpoint) if step else None, weights_only=True)
    except Interrupted as stop:
        print(f"stopped at step {stop.step}; the same command goes on from there")
        raise SystemExit(128 + stop.signum) from None


def _movable(node: Any, folder: str | None = None) -> Any:
    """The configuration with paths in the run's folder written in terms of `run.dir`, so that it can be changed."""
    if isinstance(node, dict):
        inside = folder or node["run"]["dir"]
        return {k: v if folder is None and k == "run" else _movable(v, inside) for k, v in node.items()}
    if isinstance(node, str) and folder and node.startswith(folder):
        return "${run.dir}" + node.removeprefix(folder)
    return node


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
    for message in (".*does not have many workers.*", ".*Checkpoint directory .* exists and is not empty.*"):
        warnings.filterwarnings("ignore", message)


def _introduce(config: Config, task: Task, trainer: Any, data: dict[str, Any], step: int) -> None:
    count = sum(p.numel() for p in task.parameters() if p.requires_grad)
    size = config["data"]["batch_size"] * trainer.world_size * trainer.accumulate_grad_batches
    clips = data["clips"]
    device = f"{trainer.world_size} x {trainer.strategy.root_device.type}"
    model = f"{task.describe()}, {count / 1e6:.2f} M trainable parameters"
    splits = f"{clips['train']} clips to train on, {clips['val']} to validate, {clips['test']} to test"
    epochs = trainer.max_steps * size / clips["train"]
    print(f"{config['experiment']}: {model}, on {device}")
    print(
        f"data: {data['dataset']} as {data['representation']}: {splits}; {data['hours']} hours; {data['fingerprint']}"
    )
    print(f"steps: {step} to {trainer.max_steps} of {size} clips, about {epochs:.0f} passes over the data")


def _provenance(task: Task) -> dict[str, Any]:
    import platform
    import subprocess
    from importlib.metadata import version

    def git(*words: str) -> str | None:
        result = subprocess.run(["git", *words], capture_output=True, text=True, cwd=Path(__file__).parent, check=False)
        return result.stdout.strip() if result.returncode == 0 else None

    packages = ("flame-mdm", "torch", "lightning", "torchmetrics", "transformers", "numpy", "scipy")
    return {
        "command": sys.argv,
        "commit": git("rev-parse", "HEAD"),
        "changed": git("status", "--porcelain", "--untracked-files=no"),
        "python": platform.python_version(),
        "machine": platform.platform(),
        "packages": {name: version(name) for name in packages},
        "data": task.facts,
    }


if __name__ == "__main__":
    sys.exit(main())
