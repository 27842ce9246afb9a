"""Common parts of the figures of several targets with non-uniform rotation."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torch import Tensor

from torchsar.compensate import EntropyObjective, ImageEntropy, coarse_rotation, entropy_rotation
from torchsar.core import Axis, Estimate, Signal
from torchsar.focus import MatchedFourier, RangePhase
from torchsar.radar import LIGHT_M_S, InverseRadar


def ladar(cell_m: float, prf_hz: float) -> InverseRadar:
    """Describe a ladar at 1.55 um.

    Args:
        cell_m: Size of a range cell in m.
        prf_hz: Pulse rate in Hz.

    Returns:
        The ladar.
    """
    return InverseRadar(LIGHT_M_S / 1.55e-6, LIGHT_M_S / (2 * cell_m), prf_hz)


def known_of(signal: Signal, radar: InverseRadar) -> dict[str, Any]:
    """Gather what estimators of the rotation take besides the data.

    Args:
        signal: Range-compressed pulses.
        radar: Ladar that recorded them.

    Returns:
        Arguments by name.
    """
    return {"wavelength_m": radar.wavelength_m, "prf_hz": radar.prf_hz, "range_m": signal.axis("range").values()}


def focused(signal: Signal, radar: InverseRadar, rotation: Mapping[str, Tensor]) -> Signal:
    """Form the image on a Doppler axis, with the effects of a given rotation removed.

    Args:
        signal: Range-compressed pulses.
        radar: Ladar that recorded them.
        rotation: All parameters of the rotation, its warp alone, or nothing.

    Returns:
        The image, with the axes doppler and range.
    """
    if "omega_rad_s" in rotation:
        signal = RangePhase(radar)(signal, **{name: rotation[name] for name in ("omega_rad_s", "warp_k", "yc_m")})
    return MatchedFourier(radar)(signal, rotation.get("warp_k"))


def in_metres(image: Signal, radar: InverseRadar, rate_rad_s: Tensor) -> Signal:
    """Express the Doppler frequencies of an image as cross range.

    Args:
        image: Image with the axes doppler and range.
        radar: Ladar.
        rate_rad_s: Mean rotation rate in rad/s.

    Returns:
        The image with an azimuth axis in m.
    """
    doppler, range_ = image.axes
    scale = radar.wavelength_m / (2 * float(rate_rad_s))
    return Signal(image.data, (Axis("azimuth", doppler.n, doppler.start * scale, doppler.step * scale, "m"), range_))


def second_order(signal: Signal, radar: InverseRadar) -> Estimate:
    """Estimate by the second-order method (SM), azimuth only: its one number from short sections,
    then by least entropy. It is not k1 of the target but about k1 + k2 T / 2.

    Args:
        signal: Range-compressed pulses.
        radar: Ladar that recorded them.

    Returns:
        The estimate of the warp.
    """
    figure = ImageEntropy.of(signal, radar, EntropyObjective(order=2, range_term=False))
    return entropy_rotation(
        figure, "descent", figure.start(0.0, coarse_rotation(signal.data, order=2, **known_of(signal, radar))["warp_k"])
    )
