"""The sections of a config for azimuth-multichannel bistatic radar."""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, model_validator

from torchsar.radar import LIGHT_M_S
from torchsar.study.cases import LimitedConfig
from torchsar.study.catalogue import Catalogue, Strict
from torchsar.study.registry import GATES, MULTICHANNEL_IMPAIRMENTS, RECEIVE_RANGES, SEAS


class Ephemeris(Strict):
    """Orbit of the transmitter over a turning spherical Earth, and what it looks at; see
    torchsar.radar.Orbit and seen_point. time_s: of slow time zero since the mean anomaly given.
    """

    height_m: float = Field(default=36_500e3, gt=0)
    eccentricity: float = Field(default=0.0, ge=0, le=0.9)
    inclination_deg: float = 60.0
    raan_deg: float = 195.5
    argument_of_perigee_deg: float = 270.0
    mean_anomaly_deg: float = 0.0
    off_nadir_deg: float = 7.0
    squint_deg: float = 0.0
    side: Literal["right", "left"] = "right"
    time_s: float = 0.0
    order: int = Field(default=4, ge=1, le=6)


class Radar(Strict):
    """What the instrument knows about itself; see torchsar.radar.BistaticRadar.

    The range to the transmitter comes from transmit_range, k1, k2, ..., or from an orbit.
    """

    carrier_hz: float = Field(gt=0)
    bandwidth_hz: float = Field(gt=0)
    pulse_s: float = Field(gt=0)
    sampling_hz: float = Field(gt=0)
    prf_hz: float = Field(gt=0)
    speed_m_s: float = Field(gt=0)
    reference_range_m: float = Field(gt=0)
    height_m: float = Field(default=3000.0, ge=0)
    channel_m: list[float] = Field(default=[-0.8, 0.0, 0.8], min_length=1)
    element_m: float = Field(default=0.8, gt=0)
    transmit_range: list[float] = []
    orbit: Ephemeris | None = None
    wave_speed_m_s: float = Field(default=LIGHT_M_S, gt=0)

    @model_validator(mode="after")
    def _one_transmitter(self) -> Radar:
        if self.orbit is not None and self.transmit_range:
            raise ValueError("give one of transmit_range and orbit, and leave the other out")
        return self


class Target(Strict):
    """A point of amplitude 1 in uniform motion.

    u_r_m_s: closing slant-range speed; u_a_m_s: along track, positive with the receiver; azimuth_m:
    place at t = 0; range_m: of its closest range beyond the reference range.
    """

    u_r_m_s: float = 0.0
    u_a_m_s: float = 0.0
    azimuth_m: float = 0.0
    range_m: float = 0.0


class Noise(Strict):
    """Receiver noise; at most one is given.

    snr_db: target over noise in a sample of one channel after range compression; raw_scnr_db: the
    same before it, 10 log10(B tau_p) less; scr_db: target over sea in a sample after range
    compression.
    """

    snr_db: float | None = None
    raw_scnr_db: float | None = None
    scr_db: float | None = None

    @model_validator(mode="after")
    def _one_level(self) -> Noise:
        if sum(level is not None for level in (self.snr_db, self.raw_scnr_db, self.scr_db)) > 1:
            raise ValueError("give at most one of snr_db, raw_scnr_db and scr_db, and leave the others null")
        return self


class World(Strict):
    """What is true and no processor may see.

    Every target is recorded alone, with noise and sea of its own, which follow its name.

    samples: range lines, null for the peak line alone (azimuth only); kind: range-compressed data,
    or full chirps (which need samples of two pulses more). sea_gate: what lights the sea, null for
    the gate of the targets. transmit_range: true k1, k2, ..., null for those of the radar's
    ephemeris. trials: noise draws of each case of a run; a sweep has its own number.
    """

    single: ClassVar[dict[str, Catalogue]] = {"gate": GATES, "sea": SEAS, "sea_gate": GATES, "receive": RECEIVE_RANGES}
    named: ClassVar[dict[str, Catalogue]] = {"impairments": MULTICHANNEL_IMPAIRMENTS}

    pulses: int = Field(gt=0)
    samples: int | None = Field(default=None, gt=0)
    kind: Literal["compressed", "full"] = "compressed"
    trials: int = Field(default=1, ge=1)
    targets: dict[str, Target] = Field(min_length=1)
    gate: dict[str, Any] = {"kind": "band_limited", "duration_s": 4.5}
    sea: dict[str, Any] | None = None
    sea_gate: dict[str, Any] | None = None
    receive: dict[str, Any] = {"kind": "exact"}
    transmit_range: list[float] | None = None
    noise: Noise = Noise()
    impairments: dict[str, dict[str, Any]] = {}

    @model_validator(mode="after")
    def _fits(self) -> World:
        if self.noise.scr_db is not None and self.sea is None:
            raise ValueError("noise.scr_db is the level of targets over a sea; give world.sea, or snr_db")
        if self.sea is not None and self.kind == "full":
            raise ValueError("a sea is added to range-compressed echoes; take kind: compressed")
        if self.samples is None and (self.kind == "full" or any(target.range_m for target in self.targets.values())):
            raise ValueError(
                "azimuth-only data (samples: null) know one range, the radar's reference_range_m; "
                "give samples, or leave range_m and kind: full out"
            )
        return self


class Metrics(Strict):
    """How results are judged. orders: how many pulse rates away replicas are looked for.

    published_targets: metric -> target (case/target) -> method -> figure of the source.
    """

    reference: str | None = None
    orders: int = Field(default=3, ge=1)
    published_targets: dict[str, dict[str, dict[str, float]]] = {}


class Trade(Strict):
    """What `torchsar trade` compares on the first target.

    samples: range lines of the two-dimensional chains; bands: of least squares; transmit_orders,
    receive_orders: of the range series.
    """

    samples: int = Field(default=128, ge=16)
    bands: list[Annotated[int, Field(ge=1)]] = Field(default=[1, 2, 3], min_length=1)
    transmit_orders: list[Annotated[int, Field(ge=0)]] = Field(default=[0, 1, 2, 4], min_length=1)
    receive_orders: list[Annotated[int, Field(ge=2)]] = Field(default=[2, 4], min_length=1)
    precisions: list[Literal["complex64", "complex128"]] = Field(default=["complex64", "complex128"], min_length=1)
    trials: int = Field(default=1, ge=1)
    repeats: int = Field(default=3, ge=1)


class GeoConfig(LimitedConfig):
    """An experiment with moving targets before several channels along track."""

    system: Literal["geo"] = "geo"
    radar: Radar | None = None
    world: World | None = None
    metrics: Metrics = Metrics()
    trade: Trade = Trade()


def compression_gain_db(config: GeoConfig) -> float:
    """10 log10(B tau_p): what range compression adds to a raw SNR."""
    assert config.radar is not None
    return 10 * math.log10(config.radar.bandwidth_hz * config.radar.pulse_s)
