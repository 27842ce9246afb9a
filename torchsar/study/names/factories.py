"""Stages and impairments whose constructors take other objects or functions, from plain keys."""

from __future__ import annotations

import inspect
import math
import typing
from collections.abc import Callable, Sequence
from functools import wraps
from typing import Any, Literal

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.stages import Autofocus, CorrectPulsePhase
from torchsar.compensate.rotation import RotationAutofocus, UnevenRotation
from torchsar.compensate.velocity import EffectiveVelocity
from torchsar.core import Alternate, Estimate, Signal, Stage, Turn, per_trial
from torchsar.echo.channel_errors import PolynomialDrift, SinusoidDrift, SynchronisationError, WalkDrift
from torchsar.echo.response import ChannelResponse
from torchsar.focus import OmegaK, PaddedLines, TargetImage
from torchsar.optim.scalar import gradient_minimum, parabola_minimum
from torchsar.radar import LIGHT_M_S, FarField, InverseRadar, Spotlight, StripmapRadar
from torchsar.repair.jitter import BandLimited, CorrectJitter, Exact, Lagrange
from torchsar.repair.response import band_grid
from torchsar.repair.response_phase import EstimateResponse, estimate_response_points, estimate_response_sharpest
from torchsar.scene import Dechirped, ImageReflectivity, KSea, MeasuredTrack, Polynomial, Sinusoid

_REFINE = {"gradient": gradient_minimum, "parabola": parabola_minimum}


def effective_velocity(
    radar: StripmapRadar,
    reference: Literal["matched", "flat", "phase"] | None = "matched",
    reach_m_s: float = 80.0,
    lines: int = 512,
    refine: Literal["gradient", "parabola"] = "gradient",
    tolerance_m_s: float = 0.01,
) -> EffectiveVelocity:
    """Minimum-entropy velocity of range lines that are compressed with `reference` (None:
    compressed already).
    """
    return EffectiveVelocity(OmegaK(radar, reference), reach_m_s, lines, _REFINE[refine], tolerance_m_s)


def omega_k_padded(
    radar: StripmapRadar,
    reference: Literal["matched", "flat", "phase"] | None = "matched",
    velocity_m_s: float | None = None,
    doppler_hz: float | None = None,
    lines: int | None = None,
) -> PaddedLines:
    """omega_k with empty lines behind the record, one aperture by default, so that cut apertures do
    not wrap round.
    """
    return PaddedLines(OmegaK(radar, reference, velocity_m_s, doppler_hz), lines)


def rotation_and_phase(
    radar: InverseRadar,
    order: int = 3,
    yc_m: float = 0.0,
    rounds: int = 3,
    scatterers: int | None = None,
    search: int = 60,
    polish: int = 20,
) -> Alternate:
    """A phase per pulse and the rotation in turn (`RotationAutofocus`, `UnevenRotation`), each on
    the recorded data without what the other has found.

    yc_m is held: a phase that is free in every pulse takes all of the range centre deviation with
    it.
    """
    return Alternate(
        rounds,
        phase=Turn(RotationAutofocus(radar, search, polish), CorrectPulsePhase()),
        rotation=Turn(UnevenRotation(radar, order, yc_m, scatterers)),
    )


def jitter_lagrange(points: int = 4, offset_samples: list[float] | None = None) -> CorrectJitter:
    """Jitter correction by Lagrange interpolation through this many points.

    Args:
        points: Number of points of the interpolation.
        offset_samples: Offsets of one period in samples, where they are known.
    """
    return CorrectJitter(_tensor(offset_samples), Lagrange(points))


def jitter_band_limited(
    points: int = 8, band: float = 0.95, offset_samples: list[float] | None = None
) -> CorrectJitter:
    """Jitter correction by the best local weights for a signal of this band.

    Args:
        points: Number of points of the interpolation.
        band: Occupied share of the sampling rate.
        offset_samples: Offsets of one period in samples, where they are known.
    """
    return CorrectJitter(_tensor(offset_samples), BandLimited(points, band))


def jitter_exact(offset_samples: list[float] | None = None) -> CorrectJitter:
    """Jitter correction by exact periodic non-uniform reconstruction.

    Args:
        offset_samples: Offsets of one period in samples, where they are known.
    """
    return CorrectJitter(_tensor(offset_samples), Exact())


def _tensor(values: list[float] | None) -> Tensor | None:
    return None if values is None else torch.tensor(values, dtype=torch.float64)


