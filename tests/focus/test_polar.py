"""Polar format against the direct double sum, its adjoint, its gradients, and recorded data."""

from __future__ import annotations

import copy
import math
import pickle

import pytest
import torch

from torchsar import Chain, use
from torchsar.core import Axis, Recording, Signal
from torchsar.focus import PolarFormat, PolarOperator, SpotlightBackprojection, backproject_spotlight, polar
from torchsar.io import read_inverse
from torchsar.metrics import contrast, correlation, entropy
from torchsar.radar import LIGHT_M_S, FarField, InverseRadar, Spotlight, frequency_samples

PULSES, CELLS = 11, 14
FREQUENCY = 9.3e9 + 8e6 * torch.arange(CELLS, dtype=torch.float64)
AZIMUTH, RANGE = Axis("azimuth", 8, -3.1, 0.7, "m"), Axis("range", 9, 1.3, 0.9, "m")


def waves() -> FarField:
    angle = torch.linspace(-0.4, 0.5, PULSES, dtype=torch.float64)
    away = 0.7 * torch.stack([-torch.cos(angle), -torch.sin(angle)], -1)
    return FarField(FREQUENCY, away, 0.05 * torch.cos(7 * angle))


def profiles(*trials: int, dtype: torch.dtype = torch.complex128) -> torch.Tensor:
    g = torch.Generator().manual_seed(3)
    return torch.randn(*trials, PULSES, CELLS, dtype=dtype, generator=g)


def matrix(window: str) -> torch.Tensor:
    """The map from frequency samples (pulse, frequency) to pixels (azimuth, range), entry
    by entry.
    """
    geometry = waves()
    x, y = RANGE.values(), AZIMUTH.values()[:, None]
    ranges = (
        geometry.direction[:, 0, None, None] * x
        + geometry.direction[:, 1, None, None] * y
        + geometry.offset_m[:, None, None]
    )
    phasor = torch.exp(4j * math.pi / LIGHT_M_S * FREQUENCY[:, None, None] * ranges[:, None])
    if window == "hann":
        a, b = (
            torch.sin(math.pi * torch.arange(1, n + 1, dtype=torch.float64) / (n + 1)).square() for n in (PULSES, CELLS)
        )
        phasor = phasor * (a[:, None] * b)[..., None, None]
    return phasor


@pytest.mark.parametrize("window", ["none", "hann"])
@pytest.mark.parametrize("eps", [1e-2, 1e-3, 1e-6, 1e-11])
def test_error_against_the_double_sum_is_below_eps(eps, window):
    x = profiles()
    expected = torch.einsum("kf,kfyx->yx", frequency_samples(x), matrix(window))
    image = PolarOperator(waves(), AZIMUTH, RANGE, window=window, eps=eps, dtype=torch.complex128).image(x)
    assert torch.linalg.vector_norm(image - expected) < 2 * eps * torch.linalg.vector_norm(expected)


@pytest.mark.parametrize("window", ["none", "hann"])
@pytest.mark.parametrize("eps", [1e-2, 1e-8])
def test_adjoint_is_exact_at_any_accuracy(eps, window):
    operator = PolarOperator(waves(), AZIMUTH, RANGE, window=window, eps=eps, dtype=torch.complex128)
    x, y = profiles(3), torch.randn(3, 8, 9, dtype=torch.complex128)
    left, right = ((a * b.conj()).sum((-2, -1)) for a, b in ((operator.image(x), y), (x, operator.adjoint(y))))
    torch.testing.assert_close(left, right, rtol=1e-11, atol=1e-11)


def test_equals_backprojection_of_plane_waves():
    x = profiles()
    image = PolarOperator(waves(), AZIMUTH, RANGE, eps=1e-11, dtype=torch.complex128).image(x)
    torch.testing.assert_close(
        image,
        backproject_spotlight(x, waves(), RANGE.values(), AZIMUTH.values()[:, None], eps=1e-12),
        rtol=0,
        atol=1e-8,
    )


def test_gradients_of_any_order():
    operator = PolarOperator(waves(), AZIMUTH, RANGE, eps=1e-3, dtype=torch.complex128)
    x, y = profiles(2).requires_grad_(), torch.randn(2, 8, 9, dtype=torch.complex128, requires_grad=True)
    assert torch.autograd.gradcheck(operator.image, x, fast_mode=True)
    assert torch.autograd.gradcheck(operator.adjoint, y, fast_mode=True)
    phase = torch.randn(2, PULSES, dtype=torch.float64, requires_grad=True)

    def sharpness(phase):
        return entropy(operator.image(x.detach() * torch.polar(torch.ones_like(phase), -phase)[..., None]))

    assert torch.autograd.gradcheck(sharpness, phase) and torch.autograd.gradgradcheck(sharpness, phase, fast_mode=True)
    turned = torch.func.jvp(operator.image, (x.detach(),), (x.detach(),))[1]
    torch.testing.assert_close(turned, operator.image(x.detach()))


