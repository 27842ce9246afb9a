"""Estimated velocities and images of single moving points, compared with the truth.

The points are observed by a receiver with several channels along track.

Figures of moving point targets: azimuth profiles, main lobes, contours and spectra.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchsar import plot
from torchsar.core import Chain, Estimate, Signal, Trace, take
from torchsar.metrics import azimuth_response, error_db, replica_level, replica_zones
from torchsar.metrics.cuts import about_peak, finer
from torchsar.multichannel import FocusAzimuth, PointMotion, Reconstruct, condition_number, noise_gain_db
from torchsar.radar import BistaticRadar
from torchsar.study.output.report import Drawn
from torchsar.study.settings.sections import key_of
from torchsar.study.trials.batch import Result, error_name

# symbols of the unknowns, by their names in true values and estimates
UNKNOWNS = ("u_r_m_s", "u_a_m_s", "y0_m")
# properties of a sinc: -3 dB width over the spacing of its nulls, and levels of the side lobes up
# to 20 nulls to either side
_WIDTH, _PSLR_DB, _ISLR_DB = 0.8859, -13.26, -9.92


@dataclass(frozen=True)
class FoundMotion:
    """Velocity and position estimates of a processing chain, for one moving point per row.

    Args:
        value: Estimates by name, (row,) each; values that the chain was given are left out.
        std: Predicted standard deviations of the estimates, by the same names, where there are any.
        outcome: Codes of the estimates by the same names, (row,) each; see `torchsar.Outcome`.
    """

    value: Mapping[str, Tensor]
    std: Mapping[str, Tensor]
    outcome: Mapping[str, Tensor]

    @staticmethod
    def by(estimates: Mapping[str, Estimate]) -> FoundMotion:
        """Collect the estimates of the stages of a chain; later ones replace earlier ones.

        Args:
            estimates: Estimate of each stage by its name, in the order of the chain.

        Returns:
            The last estimate of each unknown.
        """
        last = {key: e for e in estimates.values() for key in UNKNOWNS if key in (e.std or e.value)}
        return FoundMotion(
            {key: e.value[key] for key, e in last.items()},
            {key: e.std[key] for key, e in last.items() if key in e.std},
            {key: e.outcome for key, e in last.items()},
        )

    def errors(self, truth: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Compute the errors of the estimates.

        Args:
            truth: True values by name, (row,) each.

        Returns:
            Estimates minus true values and predicted standard deviations, under the names that
            `error_name` gives, (row,) each.
        """
        errors = {error_name(key): value - truth[key] for key, value in self.value.items()}
        return {**errors, **{error_name(key, "std"): std for key, std in self.std.items()}}


@dataclass(frozen=True)
class FocusedPoint:
    """The stages and motions with which a chain formed its image of a moving point.

    Args:
        stage: Name in the chain of the stage that reconstructs the Doppler spectrum.
        rebuild: Stage that reconstructs the Doppler spectrum from the channels.
        focus: Stage that focuses the spectrum in azimuth.
        rebuilt_for: Motion of the point (row,) that the reconstruction was given.
        focused_for: Motion of the point (row,) that the focusing was given.
    """

    stage: str
    rebuild: Reconstruct
    focus: FocusAzimuth
    rebuilt_for: PointMotion
    focused_for: PointMotion

    @staticmethod
    def of(chain: Chain, trace: Trace, radar: BistaticRadar) -> FocusedPoint | None:
        """Find the reconstruction and the focusing of a chain, and the motions they were given.

        Args:
            chain: The chain.
            trace: Signals and values of a run of the chain.
            radar: Radar parameters.

        Returns:
            The last reconstruction and focusing; None if the chain lacks one of the two.
        """
        kinds = (Reconstruct, FocusAzimuth)
        rebuild, focus = ([n for n, stage in chain.stages.items() if isinstance(stage, kind)] for kind in kinds)
        if not rebuild or not focus:
            return None
        stages: Any = chain.stages
        given = [_given(chain, names[-1], trace, radar) for names in (rebuild, focus)]
        return FocusedPoint(rebuild[-1], stages[rebuild[-1]], stages[focus[-1]], *given)

    @property
    def bands(self) -> int:
        """Number of Doppler bands of one PRF each that are reconstructed."""
        return self.rebuild.rebuild.bands

    @property
    def processed_hz(self) -> float:
        """Width in Hz of the Doppler band that is focused."""
        rebuilt = self.bands * self.rebuild.radar.prf_hz
        return min(rebuilt, self.focus.bandwidth_hz or rebuilt)

    def conditioning(self) -> dict[str, Tensor]:
        """Compute condition number and noise gain of the reconstruction from the channels.

        Returns:
            `noise_gain_db`, and `condition_number` if there are no more bands than channels, (row,)
            each.
        """
        radar, motion = self.rebuild.radar, self.rebuilt_for
        found = {"noise_gain_db": noise_gain_db(radar, motion, self.rebuild.rebuild)}
        known = (
            {"condition_number": condition_number(radar, motion, self.bands)} if self.bands <= radar.channels else {}
        )
        return {**known, **found}


