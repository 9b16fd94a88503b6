"""`flame-mdm inspect MOTION|FOLDER|DATASET`: finds physical faults of motions."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from flame_mdm.commands import data_node
from flame_mdm.commands.browse import prepared
from flame_mdm.config import Config, instantiate, run
from flame_mdm.errors import UserError, say
from flame_mdm.progress import ProgressBar

if TYPE_CHECKING:
    from flame_mdm.formats.motion import Motion

USAGE = """
usage: flame-mdm inspect MOTION|FOLDER|DATASET [OUT.html] [split=train] [clips=24] [fps=20] [unit=0.01] [up=z]

Finds physical faults of a motion file, of all motion files in a folder, or of a prepared data set: sliding feet, jumps,
bones that change their length, joints below the floor, bodies that float or freeze, and impossible bends. Limits, and
how many real clips each flags: docs/motion-faults.md
Prints the faults per frame and joint, and writes a player whose time line marks them; of a data set or a large folder,
it shows the worst motions, at most `clips`. Exits with 3 if there are faults.
"""
FAULTY = 3
MOST_LINES = 20
"""Faults that are printed per motion; the player shows all."""


def inspect(config: Config) -> None:
    """Prints faults, writes the page, and exits with 3 if there are any.

    Raises:
        UserError: If nothing is named, there are no motions, or the data set is unknown.
        FileNotFoundError, ValueError: If a motion or the data set cannot be read.
        SystemExit: With 3, if there are faults.
    """
    if config["clips"] < 1:
        raise UserError(f"clips={config['clips']}: must be at least 1")
    from flame_mdm.formats.faults import LIMITS, find_faults
    from flame_mdm.visualize import write_player
    from flame_mdm.visualize.bodies import load_body

    body = load_body(config["body"])
    name, count, motions = _files(config) if config["motion"] is not None else _clips(config)
    worst, kinds, faulty = [], Counter(), 0
    for motion in ProgressBar(motions, "inspecting", count, unit=" motions", disable=None if count > 1 else True):
        faults = find_faults(motion)
        kinds.update({fault.kind for fault in faults})
        faulty += bool(faults)
        frames = {frame for fault in faults for frame in range(fault.start, fault.end)}
        score = (len({fault.kind for fault in faults}), len(frames) / len(motion.joints))
        worst = sorted([*worst, (score, motion, faults)], key=lambda row: row[0], reverse=True)[: config["clips"]]
    for _, motion, faults in [row for row in worst if row[2]] if count <= config["clips"] else []:
        more = [f"  and {len(faults) - MOST_LINES} more"] if len(faults) > MOST_LINES else []
        say(motion.id, *(f"  {fault}" for fault in faults[:MOST_LINES]), *more)
    say(f"{name}: {faulty} of {count} motions with faults")
    say(*(f"  {kind:12} {kinds[kind]:6} ({kinds[kind] / count:.1%}): {LIMITS[kind][2]}" for kind in LIMITS))
    out = Path(config["out"] or Path("runs") / "inspect" / f"{name}.html")
    marks = [[(f.start, f.end, f.kind, str(f)) for f in faults] for _, _, faults in worst]
    write_player(out, [motion for _, motion, _ in worst], f"Faults of {name}", marks=marks, body=body)
    say(f"{out}: the {len(worst)} worst motions (open in any browser)" if count > len(worst) else f"player: {out}")
    if faulty:
        raise SystemExit(FAULTY)


def _files(config: Config) -> tuple[str, int, Iterator[Motion]]:
    """Returns a name, the number of motions, and the motions of a file or folder."""
    from flame_mdm.formats.layouts import find_skeleton
    from flame_mdm.formats.readers import ENDINGS, read

    path = Path(str(config["motion"]))
    if not path.exists():
        kinds = ", ".join(ENDINGS)
        raise UserError(f"{path}: no such file. Give a motion file ({kinds}), a folder of them, or a prepared data set")
    below = sorted(file for file in path.rglob("*") if file.suffix.lower() in ENDINGS and not file.is_dir())
    found = below if path.is_dir() else [path]
    if not found:
        raise UserError(f"{path}: the folder has no motion files ({', '.join(ENDINGS)})")

    def motion(file: Path) -> Motion:
        known = read(file, config["fps"], config["unit"], given=find_skeleton(file, config["up"]))
        return known if file == path else replace(known, id=file.relative_to(path).with_suffix("").as_posix())

    return path.resolve().stem, len(found), map(motion, found)


def _clips(config: Config) -> tuple[str, int, Iterator[Motion]]:
    """Returns the same of a prepared data set."""
    from flame_mdm.reporting.browse import motion

    node = data_node(config)
    representation = instantiate(config["representation"])
    data = instantiate(node, representation=representation)
    store = data.open()
    if config["split"] not in (None, *store.info["clips"]):
        raise UserError(f"no split is called {config['split']}. Available: {', '.join(store.info['clips'])}")
    clips = [clip for clip in store.clips if config["split"] in (None, clip.split)]
    return data.folder.name, len(clips), (motion(store, representation, clip) for clip in clips)


def _named(words: Sequence[str]) -> list[str]:
    """Replaces `motion=NAME` by `data=NAME` if NAME is neither a path nor looks like the name of a file."""
    name = dict(word.split("=", 1) for word in words if "=" in word).get("motion", "")
    if not name or Path(name).suffix or Path(name).exists() or "/" in name:
        return list(words)
    return prepared([f"data={name}" if word == f"motion={name}" else word for word in words])


main = partial(
    run,
    inspect,
    usage=USAGE,
    name="inspect",
    objects=("motion", "out"),
    text=("motion", "out", "up", "data.name", "source", "body"),
    kinds={"fps": "float", "unit": "float"},
    rewrite=_named,
)
