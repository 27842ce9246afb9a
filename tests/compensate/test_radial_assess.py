"""Estimates of the radial motion and their assessment are two acts."""

from __future__ import annotations

import pytest
import torch

from tests.compensate.radials import ESTIMATORS, GATE, seen, velocity_rms
from torchsar.compensate import (
    MirrorProduct,
    RadialMotion,
    SegmentedInterference,
    phase_polish,
    pulse_gain,
    radial_motion,
)
from torchsar.compensate.radial import assess, blocks, recommended
from torchsar.core import Draws, Outcome, Signal
from torchsar.echo import simulate_ladar
from torchsar.radar import TriangularLadar
from torchsar.scene import LadarWorld, LetterE, LinearInSweep, Points, Polynomial, Sinusoid
from torchsar.study.bench.direct.triangles import table1

RADAR = table1()
IDS = list(ESTIMATORS)


def noisy(snr_db: float, **world):
    given = {"n": 48, "trials": 3, "fidelity": LinearInSweep(), "dtype": torch.complex64, **world}
    return seen(snr_db=snr_db, **given)


@pytest.mark.parametrize("name", IDS)
@pytest.mark.parametrize("snr_db", [10.0, -13.0, -25.0])
def test_values_do_not_depend_on_the_assessment(name: str, snr_db: float) -> None:
    sweeps, pulse, _ = noisy(snr_db)
    whole, bare = (ESTIMATORS[name](sweeps, RADAR, pulse, window_m=GATE, assess=act) for act in (True, False))
    assert not bare.std and bool((bare.outcome == Outcome.NOT_ASSESSED).all()) and bool(bare.ok.all())
    assert whole.std.keys() == whole.value.keys() == bare.value.keys()
    for key, value in whole.value.items():
        assert torch.equal(value, bare.value[key])


@pytest.mark.parametrize("name", IDS)
def test_without_assessment_none_of_its_work_is_done(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise AssertionError("the assessment was called")

    monkeypatch.setattr(blocks, "assessed_velocity", refuse)
    for part in ("assessed_velocity", "assessed_motion"):
        monkeypatch.setattr(recommended, part, refuse)
    for part in ("_variance", "mirror_velocity", "_changes_of_product"):
        monkeypatch.setattr(assess, part, refuse)
    sweeps, pulse, truth = noisy(10.0)
    found = ESTIMATORS[name](sweeps, RADAR, pulse, window_m=GATE, assess=False)
    assert float(velocity_rms(found, truth).max()) < 2e-3
    with pytest.raises(AssertionError, match="was called"):
        ESTIMATORS[name](sweeps, RADAR, pulse, window_m=GATE)


@pytest.mark.parametrize("name", IDS)
def test_noise_and_zeros_fail_for_their_reasons(name: str) -> None:
    noise = torch.randn(20, 2, 32, 512, dtype=torch.complex64, generator=torch.Generator().manual_seed(3))
    pulse = RADAR.sweep_axes(32)[1]
    found = ESTIMATORS[name](torch.cat([noise, 0 * noise[:1]]), RADAR, pulse, window_m=GATE)
    assert not bool(found.ok.any()) and int(found.outcome[-1]) == Outcome.EMPTY
    assert int((found.outcome[:-1] == Outcome.NOISE).sum()) >= 19


@pytest.mark.parametrize("name", ["segmented_sum", "correlation", "peak", "mirror", "recommended"])
def test_what_is_doubtful_has_its_reason_and_is_used(name: str) -> None:
    """Below the threshold the SNR is too low; a fast vibration contradicts the velocities."""
    sweeps, pulse, _ = noisy(-15.0)
    weak = ESTIMATORS[name](sweeps, RADAR, pulse, window_m=GATE)
    assert bool((weak.outcome == Outcome.INEXACT).all()) and bool(weak.doubtful.all())
    fast = (Polynomial([0.3, 20.0]), Sinusoid(60e-6, 3000.0, 20.0))
    sweeps, pulse, _ = noisy(10.0, n=96, trials=1, motion=fast)
    outcome = ESTIMATORS[name](sweeps, RADAR, pulse).outcome
    assert bool((outcome == (Outcome.INEXACT if name == "peak" else Outcome.AMBIGUOUS)).all())


@pytest.mark.filterwarnings("ignore:radial_motion")
def test_outcomes_of_the_phases() -> None:
    few, pulse, _ = noisy(20.0, n=6)
    assert bool((radial_motion(few, RADAR, pulse, window_m=GATE).outcome == Outcome.TOO_FEW).all())
    three = Points([-0.06, 0.0, 0.06], [1.5, 1.5, 1.5], [0.7, 1.0, 0.7])
    one_cell, pulse, _ = noisy(20.0, n=256, scene=three, trials=1)
    assert int(radial_motion(one_cell, RADAR, pulse, window_m=GATE).outcome) == Outcome.TOO_FEW
    alike = LetterE(random_phase=False)
    letter, pulse, _ = noisy(20.0, n=512, scene=alike, trials=1, seed=8)
    found = radial_motion(letter, RADAR, pulse, window_m=(-1.0, 1.0))
    assert bool(found.doubtful.all())


def test_gains_and_polish_have_the_switch() -> None:
    g = torch.Generator().manual_seed(1)
    data = torch.randn(2, 64, 8, dtype=torch.complex64, generator=g)
    whole, bare = (pulse_gain(data, assess=act) for act in (True, False))
    assert torch.equal(whole["gain"], bare["gain"]) and bool((whole.outcome == Outcome.MISFIT).all())
    assert bool((bare.outcome == Outcome.NOT_ASSESSED).all())
    whole, bare = (phase_polish(data, assess=act) for act in (True, False))
    assert torch.equal(whole["phase_rad"], bare["phase_rad"]) and not bare.std


def test_stages_have_the_switch() -> None:
    sweeps, pulse, _ = noisy(10.0)
    signal = Signal(sweeps, RADAR.sweep_axes(pulse.n))
    for stage in (MirrorProduct(RADAR, GATE, assess=False), RadialMotion(RADAR, GATE, assess=False)):
        assert bool((stage(signal).outcome == Outcome.NOT_ASSESSED).all())


@pytest.mark.parametrize(("range_m", "rate_hz", "periods"), [(0.1, 16e6, 128), (0.013, 4e6, 48), (0.1, 4e6, 48)])
def test_side_lobes_of_a_single_strong_point_are_no_part_of_another_velocity(
    range_m: float, rate_hz: float, periods: int
) -> None:
    sal = TriangularLadar(1.934e14, 5e9, 16e-6, rate_hz, 60.0, 3000.0)
    world = LadarWorld(Points([0.0], [range_m]), [Polynomial([0.4, 10.0])], snr_db=30.0)
    signal = simulate_ladar(sal, world, periods, draws=Draws(1, trials=range(8)))[0].signal
    for stage in (MirrorProduct(sal), SegmentedInterference(sal)):
        assert stage(signal).ok.all()
