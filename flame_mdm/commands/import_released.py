"""`flame-mdm import KIND FILE [ARGS] out=FILE`: imports a checkpoint released by the authors of a paper."""

from dataclasses import dataclass
from typing import ClassVar, Literal

from flame_mdm.commands import existing
from flame_mdm.config.options import option, required
from flame_mdm.errors import say


@dataclass(frozen=True, kw_only=True)
class ImportSettings:
    """usage: flame-mdm import mdm model000475000.pt args.json out=mdm.safetensors stats=FOLDER
           flame-mdm import mfm model.pt .hydra/config.yaml out=mfm.safetensors stats=FOLDER
           flame-mdm import flame model.ckpt out=flame.safetensors

    Converts a released checkpoint of MDM, MFM, FLAME, or FLAME's motion-CLIP (mclip) to a model
    file that all commands accept.
    """

    OBJECTS: ClassVar = ("kind", "file", "args")
    kind: Literal["mdm", "mfm", "flame", "mclip"] = required(
        "mdm, mfm, flame, or mclip (FLAME's motion-CLIP)"
    )
    file: str = required("the released file: model000475000.pt, or FLAME's .ckpt", existing)
    args: str | None = option(None, "MDM's args.json, or MFM's .hydra/config.yaml", existing)
    out: str = required("a .safetensors file, or a folder into which model.safetensors is written")
    stats: str | None = option(
        None, "folder with Mean.npy and Std.npy of HumanML3D or KIT-ML", existing
    )
    averaged: bool = option(
        True, "false = use the raw weights if the file also contains averaged weights"
    )
    num_heads: int | None = option(
        None, "number of attention heads, if it differs from the number in the released models"
    )
    time_token: bool = option(
        False,
        "true = the decoder's input token encodes only the time, as in MDM's code since 2025",
    )
    run_code: bool = option(
        False, "also load pickles that contain more than weights: THIS RUNS ANY CODE IN THE FILE"
    )


def main(settings: ImportSettings) -> None:
    """Converts a released checkpoint and prints the path of the model file."""
    from flame_mdm.checkpoints.released import import_released

    say(f"written: {import_released(**vars(settings))}")
