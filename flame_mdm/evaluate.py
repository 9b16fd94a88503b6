"""Evaluates a checkpoint: `python -m flame_mdm.evaluate ckpt=... protocol=synthetic extractor=...`"""

from __future__ import annotations

import hashlib
import json
import math
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flame_mdm.config import EXPERIMENTS, Config, UserError, check, instantiate, run, trust

if TYPE_CHECKING:
    from flame_mdm.data.datamodule import MotionDataModule
    from flame_mdm.representations import Representation
    from flame_mdm.task import MotionGeneration

USAGE = """
usage: python -m flame_mdm.evaluate ckpt=FILE [protocol=NAME] extractor=FILE [key=value ...]
       python -m flame_mdm.evaluate from_samples=FOLDER data=NAME protocol=NAME extractor=FILE
       python -m flame_mdm.evaluate baseline=shuffled data=NAME protocol=NAME extractor=FILE
       torchrun --nproc-per-node 8 -m flame_mdm.evaluate ckpt=FILE ...

Measures real motions and generated ones by a protocol, and writes a JSON file with all values and where they come from.
The same command goes on where a killed one stopped. quick=true shows in a minute that all works.
Keys, with their defaults: experiments/evaluate.yaml; protocols: experiments/evaluation
"""

FORMAT = 1


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    words = sys.argv[1:] if argv is None else argv
    text = ("ckpt", "extractor", "from_samples", "protocol", "data_root", "out")
    like = ("flame_mdm.task.generate", "evaluators.protocols.change")
    return run(evaluate, words, usage=USAGE, name="evaluate", text=text, like=like)


def evaluate(config: Config) -> None:
    """Evaluates what the configuration names, and writes the JSON file.

    Raises:
        UserError, FileNotFoundError, ValueError: nothing to evaluate, or parts that do not fit one another.
    """
    what = [name for name in ("ckpt", "from_samples", "baseline") if config[name] is not None]
    if len(what) != 1:
        raise UserError(
            "give one of ckpt=runs/.../checkpoints/last.ckpt, from_samples=<folder of .npz files> and baseline=shuffled"
        )
    if what != ["ckpt"] and not config.get("data"):
        raise UserError(f"{what[0]} needs the name of the data set, such as data=humanml3d")
    if what != ["ckpt"] and config["protocol"] is None:
        raise UserError(f"{what[0]} needs a protocol, such as protocol=text_to_motion")
    if what == ["from_samples"] and (config["quick"] or config["samples"] or config["replications"]):
        raise UserError("from_samples measures all motions of the files: leave out quick, samples and replications")
    if config["split"] not in ("train", "val", "test"):
        raise UserError(f"split={config['split']}: there are train, val and test")
    if config["batch_size"] < 1:
        raise UserError(f"batch_size={config['batch_size']}: at least 1 is needed")
    if config["guidance_scale"] is not None and not math.isfinite(config["guidance_scale"]):
        raise UserError(f"guidance_scale={config['guidance_scale']} is no finite number")
    if config["out"] is not None:  # before hours of work
        if Path(config["out"]).is_dir():
            raise UserError(f"out={config['out']} is a folder; name the JSON file to write")
        Path(config["out"]).parent.mkdir(parents=True, exist_ok=True)
    with _processes(config["device"]) as (rank, world, device):
        _evaluate(config, rank, world, device)


@contextmanager
def _processes(device: str | None) -> Iterator[tuple[int, int, str]]:
    """Joins the processes that torchrun has started, if it has: number of this one, of all, device of this one."""
    import torch

    rank, world, local = (int(os.environ.get(n, d)) for n, d in (("RANK", 0), ("WORLD_SIZE", 1), ("LOCAL_RANK", 0)))
    if device is None:
        device = f"cuda:{local % torch.cuda.device_count()}" if torch.cuda.is_available() else "cpu"
    if world == 1:
        yield rank, world, device
        return
    # Motions are sent once a replication, by the CPU; a process that is done may wait for hours.
    torch.distributed.init_process_group("gloo", timeout=timedelta(days=7))
    try:
        yield rank, world, device
    finally:
        torch.distributed.destroy_process_group()


