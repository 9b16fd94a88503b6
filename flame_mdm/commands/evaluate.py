"""`flame-mdm evaluate CKPT`: evaluates a checkpoint, motions or a baseline under a protocol."""

from dataclasses import dataclass
from typing import ClassVar

from evaluators.evaluation_request import EvaluationKeys, EvaluationRequest
from flame_mdm.commands import DataSettings, ModelSettings, device_name, model_source
from flame_mdm.config.options import same_option
from flame_mdm.sampler_options import SamplerOptions


@dataclass(frozen=True, kw_only=True)
class EvaluateSettings(EvaluationKeys, SamplerOptions, DataSettings, ModelSettings):
    """usage: flame-mdm evaluate ckpt=FILE [protocol=NAME] extractor=FILE [key=value ...]
           flame-mdm evaluate from_samples=FOLDER data=NAME protocol=NAME extractor=FILE
           flame-mdm evaluate baseline=shuffled data=NAME protocol=NAME extractor=FILE
           torchrun --nproc-per-node 8 -m flame_mdm evaluate ckpt=FILE ...
           flame-mdm evaluate ckpt=FILE extractor=FILE guidance_scale=1,2.5,4 --multirun

    Evaluates generated and real motions under a protocol in experiments/evaluation, and writes a
    JSON file with all values and their provenance. After an interruption, the same command
    continues where it stopped. quick=true checks within a minute that everything works.
    --multirun evaluates once per combination of values, and launch=slurm or launch=local starts a
    job for each combination; see docs/clusters.md.
    """

    OBJECTS: ClassVar = ("ckpt", "out")
    SWEEPS: ClassVar = True
    ckpt: str | None = same_option(ModelSettings, "ckpt", default=None)
    extractor: str | None = same_option(EvaluationKeys, "extractor", model_source)
    device: str | None = same_option(EvaluationKeys, "device", device_name)

    def __post_init__(self) -> None:
        SamplerOptions.__post_init__(self)
        DataSettings.__post_init__(self)


def main(settings: EvaluateSettings) -> None:
    """Evaluates a model, a folder of motions or a baseline, and writes the result."""
    nodes = settings.nodes if settings.data is not None else {"data": None, "representation": None}
    request = EvaluationRequest.of(vars(settings) | nodes)
    if settings.ckpt is not None:
        settings.model_file()  # reports a missing file before torch is imported
    from evaluators.evaluation import evaluate

    evaluate(request)
