"""Velocity estimators of a moving point against bounds, each other, ambiguities and clutter."""

from __future__ import annotations

import math

import pytest
import torch

from tests.helpers import radial_velocity_bound_m_s
from torchsar.core import Axis, Draws, Outcome, Signal
from torchsar.echo.sea import sea_echo
from torchsar.metrics.bistatic_bounds import bistatic_bounds
from torchsar.multichannel import (
    AlongTrackAutofocus,
    Dwell,
    ElementBeam,
    GradientVelocity,
    Interferometry,
    LikelihoodVelocity,
    MovingPointVelocity,
    PointMotion,
    Search,
    WalkAmbiguity,
    moving_point_velocity,
)
from torchsar.multichannel.velocity.aperture import SeenAperture
from torchsar.multichannel.velocity.bank import bank_search
from torchsar.multichannel.velocity.likelihood import PointLikelihood, explained_energy, maximum_likelihood
from torchsar.multichannel.velocity.model import UNKNOWNS, moved, noise_beside, phase_slopes, point_phasor
from torchsar.multichannel.velocity.whitening import line_whitening
from torchsar.scene import KSea, Pattern
from torchsar.study.bench.direct.moving import azimuth_echo, compressed_echo, published_radar

F64, C128 = torch.float64, torch.complex128
RADAR, N, GATE = published_radar(), 900, Dwell(4.5)
NEAR = Search(u_r_m_s=12.0, u_a_m_s=4.0, y0_m=100.0, u_a_step_m_s=1.0)
ESTIMATORS = {
    "interferometry": Interferometry,
    "along_track": AlongTrackAutofocus,
    "likelihood": LikelihoodVelocity,
    "gradient": GradientVelocity,
    "recommended": MovingPointVelocity,
}


def noise(trials, seed, n=N, channels=3):
    generator = torch.Generator().manual_seed(seed)
    return torch.view_as_complex(torch.randn(trials, channels, n, 2, dtype=F64, generator=generator)) * math.sqrt(0.5)


def noisy(snr_db, trials, radar=RADAR, u_r=0.0, u_a=0.0, y0=0.0):
    clean = azimuth_echo(radar, N, u_r, u_a, y0)
    return Signal(10 ** (snr_db / 20) * clean + noise(trials, 1, channels=radar.channels), radar.axes(N))


def rms(x):
    return float(x.square().mean().sqrt())


def bound(snr_db, unknown=UNKNOWNS, **move):
    values = {"u_r_m_s": move.get("u_r", 0.0), "u_a_m_s": move.get("u_a", 0.0), "y0_m": move.get("y0", 0.0)}
    return {
        name: float(x)
        for name, x in bistatic_bounds(
            RADAR, N, 10 ** (snr_db / 10), **values, integration_s=4.5, unknown=unknown
        ).items()
    }


def test_model_is_the_echo_and_its_slopes():
    move = (10.0, 5.0, 30.0)
    motion, time_s = PointMotion.of(RADAR, torch.zeros(1), *move), RADAR.pulse_axis(N).values()
    echo = azimuth_echo(RADAR, N, *move)
    weight = GATE.weight(RADAR, motion, time_s)
    torch.testing.assert_close(weight * point_phasor(RADAR, motion, time_s, C128), echo, atol=1e-8, rtol=0)
    slopes = phase_slopes(RADAR, motion, time_s)
    for i in range(3):
        step = torch.zeros(3, dtype=F64)
        step[i] = 1e-4
        ends = [point_phasor(RADAR, moved(motion, s, UNKNOWNS), time_s, C128) for s in (step, -step)]
        torch.testing.assert_close(torch.angle(ends[0] * ends[1].conj()) / 2e-4, slopes[i], atol=1e-4, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("snr_db", "worst", "move"),
    [(0.0, 1.3, {"u_r": 10.0}), (7.0, 1.3, {"u_r": -7.0, "u_a": 3.0, "y0": 40.0}), (-10.0, 1.6, {"u_r": 4.0})],
)
def test_recommended_reaches_the_bound(snr_db, worst, move):
    """The estimate is not better than the bound: the edges of the gate give no information."""
    estimate = moving_point_velocity(noisy(snr_db, 32, **move).data, RADAR, GATE, NEAR)
    least = bound(snr_db, **move)
    assert bool(estimate.ok.all())
    for name, key in (("u_r_m_s", "u_r"), ("u_a_m_s", "u_a"), ("y0_m", "y0")):
        assert 0.7 < rms(estimate.value[name] - move.get(key, 0.0)) / least[name] < worst, name
        assert float(estimate.std[name].median()) == pytest.approx(least[name], rel=0.3)


