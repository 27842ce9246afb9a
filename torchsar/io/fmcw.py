"""Recordings of frequency-modulated continuous-wave radars (FMCW), such as 77 GHz boards."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch

from torchsar.core import Recording, refuse_non_finite, unit_phasor
from torchsar.io.fields import joined, parted, refuse_carrier, refuse_implausible
from torchsar.io.history import history_radar
from torchsar.radar import AntennaPath, range_profiles
from torchsar.repair.trigger import delayed


def fmcw_recording(
    beat: Any,
    start_hz: float,
    slope_hz_s: float,
    sampling_hz: float,
    position_m: Any,
    receiver_offset_m: Any = None,
    delay_s: float = 0.0,
    prf_hz: float = 1.0,
    order: str = "iq",
    beat_sign: int = 1,
) -> Recording:
    """Make a recording of dechirped sweeps, as boards write them, of one receiver or several.

    >>> import numpy
    >>> from torchsar import focus, io
    >>> place = numpy.stack([numpy.zeros(64), numpy.linspace(-0.1, 0.1, 64), numpy.zeros(64)], -1)
    >>> t = numpy.arange(128) / 5e6
    >>> late = 2 * numpy.hypot(6.0, place[:, 1:2]) / 299792458.0  # of a target at x = 6 m
    >>> beat = numpy.exp(2j * numpy.pi * (77e9 * late + 30e12 * (t * late - late**2 / 2)))
    >>> recording = io.fmcw_recording(beat, 77e9, 30e12, 5e6, place)
    >>> image = focus.SpotlightImage(recording.aux, 1.0, 1.0, 0.02, (6.0, 0.0))(recording.signal)
    >>> line, cell = divmod(int(image.data.abs().argmax()), image.axes[1].n)
    >>> [round(float(axis.values()[i]), 2) for axis, i in zip(image.axes, (line, cell))]
    [0.0, 6.0]

    The frequency of a sample at the time t after the start of its sweep is start_hz + slope_hz_s t.
    The echo of the delay T turns by 2 pi (f T - slope T^2 / 2); the second term, the residual video
    phase, is removed for delays from zero to the inverse of the frequency step. Each receiver of
    each sweep becomes a pulse of its own, with its place, so that all of them enter an image.

    Args:
        beat: Samples, complex (sweep, sample) or (sweep, receiver, sample); or integers with a last
            dim of I and Q; or, with the order "real", the real samples of a mixer without Q.
        start_hz: Frequency at the start of a sweep in Hz.
        slope_hz_s: Slope of the sweep in Hz/s, negative if the frequency falls.
        sampling_hz: Sampling rate in Hz.
        position_m: Positions of the transmitter at the sweeps in metres, (sweep, 3).
        receiver_offset_m: Positions of the receivers relative to the transmitter in metres,
            (receiver, 3) or (3,); None if both share an antenna.
        delay_s: Time from the start of a sweep to its first sample in seconds.
        prf_hz: Rate of the sweeps in Hz.
        order: Order of I and Q, if they are a dim, such as "iiqq"; "real" for samples without Q, of
            which the analytic signal is taken: delays end at half of the inverse of the frequency
            step, and targets within a few range cells of range zero are disturbed.
        beat_sign: 1 if the phase of an echo grows with its delay, as of a mixer that gives
            transmitted times conjugate received signal; else -1.

    Returns:
        Recording as by `read_path`, with range profiles (pulse, range) in complex64, in which a
        reference path of zero lies in the middle. The radar of one receiver with rising frequency
        has the length of a sweep, with which `compensate.correct_sweep_motion` corrects its motion
        within sweeps; all others take antennas to be at rest during a sweep.

    Raises:
        ValueError: If shapes do not fit, a number is not plausible, or a sample is not finite.
    """
    x = np.asarray(beat)
    if order == "real" and x.dtype.kind != "c":
        # the frequencies of a cosine have both signs, of which those of delays above zero are kept
        x, beat_sign = delayed(torch.from_numpy(x.astype(float)), torch.zeros(()), analytic=True).numpy(), 1
        x = x.conj() if slope_hz_s < 0 else x
    elif x.dtype.kind != "c":
        if x.shape[-1:] != (2,):
            raise ValueError(
                f"beat must be complex, real with a last dim of I and Q, or real with order='real', got {x.dtype} of "
                f"shape {x.shape}"
            )
        x = joined(*parted(x, order))
    place = torch.as_tensor(np.asarray(position_m, float))
    offset = torch.zeros(1, 3) if receiver_offset_m is None else torch.as_tensor(np.asarray(receiver_offset_m, float))
    offset = offset.double().reshape(-1, 3)
    x = x[:, None] if x.ndim == 2 else x
    if x.ndim != 3 or min(x.shape) < 1 or place.shape != (len(x), 3) or len(offset) != x.shape[1]:
        raise ValueError(
            f"fmcw_recording needs beat (sweep, receiver, sample) with position_m (sweep, 3) and receiver_offset_m "
            f"(receiver, 3), got {x.shape}, {tuple(place.shape)} and {tuple(offset.shape)}"
        )
    if beat_sign not in (1, -1) or not sampling_hz > 0 or slope_hz_s == 0:
        raise ValueError(
            f"beat_sign must be 1 or -1, sampling_hz positive and slope_hz_s not zero, got {beat_sign}, {sampling_hz} "
            f"and {slope_hz_s}"
        )
    data = torch.from_numpy(np.ascontiguousarray(x)).to(torch.complex128)
    refuse_non_finite(data, "beat")
    frequency = start_hz + slope_hz_s * (delay_s + torch.arange(data.shape[-1], dtype=torch.float64) / sampling_hz)
    if slope_hz_s < 0:
        frequency, data = frequency.flip(0), data.flip(-1)
    refuse_carrier(frequency, "start_hz")
    refuse_implausible(frequency, place, torch.zeros(1), ("position_m", "the reference"))
    n, step = len(frequency), abs(slope_hz_s) / sampling_hz
    profiles = range_profiles((data.conj() if beat_sign > 0 else data).resolve_conj()).flatten(0, 1)
    late = torch.remainder(torch.arange(n, dtype=torch.float64) - n // 2, n) / (n * step)
    profiles = profiles * unit_phasor(-slope_hz_s * late.square() / 2, profiles.dtype)
    sent = place[:, None].expand(-1, len(offset), 3).flatten(0, 1)
    received = None if receiver_offset_m is None else (place[:, None] + offset).flatten(0, 1)
    antennas = AntennaPath(sent.contiguous(), received, torch.zeros(len(sent), dtype=torch.float64))
    radar = history_radar(frequency, prf_hz * len(offset), 0.0)
    if slope_hz_s > 0 and len(offset) == 1:
        radar = replace(radar, pulse_s=n / sampling_hz)
    aux: dict[str, Any] = {"frequency_hz": frequency, **antennas.side_data()}
    return Recording.from_arrays(profiles, radar, what="beat", **aux)
