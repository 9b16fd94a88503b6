# pyright: standard
"""Base class for tasks that train feature extractors."""

from collections.abc import Mapping, Sequence
from typing import Any, Generic, Self, TypeVar

import torch
from torch import Tensor, nn
from torchmetrics import Metric

from evaluators.metrics import update_metrics
from evaluators.metrics.samples import SampleMetric
from flame_mdm.batch import MotionBatch
from flame_mdm.conditions import ConditionEncoder
from flame_mdm.config import Config
from flame_mdm.errors import UserError
from flame_mdm.representations import Representation
from flame_mdm.seeds import key
from flame_mdm.task import Task

Network = TypeVar("Network", bound=nn.Module)


class ExtractorTask(Task, Generic[Network]):
    """Task that trains a feature extractor, which shares no parts with the models that it evaluates."""

    network: Network

    def __init__(
        self,
        network: Network,
        condition: ConditionEncoder,
        representation: Representation,
        *,
        optimizer: Config,
        seed: int = 0,
    ):
        super().__init__(optimizer=optimizer, seed=seed)
        # The order of the parts determines the numbering of parameters in saved optimizer states.
        self.condition, self.representation = condition, representation
        self.network, self.val_metrics = network, nn.ModuleDict()

    @classmethod
    def build(
        cls,
        config: Config,
        representation: Representation,
        *,
        actions: Sequence[str] = (),
        facts: Mapping[str, Any] | None = None,
    ) -> Self:
        """Builds the task of a recipe; see `flame_mdm.task.Task.build`."""
        options = {name: value for name, value in config["task"].items() if name != "_target_"}
        options |= {
            "representation": representation,
            "optimizer": config["optimizer"],
            "seed": config["seed"],
        }
        task = cls(**options | cls.parts(config, representation, actions))
        task.config, task.facts = config, {"actions": list(actions)}
        task.add_facts(facts or {})
        return task

    def encoder(self) -> ConditionEncoder:
        """Returns the encoder for the captions of the data set."""
        return self.condition

    @classmethod
    def parts(
        cls, config: Config, representation: Representation, actions: Sequence[str]
    ) -> dict[str, Any]:
        """Builds the `network` and the `condition` that a recipe describes."""
        raise NotImplementedError

    def metrics(self) -> Mapping[str, Metric]:
        """Returns the validation metrics. The best checkpoint is selected by the metric "loss"."""
        raise NotImplementedError

    def setup(self, stage: str) -> None:
        """Sets up the task and creates the validation metrics."""
        super().setup(stage)
        self.val_metrics.update(self.metrics())

    def forward(self, x: Tensor, mask: Tensor) -> Tensor:
        """Computes features (B, E) from motions (B, F, ...) in the data's units, with mask (B, F)."""
        return self.network(x, mask)

    def seed_step(self, batch_idx: int) -> None:
        """Seeds a training step, so that its draws depend only on (seed, batch number, rank)."""
        torch.manual_seed(key("step", self.seed, batch_idx, self.global_rank))

    def update_samples(self, batch: MotionBatch, **inputs: Tensor) -> None:
        """Adds a batch to the validation metrics.

        If there are fewer clips than ranks, each rank has all clips, so only rank 0's clips count.
        """
        if self.global_rank and len(self.trainer.datamodule.val) < self.trainer.world_size:  # type: ignore[attr-defined]
            return
        for name, kind, names in (
            ("keys", "motion", batch.ids),
            ("text_keys", "caption", batch.text or ()),
        ):
            inputs[name] = torch.tensor([key(kind, value) for value in names], device=self.device)
        of_samples = {
            name: metric
            for name, metric in self.val_metrics.items()
            if isinstance(metric, SampleMetric)
        }
        update_metrics(of_samples, **inputs)

    def on_validation_epoch_end(self) -> None:
        """Logs and resets the validation metrics.

        Metrics with too few samples, except for the loss, are skipped.
        """
        for name, metric in self.val_metrics.items():
            assert isinstance(metric, Metric)
            try:
                value = metric.compute()
            except UserError:
                if name == "loss":
                    raise
                value = None
            parts = (
                {f"{name}_{part}": x for part, x in value.items()}
                if isinstance(value, dict)
                else {name: value}
            )
            for part, x in parts.items():
                if x is not None:
                    self.log(f"val/{part}", x, prog_bar=part == "loss")
            metric.reset()
