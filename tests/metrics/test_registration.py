"""Error of images after registration: what it removes, and what it leaves."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from torchsar.core import Axis, Signal
from torchsar.metrics import error_db, registered_error_db, registered_errors

F64 = torch.float64


def test_registration_ignores_shift_slope_gain_and_phase() -> None:
    """Band-limited noise whose spectrum wraps, in two trials with shifts of their own."""
    made = torch.randn(2, 64, 48, dtype=torch.complex128, generator=torch.Generator().manual_seed(3))
    bands = [((torch.fft.fftfreq(n, dtype=torch.float64) + 0.5).remainder(1) - 0.5).abs() < 0.3 for n in (64, 48)]
    spectrum = torch.fft.fft2(made) * bands[0][:, None] * bands[1]
    f, g = torch.fft.fftfreq(64, dtype=torch.float64)[:, None], torch.fft.fftfreq(48, dtype=torch.float64)
    shift = torch.tensor([[3.3, -7.45], [0.2, 0.0]], dtype=torch.float64)[..., None, None]
    carrier = torch.exp(2j * math.pi * (28 / 64 * torch.arange(64)[:, None] - 15 / 48 * torch.arange(48)))
    image = torch.fft.ifft2(spectrum) * carrier
    moved = torch.fft.ifft2(spectrum * torch.exp(-2j * math.pi * (f * shift[:, 0] + g * shift[:, 1]))) * carrier
    assert bool((error_db(moved, image) > -14).all())
    tilt = torch.exp(2j * math.pi * (0.02 * torch.arange(64)[:, None] - 0.013 * torch.arange(48)))
    assert bool((registered_error_db((0.5 - 2j) * moved, image) < -90).all())
    assert bool((registered_error_db((image * tilt).roll((3, -7), (-2, -1)), image) < -90).all())
    spoilt = moved + 0.1 * image.flip(-1)
    torch.testing.assert_close(registered_error_db(spoilt, image), torch.full((2,), -20.0).double(), rtol=0, atol=0.2)
    zeros = registered_error_db(torch.zeros_like(image), image)
    torch.testing.assert_close(zeros, torch.zeros(2, dtype=torch.float64))


def test_errors_of_amplitude_and_of_phase_are_apart() -> None:
    """Cubic phases over the image leave its amplitudes, and a wrong gain leaves the phases."""
    made = torch.randn(2, 64, 48, dtype=torch.complex128, generator=torch.Generator().manual_seed(3))
    bands = [torch.fft.fftfreq(n, dtype=F64).abs() < 0.3 for n in (64, 48)]
    image = torch.fft.ifft2(torch.fft.fft2(made) * bands[0][:, None] * bands[1])
    x = torch.linspace(-1, 1, 64, dtype=F64)[:, None]
    phase = 0.8 * (5 * x**3 - 3 * x) / 2
    turned = registered_errors(image * torch.exp(1j * phase), image)
    assert bool((turned["image_error_db"] > -12).all()) and bool((turned["amplitude_error_db"] < -25).all())
    assert torch.allclose(turned["phase_error_rad"], torch.full((2,), 0.8 / math.sqrt(7)).double(), rtol=0.15)
    faded = registered_errors(image * (1 + 0.5 * torch.sin(9 * x)), image)
    torch.testing.assert_close(faded["amplitude_error_db"], faded["image_error_db"], rtol=0, atol=0.1)
    assert bool((faded["amplitude_error_db"] > -12).all()) and bool((faded["phase_error_rad"] < 0.02).all())
    unrelated = registered_errors(torch.zeros_like(image), image)
    assert float(unrelated["amplitude_error_db"][0]) == 0 and float(unrelated["phase_error_rad"][0]) > 1.8
    # moduli of unrelated speckle fit each other by chance; the fit of the registration adds little
    other = torch.randn(6, 64, 64, dtype=torch.complex128, generator=torch.Generator().manual_seed(4))
    level = registered_errors(other[:3], other[3:])["amplitude_error_db"]
    chance = 10 * math.log10(1 - (math.pi / 4) ** 2)
    assert all(chance - 0.5 < one < chance + 0.2 for one in level[level < 0].tolist()) and bool((level < 0).any())


def test_points_that_lie_elsewhere_have_nothing_in_common() -> None:
    one, other = (torch.zeros(64, 64, dtype=torch.complex128) for _ in range(2))
    one[(10, 30, 50), (10, 40, 13)] = other[(20, 44, 55), (33, 9, 50)] = 1
    found = registered_errors(one, other)
    assert float(found["amplitude_error_db"]) > -1.5 and float(found["image_error_db"]) > -1.5


def points(places: Tensor, amplitude: Tensor, size: tuple[int, int]) -> Tensor:
    """Points with a Gaussian response at places (..., point, 2) in samples."""
    u, v = (torch.arange(n, dtype=F64) for n in size)
    rows, columns = (torch.exp(-(x - places[..., i, None]).square() / 8) for i, x in enumerate((u, v)))
    return torch.einsum("...pi,...pj,p->...ij", rows.to(amplitude.dtype), columns.to(amplitude.dtype), amplitude)


def test_registration_removes_a_rotation_a_stretch_and_a_shear() -> None:
    """Displacements of the edges by up to 0.6 sample, other in each trial, and an error besides."""
    made = torch.Generator().manual_seed(4)
    size = (96, 80)
    middle = torch.tensor([(n - 1) / 2 for n in size], dtype=F64)
    off = (torch.rand(40, 2, generator=made, dtype=F64) - 0.5) * torch.tensor([80, 64])
    amplitude = torch.randn(40, generator=made, dtype=torch.complex128)
    image = points(middle + off, amplitude, size)
    linear = torch.tensor([[[0.0, 0.015], [-0.015, 0.0]], [[0.012, 0.0], [0.004, -0.01]]], dtype=F64)
    moved = points(middle + off + off @ linear.mT + torch.tensor([2.3, -1.6]), amplitude, size)
    found = registered_error_db(1j * moved, image)
    assert bool((error_db(moved, image) > -10).all()) and bool((found < -38).all()), found
    spoilt = moved + 0.1 * image.flip(-1)
    torch.testing.assert_close(registered_error_db(spoilt, image), torch.full((2,), -20.0).double(), rtol=0, atol=0.4)


def test_images_that_have_nothing_in_common_keep_their_error() -> None:
    made = torch.randn(2, 2, 40, 30, dtype=torch.complex128, generator=torch.Generator().manual_seed(5))
    found = registered_error_db(made[0], made[1])
    assert bool((found < 1e-9).all()) and bool((found > -0.3).all())


def test_registration_never_hides_what_does_not_agree() -> None:
    """Few points at unrelated places, and thin images: what is compared leaves no small error."""
    made = torch.Generator().manual_seed(6)
    for size, count in (((32, 32), 5), ((32, 32), 10), ((2, 40), 0)):
        images = torch.zeros(2, 40, *size, dtype=torch.complex128)
        if count:
            at = torch.randint(size[0] * size[1], (2, 40, count), generator=made)
            images.flatten(-2).scatter_(-1, at, torch.randn(2, 40, count, dtype=torch.complex128, generator=made))
        else:
            images = torch.randn(images.shape, dtype=torch.complex128, generator=made)
        assert float(registered_error_db(*images).min()) > -20


def test_all_of_the_image_decides_on_the_slope_of_the_phase() -> None:
    """Five bright points leave several slopes open, 300 weak ones do not; a small quadratic phase,
    as a linear error of the path causes it, is removed.
    """
    made = torch.Generator().manual_seed(8)
    size, middle = (240, 240), torch.tensor([119.5, 119.5], dtype=F64)
    corners = torch.tensor([[0, 0], [75, -75], [-75, 75], [30, 55], [-62, -45]], dtype=F64)
    off = torch.cat([corners, (torch.rand(300, 2, generator=made, dtype=F64) - 0.5) * 190])
    amplitude = torch.randn(305, generator=made, dtype=torch.complex128)
    amplitude[:5] = 40.0
    image = points(middle + off, amplitude, size)
    shift = torch.tensor([6.0, -2.4], dtype=F64)
    x, y = ((torch.arange(240, dtype=F64) - m - d) / 240 for m, d in zip(middle, shift, strict=True))
    x = x[:, None]
    for turns in ([0.9, 0.3, 0.1, -0.25, 0.05], [-0.6, 1.4, -0.3, 0.5, 0.0], [1.2, -0.8, 0.55, -0.5, -0.1]):
        phase = sum(t * z for t, z in zip(turns, (x, y, x * x, x * y, y * y), strict=True))
        moved = points(middle + off + shift, amplitude, size) * torch.exp(2j * math.pi * phase)
        found = float(registered_error_db(moved, image))
        assert found < -35, (turns, found)


def test_images_of_nothing_and_numbers_that_are_none_are_no_agreement() -> None:
    noise = torch.randn(2, 9, 7, dtype=torch.complex128)
    none = torch.zeros_like(noise)
    for pair in ((noise, none), (none, noise), (none, none)):
        assert registered_error_db(*pair).tolist() == [0.0, 0.0]
    with pytest.raises(ValueError, match="registered_errors.*NaN"):
        registered_error_db(noise * torch.nan, noise)
    with pytest.raises(ValueError, match="trials broadcast"):
        registered_error_db(noise.expand(2, 9, 7), noise[:1].expand(3, 9, 7))
    one, other = (
        Signal(noise, (Axis("azimuth", 9, 0.0, step, "m"), Axis("range", 7, 0.0, 1.0, "m"))) for step in (1, 2)
    )
    with pytest.raises(ValueError, match="equal axes"):
        registered_error_db(one, other)


def test_trials_do_not_depend_on_others_of_the_batch() -> None:
    made = torch.Generator().manual_seed(9)
    noise = torch.randn(6, 32, 24, dtype=torch.complex128, generator=made)
    other = noise + torch.linspace(0.05, 1, 6)[:, None, None] * torch.randn(noise.shape, generator=made)
    alone = torch.stack([registered_error_db(a, b) for a, b in zip(other, noise, strict=True)])
    torch.testing.assert_close(registered_error_db(other, noise), alone, rtol=0, atol=1e-9)
