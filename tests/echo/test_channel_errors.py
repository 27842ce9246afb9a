"""Unequal channels and drifting clocks: their effect, the direct path, and errors."""

from __future__ import annotations

import math

import pytest
import torch

from tests.echo.test_bistatic import RADAR, SCENE, simulated
from torchsar.core import Draws
from torchsar.echo import ChannelErrors, SynchronisationError, bistatic_echo
from torchsar.scene import MovingPoints, Pattern

CELL_S = 1 / 60e6


def test_each_channel_gets_its_phase_gain_and_delay():
    errors = ChannelErrors([0.3, 0.0, -2.0], [0.0, 1.5, -3.0], [0.0, 2 * CELL_S, -3 * CELL_S])
    recording, truth = simulated(impairments={"imbalance": errors})
    assert truth.clean is not None
    clean, impaired = truth.clean.signal.data, recording.signal.data
    factors = torch.polar(
        torch.tensor([1.0, 10**0.075, 10**-0.15], dtype=torch.float64),
        torch.tensor([0.3, 0.0, -2.0], dtype=torch.float64),
    )
    for channel, shift in enumerate((0, 2, -3)):
        torch.testing.assert_close(
            impaired[channel], factors[channel] * clean[channel].roll(shift, -1), rtol=0, atol=1e-11
        )
    assert truth.values["imbalance.delay_s"].tolist() == [0.0, 2 * CELL_S, -3 * CELL_S]


def test_a_delay_of_part_of_a_cell_moves_the_envelope_and_not_the_carrier():
    scene = MovingPoints([0.0], [0.0], [0.0], [0.0])
    later = ChannelErrors(delay_s=[0.4 * CELL_S] * 3)
    recording, _ = simulated(scene, n_pulse=1, impairments={"late": later})
    moved = simulated(MovingPoints([0.0], [0.0], [0.0], [0.4 * 5.0]), n_pulse=1)[0].signal.data
    phase = torch.exp(2j * torch.tensor(math.pi / 0.24 * 0.4 * 5.0))
    torch.testing.assert_close(recording.signal.data[..., 34:94], (moved * phase)[..., 34:94], rtol=0, atol=3e-3)


def test_errors_may_differ_between_trials_and_apply_to_azimuth_only_data():
    phase = torch.tensor([[0.1, 0.2, 0.3], [1.0, 2.0, 3.0]], dtype=torch.float64)
    recording, truth = simulated(
        n_range=None, trials=range(2), impairments={"p": ChannelErrors(phase)}, dtype=torch.complex64
    )
    assert truth.clean is not None and recording.signal.data.dtype == torch.complex64
    torch.testing.assert_close(
        recording.signal.data, truth.clean.signal.data * torch.exp(1j * phase)[..., None].to(torch.complex64)
    )


def synchronised(**options):
    drifts = {
        "phase_rad": [0.2, 3.0, -1.0],
        "phase_sinusoid_rad": 0.5,
        "phase_walk_rad": 0.05,
        "delay_s": [1e-9, 3e-9],
        "delay_sinusoid_s": 4e-9,
        "sinusoid_hz": 2.0,
    }
    return SynchronisationError(**{**drifts, **options})


def test_all_channels_of_a_pulse_share_its_phase_and_delay():
    recording, truth = simulated(trials=range(2), impairments={"clock": synchronised()})
    phase, delay = truth.values["clock.phase_rad"], truth.values["clock.delay_s"]
    time = RADAR.pulse_axis(90).values()
    rest = delay[0] - (1e-9 + 3e-9 * time)
    waves = torch.stack([torch.sin(4 * math.pi * time), torch.cos(4 * math.pi * time)], -1)
    parts = torch.linalg.lstsq(waves, rest[:, None]).solution
    torch.testing.assert_close(waves @ parts, rest[:, None], rtol=0, atol=1e-20)
    assert float(parts.square().sum().sqrt()) == pytest.approx(4e-9, rel=1e-9)
    assert phase.shape == (2, 90) and not torch.equal(phase[0], phase[1])
    late = bistatic_echo(SCENE.movers(RADAR, Draws(3)), RADAR, 90, 128, gate=Pattern(), dtype=torch.complex128)
    frequency = torch.fft.fftfreq(128, CELL_S, dtype=torch.float64)
    late = torch.fft.ifft(torch.fft.fft(late) * torch.exp(-2j * math.pi * delay[1][:, None] * frequency))
    torch.testing.assert_close(recording.signal.data[1], late * torch.exp(1j * phase[1])[:, None], rtol=0, atol=1e-11)


