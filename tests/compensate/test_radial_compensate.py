"""Range error from velocities, and its exact compensation in sweeps."""

from __future__ import annotations

import math

import pytest
import torch

from tests.compensate.radials import GATE, rms, seen, without_line
from tests.echo.ladars import COMMON, direct_sweeps
from torchsar.compensate import compensate_motion, radial_motion, range_error
from torchsar.compensate.radial.trajectory import (
    integrated_range,
    polynomial_phasor,
    sweep_motion,
    turning_points,
)
from torchsar.core import Axis, Estimate, Outcome
from torchsar.focus import compress_sweeps
from torchsar.radar import sweep_middles
from torchsar.scene import Polynomial, Scatterers
from torchsar.scene.motion import displacement_m
from torchsar.study.bench.direct.triangles import table1

RADAR = table1()


def true_motion(radar, n, motion=COMMON):
    """Velocity at the turning points by automatic differentiation, and the displacement."""
    pulse = radar.sweep_axes(n)[1]
    t = turning_points(radar, pulse).values() - pulse.start
    t.requires_grad_()
    (v,) = torch.autograd.grad(displacement_m(motion, t).sum(), t)
    return pulse, v, lambda at: displacement_m(motion, at - pulse.start)


def test_the_spline_integrates_to_picometres_and_rectangles_to_micrometres() -> None:
    """A cubic spline through the velocities is exact to picometres, a sum of rectangles is not."""
    pulse, v, position = true_motion(RADAR, 512)
    at = sweep_middles(RADAR, pulse)
    zero = turning_points(RADAR, pulse).values()[:1]
    true = position(at) - position(zero)
    assert float((integrated_range(v, RADAR, pulse, at) - true).abs().max()) < 1e-12
    rectangles = torch.cat([torch.zeros(1, dtype=torch.float64), v.cumsum(0)[:-1]]) * pulse.step
    assert 1e-6 < float((rectangles - true[0]).abs().max()) < 6e-6


def test_sweep_motion_is_the_spline() -> None:
    for n, keep in ((1, 1), (2, 1), (3, 4), (40, 4)):
        radar = table1(keep_every=keep)
        pulse, v, _ = true_motion(radar, n)
        u = radar.fast_time_axis().values()
        powers = u[:, None] ** torch.arange(5, dtype=torch.float64)
        found = (sweep_motion(v, radar, pulse)[..., None, :] * powers).sum(-1)
        torch.testing.assert_close(
            found, integrated_range(v, radar, pulse, sweep_middles(radar, pulse)[..., None] + u), atol=1e-15, rtol=1e-10
        )


@pytest.mark.parametrize("sign", ["lo_conj_echo", "echo_conj_lo"])
@pytest.mark.parametrize("motion", [COMMON, (Polynomial([5.0, 100.0]),)])
def test_compensated_sweeps_equal_static_ones(sign, motion) -> None:
    """Compensated sweeps equal direct sums for a static target.

    The residuals are the video terms 2 K dtau DR / c and that of DR alone.
    """
    radar = table1(dechirp_sign=sign)
    s = Scatterers(*(torch.tensor([x], dtype=torch.float64) for x in (0.0, 0.0)), torch.ones(1, dtype=torch.complex128))
    moving, still = direct_sweeps(s, radar, 24, motion), direct_sweeps(s, radar, 24)
    if sign == "echo_conj_lo":
        moving, still = moving.conj(), still.conj()
    pulse, v, position = true_motion(radar, 24, motion)
    found = compensate_motion(moving, v, radar, pulse)
    zero = turning_points(radar, pulse).values()[:1]
    constant = 4 * math.pi * float(position(zero)) / radar.wavelength_m * (1 if sign == "lo_conj_echo" else -1)
    left = torch.angle(
        found
        * still.conj()
        * torch.polar(torch.ones(1, dtype=torch.float64), -torch.tensor([constant], dtype=torch.float64))
    )
    # video phase of K (2 DR / c)^2 / 2 turns, and f(u) times the offset at the first turning point
    moved = (position(sweep_middles(radar, pulse)) * 2 / radar.wave_speed_m_s).abs().max()
    video = math.pi * radar.chirp_rate_hz_s * float(moved) ** 2
    band = math.pi * radar.bandwidth_hz * 2 * float(position(zero).abs()) / radar.wave_speed_m_s
    assert float(left.abs().max()) < 1.05 * (video + band) + 1e-6
    assert (
        float(
            torch.angle(compensate_motion(moving.to(torch.complex64), v, radar, pulse).to(moving) * found.conj())
            .abs()
            .max()
        )
        < 2e-5
    )


def test_envelopes_are_corrected_only_with_f_of_u() -> None:
    """At 5 m/s the range changes by 4 cm in 512 periods.

    The phase of the carrier alone leaves the envelopes displaced: a peak of 274 of 355, 352 with
    f(u).
    """
    sweeps, pulse, truth = seen(n=512, motion=(Polynomial([5.0, 100.0]),))
    v = truth.values["velocity_m_s"]
    peak = {}
    for only in (False, True):
        cells = compress_sweeps(compensate_motion(sweeps, v, RADAR, pulse, carrier_only=only), RADAR)
        turns = torch.fft.fft(
            cells * torch.polar(torch.ones(512, 1, dtype=torch.float64), -curve(pulse)), dim=0, n=2048
        )
        peak[only] = float(turns.abs().max())
    assert peak[False] > 0.955 * 512 * sinc_of_bin() and peak[True] < 0.87 * peak[False]


