"""Denoisers: networks that predict the target of a process from a noisy motion."""

from abc import ABC, abstractmethod

from torch import Tensor, nn

from flame_mdm.batch import Condition


class Denoiser(nn.Module, ABC):
    """A network (x_t, t, mask, cond) -> prediction.

    The first arguments of subclasses are `in_features` (D), `out_features` (D, or 2D with a learned variance) and
    `cond_features` (C; 0 = unconditioned), which `task.build` passes; the others come from the configuration:
    `latent_dim`, the width of the layers; `ff_size`, the hidden width of feed-forward layers; `num_heads` of attention;
    `dropout` after the positions and inside the layers; `project_condition`, False to add the condition to the time
    without projection, as MDM does with action embeddings.
    """

    mask_padding: bool = True
    """Whether padding has no influence on real frames. A network that attends to it (False) is sampled at the padded
    length of its training."""

    context_frames: int = 0
    """Number of clean frames before the motion that the network reads in `Condition.prefix`."""

    @abstractmethod
    def forward(self, x_t: Tensor, t: Tensor, mask: Tensor, cond: Condition) -> Tensor:
        """Returns the prediction (B, F, out_features). A pure function, except for dropout in training.

        Args:
            x_t: (B, F, D) noisy motion.
            t: (B,) float in [0, 1000), the time as a row of the sinusoidal table.
            mask: (B, F) bool, True = real frame. See also `mask_padding`.
            cond: the condition, in which dropped samples are already replaced by nulls.

        Raises:
            UserError: If a motion is too long for the network, condition tokens are missing or too many, or the
                prefix is not `context_frames` long.
        """
