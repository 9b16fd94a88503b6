"""`flame-mdm import KIND FILE [ARGS] out=FILE`: imports a checkpoint released by the authors of a paper."""

from __future__ import annotations

from functools import partial

from flame_mdm.config import Config, run
from flame_mdm.errors import UserError, say

USAGE = """
usage: flame-mdm import mdm model000475000.pt args.json out=mdm.safetensors stats=FOLDER
       flame-mdm import mfm model.pt .hydra/config.yaml out=mfm.safetensors stats=FOLDER
       flame-mdm import flame model.ckpt out=flame.safetensors

Converts a released checkpoint of MDM, MFM, FLAME, or FLAME's motion-CLIP (mclip) into a model file for all commands.
Keys, with their defaults: experiments/import.yaml
"""

KINDS = ("mdm", "mfm", "flame", "mclip")


def _import(config: Config) -> None:
    if config["kind"] not in KINDS:
        raise UserError(f"unknown kind of released model: {config['kind']}. Use {', '.join(KINDS[:-1])} or mclip")
    if config["file"] is None or config["out"] is None:
        raise UserError("name FILE and out=...: flame-mdm import mdm model.pt args.json out=mdm.safetensors")
    from flame_mdm.checkpoints.released import import_released

    keys = ("kind", "file", "args", "out", "stats", "averaged", "num_heads", "time_token", "run_code")
    say(f"written: {import_released(**{key: config[key] for key in keys})}")


main = partial(
    run, _import, usage=USAGE, name="import", objects=("kind", "file", "args"), text=("file", "args", "out", "stats")
)
