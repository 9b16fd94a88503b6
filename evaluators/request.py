"""The keys of an evaluation. Nothing here imports torch, so that wrong keys are reported at once."""

from __future__ import annotations

import os
from dataclasses import dataclass, field, fields
from typing import Any, Literal

from flame_mdm.config import Config
from flame_mdm.errors import UserError
from flame_mdm.sampler_options import SamplerOptions
from flame_mdm.sampling.request import EditRequest

MIN_RESAMPLES = 100


@dataclass(frozen=True, kw_only=True)
class EvaluationRequest:
    """The keys of an evaluation, which `flame-mdm evaluate --help` explains.

    Raises:
        UserError: If keys contradict each other, or a value is out of range.
    """

    ckpt: str | None = None
    which: Literal["last", "best"] = "last"
    from_samples: str | None = None
    baseline: str | None = None
    data: Config | None = None
    representation: Config | None = None
    protocol: str | None = None
    extractor: str | None = None
    smpl: str | None = field(default_factory=lambda: os.environ.get("FLAME_MDM_SMPL"))
    split: Literal["train", "val", "test"] = "test"
    seed: int = 0
    replications: int | None = None
    samples: int | None = None
    resamples: int = 0
    multimodality: bool = True
    quick: bool = False
    force: bool = False
    options: SamplerOptions = field(default_factory=SamplerOptions)
    editing: EditRequest = field(default_factory=EditRequest)
    batch_size: int | None = None
    device: str | None = None
    data_root: str | None = None
    out: str | None = None

    @classmethod
    def of(cls, config: Config) -> EvaluationRequest:
        """Returns the request of a composed configuration."""

        def values(kind: Any) -> dict[str, Any]:
            return {key.name: config[key.name] for key in fields(kind) if key.name in config}

        sampling = {"options": SamplerOptions(**values(SamplerOptions)), "editing": EditRequest(**values(EditRequest))}
        return cls(**values(cls) | sampling)

    def __post_init__(self) -> None:
        what = [name for name in ("ckpt", "from_samples", "baseline") if getattr(self, name) is not None]
        if len(what) != 1:
            raise UserError(
                "give exactly one of ckpt=runs/.../checkpoints/last.ckpt, from_samples=<folder of .npz files> and "
                "baseline=shuffled"
            )
        if what != ["ckpt"] and not self.data:
            raise UserError(f"{what[0]} needs a data set. Add data=NAME, such as data=humanml3d")
        if what != ["ckpt"] and self.protocol is None:
            raise UserError(f"{what[0]} needs a protocol. Add protocol=NAME, such as protocol=text_to_motion")
        if what == ["from_samples"] and (self.quick or self.samples or self.replications):
            raise UserError("from_samples evaluates all motions of the files. Remove quick, samples and replications")
        if self.split not in ("train", "val", "test"):
            raise UserError(f"unknown split: {self.split}. Choose train, val or test")
        if self.resamples and self.resamples < MIN_RESAMPLES:
            raise UserError(f"resamples={self.resamples}: give 0, or {MIN_RESAMPLES} or more for a 95 % interval")
        if self.batch_size is not None and self.batch_size < 1:
            raise UserError(f"batch_size={self.batch_size}: must be at least 1")
