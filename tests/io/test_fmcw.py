"""Sweeps of FMCW boards become recordings, of which images show points where they are."""

from __future__ import annotations

import math

import numpy as np
import pytest

from torchsar import focus, io
from torchsar.core import Recording

C, START, SLOPE, FS, N = 299792458.0, 77e9, 40e12, 5e6, 128
POSITION = np.stack([np.zeros(90), np.linspace(-0.15, 0.15, 90), np.zeros(90)], -1)
RECEIVERS = np.array([[0.0, 0.02, 0.0], [0.0, 0.022, 0.0], [0.0, 0.02, 0.03]])
TARGETS = np.array([[5.0, 0.5, 0.0], [8.0, -0.7, 0.0]])


def sweeps(offsets: np.ndarray, slope: float = SLOPE, delay: float = 6e-6) -> np.ndarray:
    """Samples (sweep, receiver, sample) by the model of the mixer."""
    t = delay + np.arange(N) / FS
    received = POSITION[:, None] + offsets
    beat = np.zeros((len(POSITION), len(offsets), N), complex)
    for target in TARGETS:
        late = np.linalg.norm(POSITION - target, axis=-1)[:, None] + np.linalg.norm(received - target, axis=-1)
        late = late[..., None] / C
        sent, echo = (np.exp(2j * np.pi * (START * x + slope * x**2 / 2)) for x in (t, t - late))
        beat += sent * echo.conj()
    return beat


def check(recording: Recording) -> None:
    for target in TARGETS:
        stage = focus.SpotlightImage(recording.aux, 0.6, 0.6, 0.01, tuple(target[:2]), error_db=-40.0)
        image = stage(recording.signal).data.abs()
        x, y, _ = stage.grid.pixels_m().reshape(-1, 3)[int(image.argmax())].tolist()
        assert math.dist((x, y), target[:2]) < 0.03


@pytest.mark.parametrize("order", ["iq", "iiqq"])
def test_integers_of_several_receivers(order: str) -> None:
    beat = np.round(1000 * sweeps(RECEIVERS))
    pairs = np.stack([beat.real, beat.imag], -1).astype(np.int16)
    if order == "iiqq":
        pairs = pairs.reshape(*pairs.shape[:2], -1, 2, 2).swapaxes(-1, -2).reshape(pairs.shape)
    recording = io.fmcw_recording(pairs, START, SLOPE, FS, POSITION, RECEIVERS, 6e-6, prf_hz=100.0, order=order)
    assert recording.signal.data.shape == (270, N) and recording.radar.prf_hz == 300.0
    check(recording)


@pytest.mark.parametrize(("slope", "sign"), [(SLOPE, 1), (-SLOPE, 1), (SLOPE, -1)])
def test_slopes_and_signs(slope: float, sign: int) -> None:
    beat = sweeps(np.zeros((1, 3)), slope)[:, 0]
    recording = io.fmcw_recording(
        beat if sign > 0 else beat.conj(), START, slope, FS, POSITION, delay_s=6e-6, beat_sign=sign
    )
    assert "receiver_m" not in recording.aux
    check(recording)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"start_hz": 77.0}, "start_hz is 77.* Hz in the middle.* in GHz"),
        ({"position_m": POSITION / 1e3}, "position_m moves by 0.0003 m over all pulses.*probably in km"),
        ({"position_m": POSITION[:50]}, r"got \(90, 1, 128\), \(50, 3\)"),
        ({"slope_hz_s": 0.0}, "slope_hz_s not zero, got 1, 5000000.0 and 0.0"),
        ({"order": "iqi", "beat": np.ones((90, N, 2))}, "order must have as many i as q"),
        ({"beat": np.ones((90, N))}, "or real with order=.real., got float64"),
        ({"beat": np.full((90, N), np.nan + 0j)}, "beat"),
    ],
)
def test_mistakes(change: dict, said: str) -> None:
    keys = {"beat": sweeps(np.zeros((1, 3)))[:, 0], "start_hz": START, "slope_hz_s": SLOPE, "sampling_hz": FS}
    if "start_hz" in change:  # all of them in GHz
        keys["slope_hz_s"] = 40e3
    with pytest.raises(ValueError, match=said):
        io.fmcw_recording(**{**keys, "position_m": POSITION, **change})


@pytest.mark.parametrize("slope", [SLOPE, -SLOPE])
@pytest.mark.parametrize("samples", [N, N - 1])
def test_real_samples_are_those_of_a_mixer_without_q(slope: float, samples: int) -> None:
    beat = sweeps(RECEIVERS, slope)[..., :samples]
    real, whole = (
        io.fmcw_recording(x, START, slope, FS, POSITION, RECEIVERS, 6e-6, order=order)
        for x, order in ((np.round(1000 * beat.real).astype(np.int16), "real"), (beat, "iq"))
    )
    check(real)
    # the mirror frequencies are gone, but for their side lobes
    lit = whole.signal.data.abs() > 0.3 * whole.signal.data.abs().max()
    ratio = real.signal.data[lit] / 1000 / whole.signal.data[lit]
    assert float((ratio - 1).abs().max()) < 0.05
