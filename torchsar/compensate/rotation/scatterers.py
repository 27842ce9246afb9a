"""Joint maximum-likelihood estimation of the rotation of a target and of all its scatterers.

The unknowns are the amplitude, Doppler cell and range of each scatterer, and the common rotation.
Each round subtracts the model of all known scatterers from the data and takes one Gauss-Newton step
of all unknowns. Some rounds first find further scatterers in the image of the residual.

The Gauss-Newton matrix holds the inner products of the echoes of neighbouring scatterers. They are
computed without the range-dependent phase, which changes them by a few percent. This slows the
convergence, but leaves no error at the end, because the gradient follows from the exact residual.
For the same reason side lobes leave no error. The echoes are assumed to be range-compressed with a
flat spectrum that fills the whole band; whether their side lobes leave the window or return at its
other end is found from the data (`envelopes`).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.data import or_one
from torchsar.compensate.rotation.couplings import Neighbours, envelopes, inner_products
from torchsar.compensate.rotation.histories import OVERSAMPLING, find_peaks, inverted, noise_power, threshold
from torchsar.compensate.rotation.motion import Motion, Sampling, chosen, each, image_of, warped_time
from torchsar.core import power_of, real_dtype, reduced_turns, settle
from torchsar.focus.warped_sums import slow_times
from torchsar.radar.warp import least_rate

# largest number of scatterers, and number of steps, a compromise between accuracy and time
MOST, ROUNDS = 800, 12
# Iterations in which further scatterers are sought, and the fraction of the largest number up to
# which they are added. The brightest ones bring the rotation near the solution, and the iterations
# between let the fit converge.
_SEARCHES = {0: 0.1, 2: 0.6, 4: 1.0}
_SEARCHED = max(_SEARCHES)
# largest motion of a scatterer in one step, in cells; beyond it the model is not linear
_STEP = 0.3
# least share of the energy above the noise that the scatterers explain, found by trial: a lower
# share accepts wrong focus, a higher one rejects targets of many faint scatterers
LEAST_EXPLAINED = 0.5


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

    @property
    def count(self) -> Tensor:
        """Number of scatterers of each trial, shape (trial,)."""
        return (self.amplitude != 0).sum(-1)

    def apart(self) -> Scatterers:
        """Remove scatterers within half a Doppler cell and half a range cell of a brighter one.

        The amplitudes of two unresolved scatterers would grow without limit, with opposite phases,
        and bias the rotation.

        Returns:
            The scatterers, with zero amplitude for those removed.
        """
        level = self.amplitude.abs()
        near = ((self.cell[:, :, None] - self.cell[:, None]).abs() < 0.5) & (
            (self.row[:, :, None] - self.row[:, None]).abs() < 0.5
        )
        beside = (near & (level[:, None] > level[:, :, None])).any(-1)
        return replace(self, amplitude=torch.where(beside, 0, self.amplitude))


@dataclass(frozen=True)
class Fit:
    """State of the joint fit of a rotation and its scatterers.

    The estimated parameters of the rotation are its relative derivatives k1, k2, ..., the squared
    rate w and, if the rotation centre is estimated, the parameter v of `Motion`.

    Args:
        motion: Rotation of the target.
        scatterers: Scatterers.
        response: Share of the periodic range response (`envelopes`), shape (trial,).
        noise: Noise power per sample, shape (trial,).
        steps: Number of steps taken, shape (trial,).
        settled: True for trials that have ended, shape (trial,), bool.
        change: Change of the parameters of the rotation in the last step, shape (trial,
            parameter); infinite where the last step was not possible.
    """

    motion: Motion
    scatterers: Scatterers
    response: Tensor
    noise: Tensor
    steps: Tensor
    settled: Tensor
    change: Tensor


def explained_share(data: Tensor, fit: Fit) -> tuple[Tensor, Tensor]:
    """Compute how much of the energy of the data a fit explains.

    Args:
        data: Range-compressed pulses, shape (trial, pulse, range), complex.
        fit: The fit.

    Returns:
        The share of the energy above the noise that the scatterers explain, and the share of all
        energy that the scatterers and the noise explain, 0 to 1, shape (trial,) each.
    """
    present = (data != 0).any(-1).sum(-1)
    whole = torch.view_as_real(data).double().square().sum((-3, -2, -1)).clamp_min(torch.finfo(torch.float64).tiny)
    above = (whole - fit.noise * present * data.shape[-1]).clamp_min(1e-3 * whole)
    energy = fit.scatterers.amplitude.abs().square().sum(-1) * present
    explained = settle((energy / above).clamp(0, 1), 0.0)[0]
    return explained, 1 - (1 - explained) * above / whole


def fit_scatterers(
    data: Tensor,
    sampling: Sampling,
    start: Motion,
    *,
    count: int,
    free_centre: bool = True,
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
        count: Largest number of scatterers.
        free_centre: True also estimates the range of the rotation centre; False keeps that of
            `start`.
        rounds: Largest number of steps.

    Returns:
        The fit: rotation, scatterers and noise power.
    """
    present, device = (data != 0).any(-1), data.device
    empty = start.k.new_zeros(len(data), 0)
    fit = Fit(
        start,
        Scatterers(empty.to(torch.complex128), empty, empty),
        # initial share of the periodic range response, half way between 0 and 1
        start.w.new_full((len(data),), 0.5),
        start.w.new_full((len(data),), math.inf),
        torch.zeros(len(data), dtype=torch.int64, device=device),
        torch.zeros(len(data), dtype=torch.bool, device=device),
        start.k.new_zeros(len(data), start.k.shape[-1] + 1 + free_centre),
    )
    residual, step, near = data, None, Neighbours.find(fit.scatterers.amplitude, empty)
    for iteration in range(rounds + 1):
        share, noise, new = _SEARCHES.get(iteration), fit.noise, None
        if share or iteration > _SEARCHED:
            # if the residual of the last search was larger, its fit had not converged
            image = image_of(residual, sampling, fit.motion, oversampling=OVERSAMPLING if share else 1)
            power = power_of(image)
            brightest = power.flatten(1).amax(-1, keepdim=True) / sampling.pulses
            brightest = torch.cat([fit.scatterers.amplitude.abs().square(), brightest], -1).amax(-1)
            # Noise power per pixel; missing pulses add no noise. Errors of the model reach 1e-4 of
            # the power of the brightest scatterer, found by trial. Weaker noise does not limit the
            # fit, and residuals below that level are no scatterers and no evidence against one.
            floor = torch.maximum(noise_power(power).double(), 1e-4 * brightest)
            noise = torch.minimum(fit.noise, floor / present.double().mean(-1).clamp_min(1e-3))
            new = _new_scatterers(image, floor, sampling.pulses, fit, math.ceil(count * share)) if share else None
        if step is not None:
            fit = step.after(noise, sampling, iteration)
        if new is not None:
            found = each(lambda x, y: torch.cat([x, y], -1), fit.scatterers, new).apart()
            near = Neighbours.find(found.amplitude, found.cell)
            used = each(lambda x, width=near.shape[1]: x[:, :width], found)
            fit = replace(fit, scatterers=used, noise=noise)
        # No trial ends before the search is over. An accelerator should not wait for the decision
        # in every round.
        looks = iteration > _SEARCHED and (device.type == "cpu" or iteration % 2 == 0)
        if iteration == rounds or (looks and bool(fit.settled.all())):
            break
        residual, step = Step.of(data, sampling, fit, near, count)
    return fit


