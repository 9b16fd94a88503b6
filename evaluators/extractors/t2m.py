# pyright: standard
"""The evaluator for HumanML3D and KIT-ML.

Source: Guo et al. 2022, "Generating Diverse and Natural 3D Human Motions from Text". The authors'
code returns embeddings in descending order of length. This code keeps the order of the input.
"""

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.nn.utils.rnn import pack_padded_sequence

from flame_mdm.batch import pad_to
from flame_mdm.checkpoints.released_weights import load_strictly, read_weights
from flame_mdm.conditions.vocabulary import hashed
from flame_mdm.data import restricted_pickle
from flame_mdm.data.t2m import MAX_TOKENS, frame_tokens
from flame_mdm.errors import UserError
from flame_mdm.safe_io import read_npy

# Number of tokens in a caption, including start and end marks
SLOTS = MAX_TOKENS + 2
# Number of frames that the movement encoder maps to one vector
UNIT = 4
# Number of features at the end of each frame that the evaluator ignores
CONTACTS = 4
PARTS_OF_SPEECH = (
    *("VERB", "NOUN", "DET", "ADP", "NUM", "AUX", "PRON", "ADJ", "ADV"),
    *("Loc_VIP", "Body_VIP", "Obj_VIP", "Act_VIP", "Desc_VIP", "OTHER"),
)
_SPECIAL_WORDS = {
    "Loc_VIP": "left right clockwise counterclockwise anticlockwise forward back backward up down straight curve",
    "Body_VIP": "arm chin foot feet face hand mouth leg waist eye knee shoulder thigh",
    "Obj_VIP": "stair dumbbell chair window floor car ball handrail baseball basketball",
    "Act_VIP": "walk run swing pick bring kick put squat throw hop dance jump turn stumble stop sit lift lower raise "
    "wash stand kneel stroll rub bend balance flap jog shuffle lean rotate spin spread climb",
    "Desc_VIP": "slowly carefully fast careful slow quickly happy angry sad happily angrily sadly",
}
SPECIAL = {word: part for part, words in _SPECIAL_WORDS.items() for word in words.split()}
"""Words with a special part of speech, which takes precedence over the tagger's."""


class Words(NamedTuple):
    """Input of the text encoder for B captions."""

    # (B, 22, 300) GloVe vectors
    vectors: Tensor
    # (B, 22, 15) one-hot parts of speech
    parts: Tensor
    # (B,) int64, number of slots up to and including the end mark
    lengths: Tensor


class WordVectors:
    """Word vectors (N, 300), such as GloVe's, and a mapping from words to rows."""

    def __init__(self, rows: dict[str, int], vectors: Tensor):
        self.rows, self.vectors = rows, vectors

    @classmethod
    def read(cls, folder: Path) -> Self:
        """Reads our_vab_data.npy and our_vab_idx.pkl.

        Raises `FileNotFoundError` if a file is missing, and `UserError` if its content is invalid.
        """
        rows = restricted_pickle.read(folder / "our_vab_idx.pkl")
        vectors = _read_numbers(folder / "our_vab_data.npy").astype(np.float32)
        named = (
            isinstance(rows, dict) and vectors.ndim == 2 and {"sos", "eos", "unk"} <= rows.keys()
        )
        if not named or not all(
            isinstance(row, int | np.integer) and 0 <= row < len(vectors) for row in rows.values()
        ):
            raise UserError(
                f"{folder}: not the released GloVe vectors, which have one row each for sos, "
                f"eos, unk and other words"
            )
        return cls(rows, torch.from_numpy(vectors))

    def __call__(self, captions: Sequence[Sequence[str]], *, full_length: bool = False) -> Words:
        """Returns the text encoder's input for captions.

        Captions are lists of "word/PART" tokens, without start and end marks. Tokens after the 20th
        are dropped. If a word has no vector, both the word and its part of speech are encoded as
        unknown. `full_length` is a legacy option: as in MFM's code and in MDM's code before January
        2024, every caption is treated as if it filled all 22 slots, which lowers R-precision.
        """
        framed, lengths = zip(*map(frame_tokens, captions), strict=True)
        rows, parts = [], []
        for token in itertools.chain(*framed):
            word, _, part = token.rpartition("/")
            rows.append(self.rows.get(word, self.rows["unk"]))
            part = SPECIAL.get(word, part) if word in self.rows else "OTHER"
            parts.append(PARTS_OF_SPEECH.index(part if part in PARTS_OF_SPEECH else "OTHER"))
        slots, filled = (len(captions), SLOTS), [SLOTS] * len(captions) if full_length else lengths
        one_hot = F.one_hot(torch.tensor(parts).view(slots), len(PARTS_OF_SPEECH)).float()
        return Words(self.vectors[torch.tensor(rows).view(slots)], one_hot, torch.tensor(filled))


