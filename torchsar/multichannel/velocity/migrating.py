"""Velocity estimators on lines that still migrate."""

from __future__ import annotations

from dataclasses import replace

from torchsar.core import Estimate, Signal, Stage
from torchsar.multichannel.migration import CorrectMigration, Keystone
from torchsar.multichannel.velocity.stages import strongest_line
from torchsar.multichannel.velocity.walk import WalkAmbiguity
from torchsar.radar import BistaticRadar


class MigratingLines(Stage):
    """A velocity estimator for lines that still migrate.

    It corrects the migration of a point at rest and the walk of the strongest point for the
    estimator alone, and returns the signal unchanged: the migration that the estimated velocity
    causes is for a later `CorrectMigration`. Azimuth-only data do not migrate.

    Args:
        radar: Instrument.
        estimator: Estimator of the velocity, a stage on (channel, pulse, range) or, with
            `one_line`, on (channel, pulse).
        one_line: Whether the estimator gets the strongest range line only.
    """

    works_on = ("channel", "pulse", "range")
    also_on = (("channel", "pulse"),)

    def __init__(self, radar: BistaticRadar, estimator: Stage, one_line: bool = False) -> None:
        super().__init__()
        self.estimator, self.one_line = estimator, one_line
        self.walk, self.correct = WalkAmbiguity(radar), CorrectMigration(radar, Keystone(whole_swath=False))
        self.provides = estimator.provides

    def forward(self, signal: Signal) -> Estimate:
        """Estimate the velocity; `ok` is False also where the walk is not reliably known."""
        if "range" not in signal.names:
            return self.estimator(signal)
        walk = self.walk(signal)
        corrected = self.correct(signal, ambiguity=walk["ambiguity"])
        if self.one_line:
            corrected = Signal(strongest_line(corrected.data)[0], corrected.axes[:2])
        found = self.estimator(corrected)
        return replace(
            found,
            ok=found.ok & walk.ok,
            quality=found.quality.minimum(walk.quality),
            info={**found.info, "ambiguity": walk["ambiguity"]},
        )
