"""Absolute Doppler centroid: the PRF ambiguity is resolved from range migration.

The absolute centroid f_dc is the baseband centroid plus k PRFs. The whole number k, the ambiguity,
is found without prior knowledge. Three kinds of evidence give a log-likelihood for each candidate
k:

- Looks: the image is focused with the baseband centroid, and two azimuth looks are formed whose
  Doppler centres differ by df. If the true centroid is k PRFs away, the looks are displaced against
  each other in range by lambda k PRF df / (2 Ka). Here lambda is the wavelength and Ka the azimuth
  FM rate.
- Lines: the phase increment between adjacent lines is proportional to f_dc (f0 + f) / f0, with the
  range frequency f and the carrier frequency f0. Its slope over f gives f_dc without ambiguity.
- Entropy: a small group of range cells is focused with each candidate. The right candidate gives
  the least image entropy.

The looks are the strongest evidence wherever the scene has contrast. On featureless speckle only
the lines give evidence. The three log-likelihoods are added.

Doppler is positive when closing. Range changes by -lambda f_dc / 2 metres per second.
"""

from __future__ import annotations

import math
from typing import Literal

import torch
from torch import Tensor

from torchsar.compensate import doppler_assess
from torchsar.compensate.aperture import complete_aperture_centroid, reference_spectrum
from torchsar.compensate.doppler import agreeing_cells, lag_products, nominal_doppler, swept_band
from torchsar.compensate.group import (
    BeamSpectrum,
    RangeGroup,
    aperture_lines,
    beam_spectrum,
    block_entropy,
    block_weights,
    compress,
    pick_group,
    student_log_likelihood,
)
from torchsar.core import (
    Estimate,
    Signal,
    Stage,
    checked_samples,
    fft_lines,
    power_of,
    settle,
    take,
    unit_level,
    wrapped,
)
from torchsar.focus.reference import REFERENCES
from torchsar.radar import StripmapRadar


def _evidence(scores: Tensor, weight: Tensor | None = None) -> Tensor:
    """Log-likelihood of each candidate (..., candidate) from the scores of blocks.

    The likelihood describes how certainly a candidate is worse than the best one. scores: (...,
    block, candidate). weight: (..., block) with sum 1, equal by default. The value is Student's t
    of the mean deficit. Its degrees of freedom follow from the number of blocks that carry weight.
    A tenth of the deficit is added to its uncertainty, so that no single kind of evidence becomes a
    certainty.
    """
    if weight is None:
        weight = torch.full(scores.shape[:-1], 1 / scores.shape[-2], dtype=scores.dtype, device=scores.device)
    best = (scores * weight[..., None]).sum(-2).argmax(-1)
    deficit = take(scores, best[..., None].expand(scores.shape[:-1]))[..., None] - scores
    mean = (deficit * weight[..., None]).sum(-2)
    blocks = 1 / weight.square().sum(-1, keepdim=True)
    scatter = (weight[..., None] * (deficit - mean[..., None, :])).square().sum(-2)
    variance = blocks / (blocks - 1).clamp_min(0.5) * scatter + 0.01 * mean.square()
    tiny = 1e-24 * scores.square().amax((-2, -1))[..., None] + 1e-300
    return student_log_likelihood(mean / torch.sqrt(variance + tiny), (blocks - 1).clamp_min(0.5))


def look_scores(group: RangeGroup, doppler_hz: Tensor, velocity_m_s: float, turns: Tensor, looks: int = 16) -> Tensor:
    """Correlate neighbouring azimuth looks at the range displacement of every candidate ambiguity.

    The group is focused with the baseband Doppler as if it were absolute. If the true centroid lies
    k PRFs away, each look is displaced in range against the look before it by
    lambda k PRF df / (2 Ka), where lambda is the wavelength, df the Doppler spacing of the looks
    and Ka the azimuth FM rate. Looks one, two and three spacings apart are correlated at one, two
    and three times this displacement. Intensities are limited to 20 times their mean, so that one
    ship cannot dominate.

    Args:
        group: Group of range cells.
        doppler_hz: Baseband centroid in Hz, shape (...,), positive when closing.
        velocity_m_s: Velocity of the platform in m/s.
        turns: Candidates for the ambiguity in PRFs, shape (candidate,).
        looks: Number of azimuth looks.

    Returns:
        The correlations, shape (..., block, candidate), float64. The right candidate has the
        largest one. Each of the 8 blocks holds an eighth of the lines of the look images.
    """
    rows = beam_spectrum(group, doppler_hz).rows(doppler_hz, velocity_m_s)
    height = rows.shape[-2] // looks
    image = fft_lines(rows[..., : height * looks, :].unflatten(-2, (looks, height)), inverse=True)
    intensity = power_of(image)
    mean = intensity.mean((-3, -2, -1), keepdim=True)
    intensity = (intensity / torch.where(mean > 0, mean, 1)).clamp_max(20)
    intensity = intensity - intensity.mean(-1, keepdim=True)
    n = 2 * intensity.shape[-1]
    spectra = torch.fft.rfft(intensity, n)
    rate = group.radar.azimuth_rate_hz_s(group.middle_m, velocity_m_s)
    step_hz = height / group.data.shape[-2] * group.radar.prf_hz
    cells = group.radar.wavelength_m * group.radar.prf_hz * step_hz / (2 * rate * group.radar.range_step_m)
    frequency = torch.arange(spectra.shape[-1], dtype=torch.float64, device=rows.device) / n
    score = torch.zeros((), dtype=torch.float64, device=rows.device)
    for distance in (1, 2, 3):
        cross = (spectra[..., :-distance, :, :].conj() * spectra[..., distance:, :, :]).sum(-3)
        blocks = torch.stack([part.sum(-2) for part in cross.tensor_split(8, -2)], -2).to(torch.complex128)
        phase = 2 * math.pi * distance * (cells[..., None, None] * turns[:, None] * frequency)
        score = score + (blocks @ torch.polar(torch.ones_like(phase), phase).mT).real
    return score / n


