"""The courses that shifts of envelopes take: shifts of single pulses, lines, robust polynomials and
tones, found by the likelihood of speckle.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from torchsar.core import legendre, linear_phasor

Match = Literal["likelihood", "amplitude"]

_HALF = 2  # samples a cell: |s|^2 has twice the band of s
_QUARTER = 4  # samples a cell in correlations, whose other factor has no band limit
_FLOOR = 1e-2  # of the mean power: what the likelihood takes an empty cell to hold
_COARSE = 16  # cycles in the window, the finest features that drift is looked for in
_TUKEY = 4.685
_LEAST_CELLS = 1e-3
_LEAST_TONE_CELLS = 0.05  # smaller ones cost less than they would add
_TUNINGS = 5
_STANDS_OUT = (
    # of the mean power of a periodogram, beyond the log of the number of its cells: one false tone
    # in 400 trials
    6.0
)


@dataclass(frozen=True)
class Envelopes:
    """Powers of pulses as half spectra (trial, pulse, frequency), frequency i being i / n cycles a
    cell; zero where not present (trial, pulse). n: cells.
    """

    spectra: Tensor
    present: Tensor
    n: int

    @property
    def count(self) -> Tensor:
        """Pulses that are there, (trial, 1, 1), at least 1."""
        return self.present.sum(-1)[:, None, None].clamp_min(1)

    @staticmethod
    def of(lines: Tensor) -> Envelopes:
        """Envelopes of pulses (trial, pulse, range): |s|^2 on half cells over its mean in each
        pulse.
        """
        n = lines.shape[-1]
        present = (lines != 0).any(-1)
        real, imag = lines.real.abs().amax(-1, keepdim=True), lines.imag.abs().amax(-1, keepdim=True)
        peak = torch.maximum(real, imag)
        power = _half_cells(lines / torch.where(peak > 0, peak, 1)).abs().square()
        mean = power.mean(-1, keepdim=True)
        return Envelopes(torch.fft.rfft(power / torch.where(mean > 0, mean, 1)), present, n)

    def moved(self, shift: Tensor) -> Tensor:
        """Spectra with shifts (trial, pulse) in cells taken out."""
        return self.spectra * linear_phasor(shift / self.n, 0, self.spectra.shape[-1], self.spectra.dtype)

    def amplitudes(self) -> Envelopes:
        """The same of |s|."""
        return Envelopes(torch.fft.rfft(self.on_grid(self.spectra).clamp_min(0).sqrt()), self.present, self.n)

    def on_grid(self, spectra: Tensor, per_cell: int = _HALF) -> Tensor:
        """Samples of half spectra, per_cell of them a cell."""
        return torch.fft.irfft(spectra, per_cell * self.n) * (per_cell / _HALF)

    def likelihood(self, mean: Tensor) -> Tensor:
        """Spectrum of -1 / T, as far as envelopes reach, for that of the mean envelope T:
        correlated with the power of a pulse, the log-likelihood of its shift.
        """
        weight = -1 / self.on_grid(mean, _QUARTER).clamp_min(_FLOOR)
        return torch.fft.rfft(weight)[..., : self.spectra.shape[-1]] * (_HALF / _QUARTER)

    def peak(self, spectra: Tensor) -> Tensor:
        """Place in cells, -n/2..n/2, of the maximum of a correlation given by its half spectrum
        (..., frequency): a parabola through three samples a quarter of a cell apart.
        """
        samples = self.on_grid(
            torch.cat([torch.zeros_like(spectra[..., :1]), spectra[..., 1:]], -1), _QUARTER
        )  # its mean says nothing, and costs digits
        length = samples.shape[-1]
        at = samples.argmax(-1, keepdim=True)
        left, top, right = (samples.gather(-1, (at + step) % length).to(torch.float64) for step in (-1, 0, 1))
        bend = left - 2 * top + right
        part = torch.where(bend < 0, 0.5 * (left - right) / torch.where(bend < 0, bend, -1), 0)
        place = (at + torch.where(torch.isfinite(part), part, 0)).squeeze(-1)
        return torch.where(place > length / 2, place - length, place) / _QUARTER


Course = tuple[
    Tensor, Tensor | None
]  # shifts (trial, pulse), and their deviation (trial,) where the method has one of its own


def _half_cells(lines: Tensor) -> Tensor:
    """Band-limited interpolation to half cells; the whole spectrum of n samples stays, from -n // 2
    on.
    """
    n = lines.shape[-1]
    spectrum = torch.fft.fftshift(torch.fft.fft(lines), dim=-1)
    before = n - n // 2
    padded = torch.nn.functional.pad(spectrum, (before, n - before))
    return torch.fft.ifft(torch.fft.ifftshift(padded, dim=-1)) * _HALF


def running_shifts(pulses: Envelopes, gain: float) -> Tensor:
    """Shifts against a mean that each pulse enters with `gain`, (trial, pulse) float64, continued
    over the ends of the window from pulse to pulse.
    """
    amplitude = pulses.amplitudes()
    mean, shift, shifts = (
        torch.zeros_like(amplitude.spectra[:, 0]),
        amplitude.spectra.new_zeros((), dtype=torch.float64).expand(len(pulses.present)),
        [],
    )
    for k in range(pulses.present.shape[-1]):
        there, pulse = pulses.present[:, k], amplitude.spectra[:, k]
        found = amplitude.peak(pulse * mean.conj())
        shift = torch.where(there, shift + wrapped(found - shift, pulses.n), shift)
        moved = pulse * linear_phasor(shift / pulses.n, 0, pulse.shape[-1], pulse.dtype)
        empty = (mean == 0).all(-1)
        mean = torch.where(there[:, None], torch.where(empty[:, None], moved, (1 - gain) * mean + gain * moved), mean)
        shifts.append(shift)
    return centred(torch.stack(shifts, -1), pulses.present)


def single_shifts(pulses: Envelopes, start: Tensor, match: Match, iterations: int) -> Tensor:
    """Shifts of pulses by themselves against the mean envelope, within half a window of the start,
    (trial, pulse) float64.
    """
    used = pulses.amplitudes() if match == "amplitude" else pulses
    shift = start
    for _ in range(iterations):
        mean = used.moved(shift).sum(-2, keepdim=True) / used.count
        against = mean if match == "amplitude" else used.likelihood(mean)
        found = used.peak(used.moved(start) * against.conj())
        shift = centred(start + torch.where(used.present, found, 0), used.present)
    return shift


def smooth_shifts(pulses: Envelopes, degree: int, passes: int, blocks: int) -> tuple[Tensor, Tensor]:
    """Polynomial course of the shifts, (trial, pulse) float64 of mean zero, and its deviation by
    the scatter of the runs about it, (trial,).
    """
    k = pulses.present.shape[-1]
    basis = legendre(unit_time(k, pulses.present.device), degree)
    runs = runs_of(k, max(blocks, degree + 1), pulses.present)
    shift = mean_drift(pulses)[:, None] * (torch.arange(k, dtype=torch.float64, device=basis.device) - (k - 1) / 2)
    count, step, found = runs.sum(-1), torch.zeros_like(runs[:, :1, 0]), torch.zeros_like(runs[..., 0])
    middle = (runs @ basis) / count.clamp_min(1)[..., None]
    for _ in range(passes):
        sums = runs.to(pulses.spectra.dtype) @ pulses.moved(shift)
        # a run is held against the others alone: its own noise would hold it where it is
        others = (sums.sum(-2, keepdim=True) - sums) / (count.sum(-1, keepdim=True) - count).clamp_min(1)[..., None]
        found = pulses.peak(sums * pulses.likelihood(others).conj())
        step = robust_fit(found, middle, count)
        shift = shift + (basis @ step[..., None]).squeeze(-1)
        shift = shift - shift.mean(-1, keepdim=True)
    off = (found - (middle @ step[..., None]).squeeze(-1)).abs()
    return shift, _middling(off, count > 0).squeeze(-1) * ((degree + 1) / (count > 0).sum(-1).clamp_min(1)).sqrt()


def mean_drift(pulses: Envelopes) -> Tensor:
    """Cells a pulse, (trial,) float64, modulo the window: the line along which the coarse features
    of all envelopes together add up best.

    sum_f |sum_k P_k(f) exp(2j pi f v k / n)|^2 over the lowest frequencies f and all v at once,
    from one zero-padded transform along pulses.
    """
    k, last = pulses.present.shape[-1], min(_COARSE, pulses.n - 1)
    if last < 1:
        return torch.zeros(len(pulses.present), dtype=torch.float64, device=pulses.present.device)
    length = 2 * last * k
    power = torch.fft.ifft(pulses.spectra[..., 1 : last + 1].mT, length).abs().square()
    lines = torch.arange(length, device=power.device)
    total = torch.stack([power[:, f - 1, (f * lines) % length] for f in range(1, last + 1)]).sum(0)
    cycles = total.argmax(-1).to(torch.float64) / length
    return pulses.n * (cycles - torch.round(cycles))


def robust_fit(values: Tensor, basis: Tensor, weight: Tensor, iterations: int = 12) -> Tensor:
    """Coefficients (trial, term) of basis (trial, m, term) through values (trial, m), by reweighted
    least squares: absolute deviations, then Tukey's biweight.

    weight: (trial, m), zero for values that do not count. The scale of the biweight is the median
    deviation of each trial.
    """
    now, coefficients = weight, torch.zeros_like(basis[:, 0])
    for turn in range(iterations):
        coefficients = weighted_fit(values, basis, now)
        off = (values - (basis @ coefficients[..., None]).squeeze(-1)).abs()
        if turn < iterations // 2:
            now = weight / off.clamp_min(0.1)
        else:
            scale = _middling(off, weight > 0) + _LEAST_CELLS
            now = weight * (1 - (off / (_TUKEY * scale)).square()).clamp_min(0).square()
    return coefficients


def _middling(off: Tensor, counts: Tensor) -> Tensor:
    """Deviation of normal errors with the median of these sizes (trial, m), (trial, 1)."""
    return 1.4826 * torch.where(counts, off, torch.nan).nanmedian(-1, keepdim=True).values.nan_to_num()


def weighted_fit(values: Tensor, basis: Tensor, weight: Tensor) -> Tensor:
    """Least squares, (trial, term); directions that nothing determines get zero.

    Shapes as `robust_fit`.
    """
    share = weight / weight.sum(-1, keepdim=True).clamp_min(torch.finfo(weight.dtype).tiny)
    normal = (basis.mT * share[:, None]) @ basis
    eye = torch.eye(basis.shape[-1], dtype=basis.dtype, device=basis.device)
    return torch.linalg.solve(normal + 1e-9 * eye, (basis.mT * share[:, None]) @ values[..., None]).squeeze(-1)


@dataclass(frozen=True)
class _Tone:
    """One sinusoid per trial: frequency (trial,) in cycles a pulse, cosine and sine parts (trial,
    2) in cells.
    """

    frequency: Tensor
    parts: Tensor

    def waves(self, time: Tensor) -> Tensor:
        """Cosine and sine, (trial, pulse, 2)."""
        angle = 2 * math.pi * self.frequency[:, None] * time
        return torch.stack([torch.cos(angle), torch.sin(angle)], -1)

    def columns(self, time: Tensor) -> Tensor:
        """Derivatives of the sinusoid after its two parts and its frequency, (trial, pulse, 3)."""
        waves = self.waves(time)
        turned = (self.parts[:, None, 1] * waves[..., 0] - self.parts[:, None, 0] * waves[..., 1]) * (
            2 * math.pi * (time - time.mean())
        )
        return torch.cat([waves, turned[..., None]], -1)


def with_tones(pulses: Envelopes, smooth: Tensor, tones: int, degree: int) -> Tensor:
    """The course with up to `tones` sinusoids added one by one, each only in trials where it stands
    out of the jitter of single pulses, (trial, pulse).
    """
    course = smooth
    for _ in range(tones):
        course = _with_tone(pulses, course, degree)
    return course


def _with_tone(pulses: Envelopes, course: Tensor, degree: int) -> Tensor:
    """The course with one more sinusoid, tuned together with the polynomial by Gauss-Newton steps
    through the shifts of single pulses.
    """
    k = course.shape[-1]
    time, weight = torch.arange(k, dtype=torch.float64, device=course.device), pulses.present.to(torch.float64)
    terms = legendre(unit_time(k, course.device), degree).expand(len(course), -1, -1)
    frequency, stands_out = strongest_tone(_left(pulses, course), pulses.present)
    tone, base, now = _Tone(frequency, torch.zeros_like(terms[:, 0, :1]).expand(-1, 2)), course, course
    for _ in range(_TUNINGS):
        step = robust_fit(_left(pulses, now), torch.cat([terms, tone.columns(time)], -1), weight)
        tone = _Tone(tone.frequency + step[:, -1].clamp(-0.5 / k, 0.5 / k), tone.parts + step[:, -3:-1])
        base = base + (terms @ step[:, :-3, None]).squeeze(-1)
        now = base + (tone.waves(time) @ tone.parts[..., None]).squeeze(-1)
    gain = log_likelihood(pulses, now) - log_likelihood(pulses, course)
    kept = stands_out & (tone.parts.square().sum(-1).sqrt() > _LEAST_TONE_CELLS) & (gain > math.log(k) + _STANDS_OUT)
    return centred(torch.where(kept[:, None], now, course), torch.ones_like(pulses.present))


def _left(pulses: Envelopes, course: Tensor) -> Tensor:
    """What single pulses are off a course, (trial, pulse)."""
    return single_shifts(pulses, course, "likelihood", 1) - course


def log_likelihood(pulses: Envelopes, course: Tensor) -> Tensor:
    """Of a course, (trial,), with the mean envelope T that is best for it: - pulses * sum over
    cells of ln T.
    """
    mean = pulses.on_grid(pulses.moved(course).sum(-2, keepdim=True) / pulses.count).clamp_min(_FLOOR)
    return -(torch.log(mean).sum(-1, keepdim=True) * pulses.count / _HALF)[:, 0, 0].to(torch.float64)


def strongest_tone(rest: Tensor, present: Tensor) -> tuple[Tensor, Tensor]:
    """Frequency (cycles a pulse) of the strongest sinusoid in residual shifts (trial, pulse), and
    whether noise would hardly hold it; both (trial,).
    """
    k = rest.shape[-1]
    limit = 3 * rest.abs().median(-1, keepdim=True).values
    power = torch.fft.rfft(torch.where(present, rest.clamp(-limit, limit), 0), 8 * k).abs().square()
    power[:, :8] = 0  # less than a period is the polynomial's
    top, at = power.max(-1)
    return at / (8 * k), top > (math.log(k) + _STANDS_OUT) * power.mean(-1)


def about_circular_mean(shift: Tensor, present: Tensor, n: int) -> Tensor:
    """Shifts (trial, pulse) less their mean on the circle of n cells, in -n/2..n/2; zero where not
    present.
    """
    turn = torch.where(present, torch.polar(torch.ones_like(shift), 2 * math.pi / n * shift), 0)
    return torch.where(present, wrapped(shift - torch.angle(turn.sum(-1, keepdim=True)) * (n / (2 * math.pi)), n), 0)


def centred(shift: Tensor, present: Tensor) -> Tensor:
    """Shifts (trial, pulse) less their mean over the pulses that are there."""
    return shift - (shift * present).sum(-1, keepdim=True) / present.sum(-1, keepdim=True).clamp_min(1)


def wrapped(cells: Tensor, n: int) -> Tensor:
    """Modulo the window, in -n/2..n/2."""
    return cells - n * torch.round(cells / n)


def unit_time(n: int, device: torch.device) -> Tensor:
    """Pulses on -1..1."""
    return (2 * torch.arange(n, dtype=torch.float64, device=device) - (n - 1)) / max(1, n - 1)


def runs_of(n: int, blocks: int, present: Tensor) -> Tensor:
    """Which pulses that are there belong to which of at most `blocks` runs of equal length, (trial,
    run, pulse) of 0 and 1, float64.
    """
    length = -(-n // blocks)
    run = torch.arange(n, device=present.device) // length
    member = run == torch.arange(-(-n // length), device=present.device)[:, None]
    return (member & present[:, None]).to(torch.float64)
