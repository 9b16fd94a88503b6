"""Small folders in the layout of HumanML3D and KIT-ML, for the tests of both."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from flame_mdm.data.verify import PUBLISHED
from flame_mdm.safe_io import read_yaml

Texts = Mapping[str, tuple[int, list[str]]]
"""Name -> number of frames, lines of the text file."""


def published(name: str) -> dict:
    """The published figures of a data set."""
    return read_yaml(PUBLISHED)[name]


def line(caption: str, begin: object = 0.0, end: object = 0.0) -> str:
    """A description as in the text files."""
    return f"{caption}#{' '.join(f'{word}/NOUN' for word in caption.replace('#', '').split())}#{begin}#{end}"


def write_folder(
    folder: Path, motions: Texts, splits: Mapping[str, list[str]], width: int, mirror: bool = True
) -> Path:
    """Features count up from 1000 x the number of the motion, so that a frame tells where it comes from."""
    (folder / "new_joint_vecs").mkdir(parents=True)
    (folder / "texts").mkdir()
    for number, (name, (frames, lines)) in enumerate(motions.items()):
        features = np.tile(1000.0 * number + np.arange(frames)[:, None], (1, width)).astype(np.float32)
        for copy, values in ((name, features), (f"M{name}", -features)):
            if copy == name or mirror:
                np.save(folder / "new_joint_vecs" / f"{copy}.npy", values)
                (folder / "texts" / f"{copy}.txt").write_text("\n".join(lines) + "\n")
    for split, names in splits.items():
        copies = [copy for name in names for copy in ((name, f"M{name}") if mirror else (name,))]
        (folder / f"{split}.txt").write_text("\n".join(copies) + "\n")
    np.save(folder / "Mean.npy", np.linspace(-1, 1, width))
    np.save(folder / "Std.npy", np.linspace(0.5, 2, width))
    return folder
