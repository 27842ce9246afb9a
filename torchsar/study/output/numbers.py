"""Numbers for reading: units with prefixes, and as many digits as mean something."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

MISSING = "–"
# units that take a prefix; those of levels, shares and angles in degrees take none
_PREFIXED = ("m", "s", "Hz", "rad", "B")
_PREFIXES = {-12: "p", -9: "n", -6: "u", -3: "m", 0: "", 3: "k", 6: "M", 9: "G", 12: "T"}


def scale_of(values: Sequence[float | None], unit: str) -> tuple[float, str]:
    """Factor and unit in which most of some values lie between 1 and 1000."""
    there = sorted(abs(v) for v in values if v is not None and math.isfinite(v) and v)
    if not there or unit.split("/")[0].split("^")[0] not in _PREFIXED or "^" in unit.split("/")[0]:
        return 1.0, unit
    power = max(-12, min(12, 3 * math.floor(math.log10(there[len(there) // 2]) / 3)))
    return 10.0**-power, _PREFIXES[power] + unit


def number(value: Any, sd: float | None = None) -> str:
    """A number for reading; text passes, and what is missing is a dash.

    With a standard deviation it has that one's two leading digits, else four digits of its own.
    """
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return MISSING
    if isinstance(value, (str, bool)):
        return value if isinstance(value, str) else "yes" if value else "no"
    if isinstance(value, (list, tuple)):
        return ", ".join(number(v) for v in value)
    if sd is not None and math.isfinite(sd) and sd > 0:
        digits = max(0, 1 - math.floor(math.log10(sd)))
        return f"{value:,.{digits}f} ± {sd:.{digits}f}" if digits < 10 else f"{value:.4g} ± {sd:.2g}"
    if float(value).is_integer() and abs(value) < 1e6:
        return f"{int(value)}"
    if not 1e-3 <= abs(value) < 1e6:
        return f"{value:.4g}"
    return f"{value:,.{max(0, 3 - math.floor(math.log10(abs(value))))}f}"


def quantity(value: Any, unit: str, sd: float | None = None) -> str:
    """A number with its unit, in the prefix that suits it: 17.58 um/s."""
    if not isinstance(value, (int, float)):
        return number(value)
    factor, unit = scale_of([value], unit)
    return f"{number(value * factor, None if sd is None else sd * factor)} {unit}".strip()
