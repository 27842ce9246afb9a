"""Point targets of a GEO spaceborne-airborne bistatic radar, in two dimensions: figures 5 to 7 and 14 to 16 and Table 4 of Remote Sens. 2020, 12, 1703.

    python scripts/geo_targets.py [--out geo_targets] [--small]

Channels are rebuilt and focused as if everything stood still, and with the velocities of each target (u_r closing, u_a along track, m/s). The first blurs what moves along
track and repeats what moves along range; the second does neither. Range resolutions are those of the axis c tau / 2, half of the receive path; azimuth is x = v t.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchsar import plot
from torchsar.core import Axis, Draws, Recording, Signal, take
from torchsar.echo import simulate_bistatic
from torchsar.metrics import azimuth_response, replica_level, replica_zones
from torchsar.multichannel.azimuth import FocusAzimuth
from torchsar.multichannel.migration import CorrectMigration, Keystone
from torchsar.multichannel.reconstruct import Reconstruct
from torchsar.multichannel.response import LeastSquares
from torchsar.multichannel.transmit import RemoveTransmitRange
from torchsar.radar import BistaticRadar, LinearFM
from torchsar.scene import BandLimited, BistaticWorld, MovingPoints

RADAR = BistaticRadar(
    1.25e9, LinearFM(50e6, 10e-6), sampling_hz=60e6, prf_hz=180.0, speed_m_s=300.0, reference_range_m=5000.0, transmit_range=(-243.0, 0.02, 5e-7), wave_speed_m_s=3e8
)
INTEGRATION_S, BANDWIDTH_HZ = 4.5, 337.5
SINGLE = {"at rest": (0.0, 0.0), "u_a = 10 m/s": (0.0, 10.0), "u_r = 10 m/s": (10.0, 0.0)}
NAMED = {"P1": (0.0, 10.0), "P2": (10.0, 0.0), "P3": (10.0, 5.0), "P4": (5.0, 10.0)}
PLACES = {"P1": (-400.0, 60.0), "P2": (-200.0, -60.0), "P3": (150.0, 60.0), "P4": (400.0, -60.0)}  # azimuth and range (m) in figure 16, which prints none
FIGURES = ("azimuth width (m)", "azimuth PSLR (dB)", "azimuth ISLR (dB)", "range width (m)", "range PSLR (dB)", "range ISLR (dB)", "MFTA (dB)")
PUBLISHED = {  # width, PSLR, ISLR along azimuth, then MFTA; along range 2.64 to 2.66 m, -13 dB, -9.8 dB
    "conventional": {"P1": (59.55, -26.30, -26.37, -44.43), "P2": (1.06, None, None, -21.95), "P3": (8.77, None, None, -20.8), "P4": (17.99, None, None, -25.0)},
    "proposed": {"P1": (0.83, -13.25, -10.01, -68.9), "P2": (0.80, -13.07, -10.14, -56.7), "P3": (0.81, -13.11, -10.11, -52.4), "P4": (0.83, -13.26, -10.09, -47.6)},
}


@dataclass(frozen=True)
class Batch:
    """Targets, one a trial, and their channels after migration correction. speeds: name -> (u_r, u_a)."""

    speeds: Mapping[str, tuple[float, float]]
    migrated: Signal

    @property
    def u_r_m_s(self) -> Tensor:
        return torch.tensor([u_r for u_r, _ in self.speeds.values()], dtype=torch.float64)

    @property
    def u_a_m_s(self) -> Tensor:
        return torch.tensor([u_a for _, u_a in self.speeds.values()], dtype=torch.float64)


@dataclass(frozen=True)
class Product:
    """Rebuilt spectrum (doppler, range) and image (azimuth, range) of every trial, and how they were made. moving: with the velocities of the targets."""

    spectrum: Signal
    image: Signal
    bands: int
    moving: bool


def migrated(recording: Recording) -> Signal:
    """Channels without the transmit range and without range migration."""
    return CorrectMigration(RADAR, Keystone(whole_swath=False))(RemoveTransmitRange(RADAR)(recording.signal))


def simulated(speeds: Mapping[str, tuple[float, float]], n_pulse: int, n_range: int) -> Batch:
    """One target at the middle of the scene in each trial, without noise."""
    u_r, u_a = torch.tensor(list(speeds.values()), dtype=torch.float64).T[..., None]
    world = BistaticWorld(MovingPoints(u_r, u_a, torch.zeros_like(u_r), torch.zeros_like(u_r)), BandLimited(INTEGRATION_S))
    recording, _ = simulate_bistatic(RADAR, world, n_pulse, n_range, Draws(1, trials=range(len(speeds))))
    return Batch(speeds, migrated(recording))


def product(batch: Batch, bands: int, moving: bool) -> Product:
    """Conventional (as if at rest) or proposed (moving)."""
    values = {"u_r_m_s": batch.u_r_m_s, "u_a_m_s": batch.u_a_m_s} if moving else {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # three bands of three channels are poorly conditioned, which is what the table shows
        spectrum = Reconstruct(RADAR, LeastSquares(bands))(batch.migrated, **values)
    return Product(spectrum, FocusAzimuth(RADAR, bandwidth_hz=BANDWIDTH_HZ)(spectrum, **values), bands, moving)


def brightest(image: Signal) -> Tensor:
    """Azimuth profile of the strongest range line of each trial, (trial, azimuth)."""
    line = image.data.abs().amax(-2).argmax(-1)
    return take(image.data.mT, line, -2)


def range_cut(image: Signal) -> Tensor:
    """Range profile of the strongest azimuth line of each trial, (trial, range)."""
    return take(image.data, image.data.abs().amax(-1).argmax(-1), -2)


def measured(batch: Batch, made: Product) -> Tensor:
    """Numbers named by FIGURES, (trial, figure)."""
    azimuth, range_ = made.image.axes
    profile, along = brightest(made.image), RADAR.speed_m_s - batch.u_a_m_s
    across = azimuth_response(range_cut(made.image), range_.step / 2)
    own = azimuth_response(profile, azimuth.step)
    zones = replica_zones(RADAR, made.bands, batch.u_r_m_s, batch.u_a_m_s, integration_s=INTEGRATION_S, focused_at=None if made.moving else (0.0, 0.0))
    level = replica_level(profile, azimuth.step, zones)["mfta_db"]
    width = own["irw_m"] * along / RADAR.speed_m_s
    return torch.stack([width, own["pslr_db"], own["islr_db"], across["irw_m"], across["pslr_db"], across["islr_db"], level], -1)


def show(batch: Batch, bands: int) -> None:
    """Table 4 with so many bands."""
    tables = {way: measured(batch, product(batch, bands, way == "proposed")) for way in PUBLISHED}
    print(f"\n{f'Table 4, N = {bands}':30}" + "".join(f"{name:>10}" for name in FIGURE_HEADS))
    for way, table in tables.items():
        for name, row in zip(batch.speeds, table, strict=True):
            print(f"{f'{way} {name}':30}" + "".join(f"{float(x):>10.2f}" for x in row))
            known = PUBLISHED[way][name]
            cells = (*known[:3], None, None, None, known[3])
            print(f"{'  published':30}" + "".join(f"{'-' if x is None else f'{x:.2f}':>10}" for x in cells))


FIGURE_HEADS = ("az width", "az PSLR", "az ISLR", "rg width", "rg PSLR", "rg ISLR", "MFTA")


def near(image: Signal, along_m: float, range_m: float, place: int) -> Signal:
    """Surroundings of the peak of one trial, azimuth counted from it, range on the axis c tau / 2."""
    azimuth, range_ = image.axes
    data = image.data[place]
    row, column = divmod(int(data.abs().argmax()), data.shape[-1])
    rows, columns = round(along_m / azimuth.step), round(2 * range_m / range_.step)
    first, left = max(row - rows, 0), max(column - columns, 0)
    part = data[first : row + rows + 1, left : column + columns + 1]
    return Signal(part, (Axis("azimuth", part.shape[0], (first - row) * azimuth.step, azimuth.step, "m"), Axis("range", part.shape[1], (left - column) * range_.step / 2, range_.step / 2, "m")))


def finer(image: Signal, factor: int = 8) -> Signal:
    """Interpolated by zeros around its spectrum, for contours."""
    data, axes = image.data, []
    for dim, axis in zip((-2, -1), image.axes, strict=True):
        n = data.shape[dim]
        spectrum = torch.fft.fftshift(torch.fft.fft(data, dim=dim), dim=dim).movedim(dim, -1)
        padded = torch.nn.functional.pad(spectrum, ((factor * n) // 2 - n // 2, factor * n - n - ((factor * n) // 2 - n // 2)))
        data = factor * torch.fft.ifft(torch.fft.ifftshift(padded, dim=-1)).movedim(-1, dim)
        axes.append(Axis(axis.name, factor * n, axis.start, axis.step / factor, axis.unit))
    return Signal(data, tuple(axes))


def spectrum_2d(made: Product, place: int) -> Signal:
    """Rebuilt spectrum of one trial over Doppler (against the centre) and range frequency."""
    doppler, range_ = made.spectrum.axes
    data = torch.fft.fftshift(torch.fft.fft(made.spectrum.data[place]), dim=-1)
    step = RADAR.sampling_hz / range_.n / 1e6
    return Signal(data, (doppler, Axis("range frequency", range_.n, -(range_.n // 2) * step, step, "MHz")))


def draw_target(made: Product, place: int, title: str, path: Path) -> None:
    """Spectrum, image and azimuth profile of a target."""
    profile, azimuth = brightest(made.image)[place], made.image.axis("azimuth")
    curve = (plot.array(azimuth.values()), plot.decibel(profile))
    parts = [
        {"title": f"{title}: spectrum", "signal": spectrum_2d(made, place), "lines": {}},
        {"title": "image about the peak", "signal": near(made.image, 60.0, 40.0, place), "lines": {}},
        {"series": {"": curve}, "xlabel": "azimuth (m)", "ylabel": "amplitude (dB)", "title": "azimuth profile", "ylim": (-80.0, 2.0)},
    ]
    plot.save(plot.overlays(parts, columns=3, dynamic_range_db=50), path)


def draw_single(batch: Batch, out: Path) -> dict[str, Signal]:
    """Figures 5 to 7 (conventional) and 14, 15 (proposed); returns what their contours need."""
    names, details = list(batch.speeds), {}
    for way, first, figures in (("conventional", 0, (5, 6, 7)), ("proposed", 1, (14, 15))):
        made = product(batch, 2, way == "proposed")
        for place, figure in enumerate(figures, first):
            draw_target(made, place, f"{names[place]}, {way}", out / f"figure_{figure:02}.png")
            details[f"{figure}: {names[place]}, {way}"] = finer(near(made.image, 30.0 if figure == 6 else 6.0, 15.0, place))
    return details


def draw_scene(small: bool, out: Path) -> None:
    """Figure 16: four targets in one scene, where they are, as if at rest, and contours of each with its own velocities."""
    azimuth, range_ = zip(*PLACES.values())
    u_r, u_a = zip(*NAMED.values())
    world = BistaticWorld(MovingPoints(u_r, u_a, azimuth, range_), BandLimited(INTEGRATION_S))
    recording, truth = simulate_bistatic(RADAR, world, 1080 if small else 1800, 96, Draws(1))
    batch = Batch({}, migrated(recording))
    still = FocusAzimuth(RADAR, bandwidth_hz=BANDWIDTH_HZ)(Reconstruct(RADAR)(batch.migrated))
    plot.save(plot.overlays([{"title": "four targets, conventional (crosses of lines: true places)", "signal": relative(still), "lines": marks(truth.values)}], columns=1, dynamic_range_db=50), out / "figure_16.png")


def relative(image: Signal) -> Signal:
    """Range from the reference on the axis c tau / 2."""
    azimuth, range_ = image.axes
    return Signal(image.data, (azimuth, Axis("range", range_.n, (range_.start - RADAR.reference_range_m) / 2, range_.step / 2, "m")))
