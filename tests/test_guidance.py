"""Classifier-free guidance as a wrapper of the denoiser."""

import pytest
import torch

from flame_mdm.batch import Condition, length_mask
from flame_mdm.processes.guidance import classifier_free_guidance
from flame_mdm.processes.samplers import CountedDenoise

MASK = length_mask(torch.tensor([4, 2]))
NULL = Condition(torch.tensor([[10.0]]), torch.zeros(1, 0, 1), None)
COND = Condition(torch.tensor([[1.0], [2.0]]), torch.zeros(2, 0, 1), None, NULL)


def sees_condition(x_t, t, mask, cond):
    """Two channels x + condition + t, and as many of a variance: the condition itself."""
    assert len(x_t) == len(t) == len(mask) == len(cond.pooled)
    mean = (x_t + cond.pooled[:, None] + t[:, None, None]) * mask[..., None]
    return torch.cat([mean, cond.pooled[:, None].expand_as(x_t)], -1)


@pytest.mark.parametrize("scale", [0.0, 2.5, torch.tensor([2.5, 0.0]), torch.tensor([1.0, 8.0])])
def test_guidance_is_two_passes_in_one(scale):
    x_t, t = torch.randn(2, 4, 2), torch.tensor([3.0, 5.0])
    denoise = CountedDenoise(sees_condition)
    guided = classifier_free_guidance(denoise, scale, features=2)(x_t, t, MASK, COND)
    with_cond = sees_condition(x_t, t, MASK, COND)
    null = sees_condition(x_t, t, MASK, COND.drop(torch.tensor([True, True])))
    strength = scale[:, None, None] if isinstance(scale, torch.Tensor) else scale
    torch.testing.assert_close(guided[..., :2], (null + strength * (with_cond - null))[..., :2])
    assert torch.equal(guided[..., 2:], with_cond[..., 2:])
    assert denoise.calls == 1


def test_the_variance_is_not_guided_away_by_a_wrong_split():
    """The prediction alone: all channels are guided."""
    x_t, t = torch.randn(2, 4, 2), torch.zeros(2)

    def mean_only(*args):
        return sees_condition(*args)[..., :2]

    guided = classifier_free_guidance(mean_only, 3.0, features=2)(x_t, t, MASK, COND)
    assert guided.shape == x_t.shape
    torch.testing.assert_close(guided, (x_t + 10 + 3 * (COND.pooled[:, None] - 10)) * MASK[..., None])


def test_scale_one_is_the_denoiser_itself():
    assert classifier_free_guidance(sees_condition, 1.0, 2) is sees_condition
    assert classifier_free_guidance(sees_condition, 1, 2) is sees_condition


def test_the_doubled_condition_is_made_once_a_run_and_follows_a_change():
    seen = []

    def denoise(x_t, t, mask, cond):
        seen.append(cond)
        return x_t

    guided = classifier_free_guidance(denoise, 2.0, 2)
    x_t, t = torch.zeros(2, 4, 2), torch.zeros(2)
    other = Condition(COND.pooled + 1, COND.tokens, None, NULL)
    for cond in (COND, COND, other, COND):
        guided(x_t, t, MASK, cond)
    assert seen[0] is seen[1]
    assert seen[2].pooled.flatten().tolist() == [2, 3, 10, 10]
    assert seen[3].pooled.flatten().tolist() == [1, 2, 10, 10]


def test_the_doubled_mask_is_made_once_a_run_and_follows_a_change():
    seen = []

    def denoise(x_t, t, mask, cond):
        seen.append(mask)
        return x_t

    guided = classifier_free_guidance(denoise, 2.0, 2)
    for mask in (MASK, MASK, ~MASK, MASK):
        guided(torch.zeros(2, 4, 2), torch.zeros(2), mask, COND)
    assert seen[0] is seen[1]
    assert torch.equal(seen[2], torch.cat([~MASK, ~MASK]))
    assert torch.equal(seen[3], torch.cat([MASK, MASK]))


def test_there_is_no_guidance_without_a_null():
    lone = Condition(COND.pooled, COND.tokens, None)
    with pytest.raises(ValueError, match="no null"):
        classifier_free_guidance(sees_condition, 2.0, 2)(torch.zeros(2, 4, 2), torch.zeros(2), MASK, lone)
