"""Correction of the motion of antennas within frequency-modulated sweeps."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import normalize

from torchsar.core import Signal, Stage, unit_phasor
from torchsar.radar import AntennaPath, InverseRadar, frequency_samples, range_profiles


def correct_sweep_motion(
    profiles: Tensor,
    radar: InverseRadar,
    antennas: AntennaPath,
    centre_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
    squint_deg: float | None = None,
) -> Tensor:
    """Correct the motion of antennas within frequency-modulated sweeps on any path.

    >>> from torchsar import Draws, compensate, echo, radar, scene
    >>> fmcw = radar.InverseRadar(1e10, 1e8, 500.0, pulse_s=2e-3)
    >>> flight = scene.Flight(scene.StraightPath((-1000.0, -500.0, 0.0), (0.0, 40.0, 0.0)))
    >>> world = scene.PathWorld(scene.Points([0.0], [0.0]), flight, fidelity=scene.MotionInSweep())
    >>> recording, _ = echo.simulate_path(fmcw, world, 64, 32, Draws(1))
    >>> path, moved = radar.AntennaPath.recorded(recording.aux), recording.signal.data
    >>> at_rest = compensate.correct_sweep_motion(moved, fmcw, path)
    >>> [int(x[32].abs().argmax()) for x in (moved, at_rest)]  # the point lies in cell 16
    [14, 16]

    The frequency of a sample tells when it was sent, by the chirp rate, and so at which slow time
    it samples the echo at this frequency. The phase of a point that moves with the beam is removed,
    samples of each frequency are resampled to the middles of the sweeps in Doppler frequency, and
    the phase is put back. The result is that of antennas at rest during a sweep, for all points
    whose Doppler frequency is within half the PRF of that of the removed point. At both ends of the
    record echoes are continued by reflection; where their Doppler frequencies differ much from
    that of the point, some pulses at the ends are less exact. The correction does not change the
    power of noise. Differentiable.

    Range rates and their changes are differences between pulses, so that vibrations must be slow
    against the PRF. Of a vibration of 1 mm along the line of sight at 10 GHz, with a PRF of 500 Hz
    and sweeps of 2 ms, errors of about -79 dB are left at 20 Hz, -37 dB at 100 Hz, -29 dB at
    200 Hz and -8 dB at 400 Hz.

    Args:
        profiles: Range profiles, the unitary centred inverse FFT of frequencies that are sent in
            rising order, shape (..., pulse, range), complex.
        radar: Radar with the length `pulse_s` of a sweep; positions are those of its middle.
        antennas: Path of the antennas, at even times.
        centre_m: Middle of the scene in metres (x, y, z).
        squint_deg: For strips, the angle of the middle of the beam ahead of broadside in degrees:
            the point moves with the beam of the receiver, on the level line through `centre_m`.
            None if the antennas look at `centre_m` all the time.

    Returns:
        Range profiles of antennas at rest during a sweep, shape (..., pulse, range).

    Raises:
        ValueError: If the radar has no `pulse_s`, or there are fewer than two pulses.

    Reference:
        Meta, Hoogeboom and Ligthart 2007 (Doppler correction of FMCW data).
    """
    history = frequency_samples(profiles)
    pulses, n = history.shape[-2:]
    if pulses < 2:
        raise ValueError(f"the motion within sweeps is corrected between at least two pulses, got {pulses}")
    number = torch.arange(n, dtype=torch.float64, device=history.device) - n // 2
    frequency = radar.carrier_hz + radar.bandwidth_hz / n * number
    sent_s = (frequency - radar.carrier_hz) / radar.chirp_rate_hz_s
    point = antennas.reference_m.new_tensor(centre_m)
    if squint_deg is not None:
        place = antennas.places[-1]
        # the straight track of each trial, by least squares, and its level part
        order = torch.linspace(-1, 1, pulses, dtype=place.dtype, device=place.device)[:, None]
        along = normalize((order * place.detach()).sum(-2, keepdim=True), dim=-1)
        level = normalize(along * along.new_tensor([1.0, 1.0, 0.0]), dim=-1)
        abeam = point + ((place - point) * level).sum(-1, keepdim=True) * level
        ahead = torch.linalg.vector_norm(place - abeam, dim=-1, keepdim=True) * math.tan(math.radians(squint_deg))
        point = abeam + ahead * along
    rate = torch.zeros_like(antennas.reference_m)
    for place in (antennas.places * 2)[:2]:
        away = place - point
        speed = torch.gradient(place, spacing=1 / radar.prf_hz, dim=-2)[0]
        rate = rate + (away * speed).sum(-1) / torch.linalg.vector_norm(away, dim=-1)
    change = torch.gradient(rate, spacing=1 / radar.prf_hz, dim=-1)[0][..., None]
    step = (rate[..., 1:] + rate[..., :-1]) / (2 * radar.prf_hz)
    over = torch.cat([torch.zeros_like(rate[..., :1]), step.cumsum(-1)], -1)[..., None]
    per_m, reference = frequency / radar.wave_speed_m_s, antennas.reference_m[..., None]
    moved = over + sent_s * (rate[..., None] + sent_s * change / 2)
    slow = history * unit_phasor(per_m * (moved - reference), history.dtype)
    spectrum = torch.fft.fft(torch.cat([slow, slow.flip(-2)], -2), dim=-2)
    doppler_hz = torch.fft.fftfreq(2 * pulses, 1 / radar.prf_hz, dtype=torch.float64, device=history.device)
    spectrum = spectrum * unit_phasor(-doppler_hz[:, None] * sent_s, history.dtype)
    slow = torch.fft.ifft(spectrum, dim=-2)[..., :pulses, :]
    return range_profiles(slow * unit_phasor(per_m * (reference - over), history.dtype))


class CorrectSweepMotion(Stage):
    """Stage that corrects the motion within sweeps, see `correct_sweep_motion`; arguments as there.

    >>> from torchsar import compensate, radar
    >>> compensate.CorrectSweepMotion(radar.InverseRadar(1e10, 1e8, 500.0, pulse_s=2e-3)).squint_deg

    It comes first; the stages after it take antennas to be at rest during a pulse. A chain connects
    the side data of the recording:

        use(CorrectSweepMotion(radar), transmitter_m="aux.transmitter_m",
            receiver_m="aux.receiver_m", path_reference_m="aux.path_reference_m")

    Args:
        radar: Radar of the recording, with the length `pulse_s` of a sweep.
        centre_m: Middle of the scene in metres (x, y, z).
        squint_deg: For strips, the angle of the middle of the beam ahead of broadside in degrees.

    Raises:
        ValueError: If the radar has no `pulse_s`.
    """

    works_on = ("pulse", "range")

    def __init__(
        self,
        radar: InverseRadar,
        centre_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
        squint_deg: float | None = None,
    ) -> None:
        super().__init__()
        self.radar, self.centre_m, self.squint_deg = radar, centre_m, squint_deg
        assert radar.chirp_rate_hz_s  # raises ValueError without the length of a sweep

    def forward(
        self, signal: Signal, transmitter_m: Tensor, path_reference_m: Tensor, receiver_m: Tensor | None = None
    ) -> Signal:
        """Correct range profiles with the axes (pulse, range).

        Args:
            signal: Range profiles.
            transmitter_m: Positions of the transmitter in metres, float64 (..., pulse, 3).
            path_reference_m: Path to which phases refer in metres, float64 (..., pulse).
            receiver_m: Positions of the receiver in metres; None if both share an antenna.

        Returns:
            Range profiles with the same axes.
        """
        antennas = AntennaPath(transmitter_m, receiver_m, path_reference_m)
        return signal.with_data(correct_sweep_motion(signal.data, self.radar, antennas, self.centre_m, self.squint_deg))
