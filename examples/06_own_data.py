"""Turns a folder of motions and captions into a data set."""

import csv
from pathlib import Path

import numpy as np

from flame_mdm.data.folder import Folder
from flame_mdm.data.store import write_store
from flame_mdm.data.synthetic import Synthetic
from flame_mdm.representations.humanml import HumanML

FOLDER = Path("examples_output/06_own_data")
MOTIONS = FOLDER / "motions"


def main() -> None:
    MOTIONS.mkdir(parents=True, exist_ok=True)

    # Your recordings: .bvh, .fbx, .glb, .npz, ... Here, procedural motions take their place.
    with (MOTIONS / "captions.csv").open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["id", "text", "license"])
        for clip in Synthetic(clips=20).clips(30.0):
            np.savez(MOTIONS / clip.id, joints=clip.motion, fps=30)
            table.writerows([clip.id, text, "CC0"] for text in clip.captions)

    source = Folder(str(MOTIONS), mirror=True)
    print("\n".join(source.check(20.0)))

    store = write_store(FOLDER / "mine-humanml", source, HumanML())
    first = store.clips[0]
    print(len(store.clips), "clips;", first.id, first.captions[0], store.motion(first).shape)


if __name__ == "__main__":  # data sets are prepared by processes that import this file
    main()
