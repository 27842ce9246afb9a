"""Reconstruction of missing lines by zeros, linear interpolation, azimuth spectrum or scene model.

All four methods keep the received lines bit for bit and replace only the missing ones, whatever
samples these contain. With zeros, the relative error power of the image equals the share of missing
lines. If azimuth oversampling is low, the azimuth spectrum lowers this error little, because the
spectrum is the same for all parts of the scene. Only a model of the scene lowers it much, because
such a model knows which parts of the image are dark.

Reference:
    Tsvetkov 2017 (zeros or interpolation).
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchsar.core import Signal, Stage, checked_samples, host_value, level_of, per_trial, real_dtype, unit_phasor
from torchsar.focus.reference import REFERENCES
from torchsar.radar import StripmapRadar
from torchsar.repair.sparse import conjugate_fill, sparse_fill


def _mask(lines: Tensor, missing: Tensor) -> Tensor:
    """Mask (..., pulse, 1) of missing lines. Raises ValueError if it does not fit the lines."""
    if missing.shape[-1:] != lines.shape[-2:-1]:
        raise ValueError(
            f"missing must be a mask with one entry for each of the {lines.shape[-2]} lines, as LineIntegrity "
            f"gives it, got the shape {tuple(missing.shape)}"
        )
    return missing.bool()[..., None]


def zero_fill(lines: Tensor, missing: Tensor) -> Tensor:
    """Set missing lines to zero, the simplest of the fills.

    >>> import torch
    >>> from torchsar import repair
    >>> lines = torch.ones(4, 2, dtype=torch.complex64)
    >>> missing = torch.tensor([False, True, False, False])
    >>> repair.zero_fill(lines, missing).real[:, 0].tolist()
    [1.0, 0.0, 1.0, 1.0]

    Args:
        lines: Lines, shape (..., pulse, range), complex.
        missing: Missing lines, shape (..., pulse), bool.

    Returns:
        Lines of the same shape.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples, or if the mask does not have one entry per line.
    """
    lines = checked_samples(lines, "zero_fill", "line, range", finite=False)
    return torch.where(_mask(lines, missing), 0, lines)


def linear_fill(lines: Tensor, missing: Tensor, doppler_turns: Tensor | float = 0.0) -> Tensor:
    """Interpolate missing lines linearly between the nearest received ones.

    >>> import torch
    >>> from torchsar import repair
    >>> lines = torch.tensor([1.0, 0.0, 3.0, 4.0], dtype=torch.complex64)[:, None]  # line 1 is lost
    >>> missing = torch.tensor([False, True, False, False])
    >>> repair.linear_fill(lines, missing).real[:, 0].tolist()
    [1.0, 2.0, 3.0, 4.0]

    The phase increment of the Doppler centroid from line to line is removed before the
    interpolation and restored afterwards. Missing lines before the first or after the last received
    line are copies of that line, apart from this phase.

    The error is larger than that of `zero_fill` in two cases: if the correlation of adjacent lines,
    without the phase of the centroid, is below 0.25; or inside gaps of several lines, if azimuth
    oversampling is low. Differentiable.

    Args:
        lines: Lines, shape (..., pulse, range), complex.
        missing: Missing lines, shape (..., pulse), bool.
        doppler_turns: Doppler centroid in cycles per line, a number or shape (...,).

    Returns:
        Lines of the same shape.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples, or if the mask does not have one entry per line.
    """
    lines = checked_samples(lines, "linear_fill", "line, range", finite=False)
    mask, n = _mask(lines, missing), lines.shape[-2]
    row = torch.arange(n, device=lines.device)
    received = ~missing.bool().expand(lines.shape[:-1])
    before = torch.where(received, row, -1).cummax(-1).values
    after = torch.where(received, row, n).flip(-1).cummin(-1).values.flip(-1)
    share = torch.where(before < 0, 1.0, torch.where(after >= n, 0.0, (row - before) / (after - before).clamp_min(1)))
    turns = per_trial(doppler_turns, 1, lines)

    def turned(index: Tensor, weight: Tensor) -> Tensor:
        index = index.clamp(0, n - 1)
        factor = unit_phasor(turns * (row - index), lines.dtype) * weight.to(real_dtype(lines.dtype))
        return zero_fill(lines, missing).gather(-2, index[..., None].expand(lines.shape)) * factor[..., None]

    return torch.where(mask, turned(before, 1 - share) + turned(after, share), lines)


def azimuth_spectrum(lines: Tensor, received: Tensor, lags: int = 24) -> Tensor:
    """Estimate the azimuth power spectrum from the autocorrelation of the received lines.

    The estimate is smoothed over a Doppler interval of about 2 PRF / lags and may be slightly
    negative.

    Args:
        lines: Lines with azimuth last, shape (..., range, pulse), complex, zero where not received.
        received: Received lines, shape (..., pulse), bool.
        lags: Highest lag of the autocorrelation in lines.

    Returns:
        Spectrum averaged over range, of unit mean, in FFT order, shape (..., pulse).
    """
    n = lines.shape[-1]
    lags = min(lags, max(1, n // 4))
    products = torch.fft.ifft(torch.fft.fft(lines, 2 * n).abs().square().sum(-2))
    pairs = torch.fft.ifft(torch.fft.fft(received.to(lines.real.dtype), 2 * n).abs().square()).real
    lag = torch.arange(lags + 1, device=lines.device)
    taper = 0.5 + 0.5 * torch.cos(torch.pi * lag / (lags + 1))
    mean = products[..., : lags + 1] / pairs[..., : lags + 1].clamp_min(0.5) * taper.to(pairs.dtype)
    spectrum = 2 * torch.fft.fft(mean, n).real - mean[..., :1].real
    return spectrum / spectrum.mean(-1, keepdim=True).clamp_min(torch.finfo(spectrum.dtype).tiny)


def band_limited_fill(lines: Tensor, missing: Tensor, rounds: int = 2, steps: int = 8) -> Tensor:
    """Fill missing lines by least squares, with the azimuth spectrum of the received ones (Wiener).

    >>> import torch
    >>> from torchsar import repair
    >>> lines = torch.exp(0.25j * torch.pi * torch.arange(64))[:, None]  # Doppler of PRF / 8
    >>> missing = torch.arange(64) % 8 == 3
    >>> filled = repair.band_limited_fill(lines * ~missing[:, None], missing)
    >>> round((filled - lines).abs().max().item(), 2)
    0.0

    Conjugate gradients find the missing lines that minimise the sum of |D(f)|^2 / S(f) over the
    azimuth frequencies f, where D is the azimuth spectrum of all lines and S the expected power
    spectrum. S includes the Doppler centroid; it is estimated first from the received lines, then
    from the filled ones. Differentiable in the received lines.

    Args:
        lines: Lines, shape (..., pulse, range), complex.
        missing: Missing lines, shape (..., pulse), bool.
        rounds: Number of estimates of the spectrum.
        steps: Steps of conjugate gradients in each round.

    Returns:
        Lines of the same shape.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples or a sample is not finite, or if the mask does not have
            one entry per line.
    """
    lines = checked_samples(lines, "band_limited_fill", "line, range")
    # azimuth is the last dimension, so that its FFTs run along contiguous samples
    mask = _mask(lines, missing).mT
    filled = zero_fill(lines, missing).mT.contiguous()
    level = level_of(filled)
    filled = filled / level
    spectrum = azimuth_spectrum(filled, ~mask.expand(filled.shape)[..., 0, :]).clamp_min(0.05)
    for _ in range(rounds):

        def precision(x: Tensor, weight: Tensor = (1 / spectrum)[..., None, :]) -> Tensor:
            return torch.where(mask, torch.fft.ifft(torch.fft.fft(x) * weight), 0)

        filled = conjugate_fill(precision, filled, -precision(filled), steps)
        spectrum = azimuth_spectrum(filled, torch.ones_like(filled[..., 0, :], dtype=torch.bool), 96).clamp_min(2e-3)
    return torch.where(mask.mT, (filled * level).mT, lines)


ZeroFill = Stage.of(zero_fill)


class LinearFill(Stage):
    """Linear interpolation of missing lines, with the phase of the Doppler centroid removed.

    Args:
        radar: Radar, whose nominal pointing gives the Doppler centroid by default.
        doppler_hz: Doppler centroid in Hz; multiples of the PRF make no difference.
    """

    doppler_hz: Tensor

    def __init__(self, radar: StripmapRadar, doppler_hz: Tensor | float | None = None) -> None:
        super().__init__()
        self.hold("doppler_hz", (radar.pointing_doppler_hz or 0.0) if doppler_hz is None else doppler_hz)

    def forward(self, signal: Signal, missing: Tensor, doppler_hz: Tensor | None = None) -> Signal:
        """Interpolate missing lines; see `linear_fill`.

        Args:
            signal: Lines, shape (..., pulse, range).
            missing: Missing lines, shape (..., pulse), bool.
            doppler_hz: Doppler centroid in Hz, shape (...,); replaces that of the constructor.

        Returns:
            Signal of the same shape, with the missing lines interpolated.
        """
        doppler = self.doppler_hz if doppler_hz is None else doppler_hz
        return signal.with_data(linear_fill(signal.data, missing, doppler * signal.axis("pulse").step))


class BandLimitedFill(Stage):
    """Least-squares fill of missing lines with the azimuth spectrum of the received ones.

    No Doppler centroid is required: the estimated spectrum includes it.

    Args:
        rounds: Number of estimates of the spectrum.
        steps: Steps of conjugate gradients in each round.

    Raises:
        ValueError: If `rounds` or `steps` is less than one.
    """

    def __init__(self, rounds: int = 2, steps: int = 8) -> None:
        super().__init__()
        if rounds < 1 or steps < 1:
            raise ValueError(
                f"rounds and steps of a band-limited fill must be 1 or more, got rounds={rounds}, steps={steps}"
            )
        self.rounds, self.steps = rounds, steps

    def forward(self, signal: Signal, missing: Tensor) -> Signal:
        """Fill missing lines by their expected azimuth spectrum; see `band_limited_fill`.

        Args:
            signal: Lines, shape (..., pulse, range).
            missing: Missing lines, shape (..., pulse), bool.

        Returns:
            Signal of the same shape; the signal itself if no line is missing.
        """
        # inside vmap, where values cannot be read, lines may be missing
        if not host_value(missing.any(), True):
            return signal
        return signal.with_data(band_limited_fill(signal.data, missing, self.rounds, self.steps))


class SparseFill(Stage):
    """Reconstruction of missing lines by a model of the focused scene.

    The Doppler centroid must be absolute (ambiguity resolved) if range migration exceeds a cell.

    Args:
        radar: Radar parameters.
        reference: Name of the range reference with which raw lines are compressed inside the model,
            such as "matched"; None for lines that are range-compressed already.
        velocity_m_s: Effective velocity in m/s; by default that of the radar.
        doppler_hz: Absolute Doppler centroid in Hz; by default the nominal pointing of the radar,
            or 0.
        looks: Number of sub-looks in Doppler.
        rounds: Number of estimates of the local powers of the image.
        steps: Steps of conjugate gradients in each round.

    Raises:
        ValueError: If the reference is unknown, or `looks`, `rounds` or `steps` is less than one.
    """

    doppler_hz: Tensor
    velocity_m_s: Tensor

    def __init__(
        self,
        radar: StripmapRadar,
        reference: str | None = "matched",
        velocity_m_s: Tensor | float | None = None,
        doppler_hz: Tensor | float | None = None,
        looks: int = 4,
        rounds: int = 2,
        steps: int = 2,
    ) -> None:
        super().__init__()
        if reference is not None and reference not in REFERENCES:
            raise ValueError(
                f"range reference {reference!r} is unknown; choose one of {sorted(REFERENCES)}, or "
                "None for range-compressed lines"
            )
        if min(looks, rounds, steps) < 1:
            raise ValueError(
                f"looks, rounds and steps of a sparse fill must be 1 or more, got looks={looks}, "
                f"rounds={rounds}, steps={steps}"
            )
        self.radar, self.reference = radar, reference
        self.options = {"looks": looks, "rounds": rounds, "steps": steps}
        self.hold("velocity_m_s", radar.velocity_m_s if velocity_m_s is None else velocity_m_s)
        self.hold("doppler_hz", (radar.pointing_doppler_hz or 0.0) if doppler_hz is None else doppler_hz)

    def forward(
        self, signal: Signal, missing: Tensor, doppler_hz: Tensor | None = None, velocity_m_s: Tensor | None = None
    ) -> Signal:
        """Reconstruct missing lines by a model of the focused scene; see `sparse_fill`.

        Args:
            signal: Lines, shape (..., pulse, range).
            missing: Missing lines, shape (..., pulse), bool.
            doppler_hz: Absolute Doppler centroid in Hz, shape (...,); replaces that of the
                constructor.
            velocity_m_s: Effective velocity in m/s, shape (...,); replaces that of the constructor.

        Returns:
            Signal of the same shape; the signal itself if no line is missing.
        """
        if not host_value(missing.any(), True):
            return signal
        lines, radar = signal.data, self.radar
        reference = (
            None
            if self.reference is None
            else REFERENCES[self.reference](radar.pulse, lines.shape[-1], radar.sampling_hz, lines.device)
        )
        filled = sparse_fill(
            lines,
            missing,
            radar,
            doppler_hz=self.doppler_hz if doppler_hz is None else doppler_hz,
            velocity_m_s=self.velocity_m_s if velocity_m_s is None else velocity_m_s,
            reference=reference,
            **self.options,
        )
        return signal.with_data(filled)
