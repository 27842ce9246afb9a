"""Normal numbers of `torchsar.core.philox` in one compiled loop.

Tensor operations go through the memory some thirty times between a word and its two normal numbers;
a loop made by `torch.compile` does so twice. Short draws, uniform numbers and orders are those of
`philox`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache

import torch
from torch import Tensor

from torchsar.core import philox
from torchsar.core.philox import permutation, uniform

__all__ = ["normal", "permutation", "uniform"]

# words of a row of the program, which draws shorter than a row do not use, and rows of one call
_WIDTH, _ROWS = 1 << 13, 1 << 7
# sine and cosine of a quarter turn times x, for x from -1/2 to 1/2, as polynomials of its square
_SINE = [(-1) ** k * (math.pi / 2) ** (2 * k + 1) / math.factorial(2 * k + 1) for k in range(8)]
_COSINE = [(-1) ** k * (math.pi / 2) ** (2 * k) / math.factorial(2 * k) for k in range(9)]


def normal(keys: Sequence[int], shape: Sequence[int], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Draw standard normal numbers, equal to those of `philox.normal` to rounding.

    Args:
        keys: Key of each trial, of 128 bits.
        shape: Shape of the numbers of one trial.
        dtype: Real or complex dtype.
        device: Device on which the numbers are computed.

    Returns:
        Numbers of shape (trial, *shape) with mean zero and a mean square magnitude of one; complex
        ones are circular.

    Raises:
        RuntimeError: If the loop cannot be compiled, such as for want of a C++ compiler.
    """
    per_word = 1 if dtype.is_complex else 2
    count = math.prod(shape)
    if not keys or count < per_word * _WIDTH:
        return philox.normal(keys, shape, dtype, device)
    # at least two rows, since the program for a single one is another
    n_rows = max(2, -(-count // (per_word * _WIDTH)))
    table = philox.key_table(keys).to(device).repeat_interleave(n_rows, 0)
    first = (torch.arange(n_rows, device=device) * (_WIDTH // 4)).repeat(len(keys))
    out = torch.empty(len(table), _WIDTH, dtype=dtype.to_complex(), device=device)
    parts = -(-len(table) // _ROWS)
    for place, some, begin in zip(*(x.tensor_split(parts) for x in (out, table, first)), strict=True):
        torch.complex(*_loop(per_word, dtype.to_real(), some, begin), out=place)
    made = out if dtype.is_complex else torch.view_as_real(out)
    return made.reshape(len(keys), -1)[:, :count].reshape(len(keys), *shape)


def _loop(scale: int, dtype: torch.dtype, keys: Tensor, first: Tensor) -> tuple[Tensor, Tensor]:
    """Real and imaginary parts of the numbers of rows, (row, word), by the compiled loop."""
    program = _compiled(scale, dtype)
    try:
        return program(keys, first)
    except RuntimeError as error:
        from torch._dynamo.exc import BackendCompilerFailed  # torch.compile has imported it

        if not isinstance(error, BackendCompilerFailed):
            raise
        raise RuntimeError(
            "torch.compile could not make the loop for random numbers of source 'philox_compiled': "
            f"{error.inner_exception}. Install what it needs (on a CPU a C++ compiler), or take source "
            "'philox', whose numbers are equal to rounding"
        ) from error


@cache
def _compiled(scale: int, dtype: torch.dtype) -> Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]:
    """The function of keys and first blocks of rows that `_loop` calls."""

    def parts(keys: Tensor, first: Tensor) -> tuple[Tensor, Tensor]:
        counter = torch.arange(1, _WIDTH // 4 + 1, dtype=torch.int64, device=keys.device)
        words = philox.words_of_blocks(keys, first[:, None] + counter)
        radius = philox.radius_of(words, scale)
        cosine, sine = _cosine_and_sine(words & philox.LOW)
        return (cosine * radius).to(dtype), (sine * radius).to(dtype)

    return torch.compile(parts, fullgraph=True, dynamic=True, options={"cpp.dynamic_threads": True})


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
