# pyright: standard
"""Sets of motions for game engines: loops, starts, stops and turns that fit together.

The motions of a set are listed in a YAML file.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from pydantic import Field

from flame_mdm.errors import UserError, did_you_mean
from flame_mdm.formats import fbx_writer, gaits, glb_writer, usd
from flame_mdm.formats.body import fit_body
from flame_mdm.formats.cleanup import cleaned
from flame_mdm.formats.faults import find_faults
from flame_mdm.formats.gaits import Clip
from flame_mdm.formats.grounding import (
    GroundedMotion,
    grounded,
    jolt,
    pivot,
    slide,
    with_lengths,
)
from flame_mdm.formats.motion import Motion
from flame_mdm.formats.retarget import preset, presets
from flame_mdm.formats.rigged import RiggedClip, contact_events, rigged
from flame_mdm.generator import MotionGenerator
from flame_mdm.progress import ProgressBar
from flame_mdm.representations.skeleton import SMPL22
from flame_mdm.safe_io import atomic_folder, read_yaml, write_json
from flame_mdm.sampling.generation import generate
from flame_mdm.sampling.keywords import SamplerKeywords
from flame_mdm.sampling.reading import decoded
from flame_mdm.schemas import ClosedSchema, check_shape
from flame_mdm.visualize import contact_sheet, write_player
from flame_mdm.visualize.body import Mesh

SETS = Path(__file__).parent / "sets"
# Suffix for the names of files without a root trajectory
IN_PLACE = "_InPlace"
# Length, in seconds, of the gaps between clips when the rotations of all clips are computed
# together
SEPARATION = 1.0
NAME = r"^[A-Za-z0-9_-]{1,60}$"
WRITERS: dict[str, Callable[[Path, RiggedClip], None]] = {
    "fbx": fbx_writer.write,
    "glb": lambda path, clip: glb_writer.write(path, clip, clip.name),
    "usda": usd.write,
    "usdc": usd.write,
    "usdz": usd.write,
}
"""Functions that write a clip, by file format."""
# Penalty per meter of foot sliding, relative to the penalty per meter of difference between poses
SLIDING = 200.0
# Penalty per degree of rotation of a planted foot
PIVOTING = 0.1
# Penalty per m/s² of acceleration of a foot
JOLTING = 0.1
# Penalty of a frame with a fault
FAULTY = 0.2


class SetMotion(ClosedSchema):
    """A motion in a set."""

    text: str
    kind: Literal["loop", "gait", "turn"]
    seconds: Annotated[float, Field(gt=0, le=60)] | None = None
    degrees: Annotated[float, Field(ge=-360, le=360)] = 0.0


class MotionSet(ClosedSchema):
    """Contents of a file that describes a set of motions; docs/sampling.md explains the keys."""

    stand: str
    motions: Annotated[
        Mapping[Annotated[str, Field(pattern=NAME)], SetMotion], Field(min_length=1, max_length=200)
    ]
    prefix: Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{0,40}$")] = ""
    format: Literal["fbx", "glb", "usda", "usdc", "usdz"] = "fbx"
    rig: str | None = "unreal"
    fps: Annotated[float, Field(ge=10, le=240)] = 30.0
    candidates: Annotated[int, Field(ge=1, le=100)] = 8


def read_set(source: str) -> MotionSet:
    """Reads a set from its name, such as "locomotion", or from a YAML file.

    Raises:
        UserError: If the set is invalid.
    """
    names = sorted(path.stem for path in SETS.glob("*.yaml"))
    path = Path(source)
    if source in names:
        path = SETS / f"{source}.yaml"
    elif path.suffix not in (".yaml", ".yml"):
        near = did_you_mean(source, names)
        raise UserError(
            f"set={source}: no such set.{near} Use a .yaml file or one of {', '.join(names)}"
        )
    try:
        content = check_shape(read_yaml(path), MotionSet)
    except UserError:
        raise
    except ValueError as error:
        raise UserError(f"{path}: {error}; see docs/sampling.md") from error

    stand = content.motions.get(content.stand)
    if stand is None or stand.kind != "loop":
        raise UserError(
            f"{path}: stand is {content.stand}, which is not a loop. Use the name of a motion with kind: loop"
        )
    for name, motion in content.motions.items():
        if motion.kind == "turn" and not motion.degrees:
            raise UserError(
                f"{path}: motions.{name} is a turn without degrees. Set degrees; 90 is a turn to the left"
            )
    _check_rig(content, f"{path}: rig: ")
    return content


def changed(content: MotionSet, **values: Any) -> MotionSet:
    """Returns a set in which the values of `rig`, `format` or `fps` are replaced.

    Raises:
        UserError: If a value is invalid.
    """
    try:
        content = check_shape(content.model_dump() | values, MotionSet)
    except ValueError as error:
        raise UserError(f"set: {error}") from error
    _check_rig(content, "rig=")
    return content


def _check_rig(content: MotionSet, name: str) -> None:
    if content.rig is not None and content.rig not in presets():
        raise UserError(
            f"{name}{content.rig}: unknown.{did_you_mean(content.rig, presets())} Use one "
            f"of {', '.join(presets())}"
        )


@dataclass(frozen=True, eq=False)
class MadeSet:
    """The clips of a set, and the reasons for omitting other motions, keyed by motion name."""

    clips: list[Clip]
    left_out: dict[str, str]


def make_set(model: MotionGenerator, content: MotionSet, seed: int = 0, **options: Any) -> MadeSet:
    """Generates the motions of a set, cuts them into clips, and shows a progress bar.

    For each motion, the candidate with the best clips is kept. In a good clip, the poses at the
    cuts are similar, the feet neither slide nor jerk, and few frames have faults. Motions that the
    model cannot generate are omitted.

    Args:
        model: a text-conditioned model that has SMPL's 22 joints and can sample in windows.
        content: the set.
        seed: seed of the noise.
        options: sampling options, as in `generate`.

    Raises:
        UserError: If the model does not have SMPL's 22 joints or cannot do what is requested, or if
            no candidate shows a standing person.
    """
    if model.representation.skeleton.joints != SMPL22.joints:
        raise UserError(
            f"set: expected a model with SMPL's 22 joints, not {model.representation.skeleton.name}"
        )
    others = [name for name in content.motions if name != content.stand]
    stand = np.zeros((0, 3))
    clips: list[Clip] = []
    left_out: dict[str, str] = {}
    for name in ProgressBar([content.stand, *others], desc="sample", unit="motion"):
        motion = content.motions[name]
        takes = _takes(model, motion, content, seed, options)
        if len(stand):
            takes = [replace(take, local=with_lengths(take.local, stand)) for take in takes]
        versions = [version for take in takes if (version := _clips(name, motion, take, stand))]
        if not versions:
            left_out[name] = (
                f"none of {content.candidates} motions for '{motion.text}' {_missing(motion)}"
            )
            continue
        clips += min(versions, key=lambda version: version[0])[1]
        if name == content.stand:
            stand = clips[0].motion.local[0]
    return MadeSet(clips, left_out)


def _takes(
    model: MotionGenerator,
    motion: SetMotion,
    content: MotionSet,
    seed: int,
    options: Mapping[str, Any],
) -> list[GroundedMotion]:
    """Samples the candidates for a motion.

    A candidate for a loop consists of three repetitions plus one frame.
    """
    is_loop, representation = motion.kind == "loop", model.representation
    sampling: SamplerKeywords = {**options}  # type: ignore[typeddict-item]
    sampled = generate(
        model,
        motion.text,
        samples=content.candidates,
        seconds=motion.seconds,
        seed=seed,
        loop=is_loop,
        split=False,
        **sampling,
    )
    takes = []
    for take in sampled:
        features = torch.from_numpy(take.features)
        if is_loop:
            several = torch.cat([features] * 4)[: 3 * len(features) + 1]
            take = decoded(representation, several, take.text, take.id)
            features = several
        smooth = cleaned(take, representation.contacts(features.numpy())).resampled(content.fps)
        takes.append(grounded(smooth.joints, content.fps))
    return takes


def _clips(
    name: str, motion: SetMotion, take: GroundedMotion, stand: np.ndarray
) -> tuple[float, list[Clip]] | None:
    """Returns the score of a candidate (lower is better) and the clips that are cut from it.

    Returns None if the candidate does not show the motion.
    """
    score = 0.0
    if motion.kind == "loop":
        clips = [Clip(name, "loop", gaits.loop(take), motion.text)]
    elif motion.kind == "turn":
        turn = gaits.turn(take, motion.degrees, stand)
        if turn is None:
            return None
        clips = [Clip(name, "turn", turn, motion.text)]
    else:
        cycle = gaits.find_cycle(take, motion.degrees)
        if cycle is None:
            return None
        score = 100 * cycle.difference
        parts = gaits.gait(take, cycle, motion.degrees, stand)
        kinds = ("start", "loop", "stop")
        clips = [
            Clip(f"{name}_{kind.capitalize()}", kind, part, motion.text)
            for kind, part in zip(kinds, parts, strict=True)
        ]
    faulty = sum(
        fault.end - fault.start for clip in clips for fault in find_faults(motion_of(clip))
    )
    motions = [clip.motion for clip in clips]
    score += SLIDING * max(map(slide, motions)) + PIVOTING * max(map(pivot, motions))
    score += JOLTING * max(map(jolt, motions))
    return score + FAULTY * faulty, clips


def _missing(motion: SetMotion) -> str:
    if motion.kind == "gait":
        return f"goes steadily in the direction of {motion.degrees:g} degrees"
    return f"turns by {motion.degrees:g} degrees"


def motion_of(clip: Clip) -> Motion:
    """Converts a clip to a motion that follows the clip's root trajectory."""
    return Motion(clip.motion.world(), clip.motion.fps, SMPL22, clip.name, clip.name)


