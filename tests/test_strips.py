"""The command `torchsar focus`: strips in blocks of lines, from a file into a folder."""

from __future__ import annotations

import math
import os
import signal
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml

from tests.program import Program
from tests.repair import test_placing as placing
from tests.study.tiny import TINY
from torchsar.cli import main
from torchsar.compensate import EnergyCentre
from torchsar.core import Outcome
from torchsar.focus import Detect, FocusStrip, QuickLook
from torchsar.io import StripImage, read_images, read_stripmap
from torchsar.metrics import impulse_response
from torchsar.study.memory import PeakMemory
from torchsar.study.table import load
from torchsar.study.trials.bench import Bench

NUMBERS = {
    "fs_hz": 32e6,
    "prf_hz": 1257.0,
    "f0_hz": 5.3e9,
    "chirp_rate_hz_s": -30e12,
    "pulse_s": 1e-6,
    "slant_range_cell1_m": 100e3,  # an aperture of 90 lines
    "v_eff_m_s": 7066.0,
}
LINES, SAMPLES, DOPPLER = 1500, 48, -3000.0


def recording(path: Path, lines: int = LINES, samples: int = SAMPLES, seed: int = 0, **changes: Any) -> Path:
    """White noise over the whole PRF, as 8-bit I and Q, with a different gain in every line."""
    source = np.random.default_rng(seed)
    iq = source.normal(0, 20, (lines, samples, 2)).round().astype(np.int8)
    gains = source.integers(0, 3, lines).astype(np.uint8)
    np.savez(path, **{**NUMBERS, "iq": iq, "agc_db": gains, **changes})
    return path


def config(path: Path, more: str = "", before: str = "", key: str = "", memory_lines: int = 470) -> Path:
    memory_gb = memory_lines * SAMPLES * 24e-9
    path.write_text(
        f"""
title: strip
processor:
  recommended:
    stages:
      {before}
      focus: {{stage: focus_strip, doppler_hz: {DOPPLER}, memory_gb: {memory_gb:.9f}{key}}}
      {more}
""",
        encoding="utf-8",
    )
    return path


def focus(folder: Path, out: str, *options: str, data: Path | None = None) -> int:
    file = data or folder / "raw.npz"
    return main(["focus", str(folder / "strip.yaml"), f"data.file={file}", "--out", str(folder / out), *options])


def said(capsys: pytest.CaptureFixture[str]) -> str:
    """The only sentence behind the name of the command."""
    (line,) = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("torchsar: focus ")]
    return line


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    recording(tmp_path / "raw.npz")
    config(tmp_path / "strip.yaml")
    return tmp_path


def dying(folder: Path, out: str, block: int) -> int:
    """The program that is killed while it writes a block of the image."""
    write, count = StripImage.write, iter(range(100))

    def writing(self: StripImage, lines: slice, image: torch.Tensor, raw: int) -> None:
        if next(count) == block:
            self.array[lines.start : lines.start + 100] = 7.0  # a part of a block that is not marked
            os.kill(os.getpid(), signal.SIGKILL)
        write(self, lines, image, raw)

    StripImage.write = writing  # type: ignore[method-assign]
    return focus(folder, out)


def killed_in(folder: Path, out: str, block: int) -> None:
    """Run it in a process of its own: a fork of this one would lack the threads of zarr."""
    program = Program(dying, folder, out, block, folder=folder, said=folder / "said.txt")
    assert program.wait() == -signal.SIGKILL, program.said


def test_the_image_is_that_of_one_transform_below_minus_60_db(folder: Path) -> None:
    assert focus(folder, "out") == 0
    (image,) = read_images(folder / "out" / "image.zarr").values()
    raw = read_stripmap(folder / "raw.npz")
    stage = FocusStrip(raw.radar, doppler_hz=DOPPLER)
    whole = stage(raw.signal)
    assert image.axes == whole.axes and image.data.dtype == torch.complex64
    edge = slice(200, -200)  # a single transform is circular, so that both ends of the strip are in its first lines
    error, rms = (image.data - whole.data)[edge], whole.data[edge].abs().square().mean().sqrt()
    worst = error.abs().square().mean(-1).unfold(0, 8, 8).mean(-1).max().sqrt()
    assert 20 * math.log10(worst / rms) < -60
    with_marks = StripImage(folder / "out" / "image.zarr")
    assert sum(with_marks.is_finished(slice(first, None)) for first in range(0, LINES, 256)) == 6
    assert (folder / "out" / "quick_look.png").stat().st_size > 1000 and (folder / "out" / "config.yaml").is_file()


