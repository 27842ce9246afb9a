"""Simulation of phase histories along any path."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from torchsar.core import Draws, Recording, Truth, gathered_checks, per_trial, real_dtype, unit_phasor
from torchsar.echo.recorded import Impairment, noise, recorded, with_samples
from torchsar.echo.sums import blocks, echo_spectrum, row_bytes
from torchsar.radar import AntennaPath, InverseRadar, StraightTrack, frequency_samples, range_profiles
from torchsar.scene import Flight, PathWorld, Sway
from torchsar.scene.trials import refuse_other_trials

# amplitude gain above which a target counts as lit: half power on each of two ways
_LIT = 0.5


def path_echo(
    antennas: AntennaPath,
    points_m: Tensor,
    weight: Tensor,
    radar: InverseRadar,
    n_frequency: int,
    dtype: torch.dtype = torch.complex64,
) -> Tensor:
    """Compute the phase history of points along any path.

    >>> import torch
    >>> from torchsar import echo, radar
    >>> sar = radar.InverseRadar(1e10, 1e8, 100.0)
    >>> place_m, points_m = torch.tensor([[-800.0, 0, 600]]).double(), torch.zeros(2, 3).double()
    >>> antennas = radar.AntennaPath(place_m, None, 2 * place_m.norm(dim=-1))  # one pulse
    >>> echo.path_echo(antennas, points_m, torch.ones(1, 2), sar, 4).abs().round(decimals=2)
    tensor([[2., 2., 2., 2.]])

    The sample of pulse p at the frequency f is the sum over the points of weight exp(-2j pi f (l -
    reference) / c) with the path l = |transmitter - x| + |x - receiver|. Antennas are at rest
    during a pulse. Few points are summed by a matrix product over blocks of frequencies, more than
    64 by a non-uniform FFT (`LineSum`).
    Differentiable in positions and weights.

    Args:
        antennas: Positions of the antennas at every pulse.
        points_m: Positions of the points in metres, shape (..., point, 3), float64.
        weight: Amplitude of the points, times the gain of the beam, complex or real,
            broadcastable to (..., pulse, point).
        radar: Band of the radar; its `carrier_hz` is that of sample n // 2.
        n_frequency: Number n of frequencies, which share the bandwidth of the radar.
        dtype: Complex dtype of the result.

    Returns:
        Phase history, shape (..., pulse, frequency).

    Raises:
        ValueError: If there is no point or frequency.
    """
    if n_frequency < 1 or not points_m.shape[-2]:
        raise ValueError(f"path_echo needs points and frequencies, got {points_m.shape[-2]} and {n_frequency}")
    lead = np.broadcast_shapes(antennas.trials, points_m.shape[:-2])
    size = row_bytes(points_m.shape[-2], n_frequency, dtype) * int(np.prod(lead))
    out = []
    for pulses in blocks(antennas.pulses, size):
        delay = antennas.path_m(points_m[..., None, :, :], pulses) / radar.wave_speed_m_s
        some = weight if weight.shape[-2] == 1 else weight[..., pulses, :]
        step_hz = radar.bandwidth_hz / n_frequency
        out.append(echo_spectrum(delay, radar.carrier_hz * delay, some, n_frequency, step_hz, dtype))
    return torch.cat(out, -2)


def nominal_geometry(radar: InverseRadar, world: PathWorld, n_pulse: int, n_range: int) -> tuple[AntennaPath, Tensor]:
    """Return the paths of antennas that fly as planned, and the frequencies of the radar.

    Args:
        radar: Carrier, bandwidth and pulse repetition frequency.
        world: Paths; their deviations are left out.
        n_pulse: Number of pulses.
        n_range: Number of frequencies.

    Returns:
        Paths, whose reference is zero, and frequencies in Hz, float64 (n_range,).
    """
    time_s = torch.arange(n_pulse, dtype=torch.float64) / radar.prf_hz
    receiver = None if world.receiver is None else world.receiver.nominal.position_m(time_s)
    path = AntennaPath(world.transmitter.nominal.position_m(time_s), receiver, torch.zeros_like(time_s))
    return path, _frequencies_hz(radar, n_range)


def flown_paths(radar: InverseRadar, world: PathWorld, n_pulse: int, draws: Draws) -> tuple[AntennaPath, AntennaPath]:
    """Return the true paths of antennas and those that navigation records, in each trial.

    Args:
        radar: Pulse repetition frequency.
        world: Paths, their deviations and what navigation records of them.
        n_pulse: Number of pulses.
        draws: Random draws of the trials.

    Returns:
        True and recorded paths, as in the simulation of `simulate_path`.
    """
    flown = _Flown.of(world, draws, torch.arange(n_pulse, dtype=torch.float64) / radar.prf_hz)
    return flown.true, flown.recorded


def _frequencies_hz(radar: InverseRadar, n: int, device: torch.device | str | None = None) -> Tensor:
    """Frequencies of the n samples of a phase history, float64 (n,)."""
    number = torch.arange(n, dtype=torch.float64, device=device) - n // 2
    return radar.carrier_hz + radar.bandwidth_hz / n * number


def _moving_echo(
    flown: _Flown, time_s: Tensor, points: Tensor, weight: Tensor, radar: InverseRadar, n: int, dtype: torch.dtype
) -> Tensor:
    """Phase history (..., pulse, n) of sweeps within which the antennas move.

    The sample of the frequency f is taken when it is sent. Relative to the middle of the lit points
    its phase changes little within a sweep, so that it is interpolated between histories of
    antennas at rest at Chebyshev points of the sweep, as many as the precision needs for constant
    range rates within a sweep; vibrations need more, see `MotionInSweep`.
    """
    frequency = _frequencies_hz(radar, n, time_s.device)
    half_s = radar.bandwidth_hz / radar.chirp_rate_hz_s / 2
    power = weight.detach().abs().square()
    centre = power @ points.detach() / power.sum(-1, keepdim=True).clamp_min(torch.finfo(power.dtype).tiny)
    first, last = (flown.over(centre, time_s + at).path_m(points[..., None, :, :]) for at in (-half_s, half_s))
    moved_m = float(((last - first).detach() * (power > 0)).abs().max())
    phase = math.pi * float(frequency[-1]) / radar.wave_speed_m_s * moved_m  # at the ends of a sweep
    wanted = math.log(1e-8 if dtype == torch.complex64 else 1e-14)
    counts = (m for m in range(6, 257) if m * math.log(phase / 2 + 1e-9) - math.lgamma(m + 1) < wanted)
    count = next(counts, None)
    if count is None:
        raise ValueError(
            f"points of the scene move by {moved_m:.3g} m against each other within a sweep, by far more than pulses "
            f"at {radar.prf_hz:g} Hz can sample; check pulse_s, the speed and the extent of the scene"
        )
    order = torch.arange(count, dtype=torch.float64, device=time_s.device)
    angle = math.pi / count * (order + 0.5)
    sent = torch.acos((frequency - radar.carrier_hz) * (2 / radar.bandwidth_hz))
    share = (1 + order.sign()) / count
    matrix = torch.cos(sent[:, None] * order) @ (share[:, None] * torch.cos(order[:, None] * angle))
    total, over_m = torch.zeros((), dtype=dtype, device=time_s.device), torch.zeros_like(sent)
    for column, at in zip(matrix.unbind(-1), (half_s * torch.cos(angle)).tolist(), strict=True):
        antennas = flown.over(centre, time_s + at)
        total = total + column.to(real_dtype(dtype)) * path_echo(antennas, points, weight, radar, n, dtype)
        over_m = over_m + column * antennas.reference_m[..., None]
    turns = frequency / radar.wave_speed_m_s * (over_m - flown.true.reference_m[..., None])
    return total * unit_phasor(-turns, dtype)


@gathered_checks()
def simulate_path(
    radar: InverseRadar,
    world: PathWorld,
    n_pulse: int,
    n_range: int,
    draws: Draws,
    impairments: Mapping[str, Impairment] | None = None,
    dtype: torch.dtype = torch.complex64,
    device: torch.device | str | None = None,
) -> tuple[Recording, Truth]:
    """Simulate range profiles along any path, one recording per trial of `draws`.

    >>> from torchsar import Draws, echo, radar, scene
    >>> sar = radar.InverseRadar(1e10, 1e8, 100.0)
    >>> track = scene.StraightPath([-800.0, 0.0, 600.0], [0.0, 50.0, 0.0])
    >>> world = scene.PathWorld(scene.Points([0.0], [0.0]), scene.Flight(track))
    >>> recording, truth = echo.simulate_path(sar, world, n_pulse=4, n_range=8, draws=Draws(1))
    >>> recording.signal.data.abs().argmax(-1), recording.aux["transmitter_m"].shape
    (tensor([4, 4, 4, 4]), torch.Size([4, 3]))

    Profiles are those of pulses after range compression, or of dechirped sweeps without their video
    phase.

    Args:
        radar: Carrier, bandwidth and pulse repetition frequency.
        world: Scene, true paths, navigation, ground, beam and signal-to-noise ratio.
        n_pulse: Number of pulses.
        n_range: Number of range cells, and of frequencies.
        draws: Random draws.
        impairments: Impairments by name, applied in order.
        dtype: Complex dtype of the recording.
        device: Device of the recording.

    Returns:
        The recording, shape (..., pulse, range), and the truth. Side data of the recording are
        `frequency_hz` and those of `AntennaPath.side_data`, with the positions that navigation
        records. The values of the truth are:

        - `true_transmitter_m`, shape (..., pulse, 3), and `true_receiver_m` unless both share an
          antenna: the true positions;
        - `line_of_sight_m`, shape (..., pulse): half the path over the point (0, 0, 0), recorded
          minus true; with a beam, over the point abeam of the receiver on the level line through
          (0, 0, 0) along its straight track;
        - `azimuth_m`, `range_m`, `height_m` and `amplitude` of the scatterers, shape (..., target);
        - `noise_std`, shape (...,) or (): the standard deviation of the complex noise of a sample;
        - the true values of each impairment, as "<impairment>.<name>".

        The recording `clean` of the truth has the same noise and the true positions, but no
        impairments.

    Raises:
        ValueError: If the scene is empty, a scatterer leaves the range window while it is lit,
            there are fewer than two pulses, or a parameter given per trial has another length than
            the number of trials.
    """
    refuse_other_trials(world, draws)
    if n_pulse < 2 or n_range < 2:
        raise ValueError(f"a recording needs at least two pulses of two samples, got {n_pulse} and {n_range}")
    time_s = torch.arange(n_pulse, dtype=torch.float64, device=device) / radar.prf_hz
    flown = _Flown.of(world, draws, time_s)
    scatterers = world.scene.scatterers(draws).to(device, heights=True)
    y, x, amplitude = scatterers.tensors
    above = 0.0 if scatterers.height_m is None else scatterers.height_m
    points = torch.stack(torch.broadcast_tensors(x, y, world.ground.height_m(x, y) + above), -1)
    gain = _gain(world, flown.true, points, time_s)
    gain = gain * _within(flown.true, points, gain, radar, n_range)
    weight = amplitude[..., None, :] * gain
    if world.fidelity is None:
        history = path_echo(flown.true, points, weight, radar, n_range, dtype)
    else:
        history = _moving_echo(flown, time_s, points, weight, radar, n_range, dtype)
    std = torch.zeros((), dtype=torch.float64, device=device)
    if world.snr_db is not None:
        power = _lit_power(history, gain)
        std = torch.sqrt(power / 10 ** (per_trial(world.snr_db, 0, history) / 10))
        history = history + noise(draws, "noise", (n_pulse, n_range), std, dtype, device)
    data = range_profiles(history)
    frequency = _frequencies_hz(radar, n_range, device)
    aux, clean_aux = ({"frequency_hz": frequency, **path.side_data()} for path in (flown.recorded, flown.true))
    values = {
        **flown.truth(),
        "azimuth_m": y,
        "range_m": x,
        "height_m": points[..., 2],
        "amplitude": amplitude,
        "noise_std": std,
    }
    axes = radar.raw_axes(n_pulse, n_range)
    return recorded(data, data, axes, radar, values, impairments, draws, aux, clean_aux)


@dataclass(frozen=True)
class _Flown:
    """Antenna paths of a flight, true and as navigation records them.

    The phases of both refer to the same path length, `reference_m`.
    """

    true: AntennaPath
    recorded: AntennaPath
    strip: bool
    flights: tuple[Flight, ...]

    @staticmethod
    def of(world: PathWorld, draws: Draws, time_s: Tensor) -> _Flown:
        """Draw the flights and the paths that navigation records."""
        span_s = float(time_s[-1] - time_s[0])
        drawn, true, recorded = [], [], []
        flights = (("transmitter", world.transmitter, world.navigation),)
        if world.receiver is not None:
            flights = (*flights, ("receiver", world.receiver, world.receiver_navigation))
        for name, flight, navigation in flights:
            path = flight.drawn(draws.part(name), span_s)
            drawn.append(path)
            true.append(path.position_m(time_s))
            recorded.append(navigation.recorded_m(draws.part(name), time_s, path))
        if world.window_range_m is None:
            legs = [torch.linalg.vector_norm(place, dim=-1) for place in recorded]
            reference = 2 * legs[0] if len(legs) == 1 else legs[0] + legs[1]
        else:
            reference = torch.full_like(time_s, 2 * world.window_range_m)
        flown, written = (AntennaPath(p[0], p[1] if len(p) > 1 else None, reference) for p in (true, recorded))
        return _Flown(flown, written, world.beam is not None, tuple(drawn))

    def over(self, centre_m: Tensor, time_s: Tensor) -> AntennaPath:
        """True paths at other times; their reference is that over points (..., pulse, 3)."""
        places = [flight.position_m(time_s) for flight in self.flights]
        legs = [torch.linalg.vector_norm(place - centre_m, dim=-1) for place in places]
        return AntennaPath(places[0], places[1] if len(places) > 1 else None, legs[0] + legs[-1])

    def truth(self) -> dict[str, Tensor]:
        """True positions and the error of the line of sight."""
        names = ("true_transmitter_m", "true_receiver_m")
        values = dict(zip(names, self.true.places, strict=False))
        return {**values, "line_of_sight_m": _line_of_sight_m(self.recorded, self.true, self.strip)}


def _line_of_sight_m(recorded: AntennaPath, true: AntennaPath, strip: bool = False) -> Tensor:
    """Half the path over the point (0, 0, 0), recorded minus true, (..., pulse).

    For a strip, it is that over the points abeam of the mean path of all trials.
    """
    middle = true.transmitter_m.new_zeros(1, 3)
    if strip:
        place = true.places[-1].reshape(-1, true.pulses, 3).mean(0)
        middle = StraightTrack.fitted(place).abeam_m(place, middle[0])
    off = [
        torch.linalg.vector_norm(after - middle, dim=-1) - torch.linalg.vector_norm(before - middle, dim=-1)
        for after, before in zip(recorded.places, true.places, strict=True)
    ]
    return torch.stack(torch.broadcast_tensors(*off)).mean(0)


@dataclass(frozen=True)
class PathError:
    """Impairment: errors of the positions that navigation records.

    >>> from torchsar import Draws, echo, radar, scene
    >>> sar = radar.InverseRadar(1e10, 1e8, 100.0)
    >>> track = scene.StraightPath([-800.0, 0.0, 600.0], [0.0, 50.0, 0.0])
    >>> world = scene.PathWorld(scene.Points([0.0], [0.0]), scene.Flight(track))
    >>> errors = {"height": echo.PathError(scene.Sway(z=[scene.Offset(0.1)]))}
    >>> echo.simulate_path(sar, world, 4, 8, Draws(1), errors)[1].values["height.line_of_sight_m"]
    tensor([0.0600, 0.0600, 0.0600, 0.0600], dtype=torch.float64)

    It works on simulated and on recorded data with the side data of `AntennaPath.side_data`. The
    radar keeps the middle of the scene in its window as navigation says: the reference of the
    phases changes by the error over the point (0, 0, 0), and the samples with it, so that the
    error of the line of sight is a phase of the pulses as well.

    Args:
        transmitter: Errors of the transmitter, or of both antennas if they share one.
        receiver: Errors of the receiver.
    """

    transmitter: Sway = field(default_factory=Sway)
    receiver: Sway = field(default_factory=Sway)

    def __call__(self, recording: Recording, draws: Draws) -> tuple[Recording, dict[str, Tensor]]:
        """Add the errors to the recorded positions.

        Args:
            recording: Recording with the axes (pulse, range); the errors are functions of its slow
                time since the first pulse.
            draws: Random draws.

        Returns:
            The recording with other side data and reference, and `line_of_sight_m`, shape (...,
            pulse): half the path over the point (0, 0, 0), with the errors minus without.

        Raises:
            ValueError: If the recording holds no positions of the antennas.
        """
        aux = recording.aux
        if "transmitter_m" not in aux:
            raise ValueError(f"errors of a path need recorded positions (aux transmitter_m), got {[*aux]}")
        time_s = recording.signal.axis("pulse").offsets(aux["transmitter_m"].device)
        span_s = float(time_s[-1])
        moved = {}
        for name, error in (("transmitter", self.transmitter), ("receiver", self.receiver)):
            if f"{name}_m" in aux:
                moved[name] = aux[f"{name}_m"] + error.drawn(draws.part(name), span_s).displacement_m(time_s)
        reference = aux["path_reference_m"]
        before = AntennaPath(aux["transmitter_m"], aux.get("receiver_m"), reference)
        after = AntennaPath(moved["transmitter"], moved.get("receiver"), reference)
        off = _line_of_sight_m(after, before)
        after = replace(after, reference_m=reference + 2 * off)
        turns = 2 * off[..., None] * aux["frequency_hz"] / recording.radar.wave_speed_m_s
        data = recording.signal.data
        data = range_profiles(frequency_samples(data) * unit_phasor(turns, data.dtype))
        return with_samples(recording, data, **after.side_data()), {"line_of_sight_m": off}


def _gain(world: PathWorld, antennas: AntennaPath, points: Tensor, time_s: Tensor) -> Tensor:
    """Product of the antenna gains of all ways that have a beam, (..., pulse or 1, point)."""
    if world.beam is None:
        return points.new_ones(1, 1)
    flight = world.transmitter if world.receiver is None else world.receiver
    nominal = flight.nominal.position_m(time_s)
    heading = torch.gradient(nominal, dim=0)[0] * nominal.new_tensor([1.0, 1.0, 0.0])
    speed = torch.linalg.vector_norm(heading, dim=-1, keepdim=True)
    if not bool((speed > 0).all()):
        raise ValueError("a beam needs an antenna that moves horizontally; leave it out for a fixed antenna")
    sight = points[..., None, :, :] - antennas.places[-1][..., None, :]
    ahead = (sight * (heading / speed)[:, None]).sum(-1) / torch.linalg.vector_norm(sight, dim=-1)
    one_way = world.beam.gain(time_s, ahead)
    return one_way.square() if world.receiver is None else one_way


def _lit_power(history: Tensor, gain: Tensor) -> Tensor:
    """Mean power (...,) of the samples in pulses in which a target is lit, or in all pulses if none
    is lit.
    """
    power = torch.view_as_real(history).double().square().sum(-1).mean(-1)
    lit = (gain >= _LIT).any(-1).expand(power.shape)
    lit = lit | ~lit.any(-1, keepdim=True)
    return (power * lit).sum(-1) / lit.sum(-1)


def _within(antennas: AntennaPath, points: Tensor, gain: Tensor, radar: InverseRadar, n_range: int) -> Tensor:
    """True if the window contains the echo of a scatterer, (..., pulse, point). Raises ValueError
    if an echo leaves the window while the scatterer is lit.
    """
    off = antennas.path_m(points[..., None, :, :]).detach() / 2
    half = n_range * radar.range_step_m / 2
    within = off.abs() <= half
    lost = ~within & (gain.detach() >= _LIT)
    if bool(lost.any()):
        raise ValueError(
            f"the lit scene must stay within {half:.4g} m of range from the middle of the window, but reaches "
            f"{float((off.abs() * lost).max()):.4g} m; choose a smaller scene, more range cells, or a "
            "window about the distance of the scene (window_range_m, and the origin of a motion log)"
        )
    return within
