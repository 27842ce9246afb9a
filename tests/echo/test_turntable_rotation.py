"""Echoes of targets with a changing rotation rate against direct summation.

Reference:
    Remote Sens. 2025, 17, 3447, Eq. (3).
"""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from torchsar.core import Draws
from torchsar.echo import dechirped_echo, simulate_turntable, turntable_echo
from torchsar.focus import compress_dechirped
from torchsar.radar import LIGHT_M_S, InverseRadar
from torchsar.radar.warp import coefficients_of
from torchsar.scene import Dechirped, PhaseOnly, Points, PolynomialRotation, RandomPoints, Scatterers, TurntableWorld

DOUBLE = torch.complex128
LAMBDA = 1.55e-6
TRUE_K = (10.0, 1000.0, -4e4)
ROTATION = PolynomialRotation(0.02, TRUE_K[:2])
CUBES = RandomPoints(7, 0.12, 0.3)


def ladar(
    n_pulse: int, duration_s: float = 0.02, range_step_m: float = 0.015, pulse_s: float | None = 4e-6, **changes
) -> InverseRadar:
    """A ladar at 1.55 um over 20 ms, with as many pulses as a test affords."""
    return InverseRadar(
        LIGHT_M_S / LAMBDA, LIGHT_M_S / (2 * range_step_m), n_pulse / duration_s, pulse_s=pulse_s, **changes
    )


def unit(turns: Tensor) -> Tensor:
    """Unit phasors of phases in cycles."""
    return torch.polar(torch.ones_like(turns), 2 * math.pi * (turns - torch.round(turns)))


def turned(time_s: Tensor, omega: float, k: tuple[float, ...]) -> Tensor:
    """theta with its factorials written out."""
    return omega * (time_s + sum(value * time_s ** (i + 2) / math.factorial(i + 2) for i, value in enumerate(k)))


def direct_compressed(
    s: Scatterers, radar: InverseRadar, n_pulse: int, n_range: int, omega: float, k: tuple[float, ...], yc: float
) -> Tensor:
    """Scatterer by scatterer and frequency by frequency."""
    theta = turned(torch.arange(n_pulse, dtype=torch.float64) / radar.prf_hz, omega, k)[:, None]
    cell = torch.arange(n_range, dtype=torch.float64) - n_range // 2
    out = torch.zeros(n_pulse, n_range, dtype=DOUBLE)
    for x, y, a in zip(s.azimuth_m, s.range_m, s.amplitude, strict=True):
        response = unit(cell[:, None] * (cell - y / radar.range_step_m) / n_range).mean(0)
        out += a * response * unit(-2 / LAMBDA * (x * torch.sin(theta) - 2 * (y + yc) * torch.sin(theta / 2).square()))
    return out


