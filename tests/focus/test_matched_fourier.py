"""Matched Fourier transform: every transform against the sum itself, adjoints, gradients, units,
and invalid arguments.
"""

from __future__ import annotations

import importlib
import math
import pickle
import warnings

import pytest
import torch

from torchsar.compensate.pulse_phase.imaging import Through
from torchsar.core import Signal
from torchsar.focus import (
    CompiledNufft,
    CrossRangeLines,
    DopplerLines,
    ExplicitSum,
    Gridding,
    MatchedFourier,
    MatchedFourierOperator,
    RangePhase,
    Resampling,
    matched_fourier,
    range_phase,
)
from torchsar.focus.image_lines import cross_range_of, mean_rate
from torchsar.focus.warped_sums import times_of_even_angle
from torchsar.metrics import entropy
from torchsar.radar import LIGHT_M_S, InverseRadar
from torchsar.radar.warp import warp, warp_rate

PRF, N, LAMBDA = 20e3, 400, 1.55e-6
DURATION = N / PRF
K = torch.tensor([[10.0, 1000.0], [5.0, -200.0]], dtype=torch.float64)
OMEGA = torch.tensor([0.02, 0.03], dtype=torch.float64)
RADAR = InverseRadar(LIGHT_M_S / LAMBDA, 0.6e9, PRF)
TIMES = torch.arange(N, dtype=torch.float64) / PRF


def noise(*shape, seed=1, dtype=torch.complex128):
    return torch.randn(*shape, dtype=dtype, generator=torch.Generator().manual_seed(seed))


def relative(a, b):
    return float(torch.linalg.vector_norm(a - b) / torch.linalg.vector_norm(b))


