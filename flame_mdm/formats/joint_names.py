"""Names of a character's joints: those of a known skeleton, or of a `.yaml` file next to the character."""

import json
from collections.abc import Mapping
from pathlib import Path

from flame_mdm.errors import UserError, did_you_mean
from flame_mdm.formats.layouts import LAYOUTS
from flame_mdm.formats.retarget import joint_names, presets
from flame_mdm.formats.rig import matched, plain, recognized
from flame_mdm.safe_io import read_yaml
from flame_mdm.visualize.posture import JOINT


class UnknownJoints(UserError):
    """Some joints could not be identified; `template` has the lines of a file of names, to be completed by the user."""

    def __init__(self, message: str, template: list[str]):
        super().__init__(message)
        self.template = template


def identify(path: Path, names: Mapping[int, str]) -> dict[str, int]:
    """Returns the numbers of the joints that correspond to SMPL's, among numbers -> names of a character.

    A file of the character's name that ends in .yaml may list the names.

    Raises:
        UserError: If the file of names is invalid, or a joint is there twice.
        UnknownJoints: If required joints are missing.
    """
    listed = path.with_suffix(".yaml")
    chosen = read_yaml(listed) if listed.exists() else None
    candidates = _listed(path, listed, chosen, names) if chosen else recognized(names, known_skeletons())
    numbers, missing = matched(path, names, candidates)
    if twice := next((joint for joint, number in numbers.items() if list(numbers.values()).count(number) > 1), None):
        raise UserError(f"{listed}: {names[numbers[twice]]} is listed for {twice} and for another joint. Remove one")
    if missing:
        own = {joint: f" {json.dumps(names[number])}" for joint, number in numbers.items()}
        template = [f"# Joints of {path.name}: {', '.join(names.values())}"]
        template += [f"{joint}:{own.get(joint, '')}" for joint in JOINT]
        raise UnknownJoints(
            f"{path}: no joint found for {', '.join(missing)}. Write the names of the joints into {listed}, as in the "
            "lines above; only spine, neck, head, collars and feet may stay empty",
            template,
        )
    return numbers


def _listed(path: Path, listed: Path, chosen: object, names: Mapping[int, str]) -> dict[str, list[int]]:
    """Returns the numbers of the joints that a file of names lists."""
    if not isinstance(chosen, dict) or not all(isinstance(name, str | None) for name in chosen.values()):
        raise UserError(f"{listed}: not a list of names, each on a line such as `left_knee: Calf L`")
    if unknown := next((joint for joint in chosen if joint not in JOINT), None):
        raise UserError(f"{listed}: {unknown} is no joint of SMPL.{did_you_mean(str(unknown), JOINT)}")
    candidates = {}
    for joint, name in chosen.items():
        if name is not None:
            candidates[joint] = [number for number, own in names.items() if own == name]
            if not candidates[joint]:
                similar = did_you_mean(name, names.values())
                raise UserError(f"{listed}: {joint}: {path} has no joint {name}.{similar}")
    return candidates


def known_skeletons() -> list[dict[str, str]]:
    """Returns the joints of known skeletons: `plain` name -> joint of SMPL."""
    skeletons = [*map(joint_names, presets().values()), LAYOUTS["SMPL"].map, LAYOUTS["Bandai-Namco"].map]
    return [{plain(name): joint for joint, name in map.items() if isinstance(name, str)} for map in skeletons]
