"""Phases that minimise a cost of the image: gradients, masks, bases, independence of the start."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from torchsar.compensate import (
    CorrectPulsePhase,
    Sca,
    entropy_fixed_point,
    sharpest_phase,
)
from torchsar.compensate.pulse_phase.data import prepare
from torchsar.compensate.pulse_phase.imaging import AlongPulses
from torchsar.compensate.pulse_phase.sharpest import power_entropy
from torchsar.core import Chain, Draws, Signal, legendre, level_of, unit_phasor, use
from torchsar.focus import AzimuthTransform, azimuth_transform
from torchsar.metrics import contrast, entropy, phase_rmse
from torchsar.optim import lbfgs
from torchsar.radar import InverseRadar

DOUBLE = torch.complex128


def points(
    trials: int = 2, n_pulse: int = 48, n_range: int = 24, noise: float = 0.05, dtype: torch.dtype = DOUBLE
) -> Tensor:
    """A few points per range cell at random positions, in focus, (trial, pulse, range)."""
    draws = Draws(5, trials=range(trials))
    cycles = draws.uniform("cycles", (3, n_range), -0.35, 0.35)
    k = torch.arange(n_pulse, dtype=torch.float64)
    a = draws.normal("amplitude", (3, n_range), DOUBLE)
    echo = (a[..., None] * unit_phasor(cycles[..., None] * k, DOUBLE)).sum(1).mT
    return (echo + noise * draws.normal("noise", (n_pulse, n_range), DOUBLE)).to(dtype)


def white(trials: int = 2, n_pulse: int = 48) -> Tensor:
    return Draws(6, trials=range(trials)).uniform("white", (n_pulse,), 0.0, 2 * math.pi)


def turned(data: Tensor, phase_rad: Tensor) -> Tensor:
    return data * unit_phasor(phase_rad / (2 * math.pi), DOUBLE)[..., None].to(data.dtype)


def smooth(n_pulse: int = 48) -> Tensor:
    """Legendre polynomials of degree 2 to 5, (4, pulse)."""
    return legendre(torch.linspace(-1, 1, n_pulse, dtype=torch.float64), 5).mT[2:]


def test_entropy_and_analytic_gradient_equal_autograd():
    pulses = prepare(turned(points(), white()), "test")
    phase = white(2).flip(0).requires_grad_()
    direct = entropy(azimuth_transform((pulses.rows * torch.polar(torch.ones_like(phase), -phase)[:, None]).mT))
    (slope,) = torch.autograd.grad(direct.sum(), phase)
    cost, gradient = power_entropy(pulses.rows, pulses.rows.conj().resolve_conj(), phase.detach())
    torch.testing.assert_close(cost, direct.detach(), rtol=1e-12, atol=0)
    torch.testing.assert_close(gradient, slope, rtol=1e-9, atol=1e-13)


@pytest.mark.parametrize("dtype, tolerance", [(DOUBLE, 1e-9), (torch.complex64, 1e-4)])
@pytest.mark.parametrize("objective", ["power_entropy", "amplitude_entropy", "contrast"])
def test_the_minimum_is_stationary_sharper_and_near_the_truth(objective: str, dtype: torch.dtype, tolerance: float):
    truth, data = white(), points(dtype=dtype)
    found = sharpest_phase(turned(data, truth), objective=objective, tolerance=1e-9)  # type: ignore[arg-type]
    phase = found["phase_rad"]
    assert phase.dtype == data.real.dtype and found.ok.all() and (found.quality > 0.7).all()
    assert (phase_rmse(phase, truth) < 0.15).all()
    cost = {
        "power_entropy": entropy,
        "amplitude_entropy": lambda x: entropy(x, "amplitude"),
        "contrast": lambda x: -contrast(x),
    }[objective]

    def at(p: Tensor) -> Tensor:
        return cost(azimuth_transform(turned(turned(data.to(DOUBLE), truth), -p)))

    best = at(phase.double())
    assert (best <= at(truth) + 1e-6).all()
    nudge = 0.02 * torch.randn(20, 2, 48, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    assert (torch.stack([at(phase.double() + d) for d in nudge]) > best - tolerance).all()


def test_all_starts_reach_one_minimum():
    truth = white()
    data = turned(points(), truth)
    first = sharpest_phase(data, tolerance=1e-6)["phase_rad"]
    for start in (entropy_fixed_point(data)["phase_rad"], truth, truth + 0.5 * torch.sin(torch.arange(48.0))):
        assert (phase_rmse(sharpest_phase(data, start=start, tolerance=1e-6)["phase_rad"], first) < 2e-3).all()
    adam = sharpest_phase(data, start=truth, method="adam", steps=400, tolerance=1e-6)["phase_rad"]
    assert (phase_rmse(adam, first) < 1e-2).all()


def test_the_estimate_is_equivariant():
    data = points()
    plain, after = sharpest_phase(data)["phase_rad"], sharpest_phase(turned(data, 100 * white()))["phase_rad"]
    assert (phase_rmse(after - 100 * white(), plain) < 1e-3).all()


def test_user_defined_costs_equal_the_named_ones():
    data = turned(points(), white())
    seen = []

    def cost(image: Tensor) -> Tensor:
        seen.append(image.detach())
        return entropy(image, "amplitude")

    named, own = sharpest_phase(data, objective="amplitude_entropy"), sharpest_phase(data, objective=cost)
    assert torch.equal(named["phase_rad"], own["phase_rad"])
    start = torch.linspace(0, 3, 48, dtype=torch.float64)
    seen.clear()
    sharpest_phase(data, objective=cost, start=start, steps=1)
    torch.testing.assert_close(seen[0], azimuth_transform(turned(data, -start)) / level_of(data))


def test_any_image_formation_can_be_used():
    class Transposed:
        """Transform along pulses of profiles of shape (..., pulse, range)."""

        def image(self, rows: Tensor) -> Tensor:
            return AlongPulses().image(rows.mT).mT

        def adjoint(self, image: Tensor) -> Tensor:
            return AlongPulses().adjoint(image.mT).mT

    data = turned(points(), white())
    through = sharpest_phase(data, imaging=Transposed(), tolerance=1e-6)["phase_rad"]
    assert (phase_rmse(through, sharpest_phase(data, tolerance=1e-6)["phase_rad"]) < 1e-3).all()


def test_a_mask_excludes_a_moving_neighbour():
    """Each half of the range cells contains a target with its own phases.

    Each trial masks one of them.
    """
    mine, its = white(2), white(2).flip(-1)
    data = turned(points(), mine)
    other = turned(3 * points().flip(-1), its)
    watched = torch.zeros(2, 48, 24)
    watched[0, :, :12], watched[1, :, 12:] = 1, 1
    mixed = torch.where(watched[:, :1] > 0, data, other)
    masked = sharpest_phase(mixed, mask=watched, start=mine + 0.3 * torch.sin(torch.arange(48.0)))["phase_rad"]
    assert (phase_rmse(masked, mine) < 0.1).all()
    assert (phase_rmse(sharpest_phase(mixed)["phase_rad"], mine) > 0.5).any()
    shared = sharpest_phase(mixed[:1], mask=watched[0, 0] > 0, start=mine[:1] + 0.3 * torch.sin(torch.arange(48.0)))[
        "phase_rad"
    ]
    assert float(phase_rmse(shared, masked[:1])) < 1e-3
    for i in range(2):
        alone = sharpest_phase(mixed[i], mask=watched[i], start=mine[i] + 0.3 * torch.sin(torch.arange(48.0)))[
            "phase_rad"
        ]
        assert float(phase_rmse(alone, masked[i])) < 1e-3


def test_a_basis_succeeds_in_noise_where_free_phases_fail():
    basis = smooth()
    truth = torch.tensor([[6.0, -3.0, 1.0, 0.5], [-9.0, 2.0, -1.5, 1.0]], dtype=torch.float64) @ basis
    data = turned(points(noise=2.0), truth)
    found = sharpest_phase(data, basis=basis)
    free = sharpest_phase(data, start=truth)["phase_rad"]
    assert (phase_rmse(found["phase_rad"], truth) < 0.5 * phase_rmse(free, truth)).all()
    assert (
        found.ok.all() and (found.std["phase_rad"][:, 0] > 0.05).all() and (found.std["phase_rad"][:, 0] < 0.25).all()
    )
    # the phase stays in the span of the functions, whatever their scale, shared by trials or not
    phase = found["phase_rad"]
    torch.testing.assert_close(phase @ torch.linalg.pinv(basis) @ basis, phase, atol=1e-9, rtol=0)
    own = sharpest_phase(data, basis=(basis * torch.tensor([1e3, 1.0, 1e-3, 7.0])[:, None]).expand(2, 4, 48))[
        "phase_rad"
    ]
    torch.testing.assert_close(own, phase, atol=1e-4, rtol=0)


@pytest.mark.parametrize(
    "options",
    [{}, {"objective": "contrast"}, {"basis": smooth()}, {"method": "adam", "steps": 30}],
    ids=["free", "contrast", "basis", "adam"],
)
def test_a_batch_equals_single_trials_at_any_scale(options: dict):
    data = turned(points(3), white(3)) * torch.tensor([1.0, 1e-150, 1e150], dtype=torch.float64)[:, None, None]
    data[1, 7] = 0
    together = sharpest_phase(data, **options)
    assert torch.equal(together.info["present"][1], torch.arange(48) != 7)
    for i in range(3):
        alone = sharpest_phase(data[i], **options)
        torch.testing.assert_close(alone["phase_rad"], together["phase_rad"][i], atol=1e-6, rtol=0)
        assert alone["phase_rad"].shape == (48,)


def test_start_mask_and_basis_follow_their_trials(monkeypatch: pytest.MonkeyPatch):
    """Start, mask and basis follow their trials when the batch is cut."""
    data, start = turned(points(4), white(4)), white(4) + 0.2
    own = {
        "start": start,
        "mask": torch.rand(4, 48, 24, generator=torch.Generator().manual_seed(2)),
        "basis": smooth() + torch.rand(4, 1, 48, generator=torch.Generator().manual_seed(3)),
    }
    whole = sharpest_phase(data, steps=3, **own)["phase_rad"]
    monkeypatch.setattr("torchsar.compensate.pulse_phase.data.block_bytes_of", lambda _: 1)
    torch.testing.assert_close(sharpest_phase(data, steps=3, **own)["phase_rad"], whole, atol=1e-8, rtol=0)
    free = sharpest_phase(data, steps=3, start=start)["phase_rad"]
    assert (phase_rmse(free, start) > 1e-2).all()


@pytest.mark.parametrize("shape", [(2, 5), (8, 1), (3, 2, 1), (2, 1, 3, 3)])
@pytest.mark.parametrize(
    "options", [{}, {"objective": "contrast"}, {"method": "adam", "steps": 3}], ids=["entropy", "contrast", "adam"]
)
@pytest.mark.filterwarnings("ignore:sharpest_phase")
def test_small_recordings_stay_finite(shape: tuple[int, ...], options: dict):
    found = sharpest_phase(
        torch.randn(shape, dtype=torch.complex64, generator=torch.Generator().manual_seed(1)), **options
    )
    assert found["phase_rad"].shape == shape[:-1] and found["phase_rad"].dtype == torch.float32
    assert torch.isfinite(found["phase_rad"]).all() and not found.ok.any()


def test_zeros_and_noise_are_not_ok():
    noise = Draws(1, trials=range(3)).normal("noise", (48, 24), DOUBLE)
    noise[2] = 0
    for objective in ("power_entropy", "amplitude_entropy", "contrast"):
        found = sharpest_phase(noise, objective=objective)  # type: ignore[arg-type]
        assert not found.ok.any() and all(
            torch.isfinite(value).all() for value in (found["phase_rad"], found.quality, found.std["phase_rad"])
        )


def test_values_of_a_chain_are_optimised_in_three_lines():
    """What a user writes to optimise values of any chain: run its last part again, and descend."""
    radar = InverseRadar(2e14, 150e9, 2000.0, 0.005, 100e-6, 20e3)
    truth = torch.tensor([[3.0, -2.0, 1.0, 0.5], [-4.0, 1.0, 0.0, 1.0]], dtype=torch.float64)
    signal = Signal(turned(points(), truth @ smooth()), radar.raw_axes(48, 24))
    chain = Chain(phase=Sca(), correct=use(CorrectPulsePhase(), phase_rad="phase"), image=AzimuthTransform(radar))
    trace = chain.trace(signal)
    found = lbfgs(
        lambda c: entropy(chain.rerun(trace, "correct", given={"phase.phase_rad": c @ smooth()})),
        torch.zeros(2, 4, dtype=torch.float64),
    )
    assert (phase_rmse(found.x @ smooth(), truth @ smooth()) < 0.08).all()


def test_invalid_arguments_are_rejected():
    data = points()
    cases: list[tuple[dict, str]] = [
        (
            {"objective": "sharpness"},
            "objective 'sharpness' is not known; choose one of power_entropy, amplitude_entropy, contrast",
        ),
        ({"method": "newton"}, "method 'newton' is not known; choose one of lbfgs, adam"),
        ({"objective": entropy, "mask": torch.ones(24)}, "mask must be None if objective is a function"),
        ({"mask": torch.ones(3, 48, 24)}, r"mask of shape \(3, 48, 24\) does not fit the trials of shape \(2,\)"),
        ({"mask": torch.ones(24, 48)}, r"mask of shape \(24, 48\) does not broadcast"),
        (
            {"basis": torch.ones(47)},
            r"real functions over 48 pulses, shape \(coefficient, pulse\), got torch.float32 of shape \(47,\)",
        ),
        ({"basis": torch.ones(2, 48)}, "linearly independent"),
        ({"basis": torch.ones(3, 2, 48)}, r"basis of shape \(3, 2, 48\) does not fit"),
        ({"start": torch.ones(47)}, r"one phase per pulse, shape .* got \(47,\)"),
        (
            {"objective": lambda image: image.abs().sum()},
            r"objective returned torch.float64 of shape \(\) for 2 images",
        ),
        ({"objective": lambda image: entropy(image).detach()}, "objective returned detached torch.float64"),
        ({"steps": 0}, "steps is 0; choose a positive number"),
    ]
    for options, message in cases:
        with pytest.raises(ValueError, match=message):
            sharpest_phase(data, **options)
    with pytest.raises(TypeError, match="sharpest_phase works on complex"):
        sharpest_phase(data.real)
    for name in ("mask", "basis"):
        with pytest.raises(TypeError, match=f"{name} must be a tensor, got list"):
            sharpest_phase(data, **{name: [1.0]})
