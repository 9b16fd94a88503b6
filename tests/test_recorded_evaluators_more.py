"""Values of evaluations, audits and feature extractors, as recorded."""

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from support.recorded import Case, cases_of, check, combinations, outcome, record, some_bodies
from torch import Tensor, nn

from evaluators import perturbations
from evaluators.audit import (
    _agreement,
    _differences,
    _inputs,
    _interval,
    _Measure,
    _measured,
    audited_metrics,
)
from evaluators.encoding import encode
from evaluators.evaluation import Evaluation
from evaluators.evaluation_request import EvaluationRequest
from evaluators.evaluator import Evaluator, Motions, _chunk, keys_of
from evaluators.extractors import (
    Extractor,
    action_gru,
    mardm,
    motion_clip,
    stgcn,
    t2m,
    t2m_training,
)
from evaluators.extractors.motion_clip_calibrated import calibration_error, noisy_copies
from evaluators.metrics import make_metrics
from evaluators.near_misses import near_misses
from evaluators.perturbations import BASE, REAL, STORED
from evaluators.plan import set_bones
from evaluators.protocol import (
    DrawnClip,
    Protocol,
    _value_names,
    default_protocol,
    load_protocol,
    protocol_config,
    protocol_names,
)
from evaluators.results import Outcome, Scores, _cell, _intervals, mean_ci, mean_cost
from evaluators.scene import Scene, text_of
from evaluators.sources import (
    Baseline,
    Generator,
    SampleFolder,
    Samples,
    read_samples,
    real_motions,
)
from flame_mdm.batch import MotionBatch
from flame_mdm.data.crops import Fixed, Units, Whole
from flame_mdm.data.store import Entry
from flame_mdm.records import Cost, Value
from flame_mdm.representations.humanml import HumanML
from flame_mdm.representations.rot6d import Rot6D
from flame_mdm.representations.smpl import SMPL
from flame_mdm.sampler_options import SamplerOptions
from flame_mdm.schemas import check_shape
from flame_mdm.seeds import key

NAME = "evaluators_more"


class Tiny(Extractor):
    """A linear map of mean features and joints, and a vector per caption."""

    sha256 = "f00d" * 16

    def check(self, representation: Any, dataset: str) -> None: ...

    def motions(self, features: Tensor, joints: Tensor, mask: Tensor) -> dict[str, Tensor]:
        generator = torch.Generator().manual_seed(0)
        mean = (features * mask[..., None]).sum(1) / mask.sum(1, keepdim=True)
        weight = torch.randn(features.shape[-1], 3, generator=generator)
        extra = joints.square().sum((1, 2, 3))[:, None] / mask.sum(1, keepdim=True)
        return {"features": mean @ weight + 0.1 * extra, "logits": mean[:, :2] * 9}

    def texts(self, captions: Sequence[str], tokens: Sequence[Any]) -> Tensor:
        rows = [
            torch.randn(3, generator=torch.Generator().manual_seed(key(text) % 2**40))
            for text in captions
        ]
        return torch.stack(rows)


class OwnReference(Tiny):
    """An extractor with real motions of its own."""

    def reference(self) -> Tensor:
        return torch.randn(23, 3, generator=torch.Generator().manual_seed(4))


LENGTHS = (60, 58, 45, 41, 52, 44, 59, 47)
CAPTIONS = [
    ["walks forward slowly", "a slow walk"], ["walks forward quickly"], ["walks backward"],
    ["waves the left hand"], ["waves the right hand", "a wave"], ["kicks twice"], ["kicks once"],
    ["jumps three times"],
]  # fmt: skip
ATTRIBUTES: list[dict[str, Any]] = [
    {"action": "walk", "direction": "forward", "speed": "slow"},
    {"action": "walk", "direction": "forward", "speed": "fast"},
    {"action": "walk", "direction": "backward", "speed": "slow"},
    {"action": "wave", "side": "left", "tokens": [["waves/VERB", "hand/NOUN"]]},
    {"action": "wave", "side": "right", "style": 3},
    {"action": "kick", "count": 2, "side": "left"}, {"action": "kick", "count": 1, "side": "left"},
    {"action": "jump", "count": 3, "ends": "sit"},
]  # fmt: skip


