"""Tsvetkov 2017: raw stripmap data with receiver impairments, figures 2 to 9.

The pictures of the paper are of recordings of Kondor-E, which are not public, and it prints no
numbers beside them. Short strips with the published bandwidth, each with noise and damage of its
own, show each of the effects; pictures show the first of them.

Tsvetkov 2017: a frame of 10 x 10 km, from raw data to amplitudes, and numbers of the text.

The raw data are noise and points, of the published bandwidth and integration time; carrier, pulse
rate, sampling and range are chosen. The focusing is the paper's: Doppler centroid, velocity of
least entropy in a group of range cells in the middle, omega-K, modulus.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchsar import plot
from torchsar.compensate import DopplerCentroid, EffectiveVelocity, phase_increment
from torchsar.core import Draws, Recording, Signal
from torchsar.echo import ChannelResponse, Impairment, PeriodicJitter, Tone, apply_impairments, simulate
from torchsar.focus import Detect, OmegaK, OmegaKStolt
from torchsar.metrics import impulse_response
from torchsar.radar import LinearFM, StripmapRadar
from torchsar.repair import CorrectJitter, CorrectResponse, EstimateResponse, PilotJitter
from torchsar.repair.contamination import find_contamination
from torchsar.reproduce.item import Check, Item, Paper, given, in_order, number, seeds_of, statement
from torchsar.scene import Dwell, Points, StripmapWorld

log = logging.getLogger("torchsar.reproduce")
# bandwidth and integration time are those of the paper; the other values are a choice
SENSOR = StripmapRadar(
    carrier_hz=3.2e9,
    pulse=LinearFM(bandwidth_hz=200e6, duration_s=3e-6),
    sampling_hz=250e6,
    prf_hz=4000.0,
    velocity_m_s=7000.0,
    near_range_m=694.75e3,
    pointing_doppler_hz=0.0,
    integration_s=1.5,
)
# integration time (s) and middle of the swath (m)
FRAME_DWELL_S, RANGE_M = 1.5, 700e3
# (lines, samples) of the full frame and, in the reduced form, of an aperture and a pulse
SIZES = {False: (11_720, 17_500), True: (7_000, 1_400)}


class _Frame(NamedTuple):
    """Measurements of the processing of a frame: CPU time of each part and wall time (s), threads,
    peak memory of the process (GB), error of the velocity (m/s), and number of samples.
    """

    processor_s: dict[str, float]
    wall_s: float
    threads: int
    peak_gb: float
    velocity_m_s: float
    samples: int


def _raw(lines: int, samples: int, off_m_s: float, slab: int = 1024, step: int = 4096) -> Signal:
    """Simulate noise with three points along track at every `step` range samples.

    The echoes are computed in slabs of `slab` range samples to save memory. off_m_s: true minus
    nominal velocity.
    """
    axes = SENSOR.raw_axes(lines, samples)
    noise = torch.Generator().manual_seed(1)
    data = torch.empty((lines, samples), dtype=torch.complex64)
    torch.view_as_real(data).normal_(generator=noise)
    along = (lines / SENSOR.prf_hz - FRAME_DWELL_S) * SENSOR.velocity_m_s * 0.45
    points = Points([-along, 0.0, along], [0.0] * 3, [3.0] * 3)
    world = StripmapWorld(points, Dwell(FRAME_DWELL_S), velocity_m_s=SENSOR.velocity_m_s + off_m_s)
    for first in range((samples - slab) % step // 2, samples - slab + 1, step):
        radar = replace(SENSOR, near_range_m=SENSOR.near_range_m + first * SENSOR.range_step_m)
        data[:, first : first + slab] += simulate(radar, world, lines, slab, Draws(1))[0].signal.data
    return Signal(data, axes)


def _frame(small: bool, off_m_s: float = 2.0, width: int = 1024) -> _Frame:
    """Process a frame; Doppler centroid and velocity are estimated from `width` range samples in
    the middle.
    """
    lines, samples = SIZES[small]
    raw = _raw(lines, samples, off_m_s)
    focus, doppler = OmegaK(SENSOR), DopplerCentroid(SENSOR)
    near = max(0, (samples - width) // 2)
    group = raw.isel(range=slice(near, near + width))
    velocity = EffectiveVelocity(OmegaK(replace(SENSOR, near_range_m=group.axes[-1].start)), reach_m_s=20.0)
    spent, began = dict[str, float](), time.perf_counter()

    def timed(part: str, work: Callable[..., Any], *given: Any, **values: Any) -> Any:
        log.info("frame: %s", part)
        start = time.process_time()
        result = work(*given, **values)
        spent[part] = time.process_time() - start
        return result

    centroid = timed("Doppler centroid", doppler, group)["doppler_hz"]
    speed = timed("velocity", velocity, group, doppler_hz=centroid)["velocity_m_s"]
    image = timed("focusing", focus, raw, doppler_hz=centroid, velocity_m_s=speed)
    amplitude = timed("modulus", Detect(), image)
    wall = time.perf_counter() - began
    import resource  # the module is not available on all operating systems

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9
    off = float(speed) - SENSOR.velocity_m_s - off_m_s
    return _Frame(spent, wall, torch.get_num_threads(), peak, off, amplitude.data.numel())


def _text_1(seen: _Frame, path: Path) -> list[Check]:
    whole, off = sum(seen.processor_s.values()), abs(seen.velocity_m_s)
    parts = ", ".join(f"{part} {seconds:.1f} s" for part, seconds in seen.processor_s.items())
    ours = (
        f"{seen.samples / 1e6:.0f} million samples in {whole:.0f} s of one processor ({parts}; threads: "
        f"{seen.threads}); {seen.wall_s:.0f} s of wall time on the machine as it was; memory of the process "
        f"{seen.peak_gb:.1f} GB at most"
    )
    return [
        statement("10 x 10 km", "less than a minute", whole < 60 and seen.peak_gb < 8, ours),
        statement("error of the velocity", "1 m/s is allowed", off < 1, f"{off:.2f} m/s"),
    ]


def _half_aperture_m() -> float:
    return SENSOR.velocity_m_s * FRAME_DWELL_S / 2


def migration_change_m(over_m: float = 5000.0) -> float:
    """Compute by how much the range migration changes over a range.

    Args:
        over_m: The range in metres, by default half the frame.

    Returns:
        The change in metres.
    """
    return _half_aperture_m() ** 2 * over_m / (2 * RANGE_M**2)


def _parabola() -> Check:
    rest = _half_aperture_m() ** 4 / (8 * RANGE_M**3)
    phase = 4 * math.pi / SENSOR.wavelength_m * rest
    claim = "enough for 1 to 1.5 s"
    return statement("parabola of the range", claim, phase < math.pi / 4, f"{phase:.3f} rad are left at the ends")


def _velocity_error() -> float:
    """Error of the velocity that causes a phase of pi / 4 at the ends of the aperture."""
    quadratic = 4 * math.pi / SENSOR.wavelength_m * _half_aperture_m() ** 2 / (2 * RANGE_M)
    return math.pi / 4 * SENSOR.velocity_m_s / (2 * quadratic)


# items in the order of the paper
FRAME_ITEMS = (
    Item("Text 1", "time of a frame of 10 x 10 km, by one command", _frame, _text_1),
    given(
        "Text 2",
        "resolution in slant range before weighting",
        number("c / 2B (m)", 0.75, SENSOR.wave_speed_m_s / (2 * SENSOR.pulse.bandwidth_hz), 0.005),
    ),
    given("Text 3", "approximation of the range of a target, Eq. (2)", _parabola()),
    given(
        "Text 4",
        "error of the effective velocity that is allowed",
        number("that leaves pi / 4 at the ends of the aperture (m/s)", 1.0, _velocity_error(), 0.3),
    ),
)


__all__ = ["PAPER"]

# bandwidth of the paper; the other values are chosen, because the paper does not give them
RADAR = StripmapRadar(
    carrier_hz=3.2e9,
    pulse=LinearFM(bandwidth_hz=200e6, duration_s=1.5e-6),
    sampling_hz=250e6,
    prf_hz=2000.0,
    velocity_m_s=7000.0,
    near_range_m=700e3,
    pointing_doppler_hz=1250.0,
    integration_s=0.25,
)
# size of the strip, dwell (s), and Doppler centroid (Hz) of its beam, which exceeds half the pulse
# rate
LINES, SAMPLES, DWELL_S, DOPPLER_HZ = 1024, 1024, 0.25, 1304.0
# one bright point, and weaker ones around it (m)
POINTS = Points(azimuth_m=[0.0, 60.0, -70.0], range_m=[0.0, 40.0, -50.0], amplitude=[1.0, 0.3, 0.3])
# periodic jitter (samples), and a tone in a twentieth of the lines
JITTER = PeriodicJitter((-0.0325, 0.1475, -0.1525, 0.0375))
TONE = Tone(20.0, 31e6, drift_hz=2e6, share=0.05)
# Doppler centroid (Hz) of figure 6, for which a part of the Doppler band exceeds half the pulse
# rate
WRAPPED_HZ = 950.0
# numbers of points, and of blocks of lines, of figure 5
MANY, BLOCKS = 300, 16


def _response_rad(u: Tensor) -> Tensor:
    """Phase response of the channel over the band; -1 and 1 are its edges."""
    return 1.2 * u**3 + 0.5 * torch.sin(6 * math.pi * u)


class _Strip(NamedTuple):
    """A recording without impairments, its image, and the position of the bright point in the
    image.
    """

    recording: Recording
    image: Signal
    seed: int

    @property
    def at_m(self) -> tuple[float, float]:
        line, sample = divmod(int(self.image.data.abs().argmax()), SAMPLES)
        azimuth, range_ = (axis.values() for axis in self.image.axes)
        return float(azimuth[line]), float(range_[sample])

    def impaired(self, **impairments: Impairment) -> tuple[Recording, Mapping[str, Tensor]]:
        return apply_impairments(self.recording, impairments, Draws(self.seed))

    def error_db(self, image: Signal) -> float:
        """Relative error (dB) of an image with respect to the image without impairments."""
        gap = (image.data - self.image.data).norm() / self.image.data.norm()
        return 20 * float(torch.log10(gap))

    def loss_db(self, image: Signal) -> float:
        """Level (dB) by which the peak is below that of the image without impairments."""
        return 20 * float(torch.log10(self.image.data.abs().max() / image.data.abs().max()))


def _focused(signal: Signal, doppler_hz: float) -> Signal:
    image = OmegaK(RADAR, reference="flat", doppler_hz=doppler_hz)(signal)
    assert isinstance(image, Signal)
    return image


def _simulated(targets: Points, doppler_hz: float, seed: int) -> Recording:
    world = StripmapWorld(targets, Dwell(dwell_s=DWELL_S), doppler_hz=doppler_hz, snr_db=20.0)
    return simulate(RADAR, world, LINES, SAMPLES, Draws(seed))[0]


def _strips(small: bool, doppler_hz: float = DOPPLER_HZ) -> list[_Strip]:
    recordings = {seed: _simulated(POINTS, doppler_hz, seed) for seed in seeds_of(small)}
    return [_Strip(one, _focused(one.signal, doppler_hz), seed) for seed, one in recordings.items()]


def _uneven(small: bool) -> list[Recording]:
    """Recordings of points at random positions, which are not evenly distributed over the beam."""
    recordings = []
    for seed in seeds_of(small):
        draws = Draws(seed)
        azimuth, range_ = (w * draws.uniform(name, (MANY,)) for name, w in (("along", 5400.0), ("across", 300.0)))
        level = draws.uniform("level", (MANY,)) ** 4
        points = Points((azimuth - 2700.0).tolist(), (range_ - 150.0).tolist(), level.tolist(), random_phase=True)
        recordings.append(_simulated(points, DOPPLER_HZ, seed))
    return recordings


def _about(strip: _Strip, image: Signal, azimuth_m: float = 250.0, range_m: float = 150.0) -> Signal:
    x, r = strip.at_m
    return plot.within(image, {"azimuth": (x - azimuth_m, x + azimuth_m), "range": (r - range_m, r + range_m)})


def _figure_2(strips: list[_Strip], path: Path) -> list[Check]:
    damaged = [strip.impaired(tone=TONE) for strip in strips]
    data = damaged[0][0].signal
    plot.save(plot.image(data.with_data(data.data.real + 0j), 40, "quadrature of the raw data, with a tone"), path)
    lines = torch.stack([true["tone.contaminated"] for _, true in damaged])
    found = torch.stack([find_contamination(one.signal.data).lines for one, _ in damaged])
    right, wrong = int((found & lines).sum()), int((found & ~lines).sum())
    ours = f"{right} of {int(lines.sum())} lines with the tone found, {wrong} others"
    holds = bool((found == lines).all())
    return [statement("lines with an external signal", "stand out from the others", holds, ours, len(strips))]


def _figure_3(strips: list[_Strip], path: Path) -> list[Check]:
    damaged = [strip.impaired(tone=TONE) for strip in strips]
    lines = torch.stack([true["tone.contaminated"] for _, true in damaged])
    spectra = torch.fft.fftshift(torch.fft.fft(torch.stack([one.signal.data for one, _ in damaged])), dim=-1).abs()
    mhz = 1e-6 * RADAR.sampling_hz * (torch.arange(SAMPLES, dtype=torch.float64) / SAMPLES - 0.5)
    index = {"with the external signal": int(lines[0].nonzero()[0]), "without": int((~lines[0]).nonzero()[0])}
    top = float(spectra[0][lines[0]].max())
    part = {
        "series": {name: (plot.array(mhz), plot.decibel(spectra[0, i], top)) for name, i in index.items()},
        "xlabel": "frequency (MHz)",
        "ylabel": "amplitude (dB)",
        "title": "spectra of two lines",
        "ylim": (-70.0, 2.0),
    }
    plot.save(plot.panels([part]), path, columns=1)
    over = 20 * torch.log10(spectra.amax(-1) / spectra.median(-1).values)
    least, most = float(over[lines].min()), float(over[~lines].max())
    ours = f"peak over median: at least {least:.0f} dB with it, at most {most:.0f} dB without"
    claim = "a narrow peak tells that the line is contaminated"
    return [statement("spectrum", claim, least > most, ours, len(strips))]


def _jittered(strip: _Strip) -> tuple[Signal, Signal]:
    """Images with jitter, and after the correction of the jitter."""
    impaired, _ = strip.impaired(jitter=JITTER)
    found = PilotJitter()(impaired.signal, impaired.aux["pilot"])
    corrected = CorrectJitter()(impaired.signal, found["offset_samples"], found["period"])
    assert isinstance(corrected, Signal)
    return _focused(impaired.signal, DOPPLER_HZ), _focused(corrected, DOPPLER_HZ)


def _figure_4(strips: list[_Strip], path: Path) -> list[Check]:
    images = [_jittered(strip) for strip in strips]
    names = ("with jitter", "jitter corrected")
    shown = {name: _about(strips[0], image) for name, image in zip(names, images[0], strict=True)}
    plot.save(plot.images(shown, 50, percentile=100), path)
    errors = [[strip.error_db(image) for image in pair] for strip, pair in zip(strips, images, strict=True)]
    before, after = min(one for one, _ in errors), max(one for _, one in errors)
    ours = f"error of the image {before:.1f} dB or more, {after:.1f} dB or less after correction"
    return [
        statement("false repeats along range", "are removed by the correction", after < before - 40, ours, len(strips))
    ]


def _figure_5(recordings: list[Recording], path: Path) -> list[Check]:
    found = [phase_increment(one.signal.data, RADAR.prf_hz, (BLOCKS, 1)) for one in recordings]
    blocks = torch.stack([one.info["block_hz"].flatten() for one in found])
    means = torch.stack([one["doppler_baseband_hz"] for one in found])
    true, turns = DOPPLER_HZ - RADAR.prf_hz, 2 * math.pi / RADAR.prf_hz
    line = (torch.arange(BLOCKS, dtype=torch.float64) + 0.5) * LINES / BLOCKS
    part = {
        "series": {"blocks": (plot.array(line), plot.array(turns * blocks[0]))}
        | {
            name: (plot.array(line), plot.array(torch.full_like(line, turns * x)))
            for name, x in (("mean", float(means[0])), ("true", true))
        },
        "xlabel": "line",
        "ylabel": "phase increment (rad)",
        "title": "phase increment along the strip",
    }
    plot.save(plot.panels([part]), path, columns=1)
    spread, error = float(blocks.std(-1).min()), float((means - true).square().mean().sqrt())
    ours = f"blocks scatter by {spread:.1f} Hz or more, their mean is {error:.1f} Hz off (rms)"
    claim = "varies with the scene at a constant squint; the mean tells the centroid"
    return [statement("estimate", claim, error < spread / 2, ours, len(found))]


def _lost(
    strips: list[_Strip], wrong_hz: float, names: tuple[str, str], path: Path
) -> tuple[float, float, list[float], list[float]]:
    """Draw images with a wrong and with the estimated centroid, and return their losses.

    In this order: the least loss (dB) by the wrong centroid, the largest by the estimated one, and
    estimated centroids (Hz) and squints (deg).
    """
    found = [DopplerCentroid(RADAR)(strip.recording.signal) for strip in strips]
    centroids = [float(one["doppler_hz"]) for one in found]
    pairs = [
        [_focused(strip.recording.signal, hz) for hz in (wrong_hz, right_hz)]
        for strip, right_hz in zip(strips, centroids, strict=True)
    ]
    plot.save(plot.images(dict(zip(names, pairs[0], strict=True)), 40, percentile=100), path)
    losses = [[strip.loss_db(image) for image in pair] for strip, pair in zip(strips, pairs, strict=True)]
    squints = [float(one["squint_deg"]) for one in found]
    return min(one for one, _ in losses), max(abs(one) for _, one in losses), centroids, squints


def _figure_6(strips: list[_Strip], path: Path) -> list[Check]:
    lost, kept, centroids, _ = _lost(strips, 0.0, ("centroid ignored", "estimated"), path)
    off = max(abs(hz - WRAPPED_HZ) for hz in centroids)
    ours = (
        f"peak {lost:.1f} dB lower or more without, {kept:.2f} dB or less with the centroid, {off:.2f} Hz off or less"
    )
    claim = "ignored, it displaces and blurs targets"
    return [statement("centroid", claim, lost > 3 and kept < 0.1, ours, len(strips))]


def _figure_7(strips: list[_Strip], path: Path) -> list[Check]:
    lost, kept, _, squints = _lost(strips, DOPPLER_HZ - RADAR.prf_hz, ("a pulse rate off", "squint found"), path)
    true = math.degrees(math.asin(DOPPLER_HZ * RADAR.wavelength_m / (2 * RADAR.velocity_m_s)))
    ours = f"peak {lost:.1f} dB lower or more without the squint, {kept:.2f} dB or less with it"
    claim = "ignored, it smears bright targets to clouds"
    return [
        statement("squint", claim, lost > 10, ours, len(strips)),
        number("error of the squint (deg)", 0.01, [abs(one - true) for one in squints], 0.005, "lower"),
    ]


def _distorted(strip: _Strip) -> tuple[Signal, Signal, Tensor, Tensor]:
    """Image after the channel response and after its correction, and the estimated and the true
    phase over the band.
    """
    impaired, true = strip.impaired(response=ChannelResponse(_response_rad))
    image = _focused(impaired.signal, DOPPLER_HZ)
    phase = EstimateResponse(RADAR)(image)["phase_rad"]
    corrected = CorrectResponse(RADAR)(image, phase)
    assert isinstance(corrected, Signal)
    u = torch.linspace(-1, 1, len(phase), dtype=torch.float64)
    line = torch.stack([torch.ones_like(u), u], -1)
    flat = [x - line @ torch.linalg.lstsq(line, x[:, None]).solution[:, 0] for x in (phase, true["response.phase_rad"])]
    return image, corrected, *flat


def _figure_8(strips: list[_Strip], path: Path) -> list[Check]:
    image, corrected, _, _ = _distorted(strips[0])
    line = int(strips[0].image.data.abs().argmax()) // SAMPLES
    range_ = strips[0].image.axis("range").values() - strips[0].at_m[1]
    near = range_.abs() < 15
    named = {"distorted": image, "corrected": corrected}
    part = {
        "series": {
            name: (plot.array(range_[near]), plot.decibel(x.data[line].abs()[near])) for name, x in named.items()
        },
        "xlabel": "range from the point (m)",
        "ylabel": "amplitude (dB)",
        "title": "response in range",
        "ylim": (-45.0, 2.0),
    }
    plot.save(plot.panels([part]), path, columns=1)
    pairs = [[_pslr_db(strip, x) for x in _distorted(strip)[:2]] for strip in strips]
    before, after = (max(row) for row in zip(*pairs, strict=True))
    ours = f"PSLR {before:.1f} dB, {after:.1f} dB after correction"
    holds = all(with_error > without + 2 for with_error, without in pairs)
    return [statement("side lobe", "high, by the phase error of the channel", holds, ours, len(strips))]


def _pslr_db(strip: _Strip, image: Signal) -> float:
    return float(impulse_response(image, strip.at_m, search_m=20.0)["pslr_range_db"])


def _figure_9(strips: list[_Strip], path: Path) -> list[Check]:
    curves = [_distorted(strip)[2:] for strip in strips]
    u = torch.linspace(-1, 1, len(curves[0][0]), dtype=torch.float64)
    part = {
        "series": {
            name: (plot.array(u), plot.array(x)) for name, x in zip(("estimated", "true"), curves[0], strict=True)
        },
        "xlabel": "frequency over half the bandwidth",
        "ylabel": "phase (rad)",
        "title": "phase of the channel",
    }
    plot.save(plot.panels([part]), path, columns=1)
    inner = u.abs() < 0.95
    left = max(float((found - true)[inner].square().mean().sqrt()) for found, true in curves)
    ours = f"{left:.3f} rad rms off or less over the inner 95 % of the band"
    return [statement("phase error", "is found from the response of points", left < 0.1, ours, len(strips))]


def _step_3a(strips: list[_Strip], path: Path) -> list[Check]:
    """Compare the change of the range migration over half the published frame with its effect on a
    short strip.
    """
    stolt = OmegaKStolt(RADAR, reference="flat", doppler_hz=DOPPLER_HZ)(strips[0].recording.signal)
    change = migration_change_m()
    quarter = SENSOR.wave_speed_m_s / (8 * SENSOR.pulse.bandwidth_hz)
    ours = (
        f"not required in the frame of Text 1: the migration changes by {change:.2f} m over it, a quarter of a cell is "
        f"{quarter:.2f} m; the image of a short strip changes by {strips[0].error_db(stolt):.0f} dB"
    )
    return [statement("equalisation of the range curves", "only if required", change < quarter, ours)]


RECORDINGS = "a radar image of a recording of Kondor-E, which is not public"
PAPER = Paper(
    "stripmap",
    "O. E. Tsvetkov, Features of radar image formation in the detailed continuous modes of the Kondor-E SAR, 2017",
    in_order(
        Item("Figure 1", "radar image of a frame", why=RECORDINGS, kind="unpublished"),
        Item("Figure 2", "raw data with an external signal", _strips, _figure_2),
        Item("Figure 3", "spectrum of a line with an external signal", _strips, _figure_3),
        Item("Figure 4", "image with and without jitter of the converter", _strips, _figure_4),
        Item("Figure 5", "phase increment along the strip", _uneven, _figure_5),
        Item(
            "Figure 6",
            "image without and with the Doppler centroid",
            partial(_strips, doppler_hz=WRAPPED_HZ),
            _figure_6,
        ),
        Item("Figure 7", "image with and without the squint", _strips, _figure_7),
        Item("Figure 8", "side lobe of the response in range", _strips, _figure_8),
        Item("Figure 9", "phase of the channel over the band", _strips, _figure_9),
        Item("Figure 10", "radar image and photograph of a dam", why=RECORDINGS, kind="unpublished"),
        Item("Figure 11", "radar image and photograph of an airbase", why=RECORDINGS, kind="unpublished"),
        *FRAME_ITEMS,
        Item("Text 5", "step 3a of the focusing, replaced by Stolt interpolation", _strips, _step_3a),
    ),
)
