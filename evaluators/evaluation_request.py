# pyright: standard
"""The keys of `flame-mdm evaluate`, which describe an evaluation.

This module does not import torch, so that invalid keys are reported immediately.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field, fields
from typing import Literal

from flame_mdm.checkpoints.locating import Which
from flame_mdm.config import Config
from flame_mdm.config.options import option, same_option
from flame_mdm.errors import UserError
from flame_mdm.sampler_options import SamplerOptions
from flame_mdm.sampling.motion_request import EditRequest

MIN_RESAMPLES = 100


@dataclass(frozen=True, kw_only=True)
class EvaluationKeys:
    """Evaluation keys that the command line and Python share, with their help texts."""

    protocol: str | None = option(
        None,
        "protocol: a name in experiments/evaluation, or a file; default: the protocol for "
        "the condition and data set of the model",
    )
    extractor: str | None = option(
        None,
        "path of the motion-CLIP or other extractor that the protocol requires; none = no "
        "extractor",
    )
    smpl: str | None = option(
        lambda: os.environ.get("FLAME_MDM_SMPL"),
        "SMPL's model file (.pkl or .npz), which provides the skeleton of the joints",
    )
    from_samples: str | None = option(
        None,
        "folder with motions from another system, which are evaluated instead of ckpt; needs data=",
    )
    baseline: str | None = option(
        None,
        "baseline to evaluate instead of ckpt: real, shuffled, noisy or static "
        "motions; needs data=",
    )
    split: Literal["train", "val", "test"] = option("test", "split to evaluate: train, val or test")
    seed: int = option(0, "seed of the noise and of the random choice of motions")
    replications: int | None = option(
        None, "number of replications, instead of the protocol's number; noted in the result"
    )
    samples: int | None = option(
        None, "motions per replication, instead of the protocol's number; noted in the result"
    )
    resamples: int = option(
        0,
        "number of bootstrap resamples of the motions, such as 200, for 95 % confidence intervals",
    )
    multimodality: bool = option(
        True, "false = skip metrics that need several samples per prompt; noted in the result"
    )
    quick: bool = option(
        False, "two replications of 64 motions, to check that everything works; noted in the result"
    )
    force: bool = option(
        False,
        "generate motions even if the metrics of the real motions differ from the values that "
        "the protocol expects; the result is marked as not valid",
    )
    method: str | None = same_option(EditRequest, "method")
    until: float | None = same_option(EditRequest, "until")
    strength: float | None = same_option(EditRequest, "strength")
    batch_size: int | None = option(
        None, "motions per batch; default: 64, or the protocol's number if it measures time"
    )
    device: str | None = option(None, "cpu or cuda; default: cuda if available")
    data_root: str = option(
        "", "folder of the prepared data sets; default: the checkpoint's, or FLAME_MDM_DATA"
    )
    out: str | None = option(
        None, "the JSON file to write; default: a file next to the generated motions"
    )


@dataclass(frozen=True, kw_only=True)
class EvaluationRequest(EvaluationKeys):
    """The keys of `flame-mdm evaluate`, with the composed data set and representation.

    Raises `UserError` if keys contradict each other, or if a value is out of range.
    """

    ckpt: str | None = None
    which: Which = "last"
    data: Config | None = None
    representation: Config | None = None
    options: SamplerOptions = field(default_factory=SamplerOptions)

    @property
    def editing(self) -> EditRequest:
        """The edit options, for protocols that edit motions."""
        return EditRequest(method=self.method, until=self.until, strength=self.strength)

    @classmethod
    def of(cls, config: Config) -> EvaluationRequest:
        """Creates a request from a mapping of keys to values.

        Sampler keys are stored in `options`.
        """
        kinds = (cls, SamplerOptions)
        keywords, options = (
            {key.name: config[key.name] for key in fields(kind) if key.name in config}
            for kind in kinds
        )
        return cls(**keywords, options=SamplerOptions(**options))

    def __post_init__(self) -> None:
        _ = self.editing  # checks the keys of the edit
        subjects = [
            name for name in ("ckpt", "from_samples", "baseline") if getattr(self, name) is not None
        ]
        if len(subjects) != 1:
            raise UserError(
                "use exactly one of ckpt=FILE, from_samples=FOLDER or baseline=NAME, such as shuffled"
            )
        if subjects != ["ckpt"] and not self.data:
            raise UserError(
                f"{subjects[0]} needs a data set. Add data=NAME, such as data=humanml3d"
            )
        if subjects != ["ckpt"] and self.protocol is None:
            raise UserError(
                f"{subjects[0]} needs a protocol. Add protocol=NAME, such as protocol=text_to_motion"
            )
        if subjects == ["from_samples"] and (self.quick or self.samples or self.replications):
            raise UserError(
                "from_samples evaluates all motions in the files. Remove quick, samples and replications"
            )
        if self.resamples and self.resamples < MIN_RESAMPLES:
            raise UserError(
                f"resamples={self.resamples}: expected 0, or at least {MIN_RESAMPLES} for a 95 % interval"
            )
