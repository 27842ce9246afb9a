"""Non-uniform transforms against the direct sum, with adjoints and gradients."""

from __future__ import annotations

import math

import pytest
import torch

from torchsar.focus import nufft_type1, nufft_type2


def direct(x, points):
    j = torch.arange(x.shape[-1], dtype=torch.float64) - x.shape[-1] // 2
    return (torch.exp(-2j * math.pi * points[..., None] * j) @ x[..., None])[..., 0]


@pytest.mark.parametrize("n", [1, 7, 64, 101])
@pytest.mark.parametrize("eps", [1e-2, 1e-4, 1e-6, 1e-9, 1e-12])
def test_error_is_below_eps(n, eps):
    g = torch.Generator().manual_seed(n)
    x = torch.randn(3, n, dtype=torch.complex128, generator=g)
    points = 6 * torch.rand(3, 200, dtype=torch.float64, generator=g) - 3
    exact = direct(x, points)
    error = torch.linalg.vector_norm(nufft_type2(x, points, eps) - exact) / torch.linalg.vector_norm(exact)
    assert error < eps


def test_complex64_reaches_single_precision():
    x = torch.randn(4, 512, dtype=torch.complex64)
    points = torch.rand(4, 700, dtype=torch.float64)
    exact = direct(x.to(torch.complex128), points)
    out = nufft_type2(x, points, 1e-6)
    assert out.dtype == torch.complex64
    assert torch.linalg.vector_norm(out - exact) / torch.linalg.vector_norm(exact) < 3e-6


@pytest.mark.parametrize("eps", [1e-3, 1e-8])
def test_type1_is_the_adjoint_of_type2(eps):
    x, y = torch.randn(2, 3, 50, dtype=torch.complex128), torch.randn(2, 3, 80, dtype=torch.complex128)
    points = torch.rand(3, 80, dtype=torch.float64) - 0.5
    left = (nufft_type2(x, points, eps) * y.conj()).sum()
    right = (x * nufft_type1(y, points, 50, eps).conj()).sum()
    torch.testing.assert_close(left, right, rtol=1e-12, atol=1e-12)


def test_shared_points_equal_points_per_row():
    x, points = torch.randn(5, 33, dtype=torch.complex128), torch.rand(40, dtype=torch.float64)
    torch.testing.assert_close(nufft_type2(x, points), nufft_type2(x, points.expand(5, 40)))
    y = torch.randn(5, 40, dtype=torch.complex128)
    torch.testing.assert_close(nufft_type1(y, points, 33), nufft_type1(y, points.expand(5, 40), 33))


@pytest.mark.parametrize("transform", [lambda x, p: nufft_type2(x, p, 1e-6), lambda x, p: nufft_type1(x, p, 9, 1e-6)])
def test_gradients(transform):
    x = torch.randn(2, 12, dtype=torch.complex128, requires_grad=True)
    points = (torch.rand(2, 12, dtype=torch.float64) - 0.5).requires_grad_()
    assert torch.autograd.gradcheck(transform, (x, points))


def test_gradient_in_the_points_is_that_of_the_direct_sum():
    x, points = torch.randn(2, 40, dtype=torch.complex128), torch.rand(2, 30, dtype=torch.float64).requires_grad_()
    got, want = (
        torch.autograd.grad(f(x, points).abs().square().sum(), points)[0]
        for f in (lambda x, p: nufft_type2(x, p, 1e-9), direct)
    )
    assert torch.linalg.vector_norm(got - want) < 1e-6 * torch.linalg.vector_norm(want)


def test_invalid_arguments_raise():
    x = torch.zeros(4, dtype=torch.complex64)
    with pytest.raises(TypeError, match="float64 cycles per sample"):
        nufft_type2(x, torch.zeros(3))
    with pytest.raises(ValueError, match="eps=0"):
        nufft_type2(x, torch.zeros(3, dtype=torch.float64), 0.0)
