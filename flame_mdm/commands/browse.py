"""`flame-mdm browse DATA`: shows a prepared data set as a web page."""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import partial
from glob import escape
from pathlib import Path

from flame_mdm.commands import data_node
from flame_mdm.config import EXPERIMENTS, Config, instantiate, run
from flame_mdm.errors import UserError, say
from flame_mdm.reporting.browse import choose, find, write_clips, write_page
from flame_mdm.safe_io import read_yaml

USAGE = """
usage: flame-mdm browse data=NAME [source=PATH] [split=train] [search="waves left"] [clips=200] [out=FILE.html]
       flame-mdm browse data=NAME split=test clips=10 motions=FOLDER

NAME is a data set, as for `prepare`, or the name of your own prepared set (data.name).
Writes a single web page that opens from disk. It shows clips of a data set with their captions, mirrored copies next
to their originals, a search field, a choice of splits, the distribution of clip lengths and other statistics.
motions=FOLDER also writes the shown clips as motion files, to compare generated motions with them.
"""

STORE = "store.json"


def browse(config: Config) -> None:
    """Prepares the data set if needed, and writes the page.

    Raises:
        UserError: If no data set is named, no clip matches, or the folder `motions` holds other motions.
        FileNotFoundError, ValueError: If the raw data is missing or damaged.
    """
    node = data_node(config)
    if config["clips"] < 1:
        raise UserError(f"clips={config['clips']}: must be at least 1")

    from flame_mdm.data.store import Store
    from flame_mdm.visualize.bodies import load_body

    body = load_body(config["body"])
    representation = instantiate(config["representation"])
    data = instantiate(node, representation=representation)
    if (data.folder / STORE).exists() and data.source.named_by_recipe:
        data.source.options = Store(data.folder).info.get("source", {})  # own data are shown as they were prepared
        if config["source"] is not None:
            say(f"{data.folder}: already prepared; source={config['source']} is not read (prepare it with force=true)")
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
    write_page(out, store, representation, clips, title, body)
    say(f"{out}: {len(clips)} of {matching} clips, {out.stat().st_size / 1e6:.1f} MB")
    say(*data.counts(store))
    if config["motions"] is not None:
        write_clips(Path(config["motions"]), store, representation, clips, data.crop.longest())
        say(f"{config['motions']}: {len(clips)} motions")


def prepared(words: Sequence[str]) -> list[str]:
    """Replaces `data=NAME`, where NAME is a prepared set of the user's own motions, by the keys of that set.

    Raises:
        UserError: If NAME was prepared in several representations and none is chosen.
    """
    given = dict(word.split("=", 1) for word in words if "=" in word)
    name, root = given.get("data", ""), Path(given.get("data_root", os.environ.get("FLAME_MDM_DATA", "data")))
    if not name or (EXPERIMENTS / "data" / f"{name}.yaml").exists() or not any(root.glob(f"{escape(name)}-*/{STORE}")):
        return list(words)
    files = sorted((EXPERIMENTS / "representation").glob("*.yaml"))
    found = [p.stem for p in files if (root / f"{name}-{instantiate(read_yaml(p)).name}" / STORE).exists()]
    if "representation" in given:
        found = []
    if len(found) > 1:
        raise UserError(f"data={name} was prepared as {' and as '.join(found)}. Add representation={found[0]}")
    rest = [word for word in words if word != f"data={name}"]
    return ["data=folder", f"data.name={name}", *(f"representation={option}" for option in found), *rest]


main = partial(
    run,
    browse,
    usage=USAGE,
    name="browse",
    objects=("data", "out"),
    text=("search", "source", "data.name", "out", "motions", "body"),
    rewrite=prepared,
)
