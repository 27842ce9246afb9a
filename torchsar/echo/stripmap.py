"""Simulated stripmap acquisitions: world in, recording and truth out."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Protocol

import torch
from torch import Tensor

from torchsar.core import Draws, Recording, Signal, Truth, per_trial
from torchsar.echo.pulsed import echo_spectrum
from torchsar.radar import StripmapRadar
from torchsar.scene import Scatterers, StripmapWorld

_TABLE_BYTES = 8 << 20


class Impairment(Protocol):
    """Something that happens to a recording on its way: returns the impaired recording and what is
    true about the impairment.
    """

    def __call__(self, recording: Recording, draws: Draws) -> tuple[Recording, Mapping[str, Tensor]]: ...


@dataclass(frozen=True)
class Placed:
    """Scatterers on a straight path: when the beam centre crosses them, when they are closest, how
    far. float64, (..., target).
    """

    crossing_s: Tensor
    zero_doppler_s: Tensor
    closest_m: Tensor
    amplitude: Tensor


def place(
    scatterers: Scatterers,
    radar: StripmapRadar,
    n_pulse: int,
    n_range: int,
    doppler_hz: Tensor | float,
    velocity_m_s: Tensor | float,
) -> Placed:
    """From positions in the recorded frame to the geometry of the path.

    The frame's middle is the middle pulse and the middle of the fully compressed part of a line.
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


def stripmap_echo(
    placed: Placed,
    world: StripmapWorld,
    radar: StripmapRadar,
    n_pulse: int,
    n_range: int,
    dtype: torch.dtype = torch.complex64,
) -> Tensor:
    """Raw echo without noise, (..., pulse, range) of `dtype`. Slow time starts at 0.

    Built in range frequency from the spectrum of the sampled pulse, by blocks of pulses and of the
    targets lit in them. Differentiable in positions, amplitudes, velocity and Doppler. The echo of
    a target partly outside the record is cut, never wrapped.
    """
    n_fft = _line_length(placed, radar, n_range)
    spectrum = torch.fft.fftshift(radar.pulse.spectrum(n_fft, radar.sampling_hz, placed.closest_m.device)).to(dtype)
    lines = []
    for pulses in _pulse_blocks(placed, n_pulse, n_fft):
        pulse_s = (
            torch.arange(pulses.start, pulses.stop, dtype=torch.float64, device=placed.closest_m.device) / radar.prf_hz
        )
        block = _block_spectrum(placed, world, radar, pulse_s, n_fft, dtype)
        lines.append(torch.fft.ifft(torch.fft.ifftshift(block * spectrum, dim=-1))[..., :n_range])
    return torch.cat(lines, -2)


def _block_spectrum(
    placed: Placed, world: StripmapWorld, radar: StripmapRadar, pulse_s: Tensor, n_fft: int, dtype: torch.dtype
) -> Tensor:
    """Range spectrum (..., pulse, n_fft) of one block of pulses, summed over blocks of the targets
    that are lit in it.
    """
    velocity = per_trial(radar.velocity_m_s if world.velocity_m_s is None else world.velocity_m_s, 2, pulse_s)
    doppler = per_trial(_true_doppler(world, radar), 2, pulse_s)
    total = torch.zeros((*placed.closest_m.shape[:-1], pulse_s.numel(), n_fft), dtype=dtype, device=pulse_s.device)
    blocks = list(_target_blocks(placed, pulse_s.numel(), n_fft))
    for targets in blocks:
        since, closest, weight = _seen(placed, targets, world, radar, pulse_s, doppler, velocity)
        lit = (
            slice(None) if len(blocks) == 1 else _lit(weight)
        )  # few targets all count, so that a trial's sum does not depend on its neighbours
        since, closest, weight = (x[..., lit] for x in (since, closest, weight))
        if not since.shape[-1]:
            continue
        range_m = world.path.range_m(since, closest, velocity)
        delay = 2 * (range_m - radar.near_range_m) / radar.wave_speed_m_s
        inside = (delay > -radar.pulse.duration_s) & (delay < n_fft / radar.sampling_hz)
        amplitude = placed.amplitude[..., None, targets][..., lit] * torch.where(inside, weight, 0)
        total = total + echo_spectrum(
            delay,
            2 * radar.carrier_hz / radar.wave_speed_m_s * range_m,
            amplitude,
            n_fft,
            radar.sampling_hz / n_fft,
            dtype,
        )
    return total


