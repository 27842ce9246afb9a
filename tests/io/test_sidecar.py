"""Data in the formats of other programs give the recording of the archive with the same numbers."""

from __future__ import annotations

import logging
import tracemalloc
import warnings
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
import zarr
from scipy.io import savemat

from tests.io.test_damaged import ARCHIVES, PATH, PROFILES, SPOTLIGHT, STRIPMAP, TURNTABLE, Members
from tests.test_docs import DOCS, block_with
from torchsar.cli import main
from torchsar.core import Recording
from torchsar.io import import_recording, read, read_inverse, read_path, read_stripmap, sidecar
from torchsar.io.extras import reading
from torchsar.study.commands import run
from torchsar.study.settings.text import parse

RADAR = {name: value.item() for name, value in STRIPMAP.items() if value.ndim == 0}
PAIRS = STRIPMAP["iq"]
SYSTEMS = ["stripmap", "isal", "isal", "isal", "path"]
KEYS = ["iq", "profiles", "sig", "fp", "history"]
DIMS = {
    "iq": ["pulse", "range"],
    "profiles": ["range", "pulse"],
    **{key: ["frequency", "pulse"] for key in ("sig", "fp", "history")},
}
# writes arrays by name into a file that is to be imported
Writer = Callable[[Path, Mapping[str, np.ndarray]], None]


