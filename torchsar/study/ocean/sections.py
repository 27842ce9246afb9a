"""The sections of a config for ships on a sea before several channels."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field

from torchsar.study.cases import LimitedConfig
from torchsar.study.catalogue import Catalogue, Strict
from torchsar.study.geo.sections import Radar
from torchsar.study.registry import GATES, SEAS


class Vessel(Strict):
    """A ship of random scatterers; see torchsar.scene.Ship.

    u_r_m_s: closing; u_a_m_s: along track, with the receiver; azimuth_m, range_m: its middle at t =
    0, range beyond the reference range.

    scr_db: mean power of a sample of one of its lines over that of the sea.
    """

    u_r_m_s: float = 0.0
    u_a_m_s: float = 0.0
    azimuth_m: float = 0.0
    range_m: float = 0.0
    scr_db: float = 10.0
    length_m: float = Field(default=100.0, ge=0)
    range_cells: int = Field(default=4, ge=1)
    count: int = Field(default=15, ge=1)
    cell_m: float = Field(default=6.0, gt=0)


class World(Strict):
    """What is true and no processor may see: all ships in one scene.

    The gate lights ships and sea; the sea's cnr_db is its power over the noise. trials: scenes
    drawn for each case of a run.
    """

    single: ClassVar[dict[str, Catalogue]] = {"gate": GATES, "sea": SEAS}
    named: ClassVar[dict[str, Catalogue]] = {}

    pulses: int = Field(gt=0)
    samples: int = Field(gt=0)
    trials: int = Field(default=1, ge=1)
    targets: dict[str, Vessel] = Field(min_length=1)
    gate: dict[str, Any] = {"kind": "band_limited", "duration_s": 4.5}
    sea: dict[str, Any] = {"kind": "k_sea"}


class Metrics(Strict):
    """How results are judged.

    match_m: how far, along track and in range, what was found may appear from where a ship appears.
    published_targets: metric -> ship -> method -> figure of the source.
    """

    reference: str | None = None
    match_m: tuple[float, float] = (150.0, 40.0)
    published_targets: dict[str, dict[str, dict[str, float]]] = {}


class Trade(Strict):
    """What `torchsar trade` compares on the recommended flow.

    segments_s: of slow time; half_ranges_m: of the lines of a body; precisions: of samples.
    """

    segments_s: list[Annotated[float, Field(gt=0)]] = Field(default=[0.3, 0.6, 1.2], min_length=1)
    half_ranges_m: list[Annotated[float, Field(gt=0)]] = Field(default=[30.0, 60.0], min_length=1)
    precisions: list[Literal["complex64", "complex128"]] = Field(default=["complex64", "complex128"], min_length=1)
    repeats: int = Field(default=1, ge=1)


class OceanConfig(LimitedConfig):
    """An experiment with ships on a sea."""

    system: Literal["geo_ocean"] = "geo_ocean"
    radar: Radar | None = None
    world: World | None = None
    metrics: Metrics = Metrics()
    trade: Trade = Trade()
