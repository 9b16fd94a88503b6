"""Rules of evaluations, without a model: folders of motions, numbers of motions, and bounds of real motions."""

import hashlib
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from support.pages import result

from evaluators.callback import Evaluate
from evaluators.collectives import processes
from evaluators.evaluation import Evaluation, evaluate
from evaluators.evaluation_request import EvaluationRequest
from evaluators.evaluator import Evaluator, Motions, _values
from evaluators.extractors import Extractor
from evaluators.metrics import make_metrics
from evaluators.metrics.distribution import frechet_distance
from evaluators.metrics.samples import SampleMetric
from evaluators.plan import Plan, open_data
from evaluators.protocol import FOLDER, DrawnClip, Protocol, load_protocol, protocol_names
from evaluators.results import Outcome, Scores, _cell, _checkpoint, _intervals, mean_cost, show
from evaluators.sources import Baseline, Generator, SampleFolder, Samples, read_samples
from flame_mdm.config import parameters
from flame_mdm.data import advice_on_splits
from flame_mdm.data.crops import Units
from flame_mdm.data.folder import Folder
from flame_mdm.data.store import Entry
from flame_mdm.data.synthetic import Synthetic
from flame_mdm.errors import UserError
from flame_mdm.records import Cost, Measured, Result, Value, read_result
from flame_mdm.representations.humanml import HumanML
from flame_mdm.sampler_options import SamplerOptions
from flame_mdm.schemas import check_shape
from flame_mdm.seeds import key

BASE: dict[str, Any] = {
    "sampler": "ddim",
    "num_inference_steps": 3,
    "eta": 0.0,
    "spacing": "linspace",
}
CHANGES: dict[str, dict[str, Any]] = {
    "eta": {"eta": 0.5},
    "spacing": {"spacing": "stride"},
    "steps": {"num_inference_steps": 4},
    "guidance": {"guidance_scale": 2.0},
}


OTHERS: dict[str, dict[str, Any]] = {
    "the seed": {"seed": 1},
    "the split": {"split": "val"},
    "the number": {"samples": 7},
    "the data": {"fingerprint": "beef"},
    "the version": {"title": "p-4"},
    "the weights": {"weights": b"others"},
    "the part that an edit keeps": {"edit": {"mode": "x0"}},
    "the batches, if they are timed": {"timed": 8},
}


def folder_of(
    tmp_path: Path,
    *,
    seed: int = 0,
    split: Any = "test",
    samples: int | None = None,
    fingerprint: str = "f00d",
    title: str = "p-3",
    weights: bytes = b"weights",
    edit: dict[str, Any] | None = None,
    timed: int | None = None,
    batch_size: int = 64,
    **options: Any,
) -> Path:
    """The folder of motions of a checkpoint that is sampled with these options."""
    (tmp_path / "model.ckpt").write_bytes(weights)
    protocol = SimpleNamespace(samples=samples, title=title, batch_size=timed)
    sampling = SamplerOptions(**BASE | options).chosen() | {"edit": edit or {}}
    data = SimpleNamespace(store=SimpleNamespace(fingerprint=fingerprint))
    plan = cast(Plan, SimpleNamespace(sampling=sampling, data=data, batch_size=timed or batch_size))
    request = EvaluationRequest(ckpt=str(tmp_path / "model.ckpt"), seed=seed, split=split)
    return Plan._motions_folder(plan, request, tmp_path / "model.ckpt", cast(Protocol, protocol))


@pytest.mark.parametrize("name", CHANGES)
def test_motions_of_other_sampling_options_have_another_folder(name: str, tmp_path: Path):
    assert folder_of(tmp_path) == folder_of(tmp_path)
    assert folder_of(tmp_path, **CHANGES[name]) != folder_of(tmp_path)


@pytest.mark.parametrize("name", OTHERS)
def test_motions_that_differ_in_one_input_have_another_folder(name: str, tmp_path: Path):
    assert folder_of(tmp_path, **OTHERS[name]) != folder_of(tmp_path)
    assert folder_of(tmp_path, batch_size=8) == folder_of(tmp_path), "it changes no motion"


def scores(count: int, value: float | None = 1.0) -> Scores:
    return Scores({"fid": value}, {}, count, {"fid": 378}, {"fid": "m"})


def test_a_mean_over_unequal_numbers_of_motions_has_no_single_number():
    mixed, equal = (
        Outcome([scores(64), scores(5)]).values["fid"],
        Outcome([scores(64), scores(64, 2.0)]).values["fid"],
    )
    assert mixed is not None
    assert equal is not None
    assert (mixed.n, mixed.n_per_replication) == (None, [64, 5])
    assert (equal.n, equal.mean, equal.n_real, equal.unit) == (64, 1.5, 378, "m")
    missing = Outcome([scores(64), scores(64, None)]).values["fid"]
    assert missing is not None
    assert missing.mean is None, "not the mean of those that could be computed"


def evaluation(
    resized: bool = False, samples: int | None = None, clips: int = 100, split: str = "test"
) -> Evaluation:
    """An evaluation whose real motions are expected to have an FID of 0.06 within 0.01."""
    protocol = SimpleNamespace(
        metrics={},
        resized_samples=resized,
        cuts_motions=False,
        expected={"synthetic": {"fid": [0.06, 0.01]}},
        samples=samples,
        real_samples=None,
        selected=lambda clips: clips.clips,
    )
    store = SimpleNamespace(info={"dataset": "synthetic", "clips": {"test": 100}})
    entries = SimpleNamespace(store=store, clips=[SimpleNamespace(split=split)] * clips)
    return Evaluation(cast(Any, protocol), cast(Any, entries), None, cast(Any, None))


def value(mean: float) -> dict[str, Value | None]:
    return {"fid": Value(mean=mean, ci=None, replications=1, n=64)}


def test_bounds_of_real_motions_hold_for_the_number_of_motions_of_the_protocol():
    assert evaluation()._unexpected(value(0.065)) == []
    assert evaluation()._unexpected(value(0.08)) == [
        "real motions have fid 0.08, expected 0.06 +- 0.01"
    ]
    assert evaluation()._unexpected(value(0.04)) == [
        "real motions have fid 0.04, expected 0.06 +- 0.01"
    ]
    assert evaluation(split="val")._unexpected(value(0.08)) == []
    assert evaluation(resized=True)._unexpected(value(0.08)) == []
    (line,) = evaluation(resized=True)._conditions()
    assert "the expected values of real motions were not checked" in line
    assert evaluation()._conditions() == []


def test_only_own_data_gets_the_advice_to_change_its_splits(tmp_path: Path):
    for source, advised in ((Folder(str(tmp_path)), True), (Synthetic(seed=0), False)):
        clips = SimpleNamespace(crop=Units(), advice=advice_on_splits(source))
        protocol = SimpleNamespace(selected=lambda clips: [], only={})
        with pytest.raises(UserError, match="no clip with at least 40 frames") as refused:
            Protocol.rows(cast(Any, protocol), cast(Any, clips), 0, 0)
        assert ("captions.csv" in str(refused.value)) == advised, type(source).__name__


def test_repeated_clips_are_said():
    assert evaluation(samples=100)._conditions() == []
    (line,) = evaluation(samples=101)._conditions()
    assert line.startswith("101 motions from 100 clips: clips are repeated")


def test_a_tolerance_includes_its_ends():
    bounds = {"synthetic": {"fid": [0.5, 0.25]}}
    measured = evaluation()
    measured.protocol.expected = bounds  # type: ignore[misc]
    assert [measured._unexpected(value(mean)) for mean in (0.25, 0.75)] == [[], []]
    assert [len(measured._unexpected(value(mean))) for mean in (0.2499, 0.7501)] == [1, 1]


def test_bounds_of_an_extractor_replace_those_of_the_data():
    measured = evaluation()
    measured.protocol.expected = {
        "f00d": {"fid": [9, 1]},
        "synthetic": {"fid": [5, 1], "mid": [2, 1]},
    }  # type: ignore[misc]
    assert measured._expected() == {"fid": [5, 1], "mid": [2, 1]}
    object.__setattr__(measured, "extractor", SimpleNamespace(sha256="f00d"))
    assert measured._expected() == {"fid": [9, 1], "mid": [2, 1]}


@pytest.mark.parametrize(("count", "others", "texts"), [
    (16, 16, []), (15, 15, ["biased upward, because 15 motions are fewer than twice the 8 features"]),
    (16, 17, ["16 generated and 17 real motions. Compare it only with values for the same numbers of motions"]),
])  # fmt: skip
def test_few_motions_for_a_frechet_distance_are_said(count: int, others: int, texts: list[str]):
    name = "evaluators.metrics.distribution.FrechetMotionDistance"
    protocol = SimpleNamespace(metrics={"fid": {"_target_": name}, "other": {"_target_": "x.Y"}})
    rows, real = ({"keys": range(n), "generated": torch.zeros(n, 8)} for n in (count, others))
    measured = Evaluation(cast(Any, protocol), cast(Any, None), None, cast(Any, None))
    assert measured._warnings(rows, real) == [f"fid: {text}" for text in texts]


def test_costs_are_per_motion_and_averaged_over_replications():
    first, second = (
        Cost(nfe=5, seconds_per_sample=0.5, batch_size=8),
        Cost(nfe=7, seconds_per_sample=1, batch_size=8),
    )
    assert mean_cost([first, second]) == Cost(nfe=6, seconds_per_sample=0.75, batch_size=8)
    assert mean_cost([first, Cost()]) == Cost()


def rows_of(lengths: list[int], clip_frames: int = 100) -> list[DrawnClip]:
    entry = SimpleNamespace(length=clip_frames, captions=["a"], action=0)
    return [
        DrawnClip(f"clip {number}", cast(Any, entry), np.arange(length) + 7, 0, f"clip {number}")
        for number, length in enumerate(lengths)
    ]


