"""What all instruments share: a carrier, the speed of light, and the check of their parameters."""

from __future__ import annotations

import math
from dataclasses import fields
from numbers import Real
from typing import Any

LIGHT_M_S = 299_792_458.0  # speed of light in vacuum, by definition of the metre


class Instrument:
    """Base class of radars and ladars with the fields `carrier_hz` and `wave_speed_m_s`."""

    carrier_hz: float
    wave_speed_m_s: float

    @property
    def wavelength_m(self) -> float:
        """Carrier wavelength in metres."""
        return self.wave_speed_m_s / self.carrier_hz

    def refuse_not_positive(self, *names: str) -> None:
        """Raise ValueError unless the carrier, the wave speed and further fields are positive, and
        the whole band has positive frequencies.

        All fields whose annotations are numbers must hold numbers, or None where that is annotated.

        Args:
            *names: Names of fields that hold numbers, or None where they have no value.
        """
        for field in fields(self):  # type: ignore[arg-type]
            name, value, hint = field.name, getattr(self, field.name), str(field.type)
            optional = " or None" if "None" in hint else ""
            if optional and value is None:
                continue
            if hint.startswith("float") and not isinstance(value, Real):
                raise ValueError(f"{type(self).__name__}: {name} must be a number{optional}, got {value!r}")
            if name in ("carrier_hz", "wave_speed_m_s", *names) and not 0 < float(value) < math.inf:
                raise ValueError(f"radar.{name} must be a positive number{optional}, got {value}")
        band: Any = getattr(self, "pulse", self)
        if not band.bandwidth_hz < 2 * self.carrier_hz:
            raise ValueError(
                f"radar.carrier_hz must be above half the bandwidth of {band.bandwidth_hz:g} Hz, got "
                f"{self.carrier_hz:g} Hz; frequencies are in Hz: 9.6 GHz is 9.6e9"
            )
