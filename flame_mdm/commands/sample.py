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
from flame_mdm.safe_io import MEBIBYTE, read_text

if TYPE_CHECKING:
    from flame_mdm.formats.motion import Motion
    from flame_mdm.task import MotionGeneration

LENGTHS = {"seconds": "float | list[float]", "frames": "int | list[int]"}
"""Keys that take one value, or one per prompt, and the types of their values."""
TOGGLES = ("shared_noise", "cleanup", "loop")
"""Keys that are true or false and change the motions."""
USAGE = """
usage: flame-mdm sample ckpt=FILE text="a person walks in a circle clockwise" [seconds=3] [key=value ...]
       flame-mdm sample ckpt=FILE text="walks forward @3 | turns left | sits down @2.5" [after=walk.npz] [loop=true]
       flame-mdm sample ckpt=FILE text="walks forward" targets=path.json
       flame-mdm sample ckpt=FILE prompts=FILE.txt [seconds=[2,3.5,...]] [mp4=true]
       flame-mdm sample ckpt=FILE action=walk
       flame-mdm sample ckpt=FILE unconditioned=true

Writes motions (.npz), a GIF, and a player that opens in any browser. A file of prompts has one per line; each gets its
own folder.
Keys, with their defaults: experiments/sample.yaml
"""


