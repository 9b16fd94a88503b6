# pyright: standard
"""The evaluator, which computes many metrics with a single feature pass over the motions."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from evaluators.collectives import dealt, is_first
from evaluators.extractors import Extractor
from evaluators.metrics import make_metrics, missing_input, required_inputs, update_metrics
from evaluators.metrics.memorization import TrainingMotions, poses
from evaluators.metrics.samples import SampleMetric, TwoSets
from flame_mdm.batch import length_mask
from flame_mdm.config import Config
from flame_mdm.errors import UserError
from flame_mdm.progress import ProgressBar
from flame_mdm.representations import Representation
from flame_mdm.sampling.editing import kept_parts
from flame_mdm.sampling.motion_request import EditRequest
from flame_mdm.seeds import key

# Motions per update of a metric. More motions would not fit into the CPU cache.
CHUNK = 64
# Metric inputs that come from an extractor
FEATURES = {"generated", "real", "text", "logits"}
PAIRED = {
    "generated": "real",
    "joints": "real_joints",
    "nearest": "real_nearest",
    "references": "references",
}
"""Names of inputs from generated motions -> names of the same inputs from paired real motions."""


@dataclass
class Motions:
    """N real or generated motions, with their conditions."""

    # Unique names
    ids: list[str]
    # (F, D) float32 each, in the data's units
    features: list[np.ndarray]
    # Captions of motions with text
    captions: list[str] | None = None
    # "word/PART" tokens of the captions, if the data has tokens
    tokens: list[list[str] | None] | None = None
    # Additional inputs, by their names in `evaluators.metrics`
    inputs: dict[str, Any] = field(default_factory=dict)
    # The parts that an edit kept: the arguments `region` and `joints` of `kept_parts`
    edit: Mapping[str, Any] | None = None

    def __len__(self) -> int:
        return len(self.ids)


Rows = dict[str, Any]
"""Metric inputs for N motions, by their names in `evaluators.metrics`.

