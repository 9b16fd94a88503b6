"""`flame-mdm evaluate CKPT`: evaluates a checkpoint, a folder of motions or a baseline under a protocol."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import partial
from typing import ClassVar

from flame_mdm.commands import DataSettings, ModelSettings, check_device
from flame_mdm.config import run
from flame_mdm.sampler_options import SamplerOptions, option, same_option
from flame_mdm.sampling.request import EditRequest


@dataclass(frozen=True, kw_only=True)
class EvaluateSettings(SamplerOptions, DataSettings, ModelSettings):
    """usage: flame-mdm evaluate ckpt=FILE [protocol=NAME] extractor=FILE [key=value ...]
           flame-mdm evaluate from_samples=FOLDER data=NAME protocol=NAME extractor=FILE
           flame-mdm evaluate baseline=shuffled data=NAME protocol=NAME extractor=FILE
           torchrun --nproc-per-node 8 -m flame_mdm evaluate ckpt=FILE ...

    Evaluates generated and real motions under a protocol, and writes a JSON file with all values and their provenance.
    If interrupted, the same command continues where it stopped. quick=true checks within a minute that everything
    works. Protocols: experiments/evaluation
    """

    OBJECTS: ClassVar = ("ckpt", "out")
    protocol: str | None = option(None, "a name in experiments/evaluation, or a file; default: the model decides")
    extractor: str | None = option(None, "a motion-CLIP, or as the protocol requires; none = no extractor")
    smpl: str | None = option(lambda: os.environ.get("FLAME_MDM_SMPL"), "SMPL's model file (.pkl or .npz), for joints")
    from_samples: str | None = option(None, "a folder of motions of other systems, instead of ckpt; needs data=")
    baseline: str | None = option(None, "real, shuffled, noisy or static motions, instead of ckpt; needs data=")
    split: str = option("test", "train, val or test")
    seed: int = option(0, "seed of the noise and of the drawn motions")
    replications: int | None = option(None, "replications and samples: override the protocol; the result says so")
    samples: int | None = option(None, "number of motions")
    resamples: int = option(0, "sets of motions drawn for 95 % intervals over motions, such as 200")
    multimodality: bool = option(True, "false = skip metrics that need several samples per prompt; the result says so")
    quick: bool = option(False, "two replications of 64 motions, to check that everything works; the result says so")
    force: bool = option(False, "generate even if real motions miss the expected values; the result says so")
    method: str | None = same_option(EditRequest, "method")
    until: float | None = same_option(EditRequest, "until")
    strength: float | None = same_option(EditRequest, "strength")
    batch_size: int | None = option(None, "motions at once: 64, or what a protocol that measures time says")
    device: str | None = option(None, "default: cuda if available")
    data_root: str = option("", "folder of the prepared data sets; default: the checkpoint's, or FLAME_MDM_DATA")
    out: str | None = option(None, "the JSON file; default: next to the generated motions")

    def __post_init__(self) -> None:
        SamplerOptions.__post_init__(self)
        DataSettings.__post_init__(self)


def evaluate_request(settings: EvaluateSettings) -> None:
    """Evaluates what the settings name, and writes the result."""
    from evaluators.request import EvaluationRequest

    check_device(settings.device)
    nodes = settings.nodes if settings.data is not None else {"data": None, "representation": None}
    request = EvaluationRequest.of(vars(settings) | nodes)
    if settings.ckpt is not None:
        settings.model_file()  # reports a missing file before torch is imported
    from evaluators.evaluation import evaluate

    evaluate(request)


main = partial(run, evaluate_request, EvaluateSettings)
