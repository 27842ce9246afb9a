"""Searches for the rotation of least image entropy, on targets small enough for every method."""

from __future__ import annotations

import math
from collections.abc import Sequence

import pytest
import torch
from torch import Tensor

from torchsar.compensate import (
    EntropyObjective,
    EntropyRotation,
    ImageEntropy,
    entropy_rotation,
)
from torchsar.compensate.rotation import entropy_search
from torchsar.compensate.rotation.image_entropy import Unknowns
from torchsar.core import Chain, Draws, Estimate, Outcome, Signal, use
from torchsar.metrics import entropy
from torchsar.radar import LIGHT_M_S, InverseRadar
from torchsar.radar.warp import shape_of, warp

F64 = torch.float64
WAVELENGTH, PRF, PULSES, BINS, CELL = 1.55e-6, 20e3, 400, 16, 0.48
OMEGA, K = 0.02, torch.tensor([10.0, 1000.0], dtype=F64)
TRUTH = torch.tensor([OMEGA, 10.0, 1000.0], dtype=F64)
RANGE_M = CELL * (torch.arange(BINS, dtype=F64) - BINS // 2)
RADAR = InverseRadar(LIGHT_M_S / WAVELENGTH, LIGHT_M_S / (2 * CELL), PRF)


def echo(
    x: Tensor,
    y: Tensor,
    amplitude: Tensor,
    n_pulse: int,
    prf_hz: float,
    range_m: Tensor,
    cell_m: float,
    yc_m: float = 0.0,
    k: Tensor = K,
) -> Tensor:
    """Remote Sens. 2025, 17, 3447, Eq. (3), with exact sine and cosine, (pulse, range)."""
    angle = OMEGA * warp(torch.arange(n_pulse, dtype=F64) / prf_hz, k)
    path = x[:, None] * torch.sin(angle) + (y + yc_m)[:, None] * (torch.cos(angle) - 1)
    phasor = torch.exp(-4j * math.pi / WAVELENGTH * path) * amplitude[:, None]
    return phasor.mT @ torch.sinc((range_m - y[:, None]) / cell_m).to(torch.complex128)


def target(seed: int = 0, yc_m: float = 0.0, k: Tensor = K, snr_db: float = 20.0) -> Tensor:
    """24 points over 0.32 m of cross range and 6 m of range, with noise, (400, 16)."""
    source = torch.Generator().manual_seed(seed)
    x, y, phase = (torch.rand(24, generator=source, dtype=F64) for _ in range(3))
    data = echo(0.32 * (x - 0.5), 6.0 * (y - 0.5), torch.exp(2j * math.pi * phase), PULSES, PRF, RANGE_M, CELL, yc_m, k)
    noise = torch.randn(PULSES, BINS, dtype=torch.complex128, generator=source)
    return data + noise * data.abs().square().mean().sqrt() * 10 ** (-snr_db / 20)


def figure(data: Tensor, **options) -> ImageEntropy:
    objective = EntropyObjective(**{"oversampling": 4.0, "taps": 8, **options})
    return ImageEntropy(data, objective, wavelength_m=WAVELENGTH, prf_hz=PRF, range_m=RANGE_M)


def signal_of(data: Tensor) -> Signal:
    return Signal(data, RADAR.raw_axes(PULSES, BINS))


def equal(one: Estimate, many: Estimate, i: int, tolerance: float = 1e-6) -> None:
    for name, value in one.value.items():
        torch.testing.assert_close(many[name][i], value, rtol=tolerance, atol=tolerance)
    assert one.ok == many.ok[i]


def test_the_objective_is_the_entropy_of_the_image() -> None:
    data = target()
    phi = warp(torch.arange(PULSES, dtype=F64) / PRF, K)
    total = warp(torch.tensor([PULSES / PRF], dtype=F64), K)
    flat = data * torch.exp(-2j * math.pi / WAVELENGTH * (RANGE_M + 0.7) * (OMEGA * phi[:, None]).square())
    cells = (torch.arange(300, dtype=F64) - 150) / 2
    image = torch.exp(2j * math.pi * cells[:, None] * phi / total) @ flat
    found = figure(data, yc_m=0.7, oversampling=2.0, lines=300, taps=12)(TRUTH[None])
    torch.testing.assert_close(found[0], entropy(image), atol=1e-7, rtol=0)
    searched = figure(data, yc_m=None, oversampling=2.0, lines=300, taps=12)(
        torch.cat([TRUTH, torch.tensor([0.7], dtype=F64)])[None]
    )
    torch.testing.assert_close(searched, found, atol=1e-12, rtol=0)


@pytest.mark.parametrize("range_term", [True, False])
def test_both_kinds_of_variables_describe_the_same_rotation(range_term: bool) -> None:
    raw, shape = (figure(target(), variables=variables, range_term=range_term) for variables in ("raw", "shape"))
    x, q = raw.start(OMEGA, K), shape.start(OMEGA, K)
    torch.testing.assert_close(shape(q[None]), raw(x[None]), atol=1e-9, rtol=0)
    torch.testing.assert_close(q[-2:], shape_of(K, PULSES / PRF), atol=1e-12, rtol=0)
    torch.testing.assert_close(shape.turn(q).warp_k, K, rtol=1e-9, atol=0)
    assert raw.unknowns.names == (("omega_rad_s",) if range_term else ()) + ("k1_per_s", "k2_per_s2")
    assert shape.unknowns.names == (("angle_rad",) if range_term else ()) + ("q2", "q3")


@pytest.mark.parametrize("variables", ["raw", "shape"])
def test_gradients_against_differences(variables) -> None:
    of = figure(target(), variables=variables, yc_m=None)
    x = of.start(OMEGA, 1.02 * K, 0.4)
    cost, gradient = of.with_gradient(x)
    torch.testing.assert_close(cost, of.single(x), atol=1e-12, rtol=0)
    unit = of.units(x)
    step = 1e-4 * torch.diag(unit)
    slopes = (of(x + step) - of(x - step)) / 2e-4
    torch.testing.assert_close(gradient * unit, slopes, atol=1e-6, rtol=1e-5)
    rows = [(of.with_gradient(x + d)[1] - of.with_gradient(x - d)[1]) * unit / 2e-4 for d in step]
    hessian = torch.autograd.functional.hessian(lambda z: of.single(x + z * unit), torch.zeros_like(x))
    torch.testing.assert_close(hessian, torch.stack(rows), atol=1e-4, rtol=1e-3)


def test_infeasible_candidates_have_infinite_entropy() -> None:
    for variables in ("raw", "shape"):
        of = figure(target(), variables=variables)
        good = of.start(OMEGA, K)
        folded = (
            torch.tensor([OMEGA, -100.0, 2000.0], dtype=F64)
            if variables == "raw"
            else torch.tensor([4e-4, 2.0, 0.0], dtype=F64)
        )
        costs = of(torch.stack([good, folded, torch.full_like(good, torch.nan), good]))
        assert torch.isfinite(costs).tolist() == [True, False, False, True] and not torch.isnan(costs).any()
        assert torch.isfinite(of.with_gradient(folded)[1]).all()


def test_candidates_in_blocks_and_batches_equal_single_ones() -> None:
    data = torch.stack([target(i) * 10.0**i for i in range(3)]).to(torch.complex64)
    x = TRUTH * (1 + 0.02 * torch.randn(3, 40, 3, generator=torch.Generator().manual_seed(1), dtype=F64))
    together = figure(data)(x)
    for i in range(3):
        alone = torch.cat([figure(data[i])(part[None]) for part in x[i]])
        torch.testing.assert_close(together[i], alone, atol=2e-5, rtol=0)
    two = figure(data[None].expand(2, 3, PULSES, BINS), yc_m=torch.tensor([[0.0], [1.0]], dtype=F64))
    assert two(x.expand(2, 3, 40, 3)).shape == (2, 3, 40)
    torch.testing.assert_close(two(x.expand(2, 3, 40, 3))[0], together, atol=2e-5, rtol=0)


def test_no_compensation_is_uniform_rotation_without_range_phase() -> None:
    of = figure(target())
    still = of(torch.tensor([[0.0, 0.0, 0.0]], dtype=F64))
    torch.testing.assert_close(of.uncompensated(), still[0], atol=1e-12, rtol=0)


@pytest.mark.slow
@pytest.mark.parametrize("variables", ["raw", "shape"])
@pytest.mark.parametrize("factor", [0.9, 1.0, 1.1])
def test_descents_from_any_start_reach_one_minimum(variables, factor: float) -> None:
    of = figure(target(), variables=variables)
    start = of.start(factor * OMEGA, factor * K)
    descent, newton = entropy_rotation(of, "descent", start), entropy_rotation(of, "newton", start)
    best = entropy_rotation(figure(target()), "newton", TRUTH, steps=40).info["entropy_nats"]
    for found in (descent, newton):
        assert found.ok
        torch.testing.assert_close(found.info["entropy_nats"], best, atol=1e-5, rtol=0)
    torch.testing.assert_close(descent["warp_k"], K, rtol=0.04, atol=0)
    assert abs(float(descent["omega_rad_s"]) / OMEGA - 1) < 0.1
    assert torch.equal(descent["warp_k"], torch.stack([descent["k1_per_s"], descent["k2_per_s2"]]))


@pytest.mark.slow
def test_undamped_newton_diverges_and_is_not_ok() -> None:
    of = figure(target())
    for factor in (0.9, 1.1):
        found = entropy_rotation(of, "newton", of.start(factor * OMEGA, factor * K), damped=False)
        assert not found.ok
        assert all(torch.isfinite(value).all() for value in found.value.values())
        assert entropy_rotation(of, "newton", of.start(factor * OMEGA, factor * K)).ok


@pytest.mark.slow
def test_population_searches_find_the_minimum_inside_their_box() -> None:
    of = figure(target(), oversampling=2.0, taps=4, lines=600)
    best = entropy_rotation(of, "descent", of.start(OMEGA, K)).info["entropy_nats"]
    low, high = 0.7 * TRUTH, 1.3 * TRUTH
    for found in (
        entropy_rotation(of, "genetic", (low, high), draws=Draws(1)),
        entropy_rotation(of, "evolution", (low, high), draws=Draws(1)),
    ):
        assert found.ok and abs(float(found.info["entropy_nats"] - best)) < 0.02
    assert found.info["evaluations"] == 888 and found.info["best_entropy_nats"].shape == (37,)
    outside = entropy_rotation(of, "evolution", (1.1 * TRUTH, 1.3 * TRUTH), draws=Draws(1), generations=8)
    assert not outside.ok and outside.info["on_edge"].any(), "the minimum lies outside this box"


def test_the_grid_search_returns_the_entropy_on_the_grid() -> None:
    of = figure(target(), oversampling=2.0, taps=4)
    axes = [[OMEGA], [9.0, 9.5, 10.0, 10.5, 11.0], [900.0, 1000.0, 1100.0]]
    found = entropy_rotation(of, "grid", axes)
    assert found.ok and found.info["evaluations"] == 15 and found.info["entropy_grid_nats"].shape == (1, 5, 3)
    torch.testing.assert_close(found["warp_k"], K, atol=0, rtol=0)
    edge = entropy_rotation(of, "grid", [[OMEGA], [5.0, 10.0], [1000.0]])
    assert edge.outcome == Outcome.OUTSIDE_SEARCH and edge.info["on_edge"].tolist() == [False, True, False]


def test_the_centre_deviation_is_found_jointly() -> None:
    data = target(yc_m=1.5)
    ignored, known, joint = (
        entropy_rotation(of, "descent", of.start(OMEGA, K))
        for of in (figure(data, variables="shape", yc_m=yc) for yc in (0.0, 1.5, None))
    )
    assert joint.info["entropy_nats"] < ignored.info["entropy_nats"] - 5e-3
    assert abs(float(joint["yc_m"]) - 1.5) < 0.3 and known["yc_m"] == 1.5 and ignored["yc_m"] == 0


def test_second_order_finds_the_middle_rate() -> None:
    """The second-order method on three points finds not k1 = 10 but about k1 + k2 T / 2 = 20.

    It cannot focus the points, and is not ok.
    """
    one = torch.tensor([0.0], dtype=F64)
    data = echo(
        torch.tensor([-12.0, 0.0, 12.0], dtype=F64),
        torch.full((3,), 12.0, dtype=F64),
        torch.ones(3, dtype=torch.complex128),
        20000,
        1e6,
        one + 12.0,
        1.0,
    )
    of = ImageEntropy(
        data, EntropyObjective(order=2, range_term=False), wavelength_m=WAVELENGTH, prf_hz=1e6, range_m=one
    )
    coarse = entropy_rotation(of, "grid", [torch.linspace(0, 40, 41, dtype=F64)])
    found = entropy_rotation(of, "descent", of.start(0.0, coarse["warp_k"]))
    assert not found.ok and abs(float(found["k1_per_s"]) - 20) < 0.6
    assert set(found.value) == {"warp_k", "k1_per_s"}


def test_uniform_rotation_is_not_improved() -> None:
    still = target(k=torch.zeros(2, dtype=F64))
    of = figure(still, range_term=False, oversampling=2.0)
    found = entropy_rotation(of, "descent", of.start(0.0, torch.zeros(2, dtype=F64)))
    assert found.quality < 0.02
    assert abs(float(found["k1_per_s"])) < 3, "24 points shift the minimum by less than this"


@pytest.mark.slow
def test_a_batch_equals_single_trials() -> None:
    data = torch.stack([target(0), 100 * target(1), target(2, k=torch.tensor([20.0, -500.0], dtype=F64))])
    kinds = {
        "descent": lambda of: entropy_rotation(of, "descent", of.start(OMEGA, 0.95 * K), steps=5),
        "newton": lambda of: entropy_rotation(of, "newton", of.start(OMEGA, 0.95 * K), steps=3),
        "grid": lambda of: entropy_rotation(of, "grid", [[OMEGA], [9.0, 10.0, 11.0], [900.0, 1000.0, 1100.0]]),
        "genetic": lambda of: entropy_rotation(
            of, "genetic", (0.9 * TRUTH, 1.1 * TRUTH), draws=Draws(2), population=6, generations=2
        ),
        "evolution": lambda of: entropy_rotation(
            of, "evolution", (0.9 * TRUTH, 1.1 * TRUTH), draws=Draws(2), population=6, generations=2
        ),
    }
    for name, search in kinds.items():
        together = search(figure(data, oversampling=2.0))
        for i in range(3):
            equal(
                search(figure(data[i], oversampling=2.0)), together, i, 1e-3 if name in ("descent", "newton") else 1e-9
            )


def stages() -> list:
    low, high = (0.9 * TRUTH).tolist(), (1.1 * TRUTH).tolist()
    start = (0.95 * TRUTH).tolist()
    return [
        EntropyRotation(RADAR, "grid", low, high, [3, 3, 3]),
        EntropyRotation(RADAR, "genetic", low, high, population=10, generations=4),
        EntropyRotation(RADAR, "evolution", low, high, population=10, generations=4),
        EntropyRotation(RADAR, "newton", start=start, steps=10),
        EntropyRotation(RADAR, "descent", start=start),
    ]


@pytest.mark.slow
@pytest.mark.parametrize("stage", stages(), ids=lambda stage: stage.method)
@pytest.mark.parametrize("dtype", [torch.complex64, torch.complex128])
def test_stages_provide_what_they_declare(stage, dtype: torch.dtype) -> None:
    found = stage(signal_of(torch.stack([target(0), target(1)]).to(dtype)))
    assert set(found.value) == set(stage.provides) == {"omega_rad_s", "warp_k", "yc_m", "k1_per_s", "k2_per_s2"}
    assert found["warp_k"].shape == (2, 2) and found["omega_rad_s"].shape == (2,)
    assert found["warp_k"].dtype == F64 and found.ok.shape == (2,)
    assert (found.info["entropy_nats"] < found.info["uncompensated_entropy_nats"]).all()
    assert ((found.quality >= 0) & (found.quality <= 1)).all()


def test_a_descent_starts_from_the_result_of_a_search() -> None:
    chain = Chain(
        coarse=EntropyRotation(
            RADAR, "grid", [OMEGA, 8.0, 800.0], [OMEGA, 12.0, 1200.0], [1, 5, 5], EntropyObjective(oversampling=1.0)
        ),
        fine=use(
            EntropyRotation(RADAR, "descent", objective=EntropyObjective(variables="shape", oversampling=4.0)),
            omega_rad_s="coarse",
            warp_k="coarse",
            yc_m="coarse",
        ),
    )
    trace = chain.trace(signal_of(target()))
    coarse, fine = trace.estimates["coarse"], trace.estimates["fine"]
    assert fine.ok and (fine["warp_k"] / K - 1).abs().max() < 0.04
    assert not torch.equal(coarse["warp_k"], fine["warp_k"])


def test_invalid_input_is_rejected() -> None:
    data = target()
    with pytest.raises(ValueError, match="at least 8 pulses"):
        figure(data[:7])
    with pytest.raises(TypeError, match="complex64 or complex128"):
        figure(data.real)
    with pytest.raises(ValueError, match="NaN or Inf"):
        figure(data * torch.nan)
    with pytest.raises(ValueError, match="range_m must be a tensor of the 8 coordinates"):
        figure(data[:, :8])
    with pytest.raises(ValueError, match="order must be 2 or more without the range term, got 1"):
        figure(data, order=1, range_term=False)
    with pytest.raises(ValueError, match="the range centre deviation affects the range term alone"):
        figure(data, range_term=False, yc_m=None)
    with pytest.raises(ValueError, match="'raw' or 'shape'"):
        figure(data, variables="polar")
    with pytest.raises(ValueError, match="low must hold the 3 values omega_rad_s, k1_per_s, k2_per_s2, got 2"):
        entropy_rotation(figure(data), "genetic", ([0.01, 9.0], [0.03, 11.0]), draws=Draws(1))
    with pytest.raises(ValueError, match="list of values for each of the 3 unknowns"):
        entropy_rotation(figure(data), "grid", [[0.02], [10.0]])
    for method, where, form in (
        ("grid", 0.02, "a list of values for each of the 3 unknowns"),
        ("grid", [0.02, 10.0, 1000.0], "a list of values for each of the 3 unknowns"),
        ("genetic", ([-1.0],), "two lists, the lower and the upper bounds, of the 3 unknowns"),
        ("evolution", "narrow", "two lists, the lower and the upper bounds, of the 3 unknowns"),
        ("newton", "near", "start must hold the 3 values omega_rad_s, k1_per_s, k2_per_s2"),
    ):
        with pytest.raises(ValueError, match=form):
            entropy_rotation(figure(data), method, where)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="method 'genetic' needs random numbers; give draws"):
        entropy_rotation(figure(data), "genetic", (0.9 * TRUTH, 1.1 * TRUTH))
    with pytest.raises(ValueError, match="27000 evaluations per trial, above the limit of 1000"):
        entropy_rotation(figure(data), "grid", [torch.linspace(1, 2, 30, dtype=F64)] * 3, limit=1000)
    with pytest.raises(ValueError, match="EntropyRotation needs a rotation to start from"):
        EntropyRotation(RADAR, "descent")(signal_of(data))
    with pytest.raises(ValueError, match="start must hold the 3 values omega, k1, k2"):
        EntropyRotation(RADAR, "newton", start=[10.0, 1000.0])
    with pytest.raises(ValueError, match="low, high and counts must hold one entry per unknown"):
        EntropyRotation(RADAR, "grid", [0.0], [1.0, 2.0], [3])
    with pytest.raises(ValueError, match="low, high and counts must hold one entry per unknown"):
        EntropyRotation(RADAR, "grid", [], [], [])
    with pytest.raises(ValueError, match="method must be one of grid, .*, got 'simplex'"):
        EntropyRotation(RADAR, "simplex")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="method 'grid' needs low, high, counts; its options"):
        EntropyRotation(RADAR, "grid")
    with pytest.raises(ValueError, match="method 'genetic' needs high; its options"):
        EntropyRotation(RADAR, "genetic", low=[0.0])
    with pytest.raises(ValueError, match="method 'newton' does not take seed; its options are start, damped, steps"):
        EntropyRotation(RADAR, "newton", seed=1)
    with pytest.raises(ValueError, match="method 'evolution' needs low and does not take damped; its options"):
        EntropyRotation(RADAR, "evolution", high=[1.0], damped=False)


