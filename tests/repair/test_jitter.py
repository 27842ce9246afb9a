"""Converter jitter: correction at each accuracy, and offsets from a pilot tone and from clutter."""

from __future__ import annotations

import math

import pytest
import torch

from tests.helpers import small_recording
from torchsar.core import Chain, Draws, Outcome, use
from torchsar.echo import PeriodicJitter
from torchsar.echo.jitter import sample_unevenly
from torchsar.io import read_stripmap
from torchsar.metrics import correlation, error_db
from torchsar.repair import (
    BandLimited,
    BlindJitter,
    CorrectJitter,
    Lagrange,
    PilotJitter,
    correct_jitter,
    estimate_jitter_blind,
    estimate_jitter_pilot,
)
from torchsar.repair.jitter import Exact, correct_jitter_exact
from torchsar.repair.jitter_blind import detect_jitter_period
from torchsar.study.bench.repairs import jitter, speckle

OFFSETS = torch.tensor([0.0, 0.18, -0.12, 0.07], dtype=torch.float64)


def clutter(lines, n, band=0.77, seed=0, dtype=torch.complex128):
    white = torch.randn(lines, n, dtype=torch.complex128, generator=torch.Generator().manual_seed(seed))
    return torch.fft.ifft(torch.fft.fft(white) * (torch.fft.fftfreq(n).abs() < band / 2)).to(dtype)


def offsets(period, rms=0.1, seed=0):
    e = torch.randn(period, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    e = e - e.mean()
    return e * rms / e.square().mean().sqrt()


def test_errors_reach_the_reference_figures():
    x = clutter(8, 2048)
    y = sample_unevenly(x, OFFSETS)
    assert abs(float(error_db(y, x)) + 16) < 0.5
    assert float(error_db(Lagrange(4)(y, OFFSETS), x)) < -23.5
    assert float(error_db(Lagrange(8)(y, OFFSETS), x)) < -27
    assert float(error_db(BandLimited(8, 0.8)(y, OFFSETS), x)) < -42
    assert float(error_db(correct_jitter_exact(y, OFFSETS), x)) < -250


@pytest.mark.parametrize("n, period, seed", [(1024, 8, 0), (1022, 4, 1), (1021, 7, 2), (1000, 16, 3), (63, 4, 4)])
def test_exact_for_any_line_length(n, period, seed):
    x, e = clutter(3, n, 0.95, seed), offsets(period, 0.12, seed)
    y = sample_unevenly(x, e)
    assert float(error_db(correct_jitter_exact(y, e), x)) < -147
    single = correct_jitter_exact(y.to(torch.complex64), e)
    assert single.dtype == torch.complex64 and float(error_db(single, x)) < -90


@pytest.mark.parametrize("method", [Exact(), Lagrange(4), Lagrange(7), BandLimited(8, 0.8)])
def test_batch_equals_singles_with_offsets_per_trial(method):
    x = clutter(6, 128).reshape(3, 2, 128)
    e = torch.stack([offsets(4, 0.1, s) for s in range(3)])
    torch.testing.assert_close(method(x, e), torch.stack([method(x[i], e[i]) for i in range(3)]))


def test_periods_differ_between_trials_and_zero_offsets_change_nothing():
    x = clutter(6, 128).reshape(3, 2, 128)
    e = torch.zeros(3, 4, dtype=torch.float64)
    e[0], e[1, :2] = OFFSETS, torch.tensor([0.1, -0.1])
    y = torch.stack([sample_unevenly(x[0], e[0]), sample_unevenly(x[1], e[1, :2]), x[2]])
    out = correct_jitter(y, e, torch.tensor([4, 2, 3]))
    assert bool((error_db(out[:2], x[:2]) < -147).all()) and torch.equal(out[2], x[2])


def test_zero_offsets_change_nothing():
    x = clutter(2, 100)
    assert torch.equal(Lagrange(8)(x, torch.zeros(4)), x)
    assert float(error_db(correct_jitter_exact(x, torch.zeros(4)), x)) < -250


def test_exact_correction_is_differentiable():
    y, e = clutter(1, 24).requires_grad_(), (0.5 * OFFSETS).clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda y, e: torch.view_as_real(correct_jitter_exact(y, e)), (y, e))


@pytest.mark.parametrize("bad", [[0.0, -1.0], [0.6, -0.5], [0.0, math.nan]])
@pytest.mark.parametrize("method", [Exact(), Lagrange(8), BandLimited(8)])
def test_coinciding_instants_raise(bad, method):
    with pytest.raises(ValueError, match="instants|offset_samples: 1 of 2 values are NaN"):
        method(clutter(1, 64), torch.tensor(bad, dtype=torch.float64))


