"""Skips work that Lightning does in every step but that this framework does not need.

A training step of a small network takes about 2 ms. A third of this time is Lightning's
bookkeeping, during which a GPU waits for the host.
"""

from contextlib import AbstractContextManager, nullcontext
from typing import Any

from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.profilers import PassThroughProfiler

STEP_HOOKS = (
    "on_train_batch_start",
    "on_before_zero_grad",
    "on_before_backward",
    "on_after_backward",
    "on_before_optimizer_step",
    "on_train_batch_end",
)
"""Hooks that Lightning calls in every step."""


class NoProfiler(PassThroughProfiler):
    """Profiler that measures nothing.

    Lightning's equivalent enters a generator-based context manager about 100 times per step.
    """

    nothing: AbstractContextManager[Any] = nullcontext()

    def profile(self, action_name: str) -> AbstractContextManager[Any]:
        """Returns a context that does nothing."""
        return self.nothing


def skip_empty_hooks(trainer: Trainer, task: LightningModule) -> None:
    """Sets empty hooks to None, so that Lightning does not call them in every step.

    Lightning calls six hooks per step, and callbacks override only some of them. Calling a hook
    takes longer than many of torch's operations.
    """
    owners: list[tuple[object, type]] = [(task, LightningModule)]
    owners += [(callback, Callback) for callback in trainer.callbacks]  # type: ignore[attr-defined]
    for owner, base in owners:
        for name in STEP_HOOKS:
            if getattr(type(owner), name) is getattr(base, name):
                setattr(owner, name, None)


def skip_exchange_of_signals(trainer: Trainer) -> None:
    """Prevents Lightning from asking all processes in every step whether one of them received SIGTERM.

    For each such request, the processes wait until the device has finished the previous step.
    `Checkpoints` replaces Lightning's SIGTERM handler and exchanges signals without waiting.
    """
    trainer.fit_loop.epoch_loop._broadcast_sigterm_tensor = _nothing  # type: ignore[method-assign]


def _nothing() -> None:
    """Does nothing."""
