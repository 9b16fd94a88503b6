"""Models as files to hand on: `python -m flame_mdm.checkpoints import | export | push ...`

A model file is a .safetensors file: the (averaged) weights, statistics of the features included, and as metadata under
the key `flame_mdm` the recipe, the facts of the data and where the weights come from, as JSON. No part of it is code.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flame_mdm.config import UserError, guarded

if TYPE_CHECKING:
    from torch import Tensor

FORMAT = 1
KEY = "flame_mdm"
FILE = "model.safetensors"

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


# Files ----------------------------------------------------------------------------------------------------------------


def find(source: str | Path) -> Path:
    """The file of a model: `source` itself, the one .safetensors file in a folder, or a download from the hub.

    Args:
        source: a file, a folder, or "user/name[@revision]" of the Hugging Face hub.

    Raises:
        FileNotFoundError: no such file.
        UserError: a folder with none or several of them, or the hub does not give it.
    """
    path = Path(source)
    if path.is_file():
        return path
    if path.is_dir():
        files = sorted(path.glob("*.safetensors"))
        if len(files) != 1:
            there = ", ".join(file.name for file in files) or "no .safetensors file"
            raise UserError(f"{path}: this folder holds {there}; name the file of the model")
        return files[0]
    match = re.fullmatch(r"([\w.-]+/[\w.-]+)(?:@([\w./-]+))?", str(source))
    if match is None or path.suffix in (".ckpt", ".safetensors", ".pt") or path.parent.is_dir():
        raise FileNotFoundError(f"{path}: no such checkpoint")
    from huggingface_hub import hf_hub_download, logging

    logging.set_verbosity_error()  # else it reports every attempt to reach the hub
    try:
        return Path(hf_hub_download(match[1], FILE, revision=match[2]))
    except Exception as error:  # the client raises many kinds: no network, no such repository, no permission ...
        raise UserError(
            f"{source}: no such file or folder, nor can {FILE} of a model of that name be fetched from the hub: "
            f"{_first_line(error)}"
        ) from error


def read(path: Path) -> dict[str, Any]:
    """A model file as `config`, `facts`, `origin` and `state_dict`.

    Raises:
        UserError: it is damaged, foreign, or of a newer format.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="pt") as file:
            text = (file.metadata() or {}).get(KEY)
            state = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (it is no mapping)
    except (SafetensorError, OSError, ValueError) as error:
        raise UserError(f"{path}: damaged, or not a .safetensors file") from error
    if text is None:
        raise UserError(
            f"{path}: weights without a recipe; those of MDM, MFM and FLAME are imported by "
            "`python -m flame_mdm.checkpoints import`"
        )
    try:
        content = json.loads(text)
        found, digest = content["format"], content["sha256"]
        model = {name: content[name] for name in ("config", "facts", "origin")}
    except (ValueError, TypeError, KeyError) as error:
        raise UserError(f"{path}: damaged: its recipe cannot be read") from error
    if found != FORMAT:
        raise UserError(f"{path}: of format {found}, but this version reads {FORMAT}: update flame_mdm")
    if _sha256(state) != digest:
        raise UserError(f"{path}: damaged: its weights are not those that were written; fetch or export it again")
    return model | {"state_dict": state}


def write(
    path: Path, state: Mapping[str, Tensor], *, config: Mapping[str, Any], facts: Mapping[str, Any], origin: Any
) -> None:
    """Writes a model file, under a temporary name until it is whole.

    Args:
        path: the .safetensors file to write.
        state: the state dict of a task.
        config: its recipe.
        facts: what sampling and evaluation have to know of its data.
        origin: where the weights come from; plain values.
    """
    from safetensors.torch import save

    tensors = {name: value.detach().cpu().clone().contiguous() for name, value in state.items()}
    content = {"format": FORMAT, "sha256": _sha256(tensors), "config": config, "facts": facts, "origin": origin}
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        partial.write_bytes(save(tensors, {"format": "pt", KEY: json.dumps(content)}))
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]


def _sha256(state: Mapping[str, Tensor]) -> str:
    digest = hashlib.sha256()
    for name in sorted(state):
        digest.update(f"{name} {state[name].dtype} {tuple(state[name].shape)}".encode())
        digest.update(state[name].numpy().tobytes())
    return digest.hexdigest()


# Commands -------------------------------------------------------------------------------------------------------------


def export(source: str | Path, out: str | Path) -> Path:
    """Writes the model of a checkpoint as a model file; returns the file.

    Args:
        source: what `flame_mdm.load` takes.
        out: the .safetensors file, or a folder to put `model.safetensors` into.

    Raises:
        FileNotFoundError, UserError: as `flame_mdm.load`.
    """
    from flame_mdm.generation import file_sha256
    from flame_mdm.task import read_checkpoint

    source, out = find(source), Path(out)
    checkpoint = read_checkpoint(source)
    origin = checkpoint.get("origin") or {
        "made": "trained with flame_mdm",
        "steps": checkpoint["global_step"],
        "file": source.name,
        "sha256": file_sha256(source),
        "averaged": "current_model_state" in checkpoint,
    }
    out = out if out.suffix == ".safetensors" else out / FILE
    config = _without_own_paths(checkpoint["config"])
    write(out, checkpoint["state_dict"], config=config, facts=checkpoint["facts"], origin=origin)
    return out


