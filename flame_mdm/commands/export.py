"""`flame-mdm export CKPT OUT`: writes the model of a checkpoint as a model file."""

from __future__ import annotations

from functools import partial

from flame_mdm.config import Config, run
from flame_mdm.errors import UserError, say

USAGE = """
usage: flame-mdm export CKPT OUT [half=true]

Writes the averaged weights of a checkpoint, its recipe and the metadata of its data set as one .safetensors file.
"""


def _export(config: Config) -> None:
    if config["ckpt"] is None or config["out"] is None:
        raise UserError("name a checkpoint and an output file: flame-mdm export CKPT model.safetensors")
    from flame_mdm.checkpoints.hub import export
    from flame_mdm.checkpoints.loading import find

    say(f"written: {export(find(config['ckpt'], config['which']), config['out'], half=config['half'])}")


main = partial(
    run, _export, usage=USAGE, name="export", objects=("ckpt", "out"), text=("ckpt", "out"), kinds={"half": "bool"}
)
