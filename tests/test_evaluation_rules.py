"""Rules of evaluations, without a model: folders of motions, numbers of motions, and bounds of real motions."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch

from evaluators.callback import Evaluate
from evaluators.evaluation import Evaluation
from evaluators.evaluation_request import EvaluationRequest
from evaluators.evaluator import Evaluator, Motions
from evaluators.plan import Plan
from evaluators.protocol import DrawnClip, Protocol
from evaluators.results import Outcome, Scores, _cell, mean_cost
from evaluators.sources import Baseline, Generator
from flame_mdm.data import advice_on_splits
from flame_mdm.data.crops import Units
from flame_mdm.data.folder import Folder
from flame_mdm.data.synthetic import Synthetic
from flame_mdm.errors import UserError
from flame_mdm.records import Cost, Value
from flame_mdm.representations.humanml import HumanML
from flame_mdm.sampler_options import SamplerOptions

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
    result = SimpleNamespace(values={}, ground_truth={})
    callback.next = 3  # the step from which training begins
    trainer: Any = SimpleNamespace(global_step=0, is_global_zero=False)

    def run(source: Any, *, ground_truth: bool, force: bool) -> Any:
        ran.append(trainer.global_step)
        assert force
        return result

    callback.evaluation = cast(Any, SimpleNamespace(protocol=None, clips=None, run=run))
    for step in (0, 3, 4, 9, 10, 11, 19, 27, 29, 30):
        trainer.global_step = step
        callback.on_validation_epoch_start(trainer, module)
    assert ran == [3, 10, 27, 30]
