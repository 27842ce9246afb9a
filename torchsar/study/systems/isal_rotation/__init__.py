"""Inverse synthetic aperture ladar of a target with non-uniform rotation
(Remote Sens. 2025, 17, 3447).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchsar.core import Draws, Trace
from torchsar.focus import MatchedFourier
from torchsar.focus.requirements import Limit
from torchsar.metrics import contrast, entropy, rotation_bounds
from torchsar.radar import InverseRadar
from torchsar.scene import Points, PolynomialRotation, Scatterers, Scene, Together, TurntableWorld
from torchsar.study.names.registry import TARGET_IMPAIRMENTS, with_wavelength
from torchsar.study.systems.isal import Target
from torchsar.study.systems.isal import target as draw_target
from torchsar.study.systems.isal_rotation import choices
from torchsar.study.systems.isal_rotation.judge import (
    DRAW_CASE,
    CrossRangeCut,
    FoundRotation,
    cross_range_cut,
    k_scales,
    true_k,
)
from torchsar.study.trials import system
from torchsar.study.trials.batch import IMAGE, Batch, Judged, Processed, Trials
from torchsar.study.trials.bench import Bench
from torchsar.study.trials.system import Column, System, named_points


@dataclass(frozen=True)
class OneScene:
    """A random scene with its own seed, which is the same in every trial."""

    scene: Scene
    seed: int

    def scatterers(self, draws: Draws) -> Scatterers:
        return self.scene.scatterers(Draws(self.seed, source=draws.source))


@dataclass(frozen=True, kw_only=True)
class Rotating(Target):
    """Section `world`: the simulated target and its true parameters.

    Args:
        rotation: Rotation rate at the first pulse, and its time derivatives relative to that rate.
        centre_deviation_m: Range in metres from the centre of rotation to the zero of the range
            axis, yc.
        scene_seed: Seed of one scene for all trials, which then differ in noise alone; None for
            another scene in every trial.
    """

    rotation: PolynomialRotation
    centre_deviation_m: Tensor | float = 0.0
    scene_seed: int | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.rotation_rad_s is not None:
            raise ValueError(
                "world.rotation_rad_s, the rate of a uniform rotation, is not accepted here; give world.rotation alone"
            )
        if not bool((torch.as_tensor(self.rotation.omega_rad_s) > 0).all()):
            raise ValueError(
                f"world.rotation.omega_rad_s must be positive, got {self.rotation.omega_rad_s}; a "
                "negative rate would only mirror the image in cross range"
            )

    def of(self, radar: InverseRadar) -> TurntableWorld:
        self.rotation.refuse_turning_back(self.pulses / radar.prf_hz)
        scene: Scene = Together(self.scene)
        scene = scene if self.scene_seed is None else OneScene(scene, self.scene_seed)
        effects = (self.motion, self.start_phase, self.noise.snr_db, self.fidelity)
        return TurntableWorld(scene, None, *effects, self.rotation, self.centre_deviation_m)

    @property
    def named_points(self) -> dict[str, int]:
        """Names of the point targets, `part.number`, and their indices among all scatterers."""
        return named_points(self.scene, {Points: None})

    def noise_std(self, amplitude: Tensor) -> float:
        """Return the standard deviation of the noise in a sample; 0 without noise.

        The SNR is the total power of the scatterers, divided by the number of range cells, over the
        noise variance.

        Args:
            amplitude: Amplitudes of all scatterers.
        """
        snr_db = self.noise.snr_db
        if snr_db is None:
            return 0.0
        return math.sqrt(float(amplitude.abs().square().sum()) / self.samples) * 10 ** (-float(snr_db) / 20)


# limits that concern only methods that estimate the named value
_OF_ESTIMATORS = {"scatterers above the noise": "warp_k", "range term, pi lambda sigma_y / ra^2": "omega_rad_s"}


@dataclass(frozen=True, kw_only=True)
class Judging(system.Judging):
    """Settings of the metrics.

    Args:
        search_m: Largest distance in metres along cross range between the response of a point
            target and its true position.
        published_targets: Published values of point targets, by metric, target and method.
    """

    search_m: float = 0.1
    published_targets: Mapping[str, Mapping[str, Mapping[str, float]]] = field(default_factory=dict)


class View(NamedTuple):
    """Mean rotation rates (trial,) that scale the images of a method, and its cuts by target."""

    rate: Tensor
    cuts: Mapping[str, CrossRangeCut]


class IsalRotation(System):
    """A target with non-uniform rotation, which is estimated from its echoes."""

    name = "isal_rotation"
    about = "a target whose rotation rate changes during the record"
    Radar = staticmethod(with_wavelength(InverseRadar))
    World = Rotating
    Judging = Judging
    impairments = TARGET_IMPAIRMENTS
    ending = "matched_fourier"
    truths = ("omega_rad_s", "warp_k", "warp_k1", "yc_m")
    peak = 12.0
    tolerance = {"echo_error_db": -20.0, "image_error_db": -20.0, "peak_loss_db": 0.25, "k1_error_percent": 0.1}
    exact = {
        "world.fidelity": {"kind": "dechirped", "track_m": None},
        "uneven_rotation.order": {"order": 4},
        "matched_fourier.transform": {"transform": {"kind": "explicit_sum"}},
    }
    definitions = {
        "snr": "mean power of all range-compressed samples over noise variance, dB; the same before and after a "
        "unitary transform along range",
        "rotation": "theta = omega (t + k1 t^2 / 2! + k2 t^3 / 3! + ...), t = 0 at the first pulse: k1, k2 are "
        "the true derivatives of the rate over the rate at the first pulse",
        "mirror": "the data depend on omega^2 alone: omega is given as positive, and an image may be mirrored "
        "in cross range",
        "omega_error_percent": "estimated minus true rate at the first pulse, % of the truth",
        "k1_error_percent": "estimated minus true k1, % of the truth, or in 1/s (k1_error_per_s) if the truth is 0; "
        "likewise for k2 and higher orders",
        "yc_error_m": "estimated minus true range centre deviation yc: a scatterer at range y of the window "
        "rotates at range y + yc from the centre of rotation",
        "cross_range_scale_error_percent": "error of lengths in an image that is scaled by the mean rate that the "
        "method estimates, %; by radar.rotation_rad_s if it estimates none",
        "predicted": "omega_std_percent, k1_std_percent, yc_std_m, ...: standard deviations as predicted by the "
        "method, % of its estimate",
        "entropy_nats": "-sum p ln p, p = |I|^2 / sum |I|^2 over the whole image, nats; it grows with the number of "
        "image lines, by ln 2 from oversampling 1 to 2",
        "entropy_above_ideal_nats": "entropy minus that of the metrics.reference image of the same scene and noise",
        "contrast": "standard deviation over mean of the intensity |I|^2",
        "targets": "cut along cross range through the range cell of a point target, scaled by the rate "
        "that the method estimates, or by the true mean rate if it estimates none",
        "peak_db": "interpolated peak of the cut within metrics.search_m of the true position, relative to that of the "
        "reference",
        "irw_azimuth_m": "width between the first crossings of -3 dB beside the peak of the cut",
        "pslr_azimuth_db": "strongest response beyond the first minima beside the peak, over the peak",
        "evaluations": "number of evaluations of the objective by a search",
        "bounds": "Cramer-Rao bounds for known noise, and unknown complex amplitudes and cross ranges of "
        "resolved scatterers; overlapping scatterers raise them",
        "published": "values of Remote Sens. 2025, 17, 3447",
    }
    columns = {
        "omega_error_percent": Column("error of the rotation rate", "%", drawn="rms"),
        "k1_error_percent": Column("error of k1", "%", drawn="rms"),
        "k2_error_percent": Column("error of k2", "%", drawn="rms"),
        "entropy_nats": Column("entropy", "nats", drawn="mean"),
        "contrast": Column("contrast of the intensity"),
        "seconds": Column("time of a trial", "s"),
        "entropy_above_ideal_nats": Column("entropy above the ideal image", "nats"),
        "cross_range_scale_error_percent": Column("error of the cross-range scale", "%"),
        "k1_error_per_s": Column("error of k1, whose true value is 0", "1/s", drawn="rms"),
        "k2_error_per_s2": Column("error of k2, whose true value is 0", "1/s^2", drawn="rms"),
        "k3_error_per_s3": Column("error of k3, whose true value is 0", "1/s^3"),
        "yc_error_m": Column("error of the range centre deviation", "m"),
        "omega_std_percent": Column("predicted error of the rotation rate", "%"),
        "k1_std_percent": Column("predicted error of k1", "%"),
        "k2_std_percent": Column("predicted error of k2", "%"),
        "yc_std_m": Column("predicted error of the range centre deviation", "m"),
        "evaluations": Column("evaluations of the objective"),
        "ok": Column("share of trials called reliable"),
    }
    target_columns = {
        "peak_db": Column("peak relative to the ideal image", "dB"),
        "irw_azimuth_m": Column("width in cross range", "m"),
        "pslr_azimuth_db": Column("PSLR in cross range", "dB"),
    }

    settings = {"reference": "reference", "search_m": "search_m"}
    draw_first = (draw_target,)
    draw_case = DRAW_CASE

    def simulate(self, bench: Bench, world: Rotating, draws: Draws) -> Trials:
        made = world.trials_of(bench.radar, draws, bench.dtype, bench.device)
        made.truth["warp_k1"] = made.truth["warp_k"][..., :1]  # pyright: ignore[reportIndexIssue]
        return made

    def judge(self, bench: Bench, name: str, trace: Trace, trials: Trials, detail: bool) -> Judged:
        chain, truth, count = bench.chains[name], trials.truth, trials.count
        duration_s = bench.world().pulses / bench.radar.prf_hz
        found = FoundRotation.by(chain, trace.estimates)
        metrics = found.errors(truth, duration_s, bench.radar.rotation_rad_s)
        seen = [e.info["evaluations"].double() for e in trace.estimates.values() if "evaluations" in e.info]
        metrics |= {"evaluations": torch.stack([x.expand(count) for x in seen]).sum(0)} if seen else {}
        rate = _scale_rate(found, truth, duration_s, bench.radar.rotation_rad_s, count)
        if trace.signal.names != IMAGE:
            return Judged(metrics, view=View(rate, {}))
        metrics |= {"entropy_nats": entropy(trace.signal), "contrast": contrast(trace.signal)}
        named = bench.world().named_points if detail else {}
        cuts = {target: self._cut(bench, name, trace, truth, i, rate) for target, i in named.items()}
        shown = {target: cut for target, cut in cuts.items() if cut is not None}
        targets = {target: cut.figures for target, cut in shown.items()}
        return Judged(metrics, targets, [n for n in cuts if n not in shown], View(rate, shown))

    def _cut(
        self, bench: Bench, name: str, trace: Trace, truth: Mapping[str, Tensor], target: int, rate: Tensor
    ) -> CrossRangeCut | None:
        stages, image = bench.chains[name].stages.values(), trace.signal
        lines = [stage.oversampling for stage in stages if isinstance(stage, MatchedFourier)]
        x, y = (truth[key][..., target].expand(len(rate)) for key in ("cross_range_m", "range_m"))
        scale = bench.radar.wavelength_m / (2 * rate) if image.axes[0].unit == "Hz" else torch.ones_like(rate)
        flat = image.with_data(image.data.reshape(-1, *image.data.shape[-2:]).expand(len(rate), -1, -1))
        return cross_range_cut(flat, x, y, scale, bench.judging.search_m, 0.5 / lines[-1] if lines else 0.0)

    def compare(self, bench: Bench, outcome: Processed, ideal: Processed | None) -> Judged:
        judged, levels = super().compare(bench, outcome, ideal), {} if ideal is None else ideal.judged.targets
        targets = {}
        for target, row in judged.targets.items():
            level = levels[target]["peak"] if target in levels else torch.ones_like(row["peak"])
            peak = {"peak_db": 20 * torch.log10((row["peak"] / level).clamp_min(1e-15))}
            targets[target] = peak | {key: value for key, value in row.items() if key != "peak"}
        return Judged(judged.metrics, targets, judged.outside, judged.view)

    def bounds(self, bench: Bench, batch: Batch) -> dict[str, dict[str, Tensor]]:
        truth, std = batch.trials.truth, batch.trials.truth["noise_std"]
        if not bool((std > 0).all()):
            return {}
        radar, count = bench.radar, batch.trials.count
        scatterers = (truth["cross_range_m"], truth["range_m"], truth["amplitude"], std)
        known = {"wavelength_m": radar.wavelength_m, "prf_hz": radar.prf_hz, "n_pulse": bench.world().pulses}
        rotation = (truth["omega_rad_s"], truth["warp_k"], truth["yc_m"])
        bound = rotation_bounds(*scatterers, *rotation, **known, free_centre=_looks_for_centre(bench))
        found = {"omega_error_percent": bound["omega_rad_s"] * 100 / truth["omega_rad_s"]}
        for i, (_, value) in enumerate(((n, v) for n, v in bound.items() if n.startswith("k")), 1):
            found |= {name: value * scale for name, scale in k_scales(i, true_k(truth, i)).items()}
        found |= {"yc_error_m": bound["yc_m"]} if "yc_m" in bound else {}
        return {name: {"Cramer-Rao": value.expand(count)} for name, value in found.items()}

    def limits(self, bench: Bench) -> Mapping[Limit, Sequence[str]]:
        found: dict[Limit, Sequence[str]] = {}
        for limit in choices.limits(bench):
            value = _OF_ESTIMATORS.get(limit.name)
            provided = {n: [getattr(s, "provides", ()) for s in c.stages.values()] for n, c in bench.chains.items()}
            found[limit] = [n for n, values in provided.items() if value is None or any(value in x for x in values)]
        return found

    requirements = staticmethod(choices.requirements)  # pyright: ignore[reportAssignmentType]

    choices = staticmethod(choices.choices)  # pyright: ignore[reportAssignmentType]

    def notes(self, metrics: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
        """Yield notes for the report, as (title, text), about cases in which a wrong rotation gives
        an image with less entropy than the true rotation.
        """
        methods, reference = metrics["methods"], metrics["definitions"]["reference"]
        for case in methods[reference]["cases"] if reference else ():
            rows = {name: method["cases"][case] for name, method in methods.items()}
            trapped = [
                f"{name} ({row['entropy_above_ideal_nats']:.3f} nats, k1 {row['k1_error_percent']:.2g} % off)"
                for name, row in rows.items()
                if row.get("entropy_above_ideal_nats", 0.0) < -0.005 and abs(row.get("k1_error_percent", 0.0)) > 1.0
            ]
            if trapped:
                text = "On the grid of these images, wrong rotations give less entropy than the true one: "
                yield f"Misleading entropy, case {case}", f"{text}{', '.join(trapped)}. A finer grid prevents this."


def _scale_rate(
    found: FoundRotation, truth: Mapping[str, Tensor], duration_s: float, assumed: float | None, count: int
) -> Tensor:
    """Mean rotation rate (trial,) that scales images to metres: the estimated rate, or otherwise
    the assumed rate of the radar, or otherwise the true rate.
    """
    other = truth["rotation_rad_s"] if not assumed else torch.full_like(truth["rotation_rad_s"], assumed)
    own = found.rate(duration_s)
    return (other if own is None else torch.where(own > 0, own, other)).expand(count)


def _looks_for_centre(bench: Bench) -> bool:
    """True if any estimator of the config estimates the range centre deviation."""
    stages = (stage for chain in bench.chains.values() for stage in chain.stages.values())
    return any(getattr(s, "yc_m", 0.0) is None and "yc_m" in getattr(s, "provides", ()) for s in stages)


SYSTEM = IsalRotation
