# pyright: standard
"""Requests for motions and edits.

Requests are checked without torch, so that invalid input is rejected quickly.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from itertools import accumulate, pairwise
from numbers import Integral, Real
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from flame_mdm.config.options import option
from flame_mdm.errors import UserError, did_you_mean, one_line, shortened
from flame_mdm.sampler_options import SamplerOptions

if TYPE_CHECKING:
    from flame_mdm.formats.motion import Motion

# Maximum number of samples per request. All samples are kept in memory until the last one has been
# generated.
MAX_SAMPLES = 10_000
# Maximum number of characters per text. Captions in the data sets are far shorter.
MAX_TEXT_LENGTH = 2000
# Default duration of a motion or a part, in seconds, used when neither the request nor a number of
# repetitions determines it
USUAL_SECONDS = 3.0
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
"""Options of `flame_mdm.batch.Edit` for the editing methods from the papers."""
# Names of the regions of frames that `region` accepts
REGIONS = (
    "in_between",
    "prediction",
    "prefix",
    "suffix",
    "interpolate",
)

# Text of one part of a sequence and its duration in seconds, which is None if it is not stated
Part = tuple[str, float | None]
Waypoints = Sequence[tuple[float, float]]  # (x, z) of each waypoint in meters
Ranges = Sequence[float] | Sequence[Sequence[float]]
ARRIVAL = 0.2  # seconds between the last waypoint of a path and the end of the motion


@dataclass(frozen=True, kw_only=True)
class EditRequest:
    """Keywords of `flame_mdm.edit`: the part of the motion to resample, and the editing method.

    Raises:
        UserError: If a value is invalid for all motions.

    Example:
        >>> EditRequest(region_seconds=[[0, 1], [3, 4]], joints="left_arm").ranges
        [(0, 1), (3, 4)]
    """

    region: str | Ranges | None = option(
        None,
        "frames to resample: in_between (keeps the first and the last quarter), prediction = prefix (keeps the first "
        "quarter), suffix (keeps the last quarter), interpolate (keeps every fifth frame), or one or more [begin, end]",
    )
    region_seconds: Ranges | None = option(
        None, "one or more [begin, end] in seconds, used instead of region"
    )
    joints: str | Sequence[str] | None = option(
        None,
        "joints to resample: upper_body, lower_body, arms, legs, left_arm, right_arm, left_leg, right_leg, or a list "
        "of these and of joint names. Default: all",
    )
    method: str | None = option(
        None,
        "how the kept part is imposed: mdm overwrites the clean estimate with the kept part "
        "(exact); flame replaces the kept part after each step, as in the paper (exact); "
        "flame_code replaces it before each call of the denoiser, as in FLAME's code; mfm "
        "overwrites the early part of the flow's path. Default: mdm for diffusion, mfm for flow "
        "matching",
    )
    until: float | None = option(
        None, "for mfm: last flow time at which the path is overwritten; default: 0.2"
    )
    resample: int = option(
        1, "for flame and flame_code: how many times each sampling step is taken"
    )
    strength: float | None = option(
        None,
        "varies the motion: noise is added to it, and only this fraction of the sampling steps "
        "(above 0, up to 1) is taken. A smaller fraction keeps the result closer to the motion",
    )

    def __post_init__(self) -> None:
        if self.region is not None and self.region_seconds is not None:
            raise UserError("region and region_seconds cannot be combined. Use one of them")
        for name, choices in (("region", REGIONS), ("method", METHODS)):
            value = getattr(self, name)
            if isinstance(value, str) and value not in choices:
                raise UserError(
                    f"{name}={value} is unknown.{did_you_mean(value, choices)} Use one "
                    f"of {', '.join(choices)}"
                )
        _ = self.ranges  # raises an error if they are invalid
        if self.joints is not None and not self.joints:
            raise UserError(
                "joints: the list is empty. List the joints to resample, or omit joints to resample all of "
                "them"
            )
        if type(self.resample) is not int or self.resample < 1:
            raise UserError(f"resample={self.resample}: expected a whole number, at least 1")
        if self.strength is not None and not 0 < self.strength <= 1:
            raise UserError(f"strength={self.strength:g}: expected a number above 0 and at most 1")
        if self.method is not None:
            self.method_options(self.method)

    @property
    def ranges(self) -> list[tuple[float, float]] | None:
        """The ranges in `region` or `region_seconds`, or None if neither contains any ranges."""
        name = "region" if self.region_seconds is None else "region_seconds"
        value: Any = getattr(self, name)
        if value is None or (name == "region" and isinstance(value, str)):
            return None
        listed = [value] if is_range(value) else value
        if not isinstance(listed, list | tuple) or not listed or not all(map(is_range, listed)):
            raise UserError(
                f"{name}={value}: expected [begin, end], or several ranges as [[begin, end], [begin, end]]"
            )
        return [(begin, end) for begin, end in listed]

    def method_options(self, method: str) -> dict[str, Any]:
        """Returns the options of `flame_mdm.batch.Edit` for an editing method.

        Raises:
            UserError: If the request sets an option that the method does not support.
        """
        options = METHODS[method] | {"resample": self.resample, "strength": self.strength}
        if self.resample != 1 and options["mode"] != "x_t":
            raise UserError(
                f"resample={self.resample} applies only to method=flame and flame_code, not to {method}"
            )
        if self.until is None:
            return options
        if options["mode"] != "trajectory":
            raise UserError(f"until={self.until:g} applies only to method=mfm, not to {method}")
        return options | {"until": self.until}


@dataclass(frozen=True, kw_only=True)
class SamplingRequest:
    """Keywords of `flame_mdm.generate`: the motions to sample.

    Motions are sampled for texts or actions, or without a condition if neither is given.

    A text or action may consist of several parts, each of which may state its duration in seconds,
    as in "walks forward @3 | turns left | sits down @2". The parts are generated together as one
    motion, in overlapping windows; see docs/sequences.md. A single part with a duration, such as
    "walks forward @10", is also generated in windows, so it may be longer than the training
    motions.

    `flame_mdm.sampling.resolution.resolve` adds the values that depend on a model.

    Raises:
        UserError: If a value is invalid for all models, or if two values contradict each other.

    Example:
        >>> SamplingRequest(texts="walks forward @3 | turns left | sits down @2").parts
        [[('walks forward', 3.0), ('turns left', None), ('sits down', 2.0)]]
    """

    texts: str | Sequence[str] | None = option(
        None,
        'what the person does. Actions with seconds: "walks forward @3 | turns around | bows @2"',
    )
    actions: str | Sequence[str] | None = option(
        None, "an action label, for models that were trained on labels"
    )
    seconds: float | Sequence[float] | None = option(
        None,
        "length of the motion in seconds, or a list with one length per text. In a sequence, this "
        "is the length of each part whose text does not state a length (as @2 does). Default: the "
        "time that a stated number of repetitions takes; otherwise 3, or the length of the longest "
        "training motion if that is shorter",
    )
    frames: int | Sequence[int] | None = option(
        None, "length in frames, or a list of lengths, used instead of seconds"
    )
    samples: int = option(1, "number of motions per text or action")
    candidates: int = option(
        1,
        "number of motions to generate for each motion that is kept. The best motion without "
        "faults is kept or, if all of them have faults, the best of all",
    )
    seed: int = option(0, "seed of the noise")
    after: str | Path | Motion | None = option(None, "motion to continue: FILE or dataset:id")
    split: bool = option(
        True, 'true = split sentences such as "walks, then sits" into sequences, "walks | sits"'
    )
    loop: bool = option(False, "true = generate a loop, whose last frame leads to the first one")
    targets: str | Path | Mapping[str, Any] | None = option(
        None, "JSON file with waypoints, joint positions and poses to reach; see docs/targets.md"
    )
    path: str | Waypoints | None = option(
        None, 'waypoints on the floor, such as "0,1 0.5,2" (x,z in meters), used instead of targets'
    )
    shared_noise: bool = option(
        False,
        "true = use the same noise for all motions, which then differ only by text and length",
    )
    cleanup: bool = option(
        False, "true = smooth the motions, keep bone lengths constant, and keep feet from sliding"
    )
    options: SamplerOptions = field(default_factory=SamplerOptions)
    editing: EditRequest | None = None

    @classmethod
    def of(
        cls, function: str, keywords: Mapping[str, Any], *, editing: bool = False
    ) -> SamplingRequest:
        """Builds a request from the keywords of `generate` or `edit`.

        Raises:
            UserError: If a keyword is not a field of this class, of `SamplerOptions` or, with
                `editing`, of `EditRequest`.
        """
        request_names = _names(cls) - {"options", "editing"}
        option_names = _names(SamplerOptions)
        edit_names = _names(EditRequest) if editing else set()
        possible = request_names | option_names | edit_names
        for keyword in keywords:
            if keyword not in possible:
                raise UserError(
                    f"{function} has no option {keyword}.{did_you_mean(keyword, sorted(possible))}"
                )

        return cls(
            **_selected(keywords, request_names),
            options=SamplerOptions(**_selected(keywords, option_names)),
            editing=EditRequest(**_selected(keywords, edit_names)) if editing else None,
        )

    def __post_init__(self) -> None:
        for name in ("texts", "actions", "seconds", "frames"):
            value = getattr(self, name)
            # NumPy arrays and scalars are converted to lists and Python numbers
            value = value.tolist() if hasattr(value, "tolist") else value
            if isinstance(value, str) and name in ("texts", "actions"):
                value = (value,)
            object.__setattr__(
                self, name, tuple(value) if isinstance(value, list | tuple) else value
            )
        for name in ("samples", "candidates"):
            value = getattr(self, name)
            if not isinstance(value, Integral) or not 1 <= int(value) <= MAX_SAMPLES:
                raise UserError(
                    f"{name}={value}: expected a whole number from 1 to {MAX_SAMPLES:,}"
                )
        if not isinstance(self.seed, Integral):
            raise UserError(f"seed={self.seed!r}: expected a whole number")
        self._check_prompts()
        self._check_lengths()
        if self.path is not None:
            if self.targets is not None:
                raise UserError(
                    f"path={self.path}: path and targets cannot be combined. Use one of them"
                )
            object.__setattr__(self, "path", read_path(self.path))

        other = "loop" if self.loop else "targets" if self.has_targets else None
        if self.after is not None and other is not None:
            name = self.after if isinstance(self.after, str | Path) else self.after.id
            raise UserError(
                f"after={name}: a motion that continues another motion cannot be combined with {other}. "
                f"Omit after or {other}"
            )

        if (edit := self.editing) is not None:
            is_whole = edit.region is edit.region_seconds is edit.joints is None
            self.check_edit(edit.strength is not None and is_whole)
            if self.seconds is not None or self.frames is not None:
                raise UserError(
                    "an edit is as long as the motion. Omit seconds and frames, or select a part with "
                    "cut=[begin, end]"
                )

    def _check_prompts(self) -> None:
        if self.texts is not None and self.actions is not None:
            raise UserError("texts and actions cannot be combined. Use one of them")
        for prompt in self.prompts:
            if not isinstance(prompt, str):
                raise UserError(
                    f"{self.kind}={prompt!r} is not a string. Pass a string, such as {self.kind}='walk'"
                )
            check_length(prompt)
        if self.texts is not None and not all(text.strip() for text in self.prompts):
            raise UserError("the text is empty. Omit it to sample without a condition")

        copies = self.samples * self.candidates
        if len(self.prompts) * copies > MAX_SAMPLES:
            key = "samples" if self.candidates == 1 else "samples times candidates"
            raise UserError(
                f"{key}={copies} for each text: a request may contain at most {MAX_SAMPLES:,} motions"
            )
        _ = self.parts  # raises an error if a part is invalid

    def _check_lengths(self) -> None:
        if self.seconds is not None and self.frames is not None:
            raise UserError("seconds and frames cannot be combined. Use one of them")
        name = "frames" if self.seconds is None else "seconds"
        value: Any = getattr(self, name)
        if value is None:
            return
        shown, count = (
            f"{name}={list(value) if isinstance(value, tuple) else value}",
            len(self.prompts),
        )
        if isinstance(value, tuple) and len(value) != count:
            raise UserError(
                f"{shown}: the number of lengths is {len(value)}, but the number of prompts is {count}. Use one "
                "length, or one per prompt"
            )
        for length in value if isinstance(value, tuple) else (value,):
            if (
                not issubclass(type(length), Real)
                or not abs(length) < 1e9
                or (name == "frames" and length % 1)
            ):
                raise UserError(f"{shown} is not a valid length")

    def check_edit(self, varies: bool) -> None:
        """Checks a request that edits part of a motion or, if `varies`, varies the entire motion.

        Raises:
            UserError: If the request contains options that do not apply to edits or variations.
        """
        if self.after is not None or (not varies and (self.is_sequence or self.has_targets)):
            advice = (
                "Variations of an entire motion (strength=0.5) may have parts, loop and targets"
            )
            raise UserError(
                f"an edit changes a single motion: omit parts (|), after, loop and targets. {advice}"
            )

    @property
    def kind(self) -> Literal["text", "action", "none"]:
        """Kind of condition for the motions to sample."""
        return (
            "text" if self.texts is not None else "action" if self.actions is not None else "none"
        )

    @property
    def has_targets(self) -> bool:
        """Whether the motions have targets."""
        return self.targets is not None or self.path is not None

    @property
    def prompts(self) -> tuple[str, ...]:
        """The texts or actions, or a single empty string if there are none."""
        return tuple(self.texts or self.actions or ("",))

    @cached_property
    def parts(self) -> list[list[Part]]:
        """The parts of each prompt; see `read_parts`."""
        return [
            [(prompt, None)] if self.kind == "none" else read_parts(prompt)
            for prompt in self.prompts
        ]

    @property
    def is_sequence(self) -> bool:
        """Whether motions are generated in windows.

        Windows are used if a prompt has several parts or states a duration, or if the motions loop
        or continue another motion.
        """
        return self.loop or self.after is not None or any(is_timed(parts) for parts in self.parts)

    def lengths(self, fps: float) -> list[float | None]:
        """Returns the requested length for each prompt as an unrounded number of frames.

        The entries are None if no length was requested.
        """
        value: Any = self.frames if self.seconds is None else self.seconds
        lengths = value if isinstance(value, tuple) else [value] * len(self.prompts)
        return [
            None if length is None else length * (1.0 if self.seconds is None else fps)
            for length in lengths
        ]


def _names(kind: type[Any]) -> set[str]:
    return {entry.name for entry in fields(kind)}


def _selected(keywords: Mapping[str, Any], names: set[str]) -> dict[str, Any]:
    return {name: value for name, value in keywords.items() if name in names}


def check_length(text: str) -> None:
    """Raises `UserError` if the text is too long."""
    if len(text) > MAX_TEXT_LENGTH:
        raise UserError(
            f"{shortened(text, 60)}: the text has {len(text):,} characters. Use at most {MAX_TEXT_LENGTH:,}"
        )


def is_timed(parts: Sequence[Part]) -> bool:
    """Returns whether a prompt has several parts or states a duration."""
    return len(parts) > 1 or parts[0][1] is not None


def read_parts(text: str) -> list[Part]:
    """Splits "walks @3 | sits down" into the parts [("walks", 3.0), ("sits down", None)].

    Raises:
        UserError: If a part is empty, or if its duration is not a number of seconds above 0.
    """
    parts: list[Part] = []
    for part in text.split("|"):
        words, at, number = part.rpartition("@") if "@" in part else (part, "", "")
        try:
            seconds = float(number.strip().removesuffix("s")) if at else None
        except ValueError:
            seconds = math.nan
        if seconds is not None and not 0 < seconds < math.inf:
            raise UserError(
                f"'{part.strip()}': the duration of a part must be a number of seconds above 0, "
                "as in 'walks forward @3'"
            )
        if not words.strip():
            raise UserError(
                f"'{text}': part {len(parts) + 1} is empty. Say what happens in each part, as in 'walks | sits'"
            )
        parts.append((words.strip(), seconds))
    return parts


def is_range(value: Any) -> bool:
    """Returns whether a value is a pair of finite numbers."""
    pair = isinstance(value, list | tuple) and len(value) == 2
    return pair and all(isinstance(v, int | float) and math.isfinite(v) for v in value)


def read_path(path: str | Waypoints) -> tuple[tuple[float, float], ...]:
    """Reads waypoints (x, z), in meters, from a string "x,z x,z ..." or a sequence of pairs.

    Raises:
        UserError: If there are no waypoints or if they cannot be read.
    """
    pairs = [point.split(",") for point in path.split()] if isinstance(path, str) else path
    try:
        points = tuple((float(x), float(z)) for x, z in pairs)
    except (TypeError, ValueError):
        points = ()
    if not points:
        shown = shortened(one_line(str(path)[:500]), 60)
        raise UserError(f"path={shown}: expected waypoints as x,z in meters, such as 0,1 0.5,2")
    return points


def path_targets(path: Waypoints, seconds: float) -> dict[str, Any]:
    """Returns targets that lead a motion along a path at a constant speed.

    The path starts at x = z = 0. The motion lasts `seconds` seconds.
    """
    steps = pairwise([(0.0, 0.0), *path])
    distances = list(accumulate(math.dist(*step) for step in steps))
    total = distances[-1] or 1.0
    times = [round((seconds - ARRIVAL) * distance / total, 3) for distance in distances]
    return {
        "root": [
            {"time": time, "position": list(point)} for time, point in zip(times, path, strict=True)
        ]
    }
