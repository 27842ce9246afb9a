"""Differences between channels, estimated from clutter and removed."""

from __future__ import annotations

import math

import pytest
import torch

from torchsar.core import Signal
from torchsar.multichannel import (
    CorrectBalance,
    ElementPattern,
    EstimateBalance,
    FlatBand,
    correct_balance,
    estimate_balance,
)
from torchsar.multichannel.clutter_fit import ClutterModel
from torchsar.study.bench.direct.moving import compressed_echo, published_radar

PHASE, GAIN, DELAY = (
    torch.tensor(x, dtype=torch.float64) for x in ([0.3, 0.0, -0.5], [0.5, 0.0, -1.0], [2e-9, 0.0, -9e-9])
)
N, CELLS, LONG = 256, 160, 4096


def clutter(radar, power_of_doppler, snr_db, trials=2, n_range=CELLS, seed=3):
    """Return Gaussian clutter (trial, channel, pulse, range) of a given Doppler spectrum.

    Channels are dx / V apart in time; the pulses are cut from a long periodic record, and the range
    band is that of the transmitted pulse.
    """
    generator = torch.Generator().manual_seed(seed)
    factor = 14  # up to the Doppler of a direction along track
    f = torch.fft.fftfreq(LONG, 1 / (factor * radar.prf_hz), dtype=torch.float64)
    white = torch.randn(trials, LONG, n_range, dtype=torch.complex128, generator=generator)
    power = power_of_doppler(f) * (f.abs() < radar.speed_m_s / radar.wavelength_m)
    spectrum = white * (power / power.mean()).sqrt()[:, None]
    dx = torch.tensor(radar.channel_m, dtype=torch.float64)[:, None]
    delayed = spectrum[:, None] * torch.exp(-2j * math.pi * f * dx / radar.speed_m_s)[..., None]
    pulses = torch.fft.ifft(delayed, dim=-2, norm="ortho")[..., : N * factor : factor, :]
    noisy = pulses + 10 ** (-snr_db / 20) * torch.randn(pulses.shape, dtype=torch.complex128, generator=generator)
    band = torch.fft.fftfreq(n_range, 1 / radar.sampling_hz, dtype=torch.float64).abs() < radar.pulse.bandwidth_hz / 2
    return torch.fft.ifft(torch.fft.fft(noisy) * band)


def differed(data, radar):
    return correct_balance(data, radar, -PHASE, -GAIN, -DELAY)


def flat(f):
    return (f.abs() < 160).to(torch.float64)


def pattern(f):
    return torch.sinc(0.8 * f / 300).square()


@pytest.mark.slow
@pytest.mark.parametrize(
    "prf, spacing_m, chosen, power, limit_deg",
    [
        (180.0, 0.8, (FlatBand(360.0), 2), flat, 0.1),
        (160.0, 0.8, (FlatBand(320.0), 2), flat, 0.1),
        (180.0, 0.5, (ElementPattern(),), pattern, 2.5),
    ],
)
def test_errors_agree_with_the_predicted_std(prf, spacing_m, chosen, power, limit_deg):
    radar = published_radar(prf_hz=prf, channel_m=(-spacing_m, 0.0, spacing_m))
    found = estimate_balance(differed(clutter(radar, power, 40.0), radar), radar, *chosen)
    assert bool(found.ok.all())
    errors = {
        "phase_rad": found["phase_rad"] - PHASE,
        "gain_db": found["gain_db"] - GAIN,
        "delay_s": found["delay_s"] - DELAY,
    }
    assert float(torch.rad2deg(errors["phase_rad"]).abs().max()) < limit_deg
    assert float(errors["gain_db"].abs().max()) < (0.1 if limit_deg < 1 else 0.25)
    for name in errors:
        assert bool((errors[name].abs() <= 4 * found.std[name] + 1e-15).all()), name
        assert bool((found.std[name][..., [0, 2]] > 0).all())


def test_clutter_that_does_not_determine_a_phase_is_not_ok():
    """Channels as far apart as their elements are long see uncorrelated clutter.

    The middle phase then had a deviation of 0.04 rad and was ok, and delays were wrong by 3 ns.
    """
    radar = published_radar()
    found = estimate_balance(differed(clutter(radar, pattern, 30.0, n_range=96), radar), radar, ElementPattern(), 5)
    assert not bool(found.ok.any())
    wrong_prior = estimate_balance(differed(clutter(radar, flat, 20.0, n_range=96), radar), radar)
    assert not bool(wrong_prior.ok.any()), "gains of a wrong prior were wrong by 1.1 dB"


def test_side_lobes_of_the_pattern_do_not_bias_the_gains():
    """With five Doppler bands, they erred by 3 predicted deviations."""
    radar = published_radar(channel_m=(-0.5, 0.0, 0.5))
    found = estimate_balance(differed(clutter(radar, pattern, 30.0, trials=4), radar), radar)
    error = ((found["gain_db"] - GAIN) / found.std["gain_db"])[:, [0, 2]]
    assert bool(found.ok.all()) and float(error.square().mean().sqrt()) < 2


