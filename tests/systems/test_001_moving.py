"""Figures of Remote Sens. 2020, 12, 1703 at reduced size.

Table 4, Table 2, velocities beyond the ambiguity, and the ocean scene.
"""

from __future__ import annotations

import warnings

import pytest
import torch

from torchsar import Chain, Draws, multichannel, use
from torchsar.echo import simulate_bistatic
from torchsar.metrics import azimuth_response, bistatic_bounds, replica_level, replica_zones
from torchsar.radar import BistaticRadar, LinearFM
from torchsar.scene import BandLimited, BistaticWorld, Fleet, KSea, MovingPoints, Ship

RADAR = BistaticRadar(
    1.25e9, LinearFM(50e6, 10e-6), 60e6, 180.0, 300.0, 5000.0, transmit_range=(-243.0, 0.018), wave_speed_m_s=3e8
)
BAND_HZ, GATE = 337.5, BandLimited(4.5)
MOTION = dict.fromkeys(("u_r_m_s", "u_a_m_s", "y0_m"), "velocity")


def chain(radar: BistaticRadar = RADAR, lines: bool = False) -> Chain:
    """From channels to the image of one target, without prior knowledge."""
    stages = {"transmit": multichannel.RemoveTransmitRange(radar)}
    if lines:
        stages["walk"] = multichannel.WalkAmbiguity(radar)
        stages["migration"] = use(multichannel.CorrectMigration(radar), ambiguity="walk.ambiguity")
    return Chain(
        **stages,
        velocity=multichannel.MovingPointVelocity(radar, multichannel.Dwell(4.5)),
        rebuild=use(multichannel.Reconstruct(radar, multichannel.LeastSquares(2)), **MOTION),
        image=use(multichannel.FocusAzimuth(radar, bandwidth_hz=BAND_HZ), **MOTION),
    )


@pytest.mark.slow
@pytest.mark.parametrize("speeds", [(0.0, 10.0), (10.0, 5.0), (-17.0, 14.0)])
def test_a_target_without_prior_knowledge_is_sharp_and_without_replicas(speeds: tuple[float, float]) -> None:
    u_r, u_a = speeds
    world = BistaticWorld(MovingPoints([u_r], [u_a], [0.0], [0.0]), GATE, snr_db=27.0)
    recording, truth = simulate_bistatic(RADAR, world, 3600, None, Draws(5), dtype=torch.complex128)
    trace = chain().trace(recording)
    found = trace.estimates["velocity"]
    assert bool(found.ok) and abs(float(found["u_r_m_s"]) - u_r) < 0.06 and abs(float(found["u_a_m_s"]) - u_a) < 0.01
    assert truth.clean is not None
    motion = multichannel.PointMotion.of(RADAR, recording.signal.data.real, *(found[name] for name in MOTION))
    rebuilt = multichannel.reconstruct(
        multichannel.RemoveTransmitRange(RADAR)(truth.clean.signal).data, RADAR, motion, multichannel.LeastSquares(2)
    )
    profile = multichannel.focus_azimuth(rebuilt, multichannel.doppler_offsets(3600, 2, 180.0), RADAR, motion, BAND_HZ)
    step_m = float(motion.along_m_s) / 360
    figures = azimuth_response(profile, step_m, -3600 * step_m)
    theory = 0.886 * 0.24 * 5000 / ((300 - u_a) * 4.5)
    assert float(figures["irw_m"]) == pytest.approx(theory, rel=0.02)
    assert float(figures["pslr_db"]) == pytest.approx(-13.26, abs=0.15) and float(figures["islr_db"]) == pytest.approx(
        -9.8, abs=0.3
    )
    zones = replica_zones(
        RADAR, 2, u_r, u_a, 0.0, 5000.0, integration_s=4.5, orders=(1, 2, 3), axis_speed_m_s=300.0 - u_a
    )
    assert float(replica_level(profile, step_m, zones)["mfta_db"]) < -60


