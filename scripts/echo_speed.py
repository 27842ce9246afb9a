"""Echo synthesis: targets x samples per second of the systems with few and many targets, and the
error in complex64.

    python scripts/echo_speed.py [--targets 64 4096] [--pulses 64] [--samples 2048] [--threads 1]

Times are processor times. A gated scene is counted by the target samples that are actually lit; its
rate is lower because targets enter and leave inside a block of pulses. Where finufft is installed,
the phase history is also computed by one of its calls for each pulse, with the geometry in numpy.
"""

from __future__ import annotations

import argparse
import importlib.util
import time
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from torchsar import keep_freed_memory
from torchsar.core import Draws
from torchsar.echo import bistatic_echo, ladar_echo, path_echo, simulate
from torchsar.metrics import error_db
from torchsar.radar import AntennaPath, InverseRadar, LinearFM, StripmapRadar, TriangularLadar
from torchsar.reproduce.geo.sensor import INTEGRATION_S, RADAR
from torchsar.scene import AlwaysLit, BandLimited, Dwell, MovingPoints, Scatterers, Speckle, StripmapWorld
from torchsar.scene.strip import Beam

PATH = InverseRadar(carrier_hz=9.6e9, bandwidth_hz=600e6, prf_hz=200.0)
Echo = Callable[[torch.dtype], Tensor]


def best_s(work: Callable[[], object], repeats: int = 3) -> float:
    """Processor time in seconds of the fastest of some repeats."""
    best = float("inf")
    for _ in range(repeats):
        start = time.process_time()
        work()
        best = min(best, time.process_time() - start)
    return best


def measure(beam: Beam, targets: int, pulses: int, samples: int, repeats: int = 3) -> tuple[float, float, float]:
    """(seconds of the best of `repeats`, lit target samples, error in dB of complex64 against
    complex128) of a strip.
    """
    radar = StripmapRadar(3.2e9, LinearFM(200e6, 1e-6), 250e6, 4000.0, 7000.0, 700e3, pointing_doppler_hz=0.0)
    length_m = pulses / radar.prf_hz * radar.velocity_m_s
    world = StripmapWorld(Speckle(targets, length_m, 0.6 * (samples - radar.pulse_samples) * radar.range_step_m), beam)
    best = best_s(lambda: simulate(radar, world, pulses, samples, Draws(0)), repeats)
    recording, truth = simulate(radar, world, pulses, samples, Draws(0))
    exact, _ = simulate(radar, world, pulses, samples, Draws(0), dtype=torch.complex128)
    slow_time = torch.arange(pulses, dtype=torch.float64) / radar.prf_hz
    since = slow_time[:, None] - truth.values["zero_doppler_s"]
    lit = int((beam.weight(since, since, torch.tensor(radar.velocity_m_s)) != 0).sum()) * samples
    return best, lit, float(error_db(recording.signal, exact.signal))


def places(targets: int) -> Tensor:
    """Random places, -0.5..0.5 along two axes, float64 (2, target)."""
    return torch.rand(2, targets, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) - 0.5


def path(targets: int, pulses: int) -> tuple[AntennaPath, Tensor]:
    """An antenna that flies straight, and points on the ground."""
    along = 0.5 * (torch.arange(pulses, dtype=torch.float64) - pulses / 2)
    position = torch.stack([torch.full_like(along, -3535.0), along, torch.full_like(along, 3535.0)], -1)
    points = torch.stack([*(80 * places(targets)), torch.zeros(targets, dtype=torch.float64)], -1)
    return AntennaPath(position, None, 2 * position.norm(dim=-1)), points


def echoes(targets: int, pulses: int, samples: int) -> dict[str, tuple[float, Echo]]:
    """Target samples, and the echo in a precision, of the systems beside the strip."""
    y, x = places(targets)
    antennas, points = path(targets, pulses)
    still = [0.0] * targets
    swath_m = 0.5 * samples * RADAR.range_step_m
    movers = MovingPoints(still, still, (100 * y).tolist(), (swath_m * x).tolist()).movers(RADAR, Draws(0))
    ladar = TriangularLadar(1.934e14, 5e9, 16e-6, samples / 8e-6, 60.0, 3000.0)
    cubes = Scatterers(y, 2.5 * x, torch.ones(targets, dtype=torch.complex128))
    gate, count = BandLimited(INTEGRATION_S), targets * pulses * samples
    return {
        "path": (count, lambda dtype: path_echo(antennas, points, torch.ones(1, targets), PATH, samples, dtype)),
        "geo": (3 * count, lambda dtype: bistatic_echo(movers, RADAR, pulses, samples, gate=gate, dtype=dtype)),
        "sal": (2 * count, lambda dtype: ladar_echo(cubes, ladar, pulses, dtype=dtype)),
    }


def by_finufft(targets: int, pulses: int, samples: int) -> Callable[[], np.ndarray]:
    """The phase history of `path` by a call of finufft for each pulse."""
    import finufft  # pyright: ignore[reportMissingImports]

    antennas, points = path(targets, pulses)
    position, where, reference = (x.numpy() for x in (antennas.transmitter_m, points, antennas.reference_m))

    def history() -> np.ndarray:
        delay = (2 * np.linalg.norm(position[:, None] - where, axis=-1) - reference[:, None]) / PATH.wave_speed_m_s
        turns = PATH.carrier_hz * delay
        value = np.exp(-2j * np.pi * (turns - np.round(turns)).astype(np.float32)).astype(np.complex64)
        at = (-2 * np.pi * PATH.bandwidth_hz / samples * delay).astype(np.float32)
        lines = [finufft.nufft1d1(*pair, samples, eps=1e-6, isign=1, nthreads=1) for pair in zip(at, value)]
        return np.stack(lines)

    return history


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--targets", type=int, nargs="+", default=[64, 4096])
    for name, value in (("pulses", 64), ("samples", 2048), ("threads", 1)):
        parser.add_argument(f"--{name}", type=int, default=value)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    keep_freed_memory()  # as the commands do

    def show(name: str, targets: int, seconds: float, count: float, error: float) -> None:
        rate = count / seconds / 1e9 / args.threads
        print(f"{name:24s} {targets:6d} targets {rate:6.2f} G target*sample/s per core   error {error:6.1f} dB")

    dwell = args.pulses / 4000.0 / 2
    for targets in args.targets:
        for name, beam in (("stripmap", AlwaysLit()), ("stripmap, half lit", Dwell(dwell))):
            show(name, targets, *measure(beam, targets, args.pulses, args.samples))
        exact: dict[str, Tensor] = {}
        for name, (count, echo) in echoes(targets, args.pulses, args.samples).items():
            exact[name] = echo(torch.complex128)
            error = float(error_db(echo(torch.complex64), exact[name]).max())
            show(name, targets, best_s(lambda echo=echo: echo(torch.complex64)), count, error)
        if importlib.util.find_spec("finufft"):
            history = by_finufft(targets, args.pulses, args.samples)
            error = float(error_db(torch.from_numpy(history()), exact["path"]))
            show("path by finufft", targets, best_s(history), targets * args.pulses * args.samples, error)


if __name__ == "__main__":
    main()
