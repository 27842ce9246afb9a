"""Gradients and batches of every focuser, for small data in complex128."""

from __future__ import annotations

import pytest
import torch

from torchsar.focus import OmegaKStolt, backproject_strip, omega_k, omega_k_stolt, range_doppler
from torchsar.radar import LinearFM, StripmapRadar

RADAR = StripmapRadar(3.2e9, LinearFM(40e6, 0.2e-6), 50e6, 400.0, 120.0, 2000.0)
FORMS = [omega_k, omega_k_stolt, range_doppler]


def rows(form):
    def run(raw, velocity, frame):
        return form(raw, RADAR, doppler_hz=8.0, velocity_m_s=velocity, frame_hz=frame)

    return run


@pytest.mark.slow
@pytest.mark.parametrize("form", FORMS)
def test_gradcheck_in_raw_velocity_and_frame(form):
    torch.manual_seed(0)
    raw = torch.randn(2, 6, 8, dtype=torch.complex128, requires_grad=True)
    velocity, frame = (
        torch.tensor([118.0, 121.0], dtype=torch.float64, requires_grad=True),
        torch.tensor([5.0, -7.0], dtype=torch.float64, requires_grad=True),
    )
    assert torch.autograd.gradcheck(rows(form), (raw, velocity, frame), atol=1e-4)


def test_gradcheck_of_backprojection_in_all_arguments():
    torch.manual_seed(0)
    raw = torch.randn(5, 8, dtype=torch.complex128, requires_grad=True)
    x, r = (torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in ([0.5, 0.9], [2008.0, 2011.0]))
    velocity = torch.tensor(119.0, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(
        lambda raw, x, r, v: backproject_strip(raw, RADAR, x, r, doppler_hz=8.0, velocity_m_s=v),
        (raw, x, r, velocity),
        atol=1e-4,
    )


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("shape", [(48, 60), (33, 47)])
def test_a_batch_with_different_values_equals_its_singles(form, shape):
    raw = torch.randn(3, *shape, dtype=torch.complex128)
    doppler, velocity = (
        torch.tensor([0.0, 130.0, -900.0], dtype=torch.float64),
        torch.tensor([120.0, 90.0, 125.0], dtype=torch.float64),
    )
    batch = form(raw, RADAR, doppler_hz=doppler, velocity_m_s=velocity)
    singles = [form(raw[i], RADAR, doppler_hz=doppler[i], velocity_m_s=velocity[i]) for i in range(3)]
    torch.testing.assert_close(batch, torch.stack(singles), rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("form", FORMS)
def test_blocks_equal_the_plain_path(form):
    raw = torch.randn(700, 600, dtype=torch.complex128)
    plain = form(raw.clone().requires_grad_(), RADAR, doppler_hz=40.0, band_hz=200.0).detach()
    torch.testing.assert_close(form(raw, RADAR, doppler_hz=40.0, band_hz=200.0), plain, rtol=1e-10, atol=1e-10)


def test_backprojected_batch_equals_singles_and_blocks_do_not_matter():
    raw = torch.randn(2, 40, 64, dtype=torch.complex128)
    x, r = torch.linspace(3, 9, 5, dtype=torch.float64)[:, None], 2000 + torch.linspace(20, 120, 7, dtype=torch.float64)
    velocity = torch.tensor([120.0, 100.0], dtype=torch.float64)
    kw = {"doppler_hz": 3.0, "aperture": lambda since, _: since.abs() <= 0.025}
    batch = backproject_strip(raw, RADAR, x, r, velocity_m_s=velocity, **kw)
    assert batch.shape == (2, 5, 7)
    for i in range(2):
        torch.testing.assert_close(
            batch[i], backproject_strip(raw[i], RADAR, x, r, velocity_m_s=velocity[i], block_bytes=1, **kw)
        )


def test_apertures_limit_the_pulses():
    raw = torch.ones(40, 64, dtype=torch.complex128)
    x, r = torch.tensor(6.0, dtype=torch.float64), torch.tensor(2060.0, dtype=torch.float64)
    some = backproject_strip(raw, RADAR, x, r, doppler_hz=0.0, aperture=lambda since, _: since.abs() <= 11 / 800)
    mask = ((torch.arange(40) / 400 - 6.0 / 120).abs() <= 5.5 / 400)[:, None]
    torch.testing.assert_close(some, backproject_strip(raw * mask, RADAR, x, r, doppler_hz=0.0))
    assert (
        abs(
            backproject_strip(
                raw, RADAR, x, r, doppler_hz=300.0, frame_hz=0.0, aperture=lambda _, offset: offset.abs() <= 25
            )
        )
        == 0
    )


def test_a_processed_band_removes_other_doppler_and_warns_beyond_the_prf():
    n = 256
    tone = (
        torch.exp(2j * torch.pi * 90.625 / 400 * torch.arange(n, dtype=torch.float64))[:, None]
        .expand(n, 32)
        .contiguous()
    )
    kept, removed = (
        omega_k(tone, RADAR, doppler_hz=centre, frame_hz=0.0, band_hz=100.0).abs().mean() for centre in (90.0, 0.0)
    )
    assert removed < 0.02 * kept
    with pytest.warns(UserWarning, match=r"PRF 400 Hz .* 450"):
        omega_k(tone, RADAR, doppler_hz=0.0, band_hz=450.0)
    with pytest.raises(ValueError, match="band"):
        omega_k(tone, RADAR, doppler_hz=0.0, band_hz=-1.0)


def test_a_cropped_signal_keeps_its_ranges():
    from torchsar.core import Signal

    raw = Signal(torch.zeros(64, 128, dtype=torch.complex128), RADAR.raw_axes(64, 128))
    raw.data[32, 90] = 1
    stage = OmegaKStolt(RADAR, None)
    whole, part = stage(raw), stage(raw.isel(range=slice(40, 128)))
    peak = int(part.data.abs().sum(-2).argmax())
    assert part.axes[-1].start == pytest.approx(whole.axes[-1].start + 40 * RADAR.range_step_m)
    torch.testing.assert_close(part.data[:, peak].abs(), whole.data[:, peak + 40].abs(), rtol=0, atol=2e-3)


def test_threads_share_the_blocks_and_change_nothing():
    raw = torch.randn(900, 600, dtype=torch.complex64)
    velocity = torch.nn.Parameter(torch.tensor(119.0, dtype=torch.float64))
    before, images = torch.get_num_threads(), []
    try:
        for count in (1, 2):
            torch.set_num_threads(count)
            with torch.no_grad():
                images.append(omega_k_stolt(raw, RADAR, doppler_hz=3.0, velocity_m_s=velocity))
            assert torch.get_num_threads() == count
            with torch.inference_mode():
                omega_k(raw, RADAR, doppler_hz=3.0)
    finally:
        torch.set_num_threads(before)
    assert not images[1].requires_grad
    torch.testing.assert_close(*images, rtol=1e-4, atol=1e-4)
