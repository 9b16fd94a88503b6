"""Records of evaluations and audits: the schemas of their files, which evaluators write and reporting reads."""

from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from flame_mdm.schemas import ClosedSchema, Int, Number, Plain, Schema, read_json


class Value(Schema):
    """A metric over replications: mean, half-width of its 95 % interval, number of motions; None if not computable."""

    mean: Number | None
    ci: Number | None
    replications: Int | None
    n: Int | None
    per_replication: list[Number | None] = Field([])


class ProtocolVersion(Schema):
    """The protocol of an evaluation or audit, and the hash of its content."""

    name: str
    version: Int
    sha256: str = ""


class Data(Schema):
    """The data set of an evaluation or audit; `frames` are the limits of its clips, `excluded` counts by reason."""

    dataset: str
    fingerprint: str
    frames: Annotated[list[Int], Field(min_length=2, max_length=2)] | None = None
    excluded: dict[str, Int] = Field({})
    representation: str = ""


class ExtractorRecord(Schema):
    """A feature extractor, and the fingerprint of the data it was trained on, if known."""

    sha256: str
    path: str = ""
    data: str | None = None


class Checkpoint(Schema):
    """The checkpoint that generated the motions, its training, and the sampling options."""

    path: str
    sha256: str
    sampler: str
    num_inference_steps: Int | list[Int]
    eta: Number | None = None
    spacing: str | None = None
    guidance_scale: Number
    edit: dict[str, Plain] = Field({})
    experiment: str | None = None
    config_sha256: str = ""
    selected_by: str = ""
    averaged_weights: bool | None = None
    parameters: Int | None = None
    prediction: str | None = None
    training_steps: Int | None = None
    training_hours: Number | None = None
    training_device: str | None = None
    training_speed: str | None = None
    training_precision: str | None = None
    training_memory_gib: Number | None = None


class UsedSkeleton(Schema):
    """The bones of joints computed from SMPL's rotations: those of SMPL's model file, or of a stand-in."""

    stand_in: bool
    smpl_sha256: str | None = None


class Cost(Schema):
    """Cost per motion; None if no model was used."""

    nfe: Number | None = None
    seconds_per_sample: Number | None = None
    batch_size: Number | None = None


class Measured(Schema):
    """What an evaluation measures: `values` and, of real motions, `ground_truth`, by metric; None = not measured."""

    ground_truth: dict[str, Value | None] | None
    values: dict[str, Value | None] | None
    not_computed: dict[str, str]  # reasons by metric
    invalid_because: list[str]  # [] if the values are valid
    forced: bool = False  # whether motions were generated although real motions do not have the expected values
    warnings: list[str] = Field([])
    cost: Cost | None = None
    seeds: list[Int] = Field([])  # of metrics, by replication


class Result(Measured):
    """A result of `flame-mdm evaluate`: what was evaluated, how and where, and the values."""

    quick: bool  # not for publication
    protocol: ProtocolVersion
    changed: dict[str, Plain] = Field({})  # options that differ from the protocol
    split: str
    published_split: bool = False  # whether it tests on clips seen in training, or has no validation clips
    data: Data
    seed: Int
    extractor: ExtractorRecord | None
    checkpoint: Checkpoint | None
    samples_sha256: str | None = None  # of motion files from another system
    baseline: str | None = None
    audit: str | None = None  # path of the audit card of the extractor; None = not audited
    skeleton: UsedSkeleton | None = None  # None if the data has joint positions
    device: str
    precision: str = ""
    environment: dict[str, Any] = Field({})

    @property
    def stand_in_skeleton(self) -> bool:
        return self.skeleton is not None and self.skeleton.stand_in


class AuditedGrade(ClosedSchema):
    """One grade of a perturbation; by metric: value, half width of its 95 % interval, difference from real motions,
    and half width of the interval of that difference; None if not computable.
    """

    grade: Number
    values: dict[str, Annotated[list[Number | None], Field(min_length=4, max_length=4)]]


class AuditedPerturbation(ClosedSchema):
    """A perturbation of real motions, and its grades from weak to strong."""

    name: str
    group: str
    about: str
    unit: str
    grades: Annotated[list[AuditedGrade], Field(min_length=1)]


class AuditedExtractor(Schema):
    """The extractor of an audit, by its recipe or file."""

    sha256: str
    name: str


class AuditCard(ClosedSchema):
    """An evaluator audit, as `flame-mdm audit` writes it."""

    format: Int
    extractor: AuditedExtractor | None
    protocol: ProtocolVersion
    data: Data
    split: str
    motions: Int
    seed: Int
    resamples: Int
    packages: dict[str, str]
    metrics: dict[str, bool | None]  # whether higher values are better; None = values near those of real motions
    real: dict[str, Annotated[list[Number | None], Field(min_length=2, max_length=2)]]  # and half widths of intervals
    perturbations: Annotated[list[AuditedPerturbation], Field(min_length=1)]
    not_computed: dict[str, str]
    truth: dict[str, dict[str, Number | None]]  # agreement with exact attributes: `auc` and `correlation`, by metric


def read_result(path: Path) -> Result:
    return read_json(path, Result, "delete it, then run `flame-mdm evaluate` or `flame-mdm tables` again")
