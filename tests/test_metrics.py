"""Metrics: against the authors' code and against closed forms."""

import itertools
import math
from typing import Any

import numpy as np
import pytest
import torch
from scipy.linalg import sqrtm
from support.fixtures import golden, golden_case, groups
from support.motions import keys, wander
from torch import Tensor
from torch.nn.functional import normalize
from torchmetrics import Metric

from evaluators.metrics import (
    accuracy,
    alignment,
    distribution,
    diversity,
    physics,
    reconstruction,
    update_metrics,
)
from evaluators.metrics.alignment import (
    MotionsForText,
    MultimodalDistance,
    TextsForMotion,
    retrieval_ranks,
)
from evaluators.metrics.distribution import (
    FrechetMotionDistance,
    KernelMotionDistance,
    PrecisionRecall,
    frechet_distance,
    polynomial_mmd2,
)
from evaluators.metrics.diversity import pair_distance
from evaluators.metrics.reconstruction import (
    FlamePositionErrors,
    TemosPositionErrors,
    flame_parts,
    temos_parts,
)
from evaluators.metrics.retrieval import TMR_TOP, whole_set_retrieval
from evaluators.results import mean_ci
from flame_mdm.batch import length_mask
from flame_mdm.errors import UserError
from flame_mdm.records import Value, percentiles
from flame_mdm.representations.skeleton import KIT21, SMPL22

FIXTURE = golden("metrics")


def array(name: str) -> np.ndarray:
    return FIXTURE[name]


def tensor(name: str) -> Tensor:
    """A fixture's array; floating numbers as float64."""
    values = torch.from_numpy(FIXTURE[name])
    return values.double() if values.is_floating_point() else values.long()


def computed(metric: Metric, **inputs: Any) -> Any:
    """The value of a metric for one batch of inputs."""
    metric.update(**inputs)
    return metric.compute()


def cases(suffix: str, under: str) -> list[Any]:
    return [
        pytest.param(case, id=f"metrics-{case}")
        for case in groups(FIXTURE, suffix)
        if case.startswith(under)
    ]


one = golden_case("metrics")


@pytest.mark.golden
@pytest.mark.parametrize("case", cases("exact_f64", "fid/"))
def test_frechet_distance_equals_the_authors(case: str, subtests):
    a, b = torch.from_numpy(array(f"{case}/a")), torch.from_numpy(array(f"{case}/b"))
    value = computed(
        FrechetMotionDistance(), generated=a, keys=keys(len(a)), real=b, real_keys=keys(len(b))
    )
    # the square roots of eigenvalues that should be 0 leave 1e-8 in the reference
    assert value == pytest.approx(float(array(f"{case}/exact_f64")), rel=1e-7, abs=1e-9)
    for official in ("official_scipy117", "official_scipy110"):  # takes means in float32
        with subtests.test(official=official):
            assert value == pytest.approx(float(array(f"{case}/{official}")), rel=1e-6, abs=1e-9)


@one
def test_text_metrics_equal_guos(stem: str, subtests):
    text, motion, real = tensor("t2m/text"), tensor("t2m/motion"), tensor("t2m/gt_motion")
    for size, name in ((int(array("t2m/batch")), "top123"), (len(text), "one_batch_of_160")):
        with subtests.test(name=name):
            ranks = []
            for own in torch.arange(len(text)).split(size):
                ranks.append(
                    retrieval_ranks(
                        text[own], motion, own.expand(len(own), -1), torch.arange(len(own))
                    )
                )
            hits = torch.cat(ranks)[:, None] < torch.arange(1, 4)
            np.testing.assert_allclose(
                hits.double().mean(0), array(f"t2m/R_precision_{name}"), rtol=1e-12
            )
            if name == "top123":
                np.testing.assert_array_equal(hits[:size], array("t2m/topk_batch0"))
    ids, values = keys(len(text)), {}
    values["matching_score"] = computed(MultimodalDistance(), generated=motion, text=text, keys=ids)
    values["fid"] = computed(
        FrechetMotionDistance(), generated=motion, keys=ids, real=real, real_keys=keys(len(real))
    )
    first, second = array("t2m/diversity_first"), array("t2m/diversity_second")
    values["diversity"] = pair_distance(motion[first], motion[second])
    embedded, first, second = tensor("t2m/mm_emb"), array("t2m/mm_first"), array("t2m/mm_second")
    values["multimodality"] = pair_distance(embedded[:, first], embedded[:, second])
    expected = {name: float(array(f"t2m/{name}")) for name in values}
    assert values == pytest.approx(expected, rel=1e-5)
    assert values["fid"] == pytest.approx(expected["fid"], rel=1e-6)


@pytest.mark.golden
@pytest.mark.parametrize("case", cases("mm_pairs", "a2m/"))
def test_action_metrics_equal_the_authors(case: str):
    features = tensor("a2m/features")
    value = pair_distance(
        features[tensor(f"{case}/div_first")], features[tensor(f"{case}/div_second")]
    )
    assert value == pytest.approx(float(array(f"{case}/diversity")), rel=1e-5)
    first, second = tensor(f"{case}/mm_pairs").T
    labels = tensor(f"{case}/labels")
    assert torch.equal(labels[first], labels[second])
    # The authors' code also divides by classes without motions.
    share = len(labels.unique()) / int(array(f"{case}/num_labels"))
    expected = float(array(f"{case}/multimodality"))
    assert pair_distance(features[first], features[second]) * share == pytest.approx(
        expected, rel=1e-5
    )


