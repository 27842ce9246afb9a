"""Autofocus through the images of antennas on any path."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.recommended import autofocus
from torchsar.core import Estimate, Signal, Stage, checked_samples
from torchsar.focus import ImageGrid, TileOperator, TilePlan
from torchsar.radar import LIGHT_M_S, AntennaPath
from torchsar.radar.antenna_path import refuse_unusable
from torchsar.radar.spotlight import frequency_step_hz

# pixel spacing in resolution cells, by choice: images are sampled above their bandwidth
_STEP = 0.7
# error of the images in dB, by choice: far below what noise and side lobes leave
_ERROR_DB = -40.0


def path_autofocus(
    profiles: Tensor,
    frequency_hz: Tensor,
    antennas: AntennaPath,
    *,
    height_m: float = 0.0,
    search: int = 120,
    polish: int = 20,
) -> Estimate:
    """Estimate the phase of each pulse that sharpens the image of a spotlight scene on any path.

    It is `autofocus` with images by tiles along the recorded path, in which scatterers do not
    migrate. They cover the whole unambiguous ground, about a quarter of an image per pulse and
    second on one core for some hundred pulses. The middle of the scene, to which phases refer, is
    the origin.

    Args:
        profiles: Range profiles, the unitary centred inverse FFT of a phase history, shape (...,
            pulse, range), complex.
        frequency_hz: Frequencies in Hz, rising in equal steps, float64 (range,).
        antennas: Recorded path of the antennas, of all trials or of each of them.
        height_m: Height z of the imaged plane in metres.
        search: Largest number of iterations of the entropy fixed point, approximately.
        polish: Largest number of further iterations, which compare each pulse with a Wiener
            estimate of the scene.

    Returns:
        `phase_rad` of shape (..., pulse), to be removed, with its standard deviation, `quality` and
        `ok` as for `autofocus`. They describe errors of one phase per pulse: errors of the path
        that move envelopes by a range cell or act differently across the scene are not part of
        them. The halves of the range cells, whose difference gives the standard deviation, are
        compared without correction of migration: above about 10 dB it is two to four times too
        large where scatterers migrate through several cells.

    Raises:
        TypeError: If the profiles are not complex, or frequencies are not float64.
        ValueError: If sizes do not match, values are not finite, or the line of sight does not
            turn.
    """
    profiles = checked_samples(profiles, "path_autofocus", "pulse, range")
    refuse_unusable(frequency_hz=frequency_hz)
    size = antennas.pulses, len(frequency_hz)
    if profiles.shape[-2:] != size:
        raise ValueError(f"path_autofocus needs profiles (..., pulse, range) of {size}, got {tuple(profiles.shape)}")
    trials = torch.broadcast_shapes(profiles.shape[:-2], antennas.trials)
    if antennas.trials.numel() == 1:
        one = _reshaped(antennas, (), (0,) * len(antennas.trials))
        return autofocus(profiles, search=search, polish=polish, imaging=_operator(frequency_hz, one, height_m))
    # each trial has a plan of its own, whose image alone fills the cache
    data = profiles.expand(*trials, *size)
    found = []
    for index in torch.cartesian_prod(*(torch.arange(n) for n in trials)).reshape(-1, len(trials)).tolist():
        one = _reshaped(antennas, trials, tuple(index))
        imaging = _operator(frequency_hz, one, height_m)
        found.append(autofocus(data[tuple(index)], search=search, polish=polish, imaging=imaging))

    def joined(parts: list[Tensor]) -> Tensor:
        return torch.stack(parts).reshape(*trials, *parts[0].shape)

    return Estimate(
        {key: joined([one.value[key] for one in found]) for key in found[0].value},
        joined([one.quality for one in found]),
        joined([one.ok for one in found]),
        {key: joined([one.std[key] for one in found]) for key in found[0].std},
    )


def _reshaped(antennas: AntennaPath, trials: tuple[int, ...], index: tuple[int, ...]) -> AntennaPath:
    """The path of one trial."""

    def of(x: Tensor, behind: int) -> Tensor:
        lead = trials or tuple(antennas.trials)
        return x.expand(*lead, *x.shape[x.ndim - behind :])[index]

    receiver = None if antennas.receiver_m is None else of(antennas.receiver_m, 2)
    return AntennaPath(of(antennas.transmitter_m, 2), receiver, of(antennas.reference_m, 1))


def _operator(frequency_hz: Tensor, antennas: AntennaPath, height_m: float) -> TileOperator:
    """Image of the whole unambiguous ground about the origin, for one path."""
    middle = torch.zeros(3, dtype=torch.float64, device=frequency_hz.device)
    middle[2] = height_m
    with torch.no_grad():
        sights = torch.stack([middle - place for place in antennas.places])
        slope = (sights / torch.linalg.vector_norm(sights, dim=-1, keepdim=True)).sum(0)
        slope = (slope * (2 / len(antennas.places)))[:, :2]  # change of the path per metre, (pulse, 2)
        away = slope.mean(0)
        steep = float(torch.linalg.vector_norm(away))
        across = torch.stack([-away[1], away[0]]) / max(steep, 1e-300)
        turn = slope @ across
        span, step = float(turn.max() - turn.min()), float(turn.diff().abs().mean())
    band = float(frequency_hz[-1] - frequency_hz[0])
    wavelength = LIGHT_M_S / float(frequency_hz.mean())
    if not (span > 0 and steep > 0):
        raise ValueError("path_autofocus needs a line of sight that turns over the ground; the path has none")
    extent = wavelength / step, LIGHT_M_S / (frequency_step_hz(frequency_hz) * steep)
    spacing = _STEP * min(wavelength / span, LIGHT_M_S / (band * steep))
    counts = tuple(max(2, math.ceil(x / spacing)) for x in extent)
    axes = torch.zeros(2, 3, dtype=torch.float64, device=frequency_hz.device)
    axes[0, :2], axes[1, :2] = across, away / steep
    corner = middle - spacing * sum(n // 2 * axis for n, axis in zip(counts, axes, strict=True))
    grid = ImageGrid(corner, axes, (counts[0], counts[1]), spacing)
    places = antennas.transmitter_m, antennas.receiver_m, antennas.reference_m
    return TileOperator(TilePlan(frequency_hz, *places, grid, _ERROR_DB))


class PathAutofocus(Stage):
    """Phase per pulse that sharpens the image along any path; see `path_autofocus`.

    Args:
        height_m: Height z of the imaged plane in metres.
        search: Largest number of iterations of the entropy fixed point, approximately.
        polish: Largest number of further iterations, which compare each pulse with a Wiener
            estimate of the scene.
    """

    provides = ("phase_rad",)
    neutral = {"phase_rad": 0.0}

    def __init__(self, height_m: float = 0.0, search: int = 120, polish: int = 20) -> None:
        super().__init__()
        self.height_m, self.search, self.polish = height_m, search, polish

    def forward(
        self,
        signal: Signal,
        frequency_hz: Tensor,
        transmitter_m: Tensor,
        path_reference_m: Tensor,
        receiver_m: Tensor | None = None,
    ) -> Estimate:
        """Estimate the phase error of every pulse of a signal with the axes (pulse, range).

        Args:
            signal: Range profiles.
            frequency_hz: Frequencies in Hz, float64 (range,).
            transmitter_m: Positions of the transmitter in metres, float64 (..., pulse, 3).
            path_reference_m: Path to which phases refer in metres, float64 (..., pulse).
            receiver_m: Positions of the receiver in metres; None if both share an antenna.

        Returns:
            `Estimate` by `path_autofocus` with `phase_rad` of shape (..., pulse), to be removed.
        """
        antennas = AntennaPath(transmitter_m, receiver_m, path_reference_m)
        how = {"height_m": self.height_m, "search": self.search, "polish": self.polish}
        return path_autofocus(signal.data, frequency_hz, antennas, **how)
