"""Command line: `flame-mdm COMMAND OBJECT [OUT] key=value ...`.

`python -m flame_mdm COMMAND ...` is equivalent.
"""

import sys
from collections.abc import Sequence
from importlib import import_module
from typing import get_type_hints

from flame_mdm.errors import did_you_mean, say

COMMANDS = {
    "train": "train or resume a recipe",
    "adapt": "teach a trained model the motions in a folder",
    "distill": "train a student model that samples in one to four steps",
    "sample": "generate motions from a checkpoint",
    "demo": "request motions in the browser",
    "edit": "keep part of a motion and resample the rest",
    "evaluate": "evaluate a checkpoint under a protocol",
    "audit": "audit an evaluator: which perturbations its metrics detect, and at which strength",
    "tables": "render tables and figures from results",
    "benchmark": "train, evaluate and tabulate a set of small models",
    "prepare": "convert a data set to a packed store, or verify a store",
    "browse": "show a prepared data set as a web page",
    "inspect": "find physical faults in motions or in a data set",
    "judge": "judge whether motions do what a sentence says",
    "convert": "convert a motion file",
    "compare": "compare runs side by side, or conduct a user study",
    "report": "write the report page of a run",
    "import": "import a checkpoint released by the authors of a paper",
    "export": "write a checkpoint as a model file, or as ONNX graphs",
    "push": "upload a model file to the Hugging Face hub",
}
"""Purpose of each command.

`commands/NAME.py` contains the command's settings and its `main(settings)`. The file of `import`
is called `import_released.py`, because `import` is a Python keyword.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs a command line and returns its exit code.

    `argv` contains the arguments after `flame-mdm`. By default, they are taken from this process's
    command line.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    if not words or words[0] in ("-h", "--help"):
        say("usage: flame-mdm COMMAND OBJECT [OUT] [key=value ...]", "")
        say(*(f"  {name:10} {purpose}" for name, purpose in COMMANDS.items()), "")
        say(
            "An object is an existing path, the name of a recipe or data set, or a model on the Hugging Face hub."
        )
        say("`flame-mdm COMMAND --help` explains a command.")
        return 0 if words else 2
    name, *rest = words
    if name not in COMMANDS:
        near = did_you_mean(name, COMMANDS)
        say(
            f"error: unknown command: {name}.{near} `flame-mdm --help` lists the commands",
            error=True,
        )
        return 1
    command = import_module(
        f"flame_mdm.commands.{'import_released' if name == 'import' else name}"
    ).main
    if name == "train":  # Hydra composes its recipe
        return command(rest)
    settings = get_type_hints(command)["settings"]
    if getattr(settings, "SWEEPS", False):
        from flame_mdm.config.jobs import run_jobs

        return run_jobs(command, settings, rest)
    from flame_mdm.config import run  # imports Hydra, which --help does not need

    return run(command, settings, rest)


if __name__ == "__main__":
    sys.exit(main())
