"""Reader of range profiles, turntable sweeps and phase histories, and its errors."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from torchsar.core import centred_fft
from torchsar.io import read_inverse
from torchsar.metrics import contrast, entropy
from torchsar.radar import LIGHT_M_S, frequency_samples

FREQUENCY = 9e9 + 2e6 * np.arange(16)
ANGLE_DEG = np.linspace(-1.0, 1.0, 5)


def profiles(**changes):
    return {
        "profiles": np.arange(24).reshape(6, 4) * (1 + 2j),
        "range_step_m": 0.375,
        "bandwidth_hz": 400e6,
        "prf_hz": 100.0,
    } | changes


def turntable(x_m=0.0, y_m=0.0, **changes):
    angle = np.deg2rad(ANGLE_DEG)
    distance = x_m * np.cos(angle) + y_m * np.sin(angle)
    return {
        "sig": np.exp(-4j * np.pi / LIGHT_M_S * FREQUENCY[:, None] * distance),
        "freq_hz": FREQUENCY,
        "angle_deg": ANGLE_DEG,
    } | changes


def spotlight(point=(0.0, 0.0, 0.0), **changes):
    azimuth = np.deg2rad(np.linspace(0, 3, 5))
    antenna = 7000.0 * np.stack([np.cos(azimuth), np.sin(azimuth), np.ones(5)], -1)
    r0 = np.linalg.norm(antenna, axis=-1)
    distance = np.linalg.norm(antenna - np.array(point), axis=-1) - r0
    samples = np.exp(-4j * np.pi / LIGHT_M_S * FREQUENCY[:, None] * distance)
    return {
        "fp": samples,
        "freq_hz": FREQUENCY,
        "x_m": antenna[:, 0],
        "y_m": antenna[:, 1],
        "z_m": antenna[:, 2],
        "r0_m": r0,
        "af_r_m": np.ones(5),
    } | changes


def saved(tmp_path, values):
    path = tmp_path / "target.npz"
    np.savez(path, **{key: value for key, value in values.items() if value is not None})
    return path


def test_profiles_have_the_samples_and_the_step_of_the_file(tmp_path):
    recording = read_inverse(saved(tmp_path, profiles()))
    pulse, range_ = recording.signal.axes
    assert (
        recording.signal.names == ("pulse", "range")
        and recording.signal.data.shape == (4, 6)
        and recording.signal.data.dtype == torch.complex64
    )
    assert complex(recording.signal.data[1, 2]) == (2 * 4 + 1) * (1 + 2j)
    assert range_.step == pytest.approx(0.375) and range_.values()[3] == 0 and pulse.step == pytest.approx(0.01)
    assert recording.radar.carrier_hz == 5.52e9 and recording.radar.rotation_rad_s is None and not recording.aux
    assert read_inverse(saved(tmp_path, profiles(f0_hz=10e9))).radar.carrier_hz == 10e9


@pytest.mark.parametrize("make", [turntable, spotlight])
def test_frequency_samples_are_recovered(tmp_path, make):
    rng = np.random.default_rng(0)
    values = make()
    key = "sig" if "sig" in values else "fp"
    values[key] = rng.standard_normal((16, 5)) + 1j * rng.standard_normal((16, 5))
    recording = read_inverse(saved(tmp_path, values), torch.complex128)
    torch.testing.assert_close(frequency_samples(recording.signal.data), torch.from_numpy(values[key]).mT)
    assert float(recording.signal.data.abs().square().sum()) == pytest.approx(np.sum(np.abs(values[key]) ** 2))
    assert torch.equal(recording.aux["frequency_hz"], torch.from_numpy(FREQUENCY))


def test_range_increases_away_from_the_radar(tmp_path):
    cell = LIGHT_M_S / (2 * 16 * 2e6)
    far = read_inverse(saved(tmp_path, turntable(x_m=3 * cell))).signal
    assert far.axis("range").step == pytest.approx(cell)
    torch.testing.assert_close(
        far.axis("range").values()[far.data.abs().argmax(-1)], torch.full((5,), 3 * cell, dtype=torch.float64)
    )
    # the antenna is at +x and +z: a point that is lower or at -x is farther away
    behind = read_inverse(saved(tmp_path, spotlight((-3 * cell, 0.0, -3 * cell)))).signal
    assert behind.axis("range").values()[behind.data.abs().argmax(-1)].min() > 3 * cell


def test_geometry_and_radar_of_a_turntable(tmp_path):
    recording = read_inverse(saved(tmp_path, turntable()))
    torch.testing.assert_close(recording.aux["angle_rad"], torch.from_numpy(np.deg2rad(ANGLE_DEG)))
    radar = recording.radar
    assert (radar.carrier_hz, radar.bandwidth_hz, radar.prf_hz) == (FREQUENCY[8], pytest.approx(32e6), 1.0)
    assert radar.rotation_rad_s == pytest.approx(math.radians(0.5))
    assert read_inverse(saved(tmp_path, turntable(prf_hz=50.0))).radar.rotation_rad_s == pytest.approx(math.radians(25))


def test_geometry_and_radar_of_a_spotlight(tmp_path):
    recording = read_inverse(saved(tmp_path, spotlight()))
    assert recording.aux["position_m"].shape == (5, 3) and recording.aux["position_m"].dtype == torch.float64
    assert recording.radar.reference_range_m == pytest.approx(7000 * math.sqrt(2))
    # for small angles the line of sight turns by the azimuth times cos(elevation)
    assert recording.radar.rotation_rad_s == pytest.approx(math.radians(3) / 4 * math.cos(math.pi / 4), rel=1e-3)
    assert set(recording.aux) == {"frequency_hz", "position_m", "reference_m"}


@pytest.mark.parametrize(
    ("values", "match"),
    [
        (
            {"freq_hz": FREQUENCY},
            r"exactly one of the sample arrays.*profiles with range_step_m.*got none among the keys \['freq_hz'\]",
        ),
        (turntable() | spotlight(), r"exactly one of the sample arrays .* got \['sig', 'fp'\] among"),
        (turntable(angle_deg=None), r"lacks the keys \['angle_deg'\]; an archive with 'sig'"),
        (spotlight(y_m=None, r0_m=None), r"lacks the keys \['y_m', 'r0_m'\]"),
        (
            profiles(profiles=np.ones((6, 4))),
            r"profiles must be a complex array \(range, pulse\) .* got float64 of shape \(6, 4\)",
        ),
        (spotlight(fp=np.ones((16, 5, 1), complex)), r"fp must be a complex array \(frequency, pulse\)"),
        (profiles(prf_hz=0.0), "prf_hz must be one positive number, got 0.0"),
        (profiles(range_step_m="fine"), "range_step_m must be one positive number, got 'fine'"),
        (profiles(range_step_m=0.75), "range_step_m must be at most .* bandwidth_hz B = 4e.* got 0.75 m"),
        (turntable(freq_hz=FREQUENCY[::-1].copy()), "freq_hz: .* must rise in equal steps"),
        (turntable(freq_hz=FREQUENCY + 1e4 * np.arange(16) ** 2), "freq_hz: .* must rise in equal steps"),
        (turntable(freq_hz=FREQUENCY[:-1]), r"freq_hz must be 16 finite real numbers, got float64 of shape \(15,\)"),
        (turntable(angle_deg=np.full(5, np.nan)), "angle_deg must be 5 finite real numbers"),
        (spotlight(r0_m=np.zeros(5)), "r0_m must be positive"),
        (turntable(sig=np.full((16, 5), np.nan + 0j)), "80 of 80 samples are NaN or Inf"),
        (
            turntable(sig=np.array([None], dtype=object)),
            "sig must hold plain numbers without pickled objects, got object",
        ),
    ],
)
def test_invalid_files_raise_with_the_name_of_the_file(tmp_path, values, match):
    with pytest.raises(ValueError, match=match) as raised:
        read_inverse(saved(tmp_path, values))
    assert "target.npz" in str(raised.value)


def test_missing_files_and_files_of_other_formats_raise(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"absent\.npz does not exist"):
        read_inverse(tmp_path / "absent.npz")
    (tmp_path / "text.npz").write_text("not an archive")
    with pytest.raises(ValueError, match=r"text\.npz must be a numpy archive"):
        read_inverse(tmp_path / "text.npz")


def test_recorded_aircraft_is_in_focus_after_a_doppler_transform(recorded):
    recording = read_inverse(recorded("isar_yak42_a.npz"))
    n = recording.signal.axes[0].n
    image = centred_fft(recording.signal.data * torch.hann_window(n + 2, periodic=False)[1:-1, None], -2)
    assert float(entropy(image)) == pytest.approx(5.437, abs=0.005) and float(contrast(image)) == pytest.approx(
        21.7, abs=0.1
    )
    energy = image.abs().square().sum(-2)
    # the target lies in these cells, and is not mirrored in range
    assert energy[85:176].sum() > 0.98 * energy.sum()
