"""`flame-mdm audit data=NAME extractor=FILE`: audits an evaluator, and writes its card."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from flame_mdm.config import Config, run
from flame_mdm.errors import UserError, say
from flame_mdm.reporting.audit import card_name, read_card, write_card
from flame_mdm.reporting.report import paths
from flame_mdm.safe_io import write_json

USAGE = """
usage: flame-mdm audit data=NAME extractor=FILE|none [key=value ...]
       flame-mdm audit cards="A.json B.json"

Perturbs the real motions of a data set at graded strengths, measures them like generated ones, and writes a card: what
each metric sees, from which strength, and what it cannot see. extractor=none audits the metrics of joint positions.
If interrupted, the same command continues where it stopped. cards= compares two cards side by side.
Keys, with their defaults: experiments/audit.yaml
"""


def audit(config: Config) -> None:
    """Audits an evaluator, or renders existing cards.

    Raises:
        UserError: If a key is missing or wrong, a card is damaged, or data, protocol and extractor do not match.
    """
    out = Path(config["out"])
    if config["cards"] is not None:
        files = paths("cards", str(config["cards"]))
        if len(files) > 2:
            raise UserError(f"cards={config['cards']}: {len(files)} cards. Give one or two")
        say(*write_card([read_card(path) for path in files], out))
        return
    if "data" not in config or config["extractor"] is None:
        raise UserError(
            "an audit needs a data set and an extractor. Give data=NAME and extractor=FILE, or extractor=none"
        )
    if config["resamples"] == 0 or (config["samples"] or 64) < 8:
        raise UserError(f"resamples={config['resamples']}, samples={config['samples']}: give 100, and 8 or more")
    from evaluators.audit import audit as measure
    from evaluators.evaluation import EvaluationRequest

    protocol = config["protocol"] or ("synthetic" if config["data"]["name"] == "synthetic" else "text_to_motion")
    request = EvaluationRequest.of(config | {"baseline": "real", "protocol": protocol})
    card = measure(request, out / "cache")
    write_json(out / f"{card_name(card)}.json", card.model_dump(), indent=None)
    say(*write_card([card], out))


main = partial(
    run,
    audit,
    usage=USAGE,
    name="audit",
    objects=("data", "extractor"),
    text=("extractor", "protocol", "cards", "data_root", "out"),
    kinds={"seed": "int", "samples": "int", "resamples": "int", "batch_size": "int"},
)
