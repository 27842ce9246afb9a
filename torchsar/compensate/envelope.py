"""Alignment of the envelopes of pulses in range, ahead of any estimate of their phases (brief 002, section 9).

A shift is the place of a pulse against what the pulses have in common, in cells, towards greater range and circular in the window. It is to be
removed: `shift_range(data, -shift_cells)`. Envelopes are powers |s|^2 on a grid of half cells, where they are band-limited and shifts by any
fraction exact, each over its own mean: neither the phase nor the gain of a pulse can change its shift.

A range cell of many scatterers is speckle: its power in a pulse is exponential about the mean T of all pulses, noise included. The log-likelihood of a
shift is then the correlation of |s|^2 with -1 / T, not with T or with |s|. On the aircraft of brief 002 this halves the jitter of single pulses and
lets a polynomial be found at -10 dB.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.data import checked
from torchsar.compensate.pulse_phase.recommended import autofocus
from torchsar.compensate.pulse_phase.stages import correct_pulse_phase
from torchsar.core import Estimate, Signal, Stage, block_bytes_of, fft_lines, legendre, linear_phasor, refuse_non_finite
from torchsar.metrics.image import entropy
from torchsar.optim.descent import lbfgs

Match = Literal["likelihood", "amplitude"]

GOOD_CELLS = 0.5  # deviation of a shift beyond which an alignment is not ok
_HALF = 2  # samples a cell: |s|^2 has twice the band of s
_QUARTER = 4  # samples a cell in correlations, whose other factor has no band limit
_FLOOR = 1e-2  # of the mean power: what the likelihood takes an empty cell to hold
_COARSE = 16  # cycles in the window, the finest features that drift is looked for in
_TUKEY = 4.685
_LEAST_CELLS = 1e-3
_LEAST_TONE_CELLS = 0.05  # smaller ones cost less than they would add
_TUNINGS = 5
_STANDS_OUT = 6.0  # of the mean power of a periodogram, beyond the log of the number of its cells: one false tone in 400 trials


def shift_range(data: Tensor, shift_cells: Tensor | float) -> Tensor:
    """Every pulse moved by its shift towards greater range, circularly. data: (..., pulse, range) complex; shift_cells: (..., pulse), (pulse,) or a number.

    A linear phase about the centre of fast time, the middle of the band: the phase of an echo does not turn with its place. Unitary, and
    shift_range(., -s) undoes shift_range(., s). Differentiable in both. Raises ValueError for shifts of another shape or not finite.
    """
    n = data.shape[-1]
    shift = torch.as_tensor(shift_cells, dtype=torch.float64, device=data.device)
    if shift.ndim and shift.shape[-1] != data.shape[-2]:
        raise ValueError(f"one shift per pulse is needed, (..., {data.shape[-2]}), got {tuple(shift.shape)}")
    refuse_non_finite(shift, "shift_range: shift_cells")
    phasor = torch.fft.ifftshift(linear_phasor(-shift / n, -(n // 2), n, data.dtype), dim=-1)
    return torch.fft.ifft(torch.fft.fft(data) * phasor)


def align_running(data: Tensor, *, memory_pulses: float = 10.0) -> Estimate:
    """Shift of each pulse against an exponentially running mean of the aligned ones before it, with value["shift_cells"] (..., pulse).

    data: (..., pulse, range) complex, range-compressed. Correlates |s|, peak by a parabola through samples a quarter of a cell apart. memory_pulses: how far the mean
    reaches back. Follows any motion of less than half a window from pulse to pulse, but the mean drifts: for a start. See `align_envelopes`, also for
    std, ok and errors.
    """
    if not memory_pulses >= 1:
        raise ValueError(f"align_running: memory_pulses is {memory_pulses}; choose 1 or more")
    return _estimated(data, "align_running", lambda pulses: (running_shifts(pulses, 1 / memory_pulses), None))


def align_mean(data: Tensor, *, first: Literal["running", "none"] = "running", match: Match = "likelihood", iterations: int = 4) -> Estimate:
    """Shift of each pulse by itself against the mean envelope of all, iterated, with value["shift_cells"] (..., pulse).

    data: (..., pulse, range) complex. first: where to begin, the running mean or the data as they are. match: "likelihood" correlates |s|^2 with -1 / T, "amplitude"
    |s| with its mean. On a perfect recording of the aircraft the shifts have 0.03 cell (likelihood) or 0.07 cell rms of speckle jitter. For motion that has no
    smooth course; otherwise `align_envelopes`, also for std, ok and errors.
    """
    if first not in ("running", "none") or match not in ("likelihood", "amplitude") or iterations < 1:
        raise ValueError(f"align_mean: first is {first!r} ('running' or 'none'), match {match!r} ('likelihood' or 'amplitude'), iterations {iterations} (1 or more)")

    def find(pulses: Envelopes) -> Course:
        start = running_shifts(pulses, 0.1) if first == "running" else torch.zeros_like(pulses.present, dtype=torch.float64)
        return single_shifts(pulses, start, match, iterations), None

    return _estimated(data, "align_mean", find)


def align_envelopes(data: Tensor, *, degree: int | None = 2, tones: int = 0, passes: int = 6, blocks: int = 16) -> Estimate:
    """The recommended alignment, with value["shift_cells"] (..., pulse) to be removed: a smooth course of shifts of mean zero.

    data: (..., pulse, range) complex, range-compressed, of any phases. The line along which the coarse envelopes add up best, then `passes` rounds: the mean
    envelope, the likelihood of the shift of each of `blocks` runs of pulses against that of the others, and a polynomial of `degree` through these, robust
    against runs that went wrong. tones: number of sinusoids (vibration) that are then looked for in the shifts of single pulses, and kept where they
    stand out; they need periods of two pulses or more, and shifts of single pulses, that is about -5 dB. degree None: shifts of single pulses, not
    smoothed, begun at a parabola.

    On the aircraft of brief 002 (400 pulses) the course is found to 0.02 cell down to -8 dB and to 0.05 cell at -12.5 dB, and costs perfect data less than 0.002 nats.
    Shifts may pass the ends of the window any number of times, but not curve away from a line by half a window. A pulse of zeros takes the
    place that the course gives it. std: half of the rms difference between what the lower and the upper half of the band say, each found from nothing, or the
    deviation of the course by the scatter of its runs where that is more; ok: it is below half a cell. quality: 1 / (1 + (2 std)^2). Not differentiable.
    Raises TypeError or ValueError for samples that are not finite and complex, or settings that make no sense.
    """
    whole = all(isinstance(value, int) for value in (degree or 0, tones, passes, blocks))
    if not (whole and (degree is None or degree >= 0) and tones >= 0 and passes >= 1 and blocks >= 1) or (degree is None and tones):
        raise ValueError(f"align_envelopes: degree is {degree!r} (0 or more; None without tones), tones {tones!r} (0 or more), passes {passes!r} and blocks {blocks!r} (1 or more); whole numbers")

    def find(pulses: Envelopes) -> Course:
        smooth, deviation = smooth_shifts(pulses, 2 if degree is None else degree, passes, blocks)
        if degree is None:
            return single_shifts(pulses, smooth, "likelihood", 3), None
        return with_tones(pulses, smooth, tones, degree), deviation

    return _estimated(data, "align_envelopes", find)


def refine_alignment(data: Tensor, shift_cells: Tensor, *, degree: int = 2, rounds: int = 2, steps: int = 15) -> Estimate:
    """Image-based refinement: the polynomial that, added to shifts (..., pulse), gives the image of least entropy, with value["shift_cells"].

    data: (..., pulse, range) complex. In each round `autofocus` finds the phases at the present shifts; then the coefficients of degrees 1..degree are varied with these
    phases held (torchsar.optim.lbfgs, each trial by itself, at most `steps` steps). A round that does not lower the entropy is not taken. Needs
    phases that can be found, that is shifts within about a cell. On shifts of `align_envelopes` it changes the
    entropy by less than 0.005. ok and quality: those of the last autofocus. Errors as `align_envelopes`.
    """
    flat, _ = checked(data, "refine_alignment")
    if degree < 1 or rounds < 1:
        raise ValueError(f"refine_alignment: degree is {degree} and rounds {rounds}; choose 1 or more of both")
    flat, shift = flat.detach(), shift_cells.detach().to(torch.float64).expand(data.shape[:-1]).reshape(flat.shape[:-1])
    basis = legendre(_unit_time(flat.shape[-2], flat.device), degree)[:, 1:]
    phase = autofocus(shift_range(flat, -shift))
    least = entropy(_focused(flat, shift, phase["phase_rad"]))
    for _ in range(rounds):
        held = phase["phase_rad"]
        found = lbfgs(lambda c: entropy(_focused(flat, shift + (basis @ c[..., None])[..., 0], held)).double(), shift.new_zeros(len(flat), degree), steps=steps, first_step=0.05)  # noqa: B023
        moved = shift + (basis @ found.x[..., None])[..., 0]
        phase = autofocus(shift_range(flat, -moved), start=held)
        reached = entropy(_focused(flat, moved, phase["phase_rad"]))
        shift, least = torch.where((reached < least)[:, None], moved, shift), torch.minimum(reached, least)
    shape = data.shape[:-2]
    return Estimate({"shift_cells": shift.reshape(data.shape[:-1])}, phase.quality.reshape(shape), phase.ok.reshape(shape), info={"entropy_nats": least.reshape(shape)})


def _focused(data: Tensor, shift: Tensor, phase_rad: Tensor) -> Tensor:
    return fft_lines(correct_pulse_phase(shift_range(data, -shift), phase_rad))


def drift_cells(shift_cells: Tensor) -> Tensor:
    """Mean drift of shifts (..., pulse), cells a pulse (...,): the slope of the line through them by least squares; 0 for a single pulse."""
    n = shift_cells.shape[-1]
    k = torch.arange(n, dtype=shift_cells.dtype, device=shift_cells.device) - (n - 1) / 2
    return (shift_cells * k).sum(-1) / k.square().sum().clamp_min(1)


@dataclass(frozen=True)
class Envelopes:
    """Powers of pulses as half spectra (trial, pulse, frequency), frequency i being i / n cycles a cell; zero where not present (trial, pulse). n: cells."""

    spectra: Tensor
    present: Tensor
    n: int

    @property
    def count(self) -> Tensor:
        """Pulses that are there, (trial, 1, 1), at least 1."""
        return self.present.sum(-1)[:, None, None].clamp_min(1)

    @staticmethod
    def of(lines: Tensor) -> Envelopes:
        """Envelopes of pulses (trial, pulse, range): |s|^2 on half cells over its mean in each pulse."""
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
        """Spectrum of -1 / T, as far as envelopes reach, for that of the mean envelope T: correlated with the power of a pulse, the log-likelihood of its shift."""
        weight = -1 / self.on_grid(mean, _QUARTER).clamp_min(_FLOOR)
        return torch.fft.rfft(weight)[..., : self.spectra.shape[-1]] * (_HALF / _QUARTER)

    def peak(self, spectra: Tensor) -> Tensor:
        """Place in cells, -n/2..n/2, of the maximum of a correlation given by its half spectrum (..., frequency): a parabola through three samples a quarter of a cell apart."""
        samples = self.on_grid(torch.cat([torch.zeros_like(spectra[..., :1]), spectra[..., 1:]], -1), _QUARTER)  # its mean says nothing, and costs digits
        length = samples.shape[-1]
        at = samples.argmax(-1, keepdim=True)
        left, top, right = (samples.gather(-1, (at + step) % length).to(torch.float64) for step in (-1, 0, 1))
        bend = left - 2 * top + right
        part = torch.where(bend < 0, 0.5 * (left - right) / torch.where(bend < 0, bend, -1), 0)
        place = (at + torch.where(torch.isfinite(part), part, 0)).squeeze(-1)
        return torch.where(place > length / 2, place - length, place) / _QUARTER


Course = tuple[Tensor, Tensor | None]  # shifts (trial, pulse), and their deviation (trial,) where the method has one of its own


def _half_cells(lines: Tensor) -> Tensor:
    """Band-limited interpolation to half cells; the whole spectrum of n samples stays, from -n // 2 on."""
    n = lines.shape[-1]
    spectrum = torch.fft.fftshift(torch.fft.fft(lines), dim=-1)
    before = n - n // 2
    padded = torch.nn.functional.pad(spectrum, (before, n - before))
    return torch.fft.ifft(torch.fft.ifftshift(padded, dim=-1)) * _HALF


