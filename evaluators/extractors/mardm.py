# pyright: standard
"""The CLIP-score evaluator of MARDM (Meng et al. 2025, "Rethinking Diffusion for Text-Driven Human Motion Generation").

MARDM's other evaluator, which reads 67 features, is in `evaluators.extractors.t2m`.
"""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from flame_mdm.conditions.text import Pretrained
from flame_mdm.denoisers.layers import sinusoid

CLIP = ("openai/clip-vit-base-patch32", "3d74acf9a28c67741b2f4f2ea7635f0aaf6f0268")
"""CLIP's tokenizer on the Hugging Face hub, which is the same for all model sizes, and its commit."""


def _transformer(width: int, heads: int, hidden: int, layers: int) -> nn.TransformerEncoder:
    layer = nn.TransformerEncoderLayer(width, heads, hidden, 0.2, "gelu", batch_first=True)
    return nn.TransformerEncoder(layer, layers, enable_nested_tensor=False)


class _MotionEncoder(nn.Module):
    """A transformer with a learned first token.

    The output for this token is the embedding of the motion.
    """

    def __init__(self, features: int, width: int, transformer: nn.TransformerEncoder):
        super().__init__()
        self.query_token = nn.Parameter(torch.zeros(1, width))
        self.embed_motion, self.transformer = nn.Linear(features, width), transformer
        self.out_ln, self.out = nn.LayerNorm(width), nn.Linear(width, 512)

    def forward(self, x: Tensor, mask: Tensor) -> Tensor:
        """Embeds normalized motions (B, F, D) with mask (B, F) as vectors (B, 512)."""
        hidden = torch.cat([self.query_token.expand(len(x), 1, -1), self.embed_motion(x)], 1)
        hidden = hidden + sinusoid(torch.arange(hidden.shape[1], device=x.device), hidden.shape[2])
        hidden = self.transformer(hidden, src_key_padding_mask=~F.pad(mask, (1, 0), value=True))
        return self.out(self.out_ln(hidden[:, 0]))


class MARDMClip(nn.Module):
    """Embeds captions and the essential features of motions as vectors of norm 1.

    `mean` and `std` (67,) are used to normalize the features.
    """

    mean: Tensor
    std: Tensor

    def __init__(
        self,
        mean: Tensor,
        std: Tensor,
        *,
        width: int = 512,
        hidden: int = 1024,
        layers: int = 8,
        heads: int = 8,
        words: int = 49408,
        slots: int = 77,
    ):
        super().__init__()
        self.register_buffer("mean", mean.float(), persistent=False)
        self.register_buffer("std", std.float(), persistent=False)
        self.motion_encoder = _MotionEncoder(
            len(mean), width, _transformer(width, heads, hidden, layers)
        )
        self.token_embedding = nn.Embedding(words, width)
        self.positional_embedding = nn.Parameter(torch.zeros(slots, width))
        self.textTransEncoder = _transformer(width, heads, hidden, layers)
        self.text_ln, self.out = nn.LayerNorm(width), nn.Linear(width, 512)
        self.logit_scale = nn.Parameter(torch.zeros(()))

    def forward(self, x: Tensor, mask: Tensor) -> Tensor:
        """Computes vectors (B, 512) from motions (B, F, D >= 67) in the data's units, with mask (B, F)."""
        x = (x[..., : len(self.mean)] - self.mean) / self.std * mask[..., None]
        return F.normalize(self.motion_encoder(x, mask), dim=-1)

    def text(self, tokens: Tensor) -> Tensor:
        """Encodes captions, which are passed as CLIP tokens (B, S), as vectors (B, 512).

        The tokens after the end of a caption are 0.
        """
        hidden = self.text_ln(
            self.textTransEncoder(self.token_embedding(tokens) + self.positional_embedding)
        )
        return F.normalize(self.out(hidden[torch.arange(len(tokens)), tokens.argmax(1)]), dim=-1)


def clip_tokens(captions: Sequence[str]) -> Tensor:
    """Converts captions to CLIP tokens (B, 77), padded with 0. Long captions are truncated."""
    tokenizer = Pretrained(*CLIP, None, None).tokenizer
    encoded = tokenizer(
        list(captions), padding="max_length", truncation=True, max_length=77, return_tensors="pt"
    )
    return encoded["input_ids"] * encoded["attention_mask"]
