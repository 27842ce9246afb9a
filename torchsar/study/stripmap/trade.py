"""`torchsar trade`: time against accuracy of the alternatives, beside the exact yardstick."""

from __future__ import annotations

import logging
import math
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from torchsar import plot
from torchsar.core import Recording, Signal
from torchsar.echo.jitter import sample_unevenly
from torchsar.focus import Backproject
from torchsar.focus.omega_k import Focuser
from torchsar.metrics import error_db
from torchsar.repair.jitter import BandLimited, Exact, Lagrange
from torchsar.study.config import Loaded
from torchsar.study.methods import run_recommended
from torchsar.study.registry import FOCUS
from torchsar.study.settings.errors import ConfigError, did_you_mean
from torchsar.study.stripmap.build import build_case
from torchsar.study.trading import Tables, timed, written

log = logging.getLogger("torchsar")
_HALF = 16
_OFFSETS = (0.0, 0.18, -0.12, 0.07)


@dataclass(frozen=True)
class Row:
    """One alternative: median time over the repeats, their spread, and its error against the
    yardstick.
    """

    name: str
    seconds: float
    spread_s: float
    error_db: float
    peak_phase_deg: float | None = None


@dataclass(frozen=True)
class SmoothBand:
    """Backprojection over one PRF of Doppler about the centroid with a raised-cosine roll-off over
    its outer eighths.

    A sharp end would put Fresnel ripple of its own on the yardstick; targets that are lit within
    the inner three quarters of the PRF see full weight.
    """

    width_hz: float

    def weight(self, since_s: Tensor, doppler_offset_hz: Tensor) -> Tensor:
        outer = ((doppler_offset_hz.abs() - 3 * self.width_hz / 8) / (self.width_hz / 8)).clamp(0, 1)
        return 0.5 * (1 + torch.cos(math.pi * outer))


def trade(loaded: Loaded, out: Path | None) -> str:
    """Compare focusers, precisions and jitter correctors on the unimpaired data of a config;
    returns the tables as text.

    With `out`: config.yaml, trade.json, trade.txt and figures/ in that folder.
    """
    accepted = [
        name
        for name, stage in FOCUS.items()
        if isinstance(stage, type) and issubclass(stage, Focuser) and stage is not Backproject
    ]
    wrong = [name for name in loaded.config.trade.focusers if name not in accepted]
    if wrong:
        raise ConfigError(
            f"{loaded.file}: trade.focusers names {wrong[0]!r}, which is no focuser to "
            f"compare{did_you_mean(wrong[0], accepted)}"
        )
    return written(loaded, out, lambda: _tables(loaded), _text, _figures)


def _figures(tables: Tables) -> dict[str, plot.Figure]:
    return {
        name: plot.trade(
            [r.name for r in rows],
            [r.seconds for r in rows],
            [max(r.error_db, -200.0) for r in rows],
            "error (dB)",
            name,
        )
        for name, rows in tables.items()
    }


def _tables(loaded: Loaded) -> dict[str, list[Row]]:
    case = build_case(_noiseless(loaded))
    best = run_recommended(loaded, case)
    doppler_hz, velocity_m_s = (
        best.used.get("doppler_hz", 0.0),
        best.used.get("velocity_m_s", case.recording.radar.velocity_m_s),
    )
    with torch.no_grad():
        focusing = list(_focusing(loaded, case.clean, doppler_hz, velocity_m_s, _bright_places(best.image)))
        return {"focusing": focusing, "jitter": list(_jitter(loaded, case.clean.signal))}


def _noiseless(loaded: Loaded) -> Loaded:
    """Receiver noise is left out of a simulation: it would only blur the comparison of
    deterministic algorithms.
    """
    world = loaded.config.world
    if world is None:
        return loaded
    return replace(
        loaded,
        config=loaded.config.model_copy(
            update={"world": world.model_copy(update={"noise": world.noise.model_copy(update={"snr_db": None})})}
        ),
    )


def _bright_places(image: Signal, count: int = 4) -> list[tuple[int, int]]:
    """The brightest point of each of `count` bands of range, away from the edges."""
    amplitude = image.data.abs().clone()
    amplitude[: 2 * _HALF], amplitude[-2 * _HALF :] = 0, 0
    places = []
    for part in torch.arange(2 * _HALF, image.axes[1].n - 2 * _HALF).tensor_split(count):
        band = amplitude[:, int(part[0]) : int(part[-1]) + 1]
        line, sample = divmod(int(band.argmax()), band.shape[1])
        places.append((line, sample + int(part[0])))
    return places


