"""Gain and phase imbalance of channels that record the lines in turn."""

from __future__ import annotations

import math

import pytest
import torch

from torchsar.core import Axis, Chain, Draws, Outcome, Recording, Signal, use
from torchsar.echo import ChannelImbalance
from torchsar.io import read_stripmap
from torchsar.metrics import correlation
from torchsar.repair import CorrectImbalance, EstimateImbalance, correct_imbalance, estimate_imbalance
from torchsar.study.bench.repairs import imbalance

DEGREE = math.pi / 180


def scene(lines=256, n=512, seed=0, centre=0.3, trials=2):
    """Speckle whose Doppler spectrum is a raised cosine about `centre` cycles per line."""
    white = torch.randn(trials, lines, n, dtype=torch.complex128, generator=torch.Generator().manual_seed(seed))
    f = torch.fft.fftfreq(lines, dtype=torch.float64)[:, None]
    return torch.fft.ifft(torch.fft.fft(white, dim=-2) * (1 + torch.cos(2 * math.pi * (f - centre))), dim=-2)


def unbalanced(x, gain, degrees):
    """Lines times the gain and phase of their channel."""
    factor = torch.polar(torch.tensor(gain, dtype=torch.float64), torch.tensor(degrees, dtype=torch.float64) * DEGREE)
    return x * factor[torch.arange(x.shape[-2]) % len(gain), None].to(x.dtype)


@pytest.mark.parametrize(
    "gain, degrees",
    [((1, 1.2), (0, 60)), ((1, 0.7), (0, -85)), ((1, 1.2, 0.9), (0, 30, -25)), ((1, 1, 1.1, 0.8), (0, 20, -15, 30))],
)
@pytest.mark.parametrize("seed", [0, 1])
def test_imbalance_within_its_predicted_error(gain, degrees, seed):
    x = scene(seed=seed)
    estimate = estimate_imbalance(unbalanced(x, gain, degrees), len(gain))
    assert bool(estimate.ok.all())
    assert bool(((estimate["gain"] - torch.tensor(gain)).abs() <= 5 * estimate.std["gain"] + 1e-12).all())
    assert bool(
        (
            (estimate["phase_rad"] / DEGREE - torch.tensor(degrees)).abs()
            <= 5 * estimate.std["phase_rad"] / DEGREE + 1e-9
        ).all()
    )
    assert float(estimate.std["phase_rad"].max()) < 0.5 * DEGREE and float(estimate.std["gain"].max()) < 0.01


def test_deviations_of_a_point_and_of_noise():
    """The chirp of a point is the same in both channels."""
    generator = torch.Generator().manual_seed(2)
    noise = torch.randn(40, 128, 64, dtype=torch.complex128, generator=generator)
    k = torch.arange(128, dtype=torch.float64) - 64
    chirp = torch.zeros_like(noise)
    chirp[..., 20] = 8 * torch.polar(torch.ones_like(k), math.pi * 0.8 * k.square() / 128)
    band = torch.fft.fftfreq(64).abs() < 0.38
    field = torch.fft.ifft(torch.fft.fft(scene(128, 64, trials=40)) * band)
    field = field / field.abs().square().mean().sqrt()
    for x in (chirp + 0.1 * noise, field + noise):
        found = estimate_imbalance(unbalanced(x, (1, 1.3), (0, 50)))
        ok = found.ok
        assert float(ok.double().mean()) > 0.6
        for name, true in (("gain", 1.3), ("phase_rad", 50 * DEGREE)):
            ratio = (found[name][ok, 1] - true).square().mean().sqrt() / found.std[name][ok, 1].square().mean().sqrt()
            assert 0.4 < float(ratio) < 1.4, (name, float(ratio))


def test_the_doppler_centroid_resolves_phases_beyond_ninety_degrees():
    y = unbalanced(scene(centre=0.3), (1, 1.0), (0, 130))
    blind, with_doppler = estimate_imbalance(y), estimate_imbalance(y, doppler_cycles=torch.tensor([0.3, 0.33]))
    assert bool(((blind["phase_rad"][:, 1] / DEGREE + 50).abs() < 1).all())
    assert bool(((with_doppler["phase_rad"][:, 1] / DEGREE - 130).abs() < 1).all())


