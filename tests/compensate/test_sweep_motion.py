"""Motion of antennas within frequency-modulated sweeps: echo, correction and prediction."""

from __future__ import annotations

import math

import pytest
import torch

from torchsar import Draws, compensate, echo, focus, radar, scene
from torchsar.core import Recording
from torchsar.metrics import error_db
from torchsar.radar import LIGHT_M_S, AntennaPath
from torchsar.study.settings.sections import cases_of
from torchsar.study.systems.path.requirements import flight_requirements
from torchsar.study.table import load
from torchsar.study.trials.bench import Bench

FMCW = radar.InverseRadar(10e9, 150e6, 1000.0, pulse_s=1e-3)
POINTS = [(0.0, 0.0), (24.0, -16.0), (-20.0, 12.0)]  # azimuth, range in metres
PULSES, SAMPLES, SPEED_M_S = 400, 96, 70.0


def flown(squint_deg, receiver=False, moving=True, beam=None, points=POINTS):
    """Recording in complex128 of an aircraft that looks ahead."""
    behind = 2915.0 * math.tan(math.radians(squint_deg)) + SPEED_M_S * PULSES / FMCW.prf_hz / 2
    track = scene.StraightPath((-2500.0, -behind, 1500.0), (0.0, SPEED_M_S, 0.0))
    other = scene.Flight(scene.StraightPath((-2400.0, -behind + 50, 900.0), (0.0, 60.0, 5.0))) if receiver else None
    sway = scene.Sway(z=[scene.Sinusoid(0.3, 2.0)])
    fidelity = scene.MotionInSweep() if moving else None
    targets = scene.Points(*zip(*points, strict=True))
    world = scene.PathWorld(targets, scene.Flight(track, sway), other, beam=beam, fidelity=fidelity)
    return echo.simulate_path(FMCW, world, PULSES, SAMPLES, Draws(1), dtype=torch.complex128)[0]


def corrected(recording: Recording, squint_deg: float | None = None) -> torch.Tensor:
    path = AntennaPath.recorded(recording.aux)
    return compensate.correct_sweep_motion(recording.signal.data, FMCW, path, squint_deg=squint_deg)


@pytest.mark.parametrize("receiver", [False, True])
def test_echo_is_the_direct_sum_over_samples_that_are_sent_one_after_the_other(receiver):
    recording = flown(30.0, receiver)
    number = torch.arange(SAMPLES, dtype=torch.float64) - SAMPLES // 2
    frequency = 10e9 + 150e6 / SAMPLES * number
    time = torch.arange(PULSES, dtype=torch.float64)[:, None] / 1000.0 + 1e-3 / SAMPLES * number
    behind = 2915.0 * math.tan(math.radians(30.0)) + 14.0
    height = 1500.0 + 0.3 * torch.sin(4 * math.pi * time)
    exact = torch.zeros(PULSES, SAMPLES, dtype=torch.complex128)
    for y, x in POINTS:
        out = torch.sqrt((2500.0 + x) ** 2 + (70.0 * time - behind - y) ** 2 + height**2)
        back = out
        if receiver:
            back = torch.sqrt((2400.0 + x) ** 2 + (60.0 * time - behind + 50 - y) ** 2 + (900.0 + 5 * time) ** 2)
        turns = frequency / LIGHT_M_S * (out + back - recording.aux["path_reference_m"][:, None])
        exact += torch.exp(-2j * math.pi * (turns - turns.round()))
    assert error_db(radar.frequency_samples(recording.signal.data), exact) < -170


@pytest.mark.parametrize("receiver", [False, True])
def test_correction_gives_the_recording_of_antennas_at_rest(receiver):
    moved, still = flown(30.0, receiver), flown(30.0, receiver, moving=False)
    assert error_db(moved.signal.data, still.signal.data) > -3
    off = corrected(moved) - still.signal.data
    level = still.signal.data.abs().square().mean()
    # the ends of the record have no neighbours
    for part, worst_db in ((slice(40, -40), -100), (slice(None), -50)):
        assert 10 * math.log10(float(off[part].abs().square().mean() / level)) < worst_db


def test_correction_of_a_strip_follows_its_beam():
    """The whole record has ten times the Doppler band of the pulses; the beam half of it."""
    beam = scene.SideBeam(width_deg=4.0, squint_deg=12.0)
    moved, still = (flown(12.0, moving=moving, beam=beam) for moving in (True, False))
    assert error_db(moved.signal.data, still.signal.data) > 0
    assert error_db(corrected(moved, 12.0), still.signal.data) < -40