def test_a_cost_counts_calls_per_batch_and_seconds_per_motion(monkeypatch):
    """Batches of 2 and of 1: 10 and 4 calls of the denoiser, 3 and 2 seconds; the longest motions come first."""
    batches: list[list[int]] = []

    def generated(self: Generator, rows: list[DrawnClip], replication: int) -> Any:
        batches.append([len(row.frames) for row in rows])
        calls, seconds = {2: (10, 3.0), 1: (4, 2.0)}[len(rows)]
        return [np.full((len(row.frames), 1), len(row.frames)) for row in rows], calls, seconds

    monkeypatch.setattr(Generator, "_generate", generated)
    protocol = SimpleNamespace(batch_size=None, count=lambda clips: 3)
    arguments: Any = (None, protocol, None, SamplerOptions(), {}, 0, 2)
    samples = Generator(*arguments, progress=False)("rep_0", rows_of([4, 9, 6]), 0)
    assert batches == [[9, 6], [4]]
    assert [len(motion) for motion in samples.features] == [4, 9, 6]
    assert samples.cost == Cost(nfe=7, seconds_per_sample=5 / 3, batch_size=2)


def clips_of(motion: np.ndarray, representation: Any = None) -> Any:
    """Clips that all have the same motion, in features with a standard deviation of 2."""
    plain = SimpleNamespace(rebase=lambda x: x)
    store = SimpleNamespace(motion=lambda clip: motion)
    return SimpleNamespace(store=store, representation=representation or plain, std=np.float32(2))


def test_a_noisy_baseline_has_half_a_standard_deviation_of_noise_of_its_own():
    clips, rows = clips_of(np.ones((100, 50), np.float32)), rows_of([90, 90])
    noise = {
        (seed, replication): np.array(
            Baseline("noisy", clips, "text", seed)("", rows, replication).features
        )
        - 1
        for seed, replication in ((0, 0), (1, 0), (0, 1))
    }
    parts = [*noise[0, 0], *noise[1, 0], *noise[0, 1]]
    assert [part.std() for part in parts] == pytest.approx([1.0] * 6, rel=0.05)
    assert [part.mean() for part in parts] == pytest.approx([0.0] * 6, abs=0.05)
    assert np.abs(np.corrcoef([part.ravel() for part in parts]) - np.eye(6)).max() < 0.1
    again = Baseline("noisy", clips, "text", 0)("", rows[::-1], 0).features[::-1]
    np.testing.assert_array_equal(np.array(again) - 1, noise[0, 0])


def test_another_window_of_a_clip_begins_at_any_of_its_frames():
    clips = clips_of(np.arange(100, dtype=np.float32)[:, None])
    rows = rows_of([90] * 200)
    begins = set()
    for motion in Baseline("real", clips, "text", 0)("", rows, 0).features:
        assert (np.diff(motion[:, 0]) == 1).all()
        assert len(motion) == 90
        begins.add(int(motion[0, 0]))
    assert begins == set(range(11))
    other = Baseline("real", clips, "text", 0)("", rows, 1).features
    assert len({int(motion[0, 0]) for motion in other}) > 5


def test_a_static_baseline_holds_the_first_pose():
    representation = HumanML()
    (clip,) = Synthetic(clips=1, seed=3).clips(20.0)
    joints = torch.from_numpy(np.asarray(clip.motion)[:40])
    features = representation.encode(joints).numpy()
    row = DrawnClip("a", cast(Any, None), np.arange(5, 30), 0, "a")
    clips = clips_of(features, representation)
    (held,) = Baseline("static", clips, "text", 0)("", [row], 0).features
    assert held.shape == (25, 263)
    poses = representation.decode(torch.from_numpy(held))
    first = representation.decode(torch.from_numpy(features[5:6]))
    assert (poses - poses[:1]).abs().max() < 1e-3
    hips = poses[0, 1:3] - poses[0, :1]
    assert torch.allclose(hips.norm(dim=-1), (first[0, 1:3] - first[0, :1]).norm(dim=-1), atol=1e-3)


def protocol_of(**options: Any) -> Protocol:
    parts: dict[str, Any] = {"name": "p", "version": 1, "condition": "text", "extractor": None}
    return Protocol(**parts | {"metrics": {}, "replications": 20} | options)


SEVERAL = {"prompts": 10, "samples": 30, "replications": 5, "metrics": {}}


def test_a_protocol_counts_all_motions_of_its_replications():
    clips: Any = SimpleNamespace(clips=[SimpleNamespace(attributes={}, length=50)] * 100)
    assert protocol_of().count(clips) == 2000
    assert protocol_of(samples=64).count(clips) == 20 * 64
    assert protocol_of(multimodality=SEVERAL).count(clips) == 2000 + 5 * 30 * 10
    few = protocol_of(samples=4, multimodality=SEVERAL)
    assert few.count(clips) == 80 + 5 * 30 * 4, "no more prompts than motions"
    every = protocol_of(multimodality=SEVERAL | {"prompts": None})
    assert every.count(clips) == 2000 + 5 * 30 * 100
    assert protocol_of(quick=True, multimodality=SEVERAL).count(clips) == 2000


def test_a_protocol_in_another_size_says_what_changed():
    protocol = protocol_of(multimodality=SEVERAL, samples=500)
    same, changed = protocol.resized(1000, replications=20, samples=500, batch_size=8)
    assert (changed, same.resized_samples, same.batch_size) == ({}, False, None)
    quick, changed = protocol.resized(1000, quick=True)
    assert changed == {"replications": 2, "samples": 64}
    assert (quick.quick, quick.resized_samples) == (True, True)
    assert quick.multimodality is not None
    assert quick.multimodality.replications == 2
    assert protocol.resized(40, quick=True)[1]["samples"] == 40
    assert protocol.resized(1000, quick=True, samples=7)[1] == {"replications": 2, "samples": 7}
    more, changed = protocol.resized(1000, replications=30, multimodality=True)
    assert more.multimodality is not None
    assert (changed, more.multimodality.replications) == ({"replications": 30}, 5)
    without, changed = protocol.resized(1000, multimodality=False)
    assert (changed, without.multimodality) == ({"multimodality": False}, None)
    timed, changed = protocol_of(batch_size=1).resized(1000, batch_size=8)
    assert (changed, timed.batch_size) == ({"batch_size": 8}, 8)
    with pytest.raises(UserError, match="samples=0: must be at least 1"):
        protocol.resized(1000, samples=0)


def test_a_contact_of_the_features_is_more_likely_than_not():
    representation = HumanML()
    features = np.zeros((4, 263), np.float32)
    features[:, representation.slices["contacts"]] = np.array([0.0, 0.49, 0.51, 1.0])
    rows = Evaluator(None, {}, representation).extract(Motions(["a"], [features]))
    assert rows["contacts"][0].tolist() == [[False, False, True, True]] * 4


def test_metrics_with_random_draws_get_the_seed_of_the_replication():
    names = ("alignment.TextsForMotion", "alignment.MotionsForText", "retrieval.TMRRetrieval")
    metrics = {name: {"_target_": f"evaluators.metrics.{name}"} for name in names}
    evaluator = Evaluator(None, metrics, HumanML())
    nothing: Any = {"keys": torch.zeros(0, dtype=torch.long)}
    seeds = [
        {cast(Any, metric).seed for metric in evaluator._updated(nothing, {}, {}, seed)[0].values()}
        for seed in (0, 1)
    ]
    assert [len(chosen) for chosen in seeds] == [1, 1]
    assert seeds[0] != seeds[1]


@pytest.mark.parametrize(("shown", "text"), [
    (None, "-"), (Value(mean=None, ci=None, replications=2, n=64), "-"),
    (Value(mean=1.23456, ci=0.0123, replications=2, n=64), "1.235 +- 0.012"),
    (Value(mean=1234.56, ci=None, replications=1, n=64), "1235 (1 x 64)"),
    (Value(mean=0.5, ci=0.0, replications=2, n=600), "0.5 +- 0 (2 x 600)"),
])  # fmt: skip
def test_printed_values_have_their_interval_and_an_unusual_number_of_motions(
    shown: Value | None, text: str
):
    assert _cell(shown, "2 x 64") == text


def test_a_model_in_training_is_evaluated_at_multiples_of_the_steps_and_with_its_averages(
    monkeypatch,
):
    callback = Evaluate("synthetic", "none", every_n_steps=10)
    ran: list[int] = []
    module: Any = SimpleNamespace(generator=None)
    monkeypatch.setattr("evaluators.callback.sampling_options", lambda *_: (None, {}))
    monkeypatch.setattr("evaluators.callback.Generator", lambda *_, **__: None)
    monkeypatch.setattr("evaluators.callback.GeneratorTask", SimpleNamespace)
    nothing = SimpleNamespace(values={}, ground_truth={})
    callback.next = 3  # the step from which training begins
    trainer: Any = SimpleNamespace(global_step=0, is_global_zero=False)

    def run(source: Any, *, ground_truth: bool, force: bool) -> Any:
        ran.append(trainer.global_step)
        assert force
        return nothing

    callback.evaluation = cast(Any, SimpleNamespace(protocol=None, clips=None, run=run))
    for step in (0, 3, 4, 9, 10, 11, 19, 27, 29, 30):
        trainer.global_step = step
        callback.on_validation_epoch_start(trainer, module)
    assert ran == [3, 10, 27, 30]


def entry_of(name: str, length: int, captions: int = 3, **attributes: Any) -> Entry:
    texts = [f"{name} {number}" for number in range(captions)]
    return Entry(name, 0, length, "test", name, texts, None, attributes)


