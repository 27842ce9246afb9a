"""Checks of the numbers in the sections radar and world of a config, which find most wrong units.

Each number with a unit has a wide range of plausible magnitudes. Some products of powers of these
numbers, such as pulse length times PRF, have limits as well.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from typing import Any

from torchsar.radar import LIGHT_M_S
from torchsar.study.settings.errors import ConfigError

# units by the suffix of a key; a suffix that ends with another one comes first
_UNITS = {
    "_hz_s": "Hz/s",
    "_m_s2": "m/s^2",
    "_rad_s": "rad/s",
    "_m_s": "m/s",
    "_hz": "Hz",
    "_rad": "rad",
    "_deg": "degrees",
    "_db": "dB",
    "_m": "m",
    "_s": "s",
}
_PREFIXES = {1e3: "k", 1e-3: "m", 1e6: "M", 1e-6: "u", 1e9: "G", 1e-9: "n", 1e12: "T", 1e-12: "p"}
# pattern of SYSTEM.KEY, least and largest magnitude of numbers other than zero, and the reason; the
# systems whose numbers are checked; those of other packages have ranges of their own
_SYSTEMS = ("stripmap", "isal", "isal_rotation", "sal", "geo", "geo_ocean", "path")
# first pattern that matches is used
_RANGES: Sequence[tuple[str, float, float, str]] = (
    ("*.radar.wave_speed_m_s", 1e8, 3.1e8, "the speed of light in glass, air or space"),
    ("sal.radar.carrier_hz", 1e12, 1e16, "light from the far infrared to the ultraviolet"),
    ("sal.radar.wavelength_m", 3e-8, 3e-4, "light from the far infrared to the ultraviolet"),
    ("isal*.radar.carrier_hz", 3e8, 1e16, "waves short enough to show the shape of a target"),
    ("isal*.radar.wavelength_m", 3e-8, 1.0, "waves short enough to show the shape of a target"),
    ("geo*.radar.carrier_hz", 2e7, 3e11, "waves from the lowest radar band to millimetres"),
    ("*.radar.carrier_hz", 2e7, 1e16, "waves from the lowest radar band to the ultraviolet"),
    ("*.radar.wavelength_m", 3e-8, 15.0, "waves from the lowest radar band to the ultraviolet"),
    ("*.radar.*bandwidth_hz", 1e4, 1e13, "range cells from 15 um to 15 km"),
    ("*.radar.samp*_hz", 1e4, 1e13, "what converters reach, and what a pulse band needs"),
    ("*.radar.prf_hz", 1.0, 1e8, "from a slow ground-based radar to a fast laser"),
    ("*.radar.period_s", 1e-8, 1e-2, "the sweeps of tunable lasers"),
    ("*.radar.pulse*_s", 1e-10, 1e-1, "pulses from a nanosecond to a continuous sweep"),
    ("stripmap.radar.velocity_m_s", 0.1, 3e4, "from a rail to an orbit"),
    ("stripmap.world.velocity_m_s", 0.1, 3e4, "from a rail to an orbit"),
    ("geo*.radar.speed_m_s", 5.0, 2e3, "aircraft"),
    ("geo*.world.*u_?_m_s", 0.0, 2e3, "ships, vehicles and aircraft"),
    ("sal.radar.speed_m_s", 1e-5, 3e4, "from a laboratory stage to an orbit"),
    ("*_m_s", 0.0, 3e4, "nothing that is observed moves faster than a body in orbit"),
    ("*_m_s2", 0.0, 1e6, "no vibration or manoeuvre is more violent"),
    ("*.orbit.height_m", 1e5, 1e9, "orbits from the upper atmosphere to beyond the Moon"),
    ("geo*.radar.height_m", 1.0, 1e5, "aircraft"),
    ("geo*.radar.reference_range_m", 10.0, 1e7, "what an aircraft overlooks"),
    ("*.radar.near_range_m", 1.0, 1e8, "from the laboratory to an orbit"),
    ("*element_m", 1e-4, 1e2, "apertures that an aircraft carries"),
    ("*.radar.channel_m", 0.0, 1e2, "apertures that an aircraft carries"),
    ("*.world.beam.length_m", 1e-4, 1e2, "antennas that a platform carries"),
    ("*.motion.*.coefficients_m", 0.0, 1e6, "velocities and accelerations of observed bodies"),
    ("*.motion.*_m", 0.0, 0.1, "vibrations and fluctuations, which are far smaller than a target"),
    ("isal*.world.scene.*_m", 0.0, 1e4, "the size of a target, of which ships are the largest"),
    ("sal.world.scene.*_m", 0.0, 1e4, "what the beam of a ladar illuminates"),
    ("geo*.world.*cell_m", 0.0, 1e3, "patches of the sea"),
    ("geo*.world.*length_m", 0.0, 1e3, "ships"),
    ("geo*.world.*_m", 0.0, 1e5, "what an aircraft overlooks"),
    ("*.world.*_m", 0.0, 1e6, "scenes and swaths"),
    ("*_m", 0.0, 1e9, "distances as far as beyond the Moon"),
    ("sal.world.record.*_s", 0.0, 1e-1, "the sweeps of tunable lasers"),
    ("*.integration_s", 1e-6, 1e5, "apertures from a laser's to an orbit's"),
    ("*_rad_s", 0.0, 1e3, "turning targets"),
    ("*_rad", 0.0, 1e4, "phases of at most a thousand turns"),
    ("*_deg", 0.0, 720.0, "angles of at most two turns"),
    ("*_db", 0.0, 400.0, "levels that single precision can hold"),
    ("*.motion.*_hz", 0.0, 1e7, "vibrations and turbulent air"),
    ("*_hz_s", 0.0, 1e18, "sweeps of the fastest lasers"),
    ("*_s", 0.0, 1e5, "records of at most a day"),
    ("*_hz", 0.0, 1e13, "modulations, which are far slower than light"),
)


@dataclass(frozen=True)
class Relation:
    """Limits of a product of powers of numbers in a config, such as pulse length times PRF.

    Args:
        what: Meaning of the product.
        powers: Exponent of each number by its dotted key; `world.scene` denotes the largest
            coordinate of the scene.
        low: Least value of the product.
        high: Largest value of the product.
        factor: Constant factor of the product.
    """

    what: str
    powers: Mapping[str, int]
    low: float = 0.0
    high: float = math.inf
    factor: float = 1.0


# the limits are a hundred times wider than those of good images, to admit impaired and tiny scenes
_CARRIER, _PRF, _RANGE = "radar.carrier_hz", "radar.prf_hz", "radar.reference_range_m"
_RELATIONS = (
    *(Relation("the share of time that a pulse takes", {pulse: 1, _PRF: 1}, high=1.0)
      for pulse in ("radar.pulse.duration_s", "radar.pulse_s")),
    *(Relation("the bandwidth over the carrier", {band: 1, _CARRIER: -1}, high=2.0)
      for band in ("radar.pulse.bandwidth_hz", "radar.bandwidth_hz")),
    *(Relation("the sampling rate over the bandwidth", {"radar.sampling_hz": 1, band: -1}, high=500.0)
      for band in ("radar.pulse.bandwidth_hz", "radar.bandwidth_hz")),
    Relation("the length of a line over the pulse interval", {"world.samples": 1, "radar.sampling_hz": -1, _PRF: 1},
             high=2.0),
    *(Relation("the Doppler band of an aperture over the pulse rate",
               {speed: 2, _CARRIER: 1, time: 1, reach: -1, _PRF: -1}, high=100.0, factor=1 / LIGHT_M_S)
      for speed, time, reach in (("radar.velocity_m_s", "radar.integration_s", "radar.near_range_m"),
                                 ("radar.velocity_m_s", "world.beam.dwell_s", "radar.near_range_m"),
                                 ("radar.speed_m_s", "world.gate.duration_s", _RANGE))),
    *(Relation("the product of Doppler band and time of an aperture",
               {speed: 2, _CARRIER: 1, time: 2, reach: -1}, low=0.01, factor=1 / LIGHT_M_S)
      for speed, time, reach in (("radar.velocity_m_s", "radar.integration_s", "radar.near_range_m"),
                                 ("radar.velocity_m_s", "world.beam.dwell_s", "radar.near_range_m"),
                                 ("radar.speed_m_s", "world.gate.duration_s", _RANGE))),
    *(Relation("the Doppler band of the scene over the pulse rate",
               {rate: 1, _CARRIER: 1, "world.scene": 1, _PRF: -1}, high=100.0, factor=2 / LIGHT_M_S)
      for rate in ("radar.rotation_rad_s", "world.rotation_rad_s", "world.rotation.omega_rad_s")),
    *(Relation("the cross-range cell in m", {rate: -1, _CARRIER: -1, "world.pulses": -1, _PRF: 1}, high=100.0,
               factor=LIGHT_M_S / 2)
      for rate in ("radar.rotation_rad_s", "world.rotation_rad_s", "world.rotation.omega_rad_s")),
    Relation("the Doppler band of the scene over the period rate",
             {"radar.speed_m_s": 1, _CARRIER: 1, "world.scene": 1, _RANGE: -1, "radar.period_s": 1}, high=100.0,
             factor=2 / LIGHT_M_S),
    Relation("the cross-range cell in m",
             {"radar.speed_m_s": -1, _CARRIER: -1, "world.periods": -1, _RANGE: 1, "radar.period_s": -1}, high=100.0,
             factor=LIGHT_M_S / 2),
)  # fmt: skip


def refuse_implausible(system: str, radar: Any, world: Any, file: str) -> None:
    """Check that all numbers, and the products of powers of numbers, are within their limits.

    Args:
        system: Name of the system.
        radar: The section radar with all defaults; None for recorded data.
        world: The section world.
        file: Name of the config, for messages.

    Raises:
        ConfigError: If a number or a product is not. The message gives the unit, the accepted range
            and, if there is one, a likely correction.
    """
    if system not in _SYSTEMS:
        return
    numbers: dict[str, float] = {}
    for key, value in _numbers({"radar": radar, "world": world}, ""):
        numbers[key] = max(value, numbers.get(key, 0.0), key=abs)
        row = next((row for row in _RANGES if fnmatch(f"{system}.{key}", row[0])), None)
        if row is not None and value and not row[1] <= abs(value) <= row[2]:
            raise ConfigError(f"{file}: {key} is {_out_of_range(key, value, *row[1:])}")
    span = [key for key in numbers if key.startswith("world.scene.") and key.endswith("_m")]
    farthest = max(span, key=lambda key: abs(numbers[key]), default="")
    for relation in _RELATIONS:
        powers = {farthest if key == "world.scene" else key: power for key, power in relation.powers.items()}
        _check_relation(relation, powers, numbers, file)


def _check_relation(relation: Relation, powers: Mapping[str, int], numbers: Mapping[str, float], file: str) -> None:
    """Raise ConfigError if a relation between numbers of the config is outside its limits."""
    factor, length = relation.factor, "radar.wavelength_m"
    if _CARRIER in powers and length in numbers:
        factor *= LIGHT_M_S ** powers[_CARRIER]
        powers = {length if key == _CARRIER else key: p if key != _CARRIER else -p for key, p in powers.items()}
    values = {key: abs(numbers.get(key, 0.0)) for key in powers}
    product = factor * math.prod(values[key] ** power for key, power in powers.items() if values[key])
    if not all(values.values()) or relation.low <= product <= relation.high:
        return
    edge = relation.low if product < relation.low else relation.high
    limit = f"{'at least' if edge == relation.low else 'at most'} {edge:g}"
    tries = [
        f"{key} ({values[key]:g}{_unit(key)}) to {values[key] * (edge / product) ** (1 / power):.3g}{_unit(key)}"
        for key, power in powers.items()
    ]
    raise ConfigError(
        f"{file}: {relation.what} is {product:.3g} and should be {limit}; check the units, or change one number at "
        f"least as far as follows: {', '.join(tries)}"
    )


def _numbers(tree: Any, path: str) -> Iterator[tuple[str, float]]:
    """Every number of a tree with its dotted key; entries of a list have the key of the list."""
    if isinstance(tree, Mapping):
        for key, value in tree.items():
            yield from _numbers(value, f"{path}.{key}".lstrip("."))
    elif isinstance(tree, list | tuple):
        for value in tree:
            yield from _numbers(value, path)
    elif isinstance(tree, int | float) and not isinstance(tree, bool):
        yield path, tree


def _unit(key: str) -> str:
    return next((f" {unit}" for ending, unit in _UNITS.items() if key.endswith(ending)), "")


def _out_of_range(key: str, value: float, low: float, high: float, reason: str) -> str:
    """The value, its range, and the number with a prefix of its unit if that is in range."""
    unit = _unit(key)
    accepted = f"{low:g}{unit} to {high:g}{unit}" if low else f"at most {high:g}{unit}"
    scales = () if key.endswith(("_deg", "_db")) else _PREFIXES
    near = next((scale for scale in scales if max(low, high * 1e-12) <= abs(value) * scale <= high), None)
    hint = f"; did you mean {value:g} {_PREFIXES[near]}{unit.strip()}, which is {value * near:g}?" if near else ""
    return f"{value:g}{unit}, and should be {accepted} ({reason}){hint}"
