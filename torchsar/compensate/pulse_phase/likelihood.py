"""Likelihood of the phases of the pulses of a homogeneous scene.

The samples z of a range cell over the pulses are z = D a, where the diagonal matrix D = diag(exp(j
phi)) contains the phase errors. The vector a is circular Gaussian with a Toeplitz covariance R,
which the Doppler spectrum determines. The negative log likelihood of a cell is

    ln det R + tr(R^-1 D^H C D) = ln det R + u^H (R^-T o C) u,    u = exp(j phi),

where C is the covariance of the samples and "o" the product of elements.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.data import or_one
from torchsar.compensate.pulse_phase.homogeneous import SPECTRAL_FLOOR, occupied_band, power_groups, smoothed_spectrum
from torchsar.core import cholesky_factor, cis, fft_lines, matrix_inverse, power_of

PRIOR = 3 / math.pi**2  # inverse variance in 1/rad^2 of a phase that is uniform over a turn

Smooth = Callable[[Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class Fit:
    """Likelihood of the phases for given spectra.

    Args:
        spectra: Doppler spectrum of each group at twice as many bins as pulses, (trial, bin).
        inverses: R^-T of each group, shape (trial, pulse, pulse).
        matrix: R^-T o C, summed over the range cells, shape (trial, pulse, pulse), Hermitian.
        constant: ln det R, summed over the range cells, shape (trial,).
    """

    spectra: list[Tensor]
    inverses: list[Tensor]
    matrix: Tensor
    constant: Tensor


@dataclass(frozen=True)
class Speckle:
    """Samples of the range cells in groups of similar power.

    Args:
        groups: Samples with zeros in the cells of other groups, shape (trial, pulse, range); their
            products z z^H summed over the cells, shape (trial, pulse, pulse); and the number of
            cells, shape (trial,).
        present: Pulses that were received, shape (trial, pulse), bool.
        samples: Number of samples, shape (trial,), which is also the negative log likelihood of
            white noise, since the samples have a mean power of 1.
        independent: Share of the range cells that are independent, shape (trial,).
    """

    groups: list[tuple[Tensor, Tensor, Tensor]]
    present: Tensor
    samples: Tensor
    independent: Tensor

    @staticmethod
    def of(rows: Tensor, present: Tensor) -> Speckle:
        z = rows.mT.to(torch.complex128)
        samples = present.sum(-1).to(torch.float64) * z.shape[-1]
        total = power_of(z).sum((-2, -1))
        z = z * torch.where(total > 0, samples / or_one(total), 1).sqrt()[:, None, None]
        kept = [inside for inside in power_groups(power_of(z).sum(-2)) if bool(inside.any())]
        groups = [_group(z * inside[:, None, :], inside.sum(-1)) for inside in kept]
        return Speckle(groups, present, samples, occupied_band(fft_lines(rows)))

    def trials(self, at: Tensor) -> Speckle:
        """Select trials by their indices."""
        groups = [(own[at], products[at], cells[at]) for own, products, cells in self.groups]
        return Speckle(groups, self.present[at], self.samples[at], self.independent[at])

    def cells(self, kept: Tensor) -> Speckle:
        """Select range cells, given as booleans (trial, range)."""
        parts = [own * kept[:, None, :] for own, *_ in self.groups]
        groups = [_group(some, (some != 0).any(-2).sum(-1)) for some in parts]
        return Speckle(groups, self.present, self.present.sum(-1) * kept.sum(-1).to(torch.float64), self.independent)

    def blocks(self, size: int) -> Speckle:
        """Divide the pulses into blocks of `size` pulses, (trial * block). Pulses beyond the last
        one are absent.
        """
        n = self.present.shape[-1]
        count = -(-n // size)

        def cut(x: Tensor, dim: int) -> Tensor:
            return torch.cat([x, x.new_zeros(*x.shape[:dim], count * size - n, *x.shape[dim + 1 :])], dim)

        present = cut(self.present, 1).reshape(-1, size)
        groups = [
            _group(cut(own, 1).reshape(-1, size, own.shape[-1]), cells.repeat_interleave(count))
            for own, _, cells in self.groups
        ]
        samples = present.sum(-1) * self._cells.repeat_interleave(count)
        return Speckle(groups, present, samples, self.independent.repeat_interleave(count))

    def start(self, width: Tensor) -> Tensor:
        """Phases of greatest likelihood for flat Doppler bands of given widths (shares of the pulse
        rate), as exp(j phase).

        Args:
            width: Band of each trial, shape (trial,).
        """
        lag = torch.arange(self.present.shape[-1], dtype=torch.float64, device=self.present.device)
        every = sum(products for _, products, _ in self.groups) / or_one(self._cells)[:, None, None]
        flat = torch.ones_like(every[:, 0])
        # 85 % of the power is in the band, the rest is white
        band = 0.85 * torch.sinc(width[:, None] * lag) + (1 - 0.85) * (lag == 0)
        lower, _ = self._factor(self._toeplitz(band.to(flat.dtype)))
        matrix = torch.cholesky_inverse(lower).mT * every
        return newton(matrix, _smallest(matrix, flat))

    def powers(self, u: Tensor, part: slice = slice(None)) -> list[Tensor]:
        """Periodograms of each group over a part of the pulses, after the phases of u are removed.

        They are summed over the range cells, shape (trial, bin), at twice as many bins as pulses.
        """
        turned = ((own * u.conj()[..., None])[:, part] for own, *_ in self.groups)
        return [power_of(torch.fft.fft(own, 2 * u.shape[-1], dim=-2)).sum(-1) for own in turned]

    def periodograms(self, u: Tensor, smooth: Smooth) -> list[Tensor]:
        """Smoothed mean periodograms of each group, after the phases of u are removed."""
        return self.smoothed(self.powers(u), smooth)

    def smoothed(self, powers: list[Tensor], smooth: Smooth) -> list[Tensor]:
        """Smoothed mean periodograms of each group, from their sums over the range cells."""
        pulses = or_one(self.present.sum(-1))[:, None]
        return [
            self._smoothed(power / pulses, cells, smooth, SPECTRAL_FLOOR)
            for power, (*_, cells) in zip(powers, self.groups, strict=True)
        ]

    def adapted(self, u: Tensor, fit: Fit) -> list[Tensor]:
        """Smoothed spectra of each group, measured with filters that pass one frequency and
        suppress all others.

        The filters are R^-1 a / (a^H R^-1 a) with the covariances of a fit, where a is a tone
        (Capon). In a periodogram, leakage from strong parts of the spectrum would raise the weak
        parts.
        """
        spectra, n = [], u.shape[-1]
        kept = self.present[:, :, None] & self.present[:, None, :]
        for (own, _, cells), inverse in zip(self.groups, fit.inverses, strict=True):
            tones = torch.fft.fft(inverse.mT @ (own * u.conj()[..., None]), 2 * n, dim=-2)
            sums = torch.roll(torch.nn.functional.pad(lag_sums(inverse.mT * kept), (1, 0)), -n, -1)
            gain = torch.fft.fft(sums).real
            # the limit 1e-8 for the relative density below is that of rounding errors
            power = power_of(tones).sum(-1) / gain.square()
            spectra.append(self._smoothed(power * self.present.sum(-1)[:, None], cells, smoothed_spectrum, 1e-8))
        return spectra

    def _smoothed(self, power: Tensor, cells: Tensor, smooth: Smooth, floor: float) -> Tensor:
        """Smoothed mean of powers that were summed over the cells of a group."""
        mean = power.mean(-1, keepdim=True)
        power = torch.where(mean > 0, torch.maximum(power, floor * mean), 1) / or_one(cells)[:, None]
        return smooth(power, (cells * self.independent).clamp_min(1))

    def round(self, u: Tensor, spectra: list[Tensor]) -> tuple[Tensor, list[Tensor]]:
        """Newton step of the phases for given spectra, and the spectra adapted to the new
        phases.
        """
        fit = self.fit(spectra)
        u = newton(fit.matrix, u, 1)
        return u, self.adapted(u, fit)

    def fit(self, spectra: list[Tensor]) -> Fit:
        """Likelihood of the phases with given spectra of the groups."""
        inverses, constant = [], torch.zeros_like(self.samples)
        for (_, _, cells), spectrum in zip(self.groups, spectra, strict=True):
            lower, log_det = self._factor(self._toeplitz(torch.fft.ifft(spectrum)))
            inverses.append(torch.cholesky_inverse(lower).mT)
            constant = constant + cells * log_det
        return Fit(spectra, inverses, self.matrix(inverses), constant)

    def gain(self, u: Tensor, fit: Fit) -> Tensor:
        """Log likelihood of the phases u minus that of white noise, shape (trial,)."""
        return self.samples - fit.constant - value_of(fit.matrix, u)

    def summed(self, each: list[Tensor]) -> Tensor:
        """Sum over all range cells of a quantity that is given for one cell of each group."""
        return sum(
            (cells[:, None, None] * own for (*_, cells), own in zip(self.groups, each, strict=True)),
            torch.zeros_like(each[0]),
        )

    def information_each(self, fit: Fit) -> list[Tensor]:
        """Fisher information of the phases in 1/rad^2 from one range cell of each group."""
        eye = torch.eye(self.present.shape[-1], dtype=torch.float64, device=self.present.device)
        covariances = [self._toeplitz(torch.fft.ifft(spectrum)) for spectrum in fit.spectra]
        return [2 * ((one * other).real - eye) for one, other in zip(fit.inverses, covariances, strict=True)]

    def independent_share(self, u: Tensor, fit: Fit, each: list[Tensor], of: slice = slice(None)) -> Tensor:
        """Share of the information that is independent, (trial,), because range cells are
        correlated.

        Cells that a point fills with its side lobes, or that are sampled finer than the band
        requires, have the same innovations. The information gained from two cells depends on the
        square of their correlation. Correlations of independent cells of n pulses have a mean
        square of 1 / n.

        Args:
            u: Phases as exp(j phase), shape (trial, pulse).
            fit: The fit to all range cells.
            each: Information of a range cell of each group, see `information_each`.
            of: The groups whose share it is.
        """
        innovations = torch.zeros_like(self.groups[0][0])
        of_cell = torch.zeros_like(innovations[:, 0].real)
        for (own, *_), inverse, information in zip(self.groups[of], fit.inverses[of], each[of], strict=True):
            lower = cholesky_factor(inverse.mT)
            innovations = innovations + lower.mH @ (own * u.conj()[..., None])
            here = power_of(own).sum(-2) > 0
            amount = torch.diagonal(information, dim1=-2, dim2=-1).sum(-1).clamp_min(0)
            of_cell = of_cell + here * amount[:, None]
        level, count = torch.linalg.vector_norm(innovations, dim=-2), self.present.sum(-1).clamp_min(2)
        innovations = innovations / or_one(level)[:, None, :]
        alike = innovations.mH @ innovations
        excess = (power_of(alike) - 1 / count[:, None, None]) / (1 - 1 / count)[:, None, None]
        weight = of_cell.sqrt()
        both = (weight[:, None, :] @ (excess @ weight[..., None]))[:, 0, 0] - (weight.square() * (level > 0)).sum(-1)
        total = weight.square().sum(-1)
        return torch.where(total > 0, total / or_one(total + both.clamp_min(0)), 1)

    def matrix(self, inverses: list[Tensor]) -> Tensor:
        """Sum over the range cells of R^-T o C, for the R^-T of each group."""
        return sum(
            (one * products for one, (_, products, _) in zip(inverses, self.groups, strict=True)),
            torch.zeros_like(self.groups[0][1]),
        )

    @property
    def _cells(self) -> Tensor:
        return sum((cells for *_, cells in self.groups[1:]), self.groups[0][2])

    def _toeplitz(self, lags: Tensor) -> Tensor:
        """Covariance of the present pulses, (trial, pulse, pulse); other pulses have variance 1.

        It is Hermitian and Toeplitz with the first column `lags` (trial, at least pulse).
        """
        n = self.present.shape[-1]
        at = torch.arange(n, device=lags.device)
        both = torch.cat([lags[:, :n], lags[:, 1:n].conj().flip(-1)], -1)[:, (at[:, None] - at) % (2 * n - 1)]
        kept = self.present[:, :, None] & self.present[:, None, :]
        return torch.where(kept, both, torch.eye(n, dtype=lags.dtype, device=lags.device))

    def _factor(self, covariance: Tensor) -> tuple[Tensor, Tensor]:
        """Cholesky factor and log determinant of covariances."""
        lower = cholesky_factor(covariance)
        return lower, 2 * torch.diagonal(lower, dim1=-2, dim2=-1).real.log().sum(-1)


def _group(own: Tensor, cells: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """A group of `Speckle`: samples, their products summed over the cells, number of cells."""
    return own, own @ own.mH, cells.to(torch.float64)


def lag_sums(matrix: Tensor) -> Tensor:
    """Sum the elements (row, column) of equal row - column.

    Args:
        matrix: Matrices, shape (trial, n, n).

    Returns:
        The sums for row - column from 1 - n to n - 1, shape (trial, 2 n - 1).
    """
    n = matrix.shape[-1]
    skewed = torch.nn.functional.pad(matrix.flip(-1), (0, n)).flatten(-2)[..., : n * (2 * n - 1)]
    return skewed.unflatten(-1, (n, 2 * n - 1)).sum(-2)


def value_of(matrix: Tensor, u: Tensor) -> Tensor:
    """Compute u^H M u.

    Args:
        matrix: Hermitian matrices M, shape (trial, pulse, pulse).
        u: Vectors, shape (trial, pulse).

    Returns:
        The values, shape (trial,), real.
    """
    return (u.conj() * (matrix @ u[..., None])[..., 0]).sum(-1).real


def _smallest(matrix: Tensor, start: Tensor) -> Tensor:
    """Phases, as exp(j phase), of the eigenvector of the smallest eigenvalue, by inverse
    iteration.
    """
    n = start.shape[-1]
    ridge = 1e-6 * torch.diagonal(matrix, dim1=-2, dim2=-1).real.mean(-1)[:, None, None] + 1e-12
    lower = cholesky_factor(matrix + ridge * torch.eye(n, dtype=matrix.dtype, device=matrix.device))
    vector = start
    for _ in range(4):
        vector = torch.cholesky_solve(vector[..., None], lower)[..., 0]
        vector = vector / or_one(vector.abs().amax(-1, keepdim=True))
    size = vector.abs()
    return torch.where(size > 0, vector / or_one(size), 1)


def newton(matrix: Tensor, u: Tensor, steps: int = 4) -> Tensor:
    """Lower u^H M u by damped Newton steps of the phases of u.

    Args:
        matrix: Hermitian matrices M, shape (trial, pulse, pulse).
        u: Phases to start from as exp(j phase), shape (trial, pulse).
        steps: Number of steps; one that does not lower the value only changes the damping.

    Returns:
        The phases reached, as exp(j phase), same shape as `u`.
    """
    value, diagonal = value_of(matrix, u), torch.diagonal(matrix, dim1=-2, dim2=-1).real.mean(-1)
    damping = torch.full_like(value, 1e-3)
    eye = torch.eye(u.shape[-1], dtype=torch.float64, device=u.device)
    for _ in range(steps):
        turned = u.conj()[..., :, None] * matrix * u[..., None, :]
        slope = turned.sum(-1)
        bend = 2 * turned.real - torch.diag_embed(2 * slope.real - (2 * damping * diagonal + 1e-9)[:, None])
        lower, failed = torch.linalg.cholesky_ex(bend)
        lower = torch.where((failed == 0)[:, None, None], lower, eye)
        step = -torch.cholesky_solve(2 * slope.imag[..., None], lower)[..., 0]
        trial = u * cis(step.clamp(-1, 1))
        reached = value_of(matrix, trial)
        better = (failed == 0) & (reached <= value)
        u, value = torch.where(better[:, None], trial, u), torch.where(better, reached, value)
        damping = torch.where(better, damping / 5, damping * 10).clamp(1e-9, 1e3)
    return u


def deviation(information: Tensor) -> Tensor:
    """Predict the standard deviation of phases without their constant and linear part.

    Args:
        information: Fisher information of the phases in 1/rad^2, shape (trial, pulse, pulse).

    Returns:
        The standard deviation in rad, shape (trial, pulse).
    """
    n = information.shape[-1]
    eye = torch.eye(n, dtype=torch.float64, device=information.device)
    flat = without_line_matrix(n, information.device)
    covariance = flat @ matrix_inverse(information + PRIOR * eye) @ flat
    return torch.diagonal(covariance, dim1=-2, dim2=-1).clamp_min(0).sqrt()


def rms_of_pulses(x: Tensor, present: Tensor) -> Tensor:
    """Compute the rms of values over the present pulses.

    Args:
        x: Values, shape (trial, pulse).
        present: Pulses that were received, shape (trial, pulse), bool.

    Returns:
        The rms, shape (trial,).
    """
    return ((x.square() * present).sum(-1) / present.sum(-1).clamp_min(1)).sqrt()


def without_line_matrix(n: int, device: torch.device) -> Tensor:
    """Return the projection of phases that removes their constant and linear part.

    Args:
        n: Number of phases.
        device: Device of the result.

    Returns:
        The projection, shape (n, n), float64.
    """
    pulse = torch.linspace(-1, 1, n, dtype=torch.float64, device=device)
    line = torch.linalg.qr(torch.stack([torch.ones_like(pulse), pulse], -1)).Q
    return torch.eye(n, dtype=torch.float64, device=device) - line @ line.mT


def windowed_spectrum(power: Tensor, looks: Tensor) -> Tensor:
    """Smooth a mean periodogram by a Hann window of 9 bins, for phases that are still far off.

    Args:
        power: Mean power, shape (trial, bin); the first and the last bin are neighbours.
        looks: Not used, see `smoothed_spectrum`.

    Returns:
        The smoothed power, same shape.
    """
    window = torch.hann_window(11, periodic=False, dtype=power.dtype, device=power.device)[1:-1]
    padded = torch.nn.functional.pad(power[:, None], (4, 4), mode="circular")
    return torch.nn.functional.conv1d(padded, (window / window.sum())[None, None])[:, 0]