def _seen(
    placed: Placed,
    targets: slice,
    world: StripmapWorld,
    radar: StripmapRadar,
    pulse_s: Tensor,
    doppler_hz: Tensor,
    velocity_m_s: Tensor,
) -> list[Tensor]:
    """Time since closest approach, closest range and gain of the beam for targets at pulses, (...,
    pulse, target) each.
    """
    crossing, zero, closest = (
        x[..., None, targets] for x in (placed.crossing_s, placed.zero_doppler_s, placed.closest_m)
    )
    since = pulse_s[:, None] - zero
    offset = (
        2
        * velocity_m_s.square()
        * -since
        / (radar.wavelength_m * torch.sqrt(closest.square() + (velocity_m_s * since).square()))
        - doppler_hz
    )
    return torch.broadcast_tensors(since, closest, world.beam.weight(pulse_s[:, None] - crossing, offset, velocity_m_s))


def _true_doppler(world: StripmapWorld, radar: StripmapRadar) -> Tensor | float:
    return (radar.pointing_doppler_hz or 0.0) if world.doppler_hz is None else world.doppler_hz


def _lit(weight: Tensor) -> Tensor:
    """Indices of the targets that any pulse of any trial sees. weight: (..., pulse, target)."""
    return (weight.detach() != 0).flatten(0, -2).any(0).nonzero()[:, 0]


def _line_length(placed: Placed, radar: StripmapRadar, n_range: int) -> int:
    """FFT length that keeps every echo from wrapping: the line itself where all echoes lie inside
    it, else one pulse longer.
    """
    delay = 2 * (placed.closest_m.detach() - radar.near_range_m) / radar.wave_speed_m_s * radar.sampling_hz
    margin = 256 + radar.pulse_samples
    if float(delay.min()) >= 0 and float(delay.max()) + margin <= n_range:
        return n_range
    need = n_range + radar.pulse_samples
    return next(n for n in range(need, 2 * need) if _smooth(n))


def _smooth(n: int) -> bool:
    for p in (2, 3, 5):
        while n % p == 0:
            n //= p
    return n == 1


