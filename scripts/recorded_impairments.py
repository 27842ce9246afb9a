"""Impair a recorded raw block, correct it, and compare the images: one line per impairment.

    python scripts/recorded_impairments.py PATH.npz [--seed 0] [--only lost tone] [--threads 2]

rho is the correlation of the complex images inside the window of full apertures and full
compression, against the unimpaired recording; both are focused with the Doppler centroid found on
the unimpaired one, so that only the correction is assessed.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from torchsar.compensate import DopplerCentroid
from torchsar.core import Draws, Recording, Signal
from torchsar.echo import (
    ChannelImbalance,
    ChannelResponse,
    Impairment,
    LostGaps,
    LostLines,
    PeriodicJitter,
    Quantiser,
    Tone,
    WideInterferer,
    apply_impairments,
)
from torchsar.focus import OmegaK
from torchsar.io import read_stripmap
from torchsar.metrics import correlation
from torchsar.repair import (
    BlindJitter,
    CorrectImbalance,
    CorrectJitter,
    CorrectResponse,
    EstimateImbalance,
    EstimateResponse,
    LineIntegrity,
    NotchInterference,
    PilotJitter,
    SparseFill,
    SubtractInterference,
    ZeroFill,
)
from torchsar.repair.response import band_power

MARGIN_LINES, MARGIN_SAMPLES = 330, 1368


@dataclass
class Bench:
    """A recording, its focuser and its unimpaired image."""

    recording: Recording
    doppler_hz: Tensor
    velocity_m_s: float = 7066.0
    clean: Signal = field(init=False)

    def __post_init__(self) -> None:
        self.clean = self.focus(self.recording.signal)

    def focus(self, signal: Signal) -> Signal:
        return OmegaK(self.recording.radar, velocity_m_s=self.velocity_m_s)(signal, doppler_hz=self.doppler_hz)

    def window(self, image: Signal) -> Signal:
        return image.isel(azimuth=slice(MARGIN_LINES, -MARGIN_LINES), range=slice(0, -MARGIN_SAMPLES))

    def rho(self, image: Signal) -> float:
        return float(correlation(self.window(image), self.window(self.clean)))


def fill_sparse(bench: Bench, impaired: Recording) -> Signal:
    signal, lines = LineIntegrity()(impaired.signal, impaired.aux["line_number"])
    stage = SparseFill(bench.recording.radar, velocity_m_s=bench.velocity_m_s)
    return bench.focus(stage(signal, lines["missing"], doppler_hz=bench.doppler_hz))


def fill_zero(bench: Bench, impaired: Recording) -> Signal:
    signal, lines = LineIntegrity()(impaired.signal, impaired.aux["line_number"])
    return bench.focus(ZeroFill()(signal, lines["missing"]))


def subtract(bench: Bench, impaired: Recording) -> Signal:
    return bench.focus(SubtractInterference()(impaired.signal)[0])


def notch(bench: Bench, impaired: Recording) -> Signal:
    return bench.focus(NotchInterference()(impaired.signal)[0])


def jitter_pilot(bench: Bench, impaired: Recording) -> Signal:
    found = PilotJitter()(impaired.signal, impaired.aux["pilot"])
    return bench.focus(CorrectJitter()(impaired.signal, found["offset_samples"], found["period"]))


def jitter_blind(bench: Bench, impaired: Recording) -> Signal:
    found = BlindJitter()(impaired.signal)
    return bench.focus(CorrectJitter()(impaired.signal, found["offset_samples"], found["period"]))


def response(bench: Bench, impaired: Recording) -> Signal:
    image = bench.focus(impaired.signal)
    found = EstimateResponse(bench.recording.radar)(image)
    return CorrectResponse(bench.recording.radar)(image, found["phase_rad"])


def amplitude(bench: Bench, impaired: Recording) -> Signal:
    image = bench.focus(impaired.signal)
    found = EstimateResponse(bench.recording.radar, expected_power=band_power(bench.clean.data))(image)
    return CorrectResponse(bench.recording.radar)(image, torch.zeros_like(found["phase_rad"]), found["amplitude"])


def imbalance(bench: Bench, impaired: Recording) -> Signal:
    found = EstimateImbalance()(impaired.signal)
    return bench.focus(CorrectImbalance()(impaired.signal, found["gain"], found["phase_rad"]))


def nothing(bench: Bench, impaired: Recording) -> Signal:
    return bench.focus(impaired.signal)


def without_shift(curve: Callable[[Tensor], Tensor]) -> Callable[[Tensor], Tensor]:
    """The curve less its straight line over the band: a constant and a slope are a phase and a
    shift, which no processor can see.
    """
    u = torch.linspace(-1, 1, 2001, dtype=torch.float64)
    line = torch.linalg.lstsq(torch.stack([torch.ones_like(u), u], -1), curve(u)[:, None]).solution[:, 0]
    return lambda v: curve(v) - line[0] - line[1] * v


@dataclass(frozen=True)
class Row:
    name: str
    impairments: Mapping[str, Impairment]
    repair: Callable[[Bench, Recording], Signal]
    at_least: float


def rows(radar_band_hz: float, fs_hz: float) -> list[Row]:
    def tone(level: float, **more: float) -> dict[str, Impairment]:
        return {"tone": Tone(level, 0.17 * radar_band_hz, drift_hz=0.02 * radar_band_hz, **more)}  # type: ignore[arg-type]

    period_8 = (
        0.1 * math.sqrt(2) * torch.cos(torch.tensor([0.3, 2.1, 4.4, 1.2, 5.9, 3.3, 0.9, 2.7], dtype=torch.float64))
    )
    jitter = {"jitter": PeriodicJitter((period_8 - period_8.mean()).tolist())}
    lost = [
        Row(f"lost lines {share:.0%}", {"lost": LostLines(fraction=share)}, fill_sparse, bar)
        for share, bar in ((0.01, 0.998), (0.05, 0.991), (0.20, 0.96))
    ]
    tones = [Row(f"tone {level} dB", tone(level), subtract, 0.999) for level in (0, 10, 20, 30)]
    coarse = [
        Row(f"tone {level} dB, 4 bit", {**tone(level), "converter": Quantiser(4)}, subtract, bar)
        for level, bar in ((0, 0.988), (10, 0.958), (20, 0.751), (30, 0.369))
    ]
    wide = [
        Row(f"200 kHz wide, {level} dB", {"wide": WideInterferer(level, 0.17 * radar_band_hz, 200e3)}, subtract, bar)
        for level, bar in ((10, 0.985), (20, 0.975))
    ]
    curves: list[tuple[str, Callable[[Tensor], Tensor], float]] = [
        ("3 rad quadratic", lambda u: 3 * u.square(), 0.997),
        ("3 rad cubic", lambda u: 3 * u**3, 0.997),
        ("0.8 rad ripple", lambda u: 0.8 * torch.sin(3 * math.pi * u), 0.997),
        ("12 rad quadratic, 8 rad cubic", lambda u: 12 * u.square() + 8 * u**3, 0.99),
    ]
    phases = [
        Row(f"range phase {name}", {"response": ChannelResponse(without_shift(curve))}, response, bar)
        for name, curve, bar in curves
    ]
    slope = ChannelResponse(None, lambda u: 10 ** ((3 * u + 1.5 * torch.cos(4 * math.pi * u)) / 20))
    return [
        *lost,
        Row("five gaps of 8 lines", {"gaps": LostGaps(5, 8)}, fill_sparse, 0.993),
        *tones,
        Row("tone on 20 % of lines, 30 dB", tone(30, share=0.2), subtract, 0.999),
        *coarse,
        *wide,
        Row("clean through subtraction", {}, subtract, 0.9999),
        Row("jitter period 8, pilot", jitter, jitter_pilot, 0.9999),
        Row("jitter period 8, blind", jitter, jitter_blind, 0.9999),
        *phases,
        Row("amplitude 6 dB slope, 3 dB ripple", {"response": slope}, amplitude, 0.995),
        Row(
            "two channels, 1.2 at 60 deg",
            {"channels": ChannelImbalance((1.0, 1.2), (0.0, math.pi / 3))},
            imbalance,
            0.9999,
        ),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("path")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="*", default=[""], help="words; rows whose names hold one of them are run")
    parser.add_argument("--threads", type=int, default=2)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    recording = read_stripmap(args.path)
    bench = Bench(recording, DopplerCentroid(recording.radar)(recording.signal)["doppler_hz"])
    print(f"{'impairment':36s} {'untreated':>9s} {'corrected':>9s} {'at least':>9s} {'seconds':>8s}")
    for row in rows(recording.radar.pulse.bandwidth_hz, recording.radar.sampling_hz):
        if not any(word in row.name for word in args.only):
            continue
        impaired, _ = apply_impairments(recording, row.impairments, Draws(args.seed, case=row.name))
        start = time.perf_counter()
        repaired = row.repair(bench, impaired)
        seconds = time.perf_counter() - start
        print(
            f"{row.name:36s} {bench.rho(nothing(bench, impaired)):9.4f} {bench.rho(repaired):9.4f} "
            f"{row.at_least:9.4f} {seconds:8.1f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
