"""Assessment of errors of a path: their standard deviation, quality and outcome.

Is the image sharper than noise can be made? Do several starts agree, and have the phases hardly
changed in the last round? Is the standard deviation small enough for a focused image? Does no block
of neighbouring ranges get sharper with errors of its own than noise explains?
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from torchsar.compensate.path.ground import FINE_STEP
from torchsar.compensate.path.search import Search, Starts, sharpness
from torchsar.compensate.pulse_phase.parts import gain_of_parts
from torchsar.core import Estimate, Outcome, worst

# The Strehl ratio for an error of _SPREAD standard deviations must be at least LEAST_STREHL, the
# convention of Marechal. The factor is a choice, because the difference of two starts is itself
# uncertain.
LEAST_STREHL, _SPREAD = 0.8, 1.5
# RESTLESS: largest share of the pulses whose fringe the last round may have changed, by trial. It
# was 3 % in correct results, and 19 % in a wrong minimum common to all starts.
# _WORSE: largest ratio of the residual power of the sharpest image to that of another start, by
# trial. It was 1.1 in correct results, and 3 in wrong ones.
# _UNFIT: residual power allowed without noise, as a share of the power. It was up to 0.2 % in
# correct fits at 40 dB.
RESTLESS, _WORSE, _UNFIT = 0.1, 1.5, 0.003
# least number of scatterers of a strip, and least share of the pulses that see one, by choice
LEAST_SCATTERERS, _LEAST_SEEN = 3, 0.95


def strehl(square_m2: Tensor, fringe_m: float, spread: float = 1.0) -> Tensor:
    """Predict the Strehl ratio of an image.

    Args:
        square_m2: Mean square error of the line of sight in square metres.
        fringe_m: Half a wavelength in metres.
        spread: Factor of the error.

    Returns:
        The Strehl ratio.
    """
    return torch.exp(-square_m2 * (spread * 2 * math.pi / fringe_m) ** 2)


def of_path(found: Estimate, starts: Starts, search: Search) -> Estimate:
    """Assess the errors of a path; see `path_autofocus`.

    The standard deviation contains a part of the difference from the result of another start. It is
    the nearest of those that explain the samples as well, if there are any. The errors by noise are
    common to all results, so that a difference comes from the search. The error of each result is
    assumed to be in proportion to its residual. If another result is as good, half the power of the
    difference therefore counts; if it is much worse, little of it counts. The doubt contains half
    the power in any case, because a wrong motion with more scatterers can explain the samples as
    well as the true one.

    Args:
        found: The estimate.
        starts: Results of the search from several starts.
        search: The search.

    Returns:
        The estimate with standard deviation, quality and outcome.
    """
    best = starts.best
    other = torch.stack([one.noise for one in starts.others])
    std = (best.std_m.square() + (starts.square_m2 / (1 + (other / best.noise).square())).amin()).sqrt()
    doubt = best.std_m.square().mean() + starts.square_m2.amin() / 2
    sharp, noise = sharpness(best.image)
    # The middle of the spectrum over azimuth, which the echoes occupy, is that of pulses without
    # range migration.
    rows = torch.fft.fftshift(torch.fft.fft(best.image.mT[None]), dim=-1)
    beside = round(rows.shape[-1] * (1 - FINE_STEP) / 2)
    rows = rows[..., beside : rows.shape[-1] - beside].contiguous()
    zero = torch.zeros_like(rows[:, 0].real)
    gain = gain_of_parts(rows, zero == 0, zero)[0]
    most = _WORSE * starts.noise + _UNFIT * search.rows.abs().square().double().mean()
    outcome = worst(
        (Outcome.INEXACT, strehl(doubt, search.fringe_m, _SPREAD) <= LEAST_STREHL),
        (Outcome.PARTS_DISAGREE, gain > 2.2),  # the limit of phases of pulses
        (Outcome.AMBIGUOUS, best.noise > most),
        (Outcome.NOT_CONVERGED, best.restless > RESTLESS),
        # the factor is larger than the 1.5 for phases of pulses, because envelopes and three axes
        # are free too
        (Outcome.NOISE, sharp <= 2.0 * noise),
    )
    quality = strehl(doubt, search.fringe_m) * (1 - (noise / sharp.clamp_min(1e-12)).clamp(0, 1))
    return replace(found, std={"line_of_sight_m": std}, quality=quality, outcome=outcome)


def of_strip(
    found: Estimate, judged: Tensor, fringe_m: float, pulses: Tensor, std_m: Tensor, change_m2: Tensor
) -> Estimate:
    """Assess the errors of a strip; see `strip_autofocus`.

    Args:
        found: The estimate.
        judged: True for the pulses that see the strip, (pulse,).
        fringe_m: Half a wavelength.
        pulses: Numbers of the pulses that see a scatterer, int64.
        std_m: Standard deviation of the line of sight in metres, float64 (pulse,).
        change_m2: Mean square by which the last round changed the line of sight.

    Returns:
        The estimate with standard deviation, quality and outcome.
    """
    seen = torch.zeros_like(judged)
    seen[pulses] = True
    square = std_m[judged].square().mean()
    outcome = worst(
        (Outcome.INEXACT, strehl(square, fringe_m, _SPREAD) <= LEAST_STREHL),
        (Outcome.NOT_CONVERGED, change_m2 >= square),
        (Outcome.TOO_FEW, seen[judged].double().mean() < _LEAST_SEEN),
    )
    return replace(found, std={"line_of_sight_m": std_m}, quality=strehl(square, fringe_m), outcome=outcome)
