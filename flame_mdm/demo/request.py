"""Requests of the demo: the link of a motion, and the command lines and the Python program that make the same one.

They are a `SamplingRequest`, which checks the values, and its edits, within the limits of a public page.
"""

import json
import shlex
from collections.abc import Iterable
from typing import Annotated, Any, Literal
from urllib.parse import urlencode

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, PlainSerializer, StringConstraints, ValidationError
from pydantic_core import PydanticCustomError

from flame_mdm.errors import UserError, did_you_mean, one_line, shortened
from flame_mdm.sampling.request import path_targets, read_parts

MAX_TEXT, MAX_SECONDS, MAX_SAMPLES, MAX_STEPS, MAX_EDITS = 300, 30, 4, 1000, 8
"""Limits of a request: characters, seconds, motions, sampling steps, edits."""
MAX_SEED = 2**31 - 1
ALL = -1  # as the number of a motion: all motions so far
PLUS = " + "  # between the names of a model and of its adapter
MAX_WAY_POINTS, FAR = 16, 20.0  # a path: way points, and meters along x and z

PLAIN = r"^[^\x00-\x1f\x7f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069]*$"
"""Text without control characters, those of writing direction included."""

Text = Annotated[str, StringConstraints(strip_whitespace=True, max_length=MAX_TEXT, pattern=PLAIN)]
Samples = Annotated[int, Field(ge=1, le=MAX_SAMPLES)]
Seed = Annotated[int, Field(ge=0, le=MAX_SEED)]
Part = Literal["left_arm", "right_arm", "left_leg", "right_leg", "arms", "legs", "upper_body", "lower_body"]
Coordinate = Annotated[float, Field(ge=-FAR, le=FAR)]
RULES = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


def _way_points(value: Any) -> Any:
    if isinstance(value, str):
        value = [point.split(",") for point in value.split()]
        if any(len(point) != 2 for point in value):
            raise PydanticCustomError("path", "give way points as x,z in meters, such as 0,1 0.5,2")
    return value


Path = Annotated[
    tuple[tuple[Coordinate, Coordinate], ...],
    Field(max_length=MAX_WAY_POINTS),
    BeforeValidator(_way_points),
    PlainSerializer(lambda path: " ".join(f"{x},{z}" for x, z in path)),
]
"""Way points; in a link and on the page "x,z x,z ..."."""


class DemoEdit(BaseModel):
    """An edit of one of the motions so far: `joints` in `region_seconds` are resampled, the rest is kept.

    Attributes:
        motion: number of the edited motion, from 0.
        text: what the person does in the new part; "" = unconditioned.
        region_seconds: begin and end of the new part; None = all of the motion.
        joints: body parts to resample; none = all.
        strength: None = from noise; otherwise a variation, as in `flame_mdm.sampling.editing.edit`. One of the entire
            motion keeps text, parts and path of the request, and repeats the edits since.
    """

    model_config = RULES
    motion: Annotated[int, Field(ge=0, lt=MAX_SAMPLES)] = 0
    text: Text = ""
    region_seconds: tuple[float, float] | None = None
    joints: tuple[Part, ...] = ()
    strength: float | None = None
    samples: Samples = 1
    seed: Seed = 0


