"""Records of evaluations and audits: schemas of the files that evaluators write."""

import hashlib
import json
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from flame_mdm.schemas import ClosedSchema, Int, Number, Plain, Schema, read_json


class Value(Schema):
    """A metric's mean over replications, and the number of motions from which it was computed."""

    # None if the metric cannot be computed
    mean: Number | None
    # Half width of the 95 % interval over replications, or None for a single replication
    ci: Number | None
    replications: Int | None
    n: Int | None  # motions per replication, or None if replications differ
    per_replication: list[Number | None] = Field(default_factory=list)
    n_per_replication: list[Int] = Field(default_factory=list)
    # Number of real motions if the metric compares two sets, or None otherwise
    n_real: Int | None = None
    unit: str = ""
    # Bootstrap values: the metric, computed on motions that are drawn with replacement from the
    # first replication
    resampled: list[Number | None] = Field(default_factory=list)

    @property
    def half(self) -> float | None:
        """Half width of the 95 % interval over replications, or None if it is unknown.

        For a single replication, this is the half width of the bootstrap interval over motions.
        """
        if (self.replications or 0) > 1:
            return self.ci
        drawn = [value for value in self.resampled if value is not None]
        if self.mean is None or not drawn or len(drawn) < len(self.resampled):
            return None
        low, high = percentiles(drawn, self.mean)
        return (high - low) / 2

    @property
    def counts(self) -> str:
        """Numbers of motions as text: "3 x 64", or "64 + 5" if the replications differ."""
        if len(set(self.n_per_replication)) > 1:
            return " + ".join(map(str, self.n_per_replication))
        return f"{self.replications} x {self.n}"


def percentiles(drawn: Sequence[float], value: float) -> tuple[float, float]:
    """Returns the 95 % interval of a value, estimated from bootstrap values.

    Source: Efron and Tibshirani 1993, section 13.3. Some metrics, such as Fréchet distances, are
    larger for sets with repeated motions (section 10.6). The bootstrap values are therefore shifted
    so that their mean equals the value. The interval is valid only for sets of the same size.

    Example:
        >>> percentiles([1.0, 2.0, 3.0], 5.0)
        (4.05, 5.95)
    """
    import numpy as np

    low, high = np.percentile(drawn, (2.5, 97.5)) - np.mean(drawn) + value
    return float(low), float(high)


class ProtocolVersion(Schema):
    """The protocol of an evaluation or audit, with the hash of its content."""

    name: str
    version: Int
    sha256: str = ""


class Data(Schema):
    """The data set of an evaluation or audit.

    `frames` contains the minimum and maximum clip length. `excluded` contains the number of
    excluded clips per reason.
    """

    dataset: str
    fingerprint: str
    frames: Annotated[list[Int], Field(min_length=2, max_length=2)] | None = None
    excluded: dict[str, Int] = Field({})
    representation: str = ""


class ExtractorRecord(Schema):
    """A feature extractor and, if known, the fingerprint of its training data."""

    sha256: str
    path: str = ""
    data: str | None = None


class Checkpoint(Schema):
    """The checkpoint that generated the motions, with facts about its training and sampling."""

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
    # Changes to the recipe, in the form "key=value"
    recipe_changes: list[str] = Field(default_factory=list)
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
    """Source of the bone lengths with which joint positions are computed from SMPL rotations.

    The source is SMPL's model file or a stand-in for it.
    """

    stand_in: bool
    smpl_sha256: str | None = None


class Cost(Schema):
    """Cost per generated motion. The values are None if no model was used."""

    nfe: Number | None = None
    seconds_per_sample: Number | None = None
    batch_size: Number | None = None


class Measured(Schema):
    """Values that an evaluation measured, keyed by metric.

    `values` describes the evaluated motions, and `ground_truth` describes real motions. None means
    that a value was not measured.
    """

    ground_truth: dict[str, Value | None] | None
    values: dict[str, Value | None] | None
    # Reason why a metric was not computed, by metric
    not_computed: dict[str, str]
    # Reasons why the values are not valid; [] if they are valid
    invalid_because: list[str]
    # Whether the evaluation continued although the values of real motions were not as expected
    forced: bool = False
    warnings: list[str] = Field(default_factory=list)
    cost: Cost | None = None
    seeds: list[Int] = Field(default_factory=list)  # seed of the metrics in each replication


