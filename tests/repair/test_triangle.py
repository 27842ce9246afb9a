"""Separation of a triangular record, against sweeps that are evaluated one by one."""

from __future__ import annotations

import pytest
import torch

from torchsar.core import Axis, Chain, Draws, Recording, Signal, use
from torchsar.echo import simulate_ladar, simulate_ladar_record
from torchsar.repair import (
    BlankTurningPoints,
    CircularShift,
    SplitSweeps,
    blank_turning_points,
    circular_shift,
)
from torchsar.repair.triangle import canonical_ramps, split_record
from torchsar.repair.trigger import delayed
from torchsar.scene import EverySample, LadarWorld, Points, Polynomial
from torchsar.study.bench.direct.triangles import ground, record, sweeps, table1


def rms(x, first=12, last=2):
    """Rms without the transient, the last samples and the outer periods."""
    return float(x[..., 2:-2, first : x.shape[-1] - last].abs().square().mean().sqrt())


def signal_of(radar, x):
    """Record whose first samples are at the starts of the blocks."""
    pulse, time = radar.record_axes(*x.shape[-2:])
    return Signal(x, (pulse, Axis("time", time.n, 0.0, time.step, "s")))


SCENE = {1.5: {"scatterers": ((1.5, 1.0),)}, 10.5: {"scatterers": ((10.5, 1.0),)}}


@pytest.mark.parametrize("sign", ["lo_conj_echo", "echo_conj_lo"])
@pytest.mark.parametrize("trigger_s", [5.3e-6 + 0.3125 / 64e6, 5.3e-6, 0.0, 14.9e-6])
def test_complex_record(trigger_s, sign):
    """Samples of a symmetric grid are unchanged; between samples the delay costs 0.1 %."""
    radar = table1(dechirp_sign=sign)
    split = split_record(record(radar, trigger_s, 10), radar, trigger_s)
    assert split.shape == (2, 10 if trigger_s == 0 else 9, 512)
    off_grid = abs((trigger_s * 64e6 + 0.5 + 0.5) % 1 - 0.5) > 1e-3
    assert rms(split - sweeps(radar, split.shape[-2])) < (2e-3 if off_grid else 1e-7)


@pytest.mark.parametrize("radar, range_m, bound", [(ground(), 10.5, 0.015), (table1(detection="real"), 1.5, 0.025)])
@pytest.mark.parametrize("sign", ["lo_conj_echo", "echo_conj_lo"])
@pytest.mark.parametrize("side", [1, -1])
def test_a_real_detector_gives_the_sweeps_of_a_complex_one(radar, range_m, bound, sign, side):
    """Signs of both ramps, for scenes beyond the reference and nearer."""
    radar = type(radar)(**{**radar.__dict__, "dechirp_sign": sign})
    scene = {"scatterers": ((side * range_m, 1.0),)}
    split = split_record(record(radar, 5.3e-6, 10, **scene), radar, 5.3e-6, nearer=side < 0)
    assert split.is_complex() and rms(split - sweeps(radar, 9, **scene), 12, 12) < bound


def test_the_analytic_signal_is_better_before_the_cut():
    radar = ground()
    half = 0.5 / radar.sample_rate_hz
    x = record(radar, -half, 8, **SCENE[10.5])
    cut = delayed(x.unflatten(-1, (2, -1)).movedim(-2, 0), torch.zeros((), dtype=torch.float64), analytic=True)
    reference = sweeps(radar, 8, **SCENE[10.5])
    before, after = (rms(y - reference) for y in (split_record(x, radar, -half), canonical_ramps(cut, radar, False)))
    assert before < 0.9 * after


