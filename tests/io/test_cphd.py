"""CPHD files: both domains, both signs, one antenna and two; written files against the standard."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.io.scenes import FRAME, POINT, PULSES, SAMPLES, Built, recorded
from torchsar.core import Recording
from torchsar.focus import backproject
from torchsar.io import read, read_cphd, read_history, write_cphd
from torchsar.radar import LIGHT_M_S, AntennaPath, LocalFrame, frequency_samples, range_profiles

pytest.importorskip("sarkit", reason="sarkit is not installed (extra `formats`)")
POINTS = torch.from_numpy(POINT)


def expected(recording: Recording, point: torch.Tensor) -> torch.Tensor:
    """Phase history of a point by the side data of a recording."""
    aux = recording.aux
    antennas = AntennaPath(aux["transmitter_m"], aux.get("receiver_m"), aux["path_reference_m"])
    turns = antennas.path_m(point[None]) * aux["frequency_hz"] / LIGHT_M_S
    return torch.polar(torch.ones_like(turns), -2 * torch.pi * (turns - turns.round()))


def at(recording: Recording, points: torch.Tensor) -> torch.Tensor:
    """Image at points, relative to a perfect one."""
    aux = recording.aux
    history = frequency_samples(recording.signal.data)
    places = aux["transmitter_m"], aux.get("receiver_m"), aux["path_reference_m"]
    return backproject(history, aux["frequency_hz"], *places, points[None])[0] / history.numel()


@pytest.mark.parametrize("bistatic", [False, True])
@pytest.mark.parametrize("sign", [-1, 1])
@pytest.mark.parametrize("domain", ["FX", "TOA"])
def test_a_point_by_the_formulas_of_the_standard(tmp_path, domain, sign, bistatic):
    built = Built(domain, sign, bistatic)
    recording = read(built.write(tmp_path / "point.cphd"), torch.complex128)
    assert isinstance(recording, Recording) and ("receiver_m" in recording.aux) == bistatic
    history, model = frequency_samples(recording.signal.data), expected(recording, POINTS)
    f = recording.aux["frequency_hz"]
    lit = (f >= built.low - 1) & (f <= built.high + 1)
    assert int(lit.sum()) == (SAMPLES if domain == "FX" else 53)
    torch.testing.assert_close(history, torch.where(lit, model, 0), rtol=0, atol=1e-6)  # single precision
    torch.testing.assert_close(recording.aux["transmitter_m"][0], torch.from_numpy(built.tx[0]), rtol=0, atol=0.03)
    assert recording.radar.prf_hz == pytest.approx(200.0) and recording.signal.axes[0].start == pytest.approx(1.0)
    torch.testing.assert_close(recording.aux["scene_reference_m"], torch.from_numpy(built.srp), rtol=0, atol=1e-8)
    assert float(recording.aux["scene_corners_m"][:, :2].abs().min()) == pytest.approx(37.3, abs=0.2)


def test_two_antennas_stay_two_where_one_would_not_do(tmp_path):
    built = Built(bistatic=True)
    built.bistatic = False  # the file calls them monostatic
    recording = read_cphd(built.write(tmp_path / "point.cphd"), torch.complex128)
    torch.testing.assert_close(recording.aux["receiver_m"], torch.from_numpy(built.rx), rtol=0, atol=1e-8)
    assert abs(complex(at(recording, POINTS)) - 1) < 1e-6


def test_integer_samples_have_their_scale_and_vectors_their_band(tmp_path):
    band = {"FX1": 9.5e9, "SIGNAL": np.arange(PULSES) > 0}
    missing = {"TxTime": np.where(np.arange(PULSES) == 9, np.nan, Built().time)}
    for form, step in (("CI2", 0.01), ("CI4", 0.01)):
        file = Built(form=form).write(tmp_path / "point.cphd", {**band, **missing})
        with pytest.warns(UserWarning, match="lines hold only zeros, the first is line 0"):
            recording = read_cphd(file, torch.complex128)
        history, model = frequency_samples(recording.signal.data), expected(recording, POINTS)
        lit = recording.aux["frequency_hz"] >= 9.5e9 - 3e6
        assert len(history) == PULSES - 1 and not history[0].abs().max() > 1e-12
        torch.testing.assert_close(history[1:], torch.where(lit, model, 0)[1:], rtol=0, atol=0.8 * step)


def test_vectors_of_different_bands_are_resampled(tmp_path, monkeypatch):
    drawn = np.random.default_rng(3)
    start, step = 9.45e9 + drawn.uniform(0, 2e7, PULSES), 4.8e6 * drawn.uniform(0.97, 1.0, PULSES)
    file = Built("FX", 1, True, start, step).write(tmp_path / "point.cphd")
    recording = read_cphd(file, torch.complex128)
    monkeypatch.setattr("torchsar.io.cphd._BLOCK", 500)  # in parts of few vectors
    torch.testing.assert_close(read_cphd(file, torch.complex128).signal.data, recording.signal.data)
    assert SAMPLES < len(recording.aux["frequency_hz"]) < SAMPLES + 8
    history, model = frequency_samples(recording.signal.data), expected(recording, POINTS)
    inner = slice(12, -12)  # of all bands; a band that ends leaves ripples near its ends
    assert float((history - model)[:, inner].abs().square().mean().sqrt()) < 0.04
    assert abs(complex((history * model.conj())[:, inner].mean()) - 1) < 2e-3


@pytest.mark.parametrize("bistatic", [False, True])
def test_a_written_file_passes_the_checks_and_holds_every_bit(tmp_path, bistatic):
    import sarkit.cphd as sarkit
    from sarkit.verification import CphdConsistency

    recording, path = recorded(bistatic), tmp_path / "written.cphd"
    write_cphd(recording, path, FRAME, mode="STRIPMAP" if bistatic else "SPOTLIGHT")
    with path.open("rb") as file:
        checker = CphdConsistency.from_file(file, thorough=True)
        checker.check()
        assert list(checker.failures()) == []
        file.seek(0)
        samples, _ = sarkit.Reader(file).read_channel("1")
    history = frequency_samples(recording.signal.data).to(torch.complex64)
    np.testing.assert_array_equal(samples, history.numpy())
    back = read_cphd(path, torch.complex128)
    for name in recording.aux.keys() & back.aux.keys():
        torch.testing.assert_close(back.aux[name], recording.aux[name], rtol=1e-15, atol=5e-9)
    assert ("receiver_m" in back.aux) == bistatic and LocalFrame(*back.aux["origin_deg_m"].tolist()) == FRAME
    write_cphd(back, tmp_path / "again.cphd")
    with path.open("rb") as one, (tmp_path / "again.cphd").open("rb") as other:
        np.testing.assert_array_equal(*(sarkit.Reader(file).read_signal("1") for file in (one, other)))
    assert abs(abs(complex(at(back, POINTS))) - 1) < 0.05 and sorted(p.name for p in tmp_path.iterdir()) == [
        "again.cphd",
        "written.cphd",
    ]


def test_samples_are_turned_to_the_reference_point(tmp_path):
    recording = recorded()
    aux = recording.aux
    longer = 0.7 * torch.sin(torch.arange(PULSES, dtype=torch.float64))[:, None]
    turns = longer * aux["frequency_hz"] / LIGHT_M_S
    history = expected(recording, POINTS) * torch.polar(torch.ones_like(turns), 2 * torch.pi * turns)
    signal = recording.signal.with_data(range_profiles(history))
    aux = {**aux, "path_reference_m": aux["path_reference_m"] + longer[:, 0]}
    other = Recording(signal, recording.radar, aux)
    write_cphd(other, tmp_path / "a.cphd", FRAME)
    back = read_cphd(tmp_path / "a.cphd", torch.complex128)
    torch.testing.assert_close(frequency_samples(back.signal.data), expected(back, POINTS), rtol=0, atol=2e-6)


def test_a_fixed_transmitter_is_written(tmp_path):
    import sarkit.cphd as sarkit

    recording = recorded(True)
    aux = {**recording.aux, "transmitter_m": recording.aux["transmitter_m"][:1].expand(PULSES, 3)}
    write_cphd(Recording(recording.signal, recording.radar, aux), tmp_path / "a.cphd", FRAME)
    with (tmp_path / "a.cphd").open("rb") as file:
        tree = sarkit.Reader(file).metadata.xmltree
    assert [node.tag for node in tree.iter() if (node.text or "").lower() == "nan"] == []
    assert read_history(tmp_path / "a.cphd").aux["transmitter_m"].std(0).max() < 1e-8


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (
            lambda r: recorded(trials=range(2)),
            r"one trial, and .* has trials of shape \(2,\)",
        ),
        (lambda r: Recording(r.signal, r.radar, {}), "side data lack"),
    ],
)
def test_recordings_that_cannot_be_written(tmp_path, change, match):
    with pytest.raises(ValueError, match=match):
        write_cphd(change(recorded()), tmp_path / "a.cphd", FRAME)
    with pytest.raises(ValueError, match="give frame=LocalFrame"):
        write_cphd(recorded(), tmp_path / "a.cphd")
    with pytest.raises(FileNotFoundError, match="its folder does not exist"):
        write_cphd(recorded(), tmp_path / "no" / "a.cphd", FRAME)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("built", "vectors", "match"),
    [
        (Built("TOA", start=np.linspace(-9e-8, -8e-8, PULSES)), {}, ""),
        (Built("TOA"), {"FX1": np.linspace(9.4e9, 9.5e9, PULSES)}, "one FX1 \\+ FX2"),
        (Built("TOA"), {"SCSS": np.linspace(2.7e-9, 2.8e-9, PULSES)}, "one positive SCSS"),
        (Built(), {"SC0": np.linspace(1e9, 9e9, PULSES)}, "more than 4 times the band"),
        (Built(), {"TxTime": np.ones(PULSES)}, "rising times"),
        (Built(), {"TxPos": np.nan}, "0 vectors with finite parameters"),
    ],
)
def test_vectors_that_vary_are_read_or_refused(tmp_path, built, vectors, match):
    path = built.write(tmp_path / "a.cphd", vectors)
    if not match:
        assert abs(complex(at(read_cphd(path, torch.complex128), POINTS))) * SAMPLES / 53 > 0.99
        return
    with pytest.raises(ValueError, match=match) as caught:
        read_cphd(path)
    assert str(caught.value).startswith(str(path))


def test_channels_are_named(tmp_path):
    with pytest.raises(ValueError, match=r"has no channel 'HV'; it has \['main'\]"):
        read_cphd(Built().write(tmp_path / "a.cphd"), channel="HV")


def test_vectors_without_numbers_are_named_and_left_out(tmp_path):
    built = Built()
    broken = built.vectors()["TxTime"].copy()
    broken[7:10] = np.nan
    with pytest.warns(UserWarning, match=r"lost.cphd: 3 of 48 vectors have no finite .* the first of them 7, 8, 9"):
        recording = read_cphd(built.write(tmp_path / "lost.cphd", {"TxTime": broken}), torch.complex128)
    assert len(recording.signal.data) == PULSES - 3
    assert abs(complex(at(recording, POINTS)) - 1) < 1e-6


def test_the_area_lies_in_the_plane_through_the_reference_point(tmp_path):
    corners = read_cphd(Built().write(tmp_path / "a.cphd")).aux["scene_corners_m"]
    assert (corners[:, 2] == 0).all()


@pytest.mark.parametrize(
    ("start", "match"),
    [
        (b"<html><body>404", "begins with b'<html><body>404' instead of CPHD/ and a version, as a page of the web"),
        (b"CPHD/0.3\nXML_DATA_SIZE := 1", r"its version is 0\.3, and 1\.0\.1 and 1\.1\.0 are read"),
        (b"", "begins with b'' instead of CPHD/"),
    ],
)
def test_other_files_are_named(tmp_path, start, match):
    (tmp_path / "other.cphd").write_bytes(start)
    with pytest.raises(ValueError, match=f"other.cphd cannot be read as CPHD: .*{match}") as error:
        read_cphd(tmp_path / "other.cphd")
    assert "\n" not in str(error.value)
