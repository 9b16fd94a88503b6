"""Evaluations: from a request to a result file."""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flame_mdm.config import (
    EXPERIMENTS,
    Config,
    check,
    instantiate,
    plain,
    trust,
)
from flame_mdm.errors import UserError, say
from flame_mdm.reporting.audit import card_of
from flame_mdm.safe_io import read_yaml, sha256, write_json

if TYPE_CHECKING:  # commands check their keys before torch is imported
    from evaluators.extractors import Extractor
    from evaluators.protocol import Protocol
    from flame_mdm.checkpoints.loading import Which
    from flame_mdm.data import Split
    from flame_mdm.data.datamodule import Clips, MotionDataModule
    from flame_mdm.representations import Representation
    from flame_mdm.task import MotionGeneration

FORMAT = 1
MIN_RESAMPLES = 100


@dataclass(frozen=True, kw_only=True)
class EvaluationRequest:
    """The keys of an evaluation, which `flame-mdm evaluate --help` explains.

    Raises:
        UserError: If keys contradict each other, or a value is out of range.
    """

    ckpt: str | None = None
    which: Which = "last"
    from_samples: str | None = None
    baseline: str | None = None
    data: Config | None = None
    representation: Config | None = None
    protocol: str | None = None
    extractor: str | None = None
    smpl: str | None = None
    split: Split = "test"
    seed: int = 0
    replications: int | None = None
    samples: int | None = None
    resamples: int = 0
    multimodality: bool = True
    quick: bool = False
    force: bool = False
    guidance_scale: float | None = None
    sampler: str | None = None
    num_inference_steps: int | Sequence[int] | None = None
    eta: float | None = None
    spacing: str | None = None
    method: str | None = None
    until: float | None = None
    strength: float | None = None
    batch_size: int | None = None
    device: str | None = None
    data_root: str | None = None
    out: str | None = None

    @classmethod
    def of(cls, config: Config) -> EvaluationRequest:
        """Returns the request of a composed configuration."""
        return cls(**{field.name: config[field.name] for field in fields(cls) if field.name in config})

    def __post_init__(self) -> None:
        what = [name for name in ("ckpt", "from_samples", "baseline") if getattr(self, name) is not None]
        if len(what) != 1:
            raise UserError(
                "give exactly one of ckpt=runs/.../checkpoints/last.ckpt, from_samples=<folder of .npz files> and "
                "baseline=shuffled"
            )
        if what != ["ckpt"] and not self.data:
            raise UserError(f"{what[0]} needs a data set. Add data=NAME, such as data=humanml3d")
        if what != ["ckpt"] and self.protocol is None:
            raise UserError(f"{what[0]} needs a protocol. Add protocol=NAME, such as protocol=text_to_motion")
        if what == ["from_samples"] and (self.quick or self.samples or self.replications):
            raise UserError("from_samples evaluates all motions of the files. Remove quick, samples and replications")
        if self.split not in ("train", "val", "test"):
            raise UserError(f"unknown split: {self.split}. Choose train, val or test")
        if self.resamples and self.resamples < MIN_RESAMPLES:
            raise UserError(f"resamples={self.resamples}: give 0, or {MIN_RESAMPLES} or more for a 95 % interval")
        if self.batch_size is not None and self.batch_size < 1:
            raise UserError(f"batch_size={self.batch_size}: must be at least 1")
        if self.guidance_scale is not None and not math.isfinite(self.guidance_scale):
            raise UserError(f"guidance_scale={self.guidance_scale} is not a finite number")


def evaluate(request: EvaluationRequest) -> None:
    """Evaluates a checkpoint, motion files or a baseline, and writes the result file.

    Raises:
        UserError, FileNotFoundError, ValueError: If a file is missing, or model, data, protocol and extractor
            do not match.
    """
    if request.out is not None:  # checked here, before hours of work
        if Path(request.out).is_dir():
            raise UserError(f"out={request.out} is a folder. Name the JSON file to write")
        Path(request.out).parent.mkdir(parents=True, exist_ok=True)
    with _processes(request.device) as (rank, world, device):
        _evaluate(request, rank, world, device)