@pytest.mark.parametrize(("fidelity", "places_m"), [(True, 0.05), (False, 2.33)])
def test_image_is_where_the_requirements_predict_it(fidelity, places_m):
    """A point is displaced along the line of sight; on the ground by more."""
    recording = flown(30.0, points=POINTS[:1])
    data = corrected(recording) if fidelity else recording.signal.data
    stage = focus.TileImage(10.0, 10.0, 0.05, window="none", error_db=-50.0)
    known = (recording.aux[key] for key in ("frequency_hz", "transmitter_m", "path_reference_m"))
    image = stage(recording.signal.with_data(data), *known)
    line, sample = divmod(int(image.data.abs().argmax()), image.axes[1].n)
    ground = torch.stack([image.axes[1].values()[sample], image.axes[0].values()[line], torch.zeros(())]).double()
    sight = recording.aux["transmitter_m"][PULSES // 2]
    slant_m = float(ground @ sight / sight.norm())
    if fidelity:
        assert float(ground.norm()) < places_m
    else:
        assert slant_m == pytest.approx(places_m, rel=0.03)


def test_requirements_predict_the_displacement():
    bench = Bench(next(iter(cases_of(load("fmcw_squint", ["world.pulses=300"])).values())))
    (row,) = (row for row in bench.system.requirements(bench) if row.effect == "an antenna at rest during a sweep")
    assert row.range_cells == pytest.approx(2.33, rel=0.05) and not row.ok and row.remedy == "correct_sweep_motion"


@pytest.mark.parametrize("beam", [None, scene.SideBeam(width_deg=4.0)])
def test_requirements_hold_for_the_largest_rate_of_a_pass_at_broadside(beam):
    """The mean of the range rate is zero: nothing is displaced, but the ends of a pass are blurred.

    At the last of 256 pulses, 25.5 m along the track and 600 m away, the rate is 1.698 m/s; half of
    a beam of 4 degrees has 40 sin(2 deg) = 1.396 m/s.
    """
    slow = radar.InverseRadar(10e9, 100e6, 200.0, pulse_s=5e-3)
    place = torch.zeros(256, 3).double()
    place[:, 0], place[:, 1] = -600.0, 40.0 * (torch.arange(256) - 127.5) / 200.0
    path = AntennaPath(place, None, 2 * place.norm(dim=-1))
    rows = {row.effect: row for row in flight_requirements(slow, path, path, beam)}
    row = rows["an antenna at rest during a sweep"]
    rate_m_s = 1.698 if beam is None else 1.396
    assert row.phase_rad == pytest.approx(4 * math.pi * 10e9 / LIGHT_M_S * rate_m_s * 2.5e-3, rel=5e-3)
    assert not row.ok and row.range_cells == pytest.approx(0.0, abs=1e-9)


def test_a_radar_without_a_length_of_sweeps_is_refused():
    bare = radar.InverseRadar(10e9, 150e6, 1000.0)
    with pytest.raises(ValueError, match=r"pulse_s is not set"):
        compensate.CorrectSweepMotion(bare)
    world = scene.PathWorld(
        scene.Points([0.0], [0.0]),
        scene.Flight(scene.StraightPath((-800.0, 0.0, 600.0), (0.0, 50.0, 0.0))),
        fidelity=scene.MotionInSweep(),
    )
    with pytest.raises(ValueError, match=r"pulse_s is not set"):
        echo.simulate_path(bare, world, 8, 16, Draws(1))


@pytest.mark.parametrize("squint_deg", [None, 12.0])
def test_trials_have_paths_of_their_own(squint_deg):
    recording = flown(12.0)
    data, aux = recording.signal.data, recording.aux
    moved = aux["transmitter_m"] + torch.tensor([2.0, 0.0, 0.5]) * torch.linspace(-1, 1, PULSES)[:, None].double()
    places, reference = torch.stack([aux["transmitter_m"], moved]), aux["path_reference_m"]
    both = AntennaPath(places, None, reference.expand(2, -1))
    found = compensate.correct_sweep_motion(torch.stack([data, data]), FMCW, both, squint_deg=squint_deg)
    for trial, place in enumerate(places):
        path = AntennaPath(place, None, reference)
        alone = compensate.correct_sweep_motion(data, FMCW, path, squint_deg=squint_deg)
        torch.testing.assert_close(found[trial], alone, rtol=0, atol=1e-9)
    assert error_db(found[1], found[0]) > -60  # it climbs by 1 m and nears by 4 m
