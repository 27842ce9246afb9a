"""Removal of additive errors of the receiver: constants, slow drifts, spurs and image signals.

An image signal is due to unequal I and Q components.

Gain and phase imbalance of channels that record the lines in turn.

Channel c of C channels records the lines i with i mod C = c and multiplies them by g_c exp(j
phi_c). Each line is multiplied by the conjugate of the line before, and the products of a channel
are averaged over a recording. The mean has the phase phi_c - phi_(c-1) + rho, where rho is the
phase increment from line to line due to the Doppler centroid. In the sum over all channels the phi
cancel, so that the C products give rho and every phi_c - phi_0. Gains follow from the powers of the
lines.
"""

from __future__ import annotations

import math
from typing import Literal, get_args

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
    legendre,
    level_of,
    linear_solve,
    real_dtype,
    refuse_non_finite_values,
    take,
    unit_level,
    worst,
)
from torchsar.core.tone import strongest_tone
from torchsar.repair.assess import assess_imbalance, left_out_deviation

# axes of sweeps of a ladar, of blocks of its record, of dechirped pulses, and of channels
_ALSO_ON = (("ramp", "pulse", "fast_time"), ("pulse", "time"), ("pulse", "fast_time"), ("channel", "pulse", "range"))
Of = Literal["recording", "cell", "pulse"]


def remove_constant(x: Tensor, of: Of = "recording", degree: int = 0) -> Tensor:
    """Subtract a constant, or a value that varies slowly from pulse to pulse.

    >>> import torch
    >>> from torchsar import repair
    >>> lines = torch.randn(8, 16, dtype=torch.complex64) + 5
    >>> bool(repair.remove_constant(lines).mean().abs() < 1e-5)
    True

    Pulses of zeros do not enter the mean and are kept. Linear, and differentiable.

    Args:
        x: Samples, shape (..., pulse, sample), real or complex.
        of: "recording" subtracts the mean of all samples, such as the offset of a converter.
            "cell" subtracts the mean over pulses of each range or beat cell, such as the leakage of
            a transmitter or ground at rest; echoes of the scene about zero Doppler are also
            removed. "pulse" subtracts the mean of the samples of each pulse.
        degree: Degree of the polynomial of the pulse number that is subtracted instead of a
            constant. With n pulses, the degree d removes frequencies up to about d / n cycles per
            pulse. It has no effect for "pulse".

    Returns:
        Samples of the same shape.

    Raises:
        TypeError: If the samples are neither real nor complex of single or double precision.
        ValueError: If there are no samples, or an option is invalid.
    """
    x = checked_samples(x, "remove_constant", "pulse, sample", real=True, finite=False)
    if of not in get_args(Of) or degree < 0:
        raise ValueError(
            f"remove_constant: of must be one of {list(get_args(Of))} and degree 0 or more, got {of!r} and {degree}"
        )
    present = (x != 0).any(-1, keepdim=True).to(x.real.dtype)
    if of == "pulse":
        return x - present * x.mean(-1, keepdim=True)
    course = x.mean(-1, keepdim=True) if of == "recording" else x
    basis = legendre(torch.linspace(-1, 1, x.shape[-2], dtype=x.real.dtype, device=x.device), degree)
    weighted = (present * basis).mT
    # the ridge is needed for trials of zeros and for fewer pulses than terms
    ridge = 16 * torch.finfo(basis.dtype).eps * x.shape[-2] * torch.eye(degree + 1, dtype=basis.dtype, device=x.device)
    solved = linear_solve((weighted @ basis + ridge).to(x.dtype), weighted.to(x.dtype) @ course)
    return x - present * (basis.to(x.dtype) @ solved)


class RemoveConstant(Stage):
    """Stage that subtracts a constant of the receiver, or a slow drift; see `remove_constant`.

    Each channel and each sweep has a constant of its own.

    Args:
        of: "recording", "cell" or "pulse".
        degree: Degree of the polynomial of the pulse number that is subtracted.

    Raises:
        ValueError: If an option is invalid.
    """

    also_on = _ALSO_ON
    takes_real = True

    def __init__(self, of: Of = "recording", degree: int = 0) -> None:
        super().__init__()
        self.of: Of = of
        self.degree = degree
        remove_constant(torch.ones(1, 1), of, degree)  # raises ValueError for invalid options

    def forward(self, signal: Signal) -> Signal:
        """Subtract the constant.

        Args:
            signal: Samples of the axes (pulse, range), or of a ladar or several channels.

        Returns:
            Signal of the same axes.
        """
        return signal.with_data(remove_constant(signal.data, self.of, self.degree))


