"""Maximum likelihood of the motion and of every scatterer together: amplitude, Doppler cell and
range of each, and the rotation that all share.

Each round removes the model of all scatterers known so far from the data, finds further ones in the
image of what is left, and takes a Gauss-Newton step of everything at once: amplitudes and places of
all scatterers and the motion, with the couplings of those next to each other. Steps come from the
exact residual, so that neighbours and side lobes leave no error at the end; what range terms change
in the curvature, a few percent, is left out. Assumes range-compressed echoes of a flat band that
fills the cells (`band_response`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchsar.compensate.rotation.couplings import Pairs, band_response
from torchsar.compensate.rotation.histories import inverted, solved
from torchsar.compensate.rotation.motion import Motion, Sampling, Warped, image_of
from torchsar.compensate.rotation.peaks import find_peaks, noise_power, threshold
from torchsar.core import real_dtype, reduced_turns
from torchsar.core.warp import least_rate

_OVERSAMPLING = 2
# a new scatterer is at least this part of the brightest about it
_SHARE, _LINES, _CELLS = 0.5, 24, 2
MOST, ROUNDS = 800, 6
_FEWEST = 128
# of the data for each scatterer, so that a fit costs as much as some twenty images
_SAMPLES_EACH = 1450
_SEARCHES = {
    0: 0.1,
    2: 0.6,
    4: 1.0,
    # rounds that look for further scatterers, up to which part of all: the brightest alone bring
    # the
    # motion near; the rounds between settle what was found
}
_BLOCK_BYTES = 1 << 19
_APART = 0.5  # cells, in Doppler and in range
_STEP = 0.3  # cells that a scatterer moves at most in a step
_RIDGE = 1e-3
_LEAST_RATE = 0.05
_AGREES = 5.0  # deviations by which the curvature of a scatterer may lie off
_SETTLED = 0.2  # of its deviation: steps of the motion below it end a trial


@dataclass(frozen=True)
class Scatterers:
    """(trial, scatterer): complex128 amplitude (0: none), Doppler cell and range cell, float64."""

    amplitude: Tensor
    cell: Tensor
    row: Tensor

    @staticmethod
    def none(like: Tensor) -> Scatterers:
        empty = torch.zeros(like.shape[0], 0, dtype=torch.float64, device=like.device)
        return Scatterers(empty.to(torch.complex128), empty, empty)

    def joined(self, new: Scatterers, closed: Tensor) -> Scatterers:
        """These and the new ones; trials that are `closed` (trial,) take none."""
        added = torch.where(closed[:, None], 0, new.amplitude)
        return Scatterers(
            torch.cat([self.amplitude, added], -1),
            torch.cat([self.cell, new.cell], -1),
            torch.cat([self.row, new.row], -1),
        )

    def apart(self) -> Scatterers:
        """Without those that lie within the resolution of a brighter one: such pairs grow against
        each other without end, and pull the motion along.
        """
        level = self.amplitude.abs()
        near = ((self.cell[:, :, None] - self.cell[:, None]).abs() < _APART) & (
            (self.row[:, :, None] - self.row[:, None]).abs() < _APART
        )
        beside = (near & (level[:, None] > level[:, :, None])).any(-1)
        return replace(self, amplitude=torch.where(beside, 0, self.amplitude))


@dataclass(frozen=True)
class Fit:
    """Where a fit has come to.

    covariance: of (k1, k2, ..., w, v), the free ones, per unit noise power; noise: per sample,
    (trial,); steps: taken; last_step: largest of the shared unknowns, in their deviations,
    (trial,).
    """

    motion: Motion
    scatterers: Scatterers
    covariance: Tensor
    noise: Tensor
    steps: Tensor
    settled: Tensor
    last_step: Tensor


def fit_scatterers(
    data: Tensor,
    sampling: Sampling,
    start: Motion,
    *,
    free_centre: bool = True,
    count: int | None = None,
    rounds: int = ROUNDS,
) -> Fit:
    """Maximum likelihood from `start`, on data (trial, pulse, range); a trial ends when its motion
    moves by less than a fifth of its deviation.

    count: scatterers at most, which grow over the first rounds, by default one for every 1450
    samples, 128 to 800; rounds: steps at most.
    """
    count = min(MOST, max(_FEWEST, sampling.pulses * sampling.cells // _SAMPLES_EACH)) if count is None else count
    unknowns = _Unknowns(start.k.shape[-1], free_centre)
    present = (data != 0).any(-1)
    trials, device = data.shape[0], data.device
    noise = torch.full((trials,), math.inf, dtype=torch.float64, device=device)
    covariance = torch.zeros(trials, unknowns.size, unknowns.size, dtype=torch.float64, device=device)
    never = torch.zeros(trials, dtype=torch.bool, device=device)
    fit = Fit(start, Scatterers.none(data), covariance, noise, never.long(), never, noise)
    residual, step = data, None
    for turn in range(rounds + 1):
        new, noise = None, fit.noise
        if turn in _SEARCHES:
            new, noise = _standing_out(residual, sampling, fit, present, math.ceil(count * _SEARCHES[turn]))
        if step is not None:
            fit = _advanced(
                fit,
                step.taken(fit.noise if turn >= max(_SEARCHES) else None),
                noise,
                sampling,
                search_over=turn > max(_SEARCHES),
            )
        if new is not None:
            fit = replace(fit, scatterers=fit.scatterers.joined(new, fit.settled).apart(), noise=noise)
        if turn == rounds or bool(fit.settled.all()):
            break
        residual, step = _Step.of(data, sampling, fit, present, unknowns)
    return fit


@dataclass(frozen=True)
class _Unknowns:
    """What all scatterers share: as many k, the rate w, and v where the centre is free."""

    k: int
    centre: bool

    @property
    def size(self) -> int:
        return self.k + 1 + self.centre


def _standing_out(
    residual: Tensor, sampling: Sampling, fit: Fit, present: Tensor, bound: int
) -> tuple[Scatterers, Tensor]:
    """Scatterers that stand out of the residual, in no trial more than make `bound` with those that
    it has, and the noise power per sample (trial,).
    """
    image = image_of(residual, sampling, fit.motion, oversampling=_OVERSAMPLING)
    power = image.real.square() + image.imag.square()
    floor = noise_power(power).double()  # of a pixel: pulses that are not there bring none
    noise = torch.minimum(fit.noise, floor / present.double().mean(-1).clamp_min(1e-3))
    known = (fit.scatterers.amplitude != 0).sum(-1)
    peaks = find_peaks(power, (floor * threshold(power)).to(power.dtype), bound, _SHARE, _LINES, _CELLS).first(
        bound - known
    )
    value = torch.gather(image.flatten(1), 1, peaks.line * image.shape[2] + peaks.cell).to(
        torch.complex128
    ) / math.sqrt(sampling.pulses)
    cell, row = (peaks.line - image.shape[1] // 2) / _OVERSAMPLING, peaks.cell.to(torch.float64)
    return Scatterers(torch.where(peaks.power > 0, value, 0), cell, row), noise


def _envelopes(sampling: Sampling, row: Tensor) -> tuple[Tensor, Tensor]:
    """Responses of the range cells to scatterers at `row` and their derivatives in row, (trial,
    scatterer, range) complex128 each.
    """
    value, slope, _ = band_response(
        torch.arange(sampling.cells, dtype=row.dtype, device=row.device) - row[..., None], sampling.cells
    )
    return value, -slope


def _phasors(left: Tensor, right: Tensor, dtype: torch.dtype) -> Tensor:
    """exp(2j pi left @ right), (trial, pulse, scatterer), of a short block of pulses: its first
    pulse in float64, the differences from it, a few turns, in the working precision.

    left: float64 (trial, pulse, 2) turns per unit of right, (trial, 2, scatterer). Twice as fast as
    `core.unit_phasor` of every element.
    """
    working = real_dtype(dtype)
    begin = reduced_turns(left[:, :1] @ right).to(working)
    turns = torch.baddbmm(begin, (left - left[:, :1]).to(working), right.to(working))
    angle = (turns - turns.round()) * (2 * math.pi)
    return torch.complex(torch.cos(angle), torch.sin(angle))


@dataclass(frozen=True)
class _Step:
    """The residual's moments against what each unknown changes, and the curvature.

    moments: (trial, scatterer, base), sums over pulses of base * conj(echo) * residual at the
    scatterer's range, bases 1, u, du/dk..., phi^2; shift: the same of base 1 with the derivative of
    the envelope.
    """

    sampling: Sampling
    motion: Motion
    found: Scatterers
    unknowns: _Unknowns
    moments: Tensor
    shift: Tensor
    pairs: Pairs
    gram: Tensor

    @staticmethod
    def of(data: Tensor, sampling: Sampling, fit: Fit, present: Tensor, unknowns: _Unknowns) -> tuple[Tensor, _Step]:
        """The residual of the data and the step from it, in one pass over blocks of pulses whose
        echoes stay in the cache.
        """
        motion, found = fit.motion, fit.scatterers
        warped = Warped.of(motion.k, sampling.times(data.device), sampling.duration_s)
        square = 2 * math.pi * sampling.turns_per_square * warped.phi.square()
        bases = (
            torch.stack([torch.ones_like(warped.u), warped.u, *warped.slopes.unbind(1), square], 1) * present[:, None]
        )
        back_turns = torch.stack([warped.u, -sampling.turns_per_square * warped.phi.square()], -1)
        right = torch.stack([found.cell, motion.w[:, None] * sampling.range_m(found.row) + motion.offset[:, None]], -2)
        envelope, slope = _envelopes(sampling, found.row)
        weighted, back = (
            (found.amplitude[..., None] * envelope).conj().to(data.dtype).resolve_conj(),
            envelope.mH.to(data.dtype).resolve_conj(),
        )
        real_bases = bases.to(data.real.dtype)
        residual = torch.empty_like(data)
        moments = data.real.new_zeros(data.shape[0], bases.shape[1], 2 * found.cell.shape[-1])
        shift = data.new_zeros(envelope.shape)
        height = max(16, _BLOCK_BYTES // (data.element_size() * max(1, found.cell.numel())))
        for first in range(0, sampling.pulses, height):
            part = slice(first, first + height)
            turned_back = _phasors(back_turns[:, part], right, data.dtype)
            rest = (data[:, part] - (turned_back @ weighted).conj()) * present[:, part, None]
            residual[:, part] = rest
            moments += real_bases[:, :, part] @ torch.view_as_real((rest @ back) * turned_back).flatten(-2)
            shift += turned_back.mT @ rest
        moments = torch.view_as_complex(moments.unflatten(-1, (-1, 2)).to(torch.float64))
        shifts = (shift.to(torch.complex128) * slope.conj()).sum(-1)
        return residual, _Step(
            sampling,
            motion,
            found,
            unknowns,
            moments.mT,
            shifts,
            Pairs.find(sampling, motion.k, found.amplitude, found.cell, bases),
            bases @ bases.mT,
        )

    def taken(self, noise: Tensor | None = None) -> tuple[Motion, Scatterers, Tensor, Tensor]:
        """Motion and scatterers after the step, the step of the shared unknowns, and their
        covariance per unit noise power.

        noise: per sample (trial,); with it, scatterers whose own curvature disagrees with the step
        (several in one resolution cell) lose their say in rate and centre.
        """
        slopes, factor = self._slopes(), _Factor.of(self._local())
        found = self._solved(slopes, factor)
        if noise is None:
            return found
        slopes[..., self.unknowns.k :, -1] *= self._agreement(slopes, found[2], noise)[..., None]
        return self._solved(slopes, factor)

    def _agreement(self, slopes: Tensor, change: Tensor, noise: Tensor) -> Tensor:
        """Weights 0..1 (trial, scatterer) by how far the curvature of each scatterer alone lies
        from what the step gives it, in its deviations.
        """
        power = self.found.amplitude.abs().square()
        turned = (self.found.amplitude.conj()[..., None] * self.moments).imag
        project = inverted(self.gram[:, :2, :2])[0] @ self.gram[:, :2]
        curvature = (self.gram - self.gram[:, :2].mT @ project)[:, -1, -1, None].clamp_min(
            torch.finfo(torch.float64).tiny
        )
        own = (turned - turned[..., :2] @ project)[..., -1] / torch.where(power > 0, power, 1) / curvature
        off = own - torch.einsum("bpi,bi->bp", slopes[..., self.unknowns.k :, -1], change[:, self.unknowns.k :])
        return 1 / (1 + off.square() * 2 * power * curvature / noise[:, None] / _AGREES**2)

    def _solved(self, slopes: Tensor, factor: _Factor) -> tuple[Motion, Scatterers, Tensor, Tensor]:
        """The step for these coefficients of the shared unknowns."""
        found = self.found
        cross, shared = self._shared(slopes)
        turned = found.amplitude.conj()[..., None] * self.moments
        moved = (found.amplitude.conj() * self.shift).real
        own = torch.cat([turned[..., 0].real, turned[..., 0].imag, -2 * math.pi * turned[..., 1].imag, moved], -1)
        joint = factor.solve(torch.cat([cross, own[..., None]], -1))
        schur = shared - cross.mT @ joint[..., :-1]
        change = solved(schur, torch.einsum("bpin,bpn->bi", slopes, turned.imag) - (cross.mT @ joint[..., -1:])[..., 0])
        grow, turn, line, row = (
            (joint[..., -1] - (joint[..., :-1] @ change[..., None])[..., 0]).unflatten(-1, (4, -1)).unbind(-2)
        )
        amplitude = found.amplitude * torch.complex(1 + grow, turn)
        place = (found.row + row.clamp(-_STEP, _STEP)).clamp(0, self.sampling.cells - 1)
        return (
            self._moved(change),
            Scatterers(amplitude, found.cell + line.clamp(-_STEP, _STEP), place),
            change,
            _covariance(schur),
        )

    def _local(self) -> Tensor:
        """Gauss-Newton curvature of growth, turn, Doppler cell and row of all scatterers, (trial, 4
        scatterer, 4 scatterer).
        """
        overlap, slope, bend = self._overlaps()
        pairs = self.pairs
        flat, line, bent = (
            pairs.products[(0, 0)],
            2 * math.pi * pairs.products[(0, 1)],
            4 * math.pi**2 * pairs.products[(1, 1)],
        )
        a, u, s, us = flat * overlap, line * overlap, -flat * slope, -line * slope
        rows = [
            [a.real, -a.imag, u.imag, s.real],
            [a.imag, a.real, -u.real, s.imag],
            [-u.imag, -u.real, (bent * overlap).real, -us.imag],
            [-s.real, s.imag, -us.imag, -(flat * bend).real],
        ]
        local = pairs.matrix(rows)
        diagonal = local.diagonal(dim1=-2, dim2=-1)
        diagonal += torch.where(
            diagonal > 0, _RIDGE * diagonal, 1.0
        )  # no scatterer, or one range cell that tells nothing of range
        return local

    def _overlaps(self) -> tuple[Tensor, Tensor, Tensor]:
        """Inner product over range cells of the envelopes of each pair, and its derivatives."""
        row = self.found.row
        return band_response(self.pairs.of(row, 0) - self.pairs.of(row, 1), self.sampling.cells)

    def _shared(self, slopes: Tensor) -> tuple[Tensor, Tensor]:
        """Curvature between the scatterers' unknowns and the shared ones (trial, 4 scatterer,
        unknown), and of the shared ones (trial, unknown, unknown).
        """
        pairs = self.pairs
        overlap, slope, _ = self._overlaps()
        size = slopes.shape[-1]
        column, row = (
            slopes[pairs.trial, scatterer] for scatterer in (pairs.second, pairs.first)
        )  # (pair, unknown, base)
        seen, bowed = (
            sum(pairs.products[(base, n)][:, None] * column[..., n] for n in range(2, size)) for base in (0, 1)
        )
        parts = [
            -(seen * overlap[:, None]).imag,
            (seen * overlap[:, None]).real,
            -2 * math.pi * (bowed * overlap[:, None]).real,
            -(seen * slope[:, None]).imag,
        ]
        cross = torch.cat([pairs.per_scatterer(part) for part in parts], 1)
        shared = range(2, size)
        both = torch.stack(
            [
                (pairs.products[(n, m)] * overlap).real[:, None, None] * row[..., n, None] * column[:, None, :, m]
                for n in shared
                for m in shared
            ]
        ).sum(0)
        return cross, pairs.per_trial(both)

    def _moved(self, change: Tensor) -> Motion:
        order, motion = self.unknowns.k, self.motion
        v = motion.v + (change[:, -1] if self.unknowns.centre else 0)
        return replace(motion, k=motion.k + change[:, :order], w=motion.w + change[:, order], v=v)

    def _slopes(self) -> Tensor:
        """Coefficients of the bases in the phase per unit of each shared unknown, (trial,
        scatterer, unknown, base).
        """
        order, found = self.unknowns.k, self.found
        slopes = found.cell.new_zeros(*found.cell.shape, self.unknowns.size, order + 3)
        for i in range(order):
            slopes[..., i, 2 + i] = -2 * math.pi * found.cell
        slopes[..., order, -1] = self.sampling.range_m(found.row) + self.motion.centre_m[:, None]
        if self.unknowns.centre:
            slopes[..., -1, -1] = 1
        return slopes


@dataclass(frozen=True)
class _Factor:
    """A symmetric matrix (trial, n, n) made ready to solve with: its Cholesky factor, or None where
    rounding has left it indefinite.
    """

    matrix: Tensor
    factor: Tensor | None

    @staticmethod
    def of(matrix: Tensor) -> _Factor:
        factor, failed = torch.linalg.cholesky_ex(matrix)
        return _Factor(matrix, None if bool(failed.any()) else factor)

    def solve(self, right: Tensor) -> Tensor:
        return (
            torch.linalg.solve(self.matrix, right) if self.factor is None else torch.cholesky_solve(right, self.factor)
        )


def _covariance(normal: Tensor) -> Tensor:
    """Of the shared unknowns per unit noise power, infinite for those that nothing is known
    about.
    """
    inverse, lost = inverted(normal)
    return inverse / 2 + torch.diag_embed(torch.where(lost, math.inf, 0.0))


def _advanced(
    fit: Fit, taken: tuple[Motion, Scatterers, Tensor, Tensor], noise: Tensor, sampling: Sampling, search_over: bool
) -> Fit:
    """The fit after a step; settled trials, and steps to a motion that turns back, stay where they
    are.
    """
    motion, found, change, covariance = taken
    sane = (
        torch.isfinite(change).all(-1)
        & motion.possible(sampling)
        & (least_rate(motion.k, sampling.duration_s) > _LEAST_RATE)
    )
    deviation = covariance.diagonal(dim1=-2, dim2=-1).clamp_min(0).sqrt() * noise.sqrt()[:, None]
    step = torch.where(sane, (change.abs() / deviation.clamp_min(torch.finfo(torch.float64).tiny)).amax(-1), math.inf)
    active, old = ~fit.settled, fit.scatterers
    pick = (active & sane)[:, None]
    pairs = ((found.amplitude, old.amplitude), (found.cell, old.cell), (found.row, old.row))
    return Fit(
        motion=motion.where(active & sane, fit.motion),
        scatterers=Scatterers(*(torch.where(pick, new, before) for new, before in pairs)).apart(),
        covariance=torch.where(active[:, None, None], covariance, fit.covariance),
        noise=torch.where(active, noise, fit.noise),
        steps=fit.steps + active,
        settled=fit.settled | ((step <= _SETTLED) & search_over),
        last_step=torch.where(active, step, fit.last_step),
    )