def test_ranges_other_than_the_reference_range_of_the_radar():
    """One range per trial; the bank of filters used the reference range for all points once."""
    radar, near = published_radar(reference_range_m=5700.0), torch.tensor([6490.0, 4860.0], dtype=F64)
    echo = torch.stack([azimuth_echo(radar, N, 2.0, 3.0, 80.0, r0=float(r0)) for r0 in near])
    estimate = moving_point_velocity(10 * echo + noise(2, 1), radar, GATE, NEAR, range_m=near)
    assert bool(estimate.ok.all())
    for name, truth in (("u_r_m_s", 2.0), ("u_a_m_s", 3.0), ("y0_m", 80.0)):
        assert bool(((estimate.value[name] - truth).abs() < 5 * estimate.std[name]).all()), name


def test_with_a_known_along_track_speed():
    estimate = MovingPointVelocity(RADAR, GATE, search=NEAR, u_a_m_s=5.0)(noisy(0.0, 32, u_r=10.0, u_a=5.0))
    assert set(estimate.std) == {"u_r_m_s", "y0_m"} and bool((estimate.value["u_a_m_s"] == 5).all())
    assert (
        0.7 < rms(estimate.value["u_r_m_s"] - 10) / bound(0.0, ("u_r_m_s", "y0_m"), u_r=10.0, u_a=5.0)["u_r_m_s"] < 1.3
    )


@pytest.mark.parametrize("snr_db", [-10.0, 0.0, 17.0])
def test_interferometry_within_twice_the_bound(snr_db):
    estimate = Interferometry(RADAR, GATE, check_ambiguity=False)(noisy(snr_db, 60, u_r=10.0))
    ratio = rms(estimate.value["u_r_m_s"] - 10) / bound(snr_db, ("u_r_m_s", "y0_m"), u_r=10.0)["u_r_m_s"]
    assert 0.7 < ratio < 2.2 and bool(estimate.ok.all())


@pytest.mark.parametrize("channels", [(-0.8, 0.0, 0.75), (-0.4, 0.4), (0.8, -0.8, 0.0)])
def test_interferometry_with_uneven_channels(channels):
    radar = published_radar(channel_m=channels)
    estimate = Interferometry(radar, GATE)(noisy(10.0, 20, radar=radar, u_r=10.0, u_a=5.0), u_a_m_s=5.0)
    # bound by the look angle between the channels, without the cubic phase
    least = radial_velocity_bound_m_s(radar, 10.0, 810, 5.0)
    assert (
        0.6 < rms(estimate.value["u_r_m_s"] - 10) / least < 1.5
        and 0.6 < rms(estimate.value["y0_m"]) / (least * 5000 / 295) < 1.5
    )


def test_interferometry_and_the_ends_of_its_interval():
    """u_r is returned within half of lambda PRF (43.2 m/s) about the start: 25 appears as -18.2."""
    for u_r in (21.0, -21.0):
        estimate = Interferometry(RADAR, GATE)(noisy(17.0, 4, u_r=u_r))
        assert rms(estimate.value["u_r_m_s"] - u_r) < 0.1 and bool(estimate.ok.all())
    with pytest.warns(UserWarning, match="in 4 of 4 trials the slant-range velocity is off by whole pulse rates"):
        estimate = Interferometry(RADAR, GATE)(noisy(17.0, 4, u_r=25.0))
    assert (
        bool(((estimate.value["u_r_m_s"] - 25 + 43.2).abs() < 1.5).all())
        and not bool(estimate.ok.any())
        and estimate.info["pulse_rates"].tolist() == [1] * 4
    )
    near = Interferometry(RADAR, GATE)(noisy(17.0, 4, u_r=25.0), u_r_m_s=15.0)
    assert rms(near.value["u_r_m_s"] - 25) < 0.1