def line_doppler(lines: Tensor, radar: StripmapRadar) -> tuple[Tensor, Tensor]:
    """Estimate the absolute Doppler from the growth of the phase increment with range frequency.

    The phase increment between adjacent lines is 2 pi f_dc (f0 + f) / (f0 PRF) at range frequency
    f, with carrier frequency f0 and Doppler f_dc; its slope over f is not ambiguous. The estimate
    is coarse: its standard deviation is about f0 / bandwidth * sqrt(12) times that of the baseband
    centroid. Amplitudes are limited to three times their mean.

    Args:
        lines: Range-compressed lines, shape (..., pulse, range), complex.
        radar: Radar parameters.

    Returns:
        The Doppler, positive when closing, and its predicted standard deviation (jackknife over
        blocks of lines), both in Hz, shape (...,).
    """
    lines = unit_level(lines)
    modulus = lines.abs()
    level = 3 * modulus.mean((-2, -1), keepdim=True)
    limited = lines * (level / torch.where(modulus > 0, modulus, 1)).clamp_max(1)
    n = lines.shape[-1]
    frequency = radar.range_frequency_hz(n)
    inside = frequency.abs() < 0.475 * radar.pulse.bandwidth_hz
    above, below = int(inside[frequency >= 0].sum()), int(inside[frequency < 0].sum())

    def band(x: Tensor) -> Tensor:
        return torch.cat([x[..., :above], x[..., x.shape[-1] - below :]], -1)

    spectra = torch.fft.fft(limited)
    products = band(spectra[..., :-1, :].conj() * spectra[..., 1:, :])
    blocks = torch.stack([part.sum(-2) for part in products.tensor_split(8, -2)], -2).to(torch.complex128)
    total = blocks.sum(-2, keepdim=True)
    scale = radar.prf_hz * radar.carrier_hz / (2 * math.pi)
    frequency = band(radar.range_frequency_hz(n, lines.device))
    value, left_out = scale * _phase_slope(total, frequency)[..., 0], scale * _phase_slope(total - blocks, frequency)
    jackknife = left_out.std(-1, correction=0) * math.sqrt(7)
    return settle(value, 0.0)[0], settle(jackknife, 1e9)[0]


def _phase_slope(products: Tensor, frequency_hz: Tensor) -> Tensor:
    """Least-squares slope (rad/Hz) of the phase of products (..., f) about their common phase."""
    mean = torch.angle(products.sum(-1, keepdim=True))
    turned = products * torch.polar(torch.ones_like(mean), -mean)
    weight = turned.real
    centre = (weight * frequency_hz).sum(-1, keepdim=True) / weight.sum(-1, keepdim=True)
    offset = frequency_hz - centre
    return (offset * turned.imag).sum(-1) / (offset.square() * weight).sum(-1)


