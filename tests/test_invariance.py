"""Values of metrics, losses and validations are the same for any batches, order and number of processes."""

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest
import torch
from support.distributed import GlooPool
from support.motions import keys, wander
from torch import Tensor
from torchmetrics import Metric

from evaluators.extractors.classifier import ClassifierTask
from evaluators.extractors.motion_clip import MotionCLIP, PooledLoss, info_nce
from evaluators.extractors.stgcn import JointSTGCN
from evaluators.extractors.t2m_training import MatchingLoss
from evaluators.metrics import (
    accuracy,
    alignment,
    claims,
    distribution,
    diversity,
    memorization,
    physics,
    published_physics,
    reconstruction,
    retrieval,
    update_metrics,
)
from evaluators.metrics.samples import SampleMetric
from flame_mdm.batch import MotionBatch, length_mask
from flame_mdm.conditions import Unconditional
from flame_mdm.errors import UserError
from flame_mdm.representations.humanml import HumanML
from flame_mdm.representations.skeleton import KIT21
from flame_mdm.seeds import key


def all_metrics() -> dict[str, Metric]:
    """Every metric, with numbers small enough for the samples of `evaluation`."""
    return {
        "fid": distribution.FrechetMotionDistance(),
        "kid": distribution.KernelMotionDistance(subsets=5, subset_size=20),
        "kid_replace": distribution.KernelMotionDistance(subsets=5, subset_size=20, replace=True),
        "precision_recall": distribution.PrecisionRecall(),
        "texts_for_motion": alignment.TextsForMotion(pool=8),
        "motions_for_text": alignment.MotionsForText(pool=8),
        "mm_dist": alignment.MultimodalDistance(),
        "mclip": alignment.MotionCLIPScore(),
        "mid": alignment.MutualInformationDivergence(),
        "diversity_text": diversity.Diversity(pairs=30, replace=False),
        "diversity_action": diversity.Diversity(pairs=50, replace=True),
        "multimodality_text": diversity.TextMultimodality(samples=5, pairs=3),
        "multimodality_class": diversity.ActionMultimodality(),
        "joint_variance": diversity.JointVariance(samples=5),
        "accuracy": accuracy.ActionAccuracy(),
        "temos": reconstruction.TemosPositionErrors(),
        "flame": reconstruction.FlamePositionErrors(KIT21.parents),
        "temos_best": reconstruction.TemosPositionErrors(samples=5),
        "displacement": reconstruction.DisplacementErrors(),
        "kept_drift": reconstruction.KeptDrift(),
        "penetration": physics.Penetration(),
        "floating": physics.Floating(),
        "jitter": physics.Jitter(20.0),
        "static": physics.StaticShare(20.0),
        "skating": physics.FootSkating(20.0),
        "claims": claims.ClaimAccuracy(20.0),
        "mbench": published_physics.MBenchQuality(20.0),
        "kimodo": published_physics.KimodoQuality(20.0),
        "kimodo_constraints": published_physics.KimodoConstraints(),
        "pfc": published_physics.PhysicalFootContact(30.0),
        "transitions": published_physics.TransitionJerk(20.0, window=8),
        "multi_positive": retrieval.MultiPositiveRPrecision(),
        "tmr": retrieval.TMRRetrieval(),
        "nearest": memorization.NearestTraining(),
        "motion_clip_loss": PooledLoss(),
        "t2m_loss": MatchingLoss(2.0),
    }


PROMPTS, SAMPLES, WIDTH = 9, 5, 6
COUNT = PROMPTS * SAMPLES


def evaluation(count: int = COUNT) -> dict[str, Any]:
    """Features of 45 motions and of as many real ones: 9 prompts with 5 motions each."""
    generator = torch.Generator().manual_seed(0)
    prompts = torch.arange(COUNT) // SAMPLES
    lengths = 10 + 3 * prompts
    motions = [wander(21, int(n), i) for i, n in enumerate(lengths)]
    frames = int(lengths.max())
    joints = torch.stack([torch.cat([m, torch.zeros(frames - len(m), 21, 3)]) for m in motions])
    values = {
        "generated": torch.randn(COUNT, WIDTH, generator=generator),
        "text": torch.randn(COUNT, WIDTH, generator=generator),
        "text_keys": keys(COUNT, "text"),
        "logits": torch.randn(COUNT, 4, generator=generator),
        "labels": torch.arange(COUNT) % 4,
        "groups": torch.tensor([key("prompt", int(p)) for p in prompts]),
        "joints": joints,
        "mask": length_mask(lengths, frames),
        "keys": keys(COUNT, "motion"),
        "real": torch.randn(COUNT, WIDTH, generator=generator) + 0.5,
        "real_joints": joints + 0.01 * torch.randn(joints.shape, generator=generator).cumsum(1),
        "real_mask": length_mask(lengths, frames),
        "real_keys": keys(COUNT, "real"),
        "kept": torch.rand(COUNT, frames, 21, generator=generator) < 0.5,
        "captions": np.array([f"Walk {i // 2}." for i in range(COUNT)]),
        "contacts": torch.rand(COUNT, frames, 4, generator=generator) < 0.5,
        "nearest": torch.rand(COUNT, 2, generator=generator),
        "real_nearest": torch.rand(COUNT, 2, generator=generator),
    }
    return {name: value[:count] for name, value in values.items()}


