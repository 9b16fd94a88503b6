"""Evaluation during training."""

from pathlib import Path
from typing import Any

from lightning import Callback, LightningModule, Trainer

from evaluators.evaluation import Evaluation
from evaluators.plan import sampling_options
from evaluators.protocol import open_protocol
from evaluators.sources import Generator
from flame_mdm.data.datamodule import MotionDataModule
from flame_mdm.errors import UserError
from flame_mdm.runs import made_by
from flame_mdm.task import GeneratorTask
from flame_mdm.training.loggers import log_table


class Evaluate(Callback):
    """Evaluates the model on the validation split under a protocol, and logs val/<protocol>/<metric>.

    Checkpoints can be selected by these values. With several replications, val/<protocol>/<metric>/ci is the half width
    of the 95 % interval. The evaluation runs at the first validation and then at multiples of `every_n_steps`, with
    averaged weights if the recipe averages them. The motions are divided among all processes.

    Args:
        protocol: a name in experiments/evaluation, or the path of a file.
        extractor: path from which the protocol's extractor is loaded; "none" skips metrics of features.
        samples: motions per replication; None = the protocol's number.

    Raises `UserError` before training begins if the extractor does not exist.
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
            raise UserError(
                f"callbacks.evaluate.extractor={extractor}: no such file, but it is needed to choose the best "
                f"checkpoint: {made_by(extractor)}. Or choose by the validation loss: selection=loss"
            )
        self.name, self.path, self.every_n_steps = protocol, extractor, every_n_steps
        self.samples, self.replications, self.batch_size = samples, replications, batch_size
        self.next = 0
        self.values: dict[str, float] = {}

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        assert isinstance(pl_module, GeneratorTask)
        data: MotionDataModule = trainer.datamodule  # type: ignore[attr-defined]
        model = pl_module.generator
        clips, representation = data.clips("val"), model.representation
        size = {"replications": self.replications, "samples": self.samples, "multimodality": False}
        protocol, _ = open_protocol(self.name, clips, representation, model, **size)
        extractor = protocol.open_extractor(self.path, representation, data.store.info["dataset"])
        self.evaluation = Evaluation(protocol, clips, extractor, representation, batch_size=self.batch_size)
        self.next = trainer.global_step

    def on_validation_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if trainer.global_step < self.next or not hasattr(self, "evaluation"):
            return
        assert isinstance(pl_module, GeneratorTask)
        self.next = (trainer.global_step // self.every_n_steps + 1) * self.every_n_steps
        protocol = self.evaluation.protocol
        options, edit = sampling_options(protocol, pl_module.generator)
        size: dict[str, Any] = {"seed": 0, "batch_size": self.batch_size, "progress": False}
        source = Generator(pl_module.generator, protocol, self.evaluation.clips, options, edit, **size)
        values = self.evaluation.run(source, ground_truth=False).values or {}
        numbers = {name: v.mean for name, v in values.items() if v is not None and v.mean is not None}
        widths = {f"{name}/ci": v.ci for name, v in values.items() if v is not None and v.ci is not None}
        logged = numbers | (widths if self.replications > 1 else {})
        self.values = {f"val/{protocol.name}/{name}": value for name, value in logged.items()}
        if trainer.is_global_zero:
            columns = ("mean", "ci", "replications", "n")
            rows = [[metric, *(getattr(value, column) for column in columns)] for metric, value in values.items()]
            for logger in trainer.loggers:
                log_table(logger, f"evaluation/{protocol.name}", ["metric", *columns], rows, trainer.global_step - 1)

    def on_validation_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        pl_module.log_dict(self.values)  # computed at the start, since averaged weights are swapped out by now
        self.values = {}