def ambiguity_evidence(
    raw: Tensor, radar: StripmapRadar, doppler_baseband_hz: Tensor, reference: Tensor | None, turns: Tensor
) -> dict[str, Tensor]:
    """Compute the log-likelihood of every candidate ambiguity from each kind of evidence.

    There are three kinds of evidence: the range displacement between azimuth looks ("looks"), the
    change of the phase increment between adjacent lines over range frequency ("lines"), and the
    image entropy ("entropy"). Only the middle of the record is used: four synthetic apertures, or
    1024 lines if that is more. "looks" uses the 4096 neighbouring range cells with the most signal,
    "entropy" the 512 with the most signal, and "lines" all range cells.

    Args:
        raw: Lines, shape (..., pulse, range), complex.
        radar: Radar parameters.
        doppler_baseband_hz: Baseband centroid in Hz, shape (...,), positive when closing.
        reference: Range reference spectrum, shape (range,); None if `raw` is already
            range-compressed.
        turns: Candidates for the ambiguity in PRFs, shape (candidate,), float64.

    Returns:
        A dictionary. "looks", "lines" and "entropy" hold the log-likelihoods of the candidates,
        shape (..., candidate), each up to a constant. "line_doppler_hz" and "line_doppler_std_hz",
        shape (...,), hold the two results of `line_doppler`.
    """
    (lines, dwell), base = aperture_lines(raw, radar, reference), doppler_baseband_hz
    wide, narrow = pick_group(lines, radar, 4096), pick_group(lines, radar, 512)
    value, std = line_doppler(lines, radar)
    miss = (base[..., None] + turns * radar.prf_hz - value[..., None]) / std.clamp_min(1e-3 * radar.prf_hz)[..., None]
    spectrum, entropies = beam_spectrum(narrow, base), []
    for shift in turns * radar.prf_hz:
        at = BeamSpectrum(narrow, spectrum.data, spectrum.doppler_hz + shift)
        entropies.append(block_entropy(at.image(base + shift, radar.velocity_m_s)))
    return {
        "looks": _evidence(look_scores(wide, base, radar.velocity_m_s, turns)),
        "lines": student_log_likelihood(miss, 7),
        "entropy": _evidence(-torch.stack(entropies, -1), block_weights(narrow.data, radar, base, dwell)),
        "line_doppler_hz": value,
        "line_doppler_std_hz": std,
    }


