"""Velocity estimation on range lines whose migration has not been corrected."""

from __future__ import annotations

from dataclasses import replace

import torch

from torchsar.core import Estimate, Outcome, Signal, Stage
from torchsar.multichannel.migration import CorrectMigration, Keystone
from torchsar.multichannel.velocity.stages import strongest_line
from torchsar.multichannel.velocity.walk import WalkAmbiguity
from torchsar.radar import BistaticRadar


class MigratingLines(Stage):
    """Stage that estimates a velocity from range lines whose migration has not been corrected.

    The estimator gets a copy of the data in which the migration of a point at rest and the range
    walk of the strongest point are corrected. An along-track speed leaves a curved migration, which
    weakens the ends of the range line and bends its phase. The estimator therefore runs again, on
    data in which the migration of the motion found is corrected. The signal itself is not changed,
    so that a later `CorrectMigration` can use the estimated velocity. Data without a range axis do
    not migrate and go to the estimator directly.

    Args:
        radar: Radar parameters.
        estimator: Estimator of the velocity, a stage on (channel, pulse, range) or, with
            `one_line`, on (channel, pulse).
        one_line: Whether the estimator gets only the strongest range line.
        assess: Whether the range walk is assessed; `estimator` has a switch of its own.
    """

    works_on = ("channel", "pulse", "range")
    also_on = (("channel", "pulse"),)

    def __init__(self, radar: BistaticRadar, estimator: Stage, one_line: bool = False, *, assess: bool = True) -> None:
        super().__init__()
        self.estimator, self.one_line = estimator, one_line
        self.walk = WalkAmbiguity(radar, assess=assess)
        self.correct = CorrectMigration(radar, Keystone(whole_swath=False))
        self.provides, self.neutral = estimator.provides, estimator.neutral

    def forward(self, signal: Signal) -> Estimate:
        """Estimate the velocity from channels with the axes (channel, pulse[, range]).

        Returns:
            Values of the estimator. If there is a range axis, `info` holds the ambiguity number of
            the range walk as `ambiguity`. Outcomes: those of the estimator, and `IN_DOUBT` where
            this number is not reliable.
        """
        if "range" not in signal.names:
            return self.estimator(signal)
        walk = self.walk(signal)
        first = self._estimate(self.correct(signal, ambiguity=walk["ambiguity"]))
        # values that are not ok count as well: the migration that they correct may be why
        found = self._estimate(self.correct(signal, **{name: first[name] for name in self.provides}))
        return replace(
            found,
            outcome=torch.maximum(found.outcome, Outcome.of(walk.ok, Outcome.IN_DOUBT)),
            quality=found.quality.minimum(walk.quality),
            info={**found.info, "ambiguity": walk["ambiguity"]},
        )

    def _estimate(self, corrected: Signal) -> Estimate:
        """Run the estimator on corrected data."""
        if self.one_line:
            corrected = Signal(strongest_line(corrected.data)[0], corrected.axes[:2])
        return self.estimator(corrected)
