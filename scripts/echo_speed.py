"""Echo synthesis: targets x samples per second and error in complex64, for always-lit and gated
scenes.

    python scripts/echo_speed.py [--targets 4096] [--pulses 256] [--samples 2048] [--threads 1]

A gated scene is counted by the target samples that are actually lit; its rate is lower because
targets enter and leave inside a block of pulses.
"""

from __future__ import annotations

import argparse
import time

import torch

from torchsar import keep_freed_memory
from torchsar.core import Draws
from torchsar.echo import simulate
from torchsar.metrics import error_db
from torchsar.radar import LinearFM, StripmapRadar
from torchsar.scene import AlwaysLit, Dwell, Speckle, StripmapWorld
from torchsar.scene.strip import Beam


def measure(beam: Beam, targets: int, pulses: int, samples: int, repeats: int = 3) -> tuple[float, float, float]:
    """(seconds of the best of `repeats`, lit target samples, error in dB of complex64 against
    complex128).
    """
    radar = StripmapRadar(3.2e9, LinearFM(200e6, 1e-6), 250e6, 4000.0, 7000.0, 700e3, pointing_doppler_hz=0.0)
    length_m = pulses / radar.prf_hz * radar.velocity_m_s
    world = StripmapWorld(Speckle(targets, length_m, 0.6 * (samples - radar.pulse_samples) * radar.range_step_m), beam)
    best = float("inf")
    for _ in range(repeats):
        start = time.perf_counter()
        recording, truth = simulate(radar, world, pulses, samples, Draws(0))
        best = min(best, time.perf_counter() - start)
    exact, _ = simulate(radar, world, pulses, samples, Draws(0), dtype=torch.complex128)
    slow_time = torch.arange(pulses, dtype=torch.float64) / radar.prf_hz
    since = slow_time[:, None] - truth.values["zero_doppler_s"]
    lit = int((beam.weight(since, since, torch.tensor(radar.velocity_m_s)) != 0).sum()) * samples
    return best, lit, float(error_db(recording.signal, exact.signal))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, value in (("targets", 4096), ("pulses", 256), ("samples", 2048), ("threads", 1)):
        parser.add_argument(f"--{name}", type=int, default=value)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    keep_freed_memory()  # as the commands do
    dwell = args.pulses / 4000.0 / 2
    for name, beam in (("always lit", AlwaysLit()), ("gated to half the strip", Dwell(dwell))):
        seconds, lit, error = measure(beam, args.targets, args.pulses, args.samples)
        print(
            f"{name:24s} {lit / seconds / 1e9 / args.threads:6.2f} G target*sample/s per core   "
            f"{seconds:7.2f} s   error {error:6.1f} dB"
        )


if __name__ == "__main__":
    main()
