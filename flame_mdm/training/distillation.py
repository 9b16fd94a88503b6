"""Training of models that sample in one to four steps, from a teacher that takes more."""

import copy
from pathlib import Path
from typing import Any, Self

import torch
from torch import Tensor

from flame_mdm.batch import Condition, MotionBatch
from flame_mdm.checkpoints.loading import PARTS, find, load_task
from flame_mdm.checkpoints.model_files import weights_sha256
from flame_mdm.config import Config, flatten
from flame_mdm.errors import UserError
from flame_mdm.generator import DistilledGenerator, MotionGenerator
from flame_mdm.processes.consistency import consistency_terms
from flame_mdm.processes.guidance import classifier_free_guidance
from flame_mdm.task import MotionGeneration, Task
from flame_mdm.training.averaging import MovingAverage


class ConsistencyDistillation(DistilledGenerator, MotionGeneration):
    """A student that starts as its teacher and learns to sample in one to four steps, with the guidance built in.

    Its parts, data and captions are those of the teacher, which is only needed in training. The text encoder is not
    trained, and nothing has dropout. `experiments/distillation/consistency.yaml` explains the section `distillation`.
    """

    @classmethod
    def of_parts(cls, config: Config, *parts: Any) -> Self:
        task = super().of_parts(config, *parts)
        task.condition.requires_grad_(False)
        return task.eval()

    def train(self, mode: bool = True) -> Self:
        """Stays in evaluation mode: dropout would be noise in the targets."""
        return super().train(False)

    def setup(self, stage: str) -> None:
        super().setup(stage)
        self.start_from_teacher()

    def start_from_teacher(self) -> None:
        """Reads the teacher, and takes over its weights; raises `UserError` if there is none or it does not fit."""
        options = self.config["distillation"]
        name = options["teacher"]
        try:
            path = find(name)
        except FileNotFoundError as error:
            raise UserError(f"distillation.teacher={error}. Train it first, or name another") from error
        teacher = read_teacher(path)
        theirs, ours = (flatten({part: task.config[part] for part in PARTS[1:]}) for task in (teacher, self))
        for key in sorted(theirs.keys() | ours.keys()):
            if theirs.get(key) != ours.get(key):
                what = f"has {key}={theirs.get(key)}, but the student has {ours.get(key)}. Both need the same parts"
                raise UserError(f"distillation.teacher={name}: {what}: use `flame-mdm distill {name}`")
        before, now = teacher.facts.get("fingerprint"), self.facts.get("fingerprint")
        if None not in (before, now) and before != now:
            what = f"trained on data with fingerprint {before}, but {self.facts['dataset']} has {now}"
            raise UserError(f"distillation.teacher={name}: {what}. Give the data of the teacher")
        self.load_state_dict(teacher.state_dict())
        self.facts["teacher"] = weights_sha256(path)
        scale = options["guidance_scale"]
        self.teacher_guidance = teacher.sampler_options.guidance_scale if scale is None else scale
        # In lists, since they are no parts of the student.
        self.teacher, self.target = [copy.deepcopy(self.denoiser).requires_grad_(False)], [self.denoiser]

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Raises `UserError` if the weights of the teacher have changed since the run began."""
        if checkpoint["facts"].get("teacher") != self.facts["teacher"]:
            what = "its weights have changed since this run began"
            raise UserError(f"distillation.teacher: {what}. Restore them, or start another run with run.name=...")

    def on_fit_start(self) -> None:
        super().on_fit_start()
        self.teacher[0].to(self.device)

    def on_train_start(self) -> None:
        """Takes the targets from the moving average of the weights, if the recipe has one."""
        Task.on_train_start(self)  # and does not pretrain the text encoder, which is the teacher's
        for callback in self.trainer.callbacks:  # type: ignore[attr-defined]
            if isinstance(callback, MovingAverage):
                average = callback.averaged()
                if not self.trainer.global_step:  # it was copied before the weights of the teacher came
                    average.load_state_dict(self.state_dict())
                self.target = [average.denoiser]

    def loss_terms(
        self, batch: MotionBatch, cond: Condition, u: Tensor | None = None, noise: Tensor | None = None
    ) -> dict[str, Tensor]:
        """See `MotionGeneration.loss_terms`. Validation, which gives u, is at the times of the last grid."""
        trainer, counts = self._trainer, self.config["distillation"]["intervals"]
        progress, is_validation = 1.0, u is not None
        if not is_validation and trainer is not None and trainer.max_steps > 0:
            progress = trainer.global_step / trainer.max_steps
        times = torch.tensor(self.process.grid(counts[min(int(progress * len(counts)), len(counts) - 1)]))
        u = torch.rand(len(batch), device=self.device) if u is None else u
        index = (u * len(times)).long().clamp(max=len(times) - 1)
        noise = torch.randn_like(batch.x) if noise is None else noise
        draws: dict[str, Tensor] = {"times": times.to(self.device), "index": index, "noise": noise}
        teacher, target = self.teacher[0], self.denoiser if is_validation else self.target[0]
        if cond.null is not None and self.condition.features and self.teacher_guidance is not None:
            teacher = classifier_free_guidance(teacher, self.teacher_guidance, self.representation.features)
        networks = self.denoiser, target, teacher
        return consistency_terms(self.process, *networks, batch.x, batch.mask, cond, **draws, auxiliary=self.losses)


def read_teacher(path: Path) -> MotionGenerator:
    """Loads a model that can be a teacher; raises `UserError` if it predicts noise, or is a student itself."""
    teacher = load_task(path, MotionGenerator)
    if isinstance(teacher, DistilledGenerator):
        raise UserError(f"{path}: distilled already. Give its teacher, {teacher.config['distillation']['teacher']}")
    if teacher.process.prediction == "epsilon":
        what = "predicts noise, whose clean estimate is divided by almost nothing at the noisiest times"
        raise UserError(f"{path}: {what}. Give a model that predicts the clean motion or the velocity (MDM, MFM)")
    return teacher
