# pyright: standard
"""Results of evaluations: averages over replications, provenance, and printed output."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from evaluators.evaluation_request import EvaluationRequest
from evaluators.plan import Plan
from evaluators.protocol import digest
from evaluators.sources import SampleFolder
from flame_mdm.errors import say
from flame_mdm.records import (
    Checkpoint,
    Cost,
    Data,
    ExtractorRecord,
    ProtocolVersion,
    Result,
    Value,
)
from flame_mdm.reporting.audit_cards import card_of
from flame_mdm.safe_io import sha256
from flame_mdm.training.provenance import environment
from flame_mdm.training.start import recipe_changes


@dataclass(frozen=True)
class Scores:
    """Values of all metrics in one replication."""

    # Values by name (`metric` or `metric/part`), or None if the value cannot be computed
    values: Mapping[str, float | None]
    # Reasons for missing values, by metric
    reasons: Mapping[str, str]
    # Number of motions
    count: int
    # Numbers of real motions in set comparisons, by the names of the values
    real_counts: Mapping[str, int]
    units: Mapping[str, str]  # units of the values by name


@dataclass(frozen=True)
class Outcome:
    """Scores of one part of an evaluation.

    The parts evaluate real motions, generated motions, and several generated motions per prompt.
    """

    # Scores by replication
    scores: Sequence[Scores] = ()
    # Bootstrap values for intervals over motions, by name; see `Value`
    resampled: Mapping[str, list[float | None]] = field(default_factory=dict)
    warnings: Sequence[str] = ()
    costs: Sequence[Cost] = ()
    not_computed: Mapping[str, str] = field(default_factory=dict)

    @property
    def values(self) -> dict[str, Value | None]:
        """Means over replications. A value that is missing in a replication is None."""
        table: dict[str, Value | None] = {}
        counts = [scores.count for scores in self.scores]
        for name in self.scores[0].values if self.scores else ():
            values = [scores.values[name] for scores in self.scores]
            numbers = [value for value in values if value is not None]
            mean, ci = mean_ci(numbers) if len(numbers) == len(values) else (None, None)
            table[name] = Value(
                mean=mean,
                ci=ci,
                replications=len(values),
                n=counts[0] if len(set(counts)) == 1 else None,
                per_replication=values,
                n_per_replication=counts,
                n_real=self.scores[0].real_counts.get(name),
                unit=self.scores[0].units.get(name, ""),
                resampled=self.resampled.get(name, []),
            )
        return table

    @property
    def reasons(self) -> dict[str, str]:
        """Reasons for missing values, keyed by metric."""
        reasons: dict[str, str] = {}
        for scores in self.scores:
            reasons |= scores.reasons
        return reasons | dict(self.not_computed)


def mean_ci(values: Sequence[float]) -> tuple[float, float | None]:
    """Returns the mean over R >= 1 replications and the half width of its 95 % confidence interval.

    The half width is 1.96 std / sqrt(R), with R in the denominator of the variance, as in the code
    of Guo et al. 2022, MDM and MFM. ACTOR's tables show 1.96 times the variance instead. For a
    single replication, the half width is None.
    """
    half = float(1.96 * np.std(values) / len(values) ** 0.5) if len(values) > 1 else None
    return float(np.mean(values)), half


def mean_cost(costs: Sequence[Cost]) -> Cost:
    """Returns the mean cost over replications. Values are None if a replication used no model."""
    values = {name: [getattr(cost, name) for cost in costs] for name in Cost.model_fields}
    return Cost(
        **{
            name: None if None in numbers else float(np.mean(numbers))
            for name, numbers in values.items()
        }
    )


def make_result(request: EvaluationRequest, plan: Plan) -> Result:
    """Returns a result that contains its provenance, but no values yet."""
    info, extractor, protocol = plan.data.store.info, plan.extractor, plan.protocol
    device, crop, short = plan.representation.mean.device, plan.data.crop, plan.clips.too_short
    reason = f"{request.split} clips shorter than {crop.min_frames} frames"
    excluded = info["excluded"] | ({reason: short} if short else {})
    data = Data(
        dataset=info["dataset"],
        representation=info["representation"],
        fingerprint=info["fingerprint"],
        frames=[crop.min_frames, crop.longest()],
        excluded=excluded,
    )
    card = card_of(data, extractor.sha256 if extractor else None)
    return Result(
        quick=request.quick,
        protocol=ProtocolVersion(
            name=protocol.name, version=protocol.version, sha256=protocol.sha256
        ),
        changed=plan.changed,
        split=request.split,
        published_split=info["published_split"],
        data=data,
        seed=request.seed,
        extractor=extractor
        and ExtractorRecord(
            sha256=extractor.sha256, path=_extractor_path(request, plan), data=extractor.fingerprint
        ),
        checkpoint=_checkpoint(plan),
        samples_sha256=plan.source.sha256 if isinstance(plan.source, SampleFolder) else None,
        baseline=request.baseline,
        audit=card.path.as_posix() if card else None,
        audit_motions=card.motions if card else None,
        skeleton=plan.skeleton,
        device=torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu",
        precision=f"float32, matmul {torch.get_float32_matmul_precision()}",
        environment=environment(),
        ground_truth=None,
        values=None,
        not_computed={},
        invalid_because=_overlaps(request, plan),
    )


def _extractor_path(request: EvaluationRequest, plan: Plan) -> str:
    """Returns the extractor's path from the request or, if none is set there, from the protocol."""
    return request.extractor or str((plan.protocol.extractor or {}).get("path", ""))


