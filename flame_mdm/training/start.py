"""Starts or resumes a training run in its directory. This module does not import torch."""

from contextlib import nullcontext
from pathlib import Path
from typing import Any

from flame_mdm.config import Config, compose, flatten, movable, moved, read_saved, recipes
from flame_mdm.errors import UserError, shortened

FREE = (
    "callbacks",
    "logger",
    "data_root",
    "data.root",
    "data.num_workers",
    "data.resident",
    "data.source.path",
    "data.source.workers",
    "task.checkpoint_activations",
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
"""Keys that may differ when a run is resumed, because they change neither the model nor its training."""


def train(config: Config) -> None:
    """Trains the composed experiment, or resumes the run in its directory.

    Raises `SystemExit` if training is interrupted.
    """
    folder = Path(config["run"]["dir"])
    if (folder / "config.yaml").exists():
        _check_same(folder, config)

    from lightning.pytorch.utilities import rank_zero_only

    from flame_mdm.training.fit import fit
    from flame_mdm.training.guards import only_run

    with only_run(folder) if rank_zero_only.rank == 0 else nullcontext():
        fit(folder, config)


def recipe_changes(config: Config) -> list[str]:
    """Returns "key=value" for each key whose value in a configuration differs from its recipe.

    Some keys are not compared: the seed, keys that may differ when a run is resumed, and keys that
    are missing from the configuration because a different version wrote it. If the class of a part
    differs, the other keys of this part are left out. If the recipe is not in `experiments/`, the
    result is empty.
    """
    name = config.get("experiment")
    if name not in recipes():
        return []
    recipe = _flat(movable(compose(name)))
    model = {
        key: value
        for key, value in _flat(config).items()
        if not key.startswith((*FREE, "run", "seed"))
    }
    changed = {key: value for key, value in model.items() if value != recipe.get(key)}
    replaced = tuple(key.removesuffix("_target_") for key in changed if key.endswith("._target_"))
    return [
        f"{key}={shortened(str(value), 60)}"
        for key, value in sorted(changed.items())
        if key.endswith("._target_") or not key.startswith(replaced)
    ]


def _check_same(folder: Path, config: Config) -> None:
    there, here = movable(read_saved(folder / "config.yaml")), movable(config)
    saved, requested = flatten(there), flatten(here)
    saved_below, requested_below = _flat(there), _flat(here)
    differing = [
        f"{key} ({saved.get(key, 'absent')} there, {requested.get(key, 'absent')} here)"
        for key in sorted(saved.keys() | requested.keys())
        if saved.get(key) != requested.get(key)
        and saved_below.get(key) != requested_below.get(key)
        and not key.startswith(FREE)
    ]
    if differing:
        raise UserError(
            f"{folder} contains a run with a different configuration: {'; '.join(differing)}. Choose another name with "
            "run.name=..., or delete that folder"
        )


def _flat(config: Config) -> dict[str, Any]:
    """Flattens a configuration in which a placeholder stands for the data root in all paths."""
    root = config.get("data_root")
    return flatten(moved(config, {str(root): "${data_root}"}) if root else config)