def split_of(*entries: Entry) -> Any:
    """Clips of which the crop is a random window of at most 40 frames."""

    def crop(frames: int, generator: np.random.Generator) -> np.ndarray:
        length = min(frames, 40)
        return np.arange(length) + generator.integers(frames - length + 1)

    return SimpleNamespace(clips=list(entries), crop=crop, advice="")


@pytest.mark.parametrize(
    ("context", "frames", "shortest"), [("drawn", 10, 11), ("start", 10, 15), ("drawn", 0, 1)]
)
def test_a_clip_is_longer_than_the_context_and_has_the_attributes(
    context: str, frames: int, shortest: int
):
    lengths = (1, 9, 10, 11, 14, 15, 40)
    entries = [entry_of(f"{length}", length, kind="walk") for length in lengths]
    clips = split_of(*entries, entry_of("other", 40, kind="run"), entry_of("plain", 40))
    protocol = protocol_of(context=context, context_frames=frames, only={"kind": "walk"})
    names = [clip.id for clip in protocol.selected(clips)]
    assert names == [f"{length}" for length in lengths if length >= shortest]


def test_repeated_clips_have_draws_and_names_of_their_own_and_all_clips_occur_before():
    clips = split_of(*(entry_of(f"{number}", 200, 20) for number in range(6)))
    rows = protocol_of(samples=15).rows(clips, 0, 0)
    assert sorted(row.clip.id for row in rows[:6]) == [f"{number}" for number in range(6)]
    assert [row.clip.id for row in rows[6:12]] == [row.clip.id for row in rows[:6]]
    suffixes = [row.id.removeprefix(row.clip.id) for row in rows]
    assert suffixes == [""] * 6 + ["#1"] * 6 + ["#2"] * 3
    pairs = list(zip(rows, rows[6:], strict=False))
    assert sum(one.frames[0] != other.frames[0] for one, other in pairs) >= 8
    assert sum(one.caption != other.caption for one, other in pairs) >= 7
    assert [row.prompt for row in rows] == [row.id for row in rows]
    assert [len(row.context) for row in rows] == [0] * 15


