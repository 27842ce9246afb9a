"""Estimators of the rotation on echoes of another generator, and on data that hold nothing."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from tests.compensate.turning import BINS, F64, OPTIONS, PRF, PULSES, K, noise, points
from torchsar.compensate import (
    EntropyObjective,
    ImageEntropy,
    coarse_rotation,
    entropy_rotation,
    rotation_autofocus,
    uneven_rotation,
)
from torchsar.compensate.rotation.entropy_search import Method
from torchsar.core import Draws, Estimate
from torchsar.metrics import rotation_bounds
from torchsar.study.bench.direct.turntable import SMALL, Turntable

NARROW = Turntable(24e3, 480, 16, 0.45, 60, 0.3, 2.6)
TINY = Turntable(40e3, 800, 24, 0.3, 40, 0.45)
TRUE = {"omega_rad_s": 0.02, "k1_per_s": 10.0, "k2_per_s2": 1000.0, "yc_m": 0.0}


def scenes(count: int, snr_db: float) -> tuple[Tensor, dict[str, Tensor]]:
    """Satellites with noise, and the bounds for resolved scatterers."""
    data, bounds = [], []
    known = {"wavelength_m": SMALL.wavelength_m, "prf_hz": SMALL.prf_hz, "n_pulse": SMALL.pulses}
    for seed in range(count):
        places = SMALL.satellite(seed)
        noisy, std = SMALL.noisy(SMALL.echo(*places), snr_db, 1000 + seed)
        data.append(noisy)
        bounds.append(rotation_bounds(*places, std, TRUE["omega_rad_s"], K, **known))
    return torch.stack(data), {name: torch.stack([bound[name] for bound in bounds]) for name in TRUE}


def rms(x: Tensor) -> float:
    return float(x.square().mean().sqrt())


@pytest.mark.slow
@pytest.mark.parametrize("snr_db", [0.0, 20.0])
def test_satellites_of_the_direct_generator_reach_the_bound_and_their_errors_are_predicted(
    snr_db: float,
) -> None:
    """A range response that is not periodic, scatterers between cells, motion within the pulse."""
    data, bounds = scenes(5, snr_db)
    found = uneven_rotation(data, **SMALL.options)
    assert found.ok.all()
    over_std = {name: (found[name] - true) / found.std[name] for name, true in TRUE.items()}
    for name, true in TRUE.items():
        # of five scenes; of many it is about 1
        assert rms((found[name] - true) / bounds[name]) < 2.2, name
        assert rms(over_std[name]) < 1.6, name
    assert rms(torch.stack(list(over_std.values()))) > 0.6


def test_what_is_left_of_scatterers_before_the_fit_converges_is_no_noise() -> None:
    data, level = [], []
    for seed in range(4):
        noisy, std = NARROW.noisy(NARROW.echo(*NARROW.satellite(seed)), 30.0, 100 + seed)
        data.append(noisy)
        level.append(std**2)
    found = uneven_rotation(torch.stack(data), **NARROW.options)
    over_db = 10 * torch.log10(found.info["noise_power"] / torch.tensor(level))
    assert over_db.abs().max() < 2


def searched(data: Tensor, name: Method) -> Estimate:
    entropy = ImageEntropy(data, EntropyObjective(oversampling=1.0), **OPTIONS)
    box = ([0.018, 9.0, 900.0], [0.022, 11.0, 1100.0])
    return entropy_rotation(entropy, name, box, draws=Draws(1), population=8, generations=6)


ESTIMATORS = {
    "coarse": lambda data: coarse_rotation(data, **OPTIONS),
    "phase fit": lambda data: coarse_rotation(data, **OPTIONS, fits=4),
    "recommended": lambda data: uneven_rotation(data, **OPTIONS),
    "genetic": lambda data: searched(data, "genetic"),
    "evolution": lambda data: searched(data, "evolution"),
    "autofocus": lambda data: rotation_autofocus(data, PRF, K.expand(len(data), -1)),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", ESTIMATORS)
def test_noise_and_zeros_are_not_ok(name: str) -> None:
    data = torch.cat([noise(1, 5, PULSES, BINS), torch.zeros(1, PULSES, BINS)]).to(torch.complex64)
    assert not ESTIMATORS[name](data).ok.any()


def test_a_target_lit_for_half_of_the_aperture_is_not_ok() -> None:
    """Its rotation in the other half would be extrapolated."""
    clean = TINY.echo(*TINY.satellite(3)) * (torch.arange(TINY.pulses) < TINY.pulses // 2)[:, None]
    data, _ = TINY.noisy(clean, 10.0, 5)
    for fits in (0, 4):
        found = coarse_rotation(data, **TINY.options, fits=fits)
        assert not found.ok and math.isinf(found.info["phase_error_rad"])


@pytest.mark.parametrize("seed, snr_db, many", [(50033, 0.0, None), (71402, 10.0, 400)])
def test_a_rate_that_is_wrong_by_more_than_a_tenth_is_not_ok(seed: int, snr_db: float, many: int | None) -> None:
    """Noise makes a rate too large, which then looks accurate, or many scatterers are not found."""
    x, y, amplitude = NARROW.satellite(seed) if many is None else points(seed, many)
    clean = NARROW.echo(x * (NARROW.half_width_m / x.abs().max()), y, amplitude)
    found = uneven_rotation(NARROW.noisy(clean, snr_db, 1000 + seed)[0].to(torch.complex64), **NARROW.options)
    error = abs(float(found["omega_rad_s"]) / TRUE["omega_rad_s"] - 1)
    assert not found.ok or error < 0.1
    assert error < 3.5 * found.std["omega_rad_s"] / TRUE["omega_rad_s"]


def test_the_direct_echo_is_the_integral_over_the_pulse() -> None:
    """One sample, by a sum over short steps of the pulse, with the exact range in each."""
    x, y, amplitude = (
        torch.tensor([value], dtype=dtype) for value, dtype in ((0.4, F64), (1.07, F64), (1j, torch.complex128))
    )
    m, n, steps = 700, 16, 4000
    length = TINY.duty / TINY.prf_hz
    tau = ((torch.arange(steps, dtype=F64) + 0.5) / steps - 0.5) * length
    time = m / TINY.prf_hz + tau
    angle = 0.02 * (time + 10 * time**2 / 2 + 1000 * time**3 / 6)
    range_m = x * torch.sin(angle) - 2 * y * torch.sin(angle / 2).square()
    beat = tau / length * (y + range_m - TINY.range_m[n]) / TINY.cell_m
    expected = torch.exp(-4j * math.pi * range_m / TINY.wavelength_m - 2j * math.pi * beat).mean() * amplitude[0]
    torch.testing.assert_close(TINY.echo(x, y, amplitude)[m, n], expected, atol=1e-4, rtol=0)