@contextmanager
def _processes(device: str | None) -> Iterator[tuple[int, int, str]]:
    """Joins the processes started by torchrun, if any. Yields rank, number of processes, and device of this process."""
    import torch

    from flame_mdm.checkpoints.loading import check_device

    rank, world, local = (int(os.environ.get(n, d)) for n, d in (("RANK", 0), ("WORLD_SIZE", 1), ("LOCAL_RANK", 0)))
    if device is None:
        device = f"cuda:{local % torch.cuda.device_count()}" if torch.cuda.is_available() else "cpu"
    check_device(device)
    if world == 1:
        yield rank, world, device
        return
    # Imported before the group exists: otherwise, the default arguments of its functions would keep the group and its
    # gloo threads alive, and a live thread can abort the process while Python shuts down.
    import torch.distributed.nn.functional

    # Motions are gathered once per replication, on the CPU; a process that finishes early may wait for hours.
    torch.distributed.init_process_group("gloo", timeout=timedelta(days=7))
    try:
        yield rank, world, device
    finally:
        torch.distributed.destroy_process_group()


def _evaluate(request: EvaluationRequest, rank: int, world: int, device: str) -> None:
    from flame_mdm.checkpoints.loading import find, load

    file = find(request.ckpt, request.which) if request.ckpt is not None else None
    model = load(file, device) if file is not None else None
    data = open_data(request, model)
    representation = model.representation if model else data.representation.to(device)
    skeleton = _skeleton(request, representation)
    clips = data.clips(request.split)
    names = ("replications", "samples", "quick", "multimodality", "batch_size")
    changes = {name: getattr(request, name) for name in names}
    name = request.protocol or default_protocol(model)
    protocol, changed = open_protocol(name, clips, representation, model, **changes)
    size = protocol.batch_size or request.batch_size or 64
    extractor = protocol.open_extractor(request.extractor, representation, data.store.info["dataset"])
    report = _describe(request, protocol, model, data, extractor)
    report["skeleton"] = skeleton
    if model is not None and file is not None:
        names = ("guidance_scale", "sampler", "num_inference_steps", "eta", "spacing", "method", "until", "strength")
        sampling = protocol.sampling(model, **{name: getattr(request, name) for name in names})
        report["checkpoint"] |= {"selected_by": _selection(model, file), "sha256": sha256(file), **sampling}
        options = {"seed": request.seed, **sampling}
        folder = _motions_folder(
            file,
            _kind(protocol),
            report["checkpoint"]["sha256"],
            {**options, "split": request.split, "data": data.store.fingerprint, "samples": protocol.samples}
            | ({"batch_size": size} if protocol.batch_size else {}),
        )
        source = protocol.generator(
            model, folder, options, clips=clips, batch_size=size, world=world, progress=not rank
        )
        path = folder / "result"
    elif request.baseline is not None:
        source = protocol.baseline(request.baseline, clips, request.seed)
        path = Path("runs/baselines") / data.store.info["dataset"] / _kind(protocol) / request.baseline
        path = path if request.split == "test" else path.with_name(f"{path.name}-{request.split}")
    else:
        source = protocol.sample_folder(Path(str(request.from_samples)), representation)
        path = Path(str(request.from_samples)) / _kind(protocol)
        report["samples_sha256"] = source.sha256
    report |= {"changed": changed} | protocol.evaluate(
        source,
        clips,
        extractor,
        representation,
        seed=request.seed,
        batch_size=size,
        rank=rank,
        world=world,
        force=request.force,
        resamples=request.resamples,
        training=data.clips("train"),
    )
    if rank:
        return
    for reason in _overlaps(request, model, extractor, data):
        report["valid"] = False
        report["invalid_because"].append(reason)
    name = f"{path.name}-{extractor.sha256[:8]}" if extractor else path.name
    name += "-quick" if request.quick else f"-{protocol.replications}x" if "replications" in changed else ""
    out = Path(request.out or path.with_name(f"{name}.json"))
    write_json(out, report)
    _show(report, out)


