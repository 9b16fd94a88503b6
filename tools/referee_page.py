"""Writes docs/benchmarks/referee.md from the result files of `tools/referee.py` and `tools/referee_table.py`.

python tools/referee_page.py
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).resolve().parents[1] / "docs" / "benchmarks"
GROUPS = ("movement", "direction", "side", "count", "speed", "posture", "contact", "order", "all")
SETS = {"cmu": "CMU", "package": "free motion capture", "bandai": "Bandai-Namco", "synthetic": "synthetic"}  # fmt: skip
INTRODUCTION = """# The referee, measured

[The referee](../referee.md) explains what is judged. The tables are written by `tools/referee_page.py` from results in
this folder.

## Right verdicts on real motions

Thresholds come from one half of the recordings, these figures from the other half. A claim of a caption is taken to be
true of its motion. A falsified claim states the other side, direction or speed, one repetition more or fewer, or the
reverse order, and is taken to be false. Wrong captions count as errors. Patterns and measurements were corrected while
the errors on both halves were known, so that the figures are optimistic for other data.

CMU's captions come from HumanML3D's test split and from KIT-ML, for the recordings at hand. Bandai-Namco's captions
are templates of its labels, so that its many clips have few different sentences. Read the sets one by one.
"""


def main() -> None:
    calibration = read("referee_calibration.json")["rows"]
    parts = [INTRODUCTION, *calibration_tables(calibration)]
    systems = FOLDER / "referee_systems.json"
    if systems.exists():
        parts += systems_table(read(systems.name))
    by_eye = FOLDER / "referee_by_eye.json"
    if by_eye.exists():
        parts += eye_table(read(by_eye.name)["verdicts"])
    (FOLDER / "referee.md").write_text("\n".join(parts) + "\n", encoding="utf-8")


def read(name: str) -> dict[str, Any]:
    return json.loads((FOLDER / name).read_text(encoding="utf-8"))


def share(right: int, total: int) -> str:
    """Returns a share in percent and the number that it is of; "" of nothing."""
    return f"{100 * right / total:.1f} % of {total}" if total else "–"


def calibration_tables(rows: list[dict[str, Any]]) -> list[str]:
    lines = ["| set | claims | decided | true claims judged true | falsified claims judged false |"]
    lines.append("|---|---|---:|---:|---:|")
    by_name = {(row["set"], row["group"]): row for row in rows if "group" in row}
    for name, title in {"real": "all real sets", **SETS}.items():
        for group in GROUPS:
            row = by_name.get((name, group))
            if row is None or (name != "real" and group != "all"):
                continue
            decided = share(row["true_decided"], row["true"])
            true = share(row["true_right"], row["true_decided"])
            false = share(row["false_right"], row["false_decided"])
            lines.append(f"| {title} | {group} | {decided} | {true} | {false} |")
    lines += ["", "Captions of all recordings of a set, both halves:", ""]
    lines += ["| set | captions | with a claim | with a decided claim |", "|---|---:|---:|---:|"]
    for row in rows:
        if "captions" in row:
            count = row["captions"]
            claim, decided = (100 * row[name] / count for name in ("with_claim", "with_decided"))
            lines.append(f"| {SETS[row['set']]} | {count} | {claim:.0f} % | {decided:.0f} % |")
    kinds = [row for row in rows if row.get("group", "").startswith("kind ")]
    lines += ["", "By kind, over all real sets:", ""]
    lines += [
        "| kind | true claims judged true | falsified claims judged false |",
        "|---|---:|---:|",
    ]
    for row in kinds:
        true = share(row["true_right"], row["true_decided"])
        false = share(row["false_right"], row["false_decided"])
        lines.append(f"| {row['group'].removeprefix('kind ')} | {true} | {false} |")
    return lines


def systems_table(content: Mapping[str, Any]) -> list[str]:
    lines = ["", "## Systems", ""]
    both = sum(row["top3"] is not None for row in content["rows"])
    lines += [
        "Shares of decided claims that are true, and R-precision (`MotionsForText`, top 3, motion-CLIP of the",
        f"package) on the same motions, at most {content['motions']} per row. Over the {both} rows that have both,",
        f"the rank correlation is {content['rank_correlation']:.2f}. FLAME, MDM, MFM and DiP on Bandai-Namco and",
        "CMU have no row: no checkpoints were at hand.",
    ]
    groups = ("all", "side", "direction", "count", "movement", "posture", "contact")
    lines += ["", f"| data | motions | {' | '.join(groups)} | decided | R-precision |"]
    lines.append(f"|---|---|{'---:|' * (len(groups) + 2)}")
    for row in content["rows"]:
        values = [row["claims"][group] for group in (*groups, "decided")] + [row["top3"]]
        cells = ["–" if value is None else f"{value:.3f}" for value in values]
        lines.append(f"| {row['data']} | {row['system']} | {' | '.join(cells)} |")
    return lines


def eye_table(verdicts: list[dict[str, Any]]) -> list[str]:
    agreed = sum(verdict["agrees"] for verdict in verdicts)
    lines = ["", "## Verdicts looked at", ""]
    lines.append(
        f"{len(verdicts)} verdicts on motions of the second half, at most one per motion and spread over the kinds, "
        f"were compared with twelve pictures of each motion: {agreed} agree."
    )
    lines += ["", "| motion | verdict | agrees | |", "|---|---|---|---|"]
    for verdict in verdicts:
        agrees = "yes" if verdict["agrees"] else "no"
        lines.append(
            f"| {verdict['motion']} | {verdict['verdict']} | {agrees} | {verdict['note']} |"
        )
    return lines


if __name__ == "__main__":
    main()
