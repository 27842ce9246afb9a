"""Normal numbers from a generator whose words suit a compiled loop.

The words are those of Threefry4x32 with 13 rounds (Salmon, Moraes, Dror and Shaw, "Parallel random
numbers: as easy as 1, 2, 3", SC 2011): sums, rotations and exclusive ors of 32 bits, of which
vector units of all processors compute many at a time. A loop made by `torch.compile` computes from
the numbers of blocks to normal numbers without going through the memory. Short draws, uniform
numbers and orders are those of `philox`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache
from threading import Lock
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils._python_dispatch import _disable_current_modes  # pyright: ignore[reportPrivateUsage]

from torchsar.core import philox
from torchsar.core.philox import permutation, uniform

__all__ = ["normal", "permutation", "uniform"]

# the fewest rounds of which the authors publish known answers; bits of neighbouring blocks are
# correlated up to seven rounds, as measured with 2**23 blocks
_ROUNDS = 13
# rotations of both pairs of words in each round, again from the first after eight rounds, and the
# constant of the fifth word of the key (Salmon et al., section 3.2)
_ROTATIONS = ((10, 26), (11, 21), (13, 27), (23, 5), (6, 20), (17, 11), (25, 10), (18, 20))
_PARITY = 0x1BD11BDA
# complex numbers of a trial from which on the loop pays, and blocks of one call
_LONG, _BLOCKS = 1 << 14, 1 << 17
# keys of the test of a new loop, and blocks of each
_TEST_KEYS = [i * 0x9E3779B97F4A7C15F39CC0605CEDC835 % (1 << 128) for i in range(1, 9)]
_TEST_BLOCKS = 4099
# bits of the square root of 1/2 in float32, and those behind the exponent
_ROOT_HALF, _FRACTION = 0x3F3504F3, (1 << 23) - 1

# numbers of blocks, the schedule of a key, and the places of both complex numbers of each block, to
# be filled in: their bits in single precision, real and imaginary parts in double precision
Loop = Callable[[Tensor, Tensor, Tensor, Tensor], object]
_lock = Lock()


def schedule(keys: Sequence[int]) -> Tensor:
    """Compute what Threefry4x32-13 adds to its words, at first and after every four rounds.

    Args:
        keys: Keys of 128 bits.

    Returns:
        The addends of each key, (addition, word, key), int32 that holds the bits of unsigned
        numbers.
    """
    key = np.frombuffer(b"".join(key.to_bytes(16, "little") for key in keys), "<u4").reshape(-1, 4).T
    key = np.concatenate([key, np.bitwise_xor.reduce(key, 0, keepdims=True) ^ np.uint32(_PARITY)])
    addends = np.stack([key[(i + np.arange(4)) % 5] for i in range(_ROUNDS // 4 + 1)])
    addends[:, 3] += np.arange(len(addends), dtype=np.uint32)[:, None]
    return torch.from_numpy(addends.astype(np.uint32).view(np.int32))


def words(addends: Tensor, counter: Sequence[Tensor]) -> list[Tensor]:
    """Compute words of Threefry4x32-13 by tensor operations.

    Args:
        addends: Result of `schedule`, (addition, word, ...).
        counter: The four words of the counter of each block, int32.

    Returns:
        The four words of each block, int32 that holds the bits of unsigned numbers.

    Reference:
        Salmon, Moraes, Dror and Shaw, SC 2011, section 3.2.
    """
    x = [word + addends[0, i] for i, word in enumerate(counter)]
    for i in range(_ROUNDS):
        for to, partner, by in zip((0, 2), (1, 3) if i % 2 == 0 else (3, 1), _ROTATIONS[i % 8], strict=True):
            x[to] = x[to] + x[partner]
            # a rotation, whose halves are joined last, so that processors compute more at a time
            low = (x[partner] >> (32 - by)) & ((1 << by) - 1)
            x[partner] = (x[to] ^ (x[partner] << by)) ^ low
        if i % 4 == 3:
            x = [word + addends[i // 4 + 1, n] for n, word in enumerate(x)]
    return x


def normal(keys: Sequence[int], shape: Sequence[int], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Draw standard normal numbers by the transform of Box and Muller.

    A block of four words gives two complex numbers: one in the first half of a trial, with the
    radius and the angle of its first two words, and one in the second half with those of its other
    two. Real and imaginary parts of complex numbers are two real ones. No number lies beyond the
    largest radius of 6.76 standard deviations, sqrt(66 ln 2); of true normal numbers, one in 7e10
    does. Numbers of single precision are computed in that precision: complex ones are equal to
    those of double precision to ten units of rounding of their magnitude.

    Args:
        keys: Key of each trial, of 128 bits.
        shape: Shape of the numbers of one trial. Draws of few numbers are those of `philox.normal`.
        dtype: Real or complex dtype; numbers of less than single precision are converted from it.
        device: Device on which the numbers are computed.

    Returns:
        Numbers of shape (trial, *shape) with mean zero and a mean square magnitude of one; complex
        ones are circular.

    Raises:
        RuntimeError: If the loop cannot be compiled, such as for want of a C++ compiler, or gives
            wrong numbers.
    """
    count, per_complex = math.prod(shape), 1 if dtype.is_complex else 2
    # tensors without numbers, such as those of device "meta", are no operands of a program
    plain = torch.empty(0, device=device)
    if not keys or count < per_complex * _LONG or plain.is_meta or type(plain) is not Tensor:
        return philox.normal(keys, shape, dtype, device)
    computed = torch.complex128 if dtype in (torch.float64, torch.complex128) else torch.complex64
    # without what torch.func.grad and others put about tensors: a program wants their memory
    with torch._C._DisableFuncTorch(), torch.inference_mode(False), torch.no_grad():
        with _lock:
            loop = _tested(computed, device)
        made = _drawn(loop, keys, -(-count // (2 * per_complex)), computed, device)
        if not dtype.is_complex:
            made = torch.view_as_real(made).flatten(-2).mul_(math.sqrt(2))
        return made[:, :count].to(dtype).contiguous().reshape(len(keys), *shape)


def _drawn(loop: Loop, keys: Sequence[int], blocks: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Complex numbers of so many blocks by the loop, (key, 2 block)."""
    out = torch.empty(len(keys), 2 * blocks, dtype=dtype, device=device)
    counter = torch.arange(blocks, dtype=torch.int32, device=device)
    places = out.view(torch.int64) if dtype == torch.complex64 else torch.view_as_real(out)
    for place, addends in zip(places, schedule(keys).movedim(-1, 0).contiguous().to(device), strict=True):
        parts = (half.split(_BLOCKS) for half in place.tensor_split(2))
        for some, first, second in zip(counter.split(_BLOCKS), *parts, strict=True):
            loop(some, addends, first, second)
    return out


def _expected(keys: Sequence[int], blocks: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """The numbers of `_drawn`, by tensor operations in double precision."""
    counter = torch.arange(blocks, dtype=torch.int32, device=device)
    found = words(schedule(keys).to(device)[..., None], [counter] * 4)
    halves = [torch.complex(*_parts(*found[i : i + 2])) for i in (0, 2)]
    return torch.cat(halves, -1).to(dtype)


@cache
def _tested(dtype: torch.dtype, device: torch.device) -> Loop:
    """The loop, once it gives the numbers of tensor operations."""
    loop, size = _compiled(dtype, device), (_TEST_KEYS, _TEST_BLOCKS, dtype, device)
    found, expected = _drawn(loop, *size), _expected(*size)
    if not bool(((found - expected).abs() < 20 * torch.finfo(dtype).eps * expected.abs()).all()):
        raise RuntimeError(
            "torch.compile made a loop for random numbers of source 'threefry' that gives wrong ones with this "
            "compiler; take source 'philox'"
        )
    return loop


def _compiled(dtype: torch.dtype, device: torch.device) -> Loop:
    """The program alone: the function that torch.compile returns would make further programs for
    other states of torch, without a test, and refuses to run under dispatch modes.
    """
    programs: list[Loop] = []

    def fill(counter: Tensor, addends: Tensor, first: Tensor, second: Tensor) -> None:
        # in all four words of the counter, so that the compiler has nothing to compute with signed
        # scalars, whose overflow C++ leaves undefined
        a, b, c, d = words(addends, [counter] * 4)
        for place, high, low in ((first, a, b), (second, c, d)):
            if dtype == torch.complex64:
                place.copy_(_bits(*_single_parts(high, low)))
            else:
                place.copy_(torch.stack(_parts(high, low), -1))

    def backend(graph: torch.fx.GraphModule, inputs: list[Any]) -> Any:
        from torch._inductor.compile_fx import compile_fx  # the compiler takes seconds to import

        options = {"cpp.dynamic_threads": True, "cpp.enable_floating_point_contract_flag": "fast"}
        program: Any = compile_fx(graph, inputs, config_patches=options)
        sizes = [not isinstance(x, Tensor) for x in inputs]  # each is the number of blocks

        def loop(*tensors: Tensor) -> object:
            operands = iter(tensors)
            return program(*(len(tensors[0]) if size else next(operands) for size in sizes))

        programs.append(loop)
        return program

    try:
        with _disable_current_modes():
            place = torch.empty(_TEST_BLOCKS, dtype=dtype, device=device)
            place = place.view(torch.int64) if dtype == torch.complex64 else torch.view_as_real(place)
            operands = torch.arange(_TEST_BLOCKS, dtype=torch.int32, device=device), place.clone(), place.clone()
            for x in operands:
                torch._dynamo.mark_dynamic(x, 0)
            addends = schedule([0])[..., 0].to(device)
            torch.compile(fill, backend=backend, fullgraph=True)(operands[0], addends, *operands[1:])
        if not programs:
            raise RuntimeError("it is switched off")
    except Exception as error:
        raise RuntimeError(
            "torch.compile could not make the loop for random numbers of source 'threefry': "
            f"{getattr(error, 'inner_exception', error)}. Install what it needs (on a CPU a C++ compiler), or take "
            "source 'philox'"
        ) from error
    return programs[0]


def _parts(high: Tensor, low: Tensor) -> tuple[Tensor, Tensor]:
    """Real and imaginary parts in float64, from words for the radius and for the angle."""
    signed = (high.to(torch.float64) + 0.5) * 2.0**-32
    radius = torch.sqrt(-torch.log(torch.where(high < 0, signed + 1, signed)))
    angle = low.to(torch.float64) * (math.acos(-1) * 2.0**-31)
    return angle.cos() * radius, angle.sin() * radius


def _single_parts(high: Tensor, low: Tensor) -> tuple[Tensor, Tensor]:
    """The numbers of `_parts` in float32.

    Numbers are literals here, as torch.compile takes those of modules for inputs.
    """
    # the uniform number or, if that exceeds 1/2, its difference from one: both exact where small
    signed = (high.to(torch.float32) + 0.5) * 2.0**-32
    bits = torch.where(high < 0, signed + 1, signed).view(torch.int32) - _ROOT_HALF
    exponent, mantissa = bits >> 23, ((bits & _FRACTION) + _ROOT_HALF).view(torch.float32)
    excess = torch.where(exponent == 0, signed, mantissa - 1)
    ratio = excess / (2 + excess)
    areas = _polynomial([1 / (2 * k + 1) for k in range(5)], ratio * ratio)
    radius = torch.sqrt(-(exponent.to(torch.float32) * math.log(2) + 2 * ratio * areas))
    # sine and cosine of half the angle, of at most a quarter turn
    half = low.to(torch.float32) * 2.0**-31
    series = [math.acos(0) ** k / math.factorial(k) * (-1) ** (k // 2) for k in range(15)]
    sine, cosine = half * _polynomial(series[1::2], half * half), _polynomial(series[::2], half * half)
    double = 2 * sine * radius
    return radius - double * sine, double * cosine


def _polynomial(coefficients: Sequence[float], x: Tensor) -> Tensor:
    """Value by Horner's scheme; the first coefficient is the constant one."""
    value = torch.full_like(x, coefficients[-1])
    for c in coefficients[-2::-1]:
        value = value * x + c
    return value


def _bits(real: Tensor, imaginary: Tensor) -> Tensor:
    """Bits of complex numbers of single precision, which the loop writes as one number each."""
    low, high = (x.view(torch.int32).to(torch.int64) for x in (real, imaginary))
    return (high << 32) | (low & ((1 << 32) - 1))
