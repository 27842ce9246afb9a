"""Figures of a run as files, in the order of reading."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchsar import plot

Drawn = Iterator[tuple[str, str, str, Any]]


@dataclass(frozen=True)
class Picture:
    """A figure file and what a reader should see in it."""

    file: str
    title: str
    caption: str


def draw_all(makers: Iterable[Callable[[], Drawn]], folder: Path) -> list[Picture]:
    """Every picture that the makers have the material for, as PNG files in the folder.

    A maker yields (name, title, caption, figure).
    """
    folder.mkdir()
    pictures = []
    for make in makers:
        for name, title, caption, figure in make():
            file = f"{len(pictures) + 1:02d}_{name}.png"
            plot.save(figure, folder / file)
            pictures.append(Picture(file, title, caption))
    return pictures
