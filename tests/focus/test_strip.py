"""Strips in overlapping blocks against one transform; detection; requirements; the speed script."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from torchsar.core import Signal
from torchsar.focus import (
    Detect,
    OmegaK,
    OmegaKStolt,
    QuickLook,
    amplitude,
    focus_strip,
    multilook,
    plan_strip,
    reach_lines,
    requirements,
    to_db,
    write_strip,
)
from torchsar.focus.strip import ARRAYS
from torchsar.radar import LinearFM, StripmapRadar

RADAR = StripmapRadar(5.3e9, LinearFM(30.116e6, 1e-6, -1), 32.317e6, 1256.98, 7066.0, 988647.0)
N_LINES, N_RANGE = 6000, 48


def strip_error_db(stage, reach, seed=0, memory_lines=2600):
    torch.manual_seed(seed)
    raw = torch.randn(N_LINES, N_RANGE, dtype=torch.complex64)
    axes = RADAR.raw_axes(N_LINES, N_RANGE, start_s=3.0)
    one = stage(Signal(raw, axes)).data
    plan = plan_strip(raw.shape, reach, memory_lines * N_RANGE * 8 * ARRAYS)
    assert len(plan.blocks) > 2 and plan.bytes <= memory_lines * N_RANGE * 8 * ARRAYS
    out = np.zeros(raw.shape, np.complex64)
    write_strip(focus_strip(raw.numpy(), stage, RADAR, plan, axes=axes), out)
    inner = slice(max(-reach[0], 0), N_LINES - max(reach[1], 0))
    error = torch.from_numpy(out)[inner] - one[inner]
    return 20 * math.log10(float(error.norm() / one[inner].norm()))


@pytest.mark.parametrize("form", [OmegaK, OmegaKStolt])
@pytest.mark.parametrize("seed, doppler", [(0, -7050.0), (1, 0.0)])
def test_blocks_equal_one_transform(form, seed, doppler):
    """White noise gives the largest error, since it fills the band."""
    stage = form(RADAR, doppler_hz=doppler, band_hz=1000.0)
    reach = reach_lines(RADAR, RADAR.raw_axes(N_LINES, N_RANGE), (doppler, doppler), band_hz=1000.0)
    assert strip_error_db(stage, reach, seed) < -70


def test_blocks_follow_another_frame():
    stage = OmegaK(RADAR, doppler_hz=-700.0, frame_hz=0.0, band_hz=800.0)
    reach = reach_lines(RADAR, RADAR.raw_axes(N_LINES, N_RANGE), (-700.0, -700.0), frame_hz=0.0, band_hz=800.0)
    assert reach[0] > 0
    assert strip_error_db(stage, reach) < -70


def test_a_shorter_overlap_gives_a_larger_error():
    stage = OmegaK(RADAR, doppler_hz=0.0, band_hz=1000.0)
    assert strip_error_db(stage, (-100, 100)) > -20


def test_the_blocks_tile_the_strip_and_carry_true_axes():
    stage, reach = OmegaK(RADAR, doppler_hz=0.0, band_hz=800.0), (-400, 400)
    plan = plan_strip((5000, 8), reach, 1500 * 8 * 8 * ARRAYS)
    stage = OmegaK(RADAR, None, doppler_hz=0.0, band_hz=800.0)
    at, axes = 0, RADAR.raw_axes(5000, 8, start_s=1.0)
    for lines, image in focus_strip(torch.zeros(5000, 8, dtype=torch.complex64), stage, RADAR, plan, axes=axes):
        assert lines.start == at and image.data.shape == (lines.stop - lines.start, 8)
        assert image.axes[0].start == pytest.approx(RADAR.velocity_m_s * (1.0 + lines.start / RADAR.prf_hz))
        at = lines.stop
    assert at == 5000


def test_values_are_given_per_block():
    asked = []

    def values(lines):
        asked.append(lines)
        return {"velocity_m_s": 7066.0 + lines.start * 1e-4, "doppler_hz": torch.tensor(-5.0)}

    plan = plan_strip((3000, 8), (-400, 400), 1500 * 8 * 8 * ARRAYS)
    list(focus_strip(torch.zeros(3000, 8, dtype=torch.complex64), OmegaK(RADAR, None), RADAR, plan, values=values))
    assert len(asked) == len(plan.blocks) and all(part.stop - part.start == plan.height for part in asked)


def test_a_memory_that_is_too_small_raises():
    with pytest.raises(ValueError, match="allow at least"):
        plan_strip((30000, 1000), (-400, 400), 1 << 20)
    assert plan_strip((300, 1000), (-400, 400), 1 << 30).blocks == [(slice(0, 300), slice(0, 300))]
    with pytest.raises(ValueError, match="make a plan"):
        next(
            focus_strip(
                torch.zeros(10, 4, dtype=torch.complex64), OmegaK(RADAR), RADAR, plan_strip((11, 4), (-1, 1), 1 << 20)
            )
        )


def test_multilook_averages_power_and_moves_the_axes():
    image = torch.full((2, 9, 8), 3 + 4j, dtype=torch.complex128)
    image[1] *= 2
    assert torch.equal(
        multilook(image, (2, 4)), torch.tensor([25.0, 100.0], dtype=torch.float64)[:, None, None].expand(2, 4, 2)
    )
    axes = RADAR.image_axes(RADAR.raw_axes(9, 8))
    looked = Detect((2, 4))(Signal(image, axes))
    assert looked.data.shape == (2, 4, 2) and not looked.data.is_complex()
    torch.testing.assert_close(looked.axes[0].values(), axes[0].values()[:8].reshape(4, 2).mean(1))
    torch.testing.assert_close(looked.axes[1].values(), axes[1].values().reshape(2, 4).mean(1))
    with pytest.raises(ValueError, match="looks"):
        multilook(image, (10, 1))


@pytest.mark.parametrize("level", [1e-25, 1.0, 1e19])
def test_amplitude_at_extreme_levels(level):
    image = (torch.randn(2, 16, 16, dtype=torch.complex64) * level).requires_grad_()
    with torch.no_grad():
        image[1] = 0
    out = amplitude(image, (2, 2))
    assert torch.isfinite(out).all() and (out[0] > 0).all() and (out[1] == 0).all()
    (out / level).sum().backward()
    assert torch.isfinite(torch.view_as_real(image.grad)).all()


def test_decibels_are_per_trial():
    image = torch.ones(2, 4, 4)
    image[0, 0, 0], image[1] = 100.0, 0.0
    db = to_db(image, floor_db=-30)
    assert float(db[0].max()) == 0 and float(db[0].min()) == pytest.approx(-20) and (db[1] == -30).all()


def test_quicklook_is_small_and_square_in_metres():
    axes = RADAR.image_axes(RADAR.raw_axes(3000, 500))
    looked = QuickLook(256)(Signal(torch.randn(3000, 500, dtype=torch.complex64), axes))
    assert max(looked.data.shape) <= 256
    assert 0.4 < looked.axes[0].step / looked.axes[1].step < 2.6


def test_requirements_of_the_published_radar():
    """With r0 = 700 km, T_c = 1.5 s and dr = 5 km the migration differs by 0.14 m, a quarter of a
    cell, so that bulk + refocus suffices; the squint walks 80 to 90 cells.
    """
    radar = StripmapRadar(
        3.2e9, LinearFM(200e6, 5e-6), 250e6, 4000.0, 7000.0, 695e3, pointing_doppler_hz=0.0, integration_s=1.5
    )
    rows = {row.effect: row for row in requirements(radar, radar.raw_axes(4096, 16678))}
    bulk = rows["bulk + refocus (omega_k)"]
    assert bulk.ok and bulk.range_cells * radar.range_step_m == pytest.approx(0.14, abs=0.005)
    doppler = 2 * 7000 * math.sin(math.radians(0.3)) / radar.wavelength_m
    walk = next(
        row for row in requirements(radar, radar.raw_axes(4096, 16678), doppler) if row.effect == "squint ignored"
    )
    assert 80 < walk.range_cells < 95 and not walk.ok
    near = StripmapRadar(
        3.2e9, LinearFM(200e6, 5e-6), 250e6, 400.0, 150.0, 7e3, pointing_doppler_hz=0.0, integration_s=3.0
    )
    assert requirements(near, near.raw_axes(4096, 2048))[0].verdict == "use omega_k_stolt"
    with pytest.warns(UserWarning, match="PRF 400 Hz"):
        requirements(near, near.raw_axes(4096, 2048), integration_s=20.0)


def test_the_speed_script_runs_small():
    sys.path.insert(0, str(Path(__file__).parents[2] / "scripts"))
    try:
        import focusing_speed
    finally:
        sys.path.pop(0)
    rows = {row.form: row for row in focusing_speed.measure([256], [1], repeats=1)}
    assert rows["Stolt"].loss_db < -80 and rows["stored bulk + refocus"].ratio > 0
