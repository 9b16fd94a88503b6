"""Folder layout and sampling rules shared by HumanML3D and KIT-ML (Guo et al., CVPR 2022).

new_joint_vecs/NAME.npy     (F, D) features
texts/NAME.txt              one description per line: caption#word/POS word/POS#from#to, in seconds; or texts.zip
train.txt val.txt test.txt  names; the mirrored copy of NAME is MNAME
Mean.npy Std.npy            (D,)
"""

import math
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np

from flame_mdm.data import SPLITS, Clip, MotionSource, Split, archives, required, some
from flame_mdm.errors import UserError
from flame_mdm.safe_io import naming, read_npy, read_text

# Frames per second with which the tags `from` and `to` are converted to frames. The published code
# also uses 20 for KIT-ML, although its motions have 12.5 frames per second.
TAG_FPS = 20
MAX_LENGTH = 200  # motions and cuts with this many frames or more are left out
MAX_TOKENS = 20


class Description(NamedTuple):
    """One line of a text file.

    The line describes the motion from `begin` to `end`, in seconds. `begin` and `end` are 0 if the
    line describes the entire motion.
    """

    caption: str
    tokens: list[str]
    begin: float = 0.0
    end: float = 0.0


class Cut(NamedTuple):
    """One item of the data set: a part of a motion with its descriptions.

    The part consists of `length` frames, beginning with frame `start`.
    """

    id: str
    start: int
    length: int
    descriptions: list[Description]

    def clip(
        self, motion: np.ndarray, split: Split, source: str, encoded: str = "", **facts: str
    ) -> Clip:
        """Cuts this part from a motion and returns it as a clip.

        `facts` contains additional attributes. The `tokens` attribute is left out if any
        description has no tokens.
        """
        captions, tokens, *_ = map(list, zip(*self.descriptions, strict=True))
        attributes = facts | ({"tokens": tokens} if all(tokens) else {})
        window = (self.start, self.length)
        return Clip(self.id, motion, captions, split, source, None, attributes, encoded, window)


def parse(text: str, where: str) -> list[Description]:
    """Parses the descriptions in a text file. As in the published code, a NaN tag is treated as 0.

    `where` identifies the file in error messages.
    """
    descriptions = []
    for number, line in enumerate(map(str.strip, text.splitlines()), 1):
        if line:
            with naming(
                f"{where}, line {number}",
                ValueError,
                prefix=f"not caption#words#from#to: {line[:60]!r}: ",
            ):
                caption, tokens, *tags = line.rsplit("#", 3)
                begin, end = (0.0 if math.isnan(float(tag)) else float(tag) for tag in tags)
            descriptions.append(Description(caption, tokens.split(" "), begin, end))
    return descriptions


def cuts(name: str, frames: int, descriptions: Sequence[Description], shortest: int) -> list[Cut]:
    """Returns the items of a motion with `frames` frames, in the published order.

    Each description of a part yields a separate item called NAME@from-to. A second description of
    the same part yields the item NAME@from-to#2. As in the published code, a motion that is too
    short or too long yields no items, even if parts of it would fit.
    """
    if not shortest <= frames < MAX_LENGTH:
        return []
    items: list[Cut] = []
    seen: Counter[str] = Counter()
    for description in descriptions:
        if description.begin == description.end == 0:
            continue
        start = int(description.begin * TAG_FPS)
        length = min(int(description.end * TAG_FPS), frames) - start
        if shortest <= length < MAX_LENGTH:
            id_ = f"{name}@{description.begin:g}-{description.end:g}"
            seen[id_] += 1
            items.append(
                Cut(id_ if seen[id_] == 1 else f"{id_}#{seen[id_]}", start, length, [description])
            )
    whole = [d for d in descriptions if d.begin == d.end == 0]
    return [*items, Cut(name, 0, frames, whole)] if whole else items


def words_of(caption: str) -> list[str]:
    """Returns the words of a caption in lower case, without punctuation."""
    return re.findall(r"[^\W_]+", caption.lower())


def frame_tokens(tokens: Sequence[str]) -> tuple[list[str], int]:
    """Returns up to 20 tokens, enclosed in sos and eos and padded to 22 tokens with unk.

    Also returns the number of tokens before padding.
    """
    framed = ["sos/OTHER", *tokens[:MAX_TOKENS], "eos/OTHER"]
    return framed + ["unk/OTHER"] * (MAX_TOKENS + 2 - len(framed)), len(framed)


def read_splits(folder: Path, ending: str, get_it: str) -> dict[str, Split]:
    """Reads the lists of names and maps each name to its split, in the original order.

    Raises:
        UserError: If a name is in two splits.
    """
    splits: dict[str, Split] = {}
    for split in SPLITS:
        file = required(folder, get_it) / f"{split}{ending}"
        for name in read_text(required(file, get_it)).split():
            if splits.setdefault(name, split) != split:
                raise UserError(f"{file}: {name} is also in {splits[name]}{ending}")
    return splits


