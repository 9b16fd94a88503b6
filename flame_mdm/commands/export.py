"""`flame-mdm export CKPT OUT`: writes the model in a checkpoint as a model file, or as ONNX graphs."""

from dataclasses import dataclass
from typing import ClassVar, Literal

from flame_mdm.commands import AdaptedSettings
from flame_mdm.config.options import option, required
from flame_mdm.errors import say


@dataclass(frozen=True, kw_only=True)
class ExportSettings(AdaptedSettings):
    """usage: flame-mdm export CKPT OUT [half=true] [format=onnx] [adapter=limp.safetensors]

    Writes a single .safetensors file with the averaged weights of a checkpoint, its recipe and the
    metadata of its data set. Adapters are merged into the weights. With format=onnx, writes a
    folder for sampling without PyTorch instead; see docs/export.md.
    """

    OBJECTS: ClassVar = ("ckpt", "out")
    out: str = required("a .safetensors file or a folder; must be a folder with format=onnx")
    format: Literal["safetensors", "onnx"] = option(
        "safetensors",
        "format: safetensors, or onnx (graphs for onnxruntime, with a script that samples)",
    )
    half: bool = option(False, "true = weight matrices in half precision")


def main(settings: ExportSettings) -> None:
    """Writes a model as a single file or as ONNX graphs."""
    file = settings.model_file()
    if settings.format == "onnx":
        from flame_mdm.checkpoints.onnx_export import export_onnx as export
    else:
        from flame_mdm.checkpoints.hub import export

    say(f"written: {export(file, settings.out, half=settings.half, **settings.adapters())}")