class Data:
    """A split of encoded motions with captions and attributes."""

    def __init__(self, seed: int, count: int, crop: Any, split: str = "test", **changed: Any):
        self.representation = HumanML()
        motions = list(some_bodies(count, 20.0, seed).values())
        self.motions, self.clips = {}, []
        self.crop, self.advice = crop, " Or prepare more."
        for number, motion in enumerate(motions):
            cut = torch.from_numpy(motion[: LENGTHS[number % 8]]).float()
            name, kind = f"{split}-{seed}-{number}", number % 8
            self.motions[name] = self.representation.encode(cut).numpy()
            entry = Entry(
                name, 0, len(self.motions[name]), cast(Any, split), name, CAPTIONS[kind],
                number % 3, ATTRIBUTES[kind],
            )  # fmt: skip
            self.clips.append(replace(entry, **changed))
        frames = np.concatenate(list(self.motions.values()))
        self.std = frames.std(0)
        info = {"dataset": "own", "clips": {"test": count}, "fingerprint": "beef"}
        self.store = SimpleNamespace(
            motion=lambda clip: self.motions[clip.id], info=info, fingerprint="beef",
            references=lambda names: None,
        )  # fmt: skip


@cache
def data(count: int = 24, seed: int = 3, rule: str = "units", **changed: Any) -> Any:
    crop = {"units": Units(20, 40), "whole": Whole(), "fixed": Fixed(30)}[rule]
    return Data(seed, count, crop, **changed)


KID = {"subsets": 4, "subset_size": 9}
METRICS = {
    "fid": {"_target_": "evaluators.metrics.distribution.FrechetMotionDistance"},
    "kid": {"_target_": "evaluators.metrics.distribution.KernelMotionDistance", **KID},
    "texts_for_motion": {"_target_": "evaluators.metrics.alignment.TextsForMotion", "pool": 5},
    "mm_dist": {"_target_": "evaluators.metrics.alignment.MultimodalDistance"},
    "mid": {"_target_": "evaluators.metrics.alignment.MutualInformationDivergence"},
    "attributes": {"_target_": "evaluators.metrics.attributes.AttributeAccuracy", "fps": 20.0},
    "kimodo": {"_target_": "evaluators.metrics.published_physics.KimodoQuality", "fps": 20.0},
    "jitter": {"_target_": "evaluators.metrics.physics.Jitter", "fps": 20.0},
    "nearest": {"_target_": "evaluators.metrics.memorization.NearestTraining"},
    "errors": {"_target_": "evaluators.metrics.reconstruction.DisplacementErrors"},
}
SEVERAL = {
    "prompts": 4, "samples": 3, "replications": 2,
    "metrics": {
        "several": {
            "_target_": "evaluators.metrics.diversity.TextMultimodality", "samples": 3, "pairs": 2,
        }
    },
}  # fmt: skip


def protocol_of(**changed: Any) -> Protocol:
    content = {
        "name": "own", "version": 4, "condition": "text",
        "extractor": {"_target_": "x.Y", "path": "there"}, "metrics": METRICS, "replications": 2,
    }  # fmt: skip
    return check_shape(content | changed, Protocol)


def drawn(rows: Sequence[DrawnClip]) -> Any:
    return [
        (row.id, row.prompt, row.caption, row.frames[:1], len(row.frames), row.frames.sum(),
         row.context)
        for row in rows
    ]  # fmt: skip


def rows_of_protocols() -> Any:
    results: list[Any] = []
    for rule in ("units", "whole", "fixed"):
        clips = data(rule=rule)
        for options in combinations(
            1, 7, samples=(None, 5, 50), real_samples=(None, 30), context_frames=(0, 4),
            context=("drawn", "start"), only=({}, {"action": "walk"}),
        ):  # fmt: skip
            protocol = protocol_of(multimodality=SEVERAL, **options)
            for seed, replication in ((0, 0), (0, 1), (5, 0)):
                listed = drawn(protocol.rows(clips, seed, replication))
                results.append(np.array([len(listed), sum(row[5] for row in listed)]))
                results.append([row[:3] for row in listed[:3]])
            for purpose in ("real", "training"):
                listed = protocol.rows(clips, 0, 1, purpose=purpose)
                results.append((len(listed), drawn(listed)[:2], drawn(listed)[-1]))
            results.append(drawn(protocol.prompts(clips, 0, 1))[2:7])
            results.append((protocol.count(clips), protocol.cuts_motions, protocol.title))
            results.append(len(protocol.selected(clips)))
    row = protocol_of().rows(data(), 0, 0)[3]
    results.append((row.text, row.requested, [row.tokens(text) for text in ("a wave", row.text)]))
    for options in ({"context_frames": 40}, {"only": {"action": "fly"}}, {"context_frames": 70}):
        protocol = protocol_of(**options)
        results.append(outcome(lambda chosen=protocol: len(chosen.rows(data(), 0, 0))))
    return results


