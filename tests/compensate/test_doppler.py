"""Doppler centroid, ambiguity and velocity: known answers and the required accuracies."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.repair import test_placing as placing
from torchsar.compensate import (
    DopplerCentroid,
    EffectiveVelocity,
    EnergyCentre,
    PhaseIncrement,
    doppler_assess,
    energy_centre,
    phase_increment,
    point_doppler,
    velocity_assess,
)
from torchsar.compensate.aperture import _noise_variance
from torchsar.compensate.doppler import lag_products
from torchsar.compensate.group import BeamSpectrum
from torchsar.compensate.velocity import velocity_objective
from torchsar.core import Chain, Draws, Outcome, Recording, Signal, use
from torchsar.echo import simulate
from torchsar.focus import OmegaK
from torchsar.io import read_stripmap
from torchsar.metrics import beam_centre_bound_hz, reference_doppler_std_hz, tone_frequency_bound_hz, velocity_bound_m_s
from torchsar.optim.scalar import grid_minimum, parabola_minimum
from torchsar.radar import LIGHT_M_S, LinearFM, StripmapRadar
from torchsar.scene import Dwell, Points, RandomPoints, Scene, Speckle, StripmapWorld

PRF = 1000.0


def kondor(dwell_s: float = 0.3, squint_deg: float = 0.3) -> StripmapRadar:
    pointing = 2 * 7000 * math.sin(math.radians(squint_deg)) / (LIGHT_M_S / 3.2e9)
    return StripmapRadar(
        3.2e9, LinearFM(200e6, 2e-6), 250e6, 4000.0, 7000.0, 700e3, pointing_doppler_hz=pointing, integration_s=dwell_s
    )


def strip(
    radar: StripmapRadar,
    lines: int,
    samples: int,
    points: int = 24,
    trials: int = 2,
    velocity: float = 7000.0,
    seed: int = 1,
    snr_db: float = -5.0,
) -> tuple[Recording, torch.Tensor]:
    doppler = (radar.pointing_doppler_hz or 0.0) + torch.linspace(-40, 40, trials, dtype=torch.float64)
    scene = RandomPoints(points, lines * 7000 / 4000, 150.0)
    world = StripmapWorld(
        scene, beam=Dwell(radar.integration_s or 1.0), velocity_m_s=velocity, doppler_hz=doppler, snr_db=snr_db
    )
    return simulate(radar, world, lines, samples, Draws(seed, trials=range(trials)))[0], doppler


def coloured(
    seed: int, centre_hz: float, shape: tuple[int, int] = (2048, 1024), band_hz: float = 500.0
) -> torch.Tensor:
    """Uniform speckle with a rectangular azimuth band about centre_hz, and noise 20 dB below."""
    generator = torch.Generator().manual_seed(seed)
    x = torch.fft.fft(torch.randn(shape, generator=generator, dtype=torch.complex64), dim=0)
    frequency = torch.fft.fftfreq(shape[0], 1 / PRF, dtype=torch.float64)
    offset = torch.remainder(frequency - centre_hz + PRF / 2, PRF) - PRF / 2
    x = torch.fft.ifft(x * (offset.abs() < band_hz / 2)[:, None], dim=0)
    return x + 0.07 * torch.randn(shape, generator=generator, dtype=torch.complex64)


@pytest.mark.parametrize(("seed", "centre"), [(0, 120.0), (1, 490.0), (2, -377.0)])
def test_both_estimators_are_within_one_hertz_on_uniform_scenes(seed: int, centre: float) -> None:
    x = coloured(seed, centre)
    increment, energy = phase_increment(x, PRF), energy_centre(x, PRF)
    for estimate in (increment, energy):
        error = float(estimate["doppler_baseband_hz"]) - centre
        assert abs(error - PRF * round(error / PRF)) < 1.0
        assert bool(estimate.ok)
    assert abs(float(increment["doppler_baseband_hz"] - energy["doppler_baseband_hz"])) < 0.01


def test_block_increments_are_returned_along_the_strip() -> None:
    estimate = phase_increment(coloured(0, 120.0, (512, 256)), PRF, blocks=(8, 4))
    assert estimate.info["block_hz"].shape == (8, 4)
    assert (estimate.info["block_hz"] - 120).abs().max() < 60


def test_missing_lines_do_not_bias() -> None:
    x = coloured(3, 120.0)
    holed = x.clone()
    holed[torch.randperm(2048, generator=torch.Generator().manual_seed(0))[:100]] = 0
    for estimator in (phase_increment, energy_centre):
        assert abs(float(estimator(holed, PRF)["doppler_baseband_hz"]) - 120) < 1.0


@pytest.mark.parametrize(("dwell", "most"), [(None, 0.7), (0.8, 0.4)])  # 1.6 and 2.3 Hz if gaps count for nothing
def test_a_gap_takes_parts_of_dwells_without_much_bias(dwell: float | None, most: float) -> None:
    raw = torch.from_numpy(placing.echoes(np.arange(placing.LINES) / placing.PRF, 0.0)).to(torch.complex64)
    raw = raw + 0.05 * torch.randn(raw.shape, generator=torch.Generator().manual_seed(0), dtype=raw.dtype)
    find, found = DopplerCentroid(replace(placing.sensor(placing.PRF, 0.0), integration_s=dwell)), []
    for first in (placing.LINES, 80, 180, 250, 330, 410):
        holed = raw.clone()
        holed[first : first + 60] = 0
        found.append(find(Signal(holed, find.radar.raw_axes(*raw.shape))))
    errors = torch.stack([one["doppler_hz"] - found[0]["doppler_hz"] for one in found[1:]])
    assert float(errors.square().mean().sqrt()) < most
    assert bool((errors.abs() < 2 * torch.stack([one.std["doppler_hz"] for one in found[1:]])).all())


def test_predicted_std_covers_the_scatter_over_seeds() -> None:
    estimates = [phase_increment(coloured(seed, 120.0, (256, 64)), PRF) for seed in range(40)]
    errors = torch.stack([e["doppler_baseband_hz"] - 120 for e in estimates])
    predicted = torch.stack([e.std["doppler_baseband_hz"] for e in estimates]).mean()
    assert 0.6 < float(errors.std() / predicted) < 1.6


def test_an_empty_trial_and_extreme_scales_do_not_affect_other_trials() -> None:
    x = torch.stack(
        [
            coloured(0, 120.0, (256, 64)),
            torch.zeros(256, 64, dtype=torch.complex64),
            coloured(1, -200.0, (256, 64)) * 1e25,
        ]
    )
    estimate = phase_increment(x, PRF)
    alone = phase_increment(x[0], PRF)
    torch.testing.assert_close(estimate["doppler_baseband_hz"][0], alone["doppler_baseband_hz"])
    assert estimate.ok.tolist() == [True, False, True]
    assert torch.isfinite(estimate["doppler_baseband_hz"]).all()
    assert abs(float(estimate["doppler_baseband_hz"][2]) + 200) < 10


@pytest.mark.parametrize("rate", [0.0, 1494.0])
@pytest.mark.parametrize("snr_db", [-8.0, 10.0])
def test_point_doppler_error_lies_between_the_bound_and_the_papers_curve(rate: float, snr_db: float) -> None:
    n, prf, trials = 1024, 4000.0, 300
    generator = torch.Generator().manual_seed(5)
    t = (torch.arange(n, dtype=torch.float64) - (n - 1) / 2) / prf
    f = 3000 * (torch.rand(trials, generator=generator, dtype=torch.float64) - 0.5)
    x = torch.exp(2j * math.pi * (f[:, None] * t - 0.5 * rate * t.square()))
    x = x + 10 ** (-snr_db / 20) * torch.randn(trials, n, generator=generator, dtype=torch.complex128)
    std = (point_doppler(x, prf, rate) - f).square().mean().sqrt()
    q = n * 10 ** (snr_db / 10)
    assert float(std) <= float(reference_doppler_std_hz(q, n / prf))
    assert float(std) >= 0.7 * float(tone_frequency_bound_hz(q, n / prf))


def test_bounds_have_the_known_values() -> None:
    assert float(tone_frequency_bound_hz(1e4, 1.5)) == pytest.approx(0.39 / 150, rel=0.01)
    assert float(reference_doppler_std_hz(1e4, 1.5)) == pytest.approx(1 / 150)
    assert float(velocity_bound_m_s(1e4, 1.0, 7000.0, 0.0937, 700e3)) == pytest.approx(0.0707, rel=0.01)
    cosine = torch.cos(torch.linspace(-math.pi / 2, math.pi / 2, 4001, dtype=torch.float64))
    assert float(beam_centre_bound_hz(cosine, 1e4, 1494.0, 4000.0)) == pytest.approx(
        1494 / math.sqrt(2e4) / math.pi, rel=0.01
    )


def test_scalar_optimisers_find_the_minimum_of_each_trial() -> None:
    target = torch.tensor([-3.3, 0.02, 4.1], dtype=torch.float64)

    def cost(x: torch.Tensor) -> torch.Tensor:
        return torch.log1p((x - target).square()) + 0.1 * (x - target).square()

    coarse, costs = grid_minimum(cost, torch.zeros(3, dtype=torch.float64), 6.0, 7)
    assert costs.shape == (3, 7)
    value, curvature = parabola_minimum(cost, coarse, 2.0, 1e-4)
    torch.testing.assert_close(value, target, atol=2e-3, rtol=0)
    torch.testing.assert_close(curvature, torch.full((3,), 2.2, dtype=torch.float64), atol=0.2, rtol=0)


@pytest.mark.slow
@pytest.mark.parametrize(("squint", "ambiguity", "seed"), [(0.0, 0, 1), (0.3, 0, 2), (2.0, 1, 3)])
def test_centroid_of_points_cut_by_the_ends_of_the_strip(squint: float, ambiguity: int, seed: int) -> None:
    radar = kondor(0.3, squint)
    recording, truth = strip(radar, 2048, 1024, seed=seed)
    estimate = DopplerCentroid(radar)(recording.signal)
    assert estimate.ok.all()
    assert estimate["ambiguity"].tolist() == [ambiguity] * 2
    assert (estimate["doppler_hz"] - truth).abs().max() < 5
    blind = phase_increment(recording.signal.data, radar.prf_hz)["doppler_baseband_hz"]
    assert (estimate["doppler_baseband_hz"] - truth + 4000 * ambiguity).abs().max() < (
        blind - truth + 4000 * ambiguity
    ).abs().max()
    exact = torch.rad2deg(torch.asin(radar.sin_squint(truth)))
    assert (estimate["squint_deg"] - exact).abs().max() < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("off", [-58.0, 58.0])
def test_velocity_within_a_third_of_a_metre_per_second(off: float) -> None:
    radar = kondor(0.8)
    recording, _ = strip(radar, 4096, 900, trials=1, velocity=7000 + off)
    chain = Chain(
        doppler=DopplerCentroid(radar),
        velocity=use(EffectiveVelocity(OmegaK(radar), lines=256), doppler_hz="doppler"),
    )
    estimate = chain.trace(recording).estimates["velocity"]
    assert abs(float(estimate["velocity_m_s"]) - 7000 - off) < 0.3
    assert bool(estimate.ok)


def test_gradient_of_the_objective_is_the_slope() -> None:
    radar = kondor()
    recording, truth = strip(radar, 1536, 800)
    raw = recording.signal.data.to(torch.complex128)
    stage = EffectiveVelocity(OmegaK(radar), lines=128)
    group, dwell = stage.group(raw)
    blocks = velocity_objective(group, truth, dwell)
    v = torch.full((2,), 7020.0, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(blocks(v).sum(), v)
    with torch.no_grad():
        numeric = (blocks(v + 0.01) - blocks(v - 0.01)).sum(-1) / 0.02
    torch.testing.assert_close(slope, numeric, rtol=1e-4, atol=1e-9)


def test_a_batch_equals_single_trials_and_an_empty_trial_is_not_ok() -> None:
    radar = kondor()
    recording, _ = strip(radar, 1536, 800)
    data = torch.cat([recording.signal.data, torch.zeros_like(recording.signal.data[:1])])
    signal = recording.signal.with_data(data)
    doppler = DopplerCentroid(radar)(signal)
    velocity = EffectiveVelocity(OmegaK(radar), lines=128)(signal, doppler_hz=doppler["doppler_hz"])
    assert not bool(doppler.ok[2]) and not bool(velocity.ok[2])
    for estimate in (doppler, velocity):
        assert all(torch.isfinite(value).all() for value in estimate.value.values())
    single = signal.with_data(data[1])
    alone = DopplerCentroid(radar)(single)
    torch.testing.assert_close(alone["doppler_hz"], doppler["doppler_hz"][1], atol=1e-2, rtol=0)
    fast = EffectiveVelocity(OmegaK(radar), lines=128)(single, doppler_hz=alone["doppler_hz"])
    torch.testing.assert_close(fast["velocity_m_s"], velocity["velocity_m_s"][1], atol=0.05, rtol=0)


BLOCKS = [
    ("radarsat1_english_bay.npz", (0, 1424), (0, 2848), 488.0),
    ("radarsat1_english_bay.npz", (200, 1224), (300, 2200), None),
    ("radarsat1_squamish.npz", (0, 1536), (0, 2048), 549.0),
    ("radarsat1_squamish.npz", (400, 1424), (100, 2000), None),
]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "lines", "columns", "baseband"), BLOCKS)
def test_recorded_blocks_without_prior_knowledge(
    recorded, name: str, lines: tuple[int, int], columns: tuple[int, int], baseband: float | None
) -> None:
    recording = read_stripmap(recorded(name))
    radar = replace(
        recording.radar, near_range_m=recording.radar.near_range_m + columns[0] * recording.radar.range_step_m
    )
    signal = recording.signal.isel(pulse=slice(*lines), range=slice(*columns))
    doppler = DopplerCentroid(radar)(signal)
    assert bool(doppler.ok)
    assert float(doppler["ambiguity"]) == -6
    if baseband is not None:
        assert abs(float(doppler["doppler_baseband_hz"]) - baseband) < 5
        assert abs(float(doppler["doppler_hz"]) - (-7050 if baseband < 500 else -6990)) < 25
        for stage in (PhaseIncrement(radar), EnergyCentre(radar)):
            assert abs(float(stage(signal)["doppler_baseband_hz"]) - baseband) < 5
    velocity = EffectiveVelocity(OmegaK(radar))(signal, doppler_hz=doppler["doppler_hz"])
    assert abs(float(velocity["velocity_m_s"]) - 7066) < 3
    assert bool(velocity.ok)


SATELLITE = StripmapRadar(
    3.2e9, LinearFM(50e6, 1e-6), 62.5e6, 1000.0, 7000.0, 700e3, pointing_doppler_hz=652.0, integration_s=0.3
)
AIRCRAFT = StripmapRadar(
    3.2e9, LinearFM(40e6, 0.5e-6), 50e6, 400.0, 120.0, 4000.0, pointing_doppler_hz=0.0, integration_s=1.0
)


@pytest.mark.parametrize(
    "scene, snr_db", [(Speckle(200, 600.0, 60.0), 0.0), (Points([0.0], [0.0], random_phase=True), 20.0)]
)
def test_velocity_is_ok_when_the_search_is_narrower_than_the_minimum(scene: Scene, snr_db: float) -> None:
    """The minimum is 200 m/s wide here; 60 m/s are searched."""
    doppler = torch.full((8,), 652.0, dtype=torch.float64)
    world = StripmapWorld(scene, Dwell(0.3), velocity_m_s=7003.0, doppler_hz=doppler, snr_db=snr_db)
    signal = simulate(SATELLITE, world, 512, 192, Draws(11, trials=range(8)))[0].signal
    found = EffectiveVelocity(OmegaK(SATELLITE), 30.0, 128)(signal, doppler)
    assert bool(found.ok.all())
    rms = (found["velocity_m_s"] - 7003).square().mean().sqrt()
    assert 0.5 < float(rms / found.std["velocity_m_s"].square().mean().sqrt()) < 1.6


def test_velocity_search_focuses_the_group_thirteen_times(monkeypatch: pytest.MonkeyPatch) -> None:
    """The nominal velocity, four others, three to refine, three about the minimum, two of depth."""
    calls, rows = [], BeamSpectrum.rows
    monkeypatch.setattr(BeamSpectrum, "rows", lambda *args: (calls.append(1), rows(*args))[1])
    doppler = torch.full((2,), 652.0, dtype=torch.float64)
    world = StripmapWorld(Points([0.0], [0.0]), Dwell(0.3), velocity_m_s=7003.0, doppler_hz=doppler, snr_db=20.0)
    signal = simulate(SATELLITE, world, 512, 192, Draws(16, trials=range(2)))[0].signal
    found = EffectiveVelocity(OmegaK(SATELLITE), 30.0, 128)(signal, doppler)
    assert bool(found.ok.all()) and len(calls) == 13


def test_a_cost_that_is_known_in_the_middle_of_a_grid_is_not_computed_again() -> None:
    points: list[float] = []

    def cost(x: torch.Tensor) -> torch.Tensor:
        points.extend(x.tolist())
        return (x - 0.4).square()

    centre = torch.zeros(1, dtype=torch.float64)
    whole = grid_minimum(cost, centre, 2.0, 5)
    points.clear()
    for found, expected in zip(grid_minimum(cost, centre, 2.0, 5, cost(centre)), whole, strict=True):
        torch.testing.assert_close(found, expected)
    assert sorted(points) == [-2.0, -1.0, 0.0, 1.0, 2.0]
    with pytest.raises(ValueError, match=r"an odd number .* got 4"):
        grid_minimum(cost, centre, 2.0, 4, cost(centre))


def test_velocity_without_an_image_is_not_ok() -> None:
    """Noise in a narrow search, clutter that fills the band, a record shorter than the dwell."""
    noise = Draws(12, trials=range(6)).normal("alone", (512, 192), torch.complex64)
    stage = EffectiveVelocity(OmegaK(SATELLITE), 30.0, 128)
    doppler = torch.full((6,), 652.0, dtype=torch.float64)
    off = SATELLITE.doppler_hz(512, doppler)[0] - 652.0
    clutter = torch.fft.ifft(torch.fft.fft(noise, dim=-2) * (off.abs() < 130)[:, None], dim=-2)
    for data in (noise, clutter):
        assert not bool(stage(Signal(data, SATELLITE.raw_axes(512, 192)), doppler).ok.any())
    world = StripmapWorld(RandomPoints(24, 230.0, 150.0), Dwell(1.0), doppler_hz=doppler * 0, snr_db=10.0)
    signal = simulate(AIRCRAFT, world, 230, 192, Draws(13, trials=range(6)))[0].signal
    assert not bool(EffectiveVelocity(OmegaK(AIRCRAFT), 25.0)(signal, doppler * 0).ok.any())


def aircraft(scene: Scene, trials: int = 16, seed: int = 15, snr_db: float = 20.0) -> tuple[Signal, torch.Tensor]:
    doppler = torch.linspace(-40, 40, trials, dtype=torch.float64)
    world = StripmapWorld(scene, Dwell(1.0), velocity_m_s=120.0, doppler_hz=doppler, snr_db=snr_db)
    return simulate(AIRCRAFT, world, 768, 192, Draws(seed, trials=range(trials)))[0].signal, doppler


@pytest.mark.parametrize("dwell_s", [1.0, None])
def test_the_deviation_of_an_increment_includes_apertures_cut_at_one_end(dwell_s: float | None) -> None:
    """All targets are seen near the end of the record, where half of them are cut."""
    signal, doppler = aircraft(RandomPoints(40, 150.0, 200.0, azimuth_m=60.0, spread_db=6.0))
    for stage in (PhaseIncrement, EnergyCentre):
        found = stage(replace(AIRCRAFT, integration_s=dwell_s))(signal)
        error = found["doppler_baseband_hz"] - doppler
        rms = error.square().mean().sqrt()
        assert float(rms) > 3 and bool(found.ok.any())
        assert 0.67 < float(rms / found.std["doppler_baseband_hz"].square().mean().sqrt()) < 1.43
        assert float((error - found.info["cut_hz"]).square().mean().sqrt()) < 0.4 * float(rms)


def test_apertures_cut_by_lost_lines_count_as_those_cut_by_the_ends() -> None:
    """If lost lines counted as an end, what it cuts would not balance the other end."""
    signal, _ = aircraft(RandomPoints(40, 230.0, 150.0))
    ends = (slice(200, None), slice(None, -200))
    lost = torch.zeros_like(signal.data)
    for trials, kept in zip((slice(8), slice(8, None)), ends, strict=True):
        lost[trials, kept] = signal.data[trials, kept]
    found = PhaseIncrement(AIRCRAFT)(signal.with_data(lost))
    cut_hz = [PhaseIncrement(AIRCRAFT)(signal.isel(pulse=kept)).info["cut_hz"] for kept in ends]
    cut_hz = torch.cat([cut_hz[0][:8], cut_hz[1][8:]])
    assert float((found.info["cut_hz"] - cut_hz).norm()) < 0.4 * float(cut_hz.norm())


def test_the_increment_of_one_whole_target_is_reliable() -> None:
    signal, doppler = aircraft(Points([0.0], [0.0], random_phase=True))
    found = PhaseIncrement(AIRCRAFT)(signal)
    assert bool(found.ok.all())
    assert float((found["doppler_baseband_hz"] - doppler).abs().max()) < 0.5
    assert float(found.std["doppler_baseband_hz"].max()) < 0.5


@pytest.mark.parametrize("estimate", [phase_increment, energy_centre])
def test_independent_lines_have_no_centroid_whatever_the_range_cells_share(estimate) -> None:
    generator = torch.Generator().manual_seed(3)
    noise = torch.view_as_complex(torch.randn(40, 256, 64, 2, generator=generator, dtype=torch.float64))
    bright = noise.clone()
    bright[..., 20] *= 100
    turns = torch.rand(40, 256, 1, generator=generator, dtype=torch.float64) + 0.2123 * torch.arange(64)
    tone = noise + 10 * torch.polar(torch.ones_like(turns), 2 * math.pi * turns)
    for x in (bright, tone):
        assert not bool(estimate(x, PRF).ok.any())
    assert bool(estimate(sum(bright.roll(k, -2) for k in range(6)), PRF).ok.all())


def test_variance_of_the_products_of_noise_in_a_tile() -> None:
    noise = Draws(16, trials=range(20)).normal("alone", (129, 256), torch.complex64)
    radar = replace(AIRCRAFT, pulse=LinearFM(50e6, 0.5e-6))
    products, power = lag_products(noise, (8, 8))
    assert 0.8 < float(_noise_variance(power, radar).mean() / products.imag.square().mean()) < 1.1


def test_a_wide_search_with_an_unknown_dwell_takes_few_images() -> None:
    """An aperture of a whole PRF would be 5 s long, the step of the grid 0.2 m/s."""
    unknown = replace(AIRCRAFT, integration_s=None)
    doppler = torch.zeros(2, dtype=torch.float64)
    world = StripmapWorld(RandomPoints(40, 250.0, 150.0), Dwell(1.0), velocity_m_s=121.5, doppler_hz=doppler, snr_db=15)
    signal = simulate(AIRCRAFT, world, 768, 192, Draws(14, trials=range(2)))[0].signal
    found = EffectiveVelocity(OmegaK(unknown), 80.0)(signal, doppler)
    assert found.info["grid_velocity_m_s"].shape[0] <= 33 and float(found.info["grid_velocity_m_s"].min()) >= 60
    assert bool(found.ok.all())
    torch.testing.assert_close(found["velocity_m_s"], torch.full_like(doppler, 121.5), atol=0.2, rtol=0)


@pytest.mark.parametrize("points, snr_db", [(3, None), (12, 0.0)])
def test_an_unknown_dwell_does_not_change_the_velocity_or_its_deviation(points: int, snr_db: float | None) -> None:
    """The echo fills a twelfth of the PRF; the minimum is 150 times as wide as with all of it."""
    fine = replace(AIRCRAFT, prf_hz=900.0)
    world = StripmapWorld(RandomPoints(points, 80.0, 100.0), Dwell(1.0), velocity_m_s=121.5, snr_db=snr_db)
    signal = simulate(fine, world, 1800, 128, Draws(17, trials=range(4)))[0].signal
    known, unknown = (
        EffectiveVelocity(OmegaK(replace(fine, integration_s=dwell_s)), 20.0)(signal) for dwell_s in (1.0, None)
    )
    assert bool(known.ok.all()) and bool(unknown.ok.all())
    assert float((unknown["velocity_m_s"] - 121.5).abs().max()) < 0.15
    ratio = unknown.std["velocity_m_s"] / known.std["velocity_m_s"]
    assert float(ratio.min()) > 0.5 and float(ratio.max()) < 2


@pytest.mark.slow
def test_a_velocity_of_an_unknown_dwell_below_the_noise_says_how_exact_it_is() -> None:
    """Noise limits the depth of the minimum; with a smaller distance errors were 8 deviations."""
    radar = replace(AIRCRAFT, carrier_hz=3e9, prf_hz=300.0, integration_s=None)
    for snr_db, least in ((-6.0, 12), (-9.0, 0)):
        world = StripmapWorld(RandomPoints(12, 100.0, 100.0), Dwell(1.0), velocity_m_s=121.5, snr_db=snr_db)
        signal = simulate(radar, world, 1024, 96, Draws(3, trials=range(16)))[0].signal
        found = EffectiveVelocity(OmegaK(radar), 20.0, lines=96)(signal)
        deviations = ((found["velocity_m_s"] - 121.5) / found.std["velocity_m_s"])[found.ok]
        assert int(found.ok.sum()) >= least and float(deviations.square().mean().sqrt()) < 2


@pytest.mark.parametrize("kind", [PhaseIncrement, EnergyCentre, DopplerCentroid])
def test_outcomes_of_centroids_and_values_without_assessment(kind, monkeypatch: pytest.MonkeyPatch) -> None:
    signal, _ = aircraft(RandomPoints(24, 230.0, 150.0, spread_db=6.0), trials=1)
    noise = Draws(3, trials=range(1)).normal("alone", (768, 192), torch.complex64)
    cut, _ = aircraft(RandomPoints(24, 20.0, 150.0, azimuth_m=125.0), trials=1)
    data = torch.cat([signal.data, noise, 0 * noise, cut.data])
    found = kind(AIRCRAFT)(signal.with_data(data))
    assert found.outcome[:3].tolist() == [Outcome.OK, Outcome.NOISE, Outcome.EMPTY]
    assert found.outcome[3] == Outcome.MISFIT
    for part in ("Increments", "baseband", "absolute"):
        monkeypatch.delattr(doppler_assess, part)
    alone = kind(AIRCRAFT, assess=False)(signal.with_data(data))
    assert bool((alone.outcome == Outcome.NOT_ASSESSED).all()) and not alone.std
    for name, value in found.value.items():
        torch.testing.assert_close(alone[name], value, rtol=0, atol=0)


def test_outcomes_of_velocities_and_values_without_assessment(monkeypatch: pytest.MonkeyPatch) -> None:
    signal, doppler = aircraft(RandomPoints(24, 230.0, 150.0, spread_db=6.0), trials=2)
    noise = Draws(3, trials=range(1)).normal("alone", (768, 192), torch.complex64)
    far = StripmapWorld(RandomPoints(24, 230.0, 150.0), Dwell(1.0), velocity_m_s=160.0, doppler_hz=0.0, snr_db=20.0)
    beyond = simulate(AIRCRAFT, far, 768, 192, Draws(15, trials=range(1)))[0].signal.data
    data = torch.cat([signal.data[:1], noise, 0 * noise, beyond])
    doppler = torch.cat([doppler[:1], torch.zeros(3, dtype=torch.float64)])
    found = EffectiveVelocity(OmegaK(AIRCRAFT), 25.0)(signal.with_data(data), doppler)
    assert found.outcome[:3].tolist() == [Outcome.OK, Outcome.NOISE, Outcome.EMPTY] and not bool(found.ok[3])
    monkeypatch.delattr(velocity_assess, "assessed")
    alone = EffectiveVelocity(OmegaK(AIRCRAFT), 25.0, assess=False)(signal.with_data(data), doppler)
    assert bool((alone.outcome == Outcome.NOT_ASSESSED).all()) and not alone.std
    torch.testing.assert_close(alone["velocity_m_s"], found["velocity_m_s"], rtol=0, atol=0)


def test_invalid_arguments_are_rejected() -> None:
    radar = kondor()
    with pytest.raises(ValueError, match="flat"):
        DopplerCentroid(radar, reference="none")
    with pytest.raises(ValueError, match="reach"):
        EffectiveVelocity(OmegaK(radar), reach_m_s=-1)
    with pytest.raises(ValueError, match="blocks"):
        phase_increment(torch.ones(4, 8, dtype=torch.complex64), PRF, blocks=(8, 8))
