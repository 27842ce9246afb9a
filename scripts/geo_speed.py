"""What processing of multichannel bistatic data costs, and what it loses: precision, range
migration, estimators of velocity.

    python scripts/geo_speed.py [--out geo_speed] [--trials 16] [--rounds 3] [--small]

One thread. Chain: reconstruction (two bands) and focusing of azimuth lines, beside nothing but its
Fourier transforms, that of the channels and that of the image. Times are the best of the rounds.
Errors of images are rms over rms against the same in double precision with an exact history.
Migration: a target at rest, beyond the reference range.
"""

from __future__ import annotations

import argparse
import math
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor

from torchsar import keep_freed_memory, plot
from torchsar.core import Draws, Signal, Stage
from torchsar.echo import simulate_bistatic
from torchsar.metrics import bistatic_bounds
from torchsar.multichannel import (
    CorrectMigration,
    Dwell,
    FocusAzimuth,
    GradientVelocity,
    Interferometry,
    Keystone,
    LeastSquares,
    LikelihoodVelocity,
    MovingPointVelocity,
    NoMigration,
    Reconstruct,
    Search,
    SignalIntensityRatio,
    StaticBulk,
)
from torchsar.multichannel.migration import Migration
from torchsar.reproduce.geo.sensor import BANDWIDTH_HZ, INTEGRATION_S, RADAR
from torchsar.scene import BandLimited, BistaticWorld, MovingPoints

N_PULSE = 900
U_R_M_S, SNR_DB = 10.0, 7.0
MIGRATIONS: dict[str, Migration] = {
    "keystone, whole swath": Keystone(),
    "keystone, one reference": Keystone(whole_swath=False),
    "static bulk, whole swath": StaticBulk(whole_swath=True),
    "static bulk, one reference": StaticBulk(),
    "none": NoMigration(),
}
# of a trial, from a separate program, whose SIR tries 94 velocities
EXPECTED_MS = {"SIR": 21.0, "ATI": 2.6, "ML from ATI": 36.0}
EXPECTED_ERROR_DB = {2: -134.0, 3: -125.0}


def best_s(work: Callable[[], object], rounds: int) -> float:
    """Seconds of the fastest round."""
    taken = []
    for _ in range(rounds):
        began = time.perf_counter()
        work()
        taken.append(time.perf_counter() - began)
    return min(taken)


def azimuth_lines(trials: int, dtype: torch.dtype, snr_db: float | None = None) -> Signal:
    """Channels (trial, channel, pulse) of a target of 10 m/s."""
    world = BistaticWorld(MovingPoints([U_R_M_S], [0.0], [0.0], [0.0]), BandLimited(INTEGRATION_S), snr_db=snr_db)
    signal = simulate_bistatic(RADAR, world, N_PULSE, None, Draws(1, trials=range(trials)), dtype=torch.complex128)[
        0
    ].signal
    return signal.to(dtype)


def image(signal: Signal, bands: int) -> Tensor:
    spectrum = Reconstruct(RADAR, LeastSquares(bands))(signal, U_R_M_S)
    return FocusAzimuth(RADAR, bandwidth_hz=BANDWIDTH_HZ)(spectrum, U_R_M_S).data


def transforms(data: Tensor, bands: int) -> Tensor:
    """As many Fourier transforms as the chain has, and nothing else."""
    spectrum = torch.fft.fft(data)[..., :bands, :]
    return torch.fft.ifft(spectrum.flatten(-2))


def error_db(found: Tensor, exact: Tensor) -> float:
    return 10 * math.log10(float((found.to(exact.dtype) - exact).abs().square().sum() / exact.abs().square().sum()))