@pytest.mark.slow
def test_a_killed_program_goes_on_with_the_same_bits(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert focus(folder, "whole") == 0
    killed_in(folder, "out", 3)
    assert not (folder / "out" / "quick_look.png").exists()
    capsys.readouterr()
    assert focus(folder, "out") == 2 and "holds an image already; add --resume" in said(capsys)
    assert focus(folder, "out", "--resume") == 0
    one, other = (StripImage(folder / name / "image.zarr").array[...] for name in ("whole", "out"))
    assert np.array_equal(one, other)
    killed_in(folder, "early", 0)  # no block is finished: nothing is lost
    assert focus(folder, "early") == 0
    assert np.array_equal(one, StripImage(folder / "early" / "image.zarr").array[...])


def test_an_image_of_other_data_or_another_config_is_not_continued(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    killed_in(folder, "out", 3)
    iq = np.load(folder / "raw.npz")["iq"]
    iq[500, 7, 0] += 1  # in the second block
    other = recording(folder / "other.npz", iq=iq)
    capsys.readouterr()
    assert focus(folder, "out", "--resume", data=other) == 2
    assert "lines 256 to 511 were made from other raw data than those of now; choose another folder" in said(capsys)
    assert focus(folder, "out", "--resume", data=recording(folder / "other.npz", f0_hz=5.4e9)) == 2
    assert "was made with another recording" in said(capsys)
    config(folder / "strip.yaml", key=", band_hz: 1000.0")
    assert focus(folder, "out", "--resume") == 2 and "was made with another config" in said(capsys)
    config(folder / "strip.yaml")
    chunk = folder / "out" / "image.zarr" / "image" / "c" / "1" / "0"
    chunk.write_bytes(b"\0" + chunk.read_bytes()[1:])
    assert focus(folder, "out", "--resume") == 2 and "cannot be read as an image of a strip" in said(capsys)


@pytest.mark.parametrize(
    ("spoil", "sentence"),
    [
        (lambda path: path.write_bytes(path.read_bytes()[:-5000]), "raw.npz is cut off or damaged"),
        (lambda path: np.savez_compressed(path, **np.load(path)), "iq is compressed"),
        (lambda path: recording(path, agc_db=np.zeros(7)), "agc_db must have one entry per line, 1500, got (7,)"),
        (lambda path: recording(path, iq=np.full((LINES, SAMPLES), np.nan + 0j)), "samples are NaN or Inf"),
        (lambda path: path.unlink(), "raw.npz' does not exist"),
    ],
    ids=["cut off", "compressed", "gains", "not finite", "missing"],
)
def test_a_bad_recording_gives_one_sentence(
    spoil: Callable[[Path], Any], sentence: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    spoil(folder / "raw.npz")
    assert focus(folder, "out") == 2
    assert sentence in said(capsys)
    assert not (folder / "out" / "image.zarr").exists()


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        (
            {"more": "equal: {stage: estimate_flat_response}"},
            "the stages ['equal'] follow focus; a chain for long strips",
        ),
        ({"before": "shift: {stage: range_compress}"}, "the stage 'shift' before focus changes the samples"),
        ({"key": ", band_hz: 1500.0"}, "memory_bytes must hold blocks of at least"),
        ({"memory_lines": 60}, "memory_bytes must hold blocks of at least"),
        ({"key": ", form: chirp_scaling"}, "chirp_scaling"),
    ],
)
def test_a_bad_chain_gives_one_sentence(
    changes: dict[str, Any], sentence: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config(folder / "strip.yaml", **changes)
    assert focus(folder, "out") == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert sentence in said and not (folder / "out" / "image.zarr").exists()


def test_other_configs_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["focus", "stripmap_damaged", "--out", str(tmp_path / "out")]) == 2
    assert "torchsar focus needs data.file of the system stripmap" in said(capsys)
    assert main(["export", str(tmp_path), "--to", "sicd", "--out", str(tmp_path / "x")]) == 2


def test_detection_in_blocks_and_the_quick_look_are_those_of_the_whole_image(folder: Path) -> None:
    config(folder / "strip.yaml", "detect: {stage: detect, looks: [4, 3]}\n      look: {stage: quick_look, size: 50}")
    recording(folder / "raw.npz", lines=4501)
    assert focus(folder, "out") == 0
    image = StripImage(folder / "out" / "image.zarr")
    config(folder / "strip.yaml")
    assert focus(folder, "complex") == 0
    (whole,) = read_images(folder / "complex" / "image.zarr").values()
    expected = Detect((4, 3))(whole)
    (found,) = read_images(folder / "out" / "image.zarr").values()
    assert found.axes == expected.axes == image.axes and found.data.shape == (1125, 16)
    # the blocks are longer with looks, since they hold whole looks in whole chunks
    assert float((found.data - expected.data).norm() / expected.data.norm()) < 1e-3
    look = image.quick_look(QuickLook(50))
    torch.testing.assert_close(look.data, QuickLook(50)(found).data)
    assert look.axes == QuickLook(50)(found).axes and max(look.data.shape) <= 50


@pytest.mark.parametrize("after", [[], ["detect"], ["detect", "quick_look"], ["quick_look"]], ids=" ".join)
def test_a_simulated_run_has_the_same_stages(after: list[str], tmp_path: Path) -> None:
    tree = {**TINY, "metrics": {"reference": "clean"}}
    stages = {"focus": {"stage": "focus_strip"}, **{name: {"stage": name} for name in after}}
    tree["processor"] = {"clean": TINY["processor"]["clean"], "recommended": {"stages": stages}}
    (tmp_path / "tiny.yaml").write_text(yaml.safe_dump(tree, sort_keys=False), encoding="utf-8")
    bench = Bench(load(tmp_path / "tiny.yaml"))
    outcome = bench.batch(bench.draws(), detail=True).outcomes["recommended"]
    assert not outcome.failed and outcome.signal is not None
    assert outcome.signal.data.is_complex() == (not after) == ("entropy_nats" in outcome.metrics)


def test_estimates_from_the_middle_hold_for_the_whole_strip(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = "doppler: {stage: energy_centre}"
    text = config(folder / "strip.yaml", before=before).read_text(encoding="utf-8")
    assert "doppler_hz: -3000.0" in text
    (folder / "strip.yaml").write_text(
        text.replace("doppler_hz: -3000.0", "uses: {doppler_hz: doppler.doppler_baseband_hz}"),
        encoding="utf-8",
    )
    killed_in(folder, "out", 2)
    assert focus(folder, "out", "--resume") == 0
    assert "estimates from lines" not in capsys.readouterr().err.partition("finished")[0].split("--resume")[-1]
    values = StripImage(folder / "out" / "image.zarr").about["values"]
    assert set(values) == {"doppler_hz"} and abs(values["doppler_hz"]) < 1257


def test_an_estimate_that_failed_is_shown_with_the_reason_and_the_value_in_its_place(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    found, failed = EnergyCentre.forward, Outcome.NOISE.like(torch.zeros(()))
    monkeypatch.setattr(EnergyCentre, "forward", lambda self, *x, **y: replace(found(self, *x, **y), outcome=failed))
    text = config(folder / "strip.yaml", before="doppler: {stage: energy_centre}").read_text(encoding="utf-8")
    connected = text.replace("doppler_hz: -3000.0", "uses: {doppler_hz: doppler.doppler_baseband_hz}")
    (folder / "strip.yaml").write_text(connected, encoding="utf-8")
    assert focus(folder, "out") == 0
    lines = capsys.readouterr().err.splitlines()
    (shown,) = (line for line in lines if line.startswith("torchsar: doppler: "))
    (used,) = (line for line in lines if line.startswith("torchsar: focus uses "))
    assert shown.endswith(f" ({Outcome.NOISE.message})") and used == "torchsar: focus uses doppler_hz 0"


@pytest.mark.slow
def test_the_memory_is_that_of_a_block(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torchsar.io.strip._PART_BYTES", 1 << 20)
    lines, samples = 14_336, 512
    raw = np.memmap(tmp_path / "iq.bin", np.complex64, "w+", shape=(lines, samples))
    raw[:] = np.random.default_rng(0).normal(size=(256, samples)).astype(np.complex64)[np.arange(lines) % 256]
    np.savez(tmp_path / "raw.npz", iq=raw, **NUMBERS)
    del raw
    config(tmp_path / "strip.yaml", "look: {stage: quick_look, size: 64}", memory_lines=470 * samples // SAMPLES)
    recording(tmp_path / "small.npz", lines=300)
    assert focus(tmp_path, "first", data=tmp_path / "small.npz") == 0  # imports
    with PeakMemory() as peak:
        assert focus(tmp_path, "out") == 0
    if peak.bytes is not None:
        # the recording and its image have 59 MB each, the arrays of a block 5.8 MB; what the
        # process keeps besides varies by megabytes with what ran in it before
        assert peak.bytes < 32e6


@pytest.mark.slow
def test_lost_lines_are_filled_before_focusing(tmp_path: Path) -> None:
    number, peaks = np.delete(np.arange(placing.LINES), slice(250, 310)), []
    for kept in (np.arange(placing.LINES), number):
        path = placing.archived(
            tmp_path / f"{len(kept)}.npz", placing.echoes(kept / placing.PRF, 0.0), placing.PRF, line_number=kept
        )
        out = path.with_suffix("")
        assert main(["focus", "long_strip", f"data.file={path}", "--out", str(out)]) == 0
        (image,) = read_images(out / "image.zarr").values()
        found = [impulse_response(image, at, search_m=8.0)["peak"] for at in placing.TARGETS]
        peaks.append(torch.stack(found).abs().log10() * 20)
    assert float((peaks[1] - peaks[0]).abs().max()) < 0.5  # up to 1.8 dB without the stage
