"""Matched Fourier transform: azimuth focusing of a target with non-uniform rotation.

The rotation angle is Om phi(t), with the rotation rate Om at the first pulse (t = 0) and the warp
phi(t) = t + k1 t^2 / 2! + k2 t^3 / 3! + ... A scatterer at cross range x in range sample n
contributes

    exp(-j c4 x Om phi(t)) exp(+j (c4/2) (y_n + yc) Om^2 phi(t)^2),    c4 = 4 pi / wavelength,

where y_n + yc is its range from the rotation centre. `range_phase` removes the second factor, and
`matched_fourier` focuses the first by a Fourier transform over phi. From the pulses s(m, n) with
weights w_m, line q of the image is

    I(q, n) = sum_m w_m s(m, n) exp(+2j pi c_q u_m) / sqrt(pulses).

Here u_m = phi(t_m) / phi(T) is the relative angle of pulse m, from 0 to below 1, T = pulses / PRF
the aperture time, and c_q = (q - lines // 2) / oversampling the position of line q in Doppler cells
of 1 / T. The image axis c_q / T is Doppler at the mean rotation rate; the cross range of line q is
wavelength c_q / (2 Om phi(T)). The data do not show the sign of Om, so that images may be mirrored
in x.

Reference:
    Remote Sens. 2025, 17, 3447, Eqs. (7)-(10), with `radar.warp`; Greengard and Lee 2004
    (non-uniform FFT).
"""

from __future__ import annotations

import warnings

import torch
from torch import Tensor

from torchsar.core import (
    Axis,
    Signal,
    Stage,
    checked_samples,
    host_largest,
    host_value,
    outer_phasor,
    per_trial,
    phasor_tables,
    real_dtype,
    unit_phasor,
)
from torchsar.focus.image_lines import CrossRangeLines, DopplerLines
from torchsar.focus.transforms import Gridding, Transform
from torchsar.focus.warped_sums import PulsesToLines, Sum, normalised_warp, slow_times
from torchsar.radar import InverseRadar
from torchsar.radar.warp import least_rate, warp, warp_rate

# shorter records are rejected as invalid input, by choice
MIN_PULSES = 8
# By default the image covers Doppler frequencies of one pulse rate, with two lines per Doppler
# cell, and the sums are computed by gridding.
_DOPPLER_LINES, _GRIDDING = DopplerLines(), Gridding()


def range_phase(
    data: Tensor,
    range_m: Tensor,
    wavelength_m: float,
    prf_hz: float,
    omega_rad_s: Tensor | float,
    k: Tensor,
    yc_m: Tensor | float = 0.0,
) -> Tensor:
    """Remove the phase that the range of a scatterer adds during the rotation.

    >>> import torch
    >>> from torchsar.focus import range_phase
    >>> pulses, range_m = torch.ones(3, 2, dtype=torch.complex64), torch.tensor([0.0, 1.0]).double()
    >>> out = range_phase(pulses, range_m, 0.03, prf_hz=1.0, omega_rad_s=0.05, k=torch.zeros(0))
    >>> out[1:, 1].angle().round(decimals=2)  # at a range of 1 m
    tensor([-0.5200, -2.0900])

    Multiplies range sample n by exp(-2j pi (y_n + yc) (Om phi)^2 / wavelength), where Om phi(t) is
    the rotation angle with the warp phi(t). Use it before `matched_fourier`. Differentiable in all
    arguments except `range_m`.

    Args:
        data: Range-compressed pulses, shape (..., pulse, range), complex.
        range_m: Range y_n of the samples from the assumed rotation centre in metres, shape
            (range,), float64, evenly spaced.
        wavelength_m: Carrier wavelength in metres.
        prf_hz: Pulse rate in Hz.
        omega_rad_s: Rotation rate Om at the first pulse in rad/s, a number or shape (...,).
        k: Coefficients k1, k2, ... of the warp t + k1 t^2 / 2! + k2 t^3 / 3! + ... in 1/s, 1/s^2,
            ..., shape (..., order - 1).
        yc_m: Range centre deviation yc in metres, a number or shape (...,); y_n + yc is the
            distance from the rotation centre.

    Returns:
        Pulses of the same shape.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples.

    Reference:
        Remote Sens. 2025, 17, 3447, Eqs. (7)-(8).
    """
    data = checked_samples(data, "range_phase", "pulse, range", finite=False)
    n_pulse, n_range = data.shape[-2:]
    phi = warp(slow_times(n_pulse, prf_hz, data.device), k.to(torch.float64))
    # cycles per metre of range
    slope = -(per_trial(omega_rad_s, 1, data) * phi).square() / wavelength_m
    ends = range_m[:2].to(torch.float64)
    start, step = ends[0], ends[1] - ends[0] if n_range > 1 else torch.ones_like(ends[0])
    fine, coarse = phasor_tables(slope * step, start / step, n_range, data.dtype)
    offset = unit_phasor(slope * per_trial(yc_m, 1, data), data.dtype)
    return data * outer_phasor(fine, coarse * offset[..., None], n_range)


