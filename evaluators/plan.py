# pyright: standard
"""The parts of an evaluation: model, data, protocol, extractor, source and file names."""

import os
from pathlib import Path
from typing import Any

from evaluators.evaluation_request import EvaluationRequest
from evaluators.protocol import Protocol, default_protocol, digest, open_protocol
from evaluators.sources import Baseline, Generator, SampleFolder, Source
from flame_mdm.checkpoints.loading import find, load
from flame_mdm.config import instantiate, trust
from flame_mdm.data.body_model import load_offsets
from flame_mdm.data.datamodule import MotionDataModule
from flame_mdm.errors import UserError
from flame_mdm.generator import MotionGenerator
from flame_mdm.records import UsedSkeleton
from flame_mdm.representations import Representation
from flame_mdm.representations.rot6d import Rot6D
from flame_mdm.representations.smpl import SMPL
from flame_mdm.safe_io import sha256
from flame_mdm.safe_io.paths import check_within
from flame_mdm.sampler_options import SamplerOptions
from flame_mdm.sampling.editing import method_options
from flame_mdm.sampling.motion_request import EditRequest


class Plan:
    """All parts of an evaluation, opened and checked before anything is measured.

    Raises `UserError` or `FileNotFoundError` if a file is missing, or if the model, data, protocol
    and extractor do not match.

    Attributes:
        model, file, sampling: the model, its checkpoint and its sampling options. If the motions do
            not come from a model, they are None, None and {}.
        clips, representation: the evaluated split of `data`, and the representation on its
            device.
        skeleton: source of the bone lengths if joints are computed from SMPL's rotations, or None
            if the data contains joint positions.
        protocol, changed: the protocol with the requested numbers of motions and replications, and
            the options that were changed.
        path: path of the result file.
    """

    source: Source

    def __init__(self, request: EvaluationRequest, device: str):
        self.file = find(request.ckpt, request.which) if request.ckpt is not None else None
        self.model = model = load(self.file, device) if self.file is not None else None
        self.data = data = open_data(request, model)
        self.representation = model.representation if model else data.representation.to(device)
        self.skeleton = set_bones(request.smpl, self.representation)
        self.clips = data.clips(request.split)
        name = request.protocol or (default_protocol(model) if model else "")
        names = ("replications", "samples", "quick", "multimodality", "batch_size")
        size = {name: getattr(request, name) for name in names}
        protocol, self.changed = open_protocol(name, self.clips, self.representation, model, **size)
        self.extractor = protocol.open_extractor(
            request.extractor, self.representation, data.store.info["dataset"]
        )
        self.batch_size = protocol.batch_size or request.batch_size or 64
        self.sampling: dict[str, Any] = {}
        if model is not None and self.file is not None:
            options, edit = sampling_options(protocol, model, request.options, request.editing)
            self.sampling = options.chosen() | {"edit": edit}
            folder = self._motions_folder(request, self.file, protocol)
            cached: dict[str, Any] = {
                "seed": request.seed,
                "batch_size": self.batch_size,
                "folder": folder,
            }
            self.source = Generator(model, protocol, self.clips, options, edit, **cached)
            path = folder / "result"
        elif request.baseline is not None:
            self.source = Baseline(request.baseline, self.clips, protocol.condition, request.seed)
            split = f"-{request.split}" if request.split != "test" else ""
            seed = f"-seed{request.seed}" if request.seed else ""
            count = (
                f"-{protocol.samples}" if "samples" in self.changed and not request.quick else ""
            )
            path = (
                Path("runs/baselines")
                / data.store.info["dataset"]
                / protocol.title
                / f"{request.baseline}{split}{seed}{count}"
            )
        else:
            self.source = SampleFolder(Path(str(request.from_samples)), self.representation)
            sizes = {"replications": len(self.source.files), "samples": None}
            resized = protocol.resized_samples or protocol.samples is not None
            protocol = protocol.model_copy(update=sizes | {"resized_samples": resized})
            path = Path(str(request.from_samples)) / protocol.title
        self.protocol = protocol
        suffix = f"-{self.extractor.sha256[:8]}" if self.extractor else ""
        suffix += (
            "-quick"
            if request.quick
            else f"-{protocol.replications}x"
            if "replications" in self.changed
            else ""
        )
        self.path = Path(request.out or path.with_name(f"{path.name}{suffix}.json"))

    def _motions_folder(self, request: EvaluationRequest, file: Path, protocol: Protocol) -> Path:
        """Returns the folder for motions generated from a checkpoint with these options.

        The folder is in the checkpoint's run directory or, if there is none, next to the
        checkpoint. Motions from models in this package or on the hub are stored under runs/NAME in
        the working directory.
        """
        if not Path(str(request.ckpt)).exists():
            run = Path("runs") / str(request.ckpt)
        else:
            run = file.parent.parent if file.parent.name == "checkpoints" else file.parent
        used = self.sampling | {
            "seed": request.seed,
            "split": request.split,
            "samples": protocol.samples,
        }
        used |= {"data": self.data.store.fingerprint}
        used |= {"batch_size": self.batch_size} if protocol.batch_size else {}
        folder = run / "evaluation" / protocol.title / f"{sha256(file)[:16]}-{digest(used)[:8]}"
        check_within(folder, run)  # another user may own the run directory
        return folder