def open_protocol(
    name: str, clips: Clips, representation: Representation, model: MotionGeneration | None, **changes: Any
) -> tuple[Protocol, dict[str, Any]]:
    """Returns a protocol for a split and a model, and the options changed by `Protocol.change`.

    Raises:
        UserError: If the protocol does not exist, or does not match the clips or the model.
    """
    protocol = load_protocol(name, representation)
    changed = protocol.change(**changes, clips=len(protocol.selected(clips)))
    protocol.check_data(clips)
    if model is not None:
        check_condition(protocol, model)
    return protocol, changed


def _motions_folder(checkpoint: Path, kind: str, digest: str, options: Mapping[str, Any]) -> Path:
    """Returns the folder of the motions that a checkpoint generates with some options."""
    return run_folder(checkpoint) / "evaluation" / kind / f"{digest[:16]}-{_digest(options)[:8]}"


def _kind(protocol: Protocol) -> str:
    return f"{protocol.name}-{protocol.version}"


def protocol_file(name: str) -> Path:
    """Returns the file of a protocol, by its name in experiments/evaluation or its path.

    Raises:
        UserError: If the protocol does not exist.
    """
    path = Path(name) if name.endswith((".yaml", ".yml")) else EXPERIMENTS / "evaluation" / f"{name}.yaml"
    if not path.exists():
        names = ", ".join(sorted(p.stem for p in path.parent.glob("*.yaml")))
        raise UserError(f"no protocol is called '{name}'. Available: {names or 'none'}")
    return path


def load_protocol(name: str, representation: Representation) -> Protocol:
    """Loads a protocol for motions of a representation.

    Its file may use ${representation.fps}, ${representation.feet}, ${representation.toes} and
    ${representation.parents}.

    Args:
        name: a name in experiments/evaluation, or the path of a .yaml file.
        representation: of the motions.

    Raises:
        UserError: If the protocol does not exist or cannot be read.
    """
    from evaluators.protocol import Protocol

    path = protocol_file(name)
    skeleton = representation.skeleton
    feet, parents = list(skeleton.feet), list(skeleton.parents)
    facts = {"fps": representation.fps, "feet": feet, "toes": feet[1::2], "parents": parents}
    known = {f"${{representation.{fact}}}": value for fact, value in facts.items()}

    def filled(node: Any) -> Any:
        if isinstance(node, dict):
            return {key: filled(value) for key, value in node.items()}
        return [filled(value) for value in node] if isinstance(node, list) else known.get(str(node), node)

    config = filled(read_yaml(path))
    if not isinstance(config, dict) or "_target_" not in config:
        raise UserError(f"{path}: not a protocol: it has no _target_, such as evaluators.protocol.Protocol")
    plain(config, path)
    check(config)
    protocol = instantiate(config)
    if not isinstance(protocol, Protocol):
        raise UserError(f"{path}: not a protocol: {config['_target_']}. Name evaluators.protocol.Protocol")
    protocol.sha256 = _digest(config)
    return protocol


def default_protocol(model: MotionGeneration | None) -> str:
    """Returns the name of the default protocol for a model."""
    assert model is not None
    condition = model.conditioned_on
    if condition == "none":
        return "unconditioned"
    if condition == "action":
        released = {"humanact12": "action_to_motion", "uestc": "action_to_motion_uestc"}
        return released.get(model.facts.get("dataset", ""), "action_to_motion_own")
    return "synthetic" if model.facts.get("dataset") == "synthetic" else "text_to_motion"


