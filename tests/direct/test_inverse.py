"""The recommended autofocus of a ladar on pulses of an independent generator."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from torchsar.compensate import align_envelopes, autofocus, shift_range
from torchsar.core import Draws, Signal
from torchsar.echo import dechirped_echo
from torchsar.focus import AzimuthTransform, compress_dechirped
from torchsar.metrics import impulse_response, phase_rmse
from torchsar.radar import InverseRadar
from torchsar.scene import Aircraft
from torchsar.study.bench.direct.inverse import F64, Ladar, echo, still

LADAR = Ladar(pulses=100, prf_hz=1000.0, cells=96)
TRIALS = 2


def described(ladar: Ladar) -> InverseRadar:
    """The same numbers in the words of the package."""
    return InverseRadar(
        ladar.carrier_hz, ladar.bandwidth_hz, ladar.prf_hz, ladar.rotation_rad_s, ladar.pulse_s, ladar.range_m
    )


def tracked(t: Tensor) -> Tensor:
    """A track of 100 m/s."""
    return 100.0 * t


def moved(t: Tensor) -> Tensor:
    """0.03 m/s faster than the track, with a vibration of 2 um at 40 Hz."""
    return 100.03 * t + 2e-6 * torch.sin(2 * math.pi * 40 * t + 0.7)


@pytest.mark.parametrize(("pulses", "cells", "finer"), [(100, 96, 2), (75, 81, 3)])
def test_points_of_a_tracked_target_lie_at_their_positions(pulses: int, cells: int, finer: int) -> None:
    """Cross range and range in 0.02 cell, at 100 m/s and with a spherical wavefront. The rotation
    during the pulse couples both: a point that recedes at x omega appears x omega f0 / gamma
    farther away, 0.03 cell at most here.
    """
    ladar = Ladar(pulses=pulses, prf_hz=1000.0, cells=cells, finer=finer)
    radar = described(ladar)
    x = torch.tensor([0.0312, -0.0407, 0.0101, -0.0153], dtype=F64)
    y = torch.tensor([-0.0203, 0.0104, 0.0255, -0.0011], dtype=F64)
    raw = echo(ladar, x, y, torch.ones(4), lambda t: tracked(t) + 1e-3, lambda t: tracked(t) + 1e-3)
    image = AzimuthTransform(radar)(Signal(compress_dechirped(raw, radar), radar.raw_axes(pulses, cells)))
    found = impulse_response(image, (x, y), centre_turns=(0.0, 0.0))
    cell = radar.wavelength_m * ladar.prf_hz / (2 * ladar.rotation_rad_s * pulses)
    assert float((found["position_azimuth_m"] - x).abs().max()) < 0.02 * cell
    coupled = x * ladar.rotation_rad_s * ladar.carrier_hz / (ladar.bandwidth_hz / ladar.pulse_s)
    assert float((found["position_range_m"] - y - coupled).abs().max()) < 0.02 * radar.range_step_m


@pytest.mark.parametrize("moving", [False, True])
def test_autofocus_is_as_good_as_on_the_simulator_of_the_package(moving: bool) -> None:
    """The same aircraft, noise and start phases: errors within 10 %, known to their size."""
    radar, shape = described(LADAR), (LADAR.pulses, LADAR.cells)
    motion = (moved, tracked) if moving else (still, still)
    draws = Draws(11, trials=range(TRIALS))
    scenes = [Aircraft(3e-3, 0.16, 0.06).scatterers(Draws(20 + i)) for i in range(TRIALS)]
    direct = [echo(LADAR, s.azimuth_m, s.range_m, s.amplitude, *motion) for s in scenes]
    own = [dechirped_echo(s, radar, *shape, LADAR.rotation_rad_s, dtype=torch.complex128) for s in scenes]
    start = draws.uniform("start", (LADAR.pulses,), 0.0, 2 * math.pi)
    error = {}
    for name, raw, true in (("direct", direct, start + LADAR.truth_rad(*motion)), ("own", own, start)):
        clean = compress_dechirped(torch.stack(raw), radar)
        noise = draws.normal("noise", shape, torch.complex128) * (0.1 * clean.abs().square().mean()).sqrt()
        data = ((clean + noise) * torch.exp(1j * start)[..., None]).to(torch.complex64)
        if moving and name == "direct":
            shifts = align_envelopes(data, tones=1)
            assert bool(shifts.ok.all())
            data = shift_range(data, -shifts["shift_cells"])
        found = autofocus(data)
        assert bool(found.ok.all())
        error[name] = phase_rmse(found["phase_rad"], true)
        ratio = found.std["phase_rad"].square().mean().sqrt() / error[name].square().mean().sqrt()
        assert 0.7 < float(ratio) < 1.5, name
    assert float(error["direct"].mean()) < 1.1 * float(error["own"].mean())