def sample(config: Config) -> None:
    """Samples the requested motions and writes them.

    Raises:
        UserError: If not exactly one condition is requested, the file of prompts cannot be read, or `generate` refuses
            the request.
    """
    texts = check_request(config)
    if config["scorer"] is not None and (texts is None or config["candidates"] == 1):
        raise UserError(f"scorer={config['scorer']} chooses among motions for a text: give text=... and candidates=8")

    import numpy as np
    import torch

    from flame_mdm.checkpoints.loading import find, load
    from flame_mdm.safe_io import sha256
    from flame_mdm.sampling.generation import generate, write_motions
    from flame_mdm.sampling.targets import errors, read_targets
    from flame_mdm.visualize.bodies import load_body

    body = load_body(config["body"])
    device = config["device"] or ("cuda" if torch.cuda.is_available() else "cpu")
    file = find(config["ckpt"], config["which"])
    model = load(file, device)
    check_condition(config, model, texts)
    stages = [] if config["trajectory"] else None
    keys = ("seconds", "frames", *OPTIONS)
    score = None
    if config["scorer"] is not None:
        from evaluators.selection import text_fit

        try:
            score = text_fit(str(config["scorer"]), model, device)
        except (UserError, FileNotFoundError) as error:
            raise UserError(f"scorer: {error}") from error
    motions = generate(
        model,
        texts,
        actions=None if config["action"] is None else [str(config["action"])],
        samples=config["samples"],
        candidates=config["candidates"],
        score=score,
        seed=config["seed"],
        after=config["after"],
        loop=config["loop"],
        targets=config["targets"],
        shared_noise=config["shared_noise"],
        stages=stages,
        cleanup=config["cleanup"],
        **{key: config[key] for key in keys},
    )
    requested = {key: config[key] for key in keys} | {key: config[key] or None for key in TOGGLES}
    requested |= {key: config[key] for key in ("after", "targets", "scorer")}
    requested["candidates"] = config["candidates"] if config["candidates"] != 1 else None
    digest = sha256(file)
    folders: dict[Path, list[Motion]] = {}
    for number in range(len(motions) // config["samples"]):
        part = motions[number * config["samples"] :][: config["samples"]]
        options = {key: v[number] if isinstance(v, list) and key in LENGTHS else v for key, v in requested.items()}
        folder = default_folder(model, digest, part[0].text or "unconditioned", config["seed"], options)
        if config["out"]:
            folder = Path(config["out"], folder.name if config["prompts"] is not None else "")
        folders.setdefault(folder, []).extend(part)  # a prompt that is listed twice
    for folder, made in folders.items():
        facts = {"seed": config["seed"], "checkpoint": digest}
        write_motions(folder, made, facts, stages if made[0] is motions[0] else None, config["mp4"], body)
        say(summary(folder, made, config["mp4"]))
        if config["targets"] is not None:
            off = [100 * errors(motion, read_targets(model.representation, config["targets"])) for motion in made]
            say(f"distance from the targets: mean {np.mean(off):.1f} cm, max {np.max(off):.1f} cm")


main = partial(
    run,
    sample,
    usage=USAGE,
    name="sample",
    objects=("ckpt", "out"),
    text=("text", "prompts", "ckpt", "out", "after", "body", "targets", "scorer"),
    kinds={
        **SAMPLING,
        **LENGTHS,
        "candidates": "int",
        **dict.fromkeys((*TOGGLES, "trajectory", "mp4"), "bool"),
    },
)


def summary(folder: Path, motions: Sequence[Motion], mp4: bool = False) -> str:
    """Returns the line that tells what was written to a folder."""
    count = "1 motion" if len(motions) == 1 else f"{len(motions)} motions"
    files = ["player.html", "motions.gif", *["motions.mp4"] * mp4]
    return f"{count} of {len(motions[0].joints)} frames: {', '.join(str(folder / file) for file in files)}"


def read_prompts(path: str, key: str = "prompts") -> list[str]:
    """Returns the lines of a text file that are not blank.

    Args:
        path: the file, UTF-8 or ASCII.
        key: key of the command that names the file, for the messages.

    Raises:
        UserError: If the file does not exist, is not a text file, is larger than 1 MiB, or contains no text.
    """
    try:
        text = read_text(path, MEBIBYTE)
    except FileNotFoundError:
        raise UserError(f"{key}={path}: no such file. Give a text file with one prompt per line") from None
    except UserError as error:
        raise UserError(f"{key}={error}") from error
    if "\0" in text:
        raise UserError(f"{key}={path}: not a text file. Give a text file with one prompt per line")
    if not (prompts := [line.strip() for line in text.removeprefix("\ufeff").splitlines() if line.strip()]):
        raise UserError(f"{key}={path}: contains no text. Write one prompt per line")
    return prompts


def default_folder(model: MotionGeneration, digest: str, what: str, seed: int, options: Mapping[str, Any]) -> Path:
    """Returns `samples/<experiment>/<run>-step<steps>-<hash>/<what>-seed<seed>`, followed by all options not None.

    Requests for different motions, and checkpoints with another `digest` (SHA-256), thus go to different folders, also
    where the file system ignores case. A text that differs from its readable file name, even in case, is
    followed by its hash. The names of experiment and run come from the
    checkpoint, which may be untrusted; they are cleaned, so the folder is always within `samples`.
    """
    run = model.config.get("run")
    name = run.get("name") if isinstance(run, dict) else None
    parts = [_clean(str(name or "model")), f"step{model.steps}" if model.steps is not None else "", digest[:6]]
    experiment = re.findall(r"[\w-][\w.-]*", str(model.config["experiment"]))
    short = _clean(what.lower())[:60]
    if (
        short.replace("-", " ") != what or not what.isascii()
    ):  # file systems also fold other letters, such as the long s
        short = f"{short}-{hashlib.sha256(what.encode()).hexdigest()[:6]}".strip("-")
    values = {key: re.sub(r"[^\w.,-]+", "", str(value)) for key, value in options.items() if value is not None}
    suffix = "".join(f"-{key}={value}" for key, value in values.items())[:150]
    return Path("samples", *experiment, "-".join(filter(None, parts)), f"{short}-seed{seed}{suffix}")


def _clean(name: str) -> str:
    return re.sub(r"[^\w]+", "-", name).strip("-")


def check_condition(config: Config, model: MotionGeneration, texts: Sequence[str] | None) -> None:
    """Warns of words that the model has never seen.

    Raises:
        UserError: If no condition is requested; the message gives examples.
    """
    if texts is not None:
        from flame_mdm.conditions.vocabulary import advice
        from flame_mdm.errors import shortened
        from flame_mdm.sampling.request import read_parts

        for text in dict.fromkeys(part for each in texts for part, _ in read_parts(each)):
            of = f"'{shortened(text, 60)}': " * (len(texts) > 1 or text not in texts)
            for line in advice(text, model.facts, model.condition.max_words):
                say(f"warning: {of}{line}")
    elif config["action"] is None and not config["unconditioned"]:
        choices = {"text": model.facts.get("captions", ()), "action": model.facts["actions"], "none": ()}
        examples = list(choices[model.conditioned_on])
        shown = "; ".join(examples[:: max(1, len(examples) // 5)][:5])
        key = {"none": "unconditioned=true", "text": "text=...", "action": "action=..."}[model.conditioned_on]
        raise UserError(f"say what to sample: {key}" + f", for example {shown}" * bool(shown))


def check_request(config: Config) -> list[str] | None:
    """Checks that a checkpoint and at most one condition are requested, and returns the texts if there are any.

    Raises:
        UserError: If not, if the file of prompts cannot be read, or if MP4 is requested but cannot be written.
    """
    conditions = [key for key in ("text", "prompts", "action") if config.get(key) is not None]
    conditions += ["unconditioned"] * config["unconditioned"]
    if config["ckpt"] is None:
        raise UserError("no checkpoint given. Add ckpt=runs/.../checkpoints/last.ckpt")
    if config["text"] is not None and not str(config["text"]).strip():
        raise UserError("the text is empty. Describe what the person does, or use unconditioned=true")
    if len(conditions) > 1:
        choices = f"text=..., {'prompts=..., ' * ('prompts' in config)}action=... and unconditioned=true"
        raise UserError(f"give only one of {choices}, not {' and '.join(conditions)}")
    if "prompts" in config and str(config["text"]).endswith(".txt") and Path(str(config["text"])).exists():
        raise UserError(f"text={config['text']}: a file. To sample the prompts in it, give prompts={config['text']}")
    if config["mp4"]:
        from flame_mdm.visualize.render import video_package

        video_package("mp4=true")
    if config.get("prompts") is not None:
        return read_prompts(str(config["prompts"]))
    return None if config["text"] is None else [str(config["text"])]
