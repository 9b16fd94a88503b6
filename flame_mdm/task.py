# pyright: standard
"""Lightning modules that train the models in `flame_mdm.generator`, such as `MotionGenerator`."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import torch
from lightning import LightningModule
from lightning.pytorch.utilities.types import OptimizerLRScheduler
from torch import Tensor
from torch.optim.lr_scheduler import LambdaLR
from torchmetrics import MeanMetric

from flame_mdm.batch import Condition, MotionBatch
from flame_mdm.conditions import ConditionEncoder
from flame_mdm.conditions.target import TargetConditions
from flame_mdm.conditions.vocabulary import vocabulary
from flame_mdm.config import Config, instantiate
from flame_mdm.data.datamodule import MotionDataModule
from flame_mdm.denoisers.recomputation import recompute_activations
from flame_mdm.errors import UserError, renamed_names, say
from flame_mdm.generator import Model, MotionGenerator, Parts, sampling_defaults
from flame_mdm.losses import MotionLosses
from flame_mdm.representations import Representation
from flame_mdm.seeds import key, normal, seed_generator, seeded_noise, uniform


class Task(Model, LightningModule):
    """Base class for all tasks that `make train` can run.

    A recipe names the class of its task in `task._target_`.
    """

    def __init__(self, *, optimizer: Config, seed: int):
        super().__init__()
        self.optimizer, self.seed = optimizer, seed
        self.config, self.facts = {}, {}
        self.reported: dict[str, Tensor | float] = {}  # values to log after this step
        self.prepare_data_per_node = False  # all machines of a cluster share the data folder

    @classmethod
    def build(
        cls,
        config: Config,
        representation: Representation,
        *,
        actions: Sequence[str] = (),
        facts: Mapping[str, Any] | None = None,
    ) -> Self:
        """Builds a recipe's task and sets the sizes that depend on other parts.

        Args:
            config: the recipe.
            representation: conversion between motions and features.
            actions: names of the actions in the training data.
            facts: additional facts about the training data; see `add_facts`. Default: none.
        """
        raise NotImplementedError

    def encoder(self) -> ConditionEncoder:
        """Returns the encoder for the captions or actions in the data."""
        raise NotImplementedError

    @property
    def data(self) -> MotionDataModule:
        """The data module of the trainer."""
        return self.trainer.datamodule  # type: ignore[attr-defined]

    def describe(self) -> str:
        """Returns the name of the network's class."""
        return type(getattr(self, "network", self)).__name__

    def prepare_data(self) -> None:
        """Encodes all captions in the data once, on one rank, if the encoder is frozen."""
        self.encoder().precompute(*self._captions())

    def setup(self, stage: str) -> None:
        """Opens the encodings from `prepare_data` and adds facts about the data."""
        data, encoder = self.data, self.encoder()
        size = encoder.load_cache(*self._captions())
        if device := data.choose_device(size):
            encoder.move_cache(device)
        # Buffers are identical in all processes. If DDP broadcast them in each forward pass, a
        # process with more validation batches than the others would wait forever.
        self._ddp_params_and_buffers_to_ignore = [name for name, _ in self.named_buffers()]
        self.add_facts(
            {
                "dataset": data.store.info["dataset"],
                "fingerprint": data.store.fingerprint,
                "max_frames": data.crop.longest(),
            }
        )
        if licenses := data.store.licenses():
            self.add_facts({"licenses": licenses})

    def _captions(self) -> tuple[list[str], Path]:
        """Returns the texts to encode and the folder in which to store their encodings.

        The texts are the captions in the data and the prompts of callbacks.
        """
        prompts = [text for c in self.trainer.callbacks for text in getattr(c, "texts", ())]  # type: ignore[attr-defined]
        return sorted({*self.data.captions(), *prompts}), self.data.folder.parent / "text"

    @property
    def is_reported(self) -> bool:
        """Whether the values of the current training step are logged."""
        trainer = self._trainer  # None if the step is computed without a trainer
        return trainer is None or (trainer.global_step + 1) % trainer.log_every_n_steps == 0  # type: ignore[attr-defined]

    def report(self, values: Mapping[str, Tensor | float]) -> None:
        """Stores named values of the current training step, to be logged after the step.

        `Measurements` writes them to the loggers. For each value, Lightning's `log` would take as
        long as a forward pass of a small network, and it would keep the host busy in all later
        steps.
        """
        if self.is_reported:
            for name, value in values.items():
                self.reported[name] = value.detach() if isinstance(value, Tensor) else value

    def make_optimizer(self) -> torch.optim.Optimizer:
        """Returns the recipe's optimizer for all trained parameters."""
        return instantiate(self.optimizer, params=[p for p in self.parameters() if p.requires_grad])

    def configure_optimizers(self) -> OptimizerLRScheduler:
        """Returns the optimizer and its learning-rate schedule.

        The learning rate rises linearly over the first `lr_warmup` steps. Over the last fraction
        `lr_decay` of the training run, the learning rate falls linearly to 0.
        """
        optimizer = self.make_optimizer()
        share = self.config.get("lr_decay") or 0.0
        if not 0 <= share <= 1:
            raise UserError(
                f"lr_decay={share}: expected a fraction of the training run, from 0 to 1"
            )
        warmup = self.config.get("lr_warmup") or 0
        if warmup < 0:
            raise UserError(f"lr_warmup={warmup}: expected a number of steps, at least 0")

        steps = self.trainer.max_steps
        falling = share * steps
        if not falling and not warmup:
            return optimizer

        def factor(step: int) -> float:
            rising = (step + 1) / warmup if warmup else 1.0
            remaining = max(0, steps - step) / falling if falling else 1.0
            return min(1.0, rising, remaining)

        schedule = LambdaLR(optimizer, factor)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def on_train_start(self) -> None:
        """Allows gradient clipping with fused optimizers in bfloat16.

        Lightning does not allow this combination, because such an optimizer may unscale gradients
        itself. In bfloat16, however, gradients are not scaled.
        """
        if self.trainer.precision == "bf16-mixed":
            for optimizer in self.trainer.optimizers:
                optimizer._step_supports_amp_scaling = False  # type: ignore[attr-defined]

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Adds the recipe and the facts about the data to the checkpoint, as plain values."""
        checkpoint["config"], checkpoint["facts"] = self.config, self.facts


class GeneratorTask(Task):
    """Trains a `MotionGenerator` with any denoiser and any process.

    In checkpoints, the weights have the same names as in the generator.

    Args:
        parts: the four parts of the generator.
        losses: weights of the `MotionLosses` for the clean estimate.
        optimizer: a mapping with the `_target_` of a torch optimizer and its arguments.
        cond_drop_prob: probability that a training sample receives the null condition.
        guidance_scale, sampler, num_inference_steps: defaults of `generate`; see
            `SamplerOptions`.
        seed: seed of all random draws during training, which are functions of (seed, batch number,
            rank).
        compile: whether to compile the denoiser with torch.compile when training begins.
        checkpoint_activations: whether to store fewer activations for the backward pass and
            recompute the others; see `flame_mdm.denoisers.recomputation`. The resulting weights are
            the same, but training steps are slower.
        targets: options of `TargetConditions`, required by a denoiser with a target encoder. If
            None, the model is trained without targets.

    If the denoiser has `context_frames`, the first `context_frames` frames of each training sample
    are its clean prefix, and only the later frames contribute to the losses.
    """

    noun = MotionGenerator.noun
    kind: type[MotionGenerator] = MotionGenerator  # class of the generator

    def __init__(
        self,
        parts: Parts,
        *,
        losses: dict[str, Any],
        optimizer: Config,
        cond_drop_prob: float,
        guidance_scale: float,
        sampler: str,
        num_inference_steps: int | list[int],
        seed: int = 0,
        compile: bool = False,
        checkpoint_activations: bool = False,
        targets: dict[str, Any] | None = None,
    ):
        super().__init__(optimizer=optimizer, seed=seed)
        if not 0 <= cond_drop_prob <= 1:
            raise UserError(
                f"task.cond_drop_prob={cond_drop_prob}: expected a probability from 0 to 1"
            )
        defaults = sampling_defaults(
            guidance_scale=guidance_scale, sampler=sampler, num_inference_steps=num_inference_steps
        )
        self.generator = self.kind(parts, defaults)
        self.register_state_dict_post_hook(_name_as_generator)
        self.register_load_state_dict_pre_hook(_name_as_task)
        representation = parts.representation
        skeleton = representation.skeleton
        self.losses = MotionLosses(
            representation.to_joints, skeleton.feet, skeleton.edges, **losses
        )
        self.targets = (
            None
            if targets is None
            else TargetConditions(skeleton.joints, skeleton.facing, **targets)
        )
        if (self.targets is None) != (getattr(parts.denoiser, "target", None) is None):
            raise UserError("task.targets and denoiser.target_encoder: set both or neither")
        self.cond_drop_prob, self.compiles = cond_drop_prob, compile
        self.checkpoints_activations = checkpoint_activations
        self.compiles_steps = False  # set by `speed=fast`
        self.compiled_loss: Callable[..., dict[str, Tensor]] | None = None
        self.val_losses = torch.nn.ModuleDict()

    @classmethod
    def build(
        cls,
        config: Config,
        representation: Representation,
        *,
        actions: Sequence[str] = (),
        facts: Mapping[str, Any] | None = None,
    ) -> Self:
        """Builds the task of a recipe; see `Task.build`."""
        parts = Parts.build(config, representation, len(actions))
        section = {name: value for name, value in config["task"].items() if name != "_target_"}
        task = cls(
            parts,
            losses=config["losses"],
            optimizer=config["optimizer"],
            seed=config["seed"],
            **section,
        )
        # The task and the generator share these objects, so that facts that are added during
        # training are also available for sampling.
        task.config = task.generator.config = config
        task.facts = task.generator.facts = {"actions": list(actions)}
        task.add_facts(facts or {})
        return task

    def encoder(self) -> ConditionEncoder:
        """Returns the encoder for the captions or actions in the data."""
        return self.generator.condition

    def add_facts(self, facts: Mapping[str, Any]) -> None:
        """Adds facts about the training data, which the task and the generator share."""
        self.generator.add_facts(facts)

    def describe(self) -> str:
        """Returns the name of the denoiser's class."""
        return self.generator.describe()

    def setup(self, stage: str) -> None:
        """Also stores the vocabulary of the training captions and passes it to the text encoder."""
        super().setup(stage)
        data = self.data
        if self.generator.conditioned_on != "action":
            # Some sources only know the names of their actions after all clips have been read
            self.add_facts({"actions": list(data.store.info["actions"])})
        context = self.generator.denoiser.context_frames
        shortest = int(data.crop.draw(data.crop.min_frames, lambda count: 0)[1])
        if context >= shortest:
            advice = "Increase data.crop.min_frames, or decrease denoiser.context_frames"
            raise UserError(
                f"data.crop: a sample of {shortest} frames has no frames left after a prefix of {context} frames. "
                f"{advice}"
            )
        if self.generator.conditioned_on == "text":
            clips, may_share = data.train.clips, data.source.may_share_captions
            captions = [text for clip in clips for text in clip.captions]
            shared = [text for clip in clips if may_share(clip.license) for text in clip.captions]
            self.add_facts(vocabulary(captions, shared or None))
            if data.source.verbs:
                self.add_facts({"verbs": list(data.source.verbs)})
        if self.checkpoints_activations:
            recompute_activations(self.generator.denoiser)
        if self.compiles:
            self.generator.denoiser.compile()

    def on_fit_start(self) -> None:
        """Samples once, with a denoiser that returns 0, so that invalid options are found early."""
        process = self.generator.process
        like = torch.zeros(1, 2, self.generator.representation.features, device=self.device)
        mask = torch.ones(1, 2, dtype=torch.bool, device=self.device)
        process.sample(
            lambda x_t, *_: x_t.new_zeros(1, 2, process.out_features(x_t.shape[-1])),
            seeded_noise(["trial"], 2, like.shape[-1], seed=0, replication=0, like=like),
            mask,
            Condition(like[:, 0], like, mask),
            self.generator.sampler_options,
        )

    def on_train_start(self) -> None:
        """Also trains the text encoder before the first step of a new run."""
        super().on_train_start()
        if self.global_step == 0:
            self.pretrain()

    def pretrain(self) -> None:
        """Trains the text encoder on captions before the first step, if the recipe requests it."""
        self.encoder().pretrain([clip.captions for clip in self.data.train.clips], self.seed)

    def training_step(self, batch: MotionBatch, batch_idx: int) -> Tensor:
        """Returns the loss of one batch.

        Random draws are functions of (seed, batch number, rank).
        """
        seed_generator(key("step", self.seed, batch_idx, self.global_rank), self.device)
        targeted = None if self.targets is None else torch.rand(2, len(batch), device=self.device)
        batch, cond = _conditioned(
            self.generator, self.targets, batch, None if targeted is None else targeted[0]
        )
        if self.targets is not None and targeted is not None:
            cond = replace(cond, target_mask=targeted[1] >= self.targets.drop_prob)
        # Drop conditions even with probability 0, because DDP requires a gradient for every
        # parameter
        if cond.null is not None:
            cond = cond.drop(self.dropped(batch))
        terms = self.loss_terms(batch, cond)
        if self.is_reported:
            self.report({f"train/{name}": value.mean() for name, value in terms.items()})
        return terms["loss"].mean()

    def dropped(self, batch: MotionBatch) -> Tensor:
        """Returns a random bool mask (B,), True for motions that receive the null condition."""
        return torch.rand(len(batch), device=self.device) < self.cond_drop_prob

    def loss_terms(
        self,
        batch: MotionBatch,
        cond: Condition,
        u: Tensor | None = None,
        noise: Tensor | None = None,
    ) -> dict[str, Tensor]:
        """Returns the losses (B,) of the motions in a batch, keyed by name; "loss" is their sum.

        Args:
            batch: the motions.
            cond: their conditions.
            u: (B,) uniform numbers in (0, 1), which determine the times. Default: drawn at random.
            noise: (B, F, D) standard normal noise. Default: drawn at random.
        """
        process = self.generator.process
        t = None if u is None else process.training_times(u)

        def auxiliary(x0_hat: Tensor, x: Tensor, mask: Tensor) -> dict[str, Tensor]:
            terms = self.losses(x0_hat, x, mask)
            if self.targets is not None and cond.target is not None:
                joints = self.generator.representation.to_joints(x0_hat)
                terms["target"] = self.targets.error(joints, cond.target, batch.lengths)
            return terms

        arguments = self.generator.denoiser, batch.x, batch.mask, cond
        if not (self.training and self.compiles_steps):
            return process.loss(*arguments, t=t, noise=noise, auxiliary=auxiliary)

        # The compiler would draw other random numbers.
        t, noise = process.drawn(batch.x, t, noise)
        if self.compiled_loss is None:
            # Tables are copied to the device in the first call, which is therefore not compiled.
            with torch.random.fork_rng([]):
                process.loss(*arguments, t=t, noise=noise, auxiliary=auxiliary)
            self.compiled_loss = torch.compile(process.loss)
        for x in (batch.x, batch.mask, noise, cond.tokens, cond.token_mask):
            if x is not None:
                torch._dynamo.maybe_mark_dynamic(x, 1)
        try:
            return self.compiled_loss(*arguments, t=t, noise=noise, auxiliary=auxiliary)
        except torch._dynamo.exc.TorchDynamoException as error:  # type: ignore[attr-defined]
            reason = " ".join(str(error).strip().splitlines()[:2])
            say(f"training without compilation, which takes longer: the compiler failed ({reason})")
            self.compiles_steps = False
        return process.loss(*arguments, t=t, noise=noise, auxiliary=auxiliary)

    def losses_of(self, batch: MotionBatch) -> dict[str, Tensor]:
        """Returns the validation losses (B,) of a batch of clips.

        A clip receives the same time, noise and target on every call.
        """
        keys = torch.tensor([key("validation", name) for name in batch.ids], device=self.device)
        u, v = (draw[:, 0] for draw in uniform(keys, (1,)))
        batch, cond = _conditioned(self.generator, self.targets, batch, v)
        noise = normal(keys, *batch.x.shape[1:])
        return self.loss_terms(batch, cond, u, noise)

    def validation_step(self, batch: MotionBatch, batch_idx: int) -> None:
        """Adds the losses of a batch to the validation means."""
        for name, value in self.losses_of(batch).items():
            if name not in self.val_losses:
                self.val_losses[name] = MeanMetric().to(self.device)
            self.val_losses[name].update(value)  # type: ignore[operator]

    def on_validation_epoch_end(self) -> None:
        """Logs each loss as a mean over the clips of all ranks, with equal weight for all clips."""
        for name, metric in self.val_losses.items():
            assert isinstance(metric, MeanMetric)
            self.log(f"val/{name}", metric.compute(), prog_bar=name == "loss")
            metric.reset()


