"""Check of the channels of a bistatic receiver."""

from __future__ import annotations

from torch import Tensor

from torchsar.core import checked_samples
from torchsar.radar import BistaticRadar


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
    data = checked_samples(data, what, dims, finite=finite)
    names = dims.split(", ")
    channels = data.shape[names.index("channel") - len(names)]
    if channels != radar.channels:
        raise ValueError(
            f"{what} works on samples (..., {dims}) with one channel for each of the {radar.channels} positions in "
            f"the radar's channel_m, got the shape {tuple(data.shape)}"
        )
    return data