def _evaluate(config: Config, rank: int, world: int, device: str) -> None:
    from flame_mdm.checkpoints import find
    from flame_mdm.generation import file_sha256
    from flame_mdm.task import load

    file = find(config["ckpt"]) if config["ckpt"] is not None else None
    model = load(file, device) if file is not None else None
    data = _data(config, model)
    representation = model.representation if model else data.representation.to(device)
    protocol = load_protocol(config["protocol"] or default_protocol(model), representation)
    clips = data.clips(config["split"])
    changes = {name: config[name] for name in ("replications", "samples", "quick", "multimodality")}
    changed = protocol.change(**changes, clips=len(clips))
    protocol.check_data(clips)
    if model is not None:
        check_condition(protocol, model)
    extractor = protocol.open_extractor(config["extractor"], representation, data.store.info["dataset"])

    kind = f"{protocol.name}-{protocol.version}"
    report = _describe(config, protocol, model, data, extractor)
    if model is not None:
        assert file is not None
        names = ("guidance_scale", "sampler", "num_inference_steps", "method", "until")
        sampling = protocol.sampling(model, **{name: config[name] for name in names})
        report["checkpoint"] |= {"sha256": file_sha256(file), **sampling}
        options = {"seed": config["seed"], **sampling}
        kept = {**options, "split": config["split"], "data": data.store.fingerprint, "samples": protocol.samples}
        folder = run_folder(file) / "evaluation" / kind / f"{report['checkpoint']['sha256'][:16]}-{_digest(kept)[:8]}"
        source = protocol.generator(
            model, folder, options, clips=clips, batch_size=config["batch_size"], world=world, progress=not rank
        )
        name = "result"
    elif config["baseline"] is not None:
        source = protocol.baseline(config["baseline"], clips, config["seed"])
        folder, name = Path("runs/baselines") / data.store.info["dataset"] / kind, config["baseline"]
        name += "" if config["split"] == "test" else f"-{config['split']}"
    else:
        folder, name = Path(config["from_samples"]), kind
        source = protocol.given(folder, representation)
        report["samples_sha256"] = source.sha256
    report |= {"changed": changed} | protocol.evaluate(
        source,
        clips,
        extractor,
        representation,
        seed=config["seed"],
        batch_size=config["batch_size"],
        rank=rank,
        world=world,
    )
    if rank:
        return
    for reason in _strangers(model, data):
        report["valid"] = False
        report["invalid_because"].append(reason)
    name += f"-{extractor.sha256[:8]}" if extractor else ""
    name += "-quick" if config["quick"] else f"-{protocol.replications}x" if "replications" in changed else ""
    out = Path(config["out"] or folder / f"{name}.json")
    write_json(out, report)
    _show(report, out)


def load_protocol(name: str, representation: Representation) -> Any:
    """The protocol of that name in experiments/evaluation, or in a file, for motions of a representation.

    Its file may use ${representation.fps}, ${representation.toes} and ${representation.parents}.

    Raises:
        UserError: no such protocol, or one that cannot be read.
    """
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException
    from yaml import YAMLError

    path = Path(name) if name.endswith((".yaml", ".yml")) else EXPERIMENTS / "evaluation" / f"{name}.yaml"
    if not path.is_file():
        names = ", ".join(sorted(p.stem for p in path.parent.glob("*.yaml")))
        raise UserError(f"no protocol is called '{name}'; there are: {names or 'none'}")
    skeleton = representation.skeleton
    facts = {"fps": representation.fps, "toes": list(skeleton.feet[1::2]), "parents": list(skeleton.parents)}
    try:
        merged = OmegaConf.merge({"representation": facts}, OmegaConf.load(path))
        config: Config = OmegaConf.to_container(merged, resolve=True)  # type: ignore[assignment]
    except (OmegaConfBaseException, YAMLError, OSError, ValueError, TypeError) as error:
        raise UserError(f"{path}: not a readable protocol: {' '.join(str(error).split())}") from error
    del config["representation"]
    if "_target_" not in config:
        raise UserError(f"{path}: not a protocol: it has no _target_, such as evaluators.protocols.Protocol")
    check(config)
    protocol = instantiate(config)
    protocol.sha256 = _digest(config)
    return protocol


def default_protocol(model: MotionGeneration | None) -> str:
    """The protocol for what a model was trained to do."""
    assert model is not None
    condition = _condition(model)
    if condition == "none":
        return "unconditioned"
    if condition == "action":
        released = {"humanact12": "action_to_motion", "uestc": "action_to_motion_uestc"}
        return released.get(model.facts["dataset"], "action_to_motion_own")
    return "synthetic" if model.facts["dataset"] == "synthetic" else "text_to_motion"


def _condition(model: MotionGeneration) -> str:
    """What a model was trained to generate motions for."""
    if not model.condition.features:
        return "none"
    return "action" if model.config["condition"]["_target_"].endswith("ActionLabels") else "text"


def check_condition(protocol: Any, model: MotionGeneration) -> None:
    """Refuses a protocol whose motions are generated for what the model was not trained with.

    Raises:
        UserError: so it is.
    """
    if protocol.condition not in ("none", _condition(model)):
        raise UserError(
            f"protocol {protocol.name} generates motions for {protocol.condition}, but the checkpoint was trained with "
            f"condition {_condition(model)}: choose another protocol, such as {default_protocol(model)}"
        )


def run_folder(checkpoint: Path) -> Path:
    """The folder of the run that a checkpoint belongs to; that of the file where it belongs to none."""
    return checkpoint.parent.parent if checkpoint.parent.name == "checkpoints" else checkpoint.parent


