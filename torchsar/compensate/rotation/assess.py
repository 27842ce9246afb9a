"""Assessment of an estimated rotation by the scatterers of the image.

The entropy of an image does not show whether a rotation is right: noise has a sharpest image as
well. Five questions are asked.

- Does anything in the image rise above the noise (`Outcome.NOISE`), and are there at least three
scatterers that show the rotation (`Outcome.TOO_FEW`)?
- Are the scatterers seen during the whole aperture, and do they explain half of the energy
(`Outcome.MISFIT`)?
- Does any scatterer ask for another rotation: do the phase histories of bright scatterers agree
with it (`Outcome.PARTS_DISAGREE`)?
- Has the fit converged (`Outcome.NOT_CONVERGED`)?
- How far do the scatterers differ? Their differences, and the noise, give the standard deviations
(`Outcome.INEXACT`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Tensor

from torchsar.compensate.rotation.couplings import Neighbours
from torchsar.compensate.rotation.histories import Histories, histories_of, refined_by_histories, threshold
from torchsar.compensate.rotation.image_entropy import k_name
from torchsar.compensate.rotation.motion import Motion, Sampling, image_of, warped_time
from torchsar.compensate.rotation.scatterers import LEAST_EXPLAINED, Fit, Step, explained_share, solved
from torchsar.core import Estimate, Outcome, worst
from torchsar.focus.warped_sums import slow_times
from torchsar.metrics import entropy

# largest phase error, in rad rms, of a scatterer at the edge of the target: it then still has a
# Strehl ratio of 0.8, the convention of Marechal
MOST_PHASE_ERROR_RAD = math.sqrt(-math.log(0.8))
# least number of scatterers from which the rotation is determined reliably, by convention
_LEAST_SCATTERERS = 3
_CLEAR = 1.3  # factor over the detection threshold: noise alone exceeds it in one of 1000 images


def judged_motion(rows: Tensor, sampling: Sampling, motion: Motion, value: Mapping[str, Tensor]) -> Estimate:
    """Assess the relative derivatives of the rotation rate of a rotation.

    The rotation is refined by the histories of bright scatterers, and compared with the result. The
    phase error that is expected of the scatterer farthest from zero Doppler follows from the change
    and its covariance. A rotation of a lower order is compared
    with one of third order, since its own order cannot show what it leaves out.

    Args:
        rows: Range-compressed pulses, shape (trial, pulse, range), complex.
        sampling: Sampling of the data.
        motion: Rotation to be judged.
        value: Values of the estimate by name.

    Returns:
        The assessed estimate. Its quality is the relative decrease of
        exp(entropy) of the image due to the compensation; info holds `phase_error_rad`,
        `scatterers` and the entropies.
    """
    third = replace(motion, k=torch.nn.functional.pad(motion.k, (0, max(0, 2 - motion.k.shape[-1]))))
    refined = third
    for _ in range(2):  # two refinements, enough for an image that is still blurred
        refined = refined_by_histories(rows, sampling, refined)
    found = histories_of(rows, sampling, refined)
    error, reasons = _questioned(sampling, third, refined, found)
    entropies, quality = _entropies(rows, sampling, motion)
    info = {**entropies, "phase_error_rad": error, "scatterers": found.used.sum(-1)}
    outcome = worst(
        *reasons,
        (Outcome.PARTS_DISAGREE, error >= MOST_PHASE_ERROR_RAD),
        (Outcome.NOISE, found.level < _CLEAR),
        (Outcome.EMPTY, (rows == 0).flatten(1).all(-1)),
    )
    return Estimate(value, {}, quality, outcome, info)


def judged_fit(rows: Tensor, sampling: Sampling, fit: Fit, value: Mapping[str, Tensor]) -> Estimate:
    """Assess a joint fit of a rotation and its scatterers.

    The step that the fit would take next is computed. Its curvature and the noise give a covariance
    (Fisher information). The scatter of the changes that single scatterers would make gives another
    one. Both are averaged, the second with the weight of the number of independent scatterers.
    Scatterers that are not found disturb the others: standard deviations are divided by the share
    of the energy that is accounted for.

    Args:
        rows: Range-compressed pulses, shape (trial, pulse, range), complex.
        sampling: Sampling of the data.
        fit: The fit.
        value: Values of the estimate by name.

    Returns:
        The assessed estimate. Its quality is the share of the energy above the noise that the
        scatterers
        explain.
    """
    found, motion, order = fit.scatterers, fit.motion, fit.motion.k.shape[-1]
    explained, accounted = explained_share(rows, fit)
    near = replace(Neighbours.find(found.amplitude, found.cell), shape=found.cell.shape)
    _, equations = Step.of(rows, sampling, fit, near, found.amplitude.shape[-1])
    _, pull, curvature = equations.reduced(robust=True)
    change, inverse, lost = solved(pull, curvature)
    tiny = torch.finfo(torch.float64).tiny
    covariance = inverse / 2 * fit.noise[:, None, None]
    predicted = covariance.diagonal(dim1=-2, dim2=-1).clamp_min(tiny)
    # shares: part of the information about each parameter that a scatterer contributes.
    # own: change of the parameters from the residual of one scatterer.
    # alike: assumed correlation of the errors of two scatterers, Gaussian over 8 cells in Doppler
    # and 2 in range. Close scatterers share model errors. By trial, few adjacent ones in Doppler
    # have large errors of opposite sign.
    lines, cells = (
        ((x[:, :, None] - x[:, None]) / reach).square() for x, reach in ((found.cell, 8.0), (found.row, 2.0))
    )
    used, power = (found.amplitude != 0).double(), found.amplitude.abs().square()
    alike = torch.exp(-(lines + cells) / 2) * used[:, :, None] * used[:, None]
    shares = torch.einsum("bpij,bin,bjn->bpn", curvature, inverse, inverse)
    shares = shares / shares.sum(1, keepdim=True).clamp_min(tiny)
    own = (pull - torch.einsum("bpij,bj->bpi", curvature, change)) @ inverse
    seen = (own * (alike @ own)).sum(1) / predicted
    number = 1 / (shares * (alike @ shares)).sum(1).clamp_min(tiny)
    # The variance from the noise has the weight of two scatterers, found by trial, because a
    # variance from the scatter of a few is uncertain by a factor.
    wider = (number * seen + 2 + number.clamp_max(predicted.shape[-1])) / (number + 2) + change.square() / predicted
    wider = wider.sqrt() / accounted.clamp_min(1e-6)[:, None]
    covariance = covariance * wider[:, :, None] * wider[:, None] + torch.diag_embed(torch.where(lost, math.inf, 0.0))
    std = _standard_deviations(motion, covariance, fit.change.shape[-1] > order + 1)
    step = (fit.change.abs() / predicted.sqrt()).amax(-1)
    # a step is small below three standard deviations, or if it changes phases by less than 0.01 rad
    moving = (step > 3) & (step * (fit.noise / (2 * power.sum(-1) * sampling.pulses).clamp_min(tiny)).sqrt() > 0.01)
    level = power.amax(-1) * sampling.pulses / (fit.noise * threshold(2 * rows[0].numel())).clamp_min(tiny)
    error, reasons = _questioned(sampling, motion, motion, histories_of(rows, sampling, motion))
    outcome = worst(
        *reasons,
        # An error of 10 % of the rate, a convention for scaling images, must exceed 2.7 standard
        # deviations, because the standard deviation of a rate that is too large is too small.
        (Outcome.INEXACT, (2.7 * std["omega_rad_s"] >= 0.1 * motion.omega_rad_s) | (motion.w <= 0)),
        # the limit is doubled because phase histories are less accurate than the fit
        (Outcome.PARTS_DISAGREE, error >= 2 * MOST_PHASE_ERROR_RAD),
        (Outcome.MISFIT, explained < LEAST_EXPLAINED),
        (Outcome.NOT_CONVERGED, moving),
        # a single independent scatterer that determines the rate may be a peak of the noise
        (Outcome.TOO_FEW, (found.count < _LEAST_SCATTERERS) | (number[:, order] < 1.3)),
        (Outcome.NOISE, level < _CLEAR),
        (Outcome.EMPTY, (rows == 0).flatten(1).all(-1)),
    )
    return Estimate(value, std, explained, outcome, _entropies(rows, sampling, motion)[0])


def _questioned(
    sampling: Sampling, judged: Motion, refined: Motion, found: Histories
) -> tuple[Tensor, list[tuple[Outcome, Tensor]]]:
    """Expected phase error in rad, rms over the aperture, of a scatterer at the edge, (trial,); and
    the doubts about it.

    The error follows from the difference of two rotations and the covariance of that difference.
    Constant and linear phases only displace a scatterer and are left out.
    """
    count, order = found.used.sum(-1), judged.k.shape[-1]
    lag = found.pull.shape[-1] // 5  # number of samples of a history with correlated errors
    # With few scatterers, the scatter between them underestimates the variance. The scatter of the
    # samples within each history is therefore added.
    own = lag * torch.einsum("bpij,bpkj->bik", found.pull, found.pull)
    pull = found.pull.sum(-1)
    free = count / (count - found.inverse.shape[-1]).clamp_min(0.1)  # degrees of freedom of the fit
    covariance = found.inverse @ (pull.mT @ pull * free[:, None, None] + own) @ found.inverse
    edge = 2 * math.pi * torch.where(found.used, found.cells.abs(), 0).amax(-1)
    _, u, slopes = warped_time(
        judged.k, slow_times(sampling.pulses, sampling.prf_hz, judged.k.device), sampling.duration_s
    )
    line = torch.stack([torch.ones_like(u), u - u.mean(-1, keepdim=True)], 1)
    line = line / line.square().sum(-1, keepdim=True).sqrt()
    curves = slopes - (slopes @ line.mT) @ line
    size, change = curves @ curves.mT / sampling.pulses, refined.k - judged.k + found.change[:, :order]
    moved = torch.einsum("bi,bij,bj->b", change, size, change).clamp_min(0)
    unsure = (size * covariance[:, :order, :order]).sum((-2, -1)).clamp_min(0)
    few = (count < _LEAST_SCATTERERS) | (edge <= 2 * math.pi)
    dark = found.least_lit < 0.35  # noise at the detection threshold gives 0.25
    error = torch.nan_to_num(edge * (moved + unsure).sqrt(), math.inf, math.inf)
    return torch.where(few | dark, math.inf, error), [(Outcome.MISFIT, dark), (Outcome.TOO_FEW, few)]


def _entropies(rows: Tensor, sampling: Sampling, motion: Motion) -> tuple[dict[str, Tensor], Tensor]:
    """Entropies of the image with and without compensation, and relative decrease of exp(entropy),
    0 to 1.
    """
    after, before = entropy(image_of(rows, sampling, motion)), entropy(torch.fft.fft(rows, 2 * rows.shape[-2], dim=-2))
    named = {"entropy_nats": after, "uncompensated_entropy_nats": before}
    return named, (1 - torch.exp((after - before).double())).clamp(0, 1)


def _standard_deviations(motion: Motion, covariance: Tensor, free_centre: bool) -> dict[str, Tensor]:
    """Standard deviations of the values, from the covariance of (k, w, v).

    They are infinite where the data do not determine a value.
    """
    order, w = motion.k.shape[-1], torch.where(motion.w > 0, motion.w, 0)
    k, ww = covariance.diagonal(dim1=-2, dim2=-1)[:, :order].clamp_min(0).sqrt(), covariance[:, order, order]
    yc, moved = torch.zeros_like(w), motion.yc_m - motion.centre_m
    if free_centre:
        yc = covariance[:, -1, -1] - 2 * moved * covariance[:, order, -1] + moved.square() * ww
        yc = yc.clamp_min(0).sqrt() / w
    named = {
        "omega_rad_s": ww.clamp_min(0).sqrt() / (2 * w.sqrt()),
        "warp_k": k,
        **{k_name(i + 1): column for i, column in enumerate(k.unbind(-1))},
        "yc_m": yc,
    }
    return {name: torch.where(torch.isnan(value), math.inf, value) for name, value in named.items()}
