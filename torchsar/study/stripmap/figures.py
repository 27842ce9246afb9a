"""The pictures of one run, drawn from traces and images."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchsar import plot
from torchsar.core import Signal, Truth
from torchsar.radar import StripmapRadar
from torchsar.repair.response import band_grid
from torchsar.study.build import Case
from torchsar.study.config import Config
from torchsar.study.cuts import impulse_cuts
from torchsar.study.methods import Result, focus_name
from torchsar.study.pictures import Drawn, Picture, draw_all
from torchsar.study.registry import group_of
from torchsar.study.stripmap.judge import expected_places


@dataclass(frozen=True)
class Scene:
    """What the pictures are drawn from."""

    config: Config
    case: Case
    results: Mapping[str, Result]
    window: Mapping[str, tuple[int, int]]

    @property
    def best(self) -> Result:
        return self.results["recommended"]

    @property
    def scale(self) -> dict[str, Any]:
        """Scenes of known points are shown below their peak; of recordings the brightest thousandth
        saturates.
        """
        return (
            {"percentile": 100.0, "dynamic_range_db": 60.0}
            if self.case.targets
            else {"percentile": 99.9, "dynamic_range_db": 50.0}
        )

    @property
    def radar(self) -> StripmapRadar:
        return self.case.recording.radar


def draw(scene: Scene, folder: Path) -> list[Picture]:
    """Every picture that this run has the material for, as PNG files in the folder, in the order of
    reading.
    """
    makers = (
        _image,
        _comparison,
        _cuts,
        _squint,
        _doppler_spectrum,
        _increments,
        _repairs,
        _contaminated_line,
        _response,
        _velocity,
    )
    return draw_all([partial(make, scene) for make in makers], folder)


def _image(scene: Scene) -> Drawn:
    image = scene.best.image.crop(**scene.window)
    caption = (
        "The image of the recommended method over the judged window: range to the right, "
        "azimuth upward, in metres; amplitude in dB."
    )
    yield "image", "Focused image", caption, plot.image(image, title=scene.best.title or "recommended", **scene.scale)


def _comparison(scene: Scene) -> Drawn:
    shown = {
        name: result.image.crop(**scene.window)
        for name, result in scene.results.items()
        if not scene.config.processor[name].rerun
    }
    if len(shown) > 1:
        first = next(iter(shown))
        yield (
            "methods",
            "The same scene by every method",
            f"All images on one scale, that of '{first}'.",
            plot.images(shown, **scene.scale),
        )


def _cuts(scene: Scene) -> Drawn:
    """Impulse-response cuts of the strongest target of the recommended image."""
    compared = [r for name, r in scene.results.items() if name in {"clean", "none", "baseline", "recommended"}]
    place = _strongest(scene)
    if place is None:
        return
    label, azimuth, slant = place
    parts = []
    for axis in ("azimuth", "range"):
        series = {}
        for result in compared:
            offset, level = impulse_cuts(result.image, (azimuth, slant))[axis]
            series[result.name] = (plot.array(offset), plot.decibel(level))
        step = scene.best.image.axis(axis).step
        reach = 24 * step
        parts.append(
            {
                "series": {k: _within(x, y, reach) for k, (x, y) in series.items()},
                "xlabel": f"{axis} from the peak (m)",
                "ylabel": "dB",
                "title": f"{axis}",
                "ylim": (-50, 3),
            }
        )
    yield (
        "cuts",
        "Impulse-response cuts",
        f"Cuts through {label}, band-limited interpolation by 16; 0 dB is each curve's own peak.",
        plot.panels(parts),
    )


def _within(x: np.ndarray, y: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
    inside = np.abs(x) <= reach
    return x[inside], y[inside]


def _strongest(scene: Scene) -> tuple[str, float, float] | None:
    names, azimuth, slant = expected_places(scene.case, scene.best, scene.radar)
    if names:
        image = scene.best.image
        at = [
            torch.as_tensor(axis.index_of(x)).round().long().clamp(0, axis.n - 1)
            for axis, x in zip(image.axes, (azimuth, slant))
        ]
        best = int(image.data[at[0], at[1]].abs().argmax())
        return f"target {names[best]}", float(azimuth[best]), float(slant[best])
    part = scene.best.image.crop(**scene.window)
    flat = int(part.data.abs().argmax())
    row, column = divmod(flat, part.axes[1].n)
    return (
        "the brightest point of the window",
        part.axes[0].start + row * part.axes[0].step,
        part.axes[1].start + column * part.axes[1].step,
    )


def _squint(scene: Scene) -> Drawn:
    """The recommended image beside the rerun that ignores the Doppler centroid."""
    for name, method in scene.config.processor.items():
        if method.rerun is not None and any(key.endswith("doppler_hz") for key in method.rerun.given):
            shown = {
                "squint taken into account": scene.best.image.crop(**scene.window),
                method.title or name: scene.results[name].image.crop(**scene.window),
            }
            caption = (
                "Left: focused about the estimated Doppler centroid. Right: the same data focused as "
                "if the beam looked straight to the side: displaced, smeared, with ghosts."
            )
            yield "squint", "With and without the squint", caption, plot.images(shown, **scene.scale)


def _focus_input(result: Result) -> Signal | None:
    return None if result.trace is None else result.trace.inputs[focus_name(result.chain)]


def azimuth_spectrum(signal: Signal, bins: int = 256) -> tuple[Tensor, Tensor]:
    """Baseband Doppler (Hz) and mean azimuth power spectrum over range, averaged over segments of
    `bins` lines (raised-cosine window).
    """
    data, pulse = signal.data, signal.axes[-2]
    bins = min(bins, pulse.n)
    segments = data[: pulse.n // bins * bins].unflatten(0, (-1, bins))
    window = torch.hann_window(bins, dtype=data.real.dtype, device=data.device)[:, None]
    power = torch.zeros(bins, dtype=torch.float64)
    for segment in segments:
        power += torch.fft.fft(segment * window, dim=0).abs().square().sum(-1).double().cpu()
    frequency = torch.fft.fftshift(torch.fft.fftfreq(bins, pulse.step, dtype=torch.float64))
    return frequency, torch.fft.fftshift(power) / power.max().clamp_min(1e-300)


def _doppler_spectrum(scene: Scene) -> Drawn:
    signal = _focus_input(scene.best)
    if signal is None or "doppler_hz" not in scene.best.used:
        return
    frequency, power = azimuth_spectrum(signal)
    prf, centroid = scene.radar.prf_hz, scene.best.used["doppler_hz"]
    baseband = centroid - prf * round(centroid / prf)
    series = {
        "mean over range": (
            plot.array(frequency),
            10 * np.log10(np.maximum(plot.array(power), np.finfo(np.float32).tiny)),
        )
    }
    title = (
        f"centroid {centroid:.1f} Hz = {baseband:.1f} Hz "
        f"{'-' if centroid < baseband else '+'} {abs(round(centroid / prf))} PRF"
    )
    caption = (
        "Azimuth power spectrum of the data that is focused, averaged over range. The dashed "
        "line is the Doppler centroid inside one PRF; the ambiguity is found from range "
        "migration."
    )
    yield (
        "doppler_spectrum",
        "Doppler spectrum",
        caption,
        plot.curves(series, "baseband Doppler (Hz)", "power (dB)", title, {"centroid": baseband}),
    )


def phase_increments(signal: Signal, blocks: int = 64) -> tuple[Tensor, Tensor]:
    """Slow time (s) of blocks of lines and the mean phase increment between their adjacent lines
    (rad).
    """
    pulse = signal.axes[-2]
    blocks = min(blocks, max(1, (pulse.n - 1) // 2))
    product = (signal.data[:-1].conj() * signal.data[1:]).sum(-1).to(torch.complex128).cpu()
    parts = product.tensor_split(blocks)
    centres = torch.stack(
        [
            pulse.start + pulse.step * (t.float().mean().double() + 0.5)
            for t in torch.arange(pulse.n - 1).tensor_split(blocks)
        ]
    )
    return centres, torch.stack([torch.angle(part.sum()) for part in parts])


def _increments(scene: Scene) -> Drawn:
    signal = _focus_input(scene.best)
    if signal is None:
        return
    time_s, phase = phase_increments(signal)
    prf = scene.radar.prf_hz
    doppler = plot.array(phase) * prf / (2 * math.pi)
    series: dict[str, tuple[np.ndarray, np.ndarray]] = {"blocks of lines": (plot.array(time_s), doppler)}
    if "doppler_hz" in scene.best.used:
        base = scene.best.used["doppler_hz"] - prf * round(scene.best.used["doppler_hz"] / prf)
        doppler -= prf * np.round((doppler - base) / prf)
        series["estimate"] = (plot.array(time_s), np.full(len(doppler), base))
    caption = (
        "Mean phase increment between adjacent lines, in Hz (PRF times increment over 2 pi), "
        "for blocks of lines along the strip. The scene makes it fluctuate; the estimate "
        "averages it."
    )
    yield (
        "phase_increments",
        "Phase increments along the strip",
        caption,
        plot.curves(series, "slow time (s)", "increment (Hz)"),
    )


def _repair_stages(scene: Scene) -> Iterator[tuple[str, Signal, Signal]]:
    """Stages of the recommended chain that changed raw samples, with what went in and came out."""
    trace = scene.best.trace
    stages = scene.config.processor["recommended"].stages
    if trace is None or stages is None:
        return
    for name, entry in stages.items():
        before, after = trace.inputs[name], trace.outputs[name]
        raw = before.names == after.names == ("pulse", "range")
        if (
            raw
            and group_of(entry["stage"]) in ("repair", "own")
            and (before.data.shape != after.data.shape or not torch.equal(before.data, after.data))
        ):
            yield name, before, after


def range_spectrum(signal: Signal) -> Tensor:
    """Power spectrum summed over all lines, centred, (range,)."""
    power = torch.zeros(signal.axes[-1].n, dtype=torch.float64)
    for block in signal.data.split(256):
        power += torch.fft.fft(block).abs().square().sum(0).double().cpu()
    return torch.fft.fftshift(power)


def _frequency_mhz(scene: Scene, n: int) -> np.ndarray:
    return plot.array(torch.fft.fftshift(scene.radar.range_frequency_hz(n))) / 1e6


def _mean_spectrum_db(signal: Signal, reference: float | None = None) -> tuple[np.ndarray, float]:
    power = plot.array(range_spectrum(signal))
    top = reference or float(power.max()) or 1.0
    return 10 * np.log10(np.maximum(power / top, 1e-12)), top


def _line_power_db(signal: Signal, like: Signal) -> np.ndarray:
    """Mean power of the lines over the median line of `like`, dB."""
    power = plot.array(signal.data.abs().square().mean(-1).double())
    whole = plot.array(like.data.abs().square().mean(-1).double())
    return 10 * np.log10(np.maximum(power / (np.median(whole[whole > 0]) if (whole > 0).any() else 1.0), 1e-4))


def _repairs(scene: Scene) -> Drawn:
    """Per repair: power of the lines, and mean range spectrum, before and after."""
    for name, before, after in _repair_stages(scene):
        old, top = _mean_spectrum_db(before)
        new, _ = _mean_spectrum_db(after, top)
        lines = {
            "before": (np.arange(before.axes[0].n), _line_power_db(before, before)),
            "after": (np.arange(after.axes[0].n), _line_power_db(after, before)),
        }
        spectra = {"before": (_frequency_mhz(scene, len(old)), old), "after": (_frequency_mhz(scene, len(new)), new)}
        stage = (scene.config.processor["recommended"].stages or {})[name]["stage"]
        parts = [
            {
                "series": lines,
                "xlabel": "line",
                "ylabel": "power (dB over the median line)",
                "title": "power of the lines",
            },
            {
                "series": spectra,
                "xlabel": "range frequency (MHz)",
                "ylabel": "power (dB)",
                "title": "mean range spectrum",
            },
        ]
        caption = f"Stage '{name}' ({stage}): left, power of every line; right, range spectrum averaged over the lines."
        yield f"repair_{name}", f"Repair: {name}", caption, plot.panels(parts)


def _contaminated_line(scene: Scene) -> Drawn:
    """The range spectrum of the line that an interference repair changed most."""
    stages = scene.config.processor["recommended"].stages or {}
    for name, before, after in _repair_stages(scene):
        if "interference" not in stages[name]["stage"] and "interference" not in name:
            continue
        removed = (before.data - after.data).abs().square().sum(-1)
        line = int(removed.argmax())
        top = float(torch.fft.fft(before.data[line]).abs().max()) or 1.0
        series = {
            label: (
                _frequency_mhz(scene, s.axes[1].n),
                plot.decibel(torch.fft.fftshift(torch.fft.fft(s.data[line])), top),
            )
            for label, s in (("before", before), ("after", after))
        }
        caption = (
            f"Range spectrum of line {line}, the one from which most was removed "
            f"({int((removed > 0).sum())} of {len(removed)} lines were changed)."
        )
        yield (
            "contaminated_line",
            "Spectrum of a contaminated line",
            caption,
            plot.curves(series, "range frequency (MHz)", "dB", f"line {line}"),
        )


def _response(scene: Scene) -> Drawn:
    """Estimated phase and amplitude response of the channel over range frequency, beside the truth
    where it is known.
    """
    band_mhz = plot.array(band_grid()) * scene.radar.pulse.bandwidth_hz / 2e6
    parts = []
    for estimate in scene.best.estimates.values():
        for key, label in (("phase_rad", "phase (rad)"), ("amplitude", "amplitude")):
            if key in estimate.value and estimate.value[key].shape == band_mhz.shape:
                series = {"estimate": (band_mhz, plot.array(estimate.value[key]))}
                true = _true_curve(scene.case.truth, key, len(band_mhz))
                if true is not None:
                    series["truth"] = (band_mhz, plot.array(true))
                parts.append({"series": series, "xlabel": "range frequency (MHz)", "ylabel": label, "title": label})
    if parts:
        yield (
            "response",
            "Response of the whole channel",
            "Phase and amplitude over the band of the pulse, as found from bright places of the image.",
            plot.panels(parts),
        )
    yield from _image_repairs(scene)


def _image_repairs(scene: Scene) -> Drawn:
    """Range cut through the strongest target before and after a repair of the image."""
    place, trace = _strongest(scene), scene.best.trace
    stages = scene.config.processor["recommended"].stages or {}
    for name, entry in stages.items():
        if (
            place is None
            or trace is None
            or group_of(entry["stage"]) != "repair"
            or trace.outputs[name].names != ("azimuth", "range")
        ):
            continue
        before, after = trace.inputs[name], trace.outputs[name]
        if torch.equal(before.data, after.data):
            continue
        cuts = {
            label: impulse_cuts(image, place[1:])["range"] for label, image in (("before", before), ("after", after))
        }
        series = {label: (plot.array(offset), plot.decibel(level)) for label, (offset, level) in cuts.items()}
        caption = f"Stage '{name}' ({entry['stage']}): range cut through {place[0]} before and after."
        yield (
            f"repair_{name}",
            f"Repair: {name}",
            caption,
            plot.curves(series, "range from the peak (m)", "dB", ylim=(-50, 3)),
        )


def _true_curve(truth: Truth | None, key: str, n: int) -> Tensor | None:
    if truth is None:
        return None
    found = [value for name, value in truth.values.items() if name.endswith(f".{key}") and value.shape == (n,)]
    return found[0] if found else None


def _velocity(scene: Scene) -> Drawn:
    """Entropy over velocity, where an estimator kept its grid."""
    for name, estimate in scene.best.estimates.items():
        if "grid_velocity_m_s" in estimate.info and "grid_entropy" in estimate.info:
            grid, cost = (plot.array(estimate.info[key]) for key in ("grid_velocity_m_s", "grid_entropy"))
            value = float(estimate.value["velocity_m_s"])
            caption = (
                "Entropy of a small group of range lines over effective velocity; the dashed line is "
                "the refined minimum."
            )
            figure = plot.curves(
                {"entropy": (grid, cost)},
                "effective velocity (m/s)",
                "entropy (nats)",
                f"{value:.2f} m/s",
                {"estimate": value},
            )
            yield f"{name}_entropy", "Effective velocity by minimum entropy", caption, figure
