"""Metrics of 2023 to 2026: against the authors' code, and against closed forms."""

import math

import numpy as np
import pytest
import torch
from support.fixtures import golden, golden_case, groups, meta
from torch import Tensor
from torchmetrics import Metric

from evaluators.metrics.alignment import MotionsForText
from evaluators.metrics.distribution import frechet_distance
from evaluators.metrics.published_physics import (
    JERK_OF_REAL_MOTIONS,
    KimodoConstraints,
    KimodoQuality,
    MBenchQuality,
    PhysicalFootContact,
    TransitionJerk,
    constraint_errors,
    mbench_contact,
    mbench_floating,
    peak_and_area,
    transition_jerk,
)
from evaluators.metrics.retrieval import (
    TMR_TOP,
    MultiPositiveRPrecision,
    TMRRetrieval,
    batched_retrieval,
    best_ranks,
    dissimilar,
    multi_positive,
    plain_caption,
    whole_set_retrieval,
)
from flame_mdm.errors import UserError
from flame_mdm.representations import rotation
from flame_mdm.representations.humanml import HumanML
from flame_mdm.seeds import key

MBENCH, PFC, KIMODO, FLOWMDM, TMR = (
    golden(name)
    for name in ("mbench_quality", "pfc", "kimodo_metrics", "transition", "tmr_retrieval")
)
one = golden_case("kimodo_metrics")


def cases(fixture: dict[str, np.ndarray], under: str, stem: str) -> list:
    names = [name for name in groups(fixture, "joints") if name.startswith(f"in/{under}")]
    return [
        pytest.param(name.removeprefix("in/"), id=f"{stem}-{name.removeprefix('in/')}")
        for name in names
    ]


def y_up(joints: np.ndarray) -> Tensor:
    """Joints (..., 3) with z up as joints with y up."""
    return torch.from_numpy(joints).double()[..., [0, 2, 1]] * torch.tensor([1.0, 1.0, -1.0])


MBENCH_NAMES = dict(
    zip(
        MBenchQuality.parts,
        ("jitter", "dynamic", "penetration", "sliding", "floating"),
        strict=True,
    )
)


def mean_over(metric: Metric, fixture: dict[str, np.ndarray], names: list[str]) -> dict[str, float]:
    """The value of a metric for motions of a fixture."""
    for name in names:
        joints = y_up(fixture[f"in/{name}/joints"])[None]
        metric.update(
            joints, torch.ones(joints.shape[:2], dtype=torch.bool), torch.tensor([key(name)])
        )
    return metric.compute()


@pytest.mark.golden
@pytest.mark.parametrize("case", cases(MBENCH, "", "mbench_quality"))
def test_mbench_equals_the_authors(case: str, subtests):
    motion, toes = y_up(MBENCH[f"in/{case}/joints"]), [10, 11]
    contact = mbench_contact(motion[:, toes])
    np.testing.assert_array_equal(contact, MBENCH[f"out/{case}/contact"])
    if f"aux/{case}/floating_parts" in MBENCH:
        parts = mbench_floating(motion, motion[:, toes], contact)
        np.testing.assert_array_equal(parts, MBENCH[f"aux/{case}/floating_parts"])
    ours = MBenchQuality(20.0).measure(motion)
    for name, theirs in MBENCH_NAMES.items():
        with subtests.test(name=name, theirs=theirs):
            # The fixture has no value where the authors' code fails.
            expected = float(MBENCH.get(f"f64/{case}/{theirs}", math.nan))
            assert float(ours[name]) == pytest.approx(expected, rel=1e-8, abs=1e-8, nan_ok=True), (
                name
            )


@pytest.mark.golden
@pytest.mark.parametrize("case", cases(PFC, "", "pfc"))
def test_physical_foot_contact_equals_the_authors(case: str):
    ours = float(PhysicalFootContact(30.0).measure(y_up(PFC[f"in/{case}/joints"]))["pfc"])
    expected = float(PFC.get(f"f64/{case}/pfc", math.nan))  # their code fails for two frames
    assert ours == pytest.approx(expected, rel=1e-9, nan_ok=True)