An input is a tensor, or a list of N entries (such as joints).
"""


@dataclass
class Evaluator:
    """Computes metrics for motions, with one feature pass for all metrics.

    Given the same features, all values are bit-identical for any batch size and order. Several
    processes share the feature pass: each one receives whole batches, so that features do not
    depend on the number of processes. The first process computes the metrics.

    Example:
        >>> from flame_mdm.representations.humanml import HumanML
        >>> metrics = {"penetration": {"_target_": "evaluators.metrics.physics.Penetration"}}
        >>> evaluator = Evaluator(None, metrics, HumanML())
        >>> rows = evaluator.extract(Motions(["a"], [np.zeros((8, 263), np.float32)]))
        >>> evaluator.score(rows, {}, {}, seed=0)
        ({'penetration': 0.0}, {})
    """

    # Computes the features for metrics, or None for no features
    extractor: Extractor | None
    # Mappings with the `_target_` of a metric, by name
    metrics: Mapping[str, Config]
    representation: Representation
    batch_size: int = 64
    # Whether metrics that lack features are skipped instead of raising an error
    skip_features: bool = False
    # Training motions, used to find copies of them among generated motions, or None if copies are
    # not measured
    training: TrainingMotions | None = None

    @torch.no_grad()
    def extract(self, motions: Motions) -> Rows:
        """Computes the metric inputs for motions. All processes must pass the same motions.

        Raises `UserError` if a motion contains NaN or infinity.
        """
        rows: Rows = {"keys": keys_of(motions.ids), **motions.inputs}
        # Batches of similar lengths need little padding.
        order = np.argsort([len(x) for x in motions.features], kind="stable").tolist()
        batches = [
            order[begin : begin + self.batch_size]
            for begin in range(0, len(order), self.batch_size)
        ]
        parts = dealt(partial(self._batch, motions), batches)
        texts = [text for indices in batches if (text := self._texts(motions, indices)) is not None]
        back = np.argsort(order, kind="stable")
        unordered = [motion for batch, _ in parts for motion in batch]
        rows["joints"] = joints = [unordered[i] for i in back]
        if batches:
            rows |= {
                name: torch.cat([features[name] for _, features in parts])[back]
                for name in parts[0][1]
            }
        if texts:
            rows["text"] = torch.cat(texts)[back]
        if motions.captions is not None:
            rows |= {"text_keys": keys_of(motions.captions), "captions": motions.captions}
        contacts = self.representation.slices.get("contacts")
        if contacts is not None:
            rows["contacts"] = [torch.from_numpy(x[:, contacts] > 0.5) for x in motions.features]
        if motions.edit is not None:
            edit = EditRequest(**motions.edit)
            rows["kept"] = [
                kept_parts(self.representation, len(motion), edit)[1] for motion in joints
            ]
        if self.training is not None and joints:
            rows["nearest"] = self.training.nearest(joints, rows.get("generated"))
        return rows

    def training_motions(self, whole: Motions, windows: Motions) -> TrainingMotions:
        """Returns the training motions with which other motions are compared.

        They are stored as the poses of all frames and the features of windows.
        """
        facing = self.representation.skeleton.facing
        joints = replace(self, extractor=None).extract(whole)["joints"]
        frames = [poses(motion, facing) for motion in joints]
        lengths = torch.tensor([len(motion) for motion in frames])
        return TrainingMotions(
            torch.cat(frames), lengths, self.extract(windows).get("generated"), facing
        )

    @torch.no_grad()
    def reference(self) -> Rows | None:
        """Returns the features of the extractor's own real motions, or None if it has none.

        Without such motions, sets are compared with motions from the data set.
        """
        features = self.extractor and self.extractor.reference()
        if features is None:
            return None
        return {
            "generated": features,
            "keys": keys_of([f"reference {number}" for number in range(len(features))]),
        }

    def _batch(
        self, motions: Motions, indices: Sequence[int]
    ) -> tuple[list[Tensor], dict[str, Tensor]]:
        for i in indices:
            if not np.isfinite(motions.features[i]).all():
                raise UserError(
                    f"motion {motions.ids[i]} contains NaN or infinity. Did the model diverge?"
                )
        where = self.representation.mean.device
        lengths = [len(motions.features[i]) for i in indices]
        x = pad_sequence(
            [torch.from_numpy(motions.features[i]) for i in indices], batch_first=True
        ).to(where)
        mask = length_mask(torch.tensor(lengths, device=where))
        padded = self.representation.decode(x)
        joints = [
            motion[:length].clone() for motion, length in zip(padded.cpu(), lengths, strict=True)
        ]
        if self.extractor is None:
            return joints, {}
        features = self.extractor.motions(x, padded.where(mask[..., None, None], 0.0), mask)
        return joints, {
            "generated" if name == "features" else name: x.float().cpu()
            for name, x in features.items()
        }

    def _texts(self, motions: Motions, indices: Sequence[int]) -> Tensor | None:
        """Returns the features of captions.

        Every rank computes all of them, because extractors cache captions.
        """
        if self.extractor is None or motions.captions is None:
            return None
        tokens = motions.tokens or [None] * len(motions)
        text = self.extractor.texts(
            [motions.captions[i] for i in indices], [tokens[i] for i in indices]
        )
        return None if text is None else text.float().cpu()

    def score(
        self, generated: Rows, paired: Rows, real: Rows, seed: int
    ) -> tuple[dict[str, float | None], dict[str, str]]:
        """Computes all metrics for generated motions and their paired real motions.

        Generated and paired motions are in the same order. Metrics that compare sets use `real`, a
        separate draw of real motions, because the distance from a set to itself is 0. Returns the
        values, keyed by name (`metric` or `metric/part`), and the reasons for missing values, keyed
        by metric. A value that cannot be computed is None. Both mappings are empty in every process
        except the first. Raises `UserError` if the motions lack an input that a metric requires.
        """
        if not is_first():
            return {}, {}
        metrics, _ = self._updated(generated, paired, real, seed)
        return _values({name: metric.compute for name, metric in metrics.items()}, metrics)

    def resample(
        self, generated: Rows, paired: Rows, real: Rows, seed: int, resamples: int
    ) -> dict[str, list[float | None]]:
        """Computes all metrics for `resamples` sets of motions drawn with replacement (bootstrap).

        For metrics that compare two sets, motions are drawn from both sets. The draws depend only
        on `seed` and the numbers of motions, so that two models are compared on the same draws. See
        `score` for the arguments. Returns one value per resample, keyed by name.
        """
        count, others = len(generated["keys"]), len(real["keys"])
        if not is_first() or not count or not resamples:
            return {}
        metrics, usable = self._updated(generated, paired, real, seed)
        generator = np.random.default_rng(key("bootstrap", seed))
        drawn: list[dict[str, float | None]] = []
        for _ in ProgressBar(range(resamples), desc="bootstrap", unit=" sets"):
            rows, real_rows = (
                torch.from_numpy(generator.integers(n, size=n)) for n in (count, others)
            )
            values = {
                name: partial(metric.drawn_value, rows, real_rows)
                if name in usable
                else metric.compute
                for name, metric in metrics.items()
            }
            drawn.append(_values(values, metrics)[0])
        return {name: [values[name] for values in drawn] for name in drawn[0]}

    def _updated(
        self, generated: Rows, paired: Rows, real: Rows, seed: int
    ) -> tuple[dict[str, SampleMetric], dict[str, SampleMetric]]:
        """Updates the metrics with motions. Returns all metrics, and the subset that can be computed."""
        metrics = make_metrics(self.metrics, seed=key("metric", seed) % 2**32)
        for metric in metrics.values():
            # `bool()` returns False: metrics are not synchronized, because this process has all
            # motions.
            metric.distributed_available_fn = bool
        count = len(generated["keys"])
        usable = self.check(generated, metrics) if count else {}
        sets = {name: metric for name, metric in usable.items() if isinstance(metric, TwoSets)}
        others = {name: metric for name, metric in usable.items() if name not in sets}
        for begin in range(0, count, CHUNK):
            part = slice(begin, begin + CHUNK)
            if sets:
                update_metrics(
                    sets, generated=generated["generated"][part], keys=generated["keys"][part]
                )
            update_metrics(others, **_chunk(generated, paired, part))
        if "generated" in real:
            update_metrics(sets, real=real["generated"], real_keys=real["keys"])
        return metrics, usable

    @cached_property
    def declared(self) -> dict[str, SampleMetric]:
        """The metrics, keyed by name, for looking up the properties that they declare."""
        return make_metrics(self.metrics)

    def unit_of(self, name: str) -> str:
        """Returns the unit of a value, named `metric` or `metric/part`."""
        metric, _, part = name.partition("/")
        return self.declared[metric].unit_of(part)

    def compares_sets(self, name: str) -> bool:
        """Returns whether a value is computed by comparing a set of motions with real motions."""
        return isinstance(self.declared[name.partition("/")[0]], TwoSets)

    def reads(self, name: str) -> bool:
        """Returns whether any metric requires the input with this name."""
        return any(name in required_inputs(metric) for metric in self.declared.values())

    def check(
        self, motions: Rows, metrics: Mapping[str, SampleMetric] | None = None
    ) -> dict[str, SampleMetric]:
        """Returns the metrics that can be computed.

        With `skip_features`, metrics are left out if the features that they require are missing.
        Any other missing input raises `UserError`.
        """
        available = {
            *motions,
            "mask",
            "real_mask",
            *(PAIRED[name] for name in PAIRED if name in motions),
        }
        usable = {}
        for name, metric in (self.declared if metrics is None else metrics).items():
            needed = (
                ["generated", "keys"] if isinstance(metric, TwoSets) else required_inputs(metric)
            )
            missing = [row for row in needed if row not in available]
            if not missing:
                usable[name] = metric
            elif not (self.skip_features and FEATURES.intersection(missing)):
                raise missing_input(name, metric, missing[0])
        return usable


def keys_of(names: Sequence[str]) -> Tensor:
    """Returns the keys of N unique names, as int64 (N,); see `flame_mdm.seeds.key`."""
    return torch.tensor([key(name) for name in names], dtype=torch.long)


def _chunk(generated: Rows, paired: Rows, part: slice) -> Rows:
    """Returns padded inputs and masks for some motions and the real motions paired with them."""
    rows = {name: values[part] for name, values in generated.items()}
    rows |= {real: paired[name][part] for name, real in PAIRED.items() if name in paired}
    for joints, mask in (("joints", "mask"), ("real_joints", "real_mask")):
        if joints in rows:
            rows[mask] = length_mask(torch.tensor([len(motion) for motion in rows[joints]]))
    for name in {"joints", "real_joints", "kept", "contacts"} & rows.keys():
        rows[name] = pad_sequence(rows[name], batch_first=True)
    return rows


def _values(
    computations: Mapping[str, Callable[[], Any]], metrics: Mapping[str, SampleMetric]
) -> tuple[dict[str, float | None], dict[str, str]]:
    """Returns the values of metrics, and the reasons for missing values."""
    values: dict[str, float | None] = {}
    reasons: dict[str, str] = {}
    for name, metric in metrics.items():
        try:
            result = computations[name]()
        except UserError as error:
            reasons[name] = str(error)
            result = metric.nothing
        for part, value in result.items() if isinstance(result, dict) else [("", result)]:
            if value is not None and not math.isfinite(value):
                reasons[name] = (
                    f"{type(metric).__name__}: the value is {value}: too few or degenerate samples"
                )
                value = None
            values[f"{name}/{part}".rstrip("/")] = value
    return values, reasons
