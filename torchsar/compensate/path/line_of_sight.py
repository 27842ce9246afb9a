"""Autofocus of a path: one line-of-sight range per pulse, which moves phases and envelopes."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from numbers import Integral

import torch
from torch import Tensor

from torchsar.compensate.path.axes import Found, three_axes
from torchsar.compensate.path.envelopes import moved
from torchsar.compensate.path.ground import FINE_STEP, for_each, ground_image, placed, trials_of
from torchsar.compensate.path.search import Search
from torchsar.compensate.pulse_phase.assess import LEAST_STREHL
from torchsar.compensate.pulse_phase.sharpness import sharpness_beyond_speckle, sharpness_of_noise
from torchsar.core import Estimate, Outcome, checked_samples
from torchsar.focus import TileOperator
from torchsar.metrics import entropy, residual_phase
from torchsar.radar import AntennaPath
from torchsar.radar.antenna_path import refuse_unusable

# share of the band in step 1, in which range cells are four times as long
_FIRST_BAND = 0.25
# share of the band with which step 1 begins in the third start
_OTHER_BAND = 0.5
# fewest pulses
_LEAST_PULSES = 8
# factor by which the sharpness must exceed that of noise: more than for the phases of pulses, 1.5,
# because envelopes and three axes are free too
_MARGIN = 2.0
# factor by which the sharpness of a start must exceed that of noise to be refined in more than one
# round: in 43 scenes it was 0.5 to 1.3 times that of noise for noise and at -10 dB, 1.0 to 2.9
# times for clutter, whose errors are not found, and 3.7 to 11 times where errors were found
_HOPE = 1.25
# number of standard deviations that may not lower the Strehl ratio below its limit, by choice: the
# difference of two starts is itself uncertain
_SPREAD = 1.5
# factor by which another start may leave more of the samples than the sharpest image and still
# count as a second opinion on it, by trial: those whose results were as good left up to 1.05 times
# as much, those that had not come as far 1.1 to 1.35 times
_AS_WELL = 1.1
# largest share of the pulses whose fringes the last round may have changed, and factor by which the
# sharpest image may leave more of the samples than that of another start, by trial: 3 % and 1.1
# where the result was right, 19 % and 3 in a wrong minimum that all starts had in common; and share
# of the power that a fit may leave without noise: fits of right results left up to 0.2 % at 40 dB
_RESTLESS, _WORSE, _UNFIT = 0.1, 1.5, 0.003
# noise as a share of the mean power of the samples below which the last rounds take finer cells,
# their spacing in resolution cells, and most rounds, by trial: at 20 dB and errors of 5 cm the
# error of the line of sight fell from 1.66 to 1.50 bounds, at 10 dB it did not change
_CLEAR, _FINEST_STEP, _LAST_ROUNDS = 0.05, 0.33, 2


def path_autofocus(
    profiles: Tensor,
    frequency_hz: Tensor,
    antennas: AntennaPath,
    *,
    extent_m: float | None = None,
    height_m: float = 0.0,
    rounds: int = 6,
) -> Estimate:
    """Estimate the error of the recorded path at each pulse, along and across the line of sight.

    The recommended autofocus of antennas on any path, for spotlight scenes. The phase of a pulse
    gives its error along the line of sight modulo a fringe, half a wavelength; the envelope of its
    range profile shows how many fringes the error has. The steps are:

    1. The phases of the pulses are found in a quarter of the band, where errors of the envelopes
       matter little. They start from the phases between adjacent pulses (`sca`); iterations through
       the image formation and its adjoint then sharpen the image.
    2. Phases become ranges. If their second differences show a smooth motion, its fringes follow
       from the phases; otherwise each pulse takes the range at which its envelope and its phase
       match the sharpened image best. Envelopes that lie far from those of their neighbours are
       replaced. This is repeated in up to six rounds with half and then all of the band, in which
       the envelopes are corrected too.
    3. Envelopes may still drift slowly against the phases. The drift is the polynomial of time of
       least image entropy at unchanged phases of the carrier; it is added in whole fringes.
    4. The phase of each pulse is compared with a Wiener estimate of the scene, without windows, in
       up to ten iterations. Then the scene and the motion in three axes are estimated jointly from
       the samples: the scene with a Gaussian prior whose variance follows from the image, the
       motion by its phases, which depend on the place. Errors across the line of sight, which act
       differently over the scene, are assumed to have the spectrum of those along it. Whole
       fringes are added to pulses whose envelopes match the scene so much better.
    5. Step 4 is repeated from another start: phases of the whole band, with envelopes at rest; and
       from a third one, half of the band in step 1, if the results differ or explain the samples
       unequally well. The sharpest image counts. Where there is little noise, its scene and
       motion are estimated once more with finer cells, and to the end.

    Not observable are a constant and a linear term, which shift the image, and rotate and stretch
    it slightly; they are zero in the result. Where the errors are rough from pulse to pulse,
    fringes follow from single envelopes and are partly wrong; the result then holds modulo half a
    wavelength. Trials have image plans of their own and are processed one after another.

    Args:
        profiles: Range profiles, the unitary centred inverse FFT of a phase history, shape (...,
            pulse, range), complex. Pulses that hold only zeros are left out; their errors are
            interpolated.
        frequency_hz: Frequencies in Hz, rising in equal steps, float64 (range,).
        antennas: Recorded path of the antennas, of all trials or of each of them. The scene is
            about the origin.
        extent_m: Side of the imaged square about the origin in metres, which should hold most of
            the scatterers; by default that of the whole unambiguous ground, which takes longer.
        height_m: Height z of the imaged plane in metres.
        rounds: Largest number of rounds of the joint estimate in step 4, at least 1; there is only
            one where the image before is no sharper than that of noise.

    Returns:
        `line_of_sight_m` of shape (..., pulse), float64: half the path over the middle of the scene
        in metres, recorded minus true; and `offset_m` of shape (..., pulse, 3): the error of the
        positions in metres, recorded minus true, of both antennas alike, for `CorrectPath`. The
        standard deviation, of `line_of_sight_m` only, is that modulo half a wavelength; it follows
        from what the estimated scene and motion leave of the samples, and from the difference from
        the result of another start, weighed by how well that explains the samples. `quality` is the
        Strehl ratio predicted from it with half of the power of that difference, however well the
        other explains the samples, times the share of the sharpness that noise does not explain.
        Sharpness is the amount by which the image entropy lies below that of speckle. `ok` is False
        unless the image is twice as sharp as autofocus can make pure noise, more than one range
        cell contributes to the sharpness, the same Strehl ratio for 1.5 standard deviations exceeds
        0.8, the fringes have settled, and no start explains the samples better by far; it does not
        say whether fringes are right. It is False for fewer than 8 pulses with samples.
        `info` holds "roughness" (see `roughness`: about 1 if the fringes come from single
        envelopes, less for smooth motions) and "entropy_nats" of the image, shape (...,).

    Raises:
        TypeError: If the profiles are not complex, or frequencies are not float64.
        ValueError: If sizes do not match, values are not finite, the line of sight does not turn,
            the extent is not positive, or there is no round.
    """
    profiles = checked_samples(profiles, "path_autofocus", "pulse, range")
    refuse_unusable(frequency_hz=frequency_hz)
    trials = trials_of("path_autofocus", profiles, frequency_hz, antennas)
    if extent_m is not None and not 0 < extent_m < math.inf:
        raise ValueError(f"extent_m must be positive and finite, got {extent_m}")
    if not isinstance(rounds, Integral) or rounds < 1:
        raise ValueError(f"path_autofocus needs a whole number of rounds, at least one, got rounds={rounds}")

    @torch.no_grad()
    def find(rows: Tensor, one: AntennaPath) -> Estimate:
        present = (rows != 0).any(-1)
        few = int(present.sum()) < _LEAST_PULSES
        seen = one if few or bool(present.all()) else _only(one, present)
        coarse = ground_image(frequency_hz, seen, height_m, extent_m)
        if few:
            return _nothing(rows)
        imaging = partial(ground_image, frequency_hz, seen, height_m, extent_m)
        some = rows[present]
        some = some / some.abs().amax()
        return _spread(_judged(Search(some, frequency_hz, coarse, present), imaging, rounds), present)

    return for_each(find, profiles, antennas, trials)


def _only(antennas: AntennaPath, present: Tensor) -> AntennaPath:
    """The path of the pulses that are present."""
    receiver = None if antennas.receiver_m is None else antennas.receiver_m[present]
    return AntennaPath(antennas.transmitter_m[present], receiver, antennas.reference_m[present])


def _nothing(rows: Tensor) -> Estimate:
    """The estimate of a trial with too few pulses."""
    zero = torch.zeros(len(rows), dtype=torch.float64, device=rows.device)
    none = zero.new_zeros(())
    info = {"roughness": none + 1, "entropy_nats": none}
    value = {"line_of_sight_m": zero, "offset_m": zero[:, None].expand(-1, 3)}
    return Estimate(value, {"line_of_sight_m": zero + 1}, none, Outcome.of(none > 0, Outcome.NOISE), info=info)


def _spread(found: Estimate, present: Tensor) -> Estimate:
    """The estimate of all pulses from that of those which are present."""
    at = present.nonzero()[:, 0]
    every = torch.arange(len(present), device=present.device)
    high = torch.searchsorted(at, every).clamp(1, len(at) - 1)
    share = ((every - at[high - 1]) / (at[high] - at[high - 1])).clamp(0, 1).double()

    def of(x: Tensor) -> Tensor:
        part = share.reshape(-1, *(1,) * (x.ndim - 1))
        return x[high - 1] * (1 - part) + x[high] * part

    value = {name: of(x) for name, x in found.value.items()}
    return Estimate(
        value, {name: of(x) for name, x in found.std.items()}, found.quality, found.outcome, info=found.info
    )


def _judged(search: Search, imaging: Callable[[float], TileOperator], rounds: int) -> Estimate:
    """The estimate of the sharpest image from two or three starts, and its verdict.

    imaging: Image formation with a spacing of pixels in resolution cells.
    """
    fine = imaging(FINE_STEP)

    def refined(range_m: Tensor) -> Found:
        range_m = search.polished(range_m, fine)
        sharp, noise = _sharpness(fine.image(moved(search.rows, search.frequency_hz, range_m)[None])[0])
        return three_axes(search.rows, fine, range_m, search.present, rounds if sharp > _HOPE * noise else 1)

    def strehl(std_m: Tensor) -> Tensor:
        return torch.exp(-(std_m * (2 * math.pi / search.fringe_m)).square().mean())

    range_m, rough = search.by_envelopes(_FIRST_BAND)
    results = [refined(range_m), refined(search.by_phases())]
    found, std_m, doubt_m, alone = _sharpest(results, search)
    if alone or strehl(_SPREAD * doubt_m) <= LEAST_STREHL:
        results.append(refined(search.by_envelopes(_OTHER_BAND)[0]))
        found, std_m, doubt_m, _ = _sharpest(results, search)
    sharp, noise = _sharpness(found.image)
    quality = strehl(doubt_m) * (1 - (noise / sharp.clamp_min(1e-12)).clamp(0, 1))
    least = torch.stack([one.noise for one in results]).amin()
    least = _WORSE * least + _UNFIT * search.rows.abs().square().double().mean()
    sure = [
        sharp > _MARGIN * noise,
        strehl(_SPREAD * doubt_m) > LEAST_STREHL,
        found.restless <= _RESTLESS,
        found.noise <= least,
    ]
    ok = torch.stack(sure).all()
    if ok and found.noise < _CLEAR * search.rows.abs().square().double().mean():
        finest = imaging(_FINEST_STEP)
        last = three_axes(search.rows, finest, found.motion_m, search.present, _LAST_ROUNDS, exact=True)
        if last.noise <= found.noise and last.restless <= _RESTLESS:
            found = replace(found, motion_m=last.motion_m, offset_m=last.offset_m)
    value = {"line_of_sight_m": found.line_of_sight_m, "offset_m": found.offset_m}
    info = {"roughness": rough, "entropy_nats": entropy(found.image).double()}
    return Estimate(value, {"line_of_sight_m": std_m}, quality, Outcome.of(ok, Outcome.NOISE), info=info)


def _sharpness(image: Tensor) -> tuple[Tensor, Tensor]:
    """Sharpness of an image (azimuth, range), and that of noise."""
    sharp, effective = sharpness_beyond_speckle(image.mT)
    return sharp, sharpness_of_noise((effective * FINE_STEP).clamp_min(1))


def _sharpest(found: list[Found], search: Search) -> tuple[Found, Tensor, Tensor, bool]:
    """The result of the sharpest image, two standard deviations of its line of sight (m), and
    whether it stands alone: no other result explains the samples as well.

    Both contain a part of the difference from another result, of the nearest of those that explain
    the samples as well if there are any. All have the errors by noise in common; what differs comes
    from the search. The first takes the errors of each to be in proportion to what it leaves of the
    samples: half the power of the difference comes from one that is as good, little from one that
    is lost. The second, by which a result is doubted, takes half the power in any case: a wrong
    motion can explain the samples as well as the true one, with more scatterers, and it stands
    alone then.
    """
    best, *others = sorted(found, key=lambda one: float(entropy(one.image)))
    as_well = [one for one in others if one.noise <= _AS_WELL * best.noise]
    radians, present = 2 * math.pi / search.fringe_m, search.present

    def phase(one: Found) -> Tensor:
        return radians * placed(one.line_of_sight_m, present)

    compared = as_well or others
    apart = [residual_phase(phase(best), phase(other), present)[present] / radians for other in compared]
    square = torch.stack([x.square().mean() for x in apart])
    share = torch.stack([1 / (1 + (other.noise / best.noise).square()) for other in compared])
    std, doubt = ((best.std_m.square() + (square * part).amin()).sqrt() for part in (share, 0.5))
    return best, std, doubt, not as_well
