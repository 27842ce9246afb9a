"""Stages that image any path: trials, precision, orientation and refusals."""

from __future__ import annotations

import math

import pytest
import torch

from tests.focus.geometries import case
from torchsar.core import Signal
from torchsar.focus import DirectImage, ProcessedBeam, TileImage
from torchsar.metrics import error_db
from torchsar.radar import LIGHT_M_S, AntennaPath, InverseRadar, StraightTrack, range_profiles

DRAWN = case(1002)
N = len(DRAWN.frequency_hz)
STEP_M = 0.4


def signal(history: torch.Tensor) -> Signal:
    radar = InverseRadar(float(DRAWN.frequency_hz[N // 2]), N * float(DRAWN.frequency_hz.diff()[0]), 100.0)
    return Signal(range_profiles(history), radar.raw_axes(history.shape[-2], N))


def values(**changes: torch.Tensor) -> dict[str, torch.Tensor | None]:
    known = {
        "frequency_hz": DRAWN.frequency_hz,
        "transmitter_m": DRAWN.transmitter_m,
        "receiver_m": DRAWN.receiver_m,
        "path_reference_m": DRAWN.reference_m,
    }
    return {**known, **changes}


@pytest.mark.parametrize("window", ["none", "hann", "range"])
def test_tiles_equal_the_direct_sum_on_noise(window: str) -> None:
    numbers = (12.0, 8.0, STEP_M, (3.0, -2.0), 0.3)
    tiles, exact = (
        stage(*numbers, window=window)(signal(DRAWN.history), **values()) for stage in (TileImage, DirectImage)
    )
    assert tiles.axes == exact.axes and tiles.data.shape == (31, 21)
    assert float(error_db(tiles.data, exact.data)) < -55
    single = DirectImage(*numbers, window=window)(signal(DRAWN.history.to(torch.complex64)), **values())
    assert single.data.dtype == torch.complex64 and float(error_db(single.data.to(torch.complex128), exact.data)) < -100


def test_trials_have_paths_of_their_own() -> None:
    moved = DRAWN.transmitter_m + torch.tensor([0.0, 0.03], dtype=torch.float64)[:, None, None]
    stage = TileImage(6.0, 6.0, STEP_M)
    both = stage(signal(DRAWN.history), **values(transmitter_m=moved))
    assert both.data.shape == (2, 16, 16)
    one = stage(signal(DRAWN.history), **values(transmitter_m=moved[1]))
    assert float(error_db(both.data[1], one.data)) < -55


def test_tiles_sum_the_pulses_that_see_them_within_the_beam() -> None:
    """A beam of 6 degrees at 466 m sees 54 m of a track of 160 m, with smooth edges."""
    y = 0.4 * torch.arange(-200.0, 200.0, dtype=torch.float64)
    place = torch.stack([-450.0 + 0.2 * torch.sin(y / 9), y, torch.full_like(y, 120.0)], -1)
    path = {"transmitter_m": place, "receiver_m": None, "path_reference_m": 2 * torch.linalg.vector_norm(place, dim=-1)}
    history = torch.randn(400, N, dtype=torch.complex128, generator=torch.Generator().manual_seed(1))
    stage = TileImage(4.0, 4.0, STEP_M, window="range", error_db=-80.0, beam_deg=6.0)
    wide = y.abs() <= 466 * math.tan(math.radians(3.3)) + 5.0
    parts = [stage(signal(history * some[:, None]), **values(**path)).data for some in (wide, wide | ~wide)]
    torch.testing.assert_close(*parts)
    # weights follow from the angle to the straight track at each pixel
    one, track = TileImage(0.4, 0.4, STEP_M, window="range", error_db=-80.0, beam_deg=6.0), StraightTrack.fitted(place)
    pixels, exact = one.grid.pixels_m().reshape(-1, 3), []
    for i, pixel in enumerate(pixels):
        ahead = track.along_m(pixel) - track.along_m(place)
        offset = torch.sin(torch.atan2(ahead, track.across_m(pixel).norm())) / math.sin(math.radians(3))
        edge = 0.5 * (1 + torch.cos(math.pi * ((offset.abs() - 0.9) / 0.2).clamp(0, 1)))
        direct = DirectImage(0.4, 0.4, STEP_M, window="range")(signal(history * edge[:, None]), **values(**path))
        exact.append(direct.data.flatten()[i])
    found = one(signal(history), **values(**path)).data.flatten()
    assert float(error_db(found[None], torch.stack(exact)[None])) < -75
    both = {**path, "transmitter_m": torch.stack([place, place + 0.01])}
    assert stage(signal(history), **values(**both)).data.shape == (2, 11, 11)


@pytest.mark.parametrize("step_m", [0.06, 0.15, 0.2])
def test_a_prf_below_the_band_of_the_beam_has_ghosts_of_the_predicted_level_and_place(step_m: float) -> None:
    beam = ProcessedBeam(5.0)
    y = torch.arange(-30.0, 30.0, step_m, dtype=torch.float64)
    place = torch.stack([torch.full_like(y, -300.0), y, torch.full_like(y, 100.0)], -1)
    reference, frequency = 2 * place.norm(dim=-1), 12e9 + 8e6 * torch.arange(-16, 16, dtype=torch.float64)
    stage = TileImage(64.0, 1.0, 0.1, window="range", beam_deg=5.0, error_db=-45.0)
    (limit,) = stage.pulse_limits(AntennaPath(place, None, reference), frequency)
    assert limit.ok == (step_m < LIGHT_M_S / (2 * frequency[-1] * 2 * math.sin(math.radians(2.5))))
    # a point at the origin, whose phases are those of the reference, seen within the beam
    weight = beam.pulse_weights(place, torch.zeros(1, 3, dtype=torch.float64))[0]
    history = weight[:, None] * torch.ones(len(frequency), dtype=torch.complex128)
    radar = InverseRadar(12e9, 256e6, 100.0)
    recorded = Signal(range_profiles(history), radar.raw_axes(len(y), len(frequency)))
    image = stage(recorded, frequency_hz=frequency, transmitter_m=place, path_reference_m=reference, receiver_m=None)
    level = 20 * torch.log10(image.data.abs().amax(-1) / image.data.abs().max())
    away = image.axes[0].values().abs()
    ghost = torch.where(away > 8, level, -math.inf)
    if limit.ok:
        assert float(ghost.max()) < -25
        return
    said = [
        float(word)
        for word in limit.consequence.replace("m", "").split()
        if word.replace("-", "").replace(".", "").isdigit()
    ]
    assert float(ghost.max()) == pytest.approx(said[1], abs=1.5) and float(away[ghost.argmax()]) == pytest.approx(
        said[0], abs=0.5
    )


def test_samples_must_hold_the_spectrum_of_a_point() -> None:
    """Beside a straight track: the Doppler band of the beam, and the range band on the ground."""
    y = 0.4 * torch.arange(-300.0, 300.0, dtype=torch.float64)
    place = torch.stack([torch.full_like(y, -450.0), y, torch.full_like(y, 450.0)], -1)
    antennas = AntennaPath(place, None, torch.zeros_like(y))
    frequency = torch.linspace(9.4e9, 9.8e9, 65, dtype=torch.float64)
    stage = TileImage(2.0, 2.0, 0.2, window="range", beam_deg=6.0)
    azimuth, range_ = stage.sampling_limits(antennas, frequency)
    wanted = LIGHT_M_S / (2 * 9.8e9 * 2 * 1.1 * math.sin(math.radians(3.0)))
    assert azimuth.limit == pytest.approx(wanted, rel=0.01) and azimuth.verdict == "warn"
    band = 2 / LIGHT_M_S * (9.8e9 - 9.4e9 * math.cos(math.radians(3.3))) * math.sqrt(0.5)
    assert range_.limit == pytest.approx(1 / band, rel=0.05) and range_.ok
    # the range axis may lie along the track
    turned = TileImage(2.0, 2.0, 0.2, window="range", beam_deg=6.0, range_axis_rad=math.pi / 2)
    assert turned.sampling_limits(antennas, frequency)[1].limit == pytest.approx(wanted, rel=0.01)
    away = TileImage(2.0, 2.0, 0.2, centre_m=(0.0, 900.0), beam_deg=6.0).sampling_limits(antennas, frequency)
    assert [(limit.verdict, limit.value) for limit in away] == [("refuse", 0)]


def test_the_beam_lights_the_pulses_with_a_weight() -> None:
    """Of an antenna that advances unevenly, and turns back at times."""
    y = torch.arange(-100.0, 100.0, dtype=torch.float64)
    y = y + 3 * torch.sin(y / 2)
    place = torch.stack([-300.0 + torch.sin(y / 9), y, torch.full_like(y, 90.0)], -1)
    points = torch.stack([torch.linspace(-30, 30, 41), torch.linspace(-400, 400, 41), torch.zeros(41)], -1).double()
    beam, track = ProcessedBeam(8.0, 3.0), StraightTrack.fitted(place)
    ahead = track.along_m(points) - track.along_m(place)[:, None]
    sine = ahead / torch.hypot(ahead, torch.linalg.vector_norm(track.across_m(points), dim=-1))
    seen = beam.weight(sine) > 0
    for (first, last), pulses in zip(beam.lit_pulses(place, points).tolist(), seen.unbind(-1), strict=True):
        lit = pulses.nonzero()[:, 0].tolist()
        assert (first, last) == (lit[0], lit[-1] + 1) if lit else first >= last
    with pytest.raises(ValueError, match="does not advance"):
        beam.lit_pulses(place[:1].expand(5, 3), points)


@pytest.mark.parametrize(
    "change", [{"step_m": 0.0}, {"step_m": 9.0}, {"height_m": math.nan}, {"centre_m": (1.0,)}, {"window": "kaiser"}]
)
def test_images_that_make_no_sense_are_refused(change: dict) -> None:
    with pytest.raises((ValueError, TypeError), match="an image needs finite numbers|window|centre_m must be a pair"):
        TileImage(**{"azimuth_m": 8.0, "range_m": 8.0, "step_m": 0.5, **change})
