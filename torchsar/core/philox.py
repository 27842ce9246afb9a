"""Random numbers from words of a counter-based generator, computed where they are wanted.

The words are those of Philox4x64-10 (Salmon, Moraes, Dror and Shaw, "Parallel random numbers: as
easy as 1, 2, 3", SC 2011), equal to those of `numpy.random.Philox` with the same key. Each word
depends only on its key and its number, so that a device computes all words of all trials at once,
and only the keys are copied to it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
import torch
from torch import Tensor

# constants of Salmon et al.: multipliers, and what is added to the halves of the key in each round
_MULTIPLIERS = (0xD2E7470EE14C6C93, 0xCA5A826395121157)
_KEY_STEPS = (0x9E3779B97F4A7C15, 0xBB67AE8584CAA73B)
_ROUNDS = 10
_LOW = (1 << 32) - 1
# words that are processed at a time: by a thread of a CPU in its cache, elsewhere in about 300 MiB
_CPU_BLOCK, _BLOCK = 1 << 15, 1 << 22
# on a CPU, tensor operations are faster for short rows of many trials, and numpy for all others, as
# measured
_SHORT, _MANY = 64, 64


def words(keys: Tensor, first: int, count: int) -> Tensor:
    """Compute words of Philox4x64-10 by tensor operations, on the device of the keys.

    Args:
        keys: Low and high half of the key of each trial, (trial, 2), int64 that holds the bits of
            unsigned numbers.
        first: Number of the first word.
        count: Number of words.

    Returns:
        The bits of the words `first` to `first + count - 1` that `numpy.random.Philox(key=...)`
        gives, (trial, count), int64.

    Reference:
        Salmon, Moraes, Dror and Shaw, SC 2011, section 3.3; numpy counts blocks of words from one.
    """
    block, skipped = divmod(first, 4)
    blocks = -(-(skipped + count) // 4)
    # dims of size one are expanded by the operations, which saves most of the first two rounds
    counter = torch.arange(block + 1, block + blocks + 1, dtype=torch.int64, device=keys.device)[None]
    zero = torch.zeros_like(keys[:, :1])
    a, b, c, d = counter, zero, zero, zero
    for i in range(_ROUNDS):
        low_key, high_key = (keys[:, n, None] + _signed(i * step) for n, step in enumerate(_KEY_STEPS))
        (high_a, low_a), (high_c, low_c) = _product(_MULTIPLIERS[0], a), _product(_MULTIPLIERS[1], c)
        a, b, c, d = high_c ^ b ^ low_key, low_c, high_a ^ d ^ high_key, low_a
    return torch.stack((a, b, c, d), -1).flatten(-2)[:, skipped : skipped + count]


def _product(a: int, b: Tensor) -> tuple[Tensor, Tensor]:
    """High and low 64 bits of the product of an unsigned number and unsigned numbers in int64."""
    high_a, low_a, high_b, low_b = a >> 32, a & _LOW, _upper(b), b & _LOW
    middle = high_a * low_b + _upper(low_a * low_b)
    other = low_a * high_b + (middle & _LOW)
    return high_a * high_b + _upper(middle) + _upper(other), b * _signed(a)


def _upper(x: Tensor) -> Tensor:
    """The high 32 bits, as a logical shift gives them."""
    return (x >> 32) & _LOW


def _signed(x: int) -> int:
    """The number in int64 with the low 64 bits of a whole number."""
    return (x + (1 << 63)) % (1 << 64) - (1 << 63)


def _blocks(keys: Sequence[int], count: int, device: torch.device) -> Iterator[tuple[slice, int, Tensor]]:
    """Yield (trials, number of the first word, words), together `count` words per trial."""
    cpu = device.type == "cpu"
    size = _CPU_BLOCK * torch.get_num_threads() if cpu else _BLOCK
    width = max(1, min(count, size))
    height = size // width
    for row in range(0, len(keys), height):
        rows = slice(row, row + height)
        some = keys[rows]
        firsts = [(first, min(width, count - first)) for first in range(0, count, width)]
        if cpu and (width > _SHORT or len(some) < _MANY):
            sources = [np.random.Philox(key=key) for key in some]
            for first, n in firsts:
                found = np.stack([source.random_raw(n) for source in sources])
                yield rows, first, torch.from_numpy(found.view(np.int64))
        else:
            table = key_table(some).to(device)
            for first, n in firsts:
                yield rows, first, words(table, first, n)


def key_table(keys: Sequence[int]) -> Tensor:
    """Arrange keys for `words`.

    Args:
        keys: Keys of 128 bits.

    Returns:
        Their low and high halves, (key, 2), int64.
    """
    halves = [(_signed(key), _signed(key >> 64)) for key in keys]
    return torch.tensor(halves, dtype=torch.int64).reshape(-1, 2)


def normal(keys: Sequence[int], shape: Sequence[int], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Draw standard normal numbers by the transform of Box and Muller.

    Each word gives two independent numbers: its high 32 bits the radius, its low 32 bits the angle.
    They are computed in float64 and then converted, and are equal to rounding on all devices. No
    number lies beyond the largest radius of 6.76 standard deviations, sqrt(66 ln 2); of true normal
    numbers, one in 7e10 does.

    Args:
        keys: Key of each trial, of 128 bits.
        shape: Shape of the numbers of one trial.
        dtype: Real or complex dtype.
        device: Device on which the numbers are computed.

    Returns:
        Numbers of shape (trial, *shape) with mean zero and a mean square magnitude of one; complex
        ones are circular.
    """
    count, per_word = math.prod(shape), 1 if dtype.is_complex else 2
    out = torch.empty(len(keys), count, dtype=dtype, device=device)
    for rows, first, found in _blocks(keys, -(-count // per_word), device):
        unit = _upper(found).to(torch.float64).add_(0.5).mul_(2.0**-32)
        radius = unit.log_().mul_(-per_word).sqrt_()
        angle = (found & _LOW).to(torch.float64).mul_(2 * math.pi * 2.0**-32)
        both = torch.complex(angle.cos().mul_(radius), angle.sin_().mul_(radius))
        made = both if dtype.is_complex else torch.view_as_real(both).flatten(-2)
        place = out[rows, first * per_word : (first + found.shape[1]) * per_word]
        place.copy_(made[:, : place.shape[1]])
    return out.reshape(len(keys), *shape)


def uniform(
    keys: Sequence[int], shape: Sequence[int], low: float, high: float, dtype: torch.dtype, device: torch.device
) -> Tensor:
    """Draw uniform numbers from the high 53 bits of one word each, as numpy does.

    Args:
        keys: Key of each trial, of 128 bits.
        shape: Shape of the numbers of one trial.
        low: Lower limit.
        high: Upper limit.
        dtype: Dtype of the result; the numbers are computed in float64 and then converted.
        device: Device on which the numbers are computed.

    Returns:
        Numbers of shape (trial, *shape).
    """
    count = math.prod(shape)
    out = torch.empty(len(keys), count, dtype=dtype, device=device)
    for rows, first, found in _blocks(keys, count, device):
        unit = ((found >> 11) & ((1 << 53) - 1)).to(torch.float64).mul_(2.0**-53)
        out[rows, first : first + found.shape[1]] = unit.mul_(high - low).add_(low)
    return out.reshape(len(keys), *shape)


def permutation(keys: Sequence[int], counts: Sequence[int], device: torch.device) -> Tensor:
    """Draw whole numbers in random order, by sorting one word of each.

    Args:
        keys: Key of each trial, of 128 bits.
        counts: Number of whole numbers of each trial.
        device: Device on which the order is computed.

    Returns:
        Numbers 0 to count - 1 of each trial in random order, and then those from its count on in
        rising order, (trial, largest count), int64.
    """
    longest = max(counts, default=0)
    found = torch.empty(len(keys), longest, dtype=torch.int64, device=device)
    for rows, first, some in _blocks(keys, longest, device):
        found[rows, first : first + some.shape[1]] = some
    if any(count < longest for count in counts):
        last = torch.arange(longest, device=device) >= torch.tensor(counts, device=device)[:, None]
        found.masked_fill_(last, torch.iinfo(torch.int64).max)
    return found.argsort(dim=-1, stable=True)