def remove_tones(x: Tensor, count: int = 4, least_excess: float = 20.0) -> Tensor:
    """Subtract spurs: tones that continue from pulse to pulse.

    >>> import torch
    >>> from torchsar import repair
    >>> lines = torch.randn(64, 64, dtype=torch.complex64)
    >>> turns = 0.213 * torch.arange(64)[:, None] + 0.154 * torch.arange(64)
    >>> spur = 10 * torch.exp(2j * torch.pi * turns)
    >>> bool((repair.remove_tones(lines + spur) - lines).abs().square().mean() < 0.01)
    True

    Each tone is found where the spectrum over pulses and samples is highest, and subtracted with
    its amplitude of least squares. A tone whose frequency or phase changes from line to line is one
    for `subtract_interference`. The echo of a target in uniform motion is such a tone as well, and
    is subtracted. Differentiable in the samples, with the frequencies held fixed.

    Args:
        x: Samples, shape (..., pulse, sample), complex.
        count: Largest number of tones.
        least_excess: Least power of the tone's cell of the spectrum over the mean power of the
            other cells of its range frequency and of its Doppler frequency. In noise it is near the
            logarithm of the number of cells, 14 for a million, and also in clutter that fills the
            band of range or of Doppler frequencies. In clutter that fills half of both bands it is
            twice as large. Where there are fewer pulses or samples than this, nothing is
            subtracted.

    Returns:
        Samples of the same shape.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples or a sample is not finite.
    """
    x = checked_samples(x, "remove_tones", "pulse, sample")
    level = level_of(x)
    x = x / level
    for _ in range(count):
        with torch.no_grad():
            tone = strongest_tone(x, rounds=4)
            unit = tone._replace(amplitude=torch.ones_like(tone.amplitude)).samples(*x.shape[-2:])
        amplitude = (x * unit.conj()).mean((-2, -1)) * (tone.excess > least_excess)
        x = x - amplitude[..., None, None] * unit
    return x * level


RemoveTones = Stage.of(remove_tones, also_on=_ALSO_ON)


@differentiable("where ok")
def balance_quadrature(x: Tensor) -> tuple[Tensor, Estimate]:
    """Give I and Q components equal power and no correlation, as those of clutter and noise have.

    >>> import torch
    >>> from torchsar import repair
    >>> lines = torch.randn(256, 256, dtype=torch.complex128)
    >>> found = repair.balance_quadrature(torch.complex(lines.real, 2 * lines.imag))[1]
    >>> found["gain_db"].round()  # 20 log10(2)
    tensor(6., dtype=torch.float64)

    Subtract a constant first, which has a phase of its own. Differentiable.

    Args:
        x: Samples, shape (..., pulse, sample), complex.

    Returns:
        The balanced samples; and the estimate of `gain_db`, of Q over I, and `phase_deg`, the
        deviation from quadrature, shape (...,) each. Their standard deviation comes from eight
        parts of the pulses, and of the samples, that are left out in turn. The outcome is EMPTY for
        zeros, TOO_FEW with fewer than eight pulses, and INEXACT where the deviation would leave an
        image above -30 dB, as of scenes of few points.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples or a sample is not finite.
    """
    x = checked_samples(x, "balance_quadrature", "pulse, sample")
    unit = x / level_of(x)
    products = torch.stack([unit.real**2, unit.imag**2, unit.real * unit.imag]).to(torch.float64)
    parts = [torch.stack([p.sum((-2, -1)) for p in products.tensor_split(8, dim)], -1) for dim in (-2, -1)]
    whole = parts[0].sum(-1)

    def errors(sums: Tensor) -> Tensor:
        i, q = sums[:2].clamp_min(1e-30)
        phase = torch.asin((sums[2] / (i * q).sqrt()).clamp(-0.99, 0.99))
        return torch.stack([10 * torch.log10(q / i), torch.rad2deg(phase)])

    gain_db, phase_deg = errors(whole)
    stds = [left_out_deviation(errors(whole[..., None] - part)[..., None])[..., 0] for part in parts]
    std_db, std_deg = torch.maximum(*stds)
    # relative amplitude of the image signal: half of the gain error and half of the phase error
    image = torch.hypot(std_db * math.log(10) / 20, torch.deg2rad(std_deg)) / 2
    outcome = worst(
        (Outcome.INEXACT, image > 10 ** (-30 / 20)),
        (Outcome.TOO_FEW, torch.full_like(image, x.shape[-2], dtype=torch.int64) < 8),
        (Outcome.EMPTY, whole[0] + whole[1] == 0),
    )
    found = Estimate(
        {"gain_db": gain_db, "phase_deg": phase_deg},
        {"gain_db": std_db, "phase_deg": std_deg},
        quality=1 / (1 + image / 10 ** (-30 / 20)),
        outcome=outcome,
    )
    used = outcome < Outcome.NOISE
    gain, phase = (
        torch.where(used, v, 0).to(x.real.dtype)[..., None, None] for v in (gain_db, torch.deg2rad(phase_deg))
    )
    q = (x.imag / 10 ** (gain / 20) - x.real * torch.sin(phase)) / torch.cos(phase)
    return torch.complex(x.real, q), found


BalanceQuadrature = Stage.of(
    balance_quadrature, provides=("gain_db", "phase_deg"), neutral={"gain_db": 0.0, "phase_deg": 0.0}
)


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
        channel has no power (gain outside 1e-3..1e3), AT_REST where constants of the channels hold
        more than a twentieth of the power, TOO_FEW for fewer than 9 C lines, and INEXACT where a
        standard deviation exceeds 0.1.

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
    # share of the power that the constants of the converters hold
    means = torch.stack([x[..., c::channels, :].mean((-2, -1)) for c in range(channels)], -1)
    still = means.abs().square().mean(-1) / power.mean(-1).clamp_min(1e-300)
    return Estimate(value, **assess_imbalance(gain, lag, power.mean(-1), noise, left_out, looks, still))


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
