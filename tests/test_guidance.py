"""Classifier-free guidance as a wrapper of the denoiser."""

import pytest
import torch

from flame_mdm.batch import Condition, length_mask
from flame_mdm.processes.guidance import classifier_free_guidance
from flame_mdm.processes.samplers import CountedDenoise

MASK = length_mask(torch.tensor([4, 2]))
NULL = Condition(torch.tensor([[10.0]]), torch.zeros(1, 0, 1), None)
COND = Condition(torch.tensor([[1.0], [2.0]]), torch.zeros(2, 0, 1), None, NULL)
ZEROS = torch.zeros(2, 4, 2), torch.zeros(2)


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


def test_without_a_learned_variance_all_channels_are_guided_and_scale_one_is_the_denoiser_itself():
    x_t = torch.randn(2, 4, 2)
    guided = classifier_free_guidance(lambda *args: sees_condition(*args)[..., :2], 3.0, features=2)
    expected = (x_t + 10 + 3 * (COND.pooled[:, None] - 10)) * MASK[..., None]
    torch.testing.assert_close(guided(x_t, torch.zeros(2), MASK, COND), expected)
    assert classifier_free_guidance(sees_condition, 1, 2) is sees_condition
    with pytest.raises(ValueError, match="no null"):
        guided(*ZEROS, MASK, Condition(COND.pooled, COND.tokens, None))


def test_doubled_conditions_and_masks_are_made_once_per_run_and_follow_a_change():
    seen = []

    def denoise(x_t, t, mask, cond):
        seen.append((mask, cond))
        return x_t

    guided = classifier_free_guidance(denoise, 2.0, 2)
    other = Condition(COND.pooled + 1, COND.tokens, None, NULL)
    for mask, cond in ((MASK, COND), (MASK, COND), (MASK, other), (~MASK, COND), (MASK, COND)):
        guided(*ZEROS, mask, cond)
    masks, conditions = zip(*seen, strict=True)
    assert masks[0] is masks[1]
    assert conditions[0] is conditions[1]
    pooled = [1, 2, 10, 10]
    assert [cond.pooled.flatten().tolist() for cond in conditions] == [pooled, pooled, [2, 3, 10, 10], pooled, pooled]
    assert [torch.equal(mask, torch.cat([MASK, MASK])) for mask in masks] == [True, True, True, False, True]
