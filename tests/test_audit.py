"""Evaluator audits: measurement, resumption, cards, and links to them."""

import json
import re
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from support.fixtures import ROOT

from evaluators import perturbations
from evaluators.audit import _agreement, _differences, _inputs, _interval, _Measure
from evaluators.evaluator import Evaluator, Motions
from evaluators.extractors import Extractor
from evaluators.metrics.alignment import MotionsForText, TextsForMotion
from evaluators.metrics.distribution import frechet_distance
from evaluators.metrics.diversity import Diversity
from evaluators.metrics.samples import SampleMetric
from evaluators.perturbations import BASE, PERTURBATIONS, REAL
from evaluators.protocol import DrawnClip, load_protocol
from evaluators.scene import Scene, Text, text_of
from flame_mdm.__main__ import main
from flame_mdm.data.store import Entry
from flame_mdm.data.synthetic import Synthetic
from flame_mdm.errors import UserError
from flame_mdm.records import AuditCard, AuditedPerturbation
from flame_mdm.reporting.audit_cards import (
    CitedCard,
    ListedCard,
    Seen,
    _curve,
    card_name,
    card_of,
    findings,
    read_card,
    seen,
    write_card,
)
from flame_mdm.representations.humanml import HumanML
from flame_mdm.representations.skeleton import SMPL22
from flame_mdm.safe_io import write_json
from flame_mdm.schemas import check_shape, read_json
from flame_mdm.seeds import key


