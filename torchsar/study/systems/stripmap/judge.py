"""Figures of the stripmap simulation.

Part of the image of a strip that metrics use, and parameters with which the image was
focused.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from torchsar import plot
from torchsar.compensate import EffectiveVelocity
from torchsar.core import Chain, Signal, Trace, wrapped
from torchsar.metrics.cuts import impulse_cuts
from torchsar.radar import StripmapRadar
from torchsar.repair.response import band_grid
from torchsar.study.names.registry import group_of
from torchsar.study.output.report import Drawn
from torchsar.study.trials.batch import IMAGE, Result, image_of, last_stage

log = logging.getLogger("torchsar")
# least number of lines or samples of a window; metrics of a smaller one would depend on a few
# targets
_LEAST = 32


@dataclass(frozen=True)
class Margin:
    """Edges of the image that the metrics leave out.

    Args:
        first_lines: Number of lines left out at the start of the record.
        last_lines: Number of lines left out at the end of the record.
        first_samples: Number of range samples left out at the near edge.
        last_samples: Number of range samples left out at the far edge.
    """

    first_lines: int = 0
    last_lines: int = 0
    first_samples: int = 0
    last_samples: int = 0


def window(image: Signal, radar: StripmapRadar, margin: Margin | None) -> dict[str, slice]:
    """Return the part of an image that the metrics use, for `Signal.isel`.

    It has the lines with a full aperture and the samples with a full pulse, or what a given margin
    leaves. An axis of which fewer than 32 lines or samples would be left is used as a whole.

    Args:
        image: Image with the axes (azimuth, range).
        radar: Radar parameters.
        margin: Edges that are left out; None for those of the aperture and the pulse.

    Returns:
        Slice of indices by the name of the axis.
    """
    lines, samples = (axis.n for axis in image.axes)
    if margin is None:
        # an image can have several lines per pulse
        edge = min(
            round(radar.aperture_lines(image.axes[1].start) * radar.velocity_m_s / radar.prf_hz / image.axes[0].step)
            // 2,
            lines // 4,
        )
        margin = Margin(first_lines=edge, last_lines=edge, last_samples=radar.pulse_samples)
    spans = {"azimuth": (lines, margin.first_lines, margin.last_lines)}
    spans["range"] = (samples, margin.first_samples, margin.last_samples)
    kept = {axis: slice(first, n - last) for axis, (n, first, last) in spans.items()}
    for axis, part in kept.items():
        left = part.stop - part.start
        if left < _LEAST:
            log.debug("a margin leaves %d of the image along %s: the whole axis is used", left, axis)
            kept[axis] = slice(0, spans[axis][0])
    return kept


@dataclass(frozen=True)
class Used:
    """Parameters that the focusing stage of a chain used, of shape (trial,) each.

    Args:
        doppler_hz: Doppler centroid in Hz; None if the stage used none.
        velocity_m_s: Velocity in m/s.
        frame_hz: Doppler frequency in Hz to which the image coordinates refer.
    """

    doppler_hz: Tensor | None
    velocity_m_s: Tensor
    frame_hz: Tensor

    @staticmethod
    def by(chain: Chain, trace: Trace, radar: StripmapRadar, count: int) -> Used:
        """Return the parameters that a chain used.

        Args:
            chain: Chain that forms an image.
            trace: Signals and values of a run of the chain.
            radar: Radar parameters.
            count: Number of trials.
        """
        name = focus_name(chain)
        stage, connected = focuser_of(chain.stages[name]), trace.arguments[name]

        def value(key: str, default: Any) -> Any:
            found = connected.get(key, getattr(stage, key, default))
            return None if found is None else torch.as_tensor(found, dtype=torch.float64).detach().expand(count)

        doppler = value("doppler_hz", None)
        frame = getattr(stage, "frame_hz", None)
        frame = radar.pointing_doppler_hz if frame is None else frame
        frame = torch.zeros(count, dtype=torch.float64) if frame is None and doppler is None else frame
        frame = doppler if frame is None else torch.as_tensor(frame, dtype=torch.float64).expand(count)
        assert frame is not None
        return Used(doppler, value("velocity_m_s", radar.velocity_m_s), frame)

    def metrics(self, radar: StripmapRadar) -> dict[str, Tensor]:
        """Return Doppler centroid, squint and velocity with which the image was focused.

        Args:
            radar: Radar parameters.
        """
        found = {"effective_velocity_m_s": self.velocity_m_s}
        if self.doppler_hz is not None:
            sine = radar.sin_squint(self.doppler_hz, self.velocity_m_s).clamp(-1, 1)
            found["doppler_centroid_hz"] = self.doppler_hz
            found["doppler_baseband_hz"] = wrapped(self.doppler_hz, radar.prf_hz)
            found["squint_deg"] = torch.rad2deg(torch.asin(sine))
        return found


def focus_name(chain: Chain) -> str:
    """Return the name of the stage that forms the image.

    It is the last stage with the attribute `frame_hz`, the Doppler frequency of the image
    coordinates, or else the last stage.

    Args:
        chain: Chain of stages.

    Returns:
        Name of the stage.
    """
    focusing = [name for name, stage in chain.stages.items() if hasattr(focuser_of(stage), "frame_hz")]
    return focusing[-1] if focusing else last_stage(chain)[0]


def focuser_of(stage: nn.Module) -> nn.Module:
    """Return the focusing stage that a stage wraps, or else the stage itself.

    Args:
        stage: Stage of a chain.

    Returns:
        The focusing stage.
    """
    return getattr(stage, "focuser", stage)


def azimuth_spectrum(signal: Signal, bins: int = 256) -> tuple[Tensor, Tensor]:
    """Estimate the azimuth power spectrum of a recording, averaged over range.

    The spectrum is also averaged over segments of `bins` pulses, each weighted by a Hann window.

    Args:
        signal: Signal of one trial with the axes (pulse, range).
        bins: Number of pulses of a segment, and of Doppler bins of the result.

    Returns:
        Baseband Doppler frequency in Hz and power relative to its maximum, (bins,) each, float64.
    """
    data, pulse = signal.data, signal.axes[-2]
    bins = min(bins, pulse.n)
    window = torch.hann_window(bins, dtype=data.real.dtype, device=data.device)[:, None]
    power = torch.zeros(bins, dtype=torch.float64)
    for segment in data[: pulse.n // bins * bins].unflatten(0, (-1, bins)):
        power += torch.fft.fft(segment * window, dim=0).abs().square().sum(-1).double().cpu()
    frequency = torch.fft.fftshift(torch.fft.fftfreq(bins, pulse.step, dtype=torch.float64))
    return frequency, torch.fft.fftshift(power) / power.max().clamp_min(1e-300)


def range_spectrum(signal: Signal) -> Tensor:
    """Compute the range power spectrum of a recording, summed over all pulses.

    Args:
        signal: Signal of one trial with the axes (pulse, range).

    Returns:
        Power with zero frequency in the middle, (range,), float64.
    """
    power = torch.zeros(signal.axes[-1].n, dtype=torch.float64)
    for block in signal.data.split(256):  # a few megabytes of complex samples at a time
        power += torch.fft.fft(block).abs().square().sum(0).double().cpu()
    return torch.fft.fftshift(power)


def phase_increments(signal: Signal, blocks: int = 64) -> tuple[Tensor, Tensor]:
    """Compute the mean phase increment from pulse to pulse in successive blocks of a recording.

    Args:
        signal: Signal of one trial with the axes (pulse, range).
        blocks: Number of blocks; increments are averaged over the pulses and range cells of each.

    Returns:
        Slow time of the blocks in seconds and phase increments in radians, (block,) each, float64.
    """
    pulse = signal.axes[-2]
    blocks = min(blocks, max(1, (pulse.n - 1) // 2))
    product = (signal.data[:-1].conj() * signal.data[1:]).sum(-1).to(torch.complex128).cpu()
    index = torch.arange(pulse.n - 1, dtype=torch.float64).tensor_split(blocks)
    centres = torch.stack([pulse.start + pulse.step * (part.mean() + 0.5) for part in index])
    return centres, torch.stack([torch.angle(part.sum()) for part in product.tensor_split(blocks)])


# Part of the velocity curve that is drawn finely: half its extent in steps of the grid, and its
# number of points, of which the middle one is the estimate.
_NEAR_STEPS, _NEAR_POINTS = 1.5, 41
# methods whose cuts differ enough to be distinguished in one picture
_CUT_METHODS = ("clean", "none", "baseline", "recommended")


@dataclass(frozen=True)
class Strip:
    """The first trial of one case, from which its pictures are drawn."""

    result: Result

    @property
    def radar(self) -> Any:
        return self.result.bench.radar

    @property
    def stages(self) -> Mapping[str, Mapping[str, Any]]:
        return self.result.bench.config.processor["recommended"].stages or {}

    @property
    def scale(self) -> dict[str, Any]:
        """Level of 0 dB (as a percentile) and dynamic range of drawn images.

        0 dB is the peak if the scene has point targets, and otherwise the level that 0.1 % of the
        samples exceed.
        """
        known = bool(self.result.targets)
        return {"percentile": 100.0 if known else 99.9, "dynamic_range_db": 60.0 if known else 50.0}

    def images(self) -> dict[str, Signal]:
        """Images of all methods except reruns, in the window that the metrics use."""
        methods, margin = self.result.bench.config.processor, self.result.bench.judging.margin
        images = {name: image for name, image in self.result.images.items() if methods[name].rerun is None}
        return {name: image.isel(**window(image, self.radar, margin)) for name, image in images.items()}

    def step(self, name: str, output: bool) -> Signal:
        """Input or output of a stage of the recommended chain."""
        trace = self.result.first_of("recommended").trace
        assert trace is not None
        return image_of((trace.outputs if output else trace.inputs)[name])

    def strongest(self) -> tuple[str, float, float]:
        """Return name, azimuth and range (m) of the strongest target, or of the brightest point of
        the image if there are no targets.
        """
        targets = self.result.first_of("recommended").judged.targets
        image = self.images()["recommended"]
        if targets:
            name = max(targets, key=lambda name: float(targets[name]["peak_db"][0]))
            at = self.result.bench.system.position_of(self.result, name)
            return f"target {name}", *at
        row, column = divmod(int(image.data.abs().argmax()), image.axes[1].n)
        at = [axis.start + i * axis.step for axis, i in zip(image.axes, (row, column), strict=True)]
        return "the brightest point of the window", at[0], at[1]


def _images(result: Result) -> Drawn:
    strip = Strip(result)
    shown = strip.images()
    if len(shown) > 1:
        caption = f"The same window of every image; 0 dB is one level for all, taken from '{next(iter(shown))}'."
        yield "methods", "The same scene by every method", caption, plot.images(shown, **strip.scale)
    caption = (
        "The image of the recommended method in the window that the metrics use, in dB. The two axes have one scale "
        "unless the window is too elongated for that."
    )
    title = strip.result.bench.config.processor["recommended"].title or "recommended"
    yield "image", "Focused image", caption, plot.image(shown["recommended"], title=title, **strip.scale)


def _cuts(result: Result) -> Drawn:
    strip = Strip(result)
    label, *at = strip.strongest()
    images = {n: image for n, image in strip.result.images.items() if n in _CUT_METHODS and image.data.is_complex()}
    found = {name: impulse_cuts(image, (at[0], at[1])) for name, image in images.items()}
    parts = [
        {
            "series": {name: (plot.array(cuts[axis][0]), plot.decibel(cuts[axis][1])) for name, cuts in found.items()},
            "xlabel": f"{axis} from the peak (m)",
            "ylabel": "level (dB)",
            "title": axis,
            "ylim": (-50, 3),
        }
        for axis in IMAGE
    ]
    caption = f"Cuts through {label}, interpolated by a factor of 16. 0 dB is the peak of each curve."
    if found:
        yield "cuts", "Impulse-response cuts", caption, plot.panels(parts)


def _squint(result: Result) -> Drawn:
    """Draw the recommended image beside the rerun that ignores the Doppler centroid."""
    strip = Strip(result)
    margin = strip.result.bench.judging.margin
    for name, method in strip.result.bench.config.processor.items():
        if method.rerun is not None and any(key.endswith("doppler_hz") for key in method.rerun.given):
            wrong = strip.result.images[name]
            shown = {"squint taken into account": strip.images()["recommended"]}
            shown[method.title or name] = wrong.isel(**window(wrong, strip.radar, margin))
            caption = (
                "First: focused at the estimated Doppler centroid. Second: the same data focused as if the beam "
                "pointed exactly sideways. Targets are then displaced and blurred, and false targets appear."
            )
            yield "squint", "With and without the squint", caption, plot.images(shown, **strip.scale)


def _baseband(strip: Strip) -> tuple[float, float] | None:
    """Doppler centroid of the recommended image in Hz: absolute, and within one PRF."""
    centroid = strip.result.first_of("recommended").judged.view.doppler_hz
    if centroid is None:
        return None
    value, prf = float(centroid[0]), strip.radar.prf_hz
    return value, value - prf * round(value / prf)


def _focus_input(strip: Strip) -> Signal:
    return strip.step(focus_name(strip.result.bench.chains["recommended"]), output=False)


def _doppler_spectrum(result: Result) -> Drawn:
    strip = Strip(result)
    centroid = _baseband(strip)
    if centroid is None:
        return
    frequency, power = azimuth_spectrum(_focus_input(strip))
    level = 10 * np.log10(np.maximum(plot.array(power), np.finfo(np.float32).tiny))
    turns = round((centroid[0] - centroid[1]) / strip.radar.prf_hz)
    title = f"centroid {centroid[0]:.1f} Hz = {centroid[1]:.1f} Hz {'-' if turns < 0 else '+'} {abs(turns)} PRF"
    caption = (
        "Azimuth power spectrum of the data before focusing, averaged over range. The dashed line is the Doppler "
        "centroid within one PRF. The number of whole PRFs is estimated from range migration."
    )
    series, marks = {"mean over range": (plot.array(frequency), level)}, {"centroid": centroid[1]}
    figure = plot.curves(series, "baseband Doppler (Hz)", "power (dB)", title, marks)
    yield "doppler_spectrum", "Doppler spectrum", caption, figure


def _increments(result: Result) -> Drawn:
    strip = Strip(result)
    time_s, phase = phase_increments(_focus_input(strip))
    prf, centroid = strip.radar.prf_hz, _baseband(strip)
    doppler = plot.array(phase) * prf / (2 * math.pi)
    series: dict[str, tuple[np.ndarray, np.ndarray]] = {"blocks of lines": (plot.array(time_s), doppler)}
    if centroid is not None:
        series["estimate"] = (plot.array(time_s), np.full(len(doppler), centroid[1]))
        doppler -= prf * np.round((doppler - centroid[1]) / prf)
    caption = (
        "Mean phase increment between adjacent lines, as a frequency (PRF times increment over 2 pi), for blocks of "
        "lines along the strip. It varies with the targets that the beam illuminates; the estimate is one value for "
        "all lines."
    )
    figure = plot.curves(series, "slow time (s)", "phase increment (Hz)")
    yield "phase_increments", "Phase increments along the strip", caption, figure


def _changed(strip: Strip, names: tuple[str, ...], groups: tuple[str, ...]) -> Iterator[tuple[str, Signal, Signal]]:
    """Name, input and output of each stage of the recommended chain that changed its signal."""
    for name, entry in strip.stages.items():
        before, after = strip.step(name, False), strip.step(name, True)
        same = before.data.shape == after.data.shape and torch.equal(before.data, after.data)
        if before.names == after.names == names and group_of(entry["stage"]) in groups and not same:
            yield name, before, after


def _corrections(result: Result) -> Drawn:
    strip = Strip(result)
    for name, before, after in _changed(strip, ("pulse", "range"), ("repair", "own")):
        power = [x.data.abs().square().sum(-1).double().cpu().numpy() for x in (before, after)]
        median = np.median(power[0][power[0] > 0]) if (power[0] > 0).any() else 1.0
        lines = [(np.arange(len(p)), 10 * np.log10(np.maximum(p / median, 1e-6))) for p in power]
        spectra = [plot.array(range_spectrum(x)) for x in (before, after)]
        top = float(spectra[0].max()) or 1.0
        bands = [(_frequency_mhz(strip, len(s)), 10 * np.log10(np.maximum(s / top, 1e-12))) for s in spectra]
        parts = [
            {"series": dict(zip(("before", "after"), drawn)), "xlabel": xlabel, "ylabel": ylabel, "title": title}
            for drawn, xlabel, ylabel, title in (
                (lines, "line", "power (dB)", "power of the lines"),
                (bands, "range frequency (MHz)", "power (dB)", "mean range spectrum"),
            )
        ]
        caption = (
            f"Stage '{name}' ({strip.stages[name]['stage']}). First: power of every line relative to the median line "
            "before the correction. Second: range spectrum, averaged over the lines."
        )
        yield f"correction_{name}", f"Correction: {name}", caption, plot.panels(parts)


def _frequency_mhz(strip: Strip, n: int) -> np.ndarray:
    return plot.array(torch.fft.fftshift(strip.radar.range_frequency_hz(n))) / 1e6


def _contaminated_line(result: Result) -> Drawn:
    """Draw the range spectrum of the line that an interference correction changed most."""
    strip = Strip(result)
    for name, before, after in _changed(strip, ("pulse", "range"), ("repair", "own")):
        if "interference" not in f"{strip.stages[name]['stage']} {name}":
            continue
        removed = (before.data - after.data).abs().square().sum(-1)
        line = int(removed.argmax())
        top = float(torch.fft.fft(before.data[line]).abs().max()) or 1.0
        series = {
            label: (
                _frequency_mhz(strip, s.axes[1].n),
                plot.decibel(torch.fft.fftshift(torch.fft.fft(s.data[line])), top),
            )
            for label, s in (("before", before), ("after", after))
        }
        caption = (
            f"Range spectrum of line {line}, from which the most power was removed. "
            f"{int((removed > 0).sum())} of {len(removed)} lines were changed."
        )
        figure = plot.curves(series, "range frequency (MHz)", "level (dB)", f"line {line}")
        yield "contaminated_line", "Spectrum of a contaminated line", caption, figure


def _response(result: Result) -> Drawn:
    """Draw the estimated response of the channel, with the true one where it is known."""
    strip = Strip(result)
    band_mhz = plot.array(band_grid()) * strip.radar.pulse.bandwidth_hz / 2e6
    truth, parts = strip.result.first.trials.truth, []
    for estimate in strip.result.first_of("recommended").estimates.values():
        for key, title, label in (("phase_rad", "phase", "phase (rad)"), ("amplitude", "amplitude", "amplitude")):
            value = estimate.value.get(key)
            if value is None or value.shape[-1:] != band_mhz.shape:
                continue
            true = [v for name, v in truth.items() if name.endswith(f".{key}") and v.shape[-1:] == band_mhz.shape]
            curves = {"estimate": value, **({"truth": true[0]} if true else {})}
            series = {n: (band_mhz, plot.array(v.reshape(-1, v.shape[-1])[0])) for n, v in curves.items()}
            parts.append({"series": series, "xlabel": "range frequency (MHz)", "ylabel": label, "title": title})
    if parts:
        caption = "Phase and amplitude over the band of the pulse, estimated from bright points of the image."
        yield "response", "Frequency response of the channel", caption, plot.panels(parts)


def _image_corrections(result: Result) -> Drawn:
    """Draw a range cut through the strongest target before and after corrections of the image."""
    strip = Strip(result)
    for name, before, after in _changed(strip, IMAGE, ("repair",)):
        label, *at = strip.strongest()
        cuts = {when: impulse_cuts(x, (at[0], at[1]))["range"] for when, x in (("before", before), ("after", after))}
        series = {when: (plot.array(offset), plot.decibel(level)) for when, (offset, level) in cuts.items()}
        caption = f"Stage '{name}' ({strip.stages[name]['stage']}): range cut through {label} before and after."
        figure = plot.curves(series, "range from the peak (m)", "level (dB)", ylim=(-50, 3))
        yield f"correction_{name}", f"Correction: {name}", caption, figure


def _velocity(result: Result) -> Drawn:
    """Draw the entropy that the velocity search minimises, with fine steps near the estimate."""
    strip = Strip(result)
    bench, first = strip.result.bench, strip.result.first_of("recommended")
    chain = bench.chains["recommended"]
    for name, stage in chain.stages.items():
        if not isinstance(stage, EffectiveVelocity) or first.trace is None:
            continue
        estimate, doppler = first.estimates[name], first.trace.arguments[name].get("doppler_hz")
        value, grid = estimate.value["velocity_m_s"].reshape(-1)[:1], estimate.info["grid_velocity_m_s"]
        near = value + torch.linspace(-_NEAR_STEPS, _NEAR_STEPS, _NEAR_POINTS).to(grid) * (grid[1] - grid[0])
        velocity = torch.cat([grid, near]).sort().values
        doppler = None if doppler is None else doppler.reshape(-1)[0]
        entropy = stage.entropy(strip.step(name, output=False), velocity, doppler)
        series, marks = {"entropy": (plot.array(velocity), plot.array(entropy))}, {"estimate": float(value)}
        figure = plot.curves(series, "effective velocity (m/s)", "entropy (nats)", f"{float(value):.2f} m/s", marks)
        caption = (
            "Entropy of the image of a group of range cells over the velocity that it is focused with. The search "
            "minimises this curve; the dashed line is the minimum that it found."
        )
        yield f"{name}_entropy", "Effective velocity by minimum entropy", caption, figure


DRAW_CASE = (
    *(_images, _cuts, _squint, _doppler_spectrum, _increments, _corrections, _contaminated_line),
    *(_response, _image_corrections, _velocity),
)
