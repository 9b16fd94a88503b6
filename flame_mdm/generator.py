"""Models that generate motions, without Lightning, whose import takes longer than sampling; `flame_mdm.task` trains."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal, Self

import torch
from torch import Tensor, nn

from flame_mdm.batch import Denoise, Edit, MotionBatch, pad_to
from flame_mdm.conditions import ConditionEncoder
from flame_mdm.config import Config, instantiate, parameters
from flame_mdm.denoisers import Denoiser
from flame_mdm.errors import UserError
from flame_mdm.processes import Process
from flame_mdm.processes.guidance import classifier_free_guidance
from flame_mdm.processes.windows import Windows, blended
from flame_mdm.representations import Representation
from flame_mdm.sampler_options import SamplerOptions
from flame_mdm.seeds import seeded_noise


class Model:
    """What all models have that checkpoints hold."""

    noun = "a model"  # what its checkpoints hold, for messages
    config: Config  # the recipe, saved in checkpoints
    facts: dict[str, Any]  # of the training data: actions, maximum length, fingerprint
    steps: int | None = None  # number of training steps of the loaded checkpoint; None if unknown


class MotionGenerator(Model, nn.Module):
    """A denoiser, a process, a condition encoder and a representation, and how to sample from them."""

    noun = "a motion generator"
    denoiser: Denoiser
    process: Process
    condition: ConditionEncoder
    representation: Representation
    sampler_options: SamplerOptions  # defaults of `generate`, from the recipe

    @classmethod
    def build(cls, config: Config, representation: Representation, *, actions: Sequence[str] = ()) -> Self:
        """Builds the parts of a recipe, with sizes that depend on other parts, and combines them."""

        def part(name: str, **derived: Any) -> Any:
            legal = parameters(config[name]["_target_"])
            derived = {k: v for k, v in derived.items() if k in legal or "**" in legal}
            return instantiate(config[name], **derived)

        process: Process = part("process")
        condition: ConditionEncoder = part("condition", num_actions=len(actions))
        width, crop = representation.features, config.get("data", {}).get("crop")
        unit = crop.get("unit", 1) if isinstance(crop, dict) else 1  # of all lengths in training
        sizes = {"in_features": width, "out_features": process.out_features(width), "cond_features": condition.features}
        denoiser: Denoiser = part("denoiser", **sizes, length_unit=unit)
        model = cls.of_parts(config, denoiser, process, condition, representation)
        model.config, model.facts = config, {"actions": list(actions)}
        return model

    @classmethod
    def of_parts(cls, config: Config, *parts: Any) -> Self:
        """Combines denoiser, process, condition and representation, with the sampling of the recipe `config`."""
        model = cls()
        names = ("guidance_scale", "sampler", "num_inference_steps")
        model.combine(*parts, **{name: config["task"][name] for name in names})
        return model

    def combine(self, *parts: Any, **options: Any) -> None:
        """Stores denoiser, process, condition, representation and the sampling; raises `UserError` for invalid ones."""
        denoiser, process, condition, representation = parts
        if not isinstance(denoiser, Denoiser):
            raise UserError(f"{type(denoiser).__name__} is no denoiser: derive it from flame_mdm.denoisers.Denoiser")
        if options["num_inference_steps"] is None:  # a recipe may come from a file
            raise UserError("task.num_inference_steps=null: give the number of sampling steps")
        try:
            self.sampler_options = SamplerOptions(**options)
        except UserError as error:
            raise UserError(f"task.{error}") from error
        self.condition, self.representation = condition, representation
        self.denoiser, self.process = denoiser, process

    @property
    def device(self) -> torch.device:
        return self.representation.mean.device

    def describe(self) -> str:
        return type(self.denoiser).__name__

    @property
    def conditioned_on(self) -> Literal["none", "text", "action"]:
        """The condition that the model was trained with."""
        return self.condition.reads if self.condition.features else "none"

    @torch.no_grad()
    def generate(
        self,
        batch: MotionBatch,
        options: SamplerOptions | None = None,
        *,
        seed: int = 0,
        replication: int = 0,
        edit: Edit | None = None,
        windows: Windows | None = None,
        unconditioned: bool = False,
        shared_noise: bool = False,
        trajectory: list[Tensor] | None = None,
    ) -> Tensor:
        """Samples motions for the conditions, lengths and ids of `batch`; its `x` is ignored.

        Options of the sampler that are None have the values of the recipe. The noise of a motion is a function of
        (seed, replication, id), so the motion is the same in any batch; with `shared_noise`, of (seed, replication).
        `unconditioned` samples a conditional model with its null condition. The normalized clean estimate (B, F, D) of
        each denoiser call is appended to `trajectory`. With `windows`, motions may be longer than those in training,
        and the conditions are those of the windows. Returns (B, F, D) normalized, 0 past the end of each motion.
        """
        was_training = self.training
        if was_training:  # setting the mode of all modules takes as long as a small network
            self.eval()
        options = self.sampler_options if options is None else options.over(self.sampler_options)
        denoise: Denoise = self.denoiser
        described = batch if windows is None else windows.batch
        if unconditioned and self.condition.features:
            nothing = torch.zeros(len(described), dtype=torch.long, device=batch.x.device)
            cond = self.condition(replace(described, text=[""] * len(described), action=nothing)).drop(nothing == 0)
        else:
            cond = self.condition(described)
        scale = options.guidance_scale
        if scale is not None and cond.null is not None and self.condition.features and not unconditioned:
            denoise = classifier_free_guidance(self.denoiser, scale, self.representation.features)
        if windows is not None:
            denoise = blended(denoise, windows)
        mask, frames, features = batch.mask, batch.mask.shape[1], self.representation.features
        if windows is None and not self.denoiser.mask_padding:
            # This denoiser attends to padding, so the padded length must be the same as in training.
            mask = pad_to(mask, max(frames, self.facts.get("max_frames", 0)))
            if edit is not None:
                size = mask.shape[1]
                edit = replace(edit, known=pad_to(edit.known, size), keep=~pad_to(~edit.keep, size))
        ids = ["shared"] * len(batch) if shared_noise else batch.ids
        noise = seeded_noise(ids, mask.shape[1], features, seed=seed, replication=replication, like=batch.x)
        x = self.process.sample(denoise, noise, mask, cond, options, edit=edit, trajectory=trajectory)
        if was_training:
            self.train()
        return x[:, :frames]


class DistilledGenerator(MotionGenerator):
    """A student of `flame_mdm.training.distillation`, with the guidance built in."""

    def combine(self, *parts: Any, **options: Any) -> None:
        """See `MotionGenerator`. Edits cannot rewrite a path, since the sampler of students forgets it."""
        super().combine(*parts, **options)
        self.process.edit_modes = tuple(mode for mode in self.process.edit_modes if mode != "trajectory")

    def generate(self, batch: MotionBatch, options: SamplerOptions | None = None, **keywords: Any) -> Tensor:
        """See `MotionGenerator`; a student has learned neither guidance nor motions without condition."""
        scale = None if options is None else options.guidance_scale
        if scale not in (None, 1):
            raise UserError(f"guidance_scale={scale}: the guidance is built into this distilled model. Omit it")
        if keywords.get("unconditioned") and self.condition.features:
            raise UserError(f"this distilled model needs a {self.condition.reads}, as in its training. Add one")
        return super().generate(batch, options, **keywords)
