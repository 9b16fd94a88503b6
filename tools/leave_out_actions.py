"""Removes actions from the list of known actions in a model file, for instance because the model gets them wrong.

    python tools/leave_out_actions.py flame_mdm/models/package.safetensors waltz cry

Sentences about these actions are then rejected, and the actions with the nearest meanings are
suggested. Use the action names in `flame_mdm/conditions/language/actions.yaml`. The weights do not
change.
"""

import sys
from pathlib import Path

from flame_mdm.checkpoints.model_files import read_model_file, write_model_file
from flame_mdm.conditions.language.parsing import understand
from flame_mdm.conditions.language.tables import actions
from flame_mdm.errors import UserError, say


def main(path: Path, left_out: set[str]) -> None:
    unknown = left_out - actions().keys()
    if unknown:
        raise UserError(
            f"{', '.join(sorted(unknown))}: not in flame_mdm/conditions/language/actions.yaml. Use names from this file"
        )
    content = read_model_file(path)
    facts = content["facts"]
    facts["actions"] = [name for name in facts["actions"] if not named(name) & left_out]
    facts["captions"] = [text for text in facts["captions"] if not mentioned(text) & left_out]
    write_model_file(
        path,
        content["state_dict"],
        config=content["config"],
        facts=facts,
        origin=content["origin"],
    )


def named(name: str) -> set[str]:
    """Returns the names of the table entries to which an action name in a model file refers."""
    plain = name.replace("_", " ").lower()
    listed = {entry.name for entry in actions().values() if plain in entry.names}
    return listed or mentioned(plain)


def mentioned(text: str) -> set[str]:
    """Returns the names of the actions that a text mentions."""
    return {mention.action for mention in understand(text).mentions}


if __name__ == "__main__":
    try:
        path, *left_out = sys.argv[1:]
        main(Path(path), set(left_out))
    except UserError as error:
        say(f"error: {error}", error=True)
        sys.exit(1)
