"""Requests for motions and edits, checked once. The checks do not import torch, so wrong input is refused at once."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from itertools import accumulate, pairwise
from numbers import Integral, Real
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from flame_mdm.errors import UserError, did_you_mean, one_line, shortened
from flame_mdm.sampler_options import SamplerOptions, option

if TYPE_CHECKING:
    from flame_mdm.formats.motion import Motion
    from flame_mdm.generator import MotionGenerator

MAX_SAMPLES = 10_000  # maximum number of samples per request; they are kept in memory until all are complete
MAX_TEXT_LENGTH = 2000  # maximum number of characters of a text; captions of the data sets are far shorter
TRAINED_ON = {
    "text": ("was trained on captions", 'text="a person walks"'),
    "action": ("was trained on action labels", "action=NAME"),
    "none": ("was trained without texts and labels", "unconditioned=true"),
}
METHODS: dict[str, dict[str, Any]] = {
    "mdm": {"mode": "x0"},
    "flame": {"mode": "x_t", "blend": "after"},
    "flame_code": {"mode": "x_t", "blend": "before"},
    "mfm": {"mode": "trajectory", "until": 0.2},
}
"""Editing methods of the papers, as options of `flame_mdm.batch.Edit`."""
REGIONS = ("in_between", "prediction", "prefix", "suffix", "interpolate")  # tasks that name the frames to resample

Part = tuple[str, float | None]  # text of a part of a sequence, and its seconds if the text gives them
Ranges = Sequence[float] | Sequence[Sequence[float]]
ARRIVAL = 0.2  # seconds before the end of a motion at which the last way point of a path is reached


@dataclass(frozen=True, kw_only=True)
class EditRequest:
    """Which part of a motion to resample, and how; raises `UserError` if a value is invalid for every motion."""

    region: str | Ranges | None = option(
        None, "frames to resample: in_between, prediction (= prefix), suffix, interpolate, or one or more [begin, end]"
    )
    region_seconds: Ranges | None = option(None, "one or more [begin, end] in seconds, instead of region")
    joints: str | Sequence[str] | None = option(None, "joints to resample: upper_body, left_arm, ... or [names]")
    method: str | None = option(
        None, "mdm and flame (keep exactly), flame_code, mfm. Default: mdm for diffusion, mfm for flow matching"
    )
    until: float | None = option(None, "for mfm: flow time up to which the path is overwritten, default 0.2")
    resample: int = option(1, "for flame and flame_code: how many times each sampling step is taken")
    strength: float | None = option(
        None, "starts from the noised motion, and takes this fraction of the steps, up to 1: the smaller, the closer"
    )

    def __post_init__(self) -> None:
        if self.region is not None and self.region_seconds is not None:
            raise UserError("give region or region_seconds, not both")
        for name, choices in (("region", REGIONS), ("method", METHODS)):
            value = getattr(self, name)
            if isinstance(value, str) and value not in choices:
                raise UserError(f"{name}={value} is unknown.{did_you_mean(value, choices)} Use {', '.join(choices)}")
        _ = self.ranges  # raises if they are invalid
        if self.joints is not None and not self.joints:
            raise UserError("joints: no joint is named. Name the joints to resample, or omit joints for all of them")
        if type(self.resample) is not int or self.resample < 1:
            raise UserError(f"resample={self.resample}: give a whole number, 1 or more")
        if self.strength is not None and not 0 < self.strength <= 1:
            raise UserError(f"strength={self.strength:g}: give a number above 0, up to 1")
        if self.method is not None:
            self.method_options(self.method)

    @property
    def ranges(self) -> list[tuple[float, float]] | None:
        """The ranges of `region`, or of `region_seconds`; None if they have none."""
        name = "region" if self.region_seconds is None else "region_seconds"
        value: Any = getattr(self, name)
        if value is None or (name == "region" and isinstance(value, str)):
            return None
        listed = [value] if is_range(value) else value
        if not isinstance(listed, list | tuple) or not listed or not all(map(is_range, listed)):
            raise UserError(f"{name}={value}: write [begin, end], or several ranges as [[begin, end], [begin, end]]")
        return [(begin, end) for begin, end in listed]

    def method_options(self, method: str) -> dict[str, Any]:
        """Returns the options of `flame_mdm.batch.Edit` for a method, which must have those of this request."""
        options = METHODS[method] | {"resample": self.resample, "strength": self.strength}
        if self.resample != 1 and options["mode"] != "x_t":
            raise UserError(f"resample={self.resample} is an option of method=flame and flame_code, not of {method}")
        if self.until is None:
            return options
        if options["mode"] != "trajectory":
            raise UserError(f"until={self.until:g} is an option of method=mfm, not of {method}")
        return options | {"until": self.until}


@dataclass(frozen=True, kw_only=True)
class SamplingRequest:
    """Motions to sample, for texts or actions; unconditioned if neither is given.

    A text or action may have several parts, "walks forward @3 | turns left | sits down @2", with their seconds. They
    are generated together as one motion, in windows that overlap; see docs/sequences.md. So is a single part with
    seconds, "walks forward @10", which may be longer than the motions in training. Raises `UserError` if a value is
    invalid for every model, or two values contradict each other.
    """

    texts: str | Sequence[str] | None = option(
        None, 'what the person does; several actions in a row: "walks forward @3 | turns around | bows @2" (seconds)'
    )
    actions: str | Sequence[str] | None = option(None, "a label, for models trained on labels")
    seconds: float | Sequence[float] | None = option(
        None, "length, or a list with one per text; of a sequence, of each part that gives none. Default: up to 3"
    )
    frames: int | Sequence[int] | None = option(None, "the same in frames, instead of seconds")
    samples: int = option(1, "motions per text or action")
    seed: int = option(0, "seed of the noise")
    after: str | Path | Motion | None = option(None, "FILE or dataset:id: a motion that the result continues")
    split: bool = option(True, 'sentences with several actions, "walks, then sits", become sequences, "walks | sits"')
    loop: bool = option(False, "the last frame leads to the first one")
    targets: str | Path | Mapping[str, Any] | None = option(None, "a JSON file of places to reach: docs/targets.md")
    shared_noise: bool = option(False, "the same noise for all motions: they differ by texts and lengths alone")
    cleanup: bool = option(False, "smooth motions, constant bone lengths, feet that do not slide")
    options: SamplerOptions = field(default_factory=SamplerOptions)
    editing: EditRequest | None = None

    @classmethod
    def of(cls, function: str, editing: bool = False, /, **keywords: Any) -> SamplingRequest:
        """Returns the request of keywords: fields of this class, `SamplerOptions` and, of edits, `EditRequest`."""
        names = {kind: {entry.name for entry in fields(kind)} for kind in (cls, SamplerOptions, EditRequest)}
        names[cls] -= {"options", "editing"}
        possible = names[cls] | names[SamplerOptions] | (names[EditRequest] if editing else set())
        for keyword in keywords:
            if keyword not in possible:
                raise UserError(f"{function} has no option {keyword}.{did_you_mean(keyword, sorted(possible))}")
        own, options, edit = ({name: keywords[name] for name in of & keywords.keys()} for of in names.values())
        return cls(**own, options=SamplerOptions(**options), editing=EditRequest(**edit) if editing else None)

    def __post_init__(self) -> None:
        for name in ("texts", "actions", "seconds", "frames"):
            value = getattr(self, name)
            value = value.tolist() if hasattr(value, "tolist") else value  # an array or a number of numpy
            if isinstance(value, str) and name in ("texts", "actions"):
                value = (value,)
            object.__setattr__(self, name, tuple(value) if isinstance(value, list | tuple) else value)
        if not isinstance(self.samples, Integral) or not 1 <= int(self.samples) <= MAX_SAMPLES:
            raise UserError(f"samples={self.samples}: give 1 to {MAX_SAMPLES:,}")
        if not isinstance(self.seed, Integral):
            raise UserError(f"seed={self.seed!r}: give a whole number")
        self._check_prompts()
        self._check_lengths()
        other = "loop" if self.loop else "targets" if self.targets is not None else None
        if self.after is not None and other is not None:
            name = self.after if isinstance(self.after, str | Path) else self.after.id
            raise UserError(f"after={name}: a motion that continues another cannot have {other}. Give one of the two")
        if (edit := self.editing) is not None:
            is_whole = edit.region is edit.region_seconds is edit.joints is None
            self.check_edit(edit.strength is not None and is_whole)
            if self.seconds is not None or self.frames is not None:
                raise UserError("an edit is as long as its motion: omit seconds and frames, or give cut=[begin, end]")

    def _check_prompts(self) -> None:
        if self.texts is not None and self.actions is not None:
            raise UserError("give texts or actions, not both")
        for prompt in self.prompts:
            if not isinstance(prompt, str):
                raise UserError(f"{self.kind}={prompt!r} is not a string. Give a string, such as {self.kind}='walk'")
            if len(prompt) > MAX_TEXT_LENGTH:
                size = f"{len(prompt):,} characters are too many. Give at most {MAX_TEXT_LENGTH:,}"
                raise UserError(f"{shortened(prompt, 60)}: {size}")
        if self.texts is not None and not all(text.strip() for text in self.prompts):
            raise UserError("empty text. Omit the text to sample without condition")
        if len(self.prompts) * self.samples > MAX_SAMPLES:
            raise UserError(f"samples={self.samples} of each text: at most {MAX_SAMPLES:,} motions per request")
        _ = self.parts  # raises if a part is invalid

    def _check_lengths(self) -> None:
        if self.seconds is not None and self.frames is not None:
            raise UserError("give seconds or frames, not both")
        name = "frames" if self.seconds is None else "seconds"
        value: Any = getattr(self, name)
        if value is None:
            return
        shown, count = f"{name}={list(value) if isinstance(value, tuple) else value}", len(self.prompts)
        if isinstance(value, tuple) and len(value) != count:
            raise UserError(f"{shown}: lengths: {len(value)}, prompts: {count}. Give one length, or one per prompt")
        for length in value if isinstance(value, tuple) else (value,):
            if not issubclass(type(length), Real) or not abs(length) < 1e9 or (name == "frames" and length % 1):
                raise UserError(f"{shown} is not a valid length")

    def check_edit(self, varies: bool) -> None:
        """Raises `UserError` if a request to edit a motion, or to vary all of it, asks for more than that."""
        if self.after is not None or (not varies and (self.is_sequence or self.targets is not None)):
            advice = "Variations of an entire motion (strength=0.5) may have parts, loop and targets"
            raise UserError(f"an edit keeps a single motion: omit parts (|), after, loop and targets. {advice}")

    @property
    def kind(self) -> Literal["text", "action", "none"]:
        """The condition of the motions."""
        return "text" if self.texts is not None else "action" if self.actions is not None else "none"

    @property
    def prompts(self) -> tuple[str, ...]:
        """The texts or actions; a single empty text if there are none."""
        return tuple(self.texts or self.actions or ("",))

    @cached_property
    def parts(self) -> list[list[Part]]:
        """The parts of each prompt; see `read_parts`."""
        return [[(prompt, None)] if self.kind == "none" else read_parts(prompt) for prompt in self.prompts]

    @property
    def is_sequence(self) -> bool:
        """Whether motions are generated in windows: prompts have parts or seconds, or they loop or continue one."""
        timed = any(len(parts) > 1 or parts[0][1] is not None for parts in self.parts)
        return self.loop or self.after is not None or timed

    def lengths(self, fps: float) -> list[float | None]:
        """Returns the length of each prompt in frames, not rounded; None where the request gives none."""
        value: Any = self.frames if self.seconds is None else self.seconds
        lengths = value if isinstance(value, tuple) else [value] * len(self.prompts)
        return [None if length is None else length * (1.0 if self.seconds is None else fps) for length in lengths]


def understood(request: SamplingRequest, model: MotionGenerator) -> SamplingRequest:
    """Returns the request with its sentences of several actions as sequences, if `split` says so and the model can.

    Raises `UserError` if the model knows no word of a text that says what happens.
    """
    if request.kind != "text" or model.conditioned_on != "text":
        return request
    from flame_mdm.conditions.vocabulary import check_known, in_parts  # its package imports torch

    if request.split and request.editing is None and model.representation.relative:
        verbs = model.facts.get("verbs", ())
        texts = [t if "|" in t or "@" in t else " | ".join(in_parts(t, verbs)) for t in request.prompts]
        request = replace(request, texts=texts)
    for text in dict.fromkeys(name for parts in request.parts for name, _ in parts):
        check_known(text, model.facts)
    return request


def check_model(request: SamplingRequest, model: MotionGenerator) -> None:
    """Checks that a model can do what is requested; the planning of a sampling run also checks the lengths."""
    model.process.find_sampler(request.options.over(model.sampler_options))
    if request.kind not in ("none", model.conditioned_on):
        trained, instead = TRAINED_ON[model.conditioned_on]
        raise UserError(f"{request.kind}={shortened(request.prompts[0], 60)}: this model {trained}. Give {instead}")
    if request.is_sequence and not model.representation.relative:
        what = "has positions in the world, so that windows of a sequence do not fit together"
        raise UserError(f"representation {model.representation.name} {what}. Use a model of humanml3d features")
    for name in [name for parts in request.parts for name, _ in parts] if request.kind == "action" else ():
        if name not in (actions := model.facts["actions"]):
            raise UserError(f"unknown action '{name}'; this model knows: {', '.join(actions) or 'none'}")


def read_parts(text: str) -> list[Part]:
    """Splits "walks @3 | sits down" into parts, [("walks", 3.0), ("sits down", None)], or raises `UserError`."""
    parts: list[Part] = []
    for part in text.split("|"):
        words, at, number = part.rpartition("@") if "@" in part else (part, "", "")
        try:
            seconds = float(number.strip().removesuffix("s")) if at else None
        except ValueError:
            seconds = math.nan
        if seconds is not None and not 0 < seconds < math.inf:
            raise UserError(f"'{part.strip()}': the seconds of a part are a number above 0, as in 'walks forward @3'")
        if not words.strip():
            raise UserError(f"'{text}': part {len(parts) + 1} is empty. Say what happens in each: 'walks | sits'")
        parts.append((words.strip(), seconds))
    return parts


def is_range(value: Any) -> bool:
    """Returns whether the value is a pair of finite numbers."""
    pair = isinstance(value, list | tuple) and len(value) == 2
    return pair and all(isinstance(v, int | float) and math.isfinite(v) for v in value)


def read_path(text: str) -> list[tuple[float, float]]:
    """Returns the way points of "x,z x,z ...", in meters; raises `UserError` if the text is not of this form."""
    try:
        points = [(float(x), float(z)) for x, z in (point.split(",") for point in text.split())]
    except ValueError:
        points = []
    if not points:
        shown = shortened(one_line(text[:500]), 60)
        raise UserError(f"path={shown}: give way points as x,z in meters, such as 0,1 0.5,2")
    return points


def path_targets(path: Sequence[tuple[float, float]], seconds: float) -> dict[str, Any]:
    """Returns targets that lead a motion of `seconds` along a path from x = z = 0, at an even speed."""
    way = list(accumulate(math.dist(*pair) for pair in pairwise([(0.0, 0.0), *path])))
    times = [round((seconds - ARRIVAL) * done / (way[-1] or 1.0), 3) for done in way]
    return {"root": [{"time": time, "position": list(at)} for time, at in zip(times, path, strict=True)]}
