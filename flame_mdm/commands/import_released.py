"""`flame-mdm import KIND FILE [ARGS] out=FILE`: imports a checkpoint released by the authors of a paper."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from flame_mdm.errors import UserError, say
from flame_mdm.sampler_options import option

KINDS = ("mdm", "mfm", "flame", "mclip")


@dataclass(frozen=True, kw_only=True)
class ImportSettings:
    """usage: flame-mdm import mdm model000475000.pt args.json out=mdm.safetensors stats=FOLDER
           flame-mdm import mfm model.pt .hydra/config.yaml out=mfm.safetensors stats=FOLDER
           flame-mdm import flame model.ckpt out=flame.safetensors

    Converts a released checkpoint of MDM, MFM, FLAME, or FLAME's motion-CLIP (mclip) into a model file for all
    commands.
    """

    OBJECTS: ClassVar = ("kind", "file", "args")
    kind: str | None = option(None, "mdm, mfm, flame, or mclip (FLAME's motion-CLIP)")
    file: str | None = option(None, "the released file: model000475000.pt, or FLAME's .ckpt")
    args: str | None = option(None, "MDM's args.json, or MFM's .hydra/config.yaml")
    out: str | None = option(None, "a .safetensors file, or a folder for model.safetensors")
    stats: str | None = option(None, "folder with Mean.npy and Std.npy of HumanML3D or KIT-ML")
    averaged: bool = option(True, "false = the raw weights, if the file also has averaged ones")
    num_heads: int | None = option(None, "number of attention heads, if it differs from the released models")
    time_token: bool = option(False, "decoder whose input token is the time alone, as in MDM's code since 2025")
    run_code: bool = option(False, "load pickles that hold more than weights: THIS RUNS ANY CODE IN THE FILE")


def main(settings: ImportSettings) -> None:
    if settings.kind not in KINDS:
        raise UserError(f"unknown kind of released model: {settings.kind}. Use {', '.join(KINDS[:-1])} or mclip")
    if settings.file is None or settings.out is None:
        raise UserError("name FILE and out=...: flame-mdm import mdm model.pt args.json out=mdm.safetensors")
    for path in (settings.file, settings.args, settings.stats):
        if path is not None and not Path(path).exists():
            raise FileNotFoundError(f"{path}: no such file")
    from flame_mdm.checkpoints.released import import_released

    say(f"written: {import_released(**vars(settings))}")
