# pyright: standard
"""Evaluation protocols: which motions are generated, how often, and which metrics are computed."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import ConfigDict, Field

from evaluators.extractors import Extractor
from evaluators.metrics import make_metrics
from evaluators.metrics.attributes import ATTRIBUTES, UNREAD
from evaluators.metrics.samples import SampleMetric
from flame_mdm.config import EXPERIMENTS, Config, check, instantiate, plain
from flame_mdm.data.datamodule import Clips
from flame_mdm.data.store import Entry
from flame_mdm.errors import UserError, did_you_mean
from flame_mdm.generator import MotionGenerator
from flame_mdm.representations import Representation
from flame_mdm.safe_io import read_package_yaml, read_yaml
from flame_mdm.schemas import ClosedSchema, Int, Number, check_shape
from flame_mdm.seeds import key

FOLDER = EXPERIMENTS / "evaluation"
QUICK_REPLICATIONS, QUICK_SAMPLES = 2, 64
CONTEXT_STARTS = 5  # in DiP's code, the context begins at one of the first five frames of a clip
Count = Annotated[Int, Field(ge=1)]


@dataclass(frozen=True)
class DrawnClip:
    """A clip, with the frames and the caption that were drawn from it for one generated motion."""

    #: Unique name of the motion.
    id: str
    #: The real clip with which the motion is compared.
    clip: Entry
    #: Indices of the frames drawn from the clip.
    frames: np.ndarray
    #: Index of the caption drawn from the clip, or None if the clip has no captions.
    caption: int | None
    #: Name shared by all motions with the same caption and length.
    prompt: str
    #: Indices of the frames that the model receives as context. They are not measured.
    context: np.ndarray = field(default_factory=lambda: np.zeros(0, int))

    @property
    def text(self) -> str:
        """The drawn caption."""
        assert self.caption is not None
        return self.clip.captions[self.caption]

    @property
    def requested(self) -> dict[str, Any]:
        """The attributes of the clip that are listed in `ATTRIBUTES` or `UNREAD`."""
        return {
            name: value
            for name, value in self.clip.attributes.items()
            if name in (*ATTRIBUTES, *UNREAD)
        }

    def tokens(self, caption: str) -> list[str] | None:
        """Returns the "word/PART" tokens of one of the clip's captions, or None without tokens."""
        tagged = self.clip.attributes.get("tokens")
        return (
            tagged[self.clip.captions.index(caption)]
            if tagged and caption in self.clip.captions
            else None
        )


class Multimodality(ClosedSchema):
    """Settings of a second evaluation, with several motions per prompt."""

    #: Number of prompts, or None for all prompts of the split.
    prompts: Int | None
    #: Motions per prompt.
    samples: Int
    #: Number of replications.
    replications: Int
    #: Mappings with the `_target_` of a metric, by name.
    metrics: dict[str, Config]


