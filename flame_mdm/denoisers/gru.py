"""The recurrent network of MDM (Tevet et al. 2023, section 4.1, appendix C)."""

import torch
from torch import Tensor, nn

from flame_mdm.batch import Condition
from flame_mdm.denoisers import Denoiser
from flame_mdm.denoisers.layers import TimeAndCondition, add_sinusoid


class MDMGRU(Denoiser):
    """GRU over the frames of a motion.

    Each frame is concatenated with the sum of the time and condition embeddings. The network runs
    forward in time, so padding at the end does not affect real frames.

    Args:
        in_features: D, the number of features per frame.
        out_features: D, or 2 * D if the variance is learned.
        cond_features: C; 0 = unconditional.
        latent_dim: width of the layers.
        num_layers: number of layers of the GRU.
        dropout: probability of dropout after the positional encoding.
        project_condition: whether to project the condition before it is added to the time
            embedding.
        recur_over_batch: whether the recurrence runs over the samples of the batch instead of over
            the frames. In MDM's released code, it runs over the samples because the axes are
            swapped. This option is intended only for reproduction, because results then depend on
            the order of the samples in the batch.

    Example:
        >>> denoiser = MDMGRU(6, 6, 4, latent_dim=8, num_layers=1, dropout=0.0)
        >>> cond = Condition(torch.ones(2, 4), torch.ones(2, 0, 4), None)
        >>> denoiser(torch.ones(2, 5, 6), torch.zeros(2), torch.ones(2, 5) > 0, cond).shape
        torch.Size([2, 5, 6])
    """

    def __init__(
        self,
        in_features: int,
        out_features: int,
        cond_features: int,
        *,
        latent_dim: int,
        num_layers: int,
        dropout: float,
        project_condition: bool = True,
        recur_over_batch: bool = False,
    ):
        super().__init__()
        self.condition = TimeAndCondition(latent_dim, cond_features, project_condition)
        self.input = nn.Linear(in_features + latent_dim, latent_dim)
        self.dropout = nn.Dropout(dropout)
        self.gru = nn.GRU(latent_dim, latent_dim, num_layers, batch_first=not recur_over_batch)
        self.output = nn.Linear(latent_dim, out_features)

    def forward(self, x_t: Tensor, t: Tensor, mask: Tensor, cond: Condition) -> Tensor:
        """See `Denoiser.forward`."""
        frames = x_t.shape[1]
        token = self.condition(t, cond.pooled)[:, None].expand(-1, frames, -1)
        x = self.input(torch.cat([x_t, token], -1)).to(x_t.dtype)
        x = self.dropout(add_sinusoid(x))
        return self.output(self.gru(x)[0])
