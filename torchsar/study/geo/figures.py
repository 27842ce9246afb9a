"""The pictures of a run: azimuth profiles with false targets, main lobes, images, spectra, and
figures over targets.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchsar import plot
from torchsar.core import Axis, Signal
from torchsar.study.cases import word_of
from torchsar.study.geo.judge import NAMES, Found, Profiles, theory
from torchsar.study.geo.trials import Batch, Bench, Outcome
from torchsar.study.pictures import Drawn, Picture, draw_all

_NEAR_M, _SHOWN_DB = 12.0, -90.0
_ALONG_M, _ACROSS_M = 6.0, 20.0
Metrics = Mapping[str, Mapping[str, Tensor]]


@dataclass(frozen=True)
class Shot:
    """One target by one method, of the first trial: the clean image, its profile over x = (V_R -
    u_a) t of the target, and the rebuilt spectrum over Doppler from its centre.
    """

    image: Signal
    profile: Tensor
    along_m: Tensor
    spectrum: Signal


@dataclass(frozen=True)
class CaseResult:
    """One case: metrics (trial, target) by method; names of targets; what the methods found, by
    target and name with std and ok, and the truth, by trial; theory by target; and shots of the
    first trial by method and target.
    """

    metrics: Metrics
    targets: Sequence[str]
    found: Mapping[str, Mapping[str, Mapping[str, Any]]]
    truth: Mapping[str, Tensor]
    theory: Mapping[str, Mapping[str, float]]
    shots: Mapping[str, Mapping[str, Shot]]

    @staticmethod
    def of(bench: Bench, batch: Batch) -> CaseResult:
        """Of one batch of rows."""
        names = list(bench.echoes.targets)

        def table(values: Mapping[str, Tensor]) -> dict[str, Tensor]:
            return {key: value.reshape(-1, len(names)) for key, value in values.items()}

        metrics = {name: table(outcome.metrics) for name, outcome in batch.outcomes.items()}
        truth = {
            f"{target}.{key}": batch.truth[key].reshape(-1, len(names))[:, i]
            for key in (*NAMES, "range_m")
            for i, target in enumerate(names)
        }
        found = {name: _estimates(outcome, names, metrics[name]) for name, outcome in batch.outcomes.items()}
        shots = {
            name: _shots(bench, outcome, batch.truth, names)
            for name, outcome in batch.outcomes.items()
            if outcome.clean is not None
        }
        return CaseResult(metrics, names, found, truth, _theories(bench, batch, names), shots)

    @staticmethod
    def joined(parts: Sequence[CaseResult]) -> CaseResult:
        """All trials of a case, and the pictures of the first."""
        first = parts[0]
        metrics = {
            name: {key: torch.cat([part.metrics[name][key] for part in parts]) for key in of}
            for name, of in first.metrics.items()
        }
        found = {
            name: {
                key: {what: [x for part in parts for x in part.found[name][key][what]] for what in entry}
                for key, entry in of.items()
            }
            for name, of in first.found.items()
        }
        return replace(
            first,
            metrics=metrics,
            found=found,
            truth={key: torch.cat([part.truth[key] for part in parts]) for key in first.truth},
        )

    def by_target(self) -> dict[str, dict[str, dict[str, Tensor]]]:
        """Metrics (trial,) by target and method; what was not measured is left out."""
        rows = {
            target: {name: {key: value[:, i] for key, value in of.items()} for name, of in self.metrics.items()}
            for i, target in enumerate(self.targets)
        }
        return {
            target: {
                name: {k: v for k, v in of.items() if bool(torch.isfinite(v.double()).all())} for name, of in by.items()
            }
            for target, by in rows.items()
        }

    @property
    def images(self) -> dict[str, Signal]:
        return {f"{name}/{target}": shot.image for name, shots in self.shots.items() for target, shot in shots.items()}

    def truths(self) -> Mapping[str, Tensor]:
        return self.truth

    def estimates(self) -> dict[str, dict[str, Tensor]]:
        """Velocities by method and name."""
        return {
            name: {key: torch.tensor(entry["value"], dtype=torch.float64) for key, entry in values.items()}
            for name, values in self.found.items()
            if values
        }


def _estimates(outcome: Outcome, names: Sequence[str], metrics: Mapping[str, Tensor]) -> dict[str, dict[str, Any]]:
    """What metrics.json names of each target, with predicted deviation and verdict, lists over
    trials.
    """
    found = Found.by(outcome.trace.estimates)
    entries: dict[str, dict[str, Any]] = {}
    for i, target in enumerate(names):
        for key, value in found.value.items():
            listed = {
                what: x.reshape(-1, len(names))[:, i].tolist()
                for what, x in (("value", value), ("std", found.std[key]))
            }
            entries[f"{target}.{key}"] = {**listed, "ok": metrics["ok"][:, i].tolist()}
    return entries


def _theories(bench: Bench, batch: Batch, names: Sequence[str]) -> dict[str, dict[str, float]]:
    """Of the recommended method, where it makes an image."""
    focused = batch.outcomes["recommended"].focused
    if focused is None:
        return {}
    rows = {target: {key: float(batch.truth[key][i]) for key in NAMES} for i, target in enumerate(names)}
    return {
        target: theory(bench.echoes.radar, row, bench.echoes.integration_s, focused.processed_hz, bench.echoes.samples)
        for target, row in rows.items()
    }


def _shots(bench: Bench, outcome: Outcome, truth: Mapping[str, Tensor], names: Sequence[str]) -> dict[str, Shot]:
    """Every target of the first trial."""
    assert outcome.clean is not None and outcome.focused is not None
    radar, image = bench.echoes.radar, outcome.clean.signal
    along = radar.speed_m_s - truth["u_a_m_s"]
    cuts = Profiles.of(image, along, radar.speed_m_s)
    spectra = outcome.clean.outputs[outcome.focused.stage]
    number = torch.arange(image.axes[0].n, dtype=torch.float64)

    def shot(i: int) -> Shot:
        spectrum = spectra.data[i] if "range" not in spectra.names else spectra.data[i].abs().square().sum(-1).sqrt()
        return Shot(
            image.with_data(image.data[i]),
            cuts.azimuth[i],
            cuts.start_m[i] + cuts.step_m[i] * number,
            Signal(spectrum, spectra.axes[:1]),
        )

    return {target: shot(i) for i, target in enumerate(names)}


def draw(results: Mapping[str, CaseResult], folder: Path) -> list[Picture]:
    """Every picture of a run, as PNG files in the folder, in the order of reading."""
    by_case = [
        partial(make, case, result)
        for case, result in results.items()
        for make in (_profiles, _main_lobes, _contours, _spectra)
    ]
    return draw_all([partial(_comparison, results), *by_case], folder)


def _titled(title: str, case: str) -> str:
    return title if case == "all" else f"{title}: {case}"


def _pair(result: CaseResult) -> list[str]:
    """Methods that are drawn: the conventional one beside the recommended, or what there is of
    them.
    """
    first = [name for name in ("conventional", "recommended") if name in result.shots]
    return first or list(result.shots)[:2]


def _level(x: Tensor, top: float) -> np.ndarray:
    return np.maximum(plot.decibel(x, top), _SHOWN_DB)


def _profiles(case: str, result: CaseResult) -> Drawn:
    parts = []
    for target in result.targets if result.shots else ():
        shots = {name: result.shots[name][target] for name in _pair(result)}
        series = {
            name: (plot.array(shot.along_m), _level(shot.profile, float(shot.profile.abs().max())))
            for name, shot in shots.items()
        }
        parts.append(
            {
                "series": series,
                "xlabel": "x = (V_R - u_a) t (m)",
                "ylabel": "dB",
                "title": target,
                "ylim": (_SHOWN_DB, 3.0),
            }
        )
    if parts:
        caption = (
            "Azimuth profiles through the peak of clean images, each in dB of its own peak. "
            "False targets stand about 720 m a pulse rate from it at the parameters of the "
            "source; "
        )
        caption += (
            "the humps near 1330 m of a target cut by a gate are tails of its band, beyond the "
            "rebuilt one, folded back from the ends of the gate."
        )
        yield f"profiles_{word_of(case)}", _titled("False targets", case), caption, plot.panels(parts, columns=2)


def _main_lobes(case: str, result: CaseResult) -> Drawn:
    parts = []
    for target in result.targets if result.shots else ():
        series = {}
        for name, of in result.shots.items():
            shot = of[target]
            peak = float(shot.along_m[int(shot.profile.abs().argmax())])
            offset, level = _finer(shot)
            near = np.abs(offset - peak) <= _NEAR_M
            series[name] = (offset[near] - peak, level[near])
        parts.append(
            {"series": series, "xlabel": "x from the peak (m)", "ylabel": "dB", "title": target, "ylim": (-40.0, 3.0)}
        )
    if parts:
        yield (
            f"main_lobes_{word_of(case)}",
            _titled("Main lobes", case),
            "The same profiles about their peaks, by every method.",
            plot.panels(parts, columns=2),
        )


def _finer(shot: Shot) -> tuple[np.ndarray, np.ndarray]:
    """The profile eight times as finely sampled, dB of its peak."""
    n, factor = len(shot.profile), 8
    spectrum = torch.fft.fftshift(torch.fft.fft(shot.profile.to(torch.complex128)))
    before = (factor * n) // 2 - n // 2
    fine = torch.fft.ifft(torch.fft.ifftshift(torch.nn.functional.pad(spectrum, (before, (factor - 1) * n - before))))
    step = float(shot.along_m[1] - shot.along_m[0]) / factor
    return float(shot.along_m[0]) + step * np.arange(len(fine)), plot.decibel(fine)


def _contours(case: str, result: CaseResult) -> Drawn:
    """About the peaks of two-dimensional images."""
    chosen = {
        f"{target}, {name}": result.shots[name][target].image
        for target in result.targets
        for name in (_pair(result) if result.shots else ())
    }
    cut = {title: _about_peak(image) for title, image in chosen.items() if "range" in image.names}
    if cut:
        caption = (
            "About the peak of clean images, range on the axis c tau / 2; interpolated. "
            "Conventional images of fast targets are defocused and lie elsewhere."
        )
        yield f"contours_{word_of(case)}", _titled("Contours", case), caption, plot.contours(cut, columns=4)


def _about_peak(image: Signal) -> Signal:
    """The part about the peak, on a grid several times finer; offsets from the peak, range
    halved.
    """
    azimuth, across = image.axes
    row, line = divmod(int(image.data.abs().argmax()), across.n)
    finer = []
    for axis, place, reach in ((azimuth, row, _ALONG_M), (across, line, 2 * _ACROSS_M)):
        offset = torch.linspace(-reach, reach, 161, dtype=torch.float64)
        finer.append(
            (offset, torch.sinc((place + offset / axis.step)[:, None] - torch.arange(axis.n, dtype=torch.float64)))
        )
    data = finer[0][1].to(torch.complex128) @ image.data.to(torch.complex128) @ finer[1][1].mT.to(torch.complex128)
    axes = [
        Axis(name, 161, float(x[0]) * scale, float(x[1] - x[0]) * scale, "m")
        for name, (x, _), scale in zip(("azimuth", "range"), finer, (1.0, 0.5))
    ]
    return Signal(data, tuple(axes))


def _spectra(case: str, result: CaseResult) -> Drawn:
    parts = []
    for target in result.targets if result.shots else ():
        series = {}
        for name in _pair(result):
            spectrum = result.shots[name][target].spectrum
            series[name] = (plot.array(spectrum.axes[0].values()), np.maximum(plot.decibel(spectrum.data), -70.0))
        parts.append(
            {
                "series": series,
                "xlabel": "Doppler from the centre (Hz)",
                "ylabel": "dB",
                "title": target,
                "ylim": (-70.0, 3.0),
            }
        )
    if parts:
        caption = "Rebuilt Doppler spectra of clean echoes. Energy out of its band makes false targets."
        yield f"spectra_{word_of(case)}", _titled("Rebuilt spectra", case), caption, plot.panels(parts, columns=2)


_COMPARED = {
    "mfta_db": "largest false target (dB)",
    "u_r_error_m_s": "error of u_r (m/s)",
    "u_a_error_m_s": "error of u_a (m/s)",
    "position_error_m": "error of the place (m)",
}


def _comparison(results: Mapping[str, CaseResult]) -> Drawn:
    """Figures of all methods over targets."""
    for key, label in _COMPARED.items():
        rows = {
            (f"{case}/" if case != "all" else "") + target: by
            for case, result in results.items()
            for target, by in result.by_target().items()
        }
        names = list(dict.fromkeys(name for by in rows.values() for name, of in by.items() if key in of))
        if not names:
            continue
        level = {name: np.array([_typical(by[name].get(key), key) for by in rows.values()]) for name in names}
        part = {
            "title": "",
            "x": list(rows),
            "series": {name: (y, np.stack([y, y], -1)) for name, y in level.items()},
            "bounds": {},
        }
        said = "Mean" if key.endswith("_db") else "Root mean square"
        yield (
            key,
            label.split(" (")[0].capitalize(),
            f"{said} over trials, by target and method.",
            plot.error_curves([part], "", label, log_y=not key.endswith("_db")),
        )


def _typical(values: Tensor | None, key: str) -> float:
    """Mean of a level, root mean square of an error."""
    if values is None:
        return float("nan")
    return float(values.mean()) if key.endswith("_db") else float(values.square().mean().sqrt())