def _data(config: Config, model: MotionGeneration | None) -> MotionDataModule:
    """The prepared data, with a representation of its own: the model keeps the statistics it was trained with."""
    own = model is not None and not config.get("data")
    recipe = model.config if own and model is not None else config
    if "data" not in recipe:
        raise UserError(f"{config['ckpt']}: its recipe names no data; give data=NAME")
    if own:
        trust({"data": recipe["data"]})
    root = config["data_root"] or os.environ.get("FLAME_MDM_DATA") or (recipe["data"]["root"] if own else "data")
    representation = instantiate(recipe["representation"])
    if model is not None and representation.name != model.representation.name:
        raise UserError(
            f"the checkpoint makes {model.representation.name}, the data set {config['data']['name']} holds "
            f"{representation.name}"
        )
    data: MotionDataModule = instantiate(recipe["data"] | {"root": root}, representation=representation, seed=0)
    data.setup("test")
    return data


def _strangers(model: MotionGeneration | None, data: MotionDataModule) -> list[str]:
    """Why values of the model on this data say little: its training clips may be among those tested."""
    trained = model.facts.get("fingerprint") if model is not None else None
    if not trained or trained == data.store.fingerprint:
        return []
    return [f"the model was trained on data {trained}, this is {data.store.fingerprint}: splits may overlap"]


def _describe(
    config: Config,
    protocol: Any,
    model: MotionGeneration | None,
    data: MotionDataModule,
    extractor: Any,
) -> dict[str, Any]:
    """Where the values of a result come from."""
    import torch

    from flame_mdm.provenance import environment

    info = data.store.info
    where = (model.representation if model else data.representation).mean.device
    report: dict[str, Any] = {
        "format": FORMAT,
        "quick": config["quick"],
        "protocol": {
            "name": protocol.name,
            "version": protocol.version,
            "sha256": protocol.sha256,
            "length_source": "ground truth",
        },
        "split": config["split"],
        "published_split": info["published_split"],
        "data": {
            "dataset": info["dataset"],
            "representation": info["representation"],
            "fingerprint": info["fingerprint"],
            "frames": [data.crop.shortest(), data.crop.longest()],
        },
        "seed": config["seed"],
        "extractor": extractor
        and {"path": str(config["extractor"]), "sha256": extractor.sha256, "data": extractor.fingerprint},
        "samples_sha256": None,
        "baseline": config["baseline"],
        "checkpoint": None,
        "device": torch.cuda.get_device_name(where) if where.type == "cuda" else "cpu",
        "precision": f"float32, matmul {torch.get_float32_matmul_precision()}",
        "environment": environment(),
    }
    if model is not None:
        report["checkpoint"] = {
            "path": str(config["ckpt"]),
            "experiment": model.config.get("experiment"),
            "config_sha256": _digest(model.config),
            "averaged_weights": bool(model.config.get("ema")),
            "parameters": sum(p.numel() for p in model.parameters() if p.requires_grad),
            "selected_by": _selection(model, Path(str(config["ckpt"]))),
        }
    return report


def _selection(model: MotionGeneration, file: Path) -> str:
    """By which rule a checkpoint was chosen among those of its run, as far as its name tells."""
    best = (model.config.get("callbacks") or {}).get("best") or {}
    return f"best {best['monitor']}" if file.stem == "best" and "monitor" in best else f"none: {file.stem}"


def _digest(values: Any) -> str:
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def write_json(path: Path, report: Mapping[str, Any]) -> None:
    """Writes a result, under a temporary name until it is whole."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(".partial")
    try:
        partial.write_text(json.dumps(report, indent=2, allow_nan=False) + "\n")
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def _show(report: Mapping[str, Any], out: Path) -> None:
    """Prints the values beside those of real motions."""
    protocol = report["protocol"]
    mark = " QUICK, NOT A RESULT" if report["quick"] else ""
    print(f"{protocol['name']} version {protocol['version']}, {report['data']['dataset']} {report['split']}{mark}")
    print(f"{'':32}{'real motions':>24}{report['baseline'] or 'generated':>24}")
    for name, value in report["values"].items():
        real = report["ground_truth"].get(name)
        print(f"{name:32}{_cell(real):>24}{_cell(value):>24}")
    for name, reason in report["not_computed"].items():
        print(f"not computed: {name}: {reason}")
    for reason in report["warnings"]:
        print(f"warning: {reason}")
    for reason in report["invalid_because"]:
        print(f"NOT VALID: {reason}")
    print(f"written: {out}")


def _cell(value: Mapping[str, Any] | None) -> str:
    return "-" if value is None or value["mean"] is None else f"{value['mean']:.4g} +- {value['ci']:.2g}"


if __name__ == "__main__":
    sys.exit(main())
