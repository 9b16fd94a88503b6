"""`flame-mdm prepare DATA`: prepares a data set, or verifies a prepared one."""

from __future__ import annotations

from functools import partial

from flame_mdm.commands import data_node
from flame_mdm.config import Config, instantiate, run
from flame_mdm.errors import say

USAGE = """
usage: flame-mdm prepare data=NAME [source=PATH] [representation=NAME] [check|verify|force=true]

Converts a data set, as distributed by its owners, into a packed store under data/. `check=true` only lists the files
that were found and those that are missing; `verify=true` checks an existing store; `force=true` rewrites it.
"""


def prepare(config: Config) -> None:
    """Writes or verifies the store of a data set.

    Raises:
        UserError: If no data set is named, or the data set takes no source.
        FileNotFoundError, ValueError: If the raw data is missing or damaged.
    """
    node = data_node(config)

    from flame_mdm.data.store import write_store
    from flame_mdm.data.verify import deviations, lines, report

    representation = instantiate(config["representation"])
    data = instantiate(node, representation=representation)
    if config["check"]:
        say(*data.source.check())
        return
    if config["verify"]:
        found = report(data)
        say(*lines(found))
        if differ := deviations(found):
            say("DIFFERS from the published figures:", *(f"  {line}" for line in differ))
        say(f"{data.folder}: complete, every hash matches; the report is in verify.json")
        return
    if (data.folder / "store.json").exists() and not config["force"]:
        store = data.open()
        say(f"{data.folder}: already prepared (force=true rewrites it, verify=true checks it)", *data.changed())
    else:
        store = write_store(data.folder, data.source, representation)
        say(*data.source.findings())
    info = store.info
    say(f"{info['dataset']} as {info['representation']} at {info['fps']:g} fps; {info['hours']} hours")
    say(*data.counts(store))
    if info["excluded"]:
        say("excluded: " + ", ".join(f"{count} {reason}" for reason, count in info["excluded"].items()))
    say(f"{info['shape'][0]} frames with {info['shape'][1]} features, fingerprint {store.fingerprint}: {data.folder}")


main = partial(run, prepare, usage=USAGE, name="prepare", objects=("data",), text=("source",))
