"""Bounds of non-uniform rotation against the Fisher information of the whole model by automatic
differentiation.
"""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from torchsar.core import Draws
from torchsar.metrics import rotation_bounds
from torchsar.radar.warp import warp
from torchsar.scene import Satellite

F64 = torch.float64
WAVELENGTH = 1.55e-6
K = torch.tensor([10.0, 1000.0, -3e4, 1e6], dtype=F64)
NAMES = ["omega_rad_s", "k1_per_s", "k2_per_s2", "k3_per_s3", "k4_per_s4", "yc_m"]


def points(count: int = 5, seed: int = 1) -> tuple[Tensor, Tensor, Tensor]:
    """Cross range, range, complex amplitude."""
    source = torch.Generator().manual_seed(seed)
    x, y, level, phase = (torch.rand(count, generator=source, dtype=F64) for _ in range(4))
    return 4 * (x - 0.5), 6 * (y - 0.5), torch.polar(0.5 + level, 2 * math.pi * phase)


def brute_force(
    x: Tensor,
    y: Tensor,
    amplitude: Tensor,
    noise_std: float,
    omega: float,
    k: Tensor,
    yc: float,
    prf_hz: float,
    n_pulse: int,
    free_centre: bool,
) -> Tensor:
    """Bounds from the Jacobian of the real and imaginary parts of all samples by motion, amplitudes
    and cross ranges; each scatterer has a row of its own.
    """
    time, c4, count, order = torch.arange(n_pulse, dtype=F64) / prf_hz, 4 * math.pi / WAVELENGTH, len(x), len(k)

    def samples(unknown: Tensor) -> Tensor:
        rate, terms, centre = unknown[0], unknown[1 : 1 + order], unknown[1 + order]
        real, imaginary, cross_range = unknown[2 + order :].view(3, count)
        phi = warp(time, terms)
        phase = -c4 * cross_range[:, None] * rate * phi + c4 / 2 * (y + centre)[:, None] * (rate * phi).square()
        echo = torch.complex(real, imaginary)[:, None] * torch.polar(torch.ones_like(phase), phase)
        return torch.view_as_real(echo).flatten()

    at = torch.cat(
        [torch.tensor([omega], dtype=F64), k, torch.tensor([yc], dtype=F64), amplitude.real, amplitude.imag, x]
    )
    jacobian = torch.func.jacrev(samples)(at)
    keep = torch.ones(len(at), dtype=torch.bool)
    keep[1 + order] = free_centre
    jacobian = jacobian[:, keep]
    scale = jacobian.square().sum(0).sqrt()
    inverse = torch.linalg.inv((jacobian / scale).mT @ (jacobian / scale)) * noise_std**2 / 2
    return (inverse.diagonal().sqrt() / scale)[: 1 + order + free_centre]


@pytest.mark.parametrize("free_centre", [True, False])
@pytest.mark.parametrize("order", [1, 2, 3, 4])
def test_equals_the_inverse_fisher_information_of_the_whole_model(order: int, free_centre: bool) -> None:
    x, y, amplitude = points()
    k = K[: order - 1]
    found = rotation_bounds(
        x, y, amplitude, 0.3, 0.02, k, 0.8, wavelength_m=WAVELENGTH, prf_hz=4e3, n_pulse=81, free_centre=free_centre
    )
    assert list(found) == NAMES[:order] + ["yc_m"] * free_centre
    expected = brute_force(x, y, amplitude, 0.3, 0.02, k, 0.8, 4e3, 81, free_centre)
    torch.testing.assert_close(torch.stack(list(found.values())), expected, rtol=1e-6, atol=0)


def satellite(snr_db: float, n_pulse: int = 10000, trials: int = 4, **shape: float) -> Tensor:
    """Relative bounds of Om, k1 and k2 and bound of yc in metres for the satellite scene, averaged
    over trials.
    """
    seen = Satellite(**{"count": 600, **shape}).scatterers(Draws(1, trials=range(trials)))  # pyright: ignore[reportArgumentType]
    # mean power of the samples: each scatterer occupies one of 128 range cells
    noise_std = (seen.amplitude.abs().square().sum(-1) / 128 * 10 ** (-snr_db / 10)).sqrt()
    found = rotation_bounds(
        seen.azimuth_m,
        seen.range_m,
        seen.amplitude,
        noise_std,
        0.02,
        K[:2],
        wavelength_m=WAVELENGTH,
        prf_hz=500e3,
        n_pulse=n_pulse,
    )
    return (torch.stack(list(found.values()), -1) / torch.tensor([0.02, 10.0, 1000.0, 1.0], dtype=F64)).mean(0)


def test_figures_of_the_satellite() -> None:
    """An independent float64 model gives 1.25, 0.016 and 0.015 % for Om, k1 and k2, and 0.03 m for
    yc, at -10 dB. The bounds fall as 10^(-SNR / 20).
    """
    low = satellite(-10.0)
    torch.testing.assert_close(low, torch.tensor([1.25e-2, 1.6e-4, 1.5e-4, 0.03], dtype=F64), rtol=0.35, atol=0)
    torch.testing.assert_close(satellite(20.0), low * 10**-1.5, rtol=1e-9, atol=0)


