"""Requests to the demo: limits, links, and equivalent Python programs."""

import json
from collections.abc import Iterable, Sequence
from typing import Annotated, Any, Literal
from urllib.parse import parse_qsl, urlencode

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainSerializer,
    StringConstraints,
    ValidationError,
)

from flame_mdm.errors import UserError, did_you_mean, one_line, shortened
from flame_mdm.sampling.motion_request import (
    USUAL_SECONDS,
    path_targets,
    read_parts,
    read_path,
)

# Limits of a request, which keep a visitor from occupying the machine for minutes
MAX_TEXT = 300
MAX_SECONDS = 30
MAX_SAMPLES = 4
MAX_STEPS = 1000
MAX_EDITS = 8
MAX_SEED = 2**31 - 1
# Maximum number of fields in a query string
MAX_FIELDS = 50
# Limits of a path: number of waypoints, and distance along x and z in meters
MAX_WAYPOINTS, FAR = 16, 20.0
# Separator between the names of a model and its adapter
PLUS = " + "
PLAIN = r"^[^\x00-\x1f\x7f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069]*$"
"""Pattern of text without control characters and characters that change its direction."""

Text = Annotated[str, StringConstraints(strip_whitespace=True, max_length=MAX_TEXT, pattern=PLAIN)]
Samples = Annotated[int, Field(ge=1, le=MAX_SAMPLES)]
Seed = Annotated[int, Field(ge=0, le=MAX_SEED)]
Part = Literal[
    "left_arm", "right_arm", "left_leg", "right_leg", "arms", "legs", "upper_body", "lower_body"
]
Coordinate = Annotated[float, Field(ge=-FAR, le=FAR)]
RULES = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


Path = Annotated[
    tuple[tuple[Coordinate, Coordinate], ...],
    Field(max_length=MAX_WAYPOINTS),
    BeforeValidator(lambda value: read_path(value) if isinstance(value, str) else value),
    PlainSerializer(lambda path: " ".join(f"{x},{z}" for x, z in path)),
]
"""Waypoints, written as "x,z x,z ..." in a link and on the page."""


