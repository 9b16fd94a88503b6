"""`flame-mdm browse DATA`: shows a prepared data set as a web page."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from flame_mdm.commands import STORE, BodySettings, DataSettings, above_zero
from flame_mdm.config import instantiate
from flame_mdm.config.options import option
from flame_mdm.data import Split
from flame_mdm.errors import UserError, say


@dataclass(frozen=True, kw_only=True)
class BrowseSettings(BodySettings, DataSettings):
    """usage: flame-mdm browse data=NAME [source=PATH] [split=train] [search="waves left"] [clips=200] [out=FILE.html]
           flame-mdm browse data=NAME split=test clips=10 motions=FOLDER

    Writes a single web page that can be opened from disk. It shows clips of the data set NAME with
    their captions, mirrored copies next to their originals, and statistics. It also has a search
    field and a split filter. motions=FOLDER also writes the shown clips as motion files, so that
    generated motions can be compared with them. Data sets are named as in `prepare`; for your own
    motions, use data=folder data.name=NAME.
    """

    OBJECTS: ClassVar = ("data", "out")
    out: str | None = option(None, "HTML file; default: runs/browse/<store>.html")
    source: str | None = option(
        None, "source folder or archive, required by some data sets if they are not prepared yet"
    )
    split: Split | None = option(None, "split: train, val or test; default: all")
    search: str | None = option(None, "words that must occur in the id or the captions of a clip")
    clips: int = option(
        200,
        "maximum number of clips, selected at even intervals; mirrored copies are shown with "
        "their originals",
        above_zero,
    )
    motions: str | None = option(
        None, "folder to which the shown clips are also written as motion files"
    )


def main(settings: BrowseSettings) -> None:
    """Writes a page with motions from a prepared data set."""
    node = settings.data_node(settings.source)

    from flame_mdm.data.store import Store
    from flame_mdm.reporting.browse import choose, find, write_clips, write_page

    body = settings.read_body()
    representation = instantiate(settings.nodes["representation"])
    data = instantiate(node, representation=representation)
    if (data.folder / STORE).exists() and data.source.named_by_recipe:
        info = Store(data.folder).info  # the user's own data is shown as it was prepared
        data.source.options, data.source.version = info.get("source", {}), info.get("version", 1)
        if settings.source is not None:
            say(
                f"{data.folder} is already prepared, so source={settings.source} is not read. To "
                f"read it, prepare the data set with force=true"
            )
    data.prepare_data()
    store = data.open()
    search = settings.search or ""
    families = find(store.clips, settings.split, search)
    if not families:
        raise UserError(
            f"no clip in {data.folder} has '{search}' in its id or captions. Search for other words"
        )
    matching = sum(map(len, families))
    clips = [clip for family in choose(families, settings.clips) for clip in family]
    title = f"{store.info['dataset']}: {len(clips)} of {matching} clips"
    if settings.split is not None:
        title += f" in {settings.split}"
    if search:
        title += f" with '{search}'"
    out = Path(settings.out or Path("runs") / "browse" / f"{data.folder.name}.html")
    write_page(out, store, representation, clips, title, body)
    say(f"{out}: {len(clips)} of {matching} clips, {out.stat().st_size / 1e6:.1f} MB")
    say(*data.counts(store))
    if settings.motions is not None:
        write_clips(Path(settings.motions), store, representation, clips, data.crop.longest())
        say(f"{settings.motions}: {len(clips)} motions")
