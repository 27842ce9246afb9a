"""Common parts of all stages on channels: their axes, and the checks of channels and of
slow time.
"""

from __future__ import annotations

from torch import Tensor

from torchsar.core import Axis, Stage, checked_samples
from torchsar.radar import BistaticRadar


class ChannelStage(Stage):
    """Base class of stages on channels (channel, pulse[, range]) of a radar.

    Args:
        radar: Radar parameters.
    """

    works_on = ("channel", "pulse")
    also_on = (("channel", "pulse", "range"),)

    def __init__(self, radar: BistaticRadar) -> None:
        super().__init__()
        self.radar = radar


def checked_channels(
    data: Tensor, radar: BistaticRadar, what: str, dims: str = "channel, pulse", *, finite: bool = True
) -> Tensor:
    """Check the samples of several channels, and resolve lazy conjugation and negation.

    Args:
        data: Samples, shape (..., *dims), complex64 or complex128.
        radar: Radar parameters.
        what: Name of the function for the message.
        dims: Names of the trailing dimensions, of which one is "channel".
        finite: Whether NaN and Inf are refused.

    Returns:
        The samples.

    Raises:
        TypeError: If the data are not a tensor of these dtypes.
        ValueError: If the data have no samples or too few dimensions, do not have one channel for
            each position of the radar, or a sample is not finite.
    """
    data, names = checked_samples(data, what, dims, finite=finite), dims.split(", ")
    if data.shape[names.index("channel") - len(names)] != radar.channels:
        raise ValueError(
            f"{what} works on samples (..., {dims}) with one channel for each of the {radar.channels} positions in "
            f"the radar's channel_m, got the shape {tuple(data.shape)}; select the same channels in radar and data"
        )
    return data


def refuse_other_count(what: str, count: int, noun: str, **values: Tensor | None) -> None:
    """Raise ValueError unless values hold one number per channel, or per pulse.

    Args:
        what: Name of the function for the message.
        count: Number of channels or pulses.
        noun: "channel" or "pulse".
        **values: Values by name, shape (..., count), or None.
    """
    for name, value in values.items():
        if value is not None and value.shape[-1:] != (count,):
            raise ValueError(
                f"{what} needs {name} of shape (..., {count}), one value per {noun}, got shape {tuple(value.shape)}"
            )


def refuse_shifted(radar: BistaticRadar, pulse: Axis) -> None:
    """Raise ValueError unless slow time is zero at pulse n // 2 and pulses come at the radar's PRF.

    Reconstruction and focusing count phases from slow time zero.

    Args:
        radar: Radar parameters.
        pulse: Slow-time axis of the data.
    """
    expected = radar.pulse_axis(pulse.n)
    start, step = abs(pulse.start - expected.start), abs(pulse.step - expected.step)
    if start > 1e-6 * expected.step or step > 1e-9 * expected.step:
        raise ValueError(
            f"slow time must be zero at pulse {pulse.n // 2} of {pulse.n}, in steps of 1 / "
            f"{radar.prf_hz:g} s, got a first pulse at {pulse.start:g} s in steps of "
            f"{pulse.step:g} s; "
            "if pulses were cropped, crop as many from the other end; otherwise check prf_hz of the radar"
        )
