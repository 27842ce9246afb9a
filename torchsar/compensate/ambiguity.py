"""The Doppler ambiguity from range migration, told nothing (brief 004, item 5).

Three kinds of evidence, each a log-likelihood per candidate number of PRFs, from statistics over
independent blocks of the data:
    looks   range displacement between azimuth looks of the image: dr = lambda k prf df / (2 Ka);
    strong wherever there is contrast; lines   range displacement between adjacent lines: the phase
    increment grows with range frequency as f_dc (f0 + f) / f0; works on
            featureless speckle, and is all there is to go by on it;
    entropy a small group of range lines focused with every candidate.
They are added. Doppler is positive when closing; walk per second is -lambda f_dc / 2.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchsar.compensate.aperture import complete_aperture_centroid
from torchsar.compensate.doppler import phase_increment, unit_peak, wrap_hz
from torchsar.compensate.group import (
    RangeGroup,
    aperture_s,
    beam_spectrum,
    block_entropy,
    block_weights,
    central_lines,
    compress,
    jackknife_std,
    pick_group,
    student_log_likelihood,
)
from torchsar.core import Estimate, Signal, Stage, fft_lines, settle, take
from torchsar.focus.reference import REFERENCES
from torchsar.radar import StripmapRadar

_BLOCKS = 8


def candidate_turns(reach: int, device: torch.device | None = None) -> Tensor:
    """-reach..reach, float64; 0 alone where no other squint is possible."""
    if reach < 0:
        raise ValueError(f"the ambiguity search needs a reach of 0 or more PRFs, got {reach}")
    return torch.arange(-reach, reach + 1, dtype=torch.float64, device=device)


def _evidence(scores: Tensor, weight: Tensor | None = None) -> Tensor:
    """Log-likelihood of each candidate (..., candidate): how surely it is worse than the best one,
    from scores of blocks (..., block, candidate).

    weight: (..., block) with sum 1, equal by default. Student's t of the mean deficit; its degrees
    of freedom follow from how many blocks carry weight, and a tenth of the deficit itself counts as
    uncertainty, so that no single kind of evidence becomes certainty.
    """
    if weight is None:
        weight = torch.full(scores.shape[:-1], 1 / scores.shape[-2], dtype=scores.dtype, device=scores.device)
    best = (scores * weight[..., None]).sum(-2).argmax(-1)
    deficit = take(scores, best[..., None].expand(scores.shape[:-1]))[..., None] - scores
    mean = (deficit * weight[..., None]).sum(-2)
    blocks = 1 / weight.square().sum(-1, keepdim=True)
    gain = blocks / (blocks - 1).clamp_min(0.5)
    variance = gain * (weight[..., None] * (deficit - mean[..., None, :])).square().sum(-2) + 0.01 * mean.square()
    tiny = 1e-24 * scores.square().amax((-2, -1))[..., None] + 1e-300
    return student_log_likelihood(mean / torch.sqrt(variance + tiny), (blocks - 1).clamp_min(0.5))


def look_scores(group: RangeGroup, doppler_hz: Tensor, velocity_m_s: float, turns: Tensor, looks: int = 16) -> Tensor:
    """Correlation of neighbouring azimuth looks at the range displacement of every candidate, (...,
    block, candidate).

    The group is focused with the baseband Doppler (...,) as if it were absolute; a true centroid k
    PRFs away displaces look l + 1 against look l by dr. Blocks are ranges of image lines.
    Intensities are limited to 20 times the mean, so that one ship cannot rule.
    """
    rows = beam_spectrum(group, doppler_hz).rows(doppler_hz, velocity_m_s)
    height = rows.shape[-2] // looks
    image = fft_lines(rows[..., : height * looks, :].unflatten(-2, (looks, height)), inverse=True)
    intensity = image.real.square() + image.imag.square()
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
    for apart in (1, 2, 3):
        cross = (spectra[..., :-apart, :, :].conj() * spectra[..., apart:, :, :]).sum(-3)
        blocks = torch.stack([part.sum(-2) for part in cross.tensor_split(_BLOCKS, -2)], -2).to(torch.complex128)
        phase = 2 * math.pi * apart * (cells[..., None, None] * turns[:, None] * frequency)
        score = score + (blocks @ torch.polar(torch.ones_like(phase), phase).mT).real
    return score / n


def line_doppler(lines: Tensor, radar: StripmapRadar) -> tuple[Tensor, Tensor]:
    """Absolute Doppler from the growth of the phase increment over range frequency, with its
    predicted deviation; (...,) each, Hz.

    lines: range-compressed (..., pulse, range). Amplitudes are limited to three times their mean.
    Unambiguous, but coarse: its deviation is about f0 / bandwidth * sqrt(12) times that of the
    baseband centroid.
    """
    modulus = lines.abs()
    level = 3 * modulus.mean((-2, -1), keepdim=True)
    limited = lines * (level / torch.where(modulus > 0, modulus, 1)).clamp_max(1)
    spectra = torch.fft.fft(limited)
    frequency = radar.range_frequency_hz(lines.shape[-1], lines.device)
    inside = frequency.abs() < 0.475 * radar.pulse.bandwidth_hz
    products = (spectra[..., :-1, :].conj() * spectra[..., 1:, :])[..., inside]
    blocks = torch.stack([part.sum(-2) for part in products.tensor_split(_BLOCKS, -2)], -2).to(torch.complex128)
    total = blocks.sum(-2, keepdim=True)
    scale = radar.prf_hz * radar.carrier_hz / (2 * math.pi)
    value = scale * _phase_slope(total, frequency[inside])[..., 0]
    left_out = scale * _phase_slope(total - blocks, frequency[inside])
    return settle(value, 0.0)[0], settle(jackknife_std(left_out), 1e9)[0]


def _phase_slope(products: Tensor, frequency_hz: Tensor) -> Tensor:
    """Least-squares slope (rad/Hz) of the small phase of products (..., f) about their common
    phase.
    """
    mean = torch.angle(products.sum(-1, keepdim=True))
    turned = products * torch.polar(torch.ones_like(mean), -mean)
    weight = turned.real
    centre = (weight * frequency_hz).sum(-1, keepdim=True) / weight.sum(-1, keepdim=True)
    offset = frequency_hz - centre
    return (offset * turned.imag).sum(-1) / (offset.square() * weight).sum(-1)


def entropy_scores(
    group: RangeGroup, doppler_hz: Tensor, velocity_m_s: float, turns: Tensor, dwell_s: float
) -> tuple[Tensor, Tensor]:
    """Negative entropies of the range blocks of a group focused with every candidate, (..., block,
    candidate), and the blocks' weights.
    """
    spectrum, weight = beam_spectrum(group, doppler_hz), block_weights(group.data, group.radar, doppler_hz, dwell_s)
    scores = []
    for k in turns.tolist():
        shift = k * group.radar.prf_hz
        scores.append(-block_entropy(spectrum.moved(shift).image(doppler_hz + shift, velocity_m_s)))
    return torch.stack(scores, -1), weight


def ambiguity_evidence(
    raw: Tensor, radar: StripmapRadar, doppler_baseband_hz: Tensor, reference: Tensor | None, reach: int = 12
) -> dict[str, Tensor]:
    """Log-likelihoods of the candidates -reach..reach, each (..., candidate): "looks", "lines",
    "entropy"; and "line_doppler_hz" with its deviation.

    raw: (..., pulse, range); reference: range reference spectrum, None for compressed data. Uses at
    most four apertures of lines and 4096 columns about mid-swath.
    """
    turns = candidate_turns(reach, raw.device)
    dwell = aperture_s(radar, raw.shape[-1])
    lines = compress(unit_peak(central_lines(raw, max(1024, round(4 * dwell * radar.prf_hz)))), radar, reference)
    wide = pick_group(lines, radar, 4096)
    narrow = pick_group(lines, radar, 512)
    value, std = line_doppler(lines, radar)
    base = doppler_baseband_hz
    miss = (base[..., None] + turns * radar.prf_hz - value[..., None]) / std.clamp_min(1e-3 * radar.prf_hz)[..., None]
    return {
        "looks": _evidence(look_scores(wide, base, radar.velocity_m_s, turns)),
        "lines": student_log_likelihood(miss, _BLOCKS - 1),
        "entropy": _evidence(*entropy_scores(narrow, base, radar.velocity_m_s, turns, dwell)),
        "line_doppler_hz": value,
        "line_doppler_std_hz": std,
    }


def possible_reach(radar: StripmapRadar, reach: int) -> int:
    """At most `reach` PRFs, and no further than squints of about 70 degrees: 0.94 * 2 v /
    lambda.
    """
    return max(0, min(reach, math.floor(1.88 * radar.velocity_m_s / (radar.wavelength_m * radar.prf_hz) - 0.5)))


class DopplerCentroid(Stage):
    """The recommended estimator: absolute Doppler centroid, its ambiguity and the squint angle;
    leaves the signal alone.

    Baseband from the phase increment; the ambiguity from range migration, told nothing; then, where
    the beam's dwell is known (`radar.integration_s`) and shorter than the record, the baseband
    again from targets that the record holds for their whole dwell: one that the record's ends cut
    would pull the centroid. Values: doppler_hz (absolute), doppler_baseband_hz, ambiguity (PRFs,
    whole numbers as float64), squint_deg (positive ahead, at the nominal velocity). quality is the
    probability of the ambiguity, ok where it exceeds 0.9. info: block_hz, block_power,
    log-likelihoods `looks`, `lines`, `entropy`, `candidates`, margin (log-likelihood over the
    runner-up).
    """

    provides = ("doppler_hz", "doppler_baseband_hz", "ambiguity", "squint_deg")

    def __init__(
        self, radar: StripmapRadar, reference: str | None = "matched", reach: int = 12, blocks: tuple[int, int] = (8, 8)
    ) -> None:
        super().__init__()
        if reference is not None and reference not in REFERENCES:
            raise ValueError(
                f"range reference {reference!r} is unknown; choose one of {sorted(REFERENCES)}, or "
                "None for compressed data"
            )
        if reach < 1:
            raise ValueError(f"the ambiguity search needs a reach of at least one PRF, got {reach}")
        self.radar, self.reference, self.reach, self.blocks = radar, reference, possible_reach(radar, reach), blocks

    def spectrum(self, n: int, device: torch.device | str | None = None) -> Tensor | None:
        """Range reference for lines of n samples, None for compressed data."""
        return (
            None
            if self.reference is None
            else REFERENCES[self.reference](self.radar.pulse, n, self.radar.sampling_hz, device)
        )

    @torch.no_grad()
    def forward(self, signal: Signal) -> Estimate:
        raw, radar = signal.data, self.radar
        first = phase_increment(raw, radar.prf_hz, self.blocks)
        base = first["doppler_baseband_hz"]
        evidence = ambiguity_evidence(raw, radar, base, self.spectrum(raw.shape[-1], raw.device), self.reach)
        turns = candidate_turns(self.reach, raw.device)
        joint = evidence["looks"] + evidence["lines"] + evidence["entropy"]
        ranked = joint.sort(-1, descending=True)
        absolute = base + radar.prf_hz * turns[ranked.indices[..., 0]]
        absolute, std = complete_aperture_centroid(
            raw, radar, absolute, first.std["doppler_baseband_hz"], self.reference
        )
        baseband = wrap_hz(absolute, radar.prf_hz)
        probability = torch.softmax(joint, -1).amax(-1)
        squint = torch.rad2deg(torch.asin(radar.sin_squint(absolute).clamp(-1, 1)))
        info = {
            **first.info,
            **evidence,
            "candidates": turns,
            "margin": ranked.values[..., 0] - ranked.values[..., 1],
            "coherence": first.quality,
        }
        return Estimate(
            {
                "doppler_hz": absolute,
                "doppler_baseband_hz": baseband,
                "ambiguity": torch.round((absolute - baseband) / radar.prf_hz),
                "squint_deg": squint,
            },
            probability,
            first.ok & (probability > 0.9),
            {"doppler_hz": std, "doppler_baseband_hz": std},
            info,
        )
