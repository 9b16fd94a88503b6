"""Writes the generated pages of the docs, and draws the parts of the code as a house: `make docs`.

The pages are recipes.md, hyperparameters.md and memory.md, which are generated from the recipes.
"""

import ast
import re
import textwrap
from collections.abc import Mapping
from functools import cache
from html import escape
from itertools import takewhile
from pathlib import Path
from typing import Any

from flame_mdm.config import EXPERIMENTS, compose, recipes
from flame_mdm.reporting.tables.settings import HYPERPARAMETERS, hyperparameters, setting_text
from flame_mdm.reporting.tables.specs import PUBLISHED, load_spec
from flame_mdm.safe_io import read_yaml
from flame_mdm.training.memory import training_memory

HEAD = "<!-- Written by docs/generate.py; do not edit. -->\n"


def head(name: str) -> tuple[str, str]:
    """Returns the two parts of a recipe's head comment: what it reproduces (paper, table, row), and its deviations."""
    lines = (EXPERIMENTS / f"{name}.yaml").read_text().splitlines()[1:]
    comment = " ".join(
        line.removeprefix("#").strip()
        for line in takewhile(lambda line: line.startswith("#"), lines)
    )
    what, _, deviations = comment.partition("Deviations")
    return what.strip(), ("Deviations" + deviations if deviations else "")


def _wide(width: int, layers: int) -> list[str]:
    """Returns the overrides for a network of this width and depth, with feed-forward layers four times as wide."""
    sizes = {"latent_dim": width, "ff_size": 4 * width, "num_layers": layers}
    return [f"denoiser.{name}={size}" for name, size in sizes.items()]


def recipes_page() -> str:
    page = f"""# Recipes

{HEAD}
This project reproduces three papers: FLAME (Kim et al., AAAI 2023, arXiv:2209.00349), MDM (Tevet et al., ICLR 2023,
arXiv:2209.14916) and Motion Flow Matching (Hu et al., 2023, arXiv:2312.08895). Every table row that a paper reports for
its own model has a recipe, such as `make train EXP=humanml3d/mdm`. If the description of a recipe mentions no table,
the recipe does not correspond to a row in any paper. The file of each recipe lists the deviations from the paper. "As
in humanml3d/mdm" means that all deviations listed for that recipe also apply. Three deviations apply to all recipes: a
batch contains motions of about the same length, every sample in a batch has the same weight, and checkpoints are
selected on validation clips.
"""
    page += "\n| recipe | what it reproduces |\n|---|---|\n"
    for name in sorted(recipes(), key=lambda name: ("/" in name, name)):
        what, deviations = head(name)
        what = re.sub(
            r"(Kim|Tevet|Hu) et al\., (AAAI |ICLR )?\d{4}, arXiv:[\d.]+(, )?", "", what
        ).replace(" ()", "")
        deviations = re.sub(
            r"^Deviations(:| from)\s*", lambda m: "" if m[1] == ":" else "from ", deviations
        )
        if ", table" not in what:
            what = re.split(r"(?<!al)\. ", what)[0].rstrip(".") + "."
        folded = f" <details><summary>deviations</summary>{deviations}</details>"
        page += f"| `{name}` | {what}{folded * (', table' in what and bool(deviations))} |\n"
    return page


def published_tables() -> dict[str, dict[str, dict[str, Any]]]:
    """Returns the papers' hyperparameters: title -> recipe -> dotted key -> value (None: not in the paper)."""
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
    """Parses a value as printed in a paper. For example, "1,000" is a number, and "0.9, 0.999" is two numbers."""
    if ", " in text:
        return tuple(map(printed, text.split(", ")))
    number = text.removesuffix(" words").replace(",", "")
    return int(number) if number.isdecimal() else float(number) if number[0].isdecimal() else text


TABLES = published_tables()

DEVIATIONS = {
    (
        "humanml3d/mdm_unet",
        "parameters",
    ): "the code is not public; the widths are chosen so that the number of parameters is "
    "close to the paper's"
}
"""Hyperparameters that deviate from the papers: (recipe, key) -> reason."""


def same(ours: Any, papers: Any) -> bool:
    """Returns whether our value equals the paper's value after rounding to the paper's number of digits."""
    if isinstance(papers, float) and isinstance(ours, float):
        ours = round(ours, len(f"{papers}".partition(".")[2]) if papers > 1 else 12)
    return ours == papers