def test_bounds_fall_with_the_aperture_time() -> None:
    """An independent model of another scene gives 32, 5.3, 1.8, 0.8 and 0.23 % for Om at 5, 10, 15,
    20 and 30 ms; only the ratios are compared.
    """
    found = torch.stack([satellite(0.0, n)[:2] for n in (2500, 5000, 7500, 10000, 15000)])
    model = torch.tensor([[32, 0.23], [5.3, 0.04], [1.8, 0.015], [0.8, 0.007], [0.23, 0.003]], dtype=F64)
    # a bound at a fixed SNR also falls with the root of the pulses
    torch.testing.assert_close(found / found[3], model / model[3], rtol=0.25, atol=0)


def test_trials_broadcast() -> None:
    several = [points(seed=seed) for seed in range(3)]
    x, y, amplitude = (torch.stack(part) for part in zip(*several))
    noise, omega, yc = (
        torch.tensor([0.1, 1.0, 10.0], dtype=F64),
        torch.tensor([0.01, 0.02, 0.03], dtype=F64),
        torch.tensor([-1.0, 0.0, 2.0], dtype=F64),
    )
    k = torch.stack([K[:2], 0 * K[:2], -K[:2] / 10])
    kind = {"wavelength_m": WAVELENGTH, "prf_hz": 4e3, "n_pulse": 80}
    together = rotation_bounds(x, y, amplitude, noise, omega, k, yc, **kind)
    for i in range(3):
        alone = rotation_bounds(x[i], y[i], amplitude[i], float(noise[i]), float(omega[i]), k[i], float(yc[i]), **kind)
        for name, value in alone.items():
            torch.testing.assert_close(together[name][i], value, rtol=1e-9, atol=0)
    grid = rotation_bounds(x[0], y[0], amplitude[0].to(torch.complex64), noise[:, None], 0.02, k[None], **kind)
    assert grid["k1_per_s"].shape == (3, 3) and grid["yc_m"].dtype == F64


def test_bounds_of_unobservable_unknowns_are_infinite() -> None:
    x, y, amplitude = points()
    kind = {"wavelength_m": WAVELENGTH, "prf_hz": 4e3, "n_pulse": 80}

    def infinite(**changes) -> list[str]:
        values = {
            "cross_range_m": x,
            "range_m": y,
            "amplitude": amplitude,
            "noise_std": 0.1,
            "omega_rad_s": 0.02,
            "warp_k": K[:2],
            **kind,
            **changes,
        }
        found = rotation_bounds(**values)
        assert not any(value.isnan().any() for value in found.values())
        return [name for name, value in found.items() if torch.isinf(value).any()]

    assert infinite() == []
    assert infinite(range_m=0 * y) == ["omega_rad_s"]
    assert infinite(range_m=0 * y + 2.0) == ["omega_rad_s", "yc_m"]
    assert infinite(range_m=0 * y + 2.0, free_centre=False) == []
    assert (
        infinite(amplitude=0 * amplitude)
        == infinite(omega_rad_s=0.0)
        == infinite(noise_std=math.inf)
        == NAMES[:3] + ["yc_m"]
    )
    assert infinite(cross_range_m=x[:1], range_m=y[:1], amplitude=amplitude[:1]) == ["omega_rad_s", "yc_m"]
    assert infinite(n_pulse=3) == NAMES[:3], (
        "three pulses leave one curve after a constant and a line; it determines yc only"
    )
    assert infinite(n_pulse=1) == NAMES[:3] + ["yc_m"]
    assert infinite(noise_std=0.0) == []


def test_a_line_through_the_centre_leaves_the_rate_almost_unknown() -> None:
    """The bound is finite (condition number 2e9), but forty times that of points off the line."""
    x, y, amplitude = points(20)
    kind = {"wavelength_m": WAVELENGTH, "prf_hz": 4e3, "n_pulse": 80, "free_centre": False}
    line = rotation_bounds(y / 2, y, amplitude, 0.1, 0.02, K[:2], **kind)
    free = rotation_bounds(x, y, amplitude, 0.1, 0.02, K[:2], **kind)
    assert torch.isfinite(line["omega_rad_s"]) and line["omega_rad_s"] > 20 * free["omega_rad_s"]


def test_gradients() -> None:
    x, y, amplitude = points()
    kind = {"wavelength_m": WAVELENGTH, "prf_hz": 4e3, "n_pulse": 40}

    def logs(*values: Tensor) -> Tensor:
        return torch.stack(
            [
                value.log()
                for value in rotation_bounds(
                    values[0], values[1], values[2], values[3], values[4], 1e3 * values[5], **kind
                ).values()
            ]
        )

    noise, omega = torch.tensor(0.1, dtype=F64), torch.tensor(0.5, dtype=F64)
    assert torch.autograd.gradcheck(
        logs, [v.clone().requires_grad_() for v in (x, y, amplitude, noise, omega, K[:2] / 1e3)], atol=1e-4, rtol=1e-3
    )


def test_invalid_arguments_raise() -> None:
    x, y, amplitude = points()
    kind = {"wavelength_m": WAVELENGTH, "prf_hz": 4e3, "n_pulse": 40}
    with pytest.raises(ValueError, match=r"equally many targets, got the shapes \(5,\), \(4,\), \(5,\)"):
        rotation_bounds(x, y[:4], amplitude, 0.1, 0.02, K[:2], **kind)
    with pytest.raises(ValueError, match=r"warp_k must have the shape \(\.\.\., order - 1\)"):
        rotation_bounds(x, y, amplitude, 0.1, 0.02, K[0], **kind)
