"""Phases that make lines in Doppler of few points, by maximum likelihood.

Each point that stays is a line in Doppler with a free amplitude in every range cell. Where a few
lines and one phase per pulse explain the pulses down to the noise, the scene is known to stay, and
the phases are as exact as noise permits. Sharpness alone is not: at 25 dB the phases of two to four
points that sharpen the image were up to eight times as wrong.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.data import noise_power, or_one, rotate, safe_angle
from torchsar.core import cis, host_value, power_of, true_positions

# Effective number of range cells over which the energy is spread, below which few points may
# explain the pulses. With more, noise is as strong as they are, or they are many.
FEW_ROWS = 16
# fewest pulses: with fewer, lines explain what is no point
_LEAST_PULSES = 32
# Largest number of lines, of lines per pulse, and of the strongest range cells that count.
_MOST_LINES, _OF_PULSES, _CELLS = 16, 1 / 8, 32
# No more lines are tried if those that are left would have to explain more than so many times what
# the last one did.
_SLACK = 1.5
# A range cell counts if its energy exceeds that of noise by so many deviations.
_SEEN = 5.0
# Largest power of what lines do not explain in powers of the noise, whose level errs by a few
# percent.
_EXPLAINED = 1.15
# Least variance of the noise in mean powers: that of data without noise, which the rounds do not
# explain any better.
_LEAST_NOISE = 1e-8
# Lines of one range that are closer than this in Doppler cells describe a scatterer that changes as
# well as two that stay. Two lines have one range if their amplitudes over range correlate by this.
_CLOSE, _ONE_RANGE = 3.0, 0.5
# Largest deviation in rad, due to noise, of the phases that the points tell beside those of one
# range: energy of a second range, from the eigenvalues of the covariance over range. It is smaller
# where some lines may be a scatterer that changes.
_SECOND_RANGE_RAD, _IN_DOUBT_RAD = 0.25, 0.1
# The phases stay where they start until lines explain all but this share of the energy without
# noise: phases that make a line of one point out of ten hide the others.
_HELD = 0.25
# Rounds of amplitudes and Dopplers for each number of lines: those with held phases, and all if the
# phases become free. They end earlier where a round moves the phases by less than `_SETTLED` of
# what noise does. The bend is adapted every third round.
_HELD_ROUNDS, _ROUNDS, _SETTLED, _BEND_EVERY = 3, 20, 0.1, 3
# Largest bend in rad per range cell. The bend is pi / 8 times a wavelength over a cell, if cells
# are squares. With cells of 100 wavelengths, the points of a target of 80 cells migrate by a
# fifth of a cell, and are no lines any more.
_LARGEST_BEND = 0.004
_FINER = 4  # samples of the spectrum per Doppler cell, in which the strongest line is found
_LARGEST_TURN = 0.25  # change of a Doppler in one round in cells
_RIDGE = 1e-6  # of the energy of a line, so that equal lines have an inverse
# Lines after which trials that are explained are left out on a device. Before, they are fitted on,
# but their phases are not changed any more.
_READ_EVERY = 4


@dataclass(frozen=True)
class Points:
    """Phases that few points explain.

    Args:
        phase_rad: Phase of each pulse in rad, shape (trial, pulse).
        std_rad: Its standard deviation due to noise in rad, shape (trial,), infinite where points
            do not explain the pulses.
        noise: Variance of the noise of a sample, shape (trial,), float64, at least 1e-8 of the mean
            power; 0 where not examined.
        explained: True where points at two ranges or more explain the pulses down to the noise,
            shape (trial,), bool.
        enough: True where points do so that may have one range, shape (trial,), bool.
        examined: False if no trial was examined.
    """

    phase_rad: Tensor
    std_rad: Tensor
    noise: Tensor
    explained: Tensor
    enough: Tensor
    examined: bool


def phases_of_points(
    rows: Tensor, present: Tensor, phase_rad: Tensor, which: Tensor, count: int | None = None
) -> Points:
    """Explain pulses by one phase per pulse and few lines in Doppler.

    Lines are added one by one, each at the maximum of the spectrum of what is not explained, until
    the rest is noise. With each number of lines, the amplitudes and the Dopplers are fitted in
    turn, by least squares; and also the phases, as soon as lines explain most of the energy. A
    target that turns bends the phases of its ranges against each other, by a square over the pulses
    that grows with range; this bend is fitted too. The phases are those at the range where the
    energy has its centre.

    Trials are not explained if they need more than sixteen lines or one per eight pulses, or if the
    lines do not tell the phases because nearly all energy has one range: phases can be found that
    make one point of it, and a single point tells no change of its own phase from a phase error.
    Lines of one range that are closer than three Doppler cells do not count there, because they may
    be a scatterer that changes; then the others must tell the phases as exactly as promised.
    Differentiable.

    Args:
        rows: Pulses, shape (trial, range, pulse), complex.
        present: False where a pulse holds only zeros, shape (trial, pulse).
        phase_rad: Phase to start from in rad, shape (trial, pulse).
        which: True for the trials that are examined, shape (trial,).
        count: Their number, if it is known; otherwise the device is waited for.

    Returns:
        The phases, which are those to start from where points do not explain the pulses.
    """
    phase, explained, enough = phase_rad, torch.zeros_like(which), torch.zeros_like(which)
    noise = torch.zeros_like(which, dtype=torch.float64)
    std = torch.full_like(noise, torch.inf)
    count = host_value(which.sum(), len(which)) if count is None else count
    if not count:
        return Points(phase, std, noise, explained, enough, False)
    at = true_positions(which, count)
    least = _LEAST_NOISE * power_of(rows[at].detach()).mean((-2, -1), dtype=torch.float64)
    noise = noise.index_copy(0, at, torch.maximum(noise_power(rows[at], present[at], phase[at]), least))
    fit = _Fit.begin(rows[at], present[at], phase[at], noise[at])
    unexplained = which & (noise > 0) & (present.sum(-1) >= _LEAST_PULSES)
    unexplained, before = unexplained.index_copy(0, at, unexplained[at] & (fit.cells > 0)), fit.rest()
    every = 1 if rows.device.type == "cpu" else _READ_EVERY
    for lines in range(1, _MOST_LINES + 1):
        fit = fit.with_another_line()
        rest = fit.rest()
        found = (rest < _EXPLAINED) & fit.free & unexplained[at]
        second, doubt = fit.of_second_range()
        good = found & (second < torch.where(doubt, _IN_DOUBT_RAD, _SECOND_RANGE_RAD))
        deviation = torch.where(doubt, torch.maximum(fit.std_rad(), second), fit.std_rad())
        phase = phase.index_copy(0, at, torch.where(good[:, None], phase_rad[at] + fit.change, phase[at]))
        std = std.index_copy(0, at, torch.where(good, deviation, std[at]))
        explained = explained.index_copy(0, at, explained[at] | good)
        enough = enough.index_copy(0, at, enough[at] | found)
        more = ((_OF_PULSES * present[at].sum(-1)).floor() - lines).clamp_max(_MOST_LINES - lines)
        hopeful = (more > 0) & (rest - _SLACK * more * (before - rest) < fit.rest_of_held())
        unexplained = unexplained.index_copy(0, at, unexplained[at] & ~found & hopeful)
        before = rest
        if lines % every:
            continue
        left = host_value(unexplained[at].sum(), len(at))
        if not left:
            break
        some = true_positions(unexplained[at], left)
        at, fit, before = at[some], fit.of(some), rest[some]
    return Points(phase, std, noise, explained, enough, True)


@dataclass(frozen=True)
class _Fit:
    """Lines, amplitudes and phases of some trials.

    Args:
        rows: The range cells that count, with the phases to start from removed, and zeros, shape
            (trial, cell, pulse), complex.
        cells: Number of those that count, shape (trial,).
        present: False where a pulse holds only zeros, shape (trial, pulse).
        noise: Variance of the noise of a sample, shape (trial,).
        curve: Phase in rad of each sample for a bend of 1, shape (trial, cell, pulse).
        bend: Phase in rad that a range cell has beyond its nearer neighbour at the first and the
            last pulse, less that in the middle, shape (trial,).
        free: True where the phases are fitted, shape (trial,), bool.
        change: Change of the phases in rad, shape (trial, pulse).
        lines: Dopplers in rad per pulse, shape (trial, line).
        amplitudes: Complex amplitudes, shape (trial, line, cell).
        model: What lines explain of the rows without the change of the phases and the bend, the
            shape of the rows.
        left: What they do not explain.
    """

    rows: Tensor
    cells: Tensor
    present: Tensor
    noise: Tensor
    curve: Tensor
    bend: Tensor
    free: Tensor
    change: Tensor
    lines: Tensor
    amplitudes: Tensor
    model: Tensor
    left: Tensor

    @staticmethod
    def begin(rows: Tensor, present: Tensor, phase: Tensor, noise: Tensor) -> _Fit:
        """Return the fit without a line."""
        pulses = present.sum(-1)
        power, strongest = power_of(rows).sum(-1).detach().sort(-1, descending=True)
        power, strongest = power[:, :_CELLS], strongest[:, :_CELLS]
        seen = power > (noise * (pulses + _SEEN * pulses.sqrt()))[:, None]
        cells = seen.sum(-1)
        most = max(1, host_value(cells.max(), strongest.shape[-1]))
        inside, strongest, power = seen[:, :most], strongest[:, :most], (power * seen)[:, :most]
        some = rotate(rows.gather(1, strongest[..., None].expand(-1, -1, rows.shape[-1])), phase) * inside[..., None]
        centre = (power * strongest).sum(-1, keepdim=True) / or_one(power.sum(-1, keepdim=True))
        square = (2 / rows.shape[-1] * _numbers(present, phase.dtype)).square()
        square = square - (square * present).sum(-1, keepdim=True) / or_one(pulses)[:, None]
        curve = ((strongest - centre) * inside).to(phase.dtype)[..., None] * square[:, None]
        lines, amplitudes = 0 * phase[:, :0], rows.new_zeros(len(rows), 0, most)
        none, zero = torch.zeros_like(some), 0 * phase
        return _Fit(
            some, cells, present, noise, curve, zero[:, 0], cells < 0, zero, lines, amplitudes, model=none, left=some
        )

    def of(self, trials: Tensor) -> _Fit:
        """Return the fit of some of the trials, given by their positions."""
        return _Fit(*(getattr(self, name)[trials] for name in self.__dataclass_fields__))

    def with_another_line(self) -> _Fit:
        """Add a line where the spectrum of the rest is largest, and fit all lines and phases."""
        change, bend, free, model = self.change, self.bend, self.free, self.model
        lines = torch.cat([self.lines, self._strongest()[:, None]], -1)
        pulses, settled = self.present.sum(-1), _SETTLED * self.std_rad()
        pulse = _numbers(self.present, change.dtype)
        ridge = _RIDGE * pulses[:, None, None] * torch.eye(lines.shape[-1], dtype=change.dtype, device=change.device)
        every = 1 if change.device.type == "cpu" else _ROUNDS
        amplitudes = self.rows.new_zeros(*lines.shape, self.rows.shape[-2])
        active = torch.ones_like(free)
        straight = self.rows
        for number in range(1, _ROUNDS + 1):
            if number % _BEND_EVERY == 1:
                straight = self._straight(bend)
            rows = rotate(straight, change)
            waves = cis(lines[..., None] * pulse[:, None]) * self.present[:, None]
            matrix = waves.conj() @ waves.mT + ridge
            # the ridge makes the matrix regular, so that no check must wait for the device
            solved = torch.linalg.solve_ex(matrix, waves.conj() @ rows.mT)[0]
            amplitudes = torch.where(active[:, None, None], solved, amplitudes)
            model = torch.where(active[:, None, None], (waves.mT @ amplitudes).mT, model)
            if number == _HELD_ROUNDS:
                unknown = power_of(rows - model).sum((-2, -1)) - self.noise * self._degrees(lines.shape[-1])
                free = free | (unknown < _HELD * self._energy())
                active = active & free
            step = safe_angle((model.conj() * rows).sum(-2)) * (active & free)[:, None]
            left = rotate(rows, step) - model
            turn = _turns(waves, 1j * pulse[:, None] * waves, matrix, amplitudes, left)
            change, lines = change + step, lines + active[:, None] * turn
            if number % _BEND_EVERY == 0:
                bent = self.curve * model
                more = (bent.conj() * left).imag.sum((-2, -1)) / or_one(power_of(bent).sum((-2, -1)))
                bend = (bend + active * more).clamp(-_LARGEST_BEND, _LARGEST_BEND)
            if number > _HELD_ROUNDS:
                active = active & (step.detach().square().sum(-1) > settled.square() * pulses)
            if number >= _HELD_ROUNDS and number % every == 0 and not host_value(active.sum(), 1):
                break
        left = rotate(self._straight(bend), change) - model
        return replace(
            self, bend=bend, free=free, change=change, lines=lines, amplitudes=amplitudes, model=model, left=left
        )

    def _straight(self, bend: Tensor) -> Tensor:
        """Return the rows without a bend."""
        return self.rows * cis(-bend[:, None, None] * self.curve)

    def _strongest(self) -> Tensor:
        """Doppler of the strongest line of what is not explained in rad per pulse, (trial,)."""
        n = _FINER * self.rows.shape[-1]
        power = power_of(torch.fft.fft(self.left, n)).sum(-2)
        top = power.argmax(-1, keepdim=True)
        below, peak, above = (power.gather(-1, (top + k) % n)[:, 0] for k in (-1, 0, 1))
        fall = 2 * peak - below - above
        place = top[:, 0] + torch.where(fall > 0, (above - below) / (2 * torch.where(fall > 0, fall, 1)), 0)
        return 2 * math.pi / n * place.to(self.change.dtype)

    def _energy(self) -> Tensor:
        """Energy of the scatterers without that of the noise, (trial,)."""
        return (power_of(self.rows).sum((-2, -1)) - self.cells * self.present.sum(-1) * self.noise).detach()

    def _degrees(self, lines: int) -> Tensor:
        """Complex degrees of freedom that lines leave to the noise, (trial,)."""
        return self.cells * (self.present.sum(-1) - lines)

    def rest(self) -> Tensor:
        """Power of what is not explained in powers of the noise, (trial,): 1 if it is all noise."""
        # a phase or a Doppler is half a complex parameter
        degrees = self._degrees(self.lines.shape[-1]) - (self.present.sum(-1) + self.lines.shape[-1]) / 2
        return power_of(self.left).sum((-2, -1)) / or_one(self.noise * degrees)

    def rest_of_held(self) -> Tensor:
        """Rest below which the phases become free, or the pulses are explained, (trial,)."""
        known = self.noise * self._degrees(self.lines.shape[-1])
        return (1 + torch.where(self.free, 0, _HELD * self._energy() / or_one(known))).clamp_min(_EXPLAINED)

    def of_second_range(self) -> tuple[Tensor, Tensor]:
        """Deviation in rad of the phases that the points tell beside those of one range, (trial,).

        Also a bool per trial, True if lines of one range are close and do not count, because they
        may be a scatterer that changes.
        """
        amplitudes = self.amplitudes.to(torch.complex128)
        products = amplitudes @ amplitudes.mH
        power, squares = products.diagonal(dim1=-2, dim2=-1).real, power_of(products)
        turns = (self.lines[:, None] - self.lines[..., None]) / (2 * math.pi)
        near = (turns - turns.round()).abs() * self.rows.shape[-1] < _CLOSE
        near = near & (squares > _ONE_RANGE * power[:, None] * power[..., None])
        clear = near.sum(-1) <= 1
        # elementary symmetric polynomials of the eigenvalues: their sum, and that of their products
        total = (power * clear).sum(-1)
        pairs = total.square() - (squares * (clear[:, None] & clear[..., None])).sum((-2, -1))
        known = pairs > 10 * torch.finfo(self.rows.dtype).eps * total.square()
        std = torch.where(known, (total * self.noise / or_one(pairs.clamp_min(0))).sqrt(), torch.inf)
        return std.detach(), ~clear.all(-1)

    def std_rad(self) -> Tensor:
        """Standard deviation of the phases due to noise in rad, rms over the pulses, (trial,).

        Pulses in which the points cancel each other make it large; theirs is that of any phase.
        """
        scene = power_of(self.model if self.lines.shape[-1] else self.rows).detach().sum(-2)
        variance = 1 / (2 * scene / or_one(self.noise)[:, None] + 3 / math.pi**2)
        return ((variance * self.present).sum(-1) / or_one(self.present.sum(-1))).sqrt()


def _numbers(present: Tensor, dtype: torch.dtype) -> Tensor:
    """Number of each pulse less their mean, 0 where there is none, (trial, pulse)."""
    pulse = torch.arange(present.shape[-1], dtype=dtype, device=present.device)
    mean = (pulse * present).sum(-1, keepdim=True) / or_one(present.sum(-1, keepdim=True))
    return (pulse - mean) * present


def _turns(waves: Tensor, slopes: Tensor, matrix: Tensor, amplitudes: Tensor, left: Tensor) -> Tensor:
    """Changes of the Dopplers in rad per pulse, (trial, line), that explain most of what is left.

    A Gauss-Newton step: the slopes of the waves by their Dopplers, (trial, line, pulse) as these,
    count without what the amplitudes can explain. matrix: products of the waves.
    """
    mixed = waves.conj() @ slopes.mT
    free = slopes.conj() @ slopes.mT - mixed.mH @ torch.linalg.solve_ex(matrix, mixed)[0]
    curvature = (free * (amplitudes @ amplitudes.mH).conj()).real
    size = or_one(curvature.diagonal(dim1=-2, dim2=-1).sum(-1))[:, None, None]
    ridge = _RIDGE * size * torch.eye(curvature.shape[-1], dtype=size.dtype, device=size.device)
    right = (amplitudes.conj() * (slopes.conj() @ left.mT)).real.sum(-1, keepdim=True)
    turns = torch.linalg.solve_ex(curvature + ridge, right)[0][..., 0]
    largest = _LARGEST_TURN * 2 * math.pi / waves.shape[-1]
    return turns.clamp(-largest, largest)
