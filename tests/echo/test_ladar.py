"""Sweeps of a triangular ladar: against direct sums, each model against the next, and worlds."""

from __future__ import annotations

import math
from dataclasses import replace
from decimal import Decimal, getcontext

import pytest
import torch
from torch import Tensor

from tests.echo.ladars import COMMON, DOUBLE, THREE, direct_sweeps, table4
from torchsar.core import Draws, Recording
from torchsar.echo import PolynomialSweepError, SinusoidSweepError, ladar_echo, simulate_ladar
from torchsar.echo.sweep_error import calibration_channel
from torchsar.radar import TriangularLadar
from torchsar.scene import (
    CalibrationFibre,
    EverySample,
    LadarWorld,
    LetterE,
    LinearInSweep,
    LogAmplitude,
    OnePerPeriod,
    OnePerSweep,
    PathFluctuation,
    Points,
    Polynomial,
    QuadraticInSweep,
    RandomPoints,
    Scatterers,
    Sinusoid,
    Speckle,
)
from torchsar.scene.ladar_range import Extremes
from torchsar.scene.motion import displacement_m
from torchsar.study.bench.direct.triangles import table1

FAST = (Polynomial([5.0, 100.0]),)


def difference(found: Tensor, expected: Tensor) -> float:
    """Rms difference relative to the signal."""
    return float((found - expected).norm() / expected.norm())


@pytest.mark.parametrize("motion", [COMMON, FAST, ()], ids=["common", "fast", "none"])
@pytest.mark.parametrize("flight", [False, True])
def test_every_sample_equals_direct_sums(motion, flight: bool) -> None:
    s = RandomPoints(5, 0.2, 1.0, range_m=1.2, spread_db=10.0).scatterers(Draws(2))
    expected = direct_sweeps(s, table1(), 24, motion, flight)
    level = EverySample(() if flight else ("flight",))
    assert difference(ladar_echo(s, table1(), 24, motion, level, dtype=DOUBLE), expected) < (2e-5 if flight else 1e-8)
    assert difference(ladar_echo(s, table1(), 24, motion, level), expected) < (2e-5 if flight else 3e-7)


def test_models_differ_by_known_amounts() -> None:
    """0.17 to 0.46 % of the signal, as measured with an independent float64 model."""
    s = THREE.scatterers(Draws(0))
    expected, fast = direct_sweeps(s, table1(), 512, COMMON), direct_sweeps(s, table1(), 128, FAST)
    assert 0.0015 < difference(ladar_echo(s, table1(), 512, COMMON, LinearInSweep()), expected) < 0.002
    assert 0.004 < difference(ladar_echo(s, table1(), 128, FAST, LinearInSweep()), fast) < 0.007
    assert difference(ladar_echo(s, table1(), 512, COMMON, QuadraticInSweep()), expected) < 3e-6
    assert difference(ladar_echo(s, table1(), 128, FAST, QuadraticInSweep()), fast) < 1e-6
    assert difference(ladar_echo(s, table1(), 128, FAST, OnePerSweep()), fast) > 1


def worst_phase(a: Tensor, b: Tensor) -> float:
    return float(torch.angle(a * b.conj()).abs().max())


CASES = {
    "lines": (
        table1(speed_m_s=0.0),
        LinearInSweep(),
        (Polynomial([5.0, 500.0]),),
        1.5,
        Extremes(velocity_m_s=5.0, acceleration_m_s2=1000.0),
    ),
    "parabolas": (
        table1(speed_m_s=0.0),
        QuadraticInSweep(),
        (Polynomial([0.0, 0.0, 5e8]),),
        1.5,
        Extremes(jerk_m_s3=3e9),
    ),
    "sweeps": (table1(speed_m_s=0.0), OnePerSweep(), (Polynomial([0.04]),), 1.5, Extremes(velocity_m_s=0.04)),
    "periods": (table1(speed_m_s=0.0), OnePerPeriod(), (Polynomial([0.04]),), 1.5, Extremes(velocity_m_s=0.04)),
    "video": (table1(), EverySample(("flight", "residual_video")), (), 2.0, Extremes((0.0, 2.0))),
    "hyperbola": (
        table1(reference_range_m=10.0, speed_m_s=0.0),
        EverySample(("flight", "hyperbola")),
        (),
        0.0,
        Extremes(across_m=0.2),
    ),
    "flight": (
        table1(speed_m_s=0.0, reference_range_m=30.0, period_s=1.6e-3, sample_rate_hz=160e3),
        EverySample(),
        (Polynomial([0.0, 3.0]),),
        0.0,
        Extremes(velocity_change_m_s=6 * 4.8e-3),
    ),
}


