"""Simulation of strips."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchsar.core import Draws, Recording, Truth, gathered_checks, per_trial, power_of
from torchsar.core.fft import smooth_length
from torchsar.echo.recorded import Impairment, noise, recorded
from torchsar.echo.sums import blocks, echo_spectrum, row_bytes, summed_by_transform
from torchsar.radar import StripmapRadar
from torchsar.scene import GroundMovers, Scatterers, StripmapWorld
from torchsar.scene.trials import refuse_other_trials

# size of the phase tables of a block of pulses and targets, about that of the cache of a processor
_TABLE_BYTES = 8 << 20


@dataclass(frozen=True)
class Placed:
    """Scatterers in the geometry of a straight path.

    Args:
        crossing_s: Slow time at which the beam centre crosses the scatterer in seconds, shape (...,
            target), float64.
        zero_doppler_s: Slow time of closest approach in seconds, same shape.
        closest_m: Closest range in metres, same shape.
        amplitude: Amplitude, same shape, complex.
        along_m_s: Along-track speed of the radar relative to the scatterer in m/s, same shape; None
            for scatterers at rest, for which it is the effective velocity.
        closing_m_s: Speed of the scatterer towards the track in m/s, same shape; None if at rest.
    """

    crossing_s: Tensor
    zero_doppler_s: Tensor
    closest_m: Tensor
    amplitude: Tensor
    along_m_s: Tensor | None = None
    closing_m_s: Tensor | None = None

    def chosen(self, index: Any) -> Placed:
        """Return some scatterers.

        Args:
            index: Index of tensors of shape (..., target).

        Returns:
            The chosen scatterers.
        """
        chosen: list[Any] = [None if x is None else x[index] for x in vars(self).values()]
        return Placed(*chosen)

    def speed_m_s(self, velocity_m_s: Tensor) -> Tensor:
        """Return the speed at which the radar passes the scatterers.

        Args:
            velocity_m_s: Effective velocity in m/s, the speed past those at rest.

        Returns:
            Speed in m/s, broadcastable to the scatterers.
        """
        return (
            velocity_m_s
            if self.along_m_s is None or self.closing_m_s is None
            else torch.hypot(self.along_m_s, self.closing_m_s)
        )


def path_geometry(
    scatterers: Scatterers,
    radar: StripmapRadar,
    n_pulse: int,
    n_range: int,
    doppler_hz: Tensor | float,
    velocity_m_s: Tensor | float,
) -> Placed:
    """Convert positions of scatterers in the recorded frame to crossing times and closest ranges.

    Positions are zero at the middle of the frame, which is the middle pulse and the middle of the
    fully compressed part of a range line.

    Args:
        scatterers: Scatterers, shape (..., target).
        radar: Radar parameters.
        n_pulse: Number of pulses.
        n_range: Number of range samples.
        doppler_hz: Doppler frequency of the beam centre in hertz, a number or one value per trial.
        velocity_m_s: Effective velocity in m/s, a number or one value per trial.

    Returns:
        The scatterers in the geometry of the straight path, shape (..., target).
    """
    doppler, velocity = (per_trial(v, 1, scatterers.azimuth_m) for v in (doppler_hz, velocity_m_s))
    middle_m = radar.near_range_m + max(0, n_range - radar.pulse_samples) / 2 * radar.range_step_m
    slant = middle_m + scatterers.range_m
    crossing = (n_pulse // 2) / radar.prf_hz + scatterers.azimuth_m / velocity
    sin = radar.sin_squint(doppler, velocity)
    crossing, zero, closest, amplitude = torch.broadcast_tensors(
        crossing, crossing + sin * slant / velocity, slant * torch.sqrt(1 - sin.square()), scatterers.amplitude
    )
    return Placed(crossing, zero, closest, amplitude)


def _with_movers(
    placed: Placed,
    world: StripmapWorld,
    radar: StripmapRadar,
    size: tuple[int, int],
    draws: Draws,
    doppler_hz: Tensor | float,
    velocity_m_s: Tensor | float,
) -> Placed:
    """The scatterers at rest and the moving ones after them.

    A point in uniform motion has the range history of one at rest that the radar passes in another
    direction, at another speed.
    """
    if world.movers is None:
        return placed
    if any(isinstance(one, GroundMovers) for one in getattr(world.movers, "parts", {"": world.movers}).values()):
        raise ValueError("movers of a strip move uniformly in the slant plane; give MovingPoints or a Ship")
    moving = world.movers.movers(radar, draws.part("movers"))  # pyright: ignore[reportArgumentType]
    moving = moving.each(lambda x: x.to(placed.closest_m.device))
    begin = Scatterers(moving.y0_m, moving.range_m, moving.amplitude)
    at = path_geometry(begin, radar, *size, doppler_hz, velocity_m_s)
    middle_s = (size[0] // 2) / radar.prf_hz
    velocity = per_trial(velocity_m_s, 1, at.closest_m)
    along, closing = velocity - moving.u_a_m_s, moving.u_r_m_s
    # position relative to the radar at the middle pulse, along the track and away from it
    x_m, y_m = velocity * (at.zero_doppler_s - middle_s), at.closest_m
    sin = radar.sin_squint(per_trial(doppler_hz, 1, y_m), velocity)
    tan = sin / torch.sqrt(1 - sin.square())
    square = along.square() + closing.square()
    crossing = middle_s + (x_m - tan * y_m) / (along - tan * closing)
    zero = middle_s + (along * x_m + closing * y_m) / square
    moved = (crossing, zero, (along * y_m - closing * x_m) / square.sqrt(), at.amplitude, along, closing)
    still = (
        placed.crossing_s,
        placed.zero_doppler_s,
        placed.closest_m,
        placed.amplitude,
        velocity.expand(*placed.closest_m.shape[:-1], 1).expand(placed.closest_m.shape),
        torch.zeros_like(placed.closest_m),
    )
    lead = np.broadcast_shapes(*(x.shape[:-1] for x in (*moved, *still)))
    return Placed(*(torch.cat([x.expand(*lead, x.shape[-1]) for x in pair], -1) for pair in zip(still, moved)))


def stripmap_echo(
    placed: Placed,
    world: StripmapWorld,
    radar: StripmapRadar,
    n_pulse: int,
    n_range: int,
    dtype: torch.dtype = torch.complex64,
) -> Tensor:
    """Return the raw echo without noise.

    >>> from torchsar import Draws, echo, radar, scene
    >>> from torchsar.echo.strip import path_geometry
    >>> strip = radar.StripmapRadar(3e9, radar.LinearFM(40e6, 5e-7), 50e6, 400.0, 120.0, 4000.0)
    >>> world = scene.StripmapWorld(scene.Points([0.0], [0.0]))
    >>> placed = path_geometry(world.scene.scatterers(Draws(1)), strip, 4, 64, 0.0, 120.0)
    >>> (echo.stripmap_echo(placed, world, strip, 4, 64).abs() > 0.5).sum(-1)  # samples of a pulse
    tensor([26, 26, 26, 26])

    The echo is formed in range frequency from the spectrum of the sampled pulse. Slow time is zero
    at the first pulse. Echoes partly outside the record are cut off and never wrap around.
    Differentiable in positions, amplitudes, velocity and Doppler frequency.

    Args:
        placed: Scatterers, shape (..., target), as from `path_geometry`.
        world: Simulated world: its beam, path, velocity and Doppler frequency are used.
        radar: Radar parameters.
        n_pulse: Number of pulses.
        n_range: Number of range samples.
        dtype: Complex dtype of the result.

    Returns:
        Echo, shape (..., pulse, range).
    """
    n_fft = _line_length(placed, radar, n_range)
    echo = _lines(placed, world, radar, n_pulse, n_range, n_fft, dtype)
    if n_fft == n_range or placed.closest_m.ndim == 1 or placed.along_m_s is not None:
        return echo
    fits = _fits(placed, radar, n_range)
    if not bool(fits.any()):
        return echo
    # if only some trials need a longer FFT, each trial has the FFT that it would have alone
    return torch.where(fits[..., None, None], _lines(placed, world, radar, n_pulse, n_range, n_range, dtype), echo)


def _lines(
    placed: Placed,
    world: StripmapWorld,
    radar: StripmapRadar,
    n_pulse: int,
    n_range: int,
    n_fft: int,
    dtype: torch.dtype,
) -> Tensor:
    """Raw lines (..., pulse, range), computed by FFTs of n_fft samples."""
    spectrum = torch.fft.fftshift(radar.pulse.spectrum(n_fft, radar.sampling_hz, placed.closest_m.device)).to(dtype)
    lines = []
    slow_s = torch.arange(n_pulse, dtype=torch.float64, device=placed.closest_m.device) / radar.prf_hz
    count = placed.closest_m.shape[-1]
    many = summed_by_transform(count, n_fft, slow_s.device)
    row = row_bytes(count, n_fft, dtype) if many else 8 * n_fft
    for pulses in blocks(n_pulse, row, _TABLE_BYTES, 64):
        block = _block_spectrum(placed, world, radar, slow_s[pulses], n_fft, dtype)
        lines.append(torch.fft.ifft(torch.fft.ifftshift(block * spectrum, dim=-1))[..., :n_range])
    return torch.cat(lines, -2)


def _block_spectrum(
    placed: Placed, world: StripmapWorld, radar: StripmapRadar, pulse_s: Tensor, n_fft: int, dtype: torch.dtype
) -> Tensor:
    """Range spectrum (..., pulse, n_fft) of a block of pulses, summed over blocks of targets."""
    velocity = per_trial(radar.velocity_m_s if world.velocity_m_s is None else world.velocity_m_s, 2, pulse_s)
    doppler = per_trial(_true_doppler(world, radar), 2, pulse_s)
    total = torch.zeros((*placed.closest_m.shape[:-1], pulse_s.numel(), n_fft), dtype=dtype, device=pulse_s.device)
    count = placed.closest_m.shape[-1]
    many = summed_by_transform(count, n_fft, pulse_s.device)
    each = 25 * dtype.itemsize if many else 8 * 3 * math.isqrt(n_fft)
    width = max(16, _TABLE_BYTES // (pulse_s.numel() * each))
    for first in range(0, count, width):
        some = placed.chosen((..., None, slice(first, first + width)))
        since, weight = _times_and_gain(some, world, radar, pulse_s, doppler, velocity)
        # With few targets all are summed, so that the sum of a trial does not depend on other
        # trials. Otherwise those are summed that any pulse of any trial illuminates.
        lit = slice(None) if count <= width else (weight.detach() != 0).flatten(0, -2).any(0).nonzero()[:, 0]
        some, since, weight = some.chosen((..., lit)), since[..., lit], weight[..., lit]
        if not since.shape[-1]:
            continue
        range_m = world.path.range_m(since, some.closest_m, some.speed_m_s(velocity))
        delay = 2 * (range_m - radar.near_range_m) / radar.wave_speed_m_s
        inside = (delay > -radar.pulse.duration_s) & (delay < n_fft / radar.sampling_hz)
        amplitude = some.amplitude * torch.where(inside, weight, 0)
        turns = 2 * radar.carrier_hz / radar.wave_speed_m_s * range_m
        total = total + echo_spectrum(delay, turns, amplitude, n_fft, radar.sampling_hz / n_fft, dtype, many)
    return total


def _times_and_gain(
    some: Placed,
    world: StripmapWorld,
    radar: StripmapRadar,
    pulse_s: Tensor,
    doppler_hz: Tensor,
    velocity_m_s: Tensor,
) -> list[Tensor]:
    """Time since closest approach and gain, (..., pulse, target), of those (..., 1, target)."""
    since, speed = pulse_s[:, None] - some.zero_doppler_s, some.speed_m_s(velocity_m_s)
    range_m = torch.sqrt(some.closest_m.square() + (speed * since).square())
    if some.along_m_s is None or some.closing_m_s is None:
        ahead = velocity_m_s.square() * -since
    else:  # the gain depends on the direction of the target, not on its speed
        ahead = -velocity_m_s * (some.along_m_s * since + some.closing_m_s / speed * some.closest_m)
    offset = 2 * ahead / (radar.wavelength_m * range_m) - doppler_hz
    weight = world.beam.weight(pulse_s[:, None] - some.crossing_s, offset, velocity_m_s)
    return torch.broadcast_tensors(since, weight)


def _true_doppler(world: StripmapWorld, radar: StripmapRadar) -> Tensor | float:
    """Doppler frequency of the beam centre in the world; by default it is that of the radar."""
    return (radar.pointing_doppler_hz or 0.0) if world.doppler_hz is None else world.doppler_hz


def _line_length(placed: Placed, radar: StripmapRadar, n_range: int) -> int:
    """FFT length in which no echo wraps.

    It is the length of a line if all echoes fit into it, otherwise longer by a pulse.
    """
    first, last = (
        2 * (float(closest) - radar.near_range_m) / radar.wave_speed_m_s * radar.sampling_hz
        for closest in placed.closest_m.detach().aminmax()
    )
    if first >= 0 and last + _margin(radar) <= n_range and placed.along_m_s is None:
        return n_range
    return smooth_length(n_range + radar.pulse_samples)


def _fits(placed: Placed, radar: StripmapRadar, n_range: int) -> Tensor:
    """True if all echoes of a trial lie inside the line, (...,) bool."""
    nearest, farthest = placed.closest_m.detach().aminmax(dim=-1)
    last_m = radar.near_range_m + (n_range - _margin(radar)) * radar.range_step_m
    return (nearest >= radar.near_range_m) & (farthest <= last_m)


def _margin(radar: StripmapRadar) -> int:
    """Number of samples beyond a line: those of a pulse, and 256 for range migration, by choice."""
    return 256 + radar.pulse_samples


def target_energy(truth: Truth, world: StripmapWorld, radar: StripmapRadar, n_pulse: int) -> Tensor:
    """Return the energy of the raw echo of each target over all lines of the record.

    The energy divided by the noise variance (`noise_std` squared) is the peak signal-to-noise ratio
    after two-dimensional compression.

    Args:
        truth: True values returned by `simulate`.
        world: Simulated world; its beam weights the pulses.
        radar: Radar parameters.
        n_pulse: Number of pulses.

    Returns:
        Energy in squared sample amplitudes, shape (..., target).
    """
    values = truth.values
    crossing = values["crossing_s"]
    placed = Placed(crossing, values["zero_doppler_s"], values["closest_range_m"], values["amplitude"])
    pulse_s = torch.arange(n_pulse, dtype=torch.float64, device=crossing.device) / radar.prf_hz
    velocity, doppler = (per_trial(values[name], 2, pulse_s) for name in ("velocity_m_s", "doppler_hz"))
    some = placed.chosen((..., None, slice(None)))
    weight = _times_and_gain(some, world, radar, pulse_s, doppler, velocity)[1]
    return radar.pulse.duration_s * radar.sampling_hz * values["amplitude"].abs().square() * weight.square().sum(-2)


def lit_power(echo: Tensor) -> Tensor:
    """Return the mean power of the illuminated raw samples.

    Args:
        echo: Raw echo, shape (..., pulse, range), complex.

    Returns:
        Mean power of the samples whose power exceeds 1e-4 of the largest power in their trial,
        shape (...,).
    """
    power = power_of(echo)
    lit = power > 1e-4 * power.amax((-2, -1), keepdim=True)
    return (power * lit).sum((-2, -1)) / lit.sum((-2, -1)).clamp_min(1)


@gathered_checks()
def simulate(
    radar: StripmapRadar,
    world: StripmapWorld,
    n_pulse: int,
    n_range: int,
    draws: Draws,
    impairments: Mapping[str, Impairment] | None = None,
    dtype: torch.dtype = torch.complex64,
    device: torch.device | str | None = None,
) -> tuple[Recording, Truth]:
    """Simulate raw stripmap recordings, one per trial of `draws`.

    >>> from torchsar import Draws, echo, radar, scene
    >>> strip = radar.StripmapRadar(3e9, radar.LinearFM(40e6, 5e-7), 50e6, 400.0, 120.0, 4000.0)
    >>> world = scene.StripmapWorld(scene.Points([0.0], [0.0]))
    >>> recording, truth = echo.simulate(strip, world, n_pulse=16, n_range=64, draws=Draws(1))
    >>> recording.signal.data.shape, truth.values["crossing_s"]  # of the middle pulse
    (torch.Size([16, 64]), tensor([0.0200], dtype=torch.float64))

    Positions of the scene are zero at the middle of the frame: at the middle pulse, and in the
    middle of the range window, whose echoes are recorded completely.

    Args:
        radar: Radar parameters.
        world: Scene, beam, path, true velocity and Doppler frequency, and signal-to-noise ratio.
        n_pulse: Number of pulses.
        n_range: Number of range samples.
        draws: Random draws.
        impairments: Impairments by name, applied in order.
        dtype: Complex dtype of the recording.
        device: Device of the recording.

    Returns:
        The recording, shape (..., pulse, range), and the truth. The values of the truth are:

        - of the targets, shape (..., target): `crossing_s`, the time at which the beam centre
          crosses the target, and `zero_doppler_s`, both in seconds; `closest_range_m` in metres;
          `amplitude`, complex; with moving targets, which follow those of the scene, the speeds
          `u_a_m_s` along the track and `u_r_m_s`, closing positive;
        - shape (...,) or (): the effective velocity `velocity_m_s`; the Doppler frequency
          `doppler_hz` of the beam centre; the standard deviation `noise_std` of the complex noise
          of a sample; and the number `targets_outside` of targets of which no echo is recorded,
          because they lie outside the range window or are not lit. If these are all of a trial, a
          warning says so;
        - the true values of each impairment, as "<impairment>.<name>".

        The recording `clean` of the truth has the same noise, but no impairments.

    Raises:
        ValueError: If there is no scatterer, the squint exceeds 90 degrees, a target lies behind
            the radar, a line is shorter than the pulse, or a parameter given per trial has another
            length than the number of trials.
    """
    refuse_other_trials(world, draws)
    velocity = radar.velocity_m_s if world.velocity_m_s is None else world.velocity_m_s
    doppler = _true_doppler(world, radar)
    scatterers = world.scene.scatterers(draws).to(device)
    _refuse_impossible(radar, n_range, radar.sin_squint(doppler, velocity))
    placed = path_geometry(scatterers, radar, n_pulse, n_range, doppler, velocity)
    placed = _with_movers(placed, world, radar, (n_pulse, n_range), draws, doppler, velocity)
    if bool((placed.closest_m <= 0).any()):
        raise ValueError(
            f"a target lies behind the radar, at a range of {float(placed.closest_m.min()):.4g} "
            "m; range_m counts from the middle of the recorded frame"
        )
    outside = _outside(placed, world, radar, n_pulse, n_range, velocity)
    echo = stripmap_echo(placed, world, radar, n_pulse, n_range, dtype)
    std = torch.zeros((), dtype=torch.float64, device=device)
    if world.snr_db is not None:
        std = torch.sqrt(lit_power(echo).double() / 10 ** (per_trial(world.snr_db, 0, echo) / 10))
        echo = echo + noise(draws, "noise", (n_pulse, n_range), std, dtype, device)
    values = {
        "crossing_s": placed.crossing_s,
        "zero_doppler_s": placed.zero_doppler_s,
        "closest_range_m": placed.closest_m,
        "amplitude": placed.amplitude,
        "velocity_m_s": torch.as_tensor(velocity, dtype=torch.float64),
        "doppler_hz": torch.as_tensor(doppler, dtype=torch.float64),
        "noise_std": std,
        "targets_outside": outside.sum(-1),
    }
    if placed.along_m_s is not None and placed.closing_m_s is not None:
        values |= {
            "u_a_m_s": per_trial(velocity, 1, placed.along_m_s) - placed.along_m_s,
            "u_r_m_s": placed.closing_m_s,
        }
    return recorded(echo, echo, radar.raw_axes(n_pulse, n_range), radar, values, impairments, draws)


def _outside(
    placed: Placed, world: StripmapWorld, radar: StripmapRadar, n_pulse: int, n_range: int, velocity_m_s: Tensor | float
) -> Tensor:
    """Find scatterers without a recorded echo at the recorded time nearest to their crossing of the
    beam centre, bool (..., target); warn if these are all of a trial.
    """
    time_s = placed.crossing_s.clamp(0, (n_pulse - 1) / radar.prf_hz)
    velocity = per_trial(velocity_m_s, 1, time_s)
    range_m = torch.hypot(placed.closest_m, placed.speed_m_s(velocity) * (time_s - placed.zero_doppler_s))
    sample = (range_m - radar.near_range_m) / radar.range_step_m
    since_s = (time_s - placed.crossing_s)[..., None, :]
    lit = world.beam.weight(since_s, torch.zeros_like(since_s), velocity[..., None, :])[..., 0, :] > 0
    outside = (sample <= -radar.pulse_samples) | (sample >= n_range) | ~lit
    if bool(outside.all(-1).any()):
        reach_m = max(0, n_range - radar.pulse_samples) / 2 * radar.range_step_m
        warnings.warn(
            f"no target of the scene is recorded in {int(outside.all(-1).sum())} of {outside.all(-1).numel()} trials: "
            f"the window reaches {reach_m:.4g} m to both sides of range_m = 0, and the beam has to light azimuth_m "
            f"within the {n_pulse / radar.prf_hz:.4g} s of the record",
            stacklevel=3,
        )
    return outside


def _refuse_impossible(radar: StripmapRadar, n_range: int, sin_squint: Tensor) -> None:
    """Raise ValueError for a world that the radar cannot record."""
    if not bool((sin_squint.abs() < 1).all()):
        worst = float(sin_squint.abs().max())
        raise ValueError(
            "the Doppler frequency of the beam centre must have a magnitude below 2 * velocity / wavelength, "
            f"got one that requires a squint beyond 90 degrees (sine {worst:.4g})"
        )
    if radar.pulse_samples > n_range:
        raise ValueError(
            f"a line of {n_range} samples does not hold the pulse of {radar.pulse_samples} samples; "
            "record longer lines (n_range) or shorten the pulse"
        )