def precision(trials: int, rounds: int) -> None:
    """The chain by precision and bands, beside its transforms."""
    print(
        f"{'azimuth chain':28}{'chain (ms/line)':>17}{'FFTs (ms/line)':>17}{'ratio':>8}"
        f"{'error (dB)':>12}{'expected (dB)':>12}"
    )
    for bands in (2, 3):
        exact = image(azimuth_lines(trials, torch.complex128), bands)
        for dtype in (torch.complex128, torch.complex64):
            signal = azimuth_lines(trials, dtype)
            chain, bare = (
                best_s(work, rounds)
                for work in (lambda s=signal, n=bands: image(s, n), lambda s=signal, n=bands: transforms(s.data, n))
            )
            name = f"N = {bands}, {str(dtype).removeprefix('torch.')}"
            tail = (
                f"{error_db(image(signal, bands), exact):>12.1f}{EXPECTED_ERROR_DB[bands]:>12.0f}"
                if dtype == torch.complex64
                else f"{'-':>12}{'-':>12}"
            )
            print(f"{name:28}{1e3 * chain / trials:>17.3f}{1e3 * bare / trials:>17.3f}{chain / bare:>8.1f}{tail}")
    print()


def peak_loss_db(migration: Migration, u_r_m_s: float, beyond_m: float, n_range: int) -> float:
    """What range migration that is left takes from the peak of a target beyond the reference range,
    against one without any.
    """
    world = BistaticWorld(MovingPoints([u_r_m_s], [0.0], [0.0], [beyond_m]), BandLimited(INTEGRATION_S))
    signal = simulate_bistatic(RADAR, world, N_PULSE, n_range, Draws(1))[0].signal
    exact = CorrectMigration(RADAR, StaticBulk(), range_m=RADAR.reference_range_m + beyond_m)(signal, u_r_m_s)
    return 20 * math.log10(peak(CorrectMigration(RADAR, migration)(signal), u_r_m_s) / peak(exact, u_r_m_s))


def peak(signal: Signal, u_r_m_s: float) -> float:
    """Of the focused image."""
    return float(
        FocusAzimuth(RADAR, bandwidth_hz=BANDWIDTH_HZ)(Reconstruct(RADAR)(signal, u_r_m_s), u_r_m_s).data.abs().max()
    )


def show_migration(offsets: Sequence[float], n_range: int, rounds: int, out: Path) -> None:
    """Time of a frame, and loss of the peak over the distance from the reference range, of a target
    at rest and a moving one.
    """
    print(
        f"{f'migration, {N_PULSE} pulses':28}{f'{n_range} lines (ms)':>17}"
        + "".join(f"{f'{beyond:g} m':>8}" for beyond in offsets) * 2
    )
    print(f"{'':28}{'':>17}{'peak (dB), at rest':>{8 * len(offsets)}}{'closing at 10 m/s':>{8 * len(offsets)}}")
    frame = Signal(torch.randn(RADAR.channels, N_PULSE, n_range, dtype=torch.complex64), RADAR.axes(N_PULSE, n_range))
    losses: dict[float, dict[str, list[float]]] = {0.0: {}, U_R_M_S: {}}
    for name, migration in MIGRATIONS.items():
        stage = CorrectMigration(RADAR, migration)
        seconds = best_s(lambda stage=stage: stage(frame), rounds)
        for u_r, table in losses.items():
            table[name] = [peak_loss_db(migration, u_r, beyond, n_range) for beyond in offsets]
        print(
            f"{name:28}{1e3 * seconds:>17.1f}"
            + "".join(f"{loss:>8.2f}" for table in losses.values() for loss in table[name])
        )
    parts = []
    for u_r, table in losses.items():
        series = {
            name: (plot.array(torch.tensor(offsets)), plot.array(torch.tensor(values)))
            for name, values in table.items()
        }
        parts.append(
            {
                "series": series,
                "xlabel": "beyond the reference range (m)",
                "ylabel": "peak (dB)",
                "title": f"target of u_r = {u_r:g} m/s",
                "ylim": (-18.0, 16.0),
            }
        )
    plot.save(plot.panels(parts), out / "migration.png")
    print()