@pytest.mark.parametrize("order", [1, 2, 3, 4, 5])
def test_any_order(order: int) -> None:
    unknowns = Unknowns(0.02, order, yc=True, variables="shape")
    k = torch.tensor([10.0, 1000.0, -2e4, 1e6], dtype=F64)[: order - 1]
    x = unknowns.at(torch.tensor(0.02, dtype=F64), k, torch.tensor(1.0, dtype=F64))
    assert len(x) == len(unknowns.names) == order + 1
    turn = unknowns.turn(x, torch.tensor(0.0, dtype=F64))
    torch.testing.assert_close(turn.warp_k, k, rtol=1e-9, atol=0)
    torch.testing.assert_close(turn.omega_rad_s, torch.tensor(0.02, dtype=F64), rtol=1e-12, atol=0)
    assert turn.feasible and turn.yc_m == 1.0


def test_sequences_are_accepted_as_vectors() -> None:
    values: Sequence[float] = [0.02, 10.0, 1000.0]
    assert torch.equal(Unknowns(0.02).vector(values, "start"), TRUTH)


def test_a_search_that_uses_up_its_steps_is_not_ok() -> None:
    of = figure(target(), variables="shape")
    start = of.start(0.9 * OMEGA, 0.9 * K)
    assert (
        not entropy_rotation(of, "descent", start, steps=2).ok and not entropy_rotation(of, "newton", start, steps=2).ok
    )


