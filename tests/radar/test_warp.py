"""Warped slow time against integrals of the rotation rate and polynomials of numpy."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from torchsar.radar.warp import coefficients_of, k_of_shape, least_rate, shape_of, warp, warp_rate

F64 = torch.float64
DURATION = 0.02
K = torch.tensor([[10.0, 1000.0, -2e4, 1e6], [-5.0, 3000.0, 1e5, -3e6], [0.0, 0.0, 0.0, 0.0]], dtype=F64)
TIME = torch.linspace(0, DURATION, 41, dtype=F64)
ORDERS = [1, 2, 3, 4, 5]


@pytest.mark.parametrize("order", ORDERS)
def test_the_warp_is_the_integral_of_the_rate(order: int) -> None:
    k = K[:, : order - 1]
    taylor = 1 + sum(
        (k[:, i, None] * TIME ** (i + 1) / math.factorial(i + 1) for i in range(order - 1)),
        torch.zeros(3, len(TIME), dtype=F64),
    )
    torch.testing.assert_close(warp_rate(TIME, k), taylor, rtol=1e-13, atol=0)
    node, weight = np.polynomial.legendre.leggauss(8)
    inner = TIME[:, None] / 2 * (torch.as_tensor(node) + 1)
    rate = warp_rate(inner.flatten(), k).view(3, *inner.shape)
    torch.testing.assert_close(warp(TIME, k), (rate * torch.as_tensor(weight)).sum(-1) * TIME / 2, rtol=1e-13, atol=0)


def test_k_are_derivatives_of_the_rate_over_the_rate() -> None:
    t = torch.zeros(1, dtype=F64, requires_grad=True)
    value = warp_rate(t, K[0])
    assert value == 1.0
    for k in K[0]:
        (value,) = torch.autograd.grad(value, t, create_graph=True)
        torch.testing.assert_close(value[0], k, rtol=1e-12, atol=0)


def test_coefficients_are_those_of_a_polynomial() -> None:
    torch.testing.assert_close(coefficients_of(K[0]), K[0] / torch.tensor([2, 6, 24, 120], dtype=F64))
    series = np.polynomial.Polynomial([0, 1, *coefficients_of(K[0]).tolist()])
    torch.testing.assert_close(warp(TIME, K[0]), torch.as_tensor(series(TIME.numpy())), rtol=1e-13, atol=0)


def test_trials_and_times_broadcast() -> None:
    assert warp(TIME, K).shape == warp_rate(TIME, K).shape == (3, 41)
    assert warp(TIME.expand(3, -1), K[0]).shape == (3, 41) and warp(TIME, K[:, None].expand(3, 2, 4)).shape == (
        3,
        2,
        41,
    )
    own = torch.stack([TIME, 2 * TIME, 3 * TIME])
    torch.testing.assert_close(warp(own, K), torch.stack([warp(t, k) for t, k in zip(own, K)]))
    assert warp(TIME, K[:, :0]).shape == (3, 41) and torch.equal(warp(TIME, K[0, :0]), TIME)


@pytest.mark.parametrize("order", ORDERS)
def test_the_shape_is_a_legendre_series(order: int) -> None:
    k = K[:, : order - 1]
    shape = shape_of(k, DURATION)
    assert shape.shape == (3, order - 1)
    for row, q in zip(warp(TIME, k), shape):
        fitted = np.polynomial.legendre.legfit((2 * TIME / DURATION - 1).numpy(), row.numpy(), order)
        torch.testing.assert_close(q, torch.as_tensor(fitted[2:] / fitted[1]), rtol=1e-6, atol=1e-12)
    torch.testing.assert_close(k_of_shape(shape, DURATION), k, rtol=1e-8, atol=1e-6)


def test_the_shape_by_the_formulas_of_third_order() -> None:
    """Closed form for order 3, with h half the aperture.

    c1 = h + k1 h^2 + 0.6 k2 h^3, q2 = (h^2 / 3) (k1 + k2 h) / c1, q3 = k2 h^3 / (15 c1).
    """
    (k1, k2), h = K[:2, :2].unbind(-1), DURATION / 2
    c1 = h + k1 * h**2 + 0.6 * k2 * h**3
    torch.testing.assert_close(
        shape_of(K[:2, :2], DURATION),
        torch.stack([h**2 / 3 * (k1 + k2 * h), k2 * h**3 / 15], -1) / c1[:, None],
        rtol=1e-13,
        atol=0,
    )


def test_least_rate() -> None:
    assert least_rate(K[:, :0], DURATION).tolist() == [1, 1, 1]
    torch.testing.assert_close(
        least_rate(torch.tensor([[-100.0, 2000.0], [10.0, 1000.0]], dtype=F64), DURATION),
        torch.tensor([-0.6, 1.0], dtype=F64),
    )
    # 1 - 100 t + 5000 t^2: least 0.5 at the middle
    dip = torch.tensor([-100.0, 10000.0], dtype=F64)
    torch.testing.assert_close(least_rate(dip, DURATION), torch.tensor(0.5, dtype=F64))


def test_gradients() -> None:
    def shapes(k: Tensor) -> tuple[Tensor, ...]:
        scaled = k * torch.tensor([1.0, 1e2, 1e4, 1e6], dtype=F64)
        return (
            warp(100 * TIME, scaled),
            warp_rate(TIME, scaled),
            100 * shape_of(scaled, DURATION),
            k_of_shape(k / 50, DURATION) / 1e6,
        )

    assert torch.autograd.gradcheck(
        shapes, (K / torch.tensor([1.0, 1e2, 1e4, 1e6], dtype=F64)).requires_grad_(), atol=1e-4
    )
