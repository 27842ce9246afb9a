"""Estimators of the radial motion of a ladar by time and error, beside the bare Fourier transforms
that they need.

    python scripts/ladar_speed.py [--trials 64] [--periods 256] [--snr 10] [--window 40] [--rounds
    5] [--threads 1]

One point at a relative range of 1.5 m, with the motion of the config `sal_points`, both precisions.
Times are the best of the rounds, in turn, without and with assessment (`assess=False`, `True`). The
ratio is that of the estimate alone to a transform of every sweep to twice its length and one
transform pair along the periods of the range cells of the window. Velocity: median over trials of
the rms error, beside the bound with unknown phases of the sweeps (with known ones it is half of
that). Range: the same of the integrated error, its line removed.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from torchsar import Draws, keep_freed_memory
from torchsar.compensate import (
    mirror_product,
    ml_peak,
    radial_motion,
    range_error,
    segmented_interference,
    spectrum_correlation,
)
from torchsar.core import Axis, Estimate, Truth
from torchsar.echo import simulate_ladar
from torchsar.metrics import velocity_free_offset_bound_m_s
from torchsar.radar import LIGHT_M_S, TriangularLadar, sweep_middles
from torchsar.scene import LadarWorld, Points, Polynomial, Sinusoid

METHODS: dict[str, Callable[..., Estimate]] = {
    "spectrum_correlation": spectrum_correlation,
    "segmented_interference": segmented_interference,
    "segmented, bins summed": partial(segmented_interference, bins="sum", unwrap="per_pulse"),
    "ml_peak": ml_peak,
    "mirror_product, free": partial(mirror_product, intercept="free"),
    "mirror_product": mirror_product,
    "radial_motion": radial_motion,
}
RADAR = TriangularLadar(LIGHT_M_S / 1.55e-6, 5e9, 16e-6, 64e6, 60.0, 3000.0)
MOTION = (Polynomial([0.35, 10.0]), Sinusoid(160e-6, 100.0, 17.2), Sinusoid(10e-6, 330.0, 57.3))


def simulated(options: argparse.Namespace, dtype: torch.dtype) -> tuple[Tensor, Axis, Truth]:
    """Sweeps (trial, 2, period, N), pulse axis, truth."""
    world = LadarWorld(Points([0.0], [1.5]), motion=MOTION, snr_db=options.snr)
    recording, truth = simulate_ladar(
        RADAR, world, options.periods, Draws(1, trials=range(options.trials)), dtype=dtype
    )
    return recording.signal.data, recording.signal.axis("pulse"), truth


def bare_ms(sweeps: Tensor, cells: Tensor) -> float:
    """Milliseconds of the transforms of the whole batch."""
    began = time.perf_counter()
    torch.fft.fft(sweeps, 2 * sweeps.shape[-1])
    torch.fft.ifft(torch.fft.fft(cells))
    return 1e3 * (time.perf_counter() - began)


def range_nm(estimate: Estimate, truth: Truth, pulse: Axis) -> float:
    """Median over trials of the rms error of the range at the middles of the up sweeps, the line
    removed, nm.
    """
    error = range_error(estimate, RADAR, pulse, sweep_middles(RADAR, pulse)[0]) - truth.values["range_error_up_m"]
    k = torch.linspace(-1, 1, pulse.n, dtype=torch.float64)
    error = error - error.mean(-1, keepdim=True)
    error = error - (error * k).sum(-1, keepdim=True) / k.square().sum() * k
    return 1e9 * float(error.square().mean(-1).sqrt().median())


def table(options: argparse.Namespace, dtype: torch.dtype) -> None:
    """Print the table of one precision."""
    sweeps, pulse, truth = simulated(options, dtype)
    window = (1.5 - options.window / 2 * RADAR.range_step_m, 1.5 + options.window / 2 * RADAR.range_step_m)
    cells = torch.zeros(options.trials, options.window + 1, options.periods, dtype=dtype)
    best, bare = {(name, assess): float("inf") for name in METHODS for assess in (False, True)}, float("inf")
    found: dict[str, Estimate] = {}
    for _ in range(options.rounds):
        for name, assess in best:
            began = time.perf_counter()
            found[name] = METHODS[name](sweeps, RADAR, pulse, window_m=window, assess=assess)
            best[name, assess] = min(best[name, assess], 1e3 * (time.perf_counter() - began))
        bare = min(bare, bare_ms(sweeps, cells))
    bound = float(
        velocity_free_offset_bound_m_s(10 ** (options.snr / 10), RADAR.sweep_samples, RADAR.wavelength_m, RADAR.sweep_s)
    )
    precision = str(dtype).removeprefix("torch.")
    print(
        f"{precision}: {options.trials} trials of {options.periods} periods x 2 x "
        f"{RADAR.sweep_samples} samples, {options.snr:g} dB; bare transforms "
        f"{bare / options.trials:.2f} ms a trial"
    )
    print(
        f"{'method':<24}{'ms a trial':>11}{'assessed':>10}{'ratio':>7}{'velocity (mm/s)':>17}"
        f"{'over bound':>12}{'range (nm)':>12}{'reliable':>9}"
    )
    for name, estimate in found.items():
        error = float((estimate["velocity_m_s"] - truth.values["velocity_m_s"]).square().mean(-1).sqrt().median())
        line = (
            f"{name:<24}{best[name, False] / options.trials:>11.2f}{best[name, True] / options.trials:>10.2f}"
            f"{best[name, False] / bare:>7.2f}"
            f"{1e3 * error:>17.4f}{error / bound:>12.2f}"
        )
        print(f"{line}{range_nm(estimate, truth, pulse):>12.2f}{float(estimate.ok.double().mean()):>9.2f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    for name, default in (
        ("trials", 64),
        ("periods", 256),
        ("snr", 10.0),
        ("window", 40),
        ("rounds", 5),
        ("threads", 1),
    ):
        parser.add_argument(f"--{name}", type=type(default), default=default)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    keep_freed_memory()  # as the commands do
    for dtype in (torch.complex64, torch.complex128):
        table(options, dtype)


if __name__ == "__main__":
    main()
