# pyright: standard
"""Models that generate motions, without Lightning, whose import takes longer than sampling; `flame_mdm.task` trains."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, Self

import torch
from torch import Tensor, nn

from flame_mdm.batch import Condition, Denoise, Edit, MotionBatch, pad_to
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


@dataclass(frozen=True)
class Parts:
    """The four parts of a model: who removes noise, along which path, from which description, of which features."""

    denoiser: Denoiser
    process: Process
    condition: ConditionEncoder
    representation: Representation

    def __post_init__(self) -> None:
        if not isinstance(self.denoiser, Denoiser):
            kind = type(self.denoiser).__name__
            raise UserError(f"{kind} is no denoiser: derive it from flame_mdm.denoisers.Denoiser")

    @classmethod
    def build(cls, config: Config, representation: Representation, num_actions: int) -> Self:
        """Builds the parts of a recipe, with the sizes that depend on other parts."""

        def part(name: str, **sizes: Any) -> Any:
            legal = parameters(config[name]["_target_"])
            sizes = {key: size for key, size in sizes.items() if key in legal or "**" in legal}
            return instantiate(config[name], **sizes)

        process: Process = part("process")
        condition: ConditionEncoder = part("condition", num_actions=num_actions)
        denoiser: Denoiser = part(
            "denoiser",
            in_features=representation.features,
            out_features=process.out_features(representation.features),
            cond_features=condition.features,
            length_unit=_length_unit(config),
        )
        return cls(denoiser, process, condition, representation)


def _length_unit(config: Config) -> int:
    """Returns the number of frames of which all lengths in training are multiples."""
    crop = config.get("data", {}).get("crop")
    return crop.get("unit", 1) if isinstance(crop, dict) else 1


def sampling_defaults(
    *, guidance_scale: float, sampler: str, num_inference_steps: int | Sequence[int] | None
) -> SamplerOptions:
    """Returns the sampling options in the section `task` of a recipe; raises `UserError` for invalid values."""
    if num_inference_steps is None:  # a recipe may come from a file
        raise UserError("task.num_inference_steps=null: give the number of sampling steps")
    try:
        return SamplerOptions(guidance_scale=guidance_scale, sampler=sampler, num_inference_steps=num_inference_steps)
    except UserError as error:
        raise UserError(f"task.{error}") from error


class Model:
    """What all models have that checkpoints hold."""

    noun = "a model"  # what its checkpoints hold, for messages
    config: Config  # the recipe, saved in checkpoints
    facts: dict[str, Any]  # of the training data: actions, maximum length, fingerprint
    steps: int | None = None  # number of training steps of the loaded checkpoint; None if unknown

    def add_facts(self, facts: Mapping[str, Any]) -> None:
        """Adds facts about the training data."""
        self.facts |= facts


class MotionGenerator(Model, nn.Module):
    """A denoiser, a process, a condition encoder and a representation, and how to sample from them.

    Args:
        parts: the four parts.
        sampler_options: defaults of `generate`.
    """

    noun = "a motion generator"

    def __init__(self, parts: Parts, sampler_options: SamplerOptions):
        super().__init__()
        # Optimizer states in checkpoints number the parameters in this order.
        self.condition, self.representation = parts.condition, parts.representation
        self.denoiser, self.process = parts.denoiser, parts.process
        self.sampler_options = sampler_options
        self.config, self.facts = {}, {}

    @classmethod
    def build(cls, config: Config, representation: Representation, *, actions: Sequence[str] = ()) -> Self:
        """Builds the generator of a recipe; `actions` are the names of the actions in its data."""
        parts = Parts.build(config, representation, len(actions))
        section = config["task"]
        defaults = sampling_defaults(
            guidance_scale=section["guidance_scale"],
            sampler=section["sampler"],
            num_inference_steps=section["num_inference_steps"],
        )
        generator = cls(parts, defaults)
        generator.config, generator.facts = config, {"actions": list(actions)}
        return generator

    def add_facts(self, facts: Mapping[str, Any]) -> None:
        """Adds facts about the training data, and tells its vocabulary to the text encoder."""
        super().add_facts(facts)
        if "vocabulary" in facts:
            self.condition.seen = frozenset(facts["vocabulary"])

    @property
    def device(self) -> torch.device:
        return self.representation.mean.device

    def describe(self) -> str:
        return type(self.denoiser).__name__

    @property
    def conditioned_on(self) -> Literal["none", "text", "action"]:
        """The condition that the model was trained with."""
        return self.condition.reads if self.condition.features else "none"

    def check_request(self, options: SamplerOptions | None, unconditioned: bool) -> None:
        """Raises `UserError` if this kind of model cannot sample with these arguments of `generate`."""

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
        self.check_request(options, unconditioned)
        options = self.sampler_options if options is None else options.over(self.sampler_options)
        was_training = self.training
        if was_training:  # setting the mode of all modules takes as long as a small network
            self.eval()

        cond = self._encode(batch if windows is None else windows.batch, unconditioned)
        denoise: Denoise = self.denoiser
        scale = options.guidance_scale
        if scale is not None and cond.null is not None and self.condition.features and not unconditioned:
            denoise = classifier_free_guidance(self.denoiser, scale, self.representation.features)
        if windows is not None:
            denoise = blended(denoise, windows)

        mask, frames = batch.mask, batch.mask.shape[1]
        if windows is None and not self.denoiser.mask_padding:
            # This denoiser attends to padding, so the padded length must be the same as in training.
            mask = pad_to(mask, max(frames, self.facts.get("max_frames", 0)))
            if edit is not None:
                padded = mask.shape[1]
                edit = replace(edit, known=pad_to(edit.known, padded), keep=~pad_to(~edit.keep, padded))

        ids = ["shared"] * len(batch) if shared_noise else batch.ids
        features = self.representation.features
        noise = seeded_noise(ids, mask.shape[1], features, seed=seed, replication=replication, like=batch.x)
        x = self.process.sample(denoise, noise, mask, cond, options, edit=edit, trajectory=trajectory)
        if was_training:
            self.train()
        return x[:, :frames]

    def _encode(self, batch: MotionBatch, unconditioned: bool) -> Condition:
        """Returns the condition of a batch, or the null condition if a conditional model samples without one."""
        if not (unconditioned and self.condition.features):
            return self.condition(batch)
        nothing = torch.zeros(len(batch), dtype=torch.long, device=batch.x.device)
        empty = replace(batch, text=[""] * len(batch), action=nothing)
        return self.condition(empty).drop(nothing == 0)


class DistilledGenerator(MotionGenerator):
    """A student of `flame_mdm.training.distillation`, with the guidance built in."""

    def __init__(self, parts: Parts, sampler_options: SamplerOptions):
        super().__init__(parts, sampler_options)
        # Edits cannot rewrite a path, since the sampler of students forgets it.
        self.process.edit_modes = tuple(mode for mode in self.process.edit_modes if mode != "trajectory")

    def check_request(self, options: SamplerOptions | None, unconditioned: bool) -> None:
        """Raises `UserError` for guidance and motions without condition, which a student has not learned."""
        scale = None if options is None else options.guidance_scale
        if scale not in (None, 1):
            raise UserError(f"guidance_scale={scale}: the guidance is built into this distilled model. Omit it")
        if unconditioned and self.condition.features:
            raise UserError(f"this distilled model needs a {self.condition.reads}, as in its training. Add one")