def _conditioned(
    generator: MotionGenerator,
    targets: TargetConditions | None,
    batch: MotionBatch,
    u: Tensor | None,
) -> tuple[MotionBatch, Condition]:
    """Returns the motions to predict, without the prefix, and their conditions.

    `u` (B,) contains uniform numbers in (0, 1) that determine which targets are requested.
    """
    prefix, batch = generator.split_prefix(batch)
    cond = generator.condition(batch)
    if prefix is not None:
        cond = replace(cond, prefix=prefix)
    if targets is not None and u is not None:
        joints = generator.representation.to_joints(batch.x)
        cond = replace(cond, target=targets.draw(joints, u, batch.lengths))
    return batch, cond


def _name_as_generator(task: GeneratorTask, state: dict[str, Any], prefix: str, *_: object) -> None:
    """Removes "generator." from the names of the weights in a saved state."""
    for name in [name for name in state if name.startswith(f"{prefix}generator.")]:
        state[prefix + name.removeprefix(f"{prefix}generator.")] = state.pop(name)


def _name_as_task(task: GeneratorTask, state: dict[str, Any], prefix: str, *_: object) -> None:
    """Adds "generator." to the names of the weights in a state that is being loaded."""
    for name in [name for name in state if name.startswith(prefix)]:
        state[f"{prefix}generator.{name.removeprefix(prefix)}"] = state.pop(name)


__getattr__ = renamed_names(__name__, {"MotionGeneration": "GeneratorTask"}, since="0.3")
