"""Check of the magnitudes of the numbers in the sections radar and world, which finds most wrong
units.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from torchsar.study.settings.errors import ConfigError

Magnitudes = Mapping[str, tuple[str, float, float]]
# unit, least and largest magnitude of numbers other than zero, by the ending of their key; the
# first ending that fits counts
MAGNITUDES: Magnitudes = {
    "wave_speed_m_s": ("m/s", 1e8, 3.1e8),
    "carrier_hz": ("Hz", 2e7, 1e16),
    "wavelength_m": ("m", 3e-8, 15.0),
    "bandwidth_hz": ("Hz", 1e4, 1e13),
    "sampling_hz": ("Hz", 1e4, 1e13),
    "prf_hz": ("Hz", 1.0, 1e8),
    "period_s": ("s", 1e-8, 1e-2),
    "pulse_s": ("s", 1e-10, 1e-1),
    "pulse.duration_s": ("s", 1e-10, 1e-1),
    "reference_range_m": ("m", 10.0, 1e9),
    "near_range_m": ("m", 1.0, 1e8),
    "element_m": ("m", 1e-4, 1e2),
    "_hz_s": ("Hz/s", 0.0, 1e18),
    "_rad_s": ("rad/s", 0.0, 1e3),
    "_m_s2": ("m/s^2", 0.0, 1e6),
    "_m_s": ("m/s", 0.0, 3e4),
    "_hz": ("Hz", 0.0, 1e13),
    "_rad": ("rad", 0.0, 1e4),
    "_deg": ("degrees", 0.0, 720.0),
    "_db": ("dB", 0.0, 400.0),
    "_m": ("m", 0.0, 1e9),
    "_s": ("s", 0.0, 1e5),
}


def refuse_implausible(magnitudes: Magnitudes, radar: Any, world: Any, file: str) -> None:
    """Check that all numbers with a unit have a magnitude that occurs.

    Args:
        magnitudes: Units and limits by the ending of a key, as in `MAGNITUDES`.
        radar: The section radar with all defaults; None for recorded data.
        world: The section world.
        file: Name of the config, for messages.

    Raises:
        ConfigError: If a number has not. The message gives the unit, the accepted range and, if
            there is one, a likely correction.
    """
    for key, value in _numbers({"radar": radar, "world": world}, ""):
        unit, low, high = next((row for ending, row in magnitudes.items() if key.endswith(ending)), ("", 0.0, 1e300))
        if value and not low <= abs(value) <= high:
            prefixes = {"k": 1e3, "m": 1e-3, "M": 1e6, "u": 1e-6, "G": 1e9, "n": 1e-9}
            fits = {p: value * x for p, x in prefixes.items() if max(low, 1e-12 * high) <= abs(value) * x <= high}
            hint = next((f"; did you mean {value:g} {p}{unit}, which is {x:g}?" for p, x in fits.items()), "")
            raise ConfigError(
                f"{file}: {key} is {value:g} {unit}, and should be {low:g} {unit} to {high:g} {unit} in magnitude{hint}"
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
