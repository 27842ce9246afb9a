"""Reader of phase histories along any path: positions, navigation records, coordinates, errors."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torchsar.core import Chain, use
from torchsar.focus import DirectImage, TileImage
from torchsar.io import read_inverse, read_path
from torchsar.metrics import entropy, error_db
from torchsar.radar import LIGHT_M_S, LocalFrame, frequency_samples

FREQUENCY = 9e9 + 2e6 * np.arange(32)
TIME = np.arange(41) / 20
POINT = np.array([5.0, -8.0, 0.0])


def transmitter(t: np.ndarray) -> np.ndarray:
    return np.stack([60 * t, -3000 + 0.2 * np.sin(3 * t), 2000 + 0 * t], -1)


RECEIVER = np.array([-500.0, -2500.0, 1500.0])
USES = {name: f"aux.{name}" for name in ("frequency_hz", "transmitter_m", "path_reference_m")}


def archive(**changes):
    """History of a point, with a fixed receiver."""
    place = transmitter(TIME)
    path, reference = (
        np.linalg.norm(place - x, axis=-1) + np.linalg.norm(RECEIVER - x, axis=-1) for x in (POINT, np.zeros(3))
    )
    return {
        "history": np.exp(-2j * np.pi / LIGHT_M_S * FREQUENCY[:, None] * (path - reference)),
        "freq_hz": FREQUENCY,
        "transmitter_m": place,
        "receiver_m": RECEIVER,
        "path_reference_m": reference,
    } | changes


def saved(tmp_path, values):
    path = tmp_path / "path.npz"
    np.savez(path, **{key: value for key, value in values.items() if value is not None})
    return path


def test_samples_and_positions_of_the_file_and_the_image(tmp_path):
    recording = read_path(saved(tmp_path, archive()), torch.complex128)
    assert recording.signal.names == ("pulse", "range") and recording.signal.data.shape == (41, 32)
    history = archive()["history"].T
    torch.testing.assert_close(frequency_samples(recording.signal.data), torch.from_numpy(history))
    assert set(recording.aux) == {"frequency_hz", "transmitter_m", "receiver_m", "path_reference_m"}
    assert recording.aux["receiver_m"].shape == (41, 3) and recording.radar.prf_hz == 1.0
    uses = {**USES, "receiver_m": "aux.receiver_m"}
    images = [
        Chain(image=use(stage(20.0, 24.0, 0.5, window="none"), **uses))(recording) for stage in (TileImage, DirectImage)
    ]
    assert float(error_db(images[0].data, images[1].data)) < -55
    azimuth, range_ = (axis.values() for axis in images[0].axes)
    i, j = divmod(int(images[0].data.abs().argmax()), len(range_))
    assert (float(range_[j]), float(azimuth[i])) == (5.0, -8.0)
    assert abs(images[1].data[i, j]) == pytest.approx(41 * 32, rel=1e-9)


def test_navigation_records_and_geocentric_positions(tmp_path):
    frame, records = LocalFrame(48.0, 11.0, 500.0), np.arange(-2, 45) / 20 + 0.013
    far = {
        "transmitter_m": frame.geocentric_m(torch.from_numpy(transmitter(records))).numpy(),
        "receiver_m": frame.geocentric_m(torch.from_numpy(RECEIVER)).numpy(),
        "origin_deg_m": np.array([48.0, 11.0, 500.0]),
        "pulse_time_s": TIME,
        "transmitter_time_s": records,
    }
    recording = read_path(saved(tmp_path, archive(**far)))
    torch.testing.assert_close(recording.aux["transmitter_m"], torch.from_numpy(transmitter(TIME)), rtol=0, atol=1e-5)
    torch.testing.assert_close(recording.aux["receiver_m"][7], torch.from_numpy(RECEIVER), rtol=0, atol=1e-8)
    assert recording.radar.prf_hz == pytest.approx(20.0) and recording.signal.data.dtype == torch.complex64


@pytest.mark.parametrize(
    ("values", "match"),
    [
        (archive(transmitter_m=None), r"lacks the keys \['transmitter_m'\]"),
        (archive(history=np.ones((4, 4))), r"history must be a complex array \(frequency, pulse\)"),
        (archive(receiver_m=RECEIVER[:2]), r"receiver_m must be real numbers of shape \(41, 3\) or \(3,\), got"),
        (archive(receiver_m=RECEIVER * np.nan), "receiver_m: 3 of 3 values are NaN or Inf"),
        (archive(path_reference_m=np.ones(4)), "path_reference_m must be 41 finite real numbers"),
        (archive(path_reference_m=-np.ones(41)), "paths of 0 m or more, got a mean of -1 m"),
        (archive(freq_hz=FREQUENCY[::-1].copy()), "freq_hz: .* must rise in equal steps"),
        (archive(transmitter_time_s=TIME), "transmitter_time_s needs pulse_time_s"),
        (archive(transmitter_time_s=TIME, pulse_time_s=TIME + 1), "transmitter_m: pulses must lie within the navig"),
        (archive(transmitter_time_s=TIME[::-1].copy(), pulse_time_s=TIME), "transmitter_m: times of a .* must rise"),
        (archive(pulse_time_s=TIME[::-1].copy()), "pulse_time_s must rise"),
        (archive(origin_deg_m=np.array([98.0, 0.0, 0.0])), "origin_deg_m: latitude_deg must be -90 to 90"),
    ],
)
def test_bad_archives_are_refused(tmp_path, values, match):
    path = saved(tmp_path, values)
    with pytest.raises(ValueError, match=match) as caught:
        read_path(path)
    assert str(caught.value).startswith(str(path))


def test_gotcha_by_tiles(recorded):
    file = recorded("gotcha_pass1_hh_az001_003.npz")
    recording = read_path(file)
    assert set(read_inverse(file).aux) < set(recording.aux) and "receiver_m" not in recording.aux
    image = Chain(image=use(TileImage(100.0, 100.0, 0.25), **USES))(recording)
    assert float(entropy(image)) == pytest.approx(8.731, abs=0.002)
    azimuth, range_ = (axis.values() for axis in image.axes)
    i, j = divmod(int(image.data.abs().argmax()), len(range_))
    assert abs(float(range_[j]) + 15.5) <= 0.25 and abs(float(azimuth[i]) - 21.5) <= 0.25


IMPLAUSIBLE = {
    "GHz": (lambda a: {"freq_hz": a["freq_hz"] / 1e9}, "freq_hz is 9.03.* Hz in the middle.*if it is in GHz"),
    "km": (
        lambda a: {"transmitter_m": a["transmitter_m"] / 1e3, "receiver_m": RECEIVER / 1e3},
        "transmitter_m has a distance of 3.*path_reference_m one of .*transmitter_m is probably in km",
    ),
    "degrees": (
        lambda a: {"transmitter_m": np.stack([48 + 1e-5 * TIME, 11 + 0 * TIME, 2000 + 0 * TIME], -1)},
        "transmitter_m moves by 2e-05 m over all pulses.*probably latitude and longitude in degrees",
    ),
    "not geocentric": (
        lambda a: {"origin_deg_m": np.array([48.0, 11.0, 500.0])},
        "transmitter_m must be geocentric .* a distance of 3605 m from the centre of the Earth",
    ),
}


@pytest.mark.parametrize("name", IMPLAUSIBLE)
def test_units_that_physics_excludes(tmp_path, name):
    change, match = IMPLAUSIBLE[name]
    np.savez(tmp_path / "data.npz", **(archive() | change(archive())))
    with pytest.raises(ValueError, match=match) as error:
        read_path(tmp_path / "data.npz")
    assert str(error.value).startswith(str(tmp_path / "data.npz"))
