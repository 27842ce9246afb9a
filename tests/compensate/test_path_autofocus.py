"""Autofocus through images along any path: adjoint, phases, noise, paths of single trials."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from torchsar.compensate import CorrectPath, PathAutofocus, PathPhase, path_autofocus, path_phase
from torchsar.compensate.path import assess
from torchsar.compensate.path.fringes import drift_m, moved, rough_near, roughness, smooth_near, smoothest
from torchsar.compensate.path.ground import ground_image
from torchsar.compensate.path.joint import Found
from torchsar.compensate.path.search import Starts
from torchsar.core import Draws, Estimate, Outcome, Recording, unit_phasor
from torchsar.echo import simulate_path
from torchsar.focus import ImageGrid, TileImage, TilePlan
from torchsar.focus.tile_operator import TileOperator
from torchsar.metrics import phase_rmse, registered_error_db
from torchsar.radar import AntennaPath, InverseRadar, range_profiles
from torchsar.scene import Flight, Navigation, PathWorld, RandomPoints, RandomWalk, Sinusoid, StraightPath, Sway

F64 = torch.float64
RADAR = InverseRadar(9.6e9, 300e6, 64.0)
PULSES, CELLS = 64, 64
FLIGHT = Flight(StraightPath((-700.0, -20.0, 700.0), (0.0, 40.0, 0.0)), Sway(x=[Sinusoid(0.2, 1.5)]))
QUICK = {"search": 30, "polish": 4}


def recorded(trials: int, seed: int = 1, snr_db: float = 10.0) -> Recording:
    """Points that migrate through four range cells."""
    world = PathWorld(RandomPoints(20, 20.0, 16.0), FLIGHT, snr_db=snr_db)
    return simulate_path(RADAR, world, PULSES, CELLS, Draws(seed, trials=range(trials)))[0]


def path_of(recording: Recording) -> AntennaPath:
    return AntennaPath(recording.aux["transmitter_m"], None, recording.aux["path_reference_m"])


def white(trials: int, seed: int = 5) -> torch.Tensor:
    return 2 * math.pi * torch.rand(trials, PULSES, dtype=F64, generator=torch.Generator().manual_seed(seed))


def turned(data: torch.Tensor, phase: torch.Tensor) -> torch.Tensor:
    return data * unit_phasor(phase / (2 * math.pi), data.dtype)[..., None]


@pytest.mark.slow
def test_cars_in_motions_of_their_own_are_named() -> None:
    """An exact path and 60 points; with three cars, three of the points move and are brighter."""
    time = torch.linspace(-1, 1, 200, dtype=F64)
    sway = [-2000 + 0.4 * torch.sin(7 * time) + 0.3 * torch.cos(13 * time), 1200 + 0.5 * torch.sin(5 * time + 1)]
    place = torch.stack([45 * time, *sway], -1)
    frequency = 9.4e9 + 4e6 * (torch.arange(64, dtype=F64) - 32)
    antennas = AntennaPath(place, None, 2 * torch.linalg.vector_norm(place, dim=-1))
    draws = Draws(1)
    points = torch.cat([draws.uniform("place", (60, 2), -12, 12), torch.zeros(60, 1, dtype=F64)], -1)
    amplitude = draws.normal("amplitude", (60,), torch.complex128)
    noise = draws.normal("noise", (200, 64), torch.complex128)
    for times in (0.0, 12.0):
        speed, weight = torch.zeros(60, 3, dtype=F64), amplitude.clone()
        if times:
            speed[:3] = torch.tensor([[3.0, 0.7, 0.0], [-2.0, 0.2, 0.0], [3.0, 0.7, 0.0]]).to(F64)
            weight[:3] *= times
        at = points + 1.5 * time[:, None, None] * speed
        path = 2 * torch.linalg.vector_norm(place[:, None] - at, dim=-1) - antennas.reference_m[:, None]
        turns = -path[..., None] * frequency / 299792458.0
        history = (weight[:, None] * unit_phasor(turns, torch.complex128)).sum(1)
        data = history + history.abs().square().mean().sqrt() * noise
        found = path_autofocus(range_profiles(data).to(torch.complex64), frequency, antennas)
        assert bool(found.ok) == (not times)
        assert not times or int(found.outcome) == Outcome.PARTS_DISAGREE


def test_the_operator_has_its_adjoint() -> None:
    recording = recorded(1)
    frequency, antennas = recording.aux["frequency_hz"], path_of(recording)
    grid = ImageGrid(torch.tensor([-8.0, -8.0, 0.0]), torch.eye(3)[:2], (21, 17), 0.8)
    plan = TilePlan(frequency, antennas.transmitter_m, None, antennas.reference_m, grid, -60.0)
    operator = TileOperator(plan)
    made = torch.Generator().manual_seed(1)
    x = torch.randn(2, PULSES, CELLS, dtype=torch.complex128, generator=made)
    y = torch.randn(2, 21, 17, dtype=torch.complex128, generator=made)
    left, right = (operator.image(x) * y.conj()).sum(), (x * operator.adjoint(y).conj()).sum()
    assert abs(left - right) < 1e-10 * abs(left)
    moved = antennas.transmitter_m + torch.zeros(2, 1, 1, dtype=F64)
    with pytest.raises(ValueError, match=r"path that all trials share, got one for each of \(2,\)"):
        TileOperator(TilePlan(frequency, moved, None, antennas.reference_m, grid, -60.0))


def test_white_phases_of_migrating_scatterers_are_found_and_noise_is_not() -> None:
    recording, phase = recorded(2), white(2)
    frequency, antennas = recording.aux["frequency_hz"], path_of(recording)
    noise = torch.randn(1, PULSES, CELLS, dtype=torch.complex64, generator=torch.Generator().manual_seed(2))
    data = torch.cat([turned(recording.signal.data, phase), noise])
    found = path_phase(data, frequency, antennas, **QUICK)
    error = phase_rmse(found["phase_rad"][:2], phase)
    assert found.ok.tolist() == [True, True, False] and bool((error < 0.2).all())
    std = found.std["phase_rad"][:2].square().mean(-1).sqrt()
    assert bool((error < 2.5 * std).all()), (error, std)


def test_migration_does_not_widen_the_deviation() -> None:
    recording, phase = recorded(3, snr_db=30.0), white(3)
    data = turned(recording.signal.data, phase)
    found = path_phase(data, recording.aux["frequency_hz"], path_of(recording), **QUICK)
    error, std = phase_rmse(found["phase_rad"], phase), found.std["phase_rad"][:, 0]
    assert bool((error > std / 2).all()) and bool((error < 2 * std).all()), (error, std)


def test_trials_with_paths_of_their_own_equal_singles() -> None:
    recording, phase = recorded(2, seed=3), white(2, 7)
    frequency = recording.aux["frequency_hz"]
    place = recording.aux["transmitter_m"] + torch.tensor([0.0, 0.05], dtype=F64)[:, None, None]
    signal = recording.signal.with_data(turned(recording.signal.data, phase))
    known = {"frequency_hz": frequency, "path_reference_m": recording.aux["path_reference_m"]}
    stage = PathPhase(search=4, polish=1)
    both = stage(signal, transmitter_m=place, **known)
    one = stage(signal.with_data(signal.data[1]), transmitter_m=place[1], **known)
    assert both["phase_rad"].shape == (2, PULSES) and both.ok.shape == (2,)
    torch.testing.assert_close(both["phase_rad"][1], one["phase_rad"])


def test_paths_without_a_turn_and_other_sizes_are_refused() -> None:
    recording = recorded(1)
    frequency, antennas = recording.aux["frequency_hz"], path_of(recording)
    still = AntennaPath(antennas.transmitter_m[:1].expand(PULSES, 3), None, antennas.reference_m)
    with pytest.raises(ValueError, match="a line of sight that turns"):
        path_phase(recording.signal.data, frequency, still)
    with pytest.raises(ValueError, match=r"profiles \(..., pulse, range\) of \(64, 64\), got \(1, 63, 64\)"):
        path_phase(recording.signal.data[:, 1:], frequency, antennas)


def with_navigation(
    trials: range, error_m: float, snr_db: float = 10.0, seed: int = 5
) -> tuple[Recording, Recording, torch.Tensor]:
    """Recordings along a path that errs by random walks and along the true one, and the errors."""
    walk = [RandomWalk(error_m * math.sqrt(6), 1 / PULSES)]
    world = PathWorld(RandomPoints(20, 20.0, 16.0), FLIGHT, None, Navigation(Sway(walk, walk, walk)), snr_db=snr_db)
    recording, truth = simulate_path(RADAR, world, PULSES, CELLS, Draws(seed, trials=trials), dtype=torch.complex64)
    assert truth.clean is not None
    return recording, truth.clean, truth.values["line_of_sight_m"]


def test_paths_that_err_by_a_wavelength_give_the_image_of_the_true_path() -> None:
    recording, clean, true_m = with_navigation(range(1), 0.03)
    recording = replace(recording, signal=recording.signal.with_data(recording.signal.data.clone()))
    present = torch.arange(PULSES) != 20
    recording.signal.data[:, ~present] = 0
    known = {name: recording.aux[name] for name in ("frequency_hz", "transmitter_m", "path_reference_m")}
    found = PathAutofocus(rounds=2)(recording.signal, **known)
    radians = 4 * math.pi / RADAR.wavelength_m
    error = phase_rmse(radians * found["line_of_sight_m"], radians * true_m, present[None])
    assert found.ok.all() and bool((error < 0.15).all()), error
    assert found["offset_m"].shape == (1, PULSES, 3)
    image = TileImage(20.0, 20.0, 0.25, window="hann")
    moved = CorrectPath()(recording.signal, found["offset_m"], known["transmitter_m"])["transmitter_m"]
    images = [
        image(signal, **{**known, "transmitter_m": place}).data
        for signal, place in (
            (clean.signal.with_data(clean.signal.data * present[:, None]), clean.aux["transmitter_m"]),
            (recording.signal, moved),
            (recording.signal, known["transmitter_m"]),
        )
    ]
    after, before = (registered_error_db(x, images[0].expand_as(x)) for x in images[1:])
    assert bool((after < -10).all()) and bool((before > -3).all()), (before, after)


@pytest.mark.slow
def test_a_start_that_ends_in_a_wrong_minimum_does_no_harm() -> None:
    """With envelopes in motion this trial ends 2.3 mm off; the sharpest image counts."""
    recording, _, true_m = with_navigation(range(2, 3), 0.05, 20.0, seed=1000)
    found = path_autofocus(recording.signal.data, recording.aux["frequency_hz"], path_of(recording))
    radians = 4 * math.pi / RADAR.wavelength_m
    error = float(phase_rmse(radians * found["line_of_sight_m"], radians * true_m))
    std = radians * float(found.std["line_of_sight_m"].square().mean().sqrt())
    assert error < 0.1 and error < 2 * std, (error, std)


@pytest.mark.slow
def test_a_wrong_minimum_that_all_starts_have_in_common_is_not_ok() -> None:
    """Parts of this path end at ramps of phase of their own, 2.9 mm off, from every start."""
    recording, _, true_m = with_navigation(range(3, 4), 0.01, 20.0, seed=1025)
    found = path_autofocus(recording.signal.data, recording.aux["frequency_hz"], path_of(recording))
    radians = 4 * math.pi / RADAR.wavelength_m
    right = float(phase_rmse(radians * found["line_of_sight_m"], radians * true_m)) < 0.47
    assert right or not bool(found.ok)


@pytest.mark.slow
def test_noise_and_too_few_pulses_are_not_ok() -> None:
    recording = recorded(1)
    frequency, some = recording.aux["frequency_hz"], slice(0, 24)
    whole = path_of(recording)
    antennas = AntennaPath(whole.transmitter_m[..., some, :], None, whole.reference_m[..., some])
    noise = torch.randn(2, 24, CELLS, dtype=torch.complex64, generator=torch.Generator().manual_seed(2))
    noise[1, 5:] = 0
    found = path_autofocus(noise, frequency, antennas, rounds=1)
    assert found.outcome.tolist() == [Outcome.NOISE, Outcome.TOO_FEW]
    alone = path_autofocus(noise, frequency, antennas, rounds=1, assess=False)
    assert bool((alone.outcome == Outcome.NOT_ASSESSED).all()) and not alone.std
    assert torch.equal(alone["offset_m"], found["offset_m"])
    assert all(bool(torch.isfinite(x).all()) for x in (*found.value.values(), *found.std.values(), found.quality))
    with pytest.raises(ValueError, match="extent_m must be positive and finite, got -1"):
        path_autofocus(noise, frequency, antennas, extent_m=-1.0)
    with pytest.raises(ValueError, match="at least one, got rounds=0"):
        path_autofocus(noise, frequency, antennas, rounds=0)


def test_fringes_of_a_smooth_line_of_sight_are_found() -> None:
    fringe, time = 0.0156, torch.arange(200, dtype=F64)
    true = torch.stack([0.2 * torch.sin(0.05 * time), 0.1 * torch.cos(0.08 * time)])
    made = torch.Generator().manual_seed(3)
    carrier = (
        true
        + 4e-4 * torch.randn(2, 200, dtype=F64, generator=made)
        + fringe * torch.randint(-9, 9, (2, 200), generator=made)
    )
    rough = roughness(carrier, fringe)
    assert bool((rough < 0.5).all()) and bool((roughness(100 * carrier, fringe) > 0.8).all())
    near = true + fringe * torch.randn(2, 200, dtype=F64, generator=made)
    bend_std = rough * fringe / math.sqrt(12)
    found = smooth_near(carrier, near, 0.9 * true, fringe, 2 * fringe, bend_std)
    assert float((found - true).abs().max()) < fringe / 4
    near[:, [1, 10, 11, 150]] += torch.tensor([[0.8, -0.5, 0.9, -0.6]], dtype=F64)  # envelopes of other scatterers
    found = smooth_near(carrier, near, 0.9 * true, fringe, 2 * fringe, bend_std)
    assert float((found - true).abs().max()) < fringe / 4
    walk = (0.3 * fringe * torch.randn(2, 200, dtype=F64, generator=made)).cumsum(-1)
    near = walk + fringe * torch.round(0.6 * torch.randn(2, 200, dtype=F64, generator=made))
    torch.testing.assert_close(rough_near(walk, near, 0 * walk, fringe), near)
    curved = walk + 50 * fringe * torch.linspace(-1, 1, 200, dtype=F64) ** 2
    torch.testing.assert_close(rough_near(curved, curved, curved - walk, fringe), curved)
    wrong = near.clone()
    wrong[:, [0, 1, 2, 5, 100, 197, 199]] += 0.4
    assert float((rough_near(walk, wrong, 0 * walk, fringe) - walk).abs().max()) < 8 * fringe
    line = (smoothest(carrier, fringe) - true).diff(n=2, dim=-1)
    assert float(line.abs().max()) < fringe / 2


def test_an_envelope_that_drifts_against_the_phases_is_found() -> None:
    recording = recorded(1)
    frequency = recording.aux["frequency_hz"]
    imaging = ground_image(frequency, path_of(recording), 0.0)
    drift = 0.3 * torch.linspace(-1, 1, PULSES, dtype=F64)
    fringe = RADAR.wavelength_m / 2
    rows = recording.signal.data[0].to(torch.complex64)
    late = moved(rows, frequency, -drift)
    back = unit_phasor(-drift[:, None] * 2 * frequency.mean() / 299792458.0, late.dtype)  # keeps the carrier
    found = drift_m(late * back, frequency, imaging, slopes=True)
    assert float((found - drift).square().mean().sqrt()) < fringe


def test_a_start_that_explains_the_samples_worse_widens_the_doubt_and_not_the_deviation() -> None:
    present = torch.ones(PULSES, dtype=torch.bool)
    search: Any = SimpleNamespace(fringe_m=0.0156, present=present, rows=torch.ones(PULSES, CELLS))

    def found(noise: float, error_m: float, sharp: float) -> Found:
        line = error_m * torch.randn(PULSES, dtype=F64, generator=torch.Generator().manual_seed(3))
        image = torch.zeros(8, 8, dtype=torch.complex64)
        image[0, 0], image[1, 1] = 1.0, sharp
        value = torch.tensor(noise, dtype=F64)
        motion = torch.nn.functional.pad(line[:, None], (0, 2))
        return Found(motion, motion, torch.full_like(line, 3e-5), image, value, value * 0)

    best, near, far, lost = found(1, 0, 0.1), found(1.02, 2e-5, 0.2), found(1.3, 3e-4, 0.3), found(10, 3e-4, 0.4)
    cases = (([far, near], 3.3e-5, 3.3e-5), ([near], 3.3e-5, 3.3e-5), ([far], 1.7e-4, 2e-4), ([far, lost], 4e-5, 2e-4))
    for others, std_m, doubt_m in cases:
        starts = Starts.of([*others, best], search, best.noise)
        assert starts.best is best
        known = Estimate({"line_of_sight_m": best.motion_m[:, 0]}, quality=best.noise)
        judged = assess.of_path(known, starts, search)
        doubt = (best.std_m.square().mean() + starts.square_m2.amin() / 2).sqrt()
        assert float(judged.std["line_of_sight_m"].square().mean().sqrt()) == pytest.approx(std_m, rel=0.2)
        assert float(doubt) == pytest.approx(doubt_m, rel=0.2)