def test_several_motions_of_a_prompt_share_its_caption_and_frames():
    clips = split_of(*(entry_of(f"{number}", 200, 20) for number in range(6)))
    several = {"prompts": 2, "samples": 3, "replications": 1, "metrics": {}}
    protocol = protocol_of(multimodality=several)
    rows, prompts = protocol.prompts(clips, 4, 1), protocol.rows(clips, 4, 1)[:2]
    assert [row.id for row in rows] == [f"{p.id}~{n}" for p in prompts for n in range(3)]
    assert [row.prompt for row in rows] == [p.id for p in prompts for _ in range(3)]
    for number, row in enumerate(rows):
        source = prompts[number // 3]
        assert (row.text, row.clip) == (source.text, source.clip)
        np.testing.assert_array_equal(row.frames, source.frames)


SKELETONS = {
    "smpl22": (HumanML(), (7, 10, 8, 11), (10, 11)),
    "kit21": (HumanML(skeleton="kit21", fps=12.5), (19, 20, 14, 15), (20, 15)),
}


@pytest.mark.parametrize("name", protocol_names())
@pytest.mark.parametrize("skeleton", SKELETONS)
def test_metrics_know_the_frame_rate_the_feet_and_the_parents_of_the_motions(
    name: str, skeleton: str
):
    representation, feet, toes = SKELETONS[skeleton]
    protocol = load_protocol(name, representation)
    several = protocol.multimodality.metrics if protocol.multimodality else {}
    parents = list(representation.skeleton.parents)
    facts = {"fps": representation.fps, "toes": list(toes), "parents": parents, "feet": list(feet)}
    for metric, config in (protocol.metrics | several).items():
        expected = {fact: facts[fact] for fact in facts if fact in parameters(config["_target_"])}
        assert {fact: config.get(fact) for fact in expected} == expected, metric


NUMBERS: dict[str, tuple[int, int | None, int | None]] = {
    **dict.fromkeys(("text_to_motion_t2m", "text_to_motion_t2m_own"), (20, None, None)),
    **dict.fromkeys(("text_to_motion_mardm", "text_to_motion_mardm_clip"), (20, None, None)),
    **dict.fromkeys(("text_to_motion_t2m_legacy", "text_to_motion_t2m_dip"), (20, 1024, None)),
    **dict.fromkeys(("action_to_motion", "action_to_motion_legacy"), (20, 1000, 1000)),
    **{"action_to_motion_uestc": (20, 1000, 1000), "action_to_motion_own": (5, 1000, 1000)},
    **dict.fromkeys(("text_to_motion", "text_to_motion_flame", "bandai"), (3, None, None)),
    **{"synthetic": (5, None, None), "text_to_motion_2026": (3, None, None)},
    **{"unconditioned": (3, 1000, None), "latency": (1, 16, 16), "reconstruction": (3, None, None)},
    **dict.fromkeys(
        ("unconditioned_humanact12", "unconditioned_humanact12_legacy"), (1, 1000, None)
    ),
    **dict.fromkeys(
        ("reconstruction_best_of_10", "reconstruction_kit", "reconstruction_kit_best_of_10"),
        (1, None, None),
    ),
}
SEVERAL_OF: dict[str, tuple[int | None, int, int]] = {
    **dict.fromkeys(("text_to_motion", "text_to_motion_flame"), (100, 20, 3)),
    **dict.fromkeys(("text_to_motion_t2m", "text_to_motion_t2m_own"), (100, 30, 5)),
    **{"text_to_motion_t2m_dip": (100, 30, 5), "text_to_motion_t2m_legacy": (128, 30, 5)},
    **{"text_to_motion_mardm": (96, 30, 5), "synthetic": (20, 20, 2)},
    "reconstruction_best_of_10": (500, 10, 1),
    "reconstruction_kit_best_of_10": (None, 10, 1),
}


@cache
def loaded(name: str) -> Protocol:
    return load_protocol(name, HumanML())


def test_protocols_have_the_numbers_of_motions_that_their_page_and_the_papers_state(subtests):
    for name in protocol_names():
        with subtests.test(name=name):
            protocol = loaded(name)
            sizes = (protocol.replications, protocol.samples, protocol.real_samples)
            assert sizes == NUMBERS.get(name, (3, None, None) if "editing" in name else None)
            several = protocol.multimodality
            numbers = several and (several.prompts, several.samples, several.replications)
            assert numbers == SEVERAL_OF.get(name)
            assert protocol.smoothing == (1.0 if name == "text_to_motion_flame" else None)
            assert protocol.batch_size == (1 if name == "latency" else None)
            assert protocol.context == ("start" if name.endswith("_dip") else "drawn")
            own_split = {"ghosh_test": True} if "kit" in name else {}
            assert protocol.only == own_split


def test_metrics_of_protocols_have_the_options_of_the_papers():
    """Ten pairs of 30 motions per text; 300 pairs of texts, but 200 with repetition of actions."""
    options: dict[str, dict[str, Any]] = {}
    for name in protocol_names():
        protocol = loaded(name)
        several = protocol.multimodality
        for metric, config in (protocol.metrics | (several.metrics if several else {})).items():
            options[f"{name} {metric}"] = config
            if several and metric in several.metrics:
                per_text = config["samples"] * (1 + ("Paired" in config["_target_"]))
                assert per_text == several.samples, (name, metric)
    for name in ("text_to_motion_t2m", "text_to_motion_t2m_legacy", "text_to_motion_mardm"):
        assert options[f"{name} multimodality"]["pairs"] == 10
        assert (options[f"{name} diversity"]["pairs"], options[f"{name} diversity"]["replace"]) == (
            300,
            False,
        )
        assert "normalize" not in options[f"{name} mm_dist"]
        assert "normalize" not in options[f"{name} motions_for_text"]
    for name in ("text_to_motion", "bandai", "synthetic"):
        assert options[f"{name} diversity"]["pairs"] == 300
        assert options[f"{name} mm_dist"]["normalize"], "features are compared by their cosine"
        assert options[f"{name} motions_for_text"]["normalize"]
    assert options["synthetic multimodality"]["pairs"] == 10
    for name in ("action_to_motion", "unconditioned", "unconditioned_humanact12"):
        diversity = options[f"{name} diversity"]
        assert (diversity["pairs"], diversity["replace"]) == (200, True)
    assert options["action_to_motion multimodality"]["pairs"] == 20
    assert "replace" not in options["unconditioned_humanact12 kid"]
    assert options["unconditioned_humanact12_legacy kid"]["replace"]
    assert options["reconstruction_kit temos"]["upsampling"] == 8
    assert options["reconstruction_kit_best_of_10 temos_of_10"]["upsampling"] == 8
    assert options["editing_in_between_2026 flowmdm"]["window"] == 20
    assert all("_recursive_" in config for config in options.values() if "encoder" in config)


def samples_file(path: Path, ids: list[str], first: float, captions: list[str] | None) -> None:
    """Motions of two features, of 1, 2, ... frames, which all consist of one number."""
    lengths = [number + 1 for number in range(len(ids))]
    values = np.repeat(first + np.arange(len(ids)), lengths)
    texts: dict[str, Any] = {} if captions is None else {"captions": captions}
    np.savez(path, ids=ids, lengths=lengths, features=np.stack([values, values], 1), **texts)


def test_files_of_others_are_in_numeric_order_and_their_captions_stay_with_their_motions(
    tmp_path: Path,
):
    rows = rows_of([5, 5, 5])
    ids = [rows[2].id, rows[0].id]
    for number in (9, 10, 0):
        samples_file(tmp_path / f"rep_{number}.npz", ids, 100 * number, ["jumps", "sits"])
    samples_file(tmp_path / "multimodality_0.npz", ids, -1, None)
    samples_file(tmp_path / ".rep_1.npz", ids, -1, None)
    source = SampleFolder(tmp_path, cast(Any, SimpleNamespace(features=2, name="two")))
    assert [path.name for path in source.files] == ["rep_0.npz", "rep_9.npz", "rep_10.npz"]
    for replication, number in enumerate((0, 9, 10)):
        samples = source("", rows, replication)
        assert [row.id for row in samples.rows] == [rows[0].id, rows[2].id]
        assert samples.captions == ["sits", "jumps"]
        motions = [motion.tolist() for motion in samples.features]
        assert motions == [[[100 * number + 1] * 2] * 2, [[100 * number] * 2]]
        assert samples.cost == Cost()
    samples_file(tmp_path / "rep_0.npz", ids, 0, None)
    assert source("", rows, 0).captions is None
    before = source.sha256
    samples_file(tmp_path / "rep_10.npz", ids, 7, None)
    assert source.sha256 != before


class Sums(Extractor):
    """Features are the number of real frames and the sum of the first feature; texts are their lengths."""

    sha256 = "5" * 64

    def check(self, representation: Any, dataset: str) -> None: ...

    def motions(self, features: Any, joints: Any, mask: Any) -> dict[str, Any]:
        real = features[..., 0] * mask
        heights = (joints[..., 1].amax(2) * mask).amax(1)
        sums = torch.stack([mask.float().sum(1), real.sum(1)], 1)
        return {"features": sums, "logits": heights[:, None]}

    def texts(self, captions: Any, tokens: Any) -> Any:
        pairs = zip(captions, tokens, strict=True)
        return torch.tensor([[len(text), len(words)] for text, words in pairs])


@pytest.mark.parametrize("batch_size", [1, 2, 64])
def test_inputs_of_metrics_are_in_the_order_of_the_motions(batch_size: int):
    """Motions of 7, 3, 5, 3 and 9 frames are encoded in batches of similar lengths."""
    representation = HumanML()
    lengths = [7, 3, 5, 3, 9]
    features = [np.zeros((length, 263), np.float32) for length in lengths]
    for number, motion in enumerate(features):
        motion[:, 0], motion[:, representation.slices["root_height"]] = 0.01, number + 1
        motion[:, representation.slices["contacts"]] = number % 2
    captions = ["a" * (number + 1) for number in range(5)]
    tokens: list[list[str] | None] = [["a/DET"] * number for number in (4, 0, 3, 1, 2)]
    evaluator = Evaluator(Sums(), {}, representation, batch_size)
    rows = evaluator.extract(
        Motions([f"{n}" for n in range(5)], features, captions, tokens, edit={"region": "prefix"})
    )
    assert rows["generated"][:, 0].tolist() == lengths
    assert rows["generated"][:, 1].tolist() == pytest.approx([0.01 * n for n in lengths])
    assert rows["logits"][:, 0].tolist() == pytest.approx([1, 2, 3, 4, 5])
    assert rows["text"].tolist() == [[1, 4], [2, 0], [3, 3], [4, 1], [5, 2]]
    assert [len(motion) for motion in rows["joints"]] == lengths
    assert [float(motion[0, 0, 1]) for motion in rows["joints"]] == pytest.approx([1, 2, 3, 4, 5])
    assert [len(kept) for kept in rows["kept"]] == lengths
    assert [bool(contacts.all()) for contacts in rows["contacts"]] == [False, True] * 2 + [False]
    assert rows["captions"] == captions
    assert rows["text_keys"].tolist() == [key(text) for text in captions]


def scored(evaluation: Evaluation, inputs: Any) -> list[Any]:
    """Replaces the evaluator by one that encodes motions as their ids; returns the scored inputs."""
    calls: list[Any] = []

    def score(motions: Any, paired: Any, real: Any, seed: int) -> Any:
        calls.append((motions["ids"], paired["ids"], real["ids"], seed))
        return {}, {}

    evaluator = SimpleNamespace(
        extract=lambda motions: {"ids": motions.ids, "keys": torch.arange(len(motions.ids))},
        score=score, resample=lambda *arguments: {"drawn": [arguments[3:]]},
        compares_sets=None, unit_of=None,
    )  # fmt: skip
    evaluation.__dict__["evaluator"] = evaluator
    object.__setattr__(evaluation, "_motions", lambda rows, features, texts=None: inputs(rows))
    return calls


def test_motions_of_others_are_compared_with_the_real_motions_of_the_same_clips():
    """The first replication contains all motions, the second one the motions of two clips."""
    rows = rows_of([5, 5, 5, 5])
    protocol: Any = SimpleNamespace(
        rows=lambda clips, seed, replication: rows, smoothing=None, metrics={}
    )
    measured = Evaluation(protocol, cast(Any, None), None, cast(Any, None), seed=3)
    calls = scored(measured, lambda rows: SimpleNamespace(ids=[row.id for row in rows]))
    names = [row.id for row in rows]
    kept = [rows, [rows[1], rows[3]]]
    paired = {"ids": names, "keys": torch.arange(4)}
    real = {"ids": ["real"], "keys": torch.arange(1)}

    def source(name: str, rows: Any, replication: int) -> Samples:
        return Samples(kept[replication], [np.zeros((5, 1))] * len(kept[replication]))

    outcome = measured._measure(source, [(paired, real)] * 2, 100)
    seeds = [key("draws", 3, replication) for replication in range(2)]
    assert calls == [
        (names, names, ["real"], seeds[0]),
        ([names[1], names[3]], [names[1], names[3]], ["real"], seeds[1]),
    ]
    assert outcome.resampled == {"drawn": [(seeds[0], 100)]}, "of the first replication"
    (warning,) = outcome.warnings
    assert "different numbers of motions (4, 2)" in warning


def test_each_motion_of_a_prompt_is_compared_with_the_real_motion_of_the_prompt(monkeypatch):
    clips = split_of(*(entry_of(f"{number}", 200) for number in range(6)))
    several = {"prompts": 2, "samples": 3, "replications": 2, "metrics": {}}
    protocol = protocol_of(multimodality=several)
    measured = Evaluation(protocol, clips, None, cast(Any, None), seed=3)
    calls = scored(measured, lambda rows: SimpleNamespace(ids=[row.id for row in rows]))
    monkeypatch.setattr("evaluators.evaluation.real_motions", lambda *_: [])
    clips.store = SimpleNamespace(references=lambda ids: None)
    monkeypatch.setattr("evaluators.evaluation.Generator", type(lambda: None))
    drawn: list[tuple[str, int]] = []

    def source(name: str, rows: Any, replication: int) -> Samples:
        drawn.append((name, replication))
        return Samples(rows, [])

    measured._measure_multimodality(source, measured.evaluator)
    assert drawn == [("multimodality_0", 0), ("multimodality_1", 1)]
    for replication, (motions, paired, real, seed) in enumerate(calls):
        prompts = [row.id for row in protocol.rows(clips, 3, replication)[:2]]
        assert motions == [f"{prompt}~{number}" for prompt in prompts for number in range(3)]
        assert paired == [f"{prompt}~0" for prompt in prompts for _ in range(3)]
        assert (real, seed) == ([], key("draws", 3, replication))


def test_a_result_describes_its_checkpoint(tmp_path: Path):
    for name, best, selected in (
        ("best", {"monitor": "val/fid"}, "best val/fid"),
        ("last", {"monitor": "val/fid"}, "none: last"),
        ("best", None, "none: best"),
    ):
        file = tmp_path / f"{name}.ckpt"
        file.write_bytes(b"weights")
        config = {"callbacks": {"best": best}, "ema": 0.999, "experiment": "x/y"}
        layer = torch.nn.Linear(3, 4)
        layer.bias.requires_grad = False
        model = SimpleNamespace(
            config=config, parameters=layer.parameters, steps=7,
            process=SimpleNamespace(prediction="epsilon"),
            facts={"training": {"hours": 1.5, "device": "a GPU"}},
        )  # fmt: skip
        sampling = {"sampler": "ddim", "num_inference_steps": 3, "guidance_scale": 2.5}
        plan: Any = SimpleNamespace(model=model, file=file, sampling=sampling)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("evaluators.results.recipe_changes", lambda config: ["a=1"])
            checkpoint = _checkpoint(plan)
        assert checkpoint is not None
        assert (checkpoint.selected_by, checkpoint.experiment) == (selected, "x/y")
        assert (checkpoint.parameters, checkpoint.prediction) == (12, "noise")
        assert (checkpoint.averaged_weights, checkpoint.training_steps) == (True, 7)
        assert (checkpoint.training_hours, checkpoint.training_device) == (1.5, "a GPU")
        assert (checkpoint.sampler, checkpoint.guidance_scale) == ("ddim", 2.5)
        assert checkpoint.sha256 == hashlib.sha256(b"weights").hexdigest()


def test_motions_are_kept_in_the_run_of_the_checkpoint(tmp_path: Path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    data = SimpleNamespace(store=SimpleNamespace(fingerprint="f00d"))
    plan = cast(Plan, SimpleNamespace(sampling={}, data=data, batch_size=64))
    protocol: Any = SimpleNamespace(samples=None, title="p-3", batch_size=None)
    paths = {
        "run/checkpoints/best.ckpt": Path("run"),
        "models/mine.safetensors": Path("models"),
        "shipped": Path("runs/shipped"),
    }
    for name, run in paths.items():
        file = Path(name) if "." in name else Path("elsewhere/shipped.safetensors")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(name.encode())
        request = EvaluationRequest(ckpt=name)
        folder = Plan._motions_folder(plan, request, file, protocol)
        assert folder.parent == run / "evaluation" / "p-3"
        assert folder.name.startswith(hashlib.sha256(name.encode()).hexdigest()[:16])


@pytest.mark.parametrize(("resamples", "valid"), [(0, True), (1, False), (99, False), (100, True)])
def test_a_bootstrap_has_at_least_100_sets(resamples: int, valid: bool):
    if valid:
        assert EvaluationRequest(ckpt="a", resamples=resamples).resamples == resamples
        return
    with pytest.raises(UserError, match="at least 100"):
        EvaluationRequest(ckpt="a", resamples=resamples)


@pytest.mark.parametrize("option", ["quick", "samples", "replications"])
def test_motions_of_others_are_all_evaluated(option: str):
    options: dict[str, Any] = {"from_samples": "a", "protocol": "p", "data": {"name": "x"}}
    assert EvaluationRequest(**options).from_samples == "a"
    options[option] = 2
    with pytest.raises(UserError, match="Remove quick, samples and replications"):
        EvaluationRequest(**options)


def test_intervals_are_explained_by_what_they_are_over():
    drawn: list[float | None] = [1.0, 2.0]
    motions = Value(mean=1.5, ci=None, replications=1, n=64, resampled=drawn)
    replications = Value(mean=1.5, ci=0.1, replications=2, n=64, resampled=drawn)
    missing = Value(mean=None, ci=None, replications=2, n=64)
    explained = [_intervals({"a": None, "b": missing, "c": v}) for v in (motions, replications)]
    assert [text.rpartition(" ")[2] for text in explained] == ["motions", "replications"]
    assert _intervals({"a": missing, "b": None}) == ""


def test_generated_motions_are_read_again_with_their_cost_and_only_for_the_same_clips(
    tmp_path: Path, monkeypatch
):
    def generated(self: Generator, rows: list[DrawnClip], replication: int) -> Any:
        return [np.full((len(row.frames), 2), len(row.frames)) for row in rows], 4, 3.0

    monkeypatch.setattr(Generator, "_generate", generated)
    protocol = SimpleNamespace(batch_size=None, count=lambda clips: 3, condition="text")
    arguments: Any = (None, protocol, None, SamplerOptions(), {}, 0, 2, tmp_path)
    rows = rows_of([4, 9, 6])
    first = Generator(*arguments, progress=False)("rep_0", rows, 0)
    monkeypatch.setattr(Generator, "_generate", lambda *_: pytest.fail("sampled again"))
    again = Generator(*arguments, progress=False)("rep_0", rows, 0)
    assert [motion.tolist() for motion in again.features] == [
        [[length] * 2] * length for length in (4, 9, 6)
    ]
    assert again.cost == first.cost == Cost(nfe=4, seconds_per_sample=2, batch_size=2)
    assert again.captions is None
    assert read_samples(tmp_path / "rep_0.npz")["captions"].tolist() == ["a"] * 3
    with pytest.raises(UserError, match="contains motions for other clips"):
        Generator(*arguments, progress=False)("rep_0", rows[::-1], 0)


def test_a_value_that_is_not_finite_or_cannot_be_computed_has_a_reason():
    def refuse() -> Any:
        raise UserError("too few")

    computations: dict[str, Any] = {
        "finite": lambda: 1.5, "none": lambda: None, "infinite": lambda: float("inf"),
        "parts": lambda: {"a": 0.0, "b": float("nan")}, "refused": refuse,
    }  # fmt: skip
    metrics: Any = {name: SimpleNamespace(nothing={"x": None, "y": None}) for name in computations}
    values, reasons = _values(computations, metrics)
    assert values == {
        "finite": 1.5, "none": None, "infinite": None, "parts/a": 0.0, "parts/b": None,
        "refused/x": None, "refused/y": None,
    }  # fmt: skip
    assert reasons.keys() == {"infinite", "parts", "refused"}
    assert (reasons["refused"], "the value is inf" in reasons["infinite"]) == ("too few", True)


def test_repeated_real_motions_are_said():
    measured = evaluation()
    for count, lines in ((100, 0), (101, 1)):
        measured.protocol.real_samples = count  # type: ignore[misc]
        conditions = measured._conditions()
        assert len(conditions) == lines
    assert conditions[0].startswith("101 real motions for set comparisons from 100 clips")


@pytest.mark.parametrize(("key_root", "variable", "root"), [
    ("key", "variable", "key"), ("", "variable", "variable"), ("", "", "recipe"),
])  # fmt: skip
def test_the_folder_of_the_data_is_that_of_the_key_the_variable_or_the_recipe(
    key_root: str, variable: str, root: str, monkeypatch
):
    opened: list[dict[str, Any]] = []

    def instantiate(config: dict[str, Any], **options: Any) -> Any:
        opened.append(config | options)
        return SimpleNamespace(name="a")

    monkeypatch.setenv("FLAME_MDM_DATA", variable)
    monkeypatch.setattr("evaluators.plan.instantiate", instantiate)
    monkeypatch.setattr("evaluators.plan.trust", lambda config: None)
    config = {"data": {"name": "d", "root": "recipe"}, "representation": {"name": "r"}}
    model: Any = SimpleNamespace(config=config, representation=SimpleNamespace(name="a"))
    with pytest.raises(UserError, match="as the data set"):
        open_data(EvaluationRequest(ckpt="x", data_root=key_root), model)
    assert opened[0] == {"name": "r"}
    assert (opened[1]["root"], opened[1]["seed"]) == (root, 0)
    chosen = EvaluationRequest(
        ckpt="x", data={"name": "mine"}, representation={"name": "own"}, data_root=key_root
    )
    with pytest.raises(UserError, match="as the data set"):
        open_data(chosen, model)
    assert (opened[2], opened[3]["name"]) == ({"name": "own"}, "mine")
    assert opened[3]["root"] == (root if root != "recipe" else "data")


def test_reasons_against_a_result_come_from_real_motions_and_from_its_data(
    tmp_path: Path, monkeypatch
):
    request = EvaluationRequest(ckpt="a", seed=5, resamples=200, out=str(tmp_path / "x" / "r.json"))
    plan = SimpleNamespace(
        protocol="protocol", clips="clips", extractor="extractor", representation="representation",
        batch_size=7, source="source", path=Path(str(request.out)),
        data=SimpleNamespace(clips=lambda split: f"clips of {split}"),
    )  # fmt: skip
    runs: list[Any] = []

    def run(self: Evaluation, source: Any, **options: Any) -> Measured:
        runs.append((self, source, options))
        parts: dict[str, Any] = {"ground_truth": None, "values": {}, "not_computed": {}}
        return Measured(**parts, invalid_because=["real motions are off"], seeds=[1, 2])

    of_data = check_shape(result(invalid_because=["splits may overlap"]), Result)
    monkeypatch.setattr("evaluators.evaluation.Plan", lambda *_: plan)
    monkeypatch.setattr("evaluators.evaluation.make_result", lambda *_: of_data)
    monkeypatch.setattr(Evaluation, "run", run)
    monkeypatch.setattr("evaluators.evaluation.show", lambda *_: None)
    evaluate(request)
    ((measured, source, options),) = runs
    assert (source, options) == ("source", {"force": False, "resamples": 200})
    assert (measured.seed, measured.batch_size) == (5, 7)
    assert measured.training == "clips of train"
    written = read_result(plan.path)
    assert written.invalid_because == ["real motions are off", "splits may overlap"]
    assert (written.seeds, written.values, written.split) == ([1, 2], {}, "test")


def test_a_printed_result_has_both_columns_and_all_its_reservations(capsys):
    of: dict[str, Any] = {"ci": 0.25, "replications": 2, "n": 64}
    shown = result(
        values={
            "fid": {"mean": 4.5, **of}, "drift": {"mean": 2.0, **of, "unit": "m"},
            "kid": {"mean": None, **of, "ci": None},
        },
        ground_truth={"fid": {"mean": 0.125, **of}},
        invalid_because=["splits may overlap"], warnings=["biased"], changed={"samples": 64},
        audit="a.html", audit_motions=40, skeleton={"stand_in": True},
        data={"dataset": "d", "fingerprint": "f", "excluded": {"short clips": 3}},
    )  # fmt: skip
    show(check_shape(shown, Result), Path("r.json"))
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert lines[1][-6:] == ["+-:", "95", "%", "interval", "over", "replications"]
    table = [line for line in lines if line[0] in ("fid", "drift", "kid", "real")]
    assert table == [
        ["real", "motions", "generated"],
        ["fid", "0.125", "+-", "0.25", "4.5", "+-", "0.25"],
        ["drift", "(m)", "-", "2", "+-", "0.25"],
    ]
    text = "\n".join(" ".join(line) for line in lines)
    for words in (
        "p version 3, d test", "differs from the protocol: samples=64", "excluded from the data set: 3",
        "not computed: kid: too few", "stand-in skeleton", "warning: biased",
        "NOT VALID: splits may overlap", "on 40 motions: a.html", "written: r.json",
    ):  # fmt: skip
        assert words in text


def test_copies_are_searched_in_whole_training_motions_by_their_joints_and_in_windows_by_features(
    monkeypatch,
):
    entries = [entry_of("a", 100), entry_of("b", 30), entry_of("c", 60)]
    training, clips = split_of(*entries), split_of(entry_of("d", 50))
    target = "evaluators.metrics.memorization.NearestTraining"
    protocol = protocol_of(metrics={"nearest": {"_target_": target}}, condition="none")
    frames_of = "evaluators.evaluation.real_motions"
    monkeypatch.setattr(frames_of, lambda source, rows: [(source, row.frames) for row in rows])
    monkeypatch.setattr(Evaluator, "training_motions", lambda self, *motions: motions)
    representation: Any = None
    measured = Evaluation(protocol, clips, None, representation, seed=4, training=training)
    whole, windows = cast(Any, measured.evaluator.training)
    rows = protocol.rows(training, 4, 0, purpose="training")
    assert whole.ids == windows.ids == [row.id for row in rows]
    for row, (source, every), (_, window) in zip(
        rows, whole.features, windows.features, strict=True
    ):
        assert source is training
        np.testing.assert_array_equal(every, np.arange(row.clip.length))
        np.testing.assert_array_equal(window, row.frames)
    alone = Evaluation(protocol, clips, None, representation)
    assert alone.evaluator.training is None


def test_the_condition_decides_which_inputs_metrics_get():
    walk = {
        "action": "walk",
        "side": "left",
        "content": "walk-left",
        "tokens": [["x"], ["y"], ["z"]],
    }
    rows = [
        DrawnClip(
            name, replace(entry_of(name, 50, **walk), action=number), np.arange(5), 1, "prompt"
        )
        for number, name in enumerate("ab")
    ]
    inputs: dict[str, Any] = {}
    for condition in ("text", "action", "none"):
        measured = Evaluation(
            protocol_of(condition=condition), cast(Any, None), None, cast(Any, None)
        )
        inputs[condition] = measured._motions(rows, [np.zeros((5, 1))] * 2)
    text, action, none = inputs.values()
    assert (text.captions, text.tokens) == (["a 1", "b 1"], [["y"], ["y"]])
    assert text.inputs["requested"] == [{"action": "walk", "side": "left"}] * 2
    assert text.inputs["sides"] == [("walk-left", "left")] * 2
    assert text.inputs["groups"].tolist() == [key("prompt")] * 2
    assert "labels" not in text.inputs
    assert (action.captions, action.inputs["labels"].tolist()) == (None, [0, 1])
    assert (none.captions, none.tokens, none.inputs.keys()) == (None, None, {"groups"})
    measured = Evaluation(protocol_of(), cast(Any, None), None, cast(Any, None))
    others = measured._motions(rows, [], ["b 2", "b 0"])
    assert (others.captions, others.tokens) == (["b 2", "b 0"], [None, ["x"]])
    some = [rows[0], replace(rows[1], clip=entry_of("b", 50))]
    assert measured._motions(some, []).inputs.keys() == {"groups"}


def test_a_protocol_generates_from_what_clips_and_model_have():
    bare = split_of(entry_of("a", 50, 0), entry_of("b", 50, 0))
    bare.store = SimpleNamespace(info={"dataset": "d"})
    full = split_of(replace(entry_of("a", 50), action=0))
    models: dict[Any, Any] = {
        kind: SimpleNamespace(conditioned_on=kind) for kind in ("text", "action", "none")
    }
    for condition in ("text", "action"):
        with pytest.raises(UserError, match=f"the data set d has clips without {condition}"):
            protocol_of(condition=condition).check(bare, None)
        protocol_of(condition=condition).check(full, None)
        for kind in models.keys() - {condition}:
            with pytest.raises(UserError, match=f"was trained with condition {kind}"):
                protocol_of(condition=condition).check(full, models[kind])
        protocol_of(condition=condition).check(full, models[condition])
    for model in models.values():
        protocol_of(condition="none").check(bare, model)


def test_the_hash_of_a_protocol_is_that_of_its_content_not_of_its_name(tmp_path: Path):
    text = (FOLDER / "unconditioned.yaml").read_text()
    (tmp_path / "copy.yaml").write_text(text)
    (tmp_path / "other.yaml").write_text(text.replace("pairs: 200", "pairs: 201"))
    original, copy, other = (
        load_protocol(name, HumanML())
        for name in ("unconditioned", str(tmp_path / "copy.yaml"), str(tmp_path / "other.yaml"))
    )
    assert original.sha256 == copy.sha256 != other.sha256
    assert (copy.name, copy.title) == ("copy", "copy-1")


def metrics_of_protocols() -> dict[str, SampleMetric]:
    """One metric per class and number of motions per text, of all protocols."""
    metrics: dict[str, SampleMetric] = {}
    for name in protocol_names():
        protocol = loaded(name)
        several = protocol.multimodality
        of_all = make_metrics(protocol.metrics | (several.metrics if several else {}))
        for metric in of_all.values():
            number = getattr(metric, "samples", 1)
            metrics[f"{type(metric).__name__} of {number}"] = metric
    return metrics


# Units of values, and the direction in which they improve, where they differ from most values.
# Most values have the unit "" and improve upward; distances, errors and faults improve downward.
UNITS: dict[str, str] = {
    **{"MutualInformationDivergence": "nats", "JointVariance": "m^2", "Jitter": "m/s^3"},
    **dict.fromkeys(("Penetration", "Floating", "DisplacementErrors", "KeptDrift"), "m"),
    **{"KimodoConstraints": "m", "KimodoConstraints/root2d_acc": "", "NearestTraining/joints": "m"},
    **{"TransitionJerk": "m/frame^3", "TransitionJerk/windows": ""},
    **{"MBenchQuality": "m/frame", "MBenchQuality/ground_penetration": "m"},
    **dict.fromkeys(("MBenchQuality/foot_floating", "MBenchQuality/measured"), ""),
    **{"KimodoQuality": "m/s", "KimodoQuality/contact_consistency": ""},
    **dict.fromkeys((f"KimodoQuality/{name}" for name in ("skate_ratio", "low", "measured")), ""),
    "TemosPositionErrors": "1,000 KIT units",
}
HIGHER = {
    *("ActionAccuracy", "MotionCLIPScore", "MutualInformationDivergence", "TextsForMotion"),
    *("MotionsForText", "SideAccuracy", "AttributeAccuracy", "TMRRetrieval", "ClaimAccuracy"),
    *("MultiPositiveRPrecision", "PrecisionRecall"),
    *("KimodoConstraints/root2d_acc", "KimodoQuality/contact_consistency"),
}
NEITHER = {
    *("Diversity", "ActionMultimodality", "TextMultimodality", "PairedMultimodality"),
    *("JointVariance", "NearestTraining/joints", "NearestTraining/features"),
    *("TransitionJerk/windows", "MultiPositiveRPrecision/positives", "ClaimAccuracy/decided"),
    *(f"MultiPositiveRPrecision/chance_top{k}" for k in (1, 2, 3)),
    *("ClaimAccuracy/captions", "MBenchQuality/dynamic_degree", "KimodoQuality/low"),
    *("KernelMotionDistance/std", "MBenchQuality/measured", "KimodoQuality/measured"),
    "PhysicalFootContact/measured",
}


def test_every_value_has_the_unit_and_the_direction_that_its_docstring_states():
    for title, metric in metrics_of_protocols().items():
        kind = title.split()[0]
        for part in metric.names or [""]:
            name = f"{kind}/{part}" if part else kind
            unit = UNITS.get(name, UNITS.get(kind, ""))
            if kind == "FlamePositionErrors":
                unit = "m^2" if "ave" in part.split("_") else "m"
            assert metric.unit_of(part) == unit, name
            direction = name in HIGHER or kind in HIGHER
            if part.endswith("median"):
                direction = False
            if name in NEITHER or kind in NEITHER:
                direction = None
            assert metric.direction_of(part) is direction, name


def test_metrics_declare_what_audits_and_tables_show_of_them():
    """The value that sums up the others, whether it sees meaning, and whether it depends on the count."""
    published = {"MBenchQuality", "KimodoQuality", "PhysicalFootContact"}
    physics = published | {"FootSkating", "Penetration", "Floating", "Jitter", "StaticShare"}
    without = published | {
        *("DisplacementErrors", "KeptDrift", "FlamePositionErrors", "TemosPositionErrors"),
        *("KimodoConstraints", "PrecisionRecall", "TMRRetrieval", "TransitionJerk"),
    }
    sums_up = {
        **dict.fromkeys(("TextsForMotion", "MotionsForText", "MultiPositiveRPrecision"), "top3"),
        **{"AttributeAccuracy": "all", "ClaimAccuracy": "all", "SideAccuracy": "hand_or_path"},
        **{"KernelMotionDistance": "mean", "NearestTraining": "copies"},
        **dict.fromkeys(without, None),
    }
    of_sets = {"FrechetMotionDistance", "KernelMotionDistance", "PrecisionRecall"}
    for title, metric in metrics_of_protocols().items():
        kind = title.split()[0]
        assert metric.summary == sums_up.get(kind, ""), kind
        assert metric.summary in {None, "", *metric.names}
        assert metric.sees_meaning == (kind not in physics), kind
        assert metric.depends_on_count == (kind in of_sets), kind
        assert metric.exact == ("all" if kind == "AttributeAccuracy" else None), kind
        retrieves = kind in ("TextsForMotion", "MotionsForText")
        assert metric.audited == (("top1", "top3") if retrieves else None), kind


def test_protocols_have_the_conditions_extractors_and_tolerances_that_their_files_explain():
    extractors: dict[str, tuple[str, dict[str, Any]]] = {
        "action_to_motion": ("ClassifierExtractor", {"kind": "humanact12"}),
        "action_to_motion_legacy": (
            "ClassifierExtractor",
            {"kind": "humanact12", "random_start": True},
        ),
        "action_to_motion_uestc": ("ClassifierExtractor", {"kind": "uestc"}),
        "action_to_motion_own": ("OwnClassifierExtractor", {}),
        "synthetic": ("MotionCLIPExtractor", {"path": "motion_clip_synthetic"}),
        "text_to_motion_mardm": ("T2MExtractor", {}),
        "text_to_motion_mardm_clip": ("MARDMClipExtractor", {}),
        "text_to_motion_t2m_legacy": ("T2MExtractor", {"full_length": True}),
        "text_to_motion_t2m_own": ("OwnT2MExtractor", {}),
        "unconditioned_humanact12": ("UnconstrainedExtractor", {}),
        "unconditioned_humanact12_legacy": ("UnconstrainedExtractor", {}),
    }
    for name in protocol_names():
        protocol = loaded(name)
        condition = {"action": "action", "unconditioned": "none"}.get(name.split("_")[0], "text")
        assert protocol.condition == condition, name
        t2m = "T2MExtractor" if "t2m" in name else "MotionCLIPExtractor"
        target, options = extractors.get(name, (t2m, {}))
        needs_none = name.startswith(("latency", "reconstruction")) or name.endswith("between_2026")
        config = None if needs_none else {"_target_": f"evaluators.extractors.{target}"} | options
        assert protocol.extractor == config, name
    tolerances = {
        data: {metric: bounds[1] for metric, bounds in values.items()}
        for name in ("text_to_motion_t2m", "action_to_motion", "action_to_motion_uestc")
        for data, values in loaded(name).expected.items()
    }
    tops = [f"motions_for_text/top{k}" for k in (1, 2, 3)]
    assert tolerances == {
        "humanml3d": {
            **dict.fromkeys(tops, 0.02),
            **{"mm_dist": 0.1, "diversity": 0.4, "fid": 0.02},
        },
        "kit": {**dict.fromkeys(tops, 0.03), **{"mm_dist": 0.1, "diversity": 0.5, "fid": 0.05}},
        "humanact12": {"fid": 0.1, "accuracy": 0.02, "diversity": 0.3, "multimodality": 0.3},
        "uestc": {"fid": 1.0, "accuracy": 0.02, "diversity": 1.0, "multimodality": 0.5},
    }
    assert loaded("text_to_motion_t2m_dip").expected == loaded("text_to_motion_t2m").expected


def test_captions_are_compared_by_the_mean_of_minilms_outputs_for_all_their_words():
    metrics = loaded("text_to_motion_2026").metrics
    encoder = metrics["tmr"]["encoder"]
    assert encoder == metrics["multi_positive_minilm"]["encoder"]
    options = {"pooling": "mean", "normalize": True, "max_tokens": 256, "features": 384}
    assert {name: encoder[name] for name in options} == options
    assert "encoder" not in metrics["multi_positive_equal"]
    for name in ("motions_for_text", "multi_positive_equal", "multi_positive_minilm"):
        assert metrics[name]["normalize"], "features of a motion-CLIP are compared by their cosine"


def test_an_evaluation_with_a_checkpoint_alone_measures_the_test_split_as_its_keys_state():
    request = EvaluationRequest(ckpt="x")
    defaults = {
        **{"which": "last", "split": "test", "seed": 0, "resamples": 0, "data_root": ""},
        **{"quick": False, "force": False, "multimodality": True, "protocol": None},
        **{"replications": None, "samples": None, "batch_size": None, "extractor": None},
    }
    assert {name: getattr(request, name) for name in defaults} == defaults
    assert request.options == SamplerOptions()
    assert (request.editing.method, request.editing.until, request.editing.strength) == (None,) * 3
    edited = EvaluationRequest(ckpt="x", method="mfm", until=0.0).editing
    assert (edited.method, edited.until, edited.strength) == ("mfm", 0.0, None)
    assert EvaluationRequest(ckpt="x", strength=0.5).editing.strength == 0.5
    config = {"ckpt": "x", "guidance_scale": 0.0, "eta": 1.0, "seed": 3, "out": "a.json"}
    composed = EvaluationRequest.of(config)
    assert (composed.options.guidance_scale, composed.options.eta) == (0.0, 1.0)
    assert (composed.seed, composed.out) == (3, "a.json")
    callback = Evaluate("synthetic", "none", every_n_steps=10)
    assert (callback.samples, callback.replications, callback.batch_size) == (256, 1, 64)


def test_an_evaluation_in_training_logs_each_value_with_its_interval_and_that_of_real_motions(
    monkeypatch,
):
    callback = Evaluate("synthetic", "none", every_n_steps=10)
    monkeypatch.setattr("evaluators.callback.sampling_options", lambda *_: (None, {}))
    monkeypatch.setattr("evaluators.callback.Generator", lambda *_, **__: None)
    monkeypatch.setattr("evaluators.callback.GeneratorTask", SimpleNamespace)
    tables: list[Any] = []
    monkeypatch.setattr("evaluators.callback.log_table", lambda *table: tables.append(table))

    def of(mean: float | None, ci: float | None = None, unit: str = "") -> Value:
        return Value(mean=mean, ci=ci, replications=2, n=64, unit=unit)

    real = {"fid": of(0.0), "jitter": of(9.0, unit="m/s^3"), "mid": of(None)}
    rounds = iter(
        [
            ({"fid": of(0.5, 0.1), "jitter": of(8.0, 0.2, "m/s^3")}, real),
            ({"mid": of(2.0), "fid": of(0.4)}, None),
        ]
    )
    asked: list[bool] = []

    def run(source: Any, *, ground_truth: bool, force: bool) -> Any:
        asked.append(ground_truth)
        values, of_real = next(rounds)
        return SimpleNamespace(values=values, ground_truth=of_real)

    protocol = SimpleNamespace(name="p")
    callback.evaluation = cast(Any, SimpleNamespace(protocol=protocol, clips=None, run=run))
    logged: list[tuple[dict[str, float], bool]] = []
    module: Any = SimpleNamespace(
        generator=None, log_dict=lambda values, logger=True: logged.append((values, logger))
    )
    trainer: Any = SimpleNamespace(global_step=10, is_global_zero=True, loggers=["board"])
    for step in (10, 20):
        trainer.global_step = step
        callback.on_validation_epoch_start(trainer, module)
        callback.on_validation_epoch_end(trainer, module)
    assert asked == [True, False], "real motions are measured once"
    (curves, shown), (selecting, also), (last, _), (rest, _) = logged
    assert (shown, also, rest) == (True, False, {})
    assert curves == {
        **{"val/p/fid": 0.5, "val/p/fid/ci": 0.1, "val/p/fid/real": 0.0},
        **{"val/p/jitter (m/s^3)": 8.0, "val/p/jitter (m/s^3)/ci": 0.2},
        "val/p/jitter (m/s^3)/real": 9.0,
    }
    assert selecting == {"val/p/jitter": 8.0, "val/p/jitter/ci": 0.2}
    expected = {"val/p/mid": 2.0, "val/p/fid": 0.4, "val/p/fid/real": 0.0}
    assert last == expected, "without the values of the evaluation before"
    head = ["metric", "mean", "ci", "replications", "n", "unit", "real motions"]
    rows = [["fid", 0.5, 0.1, 2, 64, "", 0.0], ["jitter", 8.0, 0.2, 2, 64, "m/s^3", 9.0]]
    later = [["mid", 2.0, None, 2, 64, "", None], ["fid", 0.4, None, 2, 64, "", 0.0]]
    assert tables == [
        ("board", "evaluation/p", head, rows, 9),
        ("board", "evaluation/p", head, later, 19),
    ]


@pytest.mark.parametrize(
    ("device", "rank", "gpus", "used"),
    [
        (None, None, 2, "cuda:0"),
        (None, "1", 2, "cuda:1"),
        (None, "3", 2, "cuda:1"),
        (None, "1", 0, "cpu"),
        ("cpu", "1", 2, "cpu"),
        ("cuda:1", "0", 2, "cuda:1"),
    ],
)
def test_a_process_uses_the_gpu_of_its_local_rank_unless_a_device_is_chosen(
    device: str | None, rank: str | None, gpus: int, used: str, monkeypatch
):
    monkeypatch.delenv("WORLD_SIZE", raising=False)
    monkeypatch.delenv("LOCAL_RANK", raising=False)
    if rank is not None:
        monkeypatch.setenv("LOCAL_RANK", rank)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: gpus > 0)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: gpus)
    checked: list[str] = []
    monkeypatch.setattr("evaluators.collectives.check_device", checked.append)
    with processes(device) as chosen:
        assert chosen == used
    assert checked == [used]


