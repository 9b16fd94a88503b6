"""`flame-mdm evaluate CKPT`: evaluates a checkpoint, a folder of motions or a baseline under a protocol."""

from __future__ import annotations

from functools import partial

from flame_mdm.commands import SAMPLING
from flame_mdm.config import Config, run

USAGE = """
usage: flame-mdm evaluate ckpt=FILE [protocol=NAME] extractor=FILE [key=value ...]
       flame-mdm evaluate from_samples=FOLDER data=NAME protocol=NAME extractor=FILE
       flame-mdm evaluate baseline=shuffled data=NAME protocol=NAME extractor=FILE
       torchrun --nproc-per-node 8 -m flame_mdm evaluate ckpt=FILE ...

Evaluates generated and real motions under a protocol, and writes a JSON file with all values and their provenance.
If interrupted, the same command continues where it stopped. quick=true checks within a minute that everything works.
Keys, with their defaults: experiments/evaluate.yaml; protocols: experiments/evaluation
"""


def _evaluate(config: Config) -> None:
    from evaluators.evaluation import EvaluationRequest, evaluate

    evaluate(EvaluationRequest.of(config))


main = partial(
    run,
    _evaluate,
    usage=USAGE,
    name="evaluate",
    objects=("ckpt", "out"),
    text=("ckpt", "extractor", "from_samples", "protocol", "data_root", "out"),
    kinds={
        **SAMPLING,
        "strength": "float",
        "replications": "int",
        "resamples": "int",
        "batch_size": "int",
        "multimodality": "bool",
        "quick": "bool",
        "force": "bool",
    },
)
