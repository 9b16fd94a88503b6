"""Loggers: a metrics file in the run directory, TensorBoard, and Weights & Biases."""

import io
import json
import secrets
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lightning.pytorch.loggers import Logger, TensorBoardLogger, WandbLogger
from lightning.pytorch.utilities import rank_zero_only
from omegaconf import OmegaConf
from typing_extensions import TypedDict

from flame_mdm.config import Config
from flame_mdm.runs import HISTORY, records
from flame_mdm.safe_io import write_json, write_text
from flame_mdm.safe_io.paths import open_in_place
from flame_mdm.schemas import read_json


class History(Logger):
    """Appends all logged values to `metrics.jsonl` in the run directory.

    Lightning counts steps from 0. A run that resumes after `step` steps keeps the lines for steps 0
    to `step` - 1 and drops the later lines.
    """

    def __init__(self, folder: str | Path, step: int = 0):
        super().__init__()
        self.path, self.step = Path(folder) / HISTORY, step
        self.begun = False

    @property
    def name(self) -> str:
        """Name of the logger in Lightning."""
        return "history"

    @property
    def version(self) -> str:
        """Empty, because all parts of a run share one file."""
        return ""

    @rank_zero_only
    def log_hyperparams(self, *args: Any, **kwargs: Any) -> None:
        """Does nothing, because the hyperparameters are in `config.yaml`."""

    @rank_zero_only
    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Appends a line of metrics.

        A resumed run first drops the lines for the steps that it repeats.
        """
        if not self.begun:
            kept = [line for line in records(self.path) if line["step"] < self.step]
            write_text(self.path, "".join(json.dumps(line) + "\n" for line in kept))
            self.begun = True
        with open_in_place(self.path) as file:
            file.write(json.dumps({"step": step, **metrics}) + "\n")


class TensorBoardRun(TensorBoardLogger):
    """TensorBoard logger that omits Lightning's `epoch`.

    The epoch is always 0, because training is a single pass over randomly drawn batches.
    """

    @rank_zero_only
    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Logs metrics without the epoch."""
        super().log_metrics(
            {name: value for name, value in metrics.items() if name != "epoch"}, step
        )


class Kept(TypedDict, total=False):
    """Contents of `wandb.json`: the id of the run, the last step, and the number of rows."""

    id: str
    step: int | None
    rows: int


class WandbRun(WandbLogger):
    """Weights & Biases logger that continues its wandb run when training is resumed.

    Steps that the run repeats are not logged again.
    """

    def __init__(self, save_dir: str, **options: Any):
        self.path = Path(save_dir) / "wandb.json"
        kept = (
            read_json(self.path, Kept, "delete it to start a new wandb run")
            if self.path.exists()
            else {}
        )
        step = kept.get("step")
        self.logged_step, self.rows = -1 if step is None else step, kept.get("rows", 0)
        super().__init__(
            save_dir=save_dir, **{"id": kept.get("id") or secrets.token_hex(4), **options}
        )
        self._wandb_init.pop("anonymous")  # wandb warns about this variable even if it is not set

    @rank_zero_only
    def log_metrics(self, metrics: Mapping[str, Any], step: int | None = None) -> None:
        """Logs metrics, except for steps that were logged before the run was resumed."""
        if step is not None and step < self.logged_step:
            return
        # For each offline part, Weights & Biases numbers the rows from 0 again.
        if self.experiment.step < self.rows:
            self.experiment.log({}, step=self.rows)
        super().log_metrics(metrics, step)
        write_json(
            self.path,
            {"id": self.experiment.id, "step": step, "rows": self.experiment.step},
            indent=None,
        )

    @rank_zero_only
    def finalize(self, status: str) -> None:
        """Ends the wandb run, because the next run of a sweep uses the same process."""
        super().finalize(status)
        if self._experiment is not None:
            self._experiment.finish(exit_code=int(status != "success"))
            self._experiment = None


def log_config(logger: Logger, config: Config, facts: Mapping[str, Any]) -> None:
    """Logs the recipe and the provenance of a run."""
    if isinstance(logger, TensorBoardLogger):
        for name, content in (("config", config), ("provenance", facts)):
            text = OmegaConf.to_yaml(OmegaConf.create(dict(content)))
            logger.experiment.add_text(name, "".join(f"    {line}\n" for line in text.splitlines()))
    elif isinstance(logger, WandbLogger):
        logger.log_hyperparams({**config, "provenance": dict(facts)})


def log_table(
    logger: Logger, name: str, head: Sequence[str], rows: Sequence[Sequence[Any]], step: int
) -> None:
    """Logs a table with the given name and step."""
    if isinstance(logger, TensorBoardLogger):
        lines = [head, ["---"] * len(head), *rows]
        logger.experiment.add_text(
            name, "\n".join(f"| {' | '.join(map(str, line))} |" for line in lines), step
        )
    elif isinstance(logger, WandbLogger):
        logger.log_table(name, columns=list(head), data=[list(row) for row in rows], step=step)


def log_video(logger: Logger, name: str, gif: Path, step: int) -> None:
    """Logs an animated GIF with the given name and step."""
    if isinstance(logger, TensorBoardLogger):
        from PIL import Image
        from tensorboard.compat.proto.summary_pb2 import Summary  # type: ignore[attr-defined]

        data = gif.read_bytes()
        width, height = Image.open(io.BytesIO(data)).size
        image = Summary.Image(height=height, width=width, colorspace=3, encoded_image_string=data)
        summary = Summary(value=[Summary.Value(tag=name, image=image)])
        logger.experiment._get_file_writer().add_summary(summary, step)
    elif isinstance(logger, WandbLogger):
        import wandb

        logger.log_metrics({name: wandb.Video(str(gif), format="gif")}, step)  # type: ignore[dict-item]
