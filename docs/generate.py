"""Writes recipes.md and hyperparameters.md from the recipes: `make docs`."""

import re
from itertools import takewhile
from pathlib import Path
from typing import Any

from flame_mdm.config import EXPERIMENTS, recipes
from flame_mdm.reporting.tables.settings import HYPERPARAMETERS, hyperparameters, setting_text
from flame_mdm.reporting.tables.specs import PUBLISHED, load_spec
from flame_mdm.safe_io import read_yaml

HEAD = "<!-- Written by docs/generate.py; do not edit. -->\n"


def head(name: str) -> tuple[str, str]:
    """Returns the head comment of a recipe: what it is (paper, table, row), and its deviations."""
    lines = (EXPERIMENTS / f"{name}.yaml").read_text().splitlines()[1:]
    comment = " ".join(
        line.removeprefix("#").strip()
        for line in takewhile(lambda line: line.startswith("#"), lines)
    )
    what, _, deviations = comment.partition("Deviations")
    return what.strip(), ("Deviations" + deviations if deviations else "")


def recipes_page() -> str:
    page = f"""# Recipes

{HEAD}
Each row of the papers' tables that FLAME (Kim et al., AAAI 2023, arXiv:2209.00349), MDM (Tevet et al., ICLR 2023,
arXiv:2209.14916) or Motion Flow Matching (Hu et al., 2023, arXiv:2312.08895) fill has a recipe: `make train
EXP=humanml3d/mdm`. Recipes that name no table are not rows of a paper; their files list how they deviate. "As in
mdm" means the deviations of the recipe `mdm` in the same folder. Some deviations hold for all recipes: a batch contains
motions of about the same length, every sample of a batch has the same weight, and checkpoints are chosen on validation
clips.
"""
    page += "\n| recipe | what it reproduces |\n|---|---|\n"
    for name in sorted(recipes(), key=lambda name: ("/" in name, name)):
        what, deviations = head(name)
        what = re.sub(
            r"(Kim|Tevet|Hu) et al\., (AAAI |ICLR )?\d{4}, arXiv:[\d.]+(, )?", "", what
        ).replace(" ()", "")
        what = re.sub(
            r" (Not a (row of (the|a) paper|benchmark row)|Trains in [\w ']+)\.", "", what
        )
        deviations = re.sub(
            r"^Deviations(:| from)\s*", lambda m: "" if m[1] == ":" else "from ", deviations
        )
        if ", table" not in what:
            what = re.split(r"(?<!al)\. ", what)[0].rstrip(".") + "."
        folded = f" <details><summary>deviations</summary>{deviations}</details>"
        page += f"| `{name}` | {what}{folded * (', table' in what and bool(deviations))} |\n"
    return page


def published_tables() -> dict[str, dict[str, dict[str, Any]]]:
    """Returns the papers' hyperparameters: title -> recipe -> dotted key -> value; None = not in the paper."""
    published = read_yaml(PUBLISHED)
    tables = {}
    for page in published["hyperparameters"]["pages"]:
        columns = {name: dict(values) for name, values in page["recipes"].items()}
        for table in page.get("tables", []):
            for part_name, part in load_spec(table)["parts"].items():
                for row in published[table][part_name]["rows"]:
                    for column, text in row["values"].items():
                        columns[part["recipes"][column]][part["keys"][row["label"]]] = printed(text)
        tables[page["title"]] = columns
    return tables


def printed(text: str) -> Any:
    """Returns the value of a printed text: 1,000 is a number, "0.9, 0.999" two numbers."""
    if ", " in text:
        return tuple(map(printed, text.split(", ")))
    number = text.removesuffix(" words").replace(",", "")
    return int(number) if number.isdecimal() else float(number) if number[0].isdecimal() else text


TABLES = published_tables()

DEVIATIONS = {
    ("humanml3d/mdm_unet", "parameters"): "no code is public; the widths are chosen to come close"
}
"""Deviations of recipes from their papers, by (recipe, key), with the reason."""


def same(ours: Any, papers: Any) -> bool:
    """Returns whether a value agrees with the paper's, to the paper's digits."""
    if isinstance(papers, float) and isinstance(ours, float):
        ours = round(ours, len(f"{papers}".partition(".")[2]) if papers > 1 else 12)
    return ours == papers


def hyperparameters_page() -> str:
    page = f"""# Hyperparameters

{HEAD}
Values of the recipes. Bold: the paper gives the same value. If the two differ, both are shown. The other values are not
in the papers; most come from the authors' code. "–": the recipe has no such value. Where a paper names only the kind
of a text encoder (MFM: CLIP, T5; MDM: sentence-BERT), the checkpoint is our choice.
"""
    for title, published in TABLES.items():
        columns = {name: hyperparameters(name) for name in published}
        rows = [
            key for key in HYPERPARAMETERS if any(key in papers for papers in published.values())
        ]
        cells = {
            key: [_cell(ours.get(key), published[name].get(key)) for name, ours in columns.items()]
            for key in rows
        }
        equal = [key for key in rows if all(cell.startswith("**") for cell in cells[key])]
        shared = (
            HYPERPARAMETERS[key] + f" {cells[key][0]}" * (len(set(cells[key])) == 1)
            for key in equal
        )
        page += f"\n## {title}\n\n" + f"As in the paper: {'; '.join(shared)}.\n" * bool(equal)
        if equal != rows:
            page += f"\n| | {' | '.join(f'`{name}`' for name in columns)} |\n|---|{'---|' * len(columns)}\n"
        page += "".join(
            f"| {HYPERPARAMETERS[key]} | {' | '.join(cells[key])} |\n"
            for key in rows
            if key not in equal
        )
    page += "\n## Deviations from the papers\n\n"
    for (name, key), reason in DEVIATIONS.items():
        page += f"- `{name}`, {HYPERPARAMETERS[key]}: {reason}.\n"
    return (
        page
        + "\n[Recipes](recipes.md) lists deviations that the tables of the papers do not cover.\n"
    )


def _cell(ours: Any, papers: Any) -> str:
    if papers is not None and same(ours, papers):
        return f"**{setting_text(papers)}**"
    text = "–" if ours is None else setting_text(ours)
    return text if papers is None else f"{text} (paper: {setting_text(papers)})"


PAGES = {"recipes.md": recipes_page, "hyperparameters.md": hyperparameters_page}

if __name__ == "__main__":
    for name, write in PAGES.items():
        (Path(__file__).parent / name).write_text(write())
