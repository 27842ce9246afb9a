"""Interference: levels, shares, phases, converter."""

from __future__ import annotations

import pytest
import torch

from tests.helpers import small_radar
from torchsar.core import Draws, Recording, Signal
from torchsar.echo import Quantiser, Tone, WideInterferer

RADAR = small_radar()


def clutter(
    n_pulse: int = 64, n_range: int = 1024, trials: int | None = None, dtype: torch.dtype = torch.complex64
) -> Recording:
    draws = Draws(5, trials=None if trials is None else range(trials))
    return Recording(
        Signal(3 * draws.normal("clutter", (n_pulse, n_range), dtype), RADAR.raw_axes(n_pulse, n_range)), RADAR
    )


def power(x: torch.Tensor) -> torch.Tensor:
    return x.abs().square().mean((-2, -1))


@pytest.mark.parametrize(
    "impairment", [Tone(20.0, 4e6, 1e5), Tone(20.0, 4e6, rate_hz_s=1e9, coherent=True), WideInterferer(20.0, -3e6, 1e6)]
)
def test_level_is_the_given_one(impairment) -> None:
    clean = clutter()
    impaired, _ = impairment(clean, Draws(1))
    ratio = power(impaired.signal.data - clean.signal.data) / power(clean.signal.data)
    assert float(10 * torch.log10(ratio)) == pytest.approx(20.0, abs=0.01 if isinstance(impairment, Tone) else 1.0)


def test_share_of_lines_and_unchanged_rest() -> None:
    clean = clutter(trials=3)
    impaired, truth = Tone(30.0, 4e6, share=0.25)(clean, Draws(2, trials=range(3)))
    assert truth["contaminated"].sum(-1).tolist() == [16, 16, 16]
    same = (impaired.signal.data == clean.signal.data).all(-1)
    assert torch.equal(same, ~truth["contaminated"])
    assert not torch.equal(truth["contaminated"][0], truth["contaminated"][1])


def test_tone_has_its_frequency_and_drift() -> None:
    clean = clutter()
    impaired, truth = Tone(30.0, torch.tensor(4e6), drift_hz=2e6)(clean, Draws(1))
    cell = torch.fft.fft(impaired.signal.data).abs().argmax(-1)
    measured = cell * RADAR.sampling_hz / 1024
    assert float((measured - truth["frequency_hz"]).abs().max()) <= RADAR.sampling_hz / 1024
    assert float(truth["frequency_hz"][-1] - truth["frequency_hz"][0]) == pytest.approx(2e6)


def test_phase_is_random_or_coherent() -> None:
    empty = Recording(clutter().signal, RADAR)

    def phasors(tone: Tone) -> torch.Tensor:
        wave = tone(empty, Draws(1))[0].signal.data - empty.signal.data
        return wave[:, 512] / wave[:, 512].abs()

    step = phasors(Tone(60.0, 4e6 + 30.0, coherent=True))
    step = step[1:] * step[:-1].conj()
    assert float(step.mean().abs()) > 0.999  # one oscillator: the same advance from line to line
    loose = phasors(Tone(60.0, 4e6 + 30.0))
    assert float((loose[1:] * loose[:-1].conj()).mean().abs()) < 0.5


def test_wide_interferer_stays_within_its_band() -> None:
    clean = clutter()
    impaired, _ = WideInterferer(20.0, 5e6, 2e6)(clean, Draws(1))
    spectrum = (
        torch.fft.fft((impaired.signal.data - clean.signal.data) * torch.hann_window(1024)).abs().square().mean(0)
    )
    inside = (RADAR.range_frequency_hz(1024) - 5e6).abs() < 1.2e6
    assert float(spectrum[inside].sum() / spectrum.sum()) > 0.999


def test_quantiser_has_odd_levels_and_clips() -> None:
    clean = clutter(trials=2)
    impaired, truth = Quantiser(4)(clean, Draws(1, trials=range(2)))
    levels = torch.view_as_real(impaired.signal.data) * truth["gain"][:, None, None, None].float()
    assert set(torch.unique(torch.round(levels)).int().tolist()) == set(range(-15, 16, 2))
    error = power(impaired.signal.data - clean.signal.data) / power(clean.signal.data)
    assert bool((error < 10**-1.8).all())  # 4 bits at 7 levels rms: about -20 dB
    assert bool(
        (
            power(Quantiser(12, 900.0)(clean, Draws(1))[0].signal.data - clean.signal.data)
            < 1e-6 * power(clean.signal.data)
        ).all()
    )


@pytest.mark.parametrize(
    "wrong", [lambda: Tone(10.0, 0.0, share=0.0), lambda: WideInterferer(10.0, 0.0, 0.0), lambda: Quantiser(0)]
)
def test_invalid_parameters_are_refused(wrong) -> None:
    with pytest.raises(ValueError, match=r"share|bandwidth_hz|bits"):
        wrong()
