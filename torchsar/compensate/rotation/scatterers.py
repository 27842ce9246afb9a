"""Joint maximum-likelihood estimation of the rotation of a target and of all its scatterers.

The unknowns are the amplitude, Doppler cell and range of each scatterer, and the common rotation.
Each round subtracts the model of all known scatterers from the data and takes one Gauss-Newton step
of all unknowns. Some rounds first find further scatterers in the image of the residual.

The Gauss-Newton matrix holds the inner products of the echoes of neighbouring scatterers. They are
computed without the range-dependent phase, which changes them by a few percent. This slows the
convergence, but leaves no error at the end, because the gradient follows from the exact residual.
For the same reason side lobes leave no error. The echoes are assumed to be range-compressed with a
flat spectrum that fills the whole band; whether their side lobes leave the window or return at its
other end is found from the data (`RangeResponse`).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeAlias

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.data import or_one
from torchsar.compensate.rotation.couplings import Neighbours, inner_products
from torchsar.compensate.rotation.histories import inverted
from torchsar.compensate.rotation.motion import Motion, Sampling, Warped, image_of
from torchsar.compensate.rotation.peaks import find_peaks, noise_power, threshold
from torchsar.compensate.rotation.range_response import Envelopes, RangeResponse
from torchsar.core import power_of, real_dtype, reduced_turns
from torchsar.core.warp import least_rate

_OVERSAMPLING = 2  # image lines per Doppler cell, found by trial: accuracy of peaks against time
# a new scatterer has at least this share of the largest amplitude within so many lines and range
# cells, found by trial: side lobes are excluded until their scatterer is subtracted
_SHARE, _LINES, _CELLS = 0.5, 24, 2
MOST, ROUNDS = 800, 12  # largest number of scatterers, number of steps; accuracy against time
_FEWEST = 128  # default number of scatterers on small data, found by trial
# samples of the data per scatterer, so that a fit costs as much as about thirty images
_SAMPLES_EACH = 1000
# rounds that search for further scatterers, and the share of their number up to which they do: the
# brightest alone bring the motion near, and the rounds between let it converge
_SEARCHES = {0: 0.1, 2: 0.6, 4: 1.0}
_BLOCK_BYTES = 1 << 19  # phasors of a block of pulses that fit into the cache
_GROUP = 16  # pulses over which the phase of an echo changes by a few turns
# Doppler and range cells over which scatterers share errors of the model, found by trial: those of
# a few scatterers side by side in Doppler are large, with opposite signs
_SHARED_LINES, _SHARED_CELLS = 8.0, 2.0
_APART = 0.5  # Doppler and range cells within which scatterers are not resolved
_BRIGHT = 0.1  # share of the largest amplitude from which a scatterer limits a step, found by trial
_STEP = 0.3  # largest motion of a scatterer in one step, in cells: beyond it the model is not linear
_RIDGE = 1e-9  # added to the diagonal, relative: above the rounding of a matrix of float64
_ALIKE = 1e-6  # share of the energy of an echo by which the two range responses have to differ
_LEAST_RATE = 0.05  # least rate over that at the start; slower motions would nearly reverse
# standard deviations by which the phase of a scatterer may differ before it loses weight, found by
# trial
_AGREES = 5.0
# power of errors of the model over that of the brightest scatterer, found by trial: weaker noise
# does not limit the fit, and residuals below it are no scatterers and no evidence against one
_MODEL = 1e-4
# power over the detection threshold beyond which a scatterer cannot be a peak of the noise
_CERTAIN = 2.0
_LOOK = 2  # rounds after which an accelerator is asked whether all trials have ended
_SETTLED = 0.2  # steps of the motion below this share of its standard deviation end a trial


_Taken: TypeAlias = "tuple[Motion, Scatterers, Tensor, Tensor, Tensor, Tensor, Tensor]"


@dataclass(frozen=True)
class Scatterers:
    """Amplitudes and positions of the scatterers of every trial.

    Args:
        amplitude: Amplitude, shape (trial, scatterer), complex128; 0 where there is no scatterer.
        cell: Doppler cell, fractional, 0 at zero Doppler, shape (trial, scatterer), float64.
        row: Range cell, fractional, shape (trial, scatterer), float64.
    """

    amplitude: Tensor
    cell: Tensor
    row: Tensor

    @staticmethod
    def none(like: Tensor) -> Scatterers:
        """Make an empty set of scatterers.

        Args:
            like: Data, shape (trial, ...), which give the number of trials and the device.

        Returns:
            No scatterers: tensors of shape (trial, 0).
        """
        empty = torch.zeros(like.shape[0], 0, dtype=torch.float64, device=like.device)
        return Scatterers(empty.to(torch.complex128), empty, empty)

    def joined(self, new: Scatterers, closed: Tensor) -> Scatterers:
        """Append new scatterers to these.

        Args:
            new: The new scatterers.
            closed: True for trials that take no new scatterers, shape (trial,), bool.

        Returns:
            These scatterers, followed by the new ones.
        """
        added = torch.where(closed[:, None], 0, new.amplitude)
        return Scatterers(
            torch.cat([self.amplitude, added], -1),
            torch.cat([self.cell, new.cell], -1),
            torch.cat([self.row, new.row], -1),
        )

    def first(self, count: int) -> Scatterers:
        """Keep the first scatterers of every trial.

        Args:
            count: Number of scatterers to keep.

        Returns:
            The scatterers, shape (trial, count).
        """
        return Scatterers(self.amplitude[:, :count], self.cell[:, :count], self.row[:, :count])

    def apart(self) -> Scatterers:
        """Remove scatterers that lie within the resolution of a brighter one.

        The amplitudes of two unresolved scatterers would grow without limit, with opposite phases,
        and bias the rotation.

        Returns:
            The scatterers, with zero amplitude for those removed.
        """
        level = self.amplitude.abs()
        near = ((self.cell[:, :, None] - self.cell[:, None]).abs() < _APART) & (
            (self.row[:, :, None] - self.row[:, None]).abs() < _APART
        )
        beside = (near & (level[:, None] > level[:, :, None])).any(-1)
        return replace(self, amplitude=torch.where(beside, 0, self.amplitude))

    def alike(self) -> Tensor:
        """Compute how far the errors of scatterers depend on each other.

        Scatterers a few resolution cells apart share what the model does not describe.

        Returns:
            Weights from 0 (independent) to 1, shape (trial, scatterer, scatterer), float64; 0 where
            there is no scatterer.
        """
        scaled = ((self.cell, _SHARED_LINES), (self.row, _SHARED_CELLS))
        lines, rows = (((x[:, :, None] - x[:, None]) / reach).square() for x, reach in scaled)
        used = (self.amplitude != 0).double()
        return torch.exp(-(lines + rows) / 2) * used[:, :, None] * used[:, None]

    def effective_number(self) -> Tensor:
        """Count the independent scatterers over which the energy is spread.

        Returns:
            The number, shape (trial,), float64; 0 without scatterers.
        """
        power = self.amplitude.abs().square()
        spread = (power * (self.alike() @ power[..., None])[..., 0]).sum(-1)
        return power.sum(-1).square() / or_one(spread)


@dataclass(frozen=True)
class Fit:
    """State of the joint fit of a rotation and its scatterers.

    The estimated parameters of the rotation are its relative derivatives k1, k2, ..., the squared
    rate w and, if the rotation centre is estimated, the parameter v of `Motion`.

    Args:
        motion: Rotation of the target.
        scatterers: Scatterers.
        response: Range response.
        covariance: Covariance of the estimated parameters of the rotation for a noise power of 1,
            shape (trial, parameter, parameter); infinite variance where the data do not determine
            one.
        disagreement: Variance of the same parameters as the differences between scatterers show
            it, in absolute units, shape (trial, parameter). Errors of the model, such as several
            scatterers in one resolution cell, add to it. It is too small by the share of the
            differences that the fit takes up: the number of parameters over the number of
            scatterers.
        witnesses: Number of independent scatterers that contribute to each of these variances, by
            the rule of Welch and Satterthwaite, same shape.
        certain: Share of what the data show about each of these parameters that comes from
            scatterers too bright to be peaks of the noise, shape (trial, parameter).
        noise: Noise power per sample, shape (trial,).
        steps: Number of steps taken, shape (trial,).
        settled: True for trials that have ended, shape (trial,), bool.
        change: Change of the same parameters in the last step, shape (trial, parameter); infinite
            where the last step was not possible.
    """

    motion: Motion
    scatterers: Scatterers
    response: RangeResponse
    covariance: Tensor
    disagreement: Tensor
    witnesses: Tensor
    certain: Tensor
    noise: Tensor
    steps: Tensor
    settled: Tensor
    change: Tensor


def usual_count(sampling: Sampling) -> int:
    """Compute the largest number of scatterers by default: one for every 1000 samples of a trial.

    Args:
        sampling: Sampling of the data.

    Returns:
        The number, within 128..800.
    """
    return min(MOST, max(_FEWEST, sampling.pulses * sampling.cells // _SAMPLES_EACH))


def fit_scatterers(
    data: Tensor,
    sampling: Sampling,
    start: Motion,
    *,
    free_centre: bool = True,
    count: int | None = None,
    rounds: int = ROUNDS,
) -> Fit:
    """Fit the rotation of a target and all its scatterers by maximum likelihood.

    The first, third and fifth round search for further scatterers. Each round from then on measures
    the noise anew. From the fifth step on, a trial ends when a step changes each parameter of the
    rotation by at most a fifth of its standard deviation.

    Args:
        data: Range-compressed pulses, shape (trial, pulse, range), complex.
        sampling: Sampling of the data.
        start: Rotation to start from.
        free_centre: True also estimates the range of the rotation centre; False keeps that of
            `start`.
        count: Largest number of scatterers; by default one for every 1000 samples of a trial,
            within 128..800.
        rounds: Largest number of steps.

    Returns:
        The fit: rotation, scatterers, covariance and noise power.
    """
    count = usual_count(sampling) if count is None else count
    unknowns = _Unknowns(start.k.shape[-1], free_centre)
    present = (data != 0).any(-1)
    trials, device = data.shape[0], data.device
    noise = torch.full((trials,), math.inf, dtype=torch.float64, device=device)
    covariance = torch.zeros(trials, unknowns.size, unknowns.size, dtype=torch.float64, device=device)
    never = torch.zeros(trials, dtype=torch.bool, device=device)
    response = RangeResponse.of_unknown_share(trials, sampling.cells, device)
    zero = covariance.new_zeros(trials, unknowns.size)
    none = Scatterers.none(data)
    fit = Fit(start, none, response, covariance, zero, zero, zero, noise, never.long(), never, zero)
    residual, step, near = data, None, Neighbours.find(none.amplitude, none.cell)
    for iteration in range(rounds + 1):
        new, noise = None, fit.noise
        if iteration in _SEARCHES:
            new, noise = _new_scatterers(residual, sampling, fit, present, math.ceil(count * _SEARCHES[iteration]))
        elif iteration > max(_SEARCHES):
            # the residual of the last search was larger: the fit had not converged
            image = image_of(residual, sampling, fit.motion, oversampling=1)
            _, noise = _noise(power_of(image), sampling, fit, present)
        if step is not None:
            fit = _after_step(
                fit,
                step.taken(fit.noise if iteration >= max(_SEARCHES) else None),
                step.changed_response(),
                noise,
                sampling,
                search_over=iteration > max(_SEARCHES),
            )
        if new is not None:
            found = fit.scatterers.joined(new, fit.settled).apart()
            near = Neighbours.find(found.amplitude, found.cell)
            fit = replace(fit, scatterers=found.first(near.shape[1]), noise=noise)
        # no trial settles before the search is over; an accelerator should not wait in every round
        looks = iteration > max(_SEARCHES) and (device.type == "cpu" or iteration % _LOOK == 0)
        if iteration == rounds or (looks and bool(fit.settled.all())):
            break
        residual, step = _Step.of(data, sampling, fit, near, present, unknowns, count)
    return fit


@dataclass(frozen=True)
class _Unknowns:
    """The unknowns that all scatterers have in common.

    k terms of the warp, the rate w, and v if the centre is free.
    """

    k: int
    centre: bool

    @property
    def size(self) -> int:
        """Number of common unknowns."""
        return self.k + 1 + self.centre


def _new_scatterers(
    residual: Tensor, sampling: Sampling, fit: Fit, present: Tensor, bound: int
) -> tuple[Scatterers, Tensor]:
    """Scatterers that clearly exceed the residual, and the noise power per sample (trial,).

    At most `bound` per trial, including those already fitted.
    """
    image = image_of(residual, sampling, fit.motion, oversampling=_OVERSAMPLING)
    power = power_of(image)
    floor, noise = _noise(power, sampling, fit, present)
    known = (fit.scatterers.amplitude != 0).sum(-1)
    peaks = find_peaks(
        power, (floor * threshold(power[0].numel())).to(power.dtype), bound, _SHARE, _LINES, _CELLS
    ).first(bound - known)
    value = torch.gather(image.flatten(1), 1, peaks.line * image.shape[2] + peaks.cell).to(
        torch.complex128
    ) / math.sqrt(sampling.pulses)
    cell, row = (peaks.line - image.shape[1] // 2) / _OVERSAMPLING, peaks.cell.to(torch.float64)
    return Scatterers(torch.where(peaks.power > 0, value, 0), cell, row), noise


def _noise(power: Tensor, sampling: Sampling, fit: Fit, present: Tensor) -> tuple[Tensor, Tensor]:
    """Noise power of a pixel and of a sample, (trial,) each.

    power: that of the image of the residual. The noise power of a sample is at most that of the
    fit.
    """
    brightest = torch.cat(
        [fit.scatterers.amplitude.abs().square(), power.flatten(1).amax(-1, keepdim=True) / sampling.pulses], -1
    )
    # of a pixel; missing pulses add no noise
    floor = torch.maximum(noise_power(power).double(), _MODEL * brightest.amax(-1))
    return floor, torch.minimum(fit.noise, floor / present.double().mean(-1).clamp_min(1e-3))


def _phasors(left: Tensor, right: Tensor, dtype: torch.dtype) -> Tensor:
    """exp(2j pi left @ right), (trial, pulse, scatterer), for a block of pulses.

    left: float64 (trial, pulse, 2) turns per unit of right, (trial, 2, scatterer). One pulse of
    every few is computed in float64, the differences of its neighbours from it, a few turns, in the
    working precision. Faster than `core.unit_phasor` of every element.
    """
    working, pulses = real_dtype(dtype), left.shape[1]
    near = torch.arange(pulses, device=left.device) // _GROUP * _GROUP + _GROUP // 2
    near = near.clamp_max(pulses - 1)
    begin = reduced_turns(left[:, near[::_GROUP]] @ right).to(working).repeat_interleave(_GROUP, 1)[:, :pulses]
    turns = torch.baddbmm(begin, (left - left[:, near]).to(working), right.to(working))
    angle = (turns - turns.round()) * (2 * math.pi)
    return torch.complex(torch.cos(angle), torch.sin(angle))


def _blocks(data: Tensor, scatterers: int) -> Iterator[tuple[slice, slice]]:
    """Trials and pulses of blocks whose phasors fit into the cache.

    How pulses are divided does not depend on the number of trials, nor on how many scatterers the
    other trials of a batch have, so that sums round equally.
    """
    trials, pulses, line = data.shape[0], data.shape[1], data.element_size() * max(1, scatterers)
    height = min(pulses, max(16, _BLOCK_BYTES // line))
    some = max(1, _BLOCK_BYTES // (line * height))
    for trial in range(0, trials, some):
        for first in range(0, pulses, height):
            yield slice(trial, trial + some), slice(first, first + height)


@dataclass(frozen=True)
class _Step:
    """Gradient and curvature of the likelihood with respect to all unknowns.

    moments: (trial, scatterer, base), sums over pulses of base * conj(echo) * residual at the range
    of the scatterer, for the bases 1, u, du/dk..., phi^2. shift: the same of base 1 with the
    derivative of the envelope. last: the change of the common unknowns in the step before.
    """

    sampling: Sampling
    motion: Motion
    found: Scatterers
    unknowns: _Unknowns
    moments: Tensor
    shift: Tensor
    near: Neighbours
    products: Mapping[tuple[int, int], Tensor]
    gram: Tensor
    response: RangeResponse
    envelopes: Envelopes
    share: Tensor
    last: Tensor

    @staticmethod
    def of(
        data: Tensor,
        sampling: Sampling,
        fit: Fit,
        near: Neighbours,
        present: Tensor,
        unknowns: _Unknowns,
        count: int,
    ) -> tuple[Tensor, _Step]:
        """Subtract the model of all scatterers from the data and prepare the Gauss-Newton step.

        The data are processed in blocks of pulses, so that the echoes of up to `count` scatterers
        stay in the cache.

        Args:
            data: Range-compressed pulses, shape (trial, pulse, range), complex.
            sampling: Sampling of the data.
            fit: Current rotation and scatterers.
            near: Pairs of neighbouring scatterers.
            present: False for pulses without samples, shape (trial, pulse), bool.
            unknowns: Parameters of the rotation that are estimated.
            count: Largest number of scatterers.

        Returns:
            The residual, shape (trial, pulse, range), and the gradient and curvature for the step.
        """
        motion, found = fit.motion, fit.scatterers
        warped = Warped.of(motion.k, sampling.times(data.device), sampling.duration_s)
        square = 2 * math.pi * sampling.turns_per_square * warped.phi.square()
        bases = (
            torch.stack([torch.ones_like(warped.u), warped.u, *warped.slopes.unbind(1), square], 1) * present[:, None]
        )
        back_turns = torch.stack([warped.u, -sampling.turns_per_square * warped.phi.square()], -1)
        right = torch.stack([found.cell, motion.w[:, None] * sampling.range_m(found.row) + motion.offset[:, None]], -2)
        envelopes = fit.response.envelopes(found.row)
        envelope = envelopes.value
        weighted, back = (
            (found.amplitude[..., None] * envelope).conj().to(data.dtype).resolve_conj(),
            envelope.mH.to(data.dtype).resolve_conj(),
        )
        # the bases are almost linearly dependent: with orthonormal ones the small part that shows
        # the rotation is not lost in rounding
        orthonormal, mixed = torch.linalg.qr(bases.mT)
        orthonormal = orthonormal.mT.to(data.real.dtype)
        residual = torch.empty_like(data)
        moments = bases.new_zeros(data.shape[0], bases.shape[1], 2 * found.cell.shape[-1])
        shift = data.new_zeros(envelope.shape)
        for some, part in _blocks(data, count):
            turned_back = _phasors(back_turns[some, part], right[some], data.dtype)
            rest = (data[some, part] - (turned_back @ weighted[some]).conj()) * present[some, part, None]
            residual[some, part] = rest
            projected = torch.view_as_real((rest @ back[some]) * turned_back).flatten(-2)
            moments[some] += orthonormal[some, :, part] @ projected
            shift[some] += turned_back.mT @ rest
        moments = torch.view_as_complex((mixed.mT @ moments).unflatten(-1, (-1, 2)))
        shift = shift.to(torch.complex128)
        shifts = (shift * envelopes.slope.conj()).sum(-1)
        share = (found.amplitude.conj() * (shift * envelopes.difference.conj()).sum(-1)).real.sum(-1)
        return residual, _Step(
            sampling,
            motion,
            found,
            unknowns,
            moments.mT,
            shifts,
            near,
            inner_products(near, sampling, motion.k, found.amplitude, found.cell, bases),
            bases @ bases.mT,
            fit.response,
            envelopes,
            share,
            fit.change,
        )

    def taken(self, noise: Tensor | None = None) -> _Taken:
        """Take the Gauss-Newton step.

        Args:
            noise: Noise power per sample, shape (trial,). If it is given, a scatterer whose own
                phase disagrees with the common rotation, as that of several scatterers in one
                resolution cell does, gets less weight in the rotation.

        Returns:
            The rotation and the scatterers after the step; the change of the parameters of the
            rotation, shape (trial, unknown); their covariance per unit noise power, shape (trial,
            unknown, unknown); their variance from the differences between scatterers, and the
            number of scatterers that contribute to it, shape (trial, unknown) each; and the share
            of each scatterer in what the data show about them, shape (trial, scatterer, unknown).
        """
        slopes, factor = self._slopes(), _Factor.of(self._local())
        found = self._solved(slopes, factor)
        if noise is None:
            return found
        return self._solved(slopes * self._agreement(slopes, found[2], noise)[..., None, None], factor, damped=True)

    def _agreement(self, slopes: Tensor, change: Tensor, noise: Tensor) -> Tensor:
        """Weights 0..1 (trial, scatterer) by how well the phase of a scatterer fits the step.

        What the step and the unknowns of the scatterer itself leave of the phase is measured in its
        standard deviations.
        """
        power = self.found.amplitude.abs().square()
        turned = (self.found.amplitude.conj()[..., None] * self.moments).imag
        project = inverted(self.gram[:, :2, :2])[0] @ self.gram[:, :2]
        curved = (self.gram - self.gram[:, :2].mT @ project)[:, 2:, 2:]
        wanted = torch.einsum("bpin,bi->bpn", slopes[..., 2:], change) @ curved * power[..., None]
        off = (turned - turned[..., :2] @ project)[..., 2:] - wanted
        size = (off @ inverted(curved)[0] * off).sum(-1) / torch.where(power > 0, power, 1)
        size = torch.where(power > 0, 2 * size / noise[:, None], torch.nan)
        # errors that all scatterers share, as those of pulse phases, must not favour weak ones
        usual = (size.nanmedian(-1, keepdim=True).values / curved.shape[-1]).nan_to_num(1.0).clamp_min(1)
        return 1 / (1 + (size / (usual * _AGREES**2)).nan_to_num(0.0))

    def _solved(self, slopes: Tensor, factor: _Factor, damped: bool = False) -> _Taken:
        """The step for these coefficients of the common unknowns.

        damped: shorten a step that reverses the one before.
        """
        found = self.found
        cross, shared = self._shared(slopes)
        turned = found.amplitude.conj()[..., None] * self.moments
        moved = (found.amplitude.conj() * self.shift).real
        own = torch.cat([turned[..., 0].real, turned[..., 0].imag, -2 * math.pi * turned[..., 1].imag, moved], -1)
        joint = factor.solve(torch.cat([cross, own[..., None]], -1))
        # curvature and gradient of each scatterer, without what the unknowns of scatterers take up
        taken_up = torch.einsum(
            "brpi,brpj->bpij",
            joint[..., :-1].unflatten(1, (4, -1)),
            torch.cat([cross, own[..., None]], -1).unflatten(1, (4, -1)),
        )
        curvature, pull = shared - taken_up[..., :-1], torch.einsum("bpin,bpn->bpi", slopes, turned.imag)
        pull = pull - taken_up[..., -1]
        normal = curvature.sum(1)
        inverse, lost = inverted(normal)
        change = (inverse @ pull.sum(1)[..., None])[..., 0]
        informed = torch.einsum("bpij,bin,bjn->bpn", curvature, inverse, inverse)
        rest = pull - torch.einsum("bpij,bj->bpi", curvature, change)
        # share of each scatterer, with those that it is not independent of, in the variances
        moved_by, alike = rest @ inverse, found.alike()
        spread = moved_by * (alike @ moved_by)
        disagreement = spread.sum(1)
        change = change * self._within_reach((joint[..., :-1] @ change[..., None])[..., 0])[:, None]
        if damped:
            change = change * self._without_reversal(change, normal)[:, None]
        grow, turn, line, row = (
            (joint[..., -1] - (joint[..., :-1] @ change[..., None])[..., 0]).unflatten(-1, (4, -1)).unbind(-2)
        )
        amplitude = found.amplitude * torch.complex(1 + grow, turn)
        position = (found.row + row.clamp(-_STEP, _STEP)).clamp(0, self.sampling.cells - 1)
        return (
            self._moved(change),
            Scatterers(amplitude, found.cell + line.clamp(-_STEP, _STEP), position),
            change,
            inverse / 2 + torch.diag_embed(torch.where(lost, math.inf, 0.0)),  # infinite if undetermined
            disagreement,
            disagreement.square() / or_one((spread * (alike @ spread)).sum(1)),
            informed / or_one(informed.sum(1, keepdim=True)),
        )

    def _without_reversal(self, change: Tensor, normal: Tensor) -> Tensor:
        """Factor (trial,) of a step that goes back a part of the last one.

        Such steps would go back and forth, since the curvature is an approximation. The factor is
        that which ends a geometric sequence of steps, at least a half.
        """
        size = torch.einsum("bi,bij,bj->b", self.last, normal, self.last)
        ratio = torch.einsum("bi,bij,bj->b", self.last, normal, change) / or_one(size)
        return 1 / (1 - ratio.nan_to_num(0.0).clamp(-1, 0))

    def _within_reach(self, moved: Tensor) -> Tensor:
        """Factor (trial,) of the common step that limits the Doppler by which it moves scatterers.

        moved: change (trial, 4 scatterer) of the scatterers' unknowns that belongs to the step.
        """
        level, line = self.found.amplitude.abs(), moved.unflatten(-1, (4, -1))[:, 2].abs()
        bright = level > _BRIGHT * level.amax(-1, keepdim=True)
        return (_STEP / or_one(torch.where(bright, line, 0).amax(-1))).clamp_max(1)

    def _local(self) -> Tensor:
        """Gauss-Newton curvature of the scatterers' unknowns, (trial, 4 scatterer, 4 scatterer).

        The unknowns are relative amplitude, phase, Doppler cell and range cell.
        """
        overlap, slope, back, bend = self._overlaps
        products = self.products
        flat, line, bent = products[(0, 0)], 2 * math.pi * products[(0, 1)], 4 * math.pi**2 * products[(1, 1)]
        a, u, s, us, b, ub = (x * y for x, y in itertools.product((overlap, slope, back), (flat, line)))
        rows = [
            [a.real, -a.imag, u.imag, s.real],
            [a.imag, a.real, -u.real, s.imag],
            [-u.imag, -u.real, (bent * overlap).real, -us.imag],
            [b.real, -b.imag, ub.imag, (flat * bend).real],
        ]
        local = self.near.matrix(rows)
        diagonal = local.diagonal(dim1=-2, dim2=-1)
        # zero without a scatterer, or with one range cell, which does not determine range
        diagonal += torch.where(diagonal > 0, _RIDGE * diagonal, 1.0)
        return local

    @cached_property
    def _overlaps(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Inner product over range cells of the envelopes of each pair, and its derivatives.

        The derivatives are those with respect to the range of the second scatterer, of the first
        one, and of both.
        """
        value, slope = self.envelopes.value, self.envelopes.slope
        factors = ((value, value), (value, slope), (slope, value), (slope, slope))
        return tuple(self._over_range(*pair) for pair in factors)  # pyright: ignore[reportReturnType]

    def _over_range(self, first: Tensor, second: Tensor) -> Tensor:
        """Inner product of functions (trial, scatterer, range) of the scatterers of each pair."""
        return (first.conj() @ second.mT)[self.near.trial, self.near.first, self.near.second]

    def changed_response(self) -> RangeResponse:
        """Fit the share of the periodic range response to the residual by least squares.

        Both responses are the same where scatterers lie in the middle of their cells, as all do
        after the first search: the share then stays as it is, instead of following rounding.
        """
        apart, (overlap, *_) = self.envelopes.difference, self._overlaps
        energy = (self.products[(0, 0)] * (self._over_range(apart, apart) + _ALIKE * overlap)).real[:, None, None]
        total = self.near.per_trial(energy)[:, 0, 0]
        return self.response.moved(self.share / total)

    def _shared(self, slopes: Tensor) -> tuple[Tensor, Tensor]:
        """Curvature between scatterers and common unknowns, and of the common unknowns.

        (trial, 4 scatterer, unknown) and, as sums over the pairs of each scatterer, (trial,
        scatterer, unknown, unknown).
        """
        near, bases = self.near, range(2, slopes.shape[-1])
        overlap, _, back, _ = self._overlaps
        columns = slopes[near.trial, near.second].unbind(-1)[2:]

        def summed(base: int, part: Callable[[Tensor], Tensor], envelopes: Tensor = overlap) -> Tensor:
            weighted = (part(self.products[(base, n)] * envelopes)[:, None] * columns[n - 2] for n in bases)
            return near.per_scatterer(sum(weighted, torch.zeros_like(columns[0])))

        parts = [
            -summed(0, torch.imag),
            summed(0, torch.real),
            -2 * math.pi * summed(1, torch.real),
            -summed(0, torch.imag, back),
        ]
        shared = torch.stack([summed(base, torch.real) for base in bases], -1)
        return torch.cat(parts, 1), torch.einsum("bpin,bpjn->bpij", slopes[..., 2:], shared)

    def _moved(self, change: Tensor) -> Motion:
        """The motion after a step of the common unknowns."""
        order, motion = self.unknowns.k, self.motion
        v = motion.v + (change[:, -1] if self.unknowns.centre else 0)
        return replace(motion, k=motion.k + change[:, :order], w=motion.w + change[:, order], v=v)

    def _slopes(self) -> Tensor:
        """Coefficients of the bases in the phase per unit of each common unknown.

        (trial, scatterer, unknown, base).
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
    """Curvature of the scatterers' unknowns (trial, 4 scatterer, 4 scatterer), factorised.

    factor: Cholesky factors. own: inverse curvature of each scatterer alone, (trial, scatterer, 4,
    4). failed: True for trials whose matrix rounding has made indefinite.
    """

    factor: Tensor
    own: Tensor
    failed: Tensor

    @staticmethod
    def of(matrix: Tensor) -> _Factor:
        """Factorise matrices."""
        factor, info = torch.linalg.cholesky_ex(matrix)
        own = matrix.unflatten(2, (4, -1)).unflatten(1, (4, -1)).diagonal(dim1=2, dim2=4).movedim(-1, 1)
        return _Factor(factor, torch.linalg.inv_ex(own).inverse, info != 0)

    def solve(self, right: Tensor) -> Tensor:
        """Solutions for right-hand sides (trial, 4 scatterer, n).

        In trials that failed those of each scatterer on its own.
        """
        alone = torch.einsum("bpij,bjpn->bipn", self.own, right.unflatten(1, (4, -1))).flatten(1, 2)
        return torch.where(self.failed[:, None, None], alone, torch.cholesky_solve(right, self.factor))


def _after_step(
    fit: Fit,
    taken: _Taken,
    response: RangeResponse,
    noise: Tensor,
    sampling: Sampling,
    search_over: bool,
) -> Fit:
    """The fit after a step.

    Trials that have ended, and steps to a motion that reverses its direction, leave the fit
    unchanged.
    """
    motion, found, change, covariance, disagreement, witnesses, shares = taken
    least = _CERTAIN * threshold(_OVERSAMPLING * sampling.pulses * sampling.cells) * noise / sampling.pulses
    bright = found.amplitude.abs().square() > least[:, None]
    # what depends on a bright scatterer counts with it: how they divide their share is arbitrary
    certain = (shares * (found.alike() * bright[:, None]).amax(-1, keepdim=True)).sum(1)
    valid = (
        torch.isfinite(change).all(-1)
        & motion.possible(sampling)
        & (least_rate(motion.k, sampling.duration_s) > _LEAST_RATE)
    )
    std = covariance.diagonal(dim1=-2, dim2=-1).clamp_min(0).sqrt() * noise.sqrt()[:, None]
    step = (change.abs() / std.clamp_min(torch.finfo(torch.float64).tiny)).amax(-1)
    active, old = ~fit.settled, fit.scatterers
    pick = (active & valid)[:, None]
    pairs = ((found.amplitude, old.amplitude), (found.cell, old.cell), (found.row, old.row))
    return Fit(
        motion=motion.where(active & valid, fit.motion),
        scatterers=Scatterers(*(torch.where(pick, new, before) for new, before in pairs)).apart(),
        response=response.where(active & valid, fit.response),
        covariance=torch.where(active[:, None, None], covariance, fit.covariance),
        disagreement=torch.where(active[:, None], disagreement, fit.disagreement),
        witnesses=torch.where(active[:, None], witnesses, fit.witnesses),
        certain=torch.where(active[:, None], certain, fit.certain),
        noise=torch.where(active, noise, fit.noise),
        steps=fit.steps + active,
        settled=fit.settled | (valid & (step <= _SETTLED) & search_over),
        change=torch.where(active[:, None], torch.where(valid[:, None], change, math.inf), fit.change),
    )
