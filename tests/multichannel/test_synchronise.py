"""Clock errors measured in the direct path, and compression of the full chirp."""

from __future__ import annotations

import math

import pytest
import torch

from tests.multichannel.test_balance import clutter, flat
from torchsar.core import Signal
from torchsar.multichannel import (
    ClutterSynchronisation,
    CompressChannels,
    EstimateSynchronisation,
    RemoveSynchronisation,
)
from torchsar.multichannel.synchronise import estimate_synchronisation, remove_synchronisation
from torchsar.study.bench.direct.moving import compressed_echo, published_radar

RADAR = published_radar()


def direct_path(phase, delay, n=64, noise=0.0, seed=0):
    """Return the compressed direct signal (..., pulse, sample), summed over frequencies."""
    f = torch.fft.fftfreq(n, 1 / RADAR.sampling_hz, dtype=torch.float64)
    f = f[f.abs() < RADAR.pulse.bandwidth_hz / 2]
    t = (torch.arange(n, dtype=torch.float64) - n // 2) / RADAR.sampling_hz
    line = torch.exp(2j * math.pi * f * (t[:, None] - delay[..., None, None])).mean(-1)
    generator = torch.Generator().manual_seed(seed)
    return line * torch.exp(1j * phase)[..., None] + noise * torch.randn(
        line.shape, dtype=torch.complex128, generator=generator
    )


def errors(trials=3, pulses=200):
    t = torch.linspace(-1, 1, pulses, dtype=torch.float64)
    phase = torch.stack([3.0 * torch.sin(4 * t + i) for i in range(trials)])
    return torch.remainder(phase + math.pi, 2 * math.pi) - math.pi, torch.stack(
        [(i + 1) * 4e-8 * t - 1e-8 for i in range(trials)]
    )


def test_exact_without_noise():
    phase, delay = errors()
    found = estimate_synchronisation(direct_path(phase, delay), RADAR)
    torch.testing.assert_close(found["phase_rad"], phase, atol=1e-8, rtol=0)
    torch.testing.assert_close(found["delay_s"], delay, atol=1e-17, rtol=0)
    assert bool(found.ok.all())


def test_error_equals_the_predicted_std():
    phase, delay = errors(4, 500)
    found = estimate_synchronisation(direct_path(phase, delay, noise=0.1), RADAR)
    for name, true in (("phase_rad", phase), ("delay_s", delay)):
        error = torch.remainder(found[name] - true + math.pi, 2 * math.pi) - math.pi
        ratio = error.square().mean().sqrt() / found.std[name].square().mean().sqrt()
        assert float(ratio) == pytest.approx(1, abs=0.08), name
    # peak 0 dB over noise of -20 dB a sample, of which 53 of 64 frequencies lie in the band
    assert float(found.info["snr_db"].mean()) == pytest.approx(20 + 10 * math.log10(64 / 53), abs=0.3)


def test_a_lost_direct_path_is_not_ok_per_trial():
    phase, delay = errors(2, 50)
    direct = direct_path(phase, delay, noise=0.01)
    direct[1, 20] = 0
    direct[1, 21] = 0.01 * torch.randn(64, dtype=torch.complex128, generator=torch.Generator().manual_seed(5))
    found = estimate_synchronisation(direct, RADAR)
    assert found.ok.tolist() == [True, False]
    assert (
        found["phase_rad"][1, 20] == 0
        and found["delay_s"][1, 20] == 0
        and bool(torch.isfinite(found.std["delay_s"]).all())
    )
    alone = estimate_synchronisation(direct[0], RADAR)
    torch.testing.assert_close(alone["phase_rad"], found["phase_rad"][0])


def test_phase_and_delay_are_removed_from_all_channels():
    signal = compressed_echo(RADAR, 40, 96, [{"r0": 5020.0}])
    phase, delay = (x[0] for x in errors(1, 40))
    f = torch.fft.fftfreq(96, 1 / RADAR.sampling_hz, dtype=torch.float64)
    drifting = (
        torch.fft.ifft(torch.fft.fft(signal.data) * torch.exp(-2j * math.pi * delay[:, None] * f))
        * torch.exp(1j * phase)[:, None]
    )
    both = signal.with_data(torch.stack([drifting, 2 * drifting]))
    direct = direct_path(phase, delay).expand(2, -1, -1)
    estimate = EstimateSynchronisation(RADAR)(both, direct)
    out = RemoveSynchronisation(RADAR)(both, phase_rad=estimate["phase_rad"], delay_s=estimate["delay_s"])
    torch.testing.assert_close(out.data[1] / 2, signal.data, atol=1e-6, rtol=0)
    line = Signal(both.data[..., 48], RADAR.axes(40))
    torch.testing.assert_close(
        RemoveSynchronisation(RADAR)(line, estimate["phase_rad"]).data,
        line.data * torch.exp(-1j * phase),
        atol=1e-7,
        rtol=0,
    )
    small = signal.data[:, :3, :6].clone().requires_grad_()
    values = tuple(
        torch.tensor(x, dtype=torch.float64, requires_grad=True) for x in ([0.1, 0.2, -2.0], [1e-9, 0.0, 3e-9])
    )
    assert torch.autograd.gradcheck(
        lambda d, p, t: remove_synchronisation(d, RADAR, p, t * 1e-9),
        (small, values[0], (values[1] * 1e9).detach().requires_grad_()),
    )


def test_what_is_at_rest_shows_the_clock_phase():
    data = clutter(RADAR, flat, 30.0, trials=3, n_range=96)
    data[1] += 3 * compressed_echo(RADAR, 256, 96, [{"u_r": 8.0}]).data
    t = torch.linspace(-1, 1, 256, dtype=torch.float64)
    phase = 6 * t.square() + torch.tensor([0.0, 0.0, 3.0])[:, None] * t + 4
    drifting = Signal(data * torch.exp(1j * phase)[:, None, :, None], RADAR.axes(256, 96))
    found = ClutterSynchronisation(RADAR, 320.0)(drifting)
    assert bool(found.ok.all())
    error = found["phase_rad"] - 6 * (t.square() - t.square().mean())
    assert float(error.square().mean(-1).sqrt().max()) < 0.15 and bool((error.abs() < 6 * found.std["phase_rad"]).all())
    slope = (found["phase_rad"] * t).mean(-1)
    torch.testing.assert_close(torch.stack([slope, found["phase_rad"].mean(-1)]), torch.zeros(2, 3).double())
    alone = ClutterSynchronisation(RADAR, 320.0)(drifting.with_data(drifting.data[1]))
    torch.testing.assert_close(alone["phase_rad"], found["phase_rad"][1])
    delay = 4e-9 * torch.sin(3 * t) + 1e-9
    late = remove_synchronisation(drifting.data, RADAR, torch.zeros(3, 256), -delay.expand(3, -1))
    found = ClutterSynchronisation(RADAR, 320.0)(drifting.with_data(late))
    error, true = found["delay_s"] - (delay - delay.mean()), float(delay.std())
    assert bool((error.square().mean(-1).sqrt() < 0.25 * true).all()), error.square().mean(-1).sqrt()
    assert bool((error.square().mean(-1).sqrt() < 3 * found.std["delay_s"][:, 0]).all())
    noise = torch.randn(2, 3, 256, 96, dtype=torch.complex64, generator=torch.Generator().manual_seed(2))
    assert bool(ClutterSynchronisation(RADAR, 320.0)(drifting.with_data(noise)).failed.all())
    with pytest.raises(ValueError, match="must be positive, got 0 Hz and 0.25 s"):
        ClutterSynchronisation(RADAR, 0.0)(drifting)
    with pytest.raises(ValueError, match="at least 2 channels and 4 pulses, got 3 and 2"):
        ClutterSynchronisation(RADAR, 320.0)(compressed_echo(RADAR, 2, 16, [{}]))


def test_noise_does_not_shrink_the_delays():
    delay = -1e-7 * torch.linspace(-1, 1, 256, dtype=torch.float64)
    late = remove_synchronisation(clutter(RADAR, flat, 10.0, 3, 96), RADAR, torch.zeros(3, 256), -delay.expand(3, -1))
    found = ClutterSynchronisation(RADAR, 320.0, snr_db=10.0)(Signal(late, RADAR.axes(256, 96)))["delay_s"]
    assert float((found * delay).mean() / delay.square().mean()) == pytest.approx(1, abs=0.05)


def test_refusals():
    signal = compressed_echo(RADAR, 8, 16, [{}])
    with pytest.raises(ValueError, match="each of the 8 pulses"):
        EstimateSynchronisation(RADAR)(signal, torch.zeros(7, 64, dtype=torch.complex128))
    with pytest.raises(ValueError, match="8 samples or more, got torch.float64"):
        estimate_synchronisation(torch.zeros(7, 64, dtype=torch.float64), RADAR)
    with pytest.raises(ValueError, match=r"delay_s of shape \(\.\.\., 8\)"):
        remove_synchronisation(signal.data, RADAR, torch.zeros(8), torch.zeros(7))


@pytest.mark.parametrize("reference, pslr_db", [("matched", -12.5), ("flat", -13.2)])
def test_a_full_chirp_is_compressed_to_a_unit_peak_at_its_range(reference, pslr_db):
    n, first = 1024, 80
    raw = torch.zeros(3, 2, n, dtype=torch.complex128)
    pulse = RADAR.pulse.samples(RADAR.sampling_hz)
    raw[..., first : first + len(pulse)] = pulse
    line = CompressChannels(RADAR, reference)(Signal(raw, RADAR.axes(2, n))).data
    assert line.abs().argmax(-1).unique().tolist() == [first]
    # the filter is that of the pulse before sampling; the samples alias a little
    torch.testing.assert_close(line[..., first], torch.ones(3, 2, dtype=torch.complex128), atol=1e-3, rtol=0)
    fine = torch.fft.fft(line[0, 0])
    fine = torch.fft.ifft(torch.cat([fine[: n // 2], fine.new_zeros(15 * n), fine[n // 2 :]])).abs() * 16
    lobes = fine[(first + 1) * 16 + 5 : (first + 3) * 16]
    assert 20 * math.log10(float(lobes.max())) < pslr_db + 0.3
    with pytest.raises(ValueError, match="reference 'none' is unknown"):
        CompressChannels(RADAR, "none")
