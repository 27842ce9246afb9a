"""Phases that make lines in Doppler of few points, by maximum likelihood.

Each point that stays is a line in Doppler with a free amplitude in every range cell. Where a few
lines and one phase per pulse explain the pulses down to the noise, the scene is known to stay, and
the phases are as exact as noise permits. Sharpness alone is not: at 25 dB the phases of two to four
points that sharpen the image were up to eight times as wrong.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.data import noise_power, or_one, rotate, safe_angle
from torchsar.core import cis, host_value, true_positions

# Effective number of range cells over which the energy is spread, below which few points may
# explain the pulses. With more, noise is as strong as they are, or they are many.
FEW_ROWS = 16
# fewest pulses: with fewer, lines explain what is no point
_LEAST_PULSES = 32
# largest number of lines, and of the strongest range cells that count
_MOST_LINES, _CELLS = 6, 32
# No more lines are tried if those that are left would have to explain more than so many times what
# the last one did.
_SLACK = 1.5
# A range cell counts if its energy exceeds that of noise by so many deviations.
_SEEN = 5.0
# Largest power of what lines do not explain in powers of the noise, whose level errs by a few
# percent.
_EXPLAINED = 1.15
# Lines of one range that are closer than this in Doppler cells describe a scatterer that changes as
# well as two that stay. Two lines have one range if their amplitudes over range correlate by this.
_CLOSE, _ONE_RANGE = 3.0, 0.5
# Largest deviation in rad, due to noise, of the phases that the points tell beside those of one
# range: energy of a second range, from the eigenvalues of the covariance over range.
_SECOND_RANGE_RAD = 0.25
# Rounds of phases, amplitudes and Dopplers for each number of lines. They end early where both move
# the phases by less than this share of what noise does. One line alone need not be exact.
_ROUNDS, _FIRST_ROUNDS, _SETTLED = 10, 3, 0.1
_FINER = 4  # samples of the spectrum per Doppler cell, in which the strongest line is found
_LARGEST_TURN = 0.25  # change of a Doppler in one round in cells
_RIDGE = 1e-6  # of the energy of a line, so that equal lines have an inverse


@dataclass(frozen=True)
class Points:
    """Phases that few points explain.

    Args:
        phase_rad: Phase of each pulse in rad, shape (trial, pulse).
        std_rad: Its standard deviation due to noise in rad, shape (trial,), infinite where points
            do not explain the pulses.
        noise: Variance of the noise of a sample, shape (trial,), float64; 0 where not examined.
        explained: True where points at two ranges or more explain the pulses down to the noise,
            shape (trial,), bool.
        examined: False if no trial was examined.
    """

    phase_rad: Tensor
    std_rad: Tensor
    noise: Tensor
    explained: Tensor
    examined: bool


def phases_of_points(
    rows: Tensor, present: Tensor, phase_rad: Tensor, which: Tensor, count: int | None = None
) -> Points:
    """Explain pulses by one phase per pulse and few lines in Doppler.

    Lines are added one by one, each at the maximum of the spectrum of what is not explained, until
    the rest is noise. With each number of lines, the amplitudes, the Dopplers and the phases are
    fitted in turn, by least squares. Trials are not explained if they need more than six lines; if
    nearly all energy has one range, because phases can be found that make one point of it, and a
    single point tells no change of its own phase from a phase error; or if two lines of the same
    range are closer than three Doppler cells, because they may be a scatterer that changes.
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
    phase, explained = phase_rad, torch.zeros_like(which)
    noise = torch.zeros_like(which, dtype=torch.float64)
    std = torch.full_like(noise, torch.inf)
    count = host_value(which.sum(), len(which)) if count is None else count
    if not count:
        return Points(phase, std, noise, explained, False)
    at = true_positions(which, count)
    noise = noise.index_copy(0, at, noise_power(rows[at], present[at], phase[at]))
    fit = _Fit.begin(rows[at], present[at], phase[at], noise[at])
    unexplained, before = which & (noise > 0) & (present.sum(-1) >= _LEAST_PULSES), fit.rest()
    for lines in range(1, _MOST_LINES + 1):
        fit = fit.with_another_line()
        rest = fit.rest()
        found = (rest < _EXPLAINED) & unexplained[at]
        good = found & fit.tells()
        phase = phase.index_copy(0, at, torch.where(good[:, None], phase[at] + fit.change, phase[at]))
        std = std.index_copy(0, at, torch.where(good, fit.std_rad(), std[at]))
        explained = explained.index_copy(0, at, explained[at] | good)
        hopeful = rest - _SLACK * (_MOST_LINES - lines) * (before - rest) < _EXPLAINED
        unexplained = unexplained.index_copy(0, at, unexplained[at] & ~found & hopeful)
        left = host_value(unexplained[at].sum(), len(at))
        if not left:
            break
        some = true_positions(unexplained[at], left)
        at, fit, before = at[some], fit.of(some), rest[some]
    return Points(phase, std, noise, explained, True)


