"""Continuous stripmap, from impaired raw data to a focused image (Tsvetkov 2017)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Annotated, Any

import torch
from torch import Tensor

from torchsar.core import Chain, Draws, Signal, Trace, Truth, wrapped
from torchsar.echo import Impairment, Simulate
from torchsar.echo.recorded import numbered
from torchsar.echo.strip import target_energy
from torchsar.focus import ClosestRange
from torchsar.focus.requirements import Limit, Requirement, strip_limits
from torchsar.focus.skew import common_lines
from torchsar.io import read_stripmap
from torchsar.metrics import (
    contrast,
    correlation,
    entropy,
    error_db,
    impulse_response,
    reference_doppler_std_hz,
    tone_frequency_bound_hz,
    velocity_bound_m_s,
)
from torchsar.radar import StripmapRadar
from torchsar.scene import AlwaysLit, Hyperbola, MovingPoints, Points, RandomPoints, Scene, StripmapWorld, Together
from torchsar.scene.strip import Beam, Path
from torchsar.study.names.registry import BEAMS, IMPAIRMENTS, PATHS, SCENES, with_wavelength
from torchsar.study.output.report import Drawn, comparisons
from torchsar.study.settings.errors import ConfigError
from torchsar.study.settings.sections import Loaded
from torchsar.study.systems.stripmap.choices import choices, probe_of
from torchsar.study.systems.stripmap.judge import DRAW_CASE, Margin, Used, window
from torchsar.study.trials import system
from torchsar.study.trials.batch import IMAGE, Batch, Judged, Processed, Result, Trials, error_name
from torchsar.study.trials.bench import Bench
from torchsar.study.trials.choice import Choice
from torchsar.study.trials.system import Column, Noise, System, World, named_points


@dataclass(frozen=True, kw_only=True)
class Strip(World):
    """Section `world`: the simulated strip and its true parameters.

    Args:
        lines: Number of pulses of the record.
        samples: Number of range samples of each pulse.
        scene: Scenes by name, whose echoes add up.
        beam: Illumination of the scene by the antenna.
        path: Model of the range to a target over time.
        velocity_m_s: True effective velocity in m/s; None for the nominal one of the radar.
        doppler_hz: True Doppler centroid in Hz; None for the nominal pointing of the radar.
        squint_deg: True squint of the beam in degrees, as an alternative to doppler_hz.
        movers: Moving points besides the scene; null for none.
        noise: Receiver noise; the SNR is that of raw samples that contain signal.
        impairments: Impairments of the recording by name, in the order of their effect.
    """

    least = {"lines": 2, "samples": 2, "scene": 1}
    lines: int
    samples: int
    scene: Mapping[str, Annotated[Scene, SCENES]]
    beam: Annotated[Beam, BEAMS] = field(default_factory=AlwaysLit)
    path: Annotated[Path, PATHS] = field(default_factory=Hyperbola)
    velocity_m_s: Tensor | float | None = None
    doppler_hz: Tensor | float | None = None
    squint_deg: Tensor | float | None = None
    movers: MovingPoints | None = None
    noise: Noise = field(default_factory=Noise)
    impairments: Mapping[str, Annotated[Impairment, IMPAIRMENTS]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.doppler_hz is not None and self.squint_deg is not None:
            raise ValueError("doppler_hz and squint_deg both give the direction of the beam; give one of them")
        if self.velocity_m_s is not None and bool((torch.as_tensor(self.velocity_m_s) <= 0).any()):
            raise ValueError(f"velocity_m_s must be positive, got {self.velocity_m_s}")
        if self.squint_deg is not None and bool((torch.as_tensor(self.squint_deg).abs() >= 90).any()):
            raise ValueError(f"squint_deg must lie between -90 and 90 degrees, got {self.squint_deg}")

    def doppler(self, radar: StripmapRadar) -> Tensor | float | None:
        """True Doppler of the beam centre, 2 v sin(squint) / lambda where a squint is given."""
        if self.squint_deg is None:
            return self.doppler_hz
        velocity = radar.velocity_m_s if self.velocity_m_s is None else self.velocity_m_s
        squint = torch.deg2rad(torch.as_tensor(self.squint_deg, dtype=torch.float64))
        return 2 * velocity * torch.sin(squint) / radar.wavelength_m

    def of(self, radar: StripmapRadar) -> StripmapWorld:
        """The parameters of the echo simulation."""
        doppler, scene = self.doppler(radar), Together(self.scene)
        return StripmapWorld(scene, self.beam, self.path, self.velocity_m_s, doppler, self.noise.snr_db, self.movers)

    def simulation(self, radar: StripmapRadar, dtype: torch.dtype) -> Simulate:
        return Simulate(radar, self.of(radar), self.lines, self.samples, dtype=dtype, impairments=self.impairments)

    def trials_of(self, radar: StripmapRadar, draws: Draws, dtype: torch.dtype, device: str = "cpu") -> Trials:
        made = super().trials_of(radar, draws, dtype, device)
        return replace(made, clean=numbered(made.clean))

    @property
    def named_points(self) -> dict[str, int]:
        """Names of the point targets and their indices among all scatterers.

        A name is the key of the scene part in the config and the number of the target in this part,
        such as `points.0`.
        """
        return named_points(self.scene, {Points: None, RandomPoints: None})


_FIGURES = ("irw_azimuth_m", "irw_range_m", "pslr_azimuth_db", "pslr_range_db", "islr_azimuth_db", "islr_range_db")


@dataclass(frozen=True, kw_only=True)
class Judging(system.Judging):
    """Settings of the metrics.

    Args:
        margin: Edges of the image that the metrics leave out; None for lines without a full
            aperture and samples without a full pulse.
        sidelobe_nulls: Distance from the peak up to which side lobes are measured, in null spacings
            of a rectangular band.
        found_within_m: Largest distance in metres between the peak and the true position of a
            target that counts as found.
        found_above_db: Lowest peak of a target that counts as found, in dB relative to the
            reference.
    """

    margin: Margin | None = None
    sidelobe_nulls: int = 10
    found_within_m: float = 10.0
    found_above_db: float = -6.0


def estimation_metrics(trace: Trace, trials: Trials, prf_hz: float) -> dict[str, Tensor]:
    """Return the scalar estimates of a chain by name, and their errors.

    If two stages estimate values of the same name, the value of the later stage is used.
    """
    n, truth = trials.count, trials.truth
    found = {key: v for estimate in trace.estimates.values() for key, v in estimate.value.items()}
    values = {key: v.double().expand(n) for key, v in found.items() if v.shape == trace.signal.trials}
    metrics = dict(values)
    for key, value in values.items():
        if key in truth and truth[key].numel() in (1, n):
            metrics[error_name(key)] = value - truth[key].to(value)
    doppler = values.get("doppler_hz", values.get("doppler_baseband_hz"))
    if doppler is not None and "doppler_hz" in truth:
        metrics["doppler_baseband_error_hz"] = wrapped(doppler - truth["doppler_hz"].to(doppler), prf_hz)
    return metrics


def positions(chain: Chain, used: Used, bench: Bench, trials: Trials) -> tuple[Tensor, Tensor]:
    """Return the expected azimuth and range (m) of the point targets in an image, each of shape
    (trial, target).
    """
    index = torch.tensor(list(bench.world().named_points.values()))
    zero, closest, velocity = (trials.truth[key] for key in ("zero_doppler_s", "closest_range_m", "velocity_m_s"))
    zero, closest = (x[..., index].expand(trials.count, -1) for x in (zero, closest))
    azimuth, slant = bench.radar.image_position(
        zero, closest, used.frame_hz[:, None], velocity.expand(trials.count)[:, None]
    )
    flat = any(isinstance(stage, ClosestRange) for stage in chain.stages.values())
    return azimuth, closest if flat else slant


def _targets(
    bench: Bench, chain: Chain, image: Signal, used: Used, trials: Trials
) -> tuple[dict[str, dict[str, Tensor]], list[str]]:
    """Metrics of every point target inside the image, and the names of those outside."""
    names = [] if bench.recording is not None else list(bench.world().named_points)
    if not names:
        return {}, []
    expected = positions(chain, used, bench, trials)
    inside = torch.stack([(x >= a.start) & (x <= a.stop) for x, a in zip(expected, image.axes)]).all(0).all(0)
    kept = [name for name, within in zip(names, inside.tolist()) if within]
    outside = [name for name in names if name not in kept]
    if not kept:
        return {}, outside
    at = tuple(x[:, inside] if image.trials else x[0, inside] for x in expected)
    figures = impulse_response(image, (at[0], at[1]), sidelobe_nulls=bench.judging.sidelobe_nulls)
    figures = {key: value.reshape(trials.count, -1) for key, value in figures.items()}
    table = {key: figures[key] for key in _FIGURES}
    for axis, x in zip(("azimuth", "range"), expected):
        table[f"position_error_{axis}_m"] = figures[f"position_{axis}_m"] - x[:, inside]
    table["peak_db"] = 20 * torch.log10(figures["peak"].abs().clamp_min(1e-300))
    return {name: {key: value[:, i] for key, value in table.items()} for i, name in enumerate(kept)}, outside


def over_targets(bench: Bench, judged: Judged, ideal: Judged | None) -> Judged:
    """Return the metrics of a method over its point targets: peaks relative to the reference
    method, the number of targets found, and medians over those found.
    """
    settings, targets = bench.judging, {}
    for name, row in judged.targets.items():
        level = 0.0 if ideal is None or name not in ideal.targets else ideal.targets[name]["peak_db"]
        peak = row["peak_db"] - level
        away = torch.hypot(row["position_error_azimuth_m"], row["position_error_range_m"])
        seen = (away <= settings.found_within_m) & ((peak >= settings.found_above_db) | (ideal is None))
        targets[name] = {**row, "peak_db": peak, "found": seen.double()}
    if not targets:
        return judged
    found = torch.stack([row["found"] for row in targets.values()])  # (target, trial)
    metrics = {"targets": torch.full_like(found[0], len(targets)), "targets_found": found.sum(0)}
    for key in (*_FIGURES, "position_error_azimuth_m", "position_error_range_m"):
        values = torch.stack([row[key] for row in targets.values()])
        kept = torch.where(found > 0, values, torch.nan)
        if key in _FIGURES:
            metrics[key] = kept.nanmedian(0).values
        else:
            metrics[key.replace("_m", "_rms_m")] = kept.square().nanmean(0).sqrt()
    return Judged({**judged.metrics, **metrics}, targets, judged.outside, judged.view)


class Stripmap(System):
    """shape (target, trial)"""

    name = "stripmap"
    about = "side-looking radar on a straight path, simulated or recorded raw data"
    Radar = staticmethod(with_wavelength(StripmapRadar))
    World = Strip
    Judging = Judging
    impairments = IMPAIRMENTS
    reads = "raw stripmap"
    ending = "a focusing stage"
    truths = ("doppler_hz", "velocity_m_s")
    # random numbers are addressed without the batch, so that results of earlier versions are
    # reproduced
    address = 0
    peak = 2.0
    tolerance = {"image_error_db": -20.0, "echo_error_db": -20.0, "data_error_db": -20.0}
    exact = {"stage": {"stage": "omega_k_stolt"}, "world.path": {"kind": "hyperbola"}}
    definitions = {
        "snr": "mean signal power over noise variance, of the raw samples that contain signal, dB",
        "entropy": "-sum p ln p, p = |I|^2 / sum |I|^2 over the window, nats",
        "contrast": "standard deviation over mean of the intensity |I|^2 over the window",
        "irw": "-3 dB width of the impulse response, m; the median over the targets that were found",
        "pslr": "peak of the strongest side lobe over that of the main lobe, dB",
        "islr": "energy of the side lobes over that of the main lobe (null to null), dB",
        "position_error": "measured minus true position of the peak, m",
        "peak_db": "interpolated peak relative to the same target in the reference method, dB",
        "image_error_db": "10 lg of |I - I0|^2 / |I0|^2 over the window, I0 from the reference method, dB",
        "image_correlation": "|<I, I0>| / (|I| |I0|) of the complex images over the window",
        "doppler_centroid_hz": "absolute Doppler frequency of the beam centre, positive when the range decreases",
        "doppler_baseband_hz": "the Doppler centroid modulo the PRF, between -PRF/2 and PRF/2",
        "squint_deg": "asin(wavelength * doppler / (2 * velocity)), positive when the beam looks ahead",
        "published": "values of the source, or those of the theory of a rectangular spectrum",
    }
    columns = {
        "targets_found": Column("targets found"),
        "image_error_db": Column("image error against the reference", "dB", drawn="mean"),
        "image_correlation": Column("image correlation with the reference"),
        "entropy_nats": Column("entropy", "nats", drawn="mean"),
        "doppler_centroid_hz": Column("Doppler centroid", "Hz"),
        "doppler_baseband_hz": Column("Doppler centroid within one PRF", "Hz"),
        "squint_deg": Column("squint", "deg"),
        "effective_velocity_m_s": Column("effective velocity", "m/s"),
        "contrast": Column("contrast of the intensity"),
        "doppler_baseband_error_hz": Column("error of the Doppler centroid within one PRF", "Hz"),
        "velocity_error_m_s": Column("error of the effective velocity", "m/s"),
        "irw_azimuth_m": Column("width in azimuth, median", "m"),
        "irw_range_m": Column("width in range, median", "m"),
        "pslr_azimuth_db": Column("PSLR in azimuth, median", "dB"),
        "pslr_range_db": Column("PSLR in range, median", "dB"),
        "islr_azimuth_db": Column("ISLR in azimuth, median", "dB"),
        "islr_range_db": Column("ISLR in range, median", "dB"),
        "position_error_azimuth_rms_m": Column("position error in azimuth, rms", "m"),
        "position_error_range_rms_m": Column("position error in range, rms", "m"),
        "targets_outside": Column("targets outside the image"),
        "ok": Column("share of trials called reliable"),
        "seconds": Column("time of the chain", "s"),
    }
    target_columns = {
        "peak_db": Column("peak relative to the reference", "dB"),
        "irw_azimuth_m": Column("width in azimuth", "m"),
        "irw_range_m": Column("width in range", "m"),
        "pslr_azimuth_db": Column("PSLR in azimuth", "dB"),
        "pslr_range_db": Column("PSLR in range", "dB"),
        "islr_azimuth_db": Column("ISLR in azimuth", "dB"),
        "islr_range_db": Column("ISLR in range", "dB"),
        "position_error_azimuth_m": Column("position error in azimuth", "m"),
        "position_error_range_m": Column("position error in range", "m"),
    }

    settings = {"islr_extent_nulls": "sidelobe_nulls", "reference": "reference"}
    draw_case = DRAW_CASE
    plain_names = True
    read = staticmethod(partial(read_stripmap, regular=True))  # pyright: ignore[reportAssignmentType]

    def samples(self, world: Strip, radar: StripmapRadar) -> int:
        return world.lines * world.samples

    def judge(self, bench: Bench, name: str, trace: Trace, trials: Trials, detail: bool) -> Judged:
        """Return the metrics of one method, with those of point targets if `detail` is true."""
        chain, n = bench.chains[name], trials.count
        metrics = estimation_metrics(trace, trials, bench.radar.prf_hz)
        if trace.signal.names != IMAGE:
            return Judged(metrics)
        used = Used.by(chain, trace, bench.radar, n)
        # the metrics of images and responses are those before detection
        if not trace.signal.data.is_complex():
            return Judged({**metrics, **used.metrics(bench.radar)}, view=used)
        image = trace.signal.isel(**window(trace.signal, bench.radar, bench.judging.margin))
        metrics.update(
            used.metrics(bench.radar), entropy_nats=entropy(image).expand(n), contrast=contrast(image).expand(n)
        )
        if not detail:
            return Judged(metrics, view=used)
        targets, outside = _targets(bench, chain, trace.signal, used, trials)
        return Judged(metrics, targets, outside, used)

    def compare(self, bench: Bench, outcome: Processed, ideal: Processed | None) -> Judged:
        """Return the metrics of a method, with image error and correlation relative to the
        reference method, and with statistics over its point targets.
        """
        judged = over_targets(bench, outcome.judged, None if ideal is None else ideal.judged)
        one, other = outcome.signal, None if ideal is None else ideal.signal
        if one is None or other is None or one is other or not one.names == other.names == IMAGE:
            return judged
        if not (one.data.is_complex() and other.data.is_complex()):
            return judged
        pair = [
            # double precision for sums over many pixels
            image.isel(**window(image, bench.radar, bench.judging.margin)).to(torch.complex128)
            for image in common_lines(one, other)
        ]
        count = len(judged.metrics["seconds"])
        found = {"image_error_db": error_db(*pair), "image_correlation": correlation(*pair)}
        return replace(
            judged, metrics={**judged.metrics, **{name: value.expand(count) for name, value in found.items()}}
        )

    def check_sweep(self, loaded: Loaded, grid: Mapping[str, Any]) -> None:
        if "world.doppler_hz" in grid and "world.squint_deg" in grid:
            raise ConfigError(
                f"{loaded.file}: sweep: world.doppler_hz and world.squint_deg both give the direction of the beam; "
                "sweep one of them"
            )

    def bounds(self, bench: Bench, batch: Batch) -> dict[str, dict[str, Tensor]]:
        """Return lower bounds of the errors of Doppler centroid (Hz) and velocity (m/s) for scenes
        of points; nothing for other scenes, whose energy is not known in advance.
        """
        truth, world, radar = batch.trials.truth, batch.trials.own, bench.radar
        std = truth["noise_std"]
        if (
            world.movers is not None
            or not all(isinstance(scene, (Points, RandomPoints)) for scene in world.scene.parts.values())
            or not (std > 0).all()
        ):
            return {}
        q = target_energy(Truth(truth), world, radar, bench.world().lines).sum(-1) / std.square()
        range_m = truth["closest_range_m"].mean(-1)
        seconds = radar.aperture_s(float(range_m.mean()))
        doppler = {
            "Cramer-Rao bound of a point of known position": tone_frequency_bound_hz(q, seconds),
            "1/(T sqrt q), Tsvetkov 2017": reference_doppler_std_hz(q, seconds),
        }
        velocity = velocity_bound_m_s(q, seconds, truth["velocity_m_s"].to(q), radar.wavelength_m, range_m)
        bounds = {"doppler_error_hz": doppler, "doppler_baseband_error_hz": doppler}
        return {**bounds, "velocity_error_m_s": {"Cramer-Rao bound": velocity}}

    def limits(self, bench: Bench) -> Mapping[Limit, Sequence[str]]:
        """Return the limits of focusing in a simulated scene, with the methods that each concerns.

        There are none for a recording, whose aperture the antenna beam has already determined.
        """
        if bench.recording is not None:
            return {}
        found = strip_limits(bench.radar, bench.world().samples, *probe_of(bench).motion)
        return {limit: list(bench.chains) for limit in found}

    def requirements(self, bench: Bench) -> Sequence[Requirement]:
        return probe_of(bench).rows()

    def choices(self, bench: Bench) -> Sequence[Choice]:
        return choices(bench, {row.effect: row for row in self.requirements(bench)})

    def position_of(self, result: Result, target: str) -> tuple[float, float]:
        """Return the expected azimuth and range (m) of a target in the recommended image."""
        trials, view = result.first.trials, result.first_of("recommended").judged.view
        azimuth, range_ = positions(result.bench.chains["recommended"], view, result.bench, trials)
        index = list(result.bench.world().named_points).index(target)
        return float(azimuth[0, index]), float(range_[0, index])

    def pictures(self, results: Mapping[str, Result]) -> Iterator[Callable[[], Drawn]]:
        yield from self.case_pictures(results)
        if len(results) > 1:
            yield partial(comparisons, results, self.columns, "clean")


SYSTEM = Stripmap