def check_condition(protocol: Protocol, model: MotionGeneration) -> None:
    """Checks that the model was trained with the condition of the protocol.

    Raises:
        UserError: If it was trained with another condition.
    """
    if protocol.condition not in ("none", model.conditioned_on):
        raise UserError(
            f"protocol {protocol.name} generates motions from {protocol.condition}, but the checkpoint was trained "
            f"with condition {model.conditioned_on}. Choose another protocol, such as {default_protocol(model)}"
        )


def run_folder(checkpoint: Path) -> Path:
    """Returns the run directory of a checkpoint, or the folder of a file that belongs to no run."""
    return checkpoint.parent.parent if checkpoint.parent.name == "checkpoints" else checkpoint.parent


def open_data(request: EvaluationRequest, model: MotionGeneration | None) -> MotionDataModule:
    """Returns the prepared data, with its own representation. The model keeps the statistics of its training data."""
    from flame_mdm.data.datamodule import MotionDataModule

    module, encoding, root = request.data, request.representation, "data"
    if model is not None and not module:
        if "data" not in model.config:
            raise UserError(f"{request.ckpt}: its recipe names no data set. Add data=NAME")
        module, encoding = model.config["data"], model.config["representation"]
        trust({"data": module})
        root = module.get("root")
    assert module is not None
    assert encoding is not None
    root = request.data_root or os.environ.get("FLAME_MDM_DATA") or root
    representation: Representation = instantiate(encoding)
    if model is not None and representation.name != model.representation.name:
        raise UserError(
            f"the checkpoint generates {model.representation.name}, but the data set {module['name']} has "
            f"{representation.name}"
        )
    data = instantiate(module | {"root": root}, representation=representation, seed=0)
    if not isinstance(data, MotionDataModule):
        raise UserError(f"{request.ckpt}: its recipe names {type(data).__name__} as the data set. Add data=NAME")
    data.setup("test")
    return data


def _overlaps(
    request: EvaluationRequest, model: MotionGeneration | None, extractor: Extractor | None, data: MotionDataModule
) -> list[str]:
    """Returns reasons why values are not valid: evaluated clips may be training clips of the model or extractor.

    `make train` trains on the training split, so that an extractor of the same data has seen the others only if they
    are the training split, too: the footnotes of tables mark published splits like that.
    """
    here, reasons = data.store.fingerprint, []
    for what, trained in (
        ("training data", model.facts.get("fingerprint") if model is not None else None),
        ("training data of the extractor", extractor.fingerprint if extractor is not None else None),
    ):
        if trained and trained != here:
            reasons.append(f"{what} {trained} and evaluated data {here} differ: splits may overlap")
    if extractor is not None and extractor.fingerprint == here and request.split == "train":
        reasons.append("the extractor was trained on the evaluated split, train")
    return reasons


def _describe(
    request: EvaluationRequest,
    protocol: Protocol,
    model: MotionGeneration | None,
    data: MotionDataModule,
    extractor: Extractor | None,
) -> dict[str, Any]:
    """Returns the provenance of a result."""
    import torch

    from flame_mdm.training.provenance import environment

    info = data.store.info
    where = (model.representation if model else data.representation).mean.device
    card = card_of(info["dataset"], extractor.sha256 if extractor else None)
    report: dict[str, Any] = {
        "format": FORMAT,
        "quick": request.quick,
        "protocol": {
            "name": protocol.name,
            "version": protocol.version,
            "sha256": protocol.sha256,
            "length_source": "ground truth",
        },
        "split": request.split,
        "published_split": info["published_split"],
        "data": {
            "dataset": info["dataset"],
            "representation": info["representation"],
            "fingerprint": info["fingerprint"],
            "frames": [data.crop.shortest(), data.crop.longest()],
            "excluded": _excluded(data, request.split),
        },
        "seed": request.seed,
        "extractor": extractor
        and {"path": str(request.extractor), "sha256": extractor.sha256, "data": extractor.fingerprint},
        "samples_sha256": None,
        "audit": card.as_posix() if card else None,
        "baseline": request.baseline,
        "checkpoint": None,
        "device": torch.cuda.get_device_name(where) if where.type == "cuda" else "cpu",
        "precision": f"float32, matmul {torch.get_float32_matmul_precision()}",
        "environment": environment(),
    }
    if model is not None:
        report["checkpoint"] = {
            "path": str(request.ckpt),
            "experiment": model.config.get("experiment"),
            "config_sha256": _digest(model.config),
            "averaged_weights": bool(model.config.get("ema")),
            "parameters": sum(p.numel() for p in model.parameters() if p.requires_grad),
            "prediction": {"epsilon": "noise"}.get(model.process.prediction, model.process.prediction),
            "training_steps": model.steps,
            **{f"training_{name}": value for name, value in model.facts.get("training", {}).items()},
        }
    return report


