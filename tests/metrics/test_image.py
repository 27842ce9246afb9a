"""Image metrics with known answers."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from torchsar.core import Axis, Draws, Signal
from torchsar.metrics import contrast, correlation, entropy, error_after_gain_db, error_db, impulse, impulse_response


def test_entropy_known_answers():
    flat = torch.ones(4, 8, dtype=torch.complex128)
    assert float(entropy(flat)) == pytest.approx(math.log(32))
    point = torch.zeros(4, 8, dtype=torch.complex128)
    point[1, 2] = 3j
    assert float(entropy(point)) == pytest.approx(0, abs=1e-12)
    assert float(entropy(torch.zeros(4, 8, dtype=torch.complex64))) == 0


class _Passes(TorchDispatchMode):
    """Counts the operations that compute something from every pixel."""

    views = ("alias", "detach", "expand", "select", "unsqueeze", "view", "view_as_real", "_conj", "resolve_conj")

    def __init__(self, pixels: int) -> None:
        super().__init__()
        self.pixels, self.count = pixels, 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        tensors = [x for x in args if isinstance(x, torch.Tensor) and x.numel() >= self.pixels]
        self.count += bool(tensors) and func.overloadpacket.__name__ not in self.views
        return func(*args, **(kwargs or {}))


def test_entropy_takes_hardly_more_passes_than_its_plain_formula():
    """ln S - sum p ln p / S, which fails for zeros and at extreme levels."""
    image = torch.randn(64, 64, dtype=torch.complex64, generator=torch.Generator().manual_seed(1))
    with _Passes(image.numel()) as plain:
        p = image.real.square() + image.imag.square()
        expected = torch.log(p.sum()) - (p * torch.log(p)).sum() / p.sum()
    with _Passes(image.numel()) as ours:
        value = entropy(image)
    assert float(value) == pytest.approx(float(expected), abs=1e-5)
    assert ours.count <= plain.count + 1


@pytest.mark.parametrize("level", [1e-30, 1e-12, 1e12, 1e18])
def test_single_precision_at_any_level(level):
    """A zero pixel, a point and a texture, with the values of double precision."""
    image = torch.randn(3, 16, 16, dtype=torch.complex128, generator=torch.Generator().manual_seed(2))
    image[0, 3, 4], image[1] = 0, 0
    image[1, 2, 2] = 0.3 - 0.7j
    scaled = (image * torch.tensor([1.0, level, level])[:, None, None]).to(torch.complex64).requires_grad_()
    torch.testing.assert_close(entropy(scaled), entropy(image).float(), atol=2e-6, rtol=0)
    assert float(entropy(scaled.detach())[1]) == 0
    (gradient,) = torch.autograd.grad(entropy(scaled).sum(), scaled)
    assert torch.isfinite(torch.view_as_real(gradient)).all() and gradient[0, 3, 4] == 0


@pytest.mark.parametrize("scale", [1e-25, 1.0, 1e19])
@pytest.mark.parametrize("metric", [entropy, contrast])
def test_extreme_levels_change_nothing_in_single_precision(metric, scale):
    image = torch.randn(3, 16, 16, dtype=torch.complex64, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(metric(image * scale), metric(image), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("metric", [entropy, contrast])
def test_gradients_are_finite_where_pixels_are_zero(metric):
    image = torch.randn(2, 3, 4, dtype=torch.complex128, generator=torch.Generator().manual_seed(1))
    assert torch.autograd.gradcheck(metric, (image.requires_grad_(),))
    zero = torch.zeros(2, 3, 4, dtype=torch.complex64, requires_grad=True)
    metric(zero).sum().backward()
    assert torch.isfinite(torch.view_as_real(zero.grad)).all()


def test_contrast_of_speckle_is_one_in_intensity():
    image = torch.randn(400, 400, dtype=torch.complex128, generator=torch.Generator().manual_seed(2))
    assert float(contrast(image)) == pytest.approx(1, abs=0.02)
    assert float(contrast(image, of="amplitude")) == pytest.approx(math.sqrt(4 / math.pi - 1), abs=0.01)
    with pytest.raises(ValueError, match="'intensity' or 'amplitude'"):
        contrast(image, of="power")


FORMS = [(metric, of) for metric in (entropy, contrast) for of in ("intensity", "amplitude")]
FORM_IDS = [f"{metric.__name__}_{of}" for metric, of in FORMS]


def direct(metric, of: str, levels: torch.Tensor) -> float:
    """The metric from a plain list of amplitudes, pixel by pixel."""
    x = [float(a) ** {"intensity": 2, "amplitude": 1}[of] for a in levels]
    if metric is entropy:
        return -sum(v / sum(x) * math.log(v / sum(x)) for v in x if v)
    mean = sum(x) / len(x)
    return math.sqrt(sum((v - mean) ** 2 for v in x) / len(x)) / mean


@pytest.mark.parametrize(("metric", "of"), FORMS, ids=FORM_IDS)
def test_metrics_of_a_mask_are_those_of_its_pixels(metric, of):
    image = (
        torch.randn(3, 5, 6, dtype=torch.complex128, generator=torch.Generator().manual_seed(4))
        * torch.tensor([1.0, 1e3, 1e-9])[:, None, None]
    )
    image[0, 1, 2] = 0
    times = torch.randint(0, 4, (3, 5, 6), generator=torch.Generator().manual_seed(5))
    for i in range(3):
        assert float(metric(image, of)[i]) == pytest.approx(direct(metric, of, image[i].abs().flatten()), rel=1e-12)
        assert float(metric(image, of=of, mask=times > 1)[i]) == pytest.approx(
            direct(metric, of, image[i].abs()[times[i] > 1]), rel=1e-12
        )
        counted = image[i].abs().flatten().repeat_interleave(times[i].flatten())
        assert float(metric(image, of, mask=times)[i]) == pytest.approx(direct(metric, of, counted), rel=1e-12)
    torch.testing.assert_close(metric(image, of, mask=torch.ones(6, dtype=torch.bool)), metric(image, of))


@pytest.mark.parametrize("scale", [1e-25, 1e19])
@pytest.mark.parametrize(("metric", "of"), FORMS, ids=FORM_IDS)
def test_extreme_levels_change_no_metric(metric, of, scale):
    image = torch.randn(3, 16, 16, dtype=torch.complex64, generator=torch.Generator().manual_seed(1))
    mask = torch.rand(16, 16, generator=torch.Generator().manual_seed(2)).mul(2).floor()
    torch.testing.assert_close(metric(image * scale, of), metric(image, of), rtol=1e-5, atol=1e-5)
    beside = torch.where(mask > 0, image * 1e-25, 1e19)  # the excluded pixels are 440 dB stronger
    torch.testing.assert_close(metric(beside, of, mask=mask), metric(image, of, mask=mask), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(("metric", "of"), FORMS, ids=FORM_IDS)
def test_gradients_of_regions_and_at_zeros(metric, of):
    image = torch.randn(2, 3, 4, dtype=torch.complex128, generator=torch.Generator().manual_seed(1)).requires_grad_()
    mask = torch.tensor([1.0, 0.0, 2.5, 0.3], dtype=torch.float64)
    for given in (None, mask, mask > 0.4):
        assert torch.autograd.gradcheck(lambda x, m=given: metric(x, of, mask=m), (image,))
    holes = torch.where(torch.rand(2, 3, 4, generator=torch.Generator().manual_seed(3)) > 0.5, image.detach(), 0)
    for x in (holes, torch.zeros(2, 3, 4, dtype=torch.complex64), torch.ones(2, 3, 4, dtype=torch.complex64)):
        (gradient,) = torch.autograd.grad(metric(x.requires_grad_(), of, mask=mask).sum(), x)
        assert torch.isfinite(torch.view_as_real(gradient)).all() and (gradient[..., 1] == 0).all()


@pytest.mark.parametrize(("metric", "of"), FORMS, ids=FORM_IDS)
def test_an_empty_mask_gives_zero(metric, of):
    image = torch.randn(2, 3, 4, dtype=torch.complex64)
    assert torch.equal(metric(torch.zeros_like(image), of), torch.zeros(2))
    mask = torch.ones(2, 1, 1)
    mask[0] = 0
    found = metric(image, of, mask=mask)
    assert float(found[0]) == 0
    torch.testing.assert_close(found[1], metric(image[1], of))
    torch.testing.assert_close(torch.vmap(lambda x, m: metric(x, of, mask=m))(image, mask), found)


@pytest.mark.parametrize("metric", [entropy, contrast])
def test_invalid_masks_raise(metric):
    image = torch.ones(2, 3, 4)
    with pytest.raises(ValueError, match=r"mask of shape \(4, 3\) does not broadcast to the image \(2, 3, 4\)"):
        metric(image, mask=torch.ones(4, 3))
    with pytest.raises(ValueError, match="weights of 0 or more, got -1 to 1"):
        metric(image, mask=torch.tensor([1.0, -1.0, 1.0, 1.0]))
    with pytest.raises(ValueError, match="finite weights"):
        metric(image, mask=torch.tensor([1.0, math.nan, 1.0, 1.0]))
    with pytest.raises(TypeError, match="real weights or of bool, got torch.complex64"):
        metric(image, mask=torch.ones(4, dtype=torch.complex64))
    with pytest.raises(ValueError, match="'intensity' or 'amplitude'"):
        metric(image, of="power")


def test_correlation_ignores_gain_and_phase_and_error_does_not():
    a = torch.randn(2, 8, 8, dtype=torch.complex128, generator=torch.Generator().manual_seed(3))
    torch.testing.assert_close(correlation(a * (2 + 1j), a), torch.ones(2, dtype=torch.float64))
    torch.testing.assert_close(error_db(1.1 * a, a), torch.full((2,), -20.0, dtype=torch.float64))


def sinc_image(offset_a, offset_r, oversampling=1.0, centre_turns=0.0, shape=(300, 280)):
    a = torch.arange(shape[0], dtype=torch.float64)[:, None] - offset_a
    r = torch.arange(shape[1], dtype=torch.float64) - offset_r
    image = torch.sinc(a / oversampling) * torch.sinc(r / oversampling)
    image = image * torch.polar(torch.ones_like(image), 2 * math.pi * centre_turns * a + 0.7)
    axes = (Axis("azimuth", shape[0], -10.0, 0.5, "m"), Axis("range", shape[1], 1000.0, 0.25, "m"))
    return Signal(image, axes)


@pytest.mark.parametrize("offset", [0.0, 0.13, 0.5, -0.37])
@pytest.mark.parametrize(("oversampling", "centre"), [(1.0, 0.0), (1.0, 0.41), (1.8, -0.2), (4.0, 0.3)])
def test_sinc_is_measured_as_a_sinc(offset, oversampling, centre):
    image = sinc_image(150 + offset, 140 - offset, oversampling, centre)
    m = impulse_response(image, (65.0, 1035.0))
    assert float(m["irw_azimuth_m"]) == pytest.approx(0.8859 * oversampling * 0.5, rel=0.01)
    assert float(m["irw_range_m"]) == pytest.approx(0.8859 * oversampling * 0.25, rel=0.01)
    for axis in ("azimuth", "range"):
        assert float(m[f"pslr_{axis}_db"]) == pytest.approx(-13.26, abs=0.06)
        assert float(m[f"islr_{axis}_db"]) == pytest.approx(-10.17, abs=0.1)
    assert float(m["position_azimuth_m"]) == pytest.approx(-10 + 0.5 * (150 + offset), abs=0.5 * 0.01)
    assert float(m["position_range_m"]) == pytest.approx(1000 + 0.25 * (140 - offset), abs=0.25 * 0.01)
    assert math.remainder(float(torch.angle(m["peak"])) - 0.7, 2 * math.pi) == pytest.approx(0, abs=0.02)


def test_targets_and_trials_are_measured_side_by_side():
    images = torch.stack([sinc_image(150, 140).data, sinc_image(150.4, 139.8).data * 1000])
    signal = Signal(images, sinc_image(1, 1).axes)
    m = impulse_response(signal, (torch.tensor([65.0, 65.0]), torch.tensor([1035.0, 1035.0])))
    assert m["irw_azimuth_m"].shape == (2,)
    several = impulse_response(signal, (torch.tensor([[65.0, 66.0], [65.0, 64.0]]), torch.tensor([1035.0, 1035.0])))
    assert several["irw_azimuth_m"].shape == (2, 2)
    torch.testing.assert_close(several["position_azimuth_m"][:, 1], m["position_azimuth_m"])


def test_positions_outside_the_image_raise():
    with pytest.raises(ValueError, match="outside the azimuth axis"):
        impulse_response(sinc_image(150, 140), (500.0, 1035.0))


def test_invalid_images_raise():
    flat = torch.ones(8, dtype=torch.complex64)
    with pytest.raises(ValueError, match=r"at least one pixel, got the shape \(8,\)"):
        entropy(flat)
    with pytest.raises(ValueError, match=r"at least one pixel, got the shape \(0, 8\)"):
        contrast(flat.expand(0, 8))
    with pytest.raises(TypeError, match="got ndarray"):
        entropy(flat.expand(4, 8).numpy())
    with pytest.raises(ValueError, match=r"equal size can be compared.*\(4, 8\).*\(2, 8\)"):
        error_db(flat.expand(4, 8), flat.expand(2, 8))
    with pytest.raises(ValueError, match="complex images.*torch.float32"):
        correlation(flat.expand(4, 8).real, flat.expand(4, 8))


def test_invalid_arguments_of_impulse_response_raise():
    image = sinc_image(150, 140)
    with pytest.raises(ValueError, match="Signal with two axes, got \\('range',\\)"):
        impulse_response(image.isel(azimuth=0), (65.0, 1035.0))
    with pytest.raises(ValueError, match="sidelobe_nulls of 1 or more and search_m above 0, got 0"):
        impulse_response(image, (65.0, 1035.0), sidelobe_nulls=0)
    with pytest.raises(ValueError, match="outside the azimuth axis"):
        impulse_response(image, (math.nan, 1035.0))
    with pytest.raises(ValueError, match="NaN or Inf"):
        impulse_response(image.with_data(image.data * math.nan), (65.0, 1035.0))


def test_a_maximum_near_its_sample_is_refined_once(monkeypatch):
    """The position is refined again only where the maximum lies beyond half a sample."""
    calls, refined = [], impulse._refined
    monkeypatch.setattr(impulse, "_refined", lambda *args: (calls.append(1), refined(*args))[1])
    t = torch.arange(256, dtype=torch.float64)
    cut = torch.sinc(0.8 * (t - 127.8)).to(torch.complex128)
    signal = Signal(cut[:, None] * cut, (Axis("azimuth", 256, 0.0, 1.0, "m"), Axis("range", 256, 0.0, 1.0, "m")))
    out = impulse_response(signal, (torch.tensor([128.0, 126.0]), torch.tensor([128.0, 129.0])))
    torch.testing.assert_close(out["position_range_m"], torch.full((2,), 127.8, dtype=torch.float64), atol=2e-3, rtol=0)
    assert len(calls) == 1


def bell(row: float, column: float, width: tuple[float, float]) -> torch.Tensor:
    """A Gaussian response, whose interpolation is exact, in an image of 384 x 384 samples."""
    t = torch.arange(384, dtype=torch.float64)
    row_cut, column_cut = (
        torch.exp(-0.5 * ((t - at) / w).square() + 1j * 0.3 * (t - at))
        for at, w in zip((row, column), width, strict=True)
    )
    return row_cut[:, None] * column_cut


def test_the_interpolated_maximum_is_exact():
    image = bell(190.4321, 201.1234, (2.0, 3.0))
    axes = tuple(Axis(name, 384, 0.0, 1.0, "m") for name in ("azimuth", "range"))
    found = impulse_response(Signal(image, axes), (190.0, 201.0))
    assert float(found["position_azimuth_m"]) == pytest.approx(190.4321, abs=1e-7)
    assert float(found["position_range_m"]) == pytest.approx(201.1234, abs=1e-7)
    assert abs(complex(found["peak"]) - 1) < 1e-9


def test_only_responses_that_are_wide_are_interpolated_farther_out(monkeypatch):
    calls, about = [], impulse._about_zero
    monkeypatch.setattr(
        impulse, "_about_zero", lambda x, reach: (calls.append((x[..., 0].numel(), reach)), about(x, reach))[1]
    )
    images = torch.stack([bell(190.4, 201.1, (2.0, 2.0)), bell(190.4, 201.1, (14.0, 2.0)), bell(190, 201, (2.0, 2.0))])
    images = images + 1e-3 * Draws(5, trials=range(3)).normal("impulse", (384, 384), torch.complex128)
    axes = tuple(Axis(name, 384, 0.0, 1.0, "m") for name in ("azimuth", "range"))
    together = impulse_response(Signal(images, axes), (190.0, 201.0), sidelobe_nulls=2)
    assert calls == [(6, 32), (1, 128)]
    for k in range(3):
        alone = impulse_response(Signal(images[k], axes), (190.0, 201.0), sidelobe_nulls=2)
        for name, value in alone.items():
            torch.testing.assert_close(together[name][k], value, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("n", [64, 100, 384])
def test_a_part_of_an_interpolated_cut_equals_that_part_of_the_whole(n):
    spectrum = Draws(6, trials=range(2)).normal("impulse", (2 * n,), torch.complex128)
    part, whole = impulse._about_zero(spectrum, 32), impulse._about_zero(spectrum, n)
    middle = whole.shape[-1] // 2
    torch.testing.assert_close(part, whole[..., middle - 511 : middle + 512], rtol=0, atol=1e-12)


@pytest.mark.parametrize("measure", [correlation, error_db, error_after_gain_db])
@pytest.mark.parametrize("scale", [0.0, 1.0])
def test_gradients_at_no_error_and_at_zeros_are_finite(measure: Callable[..., Tensor], scale: float) -> None:
    reference = torch.randn(2, 6, 5, dtype=torch.complex128, generator=torch.Generator().manual_seed(1))
    image = (scale * reference).requires_grad_()
    measure(image, reference).sum().backward()
    assert image.grad is not None and bool(torch.isfinite(torch.view_as_real(image.grad)).all())
    if scale or measure is correlation:
        assert float(image.grad.abs().max()) < 1e-9


def test_places_without_a_point_have_no_widths() -> None:
    """Side lobes beside a point are no points: what lies beside is stronger."""
    line = torch.sinc(torch.arange(-64.0, 64.0) / 2)
    image = Signal(
        torch.outer(line, line) + 0j, (Axis("azimuth", 128, -64.0, 1.0, "m"), Axis("range", 128, -64.0, 1.0, "m"))
    )
    with pytest.warns(UserWarning, match=r"1 of 2 places have no point response: .* widen the search"):
        found = impulse_response(image, (torch.tensor([0.0, 12.0]), torch.zeros(2)), search_m=3.0)
    for name, value in found.items():
        assert torch.isfinite(value.abs()).tolist() == [True, name == "peak" or name.startswith("position")], name
    weak = image.with_data(image.data + image.data.roll(30, -1) / 100)
    with pytest.warns(UserWarning, match="for a weak target beside a stronger one choose fewer sidelobe_nulls"):
        assert impulse_response(weak, (0.0, 30.0), sidelobe_nulls=20, search_m=1.0)["irw_azimuth_m"].isnan()
    found = impulse_response(weak, (0.0, 30.0), sidelobe_nulls=4, search_m=1.0)
    assert found["irw_azimuth_m"].item() == pytest.approx(1.77, abs=0.1)