def _given(chain: Chain, stage: str, trace: Trace, radar: BistaticRadar) -> PointMotion:
    """Motion (row,) that a stage of a chain used."""
    values = {key: value for key, value in trace.arguments[stage].items() if key in UNKNOWNS}
    data, rows = trace.inputs[stage].data, trace.inputs[stage].trials
    motion = PointMotion.of(radar, data, **values, range_m=getattr(chain.stages[stage], "range_m", None))
    return motion.each(lambda value: value.expand(rows))


@dataclass(frozen=True)
class PeakCuts:
    """Cuts through the peak of the image of a moving point, one image per row.

    Args:
        azimuth: Complex cut along azimuth, (row, azimuth), over x = v t. Here t is slow time and v
            = V_R - u_a the speed of the receiver minus the true along-track speed of the point.
        step_m, start_m: Step and first value of x in metres, (row,).
        range: Cut along range, (row, range); None for azimuth-only images.
        range_axis: First value and step of the range axis in metres.
    """

    azimuth: Tensor
    step_m: Tensor
    start_m: Tensor
    range: Tensor | None
    range_axis: tuple[float, float]

    @staticmethod
    def of(image: Signal, along_m_s: Tensor, speed_m_s: float) -> PeakCuts:
        """Cut images along both axes through their strongest sample.

        Args:
            image: Images (row, azimuth[, range]), with slow time times the speed of the receiver
                as azimuth in metres.
            along_m_s: Speed of the receiver minus the true along-track speed of the point in m/s,
                (row,).
            speed_m_s: Speed of the receiver in m/s.

        Returns:
            Cuts; the azimuth cut of images without a range axis is the image itself.
        """
        axis, scale = image.axes[0], along_m_s / speed_m_s
        if "range" not in image.names:
            return PeakCuts(image.data, axis.step * scale, axis.start * scale, None, (0.0, 0.0))
        power, across = image.data.abs(), image.axes[1]
        row, line = power.amax(-1).argmax(-1), power.amax(-2).argmax(-1)
        cuts = (take(image.data, line), axis.step * scale, axis.start * scale, take(image.data, row, -2))
        return PeakCuts(*cuts, (across.start, across.step))


