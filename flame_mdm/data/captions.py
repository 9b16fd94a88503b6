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
SPLITTABLE = 10  # number of motions from which on each split has at least one


def table_rows(
    path: Path, columns: Collection[str] = COLUMNS
) -> Iterator[tuple[str, dict[str, str]]]:
    """Yields file and line, for errors, and the cells by column of each row of a table of captions.

    Raises `UserError` if the table is damaged, or has other `columns` than these, of which only `id` is required.
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
    """Returns the name of a split in a table; raises `UserError` if there is no such split."""
    for name in SPLITS:
        if split == name:
            return name
    raise UserError(f"unknown split {split!r}; use {', '.join(SPLITS)}")


def drawn_splits(
    sources: Mapping[str, str], stated: Mapping[str, Split | None]
) -> dict[str, Split]:
    """Returns the split of each motion: the stated one, else one drawn by a hash of the source.

    An empty training split, and in a set of `SPLITTABLE` or more motions any empty split, gets the source with the
    highest hash from the split with the most sources. All motions of a source stay in one split.

    Args:
        sources: name of each motion -> its source.
        stated: name of each motion -> its split in the table; None = none.
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
