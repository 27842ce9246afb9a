"""Backprojection of spotlight and turntable data against the direct double sum, and the error of
plane waves.
"""

from __future__ import annotations

import math

import pytest
import torch

from torchsar import Chain, use
from torchsar.core import Recording, Signal
from torchsar.focus import SpotlightBackprojection, backproject_spotlight
from torchsar.focus.spotlight import GroundGrid
from torchsar.io import read_inverse
from torchsar.metrics import contrast, entropy, error_db
from torchsar.radar import (
    LIGHT_M_S,
    FarField,
    InverseRadar,
    Spotlight,
    frequency_samples,
    geometry_of,
    range_profiles,
)

FREQUENCY = 9.3e9 + 8e6 * torch.arange(12, dtype=torch.float64)


def spotlight(
    n_pulse: int = 9,
    range_m: float = 900.0,
    degrees: float = 3.0,
    frequency: torch.Tensor = FREQUENCY,
    height_m: float = 0.0,
) -> Spotlight:
    azimuth = torch.deg2rad(torch.linspace(-0.3, degrees - 0.3, n_pulse, dtype=torch.float64))
    position = (
        range_m * torch.stack([torch.cos(azimuth), torch.sin(azimuth), torch.ones_like(azimuth)], -1) / math.sqrt(2)
    )
    return Spotlight(
        frequency,
        position,
        torch.linalg.vector_norm(position, dim=-1) + 0.01 * torch.randn(n_pulse, dtype=torch.float64),
        height_m,
    )


def turntable(n_pulse: int = 9) -> FarField:
    return FarField.turntable(FREQUENCY, torch.linspace(0.2, 0.35, n_pulse, dtype=torch.float64))


def profiles(*trials: int, n_pulse: int = 9, dtype: torch.dtype = torch.complex128) -> torch.Tensor:
    return torch.randn(*trials, n_pulse, FREQUENCY.shape[0], dtype=dtype)


def direct(x, geometry, ranges):
    """The double sum over pulses and frequencies. ranges: (pulse, *pixels)."""
    turns = 2 / LIGHT_M_S * geometry.frequency_hz.reshape(-1, *[1] * (ranges.ndim - 1)) * ranges[:, None]
    return (
        torch.einsum("...kf,kf...->...", frequency_samples(x), torch.exp(2j * math.pi * turns))
        if x.ndim == 2
        else torch.stack([direct(item, geometry, ranges) for item in x])
    )


def slant(geometry: Spotlight, x, y, z):
    point = torch.stack(torch.broadcast_tensors(x, y, torch.as_tensor(z, dtype=torch.float64)), -1)
    distance = torch.linalg.vector_norm(geometry.position_m.reshape(-1, *[1] * x.ndim, 3) - point, dim=-1)
    return distance - geometry.reference_m.reshape(-1, *[1] * x.ndim)


X, Y = torch.meshgrid(
    torch.linspace(-6, 8, 5, dtype=torch.float64), torch.linspace(-7, 5, 4, dtype=torch.float64), indexing="xy"
)


@pytest.mark.parametrize("height_m", [0.0, 3.5])
def test_equals_the_double_sum(height_m):
    geometry, x = spotlight(height_m=height_m), profiles()
    expected = torch.stack(
        [
            direct(x, geometry, slant(geometry, X.reshape(-1)[i : i + 1], Y.reshape(-1)[i : i + 1], height_m))[0]
            for i in range(20)
        ]
    ).reshape(4, 5)
    torch.testing.assert_close(
        backproject_spotlight(x, geometry, X, Y, eps=1e-12), expected, rtol=0, atol=1e-9 * float(expected.abs().max())
    )


def test_turntable_equals_the_double_sum():
    geometry, x = turntable(), profiles()
    angle = torch.linspace(0.2, 0.35, 9, dtype=torch.float64)
    ranges = X * torch.cos(angle)[:, None, None] + Y * torch.sin(angle)[:, None, None]
    expected = torch.stack([direct(x, geometry, ranges.flatten(1)[:, i : i + 1])[0] for i in range(20)]).reshape(4, 5)
    torch.testing.assert_close(
        backproject_spotlight(x, geometry, X, Y, eps=1e-12), expected, rtol=0, atol=1e-9 * float(expected.abs().max())
    )


