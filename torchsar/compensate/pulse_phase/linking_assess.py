"""Assessment of linked phases: whether they can be trusted, and how exact they are.

The questions are those of the module `assess`, in terms of the likelihood:

1. Is the gain over white noise more than that of phases fitted to noise? 2. Is a sparse description
of the scene not likelier? 3. Do parts of the range cells, each evaluated with the spectra of the
others, give the same phases? 4. Do the pulses before and after every boundary belong to one scene?
5. Are the range profiles aligned?
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.alignment import LARGEST_JITTER, LARGEST_MIGRATION, coherent_jitter, displacement
from torchsar.compensate.pulse_phase.assess import LEAST_STREHL
from torchsar.compensate.pulse_phase.data import Pulses, or_one, pair_phase
from torchsar.compensate.pulse_phase.fixed_point import LogAbove, Run, fixed_point
from torchsar.compensate.pulse_phase.homogeneous import LEAST_LOOKS, describe, occupied_band
from torchsar.compensate.pulse_phase.imaging import AlongPulses
from torchsar.compensate.pulse_phase.likelihood import (
    PRIOR,
    Fit,
    Speckle,
    deviation,
    rms_of_pulses,
    without_line_matrix,
)
from torchsar.core import Outcome, fft_lines, power_of, worst


class Judged(NamedTuple):
    """Accuracy of linked phases, and quantities from which the outcome follows.

    Args:
        std: Standard deviation of the phase of each pulse in rad, (trial, pulse).
        alone: That by the range cells that share their spectrum with others, rms in rad, (trial,).
        excess: Factor by which the scatter of these cells exceeds the bound, infinite where their
            curvature does not hold the phases, (trial,).
        shift: Distance in rad rms by which these cells move the phases, (trial,).
        rows: Effective number of these cells, (trial,).
        boundary: Least coherence of pulses across a boundary relative to the prediction, (trial,).
    """

    std: Tensor
    alone: Tensor
    excess: Tensor
    shift: Tensor
    rows: Tensor
    boundary: Tensor


def judged(scene: Speckle, u: Tensor, fit: Fit, still: bool) -> Judged:
    """Compute the deviation of linked phases and the other fields of `Judged`.

    The Fisher information assumes that all cells of a group have the same spectrum, and that the
    fitted one is correct. But cells of few scatterers each have a spectrum of their own, and a
    spectrum that is fitted to few cells adapts to slow phase errors. Here each cell gives a Newton
    step of the phases, with spectra and a curvature that are fitted to other cells. The squares of
    the steps add up to a variance ("sandwich" of curvature and scatter).

    Args:
        scene: The pulses.
        u: Phases as exp(j phase), shape (trial, pulse).
        fit: The fit to all range cells.
        still: True if scatterers do not change and the caller confirms the phases, as by several
            starts; the Cramer-Rao bound then is the deviation.

    Returns:
        The deviation and what it rests on.

    Reference:
        White, Maximum likelihood estimation of misspecified models, Econometrica 50(1), 1982.
    """
    each = scene.information_each(fit)
    independent = scene.independent_share(u, fit, each)
    information = scene.summed(each)
    boundary = _weakest_boundary(fit.matrix, u, information)
    energy = torch.stack([power_of(own).sum(-2) for own, *_ in scene.groups]).sum(0)
    if still:
        std = deviation(independent[:, None, None] * information)
        alone, one = rms_of_pulses(std, scene.present), torch.ones_like(boundary)
        return Judged(std, alone, one, 0 * one, _effective(energy), boundary)
    looks = [
        scene.independent_share(u, fit, each, slice(k, k + 1)) * cells for k, (*_, cells) in enumerate(scene.groups)
    ]
    # The fitted phases absorb a part of the noise of a small group, whose information is then
    # overestimated. It is reduced by 1 - 1 / n^2 for n independent cells and is zero for one. The
    # square was found by trial.
    each = [own * (1 - count.clamp_min(1) ** -2)[:, None, None] for own, count in zip(each, looks, strict=True)]
    sharing = [count >= LEAST_LOOKS for count in looks]
    bend, slopes = _crossed(scene, u, fit, sharing)
    eye = torch.eye(u.shape[-1], dtype=torch.float64, device=u.device)
    lower, failed = torch.linalg.cholesky_ex(bend + PRIOR * eye)
    lower = torch.where((failed == 0)[:, None, None], lower, eye)
    steps = without_line_matrix(u.shape[-1], u.device) @ torch.cholesky_solve(slopes, lower)
    shared = [some[:, None, None] * own for some, own in zip(sharing, each, strict=True)]
    alone = rms_of_pulses(deviation(independent[:, None, None] * scene.summed(shared)), scene.present)
    scatter = (steps.square().sum(-1) / independent[:, None]).sqrt()
    some = energy * sum(
        here[:, None] * (own != 0).any(-2) for (own, *_), here in zip(scene.groups, sharing, strict=True)
    )
    # Cells that hold the side lobes of few points also have a common spectrum. In clutter with five
    # points of +15 dB, the cells that share it hold a quarter of the energy.
    known = (failed == 0) & (some.sum(-1) > 0.2 * energy.sum(-1))
    excess = torch.where(known, rms_of_pulses(scatter, scene.present) / or_one(alone), torch.inf)
    shift = torch.where(known, rms_of_pulses(steps.sum(-1), scene.present), torch.inf)
    std = deviation(independent[:, None, None] * scene.summed(each)) * excess.clamp_min(1)[:, None]
    return Judged(std, alone, excess, shift, _effective(some), boundary)


def _crossed(scene: Speckle, u: Tensor, fit: Fit, sharing: list[Tensor]) -> tuple[Tensor, Tensor]:
    """Curvature (trial, pulse, pulse) of the likelihood, and its gradient for each range cell
    (trial, pulse, range).

    The cells are divided into four parts. Each part is evaluated with the spectra fitted to the
    other three (cross-validation).
    """
    bend, slopes = torch.zeros_like(scene.groups[0][1].real), torch.zeros_like(scene.groups[0][0].real)
    cells = torch.arange(slopes.shape[-1], device=u.device)
    for part in cells.tensor_split(4):  # 2 to 8 parts predict nearly the same errors
        inside = torch.isin(cells, part).expand(len(u), -1)
        own_cells, others = scene.cells(inside), scene.cells(~inside)
        adapted = zip(others.adapted(u, fit), sharing, strict=True)
        crossed = others.fit([torch.where(some[:, None], spectrum, 1) for spectrum, some in adapted])
        turned = (u.conj()[:, :, None] * own_cells.matrix(crossed.inverses) * u[:, None, :]).real
        bend = bend + 2 * (turned - torch.diag_embed(turned.sum(-1)))
        for (own, *_), inverse in zip(own_cells.groups, crossed.inverses, strict=True):
            straight = own * u.conj()[..., None]
            slopes = slopes - 2 * (straight.conj() * (inverse.mT @ straight)).imag
    return bend, slopes


def outcome_of(
    pulses: Pulses, found: Judged, gain: Tensor, sparse: bool
) -> tuple[Tensor, Tensor, Tensor, dict[str, Tensor]]:
    """Derive outcome, standard deviation and quality of all trials.

    Args:
        pulses: The pulses.
        found: What they tell.
        gain: Log likelihood minus that of white noise in nats, shape (trial,).
        sparse: Whether to compare with a sparse description of the scene.

    Returns:
        Outcomes; standard deviations in rad, (trial, pulse); quality; and what is for reports;
        shape (trial,).
    """
    # Phases that were fitted to circular noise gained 1.1 to 2.3 nats per pulse, measured for 4 to
    # 192 range cells and 64 to 256 pulses. A scene must gain twice as much.
    noise = 2.0 * pulses.present.sum(-1)
    share = (1 - noise / or_one(gain)).clamp(0, 1)
    lost = torch.where(share > 0, or_one(share).rsqrt(), torch.inf)
    std = (found.std * lost[:, None]).clamp_max(PRIOR**-0.5)
    strehl = torch.exp(-rms_of_pulses(std, pulses.present).square())
    alone = found.alone * found.excess.clamp_min(1)
    # The rms error of a scene may exceed its standard deviation by a factor of 1.9, and by more
    # with fewer than 24 range cells. The errors of neighbouring pulses are correlated, and where
    # the spectrum has no edges, a slow phase error hardly changes it.
    spread = 1.9**2 * (24 / found.rows.clamp_min(1)).clamp_min(1)
    spectrum = fft_lines(pulses.rows)
    jitter, migration = displacement(spectrum, pulses.present)
    jitter = torch.maximum(jitter, coherent_jitter(pulses.rows, pulses.present))
    outcome = worst(
        (Outcome.INEXACT, spread * (lost * alone).square() >= -math.log(LEAST_STREHL)),
        (Outcome.PARTS_DISAGREE, found.shift >= 1.5 * alone),
        # The excess deviation was 0.8 to 1.1 in 90 % of the clutter scenes, and 1.2 to 9 where each
        # cell holds few scatterers. With more than 30 cells, the scatter predicts the errors
        # correctly in both cases.
        (Outcome.PARTS_DISAGREE, (found.excess >= 1.2) & (found.rows <= 30)),
        # the least coherence over all boundaries was 0.6 to 0.9 in homogeneous scenes, 0.1 to 0.5
        # in scenes that change at a pulse
        (Outcome.PARTS_DISAGREE, found.boundary <= 0.55),
        (Outcome.SPARSE, ~found.excess.isfinite()),
        (Outcome.DISPLACED, (jitter >= LARGEST_JITTER) | (migration >= LARGEST_MIGRATION)),
        (Outcome.NOISE, gain <= 2 * noise),
        (Outcome.EMPTY, ~pulses.present.any(-1)),
        (Outcome.SINGULAR, pulses.present.sum(-1) < 3),
    )
    if sparse:
        start, run = pair_phase(pulses.rows, pulses.present), Run(LogAbove(2.5), AlongPulses(), 60, 1.8, 0.01)
        sharp = fixed_point(pulses.rows, start, run)[0]
        sparse_gain, ratio = describe(pulses.rows, sharp, occupied_band(spectrum))
        outcome = torch.maximum(outcome, worst((Outcome.SPARSE, (gain <= sparse_gain) | (ratio <= 0))))
    info = {
        "excess_deviation": found.excess,
        "weakest_boundary": found.boundary,
        "jitter_cells": jitter,
        "migration_cells": migration,
    }
    return outcome, std, strehl * share, info


def _weakest_boundary(matrix: Tensor, u: Tensor, information: Tensor) -> Tensor:
    """Least coherence of the pulses before and after a boundary relative to that of the model,
    (trial,).

    The coherence is the part of the log likelihood that pairs of pulses across the boundary
    contribute. It would change its sign if the signs of all later pulses changed. Its expectation
    for a covariance R is that of u^H (R^-T o C) u, which is half of the Fisher information.
    Boundaries in the first and the last sixteenth of the pulses are left out.
    """
    skipped = u.shape[-1] // 16

    def across(pairs: Tensor) -> Tensor:
        sums = pairs.cumsum(-2).cumsum(-1)
        whole = sums[..., -1] - torch.diagonal(sums, dim1=-2, dim2=-1)
        return whole[:, skipped : whole.shape[-1] - 1 - skipped]

    found = across((u.conj()[:, :, None] * matrix * u[:, None, :]).real)
    expected = across(information) / 2
    return torch.where(expected < 0, found / torch.where(expected < 0, expected, -1), 1).amin(-1)


def _effective(energy: Tensor) -> Tensor:
    """Effective number of range cells that hold the energy (trial, range), shape (trial,)."""
    return energy.sum(-1).square() / or_one(energy.square().sum(-1))
