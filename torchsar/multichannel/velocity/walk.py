"""PRF ambiguity number of a moving point from its range walk, and velocities in migrating lines.

The channels measure the slant-range velocity only modulo lambda PRF; the ambiguity number counts
these intervals. Each adds a range walk of lambda PRF T in T seconds of illumination, far more than
a range cell. Migration correction with the right number concentrates the point in one range line.
"""

from __future__ import annotations

from dataclasses import replace

import torch

from torchsar.core import Estimate, Outcome, Signal, Stage, best_of
from torchsar.multichannel.migration import CorrectMigration, Frame, Keystone, correct_migration
from torchsar.multichannel.motion import Number, PointMotion
from torchsar.multichannel.velocity.model import TINY
from torchsar.multichannel.velocity.stages import strongest_line
from torchsar.radar import BistaticRadar


class WalkAmbiguity(Stage):
    """Stage that estimates the PRF ambiguity number of the strongest point from its range walk.

    >>> from torchsar import Draws, echo, multichannel, radar, scene
    >>> receiver = radar.BistaticRadar(1.25e9, radar.LinearFM(50e6, 10e-6), 60e6, 180, 300, 5000)
    >>> world = scene.BistaticWorld(scene.MovingPoints([43], [0], [0], [0]), scene.BandLimited(1.0))
    >>> channels = echo.simulate_bistatic(receiver, world, 180, 64, Draws(seed=1))[0].signal
    >>> int(multichannel.WalkAmbiguity(receiver)(channels)["ambiguity"])  # lambda PRF is 43.2 m/s
    1

    The range migration is corrected with each number in turn. The criterion is the energy of the
    strongest range line, which depends neither on phases nor on aliasing in azimuth.
    `CorrectMigration` accepts the estimate as its input `ambiguity`.

    Args:
        radar: Radar parameters.
        most: Largest magnitude of the ambiguity numbers that are tried.
        range_m: Closest range of the reference point in metres, None for the reference range of the
            radar.
        assess: Whether quality and outcome are assessed.

    Raises:
        ValueError: If `most` is below 1.
    """

    works_on = ("channel", "pulse", "range")
    provides = ("ambiguity",)
    neutral = {"ambiguity": 0.0}
    differentiable = "no"

    def __init__(
        self, radar: BistaticRadar, most: int = 2, range_m: float | None = None, *, assess: bool = True
    ) -> None:
        super().__init__()
        if most < 1:
            raise ValueError(f"most must be 1 or more, the largest ambiguity number to try, got {most}")
        self.radar, self.most, self.range_m, self.assess = radar, most, range_m, assess

    def forward(self, signal: Signal, u_r_m_s: Number = 0.0, u_a_m_s: Number = 0.0, y0_m: Number = 0.0) -> Estimate:
        """Estimate the PRF ambiguity number of the strongest point from its range walk.

        Args:
            signal: Range-compressed channels with the axes (channel, pulse, range).
            u_r_m_s: Slant-range speed of the reference point in m/s, shape (...,) or a number.
            u_a_m_s: Along-track speed of the reference in m/s, same shape.
            y0_m: Along-track position of the reference at t = 0 in metres, same shape.

        Returns:
            `ambiguity` of shape (...,). `info` holds `line`, the index of the range line of the
            point, and `contrast`. The contrast is the energy of this line minus that of the
            strongest line with the next best number, in standard deviations of the energy of a line
            of noise. Outcomes: `NOISE` unless the contrast is above 5. `OK` says that a line stays
            bright, whatever its phases.
        """
        reference = PointMotion.of(self.radar, signal.data, u_r_m_s, u_a_m_s, y0_m, self.range_m)
        frame, migration = Frame.of(self.radar, signal), Keystone(whole_swath=False)
        numbers = torch.arange(-self.most, self.most + 1, dtype=torch.float64, device=signal.data.device)
        corrected = (correct_migration(signal.data, frame, reference, migration, number) for number in numbers)
        energies = torch.stack([x.abs().to(torch.float64).square().sum((-3, -2)) for x in corrected])
        strongest, line = energies.max(-1)
        number, margin = best_of(-strongest, numbers[(...,) + (None,) * (strongest.ndim - 1)].expand(strongest.shape))
        line = line.gather(0, (number + self.most).long()[None])[0]
        # standard deviation of the energies of lines with noise alone, from their median absolute
        # deviation
        middle = energies[self.most].median(-1, keepdim=True).values
        spread = 1.4826 * (energies[self.most] - middle).abs().median(-1).values
        contrast = margin / spread.clamp_min(1e-12 * middle[..., 0]).clamp_min(TINY)
        info = {"line": line.to(torch.float64), "contrast": contrast}
        if not self.assess:
            return Estimate({"ambiguity": number}, info=info)
        outcome = Outcome.of(contrast > 5.0, Outcome.NOISE)  # least contrast, by choice
        return Estimate({"ambiguity": number}, {}, contrast / (5.0 + contrast), outcome, info)


class MigratingLines(Stage):
    """Stage that estimates a velocity from range lines whose migration has not been corrected.

    >>> from torchsar import Draws, echo, multichannel, radar, scene
    >>> receiver = radar.BistaticRadar(1.25e9, radar.LinearFM(50e6, 10e-6), 60e6, 180, 300, 5000)
    >>> world = scene.BistaticWorld(scene.MovingPoints([20], [0], [0], [0]), scene.BandLimited(1.0))
    >>> channels = echo.simulate_bistatic(receiver, world, 180, 48, Draws(seed=1))[0].signal
    >>> velocity = multichannel.Interferometry(receiver, multichannel.Dwell(1.0))
    >>> round(multichannel.MigratingLines(receiver, velocity)(channels)["u_r_m_s"].item(), 1)
    20.0

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
        self.differentiable = estimator.differentiable

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
        # values whose outcome is not ok are used as well, because the migration that they correct
        # may be the reason
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
