"""Path lengths about the centres of tiles: exact slopes, and the parts that a tile approximates.

A pixel is at (x, y) from the centre of its tile along the axes of the image. For pulse p, l_p is
the path from the transmitter over the pixel to the receiver; a and b are its derivatives along x
and y at the centre. The index 0 denotes a reference place in the middle of the sub-aperture. With

    eps = b / b_0 - 1,    s = a / (1 + eps) - a_0,

the wave number k = k_c / (1 + eps) + q of pulse p has the phase

    k (l_p(x, y) - l_p(0, 0)) = k_c (l_0(x, y) - l_0(0, 0)) + (k_c + q) x s
                                + q (a_0 x + b_0 y) + small terms in x, y, q and s,

which depends on the pulse only through s. The small terms are polynomials of second order in x and
y. They consist of second derivatives of the path, divided by 1 + eps, and of eps itself; their
coefficients are fitted as polynomials of s. Terms that are common to all tiles are exact functions
of s and x. Those of a single tile, and all that multiply y, are expanded to second order
(`remainders`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

# number of powers of s whose sums over the pulses are formed: 1, s and s^2, the order of the
# expansion
MOMENTS = 3


def slopes(places: Sequence[Tensor], centre: Tensor, axes: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Path length and its derivatives along the axes of the image.

    Args:
        places: Positions of the antenna (monostatic, the path is twice its range) or of transmitter
            and receiver in metres, each float64 (..., pulse, 3).
        centre: Positions of the centres in metres, float64 (tile, 3).
        axes: Unit vectors, float64 (2, 3).

    Returns:
        Path in metres, and derivatives along either axis, float64 (tile, ..., pulse).
    """
    path = along_x = along_y = torch.zeros((), dtype=centre.dtype, device=centre.device)
    for place in places:
        away = centre.reshape(-1, *(1,) * (place.ndim - 1), 3) - place
        length = torch.linalg.vector_norm(away, dim=-1)
        inverse = 1 / length
        path, along_x, along_y = (
            path + length,
            along_x + (away @ axes[0]) * inverse,
            along_y + (away @ axes[1]) * inverse,
        )
    scale = 3 - len(places)
    return scale * path, scale * along_x, scale * along_y


def curvatures(places: Sequence[Tensor], centre: Tensor, axes: Tensor) -> Tensor:
    """Second derivatives of the path length along the axes of the image.

    Args:
        places: Positions of one or two antennas in metres, as in `slopes`.
        centre: Positions of the centres in metres, float64 (tile, 3).
        axes: Unit vectors, float64 (2, 3).

    Returns:
        Derivatives xx, xy, yy in 1/m, float64 (tile, ..., pulse, 3).
    """
    total = torch.zeros((), dtype=centre.dtype, device=centre.device)
    for place in places:
        away = centre.reshape(-1, *(1,) * (place.ndim - 1), 3) - place
        length = torch.linalg.vector_norm(away, dim=-1)
        p, t = ((away @ axis) / length for axis in axes)
        total = total + torch.stack([1 - p * p, -p * t, 1 - t * t], -1) / length[..., None]
    return (3 - len(places)) * total


def climb(places: Sequence[Tensor], centre: Tensor, axes: Tensor) -> Tensor:
    """Derivative of the path length along the normal of the image.

    Args:
        places: Positions of one or two antennas in metres, as in `slopes`.
        centre: Positions of the centres in metres, float64 (tile, 3).
        axes: Unit vectors, float64 (2, 3).

    Returns:
        Derivatives, float64 (tile, ..., pulse).
    """
    axis = torch.linalg.cross(*axes)
    return slopes(places, centre, torch.stack([axis, axis]))[1]