def matched_fourier(
    data: Tensor,
    warp_k: Tensor,
    prf_hz: float,
    *,
    lines: DopplerLines | CrossRangeLines = _DOPPLER_LINES,
    transform: Transform = _GRIDDING,
    weight: str = "matched",
) -> Tensor:
    """Form the image of a target with non-uniform rotation by a Fourier transform over its angle.

    >>> import torch
    >>> from torchsar.focus import matched_fourier
    >>> t, k = torch.arange(64) / 100.0, torch.tensor([1.0])
    >>> point = torch.exp(-2j * torch.pi * 20 * (t + k * t**2 / 2))[:, None]  # rate grows
    >>> [round(float(matched_fourier(point, k, 100.0).abs().max()), 1) for k in (0 * k, k)]
    [3.3, 7.9]

    The rotation angle is proportional to the warp. Where the target is deeper in range than the
    depth of focus, 2 (cross-range resolution)^2 / wavelength, first remove the phase of the range
    with `range_phase`. Differentiable in the data, the warp and the rotation rate of
    `CrossRangeLines`: twice, or once with `CompiledNufft`.

    Args:
        data: Range-compressed pulses, shape (..., pulse, range), complex.
        warp_k: Coefficients k1, k2, ... of the warp t + k1 t^2 / 2! + k2 t^3 / 3! + ... in 1/s,
            1/s^2, ..., shape (..., order - 1), with an empty last dim for uniform rotation. Leading
            dims broadcast with those of the data.
        prf_hz: Pulse rate in Hz.
        lines: Image lines: `DopplerLines`, or `CrossRangeLines` for an axis in metres.
        transform: How the sum is formed: `Gridding`, `ExplicitSum`, `Resampling` or
            `CompiledNufft`.
        weight: "matched" for equal weights of the pulses, with the best signal-to-noise ratio;
            "warped" for weights proportional to the rotation rate, as in the integral of Eq. (9).

    Returns:
        Image, shape (..., line, range), of the dtype of the data. A scatterer with the amplitude a
        in every pulse has a peak of a sqrt(pulses) with weight "matched".

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples, or if there are fewer than 8 pulses, or `weight` is not
            known.

    Reference:
        Remote Sens. 2025, 17, 3447, Eqs. (9)-(10).
    """
    data = checked_samples(data, "matched_fourier", "pulse, range", finite=False)
    operator = MatchedFourierOperator(
        warp_k.to(data.device),
        data.shape[-2],
        prf_hz,
        dtype=data.dtype,
        lines=lines,
        transform=transform,
        weight=weight,
    )
    return operator.image(data)