@one
def test_intervals_accuracy_unconstrained_diversity_precision_recall_and_retrieval_equal_the_authors(
    stem: str,
    subtests,
):
    interval: Any = mean_ci(array("ci/values").tolist())
    np.testing.assert_allclose(interval, array("ci/mean_ci"), rtol=1e-12)
    columns: Any = [mean_ci(column.tolist()) for column in array("ci/values3").T]
    np.testing.assert_allclose(np.transpose(columns), array("ci/mean_ci3"), rtol=1e-12)
    labels = tensor("a2m/logit_labels")
    value = computed(
        accuracy.ActionAccuracy(),
        logits=tensor("a2m/logits"),
        labels=labels,
        keys=keys(len(labels)),
    )
    assert value == pytest.approx(float(array("a2m/accuracy")), rel=1e-6)
    features = tensor("a2m/features")
    value = pair_distance(
        features[tensor("uncond/div_first")], features[tensor("uncond/div_second")]
    )
    assert value == pytest.approx(float(array("uncond/diversity")), rel=1e-5)
    fake, real = tensor("pr/gen"), tensor("pr/real")
    # The larger set is cut to the size of the smaller one.
    order = {
        "keys": torch.arange(len(fake)),
        "real_keys": torch.arange(len(real)),
    }
    values = computed(PrecisionRecall(), generated=fake, real=real, **order)
    assert values == pytest.approx({name: float(array(f"pr/{name}")) for name in values}, rel=1e-12)
    values = whole_set_retrieval(tensor("tmr/sims"))
    for way in ("t2m", "m2t"):
        with subtests.test(way=way):
            recall = {f"{way}_top{k}": float(array(f"tmr/{way}_R{k:02}")) / 100 for k in TMR_TOP}
            assert {name: values[name] for name in recall} == pytest.approx(recall, rel=1e-12)
            assert values[f"{way}_median"] == float(array(f"tmr/{way}_MedR"))


@pytest.mark.golden
@pytest.mark.parametrize("case", cases("idx_g", "kid/"))
def test_kernel_distance_equals_the_authors(case: str):
    a, b = tensor("kid/codes_g"), tensor("kid/codes_r")
    subsets = zip(tensor(f"{case}/idx_g"), tensor(f"{case}/idx_r"), strict=True)
    mmd = torch.stack([polynomial_mmd2(a[i], b[j]) for i, j in subsets]).numpy()
    np.testing.assert_allclose(mmd, array(f"{case}_float64/mmd"), rtol=1e-11)
    np.testing.assert_allclose(mmd, array(f"{case}_float32/mmd"), rtol=1e-4, atol=2e-6)
    np.testing.assert_allclose(
        [mmd.mean(), mmd.std()], array(f"{case}_float64/mean_std"), rtol=1e-11, atol=1e-12
    )


@pytest.mark.slow
@one
def test_kernel_distance_of_whole_sets_equals_the_authors(stem: str):
    """Their draws: of the real motions first, with replacement where these are more than a subset."""
    real, fake = tensor("kid/full/real"), tensor("kid/full/gen")
    generator = np.random.RandomState(int(array("kid/full/np_seed")))
    size, replace = 1000, len(real) > 1000
    mmd = []
    for _ in range(100):
        i, j = (
            generator.choice(len(real), size, replace),
            generator.choice(len(fake), size, replace),
        )
        mmd.append(polynomial_mmd2(real[i], fake[j]).item())
    np.testing.assert_allclose([np.mean(mmd), np.std(mmd)], array("kid/full/mean_std"), rtol=1e-5)


def mid(real: Tensor, text: Tensor, generated: Tensor, eps: float) -> float:
    requested = text[: len(generated)]
    return (
        alignment.pointwise_mutual_information(real, text, generated, requested, eps).mean().item()
    )


MID_EPS = {"mid": 0.0, "eps0": 0.0, "eps5e-4": 5e-4, "real_as_fake_eps5e-4": 5e-4}


@pytest.mark.golden
@pytest.mark.parametrize("case", [*cases("eps5e-4", "mid/"), *cases("mid", "mid/")])
def test_mid_equals_the_authors(case: str):
    names = ("x", "y", "x0") if f"{case}/x" in FIXTURE else ("real_x", "text_y", "fake_x0")
    real, text, fake = (tensor(f"{case}/{name}") for name in names)
    ours, theirs = {}, {}
    for option in (option for option in MID_EPS if f"{case}/{option}" in FIXTURE):
        motions = real[: len(fake)] if option.startswith("real_as_fake") else fake
        ours[option] = mid(real, text, motions, MID_EPS[option])
        theirs[option] = float(array(f"{case}/{option}"))
    if len(real) > real.shape[1] + text.shape[1]:
        assert ours == pytest.approx(theirs, rel=1e-6)
    # The log-determinant of the joint covariance is noise in both implementations. It cancels in the
    # difference between two sets of motions.
    else:
        (a, b), (c, d) = (x.values() for x in (ours, theirs))
        assert b - a == pytest.approx(d - c, rel=1e-6)
        assert a == pytest.approx(c, rel=5e-3)


@one
def test_flame_metrics_and_position_errors_equal_the_authors(stem: str, subtests):
    text, fake, real = (
        tensor("flame/text_feat"),
        tensor("flame/gen_motion_feat"),
        tensor("flame/gt_motion_feat"),
    )
    own = torch.arange(len(text))
    pools = torch.cat([own[:, None], tensor("flame/wrong_idx")], 1)
    rank = retrieval_ranks(fake, text, pools, torch.zeros_like(own))
    shares = [(rank < k).double().mean().item() for k in (1, 2, 3)]
    np.testing.assert_allclose(shares, array("flame/r_precision_top123"), rtol=1e-6)
    metrics = {
        "mclip": alignment.MotionCLIPScore(),
        "mm_distance": MultimodalDistance(),
        "fd": FrechetMotionDistance(),
    }
    update_metrics(metrics, generated=fake, text=text, keys=own, real=real, real_keys=own)
    for name, metric in metrics.items():
        with subtests.test(name=name, metric=metric):
            assert metric.compute() == pytest.approx(float(array(f"flame/{name}")), rel=2e-6)

    metric, pairs = FlamePositionErrors(SMPL22.parents), []
    for clip in groups(
        {k: v for k, v in FIXTURE.items() if k.startswith("flame_ape/clip")}, "translation"
    ):
        sides = []
        for motion, path in (
            ("gen_joints_xyz", "translation"),
            ("gt_joints_xyz", "gt_translation"),
        ):
            root = tensor(f"{clip}/{path}")[:, [0, 2, 1]]  # z up -> y up
            sides.append(
                flame_parts(tensor(f"{clip}/{motion}") + root[:, None], root, SMPL22.parents)
            )
        pairs.append(sides)
    names = [
        f"{part}_error" for part in ("root_joint", "global_traj", "local_joint", "global_joint")
    ]
    expected = [
        float(array(f"flame_ape/{error}_{name}")) for error in ("ape", "ave") for name in names
    ]
    np.testing.assert_allclose(averages(metric, pairs), expected, rtol=1e-6)


