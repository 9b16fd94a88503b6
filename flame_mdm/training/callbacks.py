"""Training callbacks: checkpointing, interruption, progress, measurements, samples and report."""

import shlex
import signal
import sys
import time
from collections.abc import Mapping, Sequence
from inspect import getdoc, signature
from itertools import zip_longest
from pathlib import Path
from resource import RUSAGE_SELF, getrusage
from typing import Any

import numpy as np
import torch
from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import Checkpoint
from torch import Tensor
from torch.nn.utils import get_total_norm
from torch.optim import Optimizer
from torchmetrics import Metric

from flame_mdm.batch import ceil_div
from flame_mdm.checkpoints.locating import SHIPPED
from flame_mdm.checkpoints.model_files import read_model_file
from flame_mdm.conditions.action import ActionLabels
from flame_mdm.conditions.vocabulary import plainest
from flame_mdm.config import Config
from flame_mdm.data.datamodule import Clips, MotionDataModule
from flame_mdm.errors import UserError, say
from flame_mdm.formats.motion import Motion
from flame_mdm.generator import MotionGenerator
from flame_mdm.progress import ProgressBar
from flame_mdm.reporting.page import number
from flame_mdm.reporting.report import write_report
from flame_mdm.sampling.generation import sample
from flame_mdm.sampling.motion_request import SamplingRequest
from flame_mdm.sampling.output import degenerate_notes, write_motions
from flame_mdm.sampling.resolution import resolve
from flame_mdm.signals import StopRequest
from flame_mdm.task import GeneratorTask, Task
from flame_mdm.training.loggers import log_video
from flame_mdm.training.provenance import device_name

# Number of training clips whose metrics are compared with the metrics of samples
REAL = 64
# Number of motions to sample if there are no prompts
UNCONDITIONED = 4
# Motions that differ by less than this number of meters count as the same. Even if a model has
# learned little, its samples for different prompts differ by more.
SAME = 0.01
Values = Mapping[str, float]  # values by metric, or by metric/part


class Interrupted(Exception):
    """Raised when a signal has stopped training at the end of a step, after writing a checkpoint."""

    def __init__(self, signum: int, step: int):
        super().__init__(f"{signal.Signals(signum).name} at step {step}")
        self.signum, self.step = signum, step


