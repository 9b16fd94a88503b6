"""Commands, each in its own file; `flame_mdm.__main__` lists them.

This module contains the keys that several commands share.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flame_mdm.checkpoints.locating import Which, find
from flame_mdm.config import EXPERIMENTS, Config, compose_data
from flame_mdm.config.options import option, required, same_option
from flame_mdm.errors import UserError, did_you_mean, first_line, say
from flame_mdm.formats import ADVICE, ENDINGS, motion_files, unread
from flame_mdm.sampler_options import SamplerOptions
from flame_mdm.sampling.motion_request import EditRequest, SamplingRequest

if TYPE_CHECKING:
    from flame_mdm.formats.characters import BvhCharacter, Character
    from flame_mdm.formats.motion import Motion
    from flame_mdm.generator import MotionGenerator
    from flame_mdm.visualize.body import Mesh

STORE = "store.json"


def usual_data_root() -> str:
    """Returns the folder of the prepared data sets: `FLAME_MDM_DATA` or, by default, `data`."""
    return os.environ.get("FLAME_MDM_DATA", "data")


def existing(key: str, source: str) -> None:
    """Raises `FileNotFoundError` if a file or folder does not exist."""
    if not Path(source).exists():
        raise FileNotFoundError(f"{source}: no such file")


def motion_file(key: str, source: str) -> None:
    """Checks that a motion file exists and that its extension is supported.

    `dataset:id` is only checked when the clip is read.
    """
    if Path(source).suffix.lower() in ENDINGS:
        existing(key, source)
    elif Path(source).suffix.lower() in ADVICE:
        raise unread(Path(source))
    elif ":" not in source:
        raise UserError(
            f"{key}={source}: neither a motion file ({', '.join(ENDINGS)}) nor dataset:id"
        )


def finish(failures: Sequence[str], total: int, done: str) -> None:
    """If any motions failed, prints their errors and exits with code 1.

    `done` is the past participle in the error message, such as "converted".
    """
    if failures:
        say(*(f"error: {failure}" for failure in failures), error=True)
        say(f"error: {len(failures)} of {total} motions could not be {done}", error=True)
        raise SystemExit(1)


def model_source(key: str, source: str) -> None:
    """Checks that the files of an extractor or another model exist."""
    if source != "none" and not Path(source).exists():
        try:
            find(source)
        except (UserError, FileNotFoundError) as error:
            raise UserError(f"{key}: {error}") from error


def body_name(key: str, body: str) -> None:
    """Raises `UserError` unless `body` is "mannequin", an Anny body or a file."""
    if body.split()[:1] not in (["mannequin"], ["anny"]) and not Path(body).is_file():
        raise UserError(
            f'{key}={body}: no such file. Use mannequin, a file, or Anny: {key}="anny age=0.9"'
        )


def device_name(key: str, device: str) -> None:
    """Raises `UserError` if `device` is not a device name such as cpu or cuda:1."""
    if not re.fullmatch(r"cpu|mps|xpu|cuda(:\d+)?", device):
        near = did_you_mean(device, ["cpu", "cuda"])
        raise UserError(f"{key}={device}: unknown.{near} Use cpu, cuda or cuda:NUMBER")


def video(key: str, requested: bool) -> None:
    """If MP4 files are requested, checks that they can be written."""
    if requested and find_spec("av") is None:
        raise UserError(
            f'{key}=true: MP4 requires the av package. Run pip install "flame-mdm[video]", or write a GIF'
        )


def above_zero(key: str, number: int) -> None:
    """Raises `UserError` if `number` is less than 1."""
    if number < 1:
        raise UserError(f"{key}={number}: must be at least 1")


@dataclass(frozen=True, kw_only=True)
class ModelSettings:
    """Keys that specify a model."""

    ckpt: str = required(
        "a checkpoint, run directory, model file, shipped model (package, quickstart, package_dip), or hub id"
    )
    which: Which = option("last", "which checkpoint of a run directory: last or best")

    def model_file(self) -> Path:
        """Returns the path of the model file; see `flame_mdm.checkpoints.locating.find`."""
        return find(self.ckpt, self.which)


@dataclass(frozen=True, kw_only=True)
class AdaptedSettings(ModelSettings):
    """Keys that specify a model and its adapters."""

    adapter: list[str] | None = option(
        None, "adapters for this model, written by `flame-mdm adapt` and separated by spaces"
    )
    adapter_strength: float | Sequence[float] = option(
        1.0,
        "strength of all adapters, or a list with one strength per adapter; 0 = no effect",
    )

    def adapters(self) -> dict[str, Any]:
        """Returns the keyword arguments for `flame_mdm.load` that specify the adapters."""
        return {"adapter": self.adapter or (), "strength": self.adapter_strength}


@dataclass(frozen=True, kw_only=True)
class FileSettings:
    """Keys that describe a motion file."""

    fps: float | None = option(
        None, "frames per second, which overrides the value in the file; required for .npy and .amc"
    )
    unit: float | None = option(
        None, "meters per unit of length in the file; default: 0.01 for most .bvh files, 1 for .npy"
    )
    up: str | None = option(
        None,
        "axis that points up in the file: y, z or -y; default: the axis in skeleton.yaml, or y",
    )
    animation: str | None = option(
        None, "name or number of an animation in an .fbx or .glb file; default: the first"
    )


def read_motions(
    source: str, settings: FileSettings, failures: list[str]
) -> tuple[str, int, Iterator[Motion]]:
    """Returns the name of a file or folder, the number of motions in it, and the motions.

    If a file in the folder cannot be read, its error is added to `failures`.
    """
    from flame_mdm.formats.readers import read

    path = Path(source)
    keys = (settings.fps, settings.unit, settings.up)
    if not path.is_dir():
        return (
            path.resolve().stem,
            1,
            iter([read(path, *keys, animation=settings.animation)]),
        )
    files = motion_files(path)

    def motions() -> Iterator[Motion]:
        for file in files:
            try:
                motion = read(file, *keys, animation=settings.animation)
            except (UserError, OSError) as error:
                failures.append(first_line(error))
                continue
            yield replace(motion, id=file.relative_to(path).with_suffix("").as_posix())

    return path.resolve().stem, len(files), motions()


@dataclass(frozen=True, kw_only=True)
class BodySettings:
    """Key that selects the body to show in pictures, pages and files."""

    body: str = option(
        "mannequin",
        'body to draw: mannequin, a file, or Anny with a shape, such as "anny gender=1 age=0.9"; see docs/formats.md',
        body_name,
    )

    def read_body(self) -> Mesh | None:
        """Returns the mesh of `body`, or None for the mannequin (the default)."""
        if self.body == "mannequin":
            return None
        from flame_mdm.formats.people import load_body

        return load_body(self.body)


@dataclass(frozen=True, kw_only=True)
class WritingSettings:
    """Keys that control how motion files are written."""

    rig: str | None = option(
        None, "skeleton of OUT: mixamo, unreal, unity, rigify, lafan1, soma, cmu or 100style"
    )
    root_motion: bool = option(
        False, "for rig=unreal or rig=soma: true = the root bone follows the hips on the floor"
    )
    resample: float | None = option(
        None, "frames per second of OUT; default: the frame rate of the motion"
    )
    character: str | None = option(
        None,
        "your own character to animate: a .glb with a skin, or a .bvh; see docs/characters.md",
        existing,
    )

    def read_character(self) -> Character | BvhCharacter | None:
        """Reads `character`.

        If the names of some joints are unknown, prints a draft file for the user to complete.
        """
        from flame_mdm.formats import characters

        try:
            return None if self.character is None else characters.read(self.character)
        except characters.UnknownJoints as error:
            say(*error.template)
            raise

    def at_rate(self, motion: Motion) -> Motion:
        """Resamples a motion to the frame rate `resample`, if set."""
        from flame_mdm.formats.resampling import frame_rate

        return (
            motion
            if self.resample is None
            else motion.resampled(frame_rate(self.resample, "resample"))
        )


@dataclass(frozen=True)
class LoadedModel:
    """A model to sample from, and the body to draw (None for the mannequin)."""

    model: MotionGenerator
    body: Mesh | None


@dataclass(frozen=True, kw_only=True)
class OutputSettings(BodySettings, SamplerOptions, AdaptedSettings):
    """Keys that `sample` and `edit` share."""

    text: str | None = same_option(SamplingRequest, "texts")
    action: str | None = same_option(SamplingRequest, "actions")
    unconditioned: bool = option(False, "true = generate motions without a text or an action")
    seed: int = same_option(SamplingRequest, "seed")
    cleanup: bool = same_option(SamplingRequest, "cleanup")
    targets: str | None = same_option(SamplingRequest, "targets", existing)
    trajectory: bool = option(
        False,
        "also draw the first motion's clean estimates during sampling, as trajectory.png",
    )
    mp4: bool = option(
        False, 'also write motions.mp4, which requires pip install "flame-mdm[video]"', video
    )
    device: str | None = option(None, "cpu or cuda; default: cuda if available", device_name)

    def conditions(self) -> list[str]:
        """Returns which of the keys `text`, `action` and `unconditioned` are set."""
        names = [name for name in ("text", "action") if getattr(self, name) is not None]
        return names + (["unconditioned"] if self.unconditioned else [])

    def request(self, **values: Any) -> SamplingRequest:
        """Returns the sampling request that the keys describe; `values` override the keys.

        Raises `UserError` if several conditions are requested or a value is invalid.
        """
        if len(conditions := self.conditions()) > 1:
            raise UserError(f"{' and '.join(conditions)} cannot be combined. Use only one of them")
        keywords: dict[str, Any] = {
            **self._fields(SamplingRequest),
            "texts": self.text,
            "actions": self.action,
            **values,
        }
        return SamplingRequest(
            **keywords,
            options=SamplerOptions(**self.chosen()),
            editing=EditRequest(**self._fields(EditRequest))
            if isinstance(self, EditRequest)
            else None,
        )

    def _fields(self, kind: type[Any]) -> dict[str, Any]:
        """Returns the values of the keys that are also fields of the dataclass `kind`."""
        return {
            entry.name: getattr(self, entry.name)
            for entry in fields(kind)
            if hasattr(self, entry.name)
        }

    def load(self) -> LoadedModel:
        """Loads the model and the body.

        If no condition is requested, raises a `UserError` that lists examples.
        """
        file = find(self.ckpt, self.which)  # reports a missing file before PyTorch is imported
        import torch

        from flame_mdm.checkpoints.loading import load
        from flame_mdm.sampling.output import refuse_no_condition

        adapters = self.adapters()
        device = self.device or ("cuda" if torch.cuda.is_available() else "cpu")
        model = load(file, device, **adapters)
        if not self.conditions():
            refuse_no_condition(model)
        return LoadedModel(model, self.read_body())


@dataclass(frozen=True, kw_only=True)
class DataSettings:
    """Keys for commands that open a data set."""

    data: str | None = option(
        None, "name of a data set in experiments/data; data.KEY=... overrides its keys"
    )
    representation: str | None = option(
        None,
        "name of a motion representation in experiments/representation; default: the "
        "representation of the data set",
    )
    data_root: str = option(
        usual_data_root, "folder of the prepared data sets; default: FLAME_MDM_DATA, or data"
    )
    composed: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.data is not None:
            _ = self.nodes  # reports errors before any work is done
        elif self.composed:
            raise UserError(
                f"{self.composed[0]} is an option of a data set, but no data set was specified. "
                "Add data=NAME"
            )

    @cached_property
    def nodes(self) -> Config:
        """The composed nodes `data` and `representation`, which configure the data set."""
        if self.data is None:
            names = ", ".join(sorted(path.stem for path in (EXPERIMENTS / "data").glob("*.yaml")))
            raise UserError(
                f"no data set was specified. Add data=NAME, where NAME is one of: {names}. "
                "For your own motions, use data=folder"
            )
        chosen = [f"representation={self.representation}"] if self.representation else []
        return compose_data(
            self.data, [*chosen, *self.composed], data_root=self.data_root or "data"
        )

    def data_node(self, source: str | None = None) -> Config:
        """Returns the data set's configuration; `source`, if given, replaces its source path."""
        node = self.nodes["data"]
        if source is not None:
            if "path" not in node["source"]:
                raise UserError(
                    f"source={source}: {node['name']} is generated and has no source. Remove source="
                )
            node["source"]["path"] = source
        return node
