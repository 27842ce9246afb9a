"""Figures of one batch of trials: rotation against the truth, images against the ideal one,
responses of point targets.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchsar.compensate.rotation import CoarseRotation
from torchsar.compensate.rotation.unknowns import k_name
from torchsar.core import Axis, Chain, Estimate, Signal, Trace
from torchsar.focus.matched_fourier import mean_rate
from torchsar.metrics import contrast, entropy
from torchsar.study.tracing import verdict

DEFINITIONS: dict[str, Any] = {
    "snr": (
        "mean power of all range-compressed samples over noise variance, dB; the same before "
        "and after a unitary transform along range"
    ),
    "rotation": (
        "theta = omega (t + k1 t^2 / 2! + k2 t^3 / 3! + ...), t = 0 at the first pulse: k1, "
        "k2 are the TRUE derivatives of the rate over the rate at the first pulse"
    ),
    "mirror": "only omega^2 shows in the data: omega is given positive, and an image may be mirrored in cross range",
    "omega_error_percent": "estimated minus true rate at the first pulse, % of the truth",
    "k1_error_percent": (
        "estimated minus true k1, % of the truth (k1_error_per_s, 1/s, where the truth is 0); k2 and so on alike"
    ),
    "yc_error_m": (
        "estimated minus true range centre deviation: a scatterer at range y of the window "
        "turns at y + yc from the centre"
    ),
    "cross_range_scale_error_percent": (
        "lengths in an image scaled by the method's own mean rate, less the true ones, %; of "
        "methods without a rate that of radar.rotation_rad_s"
    ),
    "predicted": (
        "omega_std_percent, k1_std_percent, yc_std_m, ...: deviations that the method itself "
        "predicts, % of its estimate"
    ),
    "entropy_nats": (
        "-sum p ln p, p = |I|^2 / sum |I|^2 over the whole image, nats; it grows with the "
        "lines of an image, ln 2 nats from oversampling 1 to 2"
    ),
    "entropy_above_ideal_nats": "entropy less that of the metrics.reference image of the same scene and noise",
    "contrast": "standard deviation over mean of the intensity |I|^2",
    "targets": (
        "cut along cross range through the range cell of a point target, metres by the "
        "method's own rate, by the true mean rate where it finds none"
    ),
    "peak_db": (
        "interpolated peak of the cut within metrics.search_m of the true place, relative to that of the reference"
    ),
    "irw_azimuth_m": "width between the first crossings of -3 dB beside the peak of the cut",
    "pslr_azimuth_db": "strongest response beyond the first minima beside the peak, over the peak",
    "evaluations": "evaluations of the objective that a search reports",
    "ok": "whether the method itself trusts its estimate",
    "seconds": "wall time of the chain of the method per trial",
    "bounds": (
        "Cramer-Rao, noise known, complex amplitudes and cross ranges of resolved scatterers "
        "unknown; overlapping neighbours raise it"
    ),
    "published": "figures of Remote Sens. 2025, 17, 3447",
}
_DB3 = 10 ** (-3.0 / 10)
_FINER = 8


@dataclass(frozen=True)
class Turned:
    """A rotation: omega_rad_s (...,), warp_k (..., order - 1), yc_m (...,), any of them None where
    a method does not look for it; std: of those it predicts.
    """

    omega_rad_s: Tensor | None
    warp_k: Tensor | None
    yc_m: Tensor | None
    std: Mapping[str, Tensor]

    @staticmethod
    def by(chain: Chain, estimates: Mapping[str, Estimate]) -> Turned:
        """What the estimators of a chain found, later ones before earlier ones."""
        found: dict[str, Tensor] = {}
        std: dict[str, Tensor] = {}
        for name, estimate in estimates.items():
            stage = chain.stages[name]
            told = set() if getattr(stage, "yc_m", 0.0) is None else {"yc_m"}
            told |= {"omega_rad_s", "yc_m"} if isinstance(stage, CoarseRotation) else set()
            for key in estimate.value.keys() - told:
                found[key] = estimate.value[key]
                std.pop(key, None)
                std.update({key: estimate.std[key]} if key in estimate.std else {})
        return Turned(found.get("omega_rad_s"), found.get("warp_k"), found.get("yc_m"), std)

    def rate(self, duration_s: float) -> Tensor | None:
        """Mean rate over the aperture (rad/s), (...,); NaN where the estimate is not positive.

        None where there is none.
        """
        if self.omega_rad_s is None or self.warp_k is None:
            return None
        rate = mean_rate(self.omega_rad_s, self.warp_k, duration_s)
        return torch.where(rate > 0, rate, torch.nan)


def rotation_metrics(
    found: Turned, truth: Mapping[str, Tensor], true_k: tuple[float, ...], duration_s: float, told_rate: float | None
) -> dict[str, Tensor]:
    """Errors and predicted deviations, (...,) each.

    true_k: k of the world, which says what is given in percent; told_rate: what the radar takes the
    rotation to be.
    """
    metrics: dict[str, Tensor] = {}
    if found.omega_rad_s is not None:
        metrics["omega_error_percent"] = 100 * (found.omega_rad_s / truth["omega_rad_s"] - 1)
        metrics.update(_relative_std("omega", found.std.get("omega_rad_s"), found.omega_rad_s))
    if found.warp_k is not None:
        stds = found.std.get("warp_k")
        for i, k in enumerate(found.warp_k.unbind(-1)):
            metrics.update(
                _k_metrics(i + 1, k, true_k[i] if i < len(true_k) else 0.0, None if stds is None else stds[..., i])
            )
    if found.yc_m is not None:
        metrics["yc_error_m"] = found.yc_m - truth["yc_m"]
        if "yc_m" in found.std:
            metrics["yc_std_m"] = found.std["yc_m"]
    rate = found.rate(duration_s)
    if rate is None and told_rate is not None:
        rate = torch.full_like(truth["rotation_rad_s"], told_rate)
    if rate is not None:
        metrics["cross_range_scale_error_percent"] = 100 * (truth["rotation_rad_s"] / rate - 1)
    return metrics


def k_metric(i: int, true_k: tuple[float, ...]) -> tuple[str, float]:
    """Name of the error of k_i, and what an error in 1/s^i is multiplied with."""
    true = true_k[i - 1] if i <= len(true_k) else 0.0
    return (f"k{i}_error_percent", 100 / abs(true)) if true else (k_name(i).replace("_", "_error_", 1), 1.0)


def _k_metrics(i: int, k: Tensor, true: float, std: Tensor | None) -> dict[str, Tensor]:
    name, scale = k_metric(i, (0.0,) * (i - 1) + (true,))
    predicted = {} if std is None else _relative_std(f"k{i}", std, k) if true else {name.replace("error", "std"): std}
    return {name: (k - true) * scale, **predicted}


def _relative_std(name: str, std: Tensor | None, value: Tensor) -> dict[str, Tensor]:
    return {} if std is None else {f"{name}_std_percent": torch.where(value != 0, 100 * std / value.abs(), 100.0)}


def told_metrics(trace: Trace) -> dict[str, Tensor]:
    """Verdict and evaluations of the objective, (...,) each."""
    trials = trace.signal.trials
    counts = [
        estimate.info["evaluations"].to(torch.float64).expand(trials)
        for estimate in trace.estimates.values()
        if "evaluations" in estimate.info
    ]
    return {**verdict(trace.estimates, trials), **({"evaluations": torch.stack(counts).sum(0)} if counts else {})}


def image_metrics(image: Signal) -> dict[str, Tensor]:
    return {"entropy_nats": entropy(image), "contrast": contrast(image)}


def in_metres(image: Signal, wavelength_m: float, rate: float) -> Signal:
    """An image of one trial with its Doppler axis as cross range; one that has metres already is
    left alone.
    """
    azimuth, range_ = image.axes
    scale = wavelength_m / (2 * rate) if azimuth.unit == "Hz" else 1.0
    return Signal(
        image.data, (Axis("cross range", azimuth.n, azimuth.start * scale, azimuth.step * scale, "m"), range_)
    )


@dataclass(frozen=True)
class Cut:
    """Cut through a point target along cross range of one trial: offset_m from the true place, and
    complex samples.
    """

    offset_m: Tensor
    line: Tensor

    @property
    def figures(self) -> dict[str, float]:
        """peak (amplitude), irw_azimuth_m and pslr_azimuth_db."""
        power = self.line.abs().square()
        top = int(power.argmax())
        width = _crossing(power, top, 1) - _crossing(power, top, -1)
        step = float(self.offset_m[1] - self.offset_m[0])
        low, high = _minimum(power, top, -1), _minimum(power, top, 1)
        beside = torch.cat([power[:low], power[high + 1 :]])
        ratio = float(beside.max() / power[top]) if beside.numel() and float(power[top]) > 0 else 0.0
        return {
            "peak": math.sqrt(float(power[top])),
            "irw_azimuth_m": width * step,
            "pslr_azimuth_db": 10 * math.log10(max(ratio, 1e-30)),
        }


def cut_through(image: Signal, x_m: float, y_m: float, search_m: float, oversampling_turns: float) -> Cut:
    """The cut through range cell y_m (nearest) within search_m of x_m, interpolated; image: of one
    trial, (cross range, range) in metres.

    oversampling_turns: middle of the band of the lines in turns a line; the matched transform has
    its points at 0..1 of the aperture.
    """
    along, across = image.axes
    column = min(max(round(float(across.index_of(y_m))), 0), across.n - 1)
    reach = math.ceil(search_m / along.step)
    middle = round(float(along.index_of(x_m)))
    first, last = max(0, middle - reach), min(along.n, middle + reach + 1)
    if last - first < 8:
        raise ValueError(
            f"the image has {max(0, last - first)} lines within search_m = {search_m:g} m of the "
            f"target at {x_m:g} m; widen metrics.search_m or the image"
        )
    return _finer(image.data[:, column].to(torch.complex128), along, first, last, x_m, oversampling_turns)


def _finer(line: Tensor, along: Axis, first: int, last: int, x_m: float, turns: float) -> Cut:
    """Lines first..last on a grid 8 times finer: the band is moved to zero and the spectrum padded,
    over twice the span so that its ends do not show.
    """
    margin = max(64, last - first)
    low, high = max(0, first - margin), min(len(line), last + margin)
    n = high - low
    index = torch.arange(n, dtype=torch.float64)
    spectrum = torch.fft.fft(
        line[low:high] * torch.polar(torch.ones(n, dtype=torch.float64), -2 * math.pi * turns * index)
    )
    half = (n + 1) // 2
    padded = torch.cat([spectrum[:half], spectrum.new_zeros((_FINER - 1) * n), spectrum[half:]])
    fine = torch.fft.ifft(padded) * _FINER
    kept = slice((first - low) * _FINER, (last - 1 - low) * _FINER + 1)
    places = along.start + along.step * (low + torch.arange(len(fine), dtype=torch.float64) / _FINER)
    return Cut((places - x_m)[kept], fine[kept])


def _crossing(power: Tensor, top: int, way: int) -> float:
    """Where power first falls through half of that at the top, to one side, in samples."""
    side = power[top:] if way > 0 else power[: top + 1].flip(0)
    below = torch.nonzero(side < _DB3 * side[0])[:, 0]
    if not len(below):
        return float(top + way * (len(side) - 1))
    at = int(below[0])
    here, there = float(side[at - 1]), float(side[at])
    return top + way * (at - 1 + (here - _DB3 * float(side[0])) / (here - there))


def _minimum(power: Tensor, top: int, way: int) -> int:
    """First local minimum from the top to one side."""
    side = power[top:] if way > 0 else power[: top + 1].flip(0)
    rises = torch.nonzero(torch.diff(side) > 0)[:, 0]
    steps = int(rises[0]) if len(rises) else len(side) - 1
    return top + way * steps
