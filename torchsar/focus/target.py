"""The image of a target from its range profiles, by what the recording tells about the geometry."""

from __future__ import annotations

import math

from torch import Tensor

from torchsar.core import Axis, Signal, Stage
from torchsar.focus.dechirped import AzimuthTransform
from torchsar.focus.polar import PolarOperator
from torchsar.radar import FarField, InverseRadar, Spotlight


class TargetImage(Stage):
    """Range profiles ("pulse", "range") to an image ("azimuth", "range"): polar format where the
    geometry is known, else a transform along pulses.

    window: "none" or "hann" over pulses (and frequencies, in polar format). oversampling: of the
    transform. step_cells: sample spacing of the polar image in resolution cells. Its range axis
    lies along the mean line of sight, range growing away from the radar, and it covers the whole
    unambiguous extent of cross range and all range cells: what `autofocus` asks of an image
    formation.
    """

    def __init__(
        self,
        radar: InverseRadar,
        geometry: FarField | Spotlight | None = None,
        window: str = "none",
        oversampling: int = 1,
        step_cells: float = 0.6,
    ) -> None:
        super().__init__()
        if not 0 < step_cells <= 1:
            raise ValueError(f"step_cells must lie in 0..1 resolution cells, got {step_cells}")
        self.radar, self.window, self.step_cells = radar, window, step_cells
        self.along = AzimuthTransform(radar, window, oversampling)
        self.waves = (
            None
            if geometry is None
            else _along_sight(geometry.far_field() if isinstance(geometry, Spotlight) else geometry)
        )
        self._operator: PolarOperator | None = None

    def operator(self, profiles: Tensor) -> PolarOperator | None:
        """The polar operator for profiles (..., pulse, range), kept for the next of the same kind;
        None where images are transforms along pulses.
        """
        if self.waves is None:
            return None
        self._refuse_other_pulses(profiles)
        kept = self._operator
        if kept is None or kept.dtype != profiles.dtype or kept.geometry.direction.device != profiles.device:
            waves = self.waves.to(profiles.device)
            kept = self._operator = PolarOperator(
                waves, *self._axes(waves, profiles), window=self.window, dtype=profiles.dtype
            )
        return kept

    def _refuse_other_pulses(self, profiles: Tensor) -> None:
        """Before an operator is kept for them."""
        assert self.waves is not None
        want = self.waves.direction.shape[0], self.waves.frequency_hz.shape[0]
        if profiles.shape[-2:] != want:
            raise ValueError(
                f"profiles of shape {tuple(profiles.shape)} do not end in the (pulse, frequency) = "
                f"{want} of the geometry; crop both alike"
            )

    def _axes(self, waves: FarField, profiles: Tensor) -> tuple[Axis, Axis]:
        n_pulse, n_range = profiles.shape[-2:]
        turn = abs(float(waves.direction[-1, 1] - waves.direction[0, 1])) / max(
            n_pulse - 1, 1
        )  # cross range enters the range by so much more a pulse
        if not turn:
            raise ValueError("the line of sight does not turn; without a turn there is no cross range to image")
        across = self.radar.wavelength_m / (2 * turn)
        along = self.radar.range_step_m * n_range / float(waves.direction.norm(dim=-1).mean())
        return _axis("azimuth", across, self.step_cells * across / n_pulse), _axis(
            "range", along, self.step_cells * along / n_range
        )

    def forward(self, signal: Signal) -> Signal:
        operator = self.operator(signal.data)
        return (
            self.along(signal)
            if operator is None
            else Signal(operator.image(signal.data), (operator.azimuth, operator.range))
        )


def _along_sight(waves: FarField) -> FarField:
    """The geometry in coordinates whose first axis is the mean ground direction away from the
    radar.
    """
    mean = waves.direction.mean(0)
    return waves.turned(math.atan2(float(mean[1]), float(mean[0])))


def _axis(name: str, extent_m: float, step_m: float) -> Axis:
    n = max(1, round(extent_m / step_m))
    return Axis(name, n, -(n // 2) * step_m, step_m, "m")
