"""Echoes along any path against direct sums, and what recordings and truth hold."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from torchsar.core import Chain, Draws, Recording, use
from torchsar.echo import PathError, path_echo, simulate_path
from torchsar.focus import DirectImage, TileImage
from torchsar.metrics import error_db
from torchsar.radar import LIGHT_M_S, AntennaPath, InverseRadar, frequency_samples
from torchsar.scene import (
    CircularPath,
    Flight,
    Navigation,
    Offset,
    PathWorld,
    PlaneGround,
    Points,
    RandomPoints,
    RandomWalk,
    SideBeam,
    Sinusoid,
    StraightPath,
    Sway,
    VibrationSpectrum,
)

F64 = torch.float64
RADAR = InverseRadar(9.6e9, 300e6, 200.0)
N_PULSE, N_RANGE = 96, 80
POINTS = Points([3.0, -8.0, 0.0], [5.0, 9.0, -12.0], [1.0, 0.5, 2.0])
AIRCRAFT = Flight(StraightPath((-3000.0, -30.0, 2000.0), (0.0, 120.0, 0.0)), Sway(x=[Sinusoid(0.3, 1.5)]))
DRONE = Flight(CircularPath(800.0, 200.0, 0.3, 0.05))
FIXED = Flight(StraightPath((-900.0, 400.0, 300.0)))


def direct(true: list[np.ndarray], recorded: list[np.ndarray], points: np.ndarray, amplitude: np.ndarray) -> np.ndarray:
    """Phase history by a sum in float64 for every sample; positions (pulse, 3)."""
    frequency = 9.6e9 + 300e6 / N_RANGE * (np.arange(N_RANGE) - N_RANGE // 2)
    out = np.zeros((N_PULSE, N_RANGE), complex)
    for p in range(N_PULSE):
        reference = sum(np.linalg.norm(place[p]) for place in recorded) * 2 / len(recorded)
        for x, a in zip(points, amplitude, strict=True):
            path = sum(np.linalg.norm(place[p] - x) for place in true) * 2 / len(true)
            out[p] += a * np.exp(-2j * np.pi * frequency / LIGHT_M_S * (path - reference))
    return out


@pytest.mark.parametrize("receiver", [None, DRONE])
def test_equals_direct_sums(receiver: Flight | None) -> None:
    off = Navigation(Sway(x=[Offset(0.2)], z=[Sinusoid(0.05, 2.0)]))
    transmitter = AIRCRAFT if receiver is None else FIXED
    world = PathWorld(POINTS, transmitter, receiver, off, off, PlaneGround(2.0, 0.1, -0.05))
    recording, truth = simulate_path(RADAR, world, N_PULSE, N_RANGE, Draws(0), dtype=torch.complex128)
    names = ["transmitter_m"] if receiver is None else ["transmitter_m", "receiver_m"]
    true = [truth.values[f"true_{name}"].numpy() for name in names]
    x, y = truth.values["range_m"], truth.values["azimuth_m"]
    points = torch.stack([x, y, 2 + 0.1 * x - 0.05 * y], -1).numpy()
    recorded = [recording.aux[name].numpy() for name in names]
    known = torch.from_numpy(direct(true, recorded, points, truth.values["amplitude"].numpy()))
    history = frequency_samples(recording.signal.data)
    assert float(error_db(history, known)) < -150
    single = simulate_path(RADAR, world, N_PULSE, N_RANGE, Draws(0))[0].signal.data
    assert single.dtype == torch.complex64 and float(error_db(single, recording.signal.data)) < -118
    assert ("receiver_m" in recording.aux) == (receiver is not None) != ("position_m" in recording.aux)


def test_clean_recordings_have_the_true_path_and_focus() -> None:
    noisy = Navigation(Sway(x=[RandomWalk(0.05, 0.005)]), latency_s=0.01)
    world = PathWorld(POINTS, AIRCRAFT, navigation=noisy)
    recording, truth = simulate_path(RADAR, world, N_PULSE, N_RANGE, Draws(1, trials=range(3)))
    assert truth.clean is not None and torch.equal(recording.signal.data, truth.clean.signal.data)
    true, recorded = truth.values["true_transmitter_m"], recording.aux["transmitter_m"]
    assert torch.equal(truth.clean.aux["transmitter_m"], true) and recorded.shape == (3, N_PULSE, 3)
    off = torch.linalg.vector_norm(recorded, dim=-1) - torch.linalg.vector_norm(true, dim=-1)
    torch.testing.assert_close(truth.values["line_of_sight_m"], off)
    uses = {name: f"aux.{name}" for name in ("frequency_hz", "transmitter_m", "path_reference_m")}
    image = Chain(image=use(TileImage(40.0, 40.0, 0.5), **uses))(truth.clean)
    for trial in image.data:
        i, j = divmod(int(trial.abs().argmax()), 81)
        assert (float(image.axes[0].values()[i]), float(image.axes[1].values()[j])) == (0.0, -12.0)


def test_errors_of_the_path_join_a_recording() -> None:
    world = PathWorld(POINTS, FIXED, DRONE)
    error = PathError(Sway(x=[Offset(0.1)]), Sway(y=[RandomWalk(torch.tensor([0.0, 0.1], dtype=F64), 0.01)]))
    draws = Draws(1, trials=range(2))
    recording, truth = simulate_path(RADAR, world, N_PULSE, N_RANGE, draws, {"path": error})
    assert truth.clean is not None
    off = recording.aux["transmitter_m"] - truth.clean.aux["transmitter_m"]
    torch.testing.assert_close(off, torch.tensor([0.1, 0.0, 0.0], dtype=F64).expand(N_PULSE, 3))
    walk = recording.aux["receiver_m"] - truth.clean.aux["receiver_m"]
    assert float(walk[0].abs().max()) == 0 < float(walk[1, :, 1].abs().max()) and float(walk[..., 0].abs().max()) == 0
    names = ("transmitter_m", "receiver_m")
    after, before = (
        sum(torch.linalg.vector_norm(side.aux[name], dim=-1) for name in names) / 2 for side in (recording, truth.clean)
    )
    torch.testing.assert_close(truth.values["path.line_of_sight_m"], after - before, rtol=0, atol=1e-9)
    # reference and samples change together: the echoes are those of the new reference
    quiet, _ = simulate_path(RADAR, world, N_PULSE, N_RANGE, draws)
    antennas = AntennaPath(quiet.aux["transmitter_m"], quiet.aux["receiver_m"], recording.aux["path_reference_m"])
    drawn = POINTS.scatterers(draws)
    points = torch.stack([drawn.range_m, drawn.azimuth_m, torch.zeros(3, dtype=F64)], -1)
    known = path_echo(antennas, points, drawn.amplitude[..., None, :], RADAR, N_RANGE)
    assert float(error_db(frequency_samples(recording.signal.data), known).max()) < -100
    bare = Recording(recording.signal, RADAR)
    with pytest.raises(ValueError, match="need recorded positions"):
        error(bare, draws)


def test_snr_is_that_of_lit_pulses_and_noise_has_its_address() -> None:
    scene = RandomPoints(60, 30.0, 30.0)
    snr_db = torch.tensor([0.0, 10.0, 20.0], dtype=F64)
    world = PathWorld(scene, AIRCRAFT, snr_db=snr_db, beam=SideBeam(1.5))
    draws = Draws(2, trials=range(3))
    noisy, truth = simulate_path(RADAR, world, N_PULSE, N_RANGE, draws)
    quiet, _ = simulate_path(RADAR, PathWorld(scene, AIRCRAFT, beam=world.beam), N_PULSE, N_RANGE, draws)
    left = (noisy.signal.data - quiet.signal.data).abs().double().square().mean((-2, -1)).sqrt()
    torch.testing.assert_close(left, truth.values["noise_std"], rtol=0.03, atol=0)
    one, _ = simulate_path(
        RADAR, PathWorld(scene, AIRCRAFT, snr_db=10.0, beam=world.beam), N_PULSE, N_RANGE, Draws(2, trials=[1])
    )
    torch.testing.assert_close(one.signal.data[0], noisy.signal.data[1], rtol=0, atol=1e-4)


def test_the_beam_lights_targets_for_its_width() -> None:
    """At 3.6 km a beam of 1.5 degrees is 94 m long, 0.79 s at 120 m/s; 1 degree of yaw is 63 m."""
    radar, point = InverseRadar(9.6e9, 300e6, 100.0), Points([0.0], [0.0])
    flight = Flight(StraightPath((-3000.0, -120.0, 2000.0), (0.0, 120.0, 0.0)))
    for yaw, middle in ((0.0, 100.0), (0.5, 100.0 - 31.5 / 1.2)):
        world = PathWorld(point, flight, beam=SideBeam(1.5, yaw_deg=yaw))
        data = simulate_path(radar, world, 200, N_RANGE, Draws(0))[0].signal.data
        level = data.abs().square().sum(-1)
        lit = (level >= level.max() / 4).nonzero()[:, 0].double()
        assert float(lit.mean()) == pytest.approx(middle, abs=1) and len(lit) == pytest.approx(79, abs=2)


def test_the_mean_power_of_a_beam_is_that_over_its_sway() -> None:
    edge = torch.sin(torch.deg2rad(torch.tensor([0.0, 0.75], dtype=F64)))
    steady = SideBeam(1.5).mean_power(edge)
    torch.testing.assert_close(steady, torch.tensor([1.0, 0.25], dtype=F64), rtol=0, atol=1e-3)
    time = torch.linspace(0, 4, 2001, dtype=F64)[:-1]  # of two periods
    swaying = SideBeam(torch.tensor([1.5, 3.0], dtype=F64), sway_deg=0.5, sway_hz=0.5)
    mean = swaying.gain(time, edge.expand(len(time), -1)).pow(4).mean(-2)
    torch.testing.assert_close(swaying.mean_power(edge), mean, rtol=0, atol=1e-3)


def test_a_strip_has_a_constant_window_and_records_what_it_holds() -> None:
    radar, flight = InverseRadar(9.6e9, 300e6, 10.0), Flight(StraightPath((-400.0, -300.0, 300.0), (0.0, 60.0, 0.0)))
    world = PathWorld(Points([-200.0, 200.0], [0.0, 0.0]), flight, beam=SideBeam(10.0), window_range_m=500.0)
    recording, _ = simulate_path(radar, world, 100, N_RANGE, Draws(0))
    assert bool((recording.aux["path_reference_m"] == 1000.0).all())
    power = recording.signal.data.abs().square().sum(-1)
    # beyond 520 m, 143 m along the path, nothing is recorded
    middle = -300 + 6 * torch.arange(100, dtype=F64)
    assert bool((power[(middle.abs() < 57)] == 0).all()) and bool((power[(middle.abs() - 200).abs() < 140] > 0).all())


def test_heights_of_the_ground() -> None:
    x, y = torch.tensor([0.0, 2.5, 5.0, 9.0], dtype=F64), torch.tensor([-5.0, 0.0, 2.5, 50.0], dtype=F64)
    tilted = PlaneGround(torch.tensor([1.0, 2.0], dtype=F64), 0.5).height_m(x, y)
    torch.testing.assert_close(tilted[1], 2 + 0.5 * x)


def test_gradients_in_positions_and_amplitudes() -> None:
    place = AIRCRAFT.position_m(torch.arange(4, dtype=F64) / 50).requires_grad_()
    points = torch.tensor([[5.0, 3.0, 0.0], [-4.0, 1.0, 2.0]], dtype=F64)
    weight = torch.tensor([[1.0, 0.5j]], dtype=torch.complex128, requires_grad=True)
    low = InverseRadar(3e7, 3e6, 50.0)

    def echo(place: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
        antennas = AntennaPath(place, None, torch.full((4,), 7200.0, dtype=F64))
        return path_echo(antennas, points, weight, low, 6, torch.complex128)

    assert torch.autograd.gradcheck(echo, (place, weight), eps=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("world", "match"),
    [
        (
            lambda: PathWorld(Points([0.0], [40.0]), AIRCRAFT),
            "lit scene must stay within 19.99 m of range .* reaches 33",
        ),
        (lambda: PathWorld(POINTS, FIXED, beam=SideBeam(5.0)), "an antenna that moves horizontally"),
        (lambda: PathWorld(POINTS, AIRCRAFT, snr_db=math.nan), "snr_db must be a finite number"),
        (lambda: PathWorld(POINTS, AIRCRAFT, snr_db=torch.zeros(2)), "one for each of the 3 trials"),
        (lambda: PathWorld(POINTS, AIRCRAFT, beam=SideBeam(0.0)), "between 0 and 180 degrees"),
        (
            lambda: PathWorld(POINTS, Flight(AIRCRAFT.nominal, Sway(z=[VibrationSpectrum(torch.ones(2), 1.0, 2.0)]))),
            "rms_m of VibrationSpectrum must be a number or one for each of the 3 trials",
        ),
    ],
)
def test_worlds_that_make_no_sense_are_refused(world, match: str) -> None:
    with pytest.raises(ValueError, match=match):
        simulate_path(RADAR, world(), N_PULSE, N_RANGE, Draws(0, trials=range(3)))


def test_tiles_of_a_bistatic_pair_equal_the_direct_sum() -> None:
    world = PathWorld(POINTS, FIXED, DRONE)
    recording, _ = simulate_path(RADAR, world, N_PULSE, N_RANGE, Draws(0), dtype=torch.complex128)
    uses = {n: f"aux.{n}" for n in ("frequency_hz", "transmitter_m", "receiver_m", "path_reference_m")}
    tiles, exact = (
        Chain(image=use(stage, **uses))(recording).data
        for stage in (TileImage(16.0, 16.0, 0.5, error_db=-80.0), DirectImage(16.0, 16.0, 0.5))
    )
    assert float(error_db(tiles, exact)) < -77
