"""`torchsar trade` for targets that turn unevenly: time against accuracy of model orders, gridding,
estimators and precisions.
"""

from __future__ import annotations

import logging
import math
import statistics
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchsar import plot
from torchsar.compensate.rotation import (
    ImageEntropy,
    coarse_rotation,
    descend_rotation,
    genetic_rotation,
    phase_fit_rotation,
    uneven_rotation,
)
from torchsar.core import Draws, Estimate, Truth
from torchsar.core.warp import k_of_shape, shape_of
from torchsar.focus.matched_fourier import matched_fourier, range_phase
from torchsar.metrics import entropy, error_db
from torchsar.study.config import Loaded
from torchsar.study.rotation.build import Turntable, check
from torchsar.study.rotation.sections import Trade
from torchsar.study.rotation.trials import true_k
from torchsar.study.trading import Tables, timed, traded

log = logging.getLogger("torchsar")
_YARDSTICK_EPS = 1e-12
_EXPLICIT_SAMPLES = 3e8  # pulses * lines * range cells, up to which the sum itself is the yardstick


@dataclass(frozen=True)
class Row:
    """One alternative: median seconds a trial over the repeats and their spread; entropy (nats),
    and its difference from the yardstick's; difference of the image from the yardstick's (dB); rms
    errors over trials (%) of the rate, k1 and k2 (of a true k of 0 in 1/s and 1/s^2). None where it
    has none.
    """

    name: str
    seconds: float
    spread_s: float
    entropy_nats: float | None = None
    entropy_error_nats: float | None = None
    image_error_db: float | None = None
    omega_error_percent: float | None = None
    k1_error_percent: float | None = None
    k2_error_percent: float | None = None


def trade(loaded: Loaded, out: Path | None) -> str:
    """Tables of orders of the warp, of the gridding knob, of estimators and of precisions on the
    first case of a config; returns them as text.

    Orders and gridding form images with the true rotation; phase errors of pulses are left out of
    all of them. With `out`: config.yaml, trade.json, trade.txt and figures/ in that folder.
    """
    return traded(loaded, out, check, _tables, _TITLES, _COLUMNS, _figures)


@torch.no_grad()
def _tables(loaded: Loaded) -> dict[str, list[Row]]:
    made = _Trials.of(loaded)
    return {
        "order": list(made.orders()),
        "gridding": list(made.griddings()),
        "estimators": list(made.estimators()),
        "precision": list(made.precisions()),
    }