def test_batches_blocks_and_vmap_change_nothing(monkeypatch):
    operator = PolarOperator(waves(), AZIMUTH, RANGE, dtype=torch.complex128)
    x = profiles(2, 3) * torch.logspace(0, 3, 6).reshape(2, 3, 1, 1)
    together = operator.image(x)
    monkeypatch.setattr(polar, "block_bytes_of", lambda device: 1)
    for i in range(2):
        for j in range(3):
            torch.testing.assert_close(
                together[i, j], operator.image(x[i, j]), rtol=0, atol=1e-13 * float(together[i, j].abs().max())
            )
    torch.testing.assert_close(operator.image(x), together)
    torch.testing.assert_close(torch.vmap(operator.image)(x), together)
    torch.testing.assert_close(
        torch.vmap(operator.adjoint, in_dims=1, out_dims=1)(together), operator.adjoint(together)
    )


def test_dtypes_are_kept_and_never_mixed():
    single = PolarOperator(waves(), AZIMUTH, RANGE, eps=1e-6)
    double = PolarOperator(waves(), AZIMUTH, RANGE, eps=1e-11, dtype=torch.complex128)
    x = profiles()
    image = single.image(x.to(torch.complex64))
    assert image.dtype == torch.complex64 and single.adjoint(image).dtype == torch.complex64
    assert torch.linalg.vector_norm(image - double.image(x)) < 5e-6 * torch.linalg.vector_norm(image)
    with pytest.raises(
        TypeError, match=r"built for torch.complex64, got torch.complex128; build it with dtype=torch.complex128"
    ):
        single.image(x)
    with pytest.raises(TypeError, match="must be complex64 or complex128, got torch.float64"):
        double.image(x.real)
    with pytest.raises(ValueError, match=r"do not end in the \(pulse, frequency\) = \(11, 14\)"):
        double.image(x[:, :5])
    with pytest.raises(ValueError, match=r"does not end in the \(azimuth, range\) = \(8, 9\)"):
        double.adjoint(x)


def recording(x: torch.Tensor, **aux: torch.Tensor) -> Recording:
    return Recording.from_arrays(x, InverseRadar(9.3e9, CELLS * 8e6, 1.0), dtype=x.dtype, frequency_hz=FREQUENCY, **aux)


def test_stage_on_a_turntable_recording():
    angle = torch.linspace(-0.2, 0.25, PULSES, dtype=torch.float64)
    data = recording(profiles(2), angle_rad=angle)
    build = {"extent_m": 9.0, "step_m": 0.75, "centre_m": (1.0, -0.5), "window": "none", "eps": 1e-9}
    connected = {"frequency_hz": "aux.frequency_hz", "angle_rad": "aux.angle_rad"}
    image, exact = (
        Chain(image=use(stage(**build), **connected))(data) for stage in (PolarFormat, SpotlightBackprojection)
    )
    assert image.axes == exact.axes and image.names == ("azimuth", "range")
    torch.testing.assert_close(image.data, exact.data, rtol=0, atol=1e-7 * float(exact.data.abs().max()))


def test_a_point_appears_at_its_position_with_x_along_range():
    angle = torch.linspace(-0.2, 0.25, PULSES, dtype=torch.float64)
    geometry = FarField.turntable(FREQUENCY, angle)
    ranges = geometry.range_m(
        slice(None), torch.tensor([2.0], dtype=torch.float64), torch.tensor([-1.0], dtype=torch.float64)
    )
    echo = recording(
        torch.fft.fftshift(
            torch.fft.ifft(torch.fft.ifftshift(torch.exp(-4j * math.pi / LIGHT_M_S * FREQUENCY * ranges), dim=-1)),
            dim=-1,
        ),
        angle_rad=angle,
    )
    for turn, position in ((0.0, (-1.0, 2.0)), (math.pi / 2, (-2.0, -1.0)), (math.pi, (1.0, -2.0))):
        image = PolarFormat(6.0, 0.5, range_axis_rad=turn, window="none", geometry=geometry)(echo.signal)
        line, cell = divmod(int(image.data.abs().argmax()), image.axes[1].n)
        assert (float(image.axes[0].values()[line]), float(image.axes[1].values()[cell])) == position


