"""Values of the metrics of evaluations, as recorded."""

import inspect
import json
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter1d
from support.recorded import (
    Case,
    bodies,
    cases_of,
    check,
    combinations,
    outcome,
    record,
    some_bodies,
)
from torch import Tensor

from evaluators import metrics as metrics_package
from evaluators.metrics import (
    accuracy,
    alignment,
    checks,
    claims,
    distribution,
    diversity,
    inputs_of,
    make_metrics,
    memorization,
    physics,
    published_physics,
    reconstruction,
    required_inputs,
    retrieval,
    samples,
    update_metrics,
)
from evaluators.metrics import attributes as attribute_rules
from flame_mdm.representations.skeleton import KIT21, SMPL22
from flame_mdm.seeds import key

NAME = "evaluators"
FEATURES = 5
LENGTHS = (60, 41, 2, 1, 23, 4, 3, 37)
ENCODER = {
    "_target_": "flame_mdm.conditions.tokens.LearnedTokens",
    **{"features": 6, "buckets": 31, "heads": 3},
}
MODULES = (
    accuracy, alignment, attribute_rules, claims, distribution, diversity, memorization, physics,
    published_physics, reconstruction, retrieval,
)  # fmt: skip


@cache
def features(count: int = 70, others: int = 83, seed: int = 0) -> dict[str, Any]:
    """Features of generated motions, their texts and real motions, in no order of the keys."""
    rng = np.random.default_rng(seed)
    generated = torch.from_numpy(rng.normal(0.3, 1.2, (count, FEATURES)))
    text = generated + torch.from_numpy(rng.normal(0, 0.9, (count, FEATURES)))
    real = torch.from_numpy(rng.normal(0, 1, (others, FEATURES)) * np.linspace(0.5, 2, FEATURES))
    sentences = [f"A person {word}s." for word in ("walk", "jump", "turn", "wave", "kick", "bow")]
    captions = [
        f"{sentences[number % 6]}" if number % 3 else f"take {number} of a walk"
        for number in range(count)
    ]
    captions = [text.upper() if number % 4 == 0 else text for number, text in enumerate(captions)]
    return {
        "generated": generated,
        "text": text,
        "real": real,
        "captions": captions,
        "keys": torch.from_numpy(rng.permutation(count)) * 3 - 7,
        "real_keys": torch.from_numpy(rng.permutation(others)) * 5,
        "text_keys": torch.tensor([key(retrieval.plain_caption(caption)) for caption in captions]),
        "labels": torch.from_numpy(rng.integers(0, 4, count)),
        "logits": torch.from_numpy(rng.normal(size=(count, 4))),
    }


WEIGHTS = np.concatenate(
    [np.ones((1, 83), int), np.random.default_rng(5).multinomial(83, np.full(83, 1 / 83), 3)]
)


def of_features(metric: samples.SampleMetric, **changed: Any) -> Any:
    """All that a metric of features computes, from two updates."""
    inputs = features() | changed
    names = inputs_of(metric)
    if isinstance(metric, distribution.TwoSets):
        half = {name: inputs[name] for name in ("generated", "keys")}
        metric.update(**{name: rows[:31] for name, rows in half.items()})
        metric.update(**{name: rows[31:] for name, rows in half.items()})
        metric.update(real=inputs["real"], real_keys=inputs["real_keys"])
    else:
        count = len(inputs["keys"])
        given = {name: inputs[name][:count] for name in names if name in inputs}
        metric.update(**{name: rows[:31] for name, rows in given.items()})
        metric.update(**{name: rows[31:] for name, rows in given.items()})
    counts = [len(inputs[name]) for name in ("keys", "real")]
    rng = np.random.default_rng(3)
    drawn, real_drawn = (torch.from_numpy(rng.integers(0, n, n)) for n in counts)
    rows = inputs | {"paired": inputs["real"][:70], "paired_text": inputs["text"].roll(1, 0)}
    return {
        "value": outcome(metric.compute),
        "drawn": outcome(lambda: metric.drawn_value(drawn, real_drawn)),
        "per sample": outcome(lambda: metric.per_sample(rows)),
        "weighted": outcome(lambda: metric.weighted(rows, WEIGHTS)) if min(counts) > 9 else None,
    }


def distributions() -> Any:
    results: list[Any] = [of_features(distribution.FrechetMotionDistance())]
    results.append(of_features(distribution.PrecisionRecall()))
    for options in combinations(
        1, 8, subsets=(3, 7), subset_size=(11, 40, 70, 71), replace=(False, True), seed=(0, 9)
    ):
        metric = distribution.KernelMotionDistance(**options)
        results.append((options, of_features(metric)))
    results.append(of_features(distribution.KernelMotionDistance()))
    for few in (1, 2, 3, 4):
        small = {name: features()[name][:few] for name in ("real", "real_keys")}
        for kind in (distribution.FrechetMotionDistance, distribution.PrecisionRecall):
            results.append(of_features(kind(), **small))
    x = features()
    results.append(distribution.manifold_coverage(x["real"] * 0.7, x["generated"]))
    results.append(distribution.frechet_distance(x["real"][:4], x["generated"][:9]))
    results.append(distribution.polynomial_mmd2(x["real"][:14], x["generated"][:14]))
    return results


