"""Newton's method, which the paper calls Gauss-Newton, from three starts: Table 2 and figures 10 to
12 of Remote Sens. 2025, 17, 3447.

A satellite of 300 scatterers at 20 dB. Starts are 0.9, 1 and 1.1 times the truth.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch

from torchsar import plot
from torchsar.compensate import EntropyObjective, ImageEntropy, newton_rotation, uneven_rotation
from torchsar.core import Axis, Draws, Estimate, Signal
from torchsar.echo import simulate_turntable
from torchsar.focus import MatchedFourier, RangePhase
from torchsar.radar import LIGHT_M_S, InverseRadar
from torchsar.reproduce.isal_rotation.satellite import ROTATION, SIZES, SNR_DB, TIP_M
from torchsar.reproduce.item import Check, Item, statement
from torchsar.scene import Satellite, TurntableWorld

# rate, k1 and k2 of the text (rad/s, 1/s, 1/s2)
TRUTH = torch.tensor([0.02, 10.0, 1000.0], dtype=torch.float64)
NAMES = ("omega_rad_s", "k1_per_s", "k2_per_s2")
# starts over the truth, and largest relative error of an estimate that is close to it
BEGINNINGS = {0.9: "from 0.9 times the truth", 1.0: "from the truth", 1.1: "from 1.1 times the truth"}
FACTORS, CLOSE = tuple(BEGINNINGS), 0.05
# enlarged part of a picture over its largest Doppler
PART = (0.35, 0.45)


@dataclass(frozen=True)
class _Seen:
    """The data, and estimates by start; of None, the recommended one, which needs none."""

    signal: Signal
    radar: InverseRadar
    found: dict[float | None, Estimate]

    def error(self, factor: float | None) -> torch.Tensor:
        """Relative errors of the rate, k1 and k2."""
        return torch.stack([self.found[factor][name] for name in NAMES]) / TRUTH - 1


def _starts(small: bool) -> _Seen:
    """A tiny satellite and one step in the reduced form."""
    prf_hz, n_pulse, n_range, cell_m, count, _ = SIZES[small]
    radar = InverseRadar(LIGHT_M_S / 1.55e-6, LIGHT_M_S / (2 * cell_m), prf_hz)
    world = TurntableWorld(Satellite(count, TIP_M * prf_hz / 500e3), rotation=ROTATION, snr_db=SNR_DB)
    signal = simulate_turntable(radar, world, n_pulse, n_range, Draws(1))[0].signal
    found: dict[float | None, Estimate] = {}
    for factor in FACTORS:
        figure = ImageEntropy.of(signal, radar, EntropyObjective(oversampling=2.0))
        start = figure.start(factor * TRUTH[0], factor * TRUTH[1:])
        found[factor] = newton_rotation(figure, start, damped=False, steps=1 if small else 20)
    known = {"wavelength_m": radar.wavelength_m, "prf_hz": prf_hz, "range_m": signal.axis("range").values()}
    found[None] = uneven_rotation(signal.data, **known)
    return _Seen(signal, radar, found)


def _compensated(seen: _Seen, factor: float | None) -> Signal:
    """Image in Doppler, since a wrong rate gives a wrong scale."""
    omega, k, yc = (seen.found[factor][name] for name in ("omega_rad_s", "warp_k", "yc_m"))
    image = MatchedFourier(seen.radar)(RangePhase(seen.radar)(seen.signal, omega, k, yc), k)
    doppler, range_ = image.axes
    return Signal(image.data, (Axis("Doppler", doppler.n, 1e-3 * doppler.start, 1e-3 * doppler.step, "kHz"), range_))


def _words(seen: _Seen, factor: float | None) -> str:
    return ", ".join(
        f"{name} {100 * float(error):+.2g} %"
        for name, error in zip(("Om", "k1", "k2"), seen.error(factor), strict=True)
    )


def _picture(factor: float) -> Callable[[_Seen, Path], list[Check]]:
    """Figure 10, 11 or 12: the middle of the image, a part of it, and the recommended one."""

    def make(seen: _Seen, path: Path) -> list[Check]:
        shown, lines = {}, {}
        for title, one in ((BEGINNINGS[factor], factor), ("recommended", None)):
            image = _compensated(seen, one)
            half = -0.25 * image.axes[0].start  # a quarter of the band
            shown[title] = plot.within(image, {"Doppler": (-half, half)})
            shown[f"{title}, part"] = plot.within(image, {"Doppler": (PART[0] * half, PART[1] * half)})
            range_m = image.axis("range")
            middle_m, half_m = range_m.start + range_m.step * (range_m.n - 1) / 2, range_m.step * range_m.n / 2
            middle, height = half * sum(PART) / 2, half * (PART[1] - PART[0]) / 2
            lines[title] = {"part": plot.boxes([(middle_m, middle)], half_m, height)}
        plot.save(plot.images(shown, 40, percentile=100, lines=lines), path)
        return [_outcome(seen, factor)]

    return make


def _outcome(seen: _Seen, factor: float) -> Check:
    close = bool((seen.error(factor).abs() < CLOSE).all())
    claim = "close to the truth, focused" if factor == 1 else "far from the truth, defocused"
    return statement(f"Newton's method {BEGINNINGS[factor]}", claim, close == (factor == 1), _words(seen, factor))


def _table_2(seen: _Seen, path: Path) -> list[Check]:
    best = bool((seen.error(None).abs() < CLOSE).all())
    return [
        *(_outcome(seen, factor) for factor in FACTORS),
        statement("without a start", "a method that needs none is close to the truth", best, _words(seen, None)),
    ]


LOST = (
    "the entropy is so flat in the rate that an undamped step from the truth itself is too long; with a line search "
    "all three starts reach the same minimum"
)
# figures and tables, by their numbers
ITEMS = (
    *(
        Item(
            f"Figure {label}",
            f"image by Newton's method {BEGINNINGS[factor]}",
            of=_starts,
            make=_picture(factor),
            why=LOST,
        )
        for label, factor in zip((10, 11, 12), FACTORS, strict=True)
    ),
    Item("Table 2", "estimates by Newton's method from three starts", "table", _starts, _table_2, LOST),
)
