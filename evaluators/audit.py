# pyright: standard
"""Evaluator audit: perturbs real motions at several grades and measures the results."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.stats import mannwhitneyu, rankdata
from torch import Tensor

from evaluators.evaluation_request import EvaluationRequest
from evaluators.evaluator import Evaluator, keys_of
from evaluators.evaluator import Motions as MotionsOf
from evaluators.extractors import OwnExtractor
from evaluators.metrics import make_metrics, required_inputs
from evaluators.metrics.samples import SampleMetric
from evaluators.perturbations import (
    BASE,
    REAL,
    STORED,
    Inputs,
    Motions,
    Perturbation,
    base_motions,
    perturbations_of,
)
from evaluators.plan import open_data
from evaluators.protocol import digest, open_protocol
from evaluators.scene import Scene, Text, text_of
from evaluators.sources import real_motions
from flame_mdm.errors import UserError
from flame_mdm.progress import ProgressBar
from flame_mdm.records import AuditCard
from flame_mdm.representations.humanml import HumanML
from flame_mdm.safe_io import atomic_write, read_npz
from flame_mdm.safe_io.paths import check_within
from flame_mdm.schemas import check_shape
from flame_mdm.training.provenance import environment

FORMAT = 1
CACHE = 2  # version of the cached metric inputs
OF_TEXTS = {"text", "text_keys", "captions", "requested"}
"""Inputs that depend on the captions of the motions."""
AVAILABLE = OF_TEXTS | {"keys", "joints", "mask", "contacts", "generated", "real"}
"""Inputs that an audit can provide. Metrics that require other inputs are not audited."""


def audit(request: EvaluationRequest, cache: Path, resamples: int) -> AuditCard:
    """Measures perturbed motions from a split, with bootstrap confidence intervals.

    See docs/audit.md. The folder `cache` stores metric inputs, so that an interrupted audit can be
    resumed. Raises `UserError` if the data, protocol and extractor do not match.
    """
    data = open_data(request, None)
    info, representation = data.store.info, data.representation.to(request.device or "cpu")
    if not isinstance(representation, HumanML):
        raise UserError(
            f"an audit needs joint positions, not {representation.name}. Add representation=humanml_clean"
        )
    clips = data.clips(request.split)
    protocol, _ = open_protocol(str(request.protocol), clips, representation, None, replications=1)
    extractor = protocol.open_extractor(request.extractor, representation, info["dataset"])
    rows = protocol.rows(clips, request.seed, 0)[: request.samples]
    again = {row.clip.id: row for row in protocol.rows(clips, request.seed, 0, purpose="real")}
    recipe = (
        extractor.task.config.get("experiment") if isinstance(extractor, OwnExtractor) else None
    )
    name = str(recipe or Path(str(request.extractor)).name)
    facts = {
        "extractor": extractor and {"sha256": extractor.sha256, "name": name},
        "protocol": {"name": protocol.name, "version": protocol.version},
        "data": {name: info[name] for name in ("dataset", "fingerprint", "representation")}
        | {"frames": [data.crop.min_frames, data.crop.longest()]},
        "split": request.split,
        "seed": request.seed,
        "motions": len(rows),
    }
    evaluator = Evaluator(
        extractor, protocol.metrics, representation, batch_size=request.batch_size or 64
    )
    scene = Scene(data, rows, real_motions(clips, rows), representation, request.seed)
    texts = [text_of(row, row.text) for row in rows] if protocol.condition == "text" else []
    perturbations = perturbations_of(scene, bool(texts))
    sets: dict[str, Motions] = {
        REAL: lambda: real_motions(clips, [again[row.clip.id] for row in rows]),
        BASE: lambda: base_motions(scene),
        STORED: lambda: scene.features,
    }
    for perturbation in perturbations:
        sets |= perturbation.motions(scene)
    folder = cache / digest([CACHE, facts, protocol.sha256])[:16]
    check_within(folder, cache.parent)
    steps = len(sets) + sum(len(perturbation.grades) for perturbation in perturbations)
    with ProgressBar(total=steps, desc="audit", unit=" sets") as bar:
        inputs: dict[str, Inputs] = {}
        for name, make in sets.items():
            inputs[name] = _inputs(
                evaluator, folder / f"{name.replace(' ', '-')}.npz", [row.id for row in rows], make
            )
            bar.update()
        measure = _Measure(evaluator, inputs, texts, scene.draws("bootstrap"), resamples)
        measured = _measured(measure, scene, perturbations, texts, bar)
    packages = environment()["packages"]
    return check_shape(
        {"format": FORMAT, **facts, "resamples": resamples, "packages": packages, **measured},
        AuditCard,
    )


def _measured(
    measure: _Measure,
    scene: Scene,
    perturbations: Sequence[Perturbation],
    texts: Sequence[Text],
    bar: ProgressBar,
) -> dict[str, Any]:
    """Returns the parts of a card: the metrics, and their values for each perturbation at each grade."""
    base = measure(measure.inputs[BASE], texts)
    scores, listed = [measure.scores(measure.inputs[BASE], texts)], []
    for perturbation in perturbations:
        grades = []
        changed, wrong = measure.inputs[BASE], texts
        for grade in perturbation.grades:
            changed, wrong = perturbation.apply(scene, grade, measure.inputs, texts)
            grades.append(
                {"grade": float(grade), "values": _differences(measure(changed, wrong), base)}
            )
            bar.update()
        if perturbation.group == "meaning":
            scores.append(measure.scores(changed, wrong))
        about = {name: getattr(perturbation, name) for name in ("name", "group", "about", "unit")}
        listed.append({**about, "grades": grades})
    return {
        "metrics": {name: measure.direction_of(name) for name in base},
        "facts": {name: measure.facts_of(name) for name in base},
        "real": {name: _interval(values) for name, values in base.items()},
        "perturbations": listed,
        "not_computed": measure.reasons,
        "truth": _agreement(measure, scores, listed),
    }


def _inputs(evaluator: Evaluator, path: Path, ids: list[str], make: Motions) -> Inputs:
    """Returns the metric inputs for motions, read from the cache or computed in a feature pass."""
    if path.exists():
        return read_npz(path)
    extracted = evaluator.extract(MotionsOf(ids, make()))
    features = extracted.get("generated")
    inputs: Inputs = {} if features is None else {"features": features.double().numpy()}
    for name, metric in audited_metrics(evaluator).items():
        inputs |= {
            _named(name, part): values for part, values in metric.readings(extracted).items()
        }
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as temporary:
        np.savez(temporary, allow_pickle=False, **inputs)
    return inputs


def audited_metrics(evaluator: Evaluator) -> dict[str, SampleMetric]:
    """Returns the metrics for which the audit can provide all inputs, keyed by name."""
    metrics = make_metrics(evaluator.metrics)
    return {
        name: metric
        for name, metric in metrics.items()
        if AVAILABLE.issuperset(required_inputs(metric))
    }


def _named(metric: str, part: str) -> str:
    return f"{metric}/{part}" if part else metric


class _Measure:
    """Computes metrics from cached inputs, for all motions and for each bootstrap resample.

    A resample only changes weights: each motion or pair is weighted by how often it is drawn. The
    candidates for retrieval are not resampled. FID is recomputed for each resample. Retrieval and
    diversity are averaged over all pools and pairs that a protocol could draw.
    """

    def __init__(
        self,
        evaluator: Evaluator,
        inputs: Mapping[str, Inputs],
        texts: Sequence[Text],
        draws: np.random.Generator,
        resamples: int,
    ):
        self.metrics, self.extractor, self.inputs = (
            audited_metrics(evaluator),
            evaluator.extractor,
            inputs,
        )
        count = len(next(iter(inputs[BASE].values())))
        resampled = draws.multinomial(count, np.full(count, 1 / count), resamples)
        self.weights = np.concatenate([np.ones((1, count), int), resampled])
        self.reasons: dict[str, str] = (
            {} if self.extractor else {"extractor": "metrics that need features"}
        )
        self.encoded: dict[str, Tensor] = {}
        self.real_texts, self.of_motions = texts, {}

    def __call__(self, inputs: Inputs, texts: Sequence[Text]) -> dict[str, np.ndarray]:
        """Returns each metric's values (1 + R,): for all motions, and then for R resamples."""
        values: dict[str, np.ndarray] = {}
        for name, metric in self.metrics.items():
            reused = self.of_motions.get(name) if inputs is self.inputs[BASE] else None
            values |= reused or self._weighted(name, metric, inputs, texts)
        return values

    def _weighted(
        self, name: str, metric: SampleMetric, inputs: Inputs, texts: Sequence[Text]
    ) -> dict[str, np.ndarray]:
        rows = self._rows(name, metric, inputs, texts)
        if rows is None:
            return {}
        try:
            computed = metric.weighted(rows, self.weights)
        except UserError as error:
            self.reasons[name] = str(error)
            return {}
        values = {
            _named(name, part): x for part, x in computed.items() if _is_audited(metric, part)
        }
        if inputs is self.inputs[BASE] and not OF_TEXTS.intersection(required_inputs(metric)):
            self.of_motions[name] = values  # these values do not depend on the captions
        return values

    def scores(self, inputs: Inputs, texts: Sequence[Text]) -> dict[str, np.ndarray]:
        """Returns the values (N,) for N individual motions or pairs, keyed by metric."""
        values = {}
        for name, metric in self.metrics.items():
            rows = self._rows(name, metric, inputs, texts)
            if rows is not None and name not in self.reasons:
                pairs = metric.per_sample(rows)
                values |= {_named(name, part): np.asarray(x)[:, 0] for part, x in pairs.items()}
        return values

    def direction_of(self, name: str) -> bool | None:
        metric, _, part = name.partition("/")
        return self.metrics[metric].direction_of(part)

    def facts_of(self, name: str) -> dict[str, Any]:
        """Returns the properties that a card lists for a value; see `AuditedMetric`.

        The properties do not include whether a higher value is better.
        """
        metric, _, part = name.partition("/")
        declared = self.metrics[metric]
        return {
            "unit": declared.unit_of(part),
            "sees_meaning": declared.sees_meaning,
            "sums_up": part == declared.summary,
            "exact": declared.exact is not None,
            "depends_on_count": declared.depends_on_count,
        }

    @property
    def truth(self) -> str | None:
        """Name of the value that checks requested attributes exactly, or None if there is none."""
        exact = {
            name: metric.exact for name, metric in self.metrics.items() if metric.exact is not None
        }
        return next((_named(name, part) for name, part in exact.items()), None)

    @property
    def judges(self) -> dict[str, int]:
        """Values that rate motion-text pairs by their features.

        The names of the values are mapped to 1, or to -1 if lower is better.
        """
        names = {}
        for name, metric in self.metrics.items():
            if "text" in required_inputs(metric):
                part = metric.names[0] if metric.names else ""
                names[_named(name, part)] = -1 if metric.direction_of(part) is False else 1
        return names

    def _rows(
        self, name: str, metric: SampleMetric, inputs: Inputs, texts: Sequence[Text]
    ) -> dict[str, Any] | None:
        """Returns a metric's inputs and readings in float64, or None if an input is missing."""
        required = set(required_inputs(metric)) | (
            {"generated"} if "generated" in metric.states else set()
        )
        rows: dict[str, Any] = {}
        if "generated" in required:
            if "features" not in inputs:
                return None
            rows = {
                "generated": torch.from_numpy(inputs["features"]),
                "real": torch.from_numpy(self.inputs[REAL]["features"]),
            }
        if required & OF_TEXTS:
            if not texts or (
                "requested" in required and not all("action" in text.requested for text in texts)
            ):
                return None
            rows["requested"] = [text.requested for text in texts]
            rows["captions"] = [text.caption for text in texts]
        if "text" in required:
            rows["text"] = self._encoded(texts)
            rows["text_keys"] = keys_of([text.caption for text in texts])
            rows["paired"] = torch.from_numpy(self.inputs[STORED]["features"])
            rows["paired_text"] = self._encoded(self.real_texts)
        prefix = f"{name}/"
        named = {
            key: values for key, values in inputs.items() if key == name or key.startswith(prefix)
        }
        return rows | {
            key.removeprefix(name).removeprefix("/"): values for key, values in named.items()
        }

    def _encoded(self, texts: Sequence[Text]) -> Tensor:
        """Encodes texts as float64 features (N, E). Each distinct caption is encoded once."""
        assert self.extractor is not None
        new = {text.caption: text for text in texts if text.caption not in self.encoded}
        if new:
            features = self.extractor.texts(list(new), [text.tokens for text in new.values()])
            assert features is not None
            self.encoded |= dict(zip(new, features.detach().cpu().double(), strict=True))
        return torch.stack([self.encoded[text.caption] for text in texts])