def test_a_bootstrap_draws_as_many_motions_as_each_of_two_unequal_sets_has():
    metrics = {
        name: {"_target_": f"evaluators.metrics.{target}"}
        for name, target in (
            ("fid", "distribution.FrechetMotionDistance"),
            ("diversity", "diversity.Diversity"),
        )
    }
    metrics["diversity"] |= cast(Any, {"pairs": 5, "replace": True})
    random = torch.Generator().manual_seed(0)
    sets = {
        name: {
            "generated": torch.randn(count, 3, generator=random),
            "keys": torch.tensor([key(name, number) for number in range(count)]),
        }
        for name, count in (("generated", 7), ("real", 12))
    }
    evaluator = Evaluator(None, metrics, HumanML())
    drawn = evaluator.resample(sets["generated"], {}, sets["real"], 5, 3)
    draws = np.random.default_rng(key("bootstrap", 5))
    for number in range(3):
        chosen = [
            sets[name]["generated"][torch.from_numpy(draws.integers(count, size=count))].double()
            for name, count in (("generated", 7), ("real", 12))
        ]
        distance = frechet_distance(*chosen).item()
        assert drawn["fid"][number] == pytest.approx(distance, rel=1e-6)
    assert len(set(drawn["diversity"])) == 3
    other = evaluator.resample(sets["generated"], {}, sets["real"], 6, 3)
    assert not set(drawn["fid"]) & set(other["fid"]), "another seed draws other motions"
    assert evaluator.resample(sets["generated"], {}, sets["real"], 5, 0) == {}