def point_responses(
    image: Signal, focused: FocusedPoint, truth: Mapping[str, Tensor], integration_s: Tensor | float | None, orders: int
) -> dict[str, Tensor]:
    """Measure point response, false targets and position error in images of single moving points.

    Args:
        image: Images (row, azimuth[, range]) without noise.
        focused: Stages and motions with which the images were formed.
        truth: True closing speed `u_r_m_s`, along-track speed `u_a_m_s`, along-track position
            `y0_m` at slow time zero and closest range `range_m` of the points, (row,) each.
        integration_s: Time in seconds for which the points are illuminated, a number or (row,);
            None if only the antenna pattern of the array elements limits the illumination.
        orders: Largest Doppler distance in pulse rates at which false targets (replicas) are
            sought.

    Returns:
        Widths in metres, side-lobe and false-target levels in dB and position errors in metres by
        name, (row,) each; NaN for images without any energy.

    Reference:
        Remote Sens. 2020, 12, 1703, Table 4.
    """
    seen = image.data.abs().flatten(len(image.trials)).amax(-1) > 0
    found = _responses(image, focused, truth, integration_s, orders)
    return {name: torch.where(seen, value, math.nan) for name, value in found.items()}


def _responses(
    image: Signal, focused: FocusedPoint, truth: Mapping[str, Tensor], integration_s: Tensor | float | None, orders: int
) -> dict[str, Tensor]:
    radar, motion = focused.rebuild.radar, focused.focused_for
    along = radar.speed_m_s - truth["u_a_m_s"]
    cuts = PeakCuts.of(image, along, radar.speed_m_s)
    response = azimuth_response(cuts.azimuth, 1.0)
    metrics = {
        "irw_azimuth_m": response["irw_m"] * cuts.step_m,
        "pslr_azimuth_db": response["pslr_db"],
        "islr_azimuth_db": response["islr_db"],
        "mfta_db": _false_targets(cuts, focused, truth, integration_s, orders),
    }
    image_s = (cuts.start_m + response["position_m"] * cuts.step_m) / along
    if cuts.range is None:
        return {**metrics, "position_error_m": motion.position_m(image_s) - truth["y0_m"]}
    across = azimuth_response(cuts.range, cuts.range_axis[1], cuts.range_axis[0])
    metrics |= {
        "irw_range_m": across["irw_m"] / 2,
        "pslr_range_db": across["pslr_db"],
        "islr_range_db": across["islr_db"],
    }
    motion = replace(motion, range_m=across["position_m"])
    closest = torch.sqrt(across["position_m"].square() - motion.position_m(image_s).square())
    position = replace(motion, range_m=closest).position_m(image_s)
    return {**metrics, "position_error_m": position - truth["y0_m"], "range_error_m": closest - truth["range_m"]}


def _false_targets(
    cuts: PeakCuts,
    focused: FocusedPoint,
    truth: Mapping[str, Tensor],
    integration_s: Tensor | float | None,
    orders: int,
) -> Tensor:
    """Level (row,) of the largest replica. It is NaN for images that are too short to
    contain any.
    """
    radar, used = focused.rebuild.radar, focused.focused_for
    given = {"integration_s": integration_s, "focused_at": (used.u_r_m_s, used.u_a_m_s), "orders": range(1, orders + 1)}
    true = (truth[key] for key in (*UNKNOWNS, "range_m"))
    zones = replica_zones(radar, focused.bands, *true, axis_speed_m_s=radar.speed_m_s - truth["u_a_m_s"], **given)
    samples = zones / cuts.step_m[:, None, None]
    peak = cuts.azimuth.abs().argmax(-1)[:, None, None]
    if not bool(((samples[..., 1:] + peak >= 0) & (samples[..., :1] + peak < cuts.azimuth.shape[-1])).any()):
        return torch.full_like(cuts.step_m, math.nan)
    return replica_level(cuts.azimuth, 1.0, samples)["mfta_db"]


def worst_image_error_db(image: Signal, exact: Signal) -> float:
    """Compute the largest relative error in dB among several images of points.

    Args:
        image: Images of one point per row, (row, azimuth) or (row, azimuth, range).
        exact: Reference images of the same size.

    Returns:
        Largest relative error over the rows in dB.
    """
    two = [x.data.to(torch.complex128).reshape(len(x.data), -1, x.data.shape[-1]) for x in (image, exact)]
    two = [x if "range" in image.names else x.mT for x in two]
    return float(error_db(*two).max())


