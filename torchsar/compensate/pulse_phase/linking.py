"""Phase linking: maximum likelihood phases of the pulses of a homogeneous scene.

A scene whose speckle fills a large part of the Doppler band has no sharp image, and methods that
sharpen the image end with wrong phases. The phases are well determined nevertheless. The samples z
of a range cell over the pulses are z = D a, where D = diag(exp(j phi)) holds the phase errors and a
is circular Gaussian with a Toeplitz covariance R that the Doppler spectrum fixes. The phases and
the spectrum minimise the negative log likelihood of a cell,

    ln det R + tr(R^-1 D^H C D) = ln det R + u^H (R^-T o C) u,    u = exp(j phi),

where C is the covariance of the samples and "o" the product of elements.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.alignment import Displacement, coherent_jitter, displacement
from torchsar.compensate.pulse_phase.data import Pulses, or_one, prepare, starting_phase
from torchsar.compensate.pulse_phase.homogeneous import SPECTRAL_FLOOR, describe, power_groups
from torchsar.compensate.pulse_phase.imaging import AlongPulses
from torchsar.compensate.pulse_phase.pairs import pair_phase
from torchsar.compensate.pulse_phase.sharpen import LogAbove, Run, fixed_point
from torchsar.compensate.pulse_phase.spectrum import smoothed_spectrum
from torchsar.compensate.pulse_phase.verdict import LEAST_ROWS, LEAST_STREHL, occupied_band
from torchsar.core import Estimate, cholesky_factor, cis, linear_solve, matrix_inverse, over_blocks
from torchsar.metrics.phase import phase_rmse

# Longest block whose phases are found by themselves, in pulses; bands of their first guesses as
# shares of the pulse rate, and the share of the power in the band.
_BLOCK, _WIDTHS, _IN_BAND = 32, (0.1, 0.25, 0.45, 0.65, 0.8, 0.9), 0.85
# Estimates of the spectrum of such a block, and of two blocks that were joined; those smoothed by a
# window, because the first phases are far off, and its half width in bins; Newton steps of the
# phases after each.
_ROUNDS, _JOINT_ROUNDS, _COARSE_ROUNDS, _WINDOW, _STEPS = 8, 3, 2, 4, 4
# Triples of rounds with adapted spectra; longest extrapolation; change, as a share of the predicted
# standard deviation, that ends them; least density relative to the mean, which rounding allows.
_REFINEMENTS, _LONGEST, _SMALL, _LEAST_FLOOR = 6, 8.0, 0.3, 1e-8
_PRIOR = 3 / math.pi**2  # information in 1/rad^2 of a phase that is uniform over a turn
# Gain of the log likelihood per pulse by which the phases fit circular noise: 1.1 to 2.3 nats were
# measured for 4 to 192 range cells and 64 to 256 pulses. A scene must gain twice as much.
_NOISE_NATS, _MARGIN = 2.0, 2.0
# The errors of neighbouring pulses depend on each other, and where the spectrum has no edges a slow
# phase error hardly changes it, so that the rms error of a scene may exceed its standard deviation
# by this factor.
_SPREAD = 1.9
# range cells from which on the errors are so predictable; with fewer the factor is larger. Found by
# trial: in few cells the spectra of points that change adapt to slow phase errors.
_CELLS = 24
# Where less than so many range cells, or a quarter of all, hold nearly all of the scene, sharp
# phases have to confirm the linked ones, to so many deviations: in up to 7 % of scenes of one to
# three points these were wrong by more than five.
_FEW_ROWS, _NEAR = 6.0, 3.0
# Share of the coherence across a boundary between pulses that the fitted spectra must find: of
# homogeneous scenes the least one was 0.6 to 0.9 over all boundaries, of scenes that change at a
# pulse 0.1 to 0.5. Boundaries in the first and last sixteenth of the pulses are left out.
_LEAST_SHARE, _OUTER = 0.55, 16
# the phases that sharpen a sparse scene, as in `autofocus`
_SHARPEN = Run(LogAbove(2.5), AlongPulses(), 60, 1.8, 0.01)
_BLOCK_BYTES = 64 << 20  # limits the memory of a block of trials


def link_phases(data: Tensor, *, start: Tensor | None = None) -> Estimate:
    """Estimate the phase of each pulse of a homogeneous scene by maximum likelihood.

    The scene is speckle with any Doppler spectrum. Its error does not depend on the size or kind of
    the phase errors. The time grows with the cube of the number of pulses, and the memory with its
    square (200 MB for 1024 pulses). Differentiable: the derivative is that of a Newton step of the
    phases for the spectra found.

    Args:
        data: Range-compressed and aligned pulses, shape (..., pulse, range), complex.
        start: Phase to start from in rad, shape (..., pulse), if it is known to about a radian; by
            default the search starts from phases that fit one of several Doppler bands best.

    Returns:
        `phase_rad` of shape (..., pulse), to be removed. The standard deviation of each pulse is
        the Cramer-Rao bound for the estimated spectrum, in which range cells that depend on each
        other count less, raised by the share of the likelihood that the phases gain on noise. A
        constant and a linear phase only add a phase to the image and shift it; they are
        left out of the standard deviation. `quality` is the predicted Strehl ratio times the share
        of the likelihood that noise does not explain. `ok` is False where the Strehl ratio for 1.9
        times the standard deviation (more where fewer than 24 range cells hold the energy) is below
        0.8, the gain in likelihood below twice that of noise, a single range cell holds nearly all
        of the energy, the range profiles are not aligned (see `Displacement`), the pulses before
        and after a boundary are less than 0.55 times as coherent as the spectra predict (where the
        scene changes, or pulses are copies of each other), adjacent pulses are not coherent in any
        ten range cells of similar power, few range cells hold nearly all of the scene and phases
        that sharpen it differ by more than three standard deviations, or a sparse description of
        the scene with these is more likely: in sparse scenes the spectrum adapts to phase errors,
        which the standard deviation does not contain. `info`
        holds, of shape (...,), "gain_nats" (log likelihood minus that of white noise), "fit_nats"
        (the same as if range cells were independent, by which phases of one scene compare),
        "weakest_boundary" (the least coherence across a boundary relative to the prediction),
        "jitter_cells" and "migration_cells".

    Raises:
        TypeError: If the data are not complex or the start is not a tensor.
        ValueError: If the data are empty or not finite, or the start does not have one phase per
            pulse.

    Reference:
        Guarnieri and Tebaldini, IEEE Trans. Geosci. Remote Sens. 46(11), 2008 (phase linking).
    """
    pulses = prepare(data, "link_phases")
    found = linked(pulses, starting_phase(start, pulses, "link_phases"))
    if pulses.n < 3 or not len(pulses.rows):
        return found
    with torch.no_grad():
        sharp = fixed_point(pulses.rows, pair_phase(pulses.rows, pulses.present), _SHARPEN)[0]
        scene = describe(pulses.rows, sharp, occupied_band(pulses.rows))
        likelier = (found.info["gain_nats"].flatten() > scene.sparse) & (scene.ratio > 0)
        phase, std = (x["phase_rad"].reshape(-1, pulses.n) for x in (found.value, found.std))
        apart = phase_rmse(phase, sharp, pulses.present)
        near = apart < _NEAR * std.double().square().mean(-1).sqrt()
        believed = likelier & (near | ~_concentrated(pulses.rows))
    return replace(found, ok=found.ok & believed.reshape(pulses.trials))


def linked(pulses: Pulses, start: Tensor | None = None) -> Estimate:
    """Estimate the phases of pulses that were checked; see `link_phases`.

    Args:
        pulses: The pulses.
        start: Phase to start from in rad, shape (trial, pulse), or None.

    Returns:
        The `Estimate` that `link_phases` returns.
    """
    rows, n = pulses.rows, pulses.n
    if not len(rows):
        none = torch.zeros(0, n, dtype=torch.float64, device=rows.device)
        return _estimate(pulses, _Linked(none, none, *3 * [none[:, 0]]), Displacement(none[:, 0], none[:, 0]))
    size = max(1, _BLOCK_BYTES // (16 * n * (6 * n + 2 * rows.shape[1])))
    parts = [slice(first, first + size) for first in range(0, len(rows), size)]
    done: dict[int, tuple[Tensor, ...]] = {}

    def work(part: slice) -> None:
        found = _linked(rows[part], pulses.present[part], None if start is None else start[part])
        moved = displacement(rows[part], pulses.present[part])
        jitter = torch.maximum(moved.jitter, coherent_jitter(rows[part], pulses.present[part]))
        done[part.start] = *found, jitter, moved.migration

    if rows.requires_grad and torch.is_grad_enabled():
        for part in parts:
            work(part)
    else:
        with torch.no_grad():
            over_blocks(work, parts, rows)
    *found, jitter, migration = (torch.cat([done[part.start][i] for part in parts]) for i in range(7))
    return _estimate(pulses, _Linked(*found), Displacement(jitter, migration))


def _concentrated(rows: Tensor) -> Tensor:
    """Whether few of the range cells hold nearly all of the scene, (trial,)."""
    energy = (rows.real.square() + rows.imag.square()).sum(-1, dtype=torch.float64)
    above = energy - energy.amin(-1, keepdim=True)
    count = above.sum(-1).square() / or_one(above.square().sum(-1))
    return count < min(_FEW_ROWS, rows.shape[-2] / 4)


class _Linked(NamedTuple):
    """Result of the linking of a block of trials.

    Args:
        phase: Phases in rad, (trial, pulse).
        std: Their standard deviations in rad, (trial, pulse).
        fit: Log likelihood minus that of white noise in nats, as if the range cells were
            independent but for the band that they occupy, (trial,).
        gain: The part of it that counts because range cells depend on each other, (trial,).
        boundary: See `_weakest_boundary`, (trial,).
    """

    phase: Tensor
    std: Tensor
    fit: Tensor
    gain: Tensor
    boundary: Tensor


def _estimate(pulses: Pulses, found: _Linked, moved: Displacement) -> Estimate:
    phase, std, fit, gain, boundary = found
    real, trials = pulses.rows.real.dtype, pulses.trials
    noise = _NOISE_NATS * pulses.present.sum(-1)
    scene = (1 - noise / or_one(gain)).clamp(0, 1)
    std = torch.where(scene[:, None] > 0, std / or_one(scene).sqrt()[:, None], torch.inf).clamp_max(_PRIOR**-0.5)
    strehl = torch.exp(-(std.square() * pulses.present).sum(-1) / pulses.present.sum(-1).clamp_min(1))
    row = (pulses.rows.detach().real.square() + pulses.rows.detach().imag.square()).sum(-1, dtype=torch.float64)
    effective = row.sum(-1).square() / or_one(row.square().sum(-1))
    spread = _SPREAD**2 * (_CELLS / effective.clamp_min(1)).clamp_min(1)
    fitted = (strehl**spread > LEAST_STREHL) & (gain > _MARGIN * noise) & (effective > LEAST_ROWS)
    return Estimate(
        value={"phase_rad": phase.reshape(*trials, pulses.n).to(real)},
        std={"phase_rad": std.reshape(*trials, pulses.n).to(real)},
        quality=(strehl * scene).reshape(trials).to(real),
        ok=(fitted & moved.aligned & (boundary > _LEAST_SHARE)).reshape(trials),
        info={
            "gain_nats": gain.reshape(trials),
            "fit_nats": fit.reshape(trials),
            "weakest_boundary": boundary.reshape(trials),
            "jitter_cells": moved.jitter.reshape(trials),
            "migration_cells": moved.migration.reshape(trials),
        },
    )


def _linked(rows: Tensor, present: Tensor, start: Tensor | None) -> _Linked:
    """Link the pulses of a block of trials."""
    if rows.shape[-1] < 3:  # nothing to distinguish a phase error from a shift of the image
        zero = torch.zeros(present.shape, dtype=torch.float64, device=rows.device)
        return _Linked(zero, zero + torch.inf, *3 * [zero[:, 0]])
    with torch.no_grad():
        scene = _Scene.of(rows.detach(), present)
        u, fit = _refined(scene, _grown(scene) if start is None else cis(start.to(torch.float64)))
        each = scene.information_each(fit)
        information, independent = scene.summed(each), scene.independent_share(u, fit, each)
        gain = scene.gain(u, fit)
        std = _deviation(independent[:, None, None] * information)
        judged = std, scene.independent * gain, independent * gain, _weakest_boundary(fit.matrix, u, information)
    if not rows.requires_grad or not torch.is_grad_enabled():
        return _Linked(torch.angle(u), *judged)
    step = _step(_Scene.of(rows, present).matrix(fit.inverses), u)
    return _Linked(torch.angle(u) + step - step.detach(), *judged)


def _weakest_boundary(matrix: Tensor, u: Tensor, information: Tensor) -> Tensor:
    """Least coherence of the pulses before and after a boundary, over that of the model, (trial,).

    It is the part of the log likelihood that pairs of pulses across the boundary contribute: it
    would change its sign with the phases of all later pulses. Its expectation for a covariance R
    is that of u^H (R^-T o C) u, which is half of the Fisher information.
    """
    skipped = u.shape[-1] // _OUTER

    def across(pairs: Tensor) -> Tensor:
        sums = pairs.cumsum(-2).cumsum(-1)
        whole = sums[..., -1] - torch.diagonal(sums, dim1=-2, dim2=-1)
        return whole[:, skipped : whole.shape[-1] - 1 - skipped]

    found = across((u.conj()[:, :, None] * matrix * u[:, None, :]).real)
    expected = across(information) / 2
    return torch.where(expected < 0, found / torch.where(expected < 0, expected, -1), 1).amin(-1)


def _grown(scene: _Scene) -> Tensor:
    """Phases near those of greatest likelihood, as exp(j phase), (trial, pulse).

    A search over all pulses ends in local minima, in which parts of the pulses have slipped by a
    Doppler cell. Few pulses have few minima. The phases of short blocks are therefore found first,
    and neighbouring blocks are joined until one is left.
    """
    trials, n = scene.present.shape
    size = -(-n // 2 ** max(0, math.ceil(math.log2(n / _BLOCK))))
    u = _solved(scene.blocks(size))
    while size < n:
        blocks = u.reshape(trials, -1, size)
        if blocks.shape[1] % 2:  # the last block has no neighbour: one of absent pulses
            blocks = torch.cat([blocks, torch.ones_like(blocks[:, :1])], 1)
        size *= 2
        u = _joined(scene.blocks(size), blocks.reshape(-1, size))
    return u.reshape(trials, -1)[:, :n]


def _solved(blocks: _Scene) -> Tensor:
    """Phases of short blocks: those of greatest likelihood that are found from several bands."""
    best, most = torch.ones_like(blocks.groups[0][0][..., 0]), torch.full_like(blocks.samples, -torch.inf)
    for width in _WIDTHS:
        u = blocks.start(width)
        for count in range(_ROUNDS):
            smooth = _windowed if count < _COARSE_ROUNDS else smoothed_spectrum
            u = _newton(blocks.fit(blocks.periodograms(u, smooth)).matrix, u, _STEPS)
        fit = blocks.fit(blocks.periodograms(u, smoothed_spectrum))
        gain = blocks.gain(u, fit)
        best = torch.where((gain > most)[:, None], u, best)
        most = torch.maximum(gain, most)
    return best


def _joined(pairs: _Scene, u: Tensor) -> Tensor:
    """Phases of pairs of blocks, from phases that are right in each block but for a straight line.

    The spectra of both blocks are laid on each other for a common covariance. For each slope of the
    second block, the best constant phase follows in closed form. With a matrix M and the phases a
    and b of the blocks it leaves b^H M b - 2 |a^H M b|: two Fourier transforms over the slopes.
    """
    half, slopes = u.shape[-1] // 2, 4 * u.shape[-1]
    left, right = u[:, :half], u[:, half:]
    powers = [pairs.powers(u, slice(0, half)), pairs.powers(u, slice(half, None))]
    likeness = sum(
        torch.fft.ifft(torch.fft.fft(one.sqrt()).conj() * torch.fft.fft(other.sqrt())).real
        for one, other in zip(*powers, strict=True)
    )
    bins = powers[0][0].shape[-1]
    at = (torch.arange(bins, device=u.device) + torch.as_tensor(likeness).argmax(-1, keepdim=True)) % bins
    both = [one + other.gather(-1, at) for one, other in zip(*powers, strict=True)]
    matrix = pairs.fit(pairs.smoothed(both, smoothed_spectrum)).matrix

    sums = _lag_sums(right.conj()[:, :, None] * matrix[:, half:, half:] * right[:, None, :])
    own = torch.fft.fft(torch.roll(torch.nn.functional.pad(sums, (0, slopes - sums.shape[-1])), 1 - half, -1)).real
    crossed = (left.conj()[:, None, :] @ matrix[:, :half, half:])[:, 0] * right
    mutual = slopes * torch.fft.ifft(crossed, slopes)
    best = (own - 2 * mutual.abs()).argmin(-1, keepdim=True)
    line = 2 * math.pi / slopes * best * torch.arange(half, device=u.device)
    u = torch.cat([left, -right * cis(line - torch.angle(mutual.gather(-1, best)))], -1)
    for _ in range(_JOINT_ROUNDS):
        u = _newton(matrix, u, _STEPS)
        matrix = pairs.fit(pairs.periodograms(u, smoothed_spectrum)).matrix
    return u


def _refined(scene: _Scene, u: Tensor) -> tuple[Tensor, _Fit]:
    """The phases of greatest likelihood for adapted spectra, and the fit with these spectra.

    Phases and spectra are found in turn. A smooth error of the phase widens the spectrum, and the
    wider spectrum hardly opposes it; three rounds are therefore extrapolated (squared iteration)
    where that makes the phases more likely.
    """
    spectra = scene.periodograms(u, smoothed_spectrum)
    std = _deviation(scene.information(scene.fit(spectra))).square().mean(-1).sqrt()
    active = torch.arange(len(u), device=u.device)
    for _ in range(_REFINEMENTS):
        some, first = scene.trials(active), u[active]
        own = [of_all[active] for of_all in spectra]
        second, own = some.round(first, own)
        third, own = some.round(second, own)
        step, next_ = torch.angle(second * first.conj()), torch.angle(third * second.conj())
        bend = (next_ - step).norm(dim=-1, keepdim=True)
        reach = (step.norm(dim=-1, keepdim=True) / or_one(bend)).where(bend > 0, 1).clamp(1, _LONGEST)
        far, of_far = some.round(first * cis(2 * reach * step + reach.square() * (next_ - step)), own)
        better = some.gain(far, some.fit(of_far)) > some.gain(third, some.fit(own))
        new = torch.where(better[:, None], far, third)
        own = [torch.where(better[:, None], one, other) for one, other in zip(of_far, own, strict=True)]
        u = u.index_copy(0, active, new)
        spectra = [of_all.index_copy(0, active, of_some) for of_all, of_some in zip(spectra, own, strict=True)]
        active = active[_distance(new, first) > _SMALL * std[active]]
        if not len(active):
            break
    return u, scene.fit(spectra)


def _distance(u: Tensor, v: Tensor) -> Tensor:
    """Difference of phases in rad, rms over the pulses, (trial,)."""
    return torch.angle(u * v.conj()).square().mean(-1).sqrt()


Smooth = Callable[[Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class _Fit:
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
class _Scene:
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
    def of(rows: Tensor, present: Tensor) -> _Scene:
        z = rows.mT.to(torch.complex128)
        samples = present.sum(-1).to(torch.float64) * z.shape[-1]
        total = (z.real.square() + z.imag.square()).sum((-2, -1))
        z = z * torch.where(total > 0, samples / or_one(total), 1).sqrt()[:, None, None]
        power = (z.real.square() + z.imag.square()).sum(-2)
        groups = []
        for inside in power_groups(power):
            if bool(inside.any()):
                own = z * inside[:, None, :]
                groups.append((own, own @ own.mH, inside.sum(-1).to(torch.float64)))
        return _Scene(groups, present, samples, occupied_band(rows))

    def trials(self, at: Tensor) -> _Scene:
        """The scenes of some of the trials, given by their indices."""
        groups = [(own[at], products[at], cells[at]) for own, products, cells in self.groups]
        return _Scene(groups, self.present[at], self.samples[at], self.independent[at])

    def blocks(self, size: int) -> _Scene:
        """Blocks of so many pulses, (trial * block); pulses beyond the last are absent."""
        n = self.present.shape[-1]
        count = -(-n // size)

        def cut(x: Tensor, dim: int) -> Tensor:
            return torch.cat([x, x.new_zeros(*x.shape[:dim], count * size - n, *x.shape[dim + 1 :])], dim)

        present = cut(self.present, 1).reshape(-1, size)
        groups = []
        for samples, _, cells in self.groups:
            own = cut(samples, 1).reshape(-1, size, samples.shape[-1])
            groups.append((own, own @ own.mH, cells.repeat_interleave(count)))
        samples = present.sum(-1) * self._cells.repeat_interleave(count)
        return _Scene(groups, present, samples, self.independent.repeat_interleave(count))

    def start(self, width: float) -> Tensor:
        """Phases of greatest likelihood for a band (share of the pulse rate), as exp(j phase)."""
        lag = torch.arange(self.present.shape[-1], dtype=torch.float64, device=self.present.device)
        every = sum(products for _, products, _ in self.groups) / or_one(self._cells)[:, None, None]
        flat = torch.ones_like(every[:, 0])
        band = _IN_BAND * torch.sinc(width * lag) + (1 - _IN_BAND) * (lag == 0)
        lower, _ = self._factor(self._toeplitz(band.to(flat.dtype).expand_as(flat)))
        matrix = torch.cholesky_inverse(lower).mT * every
        return _newton(matrix, _smallest(matrix, flat), _STEPS)

    def powers(self, u: Tensor, part: slice = slice(None)) -> list[Tensor]:
        """Periodograms of each group over a part of the pulses, without the phases of u.

        They are summed over the range cells, shape (trial, bin), at twice as many bins as pulses.
        """
        powers = []
        for own, *_ in self.groups:
            spectrum = torch.fft.fft((own * u.conj()[..., None])[:, part], 2 * u.shape[-1], dim=-2)
            powers.append((spectrum.real.square() + spectrum.imag.square()).sum(-1))
        return powers

    def periodograms(self, u: Tensor, smooth: Smooth) -> list[Tensor]:
        """Smoothed mean periodograms of each group, without the phases of u."""
        return self.smoothed(self.powers(u), smooth)

    def smoothed(self, powers: list[Tensor], smooth: Smooth) -> list[Tensor]:
        """Smoothed mean periodograms of each group, from their sums over the range cells."""
        pulses = or_one(self.present.sum(-1))[:, None]
        return [
            self._smoothed(power / pulses, cells, smooth, SPECTRAL_FLOOR)
            for power, (*_, cells) in zip(powers, self.groups, strict=True)
        ]

    def adapted(self, u: Tensor, fit: _Fit) -> list[Tensor]:
        """Smoothed powers of each group behind filters that suppress all other frequencies.

        The filters are R^-1 a / (a^H R^-1 a) with the covariances of a fit, where a is a tone. A
        periodogram raises weak parts of the spectrum by what leaks from strong ones.
        """
        spectra, n = [], u.shape[-1]
        kept = self.present[:, :, None] & self.present[:, None, :]
        for (own, _, cells), inverse in zip(self.groups, fit.inverses, strict=True):
            tones = torch.fft.fft(inverse.mT @ (own * u.conj()[..., None]), 2 * n, dim=-2)
            sums = torch.roll(torch.nn.functional.pad(_lag_sums(inverse.mT * kept), (1, 0)), -n, -1)
            gain = torch.fft.fft(sums).real
            power = (tones.real.square() + tones.imag.square()).sum(-1) / gain.square()
            spectra.append(
                self._smoothed(power * self.present.sum(-1)[:, None], cells, smoothed_spectrum, _LEAST_FLOOR)
            )
        return spectra

    def _smoothed(self, power: Tensor, cells: Tensor, smooth: Smooth, floor: float) -> Tensor:
        """Smoothed mean of powers that were summed over the cells of a group."""
        mean = power.mean(-1, keepdim=True)
        power = torch.where(mean > 0, torch.maximum(power, floor * mean), 1) / or_one(cells)[:, None]
        return smooth(power, (cells * self.independent).clamp_min(1))

    def round(self, u: Tensor, spectra: list[Tensor]) -> tuple[Tensor, list[Tensor]]:
        """A Newton step of the phases for given spectra, and the spectra adapted to the result."""
        fit = self.fit(spectra)
        u = _newton(fit.matrix, u, 1)
        return u, self.adapted(u, fit)

    def fit(self, spectra: list[Tensor]) -> _Fit:
        """The likelihood with given spectra of the groups."""
        inverses, constant = [], torch.zeros_like(self.samples)
        for (_, _, cells), spectrum in zip(self.groups, spectra, strict=True):
            lower, log_det = self._factor(self._toeplitz(torch.fft.ifft(spectrum)))
            inverses.append(torch.cholesky_inverse(lower).mT)
            constant = constant + cells * log_det
        return _Fit(spectra, inverses, self.matrix(inverses), constant)

    def gain(self, u: Tensor, fit: _Fit) -> Tensor:
        """Log likelihood of the phases u minus that of white noise, shape (trial,)."""
        return self.samples - fit.constant - _value(fit.matrix, u)

    def information(self, fit: _Fit) -> Tensor:
        """Fisher information of the phases in 1/rad^2, shape (trial, pulse, pulse), if all range
        cells are independent.
        """
        return self.summed(self.information_each(fit))

    def summed(self, each: list[Tensor]) -> Tensor:
        """Sum over all range cells of what each cell of a group adds."""
        return sum(
            (cells[:, None, None] * own for (*_, cells), own in zip(self.groups, each, strict=True)),
            torch.zeros_like(each[0]),
        )

    def information_each(self, fit: _Fit) -> list[Tensor]:
        """Fisher information of the phases in a range cell of each group."""
        eye = torch.eye(self.present.shape[-1], dtype=torch.float64, device=self.present.device)
        covariances = [self._toeplitz(torch.fft.ifft(spectrum)) for spectrum in fit.spectra]
        return [2 * ((one * other).real - eye) for one, other in zip(fit.inverses, covariances, strict=True)]

    def independent_share(self, u: Tensor, fit: _Fit, each: list[Tensor]) -> Tensor:
        """Share of the information that counts, because range cells depend on each other, (trial,).

        Cells that a point fills with its side lobes, or that are sampled finer than the band
        requires, have the same innovations. What the phases gain from two cells depends as the
        square of their correlation. Correlations of independent cells of n pulses have a mean
        square of 1 / n. each: Information of a range cell of each group, see `information_each`.
        """
        innovations = torch.zeros_like(self.groups[0][0])
        of_cell = torch.zeros_like(innovations[:, 0].real)
        for (own, *_), inverse, information in zip(self.groups, fit.inverses, each, strict=True):
            lower = cholesky_factor(inverse.mT)
            innovations = innovations + lower.mH @ (own * u.conj()[..., None])
            here = (own.real.square() + own.imag.square()).sum(-2) > 0
            amount = torch.diagonal(information, dim1=-2, dim2=-1).sum(-1).clamp_min(0)
            of_cell = of_cell + here * amount[:, None]
        level, count = torch.linalg.vector_norm(innovations, dim=-2), self.present.sum(-1).clamp_min(2)
        innovations = innovations / or_one(level)[:, None, :]
        alike = innovations.mH @ innovations
        excess = (alike.real.square() + alike.imag.square() - 1 / count[:, None, None]) / (1 - 1 / count)[:, None, None]
        weight = of_cell.sqrt()
        both = (weight[:, None, :] @ (excess @ weight[..., None]))[:, 0, 0] - (weight.square() * (level > 0)).sum(-1)
        total = weight.square().sum(-1)
        return torch.where(total > 0, total / or_one(total + both.clamp_min(0)), 1)

    def matrix(self, inverses: list[Tensor]) -> Tensor:
        """R^-T o C, summed over the range cells, for the R^-T of each group."""
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


def _lag_sums(matrix: Tensor) -> Tensor:
    """Sums of the elements (row, column) of equal row - column, from 1 - n to n - 1."""
    n = matrix.shape[-1]
    skewed = torch.nn.functional.pad(matrix.flip(-1), (0, n)).flatten(-2)[..., : n * (2 * n - 1)]
    return skewed.unflatten(-1, (n, 2 * n - 1)).sum(-2)


def _windowed(power: Tensor, _: Tensor) -> Tensor:
    """Smooth a spectrum (trial, bin) by a Hann window of 9 bins."""
    window = torch.hann_window(2 * _WINDOW + 3, periodic=False, dtype=power.dtype, device=power.device)[1:-1]
    padded = torch.nn.functional.pad(power[:, None], (_WINDOW, _WINDOW), mode="circular")
    return torch.nn.functional.conv1d(padded, (window / window.sum())[None, None])[:, 0]


def _value(matrix: Tensor, u: Tensor) -> Tensor:
    """u^H M u, shape (trial,)."""
    return (u.conj() * (matrix @ u[..., None])[..., 0]).sum(-1).real


def _smallest(matrix: Tensor, start: Tensor) -> Tensor:
    """Phases, as exp(j phase), of the eigenvector of the smallest eigenvalue; inverse iteration."""
    n = start.shape[-1]
    ridge = 1e-6 * torch.diagonal(matrix, dim1=-2, dim2=-1).real.mean(-1)[:, None, None] + 1e-12
    lower = cholesky_factor(matrix + ridge * torch.eye(n, dtype=matrix.dtype, device=matrix.device))
    vector = start
    for _ in range(4):
        vector = torch.cholesky_solve(vector[..., None], lower)[..., 0]
        vector = vector / or_one(vector.abs().amax(-1, keepdim=True))
    size = vector.abs()
    return torch.where(size > 0, vector / or_one(size), 1)


def _newton(matrix: Tensor, u: Tensor, steps: int) -> Tensor:
    """Lower u^H M u by damped Newton steps of the phases of u."""
    value, diagonal = _value(matrix, u), torch.diagonal(matrix, dim1=-2, dim2=-1).real.mean(-1)
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
        reached = _value(matrix, trial)
        better = (failed == 0) & (reached <= value)
        u, value = torch.where(better[:, None], trial, u), torch.where(better, reached, value)
        damping = torch.where(better, damping / 5, damping * 10).clamp(1e-9, 1e3)
    return u


def _step(matrix: Tensor, u: Tensor) -> Tensor:
    """Newton step of the phases of u in rad, (trial, pulse), differentiable in the matrix."""
    turned = u.conj()[..., :, None] * matrix * u[..., None, :]
    slope = turned.sum(-1)
    bend = 2 * (turned.real - torch.diag_embed(slope.real)).detach()
    # a constant phase has no curvature and no slope
    ridge = 1e-6 * torch.diagonal(matrix, dim1=-2, dim2=-1).real.mean(-1).detach()
    eye = torch.eye(u.shape[-1], dtype=torch.float64, device=u.device)
    return -linear_solve(bend + ridge[:, None, None] * eye, 2 * slope.imag)


def _deviation(information: Tensor) -> Tensor:
    """Standard deviation of each phase in rad, (trial, pulse), without its straight line."""
    n = information.shape[-1]
    pulse = torch.linspace(-1, 1, n, dtype=torch.float64, device=information.device)
    line = torch.linalg.qr(torch.stack([torch.ones_like(pulse), pulse], -1)).Q
    eye = torch.eye(n, dtype=torch.float64, device=information.device)
    flat = eye - line @ line.mT
    covariance = flat @ matrix_inverse(information + _PRIOR * eye) @ flat
    return torch.diagonal(covariance, dim1=-2, dim2=-1).clamp_min(0).sqrt()
