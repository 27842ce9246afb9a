"""Yardstick of all systems: the recommended image beside the direct sum, at random pixels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from torchsar.core import Draws, unit_phasor
from torchsar.focus.backprojection import direct_sum
from torchsar.metrics import error_after_gain_db
from torchsar.radar import LIGHT_M_S, AntennaPath, InverseRadar, frequency_samples
from torchsar.study.trials.bench import Bench
from torchsar.study.trials.choice import Alternative, Choice, Measured

# distance of the antenna from a turntable: float64 resolves a path to 3e-11 m there
_FAR_M = 1e5
# pixels at which images are compared, by choice
PIXELS = 256


@dataclass(frozen=True)
class Imaged:
    """An image of a phase history, and the geometry in which the direct sum forms it.

    Args:
        history: Phase history, shape (pulse, frequency), complex128: white noise, or echoes of
            points near the pixels.
        frequency_hz: Frequencies in Hz, float64 (frequency,).
        antennas: Positions of the antennas at the pulses, without leading dimensions. Those of a
            turntable are far away.
        pixels_m: Positions of the pixels in metres, float64 (*pixels, 3).
        image: Function that forms the image of the history by the recommended method, complex
            (*pixels), in the phase of the direct sum.
        weight: Weights of some pulses (a slice) at positions (pixel, 3) in the sum, float64 (pulse,
            pixel); None for all pulses alike.
        wave_speed_m_s: Propagation speed in m/s.
        whole: Number of pixels of the whole image, if `pixels_m` holds random ones only.
    """

    history: Tensor
    frequency_hz: Tensor
    antennas: AntennaPath
    pixels_m: Tensor
    image: Callable[[], Tensor]
    weight: Callable[[slice, Tensor], Tensor] | None = None
    wave_speed_m_s: float = LIGHT_M_S
    whole: int | None = None

    def exact(self, some: Tensor) -> Tensor:
        """Return the direct sum at some pixels, given by their numbers in `pixels_m`."""
        points = self.pixels_m.reshape(-1, 3)[some]

        def path(pulses: slice, pixels: slice) -> tuple[Tensor, Tensor | None]:
            weight = None if self.weight is None else self.weight(pulses, points[pixels])
            return self.antennas.path_m(points[pixels], pulses), weight

        speed = self.wave_speed_m_s
        return direct_sum(self.history, self.frequency_hz, path, len(points), wave_speed_m_s=speed)


def turntable(
    radar: InverseRadar,
    profiles: Tensor,
    angle_rad: Tensor,
    cross_m: Tensor,
    centre_m: float,
    image: Callable[[], Tensor],
) -> Imaged:
    """Return the image of a turning target, whose antenna moves along a far arc instead.

    Args:
        radar: Radar parameters.
        profiles: Range profiles, complex128 (pulse, range).
        angle_rad: Angle of the target at each pulse, float64 (pulse,).
        cross_m: Cross range of the lines of the image in metres, float64 (azimuth,).
        centre_m: Distance of range zero from the centre of rotation in metres.
        image: Function that forms the image, complex (azimuth, range), with the phase of the target
            at the angle zero.
    """
    n = profiles.shape[-1]
    cell = torch.arange(n, dtype=torch.float64) - n // 2
    along = torch.stack([torch.sin(angle_rad), torch.cos(angle_rad), torch.zeros_like(angle_rad)], -1)
    reference = torch.full_like(angle_rad, 2 * (_FAR_M + centre_m))
    pixels = torch.cartesian_prod(cross_m, centre_m + cell * radar.range_step_m)
    pixels = torch.cat([pixels, torch.zeros(len(pixels), 1, dtype=torch.float64)], -1)
    still = AntennaPath(-_FAR_M * torch.eye(3, dtype=torch.float64)[1:2], None, reference[:1])
    phase = unit_phasor(still.path_m(pixels)[0] / radar.wavelength_m, profiles.dtype).view(len(cross_m), n)
    return Imaged(
        frequency_samples(profiles),
        radar.carrier_hz + cell * (radar.bandwidth_hz / n),
        AntennaPath(-_FAR_M * along, None, reference),
        pixels.view(len(cross_m), n, 3),
        lambda: image() * phase.to(torch.complex64),
        wave_speed_m_s=radar.wave_speed_m_s,
    )


def some_pixels(bench: Bench, count: int) -> Tensor:
    """Return the numbers of random pixels of an image with so many, (pixel,) int64."""
    return Draws(bench.config.seed).subset("trade.pixels", count, min(PIXELS, count))


def noise_of(bench: Bench, pulses: int, samples: int) -> Tensor:
    """Return white noise on which images are compared, complex128 (pulse, sample)."""
    return Draws(bench.config.seed).normal("trade.noise", (pulses, samples), torch.complex128)


def beside_direct_sum(bench: Bench, imaged: Callable[[], Imaged], neglects: str) -> Choice:
    """Return the comparison of the recommended image with the direct sum at random pixels.

    Args:
        bench: Bench of the config.
        imaged: Function that prepares the image.
        neglects: What the recommended image neglects.
    """
    alternatives = [
        Alternative("recommended image", {"exact": False}, None, neglects),
        Alternative("direct sum, times extrapolated from random pixels", {"exact": True}),
    ]
    return Choice("image beside the direct sum", "image", alternatives, partial(_measured, bench, imaged))


def _measured(bench: Bench, imaged: Callable[[], Imaged]) -> Measured:
    of = imaged()
    count = of.pixels_m[..., 0].numel()
    some = some_pixels(bench, count)
    exact = of.exact(some)

    def loss(one: Alternative, made: Tensor) -> dict[str, float]:
        made = made if one.keys["exact"] else made.reshape(-1)[some]
        return {"image_error_db": float(error_after_gain_db(made[None].to(exact.dtype), exact[None]))}

    return Measured(
        lambda one: of.exact(some) if one.keys["exact"] else of.image(),
        loss,
        lambda one: len(some) / (of.whole or count) if one.keys["exact"] else 1.0,
    )