def test_along_track_speed():
    # three bands cannot be separated at 12 m/s
    signal = noisy(0.0, 24, u_r=10.0, u_a=12.0, y0=20.0)
    estimate = AlongTrackAutofocus(RADAR, GATE)(signal, u_r_m_s=10.0, y0_m=20.0)
    least = bound(0.0, ("u_a_m_s", "u_r_m_s"), u_r=10.0, u_a=12.0, y0=20.0)["u_a_m_s"]
    assert 0.7 < rms(estimate.value["u_a_m_s"] - 12) / least < 2.2
    assert rms(estimate.value["u_a_m_s"] - 12) == pytest.approx(float(estimate.std["u_a_m_s"].mean()), rel=0.35)
    assert bool(estimate.ok.all())
    outside = AlongTrackAutofocus(RADAR, GATE, half_m_s=8.0)(signal, u_r_m_s=10.0, y0_m=20.0)
    assert not bool(outside.ok.any()) and bool((outside.value["u_a_m_s"].abs() <= 8).all())


@pytest.mark.parametrize("name", ["along_track", "interferometry", "likelihood", "gradient", "recommended"])
def test_a_point_lit_in_a_part_of_the_aperture_is_as_certain_as_it_says(name):
    """Lit for 1 s and 1.4 s of the 4.5 s that are expected: the estimates were wrong and sure."""
    lit = (azimuth_echo(RADAR, N, 5.0, 2.0, y0, gate_s=gate) for gate, y0 in ((1.0, 20.0), (1.4, -30.0)))
    each = 2 if name == "recommended" else 5
    position = torch.tensor([20.0, -30.0], dtype=F64).repeat_interleave(each)
    data = math.sqrt(10) * torch.stack(list(lit)).repeat_interleave(each, 0) + noise(2 * each, 3)
    start = {"u_r_m_s": 5.0, "u_a_m_s": 2.0, "y0_m": position}
    taken = {"recommended": (), "along_track": ("u_r_m_s", "y0_m")}.get(name, UNKNOWNS)
    # 1 s does not exclude speeds beyond lambda PRF / 2
    options = {"recommended": {"search": NEAR}, "interferometry": {"check_ambiguity": False}}.get(name, {})
    signal = Signal(data, RADAR.axes(N))
    found = ESTIMATORS[name](RADAR, GATE, **options)(signal, **{key: start[key] for key in taken})
    assert bool(found.ok.all())
    for key, std in found.std.items():
        low, high = (0.5, 1.6) if each == 5 else (0.1, 2.1)  # four trials scatter by a third
        assert low < rms(found[key] - start[key]) / rms(std) < high, key


@pytest.mark.parametrize("name", ["along_track", "interferometry", "likelihood"])
def test_a_second_point_acts_on_the_deviations_as_on_the_errors(name):
    """The energy of a point at another Doppler was taken for noise: 3.5 times too large deviations.

    Where the two overlap in Doppler, it was too little: errors of 8 deviations.
    """
    position = torch.linspace(-20.0, 20.0, 16, dtype=F64)
    other = [azimuth_echo(RADAR, N, -8.0 + 1.1 * i, 3.0 - 0.4 * i, -40.0 + 5 * i) for i in range(16)]
    clean = torch.stack([azimuth_echo(RADAR, N, 5.0, 0.0, float(y0)) for y0 in position]) + 0.5 * torch.stack(other)
    taken = {"interferometry": ("u_r_m_s", "u_a_m_s"), "along_track": ("u_r_m_s", "y0_m")}.get(name, UNKNOWNS)
    start = {"u_r_m_s": 5.0, "u_a_m_s": 0.0, "y0_m": position}
    found = ESTIMATORS[name](RADAR, GATE)(
        Signal(10 * clean + noise(16, 5), RADAR.axes(N)), **{key: start[key] for key in taken}
    )
    assert bool(found.ok.all())
    for key, std in found.std.items():
        assert 0.5 < rms(found[key] - start[key]) / rms(std) < 1.5, key
        assert float(((found[key] - start[key]) / std).abs().max()) < 4.5, key


