"""Echoes of moving points in channels against direct sums, noise, sea, trials and gradients."""

from __future__ import annotations

import math

import pytest
import torch

from torchsar.core import Draws
from torchsar.echo import bistatic_echo, simulate_bistatic
from torchsar.focus import range_compress
from torchsar.focus.reference import flat_reference, matched_reference
from torchsar.radar import BistaticRadar, LinearFM, Orbit, range_coefficients, seen_point
from torchsar.scene import (
    BandLimited,
    BistaticWorld,
    Fleet,
    GroundMovers,
    KSea,
    MovingPoints,
    OrbitTransmit,
    Pattern,
    PolynomialTransmit,
    Ship,
    TaylorRange,
)
from torchsar.scene.movers import Movers, MovingScene
from torchsar.study.bench.direct.moving import published_radar

C = 3e8
SPEED, NEAR = 300.0, 5000.0


def radar_of(**changes) -> BistaticRadar:
    values: dict = {"pulse": LinearFM(50e6, 2e-6), "channel_m": (-0.8, 0.1, 0.75), "transmit_range": (-243.0, 0.02)}
    return published_radar(**{**values, **changes})


RADAR = radar_of()
SCENE = MovingPoints([10.0, -4.0], [5.0, -8.0], [20.0, -60.0], [12.0, -33.0], [1.0, 0.6])


def simulated(
    scene: MovingScene | None = SCENE,
    n_pulse=90,
    n_range: int | None = 128,
    radar=RADAR,
    trials=None,
    gate=None,
    dtype=torch.complex128,
    **options,
):
    simulate = {name: options.pop(name) for name in ("kind", "impairments") if name in options}
    world = BistaticWorld(scene, gate or Pattern(), **options)
    return simulate_bistatic(radar, world, n_pulse, n_range, Draws(3, trials=trials), dtype=dtype, **simulate)