def sizes_of_protocols() -> Any:
    results: list[Any] = []
    for options in combinations(
        2, 40, replications=(None, 1, 2, 3, 0), samples=(None, 5, 24, 0), batch_size=(None, 8),
        quick=(False, True), multimodality=(False, True),
    ):  # fmt: skip
        for own in ({}, {"multimodality": SEVERAL, "batch_size": 4, "samples": 24}):
            protocol = protocol_of(**own)

            def resized(protocol: Protocol = protocol, options: Any = options) -> Any:
                other, changed = protocol.resized(24, **options)
                several = other.multimodality
                return [
                    changed, other.replications, other.samples, other.batch_size, other.quick,
                    other.resized_samples, several and several.replications, other.count(data()),
                ]  # fmt: skip

            results.append(outcome(resized))
    return results


def checks_of_protocols() -> Any:
    results: list[Any] = []
    bare, unlabeled = data(captions=()), data(action=None)
    for condition in ("text", "action", "none"):
        protocol = protocol_of(condition=condition)
        for clips in (data(), bare, unlabeled):
            for model in (None, "text", "action", "none"):
                used = model and SimpleNamespace(conditioned_on=model)
                results.append(
                    outcome(lambda a=protocol, b=clips, c=used: a.check(b, cast(Any, c)))
                )
    for path in (None, "none"):
        for extractor in (None, {"_target_": "x.Y"}):
            chosen = protocol_of(extractor=extractor)
            results.append(outcome(lambda a=chosen, b=path: a.open_extractor(b, HumanML(), "own")))
    for condition in ("none", "action", "text"):
        for dataset in ("humanact12", "uestc", "synthetic", "other"):
            model = SimpleNamespace(conditioned_on=condition, facts={"dataset": dataset})
            results.append(default_protocol(cast(Any, model)))
    results += [set_bones(None, one) for one in (HumanML(), SMPL(), Rot6D())]
    for name in ("editing", "editing_inbetween", "text_to_motions", "none/there.yaml"):
        results.append(outcome(lambda asked=name: protocol_config(asked)))
    return results


def released_protocols() -> Any:
    results = {}
    for name in protocol_names():
        protocol = load_protocol(name, HumanML(fps=20.0))
        content = protocol.model_dump(exclude={"metrics", "sha256", "expected"})
        results[name] = (str(content), _value_names(make_metrics(protocol.metrics))[:60:3])
        results[name] += (protocol.sha256[:12], str(protocol.expected)[:200])
    return results


def near_misses_of_clips() -> Any:
    clips = [
        replace(clip, captions=[f"{clip.captions[0]} {n % 3}"])
        for n, clip in enumerate(data().clips)
    ]
    bandai = [
        replace(clips[0], captions=[f"{content} {style}"], attributes={
            "content": content, "style": style, "dataset": number % 2, "side": side, "more": [1]})
        for number, (content, style, side) in enumerate(
            (content, style, side)
            for style in ("normal", "old", "angry")
            for content, side in (
                ("wave-left-hand", "left"), ("wave-right-hand", "right"), ("wave-both-hands", "both"),
                ("walk", "none"),
            )
        )
    ]  # fmt: skip
    lone = replace(clips[1], attributes={"side": "left"})
    return [
        near_misses(clips),
        near_misses(bandai),
        near_misses([lone, *clips[:5]]),
        near_misses([]),
    ]


def changed_joints() -> Any:
    results: list[Any] = []
    for fps in (20.0, 12.5):
        motions = list(some_bodies(4, fps, 2).values())
        for number, joints in enumerate(motions):
            other = motions[number - 1][: 20 + 9 * number]

            def draws(seed: int = number) -> np.random.Generator:
                return np.random.default_rng(seed)

            results += [
                perturbations.jitter(joints, 7.0, draws()),
                perturbations.wobble(joints, 30.0, draws(), fps),
                perturbations.skate(joints, 1.7), perturbations.lift(joints, 3.0),
                perturbations.resize(joints, 12.0), perturbations.pop(joints, 20.0, draws()),
                perturbations.pop(joints, 20.0, draws(), last=True),
                perturbations.draw_in(joints, 20.0), perturbations.draw_in(joints, 90.0),
                perturbations.freeze(joints, 35.0), perturbations.freeze(joints, 100),
                perturbations.play(joints, 0.6, fps), perturbations.play(joints, 1.3, fps),
                perturbations.through_rate(joints, 9.0, fps),
                perturbations.through_rate(joints, 33.0, fps), perturbations.crop(joints, 37.0),
                perturbations.crop(joints[:7], 90.0),
                perturbations.drop_repetition(joints, 2), perturbations.drop_repetition(joints, 3),
                perturbations.continue_with(joints, other, fps),
                perturbations.continue_with(other, joints, fps),
            ]  # fmt: skip
            results += encode(HumanML(fps=fps), [joints[:9] + np.array([0, 0.3, 0]), other])
    return results


@cache
def scene(count: int = 16) -> Scene:
    """Motions of a split, some of which have repetitions, with training motions."""
    clips = data(count)
    rows = protocol_of().rows(clips, 0, 0)
    module = SimpleNamespace(clips=lambda split: data(11, 5, split="train"))
    return Scene(cast(Any, module), rows, real_motions(clips, rows), HumanML(), 2)


