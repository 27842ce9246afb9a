"""Stage that images a recording along any path on a grid that follows from its geometry."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchsar.core import Signal
from torchsar.focus.path_image import TileImage, spatial_band
from torchsar.focus.requirements import Limit
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


def scene_grid(
    frequency_hz: Tensor,
    antennas: AntennaPath,
    corners_m: Tensor | None = None,
    centre_m: Sequence[float] | None = None,
) -> SceneGrid:
    """Choose the grid of an image from the geometry of its recording.

    The image covers the corners, if they are known, but no more than the band and the pulses image
    without ambiguity; steps between pulses count by their median, so that lost pulses do not crop
    the image. Without corners the centre is
    - the origin, if the reference paths follow the path over it;
    - the middle of a closed path, such as a circle, whose references do not;
    - else the middle of the range window, abeam of the path: on the side of the origin, if the
      path passes it at a distance, else towards +x, or, of a path along x, towards +y. The window
      begins at the radar if the reference is nearer than half of it.
    Without corners the image has the width of the window, and is as long in azimuth, or as long as
    the path. The range axis is the mean horizontal direction in which the path grows, or x where
    there is none. The spacing is 1 / 1.25 of the finer resolution cell, the inverse of the extent
    of the spatial frequencies f (gradient of the path) / c at the centre; near the radar, where
    cells differ, it is that of the finest cell of nine points, as far as 300,000 pixels hold it.

    Args:
        frequency_hz: Frequencies in Hz, rising in equal steps, float64 (frequency,).
        antennas: Path of the antennas without trials.
        corners_m: Corners of the scene in metres, float64 (corner, 3); None if they are not known.
        centre_m: Centre of the image in metres along x and y, in place of that of the data.

    Returns:
        The grid.

    Raises:
        ValueError: If the frequencies do not rise in equal steps, or the direction to the scene
            does not change over the pulses.
    """
    window_m = LIGHT_M_S / (2 * frequency_step_hz(frequency_hz))
    near = corners_m is None and not _points_at_origin(antennas, window_m)
    centre = antennas.transmitter_m.new_zeros(3) if corners_m is None else corners_m.mean(0)
    extent = (window_m, window_m)
    if near:
        centre, extent = _abeam(antennas, window_m, warn=centre_m is None)
    if centre_m is not None:
        centre = torch.cat([centre.new_tensor(list(centre_m)), centre[2:]])
    away = [centre - place for place in antennas.places]
    slope = sum(2 / len(away) * v / torch.linalg.vector_norm(v, dim=-1, keepdim=True) for v in away)
    assert isinstance(slope, Tensor)
    mean = slope.mean(-2)
    # if the mean direction is below a fifth, the directions are all around, by choice
    angle = math.atan2(float(mean[1]), float(mean[0])) if float(mean[:2].norm()) > 0.2 else 0.0
    axes = slope.new_tensor([[math.cos(angle), math.sin(angle), 0.0], [-math.sin(angle), math.cos(angle), 0.0]])
    along = slope @ axes.mT  # slope per pulse, along range and azimuth
    ends = torch.stack([along * f / LIGHT_M_S for f in (frequency_hz[0], frequency_hz[-1])])
    band = (ends.amax((0, 1)) - ends.amin((0, 1))).tolist()
    if not (band[0] > 0 and float(along[:, 1].amax() - along[:, 1].amin()) > 0):
        raise ValueError(
            "the direction to the scene does not change over the pulses, so that there is no resolution in azimuth; "
            "an image needs antennas that move across the line of sight"
        )
    steps = slope.diff(dim=0).norm(dim=-1)
    usual = float(steps[steps > 0].median())
    if float(steps.max()) > 10 * usual:  # limit by choice, which an uneven speed does not exceed
        warnings.warn(
            f"the largest step between pulses, at pulse {int(steps.argmax())}, is {float(steps.max()) / usual:.3g} "
            "times the median one: pulses are missing there, which raises side lobes in azimuth",
            stacklevel=3,
        )
    clear = (2 * window_m / float(along[:, 0].abs().max()), LIGHT_M_S / (float(frequency_hz[-1]) * usual))
    # the unambiguous extent in azimuth is proportional to the range and is computed for the far
    # edge
    if near and float(centre.norm()) > 0:
        farther = 1 + extent[0] / 2 / float((centre - torch.stack(antennas.places).mean((0, 1))).norm())
        clear = (clear[0], clear[1] * farther)
    step = 1 / (_OVERSAMPLING * max(band))
    reach = extent if near else (clear[0], clear[0])
    if corners_m is not None:
        across = (corners_m - corners_m.mean(0)) @ axes.mT
        reach = (across.amax(0) - across.amin(0)).tolist()
        reach = tuple(size if size > 0 else clear[0] for size in reach)
    range_m, azimuth_m = (max(min(*pair), step) for pair in zip(reach, clear, strict=True))
    middle = axes @ centre
    if near:
        edges = [0.5 * (i * range_m * axes[0] + j * azimuth_m * axes[1]) for i in (-1, 0, 1) for j in (-1, 0, 1)]
        pulses = torch.tensor([[0, antennas.pulses]]).expand(9, 2)
        low, high = spatial_band(centre + torch.stack(edges), axes, antennas, frequency_hz, pulses)
        finest = 1 / (_OVERSAMPLING * float((high - low).max()))
        step = min(step, max(finest, math.sqrt(range_m * azimuth_m / 3e5)))
    return SceneGrid(azimuth_m, range_m, step, (float(middle[0]), float(middle[1])), angle, float(centre[2]))


def _points_at_origin(antennas: AntennaPath, window_m: float) -> bool:
    """True if the reference paths follow the path over the origin.

    They then differ by less than a quarter of it, by choice, and the range window is far from the
    radar or the path is closed.
    """
    over = antennas.path_m(antennas.transmitter_m.new_zeros(1, 3))[:, 0]
    whole = over + antennas.reference_m
    near_m = float(antennas.reference_m.median()) / 2 - window_m / 2
    return bool((over.abs() / whole.clamp_min(1e-9)).median() < 0.25) and (near_m > 0 or _closed(antennas))


def _closed(antennas: AntennaPath) -> bool:
    """True if a path returns: its end is nearer to its start than half of its length over pi, by
    choice.
    """
    place = torch.stack(antennas.places).mean(0)[:, :2]
    return float((place[-1] - place[0]).norm()) < float(place.diff(dim=0).norm(dim=-1).sum()) / (2 * math.pi)


def _abeam(antennas: AntennaPath, window_m: float, warn: bool) -> tuple[Tensor, tuple[float, float]]:
    """Middle of the scene of a radar that does not point at the origin, and extents of the scene in
    range and azimuth in metres.

    If `warn`, a warning names the side that was chosen.
    """
    place = torch.stack(antennas.places).mean(0)
    middle = (place.amax(0) + place.amin(0)) / 2
    middle = torch.cat([middle[:2], middle.new_zeros(1)])
    if _closed(antennas):
        return middle, (window_m, window_m)
    along = place[-1, :2] - place[0, :2]
    along = along / along.norm().clamp_min(1e-12)
    side = torch.stack([along[1], -along[0], along.new_zeros(())])
    side = -side if float(side[0] if abs(float(side[0])) > 0.5 else side[1]) < 0 else side
    toward = -place.mean(0) * (1 - along.new_tensor([0.0, 0.0, 1.0]))
    # if the path passes the origin at a distance, the scene is on the side of the origin
    if float((toward @ side).abs()) > 0.1 * window_m:
        side = side * torch.sign(toward @ side)
    reference_m, height_m = float(antennas.reference_m.median()) / 2, float(place[:, 2].mean())
    first = max(reference_m - window_m / 2, 0.0)
    low, high = (math.sqrt(max(r**2 - height_m**2, 0.0)) for r in (first, first + window_m))
    if warn:
        warnings.warn(
            f"the phase history does not point at the origin: the image shows ground ranges from {low:.3g} to "
            f"{high:.3g} m from the path, in the direction ({float(side[0]):.2f}, {float(side[1]):.2f}) of (x, y), "
            "which a straight path does not tell from the opposite one; centre_m, azimuth_m and range_m choose another "
            "area",
            stacklevel=4,
        )
    length = float((place[-1] - place[0]).norm())
    return middle + (low + high) / 2 * side, (high - low, max(high - low, length))


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
    4 million pixels, a UserWarning says how much of the scene is shown. Another warns of grating
    lobes, if a given azimuth extent is too large for the distance of the pulses, see
    `PathImage.pulse_limits`.

    Args:
        side_data: `frequency_hz`, those of `AntennaPath.side_data`, and optionally
            `scene_corners_m`, as in the recordings of `read_path` and `read_cphd`.
        azimuth_m: Extent of the image along its azimuth axis in metres.
        range_m: Extent along its range axis in metres.
        step_m: Sample spacing in metres.
        centre_m: Centre of the image in metres along x and y; None for that of `scene_grid`.
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
        centre_m: Sequence[float] | None = None,
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
                f"{tuple(known['path_reference_m'].shape)}; select one trial: recording[0]"
            )
        antennas = AntennaPath(known["transmitter_m"], known.get("receiver_m"), known["path_reference_m"])
        grid = scene_grid(known["frequency_hz"], antennas, side_data.get("scene_corners_m"), centre_m)
        step = grid.step_m if step_m is None else step_m
        wanted = ((azimuth_m, grid.azimuth_m), (range_m, grid.range_m))
        extents = [of if given is None else given for given, of in wanted]
        pixels = extents[0] * extents[1] / step**2
        if azimuth_m is None and range_m is None and pixels > _MOST_PIXELS:
            shown = [extent * math.sqrt(_MOST_PIXELS / pixels) for extent in extents]
            warnings.warn(
                f"the scene of {extents[0]:.0f} x {extents[1]:.0f} m has {pixels:.3g} pixels of {step:.3g} m; the "
                f"image shows its middle, {shown[0]:.0f} x {shown[1]:.0f} m; give azimuth_m and range_m to see more",
                stacklevel=3,
            )
            extents = shown
        super().__init__(
            extents[0], extents[1], step, grid.centre_m, grid.range_axis_rad, grid.height_m, window, error_db
        )
        self.side_data, self._own_step, self._own_extent = known, step_m is None, azimuth_m is None
        for limit in self.pulse_limits(antennas, known["frequency_hz"]):
            if not limit.ok:
                warnings.warn(limit.sentence, stacklevel=3)

    def sampling_limits(self, antennas: AntennaPath, frequency_hz: Tensor) -> list[Limit]:
        """Return the limits of a given spacing, see `PathImage`. There are none for the spacing of
        `scene_grid`.
        """
        return [] if self._own_step else super().sampling_limits(antennas, frequency_hz)

    def pulse_limits(self, antennas: AntennaPath, *args: Any, **given: Any) -> list[Limit]:
        """Return the limit of a given extent, see `PathImage`. There is none for the extent of
        `scene_grid`, which is unambiguous.
        """
        return [] if self._own_extent else super().pulse_limits(antennas, *args, **given)

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
