"""`flame-mdm inspect MOTION|FOLDER|DATASET`: finds physical faults in motions."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from glob import escape
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from flame_mdm.commands import (
    STORE,
    BodySettings,
    DataSettings,
    FileSettings,
    above_zero,
    existing,
    finish,
    read_motions,
)
from flame_mdm.config import EXPERIMENTS, instantiate
from flame_mdm.config.options import option, required
from flame_mdm.errors import UserError, say
from flame_mdm.progress import ProgressBar

if TYPE_CHECKING:
    from flame_mdm.formats.motion import Motion

MOST_LINES = 20  # maximum number of faults printed per motion; the player shows all


@dataclass(frozen=True, kw_only=True)
class InspectSettings(BodySettings, FileSettings, DataSettings):
    """usage: flame-mdm inspect MOTION|FOLDER|DATASET [OUT.html] [split=train] [clips=24] [fps=20] [unit=0.01] [up=z]

    Finds physical faults, such as sliding feet and jumps, in a motion file, in all motion files in
    a folder, or in a prepared data set. docs/motion-faults.md lists the faults and their limits.

    Prints the faults by frame and joint, and writes a player that marks them on its timeline. For a
    data set or a large folder, the player shows only the worst motions; `clips` sets their number.
    Exits with code 3 if there are faults.
    """

    OBJECTS: ClassVar = ("motion", "out")
    motion: str = required(
        "a motion file, a folder of motion files, or the name of a data set, including your "
        "own (data.name)"
    )
    out: str | None = option(None, "HTML file; default: runs/inspect/<name>.html")
    clips: int = option(
        24, "maximum number of motions in the player, which shows the worst ones", above_zero
    )
    split: str | None = option(None, "split of a data set: train, val or test; default: all")

    def __post_init__(self) -> None:
        name = self.motion
        if not (
            Path(name).suffix or Path(name).exists() or "/" in name
        ):  # must be the name of a data set, because there is no such file
            is_prepared = any(Path(self.data_root).glob(f"{escape(name)}-*/{STORE}"))
            # If no recipe has this name, the data set was prepared from a folder of the user.
            if is_prepared and not (EXPERIMENTS / "data" / f"{name}.yaml").exists():
                object.__setattr__(self, "data", "folder")
                object.__setattr__(self, "composed", (*self.composed, f"data.name={name}"))
            else:
                object.__setattr__(self, "data", name)
        elif self.data is None:
            existing("motion", name)
        super().__post_init__()


def main(settings: InspectSettings) -> None:
    """Prints the faults in motions and writes a player that shows them."""
    from flame_mdm.formats.faults import LIMITS, find_faults
    from flame_mdm.visualize import write_player

    body = settings.read_body()
    failures: list[str] = []
    if settings.data is None:
        name, total, motions = read_motions(settings.motion, settings, failures)
    else:
        name, total, motions = _clips(settings)
    worst, kinds, faulty, count = [], Counter(), 0, 0
    for motion in ProgressBar(
        motions, "inspecting", total, unit=" motions", disable=None if total > 1 else True
    ):
        count += 1
        faults = find_faults(motion)
        kinds.update({fault.kind for fault in faults})
        faulty += bool(faults)
        frames = {frame for fault in faults for frame in range(fault.start, fault.end)}
        score = (len({fault.kind for fault in faults}), len(frames) / len(motion.joints))
        worst = sorted([*worst, (score, motion, faults)], key=lambda row: row[0], reverse=True)[
            : settings.clips
        ]
    if not count:
        finish(failures, total, "read")
    for _, motion, faults in worst if count <= settings.clips else []:
        say(*(f"{motion.id}: {note}" for note in motion.notes))
        if faults:
            say(
                f"{motion.id}: {len(faults)} faults",
                *(f"  {fault}" for fault in faults[:MOST_LINES]),
            )
    say(f"{name}: {faulty} of {count} motions have faults")
    say(
        *(
            f"  {kind:12} {kinds[kind]:6} ({kinds[kind] / count:.1%}): {LIMITS[kind][2]}"
            for kind in LIMITS
        )
    )
    out = Path(settings.out or Path("runs") / "inspect" / f"{name}.html")
    marks = [[(f.start, f.end, f.kind, str(f)) for f in faults] for _, _, faults in worst]
    write_player(
        out, [motion for _, motion, _ in worst], f"Faults of {name}", marks=marks, body=body
    )
    say(
        f"{out}: the {len(worst)} worst motions (open in any browser)"
        if count > len(worst)
        else f"player: {out}"
    )
    finish(failures, total, "read")
    if faulty:
        raise SystemExit(3)


def _clips(settings: InspectSettings) -> tuple[str, int, Iterator[Motion]]:
    from flame_mdm.data.store import Store
    from flame_mdm.reporting.browse import motion

    representation = instantiate(settings.nodes["representation"])
    data = instantiate(settings.nodes["data"], representation=representation)
    # The user's motions are inspected as they were prepared.
    if (data.folder / STORE).exists() and data.source.named_by_recipe:
        info = Store(data.folder).info
        data.source.options, data.source.version = info.get("source", {}), info.get("version", 1)
    store = data.open()
    if settings.split not in (None, *store.info["clips"]):
        raise UserError(
            f"unknown split {settings.split}. Available: {', '.join(store.info['clips'])}"
        )
    clips = [clip for clip in store.clips if settings.split in (None, clip.split)]
    return data.folder.name, len(clips), (motion(store, representation, clip) for clip in clips)
