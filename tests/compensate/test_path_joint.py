"""Joint estimate of a scene and of motions in three axes: dense solutions, convergence, fringes."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from torchsar.compensate.path import joint
from torchsar.compensate.path.ground import FINE_STEP, ground_image, line_free
from torchsar.compensate.path.joint import Motion, scene_of, three_axes
from torchsar.core import Draws
from torchsar.echo import simulate_path
from torchsar.metrics import error_db, phase_rmse
from torchsar.radar import AntennaPath, InverseRadar
from torchsar.scene import Flight, PathWorld, Points, RandomPoints, StraightPath
from torchsar.scene import Scene as Scatterers

F64 = torch.float64
RADAR = InverseRadar(9.6e9, 300e6, 32.0)
PULSES = CELLS = 32
FLIGHT = Flight(StraightPath((-700.0, -20.0, 700.0), (0.0, 40.0, 0.0)))
RADIANS = 4 * math.pi / RADAR.wavelength_m


def seen(scatterers: Scatterers, snr_db: float | None = 20.0) -> tuple[Tensor, Tensor, AntennaPath]:
    """Range profiles (pulse, range), frequencies, and the true path."""
    recording, _ = simulate_path(RADAR, PathWorld(scatterers, FLIGHT, snr_db=snr_db), PULSES, CELLS, Draws(2))
    aux = recording.aux
    path = AntennaPath(aux["transmitter_m"], None, aux["path_reference_m"])
    return recording.signal.data.reshape(PULSES, CELLS).to(torch.complex128), aux["frequency_hz"], path


def recorded(path: AntennaPath, error_m: Tensor) -> AntennaPath:
    return AntennaPath(path.transmitter_m + error_m, None, path.reference_m)


def normal(*size: int, seed: int = 1) -> Tensor:
    return torch.randn(*size, dtype=torch.complex128, generator=torch.Generator().manual_seed(seed))


def motion_of(noise: float = 0.3) -> Motion:
    found = 0.1 * normal(PULSES, seed=2).real
    return Motion(normal(PULSES, 5, 3), found, torch.tensor(noise, dtype=F64))


def dense(motion: Motion) -> tuple[Tensor, Tensor]:
    """Real matrix from all motions (pulse * axis) to the samples, and the inverse prior."""
    pulses, cells, _ = motion.unit.shape
    whole = torch.zeros(pulses, cells, pulses, 3, dtype=torch.complex128)
    whole[torch.arange(pulses), :, torch.arange(pulses)] = motion.unit
    whole = whole.reshape(pulses * cells, -1)
    basis, ridge = motion.basis, motion.ridge
    inverse = torch.zeros(pulses, 3, pulses, 3, dtype=F64)
    for axis, part in zip((1, 2), ridge.chunk(2), strict=True):
        inverse[:, axis, :, axis] = basis @ (part[:, None] * basis.mT)
        # what the basis does not hold, constant and line, stays at zero
        inverse[:, axis, :, axis] += 1e9 * (torch.eye(pulses, dtype=F64) - basis @ basis.mT)
    return torch.cat([whole.real, whole.imag]), inverse.reshape(pulses * 3, -1)


def test_motions_are_those_of_dense_least_squares() -> None:
    motion, rows = motion_of(), normal(PULSES, 5, seed=3)
    matrix, inverse = dense(motion)
    y = torch.cat([rows.real.flatten(), rows.imag.flatten()])
    wanted = torch.linalg.solve(matrix.mT @ matrix + inverse, matrix.mT @ y)
    torch.testing.assert_close(motion.of(rows).flatten(), wanted, rtol=1e-5, atol=1e-7)
    covariance = torch.linalg.inv(matrix.mT @ matrix + inverse) * float(motion.noise) / 2
    expected = covariance.diagonal().reshape(PULSES, 3)[:, 0].sqrt()
    torch.testing.assert_close(motion.std_m(), expected, rtol=1e-5, atol=1e-9)


def test_what_motions_explain_is_removed_by_a_symmetric_positive_map() -> None:
    motion = motion_of()
    x, y = normal(PULSES, 5, seed=4), normal(PULSES, 5, seed=5)

    def inner(a: Tensor, b: Tensor) -> float:
        return float((a.conj() * b).sum().real)

    assert inner(motion.without(x), y) == pytest.approx(inner(x, motion.without(y)), rel=1e-9)
    assert 0 < inner(motion.without(x), x) < inner(x, x)
    step = torch.zeros(PULSES, 3, dtype=F64)
    step[:, 0] = 1.0  # free along the line of sight
    assert motion.without(motion.echo(step)).abs().max() < 1e-9


def test_the_joint_scene_solves_the_dense_equations() -> None:
    rows, frequency, path = seen(RandomPoints(3, 4.0, 4.0))
    operator = ground_image(frequency, path, 0.0, 5.0, FINE_STEP)
    scene = scene_of(rows, operator, ends=(400, 1e-26))
    motion = Motion(normal(PULSES, CELLS, 3), torch.rand(PULSES, dtype=F64), scene.noise)
    cells, left = scene.fitted(motion.without)
    pull = scene.size * operator.image((left - motion.echo(motion.of(left)))[None])[0]
    torch.testing.assert_close(scene.size * pull, scene.noise * cells, rtol=1e-6, atol=1e-9 * float(pull.abs().max()))
    torch.testing.assert_close(left, rows - operator.adjoint(cells[None])[0])


@pytest.mark.parametrize("snr_db", [20.0, 0.0])
def test_the_noise_of_samples_is_found_within_a_factor(snr_db: float) -> None:
    world = PathWorld(RandomPoints(6, 16.0, 12.0), FLIGHT, snr_db=snr_db)
    recording, truth = simulate_path(RADAR, world, PULSES, CELLS, Draws(4))
    path = AntennaPath(recording.aux["transmitter_m"], None, recording.aux["path_reference_m"])
    rows = recording.signal.data.reshape(PULSES, CELLS)
    operator = ground_image(recording.aux["frequency_hz"], path, 0.0, None, FINE_STEP)
    scene = scene_of(rows, operator)
    scene = scene.narrowed(scene.fitted()[0])
    scene = scene_of(rows, operator, scene.noise_of(scene.fitted()[1]))
    scene = scene.narrowed(scene.fitted()[0])
    noise = scene.noise_of(scene.fitted()[1])
    assert 0.6 < float(noise) / float(truth.values["noise_std"].square()) < 1.8


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_samples_change_with_a_motion_as_their_derivative_says(axis: int) -> None:
    """Also across the line of sight, where the change depends on the place in the scene."""
    rows, frequency, path = seen(RandomPoints(20, 18.0, 14.0), None)
    operator = ground_image(frequency, path, 0.0, None, FINE_STEP)
    scene = operator.image(rows[None])[0]
    scene = scene * (scene.abs() > 0.3 * scene.abs().max())
    axes = joint._axes(path, 0.0)
    unit, _ = joint._units(operator, scene, axes)
    step = 2e-4 * torch.cos(torch.arange(PULSES, dtype=F64))
    echo = [joint._along(operator, sign * step[:, None] * axes[:, axis]).adjoint(scene[None])[0] for sign in (1, -1)]
    # recorded minus true: the true path lies at the recorded one less the error
    change = (echo[0] - echo[1]) / (2 * step[:, None])
    assert error_db(unit[..., axis], change) < -33


def test_errors_across_the_line_of_sight_are_found_in_two_rounds() -> None:
    rows, frequency, path = seen(RandomPoints(20, 18.0, 14.0), 30.0)
    time = torch.linspace(-1, 1, PULSES, dtype=F64)
    error = torch.stack([torch.cos(4 * time + 2 * axis) + torch.sin(7 * time - axis) for axis in range(3)], -1)
    present = torch.ones(PULSES, dtype=torch.bool)
    error = 0.2 * torch.stack([line_free(part, present) for part in error.mT], -1)
    flown = recorded(path, error)
    sight = path.transmitter_m / torch.linalg.vector_norm(path.transmitter_m, dim=-1, keepdim=True)
    level = torch.linalg.cross(torch.tensor([[0.0, 0.0, 1.0]], dtype=F64).expand(PULSES, 3), sight, dim=-1)
    level = level / torch.linalg.vector_norm(level, dim=-1, keepdim=True)
    fine = ground_image(frequency, flown, 0.0, None, FINE_STEP)
    start = line_free((error * sight).sum(-1), present)
    found = three_axes(rows, fine, start, present, 2)
    true, left = ((x * level).sum(-1) for x in (error, error - found.offset_m))
    assert line_free(left, present).square().mean() < 0.1 * line_free(true, present).square().mean()
    assert phase_rmse(found.motion_m[:, 0] * RADIANS, start * RADIANS) < 0.1


@pytest.mark.parametrize("fringes", [1, -2])
def test_whole_fringes_of_a_pulse_are_found_by_its_envelope(fringes: int) -> None:
    rows, frequency, path = seen(Points([3.0, -4.0, 0.0], [-2.0, 4.0, 1.0], random_phase=True), 30.0)
    present = torch.ones(PULSES, dtype=torch.bool)
    fine = ground_image(frequency, path, 0.0, None, FINE_STEP)
    error = torch.zeros(PULSES, dtype=F64)
    error[PULSES // 3] = fringes * RADAR.wavelength_m / 2
    found = three_axes(rows, fine, error, present).motion_m[:, 0]
    assert found.abs().max() < 0.02 * RADAR.wavelength_m


def test_errors_across_are_not_taken_for_fringes() -> None:
    rows, frequency, path = seen(RandomPoints(20, 18.0, 14.0), 30.0)
    time = torch.linspace(-1, 1, PULSES, dtype=F64)
    present = torch.ones(PULSES, dtype=torch.bool)
    error = torch.stack([torch.cos(5 * time + axis) + torch.sin(8 * time - 2 * axis) for axis in range(3)], -1)
    error = 0.2 * torch.stack([line_free(part, present) for part in error.mT], -1)
    sight = path.transmitter_m / torch.linalg.vector_norm(path.transmitter_m, dim=-1, keepdim=True)
    start = line_free((error * sight).sum(-1), present)
    fine = ground_image(frequency, recorded(path, error), 0.0, None, FINE_STEP)
    found = three_axes(rows, fine, start, present).motion_m[:, 0]
    assert (found - start).abs().max() < RADAR.wavelength_m / 4


def test_rounds_end_when_nothing_but_an_unobservable_line_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    rows, frequency, path = seen(RandomPoints(12, 16.0, 12.0), 30.0)
    error = torch.zeros(PULSES, 3, dtype=F64)
    error[:, 0] = 1e-4 * torch.linspace(-1, 1, PULSES, dtype=F64)  # a scatterer may shift within its cell
    rounds = []
    monkeypatch.setattr(joint, "scene_of", lambda *known: rounds.append(1) or scene_of(*known))
    operator = ground_image(frequency, recorded(path, error), 0.0, None, FINE_STEP)
    three_axes(rows, operator, torch.zeros(PULSES, dtype=F64), torch.ones(PULSES, dtype=torch.bool))
    assert len(rounds) <= 4, rounds  # of six