def test_outcomes_and_values_without_assessment(monkeypatch):
    noise = torch.randn(2, 256, 64, dtype=torch.complex128, generator=torch.Generator().manual_seed(3))
    found = estimate_imbalance(torch.stack([noise[0], 0 * noise[0], unbalanced(scene(256, 64)[0], (1, 1.2), (0, 9))]))
    assert found.outcome.tolist() == [Outcome.NOISE, Outcome.EMPTY, Outcome.OK]
    few = unbalanced(scene(10, 16, trials=40), (1, 1.3), (0, 50))
    found = estimate_imbalance(few)
    assert (
        set(found.outcome.tolist()) <= {Outcome.TOO_FEW, Outcome.NOISE} and float(found.doubtful.double().mean()) > 0.9
    )
    error = found["phase_rad"][found.doubtful, 1] - 50 * DEGREE
    assert float(error.square().mean().sqrt()) < 10 * DEGREE  # a fifth of what it corrects
    monkeypatch.setattr("torchsar.repair.receiver.assess_imbalance", None)
    plain = EstimateImbalance(assess=False)(
        Signal(few, (Axis("pulse", 10, 0.0, 1.0, "s"), Axis("range", 16, 0.0, 1.0, "m")))
    )
    assert plain.outcome.tolist() == [Outcome.NOT_ASSESSED] * 40 and not plain.std
    assert all(torch.equal(plain[name], found[name]) for name in found.value)


def test_empty_trials_are_not_ok_and_the_scale_does_not_matter():
    y = (
        unbalanced(scene(trials=3), (1, 1.2), (0, 60)).to(torch.complex64)
        * torch.tensor([1e-22, 1.0, 0.0])[:, None, None]
    )
    estimate = estimate_imbalance(y)
    assert estimate.ok.tolist() == [True, True, False]
    assert estimate.failed.tolist() == [False, False, True] and bool(torch.isfinite(estimate["gain"]).all())
    assert bool(((estimate["gain"][:2, 1] - 1.2).abs() < 0.02).all())


def test_correction_is_the_inverse_and_differentiable():
    x = scene(8, 4)
    gain, phase = torch.tensor([1.0, 1.2], dtype=torch.float64), torch.tensor([0.0, 60 * DEGREE], dtype=torch.float64)
    torch.testing.assert_close(correct_imbalance(unbalanced(x, (1, 1.2), (0, 60)), gain, phase), x)
    assert torch.autograd.gradcheck(
        lambda g, p: torch.view_as_real(correct_imbalance(x, g, p)), (gain.requires_grad_(), phase.requires_grad_())
    )


@pytest.mark.parametrize("lines", [64, 10])
def test_gradients_of_an_estimate_are_finite(lines):
    """Those of the standard deviation of channel 0, which has no error, were not a number."""
    x = unbalanced(scene(lines, 16), (1, 1.2), (0, 60)).requires_grad_()
    estimate = estimate_imbalance(x)
    total = sum(v.sum() for v in (*estimate.value.values(), *estimate.std.values()))
    assert bool(torch.autograd.grad(total, x)[0].isfinite().all())


def test_too_few_lines_raise():
    with pytest.raises(ValueError, match="more than twice as many lines as channels, got 2 channels and 4 lines"):
        estimate_imbalance(torch.zeros(4, 8, dtype=torch.complex64))


@pytest.mark.slow
@pytest.mark.parametrize("name, hz", [("radarsat1_english_bay.npz", 488.0), ("radarsat1_squamish.npz", 549.0)])
def test_even_and_odd_lines_of_recorded_data(recorded, name, hz):
    clean = read_stripmap(recorded(name))
    impaired, _ = ChannelImbalance((1, 1.2), (0, 60 * DEGREE))(clean, Draws(0))
    chain = Chain(
        imbalance=EstimateImbalance(), equalise=use(CorrectImbalance(), gain="imbalance", phase_rad="imbalance")
    )
    trace = chain.trace(impaired)
    assert isinstance(impaired, Recording)
    assert abs(float(trace.values["imbalance.gain"][1]) - 1.2) < 0.0036
    assert abs(float(trace.values["imbalance.phase_rad"][1]) / DEGREE - 60) < 0.2
    assert float(correlation(trace.signal.data.to(torch.complex128), clean.signal.data.to(torch.complex128))) > 0.99999
    with_doppler = EstimateImbalance()(impaired.signal, doppler_hz=torch.tensor(hz, dtype=torch.float64))
    torch.testing.assert_close(with_doppler["phase_rad"], trace.values["imbalance.phase_rad"])


@pytest.mark.parametrize("over_db", [-30.0, -15.0, -5.0, 10.0, 30.0])
def test_constants_of_converters_are_named(over_db: float) -> None:
    """A constant that held the energy was taken for equal channels, and ok."""
    batch = imbalance(10.0)(8, 3)
    data, turn = batch.data.data, torch.rand(8, 2, 1, generator=torch.Generator().manual_seed(1))
    level = data.abs().square().mean((-2, -1), keepdim=True).sqrt() * 10 ** (over_db / 20)
    own = level * torch.polar(torch.ones_like(turn), 2 * math.pi * turn)[:, torch.arange(data.shape[-2]) % 2]
    found = estimate_imbalance((data + own).to(data.dtype))
    if over_db > -10:
        assert bool((found.outcome == Outcome.AT_REST).all())
    else:
        assert bool(found.ok.all())
        for name in ("gain", "phase_rad"):
            off = (found[name] - batch.truth[name])[..., 1].abs()
            assert bool((off < 5 * found.std[name][..., 1] + 1e-3).all())
