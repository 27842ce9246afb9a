"""The command `torchsar export`: writes the first trial of a run in formats of other programs."""

from __future__ import annotations

from pathlib import Path

from torchsar.io import read_images
from torchsar.io.export import export_images, export_recording
from torchsar.radar import LocalFrame
from torchsar.study.output.folder import fresh_result
from torchsar.study.settings.errors import ConfigError
from torchsar.study.settings.sections import Loaded, cases_of, key_of
from torchsar.study.trials.batch import last_stage
from torchsar.study.trials.bench import Bench


def export(run: Path, loaded: Loaded, form: str, out: Path, frame: LocalFrame | None = None) -> None:
    """Write the first trial of a run in another format.

    Args:
        run: The folder of the result of `torchsar run`.
        loaded: The config in this folder.
        form: netcdf (all images), sicd or geotiff (images of stages for any path), or cphd (the
            recording of every case).
        out: The folder of the new files.
        frame: Frame of the local coordinates; None for that of the recording.

    Raises:
        ConfigError: If the run has no image for the format.
        ValueError: If an image or a recording cannot be written.
    """
    images = read_images(run / "arrays.zarr")
    with fresh_result(out, "export", ()) as folder:
        if form == "netcdf":
            export_images(folder, images, loaded.config.title)
        for case, part in cases_of(loaded).items() if form != "netcdf" else ():
            bench = Bench(part)
            recording = bench.trials(bench.draws(bench.system.address, range(1))).recording
            last = {key_of(case, name): last_stage(chain)[1] for name, chain in bench.chains.items()}
            formed = {name: (images[name], stage) for name, stage in last.items() if name in images}
            export_recording(folder, form, key_of(case, "recording"), recording, formed, frame)
        if not any(folder.iterdir()):
            raise ConfigError(f"{run} has no image for {form}, which takes those of tile_image and the like")