def averages(metric: reconstruction.PositionErrors, pairs: list[Any]) -> list[float]:
    """APE and AVE of pairs of parts, without what `update` does to motions."""
    ids = keys(len(pairs))
    metric.add(ids, [metric.errors(*pair) for pair in pairs], groups=ids)
    return list(metric.compute().values())


@one
def test_temos_position_errors_equal_the_authors(stem: str, subtests):
    """Also of padded batches: their floor sees the padding, which the parts of padded motions reproduce."""
    names = [
        f"{error}_{part}"
        for error in ("APE", "AVE")
        for part in ("root", "traj", "mean_pose", "mean_joints")
    ]
    single, padded = (
        [float(array(f"temos_ape/{case}/{n}")) for n in names] for case in ("single", "padded")
    )
    fake, real = tensor("temos_ape/padded_text"), tensor("temos_ape/padded_ref")
    lengths = tensor("temos_ape/single/len_text_ref")
    metric = TemosPositionErrors()
    metric.units_per_meter = 1000.0
    values = computed(
        metric,
        joints=fake / 1000,
        mask=length_mask(lengths[:, 0], fake.shape[1]),
        real_joints=real / 1000,
        real_mask=length_mask(lengths[:, 1], real.shape[1]),
        keys=keys(len(fake)),
    )
    assert list(values.values()) == pytest.approx(single, rel=2e-6)
    metric, pairs = TemosPositionErrors(), []
    metric.units_per_meter = 1.0
    for *motions, length in zip(fake, real, array("temos_ape/lengths"), strict=True):
        pairs.append(
            [
                {part: x[:length] for part, x in metric.positions(motion).items()}
                for motion in motions
            ]
        )
    np.testing.assert_allclose(averages(metric, pairs), padded, rtol=2e-6)
    parts, length = temos_parts(fake[0]), int(array("temos_ape/lengths")[0])
    names = {
        "root": "root",
        "trajectory": "traj",
        "mean_local": "pose_local",
        "mean_global": "joints",
    }
    for part, name in names.items():
        with subtests.test(name=name):
            expected = array(f"temos_ape/transform0/{name}")
            np.testing.assert_allclose(parts[part][:length] / 1000, expected[:length], atol=2e-6)


def exactly_normal(mean: np.ndarray, covariance: np.ndarray, count: int, seed: int) -> Tensor:
    """Rows (N, E) whose mean and covariance (N - 1 in the denominator) are exactly these."""
    x = np.random.default_rng(seed).normal(size=(count, len(mean)))
    x -= x.mean(0)
    x = x @ np.linalg.inv(np.linalg.cholesky(np.cov(x.T))).T
    return torch.from_numpy(x @ np.linalg.cholesky(covariance).T + mean)


def test_frechet_distance_of_normal_distributions():
    """Of commuting covariances: |m - m'|^2 + sum (s - s')^2; of any, scipy's matrix square root."""
    deviations, other = np.array([0.5, 1.0, 3.0]), np.array([2.0, 0.1, 3.5])
    a = exactly_normal(np.array([1.0, 2.0, 3.0]), np.diag(deviations**2), 50, 0)
    b = exactly_normal(np.array([0.0, 2.0, 5.0]), np.diag(other**2), 70, 1)
    assert frechet_distance(a, b).item() == pytest.approx(
        5 + ((deviations - other) ** 2).sum(), rel=1e-12
    )

    s, t = (
        a @ a.T / 20 + 0.1 * np.eye(20) for a in np.random.default_rng(0).normal(size=(2, 20, 20))
    )
    a, b = exactly_normal(np.zeros(20), s, 100, 2), exactly_normal(np.ones(20), t, 60, 3)
    expected = 20 + np.trace(s + t) - 2 * np.trace(np.real(np.asarray(sqrtm(s @ t))))
    assert frechet_distance(a, b).item() == pytest.approx(expected, rel=1e-10)

    # without full rank, and of a set to itself
    generator = torch.Generator().manual_seed(0)
    a, b = (torch.randn(n, 12, generator=generator, dtype=torch.float64) for n in (40, 30))
    dead = torch.ones(1, 5, dtype=torch.float64)
    padded = frechet_distance(*(torch.cat([x, dead.expand(len(x), -1)], 1) for x in (a, b)))
    assert padded.item() == pytest.approx(frechet_distance(a, b).item(), rel=1e-13)
    # A rotation of a thin set: only the means and the trace remain
    few = frechet_distance(a[:5], b[:5])
    eigenvalues = np.linalg.eigvals(np.cov(a[:5].T.numpy()) @ np.cov(b[:5].T.numpy())).real.clip(0)
    trace = a[:5].var(0).sum() + b[:5].var(0).sum() - 2 * np.sqrt(eigenvalues).sum()
    assert few.item() == pytest.approx(
        ((a[:5].mean(0) - b[:5].mean(0)) ** 2).sum().item() + trace.item(), rel=1e-6
    )
    x, ids = torch.randn(64, 32, generator=torch.Generator().manual_seed(0)), torch.arange(64)
    assert (
        0
        <= computed(FrechetMotionDistance(), generated=x, keys=ids, real=x.flip(0), real_keys=ids)
        < 1e-10
    )


def test_kernel_distance_of_whole_sets_is_one_value():
    """Subsets without replacement as large as the sets are permutations; with replacement, equal samples meet."""
    generator = torch.Generator().manual_seed(0)
    a, b = (torch.randn(50, 6, generator=generator) for _ in range(2))
    inputs = {"generated": a, "keys": torch.arange(50), "real": b, "real_keys": torch.arange(50)}
    metric = distribution.KernelMotionDistance
    values = {
        replace: computed(metric(subsets=20, subset_size=50, replace=replace), **inputs)
        for replace in (False, True)
    }
    assert values[False]["mean"] == pytest.approx(
        polynomial_mmd2(a.double(), b.double()).item(), rel=1e-12
    )
    assert values[False]["std"] < 1e-12 < values[True]["std"]
    assert values[True]["mean"] > values[False]["mean"]