def _pulse_blocks(placed: Placed, n_pulse: int, n_fft: int) -> Iterator[slice]:
    """Blocks of pulses, whatever the number of trials: sums then round alike in batches of any
    size.
    """
    height = max(1, min(64, _TABLE_BYTES // (8 * n_fft)))
    for first in range(0, n_pulse, height):
        yield slice(first, min(first + height, n_pulse))


def _target_blocks(placed: Placed, height: int, n_fft: int) -> Iterator[slice]:
    width = max(16, _TABLE_BYTES // (8 * height * 3 * math.isqrt(n_fft)))
    for first in range(0, placed.closest_m.shape[-1], width):
        yield slice(first, min(first + width, placed.closest_m.shape[-1]))


def target_energy(truth: Truth, world: StripmapWorld, radar: StripmapRadar, n_pulse: int) -> Tensor:
    """Energy of each target's raw echo in squared sample amplitudes, (..., target), over the lines
    of the record that see it.

    Over the noise variance (`noise_std` squared) it is q, the peak signal-to-noise ratio after
    two-dimensional compression.
    """
    values = truth.values
    crossing = values["crossing_s"]
    placed = Placed(crossing, values["zero_doppler_s"], values["closest_range_m"], values["amplitude"])
    pulse_s = torch.arange(n_pulse, dtype=torch.float64, device=crossing.device) / radar.prf_hz
    velocity, doppler = (per_trial(values[name], 2, pulse_s) for name in ("velocity_m_s", "doppler_hz"))
    weight = _seen(placed, slice(None), world, radar, pulse_s, doppler, velocity)[2]
    return radar.pulse.duration_s * radar.sampling_hz * values["amplitude"].abs().square() * weight.square().sum(-2)


def lit_power(echo: Tensor) -> Tensor:
    """Mean power of the lit raw samples, (...,): those above 1e-4 of the strongest sample's power
    in their trial.
    """
    power = echo.real.square() + echo.imag.square()
    lit = power > 1e-4 * power.amax((-2, -1), keepdim=True)
    return (power * lit).sum((-2, -1)) / lit.sum((-2, -1)).clamp_min(1)


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
    """A recording of the world and the truth about it, batched over the trials of `draws`.

    Noise follows `world.snr_db`: mean signal power per lit raw sample over noise variance.
    impairments: applied in order, by name. The truth holds target positions (zero-Doppler time,
    closest range), velocity, beam Doppler, noise deviation, what each impairment says under
    "<impairment>.<name>", and the unimpaired recording with the same noise as `clean`. Raises
    ValueError for what no radar can record: a squint beyond 90 degrees, targets behind it, a pulse
    longer than a line.
    """
    velocity = radar.velocity_m_s if world.velocity_m_s is None else world.velocity_m_s
    doppler = _true_doppler(world, radar)
    scatterers = world.scene.scatterers(draws)
    scatterers = Scatterers(*(x.to(device) for x in (scatterers.azimuth_m, scatterers.range_m, scatterers.amplitude)))
    _refuse_impossible(scatterers, radar, n_range, radar.sin_squint(doppler, velocity))
    placed = place(scatterers, radar, n_pulse, n_range, doppler, velocity)
    if bool((placed.closest_m <= 0).any()):
        raise ValueError(
            f"a target lies behind the radar, at a range of {float(placed.closest_m.min()):.4g} "
            "m; range_m counts from the middle of the recorded frame"
        )
    echo = stripmap_echo(placed, world, radar, n_pulse, n_range, dtype)
    std = torch.zeros((), dtype=torch.float64, device=device)
    if world.snr_db is not None:
        std = torch.sqrt(lit_power(echo.detach()).double() / 10 ** (per_trial(world.snr_db, 0, echo) / 10))
        noise = draws.normal("noise", (n_pulse, n_range), dtype, device)
        echo = echo + noise * std.to(echo.real.dtype)[..., None, None]
    trials = () if draws.trials is None else (len(draws.trials),)
    # nothing may differ between trials
    echo = echo.expand(*torch.broadcast_shapes(echo.shape[:-2], trials), -1, -1)
    clean = Recording(Signal(echo, radar.raw_axes(n_pulse, n_range)), radar)
    values = {
        "crossing_s": placed.crossing_s,
        "zero_doppler_s": placed.zero_doppler_s,
        "closest_range_m": placed.closest_m,
        "amplitude": placed.amplitude,
        "velocity_m_s": torch.as_tensor(velocity, dtype=torch.float64),
        "doppler_hz": torch.as_tensor(doppler, dtype=torch.float64),
        "noise_std": std,
    }
    recording, told = apply_impairments(clean, impairments or {}, draws)
    return recording, Truth({**values, **told}, clean)


def _refuse_impossible(scatterers: Scatterers, radar: StripmapRadar, n_range: int, sin_squint: Tensor) -> None:
    if not scatterers.azimuth_m.shape[-1]:
        raise ValueError("the scene holds no scatterer; give it at least one")
    if not bool((sin_squint.abs() < 1).all()):
        worst = float(sin_squint.abs().max())
        raise ValueError(
            f"the Doppler of the beam asks for a squint beyond 90 degrees (sine {worst:.4g}); it "
            "must stay below 2 * velocity / wavelength in magnitude"
        )
    if radar.pulse_samples > n_range:
        raise ValueError(
            f"a line of {n_range} samples does not hold the pulse of {radar.pulse_samples}; "
            "record longer lines or shorten the pulse"
        )


def apply_impairments(
    recording: Recording, impairments: Mapping[str, Impairment], draws: Draws
) -> tuple[Recording, dict[str, Tensor]]:
    """Impairment a recording, simulated or real, in the order of the mapping.

    Returns it with the truth under "<impairment>.<name>".
    """
    if "line_number" not in recording.aux:
        lines = torch.arange(recording.signal.data.shape[-2], device=recording.signal.data.device)
        recording = replace(
            recording, aux={**recording.aux, "line_number": lines.expand(recording.signal.data.shape[:-1])}
        )
    told: dict[str, Tensor] = {}
    for name, impairment in impairments.items():
        recording, values = impairment(recording, draws.part(name))
        told.update({f"{name}.{key}": value for key, value in values.items()})
    return recording, told
