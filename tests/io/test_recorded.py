"""Reader of raw stripmap recordings, and its errors."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.helpers import small_radar
from torchsar.core import Recording
from torchsar.io import read_stripmap


def archive(tmp_path, **changes):
    rng = np.random.default_rng(0)
    values = {
        "iq": rng.integers(-7, 8, (6, 80, 2)).astype(np.int8),
        "fs_hz": 50e6,
        "prf_hz": 400.0,
        "f0_hz": 5.3e9,
        "chirp_rate_hz_s": -0.72e12,
        "pulse_s": 1e-6,
        "slant_range_cell1_m": 9000.0,
        "first_cell": 11,
        "v_eff_m_s": 7000.0,
        "agc_db": np.array([0, 20, 0, 0, 0, 0], np.uint8),
        "c_m_s": 2.9979e8,
        "doppler_ambiguity": -6,
    }
    values.update(changes)
    path = tmp_path / "raw.npz"
    np.savez(path, **{k: v for k, v in values.items() if v is not None})
    return path, values


def test_axes_chirp_and_gain_come_from_the_file(tmp_path):
    path, values = archive(tmp_path)
    recording = read_stripmap(path)
    assert recording.signal.names == ("pulse", "range") and recording.signal.data.dtype == torch.complex64
    assert recording.signal.axis("range").start == pytest.approx(9000 + 10 * 2.9979e8 / 100e6)
    assert recording.radar.pulse.direction == -1 and recording.radar.pulse.bandwidth_hz == pytest.approx(0.72e6)
    assert recording.radar.pointing_doppler_hz is None  # the ambiguity in the file is ignored
    sample = values["iq"][1, 3]
    assert complex(recording.signal.data[1, 3]) == pytest.approx(10 * complex(sample[0], sample[1]))


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"prf_hz": None}, r"lacks the keys \['prf_hz'\]"),
        ({"iq": np.zeros((4, 5))}, r"iq must be complex \(line, sample\) or \(line, sample, 2\)"),
        ({"agc_db": np.zeros(3)}, "agc_db has 3 entries for 6 lines"),
        ({"iq": np.full((6, 80, 2), np.nan, np.float32)}, "480 of 480 samples are NaN or Inf"),
        ({"prf_hz": -1.0}, "raw.npz: prf_hz must be one positive number, got -1.0"),
        (
            {"iq": np.array([None], dtype=object)},
            "raw.npz: iq must hold plain numbers without pickled objects, got object",
        ),
        ({"iq": np.zeros((6, 80, 2), bool)}, "iq must be complex .* got bool"),
        ({"f0_hz": 5.3e6}, r"f0_hz is 5.3e\+06 Hz, and should be 1.9986e\+07 to 9.993e\+15 Hz; if it is in MHz"),
        ({"fs_hz": 0.0}, "raw.npz: fs_hz must be one positive number, got 0.0"),
        ({"fs_hz": np.array([50e6])}, r"fs_hz must be one positive number, got \[50000000.0\]"),
        ({"f0_hz": "high"}, "f0_hz must be one positive number, got 'high'"),
        ({"chirp_rate_hz_s": np.nan}, "chirp_rate_hz_s must be one number other than zero, got nan"),
        ({"c_m_s": np.inf}, "c_m_s must be one positive number, got inf"),
        (
            {"iq": np.zeros((0, 80, 2), np.int8)},
            r"raw.npz: iq must be complex .* at least one sample, got int8 of shape \(0, 80, 2\)",
        ),
        ({"first_cell": 1.7}, "first_cell must be one whole number, got 1.7"),
        ({"agc_db": np.float64(3)}, "agc_db has 1 entries for 6 lines"),
        ({"agc_db": np.array(["loud"] * 6)}, "raw.npz: agc_db: expected numbers in an array or a tensor, got <U4"),
        ({"agc_db": np.full(6, np.nan)}, "agc_db must be finite and within"),
        ({"line_number": np.arange(6) + 0.5}, "line_number must hold whole numbers"),
        ({"line_number": np.full(6, np.inf)}, "line_number must hold whole numbers"),
        ({"line_number": np.ones(6, bool)}, "line_number must hold whole numbers, got torch.bool"),
        ({"pilot": np.ones((2, 7))}, "pilot must be one row of samples, got float64"),
        (
            {"line_number": np.zeros((2, 6), int)},
            r"line_number must hold real numbers, .* got torch.int64 of shape \(2, 6\)",
        ),
    ],
)
def test_invalid_files_raise_with_the_name_of_the_key(tmp_path, changes, match):
    path, _ = archive(tmp_path, **changes)
    with pytest.raises(ValueError, match=match):
        read_stripmap(path)


def test_missing_files_and_files_of_other_formats_raise(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"absent\.npz does not exist; give .* with raw stripmap data$"):
        read_stripmap(tmp_path / "absent.npz")
    (tmp_path / "text.npz").write_text("not an archive")
    with pytest.raises(ValueError, match="text.npz must be a numpy archive .* but it is a file of another kind"):
        read_stripmap(tmp_path / "text.npz")


def test_own_arrays_in_batches():
    data = torch.randn(3, 6, 80, dtype=torch.complex128)
    recording = Recording.from_arrays(
        data, small_radar(), dtype=torch.complex128, agc_db=torch.zeros(3, 6), line_number=torch.arange(6).expand(3, 6)
    )
    assert recording.signal.trials == (3,)
    assert torch.equal(recording.signal.data, data)
    with pytest.raises(ValueError, match="expected complex samples"):
        Recording.from_arrays(data.real, small_radar())


def test_own_data_that_are_not_arrays_raise():
    with pytest.raises(ValueError, match="data: expected numbers"):
        Recording.from_arrays(None, small_radar())
    with pytest.raises(ValueError, match="dtype must be complex64 or complex128, got torch.float32"):
        Recording.from_arrays(torch.ones(6, 80, dtype=torch.complex64), small_radar(), dtype=torch.float32)


def test_lines_of_zeros_raise_a_warning():
    data = torch.ones(6, 80, dtype=torch.complex64)
    data[3:5] = 0
    with pytest.warns(UserWarning, match="data: 2 of 6 lines hold only zeros, the first is line 3"):
        Recording.from_arrays(data, small_radar())


def test_recorded_block_is_read(recorded):
    recording = read_stripmap(recorded("radarsat1_english_bay.npz"))
    assert recording.signal.data.shape == (1424, 2848)
    assert recording.radar.pulse.direction == -1
    assert recording.radar.pulse_samples == 1350  # of 1349.2 sample intervals, the first at its leading edge


@pytest.mark.parametrize("dwell_s", [None, 0.7])
def test_the_dwell_of_the_beam_is_optional(tmp_path, dwell_s):
    path, _ = archive(tmp_path, integration_s=dwell_s)
    assert read_stripmap(path).radar.integration_s == dwell_s
    path, _ = archive(tmp_path, integration_s=-1.0)
    with pytest.raises(ValueError, match="integration_s must be one positive number, got -1"):
        read_stripmap(path)


@pytest.mark.parametrize(
    ("key", "factor", "said"),
    [
        ("f0_hz", 1e-9, "if it is in GHz"),
        ("fs_hz", 1e-6, "if it is in MHz"),
        ("pulse_s", 1e6, "if it is in us"),
        ("slant_range_cell1_m", 1e-3, "if it is in km"),
        ("v_eff_m_s", 1e-3, "if it is in km/s"),
    ],
)
def test_a_likely_unit_is_named(tmp_path, key, factor, said):
    satellite = {"fs_hz": 32e6, "prf_hz": 1257.0, "f0_hz": 5.3e9, "chirp_rate_hz_s": -7e11, "pulse_s": 41.7e-6}
    satellite |= {"slant_range_cell1_m": 988e3, "v_eff_m_s": 7066.0}
    iq = np.random.default_rng(1).normal(size=(8, 9)) + 1j
    np.savez(tmp_path / "a.npz", iq=iq, **(satellite | {key: satellite[key] * factor}))
    with pytest.raises(ValueError, match=f"a.npz: {key} is .*{said}"):
        read_stripmap(tmp_path / "a.npz")
