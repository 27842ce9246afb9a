"""From a checked config to the radar, the world, and recordings of each target alone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchsar.core import Draws, Recording, Truth, unit_phasor
from torchsar.echo import Impairment, apply_impairments, sea_echo, simulate_bistatic
from torchsar.radar import BistaticRadar, LinearFM, Orbit, range_coefficients, seen_point
from torchsar.scene import BandLimited, BistaticWorld, Gate, MovingPoints, Pattern, PolynomialTransmit, Sea
from torchsar.study.build import build_impairments, precision, refuse_oversize
from torchsar.study.cases import cases_of, check_judged
from torchsar.study.config import Loaded
from torchsar.study.geo.sections import Ephemeris, GeoConfig, Noise, Target, compression_gain_db
from torchsar.study.methods import build_chains
from torchsar.study.registry import GATES, MULTICHANNEL_IMPAIRMENTS, RECEIVE_RANGES, SEAS
from torchsar.study.settings.errors import ConfigError

TOLD = "true_"
_TOLD = ("u_r_m_s", "u_a_m_s", "y0_m", "range_m")


@dataclass(frozen=True)
class Recorded:
    """Rows of trials, each of all targets in turn: recordings with noise and sea, the same of the
    target alone (clean), both impaired, the unimpaired echo, and the truth (row,).
    """

    noisy: Recording
    clean: Recording
    unimpaired: Recording
    truth: Mapping[str, Tensor]


@dataclass(frozen=True)
class Echoes:
    """All that simulates the trials of one case.

    snr_db: of a range-compressed sample, a number or one per trial; sea: its power_db counts from
    the noise.
    """

    radar: BistaticRadar
    targets: Mapping[str, Target]
    gate: Gate
    sea: Sea | None
    sea_gate: BandLimited | Pattern
    receive: Any
    transmit: PolynomialTransmit | None
    snr_db: Tensor | float | None
    impairments: Mapping[str, Impairment]
    pulses: int
    samples: int | None
    kind: Any
    dtype: torch.dtype

    @staticmethod
    def of(loaded: Loaded) -> Echoes:
        """Raises ConfigError for what radar or world refuse."""
        config, file = loaded.config, loaded.file
        assert isinstance(config, GeoConfig) and config.world is not None
        world, radar = config.world, build_radar(loaded)
        refuse_oversize(
            world.pulses * radar.channels * len(world.targets),
            world.samples or 1,
            file,
            "world.pulses or world.samples",
        )
        gate = GATES.make(world.gate, "world.gate", file)
        sea_gate = gate if world.sea_gate is None else GATES.make(world.sea_gate, "world.sea_gate", file)
        sea = None if world.sea is None else SEAS.make(world.sea, "world.sea", file)
        receive = RECEIVE_RANGES.make(world.receive, "world.receive", file)
        transmit = None if world.transmit_range is None else PolynomialTransmit(world.transmit_range)
        impairments = build_impairments(world.impairments, "world.impairments", file, MULTICHANNEL_IMPAIRMENTS)
        snr = snr_db_of(world.noise, compression_gain_db(config), sea)
        if sea is not None and snr is None:
            raise ConfigError(
                f"{file}: world.noise: the level of a sea counts from the noise; give snr_db, raw_scnr_db or scr_db"
            )
        return Echoes(
            radar,
            world.targets,
            gate,
            sea,
            sea_gate,
            receive,
            transmit,
            snr,
            impairments,
            world.pulses,
            world.samples,
            world.kind,
            precision(config),
        )

    @property
    def integration_s(self) -> float | None:
        """Of the gate, None for a pattern."""
        return self.gate.duration_s if isinstance(self.gate, BandLimited) else None

    def recorded(self, draws: Draws, device: str = "cpu", dtype: torch.dtype | None = None) -> Recorded:
        """Rows (trial, target), flattened; dtype: of the samples, by default that of the config."""
        rows = row_draws(draws, self.targets)
        snr = self._per_row(len(rows.trials or ()))
        world = BistaticWorld(self._points(len(rows.trials or ())), self.gate, None, snr, self.receive, self.transmit)
        noisy, truth = simulate_bistatic(
            self.radar, world, self.pulses, self.samples, rows, kind=self.kind, dtype=dtype or self.dtype, device=device
        )
        assert truth.clean is not None
        if self.sea is not None:
            noisy = replace(
                noisy, signal=noisy.signal.with_data(noisy.signal.data + self._sea(rows, snr, truth, noisy))
            )
        values = {name: value[..., 0] for name, value in truth.values.items() if name in _TOLD}
        told = {f"{TOLD}{name}": values[name] for name in _TOLD}
        noisy, clean, unimpaired = (replace(one, aux={**one.aux, **told}) for one in (noisy, truth.clean, truth.clean))
        if self.impairments:
            (noisy, said), (clean, _) = (apply_impairments(one, self.impairments, rows) for one in (noisy, clean))
            values.update(said)
        return Recorded(noisy, clean, unimpaired, {**values, "noise_std": truth.values["noise_std"]})

    def _points(self, rows: int) -> MovingPoints:
        def column(name: str) -> Tensor:
            return torch.tensor(
                [getattr(target, name) for target in self.targets.values()], dtype=torch.float64
            ).repeat(rows // len(self.targets))[:, None]

        return MovingPoints(column("u_r_m_s"), column("u_a_m_s"), column("azimuth_m"), column("range_m"))

    def _per_row(self, rows: int) -> Tensor | None:
        if self.snr_db is None:
            return None
        level = torch.as_tensor(self.snr_db, dtype=torch.float64)
        return level.repeat_interleave(len(self.targets)) if level.ndim else level.expand(rows)

    def _sea(self, rows: Draws, snr: Tensor | None, truth: Truth, recording: Recording) -> Tensor:
        """Echo of the sea with the range to the transmitter on its carrier."""
        assert self.sea is not None and snr is not None
        data, signal = recording.signal.data, recording.signal
        sea = replace(self.sea, power_db=self.sea.power_db - snr)
        echo = sea_echo(
            sea, self.radar, self.pulses, self.samples, self.sea_gate, rows.part("sea"), data.dtype, data.device
        )
        turned = unit_phasor(-truth.values["transmit_range_m"] / self.radar.wavelength_m, data.dtype)
        return echo * (turned[..., None] if "range" in signal.names else turned)


def row_draws(draws: Draws, names: Mapping[str, Any]) -> Draws:
    """One address for each trial and target, trials outermost; a target keeps its draws whatever
    others there are.
    """
    trials = list(draws.trials if draws.trials is not None else [0])
    cases = draws.case if isinstance(draws.case, tuple) else (draws.case,) * len(trials)
    return Draws(
        draws.seed,
        tuple(f"{case}/{name}" for case in cases for name in names),
        [trial for trial in trials for _ in names],
    )


def snr_db_of(noise: Noise, gain_db: float, sea: Sea | None) -> float | None:
    """SNR of a range-compressed sample of one channel, None for no noise."""
    if noise.raw_scnr_db is not None:
        return noise.raw_scnr_db + gain_db
    if noise.scr_db is not None:
        assert sea is not None
        return noise.scr_db + float(sea.power_db)
    return noise.snr_db


def build_radar(loaded: Loaded) -> BistaticRadar:
    """The instrument, its range to the transmitter from the orbit where there is one.

    Raises ConfigError.
    """
    given = loaded.config.radar.model_dump()
    orbit, bandwidth, pulse_s = (given.pop(name) for name in ("orbit", "bandwidth_hz", "pulse_s"))
    try:
        if orbit is not None:
            given["transmit_range"] = transmit_coefficients(loaded.config.radar.orbit)
        return BistaticRadar(pulse=LinearFM(bandwidth, pulse_s), **given)
    except ValueError as error:
        raise ConfigError(f"{loaded.file}: radar: {error}") from None


def transmit_coefficients(ephemeris: Ephemeris) -> tuple[float, ...]:
    """k1, k2, ... of the range from the satellite to the point that it looks at."""
    names = ("eccentricity", "inclination_deg", "raan_deg", "argument_of_perigee_deg", "mean_anomaly_deg")
    orbit = Orbit.at_height(ephemeris.height_m, **{name: getattr(ephemeris, name) for name in names})
    time_s = torch.tensor([ephemeris.time_s], dtype=torch.float64)
    point = seen_point(
        *orbit.state(time_s), ephemeris.off_nadir_deg, ephemeris.squint_deg, 1.0 if ephemeris.side == "right" else -1.0
    )
    return tuple(range_coefficients(orbit, point, time_s, ephemeris.order)[0].tolist())


def refuse_unfit(loaded: Loaded) -> None:
    """Raise ConfigError for methods that the system cannot judge."""
    check_judged(loaded)
    assert isinstance(loaded.config, GeoConfig)
    if loaded.config.metrics.reference is not None:
        raise ConfigError(
            f"{loaded.file}: metrics.reference: system geo judges by the truth and by theory; leave it out"
        )


def check(loaded: Loaded) -> None:
    """Build all that a simulation names, without computing anything."""
    for case in cases_of(loaded).values():
        refuse_unfit(case)
        echoes = Echoes.of(case)
        build_chains(case, radar=echoes.radar)
