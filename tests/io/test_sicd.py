"""SICD files: the checks of another library, spatial frequencies, positions, and reading back."""

from __future__ import annotations

import math
import warnings

import numpy as np
import pytest
import torch

from tests.io.scenes import FRAME, POINT, PULSES, imaged, recorded
from torchsar.core import Recording, Signal, unit_phasor
from torchsar.focus import DirectImage, PathImage, TileImage, backproject
from torchsar.io import read, read_sicd, write_sicd
from torchsar.radar import frequency_samples, range_profiles

pytest.importorskip("sarkit", reason="sarkit is not installed (extra `formats`)")


def fixed(recording: Recording) -> Recording:
    """The recording with a transmitter at rest, and a point at the origin."""
    aux = {**recording.aux, "transmitter_m": recording.aux["transmitter_m"][:1].expand(PULSES, 3)}
    legs = sum(torch.linalg.vector_norm(aux[f"{name}_m"], dim=-1) for name in ("transmitter", "receiver"))
    signal = recording.signal.with_data(range_profiles(torch.ones_like(recording.signal.data)))
    return Recording(signal, recording.radar, {**aux, "path_reference_m": legs})


CASES = {
    "one antenna": lambda: (recorded(), {}),
    "two antennas": lambda: (recorded(True), {"window": "none"}),
    "one of two at rest": lambda: (fixed(recorded(True)), {}),
}
# axes of the image against the line of sight: each quarter turn of the pixels
ANGLES = (0.1, math.pi / 2, math.pi - 0.3, -math.pi / 2 + 0.4)


def formed(recording: Recording, **keys) -> tuple[PathImage, Signal]:
    stage = DirectImage(30.0, 28.0, 0.5, **keys)
    return stage, imaged(stage, recording)


def metadata(path):
    import sarkit.sicd as sarkit

    with path.open("rb") as file:
        reader = sarkit.NitfReader(file)
        return sarkit.XmlHelper(reader.metadata.xmltree), reader.read_image()


def failures(path) -> list[str]:
    from sarkit.verification import SicdConsistency

    with path.open("rb") as file:
        checker = SicdConsistency.from_file(file)
        checker.check()
    found = [(name, one) for name, check in checker.failures().items() for one in check["details"]]
    return [f"{name}: {one['details']}" for name, one in found if one["severity"] == "Error" and not one["passed"]]


