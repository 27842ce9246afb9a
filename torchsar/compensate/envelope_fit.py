"""Range shifts of pulse envelopes over slow time, found by the likelihood of speckle.

The shifts are found pulse by pulse, or as a straight line, a robust polynomial or a sum of
sinusoids of slow time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import host_value, legendre, linear_phasor, linear_solve, true_positions, unit_level, wrapped
from torchsar.optim.scalar import vertex

_HALF = 2  # samples per range cell, because |s|^2 has twice the band of s
_QUARTER = 4  # samples per range cell in correlations with -1 / T, which is not band-limited
# least power of a cell in the likelihood, over the mean power, so that empty cells do not dominate
_FLOOR = 1e-2
# Least power of a tone in a periodogram, in units of its mean power, minus the logarithm of the
# number of cells. It gives one false tone in 400 trials (exp(-6) = 1 / 403).
_STANDS_OUT = 6.0


@dataclass(frozen=True)
class Envelopes:
    """Power envelopes of pulses, stored as their one-sided spectra over range.

    Args:
        spectra: One-sided spectra (of `torch.fft.rfft`), shape (trial, pulse, frequency), complex;
            frequency i is i / n cycles per cell. Zero for pulses that are not present.
        present: False where a pulse holds only zeros, shape (trial, pulse), bool.
        n: Number of range cells.
    """

    spectra: Tensor
    present: Tensor
    n: int

    @property
    def count(self) -> Tensor:
        """Number of pulses that are present, shape (trial, 1, 1), at least 1."""
        return self.present.sum(-1)[:, None, None].clamp_min(1)

    @staticmethod
    def of(lines: Tensor) -> Envelopes:
        """Compute the power envelope |s|^2 of each pulse, divided by its mean over the pulse.

        The envelope has two samples per range cell, because |s|^2 has twice the bandwidth of s.

        Args:
            lines: Pulses, shape (trial, pulse, range), complex.

        Returns:
            The envelopes.
        """
        n = lines.shape[-1]
        # band-limited interpolation that keeps all n frequencies, from -(n // 2) on
        spectrum = torch.fft.fftshift(torch.fft.fft(unit_level(lines, 1)), dim=-1)
        before = _HALF * n // 2 - n // 2
        padded = torch.nn.functional.pad(spectrum, (before, (_HALF - 1) * n - before))
        power = (torch.fft.ifft(torch.fft.ifftshift(padded, dim=-1)) * _HALF).abs().square()
        mean = power.mean(-1, keepdim=True)
        return Envelopes(torch.fft.rfft(power / torch.where(mean > 0, mean, 1)), (lines != 0).any(-1), n)

    def moved(self, shift: Tensor) -> Tensor:
        """Remove range shifts from the envelopes.

        Args:
            shift: Shifts to remove in cells, shape (trial, pulse), positive towards greater range.

        Returns:
            One-sided spectra of the envelopes moved by -shift, shape (trial, pulse, frequency).
        """
        return self.spectra * linear_phasor(shift / self.n, 0, self.spectra.shape[-1], self.spectra.dtype)

    def amplitudes(self) -> Envelopes:
        """Compute the amplitude envelopes |s| from these power envelopes |s|^2.

        Returns:
            The envelopes |s|, with the same pulses and range cells.
        """
        return Envelopes(torch.fft.rfft(self.on_grid(self.spectra).clamp_min(0).sqrt()), self.present, self.n)

    def on_grid(self, spectra: Tensor, per_cell: int = _HALF) -> Tensor:
        """Compute samples of envelopes over range from their one-sided spectra.

        Args:
            spectra: One-sided spectra, shape (..., frequency).
            per_cell: Samples per range cell.

        Returns:
            The samples, shape (..., per_cell * n) for n range cells.
        """
        return torch.fft.irfft(spectra, per_cell * self.n) * (per_cell / _HALF)

    def likelihood(self, mean: Tensor, sidelobes: bool = True) -> Tensor:
        """Compute the spectrum of -1 / T within the band of the envelopes, for a mean envelope T.

        The correlation of -1 / T with the power envelope of a pulse is the log-likelihood of the
        shift of that pulse.

        Args:
            mean: One-sided spectrum of T, shape (..., frequency).
            sidelobes: Whether cells count that hold no more than sidelobes of all other cells,
                which repeat the speckle of those cells and are no evidence of their own.

        Returns:
            The one-sided spectrum of -1 / T, shape (..., frequency).
        """
        power = self.on_grid(mean, _QUARTER)
        if not sidelobes:
            samples = power.shape[-1]
            at = torch.arange(samples, dtype=power.dtype, device=power.device) * (self.n / samples)
            # upper limit of the power of a sinc pulse in a circular window
            limit = (samples / self.n) * (self.n * torch.sin(math.pi * at / self.n)).square()
            # sidelobes are considered beyond 1.5 cells and with 1.5 times this power, which suits 1
            # to 200 points
            far = torch.minimum(at, self.n - at) >= 1.5
            kernel = torch.where(far, 1.5 / torch.where(far, limit, 1), 0)
            level = torch.fft.irfft(torch.fft.rfft(power) * torch.fft.rfft(kernel), samples)
            power = torch.maximum(power, level)
        weight = -1 / power.clamp_min(_FLOOR)
        return torch.fft.rfft(weight)[..., : self.spectra.shape[-1]] * (_HALF / _QUARTER)

    def peak(self, spectra: Tensor, within: float = math.inf) -> Tensor:
        """Find the position of the maximum of a correlation, by a parabola through three samples.

        The samples are a quarter of a cell apart.

        Args:
            spectra: One-sided spectrum of the correlation, shape (..., frequency).
            within: Largest magnitude of the sample at the maximum, in cells.

        Returns:
            The position in cells, -n/2..n/2 for n range cells, shape (...,), float64.
        """
        # the mean does not affect the maximum, and without it rounding errors are smaller
        samples = self.on_grid(torch.cat([torch.zeros_like(spectra[..., :1]), spectra[..., 1:]], -1), _QUARTER)
        length = samples.shape[-1]
        outside = wrapped(torch.arange(length, device=samples.device) / _QUARTER, self.n).abs() > within
        at = samples.masked_fill(outside, -torch.inf).argmax(-1, keepdim=True)
        left, top, right = (samples.gather(-1, (at + step) % length).to(torch.float64) for step in (-1, 0, 1))
        part = vertex(left, top, right)
        position = (at + torch.where(torch.isfinite(part), part, 0)).squeeze(-1)
        return torch.where(position > length / 2, position - length, position) / _QUARTER


# shifts (trial, pulse), and their standard deviation (trial,), or None if the method does not
# predict it
Course = tuple[Tensor, Tensor | None]


def running_shifts(pulses: Envelopes, gain: float) -> Tensor:
    """Find the shift of each pulse against an exponentially running mean of the pulses before it.

    Shifts are unwrapped: they may leave the range window and continue from pulse to pulse.

    Args:
        pulses: Envelopes.
        gain: Weight of a new pulse in the mean, 0..1; the old mean has the weight 1 - gain.

    Returns:
        The shifts in cells, shape (trial, pulse), float64, of mean zero.
    """
    amplitude = pulses.amplitudes()
    mean, shifts = torch.zeros_like(amplitude.spectra[:, 0]), []
    shift = torch.zeros(len(mean), dtype=torch.float64, device=mean.device)
    for k in range(pulses.present.shape[-1]):
        there, pulse = pulses.present[:, k], amplitude.spectra[:, k]
        found = amplitude.peak(pulse * mean.conj())
        shift = torch.where(there, shift + wrapped(found - shift, pulses.n), shift)
        moved = pulse * linear_phasor(shift / pulses.n, 0, pulse.shape[-1], pulse.dtype)
        empty = (mean == 0).all(-1)
        mean = torch.where(there[:, None], torch.where(empty[:, None], moved, (1 - gain) * mean + gain * moved), mean)
        shifts.append(shift)
    return centred(torch.stack(shifts, -1), pulses.present)


def single_shifts(pulses: Envelopes, start: Tensor, match: str, iterations: int) -> Tensor:
    """Find the shift of each pulse separately against the mean envelope of all aligned pulses.

    Sidelobes help to distinguish the maxima of the likelihood, but they are correlated over many
    cells. Without them the error of a shift is smaller where noise is weak.

    Args:
        pulses: Envelopes.
        start: Shifts to start from, in cells, shape (trial, pulse).
        match: "likelihood" correlates the power |s|^2 of a pulse with -1 / T, where T is the mean
            power envelope; "amplitude" correlates |s| with the mean amplitude envelope. Both find
            shifts within half a window of those in `start`. "refined" is the likelihood of the
            cells that exceed the sidelobes, for shifts that are right within a cell.
        iterations: Number of times that the mean envelope is formed anew.

    Returns:
        The shifts in cells, shape (trial, pulse), float64, of mean zero.
    """
    used, refined = pulses.amplitudes() if match == "amplitude" else pulses, match == "refined"
    shift = start
    for _ in range(iterations):
        moved = used.moved(shift)
        mean = moved.sum(-2, keepdim=True) / used.count
        against = mean if match == "amplitude" else used.likelihood(mean, sidelobes=not refined)
        about, moved = (shift, moved) if refined else (start, used.moved(start))
        found = used.peak(moved * against.conj(), within=1.0 if refined else math.inf)
        shift = centred(about + torch.where(used.present, found, 0), used.present)
    return shift


def smooth_shifts(pulses: Envelopes, degree: int, passes: int, blocks: int) -> tuple[Tensor, Tensor]:
    """Fit a polynomial of slow time to the shifts of blocks of pulses.

    Each of several rounds estimates the shift of each block against the mean envelope of the other
    blocks and fits the polynomial to these shifts.

    Args:
        pulses: Envelopes.
        degree: Degree of the polynomial.
        passes: Number of rounds.
        blocks: Number of blocks of pulses, at least `degree` + 1 of which are used.

    Returns:
        The shifts in cells, shape (trial, pulse), float64, of mean zero; and their standard
        deviation in cells, from the scatter of the blocks about the polynomial, shape (trial,).
    """
    k = pulses.present.shape[-1]
    basis = legendre(unit_time(k, pulses.present.device), degree)
    # elements are 1 where a present pulse belongs to a block of equal length, (trial, block, pulse)
    length = -(-k // max(blocks, degree + 1))
    run, block = (torch.arange(n, device=basis.device) for n in (k, -(-k // length)))
    runs = ((run // length == block[:, None]) & pulses.present[:, None]).to(torch.float64)
    shift = mean_drift(pulses)[:, None] * (torch.arange(k, dtype=torch.float64, device=basis.device) - (k - 1) / 2)
    count, step, found = runs.sum(-1), torch.zeros_like(runs[:, :1, 0]), torch.zeros_like(runs[..., 0])
    middle = (runs @ basis) / count.clamp_min(1)[..., None]
    for _ in range(passes):
        sums = runs.to(pulses.spectra.dtype) @ pulses.moved(shift)
        # a block is compared with the other blocks only, because its own noise would keep its
        # present shift
        others = (sums.sum(-2, keepdim=True) - sums) / (count.sum(-1, keepdim=True) - count).clamp_min(1)[..., None]
        found = pulses.peak(sums * pulses.likelihood(others).conj())
        step = robust_fit(found, middle, count)
        shift = shift + (basis @ step[..., None]).squeeze(-1)
        shift = shift - shift.mean(-1, keepdim=True)
    residual = (found - (middle @ step[..., None]).squeeze(-1)).abs()
    return shift, robust_std(residual, count > 0).squeeze(-1) * ((degree + 1) / (count > 0).sum(-1).clamp_min(1)).sqrt()


def gate_jumps(pulses: Envelopes, smooth: Tensor) -> Tensor:
    """Find jumps of the range gate by whole cells, beside smooth shifts, from single pulses.

    The whole cells of the differences of single shifts from pulse to pulse add up to the jumps. The
    fractions of a cell are those of the smooth motion, which near pulses share.

    Args:
        pulses: Envelopes.
        smooth: Smooth shifts in cells, shape (trial, pulse).

    Returns:
        Jumps in whole cells, 0 for the first pulse, shape (trial, pulse), float64.
    """
    single = single_shifts(pulses, running_shifts(pulses, 0.1), "likelihood", 4)
    step = wrapped((single_shifts(pulses, single, "refined", 2) - smooth).diff(dim=-1), pulses.n)
    # of 33 pairs of pulses, which is few for any motion and many for the jitter of single shifts
    both = (pulses.present[:, 1:] & pulses.present[:, :-1])[:, None]
    phasor = torch.stack([torch.cos(2 * math.pi * step), torch.sin(2 * math.pi * step)], -2) * both
    near = torch.nn.functional.avg_pool1d(phasor, 33, 1, 16)
    common = torch.atan2(near[:, 1], near[:, 0]) / (2 * math.pi)
    return torch.nn.functional.pad(torch.round(step - common).cumsum(-1), (1, 0))


def likeliest_jumps(
    pulses: Envelopes, course: Tensor, jump: Tensor, rounds: int = 3, sure_cells: float = 0.01
) -> tuple[Tensor, Tensor]:
    """Find the likeliest jump of each pulse, given all pulses, and how uncertain it is.

    The gate stays where it is from one pulse to the next, or jumps to any cell with a probability
    that is found with the jumps. Each pulse is compared with the mean envelope of the others.

    Args:
        pulses: Envelopes.
        course: Shifts without jumps in cells, shape (trial, pulse).
        jump: Jumps in whole cells with which the mean envelope is formed, shape (trial, pulse).
        rounds: Number of times that the probability of a jump is found anew.
        sure_cells: Largest deviation by single pulses alone with which the given jumps are kept.

    Returns:
        The jumps in whole cells, 0 for the first pulse, shape (trial, pulse), float64; and the rms
        deviation in cells of the place of a pulse from the given jump, shape (trial,), float64.
    """
    n, used = pulses.n, pulses.moved(course + jump)
    best, cells = jump - jump[:, :1], wrapped(torch.arange(pulses.n, dtype=torch.float64, device=jump.device), pulses.n)

    def scores(moved: Tensor, mean: Tensor) -> Tensor:
        likely = pulses.on_grid(moved * pulses.likelihood(mean).conj())[..., ::_HALF] / _HALF
        return torch.where(pulses.present[..., None], (likely - likely.amax(-1, keepdim=True)).exp(), 0)

    def spread(weight: Tensor, square: Tensor) -> Tensor:
        each = (weight * square).sum(-1) / weight.sum(-1).clamp_min(1e-30)
        return (each.sum(-1) / pulses.count[:, 0, 0]).sqrt()

    # where single pulses are sure by themselves, the others need not be asked
    apart = spread(scores(used, used.sum(-2, keepdim=True) / pulses.count).to(cells.dtype), cells.square())
    unsure = apart > sure_cells
    at = true_positions(unsure, host_value(unsure.sum(), len(unsure)))
    if not len(at):
        return best, apart
    pulses, used, jump = Envelopes(pulses.spectra[at], pulses.present[at], n), used[at], jump[at]
    others = (used.sum(-2, keepdim=True) - used) / (pulses.count - 1).clamp_min(1)
    likely = scores(pulses.moved(course[at]), others)
    likely = torch.where(pulses.present[..., None], likely, 1)
    ways = torch.stack([likely, likely.flip(1)])  # forward and backward in slow time
    chance = (jump.diff() != 0).to(likely.dtype).mean(-1, keepdim=True).nan_to_num().clamp_min(0.1)
    for _ in range(rounds):
        state, known = torch.full_like(ways[:, :, 0], 1 / n), []
        for now in ways.unbind(2):
            state = (1 - chance) * state + chance / n
            known.append(state)
            state = state * now
            state = state / state.sum(-1, keepdim=True)
        before, after = torch.stack(known, 2)
        before, after = before * likely, after.flip(1)
        here = before * after
        early, late = before[:, :-1], (after * likely)[:, 1:]
        stays = (early * late).sum(-1) / (early.sum(-1) * late.sum(-1))
        jumps = (chance / n) / ((1 - chance) * stays + chance / n)
        chance = jumps.mean(-1, keepdim=True).clamp_min(1 / likely.shape[1])
    off, found = wrapped(cells - jump[..., None], n), cells[here.argmax(-1)]
    apart = apart.index_copy(
        0, at, spread(torch.where(pulses.present[..., None], here, 0).to(cells.dtype), off.square())
    )
    return best.index_copy(0, at, found - found[:, :1]), apart


def mean_drift(pulses: Envelopes) -> Tensor:
    """Find the mean drift of the envelopes: the straight line along which they add up best.

    Maximises sum_f |sum_k P_k(f) exp(2j pi f v k / n)|^2 over the drift v in cells per pulse. P_k
    is the spectrum of the power envelope of pulse k over the n range cells, and f runs over the 16
    lowest frequencies only. One zero-padded transform along pulses gives the sum for all v.

    Args:
        pulses: Envelopes.

    Returns:
        The drift in cells per pulse, modulo the window, shape (trial,), float64.
    """
    # Features finer than the 16 lowest frequencies agree only close to the true drift, coarser ones
    # measure it less well.
    k, last = pulses.present.shape[-1], min(16, pulses.n - 1)
    if last < 1:
        return torch.zeros(len(pulses.present), dtype=torch.float64, device=pulses.present.device)
    length = 2 * last * k
    power = torch.fft.ifft(pulses.spectra[..., 1 : last + 1].mT, length).abs().square()
    lines = torch.arange(length, device=power.device)
    total = torch.stack([power[:, f - 1, (f * lines) % length] for f in range(1, last + 1)]).sum(0)
    cycles = total.argmax(-1).to(torch.float64) / length
    return pulses.n * (cycles - torch.round(cycles))


def robust_fit(values: Tensor, basis: Tensor, weight: Tensor, iterations: int = 12) -> Tensor:
    """Fit a linear model by reweighted least squares that withstands outliers.

    Directions that the data do not determine have coefficients of zero. The first half of the
    iterations minimises absolute residuals, the second uses Tukey's biweight with the median
    absolute residual of each trial as its scale.

    Args:
        values: Values, shape (trial, m).
        basis: Basis, shape (trial, m, term).
        weight: Weights, shape (trial, m); zero excludes a value.
        iterations: Number of iterations.

    Returns:
        The coefficients, shape (trial, term).
    """
    now, coefficients = weight, torch.zeros_like(basis[:, 0])
    ridge = 1e-9 * torch.eye(basis.shape[-1], dtype=basis.dtype, device=basis.device)
    for iteration in range(iterations):
        share = now / now.sum(-1, keepdim=True).clamp_min(torch.finfo(now.dtype).tiny)
        across = basis.mT * share[:, None]
        coefficients = linear_solve(across @ basis + ridge, across @ values[..., None]).squeeze(-1)
        residual = (values - (basis @ coefficients[..., None]).squeeze(-1)).abs()
        if iteration < iterations // 2:
            now = weight / residual.clamp_min(0.1)
        else:
            # 1e-3 keeps the scale above zero when most residuals vanish. The usual factor of 4.685
            # of Tukey's biweight gives 95 % efficiency for normal errors.
            scale = 4.685 * (robust_std(residual, weight > 0) + 1e-3)
            now = weight * (1 - (residual / scale).square()).clamp_min(0).square()
    return coefficients


def robust_std(magnitude: Tensor, used: Tensor) -> Tensor:
    """Compute the standard deviation of normal errors from the median of their magnitudes.

    Args:
        magnitude: Magnitudes of the errors, shape (trial, m).
        used: Which of them count, shape (trial, m), bool.

    Returns:
        The standard deviation, shape (trial, 1).
    """
    return 1.4826 * torch.where(used, magnitude, torch.nan).nanmedian(-1, keepdim=True).values.nan_to_num()


def with_tones(pulses: Envelopes, smooth: Tensor, tones: int, degree: int) -> Tensor:
    """Add sinusoids (vibration) to a history of range shifts, one by one.

    The sinusoids are estimated from the shifts of single pulses. One is added only in trials where
    it clearly exceeds the jitter of these shifts.

    Args:
        pulses: Envelopes.
        smooth: Shift history in cells, shape (trial, pulse).
        tones: Largest number of sinusoids.
        degree: Degree of the polynomial that is fitted together with each sinusoid.

    Returns:
        The shift history in cells, shape (trial, pulse).
    """
    course, k, weight = smooth, smooth.shape[-1], pulses.present.to(torch.float64)
    time = torch.arange(k, dtype=torch.float64, device=course.device)
    terms = legendre(unit_time(k, course.device), degree).expand(len(course), -1, -1)

    def rest(course: Tensor) -> Tensor:
        return single_shifts(pulses, course, "likelihood", 1) - course

    for _ in range(tones):
        # the tone is fitted together with the polynomial
        frequency, stands_out = strongest_tone(rest(course), pulses.present)
        parts, base, now = torch.zeros_like(terms[:, 0, :1]).expand(-1, 2), course, course
        for _ in range(5):  # Gauss-Newton steps
            wave = _waves(frequency, time)
            turned = (parts[:, None, 1] * wave[..., 0] - parts[:, None, 0] * wave[..., 1]) * (
                2 * math.pi * (time - time.mean())
            )
            step = robust_fit(rest(now), torch.cat([terms, wave, turned[..., None]], -1), weight)
            frequency, parts = frequency + step[:, -1].clamp(-0.5 / k, 0.5 / k), parts + step[:, -3:-1]
            base = base + (terms @ step[:, :-3, None]).squeeze(-1)
            now = base + (_waves(frequency, time) @ parts[..., None]).squeeze(-1)
        gain = log_likelihood(pulses, now) - log_likelihood(pulses, course)
        # removing a tone of 0.05 cells adds as much error as it takes away
        kept = stands_out & (parts.square().sum(-1).sqrt() > 0.05) & (gain > math.log(k) + _STANDS_OUT)
        course = centred(torch.where(kept[:, None], now, course), torch.ones_like(pulses.present))
    return course


def _waves(frequency: Tensor, time: Tensor) -> Tensor:
    """Cosine and sine (trial, pulse, 2) of frequencies (trial,) in cycles per pulse."""
    angle = 2 * math.pi * frequency[:, None] * time
    return torch.stack([torch.cos(angle), torch.sin(angle)], -1)


def log_likelihood(pulses: Envelopes, course: Tensor) -> Tensor:
    """Compute the log-likelihood of a history of range shifts.

    It is -(number of pulses) * sum over cells of ln T, up to a constant, where T is the mean power
    envelope of the pulses with these shifts removed.

    Args:
        pulses: Envelopes.
        course: Shift history in cells, shape (trial, pulse).

    Returns:
        The log-likelihood, shape (trial,), float64.
    """
    mean = pulses.on_grid(pulses.moved(course).sum(-2, keepdim=True) / pulses.count).clamp_min(_FLOOR)
    return -(torch.log(mean).sum(-1, keepdim=True) * pulses.count / _HALF)[:, 0, 0].to(torch.float64)


def strongest_tone(rest: Tensor, present: Tensor) -> tuple[Tensor, Tensor]:
    """Find the frequency of the strongest sinusoid in residual shifts.

    Args:
        rest: Residual shifts in cells, shape (trial, pulse).
        present: False for pulses without samples, shape (trial, pulse), bool.

    Returns:
        The frequency in cycles per pulse, shape (trial,); and whether the sinusoid stands out from
        noise, shape (trial,), bool, which on pure noise is True in about one of 400 trials.
    """
    k = rest.shape[-1]
    limit = 3 * rest.abs().median(-1, keepdim=True).values
    power = torch.fft.rfft(torch.where(present, rest.clamp(-limit, limit), 0), 8 * k).abs().square()
    power[:, :8] = 0  # less than one period in the aperture is described by the polynomial
    top, at = power.max(-1)
    return at / (8 * k), top > (math.log(k) + _STANDS_OUT) * power.mean(-1)


def centred(shift: Tensor, present: Tensor) -> Tensor:
    """Subtract from shifts their mean over the pulses that are present.

    Args:
        shift: Shifts in cells, shape (trial, pulse).
        present: False for pulses without samples, shape (trial, pulse), bool.

    Returns:
        The shifts in cells, shape (trial, pulse).
    """
    return shift - (shift * present).sum(-1, keepdim=True) / present.sum(-1, keepdim=True).clamp_min(1)


def unit_time(n: int, device: torch.device) -> Tensor:
    """Compute evenly spaced times of n pulses, scaled to the interval -1..1.

    Args:
        n: Number of pulses.
        device: Device of the result.

    Returns:
        The times, shape (n,), float64.
    """
    return (2 * torch.arange(n, dtype=torch.float64, device=device) - (n - 1)) / max(1, n - 1)