class Result(Measured):
    """A result of `flame-mdm evaluate`: values, settings, and the evaluated model or motions."""

    quick: bool  # whether it is a quick run, which is not for publication
    protocol: ProtocolVersion
    changed: dict[str, Plain] = Field({})  # options that differ from the protocol
    split: str
    # Whether the data uses its published splits, in which some test clips are also training clips,
    # or validation clips are missing
    published_split: bool = False
    data: Data
    seed: Int
    extractor: ExtractorRecord | None
    checkpoint: Checkpoint | None
    samples_sha256: str | None = None  # hash of the motion files from another system
    baseline: str | None = None
    # Path of the extractor's audit card, or None if the extractor was not audited
    audit: str | None = None
    # Number of motions that were used for the audit
    audit_motions: Int | None = None
    # None if the data contains joint positions
    skeleton: UsedSkeleton | None = None
    device: str
    precision: str = ""
    environment: dict[str, Any] = Field({})

    @property
    def counts(self) -> str:
        """The most common `Value.counts`, or "" if there are no values."""
        values = [value for value in (self.values or {}).values() if value and value.replications]
        counts = Counter(value.counts for value in values if value.n != 0)
        return counts.most_common(1)[0][0] if counts else ""

    @property
    def origin(self) -> str:
        """Hash of all inputs: motions or checkpoint, extractor, data and protocol."""
        parts = [
            self.checkpoint.sha256 if self.checkpoint else self.samples_sha256 or self.baseline,
            self.extractor.sha256 if self.extractor else None,
            self.data.fingerprint,
            self.protocol.sha256,
            self.split,
            self.seed,
        ]
        return hashlib.sha256(json.dumps(parts).encode()).hexdigest()

    @property
    def stand_in_skeleton(self) -> bool:
        """Whether the bone lengths come from a stand-in for SMPL's model file."""
        return self.skeleton is not None and self.skeleton.stand_in


class AuditedGrade(ClosedSchema):
    """Results for one grade of a perturbation.

    Each metric has four numbers: its value, the half width of the value's 95 % interval, the
    difference from real motions, and the half width of the difference's interval. A number that
    cannot be computed is None.
    """

    grade: Number
    values: dict[str, Annotated[list[Number | None], Field(min_length=4, max_length=4)]]


class AuditedPerturbation(ClosedSchema):
    """A perturbation of real motions, with its grades from weak to strong."""

    name: str
    group: str
    about: str
    unit: str
    grades: Annotated[list[AuditedGrade], Field(min_length=1)]


class AuditedMetric(ClosedSchema):
    """Properties that a metric declares for one of its values."""

    unit: str = ""
    # Whether it can detect that a motion does not show what was requested
    sees_meaning: bool = True
    # Whether the value summarizes the metric's other values
    sums_up: bool = True
    # Whether it reads attributes from the joint positions, without a network
    exact: bool = False
    # Whether its bias depends on the number of motions
    depends_on_count: bool = False


class AuditedExtractor(Schema):
    """The feature extractor of an audit, named by its recipe or file."""

    sha256: str
    name: str


class AuditCard(ClosedSchema):
    """An evaluator audit, as written by `flame-mdm audit`."""

    format: Int
    extractor: AuditedExtractor | None
    protocol: ProtocolVersion
    data: Data
    split: str
    motions: Int
    seed: Int
    resamples: Int
    packages: dict[str, str]
    # Whether higher values are better, by metric, or None if values are better the closer they are
    # to the value of real motions
    metrics: dict[str, bool | None]
    # Properties by metric. Files from earlier versions contain none
    facts: dict[str, AuditedMetric] = Field({})
    # The value of real motions and the half width of its interval, by metric
    real: dict[str, Annotated[list[Number | None], Field(min_length=2, max_length=2)]]
    perturbations: Annotated[list[AuditedPerturbation], Field(min_length=1)]
    not_computed: dict[str, str]
    # Agreement with exact attributes (`auc` and `correlation`), by metric
    truth: dict[str, dict[str, Number | None]]


def read_result(path: Path) -> Result:
    """Reads the result file of an evaluation. Raises `UserError` if it is damaged."""
    return read_json(
        path, Result, "delete it, then run `flame-mdm evaluate` or `flame-mdm tables` again"
    )
