"""Your own autofocus in ten lines: minimise a function of the image of a chain, and choose settings
of an autofocus on simulated trials.

    python scripts/compose_autofocus.py [--trials 8] [--candidates 60] [--pulses 200] [--out
    compose_autofocus.png]

Both experiments print the median phase error (rad) over SNR, and share one figure.

1. The motion of a rotating aircraft is a polynomial in time. Three bright points with another
motion are in the same range window. The few coefficients of the polynomial are found by the image
entropy of the range cells of the aircraft. Their error is less than that of one free phase per
pulse.
2. Phase gradient autofocus with three iterations and three window widths. The widths are found by
random search on simulated pairs (data, true phase) and tested on trials of another seed.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch import Tensor

from torchsar import plot
from torchsar.compensate import CorrectPulsePhase, Sca, autofocus, pga_sca, sca
from torchsar.core import Chain, Draws, Signal, legendre, use
from torchsar.echo import simulate_turntable
from torchsar.focus import AzimuthTransform
from torchsar.metrics import entropy, phase_rmse
from torchsar.optim import lbfgs
from torchsar.radar import LIGHT_M_S, InverseRadar
from torchsar.scene import Aircraft, Points, Polynomial, TurntableWorld, UniformStartPhase

RADAR = InverseRadar(
    carrier_hz=LIGHT_M_S / 1.55e-6,
    bandwidth_hz=150e9,
    prf_hz=1000.0,
    rotation_rad_s=0.005,
    pulse_s=100e-6,
    reference_range_m=20e3,
)
PLANE = Aircraft(length_m=0.095, width_m=0.075)
SNR_DB = [-9.0, -6.0, -3.0, 0.0, 5.0, 10.0]
N_RANGE = 128


def motion_through_a_chain(n_pulse: int, trials: int) -> dict[str, Tensor]:
    """Phase errors (SNR, trial) of a polynomial found through a chain, with and without a region,
    and of a free phase.
    """
    signal, truth = plane_and_points(n_pulse, trials)

    # the experiment: a model of the phase, a chain, a figure of its image, a descent that every
    # trial makes by itself
    basis = legendre(torch.linspace(-1, 1, n_pulse, dtype=torch.float64), 3).mT[
        2:
    ]  # a constant and a slope only change the phase and the position of an image
    region = (torch.arange(N_RANGE) - N_RANGE // 2).abs() <= 40  # where the aircraft is
    chain = Chain(phase=Sca(), correct=use(CorrectPulsePhase(), phase_rad="phase"), image=AzimuthTransform(RADAR))
    trace = chain.trace(signal)
    start = sca(signal.data[..., region])["phase_rad"].double() @ torch.linalg.pinv(basis)

    def focused(coefficients: Tensor) -> Signal:
        return chain.rerun(trace, "correct", given={"phase.phase_rad": coefficients @ basis})

    inside = lbfgs(lambda c: entropy(focused(c), mask=region), start, value_tolerance=1e-7)
    everywhere = lbfgs(lambda c: entropy(focused(c)), start, value_tolerance=1e-7)

    found = {
        "autofocus, a free phase": autofocus(signal.data[..., region])["phase_rad"],
        "polynomial, whole image": everywhere.x @ basis,
        "polynomial, region": inside.x @ basis,
    }
    return {name: errors(phase, truth) for name, phase in found.items()}


def plane_and_points(n_pulse: int, trials: int) -> tuple[Signal, Tensor]:
    """Pulses of both targets, (SNR * trial, pulse, range), and the phase of the aircraft."""
    draws = Draws(1, trials=range(len(SNR_DB) * trials))
    plane, truth = simulate_turntable(
        RADAR, TurntableWorld(PLANE, motion=(drift(draws, n_pulse),), snr_db=snr_of(trials)), n_pulse, N_RANGE, draws
    )
    other = draws.part("strangers")
    points = Points(
        azimuth_m=[-0.02, 0.0, 0.03], range_m=[0.048, 0.051, 0.056], amplitude=[12.0, 12.0, 12.0], random_phase=True
    )
    others, _ = simulate_turntable(
        RADAR, TurntableWorld(points, motion=(drift(other, n_pulse),)), n_pulse, N_RANGE, other
    )
    return plane.signal.with_data(plane.signal.data + others.signal.data), truth.values["phase_rad"]


def drift(draws: Draws, n_pulse: int) -> Polynomial:
    """Acceleration and jerk, another one in each trial: some 10 rad over the aperture."""
    time_s = n_pulse / RADAR.prf_hz
    bend, twist = (1e-5 * draws.normal("drift", (2,))).unbind(-1)
    return Polynomial((0.0, bend / time_s**2, 0.6 * twist / time_s**3))


def learnt_windows(n_pulse: int, trials: int, candidates: int) -> tuple[list[int], dict[str, Tensor]]:
    """Three windows by random search on pairs of one seed, and phase errors (SNR, trial) on pairs
    of another seed.
    """
    data, truth = pairs(Draws(2, trials=range(8)), n_pulse, 5.0)

    # the experiment: what is tuned, how it is drawn, how it is judged
    def judged(cells: Tensor) -> Tensor:
        found = pga_sca(data, windows=cells.tolist(), iterations=len(cells))
        return phase_rmse(found["phase_rad"], truth).mean()

    drawn = (
        Draws(3, trials=range(candidates))
        .uniform("windows", (3,), math.log(3), math.log(n_pulse))
        .exp()
        .sort(-1, descending=True)
        .values
    )
    best = drawn[torch.stack([judged(cells) for cells in drawn]).argmin()].tolist()

    data, truth = pairs(Draws(4, trials=range(len(SNR_DB) * trials)), n_pulse, snr_of(trials))
    found = {
        "pga_sca, 3 iterations": pga_sca(data, iterations=3),
        "pga_sca, 3 learnt windows": pga_sca(data, windows=best, iterations=3),
        "pga_sca, 20 iterations": pga_sca(data),
        "autofocus, a free phase": autofocus(data),
    }
    return [round(cells) for cells in best], {
        name: errors(estimate["phase_rad"], truth) for name, estimate in found.items()
    }


def pairs(draws: Draws, n_pulse: int, snr_db: Tensor | float) -> tuple[Tensor, Tensor]:
    """Data (trial, pulse, range) whose pulses start with any phase, and these phases."""
    world = TurntableWorld(PLANE, start_phase=(UniformStartPhase(),), snr_db=snr_db)
    recording, truth = simulate_turntable(RADAR, world, n_pulse, N_RANGE, draws)
    return recording.signal.data, truth.values["phase_rad"]


def snr_of(trials: int) -> Tensor:
    """SNR of each row of a batch that holds all of them."""
    return torch.tensor(SNR_DB).repeat_interleave(trials)


def errors(phase_rad: Tensor, truth_rad: Tensor) -> Tensor:
    """(SNR, trial)."""
    return phase_rmse(phase_rad, truth_rad).unflatten(0, (len(SNR_DB), -1))


def show(title: str, results: Mapping[str, Tensor]) -> None:
    """Print medians over trials."""
    print(f"{title}\n{'SNR (dB)':32}" + "".join(f"{snr:8g}" for snr in SNR_DB))
    for name, rmse in results.items():
        print(f"{name:32}" + "".join(f"{float(value):8.3f}" for value in rmse.quantile(0.5, -1)))


def panel(title: str, results: Mapping[str, Tensor], names: Iterable[str]) -> dict[str, Any]:
    """Medians and quartiles for the figure; a name without results only keeps its colour."""
    nothing = torch.full((len(SNR_DB), 1), torch.nan, dtype=torch.float64)
    share = torch.tensor([0.5, 0.25, 0.75], dtype=torch.float64)
    levels = {name: plot.array(results.get(name, nothing).quantile(share, -1)) for name in names}
    return {
        "title": title,
        "x": plot.array(torch.tensor(SNR_DB)),
        "series": {name: (level[0], level[1:].T) for name, level in levels.items()},
        "bounds": {},
    }


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=8, help="at each SNR")
    parser.add_argument("--candidates", type=int, default=60, help="window schedules that are tried")
    parser.add_argument("--pulses", type=int, default=200)
    parser.add_argument("--out", default="compose_autofocus.png")
    options = parser.parse_args(arguments)
    fitted = motion_through_a_chain(options.pulses, options.trials)
    windows, learnt = learnt_windows(options.pulses, options.trials, options.candidates)
    titles = "A polynomial phase, through a chain", f"Three learnt windows: {', '.join(map(str, windows))} cells"
    show(titles[0], fitted)
    show(titles[1], learnt)
    parts = [
        panel(title, results, {**fitted, **learnt}) for title, results in zip(titles, (fitted, learnt), strict=True)
    ]
    plot.save(plot.error_curves(parts, "SNR (dB)", "phase RMSE (rad)", log_y=True), options.out)


if __name__ == "__main__":
    main()
