# pyright: standard
"""Models that generate motions.

They do not depend on Lightning, because importing it takes longer than sampling a motion.
`flame_mdm.task` trains them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, Self

import torch
from torch import Tensor, nn

from flame_mdm.batch import Condition, Denoise, Edit, MotionBatch, ceil_div, pad_to
from flame_mdm.conditions import ConditionEncoder
from flame_mdm.config import Config, instantiate
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
    """The four parts of a model.

    Raises:
        UserError: If `denoiser` is not a `flame_mdm.denoisers.Denoiser`.
    """

    #: Network that predicts the target of the process.
    denoiser: Denoiser
    #: Process that turns noise into a motion, such as diffusion or flow matching.
    process: Process
    #: Encoder of the condition, such as text or actions.
    condition: ConditionEncoder
    #: Conversion between motions and features.
    representation: Representation

    def __post_init__(self) -> None:
        if not isinstance(self.denoiser, Denoiser):
            kind = type(self.denoiser).__name__
            raise UserError(
                f"{kind} is not a denoiser. Derive it from flame_mdm.denoisers.Denoiser"
            )

    @classmethod
    def build(cls, config: Config, representation: Representation, num_actions: int) -> Self:
        """Builds the parts of a recipe and sets the sizes that depend on other parts."""
        process: Process = instantiate(config["process"])
        condition: ConditionEncoder = instantiate(config["condition"], {"num_actions": num_actions})
        sizes = sizes_of_denoiser(config, representation, process, condition)
        denoiser: Denoiser = instantiate(config["denoiser"], sizes)
        return cls(denoiser, process, condition, representation)


def sizes_of_denoiser(
    config: Config, representation: Representation, process: Process, condition: ConditionEncoder
) -> dict[str, int]:
    """Returns the denoiser's arguments that depend on the other parts of the recipe."""
    return {
        "in_features": representation.features,
        "out_features": process.out_features(representation.features),
        "cond_features": condition.features,
        "length_unit": _length_unit(config),
    }


def _length_unit(config: Config) -> int:
    """Returns the unit of length: all training lengths are multiples of this number of frames."""
    crop = config.get("data", {}).get("crop")
    return crop.get("unit", 1) if isinstance(crop, dict) else 1


def sampling_defaults(
    *, guidance_scale: float, sampler: str, num_inference_steps: int | Sequence[int] | None
) -> SamplerOptions:
    """Returns the sampling options from the `task` section of a recipe.

    Raises:
        UserError: If a value is invalid.
    """
    if num_inference_steps is None:  # possible in a recipe from a file
        raise UserError("task.num_inference_steps=null: expected the number of sampling steps")
    try:
        return SamplerOptions(
            guidance_scale=guidance_scale, sampler=sampler, num_inference_steps=num_inference_steps
        )
    except UserError as error:
        raise UserError(f"task.{error}") from error


class Model:
    """Base class for the models that are stored in checkpoints."""

    # Noun for this kind of model in messages about its checkpoints
    noun = "a model"
    # The recipe, saved in checkpoints
    config: Config
    # Facts about the training data: actions, maximum length, fingerprint
    facts: dict[str, Any]
    # Number of training steps of the loaded checkpoint, or None if it is unknown
    steps: int | None = None
    # SHA-256 of the file that the model was loaded from, or "" if it was not loaded
    sha256: str = ""

    def add_facts(self, facts: Mapping[str, Any]) -> None:
        """Adds facts about the training data."""
        self.facts |= facts


