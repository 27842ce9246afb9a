"""Antennas on any path: aircraft and drones that do not fly straight, bistatic pairs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from torchsar.core import Draws, Recording, Trace
from torchsar.echo.path import nominal_geometry
from torchsar.focus import MotionCompensation, OmegaKImage, PathImage, TilePlan, backproject
from torchsar.focus.ladar_requirements import Limit
from torchsar.focus.motion_compensation import possible_compensations
from torchsar.focus.path_image import last_image
from torchsar.focus.tiles.plan import possible_tiles
from torchsar.io import read_history
from torchsar.metrics import error_db, registered_error_db
from torchsar.radar import AntennaPath, InverseRadar
from torchsar.study.names.registry import PATH_IMPAIRMENTS
from torchsar.study.output.pictures import Drawn, comparisons
from torchsar.study.systems.path import figures
from torchsar.study.systems.path import judge as judging
from torchsar.study.systems.path.world import Flown, path_radar
from torchsar.study.trials.batch import Judged, Processed, Result, Trials
from torchsar.study.trials.bench import Bench
from torchsar.study.trials.choice import Alternative, Choice, Measured
from torchsar.study.trials.direct_images import some_pixels, white_noise
from torchsar.study.trials.system import Column, System

# errors of tiles that are compared, in dB
_ERRORS_DB = (-20.0, -40.0, -60.0, -80.0)


class AnyPath(System):
    """Antennas on any path."""

    name = "path"
    about = "one antenna or two on any path, simulated or recorded range profiles with positions"
    Radar = staticmethod(path_radar)
    World = Flown
    impairments = PATH_IMPAIRMENTS
    reads = "phase history with positions"
    ending = "tile_image, spotlight_image, omega_k_image or direct_image"
    tolerance = {"image_error_db": -40.0}
    exact = {"stage": {"stage": "direct_image"}}
    definitions = {
        "snr": "mean power of the samples of lit pulses over noise variance, dB",
        "entropy": "-sum p ln p, p = |I|^2 / sum |I|^2 over the whole image, nats",
        "contrast": "standard deviation over mean of the intensity |I|^2",
        "image_error_db": "10 lg of |g I - I0|^2 / |I0|^2 in dB, I0 from the reference method, after the shift, "
        "rotation and stretch, the linear and small quadratic phase over the image and the complex gain g that fit "
        "best, which autofocus cannot observe; in `trade`: of the image of white noise, without registration, "
        "relative to the direct sum over the same pulses",
        "path_residual_rms_m": "rms over the pulses of half the path over the middle of the scene, recorded and "
        "corrected minus true, without constant and linear terms; modulo half a wavelength where the path or phases of "
        "pulses are corrected; for a strip over the middle of the strip abeam, and over the pulses that see the image",
        "image_shift_m": "mean displacement of the named points, which autofocus cannot observe, m",
        "position_error_rms_m": "rms over the named points of the distance of the peak from the true position, without "
        "the common shift of all points, and of more than three without a common rotation and stretch, m",
        "entropy_above_ideal_nats": "entropy minus that of the reference method",
    }
    columns = {
        "image_error_db": Column("image error against the reference", "dB", drawn="mean"),
        "path_residual_rms_m": Column("error of the line of sight, rms", "m", drawn="rms"),
        "position_error_rms_m": Column("position error of points, rms", "m"),
        "image_shift_m": Column("common shift of the points", "m"),
        "entropy_nats": Column("entropy", "nats", drawn="mean"),
        "entropy_above_ideal_nats": Column("entropy above the reference", "nats"),
        "contrast": Column("contrast of the intensity"),
        "ok": Column("share of trials called reliable"),
        "seconds": Column("time of a trial", "s"),
    }
    target_columns = {
        "displacement_azimuth_m": Column("displacement in azimuth", "m"),
        "displacement_range_m": Column("displacement in range", "m"),
        "irw_azimuth_m": Column("width in azimuth", "m"),
        "irw_range_m": Column("width in range", "m"),
        "pslr_azimuth_db": Column("PSLR in azimuth", "dB"),
        "pslr_range_db": Column("PSLR in range", "dB"),
    }

    def read(self, path: str, dtype: torch.dtype) -> Recording:
        return read_history(path, dtype)

    def context(self, recording: Recording) -> dict[str, Any]:
        return {"side_data": recording.aux}

    def samples(self, world: Flown, radar: InverseRadar) -> int:
        return world.pulses * world.samples

    def simulate(self, bench: Bench, world: Flown, draws: Draws) -> Trials:
        return world.trials_of(bench.radar, draws, bench.dtype, bench.device)

    def judge(self, bench: Bench, name: str, trace: Trace, trials: Trials, detail: bool) -> Judged:
        return judging.judge(bench, name, trace, trials, detail)

    def compare(self, bench: Bench, outcome: Processed, ideal: Processed | None) -> Judged:
        judged = super().compare(bench, outcome, ideal)
        signals = [one.signal for one in (outcome, ideal) if one is not None and one.signal is not None]
        if ideal is outcome or len({signal.axes for signal in signals}) != 1 or len(signals) != 2:
            return judged
        count = len(judged.metrics["path_residual_rms_m"])
        error = registered_error_db(*(signal.data for signal in signals)).expand(count)
        return replace(judged, metrics={**judged.metrics, "image_error_db": error})

    bounds = staticmethod(judging.bounds)  # pyright: ignore[reportAssignmentType]

    def limits(self, bench: Bench) -> Mapping[Limit, Sequence[str]]:
        """Return the limits of the sample spacing of the images, by the nominal path."""
        geometry = (
            nominal_geometry(bench.radar, (world := bench.world()).of(), world.pulses, world.samples)
            if bench.recording is None
            else (AntennaPath.recorded(bench.recording.aux), bench.recording.aux["frequency_hz"])
        )
        images = {name: last_image(chain.stages.values()) for name, chain in bench.chains.items()}
        found = [(limit, name) for name, one in images.items() if one for limit in one.sampling_limits(*geometry)]
        return {limit: [name for other, name in found if other == limit] for limit, _ in found}

    def choices(self, bench: Bench) -> Sequence[Choice]:
        stage = last_image(bench.chains["recommended"].stages.values())
        if stage is None:
            return []
        clean = (
            replace(bench.world(), impairments={}).trials_of(bench.radar, bench.draws(), bench.dtype, "cpu").clean
            if bench.recording is None
            else bench.recording
        )
        antennas, grid = AntennaPath.recorded(clean.aux), stage.grid
        geometry = (clean.aux["frequency_hz"], antennas.transmitter_m, antennas.receiver_m, antennas.reference_m)
        # tiles sum the pulses of the recommended method
        tiles = possible_tiles(_ERRORS_DB, *geometry, grid, lit=stage.lit(antennas), weight=stage.weight(antennas))
        alternatives = [
            Alternative(
                f"tiles at {error:g} dB",
                {"stage": "tile_image", "error_db": error},
                {"image_error_db": plan.choice.error_db},
                "higher terms of the path within tiles",
            )
            for error, plan in tiles.items()
        ]
        # by the beam of the method that uses omega-K, if there is one
        lit = None if bench.recording is not None else bench.world().beam
        images = (s for c in bench.chains.values() for s in c.stages.values() if isinstance(s, OmegaKImage))
        beams = [image.beam for image in images if image.beam is not None]
        straight = {} if not beams else possible_compensations(geometry[0], antennas, grid, beams[0])
        compensated = [
            Alternative(
                f"omega-K after motion compensation of order {order}",
                {"stage": "omega_k_image", "order": order, "beam_deg": one.beam.width_deg},
                {"image_error_db": one.predicted_db(None if lit is None else lit.mean_power)},
                "change of motion errors with the angle" + (" and with the range" if order == 1 else ""),
            )
            for order, one in straight.items()
        ]
        every = [*compensated, *alternatives, Alternative("direct sum", {"stage": "direct_image"}, {})]
        measured = partial(_measured, bench, geometry, {**straight, **tiles}, stage)
        return [Choice("image", "stage", every, measured)]

    def pictures(self, results: Mapping[str, Result]) -> Iterator[Callable[[], Drawn]]:
        yield partial(comparisons, results, self.columns)
        for case, result in results.items():
            yield partial(figures.images, case, result)
            if result.first.trials.truth:  # not a recording without errors added
                yield partial(figures.paths, case, result)


def _measured(
    bench: Bench,
    geometry: tuple[Tensor, Tensor, Tensor | None, Tensor],
    plans: Mapping[float, MotionCompensation | TilePlan],
    stage: PathImage,
) -> Measured:
    """Images of white noise, at random pixels beside the direct sum."""
    draws, every = bench.draws(), stage.grid.pixels_m().reshape(-1, 3)
    noise = white_noise(draws, geometry[1].shape[-2], len(geometry[0]))
    some = some_pixels(draws, len(every))
    pixels = every[some]
    whole = backproject(noise, *geometry, pixels)
    history = noise.to(bench.dtype)

    def plan(one: Alternative) -> MotionCompensation | TilePlan | None:
        return plans.get(one.keys.get("order", one.keys.get("error_db", 0)))

    def run(one: Alternative) -> Tensor:
        return backproject(history, *geometry, pixels, eps=1e-6) if (of := plan(one)) is None else of.image(history)

    def loss(one: Alternative, image: Tensor) -> dict[str, float]:
        exact = whole if (of := plan(one)) is None else of.exact(noise, pixels)
        made = image if one.keys["stage"] == "direct_image" else image.flatten(-2)[..., some]
        return {"image_error_db": float(error_db(made[..., None, :].to(exact.dtype), exact[..., None, :]).max())}

    part = len(some) / len(every)
    return Measured(run, loss, lambda one: part if one.keys["stage"] == "direct_image" else 1.0)


SYSTEM = AnyPath
