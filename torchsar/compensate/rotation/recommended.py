"""The recommended estimator of non-uniform rotation, and estimators of its first steps alone."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace

import torch
from torch import Tensor

from torchsar.compensate.rotation.coarse import coarse_warp
from torchsar.compensate.rotation.histories import refined_by_histories
from torchsar.compensate.rotation.motion import LEAST_PULSES, Motion, Sampling, image_of
from torchsar.compensate.rotation.scatterers import MOST, ROUNDS, Fit, fit_scatterers, usual_count
from torchsar.compensate.rotation.unknowns import k_name
from torchsar.compensate.rotation.verdicts import (
    LEAST_EXPLAINED,
    MOST_PHASE_ERROR_RAD,
    covariance_of,
    focus_of,
    warp_phase_error,
)
from torchsar.core import (
    Estimate,
    Outcome,
    block_bytes_of,
    checked_samples,
    host_values,
    level_of,
    over_blocks,
    refuse_non_finite,
    settle,
)
from torchsar.core.warp import k_of_shape, shape_of
from torchsar.metrics import entropy

# relative error of the rate up to which it scales images, a convention, and the standard deviations
# that it must exceed: a rate that is found too large also looks too accurate
_RATE_TOLERANCE, _SURE = 0.1, 2.7
_ENTROPY_ROUNDING = 1e-3  # tolerance in nats of a comparison of entropies in float32
# size of a block of trials over the size that is best for one operation, found by trial
_BLOCKS = 8
_HISTORY_STEPS = 4  # steps of phase least squares, found by trial: enough to converge

Part = Callable[[Tensor, Sampling, Tensor | None], Estimate]


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
) -> Estimate:
    """Estimate the rotation of a target with non-uniform rotation; the recommended estimator.

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

        info["focused"] is True where the rotation is good enough to form an image: at least 3
        scatterers are found, they explain half of the energy or more, their phase histories agree
        over the whole aperture, the entropy is not higher than without compensation, and the fit
        has converged. `ok` is True where, in addition, an error of the rate above 10 % is
        improbable: 10 % of it are 2.7 standard deviations or more, also without the scatterers that
        may be peaks of the noise. Where only `ok` is False, the cross-range scale of the image is
        unknown. Targets of several hundred scatterers on few pulses, of which the usual numbers
        explain a part, are often not ok; a larger `scatterers` helps. Further info:
        scatterers (their number), noise_power, steps, entropy_nats, uncompensated_entropy_nats.

    Raises:
        TypeError: If the data are not complex.
        ValueError: If the data, the range axis or `yc_m` are invalid, or a number is not a whole
            number of 1 or more.
    """
    _check_counts("uneven_rotation", 1, order=order, rounds=rounds, scatterers=1 if scatterers is None else scatterers)

    def find(rows: Tensor, sampling: Sampling, known: Tensor | None) -> Estimate:
        motion, _ = refined_by_histories(
            rows, sampling, _start(rows, sampling, order, known), free_centre=known is None
        )
        fit = fit_scatterers(rows, sampling, motion, free_centre=known is None, count=scatterers, rounds=rounds)
        found = _estimate(rows, sampling, fit, known is None)
        if scatterers is None:
            return _with_more_scatterers(rows, sampling, fit.motion, found, known is None, rounds)
        return found

    return _over_trials("uneven_rotation", find, data, wavelength_m, prf_hz, range_m, yc_m)


def coarse_rotation(
    data: Tensor,
    *,
    wavelength_m: float,
    prf_hz: float,
    range_m: Tensor,
    order: int = 3,
    yc_m: Tensor | float | None = None,
) -> Estimate:
    """Estimate k1 and k2 from the spectra of short sections, the first step of `uneven_rotation`.

    The ratio of the rotation rate at time t after the first pulse to that at the first pulse is
    modelled as 1 + k1 t + k2 t^2 / 2 and is found to a few thousandths. The rotation rate itself is
    not estimated; `omega_rad_s` is 0.

    Args:
        data: Range-compressed pulses, shape (..., pulse, range), complex, at least 8 pulses.
        wavelength_m: Wavelength in metres.
        prf_hz: Pulse repetition frequency in Hz.
        range_m: Range coordinates y_n of the cells in metres, evenly spaced, shape (range,).
        order: Degree of the polynomial of time that describes the rotation angle. 1 is uniform
            rotation; with 2 only k1 is returned, and beyond 3 the further derivatives are 0.
        yc_m: Range centre deviation yc in metres (a cell at range y lies at y + yc from the
            rotation centre), if known a priori, a number or shape (...,).

    Returns:
        `omega_rad_s`, `warp_k` with its entries, and `yc_m`, as from `uneven_rotation` but without
        standard deviations. quality is the relative decrease of exp(entropy) of the image due to
        the compensation. `ok` is True where the entropy is not higher than without compensation and
        at least 3 bright scatterers confirm k1, k2, ...: the phase error info["phase_error_rad"]
        that their phase histories, or else a joint fit of all scatterers, show for the scatterer
        farthest from zero Doppler, plus two of its standard deviations, is below 0.47 rad rms, a
        Strehl ratio of 0.8. `ok` does not refer to `omega_rad_s` and `yc_m`.

    Raises:
        TypeError: If the data are not complex.
        ValueError: If the data, the range axis or `yc_m` are invalid, or the order is not a whole
            number of 1 or more.
    """
    _check_counts("coarse_rotation", 1, order=order)

    def find(rows: Tensor, sampling: Sampling, known: Tensor | None) -> Estimate:
        return _confirmed(rows, sampling, _start(rows, sampling, order, known))

    return _over_trials("coarse_rotation", find, data, wavelength_m, prf_hz, range_m, yc_m)


def phase_fit_rotation(
    data: Tensor,
    *,
    wavelength_m: float,
    prf_hz: float,
    range_m: Tensor,
    order: int = 3,
    yc_m: Tensor | float | None = None,
    steps: int = _HISTORY_STEPS,
    half_cells: int = 24,
) -> Estimate:
    """Estimate the rotation by the first two steps of `uneven_rotation`.

    These steps are the correlation of the spectra of short sections, and least squares on the phase
    histories of bright scatterers. They take half the time of `uneven_rotation`; the errors are two
    to twenty times as large.

    Args:
        data: Range-compressed pulses, shape (..., pulse, range), complex, at least 8 pulses.
        wavelength_m: Wavelength in metres.
        prf_hz: Pulse repetition frequency in Hz.
        range_m: Range coordinates y_n of the cells in metres, evenly spaced, shape (range,).
        order: Degree of the polynomial of time that describes the rotation angle; 1 is uniform
            rotation.
        yc_m: Range centre deviation yc in metres (a cell at range y lies at y + yc from the
            rotation centre), if known a priori, a number or shape (...,); None estimates it.
        steps: Number of times that the least-squares fit to the phase histories is repeated.
        half_cells: Half width of the windows about scatterers in Doppler cells, at least 4.

    Returns:
        `omega_rad_s`, `warp_k` with its entries, and `yc_m`, as from `uneven_rotation` but without
        standard deviations. quality is the relative decrease of exp(entropy) of the image due to
        the compensation. `ok` is True where the entropy is not higher than without compensation and
        at least 3 bright scatterers confirm k1, k2, ...: the phase error info["phase_error_rad"]
        that their phase histories, or else a joint fit of all scatterers, show for the scatterer
        farthest from zero Doppler, plus two of its standard deviations, is below 0.47 rad rms, a
        Strehl ratio of 0.8. `ok` does not refer to `omega_rad_s` and `yc_m`.

    Raises:
        TypeError: If the data are not complex.
        ValueError: If the data, the range axis or `yc_m` are invalid, or a number is too small.
    """
    _check_counts("phase_fit_rotation", 1, order=order, steps=steps)
    _check_counts("phase_fit_rotation", 4, half_cells=half_cells)

    def find(rows: Tensor, sampling: Sampling, known: Tensor | None) -> Estimate:
        motion = _start(rows, sampling, order, known)
        for _ in range(steps):
            motion, _ = refined_by_histories(rows, sampling, motion, free_centre=known is None, half_cells=half_cells)
        return _confirmed(rows, sampling, motion)

    return _over_trials("phase_fit_rotation", find, data, wavelength_m, prf_hz, range_m, yc_m)


def _start(rows: Tensor, sampling: Sampling, order: int, known: Tensor | None) -> Motion:
    """The coarse warp in `order` terms, with rate zero."""
    k = (
        coarse_warp(rows, sampling.prf_hz)
        if order > 1
        else torch.zeros(rows.shape[0], 0, dtype=torch.float64, device=rows.device)
    )
    if order == 2:
        k = k_of_shape(shape_of(k, sampling.duration_s)[:, :1], sampling.duration_s)
    return Motion.of_unknown_rate(torch.nn.functional.pad(k, (0, max(0, order - 3))), known)


def _over_trials(
    name: str,
    find: Part,
    data: Tensor,
    wavelength_m: float,
    prf_hz: float,
    range_m: Tensor,
    yc_m: Tensor | float | None,
) -> Estimate:
    """find(rows, sampling, known centre) in blocks of trials, each divided by its level."""
    data = checked_samples(data, name, "pulse, range")
    sampling = _checked(name, data, wavelength_m, prf_hz, range_m)
    trials, rows = data.shape[:-2], data.detach().reshape(-1, *data.shape[-2:])
    known = (
        None if yc_m is None else _centre(name, torch.as_tensor(yc_m, dtype=torch.float64, device=data.device), trials)
    )
    height = max(1, _BLOCKS * block_bytes_of(data.device) // (rows[0].numel() * rows.element_size()))
    parts: dict[int, Estimate] = {}

    @torch.no_grad()
    def work(first: int) -> None:
        part = slice(first, first + height)
        peak = level_of(rows[part])
        found = find(rows[part] / peak, sampling, None if known is None else known[part])
        scaled = (
            {"noise_power": found.info["noise_power"] * peak[:, 0, 0].double().square()}
            if "noise_power" in found.info
            else {}
        )
        seen = (rows[part] != 0).flatten(1).any(-1)
        parts[first] = replace(
            found, outcome=torch.maximum(found.outcome, Outcome.of(seen, Outcome.NOISE)), info={**found.info, **scaled}
        )

    starts = range(0, rows.shape[0], height)
    over_blocks(work, starts, rows)
    return Estimate.joined([parts[first] for first in starts], trials)


def _check_counts(name: str, least: int, **counts: int) -> None:
    """Raise ValueError unless numbers are integers of at least `least`."""
    for what, count in counts.items():
        if isinstance(count, bool) or not isinstance(count, int) or count < least:
            raise ValueError(f"{name}: {what} must be a whole number of {least} or more, got {count!r}")


def _centre(name: str, yc_m: Tensor, trials: torch.Size) -> Tensor:
    """The range centre deviation known a priori for every trial, (trial,)."""
    refuse_non_finite(yc_m, f"{name}: yc_m")
    if yc_m.ndim and yc_m.shape != trials:
        raise ValueError(
            f"{name}: yc_m must be one number (m) or one per trial {tuple(trials)}, got shape {tuple(yc_m.shape)}"
        )
    return yc_m.expand(trials).reshape(-1)


def _checked(name: str, data: Tensor, wavelength_m: float, prf_hz: float, range_m: Tensor) -> Sampling:
    """Sampling of the data; raises TypeError or ValueError for invalid input."""
    if data.shape[-2] < LEAST_PULSES:
        raise ValueError(
            f"{name} works on samples (..., pulse, range) of at least {LEAST_PULSES} pulses and "
            f"one range cell, got the shape {tuple(data.shape)}"
        )
    for what, value in (("wavelength_m", wavelength_m), ("prf_hz", prf_hz)):
        if not (math.isfinite(value) and value > 0):
            raise ValueError(f"{name}: {what} must be a positive number, got {value}")
    if not isinstance(range_m, Tensor) or range_m.shape != data.shape[-1:]:
        got = f"the shape {tuple(range_m.shape)}" if isinstance(range_m, Tensor) else type(range_m).__name__
        raise ValueError(
            f"{name}: range_m must be a tensor of the {data.shape[-1]} coordinates of the range cells (m), got {got}"
        )
    refuse_non_finite(range_m, f"{name}: range_m")
    range_m = range_m.to(torch.float64)
    steps = torch.diff(range_m) if len(range_m) > 1 else torch.ones_like(range_m)
    first, step, least, largest = host_values(torch.stack([range_m[0], steps.mean(), *torch.aminmax(steps)]), 0.0)
    if step == 0 or max(step - least, largest - step) > 1e-6 * abs(step):
        raise ValueError(
            f"{name}: range_m must be evenly spaced, got steps of {least:g} to {largest:g} m; resample the data in "
            "range first"
        )
    return Sampling(wavelength_m, prf_hz, data.shape[-2], data.shape[-1], first, step)


def _estimate(rows: Tensor, sampling: Sampling, fit: Fit, free_centre: bool) -> Estimate:
    """Estimate from a fit, with standard deviations and reliability."""
    found, focus = _assessed(rows, sampling, fit.motion), focus_of(rows, sampling, fit)
    focused, std = found.ok & focus.right, _standard_deviations(fit, focus.accounted, free_centre)
    count = (fit.scatterers.amplitude != 0).sum(-1)
    certain = fit.certain[:, fit.motion.k.shape[-1]].clamp_min(torch.finfo(torch.float64).tiny).sqrt()
    scaled = (_SURE * std["omega_rad_s"] < _RATE_TOLERANCE * fit.motion.omega_rad_s * certain) & (fit.motion.w > 0)
    info = {**found.info, "focused": focused, "scatterers": count, "noise_power": fit.noise, "steps": fit.steps}
    return Estimate(found.value, std, focus.explained, Outcome.of(focused & scaled, Outcome.NOISE), info=info)


def _with_more_scatterers(
    rows: Tensor, sampling: Sampling, motion: Motion, found: Estimate, free_centre: bool, rounds: int
) -> Estimate:
    """The estimate with twice as many scatterers in trials whose energy has many more than the
    usual number.
    """
    count = usual_count(sampling)
    at = ((found.quality < LEAST_EXPLAINED) & (2 * found.info["scatterers"] > count)).nonzero()[:, 0]
    if not len(at):
        return found
    fit = fit_scatterers(
        rows[at], sampling, motion.part(at), free_centre=free_centre, count=min(MOST, 2 * count), rounds=rounds
    )
    again = _estimate(rows[at], sampling, fit, free_centre)

    def mixed(all_of: Mapping[str, Tensor], some_of: Mapping[str, Tensor]) -> dict[str, Tensor]:
        return {name: whole.index_copy(0, at, some_of[name]) for name, whole in all_of.items()}

    return Estimate(
        mixed(found.value, again.value),
        mixed(found.std, again.std),
        found.quality.index_copy(0, at, again.quality),
        Outcome.of(found.ok.index_copy(0, at, again.ok), Outcome.NOISE),
        info=mixed(found.info, again.info),
    )


def _standard_deviations(fit: Fit, accounted: Tensor, free_centre: bool) -> dict[str, Tensor]:
    """Standard deviations of the values, from the covariance of (k, w, v).

    They are infinite where the data do not determine a value.
    """
    motion, order, covariance = fit.motion, fit.motion.k.shape[-1], covariance_of(fit, accounted)
    k = covariance.diagonal(dim1=-2, dim2=-1)[:, :order].clamp_min(0).sqrt()
    w = torch.where(motion.w > 0, motion.w, 0)
    ww = covariance[:, order, order]
    omega = ww.clamp_min(0).sqrt() / (2 * w.sqrt())
    yc = torch.zeros_like(w)
    if free_centre:
        found = motion.yc_m - motion.centre_m
        yc = (covariance[:, -1, -1] - 2 * found * covariance[:, order, -1] + found.square() * ww).clamp_min(
            0
        ).sqrt() / w
    named = {
        "warp_k": k,
        **{k_name(i + 1): column for i, column in enumerate(k.unbind(-1))},
        "omega_rad_s": omega,
        "yc_m": yc,
    }
    return {name: torch.where(torch.isnan(value), math.inf, value) for name, value in named.items()}


def _confirmed(rows: Tensor, sampling: Sampling, motion: Motion) -> Estimate:
    """A motion as an estimate; ok where its scatterers confirm its warp."""
    found = _assessed(rows, sampling, motion)
    error, count = warp_phase_error(rows, sampling, motion)
    ok = found.ok & (error < MOST_PHASE_ERROR_RAD)
    return replace(
        found, outcome=Outcome.of(ok, Outcome.NOISE), info={**found.info, "phase_error_rad": error, "scatterers": count}
    )


def _assessed(rows: Tensor, sampling: Sampling, motion: Motion) -> Estimate:
    """A motion as an estimate; ok where its entropy is not above that without compensation."""
    motion = replace(motion, k=settle(motion.k, 0.0)[0], w=settle(motion.w, 0.0)[0], v=settle(motion.v, 0.0)[0])
    before = entropy(torch.fft.fft(rows, 2 * sampling.pulses, dim=-2))
    after = entropy(image_of(rows, sampling, motion))
    value = {
        "warp_k": motion.k,
        **{k_name(i + 1): k for i, k in enumerate(motion.k.unbind(-1))},
        "omega_rad_s": motion.omega_rad_s,
        "yc_m": motion.yc_m,
    }
    gained = (before - after).double()
    quality = (1 - torch.exp(-gained)).clamp(0, 1)
    return Estimate(
        value,
        quality=quality,
        outcome=Outcome.of(gained > -_ENTROPY_ROUNDING, Outcome.NOISE),
        info={"entropy_nats": after, "uncompensated_entropy_nats": before},
    )
