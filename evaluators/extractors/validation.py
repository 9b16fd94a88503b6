"""Validation that is shared by the tasks that train feature extractors."""

import torch
from torch import Tensor, nn
from torchmetrics import Metric

from evaluators.metrics import update_metrics
from evaluators.metrics.samples import SampleMetric
from flame_mdm.batch import MotionBatch
from flame_mdm.errors import UserError
from flame_mdm.seeds import key
from flame_mdm.task import Task


def update_pairs(
    task: Task, metrics: nn.ModuleDict, batch: MotionBatch, motion: Tensor, text: Tensor, **more: Tensor
) -> None:
    """Updates the metrics of samples with the pairs of a batch, each on one process; features are (B, E).

    With fewer clips than processes, every process has all clips, and only the first one counts.
    """
    if task.global_rank and len(task.trainer.datamodule.val) < task.trainer.world_size:  # type: ignore[attr-defined]
        return
    keys, text_keys = (
        torch.tensor([key(kind, name) for name in names], device=task.device)
        for kind, names in (("motion", batch.ids), ("caption", batch.text or ()))
    )
    of_pairs = {name: metric for name, metric in metrics.items() if isinstance(metric, SampleMetric)}
    update_metrics(of_pairs, generated=motion, text=text, keys=keys, text_keys=text_keys, **more)


def log_validation(task: Task, metrics: nn.ModuleDict) -> None:
    """Logs the metrics of a validation over all processes, and resets them.

    Metrics other than the loss that have too few samples are left out: R-precision needs 32 captions.
    """
    for name, metric in metrics.items():
        assert isinstance(metric, Metric)
        try:
            value = metric.compute()
        except UserError:
            if name == "loss":
                raise
            value = None
        parts = {f"{name}_{part}": x for part, x in value.items()} if isinstance(value, dict) else {name: value}
        for part, x in parts.items():
            if x is not None:
                task.log(f"val/{part}", x, prog_bar=part == "loss")
        metric.reset()
