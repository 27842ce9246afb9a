"""Migration correction of aliased channels, against correction with the true motion."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from torchsar.core import Signal
from torchsar.metrics import impulse_response
from torchsar.multichannel import (
    CorrectMigration,
    Frame,
    Keystone,
    LeastSquares,
    NoMigration,
    PointMotion,
    StaticBulk,
    correct_migration,
    focus_azimuth,
    reconstruct,
)
from torchsar.multichannel.azimuth import image_axis
from torchsar.multichannel.reconstruct import doppler_axis
from torchsar.study.bench.direct.moving import compressed_echo, published_radar

RADAR = published_radar()
N = 960


def motion(u_r=0.0, u_a=0.0, y0=0.0, r0=None, radar=RADAR):
    return PointMotion.of(radar, torch.zeros(1), u_r, u_a, y0, r0)


def figures(signal, of, range_m):
    """Return widths on x = v t and on c tau / 2, and the peak, for the true motion."""
    spectrum = reconstruct(signal.data, RADAR, of, LeastSquares(), with_range=True)
    doppler, lines = doppler_axis(RADAR, N, 2), signal.axis("range")
    image = Signal(
        focus_azimuth(spectrum.mT, doppler.values(), RADAR, of).mT,
        (image_axis(RADAR, doppler), replace(lines, start=lines.start / 2, step=lines.step / 2)),
    )
    return impulse_response(image, (float(of.image_s) * RADAR.speed_m_s, range_m / 2), search_m=6.0)


def corrected(signal, reference, migration, ambiguity=0.0):
    return signal.with_data(correct_migration(signal.data, Frame.of(RADAR, signal), reference, migration, ambiguity))


@pytest.mark.slow
@pytest.mark.parametrize(
    "move, loss_db",
    [
        ({"u_r": 10.0}, 0.03),
        ({"u_r": 10.0, "y0": 150.0}, 0.1),
        ({"u_r": 25.0}, 0.1),
        ({"u_r": -35.0}, 0.15),
        ({"u_r": 10.0, "r0": 5800.0}, 0.03),
        ({"u_r": -10.0, "r0": 4750.0}, 0.05),
    ],
)
def test_keystone_equals_the_true_motion(move, loss_db):
    signal, of = compressed_echo(RADAR, N, 384, [move]), motion(**move)
    ambiguity = torch.tensor({25.0: 1.0, -35.0: -1.0}.get(move["u_r"], 0.0))
    lies_at = math.hypot(float(of.range_m), float(of.y0_m))
    best = figures(corrected(signal, of, StaticBulk(False)), of, float(of.range_m))
    got = figures(corrected(signal, motion(), Keystone(), ambiguity), of, lies_at)
    assert 20 * math.log10(best["peak"].abs() / got["peak"].abs()) < loss_db
    assert got["irw_azimuth_m"] == pytest.approx(float(best["irw_azimuth_m"]), rel=0.01)
    assert got["irw_range_m"] == pytest.approx(float(best["irw_range_m"]), rel=0.005)
    assert got["pslr_azimuth_db"] == pytest.approx(float(best["pslr_azimuth_db"]), abs=0.1)
    assert got["pslr_range_db"] == pytest.approx(-13.3, abs=0.2)
    assert 2 * got["position_range_m"] == pytest.approx(lies_at, abs=0.2)
    if move == {"u_r": 10.0}:  # figures of an independent float64 prototype
        assert got["irw_azimuth_m"] == pytest.approx(0.793, abs=0.004) and got["irw_range_m"] == pytest.approx(
            2.647, abs=0.02
        )


def test_loss_of_the_simpler_forms():
    move = {"u_r": 10.0, "r0": 5400.0}
    signal, of = compressed_echo(RADAR, N, 256, [move]), motion(**move)
    whole, bulk, fixed, none = (
        figures(corrected(signal, motion(), m), of, 5400.0)
        for m in (Keystone(), StaticBulk(), Keystone(whole_swath=False), NoMigration())
    )
    loss = [20 * math.log10(whole["peak"].abs() / f["peak"].abs()) for f in (fixed, bulk, none)]
    assert 0.2 < loss[0] < 0.6 and loss[1] > 10 and loss[2] > 8


def test_carrier_phases_are_unchanged():
    signal, of = compressed_echo(RADAR, 600, 128, [{"u_r": 5.0}], gate_s=3.0), motion(5.0)
    out = corrected(signal, motion(), Keystone()).data[:, 100:500, 64]
    t = Frame.of(RADAR, signal).time_s[100:500]
    dx = torch.tensor(RADAR.channel_m, dtype=torch.float64)[:, None]
    path = torch.sqrt((5000 - 5 * t) ** 2 + (300 * t - dx) ** 2) - 5000
    residual = out * torch.exp(2j * math.pi * path / 0.24)
    assert torch.angle(residual).abs().max() < 0.05 and (residual.abs() - 1).abs().max() < 0.05
    assert of.u_r_m_s == 5


def test_a_reference_that_moves_needs_no_ambiguity_number():
    signal, of = compressed_echo(RADAR, N, 128, [{"u_r": 30.0, "u_a": 8.0}]), motion(30.0, 8.0)
    stage = CorrectMigration(RADAR)
    got, best = (
        figures(stage(signal, u_r_m_s=30.0, u_a_m_s=8.0), of, 5000.0),
        figures(corrected(signal, of, StaticBulk()), of, 5000.0),
    )
    assert got["peak"].abs() == pytest.approx(float(best["peak"].abs()), rel=2e-3)


def test_references_and_ambiguities_per_trial():
    signal = compressed_echo(RADAR, 60, 64, [{"u_r": 25.0}, {"r0": 5100.0}], gate_s=0.25)
    both = signal.with_data(torch.stack([signal.data, 2 * signal.data]))
    values = {"u_r_m_s": torch.tensor([0.0, 3.0]), "y0_m": torch.tensor([0.0, 10.0]), "ambiguity": torch.tensor([1, 0])}
    for migration in (Keystone(), Keystone(False), StaticBulk(), NoMigration()):
        stage = CorrectMigration(RADAR, migration)
        together = stage(both, **values)
        for i in range(2):
            alone = stage(both.with_data(both.data[i]), **{name: value[i] for name, value in values.items()})
            torch.testing.assert_close(together.data[i], alone.data, atol=1e-12, rtol=0)
        half = stage(both.to(torch.complex64), **values).data
        assert half.dtype == torch.complex64 and (half - together.data).norm() < 1e-4 * together.data.norm()


@pytest.mark.parametrize("migration", [Keystone(), Keystone(False), StaticBulk()])
def test_gradients(migration):
    radar = published_radar(channel_m=(-0.8, 0.8))
    signal = compressed_echo(radar, 6, 16, [{"u_r": 10.0}], gate_s=1.0)
    frame = Frame.of(radar, signal)

    def run(data, u_r):
        return correct_migration(data, frame, PointMotion.of(radar, data, u_r, 0.0, 100.0), migration)

    assert torch.autograd.gradcheck(
        run,
        (signal.data.requires_grad_(), torch.tensor(4.0, dtype=torch.float64, requires_grad=True)),
        atol=1e-5,
        fast_mode=True,
    )


def test_data_of_other_axes_are_rejected():
    signal = compressed_echo(RADAR, 8, 16, [{}])
    with pytest.raises(ValueError, match=r"data \(\.\.\., 3, 8, 16\).*got shape \(2, 8, 16\)"):
        correct_migration(signal.data[:2], Frame.of(RADAR, signal), motion())
