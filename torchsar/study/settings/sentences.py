"""Error messages of one sentence from the validation errors of pydantic."""

from __future__ import annotations

import inspect
import types
import typing
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError

from torchsar.study.settings.errors import did_you_mean

# keys, values, stages and kinds that were renamed; the message about an old one gives the new one
RENAMED = {
    "damages": "impairments",
    "told": "trigger_known",
    "published_ideal": "published.entropy_above_ideal_nats",
    "damaged": "impaired",
    **{
        key: f"objective.{key}" for key in ("order", "range_term", "yc_m", "variables", "oversampling", "lines", "taps")
    },
    "rotation_phase_fit": "coarse_rotation, fits: 4",
    "rotation_search": "entropy_rotation, method: grid",
    **{
        f"rotation_{name}": f"entropy_rotation, method: {name}"
        for name in ("genetic", "evolution", "newton", "descent")
    },
    **{
        f"{what}_{verb}": f"{verb}_{what}"
        for verb, whats in {
            "correct": ("imbalance", "response", "path", "pulse_phase", "migration"),
            "remove": ("synchronisation", "transmit_range"),
        }.items()
        for what in whats
    },
    **{f"interference_{verb}": f"{verb}_interference" for verb in ("subtract", "notch", "drop")},
    **{what: f"estimate_{what}" for what in ("imbalance", "response", "synchronisation")},
    "response_flat_band": "estimate_flat_response",
    "jitter_pilot": "pilot_jitter",
    "jitter_blind": "blind_jitter",
    "jitter_exact": "correct_jitter",
    "jitter_lagrange": "correct_jitter, method: {kind: lagrange, points: 4}",
    "jitter_band_limited": "correct_jitter, method: {kind: band_limited}",
    "channel_balance": "estimate_balance",
    "channel_balance_correct": "correct_balance",
    "rotation": "uneven_rotation",
    "rotation_coarse": "coarse_rotation",
    "rotation_entropy": "entropy_rotation",
    "rebuild_bands": "reconstruct",
    "intensity_ratio": "signal_intensity_ratio",
    "omega_k_padded": "padded_lines",
    "focus_target": "focus_azimuth",
    "dwell_s": "aperture.duration_s",
    "bands": "rebuild.bands",
    "u_r_reach_m_s": "search.u_r_m_s",
    "u_a_reach_m_s": "search.u_a_m_s",
    "y0_reach_m": "search.y0_m",
    "straight": "straight_path",
    "circular": "circular_path",
    "plane": "plane_ground",
    "normal": "start_phase",
    "uniform": "uniform_start_phase",
    "scintillation": "log_amplitude",
    "polynomial": "polynomial_sweep_error",
    "sinusoid": "sinusoid_sweep_error",
    "fibre": "calibration_fibre",
    "image": "image_sea",
    "exact": "exact_range",
    "taylor": "taylor_range",
    "clock_errors": "synchronisation_error",
    "channel_response": "smooth_response",
}


class Strict(BaseModel):
    """Base of all sections; it rejects unknown keys, wrong types and infinities."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, frozen=True)


# order in which errors are reported: an unknown key, a missing key, a wrong value. If a number or a
# list is accepted, the error of the number is more informative than that of the list.
_RANK = {"extra_forbidden": 0, "missing": 1, "list_type": 3}


def sentence(error: ValidationError, model: type[BaseModel], file: str, where: str = "") -> str:
    """Return one sentence about the most informative of the errors of a validation.

    Args:
        error: Error of pydantic.
        model: The model that was validated.
        file: Name of the config.
        where: Dotted path of the section that the model describes.

    Returns:
        The sentence, with file, key and value.
    """
    worst = min(error.errors(), key=lambda e: _RANK.get(e["type"], 2))
    path = [str(part) for part in worst["loc"]]
    names, section = _descend(model, path)
    key, kind, given = ".".join(([where] if where else []) + names), worst["type"], worst.get("input")
    if kind == "extra_forbidden":
        new = RENAMED.get(path[-1], "")
        if section is not None and new.split(".")[0] in section.model_fields:
            return f"{file}: key {key!r} is now called {new!r}; rename it"
        return f"{file}: key {key!r} is not known{did_you_mean(path[-1], section.model_fields if section else ())}"
    if kind == "missing":
        return f"{file}: key {key!r} is missing"
    text = worst["msg"].removeprefix("Value error, ").removeprefix("Input ")
    if kind in ("dict_type", "model_type", "too_short"):
        text = "should be a mapping of keys" + (", and not an empty one" if kind == "too_short" else "")
    if isinstance(given, str) and given in RENAMED:
        text = f"should be {RENAMED[given]!r}, as it is now called"
    if not key:  # an error of the whole config, not of one key
        return f"{file}: {text}"
    shown = repr(given)
    if not text.startswith("should"):
        return f"{file}: key {key!r}: {text}"
    return f"{file}: key {key!r} has the value {shown if len(shown) < 80 else shown[:77] + '...'}; it {text}"


def _descend(model: type[BaseModel], path: list[str]) -> tuple[list[str], type[BaseModel] | None]:
    """The keys in a pydantic location, without tags of unions, and the section of the last key."""
    names: list[str] = []
    section, hint = None, model
    for part in path:
        members = members_of(hint)
        hint = members[0] if len(members) == 1 else hint
        if inspect.isclass(hint) and issubclass(hint, BaseModel):
            names.append(part)
            section, hint = hint, hint.model_fields[part].annotation if part in hint.model_fields else None
        elif typing.get_origin(hint) in (dict, list):
            names.append(part)
            hint = typing.get_args(hint)[-1]
    return names, section


def members_of(hint: Any) -> list[Any]:
    """Return the members of a union without None, or the type itself if it is no union."""
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        return [member for member in typing.get_args(hint) if member is not type(None)]
    return [hint]
