"""Estimates of a non-uniform rotation compared with the truth, and cuts through targets.

Figures of one rotating target: images in metres, detail of one end, cuts through points.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchsar import plot
from torchsar.compensate import CoarseRotation
from torchsar.compensate.rotation.image_entropy import k_name
from torchsar.core import Axis, Chain, Estimate, Signal, unit_phasor
from torchsar.focus.image_lines import mean_rate
from torchsar.study.output.report import Drawn, first_named
from torchsar.study.trials.batch import Result

# level at which the width is measured, -3 dB as a ratio of powers
_HALF_POWER = 10 ** (-3.0 / 10)
# points of a cut per line of the image, and lines beside it that keep its ends undisturbed, by
# choice
_FINER, _MARGIN = 8, 64


@dataclass(frozen=True)
class FoundRotation:
    """Estimates that a processing chain made of a non-uniform rotation.

    A value is None if no stage of the chain estimates it.

    Args:
        omega_rad_s: Rotation rate at the first pulse in rad/s, (...,).
        warp_k: Derivatives of the rate of order 1, 2, ... at the first pulse divided by the rate,
            k1 in 1/s, k2 in 1/s^2, ..., (..., order - 1).
        yc_m: Range centre deviation in metres, (...,): distance from the rotation centre to the
            assumed one.
        std: Predicted standard deviations by the name of the value, where there are any.
    """

    omega_rad_s: Tensor | None
    warp_k: Tensor | None
    yc_m: Tensor | None
    std: Mapping[str, Tensor]

    @staticmethod
    def by(chain: Chain, estimates: Mapping[str, Estimate]) -> FoundRotation:
        """Collect the estimates of the stages of a chain; later ones replace earlier ones.

        Values that a stage was given or only assumes are left out.

        Args:
            chain: The chain.
            estimates: Estimate of each stage by its name, in the order of the chain.

        Returns:
            The last estimate of each value.
        """
        found: dict[str, Tensor] = {}
        std: dict[str, Tensor] = {}
        for name, estimate in estimates.items():
            stage = chain.stages[name]
            held = set() if getattr(stage, "yc_m", 0.0) is None else {"yc_m"}
            only_warp = isinstance(stage, CoarseRotation) and not stage.options["fits"]
            held |= {"omega_rad_s", "yc_m"} if only_warp else set()
            for key in estimate.value.keys() - held:
                found[key] = estimate.value[key]
                std.pop(key, None)
                std.update({key: estimate.std[key]} if key in estimate.std else {})
        return FoundRotation(found.get("omega_rad_s"), found.get("warp_k"), found.get("yc_m"), std)

    def rate(self, duration_s: float) -> Tensor | None:
        """Mean rotation rate over the record in rad/s, (...,); NaN where the estimate is not
        positive. None if the chain does not estimate the rotation.
        """
        if self.omega_rad_s is None or self.warp_k is None:
            return None
        rate = mean_rate(self.omega_rad_s, self.warp_k, duration_s)
        return torch.where(rate > 0, rate, torch.nan)

    def errors(
        self, truth: Mapping[str, Tensor], duration_s: float, assumed_rad_s: float | None = None
    ) -> dict[str, Tensor]:
        """Compute the errors of the estimated rotation, and its predicted standard deviations.

        Args:
            truth: True `omega_rad_s`, `warp_k`, `yc_m` and mean rate `rotation_rad_s`, as the
                simulation gives them.
            duration_s: Length of the record in seconds.
            assumed_rad_s: Mean rate in rad/s that is assumed where the chain estimates none.

        Returns:
            Errors by name, (...,) each, in % of the true value; the error of yc is in metres. If
            the true value of a derivative k is zero, its error is in the unit of k instead, as
            `k1_error_per_s`, `k2_error_per_s2`, ... If it is zero in only some of the trials, both
            errors are returned, each with NaN in the trials to which it does not apply. Predicted
            standard deviations have the same names with "std" in place of "error"; those in % refer
            to the estimated value.
        """
        found: dict[str, Tensor] = {}
        if self.omega_rad_s is not None:
            found["omega_error_percent"] = 100 * (self.omega_rad_s / truth["omega_rad_s"] - 1)
            if "omega_rad_s" in self.std:
                found["omega_std_percent"] = _percent(self.std["omega_rad_s"], self.omega_rad_s)
        if self.warp_k is not None:
            stds = self.std.get("warp_k")
            for i, k in enumerate(self.warp_k.unbind(-1), 1):
                true = true_k(truth, i)
                std = None if stds is None else stds[..., i - 1]
                for name, scale in k_scales(i, true).items():
                    found[name] = (k - true) * scale
                    if std is not None:
                        own = _percent(std, k) if name.endswith("percent") else std
                        found[name.replace("error", "std")] = torch.where(scale.isnan(), torch.nan, own)
        if self.yc_m is not None:
            found["yc_error_m"] = self.yc_m - truth["yc_m"]
            found.update({"yc_std_m": self.std["yc_m"]} if "yc_m" in self.std else {})
        rate = self.rate(duration_s)
        if rate is None and assumed_rad_s is not None:
            rate = torch.full_like(truth["rotation_rad_s"], assumed_rad_s)
        if rate is not None:
            found["cross_range_scale_error_percent"] = 100 * (truth["rotation_rad_s"] / rate - 1)
        return found


def true_k(truth: Mapping[str, Tensor], i: int) -> Tensor:
    """Return the true derivative of order i of the rotation rate, relative to the rate.

    Args:
        truth: True `warp_k` (..., order - 1) and `omega_rad_s` (...,).
        i: Order of the derivative, from 1.

    Returns:
        k_i in 1 / s^i, shape (...,); zero beyond the order of the true rotation.
    """
    k = truth["warp_k"]
    return k[..., i - 1] if i <= k.shape[-1] else torch.zeros_like(truth["omega_rad_s"])


def k_scales(i: int, true: Tensor) -> dict[str, Tensor]:
    """Return the factors that convert an error of k_i into the form in which it is reported.

    Here k_i is the derivative of order i of the rotation rate, relative to the rate. Its error is
    reported in % of the true value, or in 1 / s^i where the true value is zero.

    Args:
        i: Order of the derivative, from 1.
        true: True values of k_i, shape (...,).

    Returns:
        Factors by the name of the reported error, shape (...,) each; NaN in trials to which the
        name does not apply.
    """
    zero, own = true == 0, k_name(i).replace("_", "_error_", 1)
    found = {} if bool(zero.all()) else {f"k{i}_error_percent": torch.where(zero, torch.nan, 100 / true.abs())}
    return found | ({own: torch.where(zero, 1.0, torch.nan).to(true)} if bool(zero.any()) else {})


def _percent(std: Tensor, value: Tensor) -> Tensor:
    return torch.where(value != 0, 100 * std / value.abs(), 100.0)


@dataclass(frozen=True)
class CrossRangeCut:
    """Interpolated cuts through the images of a point target along cross range.

    Args:
        offset_m: Cross range relative to the true position of the target in metres, (trial, point).
        line: Complex samples of the cut, (trial, point).
        inside: Points near enough to the true position to be searched for the peak, bool (trial,
            point).
    """

    offset_m: Tensor
    line: Tensor
    inside: Tensor

    @property
    def figures(self) -> dict[str, Tensor]:
        """Figures of the point response, (trial,) each.

        `peak` is the amplitude. `irw_azimuth_m` is the width between the first crossings of -3 dB
        on both sides of the peak. `pslr_azimuth_db` is the level of the strongest response beyond
        the first minima on both sides.
        """
        power = torch.where(self.inside, self.line.abs().square(), 0)
        top = power.argmax(-1, keepdim=True)
        peak = power.gather(-1, top)
        ends = [self._reach(power, top, peak, side) for side in (1, -1)]
        step = self.offset_m[:, 1] - self.offset_m[:, 0]
        index = torch.arange(power.shape[-1], device=power.device)
        beside = torch.where((index > ends[0][1]) | (index < ends[1][1]), power, 0).amax(-1)
        ratio = beside / peak[:, 0].clamp_min(torch.finfo(power.dtype).tiny)
        return {
            "peak": peak[:, 0].sqrt(),
            "irw_azimuth_m": (ends[0][0] - ends[1][0])[:, 0] * step,
            "pslr_azimuth_db": 10 * torch.log10(ratio.clamp_min(1e-30)),
        }

    def _reach(self, power: Tensor, top: Tensor, peak: Tensor, side: int) -> tuple[Tensor, Tensor]:
        """Fractional index of half power, and index of the first minimum, on one side of the peak,
        (trial, 1).
        """
        n, index = power.shape[-1], torch.arange(power.shape[-1], device=power.device)
        before = power.roll(side, -1)  # level of the neighbour towards the peak
        beyond, last = (index - top) * side > 0, n if side > 0 else -1
        edge = torch.where(self.inside, index, 0 if side > 0 else n - 1)
        edge = edge.amax(-1, keepdim=True) if side > 0 else edge.amin(-1, keepdim=True)

        def first(where: Tensor) -> Tensor:
            at = torch.where(where & beyond & self.inside, index, last)
            return at.amin(-1, keepdim=True) if side > 0 else at.amax(-1, keepdim=True)

        half = first(power < _HALF_POWER * peak)
        there = half != last
        at = half.clamp(0, n - 1)
        high, low = before.gather(-1, at), power.gather(-1, at)
        part = (high - _HALF_POWER * peak) / torch.where(high > low, high - low, 1)
        crossing = torch.where(there, half - side + side * part, edge)
        rise = first(power > before)
        return crossing, torch.where(rise != last, rise - side, edge)


def cross_range_cut(
    image: Signal,
    x_m: Tensor,
    y_m: Tensor,
    metres_per_unit: Tensor,
    search_m: float,
    centre_turns: float = 0.0,
) -> CrossRangeCut | None:
    """Cut images along cross range through the range cell nearest to a target.

    Args:
        image: Images (trial, azimuth, range).
        x_m: True cross range in metres, (trial,).
        y_m: True range in metres, (trial,).
        metres_per_unit: Metres per unit of the azimuth axis, (trial,): wavelength / (2 rotation
            rate) for an axis in Hz.
        search_m: Half length in metres of the part of the cut in which the peak is sought.
        centre_turns: Centre of the spectrum along azimuth in turns per line of the image; it is not
            zero for images of the matched Fourier transform, whose aperture starts at time zero.

    Returns:
        The cuts; None if any image has fewer than 8 lines within search_m of the target.
    """
    along, across = image.axes
    n, device = along.n, image.data.device
    start, step = along.start * metres_per_unit, along.step * metres_per_unit
    middle = ((x_m - start) / step).round().long()
    reach = (search_m / step).ceil().long()
    first, last = (middle - reach).clamp(0, n), (middle + reach + 1).clamp(0, n)
    # fewer lines than this do not contain a main lobe with its side lobes
    if not bool((last - first >= 8).all()):
        return None
    longest = int((last - first).max())
    margin = max(_MARGIN, longest)
    size = min(n, longest + 2 * margin)
    low = (first - margin).clamp(0, n - size)
    column = across.index_of(y_m).round().long().clamp(0, across.n - 1)
    rows = low[:, None] + torch.arange(size, device=device)
    trial = torch.arange(len(rows), device=device)[:, None]
    line = image.data[trial, rows, column[:, None]].to(torch.complex128)
    index = torch.arange(size, dtype=torch.float64, device=device)
    spectrum = torch.fft.fft(line * unit_phasor(-centre_turns * index, line.dtype))
    half = (size + 1) // 2
    gap = spectrum.new_zeros((len(rows), (_FINER - 1) * size))
    fine = torch.fft.ifft(torch.cat([spectrum[:, :half], gap, spectrum[:, half:]], -1)) * _FINER
    position = low[:, None] + torch.arange(fine.shape[-1], dtype=torch.float64, device=device) / _FINER
    inside = (position >= first[:, None]) & (position <= last[:, None] - 1)
    return CrossRangeCut(start[:, None] + step[:, None] * position - x_m[:, None], fine, inside)


# A target of fewer scatterers consists of points. Cuts through these show more than an enlarged
# picture.
_MANY = 20


def _in_metres(result: Result) -> dict[str, Signal]:
    """Images of the first trial with cross range in metres, scaled by each method's own rate."""
    found = {}
    for name, image in first_named(result.images).items():
        azimuth, range_ = image.axes
        rate = float(result.first_of(name).judged.view.rate[0])
        scale = result.bench.radar.wavelength_m / (2 * rate) if azimuth.unit == "Hz" else 1.0
        cross = Axis("cross range", azimuth.n, azimuth.start * scale, azimuth.step * scale, "m")
        found[name] = Signal(image.data, (cross, range_))
    return found


