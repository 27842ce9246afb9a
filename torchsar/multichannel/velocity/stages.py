"""Velocity estimators of a moving point as stages.

They work on signals with the axes (channel, pulse). If there is also a range axis, they work on the
strongest range line of each trial. The maximum of the likelihood by gradients is found here.

PRF ambiguity number of a moving point from its range walk, and velocities in migrating lines.

The channels measure the slant-range velocity only modulo lambda PRF; the ambiguity number counts
these intervals. Each adds a range walk of lambda PRF T in T seconds of illumination, far more than
a range cell. Migration correction with the right number concentrates the point in one range line.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchsar.core import Estimate, Outcome, Signal, Stage, best_of, take, unit_level
from torchsar.multichannel.migration import CorrectMigration, Frame, Keystone, correct_migration
from torchsar.multichannel.motion import Number, PointMotion
from torchsar.multichannel.response import checked_channels, refuse_shifted
from torchsar.multichannel.velocity.along_track import along_track_velocity, interferometry
from torchsar.multichannel.velocity.aperture import ELEMENT_BEAM, Aperture, Expected, seen_aperture
from torchsar.multichannel.velocity.assess import outcome_of_point
from torchsar.multichannel.velocity.bank import Search
from torchsar.multichannel.velocity.likelihood import PointLikelihood, explained_energy, maximum_likelihood
from torchsar.multichannel.velocity.model import (
    TINY,
    UNKNOWNS,
    estimate_of,
    moved,
    point_phasor,
    refuse_unknowns,
    round_units,
)
from torchsar.multichannel.velocity.recommended import moving_point_velocity
from torchsar.optim import implicit, lbfgs
from torchsar.radar import BistaticRadar


def strongest_line(data: Tensor) -> tuple[Tensor, Tensor]:
    """Select the range line of most energy in each trial.

    Args:
        data: Channels with corrected migration, shape (..., channel, pulse, range), complex.

    Returns:
        The line (..., channel, pulse) and its index (...,).
    """
    index = unit_level(data.detach(), 3).abs().square().sum((-3, -2)).argmax(-1)
    return take(data.movedim(-1, -3), index, -3), index


def gradient_likelihood(
    data: Tensor,
    radar: BistaticRadar,
    start: PointMotion,
    aperture: Aperture,
    unknowns: tuple[str, ...] = UNKNOWNS,
    steps: int = 60,
    *,
    assess: bool = True,
) -> Estimate:
    """Estimate the motion of highest likelihood by limited-memory BFGS with autograd gradients.

    >>> import torch
    >>> from torchsar.multichannel import Dwell, PointMotion
    >>> from torchsar.multichannel.velocity.stages import gradient_likelihood
    >>> from torchsar.radar import BistaticRadar, LinearFM
    >>> radar = BistaticRadar(1.25e9, LinearFM(50e6, 10e-6), 60e6, 180.0, 300.0, 5000.0)
    >>> data = torch.zeros(3, 90, dtype=torch.complex64)
    >>> gradient_likelihood(data, radar, PointMotion.of(radar, data.real), Dwell(0.5)).failed
    tensor(True)

    The function serves as a check of `maximum_likelihood`, which is faster, and as an example for
    other objectives.

    Args:
        data: Channels with the transmit range removed, shape (..., channel, pulse), complex.
        radar: Radar parameters.
        start: Starting motion, shape (...,). Its residual Doppler must lie within half a Doppler
            cell, as for `maximum_likelihood`.
        aperture: Expected amplitude over slow time.
        unknowns: Names of the parameters to estimate among `u_r_m_s`, `u_a_m_s`, `y0_m`.
        steps: Largest number of steps.
        assess: Whether the outcome is assessed.

    Returns:
        `u_r_m_s`, `u_a_m_s`, `y0_m` of shape (...,) with standard deviations of the unknowns.
        `info` holds `snr_db` (over all samples), `noise_power` (per sample) and `converged`. Where
        the point is lit in a part of the aperture only, this part is used, see `seen_aperture`.
        Outcomes: those of `outcome_of_point`, and `NOT_CONVERGED` where the search failed.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples, the channels are not those of the radar, or a sample is
            not finite, or if `unknowns` holds other names or a name twice.
    """
    data = checked_channels(data, radar, "gradient_likelihood")
    aperture, _ = seen_aperture(data, radar, start, aperture)
    energy = data.abs().to(torch.float64).square().sum((-2, -1)).clamp_min(TINY)
    at_start = maximum_likelihood(data, radar, start, aperture, unknowns, steps=0)
    # the phases of the unknowns are strongly correlated; in whitened units the objective is
    # isotropic
    time_s = radar.pulse_axis(data.shape[-1]).values(data.device)
    weight = aperture.weight(radar, at_start.motion, time_s)
    echo = weight[..., None, :] * point_phasor(radar, at_start.motion, time_s, torch.complex128)
    units = round_units(
        PointLikelihood.of(echo, radar, at_start.motion, aperture, unknowns, None).fit(at_start.motion).normal
    )

    def there(x: Tensor) -> PointMotion:
        return moved(at_start.motion, (units @ x[..., None])[..., 0], unknowns)

    def cost(x: Tensor) -> Tensor:
        return -explained_energy(data, radar, there(x), weight) / energy

    found = lbfgs(
        cost, torch.zeros(*data.shape[:-2], len(unknowns), dtype=torch.float64, device=data.device), steps=steps
    )
    x = implicit(lambda x, *given: cost(x), found.x, data, start)
    fit = maximum_likelihood(data, radar, there(x), aperture, unknowns, steps=0)
    outcome = None
    if assess:
        outcome, _ = outcome_of_point(data, radar, fit, aperture, [(Outcome.NOT_CONVERGED, ~found.ok)])
    return estimate_of(fit, outcome, {"converged": found.converged})


class _Velocity(Stage):
    """Estimator on one range line, with radar, expected amplitude and closest range."""

    works_on = ("channel", "pulse")
    also_on = (("channel", "pulse", "range"),)
    provides = UNKNOWNS
    neutral = dict.fromkeys(UNKNOWNS, 0.0)  # a point at rest in the middle of the scene
    differentiable = "where ok"

    def __init__(
        self,
        radar: BistaticRadar,
        aperture: Expected = ELEMENT_BEAM,
        range_m: float | None = None,
        *,
        assess: bool = True,
    ) -> None:
        super().__init__()
        self.radar, self.aperture, self.range_m, self.assess = radar, aperture, range_m, assess

    def line(self, signal: Signal) -> tuple[Tensor, Tensor | float | None]:
        """Return the data (..., channel, pulse) of the strongest range line and its closest range.

        Raises:
            ValueError: If the channels are not those of the radar, slow time is not zero at pulse n
                // 2, or there are fewer than 4 pulses.
        """
        refuse_shifted(self.radar, signal.axis("pulse"))
        channels, pulses = signal.axes[0].n, signal.axes[1].n
        # three pulses determine a tone and its curvature, a fourth shows noise
        if channels != self.radar.channels or pulses < 4:
            raise ValueError(
                f"{type(self).__name__} expects {self.radar.channels} channels as in the radar's "
                f"channel_m and at least 4 pulses, got {channels} channels and {pulses} pulses; "
                "select the same channels in radar and data"
            )
        if "range" not in signal.names:
            return signal.data, self.range_m
        data, index = strongest_line(signal.data)
        near = signal.axis("range")
        return data, near.start + near.step * index.to(torch.float64) if self.range_m is None else self.range_m

    def begin(
        self, signal: Signal, u_r_m_s: Number, u_a_m_s: Number, y0_m: Number
    ) -> tuple[Tensor, BistaticRadar, PointMotion, Aperture]:
        """Return data, radar, starting motion and aperture for an estimator that needs a start."""
        data, range_m = self.line(signal)
        motion = PointMotion.of(self.radar, data, u_r_m_s, u_a_m_s, y0_m, range_m)
        return data, self.radar, motion.each(lambda value: value.expand(data.shape[:-2])), self.aperture


class Interferometry(_Velocity):
    """Stage that estimates the slant-range speed by along-track interferometry.

    The along-track speed is given; see `interferometry`.

    Args:
        radar: Radar parameters.
        aperture: Expected amplitude over slow time.
        range_m: Closest range in metres, None for that of the strongest range line, or for the
            reference range of the radar if there is no range axis.
        check_ambiguity: Whether the assessment asks if the velocity may be wrong by lambda PRF.
        assess: Whether the outcome is assessed.
    """

    def __init__(
        self,
        radar: BistaticRadar,
        aperture: Expected = ELEMENT_BEAM,
        range_m: float | None = None,
        check_ambiguity: bool = True,
        *,
        assess: bool = True,
    ) -> None:
        super().__init__(radar, aperture, range_m, assess=assess)
        self.check_ambiguity = check_ambiguity

    def forward(self, signal: Signal, u_r_m_s: Number = 0.0, u_a_m_s: Number = 0.0, y0_m: Number = 0.0) -> Estimate:
        """Estimate slant-range speed and along-track position for a known along-track speed.

        Args:
            signal: Channels with the axes (channel, pulse[, range]).
            u_r_m_s: Starting slant-range speed in m/s, shape (...,) or a number.
            u_a_m_s: Along-track speed in m/s, shape (...,) or a number.
            y0_m: Starting along-track position at t = 0 in metres, shape (...,) or a number.

        Returns:
            `u_r_m_s`, `u_a_m_s` and `y0_m` of shape (...,), see `interferometry`.

        Raises:
            ValueError: If the radar has one channel, the data have other channels than the radar or
                fewer than 4 pulses, or slow time is not zero at pulse n // 2.
        """
        begun = self.begin(signal, u_r_m_s, u_a_m_s, y0_m)
        return interferometry(*begun, check_ambiguity=self.check_ambiguity, assess=self.assess)


class AlongTrackAutofocus(_Velocity):
    """Stage that estimates the along-track speed by the power of the deramped tone.

    >>> from torchsar import Draws, echo, multichannel, radar, scene
    >>> receiver = radar.BistaticRadar(1.25e9, radar.LinearFM(50e6, 10e-6), 60e6, 180, 300, 5000)
    >>> world = scene.BistaticWorld(scene.MovingPoints([3], [8], [0], [0]), scene.BandLimited(1.0))
    >>> channels = echo.simulate_bistatic(receiver, world, 200, None, Draws(seed=1))[0].signal
    >>> autofocus = multichannel.AlongTrackAutofocus(receiver, multichannel.Dwell(1.0), half_m_s=9)
    >>> round(autofocus(channels, u_r_m_s=3.0)["u_a_m_s"].item(), 1)
    8.0

    See `along_track_velocity`.

    Args:
        radar: Radar parameters.
        aperture: Expected amplitude over slow time.
        range_m: Closest range in metres, None for that of the strongest range line, or for the
            reference range of the radar if there is no range axis.
        half_m_s: Half width of the search about an along-track speed of zero in m/s.
        assess: Whether standard deviation and outcome are assessed.
    """

    provides = ("u_a_m_s",)
    neutral = {"u_a_m_s": 0.0}

    def __init__(
        self,
        radar: BistaticRadar,
        aperture: Expected = ELEMENT_BEAM,
        range_m: float | None = None,
        half_m_s: float = 20.0,
        *,
        assess: bool = True,
    ) -> None:
        super().__init__(radar, aperture, range_m, assess=assess)
        self.half_m_s = half_m_s

    def forward(self, signal: Signal, u_r_m_s: Number = 0.0, y0_m: Number = 0.0) -> Estimate:
        """Estimate the along-track speed for a given slant-range speed and along-track position.

        Args:
            signal: Channels with the axes (channel, pulse[, range]).
            u_r_m_s: Slant-range speed in m/s, shape (...,) or a number.
            y0_m: Along-track position at t = 0 in metres, shape (...,) or a number.

        Returns:
            `u_a_m_s` of shape (...,), see `along_track_velocity`.

        Raises:
            ValueError: If the half width of the search is not positive, or the search reaches the
                speed of the receiver. Also if the data have other channels than the radar or fewer
                than 4 pulses, or slow time is not zero at pulse n // 2.
        """
        return along_track_velocity(*self.begin(signal, u_r_m_s, 0.0, y0_m), self.half_m_s, assess=self.assess)


class LikelihoodVelocity(_Velocity):
    """Stage that estimates velocity and position by maximum likelihood near a start.

    >>> from torchsar import Draws, echo, multichannel, radar, scene
    >>> receiver = radar.BistaticRadar(1.25e9, radar.LinearFM(50e6, 10e-6), 60e6, 180, 300, 5000)
    >>> world = scene.BistaticWorld(scene.MovingPoints([3], [0], [0], [0]), scene.BandLimited(1.0))
    >>> channels = echo.simulate_bistatic(receiver, world, 200, None, Draws(seed=1))[0].signal
    >>> velocity = multichannel.LikelihoodVelocity(receiver, multichannel.Dwell(1.0))
    >>> round(velocity(channels, u_r_m_s=2.9)["u_r_m_s"].item(), 2)
    3.0

    See `maximum_likelihood`.

    Args:
        radar: Radar parameters.
        aperture: Expected amplitude over slow time.
        range_m: Closest range in metres, None for that of the strongest range line, or for the
            reference range of the radar if there is no range axis.
        unknowns: Names of the parameters to estimate among `u_r_m_s`, `u_a_m_s`, `y0_m`.
        assess: Whether the outcome is assessed.

    Raises:
        ValueError: If `unknowns` holds other names or a name twice.
    """

    def __init__(
        self,
        radar: BistaticRadar,
        aperture: Expected = ELEMENT_BEAM,
        range_m: float | None = None,
        unknowns: tuple[str, ...] = UNKNOWNS,
        *,
        assess: bool = True,
    ) -> None:
        super().__init__(radar, aperture, range_m, assess=assess)
        self.unknowns = tuple(unknowns)
        refuse_unknowns(self.unknowns)

    def forward(self, signal: Signal, u_r_m_s: Number = 0.0, u_a_m_s: Number = 0.0, y0_m: Number = 0.0) -> Estimate:
        """Estimate the parameters that `unknowns` names, near a starting motion.

        Args:
            signal: Channels with the axes (channel, pulse[, range]).
            u_r_m_s: Starting slant-range speed in m/s, shape (...,) or a number.
            u_a_m_s: Starting along-track speed in m/s, shape (...,) or a number.
            y0_m: Starting along-track position at t = 0 in metres, shape (...,) or a number.

        Returns:
            `u_r_m_s`, `u_a_m_s` and `y0_m` of shape (...,), with standard deviations of those
            estimated. Where the point is lit in a part of the aperture only, this part is used, see
            `seen_aperture`. Outcomes: those of `outcome_of_point`, and `NOT_CONVERGED` where the
            steps have not reached the maximum.

        Raises:
            ValueError: If the data have other channels than the radar or fewer than 4 pulses, or
                slow time is not zero at pulse n // 2.
        """
        data, radar, start, aperture = self.begin(signal, u_r_m_s, u_a_m_s, y0_m)
        aperture, _ = seen_aperture(data, radar, start, aperture)
        found = maximum_likelihood(data, radar, start, aperture, self.unknowns)
        if not self.assess:
            return estimate_of(found)
        # if the start was too far away, another step would explain more than the noise of a few
        # samples
        again = maximum_likelihood(data, radar, found.motion, aperture, self.unknowns, steps=1)
        moving = again.energy - found.energy > 4 * found.noise_power + 1e-9 * found.energy
        outcome, _ = outcome_of_point(data, radar, found, aperture, [(Outcome.NOT_CONVERGED, moving)])
        return estimate_of(found, outcome)


class GradientVelocity(LikelihoodVelocity):
    """Stage that estimates velocity and position by maximum likelihood with autograd gradients.

    >>> from torchsar import Draws, echo, multichannel, radar, scene
    >>> receiver = radar.BistaticRadar(1.25e9, radar.LinearFM(50e6, 10e-6), 60e6, 180, 300, 5000)
    >>> world = scene.BistaticWorld(scene.MovingPoints([3], [0], [0], [0]), scene.BandLimited(1.0))
    >>> channels = echo.simulate_bistatic(receiver, world, 200, None, Draws(seed=1))[0].signal
    >>> velocity = multichannel.GradientVelocity(receiver, multichannel.Dwell(1.0))
    >>> round(velocity(channels, u_r_m_s=2.95)["u_r_m_s"].item(), 2)
    3.0

    See `gradient_likelihood`; arguments as those of `LikelihoodVelocity`.
    """

    def forward(self, signal: Signal, u_r_m_s: Number = 0.0, u_a_m_s: Number = 0.0, y0_m: Number = 0.0) -> Estimate:
        """Estimate the parameters that `unknowns` names, near a starting motion.

        Args:
            signal: Channels with the axes (channel, pulse[, range]).
            u_r_m_s: Starting slant-range speed in m/s, shape (...,) or a number.
            u_a_m_s: Starting along-track speed in m/s, shape (...,) or a number.
            y0_m: Starting along-track position at t = 0 in metres, shape (...,) or a number.

        Returns:
            `u_r_m_s`, `u_a_m_s` and `y0_m` of shape (...,), see `gradient_likelihood`.

        Raises:
            ValueError: If the data have other channels than the radar or fewer than 4 pulses, or
                slow time is not zero at pulse n // 2.
        """
        return gradient_likelihood(*self.begin(signal, u_r_m_s, u_a_m_s, y0_m), self.unknowns, assess=self.assess)


class MovingPointVelocity(_Velocity):
    """Recommended stage for velocity and position of a moving point, without prior knowledge.

    See `moving_point_velocity`.

    Args:
        radar: Radar parameters.
        aperture: Expected amplitude over slow time.
        range_m: Closest range in metres, None for that of the strongest range line, or for the
            reference range of the radar if there is no range axis.
        search: Extent of the search, by default +-1.5 lambda PRF in slant-range speed.
        u_a_m_s: Along-track speed in m/s where it is known a priori, None to estimate it.
        assess: Whether the outcome is assessed.
    """

    def __init__(
        self,
        radar: BistaticRadar,
        aperture: Expected = ELEMENT_BEAM,
        range_m: float | None = None,
        search: Search | None = None,
        u_a_m_s: float | None = None,
        *,
        assess: bool = True,
    ) -> None:
        super().__init__(radar, aperture, range_m, assess=assess)
        self.search, self.u_a_m_s = search, u_a_m_s
        self.neutral = {**self.neutral, "u_a_m_s": u_a_m_s or 0.0}

    def forward(self, signal: Signal) -> Estimate:
        """Estimate velocity and position from channels with the axes (channel, pulse[, range]).

        Returns:
            `u_r_m_s`, `u_a_m_s` and `y0_m` of shape (...,), see `moving_point_velocity`.

        Raises:
            ValueError: If the search reaches the speed of the receiver, the data have other
                channels than the radar or fewer than 4 pulses, or slow time is not zero at pulse n
                // 2.
        """
        data, range_m = self.line(signal)
        return moving_point_velocity(
            data, self.radar, self.aperture, self.search, self.u_a_m_s, range_m, assess=self.assess
        )


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
