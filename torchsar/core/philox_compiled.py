"""Normal numbers of `torchsar.core.philox` in one compiled loop.

Tensor operations go through the memory some thirty times between a word and its two normal numbers;
a loop made by `torch.compile` does so twice. Short draws, uniform numbers and orders are those of
`philox`.

No whole number of the loop needs more than 63 bits and a sign: what C++ does beyond is undefined,
and compilers then leave out what they take for superfluous.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache

import torch
from torch import Tensor

from torchsar.core import philox
from torchsar.core.philox import LOW, permutation, uniform

__all__ = ["normal", "permutation", "uniform"]

# words of a row of the program, which draws shorter than a row do not use, and rows of one call
_WIDTH, _ROWS = 1 << 13, 1 << 7
# digits (high, low) of the multipliers a = 2**64 + high 2**32 + low, from -2**31 to 2**31 - 1
_DIGITS = [
    ((a - low >> 32) - (1 << 32), low)
    for a, low in ((a, (a + (1 << 31)) % (1 << 32) - (1 << 31)) for a in philox.MULTIPLIERS)
]
# sine and cosine of a quarter turn times x, for x from -1/2 to 1/2, as polynomials of its square
_SINE = [(-1) ** k * (math.pi / 2) ** (2 * k + 1) / math.factorial(2 * k + 1) for k in range(8)]
_COSINE = [(-1) ** k * (math.pi / 2) ** (2 * k) / math.factorial(2 * k) for k in range(9)]
# dtypes that the loop makes, and their real ones
_REAL = {dtype: dtype.to_real() for dtype in (torch.float32, torch.float64, torch.complex64, torch.complex128)}
# keys and rows of the test of a new loop
_TEST_KEYS = [i * 0x9E3779B97F4A7C15F39CC0605CEDC835 % (1 << 128) for i in range(1, 5)]
_TEST_ROWS = 8

# keys of all rounds and number of the first block, of each row, to real and imaginary parts
Loop = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]


def normal(keys: Sequence[int], shape: Sequence[int], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Draw standard normal numbers, equal to those of `philox.normal` to rounding.

    Args:
        keys: Key of each trial, of 128 bits.
        shape: Shape of the numbers of one trial.
        dtype: Real or complex dtype; others than those of single and double precision are drawn by
            `philox.normal`.
        device: Device on which the numbers are computed.

    Returns:
        Numbers of shape (trial, *shape) with mean zero and a mean square magnitude of one; complex
        ones are circular.

    Raises:
        RuntimeError: If the loop cannot be compiled, such as for want of a C++ compiler, or gives
            other numbers.
    """
    per_word = 1 if dtype.is_complex else 2
    count = math.prod(shape)
    if not keys or count < per_word * _WIDTH or dtype not in _REAL:
        return philox.normal(keys, shape, dtype, device)
    with torch.inference_mode(False), torch.no_grad():  # one program serves for all
        # torch.compile makes another program for each of the other states
        loop = _tested(per_word, _REAL[dtype], device, torch.get_num_threads(), torch.get_default_dtype())
        return _drawn(loop, keys, count, dtype, device).reshape(len(keys), *shape)


