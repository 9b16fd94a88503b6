"""Prepares a data set: `flame-mdm prepare data=bandai source=/path/to/the/archive`"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from flame_mdm.config import EXPERIMENTS, Config, instantiate, run
from flame_mdm.errors import UserError, say

USAGE = """
usage: flame-mdm prepare data=NAME [source=PATH] [representation=NAME] [check|verify|force=true]

Turns a data set, as its owners hand it out, into a packed store under data/. `check=true` only tells what is there to
prepare and what is missing; `verify=true` checks an existing store; `force=true` writes it anew.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    words = sys.argv[1:] if argv is None else argv
    return run(prepare, words, usage=USAGE, name="prepare", objects=("data",), text=("source",))


def prepare(config: Config) -> None:
    """Writes or verifies the store of a data set.

    Raises:
        UserError: no data set named. FileNotFoundError, ValueError: the raw data is absent or damaged.
    """
    if "data" not in config:
        names = sorted(path.stem for path in (EXPERIMENTS / "data").glob("*.yaml"))
        raise UserError(f"which data set? data=NAME, one of: {', '.join(names)}")
    node = config["data"]
    if config["source"] is not None:
        if "path" not in node["source"]:
            raise UserError(f"{node['name']} needs no source: it is made from nothing")
        node["source"]["path"] = str(config["source"])

    from flame_mdm.data.store import write_store
    from flame_mdm.data.verify import lines, report

    representation = instantiate(config["representation"])
    data = instantiate(node, representation=representation)
    if config["check"]:
        say(*data.source.check())
        return
    if config["verify"]:
        found = report(data)
        say(*lines(found))
        differ = [
            f"{f['found']} {name}, not {f['published']}"
            for name, f in found["figures"].items()
            if f["state"] == "differs"
        ]
        if differ:
            say(f"DIFFERS from the published figures: {'; '.join(differ)}")
        say(f"{data.folder}: whole, every hash is the recorded one; the report is in verify.json")
        return
    if (data.folder / "store.json").exists() and not config["force"]:
        store = data.open()
        say(f"{data.folder}: already prepared (force=true rewrites it, verify=true checks it)")
    else:
        store = write_store(data.folder, data.source, representation)
    info = store.info
    clips = ", ".join(f"{count} {split}" for split, count in info["clips"].items())
    say(f"{info['dataset']} as {info['representation']} at {info['fps']:g} fps: {clips}; {info['hours']} hours")
    if info["excluded"]:
        say("left out: " + ", ".join(f"{count} {reason}" for reason, count in info["excluded"].items()))
    say(f"{info['shape'][0]} frames of {info['shape'][1]} features, fingerprint {store.fingerprint}: {data.folder}")


if __name__ == "__main__":
    sys.exit(main())
