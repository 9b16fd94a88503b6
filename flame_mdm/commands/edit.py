"""`flame-mdm edit CKPT motion=FILE`: keeps part of a motion and resamples the rest."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

from flame_mdm.commands import OPTIONS, SAMPLING
from flame_mdm.commands.sample import check_condition, check_request, default_folder, summary
from flame_mdm.config import Config, run
from flame_mdm.errors import UserError, say

USAGE = """
usage: flame-mdm edit ckpt=FILE motion=walk.npz region=in_between text="a person jumps" [key=value ...]
       flame-mdm edit ckpt=FILE motion=take.bvh cut=[0,3] joints=upper_body unconditioned=true
       flame-mdm edit ckpt=FILE motion=bandai:CLIP region_seconds=[1,2] joints=[left_arm,head] method=flame ...

Keeps part of a motion and resamples the rest. Writes the original and the results (.npz), a GIF, and a player that
opens in any browser. Keys, with their defaults: experiments/edit.yaml
"""


def write_edits(config: Config) -> None:
    """Edits a motion as configured, and writes the original and the results.

    Raises:
        UserError: If not exactly one condition is requested, or `flame_mdm.sampling.editing.edit` refuses the request.
    """
    texts = check_request(config)
    if config["motion"] is None:
        raise UserError("no motion to edit. Give motion=FILE (.npz, .bvh, .json, .npy) or motion=dataset:id")

    import torch

    from flame_mdm.checkpoints.loading import find, load
    from flame_mdm.safe_io import sha256
    from flame_mdm.sampling.editing import edit
    from flame_mdm.sampling.generation import write_motions
    from flame_mdm.sampling.reading import read_motion
    from flame_mdm.visualize.bodies import load_body

    body = load_body(config["body"])
    file = find(config["ckpt"], config["which"])
    model = load(file, config["device"] or ("cuda" if torch.cuda.is_available() else "cpu"))
    check_condition(config, model, texts)
    original = read_motion(
        model.representation,
        str(config["motion"]),
        **{key: config[key] for key in ("fps", "unit", "up", "cut", "data_root")},
    )
    keys = ("region", "region_seconds", "joints", "method", "until", "resample", "strength")
    keys += ("samples", "seed", "cleanup", *OPTIONS)
    stages = [] if config["trajectory"] else None
    edits = edit(
        model,
        original,
        texts,
        actions=None if config["action"] is None else [str(config["action"])],
        stages=stages,
        **{key: config[key] for key in keys},
    )
    requested = {key: config[key] for key in keys if key not in ("resample", "samples", "seed", "cleanup")}
    requested |= {"cut": config["cut"], "cleanup": config["cleanup"] or None}
    requested["resample"] = config["resample"] if config["resample"] != 1 else None
    digest, what = sha256(file), f"edit {Path(original.id).stem} {edits[0].text}"
    folder = Path(config["out"] or default_folder(model, digest, what, config["seed"], requested))
    shown = replace(original, text=f"original: {original.text or original.id}")
    facts = {"seed": config["seed"], "checkpoint": digest, "keep": edits[0].keep}
    write_motions(folder, [shown, *edits], facts, stages, config["mp4"], body)
    say(summary(folder, edits, config["mp4"]))
    say(
        f"{edits[0].keep.mean():.0%} of the features are kept. Largest change in the kept part: "
        f"{max(e.feature_error for e in edits):.3g} in normalized features, "
        f"{max(e.joint_error for e in edits):.3g} m in world joint positions"
    )
    if max(e.joint_error for e in edits) > 0.01:
        say("a kept part that follows a generated one begins where that one ends, so its place in the world may differ")


main = partial(
    run,
    write_edits,
    usage=USAGE,
    name="edit",
    objects=("ckpt", "out"),
    text=("text", "ckpt", "motion", "out", "up", "body"),
    kinds={
        **SAMPLING,
        "method": "str",
        "until": "float",
        "resample": "int",
        "strength": "float",
        "cleanup": "bool",
        "trajectory": "bool",
        "mp4": "bool",
    },
)