def test_mid_of_normal_distributions():
    """Of the real motions themselves: the mutual information of two correlated normal variables, -log(1 - r^2) / 2."""
    r = 0.8
    both = exactly_normal(np.array([1.0, -2.0]), np.array([[4.0, 2 * r], [2 * r, 1.0]]), 500, 0)
    real, text = both[:, :1], both[:, 1:]
    metric = alignment.MutualInformationDivergence(eps=0.0)
    value = computed(metric, generated=real, text=text, real=real, keys=torch.arange(500))
    assert value == pytest.approx(-math.log(1 - r**2) / 2, rel=1e-12)
    assert mid(real, text, real.roll(1, 0), 0.0) < 0 < value


def test_r_precision_of_perfect_random_and_blind_features(subtests):
    count, generator = 1000, torch.Generator().manual_seed(0)
    text, random = torch.randn(2, count, 8, generator=generator)
    ids, blind = keys(count), torch.ones(count, 8)
    for metric in (TextsForMotion, MotionsForText):
        with subtests.test(metric=metric):
            perfect = computed(metric(), generated=text, text=text, text_keys=ids, keys=ids)
            assert perfect == {"top1": 1.0, "top2": 1.0, "top3": 1.0}
            for motion, seen in ((random, text), (blind, blind)):
                values = computed(metric(), generated=motion, text=seen, text_keys=ids, keys=ids)
                for chance, value in zip((1 / 32, 2 / 32, 3 / 32), values.values(), strict=True):
                    assert value == pytest.approx(
                        chance, abs=4 * (chance * (1 - chance) / count) ** 0.5
                    )


def test_texts_for_motion_never_draw_the_own_caption_and_motions_for_text_count_every_text_once(
    subtests,
):
    # Two captions, far from one another; each motion lies on its own, so a pool of 2 must never hold it twice.
    captions, which = torch.tensor([[0.0], [10.0]]), torch.arange(40) % 2
    for own, top1 in ((which, 1.0), (1 - which, 0.0)):
        with subtests.test(own=own, top1=top1):
            texts = {"text": captions[which], "text_keys": which, "keys": keys(40)}
            assert (
                computed(TextsForMotion(pool=2), generated=captions[own], **texts)["top1"] == top1
            )
    # 33 motions that are mixed up in pairs but for one: whatever the pools, at most the one is right.
    text = torch.arange(33.0)[:, None]
    motion = text.clone()
    motion[:32] = text[:32] + torch.tensor([1.0, -1.0]).repeat(16)[:, None]
    ids = torch.arange(33)
    hits = (
        33
        * computed(MotionsForText(), generated=motion, text=text, text_keys=ids, keys=ids)["top1"]
    )
    assert hits == pytest.approx(round(hits))
    assert 1 <= round(hits) <= 2  # the one, and one whose partner an incomplete pool may leave out


def test_ties_and_directions_in_retrieval(subtests):
    candidates, query = (
        torch.tensor([[0.0], [1.0], [1.0], [2.0]]),
        torch.tensor([[1.0], [1.0], [0.4]]),
    )
    pools = torch.arange(4).expand(3, -1)
    assert retrieval_ranks(query, candidates, pools, torch.tensor([1, 2, 3])).tolist() == [0, 1, 3]
    assert set(whole_set_retrieval(torch.eye(4)).values()) == {1.0}
    assert whole_set_retrieval(torch.ones(4, 4))["t2m_median"] == 2.5, "ties count by half"

    text = normalize(torch.randn(64, 8, generator=torch.Generator().manual_seed(0)), dim=-1)
    lengths = torch.linspace(1, 10, 64)[:, None]
    rows = {"generated": lengths * text, "text": text, "keys": torch.arange(64)}
    for alone in (True, False):
        with subtests.test(alone=alone):
            top1 = computed(MotionsForText(normalize=alone), text_keys=rows["keys"], **rows)["top1"]
            assert (top1 == 1) if alone else (top1 < 0.9)
            distance = computed(MultimodalDistance(normalize=alone), **rows)
            assert distance == pytest.approx(
                0 if alone else float((lengths - 1).mean()), rel=1e-6, abs=1e-6
            )


def test_diversity_of_two_points(subtests):
    features = torch.tensor([[0.0, 0.0], [3.0, 4.0]]).repeat(500, 1)
    for replace in (False, True):
        with subtests.test(replace=replace):
            value = computed(
                diversity.Diversity(pairs=1000, replace=replace),
                generated=features,
                keys=keys(1000),
            )
            assert value == pytest.approx(2.5, abs=0.4)  # half of the pairs are 5 apart
    line = {"generated": torch.arange(1000.0)[:, None], "keys": torch.arange(1000)}
    assert computed(diversity.Diversity(pairs=1000, replace=False), **line) == pytest.approx(
        1000 / 3, rel=0.1
    )


def multimodality(
    metric: Metric, distances: Tensor, samples: int, kind: str = "groups"
) -> float | None:
    """Of prompts whose motions stand on two points, so many apart."""
    steps = torch.arange(samples) % 2
    features = (distances[:, None] * steps).flatten()[:, None]
    prompts = torch.arange(len(distances)).repeat_interleave(samples)
    order = torch.randperm(len(prompts), generator=torch.Generator().manual_seed(0))
    return computed(metric, generated=features[order], keys=order, **{kind: prompts[order]})


def test_multimodality_in_each_definition():
    distances = torch.tensor([1.0, 3.0])
    value = multimodality(diversity.TextMultimodality(), distances, 30)
    assert value is not None
    assert 0 < value < 2
    assert (value * 10 / 2) % 1 == pytest.approx(0, abs=1e-9)  # the same pairs for all texts
    # sample i of the first set and of the second: 10 apart, thus on the same point for 10, on the other for 5
    assert multimodality(diversity.PairedMultimodality(samples=10), distances, 20) == 0
    assert multimodality(diversity.PairedMultimodality(samples=5), distances, 10) == 2
    value = multimodality(diversity.ActionMultimodality(pairs=4000), distances, 30, "labels")
    assert value == pytest.approx(1, abs=0.05)  # a pair is apart every second time


