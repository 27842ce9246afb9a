"""Recordings of which lines are read, and images that are written in blocks."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.io.test_recorded import archive
from torchsar.core import ArrayFile, Axis
from torchsar.io import StripImage, read_images, read_stripmap
from torchsar.io.strip import StripRecording, samples_checksum

AXES = (Axis("azimuth", 700, 5.0, 2.0, "m"), Axis("range", 30, 100.0, 3.0, "m"))


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("dtype", ["<c8", ">c16", "i1", ">f4"])
def test_rows_are_those_of_the_whole_array(tmp_path, order, dtype):
    x = np.asarray(np.random.default_rng(0).normal(size=(9, 5, 2)) * 50).astype(dtype, order=order)
    np.savez(tmp_path / "a.npz", other=np.arange(77), x=x)
    np.save(tmp_path / "a.npy", x)
    for held in (ArrayFile(tmp_path / "a.npz")["x"], ArrayFile(tmp_path / "a.npy")[""]):
        rows = held.rows(2, 7)
        assert rows.dtype == held.load().dtype and np.array_equal(rows, held.load()[2:7])


def test_rows_of_a_compressed_or_shortened_file_are_refused(tmp_path):
    path = tmp_path / "a.npz"
    np.savez_compressed(path, x=np.zeros((9, 5)))
    with pytest.raises(ValueError, match="x is compressed, so that its rows cannot be read one by one"):
        ArrayFile(path)["x"].rows(0, 1)
    np.savez(path, x=np.zeros((900, 5)))
    held = ArrayFile(path)["x"]
    path.write_bytes(path.read_bytes()[:9000])
    with pytest.raises(ValueError, match="x was cut off while it was read"):
        held.rows(0, 1)


@pytest.mark.parametrize("dtype", [torch.complex64, torch.complex128])
def test_lines_are_those_of_the_whole_recording(tmp_path, dtype):
    path, _ = archive(tmp_path, line_number=np.arange(6) + 10)
    whole, strip = read_stripmap(path, dtype), StripRecording(path, dtype)
    assert strip.radar == whole.radar and strip.axes == whole.signal.axes and strip.shape == (6, 80)
    part = strip.recording(1, 4)
    assert torch.equal(part.signal.data, whole.signal.data[1:4]) and torch.equal(strip[..., 1:4, :], part.signal.data)
    assert part.signal.axes[0] == whole.signal.axes[0].part(1, 4)
    assert part.aux["line_number"].tolist() == [11, 12, 13]


def begun(path, identity=None):
    return StripImage.create(path, AXES, torch.complex64, identity or {"config": 1.0}, {"rows": [1, 1]}, 100)


def test_an_image_is_read_as_it_was_written(tmp_path):
    data = torch.randn(700, 30, dtype=torch.complex64)
    image = begun(tmp_path / "a.zarr")
    assert not StripImage.is_begun(tmp_path / "a.zarr") and not StripImage.is_begun(tmp_path / "none")
    for lines in (slice(0, 300), slice(300, 600), slice(600, 700)):
        assert not image.is_finished(lines)
        image.write(lines, data[lines], samples_checksum(data[lines]))
    again = StripImage(tmp_path / "a.zarr")
    assert again.axes == AXES and again.about == {"rows": [1, 1]} and StripImage.is_begun(tmp_path / "a.zarr")
    again.check(slice(300, 600), samples_checksum(data[300:600]))
    (held,) = read_images(tmp_path / "a.zarr").values()
    assert held.axes == AXES and torch.equal(held.data, data)
    parts = list(again.parts(70))
    assert torch.equal(torch.cat([part.data for _, part in parts]), data) and parts[0][1].axes[0].start == 5.0


def test_parts_are_whole_multiples_and_small(tmp_path, monkeypatch):
    monkeypatch.setattr("torchsar.io.strip._PART_BYTES", 250 * 30 * 8)
    image = begun(tmp_path / "a.zarr")
    with pytest.raises(ValueError, match=r"a\.zarr.* 0 of 7 chunks of 'image' are there; finish"):
        next(image.parts())
    image.write(slice(0, 700), torch.zeros(700, 30, dtype=torch.complex64), 0)
    assert [part.data.shape[0] for _, part in image.parts(7)] == [245, 245, 210]
    assert [part.data.shape[0] for _, part in image.parts()] == [200, 200, 200, 100]  # whole chunks
    assert [part.data.shape[0] for _, part in image.parts(400)] == [400, 300]


def test_another_image_or_a_damaged_one_is_refused(tmp_path):
    path = tmp_path / "a.zarr"
    image, data = begun(path), torch.ones(300, 30, dtype=torch.complex64)
    image.write(slice(0, 300), data, 17)
    image.refuse_another({"config": 1})
    with pytest.raises(ValueError, match="was made with another config, 1.0 instead of 2"):
        image.refuse_another({"config": 2})
    with pytest.raises(ValueError, match="lines 0 to 299 were made from other raw data"):
        image.check(slice(0, 300), 18)
    (path / "image" / "c" / "1" / "0").unlink()  # zarr reads zeros there
    with pytest.raises(ValueError, match="lines 0 to 299 are damaged"):
        image.check(slice(0, 300), 17)
    text = (path / "zarr.json").read_text("utf-8")
    (path / "zarr.json").write_text(text.replace('"rows"', '"bows"'), "utf-8")
    with pytest.raises(ValueError, match="differ from their checksum"):
        StripImage(path)
    with pytest.raises(FileNotFoundError, match="give the folder of the result of torchsar focus"):
        StripImage(tmp_path / "none")
    read_other = tmp_path / "other.zarr"
    pytest.importorskip("zarr").open_group(str(read_other), mode="w", zarr_format=3)
    with pytest.raises(ValueError, match="was not written by this version of torchsar"):
        StripImage(read_other)
