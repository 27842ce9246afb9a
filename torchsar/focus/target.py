"""Image of a target from its range profiles, by polar format or by a transform along pulses."""

from __future__ import annotations

import math

from torch import Tensor

from torchsar.core import Axis, Signal, Stage
from torchsar.focus.dechirped import AzimuthTransform
from torchsar.focus.polar import PolarOperator
from torchsar.radar import FarField, InverseRadar, Spotlight


class TargetImage(Stage):
    """Stage that forms an image ("azimuth", "range") from range profiles ("pulse", "range").

    >>> import torch
    >>> from torchsar import Signal, focus, radar
    >>> ladar = radar.InverseRadar(193.4e12, bandwidth_hz=150e9, prf_hz=2e3, rotation_rad_s=0.005)
    >>> pulses = Signal(torch.ones(64, 32) + 0j, ladar.raw_axes(64, 32))
    >>> image = focus.TargetImage(ladar, window="hann")(pulses)
    >>> image.names, int(image.data[:, 0].abs().argmax())  # the middle line
    (('azimuth', 'range'), 32)

    Where the geometry is known, the image is formed by polar format, otherwise by a Fourier
    transform along pulses (`AzimuthTransform`). The polar image has its range axis along the
    mean line of sight, with range increasing away from the radar. It covers the whole unambiguous
    extent of cross range and all range cells, as `autofocus` requires.

    Args:
        radar: Radar of the recording.
        geometry: Geometry of the recording; None where it is not known.
        window: "none" or "hann" over pulses, in polar format also over frequencies.
        oversampling: Lines per cross-range cell of the transform along pulses.
        step_cells: Sample spacing of the polar image in resolution cells, above 0 and at most 1.

    Raises:
        ValueError: If `step_cells`, `window` or `oversampling` is not valid.
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
            raise ValueError(f"step_cells must be above 0 and at most 1 resolution cell, got {step_cells}")
        self.radar, self.window, self.step_cells = radar, window, step_cells
        self.along = AzimuthTransform(radar, window, oversampling)
        self.waves = (
            None
            if geometry is None
            else _along_sight(geometry.far_field() if isinstance(geometry, Spotlight) else geometry)
        )
        self._operator: PolarOperator | None = None

    def operator(self, profiles: Tensor) -> PolarOperator | None:
        """Return the polar-format operator for profiles, or None where no geometry is known.

        Without a geometry, images are transforms along pulses. The operator is stored
        for further profiles of the same dtype and device.

        Args:
            profiles: Range profiles, shape (..., pulse, range), complex.

        Returns:
            Map from range profiles to the image, with its adjoint, or None.

        Raises:
            ValueError: If the size of the profiles is not that of the geometry, or the line of
                sight does not rotate.
        """
        if self.waves is None:
            return None
        self._check_size(profiles)
        kept = self._operator
        if kept is None or kept.dtype != profiles.dtype or kept.geometry.direction.device != profiles.device:
            waves = self.waves.to(profiles.device)
            kept = self._operator = PolarOperator(
                waves, *self._axes(waves, profiles), window=self.window, dtype=profiles.dtype
            )
        return kept

    def _check_size(self, profiles: Tensor) -> None:
        """Raise ValueError for profiles of another size than the geometry."""
        assert self.waves is not None
        want = self.waves.direction.shape[0], self.waves.frequency_hz.shape[0]
        if profiles.shape[-2:] != want:
            raise ValueError(
                f"profiles of shape {tuple(profiles.shape)} do not end in the (pulse, frequency) = "
                f"{want} sizes of the geometry; crop profiles and geometry to the same samples"
            )

    def _axes(self, waves: FarField, profiles: Tensor) -> tuple[Axis, Axis]:
        """Axes of the polar image."""
        n_pulse, n_range = profiles.shape[-2:]
        turn = abs(float(waves.direction[-1, 1] - waves.direction[0, 1])) / max(
            n_pulse - 1, 1
        )  # change of range per pulse and metre of cross range
        if not turn:
            raise ValueError(
                "the line of sight does not rotate, so that there is no cross-range resolution; "
                "record data over a range of aspect angles"
            )
        across = self.radar.wavelength_m / (2 * turn)
        along = self.radar.range_step_m * n_range / float(waves.direction.norm(dim=-1).mean())
        return _axis("azimuth", across, self.step_cells * across / n_pulse), _axis(
            "range", along, self.step_cells * along / n_range
        )

    def forward(self, signal: Signal) -> Signal:
        """Form the image of a signal with axes (pulse, range).

        Args:
            signal: Range profiles.

        Returns:
            Image with axes (azimuth, range).

        Raises:
            ValueError: If the size of the profiles is not that of the geometry, or the line of
                sight does not rotate.
        """
        operator = self.operator(signal.data)
        return (
            self.along(signal)
            if operator is None
            else Signal(operator.image(signal.data), (operator.azimuth, operator.range))
        )


def _along_sight(waves: FarField) -> FarField:
    """Geometry in coordinates whose first axis is the mean ground direction away from the radar."""
    mean = waves.direction.mean(0)
    return waves.turned(math.atan2(float(mean[1]), float(mean[0])))


def _axis(name: str, extent_m: float, step_m: float) -> Axis:
    """Axis of an extent and a sample spacing, centred on zero."""
    n = max(1, round(extent_m / step_m))
    return Axis(name, n, -(n // 2) * step_m, step_m, "m")