def batches(values: dict[str, Any], indices: Iterable[Tensor]) -> list[dict[str, Any]]:
    """Rows in batches, each cut to its longest motion."""
    result = [{name: value[index.numpy()] for name, value in values.items()} for index in indices]
    for batch in result:
        longest = int(batch["mask"].sum(1).max())
        for name in ("joints", "mask", "real_joints", "real_mask", "kept", "contacts"):
            batch[name] = batch[name][:, :longest].contiguous()
    return result


def measure(metrics: dict[str, Metric], inputs: list[dict[str, Any]]) -> dict[str, Any]:
    for batch in inputs:
        update_metrics(metrics, scale=torch.tensor(3.0), **batch)
    return {name: metric.compute() for name, metric in metrics.items()}


@pytest.fixture(scope="module")
def expected() -> dict[str, Any]:
    """Values of all metrics from one batch."""
    values = measure(all_metrics(), batches(evaluation(), [torch.arange(COUNT)]))
    assert None not in values.values()
    return values


@pytest.mark.parametrize("size", [7, 32])
def test_values_depend_neither_on_the_batch_size_nor_on_the_order(
    size: int, expected: dict[str, Any], subtests
):
    order = torch.randperm(COUNT, generator=torch.Generator().manual_seed(1))
    for indices in (torch.arange(COUNT), order):
        with subtests.test(indices=indices):
            assert measure(all_metrics(), batches(evaluation(), indices.split(size))) == expected


def test_draws_depend_on_the_seed(expected: dict[str, Any]):
    metrics = {name: metric for name, metric in all_metrics().items() if hasattr(metric, "seed")}
    for metric in metrics.values():
        metric.seed = 1  # type: ignore[assignment]
    values = measure(metrics, batches(evaluation(), [torch.arange(COUNT)]))
    assert len(metrics) == 10
    assert not [name for name in metrics if values[name] == expected[name]]


@pytest.mark.slow
def test_values_do_not_depend_on_the_number_of_processes(
    pool: GlooPool, expected: dict[str, Any], subtests
):
    """Samples dealt in turn, all to one of the two, and none at all."""
    values = evaluation()
    for first in (range(0, COUNT, 2), range(COUNT)):
        with subtests.test(first=first):
            shares = [
                torch.tensor(list(share), dtype=torch.long)
                for share in (first, set(range(COUNT)) - set(first))
            ]
            inputs = [batches(values, share.split(7)) if len(share) else [] for share in shares]
            results = pool.run(measure, *[(all_metrics(), batch) for batch in inputs])
            assert results == [expected, expected], first
    empty = measure(all_metrics(), [])
    assert pool.run(measure, (all_metrics(), []), (all_metrics(), [])) == [empty, empty]


@pytest.mark.filterwarnings("error")
def test_without_samples_values_are_none_never_0(expected: dict[str, Any]):
    none = {
        name: dict.fromkeys(value) if isinstance(value, dict) else None
        for name, value in expected.items()
    }
    assert measure(all_metrics(), []) == none


def test_too_few_samples_and_wrong_inputs_are_errors(subtests):
    values = evaluation()
    wrong = values | {"joints": values["joints"][:, :, :20]}
    kept = values | {"kept": values["kept"] | True}
    short = values | {"mask": values["mask"] & (torch.arange(34) < 1)}
    for metric, inputs, message in (
        (distribution.FrechetMotionDistance(), 1, "got 1 generated motions, but needs at least 2"),
        (
            distribution.KernelMotionDistance(),
            45,
            "got 45 generated motions for subsets of 1000, but needs at least 1000",
        ),
        (
            distribution.PrecisionRecall(),
            3,
            "got 3 motions in the smaller set, but needs at least 4",
        ),
        (alignment.TextsForMotion(), 31, "got 31 different captions, but needs at least 32"),
        (alignment.MotionsForText(), 31, "got 31 motions, but needs at least 32"),
        (retrieval.MultiPositiveRPrecision(), 31, "got 31 motions, but needs at least 32"),
        (
            published_physics.MBenchQuality(30.0),
            45,
            "only defined at 20 frames per second, but the motions have 30",
        ),
        (
            published_physics.PhysicalFootContact(20.0),
            45,
            "only defined at 30 frames per second, but the motions have 20",
        ),
        (alignment.MutualInformationDivergence(), 12, "got 12 samples for the features of motion"),
        (
            diversity.Diversity(pairs=300, replace=False),
            45,
            "got 45 motions for 300 pairs, but needs at least 300",
        ),
        (
            diversity.TextMultimodality(),
            45,
            "9 of 9 prompts do not have 30 motions: found 5 to 5. Generate 30 motions per prompt",
        ),
        (diversity.ActionMultimodality(), 5, "got 1 motions of class 1, but needs at least 2"),
        (reconstruction.DisplacementErrors(), kept, "a motion has no generated frame"),
        (
            reconstruction.TemosPositionErrors(),
            wrong,
            "the motions have 20 joints, but the metric is only",
        ),
        (reconstruction.TemosPositionErrors(), short, "got 1 frames"),
    ):
        with (
            subtests.test(inputs=inputs, message=message),
            pytest.raises(UserError, match=f"{type(metric).__name__}: {message}"),
        ):
            measure({"metric": metric}, [evaluation(inputs) if isinstance(inputs, int) else inputs])
    with pytest.raises(ValueError, match="MultimodalDistance: got 45 keys, 45 generated, 44 text"):
        measure(
            {"metric": alignment.MultimodalDistance()}, [values | {"text": values["text"][:-1]}]
        )
    del values["real"]
    with pytest.raises(
        UserError, match=r"metric mid \(Mut.*\): missing input: real\. Remove the metric"
    ):
        update_metrics({"mid": alignment.MutualInformationDivergence()}, **values)


