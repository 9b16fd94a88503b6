"""The network of FLAME (Kim et al. 2023, section "Architecture", tables 4, 6 and 7)."""

import math

import torch
from torch import Tensor, nn

from flame_mdm.batch import Condition
from flame_mdm.denoisers import Denoiser
from flame_mdm.denoisers.layers import Transformer, with_prefix
from flame_mdm.errors import UserError


class FLAME(Denoiser):
    """The network of FLAME: a transformer decoder over frames, with cross-attention to the text.

    The input of the decoder is [ML, TS, CLS, frame 1, frame 2, ...], and its memory is [ML, TS,
    CLS, text tokens]. ML embeds the length of the motion, TS is the sinusoid of the time, and CLS
    is the projected pooled condition. The output past the end of a motion is 0.

    Args:
        in_features: D, the number of features per frame.
        out_features: D, or 2 * D if the variance is learned.
        cond_features: C; 0 = unconditional.
        latent_dim: width of the layers.
        ff_size: hidden width of the feed-forward layers.
        num_layers: number of layers.
        num_heads: number of attention heads; must divide `latent_dim`.
        dropout: probability of dropout inside the layers.
        max_frames: maximum length of a motion that ML can embed.
        length_token: whether to include ML, which the first row of table 4 omits.
        cross_attention: whether to use a decoder with cross-attention. Otherwise, the network is a
            transformer encoder over ML, TS, CLS and frames (table 4, first two rows).
        condition_frames: whether to also add TS and CLS to every frame. A small network then learns
            to follow the text in fewer training steps.
        length_unit: unit of the embedded length, in frames. ML embeds the length rounded down to a
            multiple of this unit, because the lengths of all training windows are multiples of the
            unit.

    Example:
        >>> denoiser = FLAME(
        ...     6, 6, 4, latent_dim=8, ff_size=8, num_layers=1, num_heads=2, dropout=0.0, max_frames=20
        ... )
        >>> cond = Condition(torch.ones(2, 4), torch.ones(2, 3, 4), torch.ones(2, 3) > 0)
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
        ff_size: int,
        num_layers: int,
        num_heads: int,
        dropout: float,
        max_frames: int,
        length_token: bool = True,
        cross_attention: bool = True,
        condition_frames: bool = False,
        length_unit: int = 1,
    ):
        super().__init__()
        if type(length_unit) is not int or length_unit < 1:
            raise UserError(f"length_unit={length_unit}: expected a number of frames, at least 1")
        self.max_frames, self.condition_frames, self.length_unit = (
            max_frames,
            condition_frames,
            length_unit,
        )
        # A table of max_frames rows is sufficient for the lengths 1 to max_frames. Row 0, which the
        # authors' code never reads, is used for the longest motion.
        self.length_embedding = nn.Embedding(max_frames, latent_dim) if length_token else None
        self.input = nn.Linear(in_features, latent_dim)
        self.pooled_projection = nn.Linear(cond_features, latent_dim) if cond_features else None
        self.token_projection = (
            nn.Linear(cond_features, latent_dim) if cond_features and cross_attention else None
        )
        self.transformer = Transformer(
            latent_dim, ff_size, num_layers, num_heads, dropout, nn.ReLU, cross_attention
        )
        self.output = nn.Linear(latent_dim, out_features)

    def forward(self, x_t: Tensor, t: Tensor, mask: Tensor, cond: Condition) -> Tensor:
        """See `Denoiser.forward`. Raises `UserError` if a motion is longer than `max_frames`."""
        x = self.input(x_t)
        prefix = [cosine_first_sinusoid(t, x.shape[-1]).to(x_t.dtype)]
        if self.length_embedding is not None:
            lengths = mask.sum(1)
            if x_t.shape[1] > self.max_frames and lengths.max() > self.max_frames:
                raise UserError(
                    f"a motion of {int(lengths.max())} frames is too long for the length token. "
                    f"Increase denoiser.max_frames ({self.max_frames})"
                )
            lengths = (lengths // self.length_unit * self.length_unit).clamp(min=self.length_unit)
            prefix.insert(0, self.length_embedding(lengths % self.max_frames))
        if self.pooled_projection is not None:
            prefix.append(self.pooled_projection(cond.pooled))
        if self.condition_frames:
            x = (
                x
                + (prefix[-1] if self.pooled_projection is None else prefix[-1] + prefix[-2])[
                    :, None
                ]
            )
        prefix = torch.stack(prefix, 1)
        memory, memory_mask = prefix, None
        if self.token_projection is not None:
            memory = torch.cat([prefix, self.token_projection(cond.tokens)], 1)
            memory_mask = (
                None if cond.token_mask is None else with_prefix(cond.token_mask, prefix.shape[1])
            )
        x = torch.cat([prefix, x], 1)
        x = x + cosine_first_sinusoid(torch.arange(x.shape[1], device=x.device), x.shape[-1]).to(
            x_t.dtype
        )
        x = self.transformer(x, with_prefix(mask, prefix.shape[1]), memory, memory_mask)
        return self.output(x[:, prefix.shape[1] :]) * mask[..., None]


def cosine_first_sinusoid(position: Tensor, features: int) -> Tensor:
    """Embeds positions or times (N,) as float32 vectors (N, features).

    The first half of the features are cosines, and the second half are sines.
    """
    half = features // 2
    frequency = torch.exp(
        -math.log(10000.0) * torch.arange(half, device=position.device, dtype=torch.float32) / half
    )
    angle = position.float()[:, None] * frequency
    return torch.cat([angle.cos(), angle.sin()], -1)
