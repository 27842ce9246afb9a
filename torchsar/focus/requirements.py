"""What a stripmap scene requires of its focuser: the phase that each simplification would neglect,
predicted before anything runs.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import Axis
from torchsar.focus.omega_k import FrameGeometry
from torchsar.radar import StripmapRadar


@dataclass(frozen=True)
class Requirement:
    """One simplification: the largest phase it neglects anywhere in the scene, the same as range
    cells (nan where it is no shift), the verdict.
    """

    effect: str
    neglects: str
    phase_rad: float
    range_cells: float
    tolerance_rad: float
    remedy: str

    @property
    def ok(self) -> bool:
        """Whether the simplification may be made."""
        return self.phase_rad <= self.tolerance_rad

    @property
    def verdict(self) -> str:
        return "enough" if self.ok else self.remedy


@dataclass(frozen=True)
class Aperture:
    """The part of the wavenumber plane that a scene fills, sampled: the radar at its Doppler rows,
    and the range band.
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
        """Doppler rows of a target at slant range range_m seen for integration_s (None: as long as
        it stays inside one PRF).
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
    def carrier_row(self) -> Tensor:
        """G(0, X) - f0, (d, 1)."""
        return self.at.mapped(torch.zeros(1, dtype=torch.float64))

    @property
    def slope(self) -> Tensor:
        """dG / df at the carrier, minus one, (d, 1): the relative migration of a row."""
        step = 1e-3 * self.at.radar.carrier_hz
        ends = self.at.mapped(torch.tensor([-step, step], dtype=torch.float64))
        return (ends[:, 1:] - ends[:, :1]) / (2 * step) - 1

    def bulk_residual_rad(self, offset_m: float) -> Tensor:
        """Phase (d, f) that bulk + refocus leave on a target offset_m from the centre range: 2 pi
        (2 dr / c) (G(f) - G(0) - f).
        """
        left = self.at.mapped(self.frequency_hz) - self.carrier_row - self.frequency_hz
        return 4 * math.pi * offset_m / self.at.radar.wave_speed_m_s * left

    def coupling_rad(self, range_m: float) -> Tensor:
        """Phase (d, f) that range-Doppler leaves at range_m: the curvature of G over the range
        band, 2 pi (2 R / c) (G(f) - G(0) - G'(0) f).
        """
        left = self.at.mapped(self.frequency_hz) - self.carrier_row - (1 + self.slope) * self.frequency_hz
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
) -> tuple[Requirement, ...]:
    """Table of simplifications with the phase [rad] that each neglects at worst in this scene,
    against tolerance_rad.

    axes: of the raw matrix, (pulse, range). doppler_hz: absolute centroid, by default the nominal
    pointing or 0; frame_hz: by default the nominal pointing, else the centroid (as the focusers
    choose it); integration_s: time that a target is seen, by default the radar's own, else one PRF
    of Doppler. A quarter of a range resolution cell of migration is pi/4 at the ends of the band:
    the two ways of counting agree. Warns where the PRF is below the Doppler band. Source: brief
    004, "Model only what a scene requires".
    """
    near, far = axes[-1].start, axes[-1].stop
    middle, half = (near + far) / 2, (far - near) / 2
    velocity = radar.velocity_m_s if velocity_m_s is None else float(velocity_m_s)
    doppler = (radar.pointing_doppler_hz or 0.0) if doppler_hz is None else float(doppler_hz)
    frame = (
        float(frame_hz)
        if frame_hz is not None
        else radar.pointing_doppler_hz
        if radar.pointing_doppler_hz is not None
        else doppler
    )
    seen = Aperture.of(
        radar, middle, doppler, velocity, frame, radar.integration_s if integration_s is None else integration_s
    )
    bulk, rda = (float(x.abs().max()) for x in (seen.bulk_residual_rad(half), seen.coupling_rad(far)))
    path, cells = _parabola_rad(seen, near), radar.range_step_m
    band_turns = radar.pulse.bandwidth_hz / radar.wave_speed_m_s
    walk = abs(float(radar.sin_squint(doppler, velocity))) * velocity * seen.integration_s
    back_turns = 2 * radar.carrier_hz / radar.wave_speed_m_s
    defocus = 2 * math.pi * back_turns * velocity * velocity_error_m_s * (seen.integration_s / 2) ** 2 / near
    inside = math.pi * seen.doppler_band_hz * radar.pulse.duration_s
    displaced = abs(doppler) / abs(radar.pulse.rate_hz_s) * radar.sampling_hz
    single = 2 * math.pi * back_turns * far * 2.0**-24

    def row(effect: str, neglects: str, phase_rad: float, range_cells: float, remedy: str) -> Requirement:
        return Requirement(effect, neglects, phase_rad, range_cells, tolerance_rad, remedy)

    return (
        row(
            "bulk + refocus (omega_k)",
            "change of migration over the swath",
            bulk,
            float(seen.slope.abs().max()) * half / cells,
            "use omega_k_stolt",
        ),
        row(
            "range-Doppler",
            "coupling of range and azimuth (no secondary range compression)",
            rda,
            math.nan,
            "use omega_k",
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


def recommended_form(rows: tuple[Requirement, ...]) -> str:
    """Name of the cheapest focuser of this package that the table of `requirements` allows: omega_k
    or omega_k_stolt.
    """
    return "omega_k" if rows[0].ok else "omega_k_stolt"


def _parabola_rad(seen: Aperture, range_m: float) -> float:
    """Largest 4 pi / lambda |r - parabola| over the aperture of a target at slant range range_m;
    the parabola touches at the beam centre.
    """
    radar, velocity = seen.at.radar, float(seen.at.velocity_m_s)
    sin = float(radar.sin_squint(seen.at.doppler_hz.mean(), velocity))
    way = velocity * seen.integration_s * torch.linspace(-0.5, 0.5, 65, dtype=torch.float64)
    excess = way * (way - 2 * range_m * sin)
    exact = excess / (torch.sqrt(range_m**2 + excess) + range_m)
    parabola = -way * sin + way.square() * (1 - sin**2) / (2 * range_m)
    return float((exact - parabola).abs().max()) * 4 * math.pi / radar.wavelength_m
