"""The transformers of MDM (Tevet et al. 2023, section 3 and appendix C)."""

from typing import Literal

import torch
from torch import Tensor, nn

from flame_mdm.batch import Condition
from flame_mdm.denoisers import Denoiser
from flame_mdm.denoisers.layers import TimeAndCondition, Transformer, add_sinusoid, with_prefix
from flame_mdm.denoisers.target_encoders import TARGET_ENCODERS, TargetEncoder
from flame_mdm.errors import UserError


class MDMEncoder(Denoiser):
    """Transformer encoder over [time + condition, frame 1, frame 2, ...]; used by MDM and MFM.

    Args:
        in_features: D, the number of features per frame.
        out_features: D, or 2 * D if the variance is learned.
        cond_features: C; 0 = unconditional.
        latent_dim: width of the layers.
        ff_size: hidden width of the feed-forward layers.
        num_layers: number of layers.
        num_heads: number of attention heads; must divide `latent_dim`.
        dropout: probability of dropout after the positional encoding and inside the layers.
        project_condition: whether to project the condition before it is added to the time embedding.
        max_tokens: maximum number of condition tokens between the time and the frames (30 in MFM
            with T5). 0 = no tokens; the pooled condition is added to the time instead. The
            positional encoding of the frames does not depend on the number of tokens.
        mask_padding: whether to mask the padding in attention. In the released models of MDM and
            MFM, frames attend to the padding; such models sample motions at the padded length of
            the training data and crop them.
        condition_frames: whether to also add time + condition (or, with `max_tokens`, only the
            time) to every frame. A small network then learns to follow the text in fewer training
            steps.

    Example:
        >>> denoiser = MDMEncoder(6, 6, 4, latent_dim=8, ff_size=8, num_layers=1, num_heads=2, dropout=0.0)
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
        self.max_tokens, self.mask_padding, self.condition_frames = (
            max_tokens,
            mask_padding,
            condition_frames,
        )
        self.condition = TimeAndCondition(latent_dim, cond_features, project_condition)
        self.input = nn.Linear(in_features, latent_dim)
        self.dropout = nn.Dropout(dropout)
        self.transformer = Transformer(latent_dim, ff_size, num_layers, num_heads, dropout)
        self.output = nn.Linear(latent_dim, out_features)

    def forward(self, x_t: Tensor, t: Tensor, mask: Tensor, cond: Condition) -> Tensor:
        """See `Denoiser.forward`.

        Raises:
            UserError: If `max_tokens` is above 0 and there are no tokens or too many of them.
        """
        token_mask = mask[:, :0]
        if self.max_tokens:
            tokens, token_mask = condition_tokens(cond)
            if tokens.shape[1] > self.max_tokens:
                raise UserError(
                    f"denoiser.max_tokens={self.max_tokens}: captions have up to {tokens.shape[1]} tokens. "
                    f"Set denoiser.max_tokens to at least {tokens.shape[1]}"
                )
            prefix = torch.cat(
                [self.condition.time(t)[:, None], self.condition.projection(tokens)], 1
            )
        else:
            prefix = self.condition(t, cond.pooled)[:, None]
        size = prefix.shape[1]
        positions = torch.arange(1 + self.max_tokens + x_t.shape[1], device=x_t.device)
        # Frames have the same positions even if there are fewer tokens than `max_tokens`.
        positions = torch.cat([positions[:size], positions[1 + self.max_tokens :]])
        frames = self.input(x_t)
        x = torch.cat([prefix, frames + prefix[:, :1] if self.condition_frames else frames], 1)
        x = self.dropout(add_sinusoid(x.to(x_t.dtype), positions))
        frame_mask = mask if self.mask_padding else torch.ones_like(mask)
        x = self.transformer(x, with_prefix(torch.cat([token_mask, frame_mask], 1), 1))
        return self.output(x[:, size:])


class MDMDecoder(Denoiser):
    """Transformer decoder over the frames; used by MDM and DiP.

    The memory of the cross-attention is time + condition. With `context_frames`, clean frames
    precede the noisy frames, as in DiP (Tevet et al. 2025, "CLoSD", section 3.1). Clean frames are
    identified only by their positions, and their outputs are discarded.

    Args:
        in_features: D, the number of features per frame.
        out_features: D, or 2 * D if the variance is learned.
        cond_features: C; 0 = unconditional.
        latent_dim: width of the layers.
        ff_size: hidden width of the feed-forward layers.
        num_layers: number of layers.
        num_heads: number of attention heads; must divide `latent_dim`.
        dropout: probability of dropout after the positional encoding and inside the layers.
        project_condition: whether to project the condition before it is added to the time embedding.
        input_token: content of the token before the frames, if any. "condition" is time +
            condition, as in the paper's "+ input token" and in the released model. "time" is only
            the time, as in MDM's code since February 2025.
        token_memory: whether to use all condition tokens as memory, with the time added to each of
            them, as MDM does with DistilBERT.
        memory: how the time is included in a memory of all tokens: "add" adds the time to each
            token, and "concat" places it before the tokens as a separate token.
        mask_padding: whether to mask the padding in attention. In the released models without
            `mask_frames`, frames attend to the padding.
        context_frames: number of clean frames that precede the motion; see `Condition.prefix`.
        target_encoder: network that embeds `Condition.target`. The output of this network is added
            to the time embedding. "none" ignores targets.
        target_layers: number of hidden layers of the target encoders "single" and "split".
        condition_frames: whether to also add time + condition to every noisy frame. A small network
            then learns to follow the text in fewer training steps, and can distinguish noisy frames
            from clean ones.

    Raises:
        UserError: If arguments contradict each other.

    Example:
        >>> denoiser = MDMDecoder(
        ...     6, 6, 4, latent_dim=8, ff_size=8, num_layers=1, num_heads=2, dropout=0.0, context_frames=3
        ... )
        >>> cond = Condition(torch.ones(2, 4), torch.ones(2, 0, 4), None, prefix=torch.ones(2, 3, 6))
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
        project_condition: bool = True,
        input_token: Literal["none", "condition", "time"] = "none",
        token_memory: bool = False,
        memory: Literal["add", "concat"] = "add",
        mask_padding: bool = True,
        context_frames: int = 0,
        target_encoder: Literal["none", "single", "split", "multi"] = "none",
        target_layers: int = 1,
        condition_frames: bool = False,
    ):
        super().__init__()
        self.condition_frames = condition_frames
        if memory == "concat" and not token_memory:
            raise UserError(
                "denoiser.memory=concat: the time token would precede the condition tokens, "
                "but the memory contains no condition tokens. Set token_memory=true"
            )
        if type(context_frames) is not int or context_frames < 0:
            raise UserError(
                f"denoiser.context_frames={context_frames}: expected a number of frames, at least 0"
            )
        self.input_token, self.mask_padding, self.context_frames = (
            input_token,
            mask_padding,
            context_frames,
        )
        self.token_memory, self.memory = token_memory and cond_features > 0, memory
        self.condition = TimeAndCondition(latent_dim, cond_features, project_condition)
        self.target: TargetEncoder | None = None
        if target_encoder != "none":
            self.target = TARGET_ENCODERS[target_encoder](latent_dim, target_layers)
        self.input = nn.Linear(in_features, latent_dim)
        self.dropout = nn.Dropout(dropout)
        self.transformer = Transformer(
            latent_dim, ff_size, num_layers, num_heads, dropout, cross_attention=True
        )
        self.output = nn.Linear(latent_dim, out_features)

    def forward(self, x_t: Tensor, t: Tensor, mask: Tensor, cond: Condition) -> Tensor:
        """See `Denoiser.forward`.

        Raises:
            UserError: If the prefix or the tokens are missing or have the wrong size.
        """
        time = self.condition.time(t)
        if self.target is not None:
            time = time + self.target(cond).to(time)

        x = self.input(self._with_context(x_t, cond))
        if self.condition_frames:
            clean, noisy = x[:, : self.context_frames], x[:, self.context_frames :]
            x = torch.cat([clean, noisy + self.condition.add(time, cond.pooled)[:, None]], 1)
        if self.input_token == "condition":
            x = torch.cat([self.condition.add(time, cond.pooled)[:, None], x], 1)
        elif self.input_token == "time":
            x = torch.cat([time[:, None], x], 1)
        x = self.dropout(add_sinusoid(x.to(x_t.dtype)))

        memory, memory_mask = self._memory(time, cond)
        before = x.shape[1] - x_t.shape[1]
        x = self.transformer(
            x, with_prefix(mask, before) if self.mask_padding else None, memory, memory_mask
        )
        return self.output(x[:, before:])

    def _with_context(self, x_t: Tensor, cond: Condition) -> Tensor:
        """Returns the clean frames of the prefix, followed by the noisy frames."""
        if not self.context_frames:
            return x_t
        frames = 0 if cond.prefix is None else cond.prefix.shape[1]
        if cond.prefix is None or frames != self.context_frames:
            raise UserError(
                f"the prefix has {frames} frames, but this denoiser requires {self.context_frames} clean frames"
            )
        return torch.cat([cond.prefix.to(x_t), x_t], 1)

    def _memory(self, time: Tensor, cond: Condition) -> tuple[Tensor, Tensor | None]:
        """Returns the memory (B, S, C) and its mask (B, S), which is None if all entries are real.

        Args:
            time: (B, C), time embeddings.
            cond: the condition.
        """
        if not self.token_memory:
            return self.condition.add(time, cond.pooled)[:, None], None
        tokens, mask = condition_tokens(cond)
        if self.memory == "add":
            return self.condition.add(time, tokens), mask
        return torch.cat([time[:, None], self.condition.projection(tokens)], 1), with_prefix(
            mask, 1
        )


def condition_tokens(cond: Condition) -> tuple[Tensor, Tensor]:
    """Returns the tokens (B, S, C) and their mask (B, S). Raises `UserError` if there are no tokens."""
    if cond.token_mask is None or not cond.tokens.shape[1]:
        raise UserError(
            "this denoiser needs condition tokens, but the condition encoder returns none. Choose another encoder"
        )
    return cond.tokens, cond.token_mask
