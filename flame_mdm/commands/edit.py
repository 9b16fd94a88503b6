"""`flame-mdm edit CKPT motion=FILE`: keeps part of a motion and resamples the rest."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

from flame_mdm.commands import FileSettings, motion_file, usual_data_root
from flame_mdm.commands.sample import SAMPLES, OutputSettings, check_condition, default_folder, summary
from flame_mdm.errors import say
from flame_mdm.safe_io import sha256
from flame_mdm.safe_io.paths import check_within
from flame_mdm.sampler_options import option, required
from flame_mdm.sampling.motion_request import EditRequest


@dataclass(frozen=True, kw_only=True)
class EditSettings(OutputSettings, EditRequest, FileSettings):
    """usage: flame-mdm edit CKPT MOTION [OUT] region=in_between text="a person jumps" [key=value ...]
           flame-mdm edit CKPT take.bvh cut=[0,3] joints=upper_body unconditioned=true
           flame-mdm edit CKPT bandai:CLIP region_seconds=[1,2] joints=[left_arm,head] method=flame ...

    Keeps part of a motion and resamples the rest. Writes the original and the results (.npz), a GIF, and a player that
    opens in any browser. docs/editing.md explains the keys.
    """

    OBJECTS: ClassVar = ("ckpt", "motion", "out")
    motion: str = required("FILE (.npz, .bvh, .json, .npy) or dataset:id", motion_file)
    cut: Sequence[float] | None = option(None, "[begin, end] in seconds: use only this part of the motion")
    data_root: str = option(usual_data_root, "folder of the prepared data sets")
    out: str | None = option(None, "folder; default samples/<experiment>/edit-<motion>-<text>-<hash>")


def main(settings: EditSettings) -> None:
    request = settings.request()
    file = settings.model_file()

    from flame_mdm.sampling.editing import edit_request
    from flame_mdm.sampling.generation import write_motions
    from flame_mdm.sampling.reading import read_motion

    model, body = settings.load(file)
    check_condition(settings, request, model)
    facts = {key: getattr(settings, key) for key in ("fps", "unit", "up", "cut", "data_root")}
    original = read_motion(model.representation, settings.motion, **facts)
    stages = [] if settings.trajectory else None
    edits = edit_request(model, original, request, stages=stages)
    digest, what = sha256(file), f"edit {Path(original.id).stem} {edits[0].text}"
    general = (settings.motion, settings.cut, settings.adapter, settings.adapter_strength)
    folder = Path(settings.out or default_folder(model, what, digest, replace(request, samples=1), *general))
    shown = replace(original, text=f"original: {original.text or original.id}")
    facts = {"seed": settings.seed, "checkpoint": digest, "keep": edits[0].keep}
    check_within(folder, settings.out or SAMPLES)
    write_motions(folder, [shown, *edits], facts, stages, settings.mp4, body)
    say(summary(folder, edits, settings))
    changed, moved = max(e.feature_error for e in edits), max(e.joint_error for e in edits)
    largest = f"{changed:.3g} in normalized features, {moved:.3g} m in world joint positions"
    say(f"{edits[0].keep.mean():.0%} of the features are kept. Largest change in the kept part: {largest}")
    if moved > 0.01:
        say("a kept part that follows a generated one begins where that one ends, so its place in the world may differ")
