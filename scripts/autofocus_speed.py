"""Autofocus methods by time and error, beside the bare Fourier transforms that their iterations
need.

    python scripts/autofocus_speed.py [--trials 16] [--snr 10] [--pulses 400] [--cells 256]
    [--rounds 5]

A rotating aircraft with white phase errors, complex64, one thread. Times are the best
of the rounds, in turn; the ratio is that to as many pairs of transforms of the whole batch, forward
and back, as the method's iterations made (of twice the length where it pads).
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import torch
from torch import Tensor

from torchsar import Draws, keep_freed_memory
from torchsar.compensate import autofocus, entropy_fixed_point, pga, pga_sca, sca, sharpest_phase
from torchsar.core import Estimate
from torchsar.echo import simulate_turntable
from torchsar.metrics import phase_rmse
from torchsar.radar import InverseRadar
from torchsar.scene import Aircraft, TurntableWorld, UniformStartPhase

METHODS: dict[str, Callable[[Tensor], Estimate]] = {
    "sca": sca,
    "pga": lambda x: pga(x, kernel="ml"),
    "pga_sca": pga_sca,
    "pga_sca, synchronised": lambda x: pga_sca(x, kernel="synchronised"),
    "entropy_fixed_point": entropy_fixed_point,
    "sharpest_phase": sharpest_phase,
    "autofocus": autofocus,
    "autofocus, polish 0": lambda x: autofocus(x, polish=0),
}
PADDED = ("pga", "pga_sca", "pga_sca, synchronised")


def simulated(options: argparse.Namespace) -> tuple[Tensor, Tensor]:
    """Data (trial, pulse, range) and true phases."""
    radar = InverseRadar(193.414489e12, 150e9, 2000.0, rotation_rad_s=0.005 * 400 / options.pulses, pulse_s=100e-6)
    world = TurntableWorld(Aircraft(), start_phase=[UniformStartPhase()], snr_db=options.snr)
    recording, truth = simulate_turntable(
        radar, world, options.pulses, options.cells, Draws(1, trials=range(options.trials))
    )
    return recording.signal.data, truth.values["phase_rad"]


def pairs_ms(rows: Tensor, padding: int) -> float:
    """Milliseconds of a transform of the whole batch, forward and back."""
    began = time.perf_counter()
    torch.fft.ifft(torch.fft.fft(rows, padding * rows.shape[-1]))
    return 1e3 * (time.perf_counter() - began)


def bare_ms(name: str, iterations: float, plain: float, padded: float) -> float:
    """Milliseconds of the transforms that so many iterations make."""
    # the search is plain, the polish padded; its last iterations are the polish
    if name == "autofocus":
        polish = min(iterations, 20)
        return (iterations - polish) * plain + polish * padded
    return iterations * (padded if name in PADDED else plain)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    for name, default in (("trials", 16), ("snr", 10.0), ("pulses", 400), ("cells", 256), ("rounds", 5)):
        parser.add_argument(f"--{name}", type=type(default), default=default)
    options = parser.parse_args()
    torch.set_num_threads(1)
    keep_freed_memory()  # as the commands do
    data, truth = simulated(options)
    rows = data.mT.contiguous()
    best = dict.fromkeys(METHODS, float("inf"))
    found: dict[str, Estimate] = {}
    plain = padded = float("inf")
    for _ in range(options.rounds):
        for name, method in METHODS.items():
            began = time.perf_counter()
            found[name] = method(data)
            best[name] = min(best[name], 1e3 * (time.perf_counter() - began))
        plain, padded = min(plain, pairs_ms(rows, 1)), min(padded, pairs_ms(rows, 2))
    print(
        f"{options.trials} trials of {options.pulses} pulses x {options.cells} cells, "
        f"{options.snr:g} dB, complex64, one thread"
    )
    print(
        f"{'method':<24}{'ms a trial':>11}{'iterations':>12}{'bare transforms':>17}"
        f"{'ratio':>7}{'median error (rad)':>20}{'reliable':>9}"
    )
    for name, estimate in found.items():
        count = float(estimate.info["iterations"].double().mean())
        bare = bare_ms(name, count, plain, padded) / options.trials
        ratio = "" if name in ("sca", "sharpest_phase") else f"{best[name] / options.trials / bare:.1f}"
        error = float(phase_rmse(estimate["phase_rad"], truth).median())
        print(
            f"{name:<24}{best[name] / options.trials:>11.1f}{count:>12.1f}{bare:>14.1f} "
            f"ms{ratio:>7}{error:>20.4f}{float(estimate.ok.double().mean()):>9.2f}"
        )


if __name__ == "__main__":
    main()
