"""Moving targets in strips, against positions in space computed directly."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path

import pytest
import torch
import yaml

from tests.helpers import small_radar
from tests.systems.test_world_to_metric import CONFIGS
from torchsar import focus, scene
from torchsar.core import Draws, Recording, Truth
from torchsar.data import config_chain
from torchsar.echo import simulate
from torchsar.radar import LinearFM, StripmapRadar
from torchsar.scene.strip import Beam

PULSES, SAMPLES, SPEED = 192, 128, 120.0
U_R, U_A = [0.0, 6.0, -9.0, 2.0], [0.0, 0.0, 15.0, -20.0]
AT_REST = scene.Points([0.0], [0.0], [0.0])  # of no amplitude
AT, FAR = [0.0, 4.0, -6.0, 2.0], [0.0, 3.0, -5.0, 8.0]


def moving(beam: Beam, doppler_hz: float = 0.0, **changes: object) -> tuple[Recording, Truth]:
    world = scene.StripmapWorld(AT_REST, beam, doppler_hz=doppler_hz, movers=scene.MovingPoints(U_R, U_A, AT, FAR))
    return simulate(small_radar(), world, PULSES, SAMPLES, Draws(1), dtype=torch.complex128)


def directly(doppler_hz: float, length_m: float) -> torch.Tensor:
    """Peak of each compressed line of every target: phase from its place in the slant plane, and
    gain of an aperture from its direction, (target, pulse).
    """
    radar = small_radar()
    time_s = (torch.arange(PULSES, dtype=torch.float64) - PULSES // 2) / radar.prf_hz
    u_r, u_a, at, far = (torch.tensor(x, dtype=torch.float64)[:, None] for x in (U_R, U_A, AT, FAR))
    sine = doppler_hz * radar.wavelength_m / (2 * SPEED)
    slant = radar.near_range_m + (SAMPLES - radar.pulse_samples) / 2 * radar.range_step_m + far
    along = at + slant * sine + (u_a - SPEED) * time_s
    away = slant * (1 - sine**2) ** 0.5 - u_r * time_s
    range_m = torch.hypot(along, away)
    gain = torch.sinc(length_m / radar.wavelength_m * (along / range_m - sine)) ** 2
    return gain * torch.exp(-4j * torch.pi / radar.wavelength_m * range_m)


@pytest.mark.parametrize("doppler_hz", [0.0, 60.0])
def test_the_echo_has_the_phase_and_gain_of_targets_that_move_in_space(doppler_hz: float) -> None:
    radar, truths = small_radar(), []
    for i in range(len(U_R)):
        one = scene.MovingPoints(U_R[i : i + 1], U_A[i : i + 1], AT[i : i + 1], FAR[i : i + 1])
        world = scene.StripmapWorld(AT_REST, scene.Antenna(2.0), doppler_hz=doppler_hz, movers=one)
        recording, truth = simulate(radar, world, PULSES, SAMPLES, Draws(1), dtype=torch.complex128)
        truths.append(float(truth.values["u_r_m_s"][1]))
        # at the range frequency zero a line has the phase of the range, but for what it cuts off
        whole = torch.fft.fft(recording.signal.data)[:, 0] / radar.pulse.spectrum(SAMPLES, radar.sampling_hz)[0]
        torch.testing.assert_close(whole, directly(doppler_hz, 2.0)[i], rtol=0, atol=1e-3)
    assert truths == U_R


def test_the_beam_sees_a_target_where_it_crosses() -> None:
    dwell_s = 0.1
    recording, truth = moving(scene.Dwell(dwell_s), doppler_hz=30.0)
    time_s = torch.arange(PULSES, dtype=torch.float64) / small_radar().prf_hz
    direction = 30.0 * small_radar().wavelength_m / (2 * SPEED)
    middle_s = PULSES // 2 / small_radar().prf_hz
    for i, crossing in enumerate(truth.values["crossing_s"][1:].tolist()):
        t = crossing - middle_s
        slant = float(small_radar().near_range_m + (SAMPLES - small_radar().pulse_samples) / 2 * 299792458 / 2 / 50e6)
        slant += FAR[i]
        along = AT[i] + slant * direction + (U_A[i] - SPEED) * t
        away = slant * (1 - direction**2) ** 0.5 - U_R[i] * t
        assert abs(along / (along**2 + away**2) ** 0.5 - direction) < 1e-9
    seen = ((time_s[:, None] - truth.values["crossing_s"][1:]).abs() <= dwell_s / 2).any(-1)
    assert torch.equal(recording.signal.data.abs().amax(-1) > 1e-3, seen)


def test_a_mover_appears_displaced_by_its_radial_speed() -> None:
    radar, u_r = small_radar(), 1.5
    ship = scene.MovingPoints([u_r], [0.0], [0.0], [0.0])
    world = scene.StripmapWorld(scene.Points([-25.0], [0.0]), scene.Dwell(0.3), movers=ship)
    recording, truth = simulate(radar, world, 448, 128, Draws(1))
    image = focus.RangeDoppler(radar)(recording.signal)
    azimuth = image.axes[0].values()[image.data[:, 63].abs().topk(12).indices] - image.axes[0].values()[224]
    slant = float(truth.values["closest_range_m"][1])
    expected = slant * u_r / SPEED  # a closing target appears ahead
    assert float((azimuth - expected).abs().min()) < 1.0
    assert float((azimuth + 25.0).abs().min()) < 1.0


def test_per_trial_speeds_are_those_of_single_trials_and_their_derivatives_are_true() -> None:
    radar = small_radar()

    def energy(u_r: torch.Tensor, u_a: torch.Tensor) -> torch.Tensor:
        ship = scene.MovingPoints([u_r], [u_a], [0.0], [0.0])
        world = scene.StripmapWorld(scene.Points([3.0], [0.0]), scene.Antenna(2.0), movers=ship)
        trials = Draws(1, trials=range(len(u_r)))
        return simulate(radar, world, 16, 64, trials, dtype=torch.complex128)[0].signal.data

    u_r, u_a = (torch.tensor(x, dtype=torch.float64) for x in ([1.0, -4.0], [3.0, 8.0]))
    torch.testing.assert_close(energy(u_r, u_a)[1:], energy(u_r[1:], u_a[1:]))
    weight = torch.randn(2, 16, 64, dtype=torch.complex128, generator=torch.Generator().manual_seed(1))
    given = (u_r.requires_grad_(), u_a.requires_grad_())
    assert torch.autograd.gradcheck(lambda *x: (energy(*x) * weight).real.sum((-2, -1)), given, eps=1e-4, atol=1e-6)


def test_movers_that_do_not_move_uniformly_in_the_slant_plane_are_refused() -> None:
    car = scene.GroundMovers([5.0], [0.0], [0.0], [3000.0], outward_m_s2=[1.0])
    with pytest.raises(ValueError, match="move uniformly in the slant plane"):
        simulate(small_radar(), scene.StripmapWorld(AT_REST, movers=car), 16, 64, Draws(1))


def test_a_config_has_movers_whose_speeds_may_vary(tmp_path: Path) -> None:
    sensor, world, stages, _ = CONFIGS["stripmap"]
    ship = {"u_r_m_s": [1.0], "u_a_m_s": [0.0], "azimuth_m": [0.0], "range_m": [0.0]}
    tree = {"title": "a ship", "radar": sensor, "world": {**world, "movers": ship}}
    tree["processor"] = {"recommended": {"stages": stages}}
    file = tmp_path / "ship.yaml"
    file.write_text(yaml.safe_dump(tree), encoding="utf-8")
    speed = torch.tensor([1.0, -3.0], dtype=torch.float64)
    chain = config_chain(file, vary=["world.movers.u_r_m_s.0"])
    trace = chain.trace(draws=Draws(1, trials=range(2)), given={"given.world.movers.u_r_m_s.0": speed})
    assert trace.truth is not None
    assert torch.equal(trace.truth.values["u_r_m_s"][:, 1], speed)


@pytest.mark.parametrize(
    "place, count", [((0.0, 0.0), 0), ((0.0, 5e3), 1), ((0.0, -5e2), 1), ((5e3, 0.0), 1), ((40.0, 0.0), 0)]
)
def test_targets_without_an_echo_are_counted(place: tuple[float, float], count: int) -> None:
    """Whole echoes end at the edges of the window, and a beam lights a target for a second."""
    radar = StripmapRadar(3.2e9, LinearFM(40e6, 0.5e-6), 50e6, 400.0, 120.0, 4000.0, pointing_doppler_hz=0.0)
    both = scene.Points([place[0], 1.0], [place[1], 2.0])
    _, truth = simulate(radar, scene.StripmapWorld(both, scene.Dwell(1.0)), 256, 256, Draws(1))
    assert int(truth.values["targets_outside"]) == count
    alone = scene.StripmapWorld(scene.Points([place[0]], [place[1]]), scene.Dwell(1.0))
    with pytest.warns(UserWarning, match="no target of the scene is recorded in 1 of 1") if count else nullcontext():
        recording, _ = simulate(radar, alone, 256, 256, Draws(1))
    assert bool((recording.signal.data != 0).any()) == (not count)


def test_a_squinted_beam_sees_a_fast_mover_at_its_own_speed() -> None:
    """It is closest twenty seconds after the record, where the speed decides its range."""
    radar = StripmapRadar(3.2e9, LinearFM(40e6, 0.5e-6), 50e6, 400.0, 120.0, 4000.0)
    fast = scene.MovingPoints([0.0], [60.0], [0.0], [200.0])
    world = scene.StripmapWorld(AT_REST, scene.Dwell(0.6), doppler_hz=768.5, movers=fast)
    recording, truth = simulate(radar, world, 256, 256, Draws(1))
    assert bool((recording.signal.data != 0).any()) and int(truth.values["targets_outside"]) == 0
