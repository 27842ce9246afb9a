"""Continuous records of a triangular ladar: turning points, blocks, trigger times, real samples."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from tests.echo.ladars import (
    COMMON,
    DOUBLE,
    GROUND,
    THREE,
    direct_record,
    direct_sweeps,
    table4,
    triangle_turns,
    unit_retro,
)
from torchsar.core import Draws
from torchsar.echo import PolynomialSweepError, SinusoidSweepError, ladar_echo, simulate_ladar_record
from torchsar.echo.ladar_record import ladar_record
from torchsar.echo.sweep_error import wound_turns
from torchsar.radar import TriangularLadar
from torchsar.scene import (
    CalibrationFibre,
    EverySample,
    LadarWorld,
    LetterE,
    LogAmplitude,
    OnePerSweep,
    PathFluctuation,
    Points,
    Polynomial,
    RetroAndBrokenLine,
    Scatterers,
    Sinusoid,
)
from torchsar.scene.motion import displacement_m
from torchsar.study.bench.direct.triangles import table1

COMPLEX4 = table4(detection="complex")


@pytest.mark.parametrize("side", [1.0, -1.0], ids=["beyond", "before"])
@pytest.mark.parametrize("trigger_s, flight", [(0.0, False), (5.3e-6, False), (21.7e-6, True)])
def test_equals_direct_sums_with_their_transients(side: float, trigger_s: float, flight: bool) -> None:
    s = unit_retro(Draws(3))
    s = Scatterers(s.azimuth_m, side * s.range_m, s.amplitude)
    # a sample that lies on a turning point belongs to either sweep: 1 fs keeps the two sums on one
    # side
    expected = direct_record(s, COMPLEX4, 5, 9600, GROUND, trigger_s - 1e-15, flight)
    found = ladar_record(s, COMPLEX4, 5, 9600, GROUND, trigger_s, () if flight else ("flight",), dtype=DOUBLE)
    torch.testing.assert_close(found, expected, atol=5e-4 if flight else 2e-6, rtol=0)
    real = ladar_record(s, table4(), 5, 9600, GROUND, trigger_s, () if flight else ("flight",))
    assert real.dtype == torch.float32
    torch.testing.assert_close(real.double(), found.real, atol=3e-6, rtol=0)


def test_transients_last_as_long_as_the_delay() -> None:
    """70 ns, 11 samples at 150 MHz, after every turning point."""
    radar = table4(detection="complex", keep_every=1, speed_m_s=0.0)
    found = ladar_record(Points([0.0], [10.5]).scatterers(Draws(0)), radar, 2, 4800, dtype=DOUBLE)
    step = torch.angle(found[:, 1:] * found[:, :-1].conj()) / (2 * math.pi) * radar.sample_rate_hz
    beat = radar.beat_hz(10.5)
    steady = torch.cat([step[:, 12:2399], -step[:, 2412:4799]], -1)
    torch.testing.assert_close(steady, torch.full_like(steady, beat), rtol=1e-6, atol=0)
    assert bool((step[:, :9] < 0.9 * beat).all()) and bool((step[:, 2400:2409] > -0.9 * beat).all())


def test_inside_sweeps_a_record_is_the_separated_sweeps() -> None:
    """A record whose triangle starts with the block has its samples on the grid of sweeps."""
    radar, s = table1(), THREE.scatterers(Draws(0))
    record = ladar_record(s, radar, 9, 1024, COMMON, dtype=DOUBLE).unflatten(-1, (2, 512)).movedim(-2, 0)
    expected = direct_sweeps(s, radar, 9, COMMON)
    torch.testing.assert_close(record[..., 2:], expected[..., 2:], atol=1e-5, rtol=0)
    assert float((record[..., :1] - expected[..., :1]).abs().max()) > 1e-3


def test_contiguous_blocks_join() -> None:
    s = THREE.scatterers(Draws(0))
    one, other = table1(speed_m_s=10.0), table1(speed_m_s=10.0, keep_every=2)
    joined = ladar_record(s, one, 8, 1024, COMMON, 3e-6, dtype=DOUBLE).flatten()
    # the same slow times: the axes of both begin half a record before a turning point
    lag = one.sweep_axes(8)[1].start - other.sweep_axes(4)[1].start
    shifted = Scatterers(s.azimuth_m - one.speed_m_s * lag, s.range_m, s.amplitude)
    torch.testing.assert_close(
        ladar_record(shifted, other, 4, 2048, COMMON, 3e-6, dtype=DOUBLE).flatten(), joined, atol=1e-6, rtol=0
    )


def test_real_noise_gives_the_analytic_signal_its_snr() -> None:
    world = LadarWorld(Points([0.0], [10.5]), snr_db=3.0)
    recording, truth = simulate_ladar_record(table4(), world, 8, Draws(1), dtype=DOUBLE)
    noise = recording.signal.data - ladar_record(
        Points([0.0], [10.5]).scatterers(Draws(0)), table4(), 8, 9600, dtype=DOUBLE
    )
    assert recording.signal.data.dtype == torch.float64 and recording.signal.names == ("pulse", "time")
    assert float(noise.square().mean()) == pytest.approx(10**-0.3 / 2, rel=0.03)
    assert float(truth.values["noise_std"]) == pytest.approx(10**-0.15)


def test_triggers_differ_between_trials_and_are_recorded_only_on_request() -> None:
    trigger = torch.tensor([0.0, 5.3e-6, 20e-6], dtype=torch.float64)
    world = LadarWorld(
        RetroAndBrokenLine(),
        (*GROUND, PathFluctuation(1.5e-6, 100.0, 2000.0)),
        LogAmplitude(0.1, 100.0, 2000.0),
        10.0,
        calibration=CalibrationFibre(5e-8),
    )
    together, truth = simulate_ladar_record(
        COMPLEX4, world, 4, Draws(2, trials=range(3)), trigger_s=trigger, dtype=DOUBLE
    )
    assert "trigger_s" not in together.aux and together.signal.data.shape == (3, 4, 9600)
    for i in range(3):
        alone, known = simulate_ladar_record(
            COMPLEX4, world, 4, Draws(2, trials=[i]), trigger_s=float(trigger[i]), trigger_known=True, dtype=DOUBLE
        )
        torch.testing.assert_close(together.signal.data[i], alone.signal.data[0], atol=1e-8, rtol=0)
        for name in ("velocity_m_s", "range_error_m", "range_error_up_m", "log_amplitude"):
            torch.testing.assert_close(truth.values[name][i], known.values[name][0], atol=1e-12, rtol=1e-7)
        assert float(alone.aux["trigger_s"]) == float(trigger[i])
        turning = COMPLEX4.pulse_step_s * torch.arange(4, dtype=torch.float64) + trigger[i] + 16e-6
        still = displacement_m(GROUND, turning)
        assert float((truth.values["range_error_m"][i] - still).abs().max()) < 1e-5


def test_batch_equals_singles_with_scintillation() -> None:
    snr = torch.tensor([0.0, 30.0], dtype=torch.float64)
    world = LadarWorld(
        LetterE(2.0), (Sinusoid(torch.tensor([1e-5, 2e-5], dtype=torch.float64), 300.0),), LogAmplitude(0.3), snr
    )
    radar = table1(detection="real")
    together, truth = simulate_ladar_record(radar, world, 3, Draws(7, trials=range(2)), dtype=DOUBLE)
    for i in range(2):
        single = LadarWorld(LetterE(2.0), (Sinusoid(1e-5 * (i + 1), 300.0),), LogAmplitude(0.3), float(snr[i]))
        alone = simulate_ladar_record(radar, single, 3, Draws(7, trials=[i]), dtype=DOUBLE)[0]
        torch.testing.assert_close(together.signal.data[i], alone.signal.data[0], atol=1e-8, rtol=0)
    assert truth.clean is not None and not torch.equal(truth.clean.signal.data, together.signal.data)


def test_scintillation_scales_the_echo() -> None:
    world = LadarWorld(Points([0.0], [1.5]), log_amplitude=LogAmplitude(0.3, highest_hz=5e3))
    recording, truth = simulate_ladar_record(table1(), world, 16, Draws(1), dtype=DOUBLE)
    at_turning = recording.signal.data[:, 511:514].abs().mean(-1)
    torch.testing.assert_close(torch.log(at_turning), truth.values["log_amplitude"], atol=0.01, rtol=0)


def test_both_dechirp_signs() -> None:
    world = LadarWorld(THREE, COMMON, snr_db=10.0)
    one, other = (
        simulate_ladar_record(table1(dechirp_sign=sign), world, 4, Draws(1))[0].signal.data
        for sign in ("lo_conj_echo", "echo_conj_lo")
    )
    assert torch.equal(one, other.conj())
    near = LadarWorld(THREE, COMMON, snr_db=10.0)
    reals = [
        simulate_ladar_record(table1(dechirp_sign=sign, detection="real", sample_rate_hz=128e6), near, 4, Draws(1))[
            0
        ].signal.data
        for sign in ("lo_conj_echo", "echo_conj_lo")
    ]
    assert torch.equal(*reals)


def wound_directly(error, radar: TriangularLadar, position: Tensor) -> Tensor:
    """The frequency error integrated numerically from the start of the first triangle."""
    fine = torch.linspace(-radar.sweep_s / 2, radar.sweep_s / 2, 20001, dtype=torch.float64)
    steps = [torch.diff(error.turns(fine, ramp)) for ramp in (0, 1, 0, 1)]
    wound = torch.cat([torch.zeros(1, dtype=torch.float64), torch.cat(steps).cumsum(0)])
    return wound[torch.round(position / radar.sweep_s * 20000).long()]


@pytest.mark.parametrize(
    "error",
    [SinusoidSweepError(2e6, 2.5e5, 20.0, -60.0), PolynomialSweepError([1e5, 3e11], [-2e5, 1e11, 5e16])],
    ids=["sinusoid", "polynomial"],
)
def test_sweep_errors_are_continuous_at_turning_points(error) -> None:
    radar, s = table1(), Points([0.0], [1.5]).scatterers(Draws(0))
    position = torch.arange(0, 80000, 7, dtype=torch.float64) / 20000 * radar.sweep_s
    torch.testing.assert_close(
        wound_turns(error, radar, position), wound_directly(error, radar, position), atol=1e-9, rtol=0
    )
    record = ladar_record(s, radar, 5, 1024, sweep_error=error, dtype=DOUBLE).unflatten(-1, (2, 512)).movedim(-2, 0)
    expected = direct_sweeps(s, radar, 5, error=error)
    torch.testing.assert_close(record[..., 2:], expected[..., 2:], atol=1e-5, rtol=0)
    assert (
        float(
            (record - ladar_record(s, radar, 5, 1024, dtype=DOUBLE).unflatten(-1, (2, 512)).movedim(-2, 0)).abs().max()
        )
        > 0.01
    )


def test_omitted_video_phase() -> None:
    s, radar = Points([0.0], [2.0]).scatterers(Draws(0)), table1()
    record = (
        ladar_record(s, radar, 2, 1024, without=("flight", "residual_video"), dtype=DOUBLE)
        .unflatten(-1, (2, 512))
        .movedim(-2, 0)
    )
    expected = ladar_echo(s, radar, 2, (), EverySample(("flight", "residual_video")), dtype=DOUBLE)
    torch.testing.assert_close(record[..., 2:], expected[..., 2:], atol=1e-5, rtol=0)


@pytest.mark.parametrize("detection", ["real", "complex"])
def test_gradients(detection) -> None:
    radar = table1(
        carrier_hz=1e9,
        bandwidth_hz=2e8,
        period_s=1e-3,
        sample_rate_hz=32e3,
        reference_range_m=50.0,
        detection=detection,
    )
    x, r = (
        torch.tensor([0.3, -0.2], dtype=torch.float64, requires_grad=True),
        torch.tensor([3.0, 2.5], dtype=torch.float64, requires_grad=True),
    )
    a, move = (
        torch.tensor([1.0 + 0.2j, 0.5j], dtype=DOUBLE, requires_grad=True),
        torch.tensor([0.01], dtype=torch.float64, requires_grad=True),
    )
    assert torch.autograd.gradcheck(
        lambda x, r, a, m: ladar_record(Scatterers(x, r, a), radar, 1, 32, (Sinusoid(m, 100.0, 30.0),), dtype=DOUBLE),
        (x, r, a, move),
    )


def test_error_messages() -> None:
    world = LadarWorld(Points([0.0], [1.5]))
    with pytest.raises(
        ValueError,
        match="block_s must be at least the 8e-06 s of a sweep and at most the 1.6e-05 s from one block to the next",
    ):
        simulate_ladar_record(table1(), world, 4, Draws(0), block_s=3.2e-5)
    with pytest.raises(ValueError, match="got OnePerSweep; use simulate_ladar"):
        simulate_ladar_record(table1(), LadarWorld(Points([0.0], [1.5]), fidelity=OnePerSweep()), 4, Draws(0))
    with pytest.raises(ValueError, match="fold at zero in real samples; move the reference range"):
        simulate_ladar_record(
            table1(detection="real"), LadarWorld(Points([0.0], [0.1]), (Polynomial([2.0]),)), 4, Draws(0)
        )
    with pytest.raises(ValueError, match="must be below half the sampling rate"):
        simulate_ladar_record(table4(), LadarWorld(Points([0.0], [40.0])), 4, Draws(0))


def test_triangles_of_the_tests_are_continuous() -> None:
    edge = torch.tensor([0.0, 8e-6, 16e-6], dtype=torch.float64)
    torch.testing.assert_close(
        triangle_turns(table1(), edge - 1e-15), triangle_turns(table1(), edge + 1e-15), atol=1e-4, rtol=0
    )