class DemoEdit(BaseModel):
    """An edit of an earlier motion, whose index is `motion`.

    The fields are explained in `flame_mdm.sampling.motion_request.EditRequest`. `text` describes
    the new part, or is "" if the new part is unconditioned. A variation of the entire motion keeps
    the text, parts and path of the request.
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
    """Everything that determines the motions in the demo, with the same keys as `flame-mdm sample`."""

    model_config = RULES
    model: str = "package"
    text: Text = ""
    seconds: Annotated[float, Field(gt=0, le=MAX_SECONDS)] | None = None
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
        """Returns the path as targets for `flame_mdm.generate`; `kind` is the kind of condition."""
        parts = read_parts(self.text) if self.text and kind != "none" else [("", None)]
        return path_targets(self.path, self.total_seconds(parts))

    def total_seconds(self, parts: Sequence[tuple[str, float | None]]) -> float:
        """Returns the total duration of the parts.

        A part without a duration lasts `seconds` or, if `seconds` is None, `USUAL_SECONDS`.
        """
        return sum(seconds or self.seconds or USUAL_SECONDS for _, seconds in parts)

    def steps(self, kind: str) -> list[tuple[int | None, dict[str, Any]]]:
        """Returns steps as pairs (index of the motion to edit, keywords for `generate` or `edit`).

        In the first step, which generates motions, the index is None.
        """
        shared = self.model_dump(
            include={"guidance_scale", "num_inference_steps", "sampler"}, exclude_none=True
        )
        path = {"targets": self.targets(kind)} if self.path else {}
        # The waypoints of a path are spread over this time.
        seconds = self.seconds or (USUAL_SECONDS if self.path else None)
        duration = {} if seconds is None else {"seconds": seconds}
        split = {} if self.split else {"split": False}

        def keywords(part: DemoRequest | DemoEdit, text: str, **others: Any) -> dict[str, Any]:
            condition = {} if kind == "none" or not text else {f"{kind}s": text}
            return {**condition, **others, "samples": part.samples, "seed": part.seed, **shared}

        first = keywords(self, self.text, **duration, **split, **path)
        steps: list[tuple[int | None, dict[str, Any]]] = [(None, first)]
        for part in self.edits:
            options = {"region_seconds", "joints", "strength"}
            editing = part.model_dump(mode="json", include=options, exclude_defaults=True)
            if editing.keys() == {"strength"}:
                steps.append(
                    (part.motion, keywords(part, part.text or self.text, **editing, **path))
                )
            else:
                steps.append((part.motion, keywords(part, part.text, **editing)))
        # Motions along a path are not cleaned up, because cleanup moves the root away from the
        # waypoints (by 0.3 m in one example).
        if self.cleanup and not self.path:
            steps[-1][1]["cleanup"] = True
        return steps

    def python(self, kind: str, device: str) -> str:
        """Returns Python code that generates the same motions; `kind` is the kind of condition."""
        model, _, adapter = self.model.partition(PLUS)
        options = ("" if device == "cpu" else f", {device!r}") + (
            f", adapter={adapter!r}" if adapter else ""
        )
        lines = ["import flame_mdm", "", f"model = flame_mdm.load({model!r}{options})"]
        for source, keywords in self.steps(kind):
            call = "generate(model" if source is None else f"edit(model, motions[{source}]"
            lines.append(
                f"motions = flame_mdm.{call}, {', '.join(f'{k}={v!r}' for k, v in keywords.items())})"
            )
        return "\n".join([*lines, 'motions[0].save("motion.bvh")  # or .glb, .npz, .mp4'])


def query_pairs(query: str) -> list[tuple[str, str]]:
    """Returns the keys and values of a query string.

    Raises `UserError` if there are more than `MAX_FIELDS`.
    """
    try:
        return parse_qsl(query, keep_blank_values=True, max_num_fields=MAX_FIELDS)
    except ValueError:
        fields = query.count("&") + 1
        raise UserError(f"the link has {fields} options. Use at most {MAX_FIELDS}") from None


def parse_query(pairs: Iterable[tuple[str, str]]) -> DemoRequest:
    """Returns the request in the query string of a link. Raises `UserError` for invalid requests.

    Keys that begin with "__" belong to the host and are ignored.
    """
    values: dict[str, Any] = {}
    edits: list[Any] = []
    for key, value in pairs:
        if key == "edit":
            try:
                edits.append(json.loads(value))
            except (ValueError, RecursionError):
                raise UserError(
                    f"edit={_shown(value)}: not a valid edit. Copy the whole link"
                ) from None
        elif key in values:
            raise UserError(f"{_shown(key)} is given twice. Remove one of them")
        elif not key.startswith("__"):
            values[key] = value
    return checked(values | ({"edits": edits} if edits else {}))


def checked(values: dict[str, Any]) -> DemoRequest:
    """Builds a request, replacing empty values with the defaults.

    If a value is invalid, raises a `UserError` that quotes the value.
    """
    try:
        return DemoRequest(
            **{key: value for key, value in values.items() if value not in (None, "")}
        )
    except ValidationError as error:
        first: Any = error.errors()[0]
        if first["type"] == "value_error":  # the error comes from `read_path`
            raise first["ctx"]["error"] from None
        name = ".".join(str(part) for part in first["loc"])
        if first["type"] == "extra_forbidden":
            raise UserError(
                f"unknown option {_shown(name)}.{did_you_mean(name, DemoRequest.model_fields)}"
            ) from None
        raise UserError(f"{name}={_shown(first['input'])}: {first['msg'].lower()}") from None


def _shown(value: Any) -> str:
    return shortened(one_line(str(value)[:500]), 60)