@dataclass(frozen=True)
class _Trials:
    """Simulated trials in double precision, and what is to be compared on them.

    yc_m: what estimators are told, None where the recommended one of the config looks for it.
    """

    table: Turntable
    settings: Trade
    data: Tensor
    range_m: Tensor
    truth: Truth
    yc_m: float | None
    dtype: torch.dtype

    @staticmethod
    def of(loaded: Loaded) -> _Trials:
        table, settings = Turntable.of(loaded), loaded.config.trade
        _, truth = table.recorded(Draws(loaded.config.seed, "trade", range(settings.trials)), dtype=torch.complex128)
        assert truth.clean is not None
        signal = truth.clean.signal
        if signal.names != ("pulse", "range"):
            raise ValueError("trade compares range-compressed pulses; choose the fidelity phase_only")
        stages = (loaded.config.processor["recommended"].stages or {}).values()
        given = next((entry for entry in stages if str(entry["stage"]).startswith("rotation")), {})
        return _Trials(
            table, settings, signal.data, signal.axis("range").values(), truth, given.get("yc_m"), table.dtype
        )

    @property
    def prf_hz(self) -> float:
        return self.table.radar.prf_hz

    @property
    def _told(self) -> dict[str, Any]:
        return {"wavelength_m": self.table.radar.wavelength_m, "prf_hz": self.prf_hz, "range_m": self.range_m}

    def _timed(self, work: Callable[[], Any]) -> tuple[Any, dict[str, float]]:
        result, times = timed(work, self.settings.repeats)
        count = len(self.data)
        return result, {"seconds": statistics.median(times) / count, "spread_s": (max(times) - min(times)) / count}

    def _compensated(self, data: Tensor, k: Tensor) -> Tensor:
        """Data without the true range term, of the true warp or of its parts."""
        v = self.truth.values
        return range_phase(
            data, self.range_m, self.table.radar.wavelength_m, self.prf_hz, v["omega_rad_s"], k, v["yc_m"]
        )

    def orders(self) -> Iterator[Row]:
        """Images by the true warp cut to each order, without and with the range term."""
        true, data = self.truth.values["warp_k"], self.data.to(self.dtype)
        for two_dimensional in (False, True):
            for order in self.settings.orders:
                k = _cut(true, order, self.table.duration_s)

                def image(k: Tensor = k, flat: bool = not two_dimensional) -> Tensor:
                    return matched_fourier(data if flat else self._compensated(data, k), k, self.prf_hz)

                made, seconds = self._timed(image)
                row = Row(
                    f"order {order}, {'azimuth and range' if two_dimensional else 'azimuth only'}",
                    entropy_nats=float(entropy(made).mean()),
                    **seconds,
                )
                log.info("%s: %.3f nats", row.name, row.entropy_nats)
                yield row

    def griddings(self) -> Iterator[Row]:
        """The matched Fourier transform by kernels and precisions against the sum itself, or where
        that would take long against gridding to 1e-12.
        """
        k, lines = self.truth.values["warp_k"], self.settings.lines or 2 * self.table.pulses
        exact = self._compensated(self.data, k)
        grid = {"oversampling": lines / self.table.pulses} if self.settings.lines is None else {"lines": lines}
        explicit = self.data.numel() * lines <= _EXPLICIT_SAMPLES
        choice: dict[str, Any] = (
            {"method": "explicit"} if explicit else {"eps": _YARDSTICK_EPS, "kernel_oversampling": 2.0}
        )
        truth, seconds = self._timed(lambda: matched_fourier(exact, k, self.prf_hz, **grid, **choice))
        yield Row(
            "the sum itself" if explicit else "gridding to 1e-12",
            entropy_nats=float(entropy(truth).mean()),
            entropy_error_nats=0.0,
            image_error_db=-math.inf,
            **seconds,
        )
        for precision in self.settings.precisions:
            data = exact.to(getattr(torch, precision))
            for finer in self.settings.kernel_oversamplings:
                for taps in self.settings.taps:
                    work = partial(matched_fourier, data, k, self.prf_hz, taps=taps, kernel_oversampling=finer, **grid)
                    yield self._gridded(f"{taps} taps, grid x{finer:g}, {precision}", work, truth)
            for method in ("spline", "linear"):
                yield self._gridded(
                    f"{method} interpolation, {precision}",
                    partial(matched_fourier, data, k, self.prf_hz, method=method, **grid),
                    truth,
                )

    def _gridded(self, name: str, work: Callable[[], Tensor], truth: Tensor) -> Row:
        image, seconds = self._timed(work)
        off = entropy(image.to(torch.complex128)) - entropy(truth)
        return Row(
            name,
            entropy_error_nats=float(off.abs().mean()),
            image_error_db=float(error_db(image.to(torch.complex128), truth).mean()),
            **seconds,
        )

    def estimators(self) -> Iterator[Row]:
        """Every estimator without a start, and searches: descent from the truth times 0.95, and a
        short genetic one in a box about the truth.
        """
        data = self.data.to(self.dtype)
        for name, work in self._alternatives(data).items():
            estimate, seconds = self._timed(work)
            yield self._errors(name, estimate, seconds)

    def _alternatives(self, data: Tensor) -> Mapping[str, Callable[[], Estimate]]:
        settings, told = self.settings, {**self._told, "yc_m": self.yc_m, "order": max(2, len(true_k(self.table)) + 1)}
        found: dict[str, Callable[[], Estimate]] = {
            "coarse": partial(coarse_rotation, data, **told),
            "phase fit": partial(phase_fit_rotation, data, **told),
        }
        for count in settings.scatterers:
            found[f"recommended, {count} scatterers"] = partial(uneven_rotation, data, **told, scatterers=count)
        for rounds in settings.rounds:
            found[f"recommended, {rounds} round{'s' if rounds > 1 else ''}"] = partial(
                uneven_rotation, data, **told, rounds=rounds
            )
        found["recommended"] = partial(uneven_rotation, data, **told)
        known = 0.0 if self.yc_m is None else self.yc_m
        raw, shape = (
            ImageEntropy(data, **{**told, "yc_m": known}, variables=variables) for variables in ("raw", "shape")
        )
        v = self.truth.values
        found["descent from 0.95 of the truth"] = lambda: descend_rotation(
            shape, shape.start(0.95 * v["omega_rad_s"], 0.95 * v["warp_k"], None)
        )
        centre = torch.cat([v["omega_rad_s"][..., None], v["warp_k"]], -1)
        box = settings.box * torch.where(centre != 0, centre.abs(), 1)
        name = f"genetic {settings.population} x {settings.generations}, +-{100 * settings.box:g} %"
        found[name] = lambda: genetic_rotation(
            raw,
            centre - box,
            centre + box,
            draws=Draws(1),
            population=settings.population,
            generations=settings.generations,
        )
        return found

    def _errors(self, name: str, estimate: Estimate, seconds: Mapping[str, float]) -> Row:
        v, true = self.truth.values, true_k(self.table)
        errors: dict[str, float] = {}
        if name != "coarse":  # which does not look at the rate
            errors["omega_error_percent"] = _rms(100 * (estimate["omega_rad_s"] / v["omega_rad_s"] - 1))
        for i, k in enumerate(estimate["warp_k"].unbind(-1)[:2]):
            of = true[i] if i < len(true) else 0.0
            errors[f"k{i + 1}_error_percent"] = _rms((k - of) * (100 / abs(of) if of else 1.0))
        log.info(
            "%s: %.2f s a trial, %s", name, seconds["seconds"], ", ".join(f"{value:.3g}" for value in errors.values())
        )
        return Row(name, **errors, **seconds)

    def precisions(self) -> Iterator[Row]:
        """The recommended estimator on data of both precisions."""
        told = {**self._told, "yc_m": self.yc_m, "order": max(2, len(true_k(self.table)) + 1)}
        for name in self.settings.precisions:
            estimate, seconds = self._timed(partial(uneven_rotation, self.data.to(getattr(torch, name)), **told))
            yield self._errors(f"recommended, {name}", estimate, seconds)


