"""Numbers as text, with prefixes of units and significant digits, and in JSON files."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torch import Tensor

MISSING = "–"
# units that have prefixes; those of levels, ratios and angles in degrees have none
_PREFIXED = ("m", "s", "Hz", "rad", "B")
_PREFIXES = {-12: "p", -9: "n", -6: "u", -3: "m", 0: "", 3: "k", 6: "M", 9: "G", 12: "T"}


def scale_of(values: Sequence[float | None], unit: str) -> tuple[float, str]:
    """Choose a prefix of a unit, for which the median magnitude of the values is 1 to 1000.

    Args:
        values: Numbers in the unit; None, zero and those that are not finite do not count.
        unit: The unit, without a prefix.

    Returns:
        The factor of the values, and the unit with its prefix.
    """
    there = sorted(abs(v) for v in values if v is not None and math.isfinite(v) and v)
    if not there or unit.split("/")[0].split("^")[0] not in _PREFIXED or "^" in unit.split("/")[0]:
        return 1.0, unit
    power = max(-12, min(12, 3 * math.floor(math.log10(there[len(there) // 2]) / 3)))
    return 10.0**-power, _PREFIXES[power] + unit


def number(value: Any, sd: Any = None, factor: float = 1.0) -> str:
    """Return a number as text.

    Args:
        value: A number, a text, a truth value, None, or a list of these.
        sd: Standard deviation, shown after the value. Both are rounded to the two leading digits of
            the standard deviation. A value without standard deviation has four significant digits,
            and a whole number all its digits up to a million.
        factor: Factor of all numbers.

    Returns:
        The text; a dash for None and for numbers that are not finite.
    """
    if isinstance(value, (list, tuple)):
        sds = sd if isinstance(sd, (list, tuple)) else [sd] * len(value)
        return ", ".join(number(v, s, factor) for v, s in zip(value, sds, strict=True))
    if isinstance(value, (str, bool)):
        return value if isinstance(value, str) else "yes" if value else "no"
    if value is None or not math.isfinite(value):
        return MISSING
    value = value * factor
    if sd is not None and math.isfinite(sd) and sd > 0:
        sd = float(f"{sd * factor:.1e}")
        digits = 1 - math.floor(math.log10(sd))
        if digits < 10:
            # adding 0.0 converts -0 to 0
            return " ± ".join(f"{round(x, digits) + 0.0:,.{max(0, digits)}f}" for x in (value, sd))
        return f"{value:.4g} ± {sd:.2g}"
    if float(value).is_integer() and abs(value) < 1e6:
        return f"{int(value)}"
    if not 1e-3 <= abs(value) < 1e6:
        return f"{value:.4g}"
    return f"{value:,.{max(0, 3 - math.floor(math.log10(abs(value))))}f}"


def quantity(value: Any, unit: str, sd: Any = None) -> str:
    """Return a number, or a list of numbers, with the unit and a suitable prefix: 17.58 um/s.

    Args:
        value: A number, a list of numbers, or None.
        unit: The unit, without a prefix.
        sd: Standard deviation of each number, or None.

    Returns:
        The text.
    """
    factor, unit = scale_of([*_numbers(value), *_numbers(sd)], unit)
    text = number(value, sd, factor)
    return f"{text} {unit}".strip() if any(map(math.isfinite, _numbers(value))) else text


def _numbers(value: Any) -> list[float]:
    if isinstance(value, (list, tuple)):
        return [x for one in value for x in _numbers(one)]
    return [value] if isinstance(value, (int, float)) and not isinstance(value, bool) else []


def write_json(path: Path, tree: Mapping[str, Any]) -> None:
    """Write a JSON file. Numbers that are not finite become null, as the format requires."""
    path.write_text(json.dumps(_finite(tree), indent=1, allow_nan=False) + "\n", encoding="utf-8")


def _finite(x: Any) -> Any:
    if isinstance(x, Mapping):
        return {str(k): _finite(v) for k, v in x.items()}
    if isinstance(x, (list, tuple)):
        return [_finite(v) for v in x]
    if isinstance(x, Tensor):
        return _finite(x.tolist())
    return None if isinstance(x, float) and not math.isfinite(x) else x