def diversities() -> Any:
    results: list[Any] = []
    for options in combinations(2, 9, pairs=(4, 69, 70, 71), replace=(False, True), seed=(0, 4)):
        results.append((options, of_features(diversity.Diversity(**options))))
    one = {name: features()[name][:1] for name in ("generated", "keys")}
    results.append(of_features(diversity.Diversity(1, True), **one))
    groups = torch.from_numpy(np.random.default_rng(8).permutation(70)) % 7
    for options in combinations(3, 6, samples=(10, 9, 30), pairs=(3, 10), seed=(0, 2)):
        metric = diversity.TextMultimodality(**options)
        results.append((options, of_features(metric, groups=groups)))
    results.append(of_features(diversity.TextMultimodality(), groups=groups))
    for number in (5, 10, 7):
        metric = diversity.PairedMultimodality(number)
        results.append(of_features(metric, groups=groups % (35 // number)))
    results.append(of_features(diversity.PairedMultimodality(), groups=groups))
    for options in combinations(4, 3, pairs=(5, 20), seed=(0, 3)):
        results.append(of_features(diversity.ActionMultimodality(**options)))
    results.append(of_features(diversity.ActionMultimodality()))
    lone = features()["labels"].clone()
    lone[11] = 8
    results.append(of_features(diversity.ActionMultimodality(), labels=lone))
    results.append(of_features(accuracy.ActionAccuracy()))
    x = features()
    results.append(diversity.pair_distance(x["generated"], x["text"]))
    results.append(diversity.distances(x["generated"], x["real"]))
    results.append(diversity._random_pairs(9, 4, False, 3))
    results.append(diversity._random_pairs(9, 14, True, 3))
    return results


def variances_of_joints() -> Any:
    results = []
    for lengths, count in (
        ((30,) * 6, 3),
        ((30,) * 3 + (24,) * 3, 3),
        ((30, 24) * 3, 3),
        ((30,) * 6, 4),
    ):
        joints, mask = padded(lengths)
        metric = diversity.JointVariance(count)
        groups, keys = torch.tensor([4, 4, 4, 1, 1, 1]), torch.tensor([5, 2, 9, 0, 3, 8])
        metric.update(joints[:4], mask[:4], groups[:4], keys[:4])
        metric.update(joints[4:], mask[4:], groups[4:], keys[4:])
        results.append(outcome(metric.compute))
    return results


def alignments() -> Any:
    results: list[Any] = []
    distinct = {"text_keys": torch.arange(70).flip(0) // 2}
    for pool in (32, 7, 26, 35, 36, 70, 71):
        for seed in (0, 6):
            metric = alignment.TextsForMotion(pool, seed)
            results.append(of_features(metric, **distinct if pool > 26 else {}))
            for normalize in (False, True):
                results.append(of_features(alignment.MotionsForText(pool, seed, normalize)))
    results.append(of_features(alignment.MotionsForText()))
    results.append(of_features(alignment.TextsForMotion(), **distinct))
    results += [of_features(alignment.MultimodalDistance(option)) for option in (False, True)]
    results.append(of_features(alignment.MultimodalDistance()))
    results.append(of_features(alignment.MotionCLIPScore()))
    paired = {"real": features()["real"][:70]}
    for eps in (5e-4, 0.0, 0.3):
        results.append(of_features(alignment.MutualInformationDivergence(eps), **paired))
    results.append(of_features(alignment.MutualInformationDivergence(), **paired))
    x = features()
    fitted = [x["real"], x["real"].roll(1, 1).square(), x["generated"], x["text"]]
    results.append(alignment.pointwise_mutual_information(*fitted, eps=1e-3))
    for few in (10, 11, 12):
        inputs = {name: features()[name][:few] for name in ("generated", "text", "keys", "real")}
        result = of_features(alignment.MutualInformationDivergence(), **inputs)
        results.append(result["value"])  # the covariance of resamples is singular
    return results


def ranks_with_ties() -> Any:
    """Coarse features, so that many candidates are equally near."""
    rng = np.random.default_rng(4)
    queries, candidates = (torch.from_numpy(rng.integers(0, 3, (n, 2)) * 1.0) for n in (37, 29))
    pools = torch.from_numpy(np.stack([rng.permutation(29)[:11] for _ in range(37)]))
    right = torch.from_numpy(rng.integers(0, 11, 37))
    results: list[Any] = [alignment.retrieval_ranks(queries, candidates, pools, right)]
    metric = alignment.MotionsForText(11)
    table = diversity.distances(queries, candidates)
    correct = torch.from_numpy(rng.integers(0, 29, 37))
    results.append(metric.in_random_pools(table, correct))
    results.append(outcome(lambda: alignment.MotionsForText(29).in_random_pools(table, correct)))
    results.append(outcome(lambda: alignment.MotionsForText(30).in_random_pools(table, correct)))
    marks = torch.from_numpy(rng.random((37, 29)) < 0.2)
    marks[torch.arange(37), correct] = True
    results.append(retrieval.best_ranks(-table, marks))
    results.append(retrieval.multi_positive(-table, marks))
    results += [alignment.own_pools(count, 6, 2) for count in (6, 12, 17, 19)]
    square = -table[:29] + torch.eye(29) * 0.3
    results.append(retrieval.whole_set_retrieval(square))
    results.append(retrieval.whole_set_retrieval(square, (marks[:29] | marks[:29].T)))
    batches = torch.from_numpy(rng.permutation(28)).view(4, 7)
    results.append(retrieval.batched_retrieval(square, batches))
    meaning = torch.from_numpy(rng.normal(size=(31, 6)))
    meaning = meaning / meaning.norm(dim=1, keepdim=True)
    results.append(retrieval.dissimilar(meaning))
    return results


def retrieval_with_equal_captions() -> Any:
    results: list[Any] = []
    vague = torch.nn.functional.normalize(features()["text"], dim=-1)
    for options in combinations(5, 6, pool=(32, 7, 70, 71), seed=(0, 3), normalize=(False, True)):
        metric = retrieval.MultiPositiveRPrecision(**options)
        results.append((options, of_features(metric)))
        if options["pool"] <= 70:
            x = features()
            results.append(metric.value(x["generated"], x["text"], x["text_keys"], vague))
    results.append(of_features(retrieval.MultiPositiveRPrecision()))
    for seed in (0, 3):
        metric = retrieval.TMRRetrieval(seed=seed)
        results.append(of_features(metric))
        x = features()
        results.append(metric.value(x["generated"], x["text"], x["text_keys"], vague))
        few = [rows[:31] for rows in (x["generated"], x["text"], x["text_keys"], vague)]
        results.append(metric.value(*few))
        metric.ids = x["keys"][[3, 30, 12, 7]]
        results.append(metric.compute())
    captions = ("  A Person's  walk, (slow)!\n", "a_b-c. D", "", "Ünder 3.5 m")
    results.append([retrieval.plain_caption(caption) for caption in captions])
    empty = retrieval.TMRRetrieval()
    empty.update(torch.zeros(0, 5), torch.zeros(0, 5), [], torch.zeros(0, dtype=torch.long))
    results.append(empty.compute())
    return results


def retrieval_with_encoded_captions() -> Any:
    results: list[Any] = []
    torch.manual_seed(0)
    results += [retrieval.embedding(json.dumps(ENCODER, sort_keys=True), text) for text in CAPTIONS]
    listed: list[Any] = [
        retrieval.MultiPositiveRPrecision(ENCODER, 7, 2),
        retrieval.MultiPositiveRPrecision(ENCODER, 7, 2, True),
        retrieval.TMRRetrieval(ENCODER),
    ]
    for result in map(of_features, listed):
        # With random weights, captions are on the limit of similarity
        results += [
            {name: number for name, number in result[part].items() if "dissimilar" not in name}
            if isinstance(result[part], dict)
            else result[part]
            for part in ("value", "drawn", "per sample", "weighted")
        ]
    with TemporaryDirectory() as folder:
        path = Path(folder) / "ids.txt"
        path.write_text(
            "".join(f"motion {number}\n" for number in (3, 9, 11, 80)).replace(" ", "-")
        )
        ids = torch.tensor([key(f"motion-{number}") for number in range(70)])
        results.append(of_features(retrieval.TMRRetrieval(ids=str(path)), keys=ids))
        results.append(of_features(retrieval.TMRRetrieval(ENCODER, 1, str(path)), keys=ids))
        path.write_text("\n")
        message = outcome(lambda: retrieval.TMRRetrieval(ids=str(path)))
        results.append(str(message).replace(folder, ""))
    return results


def padded(
    lengths: Sequence[int] = LENGTHS, fps: float = 20.0, seed: int = 0, offset: float = -0.01
) -> tuple[Tensor, Tensor]:
    """Motions of different lengths at different heights, with padding that is not zero."""
    rng = np.random.default_rng(seed)
    motions = list(some_bodies(len(lengths), fps, seed).values())
    longest = max(lengths) + 2
    joints = np.full((len(lengths), longest, 22, 3), 9.0)
    mask = np.zeros((len(lengths), longest), bool)
    for row, (motion, length) in enumerate(zip(motions, lengths, strict=True)):
        cut = np.resize(motion, (longest, 22, 3))[:length].copy()
        cut[..., 1] += offset * (row - 2)
        joints[row, :length] = cut + rng.normal(0, 0.004, cut.shape)
        mask[row, :length] = True
    return torch.from_numpy(joints), torch.from_numpy(mask)


KEYS = torch.tensor([30, 2, 17, 5, 11, 8, 23, 1])


def of_joints(metric: Any, seed: int = 0, fps: float = 20.0, **more: Any) -> Any:
    """All that a metric of joints computes, from two updates, and its readings."""
    joints, mask = padded(seed=seed, fps=fps)
    inputs: dict[str, Any] = {"joints": joints, "mask": mask, "keys": KEYS} | more
    metric.update(**{name: rows[:3] for name, rows in inputs.items()})
    metric.update(**{name: rows[3:] for name, rows in inputs.items()})
    value = outcome(metric.compute)
    drawn = torch.tensor([3, 3, 0, 7, 1, 4, 4, 2])
    results = {"value": value, "drawn": outcome(lambda: metric.drawn_value(drawn, drawn))}
    motions = {"joints": [x[real] for x, real in zip(joints, mask, strict=True)], "keys": KEYS}
    if "contacts" in more:
        pairs = zip(more["contacts"], mask, strict=True)
        motions["contacts"] = [contacts[real] for contacts, real in pairs]
    readings = metric.readings(motions)
    results["readings"] = readings
    if not isinstance(metric, claims.ClaimAccuracy | attribute_rules.AttributeAccuracy):
        results["per sample"] = metric.per_sample(readings)
        results["weighted"] = metric.weighted(readings, WEIGHTS[:, :8])
    return results


def physical_metrics() -> Any:
    results: list[Any] = []
    for seed, fps in ((0, 20.0), (1, 12.5), (2, 30.0)):
        listed: list[Any] = [
            physics.FootSkating(fps), physics.FootSkating(fps, (7, 11)), physics.Penetration(),
            physics.Floating(), physics.Jitter(fps), physics.StaticShare(fps),
        ]  # fmt: skip
        results += [of_joints(metric, seed, fps) for metric in listed]
    return results


def static_and_low_motions_beside_limits() -> Any:
    results: list[Any] = []
    for step in (0.0014, 0.0015, 0.0016, 0.024, 0.025, 0.026):
        for height in (0.004, 0.005, 0.006, 0.049, 0.05, 0.051, -0.004, -0.006):
            motion = torch.full((6, 22, 3), 0.5, dtype=torch.float64)
            motion[:, :, 0] = torch.arange(6)[:, None] * step
            motion[:, 10:12, 1] = height
            motion[3, 11, 1] = height + 0.2
            row = [
                metric.measure(motion)
                for metric in (
                    physics.FootSkating(20), physics.Penetration(), physics.Floating(),
                    physics.StaticShare(20),
                )
            ]  # fmt: skip
            results.append(torch.cat([x.double() for x in row]))
    return torch.stack(results)


def contacts_of(seed: int) -> Tensor:
    rng = np.random.default_rng(seed)
    return torch.from_numpy(rng.random((len(LENGTHS), max(LENGTHS) + 2, 4)) < 0.4)


def published_physical_metrics() -> Any:
    results: list[Any] = []
    for seed, fps in ((0, 20.0), (1, 12.5), (2, 30.0), (3, 20.0)):
        listed: list[Any] = [
            published_physics.MBenchQuality(fps), published_physics.MBenchQuality(fps, (8, 10)),
            published_physics.PhysicalFootContact(fps), published_physics.KimodoQuality(fps),
            published_physics.PhysicalFootContact(fps, (8, 11, 7, 10)),
        ]  # fmt: skip
        results += [of_joints(metric, seed, fps) for metric in listed]
        metric = published_physics.KimodoQuality(fps, (8, 11, 7, 10))
        results.append(of_joints(metric, seed, fps, contacts=contacts_of(seed)))
    return results


def swinging(seed: int) -> Tensor:
    """A body that moves while its feet swing in the air, stand and drag."""
    rng = np.random.default_rng(seed)
    frames = 40
    time = np.arange(frames)[:, None]
    motion = np.full((frames, 22, 3), 0.6)
    motion[..., 0] += np.cumsum(rng.choice([0.0, 0.0005, 0.02, 0.04], (frames, 1)), 0)
    for toe in (10, 11):
        phase = rng.uniform(0, 6)
        swing = 0.1 * np.sin(time * rng.uniform(0.5, 1.5) + phase)
        motion[:, toe] += np.concatenate([swing, 0.3 * swing, swing**2], 1)
        motion[:, toe, 1] *= np.repeat(rng.choice([0.01, 1.0, 1.0], 8), 5)
        motion[:, toe] *= np.repeat(rng.choice([0.0, 1.0, 1.0], 8), 5)[:, None] * 0.5 + 0.5
    return torch.from_numpy(motion)


def floating_of_mbench() -> Any:
    results = []
    for seed in range(12):
        motion = swinging(seed)
        feet = motion[:, [10, 11]]
        contact = published_physics.mbench_contact(feet)
        counts = published_physics.mbench_floating(motion, feet, contact)
        results.append((contact, counts, published_physics.MBenchQuality(20).measure(motion)))
        aloft = torch.from_numpy(np.random.default_rng(seed).random(50) < 0.7)
        results.append(published_physics._runs(aloft))
    results.append(published_physics._speed(motion[:1]))
    return results


def transitions() -> Any:
    results: list[Any] = []
    rng = np.random.default_rng(2)
    joints, mask = padded()
    starts = rng.integers(0, 50, (len(LENGTHS), 3))
    frames = np.arange(joints.shape[1])
    kept = np.zeros((len(LENGTHS), joints.shape[1], 22), bool)
    for row, (begin, end, middle) in enumerate(np.sort(starts, 1)):
        kept[row] = ((frames < begin) | (frames > end))[:, None]
        kept[row, middle:, 20] = True
    for fps in (20.0, 30.0, 12.5, 19.9999999):
        for window in (4, 7, 8, 24, 60):
            metric = published_physics.TransitionJerk(fps, window)
            results.append(of_edits(metric, joints, mask, kept=torch.from_numpy(kept)))
    curve = torch.tensor([0.1, 0.5, 0.2])
    results += [published_physics.peak_and_area(curve, real) for real in (None, 0.3)]
    return results


def of_edits(metric: Any, joints: Tensor, mask: Tensor, **more: Any) -> Any:
    inputs: dict[str, Any] = {"joints": joints, "mask": mask, "keys": KEYS} | more

    def measured() -> Any:
        metric.update(**{name: rows[:3] for name, rows in inputs.items()})
        metric.update(**{name: rows[3:] for name, rows in inputs.items()})
        return metric.compute()

    drawn = torch.tensor([6, 6, 0, 4, 1, 1, 3, 7])
    return outcome(measured), outcome(lambda: metric.drawn_value(drawn, torch.arange(1)))


def errors_of_edits() -> Any:
    results: list[Any] = []
    joints, mask = padded()
    rng = np.random.default_rng(6)
    other, other_mask = padded((60, 50, 2, 4, 20, 9, 3, 30), seed=1)
    near = joints + torch.from_numpy(rng.normal(0, 0.06, joints.shape))
    for share in (0.0, 0.3, 0.9, 1.0):
        kept = torch.from_numpy(rng.random((len(LENGTHS), joints.shape[1], 22)) < share)
        kept[:, 5:9], kept[3:, -20:] = True, False
        kept[2] = False
        constraints = published_physics.KimodoConstraints()
        results.append(of_edits(constraints, joints, mask, real_joints=near, kept=kept))
        for kind in (reconstruction.KeptDrift, reconstruction.DisplacementErrors):
            for real, real_mask in ((near, mask), (other, other_mask)):
                results.append(
                    of_edits(kind(), joints, mask, real_joints=real, real_mask=real_mask, kept=kept)
                )
    displacement = reconstruction.DisplacementErrors()
    results.append(of_edits(displacement, joints, mask, real_joints=near, real_mask=mask))
    everything = torch.ones_like(kept)
    for kind in (reconstruction.KeptDrift, reconstruction.DisplacementErrors):
        for kept in (everything, ~everything):
            results.append(
                of_edits(kind(), joints, mask, real_joints=near, real_mask=mask, kept=kept)
            )
    nothing = published_physics.KimodoConstraints()
    results.append(of_edits(nothing, joints, mask, real_joints=near, kept=~everything))
    return results


def kit_motions(seed: int, lengths: Sequence[int]) -> tuple[Tensor, Tensor]:
    """Bodies of 21 joints that wander and turn."""
    rng = np.random.default_rng(seed)
    longest = max(lengths) + 1
    joints = rng.normal([0, 0.9, 0], 0.3, (len(lengths), 1, 21, 3))
    joints = joints + np.cumsum(rng.normal(0, 0.02, (len(lengths), longest, 21, 3)), 1)
    mask = np.arange(longest) < np.array(lengths)[:, None]
    joints[~mask] = 7
    return torch.from_numpy(joints), torch.from_numpy(mask)


def errors_of_positions() -> Any:
    results: list[Any] = []
    lengths = (9, 12, 5, 7, 2, 12, 8, 6)
    groups = torch.tensor([3, 1, 3, 1, 3, 1, 3, 1])
    for seed, real_lengths in ((0, lengths), (1, (12, 9, 5, 8, 3, 4, 8, 2))):
        joints, mask = kit_motions(seed, lengths)
        real, real_mask = kit_motions(seed + 5, real_lengths)
        inputs = {"real_joints": real, "real_mask": real_mask}
        for samples_per_text in (1, 4, 3):
            more = inputs | {"groups": groups}
            temos = reconstruction.TemosPositionErrors(samples_per_text)
            results.append(of_edits(temos, joints, mask, **more))
            flame = reconstruction.FlamePositionErrors(KIT21.parents, samples_per_text)
            results.append((flame.units, of_edits(flame, joints, mask, **more)))
        results.append(of_edits(reconstruction.TemosPositionErrors(), joints, mask, **inputs))
        for factor in (2, 8):
            metric = reconstruction.TemosPositionErrors(upsampling=factor)
            results.append(of_edits(metric, joints, mask, **inputs))
            references = [motion[:8] * 1.1 for motion in real]
            again = reconstruction.TemosPositionErrors(4, factor)
            more = inputs | {"references": references, "groups": groups}
            results.append(of_edits(again, joints, mask, **more))
        results.append(reconstruction.temos_parts(joints[0] * 640))
    single, single_mask = kit_motions(0, (1,) * 8)
    short = {"real_joints": single, "real_mask": single_mask}
    results.append(of_edits(reconstruction.TemosPositionErrors(), single, single_mask, **short))
    body, body_mask = padded()
    bones = {"real_joints": body.roll(1, 0), "real_mask": body_mask.roll(1, 0)}
    results.append(of_edits(reconstruction.TemosPositionErrors(), body, body_mask, **bones))
    return results


def memorized_motions() -> Any:
    results: list[Any] = []
    facing = SMPL22.facing
    motions = list(some_bodies(9, 20.0, 4).values())
    frames = [memorization.poses(torch.from_numpy(motion), facing) for motion in motions]
    lengths = (60, 13, 41, 8, 60, 33, 5, 60, 22)
    packed = [x[:length] for x, length in zip(frames, lengths, strict=True)]
    vectors = features()["real"][:9]
    queries = [torch.from_numpy(x) for x in some_bodies(6, 20.0, 5).values()]
    queries = [queries[0][:40], queries[1][3:12], queries[2], queries[3][:1], queries[4][:6]]
    queries += [torch.from_numpy(motions[2][4:30]) + 1.5, torch.from_numpy(motions[5][3:19])]
    queries.append(torch.cat([queries[2]] * 2)[:61])
    near = features()["generated"][:8]
    for used in (vectors, None):
        training = memorization.TrainingMotions(
            torch.cat(packed), torch.tensor(lengths), used, facing
        )
        results += training.nearest(queries, near).tolist()
        results += training.nearest(queries, None).tolist()
    whole = memorization.TrainingMotions(frames[0][:9], torch.tensor([9]), None, facing)
    results.append(whole.nearest(queries, None).tolist())
    results += frames[:3]
    table = torch.from_numpy(np.random.default_rng(1).gamma(2, 1, (8, 2)))
    real = torch.from_numpy(np.random.default_rng(2).gamma(2.5, 1, (8, 2)))
    for width in (1, 2):
        for factor in (1.0, 0.2, 3.0):
            metric = memorization.NearestTraining()
            nearest = table[:, :width] * factor
            metric.update(nearest=nearest, real_nearest=real[:, :width], keys=KEYS)
            results.append(metric.compute())
    return results


def declared_properties() -> Any:
    """Declarations of every metric about its values and inputs."""
    results = {}
    for module in MODULES:
        for name, kind in inspect.getmembers(module, inspect.isclass):
            if kind.__module__ != module.__name__ or not issubclass(kind, samples.SampleMetric):
                continue
            if name in (
                "PublishedPhysics",
                "RPrecision",
                "CaptionMetric",
                "PositionErrors",
                "EditErrors",
            ):
                continue
            arguments = {
                "fps": 20, "parents": (-1, 0), "window": 8, "pairs": 3, "replace": True,
            }  # fmt: skip
            needed = [
                parameter.name
                for parameter in inspect.signature(kind).parameters.values()
                if parameter.default is parameter.empty
            ]
            metric: samples.SampleMetric = kind(**{option: arguments[option] for option in needed})
            parts = [*metric.names, "", "other"]
            results[name] = {
                "options": str(inspect.signature(kind)),
                "units": [metric.unit_of(part) for part in parts],
                "directions": [metric.direction_of(part) for part in parts],
                "names": metric.names,
                "about": [
                    metric.summary, metric.audited, metric.sees_meaning, metric.exact,
                    metric.depends_on_count, metric.states, getattr(metric, "parts", None),
                ],
                "inputs": inputs_of(metric),
                "required": required_inputs(metric),
                "nothing": metric.nothing,
                "empty": outcome(metric.compute),
                "defaults": {
                    option: getattr(metric, option, None)
                    for option in inspect.signature(kind).parameters
                },
            }  # fmt: skip
    return results


def refusals_of_metrics() -> Any:
    x = features()
    results: list[Any] = []
    metric = alignment.MultimodalDistance()
    uneven = {"generated": x["generated"][:3], "text": x["text"][:3], "keys": x["keys"][:2]}
    results.append(outcome(lambda: metric.update(**uneven)))
    twice = alignment.MultimodalDistance()
    for _ in range(2):
        twice.update(generated=x["generated"][:5], text=x["text"][:5], keys=x["keys"][:5])
    results.append(outcome(twice.compute))
    broken = x["generated"].clone()
    broken[3, 1], broken[9, 0], broken[9, 2] = torch.nan, torch.inf, torch.nan
    results.append(of_features(alignment.MotionCLIPScore(), generated=broken)["value"])
    joints, mask = padded()
    joints[4, 2, 3, 0] = torch.nan
    joints[0, 1, 0, 1] = torch.inf
    results.append(
        outcome(lambda: physics.Penetration().update(joints, mask, torch.arange(len(joints))))
    )
    results.append(outcome(lambda: physics.Jitter(20).by_group(torch.tensor([1, 1, 2, 2, 2]), 2)))
    configs = {
        "a": {"_target_": "evaluators.metrics.physics.Jitter", "fps": 20.0},
        "b": {"_target_": "evaluators.metrics.diversity.Diversity", "pairs": 3, "replace": True},
    }
    listed = make_metrics(configs, seed=11, other=3)
    results.append(
        {name: (type(one).__name__, getattr(one, "seed", None)) for name, one in listed.items()}
    )
    results.append(
        outcome(lambda: update_metrics(listed, keys=x["keys"], generated=x["generated"]))
    )
    results.append(str(metrics_package.missing_input("c", twice, "text")))
    more = make_metrics({"b": configs["b"]}, seed=2)
    update_metrics(more, keys=x["keys"], generated=x["generated"], labels=x["labels"])
    results.append([metric.compute() for metric in more.values()])
    return results


def varied(fps: float, seed: int) -> dict[str, np.ndarray]:
    """All bodies, each moved with another amplitude, size and heading about another origin."""
    rng = np.random.default_rng(seed)
    motions = {}
    for name, motion in bodies(fps).items():
        angle, size = rng.uniform(-3.1, 3.1), rng.uniform(0.9, 1.1)
        middle = motion.mean(0, keepdims=True)
        moved = middle + rng.uniform(0.55, 1.35) * (motion - middle)
        turn = np.array(
            [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
        )
        motions[name] = size * moved @ turn.T + rng.normal(0, 2, 3) * [1, 0.01, 1]
    return motions


@cache
def seen_in(kind: str) -> dict[str, dict[str, Any]]:
    """The attributes that are read from bodies, by their names."""
    fps, motions = {
        "plain": (20.0, bodies(20.0)),
        "varied": (12.5, varied(12.5, 3)),
        "fast": (30.0, some_bodies(40, 30.0, 9)),
    }[kind]
    return {name: attribute_rules.read_all(motion, fps) for name, motion in motions.items()}


def brief(seen: Mapping[str, Any]) -> str:
    """The attributes of a motion and the results of its checks, in one line."""
    parts = [" ".join(map(str, value.values())) for value in seen.get("checks", {}).values()]
    shown = " ".join(str(seen[name]) for name in seen if name != "checks")
    return f"{shown} | {', '.join(parts)}"


def attributes_of_plain_bodies() -> Any:
    return {name: brief(seen) for name, seen in seen_in("plain").items()}


def attributes_of_varied_bodies() -> Any:
    return {name: brief(seen) for name, seen in seen_in("varied").items()}


def attributes_of_fast_bodies() -> Any:
    return {name: brief(seen) for name, seen in seen_in("fast").items()}


def attributes_of_growing_movements() -> Any:
    """Actions with amplitudes that pass the limits of their rules."""
    results = {}
    for name in ("slash", "squat", "raise", "turn", "kick", "punch", "lean", "limp"):
        motion = bodies().get(name, bodies()["wave"])
        middle = motion[:1]
        for amplitude in np.linspace(0.4, 1.5, 12):
            moved = middle + amplitude * (motion - middle)
            results[f"{name} {amplitude:.1f}"] = brief(attribute_rules.read_all(moved, 20.0))
    return results


def attributes_of_no_bodies() -> Any:
    motion = bodies()["walk"]
    inputs = {
        "short": motion[:19], "a second": motion[:20],
        "infinite": np.where(np.arange(60)[:, None, None] == 7, np.inf, motion),
        "large": motion * 1.9, "small": motion * 0.4, "mixed": motion[:, ::-1],
        "noise": motion + np.random.default_rng(0).normal(0, 0.03, motion.shape),
        "half noise": motion + np.random.default_rng(0).normal(0, 0.012, motion.shape),
        "floats": motion.astype(np.float32), "longer": np.concatenate([motion, motion]),
    }  # fmt: skip
    results = {}
    for name, joints in inputs.items():
        seen = attribute_rules.read_all(joints, 20.0)
        results[name] = (brief(seen), attribute_rules.read_attributes(joints, 20.0))
    return results


def bodies_of_changing_length() -> Any:
    """Decisions of `_is_a_body` as limbs grow, shrink, stretch and shake."""
    motion = bodies()["stand"] if "stand" in bodies() else bodies()["wave"]
    rng = np.random.default_rng(3)
    results = []
    for size in np.linspace(0.4, 1.9, 16):
        results.append(attribute_rules._is_a_body(motion * size, motion * size))
    for stretch in np.linspace(0.05, 0.9, 12):
        longer = motion * (1 + stretch * np.sin(np.arange(60) / 4))[:, None, None]
        results.append(attribute_rules._is_a_body(longer, longer))
    for shake in np.linspace(0.002, 0.03, 12):
        moved = motion + rng.normal(0, shake, motion.shape)
        results.append(attribute_rules._is_a_body(moved, motion))
    return [int(result) for result in results]


@cache
def views() -> list[checks.View]:
    motions = some_bodies(24, 20.0, 12) | some_bodies(8, 12.5, 13)
    return [
        checks.View.of(gaussian_filter1d(motion, 0.05 * fps, axis=0, mode="nearest"), fps)
        for (name, motion), fps in zip(motions.items(), [20.0] * 24 + [12.5] * 8, strict=False)
    ]


def views_of_bodies() -> Any:
    results = []
    for view in views():
        hand, shoulder = view.smooth[:, [20]], view.smooth[:, [17]]
        results.append(
            [
                view.forward, view.left, view.turned, view.floor, view.path(),
                view.ahead(hand, shoulder), view.aside(hand, shoulder),
                checks.tilt_of(view.smooth), checks._raised_hand(view),
                attribute_rules._nods(view.smooth, view.forward),
            ]
        )  # fmt: skip
    return results


def rises_of_signals() -> Any:
    rng = np.random.default_rng(1)
    results = []
    for number in range(20):
        signal = np.cumsum(rng.normal(0, 0.5, 80))
        low, high = np.sort(rng.choice(signal, 2))
        results.append(checks.count_rises(signal, high, low))
        results.append(checks.count_rises(np.round(signal), 1.0, 0.0))
        results.append(checks.count_rises(signal[: number % 3], 0.1, 0.0))
    return results


def requested_attributes() -> Any:
    """Requests that are right, wrong in one part, unread or without a rule."""
    rng = np.random.default_rng(2)
    results: dict[str, Any] = {}
    names = list(seen_in("plain"))
    everything = sorted({*attribute_rules.CHECKED, *attribute_rules.MORE, "walk", "kick", "wave"})
    for number, name in enumerate(names[::4]):
        seen = seen_in("plain")[name]
        plain = {part: seen[part] for part in seen if part != "checks"}
        requests = [plain, plain | {"side": "left"}, plain | {"count": 2}, plain | {"ends": 1}]
        requests += list(seen.get("checks", {}).values())
        requests.append({"action": str(rng.choice(everything)), "side": "right"})
        rights = [
            attribute_rules.right_attributes(seen, one) for one in requests if "action" in one
        ]
        results[f"{number}"] = [
            "".join("01"[value] for value in right.values()) for right in rights
        ]
    results["keys"] = list(attribute_rules.right_attributes({}, {"action": "walk", "count": 1}))
    results["undecided"] = attribute_rules.UNDECIDED
    return results


REQUESTED: list[dict[str, Any]] = [
    {"action": "walk", "speed": "slow"}, {"action": "wave", "side": "left"}, {"action": "jump"},
    {"action": "kick", "side": "right", "count": 2}, {"action": "knock", "side": "left"},
    {"action": "walk", "while": "wave"}, {"action": "beckon", "side": "right"},
    {"action": "turn", "direction": "left", "amount": "half"},
]  # fmt: skip


def accuracies_of_attributes() -> Any:
    results: list[Any] = []
    metric = attribute_rules.AttributeAccuracy(20.0)
    results.append(of_joints(metric, requested=REQUESTED))
    names = list(seen_in("plain"))[::7][:32]
    motions = {"joints": [torch.from_numpy(bodies()[name]) for name in names]}
    readings = metric.readings(motions)
    requested = [{"action": name.partition(",")[0]} | {"side": "left"} for name in names]
    shown = {"seen": readings["seen"], "requested": requested}
    results += [metric.per_sample(shown), metric.weighted(shown, WEIGHTS[:, :32])]
    return results


CONTENTS = (
    "walk-turn-left", "walk-turn-right", "walk-left", "wave-left-hand", "walk", "raise-up-right-hand",
    "run", "walk-right",
)  # fmt: skip


def sides_of_bodies() -> Any:
    results: list[Any] = []
    for content in CONTENTS:
        sides = [
            attribute_rules.read_side(motion, content, fps)
            for fps in (20.0, 12.5)
            for motion in some_bodies(24, fps, 6).values()
        ]
        results.append("".join(side[0] for side in sides))
    joints, mask = padded((60, 41, 20, 30, 23, 50, 33, 37))
    for asked in (("left",) * 8, ("right", "left", "both", "", "right", "left", "right", "left")):
        metric = attribute_rules.SideAccuracy(20.0)
        sides = list(zip(CONTENTS, asked, strict=True))
        results.append(of_edits(metric, joints, mask, sides=sides))
    return results


CAPTIONS = [
    "a person walks forward slowly and then waves with the left hand",
    "someone jumps three times", "a man turns left by 90 degrees", "nothing that can be said",
    "a person kicks with the right foot twice", "the figure sits down, then stands up",
    "a woman waves both hands", "a person walks in a circle counterclockwise",
]  # fmt: skip


def accuracies_of_claims() -> Any:
    results: list[Any] = []
    for fps in (20.0, 12.5):
        metric = claims.ClaimAccuracy(fps)
        results.append(of_joints(metric, fps=fps, captions=CAPTIONS))
        names = list(some_bodies(24, fps, 6))
        captions = [
            f"a person {name.partition(',')[0]}s twice with the left hand" for name in names
        ]
        motions = [torch.from_numpy(some_bodies(24, fps, 6)[name]) for name in names]
        motions[1] = torch.cat([motions[1]] * 4)
        motions[2], motions[3] = motions[2][: round(0.6 * fps)], motions[3][: round(0.6 * fps) - 1]
        readings = metric.readings({"joints": motions})
        rows = readings | {"captions": captions}
        results += [readings, metric.per_sample(rows), metric.weighted(rows, WEIGHTS[:, :24])]
    other = claims.ClaimAccuracy(20.0)
    results.append(other.judged(np.zeros((40, 21, 3)), CAPTIONS[0]))
    walk = bodies()["walk"]
    results.append([len(other.judged(walk[:frames], CAPTIONS[0])) for frames in range(8, 16)])
    results.append([claims.claims_of(caption) for caption in CAPTIONS])
    return results


CASES = cases_of(globals())


@pytest.mark.parametrize("case", CASES)
def test_results_are_as_recorded(case: Case):
    check(NAME, case)


if __name__ == "__main__":
    record(NAME, CASES)