def wrong_captions() -> Any:
    wrong = scene().wrong
    return {
        kind: [text and (text.caption, text.tokens) for text in texts]
        for kind, texts in wrong.items()
    } | {"actions": scene().actions, "draws": scene().draws("a", 3).integers(99, size=4)}


def perturbed_sets() -> Any:
    """The motions of all perturbations, and what they replace at each grade."""
    results: dict[str, Any] = {}
    used = scene()
    texts = [text_of(row, row.text) for row in used.rows]
    base = {"features": np.arange(32.0).reshape(16, 2), "flags": np.arange(16)}
    for captioned in (False, True):
        listed = perturbations.perturbations_of(used, captioned)
        results[f"names {captioned}"] = [(one.name, list(one.grades), one.unit) for one in listed]
    small = [replace(one, grades=(3, 7, 16, 40)) for one in listed if one.name == "fewer"]
    fewer = perturbations.FewerMotions("fewer", "set", "", grades=(3, 7, 16, 40)).offered(
        used, True
    )
    for one in [*listed, *small, *fewer]:
        functions = one.motions(used)
        for name, motions in [*functions.items()][:: max(len(functions) - 1, 1)]:
            if name.partition(" ")[0] not in ("through",):
                arrays = motions()
                results[name] = [sum(map(len, arrays)), np.concatenate(arrays)]
        other = {"features": 100 - base["features"], "flags": -base["flags"]}
        sets = dict.fromkeys(functions, other) | {BASE: base, STORED: other, REAL: base}
        for grade in one.grades:
            inputs, chosen = one.apply(used, grade, sets, texts)
            shown = [text.caption[:12] for text in chosen] if chosen is not texts else None
            results[f"{one.name} at {grade}"] = (inputs["flags"].tolist(), shown)
    return results


@cache
def evaluated() -> dict[str, Any]:
    clips = data()
    rows = protocol_of().rows(clips, 0, 0)
    features = real_motions(clips, rows)
    inputs = {"requested": [row.requested for row in rows]}
    names, captions = [row.id for row in rows], [row.text for row in rows]
    metrics = {name: METRICS[name] for name in METRICS if name != "nearest"}
    evaluator = Evaluator(Tiny(), metrics, HumanML(), batch_size=7)
    generated = evaluator.extract(Motions(names, features, captions, None, inputs))
    shorter = [motion[: 24 - number % 4] * 1.02 for number, motion in enumerate(features)]
    paired = evaluator.extract(Motions(names, shorter, captions, None, inputs))
    return {"evaluator": evaluator, "generated": generated, "paired": paired, "rows": rows}


def scores_of_evaluators() -> Any:
    made = evaluated()
    evaluator, generated, paired = made["evaluator"], made["generated"], made["paired"]
    results: list[Any] = [generated, paired["generated"]]
    for seed in (0, 1):
        results.append(evaluator.score(generated, paired, paired, seed))
        results.append(evaluator.resample(generated, paired, paired, seed, 3))
    results.append(evaluator.resample(generated, paired, paired, 0, 0))
    results.append(
        {name: evaluator.unit_of(name) for name in ("jitter", "errors/ade", "kimodo/low")}
    )
    results.append([evaluator.compares_sets(name) for name in ("fid", "kid/mean", "mid", "jitter")])
    results.append(
        [evaluator.reads(name) for name in ("nearest", "real_joints", "contacts", "text")]
    )
    chunk = _chunk(generated, paired, slice(3, 8))
    results.append({name: chunk[name] for name in ("joints", "mask", "real_joints", "contacts")})
    bare = Evaluator(None, evaluator.metrics, HumanML(), skip_features=True)
    rows = made["rows"]
    features = real_motions(data(), rows)
    edit = {"region": "in_between", "joints": None}
    without = bare.extract(Motions([row.id for row in rows], features, edit=edit))
    results += [outcome(lambda: list(bare.check(without))), outcome(lambda: evaluator.check({}))]
    results.append([kept.double().mean() for kept in without["kept"]])
    training = evaluator.training_motions(
        Motions(["a", "b"], features[:2]), Motions(["a", "b", "c"], features[:3])
    )
    results += [training.poses, training.lengths, training.features]
    near = replace(evaluator, training=training).extract(Motions(["x", "y"], features[1:3]))
    results.append(near["nearest"].round(decimals=4).tolist())
    features[2] = features[2] * np.nan
    results.append(outcome(lambda: evaluator.extract(Motions(list("abc"), features[:3]))))
    results.append(keys_of(["a", "b"]))
    return results


