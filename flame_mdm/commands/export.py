"""`flame-mdm export CKPT OUT`: writes the model of a checkpoint as a model file."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import ClassVar

from flame_mdm.commands import ModelSettings
from flame_mdm.config import run
from flame_mdm.errors import UserError, say
from flame_mdm.sampler_options import option


@dataclass(frozen=True, kw_only=True)
class ExportSettings(ModelSettings):
    """usage: flame-mdm export CKPT OUT [half=true]

    Writes the averaged weights of a checkpoint, its recipe and the metadata of its data set as one .safetensors file.
    """

    OBJECTS: ClassVar = ("ckpt", "out")
    out: str | None = option(None, "a .safetensors file, or a folder for model.safetensors")
    half: bool = option(False, "true = weight matrices in half precision")


def export_model(settings: ExportSettings) -> None:
    """Writes the model file."""
    if settings.ckpt is None or settings.out is None:
        raise UserError("name a checkpoint and an output file: flame-mdm export CKPT model.safetensors")
    file = settings.model_file()
    from flame_mdm.checkpoints.hub import export

    say(f"written: {export(file, settings.out, half=settings.half)}")


main = partial(run, export_model, ExportSettings)
