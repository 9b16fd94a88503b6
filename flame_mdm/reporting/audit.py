"""Cards of evaluator audits."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from flame_mdm.runs import AuditCard, read_json


def card_name(card: AuditCard) -> str:
    """Returns the name of the files of a card."""
    return f"{card.data.dataset}-{card.extractor.sha256[:12] if card.extractor else 'none'}"


def read_card(path: Path) -> AuditCard:
    return read_json(path, AuditCard, "run `flame-mdm audit` again")


def write_card(cards: Sequence[AuditCard], out: Path) -> list[Path]:
    return []
