"""Archives that are damaged, of another kind or of the wrong content give one sentence or load."""

from __future__ import annotations

import io
import shutil
import tracemalloc
import warnings
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.io import savemat

from torchsar.cli import main
from torchsar.core import Recording, stored
from torchsar.io import import_recording, read, read_array, read_inverse, read_path, read_stripmap

Members = dict[str, np.ndarray]
Reader = Callable[[Path], Recording]
_RNG = np.random.default_rng(7)

STRIPMAP: Members = {
    "iq": _RNG.integers(-7, 8, (12, 40, 2)).astype(np.int8),
    **{
        name: np.array(value)
        for name, value in {
            "fs_hz": 50e6,
            "prf_hz": 400.0,
            "f0_hz": 5.3e9,
            "chirp_rate_hz_s": -0.72e12,
            "pulse_s": 1e-7,
            "slant_range_cell1_m": 9000.0,
            "first_cell": 11,
            "v_eff_m_s": 7000.0,
        }.items()
    },
    "agc_db": np.arange(12, dtype=np.uint8),
    "line_number": np.arange(12),
    "pilot": np.exp(1j * np.arange(40)),
}
PROFILES: Members = {
    "profiles": _RNG.normal(size=(6, 8)) * (1 + 2j),
    "range_step_m": np.array(0.375),
    "bandwidth_hz": np.array(400e6),
    "prf_hz": np.array(100.0),
}
TURNTABLE: Members = {
    "sig": _RNG.normal(size=(8, 6)) * (1 + 2j),
    "freq_hz": 9e9 + 2e6 * np.arange(8),
    "angle_deg": np.linspace(-1.0, 1.0, 6),
}
SPOTLIGHT: Members = {
    "fp": _RNG.normal(size=(8, 6)) * (1 + 2j),
    "freq_hz": 9e9 + 2e6 * np.arange(8),
    **{name: np.linspace(7000.0, 7010.0, 6) for name in ("x_m", "y_m", "z_m", "r0_m")},
}
PATH: Members = {
    "history": _RNG.normal(size=(8, 6)) * (1 + 2j),
    "freq_hz": 9e9 + 2e6 * np.arange(8),
    "path_reference_m": np.linspace(7000.0, 7010.0, 6),
    "pulse_time_s": np.arange(6) / 10.0,
    "transmitter_time_s": np.arange(7) / 10.0,
    "transmitter_m": np.linspace(0.0, 70.0, 7)[:, None] * np.ones(3),
    "receiver_m": np.array([1.0, 2.0, 3.0]),
}
ARCHIVES: list[tuple[Reader, Members]] = [
    (read_stripmap, STRIPMAP),
    (read_inverse, PROFILES),
    (read_inverse, TURNTABLE),
    (read_inverse, SPOTLIGHT),
    (read_path, PATH),
]
TYPES = [bool, "U3", "S0", object, "M8[s]", np.clongdouble, np.longdouble, np.float16, ">f8", ">c8", ">i4", np.uint64]
NUMBERS = [np.nan, np.inf, -np.inf, 1e300, -1e300, 1e308, 5e-324, 0.0, -1.0, 1e25]


def packed(members: Members, packing: int = zipfile.ZIP_DEFLATED) -> bytes:
    """The members as an archive, in one of the packings of zipfile."""
    whole = io.BytesIO()
    with zipfile.ZipFile(whole, "w", packing) as archive:
        for name, value in members.items():
            archive.writestr(f"{name}.npy", value if isinstance(value, bytes) else as_npy(value))
    return whole.getvalue()


def as_npy(value: np.ndarray) -> bytes:
    """An array in the format .npy."""
    member = io.BytesIO()
    np.save(member, value)
    return member.getvalue()


