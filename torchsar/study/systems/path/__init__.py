"""Antennas on any path: aircraft and drones that do not fly straight, bistatic pairs."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Annotated, Any

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.data import without_line
from torchsar.core import Chain, Recording, Signal, Trace, per_trial
from torchsar.echo import Impairment, Simulate
from torchsar.echo.path import flown_paths, nominal_geometry
from torchsar.focus import MotionCompensation, OmegaKImage, PathImage, ProcessedBeam, TilePlan, backproject
from torchsar.focus.path_image import last_image, seen_in
from torchsar.focus.requirements import Limit, Requirement
from torchsar.focus.spotlight import window_weights
from torchsar.io import read_history
from torchsar.metrics import (
    contrast,
    entropy,
    error_after_gain_db,
    error_db,
    impulse_response,
    line_of_sight_bound_m,
    registered_errors,
    residual_phase,
)
from torchsar.radar import AntennaPath, InverseRadar
from torchsar.scene import (
    Flight,
    MotionInSweep,
    Navigation,
    PathWorld,
    PlaneGround,
    Points,
    Scene,
    SideBeam,
    Sway,
    Together,
)
from torchsar.scene.flight import NominalPath
from torchsar.scene.path import Ground
from torchsar.study.names.registry import (
    GROUNDS,
    NOMINAL_PATHS,
    PATH_FIDELITIES,
    PATH_IMPAIRMENTS,
    SCENES,
    AntennaMotions,
)
from torchsar.study.systems.isal import estimated_phase, received
from torchsar.study.systems.path.figures import geometry, images, paths
from torchsar.study.systems.path.requirements import flight_requirements, warn_of_range_along_track
from torchsar.study.trials.batch import IMAGE, Batch, Found, Judged, Metrics, Processed, Trials
from torchsar.study.trials.bench import Bench
from torchsar.study.trials.choice import Alternative, Choice, Measured, lit_noise, some_pixels, white_noise
from torchsar.study.trials.system import Column, Noise, System, World, by_limit


def path_radar(carrier_hz: float, bandwidth_hz: float, prf_hz: float, pulse_s: float | None = None) -> InverseRadar:
    """Band and pulse rate of a radar whose pulses are compressed or dechirped.

    Args:
        carrier_hz: Middle of the band in Hz.
        bandwidth_hz: Bandwidth in Hz; a range cell is c / (2 bandwidth).
        prf_hz: Pulse repetition frequency in Hz.
        pulse_s: Length in seconds of a sweep that is dechirped on receive and whose frequency
            rises; null where antennas hardly move within a pulse.
    """
    return InverseRadar(carrier_hz, bandwidth_hz, prf_hz, pulse_s=pulse_s)


@dataclass(frozen=True)
class Track:
    """True path of an antenna.

    Args:
        nominal: Nominal path.
        x: Motions along axis x by name, which add up.
        y: Motions along axis y.
        z: Motions along axis z, which points up.
    """

    nominal: Annotated[NominalPath, NOMINAL_PATHS]
    x: AntennaMotions = ()
    y: AntennaMotions = ()
    z: AntennaMotions = ()


@dataclass(frozen=True)
class Recorded:
    """Errors of the recorded positions of a path.

    Args:
        x: Errors along axis x by name, which add up.
        y: Errors along axis y.
        z: Errors along axis z.
        latency_s: Age of a recorded position in seconds.
        step_m: Step in metres to which positions are rounded; 0 for none.
        rate_hz: Rate of the records in hertz, between which splines interpolate; null for a record
            at every pulse.
    """

    x: AntennaMotions = ()
    y: AntennaMotions = ()
    z: AntennaMotions = ()
    latency_s: Tensor | float = 0.0
    step_m: Tensor | float = 0.0
    rate_hz: float | None = None


@dataclass(frozen=True, kw_only=True)
class Flown(World):
    """Section `world`: the scene and the true paths.

    Args:
        pulses: Number of pulses of the record.
        samples: Number of range cells of each pulse.
        scene: Parts of the scene by name; range is axis x, azimuth axis y.
        transmitter: True path of the transmitter.
        receiver: True path of the receiver; null if both share an antenna.
        navigation: What is recorded of the path of the transmitter; null for the true path.
        receiver_navigation: What is recorded of the path of the receiver; null for the true path.
        ground: Height of the ground.
        beam: Beam of the receiver, and of the transmitter if they share an antenna; null if the
            scene is always lit.
        window_range_m: Constant range of the middle of the range window in metres; null to follow
            the middle of the scene.
        fidelity: Motion within sweeps of the length `radar.pulse_s`; null for antennas at rest
            during a pulse.
        noise: Receiver noise; the SNR is the mean over the samples of lit pulses.
        impairments: Impairments of the recording by name, in the order of their effect.
    """

    pulses: int
    samples: int
    scene: Mapping[str, Annotated[Scene, SCENES]]
    transmitter: Track
    receiver: Track | None = None
    navigation: Recorded | None = None
    receiver_navigation: Recorded | None = None
    ground: Annotated[Ground, GROUNDS] = field(default_factory=PlaneGround)
    beam: SideBeam | None = None
    window_range_m: float | None = None
    fidelity: Annotated[MotionInSweep, PATH_FIDELITIES] | None = None
    noise: Noise = field(default_factory=Noise)
    impairments: Mapping[str, Annotated[Impairment, PATH_IMPAIRMENTS]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.pulses < 2 or self.samples < 2 or not self.scene:
            raise ValueError(
                "world needs at least one scene, two pulses and two samples, got "
                f"{len(self.scene)} scenes, {self.pulses} pulses and {self.samples} samples"
            )

    def of(self) -> PathWorld:
        """The parameters of the echo simulation."""
        tracks = (self.transmitter, self.receiver)
        flown = [None if one is None else Flight(one.nominal, Sway(one.x, one.y, one.z)) for one in tracks]
        records = (one or Recorded() for one in (self.navigation, self.receiver_navigation))
        known = [Navigation(Sway(one.x, one.y, one.z), one.latency_s, one.step_m, one.rate_hz) for one in records]
        effects = (self.ground, self.beam, self.window_range_m, self.noise.snr_db, self.fidelity)
        return PathWorld(Together(self.scene), *flown, *known, *effects)  # pyright: ignore[reportCallIssue, reportArgumentType]

    def simulation(self, radar: InverseRadar, dtype: torch.dtype) -> Simulate:
        return Simulate(radar, self.of(), self.pulses, self.samples, dtype=dtype, impairments=self.impairments)

    @property
    def named_points(self) -> dict[str, tuple[Tensor | float, Tensor | float]]:
        """Azimuth and range in metres of the points of the scene, by names such as `corners.0`."""
        return {
            f"{part}.{i}": place
            for part, scene in self.scene.items()
            if isinstance(scene, Points)
            for i, place in enumerate(zip(scene.azimuth_m, scene.range_m, strict=True))
        }


def residual_m(chain: Chain, trace: Trace, trials: Trials, wavelength_m: float, clean: bool) -> Tensor:
    """Return the error of the line of sight (m) that a chain leaves, (trial, pulse).

    It has no constant and linear terms, which shift the image, and rotate and stretch it slightly.
    Where the chain estimates it or phases of pulses it is known modulo half a wavelength. It is NaN
    for pulses outside of the strip, if the image is that of a strip.
    """
    strip = seen_in(chain.stages.values(), AntennaPath.recorded(trials.recording.aux))
    pulses = (trials.count, len(strip))
    parts = [x for key, x in trials.truth.items() if key.rpartition(".")[2] == "line_of_sight_m" and not clean]
    true = sum((x.expand(pulses) for x in parts), torch.zeros(pulses, dtype=torch.float64, device=strip.device))
    phases = [x for key, x in trials.truth.items() if key.endswith(".phase_rad") and not clean]
    radians = 4 * math.pi / wavelength_m
    of_path = [e.value["line_of_sight_m"] for e in trace.estimates.values() if "line_of_sight_m" in e.value]
    if phases or of_path or any("phase_rad" in uses for uses in chain.uses.values()):
        # a recorded range that is too long leaves a positive phase
        whole = radians * true + sum((x.reshape(pulses) for x in phases), torch.zeros_like(true))
        found = sum((radians * x.reshape(pulses) for x in of_path), estimated_phase(chain, trace, whole))
        present = received(trials)
        left = residual_phase(found, whole, strip.expand(pulses) if present is None else present & strip) / radians
    else:
        left = -without_line(true, strip)
    return left.masked_fill(~strip, math.nan)


def _positions(off: Tensor, at: Tensor) -> dict[str, Tensor]:
    """Common shift of points in m, (trial,), and the rms distance in m that remains after it is
    removed.

    With more than three points, a linear displacement is also removed: rotation and stretch of the
    image. off: displacements (trial, point, 2); at: positions (trial, point, 2).
    """
    basis = torch.cat([torch.ones_like(at[..., :1]), at[..., : 2 * (at.shape[1] > 3)]], -1)
    left = (off - basis @ (torch.linalg.pinv(basis) @ off)).square().sum(-1).mean(-1).sqrt()
    return {"image_shift_m": off.mean(1).square().sum(-1).sqrt(), "position_error_rms_m": left}


def _points(
    bench: Bench, chain: Chain, image: Signal, trials: Trials, reach_m: float = 10.0
) -> tuple[dict[str, Metrics], list[str], dict[str, Tensor]]:
    """Metrics of the named points in the image, names of those outside it, and the displacement
    that the points have in common.

    A point is sought within `reach_m`, or less if another point is near.
    """
    stage = last_image(chain.stages.values())
    if stage is None:
        return {}, [], {}
    (_, cos, _), (_, sin, _) = stage.grid.axes.tolist()  # axes of the image in azimuth and range
    places, outside = {}, []
    image = image.with_data(image.data.expand(trials.count, *image.data.shape[-2:]))
    for name, place in bench.world().named_points.items():
        y, x = (per_trial(v, 0, image.data).expand(trials.count) for v in place)
        at = torch.stack([cos * y - sin * x, cos * x + sin * y], -1)
        edges = [(axis.index_of(at[:, i]), axis.n - 1) for i, axis in enumerate(image.axes)]
        if all(bool(((i >= 0) & (i <= last)).all()) for i, last in edges):
            places[name] = at
        else:
            outside.append(name)
    if not places:
        return {}, outside, {}
    at = torch.stack([*places.values()], 1)  # shape (trial, point, 2)
    apart = torch.cdist(at, at) + 2 * reach_m * torch.eye(len(places), dtype=torch.float64, device=at.device)
    search_m = max(image.axes[0].step, min(reach_m, float(apart.min()) / 2))
    found = impulse_response(image, (at[..., 0], at[..., 1]), search_m=search_m)
    off = torch.stack([found[f"position_{axis}_m"] for axis in IMAGE], -1) - at
    found |= {f"displacement_{axis}_m": off[..., i] for i, axis in enumerate(IMAGE)}
    shown = AnyPath.target_columns
    targets: dict[str, Metrics] = {name: {key: found[key][:, i] for key in shown} for i, name in enumerate(places)}
    responses = {key: found[key].nanmedian(1).values for key in shown if not key.startswith("displacement")}
    return targets, outside, {**_positions(off, at), **responses}


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
        "amplitude_error_db": "10 lg of |g |I| - |I0||^2 / |I0|^2 in dB, I0 from the reference method, after the "
        "shift, rotation and stretch and the real gain g that fit best; what is seen in the image",
        "phase_error_rad": "rms difference of the phases of I and I0, weighted by |I I0|, after the same registration "
        "and without constant, linear and small quadratic phases over the image; it matters where images are compared "
        "or added, and autofocus cannot observe slow phases; left out, as the error of the amplitudes, where an image "
        "differs from the reference by rounding only",
        "image_error_db": "10 lg of |g I - I0|^2 / |I0|^2 in dB of the complex samples, so that both errors count, "
        "with a complex gain g, as `requires` predicts it; after the same registration where the path or the phases of "
        "pulses differ from those of the reference, since autofocus cannot observe a shift; in `trade`: of the "
        "windowed image of white noise seen through the antenna, relative to the direct sum over the same pulses",
        "irw_azimuth_m": "median over the named points, as the other figures of responses; each point has its own in "
        "the tables of targets",
        "path_residual_rms_m": "rms over the pulses of half the path over the middle of the scene, recorded and "
        "corrected minus true, without constant and linear terms; modulo half a wavelength where the path or phases of "
        "pulses are corrected; for a strip over the middle of the strip abeam, and over the pulses that see the image",
        "image_shift_m": "mean displacement of the named points, which autofocus cannot observe, m",
        "position_error_rms_m": "rms over the named points of the distance of the peak from the true position, without "
        "the common shift of all points, and of more than three without a common rotation and stretch, m",
        "entropy_above_ideal_nats": "entropy minus that of the reference method",
    }
    columns = {
        "amplitude_error_db": Column("error of the amplitudes against the reference", "dB", drawn="mean"),
        "phase_error_rad": Column("error of the phases of bright pixels, rms", "rad", drawn="rms"),
        "irw_azimuth_m": Column("width of points in azimuth", "m"),
        "irw_range_m": Column("width of points in range", "m"),
        "pslr_azimuth_db": Column("PSLR of points in azimuth", "dB"),
        "pslr_range_db": Column("PSLR of points in range", "dB"),
        "position_error_rms_m": Column("position error of points, rms", "m"),
        "image_shift_m": Column("common shift of the points", "m"),
        "entropy_nats": Column("entropy", "nats", drawn="mean"),
        "entropy_above_ideal_nats": Column("entropy above the reference", "nats"),
        "contrast": Column("contrast of the intensity"),
        "path_residual_rms_m": Column("error of the line of sight, rms", "m", drawn="rms"),
        "image_error_db": Column("error of the complex samples, as predicted by `requires`", "dB"),
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

    draw_case = (images, geometry, paths)
    read = staticmethod(read_history)  # pyright: ignore[reportAssignmentType]

    def context(self, recording: Recording) -> dict[str, Any]:
        return {"side_data": recording.aux}

    def extra_definitions(self, bench: Bench) -> Mapping[str, Any]:
        left = {
            f"{name}.{key}": text
            for name, chain in bench.chains.items()
            for key, stage in chain.stages.items()
            if (text := getattr(stage, "not_estimated", ""))
        }
        return {**super().extra_definitions(bench), **({"not_estimated": left} if left else {})}

    def notes(self, metrics: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
        for stage, text in metrics["definitions"].get("not_estimated", {}).items():
            yield f"Not estimated by {stage}, and not part of its outcome", f"{text[0].upper()}{text[1:]}."

    def judge(self, bench: Bench, name: str, trace: Trace, trials: Trials, detail: bool) -> Judged:
        """Return the metrics of the image and of the path by one method.

        The field `view` of the result is the error of the line of sight in metres that is left,
        (trial, pulse).
        """
        chain, clean = bench.chains[name], bench.config.processor[name].input == "clean"
        left = residual_m(chain, trace, trials, bench.radar.wavelength_m, clean)
        metrics = {"path_residual_rms_m": left.square().nanmean(-1).sqrt()}
        targets: dict[str, Metrics] = {}
        outside: list[str] = []
        if trace.signal.names == IMAGE:
            metrics |= {"entropy_nats": entropy(trace.signal), "contrast": contrast(trace.signal)}
            if bench.recording is None:
                targets, outside, positions = _points(bench, chain, trace.signal, trials)
                metrics |= positions
        metrics = {key: value.double().expand(trials.count) for key, value in metrics.items()}
        return Judged(metrics, targets if detail else {}, outside if detail else (), view=left)

    def found(self, bench: Bench, outcome: Processed, trials: Trials) -> dict[str, Found]:
        """Return the estimates, without standard deviations (NaN) outside of the imaged strip.

        Pulses that do not see the strip change no image, and their line of sight is extrapolated.
        """
        table = super().found(bench, outcome, trials)
        left = outcome.judged.view
        return {
            key: one
            if left is None or one.std is None or one.std.shape != left.shape
            else replace(one, std=one.std.where(left.isfinite(), math.nan))
            for key, one in table.items()
        }

    def compare(self, bench: Bench, outcome: Processed, ideal: Processed | None) -> Judged:
        judged = super().compare(bench, outcome, ideal)
        signals = [one.signal for one in (outcome, ideal) if one is not None and one.signal is not None]
        if ideal is outcome or len({signal.axes for signal in signals}) != 1 or len(signals) != 2:
            return judged
        count = len(judged.metrics["path_residual_rms_m"])
        errors = registered_errors(*(signal.data for signal in signals))
        left, least = judged.view, None if ideal is None else ideal.judged.view
        # images that differ by rounding only have no errors to compare
        if bool((errors["image_error_db"] < -150).all()):
            errors = {"image_error_db": errors["image_error_db"]}
        # a method that uses the path of the reference puts everything at its place
        elif isinstance(left, Tensor) and isinstance(least, Tensor) and left.allclose(least, 0, 1e-9, equal_nan=True):
            pair = torch.broadcast_tensors(*(signal.data for signal in signals))
            errors["image_error_db"] = error_after_gain_db(*pair)
        return replace(judged, metrics={**judged.metrics, **{key: x.expand(count) for key, x in errors.items()}})

    def bounds(self, bench: Bench, batch: Batch) -> dict[str, dict[str, Tensor]]:
        """Return the Cramer-Rao bound of the line of sight, (trial,); nothing for large or recorded
        scenes and for data without noise.
        """
        truth, count = batch.trials.truth, batch.trials.count
        std = truth.get("noise_std")
        if bench.recording is not None or std is None or not bool((std > 0).all()):
            return {}
        points = torch.stack(
            torch.broadcast_tensors(*(truth[f"{axis}_m"] for axis in ("range", "azimuth", "height"))), -1
        )
        # for more pulses * samples * scatterers, the bound would take more than some seconds
        aux = batch.trials.clean.aux
        antennas = AntennaPath.recorded(aux)
        if antennas.pulses * len(aux["frequency_hz"]) * points.shape[-2] > 10_000_000 or bench.world().beam is not None:
            return {}
        bound = line_of_sight_bound_m(aux["frequency_hz"], antennas, points, truth["amplitude"], std)
        return {"path_residual_rms_m": {"Cramer-Rao": bound.expand(count)}}

    def limits(self, bench: Bench) -> Mapping[Limit, Sequence[str]]:
        """Return the limits of sample spacing and pulses of the images, by the nominal path."""
        geometry = (
            nominal_geometry(bench.radar, (world := bench.world()).of(), world.pulses, world.samples)
            if bench.recording is None
            else (AntennaPath.recorded(bench.recording.aux), bench.recording.aux["frequency_hz"])
        )
        images = {name: last_image(chain.stages.values()) for name, chain in bench.chains.items()}
        warn_of_range_along_track(geometry[0], [one.grid for one in images.values() if one])
        lit = None if bench.recording is not None else bench.world().beam
        antenna = (None, None)
        if lit is not None:
            numbers = (float(torch.as_tensor(v).mean()) for v in (lit.width_deg, lit.squint_deg))
            # ProcessedBeam raises ValueError for a beam that reaches the direction of the track
            with suppress(ValueError):
                antenna = lit.mean_power, ProcessedBeam(*numbers)
        return by_limit(
            (at, name)
            for name, one in images.items()
            if one
            for at in (*one.pulse_limits(*geometry, *antenna), *one.sampling_limits(*geometry))
        )

    def requirements(self, bench: Bench) -> Sequence[Requirement]:
        """Return the requirements of the flight of the first trial, see `flight_requirements`."""
        if bench.recording is not None:
            path, beam = AntennaPath.recorded(bench.recording.aux), None
            return flight_requirements(bench.radar, path, path, beam)
        world = bench.world()
        draws = bench.draws(bench.system.address, range(1))
        return flight_requirements(bench.radar, *flown_paths(bench.radar, world.of(), world.pulses, draws), world.beam)

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
        # the tile plans sum the same pulses as the recommended method
        seen = stage.lit(antennas), stage.weight(antennas)
        tiles = _possible_plans(
            lambda error: TilePlan(*geometry, grid, error, *seen, images=None), (-20.0, -40.0, -60.0, -80.0)
        )
        alternatives = [
            Alternative(
                f"tiles at {error:g} dB",
                {"stage": "tile_image", "error_db": error},
                {"image_error_db": plan.choice.error_db},
                "higher terms of the path within tiles",
            )
            for error, plan in tiles.items()
        ]
        # the beam is that of the method that uses omega-K, if there is one
        lit = None if bench.recording is not None else bench.world().beam
        images = (s for c in bench.chains.values() for s in c.stages.values() if isinstance(s, OmegaKImage))
        beams = [image.beam for image in images if image.beam is not None]
        straight = _possible_plans(
            lambda order: MotionCompensation(geometry[0], antennas, grid, beams[0], order), (1, 2) if beams else ()
        )
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
        measured = partial(_measured, bench, geometry, {**straight, **tiles}, stage, lit)
        return [Choice("image", "stage", every, measured)]


def _measured(
    bench: Bench,
    geometry: tuple[Tensor, Tensor, Tensor | None, Tensor],
    plans: Mapping[float, MotionCompensation | TilePlan],
    stage: PathImage,
    beam: SideBeam | None,
) -> Measured:
    """Measure images of white noise at random pixels, relative to the direct sum."""
    draws, every = bench.draws(), stage.grid.pixels_m().reshape(-1, 3)
    noise = white_noise(draws, geometry[1].shape[-2], len(geometry[0]))
    if beam is not None:
        noise = lit_noise(noise, geometry[0], AntennaPath(*geometry[1:]), beam)
    rows, columns = (window_weights(name, n) for name, n in zip(stage.windows, noise.shape, strict=True))
    noise = noise * columns * rows[:, None]
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


def _possible_plans(plan: Callable[[Any], Any], settings: Iterable[Any]) -> dict[Any, Any]:
    """Plans of images by those settings for which `plan` does not raise ValueError, such as errors
    of tiles that a geometry allows.
    """
    found: dict[Any, Any] = {}
    for one in settings:
        with suppress(ValueError):
            found[one] = plan(one)
    return found


SYSTEM = AnyPath
