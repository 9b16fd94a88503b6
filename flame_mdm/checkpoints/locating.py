"""Finds the files of models by path, run directory, name or hub id.

This module does not import torch.
"""

import re
from pathlib import Path
from typing import Literal

from flame_mdm.checkpoints.model_files import FILE
from flame_mdm.errors import UserError, did_you_mean, first_line
from flame_mdm.safe_io import regular_file

Which = Literal["last", "best"]

SHIPPED = {
    path.stem: path for path in sorted((Path(__file__).parents[1] / "models").glob("*.safetensors"))
}
"""Models in this package by name; `docs/checkpoints.md` describes how they were trained."""


def find(source: str | Path, which: Which = "last") -> Path:
    """Returns the path of a model file. Raises `FileNotFoundError` or `UserError` if there is no such file.

    `source` is a file; a run directory, in which `which` names the checkpoint; a folder with one
    .safetensors file; the name of a model in this package; or "user/name[@revision]" on the
    Hugging Face hub. An existing path takes precedence.
    """
    path = Path(source)
    if path.is_dir():
        return _find_in_folder(path, which)
    if path.exists():
        regular_file(path)
        return path
    if str(source) in SHIPPED:
        return SHIPPED[str(source)]
    match = re.fullmatch(r"([\w.-]+/[\w.-]+)(?:@([\w./-]+))?", str(source))
    if match is None or path.suffix in (".ckpt", ".safetensors", ".pt") or path.parent.is_dir():
        neighbors = [p.name for p in path.parent.iterdir()] if path.parent.is_dir() else []
        near = did_you_mean(path.name, [*neighbors, *SHIPPED])
        raise FileNotFoundError(
            f"{path}: no such checkpoint.{near or ' Use a run directory, or a .ckpt or .safetensors file'}"
        )
    from huggingface_hub import hf_hub_download, logging

    logging.set_verbosity_error()  # the client would report every attempt to reach the hub
    try:
        return Path(hf_hub_download(match[1], FILE, revision=match[2]))
    # The client raises many kinds of errors: no network, no such repository, no permission, ...
    except Exception as error:
        raise UserError(
            f"{source}: no such file or folder, and no model with this name can be downloaded from the hub "
            f"({FILE}: {first_line(error)})"
        ) from error


def _find_in_folder(folder: Path, which: Which) -> Path:
    # Files whose names begin with a dot are still being written.
    weights = [
        file for file in sorted(folder.glob("*.safetensors")) if not file.name.startswith(".")
    ]
    is_run = (folder / "config.yaml").is_file() and not weights
    if is_run or (folder / "checkpoints").is_dir():
        file = folder / "checkpoints" / f"{which}.ckpt"
        if not file.exists():
            names = (
                ", ".join(sorted(path.name for path in file.parent.glob("*.ckpt"))) or "none yet"
            )
            raise FileNotFoundError(f"{file}: no such checkpoint. The run has {names}")
        return file
    if len(weights) != 1:
        if runs := [run for run in sorted(folder.iterdir()) if (run / "checkpoints").is_dir()]:
            raise UserError(
                f"{folder}: not a run directory, but it contains run directories. Use one of them: "
                f"{', '.join(map(str, runs))}"
            )
        names = ", ".join(file.name for file in weights) or "no .safetensors file"
        raise UserError(
            f"{folder}: this folder contains {names}. Use the path of a model file or a run directory"
        )
    regular_file(weights[0])
    return weights[0]