def rig_clips(clips: list[Clip], rig: str | None, body: Mesh | None = None) -> list[RiggedClip]:
    """Converts clips to in-place clips that share one skeleton and one skin.

    All clips must have the same rest pose, because programs apply all animations of a set to the
    skeleton of the first file. Therefore, the rotations of all clips are computed together.
    """
    fps = clips[0].motion.fps
    joints, frames = gaits.with_neighbors(clips, round(SEPARATION * fps))
    motion = Motion(joints, fps, SMPL22)
    poses = motion.posed()
    whole = rigged(poses, "", fps, preset(rig, poses), fit_body(motion, body))
    return [
        whole.part(part, clip.name, clip.motion.contacts)
        for part, clip in zip(frames, clips, strict=True)
    ]


def write_set(
    folder: Path, clips: MadeSet, content: MotionSet, facts: Mapping[str, Any], body: Mesh | None
) -> list[str]:
    """Writes all files of a set to a folder, or none if an error occurs, and returns their names.

    Each clip is written to two files, one with the root trajectory and one in place. `set.json`
    describes the clips, and `set.png` and `player.html` show them.
    """
    in_place = rig_clips(clips.clips, content.rig, body)
    entries = []
    with atomic_folder(folder) as temporary:
        pairs = list(zip(clips.clips, in_place, strict=True))
        for clip, still in ProgressBar(pairs, desc="write", unit="clip"):
            name = f"{content.prefix}{clip.name}"
            files = {
                "root_motion": f"{name}.{content.format}",
                "in_place": f"{name}{IN_PLACE}.{content.format}",
            }
            moved = still.on_path(clip.motion.path, clip.motion.heading)
            for key, variant in (("root_motion", moved), ("in_place", still)):
                WRITERS[content.format](
                    temporary / files[key], replace(variant, name=Path(files[key]).stem)
                )
            entries.append(_entry(clip, still, files))
        shown = [motion_of(clip) for clip in clips.clips]
        contact_sheet(temporary / "set.png", shown, size=144, body=body)
        write_player(temporary / "player.html", shown, "Set of motions", body=body)
        listed = {"clips": entries, "left_out": clips.left_out}
        write_json(
            temporary / "set.json", {"fps": content.fps, "rig": content.rig, **facts, **listed}
        )
        names = sorted(path.name for path in temporary.iterdir())
    return names


