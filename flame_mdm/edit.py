"""Edits a motion: `python -m flame_mdm.edit ckpt=... motion=walk.npz frames=in_between text="a person jumps"`"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

from flame_mdm.config import Config, UserError, run
from flame_mdm.sample import check_request, default_folder

USAGE = """
usage: python -m flame_mdm.edit ckpt=FILE motion=walk.npz frames=in_between text="a person jumps" [key=value ...]
       python -m flame_mdm.edit ckpt=FILE motion=take.bvh cut=[0,3] joints=upper_body unconditioned=true
       python -m flame_mdm.edit ckpt=FILE motion=bandai:CLIP seconds=[1,2] joints=[left_arm,head] method=flame ...

Keeps a part of a motion and samples the rest anew. Writes the original and the results (.npz), a GIF and a player for
any browser. Keys, with their defaults: experiments/edit.yaml
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    words = sys.argv[1:] if argv is None else argv
    return run(
        write_edits,
        words,
        usage=USAGE,
        name="edit",
        text=("text", "ckpt", "motion", "out"),
        like=("flame_mdm.editing.edit",),
    )


def write_edits(config: Config) -> None:
    """Edits as the configuration asks, and writes the results.

    Raises:
        UserError: nothing, or two things, asked for; or what `flame_mdm.editing.edit` refuses.
    """
    check_request(config)
    if config["motion"] is None:
        raise UserError("no motion to edit: motion=FILE.npz, motion=FILE.bvh or motion=dataset:id")

    import torch

    from flame_mdm.checkpoints import find
    from flame_mdm.editing import edit, read_motion
    from flame_mdm.generation import file_sha256, write_motions
    from flame_mdm.task import load

    file = find(config["ckpt"])
    model = load(file, config["device"] or ("cuda" if torch.cuda.is_available() else "cpu"))
    original = read_motion(
        model.representation, str(config["motion"]), cut=config["cut"], data_root=config["data_root"]
    )
    keys = ("frames", "seconds", "joints", "method", "until", "resample", "samples", "seed")
    keys += ("guidance_scale", "sampler", "num_inference_steps")
    edits = edit(
        model,
        original,
        None if config["text"] is None else str(config["text"]),
        actions=None if config["action"] is None else [str(config["action"])],
        **{key: config[key] for key in keys},
    )
    asked = {key: config[key] for key in keys if key not in ("resample", "samples", "seed")} | {"cut": config["cut"]}
    asked["resample"] = config["resample"] if config["resample"] != 1 else None
    what = f"edit {Path(original.id).stem} {edits[0].caption}"
    folder = Path(config["out"] or default_folder(model, what, config["seed"], asked))
    shown = replace(original, caption=f"original: {original.caption or original.id}")
    facts = {"seed": config["seed"], "checkpoint": file_sha256(file), "keep": edits[0].keep}
    write_motions(folder, model, [shown, *edits], facts)
    print(f"{len(edits)} motions of {len(original.joints)} frames: {folder / 'player.html'}, {folder / 'motions.gif'}")
    print(
        f"{edits[0].keep.mean():.0%} of the features were to be kept; largest change among them: "
        f"{max(e.feature_error for e in edits):.3g} in normalized features; "
        f"{max(e.joint_error for e in edits):.3g} m of the joints in the world"
    )


class _Command(ModuleType):
    """`flame_mdm.edit` is the function of the Python API until this module, once imported, takes its name."""

    def __call__(self, *args: Any, **options: Any) -> Any:
        from flame_mdm.editing import edit

        return edit(*args, **options)


sys.modules[__name__].__class__ = _Command

if __name__ == "__main__":
    sys.exit(main())
