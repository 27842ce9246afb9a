"""Which estimators the benchmarks try, those that need no entry of their own, and known limits."""

from __future__ import annotations

import importlib
import inspect
import typing
from collections.abc import Iterator, Mapping
from typing import Any

from torch import nn

from torchsar.study.bench.frame import NOTHING, Entry
from torchsar.study.bench.records import PLACES, bench

PACKAGES = ("core", "repair", "compensate", "multichannel", "focus", "metrics", "optim", "io")
FALSE = 0.02  # bar of the lower end of the 95 % interval of the share that is sure and wrong
RATIO = (0.5, 2.0)  # bar of the rms error over the predicted one

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


# Methods that are no public functions or stages.
SIMPLE = {"textbook_pga", "adam_entropy", "uncorrected", "learned", "unrolled", "lag_network"}
# Cells of the records that miss a bar, as methods by benchmark and world, by the reason.
LIMITS: dict[str, dict[tuple[str, str], str]] = {
    "scatterers that change from pulse to pulse, or another scene from some pulse on: halves of the range cells hold "
    "the same changes and agree": {
        ("autofocus", "another scene of 8 points, 20 dB"): "autofocus, sca, pga_sca, pga_sca:synchronised, "
        "entropy_fixed_point, sharpest_phase, sharpest_phase:contrast, phase_polish",
        ("autofocus", "another scene of 40 points, 20 dB"): "autofocus, sca, pga_sca, pga_sca:synchronised, "
        "entropy_fixed_point, sharpest_phase, sharpest_phase:contrast, phase_polish",
        ("autofocus", "scintillating 8 points, 0 dB"): "autofocus, entropy_fixed_point, sharpest_phase, phase_polish",
        ("autofocus", "scintillating 8 points, 20 dB"): "autofocus, pga_sca, entropy_fixed_point, "
        "sharpest_phase, phase_polish",
        ("autofocus", "scintillating 40 points, 0 dB"): "autofocus, entropy_fixed_point, sharpest_phase, phase_polish",
        ("autofocus", "scintillating 40 points, 20 dB"): "autofocus, pga_sca, pga_sca:synchronised, "
        "entropy_fixed_point, sharpest_phase, phase_polish",
        ("autofocus", "walking 3 points, 5 dB"): "autofocus, sca, pga_sca, entropy_fixed_point, "
        "sharpest_phase, sharpest_phase:contrast, phase_polish",
        ("autofocus", "walking 3 points, 20 dB"): "autofocus, sca, pga_sca, pga_sca:synchronised, "
        "entropy_fixed_point, sharpest_phase, sharpest_phase:contrast, phase_polish",
    },
    "a vehicle that moves on its own and is 5 dB stronger than the scene: its phases are found, and not those of the "
    "scene": {
        ("autofocus", "vehicle 5 dB, 10 dB"): "autofocus, entropy_fixed_point, sharpest_phase, phase_polish",
    },
    "a vehicle that moves on its own in clutter of the same power: its range cells are few among many": {
        ("autofocus", "vehicle in clutter, 10 dB"): "link_phases",
    },
    "a gap of a fifth of the pulses: the phases of its two sides may differ by a constant, which the deviation lacks": {
        ("autofocus", "gap, 10 dB"): "sca, sharpest_phase, phase_polish",
    },
    "a strip, whose scatterers are lit in turn, given to a method that takes all of them as lit: StripAutofocus": {
        ("path", "strip, 3 mm, 0 dB"): "autofocus, entropy_fixed_point",
        ("path", "strip, 3 mm, 20 dB"): "autofocus",
    },
    "scatterers in evenly spaced range cells: displacements by their distance are nearly as likely, which `single` "
    "confuses, and which the deviation of the others counts": {
        ("alignment", "even rows, 10 dB"): "align_envelopes, AlignEnvelopes, align_envelopes:single",
        ("alignment", "even rows, 40 dB"): "align_envelopes, AlignEnvelopes",
    },
    "a moving point 26 dB above what is at rest: its side lobes are in all range cells alike": {
        ("channels", "moving point, 20 dB"): "ClutterSynchronisation"
    },
    "noise in which some range cells are brighter: the alternation of phases and rotation makes it sharper": {
        ("rotation", "bright cells"): "RotationAutofocus"
    },
    "a satellite 10 dB below the noise of a sample: the fits of few range cells agree by chance": {
        ("rotation", "own, -10 dB"): "CoarseRotation:fits"
    },
}


def limits() -> set[tuple[str, str, str]]:
    """Cells of all limits, as (benchmark, method, world). A chain has those of its estimator."""
    cells = (pair for known in LIMITS.values() for pair in known.items())
    found = {(name, method, world) for (name, world), methods in cells for method in methods.split(", ")}
    chains = {(name, f"{method}:remove_constant", world) for name, method, world in found if method == name}
    return found | chains


def missed(row: Mapping[str, Any], world: str) -> list[str]:
    """List the bars that a row misses."""
    found = []
    if (row["sure_wrong"][1] or 0.0) > FALSE:
        found.append(f"sure and wrong {row['sure_wrong'][0]:.2f}")
    ratio = row["calibration"]
    sure = row["trials"] * row["ok"][0]
    if ratio is not None and sure >= 20 and world not in NOTHING and not RATIO[0] <= ratio <= RATIO[1]:
        found.append(f"error over std {ratio:.2f}")
    return found


def entries() -> Iterator[tuple[str, Entry]]:
    """All entries with their benchmark."""
    for name in PLACES:
        for entry in bench(name).entries():
            yield name, entry


def estimators() -> Iterator[str]:
    """Public functions and stages whose result has a verdict, by introspection, as package.name."""
    for package in PACKAGES:
        module = importlib.import_module(f"torchsar.{package}")
        for name in sorted(module.__all__):
            thing = getattr(module, name)
            if inspect.isclass(thing):
                if not issubclass(thing, nn.Module):
                    continue
                thing = thing.forward
            if inspect.isfunction(thing) and _judges(typing.get_type_hints(thing).get("return")):
                yield f"{package}.{name}"


def _judges(hint: Any) -> bool:
    """Whether a return type has a verdict `ok`, such as `Estimate`, or holds one that has."""
    if inspect.isclass(hint) and "ok" in {*getattr(hint, "__annotations__", {}), *vars(hint)}:
        return True
    return any(_judges(part) for part in typing.get_args(hint))


def covered() -> set[str]:
    """Public names that an entry, or the entry of the stage or function they share, tries."""
    tried = {idea(entry.name.split(":")[0]) for _, entry in entries()}
    alike = {name for name in estimators() if idea(name) in tried}
    return alike | {name for name, other in SAME.items() if idea(other) in tried}


def idea(name: str) -> str:
    """Name without its package, underscores and capitals."""
    return name.rpartition(".")[2].replace("_", "").lower()
