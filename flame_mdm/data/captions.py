"""Caption tables written by users: `captions.csv`, with one line per caption."""

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
SPLITTABLE = 10  # with this many motions or more, each split has at least one motion


def table_rows(
    path: Path, columns: Collection[str] = COLUMNS
) -> Iterator[tuple[str, dict[str, str]]]:
    """Yields each row of a caption table as a pair.

    The pair consists of the row's location (file and line), for error messages, and a dictionary
    that maps each column to its cell.

    Raises:
        UserError: If the table is damaged, has no column `id`, or has a column that is not in
            `columns`.
    """
    rows = csv.DictReader(
        io.StringIO(read_text(path).removeprefix("\ufeff"), newline=""), strict=True
    )
    with naming(path, csv.Error, prefix="damaged: "):
        names = list(rows.fieldnames or ())
        if "id" not in names or len(names) > len(set(names) & set(columns)):
            raise UserError(
                f"its columns are {str(names)[:200]}. Use only {', '.join(columns)}; id is required"
            )
        for row in rows:
            where = f"{path}, line {rows.line_num}"
            if None in row or None in row.values():
                raise UserError(
                    f"{where}: the row must have one cell per column. Put quotes around text that contains a comma"
                )
            yield where, {name: cell.strip() for name, cell in row.items()}


def known_split(split: str) -> Split:
    """Returns `split` if it is the name of a split. Raises `UserError` otherwise."""
    for name in SPLITS:
        if split == name:
            return name
    raise UserError(f"unknown split {split!r}. Use one of {', '.join(SPLITS)}")


def drawn_splits(
    sources: Mapping[str, str], stated: Mapping[str, Split | None]
) -> dict[str, Split]:
    """Returns the split of each motion, drawing the splits that the table does not specify.

    Splits are drawn with a hash of the source, so that all motions from the same source are in the
    same split. If no motion is drawn for training, the source with the highest hash in the largest
    split is moved to training. If there are at least `SPLITTABLE` motions, empty val and test
    splits also receive a source in this way.

    Args:
        sources: maps the name of each motion to its source.
        stated: maps the name of each motion to its split, or to None if the table does not specify
            one.
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
