"""What happens while a ladar records a world: everything that is drawn, the truth about it, and how
recordings are handed over.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from torchsar.core import Axis, Draws, Recording, Signal, Truth, per_trial
from torchsar.echo.stripmap import Impairment, apply_impairments
from torchsar.echo.sweep_error import calibration_channel
from torchsar.radar import TriangularLadar
from torchsar.scene import LadarWorld, Motion, Scatterers, Tones, displacement_m, drawn_motion


@dataclass(frozen=True)
class LadarCourse:
    """What happens while a world is recorded: the scatterers within the gate, the motions, the
    scintillation (None for none).
    """

    scatterers: Scatterers
    motion: list[Motion]
    chi: Tones | None
    start_s: float

    @staticmethod
    def of(
        radar: TriangularLadar, world: LadarWorld, n_period: int, draws: Draws, device: torch.device | str | None
    ) -> LadarCourse:
        """Everything drawn. Raises ValueError for no period, or no scatterer within the gate."""
        if not isinstance(radar, TriangularLadar) or not isinstance(world, LadarWorld) or not isinstance(draws, Draws):
            raise TypeError(
                "a ladar is simulated from a TriangularLadar, a LadarWorld and Draws, got "
                f"{type(radar).__name__}, {type(world).__name__} and {type(draws).__name__}"
            )
        if not (isinstance(n_period, int) and n_period >= 1):
            raise ValueError(f"a recording needs at least one period, a whole number of them, got n_period={n_period}")
        refuse_trials("snr_db", world.snr_db, draws)
        drawn = world.scene.scatterers(draws)
        s = Scatterers(*(v.to(device) for v in (drawn.azimuth_m, drawn.range_m, drawn.amplitude)))
        axis = radar.sweep_axes(n_period)[1]
        span_s = n_period * axis.step
        chi = None if world.log_amplitude is None else world.log_amplitude.drawn(draws.part("log_amplitude"), span_s)
        return LadarCourse(_gated(s, world.gate_m), drawn_motion(world.motion, draws, span_s), chi, axis.start)

    def moved_m(self, time_s: Tensor) -> Tensor:
        """Displacement at slow times of any shape, (*trials, *times)."""
        return displacement_m(self.motion, time_s - self.start_s)

    def log_amplitude(self, time_s: Tensor) -> Tensor:
        """chi at slow times, (*trials, *times); zeros where it is not modelled."""
        return torch.zeros_like(time_s) if self.chi is None else self.chi.value(time_s - self.start_s)

    def velocity_m_s(self, time_s: Tensor, step_s: float) -> Tensor:
        """Slope of the displacement at slow times, (*trials, *times), by central differences of
        sixth order: 1e-10 where motions turn once in 300 steps.
        """
        if not self.motion:
            return torch.zeros_like(time_s)
        steps = [self.moved_m(time_s + k * step_s) - self.moved_m(time_s - k * step_s) for k in (1, 2, 3)]
        return (45 * steps[0] - 9 * steps[1] + steps[2]) / (60 * step_s)

    def truths(
        self, radar: TriangularLadar, world: LadarWorld, middle_s: Tensor, later_s: Tensor | None = None
    ) -> dict[str, Tensor]:
        """Named truths of a recording whose sweeps have their middles at middle_s (2, pulse) +
        later_s (...,); with the flight time, at the reflection.
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
    """A function of slow time (n,) at times later by later_s (...,), (..., n): where trials differ,
    by a polynomial through eight times that all share.
    """
    if later_s is None or later_s.ndim == 0:
        return value(time_s if later_s is None else time_s + later_s)
    first, last = float(later_s.min()), float(later_s.max())
    nodes = torch.linspace(first, max(last, first + 1e-9), 8, dtype=torch.float64, device=time_s.device)
    known = value(time_s + nodes[:, None])
    gaps = nodes[:, None] - nodes + torch.eye(8, dtype=torch.float64, device=time_s.device)
    away = (later_s[..., None, None] - nodes).expand(*later_s.shape, 8, 8)
    eye = torch.eye(8, dtype=torch.bool, device=time_s.device)
    weights = torch.where(eye, 1.0, away / gaps).prod(-1)
    return (known * weights[..., None]).sum(-2)


def noise_std(snr_db: Tensor | float | None, like: Tensor) -> Tensor:
    """Deviation of the complex noise of a sample, (...,): 10^(-snr / 20)."""
    return (
        torch.zeros((), dtype=torch.float64, device=like.device)
        if snr_db is None
        else 10 ** (-per_trial(snr_db, 0, like) / 20)
    )


def refuse_trials(name: str, value: Tensor | float | None, draws: Draws) -> None:
    """Raise ValueError for a per-trial tensor of another number of trials than the draws have."""
    if (
        isinstance(value, Tensor)
        and value.ndim
        and draws.trials is not None
        and value.shape[-1] not in (1, len(draws.trials))
    ):
        raise ValueError(
            f"{name} must be a number or one for each of the {len(draws.trials)} trials of the "
            f"draws, got shape {tuple(value.shape)}"
        )


def _gated(s: Scatterers, gate_m: tuple[float, float] | None) -> Scatterers:
    if not s.range_m.shape[-1]:
        raise ValueError("the scene holds no scatterer; give it at least one")
    if gate_m is None:
        return s
    inside = (s.range_m >= gate_m[0]) & (s.range_m <= gate_m[1])
    if not bool(inside.any(-1).all()):
        raise ValueError(
            f"no scatterer lies within the gate of {gate_m[0]:g} to {gate_m[1]:g} m; they lie "
            f"from {float(s.range_m.min()):g} to {float(s.range_m.max()):g} m: widen gate_m"
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
    """Side data of the calibration fibre, nothing where there is none."""
    if world.calibration is None:
        return {}
    channel = calibration_channel(radar, world.calibration, world.sweep_error, n_period, draws, dtype, device)
    return {
        "calibration": channel,
        "calibration_delay_s": torch.tensor(world.calibration.delay_s, dtype=torch.float64, device=device),
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
    """Recording and truth with the trial dims of `draws`, the recording impaired."""
    tail = len(axes)
    trials = torch.broadcast_shapes(
        data.shape[:-tail], clean.shape[:-tail], () if draws.trials is None else (len(draws.trials),)
    )
    data, clean = (v.expand(*trials, *v.shape[v.ndim - tail :]) for v in (data, clean))
    for name in ("velocity_m_s", "range_error_m", "range_error_up_m", "range_error_down_m", "log_amplitude"):
        if name in values:
            values[name] = values[name].expand(*trials, -1)
    recording = Recording(Signal(data, axes), radar, aux)
    told: dict[str, Tensor] = {}
    if impairments:
        recording, told = apply_impairments(recording, impairments, draws)
    return recording, Truth({**values, **told}, Recording(Signal(clean, axes), radar, aux))
