# pyright: standard
"""Trains action classifiers for evaluations on data sets without a released classifier."""

from collections.abc import Sequence
from typing import Any

import torch.distributed
import torch.nn.functional as F
from torch import Tensor
from torchmetrics import MeanMetric, Metric

from evaluators.collectives import world_size
from evaluators.extractors.action_gru import ActionGRU
from evaluators.extractors.stgcn import JointSTGCN
from evaluators.extractors.training import ExtractorTask
from evaluators.metrics.accuracy import ActionAccuracy
from flame_mdm.batch import MotionBatch
from flame_mdm.conditions import Unconditional
from flame_mdm.config import Config, instantiate
from flame_mdm.data.datamodule import MotionDataModule
from flame_mdm.errors import UserError
from flame_mdm.representations import Representation


class ClassifierTask(ExtractorTask[ActionGRU | JointSTGCN]):
    """Trains an action classifier on the joints of any representation.

    Command: `make train EXP=classifier/...`.
    """

    noun = "an action classifier"

    @classmethod
    def parts(
        cls, config: Config, representation: Representation, actions: Sequence[str]
    ) -> dict[str, Any]:
        """Returns the network that a recipe describes.

        Raises `UserError` if the data has fewer than two actions.
        """
        if len(actions) < 2:
            raise UserError(
                f"a classifier needs a data set with at least two actions, but this one has {len(actions)}"
            )
        parents = representation.skeleton.parents
        sizes = {"num_joints": len(parents), "parents": parents, "num_actions": len(actions)}
        network = instantiate(config["task"]["network"], sizes)
        return {"network": network, "condition": Unconditional()}

    def metrics(self) -> dict[str, Metric]:
        """Returns the validation metrics: loss and accuracy."""
        return {"loss": MeanMetric(), "accuracy": ActionAccuracy()}

    def setup(self, stage: str) -> None:
        """Raises `UserError` if a clip for training or validation has no label."""
        super().setup(stage)
        data: MotionDataModule = self.trainer.datamodule  # type: ignore[attr-defined]
        bare = [clip.id for clip in (*data.train.clips, *data.val.clips) if clip.action is None]
        if bare:
            which = f"{len(bare)} clips have no action label, such as {bare[0]}"
            raise UserError(f"{data.folder}: {which}. Prepare the data without these clips")

    def training_step(self, batch: MotionBatch, batch_idx: int) -> Tensor:
        """Returns the cross-entropy of a batch."""
        self.seed_step(batch_idx)
        logits, labels = self._classified(batch)
        loss = F.cross_entropy(logits, labels)
        accuracy = (logits.argmax(1) == labels).float().mean()
        self.report({"train/loss": loss, "train/accuracy": accuracy})
        return loss

    def _classified(self, batch: MotionBatch) -> tuple[Tensor, Tensor]:
        assert batch.action is not None
        joints = self.representation.to_joints(batch.x)
        past_end = ~batch.mask[..., None, None]  # the zeros in the padding may not decode to a pose
        return self.network.logits(joints.masked_fill(past_end, 0), batch.mask), batch.action

    def on_validation_epoch_start(self) -> None:
        """Copies rank 0's running statistics, which are saved in checkpoints, to all ranks."""
        if world_size() > 1:
            for buffer in self.network.buffers():
                torch.distributed.broadcast(buffer, 0)

    def validation_step(self, batch: MotionBatch, batch_idx: int) -> None:
        """Adds a batch to the validation metrics."""
        logits, labels = self._classified(batch)
        self.val_metrics["loss"].update(F.cross_entropy(logits, labels, reduction="none"))  # type: ignore[operator]
        self.update_samples(batch, logits=logits, labels=labels)