def ideal_responses(
    radar: BistaticRadar, u_r_m_s: float, u_a_m_s: float, integration_s: float | None, processed_hz: float, ranges: bool
) -> dict[str, float]:
    """Predict the figures of a moving point whose image is formed without any error.

    The point responses are then sinc functions over the processed bands.

    Args:
        radar: Radar parameters.
        u_r_m_s: Slant-range speed of the point in m/s.
        u_a_m_s: Along-track speed of the point in m/s.
        integration_s: Time in seconds for which the point is illuminated with constant amplitude;
            None if the amplitude follows the antenna pattern of a channel.
        processed_hz: Width of the processed Doppler band in Hz.
        ranges: Whether images have a range axis.

    Returns:
        Widths in metres, side-lobe levels in dB and errors of zero, under the names that
        `point_responses` gives its figures.
    """
    along, band = radar.speed_m_s - u_a_m_s, math.inf
    if integration_s is not None:
        band = (along**2 + u_r_m_s**2) * integration_s / (radar.wavelength_m * radar.reference_range_m)
    found = {"irw_azimuth_m": _WIDTH * along / min(band, processed_hz)}
    found |= {"pslr_azimuth_db": _PSLR_DB, "islr_azimuth_db": _ISLR_DB}
    found |= dict.fromkeys(("u_r_error_m_s", "u_a_error_m_s", "position_error_m"), 0.0)
    if ranges:
        found |= {"irw_range_m": _WIDTH * radar.wave_speed_m_s / (2 * radar.pulse.bandwidth_hz)}
        found |= {"pslr_range_db": _PSLR_DB, "islr_range_db": _ISLR_DB, "range_error_m": 0.0}
    return found


# lowest drawn levels of profiles and of spectra
_LOW_DB, _SPECTRUM_DB = -90.0, -70.0


@dataclass(frozen=True)
class Shot:
    """One target, processed by one method, in the first trial.

    Args:
        image: Its image without noise.
        profile: Cut along azimuth through the peak, shape (azimuth,).
        along_m: Positions of the cut in metres on the axis x = (V_R - u_a) t, with the speeds along
            track V_R of the receiver and u_a of the target, shape (azimuth,).
        spectrum: Magnitude of the rebuilt spectrum over the Doppler frequency in Hz, which counts
            from the centre of the spectrum; root of the sum of powers over range.
    """

    image: Signal
    profile: Tensor
    along_m: Tensor
    spectrum: Signal


Shots = dict[str, dict[str, Shot]]


def shots(result: Result) -> Shots:
    """Return the image of every target by every method that makes images."""
    targets, truth, radar = list(result.bench.world().targets), result.first.trials.truth, result.bench.radar
    found: Shots = {}
    for name, outcome in result.first.outcomes.items():
        view = outcome.judged.view
        if outcome.failed or view.image is None:
            continue
        cuts = PeakCuts.of(view.image, radar.speed_m_s - truth["u_a_m_s"], radar.speed_m_s)
        number = torch.arange(view.image.axes[0].n, dtype=torch.float64)
        flat = view.spectrum.data.flatten(2) if "range" in view.spectrum.names else view.spectrum.data[..., None]
        spectra = flat.abs().square().sum(-1).sqrt()
        found[name] = {
            target: Shot(
                view.image.with_data(view.image.data[i]),
                cuts.azimuth[i],
                cuts.start_m[i] + cuts.step_m[i] * number,
                Signal(spectra[i].to(torch.complex64), view.spectrum.axes[:1]),
            )
            for i, target in enumerate(targets)
        }
    return found


def by_target(results: Mapping[str, Result]) -> dict[str, Any]:
    """Return the metrics of the methods, by case and target."""
    names = {(case, t): None for case, r in results.items() for of in r.targets.values() for t in of}
    rows = {}
    for case, target in names:
        found = {name: of[target] for name, of in results[case].targets.items() if target in of}
        rows[key_of(case, target)] = SimpleNamespace(metrics=found)
    return rows


