"""From images and truth to metrics.json."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from torchsar.core import Estimate, Signal, Truth
from torchsar.focus import ClosestRange
from torchsar.metrics import contrast, correlation, entropy, error_db, impulse_response
from torchsar.radar import StripmapRadar
from torchsar.study.build import Case
from torchsar.study.config import Config
from torchsar.study.methods import Result
from torchsar.study.stripmap.sections import Margin

log = logging.getLogger("torchsar")

DEFINITIONS: dict[str, Any] = {
    "snr": "mean signal power per lit raw sample over noise variance, dB",
    "entropy": "-sum p ln p, p = |I|^2 / sum |I|^2 over the window, nats",
    "contrast": "standard deviation over mean of the intensity |I|^2 over the window",
    "irw": "-3 dB width of the impulse response, m",
    "pslr": "strongest side lobe over the main lobe, dB",
    "islr": "energy of the side lobes over that of the main lobe (null to null), dB",
    "position_error": "measured minus true place of the peak, m",
    "peak_db": "interpolated peak relative to the same target in the reference method, dB",
    "image_error_db": "10 lg of |I - I0|^2 / |I0|^2 over the window, I0 from the reference method, dB",
    "image_correlation": "|<I, I0>| / (|I| |I0|) of the complex images over the window",
    "doppler_centroid_hz": "absolute Doppler of the beam centre, positive when closing",
    "doppler_baseband_hz": "the centroid modulo the pulse repetition frequency, within half of it of zero",
    "squint_deg": "asin(wavelength * doppler / (2 * velocity)), positive when the beam looks ahead",
    "published": (
        "figures of the source and its corrected brief, or the theory of a rectangular band; "
        "text and numbers of the config's metrics.published"
    ),
    "seconds": "wall time of the whole chain of the method",
}


def window(image: Signal, radar: StripmapRadar, margin: Margin | None) -> dict[str, tuple[int, int]]:
    """Lines and samples that are judged: those with a full pulse and a full aperture, or what the
    margin leaves.

    Where a rule leaves less than 32 lines or samples, that axis is judged whole.
    """
    lines, samples = (axis.n for axis in image.axes)
    if margin is None:
        edge = min(radar.aperture_lines(image.axes[1].start) // 2, lines // 4)
        margin = Margin(first_lines=edge, last_lines=edge, last_samples=radar.pulse_samples)
    return {
        "azimuth": _bounds(lines, margin.first_lines, margin.last_lines),
        "range": _bounds(samples, margin.first_samples, margin.last_samples),
    }


def _bounds(n: int, first: int, last: int) -> tuple[int, int]:
    if n - last - first >= 32:
        return first, n - last
    log.warning(
        "a margin of %d and %d leaves nothing of %d lines or samples: that axis is judged whole", first, last, n
    )
    return 0, n


def metrics_tree(config: Config, case: Case, results: Mapping[str, Result]) -> dict[str, Any]:
    """The content of metrics.json."""
    radar, reference = case.recording.radar, results.get(config.metrics.reference or "")
    part = window(results["recommended"].image, radar, config.metrics.margin)
    peaks = _reference_peaks(config, case, reference, radar)
    methods = {}
    for name, result in results.items():
        targets = _targets(config, case, result, radar, peaks)
        methods[name] = {
            "title": result.title,
            "metrics": {
                **_image_metrics(result, reference, part),
                **_geometry(result, radar),
                **_over_targets(targets),
                "seconds": sum(result.seconds.values()),
            },
            "seconds_by_stage": dict(result.seconds),
            "estimates": estimate_table(result.estimates),
            "targets": targets,
        }
    definitions = {
        **DEFINITIONS,
        "islr_extent_nulls": config.metrics.sidelobe_nulls,
        "window": part,
        "reference": config.metrics.reference,
    }
    return {
        "methods": methods,
        "published": config.metrics.published,
        "truth": truth_table(case.truth),
        "definitions": definitions,
    }


def _image_metrics(result: Result, reference: Result | None, part: Mapping[str, tuple[int, int]]) -> dict[str, float]:
    image = result.image.crop(**part)
    out = {"entropy_nats": float(entropy(image)), "contrast": float(contrast(image))}
    if reference is not None and reference is not result:
        other = reference.image.crop(**part).to(torch.complex128)
        image = image.to(torch.complex128)  # sums over millions of pixels
        out["image_error_db"], out["image_correlation"] = (
            float(error_db(image, other)),
            float(correlation(image, other)),
        )
    return out


def _geometry(result: Result, radar: StripmapRadar) -> dict[str, float]:
    """Doppler centroid, squint and velocity that the image was focused with."""
    out: dict[str, float] = {}
    velocity = result.used.get("velocity_m_s", radar.velocity_m_s)
    if "doppler_hz" in result.used:
        doppler = result.used["doppler_hz"]
        out["doppler_centroid_hz"] = doppler
        out["doppler_baseband_hz"] = doppler - radar.prf_hz * round(doppler / radar.prf_hz)
        out["squint_deg"] = math.degrees(math.asin(max(-1.0, min(1.0, float(radar.sin_squint(doppler, velocity))))))
    out["effective_velocity_m_s"] = velocity
    return out


def expected_places(case: Case, result: Result, radar: StripmapRadar) -> tuple[list[str], Tensor, Tensor]:
    """Names and image coordinates of the point targets that lie inside the image, from the truth
    and the frame of the method.
    """
    if case.truth is None or not case.targets:
        return [], torch.empty(0), torch.empty(0)
    values = case.truth.values
    index = torch.tensor(list(case.targets.values()))
    azimuth, slant = radar.image_position(
        values["zero_doppler_s"][index],
        values["closest_range_m"][index],
        result.used["frame_hz"],
        values["velocity_m_s"],
    )
    if any(isinstance(stage, ClosestRange) for stage in result.chain.stages.values()):
        slant = values["closest_range_m"][index]
    inside = [
        a.start <= float(x) <= a.stop and r.start <= float(y) <= r.stop
        for (a, r), x, y in zip([result.image.axes] * len(index), azimuth, slant)
    ]
    keep = torch.tensor(inside)
    return [name for name, k in zip(case.targets, inside) if k], azimuth[keep], slant[keep]


def _measured(
    config: Config, case: Case, result: Result, radar: StripmapRadar
) -> tuple[list[str], Tensor, Tensor, dict[str, Tensor]]:
    names, azimuth, slant = expected_places(case, result, radar)
    if not names:
        return names, azimuth, slant, {}
    return (
        names,
        azimuth,
        slant,
        impulse_response(result.image, (azimuth, slant), sidelobe_nulls=config.metrics.sidelobe_nulls),
    )


def _reference_peaks(config: Config, case: Case, reference: Result | None, radar: StripmapRadar) -> dict[str, float]:
    if reference is None:
        return {}
    names, _, _, figures = _measured(config, case, reference, radar)
    return dict(zip(names, figures["peak"].abs().tolist())) if names else {}


def _targets(
    config: Config, case: Case, result: Result, radar: StripmapRadar, peaks: Mapping[str, float]
) -> dict[str, dict[str, float]]:
    """Figures of every point target by name."""
    names, azimuth, slant, figures = _measured(config, case, result, radar)
    table: dict[str, dict[str, float]] = {}
    for i, name in enumerate(names):
        row = {key: float(value[i]) for key, value in figures.items() if key.startswith(("irw", "pslr", "islr"))}
        row["position_error_azimuth_m"] = float(figures["position_azimuth_m"][i] - azimuth[i])
        row["position_error_range_m"] = float(figures["position_range_m"][i] - slant[i])
        level = float(figures["peak"][i].abs())
        row["peak_db"] = (
            20 * math.log10(max(level, 1e-300) / peaks[name])
            if peaks.get(name)
            else 20 * math.log10(max(level, 1e-300))
        )
        near = (
            math.hypot(row["position_error_azimuth_m"], row["position_error_range_m"]) <= config.metrics.found_within_m
        )
        row["found"] = float(near and (not peaks or row["peak_db"] >= config.metrics.found_above_db))
        table[name] = row
    return table


def _over_targets(targets: Mapping[str, Mapping[str, float]]) -> dict[str, float]:
    """Medians over the targets that were found, and how many those are."""
    if not targets:
        return {}
    found = [row for row in targets.values() if row["found"]]
    out = {"targets": float(len(targets)), "targets_found": float(len(found))}
    for key in ("irw_azimuth_m", "irw_range_m", "pslr_azimuth_db", "pslr_range_db", "islr_azimuth_db", "islr_range_db"):
        if found:
            out[key] = float(torch.tensor([row[key] for row in found], dtype=torch.float64).median())
    for axis in ("azimuth", "range"):
        if found:
            out[f"position_error_{axis}_rms_m"] = math.sqrt(
                sum(row[f"position_error_{axis}_m"] ** 2 for row in found) / len(found)
            )
    return out


def estimate_table(estimates: Mapping[str, Estimate]) -> dict[str, dict[str, Any]]:
    """Values of up to 16 numbers by name, `stage.value`; longer ones are in arrays.zarr."""
    table: dict[str, dict[str, Any]] = {}
    for stage, estimate in estimates.items():
        for key, value in estimate.value.items():
            if value.numel() <= 16:
                std = estimate.std.get(key)
                table[f"{stage}.{key}"] = {
                    "value": value.tolist(),
                    "std": None if std is None else std.tolist(),
                    "ok": estimate.ok.tolist(),
                }
    return table


def truth_table(truth: Truth | None) -> dict[str, Any]:
    """What is true, where it is up to 16 numbers; longer tensors are in arrays.zarr."""
    return (
        {}
        if truth is None
        else {
            name: value.tolist()
            for name, value in truth.values.items()
            if torch.as_tensor(value).numel() <= 16 and not torch.as_tensor(value).is_complex()
        }
    )