def test_results_of_baselines_and_files_have_names_that_state_how_they_differ(monkeypatch):
    representation = SimpleNamespace(to=lambda device: None)
    store = SimpleNamespace(info={"dataset": "d"})
    data = SimpleNamespace(representation=representation, store=store, clips=lambda split: None)
    network: list[Any] = [None]
    sizes: dict[str, Any] = {}

    def opened(name: str, clips: Any, representation: Any, model: Any, **size: Any) -> Any:
        return protocol_of(**sizes).resized(100, **size)

    monkeypatch.setattr("evaluators.plan.open_data", lambda request, model: data)
    monkeypatch.setattr("evaluators.plan.set_bones", lambda *_: None)
    monkeypatch.setattr("evaluators.plan.open_protocol", opened)
    monkeypatch.setattr("evaluators.plan.Baseline", lambda *_: None)
    files = SimpleNamespace(files=["a", "b", "c"])
    monkeypatch.setattr("evaluators.plan.SampleFolder", lambda *_: files)
    monkeypatch.setattr(Protocol, "open_extractor", lambda *_: network[0])

    def plan_of(**keys: Any) -> Plan:
        subject: dict[str, Any] = {} if "from_samples" in keys else {"baseline": "real"}
        return Plan(EvaluationRequest(data={"a": 1}, protocol="p", **subject | keys), "cpu")

    options: list[tuple[dict[str, Any], str]] = [
        ({}, ""),
        ({"split": "val"}, "-val"),
        ({"split": "test", "seed": 0}, ""),
        ({"seed": 1}, "-seed1"),
        ({"samples": 20}, "-20"),
        ({"replications": 3}, "-3x"),
        ({"replications": 20}, ""),
        ({"quick": True}, "-quick"),
        ({"quick": True, "samples": 7, "replications": 1}, "-quick"),
        ({"split": "train", "seed": 2, "samples": 20, "replications": 3}, "-train-seed2-20-3x"),
    ]
    for keys, suffix in options:
        assert plan_of(**keys).path == Path(f"runs/baselines/d/p-1/real{suffix}.json")
    network[0] = SimpleNamespace(sha256="0123456789abcdef")
    assert plan_of(seed=1, replications=3).path.name == "real-seed1-01234567-3x.json"
    assert plan_of(out="x/y.json").path == Path("x/y.json")
    assert (plan_of().batch_size, plan_of(batch_size=8).batch_size) == (64, 8)
    for samples in (None, 500):
        sizes |= {"samples": samples, "batch_size": samples and 1}
        plan = plan_of(from_samples="x/y")
        assert plan.path == Path("x/y/p-1-01234567.json")
        assert (plan.protocol.replications, plan.protocol.samples) == (3, None)
        assert plan.protocol.resized_samples == (samples is not None)
    assert plan_of(batch_size=8).batch_size == 8, "batches of 1 are for protocols that measure time"
    assert plan_of().batch_size == 1