@pytest.mark.parametrize("radar, level, motion, range_m, extremes", CASES.values(), ids=list(CASES))
def test_models_predict_what_they_neglect(
    radar: TriangularLadar, level, motion, range_m: float, extremes: Extremes
) -> None:
    """Against the sum with all effects: the prediction is met to a few percent."""
    s = Points([0.2 if extremes.across_m else 0.0], [range_m]).scatterers(Draws(0))
    full = EverySample(() if extremes.velocity_change_m_s else ("flight",))
    n_period = 3 if extremes.velocity_change_m_s else 1
    worst = worst_phase(
        ladar_echo(s, radar, n_period, motion, level, dtype=DOUBLE),
        ladar_echo(s, radar, n_period, motion, full, dtype=DOUBLE),
    )
    predicted = sum(level.neglected_phase_rad(radar, extremes).values())
    assert 0.9 * predicted <= worst <= 1.01 * predicted, (worst, predicted)


def test_included_effects_are_not_predicted_as_neglected() -> None:
    assert EverySample(()).neglected_phase_rad(table1(), Extremes((1.0, 2.0), 0.2, 1.0, 1.0, 1.0, 1.0)) == {}
    assert set(LinearInSweep().neglected_phase_rad(table1(), Extremes())) == {"level", "flight"}
    # 0.7 rad between up-sweep and down-sweep at the relative range 10.5 +- 0.2 m of Table 4
    assert 2 * EverySample(("residual_video",)).neglected_phase_rad(table4(), Extremes((10.3, 10.7)))[
        "residual_video"
    ] == pytest.approx(0.7, abs=0.05)
    assert EverySample(("hyperbola",)).neglected_phase_rad(table1(), Extremes(across_m=0.25))[
        "hyperbola"
    ] == pytest.approx(1.5e-7, rel=0.05)


def test_a_world_in_both_dechirp_signs_is_conjugate() -> None:
    world = LadarWorld(LetterE(), COMMON, LogAmplitude(0.1), 10.0, calibration=CalibrationFibre(50e-9, 20.0))
    one, other = (
        simulate_ladar(table1(dechirp_sign=sign), world, 8, Draws(1, trials=range(2)))[0]
        for sign in ("lo_conj_echo", "echo_conj_lo")
    )
    assert torch.equal(one.signal.data, other.signal.data.conj()) and torch.equal(
        one.aux["calibration"], other.aux["calibration"].conj()
    )


@pytest.mark.parametrize(
    "level", [LinearInSweep(), QuadraticInSweep(()), EverySample()], ids=["line", "parabola", "sample"]
)
def test_batch_equals_singles(level) -> None:
    """Trials depend on their address only; every random part differs between them."""
    snr = torch.tensor([0.0, 40.0, -10.0], dtype=torch.float64)
    amplitude = torch.tensor([1e-5, 2e-5, 3e-5], dtype=torch.float64)

    def world(pick) -> LadarWorld:
        motion = (Sinusoid(amplitude[pick], 200.0), Polynomial([0.2]), PathFluctuation(1e-6))
        return LadarWorld(
            Speckle(6, 0.2, 0.5, range_m=1.5),
            motion,
            LogAmplitude(0.1),
            snr[pick],
            level,
            sweep_error=SinusoidSweepError(1e6, 2e5),
            calibration=CalibrationFibre(5e-8, 10.0),
        )

    together, truth = simulate_ladar(
        table1(beam_rad=114e-6), world(slice(None)), 6, Draws(5, trials=[4, 0, 7]), dtype=DOUBLE
    )
    for row, trial in enumerate([4, 0, 7]):
        alone, known = simulate_ladar(
            table1(beam_rad=114e-6), world(slice(row, row + 1)), 6, Draws(5, trials=[trial]), dtype=DOUBLE
        )
        torch.testing.assert_close(together.signal.data[row], alone.signal.data[0], atol=1e-11, rtol=0)
        torch.testing.assert_close(
            truth.values["velocity_m_s"][row], known.values["velocity_m_s"][0], atol=1e-14, rtol=1e-12
        )
        assert torch.equal(together.aux["calibration"][row], alone.aux["calibration"][0])
    plain = simulate_ladar(table1(), LadarWorld(LetterE(), COMMON, snr_db=10.0), 6, Draws(5), dtype=DOUBLE)[0].signal
    assert plain.data.shape == (2, 6, 512) and plain.names == ("ramp", "pulse", "fast_time")


