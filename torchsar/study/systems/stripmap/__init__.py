"""Continuous stripmap, from impaired raw data to a focused image (Tsvetkov 2017)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from torchsar.core import Draws, Recording, Truth
from torchsar.echo import target_energy
from torchsar.focus.ladar_requirements import Limit
from torchsar.focus.requirements import Requirement
from torchsar.focus.strip_limits import strip_limits
from torchsar.io import read_stripmap
from torchsar.metrics.bounds import reference_doppler_std_hz, tone_frequency_bound_hz, velocity_bound_m_s
from torchsar.radar import StripmapRadar
from torchsar.scene import Points, RandomPoints
from torchsar.study.names.factories import with_wavelength
from torchsar.study.names.registry import IMPAIRMENTS
from torchsar.study.output.pictures import Drawn
from torchsar.study.settings.errors import ConfigError
from torchsar.study.settings.sections import Loaded
from torchsar.study.systems.stripmap import figures, judge
from torchsar.study.systems.stripmap.choices import choices, probe_of
from torchsar.study.systems.stripmap.world import Strip
from torchsar.study.trials.batch import Batch, Result, Trials
from torchsar.study.trials.bench import Bench
from torchsar.study.trials.choice import Choice
from torchsar.study.trials.system import Column, System


class Stripmap(System):
    """Side-looking radar on a straight path."""

    name = "stripmap"
    about = "side-looking radar on a straight path, simulated or recorded raw data"
    Radar = staticmethod(with_wavelength(StripmapRadar))
    World = Strip
    Judging = judge.Judging
    impairments = IMPAIRMENTS
    reads = "raw stripmap"
    ending = "a focusing stage"
    truths = ("doppler_hz", "velocity_m_s")
    # the address of draws without a batch, so that the results of earlier versions are reproduced
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

    def read(self, path: str, dtype: torch.dtype) -> Recording:
        return read_stripmap(path, dtype)

    def samples(self, world: Strip, radar: StripmapRadar) -> int:
        return world.lines * world.samples

    def simulate(self, bench: Bench, world: Strip, draws: Draws) -> Trials:
        return world.trials_of(bench.radar, draws, bench.dtype, bench.device)

    compare = staticmethod(judge.compare)  # pyright: ignore[reportAssignmentType]
    judge = staticmethod(judge.judge)  # pyright: ignore[reportAssignmentType]

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
            not all(isinstance(scene, (Points, RandomPoints)) for scene in world.scene.parts.values())
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
        azimuth, range_ = judge.positions(result.bench.chains["recommended"], view, result.bench, trials)
        index = list(result.bench.world().named_points).index(target)
        return float(azimuth[0, index]), float(range_[0, index])

    def pictures(self, results: Mapping[str, Result]) -> Iterator[Callable[[], Drawn]]:
        return figures.pictures(results, self.columns)

    def extra_definitions(self, bench: Bench) -> Mapping[str, Any]:
        return {"islr_extent_nulls": bench.judging.sidelobe_nulls, "reference": bench.judging.reference}


SYSTEM = Stripmap
