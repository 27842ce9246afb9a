"""Autofocus of a strip: slow errors of the path from the phases of prominent scatterers."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor
from torch.nn.functional import normalize

from torchsar.compensate.path import assess as assessment
from torchsar.compensate.path.ground import ERROR_DB, corrected, for_each, nothing, slope, trials_of
from torchsar.compensate.path.joint import cosines, expected_power
from torchsar.compensate.path.line_of_sight import _PathEstimator
from torchsar.compensate.path.scatterers import Echoes, prominent_places
from torchsar.compensate.pulse_phase.data import or_one, without_line
from torchsar.core import Estimate, Outcome, cis, differentiable
from torchsar.focus import ImageGrid, ProcessedBeam, TilePlan
from torchsar.focus.image_grid import level_plane
from torchsar.focus.spotlight import window_weights
from torchsar.radar import LIGHT_M_S, AntennaPath, StraightTrack
from torchsar.radar.spotlight import frequency_samples


@differentiable("no")
def strip_autofocus(
    profiles: Tensor,
    frequency_hz: Tensor,
    antennas: AntennaPath,
    *,
    azimuth_m: float,
    range_m: float,
    beam_deg: float,
    centre_m: tuple[float, float] = (0.0, 0.0),
    range_axis_rad: float = 0.0,
    height_m: float = 0.0,
    squint_deg: float = 0.0,
    assess: bool = True,
) -> Estimate:
    """Estimate the slow errors of the recorded path of a strip.

    >>> import torch
    >>> from torchsar.compensate import strip_autofocus
    >>> from torchsar.radar import AntennaPath
    >>> y = torch.linspace(-20, 20, 64, dtype=torch.float64)
    >>> place_m = torch.stack([0 * y - 290, y, 0 * y + 75], -1)
    >>> path = AntennaPath(place_m, None, 2 * place_m.norm(dim=-1))
    >>> frequency_hz = 9.6e9 + 1e7 * torch.arange(-8, 8, dtype=torch.float64)
    >>> profiles = torch.zeros(64, 16, dtype=torch.complex64)
    >>> strip = {"azimuth_m": 20.0, "range_m": 10.0, "beam_deg": 4.0}
    >>> found = strip_autofocus(profiles, frequency_hz, path, **strip)
    >>> found["offset_m"].shape, bool(found.ok)  # nothing is seen in zeros
    (torch.Size([64, 3]), False)

    The recommended autofocus of strips, in which a beam sees each scatterer for a part of the
    pulses. Prominent scatterers are found in the image, up to 300. Each gives a phase per pulse
    while it is seen, which contains the error of the path, a constant by its own phase, and terms
    by its place: its azimuth is free, its range is known from the image to some hundredths of a
    range cell. All phases together give the error of the path in two axes, along the line of sight
    abeam and across it and the track, as a sum of cosines of up to 16 periods while a scatterer is
    seen. The steps are:

    1. Increments of the phases over some pulses give a first motion along the line of sight, of any
       number of fringes. The scatterers are found again in the image with this motion removed.
    2. The phases themselves give the most probable motion. Its cosines have a Gaussian prior; their
       variances follow from the motion along the line of sight, and serve for both axes. The echoes
       of other scatterers at the same range are subtracted, and each scatterer counts as far as its
       echo exceeds what is left.

    Slow errors are the least certain: over the time that a scatterer is seen they are lines, which
    displace it, and curves, which a displacement in range would cause as well. Not observable are a
    constant and a linear term of the whole strip. Errors along the track are not estimated. Trials
    have image plans of their own and are processed one after another.

    Args:
        profiles: Range profiles, the unitary centred inverse FFT of a phase history, shape (...,
            pulse, range), complex. Pulses that hold only zeros are left out.
        frequency_hz: Frequencies in Hz, rising in equal steps, float64 (range,).
        antennas: Recorded path of the antennas, of all trials or of each of them.
        azimuth_m: Extent of the imaged strip along its azimuth axis in metres.
        range_m: Extent along its range axis in metres.
        beam_deg: Width of the beam in degrees, see `ProcessedBeam`.
        centre_m: Position of the centre in metres along (range axis, azimuth axis).
        range_axis_rad: Direction of the range axis in rad, from ground coordinate x towards y; the
            azimuth axis is a quarter turn further.
        height_m: Height z of the imaged plane in metres.
        squint_deg: Angle of the middle of the beam ahead of broadside in degrees.

        assess: Whether to add the standard deviation, the quality and the outcome.

    Returns:
        `line_of_sight_m` of shape (..., pulse), float64: half the path over the middle of the strip
        abeam of the antenna in metres, recorded minus true; and `offset_m` of shape (..., pulse,
        3): the error of the positions in metres, recorded minus true, of both antennas alike, for
        `CorrectPath`. `info` holds "scatterers", their number, shape (...,).
        The assessment adds the standard deviation of `line_of_sight_m`, which follows from the
        noise of the phases and the prior, without constant and linear terms over the pulses that
        see the strip; `quality` is the Strehl ratio predicted from it. The outcome is NOISE where
        no scatterer exceeds clutter; TOO_FEW for fewer than 3 prominent scatterers, or fewer than
        95 % of these pulses that see one; NOT_CONVERGED where the last round changed the motion by
        a standard deviation; and INEXACT where the Strehl ratio for 1.5 standard deviations is
        below 0.8.

    Raises:
        TypeError: If the profiles are not complex, or frequencies are not float64.
        ValueError: If sizes do not match, values are not finite, an extent is not positive, the
            beam is not valid (see `ProcessedBeam`), the antenna does not advance, or no pulse sees
            the strip.
    """
    trials = trials_of("strip_autofocus", profiles, frequency_hz, antennas)
    numbers = (azimuth_m, range_m, *centre_m, range_axis_rad, height_m)
    if not (all(map(math.isfinite, numbers)) and azimuth_m > 0 and range_m > 0):
        raise ValueError(
            f"strip_autofocus needs finite numbers and positive extents, got azimuth_m={azimuth_m}, range_m={range_m}, "
            f"centre_m={tuple(centre_m)}, range_axis_rad={range_axis_rad}, height_m={height_m}"
        )
    beam = ProcessedBeam(beam_deg, squint_deg)
    axes, middle = level_plane(range_axis_rad, centre_m[1], centre_m[0], height_m, profiles.device)

    @torch.no_grad()
    def find(rows: Tensor, one: AntennaPath) -> Estimate:
        strip = Strip.of(rows, frequency_hz, one, beam, axes, middle, (azimuth_m, range_m))
        outcome = Outcome.NOISE if bool((rows != 0).any()) else Outcome.EMPTY
        none = nothing(strip.judged, {"scatterers": 0.0}, outcome if assess else None)
        for _ in range(3):
            after = strip.with_increments()
            if after is None:
                return none
            change, strip = strip.changed_m2(after), after
            if change.sqrt() < 0.15 * strip.fringe_m:
                break
        # Increments determine slow errors best. The prior spectrum from them would suppress fast
        # errors, so that the first prior is flat.
        size = strip.line_free(strip.motion_m[:, 0])[strip.judged].square().mean()
        power = torch.full_like(strip.basis[:2], float(size) * strip.basis.shape[0] / strip.basis.shape[1])
        free = torch.stack([strip.line_free(cosine) for cosine in strip.basis.mT], -1)
        change, std, echoes = size, torch.zeros_like(free[:, 0]), None
        for _ in range(4):
            fitted = strip.fitted(power)
            if fitted is None:
                return none
            after, covariance, power, echoes = fitted
            # standard deviation over the judged pulses, without the constant and linear part
            std = ((free @ covariance) * free).sum(-1).clamp_min(0).sqrt()
            change, strip = strip.changed_m2(after), after
            if change < 0.3**2 * std[strip.judged].square().mean():
                break
        assert echoes is not None
        value = {"line_of_sight_m": strip.line_free(strip.motion_m[:, 0]), "offset_m": strip.offset_m}
        count = size.new_tensor(float(len(echoes.seen)))
        found = Estimate(value, quality=torch.ones_like(count), info={"scatterers": count})
        seen = echoes.pulses[echoes.seen]
        return assessment.of_strip(found, strip.judged, strip.fringe_m, seen, std, change) if assess else found

    return for_each(find, profiles, antennas, trials)


class StripAutofocus(_PathEstimator):
    """Slow errors of the recorded path of a strip; see `strip_autofocus`.

    Args:
        azimuth_m: Extent of the imaged strip along its azimuth axis in metres.
        range_m: Extent along its range axis in metres.
        beam_deg: Width of the beam in degrees, see `ProcessedBeam`.
        centre_m: Position of the centre in metres along (range axis, azimuth axis).
        range_axis_rad: Direction of the range axis in rad, from ground coordinate x towards y.
        height_m: Height z of the imaged plane in metres.
        squint_deg: Angle of the middle of the beam ahead of broadside in degrees.
        assess: Whether to add the standard deviation, the quality and the outcome.
    """

    provides = ("line_of_sight_m", "offset_m")
    neutral = {"line_of_sight_m": 0.0, "offset_m": 0.0}
    find = staticmethod(strip_autofocus)
    not_estimated = (
        "errors of the path along the track, such as of its speed, which defocus the image where they are large (see "
        "`requires`), and a constant and a linear term over the strip, which shift and shear the image"
    )
    """Errors that the estimate does not contain, and about which its outcome says nothing."""

    def __init__(
        self,
        azimuth_m: float,
        range_m: float,
        beam_deg: float,
        centre_m: tuple[float, float] = (0.0, 0.0),
        range_axis_rad: float = 0.0,
        height_m: float = 0.0,
        squint_deg: float = 0.0,
        assess: bool = True,
    ) -> None:
        super().__init__(
            azimuth_m=azimuth_m,
            range_m=range_m,
            beam_deg=beam_deg,
            centre_m=(centre_m[0], centre_m[1]),
            range_axis_rad=range_axis_rad,
            height_m=height_m,
            squint_deg=squint_deg,
            assess=assess,
        )


@dataclass(frozen=True, eq=False)
class Strip:
    """Data, settings and present motion of one trial of `strip_autofocus`.

    Args:
        history: Phase history, complex (pulse, frequency).
        frequency_hz: Frequencies in Hz, float64 (frequency,).
        weights: Weights of the frequencies, whose sum is 1, float64 (frequency,).
        recorded: Recorded path.
        beam: The beam.
        axes: Along the line of sight abeam, scaled so that a unit changes half the path by one, and
            across it and the track, (pulse, 2, 3).
        grid: Pixels of the image in which scatterers are found.
        cells: Pixels of a resolution cell along either axis.
        judged: True for the pulses that see the strip and hold samples, (pulse,).
        basis: Cosines of which motions consist, float64 (pulse, cosine).
        motion_m: Errors found so far along the axes in metres, float64 (pulse, 2).
    """

    history: Tensor
    frequency_hz: Tensor
    weights: Tensor
    recorded: AntennaPath
    beam: ProcessedBeam
    axes: Tensor
    grid: ImageGrid
    cells: tuple[float, float]
    judged: Tensor
    basis: Tensor
    motion_m: Tensor

    @staticmethod
    def of(
        rows: Tensor,
        frequency_hz: Tensor,
        antennas: AntennaPath,
        beam: ProcessedBeam,
        ground: Tensor,
        middle_m: Tensor,
        extent_m: tuple[float, float],
    ) -> Strip:
        place, pulses = antennas.places[-1], antennas.pulses
        track = StraightTrack.fitted(place)
        points = track.abeam_m(place, middle_m)
        sight = slope(antennas.places, points)
        across = normalize(torch.linalg.cross(sight, track.along.expand_as(sight), dim=-1), dim=-1)
        axes = torch.stack([sight / sight.square().sum(-1, keepdim=True), across], 1)
        # a scatterer outside of the strip is illuminated together with those inside
        away = torch.linalg.vector_norm(place - points, dim=-1).mean()
        footprint = float(away) * (math.tan(math.asin(beam.edges[1])) - math.tan(math.asin(beam.edges[0])))
        wavelength = LIGHT_M_S / float(frequency_hz.mean())
        steep = 2 * float((sight @ ground[1]).abs().mean())
        cells = (
            wavelength / (len(antennas.places) * beam.band),
            LIGHT_M_S / (float(frequency_hz[-1] - frequency_hz[0]) * max(steep, 1e-3)),
        )
        step = min(cells[0], cells[1] / 2)
        size = extent_m[0] + footprint, extent_m[1]
        counts = tuple(max(3, math.ceil(x / step)) for x in size)
        corner = middle_m - step * sum(n // 2 * axis for n, axis in zip(counts, ground, strict=True))
        grid = ImageGrid(corner, ground, (counts[0], counts[1]), step)
        sides = ground.new_tensor([[-0.5, -0.5], [-0.5, 0.5], [0.5, -0.5], [0.5, 0.5]]) * ground.new_tensor(extent_m)
        ends = beam.lit_pulses(place, middle_m + sides @ ground)
        number = torch.arange(pulses, device=rows.device)
        judged = (number >= ends[:, 0].amin()) & (number < ends[:, 1].amax())
        if not bool(judged.any()):
            raise ValueError("no pulse sees the strip within the beam; check its centre, extents and the squint")
        seen = beam.lit_pulses(place, points[pulses // 2][None])
        per = max(1, int(seen[0, 1] - seen[0, 0]))
        # 16 periods of the fastest cosine while a scatterer is illuminated, by choice
        count = max(1, min(pulses - 2, 512, math.ceil(32 * pulses / per)))
        weights = window_weights("hann", len(frequency_hz), rows.device)
        return Strip(
            frequency_samples(rows),
            frequency_hz,
            weights / weights.sum(),
            antennas,
            beam,
            axes,
            grid,
            (cells[0] / step, cells[1] / step),
            judged & (rows != 0).any(-1),
            cosines(pulses, count, rows.device),
            torch.zeros(pulses, 2, dtype=torch.float64, device=rows.device),
        )

    @property
    def fringe_m(self) -> float:
        """Half a wavelength in metres."""
        return LIGHT_M_S / (2 * float(self.frequency_hz.mean()))

    @property
    def offset_m(self) -> Tensor:
        """Errors of the positions in metres, (pulse, 3)."""
        return (self.motion_m[:, None] @ self.axes)[:, 0]

    def changed_m2(self, after: Strip) -> Tensor:
        """Mean square change of the line of sight by another round, in square metres."""
        return self.line_free((after.motion_m - self.motion_m)[:, 0])[self.judged].square().mean()

    def line_free(self, range_m: Tensor) -> Tensor:
        """Ranges (pulse,) without constant and linear terms over the judged pulses."""
        return without_line(range_m, self.judged)

    def echoes(self) -> tuple[Echoes, Curve] | None:
        """Echoes of the prominent scatterers, and their phases; None if there are too few."""
        antennas = corrected(self.recorded, self.offset_m)
        lit = partial(self.beam.lit_pulses, antennas.places[-1])
        places = antennas.transmitter_m, antennas.receiver_m, antennas.reference_m
        weight = partial(self.beam.pulse_weights, antennas.places[-1])
        plan = TilePlan(self.frequency_hz, *places, self.grid, ERROR_DB, lit, weight, images=None)
        image = plan.image(self.history * self.weights.to(self.history.real.dtype))
        found = prominent_places(image, self.grid, self.cells, 300)
        if len(found) < assessment.LEAST_SCATTERERS:
            return None
        echoes = Echoes.of(self.history, self.frequency_hz, self.weights, antennas, found, lit)
        lever = echoes.wave * (echoes.slope[..., None, :] * self.axes[echoes.pulses]).sum(-1)
        # derivative of half the path by displacements along the slope of the range and across it
        ground = echoes.slope @ self.grid.axes.mT
        mean = _mean(ground, echoes.seen)
        steep = torch.linalg.vector_norm(mean, dim=-1, keepdim=True)
        along = mean / or_one(steep)
        across = torch.stack([-along[..., 1], along[..., 0]], -1)
        moved = torch.stack([((ground - mean) * way).sum(-1) for way in (along, across)], -1)
        own = torch.cat([torch.ones_like(moved[..., :1]), echoes.wave * moved], -1)
        return echoes, Curve(self.basis, echoes.pulses, lever, own)

    def with_increments(self) -> Strip | None:
        """The strip with the motion that follows from the increments of the phases."""
        found = self.echoes()
        if found is None:
            return None
        echoes, curve = found
        # the lag of an increment, and the length of the mean of echoes before it, are a 64th of the
        # pulses, by trial
        seen = echoes.seen.shape[1]
        lag, near = max(1, round(seen / 64)), 2 * round(seen / 128) + 1
        smooth = _smooth(echoes.samples, near) * echoes.seen
        left = (echoes.samples - smooth) * echoes.seen
        noise = _mean(left.abs().square()[..., None], echoes.seen)[..., 0] / near
        turn = smooth[:, lag:] * smooth[:, :-lag].conj()
        mean = turn.sum(1, keepdim=True)
        turn = turn * (mean.conj() / or_one(mean.abs()))
        ratio = turn.abs() / or_one(noise)
        weight = torch.where(ratio > 1, ratio.square() / (ratio + 0.5), 0.0)
        half = lag // 2
        steps = torch.zeros_like(self.basis)
        steps[half : len(steps) - lag + half] = self.basis[lag:] - self.basis[:-lag]
        at = slice(half, half + turn.shape[1])
        of_steps = Curve(steps, echoes.pulses[:, at], curve.lever[:, at, :1], curve.own[:, at, :1])
        power = torch.full_like(self.basis[:1], self.fringe_m**2 * self.basis.shape[0] / self.basis.shape[1])
        free = torch.zeros_like(weight[:, :1])
        along = self.basis @ of_steps.solved(turn.angle(), weight, power, free)[0][0]
        return replace(self, motion_m=self.motion_m + torch.nn.functional.pad(along[:, None], (0, 1)))

    def fitted(self, power: Tensor) -> tuple[Strip, Tensor, Tensor, Echoes] | None:
        """The strip with the most probable motion, the covariance of its cosines along the line of
        sight, the power of its cosines, and the echoes.
        """
        found = self.echoes()
        if found is None:
            return None
        echoes, curve = found
        # mean over an eighth of the pulses, by trial
        near = 2 * round(echoes.seen.shape[1] / 16) + 1
        # the phases are those along the corrected path; the phase of the motion found so far is
        # added again
        before = curve.phase(self.motion_m)
        steep = torch.linalg.vector_norm(_mean(echoes.slope @ self.grid.axes.mT, echoes.seen), dim=-1)[:, 0]
        cell = LIGHT_M_S / (2 * float(self.frequency_hz[-1] - self.frequency_hz[0]))
        turned = torch.zeros_like(before)
        model = torch.zeros_like(echoes.samples)
        gain, motion, covariance = echoes.seen.double(), self.motion_m, torch.zeros_like(power)
        for _ in range(6):
            alone = (echoes.samples - echoes.crossed(model)) * cis(-turned) * echoes.seen
            mean = (alone * gain).sum(1, keepdim=True)
            way = mean / or_one(mean.abs())
            alone = alone * way.conj()
            gain = _smooth(alone.real, near).clamp_min(0) * echoes.seen
            model = way * gain * cis(turned)
            noise = _mean((alone - gain).abs().square()[..., None], echoes.seen)[..., 0]
            faded = gain < 0.2 * gain.amax(1, keepdim=True)
            weight = torch.where(faded, 0.0, 2 * gain.square() / or_one(noise))
            phase = torch.where(faded, 0.0, alone.imag / or_one(gain))
            # The range of a scatterer is known from the image: to 0.07 cells in clutter, by trial,
            # and to 0.7 over the root of the SNR in noise. Its phase and azimuth are free.
            spread = cell**2 * (0.07**2 + 0.7**2 / or_one(weight.sum(1) / 2))
            known = torch.stack([torch.zeros_like(spread), steep.square() / spread, torch.zeros_like(spread)], -1)
            coefficient, covariance, own = curve.solved(phase + turned + before, weight, power, known)
            motion, covariance = self.basis @ coefficient.mT, covariance[: power.shape[1], : power.shape[1]]
            turned = curve.phase(motion) - before + own
            power = expected_power(coefficient[0].square() + covariance.diagonal()).expand(2, -1)
        return replace(self, motion_m=motion), covariance, power, echoes


def _smooth(x: Tensor, length: int) -> Tensor:
    """Mean over an odd number of neighbours along the last dimension, with the ends repeated."""
    if x.is_complex():
        return torch.complex(_smooth(x.real, length), _smooth(x.imag, length))
    padded = torch.nn.functional.pad(x[:, None], (length // 2, length // 2), mode="replicate")
    return torch.nn.functional.avg_pool1d(padded, length, 1)[:, 0]


def _mean(x: Tensor, seen: Tensor) -> Tensor:
    """Mean of x (scatterer, seen, term) over the pulses that illuminate a scatterer, (scatterer, 1,
    term).
    """
    return (x * seen[..., None]).sum(1, keepdim=True) / or_one(seen.sum(1).to(x.dtype))[:, None, None]


@dataclass(frozen=True, eq=False)
class Curve:
    """Phases of scatterers as functions of a motion, which is a sum of cosines.

    The phase of a scatterer is that of the motion of the antennas, plus terms of its own: a
    constant, and displacements of its place.

    Args:
        basis: Cosines, float64 (pulse, cosine).
        pulses: Numbers of the pulses that see each scatterer, int64 (scatterer, seen).
        lever: Change of the phase by a motion along each axis in rad per metre, float64 (scatterer,
            seen, axis).
        own: Change of the phase by the terms of the scatterer, float64 (scatterer, seen, term).
    """

    basis: Tensor
    pulses: Tensor
    lever: Tensor
    own: Tensor

    def phase(self, motion_m: Tensor) -> Tensor:
        """Phase in rad of a motion (pulse, axis), float64 (scatterer, seen)."""
        return (self.lever * motion_m[self.pulses]).sum(-1)

    def solved(self, phase: Tensor, weight: Tensor, power: Tensor, known: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the most probable motion and terms of the scatterers.

        The coefficients of the motion and the terms of the scatterers are independent and Gaussian.

        Args:
            phase: Measured phases in rad, float64 (scatterer, seen).
            weight: Inverse variances of their errors, float64 (scatterer, seen).
            power: Expected power of the coefficients in square metres, float64 (axis, cosine).
            known: Inverse variances of the terms of the scatterers, whose mean is zero, float64
                (scatterer, term).

        Returns:
            Coefficients of the motion, float64 (axis, cosine); their covariance, float64 (axis *
            cosine, axis * cosine); and the phase that the terms of each scatterer add, float64
            (scatterer, seen).
        """
        # ridge: relative increase of the information, so that rounding does not make it singular
        axes, count, ridge = *power.shape, 1e-9
        pull = weight[..., None] * self.own
        normal = pull.mT @ self.own
        seen = normal.diagonal(dim1=-2, dim2=-1)  # zero for a scatterer that no pulse illuminates
        raised = torch.where(seen > 0, ridge * seen + known, 1.0)
        inverse = torch.linalg.inv(normal + torch.diag_embed(raised))
        own = (pull.mT @ phase[..., None])[..., 0]
        weighted, at = weight[..., None] * self.lever, self.pulses.flatten()
        share, drive = (
            phase.new_zeros(len(self.basis), *x.shape[2:]).index_add_(0, at, x.flatten(0, 1))
            for x in (weighted[..., None] * self.lever[..., None, :], weighted * phase[..., None])
        )
        whole = torch.einsum("pm,pik,pn->imkn", self.basis, share, self.basis).reshape(axes * count, -1)
        whole.diagonal().mul_(1 + ridge)
        cross = torch.cat([self._through(pull * self.lever[..., i : i + 1]) for i in range(axes)], -1)
        tied = inverse @ cross
        whole = whole - cross.flatten(0, 1).mT @ tied.flatten(0, 1) + torch.diag(1 / power.flatten())
        right = (self.basis.mT @ drive).mT.flatten() - tied.flatten(0, 1).mT @ own.flatten()
        factor = torch.linalg.cholesky(whole)
        found = torch.cholesky_solve(right[:, None], factor)[:, 0]
        terms = (inverse @ own[..., None])[..., 0] - tied @ found
        added = (self.own @ terms[..., None])[..., 0]
        return found.reshape(axes, count), torch.cholesky_inverse(factor), added

    def _through(self, terms: Tensor) -> Tensor:
        """Products of terms (scatterer, seen, term) with the cosines, (scatterer, term, cosine),
        for 16 scatterers at a time.
        """
        parts = zip(terms.split(16), self.pulses.split(16), strict=True)
        return torch.cat([term.mT @ self.basis[pulses] for term, pulses in parts])
