"""Geocentric and local coordinates against known points, and their inverses."""

from __future__ import annotations

import pytest
import torch

from torchsar.radar import LocalFrame, geocentric

F64 = torch.float64


def point(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=F64)


def test_known_points() -> None:
    """The ends of the axes: semi-axes of WGS 84, 6378137 m and 6356752.314245 m."""
    latitude, longitude = point(0.0, 0.0, 90.0, -90.0), point(0.0, 90.0, 0.0, 30.0)
    found = geocentric(latitude, longitude, point(0.0, 100.0, 0.0, 10.0))
    a, b = 6378137.0, 6356752.314245
    known = torch.tensor([[a, 0, 0], [0, a + 100, 0], [0, 0, b], [0, 0, -b - 10]], dtype=F64)
    torch.testing.assert_close(found, known, rtol=0, atol=1e-6)


def test_points_lie_on_the_ellipsoid_and_heights_along_its_normal() -> None:
    latitude, longitude = torch.meshgrid(
        torch.linspace(-89, 89, 13, dtype=F64), torch.linspace(-180, 180, 9, dtype=F64), indexing="ij"
    )
    at = geocentric(latitude, longitude, torch.zeros_like(latitude))
    level = (at / point(6378137.0, 6378137.0, 6356752.314245)).square().sum(-1)
    torch.testing.assert_close(level, torch.ones_like(level), rtol=1e-12, atol=0)
    up = geocentric(latitude, longitude, torch.full_like(latitude, 1000.0)) - at
    slope = 2 * at / point(6378137.0, 6378137.0, 6356752.314245).square()
    cosine = torch.nn.functional.cosine_similarity(up, slope, dim=-1)
    torch.testing.assert_close(cosine, torch.ones_like(cosine), rtol=0, atol=1e-12)
    torch.testing.assert_close(torch.linalg.vector_norm(up, dim=-1), torch.full_like(latitude, 1000.0))


def test_local_axes_point_east_north_and_up() -> None:
    frame = LocalFrame(48.1, 11.6, 500.0)
    latitude, longitude = point(48.1, 48.1, 48.1 + 1e-5, 48.1), point(11.6, 11.6 + 1e-5, 11.6, 11.6)
    local = frame.local_m(geocentric(latitude, longitude, point(500.0, 500.0, 500.0, 507.0)))
    assert float(local[0].abs().max()) < 1e-8
    # radii of curvature of WGS 84 at this latitude: 6390017 m across, 6370848 m along the meridian
    known = [[0.745, 0, 0], [0, 1.112, 0], [0, 0, 7]]
    torch.testing.assert_close(local[1:], torch.tensor(known, dtype=F64), rtol=0, atol=5e-4)


def test_conversions_are_inverse_keep_ranges_and_pass_gradients() -> None:
    frame = LocalFrame(-33.9, 151.2, 20.0)
    made = torch.randn(2, 50, 3, dtype=F64, generator=torch.Generator().manual_seed(1)) * 1e4
    far = frame.geocentric_m(made)
    torch.testing.assert_close(frame.local_m(far), made, rtol=0, atol=1e-8)
    lengths = [torch.linalg.vector_norm(x[:, 1:] - x[:, :1], dim=-1) for x in (made, far)]
    torch.testing.assert_close(*lengths, rtol=0, atol=1e-8)
    assert torch.autograd.gradcheck(frame.local_m, far[0, :2].requires_grad_(), eps=1e-2, atol=1e-6)


def test_what_is_no_position_is_refused() -> None:
    with pytest.raises(ValueError, match="latitude_deg must be -90 to 90 degrees, got values up to 151.2"):
        LocalFrame(151.2, -33.9)
    with pytest.raises(ValueError, match="NaN"):
        LocalFrame(0.0, float("nan"))
    with pytest.raises(TypeError, match="local_m must be a float64 tensor"):
        LocalFrame(0.0, 0.0).geocentric_m(torch.zeros(3))
    with pytest.raises(ValueError, match=r"geocentric_m must have the shape \(..., 3\), got \(2,\)"):
        LocalFrame(0.0, 0.0).local_m(torch.zeros(2, dtype=F64))
