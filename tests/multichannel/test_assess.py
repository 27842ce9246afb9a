"""Assessment of moving points and of channels: apart from the estimate, with a reason per trial."""

from __future__ import annotations

import math
from importlib import import_module

import pytest
import torch

from torchsar.core import Outcome, Signal
from torchsar.multichannel import (
    AlongTrackAutofocus,
    Dwell,
    EstimateBalance,
    EstimateSynchronisation,
    FlatBand,
    GradientVelocity,
    Interferometry,
    LikelihoodVelocity,
    MigratingLines,
    MovingPointVelocity,
    Search,
    SignalIntensityRatio,
    WalkAmbiguity,
    balance,
)
from torchsar.study.bench.direct.moving import azimuth_echo, published_radar

RADAR, N, GATE = published_radar(), 600, Dwell(2.5)
STAGES = {
    "ratio": lambda **keys: SignalIntensityRatio(RADAR, 180.0, search_m_s=(0.0, 10.0), step_m_s=1.0, **keys),
    "interferometry": lambda **keys: Interferometry(RADAR, GATE, **keys),
    "along_track": lambda **keys: AlongTrackAutofocus(RADAR, GATE, half_m_s=3.0, **keys),
    "likelihood": lambda **keys: LikelihoodVelocity(RADAR, GATE, **keys),
    "gradient": lambda **keys: GradientVelocity(RADAR, GATE, **keys),
    "recommended": lambda **keys: MovingPointVelocity(RADAR, GATE, search=Search(8.0, 2.0, 60.0), **keys),
}
START = {"interferometry": {}, "along_track": {"u_r_m_s": 5.0}, "likelihood": {"u_r_m_s": 5.0}}
START |= {"gradient": START["likelihood"]}


def noise(trials: int, seed: int, *shape: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return math.sqrt(0.5) * torch.view_as_complex(
        torch.randn(trials, *shape, 2, dtype=torch.float64, generator=generator)
    )


def point(snr_db: float = 20.0) -> Signal:
    """A point, noise alone, and zeros."""
    clean = 10 ** (snr_db / 20) * azimuth_echo(RADAR, N, 5.0, gate_s=2.5) + noise(1, 1, 3, N)[0]
    return Signal(torch.stack([clean, noise(1, 2, 3, N)[0], torch.zeros_like(clean)]), RADAR.axes(N))


@pytest.mark.parametrize("name", STAGES)
def test_values_are_the_same_without_assessment_which_then_does_no_work(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    signal, start = point(), START.get(name, {})
    assessed = STAGES[name]()(signal, **start)
    codes = [Outcome(int(code)) for code in assessed.outcome]
    assert codes[0].is_ok and codes[1].is_failed and codes[2] == Outcome.EMPTY

    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("assessed")

    for module in ("sir", "along_track", "stages", "recommended"):
        monkeypatch.setattr(import_module(f"torchsar.multichannel.velocity.{module}"), "outcome_of_point", refuse)
    bare = STAGES[name](assess=False)(signal, **start)
    assert bare.outcome.tolist() == [Outcome.NOT_ASSESSED] * 3
    for key, value in assessed.value.items():
        assert torch.equal(bare[key], value), key


def test_a_doubtful_speed_keeps_its_value_and_says_why() -> None:
    away = 10 * azimuth_echo(RADAR, N, 5.0, 6.0, gate_s=2.5) + noise(1, 3, 3, N)
    found = STAGES["along_track"]()(Signal(away, RADAR.axes(N)), u_r_m_s=5.0)
    assert found.outcome.tolist() == [Outcome.OUTSIDE_SEARCH] and bool(found.doubtful.all())
    assert abs(float(found["u_a_m_s"]) - 3) < 0.2


def test_a_doubtful_range_walk_makes_the_velocity_doubtful() -> None:
    radar = published_radar()
    signal = Signal(noise(1, 4, 3, 200, 32).to(torch.complex64), radar.axes(200, 32))
    assert WalkAmbiguity(radar)(signal).outcome.tolist() == [Outcome.NOISE]
    known = LikelihoodVelocity(radar, Dwell(1.0), assess=False)
    assert MigratingLines(radar, known)(signal).outcome.tolist() == [Outcome.IN_DOUBT]
    assert MigratingLines(radar, known, assess=False)(signal).outcome.tolist() == [Outcome.NOT_ASSESSED]


def test_doubtful_channels_keep_their_values(monkeypatch: pytest.MonkeyPatch) -> None:
    """Too few cells for three hundredths of a radian: the values are those of the fit."""
    radar, n = published_radar(), 64
    white = noise(2, 5, 1, 4 * n, 48).squeeze(1)
    delays = torch.tensor(radar.channel_m, dtype=torch.float64) / radar.speed_m_s
    hz = torch.fft.fftfreq(4 * n, 1 / (2 * radar.prf_hz), dtype=torch.float64)
    spectrum = torch.fft.fft(white, dim=-2) * (hz.abs() < 150)[:, None]
    shifted = spectrum[:, None] * torch.exp(-2j * math.pi * hz * delays[:, None])[..., None]
    data = torch.fft.ifft(shifted, dim=-2)[..., : 2 * n : 2, :] + noise(2, 6, 3, n, 48)
    data = torch.cat([data, noise(1, 7, 3, n, 48), torch.zeros_like(data[:1])])
    signal = Signal(data, radar.axes(n, 48))
    keys = {"prior": FlatBand(360.0), "bands": 2, "delays": False, "blocks": 4}
    found = EstimateBalance(radar, **keys)(signal)
    assert bool(found.doubtful[:2].all()) and bool(found.failed[2:].all()) and found.outcome[3] == Outcome.EMPTY
    assert bool((found["phase_rad"][:2, [0, 2]] != 0).all()) and float(found["phase_rad"][:2].abs().max()) < 0.3
    assert not bool(found["gain_db"][3].any())
    monkeypatch.setattr(balance, "assessed_balance", None)
    bare = EstimateBalance(radar, **keys, assess=False)(signal)
    assert bare.outcome.tolist() == [Outcome.NOT_ASSESSED] * 4 and not bare.std
    for key, value in found.value.items():
        assert torch.equal(bare[key], value), key


def test_pulses_without_a_direct_path_make_clocks_doubtful() -> None:
    radar = published_radar()
    direct = 0.01 * noise(2, 8, 20, 64)
    direct[0, :15, 32] += 10
    signal = Signal(torch.zeros(3, 20, dtype=torch.complex128), radar.axes(20))
    found = EstimateSynchronisation(radar)(signal, direct_path=direct)
    assert found.outcome.tolist() == [Outcome.INEXACT, Outcome.NOISE]
    bare = EstimateSynchronisation(radar, assess=False)(signal, direct_path=direct)
    assert bare.outcome.tolist() == [Outcome.NOT_ASSESSED] * 2
    assert all(torch.equal(bare[key], value) for key, value in found.value.items())