def write_hdf5(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    h5py = pytest.importorskip("h5py", reason="the extra `formats` is not installed")
    with h5py.File(path, "w") as file:
        for name, array in arrays.items():
            file[name] = array


def write_matlab5(path: Path, arrays: Mapping[str, np.ndarray], compressed: bool = False) -> None:
    with path.open("wb") as file:
        savemat(file, {name: {"data": array} for name, array in arrays.items()}, do_compression=compressed)


def write_matlab7(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """As MATLAB does: a block of its own before the HDF5 data, at least two dims, in reverse."""
    h5py = pytest.importorskip("h5py", reason="the extra `formats` is not installed")
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, array in arrays.items():
            held = np.atleast_2d(array).T
            if held.dtype.kind == "c":
                part = held.real.dtype
                held = np.ascontiguousarray(held).view([("real", part), ("imag", part)])
            file[f"{name}/data"] = held
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\0\2IM")


def write_numpy(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    with path.open("wb") as file:
        np.savez(file, allow_pickle=False, **{f"{name}/data": array for name, array in arrays.items()})


WRITERS: dict[str, Writer] = {
    "hdf5": write_hdf5,
    "matlab 5": write_matlab5,
    "matlab 7": partial(write_matlab5, compressed=True),
    "matlab 7.3": write_matlab7,
    "numpy": write_numpy,
}


def tree_of(number: int, name: str = "{}/data") -> dict[str, Any]:
    """A sidecar for the members of an archive under their own names."""
    members, key = ARCHIVES[number][1], KEYS[number]
    numbers = sidecar._KINDS[key].radar
    sections: dict[str, dict[str, Any]] = {"radar": {}, "side": {}}
    for one in (one for one in members if one != key):
        sections["radar" if one in numbers else "side"][one] = name.format(one)
    dims = DIMS[key] + ["iq"] * (members[key].ndim - 2)
    return {"system": SYSTEMS[number], "samples": {"key": key, "name": name.format(key), "dims": dims}, **sections}


def same(one: Recording, other: Recording) -> bool:
    """Whether two recordings have the same bits."""
    sides = one.aux.keys() == other.aux.keys() and all(torch.equal(one.aux[k], other.aux[k]) for k in one.aux)
    return torch.equal(one.signal.data, other.signal.data) and one.radar == other.radar and sides


def archived(path: Path, members: Members) -> Path:
    np.savez(path, allow_pickle=False, **members)
    return path


@pytest.mark.parametrize("form", WRITERS)
@pytest.mark.parametrize("number", range(len(ARCHIVES)), ids=KEYS)
def test_every_kind_of_data_in_every_format(tmp_path: Path, number: int, form: str) -> None:
    read, members = ARCHIVES[number]
    source, tree = tmp_path / "data.bin", tree_of(number)
    arrays = {(f"{name}/data" if form == "hdf5" else name): value for name, value in members.items()}
    WRITERS[form](source, arrays)
    out = import_recording(source, tree, tmp_path / "out.npz")
    assert same(read(out, torch.complex128), read(archived(tmp_path / "own.npz", members), torch.complex128))


def flat(samples: np.ndarray, dims: str, **keys: Any) -> tuple[list[np.ndarray], dict[str, Any]]:
    """Content of flat binary files, and the section `samples`."""
    order = {">": "big", "<": "little", "|": "little", "=": "little"}[samples.dtype.byteorder]
    layout = {"dims": dims.split(), "dtype": samples.dtype.name, "byte_order": order, "shape": list(samples.shape)}
    return [samples], {**layout, **keys}


def two_files() -> tuple[list[np.ndarray], dict[str, Any]]:
    _, keys = flat(PAIRS[..., 0].astype(">i2"), "pulse range", imag="imag.bin")
    return [PAIRS[..., i].astype(">i2") for i in (0, 1)], keys


REAL = ["<i1", "<i2", ">i2", "<i4", ">i4", "<f2", ">f2", "<f4", ">f4", "<f8", ">f8"]
LAYOUTS = {
    **{f"pairs {dtype}": flat(PAIRS.astype(dtype), "pulse range iq") for dtype in REAL},
    "unsigned": flat((PAIRS + np.int16(128)).astype(np.uint8), "pulse range iq", offset=128),
    "planes": flat(np.ascontiguousarray(np.moveaxis(PAIRS, -1, 0)), "iq pulse range"),
    "rows by turns": flat(np.ascontiguousarray(np.moveaxis(PAIRS, -1, 1)), "pulse iq range"),
    "transposed": flat(np.ascontiguousarray(PAIRS.transpose(1, 0, 2)), "range pulse iq"),
    "complex": flat((PAIRS[..., 0] + 1j * PAIRS[..., 1]).astype(">c8"), "pulse range"),
    "transposed complex": flat(np.ascontiguousarray((PAIRS[..., 0] + 1j * PAIRS[..., 1]).T), "range pulse"),
    "header": flat(PAIRS, "pulse range iq", header_bytes=37),
    "two files": two_files(),
    "conjugate": flat(PAIRS * np.array([1, -1], np.int8), "pulse range iq", conjugate=True),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_flat_binary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, layout: str) -> None:
    monkeypatch.setattr(sidecar, "_BLOCK_BYTES", 1000)  # several blocks
    parts, samples = LAYOUTS[layout]
    for name, part in zip(["data.bin", "imag.bin"], parts, strict=False):
        (tmp_path / name).write_bytes(bytes(samples.get("header_bytes", 0)) + part.tobytes())
    tree = {"system": "stripmap", "samples": samples, "radar": RADAR, "side": {"line_number": list(range(12))}}
    out = import_recording(tmp_path / "data.bin", tree, tmp_path / "out.npz")
    own = {"iq": PAIRS, "line_number": STRIPMAP["line_number"], **{name: np.array(x) for name, x in RADAR.items()}}
    assert same(read_stripmap(out), read_stripmap(archived(tmp_path / "own.npz", own)))


@pytest.mark.parametrize("form", ["real and imaginary data sets", "compound", "pairs", "big endian"])
def test_complex_numbers_in_hdf5(tmp_path: Path, form: str) -> None:
    samples = TURNTABLE["sig"].T
    arrays, keys = {"s": samples}, {}
    if form == "compound":
        arrays["s"] = np.ascontiguousarray(samples).view([("Re", np.float64), ("Im", np.float64)])
    elif form == "pairs":
        arrays["s"] = np.stack([samples.real, samples.imag])
    elif form == "big endian":
        arrays["s"] = samples.astype(">c16")
    else:
        arrays, keys = {"s": samples.real, "g/q": samples.imag}, {"imag": "g/q"}
    tree = tree_of(2, "{}")
    tree["samples"] |= {"name": "s", "dims": ["iq"] * (form == "pairs") + ["pulse", "frequency"], **keys}
    rest = {name: value for name, value in TURNTABLE.items() if name != "sig"}
    write_hdf5(tmp_path / "data.h5", {**rest, **arrays})
    out = import_recording(tmp_path / "data.h5", tree, tmp_path / "out.npz")
    assert same(read_inverse(out), read_inverse(archived(tmp_path / "own.npz", TURNTABLE)))


def test_units_steps_attributes_and_further_files(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py", reason="the extra `formats` is not installed")
    with h5py.File(tmp_path / "data.h5", "w") as file:
        file["s"] = TURNTABLE["sig"]
        file.attrs["prf"] = 0.25
    np.save(tmp_path / "turn.npy", np.deg2rad(TURNTABLE["angle_deg"])[None].astype(">f8"))
    tree = {
        "system": "isal",
        "samples": {"key": "sig", "name": "/s", "dims": ["frequency", "pulse"]},
        "radar": {"prf_hz": {"name": "@prf", "unit": "kHz"}},
        "side": {
            "freq_hz": {"first": 9.0, "step": 0.002, "unit": "GHz"},
            "angle_deg": {"file": "turn.npy", "name": "", "unit": "rad"},
        },
    }
    found = read_inverse(import_recording(tmp_path / "data.h5", tree, tmp_path / "out.npz"))
    assert found.radar.prf_hz == 250.0
    torch.testing.assert_close(found.aux["frequency_hz"], torch.from_numpy(TURNTABLE["freq_hz"]), rtol=1e-15, atol=0)
    torch.testing.assert_close(found.aux["angle_rad"], torch.from_numpy(np.deg2rad(TURNTABLE["angle_deg"])))


def test_own_warnings_pass_while_libraries_are_quiet(caplog: pytest.LogCaptureFixture) -> None:
    with reading(Path("a.cphd"), "CPHD"):
        logging.getLogger("torchsar").warning("kept")
        logging.getLogger("jbpy.core").error("left out")
    assert caplog.messages == ["kept"]


def imported(path: Path, data: np.ndarray, samples: Mapping[str, Any], **more: Any) -> torch.Tensor:
    """Samples of a phase history in a flat binary file."""
    data.tofile(path)
    n, pulses = samples["shape"][samples["dims"].index("frequency")], samples["shape"][samples["dims"].index("pulse")]
    side = {
        "freq_hz": {"first": 77.0, "step": 0.01, "unit": "GHz"},
        "transmitter_m": np.stack([np.zeros(pulses), 0.01 * np.arange(pulses), np.ones(pulses)], -1).tolist(),
        "path_reference_m": [8.0] * pulses,
    }
    layout = {"key": "history", "dtype": data.dtype.name, **samples}
    out = import_recording(path, {"system": "path", "samples": layout, "side": side, **more}, path.with_suffix(".npz"))
    with np.load(out) as held:
        assert held["history"].shape == (n, pulses)
        return torch.from_numpy(held["history"].T.copy())


HISTORY = np.random.default_rng(8).integers(-99, 99, (5, 6, 2))  # pulse, frequency, iq
WHOLE = torch.view_as_complex(torch.from_numpy(HISTORY).float())


@pytest.mark.parametrize(("order", "at"), [("qi", [1, 0]), ("iiqq", [0, 2, 1, 3]), ("QIIQ", [1, 0, 2, 3])])
def test_the_order_of_i_and_q(tmp_path: Path, order: str, at: list[int]) -> None:
    kept = HISTORY.reshape(5, -1, len(order))[..., at].astype(np.int16)
    samples = {"shape": [5, 6, 2], "dims": ["pulse", "frequency", "iq"], "order": order}
    assert torch.equal(imported(tmp_path / "data.bin", kept, samples), WHOLE)


def test_bytes_around_lines_and_one_of_several_receivers(tmp_path: Path) -> None:
    lines = np.stack([HISTORY - 5, HISTORY], 1).astype(np.int8).reshape(5, -1)  # pulse, receiver, ...
    around = [np.full((5, n), 77, np.int8) for n in (3, 2)]
    samples = {"shape": [5, 2, 6, 2], "dims": ["pulse", "receiver", "frequency", "iq"], "choose": {"receiver": 1}}
    samples |= {"line_prefix_bytes": 3, "line_suffix_bytes": 2, "header_bytes": 0}
    assert torch.equal(imported(tmp_path / "data.bin", np.hstack([around[0], lines, around[1]]), samples), WHOLE)


def test_a_table_of_values(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py", reason="the extra `formats` is not installed")
    table = np.arange(256, dtype=np.float32) ** 2
    codes = np.random.default_rng(2).integers(0, 256, (*PAIRS.shape[:2], 2)).astype(np.uint8)
    with h5py.File(tmp_path / "data.h5", "w") as file:
        file["codes"], file["table"] = codes, table
    samples = {"name": "codes", "dims": ["pulse", "range", "iq"], "table": "table", "offset": 21000.0}
    tree = {"system": "stripmap", "samples": samples, "radar": RADAR}
    found = read_stripmap(import_recording(tmp_path / "data.h5", tree, tmp_path / "out.npz"))
    torch.testing.assert_close(torch.view_as_real(found.signal.data).numpy(), table[codes] - 21000)
    with pytest.raises(ValueError, match="no array 'tabel'"):
        import_recording(tmp_path / "data.h5", {**tree, "samples": {**samples, "table": "tabel"}}, tmp_path / "b.npz")


def test_an_offset_is_removed_or_noticed(tmp_path: Path) -> None:
    unsigned = (PAIRS + np.int16(128)).astype(np.uint8)
    unsigned.tofile(tmp_path / "data.bin")
    samples = {"dtype": "uint8", "shape": list(unsigned.shape), "dims": ["pulse", "range", "iq"]}
    tree = {"system": "stripmap", "samples": samples, "radar": RADAR}
    with pytest.warns(UserWarning, match=r"samples have a mean of I 1\d\d.* about 1.*, as sidecar: samples.off"):
        import_recording(tmp_path / "data.bin", tree, tmp_path / "plain.npz")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        out = import_recording(
            tmp_path / "data.bin", {**tree, "samples": {**samples, "offset": 128}}, tmp_path / "o.npz"
        )
        found = read_stripmap(out).signal.data
        np.savez(tmp_path / "own.npz", allow_pickle=False, iq=unsigned, offset=128.0, **RADAR)
        own = read_stripmap(tmp_path / "own.npz").signal.data
    assert torch.equal(found, torch.view_as_complex(torch.from_numpy(PAIRS).float())) and torch.equal(own, found)
    np.savez(tmp_path / "own.npz", allow_pickle=False, iq=unsigned, **RADAR)
    with pytest.warns(UserWarning, match=r"own.npz: samples have a mean of .*, as offset"):
        read_stripmap(tmp_path / "own.npz")


def test_side_files_without_a_name_and_tables_of_text(tmp_path: Path) -> None:
    write_numpy(tmp_path / "data.npz", PATH)
    np.save(tmp_path / "path.npy", PATH["path_reference_m"])
    header = "# east,north,up"
    np.savetxt(tmp_path / "nav.csv", PATH["transmitter_m"], header=header[2:], delimiter=",", fmt="%.17g")
    tree = tree_of(4)
    tree["side"] |= {
        "path_reference_m": {"file": "path.npy"},
        "transmitter_m": {"file": "nav.csv", "name": "east, north,up"},
    }
    found = read_path(import_recording(tmp_path / "data.npz", tree, tmp_path / "out.npz"))
    np.savez(tmp_path / "own.npz", allow_pickle=False, **PATH)
    assert same(found, read_path(tmp_path / "own.npz"))
    tree["side"]["transmitter_m"]["name"] = "east,north,down"
    with pytest.raises(ValueError, match=r"\(table\) has no array 'east,north,down'.*accepted: east, north, up"):
        import_recording(tmp_path / "data.npz", tree, tmp_path / "b.npz")


@pytest.mark.parametrize("compressed", [False, True])
def test_arrays_of_structures(tmp_path: Path, compressed: bool) -> None:
    parts = [{name: x if k else -x for name, x in TURNTABLE.items()} for k in (0, 1)]
    records = np.array([tuple(part.values()) for part in parts], [(name, object) for name in TURNTABLE])
    savemat(tmp_path / "data.mat", {"scan": records}, do_compression=compressed)
    tree = tree_of(2)
    names = {one: f"scan(2)/{one}" for one in TURNTABLE}
    tree["samples"]["name"] = names["sig"]
    tree["radar"] = {one: names[one] for one in tree["radar"]}
    tree["side"] = {one: names[one] for one in tree["side"]}
    found = read_inverse(import_recording(tmp_path / "data.mat", tree, tmp_path / "out.npz"))
    np.savez(tmp_path / "own.npz", allow_pickle=False, **TURNTABLE)
    assert same(found, read_inverse(tmp_path / "own.npz"))
    for wrong in ("scan/sig", "scan(3)/sig", "scan(1)/gis"):
        tree["samples"]["name"] = wrong
        with pytest.raises(ValueError, match=r"scan is an array of 2 structures with .*, such as scan\(1\)/"):
            import_recording(tmp_path / "data.mat", tree, tmp_path / "b.npz")


def test_positions_may_be_transposed(tmp_path: Path) -> None:
    tree = tree_of(4)
    tree["side"]["transmitter_m"] = {"name": "transmitter_m/data", "transpose": True}
    write_numpy(tmp_path / "data.npz", {**PATH, "transmitter_m": PATH["transmitter_m"].T})
    out = import_recording(tmp_path / "data.npz", tree, tmp_path / "out.npz")
    with np.load(out) as held:
        assert (held["transmitter_m"] == PATH["transmitter_m"]).all()


@pytest.fixture
def source(tmp_path: Path) -> Path:
    write_numpy(tmp_path / "data.npz", STRIPMAP)
    return tmp_path / "data.npz"


# sections that replace those of a valid sidecar, or keys of them, and what the sentence says
MISTAKES: dict[str, tuple[dict[str, Any], list[str]]] = {
    "no system": ({"system": None}, ["system is missing", "accepted: isal, path, stripmap"]),
    "a system without recordings": ({"system": "sal"}, ["system has the value 'sal'", "did you mean 'isal'"]),
    "a section": ({"sampels": {}}, ["radar.yaml: key 'sampels' is not known", "did you mean 'samples'"]),
    "no samples": ({"samples": None}, ["samples must be a mapping", "got nothing"]),
    "a key of the samples": ({"samples.dim": []}, ["samples: key 'dim' is not known", "did you mean 'dims'"]),
    "dims that are lists": ({"samples.dims": [["pulse"], "range"]}, ["samples.dims must be", "[['pulse'], 'range']"]),
    "dims": ({"samples.dims": ["line", "range"]}, ["samples.dims must be", "pulse and range", "['line', 'range']"]),
    "no dims": ({"samples.dims": None}, ["samples lacks the key 'dims'"]),
    "too few dims": ({"samples.dims": ["pulse", "range"]}, ["(12, 40, 2)", "samples.dims are ['pulse', 'range']"]),
    "wrong order": ({"samples.dims": ["iq", "pulse", "range"]}, ["the dim iq must have 2", "(12, 40, 2)"]),
    "a name": ({"samples.name": "iq/dat"}, ["has no array 'iq/dat'", "did you mean 'iq/data'"]),
    "no name": ({"samples.name": None}, ["holds the arrays iq/data, ", "give the name of one of them"]),
    "a layout": ({"samples.dtype": "int8"}, ["samples.dtype", "is a numpy file; give name instead"]),
    "a name of Python": ({"radar.carrier_hz": 1e9}, ["radar: key 'carrier_hz' is not known", "did you mean 'f0_hz'"]),
    "a radar key": ({"radar.prf": 3.0}, ["radar: key 'prf' is not known", "did you mean 'prf_hz'"]),
    "another unit": ({"radar.prf_hz": "3 m"}, ["radar.prf_hz has the unit 'm', and Hz is expected", "kHz"]),
    "a misspelt unit": ({"radar.prf_hz": "3 Mhz"}, ["radar.prf_hz has the unit 'Mhz'", "did you mean 'MHz'"]),
    "a unit for none": ({"radar.first_cell": "3 Hz"}, ["radar.first_cell has the unit 'Hz'", "without a unit"]),
    "a number that is none": ({"radar.prf_hz": True}, ["radar.prf_hz must be numbers in Hz", "got True"]),
    "a negative number": ({"radar.prf_hz": -3.0}, ["radar.prf_hz must be one positive number, got -3.0"]),
    "a wrong magnitude": ({"radar.fs_hz": 50.0}, ["fs_hz is 50 Hz, and should be 1000 to 1e+13 Hz"]),
    "a list for a number": ({"radar.prf_hz": [1.0, 2.0]}, ["radar.prf_hz must be one positive number"]),
    "ragged lists": ({"side.agc_db": [[1.0], [2.0, 3.0]]}, ["side.agc_db must be numbers in dB"]),
    "a short list": ({"side.agc_db": [1.0, 2.0]}, ["agc_db has 2 entries for 12 lines"]),
    "fractions of lines": ({"side.line_number": {"first": 0, "step": 0.5}}, ["line_number must hold whole numbers"]),
    "steps without a step": ({"side.agc_db": {"first": 0.0}}, ["side.agc_db lacks the key 'step', a number"]),
    "steps and a name": ({"side.agc_db": {"first": 0, "step": 1, "name": "x"}}, ["name is given too"]),
    "steps for one number": ({"radar.prf_hz": {"first": 0, "step": 1}}, ["has no length of its own"]),
    "a missing number": ({"radar.prf_hz": ...}, ["lacks the keys ['prf_hz']"]),
    "no such file": ({"side.agc_db": {"file": "no.h5", "name": "x"}}, ["no.h5 does not exist"]),
    "a flag": ({"samples.conjugate": 1}, ["samples.conjugate must be true or false, got 1"]),
    "a channel": ({"samples.dims": ["pulse", "range", "receiver"]}, ["name one index, from 0", "{'receiver': 2}"]),
    "a wrong channel": ({"samples.choose": {"receiver": 0}}, ["choose must name one index", "got {'receiver': 0}"]),
    "a wrong order": ({"samples.order": "iqq"}, ["order must have as many i as q", "'iqq'"]),
    "an order without pairs": (
        {"samples.order": "iiqqiq", "samples.dims": ["pulse", "range", "iq"]},
        ["order must have as many i as q", "divides that of the samples, 40, got 'iiqqiq'"],
    ),
    "an offset": (
        {"samples.offset": [1.0, 2.0, 3.0]},
        ["offset must be one finite number, or one for I and Q", "[1.0, 2.0, 3.0]"],
    ),
    "imag beside iq": ({"samples.imag": "iq/data"}, ["samples must be complex, or real with one dim iq or one array"]),
}


def mistaken(tree: Any, change: Mapping[str, Any]) -> Any:
    for key, value in change.items():
        section, _, name = key.partition(".")
        part = {**tree[section], name: value} if name else value
        tree = {**tree, section: {k: v for k, v in part.items() if v is not ...} if name else part}
    return tree


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_one_sentence_and_nothing_is_written(source: Path, name: str) -> None:
    change, said = MISTAKES[name]
    with pytest.raises((ValueError, FileNotFoundError)) as error:
        import_recording(source, mistaken(tree_of(0), change), source.parent / "out.npz", "radar.yaml")
    text = str(error.value)
    assert "\n" not in text and all(part in text for part in said), text
    assert "radar.yaml" in text or "no.h5" in text
    assert [path.name for path in source.parent.iterdir()] == ["data.npz"]


FLAT_MISTAKES: dict[str, tuple[dict[str, Any], list[str]]] = {
    "cut off": ({"samples.shape": [13, 40, 2]}, ["has 960 bytes", "needs 1040", "cut off"]),
    "no header": ({"samples.header_bytes": "1"}, ["header_bytes must be a number of bytes"]),
    "an odd prefix": ({"samples.line_prefix_bytes": -1}, ["numbers of bytes at least 0", "[0, -1, 0]"]),
    "too small a shape": (
        {"samples.shape": [11, 40, 2]},
        ["needs 880, which would be 12 entries of its first dim; correct these"],
    ),
    "a shape": ({"samples.shape": [12, -1, 2]}, ["shape must be a list of numbers of at least 1", "[12, -1, 2]"]),
    "a type": ({"samples.dtype": "in8"}, ["samples.dtype has the value 'in8'", "did you mean 'int8'"]),
    "an order of I alone": ({"samples.order": "ii"}, ["radar.yaml: samples.order: order must have as many i as q"]),
    "an order": ({"samples.byte_order": "bg"}, ["samples.byte_order has the value 'bg'", "did you mean 'big'"]),
    "a name": ({"samples.name": "iq"}, ["is no HDF5, MATLAB, numpy or .csv file", "give dtype and shape, and no name"]),
    "an array without a file": ({"side.agc_db": "gain"}, ["side.agc_db", "is no HDF5, MATLAB, numpy or .csv file"]),
}


@pytest.mark.parametrize("name", FLAT_MISTAKES)
def test_mistakes_of_flat_binary_data(tmp_path: Path, name: str) -> None:
    change, said = FLAT_MISTAKES[name]
    (tmp_path / "data.bin").write_bytes(PAIRS.tobytes())
    tree = {"system": "stripmap", "samples": flat(PAIRS, "pulse range iq")[1], "radar": RADAR, "side": {}}
    with pytest.raises(ValueError) as error:
        import_recording(tmp_path / "data.bin", mistaken(tree, change), tmp_path / "out.npz", "radar.yaml")
    assert "\n" not in str(error.value) and all(part in str(error.value) for part in said), error.value
    assert [path.name for path in tmp_path.iterdir()] == ["data.bin"]


@pytest.mark.parametrize("form", WRITERS)
def test_damaged_files_give_a_sentence_or_the_same_data(tmp_path: Path, form: str) -> None:
    source, out, said = tmp_path / "data", tmp_path / "out.npz", set()
    WRITERS[form](source, {(f"{k}/data" if form == "hdf5" else k): v for k, v in SPOTLIGHT.items()})
    whole, rng = source.read_bytes(), np.random.default_rng(3)
    for attempt in range(12):
        harmed = bytearray(whole[: rng.integers(1, len(whole))] if attempt % 2 else whole)
        for at in rng.integers(len(harmed), size=0 if attempt % 2 else 30):
            harmed[at] ^= int(rng.integers(1, 256))
        source.write_bytes(harmed)
        try:
            import_recording(source, tree_of(3), out, "radar.yaml")
            read_inverse(out)
            out.unlink()
        except ValueError as error:
            said.add(str(error))
            assert "\n" not in str(error) and str(error).startswith((str(tmp_path), "radar.yaml"))
        assert [path.name for path in tmp_path.iterdir()] == ["data"]
    assert len(said) > 2


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_samples_that_are_not_finite_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, value: float) -> None:
    monkeypatch.setattr(sidecar, "_BLOCK_BYTES", 200)
    samples = PROFILES["profiles"].astype(np.complex64)
    samples[4, 3] = value
    write_numpy(tmp_path / "data.npz", {**PROFILES, "profiles": samples})
    with pytest.raises(ValueError, match=r"data.npz: profiles/data: 1 samples are NaN or Inf at indices .* 'range'"):
        import_recording(tmp_path / "data.npz", tree_of(1), tmp_path / "out.npz")
    assert [path.name for path in tmp_path.iterdir()] == ["data.npz"]


def test_an_existing_file_is_kept(source: Path) -> None:
    out = source.parent / "out.npz"
    out.write_bytes(b"mine")
    with pytest.raises(FileExistsError, match=r"out.npz exists and is not replaced"):
        import_recording(source, tree_of(0), out)
    assert out.read_bytes() == b"mine"
    with pytest.raises(ValueError, match=r"must end in \.npz"):
        import_recording(source, tree_of(0), source.parent / "out.mat")


def test_large_files_are_read_in_blocks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sidecar, "_BLOCK_BYTES", 1 << 20)
    shape = (4096, 2048, 2)  # 16 MiB, 64 MiB as complex numbers
    with (tmp_path / "data.bin").open("wb") as file:
        file.truncate(np.prod(shape))
    samples = {"dims": ["pulse", "range", "iq"], "dtype": "int8", "shape": list(shape)}
    tracemalloc.start()
    try:
        tree = {"system": "stripmap", "samples": samples, "radar": RADAR}
        import_recording(tmp_path / "data.bin", tree, tmp_path / "out.npz")
        assert tracemalloc.get_traced_memory()[1] < 8 << 20
    finally:
        tracemalloc.stop()


CONFIG = """
system: isal
title: turntable
seed: 1
processor:
  recommended:
    title: image
    stages:
      image: {stage: target_image, window: hann}
"""


def test_images_of_all_formats_are_equal_bit_for_bit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(run, "draw_all", lambda *_, **__: [])
    Path("config.yaml").write_text(CONFIG)
    rng = np.random.default_rng(5)
    angle = np.linspace(-2.0, 2.0, 24)
    point = np.exp(-4j * np.pi * (9e9 + 2e6 * np.arange(16))[:, None] * (3.0 + 2.0 * np.deg2rad(angle)) / 299792458.0)
    samples = (point + 0.1 * rng.normal(size=point.shape)).astype(np.complex64)
    members = {"sig": samples, "freq_hz": 9e9 + 2e6 * np.arange(16), "angle_deg": angle}
    np.savez("own.npz", allow_pickle=False, **members)
    images = {}
    for form in ("own", "hdf5", "matlab 5", "matlab 7.3"):
        if form != "own":
            arrays = {(f"{k}/data" if form == "hdf5" else k): v for k, v in members.items()}
            WRITERS[form](Path(form), arrays)
            Path("radar.yaml").write_text(yaml.safe_dump(tree_of(2)))
            assert main(["import", form, "--sidecar", "radar.yaml", "--out", f"{form}.npz"]) == 0
        assert main(["run", "config.yaml", f"data.file={form}.npz", "--out", f"{form}.run"]) == 0
        images[form] = zarr.open_group(f"{form}.run/arrays.zarr", mode="r")["recommended/image"][:]
    assert images["own"].any() and all((image == images["own"]).all() for image in images.values())
    assert "hdf5.npz" in capsys.readouterr().out


def test_files_that_need_a_sidecar_say_so(tmp_path: Path) -> None:
    for form in ("hdf5", "matlab 7", "matlab 7.3"):
        WRITERS[form](tmp_path / "data", {"x": np.ones(3)})
        with pytest.raises(ValueError, match="must be imported first: torchsar import FILE --sidecar YAML"):
            read(tmp_path / "data")


def test_the_sidecar_of_the_documentation(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py", reason="the extra `formats` is not installed")
    text = block_with(DOCS / "how_to" / "own_data.md", "yaml", "dims:")
    with h5py.File(tmp_path / "flight.h5", "w") as file:
        file["raw/iq"] = np.ones((2, 6, 4096), np.int8)
        file["raw/lines"] = np.arange(4096)
        file["raw"].attrs["sampling"] = 32.317
    (tmp_path / "gains.bin").write_bytes(np.full(4096, 20.0, ">f4").tobytes())
    recording = read(import_recording(tmp_path / "flight.h5", parse(text, "own_data.md"), tmp_path / "out.npz"))
    assert isinstance(recording, Recording) and recording.signal.data.shape == (4096, 6)
    assert bool((recording.signal.data == 10 * (1 + 1j)).all())
    assert (recording.radar.sampling_hz, recording.radar.carrier_hz) == (32.317e6, 5.3e9)


def test_mistakes_on_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_numpy(tmp_path / "data.npz", STRIPMAP)
    (tmp_path / "radar.yaml").write_text(yaml.safe_dump(mistaken(tree_of(0), {"radar.prf": 3.0})))
    words = ["import", str(tmp_path / "data.npz"), "--sidecar", str(tmp_path / "radar.yaml")]
    assert main([*words, "--out", str(tmp_path / "out.npz")]) == 2
    assert "radar.yaml: radar: key 'prf' is not known; did you mean 'prf_hz'?" in capsys.readouterr().err
    assert main([*words[:-1], str(tmp_path / "no.yaml"), "--out", str(tmp_path / "out.npz")]) == 2
    assert "no.yaml" in capsys.readouterr().err
    assert not (tmp_path / "out.npz").exists()