def _new_scatterers(image: Tensor, floor: Tensor, pulses: int, fit: Fit, bound: int) -> Scatterers:
    """Scatterers that clearly exceed the residual, of which at most `bound` are left per trial
    together with the known ones.
    """
    power = power_of(image)
    least = (floor * threshold(power[0].numel())).to(power.dtype)
    # The peaks have at least half of the largest amplitude within 24 lines and 2 range cells, found
    # by trial. Side lobes are thus excluded until their scatterer is subtracted.
    peak, line, row = find_peaks(power, least, bound, 0.5, 24, 2)
    wanted = torch.arange(peak.shape[-1], device=power.device) < (bound - fit.scatterers.count)[:, None]
    value = torch.gather(image.flatten(1), 1, line * image.shape[2] + row).to(torch.complex128)
    cell = (line - image.shape[1] // 2) / OVERSAMPLING
    return Scatterers(torch.where(wanted & (peak > 0), value / math.sqrt(pulses), 0), cell, row.to(torch.float64))


def _phasors(left: Tensor, right: Tensor, dtype: torch.dtype) -> Tensor:
    """Phasors exp(2j pi left @ right), (trial, pulse, scatterer), for a block of pulses.

    left: float64 (trial, pulse, 2), cycles per unit of right, (trial, 2, scatterer). The phase of
    one pulse in each group of 16 is computed in float64. The differences of the others from it are
    only a few cycles and are computed in the working precision. This is faster than
    `core.unit_phasor` of every element.
    """
    working, pulses, group = real_dtype(dtype), left.shape[1], 16
    near = torch.arange(pulses, device=left.device) // group * group + group // 2
    near = near.clamp_max(pulses - 1)
    begin = reduced_turns(left[:, near[::group]] @ right).to(working).repeat_interleave(group, 1)[:, :pulses]
    turns = torch.baddbmm(begin, (left - left[:, near]).to(working), right.to(working))
    angle = (turns - turns.round()) * (2 * math.pi)
    return torch.complex(torch.cos(angle), torch.sin(angle))


def _blocks(data: Tensor, scatterers: int) -> Iterator[tuple[slice, slice]]:
    """Trials and pulses of blocks whose phasors fit into the cache.

    The division of the pulses depends neither on the number of trials nor on the number of
    scatterers of other trials in a batch, so that sums are rounded alike.
    """
    trials, pulses, line = data.shape[0], data.shape[1], data.element_size() * max(1, scatterers)
    height = min(pulses, max(16, (1 << 19) // line))
    some = max(1, (1 << 19) // (line * height))
    for trial, first in itertools.product(range(0, trials, some), range(0, pulses, height)):
        yield slice(trial, trial + some), slice(first, first + height)


def solved(pull: Tensor, curvature: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Solve the Gauss-Newton equations of the rotation, see `Step.reduced`.

    Args:
        pull: Gradient of the likelihood that each scatterer contributes, shape (trial, scatterer,
            parameter).
        curvature: Curvature that each scatterer contributes, shape (trial, scatterer, parameter,
            parameter).

    Returns:
        The change of the parameters, shape (trial, parameter); the inverse of the whole curvature,
        shape (trial, parameter, parameter); and True for parameters that the data do not determine,
        shape (trial, parameter).
    """
    inverse, lost = inverted(curvature.sum(1))
    return (inverse @ pull.sum(1)[..., None])[..., 0], inverse, lost


@dataclass(frozen=True)
class Step:
    """Gradient and curvature of the likelihood with respect to all unknowns, at a fit.

    Args:
        fit: The fit.
        range_m: Range of the scatterers in metres, shape (trial, scatterer).
        near: Pairs of neighbouring scatterers.
        products: Inner products of their echoes over slow time, see `inner_products`.
        gram: Products of the bases 1, u, du/dk..., phi^2 of slow time, shape (trial, base, base).
        overlaps: Inner product over range cells of the range responses of each pair. Its
            derivatives with respect to the range of the second scatterer, of the first one, and of
            both. And the inner product of the derivatives of the responses with respect to the
            share of the periodic one.
        moments: Sums over pulses of base * conj(echo) * residual at the range of the scatterer,
            shape (trial, scatterer, base).
        shift: The same of base 1 with the derivative of the range response, shape (trial,
            scatterer).
        share: Gradient of the share of the periodic range response, shape (trial,).
    """

    fit: Fit
    range_m: Tensor
    near: Neighbours
    products: Mapping[tuple[int, int], Tensor]
    gram: Tensor
    overlaps: Sequence[Tensor]
    moments: Tensor
    shift: Tensor
    share: Tensor

    @staticmethod
    def of(data: Tensor, sampling: Sampling, fit: Fit, near: Neighbours, count: int) -> tuple[Tensor, Step]:
        """Subtract the model of all scatterers from the data and prepare the Gauss-Newton step.

        The data are processed in blocks of pulses, so that the echoes of up to `count` scatterers
        stay in the cache.

        Args:
            data: Range-compressed pulses, shape (trial, pulse, range), complex.
            sampling: Sampling of the data.
            fit: Current rotation and scatterers.
            near: Pairs of neighbouring scatterers.
            count: Largest number of scatterers.

        Returns:
            The residual, shape (trial, pulse, range), and the gradient and curvature for the step.
        """
        motion, found, present = fit.motion, fit.scatterers, (data != 0).any(-1)
        phi, u, slopes = warped_time(
            motion.k, slow_times(sampling.pulses, sampling.prf_hz, data.device), sampling.duration_s
        )
        square = 1 / sampling.wavelength_m * phi.square()
        rows = [torch.ones_like(u), u, *slopes.unbind(1), 2 * math.pi * square]
        bases = torch.stack(rows, 1) * present[:, None]
        range_m = sampling.range_m(found.row)
        turns = torch.stack([u, -square], -1)
        right = torch.stack([found.cell, motion.w[:, None] * range_m + motion.offset[:, None]], -2)
        value, slope, difference = envelopes(fit.response, found.row, sampling.cells)
        weighted = (found.amplitude[..., None] * value).conj().to(data.dtype).resolve_conj()
        back = value.mH.to(data.dtype).resolve_conj()
        # The bases are almost linearly dependent. With orthonormal ones, the small part that
        # determines the rotation is not lost in rounding.
        orthonormal, mixed = torch.linalg.qr(bases.mT)
        orthonormal = orthonormal.mT.to(data.real.dtype)
        residual, shift = torch.empty_like(data), data.new_zeros(value.shape)
        moments = bases.new_zeros(*bases.shape[:2], 2 * found.cell.shape[-1])
        for some, part in _blocks(data, count):
            # conjugate echoes of unit amplitude
            echoes = _phasors(turns[some, part], right[some], data.dtype)
            rest = (data[some, part] - (echoes @ weighted[some]).conj()) * present[some, part, None]
            residual[some, part] = rest
            projected = torch.view_as_real((rest @ back[some]) * echoes).flatten(-2)
            moments[some] += orthonormal[some, :, part] @ projected
            shift[some] += echoes.mT @ rest
        moments = torch.view_as_complex((mixed.mT @ moments).unflatten(-1, (-1, 2))).mT
        shift = shift.to(torch.complex128)
        share = (found.amplitude.conj() * (shift * difference.conj()).sum(-1)).real.sum(-1)
        products = inner_products(near, sampling, motion.k, found.amplitude, found.cell, bases)
        shift = (shift * slope.conj()).sum(-1)
        pairs = ((value, value), (value, slope), (slope, value), (slope, slope), (difference, difference))
        overlaps = [(one.conj() @ other.mT)[near.trial, near.first, near.second] for one, other in pairs]
        return residual, Step(fit, range_m, near, products, bases @ bases.mT, overlaps, moments, shift, share)

    def after(self, noise: Tensor, sampling: Sampling, iteration: int) -> Fit:
        """Take the Gauss-Newton step.

        Trials that have ended, and steps to a motion that reverses its direction, leave the fit
        unchanged.

        Args:
            noise: New noise power per sample, shape (trial,).
            sampling: Sampling of the data.
            iteration: Number of the round.

        Returns:
            The fit after the step.
        """
        old, found, late = self.fit, self.fit.scatterers, iteration >= _SEARCHED
        joint, pull, curvature = self.reduced(late)
        change, inverse, lost = solved(pull, curvature)
        change = change * self._within_reach(joint, change)
        if late:
            # A step that reverses a part of the previous one indicates oscillation, because the
            # curvature is an approximation. The factor, at least a half, is the limit of the
            # geometric sequence of such steps.
            whole = curvature.sum(1)
            size, back = (torch.einsum("bi,bij,bj->b", old.change, whole, x) for x in (old.change, change))
            change = change / (1 - (back / or_one(size)).nan_to_num(0.0).clamp(-1, 0))[:, None]
        own = joint[..., -1] - (joint[..., :-1] @ change[..., None])[..., 0]
        grow, turn, line, row = own.unflatten(-1, (4, -1)).unbind(-2)
        moved = Scatterers(
            found.amplitude * torch.complex(1 + grow, turn),
            found.cell + line.clamp(-_STEP, _STEP),
            (found.row + row.clamp(-_STEP, _STEP)).clamp(0, sampling.cells - 1),
        )
        motion = old.motion.moved(change)
        valid = torch.isfinite(change).all(-1) & motion.possible(sampling)
        # a slower motion would nearly reverse its rotation
        valid = valid & (least_rate(motion.k, sampling.duration_s) > 0.05)
        std = (inverse.diagonal(dim1=-2, dim2=-1).clamp_min(0) / 2).sqrt() * noise.sqrt()[:, None]
        std = torch.where(lost, math.inf, std).clamp_min(torch.finfo(torch.float64).tiny)
        small = (change.abs() / std).amax(-1) <= 0.2
        # Least squares for the share of the periodic range response. Both responses are equal where
        # scatterers lie in the middle of their cells, as all do after the first search. The small
        # ridge then keeps the share unchanged, which would otherwise follow rounding errors.
        energy = (self.products[(0, 0)] * (self.overlaps[4] + 1e-6 * self.overlaps[0])).real[:, None]
        share = torch.nan_to_num(self.share / self.near.per_scatterer(energy).sum((-2, -1)), 0.0, 0.0, 0.0)
        new = Fit(motion, moved.apart(), (old.response + share).clamp(0, 1), noise, old.steps, old.settled, change)
        # Where the step is not possible, the fit remains unchanged. The steps of trials that have
        # ended are not counted.
        new = replace(chosen(valid, new, old), noise=noise, change=torch.where(valid[:, None], change, math.inf))
        new = replace(new, steps=old.steps + 1, settled=valid & small & (iteration > _SEARCHED))
        return chosen(old.settled, old, new)

    def reduced(self, robust: bool) -> tuple[Tensor, Tensor, Tensor]:
        """Eliminate the unknowns of the scatterers.

        Args:
            robust: True gives less weight to a scatterer whose own phase disagrees with the common
                rotation, as that of several scatterers in one resolution cell does.

        Returns:
            The unknowns of the scatterers per unit of each parameter of the rotation and, in the
            last column, those for an unchanged rotation, shape (trial, 4 scatterer, parameter + 1).
            And the gradient and the curvature of the rotation, see `solved`.
        """
        slopes, solve = self._slopes(), _solver(self._local())
        found = self._without_scatterers(slopes, solve)
        if not robust:
            return found
        change = solved(*found[1:])[0]
        change = change * self._within_reach(found[0], change)
        return self._without_scatterers(slopes * self._agreement(slopes, change)[..., None, None], solve)

    def _without_scatterers(self, slopes: Tensor, solve: Callable[[Tensor], Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """Equations of the rotation after the unknowns of the scatterers are eliminated.

        slopes: phase coefficients of the parameters, see `_slopes`. solve: solver of the equations
        of the scatterers.
        """
        conjugate = self.fit.scatterers.amplitude.conj()
        cross, shared = self._shared(slopes)
        turned, moved = conjugate[..., None] * self.moments, (conjugate * self.shift).real
        own = torch.cat([turned[..., 0].real, turned[..., 0].imag, -2 * math.pi * turned[..., 1].imag, moved], -1)
        right = torch.cat([cross, own[..., None]], -1)
        joint = solve(right)
        lost = torch.einsum("brpi,brpj->bpij", joint[..., :-1].unflatten(1, (4, -1)), right.unflatten(1, (4, -1)))
        pull = torch.einsum("bpin,bpn->bpi", slopes, turned.imag) - lost[..., -1]
        return joint, pull, shared - lost[..., :-1]

    def _agreement(self, slopes: Tensor, change: Tensor) -> Tensor:
        """Weights 0 to 1 (trial, scatterer) that are smaller, the less the phase of a scatterer
        agrees with the step.

        The phase that remains after the step and the fit of the unknowns of the scatterer is
        measured in its standard deviations.
        """
        power = self.fit.scatterers.amplitude.abs().square()
        turned = (self.fit.scatterers.amplitude.conj()[..., None] * self.moments).imag
        project = inverted(self.gram[:, :2, :2])[0] @ self.gram[:, :2]
        curved = (self.gram - self.gram[:, :2].mT @ project)[:, 2:, 2:]
        wanted = torch.einsum("bpin,bi->bpn", slopes[..., 2:], change) @ curved * power[..., None]
        off = (turned - turned[..., :2] @ project)[..., 2:] - wanted
        size = (off @ inverted(curved)[0] * off).sum(-1) / torch.where(power > 0, power, 1)
        size = torch.where(power > 0, 2 * size / self.fit.noise[:, None], torch.nan)
        # errors that all scatterers have in common, such as those of pulse phases, must not give
        # weak ones more weight
        usual = (size.nanmedian(-1, keepdim=True).values / curved.shape[-1]).nan_to_num(1.0).clamp_min(1)
        # a phase may differ by 5 standard deviations before its weight decreases much, found by
        # trial
        return 1 / (1 + (size / (usual * 5.0**2)).nan_to_num(0.0))

    def _within_reach(self, joint: Tensor, change: Tensor) -> Tensor:
        """Factor (trial, 1) of a change that limits the Doppler by which it moves scatterers.

        Only scatterers with at least a tenth of the largest amplitude are limited, found by trial.
        """
        line = (joint[..., :-1] @ change[..., None])[..., 0].unflatten(-1, (4, -1))[:, 2].abs()
        level = self.fit.scatterers.amplitude.abs()
        bright = level > 0.1 * level.amax(-1, keepdim=True)
        return (_STEP / or_one(torch.where(bright, line, 0).amax(-1, keepdim=True))).clamp_max(1)

    def _local(self) -> Tensor:
        """Gauss-Newton curvature of the scatterers' unknowns, (trial, 4 scatterer, 4 scatterer).

        The unknowns are relative amplitude, phase, Doppler cell and range cell.
        """
        overlap, slope, back, bend, _ = self.overlaps
        products = self.products
        flat, line, bent = products[(0, 0)], 2 * math.pi * products[(0, 1)], 4 * math.pi**2 * products[(1, 1)]
        a, u, s, us, b, ub = (x * y for x, y in itertools.product((overlap, slope, back), (flat, line)))
        rows = [
            [a.real, -a.imag, u.imag, s.real],
            [a.imag, a.real, -u.real, s.imag],
            [-u.imag, -u.real, (bent * overlap).real, -us.imag],
            [b.real, -b.imag, ub.imag, (flat * bend).real],
        ]
        # element (i, j) of the 4 x 4 blocks, zero where two scatterers do not form a pair
        near, count = self.near, self.near.shape[1]
        local = a.real.new_zeros(near.shape[0], 4 * count, 4 * count)
        for (i, row), j in itertools.product(enumerate(rows), range(4)):
            local[near.trial, near.first + i * count, near.second + j * count] = row[j]
        diagonal = local.diagonal(dim1=-2, dim2=-1)
        # The ridge exceeds the rounding of float64. The diagonal is zero where there is no
        # scatterer, or only one range cell, which does not determine range.
        diagonal += torch.where(diagonal > 0, 1e-9 * diagonal, 1.0)
        return local

    def _slopes(self) -> Tensor:
        """Phase of the echo of each scatterer per unit of each common unknown, as coefficients of
        the bases, (trial, scatterer, unknown, base).
        """
        motion, cell = self.fit.motion, self.fit.scatterers.cell
        order, size = motion.k.shape[-1], self.fit.change.shape[-1]
        slopes = cell.new_zeros(*cell.shape, size, order + 3)
        slopes[..., :order, 2:-1] = -2 * math.pi * cell[..., None, None] * torch.eye(order, device=cell.device)
        slopes[..., order, -1] = self.range_m + motion.centre_m[:, None]
        slopes[..., order + 1 :, -1] = 1
        return slopes

    def _shared(self, slopes: Tensor) -> tuple[Tensor, Tensor]:
        """Curvature between scatterers and common unknowns, (trial, 4 scatterer, unknown), and
        curvature of the common unknowns.

        The second one is given as sums over the pairs of each scatterer, (trial, scatterer,
        unknown, unknown).
        """
        near, bases, (overlap, _, back, *_) = self.near, range(2, slopes.shape[-1]), self.overlaps
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


def _solver(matrix: Tensor) -> Callable[[Tensor], Tensor]:
    """Function that solves the equations of the unknowns of the scatterers, for right-hand sides
    (trial, 4 scatterer, n).

    In trials in which rounding has made the matrix indefinite, the equations of each scatterer are
    solved separately.
    """
    factor, info = torch.linalg.cholesky_ex(matrix)
    own = matrix.unflatten(2, (4, -1)).unflatten(1, (4, -1)).diagonal(dim1=2, dim2=4).movedim(-1, 1)
    inverse = torch.linalg.inv_ex(own).inverse

    def solve(right: Tensor) -> Tensor:
        joint = torch.cholesky_solve(right, factor)
        alone = torch.einsum("bpij,bjpn->bipn", inverse, right.unflatten(1, (4, -1)))
        return torch.where((info != 0)[:, None, None], alone.flatten(1, 2), joint)

    return solve
