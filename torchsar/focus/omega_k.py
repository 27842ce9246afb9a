"""Wavenumber (omega-K) focusing of stripmap data in beam coordinates.

A target at slant range R from the beam centre, crossed at slow time t, has the two-dimensional
spectrum (stationary phase)
    exp(-j 2 pi [2 R G(f, X) / c + f_a t]),   G = cos(s) sqrt((f0 + f)^2 - X^2) + sin(s) X,   X = c
    f_a / (2 v),
with s the squint of the frame Doppler: sin(s) = lambda f_frame / (2 v). In wavenumber space G is a
rotation by s, so G = f0 + f with zero slope at the frame Doppler: images keep the range and azimuth
axes of the raw matrix, and their spectra stay centred however large the squint. A frame of 0 Hz
gives the classical zero-Doppler image. Source: brief 004, item 7; Tsvetkov 2017, steps 1 to 6.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchsar.core import (
    Axis,
    Signal,
    Stage,
    block_bytes_of,
    cis,
    linear_phasor,
    outer_phasor,
    over_blocks,
    per_trial,
    phasor_tables,
    real_dtype,
    reduced_turns,
    spectrum_in_blocks,
    transform_in_blocks,
)
from torchsar.focus.reference import REFERENCES
from torchsar.radar import StripmapRadar

# phase that the stationary-phase spectrum of a receding-frequency azimuth signal carries beside its
# exponent, taken back by the bulk filter
STATIONARY_TURNS = 1 / 8


def wavenumber(
    radar: StripmapRadar,
    frequency_hz: Tensor,
    doppler_hz: Tensor,
    velocity_m_s: Tensor | float,
    frame_hz: Tensor | float,
) -> Tensor:
    """G(f, f_a) - f0, float64: range frequency after the wavenumber mapping.

    frequency_hz: (f,) baseband; doppler_hz: (..., d); velocity and frame: (...,). Returns (..., d,
    f). Differences are formed before they can lose digits, and evanescent pairs (|X| > f0 + f) are
    clamped to grazing.
    """
    velocity, frame = (per_trial(value, 2, doppler_hz) for value in (velocity_m_s, frame_hz))
    f0, c = radar.carrier_hz, radar.wave_speed_m_s
    x = c * doppler_hz[..., None] / (2 * velocity)
    sin = c * frame / (2 * velocity * f0)
    cos = torch.sqrt(1 - sin.square())
    root = torch.sqrt(((f0 + frequency_hz - x) * (f0 + frequency_hz + x)).clamp_min(0))
    at_frame = f0 * cos
    # cos * root + sin * x - f0, with f0 = f0 (cos^2 + sin^2) taken apart
    return cos * (root - at_frame) + sin * (x - f0 * sin)


BAND_EDGE = 0.1  # of the band, the width of its raised-cosine edges


def band_weight(radar: StripmapRadar, offset_hz: Tensor, band_hz: float) -> Tensor:
    """Weight of Doppler offsets from the centroid in a processed band: 1 inside, 1/2 at +-band_hz /
    2, raised-cosine edges of a tenth of the band.

    Raises ValueError where band_hz is no positive number; warns where band and edges do not fit the
    PRF, which folds azimuth.
    """
    if not (math.isfinite(band_hz) and band_hz > 0):
        raise ValueError(f"the processed Doppler band must be a positive number of Hz, got {band_hz}")
    if band_hz * (1 + BAND_EDGE) > radar.prf_hz * (1 + 1e-9):
        warnings.warn(
            f"PRF {radar.prf_hz:g} Hz is below the processed band of {band_hz:g} Hz and its "
            f"edges, {band_hz * (1 + BAND_EDGE):g} Hz: "
            f"azimuth is cut at the PRF; process at most {radar.prf_hz / (1 + BAND_EDGE):.6g} Hz",
            stacklevel=2,
        )
    beyond = (offset_hz.abs() - band_hz / 2) / (BAND_EDGE * band_hz)
    return 0.5 - 0.5 * torch.sin(math.pi * beyond.clamp(-0.5, 0.5))


@dataclass(frozen=True)
class FrameGeometry:
    """The rows of an azimuth spectrum: radar, absolute Doppler (..., d), and velocity and frame
    Doppler (...,), all float64.

    weight: (..., d) of a processed Doppler band, None for the whole PRF.
    """

    radar: StripmapRadar
    doppler_hz: Tensor
    velocity_m_s: Tensor
    frame_hz: Tensor
    weight: Tensor | None = None

    @staticmethod
    def of(
        radar: StripmapRadar,
        raw: Tensor,
        doppler_hz: Tensor | float,
        velocity_m_s: Tensor | float | None,
        frame_hz: Tensor | float | None,
        device: torch.device | None = None,
        band_hz: float | None = None,
    ) -> FrameGeometry:
        """Geometry of all rows of raw (..., pulse, range).

        Raises ValueError where the Doppler asks for a squint beyond 90 degrees.
        """
        device = raw.device if device is None else device
        centroid = torch.as_tensor(doppler_hz, dtype=torch.float64, device=device)
        velocity = torch.as_tensor(
            radar.velocity_m_s if velocity_m_s is None else velocity_m_s, dtype=torch.float64, device=device
        )
        default = radar.pointing_doppler_hz if radar.pointing_doppler_hz is not None else centroid
        frame = torch.as_tensor(default if frame_hz is None else frame_hz, dtype=torch.float64, device=device)
        for name, value in (("doppler_hz", centroid), ("velocity_m_s", velocity)):
            if value.ndim and value.shape != raw.shape[:-2]:
                raise ValueError(
                    f"{name} of shape {tuple(value.shape)} does not match the trial dims "
                    f"{tuple(raw.shape[:-2])} of the data; give one number per trial"
                )
        _refuse_impossible(radar, velocity, centroid, frame)
        doppler = radar.doppler_hz(raw.shape[-2], centroid, device)
        return FrameGeometry(
            radar,
            doppler,
            velocity,
            frame,
            None if band_hz is None else band_weight(radar, doppler - centroid[..., None], band_hz),
        )

    def rows(self, part: slice) -> FrameGeometry:
        """The same for some of the rows."""
        return replace(
            self, doppler_hz=self.doppler_hz[..., part], weight=None if self.weight is None else self.weight[..., part]
        )

    def weighted(self, lines: Tensor) -> Tensor:
        """lines (..., d, n) times the weight of their row, where there is one."""
        return lines if self.weight is None else lines * self.weight.to(real_dtype(lines.dtype))[..., None]

    @property
    def requires_grad(self) -> bool:
        return any(value.requires_grad for value in (self.doppler_hz, self.velocity_m_s, self.frame_hz))

    def mapped(self, frequency_hz: Tensor) -> Tensor:
        """wavenumber() of these rows, (..., d, f)."""
        return wavenumber(self.radar, frequency_hz, self.doppler_hz, self.velocity_m_s, self.frame_hz)


def _refuse_impossible(radar: StripmapRadar, velocity_m_s: Tensor, *doppler_hz: Tensor) -> None:
    """Raise ValueError for velocities that are not positive and for Dopplers that no squint
    gives.
    """
    try:
        slowest = float(velocity_m_s.detach().min())
        largest = max(
            float(radar.sin_squint(value.detach(), velocity_m_s.detach()).abs().max()) for value in doppler_hz
        )
    except RuntimeError:  # inside vmap a value cannot be looked at
        return
    if not 0 < slowest < math.inf:
        raise ValueError(f"velocity_m_s must be positive and finite in every trial, got {slowest:g}")
    if not largest < 1:
        raise ValueError(
            f"a Doppler asks for a squint of sine {largest:.4g}; doppler_hz and frame_hz must "
            "stay below 2 * velocity / wavelength in magnitude"
        )


def residual_frequency(at: FrameGeometry, offset_hz: Tensor) -> Tensor:
    """What bulk + refocus leave of the wavenumber mapping: f(G(0) + h) - h in Hz, float64 (..., d,
    h), for image frequencies h about G(0).

    f(G) is the inverse of wavenumber(): the raw range frequency that an image frequency is made of.
    """
    velocity, frame = (per_trial(value, 2, at.doppler_hz) for value in (at.velocity_m_s, at.frame_hz))
    f0, c = at.radar.carrier_hz, at.radar.wave_speed_m_s
    x = c * at.doppler_hz[..., None] / (2 * velocity)
    sin = c * frame / (2 * velocity * f0)
    # G(0) = cos root(0) + sin x, so that root(h) = root(0) + h / cos
    root = torch.sqrt(((f0 - x) * (f0 + x)).clamp_min(0)) + offset_hz / torch.sqrt(1 - sin.square())
    return torch.sqrt(x.square() + root.square()) - f0 - offset_hz


class FrequencyBasis:
    """Chebyshev polynomials over the range band: a smooth phase per Doppler row becomes a few
    float64 numbers and one matrix product.

    The number of nodes follows from the fractional bandwidth so that the polynomial errs below 1e-6
    turn.
    """

    def __init__(self, radar: StripmapRadar, n: int, device: torch.device | None = None) -> None:
        ratio = 0.5 * radar.carrier_hz / (radar.sampling_hz / 2)
        rho = ratio + math.sqrt(ratio * ratio - 1) if ratio > 1 else 1.5
        k = min(48, max(4, math.ceil(math.log(1e13) / math.log(rho))))
        angle = math.pi * (torch.arange(k, dtype=torch.float64, device=device) + 0.5) / k
        order = torch.arange(k, dtype=torch.float64, device=device)
        self.nodes_hz = torch.cos(angle) * radar.sampling_hz / 2
        self._to_coefficients = torch.cos(angle[:, None] * order) * torch.where(order == 0, 1 / k, 2 / k)
        u = (radar.range_frequency_hz(n, device) / (radar.sampling_hz / 2)).clamp(-1, 1)
        self._polynomials = torch.cos(torch.acos(u) * order[:, None])

    def evaluate(self, values_at_nodes: Tensor, dtype: torch.dtype) -> Tensor:
        """A smooth real function on the FFT grid in `dtype`, from its float64 values at the nodes,
        (..., row, node) -> (..., row, n).
        """
        return (values_at_nodes @ self._to_coefficients).to(dtype) @ self._polynomials.to(dtype)

    def phasor(self, turns_at_nodes: Tensor, dtype: torch.dtype) -> Tensor:
        """exp(2j pi turns) on the FFT grid from float64 turns at the nodes, (..., row, node) ->
        (..., row, n).
        """
        coefficients = turns_at_nodes @ self._to_coefficients
        constant = reduced_turns(coefficients[..., :1])
        coefficients = torch.cat([constant, coefficients[..., 1:]], -1).to(real_dtype(dtype))
        return cis(2 * math.pi * (coefficients @ self._polynomials.to(coefficients.dtype)))


def bulk_filter(
    basis: FrequencyBasis, at: FrameGeometry, range_m: Tensor | float, reference: Tensor | None, dtype: torch.dtype
) -> Tensor:
    """Conjugate two-dimensional spectrum of a target at range_m, (..., d, n): phase 2 pi [(2 R / c)
    (G - f0 - f) + 1/8], 1/8 turn at the frame Doppler.

    A focused target then has the phase -4 pi R / lambda of its echo at the crossing of the beam
    centre, as backprojection has. The range reference (n,) is multiplied in where there is one.
    """
    turns = (2 * range_m / at.radar.wave_speed_m_s) * (at.mapped(basis.nodes_hz) - basis.nodes_hz) + STATIONARY_TURNS
    h = basis.phasor(turns, dtype)
    return h if reference is None else h * reference.to(dtype)


def refocus_turns_per_sample(at: FrameGeometry) -> Tensor:
    """Turns per range sample of the azimuth phase left by the bulk filter, (2 dr / c) (G(0, X) -
    f0), (..., d) float64.
    """
    zero = torch.zeros(1, dtype=torch.float64, device=at.doppler_hz.device)
    return (2 * at.radar.range_step_m / at.radar.wave_speed_m_s) * at.mapped(zero)[..., 0]


def refocus(rows: Tensor, turns_per_sample: Tensor, centre: int) -> Tensor:
    """Azimuth phase of each range line relative to line `centre`.

    rows: (..., d, n) azimuth spectra; turns_per_sample: (..., d).
    """
    return rows * linear_phasor(turns_per_sample, -centre, rows.shape[-1], rows.dtype)


def omega_k(
    raw: Tensor,
    radar: StripmapRadar,
    *,
    doppler_hz: Tensor | float,
    velocity_m_s: Tensor | float | None = None,
    frame_hz: Tensor | float | None = None,
    reference: Tensor | None = None,
    band_hz: float | None = None,
) -> Tensor:
    """Bulk + refocus omega-K (the form of Tsvetkov 2017, steps 1 to 5).

    raw, result: (..., pulse, range) complex.

    doppler_hz: absolute Doppler centroid, about which the azimuth spectrum is unwrapped; frame_hz:
    frame of the image coordinates, by default the radar's nominal pointing, else the centroid. Both
    and velocity_m_s may differ per trial, (...,). reference: range reference spectrum (range,),
    None for range-compressed data. band_hz: processed Doppler bandwidth about the centroid, None
    for the whole PRF. Neglects the change of migration over the swath (`focus.requirements` says
    how much that is); `omega_k_stolt` does not. A focused target has the phase -4 pi R / lambda.
    Differentiable in raw, velocity and frame; without gradients it works by blocks in one copy of
    the data.
    """
    geometry = FrameGeometry.of(radar, raw, doppler_hz, velocity_m_s, frame_hz, band_hz=band_hz)
    n, centre = raw.shape[-1], raw.shape[-1] // 2
    basis = FrequencyBasis(radar, n, raw.device)
    range_m = radar.near_range_m + centre * radar.range_step_m

    def focus_rows(rows: Tensor, part: slice) -> Tensor:
        at = geometry.rows(part)
        rows = rows * bulk_filter(basis, at, range_m, reference, raw.dtype)
        return at.weighted(refocus(torch.fft.ifft(rows), refocus_turns_per_sample(at), centre))

    return through_doppler(raw, focus_rows, differentiable=geometry.requires_grad or raw.requires_grad)


def through_doppler(
    raw: Tensor, focus_rows: Callable[[Tensor, slice], Tensor], differentiable: bool, block_bytes: int | None = None
) -> Tensor:
    """Two-dimensional FFT, `focus_rows` on the rows of the spectrum, inverse azimuth FFT.

    raw, result: (..., pulse, range).

    focus_rows takes rows (..., d, range frequency) and their slice of the Doppler axis, and returns
    (..., d, range). Where gradients are wanted all rows go at once; otherwise blocks of rows are
    worked on inside one copy of the data, which is all the memory it takes.
    """
    if differentiable and torch.is_grad_enabled():
        return torch.fft.ifft(focus_rows(torch.fft.fft2(raw), slice(None)), dim=-2)
    work = spectrum_in_blocks(raw)
    block_bytes = block_bytes_of(raw.device) if block_bytes is None else block_bytes
    height = max(1, block_bytes // max(1, work[..., 0, :].numel() * work.element_size()))

    def focus(part: slice) -> None:
        work[..., part, :] = focus_rows(work[..., part, :], part)

    over_blocks(focus, (slice(first, first + height) for first in range(0, work.shape[-2], height)), work)
    return transform_in_blocks(work, -2, inverse=True)


class Focuser(Stage):
    """Base of the focusing stages: a radar, a range reference, a velocity and a Doppler; `form` is
    the function that does the work.

    Image axes (azimuth, range) are in the coordinates of the frame Doppler. reference: a name of
    REFERENCES to compress the pulse in the same pass, None for range-compressed data. velocity_m_s
    and doppler_hz may be given here (a number, a per-trial tensor, or an nn.Parameter to optimise)
    or by a chain at every call, which wins. band_hz: processed Doppler bandwidth, None for the
    whole PRF.
    """

    form: Callable[..., Tensor]
    velocity_m_s: Tensor
    doppler_hz: Tensor

    def __init__(
        self,
        radar: StripmapRadar,
        reference: str | None = "matched",
        velocity_m_s: Tensor | float | None = None,
        doppler_hz: Tensor | float | None = None,
        frame_hz: float | None = None,
        band_hz: float | None = None,
    ) -> None:
        super().__init__()
        if reference is not None and reference not in REFERENCES:
            raise ValueError(
                f"range reference {reference!r} is unknown; choose one of {sorted(REFERENCES)}, or "
                "None for compressed data"
            )
        self.radar, self.reference, self.frame_hz, self.band_hz = radar, reference, frame_hz, band_hz
        self.hold("velocity_m_s", radar.velocity_m_s if velocity_m_s is None else velocity_m_s)
        self.hold("doppler_hz", (radar.pointing_doppler_hz or 0.0) if doppler_hz is None else doppler_hz)

    def spectrum(self, n: int, device: torch.device | str | None = None) -> Tensor | None:
        """Range reference for lines of n samples, None for compressed data."""
        return (
            None
            if self.reference is None
            else REFERENCES[self.reference](self.radar.pulse, n, self.radar.sampling_hz, device)
        )

    def forward(self, signal: Signal, doppler_hz: Tensor | None = None, velocity_m_s: Tensor | None = None) -> Signal:
        data = type(self).form(
            signal.data,
            replace(self.radar, near_range_m=signal.axes[-1].start),
            doppler_hz=self.doppler_hz if doppler_hz is None else doppler_hz,
            velocity_m_s=self.velocity_m_s if velocity_m_s is None else velocity_m_s,
            frame_hz=self.frame_hz,
            reference=self.spectrum(signal.data.shape[-1], signal.data.device),
            band_hz=self.band_hz,
        )
        return Signal(data, self.radar.image_axes(signal.axes))


class OmegaK(Focuser):
    """Focus by bulk + refocus omega-K; arguments as `Focuser`."""

    form = staticmethod(omega_k)


class StoredOmegaK(Stage):
    """OmegaK for fixed axes, velocity and Doppler, with its filters built once: for many recordings
    of one geometry.

    Holds one complex number per sample of the raw matrix. Built by `StoredOmegaK(stage, axes,
    dtype)`.
    """

    filter: Tensor
    fine: Tensor
    coarse: Tensor

    def __init__(self, stage: OmegaK, axes: tuple[Axis, ...], dtype: torch.dtype = torch.complex64) -> None:
        super().__init__()
        n_pulse, n_range = axes[-2].n, axes[-1].n
        radar, device = replace(stage.radar, near_range_m=axes[-1].start), stage.velocity_m_s.device
        anchor = torch.empty((n_pulse, n_range), dtype=dtype, device="meta")
        self.axes, self.radar, self.centre = axes, radar, n_range // 2
        with torch.no_grad():
            at = FrameGeometry.of(
                radar, anchor, stage.doppler_hz, stage.velocity_m_s, stage.frame_hz, device, stage.band_hz
            )
            range_m = radar.near_range_m + self.centre * radar.range_step_m
            self.register_buffer(
                "filter",
                at.weighted(
                    bulk_filter(
                        FrequencyBasis(radar, n_range, device), at, range_m, stage.spectrum(n_range, device), dtype
                    )
                ),
            )
            fine, coarse = phasor_tables(refocus_turns_per_sample(at), -self.centre, n_range, dtype)
            self.register_buffer("fine", fine)
            self.register_buffer("coarse", coarse)

    def forward(self, signal: Signal) -> Signal:
        if signal.axes != self.axes or signal.data.dtype != self.filter.dtype:
            raise ValueError(
                f"stored filters are for the axes {self.axes} in {self.filter.dtype}, got "
                f"{signal.axes} in {signal.data.dtype}; build them anew"
            )

        def focus_rows(rows: Tensor, part: slice) -> Tensor:
            lines = torch.fft.ifft(rows * self.filter[..., part, :])
            return lines * outer_phasor(self.fine[..., part, :], self.coarse[..., part, :], lines.shape[-1])

        data = through_doppler(signal.data, focus_rows, differentiable=signal.data.requires_grad)
        return Signal(data, self.radar.image_axes(signal.axes))