def _entry(clip: Clip, still: RiggedClip, files: Mapping[str, str]) -> dict[str, Any]:
    """Returns a clip's entry in `set.json`.

    Lengths are in meters, angles in degrees, and times in seconds.
    """
    motion = clip.motion
    seconds = (len(motion) - 1) / motion.fps
    travel = motion.path[-1] - motion.path[0]
    steps = np.linalg.norm(np.diff(motion.path, axis=0), axis=1) * motion.fps
    entry: dict[str, Any] = {
        "name": clip.name,
        "kind": clip.kind,
        "text": clip.text,
        "files": dict(files),
        "frames": len(motion),
        "seconds": round(seconds, 4),
        "travel": [round(float(value), 4) for value in travel],
        "turn": round(float(np.degrees(motion.heading[-1] - motion.heading[0])), 2),
        "speed": [round(float(steps[0]), 3), round(float(steps[-1]), 3)],
        "slide": round(slide(motion), 4),
    }
    if clip.kind == "loop":
        distance, angle = closure(still)
        times = [None if time is None else round(time, 4) for time in gaits.passing(motion)]
        entry["passing"] = dict(zip(("left", "right"), times, strict=True))
        entry["closure"] = {"meters": round(distance, 5), "degrees": round(angle, 3)}
    entry["planted_at_start"] = dict(
        zip(("left", "right"), motion.contacts[0].tolist(), strict=True)
    )
    entry["contacts"] = [event._asdict() for event in contact_events(motion.contacts, motion.fps)]
    return entry


def closure(clip: RiggedClip) -> tuple[float, float]:
    """Returns the differences between the first and the last pose of an in-place clip.

    The first difference is a distance in meters, and the second one is an angle in degrees between
    local rotations.
    """
    positions, _ = clip.world()
    distance = float(np.linalg.norm(positions[-1] - positions[0], axis=-1).max())
    cosines = (np.trace(clip.turns[0].mT @ clip.turns[-1], axis1=-2, axis2=-1) - 1) / 2
    return distance, float(np.degrees(np.arccos(np.clip(cosines, -1, 1))).max())