def running_shifts(pulses: Envelopes, gain: float) -> Tensor:
    """Shifts against a mean that each pulse enters with `gain`, (trial, pulse) float64, continued over the ends of the window from pulse to pulse."""
    amplitude = pulses.amplitudes()
    mean, shift, shifts = torch.zeros_like(amplitude.spectra[:, 0]), amplitude.spectra.new_zeros((), dtype=torch.float64).expand(len(pulses.present)), []
    for k in range(pulses.present.shape[-1]):
        there, pulse = pulses.present[:, k], amplitude.spectra[:, k]
        found = amplitude.peak(pulse * mean.conj())
        shift = torch.where(there, shift + _wrapped(found - shift, pulses.n), shift)
        moved = pulse * linear_phasor(shift / pulses.n, 0, pulse.shape[-1], pulse.dtype)
        empty = (mean == 0).all(-1)
        mean = torch.where(there[:, None], torch.where(empty[:, None], moved, (1 - gain) * mean + gain * moved), mean)
        shifts.append(shift)
    return _centred(torch.stack(shifts, -1), pulses.present)


def single_shifts(pulses: Envelopes, start: Tensor, match: Match, iterations: int) -> Tensor:
    """Shifts of pulses by themselves against the mean envelope, within half a window of the start, (trial, pulse) float64."""
    used = pulses.amplitudes() if match == "amplitude" else pulses
    shift = start
    for _ in range(iterations):
        mean = used.moved(shift).sum(-2, keepdim=True) / used.count
        against = mean if match == "amplitude" else used.likelihood(mean)
        found = used.peak(used.moved(start) * against.conj())
        shift = _centred(start + torch.where(used.present, found, 0), used.present)
    return shift


