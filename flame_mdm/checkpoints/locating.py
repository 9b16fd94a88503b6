"""Files of models, found by path, run directory, name or hub id. This module does not import torch."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Literal, get_args

from flame_mdm.checkpoints.model_files import FILE
from flame_mdm.errors import UserError, did_you_mean, first_line
from flame_mdm.safe_io import regular_file

Which = Literal["last", "best"]

SHIPPED = {path.stem: path for path in sorted((Path(__file__).parents[1] / "models").glob("*.safetensors"))}
"""Models in this package, by name; `docs/checkpoints.md` says how they were trained."""


def find(source: str | Path, which: Which = "last") -> Path:
    """Returns the file of a model.

    Args:
        source: a file; a run directory; a folder with one .safetensors file; the name of a model in this package, such
            as "quickstart"; or "user/name[@revision]" on the Hugging Face hub. An existing path comes first.
        which: for a run directory, the last checkpoint or the one with the best validation result.

    Raises:
        FileNotFoundError: If the file does not exist, or the run has no such checkpoint.
        UserError: If the folder does not hold exactly one model file, or the model cannot be downloaded from the hub.
    """
    if which not in get_args(Which):
        raise UserError(f"which={which}: write last or best")
    path = Path(source)
    if path.exists() and not path.is_dir():
        regular_file(path)
        return path
    weights = [file for file in sorted(path.glob("*.safetensors")) if not file.name.startswith(".")]  # not half-written
    is_run = (path / "config.yaml").is_file() and not weights
    if is_run or (path / "checkpoints").is_dir():
        file = path / "checkpoints" / f"{which}.ckpt"
        if not file.exists():
            there = ", ".join(sorted(checkpoint.name for checkpoint in file.parent.glob("*.ckpt"))) or "none yet"
            raise FileNotFoundError(f"{file}: no such checkpoint. The run has {there}")
        return file
    if path.is_dir():
        if len(weights) != 1:
            there = ", ".join(file.name for file in weights) or "no .safetensors file"
            runs = ", ".join(str(folder.parent) for folder in sorted(path.glob("*/checkpoints"))[:3])
            raise UserError(
                f"{path}: this folder holds {there}. Name {f'a run: {runs}' if runs else 'the file of the model'}"
            )
        regular_file(weights[0])
        return weights[0]
    if str(source) in SHIPPED:
        return SHIPPED[str(source)]
    match = re.fullmatch(r"([\w.-]+/[\w.-]+)(?:@([\w./-]+))?", str(source))
    if match is None or path.suffix in (".ckpt", ".safetensors", ".pt") or path.parent.is_dir():
        there = [p.name for p in path.parent.iterdir()] if path.parent.is_dir() else []
        near = did_you_mean(path.name, [*there, *SHIPPED])
        advice = near or " Give a run, or a .ckpt or .safetensors file"
        raise FileNotFoundError(f"{path}: no such checkpoint.{advice}")
    from huggingface_hub import hf_hub_download, logging

    logging.set_verbosity_error()  # otherwise it reports every attempt to reach the hub
    try:
        return Path(hf_hub_download(match[1], FILE, revision=match[2]))
    except Exception as error:  # the client raises many kinds: no network, no such repository, no permission ...
        raise UserError(
            f"{source}: no such file or folder, and {FILE} of a model with this name cannot be downloaded from the "
            f"hub: {first_line(error)}"
        ) from error
