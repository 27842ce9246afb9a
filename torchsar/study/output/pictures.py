"""Figures of a run as files, in the order of reading, and those that systems have in common."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchsar import plot
from torchsar.core import Signal

Drawn = Iterator[tuple[str, str, str, Any]]


@dataclass(frozen=True)
class Picture:
    """A figure file and what a reader should see in it."""

    file: str
    title: str
    caption: str


def draw_all(makers: Iterable[Callable[[], Drawn]], folder: Path) -> list[Picture]:
    """Every picture that the makers have the material for, as PNG files in a new folder.

    Args:
        makers: Each yields (name, title, caption, figure), or nothing.
        folder: Where to write.
    """
    folder.mkdir()
    pictures = []
    for make in makers:
        for name, title, caption, figure in make():
            file = f"{len(pictures) + 1:02d}_{name}.png"
            plot.save(figure, folder / file)
            pictures.append(Picture(file, title, caption))
    return pictures


def comparisons(results: Mapping[str, Any], columns: Mapping[str, Any], without: str = "ideal") -> Drawn:
    """Figures of all methods over cases, or over methods where there is one case.

    Args:
        results: By case, with `metrics` by method and name.
        columns: The figures; those with `drawn` are drawn.
        without: A method that is left out, being what the others are compared with.
    """
    for key, column in columns.items():
        rows = {
            case: {n: m[key] for n, m in r.metrics.items() if key in m and n != without} for case, r in results.items()
        }
        names = list(dict.fromkeys(name for row in rows.values() for name in row))
        if not column.drawn or not names:
            continue

        def level(values: Any, rms: bool = column.drawn == "rms") -> float:
            there = torch.empty(0) if values is None else values[torch.isfinite(values)]
            return float("nan") if not len(there) else float(there.square().mean().sqrt() if rms else there.mean())

        table = {name: np.array([level(row.get(name)) for row in rows.values()]) for name in names}
        x, series = list(rows), table
        if len(x) == 1:
            x, series = names, {"": np.array([table[name][0] for name in names])}
        if not np.isfinite(np.concatenate(list(series.values()))).any():
            continue
        drawn = {name: (y, np.stack([y, y], -1)) for name, y in series.items()}
        log = column.drawn == "rms" and any(bool((y > 0).any()) for y in series.values())
        label = f"{column.label} ({column.unit})" if column.unit else column.label
        said = "Root mean square" if column.drawn == "rms" else "Mean"
        part = {"title": "", "x": x, "series": drawn, "bounds": {}}
        figure = plot.error_curves([part], "", label, log_y=log)
        yield key, column.label[0].upper() + column.label[1:], f"{said} over trials of the {label}, by method.", figure


def first_named(images: Mapping[str, Signal], name: str = "ideal") -> dict[str, Signal]:
    """Images with that of one method in front, where there is one."""
    front = {name: images[name]} if name in images else {}
    return {**front, **images}


def within(signal: Signal, spans: Mapping[str, tuple[float, float]]) -> Signal:
    """The part of a signal between two positions on some axes, at least two samples of each."""
    cut = {}
    for axis in signal.axes:
        if axis.name in spans:
            first, last = (round(float(axis.index_of(edge))) for edge in spans[axis.name])
            first = min(max(first, 0), max(axis.n - 2, 0))
            cut[axis.name] = (first, min(max(last + 1, first + 2), axis.n))
    return signal.crop(**cut)
