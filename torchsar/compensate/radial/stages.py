"""Estimation and compensation of the radial motion of a triangular-FMCW ladar, as chain stages.

The estimators leave the sweeps unchanged.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from torch import Tensor

from torchsar.compensate.radial.compensate import compensate_motion
from torchsar.compensate.radial.correlation import spectrum_correlation
from torchsar.compensate.radial.equalise import equalise_pulses, pulse_gain
from torchsar.compensate.radial.measured import Intercept
from torchsar.compensate.radial.mirror import mirror_product
from torchsar.compensate.radial.peak import ml_peak
from torchsar.compensate.radial.polish import phase_polish
from torchsar.compensate.radial.recommended import radial_motion
from torchsar.compensate.radial.segmented import Bins, Unwrap, segmented_interference
from torchsar.core import Estimate, Signal, Stage
from torchsar.radar import TriangularLadar

Window = tuple[float, float] | list[float] | None
SWEEPS = ("ramp", "pulse", "fast_time")  # axes of the signals of these stages


class _OfSweeps(Stage):
    """An estimator of the radial velocity from both sweeps of a range window."""

    works_on = SWEEPS
    provides = ("velocity_m_s",)
    neutral = {"velocity_m_s": 0.0}
    estimator: Callable[..., Estimate]
    azimuth_m: Tensor

    def __init__(
        self, radar: TriangularLadar, window_m: Window, azimuth_m: float, assess: bool, **options: Any
    ) -> None:
        super().__init__()
        if window_m is not None and len(window_m) != 2:
            raise ValueError(
                "window_m must be two ranges (low, high) in metres relative to the reference range, got "
                f"{list(window_m)}"
            )
        self.radar, self.window_m = radar, None if window_m is None else (float(window_m[0]), float(window_m[1]))
        self.assess, self.options = assess, options
        self.hold("azimuth_m", azimuth_m)

    def forward(self, signal: Signal) -> Estimate:
        """Estimate the radial motion from up and down sweeps of axes (ramp, pulse, fast_time).

        Returns:
            The values that the stage provides, shape (..., pulse) each: `velocity_m_s` at the
            turning points (ends of the up sweeps), receding positive, and for `RadialMotion` the
            residual `phase_rad` of the up sweeps.
        """
        return self.estimator(
            signal.data,
            self.radar,
            signal.axis("pulse"),
            window_m=self.window_m,
            azimuth_m=self.azimuth_m,
            assess=self.assess,
            **self.options,
        )


class MirrorProduct(_OfSweeps):
    """Radial velocity by the product of up and mirrored down sweeps; see `mirror_product`.

    Provides `velocity_m_s` of shape (..., pulse) at the turning points (ends of the up sweeps),
    receding positive.

    Args:
        radar: Ladar parameters.
        window_m: Lowest and highest range in metres, relative to the reference range; None for the
            whole band.
        intercept: What is assumed of the phase of the product of up and mirrored down sweep at the
            turning point: "known", "record" or "free", see `mirror_product`.
        taper: Share of the window that its edges take, see `Spectra.bands`.
        azimuth_m: Azimuth of the scene centre in metres.
        assess: False leaves out standard deviation and outcome.

    Raises:
        ValueError: If the window does not have two values.
    """

    estimator = staticmethod(mirror_product)

    def __init__(
        self,
        radar: TriangularLadar,
        window_m: Window = None,
        intercept: Intercept = "known",
        taper: float = 1.0,
        azimuth_m: float = 0.0,
        assess: bool = True,
    ) -> None:
        super().__init__(radar, window_m, azimuth_m, assess, intercept=intercept, taper=taper)


class RadialMotion(_OfSweeps):
    """Radial motion by the recommended estimator; see `radial_motion`.

    Provides `velocity_m_s`, which `CompensateMotion` can compensate, and the residual `phase_rad`,
    which `CorrectPulsePhase` can then remove.

    Args:
        radar: Ladar parameters.
        window_m: Lowest and highest range in metres, relative to the reference range; None for the
            whole band.
        intercept: What is assumed of the phase of the product of up and mirrored down sweep at the
            turning point: "known", "record" or "free", see `mirror_product`.
        taper: Share of the window that its edges take, see `Spectra.bands`.
        azimuth_m: Azimuth of the scene centre in metres.
        iterations: Largest number of iterations, see `phase_polish`.
        tolerance_rad: Tolerance of the iterations in rad, see `phase_polish`.
        assess: False leaves out standard deviation and outcome.

    Raises:
        ValueError: If the window does not have two values.
    """

    provides = ("velocity_m_s", "phase_rad")
    neutral = {"velocity_m_s": 0.0, "phase_rad": 0.0}
    estimator = staticmethod(radial_motion)

    def __init__(
        self,
        radar: TriangularLadar,
        window_m: Window = None,
        intercept: Intercept = "known",
        taper: float = 1.0,
        azimuth_m: float = 0.0,
        iterations: int = 80,
        tolerance_rad: float = 0.005,
        assess: bool = True,
    ) -> None:
        super().__init__(
            radar,
            window_m,
            azimuth_m,
            assess,
            intercept=intercept,
            taper=taper,
            iterations=iterations,
            tolerance_rad=tolerance_rad,
        )


class MlPeak(_OfSweeps):
    """Radial velocity by periodogram peaks of one scatterer; see `ml_peak`.

    Args:
        radar: Ladar parameters.
        window_m: Lowest and highest range in metres, relative to the reference range; None for the
            whole band.
        azimuth_m: Azimuth of the scatterer in metres.
        assess: False leaves out standard deviation and outcome.

    Raises:
        ValueError: If the window does not have two values.
    """

    estimator = staticmethod(ml_peak)

    def __init__(
        self,
        radar: TriangularLadar,
        window_m: Window = None,
        azimuth_m: float = 0.0,
        assess: bool = True,
    ) -> None:
        super().__init__(radar, window_m, azimuth_m, assess)


class SpectrumCorrelation(_OfSweeps):
    """Radial velocity by cross-correlation of range envelopes; see `spectrum_correlation`.

    Args:
        radar: Ladar parameters.
        upsampling: Upsampling of the spectra, 1..64.
        window_m: Lowest and highest range in metres, relative to the reference range; None for the
            whole band.
        azimuth_m: Azimuth of the scene centre in metres.
        assess: False leaves out standard deviation and outcome.

    Raises:
        ValueError: If the window does not have two values.
    """

    estimator = staticmethod(spectrum_correlation)

    def __init__(
        self,
        radar: TriangularLadar,
        upsampling: int = 20,
        window_m: Window = None,
        azimuth_m: float = 0.0,
        assess: bool = True,
    ) -> None:
        super().__init__(radar, window_m, azimuth_m, assess, upsampling=upsampling)
        self.upsampling = upsampling


class SegmentedInterference(_OfSweeps):
    """Radial velocity by segmented interference; see `segmented_interference`.

    Args:
        radar: Ladar parameters.
        bins: Frequency bins in which the phase is read: "peak" (those of the strongest scatterers)
            or "sum" (all).
        unwrap: How the whole turns of the phase are found: "gradient" (from period to period) or
            "per_pulse" (from the envelopes of every period).
        scatterers: Number of scatterers with "peak".
        padding: Factor of the zero-padding of the halves, 1..16.
        hann: True applies a Hann window to each half.
        window_m: Lowest and highest range in metres, relative to the reference range; None for the
            whole band.
        azimuth_m: Azimuth of the scene centre in metres.
        assess: False leaves out standard deviation and outcome.

    Raises:
        ValueError: If the window does not have two values.
    """

    estimator = staticmethod(segmented_interference)

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
        assess: bool = True,
    ) -> None:
        super().__init__(
            radar,
            window_m,
            azimuth_m,
            assess,
            bins=bins,
            unwrap=unwrap,
            scatterers=scatterers,
            padding=padding,
            hann=hann,
        )


class CompensateMotion(Stage):
    """Stage that compensates the radial motion `velocity_m_s`; see `compensate_motion`.

    The velocity usually comes from an earlier stage such as `MirrorProduct`.

    Args:
        radar: Ladar parameters.
        carrier_only: True compensates the phase of the carrier only; the envelopes then remain
            displaced by the motion.
    """

    works_on = SWEEPS

    def __init__(self, radar: TriangularLadar, carrier_only: bool = False) -> None:
        super().__init__()
        self.radar, self.carrier_only = radar, carrier_only

    def forward(self, signal: Signal, velocity_m_s: Tensor) -> Signal:
        """Remove the radial motion from sweeps of axes (ramp, pulse, fast_time).

        Args:
            signal: Up and down sweeps of N samples each, shape (..., 2, pulse, N), complex.
            velocity_m_s: Radial velocity at the turning points (ends of the up sweeps) in m/s,
                receding positive, shape (..., pulse).

        Returns:
            The compensated sweeps.
        """
        return signal.with_data(
            compensate_motion(signal.data, velocity_m_s, self.radar, signal.axis("pulse"), self.carrier_only)
        )


class PhasePolish(Stage):
    """Residual phase of each pulse after motion compensation; see `phase_polish`.

    Provides `phase_rad` of shape (..., pulse).

    Args:
        iterations: Largest number of iterations with Wiener weights.
        tolerance_rad: Phase step in rad, rms over the pulses, below which the iterations of a trial
            end.
        assess: False leaves out standard deviation and outcome.
    """

    provides = ("phase_rad",)
    neutral = {"phase_rad": 0.0}

    def __init__(self, iterations: int = 80, tolerance_rad: float = 0.005, assess: bool = True) -> None:
        super().__init__()
        self.options: dict[str, Any] = {"iterations": iterations, "tolerance_rad": tolerance_rad, "assess": assess}

    def forward(self, signal: Signal) -> Estimate:
        """Estimate the residual phase of every pulse of a signal of axes (pulse, range).

        Returns:
            `Estimate` by the function `phase_polish` with `phase_rad` of shape (..., pulse), to be
            removed.
        """
        return phase_polish(signal.data, **self.options)


class PulseGain(Stage):
    """Amplitude of every pulse relative to steady scatterers; see `pulse_gain`.

    Provides `gain` of shape (..., pulse), by which `EqualisePulses` divides the pulses.

    Args:
        assess: False leaves out the outcome.
    """

    provides = ("gain",)
    neutral = {"gain": 1.0}

    def __init__(self, assess: bool = True) -> None:
        super().__init__()
        self.assess = assess

    def forward(self, signal: Signal) -> Estimate:
        """Estimate `gain` of a signal of axes (pulse, range)."""
        return pulse_gain(signal.data, assess=self.assess)


class EqualisePulses(Stage):
    """Stage that divides every pulse by its `gain`; see `equalise_pulses`.

    The gain usually comes from an earlier stage such as `PulseGain`.
    """

    def forward(self, signal: Signal, gain: Tensor) -> Signal:
        """Divide the pulses of a signal of axes (pulse, range) by their gains.

        Args:
            signal: Pulses, shape (..., pulse, range), complex.
            gain: Gains, shape (..., pulse).

        Returns:
            The equalised signal.
        """
        return signal.with_data(equalise_pulses(signal.data, gain))