class Protocol(ClosedSchema):
    """A named and versioned evaluation procedure, described by a file in experiments/evaluation.

    The caption and the crop that are drawn from a clip, as well as the noise for the generated
    motion, depend only on (seed, replication, id). Generated motions are as long as the real clips.
    Real motions are measured in the same way and compared with a second draw of real motions.
    """

    model_config = ConfigDict(strict=True, frozen=True)

    #: Name of the file and, for variants, the name of the variant.
    name: str
    #: Number that is increased with each change to the protocol. Values measured with different
    #: versions are not comparable.
    version: Int
    #: Condition of the generated motions.
    condition: Literal["text", "action", "none"]
    #: Mapping with the `_target_` of an `Extractor` and its `path`, which is left out if the user
    #: must provide it.
    extractor: Config | None
    #: Mappings with the `_target_` of a metric, by name.
    metrics: dict[str, Config]
    #: Number of replications.
    replications: Count
    #: Motions per replication, from randomly drawn clips, or None to use each clip once.
    samples: Count | None = None
    #: Real motions in comparisons of sets, from randomly drawn clips, or None to use each clip
    #: once.
    real_samples: Count | None = None
    #: A second evaluation with several motions per prompt.
    multimodality: Multimodality | None = None
    #: Arguments `region` and `joints` of `kept_parts`. If not None, the generated motions are edits
    #: of real motions.
    edit: dict[str, Any] | None = None
    #: Standard deviation, in frames, of the Gaussian filter that smooths generated features over
    #: time.
    smoothing: Number | None = None
    #: Motions per batch, if the protocol measures time. The first batch is not timed.
    batch_size: Count | None = None
    #: Context frames for models that continue motions. "drawn": the first of the drawn frames,
    #: which are then not measured. "start", as in DiP's code: frames that begin at one of the first
    #: five frames of the clip; the motion that follows them is as long as the drawn frames.
    context: Literal["drawn", "start"] = "drawn"
    #: Number of context frames that the model receives, set by `open_protocol`.
    context_frames: Int = 0
    #: Attributes that evaluated clips must have. {} = all clips of the split.
    only: dict[str, Any] = Field({})
    #: Expected values of real test motions, by data set or sha256 of the extractor:
    #: a mapping from metrics to [value, tolerance]. If the measured values differ, nothing is
    #: generated.
    expected: dict[str, dict[str, Annotated[list[Number], Field(min_length=2, max_length=2)]]] = (
        Field({})
    )
    #: Whether this is a quick evaluation, set by `resized`.
    quick: bool = False
    #: Whether the number of motions differs from the number in the file, set by `resized`.
    resized_samples: bool = False
    #: Hash of the contents of the file, set by `load_protocol`.
    sha256: str = ""

    def resized(
        self,
        clips: int,
        *,
        replications: int | None = None,
        samples: int | None = None,
        batch_size: int | None = None,
        quick: bool = False,
        multimodality: bool = True,
    ) -> tuple[Protocol, dict[str, Any]]:
        """Returns the protocol with the requested numbers of motions, and the options that changed.

        `clips` is the number of clips in the split. A quick evaluation uses few motions and
        replications. `batch_size` affects only protocols that measure time.
        """
        defaults = (
            {"replications": QUICK_REPLICATIONS, "samples": min(QUICK_SAMPLES, clips)}
            if quick
            else {}
        )
        changed: dict[str, Any] = {}
        for name, number in {
            "replications": replications,
            "samples": samples,
            "batch_size": batch_size,
        }.items():
            value = defaults.get(name) if number is None else number
            if value is not None and value < 1:
                raise UserError(f"{name}={value}: must be at least 1")
            if value not in (None, getattr(self, name)) and (
                name != "batch_size" or self.batch_size
            ):
                changed[name] = value
        several = self.multimodality
        if several and "replications" in changed:
            several = several.model_copy(
                update={"replications": min(changed["replications"], several.replications)}
            )
        if several and not multimodality:
            several, changed["multimodality"] = None, False
        sizes = {"quick": quick, "multimodality": several, "resized_samples": "samples" in changed}
        return self.model_copy(update=changed | sizes), changed

    def open_extractor(
        self, path: str | None, representation: Representation, dataset: str
    ) -> Extractor | None:
        """Opens the extractor at `path`. If `path` is None, the protocol's extractor is opened.

        Returns None if the protocol needs no extractor, or if `path` is "none". Raises `UserError`
        or `FileNotFoundError` if the extractor is missing, or if it does not match the
        representation or the data set.
        """
        if self.extractor is None or path == "none":
            return None
        path = path or self.extractor.get("path")
        if path is None:
            raise UserError(
                f"protocol {self.name} needs a feature extractor. Add extractor=FILE, or extractor=none to skip the "
                "metrics that need features"
            )
        extractor: Extractor = instantiate(
            self.extractor, path=path, device=representation.mean.device
        )
        extractor.check(representation, dataset)
        return extractor

    @property
    def cuts_motions(self) -> bool:
        """Whether the model's context frames are cut off before motions are measured."""
        return self.context_frames > 0 and self.context == "drawn"

    @property
    def title(self) -> str:
        """The name and the version, such as "text_to_motion-1"."""
        return f"{self.name}-{self.version}"

    def selected(self, clips: Clips) -> list[Entry]:
        """Returns the clips that have the attributes in `only` and are longer than the context."""
        shortest = self.context_frames + (CONTEXT_STARTS if self.context == "start" else 1)
        chosen = [clip for clip in clips.clips if self.only.items() <= clip.attributes.items()]
        return [clip for clip in chosen if not self.context_frames or clip.length >= shortest]

    def rows(
        self, clips: Clips, seed: int, replication: int, *, purpose: str = "generated"
    ) -> list[DrawnClip]:
        """Returns the motions of one replication.

        Clips, captions and crops are drawn separately for each `purpose`. Raises `UserError` if the
        split contains no suitable clip.
        """
        drawn = () if purpose == "generated" else (purpose,)
        entries = sorted(
            self.selected(clips), key=lambda clip: key("sample", *drawn, seed, replication, clip.id)
        )
        if not entries:
            only = "".join(f" and {name}={value}" for name, value in self.only.items())
            reason = f"the split has no clip with at least {clips.crop.min_frames} frames{only}"
            raise UserError(f"{reason}. Choose another split with split=NAME.{clips.advice}")
        count = self.samples if purpose == "generated" else self.real_samples
        rows = []
        for number in range(len(entries) if count is None else count):
            clip = entries[number % len(entries)]
            again = number // len(entries)
            name = f"{clip.id}#{again}" if again else clip.id
            generator = np.random.default_rng(key("crop", purpose, seed, replication, name))
            caption = (
                key("caption", purpose, seed, replication, name) % len(clip.captions)
                if clip.captions
                else None
            )
            frames = clips.crop(clip.length, generator)
            context = frames[: self.context_frames]
            if self.context_frames and self.context == "start":
                context = np.arange(self.context_frames) + generator.integers(CONTEXT_STARTS)
            elif self.context_frames:
                frames = frames[self.context_frames :]
                if not len(frames):
                    length = (
                        f"{clip.id}: {len(context)} frames, all of which the model needs as context"
                    )
                    raise UserError(f"{length}. Use longer crops, such as data.crop.max_frames=196")
            rows.append(DrawnClip(name, clip, frames, caption, name, context))
        return rows

    def prompts(self, clips: Clips, seed: int, replication: int) -> list[DrawnClip]:
        """Returns the motions for one replication of the multimodality evaluation.

        Several motions are generated for each of the first `Multimodality.prompts` prompts.
        """
        assert self.multimodality is not None
        prompts = self.rows(clips, seed, replication)[: self.multimodality.prompts]
        numbers = range(self.multimodality.samples)
        return [
            replace(row, id=f"{row.id}~{number}", prompt=row.id)
            for row in prompts
            for number in numbers
        ]

    def count(self, clips: Clips) -> int:
        """Returns the number of motions that a model generates in an entire evaluation."""
        rows = self.samples or len(self.selected(clips))
        several = None if self.quick else self.multimodality
        again = (
            several.replications * several.samples * min(several.prompts or rows, rows)
            if several
            else 0
        )
        return self.replications * rows + again

    def check(self, clips: Clips, model: MotionGenerator | None) -> None:
        """Checks that the clips and the model match the protocol.

        Raises `UserError` if there are no clips, if a caption or label is missing, or if the model
        uses a different condition.
        """
        rows, condition, fault = self.rows(clips, 0, 0), self.condition, ""
        drawn = {
            "text": [row.caption for row in rows],
            "action": [row.clip.action for row in rows],
            "none": [],
        }
        if None in drawn[condition]:
            fault = f"the data set {clips.store.info['dataset']} has clips without {condition}"
        elif model is not None and condition not in ("none", model.conditioned_on):
            fault = f"the checkpoint was trained with condition {model.conditioned_on}"
        if fault:
            raise UserError(
                f"protocol {self.name} generates motions from {condition}, but {fault}. Choose another protocol"
            )