def test_truth_describes_the_motion_at_its_epochs() -> None:
    radar = table1()
    world = LadarWorld(THREE, COMMON, LogAmplitude(0.1), snr_db=20.0)
    recording, truth = simulate_ladar(radar, world, 32, Draws(0, trials=range(2)))
    since = radar.pulse_step_s * torch.arange(32, dtype=torch.float64)
    for name, share in (("range_error_m", 0.5), ("range_error_up_m", 0.25), ("range_error_down_m", 0.75)):
        torch.testing.assert_close(
            truth.values[name],
            displacement_m(COMMON, since + share * radar.period_s).expand(2, -1),
            atol=1e-16,
            rtol=1e-12,
        )
    step = 1e-7
    around = since + radar.period_s / 2
    slope = (displacement_m(COMMON, around + step) - displacement_m(COMMON, around - step)) / (2 * step)
    torch.testing.assert_close(truth.values["velocity_m_s"], slope.expand(2, -1), atol=1e-8, rtol=0)
    assert truth.clean is not None and truth.clean.signal.data.shape == recording.signal.data.shape == (2, 2, 32, 512)
    early = simulate_ladar(radar, LadarWorld(THREE, COMMON, fidelity=LinearInSweep(())), 32, Draws(0))[1]
    lag = radar.reference_range_m / radar.wave_speed_m_s
    torch.testing.assert_close(
        early.values["range_error_m"], displacement_m(COMMON, around - lag), atol=1e-16, rtol=1e-12
    )


def test_clean_has_the_noise_and_scintillation_but_no_motion() -> None:
    still = simulate_ladar(table1(), LadarWorld(THREE, (), LogAmplitude(0.2), 5.0), 8, Draws(3, trials=[1]))[0]
    truth = simulate_ladar(table1(), LadarWorld(THREE, COMMON, LogAmplitude(0.2), 5.0), 8, Draws(3, trials=[1]))[1]
    assert truth.clean is not None and torch.equal(still.signal.data, truth.clean.signal.data)


@pytest.mark.parametrize("snr_db", [-20.0, 100.0])
def test_noise_is_per_sample_of_a_unit_point(snr_db: float) -> None:
    world = LadarWorld(Points([0.0], [1.5]), snr_db=snr_db)
    recording, truth = simulate_ladar(table1(), world, 64, Draws(1), dtype=DOUBLE)
    noise = recording.signal.data - ladar_echo(Points([0.0], [1.5]).scatterers(Draws(0)), table1(), 64, dtype=DOUBLE)
    assert float(noise.abs().square().mean()) == pytest.approx(10 ** (-snr_db / 10), rel=0.02)
    assert float(truth.values["noise_std"]) == pytest.approx(10 ** (-snr_db / 20))


