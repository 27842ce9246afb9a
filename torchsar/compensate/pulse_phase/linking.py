"""Phase linking: maximum likelihood phases of the pulses of a homogeneous scene.

A scene whose speckle fills a large part of the Doppler band has no sharp image, and methods that
sharpen the image end with wrong phases. The phases are well determined nevertheless: they and the
Doppler spectrum of the scene maximise a likelihood (module `likelihood`).
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.alignment import Displacement, coherent_jitter, displacement
from torchsar.compensate.pulse_phase.data import Pulses, or_one, prepare, starting_phase
from torchsar.compensate.pulse_phase.homogeneous import LEAST_LOOKS, describe, power_groups
from torchsar.compensate.pulse_phase.imaging import AlongPulses
from torchsar.compensate.pulse_phase.likelihood import (
    LEAST_ENERGY,
    PRIOR,
    Crossed,
    Fit,
    Speckle,
    deviation,
    lag_sums,
    newton,
    newton_step,
    rms_of_pulses,
)
from torchsar.compensate.pulse_phase.pairs import pair_phase
from torchsar.compensate.pulse_phase.sharpen import LogAbove, Run, fixed_point
from torchsar.compensate.pulse_phase.spectrum import smoothed_spectrum, windowed_spectrum
from torchsar.compensate.pulse_phase.verdict import LEAST_ROWS, LEAST_STREHL, occupied_band
from torchsar.core import Estimate, Outcome, cis, over_blocks, power_of

# Longest block whose phases are found by themselves, in pulses; bands of their first guesses as
# shares of the pulse rate.
_BLOCK, _WIDTHS = 32, (0.1, 0.25, 0.45, 0.65, 0.8, 0.9)
# Estimates of the spectrum of such a block, and of two blocks that were joined; those smoothed by a
# window, because the first phases are far off.
_ROUNDS, _JOINT_ROUNDS, _COARSE_ROUNDS = 8, 3, 2
# Triples of rounds with adapted spectra; longest extrapolation; change, as a share of the predicted
# standard deviation, that ends them.
_REFINEMENTS, _LONGEST, _SMALL = 6, 8.0, 0.3
# Gain of the log likelihood per pulse by which the phases fit circular noise: 1.1 to 2.3 nats were
# measured for 4 to 192 range cells and 64 to 256 pulses. A scene must gain twice as much.
_NOISE_NATS, _MARGIN = 2.0, 2.0
# The errors of neighbouring pulses depend on each other, and where the spectrum has no edges a slow
# phase error hardly changes it, so that the rms error of a scene may exceed its standard deviation
# by this factor.
_SPREAD = 1.9
# Range cells from which on the errors are so predictable; with fewer the factor is larger. Found by
# trial.
_CELLS = 24
# Excess of the deviation (see `Crossed`) up to which range cells of similar power have the same
# spectrum: it was 0.8 to 1.1 in 90 % of the scenes of clutter, 1.2 to 9 where each cell holds few
# scatterers. In that case only the scatter of many cells predicts the errors: where less than so
# many hold the energy, up to 6 % of scenes that change were wrong by more than five deviations.
_UNLIKE, _MANY_ROWS = 1.2, 30.0
_MOVED = 1.5  # deviations by which such cells may move the phases of all
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
        other count less, raised by the share of the likelihood that the phases gain on noise. The
        bound takes range cells of similar power to have one spectrum. Where each holds few
        scatterers, they have not; the deviation is therefore raised to what the scatter of the
        range cells shows, each judged by the spectra of others. A constant and a linear phase only
        add a phase to the image and shift it; they are left out of the standard deviation.
        `quality` is the predicted Strehl ratio times the share of the likelihood that noise does
        not explain. `ok` is judged by the range cells that have ten or more independent ones of
        similar power beside them. It is False where these hold less than a fifth of the energy, as
        in scenes of few points, for which `autofocus` is made; where the Strehl ratio for 1.9 times
        the standard deviation by these cells (more where fewer than 24 of them hold the energy) is
        below 0.8; where they alone would move the phases by 1.5 deviations; and where their scatter
        exceeds the bound by a factor of 1.2 and less than 30 of them hold the energy. It is also
        False where the gain in likelihood is below twice that of noise, the range profiles are not
        aligned (see `Displacement`), the pulses before and after a boundary are less than 0.55
        times as coherent as the spectra predict (where the scene changes, or pulses are copies of
        each other), adjacent pulses are not coherent in any ten range cells of similar power, or a
        sparse description of the scene with the phases that sharpen it is more likely. `info`
        holds, of shape (...,), "gain_nats" (log likelihood minus that of white noise), "fit_nats"
        (the same as if range cells were independent, by which phases of one scene compare),
        "excess_deviation" (that scatter over the bound, infinite where it is not known),
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
    return replace(
        found, outcome=torch.maximum(found.outcome, Outcome.of(likelier.reshape(pulses.trials), Outcome.SPARSE))
    )


def may_be_ok(rows: Tensor) -> Tensor:
    """Tell where linked phases may be ok: range cells of similar power are not too few.

    Args:
        rows: Pulses, shape (trial, range, pulse), complex.

    Returns:
        False where the range cells that have nine or more of similar power beside them hold less
        than a fifth of the energy, shape (trial,), bool.
    """
    energy = power_of(rows.detach()).sum(-1, dtype=torch.float64)
    groups = power_groups(energy)
    many = groups.sum(-1, keepdim=True) >= LEAST_LOOKS
    return (groups * many * energy).sum((0, -1)) > LEAST_ENERGY * energy.sum(-1)


def linked(pulses: Pulses, start: Tensor | None = None, still: bool = False) -> Estimate:
    """Estimate the phases of pulses that were checked; see `link_phases`.

    Args:
        pulses: The pulses.
        start: Phase to start from in rad, shape (trial, pulse), or None.
        still: True if scatterers do not change and the caller confirms the phases, as by several
            starts. The Cramer-Rao bound for one spectrum of similar range cells then is the
            deviation, also of few cells.

    Returns:
        The `Estimate` that `link_phases` returns.
    """
    rows, n = pulses.rows, pulses.n
    if not len(rows):
        none = torch.zeros(0, n, dtype=torch.float64, device=rows.device)
        each = none[:, 0]
        return _estimate(
            pulses, _Linked(none, none, each, each, each), Crossed(none, each, each, each), Displacement(each, each)
        )
    size = max(1, _BLOCK_BYTES // (16 * n * (6 * n + 2 * rows.shape[1])))
    parts = [slice(first, first + size) for first in range(0, len(rows), size)]
    done: dict[int, tuple[Tensor, ...]] = {}

    def work(part: slice) -> None:
        found, crossed = _linked(rows[part], pulses.present[part], None if start is None else start[part], still)
        moved = displacement(rows[part], pulses.present[part])
        jitter = torch.maximum(moved.jitter, coherent_jitter(rows[part], pulses.present[part]))
        done[part.start] = *found, *crossed, jitter, moved.migration

    if rows.requires_grad and torch.is_grad_enabled():
        for part in parts:
            work(part)
    else:
        with torch.no_grad():
            over_blocks(work, parts, rows)
    results = [torch.cat(pieces) for pieces in zip(*(done[part.start] for part in parts), strict=True)]
    return _estimate(pulses, _Linked(*results[:5]), Crossed(*results[5:9]), Displacement(*results[9:]))


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


def _estimate(pulses: Pulses, found: _Linked, crossed: Crossed, moved: Displacement) -> Estimate:
    phase, std, fit, gain, boundary = found
    real, trials = pulses.rows.real.dtype, pulses.trials
    noise = _NOISE_NATS * pulses.present.sum(-1)
    scene = (1 - noise / or_one(gain)).clamp(0, 1)
    lost = torch.where(scene > 0, or_one(scene).rsqrt(), torch.inf)
    std = (std * lost[:, None]).clamp_max(PRIOR**-0.5)
    strehl = torch.exp(-rms_of_pulses(std, pulses.present).square())
    alone = rms_of_pulses(crossed.std, pulses.present) * crossed.excess.clamp_min(1)
    spread = _SPREAD**2 * (_CELLS / crossed.rows.clamp_min(1)).clamp_min(1)
    fitted = (spread * (lost * alone).square() < -math.log(LEAST_STREHL)) & (crossed.shift < _MOVED * alone)
    fitted = fitted & ((crossed.excess < _UNLIKE) | (crossed.rows > _MANY_ROWS)) & (gain > _MARGIN * noise)
    fitted = fitted & (crossed.rows > LEAST_ROWS)
    return Estimate(
        {"phase_rad": phase.reshape(*trials, pulses.n).to(real)},
        {"phase_rad": std.reshape(*trials, pulses.n).to(real)},
        (strehl * scene).reshape(trials).to(real),
        Outcome.of((fitted & moved.aligned & (boundary > _LEAST_SHARE)).reshape(trials), Outcome.NOISE),
        info={
            "gain_nats": gain.reshape(trials),
            "fit_nats": fit.reshape(trials),
            "excess_deviation": crossed.excess.reshape(trials),
            "weakest_boundary": boundary.reshape(trials),
            "jitter_cells": moved.jitter.reshape(trials),
            "migration_cells": moved.migration.reshape(trials),
        },
    )


def _linked(rows: Tensor, present: Tensor, start: Tensor | None, still: bool) -> tuple[_Linked, Crossed]:
    """Link the pulses of a block of trials."""
    if rows.shape[-1] < 3:  # nothing to distinguish a phase error from a shift of the image
        zero = torch.zeros(present.shape, dtype=torch.float64, device=rows.device)
        none = zero[:, 0]
        return _Linked(zero, zero + torch.inf, none, none, none), Crossed(zero, none, none, none)
    with torch.no_grad():
        scene = Speckle.of(rows.detach(), present)
        u, fit = _refined(scene, _grown(scene) if start is None else cis(start.to(torch.float64)))
        each = scene.information_each(fit)
        information, independent = scene.summed(each), scene.independent_share(u, fit, each)
        gain = scene.gain(u, fit)
        if still:
            energy = power_of(rows).sum(-1, dtype=torch.float64)
            effective = energy.sum(-1).square() / or_one(energy.square().sum(-1))
            std = deviation(independent[:, None, None] * information)
            crossed = Crossed(std, torch.ones_like(effective), torch.zeros_like(effective), effective)
        else:
            looks = scene.looks(u, fit, each)
            # phases follow the noise of few cells and leave less of it, so that these seem to tell
            # more; one cell alone tells nothing, and the square was found by trial
            kept = [own * (1 - count.clamp_min(1) ** -2)[:, None, None] for own, count in zip(each, looks, strict=True)]
            crossed = scene.crossed(u, fit, kept, looks, independent)
            std = deviation(independent[:, None, None] * scene.summed(kept)) * crossed.excess.clamp_min(1)[:, None]
        gains = scene.independent * gain, independent * gain
        judged = std, *gains, _weakest_boundary(fit.matrix, u, information)
    if not rows.requires_grad or not torch.is_grad_enabled():
        return _Linked(torch.angle(u), *judged), crossed
    step = newton_step(Speckle.of(rows, present).matrix(fit.inverses), u)
    return _Linked(torch.angle(u) + step - step.detach(), *judged), crossed


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


def _grown(scene: Speckle) -> Tensor:
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


def _solved(blocks: Speckle) -> Tensor:
    """Phases of short blocks: those of greatest likelihood that are found from several bands.

    As many bands go together as fit into the memory of a block of trials.
    """
    count = len(blocks.samples)
    which = torch.arange(count, device=blocks.samples.device)
    together = max(1, _BLOCK_BYTES // max(1, sum(16 * own.numel() for own, *_ in blocks.groups)))
    found, gains = [], []
    for widths in torch.tensor(_WIDTHS, dtype=torch.float64, device=which.device).split(together):
        every = blocks.trials(which.repeat(len(widths)))
        u = every.start(widths.repeat_interleave(count))
        for number in range(_ROUNDS):
            smooth = windowed_spectrum if number < _COARSE_ROUNDS else smoothed_spectrum
            u = newton(every.fit(every.periodograms(u, smooth)).matrix, u)
        gain = every.gain(u, every.fit(every.periodograms(u, smoothed_spectrum)))
        found.append(u.unflatten(0, (-1, count)))
        gains.append(gain.unflatten(0, (-1, count)))
    best = torch.cat(gains).nan_to_num(-torch.inf).argmax(0)
    return torch.cat(found)[best, which]


def _joined(pairs: Speckle, u: Tensor) -> Tensor:
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

    sums = lag_sums(right.conj()[:, :, None] * matrix[:, half:, half:] * right[:, None, :])
    own = torch.fft.fft(torch.roll(torch.nn.functional.pad(sums, (0, slopes - sums.shape[-1])), 1 - half, -1)).real
    crossed = (left.conj()[:, None, :] @ matrix[:, :half, half:])[:, 0] * right
    mutual = slopes * torch.fft.ifft(crossed, slopes)
    best = (own - 2 * mutual.abs()).argmin(-1, keepdim=True)
    line = 2 * math.pi / slopes * best * torch.arange(half, device=u.device)
    u = torch.cat([left, -right * cis(line - torch.angle(mutual.gather(-1, best)))], -1)
    for _ in range(_JOINT_ROUNDS):
        u = newton(matrix, u)
        matrix = pairs.fit(pairs.periodograms(u, smoothed_spectrum)).matrix
    return u


def _refined(scene: Speckle, u: Tensor) -> tuple[Tensor, Fit]:
    """The phases of greatest likelihood for adapted spectra, and the fit with these spectra.

    Phases and spectra are found in turn. A smooth error of the phase widens the spectrum, and the
    wider spectrum hardly opposes it; three rounds are therefore extrapolated (squared iteration)
    where that makes the phases more likely.
    """
    spectra = scene.periodograms(u, smoothed_spectrum)
    std = rms_of_pulses(deviation(scene.information(scene.fit(spectra))), scene.present)
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