def protocol_names(folder: Path = FOLDER) -> list[str]:
    """Returns the sorted names of the protocols in a folder, including variants."""
    return sorted(name for path in folder.glob("*.yaml") for name in _protocols(path))


def protocol_config(name: str) -> Config:
    """Returns the options of a protocol, given a name in experiments/evaluation or a .yaml file.

    A file may contain `variants`, whose options override the options of the file. For example, the
    protocol `editing_in_between` is the variant `in_between` in editing.yaml. Raises `UserError` if
    there is no such protocol.
    """
    path = Path(name) if name.endswith((".yaml", ".yml")) else FOLDER / f"{name}.yaml"
    for file in [path] if path.is_file() else sorted(path.parent.glob("*.yaml")):
        protocols = _protocols(file) if path.stem.startswith(file.stem) else {}
        if path.stem in protocols:
            return {"name": path.stem, **protocols[path.stem]}
        if file == path:
            raise UserError(f"protocol {name} has variants. Choose one of {', '.join(protocols)}")
    names = protocol_names(path.parent)
    raise UserError(
        f"unknown protocol '{name}'.{did_you_mean(path.stem, names)} Available: {', '.join(names) or 'none'}"
    )


def _protocols(path: Path) -> dict[str, Config]:
    """Returns the protocols in a file, keyed by name: its variants and, if it has metrics, the file itself."""
    content = (read_package_yaml if path.parent == FOLDER else read_yaml)(path)
    variants = content.pop("variants", {}) if isinstance(content, dict) else None
    if not isinstance(variants, dict) or not all(
        isinstance(variant, dict) for variant in variants.values()
    ):
        raise UserError(
            f"{path}: not a protocol. A protocol has keys such as condition and metrics, and its variants "
            f"are mappings"
        )
    protocols = {f"{path.stem}_{name}": content | variant for name, variant in variants.items()}
    return {path.stem: content} | protocols if "metrics" in content else protocols


