"""Evaluator audit: real motions, perturbed at graded strengths, are measured like generated ones."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from scipy.stats import hypergeom, rankdata
from torch import Tensor
from torchmetrics import Metric

from evaluators.evaluator import Evaluator, Extracted, Motions
from evaluators.extractors import OwnExtractor
from evaluators.metrics import alignment, make_metrics, physics, update_metrics
from evaluators.metrics.attributes import ATTRIBUTES, AttributeAccuracy, read_attributes, right_attributes
from evaluators.metrics.distribution import FrechetMotionDistance, frechet_distance
from evaluators.metrics.diversity import Diversity
from evaluators.metrics.published_physics import MeanOverMotions
from evaluators.near_misses import near_misses
from evaluators.perturbations import PERTURBATIONS, Joints, Perturbation, continue_with, encode
from evaluators.plan import open_data
from evaluators.protocol import Row, digest, open_protocol
from evaluators.request import EvaluationRequest
from evaluators.sources import real_motions
from flame_mdm.config import EXPERIMENTS, instantiate
from flame_mdm.data.datamodule import MotionDataModule
from flame_mdm.errors import UserError
from flame_mdm.progress import ProgressBar
from flame_mdm.representations.humanml import HumanML
from flame_mdm.safe_io import atomic_write, read_npz, read_yaml
from flame_mdm.schemas import AuditCard, check_shape
from flame_mdm.seeds import key
from flame_mdm.training.provenance import environment

FORMAT = 1
BASE, REAL = "decoded and encoded", "reference"
"""Sets of motions that all others are compared with: those of grade 0, and the real ones of set metrics."""
TOTALS: dict[type[Metric], tuple[str, str]] = {
    **dict.fromkeys((physics.FootSkating, physics.StaticShare), ("hits", "total")),
    **dict.fromkeys((physics.Penetration, physics.Floating, physics.Jitter), ("total", "frames")),
}
"""States of metrics of joints: their value is the sum of the first over motions, divided by that of the second."""
TRUTH = "attributes/all"
"""Share of motions that show every requested attribute."""

Inputs = dict[str, np.ndarray]
"""Metric inputs of N motions: "features" (N, E), "seen" (N,) attributes as JSON, and totals (N, 2) by metric."""


class Text(NamedTuple):
    """A caption, its tagged words, and the attributes that it requests."""

    caption: str
    tokens: Sequence[str] | None
    requested: Mapping[str, Any]


def audit(request: EvaluationRequest, cache: Path) -> AuditCard:
    """Measures perturbations of the motions of a split; see docs/audit.md.

    Args:
        request: data, protocol, extractor, split and seed; `samples` limits the number of motions; `resamples` is the
            number of bootstrap resamples of motions, for the intervals.
        cache: folder of the metric inputs of perturbed motions, with which a killed audit continues.

    Raises:
        UserError: If data, protocol and extractor do not match, or the data is not represented by joint positions.
    """
    data = open_data(request, None)
    info, representation = data.store.info, data.representation.to(request.device or "cpu")
    if not isinstance(representation, HumanML):
        raise UserError(
            f"{info['dataset']} is encoded as {representation.name}, but an audit perturbs joint positions. Choose a "
            "representation of joint positions, such as representation=humanml_clean"
        )
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
        | {"frames": [data.crop.shortest(), data.crop.longest()]},
        "split": request.split,
        "seed": request.seed,
        "motions": len(rows),
    }
    evaluator = Evaluator(extractor, protocol.metrics, representation, batch_size=request.batch_size or 64)
    scene = _Scene(data, rows, real_motions(clips, rows), representation, request.seed)
    sets = {REAL: lambda: real_motions(clips, [again[row.clip.id] for row in rows])} | scene.motions()
    texts = [_text(row, row.text) for row in rows] if protocol.condition == "text" else []
    perturbations = scene.perturbations(bool(texts))
    folder = cache / digest([FORMAT, facts, protocol.sha256])[:16]
    steps = len(sets) + sum(len(perturbation.grades) for perturbation in perturbations)
    with ProgressBar(total=steps, desc="audit", unit=" sets") as bar:
        inputs: dict[str, Inputs] = {}
        for name, make in sets.items():
            inputs[name] = _inputs(evaluator, folder / f"{name.replace(' ', '-')}.npz", [row.id for row in rows], make)
            bar.update()
        measure = _Measure(evaluator, inputs, texts, scene.draws("bootstrap"), request.resamples)
        measured = _measured(measure, scene, perturbations, inputs, texts, bar)
    packages = environment()["packages"]
    return check_shape(
        {"format": FORMAT, **facts, "resamples": request.resamples, "packages": packages, **measured}, AuditCard
    )


def _measured(
    measure: _Measure,
    scene: _Scene,
    perturbations: Sequence[Perturbation],
    inputs: Mapping[str, Inputs],
    texts: Sequence[Text],
    bar: ProgressBar[Any],
) -> dict[str, Any]:
    """Returns the measured part of a card."""
    base = measure(inputs[BASE], texts)
    scores, listed = [measure.scores(inputs[BASE], texts)], []
    for perturbation in perturbations:
        grades = []
        changed, wrong = inputs[BASE], texts
        for grade in perturbation.grades:
            changed, wrong = scene.condition(perturbation, grade, inputs, texts)
            grades.append({"grade": float(grade), "values": _differences(measure(changed, wrong), base)})
            bar.update()
        if perturbation.group == "meaning":
            scores.append(measure.scores(changed, wrong))
        about = {name: getattr(perturbation, name) for name in ("name", "group", "about", "unit")}
        listed.append({**about, "grades": grades})
    return {
        "metrics": {name: _higher_is_better(measure.metrics, *name.partition("/")[::2]) for name in base},
        "real": {name: _interval(values) for name, values in base.items()},
        "perturbations": listed,
        "not_computed": measure.reasons,
        "truth": _agreement(scores, listed),
    }


# Perturbed motions and texts ------------------------------------------------------------------------------------------


class _Scene:
    """Real motions of a split, and how to perturb them."""

    def __init__(
        self, data: MotionDataModule, rows: list[Row], features: list[np.ndarray], representation: HumanML, seed: int
    ):
        self.data, self.rows, self.features, self.representation, self.seed = data, rows, features, representation, seed
        self.joints = [representation.decode(torch.from_numpy(x)).double().numpy() for x in features]
        self.wrong = self._wrong()

    def draws(self, *parts: str | int) -> np.random.Generator:
        """Returns the generator for a purpose."""
        return np.random.default_rng(key("audit", self.seed, *parts))

    def motions(self) -> dict[str, Callable[[], list[np.ndarray]]]:
        """Returns how to make each set of N motions, as features, by the name of the perturbation and the grade."""
        fps, mirror = self.representation.fps, self.representation.skeleton.mirror
        order = self.draws("other half").permutation(len(self.rows))
        other = dict(zip(order.tolist(), np.roll(order, 1).tolist(), strict=True))

        def changed(change: Callable[[int, Joints], Joints]) -> Callable[[], list[np.ndarray]]:
            return lambda: encode(self.representation, [change(i, x) for i, x in enumerate(self.joints)])

        def graded(perturbation: Perturbation, grade: float) -> Callable[[int, Joints], Joints]:
            change = perturbation.change
            assert change is not None
            # The draws are the same at all grades.
            return lambda i, x: change(x, grade, self.draws(perturbation.name, self.rows[i].id), fps)

        sets = {
            BASE: changed(lambda _, x: x),
            "as stored": lambda: self.features,
            "half precision": lambda: [x.astype(np.float16).astype(np.float32) for x in sets[BASE]()],
            "mirrored": changed(lambda _, x: mirror(torch.from_numpy(x)).numpy()),
            "reversed": changed(lambda _, x: x[::-1].copy()),
            "other half": changed(lambda i, x: continue_with(x, self.joints[other[i]], fps)),
            "memorized": self._memorized,
        }
        sets |= {f"{p.name} {g:g}": changed(graded(p, g)) for p in PERTURBATIONS if p.change for g in p.grades}
        for through in self._representations():
            sets[f"through {through.name}"] = changed(
                lambda _, x, r=through: r.decode(torch.from_numpy(encode(r, [x])[0])).numpy()
            )
        return sets

    def _memorized(self) -> list[np.ndarray]:
        """Returns for each motion a training motion with the same captions or the same action, or the motion itself."""
        training, copies = self.data.clips("train"), []
        for row in self.rows:
            same = [clip for clip in training.clips if clip.captions == row.clip.captions]
            same = same or [clip for clip in training.clips if clip.action == row.clip.action] or [row.clip]
            draws = self.draws("memorized", row.id)
            clip = same[int(draws.integers(len(same)))]
            copies.append(Row(row.id, clip, training.crop(clip.length, draws), None, row.id))
        return real_motions(training, copies)

    def _representations(self) -> list[HumanML]:
        """Returns the other representations of these joints."""
        files = sorted((EXPERIMENTS / "representation").glob("humanml*.yaml"))
        others: list[HumanML] = [instantiate(read_yaml(path)) for path in files]
        own = self.representation
        return [r for r in others if r.skeleton == own.skeleton and r.fps == own.fps and r.name != own.name]

    def _wrong(self) -> dict[str, list[Text | None]]:
        """Returns a wrong text for each motion, by the name of the perturbation; None if there is none."""
        texts = {caption: _text(row, caption) for row in self.rows for caption in row.clip.captions}
        contradicting = near_misses([row.clip for row in self.rows])
        names = sorted({name for misses in contradicting for name in misses})
        wrong: dict[str, list[Text | None]] = {}
        for kind in ("wrong captions", "near misses", *(f"near misses: {name}" for name in names if len(names) > 1)):
            wrong[kind] = []
            for row, misses in zip(self.rows, contradicting, strict=True):
                draws, options = self.draws(kind, row.id), misses.get(kind.partition(": ")[2], [])
                if kind == "near misses" and misses:
                    options = misses[sorted(misses)[draws.integers(len(misses))]]
                elif kind == "wrong captions":
                    options = [caption for caption in texts if caption not in row.clip.captions]
                wrong[kind].append(texts[options[draws.integers(len(options))]] if options else None)
        return {kind: chosen for kind, chosen in wrong.items() if any(chosen)}

    def perturbations(self, captioned: bool) -> list[Perturbation]:
        """Returns the perturbations of this data."""
        listed = []
        for perturbation in PERTURBATIONS:
            if perturbation.unit == "% of captions":
                kinds = (
                    [kind for kind in self.wrong if kind.partition(":")[0] == perturbation.name] if captioned else []
                )
                for kind in kinds:
                    most = 100 * sum(text is not None for text in self.wrong[kind]) / len(self.rows)
                    grades = [*(grade for grade in perturbation.grades if grade < most), round(most, 1)]
                    listed.append(replace(perturbation, name=kind, grades=grades))
            elif perturbation.unit == "motions":
                grades = [grade for grade in perturbation.grades if grade < len(self.rows)]
                listed.append(replace(perturbation, grades=grades))
            elif perturbation.unit != "% of actions" or len({row.clip.action for row in self.rows}) > 1:
                listed.append(perturbation)
        about = "encoded and decoded by another representation"
        listed += [Perturbation(f"through {other.name}", "plumbing", about) for other in self._representations()]
        return [perturbation for perturbation in listed if perturbation.grades]

    def condition(
        self, perturbation: Perturbation, grade: float, inputs: Mapping[str, Inputs], texts: Sequence[Text]
    ) -> tuple[Inputs, list[Text]]:
        """Returns the motions and texts of a perturbation at a grade; pair i belongs to real motion i."""
        base, texts, count = inputs[BASE], list(texts), len(self.rows)
        order, share = self.draws("order", perturbation.name).permutation(count), round(count * grade / 100)
        if perturbation.unit == "% of captions":
            for i in [i for i in order if self.wrong[perturbation.name][i]][:share]:
                texts[i] = self.wrong[perturbation.name][i] or texts[i]
        elif perturbation.unit == "% of motions":
            chosen = np.isin(np.arange(count), order[:share])
            shaped = {name: chosen.reshape(-1, *[1] * (x.ndim - 1)) for name, x in base.items()}
            base = {name: np.where(shaped[name], inputs[perturbation.name][name], x) for name, x in base.items()}
        elif perturbation.unit == "% of actions":
            actions = sorted({row.clip.action or 0 for row in self.rows}, key=lambda a: key("missing", self.seed, a))
            gone = actions[: max(1, round(len(actions) * grade / 100))]
            kept = [i for i in order if (self.rows[i].clip.action or 0) not in gone]
            picked = np.array([i if i in kept else kept[i % len(kept)] for i in range(count)])
            return {name: x[picked] for name, x in base.items()}, [texts[i] for i in picked] if texts else []
        elif perturbation.unit == "motions":
            return {name: x[: int(grade)] for name, x in base.items()}, texts[: int(grade)]
        else:
            base = inputs[f"{perturbation.name} {grade:g}" if perturbation.change else perturbation.name]
        return base, texts


def _text(row: Row, caption: str) -> Text:
    tagged = row.clip.attributes.get("tokens")
    requested = {name: value for name, value in row.clip.attributes.items() if name in ATTRIBUTES}
    return Text(caption, tagged[row.clip.captions.index(caption)] if tagged else None, requested)


# Measurement ----------------------------------------------------------------------------------------------------------


def _inputs(evaluator: Evaluator, path: Path, ids: list[str], make: Callable[[], list[np.ndarray]]) -> Inputs:
    """Returns the metric inputs of motions, from the cache or else from one feature pass."""
    if path.exists():
        return read_npz(path)
    extracted = evaluator.extract(Motions(ids, make()))
    features = extracted.rows.get("generated")
    inputs: Inputs = {} if features is None else {"features": features.double().numpy()}
    for name, metric in make_metrics(evaluator.metrics).items():
        if type(metric) in TOTALS:
            inputs[name] = np.array([_totals(metric, joints) for joints in extracted.joints])
        elif isinstance(metric, MeanOverMotions):
            inputs |= _values(name, metric, extracted)
        elif isinstance(metric, AttributeAccuracy):
            inputs["seen"] = np.array([json.dumps(read_attributes(x.numpy(), metric.fps)) for x in extracted.joints])
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as temporary:
        np.savez(temporary, allow_pickle=False, **inputs)
    return inputs


def _totals(metric: Metric, joints: Tensor) -> list[float]:
    """Returns the two states of a metric, for one motion."""
    metric.reset()
    mask = torch.ones(1, len(joints), dtype=torch.bool)
    update_metrics({"": metric}, joints=joints[None], mask=mask, keys=torch.zeros(1, dtype=torch.long))
    states = [getattr(metric, state) for state in TOTALS[type(metric)]]
    return [float(sum(x.sum() for x in state) if isinstance(state, list) else state) for state in states]


def _higher_is_better(metrics: Mapping[str, Metric], name: str, part: str) -> bool | None:
    metric = metrics[name]
    other = metric.DIRECTIONS if isinstance(metric, MeanOverMotions) else {}
    return other.get(part, metric.higher_is_better)


def _values(name: str, metric: MeanOverMotions, extracted: Extracted) -> Inputs:
    """Returns the value, or 0, and whether it is defined, for each motion; nothing if no motion may have one."""
    if metric.required_fps not in (None, metric.fps):
        return {}
    for i, joints in enumerate(extracted.joints):
        rows = {row: extracted.rows[row][i : i + 1] for row in ("keys", "contacts") if row in extracted.rows}
        rows |= {"contacts": rows["contacts"][0][None]} if "contacts" in rows else {}
        update_metrics({name: metric}, joints=joints[None], mask=torch.ones(1, len(joints), dtype=torch.bool), **rows)
    values, defined = (torch.cat(getattr(metric, state)).double().numpy() for state in ("values", "defined"))
    parts = zip(metric.NAMES, values.T, defined.T, strict=True)
    return {f"{name}/{part}": np.stack([value, weight], 1) for part, value, weight in parts if weight.any()}


class _Measure:
    """Values of metrics, without resampling and in each bootstrap resample of motions.

    Intervals come from cached inputs: values of single motions or pairs are weighted by how often a resample draws the
    motion, so candidates of retrieval are not resampled, and FID is computed again. Retrieval and diversity are means
    over all pools and pairs that a protocol may draw, not of one draw.
    """

    def __init__(
        self, evaluator: Evaluator, inputs: Mapping[str, Inputs], texts: Sequence[Text], draws: np.random.Generator,
        resamples: int,
    ):  # fmt: skip
        self.metrics, self.extractor, self.inputs = make_metrics(evaluator.metrics), evaluator.extractor, inputs
        count = len(next(iter(inputs[BASE].values())))
        resampled = draws.multinomial(count, np.full(count, 1 / count), resamples)
        self.weights = np.concatenate([np.ones((1, count), int), resampled])
        self.reasons: dict[str, str] = {} if self.extractor else {"extractor": "metrics that need features"}
        self.encoded: dict[str, Tensor] = {}
        self.of_base: dict[str, np.ndarray] = {}
        self.real_texts = texts

    def __call__(self, inputs: Inputs, texts: Sequence[Text]) -> dict[str, np.ndarray]:
        """Returns the values (1 + R,) of each metric."""
        values = {name: self._ratio(pair) for name, pair in self._pairs(inputs, texts).items()}
        for name, metric in self.metrics.items():
            if "features" in inputs and isinstance(metric, FrechetMotionDistance | Diversity):
                base = inputs is self.inputs[BASE]  # as it is for changed captions
                values[name] = self.of_base[name] if base and name in self.of_base else self._of_set(metric, inputs)
                self.of_base |= {name: values[name]} if base else {}
        order = list(self.metrics)
        return dict(sorted(values.items(), key=lambda item: order.index(item[0].partition("/")[0])))

    def scores(self, inputs: Inputs, texts: Sequence[Text]) -> dict[str, np.ndarray]:
        """Returns the values (N,) of single pairs, by metric."""
        return {name: pair[:, 0] for name, pair in self._pairs(inputs, texts).items()}

    def _ratio(self, pair: np.ndarray) -> np.ndarray:
        weights = self.weights[:, : len(pair)]
        with np.errstate(invalid="ignore"):
            return weights @ pair[:, 0] / (weights @ pair[:, 1])

    def _of_set(self, metric: Metric, inputs: Inputs) -> np.ndarray:
        """Returns the values (1 + R,) of a metric of a set."""
        x, real = (torch.from_numpy(group["features"]) for group in (inputs, self.inputs[REAL]))
        weights = self.weights[:, : len(x)]
        if isinstance(metric, Diversity):
            return ((weights @ _distances(x, x).numpy()) * weights).sum(1) / weights.sum(1) ** 2
        repeats = [(torch.from_numpy(w[: len(x)]), torch.from_numpy(w)) for w in self.weights]
        drawn = ((x.repeat_interleave(a, 0), real.repeat_interleave(b, 0)) for a, b in repeats)
        return np.array([frechet_distance(*sets).item() for sets in drawn])

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
            if isinstance(metric, alignment.TextsForMotion):
                first = {text.caption: i for i, text in reversed(list(enumerate(texts)))}
                column = {caption: number for number, caption in enumerate(first)}
                own = torch.tensor([column[text.caption] for text in texts])
                values |= self._top(name, metric, _distances(motion, text[list(first.values())]), own)
            elif isinstance(metric, alignment.MotionsForText):
                pair = unit if metric.normalize else (motion, text)
                values |= self._top(name, metric, _distances(pair[1], pair[0]), torch.arange(len(motion)))
            elif isinstance(metric, alignment.MultimodalDistance):
                pair = unit if metric.normalize else (motion, text)
                values[name] = torch.linalg.vector_norm(pair[0] - pair[1], dim=-1)
            elif isinstance(metric, alignment.MotionCLIPScore):
                values[name] = (unit[0] * unit[1]).sum(1)
            elif isinstance(metric, alignment.MutualInformationDivergence):
                real, real_text = torch.from_numpy(self.inputs["as stored"]["features"]), self._encoded(self.real_texts)
                if len(real) > real.shape[1] + real_text.shape[1]:
                    pair = (real, real_text, motion, text)
                    values[name] = alignment.pointwise_mutual_information(*pair, metric.eps)
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

    "auc" is the probability that a pair that shows every requested attribute has a better score than one that does not,
    among real motions and all perturbations of the meaning at their strongest grade; "correlation" is Spearman's, of
    the values of both metrics over all perturbations and grades.
    """
    if TRUTH not in scores[0]:
        return {}
    right = np.concatenate([of_set[TRUTH] for of_set in scores]) > 0
    grades = [grade["values"] for perturbation in perturbations for grade in perturbation["grades"]]
    agreement = {}
    for name in scores[0]:
        if name.endswith("/top1") or name in ("mm_dist", "mclip_score", "mid"):
            score = np.concatenate([of_set[name] for of_set in scores]) * (-1 if name == "mm_dist" else 1)
            ranks, count = rankdata(score)[right], int(right.sum())
            auc = (ranks.sum() - count * (count + 1) / 2) / (count * (len(right) - count))
            both = np.array([(grade[name][0], grade[TRUTH][0]) for grade in grades if grade[name][0] is not None])
            correlation = np.corrcoef(rankdata(both, axis=0).T)[0, 1]
            agreement[name] = {"auc": float(auc), "correlation": float(correlation)}
    return agreement
