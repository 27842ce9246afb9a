"""Figures of a run as files, and those figures that every kind of experiment has."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchsar import plot
from torchsar.core import Signal

log = logging.getLogger("torchsar")
# ratio of the largest and the least value above which a comparison has a logarithmic axis
_DECADES = 100.0
Drawn = Iterator[tuple[str, str, str, Any]]


@dataclass(frozen=True)
class Picture:
    """Figure files that are shown side by side, with their title and caption."""

    files: tuple[str, ...]
    title: str
    caption: str


def draw_all(makers: Iterable[Callable[[], Drawn]], folder: Path) -> list[Picture]:
    """Draw pictures and write them as PNG files.

    Args:
        makers: Functions that yield pictures as (name, title, caption, figure); a list of figures
            is one picture with several panels, and an empty list gives no picture.
        folder: Folder of the files; it is made if it does not exist.

    Returns:
        The pictures in their order; one that cannot be drawn has no files, and a caption says why.
    """
    folder.mkdir(parents=True, exist_ok=True)
    pictures: list[Picture] = []
    for name, title, caption, drawn in (one for make in makers for one in _drawn(make)):
        stem = f"{len(pictures) + 1:02d}_{re.sub(r'[^A-Za-z0-9_.-]+', '_', name)[:80]}"
        panels = drawn if isinstance(drawn, list) else [drawn] * (drawn is not None)
        files = tuple(f"{stem}_{i}.png" if len(panels) > 1 else f"{stem}.png" for i in range(1, len(panels) + 1))
        for file, figure in zip(files, panels, strict=True):
            plot.save(figure, folder / file)
        if files or drawn is None:
            pictures.append(Picture(files, title[:1].upper() + title[1:], caption))
    return pictures


def _drawn(make: Callable[[], Drawn]) -> Drawn:
    """The pictures of one function, the last of which may say that the next one failed."""
    try:
        yield from make()
    except OSError:  # of the disk
        raise
    except Exception as error:  # results are more important than their pictures
        text = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
        log.warning("warning: a picture could not be drawn (%s)", text)
        yield "failed", "a picture is missing", f"It could not be drawn ({text}). All numbers are in the tables.", None


def comparisons(results: Mapping[str, Any], columns: Mapping[str, Any], without: str = "ideal") -> Drawn:
    """Yield a picture of each metric over the cases, or over the methods if there is one case.

    Args:
        results: Results by case, with `metrics` by method and name.
        columns: Presentation of the metrics; those with `drawn` are drawn.
        without: The reference method, which is not drawn.
    """
    for key, column in columns.items():
        rows = {
            case: {n: m[key] for n, m in r.metrics.items() if key in m and n != without} for case, r in results.items()
        }
        names = list(dict.fromkeys(name for row in rows.values() for name in row))
        if not column.drawn or sum(map(len, rows.values())) < 2:
            continue

        def mean(values: Any, rms: bool = column.drawn == "rms") -> float:
            there = torch.empty(0) if values is None else values[torch.isfinite(values)]
            return float("nan") if not len(there) else float(there.square().mean().sqrt() if rms else there.mean())

        table = {name: np.array([mean(row.get(name)) for row in rows.values()]) for name in names}
        x, series = list(rows), table
        if len(x) == 1:
            x, series = names, {"": np.array([table[name][0] for name in names])}
        drawn = {name: (y, np.stack([y, y], -1)) for name, y in series.items()}
        known = np.concatenate([y[np.isfinite(y)] for y in series.values()])
        log = len(known) > 0 and known.min() > 0 and (column.drawn == "rms" or known.max() > _DECADES * known.min())
        label = f"{column.label} ({column.unit})" if column.unit else column.label
        statistic = "Root mean square" if column.drawn == "rms" else "Mean"
        figures = plot.error_curves([{"title": "", "x": x, "series": drawn, "bounds": {}}], "", label, log_y=log)
        by = f"of the method '{names[0]}'" if len(names) == 1 else "by method"
        yield key, column.label, f"{statistic} over trials of the {label}, {by}.", figures


def first_named(images: Mapping[str, Signal], name: str = "ideal") -> dict[str, Signal]:
    """Return images by method, with that of the method `name` moved to the front if it exists."""
    front = {name: images[name]} if name in images else {}
    return {**front, **images}
