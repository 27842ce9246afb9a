"""Figures of one batch of rows: velocities against the truth, responses and false targets of
images, and how well the reconstruction is conditioned.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchsar.core import Chain, Estimate, Signal, Trace, take
from torchsar.metrics.replicas import azimuth_response, replica_level, replica_zones
from torchsar.multichannel.azimuth import FocusAzimuth
from torchsar.multichannel.motion import PointMotion
from torchsar.multichannel.reconstruct import Reconstruct
from torchsar.multichannel.response import condition_number, noise_gain_db
from torchsar.radar import BistaticRadar
from torchsar.study.tracing import verdict

DEFINITIONS: dict[str, Any] = {
    "snr": "power of the target over noise variance in one range-compressed sample of one channel, dB "
    "(snr_db). Raw, before compression, it is 10 log10(B tau_p) less (raw_scnr_db): 27 dB "
    "at 50 MHz and 10 us. Sample of azimuth-only data: of the compressed peak line. scr_db: power "
    "of the target over that of the sea in such a sample",
    "targets": "every target is recorded and processed alone, with noise of its own",
    "velocities": (
        "u_r: closing slant-range speed towards the receiver's closest point; u_a: along "
        "track, positive with the receiver; y0: place along track at t = 0, middle pulse"
    ),
    "responses": "irw, pslr, islr, mfta and noise-free places are measured on the image of the CLEAN echo (same "
    "impairment, no noise, no sea), rebuilt and focused with every value held that "
    "the method estimated from the NOISY one: image noise would hide false targets below about -60 dB",
    "irw_azimuth_m": (
        "3 dB width on the axis x = (V_R - u_a) t of the true target; theory 0.886 v / B, B "
        "the processed Doppler band within the target's"
    ),
    "pslr_azimuth_db": "largest side lobe over the peak; theory, a sinc: -13.26 dB",
    "islr_azimuth_db": "energy of 20 side lobes to either side over that of the main lobe; theory, a sinc: -9.92 dB",
    "mfta_db": (
        "largest replica in the zones of +-1..metrics.orders pulse rates from the peak over "
        "the peak, as far as the image reaches"
    ),
    "u_r_error_m_s": "estimated minus true u_r; u_a_error_m_s, y0_error_m alike. Only of methods that estimate it",
    "predicted": "u_r_std_m_s, u_a_std_m_s, y0_std_m: deviations that the method itself predicts",
    "position_error_m": (
        "place along track at t = 0 from the measured peak after location correction by the "
        "method's own velocities, minus the truth"
    ),
    "range": (
        "irw_range_m, pslr_range_db, islr_range_db on the axis c tau / 2, on which the width "
        "of a sinc is 0.886 c / (2 B); range_error_m: of the receive path at t = 0"
    ),
    "condition_number": "of the band matrix at the velocities used; not given for mmse, which inverts no such matrix",
    "noise_gain_db": "noise of a rebuilt bin against ideal uniform sampling by as many channels, mean over bins",
    "ok": "whether the method itself trusts its estimates",
    "seconds": "wall time of the chain of the method per target and trial",
    "theory": "a target that is rebuilt and focused without error",
    "bounds": (
        "Cramer-Rao for known noise or clutter, complex amplitude and y0 unknown; u_a unknown too, or known, as named"
    ),
    "published": "figures of Remote Sens. 2020, 12, 1703; its SCNR is read as raw",
}
IMAGES = (("azimuth",), ("azimuth", "range"))
NAMES = {"u_r_m_s": "u_r", "u_a_m_s": "u_a", "y0_m": "y0"}
_PSLR_DB, _ISLR_DB, _WIDTH = -13.26, -9.92, 0.8859


def error_name(key: str, what: str = "error") -> str:
    """Metric of an unknown: u_r_m_s -> u_r_error_m_s."""
    return f"{NAMES[key]}_{what}{key.removeprefix(NAMES[key])}"


@dataclass(frozen=True)
class Found:
    """What a method estimated, by name (row,), and the deviations that it predicts; values that it
    was told are not in it.
    """

    value: Mapping[str, Tensor]
    std: Mapping[str, Tensor]

    @staticmethod
    def by(estimates: Mapping[str, Estimate]) -> Found:
        """Of all estimators of a chain, later ones before earlier ones."""
        pairs = {
            key: (estimate.value[key], estimate.std[key])
            for estimate in estimates.values()
            for key in NAMES
            if key in estimate.std
        }
        return Found({key: value for key, (value, _) in pairs.items()}, {key: std for key, (_, std) in pairs.items()})

    def metrics(self, truth: Mapping[str, Tensor]) -> dict[str, Tensor]:
        errors = {error_name(key): value - truth[key] for key, value in self.value.items()}
        return {**errors, **{error_name(key, "std"): std for key, std in self.std.items()}}


@dataclass(frozen=True)
class Focused:
    """How the image of a chain was made: its reconstruction, stage `stage` of the chain, its
    focusing, and the motion (row,) that each was given.
    """

    stage: str
    rebuild: Reconstruct
    focus: FocusAzimuth
    rebuilt_for: PointMotion
    focused_for: PointMotion

    @staticmethod
    def of(chain: Chain, trace: Trace, radar: BistaticRadar) -> Focused | None:
        """None where a chain has no reconstruction and focusing."""
        rebuild, focus = (
            [name for name, stage in chain.stages.items() if isinstance(stage, kind)]
            for kind in (Reconstruct, FocusAzimuth)
        )
        if not rebuild or not focus:
            return None
        stages: Any = chain.stages
        return Focused(
            rebuild[-1],
            stages[rebuild[-1]],
            stages[focus[-1]],
            _given(chain, rebuild[-1], trace, radar),
            _given(chain, focus[-1], trace, radar),
        )

    @property
    def bands(self) -> int:
        return self.rebuild.rebuild.bands

    @property
    def processed_hz(self) -> float:
        """Doppler band that is focused."""
        rebuilt = self.bands * self.rebuild.radar.prf_hz
        return min(rebuilt, self.focus.bandwidth_hz or rebuilt)

    def metrics(self) -> dict[str, Tensor]:
        """Condition and noise gain, (row,) each."""
        radar, motion = self.rebuild.radar, self.rebuilt_for
        found = {"noise_gain_db": noise_gain_db(radar, motion, self.rebuild.rebuild)}
        return (
            {"condition_number": condition_number(radar, motion, self.bands), **found}
            if self.bands <= radar.channels
            else found
        )


def _given(chain: Chain, stage: str, trace: Trace, radar: BistaticRadar) -> PointMotion:
    """The motion that a stage of a chain worked with."""
    values = {parameter: trace.values[source] for parameter, source in chain.uses[stage].items() if parameter in NAMES}
    data = trace.inputs[stage].data
    motion = PointMotion.of(radar, data, **values, range_m=getattr(chain.stages[stage], "range_m", None))
    rows = trace.inputs[stage].trials
    u_r, u_a, y0, range_m = (
        value.expand(rows) for value in (motion.u_r_m_s, motion.u_a_m_s, motion.y0_m, motion.range_m)
    )
    return PointMotion(u_r, u_a, y0, range_m, motion.speed_m_s)


@dataclass(frozen=True)
class Profiles:
    """Cuts through the peak of images, one a row: along azimuth (row, azimuth), over x = (V_R -
    u_a) t of the truth, and along range (row, range) where there is one.
    """

    azimuth: Tensor
    step_m: Tensor
    start_m: Tensor
    range: Tensor | None
    range_axis: tuple[float, float]

    @staticmethod
    def of(image: Signal, along_m_s: Tensor, speed_m_s: float) -> Profiles:
        """along_m_s: v of the true targets (row,)."""
        axis, scale = image.axes[0], along_m_s / speed_m_s
        if "range" not in image.names:
            return Profiles(image.data, axis.step * scale, axis.start * scale, None, (0.0, 0.0))
        power = image.data.abs()
        row, line = power.amax(-1).argmax(-1), power.amax(-2).argmax(-1)
        across = image.axes[1]
        return Profiles(
            take(image.data, line),
            axis.step * scale,
            axis.start * scale,
            take(image.data, row, -2),
            (across.start, across.step),
        )


def response_metrics(
    image: Signal, focused: Focused, truth: Mapping[str, Tensor], integration_s: float | None, orders: int
) -> dict[str, Tensor]:
    """Responses, false targets and places in a clean image, (row,) each; NaN for images without any
    energy.
    """
    seen = image.data.abs().flatten(len(image.trials)).amax(-1) > 0
    return {
        name: torch.where(seen, value, math.nan)
        for name, value in _responses(image, focused, truth, integration_s, orders).items()
    }


def _responses(
    image: Signal, focused: Focused, truth: Mapping[str, Tensor], integration_s: float | None, orders: int
) -> dict[str, Tensor]:
    radar = focused.rebuild.radar
    along = radar.speed_m_s - truth["u_a_m_s"]
    cuts = Profiles.of(image, along, radar.speed_m_s)
    response = azimuth_response(cuts.azimuth, 1.0)
    metrics = {
        "irw_azimuth_m": response["irw_m"] * cuts.step_m,
        "pslr_azimuth_db": response["pslr_db"],
        "islr_azimuth_db": response["islr_db"],
    }
    metrics["mfta_db"] = _false_targets(cuts, focused, truth, integration_s, orders)
    place_s = (cuts.start_m + response["position_m"] * cuts.step_m) / along
    if cuts.range is None:
        return {**metrics, "position_error_m": focused.focused_for.place_m(place_s) - truth["y0_m"]}
    across = azimuth_response(cuts.range, cuts.range_axis[1], cuts.range_axis[0])
    metrics.update(
        {"irw_range_m": across["irw_m"] / 2, "pslr_range_db": across["pslr_db"], "islr_range_db": across["islr_db"]}
    )
    motion = replace(focused.focused_for, range_m=across["position_m"])
    closest = torch.sqrt(across["position_m"].square() - motion.place_m(place_s).square())
    place = replace(motion, range_m=closest).place_m(place_s)
    return {**metrics, "position_error_m": place - truth["y0_m"], "range_error_m": closest - truth["range_m"]}


def _false_targets(
    cuts: Profiles, focused: Focused, truth: Mapping[str, Tensor], integration_s: float | None, orders: int
) -> Tensor:
    """Level (row,) of the largest replica, NaN for images too short to hold any."""
    radar, used = focused.rebuild.radar, focused.focused_for
    given = {"integration_s": integration_s, "focused_at": (used.u_r_m_s, used.u_a_m_s), "orders": range(1, orders + 1)}
    zones = replica_zones(
        radar,
        focused.bands,
        truth["u_r_m_s"],
        truth["u_a_m_s"],
        truth["y0_m"],
        truth["range_m"],
        axis_speed_m_s=radar.speed_m_s - truth["u_a_m_s"],
        **given,
    )
    samples = zones / cuts.step_m[:, None, None]
    peak = cuts.azimuth.abs().argmax(-1)[:, None, None]
    if not bool(((samples[..., 1:] + peak >= 0) & (samples[..., :1] + peak < cuts.azimuth.shape[-1])).any()):
        return torch.full_like(cuts.step_m, math.nan)
    return replica_level(cuts.azimuth, 1.0, samples)["mfta_db"]


def told_metrics(trace: Trace) -> dict[str, Tensor]:
    """The method's own verdict."""
    return verdict(trace.estimates, trace.signal.trials)


def theory(
    radar: BistaticRadar,
    truth: Mapping[str, float],
    integration_s: float | None,
    bandwidth_hz: float,
    samples: int | None,
) -> dict[str, float]:
    """Figures of a target without any error: widths of sincs, and zero errors.

    bandwidth_hz: the processed band.
    """
    along = radar.speed_m_s - truth["u_a_m_s"]
    own = (
        math.inf
        if integration_s is None
        else (along**2 + truth["u_r_m_s"] ** 2) * integration_s / (radar.wavelength_m * radar.reference_range_m)
    )
    found = {
        "irw_azimuth_m": _WIDTH * along / min(own, bandwidth_hz),
        "pslr_azimuth_db": _PSLR_DB,
        "islr_azimuth_db": _ISLR_DB,
    }
    found.update(dict.fromkeys(("u_r_error_m_s", "u_a_error_m_s", "position_error_m"), 0.0))
    if samples is not None:
        found.update(
            {
                "irw_range_m": _WIDTH * radar.wave_speed_m_s / (2 * radar.pulse.bandwidth_hz),
                "pslr_range_db": _PSLR_DB,
                "islr_range_db": _ISLR_DB,
                "range_error_m": 0.0,
            }
        )
    return found
