"""Slant-range velocity of moving targets from three channels: Tables 2 and 3 of Remote Sens. 2020,
12, 1703, bounds, and velocities beyond the ambiguity.

    python scripts/geo_velocity.py [--out geo_velocity] [--trials 24] [--seed 1] [--small]

The signal intensity ratio (SIR) is the paper's estimator; along-track interferometry (ATI) and
maximum likelihood (ML) know the along-track velocity a priori as well; "no prior knowledge" is the
recommended estimator, which finds u_r, u_a and the position at once. White noise, a target seen for
4.5 s. SCNR is read as that of a raw sample, which range compression improves by 10 lg(B tau) = 27
dB. Errors are means of |error| over trials, bounds are Cramer-Rao standard deviations times sqrt(2
/ pi), the mean |error| of a Gaussian.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from torchsar import plot
from torchsar.core import Draws, Signal, Stage
from torchsar.echo import simulate_bistatic
from torchsar.metrics import bistatic_bounds
from torchsar.multichannel import (
    Dwell,
    Interferometry,
    MovingPointVelocity,
    Search,
    SignalIntensityRatio,
)
from torchsar.radar import BistaticRadar, LinearFM
from torchsar.scene import BandLimited, BistaticWorld, MovingPoints

RADAR = BistaticRadar(
    1.25e9,
    LinearFM(50e6, 10e-6),
    sampling_hz=60e6,
    prf_hz=180.0,
    speed_m_s=300.0,
    reference_range_m=5000.0,
    wave_speed_m_s=3e8,
)
INTEGRATION_S, BANDWIDTH_HZ, RECORD_S = 4.5, 337.5, 5.0
GAIN_DB = 10 * math.log10(RADAR.pulse.bandwidth_hz * 10e-6)
SCNR_DB = (-50.0, -40.0, -30.0, -20.0, -10.0, 0.0, 10.0)
TABLE_2 = {  # |error| (m/s) at SCNR_DB, a single trial each
    170.0: (4.93, 3.37, 2.39, 0.85, 0.42, 0.33, 0.23),
    180.0: (4.95, 4.32, 1.33, 0.59, 0.19, 0.12, 0.12),
    190.0: (5.68, 4.73, 1.99, 0.73, 0.12, 0.11, 0.04),
}
TABLE_3 = {
    -14.0: 0.19,
    -11.0: 0.11,
    -8.0: 0.09,
    -5.0: 0.12,
    -2.0: 0.11,
    1.0: 0.15,
    4.0: 0.15,
    7.0: 0.11,
    10.0: 0.17,
    13.0: 0.14,
}  # u_r -> |error| (m/s) at -10 dB
MEAN_OF_DEVIATION = math.sqrt(2 / math.pi)


def _estimators(radar: BistaticRadar, along_m_s: float) -> dict[str, Stage]:
    """By name; the first three know u_a = 0 a priori, the last one searches for it within
    +-along_m_s.
    """
    aperture, reach = Dwell(INTEGRATION_S), Search(u_r_m_s=radar.ambiguous_velocity_m_s / 2, u_a_m_s=along_m_s)
    return {
        "SIR": SignalIntensityRatio(radar, BANDWIDTH_HZ),
        "ATI": Interferometry(radar, aperture),
        "ML": MovingPointVelocity(radar, aperture, search=reach, u_a_m_s=0.0),
        "no prior knowledge": MovingPointVelocity(radar, aperture, search=reach),
    }


def _simulated(radar: BistaticRadar, u_r_m_s: float, snr_db: float, draws: Draws, n_range: int | None = None) -> Signal:
    """Channels (trial, channel, pulse[, range]) of a target; snr_db: after range compression."""
    world = BistaticWorld(MovingPoints([u_r_m_s], [0.0], [0.0], [0.0]), BandLimited(INTEGRATION_S), snr_db=snr_db)
    return simulate_bistatic(radar, world, round(RECORD_S * radar.prf_hz), n_range, draws)[0].signal


def _mean_bound(radar: BistaticRadar, u_r_m_s: float, scnr_db: float, known: bool) -> float:
    """Least mean |error| of u_r (m/s), u_a known a priori or not."""
    unknown = ("u_r_m_s", "y0_m") if known else ("u_r_m_s", "u_a_m_s", "y0_m")
    snr = 10 ** ((scnr_db + GAIN_DB) / 10)
    return MEAN_OF_DEVIATION * float(
        bistatic_bounds(
            radar, round(RECORD_S * radar.prf_hz), snr, u_r_m_s, integration_s=INTEGRATION_S, unknown=unknown
        )["u_r_m_s"]
    )


def _errors(radar: BistaticRadar, u_r_m_s: float, scnr_db: float, draws: Draws, along_m_s: float) -> dict[str, Tensor]:
    """|error| (trial,) of every estimator."""
    signal = _simulated(radar, u_r_m_s, scnr_db + GAIN_DB, draws)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the poor condition of three bands, which SIR needs
        return {
            name: (stage(signal)["u_r_m_s"] - u_r_m_s).abs() for name, stage in _estimators(radar, along_m_s).items()
        }


def _part(
    title: str,
    x: Sequence[float],
    columns: Sequence[dict[str, Tensor]],
    bounds: Mapping[str, Sequence[float]],
    published: Sequence[float],
) -> dict:
    """A panel: means with 95 % intervals."""
    series = {}
    for name in columns[0]:
        mean, half = (
            np.array([float(of(column[name])) for column in columns])
            for of in (torch.mean, lambda e: 1.96 * e.std() / math.sqrt(len(e)))
        )
        series[name] = (mean, np.stack([np.maximum(mean - half, 0.2 * mean), mean + half], -1))
    lines = {"published": np.array(published), **{name: np.array(values) for name, values in bounds.items()}}
    return {"title": title, "x": np.array(x), "series": series, "bounds": lines}


def _bounds_of(radar: BistaticRadar, points: Sequence[tuple[float, float]]) -> dict[str, list[float]]:
    """At (u_r, SCNR), with u_a known a priori and not."""
    return {
        name: [_mean_bound(radar, u_r, scnr, known) for u_r, scnr in points]
        for name, known in (("bound, u_a known", True), ("bound, no prior knowledge", False))
    }


def _over_noise(rates: Sequence[float], scnr_db: Sequence[float], draws: Draws, along_m_s: float, out: Path) -> None:
    """Table 2: u_r = 10 m/s."""
    parts = []
    for prf in rates:
        radar = replace(RADAR, prf_hz=prf)
        columns = [_errors(radar, 10.0, scnr, draws.part(f"{prf:g} Hz, {scnr:g} dB"), along_m_s) for scnr in scnr_db]
        bounds, published = (
            _bounds_of(radar, [(10.0, scnr) for scnr in scnr_db]),
            [TABLE_2[prf][SCNR_DB.index(scnr)] for scnr in scnr_db],
        )
        show(
            f"Table 2, {prf:g} Hz; raw SCNR (dB)", [f"{scnr:g}" for scnr in scnr_db], table(columns, bounds, published)
        )
        parts.append(_part(f"{prf:g} Hz", scnr_db, columns, bounds, published))
    plot.save(plot.error_curves(parts, "raw SCNR (dB)", "mean |error| of u_r (m/s)", log_y=True), out / "table_2.png")


def _over_velocity(velocities: Sequence[float], draws: Draws, along_m_s: float, out: Path) -> None:
    """Table 3: raw SCNR -10 dB."""
    columns = [_errors(RADAR, u_r, -10.0, draws.part(f"{u_r:g} m/s"), along_m_s) for u_r in velocities]
    bounds, published = _bounds_of(RADAR, [(u_r, -10.0) for u_r in velocities]), [TABLE_3[u_r] for u_r in velocities]
    show("Table 3, -10 dB; u_r (m/s)", [f"{u_r:g}" for u_r in velocities], table(columns, bounds, published))
    plot.save(
        plot.error_curves(
            [_part("", velocities, columns, bounds, published)], "u_r (m/s)", "mean |error| of u_r (m/s)", log_y=True
        ),
        out / "table_3.png",
    )
