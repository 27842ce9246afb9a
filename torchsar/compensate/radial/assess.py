"""Accuracy and outcome of estimated radial velocities and of the phases that remain after them."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.data import pair_phase, prepare
from torchsar.compensate.pulse_phase.fixed_point import LogAbove, Run, fixed_point
from torchsar.compensate.pulse_phase.imaging import AlongPulses
from torchsar.compensate.radial.bands import filled
from torchsar.compensate.radial.measured import LEAST_SQUARED, TINY, Intercept, Levels, Measured, mean_of
from torchsar.compensate.radial.phases import SAME_RAD, Walk
from torchsar.compensate.radial.product import mirror_velocity
from torchsar.core import Axis, Estimate, Outcome, cis, host_value, power_of, true_positions, unit_level, worst
from torchsar.core.tone import Tone, strongest_tone
from torchsar.metrics.phase import phase_rmse
from torchsar.radar import TriangularLadar

# least number of periods with an echo from which phases are estimated
LEAST_PERIODS = 8


@torch.no_grad()
def assessed_velocity(found: Estimate, measured: Measured, pulse: Axis, sweeps: Tensor) -> Estimate:
    """Add standard deviation and outcome to an estimate of radial velocities.

    Noise, and the interference of scatterers of random phases, change the power of the echo as much
    as its phase, and independently. If a complex amplitude s changes by ds, the real and the
    imaginary part of conj(s) ds have equal variances. Motion changes the phase only. The relative
    changes of power between both sweeps therefore have the same variance as the phase errors,
    whatever the scene. The effect of jerk is added, and the error of interpolation in periods
    without a clear echo.

    A method that does not use the product of up and mirrored down sweeps may follow one scatterer,
    which may have another velocity than the scene. If scatterers have equal phases, their
    interference changes the power less than the phase. The deviation of such a method is therefore
    at least the difference from the velocities of that product, less their own deviation.

    Args:
        found: Estimate of the velocities.
        measured: What the method measured.
        pulse: Slow-time axis; each entry is a period of one up and one down sweep.
        sweeps: The sweeps as recorded, shape (..., 2, pulse, N), complex.

    Returns:
        The estimate with its standard deviation, and with the outcome

        - INEXACT where the SNR after compression is too low for peaks that exceed the noise in all
          periods, or the standard deviation exceeds 0.035 lambda / T (T is the length of a sweep);
        - PARTS_DISAGREE where a part of the echo has another velocity (`_one_sided`), unless
          tones of the receiver explain it;
        - AMBIGUOUS where both sweeps have more power in common at another velocity, in more than
          one period of 20;
        - AT_REST where tones of the receiver (`_tones`) hold more than a fifth of the energy, and
          the velocity is that of the tones in more than one period of 20;
        - NOISE where they have no more in common than noise at any velocity;
        - EMPTY where all samples are zero.
    """
    product, lit = measured.product, measured.lit
    bin_m_s = product.radar.ambiguous_velocity_m_s
    square = _variance(measured, pulse)
    m = measured.still.shape[-1]
    lines = power_of(torch.fft.fft(measured.still, 2 * m))
    highest = lines.amax(-1).sqrt().to(torch.float64) / m
    best = Levels.of(highest, product)
    elsewhere = mean_of((highest > 1.1 * measured.common).to(torch.float64), lit)[..., 0]
    share, of_receiver = _tones(sweeps.detach(), measured.raw_m_s, product.radar, pulse)
    still = mean_of(of_receiver.to(torch.float64), lit)[..., 0]
    # A velocity with an error of 0.07 bins or more is of no use. Noise alone gives 0.05 at the
    # lowest sufficient SNR.
    useless = mean_of(square, product.lit)[..., 0] >= (0.07 * bin_m_s) ** 2
    outcome = worst(
        (Outcome.INEXACT, ~measured.enough | useless),
        # Tones of more than half a percent of the energy cause such lines, too. Up to a fifth they
        # do not change the velocity.
        (Outcome.PARTS_DISAGREE, _one_sided(lines, lit) & (share < 0.005)),
        (Outcome.AMBIGUOUS, (best.squared >= LEAST_SQUARED) & (elsewhere > 0.05)),
        (Outcome.AT_REST, (share > 0.2) & (still > 0.05)),
        # below 9 dB, noise alone may cause the peak of the product of both sweeps, by trial
        (Outcome.NOISE, ~lit.any(-1) | (~measured.enough & (best.squared < 10**0.9))),
        (Outcome.EMPTY, (measured.common == 0).all(-1)),
    )
    return replace(found, std={**found.std, "velocity_m_s": square.sqrt()}, outcome=outcome)


def _tones(sweeps: Tensor, raw_m_s: Tensor, radar: TriangularLadar, pulse: Axis) -> tuple[Tensor, Tensor]:
    """Find a constant and two spurs that stand at one frequency in both sweeps of all periods.

    The beat of a target has other frequencies in up and down sweeps, unless it lies at the
    reference range. Its phase then continues from sample to sample and from period to period, which
    distinguishes it from a spur.

    Args:
        sweeps: The sweeps as recorded, shape (..., 2, pulse, N), complex.
        raw_m_s: Measured velocities, shape (..., pulse).
        radar: Ladar parameters.
        pulse: Slow-time axis.

    Returns:
        Share of the energy that the tones hold, shape (...,); and whether a velocity is that of the
        product of two of them, shape (..., pulse), bool.
    """
    rest = unit_level(sweeps, 3)
    energy, n, shares, cycles = power_of(rest).mean((-3, -2, -1)).clamp_min(TINY), rest.shape[-1], [], []
    for spur in (False, True, True):
        tone = strongest_tone(rest[..., 0, :, :], rounds=4)
        f, g = (tone.sample_cycles * spur, tone.pulse_cycles * spur)
        unit = Tone(torch.ones_like(tone.amplitude), f, g, tone.share, tone.excess).samples(*rest.shape[-2:])
        steady = (rest * unit.conj()[..., None, :, :]).mean(-2)
        both = steady[..., n - n // 2 :].mean(-1) * steady[..., : n // 2].mean(-1).conj()
        # the beat of a target at the reference range has this frequency on the mean of both sweeps
        f = f + both.angle().to(torch.float64).mean(-1) * (spur / (2 * math.pi * (n - n // 2)))
        turns = f * radar.sample_rate_hz * pulse.step - g
        share = both.real.amin(-1).clamp_min(0) / energy
        shares.append(torch.where(((turns - torch.round(turns)).abs() > 0.03) | (not spur), share, 0))
        cycles.append(torch.where(shares[-1] > 0.005, f, torch.nan))
        rest = rest - steady.mean(-1)[..., None, None] * unit[..., None, :, :]
    pairs = torch.stack([f + other for f in cycles for other in cycles], -1)[..., None, :]
    turns = raw_m_s[..., None] * (4 / (radar.wavelength_m * radar.sample_rate_hz)) - pairs
    return torch.stack(shares).sum(0), ((turns - torch.round(turns)).abs() < 1 / n).any(-1)


def _one_sided(lines: Tensor, lit: Tensor) -> Tensor:
    """True where the spectrum of the product of both sweeps, with the phase of the velocities
    removed, has lines on one side only, shape (...,).

    Of scatterers that share the velocity, the product is the power of the scene over optical
    frequency. It is real, and its spectrum is symmetric: the beat of two scatterers is on both
    sides. The beat of scatterers of different velocities is displaced, to one side.

    Args:
        lines: Power spectra of the products, shape (..., pulse, 2m), zero frequency first.
        lit: False for periods in which no scatterer is illuminated, shape (..., pulse), bool.
    """
    n, counted, near = lines.shape[-1], lit[..., None, :].to(lines.dtype), 4
    # the main lobe of the product is left out
    above, below = lines[..., near : n // 2], lines.flip(-1)[..., near - 1 : n // 2 - 1]
    square = (counted @ (above - below).square())[..., 0, :]
    sides, main = torch.cat([counted @ above, counted @ below], -2), (counted @ lines[..., :1])[..., 0, :]
    # compared with the strongest of five lines on the other side, because side lobes have zeros
    other = torch.nn.functional.max_pool1d(sides.reshape(-1, *sides.shape[-2:]), 5, 1, 2).reshape(sides.shape).flip(-2)
    excess = sides - sides.flip(-2)
    # In noise the excess has the standard deviation sqrt(square), so that 4.5 times as much occurs
    # once in a thousand records of 256 lines. 1e-5 of the main line is the limit of filters.
    seen = (excess > 4.5 * square.sqrt()[..., None, :]) & (excess > 1e-5 * main[..., None, :])
    # Beats have two neighbouring lines or more. A single line may be a zero between side lobes that
    # are not quite symmetric, unless it is five times as strong as the other side, by trial.
    broad = seen & (sides > 2.5 * other)
    return ((broad[..., 1:] & broad[..., :-1]).any(-1) | (seen & (sides > 5 * other)).any(-1)).any(-1)


def _variance(measured: Measured, pulse: Axis) -> Tensor:
    """Variance (..., pulse) of the velocities, see `assessed_velocity`."""
    law, lit, clear, common = measured.law, measured.lit, measured.clear, measured.common
    share = (common / mean_of(common, lit | ~lit.any(-1, keepdim=True)).clamp_min(TINY)).clamp_min(1e-6)
    white, count = measured.white_m_s.square()[..., None], clear.sum(-1, keepdim=True)
    weight = mean_of(share, clear).clamp_min(TINY)

    def variance(changes: Tensor) -> Tensor:
        # A constant part is removed, because it comes from the detector or the laser, whose sweeps
        # differ in power.
        changes = changes - mean_of(changes * share, clear) / weight
        # the variance that white noise explains has the weight of four periods
        counted = count * mean_of(changes.square() * share, clear) + 4 * white
        return counted / ((count - 1).clamp_min(0) + 4)

    changes = _changes_of_product(measured, law.intercept or "free") if law.changes is None else law.changes()
    square = filled(variance(changes) / share, clear)
    slope, bend = (_rms_difference(measured.raw_m_s, clear, order) for order in (1, 2))
    # The factor 1 / 32 is the mean square of the time between two samples of a product, divided by
    # 24 squared periods.
    jerk = bend / 32 * (measured.product.radar.period_s / pulse.step) ** 2
    square = square + _interpolated(clear, slope, bend).square() + jerk.square() + law.floor_m_s**2
    if law.intercept:
        return square
    away = measured.velocity_m_s - mirror_velocity(measured.product, "free")[0]
    # bias in m/s due to the edges of the range window
    bias = 5e-4 * measured.product.radar.ambiguous_velocity_m_s
    of_product = changes if law.changes is None else _changes_of_product(measured, "free")
    apart = mean_of(away.square() - variance(of_product) / share, clear) - bias**2
    judged = (measured.levels.squared >= LEAST_SQUARED)[..., None]
    return torch.where(judged, torch.maximum(square, apart), square)


def _changes_of_product(measured: Measured, intercept: Intercept) -> Tensor:
    """Velocities (..., pulse) in m/s that follow if relative changes of power are taken as changes
    of phase.
    """
    bands = measured.product
    inner, radar = bands.inner, bands.radar
    per_s = 4 * math.pi * radar.carrier_hz / radar.wave_speed_m_s
    constant = cis(per_s * radar.sweep_s * (measured.raw_m_s - bands.shift_m_s))[..., None]
    power = (measured.still * constant.to(measured.still.dtype)).real
    w = (per_s * (2 * bands.time_s[inner] - radar.sweep_s)).to(power.dtype)
    phase = (power_of(bands.up[..., inner]) - power_of(bands.down[..., inner])) / 2
    total = power.sum(-1, keepdim=True)
    total = torch.where(total.abs() > torch.finfo(power.dtype).tiny, total, 1)
    centred = w - (w * power).sum(-1, keepdim=True) / total
    free = _quotient((centred * phase).sum(-1), (centred.square() * power).sum(-1))
    if intercept == "free":
        return free
    if intercept == "record":
        rest = (phase - w * free[..., None].to(power.dtype) * power).sum((-2, -1), keepdim=True)
        phase = phase - power * rest / total.sum(-2, keepdim=True)
    return _quotient((w * phase).sum(-1), (w.square() * power).sum(-1))


def _quotient(a: Tensor, b: Tensor) -> Tensor:
    """Quotient a / b in float64, zero where b is not positive."""
    return torch.where(b > 0, a / torch.where(b > 0, b, 1), 0).to(torch.float64)


def _rms_difference(velocity: Tensor, known: Tensor, order: int) -> Tensor:
    """Rms first or second difference (order 1 or 2) of velocities (..., pulse) in known periods,
    (..., 1).
    """
    if velocity.shape[-1] <= order:
        return torch.zeros_like(velocity[..., :1])
    return mean_of(velocity.diff(n=order).square(), known.unfold(-1, order + 1, 1).all(-1)).sqrt()


def _interpolated(known: Tensor, slope: Tensor, bend: Tensor) -> Tensor:
    """Error (..., pulse) of `filled` in the periods that are not known; zero elsewhere.

    slope, bend: rms first and second difference of the values, (..., 1).
    """
    at = torch.arange(known.shape[-1], device=known.device).expand(known.shape)
    before = at - torch.where(known, at, -1).cummax(-1).values
    after = torch.where(known, at, 2 * at.shape[-1]).flip(-1).cummin(-1).values.flip(-1) - at
    inside = (before <= at) & (after < at.shape[-1])
    return torch.where(inside, bend * before * after / 2, slope * torch.minimum(before, after))


@torch.no_grad()
def assessed_motion(found: Estimate, cells: Tensor, walk: Walk) -> Estimate:
    """Add standard deviation and outcome of the phases to an estimate of the radial motion.

    In a dense scene they are those of `linked_walk`. In other scenes noise gives the deviation. If
    the power of the pulses is modulated, because several scatterers interfere, the difference from
    the phases of least entropy is added.

    Args:
        found: Estimate whose velocities were assessed.
        cells: Range cells after motion compensation and azimuth deramping, shape (..., pulse,
            range), complex.
        walk: Deviation and agreement of the phases.

    Returns:
        The estimate with the greater of both outcomes. That of the phases is

        - INEXACT where their standard deviation is 0.5 rad or more;
        - AMBIGUOUS where no two starts reach the same phases in a dense scene, or least entropy
          leads to other phases;
        - TOO_FEW where less than eight periods have an echo, or the power of the pulses is
          modulated in a single range cell, because the interference of scatterers cannot be
          distinguished from motion there.
    """
    n, lines = cells.shape[-2], cells.reshape(-1, *cells.shape[-2:])
    lit, range_cells = found.info["lit"].reshape(-1, n), found.info["range_cells"].flatten()
    power = power_of(lines).sum(-1, dtype=torch.float64)
    # standard deviation of the power of the lit pulses, over its mean
    modulation = mean_of((power / mean_of(power, lit).clamp_min(TINY) - 1).square(), lit)[:, 0].sqrt()
    # A relative modulation of the power of 0.1 beyond four standard deviations of noise means
    # several scatterers. It is measured in records of 32 periods or more.
    modulated = (modulation > 0.1 + 4 * math.sqrt(2) * walk.std_rad[:, 0]) & (n >= 32)
    sparse = walk.apart_rad.isnan()
    one_cell = modulated & sparse & (range_cells < 1.5)
    compared = modulated & sparse & ~one_cell & found.ok.flatten()
    std, apart = walk.std_rad, torch.zeros_like(walk.apart_rad)
    count = host_value(compared.sum(), 0)
    if count:
        at = true_positions(compared, count)
        pulses = prepare(lines[at], "radial_motion")
        # iterations towards least entropy, as in `autofocus`
        sharpen = Run(LogAbove(2.5), AlongPulses(), 60, 1.8, 0.01)
        other = fixed_point(pulses.rows, pair_phase(pulses.rows, pulses.present), sharpen)[0]
        apart = apart.index_put((at,), 2 * phase_rmse(walk.phase_rad[at], other, lit[at]))
        std = (std.square() + apart[:, None].square()).sqrt()
    reasons = worst(
        (Outcome.INEXACT, mean_of(std.square(), lit)[:, 0] >= 0.5**2),
        # Twice the rms difference between the phases of least entropy and correct phases was 0.11
        # to 0.15 rad. It was 0.43 and more where both were wrong at -10 dB.
        (Outcome.AMBIGUOUS, (walk.apart_rad >= SAME_RAD) | (apart >= 0.35)),
        (Outcome.TOO_FEW, one_cell | ((lines != 0).any(-1).sum(-1) < LEAST_PERIODS)),
    )
    shape = found.outcome.shape
    return replace(
        found,
        std={**found.std, "phase_rad": std.reshape(*shape, n)},
        outcome=torch.maximum(found.outcome, reasons.reshape(shape)),
    )
