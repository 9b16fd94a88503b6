"""Command line of `train`: recipes composed by Hydra, sweeps, and jobs for Hydra's launchers."""

import shutil
import sys
from collections.abc import Callable, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

from hydra import main as hydra_main
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig

from flame_mdm.config import composition
from flame_mdm.config.building import plain
from flame_mdm.config.command_line import STOP, guarded, make_variables
from flame_mdm.config.composition import LAUNCH, quoted
from flame_mdm.config.signatures import Config
from flame_mdm.errors import UserError, say
from flame_mdm.safe_io.paths import check_tree

SWEEP = ("-m", "--multirun")  # with these options, values separated by commas define a sweep
QUIET = ["hydra/job_logging=disabled", "hydra/hydra_logging=disabled", "hydra.output_subdir=null"]

# Signals that end training before its first step, after which training handles signals itself.
INTERRUPT = STOP[:1]


def run_recipe(command: Callable[[Config], None], usage: str, argv: Sequence[str]) -> int:
    """Runs a command line `RECIPE key=value ... [--multirun]` and returns the exit code.

    `launch=...` passes the jobs of a sweep, or a single job, to a launcher and waits for them.
    """
    words = make_variables() if "--from-make" in argv else list(argv)
    if not words or any(word in ("-h", "--help") for word in words):
        say(*usage.strip().splitlines(), "", "experiments:")
        for folder, names in groupby(
            composition.recipes(), lambda recipe: recipe.rpartition("/")[0]
        ):
            listed = ", ".join(name.rpartition("/")[2] for name in names)
            say(f"  {f'{folder}/' if folder else '':13}{listed}")
        say("parts: " + ", ".join(f"{group}=..." for group in composition.groups()))
        return 0 if words else 2
    codes = [0]
    return guarded(lambda: _serve(command, words, codes), INTERRUPT) or max(codes)


def _serve(command: Callable[[Config], None], words: Sequence[str], codes: list[int]) -> None:
    name, *words = words
    if name.startswith("-") or "=" in name:
        raise UserError(
            f"the first word must be the name of an experiment, such as quickstart, but is '{name}'"
        )
    recipe = composition.find_recipe(name)
    flags = [word for word in words if word.startswith("-")]
    if unknown := [flag for flag in flags if flag not in SWEEP]:
        raise UserError(
            f"unknown option {unknown[0]}. Available: --help, --multirun, and key=value pairs"
        )
    overrides, base = composition.prepare_overrides(
        recipe, [word for word in words if word not in flags]
    )
    parsed = composition.parse(overrides)
    launcher = [str(o.value()) for o in parsed if o.key_or_group == LAUNCH]
    sweep = bool(launcher or flags)
    lists = [str(o.input_line) for o in parsed if o.is_sweep_override()]
    if lists and not sweep:
        raise UserError(
            f"{lists[0]}: several values define a sweep with one run per value. Add --multirun, "
            f"or use a single value"
        )
    config = composition.resolve(
        recipe, [composition.first_choice(o) for o in parsed] if sweep else overrides, base
    )
    _check_whole(config, name)
    if "local" in launcher and config["trainer"].get("devices", 1) != 1:
        raise UserError(
            "launch=local runs each job in one process. Remove launch, or trainer.devices"
        )

    def start(config: Config, task: Sequence[str]) -> int:
        # Lightning starts its additional processes with these command-line arguments.
        sys.argv = [sys.argv[0], "train", name, *task, quoted(f"run.dir={config['run']['dir']}")]
        codes.append(guarded(lambda: command(config), INTERRUPT))
        return codes[-1]

    if not sweep:
        start(config, [word for word in overrides if not word.startswith("hydra.")])
        return

    def job(_: object) -> None:
        hydra = HydraConfig.get()
        # Otherwise, Lightning would add arguments for Hydra's command line
        HydraConfig.instance().cfg = None
        task = [
            str(word)
            for word in hydra.overrides.task
            if not str(word).lstrip("+").startswith(f"{LAUNCH}=")
        ]
        code = start(
            composition.compose(name, [*task, quoted(f"run.dir={hydra.runtime.output_dir}")]), task
        )
        # A signal ends the entire sweep, whereas a failed job ends it only if a launcher ran the
        # job.
        if code > 128 or (launcher and code):
            raise SystemExit(code)

    fixed = [repr(o.key_or_group) for o in parsed if not o.is_sweep_override()]
    output = [
        "hydra.sweep.dir=${run.dir}",
        "hydra.sweep.subdir=${hydra.job.override_dirname}",
        f"hydra.job.config.override_dirname.exclude_keys=[{','.join(fixed)}]",
    ]
    check_launcher(launcher)
    if launcher:
        say(f"waiting for the jobs; their output is in {config['run']['dir']}/.submitit")
    # Hydra and the launchers overwrite files in this folder in place
    check_tree(Path(config["run"]["dir"]))
    hydra_sweep(job, recipe.folder, recipe.stem, [*output, *overrides])


def check_launcher(launchers: Sequence[str]) -> None:
    """Raises `UserError` if a launcher cannot start jobs on this machine."""
    if "slurm" in launchers and shutil.which("srun") is None:
        raise UserError(
            "launch=slurm: this machine has no srun. Run the command on a SLURM cluster, or use launch=local"
        )


def hydra_sweep(
    job: Callable[[Any], None], folder: Path, stem: str | None, words: Sequence[str]
) -> None:
    """Runs the jobs of a sweep with Hydra.

    Args:
        job: function that is called with the composed configuration of each job.
        folder: folder of the configuration.
        stem: name of the configuration file, without suffix, or None for an empty configuration.
        words: Hydra overrides, which may contain several values to sweep over.
    """
    sys.argv = [sys.argv[0], "--multirun", *words, *QUIET]
    GlobalHydra.instance().clear()
    hydra_main(version_base="1.3", config_path=str(folder), config_name=stem)(job)()


LATE = ("val_check_interval", "log_every_n_steps", "accumulate_grad_batches")
"""Keys of the trainer that Lightning checks only after the data and the model are loaded."""


def _check_whole(config: Config, name: str) -> None:
    """Raises `UserError` if a recipe is incomplete or a value would cause an error later."""
    plain(config, name)  # otherwise, the run's checkpoints would be rejected
    parts = ["trainer", "data", "representation", "task", "optimizer"]
    parts += [key for key in ("denoiser", "process", "condition") if key in config]
    lacking = [key for key in ("experiment", "seed", "ema", "logger") if key not in config]
    lacking += [
        key for key in ("run", "callbacks", *parts) if not isinstance(config.get(key), Mapping)
    ]
    if not lacking:
        lacking = [f"{key}._target_" for key in parts if "_target_" not in config[key]]
        lacking += ["run.dir"] * (not config["run"].get("dir"))
        lacking += ["trainer.max_steps"] * ("max_steps" not in config["trainer"])
    if lacking:
        raise UserError(
            f"{name}: {lacking[0]} is missing. Set it, or start the recipe with a `defaults:` "
            f"list that names another recipe or /base"
        )
    for key, value in config.get("denoiser", {}).items():
        if isinstance(value, int) and value < 0:
            raise UserError(f"denoiser.{key}={value}: must not be negative")
    for key in LATE:
        value = config["trainer"].get(key)
        if isinstance(value, int | float) and value <= 0:
            raise UserError(f"trainer.{key}={value}: must be greater than 0")
    if isinstance(config["seed"], int) and not 0 <= config["seed"] < 2**32:
        raise UserError(f"seed={config['seed']}: must be between 0 and {2**32 - 1}")
