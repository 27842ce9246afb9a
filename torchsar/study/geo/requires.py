"""`torchsar requires` for moving targets before several channels: limits of each method, and what
the scene requires of its model.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from torchsar.core import Alternate, Chain
from torchsar.focus.ladar_requirements import Limit
from torchsar.focus.requirements import Requirement
from torchsar.multichannel.migration import Keystone
from torchsar.multichannel.reconstruct import Reconstruct
from torchsar.multichannel.requirements import (
    Estimator,
    MultichannelUse,
    multichannel_limits,
    multichannel_requirements,
)
from torchsar.multichannel.response import LeastSquares
from torchsar.multichannel.velocity.sir import SignalIntensityRatio
from torchsar.multichannel.velocity.stages import (
    AlongTrackAutofocus,
    GradientVelocity,
    Interferometry,
    LikelihoodVelocity,
    MovingPointVelocity,
)
from torchsar.study.cases import refuse_recordings
from torchsar.study.config import Loaded
from torchsar.study.geo.build import Echoes, check
from torchsar.study.geo.sections import GeoConfig
from torchsar.study.geo.stages import MigrationOfLines, Stilled
from torchsar.study.limits import heed, limit_lines, limit_rows, requirement_lines, requirement_rows, write_needs
from torchsar.study.methods import build_chains
from torchsar.study.settings.errors import ConfigError

_ESTIMATORS: dict[type, Estimator] = {
    SignalIntensityRatio: "sir",
    Interferometry: "ati",
    AlongTrackAutofocus: "ati",
    LikelihoodVelocity: "ml",
    GradientVelocity: "ml",
    MovingPointVelocity: "ml",
}
_PATTERN_S = 4.5


def requires(loaded: Loaded, out: Path | None) -> str:
    """Both tables of every case of a simulation as text, predicted from the config alone.

    With `out`: config.yaml, requires.json and requires.txt there.
    """
    refuse_recordings(loaded)
    check(loaded)
    return write_needs(loaded, out, Needs.of)


def heed_limits(loaded: Loaded, case: str) -> None:
    """Refuse or warn of what the case goes beyond, see `heed`."""
    needs = Needs.of(loaded)
    assert isinstance(loaded.config, GeoConfig)
    shown = set(loaded.config.beyond_limits)
    heed(loaded, case, list(needs.limits), lambda limit: [name for name in needs.limits[limit] if name not in shown])


@dataclass(frozen=True)
class Needs:
    """Limits of one case, each with the methods that it concerns, and fidelity rows of the
    recommended method.
    """

    limits: Mapping[Limit, list[str]]
    rows: tuple[Requirement, ...]

    @staticmethod
    def of(loaded: Loaded) -> Needs:
        """Predicted from radar, world and stages. Raises ConfigError for what they refuse."""
        try:
            return _needs(loaded)
        except ValueError as error:
            raise ConfigError(f"{loaded.file}: {' '.join(str(error).split())}") from None

    def tree(self) -> dict[str, object]:
        rows = [{**row, "methods": names} for row, names in zip(limit_rows(list(self.limits)), self.limits.values())]
        return {"limits": rows, "fidelity": self.fidelity, "requirements": requirement_rows(self.rows)}

    def text(self, name: str) -> str:
        concerned = [f"  {limit.name}: {', '.join(names)}" for limit, names in self.limits.items() if not limit.ok]
        beyond = ["", "beyond a limit:", *concerned] if concerned else []
        return "\n".join(
            [
                name,
                *limit_lines(list(self.limits)),
                *beyond,
                "",
                *requirement_lines(self.rows),
                f"the simplest chain that this scene allows: {self.fidelity}",
            ]
        )

    @property
    def fidelity(self) -> str:
        """What the rows leave necessary, in words."""
        ok = {row.effect: row.ok for row in self.rows}
        if not ok:
            return "none"
        transmit = (
            "transmit range of order 1"
            if ok["transmit range of order 1"]
            else "order 2"
            if ok["transmit range of order 2"]
            else "all orders"
        )
        migration = (
            "none"
            if ok["no range migration correction"]
            else "static bulk"
            if ok["static bulk correction"]
            else "deramp and keystone"
        )
        path = "parabola" if ok["parabolic receive range"] else "hyperbola"
        return (
            f"transmit range {transmit.removeprefix('transmit range of ')}, receive range by the "
            f"{path}, range migration: {migration}"
        )


def _needs(loaded: Loaded) -> Needs:
    echoes = Echoes.of(loaded)
    uses = {name: use_of(chain, echoes) for name, chain in build_chains(loaded, radar=echoes.radar).items()}
    limits: dict[Limit, list[str]] = {}
    for name, use in uses.items():
        for limit in multichannel_limits(echoes.radar, use):
            limits.setdefault(limit, []).append(name)
    # without an aperture there is nothing to simplify
    moves = echoes.radar.speed_m_s > uses["recommended"].u_a_m_s[1]
    return Needs(limits, multichannel_requirements(echoes.radar, uses["recommended"]) if moves else ())


def use_of(chain: Chain, echoes: Echoes) -> MultichannelUse:
    """How a chain uses the radar of these echoes, whose targets bound the velocities."""
    stages = list(_stages(chain))
    rebuilds = [stage.rebuild for stage in _rebuilding(stages)]
    estimators = tuple(dict.fromkeys(_ESTIMATORS[type(stage)] for stage in stages if type(stage) in _ESTIMATORS))
    told = {
        "estimators": estimators,
        "deramped": all(isinstance(s.correct.migration, Keystone) for s in stages if isinstance(s, MigrationOfLines)),
    }
    targets = echoes.targets.values()
    speeds = {
        name: (min(getattr(t, name) for t in targets), max(getattr(t, name) for t in targets))
        for name in ("u_r_m_s", "u_a_m_s")
    }
    offset = 0.0 if echoes.samples is None else max(abs(t.range_m) for t in targets)
    snr = None if echoes.snr_db is None else float(echoes.snr_db)
    scene = {
        "y0_m": max(abs(t.azimuth_m) for t in targets),
        "swath_m": offset,
        "snr_db": snr,
        "clutter": echoes.sea is not None,
        "dtype": echoes.dtype,
    }
    rebuild = rebuilds[-1] if rebuilds else LeastSquares(1)
    return MultichannelUse(
        echoes.pulses,
        echoes.integration_s or _PATTERN_S,
        rebuild,
        echoes.integration_s is None,
        **speeds,
        **scene,
        **told,
    )


def _stages(chain: Chain) -> Iterable[object]:
    """All stages, those inside of others too."""
    for stage in chain.stages.values():
        inner = stage.estimator if isinstance(stage, Stilled) else stage
        yield from inner.estimators.values() if isinstance(inner, Alternate) else (inner,)


def _rebuilding(stages: list[object]) -> list[Reconstruct | SignalIntensityRatio]:
    """Stages that tell bands apart: the reconstruction itself, or that of the intensity ratio where
    there is none.
    """
    return [s for s in stages if isinstance(s, Reconstruct)] or [
        s for s in stages if isinstance(s, SignalIntensityRatio)
    ]
