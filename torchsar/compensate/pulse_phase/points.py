"""Maximum likelihood phases of scenes of few points.

The echo of a point is a line in Doppler with a free amplitude in every range cell, as long as the
point does not move by itself. Where a few lines and one phase per pulse explain the pulses down to
the noise, no point moves, and the phases are as exact as noise permits. Phases that only sharpen
the image are not: at 25 dB those of two to four points were up to eight times as wrong.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.data import or_one, rotate, safe_angle
from torchsar.core import cis, host_value, power_of, true_positions


def phases_of_points(rows: Tensor, present: Tensor, phase_rad: Tensor) -> tuple[Tensor, Tensor]:
    """Explain pulses by one phase per pulse and few lines in Doppler.

    Lines are added one by one, each at the maximum of the spectrum of the residual, until the
    residual is noise. With each number of lines, the amplitudes and the Dopplers are fitted in
    turn, by least squares. The phases are fitted as well, as soon as lines explain most of the
    energy. The rotation of a target adds a phase that is proportional to range and to the square of
    slow time. This "bend" is fitted too. The phases are those at the range of the centroid of the
    energy.

    Trials are not explained if the energy has more than sixteen effective range cells, or if they
    need more than sixteen lines or one per eight pulses. Nor are they if nearly all energy has one
    range response. There are phases that focus such energy into one point, and changes of the phase
    of a single point cannot be distinguished from phase errors. Differentiable.

    Args:
        rows: Pulses, shape (trial, range, pulse), complex.
        present: False where a pulse holds only zeros, shape (trial, pulse).
        phase_rad: Phase to start from in rad, shape (trial, pulse).

    Returns:
        The phases, which are those to start from where points do not explain the pulses, and a bool
        per trial that is True where they do.
    """
    energy = power_of(rows.detach()).sum(-1)
    # The fit of points is not used if more than 16 effective range cells have energy: the noise is
    # then as strong as the points, or there are many points. It is not used with fewer than 32
    # pulses either, since the fit also explains echoes that are not points.
    open_ = (energy.sum(-1).square() < 16 * energy.square().sum(-1)) & (present.sum(-1) >= 32)
    phase, explained = phase_rad, torch.zeros_like(open_)
    at = true_positions(open_, host_value(open_.sum(), len(open_)))
    if not len(at):
        return phase, explained
    noise = noise_power(rows[at], present[at], phase[at])
    # lower limit for data without noise, below which the iterations do not reduce the residual
    noise = torch.maximum(noise, 1e-8 * energy[at].mean(-1).double() / rows.shape[-1])
    fit = _Fit.begin(rows[at], present[at], phase[at], noise)
    open_ = open_.index_copy(0, at, fit.cells > 0)
    for lines in range(1, 17):
        fit = fit.with_another_line()
        # the estimated level of the noise is wrong by a few percent
        found = (fit.rest() < 1.15) & fit.free & open_[at]
        # The energy of a second range response, which follows from the eigenvalues of the
        # covariance over range, must determine the phases to 0.25 rad.
        good = found & (fit.of_second_range() < 0.25)
        phase = phase.index_copy(0, at, torch.where(good[:, None], phase_rad[at] + fit.change, phase[at]))
        explained = explained.index_copy(0, at, explained[at] | good)
        open_ = open_.index_copy(0, at, open_[at] & ~found & (lines < present[at].sum(-1) // 8))
        some = true_positions(open_[at], host_value(open_[at].sum(), len(at)))
        if not len(some):
            break
        at, fit = at[some], fit.of(some)
    return phase, explained


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
        power, strongest = power[:, :32], strongest[:, :32]
        # a range cell is used if its energy exceeds that of noise by five standard deviations
        seen = power > (noise * (pulses + 5.0 * pulses.sqrt()))[:, None]
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
        n = 4 * self.rows.shape[-1]  # samples of the spectrum, four per Doppler cell
        power = power_of(torch.fft.fft(self.left, n)).sum(-2)
        top = power.argmax(-1, keepdim=True)
        below, peak, above = (power.gather(-1, (top + k) % n)[:, 0] for k in (-1, 0, 1))
        fall = 2 * peak - below - above
        place = top[:, 0] + torch.where(fall > 0, (above - below) / (2 * torch.where(fall > 0, fall, 1)), 0)
        # Doppler of the strongest line in rad per pulse
        strongest = 2 * math.pi / n * place.to(change.dtype)
        lines = torch.cat([self.lines, strongest[:, None]], -1)
        pulses = self.present.sum(-1)
        pulse = _numbers(self.present, change.dtype)
        # with this small share of the energy of a line added, the matrix of equal lines is
        # invertible
        ridge = 1e-6 * pulses[:, None, None] * torch.eye(lines.shape[-1], dtype=change.dtype, device=change.device)
        amplitudes = self.rows.new_zeros(*lines.shape, self.rows.shape[-2])
        active = torch.ones_like(free)
        for number in range(1, 21):
            rows = rotate(self._straight(bend), change)
            waves = cis(lines[..., None] * pulse[:, None]) * self.present[:, None]
            matrix = waves.conj() @ waves.mT + ridge
            # the ridge keeps the matrix regular, so that the host need not wait for the device to
            # check it
            solved = torch.linalg.solve_ex(matrix, waves.conj() @ rows.mT)[0]
            amplitudes = torch.where(active[:, None, None], solved, amplitudes)
            model = torch.where(active[:, None, None], (waves.mT @ amplitudes).mT, model)
            # The phases are fitted only when the lines explain three quarters of the energy above
            # the noise, which is tested in the third round. Phases fitted earlier would focus one
            # point of ten and defocus the others.
            if number == 3:
                unknown = power_of(rows - model).sum((-2, -1)) - self.noise * self.cells * (pulses - lines.shape[-1])
                energy = power_of(self.rows).sum((-2, -1)) - self.cells * pulses * self.noise
                free = free | (unknown < 0.25 * energy.detach())
                active = active & free
            step = safe_angle((model.conj() * rows).sum(-2)) * (active & free)[:, None]
            left = rotate(rows, step) - model
            lines = lines + active[:, None] * _turns(waves, 1j * pulse[:, None] * waves, matrix, amplitudes, left)
            change = change + step
            if number % 3 == 0:
                bent = self.curve * model
                more = (bent.conj() * left).imag.sum((-2, -1)) / or_one(power_of(bent).sum((-2, -1)))
                # If cells are squares, the bend is pi / 8 times the wavelength over the cell size:
                # 0.004 for cells of 100 wavelengths. The points of a target of 80 cells then
                # migrate by a fifth of a cell. With a larger bend they would no longer be lines.
                bend = (bend + active * more).clamp(-0.004, 0.004)
            if number > 3:  # a round that moves the phases by less than 1e-3 rad rms is the last
                active = active & (step.detach().square().sum(-1) > 1e-3**2 * pulses)
            if number >= 3 and not host_value(active.sum(), 1):
                break
        left = rotate(self._straight(bend), change) - model
        return replace(
            self, bend=bend, free=free, change=change, lines=lines, amplitudes=amplitudes, model=model, left=left
        )

    def _straight(self, bend: Tensor) -> Tensor:
        """Return the rows after the quadratic phase `bend` is removed."""
        return self.rows * cis(-bend[:, None, None] * self.curve)

    def rest(self) -> Tensor:
        """Power of the residual relative to that of the noise, (trial,); 1 if the residual is
        noise.
        """
        # a phase or a Doppler is half a complex parameter
        pulses, lines = self.present.sum(-1), self.lines.shape[-1]
        degrees = self.cells * (pulses - lines) - (pulses + lines) / 2
        return power_of(self.left).sum((-2, -1)) / or_one(self.noise * degrees)

    def of_second_range(self) -> Tensor:
        """Standard deviation in rad of the phases as far as they follow from a second, independent
        range response, (trial,); infinite if there is none.
        """
        amplitudes = self.amplitudes.to(torch.complex128)
        products = amplitudes @ amplitudes.mH
        # total: sum of the eigenvalues. pairs: twice the sum of the products of two eigenvalues.
        total = products.diagonal(dim1=-2, dim2=-1).real.sum(-1)
        pairs = total.square() - power_of(products).sum((-2, -1))
        known = pairs > 10 * torch.finfo(self.rows.dtype).eps * total.square()
        return torch.where(known, (total * self.noise / or_one(pairs.clamp_min(0))).sqrt(), torch.inf).detach()


def _numbers(present: Tensor, dtype: torch.dtype) -> Tensor:
    """Number of each pulse, counted from the middle one, and 0 for absent pulses, (trial,
    pulse).
    """
    return (torch.arange(present.shape[-1], dtype=dtype, device=present.device) - present.shape[-1] // 2) * present


def _turns(waves: Tensor, slopes: Tensor, matrix: Tensor, amplitudes: Tensor, left: Tensor) -> Tensor:
    """Gauss-Newton step of the Dopplers in rad per pulse, (trial, line), at most a quarter of a
    Doppler cell.

    slopes: derivatives of the waves with respect to their Dopplers, (trial, line, pulse) as
    `waves`. The part of them that a change of the amplitudes explains is removed. matrix: inner
    products of the waves.
    """
    mixed = waves.conj() @ slopes.mT
    free = slopes.conj() @ slopes.mT - mixed.mH @ torch.linalg.solve_ex(matrix, mixed)[0]
    curvature = (free * (amplitudes @ amplitudes.mH).conj()).real
    size = or_one(curvature.diagonal(dim1=-2, dim2=-1).sum(-1))[:, None, None]
    ridge = 1e-6 * size * torch.eye(curvature.shape[-1], dtype=size.dtype, device=size.device)
    right = (amplitudes.conj() * (slopes.conj() @ left.mT)).real.sum(-1, keepdim=True)
    turns = torch.linalg.solve_ex(curvature + ridge, right)[0][..., 0]
    largest = 0.25 * 2 * math.pi / waves.shape[-1]  # a quarter of a Doppler cell
    return turns.clamp(-largest, largest)


def noise_power(rows: Tensor, present: Tensor, phase_rad: Tensor) -> Tensor:
    """Estimate the variance of the noise of pulses whose scatterers fill less than half the image.

    A Hann window over the pulses keeps side lobes from counting as noise.

    Args:
        rows: Pulses, shape (trial, range, pulse), complex.
        present: False where a pulse holds only zeros, shape (trial, pulse).
        phase_rad: Phases that focus them in rad, shape (trial, pulse).

    Returns:
        The variance of a sample, shape (trial,), float64, without derivatives: the median power of
        the cells of the image over ln 2, which is that of the median of noise. Range cells that
        hold only zeros do not count, and the power of absent pulses is made up for.
    """
    rows = rows.detach()
    image = _windowed(torch.fft.fft(rotate(rows, phase_rad.detach()), norm="ortho"))
    power = torch.where((rows != 0).any(-1, keepdim=True), power_of(image), torch.nan)
    median = power.flatten(1).nanmedian(-1).values.nan_to_num(0.0).double()
    # effective window over the present pulses
    window = torch.fft.ifft(_windowed(torch.fft.fft(present.to(torch.complex128))))
    return median / (math.log(2) * or_one(window.real.square().mean(-1)))


def _windowed(image: Tensor) -> Tensor:
    """Apply a Hann window over the pulses to an image (..., Doppler), and keep the power
    of noise.
    """
    return (image - (image.roll(1, -1) + image.roll(-1, -1)) / 2) / math.sqrt(1.5)