class T2MFolder(MotionSource):
    """Reader for a processed folder with the layout of HumanML3D and KIT-ML.

    Cuts and mirrored copies are in the same split as their motion. The `tokens` attribute contains
    one list per caption, with the caption's words and their parts of speech. Mirrored copies have
    names of their own, so they can be excluded separately.
    """

    representation: str  # name of the representation of the features in the folder
    fps: float
    shortest: int
    get_it: str

    def __init__(self, path: str, exclude: Sequence[str] = ()):
        self.path, self.exclude = Path(path), frozenset(str(name) for name in exclude)
        self.options = {"exclude": list(exclude)}

    @cached_property
    def names(self) -> dict[str, Split]:
        """Maps the names of the motions to their splits. Excluded motions are left out."""
        return self.not_excluded(read_splits(self.path, ".txt", self.get_it), self.path)

    @cached_property
    def texts(self) -> dict[str, list[Description]]:
        """Descriptions of each motion, from the folder `texts` or from `texts.zip`."""
        folder = self.path / "texts"
        if not folder.is_dir():
            archive = required(
                self.path / "texts.zip", f"and there is no folder texts either; {self.get_it}"
            )
            folder = archives.as_folder(archive, self, lambda name: name.endswith(".txt"))
        return {
            file.stem: parse(read_text(file), str(file)) for file in sorted(folder.rglob("*.txt"))
        }

    @cached_property
    def frames(self) -> dict[str, int]:
        """Number of frames of each motion in the splits."""
        names = self.names
        for files, kind in ((self._motions(), "new_joint_vecs/*.npy"), (self.texts, "texts/*.txt")):
            if absent := names.keys() - files:
                raise FileNotFoundError(
                    f"{self.path}: {kind} lacks {len(absent)} of the names in the splits: {some(absent)}. Process them "
                    f"again, or leave them out with 'data.source.exclude=[{','.join(sorted(absent))}]'"
                )
        return {name: len(self._load(name, mmap=True)) for name in names}

    def count(self) -> int:
        """Returns the number of items. Raises `UserError` if Mean.npy or Std.npy is damaged."""
        total = sum(
            len(cuts(name, length, self.texts[name], self.shortest))
            for name, length in self.frames.items()
        )
        self.statistics()
        return total

    def clips(self, fps: float) -> Iterator[Clip]:
        """Yields all items, at the frame rate of the folder."""
        self.check_fps(fps, self.fps)
        orphans = self.texts.keys() - self._motions() - set(self.exclude)
        self.leave_out(f"texts without a motion ({some(orphans)})", len(orphans))
        for name, length in self.frames.items():
            items = cuts(name, length, self.texts[name], self.shortest)
            self._account(name, length, items)
            motion = self._load(name) if items else np.zeros(0)
            for cut in items:
                yield cut.clip(
                    motion, self.names[name], name.removeprefix("M"), self.representation
                )

    def statistics(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns the published mean and std, computed over all motions in all splits."""
        mean, std = (self._array(f"{name}.npy", 1).astype(np.float32) for name in ("Mean", "Std"))
        if mean.shape != std.shape or not np.isfinite(mean).all() or not (std > 0).all():
            raise UserError(
                f"{self.path}: Mean.npy {mean.shape} and Std.npy {std.shape} must contain a finite mean "
                "and a positive standard deviation of the same shape"
            )
        return mean, std

    def counts(self) -> dict[str, float]:
        """Returns the statistics that are listed in `published.yaml`.

        The counts of motions, texts and words exclude mirrored copies.
        """
        texts = [
            text for name, texts in self.texts.items() if not name.startswith("M") for text in texts
        ]
        words = [word for text in texts for word in words_of(text.caption)]
        splits = Counter(self.names.values())
        return (
            {
                "motions": len({name.removeprefix("M") for name in self._motions()}),
                "texts": len(texts),
                "vocabulary": len(set(words)),
                "words per caption": round(len(words) / max(len(texts), 1), 2),
            }
            | {split: splits[split] for split in SPLITS}
            | {
                f"{split} share, %": round(100 * splits[split] / max(len(self.names), 1), 2)
                for split in SPLITS
            }
        )

    def _motions(self) -> set[str]:
        files = (self.path / "new_joint_vecs").glob("*.npy")
        # A file whose name begins with a dot is an unfinished file of a killed process
        return {path.stem for path in files if not path.name.startswith(".")}

    def _load(self, name: str, mmap: bool = False) -> np.ndarray:
        return self._array(f"new_joint_vecs/{name}.npy", 2, mmap)

    def _array(self, name: str, dimensions: int, mmap: bool = False) -> np.ndarray:
        path = self.path / name
        array = read_npy(required(path, self.get_it), mmap=mmap)
        if array.ndim != dimensions or array.dtype.kind not in "fiu":
            raise UserError(
                f"{path}: expected an array of numbers with {dimensions} dimensions, but found "
                f"shape {array.shape} and type {array.dtype}"
            )
        return array

    def _account(self, name: str, frames: int, items: Sequence[Cut]) -> None:
        """Records why a motion has no items, or how many of its captions are left out."""
        if frames < self.shortest:
            reason = f"shorter than {self.shortest} frames"
        elif frames >= MAX_LENGTH:
            reason = f"with {MAX_LENGTH} frames or more"
        elif not self.texts[name]:
            reason = "without a caption"
        elif not items:
            reason = "whose captions all describe parts that are too short or too long"
        else:
            lost = len(self.texts[name]) - sum(len(cut.descriptions) for cut in items)
            self.leave_out("captions of parts that are too short or too long", lost)
            return
        self.leave_out(f"names in {self.names[name]} {reason}")
