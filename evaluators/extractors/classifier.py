"""Training of action classifiers, whose features measure action-to-motion on data sets without a released one."""

from collections.abc import Sequence
from typing import Self

import torch
import torch.distributed
import torch.nn.functional as F
from torch import Tensor, nn
from torchmetrics import MeanMetric

from evaluators.extractors.action_gru import ActionGRU
from evaluators.extractors.stgcn import JointSTGCN
from evaluators.extractors.validation import log_validation
from evaluators.metrics.accuracy import ActionAccuracy
from flame_mdm.batch import MotionBatch
from flame_mdm.conditions import Unconditional
from flame_mdm.config import Config, instantiate, parameters
from flame_mdm.data.datamodule import MotionDataModule
from flame_mdm.errors import UserError
from flame_mdm.representations import Representation
from flame_mdm.seeds import key
from flame_mdm.task import Task


class ClassifierTask(Task):
    """Task that trains an action classifier (`make train EXP=classifier/...`), and the resulting feature extractor.

    It reads joint positions, in any representation.

    Args:
        network: the classifier.
        representation: of the motions; an extractor can only measure motions in this representation.
    """

    noun = "an action classifier"

    def __init__(
        self, network: ActionGRU | JointSTGCN, representation: Representation, *, optimizer: Config, seed: int = 0
    ):
        super().__init__(Unconditional(), representation, optimizer=optimizer, seed=seed)
        self.network = network
        with torch.device("cpu"):  # a loaded model is built on the meta device, of which metrics cannot be moved
            self.val_metrics = nn.ModuleDict({"loss": MeanMetric(), "accuracy": ActionAccuracy()})

    @classmethod
    def build(cls, config: Config, representation: Representation, *, actions: Sequence[str] = ()) -> Self:
        """Builds the network for the skeleton and actions of the data; raises `UserError` with fewer than two."""
        if len(actions) < 2:
            raise UserError(f"a classifier needs a data set with at least two actions, but this one has {len(actions)}")
        parents = representation.skeleton.parents
        sizes = {"num_joints": len(parents), "parents": parents, "num_actions": len(actions)}
        settings = config["task"]["network"]
        legal = parameters(settings["_target_"])
        network = instantiate(settings, **{name: value for name, value in sizes.items() if name in legal})
        task = cls(network, representation, optimizer=config["optimizer"], seed=config["seed"])
        task.config, task.facts = config, {"actions": list(actions)}
        return task

    def setup(self, stage: str) -> None:
        """Sets up the task. Raises `UserError` if a clip for training or validation has no label."""
        super().setup(stage)
        data: MotionDataModule = self.trainer.datamodule  # type: ignore[attr-defined]
        bare = [clip.id for clip in (*data.train.clips, *data.val.clips) if clip.action is None]
        if bare:
            raise UserError(
                f"{data.folder}: {len(bare)} clips have no action label, such as {bare[0]}. A classifier needs "
                "labels: prepare the data without these clips"
            )

    # Feature extraction -----------------------------------------------------------------------------------------------

    def forward(self, joints: Tensor, mask: Tensor) -> Tensor:
        """Returns features (B, E) of motions (B, F, J, 3) in meters, y up, with mask (B, F)."""
        return self.network(joints, mask)

    def logits(self, joints: Tensor, mask: Tensor) -> Tensor:
        """Returns unnormalized log-probabilities (B, actions); arguments as for `forward`."""
        return self.network.logits(joints, mask)

    # Training ---------------------------------------------------------------------------------------------------------

    def training_step(self, batch: MotionBatch, batch_idx: int) -> Tensor:
        """Returns the cross-entropy of one batch, in nats."""
        torch.manual_seed(key("step", self.seed, batch_idx, self.global_rank))
        logits, labels = self._classified(batch)
        loss = F.cross_entropy(logits, labels)
        accuracy = (logits.argmax(1) == labels).float().mean()
        self.log_dict({"train/loss": loss, "train/accuracy": accuracy}, batch_size=len(batch))
        return loss

    def _classified(self, batch: MotionBatch) -> tuple[Tensor, Tensor]:
        assert batch.action is not None
        joints = self.representation.to_joints(batch.x)
        past_end = ~batch.mask[..., None, None]  # features of 0 in the padding may not be a pose
        return self.logits(joints.masked_fill(past_end, 0), batch.mask), batch.action

    def on_validation_epoch_start(self) -> None:
        """Gives all processes the running statistics of the first, which checkpoints contain."""
        if torch.distributed.is_initialized() and torch.distributed.get_world_size() > 1:
            for buffer in self.network.buffers():
                torch.distributed.broadcast(buffer, 0)

    def validation_step(self, batch: MotionBatch, batch_idx: int) -> None:
        """Adds the clips of a batch; with fewer clips than processes, each has all of them, which changes no value."""
        logits, labels = self._classified(batch)
        self.val_metrics["loss"].update(F.cross_entropy(logits, labels, reduction="none"))  # type: ignore[operator]
        self.val_metrics["accuracy"].update(logits, labels)  # type: ignore[operator]

    def on_validation_epoch_end(self) -> None:
        log_validation(self, self.val_metrics)