@pytest.mark.parametrize("radar", [ground(keep_every=4), ground(keep_every=4, detection="complex")])
def test_longer_blocks_are_cut_individually(radar):
    split = split_record(record(radar, 10e-6, 4, 8000, **SCENE[10.5]), radar, 10e-6)
    assert split.shape == (2, 4, 2400)
    assert float((split - sweeps(radar, 4, **SCENE[10.5]))[..., 12:-12].abs().square().mean().sqrt()) < 0.025
    with pytest.raises(
        ValueError,
        match="a whole period of 4800 samples after the trigger, got blocks of 8000 samples, "
        "which allows triggers from 0 to 2.133e-05 s",
    ):
        split_record(record(radar, 0.0, 2, 8000), radar, 25e-6)


def test_a_trigger_of_each_trial():
    radar = table1()
    trigger = torch.tensor([0.0, 5.3e-6, 9.0e-6], dtype=torch.float64)
    x = torch.stack([record(radar, float(t), 8) for t in trigger])
    split = split_record(x, radar, trigger)
    for i in range(3):
        alone = split_record(x[i], radar, float(trigger[i]))
        torch.testing.assert_close(split[i], alone[:, :7], atol=1e-12, rtol=0)


def test_slow_time_after_separation_and_the_dropped_period():
    radar = table1()
    x = record(radar, 5.3e-6, 6)
    out = SplitSweeps(radar, 5.3e-6)(signal_of(radar, x))
    assert out.names == ("ramp", "pulse", "fast_time") and out.axis("pulse").n == 5
    assert out.axis("pulse").start == pytest.approx(radar.sweep_axes(6)[1].start + 5.3e-6, abs=1e-15)
    assert out.axis("fast_time") == radar.fast_time_axis()
    assert SplitSweeps(radar)(signal_of(radar, record(radar, 0.0, 6))).axis("pulse").n == 6


def test_records_of_the_radar_need_no_delay():
    """The axis of a record begins half a sample after its block, where sweeps do."""
    radar = table1()
    axes = radar.record_axes(6, 1024)
    out = SplitSweeps(radar)(Signal(record(radar, 0.0, 6, first_s=axes[1].start), axes))
    assert axes[1].start == 0.5 / radar.sample_rate_hz
    assert float((out.data - sweeps(radar, 6)).abs().max()) < 1e-7 and out.axis("pulse").start == pytest.approx(
        axes[0].start, abs=1e-15
    )


@pytest.mark.parametrize("trigger_s", [0.0, 3.25e-6])
def test_a_simulated_record_splits_into_simulated_sweeps(trigger_s):
    """Away from the transient of 0.64 samples; a trigger of whole samples drops one period."""
    radar = table1()
    world = LadarWorld(Points([0.0], [1.5]), motion=[Polynomial([0.35, 10.0])], fidelity=EverySample())
    recorded, _ = simulate_ladar_record(radar, world, 8, Draws(1), trigger_s=trigger_s, dtype=torch.complex128)
    separate, _ = simulate_ladar(radar, world, 8, Draws(1), dtype=torch.complex128)
    out = SplitSweeps(radar, trigger_s)(recorded.signal)
    if trigger_s == 0:
        assert out.axes == separate.signal.axes
        assert float((out.data - separate.signal.data)[..., 2:].abs().max()) < 1e-8
    assert out.axis("pulse").n == (8 if trigger_s == 0 else 7)
    assert out.axis("pulse").start == pytest.approx(separate.signal.axis("pulse").start + trigger_s, abs=1e-15)


def test_recorded_trigger_in_a_chain():
    radar = table1()
    trigger = torch.tensor([5.3e-6, 2e-6], dtype=torch.float64)
    recording = Recording(
        signal_of(radar, torch.stack([record(radar, float(t), 6) for t in trigger])), radar, {"trigger_s": trigger}
    )
    out = Chain(
        split=use(SplitSweeps(radar, "recorded"), trigger_s="aux.trigger_s"), blank=BlankTurningPoints(radar, 1.5)
    )(recording)
    assert rms(out.data - blank_turning_points(sweeps(radar, 5), radar, 1.5)) < 2e-3
    with pytest.raises(ValueError, match="needs the recorded time"):
        SplitSweeps(radar, "recorded")(recording.signal)