def test_a_second_point_of_the_same_doppler_is_no_clutter():
    """In the covariance of what one point leaves over, errors reached 46 predicted deviations.

    The chirps of the third pair are too similar to be separated.
    """
    speed = torch.tensor([1.5, -1.2, 2.0, -0.8, 0.6, -1.8], dtype=F64)
    along = torch.tensor([0.6, -0.5, 0.3, 0.8, -0.4, -0.7], dtype=F64)
    # u_r displaces by R0 / v = 5000 / 300 metres per m/s
    second = [azimuth_echo(RADAR, N, 5.0 - u, v, 10.0 + u * 5000 / 300) for u, v in zip(speed.tolist(), along.tolist())]
    clean = azimuth_echo(RADAR, N, 5.0, 0.0, 10.0) + 0.3 * torch.stack(second)
    found = MovingPointVelocity(RADAR, GATE, search=NEAR)(Signal(10 * clean + noise(6, 3), RADAR.axes(N)))
    ok = found.ok
    assert ok.tolist() == [True, True, False, True, True, True] and not bool(found.info["coloured"][ok].any())
    assert found.outcome[2] == Outcome.PARTS_DISAGREE
    for key, true in (("u_r_m_s", 5.0), ("u_a_m_s", 0.0), ("y0_m", 10.0)):
        assert float(((found[key] - true) / found.std[key])[ok].abs().max()) < 3.5, key
        assert bool((found.std[key][ok] < 2.5 * bound(20.0, u_r=5.0, y0=10.0)[key]).all()), key


@pytest.mark.parametrize("snr_db", [-3.0, 25.0])
def test_the_seen_part_of_the_aperture_has_its_own_ends(snr_db):
    """Standard deviations hold where a point is lit in a part of the expected aperture."""
    move = torch.linspace(-3, 3, 20, dtype=F64)
    clean = torch.stack([azimuth_echo(RADAR, N, 5.0, float(u), 7 * float(u), gate_s=1.0) for u in move])
    data = 10 ** (snr_db / 20) * clean + noise(20, 2)
    stage = LikelihoodVelocity(RADAR, GATE)
    found = stage(Signal(data, RADAR.axes(N)), u_r_m_s=5.0, u_a_m_s=move, y0_m=7 * move)
    assert bool(found.ok.all())
    for key, true in (("u_r_m_s", 5.0), ("u_a_m_s", move), ("y0_m", 7 * move)):
        assert 0.6 < rms(found[key] - true) / rms(found.std[key]) < 1.5, key


def test_steps_that_have_not_reached_the_maximum_are_not_ok():
    """A tone is the echo of a point that moves along with the receiver, far from the start."""
    tone = torch.ones(1, 3, N, dtype=C128)
    found = LikelihoodVelocity(RADAR, GATE)(Signal(tone + 0.1 * noise(1, 5), RADAR.axes(N)))
    assert float((found["u_a_m_s"] - RADAR.speed_m_s).abs()) > 5 * float(found.std["u_a_m_s"])
    assert float(found.info["snr_db"]) > 19 and not bool(found.ok)


def test_a_short_dwell_resolves_the_ambiguity_or_says_that_it_does_not():
    """Of speeds lambda PRF apart a wrong one was returned, and ok, in 20 % of the trials."""
    radar, speed = published_radar(), torch.linspace(-11.0, 11.0, 12, dtype=F64).repeat(2)
    clean = torch.stack([azimuth_echo(radar, 400, float(u_r), gate_s=2.0) for u_r in speed])
    level = torch.tensor([-8.0] * 12 + [10.0] * 12, dtype=F64)
    data = 10 ** (level / 20)[:, None, None] * clean + noise(24, 8, 400)
    stage = MovingPointVelocity(radar, Dwell(2.0), search=Search(u_r_m_s=64.8, y0_m=60.0), u_a_m_s=0.0)
    found = stage(Signal(data, radar.axes(400)))
    wrong = (found["u_r_m_s"] - speed).abs() > 5 * found.std["u_r_m_s"]
    assert not bool((wrong & found.ok).any()) and bool(found.ok[level > 0].all())