def _rms(x: Tensor) -> float:
    return float(x.square().mean().sqrt())


def _cut(k: Tensor, order: int, duration_s: float) -> Tensor:
    """The warp of this order that lies nearest, in least squares over the aperture: its first
    Legendre terms, or itself where it has no more.
    """
    return (
        k
        if order > k.shape[-1]
        else k_of_shape(shape_of(k, duration_s)[..., : order - 1], duration_s)
        if order > 1
        else k[..., :0]
    )


_TITLES = {
    "order": "ORDERS OF THE WARP, the true rotation cut to each",
    "gridding": "GRIDDING of the matched Fourier transform",
    "estimators": "ESTIMATORS of the rotation",
    "precision": "PRECISION of the recommended estimator",
}
_COLUMNS = {
    "entropy_nats": ("entropy (nats)", ".4f"),
    "entropy_error_nats": ("entropy error", ".1e"),
    "image_error_db": ("image error (dB)", ".1f"),
    "omega_error_percent": ("omega (%)", ".4f"),
    "k1_error_percent": ("k1 (%)", ".5f"),
    "k2_error_percent": ("k2 (%)", ".5f"),
}


def _figures(tables: Tables) -> dict[str, plot.Figure]:
    shown = {
        "order": ("entropy_nats", "entropy (nats)", False),
        "gridding": ("image_error_db", "image error (dB)", False),
    }
    shown |= dict.fromkeys(("estimators", "precision"), ("k1_error_percent", "error of k1 (dB over 1 %)", True))
    return {key: _figure(tables[key], *shown[key], key) for key in tables}


def _figure(rows: Sequence[Row], name: str, label: str, decibel: bool, title: str) -> plot.Figure:
    kept = [row for row in rows if getattr(row, name) is not None and getattr(row, name) != -math.inf]
    values = [20 * math.log10(max(getattr(row, name), 1e-9)) if decibel else getattr(row, name) for row in kept]
    return plot.trade([row.name for row in kept], [row.seconds for row in kept], values, label, title)
