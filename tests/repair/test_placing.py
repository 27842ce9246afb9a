"""Strips with lost lines, uneven times and moving windows show their targets where they are."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from torchsar import focus, metrics, radar
from torchsar.core import Recording
from torchsar.io import read_stripmap
from torchsar.io.strip import StripRecording
from torchsar.repair import SparseFill, regular_lines
from torchsar.repair.placing import LinePlan

C, CARRIER, BAND, PULSE, FS, NEAR, SPEED = 299792458.0, 3.2e9, 40e6, 2e-6, 50e6, 4000.0, 120.0
TARGETS = [(40.0, 4150.0), (75.0, 4300.0), (110.0, 4420.0)]  # azimuth at the crossing of the beam, slant range


def echoes(time: np.ndarray, doppler_hz: float, samples: int = 320, window_m: np.ndarray | None = None) -> np.ndarray:
    """Raw samples of the targets, by the signal model, seen for 0.8 s about the beam."""
    delay = 2 * (NEAR + (0 if window_m is None else window_m[:, None])) / C + np.arange(samples) / FS
    raw = np.zeros((len(time), samples), complex)
    sin = doppler_hz * C / CARRIER / (2 * SPEED)
    for azimuth, slant in TARGETS:
        crossing = azimuth / SPEED
        off = time - crossing - slant * sin / SPEED
        away = np.sqrt(slant**2 * (1 - sin**2) + (SPEED * off) ** 2)
        late = delay - 2 * away[:, None] / C
        inside = (late >= 0) & (late < PULSE) & (np.abs(time - crossing) <= 0.4)[:, None]
        chirp = np.exp(1j * np.pi * BAND / PULSE * (late - PULSE / 2) ** 2)
        raw += inside * chirp * np.exp(-4j * np.pi * CARRIER / C * away[:, None])
    return raw


def sensor(prf_hz: float, doppler_hz: float) -> radar.StripmapRadar:
    pulse = radar.LinearFM(BAND, PULSE)
    return radar.StripmapRadar(CARRIER, pulse, FS, prf_hz, SPEED, NEAR, pointing_doppler_hz=doppler_hz)


def figures(recording: Recording, doppler_hz: float) -> list[dict[str, float]]:
    image = focus.OmegaKStolt(recording.radar, doppler_hz=doppler_hz)(recording.signal)
    found = (metrics.impulse_response(image, at, search_m=6.0) for at in TARGETS)
    keys = ("position_azimuth_m", "position_range_m", "peak")
    return [{key: float(one[key].abs()) for key in keys} for one in found]


def compare(recording: Recording, reference: Recording, doppler_hz: float) -> None:
    step = [axis.step for axis in recording.radar.image_axes(recording.signal.axes)]
    cells = max(step[0], SPEED / 60), step[1]  # the beam holds 60 Hz
    for one, other in zip(figures(recording, doppler_hz), figures(reference, doppler_hz), strict=True):
        for key, cell in zip(("position_azimuth_m", "position_range_m"), cells, strict=True):
            assert abs(one[key] - other[key]) < 0.1 * cell, (key, one, other)
        assert abs(20 * np.log10(one["peak"] / other["peak"])) < 0.5, (one, other)


def archived(path: Path, raw: np.ndarray, prf_hz, near=NEAR, **side) -> Path:
    numbers = {"fs_hz": FS, "f0_hz": CARRIER, "chirp_rate_hz_s": BAND / PULSE, "pulse_s": PULSE, "v_eff_m_s": SPEED}
    np.savez(path, iq=raw.astype(np.complex64), prf_hz=prf_hz, slant_range_cell1_m=near, **numbers, **side)
    return path


PRF, LINES = 400.0, 560
REGULAR = Recording.from_arrays(echoes(np.arange(LINES) / PRF, 0.0), sensor(PRF, 0.0))


def checked(path: Path, doppler_hz: float, reference: Recording, said: str) -> None:
    """Both readers, whole and in blocks, give the targets of the undisturbed record."""
    with pytest.warns(UserWarning, match=said):
        recording = read_stripmap(path, regular=True)
    missing = recording.aux["missing"]
    fill = SparseFill(recording.radar, reference="phase", doppler_hz=doppler_hz)
    filled = fill(recording.signal, missing=missing) if bool(missing.any()) else recording.signal
    compare(replace(recording, signal=filled), reference, doppler_hz)
    strip = StripRecording(path)
    n, data = strip.shape[0], recording.signal.data
    assert (
        strip.shape == tuple(data.shape)
        and strip.axes == recording.signal.axes
        and said.split()[-1] in str(strip.notes)
    )
    blocks = [strip.recording(a, min(a + 190, n)) for a in range(0, n, 190)]
    assert torch.equal(torch.cat([block.aux["missing"] for block in blocks]), missing)
    torch.testing.assert_close(torch.cat([block.signal.data for block in blocks]), data, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("first", [180, 250, 330])
def test_lost_lines(tmp_path: Path, first: int) -> None:
    number = np.delete(np.arange(LINES), slice(first, first + 60))
    raw = echoes(number / PRF, 0.0)
    number[[30, 300]] += 7000  # wrong numbers
    path = archived(tmp_path / "a.npz", raw, PRF, line_number=number)
    checked(
        path,
        0.0,
        REGULAR,
        f"60 of 560 lines are missing, the first after line {first - 1}; they are zero until a stage",
    )
    assert len(read_stripmap(path).signal.data) == 500


def test_a_window_that_moves(tmp_path: Path) -> None:
    cell = C / (2 * FS)
    window = np.where(np.arange(LINES) < 250, 0.0, -100 * cell)
    raw = echoes(np.arange(LINES) / PRF, 0.0, 420, window_m=window)
    path = archived(tmp_path / "a.npz", raw, PRF, near=NEAR + window)
    checked(path, 0.0, REGULAR, "the range window moves by up to 100 samples and is aligned")
    window = np.where(np.arange(LINES) < 250, 3.4 * cell, 0.0)
    path = archived(tmp_path / "b.npz", echoes(np.arange(LINES) / PRF, 0.0, window_m=window), PRF, near=NEAR + window)
    checked(path, 0.0, REGULAR, r"the range window moves by up to 3\.4 samples and is aligned")


def test_a_pulse_rate_that_changes(tmp_path: Path) -> None:
    rate = np.where(np.arange(LINES) < 250, PRF, 1.015 * PRF)
    time = np.cumsum(np.append(0, 1 / rate[:-1]))
    path = archived(tmp_path / "a.npz", echoes(time, 0.0), rate)
    reference = Recording.from_arrays(echoes(np.arange(LINES) / (1.015 * PRF), 0.0), sensor(1.015 * PRF, 0.0))
    checked(path, 0.0, reference, "times of lines lie up to 0.5 pulse intervals beside the grid and are interpolated")


def test_dithered_times_at_a_large_centroid(tmp_path: Path) -> None:
    doppler, prf, lines = 600.0, 90.0, 130
    dither = np.random.default_rng(4).uniform(-0.04, 0.04, lines) / prf
    time = np.arange(lines) / prf + dither - dither[0]
    raw = echoes(time, doppler)
    path = archived(tmp_path / "a.npz", raw, prf, line_time_s=time)
    reference = Recording.from_arrays(echoes(np.arange(lines) / prf, doppler), sensor(prf, doppler))
    checked(path, doppler, reference, "and are interpolated")
    plan = LinePlan.of(reference.radar, {"line_time_s": torch.from_numpy(time)}, lines)
    assert plan is not None and abs(plan.doppler_turns(torch.from_numpy(raw), 0) * prf - doppler) < 5


def test_a_regular_recording_is_returned_as_it_is(tmp_path: Path) -> None:
    assert regular_lines(REGULAR) is REGULAR


@pytest.mark.parametrize(
    ("side", "said"),
    [
        ({"line_time_s": np.arange(60)[::-1] / PRF}, "line_time_s must rise, got .* at line "),
        ({"line_time_s": np.arange(60) / 10.0}, "the lines reach over 2361 pulse intervals of 1 / 400 s"),
        ({"line_number": np.random.default_rng(1).permutation(60)}, "line_number cannot be reconciled: only"),
    ],
)
def test_side_data_that_contradict_themselves(tmp_path: Path, side: dict, said: str) -> None:
    path = archived(tmp_path / "a.npz", echoes(np.arange(60) / PRF, 0.0), PRF, **side)
    for read in (lambda: read_stripmap(path, regular=True), lambda: StripRecording(path)):
        with pytest.raises(ValueError, match=f"a.npz: {said}"):
            read()
