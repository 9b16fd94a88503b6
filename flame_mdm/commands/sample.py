"""Samples from a checkpoint: `flame-mdm sample ckpt=... text="a person walks" seconds=3`"""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flame_mdm.commands import SAMPLING
from flame_mdm.config import Config, run
from flame_mdm.errors import UserError, say

if TYPE_CHECKING:
    from flame_mdm.task import MotionGeneration

USAGE = """
usage: flame-mdm sample ckpt=FILE text="a person walks in a circle" [seconds=6] [key=value ...]
       flame-mdm sample ckpt=FILE action=walk
       flame-mdm sample ckpt=FILE unconditioned=true

Writes motions (.npz), a GIF and a player for any browser. Keys, with their defaults: experiments/sample.yaml
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    words = sys.argv[1:] if argv is None else argv
    return run(
        sample,
        words,
        usage=USAGE,
        name="sample",
        objects=("ckpt", "out"),
        text=("text", "ckpt", "out"),
        kinds={**SAMPLING, "seconds": "float"},
    )


def sample(config: Config) -> None:
    """Samples what the configuration asks for.

    Raises:
        UserError: nothing, or two things, asked for; or what `generate` refuses.
    """
    check_request(config)

    import torch

    from flame_mdm.checkpoints.loading import find, load
    from flame_mdm.files import sha256
    from flame_mdm.generation import generate, write_motions

    device = config["device"] or ("cuda" if torch.cuda.is_available() else "cpu")
    file = find(config["ckpt"], config["which"])
    model = load(file, device)
    motions = generate(
        model,
        None if config["text"] is None else str(config["text"]),
        actions=None if config["action"] is None else [str(config["action"])],
        seconds=config["seconds"],
        frames=config["frames"],
        samples=config["samples"],
        seed=config["seed"],
        guidance_scale=config["guidance_scale"],
        sampler=config["sampler"],
        num_inference_steps=config["num_inference_steps"],
    )
    asked = {key: config[key] for key in ("seconds", "frames", "guidance_scale", "sampler", "num_inference_steps")}
    folder = Path(config["out"] or default_folder(model, motions[0].text or "unconditioned", config["seed"], asked))
    write_motions(folder, motions, {"seed": config["seed"], "checkpoint": sha256(file)})
    say(
        f"{len(motions)} motions of {len(motions[0].joints)} frames: {folder / 'player.html'}, {folder / 'motions.gif'}"
    )


def default_folder(model: MotionGeneration, what: str, seed: int, options: Mapping[str, Any]) -> Path:
    """`samples/<experiment>/<what>-seed<seed>`, and the options that are not None: other motions, another folder.

    The experiment is a word of the checkpoint, which may be a stranger's: the folder is within `samples` all the same.
    """
    experiment = re.findall(r"[\w-][\w.-]*", str(model.config["experiment"]))
    name = re.sub(r"[^a-z0-9]+", "-", what.lower()).strip("-")[:60]
    values = {key: re.sub(r"[^\w.,-]+", "", str(value)) for key, value in options.items() if value is not None}
    told = "".join(f"-{key}={value}" for key, value in values.items())[:150]
    return Path("samples", *experiment, f"{name}-seed{seed}{told}")


def check_request(config: Config) -> None:
    """Checks that a checkpoint and one condition are asked for.

    Raises:
        UserError: they are not.
    """
    asked = [key for key in ("text", "action") if config[key] is not None] + ["unconditioned"] * config["unconditioned"]
    if config["ckpt"] is None:
        raise UserError("no checkpoint: ckpt=runs/.../checkpoints/last.ckpt")
    if config["text"] is not None and not str(config["text"]).strip():
        raise UserError("the text is empty; write what the person does, or ask for unconditioned motions by name")
    if len(asked) != 1:
        raise UserError(
            f"ask for one of text=..., action=... and unconditioned=true, not {' and '.join(asked) or 'none'}"
        )


if __name__ == "__main__":
    sys.exit(main())
