"""Figures of the ocean simulation: steps of the processing, final images, and ships."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from torchsar import plot
from torchsar.core import Signal
from torchsar.multichannel import RemoveTransmitRange, StationaryImage
from torchsar.multichannel.reconstruct import LeastSquares
from torchsar.study.output.report import Drawn
from torchsar.study.systems.geo_ocean.judge import ImagePosition, MadeScene, ShownShip, at_rest
from torchsar.study.trials.batch import Result

# highest and lowest level (dB) of drawn scenes relative to the sea
_UP_DB, _DOWN_DB = 25.0, -10.0


def _made(result: Result) -> dict[str, MadeScene]:
    """Images of the first trial by every method."""
    return {n: outcome.judged.view.made[0] for n, outcome in result.first.outcomes.items() if not outcome.failed}


def _shown(result: Result) -> Mapping[str, ShownShip]:
    return result.first.trials.own[0].ships


def _true(shown: ShownShip) -> ImagePosition:
    return ImagePosition(float(shown.centre.y0_m), float(shown.centre.range_m))


def _over_sea(image: Signal) -> Signal:
    """Root mean square of blocks of pixels relative to the median block, limited to the drawn
    levels.
    """
    view = plot.quicklook(image, 300)
    level = view.data.abs().to(torch.float64)
    level = level / level.median().clamp_min(1e-300)
    return view.with_data(level.clamp(10 ** (_DOWN_DB / 20), 10 ** (_UP_DB / 20)).to(torch.complex64))


def _boxes(positions: Sequence[ImagePosition]) -> tuple[np.ndarray, np.ndarray]:
    """Outlines of +-60 m in range and +-120 m in azimuth around positions, as one broken line."""
    return plot.boxes([(p.range_m, p.azimuth_m) for p in positions], 60.0, 120.0)


def _marked(result: Result, title: str, image: Signal, apparent: bool) -> dict[str, Any]:
    """Image with outlines of ships.

    They mark true positions, and if `apparent` also positions and replicas in an image focused for
    a stationary scene.
    """
    ships = list(_shown(result).values())
    lines = {"true position": _boxes([_true(one) for one in ships])}
    if apparent:
        moving = [one for one in ships if one.ship.moves]
        lines["apparent position"] = _boxes([ImagePosition.of(one.centre) for one in moving])
        lines["false target"] = _boxes([one.replica for one in moving])
    return {"title": title, "signal": _over_sea(image), "lines": lines}


def _steps(result: Result) -> dict[str, Signal]:
    """Images after each step of the recommended method before the detection of ships.

    A step is a stage that changes the channels, from the removal of the transmit range on, because
    nothing is focused before. The last image is that of all channels. Before it is the image of a
    single channel, whose Doppler bands overlap.
    """
    chain, view = result.bench.chains["recommended"], result.first.outcomes["recommended"].judged.view
    stage, names = at_rest(chain), list(view.steps)
    first = next((i for i, name in enumerate(names) if isinstance(chain.stages[name], RemoveTransmitRange)), 0)
    images = {f"after {name}": stage(view.steps[name]) for name in names[first:-1]}
    middle = len(stage.radar.channel_m) // 2
    alone = StationaryImage(replace(stage.radar, channel_m=(0.0,)), LeastSquares(1), stage.form)
    images["one channel"] = alone(view.steps[names[-1]].isel(channel=slice(middle, middle + 1)))
    return images


def _flow(result: Result) -> Drawn:
    made = _made(result).get("recommended")
    if made is None:
        return
    steps = {**_steps(result), "everything at rest": made.conventional, "without moving ships": made.rest}
    parts = [_marked(result, title, image, True) for title, image in steps.items()]
    parts.append(_marked(result, "fused", made.fused, False))
    if made.targets is not None:
        found = {"found": _boxes([ImagePosition.of(target.motion) for target in made.targets if target.ok])}
        parts.insert(-2, {"title": "detected", "signal": _over_sea(made.conventional), "lines": found})
    caption = (
        "Root mean square of blocks; the scale ends 10 dB below the sea. What each stage leaves, focused as if "
        "everything were at rest: a single channel, whose Doppler bands overlap, and all channels, from which the "
        "bands are reconstructed. Ships with a radial velocity are displaced there and have false targets. Then the "
        "echoes of detected ships that move are subtracted, and every one is focused and inserted at its position."
    )
    yield "flow", "Steps of the recommended method", caption, plot.overlays(parts, _UP_DB - _DOWN_DB)


def _methods(result: Result) -> Drawn:
    parts = [_marked(result, name, made.fused, False) for name, made in _made(result).items()]
    if parts:
        caption = (
            "The final image of every method. The inverse of three bands amplifies false targets; setting the extent "
            "of moving ships to zero leaves holes in the sea."
        )
        figures = plot.overlays(parts, _UP_DB - _DOWN_DB)
        yield "methods", "Final images", caption, figures


def _ships(result: Result) -> Drawn:
    parts, made = [], _made(result)
    for name, shown in _shown(result).items():
        for method in (one for one in ("conventional", "recommended") if one in made):
            at = ImagePosition.of(shown.centre) if method == "conventional" else _true(shown)
            reach = zip(("azimuth", "range"), (at.azimuth_m, at.range_m), (150.0, 60.0), strict=True)
            spans = {axis: (middle - half, middle + half) for axis, middle, half in reach}
            parts.append({"title": f"{name}, {method}", "signal": plot.within(made[method].fused, spans), "lines": {}})
    if parts:
        caption = (
            "Each ship at its position in the image focused for a stationary scene (conventional) and at its "
            "true position (recommended), in dB relative to its own peak."
        )
        yield "ships", "Ships", caption, plot.overlays(parts)


DRAW_CASE = (_flow, _methods, _ships)