def values_of_evaluations() -> Any:
    results: list[Any] = []
    several: dict[str, Any] = {"multimodality": SEVERAL}
    edit: dict[str, Any] = {"edit": {"region": "in_between", "joints": None}}
    expected = {"own": {"jitter": [9.0, 0.5], "fid": [0.1, 0.2], "kid/mean": [0, 9]}}
    cases: list[tuple[dict[str, Any], Extractor | None, str, dict[str, Any]]] = [
        (several | {"real_samples": 16, "samples": 14}, Tiny(), "noisy", {"resamples": 2}),
        (several | {"smoothing": 1.5, "quick": True}, OwnReference(), "real", {}),
        (edit | {"replications": 1}, None, "static", {"ground_truth": False}),
        ({"expected": expected, "replications": 1}, Tiny(), "shuffled", {}),
        ({"expected": expected, "replications": 1}, Tiny(), "shuffled", {"force": True}),
        ({"expected": expected, "resized_samples": True, "replications": 1}, None, "static", {}),
    ]
    for options, extractor, kind, more in cases:
        used = data(12)
        training = data(11, 5, split="train")
        evaluation = Evaluation(protocol_of(**options), used, extractor, HumanML(), 3, 7, training)
        source = Baseline(kind, used, "text", 3)
        measured = outcome(lambda run=evaluation, a=source, b=more: run.run(a, **b))
        if not isinstance(measured, str):
            measured = measured.model_dump()
            for part in ("values", "ground_truth"):
                for name, value in (measured[part] or {}).items():
                    measured[part][name] = value and [*value.values()]
        results.append(measured)
    return results


def baselines() -> Any:
    results: list[Any] = []
    for kind in ("real", "shuffled", "noisy", "static", "other"):
        for condition in ("text", "action", "none"):
            for seed, replication in ((0, 0), (0, 1), (4, 0)):
                rows = protocol_of(samples=19).rows(data(), 0, 0)

                def motions(a: Any = (kind, condition, seed, replication), b: Any = rows) -> Any:
                    source = Baseline(a[0], data(), a[1], a[2])
                    features = source("", b, a[3]).features
                    return [np.concatenate(features), [len(x) for x in features]]

                results.append(outcome(motions))
    few = protocol_of(samples=3, only={"action": "kick"}).rows(data(), 0, 0)
    results.append(outcome(lambda: Baseline("shuffled", data(), "text", 0)("", few, 0)))
    return results


def folders_of_samples() -> Any:
    results: list[Any] = []
    rows = protocol_of(samples=6).rows(data(), 0, 0)
    motions = real_motions(data(), rows)[:5]
    names, lengths = [row.id for row in rows[:5]][::-1], [len(x) for x in motions]
    features = np.concatenate(motions)
    joints = np.concatenate([HumanML().decode(torch.from_numpy(x)).numpy() for x in motions])
    good = {"ids": names, "lengths": lengths, "features": features}
    contents: list[dict[str, Any]] = [
        good, good | {"captions": [f"take {name}" for name in names]},
        {"ids": names, "lengths": lengths, "joints": joints},
        good | {"ids": [*names[:4], "other"]}, good | {"ids": [*names[:4], names[0]]},
        {"ids": names, "features": features}, {"ids": names, "lengths": lengths},
        good | {"lengths": [*lengths[:4], lengths[4] + 1]}, good | {"lengths": [*lengths[:4], 0]},
        good | {"lengths": [float(n) for n in lengths]}, good | {"captions": names[:4]},
        good | {"features": features[:, :100]}, good | {"features": features.astype(complex)},
        good | {"features": joints}, {**good, "joints": joints[:-1]}, good | {"ids": list(range(5))},
    ]  # fmt: skip
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        results.append(str(outcome(lambda: SampleFolder(folder, HumanML()))).replace(name, ""))
        for number, content in enumerate(contents):
            np.savez(folder / f"part_{number}.npz", **content)
        np.savez(folder / "multimodality_0.npz", **good)
        source = SampleFolder(folder, HumanML())
        results.append([path.name for path in source.files])
        for number in range(len(contents)):
            samples = outcome(lambda n=number: source("", rows, n))
            if isinstance(samples, Samples):
                results.append(
                    [[row.id for row in samples.rows], samples.features, samples.captions]
                )
            else:
                results.append(str(samples).replace(name, ""))
        results.append(list(read_samples(folder / "part_2.npz")))
    return results


class FromNoise(Generator):
    """A generator whose motions depend on the rows of each batch."""

    def _generate(self, rows: Sequence[DrawnClip], replication: int) -> Any:
        batches = [np.full((len(row.frames), 2), len(row.frames) + replication) for row in rows]
        return batches, 10 * len(rows), 0.5 * len(rows) ** 2


