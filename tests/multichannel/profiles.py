"""Azimuth images of single points, focused with given velocities, and their figures."""

from __future__ import annotations

from typing import NamedTuple

import torch

from torchsar.metrics import replicas
from torchsar.multichannel import PointMotion, doppler_offsets, focus_azimuth, reconstruct
from torchsar.study.bench.direct.moving import azimuth_echo

BAND_HZ, GATE_S, LONG = 337.5, 4.5, 3600


class Figures(NamedTuple):
    irw_m: float
    pslr_db: float
    islr_db: float
    mfta_db: float
    image_s: float
    peak: complex


def motion_of(radar, u_r=0.0, u_a=0.0, y0=0.0):
    return PointMotion.of(radar, torch.zeros(1), u_r, u_a, y0)


def focused(data, radar, motion, rebuild, band_hz: float | None = BAND_HZ, left_k1=0.0):
    spectrum = reconstruct(data, radar, motion, rebuild, left_k1)
    return focus_azimuth(spectrum, doppler_offsets(data.shape[-1], rebuild.bands, radar.prf_hz), radar, motion, band_hz)


def figures_of(image, radar, bands, u_r=0.0, u_a=0.0, y0=0.0, gate_s: float | None = GATE_S, used=None):
    """Measure an image on x = v t, the track as seen by the target, as in the printed figures."""
    along = radar.speed_m_s - u_a
    step, n = along / (bands * radar.prf_hz), image.shape[-1]
    response = replicas.azimuth_response(image, step, -(n // 2) * step)
    zones = replicas.replica_zones(
        radar, bands, u_r, u_a, y0, integration_s=gate_s, focused_at=used, axis_speed_m_s=along
    )
    mfta = replicas.replica_level(image, step, zones)["mfta_db"]
    irw, pslr, islr, position = (float(response[name]) for name in ("irw_m", "pslr_db", "islr_db", "position_m"))
    return Figures(irw, pslr, islr, float(mfta), position / along, complex(response["peak"]))


def measured(radar, rebuild, u_r=0.0, u_a=0.0, y0=0.0, n_pulse=LONG, band_hz: float | None = BAND_HZ, used=None):
    """Return the figures of a band-limited point, focused with its own or the `used` motion."""
    assumed = (u_r, u_a, y0) if used is None else used
    image = focused(azimuth_echo(radar, n_pulse, u_r, u_a, y0), radar, motion_of(radar, *assumed), rebuild, band_hz)
    return figures_of(image, radar, rebuild.bands, u_r, u_a, y0, used=None if used is None else (used[0], used[1]))
