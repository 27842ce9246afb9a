"""Start of the triangular sweeps in a record of unknown timing, estimated from the record itself.

RD is the range of the scene relative to the reference range, f+ the beat frequency at this range.
After each turning point of the triangle there is a transient of the length 2 RD / c, until the echo
turns as well. The estimate is made in four steps:

1. Turning points: a short-time spectrum is least concentrated where its window contains a turning
   point. The concentration is averaged over all half periods.
2. Refinement: whole sweeps are cut out. Their spectra are sharpest if the cuts lie in the middle of
   the transient, and the sharpness falls equally towards both sides.
3. Fraction of a sample: in the middle of the transient, the tones of the strongest scatterer in the
   up and the down sweep have equal phase. The phases are also equal at other instants, the fringes,
   which are 1 / (2 f+) apart. Of the fringes near the result of step 2, the one is chosen at which
   the samples change from the strongest tones of one sweep to those of the next. Without Doppler
   shift the samples are symmetric about a turning point, whatever the scene: fringes about which
   they are clearly less symmetric than about another instant are excluded.
4. Order: it is decided which half of the period is the up sweep. With complex detection, the up
   sweep has the higher beat frequency if RD > 0. With real detection, a velocity v and one order of
   the sweeps give the same phases as -v and the other order. The correct order is then the one for
   which the range from the beat frequencies changes in the same sense as the integrated velocity.

Measured errors in complex records with RD = 1.5 m, 24 periods and a sampling interval of 16 ns are
0.02 ns without noise, 0.2 ns at 10 dB and 0.6 ns at 0 dB. In real records of the ground experiment
of the Reference with 64 periods, they are 0.01 to 0.04 ns at 10 dB. A record of 960 blocks of 9600
real samples takes 6 s and 1.2 GB on one core.

Analytic signal of real samples, and delays of lines by a fraction of a sample.

Reference:
    Remote Sens. 2024, 16, 793, Fig. 15 (separation by short-time Fourier transform).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import (
    Estimate,
    Outcome,
    checked_samples,
    differentiable,
    host_value,
    linear_phasor,
    real_dtype,
    take,
    unit_level,
    unit_phasor,
)
from torchsar.radar import TriangularLadar
from torchsar.repair.assess import assess_trigger


def delayed(lines: Tensor, fraction: Tensor, analytic: bool = False) -> Tensor:
    """Interpolate lines at the instants i + fraction, where i is the number of the sample.

    Lines are taken as periodic. Differentiable.

    Args:
        lines: Lines, shape (..., line, n), real or complex.
        fraction: Shift of the instants in samples, -0.5..0.5, positive for later instants; a number
            or shape (...,), float64.
        analytic: Whether to return the analytic signal: positive frequencies only, doubled, so that
            its real part is the real line.

    Returns:
        Complex lines of the same shape; the lines themselves if all shifts are zero and `analytic`
        is False.
    """
    n = lines.shape[-1]
    # inside vmap, where values cannot be read, the shift may differ from zero
    if not analytic and not fraction.requires_grad and not host_value(fraction.any(), True):
        return lines
    spectrum = torch.fft.fft(lines)
    turn = torch.fft.ifftshift(linear_phasor(fraction / n, -(n // 2), n, spectrum.dtype), dim=-1)[..., None, :]
    if analytic:
        order = torch.arange(n, device=lines.device)
        turn = turn * ((2 * order < n).int() + ((2 * order <= n) & (order > 0)).int())
    return torch.fft.ifft(spectrum * turn)


# number of sweeps that are used in the search for turning points, by choice: more are more accurate
# but take more time
MAX_WINDOWS = 192
# steps per half sample in which the symmetry of the record is computed, enough for linear
# interpolation
_FINE = 8


@dataclass(frozen=True)
class _Windows:
    """Complex lines (..., line, n) and their sweeps, which begin at o + j N with o in 0..N + 2
    margin.
    """

    lines: Tensor
    radar: TriangularLadar
    margin: int

    @property
    def count(self) -> int:
        """Even number of sweeps in one line."""
        n = self.radar.sweep_samples
        return ((self.lines.shape[-1] - 2 * self.margin) // n - 1) // 2 * 2

    def steps(self) -> tuple[int, int]:
        """Steps over lines and over pairs of sweeps that leave about MAX_WINDOWS sweeps."""
        pairs, n_line = self.count // 2, self.lines.shape[-2]
        step = max(1, pairs * n_line * 2 // MAX_WINDOWS)
        return min(step, n_line), min(pairs, max(1, step // min(step, n_line)))

    def cut(self, start: Tensor, every: bool = False) -> Tensor:
        """Cut pairs of up and down sweeps of N samples that begin at the samples `start`, shape
        (..., o) for o candidates.

        Returns (..., o, line, sweep, N): all sweeps if `every`, otherwise about MAX_WINDOWS. Beyond
        its end a line repeats its last sample.
        """
        n, device = self.radar.sweep_samples, self.lines.device
        line_step, pair_step = (1, 1) if every else self.steps()
        lines = self.lines[..., ::line_step, :]
        first = torch.arange(0, self.count // 2, pair_step, device=device) * 2
        j = torch.stack([first, first + 1], -1).flatten()
        position = start[..., None, None] + (j[:, None] * n + torch.arange(n, device=device))
        index = position.clamp_max(lines.shape[-1] - 1).flatten(-2)[..., None, :]
        source = lines[..., None, :, :].expand(*start.shape, *lines.shape[-2:])
        return source.gather(-1, index.expand(*source.shape[:-1], j.numel() * n)).unflatten(-1, (j.numel(), n))


@differentiable("where ok")
def find_trigger(
    record: Tensor,
    radar: TriangularLadar,
    contiguous: bool | None = None,
    nearer: bool = False,
    *,
    assess: bool = True,
) -> Estimate:
    """Estimate the start of the up sweep in the blocks of a record, one block per period.

    >>> import torch
    >>> radar = TriangularLadar(2e14, 5e9, 16e-6, 64e6, 60.0, 3000.0)
    >>> noise = torch.randn(24, 2 * radar.sweep_samples, dtype=torch.complex64)
    >>> int(find_trigger(noise, radar).outcome) == Outcome.NOISE
    True

    A scene that extends to both sides of the reference range has beats of both signs; the estimate
    is then unreliable.

    Args:
        record: Record, shape (..., pulse, time), real or complex.
        radar: Ladar parameters.
        contiguous: Whether blocks follow each other without a gap; None: without a gap if blocks
            are one period long and every period is recorded. Blocks with gaps need at least 1.7
            periods of samples.
        nearer: Whether the scene is nearer than the reference range. A complex record cannot show
            this: if it is wrong, the estimate is wrong by about half a period, and its outcome OK.
        assess: Whether to add quality and outcome.

    Returns:
        Estimate with `trigger_s` of shape (...,), in seconds after the first sample of a block,
        from -1 sample to one period - 1 sample. `quality`, 0..1, is the relative drop of the
        concentration of short-time spectra at turning points.

        `info` has three values for each trial. `order_sigmas` is the certainty, in standard
        deviations, that the up sweep is not mistaken for the down sweep. `fringe_sigmas` is the
        certainty, in standard deviations, that the right one of several instants with matching
        phases was chosen; it is 0 if the best of them is the last one tried. `coarse_s` is the
        estimate without use of phases, in seconds modulo half a period.

        The outcome is NOISE where no scene rises above the noise, OUTSIDE_SEARCH where no whole
        period fits its block, AMBIGUOUS where `order_sigmas` is below 5 or `fringe_sigmas` below 3,
        and MISFIT where the record is less symmetric about the turning points than the power of the
        scene in its spectrum lets expect.

    Raises:
        TypeError: If the record is not a tensor of real or complex samples.
        ValueError: If the record is not finite or too short.
    """
    record = checked_samples(record, "find_trigger", "pulse, time", real=True)
    n, is_complex = radar.sweep_samples, record.is_complex()
    joined = (radar.keep_every == 1 and record.shape[-1] == 2 * n) if contiguous is None else contiguous
    lines = unit_level(record.flatten(-2)[..., None, :] if joined else record)
    if not is_complex:
        lines = delayed(lines, torch.zeros((), dtype=torch.float64, device=lines.device), analytic=True)
    windows = _Windows(lines, radar, n // 8)
    if windows.count < 2 or windows.count * windows.lines.shape[-2] < 4:
        raise ValueError(
            f"the record is too short to find turning points: they are {n} samples apart, and only "
            f"{lines.shape[-1]} samples follow each other without a gap; record 3 periods, or 2 blocks of 1.7 periods "
            "or more"
        )
    coarse, depth = _turning_by_stft(windows)
    middle = _apex(windows, coarse, windows.margin)
    middle = _apex(windows, torch.round(middle).long(), max(n // 32, 6))
    middle = windows.margin + torch.remainder(middle - windows.margin, n)
    base = torch.round(middle).long().clamp(0, n + 2 * windows.margin)
    cycles, value = _find_tones(windows.cut(base[..., None], every=True).squeeze(-4), max(2, n // 32))
    turns = torch.angle(value[..., 0]) / (2 * math.pi)
    # strongest tones of even and odd sweeps, (..., line, pair), with the signs of a complex
    # detector
    side = 1 if is_complex else -1
    even, odd = cycles[..., 0::2, 0], side * cycles[..., 1::2, 0]
    gap, doppler = even - odd, (even + odd) / 2
    middle_gap = gap.flatten(-2).median(-1).values
    even_is_up, order_sigmas = (
        _order_by_beat(gap, nearer, radar) if is_complex else _order_by_envelope(gap, doppler, radar)
    )
    phase_difference = turns[..., 0::2] - side * turns[..., 1::2] + n * doppler
    meeting = _meeting(phase_difference, middle_gap / 2, middle - base)
    symmetry = _symmetry(windows, base, _without_outliers(doppler.flatten(-2)), is_complex)
    fine, fringe_sigmas, symmetric = _fringe(windows, base, (cycles, value), meeting, middle_gap.abs() / 2, symmetry)
    # The tones have equal phase half a transient, f+ / (2 K), after the turning point of the
    # reference, or before it if the scene is nearer.
    per_cycle = radar.sample_rate_hz**2 / radar.chirp_rate_hz_s / 2 * (-1 if nearer else 1)
    half_transient = middle_gap.abs() / 2 * per_cycle
    start = base + fine - 0.5 - half_transient + torch.where(even_is_up, 0, n)
    start = torch.nan_to_num(torch.remainder(start + 1, 2 * n) - 1)
    value = {"trigger_s": start / radar.sample_rate_hz}
    info = {
        "order_sigmas": order_sigmas,
        "fringe_sigmas": fringe_sigmas,
        "coarse_s": torch.nan_to_num(middle - 0.5 - half_transient) / radar.sample_rate_hz,
    }
    if not assess:
        return Estimate(value, outcome=Outcome.NOT_ASSESSED.like(start), info=info)
    outside = torch.zeros_like(even_is_up) if joined else (start <= -0.5) | (start + 2 * n > record.shape[-1])
    share = _scene_share(windows, base, is_complex)
    return Estimate(value, **assess_trigger(order_sigmas, fringe_sigmas, symmetric, share, outside, depth), info=info)


def _turning_by_stft(windows: _Windows) -> tuple[Tensor, Tensor]:
    """Sample of the turning points, margin..margin + N, and the drop of the spectral concentration
    there.
    """
    n = windows.radar.sweep_samples
    hop, width = max(1, n // 32), max(8, n // 8)
    lines = windows.lines[..., :: windows.steps()[0], :]
    lines = lines[..., : min(lines.shape[-1] // n, max(4, MAX_WINDOWS // lines.shape[-2])) * n]
    window = torch.hann_window(width, dtype=real_dtype(lines.dtype), device=lines.device)
    spectra = torch.stft(
        lines.reshape(-1, lines.shape[-1]), width, hop, window=window, center=False, onesided=False, return_complex=True
    )
    power = spectra.abs().square()
    sharp = power.square().sum(-2) / power.sum(-2).square().clamp_min(1e-30)
    sharp = sharp.reshape(*lines.shape[:-1], -1).mean(-2)
    frame = torch.round(
        (torch.arange(sharp.shape[-1], device=lines.device) * hop + width / 2) % n / hop
    ).long() % round(n / hop)
    bins = int(frame.max()) + 1
    total = sharp.new_zeros(*sharp.shape[:-1], bins).index_add(-1, frame, sharp)
    mean = total / torch.bincount(frame, minlength=bins).clamp_min(1)
    smooth = (torch.roll(mean, 1, -1) + 2 * mean + torch.roll(mean, -1, -1)) / 4
    position = smooth.argmin(-1) * hop
    drop = 1 - smooth.amin(-1) / smooth.amax(-1).clamp_min(1e-30)
    return torch.where(position < windows.margin, position + n, position), drop.to(torch.float64)


def _sharpness(windows: _Windows, first: Tensor) -> Tensor:
    """Sharpness (...,) of sweeps from the sample `first` (..., 1) on, averaged over the sweeps: the
    sum of the squared power of their spectra over the square of its sum.
    """
    power = torch.fft.fft(windows.cut(first)).abs().square().to(torch.float64)
    return (power.square().sum(-1) / power.sum(-1).square().clamp_min(1e-300)).mean((-3, -2, -1))


def _apex(windows: _Windows, near: Tensor, reach: int) -> Tensor:
    """First sample (...,) of the sweeps with the sharpest spectra: the intersection of straight
    lines fitted to the sharpness before and after `near`.
    """
    step = max(1, reach // 8)
    offset = torch.tensor([*range(-8, -2), *range(3, 9)], device=near.device) * step
    start = (near[..., None] + offset).clamp(0, windows.radar.sweep_samples + 2 * windows.margin)
    mean = torch.stack([_sharpness(windows, first) for first in start.split(1, -1)], -1).unflatten(-1, (2, 6))
    side = offset.to(torch.float64).unflatten(0, (2, 6))
    # least-squares weights (side, term, offset)
    terms = torch.linalg.pinv(torch.stack([torch.ones_like(side), side], -1))
    (left, rise), (right, fall) = ((mean[..., i, None, :] * terms[i]).sum(-1).unbind(-1) for i in (0, 1))
    top = (right - left) / (rise - fall).clamp_min(1e-300)
    return near.to(torch.float64) + top.clamp(-8 * step, 8 * step)


def _find_tones(sweeps: Tensor, skip: int, count: int = 4) -> tuple[Tensor, Tensor]:
    """Frequencies and complex amplitudes of the strongest tones, (..., count), found in succession.

    sweeps: (..., N), without `skip` samples at each end; frequencies in cycles per sample,
    amplitudes at the middle of the sweep.
    """
    left = sweeps[..., skip : sweeps.shape[-1] - skip].to(torch.complex128)
    m, tones = left.shape[-1], []
    window = torch.hann_window(m, periodic=False, dtype=torch.float64, device=sweeps.device)
    position = torch.arange(m, dtype=torch.float64, device=sweeps.device) - (m - 1) / 2
    for _ in range(count):
        cycles = _peak_cycles(left * window)
        tone = unit_phasor(cycles[..., None] * position, torch.complex128)
        value = (left * window * tone.conj()).sum(-1) / window.sum()
        left = left - value[..., None] * tone
        tones.append((cycles, value))
    return torch.stack([c for c, _ in tones], -1), torch.stack([v for _, v in tones], -1)


def _peak_cycles(x: Tensor) -> Tensor:
    """Frequency of the strongest tone of windowed samples, by a parabola through log power."""
    n = 4 * x.shape[-1]
    power = torch.fft.fft(x, n).abs().square()
    peak = power.argmax(-1)
    low, top, high = (
        torch.log(power.gather(-1, ((peak + i) % n)[..., None])[..., 0].clamp_min(1e-300)) for i in (-1, 0, 1)
    )
    cycles = (peak + ((high - low) / (2 * (2 * top - low - high).clamp_min(1e-12))).clamp(-0.5, 0.5)) / n
    return cycles - torch.round(cycles)


def _meeting(phase_difference: Tensor, plus_cycles: Tensor, expected: Tensor) -> Tensor:
    """Sample offset nearest to the expected one at which even and odd tones have equal phase."""
    phasor = torch.polar(torch.ones_like(phase_difference), 2 * math.pi * phase_difference).mean((-2, -1))
    turns, twice = torch.angle(phasor) / (2 * math.pi), 2 * plus_cycles
    known = twice.abs() > 1e-6
    return torch.where(
        known, -(turns + torch.round(-turns - expected * twice)) / torch.where(known, twice, 1), expected
    )


def _fringe(
    windows: _Windows,
    base: Tensor,
    tones: tuple[Tensor, Tensor],
    expected: Tensor,
    plus_cycles: Tensor,
    symmetry: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """Fringe around `expected` at which the samples change from even to odd tones, its certainty,
    and the symmetry there.

    The sum of |x - odd|^2 - |x - even|^2 up to a boundary is largest at the true one. Its standard
    deviation follows from the scatter between pairs of sweeps. Fringes about which the record is
    clearly less symmetric than about another instant are excluded, because with many scatterers the
    strongest tones do not describe the samples. Offsets are in samples from base, the certainty is
    in standard deviations. symmetry: see `_symmetry`.
    """
    n, reach = windows.radar.sweep_samples, windows.margin
    around = windows.cut((base - reach)[..., None], every=True).squeeze(-4)[..., 1::2, : 2 * reach]
    position = torch.arange(-reach, reach, dtype=torch.float64, device=base.device)
    # tones of the sweeps before and after the boundary, relative to the middle of each
    even, odd = (
        (value[..., None] * unit_phasor(cycles[..., None] * at, torch.complex128)).sum(-2)
        for cycles, value, at in (
            (*(x[..., 0::2, :] for x in tones), position + (n + 1) / 2),
            (*(x[..., 1::2, :] for x in tones), position - (n - 1) / 2),
        )
    )
    difference = (around - odd).abs().square() - (around - even).abs().square()
    total = torch.nn.functional.pad(torch.cumsum(difference, -1), (1, 0)).flatten(-3, -2)
    # three fringes on either side of the one nearest to the sharpest cuts, by choice
    order = torch.arange(-3, 4, dtype=torch.float64, device=base.device)
    offsets = expected[..., None] + order / (2 * plus_cycles.clamp_min(1e-6))[..., None]
    gain = _interpolated(total, (offsets + reach).clamp(0, 2 * reach))
    found = _interpolated(symmetry, ((offsets + reach) * 2 * _FINE).clamp(0, symmetry.shape[-1] - 1))
    mean = symmetry.mean(-2)
    most, at = mean.max(-1)
    short = symmetry.gather(-1, at[..., None, None].expand(*symmetry.shape[:-1], 1)) - found
    clear = _sigmas(short)
    # limits checked on scenes of 1 to 40 scatterers; certainties are in standard deviations
    excluded = (found.mean(-2) < 0.9 * most[..., None]) & (clear > 5)
    best = torch.where(excluded, -torch.inf, gain.mean(-2)).argmax(-1)
    sigmas = _sigmas(take(gain.movedim(-1, -2), best, -2)[..., None] - gain)
    others = torch.arange(len(order), device=base.device) != best[..., None]
    certainty = torch.where(others, torch.where(excluded, clear, sigmas), torch.inf).amin(-1)
    # the certainty is zero at an end of the search, since fringes beyond it may fit better
    beyond = (best == 0) | (best == len(order) - 1) | excluded.all(-1)
    certainty = torch.where(beyond, 0, certainty)
    chosen = torch.where(certainty > 3, take(offsets, best), expected)
    return chosen, certainty, take(found.mean(-2), best)


def _sigmas(x: Tensor) -> Tensor:
    """Mean of x (..., k, m) over k values, divided by its standard deviation, (..., m)."""
    return x.mean(-2) / (x.std(-2) / math.sqrt(x.shape[-2])).clamp_min(1e-9)


def _symmetry(windows: _Windows, base: Tensor, shift_cycles: Tensor, is_complex: bool) -> Tensor:
    """Symmetry of the samples about instants near the turning points, (..., k, m), for k of the
    pairs.

    The optical frequency is symmetric about a turning point. So are the samples of any scene, once
    the Doppler shift is removed: the sum of products of samples that lie symmetrically about an
    instant is greatest there. The instants run from -margin to margin about base in steps of 1 / (2
    _FINE) sample. An analytic signal is conjugate-symmetric instead. shift_cycles: Doppler shift in
    cycles per sample, (..., k).
    """
    n, reach = windows.radar.sweep_samples, windows.margin
    half = n // 2 - reach
    x = windows.cut((base + n - half)[..., None], every=True).squeeze(-4)[..., 0::2, : 2 * half].flatten(-3, -2)
    step = max(1, x.shape[-2] // MAX_WINDOWS)
    x, shift_cycles = x[..., ::step, :], shift_cycles[..., ::step]
    position = torch.arange(2 * half, dtype=torch.float64, device=base.device) - (half - 0.5)
    position = position if is_complex else -position.abs()
    x = x.to(torch.complex128) * unit_phasor(-shift_cycles[..., None] * position, torch.complex128)
    x = x / x.abs().square().sum(-1, keepdim=True).clamp_min(1e-300).sqrt()
    spectrum = torch.fft.fft(x, 4 * half)
    other = torch.fft.fft(x.conj(), 4 * half) if is_complex else spectrum
    product = torch.fft.fftshift(spectrum * other, dim=-1)
    fine = torch.fft.ifft(torch.fft.ifftshift(torch.nn.functional.pad(product, [2 * half * (_FINE - 1)] * 2), dim=-1))
    middle = (2 * half - 1) * _FINE  # instant half a sample before sample `half`
    return fine.real[..., middle - 2 * reach * _FINE : middle + 2 * reach * _FINE + 1] * _FINE


def _scene_share(windows: _Windows, base: Tensor, is_complex: bool) -> Tensor:
    """Share (...,) of the scene in the power, if the scene fills less than half of the spectrum."""
    spectra = torch.fft.fft(windows.cut(base[..., None]).squeeze(-4))
    power = (spectra if is_complex else spectra[..., : spectra.shape[-1] // 2]).abs().square()
    mean = power.mean((-3, -2, -1), dtype=torch.float64)
    # the median of an exponential distribution is ln 2 times its mean
    return torch.where(mean > 0, 1 - power.flatten(-3).median(-1).values / math.log(2) / mean.clamp_min(1e-300), 0)


def _interpolated(x: Tensor, position: Tensor) -> Tensor:
    """Interpolate x (..., k, n) linearly at fractional indices (..., m), (..., k, m)."""
    first = position.long().clamp(0, x.shape[-1] - 2)
    shape = (*x.shape[:-1], position.shape[-1])
    low, high = (x.gather(-1, (first + i)[..., None, :].expand(shape)) for i in (0, 1))
    return low + (position - first)[..., None, :] * (high - low)


def _order_by_beat(gap: Tensor, nearer: bool, radar: TriangularLadar) -> tuple[Tensor, Tensor]:
    """True where even sweeps are up, because up sweeps have the higher beat frequency, and the
    certainty of this.

    gap: differences (..., line, pair) of the beat frequencies of even and odd sweeps in cycles per
    sample.
    """
    gap = gap.flatten(-2)
    middle = gap.median(-1).values
    std = (gap - middle[..., None]).abs().median(-1).values * 1.5 + 1e-3 / radar.sweep_samples
    up_higher = (radar.dechirp_sign == "lo_conj_echo") != nearer
    return (middle > 0) == up_higher, middle.abs() / std * math.sqrt(gap.shape[-1] / 2)


def _order_by_envelope(gap: Tensor, doppler: Tensor, radar: TriangularLadar) -> tuple[Tensor, Tensor]:
    """True where even sweeps of a real record are up, and the certainty of this.

    Even sweeps are up if the range from the beat frequencies rises with the velocity that this
    assumption gives. Range changes by plus or minus the integrated velocity. The certainty is the
    correlation of both relative to that due to the scatter of the range from period to period.
    """
    plus, shift = (_without_outliers(x.flatten(-2) if x.shape[-2] == 1 else x[..., 0]) for x in (gap / 2, doppler))
    range_m = plus * (radar.sample_rate_hz * radar.wave_speed_m_s / (2 * radar.chirp_rate_hz_s))
    velocity = shift * (radar.sample_rate_hz * radar.wavelength_m / 2)
    if range_m.shape[-1] < 4:
        return torch.ones_like(range_m[..., 0], dtype=torch.bool), torch.zeros_like(range_m[..., 0])
    displacement = torch.nn.functional.pad(torch.cumulative_trapezoid(velocity, dx=radar.pulse_step_s), (1, 0))
    displacement, range_m = (x - x.mean(-1, keepdim=True) for x in (displacement, range_m))
    noise = torch.diff(range_m).square().mean(-1).clamp_min(1e-30).sqrt() / math.sqrt(2)
    certainty = (range_m * displacement).sum(-1) / (noise * displacement.square().sum(-1).clamp_min(1e-30).sqrt())
    return certainty > 0, certainty.abs()


def _without_outliers(x: Tensor, sigmas: float = 6.0) -> Tensor:
    """Replace outliers of values (..., k) by a running median."""
    width = min(9, x.shape[-1] // 2 * 2 - 1)
    near = torch.arange(x.shape[-1], device=x.device)[:, None] + torch.arange(width, device=x.device) - width // 2
    middle = x[..., near.clamp(0, x.shape[-1] - 1)].median(-1).values
    distance = (x - middle).abs()
    return torch.where(distance > sigmas * 1.5 * distance.median(-1, keepdim=True).values, middle, x)
