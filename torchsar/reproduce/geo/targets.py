"""Point targets of a GEO spaceborne-airborne bistatic radar, in two dimensions: figures 5 to 7 and
14 to 16 and Table 4 of Remote Sens. 2020, 12, 1703.

    python scripts/geo_targets.py [--out geo_targets] [--small]

Channels are reconstructed and focused as for targets at rest, and with the velocities of each
target (u_r closing, u_a along track, m/s). The first blurs targets that move along track and
repeats those that move along range; the second does neither. Range resolutions are those of the
axis c tau / 2, half of the receive path; azimuth is x = v t.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from torchsar import plot
from torchsar.core import Axis, Draws, Signal, take
from torchsar.echo import simulate_bistatic
from torchsar.metrics import azimuth_response, replica_level, replica_zones
from torchsar.multichannel import (
    CorrectMigration,
    FocusAzimuth,
    Keystone,
    LeastSquares,
    PointMotion,
    Reconstruct,
    RemoveTransmitRange,
    focus_azimuth,
)
from torchsar.multichannel.azimuth import image_axis
from torchsar.radar import BistaticRadar, LinearFM
from torchsar.scene import BandLimited, BistaticWorld, MovingPoints

RADAR = BistaticRadar(
    1.25e9,
    LinearFM(50e6, 10e-6),
    sampling_hz=60e6,
    prf_hz=180.0,
    speed_m_s=300.0,
    reference_range_m=5000.0,
    transmit_range=(-243.0, 0.02, 5e-7),
    wave_speed_m_s=3e8,
)
INTEGRATION_S, BANDWIDTH_HZ = 4.5, 337.5
SPEEDS = {"at rest": (0.0, 0.0), "P1": (0.0, 10.0), "P2": (10.0, 0.0), "P3": (10.0, 5.0), "P4": (5.0, 10.0)}
POSITIONS = {
    "P1": (-300.0, 60.0),
    "P2": (-150.0, -60.0),
    "P3": (150.0, 60.0),
    "P4": (250.0, -60.0),
}  # azimuth and receive range (m) in figure 16, which prints none
FIGURES = ("az width", "az PSLR", "az ISLR", "rg width", "rg PSLR", "rg ISLR", "MFTA")
# width, PSLR, ISLR along azimuth, then MFTA; along range 2.64 to 2.66 m, -13 dB, -9.8 dB
PUBLISHED = {
    "conventional": {
        "P1": (59.55, -26.30, -26.37, -44.43),
        "P2": (1.06, None, None, -21.95),
        "P3": (8.77, None, None, -20.8),
        "P4": (17.99, None, None, -25.0),
    },
    "proposed": {
        "P1": (0.83, -13.25, -10.01, -68.9),
        "P2": (0.80, -13.07, -10.14, -56.7),
        "P3": (0.81, -13.11, -10.11, -52.4),
        "P4": (0.83, -13.26, -10.09, -47.6),
    },
}


@dataclass(frozen=True)
class _Batch:
    """Targets, one a trial, and their channels. speeds: name -> (u_r, u_a)."""

    speeds: Mapping[str, tuple[float, float]]
    channels: Signal

    @property
    def values(self) -> dict[str, Tensor]:
        """Values of the targets that stages use, (trial,) each."""
        u_r, u_a = torch.tensor(list(self.speeds.values()), dtype=torch.float64).T
        return {"u_r_m_s": u_r, "u_a_m_s": u_a}


@dataclass(frozen=True)
class _Product:
    """Rebuilt spectrum (doppler, range) and image (azimuth, range) of every trial, and how they
    were made. moving: with the velocities of the targets.
    """

    spectrum: Signal
    image: Signal
    bands: int
    moving: bool


def _received(world: BistaticWorld, n_pulse: int, n_range: int, trials: int | None = None) -> Signal:
    """Range-compressed channels (channel, pulse, range) without the transmit range."""
    recording, _ = simulate_bistatic(
        RADAR, world, n_pulse, n_range, Draws(1, trials=None if trials is None else range(trials))
    )
    return RemoveTransmitRange(RADAR)(recording.signal)


def _simulated(speeds: Mapping[str, tuple[float, float]], n_pulse: int, n_range: int) -> _Batch:
    """One target at the middle of the scene in each trial, without noise."""
    u_r, u_a = torch.tensor(list(speeds.values()), dtype=torch.float64).T[..., None]
    world = BistaticWorld(
        MovingPoints(u_r, u_a, torch.zeros_like(u_r), torch.zeros_like(u_r)), BandLimited(INTEGRATION_S)
    )
    return _Batch(speeds, _received(world, n_pulse, n_range, len(speeds)))


def _products(batch: _Batch, method: str) -> list[_Product]:
    """With two and three bands, "conventional" (as if at rest) or "proposed" (with the
    velocities).
    """
    values = batch.values if method == "proposed" else {}
    standing = CorrectMigration(RADAR, Keystone(whole_swath=False))(batch.channels, **values)
    return [_product(standing, bands, values) for bands in (2, 3)]


def _product(
    standing: Signal, bands: int, values: Mapping[str, Tensor | float], range_m: float | None = None
) -> _Product:
    """From channels without migration.

    One filter serves all lines, that of the target: side lobes along range have its history, not
    that of their line.
    """
    with warnings.catch_warnings():
        warnings.simplefilter(
            "ignore"
        )  # three bands of three channels are poorly conditioned, which is what the table shows
        spectrum = Reconstruct(RADAR, LeastSquares(bands))(standing, **values)
    doppler, range_ = spectrum.axes
    motion = PointMotion.of(RADAR, standing.data, **values, range_m=range_m).each(lambda value: value[..., None])
    image = focus_azimuth(spectrum.data.mT, doppler.values(), RADAR, motion, BANDWIDTH_HZ).mT
    return _Product(spectrum, Signal(image, (image_axis(RADAR, doppler), range_)), bands, bool(values))


def _brightest(image: Signal) -> Tensor:
    """Azimuth profile of the strongest range line of each trial, (trial, azimuth)."""
    line = image.data.abs().amax(-2).argmax(-1)
    return take(image.data.mT, line, -2)


def _range_cut(image: Signal) -> Tensor:
    """Range profile of the strongest azimuth line of each trial, (trial, range)."""
    return take(image.data, image.data.abs().amax(-1).argmax(-1), -2)


def _measured(batch: _Batch, made: _Product) -> Tensor:
    """Numbers named by FIGURES, (trial, figure)."""
    profile, step = _brightest(made.image), made.image.axis("azimuth").step
    own, across = (
        azimuth_response(profile, step),
        azimuth_response(_range_cut(made.image), made.image.axis("range").step / 2),
    )
    zones = replica_zones(
        RADAR,
        made.bands,
        batch.values["u_r_m_s"],
        batch.values["u_a_m_s"],
        integration_s=INTEGRATION_S,
        focused_at=None if made.moving else (0.0, 0.0),
    )
    level = replica_level(profile, step, zones)["mfta_db"]
    width = own["irw_m"] * (1 - batch.values["u_a_m_s"] / RADAR.speed_m_s)
    return torch.stack(
        [width, own["pslr_db"], own["islr_db"], across["irw_m"], across["pslr_db"], across["islr_db"], level], -1
    )


def _near(image: Signal, along_m: float, range_m: float, trial: int) -> Signal:
    """Surroundings of the peak of one trial, azimuth and range counted from it, range on the axis c
    tau / 2.
    """
    azimuth, range_ = image.axes
    data = image.data[trial]
    peak = divmod(int(data.abs().argmax()), data.shape[-1])
    reach = round(along_m / azimuth.step), round(2 * range_m / range_.step)
    first = [max(at - side, 0) for at, side in zip(peak, reach, strict=True)]
    part = data[first[0] : peak[0] + reach[0] + 1, first[1] : peak[1] + reach[1] + 1]
    steps = azimuth.step, range_.step / 2
    axes = (
        Axis(axis.name, n, (begin - at) * step, step, "m")
        for axis, n, begin, at, step in zip(image.axes, part.shape, first, peak, steps, strict=True)
    )
    return Signal(part, tuple(axes))


def _finer(image: Signal, factor: int = 8) -> Signal:
    """Interpolated by zeros around its spectrum, for contours."""
    data, axes = image.data, []
    for dim, axis in zip((-2, -1), image.axes, strict=True):
        n = data.shape[dim]
        spectrum = torch.fft.fftshift(torch.fft.fft(data, dim=dim), dim=dim).movedim(dim, -1)
        padded = torch.nn.functional.pad(
            spectrum, ((factor * n) // 2 - n // 2, factor * n - n - ((factor * n) // 2 - n // 2))
        )
        data = factor * torch.fft.ifft(torch.fft.ifftshift(padded, dim=-1)).movedim(-1, dim)
        axes.append(Axis(axis.name, factor * n, axis.start, axis.step / factor, axis.unit))
    return Signal(data, tuple(axes))


def _spectrum_2d(made: _Product, trial: int) -> Signal:
    """Rebuilt spectrum of one trial over Doppler (against the centre) and range frequency."""
    doppler, range_ = made.spectrum.axes
    data = torch.fft.fftshift(torch.fft.fft(made.spectrum.data[trial]), dim=-1)
    step = RADAR.sampling_hz / range_.n / 1e6
    return Signal(data, (doppler, Axis("range frequency", range_.n, -(range_.n // 2) * step, step, "MHz")))


def _draw_target(made: _Product, trial: int, title: str, path: Path, reach_m: float) -> None:
    """Spectrum, image to reach_m along azimuth, and azimuth profile of a target."""
    profile, azimuth = _brightest(made.image)[trial], made.image.axis("azimuth")
    curve = (plot.array(azimuth.values()), plot.decibel(profile))
    parts = [
        {"title": f"{title}: spectrum", "signal": _spectrum_2d(made, trial), "lines": {}},
        {"title": "image about the peak", "signal": _finer(_near(made.image, reach_m, 30.0, trial)), "lines": {}},
        {
            "series": {"": curve},
            "xlabel": "azimuth (m)",
            "ylabel": "amplitude (dB)",
            "title": "azimuth profile",
            "ylim": (-80.0, 2.0),
        },
    ]
    plot.save(plot.overlays(parts, dynamic_range_db=50), path, columns=3)


def _draw_single(batch: _Batch, by_method: Mapping[str, _Product], trials: Sequence[int], out: Path) -> None:
    """Of the targets of these numbers in the batch, figures 5 to 7 (conventional) and 14, 15
    (proposed), their contours in one picture.
    """
    names, contours = list(batch.speeds), {}
    for method, figures in (("conventional", {0: 5, 1: 6, 2: 7}), ("proposed", {1: 14, 2: 15})):
        made = by_method[method]
        for trial, figure in figures.items():
            if trial not in trials:
                continue
            u_r, u_a = batch.speeds[names[trial]]
            title = f"({u_r:g}, {u_a:g}) m/s, {method}"
            blurred = method == "conventional" and u_a != 0
            _draw_target(made, trial, title, out / f"figure_{figure:02}.png", 60.0 if blurred else 15.0)
            contours[f"{figure}: {title}"] = _finer(_near(made.image, 60.0 if blurred else 6.0, 15.0, trial))
    plot.save(plot.contours(contours), out / "contours.png")


def _draw_scene(n_pulse: int, n_range: int, out: Path) -> None:
    """Figure 16: four targets in one scene, and each with its own velocities."""
    azimuth, range_ = zip(*POSITIONS.values(), strict=True)
    u_r, u_a = zip(*(SPEEDS[name] for name in POSITIONS), strict=True)
    world = BistaticWorld(MovingPoints(u_r, u_a, azimuth, range_), BandLimited(INTEGRATION_S))
    data = _received(world, n_pulse, n_range)
    at_rest = FocusAzimuth(RADAR, bandwidth_hz=BANDWIDTH_HZ)(Reconstruct(RADAR)(CorrectMigration(RADAR)(data)))
    lines = {name: (np.full(2, x), np.array([-115.0, 115.0])) for name, (x, _) in POSITIONS.items()}
    part = {
        "title": "four targets as if at rest; lines: true azimuth",
        "signal": _transposed(_relative(at_rest)),
        "lines": lines,
    }
    plot.save(plot.overlays([part], dynamic_range_db=50), out / "figure_16.png", columns=1)
    plot.save(
        plot.contours({name: _own_image(data, name) for name in POSITIONS}), out / "figure_16_contours.png", columns=4
    )


def _own_image(data: Signal, name: str) -> Signal:
    """A target of the scene, found where it appears, focused with its velocities and position."""
    (u_r, u_a), (y0, beyond) = SPEEDS[name], POSITIONS[name]
    values, range_m = {"u_r_m_s": u_r, "u_a_m_s": u_a, "y0_m": y0}, RADAR.reference_range_m + beyond
    standing = CorrectMigration(RADAR, Keystone(whole_swath=False), range_m=range_m)(data, **values)
    image = _product(standing, 2, values, range_m).image
    shown = RADAR.speed_m_s * float(PointMotion.of(RADAR, data.data, **values, range_m=range_m).image_s)
    part = image.crop(
        azimuth=_around(image.axis("azimuth"), shown, 20.0), range=_around(image.axis("range"), range_m, 40.0)
    )
    return _finer(_near(part.with_data(part.data[None]), 6.0, 15.0, 0))


def _around(axis: Axis, position: float, reach: float) -> tuple[int, int]:
    """First sample, and the one behind the last, within reach of a position."""
    first, last = (round(float(axis.index_of(position + side))) for side in (-reach, reach))
    return max(first, 0), min(last, axis.n)


def _relative(image: Signal) -> Signal:
    """Range from the reference on the axis c tau / 2."""
    azimuth, range_ = image.axes
    return Signal(
        image.data,
        (azimuth, Axis("range", range_.n, (range_.start - RADAR.reference_range_m) / 2, range_.step / 2, "m")),
    )


def _transposed(image: Signal) -> Signal:
    """Azimuth horizontal."""
    return Signal(image.data.mT, image.axes[::-1])
