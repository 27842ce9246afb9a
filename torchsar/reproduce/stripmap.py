"""Tsvetkov 2017: raw stripmap data with receiver impairments, figures 2 to 9.

The pictures of the paper are of recordings of Kondor-E, which are not public, and it prints no
numbers beside them. A short strip with the published bandwidth shows each of the effects.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from torchsar import plot
from torchsar.compensate import DopplerCentroid, phase_increment
from torchsar.core import Draws, Recording, Signal
from torchsar.echo import ChannelResponse, Impairment, PeriodicJitter, Tone, apply_impairments, simulate
from torchsar.focus import OmegaK
from torchsar.metrics import impulse_response
from torchsar.radar import LinearFM, StripmapRadar
from torchsar.repair import CorrectJitter, CorrectResponse, EstimateResponse, PilotJitter
from torchsar.repair.contamination import find_contamination
from torchsar.reproduce.item import Check, Item, Paper, in_order, number, statement
from torchsar.scene import Dwell, Points, StripmapWorld

__all__ = ["PAPER"]

# bandwidth of the paper; the rest is chosen, as it gives none of it
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
# size of the strip, dwell (s), and centroid (Hz) of its beam, which is beyond half the pulse rate
LINES, SAMPLES, DWELL_S, DOPPLER_HZ = 1024, 1024, 0.25, 1304.0
# one bright point, and weaker ones about it (m)
POINTS = Points(azimuth_m=[0.0, 60.0, -70.0], range_m=[0.0, 40.0, -50.0], amplitude=[1.0, 0.3, 0.3])
# periodic jitter (samples), and a tone in a twentieth of the lines
JITTER = PeriodicJitter((-0.0325, 0.1475, -0.1525, 0.0375))
TONE = Tone(20.0, 31e6, drift_hz=2e6, share=0.05)
# centroid (Hz) of figure 6, with a part of the Doppler band beyond half the pulse rate
WRAPPED_HZ = 950.0
# points and blocks of lines of figure 5
MANY, BLOCKS = 300, 16


def _response_rad(u: Tensor) -> Tensor:
    """Phase of the channel over the band; -1 and 1 are its edges."""
    return 1.2 * u**3 + 0.5 * torch.sin(6 * math.pi * u)


class _Strip(NamedTuple):
    """A recording without impairments, its image, and the place of the bright point in it."""

    recording: Recording
    image: Signal

    @property
    def at_m(self) -> tuple[float, float]:
        line, sample = divmod(int(self.image.data.abs().argmax()), SAMPLES)
        azimuth, range_ = (axis.values() for axis in self.image.axes)
        return float(azimuth[line]), float(range_[sample])

    def impaired(self, **impairments: Impairment) -> tuple[Recording, Mapping[str, Tensor]]:
        return apply_impairments(self.recording, impairments, Draws(1))

    def error_db(self, image: Signal) -> float:
        """Power of the difference to the image without impairments, over its power."""
        gap = (image.data - self.image.data).norm() / self.image.data.norm()
        return 20 * float(torch.log10(gap))

    def loss_db(self, image: Signal) -> float:
        """Peak below that of the image without impairments."""
        return 20 * float(torch.log10(self.image.data.abs().max() / image.data.abs().max()))


def _focused(signal: Signal, doppler_hz: float) -> Signal:
    image = OmegaK(RADAR, reference="flat", doppler_hz=doppler_hz)(signal)
    assert isinstance(image, Signal)
    return image


def _simulated(targets: Points, doppler_hz: float) -> Recording:
    world = StripmapWorld(targets, Dwell(dwell_s=DWELL_S), doppler_hz=doppler_hz, snr_db=20.0)
    return simulate(RADAR, world, LINES, SAMPLES, Draws(1))[0]


def _strip(small: bool, doppler_hz: float = DOPPLER_HZ) -> _Strip:
    """The reduced form is the full one."""
    recording = _simulated(POINTS, doppler_hz)
    return _Strip(recording, _focused(recording.signal, doppler_hz))


def _uneven(small: bool) -> Recording:
    """Points at random places, wherever the beam looks; the reduced form is the full one."""
    draws = Draws(1)
    azimuth, range_ = (width * draws.uniform(name, (MANY,)) for name, width in (("along", 5400.0), ("across", 300.0)))
    level = draws.uniform("level", (MANY,)) ** 4
    points = Points((azimuth - 2700.0).tolist(), (range_ - 150.0).tolist(), level.tolist(), random_phase=True)
    return _simulated(points, DOPPLER_HZ)


def _about(strip: _Strip, image: Signal, azimuth_m: float = 250.0, range_m: float = 150.0) -> Signal:
    x, r = strip.at_m
    return plot.within(image, {"azimuth": (x - azimuth_m, x + azimuth_m), "range": (r - range_m, r + range_m)})


def _figure_2(strip: _Strip, path: Path) -> list[Check]:
    impaired, true = strip.impaired(tone=TONE)
    data = impaired.signal
    plot.save(plot.image(data.with_data(data.data.real + 0j), 40, "quadrature of the raw data, with a tone"), path)
    found, lines = find_contamination(data.data).lines, true["tone.contaminated"]
    right, wrong = int((found & lines).sum()), int((found & ~lines).sum())
    ours = f"{right} of {int(lines.sum())} lines with the tone found, {wrong} others"
    return [statement("lines with an external signal", "stand out from the others", bool((found == lines).all()), ours)]


def _figure_3(strip: _Strip, path: Path) -> list[Check]:
    impaired, true = strip.impaired(tone=TONE)
    lines = true["tone.contaminated"]
    spectra = torch.fft.fftshift(torch.fft.fft(impaired.signal.data), dim=-1).abs()
    mhz = 1e-6 * RADAR.sampling_hz * (torch.arange(SAMPLES, dtype=torch.float64) / SAMPLES - 0.5)
    index = {"with the external signal": int(lines.nonzero()[0]), "without": int((~lines).nonzero()[0])}
    top = float(spectra[lines].max())
    part = {
        "series": {name: (plot.array(mhz), plot.decibel(spectra[i], top)) for name, i in index.items()},
        "xlabel": "frequency (MHz)",
        "ylabel": "amplitude (dB)",
        "title": "spectra of two lines",
        "ylim": (-70.0, 2.0),
    }
    plot.save(plot.panels([part]), path, columns=1)
    over = 20 * torch.log10(spectra.amax(-1) / spectra.median(-1).values)
    least, most = float(over[lines].min()), float(over[~lines].max())
    ours = f"peak over median: at least {least:.0f} dB with it, at most {most:.0f} dB without"
    return [statement("spectrum", "a narrow peak tells that the line is contaminated", least > most, ours)]


def _figure_4(strip: _Strip, path: Path) -> list[Check]:
    impaired, _ = strip.impaired(jitter=JITTER)
    found = PilotJitter()(impaired.signal, impaired.aux["pilot"])
    corrected = CorrectJitter()(impaired.signal, found["offset_samples"], found["period"])
    assert isinstance(corrected, Signal)
    images = {
        "with jitter": _focused(impaired.signal, DOPPLER_HZ),
        "jitter corrected": _focused(corrected, DOPPLER_HZ),
    }
    shown = {name: _about(strip, image) for name, image in images.items()}
    plot.save(plot.images(shown, 50, percentile=100), path)
    before, after = (strip.error_db(image) for image in images.values())
    ours = f"error of the image {before:.1f} dB, {after:.1f} dB after correction"
    return [statement("false repeats along range", "are removed by the correction", after < before - 40, ours)]


def _figure_5(recording: Recording, path: Path) -> list[Check]:
    found = phase_increment(recording.signal.data, RADAR.prf_hz, (BLOCKS, 1))
    block = found.info["block_hz"].flatten()
    mean, true = float(found["doppler_baseband_hz"]), DOPPLER_HZ - RADAR.prf_hz
    turns = 2 * math.pi / RADAR.prf_hz
    line = (torch.arange(BLOCKS, dtype=torch.float64) + 0.5) * LINES / BLOCKS
    part = {
        "series": {"blocks": (plot.array(line), plot.array(turns * block))}
        | {
            name: (plot.array(line), plot.array(torch.full_like(line, turns * x)))
            for name, x in (("mean", mean), ("true", true))
        },
        "xlabel": "line",
        "ylabel": "phase increment (rad)",
        "title": "phase increment along the strip",
    }
    plot.save(plot.panels([part]), path, columns=1)
    spread, error = float(block.std()), abs(mean - true)
    ours = f"blocks scatter by {spread:.1f} Hz, their mean is {error:.1f} Hz off"
    claim = "varies with the scene at a constant squint; the mean tells the centroid"
    return [statement("estimate", claim, error < spread / 2, ours)]


def _figure_6(strip: _Strip, path: Path) -> list[Check]:
    doppler = float(DopplerCentroid(RADAR)(strip.recording.signal)["doppler_hz"])
    images = {
        "centroid ignored": _focused(strip.recording.signal, 0.0),
        "estimated": _focused(strip.recording.signal, doppler),
    }
    plot.save(plot.images(images, 40, percentile=100), path)
    lost, kept = (strip.loss_db(image) for image in images.values())
    off = doppler - WRAPPED_HZ
    ours = f"peak {lost:.1f} dB lower without, {kept:.2f} dB with the centroid, which is {off:+.2f} Hz off"
    return [statement("centroid", "ignored, it displaces and blurs targets", lost > 3 and abs(kept) < 0.1, ours)]


def _figure_7(strip: _Strip, path: Path) -> list[Check]:
    found = DopplerCentroid(RADAR)(strip.recording.signal)
    wrong = _focused(strip.recording.signal, DOPPLER_HZ - RADAR.prf_hz)
    right = _focused(strip.recording.signal, float(found["doppler_hz"]))
    plot.save(plot.images({"squint found": right, "a pulse rate off": wrong}, 40, percentile=100), path)
    true = math.degrees(math.asin(DOPPLER_HZ * RADAR.wavelength_m / (2 * RADAR.velocity_m_s)))
    ours = f"peak {strip.loss_db(wrong):.1f} dB lower without the squint, {strip.loss_db(right):.2f} dB with it"
    return [
        statement("squint", "ignored, it smears bright targets to clouds", strip.loss_db(wrong) > 10, ours),
        number("error of the squint (deg)", 0.01, [abs(float(found["squint_deg"]) - true)], 0.005, "lower"),
    ]


def _distorted(strip: _Strip) -> tuple[Signal, Signal, Tensor, Tensor]:
    """Image through the channel and after correction; estimated and true phase over the band."""
    impaired, true = strip.impaired(response=ChannelResponse(_response_rad))
    image = _focused(impaired.signal, DOPPLER_HZ)
    phase = EstimateResponse(RADAR)(image)["phase_rad"]
    corrected = CorrectResponse(RADAR)(image, phase)
    assert isinstance(corrected, Signal)
    u = torch.linspace(-1, 1, len(phase), dtype=torch.float64)
    line = torch.stack([torch.ones_like(u), u], -1)
    flat = [x - line @ torch.linalg.lstsq(line, x[:, None]).solution[:, 0] for x in (phase, true["response.phase_rad"])]
    return image, corrected, *flat


def _figure_8(strip: _Strip, path: Path) -> list[Check]:
    image, corrected, _, _ = _distorted(strip)
    line = int(strip.image.data.abs().argmax()) // SAMPLES
    range_ = strip.image.axis("range").values() - strip.at_m[1]
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
    before, after = (float(impulse_response(x, strip.at_m, search_m=20.0)["pslr_range_db"]) for x in named.values())
    ours = f"PSLR {before:.1f} dB, {after:.1f} dB after correction"
    return [statement("side lobe", "high, by the phase error of the channel", before > after + 2, ours)]


def _figure_9(strip: _Strip, path: Path) -> list[Check]:
    _, _, found, true = _distorted(strip)
    u = torch.linspace(-1, 1, len(found), dtype=torch.float64)
    part = {
        "series": {name: (plot.array(u), plot.array(x)) for name, x in (("estimated", found), ("true", true))},
        "xlabel": "frequency over half the bandwidth",
        "ylabel": "phase (rad)",
        "title": "phase of the channel",
    }
    plot.save(plot.panels([part]), path, columns=1)
    inner = u.abs() < 0.95
    left = float((found - true)[inner].square().mean().sqrt())
    ours = f"{left:.3f} rad rms off over the inner 95 % of the band"
    return [statement("phase error", "is found from the response of points", left < 0.1, ours)]


RECORDINGS = "a radar image of a recording of Kondor-E, which is not public"
PAPER = Paper(
    "stripmap",
    "O. E. Tsvetkov, Features of radar image formation in the detailed continuous modes of the Kondor-E SAR, 2017",
    in_order(
        Item("Figure 1", "radar image of a frame", why=RECORDINGS),
        Item("Figure 2", "raw data with an external signal", of=_strip, make=_figure_2),
        Item("Figure 3", "spectrum of a line with an external signal", of=_strip, make=_figure_3),
        Item("Figure 4", "image with and without jitter of the converter", of=_strip, make=_figure_4),
        Item("Figure 5", "phase increment along the strip", of=_uneven, make=_figure_5),
        Item(
            "Figure 6",
            "image without and with the Doppler centroid",
            of=partial(_strip, doppler_hz=WRAPPED_HZ),
            make=_figure_6,
        ),
        Item("Figure 7", "image with and without the squint", of=_strip, make=_figure_7),
        Item("Figure 8", "side lobe of the response in range", of=_strip, make=_figure_8),
        Item("Figure 9", "phase of the channel over the band", of=_strip, make=_figure_9),
        Item("Figure 10", "radar image and photograph of a dam", why=RECORDINGS),
        Item("Figure 11", "radar image and photograph of an airbase", why=RECORDINGS),
    ),
)
