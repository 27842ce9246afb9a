"""Velocity and position of a moving point without prior knowledge.

A search over a grid of velocities is followed by maximum likelihood, in white noise or in clutter
whose covariance is estimated from the data.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchsar.core import Estimate, Outcome, differentiable
from torchsar.multichannel.motion import Number, PointMotion
from torchsar.multichannel.response import checked_channels
from torchsar.multichannel.velocity.aperture import Aperture, Dwell, SeenAperture, seen_aperture
from torchsar.multichannel.velocity.assess import outcome_of_point
from torchsar.multichannel.velocity.bank import Search, bank_search
from torchsar.multichannel.velocity.likelihood import fitted_together, maximum_likelihood
from torchsar.multichannel.velocity.model import TINY, UNKNOWNS, Found, estimate_of, point_phasor
from torchsar.multichannel.velocity.whitening import Whitening, sample_whitening
from torchsar.radar import BistaticRadar


@differentiable("where ok")
def moving_point_velocity(
    data: Tensor,
    radar: BistaticRadar,
    aperture: Aperture,
    search: Search | None = None,
    u_a_m_s: Tensor | float | None = None,
    range_m: Number | None = None,
    whitening: Whitening | None = None,
    *,
    assess: bool = True,
) -> Estimate:
    """Estimate velocity and position of the strongest moving point per trial, without a start.

    >>> import torch
    >>> from torchsar.multichannel import Dwell, moving_point_velocity
    >>> from torchsar.radar import BistaticRadar, LinearFM
    >>> radar = BistaticRadar(1.25e9, LinearFM(50e6, 10e-6), 60e6, 180.0, 300.0, 5000.0)
    >>> data = torch.zeros(3, 90, dtype=torch.complex64)
    >>> moving_point_velocity(data, radar, Dwell(0.5), u_a_m_s=0.0).failed
    tensor(True)

    If no clutter covariance is given, the point is first sought in white noise. If the residual
    shows clutter, the search is repeated with the covariance of the data. Each of the two fits is
    refined with the covariance of its own residual. In each trial, the fit of higher likelihood is
    returned.

    The channels must be balanced, which the data of one point cannot show: a phase that grows
    along the array acts as a position and a speed (0.2 rad over 1.6 m as 28 m and 1.7 m/s), and
    standard deviations do not contain it.

    Up to three further points are fitted together with the strongest, if the residual is then white
    noise. Standard deviations then contain their effect.

    Args:
        data: Channels with the transmit range removed and slow time zero at pulse n // 2, shape
            (..., channel, pulse), complex.
        radar: Radar parameters.
        aperture: Expected amplitude over slow time.
        search: Extent of the search, by default +-1.5 lambda PRF in slant-range speed. The
            ambiguity modulo lambda PRF is resolved by the cubic phase of the range history.
        u_a_m_s: Along-track speed in m/s where it is known a priori, None to estimate it.
        range_m: Closest range in metres, None for the reference range of the radar.
        whitening: Clutter covariance, for example from neighbouring range lines; None to estimate
            it from the data.
        assess: Whether the outcome is assessed.

    Returns:
        Slant-range speed `u_r_m_s` (closing positive), along-track speed `u_a_m_s` and along-track
        position at t = 0 `y0_m` of shape (...,), with standard deviations. `info` holds `snr_db`
        (over all samples), `noise_power` (per sample) and `coloured` (True where clutter was found,
        and everywhere if `whitening` is given). Where the point is lit in a part of the aperture
        only, as in a range line that it crosses, this part is used, see `seen_aperture`.

        Outcomes: those of `outcome_of_point`; `OUTSIDE_SEARCH`; `SINGULAR` where the standard
        deviation of u_r exceeds the half width of the search, as with a single channel; and
        `PARTS_DISAGREE` where a further point of nearly the same Doppler frequency cannot be
        separated. `AMBIGUOUS` are speeds where another one within the search that differs by lambda
        PRF explains the data as well. The cubic phase, which separates them, is small for short
        wavelengths and dwells; a search of half that width then gives what is known a priori.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples, the channels are not those of the radar, or a sample is
            not finite, or if the search reaches the speed of the receiver.
    """
    data = checked_channels(data, radar, "moving_point_velocity")
    search = search or Search(u_r_m_s=1.5 * radar.ambiguous_velocity_m_s)
    unknowns = UNKNOWNS if u_a_m_s is None else ("u_r_m_s", "y0_m")
    if u_a_m_s is not None:
        search = replace(search, u_a_m_s=0.0)
    # the first search uses the integration time of Remote Sens. 2020, 12, 1703, Table 1
    coarse, u_a = aperture if isinstance(aperture, Dwell) else Dwell(4.5), 0.0 if u_a_m_s is None else u_a_m_s
    data = data.to(torch.complex128)
    job = _Job(data, radar, aperture, torch.ones_like(data[..., 0, :].real), coarse, search, u_a, range_m, unknowns)
    if whitening is not None:
        job, found = job.as_seen(job.found(whitening), whitening)
        coloured = torch.ones(data.shape[:-2], dtype=torch.bool, device=data.device)
        return job.estimate(found, coloured, torch.zeros_like(coloured), assess, whitening)
    seen, plain = job.as_seen(job.found(None), None)
    white, plain, disturbed = seen.separated(plain)
    plain, rest = white.refined(plain)
    if not bool(rest.coloured.any()):
        return white.estimate(plain, rest.coloured, disturbed, assess)
    # the profile and the other points that a fit in white noise finds may be clutter
    clutter = sample_whitening(job.data, radar)
    job, found = job.as_seen(job.found(clutter), clutter)
    other, rest_of_other = job.refined(found)
    # in each trial, the job with the smaller log determinant is likelier
    first = ~rest.coloured | (rest.log_det <= rest_of_other.log_det)
    return white.or_other(job, first).estimate(
        _chosen_fit(plain, other, first),
        torch.where(first, rest.coloured, rest_of_other.coloured),
        disturbed & (first | job._overlap(plain.motion, other.motion)),
        assess,
    )


@dataclass(frozen=True)
class _Job:
    """Data and settings of one estimate.

    The aperture is the expected one times `profile` (..., pulse), which was measured in the data.
    `coarse` is the aperture of the search.
    """

    data: Tensor
    radar: BistaticRadar
    expected: Aperture
    profile: Tensor
    coarse: Dwell
    search: Search
    u_a_m_s: Tensor | float
    range_m: Number | None
    unknowns: tuple[str, ...]

    @property
    def aperture(self) -> SeenAperture:
        """Expected amplitude over slow time, times the profile measured in the data."""
        return SeenAperture(self.expected, self.profile)

    def found(self, whitening: Whitening | None) -> Found:
        """Find the point by a grid search over velocities, followed by maximum likelihood.

        The search uses the middle of the aperture, the last fit all of it.
        """
        start, _ = bank_search(self.data, self.radar, self.coarse, self.search, self.u_a_m_s, self.range_m, whitening)
        near = maximum_likelihood(self.data, self.radar, start, self.coarse, self.unknowns, whitening)
        # the fit may end beside the maximum, so that it is also started half a step beside the
        # nearest hypothesis
        for side in (-0.5, 0.5) if "u_a_m_s" in self.unknowns else ():
            beside = replace(start, u_a_m_s=start.u_a_m_s + side * self.search.u_a_step_m_s)
            other = maximum_likelihood(self.data, self.radar, beside, self.coarse, self.unknowns, whitening)
            near = _chosen_fit(other, near, other.energy > near.energy)
        return self.fitted(near.motion, whitening)

    def as_seen(self, found: Found, whitening: Whitening | None) -> tuple[_Job, Found]:
        """Fit points again that are lit in a part of the aperture only, and keep that part as the
        profile.
        """
        aperture, uneven = seen_aperture(self.data, self.radar, found.motion, self.expected, whitening)
        if not isinstance(aperture, SeenAperture):
            return self, found
        job = replace(self, profile=aperture.profile)
        return job, _chosen_fit(job.fitted(found.motion, whitening), found, uneven)

    def or_other(self, other: _Job, first: Tensor) -> _Job:
        """Job that has the data and the profile of another job where `first` is False."""
        data = torch.where(first[..., None, None], self.data, other.data)
        return replace(self, data=data, profile=torch.where(first[..., None], self.profile, other.profile))

    def separated(self, found: Found) -> tuple[_Job, Found, Tensor]:
        """Fit up to three further points together with the first, where this leaves white noise.

        Their echo is then removed from the data. Otherwise a point of the same Doppler frequency
        would count as clutter, whose covariance over several Doppler bins does not describe it.
        Also returns where there is such a point that cannot be separated.
        """
        job, whole = self, replace(self, profile=torch.ones_like(self.profile))
        tried = sample_whitening(self.left(found), self.radar).coloured
        disturbed = torch.zeros_like(tried)
        if not bool(tried.any()):
            return job, found, disturbed
        # if the slant-range speed is wrong by lambda PRF, the residual of one point looks like
        # further points
        found = _chosen_fit(self.resolved(found, None), found, tried)
        tried = tried & sample_whitening(self.left(found), self.radar).coloured
        points, left = found.motion.each(lambda value: value.expand(tried.shape)[..., None]), whole.left(found)
        for _ in range(3):  # at most three, by choice, because each needs a search
            further = replace(whole, data=left).found(None)
            share = further.energy / left.abs().square().sum((-2, -1)).clamp_min(TINY)
            # Clutter that fills 800 Doppler cells has 0.01 of its energy in its strongest tone. A
            # point just detected in noise has 0.03.
            tried = tried & (share > 0.02)
            if not bool(tried.any()):
                break
            # By choice, such a maximum is a point rather than clutter. The second limit exceeds the
            # 0.001 of the energy of the first point that the echo model of a wide chirp does not
            # explain.
            clear = (share > 0.05) & (further.energy > 0.002 * found.energy)
            disturbed = disturbed | (tried & clear & self._overlap(found.motion, further.motion))
            points = points.each(lambda these, one: torch.cat([these, one[..., None]], -1), further.motion)
            for _ in range(2):  # the second pass uses the amplitudes at the positions found
                points, own, others, left = fitted_together(self.data, self.radar, points, self.expected, self.unknowns)
            done = tried & ~sample_whitening(left, self.radar).coloured
            found, job, tried = (
                _chosen_fit(own, found, done),
                job.or_other(replace(whole, data=job.data - others), ~done),
                tried & ~done,
            )
            disturbed = disturbed & ~done
        return job, found, disturbed

    def _overlap(self, motion: PointMotion, other: PointMotion) -> Tensor:
        """True where the Doppler frequencies of two points differ by less than eight
        Doppler cells.
        """
        doppler_hz = [(m.u_r_m_s + m.along_m_s * m.y0_m / m.range_m) / self.radar.wavelength_m for m in (motion, other)]
        return (doppler_hz[0] - doppler_hz[1]).abs() < 8.0 / self.coarse.duration_s

    def refined(self, found: Found) -> tuple[Found, Whitening]:
        """Repeat the fit up to two times with the covariance of its residual, and return fit and
        covariance.

        Trials whose residual is white noise keep their fit.
        """
        whitening = sample_whitening(self.left(found), self.radar)
        for _ in range(2):
            if not bool(whitening.coloured.any()):
                break
            found = _chosen_fit(self.fitted(found.motion, whitening), found, whitening.coloured)
            whitening = sample_whitening(self.left(found), self.radar)
        return found, whitening

    def left(self, found: Found) -> Tensor:
        """Return the data after the echo of the fitted point is subtracted."""
        time_s = self.radar.pulse_axis(self.data.shape[-1]).values(self.data.device)
        weight = self.aperture.weight(self.radar, found.motion, time_s)[..., None, :]
        return self.data - found.amplitude[..., None, None] * weight * point_phasor(
            self.radar, found.motion, time_s, self.data.dtype
        )

    def resolved(self, found: Found, whitening: Whitening | None) -> Found:
        """Choose the likeliest of the speeds in the search that differ by multiples of
        lambda PRF.
        """
        span, begin = self.radar.ambiguous_velocity_m_s, found.motion
        reach = self.search.u_r_m_s + self.search.u_r_step_m_s
        most = torch.zeros_like(found.energy)
        for number in range(-int(2 * reach / span), int(2 * reach / span) + 1):
            there = replace(begin, u_r_m_s=begin.u_r_m_s + number * span)
            rivals = self.inside(there)
            if number == 0 or not bool(rivals.any()):
                continue
            whitening = sample_whitening(self.left(found), self.radar) if whitening is None else whitening
            job, seen = self.at(rivals), whitening.at(rivals)
            own = job.fitted(begin.each(lambda value, rivals=rivals: value[rivals]), seen, 0)
            other = job.fitted(there.each(lambda value, rivals=rivals: value[rivals]), seen)
            most[rivals] = torch.maximum(own.energy, most[rivals])
            better = job.inside(other.motion) & (other.energy > most[rivals])
            most[rivals] = torch.where(better, other.energy, most[rivals])
            rivals = rivals.masked_scatter(rivals, better)
            found = found.each(lambda x, y: x.masked_scatter(_beside(rivals, x), y[better]), other)  # noqa: B023
        return found

    def at(self, trials: Tensor) -> _Job:
        """Return the job of some trials, which a bool tensor (...,) selects."""
        u_a = self.u_a_m_s.expand(trials.shape)[trials] if isinstance(self.u_a_m_s, Tensor) else self.u_a_m_s
        return replace(self, data=self.data[trials], profile=self.profile[trials], u_a_m_s=u_a)

    def fitted(self, start: PointMotion, whitening: Whitening | None, steps: int = 12) -> Found:
        """Return the fit of highest likelihood near a start."""
        return maximum_likelihood(self.data, self.radar, start, self.aperture, self.unknowns, whitening, steps)

    def inside(self, motion: PointMotion) -> Tensor:
        """True where a motion lies within the search, bool (...,)."""
        inside = motion.u_r_m_s.abs() <= self.search.u_r_m_s + self.search.u_r_step_m_s
        if "u_a_m_s" in self.unknowns:
            reach = self.search.u_a_m_s + self.search.u_a_step_m_s
            inside = inside & ((motion.u_a_m_s - self.u_a_m_s).abs() <= reach)
        return inside

    def estimate(
        self, found: Found, coloured: Tensor, disturbed: Tensor, assess: bool, whitening: Whitening | None = None
    ) -> Estimate:
        """Form the estimate, and assess it; `disturbed` is True where another point changes it."""
        found = self.resolved(found, whitening)
        if not assess:
            return estimate_of(found, None, {"coloured": coloured})
        whitening = sample_whitening(self.left(found), self.radar) if whitening is None else whitening
        half = self.search.u_r_m_s + self.search.u_r_step_m_s
        reasons = [
            (Outcome.OUTSIDE_SEARCH, ~self.inside(found.motion)),
            (Outcome.SINGULAR, ~(found.covariance[..., 0, 0].sqrt() <= half)),
            (Outcome.PARTS_DISAGREE, disturbed),
        ]
        fit = self.data, self.radar, found, self.aperture, reasons
        outcome, info = outcome_of_point(*fit, self.inside, whitening=whitening)
        return estimate_of(found, outcome, {"coloured": coloured, **info})


def _chosen_fit(a: Found, b: Found, first: Tensor) -> Found:
    """Select one of two fits per trial."""
    return a.each(lambda x, y: torch.where(_beside(first, x), x, y), b)


def _beside(trials: Tensor, x: Tensor) -> Tensor:
    """Reshape a tensor (...,), so that it has dimensions of 1 for the further dimensions of x."""
    return trials[(...,) + (None,) * (x.ndim - trials.ndim)]
