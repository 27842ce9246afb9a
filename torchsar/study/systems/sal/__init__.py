"""Synthetic aperture ladar with a symmetric triangular sweep, whose radial motion is estimated from
every period (Remote Sens. 2024, 16, 793).
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated, Any

import torch
from torch import Tensor

from torchsar.compensate import SpectrumCorrelation
from torchsar.core import Trace
from torchsar.echo import Impairment, Simulate, simulate_ladar_record
from torchsar.metrics import (
    contrast,
    entropy,
    range_per_sweep_bound_m,
    velocity_free_offset_bound_m_s,
    velocity_known_offset_bound_m_s,
    velocity_segmented_bound_m_s,
)
from torchsar.radar import TriangularLadar
from torchsar.scene import (
    CalibrationFibre,
    LadarWorld,
    LinearInSweep,
    LogAmplitude,
    Motion,
    Points,
    RetroAndBrokenLine,
    Scene,
    Together,
)
from torchsar.scene.ladar import SweepError
from torchsar.scene.ladar_range import Fidelity
from torchsar.study.names.registry import (
    CALIBRATIONS,
    LADAR_IMPAIRMENTS,
    LOG_AMPLITUDES,
    RADIAL_MOTIONS,
    SCENES,
    SWEEP_ERRORS,
    SWEEP_FIDELITIES,
    group_of,
    with_wavelength,
)
from torchsar.study.settings.errors import ConfigError, did_you_mean
from torchsar.study.systems.sal import choices
from torchsar.study.systems.sal.judge import DRAW_CASE, course_of, target, target_responses
from torchsar.study.trials import system
from torchsar.study.trials.batch import IMAGE, Batch, Judged, Trials
from torchsar.study.trials.bench import Bench
from torchsar.study.trials.system import Column, Noise, System, World, named_points


@dataclass(frozen=True)
class Record:
    """A continuous record of the detector, cut into blocks, instead of separated sweeps.

    Args:
        trigger_s: Time from the start of a block to the start of an up sweep in seconds.
        block_s: Length of a block in seconds; null for one period of the sweep if every period is
            kept, and else for two periods.
        trigger_known: Whether the recording contains the time of the trigger.
    """

    trigger_s: Tensor | float = 0.0
    block_s: float | None = None
    trigger_known: bool = True


@dataclass(frozen=True, kw_only=True)
class Ground(World):
    """True scene, motion of the line of sight, atmosphere, laser and noise.

    Args:
        periods: Number of recorded periods of the sweep.
        scene: Scenes by name; their echoes add up.
        motion: Radial motions of the line of sight by name; they add up.
        log_amplitude: Scintillation of the atmosphere; null for none.
        fidelity: Model of how the range changes inside a sweep.
        gate_m: Least and largest relative range in metres that is recorded; null for all ranges.
        sweep_error: Phase error of the laser's sweeps; null for none.
        calibration: Internal fibre by which the sweep error can be measured; null for none.
        record: Continuous record of the detector; null for sweeps that are separated ideally.
        noise: Receiver noise; its snr_db is the power of a scatterer of amplitude 1 over that of
            the noise in a sample before any compression.
        impairments: Impairments of the recording by name, applied in this order.
    """

    least = {"periods": 1, "scene": 1}
    periods: int
    scene: Mapping[str, Annotated[Scene, SCENES]]
    motion: Sequence[Annotated[Motion, RADIAL_MOTIONS]] = ()
    log_amplitude: Annotated[LogAmplitude, LOG_AMPLITUDES] | None = None
    fidelity: Annotated[Fidelity, SWEEP_FIDELITIES] = field(default_factory=LinearInSweep)
    gate_m: Sequence[float] | None = None
    sweep_error: Annotated[SweepError, SWEEP_ERRORS] | None = None
    calibration: Annotated[CalibrationFibre, CALIBRATIONS] | None = None
    record: Record | None = None
    noise: Noise = field(default_factory=Noise)
    impairments: Mapping[str, Annotated[Impairment, LADAR_IMPAIRMENTS]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        snr_db = self.noise.snr_db
        if snr_db is not None and bool((torch.as_tensor(snr_db).abs() > 300).any()):
            raise ValueError(
                f"noise.snr_db is {snr_db}, outside the numerical range; give -300 to 300 dB, or null for no noise"
            )
        self.of()

    def of(self) -> LadarWorld:
        """The same world in the form of the echo simulation."""
        gate = None if self.gate_m is None else tuple(self.gate_m)
        scene, snr_db = Together(dict(self.scene)), self.noise.snr_db
        effects = (self.log_amplitude, snr_db, self.fidelity, gate, self.sweep_error, self.calibration)
        return LadarWorld(scene, self.motion, *effects)  # pyright: ignore[reportArgumentType]

    def simulation(self, radar: TriangularLadar, dtype: torch.dtype) -> Simulate:
        made = partial(Simulate, radar, self.of(), self.periods, dtype=dtype, impairments=self.impairments)
        return made() if self.record is None else made(by=simulate_ladar_record, **vars(self.record))

    @property
    def named_points(self) -> dict[str, int]:
        """Names `part.number` of the point targets and retro-reflectors whose responses are
        measured, and their indices among all scatterers.
        """
        return named_points(self.scene, {Points: None, RetroAndBrokenLine: 1})


log = logging.getLogger("torchsar")


@dataclass(frozen=True, kw_only=True)
class Judging(system.Judging):
    """Settings of the metrics.

    Args:
        target: Point target whose impulse response is measured and drawn; null for none.
        sidelobe_nulls: Distance from the peak up to which side lobes are measured, in null spacings
            of a rectangular band.
        search_m: Half width in metres of the search for a response about its predicted position.
    """

    target: str | None = None
    sidelobe_nulls: int = 10
    search_m: float = 0.02


class Sal(System):
    """Radial motion of a triangular-sweep ladar."""

    name = "sal"
    about = "synthetic aperture ladar with a triangular sweep, whose line of sight moves"
    Radar = staticmethod(with_wavelength(TriangularLadar))
    World = Ground
    Judging = Judging
    ending = "azimuth_matched_filter"
    tolerance = {"echo_error_db": -20.0, "image_error_db": -20.0, "velocity_rmse_m_s": 1e-4}
    exact = {"world.fidelity": {"kind": "every_sample", "without": []}}
    definitions = {
        "snr": "per sample before any compression, of a scatterer of amplitude 1 against the variance of the complex "
        "noise, dB",
        "velocity_rmse_m_s": "rms over periods with a lit scatterer (within 10 dB of the strongest) of the "
        "estimated minus the true radial velocity of the motion at the turning points, receding positive",
        "range_error": "estimated minus true motion at the middles of the up sweeps: integral of the velocity that was "
        "compensated plus lambda / (4 pi) times the phases that were removed from pulses, known modulo a turn "
        "and unwrapped along pulses against the truth",
        "range_error_max_m": "largest distance of the range error from its value at the first lit pulse, over "
        "lit pulses",
        "range_error_detrended_rms_m": "rms over lit pulses of the range error without constant and slope, "
        "which only turn and shift the image",
        "residual_phase_rms_rad": "4 pi / lambda times range_error_detrended_rms_m",
        "entropy_nats": "-sum p ln p, p = |I|^2 / sum |I|^2 over the whole image, nats",
        "entropy_above_ideal_nats": "entropy minus that of the same scene and noise without motion",
        "contrast": "standard deviation over mean of the AMPLITUDE |I|",
        "irw": "-3 dB width of the impulse response, m",
        "pslr": "strongest side lobe over the main lobe, dB",
        "islr": "energy of the side lobes over that of the main lobe (null to null), dB",
        "position": "responses are sought near the true position, shifted by the remaining motion: its "
        "mean velocity v shifts azimuth by v R / V and range by 2 v / (lambda K) beat hertz",
        "published": "values of Remote Sens. 2024, 16, 793; entropies depend on the size of the image and on the "
        "noise, so that only their order can be compared",
    }
    columns = {
        "residual_phase_rms_rad": Column("residual phase, rms without constant and slope", "rad", drawn="mean"),
        "pslr_azimuth_db": Column("PSLR in azimuth", "dB"),
        "irw_azimuth_m": Column("width in azimuth", "m"),
        "velocity_rmse_m_s": Column("velocity error, rms", "m/s", drawn="rms"),
        "entropy_above_ideal_nats": Column("entropy above the ideal image", "nats", drawn="mean"),
        "range_error_detrended_rms_m": Column("range error, rms without constant and slope", "m"),
        "range_error_max_m": Column("range error, largest", "m"),
        "islr_azimuth_db": Column("ISLR in azimuth", "dB"),
        "irw_range_m": Column("width in range", "m"),
        "pslr_range_db": Column("PSLR in range", "dB"),
        "islr_range_db": Column("ISLR in range", "dB"),
        "entropy_nats": Column("entropy", "nats"),
        "contrast": Column("contrast of the amplitude"),
        "targets_outside": Column("targets outside the image"),
        "ok": Column("share of trials called reliable"),
        "seconds": Column("time of a trial", "s"),
    }
    target_columns = {
        "irw_azimuth_m": Column("width in azimuth", "m"),
        "pslr_azimuth_db": Column("PSLR in azimuth", "dB"),
        "islr_azimuth_db": Column("ISLR in azimuth", "dB"),
        "irw_range_m": Column("width in range", "m"),
        "pslr_range_db": Column("PSLR in range", "dB"),
        "islr_range_db": Column("ISLR in range", "dB"),
    }

    settings = {"islr_extent_nulls": "sidelobe_nulls", "reference": "reference", "target": "target"}
    draw_first = (target,)
    draw_case = DRAW_CASE

    def samples(self, world: Ground, radar: TriangularLadar) -> int:
        per_period = 2 * radar.sweep_samples
        if world.record is not None:
            block = world.record.block_s or (1 if radar.keep_every == 1 else 2) * radar.period_s
            per_period = round(block * radar.sample_rate_hz)
        return world.periods * per_period

    def bytes_per_trial(self, bench: Bench) -> int:
        """Return the size in bytes of the largest tensor of a trial.

        This is the noise in double precision, or spectra that are upsampled over the whole band.
        """
        world, radar = bench.world(), bench.radar
        stages = [stage for chain in bench.chains.values() for stage in chain.stages.values()]
        wide = [s.upsampling for s in stages if isinstance(s, SpectrumCorrelation) and s.window_m is None]
        upsampled = max(wide, default=0) * radar.sweep_samples * world.periods
        return int(max(1.25 * self.samples(world, radar), upsampled) * torch.complex128.itemsize)

    def check(self, bench: Bench) -> None:
        world, target, file = bench.world(), bench.judging.target, bench.file
        if target is not None and target not in world.named_points:
            raise ConfigError(
                f"{file}: metrics.target names {target!r}, which is no point target of the "
                f"scene{did_you_mean(target, world.named_points)}"
            )
        for name, method in bench.config.processor.items():
            before: list[str] = []
            for key, entry in (method.stages or {}).items():
                stage, times = entry["stage"], before.count("deramp_azimuth")
                # these stages process deramped profiles, but cannot check whether their input is
                # deramped
                if (
                    stage in ("azimuth_matched_filter", "phase_polish")
                    and times != 1
                    and not any(group_of(other) == "own" for other in before)
                ):
                    raise ConfigError(
                        f"{file}: processor.{name}.stages.{key}: {stage} needs profiles that are deramped once, but "
                        f"{times} stages deramp_azimuth precede it; put one of them between compress_sweeps and {stage}"
                    )
                before.append(stage)
        if world.record is None and bench.radar.detection == "real":
            log.warning(
                "warning: %s: radar.detection is 'real', but separated sweeps are complex; give world.record "
                "for what a real detector records",
                file,
            )

    def judge(self, bench: Bench, name: str, trace: Trace, trials: Trials, detail: bool) -> Judged:
        clean, settings = bench.config.processor[name].input == "clean", bench.judging
        course = course_of(bench.chains[name], trace, trials.truth, bench.radar, clean)
        metrics = course.metrics(bench.radar)
        if trace.signal.names != IMAGE:
            return Judged(metrics, view=course)
        metrics |= {"entropy_nats": entropy(trace.signal), "contrast": contrast(trace.signal, of="amplitude")}
        truth, named = trials.truth, bench.world().named_points
        at = {
            t: tuple(truth[k][..., i].expand(trace.signal.trials) for k in ("azimuth_m", "range_m"))
            for t, i in named.items()
        }
        targets = target_responses(
            trace.signal,
            at,  # pyright: ignore[reportArgumentType]
            course,
            bench.radar,
            settings.sidelobe_nulls,
            settings.search_m,
        )
        shown = targets.get(settings.target or "", {})
        metrics |= {key: value for key, value in shown.items() if key.startswith(("irw", "pslr", "islr"))}
        return Judged(metrics, targets, [t for t in named if t not in targets], course)

    def bounds(self, bench: Bench, batch: Batch) -> dict[str, dict[str, Tensor]]:
        """Return lower bounds of the errors of velocity (m/s) and range (m) for a scene of one
        point; nothing for other scenes and without noise.
        """
        truth, radar, std = batch.trials.truth, bench.radar, batch.trials.truth["noise_std"]
        points = all(isinstance(scene, Points) for scene in bench.world().scene.values())
        if truth["range_m"].shape[-1] != 1 or not points or not bool((std > 0).all()):
            return {}
        snr = truth["amplitude"][..., 0].abs().square() / std.square()
        of_sweep = (snr, radar.sweep_samples, radar.wavelength_m)
        return {
            "velocity_rmse_m_s": {
                "segmented interference": velocity_segmented_bound_m_s(*of_sweep, radar.sweep_s),
                "unknown offsets": velocity_free_offset_bound_m_s(*of_sweep, radar.sweep_s),
                "known offset": velocity_known_offset_bound_m_s(*of_sweep, radar.sweep_s),
            },
            "range_error_detrended_rms_m": {"phase of one sweep": range_per_sweep_bound_m(*of_sweep)},
        }

    limits = staticmethod(choices.limits)  # pyright: ignore[reportAssignmentType]

    requirements = staticmethod(choices.requirements)  # pyright: ignore[reportAssignmentType]

    choices = staticmethod(choices.choices)  # pyright: ignore[reportAssignmentType]

    def notes(self, metrics: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
        """Yield notes for the report, as (title, text), about images with a large residual phase
        but less entropy than the ideal image.
        """
        methods, reference = metrics["methods"], metrics["definitions"]["reference"]
        for case, ideal in (methods[reference]["cases"] if reference else {}).items():
            rows = {name: method["cases"][case] for name, method in methods.items() if name != reference}
            least = ideal.get("entropy_nats", 0.0) - 0.02
            wrong = [
                f"{name} {row['entropy_nats']:.2f} nats with {row['residual_phase_rms_rad']:.3g} rad of residual phase"
                for name, row in rows.items()
                if row.get("entropy_nats", least) < least and row["residual_phase_rms_rad"] > 1.0
            ]
            if wrong:
                text = (
                    f"Some defocused images have less entropy than the ideal one ({ideal['entropy_nats']:.2f} nats): "
                    f"{', '.join(wrong)}. Compare methods by the residual phase, not by entropy alone."
                )
                yield f"Misleading entropy, case {case}", text


SYSTEM = Sal
