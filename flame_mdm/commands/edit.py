"""`flame-mdm edit CKPT motion=FILE`: keeps part of a motion and resamples the rest."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

from flame_mdm.commands import FileSettings, OutputSettings, motion_file, usual_data_root
from flame_mdm.config.options import option, required, same_option
from flame_mdm.errors import say
from flame_mdm.sampling.motion_request import EditRequest, SamplingRequest


@dataclass(frozen=True, kw_only=True)
class EditSettings(OutputSettings, EditRequest, FileSettings):
    """usage: flame-mdm edit CKPT MOTION [OUT] region=in_between text="a person jumps" [key=value ...]
           flame-mdm edit CKPT take.bvh cut=[0,3] joints=upper_body unconditioned=true
           flame-mdm edit CKPT bandai:CLIP region_seconds=[1,2] joints=[left_arm,head] method=flame ...

    Keeps part of a motion and resamples the rest. Writes the original and the results (.npz), a
    GIF, and a player that opens in any browser. docs/editing.md explains the keys.
    """

    OBJECTS: ClassVar = ("ckpt", "motion", "out")
    motion: str = required(
        "a motion file (.npz, .bvh, .fbx, .glb, .json, .npy) or dataset:id", motion_file
    )
    samples: int = same_option(SamplingRequest, "samples", default=3)
    cut: Sequence[float] | None = option(
        None, "part of the motion to use: [begin, end] in seconds; default: the whole motion"
    )
    data_root: str = option(usual_data_root, "folder of the prepared data sets")
    out: str | None = option(
        None, "folder for the results; default: samples/<experiment>/edit-<motion>-<text>-<hash>"
    )


def main(settings: EditSettings) -> None:
    """Edits a motion file and writes the results."""
    request = settings.request()

    from flame_mdm.sampling.editing import resolve_edit, sample_edit
    from flame_mdm.sampling.output import (
        SAMPLES,
        default_folder,
        degenerate_notes,
        summary,
        write_motions,
    )
    from flame_mdm.sampling.reading import read_motion

    loaded = settings.load()
    model = loaded.model
    original = read_motion(
        model.representation,
        settings.motion,
        fps=settings.fps,
        unit=settings.unit,
        up=settings.up,
        animation=settings.animation,
        cut=settings.cut,
        data_root=settings.data_root,
    )
    say(*(f"{settings.motion}: {note}" for note in original.notes))
    resolved = resolve_edit(request, model, original)
    say(*(f"warning: {line}" for line in resolved.resolved.warnings))
    stages = [] if settings.trajectory else None
    edits = sample_edit(model, resolved, stages=stages)
    say(*degenerate_notes(edits))

    title = f"edit {Path(original.id).stem} {edits[0].text}"
    general = (model.sha256, replace(request, samples=1), *origin(settings))
    folder = Path(settings.out or default_folder(model, title, *general))
    shown = replace(original, text=f"original: {original.text or original.id}")
    facts = {"seed": settings.seed, "checkpoint": model.sha256, "keep": edits[0].keep}
    write_motions(
        folder,
        [shown, *edits],
        facts,
        stages,
        settings.mp4,
        loaded.body,
        within=settings.out or SAMPLES,
    )
    say(summary(folder, edits, mp4=settings.mp4))

    changed = max(edit.feature_error for edit in edits)
    moved = max(edit.joint_error for edit in edits)
    largest = f"{changed:.3g} in normalized features, {moved:.3g} m in world joint positions"
    say(
        f"{edits[0].keep.mean():.0%} of the features are kept. Largest change in the kept part: {largest}"
    )
    if moved > 0.01:
        say(
            "a kept part that follows a generated part begins where the generated part ends, so its "
            "position in the world may differ from the original"
        )


def origin(settings: EditSettings) -> tuple[object, ...]:
    """Returns the values that, together with the request, identify an edit.

    Edits that differ in these values are written to different folders.
    """
    reading = (settings.fps, settings.unit, settings.up, settings.animation)
    return settings.motion, settings.cut, reading, settings.adapter, settings.adapter_strength
