"""Timing of a triangular record estimated from the record, against the true timing."""

from __future__ import annotations

import pytest
import torch

from torchsar.core import Chain, Outcome, Signal
from torchsar.repair import BlankTurningPoints, SplitSweeps, find_trigger
from torchsar.study.bench.direct.triangles import ground, record, sweeps, table1

SHARES = (0.0, 0.07, 0.3, 0.511, 0.97)


def made(radar, n_period, block=None, snr_db=10.0, shares=SHARES, **scene):
    """Records of several triggers, and the triggers in seconds."""
    period = radar.period_s * (1 if block is None else 0.8)
    trigger = torch.tensor(shares, dtype=torch.float64) * period + 1e-9 * torch.rand(
        len(shares), dtype=torch.float64, generator=torch.Generator().manual_seed(1)
    )
    return torch.stack(
        [record(radar, float(t), n_period, block, snr_db=snr_db, seed=i, **scene) for i, t in enumerate(trigger)]
    ), trigger


def error(estimate, trigger, radar):
    """Error of the estimated trigger in seconds, modulo the period."""
    return torch.remainder(estimate["trigger_s"] - trigger + radar.sweep_s, radar.period_s) - radar.sweep_s


@pytest.mark.parametrize("snr_db", [None, 10.0, 0.0])
@pytest.mark.parametrize("sign", ["lo_conj_echo", "echo_conj_lo"])
def test_complex_record_to_a_tenth_of_a_sample(sign, snr_db):
    radar = table1(dechirp_sign=sign)
    x, trigger = made(radar, 24, snr_db=snr_db)
    found = find_trigger(x, radar)
    assert bool(found.ok.all())
    assert float(error(found, trigger, radar).abs().max()) < {None: 0.05e-9, 10.0: 0.3e-9, 0.0: 1e-9}[snr_db]


@pytest.mark.slow
@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("motion_sign", [1, -1])
def test_real_record_and_its_order(motion_sign, side):
    radar = table1(detection="real")
    x, trigger = made(
        radar,
        192,
        shares=(0.07, 0.75),
        scatterers=((1.5 * side, 1.0),),
        motion=lambda t: motion_sign * (0.35 * t + 10 * t.square()),
    )
    found = find_trigger(x, radar, nearer=side < 0)
    assert bool(found.ok.all()) and float(error(found, trigger, radar).abs().max()) < 0.1e-9


def test_blocks_of_the_ground_ladar():
    radar = ground(keep_every=4)
    scene = {"scatterers": ((10.5, 1.0), (10.8, 0.12), (10.9, 0.12))}
    x, trigger = made(radar, 64, 9000, shares=(0.0, 0.7), **scene)
    found = find_trigger(x, radar)
    assert float(error(found, trigger, radar).abs().max()) < 0.1e-9 and bool((found.info["order_sigmas"] > 5).all())


def test_a_real_record_without_motion_has_no_order():
    """A motion v in one order is -v in the other, so without motion the order is undetermined."""
    radar = table1(detection="real")
    x, trigger = made(radar, 32, motion=lambda t: 0 * t)
    found = find_trigger(x, radar)
    assert not bool(found.ok.any())
    half = torch.remainder(error(found, trigger, radar) + radar.sweep_s / 2, radar.sweep_s) - radar.sweep_s / 2
    assert float(half.abs().max()) < 0.5e-9


@pytest.mark.parametrize("detection, n_period", [("complex", 24), ("real", 192)])
def test_several_scatterers_do_not_shift_the_trigger_by_a_fringe(detection, n_period):
    """Three points whose beats add up differently at every turning point; one fringe is 80 ns."""
    radar = table1(detection=detection)
    x, trigger = made(radar, n_period, shares=(0.07, 0.3), scatterers=((1.0, 0.7), (1.5, 1.0), (2.0, 0.7)))
    found = find_trigger(x, radar)
    assert bool(found.ok.all()) and float(error(found, trigger, radar).abs().max()) < 0.3e-9


