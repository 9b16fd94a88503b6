# pyright: standard
"""Distillation: a many-step teacher trains models to sample in one to four steps."""

import copy
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import torch
from torch import Tensor

from flame_mdm.batch import Condition, Constant, Denoise, MotionBatch
from flame_mdm.checkpoints.loading import PARTS, find, load_task
from flame_mdm.checkpoints.model_files import weights_sha256
from flame_mdm.config import Config, flatten
from flame_mdm.errors import UserError, renamed_names
from flame_mdm.generator import DistilledGenerator, MotionGenerator
from flame_mdm.processes.consistency import consistency_terms
from flame_mdm.processes.guidance import classifier_free_guidance
from flame_mdm.representations import Representation
from flame_mdm.task import GeneratorTask
from flame_mdm.training.averaging import MovingAverage


class DistillationTask(GeneratorTask):
    """Trains a student to sample in one to four steps, with built-in guidance.

    The student starts with its teacher's weights and uses the same parts, data and captions. The
    teacher is needed only during training. The text encoder is not trained, and dropout is
    disabled. `experiments/distillation/consistency.yaml` explains the section `distillation`.
    """

    kind = DistilledGenerator
    grids: dict[int, Constant]  # times of the teacher's steps, by number of steps

    @classmethod
    def build(
        cls,
        config: Config,
        representation: Representation,
        *,
        actions: Sequence[str] = (),
        facts: Mapping[str, Any] | None = None,
    ) -> Self:
        """Builds the task of a recipe with a text encoder that is not trained."""
        task = super().build(config, representation, actions=actions, facts=facts)
        task.generator.condition.requires_grad_(False)
        task.grids = {}
        return task.eval()

    def train(self, mode: bool = True) -> Self:
        """Keeps the task in evaluation mode, because dropout would add noise to the targets."""
        return super().train(False)

    def setup(self, stage: str) -> None:
        """Loads the teacher, whose weights initialize the student."""
        super().setup(stage)
        self.start_from_teacher()

    def start_from_teacher(self) -> None:
        """Loads the teacher and copies its weights.

        Raises `UserError` if the teacher is missing or does not match the student.
        """
        options = self.config["distillation"]
        name = options["teacher"]
        try:
            path = find(name)
        except FileNotFoundError as error:
            raise UserError(
                f"distillation.teacher={error}. Train the teacher first, or choose another one"
            ) from error
        teacher = read_teacher(path)
        theirs, ours = (
            flatten({part: model.config[part] for part in PARTS[1:]}) for model in (teacher, self)
        )
        for key in sorted(theirs.keys() | ours.keys()):
            if theirs.get(key) != ours.get(key):
                raise UserError(
                    f"distillation.teacher={name}: the teacher has {key}={theirs.get(key)}, but the student has "
                    f"{ours.get(key)}. Both must have the same parts. Use `flame-mdm distill {name}`"
                )
        before, now = teacher.facts.get("fingerprint"), self.facts.get("fingerprint")
        if None not in (before, now) and before != now:
            raise UserError(
                f"distillation.teacher={name}: trained on data with fingerprint {before}, but {self.facts['dataset']} "
                f"has fingerprint {now}. Use the teacher's data"
            )
        self.generator.load_state_dict(teacher.state_dict())
        self.facts["teacher"] = weights_sha256(path)
        scale = options["guidance_scale"]
        self.teacher_guidance = teacher.sampler_options.guidance_scale if scale is None else scale
        # The networks are stored in lists, so that they are not registered as submodules of the
        # student.
        denoiser = self.generator.denoiser
        self.teacher, self.target = [copy.deepcopy(denoiser).requires_grad_(False)], [denoiser]

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Raises `UserError` if the weights of the teacher have changed since the run began."""
        if checkpoint["facts"].get("teacher") != self.facts["teacher"]:
            raise UserError(
                "distillation.teacher: its weights have changed since this run began. Restore them, or start another "
                "run with run.name=..."
            )

    def on_fit_start(self) -> None:
        """Moves the teacher to the device, because Lightning only moves submodules."""
        super().on_fit_start()
        self.teacher[0].to(self.device)

    def on_train_start(self) -> None:
        """Computes the targets with the averaged weights if the recipe averages weights."""
        super().on_train_start()
        for callback in self.trainer.callbacks:  # type: ignore[attr-defined]
            if isinstance(callback, MovingAverage):
                average = callback.averaged()
                # The average was copied before the weights of the teacher were loaded.
                if not self.trainer.global_step:
                    average.load_state_dict(self.state_dict())
                self.target = [average.generator.denoiser]

    def pretrain(self) -> None:
        """Does nothing, because the text encoder is taken from the teacher."""

    def loss_terms(
        self,
        batch: MotionBatch,
        cond: Condition,
        u: Tensor | None = None,
        noise: Tensor | None = None,
    ) -> dict[str, Tensor]:
        """See `GeneratorTask.loss_terms`.

        Validation passes `u`, and always uses the time grid of the last part of training.
        """
        trainer, counts = self._trainer, self.config["distillation"]["intervals"]
        progress, is_validation = 1.0, u is not None
        if not is_validation and trainer is not None and trainer.max_steps > 0:
            progress = trainer.global_step / trainer.max_steps

        student = self.generator
        process = student.process
        count = counts[min(int(progress * len(counts)), len(counts) - 1)]
        grid = self.grids.setdefault(count, Constant(process.grid(count)))
        times = grid.on(self.device)
        u = torch.rand(len(batch), device=self.device) if u is None else u
        index = (u * len(times)).long().clamp(max=len(times) - 1)
        noise = torch.randn_like(batch.x) if noise is None else noise

        target = student.denoiser if is_validation else self.target[0]
        teacher: Denoise = self.teacher[0]
        if (
            cond.null is not None
            and student.condition.features
            and self.teacher_guidance is not None
        ):
            teacher = classifier_free_guidance(
                teacher, self.teacher_guidance, student.representation.features
            )
        return consistency_terms(
            process,
            student.denoiser,
            target,
            teacher,
            batch.x,
            batch.mask,
            cond,
            times=times,
            index=index,
            noise=noise,
            auxiliary=self.losses,
        )


def read_teacher(path: Path) -> MotionGenerator:
    """Loads a teacher. Raises `UserError` if it predicts noise or is itself a distilled model."""
    teacher = load_task(path, MotionGenerator)
    if isinstance(teacher, DistilledGenerator):
        raise UserError(
            f"{path} is a distilled model. Use its teacher, "
            f"{teacher.config['distillation']['teacher']}"
        )
    if teacher.process.prediction == "epsilon":
        raise UserError(
            f"{path}: this model predicts noise, so computing the clean estimate would divide by almost 0 at "
            f"the noisiest times. Use a model that predicts the clean motion or the velocity "
            f"(MDM, MFM)"
        )
    return teacher


__getattr__ = renamed_names(__name__, {"ConsistencyDistillation": "DistillationTask"}, since="0.3")
