"""Random quantities and truth of a ladar simulation, common to sweeps and continuous records."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from torchsar.core import Axis, Draws, Recording, Truth, per_trial
from torchsar.echo.recorded import Impairment, recorded, trials_of
from torchsar.echo.sweep_error import calibration_channel
from torchsar.radar import TriangularLadar
from torchsar.scene import LadarWorld, Motion, Scatterers
from torchsar.scene.motion import Tones, displacement_m, drawn_motion
from torchsar.scene.trials import refuse_other_trials

# Number of interpolation nodes between trigger times. Through 16 Chebyshev nodes, a sinusoid with
# one cycle over their span is exact to 1e-14 of its amplitude.
_NODES = 16


@dataclass(frozen=True)
class LadarCourse:
    """Scatterers, motions and scintillation of a simulation, with all random parts drawn.

    Args:
        scatterers: Scatterers, with amplitude zero outside the range gate, shape (..., target).
        motion: Motions along the line of sight; random ones are already drawn.
        chi: Log-amplitude of the scintillation, None for no scintillation.
        start_s: Start of the first recorded period in seconds.
    """

    scatterers: Scatterers
    motion: list[Motion]
    chi: Tones | None
    start_s: float

    @staticmethod
    def of(
        radar: TriangularLadar, world: LadarWorld, n_period: int, draws: Draws, device: torch.device | str | None
    ) -> LadarCourse:
        """Draw the scatterers, motions and scintillation of a simulation.

        Args:
            radar: Ladar parameters.
            world: Scene, motion, propagation, laser errors and noise.
            n_period: Number of periods.
            draws: Random draws.
            device: Device of the scatterers.

        Returns:
            Scatterers, motions and scintillation.

        Raises:
            TypeError: If radar, world or draws has the wrong type.
            ValueError: If there is no period, no scatterer within the gate, or a parameter per
                trial has another length than the trials.
        """
        if not isinstance(radar, TriangularLadar) or not isinstance(world, LadarWorld) or not isinstance(draws, Draws):
            raise TypeError(
                "a ladar is simulated from a TriangularLadar, a LadarWorld and Draws, got "
                f"{type(radar).__name__}, {type(world).__name__} and {type(draws).__name__}"
            )
        if not (isinstance(n_period, int) and n_period >= 1):
            raise ValueError(f"n_period must be a whole number of 1 or more periods, got {n_period}")
        refuse_other_trials(world, draws)
        s = world.scene.scatterers(draws).to(device)
        axis = radar.sweep_axes(n_period)[1]
        span_s = n_period * axis.step
        chi = None if world.log_amplitude is None else world.log_amplitude.drawn(draws.part("log_amplitude"), span_s)
        return LadarCourse(_gated(s, world.gate_m), drawn_motion(world.motion, draws, span_s), chi, axis.start)

    def moved_m(self, time_s: Tensor) -> Tensor:
        """Return the displacement of the whole scene along the line of sight.

        Args:
            time_s: Slow time in seconds, any shape, float64.

        Returns:
            Displacement in metres, receding positive, shape (*trials, *times).
        """
        return displacement_m(self.motion, time_s - self.start_s)

    def log_amplitude(self, time_s: Tensor) -> Tensor:
        """Return the log-amplitude chi of the scintillation, zero if none is modelled.

        Args:
            time_s: Slow time in seconds, any shape, float64.

        Returns:
            chi, shape (*trials, *times).
        """
        return torch.zeros_like(time_s) if self.chi is None else self.chi.value(time_s - self.start_s)

    def velocity_m_s(self, time_s: Tensor, step_s: float) -> Tensor:
        """Return the radial velocity by central differences of sixth order.

        The relative error is 1e-10 for motions with one cycle in 300 steps.

        Args:
            time_s: Slow time in seconds, any shape, float64.
            step_s: Step of the differences in seconds.

        Returns:
            Velocity in m/s, receding positive, shape (*trials, *times).
        """
        if not self.motion:
            return torch.zeros_like(time_s)
        steps = [self.moved_m(time_s + k * step_s) - self.moved_m(time_s - k * step_s) for k in (1, 2, 3)]
        return (45 * steps[0] - 9 * steps[1] + steps[2]) / (60 * step_s)

    def truths(
        self, radar: TriangularLadar, world: LadarWorld, middle_s: Tensor, later_s: Tensor | None = None
    ) -> dict[str, Tensor]:
        """Return the true values of a recording.

        Where the flight time is modelled, values that depend on time are those at the time of
        reflection, which is earlier than the reception by the reference range over the speed of
        light.

        Args:
            radar: Ladar parameters.
            world: Scene, motion, propagation, laser errors and noise.
            middle_s: Slow times of the sweep middles in seconds, shape (2, pulse).
            later_s: Time in seconds by which all sweeps come later than middle_s, a number or shape
                (...,); None for zero.

        Returns:
            Tensors by name. The radial velocity of the target `velocity_m_s` and its deviation from
            the nominal range `range_error_m` refer to the turning points between up-sweep and
            down-sweep. The same deviation at the middles of the sweeps is `range_error_up_m` and
            `range_error_down_m`. There are also `azimuth_m`, `range_m` and `amplitude` of the
            scatterers, and `noise_std`. If turbulence changes the amplitude of the echo,
            `log_amplitude` is the logarithm of this change at the turning points.
        """
        then = (
            middle_s
            if "flight" in world.fidelity.without
            else middle_s - radar.reference_range_m / radar.wave_speed_m_s
        )
        turning, s = then.mean(-2), self.scatterers
        values = {
            "velocity_m_s": _later(partial(self.velocity_m_s, step_s=radar.sweep_s / 32), turning, later_s),
            "range_error_m": _later(self.moved_m, turning, later_s),
            "range_error_up_m": _later(self.moved_m, then[0], later_s),
            "range_error_down_m": _later(self.moved_m, then[1], later_s),
            "azimuth_m": s.azimuth_m,
            "range_m": s.range_m,
            "amplitude": s.amplitude,
            "noise_std": noise_std(world.snr_db, middle_s),
        }
        return values if self.chi is None else {**values, "log_amplitude": _later(self.log_amplitude, turning, later_s)}


def _later(value: Callable[[Tensor], Tensor], time_s: Tensor, later_s: Tensor | None) -> Tensor:
    """Values (..., n) of a function of slow time at time_s (n,) + later_s (...,).

    If later_s differs between trials, a polynomial through common nodes is evaluated.
    """
    if later_s is None or later_s.ndim == 0:
        return value(time_s if later_s is None else time_s + later_s)
    # if trials have different times, a polynomial through common nodes is evaluated
    nodes = _nodes(later_s)
    known = value(time_s + nodes[:, None])
    gaps = nodes[:, None] - nodes + torch.eye(len(nodes), dtype=torch.float64, device=time_s.device)
    away = (later_s[..., None, None] - nodes).expand(*later_s.shape, len(nodes), len(nodes))
    eye = torch.eye(len(nodes), dtype=torch.bool, device=time_s.device)
    weights = torch.where(eye, 1.0, away / gaps).prod(-1)
    return (known * weights[..., None]).sum(-2)


def _nodes(values: Tensor) -> Tensor:
    """The distinct values themselves, or Chebyshev nodes over their span if there are many."""
    nodes = values.detach().unique()
    if len(nodes) <= _NODES and not values.requires_grad:
        return nodes
    first, last = float(nodes[0]), float(nodes[-1])
    angle = math.pi * (torch.arange(_NODES, dtype=torch.float64, device=values.device) + 0.5) / _NODES
    return (first + last) / 2 + max(last - first, 1e-9) / 2 * torch.cos(angle)


def noise_std(snr_db: Tensor | float | None, like: Tensor) -> Tensor:
    """Return the standard deviation of the complex noise of a sample.

    Args:
        snr_db: Power of a scatterer of amplitude 1 over the noise variance per sample in decibels,
            a number or one value per trial; None for no noise.
        like: Tensor that gives the device.

    Returns:
        10^(-snr_db / 20), or 0 without noise, shape (...,), float64.
    """
    return (
        torch.zeros((), dtype=torch.float64, device=like.device)
        if snr_db is None
        else 10 ** (-per_trial(snr_db, 0, like) / 20)
    )


def _gated(s: Scatterers, gate_m: tuple[Tensor | float, Tensor | float] | None) -> Scatterers:
    """Set the amplitude of scatterers outside the gate to zero."""
    if gate_m is None:
        return s
    low, high = (per_trial(bound, 1, s.range_m) for bound in gate_m)
    inside = (s.range_m >= low) & (s.range_m <= high)
    empty = ~inside.any(-1, keepdim=True)
    if bool(empty.any()):
        low, high = (float(bound.expand(empty.shape)[empty][0]) for bound in (low, high))
        raise ValueError(
            f"no scatterer lies within the gate of {low:g} to {high:g} m, but the scatterers lie "
            f"from {float(s.range_m.min()):g} to {float(s.range_m.max()):g} m; widen gate_m"
        )
    return replace(s, amplitude=s.amplitude * inside)


def calibration_aux(
    radar: TriangularLadar,
    world: LadarWorld,
    n_period: int,
    draws: Draws,
    dtype: torch.dtype,
    device: torch.device | str | None,
) -> dict[str, Tensor]:
    """Return the side data of the calibration fibre.

    Args:
        radar: Ladar parameters.
        world: Scene, motion, propagation, laser errors and noise.
        n_period: Number of periods.
        draws: Random draws.
        dtype: Complex dtype of the channel.
        device: Device of the channel.

    Returns:
        Tensors `calibration` and `calibration_delay_s` by name; an empty dictionary for a world
        without a fibre.
    """
    if world.calibration is None:
        return {}
    channel = calibration_channel(radar, world.calibration, world.sweep_error, n_period, draws, dtype, device)
    return {
        "calibration": channel,
        "calibration_delay_s": torch.as_tensor(world.calibration.delay_s, dtype=torch.float64, device=device),
    }


def hand_over(
    data: Tensor,
    clean: Tensor,
    axes: tuple[Axis, ...],
    radar: TriangularLadar,
    aux: dict[str, Tensor],
    values: dict[str, Tensor],
    impairments: Mapping[str, Impairment] | None,
    draws: Draws,
) -> tuple[Recording, Truth]:
    """Form the recording and its truth, and apply impairments.

    Samples and true values that are equal in all trials are expanded to the trials of the draws.

    Args:
        data: Samples, shape (..., *axes).
        clean: Samples without motion, same shape.
        axes: Axes of the samples.
        radar: Ladar parameters.
        aux: Recorded side data.
        values: True values by name.
        impairments: Impairments by name, applied in order.
        draws: Random draws.

    Returns:
        Recording and truth.
    """
    trials = trials_of(draws, len(axes), data, clean)
    for name in ("velocity_m_s", "range_error_m", "range_error_up_m", "range_error_down_m", "log_amplitude"):
        if name in values:
            values[name] = values[name].expand(*trials, -1)
    return recorded(data, clean, axes, radar, values, impairments, draws, aux, aux, count_lines=bool(impairments))
