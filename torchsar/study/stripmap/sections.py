"""The sections of a stripmap config."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

from pydantic import Field, model_validator

from torchsar.study.catalogue import Catalogue, Strict
from torchsar.study.config import Config, Noise
from torchsar.study.registry import BEAMS, IMPAIRMENTS, PATHS, SCENES


class Pulse(Strict):
    """Linear frequency-modulated pulse."""

    bandwidth_hz: float = Field(gt=0)
    duration_s: float = Field(gt=0)
    direction: Literal[1, -1] = 1


class Radar(Strict):
    """What the instrument knows about itself; see torchsar.radar.StripmapRadar."""

    carrier_hz: float = Field(gt=0)
    pulse: Pulse
    sampling_hz: float = Field(gt=0)
    prf_hz: float = Field(gt=0)
    velocity_m_s: float = Field(gt=0)
    near_range_m: float = Field(gt=0)
    pointing_doppler_hz: float | None = None
    integration_s: float | None = Field(default=None, gt=0)


class World(Strict):
    """What is true and no processor may see.

    scene, beam, path and impairments name entries of the catalogues (`torchsar list`).
    """

    single: ClassVar[dict[str, Catalogue]] = {"beam": BEAMS, "path": PATHS}
    named: ClassVar[dict[str, Catalogue]] = {"scene": SCENES, "impairments": IMPAIRMENTS}

    lines: int = Field(gt=1)
    samples: int = Field(gt=1)
    scene: dict[str, dict[str, Any]] = Field(min_length=1)
    beam: dict[str, Any] = {"kind": "always_lit"}
    path: dict[str, Any] = {"kind": "hyperbola"}
    velocity_m_s: float | None = Field(default=None, gt=0)
    doppler_hz: float | None = None
    squint_deg: float | None = Field(default=None, gt=-90, lt=90)
    noise: Noise = Noise()
    impairments: dict[str, dict[str, Any]] = {}

    @model_validator(mode="after")
    def _one_direction(self) -> World:
        if self.doppler_hz is not None and self.squint_deg is not None:
            raise ValueError("doppler_hz and squint_deg both say where the beam looks; give one of them")
        return self


class Margin(Strict):
    """Lines and samples at the edges of the image that the metrics leave out."""

    first_lines: int = Field(default=0, ge=0)
    last_lines: int = Field(default=0, ge=0)
    first_samples: int = Field(default=0, ge=0)
    last_samples: int = Field(default=0, ge=0)


class Metrics(Strict):
    """How images are judged.

    margin: None leaves out lines without a full aperture and samples without a full pulse.
    """

    margin: Margin | None = None
    reference: str | None = None
    sidelobe_nulls: int = Field(default=10, ge=1)
    found_within_m: float = Field(default=10.0, gt=0)
    found_above_db: float = -6.0
    published: dict[str, float | str] = {}


class Trade(Strict):
    """What `torchsar trade` compares: focusers, precisions, jitter correctors."""

    focusers: list[str] = ["range_doppler", "omega_k", "omega_k_stolt"]
    precisions: list[Literal["complex64", "complex128"]] = ["complex64", "complex128"]
    repeats: int = Field(default=3, ge=1)


class StripmapConfig(Config):
    """An experiment with a side-looking radar on a straight path."""

    recording: ClassVar[str] = "raw stripmap"

    system: Literal["stripmap"] = "stripmap"
    radar: Radar | None = None
    world: World | None = None
    metrics: Metrics = Metrics()
    trade: Trade = Trade()
