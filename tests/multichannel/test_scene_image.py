"""Imaging of a whole scene: moving targets are found, removed and relocated."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import pytest
import torch

from torchsar.core import Outcome, Signal
from torchsar.multichannel import (
    FlatBand,
    ImageMovers,
    LeastSquares,
    MinimumMeanSquare,
    PointMotion,
    SceneImage,
    StationaryImage,
    correct_balance,
)
from torchsar.multichannel.scene_image import placed, unbalanced
from torchsar.study.bench.direct.moving import published_radar
from torchsar.study.bench.ocean import EXTRACTION, RADAR, flow, frame_of, ship

from .test_balance import clutter, flat


@cache
def scenes() -> tuple[Signal, Signal]:
    """Return a moving ship on a sea, and the sea alone."""
    return frame_of({"one": ship()}), frame_of({})


@cache
def made() -> SceneImage:
    return flow()(scenes()[0])


def known() -> PointMotion:
    return PointMotion.of(RADAR, torch.zeros((), dtype=torch.float64), 8.0, 0.0, 0.0, 5000.0)


def near(image: Signal, azimuth_m: float, range_m: float, reach=(100.0, 15.0)) -> torch.Tensor:
    azimuth, range_ = (axis.values() for axis in image.axes)
    return image.data[((azimuth - azimuth_m).abs() < reach[0])][:, (range_ - range_m).abs() < reach[1]]


def ratio_db(a: torch.Tensor, b: torch.Tensor) -> float:
    return 10 * math.log10(float(a.abs().square().mean() / b.abs().square().mean()))


@pytest.mark.slow
def test_a_ship_is_found_removed_and_relocated() -> None:
    scene, still = made(), StationaryImage(RADAR)(scenes()[1])
    (body,) = scene.bodies
    assert abs(float(body.motion.u_r_m_s) - 8) < 0.5 and abs(float(body.motion.y0_m)) < 20
    shown = 300 * float(known().image_s)
    assert shown == pytest.approx(133, abs=1)
    before, after = (
        ratio_db(near(image, shown, 5000.0) - near(still, shown, 5000.0), near(still, shown, 5000.0))
        for image in (scene.conventional, scene.rest)
    )
    assert before > 15 and after < before - 23
    assert ratio_db(near(scene.fused, float(body.motion.y0_m), 5000.0, (40.0, 10.0)), near(still, 0.0, 5000.0)) > 10
    estimate = scene.estimate
    assert (
        estimate is not None
        and estimate.outcome.tolist() == [Outcome.OK] + 7 * [Outcome.ABSENT]
        and float(estimate["u_r_m_s"][0]) == float(body.motion.u_r_m_s)
    )
    assert float(estimate["u_r_m_s"][1:].abs().max()) == 0


@pytest.mark.slow
def test_trials_are_independent() -> None:
    sea, (body,) = scenes()[1], made().bodies
    both = flow()(sea.with_data(torch.stack([sea.data, scenes()[0].data])))
    assert [len(found) for found in both.bodies] == [0, 1] and both.fused.trials == both.data.trials == (2,)
    assert both.estimate.outcome[:, 0].tolist() == [Outcome.NOISE, Outcome.OK]
    assert not bool(both.estimate.ok[0].any()) and both.estimate.ok.sum(-1).tolist() == [0, 1]
    assert float(both.estimate["u_r_m_s"][1, 0]) == pytest.approx(float(body.motion.u_r_m_s), abs=1e-3)
    torch.testing.assert_close(both.fused.data[1], made().fused.data, atol=1e-3, rtol=1e-4)
    known_ = flow()(both.data, known=[replace(known(), u_r_m_s=torch.tensor([8.0, 6.0], dtype=torch.float64))])
    assert known_.estimate["u_r_m_s"][:, 0].tolist() == [8, 6]


@pytest.mark.slow
@pytest.mark.parametrize("rebuild", [LeastSquares(2), MinimumMeanSquare(3, prior=FlatBand(350.0))])
def test_clutter_shows_that_channels_are_not_balanced(rebuild) -> None:
    """Moving targets were reliable with speeds of -0.4 m/s for 10, displaced by 170 m."""
    data = clutter(RADAR, flat, 20.0, trials=1)
    phases = torch.tensor([[0.0, 0.0, 0.0], [0.002, 0.0, -0.002], [0.05, 0.0, -0.05]], dtype=torch.float64)
    tilted = correct_balance(data, RADAR, phases, torch.zeros(3))
    assert unbalanced(tilted, RADAR, rebuild).tolist() == [False, False, True]
    assert not bool(unbalanced(torch.randn_like(data), RADAR, rebuild).any())
    # all Doppler bands, in which nothing tells a phase along the array
    assert not bool(unbalanced(tilted, RADAR, LeastSquares(3)).any())


def test_a_known_motion_is_kept() -> None:
    scene = flow()(scenes()[0], known=[known()])
    assert float(scene.bodies[0].motion.u_r_m_s) == 8 and torch.equal(scene.conventional.data, made().conventional.data)
    still = StationaryImage(RADAR)(scenes()[1])
    shown = 300 * float(known().image_s)
    assert ratio_db(near(scene.rest, shown, 5000.0) - near(still, shown, 5000.0), near(still, shown, 5000.0)) < -5
    none = flow()(scenes()[0], known=[])
    assert none.bodies == [] and torch.equal(none.rest.data, none.conventional.data)
    with pytest.raises(ValueError, match="9 motions are known, but the detector allows at most 8"):
        flow()(scenes()[0], known=9 * [known()])


@pytest.mark.parametrize("range_m, u_a, lobe", [(4846.0, 5.13, True), (5153.9, -5.01, True), (4846.0, -5.13, False)])
def test_side_lobes_have_the_doppler_rate_of_their_target(range_m: float, u_a: float, lobe: bool) -> None:
    """Side lobes of one point without noise, with the first two motions, counted as targets."""
    (ship,) = made().bodies
    point = replace(ship, motion=known(), level=torch.tensor(4e5))
    motion = PointMotion.imaged_at(RADAR, torch.zeros((), dtype=torch.float64), 8.0, u_a, known().image_s, range_m)
    assert flow()._side_lobe(replace(ship, motion=motion, level=torch.tensor(150.0)), point) == lobe


def test_zeroing_removes_the_sea_as_well() -> None:
    still, zero = StationaryImage(RADAR)(scenes()[1]), flow(removal="zero")(scenes()[0], known=[known()])
    shown = 300 * float(known().image_s)
    left = [
        ratio_db(near(scene.rest, shown, 5000.0) - near(still, shown, 5000.0), near(still, shown, 5000.0))
        for scene in (made(), zero)
    ]
    assert left[0] + 5 < left[1] < 1


def test_a_ship_at_rest_stays_in_the_image() -> None:
    data = frame_of({"still": ship(0.0)})
    scene = flow()(data)
    assert (
        len(scene.bodies) == 1
        and torch.equal(scene.rest.data, scene.conventional.data)
        and torch.equal(scene.fused.data, scene.rest.data)
    )


def test_a_relocated_point_has_the_amplitude_of_one_at_rest() -> None:
    point = ship(length_m=0.0, range_cells=1, count=1, level_db=40.0)
    scene = flow()(frame_of({"one": point}, sea=False), known=[known()])
    rest = StationaryImage(RADAR)(
        frame_of({"one": ship(0.0, length_m=0.0, range_cells=1, count=1, level_db=40.0)}, sea=False)
    )
    assert float(scene.fused.data.abs().max() / rest.data.abs().max()) == pytest.approx(1.0, abs=0.05)
    row, column = divmod(int(scene.fused.data.abs().argmax()), scene.fused.axes[1].n)
    azimuth, range_ = scene.fused.axes
    assert float(azimuth.values()[row]) == pytest.approx(0.0, abs=1.0) and float(
        range_.values()[column]
    ) == pytest.approx(5000.0, abs=2.6)
    empty = scene.rest.with_data(torch.zeros_like(scene.rest.data))
    assert float(placed(empty, scene.bodies[0], EXTRACTION).data[~((azimuth.values()).abs() < 70)].abs().max()) == 0


def test_nothing_is_found_where_nothing_moves() -> None:
    for data in (scenes()[1], scenes()[1].with_data(torch.zeros_like(scenes()[1].data))):
        scene = ImageMovers(RADAR, EXTRACTION)(data)
        assert (
            scene.bodies == []
            and torch.equal(scene.rest.data, scene.fused.data)
            and bool(torch.isfinite(torch.view_as_real(scene.fused.data)).all())
        )


def test_side_lobes_of_a_ship_are_not_targets() -> None:
    ship, movers = made().bodies[0], flow()
    # the side lobes of a point have (6 / 90 pi)^2 = 4.5e-4 of its peak 90 m away
    beside = replace(ship, motion=replace(ship.motion, range_m=ship.motion.range_m + 90.0), level=5e-3 * ship.level)
    assert movers._side_lobe(beside, ship)
    assert not movers._side_lobe(replace(beside, level=0.05 * ship.level), ship)
    assert not movers._side_lobe(replace(beside, motion=replace(beside.motion, u_r_m_s=-ship.motion.u_r_m_s)), ship)
    assert not movers._side_lobe(replace(beside, motion=replace(beside.motion, y0_m=ship.motion.y0_m + 300.0)), ship)


@pytest.mark.slow
def test_any_reconstruction_images_the_stationary_scene() -> None:
    for rebuild in (LeastSquares(1), MinimumMeanSquare(3)):
        scene = flow(rebuild=rebuild)(scenes()[0], known=[known()])
        assert scene.rest.axes[0].n == rebuild.bands * 540 and bool(
            torch.isfinite(torch.view_as_real(scene.fused.data)).all()
        )


def test_invalid_arguments_are_rejected() -> None:
    data = scenes()[0]
    broken = data.data.clone()
    broken[0, 0, 0] = torch.nan
    with pytest.raises(ValueError, match="NaN|finite"):
        flow()(data.with_data(broken))
    with pytest.raises(ValueError, match="removal must be"):
        flow(removal="paint")
    with pytest.raises(ValueError, match="2 Doppler bands cannot be separated by 1 channel"):
        ImageMovers(published_radar(channel_m=(0.0,)))