def test_spread_equals_the_predicted_std():
    radar = published_radar()
    found = estimate_balance(
        clutter(radar, flat, 30.0, trials=24, n_range=48), radar, FlatBand(360.0), 2, delays=False, blocks=4
    )
    seen = found["phase_rad"].square().mean(0).sqrt()[[0, 2]]
    torch.testing.assert_close(
        seen / found.std["phase_rad"].mean(0)[[0, 2]], torch.ones(2, dtype=torch.float64), atol=0.5, rtol=0
    )
    assert float(found.info["snr_db"].mean()) == pytest.approx(30 - 3, abs=3.5)


@pytest.mark.slow
@pytest.mark.parametrize(
    "prf, power, snr_db, largest",
    [
        (180.0, flat, 60.0, (1.5e-4, 1.5e-3)),
        (160.0, flat, 40.0, (5e-4, 5e-3)),
        (180.0, lambda f: (f.abs() < 30).to(torch.float64), 20.0, (2e-3, 0.02)),
        (180.0, lambda f: ((f > -150) & (f < 40)).to(torch.float64), 40.0, (2e-3, 0.02)),
        (180.0, lambda f: torch.sinc(1.6 * f / 300) ** 4, 40.0, (1.5e-3, 0.015)),
    ],
    ids=["strong", "edge of the band", "narrow", "one side", "side lobes"],
)
def test_deviations_of_clutter_unlike_the_prior(prf, power, snr_db, largest):
    """Deviations were 1.4 times too large, 3 times too small or infinite.

    Of strong clutter, unequal responses of neighbouring frequencies counted as noise; at the edge
    of the band, leakage biased the gains; delays of narrow clutter erred by 1 ns, clutter on one
    side of the band led to a wrong maximum, and side lobes biased the gains by 0.08 dB.
    """
    radar = published_radar(prf_hz=prf)
    data = differed(clutter(radar, power, snr_db, trials=12, n_range=60, seed=8), radar)
    found = estimate_balance(data, radar, FlatBand(2 * prf), 2)
    assert bool(found.ok.all())
    for name, true, most in (
        ("phase_rad", PHASE, largest[0]),
        ("gain_db", GAIN, largest[1]),
        ("delay_s", DELAY, 2e-10),
    ):
        seen, std = ((x)[:, ::2].square().mean().sqrt() for x in (found[name] - true, found.std[name]))
        assert float(seen) < most and 0.6 < float(seen / std) < 1.7, (name, float(seen), float(std))


def test_a_moving_point_and_few_points():
    """A moving point that holds most of the power was balanced away, with a small deviation."""
    radar = published_radar()
    n_range = 72
    moving = compressed_echo(radar, N, n_range, [{"u_r": 8.0, "amplitude": 60.0}]).data
    data = differed(torch.stack([moving, 0 * moving]) + clutter(radar, flat, 20.0, n_range=n_range), radar)
    assert estimate_balance(data, radar, FlatBand(360.0), 2).ok.tolist() == [False, True]
    points = [{"y0": 60.0 * (k % 7) - 180, "r0": 4860.0 + 35 * k, "amplitude": 1.0 + k % 3} for k in range(8)]
    still = compressed_echo(radar, N, n_range, points).data
    noise = torch.randn(6, *still.shape, dtype=still.dtype, generator=torch.Generator().manual_seed(4))
    found = estimate_balance(differed(still + 0.01 * noise, radar), radar, FlatBand(360.0), 2)
    assert bool(found.ok.all())
    for name, true in (("phase_rad", PHASE), ("gain_db", GAIN), ("delay_s", DELAY)):
        error, std = (found[name] - true)[:, ::2], found.std[name][:, ::2]
        assert 0.5 < float(error.square().mean().sqrt() / std.square().mean().sqrt()) < 1.8, name


def test_what_moves_in_clutter_is_left_out():
    """Moving points counted as noise: gains erred by 0.8 dB, and no trial was ok."""
    radar, n_range = published_radar(), 160
    moving = [{"u_r": u_r, "amplitude": 5.0, "r0": r0} for u_r, r0 in ((8.0, 4900.0), (-6.0, 5100.0))]
    data = compressed_echo(radar, N, n_range, moving).data + clutter(radar, flat, 20.0, trials=1, n_range=n_range)
    found = estimate_balance(differed(data, radar), radar, FlatBand(360.0), 2)
    assert bool(found.ok.all())
    assert float((found["phase_rad"] - PHASE).abs().max()) < 0.01 and float((found["gain_db"] - GAIN).abs().max()) < 0.1


def test_clutter_in_one_of_two_bands_is_not_ok():
    """It could as well lie in the other band, with a phase that grows along the array."""
    radar = published_radar()
    data = clutter(radar, lambda f: ((f > 20) & (f < 160)).to(torch.float64), 20.0, n_range=60)
    assert not bool(estimate_balance(data, radar, FlatBand(360.0), 2).ok.any())


