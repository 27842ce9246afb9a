"""Backprojection: the image of any path as a direct sum, slow and exact.

`direct_sum` is the one sum of the project. Its geometry is a function that gives the path of each
pulse over each pixel, so that it serves positions in space (`backproject`), the hyperbolas of a
strip (`backproject_strip`) and plane waves (`backproject_spotlight`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import torch
from torch import Tensor

from torchsar.core import checked_samples, real_dtype, unit_phasor
from torchsar.core.nufft import Nufft, Points, interpolate
from torchsar.radar.antenna_path import AntennaPath, broadcast, refuse_unusable
from torchsar.radar.spotlight import frequency_step_hz
from torchsar.radar.stripmap import LIGHT_M_S

# function that returns, for some pulses at some pixels, the path in metres less the reference path,
# and the weight (None for 1), float64 (..., pulse, pixel)
PathOf = Callable[[slice, slice], tuple[Tensor, Tensor | None]]

_PIXELS = 4096  # pixels of a block, found by trial


def direct_sum(
    history: Tensor,
    frequency_hz: Tensor,
    path: PathOf,
    pixels: int,
    *,
    eps: float = 1e-10,
    wave_speed_m_s: float = LIGHT_M_S,
    block_bytes: int = 1 << 23,
) -> Tensor:
    """Sum a phase history coherently over its pulses and frequencies at the paths of pixels.

        image(x) = sum_p w_p(x) sum_k s[p, k] exp(+2j pi f_k l_p(x) / c)

    The sum over the frequencies is a non-uniform FFT: the range profile, periodic in c / (frequency
    step), is interpolated at the path. It takes about 40 operations per pulse and pixel.
    Differentiable in the history and the paths.

    Args:
        history: Phase history s, shape (..., pulse, frequency), complex.
        frequency_hz: Frequencies f in Hz, rising in equal steps, float64 (frequency,).
        path: Function of a slice of pulses and one of pixels that returns two tensors, float64
            (..., pulse, pixel). The first is the path l in metres less the path to which the phases
            refer, the second the weight w, or None for 1.
        pixels: Number of pixels.
        eps: Relative error of the interpolation.
        wave_speed_m_s: Propagation speed c in m/s.
        block_bytes: Size of a working array in bytes.

    Returns:
        Image, shape (..., pixel), complex.
    """
    trials, (pulses, n) = math.prod(history.shape[:-2]), history.shape[-2:]
    plan = Nufft(n, eps, history.dtype, history.device)
    step = frequency_step_hz(frequency_hz) / wave_speed_m_s * plan.length
    carrier = float(frequency_hz[n // 2]) / wave_speed_m_s
    blocks = list(_slices(pixels, min(pixels, _PIXELS)))
    # each of about 20 working arrays of a block takes up to 16 bytes per pulse and pixel
    height = max(1, min(pulses, block_bytes // (16 * max(1, trials) * max(blocks[0].stop, 2 * n))))
    sums: list[Tensor | int] = [0] * len(blocks)
    for some in _slices(pulses, height):
        profiles = plan.grid(history[..., some, :])
        for i, block in enumerate(blocks):
            path_m, weight = path(some, block)
            # the exponent is +2j pi k q, so that points have the opposite sign
            points = Points.of(plan.kernel, -path_m * step, plan.length, real_dtype(history.dtype))
            echo = interpolate(profiles, points) * unit_phasor(carrier * path_m, history.dtype)
            if weight is not None:
                echo = echo * weight.to(real_dtype(history.dtype))
            sums[i] = sums[i] + echo.sum(-2)
    return torch.cat([torch.as_tensor(part) for part in sums], -1)


def _slices(n: int, step: int) -> Iterator[slice]:
    """Slices of at most `step` that cover 0..n."""
    yield from (slice(first, min(first + step, n)) for first in range(0, n, step))


def backproject(
    history: Tensor,
    frequency_hz: Tensor,
    transmitter_m: Tensor,
    receiver_m: Tensor | None,
    reference_m: Tensor,
    pixels_m: Tensor,
    *,
    eps: float = 1e-10,
    block_bytes: int = 1 << 23,
) -> Tensor:
    """Form the image of a phase history at any pixels by the direct sum over its pulses.

    >>> import torch
    >>> from torchsar import focus
    >>> place_m = torch.tensor([[-300.0, 0.5 * y, 100.0] for y in range(-20, 20)]).double()
    >>> given = (9.6e9 + 1e7 * torch.arange(16).double(), place_m, None, 2 * place_m.norm(dim=-1))
    >>> points_m = torch.tensor([[0.0, 0.0, 0.0], [3.0, 4.0, 0.0]]).double()
    >>> focus.backproject(torch.ones(40, 16) + 0j, *given, points_m).abs().round()  # on it, off
    tensor([640.,   1.])

        image(x) = sum_p sum_k s[p, k] exp(+2j pi f_k (l_p(x) - l_ref,p) / c),

    where l_p(x) is the path from the transmitter over the pixel to the receiver. A point of unit
    amplitude has the number of samples as peak and keeps its phase. Profiles are periodic: a
    scatterer whose path is longer by c / (frequency step) appears at the same pixel. The sum takes
    about 40 operations per pulse and pixel; `TilePlan` is many times faster. Differentiable in the
    history, the positions, the reference and the pixels.

    Args:
        history: Phase history, shape (..., pulse, frequency), complex.
        frequency_hz: Frequencies in Hz, rising in equal steps, float64 (frequency,).
        transmitter_m: Positions of the transmitter in metres, float64 (..., pulse, 3).
        receiver_m: Positions of the receiver in metres, float64 (..., pulse, 3); None if both share
            an antenna, so that the path is twice its range.
        reference_m: Path to which the phases refer in metres (twice the reference range of a
            monostatic radar), float64 (..., pulse).
        pixels_m: Positions of the pixels in metres, float64 (*pixels, 3), such as those of
            `ImageGrid.pixels_m`.
        eps: Relative error of the interpolation in range.
        block_bytes: Size of a working array in bytes.

    Returns:
        Image, shape (..., *pixels), complex; leading dims are those of the history and the
        positions, broadcast.

    Raises:
        TypeError: If the history is not complex64 or complex128, or frequencies or positions are
            not float64.
        ValueError: If there are no samples or pixels, shapes do not match, values are not finite,
            or the frequencies do not rise in equal steps.
    """
    history = checked_samples(history, "backproject", "pulse, frequency", finite=False)
    refuse_unusable(frequency_hz=frequency_hz, pixels_m=pixels_m)
    antennas = AntennaPath(transmitter_m, receiver_m, reference_m)
    history = expanded_history(history, antennas, frequency_hz, "backproject")
    if pixels_m.shape[-1:] != (3,) or not pixels_m.numel():
        raise ValueError(
            f"backproject needs at least one pixel, pixels_m of shape (*pixels, 3), got {tuple(pixels_m.shape)}"
        )
    points = pixels_m.reshape(-1, 3)

    def path(pulses: slice, pixels: slice) -> tuple[Tensor, None]:
        return antennas.path_m(points[pixels], pulses), None

    image = direct_sum(history, frequency_hz, path, len(points), eps=eps, block_bytes=block_bytes)
    return image.unflatten(-1, pixels_m.shape[:-1])


def expanded_history(history: Tensor, antennas: AntennaPath, frequency_hz: Tensor, what: str) -> Tensor:
    """Expand a phase history to the trials of its antenna path.

    Args:
        history: Phase history, shape (..., pulse, frequency).
        antennas: Path of the antennas.
        frequency_hz: Frequencies in Hz, shape (frequency,).
        what: Name of the function for the message.

    Returns:
        The history, its leading dims broadcast with those of the path.

    Raises:
        ValueError: If its size is not that of the path and the frequencies.
    """
    size = antennas.pulses, len(frequency_hz)
    trials = broadcast([history.shape[:-2], antennas.trials])
    if history.shape[-2:] != size or trials is None:
        raise ValueError(
            f"{what} needs a history (..., pulse, frequency) that fits {(*antennas.trials, *size)} of the path and the "
            f"frequencies, got {tuple(history.shape)}"
        )
    return history.expand(*trials, *size)