def test_a_point_that_crosses_range_lines_is_as_certain_as_it_says():
    """Without correction of migration, the strongest line holds the middle of the aperture only."""
    clean = compressed_echo(RADAR, 720, 48, [{"u_r": 3.0, "u_a": -2.0, "y0": 20.0}], 3.5).data
    trials = clean + 0.3 * torch.stack([noise(48, seed, n=720).movedim(0, -1) for seed in range(3)])
    found = MovingPointVelocity(RADAR, Dwell(3.5), search=NEAR)(Signal(trials, RADAR.axes(720, 48)))
    assert bool(found.ok.all())
    for key, true in (("u_r_m_s", 3.0), ("u_a_m_s", -2.0), ("y0_m", 20.0)):
        assert rms((found[key] - true) / found.std[key]) < 2.5, key


@pytest.mark.parametrize("aperture", [GATE, ElementBeam()], ids=["gate", "beam"])
def test_gauss_newton_and_gradients_agree(aperture):
    signal = noisy(10.0, 3, radar=RADAR, u_r=10.0, u_a=5.0, y0=30.0)
    start = {"u_r_m_s": 10.01, "u_a_m_s": 5.05, "y0_m": 30.1}
    newton = LikelihoodVelocity(RADAR, aperture)(signal, **start)
    descent = GradientVelocity(RADAR, aperture)(signal, **start)
    for name in UNKNOWNS:
        torch.testing.assert_close(
            newton.value[name], descent.value[name], atol=0.03 * float(newton.std[name].max()), rtol=0
        )
    # both are at the maximum, where the gradient is zero
    motion = PointMotion.of(RADAR, signal.data, *(newton.value[name] for name in UNKNOWNS)).each(
        lambda x: x.requires_grad_()
    )
    time_s = RADAR.pulse_axis(N).values()
    weight = aperture.weight(RADAR, PointMotion.of(RADAR, signal.data, *start.values()), time_s)
    slopes = torch.autograd.grad(
        explained_energy(signal.data, RADAR, motion, weight).sum(), (motion.u_r_m_s, motion.u_a_m_s, motion.y0_m)
    )
    for name, slope in zip(UNKNOWNS, slopes, strict=True):
        assert (
            float((slope * newton.std[name]).abs().max())
            < 0.05 * float(explained_energy(signal.data, RADAR, motion, weight).detach().min()) ** 0.5
        )


def test_gradient_of_the_likelihood_by_hand():
    data = noisy(10.0, 2, u_r=10.0).data
    start = PointMotion.of(RADAR, data, 10.01, 0.02, 0.3).each(lambda x: x.expand(2).clone().requires_grad_())
    weight = GATE.weight(RADAR, start, RADAR.pulse_axis(N).values())
    slopes = torch.autograd.grad(
        explained_energy(data, RADAR, start, weight).sum(), (start.u_r_m_s, start.u_a_m_s, start.y0_m)
    )
    fit = PointLikelihood.of(data, RADAR, start, GATE, UNKNOWNS, None).fit(start)
    torch.testing.assert_close(2 * fit.gradient.detach(), torch.stack(slopes, -1), rtol=1e-7, atol=1e-6)


@pytest.mark.parametrize(("u_r", "u_a"), [(25.0, 0.0), (-35.0, -4.0)])
def test_the_bank_resolves_pulse_rates(u_r, u_a):
    """By the cubic phase of the range history alone."""
    estimate = MovingPointVelocity(RADAR, GATE, search=Search(u_r_m_s=42.0, u_a_m_s=6.0, y0_m=60.0, u_a_step_m_s=1.0))(
        noisy(0.0, 2, u_r=u_r, u_a=u_a)
    )
    assert (
        bool(estimate.ok.all())
        and rms(estimate.value["u_r_m_s"] - u_r) < 1.0
        and rms(estimate.value["u_a_m_s"] - u_a) < 0.15
    )


