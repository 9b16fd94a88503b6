"""Tables of captions that users write: `captions.csv`, one line per caption."""

import csv
import io
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path

from flame_mdm.data import SPLITS, Split, hashed_split, name_hash
from flame_mdm.errors import UserError
from flame_mdm.safe_io import naming, read_text

TABLE = "captions.csv"
COLUMNS = ("id", "text", "action", "split", "source", "license")
SPLITTABLE = 10  # with this number of motions, each split has at least one


def table_rows(
    path: Path, columns: Collection[str] = COLUMNS
) -> Iterator[tuple[str, dict[str, str]]]:
    """Yields the rows of a table of captions: file and line, for errors, and the cells by column.

    Raises `UserError` if the table is damaged, has no column `id`, or has a column that is not in
    `columns`.
    """
    rows = csv.DictReader(
        io.StringIO(read_text(path).removeprefix("\ufeff"), newline=""), strict=True
    )
    with naming(path, csv.Error, prefix="damaged: "):
        names = list(rows.fieldnames or ())
        if "id" not in names or len(names) > len(set(names) & set(columns)):
            raise UserError(
                f"its columns are {str(names)[:200]}; use {', '.join(columns)} (only id is required)"
            )
        for row in rows:
            where = f"{path}, line {rows.line_num}"
            if None in row or None in row.values():
                raise UserError(
                    f"{where}: not one cell per column; put texts that contain a comma in quotes"
                )
            yield where, {name: cell.strip() for name, cell in row.items()}


def known_split(split: str) -> Split:
    """Returns `split` if it is the name of a split; raises `UserError` otherwise."""
    for name in SPLITS:
        if split == name:
            return name
    raise UserError(f"unknown split {split!r}; use {', '.join(SPLITS)}")


def drawn_splits(
    sources: Mapping[str, str], stated: Mapping[str, Split | None]
) -> dict[str, Split]:
    """Returns the split of each motion: the split in the table, else one drawn by a hash of the
    source.

    All motions of a source stay in one split. If no motion is drawn for training, the source with
    the highest hash moves there from the split with the most sources. With `SPLITTABLE` or more
    motions, val and test are filled in the same manner.

    Args:
        sources: name of each motion -> its source.
        stated: name of each motion -> its split in the table, or None.
    """
    of_sources: dict[str, Split] = {sources[name]: split for name, split in stated.items() if split}
    free = sorted(set(sources.values()) - set(of_sources))
    drawn: dict[str, Split] = {source: hashed_split(source, val=5, test=10) for source in free}
    for split in SPLITS if len(sources) >= SPLITTABLE else SPLITS[:1]:
        if split not in {*of_sources.values(), *drawn.values()}:
            sizes = Counter(drawn.values())
            most = max(sizes.values(), default=0)
            if movable := [
                source for source in drawn if sizes[drawn[source]] == most > (split != "train")
            ]:
                drawn[max(movable, key=name_hash)] = split
    of_sources |= drawn
    return {name: stated[name] or of_sources[source] for name, source in sources.items()}
