"""Evaluator audit: real motions, perturbed at graded strengths, are measured like generated ones."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from scipy.stats import hypergeom, mannwhitneyu, rankdata
from torch import Tensor

from evaluators.evaluation_request import EvaluationRequest
from evaluators.evaluator import Evaluator, Motions, Rows
from evaluators.extractors import OwnExtractor
from evaluators.metrics import alignment, make_metrics, physics, update_metrics
from evaluators.metrics.attributes import AttributeAccuracy, read_attributes, right_attributes
from evaluators.metrics.distribution import FrechetMotionDistance, frechet_distance
from evaluators.metrics.diversity import Diversity
from evaluators.metrics.published_physics import PublishedPhysics
from evaluators.metrics.samples import MotionMean
from evaluators.perturbations import BASE, REAL, Inputs, Perturbation, Scene, Text, text_of
from evaluators.plan import open_data
from evaluators.protocol import digest, open_protocol
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
TRUTH = "attributes/all"  # share of motions that show every requested attribute
PHYSICS = (physics.FootSkating, physics.StaticShare, physics.Penetration, physics.Jitter, PublishedPhysics)


def audit(request: EvaluationRequest, cache: Path, resamples: int) -> AuditCard:
    """Measures perturbations of the motions of a split, with intervals from bootstrap resamples; see docs/audit.md.

    A killed audit continues with the metric inputs in the folder `cache`. Raises `UserError` if data, protocol and
    extractor do not match.
    """
    data = open_data(request, None)
    info, representation = data.store.info, data.representation.to(request.device or "cpu")
    if not isinstance(representation, HumanML):
        raise UserError(f"an audit needs joint positions, not {representation.name}. Add representation=humanml_clean")
    clips = data.clips(request.split)
    protocol, _ = open_protocol(str(request.protocol), clips, representation, None, replications=1)
    extractor = protocol.open_extractor(request.extractor, representation, info["dataset"])
    rows = protocol.rows(clips, request.seed, 0)[: request.samples]
    again = {row.clip.id: row for row in protocol.rows(clips, request.seed, 0, purpose="real")}
    recipe = extractor.task.config.get("experiment") if isinstance(extractor, OwnExtractor) else None
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
    evaluator = Evaluator(extractor, protocol.metrics, representation, batch_size=request.batch_size or 64)
    scene = Scene(data, rows, real_motions(clips, rows), representation, request.seed)
    sets = {REAL: lambda: real_motions(clips, [again[row.clip.id] for row in rows])} | scene.motions()
    texts = [text_of(row, row.text) for row in rows] if protocol.condition == "text" else []
    perturbations = scene.perturbations(bool(texts))
    folder = cache / digest([FORMAT, facts, protocol.sha256])[:16]
    check_within(folder, cache.parent)
    steps = len(sets) + sum(len(perturbation.grades) for perturbation in perturbations)
    with ProgressBar(total=steps, desc="audit", unit=" sets") as bar:
        inputs: dict[str, Inputs] = {}
        for name, make in sets.items():
            inputs[name] = _inputs(evaluator, folder / f"{name.replace(' ', '-')}.npz", [row.id for row in rows], make)
            bar.update()
        measure = _Measure(evaluator, inputs, texts, scene.draws("bootstrap"), resamples)
        measured = _measured(measure, scene, perturbations, texts, bar)
    packages = environment()["packages"]
    return check_shape({"format": FORMAT, **facts, "resamples": resamples, "packages": packages, **measured}, AuditCard)


def _measured(
    measure: _Measure, scene: Scene, perturbations: Sequence[Perturbation], texts: Sequence[Text], bar: ProgressBar
) -> dict[str, Any]:
    base = measure(measure.inputs[BASE], texts)
    scores, listed = [measure.scores(measure.inputs[BASE], texts)], []
    for perturbation in perturbations:
        grades = []
        changed, wrong = measure.inputs[BASE], texts
        for grade in perturbation.grades:
            changed, wrong = scene.condition(perturbation, grade, measure.inputs, texts)
            grades.append({"grade": float(grade), "values": _differences(measure(changed, wrong), base)})
            bar.update()
        if perturbation.group == "meaning":
            scores.append(measure.scores(changed, wrong))
        about = {name: getattr(perturbation, name) for name in ("name", "group", "about", "unit")}
        listed.append({**about, "grades": grades})
    return {
        "metrics": {name: measure.higher_is_better(name) for name in base},
        "real": {name: _interval(values) for name, values in base.items()},
        "perturbations": listed,
        "not_computed": measure.reasons,
        "truth": _agreement(scores, listed),
    }


def _inputs(evaluator: Evaluator, path: Path, ids: list[str], make: Callable[[], list[np.ndarray]]) -> Inputs:
    """Returns the metric inputs of motions, from the cache or else from one feature pass."""
    if path.exists():
        return read_npz(path)
    extracted = evaluator.extract(Motions(ids, make()))
    features = extracted.get("generated")
    inputs: Inputs = {} if features is None else {"features": features.double().numpy()}
    for name, metric in make_metrics(evaluator.metrics).items():
        if isinstance(metric, AttributeAccuracy):
            inputs["seen"] = np.array([json.dumps(read_attributes(x.numpy(), metric.fps)) for x in extracted["joints"]])
        elif isinstance(metric, PHYSICS):
            inputs |= _ratios(name, metric, extracted)
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as temporary:
        np.savez(temporary, allow_pickle=False, **inputs)
    return inputs


def _ratios(name: str, metric: MotionMean, extracted: Rows) -> Inputs:
    """Returns value and weight (N, 2) of each motion, by metric; nothing if it is defined at another frame rate."""
    if isinstance(metric, PublishedPhysics) and metric.required_fps not in (None, metric.fps):
        return {}
    for i, joints in enumerate(extracted["joints"]):
        rows = {"joints": joints[None], "mask": torch.ones(1, len(joints), dtype=torch.bool)}
        rows |= {"contacts": extracted["contacts"][i][None]} if "contacts" in extracted else {}
        update_metrics({name: metric}, keys=extracted["keys"][i : i + 1], **rows)
    pairs = torch.stack([torch.cat(getattr(metric, state)) for state in metric.states], 1).numpy()
    parts = [f"{name}/{part}" for part in metric.parts or metric.names] or [name]
    return {part: pairs[..., k] for k, part in enumerate(parts) if pairs[:, 1, k].any()}


class _Measure:
    """Values of metrics, without resampling and in each bootstrap resample of motions, from cached inputs.

    Values of motions or pairs are weighted by how often they are drawn, so candidates of retrieval are not resampled;
    FID is computed again. Retrieval and diversity are means over all pools and pairs that a protocol may draw.
    """

    def __init__(
        self,
        evaluator: Evaluator,
        inputs: Mapping[str, Inputs],
        texts: Sequence[Text],
        draws: np.random.Generator,
        resamples: int,
    ):
        self.metrics, self.extractor, self.inputs = make_metrics(evaluator.metrics), evaluator.extractor, inputs
        count = len(next(iter(inputs[BASE].values())))
        resampled = draws.multinomial(count, np.full(count, 1 / count), resamples)
        self.weights = np.concatenate([np.ones((1, count), int), resampled])
        self.reasons: dict[str, str] = {} if self.extractor else {"extractor": "metrics that need features"}
        self.encoded: dict[str, Tensor] = {}
        self.real_texts, self.base_sets = texts, self._sets(inputs[BASE])

    def __call__(self, inputs: Inputs, texts: Sequence[Text]) -> dict[str, np.ndarray]:
        """Returns the values (1 + R,) of each metric."""
        values = {}
        for name, pair in self._pairs(inputs, texts).items():
            weights = self.weights[:, : len(pair)]
            with np.errstate(invalid="ignore"):
                values[name] = weights @ pair[:, 0] / (weights @ pair[:, 1])
        values |= self.base_sets if inputs is self.inputs[BASE] else self._sets(inputs)  # the same for other captions
        order = list(self.metrics)
        return dict(sorted(values.items(), key=lambda item: order.index(item[0].partition("/")[0])))

    def scores(self, inputs: Inputs, texts: Sequence[Text]) -> dict[str, np.ndarray]:
        """Returns the values (N,) of single pairs, by metric."""
        return {name: pair[:, 0] for name, pair in self._pairs(inputs, texts).items()}

    def higher_is_better(self, name: str) -> bool | None:
        metric, _, part = name.partition("/")
        directions = getattr(self.metrics[metric], "DIRECTIONS", {})
        return directions.get(part, self.metrics[metric].higher_is_better)

    def _sets(self, inputs: Inputs) -> dict[str, np.ndarray]:
        """Returns the values (1 + R,) of metrics of sets, by name."""
        values: dict[str, np.ndarray] = {}
        if "features" not in inputs:
            return values
        x, real = (torch.from_numpy(group["features"]) for group in (inputs, self.inputs[REAL]))
        for name, metric in self.metrics.items():
            if isinstance(metric, Diversity):
                weights = self.weights[:, : len(x)]
                values[name] = ((weights @ _distances(x, x).numpy()) * weights).sum(1) / weights.sum(1) ** 2
            elif isinstance(metric, FrechetMotionDistance):
                repeats = [(torch.from_numpy(w[: len(x)]), torch.from_numpy(w)) for w in self.weights]
                drawn = ((x.repeat_interleave(a, 0), real.repeat_interleave(b, 0)) for a, b in repeats)
                values[name] = np.array([frechet_distance(*sets).item() for sets in drawn])
        return values

    def _pairs(self, inputs: Inputs, texts: Sequence[Text]) -> dict[str, np.ndarray]:
        """Returns value and weight (N, 2) of each motion or pair, by metric."""
        pairs = {name: pair for name, pair in inputs.items() if name.partition("/")[0] in self.metrics}
        if texts and "seen" in inputs and all("action" in text.requested for text in texts):
            read = [(json.loads(str(seen)), text.requested) for seen, text in zip(inputs["seen"], texts, strict=True)]
            right = [right_attributes(*pair) for pair in read]
            name = next(name for name, metric in self.metrics.items() if isinstance(metric, AttributeAccuracy))
            for part in AttributeAccuracy.names:
                if any(part in shown for shown in right):
                    weighted = [[shown.get(part, False), part in shown] for shown in right]
                    pairs[f"{name}/{part}"] = np.array(weighted, float)
        if not texts or "features" not in inputs:
            return pairs
        motion, text = torch.from_numpy(inputs["features"]), self._encoded(texts)
        unit = F.normalize(motion, dim=-1), F.normalize(text, dim=-1)
        values: dict[str, np.ndarray | Tensor] = {}
        for name, metric in self.metrics.items():
            pair = unit if getattr(metric, "normalize", False) else (motion, text)
            if isinstance(metric, alignment.TextsForMotion):
                candidates = {text.caption: text for text in texts}
                columns = list(candidates)
                own = torch.tensor([columns.index(text.caption) for text in texts])
                distance = _distances(motion, self._encoded(list(candidates.values())))
                values |= self._top(name, metric, distance, own)
            elif isinstance(metric, alignment.MotionsForText):
                values |= self._top(name, metric, _distances(pair[1], pair[0]), torch.arange(len(motion)))
            elif isinstance(metric, alignment.MultimodalDistance):
                values[name] = torch.linalg.vector_norm(pair[0] - pair[1], dim=-1)
            elif isinstance(metric, alignment.MotionCLIPScore):
                values[name] = (unit[0] * unit[1]).sum(1)
            elif isinstance(metric, alignment.MutualInformationDivergence):
                real, real_text = torch.from_numpy(self.inputs["as stored"]["features"]), self._encoded(self.real_texts)
                if len(real) > real.shape[1] + real_text.shape[1]:
                    sets = (real, real_text, motion, text)
                    values[name] = alignment.pointwise_mutual_information(*sets, metric.eps)
                else:
                    self.reasons[name] = f"{len(real)} motions are too few for its covariances"
        return pairs | {name: np.stack([value, np.ones(len(value))], 1) for name, value in values.items()}

    def _encoded(self, texts: Sequence[Text]) -> Tensor:
        """Returns features (N, E) of texts, float64; each caption is encoded once."""
        assert self.extractor is not None
        new = {text.caption: text for text in texts if text.caption not in self.encoded}
        if new:
            features = self.extractor.texts(list(new), [text.tokens for text in new.values()])
            assert features is not None
            self.encoded |= dict(zip(new, features.detach().cpu().double(), strict=True))
        return torch.stack([self.encoded[text.caption] for text in texts])

    def _top(
        self, name: str, metric: alignment.TextsForMotion | alignment.MotionsForText, distance: Tensor, own: Tensor
    ) -> dict[str, np.ndarray]:
        """Returns how probable it is that the own candidate is among the top 1 and 3 of a random pool, by query."""
        others = distance.shape[1] - 1
        if others + 1 < metric.pool:
            self.reasons[name] = f"{others + 1} candidates are fewer than a pool of {metric.pool}"
            return {}
        at = distance.gather(1, own[:, None])
        closer = (distance < at).sum(1) + ((distance == at).sum(1) - 1) // 2
        return {f"{name}/top{k}": hypergeom.cdf(k - 1, others, closer.numpy(), metric.pool - 1) for k in (1, 3)}


def _distances(a: Tensor, b: Tensor) -> Tensor:
    return torch.cdist(a, b, compute_mode="donot_use_mm_for_euclid_dist")


def _interval(values: np.ndarray) -> list[float | None]:
    """Returns the value and the half width of its 95 % interval; None if it cannot be computed."""
    pair = [float(values[0]), float(1.96 * values[1:].std())]
    return [float(f"{x:.6g}") for x in pair] if np.isfinite(pair).all() else [None, None]


def _differences(values: Mapping[str, np.ndarray], base: Mapping[str, np.ndarray]) -> dict[str, list[float | None]]:
    """Returns value and interval, difference from real motions and its interval, by metric."""
    pairs = {name: (values.get(name, np.full_like(real, np.nan)), real) for name, real in base.items()}
    return {name: [*_interval(x), *_interval(x - real)] for name, (x, real) in pairs.items()}


def _agreement(
    scores: Sequence[Mapping[str, np.ndarray]], perturbations: Sequence[Mapping[str, Any]]
) -> dict[str, dict[str, float | None]]:
    """Returns how well metrics of pairs agree with exact attributes, by metric; {} if these are not known.

    "auc" is the probability that a pair with every requested attribute has a better score than one without, among real
    motions and the strongest perturbations of the meaning; "correlation" is Spearman's over all of them and grades.
    """
    if TRUTH not in scores[0]:
        return {}
    right = np.concatenate([of_set[TRUTH] for of_set in scores]) > 0
    grades = [grade["values"] for perturbation in perturbations for grade in perturbation["grades"]]
    agreement = {}
    for name in scores[0]:
        if name.endswith("/top1") or name in ("mm_dist", "mclip_score", "mid"):
            score = np.concatenate([of_set[name] for of_set in scores]) * (-1 if name == "mm_dist" else 1)
            larger = mannwhitneyu(score[right], score[~right], method="asymptotic")[0]
            both = [(grade[name][0], grade[TRUTH][0]) for grade in grades if grade[name][0] is not None]
            agreement[name] = {
                "auc": float(larger / (right.sum() * (~right).sum())),
                "correlation": float(np.corrcoef(rankdata(both, axis=0).T)[0, 1]),
            }
    return agreement
