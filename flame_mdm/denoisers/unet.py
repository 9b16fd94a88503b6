"""The U-Net of MDM (Tevet et al. 2023, section 4.1). The code of this U-Net is not public.

The paper specifies convolutions over time, joints as channels, and 23.47 M parameters. All other
details follow the network of DDPM (Ho et al. 2020, appendix B), with the scale-and-shift injection
of Dhariwal and Nichol 2021.
"""

from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor, nn
from torch.nn import functional

from flame_mdm.batch import Condition
from flame_mdm.denoisers import Denoiser
from flame_mdm.denoisers.layers import TimeAndCondition
from flame_mdm.errors import UserError


class MDMUNet(Denoiser):
    """U-Net over time, for motions of any length. The features of a frame are its channels.

    Padding does not affect real frames. Padded frames are set to 0 before every convolution, as if
    the motion ended there, and are excluded from the normalization statistics. A frame at a coarser
    level is real if the first of its two frames at the finer level is real.

    Args:
        in_features: D, the number of features per frame.
        out_features: D, or 2 * D if the variance is learned.
        cond_features: C; 0 = unconditional.
        latent_dim: width of the time and condition embeddings.
        channels: width of each level. Each level has half the frame rate of the previous one.
        num_groups: number of groups in each group norm; must divide all widths.
        dropout: probability of dropout inside the blocks.
        project_condition: whether to project the condition before it is added to the time
            embedding.

    Example:
        >>> denoiser = MDMUNet(6, 6, 4, latent_dim=8, channels=[8, 16], num_groups=4, dropout=0.0)
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
        channels: Sequence[int],
        num_groups: int,
        dropout: float,
        project_condition: bool = True,
    ):
        super().__init__()
        block = partial(ResidualBlock, features=latent_dim, num_groups=num_groups, dropout=dropout)
        # With other lengths, the upsampled frames of some levels are cropped.
        self.frame_multiple = 2 ** (len(channels) - 1)
        self.condition = TimeAndCondition(latent_dim, cond_features, project_condition)
        self.input = nn.Conv1d(in_features, channels[0], 3, padding=1)
        finer = [channels[0], *channels[:-1]]
        self.down = nn.ModuleList(block(a, b) for a, b in zip(finer, channels, strict=True))
        self.downsample = nn.ModuleList(
            nn.Conv1d(c, c, 3, stride=2, padding=1) for c in channels[:-1]
        )
        self.middle = nn.ModuleList(block(channels[-1], channels[-1]) for _ in range(2))
        self.up = nn.ModuleList(block(2 * b, a) for a, b in zip(finer, channels, strict=True))
        self.upsample = nn.ModuleList(nn.Conv1d(c, c, 3, padding=1) for c in channels[:-1])
        self.output_norm = MaskedGroupNorm(channels[0], num_groups)
        self.output = nn.Conv1d(channels[0], out_features, 3, padding=1)

    def forward(self, x_t: Tensor, t: Tensor, mask: Tensor, cond: Condition) -> Tensor:
        """See `Denoiser.forward`."""
        token = functional.silu(self.condition(t, cond.pooled))
        masks = [mask[:, None, :: 2**level].to(x_t.dtype) for level in range(len(self.down))]
        x = self.input(x_t.transpose(1, 2) * masks[0])
        skips = []
        for level, block in enumerate(self.down):
            if level:
                x = self.downsample[level - 1](masked(x, masks[level - 1]))
            x = block(x, token, masks[level])
            skips.append(x)
        for block in self.middle:
            x = block(x, token, masks[-1])
        for level in reversed(range(len(self.up))):
            x = self.up[level](torch.cat([x, skips[level]], 1), token, masks[level])
            if level:
                x = x.repeat_interleave(2, -1)[..., : masks[level - 1].shape[-1]]
                x = self.upsample[level - 1](masked(x, masks[level - 1]))
        x = functional.silu(self.output_norm(x, masks[0]))
        return self.output(x * masks[0]).transpose(1, 2)


def masked(x: Tensor, mask: Tensor) -> Tensor:
    """Sets padded frames of x (B, C, F) to 0. Returns it in the precision of the mask (B, 1, F)."""
    # On a CPU, multiplying tensors of different precision takes longer than converting one.
    return x.to(mask.dtype) * mask


class ResidualBlock(nn.Module):
    """Residual block: norm, SiLU and convolution, twice.

    The embedding of time and condition scales and shifts the output of the second norm.
    """

    def __init__(
        self, in_channels: int, out_channels: int, features: int, num_groups: int, dropout: float
    ):
        super().__init__()
        self.norm1 = MaskedGroupNorm(in_channels, num_groups)
        self.conv1 = nn.Conv1d(in_channels, out_channels, 3, padding=1)
        self.scale_shift = nn.Linear(features, 2 * out_channels)
        self.norm2 = MaskedGroupNorm(out_channels, num_groups)
        self.dropout = nn.Dropout(dropout)
        self.conv2 = nn.Conv1d(out_channels, out_channels, 3, padding=1)
        self.skip = (
            nn.Conv1d(in_channels, out_channels, 1)
            if in_channels != out_channels
            else nn.Identity()
        )

    def forward(self, x: Tensor, token: Tensor, mask: Tensor) -> Tensor:
        """Returns the output (B, out_channels, F).

        Args:
            x: (B, in_channels, F), the input.
            token: (B, features), embedding of the time and the condition.
            mask: (B, 1, F), 1 = real frame, 0 = padding.
        """
        y = self.conv1(functional.silu(self.norm1(x, mask)) * mask)
        scale, shift = self.scale_shift(token).to(mask.dtype)[..., None].chunk(2, 1)
        y = functional.silu(self.norm2(y, mask) * (1 + scale) + shift)
        return self.skip(x) + self.conv2(self.dropout(y) * mask)


class MaskedGroupNorm(nn.Module):
    """Group norm (Wu and He 2018) whose statistics are computed only from real frames."""

    def __init__(self, channels: int, num_groups: int):
        super().__init__()
        if channels % num_groups:
            raise UserError(
                f"num_groups ({num_groups}) does not divide the number of channels ({channels})"
            )
        self.num_groups = num_groups
        self.weight = nn.Parameter(torch.ones(channels))
        self.bias = nn.Parameter(torch.zeros(channels))

    def forward(self, x: Tensor, mask: Tensor) -> Tensor:
        """Normalizes x (B, C, F). The mask (B, 1, F) is 1 for real frames and 0 for padding."""
        groups = x.to(mask.dtype).unflatten(1, (self.num_groups, -1))
        mask = mask[:, None]
        count = groups.shape[2] * mask.sum(-1, keepdim=True).clamp(min=1)
        centered = groups - (groups * mask).sum((2, 3), keepdim=True) / count
        variance = (centered * mask).square().sum((2, 3), keepdim=True) / count
        return (centered * (variance + 1e-5).rsqrt()).flatten(1, 2) * self.weight[
            :, None
        ] + self.bias[:, None]