@golden_case("pfc")
def test_means_of_mbench_and_physical_foot_contact_leave_out_motions_without_a_value(stem: str):
    values = mean_over(MBenchQuality(20.0), MBENCH, meta(MBENCH)["config"]["summary_over"])
    expected = {
        name: float(MBENCH[f"out/summary/{theirs}"][0]) for name, theirs in MBENCH_NAMES.items()
    }
    assert values == pytest.approx(expected | {"measured": 1}, abs=1e-6)
    averaged = meta(PFC)["config"]["folder_mean_over"]
    values = mean_over(PhysicalFootContact(30.0), PFC, [*averaged, "static", "steady_glide"])
    expected = {
        "pfc": float(PFC["f64/folder_mean"]),
        "measured": len(averaged) / (len(averaged) + 2),
    }
    assert values == pytest.approx(expected, rel=1e-9)


@one
def test_kimodos_skating_equals_the_authors(stem: str, subtests):
    joints, contacts, lengths = (
        torch.from_numpy(KIMODO[f"in/quality/{n}"]) for n in ("joints", "foot_contacts", "lengths")
    )
    config = meta(KIMODO)["config"]
    theirs = {
        name: f"foot_{name}" for name in ("skate_from_height", "skate_ratio", "contact_consistency")
    }
    theirs |= {
        "skate_from_contacts": "foot_skate_from_pred_contacts",
        "skate_max": "foot_skate_max_vel",
    }
    metric = KimodoQuality(config["fps"], config["foot_joint_idx"])
    for row, length in enumerate(lengths.tolist()):
        ours = metric.measure(joints[row, :length].double(), contacts[row, :length])
        for name, key_ in theirs.items():
            with subtests.test(row=row, name=name):
                assert float(ours[name]) == pytest.approx(
                    float(KIMODO[f"f64/quality/{key_}"][row]), abs=2e-7
                ), (name, row)
    frames = torch.arange(joints.shape[1]) < lengths[:, None]
    metric.update(joints, frames, torch.arange(len(joints)), contacts)
    values = metric.compute()
    expected = {name: float(KIMODO[f"f64/quality/{key_}"].mean()) for name, key_ in theirs.items()}
    assert {name: values[name] for name in theirs} == pytest.approx(expected, abs=2e-6)


@pytest.mark.golden
@pytest.mark.parametrize("case", cases(KIMODO, "c", "kimodo_metrics"))
def test_kimodos_constraints_equal_the_authors(case: str, subtests):
    errors = kimodo_errors(case)
    for name in KimodoConstraints.parts:
        with subtests.test(name=name):
            expected = float(KIMODO.get(f"f64/{case}/constraint_{name}", math.nan))
            assert float(errors[name]) == pytest.approx(expected, abs=1e-7, nan_ok=True)


def kimodo_errors(case: str) -> dict[str, Tensor]:
    joints = torch.from_numpy(KIMODO[f"in/{case}/joints"]).double()
    offsets = {
        "root2d": [torch.zeros(0, 2)],
        "full": [torch.zeros(0, 3)],
        "ee": [torch.zeros(0, 3)],
    }
    for group in groups(KIMODO, "target"):
        if group.startswith(f"in/{case}/"):
            frames, target = (
                torch.from_numpy(KIMODO[f"{group}/{name}"]) for name in ("frames", "target")
            )
            kind = group.rpartition("_")[2]
            if kind == "root2d":
                offset = joints[frames, 0][:, [0, 2]] - target
            else:
                which = (
                    torch.from_numpy(KIMODO[f"{group}/joint_idx"])
                    if kind == "ee"
                    else torch.arange(22)
                )
                offset = (joints[frames] - target)[:, which].flatten(0, 1)
            offsets[kind].append(offset)
    return constraint_errors(*(torch.cat(offsets[kind]) for kind in ("root2d", "full", "ee")))