def _without_own_paths(config: Mapping[str, Any]) -> dict[str, Any]:
    """The recipe with the folders of data and of the run where they are by default, not where this machine has them."""
    default = {
        config.get("data_root"): "data",
        config.get("run", {}).get("dir"): f"runs/{config['experiment']}/default",
    }
    own = {folder: other for folder, other in default.items() if folder and Path(folder).is_absolute()}

    def moved(node: Any) -> Any:
        if isinstance(node, dict):
            return {name: moved(value) for name, value in node.items()}
        folder = next((f for f in own if isinstance(node, str) and (node == f or node.startswith(f"{f}/"))), None)
        return node if folder is None else own[folder] + node.removeprefix(folder)

    return moved(dict(config))


def import_released(
    kind: str,
    file: str | Path,
    args: str | Path | None,
    out: str | Path,
    *,
    stats: str | Path | None = None,
    averaged: bool = True,
    num_heads: int | None = None,
    time_token: bool = False,
    run_code: bool = False,
) -> Path:
    """Writes a released checkpoint of MDM, MFM, FLAME or FLAME's motion-CLIP as a model file; returns the file.

    Args:
        kind: "mdm", "mfm", "flame" or "mclip".
        file: the released file.
        args: args.json beside it (MDM), or the Hydra configuration of its run (MFM); not for FLAME's.
        out: as in `export`.
        stats: folder with Mean.npy and Std.npy of the data that the model was trained on, where it is normalized.
        averaged, num_heads, time_token: see `flame_mdm.released.import_model`.
        run_code: read pickles that hold more than weights, which runs whatever code is in them.

    Raises:
        FileNotFoundError: a file is absent.
        UserError, ValueError: it is damaged, or not a released model of this kind.
    """
    from flame_mdm.generation import file_sha256
    from flame_mdm.released import import_model

    file, out = Path(file), Path(out)
    if (args is None) != (kind in ("flame", "mclip")):
        needs = {"mdm": "the args.json beside the checkpoint", "mfm": "the run's .hydra/config.yaml"}
        raise UserError(f"{kind} needs {needs[kind]}" if kind in needs else f"{kind} takes no file of options")
    checkpoint = _unpickle(file, run_code)
    try:
        if kind == "mclip":
            model = _motion_clip(checkpoint, num_heads)
        else:
            model = import_model(
                kind,  # type: ignore[arg-type]
                checkpoint,
                {} if args is None else _options(Path(args)),
                statistics=None if stats is None else _statistics(Path(stats)),
                averaged=averaged,
                num_heads=num_heads,
                time_token=time_token,
            )
    except ValueError as error:
        raise UserError(f"{file}: {error}") from error
    out = out if out.suffix == ".safetensors" else out / FILE
    origin = {"made": f"released by the authors of {kind.upper()}", "file": file.name, "sha256": file_sha256(file)}
    write(out, model.state_dict(), config=model.config, facts=model.facts, origin=origin | {"averaged": averaged})
    return out


def _motion_clip(checkpoint: Mapping[str, Any], num_heads: int | None) -> Any:
    """FLAME's motion-CLIP, by the class that its recipe names."""
    from hydra.utils import get_class

    from flame_mdm.config import compose

    sizes = [] if num_heads is None else [f"task.network.num_heads={num_heads}"]
    config = compose("motion_clip/humanml3d_smpl", sizes)
    return get_class(config["task"]["_target_"]).import_released(checkpoint, _without_own_paths(config))


def _unpickle(path: Path, run_code: bool) -> Any:
    import torch

    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        checkpoint = torch.load(path, map_location="cpu", weights_only=not run_code)
    except ImportError as error:
        raise UserError(f"{path}: {error}; the objects in this file need it: install it") from error
    except Exception as error:  # torch raises many kinds for damaged files
        unsafe = re.search(r"Unsupported global: GLOBAL (\S+)", str(error))
        if unsafe is None:
            raise UserError(f"{path}: damaged, or not a PyTorch file") from error
        raise UserError(
            f"{path}: holds Python objects ({unsafe[1]}) beside the weights, as old Lightning files do; reading them "
            "runs whatever code they name: add --run-code-in-file if you trust those who made the file"
        ) from error
    if not isinstance(checkpoint, Mapping):
        raise UserError(f"{path}: holds a {type(checkpoint).__name__}, not the weights of a released model")
    return checkpoint


def _options(path: Path) -> Mapping[str, Any]:
    from omegaconf import OmegaConf

    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        options = OmegaConf.to_container(OmegaConf.load(path))  # JSON is YAML
    except Exception as error:  # YAML's many errors all mean the same here
        raise UserError(f"{path}: neither JSON nor YAML") from error
    if not isinstance(options, dict):
        raise UserError(f"{path}: holds no options by name")
    # In a composed configuration of MFM, those of the network and of the training stand one level down.
    groups = [value for name, value in options.items() if name in ("model", "training") and isinstance(value, dict)]
    return {name: value for part in (*groups, options) for name, value in part.items() if isinstance(name, str)}