def smooth_shifts(pulses: Envelopes, degree: int, passes: int, blocks: int) -> tuple[Tensor, Tensor]:
    """Polynomial course of the shifts, (trial, pulse) float64 of mean zero, and its deviation by the scatter of the runs about it, (trial,)."""
    k = pulses.present.shape[-1]
    basis = legendre(_unit_time(k, pulses.present.device), degree)
    runs = _runs(k, max(blocks, degree + 1), pulses.present)
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
    """Cells a pulse, (trial,) float64, modulo the window: the line along which the coarse features of all envelopes together add up best.

    sum_f |sum_k P_k(f) exp(2j pi f v k / n)|^2 over the lowest frequencies f and all v at once, from one zero-padded transform along pulses.
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
    """Coefficients (trial, term) of basis (trial, m, term) through values (trial, m), by reweighted least squares: absolute deviations, then Tukey's biweight.

    weight: (trial, m), zero for values that do not count. The scale of the biweight is the median deviation of each trial.
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
    """Least squares, (trial, term); directions that nothing determines get zero. Shapes as `robust_fit`."""
    share = weight / weight.sum(-1, keepdim=True).clamp_min(torch.finfo(weight.dtype).tiny)
    normal = (basis.mT * share[:, None]) @ basis
    eye = torch.eye(basis.shape[-1], dtype=basis.dtype, device=basis.device)
    return torch.linalg.solve(normal + 1e-9 * eye, (basis.mT * share[:, None]) @ values[..., None]).squeeze(-1)


