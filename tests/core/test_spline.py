"""Splines through even and uneven knots against scipy, their batches, gradients and errors."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.interpolate import CubicSpline

from torchsar.core import Spline

START, STEP = 0.3, 0.7


def knots(n: int) -> np.ndarray:
    return START + STEP * np.arange(n)


@pytest.mark.parametrize("n", [2, 3, 4, 5, 6, 7, 20, 33, 66, 200])
def test_equals_scipy(n: int) -> None:
    values = np.random.default_rng(n).standard_normal((2, 3, n))
    t = np.linspace(START - 0.5, knots(n)[-1] + 0.5, 143).reshape(11, 13)
    spline, expected = Spline(torch.tensor(values), (START, STEP)), CubicSpline(knots(n), values, axis=-1)
    pairs = [(spline.at, expected), (spline.integral, expected.antiderivative())]
    for found, known in pairs:
        torch.testing.assert_close(found(torch.tensor(t)), torch.tensor(known(t)), atol=2e-12, rtol=1e-12)


def test_pieces_equal_those_of_scipy() -> None:
    values = np.random.default_rng(0).standard_normal((2, 40))
    expected = CubicSpline(knots(40), values, axis=-1).c[::-1]
    torch.testing.assert_close(
        Spline(torch.tensor(values), (START, STEP)).pieces(),
        torch.tensor(np.moveaxis(expected, 0, -1).swapaxes(0, 1).copy()),
        atol=1e-12,
        rtol=1e-12,
    )


def test_cubics_are_reproduced_and_integrals_begin_at_start() -> None:
    t = torch.linspace(-1.0, 9.0, 57, dtype=torch.float64)
    at = torch.arange(12, dtype=torch.float64) * 0.5 + 2.0
    spline = Spline(at**3 - 2 * at, (2.0, 0.5))
    torch.testing.assert_close(spline.at(t), t**3 - 2 * t, atol=1e-9, rtol=0)
    assert float(spline.integral(torch.tensor(2.0, dtype=torch.float64)).abs()) < 1e-14


def test_batch_equals_singles_and_trials_do_not_mix() -> None:
    values = torch.randn(3, 30, dtype=torch.float64) * torch.tensor([1.0, 1e6, 1e-6], dtype=torch.float64)[:, None]
    t = torch.linspace(0, 29, 50, dtype=torch.float64)
    together = Spline(values, (0.0, 1.0)).integral(t)
    torch.testing.assert_close(
        together, torch.stack([Spline(v, (0.0, 1.0)).integral(t) for v in values]), rtol=1e-12, atol=1e-16
    )


@pytest.mark.parametrize("n", [2, 3, 5, 9])
def test_gradients(n: int) -> None:
    values = torch.randn(2, n, dtype=torch.float64, requires_grad=True)
    t = (torch.rand(4, dtype=torch.float64) * (n - 1)).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda v, x: tuple(getattr(Spline(v, (0.0, 1.0)), name)(x) for name in ("at", "integral")),
        (values, t),
    )


def test_invalid_input_raises() -> None:
    with pytest.raises(TypeError, match="float64 values, got torch.float32"):
        Spline(torch.zeros(4), (0.0, 1.0))
    with pytest.raises(ValueError, match="at least two values"):
        Spline(torch.zeros(3, 1, dtype=torch.float64), (0.0, 1.0))
    with pytest.raises(ValueError, match="positive step"):
        Spline(torch.zeros(4, dtype=torch.float64), (0.0, 0.0))
    for wrong in ([0.0, 5.0, 6.0], np.arange(4.0), None, (0.0,), (0.0, "1")):
        with pytest.raises(TypeError, match=r"float64 knots in a tensor, or a tuple \(start, step\) of numbers, got "):
            Spline(torch.zeros(4, dtype=torch.float64), wrong)  # type: ignore[arg-type]


@pytest.mark.parametrize("n", [2, 3, 4, 5, 6, 40])
def test_uneven_knots_equal_scipy(n: int) -> None:
    made = np.random.default_rng(n)
    for rows in (made.uniform(0.1, 1.9, (3, n)), 10.0 ** made.uniform(-3, 3, (3, n))):
        at, values = rows.cumsum(-1), made.standard_normal((2, 3, n))
        t = np.stack([np.linspace(k[0] - 0.5, k[-1] + 0.5, 57) for k in at])
        spline = Spline(torch.tensor(values), torch.tensor(at))
        found, area, pieces = spline.at(torch.tensor(t)), spline.integral(torch.tensor(t)), spline.pieces()
        for i in range(3):
            curve = CubicSpline(at[i], values[:, i], axis=-1)
            pairs = [(found[:, i], curve(t[i])), (area[:, i], curve.antiderivative()(t[i]))]
            # each coefficient by what it adds at the end of its interval
            ends = np.diff(at[i])[:, None] ** np.arange(4)
            pairs.append((pieces[:, i] * torch.tensor(ends), np.moveaxis(curve.c[::-1], 0, -1).swapaxes(0, 1) * ends))
            for ours, known in pairs:
                assert float((ours - torch.tensor(known)).abs().max()) < 1e-10 * max(1.0, float(np.abs(known).max()))
    assert Spline(torch.tensor(values), torch.tensor(at[0])).at(torch.tensor(t[0])).shape == (2, 3, 57)


@pytest.mark.parametrize("n", [2, 3, 4, 7])
def test_gradients_of_uneven_splines(n: int) -> None:
    at = (torch.rand(2, n, dtype=torch.float64) + 0.3).cumsum(-1).requires_grad_()
    values = torch.randn(2, n, dtype=torch.float64, requires_grad=True)
    t = (torch.rand(2, 4, dtype=torch.float64) * n).requires_grad_()
    assert torch.autograd.gradcheck(lambda k, v, x: Spline(v, k).at(x), (at, values, t))


def test_invalid_uneven_knots_raise() -> None:
    good = torch.arange(4, dtype=torch.float64)
    with pytest.raises(TypeError, match="float64 knots, got torch.float32"):
        Spline(good, good.float())
    with pytest.raises(ValueError, match=r"at least two .* got shapes \(\(3,\), \(4,\)\)"):
        Spline(good[:3], good)
    with pytest.raises(ValueError, match="must rise"):
        Spline(good, good.flip(0))
