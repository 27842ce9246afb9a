"""Non-uniform FFT along pulses against the direct sum, with adjoint, gradients, and the gradients
of the trilinear form.
"""

from __future__ import annotations

import math

import pytest
import torch

from torchsar.core.nufft import Kernel
from torchsar.focus.gridding import PulseNufft, trilinear


def noise(*shape, seed=1, dtype=torch.complex128):
    return torch.randn(*shape, dtype=dtype, generator=torch.Generator().manual_seed(seed))


def warped(m=120):
    """Points of two trials: uniform, and warped with some anywhere, on the grid, at its edges, and
    out of order.
    """
    p = torch.linspace(0, 1 - 1 / m, m, dtype=torch.float64) ** torch.tensor([[1.0], [1.3]], dtype=torch.float64)
    p[1, :8] = torch.tensor([-1.2, 5.3, 0.5, 0.9999999, 1e-12, 0.0, 1.0, 0.25])
    return p


def matrix(points, lines):
    return torch.exp(2j * math.pi * points[..., None] * (torch.arange(lines, dtype=torch.float64) - lines // 2))


def relative(a, b):
    return float(torch.linalg.vector_norm(a - b) / torch.linalg.vector_norm(b))


@pytest.mark.parametrize("dtype, floor", [(torch.complex64, 3e-6), (torch.complex128, 0.0)])
@pytest.mark.parametrize("oversampling", [1.25, 1.5, 2.0])
@pytest.mark.parametrize("taps", [2, 3, 4, 5, 6, 7, 8, 11])
def test_error_is_below_that_of_the_kernel(taps, oversampling, dtype, floor):
    kernel, points, y, x = Kernel(taps, oversampling), warped(), noise(2, 120, 3), noise(2, 71, 3, seed=2)
    plan, exact = PulseNufft(71, kernel, dtype), matrix(points, 71)
    at = plan.points(points)
    forward, backward = plan.type1(y.to(dtype), at), plan.type2(x.to(dtype), at)
    assert forward.dtype == backward.dtype == dtype
    assert relative(forward, exact.mT @ y) < max(kernel.error, floor) and relative(backward, exact.conj() @ x) < max(
        kernel.error, floor
    )
    assert relative(forward, exact.mT @ y) > kernel.error / 30 or floor  # the bound is tight


@pytest.mark.parametrize("eps", [1e-2, 1e-4, 1e-7, 1e-12])
def test_eps_chooses_the_narrowest_width(eps):
    kernel = Kernel.of(eps, even=True)
    assert kernel.error <= eps < Kernel(kernel.taps - 1).error
    assert Kernel.of(eps).taps % 2 and Kernel.of(eps).taps - kernel.taps in (0, 1)


def test_invalid_kernels_raise():
    for taps in (1, 17, 3.5):
        with pytest.raises(ValueError, match="2 to 16 taps"):
            Kernel(taps)
    with pytest.raises(ValueError, match="1.25 to 2 times"):
        Kernel(6, 1.1)
    with pytest.raises(ValueError, match="choose a finer grid"):
        Kernel.of(1e-12, 1.25)
    with pytest.raises(TypeError, match="float64 cycles"):
        PulseNufft(10, Kernel(4), torch.complex64).points(torch.zeros(5))


@pytest.mark.parametrize("taps", [4, 5])
def test_type1_is_the_adjoint_of_type2(taps):
    plan, points = PulseNufft(50, Kernel(taps, 1.25), torch.complex128), warped()
    y, x, at = noise(3, 2, 120, 4), noise(3, 2, 50, 4, seed=2), plan.points(points)
    torch.testing.assert_close(
        (plan.type1(y, at) * x.conj()).sum(), (y * plan.type2(x, at).conj()).sum(), rtol=1e-12, atol=1e-12
    )


def test_a_single_point_is_exact_anywhere():
    """Also where the tap set changes, at rows and half rows, and at both ends of the circle."""
    plan = PulseNufft(32, Kernel(7), torch.complex128)
    points = torch.cat(
        [torch.linspace(-0.1, 1.1, 997, dtype=torch.float64), torch.arange(130, dtype=torch.float64) / 128]
    )[:, None]
    out = plan.type1(torch.ones(1, 1, dtype=torch.complex128), plan.points(points))[..., 0]
    assert (out - matrix(points[:, 0], 32)).abs().max() < 3 * Kernel(7).error


def test_trials_share_data_or_points():
    plan, points = PulseNufft(40, Kernel(6), torch.complex128), warped()
    y, at = noise(120, 3), plan.points(points)
    torch.testing.assert_close(plan.type1(y, at), plan.type1(y.expand(2, 120, 3), at))
    one = plan.points(points[1])
    torch.testing.assert_close(plan.type1(y.expand(5, 120, 3), one), plan.type1(y, one).expand(5, 40, 3))
    torch.testing.assert_close(torch.vmap(lambda p: plan.type1(y, plan.points(p)))(points), plan.type1(y, at))


def test_blocks_of_trials_and_columns_equal_one_pass(monkeypatch):
    plan, points, y, x = PulseNufft(40, Kernel(6), torch.complex128), warped(), noise(2, 120, 37), noise(2, 40, 37)
    at = plan.points(points)
    whole = plan.type1(y, at), plan.type2(x, at)
    monkeypatch.setattr("torchsar.focus.gridding.block_bytes_of", lambda device: 1)
    torch.testing.assert_close((plan.type1(y, at), plan.type2(x, at)), whole)


def test_parts_of_the_trilinear_form_are_each_others_gradients():
    weights, values, grid = (
        noise(2, *shape, dtype=torch.float64, seed=i).requires_grad_()
        for i, shape in enumerate([(5, 3), (5, 2), (9, 2)])
    )
    first = torch.tensor([[0, 2, 2, 5, 6], [6, 1, 0, 3, 3]])
    for function, parts in (
        (lambda w, v: trilinear("grid", 9, first, w, v), (weights, values)),
        (lambda w, g: trilinear("values", 0, first, w, g), (weights, grid)),
        (lambda v, g: trilinear("weights", 3, first, v, g), (values, grid)),
    ):
        assert torch.autograd.gradcheck(function, parts) and torch.autograd.gradgradcheck(function, parts)
    total = (trilinear("grid", 9, first, weights, values) * grid).sum()
    torch.testing.assert_close((trilinear("values", 0, first, weights, grid) * values).sum(), total)
    torch.testing.assert_close((trilinear("weights", 3, first, values, grid) * weights).sum(), total)


@pytest.mark.slow
@pytest.mark.parametrize("taps", [4, 7])
def test_two_derivatives_in_data_and_points(taps):
    plan = PulseNufft(6, Kernel(taps, 1.5), torch.complex128)
    points = (torch.rand(2, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(3))).requires_grad_()
    for function, x in ((plan.type1, noise(2, 3, 2).requires_grad_()), (plan.type2, noise(2, 6, 2).requires_grad_())):

        def of(x, p, function=function):
            return function(x, plan.points(p))

        assert torch.autograd.gradcheck(of, (x, points)) and torch.autograd.gradgradcheck(of, (x, points))


def test_gradient_in_the_points_is_that_of_the_direct_sum():
    plan, points, y = PulseNufft(40, Kernel(10), torch.complex128), warped().requires_grad_(), noise(2, 120, 3)
    got = torch.autograd.grad(plan.type1(y, plan.points(points)).abs().pow(4).sum(), points)[0]
    want = torch.autograd.grad((matrix(points, 40).mT @ y).abs().pow(4).sum(), points)[0]
    assert relative(got, want) < 1e-6