class DopplerCentroid(Stage):
    """Absolute Doppler centroid with its ambiguity and the squint angle; the recommended estimator.

    >>> from torchsar import Draws, compensate, echo, radar, scene
    >>> strip = radar.StripmapRadar(3e9, radar.LinearFM(40e6, 5e-7), 50e6, 400.0, 120.0, 4000.0)
    >>> world = scene.StripmapWorld(scene.Points([0], [0]), scene.Dwell(0.5), doppler_hz=450.0)
    >>> recording, _ = echo.simulate(strip, world, 256, 64, Draws(1))
    >>> found = compensate.DopplerCentroid(strip, assess=False)(recording.signal)
    >>> found["doppler_hz"].round(decimals=-1), found["ambiguity"]
    (tensor(450., dtype=torch.float64), tensor(1., dtype=torch.float64))

    The baseband centroid comes from the phase increment between adjacent lines. The ambiguity is
    found without prior knowledge, see `ambiguity_evidence`. Where the data leave it open, it is
    that of the centroid nearest to `pointing_doppler_hz` of the radar, if that is not None. Targets
    whose apertures are cut by the ends of the record bias the centroid. If the dwell of the beam is
    known (`radar.integration_s`) and the record is at least 1.15 dwells long, the centroid is
    therefore refined with targets whose whole dwell lies in the record, see
    `complete_aperture_centroid`. The signal is left unchanged.

    Provides `doppler_hz` (absolute, positive when closing), `doppler_baseband_hz`, `ambiguity`
    (whole number of PRFs, as float64) and `squint_deg` (positive ahead, for the nominal velocity).
    The neutral values are those of `pointing_doppler_hz` of the radar, or of 0 if that is None.

    Args:
        radar: Radar parameters.
        reference: Name of the range reference in `torchsar.focus.reference`; None for
            range-compressed data.
        reach: Largest ambiguity that is searched, in PRFs.
        blocks: Number of blocks along pulses and along range for the baseband centroid.
        assess: Whether to add standard deviations, the quality and the outcome.
        over: "mean" uses all range cells by their energy. "median" resists a target that moves on
            its own, or a hot range cell: compressed cells whose phase increment departs from the
            median of all are left out, and no cell has more than the median power. The assessment
            is that of all cells, so that the outcome still names what was left out. Side lobes of a
            target that is 10 dB or more above the scene are in most cells, and it prevails.

    Raises:
        ValueError: If the range reference or `over` is unknown, or `reach` is below one.

    Reference:
        Tsvetkov 2017, text after Fig. 5.
    """

    provides = ("doppler_hz", "doppler_baseband_hz", "ambiguity", "squint_deg")
    differentiable = "where ok"

    def __init__(
        self,
        radar: StripmapRadar,
        reference: str | None = "matched",
        reach: int = 12,
        blocks: tuple[int, int] = (8, 8),
        assess: bool = True,
        over: Literal["mean", "median"] = "mean",
    ) -> None:
        super().__init__()
        if over not in ("mean", "median"):
            raise ValueError(f"over must be 'mean' or 'median' of the range cells, got {over!r}")
        if reference is not None and reference not in REFERENCES:
            raise ValueError(
                f"range reference {reference!r} is unknown; choose one of {sorted(REFERENCES)}, or "
                "None for range-compressed data"
            )
        if reach < 1:
            raise ValueError(f"reach must be 1 or more (largest Doppler ambiguity to search, in PRFs), got {reach}")
        # the limit allows up to 70 degrees of squint, at which the absolute Doppler is 0.94 * 2
        # v / lambda
        most = math.floor(1.88 * radar.velocity_m_s / (radar.wavelength_m * radar.prf_hz) - 0.5)
        self.radar, self.reference, self.reach = radar, reference, max(0, min(reach, most))
        self.blocks, self.assess, self.over = blocks, assess, over
        nominal = torch.tensor(nominal_doppler(radar)["doppler_hz"], dtype=torch.float64)
        self.neutral = {name: float(value) for name, value in self._values(nominal).items()}

    def forward(self, signal: Signal) -> Estimate:
        """Estimate the absolute Doppler centroid of a signal of axes (pulse, range).

        Args:
            signal: Lines, shape (..., pulse, range), complex.

        Returns:
            `doppler_hz` (absolute) and `doppler_baseband_hz` in Hz, `ambiguity` (whole number of
            PRFs) and `squint_deg`, shape (...,) each. A smooth phase error of the lines shifts the
            centroid and cannot be distinguished from motion. `info` holds

            - "looks", "lines", "entropy", "line_doppler_hz" and "line_doppler_std_hz", see
              `ambiguity_evidence`;
            - "candidates": the candidates for the ambiguity in PRFs, shape (candidate,).

            The assessment adds standard deviations of both centroids, and the probability that the
            ambiguity is right as `quality`. To `info` it adds "cut_hz" (see `phase_increment`),
            "margin" (log-likelihood of the best candidate minus that of the second-best) and
            "coherence" (of adjacent lines, 0..1). The outcome is EMPTY or NOISE where the phases of
            the lines are random, and AMBIGUOUS where the probability is 0.9 or less. It is MISFIT
            where the apertures that the ends of the record cut shift the centroid by an eighth of
            the band of the beam or more, and PARTS_DISAGREE where range cells ask for another
            centroid, as beside a ship that moves. It is INEXACT from a standard deviation of 1.5 %
            of the PRF on.
        """
        radar, raw = self.radar, checked_samples(signal.data, "DopplerCentroid", "pulse, range")
        products, power = lag_products(raw, self.blocks)
        cells, reference, kept = raw, self.reference, products
        if self.over == "median":
            # in compressed cells a target is seen in few of them
            cells, reference = agreeing_cells(compress(raw, radar, reference_spectrum(radar, reference, raw))), None
            kept = lag_products(cells, self.blocks)[0]
        n, prf = raw.shape[-1], radar.prf_hz
        base = wrapped(prf / (2 * math.pi) * torch.angle(kept.sum((-2, -1))), prf)
        turns = torch.arange(-self.reach, self.reach + 1, dtype=torch.float64, device=raw.device)
        with torch.no_grad():
            evidence = ambiguity_evidence(cells, radar, base, reference_spectrum(radar, reference, cells), turns)
        joint = evidence["looks"] + evidence["lines"] + evidence["entropy"]
        best, nominal = turns[joint.argmax(-1)], radar.pointing_doppler_hz
        if nominal is not None:
            sure = torch.softmax(joint, -1).amax(-1) > doppler_assess.LEAST_PROBABILITY
            best = torch.where(sure, best, torch.round((nominal - base) / prf))
        first = base + prf * best
        refined, std = complete_aperture_centroid(cells, radar, first, reference)
        found = Estimate(self._values(refined), quality=torch.ones_like(first), info={**evidence, "candidates": turns})
        if not self.assess:
            return found
        lines = doppler_assess.Increments.of(raw, products, power, prf, *swept_band(radar, n))
        return doppler_assess.absolute(found, lines, base, std, joint)

    def _values(self, doppler_hz: Tensor) -> dict[str, Tensor]:
        """All values that an absolute Doppler centroid in Hz determines."""
        baseband = wrapped(doppler_hz, self.radar.prf_hz)
        return {
            "doppler_hz": doppler_hz,
            "doppler_baseband_hz": baseband,
            "ambiguity": torch.round((doppler_hz - baseband) / self.radar.prf_hz),
            "squint_deg": torch.rad2deg(torch.asin(self.radar.sin_squint(doppler_hz).clamp(-1, 1))),
        }
