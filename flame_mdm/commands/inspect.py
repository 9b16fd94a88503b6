"""`flame-mdm inspect MOTION|FOLDER|DATASET`: finds physical faults of motions."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from flame_mdm.commands import BodySettings, DataSettings, FileSettings, above_zero, existing
from flame_mdm.config import instantiate
from flame_mdm.config.options import option, required
from flame_mdm.errors import UserError, say
from flame_mdm.formats import motion_files
from flame_mdm.progress import ProgressBar

if TYPE_CHECKING:
    from flame_mdm.formats.motion import Motion

MOST_LINES = 20  # faults that are printed per motion; the player shows all


@dataclass(frozen=True, kw_only=True)
class InspectSettings(BodySettings, FileSettings, DataSettings):
    """usage: flame-mdm inspect MOTION|FOLDER|DATASET [OUT.html] [split=train] [clips=24] [fps=20] [unit=0.01] [up=z]

    Finds physical faults of a motion file, of all motion files in a folder, or of a prepared data set, such as sliding
    feet and jumps; their limits: docs/motion-faults.md
    Prints the faults per frame and joint, and writes a player whose time line marks them; of a data set or a large
    folder, it shows the worst motions, at most `clips`. Exits with 3 if there are faults.
    """

    OBJECTS: ClassVar = ("motion", "out")
    motion: str = required("a motion file, a folder of them, or the name of a data set")
    out: str | None = option(None, "HTML file; default runs/inspect/<name>.html")
    clips: int = option(24, "maximum number of motions in the player, the worst ones", above_zero)
    split: str | None = option(None, "train, val or test of a data set; default: all")

    def __post_init__(self) -> None:
        name = self.motion
        if not (Path(name).suffix or Path(name).exists() or "/" in name):  # not a file: a data set
            object.__setattr__(self, "data", name)
        elif self.data is None:
            existing("motion", name)
        super().__post_init__()


def main(settings: InspectSettings) -> None:
    from flame_mdm.formats.faults import LIMITS, find_faults
    from flame_mdm.visualize import write_player
    from flame_mdm.visualize.body import load_body

    body = load_body(settings.body)
    name, count, motions = _read(settings) if settings.data is None else _clips(settings)
    worst, kinds, faulty = [], Counter(), 0
    for motion in ProgressBar(motions, "inspecting", count, unit=" motions", disable=None if count > 1 else True):
        faults = find_faults(motion)
        kinds.update({fault.kind for fault in faults})
        faulty += bool(faults)
        frames = {frame for fault in faults for frame in range(fault.start, fault.end)}
        score = (len({fault.kind for fault in faults}), len(frames) / len(motion.joints))
        worst = sorted([*worst, (score, motion, faults)], key=lambda row: row[0], reverse=True)[: settings.clips]
    for _, motion, faults in [row for row in worst if row[2]] if count <= settings.clips else []:
        say(f"{motion.id}: {len(faults)} faults", *(f"  {fault}" for fault in faults[:MOST_LINES]))
    say(f"{name}: {faulty} of {count} motions with faults")
    say(*(f"  {kind:12} {kinds[kind]:6} ({kinds[kind] / count:.1%}): {LIMITS[kind][2]}" for kind in LIMITS))
    out = Path(settings.out or Path("runs") / "inspect" / f"{name}.html")
    marks = [[(f.start, f.end, f.kind, str(f)) for f in faults] for _, _, faults in worst]
    write_player(out, [motion for _, motion, _ in worst], f"Faults of {name}", marks=marks, body=body)
    say(f"{out}: the {len(worst)} worst motions (open in any browser)" if count > len(worst) else f"player: {out}")
    if faulty:
        raise SystemExit(3)


def _read(settings: InspectSettings) -> tuple[str, int, Iterator[Motion]]:
    from flame_mdm.formats.layouts import find_skeleton
    from flame_mdm.formats.readers import read

    path = Path(settings.motion)
    files = motion_files(path) if path.is_dir() else [path]

    def motion(file: Path) -> Motion:
        content = read(file, settings.fps, settings.unit, fields=find_skeleton(file, settings.up))
        return content if file == path else replace(content, id=file.relative_to(path).with_suffix("").as_posix())

    return path.resolve().stem, len(files), map(motion, files)


def _clips(settings: InspectSettings) -> tuple[str, int, Iterator[Motion]]:
    from flame_mdm.reporting.browse import motion

    representation = instantiate(settings.nodes["representation"])
    data = instantiate(settings.nodes["data"], representation=representation)
    store = data.open()
    if settings.split not in (None, *store.info["clips"]):
        raise UserError(f"no split is called {settings.split}. Available: {', '.join(store.info['clips'])}")
    clips = [clip for clip in store.clips if settings.split in (None, clip.split)]
    return data.folder.name, len(clips), (motion(store, representation, clip) for clip in clips)