def estimators(search: Search | None) -> dict[str, Callable[[Signal], Tensor]]:
    """u_r (trial,) of azimuth lines; "no prior knowledge", bank
    and ML too, seeks it.
    """
    aperture = Dwell(INTEGRATION_S)
    known = ("u_r_m_s", "y0_m")
    rough, alone = Interferometry(RADAR, aperture), SignalIntensityRatio(RADAR, BANDWIDTH_HZ)

    def refined(stage: Stage) -> Callable[[Signal], Tensor]:
        def found(signal: Signal) -> Tensor:
            start = rough(signal)
            return stage(signal, start["u_r_m_s"], y0_m=start["y0_m"])["u_r_m_s"]

        return found

    return {
        "SIR": lambda signal: alone(signal)["u_r_m_s"],
        "ATI": lambda signal: rough(signal)["u_r_m_s"],
        "ML from ATI": refined(LikelihoodVelocity(RADAR, aperture, unknowns=known)),
        "bank and ML": lambda signal: MovingPointVelocity(RADAR, aperture, u_a_m_s=0.0)(signal)["u_r_m_s"],
        "ML from ATI, by autograd": refined(GradientVelocity(RADAR, aperture, unknowns=known)),
        "no prior knowledge": lambda signal: MovingPointVelocity(RADAR, aperture, search=search)(signal)["u_r_m_s"],
    }


def bound_m_s(known: bool) -> float:
    unknown = ("u_r_m_s", "y0_m") if known else ("u_r_m_s", "u_a_m_s", "y0_m")
    return float(
        bistatic_bounds(RADAR, N_PULSE, 10 ** (SNR_DB / 10), U_R_M_S, integration_s=INTEGRATION_S, unknown=unknown)[
            "u_r_m_s"
        ]
    )


def show_estimators(trials: int, search: Search | None, out: Path) -> None:
    """Time of a trial in a batch, and rms error at 7 dB a sample after range compression."""
    print(
        f"{f'velocity, {SNR_DB:g} dB a sample':28}{'ms a trial':>17}{'expected (ms)':>12}"
        f"{'rms (m/s)':>12}{'bound (m/s)':>13}"
    )
    signal, found = azimuth_lines(trials, torch.complex128, SNR_DB), {}
    for name, estimator in estimators(search).items():
        began = time.perf_counter()
        errors = estimator(signal) - U_R_M_S
        found[name] = (time.perf_counter() - began) / trials, float(errors.square().mean().sqrt())
        known = f"{EXPECTED_MS[name]:g}" if name in EXPECTED_MS else "-"
        print(
            f"{name:28}{1e3 * found[name][0]:>17.1f}{known:>12}{found[name][1]:>12.4f}"
            f"{bound_m_s(not name.endswith('no prior knowledge')):>13.4f}"
        )
    draw_trade(found, out)


def draw_trade(found: Mapping[str, tuple[float, float]], out: Path) -> None:
    # lies on the other ML
    found = {name: figures for name, figures in found.items() if "autograd" not in name}
    seconds, rms = zip(*found.values(), strict=True)
    decibels = [20 * math.log10(error) for error in rms]
    plot.save(
        plot.trade(list(found), seconds, decibels, "rms error of u_r (dB of 1 m/s)", "estimators of velocity, a trial"),
        out / "estimators.png",
    )


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("geo_speed"), help="folder of the figures")
    parser.add_argument("--trials", type=int, default=16, help="in a batch")
    parser.add_argument("--rounds", type=int, default=3, help="of timing")
    parser.add_argument("--small", action="store_true", help="a small batch and short range lines, one round")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)

    torch.set_num_threads(1)
    keep_freed_memory()  # as the commands do
    trials, rounds = (2, 1) if options.small else (options.trials, options.rounds)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the poor condition of three bands
        precision(trials, rounds)
        show_migration(
            (0.0, 150.0) if options.small else (0.0, 100.0, 200.0, 400.0, 800.0),
            96 if options.small else 512,
            rounds,
            options.out,
        )
        show_estimators(trials, Search(u_a_m_s=2.0) if options.small else None, options.out)


if __name__ == "__main__":
    main()
