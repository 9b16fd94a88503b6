# pyright: standard
"""Callback that evaluates a model during training."""

from pathlib import Path
from typing import Any

from lightning import Callback, LightningModule, Trainer

from evaluators.evaluation import Evaluation
from evaluators.plan import sampling_options
from evaluators.protocol import open_protocol
from evaluators.sources import Generator
from flame_mdm.checkpoints.locating import find
from flame_mdm.data.datamodule import MotionDataModule
from flame_mdm.errors import UserError
from flame_mdm.records import Value
from flame_mdm.runs import made_by
from flame_mdm.task import GeneratorTask
from flame_mdm.training.loggers import log_table


class Evaluate(Callback):
    """Evaluates the model on the validation split under a protocol, and logs val/<protocol>/<metric>.

    These values can be used to select checkpoints. Dashboards show each value with its unit as
    val/<protocol>/<metric> (<unit>), next to the value for real motions (.../real). With several
    replications, .../ci is the half width of the 95 % interval.

    The evaluation runs during the first validation, and then during the first validation after each
    multiple of `every_n_steps`. If the recipe averages weights, the averaged weights are evaluated.
    The motions are divided among all ranks. Raises `UserError` before training begins if the
    extractor does not exist.

    Args:
        protocol: the name of a protocol in experiments/evaluation, or the path of a protocol file.
        extractor: source of the protocol's extractor, as in `flame-mdm evaluate`: a file, a folder,
            a model in the package or a run directory. If None, the extractor named in the protocol
            is used. If "none", metrics that need features are skipped.
        every_n_steps: number of training steps between evaluations.
        samples: number of motions per replication, or None for the number in the protocol.
        replications: number of replications.
        batch_size: number of motions per batch.
    """

    def __init__(
        self,
        protocol: str,
        extractor: str | None,
        every_n_steps: int,
        samples: int | None = 256,
        replications: int = 1,
        batch_size: int = 64,
    ):
        if extractor not in (None, "none") and not Path(extractor).exists():
            _find_extractor(extractor)
        self.name, self.path, self.every_n_steps = protocol, extractor, every_n_steps
        self.samples, self.replications, self.batch_size = samples, replications, batch_size
        self.next = 0
        self.values: dict[str, float] = {}
        self.curves: dict[str, float] = {}
        self.real: dict[str, Value | None] = {}

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Opens the protocol and the extractor, so that mismatches are reported before training."""
        assert isinstance(pl_module, GeneratorTask)
        data: MotionDataModule = trainer.datamodule  # type: ignore[attr-defined]
        model = pl_module.generator
        clips, representation = data.clips("val"), model.representation
        size = {"replications": self.replications, "samples": self.samples, "multimodality": False}
        protocol, _ = open_protocol(self.name, clips, representation, model, **size)
        extractor = protocol.open_extractor(self.path, representation, data.store.info["dataset"])
        self.evaluation = Evaluation(
            protocol, clips, extractor, representation, batch_size=self.batch_size
        )
        self.next = trainer.global_step

    def on_validation_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Evaluates the averaged weights if an evaluation is due; see `every_n_steps`."""
        if trainer.global_step < self.next or not hasattr(self, "evaluation"):
            return
        assert isinstance(pl_module, GeneratorTask)
        self.next = (trainer.global_step // self.every_n_steps + 1) * self.every_n_steps
        protocol = self.evaluation.protocol
        options, edit = sampling_options(protocol, pl_module.generator)
        size: dict[str, Any] = {"seed": 0, "batch_size": self.batch_size, "progress": False}
        source = Generator(
            pl_module.generator, protocol, self.evaluation.clips, options, edit, **size
        )
        measured = self.evaluation.run(source, ground_truth=not self.real, force=True)
        values = measured.values or {}
        self.real = self.real or measured.ground_truth or {}
        for name, value in values.items():
            if value is not None and value.mean is not None:
                self._add(f"val/{protocol.name}/{name}", value, self.real.get(name))
        if trainer.is_global_zero:
            columns = ("mean", "ci", "replications", "n", "unit")
            rows = []
            for metric, value in values.items():
                real = self.real.get(metric)
                rows.append(
                    [metric, *(getattr(value, column) for column in columns), real and real.mean]
                )
            head = ["metric", *columns, "real motions"]
            for logger in trainer.loggers:
                log_table(
                    logger, f"evaluation/{protocol.name}", head, rows, trainer.global_step - 1
                )

    def _add(self, name: str, value: Value, real: Value | None) -> None:
        """Stores a value twice: for checkpoint selection, and as a curve for dashboards."""
        assert value.mean is not None
        self.values[name] = value.mean
        label = f"{name} ({value.unit})" if value.unit else name
        self.curves[label] = value.mean
        if value.ci is not None:
            self.values[f"{name}/ci"] = self.curves[f"{label}/ci"] = value.ci
        if real is not None and real.mean is not None:
            self.curves[f"{label}/real"] = real.mean

    def on_validation_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Logs the values of the last evaluation."""
        # The values were computed at the start of the validation epoch, because the averaged
        # weights have been swapped out by now.
        pl_module.log_dict(self.curves)
        pl_module.log_dict(
            {name: x for name, x in self.values.items() if name not in self.curves}, logger=False
        )
        self.values, self.curves = {}, {}


def _find_extractor(source: str) -> None:
    """Raises `UserError` if an extractor does not exist. The message explains how to obtain it."""
    try:
        find(source)
    except (UserError, FileNotFoundError) as error:
        raise UserError(
            f"callbacks.evaluate.extractor={source}: no such file, but it is needed to choose the best checkpoint. "
            f"Obtain it ({made_by(source)}), or choose the checkpoint by the validation loss with selection=loss"
        ) from error