def hyperparameters_page() -> str:
    page = f"""# Hyperparameters

{HEAD}
The tables show the values in the recipes. A value is bold if the paper states the same value. If the paper states a
different value, both values are shown. The remaining values do not appear in the papers; most of them come from the
authors' code. "–" means that the recipe has no such value. If a paper names only the type of a text encoder (CLIP and
T5 in MFM's paper, sentence-BERT in MDM's paper), we chose the checkpoint.
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
        equal = [
            key for key in rows if len(set(cells[key])) == 1 and cells[key][0].startswith("**")
        ]
        shared = (f"{HYPERPARAMETERS[key]} {cells[key][0]}" for key in equal)
        page += f"\n## {title}\n" + f"\nAs in the paper: {'; '.join(shared)}.\n" * bool(equal)
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


ROOT = Path(__file__).parent.parent
FLOOR = "config"  # the room in the picture that represents all parts on the ground
ROOM, GAP, STOREY, MARGIN = (168, 58), 22, 104, 30  # pixels
PACKAGES = {"__init__": "flame_mdm", "__main__": "flame-mdm"}
"""Names in the picture that differ from the module names."""
ROOMS = {
    "representations": (0, "motions as features, and back"),
    "schemas": (1, "typed schemas of files"),
    "denoisers": (2, "networks: FLAME, MDM's five backbones, DiP"),
    "processes": (3, "diffusion, flow matching, samplers"),
    "conditions": (4, "texts and actions as vectors"),
    "visualize": (0, "players, pictures, videos"),
    "records": (1.9, "result files of evaluations"),
    "generator": (3, "a model made of four parts, and sampling from it"),
    "formats": (0, "motion files, cleanup, characters"),
    "runs": (1.9, "run directories"),
    "data": (0.5, "data sets, stores, batches"),
    "reporting": (1.6, "reports, comparisons, tables"),
    "task": (3, "Lightning modules: training of a model"),
    "sampling": (3, "requests, edits, sequences, streams, referee"),
    "checkpoints": (4, "model files, released weights, ONNX"),
    "training": (2.2, "callbacks, safeguards, distillation, adapters"),
    "demo": (4, "the page in the browser"),
    "__init__": (1, "the Python API"),
    "evaluators": (2.2, "protocols, metrics, extractors, audits"),
    "commands": (3.1, "one module per command"),
    "__main__": (3.1, "the command line"),
}
"""Column and description of each room in the picture. The columns are chosen so that no line crosses a room."""


def import_rules() -> tuple[dict[str, set[str]], set[str]]:
    """Reads the rules in the architecture test.

    Returns:
        The parts of the code that each part may import, and the parts "on the ground", which all parts
        may import.
    """
    tree = ast.parse((ROOT / "tests" / "test_architecture.py").read_text(encoding="utf-8"))
    values: dict[str, Any] = {}
    for node in tree.body:
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
            target = node.targets[0] if isinstance(node, ast.Assign) else node.target
            if isinstance(target, ast.Name) and target.id in {
                "AXES",
                "GROUND",
                "MODELS",
                "ALL",
                "MAY_IMPORT",
            }:
                code = compile(ast.Expression(node.value), "rules", "eval")
                values[target.id] = eval(code, dict(values))
    return values["MAY_IMPORT"], values["GROUND"]


def storeys(rules: Mapping[str, set[str]]) -> list[list[str]]:
    """Returns the rooms on each storey, from the bottom up. Each room is above all rooms that it may import."""

    @cache
    def height(name: str) -> int:
        return max((height(other) + 1 for other in rules[name]), default=0)

    return [
        [name for name in rules if height(name) == level]
        for level in range(max(map(height, rules)) + 1)
    ]


def stairs(rules: Mapping[str, set[str]]) -> list[tuple[str, str]]:
    """Returns the imports to draw as lines, as pairs (importing room, imported room).

    An import from A to C is omitted if A may import B and B may import C.
    """

    @cache
    def below(name: str) -> frozenset[str]:
        return frozenset(rules[name]).union(*(below(other) for other in rules[name]))

    return [
        (name, other)
        for name in rules
        for other in sorted(rules[name])
        if not any(other in below(between) for between in rules[name] - {other})
    ]


def house() -> str:
    """Draws the parts of the code as rooms in a house, in SVG. Lines lead down to the rooms that a room may import."""
    rules, ground = import_rules()
    # The parts on the ground, which all others may import, are drawn as one wide room.
    merged = {
        name: {FLOOR if other in ground else other for other in others} - {name}
        for name, others in rules.items()
        if name not in ground
    } | {FLOOR: set()}
    levels = storeys(merged)
    width = (
        int(max(column for column, _ in ROOMS.values()) + 1) * (ROOM[0] + GAP) - GAP + 2 * MARGIN
    )
    top = 120
    height = top + len(levels) * STOREY + 20
    places = {}
    for number, level in enumerate(levels):
        y = top + (len(levels) - 1 - number) * STOREY + (STOREY - ROOM[1]) / 2
        for name in level:
            if name == FLOOR:
                places[name] = (MARGIN, y, width - 2 * MARGIN)
            else:
                places[name] = (MARGIN + ROOMS[name][0] * (ROOM[0] + GAP), y, ROOM[0])
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" '
        f'width="{width}" height="{height}" font-family="sans-serif">',
        f'<rect width="{width}" height="{height}" fill="#fff"/>',
        f'<path d="M{width / 2:g} 12L{width - 8} {top - 6}H8Z" fill="#b5544d"/>',
        f'<rect x="14" y="{top - 6}" width="{width - 28}" height="{height - top - 6}" '
        f'fill="#f6f1e7" stroke="#c9bfae"/>',
    ]
    for name, other in stairs(merged):
        x, y, across = places[name]
        x2, y2, across2 = places[other]
        begin = x + across / 2
        end = min(max(begin, x2 + 12), x2 + across2 - 12) if other == FLOOR else x2 + across2 / 2
        bottom = y + ROOM[1]
        middle = (bottom + y2) / 2
        parts.append(
            f'<path d="M{begin:g} {bottom:g}C{begin:g} {middle:g} {end:g} {middle:g} '
            f'{end:g} {y2:g}" fill="none" stroke="#8a93a3" stroke-width="1.4"/>'
        )
    for name, (x, y, across) in places.items():
        if name == FLOOR:
            title, lines = "the ground", [", ".join(sorted(ground))]
        else:
            title, lines = PACKAGES.get(name, name), textwrap.wrap(ROOMS[name][1], 28)
        parts.append(
            f'<rect x="{x:g}" y="{y:g}" width="{across:g}" height="{ROOM[1]}" rx="5" '
            f'fill="#fffdf8" stroke="#6b7585"/>'
        )
        parts.append(_line(x + across / 2, y + 19, title, 'font-size="14" font-weight="bold"'))
        parts += [
            _line(x + across / 2, y + 35 + 13 * row, line, 'font-size="10.5"')
            for row, line in enumerate(lines)
        ]
    return "\n".join([*parts, "</svg>"]) + "\n"


def _line(x: float, y: float, text: str, style: str) -> str:
    return f'<text x="{x:g}" y="{y:g}" text-anchor="middle" fill="#1f2733" {style}>{escape(text)}</text>'


SIZES: dict[str, tuple[str, list[str]]] = {
    "`humanml3d/mdm`": ("humanml3d/mdm", []),
    "`humanml3d/mdm_unet`": ("humanml3d/mdm_unet", []),
    "`humanml3d/mdm_gru`": ("humanml3d/mdm_gru", []),
    "`humanml3d/mdm_decoder`": ("humanml3d/mdm_decoder", []),
    "`humanml3d/dip`": ("humanml3d/dip", []),
    "`humanml3d/mfm`": ("humanml3d/mfm", []),
    "`humanml3d/flame`": ("humanml3d/flame", []),
    "`humanml3d/mdm`, 1024 wide, 16 layers": ("humanml3d/mdm", _wide(1024, 16)),
    "`humanml3d/mdm`, 2048 wide, 24 layers": ("humanml3d/mdm", _wide(2048, 24)),
}
"""Rows of the table in memory.md: label -> recipe and overrides."""

MEMORY = """# Memory for training

