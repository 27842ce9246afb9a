"""Radial velocity from the product of the up sweep and the mirrored down sweep."""

from __future__ import annotations

from typing import get_args

from torch import Tensor

from torchsar.compensate.radial.bands import Bands
from torchsar.compensate.radial.blocks import Window, _SweepEstimator, velocities
from torchsar.compensate.radial.measured import Intercept, Law, Measured
from torchsar.compensate.radial.product import mirror_velocity
from torchsar.core import (
    Axis,
    Estimate,
    differentiable,
)
from torchsar.radar import TriangularLadar


@differentiable("where ok")
def mirror_product(
    sweeps: Tensor,
    radar: TriangularLadar,
    pulse: Axis,
    *,
    window_m: tuple[float, float] | None = None,
    intercept: Intercept = "known",
    taper: float = 1.0,
    azimuth_m: Tensor | float = 0.0,
    assess: bool = True,
) -> Estimate:
    """Estimate the radial velocity from the product of the up sweep and the mirrored down sweep.

    >>> import torch
    >>> from torchsar.compensate import mirror_product
    >>> from torchsar.radar import TriangularLadar
    >>> ladar = TriangularLadar(1.934e14, 5e9, 16e-6, 16e6, 60.0, 3000.0)
    >>> sweeps = torch.ones(2, 64, 128, dtype=torch.complex64)  # a point at the reference range
    >>> found = mirror_product(sweeps, ladar, ladar.sweep_axes(64)[1])
    >>> bool(found["velocity_m_s"].abs().max() < 0.01)
    True

    Let u be the time from the middle of a sweep, fc the carrier frequency and K the chirp rate. The
    product z(u) = up(u) conj(down(-u)) combines two samples of equal optical frequency fc + K u.
    Therefore z(u) = |scene(u)|^2 exp(-j 4 pi / c (fc + K u) (T - 2u) v), with the radial velocity
    v, the length T of a sweep and the propagation speed c, whatever scatterers lie in the window.
    The two samples lie symmetrically about the turning point, the end of the up sweep, so that
    acceleration cancels; jerk remains. Differentiable, except for the peak search, whose result
    Newton steps refine.

    Args:
        sweeps: Up and down sweeps of N samples each, shape (..., 2, pulse, N), complex.
        radar: Ladar parameters.
        pulse: Slow-time axis; each entry is a period of one up and one down sweep.
        window_m: Lowest and highest range in metres, relative to the reference range; None for the
            whole band. The window follows the Doppler shift.
        intercept: What is assumed of the phase of z at the turning point, u = T / 2. "known" takes
            it as zero; this requires accurate trigger timing and lowers the variance by a factor of
            four. "free" assumes nothing and uses only the slope of the phase. "record" estimates
            one constant phase for the whole record, for an unknown but constant timing error.
        taper: Share of the window that its edges take, see `Spectra.bands`.
        azimuth_m: Azimuth of the scene centre in metres, a number or shape (...,). The radial
            velocity that the straight flight causes there is subtracted, see
            `geometric_velocity_m_s`.
        assess: False leaves out the standard deviation and the outcome.

    Returns:
        `velocity_m_s` of shape (..., pulse) at the turning points (ends of the up sweeps), receding
        positive. In periods without an echo, or whose echo has faded, it is interpolated. The
        velocity is that of the centre of power of the echo: a centre at another azimuth than
        `azimuth_m` adds a nearly constant velocity, which displaces the image and is not part of
        the standard deviation. Where many scatterers have equal phases, the error may be four times
        the standard deviation. The edges of a narrow window change the power of the two sweeps in
        opposite ways when the velocity changes; at high SNR the standard deviation counts this as
        error and may be many times too large, less so with a small `taper`.
        `assess=True` adds the standard deviation and the outcome, see `assessed_velocity`:
        `Outcome.INEXACT` where the SNR is too low or the standard deviation exceeds
        0.035 lambda / T (T is the length of a sweep), `PARTS_DISAGREE` where a part of the echo has
        another velocity, `AMBIGUOUS` where both sweeps have more power in common at another
        velocity, `NOISE` where they have no more in common than noise, and `EMPTY` for samples of
        zero. `quality` is the share of the power in the window that both
        sweeps have in common. `info` holds "snr_db" (after compression) and "noise_m_s"
        (standard deviation that noise explains), shape (...,); "shift" (Doppler shift in whole
        bins) and "lit" (True in periods with an echo), shape (..., pulse);
        and, with intercept "record", "intercept_rad", the estimated phase, shape (...,).

    Raises:
        TypeError: If the sweeps are not complex.
        ValueError: If the sweeps, the window or the intercept are invalid.
    """
    refuse_other_intercept(intercept)
    return velocities(
        "mirror_product",
        lambda spectra: mirror_measured(spectra.bands(window_m, taper, oversampling=2), intercept),
        sweeps,
        radar,
        pulse,
        azimuth_m,
        assess,
    )


def mirror_measured(bands: Bands, intercept: Intercept) -> Measured:
    """Measure the radial velocity as `mirror_product` does, in sweeps that are already filtered.

    Args:
        bands: Sweeps filtered to the range window, with two samples per bin.
        intercept: "known", "record" or "free", see `mirror_product`.

    Returns:
        The velocities.
    """
    velocity, info = mirror_velocity(bands, intercept)
    return Measured.of(velocity, bands, Law(3.0 if intercept == "free" else 0.75, intercept), **info)


def refuse_other_intercept(intercept: str) -> None:
    """Check the option `intercept` of `mirror_product`.

    Args:
        intercept: The value given.

    Raises:
        ValueError: If the value is not "known", "record" or "free".
    """
    if intercept not in get_args(Intercept):
        raise ValueError(f"intercept must be 'known', 'record' or 'free', got {intercept!r}")


class MirrorProduct(_SweepEstimator):
    """Radial velocity by the product of up and mirrored down sweeps; see `mirror_product`.

    Provides `velocity_m_s` of shape (..., pulse) at the turning points (ends of the up sweeps),
    receding positive.

    Args:
        radar: Ladar parameters.
        window_m: Lowest and highest range in metres, relative to the reference range; None for the
            whole band.
        intercept: What is assumed of the phase of the product of up and mirrored down sweep at the
            turning point: "known", "record" or "free", see `mirror_product`.
        taper: Share of the window that its edges take, see `Spectra.bands`.
        azimuth_m: Azimuth of the scene centre in metres.
        assess: False leaves out standard deviation and outcome.

    Raises:
        ValueError: If the window does not have two values.
    """

    estimator = staticmethod(mirror_product)

    def __init__(
        self,
        radar: TriangularLadar,
        window_m: Window = None,
        intercept: Intercept = "known",
        taper: float = 1.0,
        azimuth_m: float = 0.0,
        assess: bool = True,
    ) -> None:
        super().__init__(radar, window_m, azimuth_m, assess, intercept=intercept, taper=taper)