@pytest.mark.slow
def test_estimators_stand_where_the_bound_lets_them() -> None:
    # raw -30 dB
    world = BistaticWorld(MovingPoints([10.0], [0.0], [0.0], [0.0]), GATE, snr_db=-3.0)
    recording, _ = simulate_bistatic(RADAR, world, 900, None, Draws(6, trials=range(80)))
    signal = multichannel.RemoveTransmitRange(RADAR)(recording.signal)
    known = multichannel.MovingPointVelocity(
        RADAR, multichannel.Dwell(4.5), search=multichannel.Search(u_r_m_s=21.0), u_a_m_s=0.0
    )
    bound = float(
        bistatic_bounds(RADAR, 900, 10**-0.3, 10.0, 0.0, 0.0, 5000.0, integration_s=4.5, unknown=("u_r_m_s", "y0_m"))[
            "u_r_m_s"
        ]
    )
    simple = multichannel.Interferometry(RADAR, multichannel.Dwell(4.5), check_ambiguity=False)
    ml, ati = (float((stage(signal)["u_r_m_s"] - 10).square().mean().sqrt()) / bound for stage in (known, simple))
    assert 0.8 < ml < 1.3 and ati < 2.2


@pytest.mark.slow
@pytest.mark.parametrize("u_r", [25.0, -35.0])
def test_velocities_beyond_the_ambiguity_are_found_or_warned_of(u_r: float) -> None:
    world = BistaticWorld(MovingPoints([u_r], [0.0], [0.0], [0.0]), GATE, snr_db=0.0)
    one, _ = simulate_bistatic(RADAR, world, 900, None, Draws(7, trials=range(2)))
    found = chain().trace(one).estimates["velocity"]
    assert bool(found.ok.all()) and float((found["u_r_m_s"] - u_r).abs().max()) < 1.0
    two, _ = simulate_bistatic(RADAR, world, 900, 96, Draws(7))
    trace = chain(lines=True).trace(two)
    assert float(trace.values["walk.ambiguity"]) == (1.0 if u_r > 0 else -1.0)
    assert bool(trace.estimates["velocity"].ok) and abs(float(trace.values["velocity.u_r_m_s"]) - u_r) < 1.0
    with pytest.warns(UserWarning, match="whole pulse rates"):
        found = multichannel.Interferometry(RADAR, multichannel.Dwell(4.5))(
            multichannel.RemoveTransmitRange(RADAR)(one.signal)
        )
    assert not bool(found.ok.any())


@pytest.mark.slow
def test_a_ship_leaves_the_sea_as_it_was_and_goes_to_its_place() -> None:
    sea = KSea(shape=1.5, power_db=0.0)
    ship = Ship(10.0, 0.0, 0.0, 0.0, level_db=10.0)
    with_ship, truth = simulate_bistatic(
        RADAR, BistaticWorld(Fleet({"ship": ship}), GATE, sea, snr_db=30.0), 1260, 128, Draws(8)
    )
    alone, _ = simulate_bistatic(RADAR, BistaticWorld(None, GATE, sea, snr_db=30.0), 1260, 128, Draws(8))
    take = multichannel.RemoveTransmitRange(RADAR)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        made = multichannel.ImageMovers(RADAR, detector=multichannel.Detector(suppressed_m_s=()))(
            take(with_ship.signal)
        )
    body = made.bodies[0]
    assert len(made.bodies) == 1 and bool(body.ok)
    assert abs(float(body.motion.u_r_m_s) - 10) < 0.09 and abs(float(body.motion.u_a_m_s)) < 0.3
    weight = truth.values["amplitude"].abs().square()
    assert float(body.motion.y0_m) == pytest.approx(
        float((weight * truth.values["y0_m"]).sum() / weight.sum()), abs=4.0
    )  # what interference of its points moves
    expected = multichannel.StationaryImage(RADAR)(take(alone.signal)).data
    shown = 300 * float(body.motion.image_s)
    azimuth, range_ = (axis.values() for axis in made.rest.axes)
    about = ((azimuth - shown).abs() < 400)[:, None] & ((range_ - body.motion.range_m).abs() < 30)
    before, after = (
        float((image.data - expected)[about].abs().square().mean() / expected[about].abs().square().mean())
        for image in (made.conventional, made.rest)
    )
    assert before > 3 and after < 0.01