@dataclass(frozen=True)
class _Tone:
    """One sinusoid per trial: frequency (trial,) in cycles a pulse, cosine and sine parts (trial, 2) in cells."""

    frequency: Tensor
    parts: Tensor

    def waves(self, time: Tensor) -> Tensor:
        """Cosine and sine, (trial, pulse, 2)."""
        angle = 2 * math.pi * self.frequency[:, None] * time
        return torch.stack([torch.cos(angle), torch.sin(angle)], -1)

    def columns(self, time: Tensor) -> Tensor:
        """Derivatives of the sinusoid after its two parts and its frequency, (trial, pulse, 3)."""
        waves = self.waves(time)
        turned = (self.parts[:, None, 1] * waves[..., 0] - self.parts[:, None, 0] * waves[..., 1]) * (2 * math.pi * (time - time.mean()))
        return torch.cat([waves, turned[..., None]], -1)


def with_tones(pulses: Envelopes, smooth: Tensor, tones: int, degree: int) -> Tensor:
    """The course with up to `tones` sinusoids added one by one, each only in trials where it stands out of the jitter of single pulses, (trial, pulse)."""
    course = smooth
    for _ in range(tones):
        course = _with_tone(pulses, course, degree)
    return course


def _with_tone(pulses: Envelopes, course: Tensor, degree: int) -> Tensor:
    """The course with one more sinusoid, tuned together with the polynomial by Gauss-Newton steps through the shifts of single pulses."""
    k = course.shape[-1]
    time, weight = torch.arange(k, dtype=torch.float64, device=course.device), pulses.present.to(torch.float64)
    terms = legendre(_unit_time(k, course.device), degree).expand(len(course), -1, -1)
    frequency, stands_out = strongest_tone(_left(pulses, course), pulses.present)
    tone, base, now = _Tone(frequency, torch.zeros_like(terms[:, 0, :1]).expand(-1, 2)), course, course
    for _ in range(_TUNINGS):
        step = robust_fit(_left(pulses, now), torch.cat([terms, tone.columns(time)], -1), weight)
        tone = _Tone(tone.frequency + step[:, -1].clamp(-0.5 / k, 0.5 / k), tone.parts + step[:, -3:-1])
        base = base + (terms @ step[:, :-3, None]).squeeze(-1)
        now = base + (tone.waves(time) @ tone.parts[..., None]).squeeze(-1)
    gain = log_likelihood(pulses, now) - log_likelihood(pulses, course)
    kept = stands_out & (tone.parts.square().sum(-1).sqrt() > _LEAST_TONE_CELLS) & (gain > math.log(k) + _STANDS_OUT)
    return _centred(torch.where(kept[:, None], now, course), torch.ones_like(pulses.present))