class Checkpoints(Checkpoint):
    """Writes `last.ckpt` periodically, at the last step, and when training is interrupted.

    `keep_every_n_steps` is the number of steps between checkpoints that are kept permanently.
    Signals stop training at the end of the current step (`StopRequest`) or, with several ranks, at
    the end of the next step. Validation is never interrupted, because the averaged weights replace
    the trained weights while it runs.
    """

    def __init__(self, folder: str, every_n_steps: int, keep_every_n_steps: int | None = None):
        super().__init__()
        if every_n_steps < 1:
            raise UserError(
                f"callbacks.checkpoints.every_n_steps={every_n_steps}: must be at least 1"
            )
        self.folder = Path(folder)
        self.every_n_steps, self.keep_every_n_steps = every_n_steps, keep_every_n_steps
        self.stop = StopRequest()
        self.exchanged = torch.tensor(0)
        self.step = -1

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Starts recording signals, so that they do not terminate the process."""
        self.step = trainer.global_step
        self.stop.install()

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        """Saves a checkpoint if one is due.

        If any rank received a signal, saves a checkpoint and stops training.
        """
        if trainer.global_step == self.step:  # gradients are still being accumulated
            return
        self.step = trainer.global_step
        signum = self.stop.signum
        if trainer.world_size > 1:
            # All processes act on the signal that was exchanged in the previous step. To read the
            # signal of the current step, they would have to wait until the device has finished it.
            signum, received = int(self.exchanged), torch.tensor(signum, device=pl_module.device)
            torch.distributed.all_reduce(received, torch.distributed.ReduceOp.MAX)
            self.exchanged = received
        last = bool(signum) or trainer.should_stop or self.step >= trainer.max_steps > 0
        if last or self.step % self.every_n_steps == 0:
            trainer.save_checkpoint(self.folder / "last.ckpt")
        if self.keep_every_n_steps and self.step % self.keep_every_n_steps == 0:
            trainer.save_checkpoint(self.folder / f"step={self.step:07d}.ckpt")
        if signum:
            raise Interrupted(signum, self.step)

    def on_train_end(self, *_: Any) -> None:
        """Restores the signal handlers."""
        self.stop.restore()

    def on_exception(self, *_: Any) -> None:
        """Restores the signal handlers."""
        self.on_train_end()


class Measurements(Callback):
    """Logs the gradient norm, learning rate and speed every `trainer.log_every_n_steps` steps.

    The values that the task reports are logged at the same steps, so logging slows down no other
    step. The gradient norm includes all gradients and is measured before clipping. The seconds per
    step do not include validation.

    Adds `facts.training` to checkpoints: `hours` (duration of training so far, including
    validation), `processes` (number of processes), `device`, `speed`, `precision`, and `memory_gib`
    (peak memory of the tensors on CUDA, or of the first process on other devices).
    """

    def __init__(self) -> None:
        self.begin = self.since = 0.0
        self.first = 0  # number of steps at the time `since`
        self.earlier: dict[str, float] = {}

    def on_load_checkpoint(
        self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Restores the totals that the run had reached before it was interrupted."""
        self.earlier = checkpoint["facts"].get("training", {})

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Starts the clocks."""
        self.begin = self.since = time.perf_counter()
        self.first = trainer.global_step

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Restarts the speed clock, so that validation time is not counted."""
        self.since, self.first = time.perf_counter(), trainer.global_step

    def on_save_checkpoint(
        self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Adds the duration and peak memory so far to the facts in the checkpoint."""
        if pl_module.device.type == "cuda":
            memory = torch.cuda.max_memory_allocated(pl_module.device) / 2**30
        else:
            memory = getrusage(RUSAGE_SELF).ru_maxrss / (
                2**30 if sys.platform == "darwin" else 2**20
            )
        assert isinstance(pl_module, Task)
        pl_module.facts["training"] = {
            "hours": self.earlier.get("hours", 0.0) + (time.perf_counter() - self.begin) / 3600,
            "memory_gib": max(self.earlier.get("memory_gib", 0.0), memory),
            "processes": trainer.world_size,
            "device": device_name(trainer),
            "speed": pl_module.config.get("run", {}).get("speed", "reference"),
            "precision": trainer.precision,
        }

    def on_before_optimizer_step(
        self, trainer: Trainer, pl_module: LightningModule, optimizer: Optimizer
    ) -> None:
        """Logs the norm of the gradients."""
        assert isinstance(pl_module, Task)
        if pl_module.is_reported:
            gradients = [p.grad for p in pl_module.parameters() if p.grad is not None]
            norm, lr = get_total_norm(gradients), optimizer.param_groups[0]["lr"]
            pl_module.report({"train/grad_norm": norm, "train/lr": lr})

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        """Logs the values that the task reported, as well as the speed."""
        step = trainer.global_step
        steps = step - self.first
        if step % trainer.log_every_n_steps or not steps:  # type: ignore[attr-defined]  # or gradients are accumulated
            return
        assert isinstance(pl_module, Task)
        data: MotionDataModule = trainer.datamodule  # type: ignore[attr-defined]
        seconds = (time.perf_counter() - self.since) / steps
        samples = data.batch_size * trainer.world_size * trainer.accumulate_grad_batches
        values: dict[str, Tensor | float] = {
            **pl_module.reported,
            "train/epochs": step * samples / len(data.train),
            "train/samples_per_second": samples / seconds,
            "train/seconds_per_step": seconds,
        }
        if pl_module.device.type == "cuda":
            memory = torch.cuda.max_memory_allocated(pl_module.device)
            values["train/gpu_memory_gib"] = memory / 2**30
        pl_module.reported.clear()
        log_values(trainer, values)
        self.since, self.first = time.perf_counter(), step


def log_values(trainer: Trainer, values: Mapping[str, Tensor | float]) -> None:
    """Writes the values of a training step to all loggers, and passes them to all callbacks.

    Tensors are copied from the device together, so that the host waits for the device only once.
    """
    tensors = {name: x for name, x in values.items() if isinstance(x, Tensor)}
    copied = torch.stack([x.detach().float() for x in tensors.values()]).tolist() if tensors else []
    numbers = {**values, **dict(zip(tensors, copied, strict=True))}
    shown = {name: torch.tensor(number) for name, number in numbers.items()}
    trainer.callback_metrics.update(shown)
    trainer.logged_metrics.update(shown)
    for logger in trainer.loggers:
        # Lightning counts steps from 0.
        logger.log_metrics({**numbers, "epoch": trainer.current_epoch}, trainer.global_step - 1)
        logger.save()


class Report(Callback):
    """Prints the last losses at the end of training, writes `report.html`, and suggests the next commands."""

    def __init__(self, folder: Path):
        self.folder = folder

    def on_fit_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Prints the last losses, writes the report, and prints the next commands to run."""
        if not trainer.is_global_zero:
            return
        texts = {"train/loss": "on the last batch", "val/loss": "on the validation clips"}
        values = trainer.callback_metrics
        if losses := ", ".join(
            f"{values[name]:.4g} {text}" for name, text in texts.items() if name in values
        ):
            say(
                f"loss after {trainer.global_step} steps: {losses} (lower is better; comparable only within a recipe)"
            )
        say(f"report: {write_report(self.folder)}")
        if isinstance(pl_module, GeneratorTask):
            example = {
                "text": f"text={next(iter(plainest(pl_module.facts.get('captions', ()))), 'a person walks')}",
                "action": f"action={next(iter(pl_module.facts['actions']), '')}",
                "none": "unconditioned=true",
            }[pl_module.generator.conditioned_on]
            say(f"next: {shlex.join(['flame-mdm', 'sample', str(self.folder), example])}")
            extractor = (
                f"extractor={_extractor_in_package(pl_module.config, pl_module.facts) or 'none'}"
            )
            say(
                f"      {shlex.join(['flame-mdm', 'evaluate', str(self.folder), extractor, 'quick=true'])}"
            )


def _extractor_in_package(config: Config, facts: Mapping[str, Any]) -> str:
    """Returns the name of this package's extractor for a model's motions, or "" if there is none."""
    name = f"motion_clip_{facts.get('dataset')}"
    if name not in SHIPPED or "captions" not in facts:
        return ""
    trained = read_model_file(SHIPPED[name])["config"]
    return name if trained["representation"] == config.get("representation") else ""


def explain_metrics(values: Values, real: Values, metrics: Mapping[str, Metric]) -> list[str]:
    """Returns lines that explain each metric and show its values for generated and real motions."""
    lines = []
    for name, metric in metrics.items():
        shown = {key: value for key, value in values.items() if key.partition("/")[0] == name}
        if shown:
            better = {True: " Higher is better.", False: " Lower is better.", None: ""}[
                metric.higher_is_better
            ]
            lines.append(f"{name}: {(getdoc(type(metric)) or '').partition(chr(10))[0]}{better}")
        for key, value in shown.items():
            reference = f" (real motions: {number(real[key])})" if key in real else ""
            lines.append(f"  {key}: {number(value)}{reference}")
    return lines


class Progress(Callback):
    """Progress bar over the steps of a run, with the remaining time and the losses."""

    bar: ProgressBar | None = None

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Shows the bar. In a resumed run, it starts at the current step."""
        self.bar = ProgressBar(
            desc="training",
            initial=trainer.global_step,
            total=trainer.max_steps if trainer.max_steps > 0 else None,
            unit="step",
            smoothing=0,  # the remaining time includes validation and sampling
            dynamic_ncols=True,
            disable=not trainer.is_global_zero,
        )

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        """Advances the bar and shows the latest values."""
        assert self.bar is not None
        steps = trainer.global_step - self.bar.n
        if self.bar.disable or not steps:  # or gradients are still being accumulated
            return
        if trainer.global_step % trainer.log_every_n_steps == 0:  # type: ignore[attr-defined]
            values = trainer.callback_metrics
            losses = {
                name: f"{values[name]:.4g}" for name in ("train/loss", "val/loss") if name in values
            }
            self.bar.set_postfix(losses, refresh=False)
        self.bar.update(steps)

    def on_train_end(self, *_: Any) -> None:
        """Closes the bar."""
        if self.bar is not None:
            self.bar.close()

    def on_exception(self, *_: Any) -> None:
        """Closes the bar."""
        self.on_train_end()


def are_same(motions: Sequence[Motion]) -> bool:
    """Returns whether the motions differ by less than `SAME`.

    If so, the network probably ignores its input. If the learning rate is too high, the network may
    learn to return the same pose for all prompts and noise. Its loss is finite and even decreases
    slightly, so the curves do not reveal the failure.
    """
    if len(motions) < 2:
        return False
    frames = min(len(motion.joints) for motion in motions)
    joints = np.stack([motion.joints[:frames] for motion in motions])
    return bool(np.ptp(joints, axis=0).max() < SAME)


class SampleMotions(Callback):
    """Generates samples for fixed prompts and noise, writes them to files, and logs a video.

    Args:
        folder: folder of the samples. The samples of each step are written to a subfolder such as
            `step_0001000`.
        every_n_steps: minimum number of steps between samples. Samples are generated when the model
            is validated, and after training.
        prompts: texts, action names, or (text, requested attributes) pairs. If None,
            `UNCONDITIONED` motions are generated without prompts. If a model is conditioned on
            actions and no prompt is an action, the model's first actions are used instead.
        seconds: length of the motions in seconds.
        metrics: torchmetrics metrics, keyed by name. Their `update` methods take some of the
            arguments joints (B, F, J, 3), mask (B, F), keys and requested.
    """

    def __init__(
        self,
        folder: str,
        every_n_steps: int,
        prompts: Sequence[str | tuple[str, dict[str, Any]]] | None,
        seconds: float,
        metrics: dict[str, Metric] | None = None,
    ):
        if not seconds > 0:
            raise UserError(f"callbacks.samples.seconds={seconds}: must be greater than 0")
        self.folder, self.every_n_steps, self.seconds = Path(folder), every_n_steps, seconds
        self.prompts = [
            (p, {}) if isinstance(p, str) else (p[0], dict(p[1])) for p in prompts or []
        ]
        self.metrics, self.next = metrics or {}, every_n_steps
        self.written: tuple[int, Path, Values] = (-1, self.folder, {})
        self.notes: list[str] = []

    @property
    def texts(self) -> list[str]:
        """Texts of the prompts."""
        return [text for text, _ in self.prompts]

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Schedules the first samples. If the model needs actions, replaces text prompts."""
        self.next = trainer.global_step + self.every_n_steps
        assert isinstance(pl_module, GeneratorTask)
        actions = pl_module.facts["actions"]
        if isinstance(pl_module.generator.condition, ActionLabels) and not set(self.texts) & set(
            actions
        ):
            # The prompts are texts if a text-to-motion recipe was overridden with condition=action.
            self.prompts = [(action, {"action": action}) for action in actions[: len(self.prompts)]]

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        """Writes samples if they are due and the data has no validation clips."""
        if not len(trainer.datamodule.val):  # type: ignore[attr-defined]  # a data set without validation clips
            self._write_if_due(trainer, pl_module)

    def on_validation_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Writes samples if they are due."""
        self._write_if_due(trainer, pl_module)

    def _write_if_due(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if trainer.global_step >= self.next:
            self.next += self.every_n_steps
            self.write(trainer, pl_module)

    def on_fit_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Writes samples of the final model.

        Also prints the metrics of these samples and of real motions.
        """
        # The last validation may already have written the samples of this step.
        if self.written[0] != trainer.global_step:
            self.write(trainer, pl_module)
        _, folder, values = self.written
        if trainer.is_global_zero:
            real = self._measure_real(trainer.datamodule.train, pl_module) if values else {}  # type: ignore[attr-defined]
            say(*explain_metrics(values, real, self.metrics))
            say(*self.notes)
            say(
                f"player: {folder / 'player.html'} (open in any browser), animation: {folder / 'motions.gif'}"
            )

    def write(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Samples some of the motions on each rank. Rank 0 measures, writes and logs all of them."""
        assert isinstance(pl_module, GeneratorTask)
        step = trainer.global_step
        folder = self.folder / f"step_{step:07d}"
        motions = self._sample(pl_module.generator, trainer.global_rank, trainer.world_size)
        if trainer.world_size > 1:
            parts: list[Any] = [None] * trainer.world_size
            torch.distributed.all_gather_object(parts, motions)
            motions = [
                motion for row in zip_longest(*parts) for motion in row if motion is not None
            ]
        values: Values = {}
        if trainer.is_global_zero:
            write_motions(folder, motions, {"seed": 0, "step": step, "checkpoint": ""})
            if are_same(motions):
                say(
                    f"warning: step {step}: all {len(motions)} samples are the same motion. The network's output "
                    "no longer depends on its input. Stop, and train again with a lower optimizer.lr"
                )
            requested = [attributes for _, attributes in self.prompts]
            values = self.measure(
                [torch.from_numpy(motion.joints) for motion in motions], requested
            )
            for logger in trainer.loggers:
                # Lightning counts steps from 0, and therefore logs this validation at `step - 1`.
                log_video(logger, "samples", folder / "motions.gif", step - 1)
                logger.log_metrics(
                    {f"samples/{name}": value for name, value in values.items()}, step - 1
                )
        self.written = (step, folder, values)
        self.notes = degenerate_notes(motions)

    def _sample(self, model: MotionGenerator, rank: int, world: int) -> list[Motion]:
        """Samples every `world`-th prompt, starting at `rank`.

        Without prompts, rank 0 samples all motions.
        """
        texts, kind = self.texts[rank::world], model.conditioned_on
        count = len(texts) if self.texts else UNCONDITIONED * (rank == 0)
        if not count:
            return []
        request = SamplingRequest(
            texts=texts if texts and kind == "text" else None,
            actions=texts if texts and kind == "action" else None,
            frames=min(round(self.seconds * model.representation.fps), model.facts["max_frames"]),
            samples=1 if texts and kind != "none" else count,
            seed=0,
            split=False,
        )
        return sample(model, resolve(request, model, check_words=False))

    def _measure_real(self, clips: Clips, task: LightningModule) -> Values:
        """Computes all metrics for up to `REAL` training clips.

        A clip is used only if it is labeled with the attributes that all prompts have in common.
        """
        assert isinstance(task, GeneratorTask)
        names = [set(requested) for _, requested in self.prompts]
        common, all_names = (
            (set.intersection(*names), set.union(*names)) if names else (set(), set())
        )
        usable = [k for k, clip in enumerate(clips.clips) if common <= clip.attributes.keys()]
        chosen = usable[:: max(1, ceil_div(len(usable), REAL))]
        representation = task.generator.representation
        features = (clips[k, -1][1][None].to(representation.mean.device) for k in chosen)
        joints = [representation.to_joints(x)[0].cpu() for x in features]
        attributes = [
            {name: v for name, v in clips.clips[k].attributes.items() if name in all_names}
            for k in chosen
        ]
        return self.measure(joints, attributes) if chosen else {}

    def measure(self, motions: Sequence[Tensor], requested: Sequence[dict[str, Any]]) -> Values:
        """Returns all metrics that can be computed for motions (F, J, 3) in meters."""
        values: dict[str, float] = {}
        for name, metric in self.metrics.items():
            metric.reset()
            # `bool()` returns False: metrics are not synchronized, because this process has all
            # motions.
            metric.distributed_available_fn = bool
            for key, (motion, attributes) in enumerate(zip(motions, requested, strict=True)):
                mask = torch.ones(1, len(motion), dtype=torch.bool)
                inputs = {
                    "joints": motion[None],
                    "mask": mask,
                    "requested": [attributes],
                    "keys": torch.tensor([key]),
                }
                metric.update(
                    **{k: v for k, v in inputs.items() if k in signature(metric.update).parameters}
                )
            result = metric.compute()
            parts = result if isinstance(result, dict) else {"": result}
            values |= {
                f"{name}/{k}".rstrip("/"): float(v) for k, v in parts.items() if v is not None
            }
        return values
