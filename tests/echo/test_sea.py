"""Echo of a sea against direct summation; its power, channels, precision and draws."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import pytest
import torch
from torch import Tensor

from torchsar.core import Draws
from torchsar.echo import simulate_bistatic
from torchsar.echo.sea import _Light, _Lines, sea_echo
from torchsar.radar import LIGHT_M_S, BistaticRadar
from torchsar.radar.bistatic import receive_range
from torchsar.scene import BandLimited, BistaticWorld, ImageReflectivity, KSea, Pattern
from torchsar.scene.sea import Sea
from torchsar.study.bench.direct.moving import published_radar


def geo_radar(**changes: Any) -> BistaticRadar:
    """The receiver of Remote Sens. 2020, 12, 1703, with a transmit range that a sea lacks."""
    return published_radar(**{"transmit_range": (-243.0, 0.03), "wave_speed_m_s": LIGHT_M_S, **changes})


@dataclass(frozen=True)
class Bright(Sea):
    """A surface of zero with cells of one near given positions; `found` holds where they lie."""

    positions: tuple[tuple[float, float], ...] = ()
    found: list[tuple[float, float]] = field(default_factory=list)

    def texture(self, azimuth_m: Tensor, range_m: Tensor, draws: Draws) -> tuple[Tensor, Tensor, Tensor]:
        raise NotImplementedError

    def reflectivity(
        self, azimuth_m: Tensor, range_m: Tensor, draws: Draws, dtype: torch.dtype = torch.complex64
    ) -> Tensor:
        cells = torch.zeros(len(azimuth_m), len(range_m), dtype=dtype)
        for azimuth, distance in self.positions:
            i, j = int((azimuth_m - azimuth).abs().argmin()), int((range_m - distance).abs().argmin())
            cells[i, j] = 1
            self.found.append((float(azimuth_m[i]), float(range_m[j])))
        return cells


def direct(
    radar: BistaticRadar,
    points: list[tuple[float, float]],
    n_pulse: int,
    n_range: int | None,
    gate: BandLimited | Pattern,
) -> Tensor:
    """Sum over points, one after the other, complex128.

    The carrier has the phase of the exact range; the band of the pulse uses the same bins.
    """
    time_s, dx, wavelength = (
        radar.pulse_axis(n_pulse).values()[:, None],
        radar.channels_at()[:, None, None],
        radar.wavelength_m,
    )
    frequency_hz, share = _Lines.of(radar, n_range, _Light.of(gate, radar, 1).last_sin).band(None)
    samples_m = torch.zeros(1) if n_range is None else (torch.arange(n_range) - n_range // 2) * radar.range_step_m
    per_metre = 2j * math.pi / LIGHT_M_S * frequency_hz
    total = torch.zeros((), dtype=torch.complex128)
    for y, offset in points:
        closest = radar.reference_range_m + offset
        beyond = receive_range(time_s, 0.0, 0.0, y, closest, radar.speed_m_s, dx) + offset
        along = radar.speed_m_s * time_s - y - dx
        element = None if isinstance(gate, BandLimited) else gate.element_m or radar.element_m
        weight = (
            (along.abs() < 675).double()
            if element is None
            else torch.sinc(element / wavelength * along / (closest + beyond - offset))
        )
        response = torch.exp(-beyond * per_metre) @ (
            share[:, None] / share.sum() * torch.exp(per_metre[:, None] * samples_m)
        )
        total = total + weight / math.sqrt(closest) * response * torch.exp(-2j * math.pi / wavelength * beyond)
    return total if n_range is not None else total[..., 0]


def mismatch_db(x: Tensor, reference: Tensor) -> float:
    """Error of x against a reference, after scaling by one complex number."""
    scale = (reference.conj() * x).sum() / reference.abs().square().sum()
    return float(
        20 * torch.log10(torch.linalg.vector_norm(x / scale - reference) / torch.linalg.vector_norm(reference))
    )


POSITIONS = ((60.0, 35.0), (-110.0, -50.0), (3.0, 90.0))
GATES = {"pattern": (Pattern(), -100.0), "long element": (Pattern(1.0), -98.0), "band": (BandLimited(4.5), -36.0)}


@pytest.mark.slow
@pytest.mark.parametrize("gate, limit_db", GATES.values(), ids=list(GATES))
@pytest.mark.parametrize("n_pulse, n_range", [(240, 64), (181, 51)])
def test_points_lie_and_migrate_as_by_direct_summation(gate, limit_db, n_pulse, n_range):
    """Three unevenly spaced channels: carrier phases, range migration and the order of channels.

    The edges of the band leave a Fresnel ripple.
    """
    radar, sea = geo_radar(channel_m=(-0.8, 0.0, 1.1)), Bright(positions=POSITIONS, margin_s=3.5)
    x = sea_echo(sea, radar, n_pulse, n_range, gate, Draws(1), torch.complex128)
    assert x.shape == (3, n_pulse, n_range)
    assert mismatch_db(x, direct(radar, sea.found, n_pulse, n_range, gate)) < limit_db


@pytest.mark.parametrize("gate, limit_db", [(Pattern(), -100.0), (BandLimited(4.5), -36.0)])
def test_a_line_agrees_with_direct_summation(gate, limit_db):
    radar, sea = geo_radar(channel_m=(1.1, 0.0, -0.8)), Bright(positions=((60.0, 0.0), (-110.0, 0.0)), margin_s=3.5)
    x = sea_echo(sea, radar, 240, None, gate, Draws(1), torch.complex128)
    assert mismatch_db(x, direct(radar, sea.found, 240, None, gate)) < limit_db


def test_a_side_lobe_appears_where_direct_summation_puts_it():
    """A point that is closest 7 s after the record is illuminated by the first side lobe only.

    It is absent for lobes=1 and present for lobes=2.
    """
    first, second = (Bright(positions=((2200.0, 0.0),), margin_s=14.0, lobes=lobes) for lobes in (1, 2))
    without, with_lobe = (
        sea_echo(sea, geo_radar(), 90, None, Pattern(), Draws(1), torch.complex128) for sea in (first, second)
    )
    assert float(without.abs().max() / with_lobe.abs().max()) < 1e-3
    assert mismatch_db(with_lobe, direct(geo_radar(), second.found, 90, None, Pattern())) < -50


@pytest.mark.slow
@pytest.mark.parametrize("gate", [BandLimited(4.5), Pattern()])
def test_cells_beyond_a_frame_do_not_wrap(gate):
    """Cells that migrate past the far end leave side lobes at most.

    So do cells 12 samples beyond either end at their closest range.
    """
    inside, near, far = (
        sea_echo(Bright(positions=((0.0, m),), margin_s=3.5), geo_radar(), 900, 24, gate, Draws(1), torch.complex128)
        for m in (0.0, -120.0, 115.0)
    )
    assert float(far.abs().max() / inside.abs().max()) < 0.05
    assert float(near[:, 400:500].abs().max() / inside.abs().max()) < 0.05
    assert float(inside[..., :8].abs().max() / inside.abs().max()) < 0.1


FRAMES = {"line": None, "frame": 24, "one sample": 1}


@pytest.mark.slow
@pytest.mark.parametrize("gate", [BandLimited(4.5), Pattern(), BandLimited(20.0)], ids=["band", "pattern", "wide band"])
@pytest.mark.parametrize("n_range", FRAMES.values(), ids=list(FRAMES))
def test_power_of_a_sample_is_the_given_one(gate, n_range):
    """In all trials, at both ends of a frame, in every channel and at the first pulses."""
    power_db = torch.tensor([-30.0, 20.0], dtype=torch.float64).repeat_interleave(8)
    x = sea_echo(
        KSea(math.inf, power_db=power_db, margin_s=0.1), geo_radar(), 40, n_range, gate, Draws(2, trials=range(16))
    )
    level = (x.abs().square().double() / 10 ** (power_db / 10).reshape(-1, *(1 for _ in x.shape[1:]))).reshape(
        16, 3, 40, -1
    )
    assert float(level.mean()) == pytest.approx(1, abs=0.03 if n_range == 24 else 0.1)
    assert float(level[:8].mean()) == pytest.approx(1, abs=0.15) and float(level[8:].mean()) == pytest.approx(
        1, abs=0.15
    )
    if n_range == 24:
        for part in (level[..., :3], level[..., -3:], level[:, :, :8], *level.unbind(1)):
            assert float(part.mean()) == pytest.approx(1, abs=0.1)


def test_a_sea_lies_in_the_band_of_its_gate():
    """At a pulse rate above the band of 337.5 Hz a periodic sea has no power beside the band."""
    radar = geo_radar(prf_hz=450.0)
    x = sea_echo(KSea(margin_s=0.0), radar, 600, None, BandLimited(4.5), Draws(3), torch.complex128)
    power = torch.fft.fft(x).abs().square().mean(0)
    doppler = torch.fft.fftfreq(600, 1 / 450.0, dtype=torch.float64)
    inside = doppler.abs() <= 300.0**2 * 4.5 / (2 * radar.wavelength_m * 5000)
    assert float(power[~inside].max() / power[inside].mean()) < 1e-20 and int(inside.sum()) == 451
    assert float(power[inside & (doppler > 0)].sum() / power[inside].sum()) == pytest.approx(0.5, abs=0.1)


def test_channels_are_one_delayed_signal():
    """At a pulse rate above the band channel m lags by dx_m / V, exactly for a periodic sea."""
    radar = geo_radar(prf_hz=450.0, channel_m=(-0.8, 0.0, 1.3))
    x = torch.fft.fft(
        sea_echo(KSea(margin_s=0.0), radar, 300, 20, BandLimited(4.5), Draws(3), torch.complex128), dim=-2
    )
    doppler = torch.fft.fftfreq(300, 1 / 450.0, dtype=torch.float64)[:, None]
    for m, dx in enumerate(radar.channel_m):
        torch.testing.assert_close(
            x[m], x[1] * torch.exp(-2j * math.pi * doppler * dx / 300.0), rtol=0, atol=1e-9 * float(x.abs().max())
        )


@pytest.mark.parametrize("gate", [BandLimited(4.5), Pattern()])
@pytest.mark.parametrize("n_range", [None, 40])
def test_single_precision_agrees_with_double(gate, n_range):
    single, double = (
        sea_echo(KSea(), geo_radar(), 100, n_range, gate, Draws(4), dtype)
        for dtype in (torch.complex64, torch.complex128)
    )
    assert single.dtype == torch.complex64
    assert float(torch.linalg.vector_norm(single - double) / torch.linalg.vector_norm(double)) < 2e-6


@pytest.mark.parametrize("n_range", [None, 12])
def test_trials_are_independent(n_range):
    power_db = torch.tensor([0.0, 30.0, -20.0, 5.0], dtype=torch.float64)
    args = (geo_radar(), 50, n_range, BandLimited(4.5))
    whole = sea_echo(KSea(power_db=power_db), *args, Draws(5, trials=range(4)), torch.complex128)
    part = sea_echo(KSea(power_db=power_db[[3, 1]]), *args, Draws(5, trials=[3, 1]), torch.complex128)
    alone = sea_echo(KSea(power_db=30.0), *args, Draws(5, trials=[1]), torch.complex128)
    unbatched = sea_echo(KSea(), *args, Draws(5), torch.complex128)
    assert whole.shape == (4, 3, 50) + (() if n_range is None else (n_range,)) and unbatched.shape == whole.shape[1:]
    for x, expected in ((part, whole[[3, 1]]), (alone, whole[1:2]), (unbatched, whole[0])):
        torch.testing.assert_close(x, expected, rtol=0, atol=1e-12 * float(expected.abs().max()))
    assert float((whole[0] - whole[3]).abs().max()) > 0.1


def test_gradients_reach_power_and_image():
    image, power = (
        torch.rand(3, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(1)).add(0.1).requires_grad_(),
        torch.tensor(3.0, dtype=torch.float64, requires_grad=True),
    )

    def echo(image: Tensor, power: Tensor) -> Tensor:
        return sea_echo(
            ImageReflectivity(image, 300.0, 60.0, power_db=power, margin_s=0.0),
            geo_radar(),
            8,
            3,
            BandLimited(1.0),
            Draws(6),
            torch.complex128,
        )

    assert torch.autograd.gradcheck(echo, (image, power))


@pytest.mark.parametrize(
    "n_range, gate, error, sentence",
    [
        (2100, Pattern(), ValueError, "got 2100 samples about the reference range of 5000 m, which begin at -"),
        (
            None,
            BandLimited(30.0),
            ValueError,
            "at or below 0.8, got 30 s, which reaches a sine of 0.9 at the reference range of 5000 m",
        ),
        (None, "pattern", TypeError, "gate of a sea must be BandLimited"),
    ],
)
def test_impossible_frames_and_gates_are_refused(n_range, gate, error, sentence):
    with pytest.raises(error, match=sentence):
        sea_echo(KSea(), geo_radar(), 20, n_range, gate, Draws(1))


def test_a_frame_near_the_receiver_is_finite():
    x = sea_echo(
        KSea(margin_s=0.0), geo_radar(reference_range_m=400.0, height_m=100.0), 16, 150, BandLimited(0.5), Draws(1)
    )
    assert bool(torch.isfinite(torch.view_as_real(x)).all()) and float(x.abs().square().mean()) == pytest.approx(
        1, abs=0.2
    )


@pytest.mark.parametrize("shape, moment", [(1.5, 10 / 3), (math.inf, 2.0)])
def test_a_focused_line_is_k_distributed_where_it_resolves_the_texture(shape, moment):
    """At a resolution of 0.79 m in cells of 40 m, <I^2> / <I>^2 = 2 (1 + 1 / shape)."""
    radar = geo_radar(prf_hz=450.0)
    x = sea_echo(
        KSea(shape, cell_m=(40.0, 20.0), margin_s=0.0),
        radar,
        600,
        None,
        BandLimited(4.5),
        Draws(7, trials=range(400)),
        torch.complex128,
    )[:, 1]
    doppler = torch.fft.fftfreq(600, 1 / 450.0, dtype=torch.float64)
    root = torch.sqrt((1 / radar.wavelength_m) ** 2 - (doppler / 300.0) ** 2)
    image = torch.fft.ifft(torch.fft.fft(x) * torch.exp(2j * math.pi * 5000.0 * (root - 1 / radar.wavelength_m)))
    intensity = image.abs().square()
    assert float(intensity.square().mean() / intensity.mean() ** 2) == pytest.approx(moment, rel=0.12)


@pytest.mark.parametrize("n_range", [None, 16])
def test_a_simulated_world_holds_the_sea_under_the_transmit_range(n_range):
    radar, sea = geo_radar(), KSea(power_db=-10.0)
    recording, _ = simulate_bistatic(
        radar, BistaticWorld(None, Pattern(), sea=sea), 30, n_range, Draws(8, trials=range(2)), dtype=torch.complex128
    )
    alone = sea_echo(sea, radar, 30, n_range, Pattern(), Draws(8, trials=range(2)).part("sea"), torch.complex128)
    turns = -radar.transmit_range_m(radar.pulse_axis(30).values()) / radar.wavelength_m
    carrier = torch.exp(2j * math.pi * turns)
    torch.testing.assert_close(
        recording.signal.data, alone * (carrier if n_range is None else carrier[:, None]), rtol=0, atol=1e-9
    )
