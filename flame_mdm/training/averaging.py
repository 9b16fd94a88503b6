"""Moving average of weights."""

from typing import Any

import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import WeightAveraging
from torch import Tensor
from torch.optim.swa_utils import get_ema_multi_avg_fn

from flame_mdm.errors import UserError


class MovingAverage(WeightAveraging):
    """Exponential moving average of the weights, for validation and for the saved model.

    By default, it computes the same average as Lightning's `EMAWeightAveraging`, but updates all
    parameters with a single call. Lightning's class iterates over all modules in every step and, on
    CUDA, waits for the device. Buffers are not averaged.

    Args:
        decay: the factor, from 0 to 1, in the update
            `average = decay * average + (1 - decay) * weights`.
        update_every_n_steps: number of steps between updates of the average.
        update_starting_at_step: up to this step, updates copy the weights instead of averaging
            them. The first update always copies the weights, unless `from_initial_weights` is true.
        from_initial_weights: whether the average starts from the weights before the first step, as
            in MDM's code. If so, the first update averages the weights instead of copying them.
    """

    def __init__(
        self,
        decay: float,
        update_every_n_steps: int = 1,
        update_starting_at_step: int = 0,
        from_initial_weights: bool = False,
    ):
        if not 0 <= decay <= 1:
            raise UserError(f"ema.decay={decay}: expected a number from 0 to 1")
        super().__init__(use_buffers=False)
        self.average = get_ema_multi_avg_fn(decay)
        self.update_every_n_steps = update_every_n_steps
        self.update_starting_at_step = update_starting_at_step
        self.from_initial_weights = from_initial_weights
        self.averages: list[Tensor] = []
        self.weights: list[Tensor] = []
        self.updates = torch.zeros(0)  # number of updates, which is saved with the averages
        self.begun = False

    def averaged(self) -> Any:
        """Returns the copy of the task that contains the averaged weights.

        During validation, the weights are swapped: the task contains the averaged weights, and the
        copy contains the trained weights.
        """
        assert self._average_model is not None
        return self._average_model.module

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Collects the parameters of the model and the average once, to save time in every step."""
        self.averages = [p.detach() for p in self.averaged().parameters()]
        self.weights = [p.detach() for p in pl_module.parameters()]
        for copy, module in zip(self.averaged().modules(), pl_module.modules(), strict=True):
            # The buffers are shared, so that both models always have the current values
            copy._buffers = module._buffers
        self.updates = self._average_model.n_averaged  # type: ignore[union-attr]
        self.begun = int(self.updates) > 0 or (
            self.from_initial_weights and trainer.global_step > 0
        )

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        """Before the first step, copies the initial weights.

        These weights may come from pretraining or from a teacher.
        """
        if self.from_initial_weights and not self.begun:
            self._copy_weights()
            self.begun = True

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        """Updates the average after an optimizer step."""
        step = trainer.global_step
        if step <= self._latest_update_step or step % self.update_every_n_steps:
            return
        if self.begun and step > self.update_starting_at_step:
            self.average(self.averages, self.weights, None)
        else:
            self._copy_weights()
        self.updates += 1
        self._latest_update_step, self.begun = step, True

    def _copy_weights(self) -> None:
        for average, weight in zip(self.averages, self.weights, strict=True):
            average.copy_(weight)