def test_joint_variance_of_known_spread():
    """Motions of a text stand at x = -1 and x = 1: variance 4 / 3 of four; a second text has none."""
    still = torch.zeros(4, 6, 2, 3)
    still[::2, ..., 0], still[1::2, ..., 0] = -1, 1
    metric = diversity.JointVariance(samples=4)
    mask = length_mask(torch.full((4,), 5), 6)
    metric.update(joints=still, mask=mask, groups=torch.full((4,), 1), keys=keys(4, "a"))
    still[..., 0] = 7
    metric.update(joints=still, mask=mask, groups=torch.full((4,), 2), keys=keys(4, "b"))
    assert metric.compute() == pytest.approx(2 / 3)


def test_displacement_and_drift_of_shifted_frames_and_joints(subtests):
    """Shifted by (3, 0, 4) in every frame after the fourth, and by twice that in the last: 5 and 10 metres."""
    real = wander(22, 10, 0)[None]
    fake = real.clone()
    fake[:, 4:] += torch.tensor([3.0, 0.0, 4.0])
    fake[:, 7] += torch.tensor([3.0, 0.0, 4.0])
    mask = length_mask(torch.tensor([8]), 10)
    kept = (torch.arange(10) < 4)[None, :, None].expand(1, 10, 22)
    motions = {"joints": fake, "mask": mask, "real_joints": real, "keys": torch.tensor([1])}
    # Motions are compared up to the end of the shorter one
    short = length_mask(torch.tensor([6]), 10)
    for change, ade, fde in (
        ({"kept": kept, "real_mask": mask}, 25 / 4, 10.0),
        ({"real_mask": mask}, 25 / 8, 10.0),
        ({"real_mask": short}, 10 / 6, 5.0),
    ):
        with subtests.test(ade=ade, fde=fde):
            values = computed(reconstruction.DisplacementErrors(), **motions, **change)
            assert values == pytest.approx({"ade": ade, "fde": fde}, rel=1e-6)

    # Joint 3 is new and 2 m off; of the kept ones joint 5 is 1 m off in one of 10 frames.
    fake = real.clone()
    fake[:, :, 3, 0] += 2
    fake[:, 4, 5, 1] += 1
    mask, kept = torch.ones(1, 10, dtype=torch.bool), (torch.arange(22) != 3).expand(1, 10, 22)
    motions |= {"joints": fake, "mask": mask, "real_mask": mask, "kept": kept}
    assert computed(reconstruction.DisplacementErrors(), **motions) == pytest.approx(
        {"ade": 2, "fde": 2}, rel=1e-6
    )
    assert computed(reconstruction.KeptDrift(), **motions) == pytest.approx(
        {"mean": 1 / 210, "largest": 1}, rel=1e-6
    )
    values = computed(reconstruction.KeptDrift(), **motions | {"kept": torch.zeros_like(kept)})
    assert values == {"mean": None, "largest": None}


def test_best_and_worst_of_several_are_chosen_by_the_root(subtests):
    """Three motions for each of two texts, the root off by 1, 2 and 3 m; the others the more, the less the root is."""
    real = wander(21, 12, 0)
    off = torch.tensor([2.0, 1.0, 3.0, 3.0, 1.0, 2.0])
    fake = real.repeat(6, 1, 1, 1)
    fake[:, :, 0, 0] += off[:, None]
    fake[:, :, 1:, 0] += (5 - off)[:, None, None]
    mask = torch.ones(6, 12, dtype=torch.bool)
    motions = {
        "joints": fake,
        "mask": mask,
        "real_joints": real.repeat(6, 1, 1, 1),
        "real_mask": mask,
    }
    motions |= {"keys": torch.arange(6), "groups": torch.tensor([8, 8, 8, 4, 4, 4])}
    values = {}
    for samples in (3, 1):
        values |= computed(FlamePositionErrors(KIT21.parents, samples=samples), **motions)
    joints = {"best": (1 + 20 * 4) / 21, "worst": (3 + 20 * 2) / 21}
    for which, root in (("best", 1), ("worst", 3)):
        with subtests.test(which=which, root=root):
            assert values[f"{which}_ape_root"] == pytest.approx(root, rel=1e-5)
            assert values[f"{which}_ape_mean_global"] == pytest.approx(joints[which], rel=1e-5)
    assert values["ape_root"] == pytest.approx(2, rel=1e-5)
    with pytest.raises(UserError, match="2 of 2 prompts do not have 2 motions"):
        computed(FlamePositionErrors(KIT21.parents, samples=2), **motions)