def generated_motions() -> Any:
    results: list[Any] = []
    with tempfile.TemporaryDirectory() as name:
        for condition, batch_size in (("text", 5), ("action", 4), ("none", 19)):
            protocol = protocol_of(samples=13, condition=condition, replications=2)
            rows = protocol.rows(data(), 0, 0)
            folder = Path(name) / condition
            folder.mkdir()
            for place in (None, folder, folder):
                source = FromNoise(
                    cast(Any, None),
                    protocol,
                    data(),
                    SamplerOptions(),
                    {},
                    0,
                    batch_size,
                    place,
                    False,
                )
                samples = source("rep_1", rows, 1)
                results.append([samples.features, samples.cost, source.bar.n, source.bar.total])
            results.append(
                str(outcome(lambda a=source, b=rows: a("rep_1", b[::-1], 1))).replace(name, "")
            )
            content = read_samples(folder / "rep_1.npz")
            results.append({entry: content[entry] for entry in sorted(content)})
    return results


def texts_of_results() -> Any:
    results: list[Any] = [mean_ci(values) for values in ([1.5], [1.0, 4.0], [2.0, 2.5, 9.0])]
    rng = np.random.default_rng(0)
    replications = [
        Scores(
            {"fid": float(rng.normal()), "kid/mean": value, "x": None}, reasons, count,
            {"fid": 70 + count}, {"x": "m"},
        )
        for value, reasons, count in ((1.0, {"x": "few"}, 64), (3.0, {"x": "none"}, 64), (None, {}, 5))
    ]  # fmt: skip
    drawn_values = {"fid": [0.1, 0.5, 0.3, 0.9], "kid/mean": [1.0, None]}
    for count in (0, 1, 2, 3):
        result = Outcome(replications[:count], drawn_values, not_computed={"y": "so"})
        results += [result.values, result.reasons, _intervals(result.values)]
        for usual in ("2 x 64", "1 x 64", "64 + 64 + 5"):
            results.append([_cell(value, usual) for value in result.values.values()])
    results += [_cell(None, ""), _cell(Value(mean=2.5, ci=None, replications=1, n=None), "2 x 3")]
    costs = [Cost(nfe=5, seconds_per_sample=0.25, batch_size=8), Cost(nfe=8, batch_size=5)]
    results += [mean_cost(costs), mean_cost(costs[:1])]
    for keys in (
        {}, {"ckpt": "a", "baseline": "b"}, {"baseline": "b"}, {"from_samples": "c", "data": {"a": 1}},
        {"from_samples": "c", "data": {"a": 1}, "protocol": "p", "quick": True},
        {"from_samples": "c", "data": {"a": 1}, "protocol": "p", "samples": 3},
        {"from_samples": "c", "data": {"a": 1}, "protocol": "p", "replications": 3},
        {"ckpt": "a", "resamples": 1}, {"ckpt": "a", "resamples": 39}, {"ckpt": "a", "resamples": 100},
        {"ckpt": "a"}, {"ckpt": "a", "until": 0.5, "strength": 2.0, "eta": 0.5},
    ):  # fmt: skip
        results.append(outcome(lambda asked=keys: EvaluationRequest.of(asked)))
    return results


class Bar:
    """Counts the steps of an audit."""

    steps = 0

    def update(self, count: int = 1) -> None:
        self.steps += count


def audits() -> Any:
    results: list[Any] = []
    used = scene()
    texts = [text_of(row, row.text) for row in used.rows]
    names = [row.id for row in used.rows]
    chosen = {"mirrored", "jitter", "frozen", "wrong captions", "near misses", "missing actions"}
    listed = [
        replace(one, grades=tuple(one.grades)[::4])
        for one in perturbations.perturbations_of(used, True)
        if one.name in chosen
    ]
    with tempfile.TemporaryDirectory() as name:
        for extractor in (Tiny(), None):
            evaluator = Evaluator(extractor, METRICS, HumanML(), 5)
            sets: dict[str, Any] = {
                BASE: lambda: perturbations.base_motions(used),
                STORED: lambda: used.features,
                REAL: lambda: [motion[3:] for motion in used.features],
            }
            offered = [one for one in listed if extractor or one.name != "frozen"]
            for one in offered:
                sets |= one.motions(used)
            folder = Path(name) / type(extractor).__name__
            inputs = {
                kind: _inputs(evaluator, folder / f"{number}.npz", names, motions)
                for number, (kind, motions) in enumerate(sets.items())
            }
            results.append({kind: list(arrays) for kind, arrays in inputs.items()})
            results.append(list(audited_metrics(evaluator)))
            for wanted in (texts, []):
                measure = _Measure(evaluator, inputs, wanted, np.random.default_rng(1), 4)
                own = offered if wanted else [one for one in offered if one.group == "joints"]
                bar = Bar()
                results.append(_measured(measure, used, own, wanted, cast(Any, bar)))
                results += [bar.steps, measure.truth, measure.judges, measure.reasons]
                results.append(measure.scores(inputs[STORED], wanted))
    return results


