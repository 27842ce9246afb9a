"""Centred Fourier transforms that move the samples and their axis together."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import torch
from torch import Tensor

from torchsar.core.signal import Signal


def centred_fft(x: Tensor, dim: int = -1) -> Tensor:
    """X(f) = sum_i x[i] exp(-2j pi f (i - n//2)), frequencies -n//2 .. in rising order.

    Differentiable; inverse: centred_ifft.
    """
    return torch.fft.fftshift(torch.fft.fft(torch.fft.ifftshift(x, dim=dim), dim=dim), dim=dim)


def centred_ifft(x: Tensor, dim: int = -1) -> Tensor:
    """Inverse of centred_fft."""
    return torch.fft.fftshift(torch.fft.ifft(torch.fft.ifftshift(x, dim=dim), dim=dim), dim=dim)


def fft_lines(x: Tensor, inverse: bool = False, n: int | None = None) -> Tensor:
    """FFT along -2 that rounds alike for any number of trials: left to itself, the library takes
    another path for a single matrix.

    x: (..., line, range); n: length, by default that of x. Differentiable.
    """
    transform = torch.fft.ifft if inverse else torch.fft.fft
    return _ContiguousGradient.apply(transform(_ContiguousGradient.apply(x).mT.contiguous(), n)).mT


class _ContiguousGradient(torch.autograd.Function):
    """Passes its input on; gradients come back contiguous, so that their transform rounds alike for
    any number of trials too.
    """

    generate_vmap_rule = True

    @staticmethod
    def forward(x: Tensor) -> Tensor:
        return x.view_as(x)

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        pass

    @staticmethod
    def jvp(ctx: Any, tangent: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        return tangent.view_as(tangent)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        return gradient.contiguous()


def to_frequency(signal: Signal, name: str) -> Signal:
    """The named axis and its samples in frequency (`pulse` -> `doppler` in Hz, `range` ->
    `range_frequency` in 1/m).

    Phases refer to the middle sample (n // 2) of the axis, not to its coordinate zero.
    """
    return signal.with_axis(centred_fft(signal.data, signal.dim(name)), **{name: signal.axis(name).dual()})


def from_frequency(signal: Signal, name: str) -> Signal:
    """Inverse of to_frequency; `name` is the frequency axis. Restores the original axis."""
    return signal.with_axis(centred_ifft(signal.data, signal.dim(name)), **{name: signal.axis(name).dual()})


def block_bytes_of(device: torch.device) -> int:
    """Size of the blocks that large arrays are worked on in: what stays in the cache of a CPU core,
    much more on an accelerator.
    """
    return 1 << 20 if device.type == "cpu" else 1 << 28


def over_blocks(work: Callable[[Any], None], parts: Iterable[Any], like: Tensor) -> None:
    """Call work on every part of an array, in as many threads as torch uses; not differentiable.

    like: the array.

    Each thread works on blocks of its own with one-threaded operations: nothing waits for a slower
    thread at every operation, which on a busy machine costs several times the work itself. Few
    blocks, accelerators and torch.func transforms go one after another.
    """
    parts, threads = list(parts), torch.get_num_threads()
    if threads == 1 or len(parts) < 2 * threads or like.device.type != "cpu" or not _has_storage(like):
        for part in parts:
            work(part)
        return
    inference = torch.is_inference_mode_enabled()

    def one(part: Any) -> None:
        # modes and thread counts belong to a thread
        torch.set_num_threads(1)
        with torch.inference_mode(inference), torch.no_grad():
            work(part)

    try:
        with ThreadPoolExecutor(threads) as pool:
            for _ in pool.map(one, parts):
                pass
    finally:
        # the mathematics library counts threads for the whole process
        torch.set_num_threads(threads)


def _has_storage(x: Tensor) -> bool:
    """False inside torch.func transforms, whose state does not pass to other threads."""
    try:
        return x.data_ptr() != 0
    except RuntimeError:
        return False


def transform_in_blocks(
    x: Tensor, dim: int, inverse: bool = False, out: Tensor | None = None, block_bytes: int | None = None
) -> Tensor:
    """FFT of x along -1 or -2 into `out` (x itself by default), by blocks that stay in the cache;
    not differentiable.

    A pass along -2 gathers a few columns into the cache, transforms them there and puts them back:
    two to four times as fast as one call on the large array, and needs no second array (unless
    `out` is not contiguous).
    """
    out = x if out is None else out
    transform = torch.fft.ifft if inverse else torch.fft.fft
    if not out.is_contiguous():
        return out.copy_(transform(x, dim=dim))
    source, target = (y.reshape(-1, *y.shape[-2:]) if dim == -2 else y.reshape(-1, y.shape[-1]) for y in (x, out))

    block_bytes = block_bytes_of(x.device) if block_bytes is None else block_bytes
    several = (
        dim == -2 and block_bytes // 16 // (source[0].numel() * source.element_size()) > 1
    )  # small trials share blocks, the last may hold one

    def work(part: tuple[slice, ...]) -> None:
        target[part] = fft_lines(source[part], inverse) if several else transform(source[part].contiguous(), dim=dim)

    over_blocks(work, _blocks(source, dim, block_bytes), out)
    return out


def spectrum_in_blocks(x: Tensor) -> Tensor:
    """fft2 of x (..., pulse, range) into a new array, by whole trials where they fit the cache,
    else pass by pass; not differentiable.
    """
    out = torch.empty_like(x, memory_format=torch.contiguous_format)
    if x.shape[-2] * x.shape[-1] * x.element_size() > 4 * block_bytes_of(x.device):
        return transform_in_blocks(transform_in_blocks(x, -1, out=out), -2)
    source, target = x.reshape(-1, *x.shape[-2:]), out.view(-1, *x.shape[-2:])

    def work(trial: int) -> None:
        target[trial] = torch.fft.fft2(source[trial])

    over_blocks(work, range(source.shape[0]), out)
    return out


def _blocks(x: Tensor, dim: int, block_bytes: int) -> Iterator[tuple[slice, ...]]:
    """Slices of (row, n) for a transform along -1, of (trial, n, column) for one along -2: trials
    where they fit, else their columns.

    Trials go one by one unless they are tiny: a strided transform of several makes torch copy them
    first.
    """
    item = x[0].numel() * x.element_size()
    if dim == -1 or item <= block_bytes:
        height = max(1, (block_bytes if dim == -1 else block_bytes // 16) // item)
        yield from ((slice(first, first + height),) for first in range(0, x.shape[0], height))
        return
    width = max(16, block_bytes // (x.shape[-2] * x.element_size()))
    for trial in range(x.shape[0]):
        yield from (
            (slice(trial, trial + 1), slice(None), slice(first, first + width))
            for first in range(0, x.shape[-1], width)
        )
