"""Autofocus of strips: errors of the path, their deviation, verdicts, and its parts."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from torchsar.compensate import CorrectPath, StripAutofocus, strip_autofocus
from torchsar.compensate.path.joint import cosines
from torchsar.compensate.path.scatterers import Echoes, prominent_places
from torchsar.compensate.path.strip import Curve
from torchsar.core import Outcome
from torchsar.focus import ImageGrid, ProcessedBeam, TileImage
from torchsar.metrics import phase_rmse, registered_error_db
from torchsar.radar import StraightTrack, frequency_samples
from torchsar.scene import Points
from torchsar.study.bench.beside import CELLS, PULSES, RADAR, STRIP, judged, path_of, strips

F64 = torch.float64
RADIANS = 4 * math.pi / RADAR.wavelength_m
KNOWN = ("frequency_hz", "transmitter_m", "path_reference_m")


@pytest.mark.slow
def test_errors_of_a_strip_are_found_within_their_deviation_and_the_image_is_that_of_the_true_path() -> None:
    recording, truth = strips(seed=5)
    known = {name: recording.aux[name] for name in KNOWN}
    found = StripAutofocus(**STRIP)(recording.signal, **known)
    inside = judged()[None]
    true = truth.values["line_of_sight_m"]
    before = phase_rmse(0 * true, RADIANS * true, inside)
    error = phase_rmse(RADIANS * found["line_of_sight_m"], RADIANS * true, inside)
    std = RADIANS * found.std["line_of_sight_m"][inside].reshape(1, -1).square().mean(-1).sqrt()
    assert found.ok.all() and bool((before > 0.3).all()) and bool((error < 0.1).all()), (before, error)
    assert bool((error < 2 * std).all()) and bool((std < 0.05).all()), (error, std)
    assert truth.clean is not None
    image = TileImage(60.0, 26.0, 0.25, window="range", error_db=-40.0, beam_deg=6.0)
    moved = CorrectPath()(recording.signal, found["offset_m"], known["transmitter_m"])["transmitter_m"]
    ideal, after, bad = (
        image(recording.signal, **{**known, "transmitter_m": place}).data
        for place in (truth.clean.aux["transmitter_m"], moved, known["transmitter_m"])
    )
    after, bad = registered_error_db(after, ideal), registered_error_db(bad, ideal)
    assert bool((after < -22).all()) and bool((bad > -12).all()), (bad, after)


@pytest.mark.slow
def test_errors_of_several_fringes_are_found() -> None:
    recording, truth = strips(error_m=5e-3, seed=8)
    found = strip_autofocus(recording.signal.data, recording.aux["frequency_hz"], path_of(recording), **STRIP)
    inside = judged()[None]
    true = RADIANS * truth.values["line_of_sight_m"]
    error = phase_rmse(RADIANS * found["line_of_sight_m"], true, inside)
    before = phase_rmse(0 * true, true, inside)
    assert bool((before > 1).all()) and bool((error < 0.25).all()), (before, error)


@pytest.mark.slow
def test_noise_zeros_and_few_scatterers_are_not_ok_and_pulses_of_zeros_are_left_out() -> None:
    recording, _ = strips(seed=6)
    frequency, path = recording.aux["frequency_hz"], path_of(recording).of_trial((0,))
    noise = torch.randn(PULSES, CELLS, dtype=torch.complex64, generator=torch.Generator().manual_seed(1))
    few, _ = strips(Points([0.0], [3.0]), seed=2)
    for data in (noise, 0 * noise, few.signal.data[0]):
        found = strip_autofocus(data, frequency, path, **STRIP)
        assert not bool(found.ok) and bool(found["offset_m"].isfinite().all())
    data = recording.signal.data[0].clone()
    data[300:310] = 0
    found = strip_autofocus(data, frequency, path, **STRIP)
    assert bool(found.ok) and bool(found["offset_m"].isfinite().all())


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        ({"azimuth_m": 0.0}, "positive extents, got azimuth_m=0.0"),
        ({"centre_m": (0.0, math.nan)}, "finite numbers"),
        ({"beam_deg": -1.0}, "positive width_deg"),
        ({"centre_m": (0.0, 5000.0)}, "no pulse sees the strip"),
    ],
)
def test_bad_strips_are_refused(changed: dict[str, float], sentence: str) -> None:
    recording, _ = strips()
    with pytest.raises(ValueError, match=sentence):
        strip_autofocus(
            recording.signal.data, recording.aux["frequency_hz"], path_of(recording), **{**STRIP, **changed}
        )


@pytest.mark.slow
def test_values_without_assessment_are_those_with_it() -> None:
    recording, _ = strips(seed=5)
    known = {name: recording.aux[name] for name in KNOWN}
    found, alone = (StripAutofocus(**STRIP, assess=assess)(recording.signal, **known) for assess in (True, False))
    assert found.outcome.tolist() == [Outcome.OK] and alone.outcome.tolist() == [Outcome.NOT_ASSESSED]
    assert not alone.std and torch.equal(alone["offset_m"], found["offset_m"])


def test_a_curve_is_that_of_dense_least_squares() -> None:
    made = torch.Generator().manual_seed(3)

    def normal(*size: int) -> Tensor:
        return torch.randn(*size, dtype=F64, generator=made)

    pulses, count, scatterers, seen = 40, 6, 5, 16
    basis = cosines(pulses, count, torch.device("cpu"))
    at = torch.randint(pulses - seen, (scatterers, 1), generator=made) + torch.arange(seen)
    curve = Curve(basis, at, normal(scatterers, seen, 2), normal(scatterers, seen, 3))
    phase, weight = normal(scatterers, seen), normal(scatterers, seen).square()
    weight[0] = 0  # nothing is known of the first
    power, known = normal(2, count).square(), normal(scatterers, 3).square()
    coefficient, covariance, added = curve.solved(phase, weight, power, known)
    columns = torch.zeros(scatterers, seen, 2 * count + 3 * scatterers, dtype=F64)
    for axis in range(2):
        columns[..., axis * count : (axis + 1) * count] = curve.lever[..., axis, None] * basis[at]
    for i in range(scatterers):
        columns[i, :, 2 * count + 3 * i : 2 * count + 3 * i + 3] = curve.own[i]
    rows, prior = columns.flatten(0, 1), torch.cat([1 / power.flatten(), known.flatten()])
    whole = rows.mT @ (weight.reshape(-1, 1) * rows) + torch.diag(prior)
    wanted = torch.linalg.solve(whole, rows.mT @ (weight * phase).flatten())
    torch.testing.assert_close(coefficient.flatten(), wanted[: 2 * count], rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(covariance, torch.linalg.inv(whole)[: 2 * count, : 2 * count], rtol=1e-6, atol=1e-9)
    own = (rows[:, 2 * count :] @ wanted[2 * count :]).reshape(scatterers, seen)
    torch.testing.assert_close(added[1:], own[1:], rtol=1e-6, atol=1e-8)


def test_echoes_are_direct_sums_and_hold_those_of_others_at_their_range() -> None:
    recording, truth = strips(Points([0.0, 4.0, -20.0], [0.0, 0.5, 0.3]), snr_db=None, error_m=0.0)
    frequency, path = recording.aux["frequency_hz"], path_of(recording).of_trial((0,))
    history = frequency_samples(recording.signal.data[0].to(torch.complex128))
    weights = torch.hann_window(CELLS, dtype=F64)
    weights = weights / weights.sum()
    places = torch.stack([truth.values[f"{axis}_m"].reshape(-1) for axis in ("range", "azimuth", "height")], -1)
    echoes = Echoes.of(
        history, frequency, weights, path, places, lambda x: ProcessedBeam(6.0).lit_pulses(path.transmitter_m, x)
    )
    phase = 2j * math.pi * path.path_m(places).mT[..., None] * frequency / 299792458.0  # (scatterer, pulse, frequency)
    direct = (weights * history * phase.exp()).sum(-1).gather(1, echoes.pulses) * echoes.seen
    torch.testing.assert_close(echoes.samples, direct, rtol=1e-8, atol=1e-8 * float(direct.abs().max()))
    # unit echoes of the three, as the sum over frequencies gives them
    model = echoes.seen.to(torch.complex128)
    unit = (weights * phase.exp()[:, None] * (-phase).exp()).sum(-1)  # (place, scatterer, pulse)
    lit = torch.zeros(3, PULSES, dtype=torch.bool).scatter(1, echoes.pulses, echoes.seen)
    wanted = (unit * lit).sum(1) - unit.diagonal().mT * lit
    wanted = wanted.gather(1, echoes.pulses) * echoes.seen
    assert float(wanted.abs().max()) > 0.3
    torch.testing.assert_close(echoes.crossed(model), wanted, rtol=0, atol=2e-3)


def test_prominent_places_are_those_above_clutter_and_not_their_side_lobes() -> None:
    made = torch.Generator().manual_seed(4)
    image = torch.randn(200, 60, dtype=torch.complex64, generator=made)
    image[50, 20], image[120, 40], image[58, 20] = 100.0, 8.0, 9.0  # the last one is a side lobe of the first
    grid = ImageGrid(torch.tensor([-3.0, -50.0, 0.0]), torch.tensor([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]), (200, 60), 0.5)
    places = prominent_places(image, grid, (1.0, 2.0), 10)
    wanted = torch.tensor([[7.0, -25.0, 0.0], [17.0, 10.0, 0.0]], dtype=F64)
    torch.testing.assert_close(places, wanted, rtol=0, atol=0.3)
    assert not len(prominent_places(0 * image, grid, (1.0, 2.0), 10))


def test_points_abeam_lie_on_the_level_line_through_the_middle() -> None:
    place = torch.stack([torch.zeros(5), torch.arange(5.0), 100 + 0.1 * torch.arange(5.0)], -1).double()
    points = StraightTrack.fitted(place).abeam_m(place, torch.tensor([30.0, 2.0, 1.0], dtype=F64))
    wanted = torch.stack([torch.full((5,), 30.0), torch.arange(5.0), torch.ones(5)], -1).double()
    torch.testing.assert_close(points, wanted)