@one
def test_kimodos_percentile_retrieval_distances_and_angles_equal_the_authors(stem: str, subtests):
    metric, config = KimodoConstraints(), meta(KIMODO)["config"]["constraint_cases"]
    metric.add(torch.arange(len(config)), [kimodo_errors(case) for case in config])
    expected = float(KIMODO["out/constraint_root2d_err_p95"])
    assert metric.compute()["root2d_err_p95"] == pytest.approx(expected, abs=1e-7), "over motions"
    text, motion, real = (
        torch.from_numpy(KIMODO[f"in/tmr/{n}"]).double() for n in ("text", "motion", "gt_motion")
    )
    same = text @ text.T > 0.96  # their threshold 0.99 is converted to 0.98 of (cosine + 1) / 2
    for group, query, gallery in (
        ("t2m_R", text, motion),
        ("m2m_R", motion, real),
        ("t2m_gt_R", text, real),
    ):
        assert_recall(
            whole_set_retrieval(query @ gallery.T, same), KIMODO, {"t2m": f"f64/tmr/{group}"}
        )
    alone = best_ranks(text @ motion.T, torch.eye(len(text), dtype=torch.bool))
    ranks = torch.from_numpy(KIMODO["out/tmr/rank_per_sample"])
    assert torch.equal((alone + 1).floor(), ranks.to(alone)) or torch.equal(
        (alone + 1).ceil(), ranks.to(alone)
    )
    assert (alone < 3).double().mean().item() * 100 == pytest.approx(
        float(KIMODO["out/tmr/no_groups_R03"])
    )
    for name, a, b in (
        ("gen_gt", motion, real),
        ("gen_text", motion, text),
        ("gt_text", real, text),
    ):
        with subtests.test(name=name, a=a, b=b):
            assert float(frechet_distance(a, b)) == pytest.approx(
                float(KIMODO[f"f64/tmr/FID/{name}"]), abs=1e-6
            )
    pred, target = (
        torch.from_numpy(KIMODO[f"in/geodesic/{name}"]).double() for name in ("pred", "target")
    )
    angles = torch.rad2deg(rotation.matrix_to_axis_angle(pred @ target.mT).norm(dim=-1))
    # its arc cosine rounds near 0 and 180
    np.testing.assert_allclose(angles, KIMODO["f64/geodesic/degrees"], atol=2e-2)


@pytest.mark.golden
@pytest.mark.parametrize(("stem", "kind"), [("transition", "joints"), ("transition", "features")])
def test_jerk_of_transitions_equals_the_authors(stem: str, kind: str):
    motions = torch.from_numpy(FLOWMDM[f"in/{kind}/{'positions' if kind == 'joints' else 'feats'}"])
    if kind == "features":
        motions = HumanML(variant="legacy").decode(motions.double())
        np.testing.assert_allclose(motions, FLOWMDM["out/features/positions"], atol=2e-6)
    curves = torch.stack([transition_jerk(motion) for motion in motions])
    for row, length in enumerate(FLOWMDM[f"in/{kind}/lengths"]):
        curves[row, length - 3 :] = 0  # theirs: windows are padded
    if kind == "joints":
        np.testing.assert_allclose(curves, FLOWMDM["f64/joints/jerk"], atol=1e-9)
    values = peak_and_area(curves.mean(0), JERK_OF_REAL_MOTIONS[20])
    assert values == pytest.approx(
        [float(FLOWMDM[f"f64/{kind}/{n}"]) for n in ("peak_jerk", "auj")], rel=1e-7
    )


def assert_recall(
    ours: dict, fixture: dict[str, np.ndarray], keys: dict[str, str], within: float = 1e-10
):
    """Recall in percent and median rank are those under the fixture's key for each way."""
    for way, theirs in keys.items():
        for k in TMR_TOP:
            assert ours[f"{way}_top{k}"] * 100 == pytest.approx(
                float(fixture[f"{theirs}/R{k:02}"]), abs=within
            )
        assert ours[f"{way}_median"] == float(fixture[f"{theirs}/MedR"])


