"""The recommended estimator of non-uniform rotation, estimators of its first steps alone, and the
autofocus of a rotating target.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchsar.compensate.pulse_phase import autofocus
from torchsar.compensate.pulse_phase.assess import conclude
from torchsar.compensate.pulse_phase.data import find_phases, pair_phase, prepare, refuse_odd_counts, starting_phase
from torchsar.compensate.pulse_phase.fixed_point import LogAbove, Run, Wiener, fixed_point, in_turn
from torchsar.compensate.pulse_phase.imaging import Through
from torchsar.compensate.rotation.assess import judged_fit, judged_motion
from torchsar.compensate.rotation.coarse import coarse_warp
from torchsar.compensate.rotation.histories import refined_by_histories
from torchsar.compensate.rotation.image_entropy import k_name, uniform_rotation, values_of
from torchsar.compensate.rotation.motion import SEARCH_EPS, Motion, Sampling, each
from torchsar.compensate.rotation.scatterers import (
    LEAST_EXPLAINED,
    MOST,
    ROUNDS,
    Fit,
    explained_share,
    fit_scatterers,
)
from torchsar.core import (
    Estimate,
    Signal,
    Stage,
    block_bytes_of,
    checked_samples,
    differentiable,
    level_of,
    over_blocks,
    refuse_non_finite,
    settle,
)
from torchsar.focus.image_lines import DopplerLines
from torchsar.focus.matched_fourier import MatchedFourierOperator, range_phase
from torchsar.focus.transforms import Gridding
from torchsar.radar import InverseRadar
from torchsar.radar.warp import k_of_shape, shape_of


@differentiable("no")
def uneven_rotation(
    data: Tensor,
    *,
    wavelength_m: float,
    prf_hz: float,
    range_m: Tensor,
    order: int = 3,
    yc_m: Tensor | float | None = None,
    scatterers: int | None = None,
    rounds: int = ROUNDS,
    assess: bool = True,
) -> Estimate:
    """Estimate the rotation of a target with non-uniform rotation; the recommended estimator.

    >>> import torch
    >>> from torchsar.compensate import uneven_rotation
    >>> pulses = torch.ones(64, 4, dtype=torch.complex64)
    >>> range_m = torch.arange(4, dtype=torch.float64)
    >>> found = uneven_rotation(pulses, wavelength_m=1e-6, prf_hz=1e3, range_m=range_m)
    >>> found["warp_k"].shape, bool(found.ok)  # nothing off the axis shows a rotation
    (torch.Size([2]), False)

    No values to start from and no search bounds are needed. The estimator has three steps:
    correlation of the Doppler spectra of short sections (`coarse_warp`), least squares on the phase
    histories of bright scatterers (`refined_by_histories`), and a joint maximum-likelihood fit of
    the rotation and every scatterer (`fit_scatterers`).

    The rotation rate is found only from the phase curvature, which grows with range. Scatterers at
    several ranges are therefore needed: if all lie in one range cell and `yc_m` is not given, the
    rate cannot be found.

    Args:
        data: Range-compressed pulses, shape (..., pulse, range), complex, at least 8 pulses.
        wavelength_m: Wavelength in metres.
        prf_hz: Pulse repetition frequency in Hz.
        range_m: Range coordinates y_n of the cells in metres, evenly spaced, shape (range,).
        order: Degree of the polynomial of time that describes the rotation angle: 1 for uniform
            rotation, 2, 3 or more.
        yc_m: Range centre deviation yc in metres (a cell at range y lies at y + yc from the
            rotation centre), if known a priori, a number or shape (...,); None estimates it.
        scatterers: Largest number of scatterers; more are more accurate and take longer. By default
            one for every 1000 samples of a trial, within 128..800, and twice as many in trials
            where these explain less than half of the energy.
        rounds: Largest number of maximum-likelihood steps.
        assess: False leaves out the assessment: no standard deviations, outcome NOT_ASSESSED.

    Returns:
        `omega_rad_s`, the rotation rate at the first pulse, shape (...,); `warp_k`, its relative
        derivatives k1, k2, ... in 1/s, 1/s^2, ..., shape (..., order - 1), and each of them as
        `k1_per_s`, `k2_per_s2`, ...; and `yc_m`, the range centre deviation, shape (...,). The data
        do not show the sign of the rotation rate, so `omega_rad_s` is positive and the image may be
        mirrored in cross range. Standard deviations are averages of what the noise explains (the
        Fisher information of the scatterers found) and of what the differences between these
        scatterers show, which counts the more, the more of them contribute; they are larger where
        energy is left that neither the scatterers nor the noise explain. From 30 dB the error is
        mostly that of scatterers in one resolution cell, which the differences show. quality is the
        share of the energy above the noise that the scatterers explain.

        Outcomes: EMPTY; NOISE if no scatterer clearly exceeds the noise; TOO_FEW with fewer than 3
        scatterers, or if a single one shows the rate; NOT_CONVERGED; MISFIT if the scatterers
        explain less than half of the energy or are not seen during the whole aperture;
        PARTS_DISAGREE if the phase histories of bright scatterers ask for another rotation; INEXACT
        if an error of the rate above 10 % is probable: 10 % of it are less than 2.7 standard
        deviations. The image is then focused, but its cross-range scale is unknown. Targets of
        several hundred scatterers on few pulses, of which the usual numbers explain a part, are
        often doubtful; a larger `scatterers` helps. info: scatterers (their number), noise_power,
        steps, and, if assessed, entropy_nats and uncompensated_entropy_nats.

    Raises:
        TypeError: If the data are not complex.
        ValueError: If the data, the range axis or `yc_m` are invalid, or a number is not a whole
            number of 1 or more.
    """
    refuse_odd_counts(
        "uneven_rotation", 1, order=order, rounds=rounds, scatterers=1 if scatterers is None else scatterers
    )

    def find(rows: Tensor, sampling: Sampling, known: Tensor | None) -> Fit:
        options = {"free_centre": known is None}
        motion = refined_by_histories(rows, sampling, _start(order, rows, sampling, known), **options)
        # with one scatterer for 1000 samples, a fit costs as much as about thirty images
        count = min(MOST, max(128, sampling.pulses * sampling.cells // 1000)) if scatterers is None else scatterers
        fit = fit_scatterers(rows, sampling, motion, **options, count=count, rounds=rounds)
        if scatterers is None:
            # trials that have many more scatterers than usual, of which most of the energy is not
            # explained, are fitted with more of them
            poor = explained_share(rows, fit)[0] < LEAST_EXPLAINED
            at = (poor & (2 * fit.scatterers.count > count)).nonzero()[:, 0]
            if len(at):
                start, count = each(lambda x: x[at], fit.motion), min(MOST, 2 * count)
                again = fit_scatterers(rows[at], sampling, start, **options, count=count, rounds=rounds)
                width = max(x.scatterers.cell.shape[-1] for x in (fit, again))
                wide = [
                    replace(x, scatterers=each(lambda y: pad(y, (0, width - y.shape[-1])), x.scatterers))
                    for x in (fit, again)
                ]
                fit = each(lambda x, y: x.index_copy(0, at, y), *wide)
        return fit

    return _over_trials("uneven_rotation", find, assess, data, wavelength_m, prf_hz, range_m, yc_m)


@differentiable("no")
def coarse_rotation(
    data: Tensor,
    *,
    wavelength_m: float,
    prf_hz: float,
    range_m: Tensor,
    order: int = 3,
    yc_m: Tensor | float | None = None,
    fits: int = 0,
    assess: bool = True,
) -> Estimate:
    """Estimate k1 and k2 from the spectra of short sections, and with `fits` also the rate.

    >>> import torch
    >>> from torchsar.compensate import coarse_rotation
    >>> pulses = torch.ones(64, 4, dtype=torch.complex64)
    >>> range_m = torch.arange(4, dtype=torch.float64)
    >>> found = coarse_rotation(pulses, wavelength_m=1e-6, prf_hz=1e3, range_m=range_m)
    >>> found["warp_k"].shape, found["k1_per_s"].shape
    (torch.Size([2]), torch.Size([]))

    This is the first step of `uneven_rotation`. The ratio of the rotation rate at time t after the
    first pulse to that at the first pulse is modelled as 1 + k1 t + k2 t^2 / 2 and is found to a
    few thousandths. Without `fits` the rotation rate itself is not estimated; `omega_rad_s` is 0.
    With `fits`, least squares on the phase histories of bright scatterers follow, the second step
    of `uneven_rotation`, which also find the rate. Four fits take half the time of
    `uneven_rotation`; the errors are two to twenty times as large.

    Args:
        data: Range-compressed pulses, shape (..., pulse, range), complex, at least 8 pulses.
        wavelength_m: Wavelength in metres.
        prf_hz: Pulse repetition frequency in Hz.
        range_m: Range coordinates y_n of the cells in metres, evenly spaced, shape (range,).
        order: Degree of the polynomial of time that describes the rotation angle. 1 is uniform
            rotation; with 2 only k1 is returned, and beyond 3 the further derivatives are 0.
        yc_m: Range centre deviation yc in metres (a cell at range y lies at y + yc from the
            rotation centre), if known a priori, a number or shape (...,). None estimates it where
            `fits` is above 0, and takes it as 0 otherwise.
        fits: Number of times that the least-squares fit to the phase histories is made.
        assess: False leaves out the assessment.

    Returns:
        `omega_rad_s`, `warp_k` with its entries, and `yc_m`, as from `uneven_rotation` but without
        standard deviations. quality is the relative decrease of exp(entropy) of the image due to
        the compensation. The outcomes refer to k1, k2, ..., not to `omega_rad_s` and `yc_m`: EMPTY;
        NOISE if no pixel clearly exceeds the noise; TOO_FEW with fewer than 3 isolated scatterers,
        or none off zero Doppler; MISFIT if they are not seen during the whole aperture;
        PARTS_DISAGREE if the phase error info["phase_error_rad"] that their phase histories show
        for the scatterer farthest from zero Doppler is above 0.47 rad rms, a Strehl ratio of 0.8.

    Raises:
        TypeError: If the data are not complex.
        ValueError: If the data, the range axis or `yc_m` are invalid, the order is not a whole
            number of 1 or more, or `fits` is not a whole number of 0 or more.
    """
    refuse_odd_counts("coarse_rotation", 1, order=order)
    refuse_odd_counts("coarse_rotation", 0, fits=fits)

    def find(rows: Tensor, sampling: Sampling, known: Tensor | None) -> Motion:
        motion = _start(order, rows, sampling, known)
        for _ in range(fits):
            motion = refined_by_histories(rows, sampling, motion, free_centre=known is None)
        return motion

    return _over_trials("coarse_rotation", find, assess, data, wavelength_m, prf_hz, range_m, yc_m)


def _start(order: int, rows: Tensor, sampling: Sampling, known: Tensor | None) -> Motion:
    """Motion with the coarse warp of `order` terms and the rate zero."""
    k = (
        coarse_warp(rows, sampling.prf_hz)
        if order > 1
        else torch.zeros(rows.shape[0], 0, dtype=torch.float64, device=rows.device)
    )
    if order == 2:
        k = k_of_shape(shape_of(k, sampling.duration_s)[:, :1], sampling.duration_s)
    zero = k.new_zeros(len(k))
    return Motion(pad(k, (0, max(0, order - 3))), zero, zero, zero if known is None else known)


def _over_trials(
    name: str,
    find: Callable[[Tensor, Sampling, Tensor | None], Motion | Fit],
    assess: bool,
    data: Tensor,
    wavelength_m: float,
    prf_hz: float,
    range_m: Tensor,
    yc_m: Tensor | float | None,
) -> Estimate:
    """Call find(rows, sampling, known centre) on blocks of trials, each divided by its
    rms level.
    """
    data = checked_samples(data, name, "pulse, range")
    sampling = Sampling.of(name, data, wavelength_m, prf_hz, range_m)
    trials, rows = data.shape[:-2], data.detach().reshape(-1, *data.shape[-2:])
    known = None if yc_m is None else torch.as_tensor(yc_m, dtype=torch.float64, device=data.device)
    if known is not None:
        refuse_non_finite(known, f"{name}: yc_m")
        if known.ndim and known.shape != trials:
            raise ValueError(
                f"{name}: yc_m must be one number (m) or one per trial {tuple(trials)}, got shape {tuple(known.shape)}"
            )
        known = known.expand(trials).reshape(-1)
    # eight times the block size that is best for one operation, found by trial
    height = max(1, 8 * block_bytes_of(data.device) // (rows[0].numel() * rows.element_size()))
    parts: dict[int, Estimate] = {}

    @torch.no_grad()
    def work(first: int) -> None:
        part = slice(first, first + height)
        level = level_of(rows[part])
        some = rows[part] / level
        found = find(some, sampling, None if known is None else known[part])
        fit = isinstance(found, Fit)
        motion = found.motion if fit else found
        motion = replace(motion, **{name: settle(getattr(motion, name), 0.0)[0] for name in ("k", "w", "v")})
        value, info = values_of(motion.omega_rad_s, motion.k, motion.yc_m), {}
        if fit:
            noise_power = found.noise * level[:, 0, 0].double().square()
            info = {"scatterers": found.scatterers.count, "noise_power": noise_power, "steps": found.steps}
        parts[first] = Estimate(value, info=info)
        if assess:
            judged = judged_fit(some, sampling, found, value) if fit else judged_motion(some, sampling, motion, value)
            parts[first] = replace(judged, info={**judged.info, **info})

    starts = range(0, rows.shape[0], height)
    over_blocks(work, starts, rows)
    return Estimate.joined([parts[first] for first in starts], trials)


class _Rotation(Stage):
    """Base of the stages that estimate a rotation. A connected yc_m replaces the setting of the
    stage.

    yc_m: the range centre deviation (m) known a priori, or None to estimate it.
    """

    differentiable = "no"

    def __init__(
        self,
        radar: InverseRadar,
        order: int,
        yc_m: float | None,
        find: Callable[..., Estimate],
        **options: Any,
    ) -> None:
        super().__init__()
        if order < 1:
            raise ValueError(f"order of the rotation must be 1 (uniform rotation) or more, got {order}")
        self.radar, self.order, self.yc_m, self.find, self.options = radar, order, yc_m, find, options
        self.provides = ("omega_rad_s", "warp_k", "yc_m", *(k_name(i) for i in range(1, order)))
        self.neutral = uniform_rotation(radar, self.provides, yc_m)

    def forward(self, signal: Signal, yc_m: Tensor | None = None) -> Estimate:
        """Estimate the rotation from a signal of axes (pulse, range).

        Args:
            signal: Range-compressed pulses, shape (..., pulse, range), complex.
            yc_m: Range centre deviation yc in metres (a cell at range y lies at y + yc from the
                rotation centre), known a priori, shape (...,).

        Returns:
            The `Estimate` of the function that the description of the stage names.
        """
        return self.find(
            signal.data,
            wavelength_m=self.radar.wavelength_m,
            prf_hz=1 / signal.axis("pulse").step,
            # the host reads only their spacing
            range_m=signal.axis("range").values(torch.device("cpu")),
            order=self.order,
            yc_m=self.yc_m if yc_m is None else yc_m,
            **self.options,
        )


class UnevenRotation(_Rotation):
    """Non-uniform rotation by the recommended estimator; see `uneven_rotation`.

    Provides `omega_rad_s` (rotation rate at the first pulse), `warp_k` (its relative derivatives)
    with its entries `k1_per_s`, `k2_per_s2`, ..., and `yc_m` (range centre deviation).

    Args:
        radar: Radar parameters.
        order: Degree of the polynomial of time that describes the rotation angle; 1 is uniform
            rotation.
        yc_m: Range centre deviation yc in metres (a cell at range y lies at y + yc from the
            rotation centre), if known a priori; None estimates it.
        scatterers: Largest number of scatterers that are fitted, by default as in
            `uneven_rotation`.
        rounds: Largest number of maximum-likelihood steps.
        assess: False leaves out the assessment.

    Raises:
        ValueError: If the order is below 1.
    """

    def __init__(
        self,
        radar: InverseRadar,
        order: int = 3,
        yc_m: float | None = None,
        scatterers: int | None = None,
        rounds: int = ROUNDS,
        assess: bool = True,
    ) -> None:
        super().__init__(radar, order, yc_m, uneven_rotation, scatterers=scatterers, rounds=rounds, assess=assess)


class CoarseRotation(_Rotation):
    """Derivatives k1 and k2 of the rotation rate, with `fits` also the rate; see `coarse_rotation`.

    They are found from the Doppler spectra of short sections of the aperture.

    Args:
        radar: Radar parameters.
        order: Degree of the polynomial of time that describes the rotation angle; 1 is uniform
            rotation.
        assess: False leaves out the assessment.
        yc_m: Range centre deviation yc in metres (a cell at range y lies at y + yc from the
            rotation centre), if known a priori; None estimates it where `fits` is above 0.
        fits: Number of least-squares fits to the phase histories of bright scatterers, which also
            find the rotation rate.

    Raises:
        ValueError: If the order is below 1.
    """

    def __init__(
        self, radar: InverseRadar, order: int = 3, assess: bool = True, yc_m: float | None = None, fits: int = 0
    ) -> None:
        super().__init__(radar, order, yc_m, coarse_rotation, fits=fits, assess=assess)


class RotationAutofocus(Stage):
    """Phase error of each pulse of a rotating target, common to all its scatterers.

    Provides `phase_rad`. If another stage provides `warp_k`, the phases are found by
    `rotation_autofocus`, otherwise by `autofocus`.

    The phase of every pulse is free and therefore also takes up the effect of the range centre
    deviation yc. If an estimator of the rotation alternates with this stage, give it a fixed yc.

    Args:
        radar: Radar parameters.
        search: Largest number of fixed-point iterations that minimise the image entropy, with and
            without a rotation.
        polish: Largest number of further iterations, which compare each pulse with a Wiener
            estimate of the scene.
        assess: False leaves out the assessment.
    """

    provides = ("phase_rad",)
    neutral = {"phase_rad": 0.0}
    differentiable = "where ok"

    def __init__(self, radar: InverseRadar, search: int = 60, polish: int = 20, assess: bool = True) -> None:
        super().__init__()
        self.radar, self.options = radar, {"search": search, "polish": polish, "assess": assess}

    def forward(
        self,
        signal: Signal,
        phase_rad: Tensor | None = None,
        omega_rad_s: Tensor | None = None,
        warp_k: Tensor | None = None,
        yc_m: Tensor | None = None,
    ) -> Estimate:
        """Estimate the phase error of every pulse of a signal of axes (pulse, range).

        Args:
            signal: Range-compressed pulses, shape (..., pulse, range), complex.
            phase_rad: Phase to start from in rad, shape (..., pulse).
            omega_rad_s: Rotation rate at the first pulse in rad/s, shape (...,); without it the
                phase that depends on the range of a scatterer is not compensated.
            warp_k: Relative derivatives k1, k2, ... of the rotation rate at the first pulse in 1/s,
                1/s^2, ..., shape (..., order - 1).
            yc_m: Range centre deviation yc in metres (a cell at range y lies at y + yc from the
                rotation centre), shape (...,); by default 0.

        Returns:
            `phase_rad` of shape (..., pulse), to be removed: the estimate of `rotation_autofocus`,
            or of `autofocus` if `warp_k` is None.

        Raises:
            TypeError: If the data are not complex or the start is not a tensor.
            ValueError: As from the two functions.
        """
        if warp_k is None:
            return autofocus(signal.data, start=phase_rad, **self.options)
        prf_hz, data = 1 / signal.axis("pulse").step, signal.data
        if omega_rad_s is not None:
            data = range_phase(
                data,
                signal.axis("range").values(data.device),
                self.radar.wavelength_m,
                prf_hz,
                omega_rad_s,
                warp_k,
                0.0 if yc_m is None else yc_m,
            )
        k = warp_k.expand(*signal.trials, warp_k.shape[-1]).reshape(-1, warp_k.shape[-1])
        return rotation_autofocus(data, prf_hz, k, phase_rad, **self.options)


@differentiable("where ok")
def rotation_autofocus(
    data: Tensor,
    prf_hz: float,
    warp_k: Tensor,
    start: Tensor | None = None,
    search: int = 60,
    polish: int = 20,
    assess: bool = True,
) -> Estimate:
    """Estimate the phase error of each pulse of a target whose non-uniform rotation is known.

    >>> import torch
    >>> from torchsar.compensate import rotation_autofocus
    >>> pulses, k = torch.ones(64, 4, dtype=torch.complex64), torch.zeros(1, 2, dtype=torch.float64)
    >>> rotation_autofocus(pulses, 1e3, k)["phase_rad"].shape
    torch.Size([64])

    The phases are those with which the image, formed by the matched Fourier transform for this
    rotation, is sharpest.

    Args:
        data: Range-compressed pulses from which `range_phase` has removed the phase that depends on
            the range of a scatterer, shape (..., pulse, range), complex.
        prf_hz: Pulse repetition frequency in Hz.
        warp_k: Relative derivatives k1, k2, ... of the rotation rate at the first pulse in 1/s,
            1/s^2, ..., shape (trial, order - 1), with all trial dimensions of the data as one.
        start: Phase to start from in rad, shape (..., pulse); by default that of the spatial
            correlation algorithm (function `sca`): the phases
            between adjacent pulses, added up.
        search: Largest number of fixed-point iterations that minimise the image entropy.
        polish: Largest number of further iterations, which compare each pulse with a Wiener
            estimate of the scene.
        assess: False leaves out the assessment.

    Returns:
        `phase_rad` of shape (..., pulse), to be removed, with its standard deviation, quality and
        info as from `autofocus`. Outcomes: EMPTY, SINGULAR, NOISE if the image is less than 1.5
        times as sharp as autofocus makes noise, and INEXACT if the Strehl ratio predicted from the
        standard deviation is below 0.8.

    Raises:
        TypeError: If the data are not complex or the start is not a tensor.
        ValueError: If the data are empty or not finite, the start does not have one phase per
            pulse, or a number of iterations is not a whole number of 0 or more.
    """
    pulses = prepare(data, "rotation_autofocus", empty=False)
    refuse_odd_counts("rotation_autofocus", 0, search=search, polish=polish)
    through = Through(
        MatchedFourierOperator(
            warp_k, pulses.n, prf_hz, dtype=data.dtype, lines=DopplerLines(1.0), transform=Gridding(eps=SEARCH_EPS)
        )
    )
    # the floor is the last one of `entropy_fixed_point`, and the relaxation that of `autofocus`
    runs = [Run(LogAbove(2.0), through, search, 1.8, 0.01), Run(Wiener(), through, polish, 1.0, 1e-3)]

    def find(rows: Tensor, present: Tensor, begin: Tensor | None) -> tuple[Tensor, Tensor]:
        return in_turn(rows, pair_phase(rows, present) if begin is None else begin, runs)

    def continued(rows: Tensor, which: Tensor | slice, at: Tensor) -> Tensor:
        return fixed_point(rows, at, replace(runs[1], iterations=6))[0]

    begin = starting_phase(start, pulses, "rotation_autofocus")
    return conclude(pulses, *find_phases(pulses, find, begin, whole=True), assess, continued, through)
