"""Noise of sampling runs: its distribution, and that it depends on seed, replication, name and draw alone."""

import torch
from scipy import stats

from flame_mdm.seeds import key, normal, seeded_noise, uniform


def test_numbers_are_uniform_in_0_to_1_and_noise_is_standard_normal_and_uncorrelated(subtests):
    for number, draws in enumerate(uniform(torch.arange(500), (100,))):
        with subtests.test(number=number):
            assert 0 < draws.min() < draws.max() <= 1
            assert stats.kstest(draws.flatten().numpy(), "uniform").pvalue > 1e-3
    assert torch.isfinite(normal(torch.arange(500), 10, 5)).all()
    noise = seeded_noise(["a", "b", "c", "d"], 196, 263, seed=1, replication=0, like=torch.zeros(1))
    first, second = noise(0), noise(1)
    assert stats.kstest(first.flatten().numpy(), "norm").pvalue > 1e-3
    assert abs(first.var().item() - 1) < 0.01
    assert abs(first.pow(4).mean().item() - 3) < 0.1
    for a, b in (
        *((first, second), (first[0], first[1]), (first[:, 1:], first[:, :-1])),
        *((first[..., 1:], first[..., :-1]), (first[..., ::2][..., :131], first[..., 1::2])),
    ):
        with subtests.test(a=a, b=b):
            assert abs((a * b).mean().item()) < 0.01


def test_noise_of_a_motion_depends_on_its_name_alone(subtests):
    like = torch.zeros(1, dtype=torch.float64)
    together = seeded_noise(["a", "b"], 20, 7, seed=3, replication=1, like=like)(2)
    alone = seeded_noise(["b"], 11, 7, seed=3, replication=1, like=like)(2)
    assert torch.equal(together[1, :11], alone[0])
    assert together.dtype == torch.float64
    for seed, replication, draw in ((4, 1, 2), (3, 2, 2), (3, 1, 3)):
        with subtests.test(seed=seed, replication=replication, draw=draw):
            other = seeded_noise(["b"], 11, 7, seed=seed, replication=replication, like=like)(draw)
            assert not torch.isclose(other, alone).any()


def test_keys_and_values_are_the_same_on_every_machine():
    assert key("noise", 0, 0, "a person walks#0") == 5875030488727364246
    assert len({key("a", "bc"), key("ab", "c"), key("abc")}) == 3
    expected = torch.tensor([[1.659318, 0.165578, -1.722518], [0.365735, 0.746690, -0.594605]])
    assert torch.allclose(normal(torch.tensor([12345]), 2, 3)[0], expected, atol=1e-6)
