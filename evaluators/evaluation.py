# pyright: standard
"""Runs evaluations: measures real motions, generates and measures motions, and writes results."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.ndimage import gaussian_filter1d
from torch import Tensor

from evaluators.collectives import is_first, processes, shared
from evaluators.evaluation_request import EvaluationRequest
from evaluators.evaluator import Evaluator, Motions, Rows, keys_of
from evaluators.extractors import Extractor
from evaluators.metrics.distribution import FrechetMotionDistance
from evaluators.plan import Plan
from evaluators.protocol import DrawnClip, Protocol
from evaluators.results import Outcome, Scores, make_result, mean_cost, show
from evaluators.sources import Generator, Samples, Source, real_motions
from flame_mdm.data.datamodule import Clips
from flame_mdm.errors import UserError
from flame_mdm.records import Measured, Value
from flame_mdm.representations import Representation
from flame_mdm.safe_io import write_json
from flame_mdm.seeds import key

SKIPPED = {"extractor": "extractor=none: metrics that need features were not computed"}


def evaluate(request: EvaluationRequest) -> None:
    """Evaluates a checkpoint, motion files from another system or a baseline, and writes the result file.

    Real motions are measured first. If their values differ from the expected values in the
    protocol, the data or the extractor is wrong, and nothing is generated. For a guide, see
    `docs/evaluation.md`.

    Args:
        request: the keys of `flame-mdm evaluate`.

    Raises:
        UserError: If the model, data, protocol and extractor do not match, or if real motions do
            not have the expected values.

    Example:
        >>> from evaluators.evaluation_request import EvaluationRequest
        >>> evaluate(EvaluationRequest(ckpt="runs/quickstart/default", quick=True))  # doctest: +SKIP
    """
    if request.out is not None:  # checked before hours of work
        if Path(request.out).is_dir():
            raise UserError(f"out={request.out} is a folder. Set out to the JSON file to write")
        Path(request.out).parent.mkdir(parents=True, exist_ok=True)
    with processes(request.device) as device:
        plan = Plan(request, device)
        result = make_result(request, plan)
        parts = (plan.protocol, plan.clips, plan.extractor, plan.representation)
        evaluation = Evaluation(
            *parts, request.seed, plan.batch_size, training=plan.data.clips("train")
        )
        measured = evaluation.run(plan.source, force=request.force, resamples=request.resamples)
        if is_first():
            reasons = measured.invalid_because + result.invalid_because
            result = result.model_copy(update=dict(measured) | {"invalid_because": reasons})
            write_json(plan.path, result.model_dump())
            show(result, plan.path)


@dataclass(frozen=True)
class Evaluation:
    """Evaluates a split of a data set under a protocol.

    All ranks must create and run the evaluation together.
    """

    # Protocol to follow
    protocol: Protocol
    # Clips of the evaluated split
    clips: Clips
    # The opened extractor, or None, in which case metrics that need features have no value
    extractor: Extractor | None
    # Representation of the motions, on the device that computes the metrics
    representation: Representation
    # Seed of all random draws
    seed: int = 0
    # Batch size of the extractor
    batch_size: int = 64
    # The training split, for metrics that detect copies of its motions
    training: Clips | None = None

    def run(
        self,
        source: Source | None,
        *,
        ground_truth: bool = True,
        force: bool = False,
        resamples: int = 0,
    ) -> Measured:
        """Evaluates the real motions in all replications, and then the motions from the source.

        Each rank generates some of the batches and computes their features. Rank 0 computes the
        metrics, and all ranks return the result. If real motions do not have the expected values,
        raises `UserError` before anything is generated, unless `force` is True.

        Args:
            source: source of the motions. If None, only real motions are measured.
            ground_truth: whether to measure real motions as well.
            force: whether to generate motions even if real motions do not have the expected values.
            resamples: number of bootstrap sets to draw from the motions of the first replication,
                for confidence intervals over motions.
        """
        real_sets, real = self._measure_real(source, ground_truth)
        unexpected = shared(self._unexpected(real.values))
        if unexpected and source is not None and not force:
            _refuse(unexpected)

        generated, several = Outcome(), Outcome()
        if source is not None:
            generated = self._measure(source, real_sets, resamples)
            if self.several:
                several = self._measure_multimodality(source, self.several)
        skipped = SKIPPED if self.evaluator.skip_features else {}
        return shared(
            Measured(
                ground_truth=real.values if ground_truth else None,
                values=None if source is None else generated.values | several.values,
                not_computed=real.reasons | generated.reasons | several.reasons | skipped,
                invalid_because=unexpected,
                forced=bool(unexpected) and source is not None and force,
                warnings=[*self._conditions(), *generated.warnings],
                cost=None if source is None else mean_cost(generated.costs),
                seeds=[
                    key("draws", self.seed, replication)
                    for replication in range(self.protocol.replications)
                ],
            )
        )

    @cached_property
    def evaluator(self) -> Evaluator:
        """The evaluator for the motions of each replication."""
        # `skips` is True for extractor=none.
        skips = self.extractor is None and self.protocol.extractor is not None
        evaluator = Evaluator(
            self.extractor,
            self.protocol.metrics,
            self.representation,
            self.batch_size,
            skip_features=skips,
        )
        if evaluator.reads("nearest") and self.training is not None:
            windows = self.protocol.rows(self.training, self.seed, 0, purpose="training")
            whole = [replace(row, frames=np.arange(row.clip.length)) for row in windows]
            motions = [
                self._motions(rows, real_motions(self.training, rows)) for rows in (whole, windows)
            ]
            evaluator.training = evaluator.training_motions(*motions)
        return evaluator

    @cached_property
    def several(self) -> Evaluator | None:
        """Evaluator for several motions per prompt, or None if multimodality is not measured."""
        several = self.protocol.multimodality
        return several and replace(self.evaluator, metrics=several.metrics)

    def _score(
        self, evaluator: Evaluator, motions: Rows, paired: Rows, real: Rows, replication: int
    ) -> Scores:
        values, reasons = evaluator.score(
            motions, paired, real, key("draws", self.seed, replication)
        )
        real_counts = dict.fromkeys(filter(evaluator.compares_sets, values), len(real["keys"]))
        units = {name: evaluator.unit_of(name) for name in values}
        return Scores(values, reasons, len(motions["keys"]), real_counts, units)

    def _measure_real(
        self, source: Source | None, ground_truth: bool
    ) -> tuple[list[tuple[Rows, Rows]], Outcome]:
        """Measures real motions and returns them for comparisons with the source's motions.

        Each replication has two references: the real motions of the evaluated clips, and a set of
        real motions for metrics that compare sets.
        """
        scores = []
        real_sets = []
        for replication in range(self.protocol.replications):
            again = self.protocol.rows(self.clips, self.seed, replication, purpose="real")
            real = self.evaluator.reference()
            if real is None:
                features = real_motions(self.clips, again)
                real = replace(self.evaluator, training=None).extract(
                    self._motions(again, features)
                )
            real = _without_joints(real)
            paired = self._paired(self.protocol.rows(self.clips, self.seed, replication))
            if ground_truth:
                scores.append(self._score(self.evaluator, paired, paired, real, replication))
            if source is not None:
                # The inputs are checked before any motion is generated.
                for checked in filter(None, (self.evaluator, self.several)):
                    checked.check(paired)
                # All replications are kept in memory. Joints take the most memory, so they are kept
                # only if metrics compare them.
                real_sets.append(
                    (
                        paired if self.evaluator.reads("real_joints") else _without_joints(paired),
                        real,
                    )
                )
        return real_sets, Outcome(scores)

    def _paired(self, rows: Sequence[DrawnClip]) -> Rows:
        motions = self._motions(rows, real_motions(self.clips, rows))
        if references := self.clips.store.references([row.clip.id for row in rows]):
            motions.inputs["references"] = [torch.from_numpy(joints) for joints in references]
        return self.evaluator.extract(motions)

    def _unexpected(self, values: Mapping[str, Value | None]) -> list[str]:
        """Returns a line for each unexpected value of the real test motions."""
        if not values or self.protocol.resized_samples or self.protocol.cuts_motions:
            return []
        lines = []
        for metric, (expected, tolerance) in self._expected().items():
            value = values.get(metric)
            mean = value.mean if value else None
            if mean is None:
                if not self.evaluator.skip_features:
                    lines.append(
                        f"{metric} of real motions could not be computed (expected: {expected:g})"
                    )
            elif not abs(mean - expected) <= tolerance:
                lines.append(
                    f"real motions have {metric} {mean:.4g}, expected {expected:g} +- {tolerance:g}"
                )
        return lines

    def _expected(self) -> dict[str, list[float]]:
        """Returns, for each metric, the expected value for real motions and its tolerance.

        Returns {} unless the test split is evaluated.
        """
        # A data set without test clips (HumanAct12) is tested on its training clips, so their
        # values are checked.
        info = self.clips.store.info
        if self.clips.clips[0].split != "test" and info["clips"]["test"]:
            return {}
        names = [info["dataset"], *([self.extractor.sha256] if self.extractor else [])]
        return {
            metric: bounds
            for name in names
            for metric, bounds in self.protocol.expected.get(name, {}).items()
        }

    def _conditions(self) -> list[str]:
        """Returns notes on limitations.

        The notes cover repeated clips and values for real motions that were not checked.
        """
        lines = []
        clips = len(self.protocol.selected(self.clips))
        drawn = {
            "motions": self.protocol.samples,
            "real motions for set comparisons": self.protocol.real_samples,
        }
        for purpose, count in drawn.items():
            if count is not None and count > clips:
                lines.append(
                    f"{count} {purpose} from {clips} clips: clips are repeated, which changes the "
                    f"distances between sets"
                )
        if self.protocol.resized_samples and self._expected():
            lines.append(
                "the expected values of real motions were not checked: they hold only for the "
                "protocol's number of motions"
            )
        if self.protocol.cuts_motions and self._expected():
            lines.append(
                "the expected values of real motions were not checked: this protocol does not measure the first frames"
            )
        return lines

    def _measure(
        self, source: Source, real_sets: Sequence[tuple[Rows, Rows]], resamples: int
    ) -> Outcome:
        """Measures the source's motions for each replication."""
        scores, costs, warnings = [], [], []
        resampled: Mapping[str, list[float | None]] = {}
        for replication, (paired, real) in enumerate(real_sets):
            rows = self.protocol.rows(self.clips, self.seed, replication)
            samples = source(f"rep_{replication}", rows, replication)
            costs.append(samples.cost)
            # Motions from another system may not cover all clips.
            if len(samples.rows) != len(rows):
                ids = {row.id for row in samples.rows}
                paired = _select(paired, [i for i, row in enumerate(rows) if row.id in ids])
            generated = self.evaluator.extract(self._generated(samples))
            scores.append(self._score(self.evaluator, generated, paired, real, replication))
            if not replication:
                warnings = self._warnings(generated, real)
                resampled = self.evaluator.resample(
                    generated, paired, real, key("draws", self.seed, 0), resamples
                )
        counts = [replication.count for replication in scores]
        if len(set(counts)) > 1:
            numbers = ", ".join(map(str, counts))
            warnings.append(
                f"the replications have different numbers of motions ({numbers}), which affects "
                "values that depend on this number"
            )
        return Outcome(scores, resampled, warnings, costs)

    def _measure_multimodality(self, source: Source, evaluator: Evaluator) -> Outcome:
        """Computes the metrics that need several motions per prompt."""
        several = self.protocol.multimodality
        assert several is not None
        generates = isinstance(source, Generator) and not self.protocol.quick
        scores = []
        nothing = evaluator.extract(self._motions([], []))
        for replication in range(several.replications):
            motions = paired = nothing
            if generates:
                rows = self.protocol.prompts(self.clips, self.seed, replication)
                motions = evaluator.extract(
                    self._generated(source(f"multimodality_{replication}", rows, replication))
                )
                real = self._paired(rows[:: several.samples])
                paired = _select(real, [i // several.samples for i in range(len(rows))])
            scores.append(self._score(evaluator, motions, paired, nothing, replication))
        if generates:
            return Outcome(scores)
        reason = (
            "not computed in a quick evaluation"
            if self.protocol.quick
            else "there is one sample per clip"
        )
        return Outcome(
            scores, not_computed={"multimodality": f"{reason}: it needs several samples per prompt"}
        )

    def _generated(self, samples: Samples) -> Motions:
        """Returns the motions to measure, smoothed over time if the protocol requires it.

        Each motion is smoothed without its padding, as in FLAME's code.
        """
        sigma, features = self.protocol.smoothing, samples.features
        if sigma is not None:
            features = [gaussian_filter1d(motion, sigma, axis=0) for motion in features]
        return self._motions(samples.rows, features, samples.captions)

    def _warnings(self, generated: Rows, real: Rows) -> list[str]:
        lines: list[str] = []
        count, others = len(generated["keys"]), len(real["keys"])
        for name, config in self.protocol.metrics.items():
            if "generated" in generated and config["_target_"].endswith(
                FrechetMotionDistance.__name__
            ):
                width = generated["generated"].shape[1]
                if min(count, others) < 2 * width:
                    few = f"{min(count, others)} motions are fewer than twice the {width} features"
                    lines.append(f"{name}: biased upward, because {few}")
                if count != others:
                    numbers = f"{count} generated and {others} real motions"
                    lines.append(
                        f"{name}: {numbers}. Compare it only with values for the same numbers of motions"
                    )
        return lines

    def _motions(
        self,
        rows: Sequence[DrawnClip],
        features: list[np.ndarray],
        captions: list[str] | None = None,
    ) -> Motions:
        """Combines the features of motions with the conditions in `rows`.

        If `captions` is not None, these captions replace the captions in `rows`.
        """
        condition = self.protocol.condition
        texts = captions or [row.text for row in rows] if condition == "text" else None
        attributes = [row.clip.attributes for row in rows]
        inputs: dict[str, Any] = {"groups": keys_of([row.prompt for row in rows])}
        if condition == "action":
            inputs["labels"] = torch.tensor([row.clip.action for row in rows])
        if condition != "none" and all("action" in x for x in attributes):
            inputs["requested"] = [row.requested for row in rows]
        if condition != "none" and all("content" in x for x in attributes):
            inputs["sides"] = [(x["content"], x.get("side", "")) for x in attributes]
        return Motions(
            ids=[row.id for row in rows],
            features=features,
            captions=texts,
            tokens=[row.tokens(caption) for row, caption in zip(rows, texts, strict=True)]
            if texts
            else None,
            inputs=inputs,
            edit=self.protocol.edit,
        )


def _without_joints(rows: Rows) -> Rows:
    return {name: values for name, values in rows.items() if name != "joints"}


def _select(rows: Rows, indices: list[int]) -> Rows:
    return {
        n: v[indices] if isinstance(v, Tensor) else [v[i] for i in indices] for n, v in rows.items()
    }


def _refuse(unexpected: Sequence[str]) -> None:
    if not is_first():
        raise SystemExit(1)  # rank 0 prints the reason
    raise UserError(
        f"nothing was generated, because {'; '.join(unexpected)}. Check the data and the extractor, or add "
        "force=true; the result is then marked as not valid"
    )
