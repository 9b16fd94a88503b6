# pyright: standard
"""Output of the sampling commands: folders, files, and summaries of what was written."""

import hashlib
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from flame_mdm.errors import UserError
from flame_mdm.formats.motion import Motion
from flame_mdm.generator import MotionGenerator
from flame_mdm.safe_io import atomic_folder
from flame_mdm.sampling.motion_request import TRAINED_ON
from flame_mdm.visualize import contact_sheet, write_gif, write_mp4, write_player
from flame_mdm.visualize.body import Mesh

SAMPLES = "samples"  # default folder for motions
REQUEST_FILES = re.compile(r"motion_\d{3,}\.npz|motions\.mp4|trajectory\.png")
"""Files that are written only for some requests."""


def refuse_no_condition(model: MotionGenerator) -> None:
    """Raises a `UserError` that asks for a condition and lists examples that the model knows."""
    examples = list(
        model.facts["actions"]
        if model.conditioned_on == "action"
        else model.facts.get("captions", ())
    )
    shown = "; ".join(examples[:: max(1, len(examples) // 5)][:5])
    key = TRAINED_ON[model.conditioned_on][1]
    raise UserError(f"nothing to sample. Set {key}" + (f". Examples: {shown}" if shown else ""))


def default_folder(model: MotionGenerator, title: str, *request: object) -> Path:
    """Returns `samples/<experiment>/<title>-<hash>`; the hash depends on the title and `request`.

    Requests for different motions therefore use different folders, even on a file system that
    ignores case. The folder is always inside `SAMPLES`, even if an untrusted checkpoint contains a
    path instead of an experiment name.
    """
    digest = hashlib.sha256(repr((title, request)).encode()).hexdigest()[:6]
    name = re.sub(r"[^\w]+", "-", title.lower()).strip("-")[:40].strip("-")
    return Path(
        SAMPLES, *re.findall(r"[\w-][\w.-]*", str(model.config["experiment"])), f"{name}-{digest}"
    )


def summary(folder: Path, motions: Sequence[Motion], *, mp4: bool) -> str:
    """Returns a one-line summary of the files that `write_motions` wrote to a folder."""
    count = "1 motion" if len(motions) == 1 else f"{len(motions)} motions"
    files = f"{folder / 'player.html'}, motions.gif" + (", motions.mp4" if mp4 else "")
    return f"{count} of {len(motions[0].joints)} frames: {files}"


def degenerate_notes(motions: Sequence[Motion]) -> list[str]:
    """Returns a warning if the features in some frames do not determine rotations.

    Without such frames, the result is [].
    """
    degenerate = sum(motion.degenerate for motion in motions)
    if not degenerate:
        return []
    frames = sum(len(motion.joints) for motion in motions)
    rest = "which were replaced by arbitrary ones. Train the model longer"
    return [f"warning: {degenerate} of {frames} frames have degenerate rotations, {rest}"]


def write_motions(
    folder: Path,
    motions: Sequence[Motion],
    facts: dict[str, Any],
    stages: Sequence[Motion] | None = None,
    mp4: bool = False,
    body: Mesh | None = None,
    *,
    within: str | Path | None = None,
) -> None:
    """Writes `motion_000.npz`, ..., `motions.gif`, `motions.png` and `player.html` to a folder.

    Either all files are written or none, and files that remain from an earlier request are removed.
    The pictures show only the first eight motions, and `trajectory.png` shows the stages of a
    sampling run. `facts` are added to each `.npz`. Links must not point outside `within`; see
    `flame_mdm.safe_io.atomic_folder`.
    """
    scene = [replace(motion, text=motion.text or "unconditioned") for motion in motions]
    title = motions[0].text if len({motion.text for motion in motions}) == 1 else ""
    with atomic_folder(folder, within=within) as temporary:
        write_player(temporary / "player.html", scene, title or "Motions", body=body)
        for number, motion in enumerate(motions):
            motion.save(temporary / f"motion_{number:03d}.npz", **facts)
        write_gif(temporary / "motions.gif", scene[:8], body=body)
        if mp4:
            write_mp4(temporary / "motions.mp4", scene[:8], body=body)
        contact_sheet(temporary / "motions.png", scene[:8], body=body)
        if stages:
            contact_sheet(temporary / "trajectory.png", stages, body=body)
        written = {path.name for path in temporary.iterdir()}
    for path in list(folder.iterdir()):
        if REQUEST_FILES.fullmatch(path.name) and path.name not in written:
            path.unlink()
