"""Range-Doppler step by step, and range walk removed by the keystone transform."""

from __future__ import annotations

import pytest
import torch

from tests.helpers import small_radar
from torchsar import echo, focus, radar, scene
from torchsar.core import Chain, Draws, Signal, Trace, use
from torchsar.study.trials.batch import IMAGE

SQUINTED = {"doppler_hz": torch.tensor([-60.0, 10.0, 90.0], dtype=torch.float64)}
SQUINTED |= {"velocity_m_s": torch.tensor([112.0, 120.0, 131.0], dtype=torch.float64)}


def stepwise(n_pulse: int = 256, dwell_s: float = 0.5, **settings: float) -> tuple[Trace, Signal]:
    """Trials of different squint and velocity in four steps, and by the whole algorithm."""
    sensor, given = small_radar(), {name: f"given.{name}" for name in SQUINTED}
    world = scene.StripmapWorld(scene.Points([-20.0, 0.0, 15.0], [-20.0, 0.0, 60.0]), scene.Dwell(dwell_s))
    chain = Chain(
        echo=use(echo.Simulate(sensor, world, n_pulse, 160, dtype=torch.complex128), **given),
        compress=focus.RangeCompress(sensor),
        doppler=focus.DopplerTransform(),
        rcmc=use(focus.CorrectRangeMigration(sensor), **given),
        azimuth=use(focus.AzimuthCompress(sensor, **settings), **given),
    )
    trace = chain.trace(draws=Draws(1, trials=range(3)), given={f"given.{k}": v for k, v in SQUINTED.items()})
    return trace, focus.RangeDoppler(sensor, **settings)(trace.outputs["echo"], **SQUINTED)


@pytest.mark.parametrize("settings", [{}, {"band_hz": 300.0}])
@pytest.mark.parametrize("n_pulse", [256, 255])
def test_the_steps_together_are_range_doppler(n_pulse: int, settings: dict[str, float]) -> None:
    trace, whole = stepwise(n_pulse, **settings)
    assert trace.signal.names == whole.names == IMAGE
    for found, expected in zip(trace.signal.axes, whole.axes, strict=True):
        torch.testing.assert_close(found.values(), expected.values())
    torch.testing.assert_close(trace.signal.data, whole.data, rtol=0, atol=1e-12 * float(whole.data.abs().max()))


def test_migration_is_corrected_in_the_rows_of_the_target() -> None:
    sensor = small_radar(sampling_hz=100e6, pulse=radar.LinearFM(80e6, 0.5e-6))
    world = scene.StripmapWorld(scene.Points([0.0], [0.0]), scene.Dwell(2.4))
    chain = Chain(
        echo=echo.Simulate(sensor, world, 1024, 256, dtype=torch.complex128),
        compress=focus.RangeCompress(sensor),
        doppler=focus.DopplerTransform(),
        rcmc=focus.CorrectRangeMigration(sensor),
    )
    trace = chain.trace(draws=Draws(1))
    lit = trace.signal.axes[0].values().abs() < 80  # the Doppler band of the dwell

    def cells(name: str) -> list[int]:
        return trace.outputs[name].data[lit].abs().argmax(-1).unique().tolist()

    assert len(cells("doppler")) > 1
    assert len(cells("rcmc")) == 1


def test_the_keystone_stage_straightens_a_walk_of_several_pulse_rates() -> None:
    isar = radar.InverseRadar(1e10, 1e9, 500.0)
    world = scene.TurntableWorld(
        scene.Points([0.0], [-0.6]), 0.0, [scene.Polynomial([9.0])], fidelity=scene.Dechirped()
    )
    moved = radar.InverseRadar(1e10, 1e9, 500.0, pulse_s=1e-4)
    chain = Chain(
        echo=echo.Simulate(moved, world, 64, 64),
        compress=focus.CompressDechirped(moved),
        straight=use(focus.Keystone(isar), ambiguity="given.ambiguity"),
    )
    # 9 m/s give -600 Hz, one pulse rate below -100 Hz
    trace = chain.trace(draws=Draws(1), given={"given.ambiguity": torch.tensor(-1.0)})
    assert len(trace.outputs["compress"].data.abs().argmax(-1).unique()) > 5
    assert len(trace.signal.data[4:-4].abs().argmax(-1).unique()) == 1
