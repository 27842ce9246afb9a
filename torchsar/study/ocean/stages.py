"""The stages that picture whole scenes, from plain keys."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import torch
from torch import Tensor

from torchsar.core import Estimate, Signal, Stage
from torchsar.multichannel.body import Extraction
from torchsar.multichannel.motion import PointMotion
from torchsar.multichannel.response import ElementPattern, FlatBand, LeastSquares, MinimumMeanSquare, Rebuild
from torchsar.multichannel.scene_image import Detector, ImageMovers, Removal, SceneImage
from torchsar.multichannel.stationary import StationaryImage
from torchsar.radar import BistaticRadar

Method = Literal["least_squares", "mmse"]


def _rebuild(bands: int, method: Method, band_hz: float | None, snr_db: float) -> Rebuild:
    return (
        LeastSquares(bands)
        if method == "least_squares"
        else MinimumMeanSquare(bands, snr_db, ElementPattern() if band_hz is None else FlatBand(band_hz))
    )


def stationary_image(
    radar: BistaticRadar,
    bands: int = 2,
    method: Method = "least_squares",
    band_hz: float | None = None,
    snr_db: float = 40.0,
    form: Literal["stolt", "bulk"] = "stolt",
) -> StationaryImage:
    """The image of everything as if at rest; mmse expects power in a flat band of band_hz, or by
    the pattern of the elements (null).
    """
    return StationaryImage(radar, _rebuild(bands, method, band_hz, snr_db), form)


class MoversImage(Stage):
    """The flow of Remote Sens. 2020, 12, 1703, Fig.

    13: the image (azimuth, range) of one frame with movers in their places, and what they are.

    bands, method, band_hz, snr_db: how what is at rest is rebuilt. removal: subtract the echo of
    movers, or zero all that lies in their lines and extent. segment_s, half_along_m, half_range_m,
    integration_s: of the extraction. Velocities and places of forward, (target,) each: of all
    targets, strongest first, where they are known.
    """

    works_on = ("channel", "pulse", "range")
    provides = ("u_r_m_s", "u_a_m_s", "y0_m", "range_m")

    def __init__(
        self,
        radar: BistaticRadar,
        bands: int = 2,
        method: Method = "least_squares",
        band_hz: float | None = None,
        snr_db: float = 40.0,
        removal: Removal = "subtract",
        integration_s: float = 4.5,
        segment_s: float = 0.6,
        half_along_m: float = 120.0,
        half_range_m: float = 60.0,
        threshold_db: float = 10.0,
        most: int = 8,
        u_a_reach_m_s: float = 20.0,
        suppressed_m_s: Sequence[float] = Detector().suppressed_m_s,
    ) -> None:
        super().__init__()
        extraction = Extraction(half_along_m, half_range_m, integration_s, segment_s)
        detector = Detector(threshold_db, most=most, suppressed_m_s=suppressed_m_s)
        self.flow = ImageMovers(
            radar, extraction, detector, _rebuild(bands, method, band_hz, snr_db), removal, u_a_half_m_s=u_a_reach_m_s
        )

    def scene(
        self,
        signal: Signal,
        u_r_m_s: Tensor | None = None,
        u_a_m_s: Tensor | None = None,
        y0_m: Tensor | None = None,
        range_m: Tensor | None = None,
    ) -> SceneImage:
        """All that the flow makes."""
        told: list[Any] = [u_r_m_s, u_a_m_s, y0_m, range_m]
        if all(value is None for value in told):
            return self.flow(signal)
        if any(value is None or value.ndim != 1 for value in told):
            raise ValueError(
                "targets are known by u_r_m_s, u_a_m_s, y0_m and range_m together, one number a "
                "target each; connect all four, or none"
            )
        radar, like = self.flow.radar, signal.data.real
        return self.flow(
            signal,
            known=[
                PointMotion.of(radar, like, *of_one)
                for of_one in zip(*(value.to(torch.float64) for value in told), strict=True)
            ],
        )

    def forward(
        self,
        signal: Signal,
        u_r_m_s: Tensor | None = None,
        u_a_m_s: Tensor | None = None,
        y0_m: Tensor | None = None,
        range_m: Tensor | None = None,
    ) -> tuple[Signal, Estimate]:
        made = self.scene(signal, u_r_m_s, u_a_m_s, y0_m, range_m)
        assert made.estimate is not None
        return made.fused, made.estimate