class MotionGenerator(Model, nn.Module):
    """Samples motions with a denoiser, a process, a condition encoder and a representation.

    Args:
        parts: the four parts.
        sampler_options: default options of `generate`.

    Example:
        >>> import flame_mdm
        >>> from flame_mdm.batch import length_mask
        >>> model = flame_mdm.load("quickstart")
        >>> mask = length_mask(torch.tensor([20]))
        >>> batch = MotionBatch(torch.zeros(1, 20, 1), mask, ["first"], text=["a person walks"])
        >>> x = model.generate(batch, SamplerOptions(num_inference_steps=2), seed=0)
        >>> model.representation.to_joints(x).shape
        torch.Size([1, 20, 22, 3])
    """

    noun = "a motion generator"
    #: Kind of condition with which the model was trained.
    conditioned_on: Literal["none", "text", "action"]

    def __init__(self, parts: Parts, sampler_options: SamplerOptions):
        super().__init__()
        # Optimizer states in checkpoints refer to parameters by their index in this order.
        self.condition, self.representation = parts.condition, parts.representation
        self.denoiser, self.process = parts.denoiser, parts.process
        self.sampler_options = sampler_options
        self.conditioned_on = parts.condition.reads if parts.condition.features else "none"
        self.config, self.facts = {}, {}

    @classmethod
    def build(
        cls,
        config: Config,
        representation: Representation,
        *,
        actions: Sequence[str] = (),
        facts: Mapping[str, Any] | None = None,
    ) -> Self:
        """Builds the generator that a recipe describes.

        Args:
            config: the recipe.
            representation: conversion between motions and features.
            actions: names of the actions in the training data.
            facts: additional facts about the training data; see `add_facts`. Default: none.
        """
        parts = Parts.build(config, representation, len(actions))
        section = config["task"]
        defaults = sampling_defaults(
            guidance_scale=section["guidance_scale"],
            sampler=section["sampler"],
            num_inference_steps=section["num_inference_steps"],
        )
        generator = cls(parts, defaults)
        generator.config, generator.facts = config, {"actions": list(actions)}
        generator.add_facts(facts or {})
        return generator

    def add_facts(self, facts: Mapping[str, Any]) -> None:
        """Adds facts about the training data and passes the vocabulary to the text encoder."""
        super().add_facts(facts)
        if "vocabulary" in facts:
            self.condition.seen = frozenset(facts["vocabulary"])

    @property
    def device(self) -> torch.device:
        """The model's device."""
        return self.representation.mean.device

    def describe(self) -> str:
        """Returns the name of the denoiser's class."""
        return type(self.denoiser).__name__

    def check_request(self, options: SamplerOptions | None, unconditioned: bool) -> None:
        """Checks the arguments of `generate`. Subclasses may add checks.

        Raises:
            UserError: If this kind of model cannot sample with these arguments.
        """

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
        prefix: Tensor | None = None,
        unconditioned: bool = False,
        shared_noise: bool = False,
        trajectory: list[Tensor] | None = None,
    ) -> Tensor:
        """Samples motions for the conditions, lengths and ids of a batch.

        The noise of a motion is a function of (seed, replication, id). Therefore, a motion does not
        depend on the other motions in its batch.

        Args:
            batch: conditions, `mask` and `ids` of B motions. `x` is ignored.
            options: sampler options. Options that are None default to the recipe's values.
            seed: seed of the noise.
            replication: index of the replication, used to sample several motions per id.
            edit: part of a motion to keep.
            windows: overlapping windows that together cover motions longer than the training
                motions. The windows' conditions replace the conditions of the batch.
            prefix: (B, C, D) normalized features of the frames before the motions. Required if the
                denoiser has `context_frames` C. Such a model continues the prefix block by block
                and does not support `edit`, `windows` or `trajectory`.
            unconditioned: whether to sample a conditional model with its null condition.
            shared_noise: whether the noise depends only on (seed, replication), so that it is the
                same for all ids.
            trajectory: list to which the normalized clean estimate (B, F, D) from each call of the
                denoiser is appended.

        Returns:
            Normalized features (B, F, D), which are 0 past the end of each motion.

        Raises:
            UserError: If the model or its process cannot sample with these arguments.
        """
        self.check_request(options, unconditioned)
        options = self.sampler_options if options is None else options.over(self.sampler_options)
        was_training = self.training
        # Setting the mode of all modules takes as long as a forward pass of a small network.
        if was_training:
            self.eval()

        cond = self.encode(batch if windows is None else windows.batch, unconditioned)
        ids = ["shared"] * len(batch) if shared_noise else batch.ids
        if self.denoiser.context_frames:
            if edit is not None or windows is not None or trajectory is not None:
                raise UserError(
                    "this model continues motions block by block. Omit edit, windows and trajectory"
                )
            blocks = Blocks(
                self,
                ids,
                prefix,
                options,
                seed=seed,
                replication=replication,
                unconditioned=unconditioned,
            )
            count = ceil_div(batch.mask.shape[1], self.block_frames)
            x = torch.cat([blocks.sample(cond) for _ in range(count)], 1)[:, : batch.mask.shape[1]]
            if was_training:
                self.train()
            return x * batch.mask[..., None]

        mask, frames = batch.mask, batch.mask.shape[1]
        if windows is None and not self.denoiser.mask_padding:
            # This denoiser attends to padding, so motions are padded to the length used in
            # training.
            mask = pad_to(mask, max(frames, self.facts.get("max_frames", 0)))
            if edit is not None:
                padded = mask.shape[1]
                edit = replace(
                    edit, known=pad_to(edit.known, padded), keep=~pad_to(~edit.keep, padded)
                )

        features = self.representation.features
        noise = seeded_noise(
            ids, mask.shape[1], features, seed=seed, replication=replication, like=batch.x
        )

        denoise = self.guided(cond, options, unconditioned)
        if windows is not None:
            denoise = blended(denoise, windows)
        x = self.process.sample(
            denoise, noise, mask, cond, options, edit=edit, trajectory=trajectory
        )
        if was_training:
            self.train()
        return x[:, :frames]

    def encode(self, batch: MotionBatch, unconditioned: bool = False) -> Condition:
        """Returns the condition of a batch, or the null condition if `unconditioned`."""
        if not (unconditioned and self.condition.features):
            return self.condition(batch)
        nothing = torch.zeros(len(batch), dtype=torch.long, device=batch.x.device)
        empty = replace(batch, text=[""] * len(batch), action=nothing)
        return self.condition(empty).drop(nothing == 0)

    def guided(self, cond: Condition, options: SamplerOptions, unconditioned: bool) -> Denoise:
        """Returns the denoiser, with guidance if there is a condition."""
        scale = options.guidance_scale
        if scale is None or cond.null is None or not self.condition.features or unconditioned:
            return self.denoiser
        return classifier_free_guidance(self.denoiser, scale, self.representation.features)

    @property
    def block_frames(self) -> int:
        """Number of frames per block, for a model with `context_frames`."""
        return self.facts["max_frames"] - self.denoiser.context_frames

    def split_prefix(self, batch: MotionBatch) -> tuple[Tensor | None, MotionBatch]:
        """Splits motions into the clean prefix that the denoiser reads and the remaining frames.

        The prefix is (B, C, D), or None if the denoiser reads no prefix.
        """
        context = self.denoiser.context_frames
        if not context:
            return None, batch
        return batch.x[:, :context], replace(
            batch, x=batch.x[:, context:], mask=batch.mask[:, context:]
        )


