"""Model files to share: export from a checkpoint, model card, upload to the Hugging Face hub."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from flame_mdm.checkpoints.files import FILE, read_checkpoint, read_model_file, without_own_paths, write_model_file
from flame_mdm.checkpoints.loading import find
from flame_mdm.config import save
from flame_mdm.errors import UserError, first_line, markdown_text
from flame_mdm.files import read_text, sha256, write_text

WRITTEN = {"README.md": "library_name: flame-mdm", "config.yaml": "The recipe of this model."}
"""Files that `push` writes beside the model, with what tells them from files of others."""

LICENSES = {
    "bandai": (
        "cc-by-nc-4.0",
        "Trained on the Bandai-Namco-Research-Motiondataset (CC BY-NC 4.0): not for commercial use.",
    ),
    "synthetic": ("mit", "Trained on procedural motions that the package makes itself; no data of others is in it."),
}
OTHER_LICENSE = (
    "other",
    "The terms of the motion data that the model was trained on apply to it; AMASS and HumanAct12, which HumanML3D and "
    "BABEL are made from, and UESTC are for non-commercial research.",
)


def export(source: str | Path, out: str | Path) -> Path:
    """Writes the model of a checkpoint as a model file; returns the file.

    Args:
        source: what `flame_mdm.load` takes.
        out: the .safetensors file, or a folder to put `model.safetensors` into.

    Raises:
        FileNotFoundError, UserError: as `flame_mdm.load`.
    """
    source, out = find(source), Path(out)
    checkpoint = read_checkpoint(source)
    origin = checkpoint.get("origin") or {
        "made": "trained with flame_mdm",
        "steps": checkpoint.get("global_step"),
        "file": source.name,
        "sha256": sha256(source),
        "averaged": "current_model_state" in checkpoint,
    }
    out = out if out.suffix == ".safetensors" else out / FILE
    config = without_own_paths(checkpoint["config"])
    write_model_file(out, checkpoint["state_dict"], config=config, facts=checkpoint["facts"], origin=origin)
    return out


def push(
    source: str | Path, repository: str, folder: str | Path, *, upload: bool = True, private: bool = False
) -> Path:
    """Writes a folder with a model file and its card, and uploads it to the Hugging Face hub.

    Args:
        source: what `flame_mdm.load` takes.
        repository: "user/name" on the hub.
        folder: where to write `model.safetensors`, `config.yaml` and the card, `README.md`.
        upload: False leaves it at the folder.
        private: a new repository is private.

    Raises:
        FileNotFoundError, UserError: as `flame_mdm.load`; or the hub cannot be reached or refuses.
    """
    if not re.fullmatch(r"\w[\w.-]*/\w[\w.-]*", repository):
        raise UserError(f"{repository}: name the model as user/name")
    for name, mark in WRITTEN.items():
        if (path := Path(folder) / name).exists() and mark not in read_text(path):
            raise UserError(f"{path}: not written by push, and not overwritten. Choose another `folder`")
    file = export(source, Path(folder) / FILE)
    model = read_model_file(file)
    save(model["config"], file.parent / "config.yaml", head=WRITTEN["config.yaml"])
    write_text(file.parent / "README.md", card(model, repository))
    if upload:
        from huggingface_hub import HfApi

        try:
            HfApi().create_repo(repository, private=private, exist_ok=True)
            HfApi().upload_folder(
                repo_id=repository, folder_path=file.parent, allow_patterns=[FILE, "config.yaml", "README.md"]
            )
        except Exception as error:  # the client raises many kinds: no network, no token, no permission ...
            raise UserError(f"{repository}: {file.parent} is written but not uploaded: {first_line(error)}") from error
    return file.parent


def card(model: Mapping[str, Any], repository: str) -> str:
    """The card of a model on the hub: recipe, data, provenance, license."""
    config, facts, origin = model["config"], model["facts"], model["origin"]
    license_id, terms = LICENSES.get(facts.get("dataset", ""), OTHER_LICENSE)
    parts = {
        name: config[name]["_target_"].rpartition(".")[2]
        for name in ("denoiser", "process", "condition", "representation")
        if name in config
    }
    request = {"ActionLabels": f"actions={facts['actions'][:1]}", "Unconditional": ""}.get(
        parts.get("condition", ""), '"a person walks forward"'
    )
    weights = sum(value.numel() for value in model["state_dict"].values())
    rows = [
        ("experiment", config["experiment"]),
        *parts.items(),
        ("numbers in the file", f"{weights:,}"),
        ("data", facts.get("dataset", "unknown")),
        ("fingerprint of the data", facts.get("fingerprint") or "unknown"),
        ("longest motion", f"{facts['max_frames']} frames"),
        ("actions", ", ".join(facts["actions"]) or "none"),
        *((f"weights: {name}", value) for name, value in origin.items()),
    ]
    table = "\n".join(f"| {markdown_text(str(name))} | {markdown_text(str(value))} |" for name, value in rows)
    return f"""---
license: {license_id}
library_name: flame-mdm
tags: [human-motion-generation, text-to-motion]
---

# {repository.partition("/")[2]}

A model of human motion. It generates joints in metres, y up:

    import flame_mdm
    model = flame_mdm.load("{repository}")
    motion = flame_mdm.generate(model, {request + ", " if request else ""}seconds=3, seed=0)[0]

| | |
|---|---|
{table}

The recipe stands in `config.yaml`.

## License

{terms}
"""