def _left(pulses: Envelopes, course: Tensor) -> Tensor:
    """What single pulses are off a course, (trial, pulse)."""
    return single_shifts(pulses, course, "likelihood", 1) - course


def log_likelihood(pulses: Envelopes, course: Tensor) -> Tensor:
    """Of a course, (trial,), with the mean envelope T that is best for it: - pulses * sum over cells of ln T."""
    mean = pulses.on_grid(pulses.moved(course).sum(-2, keepdim=True) / pulses.count).clamp_min(_FLOOR)
    return -(torch.log(mean).sum(-1, keepdim=True) * pulses.count / _HALF)[:, 0, 0].to(torch.float64)


def strongest_tone(rest: Tensor, present: Tensor) -> tuple[Tensor, Tensor]:
    """Frequency (cycles a pulse) of the strongest sinusoid in residual shifts (trial, pulse), and whether noise would hardly hold it; both (trial,)."""
    k = rest.shape[-1]
    limit = 3 * rest.abs().median(-1, keepdim=True).values
    power = torch.fft.rfft(torch.where(present, rest.clamp(-limit, limit), 0), 8 * k).abs().square()
    power[:, :8] = 0  # less than a period is the polynomial's
    top, at = power.max(-1)
    return at / (8 * k), top > (math.log(k) + _STANDS_OUT) * power.mean(-1)