FADE = 0.5
"""Time in seconds over which a jump between two blocks of a stream is faded out."""


class Blocks:
    """Generates motions block by block: each block continues the last frames of the previous one.

    Source: Tevet et al. 2025, "CLoSD". The noise of a block is a function of (seed, replication,
    id, block index). Changing a condition therefore affects only later blocks.

    Args:
        model: the model. Its denoiser has `context_frames` C.
        ids: names of the B motions, which seed the noise.
        prefix: (B, C, D) normalized features of the frames before the first block.
        options: sampler options, none of which may be None.
        seed: seed of the noise.
        replication: index of the replication, used to sample several motions per id.
        unconditioned: whether all conditions are null conditions. In this case, guidance is not
            applied.
        fade: if two blocks do not fit together, the jump at the seam is faded out over this number
            of frames; see `joined`. 0 = no fading, as in DiP's code.

    Raises:
        UserError: If the prefix is missing or has the wrong shape.
    """

    def __init__(
        self,
        model: MotionGenerator,
        ids: Sequence[str],
        prefix: Tensor | None,
        options: SamplerOptions,
        *,
        seed: int = 0,
        replication: int = 0,
        unconditioned: bool = False,
        fade: int = 0,
    ):
        expected = (len(ids), model.denoiser.context_frames, model.representation.features)
        if prefix is None or tuple(prefix.shape) != expected:
            shape = None if prefix is None else tuple(prefix.shape)
            raise UserError(
                f"the prefix has shape {shape}, but this model requires shape {expected}. Pass "
                "frames of this shape"
            )
        self.model, self.ids, self.prefix, self.options = model, list(ids), prefix, options
        self.seed, self.replication, self.unconditioned = seed, replication, unconditioned
        self.fade = fade
        self.number = 0  # index of the next block

    @torch.no_grad()
    def sample(
        self, cond: Condition, kept: Tensor | None = None, edit: Edit | None = None
    ) -> Tensor:
        """Samples the next block and returns its normalized features (B, P, D).

        Args:
            cond: the conditions of this block.
            kept: (B,) int64, number of frames to keep at the beginning of the block. The next block
                continues from the last of these frames. Default: all frames.
            edit: part of the block that is given rather than generated.
        """
        model, prefix = self.model, self.prefix
        frames, features = model.block_frames, model.representation.features
        names = [f"{name}\x1f{self.number}" for name in self.ids]
        noise = seeded_noise(
            names, frames, features, seed=self.seed, replication=self.replication, like=prefix
        )
        mask = torch.ones(len(prefix), frames, dtype=torch.bool, device=prefix.device)
        cond = replace(cond, prefix=prefix)
        denoise = model.guided(cond, self.options, self.unconditioned)
        x = model.process.sample(denoise, noise, mask, cond, self.options, edit=edit)
        if self.fade:
            after = x.clone()
            pose = model.representation.pose
            after[..., pose] = joined(prefix[..., pose], x[..., pose], self.fade)
            x = after if edit is None else torch.where(edit.keep, x, after)

        self.number += 1
        context = prefix.shape[1]
        kept = torch.full((len(x),), frames, device=x.device) if kept is None else kept
        last = kept[:, None] + torch.arange(context, device=x.device)
        rows = torch.arange(len(x), device=x.device)[:, None]
        self.prefix = torch.cat([prefix, x], 1)[rows, last]
        return x