def test_many_scatterers_leave_the_trigger_right_or_doubted():
    """A fifth of such records was sure and wrong: the four strongest tones do not describe them."""
    radar, generator = table1(), torch.Generator().manual_seed(30)
    start = radar.period_s * torch.rand(12, dtype=torch.float64, generator=generator)
    scenes = 0.3 + 1.7 * torch.rand(12, 30, generator=generator)
    level = 0.2 + torch.randn(12, 30, generator=generator).abs()
    x = [
        record(radar, float(t), 12, None, snr_db=10.0, seed=i, scatterers=list(zip(*scene, strict=True)))
        for i, (t, scene) in enumerate(zip(start, torch.stack([scenes, level], 1).tolist(), strict=True))
    ]
    found = find_trigger(torch.stack(x), radar)
    assert int(found.ok.sum()) >= 7
    assert float(error(found, start, radar)[found.ok].abs().max()) < 20e-9


def test_scene_nearer_than_the_reference():
    radar = table1()
    x, trigger = made(radar, 24, scatterers=((-1.5, 1.0),))
    right, wrong = find_trigger(x, radar, nearer=True), find_trigger(x, radar)
    assert float(error(right, trigger, radar).abs().max()) < 0.5e-9
    assert float((error(wrong, trigger, radar).abs() - radar.sweep_s).abs().max()) < 0.1e-6


def test_empty_and_noise_trials_are_not_ok_and_do_not_change_others():
    radar = table1()
    x, _ = made(radar, 24, shares=(0.3,))
    noise = torch.randn(x.shape, dtype=x.dtype, generator=torch.Generator().manual_seed(3))
    together = find_trigger(torch.cat([x, 0 * x, 1e6 * noise]), radar)
    assert together.ok.tolist() == [True, False, False] and bool(torch.isfinite(together["trigger_s"]).all())
    torch.testing.assert_close(together["trigger_s"][0], find_trigger(x[0], radar)["trigger_s"], atol=1e-15, rtol=0)


def test_outcomes_and_triggers_without_assessment(monkeypatch):
    radar = table1()
    x, _ = made(radar, 24, shares=(0.3,), snr_db=None)
    noise = torch.randn(x.shape, dtype=x.dtype, generator=torch.Generator().manual_seed(3))
    weak, _ = made(radar, 24, shares=(0.3,), snr_db=-10.0)
    data = torch.cat([x, 0 * x, noise, weak])
    signal = Signal(data, radar.record_axes(24, 1024))
    found = SplitSweeps(radar, "search")(signal)[1]
    assert found.outcome.tolist() == [Outcome.OK, Outcome.NOISE, Outcome.NOISE, Outcome.AMBIGUOUS]
    monkeypatch.setattr("torchsar.repair.trigger.assess_trigger", None)
    plain = SplitSweeps(radar, "search", assess=False)(signal)[1]
    assert plain.outcome.tolist() == [Outcome.NOT_ASSESSED] * 4
    assert torch.equal(plain["trigger_s"], found["trigger_s"])


def test_single_precision_gives_the_same_trigger():
    radar = table1()
    x, trigger = made(radar, 24)
    assert float(error(find_trigger(x.to(torch.complex64), radar), trigger, radar).abs().max()) < 0.3e-9


def test_the_stage_separates_with_the_estimated_trigger():
    radar = table1()
    x, _ = made(radar, 16, snr_db=None)
    signal = Signal(x, radar.record_axes(16, 1024))
    out, found = SplitSweeps(radar, "search")(signal)
    assert bool(found.ok.all()) and out.data.shape == (len(SHARES), 2, 15, 512)
    assert float((out.data[1] - sweeps(radar, 15))[:, 2:-2, 12:-2].abs().square().mean().sqrt()) < 2e-3
    trace = Chain(split=SplitSweeps(radar, "search"), blank=BlankTurningPoints(radar, 1.5)).trace(signal)
    assert torch.equal(trace.values["split.trigger_s"], found["trigger_s"])


def test_short_records_raise():
    radar = ground(keep_every=4)
    with pytest.raises(ValueError, match="too short to find turning points"):
        find_trigger(record(radar, 0.0, 4, 4800), radar)
