"""Search for the line of sight of each pulse: by its phase, and by its envelope for whole
fringes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.compensate.path.fringes import drift_m, matched_m, moved, rough_near, roughness, smooth_near, smoothest
from torchsar.compensate.path.ground import FINE_STEP, line_free, placed
from torchsar.compensate.path.joint import Found, three_axes
from torchsar.compensate.pulse_phase.data import pair_phase
from torchsar.compensate.pulse_phase.fixed_point import Run, Wiener, fixed_point, weighted
from torchsar.compensate.pulse_phase.imaging import Through
from torchsar.compensate.pulse_phase.sharpness import sharpness_beyond_speckle, sharpness_of_noise
from torchsar.core import cis, real_dtype
from torchsar.focus.spotlight import window_weights
from torchsar.focus.tile_operator import TileOperator
from torchsar.metrics import entropy, residual_phase
from torchsar.radar import LIGHT_M_S
from torchsar.radar.spotlight import frequency_samples, range_profiles

# roughness below which a line of sight is smooth: it was 0.3 to 0.6 for smooth errors, and 1.0 for
# random walks
_ROUGH = 0.75
# A result of another start is compared with the best one only if its residual power is at most this
# times as large, by trial. Results of equal quality had up to 1.05 times, less converged ones 1.1
# to 1.35 times the residual power.
_AS_WELL = 1.1


def _intensity(power: Tensor, mean: Tensor) -> Tensor:
    """Weights of image cells that raise the sum of the squared intensity."""
    return power / mean


def _surprise(power: Tensor, mean: Tensor) -> Tensor:
    """Weights of image cells that lower the entropy: ln p minus the mean of ln p weighted by p, and
    zero where this is negative. The share of a cell in the energy is p.
    """
    share = power / (mean * (power.shape[-1] * power.shape[-2]))
    log = torch.log(share.clamp_min(torch.finfo(share.dtype).tiny))
    return (log - (share * log).sum((-2, -1), keepdim=True)).clamp_min(0)


@dataclass(frozen=True, eq=False)
class Search:
    """The search of one trial.

    Args:
        rows: Range profiles of the pulses that are present, (pulse, range).
        frequency_hz: Frequencies.
        imaging: Image formation along their recorded path.
        present: True for these among all pulses.
    """

    rows: Tensor
    frequency_hz: Tensor
    imaging: TileOperator
    present: Tensor

    @property
    def fringe_m(self) -> float:
        """Half a wavelength in metres."""
        return LIGHT_M_S / (2 * float(self.frequency_hz.mean()))

    def metres(self, phase_rad: Tensor) -> Tensor:
        """Range in metres that corresponds to a phase."""
        return phase_rad.double() * (self.fringe_m / (2 * math.pi))

    def windowed(self, share: float) -> Tensor:
        """Profiles with Hann windows over the pulses and over a share of the band."""
        pulses, n = self.rows.shape
        real = real_dtype(self.rows.dtype)
        k = torch.linspace(-1, 1, n, dtype=torch.float64, device=self.rows.device) / share
        over_band = torch.where(k.abs() < 1, (1 + torch.cos(math.pi * k)) / 2, 0).to(real)
        over_pulses = window_weights("hann", pulses, self.rows.device).to(real).clamp_min(0.1)
        samples = frequency_samples(self.rows) * (over_pulses[:, None] * over_band)
        return range_profiles(samples)

    def sharpened(self, rows: Tensor, range_m: Tensor, start: Tensor | None) -> tuple[Tensor, Tensor]:
        """Phases that sharpen the image of rows with the errors range_m of the line of sight
        removed, and the rows without these errors.
        """
        at = moved(rows, self.frequency_hz, range_m)
        columns = at.mT[None].contiguous()
        phase = torch.zeros_like(columns[:, 0].real) if start is None else start[None]
        # both iterations end at a phase step of 0.03 rad rms, found by trial
        for weights, iterations in ((_intensity, 30), (_surprise, 12)):
            phase = fixed_point(columns, phase, Run(weights, Through(self.imaging), iterations, 1.0, 0.03))[0]
        return phase[0], at

    def by_phases(self, share: float) -> Tensor:
        """Phases (pulse,) that sharpen the image in a share of the band, while the envelopes remain
        unchanged.
        """
        rows = self.windowed(share)
        columns, rest = rows.mT[None], torch.zeros(len(rows), dtype=torch.float64, device=rows.device)
        start = pair_phase(columns, torch.ones_like(columns[:, 0].real, dtype=torch.bool))[0]
        return self.sharpened(rows, rest, start)[0]

    def by_envelopes(self, first_band: float) -> tuple[Tensor, Tensor]:
        """Line of sight with whole fringes, found with the envelopes, and its roughness.

        first_band: Share of the band in which the first phases are found.
        """
        cell, fringe = LIGHT_M_S / (2 * float(self.frequency_hz[-1] - self.frequency_hz[0])), self.fringe_m
        phase = self.by_phases(first_band)
        carrier = self.metres(phase)
        range_m, rough = torch.zeros_like(carrier), roughness(carrier, fringe)
        if rough < _ROUGH:
            range_m, phase = line_free(smoothest(carrier, fringe), self.present), None
        # each round corrects the envelopes by up to `reach` range cells in a share of the band, by
        # trial
        for turn, (share, reach) in enumerate(((0.5, 4.0), (1.0, 2.0), *[(1.0, 0.5)] * 4)):
            rows, before = self.windowed(share), range_m
            phase, at = self.sharpened(rows, range_m, phase)
            rough = roughness(range_m + self.metres(phase), fringe)
            if share < 1 and rough >= _ROUGH:
                continue
            range_m, phase = self.with_envelopes(range_m, phase, at, reach * cell, rough), None
            if share == 1:
                rows = moved(rows, self.frequency_hz, range_m)
                drift = drift_m(rows, self.frequency_hz, self.imaging, slopes=turn == 1)
                range_m = range_m + fringe * torch.round(drift / fringe)
            range_m = line_free(range_m, self.present)
            if turn > 1 and (range_m - before).square().mean().sqrt() < fringe:
                break
        return range_m, rough

    def polished(self, range_m: Tensor, imaging: TileOperator) -> Tensor:
        """Line of sight whose phases match a Wiener estimate of the scene; the envelopes remain
        unchanged.

        imaging: Image formation of the scene.
        """
        columns = moved(self.rows, self.frequency_hz, range_m).mT[None].contiguous()
        # The 10 iterations were chosen by trial. With more of them, the phases diverge, because
        # errors across the line of sight are not known yet.
        run = Run(Wiener(), Through(imaging), 10, 1.0, 1e-3)
        phase, _ = fixed_point(columns, torch.zeros_like(columns[:, 0].real), run)
        return line_free(range_m + self.metres(phase[0]), self.present)

    def with_envelopes(self, range_m: Tensor, phase: Tensor, at: Tensor, reach_m: float, rough: Tensor) -> Tensor:
        """Line of sight that matches the envelopes and phases to the image that the
        phases sharpen.
        """
        turned = at * cis(-phase)[:, None]
        model = self.imaging.adjoint(weighted(self.imaging.image(turned[None]), _surprise))[0]
        whole = moved(self.rows, self.frequency_hz, range_m)
        near = range_m + matched_m(whole, model, self.frequency_hz, reach_m)
        carrier = range_m + self.metres(phase)
        if rough >= _ROUGH:
            return rough_near(carrier[None], near[None], range_m[None], self.fringe_m)[0]
        bends = rough * (self.fringe_m / math.sqrt(12))
        # measurements by envelopes are assumed to have an error of two fringes
        known = (self.fringe_m, 2 * self.fringe_m, bends[None])
        return smooth_near(carrier[None], near[None], range_m[None], *known)[0]


@dataclass(frozen=True, eq=False)
class Starts:
    """Results of the search from several starts.

    Args:
        best: Result with the sharpest image.
        others: Those that it is compared with: the others that explain the samples as well, or all
            others if there are none.
        square_m2: Mean square of the differences of the line of sight from these, (other,).
        noise: Least noise that a start leaves.
        roughness: Roughness of the line of sight in the first start.
    """

    best: Found
    others: list[Found]
    square_m2: Tensor
    noise: Tensor
    roughness: Tensor

    @staticmethod
    def of(results: list[Found], search: Search, roughness: Tensor) -> Starts:
        """Choose the sharpest image among results, and compare the others with it."""
        best, *others = sorted(results, key=lambda one: float(entropy(one.image)))
        compared = [one for one in others if one.noise <= _AS_WELL * best.noise] or others
        radians, present = 2 * math.pi / search.fringe_m, search.present
        phases = [radians * placed(one.motion_m[:, 0], present) for one in (best, *compared)]
        apart = [residual_phase(phases[0], other, present)[present] / radians for other in phases[1:]]
        least = torch.stack([one.noise for one in results]).amin()
        return Starts(best, compared, torch.stack([x.square().mean() for x in apart]), least, roughness)


def found_from_starts(search: Search, fine: TileOperator, rounds: int) -> Starts:
    """Find the errors from two starts, and from a third one if the results of the two differ.

    Args:
        search: The search.
        fine: Image formation with pixels of `FINE_STEP`.
        rounds: Largest number of rounds of the joint estimate.

    Returns:
        The results.
    """

    def refined(range_m: Tensor) -> Found:
        range_m = search.polished(range_m, fine)
        sharp, noise = sharpness(fine.image(moved(search.rows, search.frequency_hz, range_m)[None])[0])
        # A start whose image is hardly sharper than noise gets one round only. In 43 scenes the
        # sharpness was 0.5 to 1.3 times that of noise for noise and at -10 dB. It was 1.0 to 2.9
        # times for clutter, whose errors are not found, and 3.7 to 11 times where errors were
        # found.
        return three_axes(search.rows, fine, range_m, search.present, rounds if sharp > 1.25 * noise else 1)

    # The first start uses a quarter of the band, in which range cells are four times as long, and a
    # third one uses half of it.
    range_m, rough = search.by_envelopes(0.25)
    results = [refined(range_m), refined(search.metres(search.by_phases(1.0)))]
    both = Starts.of(results, search, rough)
    spread = 2 * both.best.std_m.square().mean() + both.square_m2.amin()
    alone = both.others[0].noise > _AS_WELL * both.best.noise
    # The phases of two results may differ, by choice, by so much that 1.5 standard deviations of
    # half the power lower the Strehl ratio to 0.8.
    apart = 2 * -math.log(0.8) / 1.5**2
    if not (alone or spread * (2 * math.pi / search.fringe_m) ** 2 > apart):
        return both
    return Starts.of([*results, refined(search.by_envelopes(0.5)[0])], search, rough)


def sharpness(image: Tensor) -> tuple[Tensor, Tensor]:
    """Measure the sharpness of an image with pixels of `FINE_STEP`.

    Args:
        image: Image, shape (azimuth, range), complex.

    Returns:
        The sharpness in nats, and that of noise.
    """
    sharp, rows, _ = sharpness_beyond_speckle(image.mT)
    return sharp, sharpness_of_noise((rows * FINE_STEP).clamp_min(1))