def joined(before: Tensor, x: Tensor, fade: int) -> Tensor:
    """Removes the jump at the seam between two successive blocks of frames.

    The block is shifted so that the change at the seam is the mean of the changes before and after
    it. The shift then decays to zero over the next frames ("inertialization", Bollo 2018).

    Args:
        before: (B, C, D) features of the frames before the block.
        x: (B, P, D) features of the block.
        fade: number of frames over which the shift decays to zero.

    Returns:
        The shifted block (B, P, D).

    Example:
        >>> before, x = torch.zeros(1, 1, 1), torch.tensor([8.0, 8.0, 8.0, 8.0, 8.0])[None, :, None]
        >>> joined(before, x, fade=4).flatten().tolist()
        [0.0, 1.25, 4.0, 6.75, 8.0]
    """
    count = min(fade, x.shape[1])
    steps = [frames.diff(dim=1).sum(1) for frames in (before[:, -2:], x[:, :2])]
    jump = before[:, -1] + (steps[0] + steps[1]) / 2 - x[:, 0]
    share = torch.arange(count, device=x.device, dtype=x.dtype) / fade
    weight = (1 - share) ** 2 * (1 + 2 * share)
    moved = x[:, :count] + weight[:, None] * jump[:, None]
    return torch.cat([moved, x[:, count:]], 1)


class DistilledGenerator(MotionGenerator):
    """A student model, trained by `flame_mdm.training.distillation`.

    Guidance is built into its weights.
    """

    def __init__(self, parts: Parts, sampler_options: SamplerOptions):
        super().__init__(parts, sampler_options)
        # The sampler of student models has no path that an edit could overwrite.
        self.process.edit_modes = tuple(
            mode for mode in self.process.edit_modes if mode != "trajectory"
        )

    def check_request(self, options: SamplerOptions | None, unconditioned: bool) -> None:
        """Raises `UserError` if guidance or an unconditioned motion is requested.

        Student models support neither.
        """
        scale = None if options is None else options.guidance_scale
        if scale not in (None, 1):
            raise UserError(
                f"guidance_scale={scale}: the guidance is built into this distilled model. Omit guidance_scale"
            )
        if unconditioned and self.condition.features:
            raise UserError(
                "this distilled model was trained only with conditions and cannot sample without one. "
                f"Pass a {self.condition.reads}"
            )