@pytest.mark.parametrize("case", CASES)
def test_files_pass_the_checks_and_give_the_samples_back(tmp_path, case):
    recording, keys = CASES[case]()
    stage, image = formed(recording, **keys)
    path = tmp_path / "image.nitf"
    write_sicd(image, path, recording, stage, FRAME)
    assert failures(path) == []
    xml, _ = metadata(path)
    back = read(path, torch.complex128)
    assert back.axes == image.axes
    centred = [axis.offsets() - axis.n // 2 * axis.step for axis in image.axes]
    carrier = [
        unit_phasor(xml.load(f"{{*}}Grid/{{*}}{side}/{{*}}KCtr") * x, torch.complex128)
        for side, x in zip(("Col", "Row"), centred)
    ]
    restored = back.data * carrier[0][:, None] * carrier[1]
    torch.testing.assert_close(restored, image.data, rtol=0, atol=2e-7 * float(image.data.abs().max()))


@pytest.mark.parametrize("turn", ANGLES)
def test_spatial_frequencies_lie_where_the_file_says_and_points_where_they_are(tmp_path, turn):
    import sarkit.sicd.projection as projection

    recording = recorded()
    sin, cos = math.sin(turn), math.cos(turn)
    centre = 0.6 * (cos * POINT[0] + sin * POINT[1]), 0.6 * (cos * POINT[1] - sin * POINT[0])
    stage = DirectImage(26.0, 32.0, 0.5, centre, turn, window="none")
    places = recording.aux["transmitter_m"], None, recording.aux["path_reference_m"]
    image = imaged(stage, recording)
    path = tmp_path / "image.nitf"
    write_sicd(image, path, recording, stage, FRAME)
    assert failures(path) == []
    xml, samples = metadata(path)
    # a point of known position
    target = FRAME.geocentric_m(torch.from_numpy(POINT)).numpy()
    grid = projection.scene_to_image(projection.MetadataParams.from_xml(xml.element_tree), target)[0]
    row, column = np.array(grid) / 0.5 + xml.load("{*}ImageData/{*}SCPPixel")
    peak = np.unravel_index(np.abs(samples).argmax(), samples.shape)
    assert np.abs(np.array(peak) - (row, column)).max() < 0.75
    # samples of the image about the centre, fine enough for its carrier, by the direct sum
    centre = FRAME.local_m(torch.tensor(xml.load("{*}GeoData/{*}SCP/{*}ECF")))
    pulse, f = recording.aux["transmitter_m"], recording.aux["frequency_hz"]
    turns = 2 * f * (torch.linalg.vector_norm(pulse - centre, dim=-1)[:, None] - places[2][:, None] / 2) / 299792458.0
    history = torch.polar(torch.ones_like(turns), -2 * torch.pi * (turns - turns.round()))  # a point at the centre
    origin = FRAME.geocentric_m(torch.zeros(3, dtype=torch.float64))
    for side in ("Row", "Col"):
        of = {key: xml.load(f"{{*}}Grid/{{*}}{side}/{{*}}{key}") for key in ("UVectECF", "KCtr", "ImpRespBW", "Sgn")}
        axis = FRAME.local_m(torch.tensor(of["UVectECF"]) + origin)
        x = torch.arange(-800, 800, dtype=torch.float64) * 0.01
        line = backproject(history, f, *places, centre + x[:, None] * axis)
        k = torch.fft.fftfreq(len(x), 0.01, dtype=torch.float64)
        transform = torch.fft.fft if of["Sgn"] < 0 else torch.fft.ifft
        power = transform(line).abs() ** 2
        inside = (k - of["KCtr"]).abs() <= of["ImpRespBW"] / 2 + 0.1
        assert float(power[inside].sum() / power.sum()) > 0.95
        half = (k - of["KCtr"]).abs() <= 0.25 * of["ImpRespBW"]
        assert float(power[half].sum() / power.sum()) < 0.9  # the band is not wider than the spectrum
    # samples of the file are those of the image at their position, without the carrier
    pixel = np.array(peak) - xml.load("{*}ImageData/{*}SCPPixel")
    sides = ("Row", "Col")
    along = [FRAME.local_m(torch.tensor(xml.load(f"{{*}}Grid/{{*}}{side}/{{*}}UVectECF")) + origin) for side in sides]
    away = 0.5 * (pixel[0] * along[0] + pixel[1] * along[1])
    direct = backproject(frequency_samples(recording.signal.data), f, *places, (centre + away)[None])[0]
    turns = sum(xml.load(f"{{*}}Grid/{{*}}{side}/{{*}}KCtr") * 0.5 * n for side, n in zip(sides, pixel))
    assert abs(complex(direct) * np.exp(-2j * np.pi * turns) - samples[peak]) < 1e-5 * abs(samples[peak])
    spectrum = np.abs(np.fft.fftshift(np.fft.fft2(samples))) ** 2
    axes = [np.fft.fftshift(np.fft.fftfreq(n, 0.5)) for n in samples.shape]
    for dim, side in enumerate(("Row", "Col")):
        low, high = (xml.load(f"{{*}}Grid/{{*}}{side}/{{*}}DeltaK{i}") for i in (1, 2))
        part = spectrum.sum(1 - dim)
        assert part[(axes[dim] >= low - 0.05) & (axes[dim] <= high + 0.05)].sum() > 0.97 * part.sum()


def test_times_of_a_strip_follow_the_beam(tmp_path):
    recording = recorded()
    stage = TileImage(10.0, 10.0, 0.5, window="range", error_db=-40.0, beam_deg=0.25, squint_deg=0.0)
    write_sicd(imaged(stage, recording), tmp_path / "a.nitf", recording, stage, FRAME, mode="STRIPMAP")
    assert failures(tmp_path / "a.nitf") == []
    xml, _ = metadata(tmp_path / "a.nitf")
    poly = xml.load("{*}Grid/{*}TimeCOAPoly")
    assert poly[0, 1] == pytest.approx(1 / 400.0, rel=0.1)  # seconds per metre along the path
    assert poly[0, 0] == pytest.approx(48 / 400, abs=0.01)


def test_pixels_of_other_types_are_read(tmp_path):
    import sarkit.sicd as sarkit

    recording = recorded()
    stage, image = formed(recording)
    write_sicd(image, tmp_path / "a.nitf", recording, stage, FRAME)
    with (tmp_path / "a.nitf").open("rb") as file:
        reader = sarkit.NitfReader(file)
        values, meta = reader.read_image(), reader.metadata
    scale = 1000 / np.abs(values).max()
    for pixel, parts in {
        "RE16I_IM16I": (values.real * scale, values.imag * scale),
        "AMP8I_PHS8I": (np.abs(values) * scale / 4, np.angle(values) / (2 * np.pi) * 256 % 256),
    }.items():
        meta.xmltree.find("{*}ImageData/{*}PixelType").text = pixel
        kind = sarkit.PIXEL_TYPES[pixel]["dtype"]
        made = np.zeros(values.shape, kind)
        for name, part in zip(kind.names, parts):
            made[name] = np.rint(part) % 256 if pixel.startswith("AMP") else np.rint(part)
        with (tmp_path / "b.nitf").open("wb") as file, sarkit.NitfWriter(file, meta) as writer:
            writer.write_image(made)
        back = read_sicd(tmp_path / "b.nitf").data.numpy().T
        unit = 1000 if pixel.startswith("RE") else 250
        bright = np.abs(values) > 0.1 * np.abs(values).max()
        np.testing.assert_allclose(back[bright] / unit, values[bright] * scale / 1000, atol=0.02)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"trials": True}, "a file holds one trial, and the image has trials of shape"),
        ({"stage": True}, "but its stage forms"),
        ({"frame": None}, "does not say where on the Earth it lies"),
        ({"axes": True}, r"only images with the axes \('azimuth', 'range'\)"),
        ({"nan": True}, "NaN or Inf"),
    ],
)
def test_images_that_cannot_be_written(tmp_path, change, match):
    recording = recorded()
    stage, image = formed(recording)
    if "trials" in change:
        image = image.with_data(torch.stack([image.data] * 2))
    if "axes" in change:
        image = recording.signal
    if "nan" in change:
        image = image.with_data(image.data * math.nan)
    stage = DirectImage(10.0, 10.0, 0.5) if "stage" in change else stage
    with pytest.raises(ValueError, match=match), warnings.catch_warnings():
        write_sicd(image, tmp_path / "a.nitf", recording, stage, change.get("frame", FRAME))
    assert not list(tmp_path.iterdir())


def test_half_a_file_is_named_without_the_log_of_a_library(tmp_path, caplog):
    file = tmp_path / "cut.nitf"
    file.write_bytes(b"NITF02.10".ljust(342) + b"%012d" % 5000 + bytes(900))
    with pytest.raises(
        ValueError, match=r"cut.nitf cannot be read as SICD: it is cut off: its header counts 5000 bytes"
    ):
        read_sicd(file)
    assert not caplog.records