def tmr(group: str) -> dict[str, str]:
    return {way: f"{group}/{way}" for way in ("t2m", "m2t")}


@pytest.mark.golden
@pytest.mark.parametrize(
    "group", [pytest.param(g, id=f"tmr_retrieval-{g}") for g in groups(TMR, "ranks_t2m")]
)
def test_ranks_equal_tmrs(group: str, subtests):
    name = group.removeprefix("out/")
    if name == "few_values_optimistic":
        pytest.skip("TMR never uses its option to break ties in favor of the correct answer")
    similarity = torch.from_numpy(
        TMR["in/few_values" if name == "few_values" else "in/sims"]
    ).double()
    if name == "nsim":
        chosen = torch.from_numpy(TMR["in/nsim_idx"])
        similarity = similarity[chosen][:, chosen]
    correct = torch.eye(len(similarity), dtype=torch.bool)
    if name.startswith("threshold"):
        meaning = torch.from_numpy(TMR["in/sent_emb"]).double()
        correct |= meaning @ meaning.T > 2 * float(name.partition("_")[2]) - 1
    for way, table in (("t2m", similarity), ("m2t", similarity.T)):
        with subtests.test(way=way):
            if f"{group}/ranks_{way}" in TMR:
                np.testing.assert_array_equal(
                    best_ranks(table, correct), TMR[f"{group}/ranks_{way}"]
                )
    assert_recall(whole_set_retrieval(similarity, correct), TMR, tmr(group))


@golden_case("tmr_retrieval")
def test_retrieval_in_small_batches_and_by_protocol_equals_tmrs(stem: str, tmp_path, monkeypatch):
    similarity, batches = (
        torch.from_numpy(TMR["in/sims"]).double(),
        torch.from_numpy(TMR["out/guo/batches"]),
    )
    assert_recall(batched_retrieval(similarity, batches), TMR, tmr("out/guo"))

    ids, chosen = TMR["in/keyids"].tolist(), TMR["in/nsim_idx"]
    vectors = dict(zip(ids, torch.from_numpy(TMR["in/sent_emb"]), strict=True))
    monkeypatch.setattr(
        "evaluators.metrics.retrieval.embedding", lambda encoder, caption: vectors[caption]
    )
    listed = tmp_path / "nsim_test.txt"
    listed.write_text("\n".join([*(ids[i] for i in chosen), "not_evaluated"]) + "\n")
    metric = TMRRetrieval(encoder={"_target_": "stand-in"}, ids=str(listed))
    motion, text = (torch.from_numpy(TMR[f"in/{kind}_latent"]) for kind in ("motion", "text"))
    metric.update(motion, text, ids, torch.tensor([key(name) for name in ids]))
    values = metric.compute()
    for ours, theirs in (
        ("all", "normal"),
        ("threshold", "threshold_0.95"),
        ("dissimilar", "nsim"),
    ):
        part = {
            name.removeprefix(f"{ours}_"): value
            for name, value in values.items()
            if name.startswith(ours)
        }
        # Their similarities are float32, which moves single queries whose answers are nearly equal.
        assert_recall(part, TMR, tmr(f"out/driver_bs256/{theirs}"), within=1.01 * 100 / len(ids))


def test_a_list_of_dissimilar_motions_needs_ids(tmp_path):
    (tmp_path / "empty.txt").write_text("\n")
    with pytest.raises(UserError, match=r"empty\.txt: contains no ids. Write one id per line"):
        TMRRetrieval(ids=str(tmp_path / "empty.txt"))
    with pytest.raises(FileNotFoundError):
        TMRRetrieval(ids=str(tmp_path / "none.txt"))