def test_values_do_not_depend_on_the_assessment(monkeypatch: pytest.MonkeyPatch) -> None:
    data = torch.stack([target(0), target(1)])
    axes = [[OMEGA], [9.0, 10.0, 11.0], [900.0, 1000.0, 1100.0]]

    def searches(**options: bool) -> list[Estimate]:
        of = figure(data, oversampling=2.0)
        start, box = of.start(OMEGA, 0.95 * K), (0.9 * TRUTH, 1.1 * TRUTH)
        few = {"population": 6, "generations": 2, "draws": Draws(2)}
        return [
            entropy_rotation(of, "grid", axes, **options),
            entropy_rotation(of, "genetic", box, **few, **options),
            entropy_rotation(of, "evolution", box, **few, **options),
            entropy_rotation(of, "newton", start, steps=2, **options),
            entropy_rotation(of, "descent", start, steps=2, **options),
        ]

    def failing(*_: object) -> None:
        raise AssertionError("the assessment was called")

    assessed = searches()
    monkeypatch.setattr(entropy_search, "judged_motion", failing)
    for one, bare in zip(assessed, searches(assess=False), strict=True):
        assert all(torch.equal(value, bare[key]) for key, value in one.value.items())
        assert (bare.outcome == Outcome.NOT_ASSESSED).all()
    codes = [set(one.outcome.tolist()) for one in assessed]
    assert codes[0] == {Outcome.OK} and codes[3] == codes[4] == {Outcome.NOT_CONVERGED}
