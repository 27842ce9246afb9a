"""Factories that build stages, scenes and impairments from plain keys of a config, where their
constructors take objects or functions.
"""

from __future__ import annotations

import inspect
import typing
from collections.abc import Callable, Sequence
from functools import wraps
from typing import Any, Literal

import torch
from torch import Tensor

from torchsar.compensate import Autofocus, EffectiveVelocity, RotationAutofocus, UnevenRotation
from torchsar.compensate.pulse_phase import CorrectPulsePhase
from torchsar.core import Alternate, Turn
from torchsar.focus import OmegaK, PaddedLines, TargetImage
from torchsar.io.plain import measured_displacement, read_array
from torchsar.radar import LIGHT_M_S, FarField, InverseRadar, Spotlight, StripmapRadar, read_track
from torchsar.repair import BandLimited, CorrectJitter, Lagrange
from torchsar.scene import Dechirped, ImageReflectivity, KSea, MeasuredTrack, Polynomial, RecordedPath


def effective_velocity(
    radar: StripmapRadar,
    reference: Literal["matched", "flat", "phase"] | None = "matched",
    reach_m_s: float = 80.0,
    lines: int = 512,
    tolerance_m_s: float = 0.01,
    assess: bool = True,
) -> EffectiveVelocity:
    """Estimator of the effective velocity, as the velocity that gives the least image entropy.

    Args:
        reference: Reference of the range compression; None if the lines are already compressed.
        reach_m_s: Largest error of the nominal velocity in m/s.
        lines: Number of range cells that are used, at least 16.
        tolerance_m_s: Tolerance of the refinement in m/s.
        assess: Whether to add the standard deviation and the outcome.
    """
    return EffectiveVelocity(OmegaK(radar, reference), reach_m_s, lines, tolerance_m_s=tolerance_m_s, assess=assess)


def omega_k_padded(
    radar: StripmapRadar,
    reference: Literal["matched", "flat", "phase"] | None = "matched",
    velocity_m_s: float | None = None,
    doppler_hz: float | None = None,
    lines: int | None = None,
) -> PaddedLines:
    """Omega-K focusing with empty lines appended to the record, so that apertures that are cut off
    at its end do not appear at its beginning.

    Args:
        reference: Reference of the range compression; None if the lines are already compressed.
        velocity_m_s: Velocity in m/s; None for that of the radar.
        doppler_hz: Doppler centroid in Hz; None for that of the radar.
        lines: Number of empty lines; None for one aperture.
    """
    return PaddedLines(OmegaK(radar, reference, velocity_m_s, doppler_hz), lines)


def autofocus(
    radar: InverseRadar,
    geometry: FarField | Spotlight | None = None,
    search: int = 120,
    polish: int = 20,
    scene: Literal["sparse", "points", "clutter", "auto"] = "sparse",
    assess: bool = True,
) -> Autofocus:
    """Phase per pulse that sharpens the image of a target; see `torchsar.compensate.autofocus`.

    The image is the polar-format image of `TargetImage` if `geometry` is given, and the Fourier
    transform along pulses otherwise.

    Args:
        geometry: Geometry of the recording; None if it is not known.
        search: Largest number of iterations of the entropy fixed point, approximately.
        polish: Largest number of further iterations, which compare each pulse with a Wiener
            estimate of the scene.
        scene: Kind of the scene: "sparse", "points", "clutter" or "auto"; with a geometry it is
            taken to be sparse.
        assess: Whether to add the standard deviation and the outcome.
    """
    imaging = None if geometry is None else TargetImage(radar, geometry)
    return Autofocus(search, polish, imaging, scene, assess)


