"""The sections of a config for turning targets."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field

from torchsar.study.cases import CasedConfig
from torchsar.study.catalogue import Catalogue, Strict
from torchsar.study.config import Noise
from torchsar.study.registry import FIDELITIES, IMPAIRMENTS, MOTIONS, SCENES, START_PHASES

_IMPAIRMENTS = ("lost_pulses", "white_phase", "phase_walk", "phase_sinusoid", "quantiser")
TARGET_IMPAIRMENTS = Catalogue(
    "impairment of a turning target", "kind", {name: IMPAIRMENTS.entries[name] for name in _IMPAIRMENTS}
)


class Radar(Strict):
    """What the instrument knows about itself; see torchsar.radar.InverseRadar."""

    carrier_hz: float = Field(gt=0)
    bandwidth_hz: float = Field(gt=0)
    prf_hz: float = Field(gt=0)
    rotation_rad_s: float | None = Field(default=None, gt=0)
    pulse_s: float | None = Field(default=None, gt=0)
    reference_range_m: float = Field(default=0.0, ge=0)


class World(Strict):
    """What is true and no processor may see.

    scene, motion, start_phase, fidelity and impairments name entries of the catalogues (`torchsar
    list`).

    trials: scenes and noise draws of each case of a run; a sweep has its own number.
    """

    single: ClassVar[dict[str, Catalogue]] = {"fidelity": FIDELITIES}
    named: ClassVar[dict[str, Catalogue]] = {
        "scene": SCENES,
        "motion": MOTIONS,
        "start_phase": START_PHASES,
        "impairments": TARGET_IMPAIRMENTS,
    }

    pulses: int = Field(gt=0)
    samples: int = Field(gt=0)
    trials: int = Field(default=1, ge=1)
    scene: dict[str, dict[str, Any]] = Field(min_length=1)
    motion: dict[str, dict[str, Any]] = {}
    start_phase: dict[str, dict[str, Any]] = {}
    fidelity: dict[str, Any] = {"kind": "phase_only"}
    rotation_rad_s: float | None = None
    noise: Noise = Noise()
    impairments: dict[str, dict[str, Any]] = {}


class Metrics(Strict):
    """How images are judged. reference: the method whose image of the same scene is the ideal one.

    published: case -> method -> entropy (nats); published_ideal: entropy of the error-free image of
    the source, from which they are counted.
    """

    reference: str | None = None
    published: dict[str, dict[str, float]] = {}
    published_ideal: float | None = None


class Trade(Strict):
    """What `torchsar trade` compares: methods of the processor, iterations of the recommended one,
    precisions; over so many trials, repeated.
    """

    precisions: list[Literal["complex64", "complex128"]] = ["complex64", "complex128"]
    search: list[Annotated[int, Field(ge=0)]] = Field(default=[0, 10, 30, 120], min_length=1)
    polish: list[Annotated[int, Field(ge=0)]] = Field(default=[5, 10, 20], min_length=1)
    trials: int = Field(default=8, ge=1)
    repeats: int = Field(default=3, ge=1)


class IsalConfig(CasedConfig):
    """An experiment with a turning target."""

    recording: ClassVar[str] = "range profile or phase history"

    system: Literal["isal"] = "isal"
    radar: Radar | None = None
    world: World | None = None
    metrics: Metrics = Metrics()
    trade: Trade = Trade()
