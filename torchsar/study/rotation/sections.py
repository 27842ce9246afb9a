"""The sections of a config for targets that turn unevenly."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from torchsar.study.cases import LimitedConfig
from torchsar.study.catalogue import Strict
from torchsar.study.isal import sections


class Radar(sections.Radar):
    """What the instrument knows about itself; see torchsar.radar.InverseRadar.

    One of wavelength_m and carrier_hz.
    """

    wavelength_m: float | None = Field(default=None, gt=0)
    carrier_hz: float | None = Field(default=None, gt=0)

    @model_validator(mode="after")
    def _one_carrier(self) -> Radar:
        if (self.wavelength_m is None) == (self.carrier_hz is None):
            raise ValueError("give one of wavelength_m and carrier_hz, and leave the other null")
        return self


class Rotation(Strict):
    """theta(t) = omega_rad_s (t + k1 t^2 / 2! + k2 t^3 / 3!

    + ...), t = 0 at the first pulse; k = [k1, k2, ...], true derivatives of the rate over the rate.
    """

    omega_rad_s: float = Field(gt=0)
    k: list[float] = []


class World(sections.World):
    """What is true and no processor may see.

    rotation: of the target; centre_deviation_m: yc, how much farther from the rotation centre
    scatterers are than the range axis says.

    scene_seed: None for scenes that follow `seed` and differ from trial to trial; a number for ONE
    scene, that of this seed, in all trials, which then differ in noise alone. An even rotation is
    one without k; the rotation_rad_s of other turning targets stays null.
    """

    rotation: Rotation
    centre_deviation_m: float = 0.0
    scene_seed: int | None = Field(default=None, ge=0)
    rotation_rad_s: None = None


class Metrics(Strict):
    """How results are judged. reference: the method whose image of the same scene is the ideal one.

    search_m: how far along cross range from its place the response of a point target is looked for.
    published: metric -> case -> method -> figure of the source; published_targets: metric -> target
    -> method -> the same of point targets.
    """

    reference: str | None = None
    search_m: float = Field(default=0.1, gt=0)
    published: dict[str, dict[str, dict[str, float]]] = {}
    published_targets: dict[str, dict[str, dict[str, float]]] = {}


class Trade(Strict):
    """What `torchsar trade` compares, over so many trials, repeated.

    orders: of the warp. taps, kernel_oversamplings: of the gridding. scatterers, rounds: what the
    recommended estimator may spend; population, generations: of the genetic search. lines: of the
    images on which the gridding is judged, None for twice the pulses.
    """

    orders: list[Annotated[int, Field(ge=1)]] = Field(default=[1, 2, 3, 4], min_length=1)
    taps: list[Annotated[int, Field(ge=2, le=16)]] = Field(default=[2, 3, 4, 5, 6, 7, 8], min_length=1)
    kernel_oversamplings: list[Annotated[float, Field(gt=1)]] = Field(default=[1.25, 2.0], min_length=1)
    precisions: list[Literal["complex64", "complex128"]] = Field(default=["complex64", "complex128"], min_length=1)
    scatterers: list[Annotated[int, Field(ge=3)]] = [10, 30, 100]
    rounds: list[Annotated[int, Field(ge=1)]] = [1, 2]
    population: int = Field(default=10, ge=4)
    generations: int = Field(default=4, ge=1)
    box: float = Field(default=0.1, gt=0, lt=1)
    lines: int | None = Field(default=None, ge=8)
    trials: int = Field(default=1, ge=1)
    repeats: int = Field(default=1, ge=1)


class RotationConfig(LimitedConfig):
    """An experiment with a target that turns unevenly; beyond_limits: methods that it shows beyond
    their limits on purpose, of which it only warns.
    """

    system: Literal["isal_rotation"] = "isal_rotation"
    radar: Radar | None = None
    world: World | None = None
    metrics: Metrics = Metrics()
    trade: Trade = Trade()
