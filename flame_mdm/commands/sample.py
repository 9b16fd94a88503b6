"""`flame-mdm sample CKPT text="a person walks" seconds=3`: samples motions from a checkpoint."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flame_mdm.commands import OPTIONS, SAMPLING
from flame_mdm.config import Config, run
from flame_mdm.errors import UserError, say

if TYPE_CHECKING:
    from flame_mdm.formats.motion import Motion
    from flame_mdm.task import MotionGeneration

USAGE = """
usage: flame-mdm sample ckpt=FILE text="a person walks in a circle" [seconds=3] [key=value ...]
       flame-mdm sample ckpt=FILE action=walk
       flame-mdm sample ckpt=FILE unconditioned=true

Writes motions (.npz), a GIF, and a player that opens in any browser.
Keys, with their defaults: experiments/sample.yaml
"""


def sample(config: Config) -> None:
    """Samples the requested motions and writes them.

    Raises:
        UserError: If not exactly one condition is requested, or `generate` refuses the request.
    """
    check_request(config)

    import torch

    from flame_mdm.checkpoints.loading import find, load
    from flame_mdm.files import sha256
    from flame_mdm.generation import generate, write_motions

    device = config["device"] or ("cuda" if torch.cuda.is_available() else "cpu")
    file = find(config["ckpt"], config["which"])
    model = load(file, device)
    check_condition(config, model)
    stages = [] if config["trajectory"] else None
    keys = ("seconds", "frames", *OPTIONS)
    motions = generate(
        model,
        None if config["text"] is None else str(config["text"]),
        actions=None if config["action"] is None else [str(config["action"])],
        samples=config["samples"],
        seed=config["seed"],
        shared_noise=config["shared_noise"],
        stages=stages,
        **{key: config[key] for key in keys},
    )
    requested = {key: config[key] for key in keys} | {"shared_noise": config["shared_noise"] or None}
    digest, what = sha256(file), motions[0].text or "unconditioned"
    folder = Path(config["out"] or default_folder(model, digest, what, config["seed"], requested))
    write_motions(folder, motions, {"seed": config["seed"], "checkpoint": digest}, stages)
    say(summary(folder, motions))


main = partial(
    run,
    sample,
    usage=USAGE,
    name="sample",
    objects=("ckpt", "out"),
    text=("text", "ckpt", "out"),
    kinds={**SAMPLING, "seconds": "float", "shared_noise": "bool", "trajectory": "bool"},
)


def summary(folder: Path, motions: Sequence[Motion]) -> str:
    """Returns the line that tells what was written to a folder."""
    count = "1 motion" if len(motions) == 1 else f"{len(motions)} motions"
    return f"{count} of {len(motions[0].joints)} frames: {folder / 'player.html'}, {folder / 'motions.gif'}"


def default_folder(model: MotionGeneration, digest: str, what: str, seed: int, options: Mapping[str, Any]) -> Path:
    """Returns `samples/<experiment>/<run>-step<steps>-<hash>/<what>-seed<seed>`, followed by all options not None.

    Requests for different motions, and checkpoints with another `digest` (SHA-256), thus go to different folders. A
    text that is not readable as a file name is followed by its hash. The names of experiment and run come from the
    checkpoint, which may be untrusted; they are cleaned, so the folder is always within `samples`.
    """
    run = model.config.get("run")
    name = run.get("name") if isinstance(run, dict) else None
    parts = [_clean(str(name or "model")), f"step{model.steps}" if model.steps is not None else "", digest[:6]]
    experiment = re.findall(r"[\w-][\w.-]*", str(model.config["experiment"]))
    short = _clean(what.lower())[:60]
    if short != what.lower().replace(" ", "-"):
        short = f"{short}-{hashlib.sha256(what.encode()).hexdigest()[:6]}".strip("-")
    values = {key: re.sub(r"[^\w.,-]+", "", str(value)) for key, value in options.items() if value is not None}
    suffix = "".join(f"-{key}={value}" for key, value in values.items())[:150]
    return Path("samples", *experiment, "-".join(filter(None, parts)), f"{short}-seed{seed}{suffix}")


def _clean(name: str) -> str:
    return re.sub(r"[^\w]+", "-", name).strip("-")


def check_condition(config: Config, model: MotionGeneration) -> None:
    """Warns of words that the model has never seen.

    Raises:
        UserError: If no condition is requested; the message gives examples.
    """
    if config["text"] is not None:
        from flame_mdm.conditions.vocabulary import advice

        for line in advice(str(config["text"]), model.facts, model.condition.max_words):
            say(f"warning: {line}")
    elif config["action"] is None and not config["unconditioned"]:
        choices = {"text": model.facts.get("captions", ()), "action": model.facts["actions"], "none": ()}
        examples = list(choices[model.conditioned_on])
        shown = "; ".join(examples[:: max(1, len(examples) // 5)][:5])
        key = {"none": "unconditioned=true", "text": "text=...", "action": "action=..."}[model.conditioned_on]
        raise UserError(f"say what to sample: {key}" + f", for example {shown}" * bool(shown))


def check_request(config: Config) -> None:
    """Checks that a checkpoint and at most one condition are requested.

    Raises:
        UserError: If not.
    """
    conditions = [key for key in ("text", "action") if config[key] is not None]
    conditions += ["unconditioned"] * config["unconditioned"]
    if config["ckpt"] is None:
        raise UserError("no checkpoint given. Add ckpt=runs/.../checkpoints/last.ckpt")
    if config["text"] is not None and not str(config["text"]).strip():
        raise UserError("the text is empty. Describe what the person does, or use unconditioned=true")
    if len(conditions) > 1:
        raise UserError(f"give only one of text=..., action=... and unconditioned=true, not {' and '.join(conditions)}")
