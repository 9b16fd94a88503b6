"""Several data sets combined into one. Every clip keeps the license of its data set."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Literal

from flame_mdm.data import Clip, MotionSource
from flame_mdm.errors import UserError
from flame_mdm.representations import Representation
from flame_mdm.safe_io import read_package_yaml

Use = Literal["any", "research"]


@cache
def known_licenses() -> dict[str, dict[str, str]]:
    """Returns the permitted `use` and the `terms` of each license in `licenses.yaml`."""
    return read_package_yaml(Path(__file__).with_name("licenses.yaml"))


class Mixture(MotionSource):
    """The clips of several data sets, one data set after the other.

    Args:
        parts: the data sets, each with a name of your choice.
        use: purpose of the trained model. With "any", a data set is rejected if it contains motions
            whose license is unknown or permits only research. With "research", all data sets are
            accepted.
    """

    name = "mixture"
    named_by_recipe = True
    # Increase this number whenever the version of any data set increases, because a mixture then
    # also reads the motions of that data set differently
    version = 1

    def __init__(self, parts: Mapping[str, MotionSource], use: Use = "any"):
        if not parts:
            raise UserError("data.source.parts is empty. Specify at least one data set")
        if use not in ("any", "research"):
            raise UserError(f"data.source.use={use!s:.40}: unknown value. Use any or research")
        self.parts, self.use = dict(parts), use
        self.verbs = tuple(sorted({verb for part in parts.values() for verb in part.verbs}))
        self.options = {
            "use": use,
            "parts": {name: dict(part.options) for name, part in self.parts.items()},
        }

    def count(self) -> int:
        """Returns the total number of clips in all parts.

        Raises:
            UserError: If a license forbids the use that is specified in the recipe.
        """
        self.check_licenses()
        return sum(part.count() for part in self.parts.values())

    def licenses(self) -> set[str]:
        """Returns the licenses of all parts."""
        return {license for part in self.parts.values() for license in part.licenses()}

    def may_share_captions(self, license: str) -> bool:
        """Returns whether the license permits any use of the clip, including its captions."""
        return known_licenses().get(license, {}).get("use") == "any"

    def check_licenses(self) -> None:
        """Raises `UserError` if a license forbids the use that is specified in the recipe."""
        if self.use == "research":
            return
        for name, part in self.parts.items():
            for license in sorted(part.licenses()):
                if known_licenses().get(license, {}).get("use") == "any":
                    continue
                label = f"license {license}" if license else "an unknown license"
                raise UserError(
                    f"data.source.parts.{name} contains motions with {label}, but data.source.use=any. Leave them out, "
                    "or set data.source.use=research for a research-only model"
                )

    def clips(self, fps: float) -> Iterator[Clip]:
        """Yields the clips of all parts, one part after the other.

        Actions with the same name have the same label in all parts.
        """
        self.check_licenses()
        names: dict[str, int] = {}
        for part in self.parts.values():
            for clip in part.clips(fps):
                action = None
                if clip.action is not None:
                    # The actions of a folder are known only after its first clip has been read.
                    action = names.setdefault(part.actions[clip.action], len(names))
                yield replace(clip, action=action, license=clip.license or part.license)
            self.excluded.update(part.excluded)
        self.actions = tuple(names)
        self.failures = [line for part in self.parts.values() for line in part.failures]

    def findings(self) -> list[str]:
        """Returns the findings of all parts, each preceded by the name of its part."""
        return [f"{name}: {line}" for name, part in self.parts.items() for line in part.findings()]

    def failure_lines(self) -> list[str]:
        """Returns the failures of all parts as lines to print."""
        return [line for part in self.parts.values() for line in part.failure_lines()]

    def changed(self, store: Path) -> list[str]:
        """Returns one line for each part whose files have changed."""
        return [line for part in self.parts.values() for line in part.changed(store)]

    def suit(self, representation: Representation) -> None:
        """Configures each part for a representation."""
        for part in self.parts.values():
            part.suit(representation)

    def check(self, fps: float) -> list[str]:
        """Checks the licenses, and returns the file reports of all parts."""
        self.check_licenses()
        return [line for part in self.parts.values() for line in part.check(fps)]