def rotation_and_phase(
    radar: InverseRadar,
    order: int = 3,
    yc_m: float = 0.0,
    rounds: int = 3,
    scatterers: int | None = None,
    search: int = 60,
    polish: int = 20,
    assess: bool = True,
) -> Alternate:
    """Alternate estimation of a phase error per pulse (`RotationAutofocus`) and of the non-uniform
    rotation (`UnevenRotation`) of a target, each from the data after correction of the other.

    Args:
        order: Degree of the rotation angle as a polynomial of slow time.
        yc_m: Range in metres from the centre of rotation to the zero of the range axis. It is not
            estimated, because the phase errors of the pulses absorb its whole effect.
        rounds: Number of rounds; each round estimates the phase and then the rotation.
        scatterers: Largest number of scatterers by which the rotation is estimated.
        search: Largest number of fixed-point iterations for the phase of least image entropy.
        polish: Largest number of further iterations for the phase, which compare each pulse with a
            Wiener estimate of the scene.
        assess: Whether to add the standard deviations and the outcome.
    """
    return Alternate(
        rounds,
        phase=Turn(RotationAutofocus(radar, search, polish, assess=assess), CorrectPulsePhase()),
        rotation=Turn(UnevenRotation(radar, order, yc_m, scatterers, assess=assess)),
    )


def jitter_lagrange(points: int = 4, offset_samples: Tensor | None = None) -> CorrectJitter:
    """Correction of periodic sampling jitter by Lagrange interpolation.

    Args:
        points: Number of points of the interpolation.
        offset_samples: Offsets of one period in samples, if they are known.
    """
    return CorrectJitter(offset_samples, Lagrange(points))


def jitter_band_limited(points: int = 8, band: float = 0.95, offset_samples: Tensor | None = None) -> CorrectJitter:
    """Correction of periodic sampling jitter by interpolation with the weights of least error for a
    band-limited signal.

    Args:
        points: Number of points of the interpolation.
        band: Ratio of the bandwidth of the signal to the sampling rate.
        offset_samples: Offsets of one period in samples, if they are known.
    """
    return CorrectJitter(offset_samples, BandLimited(points, band))


def drift(velocity_m_s: Tensor | float = 0.0, acceleration_m_s2: Tensor | float = 0.0) -> Polynomial:
    """Constant velocity and acceleration along the line of sight, d = v t + a t^2 / 2.

    Args:
        velocity_m_s: Velocity in m/s, receding positive.
        acceleration_m_s2: Acceleration in m/s^2.
    """
    return Polynomial((velocity_m_s, acceleration_m_s2 / 2))


def dechirped(track_m: Sequence[Tensor | float] | None = None) -> Dechirped:
    """Echo model of dechirped pulses, with the range of a target computed at every sample.

    Args:
        track_m: Polynomial that the range window follows: velocity in m/s, half the acceleration in
            m/s^2, and so on; None for a fixed range window.
    """
    return Dechirped((Polynomial(track_m),) if track_m else ())


def k_sea(
    cnr_db: Tensor | float = 30.0,
    shape: Tensor | float = 1.5,
    cell_m: tuple[float, float] = (20.0, 20.0),
    margin_s: float | None = None,
    lobes: int = 1,
) -> KSea:
    """K-distributed sea clutter.

    Args:
        cnr_db: Clutter-to-noise ratio of a range-compressed sample in dB.
        shape: Shape of the gamma distribution; small for spiky seas.
        cell_m: Along-track and range side of the cells of constant texture in metres.
        margin_s: Time in s by which the surface extends beyond the record at both ends; None to
            reach to the edge of the illumination.
        lobes: Number of nulls of the antenna pattern, to either side of its maximum, up to which
            the antenna illuminates the surface.
    """
    return KSea(power_db=cnr_db, shape=shape, cell_m=cell_m, margin_s=margin_s, lobes=lobes)


