"""Phase errors modulo 2 pi, and bounds of phases per pulse."""

from __future__ import annotations

import math

import pytest
import torch

from torchsar.metrics import phase_rmse, pulse_phase_bound_of_scene_rad, pulse_phase_bound_rad, residual_phase, strehl

DOUBLE = torch.complex128


def white(*shape: int, seed: int = 0) -> torch.Tensor:
    return 2 * math.pi * torch.rand(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def normal(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("n", [3, 7, 64, 401])
@pytest.mark.parametrize("cells", [0.0, 0.04, 0.3, 0.5, -0.49, 3.37, 1.5, -17.06, 31.9])
def test_a_linear_phase_of_any_fraction_of_a_cell_is_removed(n, cells):
    a, k = white(n), torch.arange(n, dtype=torch.float64)
    assert float(residual_phase(a + 5.0 + 2 * math.pi * cells / n * k, a).abs().max()) < 1e-9


def test_whole_turns_of_single_pulses_do_not_count():
    a, error = white(3, 50), 0.4 * normal(3, 50, seed=1)
    turns = 2 * math.pi * torch.round(1e3 * normal(3, 50, seed=2))
    torch.testing.assert_close(residual_phase(a + error + turns, a), residual_phase(a + error, a), atol=1e-8, rtol=0)


def test_errors_beyond_pi_are_not_unwrapped():
    """A smooth error of many turns is compared modulo 2 pi; unwrapping would make it a large
    one.
    """
    t = torch.linspace(-1, 1, 300, dtype=torch.float64)
    residual = residual_phase(200 * t**2, torch.zeros(300))
    assert float(residual.abs().max()) <= math.pi and 1.4 < float(phase_rmse(200 * t**2, torch.zeros(300))) < 1.9


def test_the_removed_line_maximises_the_coherence():
    """Any other slope or constant makes the mean phasor smaller or rotates it."""
    residual = residual_phase(0.8 * normal(4, 60, seed=3) + 0.05 * torch.arange(60), torch.zeros(60))
    k = torch.arange(60, dtype=torch.float64) - 29.5
    best = strehl(residual)
    for slope in (-0.02, -1e-4, 1e-4, 0.02):
        assert bool((strehl(residual + slope * k) < best).all())
    mean = torch.exp(1j * residual).mean(-1)
    assert float(torch.angle(mean).abs().max()) < 1e-12


def test_small_errors_equal_least_squares():
    error = 1e-4 * normal(80, seed=4)
    k = torch.arange(80, dtype=torch.float64)
    design = torch.stack([torch.ones_like(k), k], -1)
    expected = error - design @ torch.linalg.lstsq(design, error[:, None]).solution[:, 0]
    torch.testing.assert_close(residual_phase(error + 0.3 + 0.7 * k, torch.zeros(80)), expected, atol=1e-9, rtol=0)


def test_missing_pulses_do_not_count():
    a, error = white(2, 40), 0.2 * normal(2, 40, seed=5)
    present = torch.ones(2, 40, dtype=torch.bool)
    present[0, 3:20], present[1, ::2] = False, False
    wild = torch.where(present, a + error, 1e5 * normal(2, 40, seed=6))
    residual = residual_phase(wild, a, present)
    torch.testing.assert_close(
        residual, residual_phase(torch.where(present, a + error, 0), a, present), atol=1e-9, rtol=0
    )
    assert not residual[~present].any()
    torch.testing.assert_close(
        phase_rmse(wild, a, present)[0], residual[0][present[0]].square().mean().sqrt(), atol=1e-12, rtol=0
    )
    # the present pulses alone give the same result
    alone = residual_phase(wild[1, 1::2], a[1, 1::2])
    torch.testing.assert_close(residual[1, 1::2], alone, atol=1e-9, rtol=0)
    assert phase_rmse(wild, a, torch.zeros(40, dtype=torch.bool)).tolist() == [0, 0]


def test_white_phases_and_strehl():
    rmse = phase_rmse(white(50, 400), white(50, 400, seed=1))
    assert float(rmse.min()) > 1.55 and float(rmse.max()) < 1.75
    assert float(strehl(torch.zeros(9))) == pytest.approx(1) and float(strehl(0.47 * normal(20000))) == pytest.approx(
        0.8, abs=0.01
    )
    assert float(strehl(torch.tensor([0.0, math.pi]))) == pytest.approx(0, abs=1e-12)


def test_shapes_precision_and_batches():
    a, b = white(2, 3, 30), white(30, seed=1)
    together = residual_phase(a.float(), b)
    assert together.shape == (2, 3, 30) and together.dtype == torch.float64 and phase_rmse(a, b).shape == (2, 3)
    for i in range(2):
        for j in range(3):
            torch.testing.assert_close(residual_phase(a[i, j].float(), b), together[i, j], atol=1e-10, rtol=0)


@pytest.mark.parametrize("n", [1, 2])
def test_one_or_two_pulses_leave_no_residual(n):
    assert float(residual_phase(white(n), white(n, seed=1)).abs().max()) < 1e-9


def test_phases_of_different_pulses_are_refused():
    with pytest.raises(ValueError, match=r"phase needs an estimate and .* same pulses.* \(4, 32\) and \(4, 16\)$"):
        phase_rmse(torch.zeros(4, 32), torch.zeros(4, 16))


def test_non_finite_phases_raise():
    with pytest.raises(ValueError, match="1 of 3 phases are NaN"):
        residual_phase(torch.tensor([0.0, torch.nan, 0.0]), torch.zeros(3))


# bounds


def tiny(trials: int = 1, n_pulse: int = 6, n_range: int = 4, targets: int = 5, seed: int = 1):
    g = torch.Generator().manual_seed(seed)
    azimuth = torch.exp(
        2j * math.pi * torch.rand(trials, 1, targets, dtype=torch.float64, generator=g) * torch.arange(n_pulse)[:, None]
    )
    return (
        azimuth,
        torch.randn(trials, targets, n_range, dtype=DOUBLE, generator=g),
        torch.randn(trials, targets, dtype=DOUBLE, generator=g),
    )


def fisher_bound(azimuth, range_, amplitude, std):
    """Bound with all unknowns at once: phases without constant and line, and the real and imaginary
    parts of all amplitudes.
    """
    n, m = azimuth.shape
    k = torch.arange(n, dtype=torch.float64)
    free = torch.linalg.svd(torch.stack([torch.ones_like(k), k]), full_matrices=True)[2][2:].mT

    def samples(unknown):
        psi, parts = free @ unknown[: n - 2], unknown[n - 2 :].reshape(2, m)
        echo = torch.exp(1j * psi)[:, None] * ((azimuth * torch.complex(parts[0], parts[1])) @ range_)
        return torch.view_as_real(echo).flatten()

    at = torch.cat([torch.zeros(n - 2, dtype=torch.float64), amplitude.real, amplitude.imag])
    jacobian = torch.autograd.functional.jacobian(samples, at)
    covariance = torch.linalg.inv(2 / std**2 * jacobian.mT @ jacobian)
    return torch.sqrt(torch.trace(free @ covariance[: n - 2, : n - 2] @ free.mT) / n)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_bound_of_a_scene_equals_the_whole_fisher_matrix(seed):
    azimuth, range_, amplitude = tiny(2, seed=seed)
    bound = pulse_phase_bound_of_scene_rad(azimuth, range_, amplitude, 0.3)
    expected = torch.stack([fisher_bound(azimuth[i], range_[i], amplitude[i], 0.3) for i in range(2)])
    torch.testing.assert_close(bound, expected, rtol=1e-5, atol=0)


def test_bound_scales_and_counts_equal_positions_once():
    azimuth, range_, amplitude = tiny()
    bound = pulse_phase_bound_of_scene_rad(azimuth, range_, amplitude, 0.3)
    torch.testing.assert_close(
        pulse_phase_bound_of_scene_rad(azimuth, range_, 1e6 * amplitude, 0.15e6), bound / 2, rtol=1e-5, atol=0
    )
    positions, shapes, strengths = (
        torch.cat([azimuth, azimuth[..., :1]], -1),
        torch.cat([range_, range_[:, :1]], 1),
        torch.cat([amplitude, 0 * amplitude[:, :1]], -1),
    )
    torch.testing.assert_close(
        pulse_phase_bound_of_scene_rad(positions, shapes, strengths, 0.3), bound, rtol=1e-4, atol=0
    )


def test_bound_of_a_known_scene():
    """The phase of one pulse with known samples, estimated by correlation, reaches 1 / sqrt(2 N
    SNR); unknown amplitudes raise the bound.
    """
    echo = torch.exp(1j * torch.arange(64))
    noise = torch.randn(20000, 64, dtype=DOUBLE, generator=torch.Generator().manual_seed(1)) / math.sqrt(10.0)
    measured = torch.angle(((echo + noise) * echo.conj()).sum(-1)).std()
    assert float(measured / pulse_phase_bound_rad(10.0, 64)) == pytest.approx(1, abs=0.02)
    azimuth, range_, amplitude = tiny(n_pulse=40, n_range=16, targets=3)
    power = ((azimuth * amplitude[..., None, :]) @ range_).abs().square().mean()
    unknown, known = (
        pulse_phase_bound_of_scene_rad(azimuth, range_, amplitude, 0.1)[0],
        pulse_phase_bound_rad(power / 0.01, 16, 40),
    )
    assert known < unknown < 1.5 * known
    assert float(known / pulse_phase_bound_rad(power / 0.01, 16)) == pytest.approx(math.sqrt(38 / 40))
    snr = torch.tensor([0.0, 1.0])
    assert pulse_phase_bound_rad(snr, 16, 2).tolist() == [0.0, 0.0]  # nothing is left of two phases
    assert pulse_phase_bound_rad(snr, 16, 3)[0] == math.inf
