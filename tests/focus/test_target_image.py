"""Images of targets with and without known geometry, and autofocus through them."""

from __future__ import annotations

import math

import pytest
import torch

from torchsar.compensate import autofocus
from torchsar.core import Signal, unit_phasor
from torchsar.focus import AzimuthTransform, TargetImage
from torchsar.metrics import correlation, entropy, phase_rmse
from torchsar.radar import LIGHT_M_S, InverseRadar, geometry_of, range_profiles

PULSES, CELLS = 96, 64
FREQUENCY = 9.4e9 + 12e6 * torch.arange(CELLS, dtype=torch.float64)
ANGLE = 0.6 + torch.linspace(-0.09, 0.09, PULSES, dtype=torch.float64)
TURN = 0.18 / (PULSES - 1)
RADAR = InverseRadar(float(FREQUENCY[CELLS // 2]), 12e6 * CELLS, 1.0, TURN)
GEOMETRY = geometry_of(frequency_hz=FREQUENCY, angle_rad=ANGLE)


def recorded_points(
    range_m: torch.Tensor, azimuth_m: torch.Tensor, amplitude: torch.Tensor, dtype=torch.complex128
) -> torch.Tensor:
    """Range profiles (pulse, range) of points given along and across the mean line of sight, by the
    formula of the turntable.
    """
    x = range_m * math.cos(0.6) - azimuth_m * math.sin(0.6)
    y = range_m * math.sin(0.6) + azimuth_m * math.cos(0.6)
    range_ = x * torch.cos(ANGLE)[:, None] + y * torch.sin(ANGLE)[:, None]
    phasors = unit_phasor(-2 * FREQUENCY[:, None] * range_[:, None] / LIGHT_M_S, torch.complex128)
    return range_profiles((phasors * amplitude).sum(-1)).to(dtype)


def many(trials: int = 2, n: int = 60) -> torch.Tensor:
    """Points on one side of the unambiguous extent, so that the middle of their Doppler is not that
    of the image.
    """
    g = torch.Generator().manual_seed(4)
    draw = [torch.rand(trials, n, dtype=torch.float64, generator=g) - 0.5 for _ in range(2)]
    amplitude = torch.randn(trials, n, dtype=torch.complex128, generator=g)
    across = RADAR.wavelength_m / (2 * TURN)
    return torch.stack(
        [recorded_points(9 * draw[0][i], across * (0.2 + 0.4 * draw[1][i]), amplitude[i]) for i in range(trials)]
    )


def as_signal(x: torch.Tensor) -> Signal:
    return Signal(x, RADAR.raw_axes(PULSES, CELLS))


@pytest.mark.parametrize("window, oversampling", [("none", 1), ("hann", 2)])
def test_without_a_geometry_it_is_the_transform_along_pulses(window, oversampling):
    signal = as_signal(many())
    image, expected = (
        TargetImage(RADAR, window=window, oversampling=oversampling)(signal),
        AzimuthTransform(RADAR, window, oversampling)(signal),
    )
    assert image.axes == expected.axes and torch.equal(image.data, expected.data)
    assert TargetImage(RADAR).operator(signal.data) is None


@pytest.mark.parametrize("at", [(0.0, 0.0), (2.0, 1.5), (-3.1, 2.2), (1.7, -3.3)])
def test_a_point_appears_at_its_range_and_cross_range(at):
    image = TargetImage(RADAR, GEOMETRY)(
        as_signal(recorded_points(torch.tensor([at[0]]), torch.tensor([at[1]]), torch.ones(1)))
    )
    azimuth, range_ = image.axes
    peak = int(image.data.abs().argmax())
    assert image.names == ("azimuth", "range")
    assert abs(float(azimuth.values()[peak // range_.n]) - at[1]) <= azimuth.step
    assert abs(float(range_.values()[peak % range_.n]) - at[0]) <= range_.step


def test_it_covers_the_unambiguous_extent():
    azimuth, range_ = TargetImage(RADAR, GEOMETRY, step_cells=0.5)(as_signal(many()[0])).axes
    assert azimuth.n * azimuth.step == pytest.approx(RADAR.wavelength_m / (2 * TURN), rel=0.02)
    assert range_.n * range_.step == pytest.approx(CELLS * RADAR.range_step_m, rel=0.02)
    assert azimuth.n == 2 * PULSES and range_.n == 2 * CELLS
    assert azimuth.values()[azimuth.n // 2] == pytest.approx(0, abs=1e-12) and range_.values()[
        range_.n // 2
    ] == pytest.approx(0, abs=1e-12)


def test_the_operator_is_reused_for_one_precision():
    stage, x = TargetImage(RADAR, GEOMETRY), many()
    first = stage.operator(x)
    assert first is not None and stage.operator(x[0]) is first and stage(as_signal(x)).data.dtype == torch.complex128
    single = stage(as_signal(x.to(torch.complex64)))
    assert single.data.dtype == torch.complex64 and stage.operator(x) is not first
    assert float(correlation(single.data, stage(as_signal(x)).data.to(torch.complex64)).min()) > 0.999


def test_autofocus_with_the_polar_image_handles_migration():
    """With random phases the transform along pulses does not determine the position of the image,
    so that its scatterers migrate wrongly; the polar image does.
    """
    x = many()
    a = 2 * math.pi * torch.rand(2, PULSES, dtype=torch.float64, generator=torch.Generator().manual_seed(9))
    dirty = x * torch.exp(1j * a)[..., None]
    stage = TargetImage(RADAR, GEOMETRY)
    found = autofocus(dirty, imaging=stage.operator(dirty))
    plain = autofocus(dirty)
    assert found.ok.all() and float(phase_rmse(found["phase_rad"], a).max()) < 0.1 < float(
        phase_rmse(plain["phase_rad"], a).min()
    )
    clean, focused = (stage(as_signal(v)).data for v in (x, dirty * torch.exp(-1j * found["phase_rad"])[..., None]))
    assert float((entropy(focused) - entropy(clean)).abs().max()) < 0.05
    # the slope is found as well, to a fraction of a cell: the image is at its true position in the
    # unambiguous extent
    assert float(correlation(focused.abs().to(focused.dtype), clean.abs().to(clean.dtype)).min()) > 0.6


def test_invalid_arguments_raise():
    with pytest.raises(ValueError, match="step_cells must be above 0 and at most 1"):
        TargetImage(RADAR, step_cells=1.5)
    still = geometry_of(frequency_hz=FREQUENCY, angle_rad=torch.zeros(PULSES, dtype=torch.float64))
    with pytest.raises(ValueError, match="does not rotate"):
        TargetImage(RADAR, still)(as_signal(many()[0]))
    with pytest.raises(ValueError, match="azimuth window"):
        TargetImage(RADAR, window="taylor")
