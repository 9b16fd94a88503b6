"""Rules of evaluations, without a model: folders of motions, numbers of motions, and bounds of real motions."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from evaluators.evaluation import Evaluation
from evaluators.evaluation_request import EvaluationRequest
from evaluators.plan import Plan
from evaluators.protocol import Protocol
from evaluators.results import Outcome, Scores
from flame_mdm.data import advice_on_splits
from flame_mdm.data.crops import Units
from flame_mdm.data.folder import Folder
from flame_mdm.data.synthetic import Synthetic
from flame_mdm.errors import UserError
from flame_mdm.records import Value
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


def folder_of(tmp_path: Path, **options: Any) -> Path:
    """The folder of motions of a checkpoint that is sampled with these options."""
    (tmp_path / "model.ckpt").write_bytes(b"weights")
    protocol = SimpleNamespace(samples=None, title="p-3", batch_size=None)
    sampling = SamplerOptions(**BASE | options).chosen() | {"edit": {}}
    data = SimpleNamespace(store=SimpleNamespace(fingerprint="f00d"))
    plan = cast(Plan, SimpleNamespace(sampling=sampling, data=data, batch_size=64))
    request = EvaluationRequest(ckpt=str(tmp_path / "model.ckpt"))
    return Plan._motions_folder(plan, request, tmp_path / "model.ckpt", cast(Protocol, protocol))


@pytest.mark.parametrize("name", CHANGES)
def test_motions_of_other_sampling_options_have_another_folder(name: str, tmp_path: Path):
    assert folder_of(tmp_path) == folder_of(tmp_path)
    assert folder_of(tmp_path, **CHANGES[name]) != folder_of(tmp_path)


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
