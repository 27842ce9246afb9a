"""Methods of the benchmark `autofocus`: those of the package, and simple ones beside them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from torchsar.compensate import (
    Autofocus,
    EntropyFixedPoint,
    LinkPhases,
    Pga,
    PgaSca,
    PhasePolish,
    Sca,
    SharpestPhase,
    sharpest_phase,
)
from torchsar.core import Chain, Estimate, Signal, cis
from torchsar.metrics import entropy
from torchsar.optim import adam
from torchsar.repair import RemoveConstant
from torchsar.study.bench.entrant import entrant
from torchsar.study.bench.frame import Bench, Entry
from torchsar.study.bench.learned import trained
from torchsar.study.bench.pulses import PHASES, WORLDS, scores


def uncorrected(data: Tensor) -> Tensor:
    """No phase error at all."""
    return torch.zeros(data.shape[:-1], dtype=torch.float64)


def textbook_pga(data: Tensor, iterations: int = 20) -> Tensor:
    """Phase gradient autofocus as textbooks have it.

    The brightest cell of every range cell is shifted to zero Doppler, and a window about it is
    transformed to pulses, where products of adjacent pulses give the gradient of the phase. The
    window begins with half of the image and narrows by the factor 0.7 to 5 cells.

    Reference:
        Wahl et al., IEEE Trans. AES 30 (1994), 827-835, with the maximum-likelihood kernel.
    """
    x, n = data.mT.to(torch.complex128), data.shape[-2]
    phase, line = torch.zeros(data.shape[:-1], dtype=torch.float64), torch.arange(n, dtype=torch.float64)
    line = line - line.mean()
    for iteration in range(iterations):
        image = torch.fft.fft(x * cis(-phase)[:, None])
        peak = image.abs().argmax(-1, keepdim=True)
        index = (torch.arange(n) + peak) % n
        half = max(2, int(n / 4 * 0.7**iteration))
        cell = torch.arange(n)
        window = torch.minimum(cell, n - cell) <= half
        pulses = torch.fft.ifft(image.gather(-1, index) * window)
        step = (pulses[..., 1:] * pulses[..., :-1].conj()).sum(-2).angle()
        update = torch.cat([torch.zeros_like(step[:, :1]), step.cumsum(-1)], -1)
        update = update - update.mean(-1, keepdim=True)
        phase = phase + update - (update @ line / line.square().sum())[:, None] * line
    return phase


def adam_entropy(data: Tensor, steps: int = 200) -> Tensor:
    """The phases of least image entropy that Adam finds from zero."""
    x = data.to(torch.complex64)

    def cost(phase: Tensor) -> Tensor:
        return entropy(torch.fft.fft(x * cis(-phase)[..., None], dim=-2))

    return adam(cost, torch.zeros(x.shape[:-1]), steps=steps, rate=0.1).x


def entries() -> list[Entry]:
    """Methods that are recorded."""
    stages: dict[str, Callable[[Signal], Estimate]] = {
        "autofocus": Autofocus(),
        "sca": Sca(),
        "pga": Pga(),
        "pga:ml": Pga("ml"),
        "pga_sca": PgaSca(),
        "pga_sca:synchronised": PgaSca("synchronised", "measured"),
        "entropy_fixed_point": EntropyFixedPoint(),
        "sharpest_phase": SharpestPhase(steps=60),
        "sharpest_phase:contrast": lambda x: sharpest_phase(x.data, objective="contrast", steps=60),
        "phase_polish": PhasePolish(),
        "link_phases": LinkPhases(),
    }
    simple: dict[str, Callable[..., Any]] = {
        "autofocus:remove_constant": Chain(repair=RemoveConstant(), phase=Autofocus()),
        "textbook_pga": textbook_pga,
        "adam_entropy": adam_entropy,
        "uncorrected": uncorrected,
        **trained(),
    }
    plain = {name: entrant(method, "phase_rad", per_pulse=True) for name, method in simple.items()}
    return [Entry(name, run, WORLDS, PHASES) for name, run in {**stages, **plain}.items()]


BENCH = Bench("autofocus", "the phase of every pulse", entries, scores, per_pulse=True)
