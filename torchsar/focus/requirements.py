"""Phase that each simplification of a stripmap focuser neglects in a given scene.

All values follow from the radar and from the slow-time and range axes of the data, before any
simulation.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from torchsar.core import Axis
from torchsar.focus.frame_geometry import FrameGeometry, wavenumber
from torchsar.focus.skew import EXCESS, skew_hz
from torchsar.radar import StripmapRadar

# name of the simplification that every form of omega-K and range-Doppler makes
EQUAL_WEIGHTS = "equal weights of range frequencies"


@dataclass(frozen=True)
class Requirement:
    """One simplification and the largest phase that it neglects anywhere in the scene.

    Args:
        effect: Name of the simplification.
        neglects: Description of the neglected term.
        phase_rad: Largest neglected phase in rad.
        range_cells: Neglected shift in range cells; nan where no shift is neglected.
        tolerance_rad: Tolerated phase in rad.
        remedy: Remedy where the simplification is not permissible.
        error_db: Predicted error in dB of the image of a point for which the neglected phase is
            largest: the relative error of `phase_error_db`, or the loss of the peak; nan where no
            error is predicted.
        tolerance_db: Largest permissible `error_db` in dB.
        limit_rad: Largest permissible `phase_rad` in rad where an error is predicted.
    """

    effect: str
    neglects: str
    phase_rad: float
    range_cells: float
    tolerance_rad: float
    remedy: str
    error_db: float = math.nan
    tolerance_db: float = -20.0
    limit_rad: float = math.inf

    @property
    def ok(self) -> bool:
        """True where the simplification is permissible.

        If `error_db` is predicted, it must not exceed `tolerance_db`, nor `phase_rad` exceed
        `limit_rad`. Otherwise `phase_rad` must not exceed `tolerance_rad`.
        """
        if math.isnan(self.error_db):
            return self.phase_rad <= self.tolerance_rad
        return self.error_db <= self.tolerance_db and self.phase_rad <= self.limit_rad

    @property
    def verdict(self) -> str:
        """ "enough" where the simplification is permissible, otherwise the remedy."""
        return "enough" if self.ok else self.remedy


@dataclass(frozen=True)
class Limit:
    """One limit of a method, with the value of the limited quantity in a given scene.

    Args:
        name: Name of the quantity.
        value: Value of the quantity in the scene, in `unit`.
        limit: Limit of the method, in `unit`.
        unit: Unit of `value` and `limit`, empty for pure numbers.
        beyond: Verdict where the limit is not met: "warn", or "refuse" if the method then fails.
        consequence: Consequence where the limit is not met.
        remedy: Remedy where the limit is not met.
        at_least: True if the value must be at least the limit, False if it must be below.
    """

    name: str
    value: float
    limit: float
    unit: str
    beyond: Literal["warn", "refuse"]
    consequence: str
    remedy: str
    at_least: bool = False

    @property
    def ok(self) -> bool:
        """True where the limit is met."""
        return self.value >= self.limit if self.at_least else self.value < self.limit

    @property
    def verdict(self) -> Literal["ok", "warn", "refuse"]:
        """ "ok" where the limit is met, otherwise `beyond`."""
        return "ok" if self.ok else self.beyond

    @property
    def sentence(self) -> str:
        """One sentence with value and limit, and if it is not met, consequence and remedy."""
        relation = "at least" if self.at_least else "below"
        figures = (
            f"{self.name} is {f'{self.value:.4g} {self.unit}'.strip()}, and must be {relation} "
            f"{f'{self.limit:.4g} {self.unit}'.strip()}"
        )
        return figures if self.ok else f"{figures}: {self.consequence}; {self.remedy}"


def refuse_numbers(least: float, **numbers: float) -> None:
    """Raise an error for numbers that are not finite or too small.

    Args:
        least: Least accepted value; minus infinity for numbers of either sign.
        **numbers: Numbers by name.

    Raises:
        ValueError: If a number is not finite or below `least`.
    """
    for name, value in numbers.items():
        if not (math.isfinite(value) and value >= least):
            sign = "" if least == -math.inf else "positive " if least > 0 else "non-negative "
            raise ValueError(f"{name} must be a finite {sign}number, got {value}")


def phase_error_db(phase_rad: Tensor) -> float:
    """Relative error of a response with a neglected phase: mean |exp(j phi) - 1|^2 in dB.

    A quadratic phase that reaches pi / 4 at the ends of an aperture gives -9.2 dB, or -12.7 dB if
    its mean is removed.

    Args:
        phase_rad: Phase in rad over the support of the spectrum, any shape.

    Returns:
        Relative error in dB, at least -300 dB.
    """
    error = float((2 - 2 * torch.cos(phase_rad)).mean())
    return 10 * math.log10(max(error, 1e-30))


@dataclass(frozen=True)
class Aperture:
    """Samples of the Doppler band and the range band that the spectrum of a target occupies.

    The Doppler band of a target is proportional to the transmitted frequency: at the range
    frequency f it is 1 + f / f0 times that at the carrier f0.

    Args:
        at: Geometry at the sampled Doppler frequencies at the carrier.
        frequency_hz: Sampled range frequencies relative to the carrier in Hz, shape (f,).
        integration_s: Integration time in seconds.
        doppler_band_hz: Doppler bandwidth in Hz.
    """

    at: FrameGeometry
    frequency_hz: Tensor
    integration_s: float
    doppler_band_hz: float

    @staticmethod
    def of(
        radar: StripmapRadar,
        range_m: float,
        doppler_hz: float,
        velocity_m_s: float,
        frame_hz: float,
        integration_s: float | None,
        samples: int = 65,
    ) -> Aperture:
        """Sample the Doppler band and the range band of a target.

        Warns if the PRF is below the Doppler bandwidth of the aperture.

        Args:
            radar: Radar of the recording.
            range_m: Slant range of the target in metres.
            doppler_hz: Absolute Doppler centroid in Hz.
            velocity_m_s: Effective velocity in m/s.
            frame_hz: Doppler frequency in Hz of the line of sight that defines the image
                coordinates, see `omega_k`.
            integration_s: Integration time in seconds; None for the time in which the Doppler of
                the target changes by one PRF.
            samples: Number of samples per axis.

        Returns:
            The sampled bands.
        """
        cos2 = 1 - float(radar.sin_squint(doppler_hz, velocity_m_s)) ** 2
        rate = float(radar.azimuth_rate_hz_s(range_m, velocity_m_s)) * cos2
        wanted = radar.prf_hz / rate if integration_s is None else integration_s
        band = min(rate * wanted, radar.prf_hz)
        if rate * wanted > 1.001 * radar.prf_hz:
            warnings.warn(
                f"PRF {radar.prf_hz:g} Hz is below the Doppler band {rate * wanted:.6g} Hz of a "
                f"{wanted:g} s aperture: its ends alias in azimuth; shorten the aperture to "
                f"{radar.prf_hz / rate:.3g} s",
                stacklevel=3,
            )
        doppler = doppler_hz + band * torch.linspace(-0.5, 0.5, samples, dtype=torch.float64)
        frequency = radar.pulse.bandwidth_hz * torch.linspace(-0.5, 0.5, samples, dtype=torch.float64)
        velocity, frame = (torch.tensor(v, dtype=torch.float64) for v in (velocity_m_s, frame_hz))
        return Aperture(FrameGeometry(radar, doppler, velocity, frame), frequency, band / rate, band)

    @property
    def doppler_hz(self) -> Tensor:
        """Doppler of the target at each carrier Doppler and range frequency in Hz, shape (d, f)."""
        return self.at.doppler_hz[:, None] * (1 + self.frequency_hz / self.at.radar.carrier_hz)

    @property
    def wrapped(self) -> Tensor:
        """True where the Doppler lies outside the PRF interval about the centroid at the carrier.
        Shape (d, f), bool.

        A focuser that unwraps all range frequencies about this centroid loses these parts of the
        spectrum. An excess of a twentieth of the PRF is tolerated.
        """
        reach = (1 + EXCESS) * self.at.radar.prf_hz / 2
        return (self.doppler_hz - self.at.doppler_hz.mean()).abs() > reach

    def _mapped(self, frequency_hz: Tensor) -> Tensor:
        """Mapping G - f0 at `doppler_hz` and at range frequencies (f,) or (1,), shape (d, f)."""
        at = self.at
        return wavenumber(at.radar, frequency_hz[:, None], self.doppler_hz, at.velocity_m_s, at.frame_hz)[..., 0]

    @property
    def carrier_row(self) -> Tensor:
        """Omega-K mapping G - f0 at the carrier f0 in Hz, see `wavenumber`, shape (d, f)."""
        return self._mapped(torch.zeros(1, dtype=torch.float64))

    @property
    def slope(self) -> Tensor:
        """Relative range migration at each Doppler at the carrier, shape (Doppler, 1).

        It is dG / df - 1 at the carrier, with the omega-K mapping G of `wavenumber`.
        """
        step = 1e-3 * self.at.radar.carrier_hz
        ends = self.at.mapped(torch.tensor([-step, step], dtype=torch.float64))
        return (ends[:, 1:] - ends[:, :1]) / (2 * step) - 1

    def bulk_residual_rad(self, offset_m: float) -> Tensor:
        """Compute the phase that omega-K without Stolt interpolation leaves away from centre range.

        It is 2 pi (2 dr / c) (G(f) - G(0) - f) at range frequency f, with the mapping G of
        `wavenumber` at each Doppler.

        Args:
            offset_m: Distance dr of the target from the centre range in metres.

        Returns:
            Phase in rad, shape (d, f), over Doppler and range frequency.
        """
        left = self._mapped(self.frequency_hz) - self.carrier_row - self.frequency_hz
        return 4 * math.pi * offset_m / self.at.radar.wave_speed_m_s * left

    def coupling_rad(self, range_m: float) -> Tensor:
        """Compute the phase that the range-Doppler algorithm leaves.

        It is 2 pi (2 R / c) (G(f) - G(0) - G'(0) f) at range frequency f, with the mapping G of
        `wavenumber` at each Doppler and its slope G' over f: the terms beyond linear ones in f.

        Args:
            range_m: Slant range R of the target in metres.

        Returns:
            Phase in rad, shape (d, f), over Doppler and range frequency.
        """
        step = torch.full((1,), 1e-3 * self.at.radar.carrier_hz, dtype=torch.float64)
        slope = (self._mapped(step) - self._mapped(-step)) / (2 * step)
        left = self._mapped(self.frequency_hz) - self.carrier_row - slope * self.frequency_hz
        return 4 * math.pi * range_m / self.at.radar.wave_speed_m_s * left


def requirements(
    radar: StripmapRadar,
    axes: tuple[Axis, ...],
    doppler_hz: float | None = None,
    velocity_m_s: float | None = None,
    integration_s: float | None = None,
    frame_hz: float | None = None,
    tolerance_rad: float = math.pi / 4,
    velocity_error_m_s: float = 1.0,
    tolerance_db: float = -20.0,
) -> tuple[Requirement, ...]:
    """List the largest phase that each simplification of a focuser neglects in a stripmap scene.

    >>> from torchsar import focus, radar
    >>> sensor = radar.StripmapRadar(carrier_hz=3.2e9, pulse=radar.LinearFM(40e6, 0.5e-6),
    ...     sampling_hz=48e6, prf_hz=400.0, velocity_m_s=120.0, near_range_m=4000.0)
    >>> rows = focus.requirements(sensor, sensor.raw_axes(1024, 256))
    >>> [row.effect for row in rows if not row.ok]  # what may not be neglected
    ['bulk + refocus (omega_k)', 'parabolic range history', 'velocity wrong by 1 m/s']

    A range shift is also given as its phase at the ends of the range band; a quarter of a range
    resolution cell is a phase of pi/4. Warns where the PRF is below the Doppler band of a target.

    Args:
        radar: Radar of the recording.
        axes: Axes of the raw matrix, (pulse, range).
        doppler_hz: Absolute Doppler centroid in Hz; None for the nominal pointing of the radar, or
            0 where it has none.
        velocity_m_s: Effective velocity in m/s; None for that of the radar.
        integration_s: Integration time of a target in seconds; None for that of the radar, or where
            it has none, the time in which the Doppler of a target sweeps one PRF.
        frame_hz: Doppler frequency in Hz of the line of sight that defines the image coordinates, 0
            for a zero-Doppler image; None for the nominal pointing of the radar, or for the
            centroid where the radar has none.
        tolerance_rad: Tolerated phase in rad.
        velocity_error_m_s: Error of the effective velocity in m/s that the row "velocity wrong by"
            assumes.
        tolerance_db: Tolerated relative error in dB of the image of a point, for simplifications
            whose error is predicted.

    Returns:
        One `Requirement` per simplification: what it neglects, the error and the remedy.
    """
    # range at which bulk processing is exact
    middle = axes[-1].start + axes[-1].n // 2 * axes[-1].step
    velocity = radar.velocity_m_s if velocity_m_s is None else float(velocity_m_s)
    doppler = (radar.pointing_doppler_hz or 0.0) if doppler_hz is None else float(doppler_hz)
    frame = (
        float(frame_hz)
        if frame_hz is not None
        else radar.pointing_doppler_hz
        if radar.pointing_doppler_hz is not None
        else doppler
    )
    aperture = Aperture.of(
        radar, middle, doppler, velocity, frame, radar.integration_s if integration_s is None else integration_s
    )
    near, far = full_swath_m(radar, axes, doppler, velocity, aperture.integration_s)
    half = max(abs(near - middle), abs(far - middle))
    # a phase of pi / 2 has the mean square error of the random phase of wrapped parts
    bulk_rad, coupling_rad = (
        torch.where(aperture.wrapped, math.pi / 2, phase)
        for phase in (aperture.bulk_residual_rad(half), aperture.coupling_rad(far))
    )
    skewed_rad = torch.where(aperture.wrapped, math.pi / 2, 0.0).to(torch.float64)
    bulk, rda, skewed = (float(x.abs().max()) for x in (bulk_rad, coupling_rad, skewed_rad))
    path, cells = _parabola_rad(aperture, near), radar.range_step_m
    band_turns = radar.pulse.bandwidth_hz / radar.wave_speed_m_s
    walk = abs(float(radar.sin_squint(doppler, velocity))) * velocity * aperture.integration_s
    back_turns = 2 * radar.carrier_hz / radar.wave_speed_m_s
    defocus = 2 * math.pi * back_turns * velocity * velocity_error_m_s * (aperture.integration_s / 2) ** 2 / near
    inside = math.pi * aperture.doppler_band_hz * radar.pulse.duration_s
    displaced = abs(doppler) / abs(radar.pulse.rate_hz_s) * radar.sampling_hz
    single = 2 * math.pi * back_turns * far * 2.0**-24
    # mean square over the band of (1 + f / f0)^(-1/2) - 1, which is about f / (2 f0)
    equal_weights = (radar.pulse.bandwidth_hz / radar.carrier_hz) ** 2 / 48

    def row(
        effect: str,
        neglects: str,
        phase_rad: float,
        range_cells: float,
        remedy: str,
        over: Tensor | None = None,
        limit_rad: float = math.inf,
    ) -> Requirement:
        error_db = math.nan if over is None else 10 * math.log10(10 ** (phase_error_db(over) / 10) + equal_weights)
        return Requirement(
            effect, neglects, phase_rad, range_cells, tolerance_rad, remedy, error_db, tolerance_db, limit_rad
        )

    without_stolt = row(
        "bulk + refocus (omega_k)",
        "change of migration over the swath",
        bulk,
        float(aperture.slope.abs().max()) * half / cells,
        "use omega_k_stolt",
        bulk_rad,
    )
    one_centroid = row(
        "one Doppler centroid for all range frequencies",
        f"skew of the spectrum; an aperture spans {aperture.doppler_band_hz + skew_hz(radar, doppler):.4g} Hz, "
        f"{skew_hz(radar, doppler):.2g} Hz of them by the skew, the PRF is {radar.prf_hz:g} Hz",
        skewed,
        math.nan,
        "use omega_k_stolt",
        skewed_rad,
    )
    return (
        without_stolt,
        row(
            "range-Doppler",
            "coupling of range and azimuth (no secondary range compression)",
            rda,
            math.nan,
            "use omega_k" if without_stolt.ok and one_centroid.ok else "use omega_k_stolt",
            coupling_rad,
            # Measured increase of the PSLR in range over exact focusing: 0.03 dB at 0.6 rad without
            # squint; 0.10 dB at 0.53 rad and 0.8 dB at 1.2 rad with squint.
            0.5,
        ),
        one_centroid,
        row(
            EQUAL_WEIGHTS,
            "weights (1 + f / f0)^(-1/2) of the range frequencies f, which the direct sum has",
            0.0,
            math.nan,
            "multiply the range spectrum of the image by them",
            torch.zeros(1),
        ),
        row(
            "parabolic range history", "third and higher orders of the hyperbola", path, math.nan, "keep the hyperbola"
        ),
        row(
            "squint ignored",
            "range walk of the beam centre over the aperture",
            2 * math.pi * band_turns * walk,
            walk / cells,
            "focus about the Doppler centroid",
        ),
        row(
            f"velocity wrong by {velocity_error_m_s:g} m/s",
            "quadratic phase over the aperture",
            defocus,
            math.nan,
            "estimate the effective velocity",
        ),
        row(
            "stop and go",
            "change of Doppler inside the pulse over the aperture (the cells: a constant shift)",
            inside,
            displaced,
            "model the motion inside the pulse",
        ),
        row(
            "range in float32",
            "rounding of absolute ranges",
            single,
            single / (2 * math.pi * back_turns) / cells,
            "form phases in float64 turns (always done here)",
        ),
    )


def full_swath_m(
    radar: StripmapRadar, axes: tuple[Axis, ...], doppler_hz: float, velocity_m_s: float, integration_s: float
) -> tuple[float, float]:
    """Compute the slant ranges whose echoes are recorded over the whole aperture.

    Args:
        radar: Radar of the recording.
        axes: Axes of the raw matrix, (pulse, range).
        doppler_hz: Absolute Doppler centroid in Hz.
        velocity_m_s: Effective velocity in m/s.
        integration_s: Integration time of a target in seconds.

    Returns:
        Least and largest slant range at the crossing of the beam centre in metres. Where no range
        is recorded over the whole aperture, both are the middle of the record.
    """
    start, stop = axes[-1].start, axes[-1].stop - radar.pulse_samples * axes[-1].step
    along = velocity_m_s * integration_s / 2
    walk = along * abs(float(radar.sin_squint(doppler_hz, velocity_m_s))) + along**2 / (2 * start)
    middle = (axes[-1].start + axes[-1].stop) / 2
    return (start + walk, stop - walk) if start + walk <= stop - walk else (middle, middle)


def strip_limits(radar: StripmapRadar, samples: int, doppler_hz: float, velocity_m_s: float) -> tuple[Limit, ...]:
    """Compare the Doppler band of the aperture of a stripmap radar with its PRF.

    Args:
        radar: Radar of the recording.
        samples: Number of range samples of a line; the Doppler rate is that at the middle one.
        doppler_hz: Absolute Doppler centroid in Hz.
        velocity_m_s: Effective velocity in m/s.

    Returns:
        The limit of the Doppler band; an empty tuple where the radar has no integration time.
    """
    if radar.integration_s is None:
        return ()
    middle = radar.near_range_m + samples // 2 * radar.range_step_m
    cos2 = 1 - float(radar.sin_squint(doppler_hz, velocity_m_s)) ** 2
    rate = float(radar.azimuth_rate_hz_s(middle, velocity_m_s)) * cos2
    shorter = f"shorten the aperture to {radar.prf_hz / rate:.3g} s, or raise the PRF"
    name = f"Doppler band of a {radar.integration_s:g} s aperture"
    return (Limit(name, rate * radar.integration_s, radar.prf_hz, "Hz", "warn", "its ends alias in azimuth", shorter),)


def _parabola_rad(aperture: Aperture, range_m: float) -> float:
    """Largest phase 4 pi / lambda |r - parabola| over the aperture of a target at slant range
    range_m.

    The parabola touches the range history at the beam centre.
    """
    radar, velocity = aperture.at.radar, float(aperture.at.velocity_m_s)
    sin = float(radar.sin_squint(aperture.at.doppler_hz.mean(), velocity))
    along = velocity * aperture.integration_s * torch.linspace(-0.5, 0.5, 65, dtype=torch.float64)
    excess = along * (along - 2 * range_m * sin)
    exact = excess / (torch.sqrt(range_m**2 + excess) + range_m)
    parabola = -along * sin + along.square() * (1 - sin**2) / (2 * range_m)
    return float((exact - parabola).abs().max()) * 4 * math.pi / radar.wavelength_m
