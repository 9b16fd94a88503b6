"""Denoisers: networks that predict the target of a process from a noisy motion."""

from abc import ABC, abstractmethod

from torch import Tensor, nn

from flame_mdm.batch import Condition


class Denoiser(nn.Module, ABC):
    """Base class for denoisers.

    A denoiser predicts the target of a process from a noisy motion. Subclasses take some of the
    following arguments. The first three arguments depend on other parts of the model and are passed
    by `Parts.build`. All other arguments are set in the configuration.

    Args:
        in_features: D, the number of features per frame.
        out_features: D, or 2 * D if the variance is learned.
        cond_features: C, the width of the condition; 0 = unconditional.
        latent_dim: width of the layers.
        ff_size: hidden width of the feed-forward layers.
        num_layers: number of layers.
        num_heads: number of attention heads; must divide `latent_dim`.
        dropout: probability of dropout after the positional encoding and inside the layers, from 0
            to 1 (exclusive).
        project_condition: whether to project the condition before it is added to the time
            embedding. MDM does not project action embeddings. Without the projection, C must equal
            `latent_dim`.

    Example:
        >>> import torch
        >>> class Mean(Denoiser):  # a denoiser that returns the mean of the motion
        ...     def forward(self, x_t, t, mask, cond):
        ...         return x_t.mean(1, keepdim=True).expand_as(x_t)
        >>> x_t, mask = torch.ones(2, 5, 3), torch.ones(2, 5, dtype=torch.bool)
        >>> Mean()(x_t, torch.zeros(2), mask, Condition(x_t[:, 0], x_t[:, :0], None)).shape
        torch.Size([2, 5, 3])
    """

    #: Whether padding has no influence on real frames. If False, the network attends to padding,
    #: and sampling uses the padded length of the training batches.
    mask_padding: bool = True

    #: Number of clean frames that precede the motion. The network reads them from
    #: `Condition.prefix`.
    context_frames: int = 0

    #: A compiled network has only one graph for all lengths that are multiples of this number of
    #: frames.
    frame_multiple: int = 1

    @abstractmethod
    def forward(self, x_t: Tensor, t: Tensor, mask: Tensor, cond: Condition) -> Tensor:
        """Returns the prediction (B, F, out_features).

        The network is a pure function of its inputs, except for dropout during training.

        Args:
            x_t: (B, F, D) noisy motion.
            t: (B,) float in [0, 1000), the time, given as a row index into the sinusoidal table.
            mask: (B, F) bool, True for real frames. See also `mask_padding`.
            cond: the condition. For samples whose condition was dropped, `cond` already contains
                the null condition.

        Raises:
            UserError: If a motion is too long for the network, if there are no condition tokens or
                too many of them, or if the prefix does not have `context_frames` frames.
        """