def curve(pulse: Axis) -> torch.Tensor:
    t = pulse.values()[:, None] + RADAR.period_s / 4
    return 2 * math.pi * (RADAR.speed_m_s * t).square() / (RADAR.wavelength_m * (RADAR.reference_range_m + 1.5))


def sinc_of_bin() -> float:
    """Response of the cell nearest to RD 1.5 m to a scatterer between two cells."""
    off = 1.5 / RADAR.range_step_m - round(1.5 / RADAR.range_step_m)
    return math.sin(math.pi * off) / (math.pi * off) if off else 1.0


def test_polynomial_phasor_in_both_precisions_and_under_vmap() -> None:
    g = torch.Generator().manual_seed(1)
    c = torch.randn(3, 2, 5, 6, dtype=torch.float64, generator=g) * torch.tensor(
        [1e6, 1e8, 1e12, 1e16, 1e20, 1e24], dtype=torch.float64
    )
    u = RADAR.fast_time_axis().values()
    turns = sum(c[..., k, None] * u**k for k in range(6))
    true = torch.polar(torch.ones_like(turns), 2 * math.pi * (turns - torch.round(turns)))
    for dtype, bound in ((torch.complex128, 1e-7), (torch.complex64, 1e-5)):
        found = polynomial_phasor(c, 1 / RADAR.sample_rate_hz, 512, dtype)
        assert found.dtype == dtype and float((found - true).abs().max()) < bound
        mapped = torch.vmap(lambda x, dtype=dtype: polynomial_phasor(x, 1 / RADAR.sample_rate_hz, 512, dtype))(c)
        assert float((mapped - true).abs().max()) < bound


def test_a_large_trial_does_not_degrade_small_quadratic_terms() -> None:
    sweeps, pulse, truth = seen(n=12, dtype=torch.complex64)
    v = truth.values["velocity_m_s"]
    wild = 5.0 * (-1.0) ** torch.arange(12, dtype=torch.float64)
    both = compensate_motion(torch.stack([sweeps, sweeps]), torch.stack([v, wild]), RADAR, pulse)
    assert float((both[0] - compensate_motion(sweeps, v, RADAR, pulse)).abs().max()) < 1e-6
    assert float((both[1] - compensate_motion(sweeps.to(torch.complex128), wild, RADAR, pulse)).abs().max()) < 1e-5


def test_range_error_adds_velocities_and_phases() -> None:
    pulse, v, position = true_motion(RADAR, 64)
    at = sweep_middles(RADAR, pulse)[0]
    bump = 3e-8 * torch.sin(2 * math.pi * 5 * torch.arange(64, dtype=torch.float64) / 64)
    phase = 4 * math.pi / RADAR.wavelength_m * bump
    one = torch.ones((), dtype=torch.bool)
    both = range_error(
        Estimate({"velocity_m_s": v, "phase_rad": phase}, quality=one.double(), outcome=Outcome.of(one, Outcome.NOISE)),
        RADAR,
        pulse,
        at,
    )
    torch.testing.assert_close(
        both, position(at) - position(turning_points(RADAR, pulse).values()[:1]) + bump, atol=1e-12, rtol=0
    )


def test_phase_has_the_sign_of_the_range() -> None:
    """With the wrong sign the chain would double the noise of the velocities."""
    sweeps, pulse, truth = seen(n=128, trials=2, snr_db=0.0)
    found = radial_motion(sweeps, RADAR, pulse, window_m=GATE)
    middle = sweep_middles(RADAR, pulse)[0]
    alone = Estimate({"velocity_m_s": found["velocity_m_s"]}, quality=found.quality, outcome=found.outcome)
    wrong = Estimate(
        {"velocity_m_s": found["velocity_m_s"], "phase_rad": -found["phase_rad"]},
        quality=found.quality,
        outcome=found.outcome,
    )
    error = [
        float(rms(without_line(range_error(e, RADAR, pulse, middle) - truth.values["range_error_up_m"])).mean())
        for e in (found, alone, wrong)
    ]
    assert error[0] < 0.3 * error[1] and error[2] > 1.7 * error[1]


def test_invalid_input_is_rejected() -> None:
    sweeps, pulse, truth = seen(n=4)
    v = truth.values["velocity_m_s"]
    with pytest.raises(ValueError, match="velocity_m_s must hold one velocity per period"):
        compensate_motion(sweeps, v[:3], RADAR, pulse)
    with pytest.raises(ValueError, match=r"1 of \d+ velocities are NaN or Inf"):
        compensate_motion(sweeps, torch.where(v == v[1], torch.nan, v), RADAR, pulse)
    with pytest.raises(TypeError, match="complex samples"):
        compensate_motion(sweeps.real, v, RADAR, pulse)