def test_a_wrong_pattern_is_not_ok():
    """Its gains were wrong by 0.25 dB in all trials and ok."""
    radar = published_radar(channel_m=(-0.5, 0.0, 0.5))
    assert not bool(estimate_balance(clutter(radar, flat, 20.0, trials=6, n_range=96), radar).ok.any())


def test_stages_remove_the_differences():
    radar = published_radar()
    clean = clutter(radar, flat, 40.0, trials=1)
    signal = Signal(differed(clean, radar), radar.axes(N, CELLS))
    estimate = EstimateBalance(radar, FlatBand(360.0), 2)(signal)
    out = CorrectBalance(radar)(signal, **{name: estimate[name] for name in EstimateBalance.provides})
    assert (out.data - clean).norm() < 0.01 * clean.norm() < 0.05 * (signal.data - clean).norm()
    torch.testing.assert_close(CorrectBalance(radar)(signal, PHASE, GAIN, DELAY).data, clean, atol=1e-9, rtol=0)
    line = signal.data[..., 0]
    flat_line = CorrectBalance(radar)(Signal(line, radar.axes(N)), PHASE, GAIN).data
    torch.testing.assert_close(flat_line, line * (10 ** (-GAIN / 20) * torch.exp(-1j * PHASE))[:, None])


@pytest.mark.slow
def test_trials_are_independent_and_empty_ones_not_ok():
    radar = published_radar()
    data = differed(clutter(radar, flat, 30.0, n_range=60), radar)
    dead = data[:1] * torch.tensor([1.0, 0.0, 1.0])[:, None, None]
    data = torch.cat([data * torch.tensor([1.0, 1e3])[:, None, None, None], torch.zeros_like(data[:1]), dead])
    together = estimate_balance(data, radar, FlatBand(360.0), 2)
    assert together.ok.tolist() == [True, True, False, False]
    assert all(
        bool(torch.isfinite(v).all()) for v in (*together.value.values(), *together.std.values(), together.quality)
    )
    for i in range(4):
        alone = estimate_balance(data[i], radar, FlatBand(360.0), 2)
        for name, value in alone.value.items():
            torch.testing.assert_close(together[name][i], value, atol=1e-9, rtol=1e-6)
    single = estimate_balance(data.to(torch.complex64), radar, FlatBand(360.0), 2)
    torch.testing.assert_close(single["phase_rad"], together["phase_rad"], atol=1e-4, rtol=0)


@pytest.mark.parametrize("spacing_m, prior, bands", [(0.8, FlatBand(360.0), 2), (0.5, ElementPattern(), 14)])
def test_snr_of_the_expected_covariance(spacing_m, prior, bands):
    """The last parabola of the search was so wide that the SNR erred by 0.05 to 0.3 dB."""
    radar = published_radar(channel_m=(-spacing_m, 0.0, spacing_m))
    model = ClutterModel.of(radar, prior, 64, bands, torch.device("cpu"))
    snr_db = torch.tensor([-10.0, -7.5, 10.0, 20.5, 31.0], dtype=torch.float64)
    torch.testing.assert_close(model.snr_db(model.noisy(snr_db)), snr_db, atol=0.01, rtol=0)


def test_phases_in_single_precision_are_removed():
    radar, data = published_radar(), torch.ones(3, 4, 8, dtype=torch.complex128)
    expected = correct_balance(data, radar, PHASE.float().double(), GAIN, DELAY)
    torch.testing.assert_close(correct_balance(data, radar, PHASE.float(), GAIN, DELAY), expected)
    single = CorrectBalance(radar)(Signal(data, radar.axes(4, 8)), PHASE.float(), GAIN.float(), DELAY.float())
    torch.testing.assert_close(single.data, expected, atol=1e-5, rtol=0)


def test_refusals():
    radar, data = published_radar(), torch.ones(3, 8, 64, dtype=torch.complex128)
    with pytest.raises(ValueError, match=r"at least two positions in channel_m, got channel_m=\(0.0,\)"):
        estimate_balance(data[:1], published_radar(channel_m=(0.0,)))
    with pytest.raises(ValueError, match="bands must be at least 1, .* got 0"):
        estimate_balance(data, radar, bands=0)
    for blocks in (1, 54):
        with pytest.raises(ValueError, match=f"blocks must be at least 2 and at most 53, .* got {blocks}"):
            estimate_balance(data, radar, blocks=blocks)
    with pytest.raises(ValueError, match="each of the 3 positions"):
        estimate_balance(torch.zeros(2, 8, 64, dtype=torch.complex128), radar)
    with pytest.raises(ValueError, match="gain_db .* got shape \\(2,\\)"):
        correct_balance(torch.zeros(3, 8, 64, dtype=torch.complex128), radar, PHASE, GAIN[:2])
    with pytest.raises(ValueError, match="leave delay_s out"):
        correct_balance(torch.zeros(3, 8, dtype=torch.complex128), radar, PHASE, GAIN, DELAY, with_range=False)