def test_the_chosen_extractor_replaces_that_of_the_protocol(monkeypatch):
    opened: list[Any] = []

    def instantiated(config: Any, *, path: str, device: Any) -> Any:
        opened.append((path, device))
        return SimpleNamespace(check=lambda *checked: opened.append(checked))

    monkeypatch.setattr("evaluators.protocol.instantiate", instantiated)
    representation: Any = SimpleNamespace(mean=SimpleNamespace(device="there"))
    named = protocol_of(extractor={"_target_": "x", "path": "a"})
    for path, used in ((None, "a"), ("b", "b")):
        assert named.open_extractor(path, representation, "d") is not None
        assert opened[-2:] == [(used, "there"), (representation, "d")]
    assert named.open_extractor("none", representation, "d") is None
    assert protocol_of().open_extractor("b", representation, "d") is None
    with pytest.raises(UserError, match="needs a feature extractor"):
        protocol_of(extractor={"_target_": "x"}).open_extractor(None, representation, "d")


def test_a_drawn_clip_has_the_tags_of_its_caption_and_the_attributes_that_rules_read():
    tags = [["a/DET"], ["b/NOUN", "c/VERB"]]
    facts = {"action": "walk", "count": 0, "while": "wave", "take": 3, "tokens": tags}
    clip = entry_of("x", 50, 2, **facts)
    row = DrawnClip("x", clip, np.arange(50), 1, "x")
    assert (row.text, row.tokens(row.text), row.tokens("x 0")) == ("x 1", tags[1], tags[0])
    assert row.tokens("another caption") is None
    assert row.requested == {"action": "walk", "count": 0, "while": "wave"}
    assert replace(row, clip=entry_of("x", 50, 2)).tokens("x 0") is None


