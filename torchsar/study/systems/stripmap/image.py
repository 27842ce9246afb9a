"""Part of the image of a strip that metrics use, and parameters with which the image was
focused.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from torchsar.core import Chain, Signal, Trace, wrapped
from torchsar.radar import StripmapRadar
from torchsar.study.trials.batch import last_stage

log = logging.getLogger("torchsar")
# least number of lines or samples of a window; metrics of a smaller one would depend on a few
# targets
_LEAST = 32


@dataclass(frozen=True)
class Margin:
    """Edges of the image that the metrics leave out.

    Args:
        first_lines: Number of lines left out at the start of the record.
        last_lines: Number of lines left out at the end of the record.
        first_samples: Number of range samples left out at the near edge.
        last_samples: Number of range samples left out at the far edge.
    """

    first_lines: int = 0
    last_lines: int = 0
    first_samples: int = 0
    last_samples: int = 0


def window(image: Signal, radar: StripmapRadar, margin: Margin | None) -> dict[str, slice]:
    """Return the part of an image that the metrics use, for `Signal.isel`.

    It has the lines with a full aperture and the samples with a full pulse, or what a given margin
    leaves. An axis of which fewer than 32 lines or samples would be left is used as a whole.

    Args:
        image: Image with the axes (azimuth, range).
        radar: Radar parameters.
        margin: Edges that are left out; None for those of the aperture and the pulse.

    Returns:
        Slice of indices by the name of the axis.
    """
    lines, samples = (axis.n for axis in image.axes)
    if margin is None:
        # an image can have several lines per pulse
        edge = min(
            round(radar.aperture_lines(image.axes[1].start) * radar.velocity_m_s / radar.prf_hz / image.axes[0].step)
            // 2,
            lines // 4,
        )
        margin = Margin(first_lines=edge, last_lines=edge, last_samples=radar.pulse_samples)
    spans = {"azimuth": (lines, margin.first_lines, margin.last_lines)}
    spans["range"] = (samples, margin.first_samples, margin.last_samples)
    kept = {axis: slice(first, n - last) for axis, (n, first, last) in spans.items()}
    for axis, part in kept.items():
        left = part.stop - part.start
        if left < _LEAST:
            log.debug("a margin leaves %d of the image along %s: the whole axis is used", left, axis)
            kept[axis] = slice(0, spans[axis][0])
    return kept


@dataclass(frozen=True)
class Used:
    """Parameters that the focusing stage of a chain used, of shape (trial,) each.

    Args:
        doppler_hz: Doppler centroid in Hz; None if the stage used none.
        velocity_m_s: Velocity in m/s.
        frame_hz: Doppler frequency in Hz to which the image coordinates refer.
    """

    doppler_hz: Tensor | None
    velocity_m_s: Tensor
    frame_hz: Tensor

    @staticmethod
    def by(chain: Chain, trace: Trace, radar: StripmapRadar, count: int) -> Used:
        """Return the parameters that a chain used.

        Args:
            chain: Chain that forms an image.
            trace: Signals and values of a run of the chain.
            radar: Radar parameters.
            count: Number of trials.
        """
        name = focus_name(chain)
        stage, connected = focuser_of(chain.stages[name]), trace.arguments[name]

        def value(key: str, default: Any) -> Any:
            found = connected.get(key, getattr(stage, key, default))
            return None if found is None else torch.as_tensor(found, dtype=torch.float64).detach().expand(count)

        doppler = value("doppler_hz", None)
        frame = getattr(stage, "frame_hz", None)
        frame = radar.pointing_doppler_hz if frame is None else frame
        frame = torch.zeros(count, dtype=torch.float64) if frame is None and doppler is None else frame
        frame = doppler if frame is None else torch.as_tensor(frame, dtype=torch.float64).expand(count)
        assert frame is not None
        return Used(doppler, value("velocity_m_s", radar.velocity_m_s), frame)

    def metrics(self, radar: StripmapRadar) -> dict[str, Tensor]:
        """Return Doppler centroid, squint and velocity with which the image was focused.

        Args:
            radar: Radar parameters.
        """
        found = {"effective_velocity_m_s": self.velocity_m_s}
        if self.doppler_hz is not None:
            sine = radar.sin_squint(self.doppler_hz, self.velocity_m_s).clamp(-1, 1)
            found["doppler_centroid_hz"] = self.doppler_hz
            found["doppler_baseband_hz"] = wrapped(self.doppler_hz, radar.prf_hz)
            found["squint_deg"] = torch.rad2deg(torch.asin(sine))
        return found


def focus_name(chain: Chain) -> str:
    """Return the name of the stage that forms the image.

    It is the last stage with the attribute `frame_hz`, the Doppler frequency of the image
    coordinates, or else the last stage.

    Args:
        chain: Chain of stages.

    Returns:
        Name of the stage.
    """
    focusing = [name for name, stage in chain.stages.items() if hasattr(focuser_of(stage), "frame_hz")]
    return focusing[-1] if focusing else last_stage(chain)[0]


def focuser_of(stage: nn.Module) -> nn.Module:
    """Return the focusing stage that a stage wraps, or else the stage itself.

    Args:
        stage: Stage of a chain.

    Returns:
        The focusing stage.
    """
    return getattr(stage, "focuser", stage)