def test_a_point_gives_the_sum_of_the_weights_with_its_own_phase():
    geometry = spotlight()
    x, y = torch.tensor([2.0], dtype=torch.float64), torch.tensor([-3.0], dtype=torch.float64)
    turns = -2 / LIGHT_M_S * FREQUENCY * slant(geometry, x, y, 0.0)
    echo = range_profiles(0.5j * torch.exp(2j * math.pi * turns))
    torch.testing.assert_close(
        backproject_spotlight(echo, geometry, x, y), torch.tensor([0.5j * 9 * 12], dtype=torch.complex128)
    )
    weights = [float((torch.hann_window(n + 2, periodic=False, dtype=torch.float64)).sum()) for n in (9, 12)]
    torch.testing.assert_close(
        backproject_spotlight(echo, geometry, x, y, window="hann"),
        torch.tensor([0.5j * weights[0] * weights[1]], dtype=torch.complex128),
    )


def test_blocks_and_batches_change_nothing():
    geometry, x = spotlight(), profiles(3) * torch.logspace(0, 3, 3)[:, None, None]
    together = backproject_spotlight(x, geometry, X, Y)
    small = backproject_spotlight(x, geometry, X, Y, block_bytes=1)
    for i in range(3):
        scale = float(together[i].abs().max())
        torch.testing.assert_close(together[i], backproject_spotlight(x[i], geometry, X, Y), rtol=0, atol=1e-12 * scale)
        torch.testing.assert_close(together[i], small[i], rtol=0, atol=1e-12 * scale)
    many = backproject_spotlight(x[0], geometry, X.new_zeros(5000), Y.new_zeros(5000))
    torch.testing.assert_close(many, many[:1].expand(5000))


def test_complex64_is_kept_and_near():
    geometry, x = spotlight(range_m=10e3), profiles(2)
    out = backproject_spotlight(x.to(torch.complex64), geometry, X, Y, eps=1e-6)
    assert out.dtype == torch.complex64
    assert float(error_db(out, backproject_spotlight(x, geometry, X, Y)).max()) < -105


def test_gradients_in_profiles_pixels_and_antennas():
    geometry = spotlight(4)

    def image(x, at, position):
        return backproject_spotlight(
            x, Spotlight(FREQUENCY, position, geometry.reference_m), at, -at, eps=1e-8, window="hann"
        )

    at = torch.tensor([1.3, -2.1], dtype=torch.float64, requires_grad=True)
    x = profiles(n_pulse=4).requires_grad_()
    assert torch.autograd.gradcheck(
        image, (x, at, geometry.position_m.clone().requires_grad_()), atol=1e-4, rtol=1e-4, eps=1e-7
    )


def test_plane_waves_match_the_exact_ranges_at_the_centre():
    geometry = spotlight(height_m=2.0)
    tiny = torch.tensor([0.0, 1e-3, 0.0], dtype=torch.float64)
    other = torch.tensor([0.0, 0.0, 1e-3], dtype=torch.float64)
    assert float(geometry.neglected_range_m(tiny, other).abs().max()) < 1e-8
    far = torch.tensor([30.0], dtype=torch.float64)
    # straight across the line of sight of the middle pulses: rho^2 / 2R
    assert float(geometry.neglected_range_m(0 * far, far)[0]) == pytest.approx(30**2 / 1800, rel=0.02)


def test_only_defocus_remains_at_apparent_positions():
    frequency = 9.3e9 + 2e6 * torch.arange(32, dtype=torch.float64)
    geometry = spotlight(64, 9000.0, 3.0, frequency)
    x, y = torch.meshgrid(
        torch.linspace(38, 42, 21, dtype=torch.float64), torch.linspace(28, 32, 21, dtype=torch.float64), indexing="xy"
    )
    echo = range_profiles(
        torch.exp(-4j * math.pi / LIGHT_M_S * frequency * geometry.range_m(slice(None), x[9, 12][None], y[9, 12][None]))
    )
    exact = backproject_spotlight(echo, geometry, x, y)
    naive = backproject_spotlight(echo, geometry.far_field(), x, y)
    placed = backproject_spotlight(
        echo, geometry.far_field(), *(v.reshape(x.shape) for v in geometry.apparent(x.reshape(-1), y.reshape(-1)))
    )
    assert float(error_db(placed, exact)) < -30 < 0 < float(error_db(naive, exact)) + 3


