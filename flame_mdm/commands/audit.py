"""`flame-mdm audit data=NAME extractor=FILE`: audits an evaluator and writes its card."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

from evaluators.evaluation_request import EvaluationKeys
from flame_mdm.commands import DataSettings, device_name, model_source
from flame_mdm.config.options import option, same_option
from flame_mdm.errors import UserError, say
from flame_mdm.reporting.audit_cards import card_name, read_card, write_card
from flame_mdm.safe_io import write_json


@dataclass(frozen=True, kw_only=True)
class AuditSettings(DataSettings):
    """usage: flame-mdm audit data=NAME extractor=FILE|none [key=value ...]
           flame-mdm audit cards="A.json B.json"

    Perturbs a data set's real motions at several strengths, evaluates them as if they had been
    generated, and writes a card. The card shows which perturbations each metric detects, at which
    strength it does so, and which ones it misses. extractor=none audits the metrics that are
    computed from joint positions. After an interruption, the same command continues where it
    stopped. cards= renders an existing card again, or two cards side by side.
    """

    OBJECTS: ClassVar = ("data", "extractor")
    extractor: str | None = option(
        None,
        "path of the motion-CLIP or other extractor required by the protocol; none = audit "
        "only metrics that need no extractor",
        model_source,
    )
    protocol: str | None = option(
        None,
        "protocol whose metrics are audited; default: synthetic for data=synthetic, otherwise "
        "text_to_motion",
    )
    split: Literal["train", "val", "test"] = option(
        "test", "split whose motions are used: train, val or test"
    )
    samples: int | None = option(None, "number of motions; default: all motions of the split")
    seed: int = same_option(EvaluationKeys, "seed")
    resamples: int = option(
        100, "number of bootstrap resamples of the motions, for the confidence intervals"
    )
    cards: list[str] | None = option(
        None, "one card (.json) to render again, or two cards to render side by side"
    )
    batch_size: int = option(64, "motions per batch")
    device: str | None = option(None, "cpu or cuda; default: cpu", device_name)
    data_root: str = option(
        "", "folder of the prepared data sets; default: FLAME_MDM_DATA, or data"
    )
    out: str = option("runs/audit", "folder for the cards")


def main(settings: AuditSettings) -> None:
    """Writes cards: audits an extractor or metrics, or renders existing cards again."""
    out = Path(settings.out)
    if settings.cards is not None:
        if len(settings.cards) > 2:
            raise UserError(
                f"cards={' '.join(settings.cards)}: got {len(settings.cards)} cards. Pass one or two"
            )
        paths = [Path(card) for card in settings.cards]
        name = "-and-".join(path.stem for path in paths)
        say(*write_card([read_card(path) for path in paths], out, name))
        return
    if settings.data is None or settings.extractor is None:
        raise UserError(
            "an audit requires a data set and an extractor: data=NAME extractor=FILE, "
            "or extractor=none"
        )
    if settings.resamples < 100 or (settings.samples or 64) < 8:
        raise UserError(
            f"resamples={settings.resamples}, samples={settings.samples}: too few. Use at "
            f"least resamples=100 and samples=8"
        )
    from evaluators.audit import audit as measure
    from evaluators.evaluation_request import EvaluationRequest

    protocol = settings.protocol or (
        "synthetic" if settings.nodes["data"]["name"] == "synthetic" else "text_to_motion"
    )
    request = EvaluationRequest.of(
        vars(settings) | settings.nodes | {"baseline": "real", "protocol": protocol}
    )
    card = measure(request, out / "cache", settings.resamples)
    write_json(out / f"{card_name(card)}.json", card.model_dump(), indent=None)
    say(*write_card([card], out))