def intervals_of_audits() -> Any:
    rng = np.random.default_rng(3)
    base = {"a": rng.normal(size=5), "b": rng.normal(size=5), "c": np.array([1.0, np.nan, 2])}
    other = {"a": rng.normal(size=5), "c": np.array([np.nan, 1.0, 2])}
    results: list[Any] = [_interval(values) for values in base.values()]
    results.append(_differences(other, base))
    measure = SimpleNamespace(truth="truth", judges={"up": 1, "down": -1, "missing": 1})
    scores = [
        {"truth": rng.integers(0, 2, 9), "up": rng.normal(size=9), "down": rng.normal(size=9)}
        for _ in range(3)
    ]
    grades = [
        {"values": {name: [float(rng.normal()), 0, 0, 0] for name in ("truth", "up", "down")}}
        for _ in range(5)
    ]
    grades[2]["values"]["down"] = [None] * 4
    results.append(_agreement(cast(Any, measure), scores, [{"grades": grades}]))
    return results


def batch_of(width: int, lengths: Sequence[int] = (24, 9, 17, 12)) -> tuple[Tensor, Tensor]:
    """Random motions of different lengths, with padding that is not zero."""
    rng = np.random.default_rng(width)
    mask = torch.arange(max(lengths) + 3) < torch.tensor(lengths)[:, None]
    return torch.from_numpy(rng.normal(size=(*mask.shape, width))), mask


def seeded(create: Callable[[], nn.Module]) -> Any:
    """A network with seeded float64 weights, also of its constant parameters and buffers."""
    torch.manual_seed(3)
    network = create().double().eval()
    for parameter in network.parameters():
        if parameter.numel() == 1 or not parameter.detach().std():
            nn.init.normal_(parameter, 0.3, 0.5)
    for name, buffer in network.named_buffers():
        if name.endswith("running_var"):
            buffer.copy_(torch.rand_like(buffer) + 0.5)
        elif name.endswith("running_mean"):
            buffer.copy_(torch.randn_like(buffer))
    return network


@torch.no_grad()
def features_of_motion_clips() -> Any:
    results: list[Any] = []
    for options in combinations(3, 4, blind_features=(0, 3), roughness=(False, True)):
        network = seeded(
            lambda chosen=options: motion_clip.MotionCLIP(
                7, 5, latent_dim=8, ff_size=12, num_layers=2, num_heads=2, dropout=0.1,
                max_frames=24, embedding_dim=6, **chosen,
            )
        )  # fmt: skip
        x, mask = batch_of(7)
        results += [network(x, mask), network.text(x[:, 0, :5]), network.logit_scale]
        long = outcome(lambda used=network: used(*batch_of(7, (25, 3))))
        results += [network(*batch_of(7, (2, 1))), long]
    rng = np.random.default_rng(1)
    motion, text = (torch.from_numpy(rng.normal(size=(6, 4))) for _ in range(2))
    wrong, meaning = (
        torch.from_numpy(rng.normal(size=(6, 2, 4))),
        torch.tensor([[0, 1], [0, 2], [3, 2], [4, 5], [6, 7], [6, 8]]),
    )
    for kinds in combinations(0, 4, meaning=(None, meaning), wrong_text=(None, wrong)):
        results.append(motion_clip.info_nce(motion, text, torch.tensor(0.7), **kinds))
    for count in (5, 32, 40, 70):
        loss = motion_clip.PooledLoss()
        pair = torch.from_numpy(rng.normal(size=(2, count, 4)))
        loss.update(pair[0], pair[1], torch.from_numpy(rng.permutation(count)), torch.tensor(1.7))
        results.append(loss.compute())
    results.append(
        calibration_error(motion, text, torch.rand(6, generator=torch.Generator().manual_seed(1)))
    )
    return results


def noisy_copies_of_motions() -> Any:
    results = []
    representation = HumanML()
    representation.mean.copy_(torch.linspace(-0.3, 0.4, 263))
    representation.std.copy_(torch.linspace(0.6, 1.7, 263))
    for count in (1, 4, 5):
        motions = [
            torch.from_numpy(x) for x in real_motions(data(), protocol_of().rows(data(), 0, 0))
        ]
        lengths = torch.tensor([min(30 - 3 * n, len(motions[n])) for n in range(count)])
        x = torch.zeros(count, 34, 263)
        for row, length in enumerate(lengths.tolist()):
            x[row, :length] = representation.normalize(motions[row])[:length]
        torch.manual_seed(2)
        results.append(noisy_copies(representation, x, lengths, torch.linspace(0.2, 0.9, count)))
    return results