def _drawn(loop: Loop, keys: Sequence[int], count: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """So many numbers of each trial by the loop, (trial, number)."""
    per_word = 1 if dtype.is_complex else 2
    # at least two rows in all, since the program for a single one is another
    n_rows = max(2 if len(keys) == 1 else 1, -(-count // (per_word * _WIDTH)))
    table = philox.key_table(keys).to(device)
    rounds = torch.stack([half for pair in philox.round_keys(table) for half in pair], -1)
    rounds = torch.stack((philox.upper(rounds), rounds & LOW), -1).repeat_interleave(n_rows, 0)
    first = (torch.arange(n_rows, device=device) * (_WIDTH // 4)).repeat(len(keys))
    out = torch.empty(len(first), _WIDTH, dtype=dtype.to_complex(), device=device)
    parts = -(-len(first) // _ROWS)
    for place, some, begin in zip(*(x.tensor_split(parts) for x in (out, rounds, first)), strict=True):
        torch.complex(*loop(some.clone(), begin.clone()), out=place)  # views would make another program
    made = out if dtype.is_complex else torch.view_as_real(out)
    return made.reshape(len(keys), -1)[:, :count].contiguous()


@cache
def _tested(scale: int, dtype: torch.dtype, device: torch.device, *_: object) -> Loop:
    """The loop for this state of torch, once it gives the numbers of `philox`."""
    loop, drawn = _compiled(scale, dtype), dtype.to_complex() if scale == 1 else dtype
    count = _TEST_ROWS * _WIDTH * scale
    found = _drawn(loop, _TEST_KEYS, count, drawn, device)
    expected = philox.normal(_TEST_KEYS, (count,), drawn, device)
    if not bool(((found - expected).abs() < 50 * torch.finfo(dtype).eps).all()):
        raise RuntimeError(
            "torch.compile made a loop for random numbers of source 'philox_compiled' that gives wrong ones with this "
            "compiler; take source 'philox'"
        )
    return loop


def _compiled(scale: int, dtype: torch.dtype) -> Loop:
    """The loop, made in its first call."""

    def parts(rounds: Tensor, first: Tensor) -> tuple[Tensor, Tensor]:
        counter = torch.arange(1, _WIDTH // 4 + 1, dtype=torch.int64, device=first.device)
        words = _words(rounds, first[:, None] + counter)
        radius = philox.radius_of(words, scale)
        cosine, sine = _cosine_and_sine(words & LOW)
        return (cosine * radius).to(dtype), (sine * radius).to(dtype)

    # programs of one code object are limited in number
    parts.__code__ = parts.__code__.replace()
    program = torch.compile(parts, fullgraph=True, dynamic=True, options={"cpp.dynamic_threads": True})

    def loop(rounds: Tensor, first: Tensor) -> tuple[Tensor, Tensor]:
        try:
            return program(rounds, first)
        except Exception as error:
            from torch._dynamo import exc  # torch.compile has imported it

            if not isinstance(error, (exc.TorchDynamoException, exc.FailOnRecompileLimitHit)):
                raise
            raise RuntimeError(
                "torch.compile could not make the loop for random numbers of source 'philox_compiled': "
                f"{getattr(error, 'inner_exception', error)}. Install what it needs (on a CPU a C++ compiler), or take "
                "source 'philox', whose numbers are equal to rounding"
            ) from error

    return loop


def _words(rounds: Tensor, counter: Tensor) -> Tensor:
    """The words of blocks, (row, 4 block).

    rounds: halves (high, low) of the low and high key of each round, (row, 20, 2).
    counter: numbers of the blocks, (row, block).
    """
    zero = (torch.zeros_like(counter[:, :1]),) * 2
    a, b, c, d = (philox.upper(counter), counter & LOW), zero, zero, zero
    for i in range(0, rounds.shape[1], 2):
        low_key, high_key = (rounds[:, i + n, :, None].unbind(1) for n in range(2))
        (high_a, low_a), (high_c, low_c) = _product(*_DIGITS[0], *a), _product(*_DIGITS[1], *c)
        a = tuple(x ^ y ^ z for x, y, z in zip(high_c, b, low_key, strict=True))
        c = tuple(x ^ y ^ z for x, y, z in zip(high_a, d, high_key, strict=True))
        b, d = low_c, low_a
    return torch.stack([(high << 32) | low for high, low in (a, b, c, d)], -1).flatten(-2)


def _product(a_high: int, a_low: int, high: Tensor, low: Tensor) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
    """Halves of the high and the low 64 bits of a product (2**64 + a_high 2**32 + a_low) b.

    high, low: halves of b, from 0 to 2**32 - 1. The magnitude of a digit is at most 2**31, and that
    of each product and sum below 2**63; the shifts round down, as for digits with a sign.
    """
    last = a_low * low
    middle = a_high * low + (last >> 32)
    other = a_low * high + (middle & LOW)
    top = a_high * high + (middle >> 32) + (other >> 32)
    carry = (top & LOW) + low
    return (((top >> 32) + high + (carry >> 32)) & LOW, carry & LOW), (other & LOW, last & LOW)


def _cosine_and_sine(angle: Tensor) -> tuple[Tensor, Tensor]:
    """Cosine and sine of whole multiples of 2**-32 turns.

    The multiple of a quarter turn is split off in whole numbers, hence exactly.
    """
    quarter = (angle + (1 << 29)) >> 30
    x = (angle - (quarter << 30)).to(torch.float64) * 2.0**-30
    sine, cosine = x * _polynomial(_SINE, x * x), _polynomial(_COSINE, x * x)
    odd = (quarter & 1) == 1
    return (
        torch.where(odd, sine, cosine) * (1 - ((quarter + 1) & 2)),
        torch.where(odd, cosine, sine) * (1 - (quarter & 2)),
    )


def _polynomial(coefficients: Sequence[float], x: Tensor) -> Tensor:
    """Value by Horner's scheme; the first coefficient is the constant one."""
    value = torch.full_like(x, coefficients[-1])
    for c in coefficients[-2::-1]:
        value = value * x + c
    return value
