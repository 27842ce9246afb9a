"""Whether an estimated rotation is right, as the scatterers of the image show it.

The entropy of an image does not show it: noise has a sharpest image as well.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.data import or_one
from torchsar.compensate.rotation.histories import LEAST_SCATTERERS, change_by_histories, refined_by_histories
from torchsar.compensate.rotation.motion import Motion, Sampling, Warped
from torchsar.compensate.rotation.scatterers import Fit, fit_scatterers
from torchsar.core import settle

# largest phase error, in rad rms, of a scatterer at the edge of the target: it then still has a
# Strehl ratio of 0.8, the convention of Marechal
MOST_PHASE_ERROR_RAD = math.sqrt(-math.log(0.8))
# least share of the energy above the noise that the scatterers explain, found by trial: a lower
# share accepts wrong focus, a higher one rejects targets of many faint scatterers
LEAST_EXPLAINED = 0.5
# last step of a fit that has converged, in standard deviations or as a phase of the scatterers in
# rad, found by trial
_REST_STDS, _REST_RAD = 3.0, 0.01
_TO_GO = 0.25  # distance that is left after the last step over that step, found by trial
# scatterers that outweigh the variance that the noise explains: a variance that a few of them show
# is uncertain by a factor, found by trial
_FEW = 2.0
_WRONG_FOCUS = 2.0  # phase error over `MOST_PHASE_ERROR_RAD` of a wrong focus, found by trial
_LEAST_ORDER = 3  # least order of the rotation with which another is compared, that of the paper
_CHECKS = 2  # refinements of a rotation to be judged: enough for an image that is still blurred


class Focus(NamedTuple):
    """Whether a joint fit has found the rotation of its target.

    Args:
        right: True where at least 3 scatterers are found, they explain half of the energy or more,
            their histories do not contradict the fit, and it has converged, shape (trial,), bool.
        explained: Share of the energy above the noise that the scatterers explain, 0 to 1, shape
            (trial,).
        accounted: Share of all energy that the scatterers and the noise explain, 0 to 1, shape
            (trial,).
        edge_rad: Largest Doppler of bright scatterers as a phase over the aperture in rad, shape
            (trial,); infinite where they do not determine the rotation.
    """

    right: Tensor
    explained: Tensor
    accounted: Tensor
    edge_rad: Tensor


def focus_of(rows: Tensor, sampling: Sampling, fit: Fit) -> Focus:
    """Judge a joint fit of a rotation and its scatterers.

    Args:
        rows: Range-compressed pulses, shape (trial, pulse, range), complex.
        sampling: Sampling of the data.
        fit: The fit.

    Returns:
        The verdict.
    """
    found = (fit.scatterers.amplitude != 0).sum(-1)
    present = (rows != 0).any(-1).sum(-1)
    energy = fit.scatterers.amplitude.abs().square().sum(-1) * present
    power = torch.view_as_real(rows).double().square().sum((-3, -2, -1)).clamp_min(torch.finfo(torch.float64).tiny)
    above = (power - fit.noise * present * rows.shape[-1]).clamp_min(1e-3 * power)
    explained = settle((energy / above).clamp(0, 1), 0.0)[0]
    accounted = 1 - (1 - explained) * above / power
    tiny = torch.finfo(torch.float64).tiny
    predicted = fit.covariance.diagonal(dim1=-2, dim2=-1) * fit.noise[:, None]
    step = (fit.change.abs() / predicted.clamp_min(tiny).sqrt()).amax(-1)
    converged = (step <= _REST_STDS) | (step * (fit.noise / (2 * energy.clamp_min(tiny))).sqrt() <= _REST_RAD)
    # histories are less accurate than the fit: they only exclude a wrong focus
    change, covariance, edge, _ = change_by_histories(rows, sampling, fit.motion)
    confirmed = _phase_error(sampling, fit.motion, change, covariance, edge) < _WRONG_FOCUS * MOST_PHASE_ERROR_RAD
    right = (found >= LEAST_SCATTERERS) & confirmed & (explained >= LEAST_EXPLAINED) & converged
    return Focus(right, explained, accounted, edge)


def covariance_of(fit: Fit, accounted: Tensor) -> Tensor:
    """Compute the covariance of the parameters of the rotation of a joint fit.

    The variance that the noise explains (Fisher information) and that which the differences between
    scatterers show are averaged, the second with the weight of the number of scatterers that
    contribute to it. The step that is left is added. Scatterers that are not found disturb the
    others: standard deviations are divided by the share of the energy that is accounted for.

    Args:
        fit: The fit.
        accounted: Share of all energy that the scatterers and the noise explain, 0 to 1, shape
            (trial,).

    Returns:
        The covariance in the units and the order of the parameters of `Fit`, shape (trial,
        parameter, parameter); infinite where there are no scatterers.
    """
    known = (fit.scatterers.amplitude != 0).any(-1)
    covariance = fit.covariance * fit.noise[:, None, None]
    predicted = covariance.diagonal(dim1=-2, dim2=-1).clamp_min(torch.finfo(torch.float64).tiny)
    # what the scatterers would differ by if the fit did not take up a part of it as well
    taken_up = (predicted.shape[-1] / fit.scatterers.effective_number().clamp_min(1)).clamp_max(1)[:, None]
    seen = taken_up + fit.disagreement / predicted
    wider = (fit.witnesses * seen + _FEW) / (fit.witnesses + _FEW) + (_TO_GO * fit.change).square() / predicted
    wider = wider.sqrt() / or_one(accounted)[:, None]
    return torch.where(known[:, None, None], covariance * wider[:, :, None] * wider[:, None], math.inf)


def warp_phase_error(data: Tensor, sampling: Sampling, motion: Motion) -> tuple[Tensor, Tensor]:
    """Measure how well the relative derivatives of the rotation rate of a rotation fit the data.

    The rotation is refined by the histories of bright scatterers, and compared with the result. The
    change plus two standard deviations are given as the phase error that they cause to the
    scatterer farthest from zero Doppler among those used. A constant phase and a phase that is
    linear in the warped time only displace a scatterer and are left out. Where the histories do not
    confirm the rotation, because scatterers close to each other disturb them or because the
    rotation is wrong, the more accurate joint fit of all scatterers decides. A rotation of a lower
    order is compared with one of third order, since its own order cannot show what it leaves out.

    Args:
        data: Range-compressed pulses, shape (trial, pulse, range), complex.
        sampling: Sampling of the data.
        motion: Rotation to be judged.

    Returns:
        The phase error in rad, rms over the aperture, shape (trial,); and the number of scatterers,
        shape (trial,). The error is infinite where there are fewer than 3 scatterers, where all of
        them lie within a cell of zero Doppler, or where they are not seen in all quarters of the
        aperture, so that the rotation is extrapolated.
    """
    motion = replace(motion, k=torch.nn.functional.pad(motion.k, (0, max(0, _LEAST_ORDER - 1 - motion.k.shape[-1]))))
    refined = motion
    for _ in range(_CHECKS):
        refined, _ = refined_by_histories(data, sampling, refined)
    change, covariance, edge, count = change_by_histories(data, sampling, refined)
    error = _phase_error(sampling, motion, refined.k - motion.k + change, covariance, edge)
    at = (torch.isfinite(error) & (error >= MOST_PHASE_ERROR_RAD)).nonzero()[:, 0]
    if len(at):
        rows, judged = data[at], motion.part(at)
        fit = fit_scatterers(rows, sampling, refined.part(at))
        focus, order = focus_of(rows, sampling, fit), motion.k.shape[-1]
        covariance = covariance_of(fit, focus.accounted)[:, :order, :order]
        joint = _phase_error(sampling, judged, fit.motion.k - judged.k, covariance, focus.edge_rad)
        error = error.index_copy(0, at, torch.where(focus.right, joint, error[at]))
    return error, count


def _phase_error(sampling: Sampling, motion: Motion, change: Tensor, covariance: Tensor, edge_rad: Tensor) -> Tensor:
    """Phase error in rad, rms over the aperture, of a scatterer at the edge, (trial,).

    It is that of a change of k1, k2, ... (trial, order - 1) and of two of its standard deviations.
    """
    warped = Warped.of(motion.k, sampling.times(motion.k.device), sampling.duration_s)
    line = torch.stack([torch.ones_like(warped.u), warped.u - warped.u.mean(-1, keepdim=True)], 1)
    line = line / line.square().sum(-1, keepdim=True).sqrt()
    curves = warped.slopes - (warped.slopes @ line.mT) @ line
    size = curves @ curves.mT / sampling.pulses
    moved, unsure = torch.einsum("bi,bij,bj->b", change, size, change), (size * covariance).sum((-2, -1))
    return torch.nan_to_num(edge_rad * (moved.clamp_min(0).sqrt() + 2 * unsure.clamp_min(0).sqrt()), math.inf, math.inf)
