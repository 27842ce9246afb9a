"""Inverse synthetic aperture ladar with a phase error in every pulse (Ruan et al. 2013)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Annotated, Any

import numpy as np
import torch
from torch import Tensor

from torchsar import plot
from torchsar.compensate import autofocus
from torchsar.core import Chain, Draws, Recording, Signal, Trace
from torchsar.echo import Impairment, Simulate
from torchsar.echo.turntable import rotation_angle
from torchsar.focus import AzimuthTransform, CompressDechirped, inverse_requirements
from torchsar.focus.requirements import Requirement
from torchsar.io import read_inverse
from torchsar.metrics import (
    contrast,
    entropy,
    error_db,
    phase_rmse,
    pulse_phase_bound_of_scene_rad,
    pulse_phase_bound_rad,
    residual_phase,
    strehl,
)
from torchsar.metrics.bounds import turntable_responses
from torchsar.metrics.image import rolled_to
from torchsar.radar import InverseRadar, geometry_of
from torchsar.scene import Dechirped, Motion, PhaseOnly, Points, Scene, Sinusoid, Together, TurntableWorld
from torchsar.scene.motion import PulsePhase, displacement_m
from torchsar.scene.turntable import Fidelity
from torchsar.study.names.registry import FIDELITIES, MOTIONS, SCENES, START_PHASES, TARGET_IMPAIRMENTS, with_wavelength
from torchsar.study.output.report import Drawn, first_named
from torchsar.study.settings.errors import ConfigError
from torchsar.study.trials.batch import IMAGE, Batch, Judged, Result, Trials, last_values, used_values
from torchsar.study.trials.bench import Bench
from torchsar.study.trials.choice import (
    Alternative,
    Choice,
    DirectlySummed,
    Measured,
    beside_direct_sum,
    turning_target,
)
from torchsar.study.trials.system import Column, Noise, System, World


@dataclass(frozen=True, kw_only=True)
class Target(World):
    """Section `world`: the simulated target and its true parameters.

    Args:
        pulses: Number of pulses of the record.
        samples: Number of range cells of each pulse.
        scene: Parts of the target by name, which rotate together.
        motion: Motions along the line of sight by name, which add up.
        start_phase: Random phase errors of the pulses by name, which add up.
        fidelity: Model of the echo.
        rotation_rad_s: True rotation rate in rad/s; None for the rate that the radar assumes.
        noise: Receiver noise; the SNR is the mean over all range-compressed samples.
        impairments: Impairments of the recording by name, in the order of their effect.
    """

    pulses: int
    samples: int
    scene: Mapping[str, Annotated[Scene, SCENES]]
    motion: Sequence[Annotated[Motion, MOTIONS]] = ()
    start_phase: Sequence[Annotated[PulsePhase, START_PHASES]] = ()
    fidelity: Annotated[Fidelity, FIDELITIES] = field(default_factory=PhaseOnly)
    rotation_rad_s: Tensor | float | None = None
    noise: Noise = field(default_factory=Noise)
    impairments: Mapping[str, Annotated[Impairment, TARGET_IMPAIRMENTS]] = field(default_factory=dict)

    least = {"pulses": 1, "samples": 1, "scene": 1}

    def of(self, radar: InverseRadar) -> TurntableWorld:
        """The parameters of the echo simulation."""
        scene, noise = Together(self.scene), self.noise.snr_db
        return TurntableWorld(scene, self.rotation_rad_s, self.motion, self.start_phase, noise, self.fidelity)

    def simulation(self, radar: InverseRadar, dtype: torch.dtype) -> Simulate:
        return Simulate(radar, self.of(radar), self.pulses, self.samples, dtype=dtype, impairments=self.impairments)

    def edge(self, draws: Draws) -> tuple[float, float]:
        """Return the largest magnitudes of cross range and range (m) of the scatterers."""
        scene = Together(self.scene).scatterers(draws)
        return tuple(float(x.abs().max()) for x in (scene.azimuth_m, scene.range_m))  # pyright: ignore[reportReturnType]


def echo_choices(bench: Bench) -> list[Choice]:
    """Return the choice of the echo model; nothing if the radar has no pulse length.

    The model `phase_only` changes the phases of range-compressed pulses; the model `dechirped`
    simulates dechirped pulses with the motion within each pulse.
    """
    world, radar = bench.world(), bench.radar
    if radar.pulse_s is None:
        return []
    edge = world.edge(bench.draws())
    lost = {"echo_error_db": PhaseOnly().neglected_db(radar, world.of(radar), world.pulses, *edge)}
    alternatives = [
        Alternative(
            "phase_only",
            {"kind": "phase_only"},
            lost,
            "migration, motion inside pulses",
            "fixed envelopes (phase_only)",
        ),
        Alternative("dechirped", {"kind": "dechirped"}, {}),
    ]

    def measured() -> Measured:
        own = world.fidelity if isinstance(world.fidelity, Dechirped) else Dechirped()
        levels = {"phase_only": PhaseOnly(), "dechirped": own}
        point = replace(
            world, scene={"edge": Points([edge[0]], [edge[1]])}, noise=Noise(), start_phase=(), impairments={}
        )
        # compression removes the mean velocity of the range that the receiver tracks
        compress = CompressDechirped(
            radar,
            velocity_m_s=sum(m.coefficients_m[0] for m in own.track) if own.track else None,  # pyright: ignore
        )

        def made(name: str, of: Any, dtype: torch.dtype) -> Tensor:
            signal = replace(of, fidelity=levels[name]).trials_of(radar, Draws(0), dtype).recording.signal
            return (compress(signal) if "fast_time" in signal.names else signal).data

        exact = made("dechirped", point, torch.complex128)

        return Measured(
            lambda one: made(one.keys["kind"], world, bench.dtype),
            lambda one, _: {"echo_error_db": float(error_db(made(one.keys["kind"], point, torch.complex128), exact))},
        )

    return [Choice("echo model", "world.fidelity", alternatives, measured)]


def whole_phase(trials: Trials) -> Tensor:
    """Return the true phase error of every pulse in rad, with impairments, (trial, pulse)."""
    phases = [value for name, value in trials.truth.items() if name == "phase_rad" or name.endswith(".phase_rad")]
    pulses = trials.recording.signal.data.shape[:-1]
    whole = torch.zeros(pulses, dtype=torch.float64, device=trials.recording.signal.data.device)
    return (whole + sum(phases)).reshape(trials.count, -1)


def received(trials: Trials) -> Tensor | None:
    """Pulses that were received, bool (trial, pulse); None if no impairment loses any."""
    lost = [value for name, value in trials.truth.items() if name.endswith(".present")]
    return torch.stack(lost).all(0).reshape(-1, lost[0].shape[-1]) if lost else None


def estimated_phase(chain: Chain, trace: Trace, like: Tensor) -> Tensor:
    """Return the phase in rad that a chain removes from each pulse, in the shape of `like`.

    It is the sum over all stages that correct a phase. If there is no such stage, it is the last
    estimate of a phase, or zero if there is none. Phases that are only initial values of another
    estimator do not count.
    """
    found = used_values(chain, trace, "phase_rad") or last_values(trace, "phase_rad")
    return sum((phase.reshape(like.shape) for phase in found), torch.zeros_like(like))


def _bound_ratio(bench: Bench) -> float | None:
    """Ratio of the bound for unknown amplitudes to that for a known scene, computed for one scene.
    It is None if the computation would take too long.
    """
    size, world, radar = bench.world(), bench.world().of(bench.radar), bench.radar
    scene = world.scene.scatterers(bench.draws("bound"))
    # the bound requires the inverse of a matrix; up to this size it takes about a second on one
    # core
    few = scene.amplitude.shape[-1] <= 1200 and 2 < size.pulses <= 800
    if not isinstance(world.fidelity, PhaseOnly) or not few:
        return None
    rate = float((radar.rotation_rad_s if world.rotation_rad_s is None else world.rotation_rad_s) or 0.0)
    azimuth, response = turntable_responses(radar, rate, scene.azimuth_m, scene.range_m, size.pulses, size.samples)
    power = ((azimuth * scene.amplitude) @ response).abs().square().mean()
    return float(
        pulse_phase_bound_of_scene_rad(azimuth, response, scene.amplitude, 1.0)
        / pulse_phase_bound_rad(power, size.samples, size.pulses)
    )


def target(result: Result) -> Drawn:
    """Draw the scatterers of a simulated target."""
    trials = result.first.trials
    if "cross_range_m" in trials.truth:
        along, across, amplitude = map(plot.array, trials.first("range_m", "cross_range_m", "amplitude"))
        caption = "Positions of the scatterers in the first trial. The area of a dot is proportional to the power."
        figure = plot.scatterers(along, across, np.abs(amplitude) ** 2, "range (m)", "cross range (m)")
        yield "target", "Target", caption, figure


def _images(result: Result) -> Drawn:
    """Draw the images of all methods, the ideal one first."""
    shown = first_named(result.images)
    reference, first = next(iter(shown.items()))
    trials, spans = result.first.trials, {}
    if "cross_range_m" in trials.truth:
        known = zip(("azimuth", "range"), trials.first("cross_range_m", "range_m"), strict=True)
        # a margin of 15 % of the extent about the scatterers
        spans = {axis: plot.span(at, 0.15 * float(at.max() - at.min())) for axis, at in known}
    caption = (
        f"The first trial, in dB: 0.1 % of the samples of '{reference}' exceed 0 dB, the same level for all methods. "
        "Every image is shifted to the position of the first one, because autofocus leaves its position open."
    )
    rolled = {name: plot.within(rolled_to(image, first), spans) for name, image in shown.items()}
    yield "images", "Images by every method", caption, plot.images(rolled, dynamic_range_db=35.0)


def _phases(result: Result, near_rad: float = 0.3) -> Drawn:
    """Draw the true phase errors and the residual phases. Residual phases with an rms below
    `near_rad` have a separate panel.
    """
    true = whole_phase(result.first.trials)[0].cpu()
    pulses = np.arange(true.numel())
    inside = torch.remainder(true + torch.pi, 2 * torch.pi) - torch.pi
    found = {name: outcome.judged.view for name, outcome in result.first.outcomes.items() if not outcome.failed}
    left = {n: residual_phase(phase[0].cpu(), true) for n, phase in found.items() if n not in ("none", "ideal")}
    shown = {"true phase error, wrapped": {"true": inside}}
    for title, near in ((f"residual phase below {near_rad} rad rms", True), ("residual phase, other methods", False)):
        kept = {n: x for n, x in left.items() if (float(x.square().mean().sqrt()) < near_rad) == near}
        if kept:
            shown[title if len(kept) > 1 else f"{title}: {next(iter(kept))}"] = kept
    parts = [
        {
            "series": {name: (pulses, plot.array(x)) for name, x in series.items()},
            "xlabel": "pulse",
            "ylabel": "phase (rad)",
            "title": title,
        }
        for title, series in shown.items()
    ]
    caption = (
        "The phase error of every pulse in the first trial, and estimate minus truth by method, without a constant and "
        "a linear phase, which do not change the focus. All phases are wrapped to the interval from -pi to pi."
    )
    yield "phases", "Phase errors", caption, plot.panels(parts)


# numbers of iterations of `autofocus` that are compared: its defaults, 120 and 20, and fewer
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

    draw_first = (target,)
    draw_case = (_images, _phases)
    read = staticmethod(read_inverse)  # pyright: ignore[reportAssignmentType]

    def context(self, recording: Recording) -> dict[str, Any]:
        names = ("frequency_hz", "angle_rad", "position_m", "reference_m")
        known: dict[str, Any] = {name: recording.aux[name] for name in names if name in recording.aux}
        return {"geometry": geometry_of(**known) if known else None}

    def judge(self, bench: Bench, name: str, trace: Trace, trials: Trials, detail: bool) -> Judged:
        """Return the metrics of the residual phase and of the image by one method.

        The field `view` of the result is the phase in rad that the method removes, (trial, pulse).
        """
        chain, clean = bench.chains[name], bench.config.processor[name].input == "clean"
        true, present = whole_phase(trials), received(trials)
        truth = torch.zeros_like(true) if clean else true
        found = estimated_phase(chain, trace, true)
        residual = residual_phase(found, truth, present)
        metrics = {"residual_phase_rms_rad": phase_rmse(found, truth, present), "strehl": strehl(residual, present)}
        for estimate in trace.estimates.values():
            if "phase_rad" in estimate.std:
                metrics["residual_phase_std_rad"] = estimate.std["phase_rad"].mean(-1)
        if trace.signal.names == IMAGE:
            metrics.update(entropy_nats=entropy(trace.signal), contrast=contrast(trace.signal))
        if bench.recording is not None:
            own = trace if clean else chain.trace(trials.clean)
            metrics["entropy_above_clean_nats"] = metrics["entropy_nats"] - entropy(own.signal)
            agreement = phase_rmse(found - truth, estimated_phase(chain, own, true), present)
            metrics["agreement_rad"] = agreement
        return Judged({key: x.double().expand(trials.count) for key, x in metrics.items()}, view=found)

    def bounds(self, bench: Bench, batch: Batch) -> dict[str, dict[str, Tensor]]:
        """Return lower bounds of the rms residual phase in rad, (trial,): one for a known scene,
        and one for unknown amplitudes of its scatterers. Both are without the constant and linear
        terms of the phase, as the residual phase is.

        The ratio of the second bound to the first is computed for a single scene of the case; it
        differs by about one percent between scenes.
        """
        std, data = batch.trials.truth["noise_std"], batch.trials.clean.signal.data
        if not bool((std > 0).all()):
            return {}
        power = (torch.view_as_real(data).double().square().sum(-1).mean((-2, -1)) - std.square()).clamp_min(1e-300)
        known = pulse_phase_bound_rad(power / std.square(), data.shape[-1], data.shape[-2])
        ratio = bench.memo("bound ratio", lambda: _bound_ratio(bench))
        free = {} if ratio is None else {"amplitudes unknown (Cramer-Rao)": known * ratio}
        return {"residual_phase_rms_rad": {"scene known": known, **free}}

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
            # without a rotation rate, the image has no cross range in metres
            *([] if bench.radar.rotation_rad_s is None else [image]),
            Choice("effort of autofocus", "autofocus.search", efforts, partial(_efforts, bench)),
        ]


def _efforts(bench: Bench) -> Measured:
    """Measure `autofocus` with fewer iterations, on trials with the echo model `phase_only`."""
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
    # the axis is scaled by the assumed rate
    cross, image = radar.image_axes(axes)[0].values() * (radar.rotation_rad_s / turning), AzimuthTransform(radar)
    return turning_target(
        *(radar, angle, cross, 0.0, world.samples, bench.draws()),
        lambda noise: image(Signal(noise.to(bench.dtype), axes)).data,
    )


SYSTEM = Isal