@torch.no_grad()
def features_of_t2m() -> Any:
    results: list[Any] = []
    sizes = {"movement_hidden": 6, "movement_latent": 5, "text_hidden": 4, "motion_hidden": 7}
    mean, std = torch.linspace(-1, 1, 11), torch.linspace(0.5, 2, 11)
    words = {word: row for row, word in enumerate(("sos", "eos", "unk", "walk", "left", "cat"))}
    vectors = torch.randn(6, 300, generator=torch.Generator().manual_seed(0))
    reader = t2m.WordVectors(words, vectors)
    captions = [
        ["walk/NOUN", "left/ADV", "cat/NOUN"], ["dog/NOUN"], ["cat/XYZ"] * 25, ["walk/"] * 20, [],
        ["cat/VERB", "a/b/NOUN"],
    ]  # fmt: skip
    for full in (False, True):
        results.append(reader(captions, full_length=full))
    results.append(reader(captions))
    for used in (None, 5):
        network = seeded(
            lambda chosen=used: t2m.T2MEvaluator(
                mean, std, **sizes, embedding=3, max_frames=28, used_features=chosen
            )
        )
        x, mask = batch_of(11)
        results += [network(x, mask), network.text(reader(captions)), network.used]
        for lengths in ((3, 9), (4, 28), (29, 8)):
            results.append(outcome(lambda a=network, b=lengths: a(*batch_of(11, b))))
        decoder = seeded(lambda chosen=network: t2m_training._MovementDecoder(5, 6, chosen.used))
        batch = MotionBatch(x[:, :26], mask[:, :26], list("abcd"))
        results.append(t2m_training.reconstruction_terms(network, decoder, batch))
    learned = seeded(t2m.LearnedWords)
    results.append(learned([["walk", "left"], ["cat/NOUN"] * 30]))
    results.append(len(t2m.SPECIAL))
    rng = np.random.default_rng(0)
    for margin in (0.5, 3.0, 10.0):
        motion, text = (torch.from_numpy(rng.normal(size=(7, 3))) for _ in range(2))
        fits = torch.from_numpy(rng.random((7, 7)) < 0.4) | torch.eye(7, dtype=torch.bool)
        fits[3] = True
        results += [t2m_training.matching_loss(motion, text, margin, one) for one in (None, fits)]
        for count in (1, 7):
            loss = t2m_training.MatchingLoss(margin)
            loss.update(
                generated=motion[:count], text=text[:count], keys=torch.arange(count).flip(0)
            )
            results.append(loss.compute())
    return results


@torch.no_grad()
def features_of_classifiers() -> Any:
    results: list[Any] = []
    x, mask = batch_of(24 * 3)
    joints = x.unflatten(-1, (24, 3))
    gru = seeded(lambda: action_gru.ActionGRU(24, 5, num_actions=4))
    state = gru.random_state([3, 1, 2, 7])
    results += [gru(joints, mask), gru.logits(joints, mask), gru.logits(joints, mask, state), state]
    results.append(gru.published(joints, mask, state))
    results += [len(list(action_gru.ActionGRU().parameters())), action_gru.NUM_ACTIONS]
    parents = (1, -1, 1, 2, 0)
    results += [stgcn.adjacency(parents).tolist(), stgcn.adjacency(stgcn.UNCONSTRAINED_PARENTS)]
    for widths, strides in (((4, 4, 6), (1, 1, 2)), ((3, 5, 5, 5), (2, 1, 1, 2))):
        network = seeded(lambda a=widths, b=strides: stgcn.JointSTGCN(parents, 3, a, b))
        results += [network(joints[:, :, :5], mask), network.logits(joints[:, :, :5], mask)]
    whole = seeded(stgcn.Unconstrained)
    results += [whole(joints[:2], mask[:2]), whole.logits(joints[:2], mask[:2])]
    rotations, rotation_mask = batch_of(25 * 6, (11, 7))
    results.append(seeded(stgcn.UESTC)(rotations, rotation_mask))
    clip = seeded(
        lambda: mardm.MARDMClip(
            torch.linspace(-1, 1, 9), torch.linspace(0.5, 2, 9), width=8, hidden=6, layers=2, heads=2,
            words=20, slots=7,
        )
    )  # fmt: skip
    tokens = torch.tensor([[3, 5, 19, 0, 0, 0, 0], [4, 19, 0, 0, 0, 0, 0], [1, 2, 3, 4, 5, 6, 19]])
    results += [clip(*batch_of(12)), clip.text(tokens)]
    return results


CASES = cases_of(globals())


@pytest.mark.parametrize("case", CASES)
def test_results_are_as_recorded(case: Case):
    check(NAME, case)


if __name__ == "__main__":
    record(NAME, CASES)