def channel_response(
    quadratic_rad: Tensor | float = 0.0,
    cubic_rad: Tensor | float = 0.0,
    ripple_rad: Tensor | float = 0.0,
    ripple_cycles: Tensor | float = 3.0,
    slope_db: Tensor | float = 0.0,
    amplitude_ripple_db: Tensor | float = 0.0,
) -> ChannelResponse:
    """Impairment: phase quadratic u^2 + cubic u^3 + ripple sin(pi cycles u), and gain slope u / 2 +
    ripple cos(pi cycles u) in dB, u = -1..1 over the band.

    The phase is taken without its constant and linear parts: these are a phase and a shift of the
    whole scene, which nothing can tell from the scene's own.

    Args:
        quadratic_rad: Quadratic phase at the band edge in radians.
        cubic_rad: Cubic phase at the band edge in radians.
        ripple_rad: Amplitude of the phase ripple in radians.
        ripple_cycles: Cycles of the ripples over the band.
        slope_db: Gain difference of the band edges in dB.
        amplitude_ripple_db: Amplitude of the gain ripple in dB.
    """

    def curve(u: Tensor) -> Tensor:
        quadratic, cubic, ripple, cycles = (
            per_trial(v, 1, u) for v in (quadratic_rad, cubic_rad, ripple_rad, ripple_cycles)
        )
        return quadratic * u.square() + cubic * u**3 + ripple * torch.sin(math.pi * cycles * u)

    def phase(u: Tensor) -> Tensor:
        grid = band_grid(u.device)
        whole = curve(grid)
        slope = (whole * grid).sum(-1, keepdim=True) / grid.square().sum()
        return curve(u) - whole.mean(-1, keepdim=True) - u * slope

    def amplitude(u: Tensor) -> Tensor:
        slope, ripple, cycles = (per_trial(v, 1, u) for v in (slope_db, amplitude_ripple_db, ripple_cycles))
        return 10 ** ((slope * u / 2 + ripple * torch.cos(math.pi * cycles * u)) / 20)

    return ChannelResponse(phase, amplitude)


_RESPONSE = {"sharpest": estimate_response_sharpest, "points": estimate_response_points}


class FlatBandResponse(Stage):
    """EstimateResponse for images made with the `flat` reference: a clean one fills the pulse band
    evenly, so the amplitude is found as well.
    """

    works_on = EstimateResponse.works_on
    provides = EstimateResponse.provides

    def __init__(self, radar: StripmapRadar, method: Literal["sharpest", "points"] = "sharpest") -> None:
        super().__init__()
        self.radar, self.method = radar, _RESPONSE[method]

    def forward(self, signal: Signal) -> Estimate:
        even = torch.ones(signal.data.shape[-1], dtype=torch.float64, device=signal.data.device)
        return EstimateResponse(self.radar, self.method, even)(signal)


def estimate_response(radar: StripmapRadar, method: Literal["sharpest", "points"] = "sharpest") -> EstimateResponse:
    """Phase response of the channel from bright places of the focused image; the amplitude is left
    alone.
    """
    return EstimateResponse(radar, _RESPONSE[method])


def vibration(name: str, unit: Literal["mm", "um"]) -> Sinusoid:
    """Sinusoidal vibration by its published name amplitude_frequency_phase (1_100_90), the
    amplitude in `unit`.

    Args:
        name: Amplitude, frequency in Hz and phase in degrees, such as 1_100_90.
        unit: Unit of the amplitude.
    """
    return Sinusoid.named(name, unit=unit)


def drift(velocity_m_s: Tensor | float = 0.0, acceleration_m_s2: Tensor | float = 0.0) -> Polynomial:
    """Constant velocity and acceleration along the line of sight, d = v t + a t^2 / 2.

    Args:
        velocity_m_s: Velocity in m/s, receding positive.
        acceleration_m_s2: Acceleration in m/s^2.
    """
    return Polynomial((velocity_m_s, acceleration_m_s2 / 2))


def measured_track(file: str) -> MeasuredTrack:
    """A displacement (m) over time (s) from a file of two columns, text, .csv, .npy or .npz.

    Args:
        file: Path of the file.
    """
    return MeasuredTrack.from_file(file)


def dechirped(track_m: Sequence[Tensor | float] | None = None) -> Dechirped:
    """Dechirped pulses with the motion inside them; track_m: velocity, half the acceleration, ...

    that the range window follows.
    """
    return Dechirped((Polynomial(track_m),) if track_m else ())


class AutofocusOfImage(Autofocus):
    """`autofocus`, through polar format where the recording tells where the antenna was."""

    def __init__(
        self, radar: InverseRadar, geometry: FarField | Spotlight | None = None, search: int = 120, polish: int = 20
    ) -> None:
        super().__init__(search, polish)
        self.target = None if geometry is None else TargetImage(radar, geometry)

    def forward(self, signal: Signal, start: Tensor | None = None) -> Estimate:
        if self.target is not None:
            self.imaging = self.target.operator(signal.data)
        return super().forward(signal, start)


