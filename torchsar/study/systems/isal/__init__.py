"""Inverse synthetic aperture ladar with a phase error in every pulse (Ruan et al. 2013)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from torchsar.compensate import autofocus
from torchsar.core import Draws, Recording, Signal, Trace
from torchsar.echo.turntable import rotation_angle
from torchsar.focus import AzimuthTransform
from torchsar.focus.inverse_requirements import inverse_requirements
from torchsar.focus.requirements import Requirement
from torchsar.io import read_inverse
from torchsar.metrics import phase_rmse
from torchsar.radar import InverseRadar, geometry_of
from torchsar.scene import PhaseOnly, Sinusoid, displacement_m
from torchsar.study.names.factories import with_wavelength
from torchsar.study.names.registry import TARGET_IMPAIRMENTS
from torchsar.study.output.pictures import Drawn, comparisons
from torchsar.study.settings.errors import ConfigError
from torchsar.study.systems.isal import figures, judge
from torchsar.study.systems.isal.judge import received, whole_phase
from torchsar.study.systems.isal.world import Target, echo_choices
from torchsar.study.trials.batch import Judged, Result, Trials
from torchsar.study.trials.bench import Bench
from torchsar.study.trials.choice import Alternative, Choice, Measured, beside_direct_sum
from torchsar.study.trials.direct_images import DirectlySummed, turning_target
from torchsar.study.trials.system import Column, System

_GEOMETRY = ("frequency_hz", "angle_rad", "position_m", "reference_m")
# iterations of `autofocus` that are compared: its defaults, 120 and 20, and fewer
_EFFORTS = ((0, 5), (10, 5), (30, 10), (120, 10), (120, 20))


class Isal(System):
    """A rotating target with a phase error in every pulse."""

    name = "isal"
    about = "a rotating target with a phase error in every pulse, simulated or recorded range profiles"
    Radar = staticmethod(with_wavelength(InverseRadar))
    World = Target
    impairments = TARGET_IMPAIRMENTS
    reads = "range profile or phase history"
    ending = "azimuth_transform or target_image"
    tolerance = {"echo_error_db": -20.0, "image_error_db": -20.0, "residual_phase_rms_rad": 0.1}
    exact = {"world.fidelity": {"kind": "dechirped"}}
    definitions = {
        "snr": "mean power of all range-compressed samples over noise variance, dB",
        "entropy": "-sum p ln p, p = |I|^2 / sum |I|^2 over the whole image, nats",
        "entropy_above_ideal_nats": "entropy minus that of the error-free image of the same scene and noise; it "
        "varies by about 0.03 with the position of the image relative to the grid",
        "contrast": "standard deviation over mean of the intensity |I|^2",
        "residual_phase_rms_rad": "rms over the received pulses of the phase that all corrections remove minus "
        "the true phase, without its constant and linear terms",
        "residual_phase_std_rad": "standard deviation of the residual phase as predicted by the method",
        "strehl": "|mean exp(j residual)|^2 over pulses; 0.8 or more, about 0.47 rad rms, is a success",
        "entropy_above_clean_nats": "entropy minus that of the same method on the recording without the "
        "injected phases",
        "agreement_rad": "rms of (estimate - injected phase) minus the estimate on the recording without "
        "injected phases; 0 for a method that removes any phase error alike",
        "published": "values of Ruan et al. 2013, Table 1, minus the entropy of 7.2 nats that the paper implies "
        "for the error-free image",
    }
    columns = {
        "entropy_above_ideal_nats": Column("entropy above the ideal image", "nats", drawn="mean"),
        "entropy_above_clean_nats": Column("entropy above the method's own result without injected phases", "nats"),
        "residual_phase_rms_rad": Column("residual phase, rms", "rad", drawn="mean"),
        "agreement_rad": Column("influence of the injected phases, rms", "rad", drawn="mean"),
        "residual_phase_std_rad": Column("predicted residual phase, rms", "rad"),
        "strehl": Column("Strehl ratio"),
        "entropy_nats": Column("entropy", "nats"),
        "contrast": Column("contrast of the intensity"),
        "ok": Column("share of trials called reliable"),
        "seconds": Column("time of a trial", "s"),
    }

    def read(self, path: str, dtype: torch.dtype) -> Recording:
        return read_inverse(path, dtype)

    def context(self, recording: Recording) -> dict[str, Any]:
        known: dict[str, Any] = {name: recording.aux[name] for name in _GEOMETRY if name in recording.aux}
        return {"geometry": geometry_of(**known) if known else None}

    def samples(self, world: Target, radar: InverseRadar) -> int:
        return world.pulses * world.samples

    def simulate(self, bench: Bench, world: Target, draws: Draws) -> Trials:
        return world.trials_of(bench.radar, draws, bench.dtype, bench.device)

    bounds = staticmethod(judge.bounds)  # pyright: ignore[reportAssignmentType]

    def judge(self, bench: Bench, name: str, trace: Trace, trials: Trials, detail: bool) -> Judged:
        return judge.judge(bench, name, trace, trials)

    def requirements(self, bench: Bench) -> Sequence[Requirement]:
        if bench.recording is not None:
            raise ConfigError(
                f"{bench.file}: 'requires' needs the extent and the motion of the target, which are not known for a "
                "recording; use a config that simulates the echoes"
            )
        radar, world = bench.radar, bench.world()
        across, along = world.edge(bench.draws())
        time_s = torch.arange(4 * world.pulses, dtype=torch.float64) / (4 * radar.prf_hz)
        moved = displacement_m(world.motion, time_s)
        slope = torch.gradient(moved, spacing=(time_s,))[0]
        bend = torch.gradient(slope, spacing=(time_s,))[0]
        shaken = [(float(m.amplitude_m), float(m.frequency_hz)) for m in world.motion if isinstance(m, Sinusoid)]
        speeds = (0.0, 0.0) if shaken else (float(slope.abs().max()), float(bend.abs().max()))
        rate = None if world.rotation_rad_s is None else float(torch.as_tensor(world.rotation_rad_s).abs().max())
        size = (world.pulses, world.samples, 2 * max(across, 1e-9), 2 * max(along, 1e-9))
        return inverse_requirements(radar, *size, *speeds, shaken, rate)

    def choices(self, bench: Bench) -> Sequence[Choice]:
        if bench.recording is not None:
            raise ConfigError(
                f"{bench.file}: 'trade' needs the true phases, which are not known for a recording; "
                "use a config that simulates the echoes"
            )
        efforts = [Alternative(f"autofocus, search {s}, polish {p}", {"search": s, "polish": p}) for s, p in _EFFORTS]
        image = beside_direct_sum(partial(_summed, bench), "migration while the target turns")
        return [
            *echo_choices(bench),
            # without a rotation rate the image has no cross range
            *([] if bench.radar.rotation_rad_s is None else [image]),
            Choice("effort of autofocus", "autofocus.search", efforts, partial(_efforts, bench)),
        ]

    def pictures(self, results: Mapping[str, Result]) -> Iterator[Callable[[], Drawn]]:
        yield partial(figures.target, next(iter(results.values())))
        yield partial(comparisons, results, self.columns)
        for case, result in results.items():
            yield partial(figures.images, case, result)
            yield partial(figures.phases, case, result)


def _efforts(bench: Bench) -> Measured:
    """`autofocus` with fewer iterations, on trials with the echo model `phase_only`."""
    world, draws = bench.world(), bench.draws("trade", range(bench.config.trade.trials))
    trials = replace(world, fidelity=PhaseOnly()).trials_of(bench.radar, draws, bench.dtype, bench.device)
    data, truth, present = trials.recording.signal.data, whole_phase(trials), received(trials)

    def error(phase: Tensor) -> Tensor:
        return phase_rmse(phase, truth, present)

    best = error(autofocus(data, search=_EFFORTS[-1][0], polish=_EFFORTS[-1][1])["phase_rad"])

    def loss(one: Alternative, phase: Tensor) -> dict[str, float]:
        return {"residual_phase_rms_rad": float((error(phase) - best).max())}

    return Measured(lambda one: autofocus(data, **one.keys)["phase_rad"], loss)


def _summed(bench: Bench) -> DirectlySummed:
    """Image of white noise by the transform along the pulses."""
    world, radar = bench.world(), bench.radar
    axes = radar.raw_axes(world.pulses, world.samples)
    rate = radar.rotation_rad_s if world.rotation_rad_s is None else world.rotation_rad_s
    turning = float(torch.as_tensor(rate).reshape(-1)[0])
    angle = rotation_angle(radar, world.pulses, turning, torch.empty(()))
    # the axis has the scale of the assumed rate
    cross, image = radar.image_axes(axes)[0].values() * (radar.rotation_rad_s / turning), AzimuthTransform(radar)
    return turning_target(
        *(radar, angle, cross, 0.0, world.samples, bench.draws()),
        lambda noise: image(Signal(noise.to(bench.dtype), axes)).data,
    )


SYSTEM = Isal
