"""Radial motion as stages: estimators of `velocity_m_s` that leave the sweeps alone, and what takes
the motion out.
"""

from __future__ import annotations

from torch import Tensor

from torchsar.compensate.radial.compensate import compensate_motion
from torchsar.compensate.radial.correlation import spectrum_correlation
from torchsar.compensate.radial.equalise import equalise_pulses, pulse_gain
from torchsar.compensate.radial.mirror import Intercept, mirror_product
from torchsar.compensate.radial.peak import ml_peak
from torchsar.compensate.radial.polish import phase_polish
from torchsar.compensate.radial.recommended import radial_motion
from torchsar.compensate.radial.segmented import Bins, Unwrap, segmented_interference
from torchsar.core import Estimate, Signal, Stage
from torchsar.radar import TriangularLadar

Window = tuple[float, float] | list[float] | None
SWEEPS = ("ramp", "pulse", "fast_time")


def _window(window_m: Window) -> tuple[float, float] | None:
    if window_m is None:
        return None
    if len(window_m) != 2:
        raise ValueError(f"window_m must be two relative ranges (low, high) in metres, got {list(window_m)}")
    return float(window_m[0]), float(window_m[1])


class _OfSweeps(Stage):
    """An estimator of the radial velocity at the turning points, from both sweeps of a window of
    relative ranges.
    """

    works_on = SWEEPS
    provides = ("velocity_m_s",)
    azimuth_m: Tensor

    def __init__(self, radar: TriangularLadar, window_m: Window, azimuth_m: float) -> None:
        super().__init__()
        self.radar, self.window_m = radar, _window(window_m)
        self.hold("azimuth_m", azimuth_m)


class MirrorProduct(_OfSweeps):
    """`mirror_product`."""

    def __init__(
        self,
        radar: TriangularLadar,
        window_m: Window = None,
        intercept: Intercept = "known",
        taper: float = 1.0,
        azimuth_m: float = 0.0,
    ) -> None:
        super().__init__(radar, window_m, azimuth_m)
        self.intercept: Intercept = intercept
        self.taper = taper

    def forward(self, signal: Signal) -> Estimate:
        return mirror_product(
            signal.data,
            self.radar,
            signal.axis("pulse"),
            window_m=self.window_m,
            intercept=self.intercept,
            taper=self.taper,
            azimuth_m=self.azimuth_m,
        )


class RadialMotion(MirrorProduct):
    """`radial_motion`, the recommended estimator: `velocity_m_s` for `CompensateMotion`, then
    `phase_rad` for `CorrectPulsePhase`.
    """

    provides = ("velocity_m_s", "phase_rad")

    def __init__(
        self,
        radar: TriangularLadar,
        window_m: Window = None,
        intercept: Intercept = "known",
        taper: float = 1.0,
        azimuth_m: float = 0.0,
        iterations: int = 80,
        tolerance_rad: float = 0.005,
    ) -> None:
        super().__init__(radar, window_m, intercept, taper, azimuth_m)
        self.iterations, self.tolerance_rad = iterations, tolerance_rad

    def forward(self, signal: Signal) -> Estimate:
        return radial_motion(
            signal.data,
            self.radar,
            signal.axis("pulse"),
            window_m=self.window_m,
            intercept=self.intercept,
            taper=self.taper,
            azimuth_m=self.azimuth_m,
            iterations=self.iterations,
            tolerance_rad=self.tolerance_rad,
        )


class MlPeak(_OfSweeps):
    """`ml_peak`."""

    def __init__(self, radar: TriangularLadar, window_m: Window = None, azimuth_m: float = 0.0) -> None:
        super().__init__(radar, window_m, azimuth_m)

    def forward(self, signal: Signal) -> Estimate:
        return ml_peak(signal.data, self.radar, signal.axis("pulse"), window_m=self.window_m, azimuth_m=self.azimuth_m)


class SpectrumCorrelation(_OfSweeps):
    """`spectrum_correlation`."""

    def __init__(
        self, radar: TriangularLadar, upsampling: int = 20, window_m: Window = None, azimuth_m: float = 0.0
    ) -> None:
        super().__init__(radar, window_m, azimuth_m)
        self.upsampling = upsampling

    def forward(self, signal: Signal) -> Estimate:
        return spectrum_correlation(
            signal.data,
            self.radar,
            signal.axis("pulse"),
            upsampling=self.upsampling,
            window_m=self.window_m,
            azimuth_m=self.azimuth_m,
        )


class SegmentedInterference(_OfSweeps):
    """`segmented_interference`."""

    def __init__(
        self,
        radar: TriangularLadar,
        bins: Bins = "peak",
        unwrap: Unwrap = "gradient",
        scatterers: int = 1,
        padding: int = 4,
        hann: bool = False,
        window_m: Window = None,
        azimuth_m: float = 0.0,
    ) -> None:
        super().__init__(radar, window_m, azimuth_m)
        self.bins: Bins = bins
        self.unwrap: Unwrap = unwrap
        self.scatterers, self.padding, self.hann = scatterers, padding, hann

    def forward(self, signal: Signal) -> Estimate:
        return segmented_interference(
            signal.data,
            self.radar,
            signal.axis("pulse"),
            bins=self.bins,
            unwrap=self.unwrap,
            scatterers=self.scatterers,
            padding=self.padding,
            hann=self.hann,
            window_m=self.window_m,
            azimuth_m=self.azimuth_m,
        )


class CompensateMotion(Stage):
    """`compensate_motion` by a connected value `velocity_m_s` (..., pulse) at the turning
    points.
    """

    works_on = SWEEPS

    def __init__(self, radar: TriangularLadar, carrier_only: bool = False) -> None:
        super().__init__()
        self.radar, self.carrier_only = radar, carrier_only

    def forward(self, signal: Signal, velocity_m_s: Tensor) -> Signal:
        return signal.with_data(
            compensate_motion(signal.data, velocity_m_s, self.radar, signal.axis("pulse"), self.carrier_only)
        )


class PhasePolish(Stage):
    """`phase_polish`: what a compensation by velocities has left in each pulse."""

    provides = ("phase_rad",)

    def __init__(self, iterations: int = 80, tolerance_rad: float = 0.005) -> None:
        super().__init__()
        self.iterations, self.tolerance_rad = iterations, tolerance_rad

    def forward(self, signal: Signal) -> Estimate:
        return phase_polish(signal.data, iterations=self.iterations, tolerance_rad=self.tolerance_rad)


class PulseGain(Stage):
    """`pulse_gain`: how strong each pulse is."""

    provides = ("gain",)

    def forward(self, signal: Signal) -> Estimate:
        return pulse_gain(signal.data)


class EqualisePulses(Stage):
    """`equalise_pulses` by a connected value `gain` (..., pulse)."""

    def forward(self, signal: Signal, gain: Tensor) -> Signal:
        return signal.with_data(equalise_pulses(signal.data, gain))