def _statistics(folder: Path) -> tuple[Any, Any]:
    import numpy as np
    import torch

    found = []
    for name in ("Mean.npy", "Std.npy"):
        try:
            found.append(torch.from_numpy(np.load(folder / name, allow_pickle=False)))
        except FileNotFoundError:
            raise FileNotFoundError(f"{folder / name}: no such file") from None
        except (ValueError, EOFError, TypeError) as error:
            raise UserError(f"{folder / name}: damaged, or not an array of numbers") from error
    return found[0], found[1]


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
    from flame_mdm.config import save

    if not re.fullmatch(r"[\w.-]+/[\w.-]+", repository):
        raise UserError(f"{repository}: name the model as user/name")
    file = export(source, Path(folder))
    model = read(file)
    save(model["config"], file.parent / "config.yaml", head="The recipe of this model.")
    (file.parent / "README.md").write_text(card(model, repository), encoding="utf-8")
    if upload:
        from huggingface_hub import HfApi

        try:
            HfApi().create_repo(repository, private=private, exist_ok=True)
            HfApi().upload_folder(
                repo_id=repository, folder_path=file.parent, allow_patterns=[FILE, "config.yaml", "README.md"]
            )
        except Exception as error:  # the client raises many kinds: no network, no token, no permission ...
            raise UserError(f"{repository}: {file.parent} is written but not uploaded: {_first_line(error)}") from error
    return file.parent


def card(model: Mapping[str, Any], repository: str) -> str:
    """The card of a model on the hub: recipe, data, provenance, license."""
    config, facts, origin = model["config"], model["facts"], model["origin"]
    license_id, terms = LICENSES.get(facts["dataset"], OTHER_LICENSE)
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
        ("data", facts["dataset"]),
        ("fingerprint of the data", facts["fingerprint"] or "unknown"),
        ("longest motion", f"{facts['max_frames']} frames"),
        ("actions", ", ".join(facts["actions"]) or "none"),
        *((f"weights: {name}", value) for name, value in origin.items()),
    ]
    table = "\n".join(f"| {name} | {value} |" for name, value in rows)
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


USAGE = """
Turns checkpoints into model files (.safetensors) that flame_mdm.load, make sample and make edit take.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    parser = argparse.ArgumentParser(prog="python -m flame_mdm.checkpoints", description=USAGE)
    commands = parser.add_subparsers(dest="command", required=True)
    out = {"required": True, "metavar": "FILE", "help": "a .safetensors file, or a folder for model.safetensors"}

    importing = commands.add_parser("import", help="a checkpoint that the authors of a paper released")
    importing.add_argument("kind", choices=("mdm", "mfm", "flame", "mclip"), help="mclip: FLAME's motion-CLIP")
    importing.add_argument("file", help="model000475000.pt, or FLAME's .ckpt")
    importing.add_argument("args", nargs="?", help="MDM's args.json, or MFM's .hydra/config.yaml")
    importing.add_argument("-o", "--out", **out)
    importing.add_argument("--stats", metavar="FOLDER", help="Mean.npy and Std.npy of HumanML3D or KIT-ML")
    importing.add_argument("--last", action="store_true", help="the last weights, where the file has averaged ones too")
    importing.add_argument("--heads", type=int, help="attention heads, where they are not the released models'")
    importing.add_argument(
        "--time-token", action="store_true", help="a decoder with token of MDM's code since February 2025"
    )
    importing.add_argument(
        "--run-code-in-file", action="store_true", help="read pickles of more than weights: RUNS ANY CODE IN THEM"
    )

    exporting = commands.add_parser("export", help="a checkpoint of make train")
    exporting.add_argument("checkpoint")
    exporting.add_argument("-o", "--out", **out)

    pushing = commands.add_parser("push", help="to the Hugging Face hub, with a card")
    pushing.add_argument("checkpoint")
    pushing.add_argument("repository", help="user/name")
    pushing.add_argument("--folder", help="where the files are written first; default: push/<name>")
    pushing.add_argument("--private", action="store_true")
    pushing.add_argument("--dry-run", action="store_true", help="write the folder, upload nothing")

    words = argparse.Namespace()

    def command() -> None:
        parser.parse_args(sys.argv[1:] if argv is None else argv, words)
        if words.command == "import":
            options = {"stats": words.stats, "averaged": not words.last, "num_heads": words.heads}
            options |= {"time_token": words.time_token, "run_code": words.run_code_in_file}
            print(f"written: {import_released(words.kind, words.file, words.args, words.out, **options)}")
        elif words.command == "export":
            print(f"written: {export(words.checkpoint, words.out)}")
        else:
            folder = words.folder or Path("push") / words.repository.rpartition("/")[2]
            upload = not words.dry_run
            folder = push(words.checkpoint, words.repository, folder, upload=upload, private=words.private)
            print(f"{f'uploaded to {words.repository}' if upload else 'not uploaded'}: {folder}")

    return guarded(command)


if __name__ == "__main__":
    sys.exit(main())
