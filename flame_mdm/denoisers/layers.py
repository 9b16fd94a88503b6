"""Layers shared by the denoisers: sinusoids, transformer, and embedding of time and condition."""

import math
from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn import functional

from flame_mdm.errors import UserError


def sinusoid(position: Tensor, features: int) -> Tensor:
    """Returns sinusoidal embeddings (N, features) for positions (N,) (Vaswani et al. 2017, section 3.5).

    Even channels are sines, and odd channels are cosines. The embeddings are always computed in
    float32, regardless of the network's precision, as they were when the released weights were
    trained.
    """
    channel = torch.arange(0, features, 2, device=position.device, dtype=torch.float32)
    angle = position.float()[:, None] * torch.exp(channel * (-math.log(10000.0) / features))
    return torch.stack([angle.sin(), angle.cos()], -1).flatten(1)


def add_sinusoid(x: Tensor, positions: Tensor | None = None) -> Tensor:
    """Adds the embeddings of positions (N,) to a sequence (B, N, C). Default: positions 0 to N - 1.

    The embeddings are converted to the precision of the sequence. With autocast, convert the
    sequence to float32 first: on a CPU, adding tensors of different precision takes 10 times as
    long as converting one of them.
    """
    if positions is None:
        positions = torch.arange(x.shape[1], device=x.device)
    return x + sinusoid(positions, x.shape[-1]).to(x.dtype)


def with_prefix(mask: Tensor, prefix: int) -> Tensor:
    """Prepends `prefix` real entries to a mask (B, N)."""
    return torch.cat([mask.new_ones(mask.shape[0], prefix), mask], 1)


class Attention(nn.Module):
    """Multi-head attention from x to itself or to a memory (Vaswani et al. 2017, section 3.2.2).

    As in the released weights, query, key and value share one matrix (3C, C), so that
    self-attention needs only one projection.
    """

    def __init__(self, features: int, num_heads: int, dropout: float):
        super().__init__()
        if num_heads < 1 or features % num_heads:
            raise UserError(f"latent_dim ({features}) is not a multiple of num_heads ({num_heads})")
        self.num_heads, self.dropout = num_heads, dropout
        self.attend: Callable[..., Tensor] = functional.scaled_dot_product_attention
        self.qkv = nn.Linear(features, 3 * features)
        self.out = nn.Linear(features, features)
        nn.init.xavier_uniform_(self.qkv.weight)
        nn.init.zeros_(self.qkv.bias)
        nn.init.zeros_(self.out.bias)

    def forward(self, x: Tensor, mask: Tensor | None, memory: Tensor | None = None) -> Tensor:
        """Attends from x (B, N, C) to a memory, or to x if there is no memory.

        Args:
            x: (B, N, C), the queries.
            mask: (B, S) bool, True for real entries, or None if all entries are real.
            memory: (B, S, C), the keys and values. Default: x.
        """

        def heads(y: Tensor, parts: int) -> list[Tensor]:
            # Transposing after `unbind` saves a copy of the gradients of all parts.
            split = y.unflatten(-1, (parts, self.num_heads, -1)).unbind(2)
            return [part.transpose(1, 2) for part in split]

        if memory is None:
            query, key, value = heads(self.qkv(x), 3)
        else:
            size = x.shape[-1]
            weight, bias = self.qkv.weight, self.qkv.bias
            (query,) = heads(functional.linear(x, weight[:size], bias[:size]), 1)
            key, value = heads(functional.linear(memory, weight[size:], bias[size:]), 2)
        mask = None if mask is None else mask[:, None, None]
        dropout = self.dropout if self.training else 0.0
        return self.out(
            self.attend(query, key, value, attn_mask=mask, dropout_p=dropout)
            .transpose(1, 2)
            .flatten(2)
        )