def test_a_clip_that_is_one_frame_longer_than_the_motion_has_two_windows():
    clips = clips_of(np.arange(100, dtype=np.float32)[:, None])
    rows = [replace(row, frames=np.arange(99)) for row in rows_of([1] * 40)]
    motions = Baseline("real", clips, "text", 0)("", rows, 0).features
    assert {int(motion[0, 0]) for motion in motions} == {0, 1}
    whole = [replace(row, frames=np.arange(100)) for row in rows]
    motions = Baseline("real", clips, "text", 0)("", whole, 0).features
    assert {(int(motion[0, 0]), len(motion)) for motion in motions} == {(0, 100)}


@pytest.mark.parametrize("condition", ["text", "action"])
def test_motions_of_two_captions_or_actions_in_equal_numbers_can_be_shuffled(
    condition: str,
):
    entries = [
        SimpleNamespace(length=1, captions=["a", "b"], action=number % 2) for number in range(8)
    ]
    rows = [
        DrawnClip(f"{number}", cast(Any, entry), np.array([number]), number % 2, "")
        for number, entry in enumerate(entries)
    ]
    clips = clips_of(np.arange(8, dtype=np.float32)[:, None])

    def shuffled(seed: int, replication: int, count: int = 8) -> list[int]:
        chosen = rows if count == 8 else [*rows[:6], rows[0]]
        baseline = Baseline("shuffled", clips, condition, seed)
        return [int(motion[0, 0]) for motion in baseline("", chosen, replication).features]

    assert sorted(shuffled(0, 0)) == list(range(8))
    assert all((new - number) % 2 for number, new in enumerate(shuffled(0, 0)))
    with pytest.raises(UserError, match="4 of 7 motions have the same caption or label"):
        shuffled(0, 0, 7)


@pytest.mark.parametrize("lacking", [0, 1, 4])
def test_one_clip_without_a_caption_or_a_label_is_enough_to_refuse_a_protocol(lacking: int):
    entries = [replace(entry_of(f"{number}", 50), action=0) for number in range(5)]
    entries[lacking] = entry_of(f"{lacking}", 50, 0)
    clips = split_of(*entries)
    clips.store = SimpleNamespace(info={"dataset": "d"})
    for condition in ("text", "action"):
        with pytest.raises(UserError, match=f"the data set d has clips without {condition}"):
            protocol_of(condition=condition).check(clips, None)
    protocol_of(condition="none").check(clips, None)


@pytest.mark.parametrize("count", [64, 65, 130])
def test_all_motions_are_measured_and_paired_however_many_there_are(count: int):
    """Motion i has i % 3 + 3 frames and is 0.1 i m above the floor and above its real motion."""
    targets = {"floating": "physics.Floating", "displacement": "reconstruction.DisplacementErrors"}
    metrics = {name: {"_target_": f"evaluators.metrics.{x}"} for name, x in targets.items()}
    evaluator = Evaluator(None, metrics, HumanML())
    joints = [
        torch.zeros(number % 3 + 3, 22, 3) + torch.tensor([0.0, 0.1 * number, 0.0])
        for number in range(count)
    ]
    keys = torch.tensor([key(str(number)) for number in range(count)])
    generated = {"joints": joints, "keys": keys}
    paired = {"joints": [torch.zeros_like(motion) for motion in joints]}
    values, reasons = evaluator.score(generated, paired, {}, seed=0)
    frames, heights = np.arange(count) % 3 + 3, 0.1 * np.arange(count)
    assert reasons == {}
    assert values == pytest.approx(
        {
            "floating": (frames * heights).sum() / frames.sum(),
            **dict.fromkeys(("displacement/ade", "displacement/fde"), heights.mean()),
        }
    )


@pytest.mark.parametrize("condition", ["text", "action", "none"])
def test_a_model_gets_the_seed_the_replication_and_the_condition_of_the_protocol(condition: str):
    asked: list[tuple[Any, dict[str, Any]]] = []

    def generate(batch: Any, options: Any, **more: Any) -> torch.Tensor:
        asked.append((batch, {"options": options} | more))
        return torch.arange(2 * 5 * 2).view(2, 5, 2)

    model: Any = SimpleNamespace(
        generate=generate,
        device="cpu",
        denoiser=SimpleNamespace(context_frames=0),
        representation=SimpleNamespace(features=2, denormalize=lambda x: 10 * x),
    )
    entries = [replace(entry_of(name, 50), action=action) for name, action in (("a", 3), ("b", 0))]
    rows = [
        DrawnClip(entry.id, entry, np.arange(frames), 1, "")
        for entry, frames in zip(entries, (5, 2), strict=True)
    ]
    options = SamplerOptions(guidance_scale=0.0)
    source = Generator(
        model,
        protocol_of(condition=condition),
        split_of(*entries),
        options,
        {},
        4,
        2,
        progress=False,
    )
    motions = source._sample(rows, 3)
    ((batch, more),) = asked
    assert more == {
        **{"options": options, "replication": 3, "seed": 4, "edit": None, "prefix": None},
        "unconditioned": condition == "none",
    }
    assert (batch.ids, batch.x.shape, batch.mask.sum(1).tolist()) == (["a", "b"], (2, 5, 2), [5, 2])
    assert batch.text == (["a 1", "b 1"] if condition == "text" else None)
    labels = None if batch.action is None else batch.action.tolist()
    assert labels == ([3, 0] if condition == "action" else None)
    np.testing.assert_array_equal(motions[0], 10 * np.arange(10).reshape(5, 2))
    np.testing.assert_array_equal(motions[1], 10 * np.arange(10, 14).reshape(2, 2))
