"""`flame-mdm browse DATA`: shows a prepared data set as a web page."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from flame_mdm.config import EXPERIMENTS, Config, instantiate, run
from flame_mdm.errors import UserError, say
from flame_mdm.reporting.browse import choose, find, write_clips, write_page

USAGE = """
usage: flame-mdm browse data=NAME [split=train] [search="waves left"] [clips=200] [out=FILE.html]
       flame-mdm browse data=NAME split=test clips=10 motions=FOLDER

Writes a single web page that opens from disk. It shows clips of a data set with their captions, mirrored copies next
to their originals, a search field, a choice of splits, the distribution of clip lengths and other statistics.
motions=FOLDER also writes the shown clips as motion files, to compare generated motions with them.
"""


def browse(config: Config) -> None:
    """Prepares the data set if needed, and writes the page.

    Raises:
        UserError: If no data set is named, no clip matches, or the folder `motions` holds other motions.
        FileNotFoundError, ValueError: If the raw data is missing or damaged.
    """
    if "data" not in config:
        names = sorted(path.stem for path in (EXPERIMENTS / "data").glob("*.yaml"))
        raise UserError(f"no data set named. Add data=NAME, one of: {', '.join(names)}")
    if config["clips"] < 1:
        raise UserError(f"clips={config['clips']}: must be at least 1")

    representation = instantiate(config["representation"])
    data = instantiate(config["data"], representation=representation)
    data.prepare_data()
    store = data.open()
    if config["split"] not in (None, *store.info["clips"]):
        raise UserError(f"no split is called {config['split']}. Available: {', '.join(store.info['clips'])}")
    search = "" if config["search"] is None else str(config["search"])
    families = find(store.clips, config["split"], search)
    if not families:
        raise UserError(f"no clip of {data.folder} has '{search}' in its id or captions. Search for other words")
    matching = sum(map(len, families))
    clips = [clip for family in choose(families, config["clips"]) for clip in family]
    title = f"{store.info['dataset']}: {len(clips)} of {matching} clips"
    title += f" in {config['split']}" * (config["split"] is not None) + f" with '{search}'" * bool(search)
    out = Path(config["out"] or Path("runs") / "browse" / f"{data.folder.name}.html")
    write_page(out, store, representation, clips, title)
    say(f"{out}: {len(clips)} of {matching} clips, {out.stat().st_size / 1e6:.1f} MB")
    say(*data.counts(store))
    if config["motions"] is not None:
        write_clips(Path(config["motions"]), store, representation, clips, data.crop.longest())
        say(f"{config['motions']}: {len(clips)} motions")


main = partial(run, browse, usage=USAGE, name="browse", objects=("data", "out"), text=("search", "out", "motions"))
