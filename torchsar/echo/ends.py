"""Stages with which a chain begins: the simulation of a recording, and its impairments."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn

from torchsar.core import Draws, Recording, Truth
from torchsar.echo.bistatic import simulate_bistatic
from torchsar.echo.ladar import simulate_ladar
from torchsar.echo.path import simulate_path
from torchsar.echo.recorded import Impairment, numbered
from torchsar.echo.strip import simulate
from torchsar.echo.turntable import simulate_turntable
from torchsar.scene import BistaticWorld, LadarWorld, PathWorld, StripmapWorld, TurntableWorld

Simulation = Callable[..., tuple[Recording, Truth]]
# function that simulates a world, by the class of its description
_OF_WORLD: Mapping[type, Simulation] = {
    StripmapWorld: simulate,
    PathWorld: simulate_path,
    TurntableWorld: simulate_turntable,
    BistaticWorld: simulate_bistatic,
    LadarWorld: simulate_ladar,
}


def _connects(described: Any) -> list[inspect.Parameter]:
    """Values by which a description can be changed: its fields, or the parameters of a function
    that makes it.
    """
    if not is_dataclass(described):
        return list(inspect.signature(described).parameters.values())
    return [inspect.Parameter(one.name, inspect.Parameter.KEYWORD_ONLY, default=None) for one in fields(described)]


class Simulate(nn.Module):
    """Stage that begins a chain: it simulates the recording from random draws.

    >>> import torch
    >>> from torchsar import Chain, Draws, echo, focus, metrics, radar, scene, use
    >>> isar = radar.InverseRadar(1e10, 1e9, 500.0, rotation_rad_s=0.1)
    >>> world = scene.TurntableWorld(scene.Points([0.0, 4.0], [0.0, 1.0]), snr_db=20.0)
    >>> chain = Chain(
    ...     echo=use(echo.Simulate(isar, world, n_pulse=32, n_range=32), snr_db="given.snr_db"),
    ...     image=focus.AzimuthTransform(isar),
    ...     entropy=metrics.Measure(metrics.entropy),
    ... )
    >>> levels = torch.tensor([0.0, 20.0, 40.0], dtype=torch.float64)
    >>> trace = chain.trace(draws=Draws(1, trials=range(3)), given={"given.snr_db": levels})
    >>> trace.metrics["entropy"].round(decimals=1)
    tensor([4.8000, 1.9000, 1.8000])

    It is called with None, as there is no recording before it, and the draws. The fields of the
    world can be connected to values by `use`, such as an SNR or a velocity per trial. Where a value
    is deeper in the world, give a function that makes the world: its parameters can be connected.

    Args:
        radar: Radar parameters.
        world: Description of the world, such as a StripmapWorld, or a function that returns it.
        n_pulse: Number of pulses, or of periods of a ladar.
        n_range: Number of range samples, where the simulation has it.
        by: Function that simulates, such as `simulate_ladar_record`; None for that of the kind of
            the world.
        dtype: Complex dtype of the recording.
        **options: Further arguments of this function, such as `kind` of `simulate_bistatic`.
    """

    on_recording = True

    def __init__(
        self,
        radar: Any,
        world: Any,
        n_pulse: int,
        n_range: int | None = None,
        by: Simulation | None = None,
        dtype: torch.dtype = torch.complex64,
        **options: Any,
    ) -> None:
        super().__init__()
        if not callable(world) and by is None and type(world) not in _OF_WORLD:
            raise TypeError(
                f"Simulate knows the worlds {', '.join(kind.__name__ for kind in _OF_WORLD)}, got "
                f"{type(world).__name__}; give the function that simulates it: by=..."
            )
        self.radar, self.world, self.size = radar, world, (n_pulse, n_range)
        self.by, self.options = by, {"dtype": dtype, **options}
        self.connects = _connects(world)
        # an empty buffer, which moves with the chain and thus has its device
        self.register_buffer("place", torch.empty(0), persistent=False)

    def extra_repr(self) -> str:
        name = getattr(self.world, "__name__", type(self.world).__name__)
        return "" if name == "<lambda>" else name

    def forward(self, recording: Recording | None, draws: Draws, **values: Tensor) -> tuple[Recording, Truth]:
        """Simulate one recording per trial of the draws.

        Args:
            recording: None.
            draws: Random draws.
            **values: Fields of the world, or arguments of the function that makes it.

        Returns:
            The recording and the truth.

        Raises:
            TypeError: If there is a recording already.
            ValueError: If the world cannot be simulated, see the function that simulates it.
        """
        if recording is not None:
            raise TypeError("a simulation begins a chain; call the chain with draws=... alone, without a recording")
        changed = self.world(**values) if callable(self.world) else replace(self.world, **values)
        by: Any = _OF_WORLD[type(changed)] if self.by is None else self.by
        n_pulse, n_range = self.size
        size = (n_pulse, n_range) if "n_range" in inspect.signature(by).parameters else (n_pulse,)
        return by(self.radar, changed, *size, draws=draws, device=self.place.device, **self.options)


class Impair(nn.Module):
    """Stage that applies an impairment to the recording at its place in a chain.

    >>> import torch
    >>> from torchsar import Chain, Draws, Recording, compensate, echo, metrics, radar, use
    >>> isar = radar.InverseRadar(1e10, 1e9, 500.0)
    >>> pulses = Recording.from_arrays(torch.ones(8, 8) + 0j, isar)
    >>> chain = Chain(
    ...     shaken=echo.Impair(echo.WhitePhase()),
    ...     phase=compensate.Sca(assess=False),
    ...     rms_rad=use(
    ...         metrics.Measure(metrics.phase_rmse),
    ...         estimate_rad="phase.phase_rad",
    ...         reference_rad="truth.shaken.phase_rad",
    ...     ),
    ... )
    >>> bool(chain.trace(pulses, draws=Draws(1)).metrics["rms_rad"] < 1e-6)
    True

    In a chain it draws and names its true values as `apply_impairments` does under the name of the
    stage: here `truth.shaken.phase_rad`. Fields of the impairment can be connected to values by
    `use`.

    Args:
        impairment: Impairment, such as LostLines or PathError.
    """

    on_recording = True

    def __init__(self, impairment: Impairment) -> None:
        super().__init__()
        self.impairment = impairment
        self.connects = _connects(impairment) if is_dataclass(impairment) else []

    def extra_repr(self) -> str:
        return type(self.impairment).__name__

    def forward(self, recording: Recording, draws: Draws, **values: Tensor) -> tuple[Recording, Truth]:
        """Impair a recording.

        Args:
            recording: Recording.
            draws: Random draws of this impairment.
            **values: Fields of the impairment.

        Returns:
            The impaired recording, and the true values of the impairment.

        Raises:
            TypeError: If there is no recording.
        """
        if not isinstance(recording, Recording):
            raise TypeError(f"Impair needs a Recording, got {type(recording).__name__}; begin with echo.Simulate")
        impairment: Any = replace(self.impairment, **values) if values else self.impairment  # pyright: ignore
        impaired, truth = impairment(numbered(recording), draws)
        return impaired, Truth(dict(truth))