def _estimated(data: Tensor, name: str, find: Callable[[Envelopes], Course]) -> Estimate:
    """Shifts of the whole band and, to judge them, of its lower and upper half, whose speckle and noise are independent."""
    flat, present = checked(data, name)
    height = max(1, 8 * block_bytes_of(flat.device) // max(1, flat[0].numel() * flat.element_size())) if len(flat) else 1
    with torch.no_grad():
        parts = [_judged(flat[first : first + height].detach(), find) for first in range(0, len(flat), height)]
    parts = parts or [(torch.zeros_like(present, dtype=torch.float64), torch.zeros(0, dtype=torch.float64, device=flat.device))]  # no trials
    shift, std = (torch.cat(pieces) for pieces in zip(*parts, strict=True))
    learnable = present.sum(-1) >= 2
    shift, std = torch.where(learnable[:, None], shift, 0), torch.where(learnable, std, data.shape[-1] / math.sqrt(12))
    quality = 1 / (1 + (std / GOOD_CELLS).square())
    shape = data.shape[:-2]
    wide = std[:, None].expand_as(shift).reshape(data.shape[:-1])
    return Estimate(
        value={"shift_cells": shift.reshape(data.shape[:-1])},
        std={"shift_cells": wide},
        quality=quality.reshape(shape),
        ok=(learnable & (std < GOOD_CELLS)).reshape(shape),
        info={"present": present.reshape(data.shape[:-1])},
    )


def _judged(lines: Tensor, find: Callable[[Envelopes], Course]) -> tuple[Tensor, Tensor]:
    """Shifts (trial, pulse) and their deviation (trial,) in cells: what the halves disagree by, or what the method says itself where that is more."""
    envelopes, n = Envelopes.of(lines), lines.shape[-1]
    shift, deviation = find(envelopes)
    if n < 4:
        return shift, shift.new_full(shift.shape[:1], n / math.sqrt(12))
    lower, upper = (find(Envelopes.of(half))[0] * (n / half.shape[-1]) for half in _band_halves(lines))
    off = _about_circular_mean(lower - upper, envelopes.present, n)
    disagreement = (off.square().sum(-1) / envelopes.present.sum(-1).clamp_min(1)).sqrt() / 2
    return shift, disagreement if deviation is None else torch.maximum(disagreement, deviation)


def _band_halves(lines: Tensor) -> list[Tensor]:
    """Pulses compressed from the two halves of the band alone, each about its own middle, (trial, pulse, n // 2), cells twice as wide."""
    half = lines.shape[-1] // 2
    spectrum = torch.fft.fftshift(torch.fft.fft(lines), dim=-1)
    return [torch.fft.ifft(torch.fft.ifftshift(part, dim=-1)) for part in (spectrum[..., :half], spectrum[..., -half:])]


def _about_circular_mean(shift: Tensor, present: Tensor, n: int) -> Tensor:
    """Shifts (trial, pulse) less their mean on the circle of n cells, in -n/2..n/2; zero where not present."""
    turn = torch.where(present, torch.polar(torch.ones_like(shift), 2 * math.pi / n * shift), 0)
    return torch.where(present, _wrapped(shift - torch.angle(turn.sum(-1, keepdim=True)) * (n / (2 * math.pi)), n), 0)


def _centred(shift: Tensor, present: Tensor) -> Tensor:
    """Shifts (trial, pulse) less their mean over the pulses that are there."""
    return shift - (shift * present).sum(-1, keepdim=True) / present.sum(-1, keepdim=True).clamp_min(1)


def _wrapped(cells: Tensor, n: int) -> Tensor:
    """Modulo the window, in -n/2..n/2."""
    return cells - n * torch.round(cells / n)


def _unit_time(n: int, device: torch.device) -> Tensor:
    """Pulses on -1..1."""
    return (2 * torch.arange(n, dtype=torch.float64, device=device) - (n - 1)) / max(1, n - 1)


def _runs(n: int, blocks: int, present: Tensor) -> Tensor:
    """Which pulses that are there belong to which of at most `blocks` runs of equal length, (trial, run, pulse) of 0 and 1, float64."""
    length = -(-n // blocks)
    run = torch.arange(n, device=present.device) // length
    member = run == torch.arange(-(-n // length), device=present.device)[:, None]
    return (member & present[:, None]).to(torch.float64)


class AlignEnvelopes(Stage):
    """`align_envelopes`, with shift_m (..., pulse) towards greater range, to be removed by `ShiftRange`, and the range rate velocity_m_s (...,).

    velocity_m_s: that of the residual drift (receding positive), added to the one that the pulses were compressed with where such a value is connected: what
    `focus.CompressDechirped` should be given. Drift is known modulo a window per pulse, and an acceleration a adds a f0 / gamma to it where dechirped pulses couple
    range to Doppler (0.13 s in brief 002).
    """

    provides = ("shift_m", "velocity_m_s")

    def __init__(self, degree: int | None = 2, tones: int = 0, passes: int = 6, blocks: int = 16) -> None:
        super().__init__()
        self.degree, self.tones, self.passes, self.blocks = degree, tones, passes, blocks

    def forward(self, signal: Signal, velocity_m_s: Tensor | None = None) -> Estimate:
        found = align_envelopes(signal.data, degree=self.degree, tones=self.tones, passes=self.passes, blocks=self.blocks)
        cell_m, per_s = signal.axis("range").step, 1 / signal.axis("pulse").step
        velocity = drift_cells(found["shift_cells"]) * (cell_m * per_s)
        value = {"shift_m": found["shift_cells"] * cell_m, "velocity_m_s": velocity if velocity_m_s is None else velocity + velocity_m_s}
        return Estimate(value, found.quality, found.ok, {"shift_m": found.std["shift_cells"] * cell_m}, found.info)


class ShiftRange(Stage):
    """Moves every pulse back by shift_m (..., pulse), a value of `AlignEnvelopes`: see `shift_range`. Differentiable in both."""

    def forward(self, signal: Signal, shift_m: Tensor) -> Signal:
        return signal.with_data(shift_range(signal.data, -shift_m / signal.axis("range").step))