@dataclass(frozen=True, eq=False)
class Expansion:
    """Polynomials of s that describe the path lengths of tiles.

    Args:
        centre: Centres of the tiles in metres, float64 (tile, 3).
        axes: Axes of the image, float64 (2, 3).
        reference: Reference place of each antenna in metres, float64 (1, 3).
        path_m: Path of the reference, float64 (tile, 1).
        a: Derivative of the path of the reference along x, float64 (tile, 1).
        b: Derivative of the path of the reference along y, float64 (tile, 1).
        c: Derivative of the path of the reference along the normal, float64 (tile, 1).
        curvature: Second derivatives xx, xy, yy of the reference, float64 (tile, 3).
        fit: Coefficients of s and s^2 for (xx, xy, yy, eps, c), float64 (tile, 2, 5).
        common: Means of a and of the coefficients over the tiles, float64 (), (2, 5).
        carrier: Wave number k_c in rad/m.
    """

    centre: Tensor
    axes: Tensor
    reference: Sequence[Tensor]
    path_m: Tensor
    a: Tensor
    b: Tensor
    c: Tensor
    curvature: Tensor
    fit: Tensor
    common: tuple[Tensor, Tensor]
    carrier: float

    @classmethod
    def of(
        cls, places: Sequence[Tensor], reference: Sequence[Tensor], centre: Tensor, axes: Tensor, carrier: float
    ) -> Expansion:
        """Fit the polynomials to sampled places.

        Args:
            places: Sampled positions of one or two antennas, each float64 (pulse, 3).
            reference: Reference place of each antenna, float64 (1, 3).
            centre: Centres of the tiles, float64 (tile, 3).
            axes: Axes of the image, float64 (2, 3).
            carrier: Wave number k_c in rad/m.
        """
        # the reference is the first pulse
        every = [torch.cat(pair) for pair in zip(reference, places, strict=True)]
        path, a, b = slopes(every, centre, axes)
        bends, climbs = curvatures(every, centre, axes), climb(every, centre, axes)
        path, a0, b0, c0 = (v[:, :1] for v in (path, a, b, climbs))
        h0 = bends[:, 0]
        stretch = b[:, 1:] / b0
        s = a[:, 1:] / stretch - a0
        scale = s.abs().amax(-1, keepdim=True).clamp_min(1e-30)
        t = s / scale
        wanted = torch.cat(
            [
                bends[:, 1:] / stretch[..., None] - h0[:, None],
                (stretch - 1)[..., None],
                (climbs[:, 1:] / stretch - c0)[..., None],
            ],
            -1,
        )
        powers = torch.stack([t, t * t], -1)
        fit = torch.linalg.pinv(powers, rtol=1e-8) @ wanted
        fit = fit / torch.stack([scale, scale * scale], -2)
        return cls(centre, axes, reference, path, a0, b0, c0, h0, fit, (a0.mean(), fit.mean(0)), carrier)

    def common_phase(self, s: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
        """Phase in rad that all tiles have in common at the carrier, and its derivative in m with
        respect to the wave number.

        s and x (in m) broadcast with each other.
        """
        a, fit = self.common
        bend = 0.5 * (fit[0, 0] * s + fit[1, 0] * s * s)
        stretch = fit[0, 3] * s + fit[1, 3] * s * s
        path = x * s + x * x * bend
        return self.carrier * path, path + x * (a + s) * stretch

    def rows(self, rows: slice) -> Expansion:
        """Return the expansion of some of the tiles."""
        mine = {name: getattr(self, name)[rows] for name in ("centre", "path_m", "a", "b", "c", "curvature", "fit")}
        return replace(self, **mine)

    def tile_path(self, x: Tensor) -> Tensor:
        """Path in m that is due to x (x,) alone, (tile, x)."""
        return self.a * x + 0.5 * self.curvature[:, :1] * x * x

    def range_path(self, y: Tensor) -> Tensor:
        """Path in m that is due to y (y,) alone, (tile, y)."""
        return self.b * y + 0.5 * self.curvature[:, 2:] * y * y

    def remainders(
        self, q: Tensor, x: Tensor, order: int, dims: int = 1, *, heights: bool = False
    ) -> list[list[Tensor]]:
        """Complex weights of the moments of s: a list over `factors` of lists over powers of s.

        The remaining phase of a tile is alpha(s) + y beta(s) + y^2 gamma(s) + h delta(s) at the
        height h; its exponential is expanded to second order, with the powers of s up to the second
        and those of y up to `order`.

        Args:
            q: Wave numbers relative to the carrier in rad/m.
            x: Positions in m.
            order: Highest power of y, 1 or 2.
            dims: Dimensions of the weights behind that of the tiles, with which q and x broadcast.
            heights: Whether pixels have heights.

        Returns:
            Weights, complex128.
        """
        behind = (-1, *(1,) * dims)
        (xx1, xy1, yy1, e1, c1), (xx2, xy2, yy2, e2, c2) = (
            tuple(v.reshape(behind) for v in part.unbind(-1)) for part in self.fit.unbind(1)
        )
        a, b, c, xy0 = (v.reshape(behind) for v in (self.a, self.b, self.c, self.curvature[:, 1]))
        mean_a, mean = self.common
        k = self.carrier + q
        # terms that differ between tiles
        alpha1 = 0.5 * k * (xx1 - mean[0, 0]) * x * x + q * (a * e1 - mean_a * mean[0, 3]) * x
        alpha2 = 0.5 * k * (xx2 - mean[1, 0]) * x * x + q * (a * e2 - mean_a * mean[1, 3] + e1 - mean[0, 3]) * x
        beta0, beta1, beta2 = q * xy0 * x, k * xy1 * x + q * b * e1, k * xy2 * x + q * b * e2
        weights = [
            [torch.ones_like(beta0), 1j * alpha1, 1j * alpha2 - alpha1 * alpha1 / 2],
            [1j * beta0, 1j * beta1 - alpha1 * beta0, 1j * beta2 - alpha1 * beta1 - alpha2 * beta0],
        ]
        if order == 2:
            gamma1, gamma2 = 0.5 * k * yy1, 0.5 * k * yy2
            weights.append(
                [
                    -beta0 * beta0 / 2,
                    1j * gamma1 - beta0 * beta1,
                    1j * gamma2 - beta1 * beta1 / 2 - beta0 * beta2,
                ]
            )
        if heights:
            none = torch.zeros_like(beta0)
            delta1, delta2 = k * c1 + q * c * e1, k * c2 + q * c * e2
            weights += [
                [none, none + 1j * delta1, 1j * delta2 - alpha1 * delta1],
                [none, -beta0 * delta1, -beta1 * delta1 - beta0 * delta2],
                [none, none, none - delta1 * delta1 / 2],
            ]
        return weights

    @staticmethod
    def factors(y: Tensor, order: int, height_m: Tensor | None = None) -> list[Tensor]:
        """Factors of the weights of `remainders` at positions y in m and heights in m."""
        powers = [y**power for power in range(order + 1)]
        return powers if height_m is None else [*powers, height_m, y * height_m, height_m * height_m]

    def error(
        self, places: Sequence[Tensor], wave: Tensor, x: Tensor, y: Tensor, order: int, height_m: float = 0.0
    ) -> Tensor:
        """Phasor that a tile gives to a single sample, relative to the exact one, less 1.

        Args:
            places: Positions of one or two antennas, each float64 (pulse, 3).
            wave: Wave numbers in rad/m, float64 (wave number,).
            x: Positions from the centre in m, float64 (x,).
            y: Positions from the centre in m, float64 (y,).
            order: Highest power of y, 1 or 2.
            height_m: Height of the pixels above the plane of the tile in m.

        Returns:
            Errors, complex128 (tile, pulse, wave number, x, y).
        """
        path, a, b = slopes(places, self.centre, self.axes)
        stretch = b / self.b
        shape, raised = (len(self.centre), len(x), len(y)), height_m != 0
        plane = self.centre[:, None, None] + x[:, None, None] * self.axes[0] + y[:, None] * self.axes[1]
        plane = plane.flatten(0, 2)
        pixels = plane + height_m * torch.linalg.cross(*self.axes) if raised else plane

        def excess(of: Sequence[Tensor], centre_m: Tensor, pixels: Tensor) -> Tensor:
            far = slopes(of, pixels, self.axes)[0].unflatten(0, shape).movedim(-1, 1)
            return (far - centre_m[..., None, None])[:, :, None]

        x, (a0, b0) = x[:, None], (v[..., None, None, None] for v in (self.a, self.b))
        s = (a / stretch - self.a)[..., None, None, None]
        q = wave[:, None, None] - (self.carrier / stretch)[..., None, None, None]
        xx0, _, yy0 = (v.reshape(-1, 1, 1, 1, 1) for v in self.curvature.unbind(-1))
        constant, per_wave = self.common_phase(s, x)
        exact = excess(self.reference, self.path_m, pixels)
        phase = constant + q * per_wave + self.carrier * exact
        if raised:
            phase = phase + q * (exact - excess(self.reference, self.path_m, plane))
        phase = phase + q * (a0 * x + 0.5 * xx0 * x * x + b0 * y + 0.5 * yy0 * y * y)
        phase = phase - wave[:, None, None] * excess(places, path, pixels)
        factors = self.factors(y, order, torch.full_like(y, height_m) if raised else None)
        parts = (
            factor * sum(weight * s**moment for moment, weight in enumerate(weights))
            for factor, weights in zip(factors, self.remainders(q, x, order, 4, heights=raised), strict=True)
        )
        return torch.exp(1j * phase) * sum(parts) - 1
