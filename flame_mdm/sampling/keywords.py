# pyright: standard
"""Keywords of `flame_mdm.generate` and `flame_mdm.edit`, with their types.

The keywords are the fields of `SamplingRequest`, `EditRequest` and `SamplerOptions`. These classes
define the defaults and help texts of the keywords.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypedDict

from flame_mdm.formats.motion import Motion
from flame_mdm.sampling.motion_request import Ranges, Waypoints


class SamplerKeywords(TypedDict, total=False):
    """Fields of `flame_mdm.sampler_options.SamplerOptions`."""

    guidance_scale: float | None
    sampler: str | None
    num_inference_steps: int | Sequence[int] | None
    eta: float | None
    spacing: str | None


class SamplingKeywords(SamplerKeywords, total=False):
    """Fields of `SamplingRequest` (except `texts`) and of `SamplerOptions`."""

    actions: str | Sequence[str] | None
    seconds: float | Sequence[float] | None
    frames: int | Sequence[int] | None
    samples: int
    candidates: int
    seed: int
    after: str | Path | Motion | None
    split: bool
    loop: bool
    targets: str | Path | Mapping[str, Any] | None
    path: str | Waypoints | None
    shared_noise: bool
    cleanup: bool


class EditKeywords(SamplingKeywords, total=False):
    """Fields of `EditRequest`, in addition to `SamplingKeywords`."""

    region: str | Ranges | None
    region_seconds: Ranges | None
    joints: str | Sequence[str] | None
    method: str | None
    until: float | None
    resample: int
    strength: float | None
