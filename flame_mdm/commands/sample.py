"""`flame-mdm sample CKPT text="a person walks" seconds=3`: samples motions from a checkpoint."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from importlib.util import find_spec
from pathlib import Path
from statistics import mean
from typing import TYPE_CHECKING, Any, ClassVar

from flame_mdm.commands import AdaptedSettings, BodySettings, device_name, existing, motion_file
from flame_mdm.errors import UserError, say, shortened
from flame_mdm.safe_io import MEBIBYTE, read_text, sha256
from flame_mdm.safe_io.paths import check_within
from flame_mdm.sampler_options import SamplerOptions, option, same_option
from flame_mdm.sampling.motion_request import (
    TRAINED_ON,
    EditRequest,
    SamplingRequest,
    path_targets,
    read_path,
    understood,
)

if TYPE_CHECKING:
    from flame_mdm.formats.motion import Motion
    from flame_mdm.generator import MotionGenerator
    from flame_mdm.visualize.body import Mesh

SAMPLES = "samples"  # default folder of the motions
GALLERY = 200  # maximum number of motions on the page of a file of prompts, which has about 20 kB for each


def video(key: str, requested: bool) -> None:
    if requested and find_spec("av") is None:
        raise UserError(f'{key}=true: MP4 needs the package av. Run pip install "flame-mdm[video]", or write a GIF')


@dataclass(frozen=True, kw_only=True)
class OutputSettings(BodySettings, SamplerOptions, AdaptedSettings):
    """Keys that `sample` and `edit` share."""

    text: str | None = same_option(SamplingRequest, "texts")
    action: str | None = same_option(SamplingRequest, "actions")
    unconditioned: bool = option(False, "true = neither text nor action")
    samples: int = same_option(SamplingRequest, "samples", default=3)
    seed: int = same_option(SamplingRequest, "seed")
    cleanup: bool = same_option(SamplingRequest, "cleanup")
    targets: str | None = same_option(SamplingRequest, "targets", existing)
    trajectory: bool = option(False, "draw the clean estimates along the sampling of the first motion: trajectory.png")
    mp4: bool = option(False, 'also write motions.mp4; needs pip install "flame-mdm[video]"', video)
    device: str | None = option(None, "default: cuda if available", device_name)

    def load(self, file: Path) -> tuple[MotionGenerator, Mesh]:
        """Returns the model with its adapters, and the body to draw."""
        import torch

        from flame_mdm.checkpoints.loading import load
        from flame_mdm.visualize.body import load_body

        body = load_body(self.body)
        return load(file, self.device or ("cuda" if torch.cuda.is_available() else "cpu"), **self.adapters()), body

    def request(self) -> SamplingRequest:
        """Returns what is requested of the model; raises `UserError` if it is more than one condition, or invalid."""
        conditions = [name for name in ("text", "prompts", "action") if getattr(self, name, None) is not None]
        conditions += ["unconditioned"] if self.unconditioned else []
        if len(conditions) > 1:
            raise UserError(f"{' and '.join(conditions)} exclude each other. Give only one of them")

        def values(kind: type) -> dict[str, Any]:
            return {entry.name: getattr(self, entry.name) for entry in fields(kind) if hasattr(self, entry.name)}

        texts = read_prompts(vars(self)["prompts"]) if "prompts" in conditions else self.text
        own = values(SamplingRequest) | {"texts": texts, "actions": self.action}
        editing = EditRequest(**values(EditRequest)) if isinstance(self, EditRequest) else None
        return SamplingRequest(**own, options=SamplerOptions(**values(SamplerOptions)), editing=editing)


@dataclass(frozen=True, kw_only=True)
class SampleSettings(OutputSettings):
    """usage: flame-mdm sample CKPT text="a person walks in a circle clockwise" [seconds=3] [key=value ...]
           flame-mdm sample CKPT text="walks forward @3 | turns around | bows @2.5" [after=walk.npz] [loop=true]
           flame-mdm sample CKPT text="walks forward" path="0,1 0.5,2" | targets=FILE.json
           flame-mdm sample CKPT prompts=FILE.txt [seconds=[2,3.5,...]] [mp4=true]
           flame-mdm sample CKPT action=walk
           flame-mdm sample CKPT unconditioned=true

    Writes motions (.npz), a GIF, and a player that opens in any browser. A file of prompts has one per line; each gets
    its own folder, and one page shows all.
    """

    OBJECTS: ClassVar = ("ckpt", "out")
    prompts: str | None = option(None, "instead of text: a file with one prompt per line; each gets its own folder")
    seconds: float | Sequence[float] | None = same_option(SamplingRequest, "seconds")
    frames: int | Sequence[int] | None = same_option(SamplingRequest, "frames")
    after: str | None = same_option(SamplingRequest, "after", motion_file)
    split: bool = same_option(SamplingRequest, "split")
    loop: bool = same_option(SamplingRequest, "loop")
    path: str | None = option(None, 'way points on the floor, x,z in meters, instead of targets: "0,1 0.5,2"')
    shared_noise: bool = same_option(SamplingRequest, "shared_noise")
    out: str | None = option(None, "folder; default samples/<experiment>/<text>-<hash>")

    def request(self) -> SamplingRequest:
        """See `OutputSettings`; a path becomes targets."""
        request = super().request()
        if self.path is None:
            return request
        if excess := [name for name in ("targets", "prompts", "frames") if getattr(self, name) is not None]:
            raise UserError(f"path={self.path}: {excess[0]} cannot be given with a path. Give text and seconds")
        way, usual = read_path(self.path), request.lengths(1.0)[0] or 3.0
        return replace(request, targets=path_targets(way, sum(seconds or usual for _, seconds in request.parts[0])))


def main(settings: SampleSettings) -> None:
    request = settings.request()
    file = settings.model_file()

    from flame_mdm.sampling.generation import sample_request, write_motions

    model, body = settings.load(file)
    typed, request = request.prompts, understood(request, model)
    for text in request.prompts:
        if text not in typed:
            say(f"sampled as a sequence: {text}. Add split=false to sample it as one action")
    check_condition(settings, request, model)
    stages = [] if settings.trajectory else None
    motions = sample_request(model, request, stages=stages)
    digest = sha256(file)
    folders = _folders(settings, request, model, digest, motions)
    for folder, made in folders.items():
        check_within(folder, settings.out or SAMPLES)
        facts = {"seed": settings.seed, "checkpoint": digest}
        write_motions(folder, made, facts, stages if made[0] is motions[0] else None, settings.mp4, body)
        if settings.prompts is None:
            say(summary(folder, made, settings))
        if request.targets is not None:
            say(_distance(request.targets, model, made))
    if settings.prompts is not None:
        say(_gallery(settings, folders, body))


def _folders(
    settings: SampleSettings, request: SamplingRequest, model: MotionGenerator, digest: str, motions: Sequence[Motion]
) -> dict[Path, list[Motion]]:
    """Returns the folders to write, with the motions of each; a prompt that is listed twice has one folder."""
    shared = replace(request, texts=None, actions=None, seconds=None, frames=None, samples=1)
    general = (digest, request.kind, shared, settings.adapter, settings.adapter_strength)
    lengths = request.lengths(model.representation.fps)
    folders: dict[Path, list[Motion]] = {}
    for number, (prompt, length) in enumerate(zip(request.prompts, lengths, strict=True)):
        folder = default_folder(model, prompt or "unconditioned", length, *general)
        if settings.out:
            folder = Path(settings.out, folder.name if settings.prompts is not None else "")
        made = motions[number * request.samples : (number + 1) * request.samples]
        folders.setdefault(folder, []).extend(made)
    return folders


def _distance(source: Any, model: MotionGenerator, motions: Sequence[Motion]) -> str:
    from flame_mdm.sampling.targets import errors, read_targets

    targets = read_targets(model.representation, source)
    distances = [100 * distance for motion in motions for distance in errors(motion, targets).tolist()]
    return f"distance from the targets: mean {mean(distances):.1f} cm, max {max(distances):.1f} cm"


def summary(folder: Path, motions: Sequence[Motion], settings: OutputSettings) -> str:
    """Returns the line that tells what was written to a folder."""
    count = "1 motion" if len(motions) == 1 else f"{len(motions)} motions"
    files = f"{folder / 'player.html'}, motions.gif" + (", motions.mp4" if settings.mp4 else "")
    return f"{count} of {len(motions[0].joints)} frames: {files}"


def _gallery(settings: SampleSettings, folders: Mapping[Path, list[Motion]], body: Mesh) -> str:
    from flame_mdm.visualize import write_player

    page = next(iter(folders)).with_name(f"{Path(str(settings.prompts)).stem}.html")
    first = [replace(made[0], id=folder.name) for folder, made in folders.items()][:GALLERY]
    write_player(page, first, f"{len(folders)} prompts", body=body)
    return f"{sum(map(len, folders.values()))} motions for {len(folders)} prompts, a folder for each: {page}"


def read_prompts(path: str) -> list[str]:
    """Returns the lines of a file of prompts that are not blank."""
    text = read_text(path, MEBIBYTE)
    prompts = [line.strip() for line in text.removeprefix("\ufeff").splitlines() if line.strip()]
    if not prompts or "\0" in text:
        raise UserError(f"{path}: no prompts. Write one per line")
    return prompts


def default_folder(model: MotionGenerator, what: str, *request: object) -> Path:
    """Returns `samples/<experiment>/<what>-<hash>`; the hash is that of `what` and of everything in `request`.

    Requests for different motions thus go to different folders, also where the file system ignores case. The folder is
    within `SAMPLES`, whatever an untrusted checkpoint calls its experiment.
    """
    digest = hashlib.sha256(repr((what, request)).encode()).hexdigest()[:6]
    name = re.sub(r"[^\w]+", "-", what.lower()).strip("-")[:40].strip("-")
    return Path(SAMPLES, *re.findall(r"[\w-][\w.-]*", str(model.config["experiment"])), f"{name}-{digest}")


def check_condition(settings: OutputSettings, request: SamplingRequest, model: MotionGenerator) -> None:
    """Warns of words that the model has never seen; raises `UserError` with examples if no condition is requested."""
    if request.kind == "text":
        from flame_mdm.conditions.vocabulary import advice

        for text in dict.fromkeys(part for parts in request.parts for part, _ in parts):
            of = "" if request.prompts == (text,) else f"'{shortened(text, 60)}': "
            for line in advice(text, model.facts, model.condition.max_words):
                say(f"warning: {of}{line}")
    elif request.kind == "none" and not settings.unconditioned:
        examples = list(model.facts["actions"] if model.conditioned_on == "action" else model.facts.get("captions", ()))
        shown = "; ".join(examples[:: max(1, len(examples) // 5)][:5])
        key = TRAINED_ON[model.conditioned_on][1]
        raise UserError(f"say what to sample: {key}" + (f". Examples: {shown}" if shown else ""))
