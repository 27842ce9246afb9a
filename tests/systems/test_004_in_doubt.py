"""Phase errors of the pulses of a strip that an autofocus finds, and whose estimate fails."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from torchsar.compensate import CorrectPulsePhase, DopplerCentroid, Sca
from torchsar.core import Chain, Draws, Estimate, Outcome, Signal, use
from torchsar.echo import simulate
from torchsar.focus import OmegaK
from torchsar.metrics import entropy
from torchsar.radar import LinearFM, StripmapRadar
from torchsar.scene import Dwell, Points, StripmapWorld

RADAR = StripmapRadar(
    carrier_hz=3.2e9,
    pulse=LinearFM(bandwidth_hz=40e6, duration_s=0.5e-6),
    sampling_hz=50e6,
    prf_hz=400.0,
    velocity_m_s=120.0,
    near_range_m=4000.0,
    pointing_doppler_hz=0.0,
)
DOPPLER_HZ = 25.0


class Failed(Sca):
    """Pulse phases that remove the curvature of the azimuth histories, and have failed."""

    def forward(self, signal: Signal) -> Estimate:
        found = super().forward(signal)
        return replace(found, outcome=Outcome.NOISE.like(found.outcome))


@pytest.fixture(scope="module")
def strip() -> Signal:
    targets = Points(azimuth_m=[0.0, 12.0, -15.0], range_m=[0.0, 30.0, -40.0])
    world = StripmapWorld(targets, Dwell(dwell_s=1.0), doppler_hz=DOPPLER_HZ, snr_db=10.0)
    return simulate(RADAR, world, 512, 128, Draws(1))[0].signal


def test_a_failed_phase_leaves_the_strip_and_its_doppler_alone(strip: Signal) -> None:
    chain = Chain(
        phase=Failed(),
        correct=use(CorrectPulsePhase(), phase_rad="phase"),
        doppler=DopplerCentroid(RADAR),
        focus=use(OmegaK(RADAR), doppler_hz="doppler"),
    )
    trace = chain.trace(strip)
    assert trace.estimates["phase"]["phase_rad"].abs().max() > 50
    assert torch.equal(trace.outputs["correct"].data, strip.data) and bool(trace.neutral["correct.phase_rad"])
    doppler = trace.estimates["doppler"]
    assert bool(doppler.ok) and float(doppler.neutral["doppler_hz"]) == 0.0
    assert abs(float(trace.estimates["doppler"]["doppler_hz"]) - DOPPLER_HZ) < 1.0
    applied = chain.rerun(trace, "correct", given={"phase.phase_rad": trace.values["phase.phase_rad"] + 0})
    assert entropy(applied.data) > entropy(trace.signal.data) + 1


def test_lines_of_random_phases_have_no_doppler_that_is_ok(strip: Signal) -> None:
    phase = 2 * torch.pi * torch.rand(3, 512, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    found = DopplerCentroid(RADAR)(CorrectPulsePhase()(strip, phase))
    assert not found.ok.any()
    for name in ("doppler_hz", "doppler_baseband_hz", "ambiguity", "squint_deg"):
        assert found.trusted(name, "neutral").tolist() == [0.0] * 3