def _images(result: Result) -> Drawn:
    along, across = result.first.trials.first("range_m", "cross_range_m")
    images = _in_metres(result)
    # more than the cross range of the target, so that the responses of points are visible
    reach = (1.15 if len(across) >= _MANY else 1.5) * float(across.abs().max())
    margin = next(iter(images.values())).axes[1].step
    shown = _parts(images, (-reach, reach), plot.span(along, margin))
    caption = (
        "The first trial; 0 dB is the peak of the first image. Cross range is scaled by the rotation rate that the "
        "method itself estimates, or by the true mean rate if it estimates none. The sign of cross range cannot be "
        "determined from the data."
    )
    figure = plot.images(shown, dynamic_range_db=40.0, percentile=100)
    yield "images", "Images by every method", caption, figure


def _end(result: Result, part: float = 0.2) -> Drawn:
    """Draw the end of the target with the outermost scatterer, as in Figs 5 to 9 of the source: the
    part `part` of its half width.
    """
    along, across = result.first.trials.first("range_m", "cross_range_m")
    if len(across) < _MANY:
        return
    reach, side = float(across.abs().max()), across[across.abs().argmax()].sign()
    near = side * across >= (1 - part) * reach
    images = _in_metres(result)
    margin = next(iter(images.values())).axes[1].step
    shown = _parts(images, plot.span(across[near], 0.1 * part * reach), plot.span(along[near], margin))
    caption = (
        "The outermost part of the target. An error of the rotation rate moves the scatterers along cross range; "
        "errors of k1 and k2 blur them. 0 dB is the peak of the first image."
    )
    figure = plot.images(shown, dynamic_range_db=40.0, percentile=100)
    yield "end", "One end of the target, enlarged", caption, figure