def direct_dechirped(
    s: Scatterers,
    radar: InverseRadar,
    n_pulse: int,
    n_fast: int,
    omega: float,
    k: tuple[float, ...],
    yc: float,
    curved: bool = False,
) -> Tensor:
    """Sum over scatterers with the angle at every sample; `curved`: spherical wavefronts."""
    assert radar.pulse_s is not None
    fast = (torch.arange(n_fast, dtype=torch.float64) - n_fast // 2) * radar.pulse_s / n_fast
    theta = turned(torch.arange(n_pulse, dtype=torch.float64)[:, None] / radar.prf_hz + fast, omega, k)
    out = torch.zeros(n_pulse, n_fast, dtype=DOUBLE)
    for x, y, a in zip(s.azimuth_m, s.range_m, s.amplitude, strict=True):
        change = x * torch.sin(theta) - 2 * (y + yc) * torch.sin(theta / 2).square()
        if curved:
            across, far = x * torch.cos(theta) - (y + yc) * torch.sin(theta), radar.reference_range_m + y + change
            change = change + across.square() / (torch.sqrt(far.square() + across.square()) + far)
        delay = 2 * (y + change) / radar.wave_speed_m_s
        out += a * unit(
            -(
                radar.carrier_hz * 2 * change / radar.wave_speed_m_s
                + radar.chirp_rate_hz_s * (fast * delay - delay.square() / 2)
            )
        )
    return out


@pytest.mark.parametrize("yc", [0.0, -1.5, 0.7])
@pytest.mark.parametrize("order", [1, 2, 3, 4])
def test_phase_only_equals_direct_sums(order: int, yc: float) -> None:
    s, radar, k = CUBES.scatterers(Draws(order)), ladar(70), TRUE_K[: order - 1]
    expected = direct_compressed(s, radar, 70, 32, 0.1745, k, yc)
    rotation = PolynomialRotation(0.1745, k)
    torch.testing.assert_close(turntable_echo(s, radar, 70, 32, rotation, DOUBLE, yc), expected, atol=2e-10, rtol=0)
    torch.testing.assert_close(
        turntable_echo(s, radar, 70, 32, rotation, centre_deviation_m=yc).to(DOUBLE), expected, atol=1e-5, rtol=0
    )


@pytest.mark.parametrize("yc", [0.0, -1.5, 0.7])
@pytest.mark.parametrize("order", [1, 2, 3, 4])
def test_dechirped_equals_direct_sums(order: int, yc: float) -> None:
    """Angular acceleration within a pulse matters: in 4 us it changes phases by 1e-5 rad here."""
    s, radar, k = CUBES.scatterers(Draws(order)), ladar(70), TRUE_K[: order - 1]
    expected = direct_dechirped(s, radar, 70, 32, 0.1745, k, yc)
    rotation = PolynomialRotation(0.1745, k)
    torch.testing.assert_close(
        dechirped_echo(s, radar, 70, 32, rotation, dtype=DOUBLE, centre_deviation_m=yc), expected, atol=1e-7, rtol=0
    )
    torch.testing.assert_close(
        dechirped_echo(s, radar, 70, 32, rotation, centre_deviation_m=yc).to(DOUBLE), expected, atol=1e-5, rtol=0
    )


def test_an_order_of_one_is_the_uniform_rotation_from_the_first_pulse() -> None:
    s, radar = CUBES.scatterers(Draws(1)), ladar(9)
    even, polynomial = (
        turntable_echo(s, radar, n, 32, rotation, DOUBLE) for n, rotation in ((9, 0.1), (5, PolynomialRotation(0.1)))
    )
    torch.testing.assert_close(even[4:], polynomial, atol=1e-10, rtol=0)


def test_the_factors_of_two_and_six() -> None:
    t = torch.tensor([0.0, 0.004, 0.02], dtype=torch.float64)
    torch.testing.assert_close(ROTATION.angle(t), 0.02 * t + 0.2 * t**2 / 2 + 20 * t**3 / 6, rtol=1e-14, atol=0)
    torch.testing.assert_close(ROTATION.rate(t), 0.02 + 0.2 * t + 20 * t**2 / 2, rtol=1e-14, atol=0)
    torch.testing.assert_close(ROTATION.acceleration(t), 0.2 + 20 * t, rtol=1e-12, atol=0)
    torch.testing.assert_close(
        coefficients_of(ROTATION.warp_k(t)), torch.tensor([10 / 2, 1000 / 6], dtype=torch.float64), rtol=1e-15, atol=0
    )
    fourth = PolynomialRotation(0.02, TRUE_K)
    torch.testing.assert_close(fourth.acceleration(t), 0.02 * (10 + 1000 * t - 4e4 * t**2 / 2), rtol=1e-12, atol=0)
    torch.testing.assert_close(float(ROTATION.mean_rate(0.02, t)) * 0.02, 0.467e-3, rtol=1e-3, atol=0)


def test_numbers_tensors_and_one_tensor_of_k_mean_the_same() -> None:
    t, k1, k2 = (
        torch.linspace(0, 0.02, 5, dtype=torch.float64),
        torch.tensor([10.0, 20.0]),
        torch.tensor([1000.0, -500.0]),
    )
    angle = PolynomialRotation(torch.tensor([0.02, 0.03]), (k1, k2)).angle(t)
    assert angle.shape == (2, 5)
    torch.testing.assert_close(
        PolynomialRotation(torch.tensor([0.02, 0.03]), torch.stack([k1, k2], -1)).angle(t), angle
    )
    torch.testing.assert_close(angle[1], turned(t, float(torch.tensor(0.03)), (20.0, -500.0)), rtol=1e-13, atol=0)
    assert PolynomialRotation(0.02, (10.0, k2)).angle(t).shape == (2, 5)
    assert PolynomialRotation(0.02, torch.empty(0)).angle(t).shape == (5,)


@pytest.mark.parametrize("fidelity", [PhaseOnly(), Dechirped()])
def test_batches_equal_singles(fidelity) -> None:
    omega, k1, yc = (
        torch.tensor(v, dtype=torch.float64) for v in ([0.17, 0.2, 0.1], [6.0, -10.0, 0.0], [0.0, -0.5, 0.8])
    )
    radar, snr = ladar(66), torch.tensor([10.0, 0.0, 20.0], dtype=torch.float64)
    world = TurntableWorld(
        CUBES, snr_db=snr, fidelity=fidelity, rotation=PolynomialRotation(omega, (k1, 1100.0)), centre_deviation_m=yc
    )
    whole, truth = simulate_turntable(radar, world, 66, 32, Draws(2, trials=range(3)), dtype=DOUBLE)
    for i in range(3):
        one = TurntableWorld(
            CUBES,
            snr_db=float(snr[i]),
            fidelity=fidelity,
            rotation=PolynomialRotation(float(omega[i]), (float(k1[i]), 1100.0)),
            centre_deviation_m=float(yc[i]),
        )
        single, alone_truth = simulate_turntable(radar, one, 66, 32, Draws(2, trials=[i]), dtype=DOUBLE)
        torch.testing.assert_close(single.signal.data[0], whole.signal.data[i], atol=1e-11, rtol=0)
        for name in ("omega_rad_s", "warp_k", "yc_m", "rotation_rad_s", "noise_std"):
            torch.testing.assert_close(alone_truth.values[name][0], truth.values[name][i])


@pytest.mark.parametrize("fidelity", [PhaseOnly(), Dechirped()])
def test_the_truth_holds_the_rotation(fidelity) -> None:
    world = TurntableWorld(CUBES, fidelity=fidelity, rotation=ROTATION, centre_deviation_m=-1.5)
    _, truth = simulate_turntable(ladar(20), world, 20, 32, Draws(2, trials=range(3)))
    assert (
        truth.values["warp_k"].tolist() == [[10.0, 1000.0]] * 3
        and truth.values["yc_m"].tolist() == [-1.5] * 3
        and truth.values["omega_rad_s"].tolist() == [0.02] * 3
    )
    torch.testing.assert_close(
        truth.values["rotation_rad_s"],
        torch.full((3,), 0.02 * (1 + 10 * 0.02 / 2 + 1000 * 0.02**2 / 6), dtype=torch.float64),
    )
    _, alone = simulate_turntable(ladar(20), world, 20, 32, Draws(2))
    assert alone.values["omega_rad_s"].shape == () and alone.values["warp_k"].shape == (2,)
    _, even = simulate_turntable(
        ladar(20, rotation_rad_s=0.1), TurntableWorld(CUBES, fidelity=fidelity), 20, 32, Draws(2)
    )
    assert not {"omega_rad_s", "warp_k", "yc_m"} & set(even.values)


@pytest.mark.parametrize("level", ["a", "b"])
def test_echoes_are_differentiable_in_the_rotation(level: str) -> None:
    s, radar = RandomPoints(3, 2e-3, 0.05).scatterers(Draws(3)), ladar(4)

    def echo(x: Tensor, omega: Tensor, k: Tensor, yc: Tensor) -> Tensor:
        scatterers, rotation = (
            Scatterers(1e-3 * x, s.range_m, s.amplitude),
            PolynomialRotation(1e-2 * omega, k * torch.tensor([1.0, 100.0])),
        )
        if level == "a":
            return turntable_echo(scatterers, radar, 4, 5, rotation, DOUBLE, yc)
        return dechirped_echo(scatterers, radar, 4, 5, rotation, dtype=DOUBLE, centre_deviation_m=yc)

    numbers = ([2.0, 1.0], [[10.0, 10.0], [-6.0, 11.0]], [0.1, -0.2])
    inputs = (1e3 * s.azimuth_m, *(torch.tensor(v, dtype=torch.float64) for v in numbers))
    assert torch.autograd.gradcheck(echo, [v.requires_grad_() for v in inputs], eps=1e-6, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("width_m, difference", [(3.2, 4.5e-5), (12.86, 1.8e-4)])
def test_angles_instead_of_sines_do_not_matter(width_m: float, difference: float) -> None:
    """Angles instead of sines change 4.5e-5 of the data for a small target with A = 0.47 mrad.

    The difference grows with the width, as x theta^3 / 6.
    """
    s, radar = RandomPoints(60, width_m, 6.8).scatterers(Draws(1)), ladar(500, range_step_m=0.12)
    theta = ROTATION.angle(torch.arange(500, dtype=torch.float64) / radar.prf_hz)[:, None]
    exact, short = turntable_echo(s, radar, 500, 64, ROTATION, DOUBLE), torch.zeros(500, 64, dtype=DOUBLE)
    for x, y, a in zip(s.azimuth_m, s.range_m, s.amplitude, strict=True):
        still = turntable_echo(Scatterers(x[None], y[None], a[None]), radar, 1, 64, 0.0, DOUBLE)
        short += unit(-2 / LAMBDA * (x * theta - y * theta.square() / 2)) * still
    assert float((exact - short).norm() / exact.norm()) == pytest.approx(difference, rel=0.15)


@pytest.mark.parametrize("cells, loss_db", [(0.012, 0.001), (0.075, 0.02), (0.19, 0.15), (0.37, 0.6), (0.75, 2.4)])
def test_loss_by_migration(cells: float, loss_db: float) -> None:
    """Peak loss of a migrating envelope over its migration x A in range cells.

    The losses are those of an independent float64 model.
    """
    x, angle = 6.43, float(ROTATION.mean_rate(0.02, torch.zeros(0))) * 0.02
    radar = ladar(400, range_step_m=x * angle / cells, pulse_s=1e-9)
    s = Points([x], [0.0]).scatterers(Draws(0))
    theta = ROTATION.angle(torch.arange(400, dtype=torch.float64) / radar.prf_hz)
    focus = unit(2 / LAMBDA * x * torch.sin(theta))[:, None]
    fixed = (turntable_echo(s, radar, 400, 16, ROTATION, DOUBLE) * focus).mean(0).abs().max()
    moving = (
        (compress_dechirped(dechirped_echo(s, radar, 400, 16, ROTATION, dtype=DOUBLE), radar) * focus)
        .mean(0)
        .abs()
        .max()
    )
    assert float(fixed) == pytest.approx(1.0, abs=1e-9)
    assert -20 * math.log10(float(moving)) == pytest.approx(loss_db, rel=0.35 if loss_db < 0.1 else 0.1)


@pytest.mark.parametrize("x, y, yc", [(0.1, 0.06, 0.0), (-0.09, -0.03, 0.4), (0.02, 0.1, -1.5)])
def test_phase_only_predicts_what_it_neglects(x: float, y: float, yc: float) -> None:
    s, radar = Points([x], [y]).scatterers(Draws(0)), ladar(41, pulse_s=1e-7)
    rotation = PolynomialRotation(0.1745, (6.0, 1100.0))
    b = direct_dechirped(s, radar, 41, 33, 0.1745, (6.0, 1100.0), yc)
    a = torch.fft.fftshift(
        torch.fft.fft(torch.fft.ifftshift(turntable_echo(s, radar, 41, 33, rotation, DOUBLE, yc), dim=-1), dim=-1),
        dim=-1,
    )
    worst = float(torch.angle(b * a.conj()).abs().max())
    predicted = PhaseOnly().neglected_phase_rad(radar, 41, x, y, rotation_rad_s=rotation, centre_deviation_m=yc)
    assert 0.6 * predicted <= worst <= predicted


def test_neglected_migration_is_pi_times_the_cells_of_the_whole_angle() -> None:
    radar, rotation = (
        ladar(100, pulse_s=1e-8),
        PolynomialRotation(torch.tensor([0.02, -0.04], dtype=torch.float64), TRUE_K[:2]),
    )
    angle = 2 * 0.467e-3
    predicted = PhaseOnly().neglected_phase_rad(radar, 100, 6.43, 0.0, rotation_rad_s=rotation)
    assert predicted == pytest.approx(math.pi * 6.43 * angle / radar.range_step_m, rel=0.03)
    assert predicted == pytest.approx(
        2 * PhaseOnly().neglected_phase_rad(radar, 100, 6.43, 0.0, rotation_rad_s=angle / 0.02), rel=0.03
    )


def test_dechirped_predicts_what_it_neglects() -> None:
    radar, k = ladar(41, reference_range_m=2000.0), (6.0, 1100.0)
    s = Points([0.1], [0.06]).scatterers(Draws(0))
    plane, curved = (direct_dechirped(s, radar, 41, 8, 0.1745, k, 0.9, c) for c in (False, True))
    phase = torch.angle(curved * plane.conj() * (curved[0, 4] * plane[0, 4].conj()).conj())
    predicted = Dechirped().neglected_phase_rad(radar, 41, 0.1, 0.06, PolynomialRotation(0.1745, k), 0.9)
    # the bound takes the worse of the two senses of rotation, and the angle at the end of the last
    # period
    assert 1.0 < predicted < 3.0 and 0.85 * predicted < float(phase.abs().max()) < predicted


REFUSED = {
    "omega": (lambda: PolynomialRotation(math.nan), "omega_rad_s of a rotation must be a finite number"),
    "k": (
        lambda: PolynomialRotation(0.02, (10.0, torch.tensor([1.0, math.inf]))),
        "k2 of a rotation must be a finite number",
    ),
    "k tensor": (
        lambda: PolynomialRotation(0.02, torch.tensor([[1.0, math.inf]])),
        "k2 of a rotation must be a finite number",
    ),
    "k scalar": (
        lambda: PolynomialRotation(0.02, torch.tensor(10.0)),
        r"k of a rotation must be a sequence of numbers, got tensor\(10.\); put one number in brackets",
    ),
    "both": (
        lambda: TurntableWorld(CUBES, 0.02, rotation=ROTATION),
        "rotation_rad_s=0.02 and a polynomial rotation are both given for the world; give one of them",
    ),
    "type": (
        lambda: TurntableWorld(CUBES, rotation=0.02),
        r"PolynomialRotation\(omega_rad_s\) or None, got 0.02",
    ),  # pyright: ignore[reportArgumentType]
    "yc": (lambda: TurntableWorld(CUBES, centre_deviation_m=math.inf), "centre_deviation_m must be a finite number"),
    "turning back": (
        lambda: simulate_turntable(
            ladar(20), TurntableWorld(CUBES, rotation=PolynomialRotation(0.02, (-100.0, 2000.0))), 20, 32, Draws(0)
        ),
        "the rotation rate falls to -0.6 of its first value within the 0.02 s of the record",
    ),
    "one of two turns back": (
        lambda: dechirped_echo(
            CUBES.scatterers(Draws(0)),
            ladar(20),
            20,
            32,
            PolynomialRotation(0.02, (torch.tensor([10.0, -100.0]), 2000.0)),
        ),
        "the rotation rate falls to -0.6 of its first value",
    ),
    "jerk in a pulse": (
        lambda: dechirped_echo(
            CUBES.scatterers(Draws(0)), ladar(20, pulse_s=9e-4), 20, 32, PolynomialRotation(1e-4, (0.0, 0.0, 1e9))
        ),
        "the target turns by .* rad in half a pulse, for which the dechirped model neglects a phase of .* rad",
    ),
}


@pytest.mark.parametrize("attempt, sentence", REFUSED.values(), ids=list(REFUSED))
def test_impossible_rotations_are_refused(attempt, sentence: str) -> None:
    with pytest.raises((ValueError, TypeError), match=sentence):
        attempt()


def test_a_rate_that_falls_only_after_the_record_is_fine() -> None:
    rotation = PolynomialRotation(0.02, (-100.0, 2000.0))
    rotation.refuse_turning_back(0.01)
    assert torch.isfinite(turntable_echo(CUBES.scatterers(Draws(0)), ladar(20, 0.01), 20, 32, rotation)).all()
