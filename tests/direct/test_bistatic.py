"""Uncompressed bistatic echoes of an independent generator share the geometry of the package."""

from __future__ import annotations

import math

import pytest
import torch

from tests.direct.test_stripmap import peak
from torchsar.core import Chain, Draws, Signal, use
from torchsar.echo import simulate_bistatic
from torchsar.focus import range_compress
from torchsar.focus.reference import flat_reference
from torchsar.metrics import azimuth_response
from torchsar.multichannel import (
    CompressChannels,
    CorrectMigration,
    Dwell,
    ElementBeam,
    FocusAzimuth,
    LeastSquares,
    MigratingLines,
    MovingPointVelocity,
    Reconstruct,
    RemoveTransmitRange,
    Search,
)
from torchsar.radar import BistaticRadar, LinearFM
from torchsar.scene import BandLimited, BistaticWorld, MovingPoints, Pattern
from torchsar.study.bench.direct.bistatic import C, Survey, echo


@pytest.mark.parametrize("duration_s", [10e-6, 9.9931e-6])
def test_compressed_peaks_lie_at_the_receive_range_with_the_phase_of_the_path(duration_s):
    transmit = (-243.0, 0.018)
    radar = BistaticRadar(1.25e9, LinearFM(50e6, duration_s), 60e6, 180.0, 300.0, 5000.0, transmit_range=transmit)
    _, pulses, samples = radar.axes(5, 1500)
    time_s, line_m = pulses.values().numpy(), samples.values().numpy()
    for channel_m in radar.channel_m:
        raw, range_m = echo(
            time_s,
            line_m,
            carrier_hz=1.25e9,
            rate_hz_s=50e6 / duration_s,
            pulse_s=duration_s,
            speed_m_s=300.0,
            channel_m=channel_m,
            closest_m=5012.3,
            along_m=3.1,
            closing_m_s=11.0,
            transmit=transmit,
        )
        lines = range_compress(torch.from_numpy(raw), flat_reference(radar.pulse, 1500, 60e6))
        place = (range_m - samples.start) / samples.step
        assert max(abs(peak(line) - x) for line, x in zip(lines, place, strict=True)) < 0.02
        shift = torch.fft.fftfreq(1500, dtype=torch.float64) * torch.from_numpy(place)[:, None]
        at_peak = (torch.fft.fft(lines) * torch.exp(2j * math.pi * shift)).mean(-1)
        path = torch.from_numpy(range_m) + radar.transmit_range_m(torch.from_numpy(time_s))
        left = at_peak * torch.exp(2j * math.pi * torch.remainder(path / radar.wavelength_m, 1))
        assert radar.wave_speed_m_s == C and float((left - 1).abs().max()) < 0.01


@pytest.mark.slow
@pytest.mark.parametrize(("lit_s", "pulse_s"), [(2.0, 2e-6), (None, 1.9931e-6)])
def test_the_recommended_chain_works_as_on_the_simulator_of_the_package(lit_s, pulse_s):
    """Raw channels of moving points, lit by a spot or seen through the pattern of an element."""
    survey, pulses, cells = Survey(pulse_s=pulse_s), 432, 48
    radar = BistaticRadar(1.25e9, LinearFM(50e6, pulse_s), 60e6, 180.0, 300.0, 5000.0, transmit_range=survey.transmit)
    axes, long = radar.axes(pulses, cells), radar.axes(pulses, cells + 240)
    u_r, u_a, y0 = torch.tensor([[8.0, -5.0], [3.0, -2.0], [0.0, 9.0]], dtype=torch.float64)
    moves = list(zip(u_r.tolist(), u_a.tolist(), y0.tolist(), strict=True))
    line_m = long[2].values().numpy()
    raw = torch.stack([torch.from_numpy(survey.raw(pulses, line_m, *move, lit_s=lit_s)) for move in moves])
    points = MovingPoints(u_r[:, None], u_a[:, None], y0[:, None], torch.zeros(2, 1, dtype=torch.float64))
    world = BistaticWorld(points, Pattern() if lit_s is None else BandLimited(lit_s))
    draws = Draws(3, trials=range(2))
    own = simulate_bistatic(radar, world, pulses, cells, draws, dtype=torch.complex128)[0].signal
    names = ("u_r_m_s", "u_a_m_s", "y0_m")
    motion = dict.fromkeys(names, "velocity")
    aperture = ElementBeam() if lit_s is None else Dwell(lit_s)
    point = MovingPointVelocity(radar, aperture, search=Search(12.0, 5.0, 30.0, u_a_step_m_s=1.0))
    chain = Chain(
        transmit=RemoveTransmitRange(radar),
        velocity=MigratingLines(radar, point, one_line=True),
        migration=use(CorrectMigration(radar), **motion),
        rebuild=use(Reconstruct(radar, LeastSquares(2)), **motion),
        focus=use(FocusAzimuth(radar, bandwidth_hz=150.0), **motion),
    )
    noise = 0.03 * draws.normal("noise", (3, pulses, cells), torch.complex128)
    compressed = CompressChannels(radar, "flat")(Signal(raw, long)).data[..., 120 : 120 + cells]
    figures = {}
    for name, data in (("direct", compressed), ("own", own.data)):
        trace = chain.trace(Signal(data + noise, axes))
        found = trace.estimates["velocity"]
        assert bool(found.ok.all())
        for key, true in zip(names, (u_r, u_a, y0), strict=True):
            assert float(((found[key] - true).abs() / found.std[key]).max()) < 4, key
        azimuth = trace.signal.axes[0]
        rows, lines = (trace.signal.data.abs().amax(dim).argmax(-1) for dim in (-1, -2))
        through = torch.stack([x[:, i] for x, i in zip(trace.signal.data, lines.tolist(), strict=True)])
        place = [peak(x[i]) for x, i in zip(trace.signal.data, rows.tolist(), strict=True)]
        figures[name] = {**azimuth_response(through, azimuth.step), "cell": torch.tensor(place)}
    for name, most in (("irw_m", 0.02), ("pslr_db", 0.3), ("islr_db", 0.3), ("cell", 0.02)):
        assert float((figures["direct"][name] - figures["own"][name]).abs().max()) < most, name