def open_data(request: EvaluationRequest, model: MotionGenerator | None) -> MotionDataModule:
    """Returns the prepared data, in the representation in which it is stored.

    Raises `UserError` if no data set is specified, if the data set is not prepared, or if the model
    generates a different representation.
    """
    module, encoding, root = request.data, request.representation, "data"
    if model is not None and not module:
        if "data" not in model.config:
            raise UserError(f"{request.ckpt}: its recipe specifies no data set. Add data=NAME")
        module, encoding = model.config["data"], model.config["representation"]
        trust({"data": module})
        root = module.get("root")
    assert module is not None
    assert encoding is not None
    root = request.data_root or os.environ.get("FLAME_MDM_DATA") or root
    representation: Representation = instantiate(encoding)
    if model is not None and representation.name != model.representation.name:
        names = f"{model.representation.name}, but the data set {module['name']} has {representation.name}"
        raise UserError(f"the checkpoint generates {names}")
    data = instantiate(module | {"root": root}, representation=representation, seed=0)
    if not isinstance(data, MotionDataModule):
        raise UserError(
            f"{request.ckpt}: its recipe specifies {type(data).__name__} as the data set. Add data=NAME"
        )
    data.setup("test")
    return data


def set_bones(smpl: str | None, representation: Representation) -> UsedSkeleton | None:
    """Sets the bones of a representation with SMPL's rotations to the bones in SMPL's model file.

    Without this file, the stand-in bones are kept.
    """
    if not isinstance(representation, SMPL | Rot6D):
        return None
    if smpl is None:
        return UsedSkeleton(stand_in=True)
    representation.offsets = load_offsets(Path(smpl))
    return UsedSkeleton(stand_in=False, smpl_sha256=sha256(smpl))


def sampling_options(
    protocol: Protocol,
    model: MotionGenerator,
    options: SamplerOptions | None = None,
    editing: EditRequest | None = None,
) -> tuple[SamplerOptions, dict[str, Any]]:
    """Returns the options of the sampler and of `Edit`.

    Options that are not requested keep their values from the recipe.
    """
    options, editing = options or SamplerOptions(), editing or EditRequest()
    edit: dict[str, Any] = {}
    if protocol.edit is not None:
        edit, options = method_options(model.process, editing, options)
    elif editing != EditRequest():
        raise UserError(
            f"protocol {protocol.name} does not edit motions. Remove method, until and strength"
        )
    options = options.over(model.sampler_options)
    model.process.find_sampler(options)
    return options, edit