{head}
The table below is computed from the recipes. Sizes are in GiB per process and assume float32, the recipe's batch size
and motions of the recipe's maximum length. The state consists of the weights, their gradients, Adam's two states and,
if the recipe averages weights, the averaged weights. The size of the state does not depend on the batch size.
Activations are the tensors that the forward pass keeps for the backward pass. The size of the activations grows with
`data.batch_size`. On a GPU, `speed=fast` halves this size. Frozen text encoders are not included, because they are not
on the device during training. Libraries and kernels require additional memory.

| model | parameters, M | batch | state | activations | with `task.checkpoint_activations` |
|---|---:|---:|---:|---:|---:|
{rows}

The wide models override `denoiser.latent_dim`, `denoiser.ff_size` (four times the width) and `denoiser.num_layers`.

[GPUs and clusters](clusters.md#larger-models) explains what to do if a model does not fit into memory.
"""


def memory_page() -> str:
    """Returns the contents of memory.md: the memory for training the recipes in `SIZES`."""
    rows = []
    for label, (recipe, words) in SIZES.items():
        config = compose(recipe, words)
        need = training_memory(config)
        sizes = [need.state, need.activations, need.recomputed]
        cells = [label, f"{need.parameters / 1e6:.1f}", str(config["data"]["batch_size"])]
        cells += [f"{size / 2**30:.2f}" for size in sizes]
        rows.append(f"| {' | '.join(cells)} |")
    return MEMORY.format(head=HEAD, rows="\n".join(rows))


PAGES = {
    "memory.md": memory_page,
    "recipes.md": recipes_page,
    "hyperparameters.md": hyperparameters_page,
    "assets/house.svg": house,
}

if __name__ == "__main__":
    for name, write in PAGES.items():
        (Path(__file__).parent / name).write_text(write())