class MatchedFourierOperator:
    """Linear map of `matched_fourier` for one warp per trial, with its exact adjoint.

    >>> import torch
    >>> from torchsar import focus
    >>> operator = focus.MatchedFourierOperator(torch.tensor([1.0]), n_pulse=64, prf_hz=100.0)
    >>> image = operator.image(torch.ones(64, 3, dtype=torch.complex64))
    >>> image.shape, operator.adjoint(image).shape
    (torch.Size([128, 3]), torch.Size([64, 3]))

    The tables of the transform do not depend on the data. They are computed once, at construction.

    Args:
        warp_k: Coefficients k1, k2, ... of the warp t + k1 t^2 / 2! + k2 t^3 / 3! + ... in 1/s,
            1/s^2, ..., shape (..., order - 1).
        n_pulse: Number of pulses of the data.
        prf_hz: Pulse rate in Hz.
        dtype: Complex type of the data.
        lines: Image lines, see `matched_fourier`.
        transform: How the sum is formed, see `matched_fourier`.
        weight: "matched" or "warped", see `matched_fourier`.

    Raises:
        ValueError: If `n_pulse` is below 8, or `weight` is not known.
    """

    def __init__(
        self,
        warp_k: Tensor,
        n_pulse: int,
        prf_hz: float,
        *,
        dtype: torch.dtype = torch.complex64,
        lines: DopplerLines | CrossRangeLines = _DOPPLER_LINES,
        transform: Transform = _GRIDDING,
        weight: str = "matched",
    ) -> None:
        if n_pulse < MIN_PULSES:
            raise ValueError(f"a matched Fourier transform needs at least {MIN_PULSES} pulses, got {n_pulse}")
        _check_weight(weight)
        self.n_pulse, self.dtype, self.lines = n_pulse, dtype, lines.number(n_pulse)
        k = warp_k.to(torch.float64)
        u, rate = normalised_warp(k, n_pulse, prf_hz)
        step = lines.cells_per_line(k, n_pulse / prf_hz)
        self.weight = rate.to(real_dtype(dtype)) if weight == "warped" else None
        self.transform: Sum = transform.build(PulsesToLines(k, n_pulse, prf_hz, u, step, self.lines, dtype))

    def image(self, pulses: Tensor) -> Tensor:
        """Form the image of range-compressed pulses.

        Args:
            pulses: Pulses, shape (..., pulse, range), complex.

        Returns:
            Image, shape (..., line, range).

        Raises:
            TypeError: If the dtype is not that of the operator.
            ValueError: If the number of pulses is not that of the operator.
        """
        self._check(pulses, self.n_pulse, "pulses")
        return self.transform.forward(pulses if self.weight is None else pulses * self.weight[..., None])

    def adjoint(self, image: Tensor) -> Tensor:
        """Apply the adjoint of `image`, which maps an image to pulses.

        Args:
            image: Image, shape (..., line, range), complex.

        Returns:
            Pulses, shape (..., pulse, range), with <image(p), i> = <p, adjoint(i)> and <a, b> =
            sum a conj(b).

        Raises:
            TypeError: If the dtype is not that of the operator.
            ValueError: If the number of lines is not that of the operator.
        """
        self._check(image, self.lines, "lines")
        pulses = self.transform.adjoint(image)
        return pulses if self.weight is None else pulses * self.weight[..., None]

    def _check(self, x: Tensor, n: int, what: str) -> None:
        """Raise where x is not of the dtype and size that the operator was built for."""
        if x.dtype != self.dtype:
            raise TypeError(
                f"this matched Fourier transform was built for {self.dtype}, got data of {x.dtype}; build it "
                f"with dtype={x.dtype}"
            )
        if x.ndim < 2 or x.shape[-2] != n:
            raise ValueError(
                f"data of this matched Fourier transform must have the last dims ({what}, range) with {n} {what}, "
                f"got shape {tuple(x.shape)}"
            )


def _check_weight(weight: str) -> None:
    """Raise ValueError for an unknown weighting of the pulses."""
    if weight not in ("matched", "warped"):
        raise ValueError(f"weight {weight!r} of the pulses is not known; choose 'matched' or 'warped'")


class RangePhase(Stage):
    """Stage that removes the phase that the range of scatterers adds during the rotation.

    Use it before `MatchedFourier`. It applies `range_phase` with the range axis of the signal.
    Values passed to `forward`, such as estimates that a chain connects, take precedence over those
    given here.

    Args:
        radar: Radar of the recording.
        omega_rad_s: Rotation rate at the first pulse in rad/s; None for that of the radar.
        warp_k: Coefficients k1, k2, ... of the warp t + k1 t^2 / 2! + k2 t^3 / 3! + ... in 1/s,
            1/s^2, ..., shape (..., order - 1); None for uniform rotation.
        yc_m: Range centre deviation in metres, added to the range axis to give the distance from
            the rotation centre; None for 0.

    Raises:
        ValueError: On use, if no rotation rate is known or the rotation angle does not increase
            throughout the aperture.
    """

    omega_rad_s: Tensor | None
    warp_k: Tensor | None
    yc_m: Tensor | None

    def __init__(
        self,
        radar: InverseRadar,
        omega_rad_s: Tensor | float | None = None,
        warp_k: Tensor | None = None,
        yc_m: Tensor | float | None = None,
    ) -> None:
        super().__init__()
        self.radar = radar
        _hold_given(
            self, omega_rad_s=radar.rotation_rad_s if omega_rad_s is None else omega_rad_s, warp_k=warp_k, yc_m=yc_m
        )

    def forward(
        self,
        signal: Signal,
        omega_rad_s: Tensor | None = None,
        warp_k: Tensor | None = None,
        yc_m: Tensor | None = None,
    ) -> Signal:
        """Remove the phase of the range from a signal with axes (pulse, range).

        Args:
            signal: Range-compressed pulses.
            omega_rad_s: Rotation rate at the first pulse in rad/s; None for that of the stage.
            warp_k: Coefficients k1, k2, ... of the warp t + k1 t^2 / 2! + ..., shape (..., order -
                1); None for those of the stage.
            yc_m: Range centre deviation in metres, added to the range axis to give the distance
                from the rotation centre; None for that of the stage.

        Returns:
            Corrected signal on the same axes.

        Raises:
            ValueError: If no rotation rate is known or the rotation angle does not increase
                throughout the aperture.
        """
        pulse, range_ = signal.axes
        omega, yc = self.omega_rad_s if omega_rad_s is None else omega_rad_s, self.yc_m if yc_m is None else yc_m
        if omega is None:
            raise ValueError(
                "RangePhase needs a rotation rate in rad/s, got none; set radar.rotation_rad_s, give omega_rad_s, "
                "or connect an estimate of it"
            )
        k = _warp_of(signal, self.warp_k if warp_k is None else warp_k)
        return signal.with_data(
            range_phase(
                signal.data,
                range_.values(),
                self.radar.wavelength_m,
                1 / pulse.step,
                omega,
                k,
                0.0 if yc is None else yc,
            )
        )


