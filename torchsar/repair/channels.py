"""Gain and phase imbalance of channels that record the lines in turn.

Channel c of C channels records the lines i with i mod C = c and multiplies them by g_c exp(j
phi_c). Each line is multiplied by the conjugate of the line before, and the products of a channel
are averaged over a recording. The mean has the phase phi_c - phi_(c-1) + rho, where rho is the
phase increment from line to line due to the Doppler centroid. In the sum over all channels the phi
cancel, so that the C products give rho and every phi_c - phi_0. Gains follow from the powers of the
lines.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchsar.core import (
    Estimate,
    Outcome,
    Signal,
    Stage,
    checked_samples,
    cis,
    differentiable,
    real_dtype,
    refuse_non_finite_values,
    take,
    unit_level,
)
from torchsar.repair.assess import assess_imbalance


def _sums(x: Tensor, noise: Tensor, blocks: int) -> tuple[Tensor, Tensor]:
    """Products of each line with the conjugate of the line before, and powers of the lines of a
    channel above the noise, (..., block, channel) each.

    Both are summed over groups of lines. Group g contains, for each channel, the mean of the lines
    before and after line C g, weighted so that their centre is line C g. A slow change of the scene
    is therefore the same in all channels. x: lines (..., line, range); noise: (..., channel). The
    sums are divided by the power of the strongest line.
    """
    channels = noise.shape[-1]
    groups, device = x.shape[-2] // channels - 1, x.device
    power = x.abs().square().mean(-1).to(torch.float64)
    scale = power.amax(-1, keepdim=True).clamp_min(1e-300)
    product = (x[..., 1:, :] * x[..., :-1, :].conj()).mean(-1).to(torch.complex128) / scale
    clean = power / scale - (noise / scale)[..., torch.arange(x.shape[-2], device=device) % channels]
    before = torch.arange(channels, dtype=torch.float64, device=device) / channels
    block = torch.arange(groups, device=device) * blocks // groups

    def summed(values: Tensor) -> Tensor:
        table = values[..., : channels * (groups + 1)].unflatten(-1, (groups + 1, channels))
        centred = (1 - before) * table[..., 1:, :] + before * table[..., :-1, :]
        total = torch.zeros(*centred.shape[:-2], blocks, channels, dtype=values.dtype, device=device)
        return total.index_add(-2, block, centred)

    return summed(torch.nn.functional.pad(product, (1, 0))), summed(clean)


def _gain(own: Tensor) -> Tensor:
    """Gain of each channel relative to channel 0 from powers (..., channel)."""
    own = own.clamp_min(1e-300)
    return torch.exp(torch.log(own / own[..., :1]) / 2)


def _noise(x: Tensor, channels: int) -> Tensor:
    """Noise power per sample of each channel, (..., channel), from empty parts of the band or empty
    range cells.

    It is zero where neither spectrum nor range cells have an empty part, and for lines of fewer
    than 32 samples.
    """
    n, half = x.shape[-1], x.shape[-1] // 32
    if n < 32:
        return torch.zeros(*x.shape[:-2], channels, dtype=torch.float64, device=x.device)
    floors = []
    # the averaged noise must lie six of its standard deviations below the mean power, by choice, to
    # count as an empty part
    flat = 1 - 6 / math.sqrt(_looks(x, channels))
    for y in (x, torch.fft.fft(x, norm="ortho")):
        square = y.abs().square().to(torch.float64)
        power = torch.stack([square[..., c::channels, :].mean(-2) for c in range(channels)], -2)
        padded = torch.nn.functional.pad(power.reshape(-1, 1, n), (half, half), mode="circular")
        smooth = torch.nn.functional.avg_pool1d(padded, 2 * half + 1, stride=1).reshape(power.shape)
        floor = smooth.kthvalue(max(1, n // 20), -1).values
        floors.append(torch.where(floor < flat * power.mean(-1), floor, torch.inf))
    least = torch.minimum(*floors)
    return torch.where(torch.isfinite(least), least, 0)


def _looks(x: Tensor, channels: int) -> int:
    """Number of samples over which the noise of a channel is averaged."""
    return (2 * (x.shape[-1] // 32) + 1) * (x.shape[-2] // channels)


@differentiable("where ok")
def estimate_imbalance(
    x: Tensor, channels: int = 2, doppler_cycles: Tensor | float | None = None, *, assess: bool = True
) -> Estimate:
    """Estimate gain and phase of every channel relative to channel 0, which records the first line.

    >>> import torch
    >>> lines = torch.tensor([1.0, 2.0], dtype=torch.complex128).repeat(8)[:, None]
    >>> estimate_imbalance(lines, assess=False)["gain"]
    tensor([1., 2.], dtype=torch.float64)

    The C channels record the lines in turn. The products of neighbouring lines give the phase
    increment from line to line only modulo 2 pi / C, and the phases of the channels are ambiguous
    accordingly. For two channels, the phases phi and phi + pi cannot be distinguished; they
    correspond to Doppler spectra that are displaced by PRF / 2. Noise is measured in the part of
    the range band or of the range cells that the signal leaves empty, and its bias of the gains is
    removed. Without such a part, noise must be weak.

    Args:
        x: Raw lines, shape (..., pulse, range), complex.
        channels: Number of channels C.
        doppler_cycles: Baseband Doppler centroid over PRF, shape (...,), accurate to 1 / (2 C);
            resolves the ambiguity. If it is None, the set of phases with the smallest mean square
            is taken: for two channels, the phase within 90 degrees.
        assess: Whether to add standard deviations, quality and outcome.

    Returns:
        Estimate with `gain` of shape (..., C), 1 for channel 0, and `phase_rad` of shape (..., C)
        in radians, 0 for channel 0, which `correct_imbalance` removes. Standard deviations follow
        from blocks of lines that are left out in turn; `quality` is the coherence of neighbouring
        lines. The outcome is NOISE where this coherence may be due to chance, SINGULAR where a
        channel has no power (gain outside 1e-3..1e3), TOO_FEW for fewer than 9 C lines, and INEXACT
        where a standard deviation exceeds 0.1.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples or a sample is not finite, or if there are fewer than
            two channels or fewer than 2 C + 1 lines.
    """
    x = checked_samples(x, "estimate_imbalance", "pulse, range")
    if channels < 2 or x.shape[-2] < 2 * channels + 1:
        raise ValueError(
            "estimate_imbalance needs 2 or more channels and more than twice as many lines as channels, "
            f"got {channels} channels and {x.shape[-2]} lines"
        )
    x = unit_level(x)
    noise = _noise(x, channels)
    # at most 16 blocks, by choice; each is left out in turn for the standard deviations
    products, powers = _sums(x, noise, min(16, x.shape[-2] // channels - 1))
    product, gain = products.sum(-2), _gain(powers.sum(-2))
    value = {"gain": gain, "phase_rad": _phases(product, channels, doppler_cycles)}
    if not assess:
        return Estimate(value, outcome=Outcome.NOT_ASSESSED.like(gain[..., 0]))
    turns = torch.angle((product[..., None, :] - products) * product.conj()[..., None, :])
    phases = torch.nn.functional.pad((turns - turns.mean(-1, keepdim=True))[..., 1:].cumsum(-1), (1, 0))
    left_out = _gain(powers.sum(-2, keepdim=True) - powers), phases
    power = x.abs().square().mean(-1).to(torch.float64)
    level = power.mean(-1) / power.amax(-1).clamp_min(1e-300)
    lag = product / (level * (x.shape[-2] // channels - 1)).clamp_min(1e-300)[..., None]
    looks = (x.shape[-1] * x.shape[-2] / channels, _looks(x, channels))
    return Estimate(value, **assess_imbalance(gain, lag, power.mean(-1), noise, left_out, looks))


def _phases(product: Tensor, channels: int, doppler_cycles: Tensor | float | None) -> Tensor:
    """Phases of the channels relative to channel 0, from the products of successive lines. Both
    have the shape (..., channel).
    """
    angle = torch.angle(product)
    turns = torch.arange(channels, dtype=torch.float64, device=product.device) / channels
    rho = torch.angle(torch.polar(torch.ones_like(angle), angle).prod(-1))[..., None] / channels + 2 * math.pi * turns
    increments = angle[..., None, 1:] - rho[..., None]
    phases = torch.nn.functional.pad(torch.cumsum(increments, -1), (1, 0))
    phases = torch.remainder(phases + math.pi, 2 * math.pi) - math.pi
    if doppler_cycles is None:
        cost = phases.square().sum(-1)
    else:
        expected = 2 * math.pi * torch.as_tensor(doppler_cycles, dtype=torch.float64, device=product.device)
        cost = -torch.cos(rho - expected[..., None])
    return take(phases, cost.argmin(-1), -2)


def correct_imbalance(x: Tensor, gain: Tensor, phase_rad: Tensor) -> Tensor:
    """Divide the lines of channel c by gain[c] exp(j phase[c]).

    >>> import torch
    >>> from torchsar import repair
    >>> lines = torch.tensor([1, 2j, 1, 2j], dtype=torch.complex64)[:, None]  # channels 0, 1, 0, 1
    >>> gain, phase_rad = torch.tensor([1.0, 2.0]), torch.tensor([0.0, torch.pi / 2])
    >>> repair.correct_imbalance(lines, gain, phase_rad).real[:, 0].tolist()
    [1.0, 1.0, 1.0, 1.0]

    Channel c of C channels recorded the lines i with i mod C = c. Differentiable.

    Args:
        x: Raw lines, shape (..., pulse, range), complex.
        gain: Gains, shape (..., C), float64.
        phase_rad: Phases in radians, shape (..., C), float64.

    Returns:
        Lines of the same shape.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples, or if gains and phases differ in shape.
    """
    x = checked_samples(x, "correct_imbalance", "pulse, range", finite=False)
    if gain.shape != phase_rad.shape:
        raise ValueError(
            "gain and phase_rad must have the same shape (..., channel), got the shapes "
            f"{tuple(gain.shape)} and {tuple(phase_rad.shape)}"
        )
    refuse_non_finite_values("correct_imbalance", gain=gain, phase_rad=phase_rad)
    real = real_dtype(x.dtype)
    factor = cis(-phase_rad.to(real)) / gain.to(real)
    return x * factor[..., torch.arange(x.shape[-2], device=x.device) % gain.shape[-1], None]


class EstimateImbalance(Stage):
    """Estimator of the imbalance of channels that record the lines in turn.

    The lines must be on a regular grid (see `LineIntegrity`).

    Args:
        channels: Number of channels.
        assess: Whether to add standard deviations, quality and outcome.
    """

    provides = ("gain", "phase_rad")
    neutral = {"gain": 1.0, "phase_rad": 0.0}
    differentiable = "where ok"

    def __init__(self, channels: int = 2, *, assess: bool = True) -> None:
        super().__init__()
        self.channels, self.assess = channels, assess

    def forward(self, signal: Signal, doppler_hz: Tensor | None = None) -> Estimate:
        """Estimate gain and phase of every channel; see `estimate_imbalance`.

        Args:
            signal: Raw lines, shape (..., pulse, range).
            doppler_hz: Baseband Doppler centroid in Hz, shape (...,); resolves the ambiguity of the
                phases.

        Returns:
            Estimate with `gain` and `phase_rad`, shape (..., channel) each.
        """
        cycles = None if doppler_hz is None else doppler_hz * signal.axis("pulse").step
        return estimate_imbalance(signal.data, self.channels, cycles, assess=self.assess)


CorrectImbalance = Stage.of(correct_imbalance)