def test_operator_is_reused_for_its_geometry_and_dtype_only():
    stage, geometry = PolarFormat(6.0, 0.5, geometry=waves()), waves()
    first = stage.operator(profiles(), geometry)
    assert stage.operator(profiles(4), waves()) is first
    assert stage.operator(profiles(dtype=torch.complex64), geometry).dtype == torch.complex64
    other = stage.operator(profiles(), geometry.turned(0.1))
    torch.testing.assert_close(
        pickle.loads(pickle.dumps(copy.deepcopy(first))).image(profiles()), first.image(profiles())
    )
    assert other is not first and not torch.equal(other.image(profiles()), first.image(profiles()))


@pytest.mark.parametrize("build", [PolarFormat, SpotlightBackprojection])
def test_stage_checks_its_input(build):
    stage = build(6.0, 0.5, geometry=waves())
    signal = recording(profiles(2)).signal
    image = stage(signal).data
    torch.testing.assert_close(torch.vmap(stage)(signal).data, image)
    torch.testing.assert_close(stage(signal.with_data(signal.data[1])).data, image[1])
    assert stage(signal.with_data(signal.data.to(torch.complex64))).data.dtype == torch.complex64
    bad = signal.data.clone()
    bad[1, 3, 5] = torch.nan
    with pytest.raises(ValueError, match=r"1 of \d+ samples are NaN or Inf, the first at index \(1, 3, 5\)"):
        stage(signal.with_data(bad))
    assert not stage(signal.with_data(0 * signal.data)).data.any()
    stage.load_state_dict(stage.state_dict())
    with pytest.raises(ValueError, match="works on the axes"):
        stage(Signal(signal.data, (AZIMUTH.part(0, PULSES), RANGE.part(0, CELLS))))


def gotcha(recorded) -> tuple[Recording, Spotlight]:
    data = read_inverse(recorded("gotcha_pass1_hh_az001_003.npz"))
    return data, Spotlight(data.aux["frequency_hz"], data.aux["position_m"], data.aux["reference_m"])


def test_recorded_car_park(recorded):
    data, geometry = gotcha(recorded)
    image = PolarFormat(100.0, 0.25, geometry=geometry)(data.signal)
    assert float(entropy(image)) == pytest.approx(8.731, abs=0.02) and float(contrast(image)) == pytest.approx(
        23.68, abs=0.5
    )
    line, cell = divmod(int(image.data.abs().argmax()), 401)
    # the curvature of the wavefront moves it by up to 4 cm, less than a pixel
    assert (
        abs(float(image.axes[1].values()[cell]) + 15.5) <= 0.25
        and abs(float(image.axes[0].values()[line]) - 21.5) <= 0.25
    )


def test_recorded_car_park_agrees_with_backprojection(recorded):
    data, geometry = gotcha(recorded)
    patch = {"extent_m": 12.0, "step_m": 0.25, "geometry": geometry}
    image, exact = (stage(**patch)(data.signal) for stage in (PolarFormat, SpotlightBackprojection))
    assert float(correlation(image.data.abs().to(torch.complex64), exact.data.abs().to(torch.complex64))) > 0.9999
    # at the edge the image is displaced: at apparent positions plane waves agree, including phase
    x, y = torch.meshgrid(
        torch.linspace(40, 46, 25, dtype=torch.float64),
        torch.linspace(-48, -42, 25, dtype=torch.float64),
        indexing="xy",
    )
    apparent = (v.reshape(x.shape) for v in geometry.apparent(x.reshape(-1), y.reshape(-1)))
    waves, sight = (
        backproject_spotlight(data.signal.data, g, *at, window="hann", eps=1e-5)
        for g, at in ((geometry.far_field(), apparent), (geometry, (x, y)))
    )
    assert float(correlation(waves, sight)) > 0.9995


def test_recorded_turntable(recorded):
    data = read_inverse(recorded("isar_thz_airplane_even.npz"))
    connected = {"frequency_hz": "aux.frequency_hz", "angle_rad": "aux.angle_rad"}
    image, exact = (
        Chain(image=use(stage(0.72, 0.003), **connected))(data) for stage in (PolarFormat, SpotlightBackprojection)
    )
    assert image.data.shape == (241, 241) and float(correlation(image, exact)) > 0.9999
    for form in (image, exact):
        assert float(entropy(form)) == pytest.approx(7.931, abs=0.005) and float(contrast(form)) == pytest.approx(
            7.66, abs=0.05
        )