@pytest.mark.parametrize(("u_r", "number"), [(25.0, 1), (-35.0, -1), (3.0, 0)])
def test_range_walk_resolves_pulse_rates(u_r, number):
    signal = compressed_echo(RADAR, 810, 64, [{"u_r": u_r}])
    trials = signal.data + 0.5 * torch.randn(
        2, *signal.data.shape, dtype=C128, generator=torch.Generator().manual_seed(1)
    )
    estimate = WalkAmbiguity(RADAR)(signal.with_data(trials.to(torch.complex64)))
    assert estimate.value["ambiguity"].tolist() == [number, number] and bool(estimate.ok.all())


def test_a_position_known_from_an_image():
    """`bank_search` about the slow time at which the point appears in an image."""
    data = noisy(0.0, 3, u_r=10.0, u_a=5.0, y0=300.0).data
    appears = PointMotion.of(RADAR, data, 10.0, 5.0, 300.0).image_s
    start, energy = bank_search(
        data, RADAR, GATE, Search(u_r_m_s=15.0, u_a_m_s=8.0, y0_m=30.0, u_a_step_m_s=1.0), image_s=appears
    )
    assert rms(start.u_r_m_s - 10) <= 2.0 and rms(start.u_a_m_s - 5) <= 1.0 and bool((energy > 500).all())
    found = maximum_likelihood(data, RADAR, start, GATE)
    assert rms(found.motion.y0_m - 300) < 15


def test_the_bank_finds_the_same_where_values_cannot_be_read():
    """Inside vmap it searches all bins of all pulses."""
    data, speed = noisy(0.0, 2, u_r=10.0).data, torch.tensor([0.0, 0.5], dtype=torch.float64)
    search = Search(u_r_m_s=15.0, y0_m=30.0)
    mapped = torch.vmap(lambda x, u_a: bank_search(x, RADAR, GATE, search, u_a)[0].u_r_m_s)(data, speed)
    assert torch.equal(mapped, bank_search(data, RADAR, GATE, search, speed)[0].u_r_m_s)
    assert rms(mapped - 10) <= 2.0


class TestClutter:
    """A point at u_r = 10 m/s in a K-distributed sea 30 dB above unit noise."""

    RADAR = published_radar()

    def data(self, scr_db, trials=2, lines=1, seed=3, n=N, u_r=10.0):
        t = self.RADAR.pulse_axis(n).values()
        motion = PointMotion.of(self.RADAR, torch.zeros(1), u_r)
        point = ElementBeam().weight(self.RADAR, motion, t) * point_phasor(self.RADAR, motion, t, C128)
        sea = torch.stack(
            [
                sea_echo(
                    KSea(power_db=30.0),
                    self.RADAR,
                    n,
                    None,
                    Pattern(),
                    Draws(seed + 100 * line, trials=range(trials)),
                    C128,
                )
                for line in range(lines)
            ],
            1,
        )
        sea = sea + noise(trials * lines, seed, n).view(trials, lines, 3, n)
        return sea[:, 0] + 10 ** ((30 + scr_db) / 20) * point, sea[:, 1:]

    def test_covariance_from_the_data_themselves(self):
        data, _ = self.data(0.0)
        estimate = moving_point_velocity(data, self.RADAR, ElementBeam(), NEAR)
        assert bool(estimate.info["coloured"].all() and estimate.ok.all())
        assert rms(estimate.value["u_r_m_s"] - 10) < 0.3

    def test_covariance_from_neighbouring_lines(self):
        """Clutter biases the position and thereby the expected aperture, but not u_r."""
        data, around = self.data(10.0, trials=4, lines=5)
        estimate = moving_point_velocity(
            data, self.RADAR, ElementBeam(), NEAR, whitening=line_whitening(around, self.RADAR)
        )
        assert (
            bool(estimate.ok.all())
            and rms(estimate.value["u_r_m_s"] - 10) < 2 * float(estimate.std["u_r_m_s"].median()) < 0.14
        )

    def test_strong_clutter_beyond_the_circular_model(self):
        """Deviations hold at 50 dB, and a displaced expected amplitude displaces no point."""
        n, trials = 450, 24
        sea = sea_echo(KSea(power_db=50.0), self.RADAR, n, None, Pattern(), Draws(3, trials=range(trials)), C128)
        sea = sea + noise(trials, 3, n)
        t = self.RADAR.pulse_axis(n).values()
        truth = PointMotion.of(self.RADAR, sea, 8.0)
        beam = ElementBeam().weight(self.RADAR, truth, t)
        data = sea + 10**2.5 * beam * point_phasor(self.RADAR, truth, t, C128)
        whitening = line_whitening(sea, self.RADAR)
        found = maximum_likelihood(data, self.RADAR, truth, ElementBeam(), whitening=whitening)
        assert 0.7 < rms(found.motion.u_r_m_s - 8) / rms(found.covariance[:, 0, 0].sqrt()) < 1.4
        displaced = SeenAperture(ElementBeam(), (1 + 0.02 * t) * torch.ones(trials, 1))
        other = maximum_likelihood(data, self.RADAR, truth, displaced, whitening=whitening)
        assert rms(other.motion.y0_m - found.motion.y0_m) < 0.05 * rms(found.covariance[:, 2, 2].sqrt())

    def test_white_noise_stays_white(self):
        estimate = MovingPointVelocity(RADAR, GATE, search=NEAR)(noisy(10.0, 6, u_r=5.0))
        assert not bool(estimate.info["coloured"].any())


