"""Start of a training run in its directory, or its continuation. This module does not import torch."""

from contextlib import nullcontext
from pathlib import Path

from flame_mdm.config import Config, flatten, movable, read_saved
from flame_mdm.errors import UserError

FREE = (
    *("callbacks", "logger", "data_root", "data.root", "data.num_workers", "data.resident"),
    *("data.source.path", "data.source.workers"),
    *("trainer.max_steps", "trainer.max_time", "trainer.devices", "trainer.num_nodes", "trainer.accelerator"),
    *("trainer.strategy", "trainer.log_every_n_steps", "trainer.val_check_interval", "trainer.limit_val_batches"),
    "trainer.enable_progress_bar",
)
"""Keys that may differ when a run is resumed."""


def train(config: Config) -> None:
    """Trains the composed experiment, or resumes the run in its directory; an interruption raises `SystemExit`."""
    folder = Path(config["run"]["dir"])
    if (folder / "config.yaml").exists():
        _check_same(folder, config)

    from lightning.pytorch.utilities import rank_zero_only

    from flame_mdm.training.fit import fit
    from flame_mdm.training.guards import only_run

    with only_run(folder) if rank_zero_only.rank == 0 else nullcontext():
        fit(folder, config)


def _check_same(folder: Path, config: Config) -> None:
    saved, requested = flatten(movable(read_saved(folder / "config.yaml"))), flatten(movable(config))
    differing = [
        f"{key} ({saved.get(key, 'absent')} there, {requested.get(key, 'absent')} here)"
        for key in sorted(saved.keys() | requested.keys())
        if saved.get(key) != requested.get(key) and not key.startswith(FREE)
    ]
    if differing:
        raise UserError(
            f"{folder} holds a run with another configuration: {'; '.join(differing)}. Choose another name with "
            "run.name=..., or delete that folder"
        )