@pytest.mark.slow
@pytest.mark.parametrize("snr_db, cycles, period", [(60.0, 0.2137, 4), (30.0, -0.37, 4), (40.0, 0.11, 13)])
def test_pilot_reaches_the_predicted_error(snr_db, cycles, period):
    true = OFFSETS if period == 4 else offsets(period)
    impairment = PeriodicJitter(true, pilot_cycles=cycles, pilot_snr_db=snr_db, pilot_samples=2000)
    pilot = impairment.pilot(true, Draws(3, trials=range(60)), torch.zeros(1, dtype=torch.complex64))
    for origin, expected in (("mean", true - true.mean()), ("first", true - true[0])):
        estimate = estimate_jitter_pilot(pilot, origin=origin)
        assert bool(estimate.ok.all()) and bool((estimate["period"] == period).all())
        error = (estimate["offset_samples"][:, :period] - expected).square().mean().sqrt()
        predicted = estimate.std["offset_samples"][:, :period].square().mean().sqrt()
        assert 0.85 < float(error / predicted) < 1.15


@pytest.mark.slow
@pytest.mark.parametrize("length", [64, 512, 4096, 65536])
def test_the_period_of_a_pilot_without_noise_is_not_a_multiple(length: int):
    """Rounding errors of strong jitter looked like jitter of two or three times the period."""
    draws = Draws(1, trials=range(3 if length <= 4096 else 1))
    time = torch.arange(length, dtype=torch.float64)
    for period in (1, 2, 3, 4, 6, 8):
        offsets = 0.05 * draws.normal(f"{period}", (period,))
        pilot = torch.polar(torch.ones_like(time), 2 * math.pi * 0.1371 * (time + offsets[:, (time % period).long()]))
        assert estimate_jitter_pilot(pilot)["period"].tolist() == [period] * len(pilot)


@pytest.mark.slow
def test_a_pilot_without_jitter_gives_zero_offsets():
    pilot = PeriodicJitter((0.0,)).pilot(
        torch.zeros(1, dtype=torch.float64), Draws(0, trials=range(100)), torch.zeros(1, dtype=torch.complex64)
    )
    estimate = estimate_jitter_pilot(
        pilot + 0.03 * Draws(1, trials=range(100)).normal("more", (4096,), torch.complex64)
    )
    assert bool(estimate.ok.all()) and float(estimate["offset_samples"].abs().max()) == 0


@pytest.mark.parametrize(
    "make, match",
    [
        (lambda: Lagrange("8"), "whole number of 2 to 64, such as 4, 8 or 12, got '8'"),  # pyright: ignore
        (lambda: Lagrange(65), "whole number of 2 to 64, such as 4, 8 or 12, got 65"),
        (lambda: BandLimited(8, "x"), "whole number of 2 to 64 points and a band .* band='x'"),  # pyright: ignore
        (lambda: BandLimited(7.5), "whole number of 2 to 64 points and a band .* points=7.5"),  # pyright: ignore
    ],
)
def test_interpolations_of_a_wrong_size_are_refused(make, match):
    with pytest.raises(ValueError, match=match):
        make()


def test_invalid_pilots_raise_or_are_not_ok():
    good = PeriodicJitter(OFFSETS).pilot(OFFSETS, Draws(0, trials=range(5)), torch.zeros(1, dtype=torch.complex128))
    bad = good.clone()
    bad[1], bad[2, 7], bad[3] = (
        0,
        math.nan,
        torch.randn(4096, dtype=torch.complex128, generator=torch.Generator().manual_seed(0)),
    )
    estimate = estimate_jitter_pilot(bad)
    assert estimate.ok.tolist() == [True, False, False, False, True]
    assert (
        bool(torch.isfinite(estimate["offset_samples"]).all())
        and float(estimate["offset_samples"][1:4].abs().max()) == 0
    )
    torch.testing.assert_close(
        estimate["offset_samples"][[0, 4]], estimate_jitter_pilot(good[[0, 4]])["offset_samples"]
    )
    with pytest.raises(ValueError, match="at least 64 samples, 4 jitter periods of 16 samples, got 0"):
        estimate_jitter_pilot(good[:, :0])
    with pytest.raises(TypeError, match="complex"):
        estimate_jitter_pilot(good.real)


def test_chain_from_pilot_to_correction(small_jittered):
    recording, clean = small_jittered
    chain = Chain(
        pilot=use(PilotJitter(origin="first"), pilot="aux.pilot"),
        jitter=use(CorrectJitter(), offset_samples="pilot", period="pilot"),
    )
    repaired = chain(recording)
    assert float(error_db(recording.signal, clean).max()) > -20
    assert float(error_db(repaired, clean).max()) < -75


