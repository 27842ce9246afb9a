"""Wavenumber (omega-K) focusing of stripmap data.

The image shows a target at the slow time t and the slant range R at which a chosen line of sight
crosses it. The line of sight is given by its Doppler frequency f_frame (`frame_hz`): usually that
of the beam centre, or 0 Hz for the classical zero-Doppler image. At the Doppler frequency f_a and
the range frequency f, relative to the carrier f0, the echo has the spectrum (stationary phase)

    exp(-j 2 pi [2 R G(f, X) / c + f_a t]),    X = c f_a / (2 v),
    G = cos(s) sqrt((f0 + f)^2 - X^2) + sin(s) X,

where v is the effective velocity and s the squint of the line of sight, sin(s) = lambda f_frame /
(2 v). For f_frame = 0, G is the usual square root; otherwise the plane of wave numbers is rotated
by s. At f = 0 and f_a = f_frame this gives G = f0, dG/df = 1 and dG/df_a = 0. Images therefore keep
the range and azimuth axes of the raw matrix, and their spectra stay centred at any squint.

Reference:
    Tsvetkov 2017, focusing steps 1 to 6 after Eq. (2).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from torchsar.core import (
    Signal,
    Stage,
    block_bytes_of,
    checked_samples,
    cis,
    host_largest,
    is_traced,
    linear_phasor,
    outer_phasor,
    over_blocks,
    per_trial,
    phasor_tables,
    real_dtype,
    reduced_turns,
    transform_in_blocks,
    unit_phasor,
)
from torchsar.focus.frame_geometry import FrameGeometry
from torchsar.focus.reference import REFERENCES
from torchsar.radar import StripmapRadar

# Phase in cycles (pi / 4) of the spectrum of an azimuth signal with falling frequency, by
# stationary phase. The bulk filter removes it.
STATIONARY_TURNS = 1 / 8


def residual_frequency(at: FrameGeometry, offset_hz: Tensor) -> Tensor:
    """Compute the part of the Stolt frequency shift that `bulk_filter` and `refocus` leave.

    The range frequency h of the image belongs to the range frequency f of the raw data at which
    G(f) = G(0) + h, with the mapping G of `wavenumber`. `bulk_filter` and `refocus` treat f and h
    as equal, so that the shift f - h remains.

    Args:
        at: Geometry of the Doppler rows.
        offset_hz: Range frequencies h of the image in Hz, shape (h,).

    Returns:
        Shifts f - h in Hz, shape (..., d, h), float64.
    """
    velocity, frame = (per_trial(value, 2, at.doppler_hz) for value in (at.velocity_m_s, at.frame_hz))
    f0, c = at.radar.carrier_hz, at.radar.wave_speed_m_s
    x = c * at.doppler_hz[..., None] / (2 * velocity)
    sin = c * frame / (2 * velocity * f0)
    # G(0) = cos root(0) + sin x, so that root(h) = root(0) + h / cos
    root = torch.sqrt(((f0 - x) * (f0 + x)).clamp_min(0)) + offset_hz / torch.sqrt(1 - sin.square())
    return torch.sqrt(x.square() + root.square()) - f0 - offset_hz


def is_below(values: Tensor, limit: float) -> bool:
    """Return whether all magnitudes are below a limit.

    Args:
        values: Values, any shape.
        limit: Limit of their magnitude.

    Returns:
        True if all are below; False where values cannot be read.
    """
    return host_largest(values.detach().abs(), math.inf) < limit


class FrequencyBasis:
    """Chebyshev polynomials that interpolate smooth phases over the range band.

    The phase of a Doppler row is computed in float64 at a few range frequencies, the nodes
    (`nodes_hz`); one matrix product then evaluates it at all range frequencies. The number of nodes
    follows from the ratio of sampling rate to carrier and from the squint, so that the error stays
    below 1e-6 turn. Where the squint is so large that 48 nodes are not enough, all range
    frequencies are nodes, and nothing is interpolated.

    Args:
        radar: Radar of the recording.
        n: Number of range frequencies.
        device: Device of the result.
        sin_reach: Largest magnitude of the sine of the squint over all Doppler rows.
        wait: Whether to wait for the values of a phase, which tell whether float32 suffices for it.
            False, for filters that are formed many times, takes float64 on an accelerator.
    """

    def __init__(
        self,
        radar: StripmapRadar,
        n: int,
        device: torch.device | None = None,
        sin_reach: float = 0.0,
        wait: bool = True,
    ) -> None:
        self._wait = wait
        # the phase is singular where the square root of the mapping is zero
        ratio = min(0.5, 1 - sin_reach) * radar.carrier_hz / (radar.sampling_hz / 2)
        rho = ratio + math.sqrt(ratio * ratio - 1) if ratio > 1 else 1.0
        k = max(4, math.ceil(math.log(1e13) / math.log(rho))) if rho > 1 else math.inf
        self.direct = k > 48
        if self.direct:
            self.nodes_hz = radar.range_frequency_hz(n, device)
            return
        angle = math.pi * (torch.arange(k, dtype=torch.float64, device=device) + 0.5) / k
        order = torch.arange(k, dtype=torch.float64, device=device)
        self.nodes_hz = torch.cos(angle) * radar.sampling_hz / 2
        # torch.where of two Python numbers would return float32
        self._to_coefficients = torch.cos(angle[:, None] * order) * torch.where(order == 0, 1.0, 2.0) / k
        u = (radar.range_frequency_hz(n, device) / (radar.sampling_hz / 2)).clamp(-1, 1)
        self._polynomials = torch.cos(torch.acos(u) * order[:, None])

    def table(self, values_at_nodes: Tensor) -> Tensor:
        """Compute the small table from which `evaluate` interpolates a smooth real function.

        Args:
            values_at_nodes: Values at the frequencies `nodes_hz`, shape (..., row, node), float64.

        Returns:
            Table, shape (..., row, node), float64.
        """
        return values_at_nodes if self.direct else values_at_nodes @ self._to_coefficients

    def evaluate(self, table: Tensor, dtype: torch.dtype) -> Tensor:
        """Interpolate a smooth real function of range frequency from the nodes to the FFT grid.

        Args:
            table: Rows of the result of `table`, shape (..., row, node).
            dtype: Real type of the result.

        Returns:
            Values at all range frequencies in FFT order, shape (..., row, n).
        """
        return table.to(dtype) if self.direct else table.to(dtype) @ self._polynomials.to(dtype)

    def turn_table(self, turns_at_nodes: Tensor, dtype: torch.dtype) -> Tensor:
        """Compute the small table from which `phasors` evaluates a phase.

        Args:
            turns_at_nodes: Phase in turns at the frequencies `nodes_hz`, shape (..., row, node),
                float64.
            dtype: Complex type of the phasors.

        Returns:
            Table, shape (..., row, node): in radians in the precision of the phasors if that
            suffices, else in turns in float64.
        """
        if self.direct:
            return turns_at_nodes
        coefficients = self.table(turns_at_nodes)
        constant = reduced_turns(coefficients[..., :1])
        varying = coefficients[..., 1:].abs().sum(-1)
        table = torch.cat([constant, coefficients[..., 1:]], -1)
        # Measured for white noise in float32: the image error is -95 dB if the phase varies by 166
        # cycles, and -87 dB at 339.
        if dtype == torch.complex64 and not ((self._wait or varying.device.type == "cpu") and is_below(varying, 200)):
            return table
        return (2 * math.pi * table).to(real_dtype(dtype))

    def phasors(self, table: Tensor, dtype: torch.dtype) -> Tensor:
        """Interpolate a phase to the FFT grid, and return its phasors.

        Args:
            table: Rows of the result of `turn_table`, shape (..., row, node).
            dtype: Complex type of the result.

        Returns:
            Phasors at all range frequencies in FFT order, shape (..., row, n).
        """
        if self.direct:
            return unit_phasor(table, dtype)
        values = table @ self._polynomials.to(table.dtype)
        return cis(values) if table.dtype == real_dtype(dtype) else unit_phasor(values, dtype)


def bulk_turns(basis: FrequencyBasis, at: FrameGeometry, range_m: Tensor | float) -> Tensor:
    """Compute the phase of `bulk_filter` at the nodes of range frequency.

    Args:
        basis: Polynomials that interpolate phases over the range band.
        at: Geometry of the Doppler rows.
        range_m: Slant range in metres.

    Returns:
        Turns, shape (..., d, node), float64.
    """
    delay = 2 * range_m / at.radar.wave_speed_m_s
    return delay * (at.mapped(basis.nodes_hz) - basis.nodes_hz) + STATIONARY_TURNS


def bulk_filter(
    basis: FrequencyBasis, at: FrameGeometry, range_m: Tensor | float, reference: Tensor | None, dtype: torch.dtype
) -> Tensor:
    """Compute the filter that focuses targets at one slant range R.

    It is the conjugate of the two-dimensional spectrum of such a target, with the phase 2 pi
    [(2 R / c) (G - f0 - f) + 1/8] over Doppler and range frequency f, where G - f0 is the mapping
    of `wavenumber`. A focused target keeps the phase -4 pi R / lambda of its echo at slant range R,
    as in backprojection.

    Args:
        basis: Polynomials that interpolate phases over the range band.
        at: Geometry of the Doppler rows.
        range_m: Slant range R in metres.
        reference: Spectrum of the range compression filter, shape (n,), included as a factor; None
            for range-compressed data.
        dtype: Complex type of the result.

    Returns:
        Filter, shape (..., d, n), for d Doppler rows and n range frequencies.
    """
    h = basis.phasors(basis.turn_table(bulk_turns(basis, at, range_m), dtype), dtype)
    return h if reference is None else h * reference.to(dtype)


def refocus_turns_per_sample(at: FrameGeometry) -> Tensor:
    """Compute the azimuth phase that the bulk filter leaves per range sample.

    The bulk filter is exact at its reference range. Every range step dr away from it leaves
    (2 dr / c) (G - f0) turns, with the mapping G - f0 of `wavenumber` at the carrier frequency f0.

    Args:
        at: Geometry of the Doppler rows.

    Returns:
        Turns per range sample, shape (..., d), float64.
    """
    zero = torch.zeros(1, dtype=torch.float64, device=at.doppler_hz.device)
    return (2 * at.radar.range_step_m / at.radar.wave_speed_m_s) * at.mapped(zero)[..., 0]


def refocus(rows: Tensor, turns_per_sample: Tensor, centre: int) -> Tensor:
    """Apply the azimuth compression that the bulk filter leaves out away from its reference range.

    The bulk filter focuses at one reference range. At every other range, a phase remains that is
    linear in the distance from the reference range and depends on the Doppler frequency.

    Args:
        rows: Azimuth spectra after the bulk filter, shape (..., Doppler, range), complex.
        turns_per_sample: Remaining phase per range sample in cycles, shape (..., Doppler).
        centre: Index of the range sample at the reference range of the bulk filter.

    Returns:
        Focused azimuth spectra, same shape.
    """
    return rows * linear_phasor(turns_per_sample, -centre, rows.shape[-1], rows.dtype)


def row_tables(
    basis: FrequencyBasis, at: FrameGeometry, range_m: Tensor | float, raw: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Compute small tables, from which the filters of Doppler rows are formed in blocks.

    Args:
        basis: Polynomials that interpolate phases over the range band.
        at: Geometry of the Doppler rows.
        range_m: Slant range in metres of the middle sample.
        raw: Data that give the number of range samples and the dtype.

    Returns:
        Table of the bulk filter for `FrequencyBasis.phasors`, and the two of the phasors of
        refocusing for `outer_phasor`, each of shape (..., d, m).
    """
    n = raw.shape[-1]
    return (
        basis.turn_table(bulk_turns(basis, at, range_m), raw.dtype),
        *phasor_tables(refocus_turns_per_sample(at), -(n // 2), n, raw.dtype),
    )


def tabulated(
    build: Callable[[FrameGeometry], tuple[Tensor, ...]], geometry: FrameGeometry, once: bool = True
) -> Callable[[slice], tuple[Tensor, ...]]:
    """Return a function that gives the tables of some Doppler rows.

    Args:
        build: Computes tables (..., d, m) of the rows of a geometry.
        geometry: Geometry of all Doppler rows.
        once: Compute those of all rows at once. Where False, they are computed for each request,
            which saves memory where tables are as large as the data.

    Returns:
        Function of a slice of the Doppler axis.
    """
    if not once:
        return lambda part: build(geometry.rows(part))
    tables = build(geometry)
    return lambda part: tuple(table[..., part, :] for table in tables)


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
    """Focus raw data by omega-K without Stolt interpolation: a bulk filter, then refocusing.

    The bulk filter is exact in the middle of the swath; refocusing corrects the azimuth phase at
    all other ranges. The change of range migration over the swath is neglected: `requirements`
    predicts the error, and `omega_k_stolt` avoids it. A focused target at slant range R has the
    phase -4 pi R / lambda. Differentiable in the raw data, the velocity and `frame_hz`. Where no
    gradients are required, memory is saved: Doppler rows are processed in blocks that overwrite one
    copy of the data.

    Args:
        raw: Raw or range-compressed data, shape (..., pulse, range), complex.
        radar: Radar of the recording.
        doppler_hz: Absolute Doppler centroid in Hz, about which the azimuth spectrum is unwrapped,
            a number or shape (...,).
        velocity_m_s: Effective velocity in m/s, a number or shape (...,); None for that of the
            radar.
        frame_hz: Doppler frequency in Hz of the line of sight that defines the image coordinates, 0
            for a zero-Doppler image; None for the nominal pointing of the radar, or for the
            centroid where the radar has none.
        reference: Spectrum of the range compression filter, shape (range,); None for
            range-compressed data.
        band_hz: Processed Doppler bandwidth about the centroid in Hz; None for the whole PRF.

    Returns:
        Image, shape (..., azimuth, range), complex.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples, or if `doppler_hz` or `velocity_m_s` is neither a
            number nor a tensor in the shape of the leading dims of the data. Also if the velocity
            is not positive, the magnitude of `doppler_hz` or `frame_hz` is not below 2 velocity /
            wavelength, or `band_hz` is not positive.

    Reference:
        Tsvetkov 2017, focusing steps 1 to 5 after Eq. (2).
    """
    raw = checked_samples(raw, "omega_k", "pulse, range", finite=False)
    geometry = FrameGeometry.of(radar, raw, doppler_hz, velocity_m_s, frame_hz, band_hz=band_hz)
    n = raw.shape[-1]
    basis = FrequencyBasis(radar, n, raw.device, geometry.sin_reach)
    range_m = radar.near_range_m + n // 2 * radar.range_step_m

    tables = tabulated(lambda at: row_tables(basis, at, range_m, raw), geometry, not basis.direct)
    reference = None if reference is None else reference.to(raw.dtype)

    def focus_rows(rows: Tensor, part: slice) -> Tensor:
        bulk, fine, coarse = tables(part)
        if reference is not None:
            rows = rows * reference
        lines = torch.fft.ifft(rows * basis.phasors(bulk, raw.dtype))
        return geometry.rows(part).weighted(lines * outer_phasor(fine, coarse, n))

    return through_doppler(raw, focus_rows, differentiable=geometry.requires_grad or raw.requires_grad)


def is_whole(raw: Tensor, differentiable: bool) -> bool:
    """Return whether all Doppler rows are processed at once, not in blocks.

    Args:
        raw: Raw data.
        differentiable: Whether gradients are required.

    Returns:
        True for gradients, and in a traced program, in which every block repeats all operations.
    """
    return is_traced(raw) or (differentiable and torch.is_grad_enabled())


def through_doppler(
    raw: Tensor, focus_rows: Callable[[Tensor, slice], Tensor], differentiable: bool, block_bytes: int | None = None
) -> Tensor:
    """Apply a function to the rows of the two-dimensional spectrum, then an inverse azimuth FFT.

    Where gradients are required, and in a traced program, all rows are processed at once. Otherwise
    memory is saved: rows are processed in blocks that overwrite one copy of the data.

    Args:
        raw: Raw data, shape (..., pulse, range), complex.
        focus_rows: Maps rows (..., d, range frequency) and their slice of the Doppler axis to (...,
            d, range).
        differentiable: Whether gradients are required.
        block_bytes: Size of a block in bytes; None for a size that suits the device.

    Returns:
        Image, same shape as the data.
    """
    if is_whole(raw, differentiable):
        return torch.fft.ifft(focus_rows(torch.fft.fft2(raw), slice(None)), dim=-2)
    # the range FFT of a block of rows shares its stay in the cache with their focusing
    work = transform_in_blocks(raw, -2, out=torch.empty_like(raw, memory_format=torch.contiguous_format))
    block_bytes = block_bytes_of(raw.device) if block_bytes is None else block_bytes
    height = max(1, block_bytes // max(1, work[..., 0, :].numel() * work.element_size()))

    def focus(part: slice) -> None:
        work[..., part, :] = focus_rows(torch.fft.fft(work[..., part, :]), part)

    over_blocks(focus, (slice(first, first + height) for first in range(0, work.shape[-2], height)), work)
    return transform_in_blocks(work, -2, inverse=True)


class Focuser(Stage):
    """Base class of the stages that focus stripmap data, such as `OmegaK`.

    The image shows a target where a chosen line of sight crosses it: azimuth follows from the slow
    time of the crossing, range is the slant range there. `frame_hz` is the Doppler frequency of
    that line of sight. Values passed to `forward`, such as estimates that a chain connects, take
    precedence over those given here. A subclass sets `form`, the function that focuses.

    Args:
        radar: Radar of the recording.
        reference: Filter that compresses the pulses in range in the same pass: "matched", "flat" or
            "phase", see `RangeCompress`; None for range-compressed data.
        velocity_m_s: Effective velocity in m/s: a number, a tensor per trial, or an nn.Parameter to
            optimise; None for that of the radar.
        doppler_hz: Absolute Doppler centroid in Hz: a number, a tensor per trial, or an
            nn.Parameter; None for the nominal pointing of the radar, or 0 where it has none.
        frame_hz: Doppler frequency of that line of sight in Hz, 0 for a zero-Doppler image; None
            for the nominal pointing of the radar, or for the centroid where the radar has none.
        band_hz: Processed Doppler bandwidth in Hz; None for the whole PRF.

    Raises:
        ValueError: If `reference` is not known.
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
        """Return the spectrum of the range compression filter, or None for range-compressed data.

        Args:
            n: Number of samples of a range line.
            device: Device of the result.

        Returns:
            Spectrum in FFT order, shape (n,), complex128, or None.
        """
        if self.reference is None:
            return None
        return REFERENCES[self.reference](self.radar.pulse, n, self.radar.sampling_hz, device)

    def forward(self, signal: Signal, doppler_hz: Tensor | None = None, velocity_m_s: Tensor | None = None) -> Signal:
        """Focus a signal with axes (pulse, range).

        Args:
            signal: Recording.
            doppler_hz: Doppler centroid in Hz; None for that of the stage.
            velocity_m_s: Effective velocity in m/s; None for that of the stage.

        Returns:
            Image with axes (azimuth, range).

        Raises:
            ValueError: If a Doppler frequency, the velocity or the processed band is not valid, see
                `omega_k`.
        """
        data = type(self).form(
            signal.data,
            replace(self.radar, near_range_m=signal.axes[-1].start),
            doppler_hz=self.doppler_hz if doppler_hz is None else doppler_hz,
            velocity_m_s=self.velocity_m_s if velocity_m_s is None else velocity_m_s,
            frame_hz=self.frame_hz,
            reference=self.spectrum(signal.data.shape[-1], signal.data.device),
            band_hz=self.band_hz,
        )
        azimuth, range_ = self.radar.image_axes(signal.axes)
        return Signal(data, (azimuth.resampled(data.shape[-2] // azimuth.n), range_))


class OmegaK(Focuser):
    """Stage that focuses stripmap data by omega-K without Stolt interpolation, see `omega_k`.

    >>> from torchsar import Draws, echo, focus, radar, scene
    >>> sensor = radar.StripmapRadar(carrier_hz=3.2e9, pulse=radar.LinearFM(40e6, 0.5e-6),
    ...     sampling_hz=48e6, prf_hz=400.0, velocity_m_s=120.0, near_range_m=4000.0)
    >>> world = scene.StripmapWorld(scene.Points([0.0], [0.0]), scene.Dwell(0.2))
    >>> recording, _ = echo.simulate(sensor, world, n_pulse=128, n_range=96, draws=Draws(1))
    >>> image = focus.OmegaK(sensor)(recording.signal)
    >>> divmod(int(image.data.abs().argmax()), 96)  # line and sample of the peak
    (64, 36)

    Arguments as in its base class `Focuser`.
    """

    form = staticmethod(omega_k)
