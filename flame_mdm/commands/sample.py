"""`flame-mdm sample CKPT text="a person walks" seconds=3`: samples motions from a checkpoint."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from statistics import mean
from typing import TYPE_CHECKING, Any, ClassVar

from flame_mdm.commands import OutputSettings, WritingSettings, model_source, motion_file
from flame_mdm.config.options import option, same_option
from flame_mdm.errors import UserError, say, shortened
from flame_mdm.formats import WRITTEN
from flame_mdm.safe_io.paths import check_within
from flame_mdm.sampler_options import SamplerOptions
from flame_mdm.sampling.motion_request import SamplingRequest
from flame_mdm.sampling.prompt_file import PromptFile

if TYPE_CHECKING:
    from flame_mdm.formats.characters import BvhCharacter, Character
    from flame_mdm.formats.motion import Motion
    from flame_mdm.generator import MotionGenerator
    from flame_mdm.sampling.generation import Score
    from flame_mdm.sampling.motion_sets import MotionSet
    from flame_mdm.sampling.resolution import ResolvedRequest
    from flame_mdm.sampling.targets import Targets
    from flame_mdm.visualize.body import Mesh

# Maximum number of motions on the page for a prompt file. Each motion takes about 20 kB.
GALLERY = 200
CLAIMS = "claims"  # scorer that checks the claims in the text; see docs/referee.md


def scorer_source(key: str, source: str) -> None:
    """Checks that the scorer is `CLAIMS` or an existing model."""
    if source != CLAIMS:
        model_source(key, source)


@dataclass(frozen=True, kw_only=True)
class SampleSettings(OutputSettings, WritingSettings):
    """usage: flame-mdm sample CKPT text="a person walks in a circle clockwise" [seconds=3] [key=value ...]
           flame-mdm sample CKPT walk.fbx text="a person walks forward" [rig=unreal] [resample=30]
           flame-mdm sample CKPT text="walks forward @3 | turns around | bows @2.5" [after=walk.npz] [loop=true]
           flame-mdm sample CKPT text="walks forward" path="0,1 0.5,2" | targets=FILE.json
           flame-mdm sample CKPT text="jumps" candidates=8 [scorer=claims|RUN]
           flame-mdm sample CKPT prompts=FILE.txt [seconds=[2,3.5,...]] [mp4=true]
           flame-mdm sample CKPT set=locomotion OUT [rig=unity] [format=glb]
           flame-mdm sample CKPT action=walk
           flame-mdm sample CKPT unconditioned=true

    Writes motions (.npz), a GIF, and a player that opens in any browser. A prompt file contains one
    prompt per line. Each prompt gets its own folder, and one page shows the first motion of each
    prompt. Prompts that cannot be sampled are listed at the end, and the exit code is then 1. A set
    is a folder of matching clips for game engines: loops, starts, stops and turns. If OUT is a file
    (.fbx, .glb, .bvh, .usdz, .vrma, .npz, .json, .npy, .mp4 or .gif), only this file is written.
    """

    OBJECTS: ClassVar = ("ckpt", "out")
    prompts: str | None = option(
        None, "file with one prompt per line, used instead of text. Each prompt gets its own folder"
    )
    seconds: float | Sequence[float] | None = same_option(SamplingRequest, "seconds")
    frames: int | Sequence[int] | None = same_option(SamplingRequest, "frames")
    after: str | None = same_option(SamplingRequest, "after", motion_file)
    split: bool = same_option(SamplingRequest, "split")
    loop: bool = same_option(SamplingRequest, "loop")
    path: str | None = same_option(SamplingRequest, "path")
    candidates: int = same_option(SamplingRequest, "candidates")
    set: str | None = option(
        None,
        "set of clips to sample instead of a text: locomotion, or a .yaml file; see "
        "docs/sampling.md#sets-for-game-engines",
    )
    format: str | None = option(None, "format of a set's files: fbx, glb, usda, usdc or usdz")
    scorer: str | None = option(
        None,
        "how to choose the candidate that fits the text best: claims (most true "
        "and fewest false claims, see docs/referee.md), or a motion-CLIP (run or file)",
        scorer_source,
    )
    shared_noise: bool = same_option(SamplingRequest, "shared_noise")
    samples: int | None = option(
        None, "motions per text or action; default: 3, or 1 if OUT is a file"
    )
    out: str | None = option(
        None, "a folder or a motion file; default: the folder samples/<experiment>/<text>-<hash>"
    )

    @property
    def file(self) -> Path | None:
        """The motion file to write, or None if a folder is written."""
        path = Path(self.out or "")
        return path if path.suffix.lower() in WRITTEN and not path.is_dir() else None

    def check_output(self) -> None:
        """Raises `UserError` if a key does not apply to the requested kind of output."""
        if self.set is not None:
            of_sets = {
                "out",
                "set",
                "format",
                "rig",
                "resample",
                "seed",
                "body",
                "device",
                "ckpt",
                "which",
            }
            of_sets |= {
                "adapter",
                "adapter_strength",
                *(entry.name for entry in fields(SamplerOptions)),
            }
            for entry in fields(self):
                value = getattr(self, entry.name)
                if entry.name not in of_sets and value != entry.default:
                    shown = f"{entry.name}={shortened(str(value), 60)}"
                    raise UserError(
                        f"{shown}: a set determines which motions are sampled, and how they are "
                        f"cut. Omit {entry.name}"
                    )
            if self.file is not None:
                raise UserError(f"out={self.out}: a set consists of several files. Use a folder")
            return
        if self.format is not None:
            raise UserError(
                f"format={self.format} applies only to sets. For a single file, the extension of OUT "
                f"determines the format. Remove format="
            )
        if self.file is None:
            for key in ("rig", "root_motion", "resample", "character"):
                if value := getattr(self, key):
                    advice = "Set an output file, such as out=walk.fbx"
                    raise UserError(
                        f"{key}={str(value).lower()} applies only to a single file, not to a folder. "
                        f"{advice}"
                    )
            return
        for key in ("prompts", "mp4", "trajectory"):
            if value := getattr(self, key):
                advice = "Use a folder, or omit out"
                raise UserError(
                    f"{key}={str(value).lower()}: {self.out} is a single motion file. {advice}"
                )

    def set_content(self, source: str) -> MotionSet:
        """Returns the description of a set, adapted to `rig`, `format` and `resample`."""
        from flame_mdm.sampling.motion_sets import changed, read_set

        keys = {"rig": self.rig, "format": self.format, "fps": self.resample}
        return changed(
            read_set(source), **{key: value for key, value in keys.items() if value is not None}
        )

    def conditions(self) -> list[str]:
        """Returns the keys that determine the motions, including `prompts` and `set`."""
        sources = [key for key in ("prompts", "set") if getattr(self, key) is not None]
        return [*super().conditions(), *sources]

    def request_for(self, prompts: PromptFile | None) -> SamplingRequest:
        """Returns the sampling request, with the accepted prompts of a prompt file, if any."""
        default = 3 if self.file is None else 1
        samples = default if self.samples is None else self.samples
        if prompts is None:
            request = self.request(samples=samples)
        else:
            if self.path is not None:
                raise UserError(
                    f"path={self.path}: a path cannot be combined with a prompt file. Use "
                    "text and seconds instead"
                )
            request = self.request(
                samples=samples,
                texts=list(prompts.accepted.values()),
                seconds=prompts.lengths("seconds", self.seconds),
                frames=prompts.lengths("frames", self.frames),
            )
        if self.scorer is not None and (request.kind != "text" or self.candidates == 1):
            raise UserError(
                f"scorer={self.scorer} chooses among several motions for a text. Add text=... and "
                f"candidates=8"
            )
        return request


def main(settings: SampleSettings) -> None:
    """Samples motions for texts, a prompt file or a set, and writes them."""
    settings.check_output()
    if settings.set is not None:
        _sample_set(settings, settings.set)
        return
    prompts = None if settings.prompts is None else PromptFile.read(settings.prompts)
    if prompts is None or prompts.accepted:
        _sample(settings, settings.request_for(prompts), prompts)
    if prompts is not None and prompts.refused:
        say(*prompts.report(), error=True)
        count = f"{len(prompts.refused)} of {len(prompts.lines)} prompts"
        raise UserError(f"{prompts.path}: {count} cannot be sampled. Correct the lines above")


def _sample(settings: SampleSettings, request: SamplingRequest, prompts: PromptFile | None) -> None:
    """Samples the motions for a request and writes them.

    Prompts in a prompt file that the model cannot sample are refused.
    """
    loaded = settings.load()  # a missing file is reported before PyTorch is imported
    character = settings.read_character()
    from flame_mdm.sampling.generation import sample
    from flame_mdm.sampling.output import SAMPLES, degenerate_notes, summary, write_motions
    from flame_mdm.sampling.referee.sentences import read_claims
    from flame_mdm.sampling.resolution import resolve

    model = loaded.model
    refused: dict[int, UserError] | None = None if prompts is None else {}
    resolved = resolve(request, model, refused)
    if prompts is not None and refused:
        prompts.refuse(refused)
        if not resolved.prompts:
            return
    for prompt in resolved.prompts:
        if prompt.is_split:
            say(f"sampled as a sequence: {prompt.text}. Add split=false to sample it as one action")
        if prompts is None and prompt.summary:
            say(f"understood: {prompt.summary}")
    say(*(f"warning: {line}" for line in resolved.warnings))

    score = None if settings.scorer is None else _score(settings.scorer, model)
    if settings.scorer == CLAIMS:
        for prompt in resolved.prompts:
            if not read_claims(prompt.text):
                say(
                    f"warning: '{shortened(prompt.text, 60)}' contains no claim that can be checked"
                )
    stages = [] if settings.trajectory else None
    motions = sample(model, resolved, score=score, stages=stages)
    say(*degenerate_notes(motions))
    facts = {"seed": settings.seed, "checkpoint": loaded.model.sha256}
    if settings.file is not None:
        _write_files(settings, settings.file, motions, character, loaded.body, facts)
        if resolved.targets is not None:
            say(_distance(resolved.targets, motions))
        return

    folders = _folders(settings, resolved, model, motions)
    for folder, written in folders.items():
        write_motions(
            folder,
            written,
            facts,
            stages if written[0] is motions[0] else None,
            settings.mp4,
            loaded.body,
            within=settings.out or SAMPLES,
        )
        if prompts is None:
            say(summary(folder, written, mp4=settings.mp4))
        if resolved.targets is not None:
            say(_distance(resolved.targets, written))
    if prompts is not None:
        say(_gallery(prompts, folders, loaded.body))


def _sample_set(settings: SampleSettings, source: str) -> None:
    """Samples a set of clips and writes it."""
    content = settings.set_content(source)
    texts = [motion.text for motion in content.motions.values()]
    _ = settings.request(texts=texts, samples=1)  # raises errors before the model is loaded
    loaded = settings.load()
    from flame_mdm.sampling.motion_sets import make_set, write_set
    from flame_mdm.sampling.output import SAMPLES, default_folder

    options = {entry.name: getattr(settings, entry.name) for entry in fields(SamplerOptions)}
    clips = make_set(loaded.model, content, settings.seed, **options)
    say(*(f"omitted: {name}: {reason}" for name, reason in clips.left_out.items()))
    if settings.out is None:
        general = (
            content.model_dump(),
            options,
            settings.seed,
            settings.adapter,
            settings.adapter_strength,
        )
        folder = default_folder(loaded.model, Path(source).stem, loaded.model.sha256, *general)
    else:
        folder = Path(settings.out)
    check_within(folder, settings.out or SAMPLES)
    facts = {"set": Path(source).stem, "seed": settings.seed, "checkpoint": loaded.model.sha256}
    write_set(folder, clips, content, facts, loaded.body)
    say(
        f"{len(clips.clips)} clips, each in two versions (with root motion and in place): "
        f"{folder / 'player.html'}, set.png, set.json"
    )


def _write_files(
    settings: SampleSettings,
    file: Path,
    motions: Sequence[Motion],
    character: Character | BvhCharacter | None,
    body: Mesh | None,
    facts: dict[str, Any],
) -> None:
    """Writes the first motion to `file` and the others to numbered files, such as walk_2.fbx."""
    for number, motion in enumerate(motions, 1):
        path = file if number == 1 else file.with_stem(f"{file.stem}_{number}")
        written = settings.at_rate(motion)
        say(written.save(path, False, settings.rig, character, body, settings.root_motion, **facts))


def _score(source: str, model: MotionGenerator) -> Score:
    """Returns the function that scores candidates, based on claims or a motion-CLIP.

    Raises `UserError` if the scorer cannot read the model's motions.
    """
    if source == CLAIMS:
        return claims_score(model)
    from evaluators.extractors import MotionCLIPExtractor

    try:
        scorer = MotionCLIPExtractor(source, model.device)
        scorer.check(model.representation, model.facts.get("dataset", ""))
    except (UserError, FileNotFoundError) as error:
        raise UserError(f"scorer: {error}") from error
    return scorer.fit


def claims_score(model: MotionGenerator) -> Score:
    """Returns the function that scores candidates by the claims in their texts.

    Raises `UserError` if the motions have a skeleton that the referee does not support.
    """
    from flame_mdm.representations.skeleton import SMPL22
    from flame_mdm.sampling.referee.judging import claim_score

    skeleton = model.representation.skeleton
    if skeleton != SMPL22:
        raise UserError(
            f"scorer={CLAIMS}: this model's skeleton is {skeleton.name}, but the referee requires "
            f"{SMPL22.name}. Set scorer to a motion-CLIP checkpoint"
        )
    return claim_score


def _folders(
    settings: SampleSettings,
    resolved: ResolvedRequest,
    model: MotionGenerator,
    motions: Sequence[Motion],
) -> dict[Path, list[Motion]]:
    """Returns the folders to write, each with its motions.

    A prompt that is listed twice gets a single folder.
    """
    from flame_mdm.sampling.output import default_folder

    request = resolved.request
    shared = replace(request, texts=None, actions=None, seconds=None, frames=None, samples=1)
    general = (
        model.sha256,
        request.kind,
        shared,
        settings.scorer,
        settings.adapter,
        settings.adapter_strength,
    )
    folders: dict[Path, list[Motion]] = {}
    for number, prompt in enumerate(resolved.prompts):
        folder = default_folder(model, prompt.text or "unconditioned", prompt.frames, *general)
        if settings.out:
            folder = Path(settings.out, folder.name if settings.prompts is not None else "")
        first = number * request.samples
        folders.setdefault(folder, []).extend(motions[first : first + request.samples])
    return folders


def _distance(targets: Targets, motions: Sequence[Motion]) -> str:
    from flame_mdm.sampling.targets import errors

    distances = [
        100 * distance for motion in motions for distance in errors(motion, targets).tolist()
    ]
    return f"distance from the targets: mean {mean(distances):.1f} cm, max {max(distances):.1f} cm"


def _gallery(prompts: PromptFile, folders: Mapping[Path, list[Motion]], body: Mesh | None) -> str:
    """Writes a page with the first motion of each prompt, and returns a message with its path."""
    from flame_mdm.visualize import write_player

    page = next(iter(folders)).with_name(f"{Path(prompts.path).stem}.html")
    first = [replace(motions[0], id=folder.name) for folder, motions in folders.items()][:GALLERY]
    write_player(page, first, f"{len(folders)} prompts", body=body)
    return f"{sum(map(len, folders.values()))} motions for {len(folders)} prompts, one folder per prompt: {page}"
