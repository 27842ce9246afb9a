"""Adaptive chirplets: exact on chirps; on a target with jerk they lose its weak scatterers."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from torchsar.compensate import ChirpletClean, chirplet_clean
from torchsar.core import Signal
from torchsar.focus import matched_fourier
from torchsar.metrics import entropy
from torchsar.radar import LIGHT_M_S, InverseRadar
from torchsar.radar.warp import warp

F64 = torch.float64
PULSES, PRF = 600, 30e3
TIME = (torch.arange(PULSES, dtype=F64) - (PULSES - 1) / 2) / PRF


def chirps(doppler_hz: Tensor, rate_hz_s: Tensor, amplitude: Tensor) -> Tensor:
    """Sum over the first dimension of chirps (chirp, range), (pulse, range) complex128."""
    turns = doppler_hz[:, None] * TIME[:, None] + rate_hz_s[:, None] * TIME[:, None].square() / 2
    return (amplitude[:, None] * torch.exp(-2j * math.pi * turns)).sum(0)


def turning(cells: Tensor, amplitude: Tensor, k: tuple[float, float]) -> Tensor:
    """One range cell of scatterers with warp k.

    cells: their Doppler cells in the middle of the aperture.
    """
    time = torch.arange(PULSES, dtype=F64) / PRF
    middle = PULSES / 2 / PRF
    phi = warp(time, torch.tensor(k, dtype=F64))
    rate = 1 + k[0] * middle + k[1] * middle**2 / 2
    return (amplitude * torch.exp(-2j * math.pi * cells * phi[:, None] * PRF / PULSES / rate)).sum(-1)[:, None]


DOPPLER = torch.tensor([[1000.0, -7013.0], [-3333.3, 9000.0]], dtype=F64)
RATE = torch.tensor([[1.1e5, -2.9e5], [0.0, 3.1e5]], dtype=F64)
AMPLITUDE = torch.tensor([[1.0, 0.5j], [0.2 - 0.3j, -1.0]], dtype=torch.complex128)


def test_chirps_are_found_in_order_of_strength() -> None:
    found = chirplet_clean(chirps(DOPPLER, RATE, AMPLITUDE), PRF, atoms=2)
    order = torch.tensor([[0, 1], [1, 0]])
    cell = PRF / PULSES
    torch.testing.assert_close(found.doppler_hz, DOPPLER.gather(0, order), atol=0.05 * cell, rtol=0)
    torch.testing.assert_close(found.rate_hz_s, RATE.gather(0, order), atol=0.3 * cell**2, rtol=0)
    torch.testing.assert_close(found.amplitude, AMPLITUDE.gather(0, order), atol=0.03, rtol=0)
    assert found.residual_share < 1e-3


def test_the_image_is_that_of_tones() -> None:
    found = chirplet_clean(chirps(DOPPLER, RATE, AMPLITUDE), PRF, atoms=2)
    even = torch.zeros(0, dtype=F64)
    sharp = matched_fourier(chirps(DOPPLER, 0 * RATE, AMPLITUDE), even, PRF)
    assert found.image.shape == sharp.shape == (2 * PULSES, 2)
    assert (found.image - sharp).abs().max() < 0.05 * sharp.abs().max()
    assert entropy(matched_fourier(chirps(DOPPLER, RATE, AMPLITUDE), even, PRF)) > entropy(sharp) + 1


def test_weak_scatterers_are_lost_on_a_target_with_jerk() -> None:
    """Two strong and six weak scatterers per range cell.

    Without jerk all eight are imaged. With jerk the residuals of the strong ones use up the atoms.
    """
    cells = torch.tensor([-220.0, -150.5, -90.2, -31.0, 43.7, 100.0, 161.5, 214.0], dtype=F64)
    amplitude = torch.full((8,), 0.07, dtype=torch.complex128)
    amplitude[[0, 7]] = 1.0
    lines = (2 * cells).round().to(torch.int64) + PULSES
    weak = slice(1, 7)

    def seen(k: tuple[float, float]) -> Tensor:
        image = chirplet_clean(turning(cells, amplitude, k), PRF, atoms=8).image[:, 0].abs() / math.sqrt(PULSES)
        return torch.stack([image[line - 3 : line + 4].max() for line in lines]) / amplitude.abs()

    even, uneven = seen((20.0, 0.0)), seen((5.0, 5000.0))
    assert (even[[0, 7]] > 0.9).all() and (even[weak] > 0.7).all()
    assert (uneven[[0, 7]] > 0.3).all()
    assert (uneven[weak] < 0.5).sum() >= 4


def test_atoms_below_the_floor_are_not_shown() -> None:
    data = chirps(DOPPLER, RATE, AMPLITUDE * torch.tensor([[1.0, 1.0], [1.0, 1e-3]], dtype=F64))
    everything, strong = (chirplet_clean(data, PRF, atoms=2, floor_db=floor) for floor in (80.0, 20.0))
    assert torch.equal(everything.amplitude, strong.amplitude)
    assert not torch.equal(everything.image, strong.image)


@pytest.mark.parametrize("dtype", [torch.complex64, torch.complex128])
def test_a_batch_equals_single_trials(dtype: torch.dtype) -> None:
    data = torch.stack([chirps(DOPPLER, RATE * s, AMPLITUDE) * 10**i for i, s in enumerate((1.0, 0.3, -1.0))]).to(dtype)
    together = chirplet_clean(data, PRF, atoms=3, floor_db=20.0)
    assert together.image.dtype == dtype
    for i in range(3):
        alone = chirplet_clean(data[i], PRF, atoms=3, floor_db=20.0)
        level = float(alone.image.abs().max())
        torch.testing.assert_close(
            together.image[i], alone.image, atol=level * (1e-4 if dtype == torch.complex64 else 1e-9), rtol=0
        )


def test_any_number_of_pulses() -> None:
    for n in (16, 17, 101, 599):
        data = chirps(DOPPLER[:1], RATE[:1], AMPLITUDE[:1])[:n]
        assert torch.isfinite(torch.view_as_real(chirplet_clean(data, PRF, atoms=1).image)).all()
    silent = chirplet_clean(torch.zeros(64, 3, dtype=torch.complex64), PRF)
    assert not silent.image.abs().any() and silent.residual_share == 0


def test_the_stage_forms_an_image_in_hertz() -> None:
    radar = InverseRadar(LIGHT_M_S / 1.55e-6, 1e9, PRF)
    signal = Signal(chirps(DOPPLER, RATE, AMPLITUDE), radar.raw_axes(PULSES, 2))
    image = ChirpletClean(radar, atoms=2, oversampling=4.0, lines=1800)(signal)
    assert image.names == ("azimuth", "range") and image.axis("azimuth").unit == "Hz"
    peak = image.axis("azimuth").values()[image.data.abs().argmax(0)]
    torch.testing.assert_close(peak, torch.tensor([1000.0, 9000.0], dtype=F64), atol=PRF / PULSES / 4, rtol=0)


def test_invalid_input_is_rejected() -> None:
    data = chirps(DOPPLER, RATE, AMPLITUDE)
    with pytest.raises(ValueError, match="at least 16 pulses"):
        chirplet_clean(data[:15], PRF)
    with pytest.raises(TypeError, match="complex64 or complex128"):
        chirplet_clean(data.real, PRF)
    with pytest.raises(ValueError, match="NaN or Inf"):
        chirplet_clean(data * torch.nan, PRF)
    for options in ({"atoms": 0}, {"sweep": 0.0}, {"floor_db": -1.0}):
        with pytest.raises(ValueError, match="atoms 1 or more"):
            chirplet_clean(data, PRF, **options)