def damaged(members: Members, seed: int) -> bytes:
    """An archive with one kind of damage, by turns, at a random place."""
    rng = np.random.default_rng(seed)
    name = str(rng.choice(list(members)))
    value, packing = members[name], int(rng.choice([zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2]))
    whole = bytearray(packed(members, packing))
    kind = seed % 9
    if kind == 0:
        return bytes(whole[: rng.integers(len(whole))])
    if kind in (1, 2):
        for at in rng.integers(len(whole), size=int(rng.integers(1, 40))):
            whole[at] ^= int(rng.integers(1, 256))
        return bytes(whole)
    if kind == 3:  # the bytes of a member instead of those of the archive: checksums fit
        inner = bytearray(as_npy(value))
        for at in rng.integers(len(inner), size=int(rng.integers(1, 9))):
            inner[at] ^= int(rng.integers(1, 256))
        return packed({**members, name: bytes(inner)}, packing)  # pyright: ignore[reportArgumentType]
    if kind == 4:
        return packed({**members, name: rng.bytes(200)}, packing)  # pyright: ignore[reportArgumentType]
    if kind == 5:
        wrong = np.dtype(TYPES[rng.integers(len(TYPES))])
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return packed({**members, name: value.astype(np.int64).astype(wrong)}, packing)
    if kind == 6:
        shapes = [
            value[..., None],
            value[None],
            value.T,
            value.reshape(-1)[:0],
            value.reshape(-1)[:1],
            np.zeros((0, 3)),
        ]
        return packed({**members, name: shapes[rng.integers(len(shapes))]}, packing)
    if kind == 7:
        odd = np.array(value, dtype=np.complex128 if value.dtype.kind == "c" else np.float64)
        odd.reshape(-1)[rng.integers(odd.size)] = NUMBERS[rng.integers(len(NUMBERS))]
        return packed({**members, name: odd}, packing)
    return packed({other: held for other, held in members.items() if other != name}, packing)