class DemoRequest(BaseModel):
    """Everything that determines the motions that the demo shows; keys are those of `flame-mdm sample`.

    Attributes:
        path: way points of the root over the floor, x and z in meters; see `flame_mdm.sampling.request.path_targets`.
    """

    model_config = RULES
    model: str = "quickstart"
    text: Text = ""
    seconds: Annotated[float, Field(gt=0, le=MAX_SECONDS)] = 3.0
    samples: Samples = 1
    seed: Seed = 0
    guidance_scale: float | None = None
    num_inference_steps: Annotated[int, Field(ge=1, le=MAX_STEPS)] | None = None
    sampler: Annotated[str, StringConstraints(max_length=40, pattern=PLAIN)] | None = None
    cleanup: bool = True
    split: bool = True
    path: Path = ()
    edits: Annotated[tuple[DemoEdit, ...], Field(max_length=MAX_EDITS)] = ()

    def query(self) -> str:
        """Returns the query string of a link to this request; `parse_query` reads it."""
        values = self.model_dump(exclude={"edits"}, mode="json")
        values |= {name: str(values[name]).lower() for name in ("cleanup", "split")}
        pairs = {key: value for key, value in values.items() if value not in (None, "")}
        edits = [change.model_dump_json(exclude_defaults=True) for change in self.edits]
        return urlencode([*pairs.items(), *(("edit", text) for text in edits)])

    def targets(self, kind: str) -> dict[str, Any]:
        """Returns the targets of `flame_mdm.generate` that lead along the path; `kind` as for `steps`."""
        parts = read_parts(self.text) if self.text and kind != "none" else [("", None)]
        return path_targets(self.path, sum(seconds or self.seconds for _, seconds in parts))

    def steps(self, kind: str) -> list[tuple[int | None, dict[str, Any]]]:
        """Returns the number of the motion to edit, None at first, and keywords of `generate` or `edit`, for each step.

        Motions are edited as the model made them and cleaned up at the end. The model was trained on `kind`: text,
        action, none.
        """
        names = ("guidance_scale", "num_inference_steps", "sampler")
        shared = {name: value for name in names if (value := getattr(self, name)) is not None}
        path = {"targets": self.targets(kind)} if self.path else {}
        split = {} if self.split else {"split": False}

        def keywords(part: DemoRequest | DemoEdit, text: str, **others: Any) -> dict[str, Any]:
            condition = {} if kind == "none" or not text else {f"{kind}s": text}
            return {**condition, **others, "samples": part.samples, "seed": part.seed, **shared}

        first = keywords(self, self.text, seconds=self.seconds, **split, **path)
        steps: list[tuple[int | None, dict[str, Any]]] = [(None, first)]
        whole = 1  # number of steps up to the last one that makes entire motions
        for part in self.edits:
            region = None if part.region_seconds is None else list(part.region_seconds)
            editing = {"region_seconds": region, "joints": list(part.joints) or None, "strength": part.strength}
            editing = {name: value for name, value in editing.items() if value is not None}
            if editing.keys() != {"strength"}:
                steps.append((part.motion, keywords(part, part.text, **editing)))
                continue
            sources = [*(source for source, _ in steps[whole:]), part.motion]
            source = next(source for source in sources if source != ALL)
            again = [(ALL, others | {"samples": 1}) for _, others in steps[whole:]]
            steps[whole:] = [(source, keywords(part, part.text or self.text, **editing, **path)), *again]
            whole += 1
        if self.cleanup and not self.path:  # cleanup moves the root off the way points, by 0.3 m in one example
            steps[-1][1]["cleanup"] = True
        return steps

    def command(self, kind: str, device: str | None) -> str:
        """Returns the command lines that write the same motions; `device` if it is not the default."""
        lines, files, (model, _, adapter) = [], [""], self.model.partition(PLUS)
        for number, (source, keywords) in enumerate(self.steps(kind)):
            keys = {{"texts": "text", "actions": "action"}.get(key, key): value for key, value in keywords.items()}
            keys |= {} if keys.keys() & {"text", "action"} else {"unconditioned": True}
            keys |= {"adapter": adapter} if adapter else {}
            keys |= {"device": device} if device else {}
            if "targets" in keys:
                lines.append(f"echo {shlex.quote(json.dumps(keys['targets']))} > path.json")
                keys["targets"] = "path.json"
            edited = [files[source or 0]] if source != ALL else files
            files = []
            for index, file in enumerate(edited, 1):
                folder = f"edit_{number}" + f"_{index}" * (len(edited) > 1) if number else "motions"
                words = ["edit", model, f"motion={file}"] if number else ["sample", model]
                words += [f"{key}={_word(value)}" for key, value in keys.items()]
                lines.append(shlex.join(["flame-mdm", *words, f"out={folder}"]))
                # the folder of an edit begins with the original
                files += [f"{folder}/motion_{k + (number > 0):03d}.npz" for k in range(keys["samples"])]
        return "\n".join(lines)

    def python(self, kind: str, device: str) -> str:
        model, _, adapter = self.model.partition(PLUS)
        options = f", {device!r}" * (device != "cpu") + f", adapter={adapter!r}" * bool(adapter)
        lines = ["import flame_mdm", "", f"model = flame_mdm.load({model!r}{options})"]
        for source, keywords in self.steps(kind):
            call = {None: "generate(model", ALL: "edit(model, motion"}.get(source, f"edit(model, motions[{source}]")
            call = f"flame_mdm.{call}" + "".join(f", {key}={value!r}" for key, value in keywords.items()) + ")"
            lines.append(f"motions = [{call}[0] for motion in motions]" if source == ALL else f"motions = {call}")
        return "\n".join([*lines, 'motions[0].save("motion.bvh")  # or .glb, .npz, .mp4'])


def _word(value: Any) -> str:
    if isinstance(value, list):
        return f"[{','.join(map(str, value))}]"
    return str(value).lower() if isinstance(value, bool) else str(value)


def parse_query(pairs: Iterable[tuple[str, str]]) -> DemoRequest:
    """Returns the request of a link's query string; raises `UserError`. Keys with "__" belong to the host."""
    values: dict[str, Any] = {}
    edits: list[Any] = []
    for key, value in pairs:
        if key == "edit":
            try:
                edits.append(json.loads(value))
            except (ValueError, RecursionError):
                raise UserError(f"edit={_shown(value)}: not an edit of this page. Copy the whole link") from None
        elif key in values:
            raise UserError(f"{_shown(key)} is given twice. Remove one")
        elif not key.startswith("__"):
            values[key] = value
    return checked(values | ({"edits": edits} if edits else {}))


def checked(values: dict[str, Any]) -> DemoRequest:
    """Returns a request; empty values are left to the defaults. A `UserError` quotes the invalid value."""
    try:
        return DemoRequest(**{key: value for key, value in values.items() if value not in (None, "")})
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(str(part) for part in first["loc"])
        if first["type"] == "extra_forbidden":
            raise UserError(f"unknown option {_shown(name)}.{did_you_mean(name, DemoRequest.model_fields)}") from None
        raise UserError(f"{name}={_shown(first['input'])}: {first['msg'].lower()}") from None


def _shown(value: Any) -> str:
    return shortened(one_line(str(value)[:500]), 60)
