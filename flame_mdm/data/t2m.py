"""Folder layout and sampling rules shared by HumanML3D and KIT-ML (Guo et al., CVPR 2022).

new_joint_vecs/NAME.npy     (F, D) features
texts/NAME.txt              one description per line: caption#word/POS word/POS#from#to, in seconds; or texts.zip
train.txt val.txt test.txt  names; the mirrored copy of NAME is MNAME
Mean.npy Std.npy            (D,)
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np

from flame_mdm.data import Clip, MotionSource, Split, archives
from flame_mdm.errors import UserError
from flame_mdm.safe_io import read_npy, read_text

TAG_FPS = 20
"""Frames per second of the tags `from` and `to`, also in KIT-ML, whose motions have 12.5."""

MAX_LENGTH = 200
"""Motions and cuts of this many frames or more are left out."""

MAX_TOKENS = 20
SPLITS: tuple[Split, ...] = ("train", "val", "test")


class Description(NamedTuple):
    """One line of a text file: seconds `begin` to `end` of the motion, both 0 for the entire motion."""

    caption: str
    tokens: list[str]
    begin: float = 0.0
    end: float = 0.0


class Cut(NamedTuple):
    """One item of the data set: frames `start` to `start + length` of a motion and their descriptions."""

    id: str
    start: int
    length: int
    descriptions: list[Description]


def parse(text: str, where: str) -> list[Description]:
    """Parses the descriptions in a text file; a NaN tag means 0, as published.

    Raises:
        ValueError: a line does not have four parts; the message contains `where` and the line number.
    """
    found = []
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip():
            continue
        try:
            caption, tokens, *tags = line.strip().rsplit("#", 3)
            begin, end = (0.0 if math.isnan(float(tag)) else float(tag) for tag in tags)
        except ValueError:
            raise ValueError(f"{where}, line {number}: not caption#words#from#to: {line.strip()[:60]!r}") from None
        found.append(Description(caption, tokens.split(" "), begin, end))
    return found


def cuts(name: str, frames: int, descriptions: Sequence[Description], shortest: int) -> list[Cut]:
    """Returns the items of a motion of `frames` frames, in the published order.

    A description of a part gives a separate item named NAME@from-to; the second item of the same part is named
    NAME@from-to#2. As published, a motion that is too short or too long gives no items, even if parts of it would fit.
    """
    if not shortest <= frames < MAX_LENGTH:
        return []
    found: list[Cut] = []
    seen: Counter[str] = Counter()
    for description in descriptions:
        if description.begin == description.end == 0:
            continue
        start = int(description.begin * TAG_FPS)
        length = min(int(description.end * TAG_FPS), frames) - start
        if shortest <= length < MAX_LENGTH:
            id_ = f"{name}@{description.begin:g}-{description.end:g}"
            seen[id_] += 1
            found.append(Cut(id_ if seen[id_] == 1 else f"{id_}#{seen[id_]}", start, length, [description]))
    whole = [d for d in descriptions if d.begin == d.end == 0]
    return [*found, Cut(name, 0, frames, whole)] if whole else found


def words_of(caption: str) -> list[str]:
    """Returns the words of a caption, without capitals and punctuation."""
    return re.findall(r"[^\W_]+", caption.lower())


def frame_tokens(tokens: Sequence[str]) -> tuple[list[str], int]:
    """Returns the first 20 tokens between sos and eos, padded to 22 with unk, and the number without padding."""
    framed = ["sos/OTHER", *tokens[:MAX_TOKENS], "eos/OTHER"]
    return framed + ["unk/OTHER"] * (MAX_TOKENS + 2 - len(framed)), len(framed)


class T2MFolder(MotionSource):
    """A processed folder. Cuts and mirrored copies have the split of their motion, which is also their source.

    The attribute `tokens` contains the words with their parts of speech, one list per caption.
    """

    representation: str
    """Name of the representation of the features in the folder."""
    fps: float
    shortest: int
    get_it: str

    def __init__(self, path: str, exclude: Sequence[str] = ()):
        """Stores the arguments; reads no files.

        Args:
            path: the folder.
            exclude: names to leave out; a mirrored copy has its own name.
        """
        self.path, self.exclude = Path(path), frozenset(str(name) for name in exclude)
        self._excluded: Counter[str] = Counter()

    @cached_property
    def names(self) -> dict[str, Split]:
        """Name in a list of the splits -> its split, in the order of the lists.

        Raises:
            FileNotFoundError: the folder or a list is missing.
            ValueError: a name is in two splits, or `exclude` has an unknown name.
        """
        if not self.path.is_dir():
            raise FileNotFoundError(f"{self.path}: no such folder; {self.get_it}")
        found: dict[str, Split] = {}
        for split in SPLITS:
            file = self.path / f"{split}.txt"
            if not file.is_file():
                raise FileNotFoundError(f"{file}: no such list of names; {self.get_it}")
            for name in read_text(file).split():
                if found.setdefault(name, split) != split:
                    raise ValueError(f"{file}: {name} is also in {found[name]}.txt")
        unknown = self.exclude - found.keys()
        if unknown:
            raise ValueError(f"data.source.exclude: no split contains {_some(unknown)}")
        return {name: split for name, split in found.items() if name not in self.exclude}

    @cached_property
    def texts(self) -> dict[str, list[Description]]:
        """Descriptions of each motion, from the folder `texts` or from `texts.zip`."""
        return {name: parse(text, where) for name, where, text in _texts(self.path)}

    @cached_property
    def frames(self) -> dict[str, int]:
        """Number of frames of each motion in the splits.

        Raises:
            FileNotFoundError: motions or texts of names in the splits are missing.
            ValueError: a file is damaged.
        """
        names = self.names
        for what, kind in ((self._motions(), "new_joint_vecs/*.npy"), (self.texts, "texts/*.txt")):
            absent = [name for name in names if name not in what]
            if absent:
                raise FileNotFoundError(
                    f"{self.path}: {kind} lacks {len(absent)} of the names in the splits: {_some(absent)}; process "
                    f"them again, or leave them out with {_exclusion(absent)}"
                )
        return {name: len(self._load(name, mmap=True)) for name in names}

    def count(self) -> int:
        total = sum(len(cuts(name, length, self.texts[name], self.shortest)) for name, length in self.frames.items())
        self.statistics()
        return total

    def clips(self, fps: float) -> Iterator[Clip]:
        """Yields all items, at the frame rate of the folder.

        Raises:
            ValueError: another frame rate is requested, a file is damaged, or motions are not finite; these are all
                listed at the end, so that they can be excluded together.
        """
        if fps != self.fps:
            raise ValueError(f"{self.name} has {self.fps:g} frames per second, but representation.fps is {fps:g}")
        self._excluded = Counter({"names by data.source.exclude": len(self.exclude)} if self.exclude else {})
        orphans = self.texts.keys() - self._motions() - self.exclude
        if orphans:
            self._excluded[f"texts without a motion ({_some(orphans)})"] = len(orphans)
        damaged = []
        for name, length in self.frames.items():
            found = cuts(name, length, self.texts[name], self.shortest)
            self._account(name, length, found)
            motion = self._load(name) if found else np.zeros(0)
            if not np.isfinite(motion).all():
                damaged.append(name)
                continue
            for cut in found:
                yield Clip(
                    id=cut.id,
                    motion=motion,
                    captions=[description.caption for description in cut.descriptions],
                    split=self.names[name],
                    source=name.removeprefix("M"),
                    attributes={"tokens": [description.tokens for description in cut.descriptions]},
                    encoded=self.representation,
                    window=(cut.start, cut.length),
                )
        if damaged:
            raise ValueError(
                f"{self.path}: {len(damaged)} motions contain non-finite numbers: {_some(damaged)}; process them "
                f"again, or leave them out with {_exclusion(damaged)}"
            )

    def excluded(self) -> dict[str, int]:
        """Returns the number of names without clips, by split and reason, and of descriptions of parts without clip."""
        return dict(self._excluded)

    def statistics(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns the published mean and std, which are over all motions of all splits.

        Raises:
            FileNotFoundError: the files are missing.
            ValueError: the files are damaged, or a std is not positive.
        """
        mean, std = (self._array(self.path / f"{name}.npy") for name in ("Mean", "Std"))
        if {mean.dtype.kind, std.dtype.kind} - set("fiu"):
            raise ValueError(f"{self.path}: Mean.npy and Std.npy are not arrays of real numbers")
        if mean.shape != std.shape or mean.ndim != 1 or not np.isfinite(mean).all() or not (std > 0).all():
            raise ValueError(f"{self.path}: Mean.npy {mean.shape} or Std.npy {std.shape} is not a mean or positive std")
        return mean.astype(np.float32), std.astype(np.float32)

    def counts(self) -> dict[str, float]:
        """Returns the figures of the folder under the names of `published.yaml`, of which mirrored copies give none."""
        originals = {name.removeprefix("M") for name in self._motions()}
        captions = [d.caption for name, found in self.texts.items() if not name.startswith("M") for d in found]
        words = [words_of(caption) for caption in captions]
        splits = Counter(self.names.values())
        return {
            "motions": len(originals),
            "texts": len(captions),
            "vocabulary": len({word for caption in words for word in caption}),
            "words per caption": round(sum(map(len, words)) / max(len(words), 1), 2),
            **{split: splits[split] for split in SPLITS},
            **{f"{split} share, %": round(100 * splits[split] / max(len(self.names), 1), 2) for split in SPLITS},
        }

    def _motions(self) -> set[str]:
        files = (self.path / "new_joint_vecs").glob("*.npy")
        return {path.stem for path in files if not path.name.startswith(".")}  # unfinished, of a killed process

    def _load(self, name: str, mmap: bool = False) -> np.ndarray:
        motion = self._array(self.path / "new_joint_vecs" / f"{name}.npy", mmap)
        if motion.ndim != 2 or motion.dtype.kind not in "fiu":
            what = f"shape {motion.shape} of {motion.dtype}"
            raise ValueError(f"{self.path}/new_joint_vecs/{name}.npy: {what}, not numbers (frames, features)")
        return motion

    def _array(self, path: Path, mmap: bool = False) -> np.ndarray:
        try:
            return read_npy(path, mmap=mmap)
        except UserError:
            raise
        except FileNotFoundError:
            raise FileNotFoundError(f"{path}: no such file; {self.get_it}") from None
        except ValueError as error:
            raise ValueError(f"{path}: {error}; process it again, or exclude it by name") from error

    def _account(self, name: str, frames: int, found: Sequence[Cut]) -> None:
        """Counts what is left out of a motion, by reason."""
        lost = len(self.texts[name]) - sum(len(cut.descriptions) for cut in found)
        reason = ""
        if frames < self.shortest:
            reason = f"shorter than {self.shortest} frames"
        elif frames >= MAX_LENGTH:
            reason = f"of {MAX_LENGTH} frames or more"
        elif not self.texts[name]:
            reason = "without a caption"
        elif not found:
            reason = "with captions of unfit parts only"
        elif lost:
            self._excluded["captions of parts that are too short or too long"] += lost
        if reason:
            self._excluded[f"names of {self.names[name]} {reason}"] += 1


