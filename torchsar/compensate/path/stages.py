"""Stages of the autofocus of a path."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from torchsar.compensate.path.line_of_sight import path_autofocus, path_phase
from torchsar.compensate.path.strip import strip_autofocus
from torchsar.core import Estimate, Signal, Stage
from torchsar.radar import AntennaPath


class _PathEstimator(Stage):
    """Base class of the stages that estimate errors of pulses through the image along a path."""

    # function of profiles, frequencies and antennas, and its further settings
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

    def __init__(
        self, extent_m: float | None = None, height_m: float = 0.0, rounds: int = 6, assess: bool = True
    ) -> None:
        super().__init__(extent_m=extent_m, height_m=height_m, rounds=rounds, assess=assess)


class StripAutofocus(_PathEstimator):
    """Slow errors of the recorded path of a strip; see `strip_autofocus`.

    Args:
        azimuth_m: Extent of the imaged strip along its azimuth axis in metres.
        range_m: Extent along its range axis in metres.
        beam_deg: Width of the beam in degrees, see `ProcessedBeam`.
        centre_m: Position of the centre in metres along (range axis, azimuth axis).
        range_axis_rad: Direction of the range axis in rad, from ground coordinate x towards y.
        height_m: Height z of the imaged plane in metres.
        squint_deg: Angle of the middle of the beam ahead of broadside in degrees.
        assess: Whether to add the standard deviation, the quality and the outcome.
    """

    provides = ("line_of_sight_m", "offset_m")
    neutral = {"line_of_sight_m": 0.0, "offset_m": 0.0}
    find = staticmethod(strip_autofocus)

    def __init__(
        self,
        azimuth_m: float,
        range_m: float,
        beam_deg: float,
        centre_m: tuple[float, float] = (0.0, 0.0),
        range_axis_rad: float = 0.0,
        height_m: float = 0.0,
        squint_deg: float = 0.0,
        assess: bool = True,
    ) -> None:
        super().__init__(
            azimuth_m=azimuth_m,
            range_m=range_m,
            beam_deg=beam_deg,
            centre_m=(centre_m[0], centre_m[1]),
            range_axis_rad=range_axis_rad,
            height_m=height_m,
            squint_deg=squint_deg,
            assess=assess,
        )


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
            3), not assessed; a chain replaces an offset whose estimate failed by zero.
        """
        places = {"transmitter_m": transmitter_m, "receiver_m": receiver_m}
        value = {name: place - offset_m for name, place in places.items() if place is not None}
        return Estimate(value, quality=signal.data.real.new_ones(value["transmitter_m"].shape[:-2]))
