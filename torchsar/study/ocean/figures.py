"""The pictures of a run: whole scenes as every method shows them, the recommended one step by step,
ships, and errors over ships.
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
from torchsar.core import Signal
from torchsar.multichannel.scene_image import SceneImage
from torchsar.study.cases import word_of
from torchsar.study.ocean.judge import Sight, shown_at
from torchsar.study.ocean.trials import Bench, Scene, stacked
from torchsar.study.pictures import Drawn, Picture, draw_all

_CHIP_M, _BOX_M = (150.0, 60.0), (120.0, 60.0)
_UP_DB, _DOWN_DB, _LARGEST = 25.0, -10.0, 900
NAMES = ("u_r_m_s", "u_a_m_s", "y0_m", "range_m")


@dataclass(frozen=True)
class CaseResult:
    """One case: metrics of ships (trial, ship) by method, of scenes (trial,); places of the truth
    and of what was found (trial, ship); what the first scene looks like.
    """

    metrics: Mapping[str, Mapping[str, Tensor]]
    whole: Mapping[str, Mapping[str, Tensor]]
    targets: Sequence[str]
    truth: Mapping[str, Tensor]
    found: Mapping[str, Mapping[str, Tensor]]
    sights: Mapping[str, Sight]
    made: Mapping[str, SceneImage]

    @staticmethod
    def of(bench: Bench, scene: Scene, pictured: bool) -> CaseResult:
        """Of one scene."""
        names = list(bench.ocean.ships)
        metrics = {
            way: {key: value[None] for key, value in stacked([dict(of.ships[name]) for name in names]).items()}
            for way, of in scene.judged.items()
        }
        whole = {way: stacked([dict(of.whole)]) for way, of in scene.judged.items()}
        truth = {
            key: torch.stack([getattr(scene.reference.ships[name].centre, key) for name in names])[None]
            for key in NAMES
        }
        found = {}
        for way, of in scene.judged.items():
            if bench.ways[way].estimates:
                found[way] = {
                    key: torch.tensor(
                        [[np.nan if body is None else float(getattr(body.motion, key)) for body in of.bodies.values()]],
                        dtype=torch.float64,
                    )
                    for key in NAMES
                }
        return CaseResult(metrics, whole, names, truth, found, scene.reference.ships, scene.made if pictured else {})

    @staticmethod
    def joined(parts: Sequence[CaseResult]) -> CaseResult:
        """All scenes of a case."""

        def cat(tables: list[Mapping[str, Mapping[str, Tensor]]]) -> dict[str, dict[str, Tensor]]:
            return {
                way: {key: torch.cat([table[way][key] for table in tables if key in table[way]]) for key in of}
                for way, of in tables[0].items()
            }

        first = parts[0]
        truth = {key: torch.cat([part.truth[key] for part in parts]) for key in first.truth}
        return replace(
            first,
            metrics=cat([p.metrics for p in parts]),
            whole=cat([p.whole for p in parts]),
            truth=truth,
            found=cat([p.found for p in parts]),
        )

    def measured(self, target: str | None = None) -> dict[str, dict[str, Tensor]]:
        """By method the finite metrics of one ship, or of all with those of scenes."""
        chosen = slice(None) if target is None else slice(self.targets.index(target), self.targets.index(target) + 1)
        rows = {
            way: {key: value[:, chosen][torch.isfinite(value[:, chosen])] for key, value in of.items()}
            for way, of in self.metrics.items()
        }
        of_scenes = self.whole if target is None else {way: {} for way in rows}
        return {
            way: {**{key: value for key, value in of.items() if len(value)}, **of_scenes[way]}
            for way, of in rows.items()
        }

    @property
    def images(self) -> dict[str, Signal]:
        return {
            f"{way}/{name}": getattr(made, name)
            for way, made in self.made.items()
            for name in (("fused", "rest") if made.bodies else ("fused",))
        }

    def truths(self) -> dict[str, Tensor]:
        """By ship and name, (trial,)."""
        return {
            f"{target}.{key}": value[:, i] for key, value in self.truth.items() for i, target in enumerate(self.targets)
        }

    def estimates(self) -> dict[str, dict[str, Tensor]]:
        """By method, then by ship and name, (trial,): NaN where a ship was not found."""
        return {
            way: {f"{target}.{key}": value[:, i] for key, value in of.items() for i, target in enumerate(self.targets)}
            for way, of in self.found.items()
        }


def draw(results: Mapping[str, CaseResult], folder: Path) -> list[Picture]:
    """Every picture of a run, as PNG files in the folder, in the order of reading."""
    by_case = [partial(make, case, result) for case, result in results.items() for make in (_flow, _methods, _chips)]
    return draw_all([*by_case, partial(_comparison, results)], folder)


def _titled(title: str, case: str) -> str:
    return title if case == "all" else f"{title}: {case}"


def _over_sea(image: Signal) -> Signal:
    """Root mean square over blocks, over that of the middling block, held to what the eye needs."""
    view = plot.quicklook(image, _LARGEST // 3)
    level = view.data.abs().to(torch.float64)
    level = level / level.median().clamp_min(1e-300)
    return view.with_data(level.clamp(10 ** (_DOWN_DB / 20), 10 ** (_UP_DB / 20)).to(torch.complex64))


def _box(azimuth_m: float, range_m: float) -> tuple[np.ndarray, np.ndarray]:
    """The outline of a window, as a line."""
    along, across = _BOX_M
    return range_m + across * np.array([-1, 1, 1, -1, -1]), azimuth_m + along * np.array([-1, -1, 1, 1, -1])


def _boxes(places: Sequence[tuple[float, float]]) -> tuple[np.ndarray, np.ndarray]:
    """Several outlines as one broken line."""
    parts = [np.append(np.stack(_box(*place)), [[np.nan], [np.nan]], 1) for place in places]
    both = np.concatenate(parts, 1) if parts else np.zeros((2, 0))
    return both[0], both[1]


def _marked(result: CaseResult, title: str, image: Signal, shown: bool) -> dict:
    """An image with outlines about true places, and about where an image of everything at rest
    shows ships and their replicas.
    """
    sights = list(result.sights.values())
    lines = {"true place": _boxes([(float(s.centre.y0_m), float(s.centre.range_m)) for s in sights])}
    if shown:
        moving = [s for s in sights if s.ship.moves]
        lines["shown at"] = _boxes([(p.azimuth_m, p.range_m) for p in (shown_at(s.centre) for s in moving)])
        lines["false target"] = _boxes([(s.replica.azimuth_m, s.replica.range_m) for s in moving])
    return {"title": title, "signal": _over_sea(image), "lines": lines}


def _flow(case: str, result: CaseResult) -> Drawn:
    made = result.made.get("recommended")
    if made is not None:
        parts = [
            _marked(result, title, image, title != "fused")
            for title, image in (
                ("everything at rest", made.conventional),
                ("without movers", made.rest),
                ("fused", made.fused),
            )
        ]
        caption = (
            "Azimuth (m, up) over range (m), root mean square over blocks, 35 dB. Left: "
            "everything focused as if at rest; closing ships appear beside their places, with "
            "false targets. "
        )
        caption += "Middle: the echo of what moves subtracted. Right: every mover put in its place."
        yield (
            f"flow_{word_of(case)}",
            _titled("The recommended flow", case),
            caption,
            plot.overlays(parts, 3, _UP_DB - _DOWN_DB),
        )


def _methods(case: str, result: CaseResult) -> Drawn:
    parts = [_marked(result, name, made.fused, False) for name, made in result.made.items()]
    if parts:
        caption = (
            "The final image of every method. The inverse of three bands lifts the floor of the "
            "whole scene; zeroing leaves holes in the sea."
        )
        yield (
            f"methods_{word_of(case)}",
            _titled("Final images", case),
            caption,
            plot.overlays(parts, 3, _UP_DB - _DOWN_DB),
        )


def _chips(case: str, result: CaseResult) -> Drawn:
    parts = []
    for name, sight in result.sights.items():
        for way in ("conventional", "recommended"):
            made = result.made.get(way)
            if made is not None:
                at = shown_at(sight.centre) if way == "conventional" else None
                place = (at.azimuth_m, at.range_m) if at else (float(sight.centre.y0_m), float(sight.centre.range_m))
                parts.append({"title": f"{name}, {way}", "signal": _cut(made.fused, place), "lines": {}})
    if parts:
        caption = (
            "Each ship where the image of everything at rest shows it (conventional) and in its "
            "place (recommended), in dB of its own peak."
        )
        yield f"ships_{word_of(case)}", _titled("Ships", case), caption, plot.overlays(parts, 2, 40.0)


def _cut(image: Signal, place: tuple[float, float]) -> Signal:
    """The part about a place."""
    axes, slices = [], []
    for axis, at, reach in zip(image.axes, place, _CHIP_M, strict=True):
        first = min(max(0, round((at - reach - axis.start) / axis.step)), axis.n - 2)
        last = max(first + 2, min(axis.n, round((at + reach - axis.start) / axis.step)))
        slices.append(slice(first, last))
        axes.append(replace(axis, n=last - first, start=axis.start + first * axis.step))
    return Signal(image.data[slices[0], slices[1]], tuple(axes))


_COMPARED = {
    "u_r_error_m_s": "error of u_r (m/s)",
    "u_a_error_m_s": "error of u_a (m/s)",
    "position_error_m": "error of the place (m)",
    "replica_db": "false target over the sea (dB)",
}
_COMPARED |= {"sea_error_db": "error of the sea (dB)", "contrast_db": "ship over the sea (dB)"}


def _comparison(results: Mapping[str, CaseResult]) -> Drawn:
    """Figures of all methods over ships."""
    for key, label in _COMPARED.items():
        rows = {
            (f"{case}/" if case != "all" else "") + target: result.measured(target)
            for case, result in results.items()
            for target in result.targets
        }
        rows = {target: by for target, by in rows.items() if any(key in of for of in by.values())}
        names = list(dict.fromkeys(way for by in rows.values() for way, of in by.items() if key in of))
        if not names:
            continue
        level = {way: np.array([_typical(by[way].get(key), key) for by in rows.values()]) for way in names}
        part = {
            "title": "",
            "x": list(rows),
            "series": {way: (y, np.stack([y, y], -1)) for way, y in level.items()},
            "bounds": {},
        }
        said = "Mean" if key.endswith("_db") else "Root mean square"
        yield (
            key,
            label.split(" (")[0].capitalize(),
            f"{said} over scenes, by ship and method.",
            plot.error_curves([part], "", label, log_y=not key.endswith("_db")),
        )


def _typical(values: Tensor | None, key: str) -> float:
    """Mean of a level, root mean square of an error."""
    if values is None:
        return float("nan")
    return float(values.mean()) if key.endswith("_db") else float(values.square().mean().sqrt())
