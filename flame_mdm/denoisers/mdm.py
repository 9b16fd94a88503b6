"""The transformers of the Human Motion Diffusion Model (Tevet et al. 2023, "MDM", section 3 and appendix C)."""

from typing import Literal

import torch
from torch import Tensor, nn

from flame_mdm.batch import Condition
from flame_mdm.denoisers import Denoiser
from flame_mdm.denoisers.layers import TimeAndCondition, Transformer, sinusoid, with_prefix
from flame_mdm.errors import UserError


class MDMEncoder(Denoiser):
    """Transformer encoder over [time + condition, frame 1, frame 2, ...]; the network of MDM and of MFM.

    Args:
        max_tokens: 0 = the pooled condition is added to the time. Otherwise the maximum number of condition tokens
            between the time and the frames (MFM with T5: 30); frames keep their positions if there are fewer.
        mask_padding: False lets frames attend to the padding, as the released models of MDM and MFM do: they are
            sampled at the padded length of their training and cropped.
        condition_frames: also add time + condition (with `max_tokens`, the time) to every frame: a small network
            follows the text after fewer steps.
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
        project_condition: bool = True,
        max_tokens: int = 0,
        mask_padding: bool = True,
        condition_frames: bool = False,
    ):
        super().__init__()
        self.max_tokens, self.mask_padding, self.condition_frames = max_tokens, mask_padding, condition_frames
        self.condition = TimeAndCondition(latent_dim, cond_features, project_condition)
        self.input = nn.Linear(in_features, latent_dim)
        self.dropout = nn.Dropout(dropout)
        self.transformer = Transformer(latent_dim, ff_size, num_layers, num_heads, dropout)
        self.output = nn.Linear(latent_dim, out_features)

    def forward(self, x_t: Tensor, t: Tensor, mask: Tensor, cond: Condition) -> Tensor:
        token_mask = mask[:, :0]
        if self.max_tokens:
            tokens, token_mask = condition_tokens(cond)
            if tokens.shape[1] > self.max_tokens:
                raise UserError(f"denoiser.max_tokens={self.max_tokens}: give at least {tokens.shape[1]}")
            prefix = torch.cat([self.condition.time(t)[:, None], self.condition.projection(tokens)], 1)
        else:
            prefix = self.condition(t, cond.pooled)[:, None]
        size = prefix.shape[1]
        positions = torch.arange(1 + self.max_tokens + x_t.shape[1], device=x_t.device)
        positions = torch.cat([positions[:size], positions[1 + self.max_tokens :]])  # frames keep theirs
        frames = self.input(x_t)
        x = torch.cat([prefix, frames + prefix[:, :1] if self.condition_frames else frames], 1)
        x = self.dropout(x + sinusoid(positions, x.shape[-1]).to(x_t.dtype))
        frame_mask = mask if self.mask_padding else torch.ones_like(mask)
        x = self.transformer(x, with_prefix(torch.cat([token_mask, frame_mask], 1), 1))
        return self.output(x[:, size:])


class MDMDecoder(Denoiser):
    """Transformer decoder over the frames, with time + condition as cross-attention memory.

    Args:
        input_token: token before the frames: "condition" is time + condition, as in the paper's "+ input token" and the
            released model; "time" is the time alone, as in MDM's code since February 2025.
        token_memory: memory of all condition tokens, with the time added to each, as MDM with DistilBERT.
        mask_padding: False lets frames attend to the padding, as the released models without `mask_frames` do.
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
        project_condition: bool = True,
        input_token: Literal["none", "condition", "time"] = "none",
        token_memory: bool = False,
        mask_padding: bool = True,
    ):
        super().__init__()
        self.input_token, self.mask_padding = input_token, mask_padding
        self.token_memory = token_memory and cond_features > 0
        self.condition = TimeAndCondition(latent_dim, cond_features, project_condition)
        self.input = nn.Linear(in_features, latent_dim)
        self.dropout = nn.Dropout(dropout)
        self.transformer = Transformer(latent_dim, ff_size, num_layers, num_heads, dropout, cross_attention=True)
        self.output = nn.Linear(latent_dim, out_features)

    def forward(self, x_t: Tensor, t: Tensor, mask: Tensor, cond: Condition) -> Tensor:
        x = self.input(x_t)
        if self.input_token == "condition":
            x = torch.cat([self.condition(t, cond.pooled)[:, None], x], 1)
        elif self.input_token == "time":
            x = torch.cat([self.condition.time(t)[:, None], x], 1)
        prefix = x.shape[1] - x_t.shape[1]
        x = self.dropout(x + sinusoid(torch.arange(x.shape[1], device=x.device), x.shape[-1]).to(x_t.dtype))
        if self.token_memory:
            tokens, memory_mask = condition_tokens(cond)
            memory = self.condition(t, tokens)
        else:
            memory, memory_mask = self.condition(t, cond.pooled)[:, None], None
        x = self.transformer(x, with_prefix(mask, prefix) if self.mask_padding else None, memory, memory_mask)
        return self.output(x[:, prefix:])


def condition_tokens(cond: Condition) -> tuple[Tensor, Tensor]:
    """Returns the tokens (B, S, C) and their mask (B, S); raises `UserError` if there are none."""
    if cond.token_mask is None or not cond.tokens.shape[1]:
        raise UserError("this denoiser needs condition tokens, but the condition encoder has none: choose another one")
    return cond.tokens, cond.token_mask
