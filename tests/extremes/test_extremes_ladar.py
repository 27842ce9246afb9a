"""The ladar's estimators and image formation where numbers end: levels, distances, lengths,
noise.
"""

from __future__ import annotations

import itertools
import math

import pytest
import torch

from tests.compensate.radials import ESTIMATORS, GATE, seen, velocity_rms
from torchsar.compensate import compensate_motion, radial_motion
from torchsar.core import Estimate, Signal
from torchsar.focus import AzimuthMatchedFilter, CompressSweeps, DerampAzimuth
from torchsar.scene import LinearInSweep, Points, Polynomial
from torchsar.study.bench.direct.triangles import table1

RADAR = table1()
IDS = list(ESTIMATORS)
ROUGH = 2e-3  # of a correlation on its grid; all others are far better


def finite(estimate: Estimate) -> bool:
    tensors = (*estimate.value.values(), *estimate.std.values(), *estimate.info.values(), estimate.quality)
    return all(bool(torch.isfinite(x.double()).all()) for x in tensors)


@pytest.mark.parametrize("name", IDS)
@pytest.mark.parametrize("level", [1e-30, 1e-15, 1e15, 1e30])
def test_levels_in_single_precision(name, level) -> None:
    """Squares of these samples are zero or infinite in float32."""
    sweeps, pulse, truth = seen(n=16, dtype=torch.complex64)
    found = ESTIMATORS[name](sweeps * level, RADAR, pulse, window_m=GATE)
    assert bool(found.ok) and finite(found) and float(velocity_rms(found, truth)) < ROUGH


@pytest.mark.parametrize("name", IDS)
@pytest.mark.parametrize("reference_m, speed", [(10.0, 1.0), (10.0, 60.0), (1e5, 60.0), (1e6, 7000.0), (3000.0, 0.0)])
def test_ten_metres_to_a_thousand_kilometres(name, reference_m, speed) -> None:
    radar = table1(reference_range_m=reference_m, speed_m_s=speed)
    sweeps, pulse, truth = seen(radar, n=16)
    found = ESTIMATORS[name](sweeps, radar, pulse, window_m=GATE)
    assert (
        bool(found.ok)
        and finite(found)
        and float(velocity_rms(found, truth)) < (ROUGH if name == "correlation" else 1e-4)
    )


@pytest.mark.parametrize("name", IDS)
@pytest.mark.parametrize("range_m", [-6.5, -1.5, 0.0, 6.9])
def test_ranges_on_either_side_and_at_the_edge_of_the_band(name, range_m) -> None:
    window = (max(range_m - 0.6, -256 * RADAR.range_step_m), min(range_m + 0.6, 255 * RADAR.range_step_m))
    sweeps, pulse, truth = seen(n=16, scene=Points([0.0], [range_m], [1.0]), motion=(Polynomial([0.3, 10.0]),))
    found = ESTIMATORS[name](sweeps, RADAR, pulse, window_m=window)
    assert bool(found.ok) and float(velocity_rms(found, truth)) < (ROUGH if name == "correlation" else 1e-4)


@pytest.mark.parametrize("name", IDS)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_nothing(name) -> None:
    for n in (1, 2, 9):
        found = ESTIMATORS[name](
            torch.zeros(3, 2, n, 512, dtype=torch.complex64), RADAR, RADAR.sweep_axes(n)[1], window_m=GATE
        )
        assert (
            finite(found)
            and not bool(found.ok.any())
            and not bool(found.info["lit"].any())
            and not bool(found.quality.any())
        )


@pytest.mark.slow
@pytest.mark.parametrize("name", IDS)
def test_noise_from_none_to_nothing_else(name) -> None:
    """From 100 dB down the error never falls with the noise rising, and what counts as reliable is
    right.
    """
    errors = []
    for snr_db in (100.0, 60.0, 30.0, 0.0, -10.0, -20.0, -30.0):
        sweeps, pulse, truth = seen(n=64, trials=2, snr_db=snr_db, dtype=torch.complex64, fidelity=LinearInSweep())
        found = ESTIMATORS[name](sweeps, RADAR, pulse, window_m=GATE)
        error = velocity_rms(found, truth)
        assert finite(found) and bool(found.ok.all()) == (snr_db > -15)
        errors.append(float(error.max()))
    assert all(later > 0.8 * earlier for earlier, later in itertools.pairwise(errors)) and errors[0] < ROUGH


@pytest.mark.parametrize("name", IDS)
def test_many_trial_dims(name) -> None:
    sweeps, pulse, _ = seen(n=8)
    many = ESTIMATORS[name](sweeps.expand(2, 1, 3, *sweeps.shape), RADAR, pulse, window_m=GATE)
    assert many["velocity_m_s"].shape == (2, 1, 3, 8) and many.ok.shape == (2, 1, 3)


def test_the_smallest_sweep() -> None:
    """16 samples a sweep hold a band of 16 range cells."""
    radar = table1(sample_rate_hz=2e6)
    sweeps, pulse, truth = seen(radar, n=16, scene=Points([0.0], [0.06], [1.0]), motion=(Polynomial([0.05]),))
    for name in ("segmented", "peak", "mirror", "recommended"):
        assert float(velocity_rms(ESTIMATORS[name](sweeps, radar, pulse), truth)) < 2e-3, name


@pytest.mark.parametrize("level", [1e-30, 1.0, 1e30])
def test_images_at_any_level(level) -> None:
    sweeps, pulse, _ = seen(n=64, dtype=torch.complex64)
    found = radial_motion(sweeps * level, RADAR, pulse, window_m=GATE)
    still = compensate_motion(sweeps * level, found["velocity_m_s"], RADAR, pulse)
    image = AzimuthMatchedFilter(RADAR)(
        DerampAzimuth(RADAR)(CompressSweeps(RADAR)(Signal(still, RADAR.sweep_axes(64))))
    )
    assert image.data.dtype == torch.complex64 and bool(torch.isfinite(image.data).all())
    assert 0.6 < float(image.data.abs().max()) / level < 1.05


def test_a_velocity_of_a_kilometre_a_second_is_taken_out_exactly() -> None:
    """Nothing in the compensation is small: 1e9 turns over the record."""
    v = 1000.0 + torch.zeros(64, dtype=torch.float64)
    pulse = RADAR.sweep_axes(64)[1]
    ones = torch.ones(2, 64, 512, dtype=torch.complex128)
    there = compensate_motion(ones, v, RADAR, pulse)
    back = compensate_motion(there, -v, RADAR, pulse)
    assert float((back - 1).abs().max()) < 1e-5
    t = pulse.values()[:, None] + RADAR.fast_time_axis().values() + RADAR.period_s / 4
    position = 1000.0 * (t - pulse.start - RADAR.period_s / 2)
    turns = (
        -2
        * (RADAR.carrier_hz + RADAR.chirp_rate_hz_s * RADAR.fast_time_axis().values())
        / RADAR.wave_speed_m_s
        * position
    )
    assert (
        float(
            torch.angle(there[0] * torch.polar(torch.ones_like(turns), -2 * math.pi * (turns - torch.round(turns))))
            .abs()
            .max()
        )
        < 1e-5
    )
