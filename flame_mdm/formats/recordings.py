"""Facts about published recordings that their files omit or state incorrectly."""

import re
from pathlib import Path

from flame_mdm.safe_io import read_package_yaml

AT_60: frozenset[str] = frozenset(
    read_package_yaml(Path(__file__).with_suffix(".yaml"))["cmu_at_60"]
)
"""Subjects and individual recordings that CMU captured at 60 frames per second."""
# Skeletons of CMU's recordings and of their conversions
CMU_SKELETONS = (
    "CMU",
    "CMU ASF",
    "Daz",
    "Character Creator",
)
# Pattern for a CMU recording in a file name; the group is the number of the subject
TRIAL = re.compile(r"(?<!\d)(\d{2,3})_\d{2,3}(?!\d)")


def is_at_60(trial: str) -> bool:
    """Returns whether CMU lists a recording, such as 60_01, as captured at 60 frames per second."""
    return not {trial, trial.partition("_")[0]}.isdisjoint(AT_60)


def known_rate(name: str, skeleton: str, fps: float) -> float | None:
    """Returns a recording's true frame rate if its name and skeleton show that `fps` is wrong.

    BVH conversions specify 120 frames per second for nearly all of CMU's recordings.
    """
    trial = TRIAL.search(name)
    if (
        trial
        and skeleton.partition(" without")[0] in CMU_SKELETONS
        and round(fps) == 120
        and is_at_60(trial[0])
    ):
        return 60.0
    return None
