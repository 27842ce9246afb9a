"""Choices that a config makes, such as the form of the focusing, and their alternatives.

The value `auto` selects the cheapest alternative with an acceptable predicted loss, or the most
exact one if there is none.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from torchsar.core import Axis, Draws, Signal, unit_phasor
from torchsar.focus import azimuth_matched_filter, deramp_azimuth
from torchsar.focus.backprojection import direct_sum
from torchsar.focus.reference import REFERENCES
from torchsar.metrics.image import error_after_gain_db
from torchsar.multichannel.stationary import StationaryImage, stationary_axis
from torchsar.radar import (
    LIGHT_M_S,
    AntennaPath,
    BistaticRadar,
    InverseRadar,
    StraightTrack,
    StripmapRadar,
    TriangularLadar,
    frequency_samples,
)
from torchsar.scene import SideBeam
from torchsar.study.settings.errors import ConfigError, one_line
from torchsar.study.settings.sections import Config, Loaded
from torchsar.study.settings.signature import AUTO


@dataclass(frozen=True)
class Alternative:
    """One alternative of a choice.

    Args:
        name: Name in tables.
        keys: Keys and values that select it in the mapping of the choice.
        loss: Predicted loss by metric; None if there is no prediction.
        neglects: Description of the effects that the alternative neglects.
        effect: Field `effect` of the `Requirement` about the same simplification; empty if there is
            none. The verdict of that requirement then follows from `loss`.
    """

    name: str
    keys: Mapping[str, Any] = field(default_factory=dict)
    loss: Mapping[str, float] | None = None
    neglects: str = ""
    effect: str = ""


# lower levels are differences due to rounding in double precision
EXACT_DB = -280.0


@dataclass(frozen=True)
class Measured:
    """Measurement of the time and the loss of alternatives.

    Args:
        run: Function of an alternative that computes its result, and whose time is measured.
        loss: Function of an alternative and its result that returns the loss by metric, relative to
            an exact result.
        share: Function of an alternative that returns which part of the whole work `run` does,
            between 0 and 1; measured times are divided by it.
    """

    run: Callable[[Alternative], Any]
    loss: Callable[[Alternative, Any], Mapping[str, float]]
    share: Callable[[Alternative], float] = lambda alternative: 1.0


@dataclass(frozen=True)
class Choice:
    """A choice that a config makes, with its alternatives from the cheapest to the exact one.

    Args:
        name: Name in tables.
        at: The key that may have the value `auto`: a dotted key of the world such as
            `world.fidelity`, `stage`, or `STAGE.key` for a key of all stages of that name.
        alternatives: The alternatives, the cheapest first and the most exact one last.
        measured: Function that prepares the measurement of the alternatives, which may take long;
            None if they cannot be measured.
        yardstick: Exact alternative to which losses are relative, if it is not the last one of
            `alternatives`; None otherwise.
    """

    name: str
    at: str
    alternatives: Sequence[Alternative]
    measured: Callable[[], Measured] | None = None
    yardstick: Alternative | None = None


def beside_direct_sum(prepared: Callable[[], DirectlySummed], neglects: str) -> Choice:
    """Return the comparison of the recommended image with the direct sum at random pixels.

    Args:
        prepared: Function that prepares the image.
        neglects: What the recommended image neglects.
    """

    def measured() -> Measured:
        of = prepared()
        return Measured(
            lambda one: of.exact() if one.keys else of.image(),
            lambda one, made: {"image_error_db": of.error_db(made if one.keys else of.at(made))},
            lambda one: of.share if one.keys else 1.0,
        )

    return Choice(
        "image beside the direct sum",
        "image",
        [
            Alternative("recommended image", {}, None, neglects),
            Alternative("direct sum, times extrapolated from random pixels", {"exact": True}),
        ],
        measured,
    )


def tolerance_of(loaded: Loaded) -> dict[str, float]:
    """Return the largest acceptable loss of each metric, by the config or else by the system."""
    unknown = next((name for name in loaded.config.trade.tolerance if name not in loaded.system.tolerance), None)
    if unknown is not None:
        known = ", ".join(loaded.system.tolerance)
        raise ConfigError(
            f"{loaded.file}: trade.tolerance names {unknown!r}, which is no loss of this system (losses: {known})"
        )
    return {**loaded.system.tolerance, **loaded.config.trade.tolerance}


def within(loss: Mapping[str, float] | None, tolerance: Mapping[str, float]) -> bool:
    """Return whether the losses are known and within their tolerances; NaN is not within any."""
    return loss is not None and all(value <= tolerance[name] for name, value in loss.items() if name in tolerance)


def cheapest(choice: Choice, tolerance: Mapping[str, float]) -> Alternative:
    """Return the first alternative with an acceptable predicted loss, or else the last one."""
    kept = [one for one in choice.alternatives if one.loss is not None and within(one.loss, tolerance)]
    return kept[0] if kept else choice.alternatives[-1]


def choices_of(bench: Any) -> Sequence[Choice]:
    """Return the choices between alternatives that a config has.

    Raises:
        ConfigError: If the losses of the alternatives cannot be predicted.
    """
    try:
        return bench.system.choices(bench)
    except ConfigError:
        raise
    except (ValueError, TypeError) as error:
        raise ConfigError(f"{bench.file}: {one_line(error)}") from None


def resolved(loaded: Loaded, bench_of: Callable[[Loaded], Any]) -> tuple[Loaded, tuple[str, ...]]:
    """Replace every `auto` of a config by the cheapest alternative with a predicted loss within the
    tolerance, or by the most exact one where there is none.

    Args:
        loaded: The config.
        bench_of: Function that prepares a config without `auto` for simulation and processing, see
            `Bench`.

    Returns:
        The config without `auto`, and a sentence about each replacement with its reason.

    Raises:
        ConfigError: If the system has no alternatives for a key with the value `auto`.
    """
    found = list(_automatic(loaded.config, loaded.system.stages.automatic))
    if not found:
        return loaded, ()
    exact = loaded.system.exact
    unknown = next((path for at, path, _ in found if at not in exact), None)
    if unknown is not None:
        raise ConfigError(
            f"{loaded.file}: {unknown} is 'auto', but this system accepts 'auto' only for "
            f"{', '.join(exact) or 'no key'}"
        )
    bench = bench_of(loaded.changed({path: {**entry, **exact[at]} for at, path, entry in found}, "auto"))
    choices = {choice.at: choice for choice in choices_of(bench)}
    fixed = next((path for at, path, _ in found if at not in choices), None)
    if fixed is not None:
        raise ConfigError(f"{loaded.file}: {fixed} is 'auto', but this config has no alternatives for it; give a value")
    tolerance, changes, reasons = tolerance_of(loaded), {}, []
    for at, path, entry in found:
        taken = cheapest(choices[at], tolerance)
        changes[path] = {**entry, **taken.keys}
        why = ", ".join(
            f"{name} {value:.3g} (at most {tolerance[name]:g})" for name, value in (taken.loss or {}).items()
        )
        best = "the cheapest with an acceptable" if within(taken.loss, tolerance) else "the most exact, with a"
        reasons.append(f"{path}: {taken.name} was chosen, {best} predicted loss: {why or 'exact'}")
    return loaded.changed(changes, "auto"), tuple(reasons)


def _automatic(config: Config, keys: Collection[str]) -> Iterator[tuple[str, str, Mapping[str, Any]]]:
    """Generate every `auto` of a config, as the key of its choice (`Choice.at`), the path of its
    mapping, and the mapping.

    keys: "STAGE.KEY" of the keys that may be `auto`. Other keys may have the same value with
    another meaning.
    """
    for key, value in (config.world or {}).items():
        if isinstance(value, Mapping) and value.get("kind") == AUTO:
            yield f"world.{key}", f"world.{key}", value
    for name, method in config.processor.items():
        for stage, entry in (method.stages or {}).items():
            path = f"processor.{name}.stages.{stage}"
            if entry["stage"] == AUTO:
                yield "stage", path, entry
            for key in (key for key, value in entry.items() if value == AUTO and key != "stage"):
                if f"{entry['stage']}.{key}" in keys:
                    yield f"{entry['stage']}.{key}", path, entry


# distance of the antenna from a rotating target; at this distance float64 resolves a path to 3e-11
# m
_FAR_M = 1e5
# number of pixels at which images are compared, by choice
PIXELS = 256


def some_pixels(draws: Draws, count: int) -> Tensor:
    """Choose random pixels of an image.

    Args:
        draws: Random draws.
        count: Number of pixels of the image.

    Returns:
        Numbers of at most `PIXELS` pixels in rising order, int64 (pixel,).
    """
    return draws.subset("trade.pixels", count, min(PIXELS, count))


def white_noise(draws: Draws, pulses: int, samples: int) -> Tensor:
    """Draw the white noise on which images are compared.

    Args:
        draws: Random draws.
        pulses: Number of pulses.
        samples: Number of samples of a pulse.

    Returns:
        Noise, complex128 (pulse, sample).
    """
    return draws.normal("trade.noise", (pulses, samples), torch.complex128)


def lit_noise(noise: Tensor, frequency_hz: Tensor, antennas: AntennaPath, beam: SideBeam) -> Tensor:
    """Give white noise the spectrum of scatterers in all directions, seen through an antenna.

    Args:
        noise: White noise, complex128 (pulse, frequency).
        frequency_hz: Frequencies in Hz, float64 (frequency,).
        antennas: Path of the antennas, about straight; the receiver has the beam.
        beam: Beam of the antenna; of several trials the mean.

    Returns:
        Phase history, complex128 (pulse, frequency).
    """
    place, reference = (
        x.reshape(-1, *x.shape[-n:])[0] for x, n in ((antennas.places[-1], 2), (antennas.reference_m, 1))
    )
    sine = torch.linspace(-1, 1, 8193, dtype=torch.float64)
    power = beam.mean_power(sine).reshape(-1, len(sine)).mean(0)
    # cycles per pulse of the echo of a scatterer ahead, and all directions with the same echo
    ahead = (2 if antennas.receiver_m is None else 1) * StraightTrack.fitted(place).step_m * frequency_hz / LIGHT_M_S
    most = math.ceil(float(ahead.max()) + 0.5)
    cycles = torch.fft.fftfreq(len(noise), dtype=torch.float64)
    held = torch.zeros(noise.shape, dtype=torch.float64)
    for alias in range(-most, most + 1):
        at = (cycles[:, None] + alias) / ahead
        held += power[((at.clamp(-1, 1) + 1) / 2 * (len(sine) - 1)).round().long()] * (at.abs() <= 1)
    lit = torch.fft.ifft(torch.fft.fft(noise, dim=0) * held.sqrt(), dim=0)
    return lit * unit_phasor(reference[:, None] * (frequency_hz / LIGHT_M_S), noise.dtype)


@dataclass(frozen=True, eq=False)
class DirectlySummed:
    """An image of a phase history, and the geometry in which the direct sum forms it.

    Args:
        history: Phase history, complex128 (pulse, frequency).
        frequency_hz: Frequencies in Hz, float64 (frequency,).
        antennas: Positions of the antennas at the pulses, without leading dimensions.
        pixels_m: Positions in metres of the pixels that are compared, float64 (pixel, 3).
        image: Function that forms the whole image by the recommended method.
        at: Function of that image that returns the pixels that are compared, complex (pixel,), with
            the phase convention of the direct sum.
        share: Number of these pixels over that of the whole image.
        weight: Weights of some pulses (a slice) at positions (pixel, 3) in the sum, float64 (pulse,
            pixel); None for all pulses alike.
        wave_speed_m_s: Propagation speed in m/s.
    """

    history: Tensor
    frequency_hz: Tensor
    antennas: AntennaPath
    pixels_m: Tensor
    image: Callable[[], Tensor]
    at: Callable[[Tensor], Tensor]
    share: float
    weight: Callable[[slice, Tensor], Tensor] | None = None
    wave_speed_m_s: float = LIGHT_M_S
    _kept: list[Tensor] = field(default_factory=list, init=False)

    def exact(self) -> Tensor:
        """Return the direct sum at the pixels, complex128 (pixel,)."""

        def path(pulses: slice, pixels: slice) -> tuple[Tensor, Tensor | None]:
            points = self.pixels_m[pixels]
            weight = None if self.weight is None else self.weight(pulses, points)
            return self.antennas.path_m(points, pulses), weight

        speed = self.wave_speed_m_s
        return direct_sum(self.history, self.frequency_hz, path, len(self.pixels_m), wave_speed_m_s=speed)

    def error_db(self, pixels: Tensor) -> float:
        """Return the relative error of pixels after a common gain, in dB.

        Args:
            pixels: Values at the pixels, such as those of `at`, complex (pixel,).
        """
        if not self._kept:
            self._kept.append(self.exact())
        (exact,) = self._kept
        return float(error_after_gain_db(pixels[None].to(exact.dtype), exact[None]))


def turning_target(
    radar: InverseRadar,
    angle_rad: Tensor,
    cross_m: Tensor,
    centre_m: float,
    samples: int,
    draws: Draws,
    image: Callable[[Tensor], Tensor],
) -> DirectlySummed:
    """Describe the image of white noise as that of a turning target, with the antenna on a far arc.

    At the angle phi the antenna lies in the direction -(sin phi, cos phi) from the centre of
    rotation, in coordinates of cross range and range.

    Args:
        radar: Radar parameters.
        angle_rad: Angle of the target at each pulse in rad, float64 (pulse,).
        cross_m: Cross range of the lines of the image in metres, float64 (azimuth,).
        centre_m: Distance of range zero from the centre of rotation in metres.
        samples: Number of range cells.
        draws: Random draws.
        image: Function of range profiles (pulse, range) that returns their image (azimuth, range),
            with phases that refer to the angle zero.

    Returns:
        The image with its direct sum.
    """
    profiles = white_noise(draws, len(angle_rad), samples)
    cell = torch.arange(samples, dtype=torch.float64) - samples // 2
    along = torch.stack([torch.sin(angle_rad), torch.cos(angle_rad), torch.zeros_like(angle_rad)], -1)
    reference = torch.full_like(angle_rad, 2 * (_FAR_M + centre_m))
    pixels = torch.cartesian_prod(cross_m, centre_m + cell * radar.range_step_m, cross_m.new_zeros(1))
    some = some_pixels(draws, len(pixels))
    still = AntennaPath(pixels.new_tensor([[0.0, -_FAR_M, 0.0]]), None, reference[:1])
    turns = still.path_m(pixels[some])[0] / radar.wavelength_m
    return DirectlySummed(
        frequency_samples(profiles),
        radar.carrier_hz + cell * (radar.bandwidth_hz / samples),
        AntennaPath(-_FAR_M * along, None, reference),
        pixels[some],
        lambda: image(profiles),
        lambda made: made.reshape(-1)[some] * unit_phasor(turns, made.dtype),
        len(some) / len(pixels),
        wave_speed_m_s=radar.wave_speed_m_s,
    )


def ladar_strip(
    radar: TriangularLadar, pulse: Axis, range_: Axis, beam_rad: float | None, draws: Draws, dtype: torch.dtype
) -> DirectlySummed:
    """Describe the image of white noise by `azimuth_matched_filter`, with the ladar on its track.

    Args:
        radar: Ladar parameters.
        pulse: Slow time of the profiles.
        range_: Range relative to the reference range of the ladar.
        beam_rad: Angle of the aperture in rad; None for the whole record.
        draws: Random draws.
        dtype: Dtype of the image.

    Returns:
        The image with its direct sum.
    """
    noise, along = white_noise(draws, pulse.n, range_.n), radar.speed_m_s * pulse.values()
    closest = radar.reference_range_m + range_.values()
    middle = closest[range_.n // 2]
    pixels = torch.cartesian_prod(along, closest, along.new_zeros(1))[:, [1, 0, 2]]
    some = some_pixels(draws, len(pixels))
    cell = torch.arange(range_.n, dtype=torch.float64) - range_.n // 2
    band, data = radar.wave_speed_m_s / (2 * range_.step), noise.to(dtype)
    # dechirped echoes have the conjugate phase, and the filter gives the mean over an aperture
    turns = 2 * (pixels[some, 0] - middle) / radar.wavelength_m
    step = radar.speed_m_s * pulse.step
    lit = 2 * torch.floor((beam_rad or 0.0) * pixels[some, 0] / (2 * step)) + 1

    def seen(pulses: slice, points: Tensor) -> Tensor:
        reach = math.inf if beam_rad is None else beam_rad * points[:, 0] / 2
        return ((along[pulses, None] - points[:, 1]).abs() <= reach).to(torch.float64)

    return DirectlySummed(
        frequency_samples(noise.conj().resolve_conj()),
        radar.carrier_hz + cell * (band / range_.n),
        AntennaPath(_on_track(along), None, 2 * middle.expand(pulse.n)),
        pixels[some],
        lambda: azimuth_matched_filter(deramp_azimuth(data, radar, pulse, range_), radar, pulse, range_, beam_rad),
        lambda made: made.reshape(-1)[some].conj() * unit_phasor(turns, dtype) * lit,
        len(some) / len(pixels),
        seen,
        radar.wave_speed_m_s,
    )


def points_at_rest(
    radar: BistaticRadar,
    stage: StationaryImage,
    size: tuple[int, int],
    lit_s: float,
    draws: Draws,
    dtype: torch.dtype,
    echo: Callable[[Tensor, Tensor], Tensor],
) -> DirectlySummed:
    """Describe the image of points at rest near random pixels by several receive channels.

    Noise is not suitable, because reconstruction inverts the sampling by the channels, which the
    direct sum does not. Receive paths are travelled once, so that the frequencies are half those of
    the radar.

    Args:
        radar: Radar parameters.
        stage: Stage that forms the image.
        size: Number of pulses and of range samples.
        lit_s: Time in seconds for which points are lit; those are compared that are lit within the
            record.
        draws: Random draws.
        dtype: Dtype of the image.
        echo: Function of azimuth and range beyond the reference range of points in metres, float64
            (point,), that returns their echo without the transmit range, complex128 (channel,
            pulse, range).

    Returns:
        The image with its direct sum.
    """
    axes = radar.axes(*size)
    lines, cells = stationary_axis(radar, axes[1], stage.rebuild.bands), axes[2]
    reach = max(0.0, size[0] / radar.prf_hz - lit_s) / 2 * radar.speed_m_s
    rows = slice(*(round(float(lines.index_of(y))) + more for y, more in ((-reach, 0), (reach, 1))))
    # a quarter of the cells is left out on each side, because range migration extends into it
    columns = slice(cells.n // 4, 3 * cells.n // 4)
    along, closest = lines.values()[rows], cells.values()[columns] - radar.reference_range_m
    pixels = torch.cartesian_prod(along, closest, along.new_zeros(1))[:, [1, 0, 2]]
    some = some_pixels(draws, len(pixels))
    off = draws.uniform("trade.offsets", (2, len(some))) - 0.5
    data = echo(pixels[some, 1] + off[0] * lines.step, pixels[some, 0] + off[1] * cells.step)
    used = Signal(data.to(dtype), axes)
    turns = pixels[some, 0] / radar.wavelength_m
    cell = torch.arange(cells.n, dtype=torch.float64) - cells.n // 2
    place = (radar.speed_m_s * axes[1].values() - radar.channels_at()[:, None]).reshape(-1)
    return DirectlySummed(
        frequency_samples(data.flatten(0, 1)),
        (radar.carrier_hz + cell * (radar.sampling_hz / cells.n)) / 2,
        AntennaPath(_on_track(place), None, torch.full_like(place, 2 * radar.reference_range_m)),
        pixels[some] + pixels.new_tensor([radar.reference_range_m, 0.0, 0.0]),
        lambda: stage(used).data,
        lambda made: made[rows, columns].reshape(-1)[some] * unit_phasor(turns, dtype),
        len(some) / (lines.n * cells.n),
        wave_speed_m_s=radar.wave_speed_m_s,
    )


def points_of_a_strip(
    radar: StripmapRadar,
    raw: Signal,
    zero_doppler_s: Tensor,
    closest_range_m: Tensor,
    doppler_hz: float,
    velocity_m_s: float,
    image: Callable[[], Tensor],
) -> DirectlySummed:
    """Describe the image of lit points of a strip at the pixels nearest to them.

    Noise is not suitable: points have only the Doppler of their dwell, noise that of the whole PRF.

    Args:
        radar: Radar parameters.
        raw: Raw data of the points, complex128, with the axes (pulse, range).
        zero_doppler_s: Times of closest approach of the points in seconds, float64 (point,).
        closest_range_m: Closest ranges of the points in metres, float64 (point,).
        doppler_hz: Doppler centroid in Hz, to which image coordinates refer where the radar has no
            nominal pointing.
        velocity_m_s: Effective velocity in m/s.
        image: Function that forms the image, complex (azimuth, range).

    Returns:
        The image with its direct sum.
    """
    pulses, n = raw.data.shape
    frame = doppler_hz if radar.pointing_doppler_hz is None else radar.pointing_doppler_hz
    positions = radar.image_position(zero_doppler_s, closest_range_m, frame, velocity_m_s)
    axes = radar.image_axes(raw.axes)
    index = [axis.index_of(x).round().long().clamp(0, axis.n - 1) for axis, x in zip(axes, positions, strict=True)]
    along, slant = (axis.values()[i] for axis, i in zip(axes, index, strict=True))
    sine = radar.sin_squint(frame, velocity_m_s)
    # azimuth at which the chosen line of sight crosses the point, which is before broadside
    along = velocity_m_s * along / radar.velocity_m_s + sine * slant
    compressed = torch.fft.fft(raw.data) * REFERENCES["matched"](radar.pulse, n, radar.sampling_hz)
    cell, near = torch.arange(n, dtype=torch.float64) - n // 2, raw.axes[1].start
    place = velocity_m_s * raw.axes[0].values()
    turns = 2 * (slant - near) / radar.wavelength_m
    return DirectlySummed(
        torch.fft.fftshift(compressed, dim=-1),
        radar.carrier_hz + cell * (radar.sampling_hz / n),
        AntennaPath(_on_track(place), None, torch.full_like(place, 2 * near)),
        torch.stack([slant * torch.sqrt(1 - sine.square()), along, torch.zeros_like(along)], -1),
        image,
        # an image may have several lines per pulse
        lambda made: made[:: made.shape[0] // pulses][index[0], index[1]] * unit_phasor(turns, made.dtype),
        len(slant) / (pulses * n),
        # weights as in `PointPatches.exact`; x is the closest range
        lambda some, points: points[:, 0].rsqrt().expand(len(place[some]), -1),
        radar.wave_speed_m_s,
    )


def _on_track(along_m: Tensor) -> Tensor:
    """Positions on a straight track along y, float64 (pulse, 3)."""
    return torch.stack([torch.zeros_like(along_m), along_m, torch.zeros_like(along_m)], -1)