def test_circular_shift_joins_samples_one_period_apart():
    """The phase steps back by 2 pi fd period at the joint, inside a sweep."""
    radar, trigger = table1(), 6e-6
    x = record(radar, trigger, 4, motion=lambda t: 0.3 * t)
    shifted = CircularShift(radar, trigger)(signal_of(radar, x)).data
    assert torch.equal(shifted, circular_shift(x, radar, trigger))
    joint = 1024 - 384
    steps = torch.angle(shifted[:, 1:] * shifted[:, :-1].conj()) / (2 * torch.pi)
    jump = steps[:, joint - 1] - steps[:, joint + 1]
    turns = 2 * 0.3 / radar.wavelength_m * radar.period_s
    assert float((jump + turns - torch.round(jump + turns)).abs().max()) < 1e-4 and abs(turns - round(turns)) > 0.1
    anew = split_record(x, radar, trigger)
    assert float(torch.diff(torch.angle(anew[..., 1:] * anew[..., :-1].conj()), dim=-1)[..., 10:-10].abs().max()) < 0.1


def test_blanking():
    radar = ground()
    ones = torch.ones(2, 3, 2400)
    assert (
        int((blank_turning_points(ones, radar, 10.5)[0, 0] == 0).sum()) == 11
        and float(blank_turning_points(ones, radar, 10.5)[0, 0, 10]) == 0
    )
    assert (blank_turning_points(ones, radar, 0.0, -10.5)[1, 2, -11:] == 0).all() and float(
        blank_turning_points(ones, radar, 0.0, -10.5).sum()
    ) == 6 * 2389
    assert float(blank_turning_points(ones, radar, 10.5, margin=3).sum()) == 6 * (2400 - 11 - 6)
    with pytest.raises(ValueError, match="the ranges are relative"):
        BlankTurningPoints(radar, 4339.5)


@pytest.mark.parametrize("real", [False, True])
def test_gradients_and_vmap(real):
    radar = table1(period_s=0.5e-6, detection="real" if real else "complex")
    x = torch.randn(
        2, 3, 32, dtype=torch.float64 if real else torch.complex128, generator=torch.Generator().manual_seed(0)
    )
    trigger = torch.tensor([0.12e-6, 0.3e-6], dtype=torch.float64)
    cut = lambda x, us: split_record(x, radar, us * 1e-6)  # noqa: E731
    assert torch.autograd.gradcheck(
        cut, (x.requires_grad_(), (trigger * 1e6).requires_grad_()), fast_mode=True, atol=1e-5
    )
    torch.testing.assert_close(
        torch.vmap(lambda y: split_record(y, radar, 0.12e-6))(x.detach()), split_record(x.detach(), radar, 0.12e-6)
    )


def test_dtype_is_kept_and_invalid_input_raises():
    radar = table1()
    for dtype, expected in (
        (torch.complex64, torch.complex64),
        (torch.float32, torch.complex64),
        (torch.float64, torch.complex128),
    ):
        x = record(radar, 0.0, 3)
        x = x.to(dtype) if dtype.is_complex else x.real.to(dtype)
        assert split_record(x, radar, 1e-6).dtype == expected
    for trigger in ("late", float("nan")):
        with pytest.raises(ValueError, match="trigger must be"):
            SplitSweeps(radar, trigger)
    with pytest.raises(ValueError, match="has no complete triangle"):
        split_record(record(radar, 0.0, 1), radar, 3e-6)
    with pytest.raises(ValueError, match="sample_rate_hz of the radar is"):
        SplitSweeps(table1(sample_rate_hz=32e6))(signal_of(radar, record(radar, 0.0, 2)))
    with pytest.raises(TypeError, match="complex samples"):
        BlankTurningPoints(radar, 1.5)(Signal(torch.zeros(2, 3, 512), radar.sweep_axes(3)))