def direct_ranges(radar: BistaticRadar, movers: Movers, n_pulse: int) -> tuple[torch.Tensor, torch.Tensor]:
    """R_m (m) and the sine of the look angle, (channel, pulse, target)."""
    time = ((torch.arange(n_pulse, dtype=torch.float64) - n_pulse // 2) / radar.prf_hz)[:, None]
    along = (
        (SPEED - movers.u_a_m_s) * time
        - movers.y0_m
        - torch.tensor(radar.channel_m, dtype=torch.float64)[:, None, None]
    )
    ranges = torch.sqrt((NEAR + movers.range_m - movers.u_r_m_s * time) ** 2 + along**2)
    return ranges, along / ranges


def direct_peaks(radar: BistaticRadar, n_pulse: int) -> torch.Tensor:
    """Carrier and antenna pattern of each target, (channel, pulse, target)."""
    movers = SCENE.movers(radar, Draws(3))
    ranges, sine = direct_ranges(radar, movers, n_pulse)
    time = ((torch.arange(n_pulse, dtype=torch.float64) - n_pulse // 2) / radar.prf_hz)[:, None]
    transmit = -243.0 * time + 0.02 * time**2
    return (
        torch.sinc(0.8 * sine / 0.24) * torch.exp(-2j * math.pi / 0.24 * (transmit + ranges - NEAR)) * movers.amplitude
    )


def test_azimuth_only_echo_is_the_direct_sum():
    recording, truth = simulated(n_range=None)
    torch.testing.assert_close(recording.signal.data, direct_peaks(RADAR, 90).sum(-1), rtol=0, atol=1e-9)
    assert recording.signal.names == ("channel", "pulse")
    assert truth.values["range_m"].tolist() == [5012.0, 4967.0] and truth.values["y0_m"].tolist() == [20.0, -60.0]


def direct_lines(radar: BistaticRadar, n_pulse: int, n_range: int, late_m: torch.Tensor | float = 0.0) -> torch.Tensor:
    """Sinc responses about R_m on the receive path."""
    ranges, _ = direct_ranges(radar, SCENE.movers(radar, Draws(3)), n_pulse)
    axis = NEAR + (torch.arange(n_range) - n_range // 2) * C / 60e6
    response = torch.sinc(50e6 / C * (axis - (ranges + late_m)[..., None]))
    return (direct_peaks(radar, n_pulse)[..., None] * response).sum(-2)


def test_compressed_echo_is_a_sinc_on_the_receive_path():
    """The ripple of a line of finite length is -50 dB of the peak."""
    recording, _ = simulated()
    torch.testing.assert_close(recording.signal.data, direct_lines(RADAR, 90, 128), rtol=0, atol=4e-3)
    longer = bistatic_echo(SCENE.movers(RADAR, Draws(3)), RADAR, 90, 4096, gate=Pattern(), dtype=torch.complex128)
    torch.testing.assert_close(longer, direct_lines(RADAR, 90, 4096), rtol=0, atol=1.5e-4)


def test_band_weights_peak_at_one_and_hold_the_band():
    for n in (96, 1000):
        weights = RADAR.band_weights(n)
        assert float(torch.fft.ifft(weights)[0].real) == pytest.approx(1.0)
        assert float(weights.sum() / weights.max()) == pytest.approx(n * 50 / 60, abs=1e-9)


@pytest.mark.parametrize(("reference", "within"), [(flat_reference, 6e-3), (matched_reference, 0.05)])
def test_full_echoes_compress_to_the_compressed_ones(reference, within):
    """Both methods of synthesis are equivalent."""
    radar = radar_of(pulse=LinearFM(50e6, 10e-6))
    raw = simulated(radar=radar, n_range=1500, n_pulse=12, kind="full")[0].signal
    data = range_compress(raw.data, reference(radar.pulse, 1500, radar.sampling_hz))
    torch.testing.assert_close(
        data, simulated(radar=radar, n_range=1500, n_pulse=12)[0].signal.data, rtol=0, atol=within
    )


def carrier(range_m: float) -> torch.Tensor:
    return torch.exp(-2j * math.pi / 0.24 * torch.tensor(range_m, dtype=torch.float64))


def test_full_echo_starts_at_its_range_and_is_cut_not_wrapped():
    scene = MovingPoints([0.0], [0.0], [0.0], [50 * C / 60e6])
    line = simulated(scene, n_pulse=1, n_range=150, radar=radar_of(channel_m=(0.0,)), kind="full")[0].signal.data[0, 0]
    assert float(line[:125].abs().max()) < 1e-9 and float((line[125:].abs() - 1).abs().max()) < 1e-6
    torch.testing.assert_close(line[125:], RADAR.pulse.samples(60e6)[:25] * carrier(250.0), rtol=0, atol=1e-6)
    early = simulated(
        MovingPoints([0.0], [0.0], [0.0], [-100 * C / 60e6]),
        n_pulse=1,
        n_range=150,
        radar=radar_of(channel_m=(0.0,)),
        kind="full",
    )[0].signal.data[0, 0]
    torch.testing.assert_close(early[:95], RADAR.pulse.samples(60e6)[25:] * carrier(-500.0), rtol=0, atol=1e-6)
    assert float(early[95:].abs().max()) < 1e-9


def test_echoes_beyond_the_line_do_not_come_back_at_its_other_end():
    scene = MovingPoints([0.0], [0.0], [0.0], [75 * C / 60e6])
    data = simulated(scene, n_pulse=3)[0].signal.data.abs()
    assert float(data[..., :40].max()) < 0.012 < 0.02 < float(data[..., -10:].max())


def test_the_window_follows_the_ephemeris_and_the_carrier_the_truth():
    """The envelope lies at R_m plus the difference of the true range and the ephemeris.

    Removal of the ephemeris leaves that same range on the carrier.
    """
    known = radar_of(transmit_range=(-243.0, 0.02))
    true = PolynomialTransmit((-223.0, 0.02))
    time = known.pulse_axis(90).values()
    recording, truth = simulated(radar=known, transmit=true)
    late = (20.0 * time)[:, None]
    expected = direct_lines(known, 90, 128, late) * torch.exp(-2j * math.pi / 0.24 * late)
    torch.testing.assert_close(recording.signal.data, expected, rtol=0, atol=4e-3)
    torch.testing.assert_close(truth.values["transmit_range_m"], -223 * time + 0.02 * time**2)


def test_a_real_orbit_differs_from_its_ephemeris_by_less_than_a_milliradian():
    orbit = Orbit.at_height(36_500e3, inclination_deg=60.0, raan_deg=195.5, argument_of_perigee_deg=270.0)
    at = torch.zeros(1, dtype=torch.float64)
    point = seen_point(*orbit.state(at), 7.0, 30.0)
    radar = radar_of(transmit_range=range_coefficients(orbit, point, at)[0].tolist())
    truth = OrbitTransmit(orbit, point[0].tolist())
    data = [simulated(radar=radar, n_range=None, n_pulse=810, transmit=t)[0].signal.data for t in (truth, None)]
    assert radar.transmit_range[0] != 0 and float((data[0] - data[1]).abs().max()) < 1e-3


def test_motion_towards_the_transmitter_adds_to_doppler():
    """The Doppler frequency is that of the bistatic closing speed."""
    radar = radar_of(transmit_range=())
    still = GroundMovers([-12.5], [0.0], [0.0], [4000.0])
    moved = GroundMovers([-12.5], [0.0], [0.0], [4000.0], towards_transmitter=(-0.48, 0.0))
    data = [simulated(scene, n_range=None, radar=radar)[0].signal.data for scene in (still, moved)]
    time = radar.pulse_axis(90).values()
    torch.testing.assert_close(data[1], data[0] * torch.exp(2j * math.pi / 0.24 * 6 * time), rtol=0, atol=1e-9)
    assert simulated(moved, n_range=None)[1].values["u_t_m_s"].tolist() == [6.0]


def test_fidelity_of_the_receive_range_reaches_the_echo():
    exact, series = (
        simulated(n_range=None, n_pulse=810, receive=r)[0].signal.data for r in (TaylorRange(12), TaylorRange(2))
    )
    torch.testing.assert_close(exact, simulated(n_range=None, n_pulse=810)[0].signal.data, rtol=0, atol=1e-6)
    assert float((series - exact).abs().max()) > 0.5


@pytest.mark.parametrize(("kind", "gain"), [("compressed", 1.0), ("full", 120.0)])
def test_noise_has_the_variance_of_the_signal_to_noise_ratio(kind, gain):
    levels = torch.tensor([0.0, 20.0])
    recording, truth = simulated(snr_db=levels, trials=range(2), kind=kind, n_range=200)
    assert truth.clean is not None
    noise = recording.signal.data - truth.clean.signal.data
    power = noise.abs().square().mean((-3, -2, -1))
    torch.testing.assert_close(power, gain * 10 ** (-levels.double() / 10), rtol=0.02, atol=0)
    torch.testing.assert_close(truth.values["noise_std"] ** 2, gain * 10 ** (-levels.double() / 10))


def test_noise_of_full_echoes_keeps_its_ratio_through_compression():
    radar = radar_of(pulse=LinearFM(50e6, 4e-6))
    recording, truth = simulated(radar=radar, n_range=600, kind="full", snr_db=10.0)
    assert truth.clean is not None
    noise = range_compress(recording.signal.data - truth.clean.signal.data, matched_reference(radar.pulse, 600, 60e6))
    assert float(noise.abs().square().mean()) == pytest.approx(0.1, rel=0.05)


@pytest.mark.parametrize("kind", ["compressed", "full"])
def test_the_sea_has_the_transmit_range_on_its_carrier(kind):
    """A full sea, compressed, is the compressed sea where lines are complete."""
    radar = radar_of(pulse=LinearFM(50e6, 4e-6))
    data = simulated(None, radar=radar, n_range=1000, n_pulse=12, sea=KSea(power_db=0.0, margin_s=0.0), kind=kind)[
        0
    ].signal.data
    plain = simulated(
        None,
        radar=radar_of(pulse=radar.pulse, transmit_range=()),
        n_range=1000,
        n_pulse=12,
        sea=KSea(power_db=0.0, margin_s=0.0),
    )[0].signal.data
    data = range_compress(data, flat_reference(radar.pulse, 1000, 60e6)) if kind == "full" else data
    time = radar.pulse_axis(12).values()[:, None]
    expected = plain * torch.exp(-2j * math.pi / 0.24 * (-243 * time + 0.02 * time**2))
    part = slice(20, 700)
    error = (data - expected)[..., part].abs().square().mean() / expected[..., part].abs().square().mean()
    assert float(error) < (1e-20 if kind == "compressed" else 0.01)


@pytest.mark.parametrize("n_range", [None, 64])
def test_batches_equal_single_trials(n_range):
    scene = Fleet(
        {
            "points": MovingPoints(torch.tensor([[1.0], [10.0], [-5.0]]), [3.0], [10.0], [0.0], random_phase=True),
            "ship": Ship(torch.tensor([0.0, 1.0, 2.0]), 4.0),
        }
    )
    batch, truth = simulated(
        scene, n_pulse=40, n_range=n_range, trials=range(3), snr_db=torch.tensor([0.0, 10.0, 20.0])
    )
    for i, (a, b) in enumerate(zip((1.0, 10.0, -5.0), (0.0, 1.0, 2.0), strict=True)):
        one = Fleet({"points": MovingPoints([a], [3.0], [10.0], [0.0], random_phase=True), "ship": Ship(b, 4.0)})
        alone = simulated(one, n_pulse=40, n_range=n_range, trials=[i], snr_db=10.0 * i)[0].signal.data[0]
        torch.testing.assert_close(batch.signal.data[i], alone, rtol=0, atol=1e-12)
    assert truth.values["u_r_m_s"].shape == (3, 16)


def test_a_scene_that_draws_nothing_has_all_trials():
    assert simulated(trials=range(4), n_pulse=5)[0].signal.data.shape == (4, 3, 5, 128)


def test_single_precision_agrees_with_double():
    single = simulated(dtype=torch.complex64, n_pulse=200, snr_db=10.0)[0].signal.data
    assert single.dtype == torch.complex64
    torch.testing.assert_close(
        single.to(torch.complex128), simulated(n_pulse=200, snr_db=10.0)[0].signal.data, rtol=0, atol=2e-5
    )


@pytest.mark.parametrize("n_range", [None, 12])
def test_gradients_of_speeds_positions_and_amplitudes(n_range):
    values = [
        torch.tensor(v, dtype=torch.float64, requires_grad=True)
        for v in ([10.0, -4.0], [5.0, -8.0], [2.0, -6.0], [3.0, -2.0])
    ]
    amplitude = torch.tensor([1.0 + 0.5j, -0.6j], dtype=torch.complex128, requires_grad=True)

    def echo(*args):
        return bistatic_echo(Movers(*args), RADAR, 5, n_range, gate=Pattern(), dtype=torch.complex128)

    assert torch.autograd.gradcheck(echo, (*values, amplitude), eps=1e-6, atol=1e-5)


def test_channels_pass_through_vmap():
    speeds = torch.tensor([[10.0], [-4.0]], dtype=torch.float64)
    rest = torch.zeros(1, dtype=torch.float64)

    def echo(u_r):
        return bistatic_echo(
            Movers(u_r, rest, rest, rest, torch.ones(1, dtype=torch.complex128)),
            RADAR,
            20,
            gate=BandLimited(4.5),
            dtype=torch.complex128,
        )

    torch.testing.assert_close(torch.vmap(echo)(speeds), torch.stack([echo(u) for u in speeds]))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"scene": MovingPoints([0.0], [300.0], [0.0], [0.0])}, "as fast as the receiver"),
        ({"scene": MovingPoints([0.0], [0.0], [0.0], [-5000.0])}, "positive range"),
        (
            {"scene": MovingPoints([0.0], [0.0], [0.0], [5000.0])},
            "counts from the reference range, must lie within 1.5",
        ),
        ({"scene": MovingPoints([], [], [], [])}, "holds no target"),
        ({"n_pulse": 0}, "whole numbers"),
        ({"n_range": 100, "kind": "full"}, "120 samples of the pulse"),
        ({"n_range": None, "kind": "full"}, "120 samples of the pulse"),
        ({"kind": "raw"}, "compressed, full"),
        ({"snr_db": torch.zeros(3), "trials": range(2)}, "each of the 2 trials"),
    ],
)
def test_impossible_recordings_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        simulated(**options)
