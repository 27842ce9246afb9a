"""Impossible geometries raise errors that name the value."""

from __future__ import annotations

import pytest
import torch

from tests.helpers import small_radar, small_recording
from torchsar.focus import OmegaK


@pytest.mark.parametrize(
    ("given", "match"),
    [
        ({"velocity_m_s": -5.0}, "velocity_m_s must be positive"),
        ({"velocity_m_s": float("nan")}, "velocity_m_s: 1 of 1 values are NaN"),
        ({"doppler_hz": 1e9}, "doppler_hz and frame_hz must stay below"),
        ({"doppler_hz": float("nan")}, "doppler_hz: 1 of 1 values are NaN"),
    ],
)
def test_impossible_geometry_raises(given, match):
    recording, _ = small_recording(16, 64)
    values = {name: torch.tensor(value, dtype=torch.float64) for name, value in given.items()}
    with pytest.raises(ValueError, match=match):
        OmegaK(small_radar())(recording.signal, **values)
