"""Errors of the receiver: levels, frequencies, positions, and what stays unchanged."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from tests.echo.test_interference import RADAR, clutter, power
from tests.helpers import small_ladar
from torchsar.core import Axis, Draws, Recording, Signal
from torchsar.echo.receiver import GainSteps, GateJumps, GroundAtRest, Leakage, PulsedInterference, QuadratureError


@pytest.mark.parametrize("level_db", [-20.0, 0.0, 30.0])
def test_levels_are_the_given_ones(level_db: float) -> None:
    clean = clutter(256, 128, trials=3, dtype=torch.complex128)
    draws, level = Draws(1, trials=range(3)), torch.full((3,), 10 ** (level_db / 10), dtype=torch.float64)

    def added(impairment) -> torch.Tensor:
        return impairment(clean, draws)[0].signal.data - clean.signal.data

    for spur in (Leakage(level_db), Leakage(level_db, 0.2, -0.1, 0.3), GroundAtRest(level_db, 1.0)):
        torch.testing.assert_close(power(added(spur)) / power(clean.signal.data), level, rtol=0.05, atol=0)
    at_one_cell = added(Leakage(level_db, position=torch.tensor([0.0, 0.5, 1.0])))
    assert (at_one_cell.abs() > 0).any(-2).nonzero().tolist() == [[0, 0], [1, 64], [2, 127]]
    torch.testing.assert_close(power(at_one_cell) * 128 / power(clean.signal.data), level)
    bursts = added(PulsedInterference(level_db, 98765.4, 2e-6, bursts=True))
    hit = bursts != 0
    assert hit.to(torch.float64).mean() == pytest.approx(0.2, abs=0.02)
    torch.testing.assert_close(
        power(bursts) / hit.double().mean((-2, -1)) / power(clean.signal.data), level, rtol=0.05, atol=0
    )


def test_leakage_is_a_line_of_its_frequencies_and_its_power_is_recorded() -> None:
    clean = clutter(64, 128, dtype=torch.complex128)
    impaired, truth = Leakage(20.0, sample_cycles=0.25, pulse_cycles=-0.125)(clean, Draws(2))
    added = impaired.signal.data - clean.signal.data
    assert divmod(int(torch.fft.fft2(added).abs().argmax()), 128) == (56, 32)
    torch.testing.assert_close(power(added), truth["power"])
    assert (truth["leakage"][1:] * truth["leakage"][:-1].conj()).angle().div(2 * math.pi).mean() == pytest.approx(
        -0.125
    )


def test_channels_and_sweeps_share_their_errors_and_a_detector_records_the_real_part() -> None:
    ladar = small_ladar()
    axes = ladar.sweep_axes(8)
    sweeps = Recording(Signal(torch.ones(3, *(a.n for a in axes), dtype=torch.complex128), axes), ladar)
    draws = Draws(1, trials=range(3))
    for impairment in (Leakage(3.0, walk_rad=0.5), GainSteps(2, 6.0)):
        change = impairment(sweeps, draws)[0].signal.data
        assert torch.equal(change[:, 0], change[:, 1]) and not torch.equal(change[0], change[1])
    detected = (replace(axes[1], n=4), Axis("time", 4096, 0.0, 1.0, "s"))
    block = Recording(Signal(torch.ones(4, 4096, dtype=torch.float64), detected), ladar)
    noted = Leakage(0.0, sample_cycles=0.1)(block, Draws(1))[0].signal.data - 1
    assert power(noted) == pytest.approx(1.0, rel=1e-3)
    offset = Leakage(0.0)(block, Draws(1, trials=range(6)))[0].signal.data - 1  # whatever its random phase
    torch.testing.assert_close(power(offset), torch.ones(6, dtype=torch.float64))
    with pytest.raises(ValueError, match="need complex samples, got real ones"):
        QuadratureError(1.0)(block, Draws(1))


def test_pulses_of_another_radar_come_at_their_own_frequency() -> None:
    clean = clutter(64, 1024, dtype=torch.complex128)
    slow = PulsedInterference(30.0, prf_hz=RADAR.prf_hz / 4, duration_s=2e-6, bandwidth_hz=1e7)
    impaired, truth = slow(clean, Draws(3))
    changed = (impaired.signal.data != clean.signal.data).double().mean(-1)
    assert torch.equal(changed, truth["share"])
    lines = truth["share"].nonzero()[:, 0]
    assert len(lines) in (0, 16) and (lines.diff() == 4).all()


def test_quadrature_error_adds_the_image_that_it_records() -> None:
    n = torch.arange(1024, dtype=torch.float64)
    tone = torch.exp(2j * math.pi * 0.125 * n)[None]
    recording = Recording(Signal(tone, RADAR.raw_axes(1, 1024)), RADAR)
    impaired, truth = QuadratureError(1.5, 4.0)(recording, Draws(1))
    spectrum = torch.fft.fft(impaired.signal.data[0]).abs().square()
    assert float(10 * torch.log10(spectrum[-128] / spectrum[128])) == pytest.approx(float(truth["image_db"]), abs=1e-6)


def test_gate_jumps_move_cells_by_the_recorded_shift() -> None:
    clean = clutter(64, 32, trials=2)
    draws = Draws(1, trials=range(2))
    impaired, truth = GateJumps(5.0, share=torch.tensor([0.2, 1.0]))(clean, draws)
    back = torch.stack(
        [
            torch.stack([line.roll(-int(s)) for line, s in zip(*one, strict=True)])
            for one in zip(impaired.signal.data, truth["shift_cells"], strict=True)
        ]
    )
    assert torch.equal(back, clean.signal.data)
    assert (truth["shift_cells"] != 0).sum(-1).tolist() == pytest.approx([12, 58], abs=8)
    held = GateJumps(5.0, share=0.1, lasting=True)(clean, draws)[1]["shift_cells"]
    assert (held.diff() != 0).sum() < 24 and held.abs().max() <= 5
    # of dechirped pulses the beat frequency moves
    beat = Recording(Signal(clean.signal.data, (clean.signal.axes[0], Axis("fast_time", 32, -16.0, 1.0, "s"))), RADAR)
    moved, found = GateJumps(5.0)(beat, draws)
    spectra = (torch.fft.ifft(torch.fft.ifftshift(x, dim=-1)) for x in (moved.signal.data, clean.signal.data))
    profile, before = spectra
    shift = int(found["shift_cells"][0, 0])
    torch.testing.assert_close(profile[0, 0], before[0, 0].roll(shift))


@pytest.mark.parametrize(
    "wrong",
    [
        lambda: Leakage(0.0, position=1.5),
        lambda: GroundAtRest(0.0, 2.0),
        lambda: PulsedInterference(0.0, -1.0, 1e-6),
        lambda: GainSteps(-1),
        lambda: GateJumps(1.0, share=0.0),
    ],
)
def test_numbers_out_of_range_are_refused(wrong) -> None:
    with pytest.raises(ValueError, match="must|need"):
        wrong()