def k_sea(
    cnr_db: Tensor | float = 30.0,
    shape: Tensor | float = 1.5,
    cell_m: tuple[float, float] = (20.0, 20.0),
    margin_s: float | None = None,
    lobes: int = 1,
) -> KSea:
    """K-distributed sea, cnr_db over the noise in a range-compressed sample."""
    return KSea(power_db=cnr_db, shape=shape, cell_m=cell_m, margin_s=margin_s, lobes=lobes)


def image_sea(
    file: str,
    azimuth_extent_m: Tensor | float,
    range_extent_m: Tensor | float,
    cnr_db: Tensor | float = 30.0,
    key: str | None = None,
    margin_s: float | None = None,
    lobes: int = 1,
) -> ImageReflectivity:
    """A surface whose mean intensity is the image in a .npy or .npz file (array `key`), cnr_db over
    the noise in a range-compressed sample.
    """
    try:
        return ImageReflectivity.from_file(
            file, azimuth_extent_m, range_extent_m, key, power_db=cnr_db, margin_s=margin_s, lobes=lobes
        )
    except OSError as error:
        raise ValueError(f"the image {file!r} cannot be read: {error.strerror or error}") from None


def clock_errors(
    phase_rad: Sequence[Tensor | float] | None = None,
    phase_sinusoid_rad: Tensor | float = 0.0,
    phase_walk_rad: Tensor | float = 0.0,
    delay_s: Sequence[Tensor | float] | None = None,
    delay_sinusoid_s: Tensor | float = 0.0,
    sinusoid_hz: Tensor | float = 0.5,
    direct_snr_db: Tensor | float | None = 40.0,
    direct_samples: int = 64,
) -> SynchronisationError:
    """Clocks that drift apart: polynomials c0, c1, ... over seconds, sinusoids and a random walk
    from pulse to pulse; recorded beside a direct path that shows them.

    Args:
        phase_rad: Polynomial of the phase in rad, rad/s, ...
        phase_sinusoid_rad: Amplitude of a sinusoidal phase in radians.
        phase_walk_rad: Standard deviation of the steps of a random walk in radians.
        delay_s: Polynomial of the delay in s, s/s, ...
        delay_sinusoid_s: Amplitude of a sinusoidal delay in seconds.
        sinusoid_hz: Frequency of the sinusoids in Hz.
        direct_snr_db: Signal-to-noise ratio of the direct path in dB; None for none.
        direct_samples: Samples of the direct path.
    """
    phase = [
        PolynomialDrift(phase_rad or [0.0]),
        SinusoidDrift(phase_sinusoid_rad, sinusoid_hz),
        WalkDrift(phase_walk_rad),
    ]
    delay = [PolynomialDrift(delay_s or [0.0]), SinusoidDrift(delay_sinusoid_s, sinusoid_hz)]
    # delays need range cells; phases always draw from the same addresses
    delayed = bool(delay_s) or isinstance(delay_sinusoid_s, Tensor) or bool(delay_sinusoid_s)
    return SynchronisationError(phase, delay if delayed else [], direct_snr_db, direct_samples)


def with_wavelength(radar: type) -> Callable[..., Any]:
    """The constructor of a radar, which takes wavelength_m in place of carrier_hz as well."""

    @wraps(radar, updated=())
    def made(carrier_hz: float | None = None, wavelength_m: float | None = None, **keys: Any) -> Any:
        if (carrier_hz is None) == (wavelength_m is None):
            raise ValueError("give one of carrier_hz and wavelength_m, and leave the other null")
        speed = keys.get("wave_speed_m_s", LIGHT_M_S)
        return radar(carrier_hz=carrier_hz if wavelength_m is None else speed / wavelength_m, **keys)

    signature, optional = inspect.signature(radar), inspect.Parameter.KEYWORD_ONLY
    rest = [p.replace(kind=optional) for p in signature.parameters.values() if p.name != "carrier_hz"]
    first = [inspect.Parameter(name, optional, default=None) for name in ("carrier_hz", "wavelength_m")]
    made.__signature__ = signature.replace(parameters=[*first, *rest])  # pyright: ignore[reportAttributeAccessIssue]
    hints = typing.get_type_hints(radar.__init__)
    made.__annotations__ = {**hints, "carrier_hz": float | None, "wavelength_m": float | None}
    return made
