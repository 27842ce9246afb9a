"""Motion compensation and omega-K of nearly straight paths, against the direct sum."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor

from torchsar.core import Signal
from torchsar.focus import ImageGrid, MotionCompensation, OmegaKImage, ProcessedBeam, TileImage, compensated_omega_k
from torchsar.metrics import error_db
from torchsar.radar import AntennaPath, InverseRadar, range_profiles

F64, C128 = torch.float64, torch.complex128
# noise on so many pixels gives the error within a tenth of it
PIXELS = 200


@dataclass(frozen=True)
class Strip:
    """A strip along y at x = z = 0, seen from a height, with sways that do not repeat."""

    sway_m: float = 0.0
    range_m: float = 500.0
    grazing_deg: float = 12.0
    beam_deg: float = 6.0
    squint_deg: float = 0.0
    carrier_hz: float = 9.6e9
    bandwidth_hz: float = 300e6
    frequencies: int = 160
    step_m: float = 0.107
    uneven_m: float = 0.0
    climb: float = 0.0
    heading: float = 0.0
    swath_m: float = 36.0
    seed: int = 0

    @property
    def frequency_hz(self) -> Tensor:
        n = self.frequencies
        return self.carrier_hz + self.bandwidth_hz / n * (torch.arange(n, dtype=F64) - n // 2)

    @property
    def antennas(self) -> AntennaPath:
        source = torch.Generator().manual_seed(self.seed)
        height, across = (self.range_m * f(math.radians(self.grazing_deg)) for f in (math.sin, math.cos))
        reach = self.range_m * math.tan(math.radians(0.6 * self.beam_deg))
        pulses = math.ceil((2 * reach + 20.0) / self.step_m)
        u = (torch.arange(pulses, dtype=F64) - pulses / 2) * self.step_m
        start = 2 * math.pi * torch.rand(3, generator=source, dtype=F64)
        sway, heave = (torch.sin(2 * math.pi * u / cycle + x) for cycle, x in ((0.4 * reach, start[0]), (30, start[1])))
        y = u - self.range_m * math.tan(math.radians(self.squint_deg))
        y = y + self.uneven_m * torch.sin(2 * math.pi * u / 11 + start[2])
        x = -across + self.sway_m * sway + self.heading * u
        z = height + 0.3 * self.sway_m * heave + self.climb * u
        reference = torch.full_like(u, 2 * self.range_m / math.cos(math.radians(self.squint_deg)))
        return AntennaPath(torch.stack([x, y, z], -1), None, reference)

    @property
    def grid(self) -> ImageGrid:
        axes = torch.tensor([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]], dtype=F64)
        origin = torch.tensor([-self.swath_m / 2, -8.0, 0.0], dtype=F64)
        return ImageGrid(origin, axes, (33, round(self.swath_m / 0.5) + 1), 0.5)

    def plan(self, order: int = 2) -> MotionCompensation:
        beam = ProcessedBeam(self.beam_deg, self.squint_deg)
        return MotionCompensation(self.frequency_hz, self.antennas, self.grid, beam, order)

    @property
    def noise(self) -> Tensor:
        source = torch.Generator().manual_seed(self.seed)
        return torch.randn(self.antennas.pulses, self.frequencies, dtype=C128, generator=source)

    def measured_db(self, plan: MotionCompensation) -> float:
        """Error of the image of white noise at random pixels."""
        pixels = self.grid.pixels_m().reshape(-1, 3)
        some = torch.randperm(len(pixels), generator=torch.Generator().manual_seed(1))[:PIXELS]
        history = self.noise
        made, exact = plan.image(history).flatten(-2)[some], plan.exact(history, pixels[some], eps=1e-8)
        return float(error_db(made[None], exact[None]))


STRIPS = {
    "drone": Strip(sway_m=0.5, uneven_m=0.2),
    "steep and climbing": Strip(sway_m=0.2, grazing_deg=45.0, climb=0.04, heading=-0.02, swath_m=30.0),
    "squinted": Strip(sway_m=0.1, squint_deg=8.0),
    "far": Strip(sway_m=0.5, range_m=3000.0, grazing_deg=30.0, beam_deg=2.0, step_m=0.3, bandwidth_hz=150e6),
    "L band": Strip(sway_m=1.0, carrier_hz=1.3e9, bandwidth_hz=60e6, frequencies=64, step_m=0.5, beam_deg=10.0),
    "wide": Strip(sway_m=0.05, beam_deg=12.0, step_m=0.06, range_m=300.0),
    "narrow and straight": Strip(beam_deg=3.0, step_m=0.2),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", STRIPS)
def test_the_loss_is_predicted_within_a_factor_of_one_and_a_half(name: str) -> None:
    strip = STRIPS[name]
    plan = strip.plan()
    assert abs(plan.predicted_db() - strip.measured_db(plan)) < 20 * math.log10(1.5)


def test_the_first_order_loses_what_the_second_corrects() -> None:
    strip = Strip(sway_m=0.1)
    first, second = strip.plan(1), strip.plan(2)
    measured = strip.measured_db(first), strip.measured_db(second)
    assert abs(first.predicted_db() - measured[0]) < 20 * math.log10(1.5)
    assert measured[0] > measured[1] + 10


def test_points_at_the_compensated_angle_lose_least() -> None:
    plan = STRIPS["drone"].plan()
    assert plan.predicted_db(torch.ones_like) == pytest.approx(plan.predicted_db())
    sines, share = plan.beam.quadrature()
    sine = math.sqrt(1 - float((share * (1 - sines.square()).sqrt()).sum()) ** 2)
    assert plan.predicted_db(lambda s: torch.exp(-(((s.abs() - sine) / 0.005) ** 2))) < plan.predicted_db() - 6


def test_a_straight_track_gives_the_weighted_direct_sum() -> None:
    strip = replace(STRIPS["drone"], sway_m=0.0)
    assert strip.measured_db(strip.plan()) < -45


def test_a_point_keeps_its_place_amplitude_and_phase() -> None:
    strip = Strip(sway_m=0.3)
    antennas, plan = strip.antennas, strip.plan()
    at = strip.grid.pixels_m()[20, 50]
    turns = antennas.path_m(at[None]) * strip.frequency_hz / 299_792_458.0
    image = plan.image(torch.exp(-2j * math.pi * (turns - turns.round())))
    peak = plan.exact(torch.exp(-2j * math.pi * (turns - turns.round())), at[None])[0]
    assert divmod(int(image.abs().argmax()), image.shape[-1]) == (20, 50)
    assert abs(complex(image[20, 50] / peak) - 1) < 0.02


def test_trials_have_paths_and_precision_of_their_own() -> None:
    strip = Strip(sway_m=0.2, frequencies=32, bandwidth_hz=60e6)
    antennas, history = strip.antennas, strip.noise
    place = antennas.transmitter_m + torch.tensor([0.0, 0.05], dtype=F64)[:, None, None]
    given = strip.frequency_hz, place, antennas.reference_m, strip.grid, ProcessedBeam(strip.beam_deg)
    both = compensated_omega_k(history, *given)
    assert both.shape == (2, *strip.grid.counts)
    torch.testing.assert_close(both[0], strip.plan().image(history))
    single = compensated_omega_k(history.to(torch.complex64), *given)
    assert single.dtype == torch.complex64 and bool((error_db(single.to(C128), both) < -70).all())
    shared = strip.plan().image(torch.stack([history, 2j * history]))
    torch.testing.assert_close(shared[1], 2j * shared[0])


def test_even_pulses_of_the_nominal_track_are_those_of_the_history() -> None:
    """Points within the beam at all pulses of a path that is straight and even stay as they are."""
    strip = Strip(frequencies=32, bandwidth_hz=60e6)
    plan = strip.plan()
    turns = strip.antennas.path_m(torch.zeros(1, 3, dtype=F64)) * strip.frequency_hz / 299_792_458.0
    history = torch.exp(-2j * math.pi * (turns - turns.round()))
    even = plan.straight(history)
    assert even.shape == (plan.lines, plan.cells)
    # lines at the closest approach, at whose range the profile of the history peaks as well
    line = round((0.0 - plan.start_m) / plan.track.step_m)
    cell = int(even[line].abs().argmax())
    assert abs(float(plan.range_m[cell]) - strip.range_m) < 1.5


def test_gradients_reach_the_history() -> None:
    strip = Strip(sway_m=0.2, frequencies=16, bandwidth_hz=60e6, beam_deg=2.0, step_m=0.3)
    plan = strip.plan()
    history = strip.noise.requires_grad_()
    weight = torch.randn(*strip.grid.counts, dtype=C128)
    (slope,) = torch.autograd.grad((plan.image(history) * weight).sum().real, history)
    ahead = torch.randn_like(history)
    change = float((plan.image(ahead) * weight).sum().real)
    assert float((slope.conj() * ahead).sum().real) == pytest.approx(change, rel=1e-6)


def test_the_stage_images_profiles_and_refuses_what_does_not_suit() -> None:
    strip = Strip(sway_m=0.3)
    antennas, frequency = strip.antennas, strip.frequency_hz
    radar = InverseRadar(strip.carrier_hz, strip.bandwidth_hz, 100.0)
    signal = Signal(range_profiles(strip.noise), radar.raw_axes(antennas.pulses, strip.frequencies))
    stage = OmegaKImage(16.0, 36.0, 0.5, strip.beam_deg, window="none")
    known = {"transmitter_m": antennas.transmitter_m, "path_reference_m": antennas.reference_m}
    image = stage(signal, frequency_hz=frequency, **known)
    torch.testing.assert_close(image.data, strip.plan().image(strip.noise))
    seen = OmegaKImage(16.0, 36.0, 0.5, 2.0).seen(antennas)
    assert 0 < seen.sum() < antennas.pulses and seen.equal(TileImage(16.0, 36.0, 0.5, beam_deg=2.0).seen(antennas))
    with pytest.raises(ValueError, match="this path is bistatic; image it by tiles"):
        stage(signal, frequency_hz=frequency, receiver_m=antennas.transmitter_m, **known)
    with pytest.raises(ValueError, match="order of motion compensation is 1 or 2"):
        OmegaKImage(16.0, 36.0, 0.5, 6.0, order=3)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"sway_m": 8.0}, "too far from straight"),
        ({"beam_deg": 12.0}, "choose a narrower beam"),
        ({"swath_m": 1200.0}, "one side of the track"),
        ({"frequencies": 2400}, "reaches the antenna"),
        ({"squint_deg": 79.0}, "less than 80 degrees"),
    ],
)
def test_paths_that_do_not_suit_are_refused(change: dict, match: str) -> None:
    with pytest.raises(ValueError, match=match):
        replace(Strip(), **change).plan()
