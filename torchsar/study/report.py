"""The report: one HTML file with its pictures inside, made only from metrics.json, the figures and
the resolved config.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import jinja2
import torch

from torchsar.study.pictures import Picture

_LABELS = {
    "targets_found": ("targets found", "", 0),
    "image_error_db": ("image error against the reference", "dB", 2),
    "image_correlation": ("image correlation with the reference", "", 5),
    "entropy_nats": ("entropy", "nats", 3),
    "contrast": ("contrast of the intensity", "", 2),
    "doppler_centroid_hz": ("Doppler centroid", "Hz", 2),
    "doppler_baseband_hz": ("Doppler centroid within one PRF", "Hz", 2),
    "squint_deg": ("squint", "deg", 4),
    "effective_velocity_m_s": ("effective velocity", "m/s", 2),
    "irw_azimuth_m": ("width in azimuth, median", "m", 3),
    "irw_range_m": ("width in range, median", "m", 3),
    "pslr_azimuth_db": ("PSLR in azimuth, median", "dB", 2),
    "pslr_range_db": ("PSLR in range, median", "dB", 2),
    "islr_azimuth_db": ("ISLR in azimuth, median", "dB", 2),
    "islr_range_db": ("ISLR in range, median", "dB", 2),
    "position_error_azimuth_rms_m": ("position error in azimuth, rms", "m", 3),
    "position_error_range_rms_m": ("position error in range, rms", "m", 3),
    "seconds": ("time of the chain", "s", 2),
}


def number(value: Any, digits: int = 4) -> str:
    """A number for reading; text passes, and what is missing is a dash."""
    if value is None:
        return "–"
    if isinstance(value, str):
        return value
    if isinstance(value, (list, tuple)):
        return ", ".join(number(v, digits) for v in value)
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int) or (float(value).is_integer() and abs(value) < 1e6):
        return f"{int(value)}"
    return f"{value:,.{digits}f}" if 1e-3 <= abs(value) < 1e7 else f"{value:.4g}"


def figure_table(metrics: Mapping[str, Any]) -> tuple[list[str], list[dict[str, Any]]]:
    """Column names (the methods, then 'published') and rows of text for every metric that any
    method has.
    """
    methods, published = metrics["methods"], metrics["published"]
    rows = []
    for key, (label, unit, digits) in _LABELS.items():
        if any(key in m["metrics"] for m in methods.values()):
            cells = [number(m["metrics"].get(key), digits) for m in methods.values()]
            rows.append(
                {
                    "label": label,
                    "unit": unit,
                    "cells": cells,
                    "published": number(published.get(key), digits) if key in published else "",
                }
            )
    return [*methods], rows


def _embedded(path: Path) -> str:
    return "data:image/png;base64," + base64.b64encode(path.read_bytes()).decode("ascii")


def installed_version() -> str:
    try:
        return version("torchsar-lab")
    except PackageNotFoundError:
        return "not installed"


def write_page(path: Path, template: str, pictures: Sequence[Picture], figures: Path, **fields: Any) -> None:
    """Write one HTML file with its pictures inside, which asks for nothing from outside.

    template: a file beside this module that extends base.html.j2. figures: the folder of the
    pictures. fields: what the template shows; the base itself shows `title`, `command`,
    `definitions` (name -> text) and `config` (text).
    """
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("torchsar.study", "."),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["number"] = number
    text = environment.get_template(template).render(
        pictures=[{"title": p.title, "caption": p.caption, "source": _embedded(figures / p.file)} for p in pictures],
        made=f"torchsar-lab {installed_version()}, torch {torch.__version__}, {datetime.now(UTC):%Y-%m-%d %H:%M} UTC",
        **fields,
    )
    path.write_text(text, encoding="utf-8")


def write_report(
    path: Path,
    title: str,
    metrics: Mapping[str, Any],
    pictures: Sequence[Picture],
    figures: Path,
    config_text: str,
    command: str,
) -> None:
    """Write the report of one run; it asks for nothing from outside."""
    columns, rows = figure_table(metrics)
    fields = {"metrics": metrics, "best": metrics["methods"]["recommended"], "columns": columns, "rows": rows}
    write_page(
        path,
        "report.html.j2",
        pictures,
        figures,
        title=title,
        command=command,
        definitions=metrics["definitions"],
        config=config_text,
        **fields,
    )