def measured_track(file: str) -> MeasuredTrack:
    """Measured displacement at equally spaced times, interpolated by a cubic spline.

    Args:
        file: Text or .csv file of two columns, times in seconds and displacements in metres
            (separated by commas or blanks, a line of names is allowed), .npy file of shape (n, 2),
            or .npz file with `time_s` (n,) and `displacement_m` (..., n).
    """
    time_s, displacement_m = (torch.as_tensor(x, dtype=torch.float64) for x in measured_displacement(file))
    try:
        return MeasuredTrack(time_s, displacement_m)
    except ValueError as problem:
        raise ValueError(f"{file}: {problem}") from None


def recorded_path(file: str, origin: Sequence[float] | None = None, start_s: float | None = None) -> RecordedPath:
    """Path of a motion log, between whose records cubic splines interpolate.

    Args:
        file: Table (.csv, text, .npz) with the columns time, x, y, z in s and m, or time, latitude,
            longitude, height in s, degrees and m, see `torchsar.radar.read_track`.
        origin: Origin of the coordinates of the world: x, y, z, or latitude, longitude, height;
            null for that of the log, or the place of its first record at height 0.
        start_s: Time of the first pulse on the clock of the log; null for the first record.
    """
    try:
        return RecordedPath(read_track(file, origin), start_s)
    except OSError as error:
        raise ValueError(str(error)) from None


def image_sea(
    file: str,
    azimuth_extent_m: Tensor | float,
    range_extent_m: Tensor | float,
    cnr_db: Tensor | float = 30.0,
    key: str | None = None,
    margin_s: float | None = None,
    lobes: int = 1,
) -> ImageReflectivity:
    """Surface whose mean intensity is the image in a .npy or .npz file.

    Args:
        file: Path of the file.
        azimuth_extent_m: Along-track extent of the image in metres.
        range_extent_m: Range extent of the image in metres.
        cnr_db: Clutter-to-noise ratio of a range-compressed sample in dB.
        key: Name of the array in an .npz file of several arrays.
        margin_s: Time in s by which the surface extends beyond the record at both ends; None to
            reach to the edge of the illumination.
        lobes: Number of nulls of the antenna pattern, to either side of its maximum, up to which
            the antenna illuminates the surface.
    """
    try:
        keys = {"power_db": cnr_db, "margin_s": margin_s, "lobes": lobes}
        return ImageReflectivity(read_array(file, key), azimuth_extent_m, range_extent_m, **keys)
    except OSError as error:
        raise ValueError(f"the image {file!r} cannot be read: {error.strerror or error}") from None


def with_wavelength(radar: type) -> Callable[..., Any]:
    """Return the constructor of a radar with `wavelength_m` as an alternative to `carrier_hz`.

    Args:
        radar: Class of the radar, with the parameter `carrier_hz`.

    Returns:
        A function with the signature of the class and the parameter `wavelength_m`.
    """

    @wraps(radar, updated=())
    def made(carrier_hz: float | None = None, wavelength_m: float | None = None, **keys: Any) -> Any:
        if (carrier_hz is None) == (wavelength_m is None):
            raise ValueError("give one of carrier_hz and wavelength_m, and leave the other null")
        speed = keys.get("wave_speed_m_s", LIGHT_M_S)
        return radar(carrier_hz=carrier_hz if wavelength_m is None else speed / wavelength_m, **keys)

    signature, optional = inspect.signature(radar), inspect.Parameter.KEYWORD_ONLY
    rest = [p.replace(kind=optional) for p in signature.parameters.values() if p.name != "carrier_hz"]
    first = [inspect.Parameter(name, optional, default=None) for name in ("carrier_hz", "wavelength_m")]
    made.__signature__, made.__doc__ = (  # pyright: ignore[reportAttributeAccessIssue]
        signature.replace(parameters=[*first, *rest]),
        inspect.cleandoc(radar.__doc__ or "").replace(
            "carrier_hz:", "wavelength_m: Wavelength in metres, in place of `carrier_hz`.\n    carrier_hz:", 1
        ),
    )
    hints = typing.get_type_hints(radar.__init__)
    made.__annotations__ = {**hints, "carrier_hz": float | None, "wavelength_m": float | None}
    return made