@pytest.mark.parametrize("reference_m", [10.0, 3000.0, 1e6])
def test_phases_hold_from_ten_metres_to_a_thousand_kilometres(reference_m: float) -> None:
    """Against arithmetic of fifty digits, at the ends of the record and of a sweep."""
    getcontext().prec = 50
    radar = table1(reference_range_m=reference_m)
    s = Points([0.06], [1.7]).scatterers(Draws(0))
    found, single = (
        ladar_echo(s, radar, 9, (Polynomial([0.4]),), EverySample(), dtype=dtype) for dtype in (DOUBLE, torch.complex64)
    )
    c, start, u = Decimal(radar.wave_speed_m_s), radar.sweep_axes(9)[1].values(), radar.fast_time_axis().values()
    for ramp, pulse, sample in ((0, 0, 0), (1, 8, 511), (0, 4, 200)):
        time = (
            Decimal(float(start[pulse]))
            + Decimal(radar.period_s) * (Decimal(1 + 2 * ramp) / 4)
            + Decimal(float(u[sample]))
        )
        across, near = (
            Decimal(radar.speed_m_s) * time - Decimal(float(s.azimuth_m[0])),
            Decimal(reference_m) + Decimal(float(s.range_m[0])),
        )
        path = (
            (near * near + across * across).sqrt()
            - Decimal(reference_m)
            + Decimal("0.4") * (time - Decimal(float(start[0])))
        )
        delay = 2 * path / c
        turns = Decimal(radar.carrier_hz) * delay + (1 - 2 * ramp) * Decimal(radar.chirp_rate_hz_s) * (
            Decimal(float(u[sample])) * delay - delay * delay / 2
        )
        expected = complex(math.cos(2 * math.pi * float(turns % 1)), math.sin(2 * math.pi * float(turns % 1)))
        assert (
            abs(complex(found[ramp, pulse, sample]) - expected) < 1e-7
            and abs(complex(single[ramp, pulse, sample]) - expected) < 1e-6
        )


def test_the_beam_illuminates_its_width() -> None:
    """The beam of 114 urad illuminates 0.342 m at 3 km, 356 periods at 60 m/s."""
    echo = ladar_echo(Points([0.0, 0.06], [1.5, 2.0], [1.0, 0.0]).scatterers(Draws(0)), table1(beam_rad=114e-6), 512)
    lit = (echo.abs() > 0.5).all(-1)
    assert 355 <= int(lit[0].sum()) <= 357 and bool((echo[0, ~lit[0]] == 0).all()) and bool(lit[:, 256].all())


def test_the_gate_keeps_scatterers_out() -> None:
    world = LadarWorld(THREE, gate_m=(1.2, 1.8))
    alone = LadarWorld(Points([0.0], [1.5]))
    gated, known = (simulate_ladar(table1(), w, 4, Draws(0), dtype=DOUBLE)[0].signal.data for w in (world, alone))
    torch.testing.assert_close(gated, known, atol=1e-12, rtol=0)
    with pytest.raises(
        ValueError, match="no scatterer lies within the gate of 5 to 6 m, but the scatterers lie from 1 to 2 m"
    ):
        simulate_ladar(table1(), LadarWorld(THREE, gate_m=(5.0, 6.0)), 4, Draws(0))


ERRORS = {
    "sinusoid": SinusoidSweepError(2e6, 2.5e5, 20.0, -60.0),
    "polynomial": PolynomialSweepError([1e5, 3e11, 5e16], [-2e5, 1e11, 0.0, 1e22]),
}


@pytest.mark.parametrize("error", ERRORS.values(), ids=list(ERRORS))
def test_sweep_errors_equal_direct_sums(error) -> None:
    s = THREE.scatterers(Draws(0))
    expected = direct_sweeps(s, table1(), 8, COMMON, error=error)
    assert difference(direct_sweeps(s, table1(), 8, COMMON), expected) > 0.04
    assert difference(ladar_echo(s, table1(), 8, COMMON, EverySample(), error, DOUBLE), expected) < 1e-8
    lines = difference(
        ladar_echo(s, table1(), 8, COMMON, LinearInSweep(), dtype=DOUBLE), direct_sweeps(s, table1(), 8, COMMON)
    )
    assert difference(ladar_echo(s, table1(), 8, COMMON, LinearInSweep(), error, DOUBLE), expected) < 1.2 * lines