def _pair(result: Result) -> Shots:
    """Images of the conventional and the recommended method, or of the first two methods if these
    are missing.
    """
    found = shots(result)
    chosen = [name for name in ("conventional", "recommended") if name in found] or list(found)[:2]
    return {name: found[name] for name in chosen}


def _panels(found: Shots, curve: Callable[[Shot], tuple[Any, Any]], xlabel: str, low: float) -> list[dict[str, Any]]:
    """Panels, one for each target, with a curve of levels in dB for each method."""
    return [
        {
            "title": target,
            "series": {name: curve(of[target]) for name, of in found.items()},
            "xlabel": xlabel,
            "ylabel": "level (dB)",
            "ylim": (low, 3.0),
        }
        for target in next(iter(found.values()), {})
    ]


def _profiles(result: Result) -> Drawn:
    def curve(shot: Shot) -> tuple[Any, Any]:
        return plot.array(shot.along_m), np.maximum(plot.decibel(shot.profile), _LOW_DB)

    radar = result.bench.radar
    replica_m = radar.prf_hz * radar.wavelength_m * radar.reference_range_m / radar.speed_m_s
    caption = (
        "Azimuth profiles through the peak of images without noise, in dB relative to their own peaks. False targets "
        f"lie at multiples of about {replica_m:.0f} m from the peak, one for each pulse rate; V_R is the speed of the "
        "receiver. Weak maxima between them, of targets with limited illumination, are ends of the Doppler band that "
        "lie outside of the rebuilt band."
    )
    figures = plot.panels(_panels(_pair(result), curve, "x = (V_R - u_a) t (m)", _LOW_DB))
    yield "profiles", "False targets", caption, figures


def _main_lobes(result: Result) -> Drawn:
    def curve(shot: Shot) -> tuple[Any, Any]:
        fine, first = finer(shot.profile, 8), int(shot.profile.abs().argmax())
        offset = float(shot.along_m[1] - shot.along_m[0]) * (np.arange(len(fine)) / 8 - first)
        near = np.abs(offset) <= 12.0
        return offset[near], plot.decibel(fine)[near]

    figures = plot.panels(_panels(shots(result), curve, "x from the peak (m)", -40.0))
    caption = "The same profiles about their peaks, for every method."
    yield "main_lobes", "Main lobes", caption, figures


def _contours(result: Result) -> Drawn:
    """Draw two-dimensional images around their peaks, if there are any."""
    found = _pair(result)
    images = {
        f"{target}, {name}": of[target].image for target in next(iter(found.values()), {}) for name, of in found.items()
    }
    cut = {title: _about_peak(image) for title, image in images.items() if "range" in image.names}
    if cut:
        caption = (
            "Interpolated images without noise about their peaks, range on the axis c tau / 2. Conventional images of "
            "moving targets are defocused and displaced."
        )
        yield "contours", "Contours", caption, plot.contours(cut)


def _about_peak(image: Signal) -> Signal:
    """Part of an image around its peak, +-6 m in azimuth and +-20 m in range on a grid of 161
    samples.

    The axes give offsets from the peak; those in range are halved.
    """
    part = about_peak(image, (6.0, 40.0), 161)
    range_ = part.axes[1]
    return Signal(part.data, (part.axes[0], replace(range_, start=range_.start / 2, step=range_.step / 2)))


def _spectra(result: Result) -> Drawn:
    def curve(shot: Shot) -> tuple[Any, Any]:
        return plot.array(shot.spectrum.axes[0].values()), np.maximum(plot.decibel(shot.spectrum.data), _SPECTRUM_DB)

    figures = plot.panels(_panels(_pair(result), curve, "Doppler from the centre (Hz)", _SPECTRUM_DB))
    caption = (
        "Rebuilt Doppler spectra of echoes without noise. Energy outside of the band of a target makes false ones."
    )
    yield "spectra", "Rebuilt spectra", caption, figures


DRAW_CASE = (_profiles, _main_lobes, _contours, _spectra)
