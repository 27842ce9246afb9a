"""Stages that image the ground from range profiles along any path."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from numbers import Real

import torch
from torch import Tensor

from torchsar.core import Axis, Signal, Stage, real_dtype, untraced
from torchsar.focus.backprojection import backproject
from torchsar.focus.image_grid import ImageGrid, level_plane
from torchsar.focus.motion_compensation import compensated_image
from torchsar.focus.processed_beam import ProcessedBeam
from torchsar.focus.requirements import Limit
from torchsar.focus.spotlight import window_weights
from torchsar.focus.tiles import image_tiles
from torchsar.focus.tiles.scene import Lit, Weight
from torchsar.radar import StraightTrack
from torchsar.radar.antenna_path import AntennaPath
from torchsar.radar.spotlight import frequency_samples
from torchsar.radar.stripmap import LIGHT_M_S

# windows over pulses and over frequencies, by the names of window pairs that differ
_WINDOWS = {"range": ("none", "hann")}
# numbers of pulses of an aperture at which spatial frequencies are computed, and of points of the
# image along either axis, both by choice
_PULSES, _POINTS = 33, 3
# share of a band that contains 99.9 % of the energy if there are Hann windows in both directions
_HELD = 0.8


class PathImage(Stage):
    """Base class of the stages that image the ground from range profiles along any path.

    >>> from torchsar import focus
    >>> focus.PathImage(azimuth_m=20.0, range_m=10.0, step_m=0.5).grid.counts  # lines, samples
    (41, 21)

    The image has the axes ("azimuth", "range"), in metres on a horizontal plane. A chain connects
    the side data of the recording; without `receiver_m` both antennas are at `transmitter_m`:

        use(TileImage(100.0, 100.0, 0.25), frequency_hz="aux.frequency_hz",
            transmitter_m="aux.transmitter_m", receiver_m="aux.receiver_m",
            path_reference_m="aux.path_reference_m")

    The image is the sum over pulses and frequencies of the samples times the window, with the phase
    of a point as in `backproject`. Positions (trial, pulse, 3) are paths of single trials.

    Args:
        azimuth_m: Extent of the image along its azimuth axis in metres.
        range_m: Extent along its range axis in metres.
        step_m: Sample spacing in metres.
        centre_m: Position of the centre in metres along (range axis, azimuth axis).
        range_axis_rad: Direction of the range axis in rad, from ground coordinate x towards y; the
            azimuth axis is a quarter turn further.
        height_m: Height z of the imaged plane in metres.
        window: "none"; "hann" over pulses and over frequencies; or "range", Hann over frequencies
            only, for strips, in which each point is seen by a part of the pulses.

    Raises:
        ValueError: If a number is not finite, the spacing is not positive or larger than an extent,
            or the window is not known.
    """

    beam: ProcessedBeam | None = None
    """Beam whose pulses are summed, for strips; None for all pulses."""

    def __init__(
        self,
        azimuth_m: float,
        range_m: float,
        step_m: float,
        centre_m: tuple[float, float] = (0.0, 0.0),
        range_axis_rad: float = 0.0,
        height_m: float = 0.0,
        window: str = "hann",
    ) -> None:
        super().__init__()
        centre = tuple(centre_m) if isinstance(centre_m, Sequence) else (centre_m,)
        numbers = (azimuth_m, range_m, step_m, *centre, range_axis_rad, height_m)
        if (
            not all(isinstance(x, Real) and math.isfinite(x) for x in numbers)
            or len(centre) != 2
            or not 0 < step_m <= min(azimuth_m, range_m)
        ):
            raise ValueError(
                "an image needs finite numbers with 0 < step_m <= azimuth_m, range_m and a centre of two coordinates, "
                f"got azimuth_m={azimuth_m}, range_m={range_m}, step_m={step_m}, centre_m={centre_m}, "
                f"range_axis_rad={range_axis_rad}, height_m={height_m}"
            )
        self.windows = _WINDOWS.get(window, (window, window))
        for name in self.windows:
            window_weights(name, 1)
        counts = tuple(round(extent / step_m) + 1 for extent in (azimuth_m, range_m))
        starts = [centre - n // 2 * step_m for centre, n in zip(reversed(tuple(centre_m)), counts, strict=True)]
        azimuth, range_ = (
            Axis(name, n, start, float(step_m), "m")
            for name, n, start in zip(("azimuth", "range"), counts, starts, strict=True)
        )
        self.axes = azimuth, range_
        axes, origin = level_plane(range_axis_rad, starts[0], starts[1], height_m)
        self.grid = ImageGrid(origin, axes, (azimuth.n, range_.n), float(step_m))

    def form(self, history: Tensor, frequency_hz: Tensor, antennas: AntennaPath, grid: ImageGrid) -> Tensor:
        """Form the image of a phase history; subclasses implement this method.

        Args:
            history: Phase history, shape (..., pulse, frequency), complex.
            frequency_hz: Frequencies in Hz, shape (frequency,).
            antennas: Path of the antennas.
            grid: Pixels.

        Returns:
            Image, shape (..., azimuth, range).
        """
        raise NotImplementedError

    def lit(self, antennas: AntennaPath) -> Lit | None:
        """Return the function of the pulses that see a point within the processed beam.

        Args:
            antennas: Path of the antennas. The beam is that of the receiver, seen from the mean
                path of all trials.

        Returns:
            Function, see `TilePlan`, or None for all pulses.

        Raises:
            ValueError: If the receiver does not advance, see `StraightTrack.fitted`.
        """
        return None if self.beam is None else partial(self.beam.lit_pulses, _mean_place(antennas))

    def weight(self, antennas: AntennaPath) -> Weight | None:
        """Return the function of the weights of pulses by the processed beam, with its edges.

        Args:
            antennas: Path of the antennas, see `lit`.

        Returns:
            Function, see `TilePlan`, or None for equal weights.

        Raises:
            ValueError: If the receiver does not advance, see `StraightTrack.fitted`.
        """
        return None if self.beam is None else partial(self.beam.pulse_weights, _mean_place(antennas))

    def sampling_limits(self, antennas: AntennaPath, frequency_hz: Tensor) -> list[Limit]:
        """Return the limits of the sample spacing up to which the samples represent the spectrum.

        The spectrum is that of all of nine points of the image, of which Hann windows in both
        directions leave 80 % (99.9 % of the energy). The limit is the inverse of its width. An
        image with coarser samples shows the same brightness, but it cannot be resampled, or
        compared with a displaced one.

        Args:
            antennas: Path of the antennas.
            frequency_hz: Frequencies in Hz, float64 (frequency,).

        Returns:
            Limits along azimuth and range; or one that refuses the image, if no pulse sees it.
        """
        grid, points = self.grid, self._nine_points().to(antennas.reference_m.device)
        lit = self.lit(antennas)
        ends = torch.tensor([[0, antennas.pulses]]).expand(len(points), 2) if lit is None else lit(points)
        seen = ends[:, 1] > ends[:, 0]
        if not bool(seen.any()):
            near_m = float((antennas.places[-1][..., None, :] - points).norm(dim=-1).min())
            return [
                Limit(
                    "the number of pulses that see the image",
                    0,
                    1,
                    "",
                    "refuse",
                    f"the image is empty; the path passes it at {near_m:.4g} m",
                    "check the origin of a motion log, width and squint of the beam, and the centre of the image",
                    at_least=True,
                )
            ]
        low, high = spatial_band(points[seen], grid.axes, antennas, frequency_hz, ends[seen])
        held = _HELD if self.windows == ("hann", "hann") else 1.0
        steps = (1 / (held * (high.amax(0) - low.amin(0)))).tolist()
        return [
            Limit(
                f"the sample spacing step_m of the image in {axis.name}",
                grid.step_m,
                step,
                "m",
                "warn",
                "samples do not hold the spectrum of the image, so that it cannot be resampled, and its error relative "
                "to a displaced reference is too large",
                "choose a finer step_m",
            )
            for axis, step in zip(self.axes, steps, strict=True)
        ]

    def pulse_limits(
        self,
        antennas: AntennaPath,
        frequency_hz: Tensor,
        power: Callable[[Tensor], Tensor] | None = None,
        beam: ProcessedBeam | None = None,
    ) -> list[Limit]:
        """Return the limit of the distance of pulses up to which the image is unambiguous.

        With a beam, pulses must sample its Doppler band. Beyond the limit, a point appears again
        where its Doppler frequency differs by the PRF. The level of such a ghost is the share of
        the echo from those pulses whose beam contains both. The range window lowers it, because the
        range of a ghost changes by a wavelength per pulse.

        Without a beam, the paths over both ends of the image must change by less than a wavelength
        relative to each other from pulse to pulse: grating lobes of a point lie where they change
        by a whole one. The ends are those of the side across the line of sight, on the line where
        the change is largest. The limit holds for the median of the pulses, so that lost pulses do
        not matter, and for the trial with the largest one. The distance of the lobes follows from
        the largest change of the spatial frequency in the image; where it is smaller, they lie
        farther away.

        Args:
            antennas: Path of the antennas; the receiver has the beam.
            frequency_hz: Frequencies in Hz, float64 (frequency,).
            power: Function of the sine of the angle ahead of broadside that returns the two-way
                power gain of the antenna; None for the squared weights of the beam.
            beam: Beam of the antenna, which counts where the image has no processed beam.

        Returns:
            The limit.
        """
        beam = self.beam or beam
        if beam is None:
            return [self._grating_limit(antennas, frequency_hz)]
        track, ways = StraightTrack.fitted(_mean_place(antennas)), 2 if antennas.receiver_m is None else 1
        wavelength = LIGHT_M_S / float(frequency_hz.max())
        longest = wavelength / (ways * beam.band)
        # difference between the sines of the lines of sight to a point and to its ghost
        apart = wavelength / (ways * track.step_m)
        low, high = beam.ends
        sine = torch.linspace(low - apart, high + apart, 4096, dtype=torch.float64)
        weight = beam.weight(sine)
        lit = weight if power is None else power(sine).sqrt()
        middle = self.grid.pixels_m(*(slice(n // 2, n // 2 + 1) for n in self.grid.counts)).reshape(-1, 3)
        closest = float(torch.linalg.vector_norm(track.across_m(middle.to(track.along)), dim=-1))
        cells = closest / track.step_m * float(frequency_hz.max() - frequency_hz.min()) / float(frequency_hz.mean())
        shares = []
        for side in (-1, 1):
            both = lit * beam.weight(sine + side * apart)
            off = cells * (sine - (both * sine).sum() / both.sum().clamp_min(1e-300))
            held = torch.sinc(off) if self.windows[1] == "none" else _hann_response(off)
            shares.append((both * held).sum().abs())
        level = float(torch.stack(shares).max() / (lit * weight).sum())
        place = closest * apart / (1 - beam.middle**2) ** 1.5
        return [
            Limit(
                "the distance of pulses along the track",
                track.step_m,
                longest,
                "m",
                "warn",
                f"ghosts of bright points lie {place:.3g} m beside them along the track, at up to "
                f"{20 * math.log10(max(level, 1e-10)):.1f} dB",
                f"raise the PRF by a factor of {track.step_m / longest:.3g} or more; a narrower processed beam helps "
                "only as far as the antenna illuminates no more",
            )
        ]

    def _grating_limit(self, antennas: AntennaPath, frequency_hz: Tensor) -> Limit:
        """Return the limit of the pulses without a beam, see `pulse_limits`."""
        places = [place.detach() for place in antennas.places]
        points, wavelength = self._nine_points().to(places[0].device), LIGHT_M_S / float(frequency_hz.max())
        path_m = AntennaPath(places[0], places[-1], places[0].new_zeros(antennas.pulses)).path_m(points)
        steps = path_m.diff(dim=-2).unflatten(-1, (_POINTS, _POINTS))
        sides = torch.stack([(steps.amax(side) - steps.amin(side)).amax(-1) for side in (-2, -1)], -1)
        away = [torch.nn.functional.normalize(points - x[..., None, :], dim=-1) for x in (places[0], places[-1])]
        # of the path along both axes, (..., pulse, point, axis)
        slopes = (away[0] + away[1]) @ self.grid.axes.to(points).mT
        # the pulses resolve the side that lies across the line of sight
        across = slopes.mean(-2)[..., 1:, :].abs().argmin(-1, keepdim=True)
        both = [x.gather(-1, across)[..., 0] / wavelength for x in (sides, slopes.diff(dim=-3).abs().amax(-2))]
        # one more NaN, since a single pulse has no step
        moving = [torch.nn.functional.pad(x.masked_fill(both[0] <= 0, math.nan), (0, 1), value=math.nan) for x in both]
        apart, rate = (float(x.nanmedian(-1).values.nan_to_num(0.0).max()) for x in moving)
        lobe_m = 1 / max(rate, 1e-12)
        return Limit(
            "the change of path from pulse to pulse across the image",
            apart,
            1.0,
            "wavelengths",
            "warn",
            f"the pulses do not tell apart places that lie about {lobe_m:.3g} m or more from each other across the "
            "line of sight, where bright points have grating lobes",
            f"choose an extent across the line of sight of about {lobe_m:.3g} m if the beam illuminates no more, or "
            f"raise the PRF by a factor of {apart:.3g}",
        )

    def _nine_points(self) -> Tensor:
        """Corners of the image, middles of its sides, and its middle, in metres, float64 (9, 3)."""
        grid = self.grid
        i, j = (torch.linspace(0, n - 1, _POINTS, dtype=torch.float64)[:, None] * grid.step_m for n in grid.counts)
        return (grid.origin_m + (i * grid.axes[0])[:, None] + j * grid.axes[1]).reshape(-1, 3)

    def extra_repr(self) -> str:
        """Return the number of pixels and their spacing as words."""
        return f"{self.grid.counts[0]} x {self.grid.counts[1]} pixels of {self.grid.step_m:.4g} m"

    def seen(self, antennas: AntennaPath) -> Tensor:
        """Return the pulses that see a part of the image.

        Args:
            antennas: Path of the antennas.

        Returns:
            True from the first to the last of them, bool (pulse,); for all pulses without a beam.
        """
        number = torch.arange(antennas.pulses, device=antennas.reference_m.device)
        lit = self.lit(antennas)
        if lit is None:
            return number >= 0
        rows, columns = (slice(None, None, max(1, n - 1)) for n in self.grid.counts)
        ends = lit(self.grid.pixels_m(rows, columns).reshape(-1, 3).to(number.device))
        return (number >= ends[:, 0].amin()) & (number < ends[:, 1].amax())

    def forward(
        self,
        signal: Signal,
        frequency_hz: Tensor,
        transmitter_m: Tensor,
        path_reference_m: Tensor,
        receiver_m: Tensor | None = None,
    ) -> Signal:
        """Form the image of range profiles with the axes (pulse, range).

        Args:
            signal: Range profiles, the centred unitary inverse FFT of a phase history.
            frequency_hz: Frequencies in Hz, float64 (range,).
            transmitter_m: Positions of the transmitter in metres, float64 (..., pulse, 3).
            path_reference_m: Path to which phases refer in metres, float64 (..., pulse).
            receiver_m: Positions of the receiver in metres; None if both share an antenna.

        Returns:
            Image with the axes (azimuth, range) in metres.
        """
        data = signal.data
        weights = (window_weights(name, n, data.device) for name, n in zip(self.windows, data.shape[-2:], strict=True))
        rows, columns = (weight.to(real_dtype(data.dtype)) for weight in weights)
        history = frequency_samples(data) * columns * rows[:, None]
        with untraced():
            places = self.grid.origin_m.to(data.device), self.grid.axes.to(data.device)
            grid = ImageGrid(*places, self.grid.counts, self.grid.step_m)
        antennas = AntennaPath(transmitter_m, receiver_m, path_reference_m)
        return Signal(self.form(history, frequency_hz, antennas, grid), self.axes)


def spatial_band(
    points_m: Tensor, directions: Tensor, antennas: AntennaPath, frequency_hz: Tensor, ends: Tensor
) -> tuple[Tensor, Tensor]:
    """Compute the limits of the spectrum of an image at some points.

    Args:
        points_m: Points in metres, float64 (point, 3).
        directions: Axes of the image, unit vectors, float64 (axis, 3).
        antennas: Path of the antennas; of several trials the mean.
        frequency_hz: Frequencies in Hz, rising, float64 (frequency,).
        ends: First pulse that sees each point and the pulse after the last, int64 (point, 2).

    Returns:
        Lowest and highest spatial frequency in cycles per metre, float64 (point, axis): the change
        of the path along the axes, in wavelengths.
    """
    places = [place.reshape(-1, antennas.pulses, 3).mean(0) for place in antennas.places]
    low, high = (points_m.new_full((len(points_m), len(directions)), sign * math.inf) for sign in (1, -1))
    ends, directions = ends.to(points_m.device), directions.to(points_m)
    for share in torch.linspace(0, 1, _PULSES, dtype=torch.float64).tolist():
        pulse = (ends[:, 0] + share * (ends[:, 1] - 1 - ends[:, 0])).round().long().clamp(0, antennas.pulses - 1)
        away = [points_m - place[pulse] for place in places]
        unit = [v / torch.linalg.vector_norm(v, dim=-1, keepdim=True) for v in away]
        slope = torch.stack(unit).mean(0) * 2 @ directions.mT
        for frequency in (frequency_hz[0], frequency_hz[-1]):
            k = slope * (frequency / LIGHT_M_S)
            low, high = torch.minimum(low, k), torch.maximum(high, k)
    return low, high


def _hann_response(cells: Tensor) -> Tensor:
    """Response of a band with a Hann window at distances in resolution cells, relative to
    its peak.
    """
    return torch.sinc(cells) + (torch.sinc(cells - 1) + torch.sinc(cells + 1)) / 2


def _mean_place(antennas: AntennaPath) -> Tensor:
    """Positions of the receiver, averaged over all trials, float64 (pulse, 3)."""
    return antennas.places[-1].detach().reshape(-1, antennas.pulses, 3).mean(0)


def seen_in(stages: Iterable[object], antennas: AntennaPath) -> Tensor:
    """Return the pulses that see a part of the last image of a chain, see `PathImage.seen`.

    Args:
        stages: Stages of the chain.
        antennas: Path of the antennas.

    Returns:
        bool (pulse,); True for all pulses if no stage forms an image.
    """
    image = last_image(stages)
    if image is None:
        return torch.ones(antennas.pulses, dtype=torch.bool, device=antennas.reference_m.device)
    return image.seen(antennas)


def last_image(stages: Iterable[object]) -> PathImage | None:
    """Find the last stage that images a path.

    Args:
        stages: Stages of a chain.

    Returns:
        The stage, or None if there is none.
    """
    return next((one for one in reversed(list(stages)) if isinstance(one, PathImage)), None)


class TileImage(PathImage):
    """Stage that images any path by tiles, see `TilePlan`; arguments as in `PathImage`.

    >>> from torchsar import Draws, echo, focus, radar, scene
    >>> sensor = radar.InverseRadar(carrier_hz=9.6e9, bandwidth_hz=160e6, prf_hz=40.0)
    >>> world = scene.PathWorld(scene.Points([0.0], [0.0]),
    ...     scene.Flight(scene.StraightPath((-300.0, -10.0, 100.0), (0.0, 20.0, 0.0))))
    >>> recording, _ = echo.simulate_path(sensor, world, 40, 16, Draws(1))
    >>> image = focus.TileImage(8.0, 8.0, 0.5)(recording.signal,
    ...     *(recording.aux[x] for x in ("frequency_hz", "transmitter_m", "path_reference_m")))
    >>> divmod(int(image.data.abs().argmax()), 17)  # line and sample of the peak
    (8, 8)

    Args:
        azimuth_m: Extent of the image along its azimuth axis in metres.
        range_m: Extent along its range axis in metres.
        step_m: Sample spacing in metres.
        centre_m: Position of the centre in metres along (range axis, azimuth axis).
        range_axis_rad: Direction of the range axis in rad, from ground coordinate x towards y.
        height_m: Height z of the imaged plane in metres.
        window: "none", "hann" or "range", see `PathImage`.
        error_db: Largest rms error relative to the image of white noise, in dB.
        beam_deg: Width of the processed beam in degrees, for strips: each pixel is summed over the
            pulses that see it within the beam, with the weights of its smooth edges. None for all
            pulses.
        squint_deg: Angle of the middle of the beam ahead of broadside in degrees.

    Raises:
        ValueError: If the beam is not valid, see `ProcessedBeam`.
    """

    fixed = ("frequency_hz", "transmitter_m", "path_reference_m", "receiver_m")

    def __init__(
        self,
        azimuth_m: float,
        range_m: float,
        step_m: float,
        centre_m: tuple[float, float] = (0.0, 0.0),
        range_axis_rad: float = 0.0,
        height_m: float = 0.0,
        window: str = "hann",
        error_db: float = -60.0,
        beam_deg: float | None = None,
        squint_deg: float = 0.0,
    ) -> None:
        super().__init__(azimuth_m, range_m, step_m, centre_m, range_axis_rad, height_m, window)
        self.error_db = error_db
        self.beam = None if beam_deg is None else ProcessedBeam(beam_deg, squint_deg)

    def form(self, history: Tensor, frequency_hz: Tensor, antennas: AntennaPath, grid: ImageGrid) -> Tensor:
        """Form the image by tiles.

        Args:
            history: Phase history, shape (..., pulse, frequency), complex.
            frequency_hz: Frequencies in Hz, shape (frequency,).
            antennas: Path of the antennas.
            grid: Pixels.

        Returns:
            Image, shape (..., azimuth, range).
        """
        places = antennas.transmitter_m, antennas.receiver_m, antennas.reference_m
        beam = self.lit(antennas), self.weight(antennas)
        return image_tiles(history, frequency_hz, *places, grid, self.error_db, *beam)


class DirectImage(PathImage):
    """Stage that images any path by the direct sum, see `backproject`: slow and exact.

    >>> from torchsar import Draws, echo, focus, radar, scene
    >>> sensor = radar.InverseRadar(carrier_hz=9.6e9, bandwidth_hz=160e6, prf_hz=40.0)
    >>> world = scene.PathWorld(scene.Points([0.0], [0.0]),
    ...     scene.Flight(scene.StraightPath((-300.0, -10.0, 100.0), (0.0, 20.0, 0.0))))
    >>> recording, _ = echo.simulate_path(sensor, world, 40, 16, Draws(1))
    >>> image = focus.DirectImage(8.0, 8.0, 0.5)(recording.signal,
    ...     *(recording.aux[x] for x in ("frequency_hz", "transmitter_m", "path_reference_m")))
    >>> divmod(int(image.data.abs().argmax()), 17)  # line and sample of the peak
    (8, 8)

    Arguments as in `PathImage`.
    """

    def form(self, history: Tensor, frequency_hz: Tensor, antennas: AntennaPath, grid: ImageGrid) -> Tensor:
        """Form the image by the direct sum.

        Args:
            history: Phase history, shape (..., pulse, frequency), complex.
            frequency_hz: Frequencies in Hz, shape (frequency,).
            antennas: Path of the antennas.
            grid: Pixels.

        Returns:
            Image, shape (..., azimuth, range).
        """
        places = antennas.transmitter_m, antennas.receiver_m, antennas.reference_m
        eps = 1e-10 if history.dtype == torch.complex128 else 1e-6
        return backproject(history, frequency_hz, *places, grid.pixels_m(), eps=eps)


class OmegaKImage(PathImage):
    """Stage that images nearly straight paths by motion compensation and omega-K.

    >>> from torchsar import Draws, echo, focus, radar, scene
    >>> sensor = radar.InverseRadar(carrier_hz=9.6e9, bandwidth_hz=160e6, prf_hz=100.0)
    >>> world = scene.PathWorld(scene.Points([0.0], [0.0]),
    ...     scene.Flight(scene.StraightPath((-300.0, -16.0, 100.0), (0.0, 20.0, 0.0))))
    >>> recording, _ = echo.simulate_path(sensor, world, 160, 16, Draws(1))
    >>> image = focus.OmegaKImage(8.0, 8.0, 0.5, beam_deg=3.0)(recording.signal,
    ...     *(recording.aux[x] for x in ("frequency_hz", "transmitter_m", "path_reference_m")))
    >>> divmod(int(image.data.abs().argmax()), 17)  # line and sample of the peak
    (8, 8)

    See `compensated_omega_k`. Only pulses that see a pixel within the processed beam contribute to
    it.

    Args:
        azimuth_m: Extent of the image along its azimuth axis in metres.
        range_m: Extent along its range axis in metres.
        step_m: Sample spacing in metres.
        beam_deg: Width of the processed beam in degrees.
        squint_deg: Angle of the middle of the beam ahead of broadside in degrees.
        order: 1 to compensate for the middle of the swath only, 2 for all ranges.
        centre_m: Position of the centre in metres along (range axis, azimuth axis).
        range_axis_rad: Direction of the range axis in rad, from ground coordinate x towards y.
        height_m: Height z of the imaged plane in metres.
        window: "none", "hann" or "range", see `PathImage`.

    Raises:
        ValueError: If the beam is not valid, see `ProcessedBeam`, or the order is not 1 or 2.
    """

    def __init__(
        self,
        azimuth_m: float,
        range_m: float,
        step_m: float,
        beam_deg: float,
        squint_deg: float = 0.0,
        order: int = 2,
        centre_m: tuple[float, float] = (0.0, 0.0),
        range_axis_rad: float = 0.0,
        height_m: float = 0.0,
        window: str = "range",
    ) -> None:
        super().__init__(azimuth_m, range_m, step_m, centre_m, range_axis_rad, height_m, window)
        if order not in (1, 2):
            raise ValueError(f"the order of motion compensation is 1 or 2, got {order}")
        self.beam, self.order = ProcessedBeam(beam_deg, squint_deg), order

    def form(self, history: Tensor, frequency_hz: Tensor, antennas: AntennaPath, grid: ImageGrid) -> Tensor:
        """Form the image by motion compensation and omega-K.

        Args:
            history: Phase history, shape (..., pulse, frequency), complex.
            frequency_hz: Frequencies in Hz, shape (frequency,).
            antennas: Path of the antenna.
            grid: Pixels.

        Returns:
            Image, shape (..., azimuth, range).

        Raises:
            ValueError: If the path is bistatic or does not suit, see `MotionCompensation`.
        """
        assert self.beam is not None
        return compensated_image(history, frequency_hz, antennas, grid, self.beam, self.order)