def test_below_the_threshold_nothing_is_found():
    """The threshold is 19 dB over all samples, -15 dB per sample."""
    for snr_db, found in ((-300.0, False), (-20.0, False), (-8.0, True)):
        signal = noisy(snr_db, 6, u_r=5.0)
        assert bool(torch.equal(MovingPointVelocity(RADAR, GATE, search=NEAR)(signal).ok, torch.full((6,), found)))
        assert bool(torch.equal(Interferometry(RADAR, GATE)(signal).ok, torch.full((6,), found)))


@pytest.mark.parametrize("aperture", [GATE, ElementBeam()], ids=["gate", "beam"])
@pytest.mark.parametrize("name", ESTIMATORS)
def test_zeros_and_points_outside_the_record(name, aperture):
    stage = _small(name, RADAR, aperture)
    data = torch.stack([torch.zeros(3, 200, dtype=C128), azimuth_echo(RADAR, 200, y0=2500.0)])
    for values in ({},) if name == "recommended" else ({}, {"y0_m": 2500.0}):
        estimate = stage(Signal(data, RADAR.axes(200)), **values)
        assert not bool(estimate.ok.any())
        assert all(
            bool(torch.isfinite(x).all()) for x in (*estimate.value.values(), estimate.quality, estimate.info["snr_db"])
        )
        assert all(bool((x > 1e3).all()) for x in estimate.std.values())
        assert all(float(x[0]) == values.get(key, 0) for key, x in estimate.value.items())


def _small(name, radar=RADAR, aperture=GATE, **settings):
    extra = {"search": Search(u_r_m_s=3.0, u_a_m_s=1.0, y0_m=60.0, u_a_step_m_s=1.0)} if name == "recommended" else {}
    return ESTIMATORS[name](radar, aperture, **extra, **settings)