def test_physics_of_simple_motions(subtests):
    frames, fps = 30, 20.0
    still = torch.rand(1, 1, 22, 3, generator=torch.Generator().manual_seed(0)).repeat(
        1, frames, 1, 1
    )
    still[..., 1] -= still[..., 1].amin()
    mask, ids = torch.ones(1, frames, dtype=torch.bool), torch.tensor([1])

    def measured(joints: Tensor) -> dict[str, Any]:
        metrics = {"below": physics.Penetration(), "above": physics.Floating()}
        metrics |= {"jerk": physics.Jitter(fps), "static": physics.StaticShare(fps)}
        update_metrics(metrics, joints=joints, mask=mask, keys=ids)
        return {name: metric.compute() for name, metric in metrics.items()}

    assert measured(still) == {"below": 0, "above": 0, "jerk": 0, "static": 1}
    cubic = still.double().clone()
    cubic[..., 0] += (torch.arange(frames).double() / fps)[:, None] ** 3  # jerk 6 m/s^3
    values = measured(cubic)
    assert (values["jerk"], values["static"]) == (pytest.approx(6, rel=1e-6), 0)
    lift = torch.tensor([0.0, 1.0, 0.0])
    half = still.clone()
    half[:, : frames // 2] -= 0.1 * lift
    for joints, above, below in (
        (still + 0.1 * lift, 0.1, 0),
        (still - 0.1 * lift, 0, 0.1),
        (still + 0.004 * lift, 0, 0),
        (still - 0.004 * lift, 0, 0),
        (half, 0, 0.05),
    ):
        with subtests.test(above=above, below=below):
            values = measured(joints)
            assert values["above"] == pytest.approx(above, rel=1e-6)
            assert values["below"] == pytest.approx(below, rel=1e-6)


def test_a_bootstrap_of_a_mean_is_the_interval_in_closed_form():
    generator = np.random.default_rng(0)
    x = generator.normal(3, 2, 200)
    drawn = x[generator.integers(200, size=(4000, 200))].mean(1)
    half = 1.96 * x.std() / 200**0.5
    low, high = percentiles(drawn.tolist(), x.mean())
    np.testing.assert_allclose([low, high], [x.mean() - half, x.mean() + half], atol=0.05 * half)


def test_a_bootstrap_of_a_distance_is_at_its_value():
    generator, draws = torch.Generator().manual_seed(0), np.random.default_rng(0)
    real, noise = torch.randn(2, 150, 8, generator=generator, dtype=torch.float64)
    value = frechet_distance(noise, real).item()
    drawn = [
        frechet_distance(noise[draws.integers(150, size=150)], real).item() for _ in range(300)
    ]
    low, high = percentiles(drawn, value)
    assert low < value < high, (
        "sets with repetitions are farther away, which is not the value's error"
    )


def test_an_interval_is_over_replications_or_over_motions_and_a_single_value_has_none():
    assert mean_ci([3.0]) == (3.0, None)
    single: dict[str, Any] = {"mean": 3.0, "replications": 1, "n": 64}
    assert Value(ci=0.0, **single).half is None, "as earlier versions wrote it"
    assert Value(ci=None, **single).half is None
    drawn: list[float | None] = [2.0 + k / 100 for k in range(201)]
    assert Value(ci=None, **single, resampled=drawn).half == pytest.approx(0.95)
    assert Value(mean=3.0, ci=0.5, replications=2, n=64, resampled=drawn).half == 0.5


@pytest.mark.parametrize("seed", range(5))
def test_multimodality_draws_no_motion_twice_on_the_same_side(seed: int):
    # Both sides are all 5 motions in some order, so that the value is the mean distance of one of 120 pairings.
    features = torch.tensor([0.0, 1.0, 4.3, 13.7, 41.9], dtype=torch.float64)
    pairings = [
        (features - features[list(order)]).abs().mean()
        for order in itertools.permutations(range(5))
    ]
    metric = diversity.TextMultimodality(samples=5, pairs=5, seed=seed)
    value = computed(
        metric, generated=features[:, None], groups=torch.zeros(5, dtype=torch.long), keys=keys(5)
    )
    assert min(abs(value - float(pairing)) for pairing in pairings) < 1e-9


def test_spread_of_the_kernel_distance_is_that_of_its_subsets():
    generator = torch.Generator().manual_seed(0)
    generated, real = torch.randn(2, 9, 3, generator=generator, dtype=torch.float64)
    values = KernelMotionDistance(subsets=2, subset_size=4).value(generated, real)
    draw = np.random.default_rng(0).choice
    pairs = [[x[draw(9, 4, replace=False)] for x in (generated, real)] for _ in range(2)]
    first, second = (polynomial_mmd2(*pair).item() for pair in pairs)
    assert values["mean"] == pytest.approx((first + second) / 2)
    assert values["std"] == pytest.approx(abs(first - second) / 2)


@pytest.mark.parametrize("fps", [20.0, 30.0])
@pytest.mark.parametrize(
    ("speed", "height", "slides"),
    [(0.51, 0.0, True), (0.49, 0.0, False), (0.51, 0.049, True), (0.51, 0.051, False)],
)
def test_a_foot_slides_from_half_a_meter_per_second_below_five_centimeters(
    fps: float, speed: float, height: float, slides: bool
):
    motion = torch.full((4, 22, 3), 0.5, dtype=torch.float64)
    motion[:, 10, 0], motion[:, 10, 1] = torch.arange(4) * speed / fps, height
    assert physics.FootSkating(fps).measure(motion).tolist() == [slides] * 3


def test_a_foot_that_tips_up_and_down_does_not_slide_and_each_foot_has_its_own_contact():
    motion = torch.full((3, 22, 3), 0.5, dtype=torch.float64)
    motion[:, 10, 1] = torch.tensor([0.0, 0.045, 0.0])  # 0.9 m/s upward
    motion[:, 11, 0] = torch.arange(3.0)  # fast, and in the air
    assert physics.FootSkating(20.0).measure(motion).tolist() == [False, False]


@pytest.mark.parametrize("metric", [physics.Penetration, physics.Floating])
def test_distances_from_the_floor_count_above_half_a_centimeter(metric: Any):
    heights = metric.side * torch.tensor([0.0049, 0.0051, 0.02], dtype=torch.float64)
    motion = (heights + metric.side * 0.3)[:, None, None].repeat(1, 22, 3)
    motion[:, 3, 1] = heights  # the lowest joint
    if metric.side < 0:
        motion[:, :, 1] = heights[:, None]
    assert metric().measure(motion).tolist() == pytest.approx([0, 0.0051, 0.02])


@pytest.mark.parametrize("fps", [20.0, 30.0])
def test_a_motion_is_static_below_three_centimeters_per_second_on_average(fps: float):
    for speed, static in ((0.029, True), (0.031, False)):
        motion = torch.zeros(5, 2, 3, dtype=torch.float64)
        motion[:, 0, 0] = 2 * speed * torch.arange(5) / fps  # the other joint stands
        assert physics.StaticShare(fps).measure(motion).tolist() == [static]
    assert physics.StaticShare(fps).measure(motion[:1]).tolist() == []


def features_of(count: int, seed: int = 0) -> dict[str, Tensor]:
    """Random features of motions and texts, of unequal lengths, with one caption per motion."""
    generator = torch.Generator().manual_seed(seed)
    text, noise = torch.randn(2, count, 3, generator=generator, dtype=torch.float64)
    lengths = torch.linspace(1, 5, count, dtype=torch.float64)[:, None]
    ids = torch.arange(count)
    return {"generated": lengths * (text + noise), "text": text, "text_keys": ids, "keys": ids}


SEEDED: dict[str, Any] = {
    "texts": lambda seed: TextsForMotion(pool=4, seed=seed),
    "motions": lambda seed: MotionsForText(pool=4, seed=seed),
    "diversity": lambda seed: diversity.Diversity(pairs=5, replace=False, seed=seed),
    "diversity with repetition": lambda seed: diversity.Diversity(5, replace=True, seed=seed),
    "text multimodality": lambda seed: diversity.TextMultimodality(20, 5, seed),
    "action multimodality": lambda seed: diversity.ActionMultimodality(5, seed),
    "kernel distance": lambda seed: KernelMotionDistance(3, 5, seed=seed),
}


@pytest.mark.parametrize("name", SEEDED)
def test_random_draws_are_those_of_the_seed(name: str):
    inputs: dict[str, Any] = features_of(40)
    inputs |= {"groups": torch.arange(40) // 20, "labels": torch.arange(40) // 20}
    inputs |= {"real": features_of(40, 1)["generated"], "real_keys": inputs["keys"]}

    def values(seed: int) -> Any:
        metric = SEEDED[name](seed)
        update_metrics({name: metric}, **inputs)
        return metric.compute()

    assert values(3) == values(3)
    assert len({str(values(seed)) for seed in range(8)}) > 4


@pytest.mark.parametrize("normalize", [False, True])
def test_values_of_individual_pairs_average_to_the_value_of_the_set(normalize: bool):
    rows = features_of(12)
    weights = np.ones((1, 12), int)
    metrics: list[Any] = [
        MultimodalDistance(normalize),
        MotionsForText(pool=12, normalize=normalize),
        TextsForMotion(pool=12),
        alignment.MotionCLIPScore(),
    ]
    for metric in metrics:
        update_metrics({"": metric}, **rows)
        value = metric.compute()
        resampled = metric.weighted(rows, weights)
        expected = value if isinstance(value, dict) else {"": value}
        assert {name: x.item() for name, x in resampled.items()} == pytest.approx(expected)


def test_half_of_the_candidates_at_an_equal_distance_count_as_closer():
    # 2 of the 4 others count as closer; a pool has 2 others, none of them closer in 1 of 6 pools
    values = TextsForMotion(pool=3).in_random_pools(torch.ones(1, 5), torch.tensor([2]))
    assert [x[0, 0].item() for x in values.values()] == pytest.approx([1 / 6, 5 / 6, 1])
    with pytest.raises(UserError, match="a pool needs 6 candidates, but there are only 5"):
        TextsForMotion(pool=6).in_random_pools(torch.ones(1, 5), torch.tensor([2]))
    TextsForMotion(pool=5).in_random_pools(torch.ones(1, 5), torch.tensor([2]))


def test_resamples_repeat_motions_as_often_as_they_are_drawn():
    weights = np.random.default_rng(0).multinomial(12, np.full(12, 1 / 12), 3)
    rows = {"generated": features_of(12)["generated"], "real": features_of(12, 1)["generated"]}
    fid = FrechetMotionDistance().weighted(rows, weights)[""]
    spread = diversity.Diversity(pairs=5, replace=True).weighted(rows, weights)[""]
    for row, times in enumerate(weights):
        generated, real = (x[np.repeat(np.arange(12), times)] for x in rows.values())
        assert fid[row] == pytest.approx(frechet_distance(generated, real).item())
        pairs = (generated[:, None] - generated).norm(dim=-1)
        assert spread[row] == pytest.approx(pairs.mean().item())


@pytest.mark.parametrize(("count", "enough"), [(6, False), (7, True)])
def test_mid_needs_more_motions_than_features(count: int, enough: bool):
    rows: dict[str, Any] = features_of(count)
    real = features_of(count, 1)["generated"]
    metric = alignment.MutualInformationDivergence()
    paired = {"paired": real, "paired_text": rows["text"]}
    if enough:
        (terms,) = metric.per_sample(rows | paired).values()
        value = metric.value(rows["generated"], rows["text"], real)
        assert terms[:, 0].mean().item() == pytest.approx(value)
        return
    with pytest.raises(UserError, match=r"got 6 samples .*, but needs at least 7"):
        metric.value(rows["generated"], rows["text"], real)
    with pytest.raises(UserError, match="6 motions are too few"):
        metric.per_sample(rows | paired)


def test_precision_and_recall_compare_sets_of_the_same_size():
    generator = torch.Generator().manual_seed(0)
    real, generated = (
        torch.randn(n, 2, generator=generator, dtype=torch.float64) for n in (60, 20)
    )
    values, cut = (PrecisionRecall().value(generated, x) for x in (real, real[:20]))
    assert values == cut
    assert PrecisionRecall().value(real, generated) == PrecisionRecall().value(real[:20], generated)
    with pytest.raises(UserError, match="got 3 motions in the smaller set, but needs at least 4"):
        PrecisionRecall().value(generated[:3], real)
    PrecisionRecall().value(generated[:4], real)


def test_drift_is_averaged_over_the_motions_with_kept_joints_and_the_largest_is_that_of_all():
    """Joints are 1 to 4 m off in motions of 2, 4 and 3 frames; nothing is kept of the last motion."""
    real = torch.zeros(3, 4, 2, 3)
    joints, kept = real.clone(), torch.zeros(3, 4, 2, dtype=torch.bool)
    joints[0, :2, 0, 0] = torch.tensor([1.0, 3.0])
    joints[1, :, 1, 2], joints[2, ..., 1] = 1.5, 4.0
    kept[0, :2, 0], kept[1, :, 1] = True, True
    mask = length_mask(torch.tensor([2, 4, 3]), 4)
    motions = {"joints": joints, "mask": mask, "real_joints": real, "real_mask": mask, "kept": kept}
    drift = computed(reconstruction.KeptDrift(), keys=torch.arange(3), **motions)
    assert drift == pytest.approx({"mean": (2 + 1.5) / 2, "largest": 3})
    errors = computed(reconstruction.DisplacementErrors(), keys=torch.arange(3), **motions)
    assert errors == pytest.approx({"ade": 4 / 3, "fde": 4 / 3}), "of clips, not of frames"


def test_every_frame_transition_has_the_same_weight_in_the_physics_of_several_motions():
    """A foot slides in 1 of 1 and in 1 of 5 transitions; a joint of two has a jerk of 2 or 0 m/frame^3."""
    sliding = torch.full((2, 6, 22, 3), 0.5)
    sliding[:, :, 10, 1], sliding[:, 1:, 10, 0] = 0.0, 1.5
    mask = length_mask(torch.tensor([2, 6]), 6)
    values = computed(physics.FootSkating(20.0), joints=sliding, mask=mask, keys=keys(2))
    assert values == pytest.approx(2 / 6)
    shaken = torch.zeros(2, 8, 2, 3)
    shaken[0, 1, 0, 0] = 2.0 / 3  # third differences of the first 4 frames: 3 times as much
    mask = length_mask(torch.tensor([4, 8]), 8)
    values = computed(physics.Jitter(1.0), joints=shaken, mask=mask, keys=keys(2))
    assert values == pytest.approx((2 / 2) / (1 + 5))


@pytest.mark.parametrize(("point", "share"), [(4.0, 1), (4.001, 0), (-2.0, 1), (-2.001, 0)])
def test_the_manifold_of_a_sample_ends_at_its_third_neighbor(point: float, share: int):
    """The third neighbors of 0 and 2 are 2 away; the samples between them have nearer ones."""
    samples = torch.tensor([[0.0], [1.0], [1.5], [2.0]], dtype=torch.float64)
    points = torch.tensor([[point]], dtype=torch.float64)
    assert distribution.manifold_coverage(points, samples).item() == share


def test_upsampled_motions_are_compared_with_recordings_instead_of_real_motions():
    """Every eighth frame of a recording, whose joints move at a constant speed; the recording is longer."""
    pose = wander(21, 1, 0)[0].double()
    recording = pose + torch.arange(30.0)[:, None, None] * torch.tensor([0.01, 0.0, 0.02])
    joints, mask = recording[:25:8][None], torch.ones(1, 4, dtype=torch.bool)
    motions: dict[str, Any] = {"joints": joints, "mask": mask, "real_mask": mask}
    motions["real_joints"] = joints + 1.0
    metric = TemosPositionErrors(upsampling=8)
    values = computed(metric, keys=torch.tensor([0]), references=[recording], **motions)
    assert list(values.values()) == pytest.approx([0.0] * 8, abs=1e-7)
    metric = TemosPositionErrors(upsampling=8)
    twice = [pose + 2 * (recording - pose)]
    values = computed(metric, keys=torch.tensor([0]), references=twice, **motions)
    step = 0.64 * math.hypot(0.01, 0.02)  # a KIT unit is 1/640 m
    assert values["ape_trajectory"] == pytest.approx(12 * step), "the mean of 0 to 24 steps"
    with pytest.raises(UserError, match="the store has no recordings"):
        TemosPositionErrors(upsampling=8).update(keys=torch.tensor([0]), **motions)


DEFAULTS: list[tuple[Any, dict[str, Any]]] = [
    (KernelMotionDistance(), {"subsets": 100, "subset_size": 1000, "replace": False}),
    (TextsForMotion(), {"pool": 32}),
    (MotionsForText(), {"pool": 32, "normalize": False}),
    (diversity.TextMultimodality(), {"samples": 30, "pairs": 10}),
    (diversity.PairedMultimodality(), {"samples": 10}),
    (diversity.ActionMultimodality(), {"pairs": 20}),
    (alignment.MutualInformationDivergence(), {"eps": 5e-4}),
    (MultimodalDistance(), {"normalize": False}),
]


@pytest.mark.parametrize(("metric", "options"), DEFAULTS, ids=lambda x: type(x).__name__)
def test_metrics_without_options_are_those_of_the_papers(metric: Any, options: dict[str, Any]):
    """As their docstrings state; protocols leave these options out."""
    assert {name: getattr(metric, name) for name in options} == options


def test_the_diversity_of_resamples_is_the_mean_over_all_pairs_of_drawn_motions():
    """A motion may be paired with itself, as in the draws of the protocols."""
    random = torch.Generator().manual_seed(0)
    features = torch.randn(5, 3, generator=random, dtype=torch.float64)
    weights = np.array([[1, 1, 1, 1, 1, 9], [0, 3, 1, 0, 1, 9]])
    metric = diversity.Diversity(pairs=300, replace=True)
    (values,) = metric.weighted({"generated": features}, weights).values()
    for value, times in zip(values, weights, strict=True):
        drawn = features.repeat_interleave(torch.from_numpy(times[:5]), 0)
        pairs = [(a - b).norm().item() for a in drawn for b in drawn]
        assert value == pytest.approx(np.mean(pairs))
    many = diversity.Diversity(pairs=20_000, replace=True)
    assert values[0] == pytest.approx(many.value(features), rel=0.02)


def test_the_variance_of_joints_is_that_of_the_motions_of_each_text_in_any_order():
    random, frames = torch.Generator().manual_seed(0), (4, 7, 5)
    motions = [torch.randn(3, length, 2, 3, generator=random) for length in frames]
    expected = np.mean([x.double().var(0).sum(-1).mean().item() for x in motions])
    listed = [(text, motion) for text, of_text in enumerate(motions) for motion in of_text]
    metric = diversity.JointVariance(samples=3)
    for number in torch.randperm(9, generator=random).tolist():
        text, motion = listed[number]
        mask = torch.ones(1, len(motion), dtype=torch.bool)
        groups, names = torch.tensor([[30, 10, 20][text]]), torch.tensor([(number * 5) % 9])
        metric.update(motion[None], mask, groups=groups, keys=names)
    assert metric.compute() == pytest.approx(expected, rel=1e-6)


def test_the_median_rank_of_an_even_number_of_texts_is_between_two_ranks():
    similarity = torch.tensor(
        [
            [9.0, 1.0, 2.0, 3.0],  # rank 1 of its motion
            [5.0, 4.0, 1.0, 2.0],  # rank 2
            [3.0, 4.0, 2.0, 1.0],  # rank 3
            [4.0, 3.0, 2.0, 1.0],  # rank 4
        ]
    )
    values = whole_set_retrieval(similarity)
    assert values["t2m_median"] == 2.5
    assert [values[f"t2m_top{k}"] for k in TMR_TOP] == [0.25, 0.5, 0.75, 1, 1]
    # The ranks in the columns are 1, 1.5 (a tie), 2 (a tie of three) and 3.5
    assert values["m2t_median"] == 1.75
