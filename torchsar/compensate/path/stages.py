"""Stages of the autofocus of a path."""

from __future__ import annotations

from torch import Tensor

from torchsar.compensate.path.line_of_sight import path_autofocus
from torchsar.compensate.path.phase import path_phase
from torchsar.core import Estimate, Signal, Stage
from torchsar.radar import AntennaPath


class _PathEstimator(Stage):
    """Base class of the stages that estimate errors of pulses through the image along a path."""

    def estimate(self, profiles: Tensor, frequency_hz: Tensor, antennas: AntennaPath) -> Estimate:
        """Estimate the errors; subclasses implement this method.

        Args:
            profiles: Range profiles, shape (..., pulse, range), complex.
            frequency_hz: Frequencies in Hz, float64 (range,).
            antennas: Recorded path of the antennas.

        Returns:
            The estimate.
        """
        raise NotImplementedError

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
        return self.estimate(signal.data, frequency_hz, AntennaPath(transmitter_m, receiver_m, path_reference_m))


class PathPhase(_PathEstimator):
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

    def estimate(self, profiles: Tensor, frequency_hz: Tensor, antennas: AntennaPath) -> Estimate:
        """Estimate the phase error of every pulse, see `path_phase`.

        Args:
            profiles: Range profiles, shape (..., pulse, range), complex.
            frequency_hz: Frequencies in Hz, float64 (range,).
            antennas: Recorded path of the antennas.

        Returns:
            `phase_rad` of shape (..., pulse), to be removed.
        """
        how = {"height_m": self.height_m, "search": self.search, "polish": self.polish}
        return path_phase(profiles, frequency_hz, antennas, **how)


class PathAutofocus(_PathEstimator):
    """Error of the recorded path at every pulse, along and across the line of sight.

    See `path_autofocus`.

    Args:
        extent_m: Side of the imaged square about the origin in metres; None for the whole
            unambiguous ground.
        height_m: Height z of the imaged plane in metres.
        rounds: Rounds of the last step, at least 1.
    """

    provides = ("line_of_sight_m", "offset_m")
    neutral = {"line_of_sight_m": 0.0, "offset_m": 0.0}

    def __init__(self, extent_m: float | None = None, height_m: float = 0.0, rounds: int = 4) -> None:
        super().__init__()
        self.extent_m, self.height_m, self.rounds = extent_m, height_m, rounds

    def estimate(self, profiles: Tensor, frequency_hz: Tensor, antennas: AntennaPath) -> Estimate:
        """Estimate the error of the recorded path, see `path_autofocus`.

        Args:
            profiles: Range profiles, shape (..., pulse, range), complex.
            frequency_hz: Frequencies in Hz, float64 (range,).
            antennas: Recorded path of the antennas.

        Returns:
            `line_of_sight_m` of shape (..., pulse) and `offset_m` of shape (..., pulse, 3).
        """
        how = {"extent_m": self.extent_m, "height_m": self.height_m, "rounds": self.rounds}
        return path_autofocus(profiles, frequency_hz, antennas, **how)


class CorrectPath(Stage):
    """Recorded positions less their estimated errors, for the stages that image any path.

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
            3). It is always `ok`; a chain replaces an offset that is not `ok` by zero.
        """
        places = {"transmitter_m": transmitter_m, "receiver_m": receiver_m}
        value = {name: place - offset_m for name, place in places.items() if place is not None}
        sure = signal.data.real.new_ones(value["transmitter_m"].shape[:-2])
        return Estimate(value, sure, sure > 0)