def _patch(image: Tensor, place: tuple[int, int]) -> Tensor:
    return image[place[0] - _HALF : place[0] + _HALF, place[1] - _HALF : place[1] + _HALF]


def _focusing(
    loaded: Loaded, recording: Recording, doppler_hz: float, velocity_m_s: float, places: Sequence[tuple[int, int]]
) -> Iterator[Row]:
    """The yardstick (backprojection of patches in complex128) first, then every focuser in every
    precision.
    """
    exact, seconds = _yardstick(recording, doppler_hz, velocity_m_s, places)
    yield Row(f"backprojection of {len(places)} patches, complex128", seconds, 0.0, -float("inf"), 0.0)
    for precision in loaded.config.trade.precisions:
        signal = recording.signal.to(getattr(torch, precision))
        for name in loaded.config.trade.focusers:
            stage = FOCUS[name](recording.radar, "matched", velocity_m_s, doppler_hz)
            image, times = timed(lambda stage=stage, signal=signal: stage(signal).data, loaded.config.trade.repeats)
            patches = _scaled(torch.stack([_patch(image, place) for place in places]).to(torch.complex128), exact)
            phase = torch.angle(patches[:, _HALF, _HALF] / exact[:, _HALF, _HALF]).abs().max()
            error = float(error_db(patches.flatten(0, 1), exact.flatten(0, 1)))
            log.info("%s, %s: %.2f s, %.1f dB", name, precision, statistics.median(times), error)
            yield Row(
                f"{name}, {precision}",
                statistics.median(times),
                max(times) - min(times),
                error,
                float(torch.rad2deg(phase)),
            )


def _scaled(patches: Tensor, exact: Tensor) -> Tensor:
    """The patches with the one complex gain that fits them best: focusers differ by a constant of
    the transform.
    """
    return patches * ((patches.conj() * exact).sum() / patches.abs().square().sum())


def _yardstick(
    recording: Recording, doppler_hz: float, velocity_m_s: float, places: Sequence[tuple[int, int]]
) -> tuple[Tensor, float]:
    began = time.perf_counter()
    signal = recording.signal.to(torch.complex128)
    patches = []
    for line, sample in places:
        lines, cells = (line - _HALF, line + _HALF), (sample - _HALF, sample + _HALF)
        stage = Backproject(
            recording.radar,
            "matched",
            velocity_m_s,
            doppler_hz,
            lines=lines,
            cells=cells,
            aperture=SmoothBand(recording.radar.prf_hz),
        )
        patches.append(stage(signal).data)
    log.info("yardstick: %.1f s", time.perf_counter() - began)
    return torch.stack(patches), time.perf_counter() - began


def _jitter(loaded: Loaded, signal: Signal) -> Iterator[Row]:
    """Correctors of a known periodic jitter on the first 1024 lines of the raw data, in its own
    precision.
    """
    raw = signal.data[:1024]
    offsets = torch.tensor(_OFFSETS, dtype=torch.float64)
    uneven = sample_unevenly(raw, offsets)
    yield Row("uncorrected", 1e-6, 0.0, float(error_db(uneven, raw)))
    methods: Mapping[str, Callable[[Tensor, Tensor], Tensor]] = {
        "Lagrange, 4 points": Lagrange(4),
        "Lagrange, 8 points": Lagrange(8),
        "Lagrange, 12 points": Lagrange(12),
        "band-limited, 8 points": BandLimited(8),
        "exact": Exact(),
    }
    for name, method in methods.items():
        fixed, times = timed(lambda method=method: method(uneven, offsets), loaded.config.trade.repeats)
        yield Row(name, statistics.median(times), max(times) - min(times), float(error_db(fixed, raw)))


def _text(tables: Tables) -> str:
    parts = ["FOCUSING: error over patches about bright points, against backprojection, one common gain removed"]
    parts += [f"{'alternative':<46}{'time (s)':>10}{'spread':>8}{'error (dB)':>12}{'peak phase (deg)':>18}"]
    parts += [
        f"{r.name:<46}{r.seconds:>10.3f}{r.spread_s:>8.3f}{_db(r.error_db):>12}{r.peak_phase_deg or 0:>18.3f}"
        for r in tables["focusing"]
    ]
    parts += [
        "",
        f"JITTER of period 4, offsets {_OFFSETS}: error of the raw data",
        f"{'alternative':<46}{'time (s)':>10}{'spread':>8}{'error (dB)':>12}",
    ]
    parts += [f"{r.name:<46}{r.seconds:>10.3f}{r.spread_s:>8.3f}{_db(r.error_db):>12}" for r in tables["jitter"]]
    return "\n".join(parts)


def _db(value: float) -> str:
    return "exact" if value == -float("inf") else f"{value:.1f}"
