"""One phase per pulse by autofocus through the images of antennas on any path."""

from __future__ import annotations

from torch import Tensor

from torchsar.compensate.path.ground import for_each, ground_image, trials_of
from torchsar.compensate.pulse_phase.recommended import autofocus
from torchsar.core import Estimate, Signal, Stage, checked_samples
from torchsar.radar import AntennaPath
from torchsar.radar.antenna_path import refuse_unusable


def path_phase(
    profiles: Tensor,
    frequency_hz: Tensor,
    antennas: AntennaPath,
    *,
    height_m: float = 0.0,
    search: int = 120,
    polish: int = 20,
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

    Returns:
        `phase_rad` of shape (..., pulse), to be removed, with its standard deviation, `quality` and
        `ok` as for `autofocus`. They describe errors of one phase per pulse: errors of the path
        that move envelopes by a range cell or act differently across the scene are not part of
        them.

    Raises:
        TypeError: If the profiles are not complex, or frequencies are not float64.
        ValueError: If sizes do not match, values are not finite, or the line of sight does not
            turn.
    """
    profiles = checked_samples(profiles, "path_phase", "pulse, range")
    refuse_unusable(frequency_hz=frequency_hz)
    trials = trials_of("path_phase", profiles, frequency_hz, antennas)
    if antennas.trials.numel() == 1:
        one = antennas.of_trial((0,) * len(antennas.trials))
        return autofocus(profiles, search=search, polish=polish, imaging=ground_image(frequency_hz, one, height_m))

    def find(rows: Tensor, one: AntennaPath) -> Estimate:
        return autofocus(rows, search=search, polish=polish, imaging=ground_image(frequency_hz, one, height_m))

    return for_each(find, profiles, antennas, trials)


class PathPhase(Stage):
    """Phase per pulse that sharpens the image along any path; see `path_phase`.

    Args:
        height_m: Height z of the imaged plane in metres.
        search: Largest number of iterations of the entropy fixed point, approximately.
        polish: Largest number of further iterations, which compare each pulse with a Wiener
            estimate of the scene.
    """

    provides = ("phase_rad",)
    neutral = {"phase_rad": 0.0}

    def __init__(self, height_m: float = 0.0, search: int = 120, polish: int = 20) -> None:
        super().__init__()
        self.height_m, self.search, self.polish = height_m, search, polish

    def forward(
        self,
        signal: Signal,
        frequency_hz: Tensor,
        transmitter_m: Tensor,
        path_reference_m: Tensor,
        receiver_m: Tensor | None = None,
    ) -> Estimate:
        """Estimate the phase error of every pulse of a signal with the axes (pulse, range).

        Args:
            signal: Range profiles.
            frequency_hz: Frequencies in Hz, float64 (range,).
            transmitter_m: Positions of the transmitter in metres, float64 (..., pulse, 3).
            path_reference_m: Path to which phases refer in metres, float64 (..., pulse).
            receiver_m: Positions of the receiver in metres; None if both share an antenna.

        Returns:
            `Estimate` by `path_phase` with `phase_rad` of shape (..., pulse), to be removed.
        """
        antennas = AntennaPath(transmitter_m, receiver_m, path_reference_m)
        how = {"height_m": self.height_m, "search": self.search, "polish": self.polish}
        return path_phase(signal.data, frequency_hz, antennas, **how)
