"""Small instruments and scenes that several tests share."""

from __future__ import annotations

import signal

from torchsar.core import Draws, Recording, Truth
from torchsar.echo import simulate
from torchsar.radar import LinearFM, StripmapRadar
from torchsar.scene import AlwaysLit, Dwell, Points, StripmapWorld


def mind_interrupts() -> None:
    """For the child of a Popen: tests that were started in the background ignore Ctrl-C, and their children would, too."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def small_radar(**changes: object) -> StripmapRadar:
    """A short-range S-band radar whose apertures fit a hundred pulses: cheap, with real migration."""
    values: dict = {
        "carrier_hz": 3.2e9,
        "pulse": LinearFM(40e6, 0.5e-6),
        "sampling_hz": 50e6,
        "prf_hz": 400.0,
        "velocity_m_s": 120.0,
        "near_range_m": 4000.0,
        "pointing_doppler_hz": 0.0,
    }
    return StripmapRadar(**{**values, **changes})


def kondor_radar(**changes: object) -> StripmapRadar:
    """The Kondor-like sensor of brief 004 with a short pulse."""
    values: dict = {
        "carrier_hz": 3.2e9,
        "pulse": LinearFM(200e6, 3e-6),
        "sampling_hz": 250e6,
        "prf_hz": 4000.0,
        "velocity_m_s": 7000.0,
        "near_range_m": 700e3,
        "pointing_doppler_hz": 0.0,
    }
    return StripmapRadar(**{**values, **changes})


def small_recording(n_pulse: int = 128, n_range: int = 96, trials: int | None = None, snr_db: float | None = 20.0, dwell_s: float | None = 0.2, **kwargs) -> tuple[Recording, Truth]:
    """Three points seen by the small radar."""
    scene = Points([0.0, 6.0, -9.0], [0.0, 30.0, -45.0], [1.0, 0.7, 0.5], random_phase=True)
    world = StripmapWorld(scene, Dwell(dwell_s) if dwell_s else AlwaysLit(), snr_db=snr_db, velocity_m_s=kwargs.pop("velocity_m_s", None), doppler_hz=kwargs.pop("doppler_hz", None))
    draws = Draws(kwargs.pop("seed", 1), trials=None if trials is None else range(trials))
    return simulate(kwargs.pop("radar", None) or small_radar(), world, n_pulse, n_range, draws, **kwargs)
