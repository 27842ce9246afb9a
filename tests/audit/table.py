"""The table of all estimators, and those that need no entry of their own, with the reason."""

from __future__ import annotations

from tests.audit import channels, ladars, paths, pulses, repairs, rotations, strips
from tests.audit.frame import Entry, estimators

# Functions that a stage of another name calls with the same data and settings: the verdict is
# formed once, in the function. A function and a stage of one name need one entry, too.
SAME = {
    "compensate.minimum_entropy_velocity": "compensate.EffectiveVelocity",
    "repair.estimate_jitter_blind": "repair.BlindJitter",
    "repair.estimate_jitter_pilot": "repair.PilotJitter",
    "repair.estimate_response_sharpest": "repair.EstimateResponse",
}

# Functions whose `ok` is no claim about data: with the reason.
_SEARCH = "`ok` says that the cost was finite: the minimum of a function that the caller gives"
_LIMIT = "`ok` says that an algorithm meets a requirement: computed from parameters, not from data"
OTHER = {
    **dict.fromkeys(
        ("optim.adam", "optim.differential_evolution", "optim.genetic", "optim.grid_search", "optim.lbfgs"), _SEARCH
    ),
    "optim.newton": _SEARCH,
    "compensate.CorrectPath": "`ok` is always True: positions less an offset that is itself an estimate",
    "focus.requirements": _LIMIT,
    "focus.inverse_requirements": _LIMIT,
    "focus.ladar_requirements": _LIMIT,
    "focus.ladar_limits": _LIMIT,
    "multichannel.multichannel_requirements": _LIMIT,
    "multichannel.multichannel_limits": _LIMIT,
}

# Cells of the recorded audit that miss a bar, as (estimator, world, SNR), by the reason.
_CHANGES = {  # SNR of the worlds whose scatterers change, by a short name
    "8 points": [("another scene of 8 points", 20.0)],
    "40 points": [("another scene of 40 points", 20.0)],
    "few scintillate": [("scintillating 8 points", 20.0)],
    "few scintillate, 0 dB": [("scintillating 8 points", 0.0)],
    "many scintillate": [("scintillating 40 points", 20.0)],
    "many scintillate, 0 dB": [("scintillating 40 points", 0.0)],
    "walk": [("walking 3 points", 5.0), ("walking 3 points", 20.0)],
}
_ALWAYS = ("8 points", "40 points", "walk")
_MANY = ("many scintillate", "many scintillate, 0 dB")
_CHANGING = {
    "Autofocus": tuple(_CHANGES),
    "EntropyFixedPoint": (*_ALWAYS, "few scintillate", *_MANY),
    "SharpestPhase": (*_ALWAYS, *_MANY),
    "PgaSca:synchronised": (*_ALWAYS, "many scintillate"),
    **dict.fromkeys(("Sca", "PgaSca", "SharpestPhase:contrast"), _ALWAYS),
}
LIMITS: dict[str, list[tuple[str, str, float | None]]] = {
    "scatterers that change from pulse to pulse, or another scene from some pulse on: halves of the range cells hold "
    "the same changes and agree": [
        (f"compensate.{name}", *cell) for name, kinds in _CHANGING.items() for kind in kinds for cell in _CHANGES[kind]
    ],
    "a moving point 26 dB above what is at rest: its side lobes are in all range cells alike": [
        ("multichannel.ClutterSynchronisation", "moving point", 20.0)
    ],
}


def entries() -> list[Entry]:
    """All entries of the audit."""
    parts = (strips, pulses, paths, rotations, ladars, channels, repairs)
    return [entry for part in parts for entry in part.entries()]


def covered(names: list[Entry]) -> set[str]:
    """Public names that an entry, or the entry of the stage or function they share, tries."""
    tried = {entry.name.split(":")[0] for entry in names}
    alike = {name for name in estimators() if _idea(name) in set(map(_idea, tried))}
    return tried | alike | {name for name, other in SAME.items() if other in tried}


def _idea(name: str) -> str:
    return name.replace("_", "").lower()