def _texts(path: Path) -> Iterator[tuple[str, str, str]]:
    """Yields name, path and content of all text files, sorted."""
    if (path / "texts").is_dir():
        for file in sorted((path / "texts").glob("*.txt")):
            yield file.stem, str(file), read_text(file)
        return
    archive = path / "texts.zip"
    if not archive.is_file():
        raise FileNotFoundError(f"{path}: contains neither a folder texts nor texts.zip")
    contents = {
        member: content()
        for member, content in archives.members(archive)
        if member.endswith(".txt") and "__MACOSX" not in PurePosixPath(member).parts
    }
    for member, content in sorted(contents.items()):
        try:
            text = content.decode("utf-8").replace("\r\n", "\n").replace("\r", "\n")
        except UnicodeDecodeError as error:
            raise ValueError(f"{archive}/{member}: not a UTF-8 text file: {error}") from error
        yield PurePosixPath(member).stem, f"{archive}/{member}", text


def _some(names: Iterable[str]) -> str:
    first = sorted(names)
    return ", ".join(first[:5]) + (f" and {len(first) - 5} more" if len(first) > 5 else "")


def _exclusion(names: Sequence[str]) -> str:
    """Returns the override that leaves these names out; only its key if there are more than 100."""
    return f"'data.source.exclude=[{','.join(names)}]'" if len(names) <= 100 else "data.source.exclude"
