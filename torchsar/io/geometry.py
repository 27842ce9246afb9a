"""Geometry of a recording for files that locate it on the Earth."""

from __future__ import annotations

import torch
from torch import Tensor

from torchsar.core import Recording, Signal
from torchsar.focus.path_image import PathImage
from torchsar.radar import AntennaPath, LocalFrame


def frame_of(recording: Recording, frame: LocalFrame | None) -> LocalFrame:
    """Return the frame of the local coordinates of a recording.

    Args:
        recording: Recording; its side data may hold `origin_deg_m`.
        frame: Frame to use instead; None for that of the recording.

    Returns:
        The frame.

    Raises:
        ValueError: If there is none.
    """
    if frame is not None:
        return frame
    if "origin_deg_m" not in recording.aux:
        raise ValueError(
            "the recording does not say where on the Earth it lies; give frame=LocalFrame(latitude_deg, "
            "longitude_deg, height_m) of the origin of its coordinates, after torchsar export --origin LATITUDE "
            "LONGITUDE HEIGHT"
        )
    return LocalFrame(*recording.aux["origin_deg_m"].tolist())


def single(value: Tensor, dims: int, what: str) -> Tensor:
    """Return a tensor without trial dimensions.

    Args:
        value: The tensor.
        dims: Number of its dimensions behind the trials.
        what: Its name, for messages.

    Returns:
        The tensor of the only trial, on the CPU, without gradient.

    Raises:
        ValueError: If there are several trials, or none.
    """
    lead = value.shape[: value.ndim - dims]
    if lead.numel() != 1:
        raise ValueError(
            f"a file holds one trial, and {what} has trials of shape {tuple(lead)}; select one of them, such as "
            "signal.data[0]"
        )
    return value.detach().cpu().resolve_conj().reshape(value.shape[value.ndim - dims :])


def antennas_of(recording: Recording) -> AntennaPath:
    """Return the path of the antennas of a recording with one trial.

    Args:
        recording: Recording with the side data of `AntennaPath.side_data`.

    Returns:
        The path, without trials and on the CPU.

    Raises:
        ValueError: If side data are missing, or there are several trials.
    """
    aux = recording.aux
    missing = [name for name in ("frequency_hz", "transmitter_m", "path_reference_m") if name not in aux]
    if missing:
        raise ValueError(
            f"the recording must hold a phase history with the positions of its antennas, but its side data lack "
            f"{missing}; got {sorted(aux)}"
        )
    receiver = single(aux["receiver_m"], 2, "receiver_m") if "receiver_m" in aux else None
    return AntennaPath(
        single(aux["transmitter_m"], 2, "transmitter_m"),
        receiver,
        single(aux["path_reference_m"], 1, "path_reference_m"),
    )


def pulse_time_s(recording: Recording) -> Tensor:
    """Return the times of the pulses.

    Args:
        recording: Recording.

    Returns:
        The side data `pulse_time_s`, or else the axis of the pulses, in seconds, float64 (pulse,).
    """
    if "pulse_time_s" in recording.aux:
        return single(recording.aux["pulse_time_s"], 1, "pulse_time_s")
    return recording.signal.axis("pulse").values()


def image_samples(signal: Signal, image: PathImage) -> Tensor:
    """Return the samples of an image with one trial, (azimuth, range).

    Args:
        signal: Image with the axes (azimuth, range) in metres.
        image: Stage that formed it.

    Returns:
        The samples on the CPU, without gradient.

    Raises:
        ValueError: If it has other axes than the stage forms, several trials, or samples that are
            not finite.
    """
    if signal.names != ("azimuth", "range") or any(axis.unit != "m" for axis in signal.axes):
        raise ValueError(
            "only images with the axes ('azimuth', 'range') in metres can be written, got "
            f"{[f'{axis.name} ({axis.unit})' for axis in signal.axes]}"
        )
    if signal.axes != image.axes:
        ours, theirs = (" x ".join(f"{axis.n} of {axis.step:g} m" for axis in of.axes) for of in (signal, image))
        raise ValueError(f"the image has {ours}, but its stage forms {theirs}; give the stage that formed the image")
    data = single(signal.data, 2, "the image")
    if not bool(torch.isfinite(data.abs()).all()):
        raise ValueError("the image has samples that are NaN or Inf and cannot be written")
    return data