def loads_or_says(read: Reader, path: Path) -> str:
    """The sentence of the refusal, empty if the archive loads with finite samples."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # lines of zeros are no matter here
            data = read(path).signal.data
    except ValueError as error:
        said = str(error)
        assert said.startswith(str(path)) and "\n" not in said, said
        return said
    assert bool(torch.isfinite(data).all())
    return ""


@pytest.mark.parametrize("number", range(len(ARCHIVES)))
def test_damage_gives_a_sentence_or_loads(tmp_path: Path, number: int) -> None:
    read, members = ARCHIVES[number]
    path = tmp_path / "data.npz"
    path.write_bytes(packed(members))
    assert loads_or_says(read, path) == ""
    said = []
    for seed in range(18 * number, 18 * number + 18):
        path.write_bytes(damaged(members, seed))
        said.append(loads_or_says(read, path))
    assert len(set(said)) > 9  # the damages are of many kinds


def encrypted(whole: bytes) -> bytes:
    """The archive with the flag of encryption at every member."""
    marked = bytearray(whole)
    for start, offset in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        at = marked.find(start)
        while at >= 0:
            marked[at + offset] |= 1
            at = marked.find(start, at + 1)
    return bytes(marked)


def doubled(whole: bytes) -> bytes:
    """The archive with another sampling rate beside the first."""
    held = io.BytesIO(whole)
    with zipfile.ZipFile(held, "a") as archive, warnings.catch_warnings(action="ignore"):
        archive.writestr("fs_hz.npy", as_npy(np.array(40e6)))
    return held.getvalue()


WHOLE = packed(STRIPMAP)
MISTAKEN: dict[str, tuple[bytes, str]] = {
    "empty": (b"", "is empty"),
    "cut off": (WHOLE[: len(WHOLE) // 2], "is cut off or damaged"),
    "encrypted": (encrypted(WHOLE), "prf_hz is encrypted; save the archive without a password"),
    "a key twice": (doubled(WHOLE), "holds the array 'fs_hz' twice"),
    "one array": (as_npy(STRIPMAP["iq"]), "holds a single array"),
    "of another kind": (b"\x89HDF\r\n" + bytes(99), "is a file of another kind"),
    "an empty archive": (packed({}), "lacks the keys"),
    "too large a number": (
        packed({**STRIPMAP, "iq": np.full((12, 40, 2), 1e300)}),
        "converted to torch.complex64: 480 of 480 samples are NaN or Inf",
    ),
    "an infinite cell": (packed({**STRIPMAP, "first_cell": np.array(np.inf)}), "must be one whole number, got inf"),
    "a rate in GHz": (
        packed({**STRIPMAP, "fs_hz": np.array(0.05)}),
        "fs_hz is 0.05 Hz, and should be 1000 to 1e+13 Hz",
    ),
    "a carrier in GHz": (packed({**STRIPMAP, "f0_hz": np.array(5.3)}), "f0_hz is 5.3 Hz, and should be"),
    "a carrier in MHz": (packed({**STRIPMAP, "f0_hz": np.array(2e7), "pulse_s": np.array(1e-4)}), "the bandwidth"),
    "a pulse in ms": (
        packed({**STRIPMAP, "pulse_s": np.array(0.01), "chirp_rate_hz_s": np.array(1e9)}),
        "is longer than the pulse interval",
    ),
    "faster than light": (packed({**STRIPMAP, "v_eff_m_s": np.array(4e8)}), "v_eff_m_s is 4e+08 m/s, and should be"),
    "a long text": (packed({**STRIPMAP, "f0_hz": np.array("high" * 99)}), "got <U396 of shape ()"),
}


@pytest.mark.parametrize("mistake", MISTAKEN)
def test_a_bad_archive_gives_one_sentence_and_nothing_is_written(
    mistake: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content, sentence = MISTAKEN[mistake]
    path = tmp_path / "data.npz"
    path.write_bytes(content)
    status = main(["run", "recorded_strip", f"data.file={path}", "--out", str(tmp_path / "out")])
    said = [line for line in capsys.readouterr().err.splitlines() if line != "torchsar: run recorded_strip"]
    assert status == 2 and len(said) == 1 and str(path) in said[0] and sentence in said[0], said
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["unused", "prf_hz", "pilot"])
def test_arrays_that_are_not_used_are_not_unpacked(name: str, tmp_path: Path) -> None:
    path = tmp_path / "data.npz"
    path.write_bytes(packed({**STRIPMAP, name: np.zeros(1 << 24, np.uint8)}))
    assert path.stat().st_size < 1 << 17
    tracemalloc.start()
    said = loads_or_says(read_stripmap, path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1 << 22 and (name in said) == (name != "unused")


def test_samples_that_exceed_the_memory_are_refused_by_their_header(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "data.npz"
    path.write_bytes(WHOLE)
    monkeypatch.setattr(stored, "machine_memory_bytes", lambda: 1500)
    with pytest.raises(ValueError, match=r"data.npz: iq: int8 of shape \(12, 40, 2\) takes .* GB.* cut the array"):
        read_stripmap(path)


def test_numbers_keep_the_digits_that_the_chosen_type_can_hold(tmp_path: Path) -> None:
    path, fine = tmp_path / "data.npz", np.full((12, 40, 2), 1 + 2.0**-40)
    path.write_bytes(packed({**STRIPMAP, "iq": fine.astype(">f8"), "agc_db": np.zeros(12)}))
    data = read_stripmap(path, torch.complex128).signal.data
    assert bool((data == complex(fine[0, 0, 0], fine[0, 0, 0])).all())
    path.write_bytes(packed({**PROFILES, "profiles": PROFILES["profiles"].astype(np.clongdouble)}))
    np.testing.assert_array_equal(read_inverse(path, torch.complex128).signal.data.T, PROFILES["profiles"])


PLAN = {"system": "stripmap", "samples": {"name": "iq", "dims": ["pulse", "range", "iq"]}}


def imported(path: Path) -> str:
    """The sentence with which an import of a file of samples is refused."""
    sidecar = {**PLAN, "radar": {name: float(STRIPMAP[name]) for name in ("fs_hz", "prf_hz", "f0_hz")}}
    sidecar["radar"] |= {"chirp_rate_hz_s": -0.72e12, "pulse_s": 1e-7, "slant_range_cell1_m": 9e3, "v_eff_m_s": 7e3}
    with pytest.raises(ValueError, match=path.name) as error:
        import_recording(path, sidecar, path.with_name("new.npz"))
    assert not path.with_name("new.npz").exists()
    return str(error.value)


def test_a_compressed_matlab_variable_is_checked_before_it_is_unpacked(tmp_path: Path) -> None:
    path, text = tmp_path / "data.mat", io.BytesIO()
    savemat(text, {"iq": np.zeros((12, 40, 2), np.int8)})
    whole = bytearray(text.getvalue())
    whole[132:136] = (len(whole) - 136 + (1 << 25)).to_bytes(4, "little")  # the size that the variable states
    content = zlib.compress(bytes(whole[128:]) + bytes(1 << 25))
    path.write_bytes(whole[:128] + b"\x0f\0\0\0" + len(content).to_bytes(4, "little") + content)
    tracemalloc.start()
    said = imported(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert "iq is damaged, since" in said and "of its shape (12, 40, 2)" in said and peak < 1 << 22


def test_numbers_that_hdf5_invents_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    h5py = pytest.importorskip("h5py", reason="the extra `formats` is not installed")
    path = tmp_path / "data.h5"
    for chunks, found in (((6, 40, 2), "1 of its 2 parts"), (None, "0 of its 1 parts")):
        with h5py.File(path, "w") as file:
            held = file.create_dataset("iq", (12, 40, 2), np.int8, chunks=chunks)
            if chunks:
                held[:6] = 1
        assert f"was not written as a whole, since the file has {found}" in imported(path)
    with h5py.File(path, "w") as file:
        file["iq"] = STRIPMAP["iq"]
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=100))
    assert "becomes an archive of 3.84e-06 GB, and 1e-07 GB are free" in imported(path)


@pytest.mark.parametrize(
    ("held", "said"),
    [
        ({**STRIPMAP, "chirp_rate_hz_s": 0.72}, r"pulse_s is 0.72 Hz/s times .* if it is in MHz/us, say so"),
        (
            {**STRIPMAP, "iq": STRIPMAP["iq"][:1]},
            r"iq must be .* two lines of at least one sample, got int8 of shape \(1, ",
        ),
        (
            {**TURNTABLE, "freq_hz": TURNTABLE["freq_hz"] / 1e9},
            r"freq_hz is .* Hz in the middle, .* if it is in GHz, say",
        ),
        (
            {"samples": np.ones((3, 4), complex)},
            r"must hold one of the sample arrays iq \(strip\), .* keys \['samples'\]",
        ),
    ],
)
def test_mislabelled_archives(tmp_path: Path, held: dict[str, np.ndarray], said: str) -> None:
    np.savez(tmp_path / "data.npz", allow_pickle=False, **held)
    with pytest.raises(ValueError, match=f"data.npz.* {said}"):
        read(tmp_path / "data.npz")


@pytest.mark.parametrize(("name", "content"), [("a.cphd", b"CPHD/1.1.0\r\n" * 9), ("a.nitf", b"NITF02.10" + b" " * 30)])
def test_what_a_library_says_of_its_own_variables_is_no_cause(tmp_path: Path, name: str, content: bytes) -> None:
    pytest.importorskip("sarkit", reason="the extra `formats` is not installed")
    (tmp_path / name).write_bytes(content)
    with pytest.raises(
        ValueError, match=rf"{name} cannot be read as .*: it is damaged or of another kind \(ValueError: "
    ):
        read(tmp_path / name)


def test_a_picture_beyond_the_memory_is_refused_by_its_header(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pillow = pytest.importorskip("PIL.Image")
    pillow.new("L", (300, 200)).save(tmp_path / "a.png")
    assert read_array(tmp_path / "a.png").shape == (200, 300)
    monkeypatch.setattr(stored, "machine_memory_bytes", lambda: 1500)
    with pytest.raises(ValueError, match=r"a.png: float64 of shape \(200, 300\) takes"):
        read_array(tmp_path / "a.png")