@pytest.mark.parametrize("name", ESTIMATORS)
def test_trials_are_independent(name):
    """Strong, weak, zero and noisy trials and one in clutter give the same together and alone."""
    quiet = noisy(10.0, 2, u_r=3.0).data[..., N // 2 - 192 : N // 2 + 192]
    slow = torch.exp(2j * math.pi * 0.01 * torch.arange(384, dtype=F64))
    data = torch.stack(
        [1e3 * quiet[0], 1e-6 * quiet[1], torch.zeros_like(quiet[0]), noise(1, 4, 384)[0], quiet[0] + 30 * slow]
    ).to(torch.complex64)
    signal, start = Signal(data, RADAR.axes(384)), {} if name == "recommended" else {"u_r_m_s": 3.01}
    stage = _small(name)
    together = stage(signal, **start)
    for i in range(5):
        alone = stage(signal.with_data(data[i]), **start)
        assert bool(alone.ok) == bool(together.ok[i])
        for key, value in alone.value.items():
            torch.testing.assert_close(together.value[key][i], value, atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize("name", ESTIMATORS)
def test_single_precision_and_range_lines(name):
    """complex64 data give the velocities of complex128 data.

    With range lines the strongest one is used, with its own closest range.
    """
    signal, start = noisy(10.0, 2, u_r=3.0), {} if name == "recommended" else {"u_r_m_s": 3.01}
    double, single = (
        _small(name)(signal.with_data(signal.data.to(dtype)), **start) for dtype in (C128, torch.complex64)
    )
    lines = torch.stack([0.1 * signal.data.flip(-1), signal.data, 0.1 * signal.data.conj()], -1)
    axes = (*signal.axes, Axis("range", 3, 4995.0, 5.0, "m"))
    among = _small(name)(Signal(lines, axes), **start)
    for key, value in double.value.items():
        assert value.dtype == F64 == single.value[key].dtype
        torch.testing.assert_close(
            single.value[key], value, atol=1e-3 * float(double.std[key].max()) if key in double.std else 1e-9, rtol=0
        )
        torch.testing.assert_close(among.value[key], value, atol=1e-9, rtol=0)


def test_one_channel():
    """One channel cannot separate velocity and position.

    Interferometry rejects it, the other estimates are not ok.
    """
    radar = published_radar(channel_m=(0.0,))
    signal = noisy(10.0, 2, radar=radar, u_r=3.0)
    with pytest.raises(ValueError, match="one channel cannot separate position and velocity"):
        Interferometry(radar, GATE)(signal)
    estimate = _small("recommended", radar)(signal)
    assert (
        not bool(estimate.ok.any())
        and bool((estimate.std["u_r_m_s"] > 20).all())
        and bool(torch.isfinite(estimate.value["u_r_m_s"]).all())
    )
    known = AlongTrackAutofocus(radar, GATE)(signal, u_r_m_s=3.0)
    assert rms(known.value["u_a_m_s"]) < 0.05 and bool(known.ok.all())


def test_refusals():
    signal = noisy(10.0, 1)
    channel, pulse = RADAR.axes(N)
    cropped = Signal(signal.data[..., :800], (channel, Axis("pulse", 800, pulse.start, pulse.step, "s")))
    for name in ESTIMATORS:
        with pytest.raises(ValueError, match="slow time must be zero at pulse 400 of 800"):
            _small(name)(cropped)
        with pytest.raises(ValueError, match="expects 2 channels .* got 3 channels and 900 pulses"):
            _small(name, published_radar(channel_m=(0.0, 0.8)))(signal)
        with pytest.raises(ValueError, match="at least 4 pulses, got 3 channels and 2 pulses"):
            _small(name)(Signal(signal.data[..., :2], RADAR.axes(2)))
    for unknowns in (("u_r",), (), ("u_r_m_s", "u_r_m_s")):
        with pytest.raises(ValueError, match="unknowns must be names among"):
            LikelihoodVelocity(RADAR, GATE, unknowns=unknowns)
    with pytest.raises(ValueError, match="half_m_s of a search along track must be positive, got 0"):
        AlongTrackAutofocus(RADAR, GATE, half_m_s=0.0)(signal)
    with pytest.raises(ValueError, match="400 m/s, as fast as the receiver"):
        AlongTrackAutofocus(RADAR, GATE, half_m_s=400.0)(signal)
    with pytest.raises(ValueError, match="as fast as the receiver"):
        MovingPointVelocity(RADAR, GATE, search=Search(u_a_m_s=400.0))(signal)
    with pytest.raises(ValueError, match="search.u_r_m_s must be 0 or a positive half width, got -1"):
        Search(u_r_m_s=-1)
    with pytest.raises(ValueError, match="finite duration_s, got 0"):
        Dwell(0.0)


def test_noise_of_fewer_samples_than_channels_is_taken_as_equal() -> None:
    """One pulse would leave no noise in two of three directions, and a false deviation of 2 um."""
    left = torch.randn(4, 3, 1, dtype=torch.complex128, generator=torch.Generator().manual_seed(1))
    noise = noise_beside(left, torch.ones(4, 1, 1, dtype=torch.float64), torch.ones(4, 1, 1) + 0j, 4)
    level = noise.diagonal(dim1=-2, dim2=-1)
    torch.testing.assert_close(noise, torch.diag_embed(level))
    torch.testing.assert_close(level, level.mean(-1, keepdim=True).expand_as(level))
    assert bool((level > 0).all())
