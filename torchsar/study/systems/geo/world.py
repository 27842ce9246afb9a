"""Moving points recorded by several channels: section `world` of a config, and its echoes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Annotated, Any, Literal, NamedTuple

import torch
from torch import Tensor

from torchsar.core import Draws, Recording, Truth, unit_phasor
from torchsar.echo import Impairment, apply_impairments, simulate_bistatic
from torchsar.echo.sea import sea_echo
from torchsar.radar import LIGHT_M_S, BistaticRadar, Ephemeris, LinearFM
from torchsar.scene import BandLimited, BistaticWorld, ExactRange, MovingPoints, PolynomialTransmit
from torchsar.scene.bistatic import Gate, ReceiveRange
from torchsar.scene.sea import Sea
from torchsar.scene.trials import repeated
from torchsar.study.names.registry import GATES, MULTICHANNEL_IMPAIRMENTS, RECEIVE_RANGES, SEAS
from torchsar.study.trials.batch import Trials
from torchsar.study.trials.system import World

# true values that processors may use, and that metrics.json contains for each target
TRUTHS = ("u_r_m_s", "u_a_m_s", "y0_m", "range_m")


def bistatic_radar(
    carrier_hz: float,
    bandwidth_hz: float,
    pulse_s: float,
    sampling_hz: float,
    prf_hz: float,
    speed_m_s: float,
    reference_range_m: float,
    height_m: float = 3000.0,
    channel_m: Sequence[float] = (-0.8, 0.0, 0.8),
    element_m: float = 0.8,
    transmit_range: Sequence[float] = (),
    orbit: Ephemeris | None = None,
    wave_speed_m_s: float = LIGHT_M_S,
) -> BistaticRadar:
    """Make a `BistaticRadar` from the keys of a config.

    Args:
        carrier_hz: Carrier frequency in Hz.
        bandwidth_hz: Bandwidth of the transmitted up-chirp in Hz.
        pulse_s: Length of the transmitted pulse in seconds.
        sampling_hz: Complex sampling rate in Hz, at least the bandwidth.
        prf_hz: Pulse repetition frequency of the transmitter in Hz.
        speed_m_s: Speed of the receiver along its straight, level track in m/s.
        reference_range_m: Closest slant range from the receiver to the scene centre in metres.
        height_m: Height of the receiver in metres.
        channel_m: Positions of the channels along the track in metres.
        element_m: Length of the aperture of each channel along the track in metres.
        transmit_range: Coefficients k1, k2, ... (m/s, m/s^2, ...) of the change of the range to the
            transmitter, k1 t + k2 t^2 + ...
        orbit: Orbit of the transmitter, from which these coefficients follow; null if
            transmit_range is given, or the coefficients are zero.
        wave_speed_m_s: Propagation speed in m/s.

    Raises:
        ValueError: If both transmit_range and orbit are given, or a value is not accepted.
    """
    if orbit is not None and transmit_range:
        raise ValueError("radar: give one of transmit_range and orbit, and leave the other out")
    known: dict[str, Any] = {"height_m": height_m, "channel_m": tuple(channel_m), "element_m": element_m}
    known["transmit_range"] = tuple(transmit_range) if orbit is None else orbit.transmit_coefficients()
    numbers = (sampling_hz, prf_hz, speed_m_s, reference_range_m)
    return BistaticRadar(carrier_hz, LinearFM(bandwidth_hz, pulse_s), *numbers, **known, wave_speed_m_s=wave_speed_m_s)


@dataclass(frozen=True)
class Target:
    """A point of amplitude 1 in uniform motion.

    Args:
        u_r_m_s: Speed along the slant range in m/s, closing positive.
        u_a_m_s: Speed along the track in m/s, positive in the flight direction of the receiver.
        azimuth_m: Position along the track in metres at t = 0, the middle pulse.
        range_m: Closest range in metres beyond the reference range.
    """

    u_r_m_s: Tensor | float = 0.0
    u_a_m_s: Tensor | float = 0.0
    azimuth_m: Tensor | float = 0.0
    range_m: Tensor | float = 0.0


@dataclass(frozen=True)
class Level:
    """Level of a target over noise or sea; at most one is given, in dB.

    Args:
        snr_db: Power of a target over noise in a sample of one channel after range compression.
        raw_scnr_db: Power of a target over noise in a sample of one channel before range
            compression; "raw SCNR" in the literature, although it does not include the clutter.
            Compression raises it by 10 log10(B tau_p) dB, with the bandwidth B and the
            length tau_p of a pulse.
        scr_db: Power of a target over that of the sea in a sample after range compression.
    """

    snr_db: Tensor | float | None = None
    raw_scnr_db: Tensor | float | None = None
    scr_db: Tensor | float | None = None

    def __post_init__(self) -> None:
        given = [one.name for one in fields(self) if getattr(self, one.name) is not None]
        if len(given) > 1:
            raise ValueError(
                f"world.noise: {given[0]} and {given[1]} both set the level of the targets; give one of snr_db, "
                "raw_scnr_db and scr_db, and leave the others null"
            )


class Own(NamedTuple):
    """What metrics need: the impaired echo of the targets alone, their SNR in dB, shape (row,), and
    the world with the parameters of each row. A row is one target in one trial.
    """

    alone: Recording
    snr_db: Tensor | None
    world: Points


@dataclass(frozen=True, kw_only=True)
class Points(World):
    """World of moving point targets, a sea and noise. Every target is recorded alone, with random
    numbers of its own, which depend on its name.

    Args:
        pulses: Number of pulses of the record.
        samples: Number of range samples; null for azimuth-only data, a single range line through
            the target.
        kind: "compressed" for range-compressed data, or "full" for uncompressed chirps. Chirps need
            more range samples, by twice the length of a pulse.
        targets: Point targets by name.
        gate: Illumination of the targets over slow time.
        sea: Clutter of a sea at rest; null for none.
        sea_gate: Illumination of the sea; null for the gate of the targets.
        receive: Model of the range from a target to the receiver.
        transmit_range: True k1, k2, ... of the range to the transmitter; null for the values of
            the radar.
        noise: Level of the targets over noise or sea.
        impairments: Impairments of the recording by name, applied in this order.
    """

    pulses: int
    samples: int | None = None
    kind: Literal["compressed", "full"] = "compressed"
    targets: Mapping[str, Target]
    gate: Annotated[Gate, GATES] = field(default_factory=lambda: BandLimited(4.5))
    sea: Annotated[Sea, SEAS] | None = None
    sea_gate: Annotated[Gate, GATES] | None = None
    receive: Annotated[ReceiveRange, RECEIVE_RANGES] = field(default_factory=ExactRange)
    transmit_range: Sequence[Tensor | float] | None = None
    noise: Level = field(default_factory=Level)
    impairments: Mapping[str, Annotated[Impairment, MULTICHANNEL_IMPAIRMENTS]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.pulses < 1 or not self.targets or (self.samples is not None and self.samples < 1):
            raise ValueError(
                "world needs at least one target, one pulse and one sample (or null for azimuth-only data), got "
                f"{len(self.targets)} targets, {self.pulses} pulses and {self.samples} samples"
            )
        if self.noise.scr_db is not None and self.sea is None:
            raise ValueError("world.noise.scr_db, a signal-to-clutter ratio, needs world.sea; give it, or use snr_db")
        if self.sea is not None and all(getattr(self.noise, one.name) is None for one in fields(Level)):
            raise ValueError(
                "world.noise must be given with world.sea, whose level is relative to the noise; give snr_db, "
                "raw_scnr_db or scr_db"
            )
        if self.sea is not None and self.kind == "full":
            raise ValueError(
                "world.sea needs range-compressed echoes, to which it is added; set world.kind: compressed"
            )
        beyond = any(bool((torch.as_tensor(target.range_m) != 0).any()) for target in self.targets.values())
        if self.samples is None and (self.kind == "full" or beyond):
            raise ValueError(
                "world.samples: azimuth-only data (null) have a single range, the reference_range_m of the radar; "
                "give a number of samples, or leave out range_m of the targets and 'kind: full'"
            )

    @property
    def integration_s(self) -> Tensor | float | None:
        """Time in s for which targets are illuminated; None for an antenna pattern."""
        return self.gate.duration_s if isinstance(self.gate, BandLimited) else None

    def snr_db(self, radar: BistaticRadar) -> Tensor | float | None:
        """Return the SNR in dB of a target in a range-compressed sample of one channel; None for no
        noise.
        """
        noise = self.noise
        if noise.raw_scnr_db is not None:
            return noise.raw_scnr_db + compression_gain_db(radar)
        if noise.scr_db is not None and self.sea is not None:
            return noise.scr_db + self.sea.power_db
        return noise.snr_db

    def trials_of(self, radar: BistaticRadar, draws: Draws, dtype: torch.dtype, device: str = "cpu") -> Trials:
        """Simulate recordings with and without noise and sea, and the true values.

        A row is one target in one trial; the rows of a trial follow each other.
        """
        rows, count = _row_draws(draws, self.targets), len(draws.trials or (0,))
        own: Points = repeated(self, len(self.targets))  # each row has the values of its trial
        level = own.snr_db(radar)
        snr = None if level is None else torch.as_tensor(level, dtype=torch.float64).expand(len(rows.trials or ()))
        transmit = None if own.transmit_range is None else PolynomialTransmit(own.transmit_range)
        world = BistaticWorld(self.points(count), own.gate, None, snr, own.receive, transmit)
        size = (self.pulses, self.samples)
        noisy, truth = simulate_bistatic(radar, world, *size, rows, kind=self.kind, dtype=dtype, device=device)
        assert truth.clean is not None
        if self.sea is not None:
            noisy = replace(noisy, signal=noisy.signal.with_data(noisy.signal.data + own._sea(rows, snr, truth, noisy)))
        values = {name: value[..., 0] for name, value in truth.values.items() if name in TRUTHS}
        named = {
            f"{target}.{name}": x.reshape(count, -1)[:, i]
            for name, x in values.items()
            for i, target in enumerate(self.targets)
        }
        values = {**values, **named, "noise_std": truth.values["noise_std"]}
        alone = truth.clean
        if own.impairments:
            (noisy, known), (alone, _) = (apply_impairments(one, own.impairments, rows) for one in (noisy, alone))
            values.update(known)
        return Trials(noisy, truth.clean, values, count, Own(alone, snr, own))

    def points(self, count: int) -> MovingPoints:
        """Return the targets, one in each row; the rows of a trial follow each other."""

        def rows(name: str) -> Tensor:
            each = [
                torch.as_tensor(getattr(one, name), dtype=torch.float64).expand(count) for one in self.targets.values()
            ]
            return torch.stack(each, -1).reshape(-1, 1)

        return MovingPoints(rows("u_r_m_s"), rows("u_a_m_s"), rows("azimuth_m"), rows("range_m"))

    def _sea(self, rows: Draws, snr: Tensor | None, truth: Truth, recording: Recording) -> Tensor:
        """Echo of the sea with the carrier phase of the transmit range."""
        assert self.sea is not None and snr is not None
        signal, gate = recording.signal, self.gate if self.sea_gate is None else self.sea_gate
        sea = replace(self.sea, power_db=self.sea.power_db - snr)  # pyright: ignore[reportCallIssue]
        where = (rows.part("sea"), signal.data.dtype, signal.data.device)
        echo = sea_echo(sea, recording.radar, self.pulses, self.samples, gate, *where)  # pyright: ignore
        turned = unit_phasor(-truth.values["transmit_range_m"] / recording.radar.wavelength_m, signal.data.dtype)
        return echo * (turned[..., None] if "range" in signal.names else turned)


def compression_gain_db(radar: BistaticRadar) -> float:
    """Return the SNR gain of range compression in dB, 10 log10(bandwidth * pulse length)."""
    return 10 * math.log10(radar.pulse.bandwidth_hz * radar.pulse.duration_s)


def _row_draws(draws: Draws, names: Mapping[str, Target]) -> Draws:
    """One address for each trial and target, trials outermost. The random numbers of a target do
    not depend on other targets.
    """
    rows = [(f"{case}/{name}", trial) for case, trial in draws.addresses for name in names]
    return replace(draws, case=tuple(case for case, _ in rows), trials=[trial for _, trial in rows])
