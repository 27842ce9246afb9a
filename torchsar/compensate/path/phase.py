"""One phase per pulse by autofocus through the images of antennas on any path."""

from __future__ import annotations

from torch import Tensor

from torchsar.compensate.path.ground import for_each, ground_image, trials_of
from torchsar.compensate.pulse_phase.recommended import autofocus
from torchsar.core import Estimate
from torchsar.radar import AntennaPath


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
