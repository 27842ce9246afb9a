"""Simulation of inverse synthetic aperture recordings of a rotating target."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from torchsar.core import Axis, Draws, Recording, Truth, gathered_checks, linear_phasor, per_trial, unit_phasor
from torchsar.echo.dechirped import dechirped_echo, fast_time_axis
from torchsar.echo.recorded import Impairment, noise, recorded, trials_of
from torchsar.echo.sums import blocks
from torchsar.radar import InverseRadar
from torchsar.scene import Dechirped, PolynomialRotation, Scatterers, TurntableWorld
from torchsar.scene.motion import displacement_m, start_phase_rad
from torchsar.scene.trials import refuse_other_trials
from torchsar.scene.turntable import Rotation, rotation_angle


def turntable_echo(
    scatterers: Scatterers,
    radar: InverseRadar,
    n_pulse: int,
    n_range: int,
    rotation_rad_s: Rotation,
    dtype: torch.dtype = torch.complex64,
    centre_deviation_m: Tensor | float = 0.0,
) -> Tensor:
    """Return range-compressed pulses of a rotating target without range migration and noise.

    >>> import torch
    >>> from torchsar import echo, radar, scene
    >>> isar = radar.InverseRadar(1e10, 1e9, 500.0)
    >>> range_m = torch.tensor([3 * isar.range_step_m], dtype=torch.float64)
    >>> point = scene.Scatterers(0 * range_m, range_m, torch.ones(1, dtype=torch.complex128))
    >>> echo.turntable_echo(point, isar, 4, 16, 0.1).abs().argmax(-1)  # sample 8 is the middle
    tensor([11, 11, 11, 11])

    In pulse i and at sample n from the middle of the range window,

        s[i, n] = sum_m a_m h(n - y_m / dr)
            exp(-4j pi / lambda (x_m sin theta_i + (y_m + yc) (cos theta_i - 1))),

    with the cross range x_m, range y_m and amplitude a_m of scatterer m, the range step dr and the
    rotation angle theta_i. h is the response of a rectangular band of n_range frequencies, with
    unit peak and periodic in the window. The phase of a_m is that of the echo at theta = 0. For
    each range frequency the sum over scatterers is a matrix product of phasors. Differentiable in
    positions, amplitudes, yc and the parameters of the rotation.

    Args:
        scatterers: Scatterers, shape (..., target).
        radar: Radar parameters.
        n_pulse: Number of pulses.
        n_range: Number of range samples.
        rotation_rad_s: Rotation rate in rad/s of a uniform rotation, a number or one value per
            trial, with the angle zero at pulse n_pulse // 2; or a PolynomialRotation, with the
            angle zero at the first pulse.
        dtype: Complex dtype of the result.
        centre_deviation_m: Distance yc in metres, a number or one value per trial: the centre of
            rotation lies at the range -yc from the middle of the range window.

    Returns:
        Pulses, shape (*trials, pulse, range).

    Raises:
        ValueError: If the rate of a PolynomialRotation falls to zero within the record.

    Reference:
        Ruan et al. 2013, Eqs. (1), (9); Remote Sens. 2025, 17, 3447, Eq. (3), with exact sine and
        cosine.
    """
    x, y, amplitude = torch.broadcast_tensors(*scatterers.tensors)
    lever = y + per_trial(centre_deviation_m, 1, y)
    theta = rotation_angle(radar, n_pulse, rotation_rad_s, x)
    responses = linear_phasor(-y / (n_range * radar.range_step_m), -(n_range // 2), n_range, dtype)
    spectra = responses * amplitude.to(dtype)[..., None]
    parts = []
    for pulses in blocks(n_pulse, 16 * x.shape[-1], most=64):
        angle = theta[..., pulses, None]
        path = x[..., None, :] * torch.sin(angle) - lever[..., None, :] * (2 * torch.sin(angle / 2).square())
        lines = unit_phasor(-2 / radar.wavelength_m * path, dtype) @ spectra
        # Both domains are centred, so that sample n_range // 2 is at range zero. The transform is
        # made in blocks, while the lines are in the cache.
        parts.append(torch.fft.fftshift(torch.fft.ifft(torch.fft.ifftshift(lines, dim=-1)), dim=-1))
    return torch.cat(parts, -2)


@gathered_checks()
def simulate_turntable(
    radar: InverseRadar,
    world: TurntableWorld,
    n_pulse: int,
    n_range: int,
    draws: Draws,
    impairments: Mapping[str, Impairment] | None = None,
    dtype: torch.dtype = torch.complex64,
    device: torch.device | str | None = None,
) -> tuple[Recording, Truth]:
    """Simulate recordings of a rotating target, one per trial of `draws`.

    >>> from torchsar import Draws, echo, radar, scene
    >>> isar = radar.InverseRadar(1e10, 1e9, 500.0, rotation_rad_s=0.1)
    >>> world = scene.TurntableWorld(scene.Points([0.0], [0.0]), motion=[scene.Polynomial([5.0])])
    >>> recording, truth = echo.simulate_turntable(isar, world, 4, 8, Draws(1))
    >>> recording.signal.data.abs().argmax(-1), truth.values["displacement_m"]
    (tensor([4, 4, 4, 4]), tensor([0.0000, 0.0100, 0.0200, 0.0300], dtype=torch.float64))

    `world.fidelity` is the model of the echo. With `PhaseOnly`, the recording before impairments is
    EXACTLY the clean recording, noise included, with each pulse multiplied by exp(j psi), where psi
    is the phase error of the pulse. Circular Gaussian noise keeps its distribution under this
    factor. With `Dechirped`, the noise is added to the echo after its phase errors. The
    signal-to-noise ratio `world.snr_db` is the same before and after range compression.

    Args:
        radar: Radar parameters.
        world: Scene, rotation, motion, start phases, model of the echo and signal-to-noise ratio.
        n_pulse: Number of pulses.
        n_range: Number of range samples, or of samples of a dechirped pulse.
        draws: Random draws.
        impairments: Impairments by name, applied in order.
        dtype: Complex dtype of the recording.
        device: Device of the recording.

    Returns:
        The recording and the truth. With `PhaseOnly` the recording is range-compressed, shape (...,
        pulse, range). With `Dechirped` it is raw, shape (..., pulse, fast_time), and its side data
        `aux` hold `reference_m`, the displacement of the reference, shape (..., pulse).

        The values of the truth are:

        - `phase_rad`, shape (..., pulse): the phase error psi = delta - 4 pi d / lambda, with the
          start phase delta and the displacement d relative to the reference at the middle of the
          pulse;
        - `displacement_m`, shape (..., pulse): the whole displacement of the target;
        - `noise_std`, shape (...,) or (): the standard deviation of the complex noise of a sample;
        - `cross_range_m`, `range_m` and `amplitude` of the scatterers, shape (..., target);
        - `rotation_rad_s`, shape (...,) or (): the rate of a uniform rotation, or the mean rate of
          a polynomial rotation over the record;
        - with a polynomial rotation only: its rate `omega_rad_s` at the first pulse and the centre
          deviation `yc_m`, shape (...,); its coefficients `warp_k`, shape (..., order - 1);
        - the true values of each impairment, as "<impairment>.<name>".

        The recording `clean` of the truth has the same noise, but no motion, start phases or
        impairments.

    Raises:
        ValueError: If the target leaves the range window, the scene is empty, there is no rotation
            rate, the rate falls to zero, the length of a dechirped pulse is not known, or a
            parameter given per trial has another length than the number of trials.
    """
    refuse_other_trials(world, draws)
    course = _Course.of(radar, world, n_pulse, n_range, draws, device)
    record = _dechirped if isinstance(world.fidelity, Dechirped) else _phase_only
    clean, data, std, axes, aux = record(radar, world, course, n_range, draws, dtype)
    trials = trials_of(draws, 2, data)
    values = {
        "phase_rad": course.psi_rad(radar).expand(*trials, -1),
        "displacement_m": course.moved_m.expand(*trials, -1),
        "noise_std": std,
        "cross_range_m": course.scatterers.azimuth_m,
        "range_m": course.scatterers.range_m,
        "amplitude": course.scatterers.amplitude,
        **_rotation_truth(course.rotation, world.centre_deviation_m, n_pulse / radar.prf_hz, data.device, trials),
    }
    aux = {name: v.expand(*trials, -1) for name, v in aux.items()}
    return recorded(data, clean, axes, radar, values, impairments, draws, aux)


def _rotation_truth(
    rotation: Rotation, yc_m: Tensor | float, duration_s: float, device: torch.device, trials: tuple[int, ...]
) -> dict[str, Tensor]:
    """True values of the rotation by name."""
    if not isinstance(rotation, PolynomialRotation):
        return {"rotation_rad_s": torch.as_tensor(rotation, dtype=torch.float64)}
    like = torch.zeros((), dtype=torch.float64, device=device)
    k = rotation.warp_k(like)
    scalars = {
        "rotation_rad_s": rotation.mean_rate(duration_s, like),
        "omega_rad_s": rotation.omega(like),
        "yc_m": per_trial(yc_m, 0, like),
    }
    return {**{name: value.expand(trials) for name, value in scalars.items()}, "warp_k": k.expand(*trials, k.shape[-1])}


@dataclass(frozen=True)
class _Course:
    """Scatterers, rotation, displacements and start phases of a simulation."""

    scatterers: Scatterers
    rotation: Rotation
    moved_m: Tensor
    reference_m: Tensor
    start_rad: Tensor

    @staticmethod
    def of(
        radar: InverseRadar,
        world: TurntableWorld,
        n_pulse: int,
        n_range: int,
        draws: Draws,
        device: torch.device | str | None,
    ) -> _Course:
        """Draw the target and its motion. Raises ValueError for impossible ones."""
        choices = (world.rotation, world.rotation_rad_s, radar.rotation_rad_s)
        rotation = next((choice for choice in choices if choice is not None), None)
        if rotation is None:
            raise ValueError(
                "neither radar.rotation_rad_s nor world.rotation_rad_s is set; the world needs a "
                "rotation rate, 0 for none"
            )
        if n_pulse < 1 or n_range < 1:
            raise ValueError(
                f"a recording needs at least one pulse of one sample, got n_pulse={n_pulse}, n_range={n_range}"
            )
        scatterers = world.scene.scatterers(draws).to(device)
        time_s = torch.arange(n_pulse, dtype=torch.float64, device=device) / radar.prf_hz
        moved, followed = displacement_m(world.motion, time_s), torch.zeros_like(time_s)
        if isinstance(world.fidelity, Dechirped):
            followed = displacement_m(world.fidelity.track, time_s)
            _refuse_outside(scatterers, moved - followed, radar, n_range)
        else:
            _refuse_outside(scatterers, followed, radar, n_range)
        start_rad = start_phase_rad(world.start_phase, draws, n_pulse).to(device)
        return _Course(scatterers, rotation, moved, followed, start_rad)

    def psi_rad(self, radar: InverseRadar) -> Tensor:
        """Total phase error of each pulse, (*trials, pulse)."""
        return self.start_rad - 4 * math.pi / radar.wavelength_m * (self.moved_m - self.reference_m)


_Simulated = tuple[Tensor, Tensor, Tensor, tuple[Axis, ...], dict[str, Tensor]]


def _phase_only(
    radar: InverseRadar, world: TurntableWorld, course: _Course, n_range: int, draws: Draws, dtype: torch.dtype
) -> _Simulated:
    """Simulate with `PhaseOnly`. Returns clean and recorded samples, noise standard deviation, axes
    and side data.
    """
    n_pulse = course.moved_m.shape[-1]
    still = turntable_echo(course.scatterers, radar, n_pulse, n_range, course.rotation, dtype, world.centre_deviation_m)
    added, std = _noise(still, world.snr_db, draws)
    clean = still + added
    return clean, _turned(clean, course.psi_rad(radar)), std, radar.raw_axes(n_pulse, n_range), {}


def _dechirped(
    radar: InverseRadar, world: TurntableWorld, course: _Course, n_fast: int, draws: Draws, dtype: torch.dtype
) -> _Simulated:
    """Simulate with `Dechirped`, in which the noise of the receiver has no phase error.

    Returns the same five results as `_phase_only`.
    """
    n_pulse, track = course.moved_m.shape[-1], world.fidelity.track if isinstance(world.fidelity, Dechirped) else ()
    turned = partial(
        dechirped_echo,
        course.scatterers,
        radar,
        n_pulse,
        n_fast,
        course.rotation,
        dtype=dtype,
        centre_deviation_m=world.centre_deviation_m,
    )
    still = turned()
    moving = turned(world.motion, track) if world.motion or track else still
    added, std = _noise(still, world.snr_db, draws)
    axes = (radar.raw_axes(n_pulse, n_fast)[0], fast_time_axis(radar, n_fast))
    return still + added, _turned(moving, course.start_rad) + added, std, axes, {"reference_m": course.reference_m}


def _turned(pulses: Tensor, phase_rad: Tensor) -> Tensor:
    """Multiply pulses by exp(j phase)."""
    return pulses * unit_phasor(phase_rad / (2 * math.pi), pulses.dtype)[..., None]


def _noise(echo: Tensor, snr_db: Tensor | float | None, draws: Draws) -> tuple[Tensor | float, Tensor]:
    """Draw circular Gaussian noise for an echo. Returns the noise and its standard deviation
    (...,).
    """
    if snr_db is None:
        return 0.0, torch.zeros((), dtype=torch.float64, device=echo.device)
    power = torch.view_as_real(echo).double().square().sum(-1).mean((-2, -1))
    std = torch.sqrt(power / 10 ** (per_trial(snr_db, 0, echo) / 10))
    return noise(draws, "noise", echo.shape[-2:], std, echo.dtype, echo.device), std


def _refuse_outside(scatterers: Scatterers, off_m: Tensor, radar: InverseRadar, n_range: int) -> None:
    """Raise ValueError if the target leaves the range window. off_m: displacement, (*trials,
    pulse).
    """
    y, off = scatterers.range_m.detach(), off_m.detach()
    nearest, farthest = float((y.amin(-1) + off.amin(-1)).min()), float((y.amax(-1) + off.amax(-1)).max())
    low, high = ((edge - n_range // 2 - 0.5) * radar.range_step_m for edge in (0, n_range))
    if not (low <= nearest and farthest <= high):
        raise ValueError(
            f"the target must stay within the range window of {low:.6g} to {high:.6g} m, but reaches from "
            f"{nearest:.6g} to {farthest:.6g} m; choose a smaller target or more range samples, or let the window "
            "follow the target by the track of Dechirped (in a config, track_m of the fidelity dechirped)"
        )
