"""Bodies: segments, echoes against direct sums, velocities and positions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from torchsar.multichannel import Extraction, Frame, PointMotion
from torchsar.multichannel.body import body_echo, body_image, centred_motion, find_body, known_body
from torchsar.multichannel.chip import Segments, chip_about
from torchsar.study.bench.direct.moving import compressed_echo
from torchsar.study.bench.ocean import EXTRACTION, GATE_S, RADAR, frame_of, ship

POINT = {"u_r": 7.0, "u_a": -4.0, "y0": 20.0, "r0": 5010.0}
WIDE = replace(EXTRACTION, range_m=100.0)
LIKE = torch.zeros((), dtype=torch.float64)


def motion_of(u_r=7.0, u_a=-4.0, y0=20.0, r0=5010.0) -> PointMotion:
    return PointMotion.of(RADAR, LIKE, u_r, u_a, y0, r0)


def left_db(data, taken) -> float:
    return 20 * float(torch.log10((data - taken).norm() / data.norm()))


def noisy_point(level=1e-3):
    """A point and white noise, complex128, and the point alone."""
    clean = compressed_echo(RADAR, 540, 96, [POINT], gate_s=GATE_S)
    noise = torch.randn(clean.data.shape, dtype=torch.complex128, generator=torch.Generator().manual_seed(3))
    return clean.with_data(clean.data + level * noise), clean


def test_segments_are_inverted() -> None:
    x = torch.randn(3, 2, 240, dtype=torch.complex128, generator=torch.Generator().manual_seed(1))
    whole = Segments(240, 48, torch.arange(48), torch.arange(11))
    torch.testing.assert_close(whole.back(whole.of(x)), x, atol=1e-12, rtol=0)
    tone = torch.exp(2j * np.pi * 3 / 48 * torch.arange(240, dtype=torch.float64))
    few = replace(whole, bins=torch.tensor([2, 3, 4]))
    assert few.of(x).shape == (3, 2, 11, 3)
    torch.testing.assert_close(few.back(few.of(tone[None]))[0, 48:-48], tone[48:-48], atol=1e-12, rtol=0)
    assert (
        float(
            few.back(few.of(tone[None] * torch.exp(2j * np.pi * 12 / 48 * torch.arange(240, dtype=torch.float64))))
            .abs()[0, 48:-48]
            .max()
        )
        < 1e-12
    )


def test_the_echo_of_a_body_is_the_direct_sum() -> None:
    data, clean = noisy_point()
    frame = Frame.of(RADAR, data)
    body = known_body(data.data, frame, motion_of(), WIDE)
    assert bool(body.ok) and float(body.motion.u_r_m_s) == 7
    # range side lobes outside the lines have -23 dB
    assert left_db(clean.data, body_echo(body, frame)) < -20
    assert body_echo(body, frame).dtype == torch.complex128


def test_everything_is_the_data_of_its_lines_and_tones() -> None:
    data, clean = noisy_point()
    frame = Frame.of(RADAR, data)
    taken = body_echo(known_body(data.data, frame, motion_of(), WIDE), frame, everything=True)
    assert left_db(clean.data, taken) < -20 and left_db(data.data, taken) < -20


def test_position_and_amplitude_of_a_point() -> None:
    data, _ = noisy_point()
    frame = Frame.of(RADAR, data)
    body = known_body(
        data.data, frame, motion_of(y0=10.0, r0=5003.0), EXTRACTION
    )  # the middle is corrected, the velocity is kept
    assert float(body.motion.y0_m) == pytest.approx(20.0, abs=0.05) and float(body.motion.range_m) == pytest.approx(
        5010.0, abs=0.5
    )
    position = torch.linspace(10.0, 30.0, 81, dtype=torch.float64)
    image = body_image(body, position, EXTRACTION).abs()
    row, line = divmod(int(image.argmax()), image.shape[1])
    assert float(position[row]) == pytest.approx(20.0, abs=0.3) and float(image.max()) == pytest.approx(1.0, abs=0.05)
    assert float(body.chip.range_m[line]) == pytest.approx(5010.0, abs=2.6)


def test_a_ship_on_a_sea_is_found_with_its_velocity() -> None:
    data = frame_of({"one": ship(8.0, 5.0)})
    alone = frame_of({"one": ship(8.0, 5.0)}, sea=False)
    frame, true = Frame.of(RADAR, data), motion_of(8.0, 5.0, 0.0, 5000.0)
    body = find_body(
        data.data, frame, float(true.image_s) + 0.02, float(true.closest_m) + 3.0, EXTRACTION, u_a_half_m_s=12.0
    )
    assert bool(body.ok) and abs(float(body.motion.u_r_m_s) - 8) < 0.5 and abs(float(body.motion.u_a_m_s) - 5) < 1.0
    assert abs(float(body.motion.u_r_m_s) - 8) < 3 * float(body.u_r_std_m_s)
    own = centred_motion(chip_about(alone.data, frame, true, EXTRACTION))
    # y0 changes by 16.7 m per metre per second of u_r
    assert abs(float(body.motion.y0_m - own.y0_m) + 5000 / 295 * (float(body.motion.u_r_m_s) - 8)) < 3


@pytest.mark.parametrize("speeds", [((-0.5, 2.8), (1.0, -1.1)), ((8.0, 0.8), (-5.1, 4.9)), ((-2.5, 5.8), (9.6, -3.8))])
def test_two_ships_of_different_speeds_in_one_place_are_not_mistaken_for_one(speeds) -> None:
    """An image shows both at the same azimuth; one speed fits far from both or between them."""
    (one, other), shown = speeds, 5000 / 300 * speeds[0][0]
    ships = {
        "one": ship(*one, level_db=20.0),
        "other": ship(*other, level_db=16.0, azimuth_m=shown - 5000 / 300 * other[0] + 25.0, range_m=5.0),
    }
    data = frame_of(ships)
    body = find_body(data.data, Frame.of(RADAR, data), shown / 300, 5000.0, EXTRACTION, u_a_half_m_s=12.0)
    off = min(abs(float(body.motion.u_r_m_s) - speed[0]) for speed in speeds)
    assert not bool(body.ok) or off < 5 * float(body.u_r_std_m_s)


@pytest.mark.parametrize("apart", [0.0, 0.8])
def test_range_lines_of_different_speeds_predict_the_error(apart: float) -> None:
    """Two ships in neighbouring lines count as one: its speed was ok and off by two deviations."""
    for seed in range(2):
        ships = {
            name: ship(8.0 + side * apart / 2, azimuth_m=-5000 / 300 * (8.0 + side * apart / 2), range_m=6.0 * side)
            for name, side in (("near", -1), ("far", 1))
        }
        data = frame_of(ships, seed)
        body = find_body(data.data, Frame.of(RADAR, data), 0.0, 5000.0, EXTRACTION, u_a_half_m_s=12.0)
        off = min(abs(float(body.motion.u_r_m_s) - 8.0 - side * apart / 2) for side in (-1, 1))
        std = float(body.u_r_std_m_s)
        assert off < 1.5 * std and (bool(body.ok) and std < 0.05 if apart == 0 else apart / 4 < std < apart / 2 + 0.05)


def test_a_ship_in_the_lines_beside_another_is_no_sea() -> None:
    slow = {"slow": ship(2.5, 4.0)}
    fast = {"fast": ship(-5.0, azimuth_m=110.0, range_m=165.0, level_db=30.0)}
    true = motion_of(2.5, 4.0, 0.0, 5000.0)
    found = []
    for ships in (slow, slow | fast):
        data = frame_of(ships)
        where = float(true.image_s), float(true.closest_m)
        found.append(find_body(data.data, Frame.of(RADAR, data), *where, EXTRACTION, u_a_half_m_s=12.0))
    alone, beside = found
    assert bool(alone.ok) and bool(beside.ok) and len(beside.chip.beside) < len(alone.chip.beside)
    assert abs(float(beside.motion.u_r_m_s - alone.motion.u_r_m_s)) < 2 * float(alone.u_r_std_m_s)


def test_a_body_that_cannot_be_found_is_not_ok() -> None:
    data = frame_of({}, seed=4)
    body = find_body(data.data, Frame.of(RADAR, data), 0.0, 5000.0, EXTRACTION)
    assert not bool(body.ok) and all(
        bool(torch.isfinite(getattr(body.motion, name))) for name in ("u_r_m_s", "u_a_m_s", "y0_m", "range_m")
    )
    silent = find_body(torch.zeros_like(data.data), Frame.of(RADAR, data), 0.0, 5000.0, EXTRACTION)
    assert not bool(silent.ok) and bool(torch.isfinite(silent.level)) and bool(torch.isfinite(silent.motion.u_r_m_s))


def test_a_motion_that_leaves_the_record_ends_the_search() -> None:
    """Seed 110 drives the search to a motion that no pulse illuminates; it once never ended."""
    data = frame_of({}, seed=110)
    body = find_body(data.data, Frame.of(RADAR, data), 0.0, 5000.0, EXTRACTION)
    assert not bool(body.ok)


def test_invalid_arguments_are_rejected() -> None:
    data, _ = noisy_point()
    frame = Frame.of(RADAR, data)
    with pytest.raises(ValueError, match="12 beside it for the covariance of the sea, got 0 cells"):
        chip_about(data.data, frame, motion_of(r0=9000.0), EXTRACTION)
    with pytest.raises(ValueError, match="segment_s of an extraction must be positive"):
        Extraction(segment_s=0.0)