class MatchedFourier(Stage):
    """Stage that forms the image (azimuth, range) of a target with non-uniform rotation.

    It applies `matched_fourier`. The azimuth axis is Doppler in Hz at the mean rotation rate, the
    same for all trials, or cross range in metres where `cross_range_m` is given. Values passed to
    `forward`, such as estimates that a chain connects, take precedence over those given here.

    Args:
        radar: Radar of the recording.
        oversampling: Image lines per Doppler cell, which is 1 / aperture time.
        lines: Number of image lines about Doppler zero; None for the whole pulse rate.
        weight: "matched" or "warped", see `matched_fourier`.
        transform: How the sum over pulses is formed, see `matched_fourier`.
        cross_range_m: Step in metres and number of lines of an azimuth axis in metres; replaces
            `oversampling` and `lines` and needs a rotation rate.
        warp_k: Coefficients k1, k2, ... of the warp t + k1 t^2 / 2! + k2 t^3 / 3! + ... in 1/s,
            1/s^2, ..., shape (..., order - 1); None for uniform rotation.
        omega_rad_s: Rotation rate at the first pulse in rad/s; None for that of the radar.

    Raises:
        ValueError: If `oversampling` is not positive, `lines` is below 1, or `weight` is not known.
            On use: if the rotation angle does not increase throughout the aperture, if
            `cross_range_m` is given without a rotation rate, or if the outermost line in metres has
            a Doppler above the pulse rate. The stage warns if this Doppler exceeds 0.95 times half
            the pulse rate.
    """

    takes_empty = False

    omega_rad_s: Tensor | None
    warp_k: Tensor | None

    def __init__(
        self,
        radar: InverseRadar,
        oversampling: float = 2.0,
        lines: int | None = None,
        weight: str = "matched",
        transform: Transform = _GRIDDING,
        cross_range_m: tuple[float, int] | None = None,
        warp_k: Tensor | None = None,
        omega_rad_s: Tensor | float | None = None,
    ) -> None:
        super().__init__()
        _check_weight(weight)
        DopplerLines(oversampling, lines)  # the constructor checks both values
        self.radar, self.oversampling, self.lines, self.cross_range_m = radar, oversampling, lines, cross_range_m
        if cross_range_m is not None:
            step_m, count = cross_range_m
            self.cross_range_m = step_m, round(count)  # numbers of a config are floats
        self.weight, self.transform = weight, transform
        _hold_given(self, omega_rad_s=radar.rotation_rad_s if omega_rad_s is None else omega_rad_s, warp_k=warp_k)

    def operator(
        self, signal: Signal, warp_k: Tensor | None = None, omega_rad_s: Tensor | None = None
    ) -> MatchedFourierOperator:
        """Return the linear map from the pulses of a signal to the image, for autofocus.

        Args:
            signal: Recording, axes (pulse, range).
            warp_k: Coefficients k1, k2, ... of the warp t + k1 t^2 / 2! + ..., shape (..., order -
                1); None for those of the stage.
            omega_rad_s: Rotation rate at the first pulse in rad/s; None for that of the stage.

        Returns:
            Map from pulses to the image, with its adjoint.

        Raises:
            ValueError: If the rotation angle does not increase throughout the aperture, or lines in
                metres lack a rotation rate or have a Doppler above the pulse rate.
        """
        pulse = signal.axis("pulse")
        k = _warp_of(signal, self.warp_k if warp_k is None else warp_k)
        omega = self.omega_rad_s if omega_rad_s is None else omega_rad_s
        return MatchedFourierOperator(
            k,
            pulse.n,
            1 / pulse.step,
            dtype=signal.data.dtype,
            lines=self._lines(k, pulse, omega),
            transform=self.transform,
            weight=self.weight,
        )

    def forward(self, signal: Signal, warp_k: Tensor | None = None, omega_rad_s: Tensor | None = None) -> Signal:
        """Form the image of a signal with axes (pulse, range).

        Args:
            signal: Range-compressed pulses.
            warp_k: Coefficients k1, k2, ... of the warp t + k1 t^2 / 2! + ..., shape (..., order -
                1); None for those of the stage.
            omega_rad_s: Rotation rate at the first pulse in rad/s; None for that of the stage.

        Returns:
            Image with axes (azimuth, range).

        Raises:
            ValueError: If the rotation angle does not increase throughout the aperture, or lines in
                metres lack a rotation rate or have a Doppler above the pulse rate.
        """
        operator = self.operator(signal, warp_k, omega_rad_s)
        return Signal(
            operator.image(signal.data), (self._azimuth(signal.axis("pulse"), operator.lines), signal.axis("range"))
        )

    def _lines(self, k: Tensor, pulse: Axis, omega_rad_s: Tensor | None) -> DopplerLines | CrossRangeLines:
        """Image lines. Those in metres are checked against the pulse rate."""
        if self.cross_range_m is None:
            return DopplerLines(self.oversampling, self.lines)
        if omega_rad_s is None:
            raise ValueError(
                "image lines in metres need omega_rad_s, got None; set radar.rotation_rad_s, give omega_rad_s, "
                "connect an estimate of it, or leave out cross_range_m for a Doppler axis"
            )
        lines = CrossRangeLines(*self.cross_range_m, omega_rad_s, self.radar.wavelength_m)
        _check_pulse_rate(lines, k, pulse)
        return lines

    def _azimuth(self, pulse: Axis, lines: int) -> Axis:
        """Azimuth axis of the image."""
        step, unit = (
            (1 / (self.oversampling * pulse.n * pulse.step), "Hz")
            if self.cross_range_m is None
            else (self.cross_range_m[0], "m")
        )
        return Axis("azimuth", lines, -(lines // 2) * step, step, unit)


def _hold_given(stage: Stage, **values: Tensor | float | None) -> None:
    """Store constants of a stage as buffers or parameters, and None where there is no value."""
    for name, value in values.items():
        if value is None:
            setattr(stage, name, None)
        else:
            stage.hold(name, value)


def _warp_of(signal: Signal, k: Tensor | None) -> Tensor:
    """Derivatives k of the warp on the device of the signal, empty if there are none.

    Raises ValueError where the shape of k does not fit or the rotation angle does not increase
    throughout the aperture.
    """
    if k is None:
        return torch.zeros(0, dtype=torch.float64, device=signal.data.device)
    if k.ndim == 0 or not _broadcasts(k.shape[:-1], signal.trials):
        raise ValueError(
            f"warp_k must have the shape (order - 1,), or (..., order - 1) with leading dims that broadcast with the "
            f"trials {tuple(signal.trials)} of the data, got the shape {tuple(k.shape)}"
        )
    k, pulse = k.to(device=signal.data.device, dtype=torch.float64), signal.axis("pulse")
    least = least_rate(k.detach(), pulse.n * pulse.step)
    bad = host_value((~(least > 0)).sum(), 0)
    if bad:
        raise ValueError(
            f"the rotation angle does not increase throughout the aperture in {bad} of {least.numel()} trials: "
            "two times have the same angle, and no image can be formed; check warp_k"
        )
    return k


def _broadcasts(a: torch.Size, b: torch.Size) -> bool:
    """True if two shapes broadcast."""
    return all(m == n or 1 in (m, n) for m, n in zip(reversed(a), reversed(b)))


def _check_pulse_rate(lines: CrossRangeLines, k: Tensor, pulse: Axis) -> None:
    """Warn or raise where the outermost line has a Doppler beyond half the pulse rate at the
    fastest rotation, so that lines show aliases.
    """
    fastest = warp_rate(pulse.offsets(k.device), k.detach()).amax(-1)
    omega = torch.as_tensor(lines.omega_rad_s).detach()
    share = (
        4
        * (per_trial(omega, 0, k).abs() * fastest)
        * (lines.step_m * (lines.count // 2))
        / lines.wavelength_m
        * pulse.step
    )
    worst = host_largest(share, 0.0)
    reach = (
        f"the outermost of {lines.count} lines {lines.step_m:g} m apart has a Doppler of {worst:.3g} times half "
        "the pulse rate"
    )
    if worst > 2:
        raise ValueError(f"{reach}, so that every scatterer would show more than once; choose fewer lines")
    if worst > 0.95:
        warnings.warn(f"{reach}: scatterers there are aliased; choose fewer lines or a higher pulse rate", stacklevel=5)