def direct(data, k, oversampling, lines, weight="matched"):
    """The definition, term by term."""
    total = warp(torch.tensor([DURATION], dtype=torch.float64), k)
    u = warp(TIMES, k) / total
    w = warp_rate(TIMES, k) * DURATION / total if weight == "warped" else torch.ones_like(u)
    cells = (torch.arange(lines, dtype=torch.float64) - lines // 2) / oversampling
    return torch.exp(2j * math.pi * cells[:, None] * u[..., None, :]) @ (data * w[..., None]) / math.sqrt(N)


def points(x_m, y_m, k=K, omega=OMEGA, n_range=1, step_m=0.25, yc_m=0.0):
    """Pulses (trial, pulse, range) of scatterers at cross ranges and ranges, with an envelope of
    one cell.
    """
    c4, theta = 4 * math.pi / LAMBDA, omega[..., None] * warp(TIMES, k)
    data = torch.zeros(*theta.shape, n_range, dtype=torch.complex128)
    for x, y in zip(x_m, y_m):
        cell = torch.sinc((step_m * (torch.arange(n_range, dtype=torch.float64) - n_range // 2) + yc_m - y) / step_m)
        data = data + torch.exp(1j * c4 * (y / 2 * theta.square() - x * theta))[..., None] * cell
    return data


NO_FINUFFT = pytest.mark.skipif(not importlib.util.find_spec("finufft"), reason="finufft is not installed")


def name_of(transform):
    return type(transform).__name__


def sums(eps=None):
    """The transforms that evaluate the sum itself, to a relative error eps."""
    return [Gridding(eps=eps), ExplicitSum(), pytest.param(CompiledNufft(eps), marks=NO_FINUFFT)]


@pytest.mark.parametrize("weight", ["matched", "warped"])
@pytest.mark.parametrize("oversampling, lines", [(1.0, None), (2.0, None), (1.3, 201), (4.0, 64)])
@pytest.mark.parametrize("transform", sums(1e-9), ids=name_of)
def test_equals_the_sum(transform, oversampling, lines, weight):
    data = noise(2, N, 3)
    image = matched_fourier(data, K, PRF, lines=DopplerLines(oversampling, lines), transform=transform, weight=weight)
    assert image.shape == (2, lines or round(oversampling * N), 3)
    assert relative(image, direct(data, K, oversampling, image.shape[-2], weight)) < 1e-9


@pytest.mark.parametrize("eps", [1e-3, 1e-6])
def test_eps_holds_in_single_precision(eps):
    data = noise(2, N, 3)
    image = matched_fourier(data.to(torch.complex64), K, PRF, transform=Gridding(eps=eps))
    assert image.dtype == torch.complex64 and relative(image, direct(data, K, 2.0, 2 * N)) < eps


def test_kernel_choice():
    assert Gridding(4).kernel.oversampling == 2 and Gridding(4, oversampling=1.25).kernel.oversampling == 1.25
    assert Gridding(eps=1e-6).kernel.oversampling == 1.5 and Gridding(eps=1e-13).kernel.oversampling == 2
    assert Gridding().kernel == Gridding(eps=1e-6).kernel
    with pytest.raises(ValueError, match="not both"):
        Gridding(4, 1e-3)


def edge(share=0.93):
    """Points spread up to `share` of half the pulse rate at the fastest rotation, and their image
    by the direct sum.
    """
    reach = share * LAMBDA * PRF / 4 / float((OMEGA[0] * warp_rate(TIMES, K[0])).max())
    data = points(torch.linspace(-reach, reach, 41).tolist(), [0.0] * 41)[:1]
    return data, matched_fourier(data, K[:1], PRF, transform=ExplicitSum())


@pytest.mark.parametrize(
    "transform, low, high",
    [
        (Gridding(4, oversampling=1.25), 1e-3, 1e-2),
        (Gridding(4), 1e-4, 1e-3),
        (Gridding(6, oversampling=1.25), 7e-5, 7e-4),
        (Gridding(6), 1e-6, 1e-5),
        (Gridding(8), 1e-8, 1e-7),
        (Resampling("linear"), 0.1, 0.5),
        (Resampling("spline"), 0.03, 0.2),
    ],
    ids=str,
)
def test_error_of_each_transform(transform, low, high):
    """An independent float64 model gives 4e-3, 4e-4, 2e-4, 4e-6 and 4e-8 for the kernels, and 0.20
    and 0.077 for resampling with targets up to 93 % of half the pulse rate.
    """
    data, exact = edge()
    assert low < relative(matched_fourier(data, K[:1], PRF, transform=transform), exact) < high


@pytest.mark.parametrize(
    "taps, oversampling, worst", [(2, 2.0, 2e-2), (4, 1.25, 4e-3), (4, 2.0, 1.5e-4), (6, 2.0, 7e-7)]
)
def test_entropy_follows_the_kernel(taps, oversampling, worst):
    data, exact = edge()
    assert (
        abs(
            float(
                entropy(matched_fourier(data, K[:1], PRF, transform=Gridding(taps, oversampling=oversampling)))
                - entropy(exact)
            )
        )
        < worst
    )


@pytest.mark.parametrize("interpolation, worst", [("linear", 0.01), ("spline", 2e-4)])
def test_resampling_is_right_well_inside_the_band(interpolation, worst):
    """The pulses are tapered, because a sum over equal steps of angle weights the outermost pulses
    differently, which changes the image by some hundredths.
    """
    data = edge(0.1)[0] * torch.sin(math.pi * TIMES / DURATION).square()[:, None]
    for lines in (DopplerLines(), DopplerLines(1.3, 300)):
        exact = matched_fourier(data, K[:1], PRF, lines=lines, transform=ExplicitSum())
        found = matched_fourier(data, K[:1], PRF, lines=lines, transform=Resampling(interpolation))
        assert relative(found, exact) < worst


def test_times_of_even_angle():
    time = times_of_even_angle(K, N, PRF)
    torch.testing.assert_close(
        warp(time, K),
        torch.arange(N, dtype=torch.float64) / N * warp(torch.tensor([DURATION], dtype=torch.float64), K),
        rtol=1e-13,
        atol=1e-16,
    )


@pytest.mark.parametrize(
    "lines", [DopplerLines(1.3, 120), CrossRangeLines(1e-4, 120, OMEGA, LAMBDA)], ids=["doppler", "metres"]
)
@pytest.mark.parametrize("transform", [*sums(), Resampling("linear"), Resampling("spline")], ids=str)
def test_adjoint(transform, lines):
    operator = MatchedFourierOperator(
        K, N, PRF, dtype=torch.complex128, lines=lines, transform=transform, weight="warped"
    )
    pulses, image = noise(3, 2, N, 4), noise(3, 2, 120, 4, seed=2)
    torch.testing.assert_close(
        (operator.image(pulses) * image.conj()).sum(),
        (pulses * operator.adjoint(image).conj()).sum(),
        rtol=1e-7 if isinstance(transform, CompiledNufft) else 1e-11,
        atol=1e-9,
    )


def test_operator_is_an_imaging_of_autofocus():
    imaging = Through(MatchedFourierOperator(K, N, PRF, dtype=torch.complex128))
    rows, image = noise(2, 3, N), noise(2, 3, 2 * N, seed=2)
    torch.testing.assert_close(
        (imaging.image(rows) * image.mT.conj()).sum(),
        (rows * imaging.adjoint(image.mT).conj()).sum(),
        rtol=1e-11,
        atol=1e-9,
    )


SMALL = torch.tensor([[0.1, 0.01], [0.05, 0.03]], dtype=torch.float64)


@pytest.mark.parametrize(
    "options",
    [
        {"transform": Gridding(5)},
        {"transform": Gridding(4, oversampling=1.25), "weight": "warped"},
        {"transform": ExplicitSum()},
        {"transform": Resampling("spline")},
        {"transform": Resampling("linear"), "lines": DopplerLines(1.1, 7)},
    ],
    ids=str,
)
def test_two_derivatives(options):
    data, k = noise(2, 10, 2).requires_grad_(), SMALL.clone().requires_grad_()

    def image(data, k):
        return matched_fourier(data, k, 10.0, **{"lines": DopplerLines(lines=7), **options})

    assert torch.autograd.gradcheck(
        image, (data, k), fast_mode=True, check_forward_ad=True
    ) and torch.autograd.gradgradcheck(image, (data, k), fast_mode=True)


def test_two_derivatives_in_metres():
    data, k, omega = (
        noise(2, 10, 2).requires_grad_(),
        SMALL.clone().requires_grad_(),
        torch.tensor([0.3, 0.2], dtype=torch.float64).requires_grad_(),
    )

    def image(data, k, omega, yc):
        data = range_phase(data, torch.tensor([-0.1, 0.3], dtype=torch.float64), 1.0, 10.0, omega, k, yc)
        return matched_fourier(data, k, 10.0, lines=CrossRangeLines(0.1, 9, omega, 1.0))

    assert torch.autograd.gradcheck(image, (data, k, omega, omega), fast_mode=True) and torch.autograd.gradgradcheck(
        image, (data, k, omega, omega), fast_mode=True
    )


@NO_FINUFFT
def test_first_derivative_through_the_compiled_library():
    data, k = noise(2, 10, 2).requires_grad_(), SMALL.clone().requires_grad_()

    def image(data, k):
        return matched_fourier(data, k, 10.0, transform=CompiledNufft(1e-12))

    assert torch.autograd.gradcheck(image, (data, k), check_forward_ad=True)
    operator = MatchedFourierOperator(SMALL, 10, 10.0, dtype=torch.complex128, transform=CompiledNufft(1e-12))
    assert torch.autograd.gradcheck(operator.adjoint, (noise(2, 20, 2).requires_grad_(),), check_forward_ad=True)


def test_error_for_the_missing_library_names_its_extra(monkeypatch):
    def missing(name):
        raise ModuleNotFoundError(name)

    monkeypatch.setattr(importlib, "import_module", missing)
    with pytest.raises(ModuleNotFoundError, match=r"torchsar-lab\[nufft\]"):
        matched_fourier(noise(N, 1), K[0], PRF, transform=CompiledNufft())


@pytest.mark.parametrize("transform", [Gridding(), ExplicitSum(), Resampling("spline")], ids=name_of)
def test_batch_equals_singles_and_broadcasts(transform):
    data = noise(2, N, 3) * torch.tensor([1.0, 1e4])[:, None, None]
    together = matched_fourier(data, K, PRF, transform=transform)
    for i in range(2):
        torch.testing.assert_close(
            together[i], matched_fourier(data[i], K[i], PRF, transform=transform), rtol=1e-12, atol=1e-12 * 1e4**i
        )
        torch.testing.assert_close(
            matched_fourier(data[0], K, PRF, transform=transform)[i],
            matched_fourier(data[0], K[i], PRF, transform=transform),
            rtol=1e-12,
            atol=1e-11,
        )
    torch.testing.assert_close(
        torch.vmap(lambda k: matched_fourier(data[0], k, PRF))(K), matched_fourier(data[0], K, PRF)
    )


@pytest.mark.parametrize("transform", [*sums(), Resampling("linear"), Resampling("spline")], ids=str)
def test_a_pickled_operator_forms_the_same_image(transform):
    operator, data = MatchedFourierOperator(K, N, PRF, dtype=torch.complex128, transform=transform), noise(2, N, 3)
    sent, image = pickle.loads(pickle.dumps(operator)), operator.image(data)
    torch.testing.assert_close(sent.image(data), image, rtol=0, atol=0)
    torch.testing.assert_close(sent.adjoint(image), operator.adjoint(image), rtol=0, atol=0)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_non_finite_warp_affects_its_own_trial_only(bad):
    k, data = K.clone(), noise(2, N, 3)
    k[0, 1] = bad
    image = matched_fourier(data, k, PRF)
    assert image[0].isnan().all()
    torch.testing.assert_close(image[1], matched_fourier(data[1], K[1], PRF))


def test_no_warp_is_a_plain_transform():
    data = noise(N, 2)
    want = torch.fft.fftshift(torch.fft.ifft(data, dim=0, norm="ortho"), dim=0)
    assert (
        relative(
            matched_fourier(data, torch.zeros(0), PRF, lines=DopplerLines(1.0), transform=Gridding(eps=1e-12)), want
        )
        < 1e-12
    )
    assert (
        relative(
            matched_fourier(
                data, torch.zeros(1, dtype=torch.float64), PRF, lines=DopplerLines(1.0), transform=Gridding(eps=1e-12)
            ),
            want,
        )
        < 1e-12
    )


def test_any_order():
    k, data = torch.tensor([3.0, 200.0, 1e4, -5e5], dtype=torch.float64), noise(N, 1)
    assert relative(matched_fourier(data, k, PRF, transform=Gridding(eps=1e-10)), direct(data, k, 2.0, 2 * N)) < 1e-10


def test_fewer_lines_are_the_middle_of_all():
    data = noise(N, 2)
    few, every = matched_fourier(data, K[0], PRF, lines=DopplerLines(lines=300)), matched_fourier(data, K[0], PRF)
    assert relative(few, every[N - 150 : N + 150]) < 2e-6


@pytest.mark.parametrize("yc_m", [0.0, 1.5])
def test_range_phase_is_the_factor_itself(yc_m):
    data, y = noise(2, N, 7), 0.24 * (torch.arange(7, dtype=torch.float64) - 3)
    yc = torch.tensor([yc_m, -yc_m], dtype=torch.float64)
    theta = OMEGA[:, None] * warp(TIMES, K)
    h = torch.exp(-2j * math.pi / LAMBDA * (y + yc[:, None, None]) * theta.square()[..., None])
    torch.testing.assert_close(range_phase(data, y, LAMBDA, PRF, OMEGA, K, yc), data * h, rtol=1e-10, atol=1e-10)
    single = range_phase(data.to(torch.complex64), y, LAMBDA, PRF, OMEGA, K, yc)
    assert single.dtype == torch.complex64 and relative(single, data * h) < 1e-6


def test_a_point_is_focused_in_both_axes_and_scaled():
    """The point lies 8 mm to one side and 12 m from the centre, where the range term alone costs
    more than 2 dB.
    """
    data = points([8e-3], [12.0], n_range=5, yc_m=12.0)
    signal = Signal(data, RADAR.raw_axes(N, 5))
    focused = MatchedFourier(RADAR, oversampling=8.0)(
        RangePhase(RADAR)(signal, OMEGA, K, torch.full((2,), 12.0, dtype=torch.float64)), K
    )
    line = focused.data[..., 2].abs()
    torch.testing.assert_close(line.amax(-1), torch.full((2,), math.sqrt(N), dtype=torch.float64), rtol=0.02, atol=0)
    doppler = focused.axis("azimuth").values()[line.argmax(-1)]
    step = cross_range_of(focused.axis("azimuth").step, OMEGA, K, LAMBDA, DURATION)
    found = torch.stack([cross_range_of(doppler, OMEGA, K, LAMBDA, DURATION)[i, i] for i in range(2)])
    assert ((found - 8e-3).abs() < 0.6 * step).all()
    assert (matched_fourier(data, K, PRF)[..., 2].abs().amax(-1) < 0.8 * math.sqrt(N)).all()


def test_metre_mode_puts_all_trials_on_one_axis():
    signal = Signal(points([8e-3, -3e-3], [0.0, 0.0]), RADAR.raw_axes(N, 1))
    image = MatchedFourier(RADAR, cross_range_m=(2e-4, 121))(signal, warp_k=K, omega_rad_s=OMEGA)
    axis = image.axis("azimuth")
    assert (axis.unit, axis.n, axis.name) == ("m", 121, "azimuth") and axis.values()[60] == 0
    at = image.data[..., 0].abs()
    assert (
        (at[:, 100] > 0.9 * math.sqrt(N)).all()
        and (at[:, 45] > 0.9 * math.sqrt(N)).all()
        and (at[:, 115] < 0.2 * math.sqrt(N)).all()
    )
    explicit = MatchedFourier(RADAR, cross_range_m=(2e-4, 121), transform=ExplicitSum())(
        signal, warp_k=K, omega_rad_s=OMEGA
    )
    assert relative(image.data, explicit.data) < 1e-6
    cells = (
        torch.exp(4j * math.pi / LAMBDA * axis.values()[:, None] * (OMEGA[:, None] * warp(TIMES, K))[:, None, :])
        @ signal.data
        / math.sqrt(N)
    )
    assert relative(explicit.data, cells) < 1e-10


def test_doppler_axis_and_mean_rate():
    axis = MatchedFourier(RADAR, oversampling=4.0, lines=100)(Signal(noise(2, N, 1), RADAR.raw_axes(N, 1)), K).axis(
        "azimuth"
    )
    assert axis.unit == "Hz" and axis.step == pytest.approx(1 / (4 * DURATION)) and axis.values()[50] == 0
    total = DURATION + K[:, 0] * DURATION**2 / 2 + K[:, 1] * DURATION**3 / 6
    torch.testing.assert_close(mean_rate(OMEGA, K, DURATION), OMEGA * total / DURATION)
    torch.testing.assert_close(cross_range_of(1 / DURATION, OMEGA, K, LAMBDA, DURATION), LAMBDA / (2 * OMEGA * total))


def test_connected_values_take_precedence_over_constants():
    signal = Signal(noise(2, N, 3), RADAR.raw_axes(N, 3))
    held = MatchedFourier(RADAR, warp_k=K[0])
    torch.testing.assert_close(held(signal).data, matched_fourier(signal.data, K[0], PRF))
    torch.testing.assert_close(held(signal, K).data, matched_fourier(signal.data, K, PRF))
    torch.testing.assert_close(MatchedFourier(RADAR)(signal).data, matched_fourier(signal.data, torch.zeros(0), PRF))
    phase = RangePhase(RADAR, omega_rad_s=0.02, warp_k=K[0], yc_m=1.0)
    torch.testing.assert_close(
        phase(signal).data, range_phase(signal.data, signal.axis("range").values(), LAMBDA, PRF, 0.02, K[0], 1.0)
    )
    torch.testing.assert_close(
        phase(signal, OMEGA, K, OMEGA).data,
        range_phase(signal.data, signal.axis("range").values(), LAMBDA, PRF, OMEGA, K, OMEGA),
    )


def test_start_of_slow_time_does_not_matter():
    data = noise(2, N, 3)
    early, late = (RangePhase(RADAR, 0.02)(Signal(data, RADAR.raw_axes(N, 3, start)), warp_k=K) for start in (0.0, 5.0))
    torch.testing.assert_close(MatchedFourier(RADAR)(early, K).data, MatchedFourier(RADAR)(late, K).data)


def test_tunable_warp_descends():
    k = torch.nn.Parameter(K[0] * 1.05)
    stage = MatchedFourier(RADAR, warp_k=k)
    value = entropy(stage(Signal(points([8e-3, -3e-3], [0.0, 0.0])[0], RADAR.raw_axes(N, 1))).data)
    value.backward()
    assert torch.isfinite(k.grad).all() and (k.grad > 0).all()


def test_invalid_arguments_raise():
    signal = Signal(noise(2, N, 3), RADAR.raw_axes(N, 3))
    backwards = torch.tensor([[-100.0, 2000.0], [0.0, 0.0]], dtype=torch.float64)
    for stage in (MatchedFourier(RADAR), RangePhase(RADAR, 0.02)):
        with pytest.raises(ValueError, match="1 of 2 trials: two times have the same angle"):
            stage(signal, warp_k=backwards)
        with pytest.raises(ValueError, match=r"warp_k must have the shape \(order - 1,\)"):
            stage(signal, warp_k=K[:1].expand(3, 2))
    with pytest.raises(ValueError, match="RangePhase needs a rotation rate"):
        RangePhase(RADAR)(signal)
    with pytest.raises(ValueError, match="need omega_rad_s"):
        MatchedFourier(RADAR, cross_range_m=(1e-4, 50))(signal, K)
    with pytest.raises(ValueError, match="at least 8 pulses"):
        matched_fourier(noise(7, 2), K[0], PRF)
    for options, message in (
        ({"weight": "hann"}, "weight 'hann'"),
        ({"oversampling": 0.0}, "positive"),
        ({"lines": 0}, "at least 1"),
    ):
        with pytest.raises(ValueError, match=message):
            MatchedFourier(RADAR, **options)
    with pytest.raises(ValueError, match="interpolation 'fft'"):
        Resampling("fft")
    with pytest.raises(ValueError, match="a positive step and at least one line"):
        CrossRangeLines(0.0, 9, 0.02, LAMBDA)
    operator = MatchedFourierOperator(K, N, PRF)
    with pytest.raises(TypeError, match="built for torch.complex64"):
        operator.image(noise(2, N, 3))
    with pytest.raises(ValueError, match="with 400 pulses, got shape"):
        operator.image(noise(2, N + 1, 3, dtype=torch.complex64))


def test_lines_in_metres_are_checked_against_the_pulse_rate():
    signal = Signal(noise(2, N, 1), RADAR.raw_axes(N, 1))
    reach = LAMBDA * PRF / 4 / float((OMEGA[:, None] * warp_rate(TIMES, K)).max())

    def image(share):
        return MatchedFourier(RADAR, cross_range_m=(share * reach / 50, 100))(signal, K, OMEGA)

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        image(0.9)
    with pytest.warns(UserWarning, match="0.97 times half the pulse rate"):
        image(0.97)
    with pytest.raises(ValueError, match="show more than once"):
        image(2.1)
