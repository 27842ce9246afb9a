"""The sections of a config for triangular-sweep ladars."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, model_validator

from torchsar.study.cases import LimitedConfig
from torchsar.study.catalogue import Catalogue, Strict
from torchsar.study.config import Noise
from torchsar.study.registry import (
    CALIBRATIONS,
    IMPAIRMENTS,
    LOG_AMPLITUDES,
    RADIAL_MOTIONS,
    SCENES,
    SWEEP_ERRORS,
    SWEEP_FIDELITIES,
)

LADAR_IMPAIRMENTS = Catalogue(
    "impairment of a ladar recording", "kind", {name: IMPAIRMENTS.entries[name] for name in ("quantiser",)}
)


class Radar(Strict):
    """What the instrument knows about itself; see torchsar.radar.TriangularLadar.

    One of wavelength_m and carrier_hz.
    """

    wavelength_m: float | None = Field(default=None, gt=0)
    carrier_hz: float | None = Field(default=None, gt=0)
    bandwidth_hz: float = Field(gt=0)
    period_s: float = Field(gt=0)
    sample_rate_hz: float = Field(gt=0)
    speed_m_s: float = Field(ge=0)
    reference_range_m: float = Field(gt=0)
    beam_rad: float | None = Field(default=None, gt=0)
    keep_every: int = Field(default=1, ge=1)
    detection: Literal["complex", "real"] = "complex"
    dechirp_sign: Literal["lo_conj_echo", "echo_conj_lo"] = "lo_conj_echo"

    @model_validator(mode="after")
    def _one_carrier(self) -> Radar:
        if self.wavelength_m is None and self.carrier_hz is None:
            raise ValueError("neither wavelength_m nor carrier_hz is given; give one of them")
        if self.wavelength_m is not None and self.carrier_hz is not None:
            raise ValueError("wavelength_m and carrier_hz say the same; give one of them, and set the other to null")
        return self


class Record(Strict):
    """A continuous record instead of separated sweeps.

    trigger_s: where in a block an up sweep starts; told: whether the recording says it.

    block_s: length of a block; by default one period where every period is kept, else two.
    """

    trigger_s: float = 0.0
    block_s: float | None = Field(default=None, gt=0)
    told: bool = True


class World(Strict):
    """What is true and no processor may see.

    scene, motion, fidelity, log_amplitude, sweep_error, calibration and impairments name entries of
    catalogues.

    record: None for sweeps that an ideal splitter hands over. trials: scenes and noise draws of
    each case of a run; a sweep has its own number.
    """

    single: ClassVar[dict[str, Catalogue]] = {
        "fidelity": SWEEP_FIDELITIES,
        "log_amplitude": LOG_AMPLITUDES,
        "sweep_error": SWEEP_ERRORS,
        "calibration": CALIBRATIONS,
    }
    named: ClassVar[dict[str, Catalogue]] = {
        "scene": SCENES,
        "motion": RADIAL_MOTIONS,
        "impairments": LADAR_IMPAIRMENTS,
    }

    periods: int = Field(gt=0)
    trials: int = Field(default=1, ge=1)
    scene: dict[str, dict[str, Any]] = Field(min_length=1)
    motion: dict[str, dict[str, Any]] = {}
    log_amplitude: dict[str, Any] | None = None
    fidelity: dict[str, Any] = {"kind": "linear_in_sweep"}
    gate_m: Annotated[list[float], Field(min_length=2, max_length=2)] | None = None
    sweep_error: dict[str, Any] | None = None
    calibration: dict[str, Any] | None = None
    record: Record | None = None
    noise: Noise = Noise()
    impairments: dict[str, dict[str, Any]] = {}


class Metrics(Strict):
    """How results are judged.

    reference: the method whose image of the same scene is the ideal one; target: the point target
    whose response is shown.

    search_m: how far from its predicted place a response is looked for. published: metric -> case
    -> method -> figure of the source.
    """

    reference: str | None = None
    target: str | None = None
    sidelobe_nulls: int = Field(default=10, ge=1)
    search_m: float = Field(default=0.02, gt=0, le=1)
    published: dict[str, dict[str, dict[str, float]]] = {}


class Trade(Strict):
    """What `torchsar trade` compares beside the estimators of the processor and the fidelity
    ladder; over so many trials, repeated.
    """

    precisions: list[Literal["complex64", "complex128"]] = ["complex64", "complex128"]
    tapers: list[Annotated[float, Field(ge=0, le=1)]] = [0.0, 0.5, 1.0]
    paddings: list[Annotated[int, Field(ge=1)]] = [1, 2, 4]
    upsamplings: list[Annotated[int, Field(ge=1)]] = [1, 4, 20]
    trials: int = Field(default=4, ge=1)
    repeats: int = Field(default=3, ge=1)


class SalConfig(LimitedConfig):
    """An experiment with a triangular-sweep ladar; beyond_limits: methods that it shows beyond
    their limits on purpose, of which it only warns.
    """

    recording: ClassVar[str] = "ladar"

    system: Literal["sal"] = "sal"
    radar: Radar | None = None
    world: World | None = None
    metrics: Metrics = Metrics()
    trade: Trade = Trade()