def _is_audited(metric: SampleMetric, part: str) -> bool:
    return metric.audited is None or part in metric.audited


def _interval(values: np.ndarray) -> list[float | None]:
    """Returns a value and the half width of its 95 % interval. Both are None if they cannot be computed."""
    pair = [float(values[0]), float(1.96 * values[1:].std())]
    return [float(f"{x:.6g}") for x in pair] if np.isfinite(pair).all() else [None, None]


def _differences(
    values: Mapping[str, np.ndarray], base: Mapping[str, np.ndarray]
) -> dict[str, list[float | None]]:
    """Returns each metric's value and its difference from the value for real motions.

    Each of the two comes with the half width of its 95 % interval.
    """
    pairs = {
        name: (values.get(name, np.full_like(real, np.nan)), real) for name, real in base.items()
    }
    return {name: [*_interval(x), *_interval(x - real)] for name, (x, real) in pairs.items()}


def _agreement(
    measure: _Measure,
    scores: Sequence[Mapping[str, np.ndarray]],
    perturbations: Sequence[Mapping[str, Any]],
) -> dict[str, dict[str, float | None]]:
    """Returns how well each metric that rates pairs agrees with the exact attributes.

    "auc" is the probability that a pair with every requested attribute scores better than a pair
    that lacks at least one. It is computed from pairs with real motions and pairs with the
    strongest perturbations of meaning. "correlation" is Spearman's rank correlation over these
    perturbations at all grades. Returns {} if the exact attributes are unknown.
    """
    truth = measure.truth
    if truth is None or truth not in scores[0]:
        return {}
    right = np.concatenate([of_set[truth] for of_set in scores]) > 0
    grades = [grade["values"] for perturbation in perturbations for grade in perturbation["grades"]]
    agreement = {}
    for name, sign in measure.judges.items():
        if name in scores[0]:
            score = np.concatenate([of_set[name] for of_set in scores]) * sign
            larger = mannwhitneyu(score[right], score[~right], method="asymptotic")[0]
            both = [
                (grade[name][0], grade[truth][0]) for grade in grades if grade[name][0] is not None
            ]
            agreement[name] = {
                "auc": float(larger / (right.sum() * (~right).sum())),
                "correlation": float(np.corrcoef(rankdata(both, axis=0).T)[0, 1]),
            }
    return agreement
