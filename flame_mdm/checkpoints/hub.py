"""Model sharing: export from a checkpoint, model card, and upload to the Hugging Face hub."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from flame_mdm.checkpoints.adapters import read_merged
from flame_mdm.checkpoints.locating import find
from flame_mdm.checkpoints.model_files import (
    FILE,
    read_model_file,
    without_own_paths,
    write_model_file,
)
from flame_mdm.config import save
from flame_mdm.errors import UserError, first_line, markdown_text
from flame_mdm.safe_io import (
    atomic_folder,
    read_package_yaml,
    read_text,
    regular_file,
    sha256,
    write_text,
)

CARD = Path(__file__).with_name("card.md")
MOTION_LICENSES = Path(__file__).parent.parent / "data" / "licenses.yaml"
WRITTEN = {"README.md": "library_name: flame-mdm", "config.yaml": "The recipe of this model."}
"""Files that `push` writes next to the model, each with text that identifies it as written by `push`.

The model card also contains the hash of the model file.
"""
OTHERS = "not overwritten because push did not write it. Choose another folder with out=..."


def export(source: str | Path, out: str | Path, *, half: bool = False, **adapted: Any) -> Path:
    """Writes the model in a checkpoint as a single .safetensors file and returns the file's path.

    Args:
        source: the model, as in `flame_mdm.load`.
        out: path of the file.
        half: whether to store weight matrices in half precision. Vectors, such as the statistics of
            the features, remain in single precision. Loaded models always compute in single
            precision.
        adapted: adapters to merge into the weights, and their strengths, as in `flame_mdm.load`.

    Raises the same errors as `flame_mdm.load`.
    """
    source = find(source)
    checkpoint = read_merged(source, **adapted)
    origin = checkpoint.get("origin") or {
        "made": "trained with flame_mdm",
        "steps": checkpoint.get("global_step"),
        "file": source.name,
        "sha256": sha256(source),
        "averaged": "current_model_state" in checkpoint,
    }
    state = checkpoint["state_dict"]
    if half:
        state = {name: value.half() if value.ndim > 1 else value for name, value in state.items()}
        origin |= {"half_precision": True}
    config = without_own_paths(checkpoint["config"])
    return write_model_file(out, state, config=config, facts=checkpoint["facts"], origin=origin)


def push(
    source: str | Path, repository: str, folder: str | Path, *, upload: bool, private: bool
) -> Path:
    """Writes a folder with the model file, recipe and model card, and uploads it to the hub as "user/name".

    See `export` for the arguments.
    """
    if not re.fullmatch(r"\w[\w.-]*/\w[\w.-]*", repository):
        raise UserError(f"{repository}: not a repository name. Use user/name")
    folder = Path(folder)
    _check_written(folder)
    with atomic_folder(folder) as temporary:
        file = export(source, temporary / FILE)
        model = read_model_file(file)
        save(model["config"], temporary / "config.yaml", head=WRITTEN["config.yaml"])
        write_text(temporary / "README.md", card(model, repository, sha256(file)))
    if upload:
        from huggingface_hub import HfApi

        try:
            HfApi().create_repo(repository, private=private, exist_ok=True)
            HfApi().upload_folder(
                repo_id=repository, folder_path=folder, allow_patterns=[FILE, *WRITTEN]
            )
        # The client raises many kinds of errors: no network, no token, no permission, ...
        except Exception as error:
            message = f"{repository}: upload failed: {first_line(error)}. The files are in {folder}"
            raise UserError(message) from error
    return folder


def _check_written(folder: Path) -> None:
    """Raises `UserError` if a folder contains a file that `push` would overwrite but did not write."""
    for name, mark in WRITTEN.items():
        path = folder / name
        if path.exists() and mark not in read_text(path):
            raise UserError(f"{path}: {OTHERS}")
    file, text = folder / FILE, folder / "README.md"
    if file.exists():
        regular_file(file)
        if not text.exists() or sha256(file) not in read_text(text):
            raise UserError(f"{file}: {OTHERS}")


def card(model: Mapping[str, Any], repository: str, file_sha256: str) -> str:
    """Returns the model card for a model file with the given content and hash."""
    from jinja2 import Template

    config, facts = model["config"], model["facts"]
    licenses = read_package_yaml(Path(__file__).with_name("licenses.yaml"))
    names = [
        name for name in ("denoiser", "process", "condition", "representation") if name in config
    ]
    parts = {name: config[name]["_target_"].rpartition(".")[2] for name in names}
    other = {"ActionLabels": f"actions={facts['actions'][:1]}, ", "Unconditional": ""}
    request = other.get(parts.get("condition", ""), '"a person walks forward", ')
    rows = {
        "experiment": config["experiment"],
        **parts,
        "parameters": f"{sum(value.numel() for value in model['state_dict'].values()):,}",
        "data": facts.get("dataset", "unknown"),
        "fingerprint of the data": facts.get("fingerprint") or "unknown",
        "longest motion": f"{facts['max_frames']} frames",
        "actions": ", ".join(facts["actions"]) or "none",
        f"sha256 of {FILE}": file_sha256,
        **{f"weights: {name}": value for name, value in model["origin"].items()},
    }
    terms = read_package_yaml(MOTION_LICENSES)
    sources = [motions | terms.get(motions["license"], {}) for motions in facts.get("licenses", ())]
    template = Template(CARD.read_text(encoding="utf-8"), keep_trailing_newline=True)
    dataset = "mixture" if sources else facts.get("dataset")
    words = licenses.get(dataset, licenses["other"]) | {
        "repository": repository,
        "request": request,
    }
    return template.render(words, rows=rows, sources=sources, markdown=markdown_text)
