"""The systems that a config may choose by its key `system`, and what each brings: sections,
experiments, trials, tables.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Protocol

from torchsar.core import Draws
from torchsar.study.config import Config, Loaded
from torchsar.study.settings.errors import ConfigError, did_you_mean


class Trials(Protocol):
    """One batch of Monte Carlo trials of a config, as `torchsar.study.sweep` takes it, and what is
    asked of it before.
    """

    @property
    def batched(self) -> Collection[str]: ...

    def __call__(self, parameters: Mapping[str, Any], draws: Draws) -> dict[str, Any]: ...

    def bytes_per_trial(self, fixed: Mapping[str, Any]) -> int: ...

    def check(self, grid: Mapping[str, Any]) -> None: ...

    def stages(self, fixed: Mapping[str, Any]) -> set[str]: ...


@dataclass(frozen=True)
class System:
    """What a system brings.

    config: its sections. check(loaded): builds all that the config of a simulation names.
    run(loaded, out, command), requires(loaded, out) and trade(loaded, out): the commands.
    trials(loaded, device): its Monte Carlo. definitions: of the figures, by name.
    """

    config: type[Config]
    check: Callable[[Loaded], None]
    run: Callable[[Loaded, Path, str], Path]
    requires: Callable[[Loaded, Path | None], str]
    trade: Callable[[Loaded, Path | None], str]
    trials: Callable[..., Trials]
    definitions: Mapping[str, Any]


@cache
def systems() -> dict[str, System]:
    """All systems by name."""
    from torchsar.study.geo import run as geo_run
    from torchsar.study.geo.judge import DEFINITIONS as GEO
    from torchsar.study.geo.requires import requires as geo_requires
    from torchsar.study.geo.sections import GeoConfig
    from torchsar.study.geo.trade import trade as geo_trade
    from torchsar.study.geo.trials import GeoTrials
    from torchsar.study.isal import run as isal_run
    from torchsar.study.isal.judge import DEFINITIONS as ISAL
    from torchsar.study.isal.requires import requires as isal_requires
    from torchsar.study.isal.sections import IsalConfig
    from torchsar.study.isal.trade import trade as isal_trade
    from torchsar.study.isal.trials import IsalTrials
    from torchsar.study.ocean import run as ocean_run
    from torchsar.study.ocean.judge import DEFINITIONS as OCEAN
    from torchsar.study.ocean.requires import requires as ocean_requires
    from torchsar.study.ocean.sections import OceanConfig
    from torchsar.study.ocean.trade import trade as ocean_trade
    from torchsar.study.ocean.trials import OceanTrials
    from torchsar.study.rotation import run as rotation_run
    from torchsar.study.rotation.judge import DEFINITIONS as ROTATION
    from torchsar.study.rotation.requires import requires as rotation_requires
    from torchsar.study.rotation.sections import RotationConfig
    from torchsar.study.rotation.trade import trade as rotation_trade
    from torchsar.study.rotation.trials import RotationTrials
    from torchsar.study.sal import run as sal_run
    from torchsar.study.sal.judge import DEFINITIONS as SAL
    from torchsar.study.sal.requires import requires as sal_requires
    from torchsar.study.sal.sections import SalConfig
    from torchsar.study.sal.trade import trade as sal_trade
    from torchsar.study.sal.trials import SalTrials
    from torchsar.study.stripmap import run as stripmap_run
    from torchsar.study.stripmap.judge import DEFINITIONS as STRIPMAP
    from torchsar.study.stripmap.requires import requires as stripmap_requires
    from torchsar.study.stripmap.sections import StripmapConfig
    from torchsar.study.stripmap.trade import trade as stripmap_trade
    from torchsar.study.stripmap.trials import StripmapTrials

    return {
        "geo": System(GeoConfig, geo_run.check, geo_run.run, geo_requires, geo_trade, GeoTrials, GEO),
        "geo_ocean": System(
            OceanConfig, ocean_run.check, ocean_run.run, ocean_requires, ocean_trade, OceanTrials, OCEAN
        ),
        "isal": System(IsalConfig, isal_run.check, isal_run.run, isal_requires, isal_trade, IsalTrials, ISAL),
        "isal_rotation": System(
            RotationConfig,
            rotation_run.check,
            rotation_run.run,
            rotation_requires,
            rotation_trade,
            RotationTrials,
            ROTATION,
        ),
        "sal": System(SalConfig, sal_run.check, sal_run.run, sal_requires, sal_trade, SalTrials, SAL),
        "stripmap": System(
            StripmapConfig,
            stripmap_run.check,
            stripmap_run.run,
            stripmap_requires,
            stripmap_trade,
            StripmapTrials,
            STRIPMAP,
        ),
    }


def system_named(name: Any, file: str) -> System:
    """The system of that name. Raises ConfigError naming those there are."""
    if not isinstance(name, str) or name not in systems():
        raise ConfigError(
            f"{file}: key 'system' has the value {name!r}; it should be one of "
            f"{', '.join(systems())}{did_you_mean(str(name), systems())}"
        )
    return systems()[name]


def system_of(loaded: Loaded) -> System:
    """The system of a checked config."""
    return systems()[loaded.config.system]
