"""Doppler centroid of the beam from the position of one point in the image."""

from __future__ import annotations

import math

import pytest
import torch

from torchsar.compensate import PointDoppler, doppler_assess, doppler_at
from torchsar.compensate.point import peak_time_s
from torchsar.core import Draws, Outcome, Signal
from torchsar.echo import simulate
from torchsar.echo.strip import target_energy
from torchsar.focus import OmegaK
from torchsar.metrics import reference_doppler_std_hz, tone_frequency_bound_hz
from torchsar.radar import LinearFM, StripmapRadar
from torchsar.scene import Dwell, Points, RandomPoints, Scene, Speckle, StripmapWorld

RADAR = StripmapRadar(
    3.2e9, LinearFM(50e6, 1e-6), 62.5e6, 1000.0, 7000.0, 700e3, pointing_doppler_hz=652.0, integration_s=0.3
)


def observed(snr_db: float, doppler_hz: float, trials: int = 60, seed: int = 1):
    world = StripmapWorld(Points([0.0], [0.0], random_phase=True), Dwell(0.3), doppler_hz=doppler_hz, snr_db=snr_db)
    recording, truth = simulate(
        RADAR, world, 512, 192, Draws(seed, case=f"{snr_db}/{doppler_hz}", trials=range(trials))
    )
    q = float((target_energy(truth, world, RADAR, 512).sum(-1) / truth.values["noise_std"].square()).mean())
    return PointDoppler(RADAR)(OmegaK(RADAR)(recording.signal)), q


@pytest.mark.slow
@pytest.mark.parametrize("snr_db, doppler_hz", [(-20.0, 391.0), (-10.0, 652.0), (0.0, 913.0)])
def test_error_reaches_the_bound_of_a_tone_below_the_papers_curve(snr_db: float, doppler_hz: float) -> None:
    found, q = observed(snr_db, doppler_hz)
    rmse = float((found["doppler_hz"] - doppler_hz).square().mean().sqrt())
    bound = float(tone_frequency_bound_hz(q, 0.3))
    assert 0.7 * bound <= rmse <= 1.35 * bound
    assert rmse <= float(reference_doppler_std_hz(q, 0.3))
    assert bool(found.ok.all()) and float(found.std["doppler_hz"].median()) == pytest.approx(bound, rel=0.35)


def test_a_weak_point_has_the_std_of_its_bound() -> None:
    """Its image is 27 lines wide, and the highest of these lines holds 1.5 times its power."""
    radar = StripmapRadar(
        3.2e9, LinearFM(100e6, 0.4e-6), 125e6, 4000.0, 7000.0, 700e3, pointing_doppler_hz=652.0, integration_s=0.1
    )
    world = StripmapWorld(Points([0.0], [0.0], random_phase=True), Dwell(0.1), doppler_hz=652.0, snr_db=-20.0)
    recording, truth = simulate(radar, world, 512, 192, Draws(3, trials=range(12)))
    q = float((target_energy(truth, world, radar, 512).sum(-1) / truth.values["noise_std"].square()).mean())
    found = PointDoppler(radar)(OmegaK(radar)(recording.signal))
    std = float(found.std["doppler_hz"].square().mean().sqrt())
    assert found.ok.all() and std == pytest.approx(float(tone_frequency_bound_hz(q, 0.1)), rel=0.1)


def test_noise_alone_is_not_ok(monkeypatch: pytest.MonkeyPatch) -> None:
    noise = Draws(4, trials=range(20)).normal("n", (512, 192), torch.complex64)
    found = PointDoppler(RADAR)(Signal(noise, RADAR.image_axes(RADAR.raw_axes(512, 192))))
    assert bool((found.outcome == Outcome.NOISE).all())
    silent = PointDoppler(RADAR)(
        Signal(torch.zeros(2, 64, 64, dtype=torch.complex64), RADAR.image_axes(RADAR.raw_axes(64, 64)))
    )
    assert bool((silent.outcome == Outcome.EMPTY).all()) and bool(torch.isfinite(silent["doppler_hz"]).all())
    monkeypatch.delattr(doppler_assess, "of_point")
    alone = PointDoppler(RADAR, assess=False)(Signal(noise, RADAR.image_axes(RADAR.raw_axes(512, 192))))
    assert not alone.std and bool((alone.outcome == Outcome.NOT_ASSESSED).all())
    assert torch.equal(alone["doppler_hz"], found["doppler_hz"])


