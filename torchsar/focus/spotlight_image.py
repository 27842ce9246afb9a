"""Stage that images a recording along any path on a grid that follows from its geometry."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import Signal
from torchsar.focus.path_image import TileImage
from torchsar.radar import LIGHT_M_S, AntennaPath
from torchsar.radar.spotlight import frequency_step_hz

# samples per resolution cell of the finer direction, by choice
_OVERSAMPLING = 1.25
# largest number of pixels of an image whose size is not given, by choice: a minute of computation
_MOST_PIXELS = 4_000_000


@dataclass(frozen=True)
class SceneGrid:
    """Extent, spacing and position of an image on a horizontal plane, as arguments of `PathImage`.

    Args:
        azimuth_m: Extent along the azimuth axis in metres.
        range_m: Extent along the range axis in metres.
        step_m: Sample spacing in metres.
        centre_m: Position of the centre in metres along (range axis, azimuth axis).
        range_axis_rad: Direction of the range axis in rad, from ground coordinate x towards y.
        height_m: Height of the plane in metres.
    """

    azimuth_m: float
    range_m: float
    step_m: float
    centre_m: tuple[float, float]
    range_axis_rad: float
    height_m: float


def scene_grid(frequency_hz: Tensor, antennas: AntennaPath, corners_m: Tensor | None = None) -> SceneGrid:
    """Choose the grid of an image from the geometry of its recording.

    The range axis is the mean horizontal direction in which the path grows. The spacing is 1 /
    1.25 of the finer resolution cell, the inverse of the extent of the spatial frequencies f
    (gradient of the path) / c. The image covers the corners, or without these a square about the
    origin, but no more than the band and the pulses image without ambiguity.

    Args:
        frequency_hz: Frequencies in Hz, rising in equal steps, float64 (frequency,).
        antennas: Path of the antennas without trials.
        corners_m: Corners of the scene in metres, float64 (corner, 3); None if they are not known.

    Returns:
        The grid.

    Raises:
        ValueError: If the frequencies do not rise in equal steps, or the direction to the scene
            does not change over the pulses.
    """
    centre = antennas.transmitter_m.new_zeros(3) if corners_m is None else corners_m.mean(0)
    away = [centre - place for place in antennas.places]
    slope = sum(2 / len(away) * v / torch.linalg.vector_norm(v, dim=-1, keepdim=True) for v in away)
    assert isinstance(slope, Tensor)
    mean = slope.mean(-2)
    angle = math.atan2(float(mean[1]), float(mean[0]))
    axes = slope.new_tensor([[math.cos(angle), math.sin(angle), 0.0], [-math.sin(angle), math.cos(angle), 0.0]])
    along = slope @ axes.mT  # per pulse, along range and azimuth
    ends = torch.stack([along * f / LIGHT_M_S for f in (frequency_hz[0], frequency_hz[-1])])
    band = (ends.amax((0, 1)) - ends.amin((0, 1))).tolist()
    if not (band[0] > 0 and float(along[:, 1].amax() - along[:, 1].amin()) > 0):
        raise ValueError(
            "the direction to the scene does not change over the pulses, so that there is no resolution in azimuth; "
            "an image needs antennas that move across the line of sight"
        )
    clear = (
        LIGHT_M_S / (frequency_step_hz(frequency_hz) * float(along[:, 0].abs().max())),
        LIGHT_M_S / float(frequency_hz[-1] * along[:, 1].diff().abs().max()),
    )
    step = 1 / (_OVERSAMPLING * max(band))
    if corners_m is None:
        reach = (clear[0], clear[0])
    else:
        across = (corners_m - centre) @ axes.mT
        reach = (across.amax(0) - across.amin(0)).tolist()
        reach = tuple(size if size > 0 else clear[0] for size in reach)
    range_m, azimuth_m = (max(min(*pair), step) for pair in zip(reach, clear, strict=True))
    middle = axes @ centre
    return SceneGrid(azimuth_m, range_m, step, (float(middle[0]), float(middle[1])), angle, float(centre[2]))


class SpotlightImage(TileImage):
    """Stage that images a recording by tiles on a grid that follows from its geometry.

    >>> from torchsar import Draws, echo, focus, radar, scene
    >>> sensor = radar.InverseRadar(carrier_hz=9.6e9, bandwidth_hz=160e6, prf_hz=40.0)
    >>> world = scene.PathWorld(scene.Points([0.0], [0.0]),
    ...     scene.Flight(scene.StraightPath((-300.0, -10.0, 100.0), (0.0, 20.0, 0.0))))
    >>> recording, _ = echo.simulate_path(sensor, world, 40, 16, Draws(1))
    >>> image = focus.SpotlightImage(recording.aux, 8.0, 8.0, 0.5)(recording.signal)
    >>> divmod(int(image.data.abs().argmax()), 17)  # line and sample of the peak
    (8, 8)

    The geometry is that of the side data of the recording; values that a chain connects replace it,
    such as a corrected path:

        image = SpotlightImage(recording.aux)(recording.signal)

    Extents and spacing that are not given are those of `scene_grid`; if such an image had more than
    4 million pixels, a UserWarning says how much of the scene is shown.

    Args:
        side_data: `frequency_hz`, those of `AntennaPath.side_data`, and optionally
            `scene_corners_m`, as in the recordings of `read_path` and `read_cphd`.
        azimuth_m: Extent of the image along its azimuth axis in metres.
        range_m: Extent along its range axis in metres.
        step_m: Sample spacing in metres.
        window: "none", "hann" or "range", see `PathImage`.
        error_db: Largest rms error relative to the image of white noise, in dB.

    Raises:
        ValueError: If side data are missing or have trials, or the grid is not valid.
    """

    def __init__(
        self,
        side_data: Mapping[str, Tensor] | None = None,
        azimuth_m: float | None = None,
        range_m: float | None = None,
        step_m: float | None = None,
        window: str = "hann",
        error_db: float = -60.0,
    ) -> None:
        needed = ("frequency_hz", "transmitter_m", "path_reference_m")
        missing = [name for name in needed if side_data is None or name not in side_data]
        if side_data is None or missing:
            raise ValueError(
                f"the grid of a spotlight image follows from the side data of a recording, which lack {missing}; for "
                "other data use TileImage (tile_image) with a grid of your own"
            )
        known = {name: side_data[name] for name in (*needed, "receiver_m") if name in side_data}
        if known["path_reference_m"].ndim != 1:
            raise ValueError(
                "the side data of a spotlight image must have no trials, got path_reference_m of shape "
                f"{tuple(known['path_reference_m'].shape)}; select one trial"
            )
        antennas = AntennaPath(known["transmitter_m"], known.get("receiver_m"), known["path_reference_m"])
        grid = scene_grid(known["frequency_hz"], antennas, side_data.get("scene_corners_m"))
        step = grid.step_m if step_m is None else step_m
        wanted = ((azimuth_m, grid.azimuth_m), (range_m, grid.range_m))
        extents = [of if given is None else given for given, of in wanted]
        pixels = extents[0] * extents[1] / step**2
        if azimuth_m is None and range_m is None and pixels > _MOST_PIXELS:
            shown = [extent * math.sqrt(_MOST_PIXELS / pixels) for extent in extents]
            warnings.warn(
                f"the scene of {extents[0]:.0f} x {extents[1]:.0f} m has {pixels:.3g} pixels of {step:.3g} m; the "
                f"image shows its middle, {shown[0]:.0f} x {shown[1]:.0f} m; give azimuth_m and range_m to see more",
                stacklevel=2,
            )
            extents = shown
        super().__init__(
            extents[0], extents[1], step, grid.centre_m, grid.range_axis_rad, grid.height_m, window, error_db
        )
        self.side_data = known

    def forward(
        self,
        signal: Signal,
        frequency_hz: Tensor | None = None,
        transmitter_m: Tensor | None = None,
        path_reference_m: Tensor | None = None,
        receiver_m: Tensor | None = None,
    ) -> Signal:
        """Form the image of range profiles with the axes (pulse, range).

        Args:
            signal: Range profiles, the centred unitary inverse FFT of a phase history.
            frequency_hz: Frequencies in Hz, float64 (range,); None for those of the recording.
            transmitter_m: Positions of the transmitter in metres, float64 (..., pulse, 3); None for
                those of the recording.
            path_reference_m: Path to which phases refer in metres, float64 (..., pulse); None for
                that of the recording.
            receiver_m: Positions of the receiver in metres; None for those of the recording.

        Returns:
            Image with the axes (azimuth, range) in metres.
        """
        given = {
            "frequency_hz": frequency_hz,
            "transmitter_m": transmitter_m,
            "path_reference_m": path_reference_m,
            "receiver_m": receiver_m,
        }
        known = {name: value.to(signal.data.device) for name, value in self.side_data.items()}
        return super().forward(signal, **{**known, **{name: v for name, v in given.items() if v is not None}})