class TransformerLayer(nn.Module):
    """Transformer layer: self-attention, optional cross-attention, and a feed-forward network.

    Each of these sublayers is followed by a residual sum and a layer norm.
    """

    def __init__(
        self,
        features: int,
        ff_size: int,
        num_heads: int,
        dropout: float,
        activation: type[nn.Module],
        cross_attention: bool,
    ):
        super().__init__()
        self.self_attention = Attention(features, num_heads, dropout)
        self.self_norm = nn.LayerNorm(features)
        self.cross_attention = Attention(features, num_heads, dropout) if cross_attention else None
        self.cross_norm = nn.LayerNorm(features) if cross_attention else None
        self.feed_forward = nn.Sequential(
            nn.Linear(features, ff_size),
            activation(),
            nn.Dropout(dropout),
            nn.Linear(ff_size, features),
        )
        self.feed_forward_norm = nn.LayerNorm(features)
        self.dropout = nn.Dropout(dropout)

    def forward(
        self, x: Tensor, mask: Tensor | None, memory: Tensor | None, memory_mask: Tensor | None
    ) -> Tensor:
        """Transforms a sequence.

        Args:
            x: (B, N, C), the sequence.
            mask: (B, N) bool, True for real entries, or None if all entries are real.
            memory: (B, S, C), the keys and values of cross-attention.
            memory_mask: (B, S) bool, True for real entries, or None if all entries are real.
        """
        x = self.self_norm(self._residual(x, self.self_attention(x, mask)))
        if self.cross_attention is not None and self.cross_norm is not None:
            y = self.cross_attention(x, memory_mask, memory)
            x = self.cross_norm(self._residual(x, y))
        return self.feed_forward_norm(self._residual(x, self.feed_forward(x)))

    def _residual(self, x: Tensor, y: Tensor) -> Tensor:
        """Adds the output y of a sublayer to its input x, both (B, N, C), with dropout."""
        # On a CPU, adding tensors of different precision takes 10 times as long as converting one,
        # and adding in place saves the time to allocate another tensor.
        total = self.dropout(y).to(x.dtype)
        total += x
        return total


class Transformer(nn.Module):
    """A stack of post-norm layers without a causal mask.

    With cross-attention, the stack is a decoder; otherwise, it is an encoder.
    """

    def __init__(
        self,
        features: int,
        ff_size: int,
        num_layers: int,
        num_heads: int,
        dropout: float,
        activation: type[nn.Module] = nn.GELU,
        cross_attention: bool = False,
    ):
        super().__init__()
        options = features, ff_size, num_heads, dropout, activation, cross_attention
        self.layers = nn.ModuleList(TransformerLayer(*options) for _ in range(num_layers))

    def forward(
        self,
        x: Tensor,
        mask: Tensor | None,
        memory: Tensor | None = None,
        memory_mask: Tensor | None = None,
    ) -> Tensor:
        """Transforms a sequence.

        Args:
            x: (B, N, C), the sequence.
            mask: (B, N) bool, True for real entries, or None if all entries are real.
            memory: (B, S, C), the memory of a decoder. Encoders have none.
            memory_mask: (B, S) bool, True for real entries, or None if all entries are real.
        """
        for layer in self.layers:
            x = layer(x, mask, memory, memory_mask)
        return x


class TimeAndCondition(nn.Module):
    """Embeds the time and the condition as MDM's token z_tk (Tevet et al. 2023, section 3).

    The embedding is the time's sinusoid, passed through two linear layers, plus the projected
    condition. The null condition is a zero vector *before* the projection, so that only the bias of
    the projection remains.
    """

    def __init__(self, features: int, cond_features: int, project_condition: bool):
        super().__init__()
        if cond_features and not project_condition and cond_features != features:
            raise UserError(
                f"project_condition=false requires latent_dim={cond_features}, the width of the "
                "condition"
            )
        self.features, self.cond_features = features, cond_features
        self.time_embedding = nn.Sequential(
            nn.Linear(features, features), nn.SiLU(), nn.Linear(features, features)
        )
        self.projection = (
            nn.Linear(cond_features, features)
            if cond_features and project_condition
            else nn.Identity()
        )

    def time(self, t: Tensor) -> Tensor:
        """Embeds times (B,) as vectors (B, features)."""
        return self.time_embedding(sinusoid(t, self.features).to(next(self.parameters()).dtype))

    def forward(self, t: Tensor, condition: Tensor) -> Tensor:
        """Embeds times (B,) and a condition (B, C) as vectors (B, features).

        A condition (B, S, C) is embedded as vectors (B, S, features).
        """
        return self.add(self.time(t), condition)

    def add(self, time: Tensor, condition: Tensor) -> Tensor:
        """Adds time embeddings (B, features) to the projected condition (B, C) or (B, S, C)."""
        if not self.cond_features:
            return time
        return self.projection(condition) + (time if condition.ndim == 2 else time[:, None])
