"""A cheap trial function for tests of sweeps."""

from __future__ import annotations

import os
import time
from pathlib import Path

import torch

from torchsar.study.montecarlo import Record, sweep

GRID = {"snr_db": [0.0, 10.0, 20.0], "law": ["flat", "tilted"]}
SAMPLES = 64


def trial(parameters: dict, draws) -> dict:
    """Mean of noisy samples: by plain averaging, and by a chain of transforms that rounds.

    All batched; the noise is shared.
    """
    noise = draws.normal("noise", (SAMPLES,), torch.complex64)
    level = 10 ** (-parameters["snr_db"] / 20)
    x = 1 + level[:, None].to(torch.float32) * noise
    if parameters["law"] == "tilted":
        x = x * torch.linspace(0.5, 1.5, SAMPLES)
    back = torch.fft.ifft(torch.fft.fft(x) * 1.5) / 1.5
    plain, other = x.real.mean(-1) - 1, back.real.mean(-1) - 1
    return {
        "average": {"level_error_m": plain, "ok": plain.abs() < 0.5},
        "transformed": {"level_error_m": other, "first_m": noise[:, 0].real},
        "bounds": {"level_error_m": {"Cramer-Rao bound": level / (2 * SAMPLES) ** 0.5}},
        "saved": {"average": {"samples": x}},
    }


class Logged:
    """The trial, slowed down, with a line in a file for every row that it computes: process,
    address, trial.
    """

    def __init__(self, slow_s: float, log: str | None) -> None:
        self.slow_s, self.log = slow_s, log

    def __call__(self, parameters: dict, draws) -> dict:
        if self.log:
            with open(self.log, "a", encoding="utf-8") as file:
                file.write("".join(f"{os.getpid()} {case} {trial}\n" for case, trial in zip(draws.case, draws.trials)))
        time.sleep(self.slow_s)
        return trial(parameters, draws)


def run(out: Path | None = None, **options) -> Record:
    """The toy sweep with 40 trials a point."""
    return sweep(
        options.pop("trial", trial),
        options.pop("grid", GRID),
        batched=["snr_db"],
        out=out,
        **{"trials": 40, "seed": 5, **options},
    )