class LearnedWords(nn.Module):
    """Word vectors learned together with the evaluator, for data sets without tagged words.

    The vectors for the parts of speech are 0.
    """

    def __init__(self):
        super().__init__()
        self.table = nn.Embedding(2048, _TextEncoder.WORD)
        nn.init.normal_(self.table.weight, std=0.3)  # similar to the scale of GloVe vectors

    def forward(self, captions: Sequence[Sequence[str]]) -> Words:
        """Returns the text encoder's input for lists of words. Words after the 20th are dropped."""
        framed, lengths = zip(*map(frame_tokens, captions), strict=True)
        rows = [
            [hashed(token.partition("/")[0], self.table.num_embeddings) for token in tokens]
            for tokens in framed
        ]
        vectors = self.table(torch.tensor(rows, device=self.table.weight.device)).sum(2)
        return Words(
            vectors,
            vectors.new_zeros(*vectors.shape[:2], len(PARTS_OF_SPEECH)),
            torch.tensor(lengths),
        )


class T2MEvaluator(nn.Module):
    """Embeds motions and captions in a joint space to compute the metrics of HumanML3D and KIT.

    The metrics are R-precision, MM-Dist, FID and diversity. Features are in the data's units and
    are normalized with the `mean` and `std` (D,) of the released weights. After normalization,
    motions are padded with zeros to `max_frames`, as the authors' code does for real motions.
    Therefore, the convolutions read 3 frames past the end. The network reads the first
    `used_features` features (67 for MARDM, 64 for KIT), or all features except the contacts if it
    is None.
    """

    mean: Tensor
    std: Tensor

    def __init__(
        self,
        mean: Tensor,
        std: Tensor,
        *,
        movement_hidden: int = 512,
        movement_latent: int = 512,
        text_hidden: int = 512,
        motion_hidden: int = 1024,
        embedding: int = 512,
        max_frames: int = 196,
        used_features: int | None = None,
    ):
        super().__init__()
        self.max_frames = max_frames
        self.register_buffer("mean", mean.float())
        self.register_buffer("std", std.float())
        self.used = used_features or len(mean) - CONTACTS
        self.movement_encoder = _MovementEncoder(self.used, movement_hidden, movement_latent)
        self.text_encoder = _TextEncoder(text_hidden, embedding)
        self.motion_encoder = _MotionEncoder(movement_latent, motion_hidden, embedding)

    def forward(self, x: Tensor, mask: Tensor) -> Tensor:
        """Computes embeddings (B, E) from motions (B, F, D) and their mask (B, F).

        The motions must have 4 to `max_frames` frames.
        """
        lengths = mask.sum(1)
        shortest, longest = int(lengths.min()), int(lengths.max())
        if shortest < UNIT or longest > self.max_frames:
            takes = f"the T2M evaluator reads motions of {UNIT} to {self.max_frames} frames"
            raise UserError(f"{takes}, but these have {shortest} to {longest}")
        used = slice(self.used)
        x = (x[..., used] - self.mean[used]) / self.std[used] * mask[..., None]
        x = pad_to(x[:, : self.max_frames], self.max_frames)
        with torch.no_grad():  # the movement encoder is frozen when texts and motions are matched
            movements = self.movement_encoder(x)
        return self.motion_encoder(movements, lengths // UNIT)

    def text(self, words: Words) -> Tensor:
        """Computes embeddings (B, E) of captions from the output of `WordVectors` or `LearnedWords`."""
        weight = self.text_encoder.input_emb.weight
        return self.text_encoder(words.vectors.to(weight), words.parts.to(weight), words.lengths)


class _MovementEncoder(nn.Module):
    """Two convolutions over time, which encode every 4 frames as one vector."""

    def __init__(self, in_features: int, hidden: int, latent: int):
        super().__init__()
        self.main = nn.Sequential(
            *(nn.Conv1d(in_features, hidden, 4, 2, 1), nn.Dropout(0.2), nn.LeakyReLU(0.2)),
            *(nn.Conv1d(hidden, latent, 4, 2, 1), nn.Dropout(0.2), nn.LeakyReLU(0.2)),
        )
        self.out_net = nn.Linear(latent, latent)

    def forward(self, x: Tensor) -> Tensor:
        """Encodes motions (B, F, D) as vectors (B, F // 4, latent)."""
        return self.out_net(self.main(x.transpose(1, 2)).transpose(1, 2))


class _Recurrent(nn.Module):
    """A bidirectional GRU with a learned initial state, whose final states are embedded."""

    def __init__(self, in_features: int, hidden: int, embedding: int):
        super().__init__()
        self.input_emb = nn.Linear(in_features, hidden)
        self.gru = nn.GRU(hidden, hidden, batch_first=True, bidirectional=True)
        self.output_net = nn.Sequential(
            nn.Linear(2 * hidden, hidden),
            nn.LayerNorm(hidden),
            nn.LeakyReLU(0.2),
            nn.Linear(hidden, embedding),
        )
        self.hidden = nn.Parameter(torch.randn(2, 1, hidden))

    def encode(self, x: Tensor, lengths: Tensor) -> Tensor:
        """Encodes sequences (B, N, in_features) with `lengths` (B,) as vectors (B, embedding)."""
        packed = pack_padded_sequence(
            self.input_emb(x), lengths.cpu(), batch_first=True, enforce_sorted=False
        )
        _, last = self.gru(packed, self.hidden.expand(-1, len(x), -1).contiguous())
        return self.output_net(torch.cat([last[0], last[1]], -1))


class _MotionEncoder(_Recurrent):
    """Encodes a sequence of movement vectors as the embedding of a motion."""

    def forward(self, x: Tensor, lengths: Tensor) -> Tensor:
        return self.encode(x, lengths)


class _TextEncoder(_Recurrent):
    """Encodes word vectors, to which embeddings of the parts of speech are added."""

    WORD = 300

    def __init__(self, hidden: int, embedding: int):
        super().__init__(self.WORD, hidden, embedding)
        self.pos_emb = nn.Linear(len(PARTS_OF_SPEECH), self.WORD)

    def forward(self, vectors: Tensor, parts: Tensor, lengths: Tensor) -> Tensor:
        """Encodes sequences of words with `lengths` (B,) as vectors (B, embedding).

        `vectors` (B, N, 300) and `parts` (B, N, 15) describe the words and their parts of speech.
        """
        return self.encode(vectors + self.pos_emb(parts), lengths)


def _read_numbers(path: Path) -> np.ndarray:
    array = read_npy(path)
    if array.dtype.kind not in "fiu":
        raise UserError(f"{path}: expected an array of numbers, but found {array.dtype}")
    return array


def read_statistics(folder: Path) -> list[Tensor]:
    """Reads an evaluator's released mean.npy and std.npy, each (D,)."""
    return [torch.from_numpy(_read_numbers(folder / name)) for name in ("mean.npy", "std.npy")]


def load_t2m(folder: Path) -> T2MEvaluator:
    """Loads the evaluator from the folder of a `T2MExtractor`.

    If the folder's statistics have 67 or 64 features, this is MARDM's evaluator.
    """
    mean, std = read_statistics(folder)
    network = T2MEvaluator(mean, std, used_features=len(mean) if len(mean) in (67, 64) else None)
    path = folder / "finest.tar"
    for name in ("movement_encoder", "text_encoder", "motion_encoder"):
        load_strictly(network.get_submodule(name), read_weights(path, name), path)
    return network.eval()
