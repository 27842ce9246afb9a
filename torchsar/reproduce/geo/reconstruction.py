"""Reconstruction of the Doppler band of moving points from few channels, and its condition: figures
10 to 12 and 17 of Remote Sens. 2020, 12, 1703.

    python scripts/geo_reconstruction.py [--out geo_reconstruction] [--small]

Azimuth only, without noise. "Band-limited": the target is seen for 4.5 s; "pattern": through the
pattern of the elements, in records of 20 s, so that replicas up to three pulse rates away have
their own positions. MFTA: largest false target against the peak. N: Doppler bands that are
reconstructed.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from torchsar import plot
from torchsar.core import Draws, Signal
from torchsar.echo import simulate_bistatic
from torchsar.metrics import replica_level, replica_zones
from torchsar.multichannel import (
    FocusAzimuth,
    LeastSquares,
    MinimumMeanSquare,
    PointMotion,
    Reconstruct,
)
from torchsar.multichannel.response import Rebuild
from torchsar.multichannel.velocity.sir import Intensity, signal_intensity
from torchsar.radar import BistaticRadar, LinearFM
from torchsar.scene import BandLimited, BistaticWorld, Gate, MovingPoints, Pattern

RADAR = BistaticRadar(
    1.25e9,
    LinearFM(50e6, 10e-6),
    sampling_hz=60e6,
    prf_hz=180.0,
    speed_m_s=300.0,
    reference_range_m=5000.0,
    wave_speed_m_s=3e8,
)
UNEVEN = replace(RADAR, channel_m=(-0.8, 0.0, 0.75))
INTEGRATION_S, BANDWIDTH_HZ, RECORD_S = 4.5, 337.5, 20.0
GATES: dict[str, Gate] = {"band-limited": BandLimited(INTEGRATION_S), "pattern": Pattern()}
TRUE_M_S, GUESSES_M_S = 10.0, (5.0, 8.0, 10.0)
EXPECTED_SIR = {
    "band-limited": (24.5, 14.8, 39.2),
    "pattern": (7.3, 4.4, 11.6),
}  # dB, peak of Gamma1, Gamma2, Gamma over their value at 0 m/s
PUBLISHED_MFTA = {"band-limited": "below -60 dB", "pattern": "below -25 dB"}


@dataclass(frozen=True)
class _Method:
    """How bands are separated.

    Args:
        rebuild: Reconstruction of the bands.
        moving: Whether the velocity of the target is used; otherwise it is assumed at rest.
    """

    rebuild: Rebuild
    moving: bool


METHODS = {
    "conventional, N = 3": _Method(LeastSquares(3), False),
    "conventional, N = 2": _Method(LeastSquares(2), False),
    "proposed, N = 3": _Method(LeastSquares(3), True),
    "proposed, N = 2": _Method(LeastSquares(2), True),
    "proposed, MMSE, N = 5": _Method(MinimumMeanSquare(5), True),
}
EXPECTED_MFTA = {  # (gate, method) -> at (2, 10, 20) m/s for conventional, (0, 10, 20) for proposed
    ("band-limited", "conventional, N = 3"): (-17.7, -6.3, -1.1),
    ("band-limited", "conventional, N = 2"): (-41.6, -19.5, -1.1),
    ("band-limited", "proposed, N = 3"): (-63.8, -55.9, -47.6),
    ("band-limited", "proposed, N = 2"): (-71.6, -67.5, -65.6),
    ("band-limited", "proposed, MMSE, N = 5"): (-37.4, -39.2, -42.3),
    ("pattern", "conventional, N = 3"): (-17.3, -6.3, -1.4),
    ("pattern", "conventional, N = 2"): (-20.3, -17.7, -0.6),
    ("pattern", "proposed, N = 3"): (-29.6, -28.0, -25.8),
    ("pattern", "proposed, N = 2"): (-20.6, -17.8, -16.5),
    ("pattern", "proposed, MMSE, N = 5"): (-33.3, -30.7, -25.6),
}


def _simulated(u_r_m_s: Tensor, gate: Gate, seconds: float) -> Signal:
    """Channels (trial, channel, pulse) of one target a trial."""
    at_rest = torch.zeros(len(u_r_m_s), 1, dtype=torch.float64)
    world = BistaticWorld(MovingPoints(u_r_m_s[:, None], at_rest, at_rest, at_rest), gate)
    draws = Draws(1, trials=range(len(u_r_m_s)))
    return simulate_bistatic(RADAR, world, round(seconds * RADAR.prf_hz), None, draws, dtype=torch.complex128)[0].signal


def _spectrum(data: Signal, rebuild: Rebuild, u_r_m_s: Tensor | float) -> Signal:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what a poor condition does is the subject of this script
        return Reconstruct(RADAR, rebuild)(data, u_r_m_s)


def _replicas_db(data: Signal, u_r_m_s: Tensor, method: _Method, gate: Gate) -> Tensor:
    """MFTA within three pulse rates, (trial,)."""
    assumed = u_r_m_s if method.moving else torch.zeros_like(u_r_m_s)
    image = FocusAzimuth(RADAR, bandwidth_hz=BANDWIDTH_HZ)(_spectrum(data, method.rebuild, assumed), assumed)
    seen = INTEGRATION_S if isinstance(gate, BandLimited) else None
    zones = replica_zones(
        RADAR, method.rebuild.bands, u_r_m_s, integration_s=seen, focused_at=(assumed, 0.0), orders=(1, 2, 3)
    )
    return replica_level(image.data, image.axis("azimuth").step, zones)["mfta_db"]


def _false_targets(speeds: Tensor) -> dict[str, dict[str, Tensor]]:
    """MFTA (dB) by gate and method over u_r, (speed,)."""
    found = {}
    for name, gate in GATES.items():
        data = _simulated(speeds, gate, RECORD_S)
        found[name] = {label: _replicas_db(data, speeds, method, gate) for label, method in METHODS.items()}
    return found


def _draw_false_targets(speeds: Tensor, found: Mapping[str, Mapping[str, Tensor]], out: Path) -> None:
    """Figure 17."""
    parts = []
    for gate, methods in found.items():
        series = {label: (plot.array(speeds), plot.array(levels)) for label, levels in methods.items()}
        parts.append(
            {"series": series, "xlabel": "u_r (m/s)", "ylabel": "MFTA (dB)", "title": gate, "ylim": (-80.0, 45.0)}
        )
    plot.save(plot.panels(parts), out / "figure_17.png")


def _draw_spectra(data: Mapping[str, Signal], out: Path) -> None:
    """Figures 10 and 11: spectra of a target of 10 m/s rebuilt with guesses of its velocity, over
    Doppler from zero; dashed: the processed band about the guess.
    """
    for figure, signal in zip((10, 11), data.values(), strict=True):
        parts = []
        for guess in GUESSES_M_S:
            rebuilt = _spectrum(signal, LeastSquares(3), guess)
            centre = guess / RADAR.wavelength_m
            curve = (plot.array(rebuilt.axis("doppler").values() + centre), plot.decibel(rebuilt.data[0]))
            edges = {"processed band": centre - BANDWIDTH_HZ / 2, "its end": centre + BANDWIDTH_HZ / 2}
            parts.append(
                {
                    "series": {"spectrum": curve},
                    "xlabel": "Doppler (Hz)",
                    "ylabel": "amplitude (dB)",
                    "title": f"rebuilt with {guess:g} m/s",
                    "marks": edges,
                    "ylim": (-60.0, 20.0),
                }
            )
        plot.save(plot.panels(parts), out / f"figure_{figure}.png", columns=3)


def _intensity(signal: Signal, guesses: Tensor) -> Intensity:
    """Of one trial, over guesses of u_r."""
    data = signal.data[0, None, ..., None].expand(len(guesses), -1, -1, -1)
    return signal_intensity(data, RADAR, PointMotion.of(RADAR, data, guesses), LeastSquares(3), BANDWIDTH_HZ)


def _ratios_db(found: Intensity) -> dict[str, Tensor]:
    return {
        name: 10 * torch.log10(ratio)
        for name, ratio in (("Gamma1", found.power_ratio), ("Gamma2", found.amplitude_ratio), ("Gamma", found.ratio))
    }


def _draw_ratios(data: Mapping[str, Signal], guesses: Tensor, out: Path) -> None:
    """Figure 12, and where the curves peak."""
    parts = []
    print(f"\n{'intensity ratio':26}{'peak (m/s)':>12}{'over 0 m/s (dB)':>18}{'expected (dB)':>18}")
    for gate, signal in data.items():
        curves = _ratios_db(_intensity(signal, guesses))
        for (name, curve), known in zip(curves.items(), EXPECTED_SIR[gate], strict=True):
            print(
                f"{f'{gate}: {name}':26}{float(guesses[curve.argmax()]):>12.2f}"
                f"{float(curve.max() - curve[0]):>18.1f}{known:>18.1f}"
            )
        series = {name: (plot.array(guesses), plot.array(curve)) for name, curve in curves.items()}
        parts.append(
            {"series": series, "xlabel": "u_r of the reconstruction (m/s)", "ylabel": "ratio (dB)", "title": gate}
        )
    print(
        "the expected figures are those of three bands without any energy beyond them; bands "
        "further out alias into these and lower the band-limited peaks by as much as shown"
    )
    plot.save(plot.panels(parts), out / "figure_12.png")
