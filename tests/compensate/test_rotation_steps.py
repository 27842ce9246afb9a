"""The mathematics of the estimators of non-uniform rotation, against autograd and plain sums."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.compensate.turning import (
    CELL,
    F64,
    OMEGA,
    PRF,
    PULSES,
    RANGE_M,
    WAVELENGTH,
    K,
    echo,
    noise,
    points,
    response,
    target,
)
from torchsar.compensate.rotation.couplings import Neighbours, inner_products
from torchsar.compensate.rotation.histories import (
    find_peaks,
    histories_of,
    inverted,
    noise_power,
    refined_by_histories,
    threshold,
)
from torchsar.compensate.rotation.motion import Motion, Sampling, image_of, warped_time, without_range_term
from torchsar.compensate.rotation.scatterers import Fit, Scatterers, Step, _solver, solved
from torchsar.radar.warp import warp
from torchsar.study.bench.direct.turntable import Turntable

SAMPLING = Sampling(WAVELENGTH, PRF, PULSES, len(RANGE_M), float(RANGE_M[0]), CELL)
TIME = torch.arange(PULSES, dtype=F64) / PRF


def of_unknown_rate(k: Tensor) -> Motion:
    zero = k.new_zeros(len(k))
    return Motion(k, zero, zero, zero)


def truth(k: Tensor = K, centre_m: float = 0.0) -> Motion:
    one = torch.ones(1, dtype=F64)
    return Motion(k[None], OMEGA**2 * one, 0 * one, centre_m * one)


@pytest.mark.parametrize("order", [1, 2, 3, 4])
def test_slopes_of_the_normalised_warp(order: int) -> None:
    k = torch.tensor([[10.0, 1000.0, 2e5], [-5.0, 3000.0, 0.0]], dtype=F64)[:, : order - 1]
    phi, u, found = warped_time(k, TIME, SAMPLING.duration_s)
    whole = torch.tensor([SAMPLING.duration_s], dtype=F64)
    torch.testing.assert_close(phi, warp(TIME, k))
    torch.testing.assert_close(u, warp(TIME, k) / warp(whole, k))
    assert found.shape == (2, order - 1, PULSES)
    for i in range(2 if order > 1 else 0):
        slopes = torch.autograd.functional.jacobian(lambda k: warp(TIME, k) / warp(whole, k), k[i])
        torch.testing.assert_close(found[i], slopes.mT, rtol=1e-9, atol=1e-15)


def test_the_range_term_is_removed() -> None:
    data, motion = target(0), Motion(K[None], *torch.tensor([[4e-4], [2e-4], [1.5]], dtype=F64))
    phi = warp(TIME, K)
    lever = RANGE_M + 1.5 + 0.5  # v = w / 2
    expected = data * torch.exp(-2j * math.pi / WAVELENGTH * lever * 4e-4 * phi[:, None].square())
    torch.testing.assert_close(
        without_range_term(data[None], SAMPLING, motion, phi[None])[0], expected, rtol=1e-9, atol=1e-9
    )
    torch.testing.assert_close(motion.yc_m, torch.tensor([2.0], dtype=F64))
    unknown = Motion(K[None], *torch.tensor([[-1e-9], [2e-4], [1.5]], dtype=F64))
    assert unknown.yc_m == 1.5 and unknown.omega_rad_s == 0


def test_the_image_focuses_every_scatterer() -> None:
    x, _, amplitude = points(0, 5)
    y = RANGE_M[[2, 6, 11, 15, 20]]
    image = image_of(echo(x, y, amplitude)[None], SAMPLING, truth())[0]
    cells = 2 * x * OMEGA * float(warp(torch.tensor([SAMPLING.duration_s], dtype=F64), K)) / WAVELENGTH
    for cell, column, level in zip(cells.tolist(), (2, 6, 11, 15, 20), amplitude.abs().tolist()):
        peak = image[:, column].abs().argmax()
        assert abs(float(peak - PULSES) / 2 - cell) <= 0.3
        assert abs(float(image[peak, column].abs()) / (level * math.sqrt(PULSES)) - 1) < 0.11


def test_noise_power_and_threshold() -> None:
    power = torch.stack([noise(seed, 500, 40).abs().square() for seed in range(20)])
    found = noise_power(3.0 * power)
    torch.testing.assert_close(found, torch.full((20,), 3.0, dtype=F64), rtol=0.05, atol=0)
    above = (power > threshold(power[0].numel())).flatten(1).any(1).sum()
    assert above <= 6, "noise exceeds the threshold once in about ten images"
    power[0, :50] += 1e6
    assert abs(float(noise_power(3.0 * power)[0]) / 3 - 1) < 0.25, (
        "a tenth of the image full of scatterers moves the median a little"
    )


def test_peaks_against_a_plain_search() -> None:
    power = torch.stack([noise(seed, 60, 12).abs().square() for seed in range(3)])
    floor = torch.tensor([1.0, 2.0, 1e9], dtype=F64)
    found, line, cell = find_peaks(power, floor, 400, 0.5, 3, 1)
    for trial in range(3):
        plain = plain_peaks(power[trial], float(floor[trial]), 0.25, 3, 1)
        live = found[trial] > 0
        assert sorted(zip(line[trial, live].tolist(), cell[trial, live].tolist())) == plain
        assert (found[trial].diff() <= 0).all()


def plain_peaks(power: Tensor, floor: float, share: float, lines: int, cells: int) -> list[tuple[int, int]]:
    found = []
    for i in range(power.shape[0]):
        for j in range(power.shape[1]):
            level = power[i, j]
            cross = [
                power[a, b]
                for a, b in ((i - 1, j), (i + 1, j), (i, j - 1), (i, j + 1))
                if 0 <= a < power.shape[0] and 0 <= b < power.shape[1]
            ]
            around = power[max(0, i - lines) : i + lines + 1, max(0, j - cells) : j + cells + 1].max()
            if level > floor and all(level > other for other in cross) and level >= share * around:
                found.append((i, j))
    return found


@pytest.mark.parametrize("error", [(1.0, -60.0), (-2.0, 60.0)])
def test_phase_histories_correct_an_error_of_the_motion(error: tuple[float, float]) -> None:
    """One step removes most of the error of a coarse warp, and finds an unknown rate."""
    data, motion = target(0)[None], of_unknown_rate((K + torch.tensor(error, dtype=F64))[None])
    offset = (motion.k[0] - K).abs()
    once = refined_by_histories(data, SAMPLING, motion)
    assert histories_of(data, SAMPLING, motion).used.sum() > 5 and abs(float(once.omega_rad_s) / OMEGA - 1) < 0.25
    twice = refined_by_histories(data, SAMPLING, once)
    thrice = refined_by_histories(data, SAMPLING, twice)
    assert ((once.k[0] - K).abs() < 0.5 * offset).all() and ((thrice.k[0] - K).abs() < 0.3 * offset).all()


def test_scatterers_beyond_the_pulse_rate_are_left_out() -> None:
    """The pulses are too sparse at the end, where the target turns faster.

    Its edges return, blurred, at the other end of the band, and were taken for scatterers of other
    phase histories.
    """
    table = Turntable(PRF, PULSES, 24, CELL, 40, 0.45)
    data, _ = table.noisy(table.echo(*table.satellite(0)), 20.0, 0)
    found = histories_of(data[None], SAMPLING, truth())
    turns = 2 * OMEGA * 0.45 / WAVELENGTH * warp(torch.tensor([SAMPLING.duration_s], dtype=F64), K)
    assert found.used.sum() > 10 and abs(found.cells[found.used].abs().max() - turns) < 2


def test_incoherent_pulses_have_no_scatterers_in_a_rotation_that_nearly_stops() -> None:
    """Most of the band is then beyond the pulse rate, and is no measure of the level of a cell."""
    flicker = noise(0, 8, PULSES, 1) / noise(0, 8, PULSES, 1).abs() * torch.linspace(1, 4, 24, dtype=F64)
    end = SAMPLING.duration_s
    stops = truth(torch.tensor([-2.8 / end, 7.2 / end**2], dtype=F64))
    motion = Motion(*(v.expand(8, *v.shape[1:]) for v in (stops.k, stops.w, stops.v, stops.centre_m)))
    assert (histories_of(flicker, SAMPLING, motion).used.sum(-1) == 0).sum() >= 6


def test_an_undersampled_range_term_is_impossible() -> None:
    still, wild, broken = of_unknown_rate(K[None]), truth(), truth()
    assert still.possible(SAMPLING) and truth().possible(SAMPLING) and truth(centre_m=-50.0).possible(SAMPLING)
    for motion in (
        Motion(wild.k, 1e3 * wild.w, wild.v, wild.centre_m),
        Motion(wild.k, wild.w, wild.v - 5.0, wild.centre_m),
        Motion(broken.k * math.nan, broken.w, broken.v, broken.centre_m),
    ):
        assert not motion.possible(SAMPLING)


def test_histories_of_empty_data_leave_the_motion_unchanged() -> None:
    start = of_unknown_rate(K[None].expand(2, -1))
    for data in (torch.zeros(2, PULSES, 24, dtype=torch.complex128), 0 * noise(0, 2, PULSES, 24)):
        motion = refined_by_histories(data, SAMPLING, start)
        assert torch.equal(motion.k, start.k) and motion.w.tolist() == [0, 0]


def test_small_normal_equations_of_any_scale_are_solved() -> None:
    rows = torch.randn(3, 10, 4, dtype=F64, generator=torch.Generator().manual_seed(0)) * torch.tensor(
        [1e-9, 1.0, 1e6, 1e3], dtype=F64
    )
    answer = torch.tensor([1e9, 2.0, 3e-6, 0.0], dtype=F64)
    rows[:, :, 3] = 0
    torch.testing.assert_close(
        (inverted(rows.mT @ rows)[0] @ rows.mT @ (rows @ answer)[..., None])[..., 0],
        answer.expand(3, -1),
        rtol=1e-6,
        atol=1e-9,
    )


CELLS, SHORT = 16, 96
SMALL = Sampling(WAVELENGTH, SHORT / SAMPLING.duration_s, SHORT, CELLS, -3.0, 0.4)
FEW = 6


def few() -> tuple[Scatterers, Motion]:
    """Six overlapping scatterers, with Doppler cells on the steps of the table of couplings."""
    source = torch.Generator().manual_seed(3)
    level, phase, cell, row = (torch.rand(1, FEW, dtype=F64, generator=source) for _ in range(4))
    # a small range term, since couplings neglect that it differs between range cells
    motion = Motion(K[None], *torch.tensor([[1e-7], [1e-4], [0.7]], dtype=F64))
    return Scatterers(torch.polar(0.5 + level, 6 * phase), (6 * 16 * (cell - 0.5)).round() / 16, 5 + 4 * row), motion


def model(unknown: Tensor, found: Scatterers, motion: Motion) -> Tensor:
    """Data of scatterers and a motion that are changed by `unknown`.

    Its entries are relative amplitude, phase, Doppler cell and range cell of the scatterers, then
    k, w and v. As a step assumes, the range term stays that of the first range cells and of the
    first warp.
    """
    grow, turn, line, row = unknown[: 4 * FEW].view(4, FEW)
    k, w, v = (
        motion.k[0] + unknown[4 * FEW : -2],
        motion.w + unknown[-2],
        motion.offset + motion.centre_m * unknown[-2] + unknown[-1],
    )
    time = torch.arange(SHORT, dtype=F64) / SMALL.prf_hz
    phi = warp(time, k)
    u = phi / warp(torch.tensor([SMALL.duration_s], dtype=F64), k)
    range_m = SMALL.first_m + SMALL.step_m * found.row[0]
    turns = (
        -(found.cell[0] + line) * u[:, None]
        + (w * range_m + v) * warp(time, motion.k[0])[:, None].square() / WAVELENGTH
    )
    amplitude = found.amplitude[0] * torch.complex(1 + grow, turn)
    profile = response(torch.arange(CELLS, dtype=F64) - (found.row[0] + row)[:, None], CELLS)
    return torch.view_as_real((torch.exp(2j * math.pi * turns) * amplitude) @ profile)


def fit_of(motion: Motion, found: Scatterers) -> Fit:
    """State with the periodic range response of `model`."""
    one, never = torch.ones(1, dtype=F64), torch.zeros(1, dtype=torch.bool)
    return Fit(motion, found, one, one, never.long(), never, torch.zeros(1, 4, dtype=F64))


def near_of(found: Scatterers) -> Neighbours:
    return Neighbours.find(found.amplitude, found.cell)


def step_of(data: Tensor) -> tuple[Tensor, Step]:
    found, motion = few()
    return Step.of(data, SMALL, fit_of(motion, found), near_of(found), 8)


@pytest.mark.parametrize("gaps", [False, True])
def test_gradient_and_curvature_of_a_step_are_those_of_the_model(gaps: bool) -> None:
    found, motion = few()
    present = torch.ones(1, SHORT, dtype=torch.bool)
    present[:, 20:33] = not gaps
    zero = torch.zeros(4 * FEW + 4, dtype=F64)
    data = torch.view_as_complex(model(zero, found, motion))[None] + 0.3 * noise(7, 1, SHORT, CELLS)
    data = data * present[..., None]
    residual, step = step_of(data)
    expected = torch.view_as_real(residual[0])
    torch.testing.assert_close(
        expected,
        (torch.view_as_real(data[0]) - model(zero, found, motion)) * present[0, :, None, None],
        atol=1e-9,
        rtol=0,
    )
    jacobian = torch.func.jacfwd(lambda x: model(x, found, motion))(zero) * present[0, :, None, None, None]
    gradient = (jacobian * expected[..., None]).sum((0, 1, 2))
    slopes = step._slopes()
    turned = found.amplitude.conj()[..., None] * step.moments
    own = torch.cat(
        [
            turned[..., 0].real,
            turned[..., 0].imag,
            -2 * math.pi * turned[..., 1].imag,
            (found.amplitude.conj() * step.shift).real,
        ],
        -1,
    )
    torch.testing.assert_close(own[0], gradient[: 4 * FEW], rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(
        torch.einsum("bpin,bpn->bi", slopes, turned.imag)[0], gradient[4 * FEW :], rtol=1e-6, atol=1e-9
    )
    flat = jacobian.flatten(0, 2)
    local, (cross, shared) = step._local(), step._shared(slopes)
    mine = torch.cat([torch.cat([local[0], cross[0]], 1), torch.cat([cross[0].mT, shared[0].sum(0)], 1)])
    size = flat.square().sum(0).sqrt()
    torch.testing.assert_close(mine / size / size[:, None], flat.mT @ flat / size / size[:, None], rtol=0, atol=2e-3)


def test_steps_explain_all_energy_of_noise_free_data() -> None:
    found, motion = few()
    near = torch.zeros(4 * FEW + 4, dtype=F64)
    near[: 2 * FEW], near[2 * FEW : 3 * FEW], near[3 * FEW : 4 * FEW] = 0.03, 0.02, -0.01
    data = torch.view_as_complex(model(near, found, motion))[None]
    fit, left = fit_of(motion, found), []
    for _ in range(5):
        residual, step = Step.of(data, SMALL, fit, near_of(found), 8)
        left.append(float(residual.abs().square().sum() / data.abs().square().sum()))
        moved = step.after(fit.noise, SMALL, 0)
        fit = replace(fit, scatterers=moved.scatterers)
        assert (solved(*step.reduced(False)[1:])[1].diagonal(dim1=1, dim2=2) > 0).all()
    assert left[0] > 1e-4 and left[-1] < 1e-3 * left[0]


def test_only_scatterers_less_than_64_cells_apart_are_coupled() -> None:
    """Also just below; those a little farther apart are pairs, because they may come nearer."""
    cell = torch.tensor([[0.0, math.nextafter(64.0, 0.0), 64.0, 69.0, math.nan]], dtype=F64)
    one = torch.ones_like(cell, dtype=torch.complex128)
    near = Neighbours.find(one, cell)
    value = inner_products(near, SMALL, K[None], one, cell, torch.ones(1, 1, SHORT))[(0, 0)]
    coupled = {(p, q) for p, q, v in zip(near.first.tolist(), near.second.tolist(), value) if v != 0}
    assert coupled == {(p, q) for p in range(4) for q in range(4) if abs(cell[0, p] - cell[0, q]) < 64}
    assert len(near.first) == len(coupled) + 2, "(0, 2) and (2, 0), of 64 cells"


def test_neighbours_are_numbered_as_by_nonzero() -> None:
    source = torch.Generator().manual_seed(5)
    cell = 400 * torch.rand(3, 30, dtype=F64, generator=source)
    used = torch.rand(3, 30, generator=source) < 0.7
    used[:, 27:] = False
    near = Neighbours.find(used.to(torch.complex128), cell)
    apart = (cell[:, :, None] - cell[:, None]).abs()
    wanted = ((apart < 69) & used[:, :, None] & used[:, None]).nonzero(as_tuple=True)
    assert all(torch.equal(a, b) for a, b in zip((near.trial, near.first, near.second), wanted))
    assert near.shape == (3, int(used.any(0).nonzero().max()) + 1)
    for trials, scatterers in ((2, 5), (0, 5), (2, 0)):
        none = torch.zeros(trials, scatterers, dtype=F64)
        assert Neighbours.find(none, none).shape == (trials, min(1, scatterers))


def test_an_indefinite_curvature_moves_every_scatterer_on_its_own() -> None:
    """And only in its own trial. Unknowns of two scatterers, in the order of `Step._local`."""
    source = torch.Generator().manual_seed(1)
    right = torch.randn(2, 8, 3, dtype=F64, generator=source)
    root = torch.randn(8, 8, dtype=F64, generator=source)
    good = root @ root.mT + torch.eye(8, dtype=F64)
    # unknown i of scatterer p is row 2 i + p
    own = [good[p::2, p::2] for p in range(2)]
    bad = good.clone()
    bad[0, 1] = bad[1, 0] = 2 * good[0, 0].maximum(good[1, 1])
    found = _solver(torch.stack([good, bad]))(right)
    torch.testing.assert_close(found[0], torch.linalg.solve(good, right[0]))
    for p in range(2):
        torch.testing.assert_close(found[1, p::2], torch.linalg.solve(own[p], right[1, p::2]))
