"""Autofocus of a path through the images along it.

Errors of the path move phases and envelopes. A correction of the phase per pulse does not move the
envelopes back.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from numbers import Integral

import torch
from torch import Tensor

from torchsar.compensate.path import assess as assessment
from torchsar.compensate.path.ground import FINE_STEP, for_each, ground_image, nothing, trials_of
from torchsar.compensate.path.joint import three_axes
from torchsar.compensate.path.search import Search, found_from_starts
from torchsar.compensate.pulse_phase.recommended import autofocus
from torchsar.core import Estimate, Outcome, Signal, Stage, differentiable
from torchsar.metrics import entropy
from torchsar.radar import AntennaPath


@differentiable("no")
def path_autofocus(
    profiles: Tensor,
    frequency_hz: Tensor,
    antennas: AntennaPath,
    *,
    extent_m: float | None = None,
    height_m: float = 0.0,
    rounds: int = 6,
    assess: bool = True,
) -> Estimate:
    """Estimate the error of the recorded path at each pulse, along and across the line of sight.

    >>> import torch
    >>> from torchsar.compensate import path_autofocus
    >>> from torchsar.radar import AntennaPath
    >>> y = torch.linspace(-20, 20, 32, dtype=torch.float64)
    >>> place_m = torch.stack([0 * y - 700, y, 0 * y + 700], -1)
    >>> path = AntennaPath(place_m, None, 2 * place_m.norm(dim=-1))
    >>> frequency_hz = 9.6e9 + 1e7 * torch.arange(-16, 16, dtype=torch.float64)
    >>> profiles = torch.zeros(32, 32, dtype=torch.complex64)
    >>> profiles[:, 16] = 1  # a point at the origin
    >>> found = path_autofocus(profiles, frequency_hz, path, rounds=1)
    >>> bool(found["line_of_sight_m"].abs().max() < 1e-4)
    True

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

        assess: Whether to add the standard deviation, the quality and the outcome.

    Returns:
        `line_of_sight_m` of shape (..., pulse), float64: half the path over the middle of the scene
        in metres, recorded minus true; and `offset_m` of shape (..., pulse, 3): the error of the
        positions in metres, recorded minus true, of both antennas alike, for `CorrectPath`. `info`
        holds "roughness" (see `roughness`: about 1 if the fringes come from single envelopes, less
        for smooth motions) and "entropy_nats" of the image, shape (...,).
        The assessment adds the standard deviation of `line_of_sight_m` modulo half a wavelength;
        `offset_m` has none, since its parts across the line of sight are hardly determined. The
        standard deviation follows from what the estimated scene and motion leave of the samples,
        and from the difference from the result of another start, weighed by how well that explains
        the samples.
        `quality` is the Strehl ratio predicted from it with half of the power of that difference,
        however well the other explains the samples, times the share of the sharpness that noise
        does not explain. Sharpness is the amount by which the image entropy lies below that of
        speckle. The outcome does not say whether fringes are right. It is EMPTY without samples;
        NOISE where the image is not twice as sharp as autofocus can make pure noise; TOO_FEW for
        fewer than 8 pulses with samples; NOT_CONVERGED where the fringes have not settled;
        AMBIGUOUS where another start explains the samples better by far; PARTS_DISAGREE where one
        of three blocks of ranges gets sharper with errors of its own, as cars make it (8 of 12
        scenes with three cars in different motions, 3 of 25 without cars; heights that are not
        known are not seen); and INEXACT where the same Strehl ratio for 1.5 standard deviations is
        below 0.8.

    Raises:
        TypeError: If the profiles are not complex, or frequencies are not float64.
        ValueError: If sizes do not match, values are not finite, the line of sight does not turn,
            the extent is not positive, or there is no round.
    """
    trials = trials_of("path_autofocus", profiles, frequency_hz, antennas)
    if extent_m is not None and not 0 < extent_m < math.inf:
        raise ValueError(f"extent_m must be positive and finite, got {extent_m}")
    if not isinstance(rounds, Integral) or rounds < 1:
        raise ValueError(f"path_autofocus needs a whole number of rounds, at least one, got rounds={rounds}")

    @torch.no_grad()
    def find(rows: Tensor, one: AntennaPath) -> Estimate:
        present = (rows != 0).any(-1)
        few = int(present.sum()) < 8
        seen = one
        if not (few or bool(present.all())):
            receiver = None if one.receiver_m is None else one.receiver_m[present]
            seen = AntennaPath(one.transmitter_m[present], receiver, one.reference_m[present])
        coarse = ground_image(frequency_hz, seen, height_m, extent_m)
        if few:
            outcome = Outcome.TOO_FEW if bool(present.any()) else Outcome.EMPTY
            return nothing(present, {"roughness": 1.0, "entropy_nats": 0.0}, outcome if assess else None)
        imaging = partial(ground_image, frequency_hz, seen, height_m, extent_m)
        some = rows[present]
        some = some / some.abs().amax()
        search = Search(some, frequency_hz, coarse, present)
        results = found_from_starts(search, imaging(FINE_STEP), rounds)
        best = results.best
        # If noise is below a twentieth of the power, up to two rounds use finer cells, by trial. At
        # 20 dB and errors of 5 cm, the error fell from 1.66 to 1.50 times the Cramer-Rao bound.
        if best.noise < 0.05 * some.abs().square().double().mean():
            last = three_axes(some, imaging(0.33), best.motion_m, present, 2, ends=(120, 0.001))
            if last.noise <= best.noise and last.restless <= assessment.RESTLESS:
                best = replace(best, motion_m=last.motion_m, offset_m=last.offset_m)
        value = {"line_of_sight_m": best.motion_m[:, 0], "offset_m": best.offset_m}
        info = {"roughness": results.roughness, "entropy_nats": entropy(best.image).double()}
        found = Estimate(value, quality=torch.ones_like(best.noise), info=info)
        return _spread(assessment.of_path(found, results, search) if assess else found, present)

    return for_each(find, profiles, antennas, trials)


def _spread(found: Estimate, present: Tensor) -> Estimate:
    """Interpolate the estimate for the pulses that are present to all pulses."""
    at = present.nonzero()[:, 0]
    every = torch.arange(len(present), device=present.device)
    high = torch.searchsorted(at, every).clamp(1, len(at) - 1)
    share = ((every - at[high - 1]) / (at[high] - at[high - 1])).clamp(0, 1).double()

    def of(x: Tensor) -> Tensor:
        part = share.reshape(-1, *(1,) * (x.ndim - 1))
        return x[high - 1] * (1 - part) + x[high] * part

    value, std = ({name: of(x) for name, x in table.items()} for table in (found.value, found.std))
    return replace(found, value=value, std=std)


@differentiable("no")
def path_phase(
    profiles: Tensor,
    frequency_hz: Tensor,
    antennas: AntennaPath,
    *,
    height_m: float = 0.0,
    search: int = 120,
    polish: int = 20,
    assess: bool = True,
) -> Estimate:
    """Estimate the phase of each pulse that sharpens the image of a spotlight scene on any path.

    >>> import torch
    >>> from torchsar.compensate import path_phase
    >>> from torchsar.radar import AntennaPath
    >>> y = torch.linspace(-20, 20, 32, dtype=torch.float64)
    >>> place_m = torch.stack([0 * y - 700, y, 0 * y + 700], -1)
    >>> path = AntennaPath(place_m, None, 2 * place_m.norm(dim=-1))
    >>> frequency_hz = 9.6e9 + 1e7 * torch.arange(-16, 16, dtype=torch.float64)
    >>> profiles = torch.zeros(32, 32, dtype=torch.complex64)
    >>> profiles[:, 16] = 1  # a point at the origin
    >>> found = path_phase(profiles, frequency_hz, path)
    >>> found["phase_rad"].shape
    torch.Size([32])

    It is `autofocus` with images by tiles along the recorded path, in which scatterers do not
    migrate. They cover the whole unambiguous ground. The middle of the scene, to which phases
    refer, is the origin.

    Args:
        profiles: Range profiles, the unitary centred inverse FFT of a phase history, shape (...,
            pulse, range), complex.
        frequency_hz: Frequencies in Hz, rising in equal steps, float64 (range,).
        antennas: Recorded path of the antennas, of all trials or of each of them.
        height_m: Height z of the imaged plane in metres.
        search: Largest number of iterations of the entropy fixed point, approximately.
        polish: Largest number of further iterations, which compare each pulse with a Wiener
            estimate of the scene.
        assess: Whether to add the standard deviation, the quality and the outcome.

    Returns:
        `phase_rad` of shape (..., pulse), to be removed, with its standard deviation, quality and
        outcome as for `autofocus`. They describe errors of one phase per pulse: errors of the path
        that move envelopes by a range cell or act differently across the scene are not part of
        them.

    Raises:
        TypeError: If the profiles are not complex, or frequencies are not float64.
        ValueError: If sizes do not match, values are not finite, or the line of sight does not
            turn.
    """
    trials = trials_of("path_phase", profiles, frequency_hz, antennas)

    def find(rows: Tensor, one: AntennaPath) -> Estimate:
        imaging = ground_image(frequency_hz, one, height_m)
        return autofocus(rows, search=search, polish=polish, imaging=imaging, assess=assess)

    if antennas.trials.numel() == 1:
        return find(profiles, antennas.of_trial((0,) * len(antennas.trials)))
    return for_each(find, profiles, antennas, trials)


class _PathEstimator(Stage):
    """Base class of the stages that estimate errors of pulses through the image along a path.

    Args:
        settings: Options of the function `find` of the stage.
    """

    differentiable = "no"
    # function of profiles, frequencies, antennas and its own settings
    find: Callable[..., Estimate]

    def __init__(self, **settings: float | tuple[float, float] | None) -> None:
        super().__init__()
        self.settings = settings

    def forward(
        self,
        signal: Signal,
        frequency_hz: Tensor,
        transmitter_m: Tensor,
        path_reference_m: Tensor,
        receiver_m: Tensor | None = None,
    ) -> Estimate:
        """Estimate the errors of the pulses of a signal with the axes (pulse, range).

        Args:
            signal: Range profiles.
            frequency_hz: Frequencies in Hz, float64 (range,).
            transmitter_m: Recorded positions of the transmitter in metres, float64 (..., pulse, 3).
            path_reference_m: Path to which phases refer in metres, float64 (..., pulse).
            receiver_m: Recorded positions of the receiver in metres; None if both share an antenna.

        Returns:
            `Estimate` with the values that the stage provides, by pulse.
        """
        antennas = AntennaPath(transmitter_m, receiver_m, path_reference_m)
        return type(self).find(signal.data, frequency_hz, antennas, **self.settings)


class PathPhase(_PathEstimator):
    """Phase per pulse that sharpens the image along any path; see `path_phase`.

    Args:
        height_m: Height z of the imaged plane in metres.
        search: Largest number of iterations of the entropy fixed point, approximately.
        polish: Largest number of further iterations, which compare each pulse with a Wiener
            estimate of the scene.
        assess: Whether to add the standard deviation, the quality and the outcome.
    """

    provides = ("phase_rad",)
    neutral = {"phase_rad": 0.0}
    find = staticmethod(path_phase)

    def __init__(self, height_m: float = 0.0, search: int = 120, polish: int = 20, assess: bool = True) -> None:
        super().__init__(height_m=height_m, search=search, polish=polish, assess=assess)


class PathAutofocus(_PathEstimator):
    """Error of the recorded path at every pulse, along and across the line of sight.

    See `path_autofocus`.

    Args:
        extent_m: Side of the imaged square about the origin in metres; None for the whole
            unambiguous ground.
        height_m: Height z of the imaged plane in metres.
        rounds: Largest number of rounds of the last step, at least 1.
        assess: Whether to add the standard deviation, the quality and the outcome.
    """

    provides = ("line_of_sight_m", "offset_m")
    neutral = {"line_of_sight_m": 0.0, "offset_m": 0.0}
    find = staticmethod(path_autofocus)
    not_estimated = (
        "a constant and a linear error of the path, which shift the image, and rotate and stretch it slightly"
    )
    """Errors that the estimate does not contain, and about which its outcome says nothing."""

    def __init__(
        self, extent_m: float | None = None, height_m: float = 0.0, rounds: int = 6, assess: bool = True
    ) -> None:
        super().__init__(extent_m=extent_m, height_m=height_m, rounds=rounds, assess=assess)


class CorrectPath(Stage):
    """Stage that subtracts the estimated errors from recorded positions, for the stages that image
    any path.

    >>> import torch
    >>> from torchsar import compensate, core, radar
    >>> axes = radar.InverseRadar(1e10, 1e8, 100.0).raw_axes(1, 8)
    >>> signal = core.Signal(torch.ones(1, 8) + 0j, axes)
    >>> place_m, offset_m = torch.tensor([[-800.0, 0, 600], [0, 0, 0.5]]).double().split(1)
    >>> compensate.CorrectPath()(signal, offset_m, place_m)["transmitter_m"]
    tensor([[-800.0000,    0.0000,  599.5000]], dtype=torch.float64)

    The signal stays as it is. A chain connects an autofocus before and an image after it:

        correct = use(CorrectPath(), offset_m="autofocus", transmitter_m="aux.transmitter_m")
        image = use(TileImage(...), transmitter_m="correct", ...)
    """

    provides = ("transmitter_m", "receiver_m")
    neutral = dict.fromkeys(provides, "positions are corrected by an offset, which is itself neutral in doubt")

    def forward(
        self, signal: Signal, offset_m: Tensor, transmitter_m: Tensor, receiver_m: Tensor | None = None
    ) -> Estimate:
        """Subtract the errors from the recorded positions.

        Args:
            signal: Range profiles.
            offset_m: Errors of the recorded positions in metres, recorded minus true, float64 (...,
                pulse, 3), the same for both antennas.
            transmitter_m: Recorded positions of the transmitter in metres, float64 (..., pulse, 3).
            receiver_m: Recorded positions of the receiver in metres; None if both share an antenna.

        Returns:
            `Estimate` of `transmitter_m`, and of `receiver_m` if there is one, float64 (..., pulse,
            3), not assessed; a chain replaces an offset whose estimate failed by zero.
        """
        places = {"transmitter_m": transmitter_m, "receiver_m": receiver_m}
        value = {name: place - offset_m for name, place in places.items() if place is not None}
        return Estimate(value, quality=signal.data.real.new_ones(value["transmitter_m"].shape[:-2]))
