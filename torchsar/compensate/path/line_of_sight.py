"""Autofocus of a path: one line-of-sight range per pulse, which moves phases and envelopes."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.compensate.path.axes import Found, three_axes
from torchsar.compensate.path.envelopes import drift_m, matched_m, moved
from torchsar.compensate.path.fringes import roughness, smooth_near, smoothest
from torchsar.compensate.path.ground import STEP, for_each, ground_image, trials_of
from torchsar.compensate.pulse_phase.data import without_line
from torchsar.compensate.pulse_phase.imaging import Through
from torchsar.compensate.pulse_phase.pairs import pair_phase
from torchsar.compensate.pulse_phase.sharpen import Run, Weights, fixed_point, weighted
from torchsar.compensate.pulse_phase.verdict import (
    LEAST_ROWS,
    LEAST_STREHL,
    sharpness_beyond_speckle,
    sharpness_of_noise,
)
from torchsar.core import Estimate, checked_samples, cis, real_dtype
from torchsar.focus import TileOperator
from torchsar.focus.spotlight import window_weights
from torchsar.metrics import entropy, residual_phase
from torchsar.radar import LIGHT_M_S, AntennaPath
from torchsar.radar.antenna_path import refuse_unusable
from torchsar.radar.spotlight import frequency_samples, range_profiles

# share of the band in step 1, in which range cells are four times as long
_FIRST_BAND = 0.25
# share of the band with which step 1 begins in the third start
_OTHER_BAND = 0.5
# rounds of the search, which end when the line of sight changes by less, rms, in fringes
_ROUNDS, _SETTLED_FRINGES = 6, 1.0
# largest errors of the envelopes that the first, the second and the later rounds of the search
# correct, in range cells, by trial
_REACH_CELLS = (4.0, 2.0, 0.5)
# share of the band in the first, the second and the later rounds of the search
_BANDS = (0.5, 1.0, 1.0)
# roughness below which fringes are those of a smooth line of sight, and standard deviation in
# fringes of a measurement by envelopes: 0.3 to 0.6 for smooth errors, 1.0 for random walks
_ROUGH, _NEAR_FRINGES = 0.75, 2.0
# least weight of the window over pulses
_LEAST_WEIGHT = 0.1
# iterations of the fixed points, by trial, and phase step at which they end
_COARSE, _FINE, _TOLERANCE_RAD = 30, 12, 0.03
# fewest pulses
_LEAST_PULSES = 8
# factor by which the sharpness must exceed that of noise: more than for the phases of pulses, 1.5,
# because envelopes and three axes are free too
_MARGIN = 2.0
# number of standard deviations that may not lower the Strehl ratio below its limit, by choice: the
# difference of two starts is itself uncertain
_SPREAD = 1.5


def path_autofocus(
    profiles: Tensor,
    frequency_hz: Tensor,
    antennas: AntennaPath,
    *,
    extent_m: float | None = None,
    height_m: float = 0.0,
    rounds: int = 4,
) -> Estimate:
    """Estimate the error of the recorded path at each pulse, along and across the line of sight.

    The recommended autofocus of antennas on any path, for spotlight scenes. The phase of a pulse
    gives its error along the line of sight modulo a fringe, half a wavelength; the envelope of its
    range profile shows how many fringes the error has. The steps are:

    1. The phases of the pulses are found in a quarter of the band, where errors of the envelopes
       matter little. They start from the phases between adjacent pulses (`sca`); iterations through
       the image formation and its adjoint then sharpen the image.
    2. Phases become ranges. If their second differences show a smooth motion, its fringes follow
       from the phases; otherwise each pulse takes the range at which its envelope and its phase
       match the sharpened image best. This is repeated in up to six rounds with half and then all
       of the band, in which the envelopes are corrected too.
    3. Envelopes may still drift slowly against the phases. The drift is the polynomial of time of
       least image entropy at unchanged phases of the carrier; it is added in whole fringes.
    4. The phases of each pulse in nine blocks of the image, without windows and relative to an
       estimate of the scene, refine the line of sight. Errors across it, which act differently over
       the scene, are fitted with a ridge, for which they are supposed to have the spectrum of the
       motion along the line of sight.
    5. Step 4 is repeated from another start: phases of the whole band, with envelopes at rest; and
       from a third one, half of the band in step 1, if the results differ. The sharpest image
       counts.

    Not observable are a constant and a linear term, which move the image; they are zero in the
    result. Where the errors are rough from pulse to pulse, fringes follow from single envelopes and
    are partly wrong; the result then holds modulo half a wavelength. Trials have image plans of
    their own and are processed one after another.

    Args:
        profiles: Range profiles, the unitary centred inverse FFT of a phase history, shape (...,
            pulse, range), complex. Pulses that hold only zeros are left out; their errors are
            interpolated.
        frequency_hz: Frequencies in Hz, rising in equal steps, float64 (range,).
        antennas: Recorded path of the antennas, of all trials or of each of them. The scene is
            about the origin.
        extent_m: Side of the imaged square about the origin in metres, which should hold most of
            the scatterers; by default that of the whole unambiguous ground, which takes longer.
        height_m: Height z of the imaged plane in metres.
        rounds: Rounds of step 4, at least 1.

    Returns:
        `line_of_sight_m` of shape (..., pulse), float64: half the path over the middle of the scene
        in metres, recorded minus true; and `offset_m` of shape (..., pulse, 3): the error of the
        positions in metres, recorded minus true, of both antennas alike, for `CorrectPath`. The
        standard deviation, of `line_of_sight_m` only, is that modulo half a wavelength; it follows
        from what a Wiener estimate of the scene leaves of the samples, and from the difference
        from the nearest result of another start. `quality` is the Strehl ratio predicted from it,
        times the share of the sharpness that noise does not explain. Sharpness is the amount by
        which the image entropy lies below that of speckle. `ok` is False unless the image is twice
        as sharp as autofocus can make pure noise, more than one range cell contributes to the
        sharpness, and the Strehl ratio for 1.5 standard deviations exceeds 0.8; it does not say
        whether fringes are right. It is False for fewer than 8 pulses with samples. `info` holds
        "roughness" (see `roughness`: about 1 if the fringes come from single envelopes, less for
        smooth motions) and "entropy_nats" of the image, shape (...,).

    Raises:
        TypeError: If the profiles are not complex, or frequencies are not float64.
        ValueError: If sizes do not match, values are not finite, the line of sight does not turn,
            the extent is not positive, or there is no round.
    """
    profiles = checked_samples(profiles, "path_autofocus", "pulse, range")
    refuse_unusable(frequency_hz=frequency_hz)
    trials = trials_of("path_autofocus", profiles, frequency_hz, antennas)
    if extent_m is not None and not 0 < extent_m < math.inf:
        raise ValueError(f"extent_m must be positive and finite, got {extent_m}")
    if rounds < 1:
        raise ValueError(f"path_autofocus needs at least one round, got rounds={rounds}")

    @torch.no_grad()
    def find(rows: Tensor, one: AntennaPath) -> Estimate:
        operator = ground_image(frequency_hz, one, height_m, extent_m)
        found = _nothing(rows)
        present = (rows.real.square() + rows.imag.square()).sum(-1) > 0
        if int(present.sum()) >= _LEAST_PULSES:
            if not bool(present.all()):
                operator = ground_image(frequency_hz, _only(one, present), height_m, extent_m)
            some = rows[present]
            some = some / some.abs().amax()
            found = _Search(some, frequency_hz, operator, rounds).judged()
            found = _spread(found, present)
        return found

    return for_each(find, profiles, antennas, trials)


def _only(antennas: AntennaPath, present: Tensor) -> AntennaPath:
    """The path of the pulses that are present."""
    receiver = None if antennas.receiver_m is None else antennas.receiver_m[present]
    return AntennaPath(antennas.transmitter_m[present], receiver, antennas.reference_m[present])


def _nothing(rows: Tensor) -> Estimate:
    """The estimate of a trial with too few pulses."""
    zero = torch.zeros(len(rows), dtype=torch.float64, device=rows.device)
    none = zero.new_zeros(())
    info = {"roughness": none + 1, "entropy_nats": none}
    value = {"line_of_sight_m": zero, "offset_m": zero[:, None].expand(-1, 3)}
    return Estimate(value, none, none > 0, {"line_of_sight_m": zero + 1}, info)


def _spread(found: Estimate, present: Tensor) -> Estimate:
    """The estimate of all pulses from that of those which are present."""
    at = present.nonzero()[:, 0]
    every = torch.arange(len(present), device=present.device)
    high = torch.searchsorted(at, every).clamp(1, len(at) - 1)
    share = ((every - at[high - 1]) / (at[high] - at[high - 1])).clamp(0, 1).double()

    def of(x: Tensor) -> Tensor:
        part = share.reshape(-1, *(1,) * (x.ndim - 1))
        return x[high - 1] * (1 - part) + x[high] * part

    value = {name: of(x) for name, x in found.value.items()}
    return Estimate(value, found.quality, found.ok, {name: of(x) for name, x in found.std.items()}, found.info)


def _intensity(power: Tensor, mean: Tensor) -> Tensor:
    """Weights of image cells that sharpen by the sum of the squared intensity."""
    return power / mean


def _surprise(power: Tensor, mean: Tensor) -> Tensor:
    """Weights of image cells that sharpen by the entropy, of those that are above its level."""
    share = power / (mean * (power.shape[-1] * power.shape[-2]))
    log = torch.log(share.clamp_min(torch.finfo(share.dtype).tiny))
    return (log - (share * log).sum((-2, -1), keepdim=True)).clamp_min(0)


# what a search sharpens by, iterations and phase step at which they end
_BOTH: list[tuple[Weights, int, float]] = [
    (_intensity, _COARSE, _TOLERANCE_RAD),
    (_surprise, _FINE, _TOLERANCE_RAD),
]


@dataclass(frozen=True, eq=False)
class _Search:
    """The search of one trial.

    Args:
        rows: Range profiles of the pulses that are present, (pulse, range).
        frequency_hz: Frequencies.
        imaging: Image formation along their recorded path.
        rounds: Rounds of the last step.
    """

    rows: Tensor
    frequency_hz: Tensor
    imaging: TileOperator
    rounds: int

    @property
    def _fringe_m(self) -> float:
        return LIGHT_M_S / (2 * float(self.frequency_hz.mean()))

    def metres(self, phase_rad: Tensor) -> Tensor:
        """Range that has a phase."""
        return phase_rad.double() * (self._fringe_m / (2 * math.pi))

    def line_free(self, range_m: Tensor) -> Tensor:
        """Ranges without constant and linear terms."""
        return without_line(range_m, torch.ones_like(range_m, dtype=torch.bool))

    def windowed(self, share: float) -> Tensor:
        """Profiles with Hann windows over pulses and over a share of the band."""
        pulses, n = self.rows.shape
        real = real_dtype(self.rows.dtype)
        k = torch.linspace(-1, 1, n, dtype=torch.float64, device=self.rows.device) / share
        over_band = torch.where(k.abs() < 1, (1 + torch.cos(math.pi * k)) / 2, 0).to(real)
        over_pulses = window_weights("hann", pulses, self.rows.device).to(real).clamp_min(_LEAST_WEIGHT)
        samples = frequency_samples(self.rows) * (over_pulses[:, None] * over_band)
        return range_profiles(samples)

    def sharpened(
        self, rows: Tensor, range_m: Tensor, runs: list[tuple[Weights, int, float]], start: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Phases that sharpen the image of rows at a line of sight, and the corrected rows."""
        at = moved(rows, self.frequency_hz, range_m)
        columns = at.mT[None].contiguous()
        phase = torch.zeros_like(columns[:, 0].real) if start is None else start[None]
        for weights, count, tolerance in runs:
            phase = fixed_point(columns, phase, Run(weights, Through(self.imaging), count, 1.0, tolerance))[0]
        return phase[0], at

    def by_phases(self) -> Tensor:
        """Line of sight within a fringe: phases that sharpen the image, with envelopes at rest."""
        rows, rest = self.windowed(1.0), torch.zeros(len(self.rows), dtype=torch.float64, device=self.rows.device)
        return self.metres(self.sharpened(rows, rest, _BOTH, self.adjacent(rows))[0])

    def adjacent(self, rows: Tensor) -> Tensor:
        """Phases of the pulses from those between adjacent pulses, (pulse,)."""
        columns = rows.mT[None]
        return pair_phase(columns, torch.ones_like(columns[:, 0].real, dtype=torch.bool))[0]

    def by_envelopes(self, first_band: float) -> tuple[Tensor, Tensor]:
        """Line of sight with whole fringes before the last step, and its roughness.

        first_band: Share of the band in which the first phases are found.
        """
        cell = LIGHT_M_S / (2 * float(self.frequency_hz[-1] - self.frequency_hz[0]))
        range_m = torch.zeros(len(self.rows), dtype=torch.float64, device=self.rows.device)
        rows = self.windowed(first_band)
        phase, _ = self.sharpened(rows, range_m, _BOTH, self.adjacent(rows))
        carrier = self.metres(phase)
        rough = roughness(carrier, self._fringe_m)
        if rough < _ROUGH:
            range_m, phase = self.line_free(smoothest(carrier, self._fringe_m)), None
        for turn in range(_ROUNDS):
            share, reach = _BANDS[min(turn, 2)], _REACH_CELLS[min(turn, 2)]
            rows, before = self.windowed(share), range_m
            phase, at = self.sharpened(rows, range_m, _BOTH, phase)
            rough = roughness(range_m + self.metres(phase), self._fringe_m)
            if share < 1 and rough >= _ROUGH:
                continue
            range_m, phase = self.with_envelopes(range_m, phase, at, reach * cell, rough), None
            if share == 1:
                rows = moved(rows, self.frequency_hz, range_m)
                drift = drift_m(rows, self.frequency_hz, self.imaging, slopes=turn == 1)
                range_m = range_m + self._fringe_m * torch.round(drift / self._fringe_m)
            range_m = self.line_free(range_m)
            if turn > 1 and (range_m - before).square().mean().sqrt() < _SETTLED_FRINGES * self._fringe_m:
                break
        return range_m, rough

    def with_envelopes(self, range_m: Tensor, phase: Tensor, at: Tensor, reach_m: float, rough: Tensor) -> Tensor:
        """Line of sight at which envelopes and phases match the image that phases sharpen."""
        turned = at * cis(-phase)[:, None]
        model = self.imaging.adjoint(weighted(self.imaging.image(turned[None]), _surprise))[0]
        whole = moved(self.rows, self.frequency_hz, range_m)
        near = range_m + matched_m(whole, model, self.frequency_hz, reach_m)
        if rough >= _ROUGH:
            return near
        carrier = range_m + self.metres(phase)
        bends = rough * (self._fringe_m / math.sqrt(12))
        near_std = _NEAR_FRINGES * self._fringe_m
        return smooth_near(carrier[None], near[None], self._fringe_m, near_std, bends[None])[0]

    def refined(self, range_m: Tensor) -> Found:
        """The last step from a start."""
        return three_axes(self.rows, self.imaging, range_m, self.rounds)

    def nearest(self, found: list[Found]) -> tuple[Found, Tensor]:
        """The result of the sharpest image, and the standard deviation of its line of sight (m).

        The latter contains the difference from the nearest other result. All have the errors by
        noise in common; what differs comes from the search.
        """
        best, *others = sorted(found, key=lambda one: float(entropy(one.image)))
        radians = 2 * math.pi / self._fringe_m
        apart = [residual_phase(radians * best.line_of_sight_m, radians * one.line_of_sight_m) for one in others]
        least = torch.stack([x.square().mean() for x in apart]).amin() / radians**2
        return best, (best.std_m.square() + least / 2).sqrt()

    def strehl(self, std_m: Tensor) -> Tensor:
        """Strehl ratio for a standard deviation of the line of sight."""
        return torch.exp(-(std_m * (2 * math.pi / self._fringe_m)).square().mean())

    def judged(self) -> Estimate:
        """The estimate of the sharpest image with three axes, and its verdict."""
        range_m, rough = self.by_envelopes(_FIRST_BAND)
        results = [self.refined(range_m), self.refined(self.by_phases())]
        found, std_m = self.nearest(results)
        if self.strehl(_SPREAD * std_m) <= LEAST_STREHL:
            results.append(self.refined(self.by_envelopes(_OTHER_BAND)[0]))
            found, std_m = self.nearest(results)
        sharp, effective, telling = sharpness_beyond_speckle(found.image.mT)
        noise = sharpness_of_noise((effective * STEP).clamp_min(1))
        quality = self.strehl(std_m) * (1 - (noise / sharp.clamp_min(1e-12)).clamp(0, 1))
        ok = (sharp > _MARGIN * noise) & (telling > LEAST_ROWS) & (self.strehl(_SPREAD * std_m) > LEAST_STREHL)
        value = {"line_of_sight_m": found.line_of_sight_m, "offset_m": found.offset_m}
        info = {"roughness": rough, "entropy_nats": entropy(found.image).double()}
        return Estimate(value, quality, ok, {"line_of_sight_m": std_m}, info)