def test_the_direct_path_shows_phase_and_delay_of_every_pulse():
    recording, truth = simulated(impairments={"clock": synchronised(direct_snr_db=None, direct_samples=96)})
    path = recording.aux["direct_path"]
    assert path.shape == (90, 96)
    time = (torch.arange(96, dtype=torch.float64) - 48) * CELL_S
    delay, phase = truth.values["clock.delay_s"][:, None], truth.values["clock.phase_rad"][:, None]
    expected = torch.sinc(50e6 * (time - delay)) * torch.exp(1j * phase)
    torch.testing.assert_close(path, expected, rtol=0, atol=8e-3)


def test_the_direct_path_has_noise_of_its_own():
    clean, noisy = (
        simulated(
            n_range=None,
            trials=range(2),
            impairments={"clock": SynchronisationError(phase_walk_rad=0.1, direct_snr_db=snr)},
        )[0].aux["direct_path"]
        for snr in (None, 20.0)
    )
    assert float((noisy - clean).abs().square().mean()) == pytest.approx(0.01, rel=0.05)


def clock_phase(trials, **errors):
    options = {"n_range": None, "n_pulse": 901, "impairments": {"c": SynchronisationError(**errors)}}
    return simulated(trials=trials, **options)[1].values["c.phase_rad"]


def test_walks_are_zero_in_the_middle_and_have_the_given_step():
    walk = clock_phase(range(20), phase_walk_rad=0.2)
    assert bool((walk[:, 450] == 0).all())
    assert float(walk.diff().std()) == pytest.approx(0.2, rel=0.03)


def test_sinusoids_start_at_random_and_trials_do_not_depend_on_their_batch():
    both = clock_phase(range(3), phase_sinusoid_rad=1.0, sinusoid_hz=2.0)
    alone = clock_phase([2], phase_sinusoid_rad=1.0, sinusoid_hz=2.0)
    assert torch.equal(both[2], alone[0]) and not torch.allclose(both[1], both[2], atol=1e-3)


@pytest.mark.parametrize(
    ("impairment", "n_range", "message"),
    [
        (ChannelErrors([0.0, 1.0]), None, "each of the 3 channels"),
        (ChannelErrors(delay_s=[0.0, 1e-9, 0.0]), None, "no range axis"),
        (SynchronisationError(delay_s=[1e-9]), None, "no range axis"),
        (SynchronisationError(delay_s=[1e-6]), 128, "a quarter of the 64"),
    ],
)
def test_errors_that_do_not_fit_the_recording_are_refused(impairment, n_range, message):
    with pytest.raises(ValueError, match=message):
        simulated(n_range=n_range, n_pulse=10, impairments={"e": impairment})


@pytest.mark.parametrize(
    ("build", "error", "message"),
    [
        (lambda: ChannelErrors([math.inf]), ValueError, "phase_rad of channels"),
        (lambda: SynchronisationError(direct_samples=4), ValueError, "at least 8"),
        (lambda: SynchronisationError(0.5), TypeError, "phase_rad must be a list of numbers or None, got 0.5"),  # type: ignore[arg-type]
        (lambda: SynchronisationError(delay_s=1e-9), TypeError, "delay_s must be a list of numbers or None"),  # type: ignore[arg-type]
        (lambda: SynchronisationError(torch.ones(2)), ValueError, "phase_rad of clock errors .* in brackets"),  # type: ignore[arg-type]
        (lambda: SynchronisationError(phase_walk_rad=-1.0), ValueError, "0 or more"),
    ],
)
def test_invalid_errors_are_refused(build, error, message):
    with pytest.raises(error, match=message):
        build()
