"""`flame-mdm distill CKPT [OUT] key=value ...`: trains a student model that samples in one to four steps."""

import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from omegaconf import OmegaConf

from flame_mdm.commands import ModelSettings
from flame_mdm.commands.train import USAGE, train
from flame_mdm.config import EXPERIMENTS, Config, movable, save
from flame_mdm.config.options import option
from flame_mdm.config.sweeps import run_recipe
from flame_mdm.errors import UserError
from flame_mdm.safe_io import read_package_yaml
from flame_mdm.safe_io.paths import check_tree

RECIPE = "student.yaml"
"""File name of the student's recipe in its run directory.

All training processes read this file, including the jobs of launchers.
"""
SHARE_OF_STEPS, SHARE_OF_RATE = 0.2, 0.1


@dataclass(frozen=True, kw_only=True)
class DistillSettings(ModelSettings):
    """usage: flame-mdm distill CKPT [OUT] [key=value ...]

    Trains a student of a model that predicts the clean motion or the velocity (MDM, MFM). The
    student samples in 1, 2 or 4 steps, with guidance built in. Its recipe is the model's recipe
    with the keys in experiments/distillation/consistency.yaml, a fifth of the training steps and a
    tenth of the learning rate. The data set is read from FLAME_MDM_DATA or, if that is not set,
    from the data folder in the model's recipe. Keys such as trainer.max_steps=1000 override the
    recipe. Running the same command again resumes the run. --multirun seed=1,2 and launch= start
    sweeps and jobs, as in train. See docs/few-steps.md.
    """

    OBJECTS: ClassVar = ("ckpt", "out")
    COMPOSED: ClassVar = ("seed", "lr_decay", "lr_warmup", "ema", "launch", "-m", "--multirun")
    out: str | None = option(None, "run directory. Default: runs/RECIPE_distilled/default")
    composed: tuple[str, ...] = ()


def main(settings: DistillSettings) -> None:
    """Writes the recipe of a student and trains the student."""
    recipe = student_recipe(settings)
    folder = Path(recipe["run"]["dir"])
    path, new = folder / RECIPE, not folder.exists()
    check_tree(folder)
    save(recipe, path)  # processes on other nodes also read this file
    code = run_recipe(train, USAGE, [str(path), *settings.composed])
    if code and new and not any(folder.rglob("config.yaml")):  # no training started
        shutil.rmtree(folder, ignore_errors=True)
    if code:
        raise SystemExit(code)


def student_recipe(settings: DistillSettings) -> Config:
    """Returns the recipe of a student: the teacher's recipe with changes for distillation.

    Raises `UserError` if the model was not trained with this framework.
    """
    file = settings.model_file()
    from flame_mdm.training.distillation import read_teacher

    teacher = read_teacher(file)
    recipe: Any = teacher.config
    if not teacher.steps or not isinstance(recipe.get("data"), dict) or "trainer" not in recipe:
        raise UserError(
            f"{settings.ckpt} was not trained with this framework, so its data and number of "
            f"training steps are unknown"
        )
    name = f"{recipe['experiment']}_distilled"
    root = os.environ.get("FLAME_MDM_DATA", recipe["data_root"])
    steps = max(1, round(SHARE_OF_STEPS * teacher.steps))
    changes: Config = {
        "experiment": name,
        "data_root": root,
        "data": {"root": root},
        "initial_weights": None,  # the student starts from the weights of its teacher
        "run": {"name": "default", "dir": settings.out or f"runs/{name}/default"},
        "optimizer": {"lr": SHARE_OF_RATE * recipe["optimizer"]["lr"]},
        "trainer": {
            "max_steps": steps,
            "val_check_interval": min(steps, recipe["trainer"]["val_check_interval"]),
        },
        "distillation": {"teacher": str(file)},
    }
    if samples := recipe["callbacks"].get("samples"):
        changes["callbacks"] = {"samples": {"every_n_steps": min(steps, samples["every_n_steps"])}}
    shared = read_package_yaml(EXPERIMENTS / "distillation" / "consistency.yaml")
    merged: Any = OmegaConf.to_container(OmegaConf.merge(movable(recipe), shared, changes))
    return merged