def test_multi_positive_r_precision_of_an_example_and_dissimilar_captions():
    similarity = torch.tensor([[0.9, 0.8, 0.8, 0.1]])
    values = multi_positive(similarity, torch.tensor([[True, False, True, False]]))
    expected = {"top1": 1, "top2": 1, "top3": 1, "proper": 0.75, "positives": 2}
    assert values == pytest.approx(
        expected | {"chance_top1": 0.5, "chance_top2": 5 / 6, "chance_top3": 1}
    )
    values = multi_positive(similarity, torch.tensor([[False, True, True, False]]))
    assert (values["top1"], values["top2"], values["proper"]) == (0, 1, 0.5)
    angles = torch.linspace(0, math.pi / 2, 5)
    assert dissimilar(torch.stack([angles.cos(), angles.sin()], 1)) == [0, 4]
    angles = torch.linspace(0, math.pi / 2, 7)
    assert dissimilar(torch.stack([angles.cos(), angles.sin()], 1)) == [0, 6, 3]


def test_equal_captions_count_as_correct_and_the_classic_value_stays():
    """Half of the captions are repeated: a motion ranks behind the motion of the same caption half of the time."""
    count, generator = 96, torch.Generator().manual_seed(0)
    text = torch.randn(count // 2, 4, generator=generator).repeat(2, 1)
    motion = text + 1e-3 * torch.randn(text.shape, generator=generator)
    captions = [
        f"A person {i % (count // 2)}" + ("." if i < count // 2 else " ") for i in range(count)
    ]
    assert (
        plain_caption("A man,  walking. ")
        == plain_caption("a man walking")
        != plain_caption("a man walks")
    )
    keys = torch.arange(count)
    metric, classic = MultiPositiveRPrecision(), MotionsForText()
    metric.update(motion, text, captions, keys)
    classic.update(keys=keys, generated=motion, text=text, text_keys=keys % (count // 2))
    values, single = metric.compute(), classic.compute()
    assert values["top1"] == values["proper"] == 1
    assert values["single_top1"] == single["top1"] < 1
    assert 1 < values["positives"] < 2
    assert values["chance_top1"] == pytest.approx(values["positives"] / 32)


def test_windows_of_transitions(subtests):
    """A step of 1 m in one coordinate has third differences 1, -2, 1 around it; only whole windows count."""
    joints = torch.zeros(2, 40, 22, 3)
    joints[:, 20:, 3, 0] = 1
    kept = torch.zeros(2, 40, 22, dtype=torch.bool)
    kept[0, 20:] = True
    kept[1, 3:] = True  # its window would begin before the motion
    real = JERK_OF_REAL_MOTIONS[20]
    for fps, area in ((20.0, 4 - 3 * real + 4 * real), (60.0, None)):
        with subtests.test(fps=fps, area=area):
            metric = TransitionJerk(fps, window=10)
            metric.update(joints, torch.ones(2, 40, dtype=torch.bool), kept, torch.arange(2))
            assert metric.compute() == pytest.approx({"peak": 2, "area": area, "windows": 1})


@pytest.mark.parametrize(("step", "is_inside"), [(15, False), (16, True), (24, True), (25, False)])
def test_windows_of_transitions_are_centered_at_the_first_frame_after_them(
    step: int, is_inside: bool
):
    """The window of 10 frames at frame 20 has frames 15 to 24, so that it contains steps into frames 16 to 24."""
    joints = torch.zeros(1, 40, 22, 3)
    joints[:, step:, 3, 0] = 1
    kept = torch.zeros(1, 40, 22, dtype=torch.bool)
    kept[:, 20:] = True
    metric = TransitionJerk(20.0, window=10)
    metric.update(joints, torch.ones(1, 40, dtype=torch.bool), kept, torch.arange(1))
    assert (metric.compute()["peak"] > 0) == is_inside


def test_kept_joints_count_as_end_effectors_only_in_frames_that_keep_a_part():
    real = torch.zeros(1, 4, 22, 3)
    joints = real.clone()
    joints[0, :2] += torch.tensor([0.0, 0.5, 0.0])  # frames that keep all joints
    joints[0, 2:] += torch.tensor([0.0, 0.2, 0.0])  # frames that keep the hands
    kept = torch.zeros(1, 4, 22, dtype=torch.bool)
    kept[0, :2] = True
    kept[0, 2:, 20:] = True
    metric = KimodoConstraints()
    metric.update(joints, real, torch.ones(1, 4) > 0, kept, keys=torch.tensor([0]))
    values = metric.compute()
    assert values["fullbody_keyframe"] == pytest.approx(0.5)
    assert values["end_effector"] == pytest.approx(0.2)


def test_jerks_of_transitions_are_averaged_over_all_windows_of_all_motions():
    """Steps of 1 m and 3 m at the two seams of a motion, and none at the seam of another: 2, 6 and 0."""
    joints = torch.zeros(2, 60, 22, 3)
    joints[0, 20:, 3, 0], joints[0, 40:, 5, 1] = 1, 3
    kept = torch.zeros(2, 60, 22, dtype=torch.bool)
    kept[0, 20:40], kept[1, 30:] = True, True
    metric = TransitionJerk(60.0, window=10)
    metric.update(joints, torch.ones(2, 60, dtype=torch.bool), kept, torch.arange(2))
    assert metric.compute() == pytest.approx({"peak": (2 + 6 + 0) / 3, "area": None, "windows": 3})


def test_the_root_is_compared_on_the_ground_where_it_is_kept():
    """The root is kept in frames 1 to 3, where it is 0.1, 0.11 and 0 m off, and another joint in frame 0."""
    real = torch.zeros(1, 5, 22, 3, dtype=torch.float64)
    joints = real.clone()
    joints[0, :, 0, 0] = torch.tensor([9.0, 0.0, 0.11, 0.0, 9.0])
    joints[0, 1, 0, 2] = 0.1
    joints[0, :, 0, 1] = 7.0
    kept = torch.zeros(1, 5, 22, dtype=torch.bool)
    kept[0, 1:4, 0], kept[0, 0, 5] = True, True
    metric = KimodoConstraints()
    metric.update(joints, real, torch.ones(1, 5) > 0, kept, keys=torch.tensor([0]))
    values = metric.compute()
    assert values["root2d_err"] == pytest.approx(0.07)
    assert values["root2d_acc"] == pytest.approx(2 / 3)
    assert values["fullbody_keyframe"] is None
    metric = KimodoConstraints()
    metric.add(torch.arange(22), [*({"root2d_err": float(x)} for x in range(21)), {}])
    assert metric.compute()["root2d_err_p95"] == 19, "motions without a kept root do not count"


@pytest.mark.parametrize("fps", [20.0, 30.0, 60.0])
def test_kimodos_toes_skate_faster_than_a_fifth_of_a_meter_per_second(fps: float):
    """The left toe moves at 0.19, 0.21 and 0.21 m/s; at last it is low in the first three frames."""
    motion = torch.full((4, 22, 3), 0.5, dtype=torch.float64)
    motion[:, 10, 0] = torch.tensor([0.0, 0.19, 0.4, 0.61]) / fps
    motion[:, 10, 1] = 0.049
    low = KimodoQuality(fps).measure(motion)
    assert float(low["skate_ratio"]) == pytest.approx(2 / 3, abs=1e-5)
    assert float(low["skate_from_height"]) == pytest.approx(0.61 / 3, abs=1e-5)
    assert float(low["low"]) == pytest.approx(0.5)
    motion[3, 10, 1] = 0.051
    rising = KimodoQuality(fps).measure(motion)
    assert float(rising["low"]) == pytest.approx(0.5), "where movements begin"
    assert float(rising["skate_ratio"]) == pytest.approx(1 / 2, abs=1e-5)
    contacts = torch.zeros(4, 4, dtype=torch.bool)
    contacts[1, 1] = contacts[3] = True  # no movement begins in the last frame
    values = KimodoQuality(fps).measure(motion, contacts)
    assert float(values["skate_from_contacts"]) == pytest.approx(0.21, abs=1e-5)
    assert float(values["skate_max"]) == pytest.approx(0.21)
    assert float(values["contact_consistency"]) == pytest.approx(11 / 12)


def test_at_most_100_motions_and_half_of_them_are_dissimilar():
    angles = torch.linspace(0, 3, 250)
    meaning = torch.stack([angles.cos(), angles.sin()], 1).double()
    for count, chosen in ((150, 75), (199, 99), (201, 100), (250, 100)):
        indices = dissimilar(meaning[:count])
        assert (len(indices), len(set(indices)), indices[:2]) == (chosen, chosen, [0, count - 1])


def test_similar_captions_count_as_correct_by_the_cosine_of_their_meanings():
    """At 0, 25 and 27 degrees: cosines of 0.906 and 0.891 with the first. Two motions are exchanged."""
    angles = torch.deg2rad(torch.tensor([0.0, 25.0, 27.0, 180.0]))
    meaning = torch.stack([angles.cos(), angles.sin()], 1).double()
    text = torch.eye(4, dtype=torch.float64)
    for order, top1 in (([1, 0, 2, 3], 1.0), ([2, 1, 0, 3], 0.5)):
        metric = MultiPositiveRPrecision(pool=4)
        values = metric.value(text[order], text, torch.arange(4), meaning)
        assert (values["top1"], values["positives"]) == (top1, (2 + 3 + 2 + 1) / 4)


@pytest.mark.parametrize(("count", "batches"), [(31, 0), (32, 1), (63, 1), (64, 2)])
def test_whole_batches_of_32_motions_are_retrieved(count: int, batches: int):
    generator = torch.Generator().manual_seed(0)
    motion, text = torch.randn(2, count, 4, generator=generator, dtype=torch.float64)
    values = TMRRetrieval().value(motion, text, torch.arange(count), torch.zeros(count, 0))
    top = values["batches_t2m_top10"]
    if not batches:
        assert top is None
        return
    assert top is not None
    assert 0 < top < 1
    assert (top * 32 * batches) % 1 == pytest.approx(0, abs=1e-9)
    assert values["dissimilar_t2m_top1"] is None, "without an encoder"


@pytest.mark.parametrize(
    ("seams", "windows"),
    [((30,), 1), ((29,), 0), ((30, 90), 2), ((91,), 0), ((30, 60, 90), 3), ((), 0)],
)
def test_a_transition_counts_if_the_motion_contains_its_whole_window(seams, windows):
    """Windows of 60 frames begin 30 frames before a seam; the motion has 120 frames."""
    part = (np.searchsorted(seams, np.arange(120), side="right") % 2).astype(bool)
    kept = torch.from_numpy(part)[None, :, None].expand(1, 120, 22)
    metric = TransitionJerk(20.0, window=60)
    mask = torch.ones(1, 120, dtype=torch.bool)
    metric.update(torch.zeros(1, 120, 22, 3), mask, kept, keys=torch.tensor([0]))
    assert metric.compute()["windows"] == windows


@pytest.mark.parametrize(
    ("fps", "jerk"),
    [
        (20.0, 0.033031363),
        (30.0, 0.016383045),
        (30.0000001, 0.016383045),
        (29.97, None),
        (60.0, None),
    ],
)
def test_the_area_of_a_still_transition_is_the_jerk_of_real_motions_at_its_frame_rate(
    fps: float, jerk: float | None
):
    kept = torch.zeros(1, 30, 22, dtype=torch.bool)
    kept[:, 15:] = True
    metric = TransitionJerk(fps, window=13)
    metric.update(torch.zeros(1, 30, 22, 3), torch.ones(1, 30) > 0, kept, keys=torch.arange(1))
    area = None if jerk is None else pytest.approx(10 * jerk)
    assert metric.compute() == {"peak": 0, "area": area, "windows": 1}
