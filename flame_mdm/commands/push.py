"""`flame-mdm push CKPT user/name`: uploads a model file and its model card to the Hugging Face hub."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from flame_mdm.config import Config, run
from flame_mdm.errors import UserError, say

USAGE = """
usage: flame-mdm push CKPT user/name [OUT] [private=true] [dry_run=true]

Writes model.safetensors, config.yaml and a model card, and uploads them to the Hugging Face hub.
Keys, with their defaults: experiments/push.yaml
"""


def _push(config: Config) -> None:
    if config["ckpt"] is None or config["repository"] is None:
        raise UserError("name a checkpoint and a repository: flame-mdm push CKPT user/name")
    from flame_mdm.checkpoints.hub import push
    from flame_mdm.checkpoints.loading import find

    name, upload = str(config["repository"]), not config["dry_run"]
    folder = config["out"] or Path("push") / name.rpartition("/")[2]
    folder = push(find(config["ckpt"], config["which"]), name, folder, upload=upload, private=config["private"])
    say(f"{f'uploaded to {name}' if upload else 'not uploaded'}: {folder}")


main = partial(
    run, _push, usage=USAGE, name="push", objects=("ckpt", "repository", "out"), text=("ckpt", "repository", "out")
)