def _skeleton(request: EvaluationRequest, representation: Representation) -> dict[str, Any] | None:
    """Sets the bone offsets of a representation of SMPL rotations from SMPL's model file, if it is given.

    Returns:
        "stand_in": whether a stand-in skeleton is used, because the file is not given; "smpl_sha256": hash of the file.
        None if motions are represented by joint positions, which need no skeleton.

    Raises:
        FileNotFoundError, ValueError: no such file, or no SMPL model.
    """
    from flame_mdm.data.body_model import load_offsets
    from flame_mdm.representations.rot6d import Rot6D
    from flame_mdm.representations.smpl import SMPL

    if not isinstance(representation, SMPL | Rot6D):
        return None
    if request.smpl is None:
        return {"stand_in": True, "smpl_sha256": None}
    representation.offsets = load_offsets(Path(request.smpl))
    return {"stand_in": False, "smpl_sha256": sha256(request.smpl)}


def _excluded(data: MotionDataModule, split: Split) -> dict[str, int]:
    """Returns the number of clips excluded from the data set and from the split, by reason."""
    short = data.clips(split).too_short
    reason = f"{split} clips shorter than {data.crop.shortest()} frames"
    return data.store.info["excluded"] | ({reason: short} if short else {})


def _selection(model: MotionGeneration, file: Path) -> str:
    """Returns how a checkpoint was selected among those of its run, judging by its file name."""
    best = (model.config.get("callbacks") or {}).get("best") or {}
    return f"best {best['monitor']}" if file.stem == "best" and "monitor" in best else f"none: {file.stem}"


def _digest(values: Any) -> str:
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def _show(report: Mapping[str, Any], out: Path) -> None:
    """Prints the values next to those of real motions."""
    protocol = report["protocol"]
    mark = " QUICK RUN, NOT FOR PUBLICATION" if report["quick"] else ""
    say(f"{protocol['name']} version {protocol['version']}, {report['data']['dataset']} {report['split']}{mark}")
    say(f"{'':32}{'real motions':>24}{report['baseline'] or 'generated':>24}")
    for name, value in report["values"].items():
        real = report["ground_truth"].get(name)
        if any(found is not None and found["mean"] is not None for found in (real, value)):
            say(f"{name:32}{_cell(real):>24}{_cell(value):>24}")
    for reason, count in report["data"]["excluded"].items():
        say(f"excluded from the data set: {count} {reason}")
    for name, reason in report["not_computed"].items():
        say(f"not computed: {name}: {reason}")
    if report["skeleton"] and report["skeleton"]["stand_in"]:
        say("warning: joints were computed with a stand-in skeleton. Give SMPL's model file for its own: smpl=FILE")
    for reason in report["warnings"]:
        say(f"warning: {reason}")
    for reason in report["invalid_because"]:
        say(f"NOT VALID: {reason}")
    if report["audit"] is None:
        say(f"not audited: what this evaluator sees is not known. make audit DATA={report['data']['dataset']} tells")
    say(f"written: {out}")


def _cell(value: Mapping[str, Any] | None) -> str:
    return "-" if value is None or value["mean"] is None else f"{value['mean']:.4g} +- {value['ci']:.2g}"