def load_protocol(name: str, representation: Representation) -> Protocol:
    """Loads a protocol (see `protocol_config`) for motions of a representation.

    The file may use the placeholders ${representation.fps}, ${representation.feet},
    ${representation.toes} and ${representation.parents}.
    """
    skeleton = representation.skeleton
    feet, parents = list(skeleton.feet), list(skeleton.parents)
    facts = {"fps": representation.fps, "feet": feet, "toes": feet[1::2], "parents": parents}
    placeholders = {f"${{representation.{fact}}}": value for fact, value in facts.items()}

    def filled(node: Any) -> Any:
        if isinstance(node, dict):
            return {name: filled(value) for name, value in node.items()}
        return (
            [filled(value) for value in node]
            if isinstance(node, list)
            else placeholders.get(str(node), node)
        )

    config = filled(protocol_config(name))
    plain(config, f"protocol {name}")
    try:
        protocol = check_shape(config | {"sha256": digest(config | {"name": ""})}, Protocol)
    except ValueError as error:
        raise UserError(f"protocol {name}: {error}") from error
    check(config)
    several = protocol.multimodality
    make_metrics(several.metrics if several else {})  # raises if a metric cannot be created
    values = _value_names(make_metrics(protocol.metrics))
    for bounds in protocol.expected.values():
        for metric in bounds:
            if metric not in values:
                raise UserError(
                    f"protocol {name}: expected: unknown value {metric}.{did_you_mean(metric, values)}"
                )
    return protocol


def _value_names(metrics: Mapping[str, SampleMetric]) -> list[str]:
    """Returns the names of all values that the metrics compute: `metric` or `metric/part`."""
    parts = [(name, part) for name, metric in metrics.items() for part in metric.names or [""]]
    return [f"{name}/{part}" if part else name for name, part in parts]


def digest(values: Any) -> str:
    """Returns the SHA-256 hash of JSON values."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def open_protocol(
    name: str,
    clips: Clips,
    representation: Representation,
    model: MotionGenerator | None,
    **size: Any,
) -> tuple[Protocol, dict[str, Any]]:
    """Opens a protocol and checks that it fits a split and a model.

    Returns the protocol, and the options that `Protocol.resized` changed.
    """
    protocol = load_protocol(name, representation)
    if model is not None:
        protocol = protocol.model_copy(update={"context_frames": model.denoiser.context_frames})
    protocol, changed = protocol.resized(len(protocol.selected(clips)), **size)
    protocol.check(clips, model)
    if protocol.cuts_motions:
        changed["context_frames"] = protocol.context_frames
    return protocol, changed


def default_protocol(model: MotionGenerator) -> str:
    """Returns the name of the default protocol for a model's condition and data set."""
    condition, dataset = model.conditioned_on, model.facts.get("dataset", "")
    if condition == "none":
        return "unconditioned"
    if condition == "action":
        released = {"humanact12": "action_to_motion", "uestc": "action_to_motion_uestc"}
        return released.get(dataset, "action_to_motion_own")
    return "synthetic" if dataset == "synthetic" else "text_to_motion"