class Linear(Extractor):
    """A random linear map of mean features, and a vector per caption."""

    sha256 = "0" * 64

    def check(self, representation, dataset): ...

    def motions(self, features, joints, mask):
        generator = torch.Generator().manual_seed(0)
        mean = (features * mask[..., None]).sum(1) / mask.sum(1, keepdim=True)
        return {"features": mean @ torch.randn(features.shape[-1], 3, generator=generator)}

    def texts(self, captions, tokens):
        rows = [
            torch.randn(3, generator=torch.Generator().manual_seed(key(text))) for text in captions
        ]
        return torch.stack(rows)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Metric inputs of 40 clips from the audit and from an evaluation."""
    representation = HumanML()
    protocol = load_protocol("synthetic", representation)
    physics = load_protocol("text_to_motion_2026", representation).metrics
    metrics = protocol.metrics | {
        name: physics[name] for name in ("claims", "mbench", "kimodo", "edge")
    }
    evaluator = Evaluator(
        Linear(), {k: v for k, v in metrics.items() if k != "diversity"}, representation
    )
    clips = list(Synthetic(clips=40, seed=5).clips(20.0))
    features = [
        representation.encode(torch.from_numpy(np.asarray(clip.motion))).numpy() for clip in clips
    ]
    ids, captions = (
        [clip.id for clip in clips],
        [clip.captions[0] + "." * i for i, clip in enumerate(clips)],
    )
    requested: list[Mapping[str, Any]] = [dict(clip.attributes) for clip in clips]
    found = evaluator.extract(Motions(ids, features, captions, inputs={"requested": requested}))
    other = evaluator.extract(Motions(ids, [x[8:] for x in features]))
    values, _ = evaluator.score(found, found, other, 0)
    folder = tmp_path_factory.mktemp("cache")
    sets = {
        name: _inputs(evaluator, folder / f"{name}.npz", ids, lambda x=x: x)
        for name, x in (
            (BASE, features),
            ("as stored", features),
            (REAL, [x[8:] for x in features]),
        )
    }
    texts = [
        Text(caption, None, attributes)
        for caption, attributes in zip(captions, requested, strict=True)
    ]
    measure = _Measure(evaluator, sets, texts, np.random.default_rng(0), 50)
    return measure, sets, texts, values, found


def test_values_without_resampling_are_those_of_an_evaluation(scene):
    measure, sets, texts, values, _ = scene
    found = measure(sets[BASE], texts)
    compared = {name: found[name][0] for name in found if name in values and "_for_" not in name}
    assert {
        "fid",
        "mm_dist",
        "mclip_score",
        "mid",
        "jitter",
        "foot_skating",
        "attributes/action",
    } <= compared.keys()
    assert {
        "claims/all",
        "claims/side",
        "mbench/foot_floating",
        "kimodo/skate_ratio",
        "kimodo/contact_consistency",
    } <= compared.keys()
    assert compared == pytest.approx({name: values[name] for name in compared}, rel=1e-9)
    assert not any(name.startswith("edge") for name in found), "not defined at 20 frames per second"


def test_retrieval_is_the_mean_over_pools(scene, subtests):
    measure, sets, texts, _, extracted = scene
    values = measure(sets[BASE], texts)
    rows = {name: extracted[name] for name in ("generated", "text", "text_keys", "keys")}
    for name, metric in (
        ("texts_for_motion", TextsForMotion),
        ("motions_for_text", partial(MotionsForText, normalize=True)),
    ):
        with subtests.test(name=name, metric=metric):
            drawn = []
            for seed in range(60):
                one = metric(seed=seed)
                one.update(**rows)
                drawn.append(one.compute()["top3"])
            assert values[f"{name}/top3"][0] == pytest.approx(np.mean(drawn), abs=0.02)


def test_intervals_are_those_of_a_bootstrap_over_motions(scene):
    measure, sets, texts, _, _ = scene
    cosines = measure.scores(sets[BASE], texts)["mclip_score"]
    resampled = measure(sets[BASE], texts)["mclip_score"][1:]
    assert resampled.std() == pytest.approx(cosines.std() / len(cosines) ** 0.5, rel=0.25)
    # Only the captions differ, which the metric does not see.
    assert (measure(sets[BASE], texts)["fid"] == measure(sets[BASE], texts[::-1])["fid"]).all()


@pytest.fixture(scope="module")
def card() -> AuditCard:
    """A card with a metric that sees from 2 on, clearly from 5, and one that rewards."""
    grades = {1: 0.1, 2: 0.5, 5: 2.0}
    values = [
        {
            "grade": float(g),
            "values": {"fid": [1 + d, 0.3, d, 0.2], "jitter": [9 - d, 5.0, -d, 0.01]},
        }
        for g, d in grades.items()
    ]
    shared = {"group": "joints", "about": "noise <b>", "unit": "mm"}
    still = [{"grade": 1.0, "values": {"fid": [1.0, 0.9, 0.0, 0.0], "jitter": [None] * 4}}]
    content = {
        **{
            "format": 1,
            "split": "test",
            "motions": 40,
            "seed": 0,
            "resamples": 10,
            "packages": {"torch": "2"},
        },
        "extractor": {"sha256": "ab" * 32, "name": "motion_clip/x"},
        "protocol": {"name": "text_to_motion", "version": 1},
        "data": {"dataset": "x", "fingerprint": "f", "frames": [24, 60]},
        "metrics": {"fid": False, "jitter": False},
        "real": {"fid": [1.0, 0.9], "jitter": [9.0, 5.0]},
        "perturbations": [
            {"name": "noise", "grades": values, **shared},
            {"name": "still", "grades": still, **shared},
        ],
        **{"not_computed": {}, "truth": {"fid": {"auc": 0.9, "correlation": -0.5}}},
    }
    return check_shape(content, AuditCard)


def test_a_grade_is_seen_from_where_all_stronger_ones_differ_and_findings_are_sentences(card):
    noise, still = card.perturbations
    assert seen(card, noise, "fid") == Seen(2.0, 5.0, rewarded=False, monotone=True)
    assert seen(card, noise, "jitter") == Seen(1.0, None, rewarded=True, monotone=True)
    assert seen(card, still, "fid") == Seen(None, None, rewarded=False, monotone=True)
    assert seen(card, still, "jitter") is None
    back = noise.model_dump()
    back["grades"][2]["values"]["fid"] = [1.1, 0.3, 0.1, 0.2]
    assert seen(card, check_shape(back, AuditedPerturbation), "fid") == Seen(
        None, None, rewarded=False, monotone=False
    )
    assert findings(card) == [
        "No metric detects these perturbations: still.",
        "jitter is better for these perturbations than for real motions: noise.",
    ]


def test_pages_escape_and_show_one_card_or_two(card, tmp_path, subtests):
    page, text = write_card([card], tmp_path)
    assert page.name.startswith("x-abababababab-40-")
    assert page.read_text().count("<polyline") == 2
    assert "| noise (mm) | 2 → 5 | 1 → – |" in text.read_text()
    fewer = {
        "extractor": None,
        "metrics": {"jitter": False},
        "perturbations": card.perturbations[:1],
    }
    page, text = write_card([card, card.model_copy(update=fewer)], tmp_path)
    assert "-and-x-none-40-" in page.name
    assert "None" not in text.read_text(), "a card without an extractor names none"
    assert "| noise (mm) | 2 → 5 / not computed | 1 → – / 1 → – |" in text.read_text()
    assert page.read_text().count("<polyline") == 3
    content = card.model_dump_json()
    for own in (
        '"jitter"',
        '"mm"',
        '"noise <b>"',
        '"motion_clip/x"',
        '"test"',
        '"torch"',
        '"x"',
        '"f"',
    ):
        content = content.replace(own, json.dumps("<img src=x onerror=alert(1)>"))
    for path in write_card([check_shape(json.loads(content), AuditCard)], tmp_path, "escaped"):
        with subtests.test(path=path.name):
            assert "<img" not in path.read_text()
            assert path.read_text().count("&lt;img src=x onerror=alert(1)&gt;") > 10


def test_a_value_at_some_grades_is_not_shown_as_one_at_all_grades(card, tmp_path):
    lacking = card.perturbations[0].model_dump()
    lacking["grades"][1]["values"]["fid"] = [None] * 4
    partial_card = card.model_copy(
        update={"perturbations": [check_shape(lacking, AuditedPerturbation)]}
    )
    _, text = write_card([partial_card], tmp_path)
    assert "| noise (mm) | not computed at 2 | 1 → – |" in text.read_text()


def test_the_strongest_card_that_fits_is_cited_and_a_weaker_one_overwrites_nothing(
    card, tmp_path, monkeypatch
):
    monkeypatch.setenv("FLAME_MDM_AUDITS", str(tmp_path))
    assert card_of(card.data, "ab" * 32) is None
    crop = card.data.model_copy(update={"frames": [24, 40]})
    for changes in ({}, {"motions": 8}, {"motions": 900, "data": crop}, {"motions": 41, "seed": 1}):
        changed = card.model_copy(update=changes)
        write_json(tmp_path / f"{card_name(changed)}.json", changed.model_dump())
    assert len(list(tmp_path.iterdir())) == 4, "every card is kept"
    cited = card_of(card.data, "ab" * 32)
    assert cited is not None
    assert (cited.motions, str(cited).endswith("(41 motions)"), cited.path.parent) == (
        41,
        True,
        tmp_path,
    )
    other = card_of(crop, "ab" * 32)
    assert other is not None
    assert other.motions == 900
    assert card_of(card.data, None) is None


class Halves(SampleMetric):
    """A metric that no other module knows."""

    higher_is_better = True
    unit = "halves"
    states = ("generated",)

    def per_sample(self, rows):
        values = rows["generated"][:, 0] / 2
        return {"": torch.stack([values, torch.ones_like(values)], 1)}


def test_an_audit_asks_metrics_that_it_does_not_know(scene):
    _, sets, texts, _, _ = scene
    evaluator = Evaluator(Linear(), {"halves": {"_target_": f"{__name__}.Halves"}}, HumanML())
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("evaluators.audit.make_metrics", lambda _: {"halves": Halves()})
        measure = _Measure(evaluator, sets, texts, np.random.default_rng(0), 20)
    values = measure(sets[BASE], texts)["halves"]
    expected = measure.weights @ sets[BASE]["features"][:, 0] / measure.weights.sum(1) / 2
    np.testing.assert_allclose(values, expected)
    assert measure.direction_of("halves") is True
    assert measure.facts_of("halves")["unit"] == "halves"
    assert measure.judges == {}


def test_agreement_with_exact_attributes_depends_on_whether_lower_is_better():
    """Pairs with every attribute have the best scores of both metrics; the scores get worse with each grade."""
    measure: Any = SimpleNamespace(
        truth="exact", judges={"distance": -1, "similarity": 1, "blind": 1}
    )
    scores = [
        {
            "exact": [1, 1, 1],
            "distance": [0.1, 0.2, 0.3],
            "similarity": [3, 2, 5],
            "blind": [7, 7, 7],
        },
        {
            "exact": [0, 1, 0],
            "distance": [0.9, 0.4, 0.8],
            "similarity": [0, 4, 1],
            "blind": [7, 7, 8],
        },
    ]
    scores = [
        {name: np.array(values, float) for name, values in of_set.items()} for of_set in scores
    ]
    grades = [
        {"exact": [0.9], "distance": [0.2], "similarity": [3.0], "blind": [7.0]},
        {"exact": [0.5], "distance": [0.4], "similarity": [1.0], "blind": [None]},
        {"exact": [0.1], "distance": [0.5], "similarity": [0.5], "blind": [8.0]},
    ]
    agreement = _agreement(measure, scores, [{"grades": [{"values": values} for values in grades]}])
    assert agreement["distance"] == pytest.approx({"auc": 1, "correlation": -1})
    assert agreement["similarity"] == pytest.approx({"auc": 1, "correlation": 1})
    assert agreement["blind"] == pytest.approx({"auc": 0.25, "correlation": -1}), (
        "grades without a value do not count"
    )


def refuse_inputs(folders: set[Path], evaluator: Evaluator, file: Path, *rest: object) -> None:
    """Takes the place of `_inputs`: records the folder and stops the audit."""
    folders.add(file.parent)
    raise UserError("stopped")


@pytest.mark.slow
def test_an_audit_resumes_and_gives_the_same_card(tmp_path, monkeypatch, capsys):
    names = (
        "jitter",
        "mirrored",
        "near misses",
        "missing actions",
        "memorized",
        "fewer",
        "half precision",
    )
    few = [perturbation for perturbation in PERTURBATIONS if perturbation.name in names]
    monkeypatch.setattr(perturbations, "PERTURBATIONS", few)
    passes: list[int] = []
    extract = Evaluator.extract
    monkeypatch.setattr(
        Evaluator, "extract", lambda self, x: passes.append(len(x)) or extract(self, x)
    )
    assert main(["prepare", "synthetic", "data.source.clips=200", f"data_root={tmp_path}"]) == 0
    (path,) = tmp_path.glob("synthetic-*/clips.jsonl")
    clips = path.read_text().count('"test"')
    words = [
        "audit",
        "data=synthetic",
        "data.source.clips=200",
        f"data_root={tmp_path}",
        "resamples=100",
    ]
    words += ["extractor=none", f"out={tmp_path / 'out'}"]
    assert main(words) == 0
    (path,) = (tmp_path / "out").glob("synthetic-none-*.json")
    card, first = read_card(path), len(passes)
    assert card.motions == clips == passes[0]
    assert [perturbation.name for perturbation in card.perturbations][:2] == ["jitter", "mirrored"]
    by_name = {perturbation.name: perturbation for perturbation in card.perturbations}
    truth = [grade.values["attributes/all"][0] or 0 for grade in by_name["near misses"].grades]
    assert sorted(truth, reverse=True) == truth
    # Exact attributes see every wrong caption
    assert (card.real["attributes/all"][0] or 0) > 0.95 > truth[-1]
    jitter = seen(card, by_name["jitter"], "jitter")
    assert (jitter and jitter.grade, "fid" in card.metrics) == (1, False)
    assert card.not_computed == {"extractor": "metrics that need features"}
    before = json.loads(path.read_text())
    min((tmp_path / "out" / "cache").glob("*/*.npz")).unlink()
    assert main(words) == 0
    assert len(passes) == first + 1
    assert json.loads(path.read_text()) == before
    folders: set[Path] = set((tmp_path / "out" / "cache").iterdir())
    monkeypatch.setattr("evaluators.audit._inputs", partial(refuse_inputs, folders))
    protocol = (ROOT / "experiments" / "evaluation" / "synthetic.yaml").read_text()
    for number, text in enumerate((protocol, protocol.replace("pairs: 300", "pairs: 200"))):
        (tmp_path / "synthetic.yaml").write_text(text)
        assert main([*words, f"protocol={tmp_path / 'synthetic.yaml'}"]) == 1
        assert len(folders) == 1 + number, "another protocol has its own inputs"
    assert main([*words[:-2], "extractor=missing.ckpt", words[-1]]) == 1
    assert main(["audit", "data=synthetic"]) == 1
    assert "extractor=none" in capsys.readouterr().err


@pytest.mark.usefixtures("composed_once")
def test_the_command_audits_real_test_motions_under_the_protocol_of_the_data(
    tmp_path, monkeypatch, capsys
):
    audited: list[Any] = []

    def audit(*values: Any) -> None:
        audited.append(values)
        raise UserError("audited")

    monkeypatch.setattr("evaluators.audit.audit", audit)
    for data, protocol in (("synthetic", "synthetic"), ("bandai", "text_to_motion")):
        words = [f"data={data}", "extractor=none", "samples=8", "seed=3", f"out={tmp_path}"]
        assert main(["audit", *words]) == 1
        ((request, cache, resamples),) = audited
        assert (request.data["name"], request.protocol) == (data, protocol)
        assert (request.baseline, request.split, request.samples) == ("real", "test", 8)
        assert (cache, resamples) == (tmp_path / "cache", 100)
        audited.clear()
    for few in ("samples=7", "resamples=99"):
        assert main(["audit", "data=synthetic", "extractor=none", few]) == 1
        assert f"{few}" in (error := capsys.readouterr().err)
        assert "too few" in error
    assert not audited


CARDS = sorted((ROOT / "docs" / "benchmarks" / "audit").glob("*.json"))


@pytest.mark.parametrize("path", CARDS, ids=lambda path: path.stem)
def test_committed_cards_are_listed_complete_and_small(path, tmp_path, subtests):
    listed = json.loads((ROOT / "flame_mdm" / "reporting" / "audited.json").read_text())
    assert [card["name"] for card in listed] == [p.stem for p in CARDS]
    card = read_card(path)
    sha256 = card.extractor.sha256 if card.extractor else None
    facts = {"extractor": sha256 and sha256[:12], "motions": card.motions, "split": card.split}
    assert next(x for x in listed if x["name"] == path.stem).items() >= facts.items()
    assert card_of(card.data, sha256) == CitedCard(
        Path("docs/benchmarks/audit") / f"{path.stem}.html", card.motions, card.split, card.data
    )
    for written in write_card([card], tmp_path, path.stem):
        with subtests.test(written=written.name):
            kept = path.with_suffix(written.suffix)
            assert kept.read_bytes() == written.read_bytes(), (
                f"flame-mdm audit cards={path} out={path.parent}"
            )
            assert kept.stat().st_size <= 300_000
    assert card.motions >= 368
    by_name = {perturbation.name: perturbation for perturbation in card.perturbations}
    for name in ("wrong captions", "near misses"):
        with subtests.test(name=name):
            responses = {metric: seen(card, by_name[name], metric) for metric in card.metrics}
            noticed = {
                metric
                for metric, response in responses.items()
                if response and response.grade is not None
            }
            assert "fid" not in noticed
            assert bool(noticed) == any(fact.sees_meaning for fact in card.facts.values())


def scene_of(count: int = 40) -> Scene:
    """Motions of ten actions, whose captions name the action and, for the first five, a side."""
    rows = []
    for number in range(count):
        action, side = number % 10, ("left", "right")[number // 10 % 2]
        attributes: dict[str, Any] = {"action": f"action {action}"}
        if action < 5:
            attributes["side"] = side
        stated = " ".join(map(str, attributes.values()))
        captions = [stated, f"{stated} again"]
        entry = Entry(f"clip {number}", 0, 40, "test", "", captions, action, attributes)
        rows.append(DrawnClip(entry.id, entry, np.arange(40), 0, entry.id))
    features = [np.full((40, 2), number, np.float32) for number in range(count)]
    return Scene(cast(Any, None), rows, features, cast(Any, SimpleNamespace(fps=20.0)), 0)


def listed(name: str) -> Any:
    return next(perturbation for perturbation in PERTURBATIONS if perturbation.name == name)


def numbered(scene: Scene) -> dict[str, Any]:
    """Sets of motions whose numbers are the index of the motion, negative in the perturbed set."""
    numbers = np.arange(len(scene))[:, None] + np.zeros((1, 3))
    return {BASE: {"x": numbers}, "mirrored": {"x": -1 - numbers}}


def test_a_share_of_the_motions_is_replaced_and_larger_shares_contain_smaller_ones():
    scene = scene_of(39)
    texts = [text_of(row, row.text) for row in scene.rows]
    before: set[int] = set()
    for grade, count in ((5, 2), (10, 4), (20, 8), (50, 20), (100, 39)):
        inputs, same = listed("mirrored").apply(scene, grade, numbered(scene), texts)
        replaced = {int(-1 - x) for x in inputs["x"][:, 0] if x < 0}
        assert (len(replaced), before <= replaced, same is texts) == (count, True, True)
        kept = [int(x) for x in inputs["x"][:, 0] if x >= 0]
        assert sorted({*kept, *replaced}) == list(range(39))
        before = replaced


def test_captions_are_replaced_up_to_the_share_of_motions_that_have_wrong_ones():
    scene = scene_of()
    texts = [text_of(row, row.text) for row in scene.rows]
    (near,) = listed("near misses").offered(scene, True)
    assert near.grades == [1, 2, 5, 10, 20, 50.0]
    (everything,) = listed("wrong captions").offered(scene, True)
    assert everything.grades == [1, 2, 5, 10, 20, 50, 100.0]
    assert listed("near misses").offered(scene, False) == []
    for perturbation, grade, count in (
        (near, 20, 8),
        (near, 50, 20),
        (everything, 5, 2),
        (everything, 100, 40),
    ):
        inputs, changed = perturbation.apply(scene, grade, numbered(scene), texts)
        assert inputs is not None
        assert (inputs["x"][:, 0] == np.arange(40)).all()
        wrong = [i for i in range(40) if changed[i] != texts[i]]
        assert len(wrong) == count
        for i in wrong:
            assert changed[i].caption not in scene.rows[i].clip.captions
            if perturbation is near:
                assert changed[i].requested["action"] == texts[i].requested["action"]


def test_dropped_actions_never_appear_and_the_others_are_repeated_with_their_texts():
    scene = scene_of()
    texts = [text_of(row, row.text) for row in scene.rows]
    before: set[int] = set()
    for grade, count in ((1, 1), (25, 2), (50, 5), (75, 8)):
        inputs, kept = listed("missing actions").apply(scene, grade, numbered(scene), texts)
        motions = inputs["x"][:, 0].astype(int).tolist()
        gone = set(range(10)) - {scene.actions[i] for i in motions}
        assert (len(gone), before <= gone, len(motions)) == (count, True, 40)
        assert [text.caption for text in kept] == [texts[i].caption for i in motions]
        stay = [i for i in range(40) if scene.actions[i] not in gone]
        assert all(motions[i] == i for i in stay)
        assert max(motions.count(i) for i in stay) <= 2 + 40 // len(stay)
        before = gone
    one = replace(scene, rows=scene.rows[:1])
    assert listed("missing actions").offered(one, True) == []


def test_fewer_motions_are_the_first_ones():
    scene = scene_of(100)
    texts = [text_of(row, row.text) for row in scene.rows]
    (fewer,) = listed("fewer").offered(scene, True)
    assert fewer.grades == [64]
    inputs, kept = fewer.apply(scene, 64, numbered(scene), texts)
    assert (inputs["x"][:, 0].tolist(), kept) == (list(range(64)), texts[:64])
    assert listed("fewer").offered(scene_of(64), True) == []


def test_changes_of_joints_have_the_draws_of_the_motion_and_the_sign_of_their_grade(monkeypatch):
    seen: list[tuple[float, float, Any]] = []

    def change(joints: Any, grade: float, draws: np.random.Generator, fps: float) -> Any:
        seen.append((grade, draws.uniform(), fps))
        return joints

    monkeypatch.setattr(perturbations, "encode", lambda representation, motions: motions)
    scene = scene_of(3)
    scene.__dict__["joints"] = [np.zeros((4, 22, 3))] * 3
    changed = perturbations.ChangedJoints(
        "x", "joints", "", "cm", (1, 2.5), change, ["draws", "fps"], sign=-1
    )
    sets = changed.motions(scene)
    assert list(sets) == ["x 1", "x 2.5"]
    for make in sets.values():
        make()
    grades, draws, rates = zip(*seen, strict=True)
    assert grades == (-1, -1, -1, -2.5, -2.5, -2.5)
    assert draws[:3] == draws[3:]
    assert len(set(draws)) == 3
    assert set(rates) == {20.0}


def test_the_grades_of_an_audit_are_those_that_its_page_states():
    signs = {p.name: p.sign for p in PERTURBATIONS if isinstance(p, perturbations.ChangedJoints)}
    assert {name for name, sign in signs.items() if sign < 0} == {"sinking", "shorter bones"}
    grades = {p.name: (p.unit, tuple(p.grades)) for p in PERTURBATIONS}
    lengths = (1, 2, 5, 10, 20)
    shares = ("% of motions", (5, 10, 20, 50, 100))
    expected: dict[str, tuple[str, tuple[float, ...]]] = {
        **{"jitter": ("mm", lengths), "wobble": ("mm", (5, 10, 20, 50))},
        **{"skating": ("x", (1.05, 1.1, 1.25, 1.5, 2)), "arms inside": ("cm", (10, 20, 30))},
        **dict.fromkeys(("floating", "sinking"), ("cm", (1, 2, 5, 10))),
        **dict.fromkeys(("longer bones", "shorter bones"), ("%", lengths)),
        **dict.fromkeys(("pop", "last-frame pop"), ("cm", lengths)),
        **dict.fromkeys(
            ("mirrored", "reversed", "other half", "memorized", "dropped repetition"), shares
        ),
        **{"slower": ("x", (0.9, 0.75, 0.5)), "faster": ("x", (1.1, 1.25, 1.5, 2))},
        **{"frozen": ("% of time", (10, 25, 50, 75, 100)), "cropped": ("% of time", (10, 25, 50))},
        **{"frame rate": ("fps", (30, 15, 10)), "fewer": ("motions", (256, 128, 64))},
        "missing actions": ("% of actions", (10, 25, 50, 75)),
    }
    assert {name: grades[name] for name in expected} == expected


def test_a_difference_is_seen_if_it_exceeds_its_interval_and_rounding(card):
    metrics = ("fid", "jitter")

    def response(*grades: tuple[float, float]) -> Seen | None:
        values = [
            {"grade": float(n), "values": {m: [1.0 + d, 0.3, d, half] for m in metrics}}
            for n, (d, half) in enumerate(grades, 1)
        ]
        facts = {"name": "n", "group": "joints", "about": "", "unit": ""}
        return seen(card, check_shape(facts | {"grades": values}, AuditedPerturbation), "fid")

    for grades, grade, outside in (
        ([(0.1, 0.1), (0.2, 0.1)], 2.0, None),  # the first difference is as large as its interval
        ([(2e-6, 0.0)], 1.0, None),
        ([(0.9e-6, 0.0)], None, None),
        ([(0.9, 0.1)], 1.0, None),  # as wide as the interval of real motions, 0.9
        ([(0.91, 0.1)], 1.0, 1.0),
        ([(0.5, 0.1), (0.0, 0.1), (0.5, 0.1)], 3.0, None),
    ):
        reaction = response(*grades)
        assert reaction is not None
        assert (reaction.grade, reaction.outside) == (grade, outside), grades
    falling = response((0.5, 0.1), (0.39, 0.1))
    assert falling is not None
    assert not falling.monotone
    level = response((0.5, 0.1), (0.41, 0.1))
    assert level is not None
    assert level.monotone


def bodies(monkeypatch: pytest.MonkeyPatch, count: int = 6) -> Scene:
    """Motions of 40 and more frames whose features are their joint positions, all different."""
    monkeypatch.setattr(perturbations, "encode", lambda representation, motions: motions)
    scene, generator = scene_of(count), np.random.default_rng(0)
    scene.representation = cast(Any, SimpleNamespace(fps=20.0, skeleton=SMPL22))
    scene.__dict__["joints"] = [
        generator.normal(size=(40 + number, 22, 3)).cumsum(0) for number in range(count)
    ]
    return scene


def set_of(name: str, scene: Scene) -> list[np.ndarray]:
    """The motions of a perturbation with one set."""
    ((_, make),) = listed(name).motions(scene).items()
    return make()


def test_mirrored_reversed_and_rounded_motions_are_those_of_the_scene(monkeypatch):
    scene = bodies(monkeypatch)
    names = SMPL22.joints
    for x, mirrored, backward, rounded in zip(
        scene.joints,
        set_of("mirrored", scene),
        set_of("reversed", scene),
        set_of("half precision", scene),
        strict=True,
    ):
        for joint, name in enumerate(names):
            swap = {"left": "right", "right": "left"}
            side, _, part = name.partition("_")
            other = f"{swap[side]}_{part}" if side in swap else name
            np.testing.assert_allclose(mirrored[:, names.index(other)], x[:, joint] * [-1, 1, 1])
        np.testing.assert_array_equal(backward, x[::-1])
        np.testing.assert_array_equal(rounded, x.astype(np.float16))
    stored = set_of("as stored", scene)
    assert all(np.array_equal(a, b) for a, b in zip(stored, scene.features, strict=True))


def test_every_motion_continues_with_the_half_of_one_other_motion(monkeypatch):
    scene = bodies(monkeypatch)
    others = []
    for number, joined in enumerate(set_of("other half", scene)):
        joints = scene.joints[number]
        half = len(joints) // 2
        assert len(joined) == len(joints)
        np.testing.assert_array_equal(joined[:half], joints[:half])
        steps = np.diff(joined[half + 8 : half + 16], axis=0)  # after 0.4 s
        others += [
            index
            for index, other in enumerate(scene.joints)
            if np.allclose(np.diff(other[len(other) // 2 :][8:16], axis=0), steps)
        ]
        assert len(others) == number + 1
        assert others[-1] != number
    assert sorted(others) == list(range(6))


def test_a_repetition_is_cut_only_out_of_motions_that_repeat(monkeypatch):
    scene = bodies(monkeypatch, 4)
    angle = 2 * np.pi * np.arange(60) / 20  # three periods
    scene.joints[1] = np.sin(angle)[:, None, None] * np.linspace(0.5, 1, 66).reshape(1, 22, 3)
    counts: list[Any] = [1, 3, "many", None]
    for row, count in zip(scene.rows, counts, strict=True):
        row.clip.attributes.update({"count": count} if count else {})
    assert [perturbations.repetitions(row) for row in scene.rows] == [1, 3, 1, 1]
    changed = set_of("dropped repetition", scene)
    assert [len(x) for x in changed] == [40, 40, 42, 43]
    assert all(changed[number] is scene.joints[number] for number in (0, 2, 3))
    assert listed("dropped repetition").offered(scene, True) == [listed("dropped repetition")]
    assert listed("dropped repetition").offered(scene_of(4), True) == []


def test_memorized_motions_have_the_same_captions_or_else_the_same_action(monkeypatch):
    scene = scene_of(3)
    texts = [row.clip.captions for row in scene.rows]
    training = [
        Entry("same 1", 0, 30, "train", "", texts[0], 7, {}),
        Entry("same 2", 0, 50, "train", "", texts[0], 7, {}),
        Entry("same action", 0, 60, "train", "", ["other"], 0, {}),
        Entry("action 1", 0, 70, "train", "", ["one of " + texts[1][0]], 1, {}),
    ]
    splits = []

    def clips(split: str) -> Any:
        splits.append(split)
        return SimpleNamespace(clips=training, crop=lambda length, draws: np.arange(length // 2))

    scene.data = cast(Any, SimpleNamespace(clips=clips))
    monkeypatch.setattr(perturbations, "real_motions", lambda source, rows: rows)
    copies: Any = set_of("memorized", scene)
    chosen = [row.clip.id for row in copies]
    assert chosen[0] in ("same 1", "same 2")
    # No training motion shows the third action, so that the motion itself is kept
    assert chosen[1:] == ["action 1", "clip 2"]
    assert [len(row.frames) for row in copies] == [row.clip.length // 2 for row in copies]
    assert [row.id for row in copies] == ["clip 0", "clip 1", "clip 2"]
    assert splits == ["train"]
    drawn = {set_of("memorized", replace(scene, seed=seed))[0].clip.id for seed in range(20)}  # type: ignore[attr-defined]
    assert drawn == {"same 1", "same 2"}


def test_wrong_captions_are_of_other_motions_and_near_misses_differ_in_one_attribute():
    scene = scene_of()
    for row, count in zip(scene.rows, range(40), strict=True):
        row.clip.attributes["count"] = 1 + count // 20
        row.clip.captions[:] = [
            f"{name} {value}"
            for name, value in [("all", " ".join(map(str, row.clip.attributes.values())))]
        ]
    wrong = scene.wrong
    assert list(wrong) == [
        "wrong captions",
        "near misses",
        "near misses: count",
        "near misses: side",
    ]
    for number, row in enumerate(scene.rows):
        said = row.clip.attributes
        for kind, texts in wrong.items():
            text = texts[number]
            if text is None:
                assert kind == "near misses: side"
                assert "side" not in said
                continue
            differing = {
                name
                for name in said.keys() | text.requested
                if said.get(name) != text.requested.get(name)
            }
            if kind == "wrong captions":
                assert differing
            elif kind == "near misses":
                assert len(differing) == 1
                assert differing <= {"count", "side"}
            else:
                assert differing == {kind.removeprefix("near misses: ")}
    seen_attributes = {
        name
        for row, text in zip(scene.rows, wrong["near misses"], strict=True)
        if text
        for name in row.clip.attributes
        if row.clip.attributes[name] != text.requested[name]
    }
    assert seen_attributes == {"count", "side"}
    assert replace(scene, seed=1).wrong["wrong captions"] != wrong["wrong captions"]
    assert replace(scene).wrong == wrong


def test_intervals_are_95_percent_of_the_resamples_and_differences_are_paired():
    assert _interval(np.array([2.0, 1.0, 3.0, 1.0, 3.0])) == [2.0, 1.96]
    assert _interval(np.array([2.0, 1.0, np.nan])) == [None, None]
    base = {"fid": np.array([1.0, 3.0, 1.0]), "r": np.array([0.5, 0.5, 0.5])}
    changed = {"fid": np.array([4.0, 6.5, 3.5])}
    assert _differences(changed, base) == {
        "fid": [4.0, 2.94, 3.0, 0.98],
        "r": [None] * 4,
    }


def test_values_of_fewer_motions_are_those_of_the_first_ones(scene):
    measure, sets, texts, _, _ = scene
    few = {name: values[:16] for name, values in sets[BASE].items()}
    values = measure(few, texts[:16])
    generated = torch.from_numpy(sets[BASE]["features"][:16])
    real = torch.from_numpy(sets[REAL]["features"])
    for number in (0, 1, 50):
        times = torch.from_numpy(measure.weights[number])
        drawn = generated.repeat_interleave(times[:16], 0)
        expected = frechet_distance(drawn, real.repeat_interleave(times, 0)).item()
        assert values["fid"][number] == pytest.approx(expected)
    sums, counts = sets[BASE]["jitter"][:16].T
    np.testing.assert_allclose(
        values["jitter"],
        measure.weights[:, :16] @ sums / (measure.weights[:, :16] @ counts),
    )
    pairs = torch.cdist(generated, generated)
    diversity = Diversity(pairs=4, replace=True).weighted({"generated": generated}, measure.weights)
    for number in (0, 3):
        rows = torch.arange(16).repeat_interleave(torch.from_numpy(measure.weights[number, :16]))
        assert diversity[""][number] == pytest.approx(float(pairs[rows][:, rows].mean()))


def test_a_card_states_which_values_are_exact_and_what_they_depend_on(scene):
    measure, sets, texts, _, _ = scene
    facts = {name: measure.facts_of(name) for name in measure(sets[BASE], texts)}
    exact = {name for name, of_value in facts.items() if of_value["exact"]}
    assert exact == {name for name in facts if name.startswith("attributes/")}
    assert measure.truth == "attributes/all"
    assert facts["fid"]["depends_on_count"]
    assert not facts["jitter"]["depends_on_count"]
    assert (facts["jitter"]["unit"], facts["fid"]["unit"]) == ("m/s^3", "")
    assert [facts[f"attributes/{name}"]["sums_up"] for name in ("all", "action")] == [True, False]
    assert facts["attributes/action"]["sees_meaning"]
    assert not facts["jitter"]["sees_meaning"]
    assert measure.direction_of("fid") is False
    assert measure.direction_of("attributes/action") is True


def test_cards_of_the_same_lengths_the_test_split_and_the_same_data_come_first(card):
    def strength(motions: int, **changes: Any) -> tuple[Any, ...]:
        data = card.data.model_copy(
            update={name: changes[name] for name in ("frames", "fingerprint") if name in changes}
        )
        return CitedCard(Path("a"), motions, changes.get("split", "test"), data).strength(card.data)

    ranked = [
        strength(2),
        strength(1),
        strength(900, fingerprint="other"),
        strength(9000, split="train"),
        strength(90_000, frames=[24, 61]),
        strength(1, frames=[24, 61], split="train", fingerprint="other"),
    ]
    assert ranked == sorted(ranked, reverse=True)
    assert len(set(ranked)) == len(ranked)


def test_motions_pass_through_every_other_representation_of_their_skeleton_and_frame_rate():
    clean, legacy = (HumanML(variant=variant) for variant in ("clean", "legacy"))
    for representation, other in ((clean, legacy), (legacy, clean)):
        (through,) = perturbations.through_others(representation)
        assert (through.name, through.group) == (f"through {other.name}", "plumbing")
    assert perturbations.through_others(HumanML(fps=31)) == []


def card_with(card: AuditCard, perturbations: list[dict[str, Any]], **changes: Any) -> AuditCard:
    """A card with these perturbations, each with a name, a group, and the values of its grades."""
    content = card.model_dump() | {"perturbations": perturbations} | changes
    return check_shape(json.loads(json.dumps(content)), AuditCard)


def perturbed(
    name: str, group: str, *grades: tuple[float, dict[str, list[float | None]]]
) -> dict[str, Any]:
    values = [{"grade": grade, "values": metrics} for grade, metrics in grades]
    return {"name": name, "group": group, "about": f"about {name}", "unit": "", "grades": values}


SEES: list[float | None] = [2.0, 0.1, 1.0, 0.1]
BLIND: list[float | None] = [1.0, 0.1, 0.0, 0.1]
BETTER: list[float | None] = [0.5, 0.1, -0.5, 0.1]


def test_findings_name_what_one_metric_alone_sees_what_summaries_miss_and_biased_values(card):
    def of(fid: list[float | None], jitter: list[float | None]) -> tuple[float, dict[str, Any]]:
        return (0.5, {"fid": fid, "jitter": jitter})

    rows = [
        perturbed("both", "joints", of(SEES, SEES)),
        perturbed("joints only fid", "joints", of(SEES, BLIND)),
        perturbed("meaning only fid", "meaning", of(SEES, BLIND)),
        perturbed("nobody", "meaning", of(BLIND, BLIND)),
        perturbed("nobody:variant", "joints", of(BLIND, BLIND)),
        perturbed("memorized", "set", of(BLIND, BLIND)),
        perturbed("another set", "set", of(BLIND, BETTER)),
        perturbed("better", "joints", of(SEES, BETTER)),
        perturbed("fewer", "set", of(SEES, BLIND), (8.0, {"fid": [3.25, *SEES[1:]], "jitter": BLIND})),
    ]  # fmt: skip
    facts = {"jitter": {"sees_meaning": False}, "fid": {"depends_on_count": True}}
    real = {"fid": [1.0, 0.1], "jitter": [1.0, 0.1]}
    assert findings(card_with(card, rows, facts=facts, real=real)) == [
        "No metric detects these perturbations: nobody, memorized.",
        "Only fid detects these perturbations: joints only fid, meaning only fid.",
        "jitter does not detect these perturbations: joints only fid.",
        "jitter is better for these perturbations than for real motions: better.",
        "With 8 real motions, fid is 3.25. With all motions, decoded and encoded again, it is 1.",
    ]
    facts["jitter"] |= {"sums_up": False}
    lines = findings(card_with(card, rows, facts=facts, real=real))
    assert not any("jitter does not" in line for line in lines)


def test_cells_of_a_card_say_yes_for_a_single_grade_and_mark_what_is_not_monotone(card, tmp_path):
    first = (1.0, {"fid": SEES, "jitter": BLIND})
    rows = [
        perturbed("single", "joints", (0.5, {"fid": [3.0, 0.1, 2.0, 0.1], "jitter": BETTER})),
        perturbed("dips", "joints", first, (2.0, {"fid": [1.5, 0.1, 0.5, 0.1], "jitter": BLIND})),
        perturbed("within", "joints", first, (2.0, {"fid": [1.95, 0.1, 0.95, 0.1], "jitter": BLIND})),
    ]  # fmt: skip
    real = {"fid": [1.0, 0.9], "jitter": [1.0, 0.4]}
    page, text = write_card([card_with(card, rows, real=real)], tmp_path)
    lines = text.read_text().replace("\\", "").splitlines()
    assert "| single | yes | yes |" in lines
    assert "| dips | 1 → – ~ | – |" in lines
    assert "| within | 1 | – |" in lines
    kinds = re.findall(r'<span class="(\w+)">(?:yes|1 → – ~|1|–)</span>', page.read_text())
    assert kinds == ["seen", "bad", "weak", "faint", "seen", "faint"]


def test_the_curve_of_a_perturbation_spans_the_box_from_real_motions_to_the_strongest_grade(card):
    curve = _curve(card, card.perturbations[0], "fid")
    assert curve is not None
    points = [tuple(map(float, pair.split(","))) for pair in curve["line"].split()]
    assert [x for x, _ in points] == [3, 45, 87, 129]  # 3 pixels from the edges of 132
    means, halves = np.array([1.0, 1.1, 1.5, 3.0]), np.array([0.9, 0.3, 0.3, 0.3])
    low, high = (means - halves).min(), (means + halves).max()
    expected = 3 + 42 * (high - means) / (high - low)  # the largest values are at the top
    assert [y for _, y in points] == pytest.approx(expected, abs=0.06)
    band = [tuple(map(float, pair.split(","))) for pair in curve["band"].split()]
    assert [x for x, _ in band] == [3, 45, 87, 129, 129, 87, 45, 3]
    assert min(y for _, y in band) == 3
    assert max(y for _, y in band) == 45
    assert float(curve["level"]) == points[0][1]
    assert curve["text"] == "1 to 3"
    assert _curve(card, card.perturbations[1], "fid") is None  # it is constant


def test_the_name_of_a_card_depends_on_the_motions_and_resamples_but_not_on_its_values(card):
    changes: list[dict[str, Any]] = [
        {"seed": 1}, {"split": "train"}, {"resamples": 11}, {"motions": 41}, {"extractor": None},
        {"data": card.data.model_copy(update={"fingerprint": "g"})},
        {"data": card.data.model_copy(update={"frames": [24, 61]})},
        {"protocol": card.protocol.model_copy(update={"version": 2})},
    ]  # fmt: skip
    names = {card_name(card.model_copy(update=change)) for change in changes}
    assert len(names | {card_name(card)}) == len(changes) + 1
    assert card_name(card.model_copy(update={"real": {}, "packages": {}})) == card_name(card)


def test_a_card_of_another_data_set_is_not_cited(card, tmp_path, monkeypatch):
    monkeypatch.setenv("FLAME_MDM_AUDITS", str(tmp_path))
    longer = card.model_copy(update={"data": card.data.model_copy(update={"dataset": "x-y"})})
    write_json(tmp_path / f"{card_name(longer)}.json", longer.model_dump())
    assert card_of(card.data, "ab" * 32) is None
    other = card_of(longer.data, "ab" * 32)
    assert other is not None
    assert other.path == tmp_path / f"{card_name(longer)}.html"


def test_metrics_that_are_exact_are_the_last_columns_and_facts_state_the_conditions(card, tmp_path):
    facts = {"fid": {"exact": True}}
    values = {"seed": 3, "resamples": 200, "not_computed": {"mid": "too few motions"}}
    exact = card_with(card, [row.model_dump() for row in card.perturbations], facts=facts, **values)
    lines = write_card([exact], tmp_path)[1].read_text().splitlines()
    assert "| detected from | jitter | fid |" in lines
    for line in (
        "- motions: 40 of 24 to 60 frames", "- protocol: text\\_to\\_motion version 1, seed 3",
        "- intervals: 95 %, from 200 bootstrap resamples of the motions", "- not computed: mid: too few motions",
        "- data: test split of x, fingerprint f, ", "- fid against exact attributes: AUC 0.9, rank correlation -0.5",
    ):  # fmt: skip
        assert any(
            shown.replace("\\", "").startswith(line.replace("\\", "").strip()) for shown in lines
        ), line


def test_a_metric_rewards_a_perturbation_by_its_strongest_grade(card):
    def rewarded(metric_is_higher: bool, *changes: float) -> bool:
        values: list[tuple[float, dict[str, list[float | None]]]] = [
            (float(grade), {"fid": [1.0 + d, 0.1, d, 0.1], "jitter": [1.0 + d, 0.1, d, 0.1]})
            for grade, d in enumerate(changes, 1)
        ]
        shown = card_with(
            card, [perturbed("x", "joints", *values)], metrics={"fid": metric_is_higher}
        )
        response = seen(shown, shown.perturbations[0], "fid")
        assert response is not None
        return response.rewarded

    assert rewarded(True, -0.5, 0.5)
    assert not rewarded(True, 0.5, -0.5)
    assert rewarded(False, 0.5, -0.5)
    assert not rewarded(False, -0.5, 0.5)
    assert not rewarded(True, 0.5, 0.05)  # the strongest grade is not detected


def test_a_difference_that_is_missing_is_named_even_if_the_value_is_known(card, tmp_path):
    lacking = card.perturbations[0].model_dump()
    lacking["grades"][0]["values"]["fid"][2:] = [None, None]
    lacking["grades"][2]["values"]["jitter"][2:] = [None, None]
    _, text = write_card([card_with(card, [lacking])], tmp_path)
    assert "| noise (mm) | not computed at 1 | not computed at 5 |" in text.read_text()


def test_no_card_of_the_repository_is_cited_for_another_data_set(tmp_path, monkeypatch):
    monkeypatch.setenv("FLAME_MDM_AUDITS", str(tmp_path))
    listed = read_json(ROOT / "flame_mdm" / "reporting" / "audited.json", list[ListedCard])
    assert listed
    for entry in listed:
        assert card_of(entry.data, entry.extractor) is not None
        other = entry.data.model_copy(update={"dataset": "another set"})
        assert card_of(other, entry.extractor) is None
