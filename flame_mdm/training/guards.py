"""Safeguards for long runs: run lock, divergence detection, and messages about killed processes."""

import re
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

import torch
from lightning import Callback, LightningModule, Trainer
from torch import Tensor

from flame_mdm.batch import MotionBatch
from flame_mdm.errors import UserError, say
from flame_mdm.safe_io import locked, write_json
from flame_mdm.safe_io.paths import check_tree, remove_abandoned


@contextmanager
def only_run(folder: Path) -> Iterator[None]:
    """Holds the lock `run.lock` in the run directory, which may come from an untrusted source.

    Raises `UserError` if another process on any host holds the lock, or if links in the directory
    lead out of it.
    """

    def refuse(owner: str) -> None:
        raise UserError(
            f"{folder}: {owner or 'another process'} is training in this directory. Choose another run.name, or stop "
            "that process"
        )

    check_tree(folder)
    new = not folder.exists()
    with locked(folder / "run.lock", refuse, "do not start a second run in this directory") as dead:
        if dead:
            say(f"{folder}: the previous {dead} died; taking over its run directory")
            remove_abandoned(folder / "checkpoints", is_locked=True)
        try:
            yield
        finally:
            # If there is no configuration, training has never started, and the folder contains only
            # the files of loggers.
            if new and not (folder / "config.yaml").exists():
                shutil.rmtree(folder, ignore_errors=True)


class BadLoss(Callback):
    """If a loss is not finite or explodes, stops training before a checkpoint is written.

    A loss explodes if it exceeds `factor` times the median loss of the previous log interval.
    `bad_batch.json` in the run directory describes the first bad batch: the step and, for each
    rank, the batch index, the clip ids and the loss.

    Args:
        folder: the run directory.
        factor: maximum ratio of a loss to the median loss of the previous log interval.
    """

    def __init__(self, folder: str, factor: float = 1000.0):
        # Copying a loss from the GPU requires waiting until the step is finished. Therefore, losses
        # stay on the device and are copied together, at the log interval and before a checkpoint.
        self.path, self.factor = Path(folder) / "bad_batch.json", factor
        self.usual = float("inf")
        self.seen: list[tuple[int, int, Sequence[str], Tensor]] = []

    def on_train_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        outputs: Any,
        batch: MotionBatch,
        batch_idx: int,
    ) -> None:
        """Stores the loss of each batch on the device. Checks all losses once per log interval."""
        loss = outputs["loss"] if isinstance(outputs, Mapping) else outputs
        self.seen.append((trainer.global_step, batch_idx, batch.ids, loss.detach().float()))
        if (batch_idx + 1) % trainer.log_every_n_steps == 0:  # type: ignore[attr-defined]
            self.check(trainer)

    def on_save_checkpoint(
        self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Checks the losses, so that no checkpoint contains weights updated after a bad loss."""
        self.check(trainer)

    def check(self, trainer: Trainer) -> None:
        """Raises `UserError` on all ranks at the same step if a loss since the last check is bad."""
        if not self.seen:
            return
        recent = torch.stack([loss for *_, loss in self.seen])
        parts = [recent]
        if trainer.world_size > 1:
            parts = [torch.empty_like(recent) for _ in range(trainer.world_size)]
            torch.distributed.all_gather(parts, recent)
        losses = torch.stack(parts).cpu()  # (processes, steps)
        bad = (~losses.isfinite() | (losses > self.factor * self.usual)).any(0)
        if bad.any():
            self._stop(trainer, int(bad.nonzero()[0]), losses)
        self.usual = float(losses.median())
        self.seen = []

    def _stop(self, trainer: Trainer, first: int, losses: Tensor) -> NoReturn:
        step, number, ids, loss = self.seen[first]
        batch = {
            "rank": trainer.global_rank,
            "batch": number,
            "ids": list(ids),
            "loss": str(float(loss)),
        }
        batches: list[Any] = [batch] * trainer.world_size
        if trainer.world_size > 1:
            torch.distributed.all_gather_object(batches, batch)
        if trainer.is_global_zero:
            write_json(self.path, {"step": step, "usual_loss": str(self.usual), "batches": batches})
        typical = f" (typical: {self.usual:.3g})" if self.usual < float("inf") else ""
        raise UserError(
            f"the loss at step {step} is {float(losses[:, first].max()):g}{typical}. The clips of the batch are listed "
            f"in {self.path}. Lower optimizer.lr, set trainer.gradient_clip_val, or inspect these clips. Earlier "
            "checkpoints are intact"
        )


def lost_worker(error: BaseException) -> UserError | None:
    """Returns an error message if `error` means that a data loading process died, else None."""
    # If a worker dies while a checkpoint is being written, its error is the cause of another error.
    message = f"{error} {error.__cause__ or ''}"
    lost = re.search(
        r"DataLoader worker \(pid.*?\) (is killed by signal|exited unexpectedly)", message
    )
    # A pipe of a data loader breaks before torch notices that its worker has died.
    if lost is None and not isinstance(error, ConnectionError | EOFError):
        return None
    return UserError(
        "a data loading process was killed, perhaps because memory ran out, or ended "
        "unexpectedly. Lower data.num_workers (0 = load in the main process), and run the same "
        "command again to resume from the last checkpoint"
    )


def out_of_memory(error: BaseException, step: int) -> UserError | None:
    """Returns an error message if `error` means that memory is exhausted, else None."""
    if not isinstance(error, torch.OutOfMemoryError) and "can't allocate memory" not in str(error):
        return None
    return UserError(
        f"out of memory at step {step}. Lower data.batch_size (trainer.accumulate_grad_batches compensates for it), "
        "set trainer.precision=bf16-mixed, or use shorter crops or a smaller network"
    )