@dataclass(frozen=True)
class _Fit:
    """Lines, amplitudes and phases of some trials.

    Args:
        rows: The range cells that count, with the phases to start from removed, and zeros, shape
            (trial, cell, pulse), complex.
        cells: Number of those that count, shape (trial,).
        present: False where a pulse holds only zeros, shape (trial, pulse).
        noise: Variance of the noise of a sample, shape (trial,).
        change: Change of the phases in rad, shape (trial, pulse).
        lines: Dopplers in rad per pulse, shape (trial, line).
        amplitudes: Complex amplitudes, shape (trial, line, cell).
        model: What lines explain of the rows without the change of the phases, their shape.
    """

    rows: Tensor
    cells: Tensor
    present: Tensor
    noise: Tensor
    change: Tensor
    lines: Tensor
    amplitudes: Tensor
    model: Tensor

    @staticmethod
    def begin(rows: Tensor, present: Tensor, phase: Tensor, noise: Tensor) -> _Fit:
        """Return the fit without a line."""
        pulses = present.sum(-1)
        energy = rows.real.square() + rows.imag.square()
        power, strongest = energy.sum(-1).sort(-1, descending=True)
        power, strongest = power[:, :_CELLS], strongest[:, :_CELLS]
        seen = power > (noise * (pulses + _SEEN * pulses.sqrt()))[:, None]
        cells = seen.sum(-1)
        most = max(1, host_value(cells.max(), strongest.shape[-1]))
        inside, strongest = seen[:, :most, None], strongest[:, :most]
        some = rotate(rows.gather(1, strongest[..., None].expand(-1, -1, rows.shape[-1])), phase) * inside
        none = rows.new_zeros(len(rows), 0, most)
        return _Fit(some, cells, present, noise, 0 * phase, 0 * phase[:, :0], none, torch.zeros_like(some))

    def of(self, trials: Tensor) -> _Fit:
        """Return the fit of some of the trials, given by their positions."""
        return _Fit(*(getattr(self, name)[trials] for name in self.__dataclass_fields__))

    def with_another_line(self) -> _Fit:
        """Add a line where the spectrum of the rest is largest, and fit all lines and phases."""
        n = self.rows.shape[-1]
        rest = torch.fft.fft(rotate(self.rows, self.change) - self.model, _FINER * n)
        power = (rest.real.square() + rest.imag.square()).sum(-2)
        top = power.argmax(-1, keepdim=True)
        below, peak, above = (power.gather(-1, (top + k) % (_FINER * n))[:, 0] for k in (-1, 0, 1))
        bend = below + above - 2 * peak
        place = top[:, 0] + torch.where(bend < 0, (below - above) / (2 * torch.where(bend < 0, bend, -1)), 0)
        line = 2 * math.pi / (_FINER * n) * place.to(self.change.dtype)
        change, lines = self.change, torch.cat([self.lines, line[:, None]], -1)
        pulses, settled = self.present.sum(-1), _SETTLED * self.std_rad()
        pulse = torch.arange(n, dtype=change.dtype, device=change.device)
        pulse = (pulse - (pulse * self.present).sum(-1, keepdim=True) / pulses[:, None]) * self.present
        ridge = _RIDGE * pulses[:, None, None] * torch.eye(lines.shape[-1], dtype=change.dtype, device=change.device)
        every = 1 if change.device.type == "cpu" else _ROUNDS
        amplitudes, model = self.rows.new_zeros(*lines.shape, self.rows.shape[-2]), self.model
        active = torch.ones_like(lines[:, :1], dtype=torch.bool)
        rounds = _ROUNDS if lines.shape[-1] > 1 else _FIRST_ROUNDS
        for number in range(1, rounds + 1):
            rows = rotate(self.rows, change)
            waves = cis(lines[..., None] * pulse[:, None]) * self.present[:, None]
            matrix = waves.conj() @ waves.mT + ridge
            # the ridge makes the matrix regular, so that no check must wait for the device
            solved = torch.linalg.solve_ex(matrix, waves.conj() @ rows.mT)[0]
            amplitudes = torch.where(active[..., None], solved, amplitudes)
            model = torch.where(active[..., None], (waves.mT @ amplitudes).mT, model)
            step = safe_angle((model.conj() * rows).sum(-2))
            turn = _turns(waves, 1j * pulse[:, None] * waves, matrix, amplitudes, rotate(rows, step) - model)
            change, lines = change + active * step, lines + active * turn
            moved = (step.detach().square().sum(-1, keepdim=True) / or_one(pulses)[:, None]).sqrt()
            active = active & (moved > settled[:, None])
            if number % every == 0 and number < rounds and not host_value(active.sum(), 1):
                break
        return _Fit(self.rows, self.cells, self.present, self.noise, change, lines, amplitudes, model)

    def rest(self) -> Tensor:
        """Power of what is not explained in powers of the noise, (trial,): 1 if it is all noise."""
        rest = rotate(self.rows, self.change) - self.model
        pulses, lines = self.present.sum(-1), self.lines.shape[-1]
        free = self.cells * (pulses - lines) - pulses / 2
        return (rest.real.square() + rest.imag.square()).sum((-2, -1)) / or_one(self.noise * free)

    def tells(self) -> Tensor:
        """Whether the lines are points that tell the phases, a bool per trial."""
        products = self.amplitudes @ self.amplitudes.mH
        power = products.diagonal(dim1=-2, dim2=-1).real
        alike = (products.real.square() + products.imag.square()) / or_one(power[:, None] * power[..., None])
        turns = (self.lines[:, None] - self.lines[..., None]) / (2 * math.pi)
        apart = (turns - turns.round()).abs() * self.rows.shape[-1]
        close = ((apart < _CLOSE) & (alike > _ONE_RANGE)).sum((-2, -1)) > self.lines.shape[-1]
        # elementary symmetric polynomials of the eigenvalues: their sum, and that of their products
        total = power.sum(-1)
        pairs = (total.square() - (products.real.square() + products.imag.square()).sum((-2, -1))) / 2
        return ~close & (2 * _SECOND_RANGE_RAD**2 * pairs > total * self.noise)

    def std_rad(self) -> Tensor:
        """Standard deviation of the phases due to noise in rad, (trial,)."""
        pulses = self.present.sum(-1)
        energy = (self.rows.real.square() + self.rows.imag.square()).sum((-2, -1))
        scene = (energy - self.cells * pulses * self.noise).detach()
        return torch.where(scene > 0, (pulses * self.noise / or_one(2 * scene)).sqrt(), torch.inf)


def _turns(waves: Tensor, slopes: Tensor, matrix: Tensor, amplitudes: Tensor, rest: Tensor) -> Tensor:
    """Changes of the Dopplers in rad per pulse, (trial, line), that explain most of the rest.

    A Gauss-Newton step: the slopes of the waves by their Dopplers, (trial, line, pulse) as these,
    count without what the amplitudes can explain. matrix: products of the waves.
    """
    mixed = waves.conj() @ slopes.mT
    free = slopes.conj() @ slopes.mT - mixed.mH @ torch.linalg.solve_ex(matrix, mixed)[0]
    curvature = (free * (amplitudes @ amplitudes.mH).conj()).real
    size = or_one(curvature.diagonal(dim1=-2, dim2=-1).sum(-1))[:, None, None]
    ridge = _RIDGE * size * torch.eye(curvature.shape[-1], dtype=size.dtype, device=size.device)
    right = (amplitudes.conj() * (slopes.conj() @ rest.mT)).real.sum(-1, keepdim=True)
    turns = torch.linalg.solve_ex(curvature + ridge, right)[0][..., 0]
    largest = _LARGEST_TURN * 2 * math.pi / waves.shape[-1]
    return turns.clamp(-largest, largest)
