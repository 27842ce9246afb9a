"""The function that reads any format: its choice, absent libraries, and damaged files."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.io.scenes import FRAME, Built, imaged, recorded
from tests.io.test_damaged import PATH, PROFILES, SPOTLIGHT, STRIPMAP, TURNTABLE, loads_or_says, packed
from torchsar.cli import main
from torchsar.core import Recording
from torchsar.focus import DirectImage
from torchsar.io import read, read_cphd, read_history, read_sicd, write_cphd, write_geotiff, write_sicd
from torchsar.io.formats import FORMATS


@pytest.mark.parametrize("members", [STRIPMAP, PROFILES, TURNTABLE, SPOTLIGHT, PATH])
def test_archives_are_read_by_their_keys(tmp_path, members):
    path = tmp_path / "data.any"  # the content decides
    path.write_bytes(packed(members))
    recording = read(path)
    assert isinstance(recording, Recording)
    assert ("transmitter_m" in recording.aux) == (members in (SPOTLIGHT, PATH))


@pytest.mark.parametrize(
    ("name", "content", "match"),
    [
        ("a.xyz", b"nothing", r"is of no known format; files that can be read are .*CPHD \(.cphd\)"),
        ("a.xyz", b"", "is of no known format"),
        ("a.crsd", b"CRSDsar/1.0\n", "received signals before range compression"),
        ("a.csv", b"t,x,y,z\n", "is a table of numbers, such as a motion log.*read_track"),
        ("a.npz", b"", "is empty"),
    ],
)
def test_other_files_give_one_sentence(tmp_path, name, content, match):
    path = tmp_path / name
    path.write_bytes(content)
    for reader in (read, read_history):
        with pytest.raises(ValueError, match=match) as caught:
            reader(path)
        assert str(caught.value).startswith(str(path))
    with pytest.raises(FileNotFoundError, match="does not exist"):
        read(tmp_path / "none.cphd")
    with pytest.raises(FileNotFoundError, match="is no file"):
        read(tmp_path)


def test_the_table_of_formats_has_no_two_owners():
    for field in ("suffixes", "magic"):
        values = [value for one in FORMATS for value in getattr(one, field)]
        assert len(values) == len(set(values))


@pytest.mark.parametrize(
    ("module", "extra"), [("sarkit.cphd", "formats"), ("sarkit.sicd", "formats"), ("rasterio", "geo")]
)
def test_an_absent_library_is_named_with_its_extra(tmp_path, monkeypatch, capsys, module, extra):
    monkeypatch.setitem(sys.modules, module, None)
    path = tmp_path / "a.cphd"
    path.write_bytes(b"CPHD/1.1.0\n")
    recording, stage = recorded(), DirectImage(4.0, 4.0, 1.0)
    image = stage(
        recording.signal,
        **{name: recording.aux[name] for name in ("frequency_hz", "transmitter_m", "path_reference_m")},
    )
    calls = {
        "sarkit.cphd": [lambda: read(path), lambda: write_cphd(recording, tmp_path / "b", FRAME)],
        "sarkit.sicd": [lambda: read_sicd(path), lambda: write_sicd(image, tmp_path / "b", recording, stage, FRAME)],
        "rasterio": [lambda: write_geotiff(image, tmp_path / "b", stage, FRAME)],
    }[module]
    package = module.partition(".")[0]
    for call in calls:
        said = rf'needs the package {package}: pip install "torchsar-lab\[{extra}\]"'
        with pytest.raises(ModuleNotFoundError, match=said):
            call()
    if module == "sarkit.cphd":
        assert main(["run", "spotlight", f"data.file={path}", "--out", str(tmp_path / "out")]) == 2
        said = [line for line in capsys.readouterr().err.splitlines() if line != "torchsar: run spotlight"]
        assert len(said) == 1 and 'pip install "torchsar-lab[formats]"' in said[0]
    assert [one.name for one in tmp_path.iterdir()] == ["a.cphd"]


def damaged(whole: bytes, seed: int) -> bytes:
    """The file cut off, with changed bytes anywhere, in its header, or with exchanged numbers."""
    rng, data = np.random.default_rng(seed), bytearray(whole)
    if seed % 4 == 0:
        return bytes(data[: rng.integers(len(data))])
    reach = len(data) if seed % 4 == 1 else min(len(data), 7000)
    if seed % 4 == 3:
        digits = [i for i, byte in enumerate(data[:reach]) if chr(byte).isdigit()]
        for at in rng.choice(digits, 12):
            data[at] = ord("0") + int(rng.integers(10))
        return bytes(data)
    for at in rng.integers(reach, size=int(rng.integers(1, 40))):
        data[at] = int(rng.integers(256))
    return bytes(data)


@pytest.mark.parametrize("kind", ["cphd", "cphd of delays", "sicd"])
def test_damage_gives_a_sentence_or_loads(tmp_path: Path, kind: str) -> None:
    pytest.importorskip("sarkit", reason="sarkit is not installed (extra `formats`)")
    path = tmp_path / "data.bin"
    if kind == "sicd":
        stage, recording = DirectImage(8.0, 8.0, 0.5), recorded()
        image = imaged(stage, recording)
        write_sicd(image, path, recording, stage, FRAME)
    elif kind == "cphd":
        write_cphd(recorded(), path, FRAME)
    else:
        Built("TOA").write(path)
    whole, reader = path.read_bytes(), read_sicd if kind == "sicd" else read_cphd
    said = []
    for seed in range(48):
        path.write_bytes(damaged(whole, seed))
        if kind == "sicd":
            try:
                assert bool(torch.isfinite(reader(path).data).all())  # pyright: ignore[reportAttributeAccessIssue]
                said.append("")
            except ValueError as error:
                said.append(str(error))
                assert said[-1].startswith(str(path)) and "\n" not in said[-1]
        else:
            said.append(loads_or_says(reader, path))  # pyright: ignore[reportArgumentType]
    assert len(set(said)) > 8


def test_an_image_is_no_phase_history(tmp_path):
    pytest.importorskip("sarkit", reason="sarkit is not installed (extra `formats`)")
    stage, recording = DirectImage(8.0, 8.0, 0.5), recorded()
    image = imaged(stage, recording)
    write_sicd(image, tmp_path / "a.nitf", recording, stage, FRAME)
    with pytest.raises(ValueError, match=r"a.nitf: SICD holds no phase history with positions"):
        read_history(tmp_path / "a.nitf")