def test_samples_given_twice_and_features_that_are_not_finite_are_errors(subtests):
    bad = evaluation()
    for name in ("generated", "text", "real", "joints", "logits", "nearest"):
        bad[name][3, 0] = math.nan
    for name, metric in all_metrics().items():
        with subtests.test(name=name):
            if isinstance(metric, SampleMetric):
                with pytest.raises(UserError, match="1 samples were added twice"):
                    measure(
                        {name: metric},
                        batches(evaluation(), [torch.arange(COUNT), torch.tensor([3])]),
                    )
                metric.reset()
            with pytest.raises(UserError, match="NaN or infinity"):
                measure({name: metric}, [bad])


def loss_and_gradients(
    first: int, last: int, hard: bool = False
) -> tuple[float, dict[str, torch.Tensor]]:
    """Loss of the pairs `first` to `last` of six; pairs of other processes are negatives."""
    torch.manual_seed(0)
    clip = MotionCLIP(
        7,
        10,
        latent_dim=16,
        ff_size=24,
        num_layers=2,
        num_heads=4,
        dropout=0.0,
        max_frames=20,
        embedding_dim=8,
    )
    torch.manual_seed(3)
    meaning = torch.tensor([[1, 10], [2, 20], [3, 30], [1, 40], [4, 50], [5, 20]])
    pairs = torch.randn(6, 9, 7), torch.tensor([9, 4, 7, 9, 2, 6]), torch.randn(6, 10), meaning
    x, lengths, texts, meaning = (values[first:last] for values in pairs)
    wrong = clip.text(torch.stack([texts + 0.1, texts.flip(1)], 1))
    more = {"meaning": meaning, "wrong_text": wrong} if hard else {}
    loss = info_nce(clip(x, length_mask(lengths, 9)), clip.text(texts), clip.logit_scale, **more)
    loss.backward()
    gradients = {name: p.grad for name, p in clip.named_parameters() if p.grad is not None}
    assert gradients.keys() == dict(clip.named_parameters()).keys()
    return loss.item(), gradients


@pytest.mark.slow
def test_two_processes_learn_what_one_learns_from_all_pairs(pool: GlooPool, subtests):
    for hard in (False, True):
        with subtests.test(hard=hard):
            loss, gradients = loss_and_gradients(0, 6, hard)
            (loss_a, a), (loss_b, b) = pool.run(loss_and_gradients, (0, 3, hard), (3, 6, hard))
            assert (loss_a + loss_b) / 2 == pytest.approx(loss, abs=1e-6)
            for name, gradient in gradients.items():
                torch.testing.assert_close(
                    (a[name] + b[name]) / 2, gradient, atol=1e-6, rtol=1e-4, msg=name
                )
            alone, _ = loss_and_gradients(0, 3, hard)
            assert (
                abs(alone - loss_a) > 0.05
            )  # without the others' negatives the loss is another one


def validate(rank: int, world: int) -> tuple[float, ...]:
    """Loss and accuracy of a classifier over all clips, of which this process sees every `world`-th.

    Each process has normalized batches of its own in training: its running statistics are others.
    """
    torch.manual_seed(0)
    representation = HumanML("smpl22", "clean", 20)
    network = JointSTGCN(representation.skeleton.parents, 3, widths=(4,), strides=(1,))
    task = ClassifierTask(network, Unconditional(), representation, optimizer={}).eval()
    task.val_metrics.update(task.metrics())
    x, labels = torch.randn(10, 8, representation.features), torch.arange(10) % 3
    for name, buffer in network.named_buffers():
        if "running" in name:
            buffer += rank + 0.5
    task.on_validation_epoch_start()
    mine = slice(rank, None, world)
    ids, mask = [str(number) for number in range(10)], torch.ones(10, 8, dtype=torch.bool)
    with torch.no_grad():
        task.validation_step(MotionBatch(x[mine], mask[mine], ids[mine], action=labels[mine]), 0)
    return tuple(float(metric.compute()) for metric in task.val_metrics.values())  # type: ignore[operator]


@pytest.mark.slow
def test_two_processes_validate_as_one(pool: GlooPool):
    loss, accuracy = validate(0, 1)
    first, second = pool.run(validate, (0, 2), (1, 2))
    assert first == second == (pytest.approx(loss, rel=1e-5), accuracy)
