"""Centred Fourier transforms of signals, and transforms of large arrays in small blocks."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import torch
from torch import Tensor

from torchsar.core.host import checked_samples, is_traced
from torchsar.core.signal import Signal


def centred_fft(x: Tensor, dim: int = -1) -> Tensor:
    """Compute the Fourier transform whose phases refer to the middle sample.

    >>> import torch
    >>> from torchsar.core import centred_fft
    >>> centred_fft(torch.ones(4)).real  # frequency zero is sample n // 2
    tensor([0., 0., 4., 0.])

    X(f) = sum_i x[i] exp(-2j pi f (i - n // 2)), differentiable; the inverse is `centred_ifft`.

    Args:
        x: Samples, any shape, complex.
        dim: Dimension to transform.

    Returns:
        Spectrum of the same shape, frequencies rising from -(n // 2) / n cycles per sample.

    Raises:
        TypeError: If the samples are not complex64 or complex128, float32 or float64.
        ValueError: If there are no samples.
    """
    x = checked_samples(x, "centred_fft", "sample", real=True, finite=False)
    return torch.fft.fftshift(torch.fft.fft(torch.fft.ifftshift(x, dim=dim), dim=dim), dim=dim)


def centred_ifft(x: Tensor, dim: int = -1) -> Tensor:
    """Compute the inverse Fourier transform of a spectrum whose phases refer to the middle sample.

    >>> import torch
    >>> from torchsar.core import centred_ifft
    >>> centred_ifft(torch.tensor([0.0, 0.0, 4.0, 0.0])).real
    tensor([1., 1., 1., 1.])

    x[i] = (1 / n) sum_f X(f) exp(2j pi f (i - n // 2)), the inverse of `centred_fft`.

    Args:
        x: Spectrum, any shape, frequencies rising, complex.
        dim: Dimension to transform.

    Returns:
        Samples of the same shape.

    Raises:
        TypeError: If the samples are not complex64 or complex128, float32 or float64.
        ValueError: If there are no samples.
    """
    x = checked_samples(x, "centred_ifft", "sample", real=True, finite=False)
    return torch.fft.fftshift(torch.fft.ifft(torch.fft.ifftshift(x, dim=dim), dim=dim), dim=dim)


def fft_lines(x: Tensor, inverse: bool = False, n: int | None = None) -> Tensor:
    """Compute the FFT along dim -2, bit for bit the same for any number of trials.

    torch.fft.fft along dim -2 treats a single matrix and a batch differently, so that its results
    for the two differ in the last bits. Differentiable.

    Args:
        x: Samples, shape (..., line, range), complex.
        inverse: Whether to compute the inverse transform.
        n: Length of the transform; by default the number of lines.

    Returns:
        Spectrum in FFT order, shape (..., n, range).

    Raises:
        TypeError: If the samples are not complex64 or complex128, float32 or float64.
        ValueError: If there are no samples.
    """
    x = checked_samples(x, "fft_lines", "range", real=True, finite=False)
    transform = torch.fft.ifft if inverse else torch.fft.fft
    return _ContiguousGradient.apply(transform(_ContiguousGradient.apply(x).mT.contiguous(), n)).mT


class _ContiguousGradient(torch.autograd.Function):
    """Identity whose gradient is made contiguous, so that its transform is rounded alike in any
    batch.
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
    """Transform one axis of a signal to frequency.

    >>> import torch
    >>> from torchsar import Axis, Signal
    >>> from torchsar.core import to_frequency
    >>> line = Signal(torch.ones(4, dtype=torch.complex64), (Axis("range", 4, 0.0, 0.5, "m"),))
    >>> spectrum = to_frequency(line, "range")
    >>> spectrum.names, spectrum.axes[0].step, spectrum.data.abs().tolist()
    (('range_frequency',), 0.5, [0.0, 0.0, 4.0, 0.0])

    Phases refer to the middle sample (n // 2) of the axis, not to its coordinate zero.

    Args:
        signal: Signal with the axis.
        name: Name of the axis: `pulse` becomes `doppler` in Hz, `range` becomes `range_frequency`
            in 1/m.

    Returns:
        Spectrum with the frequency axis in place of the named one.

    Raises:
        KeyError: If the signal has no axis of that name.
    """
    return signal.with_axis(centred_fft(signal.data, signal.dim(name)), **{name: signal.axis(name).dual()})


def from_frequency(signal: Signal, name: str) -> Signal:
    """Transform a frequency axis back to the original axis; the inverse of `to_frequency`.

    >>> import torch
    >>> from torchsar import Axis, Signal
    >>> from torchsar.core import from_frequency, to_frequency
    >>> line = Signal(torch.ones(4, dtype=torch.complex64), (Axis("range", 4, 0.0, 0.5, "m"),))
    >>> from_frequency(to_frequency(line, "range"), "range_frequency").axes == line.axes
    True

    Args:
        signal: Signal with a frequency axis made by `to_frequency`.
        name: Name of the frequency axis.

    Returns:
        Signal on the original axis, same shape.

    Raises:
        KeyError: If the signal has no axis of that name.
    """
    return signal.with_axis(centred_ifft(signal.data, signal.dim(name)), **{name: signal.axis(name).dual()})


def block_bytes_of(device: torch.device) -> int:
    """Return the size of the blocks in which large arrays are processed.

    Args:
        device: Device of the array.

    Returns:
        Size in bytes: 1 MiB on a CPU, which stays in the cache of a core. On a GPU 1/128 of its
        memory, since each block costs a call of every operation; 256 MiB on other accelerators.
    """
    if device.type == "cuda":
        return torch.cuda.get_device_properties(device).total_memory // 128
    return 1 << 20 if device.type == "cpu" else 1 << 28


def over_blocks(work: Callable[[Any], None], parts: Iterable[Any], like: Tensor) -> None:
    """Call a function for every part of an array, in as many threads as torch uses.

    Each thread processes its own parts with single-threaded operations, and therefore does not wait
    for the slowest thread after every operation. On a busy machine such waiting takes several times
    as long as the work itself. Parts are processed one after another if there are fewer than two
    for each thread, on an accelerator, and inside torch.func transforms. Not differentiable.

    Args:
        work: Function of one part, which writes its result into the array.
        parts: Parts of the array, in any form that `work` accepts.
        like: The array, whose device and storage decide whether threads can be used.
    """
    parts, threads = list(parts), torch.get_num_threads()
    if threads == 1 or len(parts) < 2 * threads or like.device.type != "cpu" or not is_plain(like):
        for part in parts:
            work(part)
        return
    inference = torch.is_inference_mode_enabled()

    def one(part: Any) -> None:
        # modes and thread counts must be set in each thread
        torch.set_num_threads(1)
        with torch.inference_mode(inference), torch.no_grad():
            work(part)

    try:
        with ThreadPoolExecutor(threads) as pool:
            for _ in pool.map(one, parts):
                pass
    finally:
        # the mathematics library has one thread count for the whole process
        torch.set_num_threads(threads)


def is_plain(x: Tensor) -> bool:
    """Return whether a tensor has storage of its own, unlike one inside a torch.func transform.

    Transforms and traces do not reach other threads, and wrapped values cannot be written into a
    plain tensor.

    Args:
        x: Tensor, any shape.

    Returns:
        False inside a transform such as vmap, and for a tensor of a traced program.
    """
    try:
        return not is_traced(x) and x.data_ptr() != 0
    except RuntimeError:
        return False


def transform_in_blocks(
    x: Tensor, dim: int, inverse: bool = False, out: Tensor | None = None, block_bytes: int | None = None
) -> Tensor:
    """Compute an FFT along dim -1 or -2 in blocks that stay in the cache.

    Along dim -2 a few columns at a time are gathered, transformed and written back. This is two to
    four times as fast as one call for the large array, and needs no second array if `out` is
    contiguous. Not differentiable.

    Args:
        x: Samples, shape (..., line, range), complex.
        dim: Dimension to transform, -1 or -2.
        inverse: Whether to compute the inverse transform.
        out: Array for the result, of the shape of x; by default x itself, which is overwritten.
        block_bytes: Size of a block in bytes; by default the result of `block_bytes_of`.

    Returns:
        `out`, in FFT order.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples.
    """
    x = checked_samples(x, "transform_in_blocks", "pulse, range", finite=False)
    out = x if out is None else out
    transform = torch.fft.ifft if inverse else torch.fft.fft
    if not out.is_contiguous():
        return out.copy_(transform(x, dim=dim))
    source, target = (y.reshape(-1, *y.shape[-2:]) if dim == -2 else y.reshape(-1, y.shape[-1]) for y in (x, out))

    block_bytes = block_bytes_of(x.device) if block_bytes is None else block_bytes
    several = (
        dim == -2 and block_bytes // 16 // (source[0].numel() * source.element_size()) > 1
    )  # small trials share a block, of which the last may have only one trial

    def work(part: tuple[slice, ...]) -> None:
        target[part] = fft_lines(source[part], inverse) if several else transform(source[part].contiguous(), dim=dim)

    over_blocks(work, _blocks(source, dim, block_bytes), out)
    return out


def _blocks(x: Tensor, dim: int, block_bytes: int) -> Iterator[tuple[slice, ...]]:
    """Slices of an array, one for each block that is transformed at once.

    A slice is (row, n) for a transform along dim -1 and (trial, n, column) along dim -2. Small
    trials share a slice. A large trial is divided by columns, because torch copies the input before
    a strided transform of several trials.
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


def smooth_length(n: int) -> int:
    """Return the least FFT length of at least n without prime factors above 5.

    Args:
        n: Least length.

    Returns:
        Length, at most 2 n.

    Raises:
        ValueError: If n is below 1.
    """
    if n < 1:
        raise ValueError(f"an FFT has at least one sample, got the length {n}")
    # a number without prime factors above 5 divides a high power of 30
    return next(k for k in range(n, 2 * n + 1) if pow(30, k.bit_length(), k) == 0)
