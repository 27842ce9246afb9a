"""Removal of additive errors of the receiver: constants, slow drifts, spurs and image signals.

An image signal is due to unequal I and Q components.
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
    differentiable,
    legendre,
    level_of,
    linear_solve,
    worst,
)
from torchsar.core.tone import strongest_tone
from torchsar.repair.assess import left_out_deviation

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
    for `subtract_interference`. Differentiable in the samples, with the frequencies held fixed.

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
