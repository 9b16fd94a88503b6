"""Counter-based random numbers.

A random number depends on its purpose, not on the order in which numbers are drawn.

In a sampling run, each element of a motion's noise is a function of its index and of (seed,
replication, id). The noise therefore does not depend on the batch, the padding, the number of ranks
or the device. The noise is computed by hashing a counter (splitmix64: Steele, Lea and Flood 2014,
"Fast splittable pseudorandom number generators") and mapping the hash to the normal distribution
(Box and Muller 1958).
"""

import hashlib
import math
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from flame_mdm.batch import Noise

Counters = TypeVar("Counters", Tensor, np.ndarray)


def key(*parts: str | int) -> int:
    """Hashes strings and integers to a 63-bit number that is the same on every machine.

    Example:
        >>> key("noise", 0, "clip_1") == key("noise", 0, "clip_1"), key("noise", 0, "clip_2") < 2**63
        (True, True)
    """
    text = "\x1f".join(str(part) for part in parts)
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big") >> 1


def seed_generator(number: int, device: torch.device) -> None:
    """Seeds torch's random number generators for the CPU and for `device`.

    `torch.manual_seed` seeds the generators for all devices, which takes longer: about a
    millisecond if CUDA is not initialized.
    """
    torch.default_generator.manual_seed(number)
    if device.type != "cpu":
        torch.get_device_module(device).manual_seed(number)


# Constants of splitmix64, as signed 64-bit integers
_GOLDEN, _MIX1, _MIX2 = (
    v - (1 << 64) for v in (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB)
)


def _shift_right(x: Counters, bits: int) -> Counters:
    return (x >> bits) & ((1 << (64 - bits)) - 1)


def _hash(x: Counters) -> Counters:
    x = x + _GOLDEN
    x = (x ^ _shift_right(x, 30)) * _MIX1
    x = (x ^ _shift_right(x, 27)) * _MIX2
    return x ^ _shift_right(x, 31)


def integers(keys: np.ndarray) -> Callable[[Any], np.ndarray]:
    """Returns a function `draw(count)` that draws uniform integers (B,) from 0 to count - 1.

    `count` is an integer below 2^31, or an int64 array (B,) with one such integer per key. Each
    call draws new integers.
    """
    state = keys

    def below(count: Any) -> np.ndarray:
        nonlocal state
        state = _hash(state)
        return (_shift_right(state, 33) * count) >> 31

    return below


def uniform(keys: Tensor, shape: Sequence[int]) -> tuple[Tensor, Tensor]:
    """Returns two independent uniform draws in (0, 1) for keys (B,).

    Each draw is a float32 tensor of shape (B, *shape).
    """
    positions = torch.arange(math.prod(shape), device=keys.device).reshape(1, *shape)
    bits = _hash(_hash(keys).reshape(-1, *[1] * len(shape)) + positions * _GOLDEN)
    scale = 2.0**-24
    return ((bits & 0xFFFFFF) + 0.5) * scale, ((_shift_right(bits, 40) & 0xFFFFFF) + 0.5) * scale


def normal(keys: Tensor, frames: int, features: int) -> Tensor:
    """Returns float32 standard normal noise (B, F, D) for int64 keys (B,).

    The noise is computed as in Box and Muller 1958. Element (f, d) of the noise for a key does not
    depend on B or F.

    Example:
        >>> keys = torch.tensor([key("a"), key("b")])
        >>> torch.equal(normal(keys, 4, 3)[1:], normal(keys[1:], 6, 3)[:, :4])
        True
    """
    pairs = (features + 1) // 2
    u, v = uniform(keys, (frames, pairs))
    radius, angle = torch.sqrt(-2 * torch.log(u)), 2 * math.pi * v
    return torch.stack([radius * torch.cos(angle), radius * torch.sin(angle)], -1).flatten(2)[
        ..., :features
    ]


def seeded_noise(
    ids: Sequence[str], frames: int, features: int, *, seed: int, replication: int, like: Tensor
) -> Noise:
    """Returns the noise of a sampling run.

    Args:
        ids: names of the B motions.
        frames: number of frames F.
        features: number of features D.
        seed: seed of the sampling run.
        replication: index of the replication, used to sample several motions per id.
        like: a tensor whose device and precision the noise should have.

    Returns:
        A function that maps the draw index (0, 1, 2, ...) to noise (B, F, D).
    """
    keys = torch.tensor([key("noise", seed, replication, name) for name in ids], device=like.device)
    return lambda draw: normal(_hash(keys + draw), frames, features).to(like.dtype)