def _checkpoint(plan: Plan) -> Checkpoint | None:
    """Describes the checkpoint, including how it was selected from its run.

    The selection is inferred from the file name.
    """
    model, file = plan.model, plan.file
    if model is None or file is None:
        return None
    best = (model.config.get("callbacks") or {}).get("best") or {}
    return Checkpoint(
        path=str(file),
        sha256=sha256(file),
        experiment=model.config.get("experiment"),
        config_sha256=digest(model.config),
        recipe_changes=recipe_changes(model.config),
        selected_by=f"best {best['monitor']}"
        if file.stem == "best" and "monitor" in best
        else f"none: {file.stem}",
        averaged_weights=bool(model.config.get("ema")),
        parameters=sum(p.numel() for p in model.parameters() if p.requires_grad),
        prediction={"epsilon": "noise"}.get(model.process.prediction, model.process.prediction),
        training_steps=model.steps,
        **{f"training_{name}": value for name, value in model.facts.get("training", {}).items()},
        **plan.sampling,
    )


def _overlaps(request: EvaluationRequest, plan: Plan) -> list[str]:
    """Returns the reasons why the values are invalid.

    Values are invalid if evaluated clips may be in the training data of the model or of the
    extractor.
    """
    evaluated, extractor, reasons = plan.data.store.fingerprint, plan.extractor, []
    trained = {"training data": plan.model.facts.get("fingerprint") if plan.model else None}
    trained["training data of the extractor"] = extractor.fingerprint if extractor else None
    for origin, fingerprint in trained.items():
        if fingerprint and fingerprint != evaluated:
            reasons.append(
                f"{origin} {fingerprint} and evaluated data {evaluated} differ: splits may overlap"
            )
    if extractor is not None and extractor.fingerprint == evaluated and request.split == "train":
        reasons.append("the extractor was trained on the evaluated split, train")
    return reasons


def show(result: Result, path: Path) -> None:
    """Prints a result's values, intervals and warnings, and the path of its file."""
    protocol, data, values = result.protocol, result.data, result.values or {}
    mark = " QUICK RUN, NOT FOR PUBLICATION" if result.quick else ""
    say(f"{protocol.name} version {protocol.version}, {data.dataset} {result.split}{mark}")
    usual = result.counts
    if usual:
        say(f"replications x motions: {usual}" + _intervals(values))
    if result.changed:
        say(
            "differs from the protocol: "
            + ", ".join(f"{name}={value}" for name, value in result.changed.items())
        )
    if result.checkpoint and result.checkpoint.recipe_changes:
        changes = ", ".join(result.checkpoint.recipe_changes)
        say(f"the model differs from the recipe {result.checkpoint.experiment}: {changes}")
    say(f"{'':40}{'real motions':>24}{result.baseline or 'generated':>24}")
    for name, value in values.items():
        real = (result.ground_truth or {}).get(name)
        if any(shown is not None and shown.mean is not None for shown in (real, value)):
            unit = next((f" ({shown.unit})" for shown in (value, real) if shown and shown.unit), "")
            say(f"{name + unit:40}{_cell(real, usual):>24}{_cell(value, usual):>24}")
    for reason, count in data.excluded.items():
        say(f"excluded from the data set: {count} {reason}")
    for name, reason in result.not_computed.items():
        say(f"not computed: {name}: {reason}")
    if result.stand_in_skeleton:
        say(
            "warning: joints were computed with a stand-in skeleton. To use "
            "SMPL's skeleton, pass SMPL's model file with smpl=FILE"
        )
    for reason in result.warnings:
        say(f"warning: {reason}")
    for reason in result.invalid_because:
        say(f"NOT VALID: {reason}")
    if result.audit is not None:
        say(f"audit of this evaluator, on {result.audit_motions} motions: {result.audit}")
    else:
        say(
            f"not audited: it is unknown which faults this evaluator detects. To audit it, run "
            f"make audit DATA={data.dataset}"
        )
    say(f"written: {path}")


def _intervals(values: Mapping[str, Value | None]) -> str:
    """Returns an explanation of the intervals to append to a line, or "" without intervals."""
    shown = [value for value in values.values() if value and value.half is not None]
    if not shown:
        return ""
    return "; +-: 95 % interval over " + (
        "motions" if shown[0].resampled and shown[0].ci is None else "replications"
    )


def _cell(value: Value | None, usual: str) -> str:
    """Formats a value, followed by its interval if it has one.

    The numbers of motions are appended if they differ from `usual`, the numbers for most values.
    """
    if value is None or value.mean is None:
        return "-"
    half = f" +- {value.half:.2g}" if value.half is not None else ""
    counts = f" ({value.counts})" if value.n is not None and value.counts != usual else ""
    return f"{value.mean:.4g}{half}{counts}"