@pytest.mark.parametrize("angle", [0.4, -2.0])
@pytest.mark.parametrize("build", [spotlight, turntable])
def test_turned_coordinates_keep_ranges(build, angle):
    geometry = build()
    x, y = X.reshape(-1), Y.reshape(-1)
    along = math.cos(angle) * x + math.sin(angle) * y
    across = math.cos(angle) * y - math.sin(angle) * x
    torch.testing.assert_close(
        geometry.turned(angle).range_m(slice(None), along, across),
        geometry.range_m(slice(None), x, y),
        rtol=0,
        atol=1e-9,
    )


def test_ground_grid_axes():
    azimuth, range_ = GroundGrid(10.0, 2.5, (100.0, -7.0)).axes()
    assert (azimuth.name, range_.name, azimuth.n, range_.n) == ("azimuth", "range", 5, 5)
    assert azimuth.values().tolist() == [-12, -9.5, -7, -4.5, -2] and range_.values()[2] == 100
    with pytest.raises(ValueError, match="0 < step_m <= extent_m"):
        GroundGrid(1.0, 2.0)


def test_stage_in_a_chain_takes_recorded_side_data():
    geometry, x = spotlight(), profiles(2)
    radar = InverseRadar(9.3e9, 12 * 8e6, 1.0)
    recording = Recording.from_arrays(
        x,
        radar,
        dtype=torch.complex128,
        frequency_hz=FREQUENCY,
        position_m=geometry.position_m,
        reference_m=geometry.reference_m,
    )
    stage = SpotlightBackprojection(8.0, 2.0, window="none", eps=1e-9)
    image = Chain(
        image=use(stage, frequency_hz="aux.frequency_hz", position_m="aux.position_m", reference_m="aux.reference_m")
    )(recording)
    assert image.names == ("azimuth", "range") and image.data.shape == (2, 5, 5)
    y, along = image.axes[0].values(), image.axes[1].values()
    torch.testing.assert_close(
        image.data,
        backproject_spotlight(x, geometry, along, y[:, None]),
        rtol=0,
        atol=1e-7 * float(image.data.abs().max()),
    )
    torch.testing.assert_close(
        SpotlightBackprojection(8.0, 2.0, window="none", eps=1e-9, geometry=geometry)(recording.signal).data, image.data
    )


def test_invalid_arguments_raise():
    geometry, x = spotlight(), profiles()
    with pytest.raises(ValueError, match=r"needs frequency_hz and either angle_rad or position_m .* got none of them"):
        SpotlightBackprojection(8.0, 2.0)(Signal(x, InverseRadar(9.3e9, 96e6, 1.0).raw_axes(9, 12)))
    with pytest.raises(ValueError, match=r"got \['frequency_hz', 'angle_rad', 'position_m'\]"):
        geometry_of(FREQUENCY, torch.zeros(9), geometry.position_m)
    with pytest.raises(TypeError, match=r"angle_rad must be a float64 tensor with 1 dims.* got torch.float32"):
        geometry_of(FREQUENCY, torch.zeros(9))
    with pytest.raises(ValueError, match=r"do not end in the \(pulse, frequency\) = \(9, 12\)"):
        backproject_spotlight(x[:8], geometry, X, Y)
    with pytest.raises(ValueError, match="window 'kaiser' is not known; choose 'none' or 'hann'"):
        SpotlightBackprojection(8.0, 2.0, window="kaiser")
    with pytest.raises(ValueError, match="must rise in equal steps"):
        FarField.turntable(FREQUENCY.flip(0), torch.zeros(9, dtype=torch.float64))
    with pytest.raises(ValueError, match="at least one pixel"):
        backproject_spotlight(x, geometry, X[:0], Y[:0])


@pytest.mark.slow
def test_recorded_car_park(recorded):
    recording = read_inverse(recorded("gotcha_pass1_hh_az001_003.npz"))
    stage = SpotlightBackprojection(100.0, 0.25)
    image = Chain(
        image=use(stage, frequency_hz="aux.frequency_hz", position_m="aux.position_m", reference_m="aux.reference_m")
    )(recording)
    assert image.data.shape == (401, 401)
    assert float(entropy(image)) == pytest.approx(8.731, abs=0.005) and float(contrast(image)) == pytest.approx(
        23.68, abs=0.1
    )
    line, cell = divmod(int(image.data.abs().argmax()), 401)
    assert (float(image.axes[1].values()[cell]), float(image.axes[0].values()[line])) == (-15.5, 21.5)