@pytest.mark.parametrize("scene", [Speckle(600, 900.0, 60.0), RandomPoints(3, 60.0, 400.0)])
def test_a_point_that_does_not_stand_out_is_not_ok(scene: Scene) -> None:
    world = StripmapWorld(scene, Dwell(0.3), doppler_hz=652.0, snr_db=10.0)
    image = OmegaK(RADAR)(simulate(RADAR, world, 512, 192, Draws(6, trials=range(6)))[0].signal)
    assert bool((PointDoppler(RADAR)(image).outcome == Outcome.AMBIGUOUS).all())


def test_doppler_at_inverts_the_image_position() -> None:
    zero_s, closest_m, velocity = 0.7, 701e3, 7003.0
    for crossing_s in (-0.4, 0.2, 0.6):
        ahead = velocity * (zero_s - crossing_s)
        doppler = 2 * velocity / RADAR.wavelength_m * ahead / math.hypot(closest_m, ahead)
        for frame_hz in (0.0, 652.0, -900.0):
            position = RADAR.image_position(
                torch.tensor(zero_s, dtype=torch.float64),
                torch.tensor(closest_m, dtype=torch.float64),
                frame_hz,
                velocity,
            )
            assert float(doppler_at(RADAR, *position, frame_hz, velocity, crossing_s)) == pytest.approx(
                doppler, abs=1e-7
            )


def test_a_frame_is_required() -> None:
    from dataclasses import replace

    radar = replace(RADAR, pointing_doppler_hz=None)
    with pytest.raises(ValueError, match="PointDoppler: frame_hz, .* is not known"):
        PointDoppler(radar)(Signal(torch.ones(64, 64, dtype=torch.complex64), radar.image_axes(radar.raw_axes(64, 64))))


@pytest.mark.slow
@pytest.mark.parametrize("at_m, inside", [(40.0, True), (140.0, True), (-145.0, True), (165.0, False)])
def test_the_std_of_a_cut_aperture_follows_its_observed_part(at_m: float, inside: bool) -> None:
    """An airborne radar with 307 m of track and 120 m of aperture.

    The image contains the point, circularly, 140 m beyond its end.
    """
    radar = StripmapRadar(
        9.6e9, LinearFM(60e6, 1.5e-6), 75e6, 400.0, 120.0, 5000.0, pointing_doppler_hz=0.0, integration_s=1.0
    )
    world = StripmapWorld(
        Points([at_m], [0.0], random_phase=True), Dwell(1.0), doppler_hz=math.copysign(37.0, at_m), snr_db=-10.0
    )
    recording, truth = simulate(radar, world, 1024, 192, Draws(2, case=f"{at_m}", trials=range(30)))
    found = PointDoppler(radar, crossing_s=float(truth.values["crossing_s"].flatten()[0]))(
        OmegaK(radar)(recording.signal)
    )
    q = float((target_energy(truth, world, radar, 1024).sum(-1) / truth.values["noise_std"].square()).mean())
    bound = float(tone_frequency_bound_hz(q, min(1.0, 0.5 + 1.28 - abs(at_m) / 120)))
    rmse = float((found["doppler_hz"] - world.doppler_hz).square().mean().sqrt())
    assert bool((found.ok == inside).all()) and 0.6 * bound <= rmse <= 1.4 * bound
    assert float(found.std["doppler_hz"].median()) == pytest.approx(bound, rel=0.15)


@pytest.mark.parametrize("sample", [30.0, 30 + 1e-12, 30.4, -5.3])
def test_the_time_of_a_point_beside_the_image_stays(sample: float) -> None:
    image = Draws(3).normal("image", (64, 3), dtype=torch.complex64)
    at = [torch.tensor(v, dtype=torch.float64) for v in (sample, 0.0, 0.05)]
    found = float(peak_time_s(image, 400.0, at[0], 20.0, (-0.05, 0.05), *at[1:]))
    assert found == 0.05
    inside = float(peak_time_s(image, 400.0, 0 * at[1] + 1, 20.0, (-0.05, 0.05), *at[1:]))
    assert math.isfinite(inside) and inside != 0.05