def _parts(images: Mapping[str, Signal], across: tuple[float, float], along: tuple[float, float]) -> dict[str, Signal]:
    """The part of every image between two cross ranges and two ranges, in metres."""
    return {name: plot.within(image, {"cross range": across, "range": along}) for name, image in images.items()}


def _slices(result: Result) -> Drawn:
    """Draw cuts through the point targets."""
    views = {name: result.first_of(name).judged.view for name in first_named(result.images)}
    targets = dict.fromkeys(target for view in views.values() for target in view.cuts)
    parts = [
        part for one in targets for part in _panels(one, {n: v.cuts[one] for n, v in views.items() if one in v.cuts})
    ]
    if parts:
        caption = (
            "Cuts along cross range through each point target. The ideal response is in every panel; the other methods "
            "are spread over several panels if there are many. 0 dB is the peak of the ideal response."
        )
        yield "slices", "Responses of point targets", caption, plot.panels(parts)


def _panels(target: str, cuts: Mapping[str, CrossRangeCut], beside: int = 4) -> list[dict[str, Any]]:
    """Panels of one target, over 25 widths of the response to either side.

    Each panel has the first method and an equal share of the others, at most `beside`.
    """
    first, *others = cuts
    top, width = (float(cuts[first].figures[key][0]) for key in ("peak", "irw_azimuth_m"))
    count = math.ceil(len(others) / beside) or 1
    parts = []
    for number in range(count):
        series = {}
        for name in [first, *others[number::count]]:
            offset, inside = cuts[name].offset_m[0], cuts[name].inside[0]
            kept = inside & (offset.abs() <= 25 * width)
            series[name] = (1e3 * plot.array(offset[kept]), plot.decibel(cuts[name].line[0][kept], top))
        labels = {"xlabel": "cross range from the true position (mm)", "ylabel": "level (dB)", "title": target}
        parts.append({"series": series, **labels, "ylim": (-50.0, 3.0)})
    return parts


DRAW_CASE = (_images, _end, _slices)