@pytest.fixture
def small_jittered():
    from tests.helpers import small_recording

    recording, truth = small_recording(trials=2, impairments={"jitter": PeriodicJitter(OFFSETS)})
    return recording, truth.clean.signal


@pytest.mark.slow
@pytest.mark.parametrize("period, seed", [(4, 0), (8, 1), (5, 2)])
def test_blind_offsets_of_simulated_clutter(period, seed):
    true = offsets(period, 0.1, seed)
    x = clutter(128, 1024, 0.85, seed, torch.complex64)
    y = torch.stack([sample_unevenly(x, true), x])
    estimate = estimate_jitter_blind(y)
    assert estimate["period"].tolist() == [period, 1] and bool(estimate.ok.all())
    error = (estimate["offset_samples"][0, :period] - true).square().mean().sqrt()
    assert float(error) < 0.003
    assert float(estimate["offset_samples"][1].abs().max()) == 0


def test_blind_estimate_of_an_empty_trial_is_not_ok():
    x = clutter(64, 512, seed=3)
    y = torch.stack([sample_unevenly(x, OFFSETS), torch.zeros_like(x)])
    estimate = estimate_jitter_blind(y)
    assert estimate.ok.tolist() == [True, False] and float(estimate["offset_samples"][1].abs().max()) == 0
    torch.testing.assert_close(estimate["offset_samples"][0], estimate_jitter_blind(y[:1])["offset_samples"][0])


@pytest.mark.slow
@pytest.mark.parametrize("name, seed", [("radarsat1_english_bay.npz", 0), ("radarsat1_squamish.npz", 1)])
def test_blind_on_recorded_data(recorded, name, seed):
    """The bound is 0.003 sample; the recordings themselves have about 0.0012 sample of jitter."""
    x = read_stripmap(recorded(name)).signal.data[:1024]
    true = offsets(8, 0.1, seed)
    y = sample_unevenly(x, true)
    assert int(detect_jitter_period(x)) == 1
    estimate = estimate_jitter_blind(y)
    assert int(estimate["period"]) == 8
    assert float((estimate["offset_samples"][:8] - true).square().mean().sqrt()) < 0.003
    repaired = correct_jitter(y, estimate["offset_samples"], estimate["period"])
    assert float(correlation(y.to(torch.complex128), x.to(torch.complex128))) < 0.99
    assert float(correlation(repaired.to(torch.complex128), x.to(torch.complex128))) > 0.9999


def test_noise_and_jitter_too_small_to_find_are_in_the_deviation_of_the_blind_estimate():
    x = clutter(32 * 12, 512, seed=5).reshape(12, 32, 512)
    true = torch.stack([offsets(4, size, i) for i, size in enumerate((0.1, 0.02) * 6)])
    y = sample_unevenly(x / x.abs().square().mean().sqrt(), true) + 0.32 * clutter(32 * 12, 512, 1.0, 6).reshape(
        x.shape
    )
    found = estimate_jitter_blind(y, 8)
    ok = found.ok
    error = (found["offset_samples"] - true.repeat(1, 2))[ok].square().mean().sqrt()
    assert int(ok.sum()) >= 9
    assert 0.67 < float(error / found.std["offset_samples"][ok].square().mean().sqrt()) < 1.4
    large = true[::2].repeat(1, 2)  # neither too small nor too large
    assert abs(float((found["offset_samples"][::2] * large).sum() / large.square().sum()) - 1) < 0.05


def test_the_ends_of_recorded_lines_do_not_join():
    """Lines cut from longer ones, as a receiver records them; 7 does not divide their length."""
    true = offsets(7, 0.1, 3)
    x = sample_unevenly(clutter(32, 1022, seed=7), true)[:, 140:652]
    found = estimate_jitter_blind(x + 1e-3 * clutter(32, 512, 1.0, 8), 8)
    error = (found["offset_samples"][:7] - true).square().mean().sqrt()
    assert bool(found.ok) and int(found["period"]) == 7
    assert float(error) < 5e-4 and float(error) < 3 * float(found.std["offset_samples"][0])


def test_offsets_on_which_the_fit_may_settle_wrongly_are_not_ok():
    true = torch.tensor([0.45, -0.35, -0.08, -0.02], dtype=torch.float64)
    found = estimate_jitter_blind(sample_unevenly(clutter(32, 512, seed=9), true), period=4)
    assert not bool(found.ok)