@pytest.mark.parametrize("error", [None, *ERRORS.values()], ids=["none", *ERRORS])
def test_the_fibre_records_the_sweep_error(error) -> None:
    radar, delay = table1(), 60e-9
    found = calibration_channel(radar, CalibrationFibre(delay), error, 5, Draws(0), DOUBLE)
    u = radar.fast_time_axis().values()
    for ramp, rate in ((0, radar.chirp_rate_hz_s), (1, -radar.chirp_rate_hz_s)):
        turns = radar.carrier_hz * delay + rate * u * delay - rate * delay**2 / 2
        if error is not None:
            turns = turns + error.turns(u, ramp) - error.turns(u - delay, ramp)
        expected = torch.polar(torch.ones_like(u), 2 * math.pi * (turns - torch.round(turns)))
        torch.testing.assert_close(found[ramp, 0], expected, atol=1e-7, rtol=0)
    noisy = calibration_channel(
        radar, CalibrationFibre(delay, 10.0, every_period=True), error, 5, Draws(0, trials=range(3)), DOUBLE
    )
    assert noisy.shape == (3, 2, 5, 512)
    assert float((noisy - found).abs().square().mean()) == pytest.approx(0.1, rel=0.05)


@pytest.mark.parametrize("error", ERRORS.values(), ids=list(ERRORS))
def test_sweep_errors_are_integrals_of_their_frequency(error) -> None:
    u = torch.linspace(-4e-6, 4e-6, 81, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(error.turns(u, 0).sum(), u)
    known = (
        error.amplitude_hz * torch.sin(2 * math.pi * error.frequency_hz * u + math.radians(20.0))
        if isinstance(error, SinusoidSweepError)
        else 1e5 + 3e11 * u + 5e16 * u**2
    )
    torch.testing.assert_close(slope, known.detach(), rtol=1e-9, atol=1e-3)
    assert float(error.turns(torch.zeros((), dtype=torch.float64), 1)) == 0.0


@pytest.mark.parametrize(
    "level", [LinearInSweep(()), QuadraticInSweep(), EverySample()], ids=["line", "parabola", "sample"]
)
def test_gradients(level) -> None:
    radar = table1(carrier_hz=1e9, bandwidth_hz=2e8, period_s=1e-3, sample_rate_hz=32e3, reference_range_m=50.0)
    x, r = (
        torch.tensor([[0.3, -0.2]], dtype=torch.float64, requires_grad=True),
        torch.tensor([[1.0, 2.0]], dtype=torch.float64, requires_grad=True),
    )
    a, move = (
        torch.tensor([[1.0 + 0.2j, 0.5j]], dtype=DOUBLE, requires_grad=True),
        torch.tensor([0.01], dtype=torch.float64, requires_grad=True),
    )
    assert torch.autograd.gradcheck(
        lambda x, r, a, m: ladar_echo(Scatterers(x, r, a), radar, 2, (Sinusoid(m, 100.0, 30.0),), level, dtype=DOUBLE),
        (x, r, a, move),
    )


def test_impairments_enter_the_truth() -> None:
    def louder(recording: Recording, draws: Draws) -> tuple[Recording, dict[str, Tensor]]:
        gain = draws.uniform("gain", (), 2.0, 3.0)
        return replace(
            recording, signal=recording.signal.with_data(recording.signal.data * gain[:, None, None, None])
        ), {"gain": gain}

    recording, truth = simulate_ladar(
        table1(), LadarWorld(THREE), 16, Draws(0, trials=range(2)), {"louder": louder}, dtype=DOUBLE
    )
    assert truth.clean is not None
    torch.testing.assert_close(
        recording.signal.data, truth.clean.signal.data * truth.values["louder.gain"][:, None, None, None]
    )


def test_error_messages() -> None:
    with pytest.raises(ValueError, match=r"below half the sampling rate, 32 MHz, got 33.3\d+ MHz; move it nearer"):
        ladar_echo(Points([0.0], [8.0]).scatterers(Draws(0)), table1(), 4)
    with pytest.raises(ValueError, match="move it more slowly"):
        ladar_echo(Points([0.0], [1.5]).scatterers(Draws(0)), table1(), 4, (Polynomial([25.0]),))
    with pytest.raises(ValueError, match="n_period must be a whole number of 1 or more"):
        simulate_ladar(table1(), LadarWorld(THREE), 0, Draws(0))
    with pytest.raises(ValueError, match="holds no scatterer"):
        simulate_ladar(table1(), LadarWorld(Points([], [])), 4, Draws(0))
