"""KIT Motion-Language: a processed folder with 251 features, and joint positions as in TEMOS.

Source: Plappert, Mandery, Asfour, "The KIT Motion-Language Dataset", Big Data 2016. `docs/kit.md`
lists the required downloads.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np

from flame_mdm.batch import ceil_div
from flame_mdm.data import SPLITS, Clip, MotionSource, Split, required
from flame_mdm.data.parallel import in_order
from flame_mdm.data.t2m import T2MFolder, read_splits
from flame_mdm.errors import UserError
from flame_mdm.safe_io import naming, read_json, read_text

UNITS_PER_METER = 640


class KIT(T2MFolder):
    """Reader for the processed folder with 251 features per frame (Guo et al., CVPR 2022)."""

    name = "kit"
    representation = "humanml-legacy-kit21"
    fps = 12.5
    shortest = 24
    get_it = "download KIT-ML as processed for text-to-motion, which is linked at https://github.com/EricGuo5513/HumanML3D"


class KITTemos(MotionSource):
    """Joint positions of the MMM model at 12.5 fps, with TEMOS's splits and length limits.

    The recordings have 100 frames per second, and every eighth frame is used. Source: Petrovich,
    Black, Varol, "TEMOS", ECCV 2022; FLAME follows the same rules. Motions shorter than 10 frames
    or longer than 500 frames are left out of the training and validation splits. The test split
    contains all motions, but only the first caption of each motion. The `ghosh_test` attribute
    states whether a clip is in Ghosh et al.'s test split.

    The folder `path` contains `NUMBER_fke.csv`, `NUMBER_annotations.json` and `NUMBER_meta.json`
    for each motion. The folder `splits` contains TEMOS's lists of these numbers.
    """

    name = "kit-temos"
    shortest, longest = 10, 500
    get_it = "get datasets/kit-splits from https://github.com/Mathux/TEMOS"
    get_motions = (
        "get KIT-ML at https://motion-annotation.humanoids.kit.edu/dataset and the joints as "
        "described in docs/kit.md"
    )

    def __init__(self, path: str, splits: str, exclude: Sequence[str] = (), workers: int = 0):
        self.path, self.splits, self.workers = Path(path), Path(splits), workers
        self.exclude = frozenset(str(name) for name in exclude)
        self.options = {"exclude": list(exclude)}

    @cached_property
    def names(self) -> dict[str, Split]:
        """Maps the name of each motion to its split."""
        return self.not_excluded(read_splits(self.splits, "", self.get_it), self.splits)

    @cached_property
    def ghosh_test(self) -> set[str]:
        """The names in Ghosh et al.'s test split. The set is empty if this list is missing."""
        file = self.splits / "ghosh-test"
        return set(read_text(file).split()) if file.is_file() else set()

    @cached_property
    def texts(self) -> dict[str, list[str]]:
        """Captions for each motion in the splits. Motions without captions are left out."""
        names, texts = self.names, {}
        required(self.path, self.get_motions)
        for name in names:
            captions, meta = (
                read_json(self.path / f"{name}_{kind}.json") for kind in ("annotations", "meta")
            )
            are_texts = isinstance(captions, list) and all(
                isinstance(text, str) for text in captions
            )
            if (
                not are_texts
                or not isinstance(meta, dict)
                or len(captions) != meta.get("nb_annotations")
            ):
                raise UserError(
                    f"{self.path}: {name}_annotations.json is damaged or does not match {name}_meta.json"
                )
            if captions:
                texts[name] = captions
        return texts

    @cached_property
    def frames(self) -> dict[str, int]:
        """For each motion with captions, the number of frames at 12.5 frames per second."""
        rows = {
            name: len(read_text(self.path / f"{name}_fke.csv").splitlines()) - 1
            for name in self.texts
        }
        return {name: ceil_div(count, 8) for name, count in rows.items()}

    def count(self) -> int:
        """Returns the number of motions that have a caption and a permitted length."""
        return sum(self._fits(name) for name in self.frames)

    def clips(self, fps: float) -> Iterator[Clip]:
        """Yields one clip per motion.

        The `reference` of a test clip includes every frame of its recording.
        """
        self.check_fps(fps, 12.5)
        for name, split in self.names.items():
            if name not in self.texts:
                self.leave_out(f"motions in {split} without a caption")
            elif not self._fits(name):
                is_short = self.frames[name] < self.shortest
                limit = (
                    f"shorter than {self.shortest}" if is_short else f"longer than {self.longest}"
                )
                self.leave_out(f"motions in {split} {limit} frames")
        names = [name for name in self.frames if self._fits(name)]
        tasks = [
            (self.path / f"{name}_fke.csv", 1 if self.names[name] == "test" else 8)
            for name in names
        ]
        for name, recording in zip(names, in_order(_recording, tasks, self.workers), strict=True):
            attributes = {"ghosh_test": name in self.ghosh_test}
            clip = Clip(name, recording, self.texts[name], self.names[name], name, None, attributes)
            if clip.split == "test":
                clip = replace(
                    clip, motion=recording[::8], captions=clip.captions[:1], reference=recording
                )
            yield clip

    def counts(self) -> dict[str, int]:
        """Returns the numbers of motions and captions, and the number of names in each split."""
        texts = sum(len(read_json(path)) for path in self.path.glob("*_annotations.json"))
        splits = list(read_splits(self.splits, "", self.get_it).values())
        counts = {split: splits.count(split) for split in SPLITS} | {
            "ghosh_test": len(self.ghosh_test)
        }
        return {"motions": len(list(self.path.glob("*_fke.csv"))), "texts": texts, **counts}

    def _fits(self, name: str) -> bool:
        return self.names[name] == "test" or self.shortest <= self.frames[name] <= self.longest


def _recording(task: tuple[Path, int]) -> np.ndarray:
    return read_joints(*task)


def read_joints(path: Path, step: int = 8) -> np.ndarray:
    """Reads the joint positions (F, 21, 3) float32 of every `step`-th frame.

    The positions are in meters, with y up. KIT's unit is about 1/640 m.
    """
    lines = read_text(path).splitlines()[1::step]
    with naming(path, ValueError, prefix="damaged, exclude it by its number: "):
        rows = np.loadtxt(lines, delimiter=",", ndmin=2)
        if rows.shape[1] != 64 or not len(rows) or not np.isfinite(rows).all():
            raise UserError(
                f"rows have shape {rows.shape}, but each row must contain its number and 63 finite coordinates"
            )
    return (rows[:, 1:].reshape(-1, 21, 3) / UNITS_PER_METER).astype(np.float32)