def test_outcomes_and_values_without_assessment(monkeypatch):
    x = clutter(32, 512, seed=3, dtype=torch.complex64)
    noise = clutter(32, 512, 1.0, 4, torch.complex64)
    y = torch.stack([sample_unevenly(x, OFFSETS), noise, 0 * x, sample_unevenly(x, OFFSETS) + 0.4 * noise])
    blind = estimate_jitter_blind(y, 8)
    assert blind.outcome.tolist() == [Outcome.OK, Outcome.NOISE, Outcome.EMPTY, Outcome.INEXACT]
    true = (OFFSETS - OFFSETS.mean()).repeat(2)  # a doubtful value is better than none
    assert float((blind["offset_samples"][3] - true).square().mean()) < 0.1 * float(true.square().mean())
    tone = torch.polar(torch.ones(512, dtype=torch.float64), 2 * math.pi * 0.21 * torch.arange(512.0).double())
    noise = noise[:1].to(torch.complex128)
    pilots = torch.cat([sample_unevenly(tone[None], OFFSETS), noise, 0 * noise, tone[None] + 0.5 * noise])
    pilot = estimate_jitter_pilot(pilots, 8)
    assert pilot.outcome.tolist() == [Outcome.OK, Outcome.NOISE, Outcome.EMPTY, Outcome.INEXACT]
    monkeypatch.setattr("torchsar.repair.jitter_blind.assess_offsets", None)
    signal = small_recording(32, 512, trials=4)[0].signal
    for found, plain in (
        (blind, BlindJitter(8, assess=False)(signal.with_data(y))),
        (pilot, PilotJitter(8, assess=False)(signal, pilot=pilots)),
    ):
        assert plain.outcome.tolist() == [Outcome.NOT_ASSESSED] * 4 and not plain.std
        assert all(torch.equal(plain[name], found[name]) for name in found.value)


def test_jitter_too_small_to_find_is_in_the_deviation_of_the_pilot_estimate():
    draws = Draws(8, trials=range(200))
    true = 0.02 * draws.normal("offsets", (4,))
    true = (true - true.mean(-1, keepdim=True)).repeat(1, 256)
    turns = draws.uniform("f", (1,), 0.1, 0.4) * (torch.arange(1024, dtype=torch.float64) + true)
    pilot = torch.polar(torch.ones_like(turns), 2 * math.pi * turns) + 0.1 * draws.normal(
        "noise", (1024,), clutter(1, 8).dtype
    )
    found = estimate_jitter_pilot(pilot, 8)
    error = (found["offset_samples"] - true[:, :8])[found.ok].square().mean().sqrt()
    assert 0.67 < float(error / found.std["offset_samples"][found.ok].square().mean().sqrt()) < 1.4


def test_a_periodic_gain_is_not_taken_for_jitter():
    true = offsets(4, 0.08, 1)
    y = sample_unevenly(clutter(32, 512, seed=11), true) + 0.02 * clutter(32, 512, 1.0, 12)
    found = estimate_jitter_blind(y * torch.tensor([1.1, 0.95, 1.05, 0.88]).repeat(128), 8)
    assert not bool(found.ok) or float((found["offset_samples"][:4] - true).square().mean().sqrt()) < 0.015


@pytest.mark.slow
@pytest.mark.parametrize("converter", [True, False])
def test_noise_of_the_converter_is_distinguished_from_noise_with_jitter(converter: bool) -> None:
    """A tenth of the power is noise; taken for the other kind the offsets err by 12 to 15 %."""
    batch = jitter(10.0, converter=converter)(32, 5)
    found, true = estimate_jitter_blind(batch.data.data, max_period=8), batch.truth["offset_samples"]
    sure = found.ok
    error, std = (x[sure].square().mean().sqrt() for x in (found["offset_samples"] - true, found.std["offset_samples"]))
    assert float(sure.double().mean()) > 0.8 and 0.67 < float(error / std) < 1.43
    gain = (found["offset_samples"] * true).sum() / true.square().sum()
    assert abs(float(gain) - 1) < 0.05


def test_a_period_beyond_the_search_is_named() -> None:
    """A divisor of the period was found, and the rest of the jitter was left without a word."""
    draws = Draws(7, trials=range(6))
    scene = 10 * speckle(draws, 64, 512)
    noise = draws.normal("noise", (64, 512), torch.complex128)
    offsets = 0.1 * draws.normal("offsets", (20,)).clamp(-2, 2)
    jittered = sample_unevenly(scene, offsets - offsets.mean(-1, keepdim=True)) + noise
    found, clean = (estimate_jitter_blind(x, max_period=8) for x in (jittered, scene + noise))
    assert bool((found.outcome == Outcome.OUTSIDE_SEARCH).all()) and bool(clean.ok.all())
