"""`flame-mdm prepare DATA`: prepares a data set, or verifies a prepared one."""

from dataclasses import dataclass
from typing import ClassVar

from flame_mdm.commands import STORE, DataSettings
from flame_mdm.config import instantiate
from flame_mdm.config.options import option
from flame_mdm.errors import say


@dataclass(frozen=True, kw_only=True)
class PrepareSettings(DataSettings):
    """usage: flame-mdm prepare data=NAME [source=PATH] [representation=NAME] [check|verify|force=true]

    Converts the original files of a data set into a packed store in data/. `check=true` only lists
    which of these files exist and which are missing, `verify=true` checks an existing store, and
    `force=true` rewrites it.
    """

    OBJECTS: ClassVar = ("data",)
    source: str | None = option(None, "source folder or archive, required by some data sets")
    check: bool = option(False, "only list which files exist and which are missing")
    verify: bool = option(False, "only check an existing store and report on it")
    force: bool = option(False, "rewrite an existing store")


def main(settings: PrepareSettings) -> None:
    """Writes a data set's store or checks its files, and prints a report."""
    node = settings.data_node(settings.source)

    from flame_mdm.data.store import write_store
    from flame_mdm.data.verify import deviations, lines, report

    representation = instantiate(settings.nodes["representation"])
    data = instantiate(node, representation=representation)
    if settings.check:
        data.source.suit(representation)
        say(*data.source.check(representation.fps))
        if data.source.failures:
            raise SystemExit(1)
        return
    if settings.verify:
        checked = report(data)
        say(*lines(checked))
        if differ := deviations(checked):
            say("DIFFERS from the published numbers:", *(f"  {line}" for line in differ))
        say(f"{data.folder}: complete, and every hash matches. The report is in verify.json")
        return
    if (data.folder / STORE).exists() and not settings.force:
        store = data.open()
        say(f"{data.folder}: already prepared (force=true rewrites it, verify=true checks it)")
        say(*data.source.changed(data.folder / STORE))
    else:
        store = write_store(data.folder, data.source, representation)
        say(*data.source.findings())
    info = store.info
    say(
        f"{info['dataset']} as {info['representation']} at {info['fps']:g} fps; {info['hours']} hours"
    )
    say(*data.counts(store))
    if info["excluded"]:
        say(
            "excluded: "
            + ", ".join(f"{count} {reason}" for reason, count in info["excluded"].items())
        )
    size = f"{info['shape'][0]} frames with {info['shape'][1]} features"
    say(f"{size}, fingerprint {store.fingerprint}: {data.folder}", *data.source.failure_lines())
    if data.source.failures:
        raise SystemExit(1)
