"""The pictures of a run: range profiles and images of every case, the motion and what is left of
it, slices through a response.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from torchsar import plot
from torchsar.core import Axis, Signal
from torchsar.study.cases import word_of
from torchsar.study.cuts import impulse_cuts
from torchsar.study.pictures import Drawn, Picture, draw_all
from torchsar.study.sal.judge import Course
from torchsar.study.sal.trials import Batch, Bench
from torchsar.study.tracing import image_of

_MARGIN_M = 0.35
_COMPARED = {
    "residual_phase_rms_rad": "residual phase (rad rms)",
    "velocity_rmse_m_s": "velocity error (m/s rms)",
    "entropy_above_ideal_nats": "entropy above the ideal image (nats)",
}


Metrics = Mapping[str, Mapping[str, Tensor]]


@dataclass(frozen=True)
class CaseResult:
    """One case: metrics (trial,) by method, and of each point target; of the first trial images,
    profiles and courses by method, the truth, and the scatterers: azimuth and relative range (m),
    amplitude.
    """

    metrics: Metrics
    targets: Mapping[str, Metrics]
    images: Mapping[str, Signal]
    profiles: Mapping[str, Signal]
    courses: Mapping[str, Course]
    truth: Mapping[str, Tensor]
    scatterers: tuple[Tensor, Tensor, Tensor]
    target: str | None

    @staticmethod
    def of(
        bench: Bench, first: Batch, all_metrics: Sequence[Metrics], all_targets: Sequence[Mapping[str, Metrics]]
    ) -> CaseResult:
        """A case from its first batch, and the metrics and responses by method of all of them."""
        metrics = {name: _joined([part[name] for part in all_metrics]) for name in bench.chains}
        targets = {
            name: {key: _joined([part[name][key] for part in all_targets]) for key in first.outcomes[name].targets}
            for name in bench.chains
        }
        images = {name: image_of(outcome.last) for name, outcome in first.outcomes.items()}
        profiles = {
            name: image_of(outcome.profiles) for name, outcome in first.outcomes.items() if outcome.profiles is not None
        }
        courses = {name: _first_course(outcome.course) for name, outcome in first.outcomes.items()}
        values = {
            name: _first_row(first.truth.values[name])
            for name in ("velocity_m_s", "range_error_m", "azimuth_m", "range_m", "amplitude")
        }
        scatterers = values["azimuth_m"], values["range_m"], values["amplitude"]
        return CaseResult(metrics, targets, images, profiles, courses, values, scatterers, bench.config.metrics.target)

    def truths(self) -> Mapping[str, Tensor]:
        return self.truth

    def estimates(self) -> dict[str, dict[str, Tensor]]:
        """Velocities and range errors by method."""
        found = {
            name: {"range_error_m": course.error_m, "velocity_m_s": course.velocity_m_s}
            for name, course in self.courses.items()
        }
        return {
            name: {key: value for key, value in values.items() if value is not None} for name, values in found.items()
        }


def _joined(parts: Sequence[Mapping[str, Tensor]]) -> dict[str, Tensor]:
    return {key: torch.cat([part[key].reshape(-1) for part in parts]) for key in parts[0]}


def _first_row(x: Tensor) -> Tensor:
    return x.reshape(-1, x.shape[-1])[0]


def _first_course(course: Course) -> Course:
    parts = {key: getattr(course, key) for key in ("velocity_m_s", "velocity_error_m_s", "error_m", "coarse_m", "lit")}
    return replace(course, **{key: None if value is None else _first_row(value) for key, value in parts.items()})


def draw(results: Mapping[str, CaseResult], folder: Path) -> list[Picture]:
    """Every picture of a run, as PNG files in the folder, in the order of reading."""
    by_case = [
        partial(make, case, result)
        for case, result in results.items()
        for make in (_profiles, _images, _motion, _slices)
    ]
    return draw_all([partial(_target, next(iter(results.values()))), partial(_comparison, results), *by_case], folder)


def _titled(title: str, case: str) -> str:
    return title if case == "all" else f"{title}: {case}"


def _target(result: CaseResult) -> Drawn:
    along, range_, amplitude = (plot.array(v) for v in result.scatterers)
    caption = "Scatterers of the first scene, ranges relative to the reference; the area of a point is its power."
    yield (
        "target",
        "Target",
        caption,
        plot.places(range_, along, np.abs(amplitude) ** 2, "relative range (m)", "azimuth (m)"),
    )


def _comparison(results: Mapping[str, CaseResult]) -> Drawn:
    """What every method leaves, by case."""
    for key, label in _COMPARED.items():
        names = [
            name
            for name in next(iter(results.values())).metrics
            if name != "ideal" and any(key in result.metrics[name] for result in results.values())
        ]
        if not names:
            continue
        means = {name: np.array([_mean(result.metrics[name], key) for result in results.values()]) for name in names}
        parts = [
            {
                "title": "",
                "x": list(results),
                "series": {name: (y, np.stack([y, y], -1)) for name, y in means.items()},
                "bounds": {},
            }
        ]
        yield (
            key,
            label.split(" (")[0].capitalize(),
            f"Mean over trials of the {label}, by case and method.",
            plot.error_curves(parts, "case", label, log_y=_on_decades(key, means)),
        )


def _on_decades(key: str, means: Mapping[str, np.ndarray]) -> bool:
    """Errors stand on a logarithmic axis where there are any."""
    return key != "entropy_above_ideal_nats" and any(bool((mean > 0).any()) for mean in means.values())


def _mean(metrics: Mapping[str, Tensor], key: str) -> float:
    return float(metrics[key].mean()) if key in metrics else float("nan")


def _about_scene(signal: Signal, result: CaseResult, beyond_m: float = 0.0) -> Signal:
    """The ranges of the scatterers with a margin, farther beyond where motion moves beats."""
    axis, ranges = signal.axes[1], result.scatterers[1]
    low, high = float(ranges.min()) - _MARGIN_M, float(ranges.max()) + _MARGIN_M + beyond_m
    first, last = (int(np.clip(round(float(axis.index_of(edge))), 0, axis.n - 1)) for edge in (low, high))
    return signal.crop(range=(first, max(last, first + 1) + 1))


def _shown(signals: Mapping[str, Signal], result: CaseResult, beyond_m: float) -> dict[str, Signal]:
    first = "ideal" if "ideal" in signals else next(iter(signals))
    order = {first: signals[first], **{name: signal for name, signal in signals.items() if name != first}}
    return {name: _about_scene(signal, result, beyond_m) for name, signal in order.items()}


def _profiles(case: str, result: CaseResult) -> Drawn:
    caption = (
        "Range profiles of the up sweeps of the first trial, of methods that differ before "
        "any correction of pulse phases, in dB of the peak of the first panel. Motion moves "
        "the beat: 2 v / lambda."
    )
    signals = {
        name: _in_milliseconds(signal) for name, signal in _shown(_distinct(result.profiles), result, 0.3).items()
    }
    if signals:
        yield (
            f"profiles_{word_of(case)}",
            _titled("Range profiles over slow time", case),
            caption,
            plot.images(signals, dynamic_range_db=40.0, columns=3, percentile=100),
        )


def _distinct(signals: Mapping[str, Signal]) -> dict[str, Signal]:
    """The signals without those that an earlier method has as well."""
    kept: dict[str, Signal] = {}
    for name, signal in signals.items():
        if not any(
            other.data.shape == signal.data.shape and torch.equal(other.data, signal.data) for other in kept.values()
        ):
            kept[name] = signal
    return kept


def _in_milliseconds(signal: Signal) -> Signal:
    pulse = signal.axes[0]
    return Signal(signal.data, (Axis("slow time", pulse.n, 1e3 * pulse.start, 1e3 * pulse.step, "ms"), signal.axes[1]))


def _images(case: str, result: CaseResult) -> Drawn:
    caption = (
        "The first trial; all images on one scale, that of the first, in dB. A slope of the "
        "range error shifts an image along azimuth, which is no error of focus."
    )
    signals = _shown(result.images, result, 0.3)
    yield (
        f"images_{word_of(case)}",
        _titled("Images by every method", case),
        caption,
        plot.images(signals, dynamic_range_db=40.0, columns=3, percentile=100),
    )


def _motion(case: str, result: CaseResult) -> Drawn:
    """Velocity, its error, and the range error that is left, methods of like size together."""
    courses = {name: course for name, course in result.courses.items() if name != "ideal"}
    estimating = {name: course for name, course in courses.items() if course.velocity_m_s is not None}
    if not estimating:
        return
    pulse = next(iter(estimating.values())).pulse
    parts = [
        _panel(
            "radial velocity",
            "m/s",
            {"true": (pulse, result.truth["velocity_m_s"][: pulse.n]), **_worst_velocities(estimating)},
        )
    ]
    errors = {name: (c.pulse, 1e3 * _lit_only(c, c.velocity_error_m_s)) for name, c in estimating.items()}
    parts += _by_size("estimated minus true velocity", "mm/s", errors)
    left = {name: (c.pulse, 1e6 * _lit_only(c, c.detrended_m)) for name, c in courses.items()}
    parts += _by_size("range error left", "um", left)
    caption = (
        "Estimates of the first trial against the truth, methods of like error together; "
        "periods without a lit scatterer are left out. Range errors without constant and "
        "slope, "
        "which only turn and shift the image. A quarter of the wavelength is 0.39 um at 1.55 um."
    )
    yield (
        f"motion_{word_of(case)}",
        _titled("Motion and what is left of it", case),
        caption,
        plot.panels(parts, columns=2),
    )


Lines = Mapping[str, tuple[Axis, Tensor]]


def _lit_only(course: Course, x: Tensor | None) -> Tensor:
    assert x is not None
    return torch.where(course.lit, x, torch.nan)


def _worst_velocities(courses: Mapping[str, Course]) -> Lines:
    """Velocities of the two methods that err most, the others lying on the truth."""
    order = sorted(courses, key=lambda name: -float(courses[name].rms(courses[name].velocity_error_m_s)))  # pyright: ignore[reportArgumentType]
    return {name: (courses[name].pulse, _lit_only(courses[name], courses[name].velocity_m_s)) for name in order[:2]}


def _panel(title: str, unit: str, lines: Lines) -> dict[str, object]:
    return {
        "series": {name: (1e3 * plot.array(axis.values()), plot.array(y)) for name, (axis, y) in lines.items()},
        "xlabel": "slow time (ms)",
        "ylabel": unit,
        "title": title,
    }


def _by_size(title: str, unit: str, lines: Lines) -> list[dict[str, object]]:
    """Panels of up to four methods each whose largest values are alike, the smallest first."""
    size = {name: float(torch.nan_to_num(y).abs().max()) for name, (_, y) in lines.items()}
    groups: list[list[str]] = []
    for name in sorted(size, key=lambda name: size[name]):
        if groups and len(groups[-1]) < 4 and size[name] < 10 * max(size[groups[-1][0]], 1e-300):
            groups[-1].append(name)
        else:
            groups.append([name])
    return [
        _panel(
            title if len(group) > 1 else f"{title}: {group[0]}", unit, {name: lines[name] for name in reversed(group)}
        )
        for group in groups
    ]


def _slices(case: str, result: CaseResult) -> Drawn:
    """Cuts through the response of the target that metrics.target names, four methods a panel
    beside the ideal.
    """
    if result.target is None:
        return
    places = {
        name: result.targets[name][result.target] for name in result.images if result.target in result.targets[name]
    }
    cuts = {
        name: impulse_cuts(result.images[name], (float(f["position_azimuth_m"][0]), float(f["position_range_m"][0])))
        for name, f in places.items()
    }
    others = sorted(
        (name for name in cuts if name != "ideal"),
        key=lambda name: float(result.metrics[name]["residual_phase_rms_rad"][0]),
    )
    parts = []
    for first in range(0, len(others), 4):
        names = [*(["ideal"] if "ideal" in cuts else []), *others[first : first + 4]]
        for axis in ("azimuth", "range"):
            series = {
                name: (plot.array(cuts[name][axis][0]), plot.decibel(plot.array(cuts[name][axis][1]))) for name in names
            }
            parts.append(
                {
                    "series": series,
                    "xlabel": f"{axis} from the peak (m)",
                    "ylabel": "dB",
                    "title": axis,
                    "ylim": (-40.0, 2.0),
                }
            )
    caption = (
        "Slices through the strongest place near the predicted one; 0 dB is each curve's own "
        "peak. Methods by what they leave of the motion, the best first."
    )
    if parts:
        yield f"slices_{word_of(case)}", _titled(f"Response of {result.target}", case), caption, plot.panels(parts)
