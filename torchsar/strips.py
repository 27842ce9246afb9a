"""Focusing of recorded strips that are longer than memory, from a config into a folder."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchsar import plot
from torchsar.core import Axis, Signal
from torchsar.focus import Detect, FocusStrip, QuickLook
from torchsar.focus.strip import StripPlan, focus_block
from torchsar.io import StripImage, write_strip_geotiff
from torchsar.io.strip import StripRecording, samples_checksum
from torchsar.repair import SparseFill
from torchsar.study.output.folder import ResultFolder, fresh_result, opened
from torchsar.study.output.progress import progress
from torchsar.study.settings.errors import ConfigError
from torchsar.study.settings.sections import Loaded
from torchsar.study.trials.bench import build_chains

log = logging.getLogger("torchsar")
# largest number of image lines in a chunk of the store
_CHUNK_LINES = 256
FILES = ("config.yaml", "quick_look.png")
_HINT = (
    "a chain for long strips has estimators, sparse_fill if lost lines are to be filled, one stage focus_strip, then "
    "detect and quick_look, or neither"
)


def focus_recording(loaded: Loaded, out: Path, resume: bool = False, device: str = "cpu") -> Path:
    """Focus a recorded strip with the recommended method of a config, block by block.

    Estimators before the stage `focus_strip` run once, on the lines in the middle of the strip that
    fit its memory, and their values hold for the whole strip. Blocks of raw lines are read,
    focused, detected if a stage `detect` follows, and written. At the end the picture of a stage
    `quick_look` is made. A killed program loses at most one block.

    Args:
        loaded: The config; `data.file` is an archive for `torchsar.io.read_stripmap`.
        out: The result folder: image.zarr (see `torchsar.io.StripImage`) grows there block by
            block; config.yaml and quick_look.png appear at the end.
        resume: Whether to continue the image in the folder.
        device: Device on which blocks are focused.

    Returns:
        Path of the image.

    Raises:
        ConfigError: If the config is not for a long strip, or the folder cannot be used.
        ValueError: If the recording or the image in the folder is damaged, or the image to continue
            is that of other data or another config.
        KeyboardInterrupt: After Ctrl-C, with a sentence that says how to go on.
    """
    began = time.perf_counter()
    strip = _Strip(loaded, device)
    with opened(out, "focus", FILES) as folder:
        try:
            image = strip.focused(folder, resume)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(f"finished blocks are kept in {out}; go on with --resume") from None
        with folder.staged() as new:
            (new / "config.yaml").write_text(loaded.text(), encoding="utf-8")
            plot.save(plot.image(image.quick_look(strip.picture), title=loaded.config.title), new / "quick_look.png")
    log.info("finished in %.0f s", time.perf_counter() - began)
    return image.path


def export_strip(path: Path, form: str, out: Path) -> None:
    """Write the image of a strip in another format, part by part.

    Args:
        path: Folder of the image, image.zarr.
        form: The format, "geotiff": the amplitude with overviews, see `write_strip_geotiff`.
        out: Folder of the new file, image.tif.

    Raises:
        ConfigError: If the format is another one, or the folder cannot be used.
        ModuleNotFoundError: If rasterio is not installed (extra `geo`).
        ValueError: If the image is damaged.
    """
    if form != "geotiff":
        raise ConfigError(f"{path} can be exported to geotiff, got {form}; the image itself is a zarr store")
    image = StripImage(path)
    with fresh_result(out, "export", ("image.tif",)) as folder:
        write_strip_geotiff(image, folder / "image.tif")


class _Strip:
    """A strip recording and the stages of a config that make an image of it."""

    def __init__(self, loaded: Loaded, device: str) -> None:
        config, self._device = loaded.config, device
        if config.data.file is None or config.data.impairments or config.cases or config.system != "stripmap":
            raise ConfigError(
                f"{loaded.file}: torchsar focus needs data.file of the system stripmap, without data.impairments and "
                "cases; write data.file=PATH after the command"
            )
        self.recording = StripRecording(config.data.file, getattr(torch, config.precision))
        for note in self.recording.notes:
            log.warning("warning: %s: %s", config.data.file, note)
        chain = build_chains(loaded, radar=self.recording.radar)["recommended"].to(device)
        where, names = f"{loaded.file}: processor.recommended.stages", list(chain.stages)
        strips = [name for name in names if isinstance(chain.stages[name], FocusStrip)]
        if len(strips) != 1:
            raise ConfigError(f"{where}: there are {len(strips)} stages focus_strip; {_HINT}")
        self._name, self._before, self._chain = strips[0], names[: names.index(strips[0])], chain
        self.focus: Any = chain.stages[strips[0]]
        self._fill = next((name for name in self._before if isinstance(chain.stages[name], SparseFill)), "")
        after = [chain.stages[name] for name in names[len(self._before) + 1 :]]
        if [type(stage) for stage in after] not in ([], [Detect], [QuickLook], [Detect, QuickLook]):
            raise ConfigError(f"{where}: the stages {names[len(self._before) + 1 :]} follow {strips[0]}; {_HINT}")
        self.detect = next((stage for stage in after if isinstance(stage, Detect)), None)
        self._looks = 1 if self.detect is None else self.detect.looks[0]
        self._chunk_lines = max(1, _CHUNK_LINES // self._looks)
        self.picture = next((stage for stage in after if isinstance(stage, QuickLook)), QuickLook())
        recommended = config.model_dump()["processor"]["recommended"]["stages"]
        shape, radar = list(self.recording.shape), repr(self.recording.radar)
        self._identity = {"recording": [shape, radar], "config": [recommended, config.precision]}

    def focused(self, folder: ResultFolder, resume: bool) -> StripImage:
        """Compute the image in the folder; finished blocks are only checked."""
        path = folder.store("image.zarr")
        if path.exists() and not folder.claimed:
            raise ConfigError(f"--out {folder.path}: torchsar focus did not write {path.name}; choose another folder")
        image = StripImage(path, "r+") if StripImage.is_begun(path) else None
        if image is not None and not resume:
            raise ConfigError(
                f"{folder.path} holds an image already; add --resume to go on with it, or choose another folder"
            )
        if image is not None:
            image.refuse_another(self._identity)
        folder.claim()
        known = self._estimated() if image is None else image.about["values"]
        values = {name: torch.tensor(value, dtype=torch.float64) for name, value in known.items()}
        plan = self._plan(values)
        identity = {**self._identity, "plan": repr(plan)}
        if image is not None:
            image.refuse_another(identity)
        done = [] if image is None else [keep for _, keep in plan.blocks if image.is_finished(self._rows(image, keep))]
        with progress(plan.n_lines, "lines", sum(keep.stop - keep.start for keep in done)) as count:
            for read, keep in plan.blocks:
                recorded = self.recording.recording(read.start, read.stop)
                raw = recorded.signal.data
                checksum = samples_checksum(raw)
                if image is not None and keep in done:
                    image.check(self._rows(image, keep), checksum)
                    continue
                if image is not None and keep.stop - keep.start < self._looks:
                    break  # too few lines are left for a look
                block = self._block(raw, recorded.aux["missing"], read, keep, values)
                if image is None:  # the size of the image is known after the first block
                    about = {"values": known, "rows": [block.axes[0].n, keep.stop]}
                    axes, dtype = self._axes(block, plan, keep), block.data.dtype
                    image = StripImage.create(path, axes, dtype, identity, about, self._chunk_lines)
                image.write(self._rows(image, keep), block.data.cpu(), checksum)
                count.update(keep.stop - keep.start)
        assert image is not None
        return image

    @staticmethod
    def _axes(first: Signal, plan: StripPlan, keep: slice) -> tuple[Axis, Axis]:
        """Axes of the whole image, computed from the first block and the raw lines that it
        represents.
        """
        azimuth, range_ = first.axes
        return azimuth.part(0, plan.n_lines * azimuth.n // keep.stop), range_

    @staticmethod
    def _rows(image: StripImage, keep: slice) -> slice:
        """Rows of the image that belong to raw lines; the numbers of rows and lines may differ."""
        rows, lines = image.about["rows"]
        return slice(keep.start * rows // lines, keep.stop * rows // lines)

    @torch.no_grad()
    def _block(self, raw: Tensor, missing: Tensor, read: slice, keep: slice, values: Mapping[str, Tensor]) -> Signal:
        """Focus a block of raw lines, after its missing lines were filled if the chain has a stage
        for this, and detect it if there is one.
        """
        given = {name: value.to(self._device) for name, value in values.items()}
        fill = self._chain.stages[self._fill] if self._fill and bool(missing.any()) else None

        def focused(signal: Signal, **given: Tensor) -> Signal:
            whole = signal if fill is None else fill(signal, missing=missing.to(self._device), **given)
            return self.focus.focuser(whole, **given)

        image = focus_block(raw.to(self._device), focused, self.recording.radar, self.recording.axes, read, keep, given)
        return image if self.detect is None else self.detect(image)

    def _plan(self, values: Mapping[str, Tensor]) -> StripPlan:
        """Plan the blocks so that their image lines are whole chunks of the store and
        whole looks.
        """
        strip, multiple = self.recording, self._chunk_lines * self._looks
        return self.focus.plan(strip.shape, strip.axes, strip.dtype.itemsize, multiple, **values)

    def _estimated(self) -> dict[str, float]:
        """Values of the estimators before the focusing stage, from lines in the middle of the
        strip.
        """
        if not self._before:
            return {}
        n, samples = self.recording.shape
        count = min(n, self.focus.memory_bytes // (4 * samples * self.recording.dtype.itemsize))
        first = (n - count) // 2
        part = self.recording.recording(first, first + count).to(self._device)
        log.info("estimates from lines %d to %d", first, first + count - 1)
        with torch.no_grad():
            trace = self._chain.trace(part)
        kept = [name for name in self._before if name != self._fill]
        changed = [name for name in kept if trace.outputs[name] is not trace.inputs[name]]
        if changed:
            raise ConfigError(f"the stage {changed[0]!r} before {self._name} changes the samples; {_HINT}")
        for name, estimate in trace.estimates.items():
            shown = ", ".join(f"{key} {float(x.double().mean()):.6g}" for key, x in estimate.value.items())
            reason = "; ".join(code.message for code in estimate.reasons if not code.is_ok)
            log.info("%s: %s%s", name, shown, reason and f" ({reason})")
        used = {name: float(value) for name, value in trace.arguments[self._name].items()}
        log.info("%s uses %s", self._name, ", ".join(f"{key} {value:.6g}" for key, value in used.items()))
        return used
