"""The autofocus functions on data of any scale, with gaps, too small, too strong, or pure noise."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from tests.compensate.scenes import DOUBLE, METHODS, noise, noisy, still, turned, white
from torchsar.compensate import autofocus, correct_pulse_phase, entropy_fixed_point, link_phases, pga, phase_polish, sca
from torchsar.compensate.pulse_phase.homogeneous import occupied_band
from torchsar.compensate.pulse_phase.sharpness import sharpness_of_noise
from torchsar.metrics import phase_rmse, residual_phase

NAMES = list(METHODS)


def scene(trials: int = 2, snr_db: float = 10.0, **kwargs) -> tuple[Tensor, Tensor]:
    x, a = noisy(still(trials, **kwargs), snr_db), white(trials, kwargs.get("n_pulse", 128))
    return turned(x, a), a


# scale


@pytest.mark.slow
@pytest.mark.parametrize(
    "dtype, scale",
    [
        (DOUBLE, 1e160),
        (DOUBLE, 1e-160),
        (DOUBLE, 1e300),
        (DOUBLE, 1e-300),
        (torch.complex64, 1e25),
        (torch.complex64, 1e-25),
        (torch.complex64, 1e-37),
    ],
)
@pytest.mark.parametrize("name", NAMES)
def test_scale_has_no_effect(name, dtype, scale):
    x, _ = scene(2, n_pulse=64, n_range=32)
    plain, scaled = METHODS[name](x.to(dtype)), METHODS[name]((x * scale).to(dtype))
    assert float(residual_phase(scaled["phase_rad"], plain["phase_rad"]).abs().max()) < (
        1e-5 if dtype == torch.complex64 else 1e-10
    )
    assert torch.equal(scaled.ok, plain.ok) and torch.isfinite(scaled.quality).all()


@pytest.mark.parametrize("name", NAMES)
def test_single_precision_estimates_as_well(name):
    x, a = scene(2)
    single, double = METHODS[name](x.to(torch.complex64)), METHODS[name](x)
    assert single["phase_rad"].dtype == single.quality.dtype == torch.float32
    torch.testing.assert_close(
        phase_rmse(single["phase_rad"], a), phase_rmse(double["phase_rad"], a), atol=1e-4, rtol=0
    )


# rejected input


@pytest.mark.parametrize("bad", [math.nan, math.inf, complex(0, -math.inf)])
@pytest.mark.parametrize("name", NAMES)
def test_non_finite_samples_are_rejected_with_their_position(name, bad):
    x, _ = scene(2, n_pulse=16, n_range=8)
    x[1, 3, 5] = bad
    with pytest.raises(ValueError, match=r"1 of 256 samples are NaN or Inf, the first at index \(1, 3, 5\)"):
        METHODS[name](x)


@pytest.mark.parametrize("name", NAMES)
def test_real_data_are_rejected(name):
    for bad in (torch.ones(8, 4), torch.ones(8, 4, dtype=torch.int64), [[1j, 2.0]]):
        with pytest.raises(TypeError, match="complex"):
            METHODS[name](bad)  # pyright: ignore[reportArgumentType]


# empty data


@pytest.mark.parametrize("name", NAMES)
def test_an_empty_trial_gives_zero_and_does_not_affect_others(name):
    x, _ = scene(3, n_pulse=64, n_range=32)
    x[1] = 0
    found, rest = METHODS[name](x), METHODS[name](x[[0, 2]])
    assert (
        not found["phase_rad"][1].any()
        and not found.ok[1]
        and found.quality[1] == 0
        and torch.isfinite(found.std["phase_rad"]).all()
    )
    torch.testing.assert_close(found["phase_rad"][[0, 2]], rest["phase_rad"], atol=1e-12, rtol=0)


@pytest.mark.parametrize("name", NAMES)
def test_zero_trials_give_an_empty_estimate(name):
    found = METHODS[name](torch.zeros(0, 3, 16, 8, dtype=torch.complex64))
    assert found["phase_rad"].shape == found.info["present"].shape == (
        0,
        3,
        16,
    ) and found.ok.shape == found.quality.shape == (0, 3)


@pytest.mark.parametrize("method", [link_phases, phase_polish])
def test_zero_trials_give_an_empty_estimate_of_the_other_phases(method):
    found = method(torch.zeros(0, 3, 16, 8, dtype=torch.complex64))
    assert found["phase_rad"].shape == (0, 3, 16) and found.ok.shape == found.quality.shape == (0, 3)


@pytest.mark.parametrize("name", NAMES)
def test_rows_of_zeros_are_harmless(name):
    x, a = scene(2, n_pulse=96, n_range=32)
    wide = torch.zeros(2, 96, 80, dtype=DOUBLE)
    wide[..., 5:69:2] = x
    error, wider = phase_rmse(METHODS[name](x)["phase_rad"], a), phase_rmse(METHODS[name](wide)["phase_rad"], a)
    assert bool((wider < 1.3 * error + 0.02).all())


# too few pulses or range cells


@pytest.mark.parametrize("n_pulse", [1, 2])
@pytest.mark.parametrize("name", NAMES)
def test_too_few_pulses_give_zero_and_a_warning(name, n_pulse):
    with pytest.warns(UserWarning, match=rf"phase error of {n_pulse} pulse\(s\) cannot be distinguished"):
        found = METHODS[name](noise(3, n_pulse, 8))
    assert (
        found["phase_rad"].shape == (3, n_pulse)
        and not found["phase_rad"].any()
        and not found.ok.any()
        and not found.quality.any()
    )


@pytest.mark.parametrize("name", NAMES)
def test_one_row_warns_and_is_not_ok(name):
    x, _ = scene(4, 30.0, n_range=1)
    with pytest.warns(UserWarning, match="with one range cell, phase errors cannot be distinguished"):
        found = METHODS[name](x)
    assert torch.isfinite(found["phase_rad"]).all() and not found.ok.any()


@pytest.mark.parametrize("shape", [(3, 2), (3, 7), (4, 4), (5, 1, 3, 3), (7, 5)])
@pytest.mark.filterwarnings("ignore:.*one range cell")
@pytest.mark.parametrize("name", NAMES)
def test_tiny_shapes_are_kept(name, shape):
    found = METHODS[name](torch.randn(shape, dtype=torch.complex64, generator=torch.Generator().manual_seed(0)))
    assert (
        found["phase_rad"].shape == shape[:-1]
        and found.ok.shape == shape[:-2]
        and torch.isfinite(found["phase_rad"]).all()
        and not found.ok.any()
    )


def test_one_pulse_or_two_still_carry_gradients():
    x = torch.randn(2, 2, 4, dtype=DOUBLE, requires_grad=True)
    with pytest.warns(UserWarning, match="cannot be distinguished from a shift"):
        sca(x)["phase_rad"].sum().backward()
    assert x.grad is not None and not x.grad.any()


@pytest.mark.parametrize("name", ["pga_sca", "entropy_fixed_point", "autofocus"])
@pytest.mark.parametrize("n_pulse", [127, 96, 101])
def test_any_number_of_pulses(name, n_pulse):
    x, a = scene(2, 20.0, n_pulse=n_pulse, n_range=31)
    found = METHODS[name](x)
    assert found.ok.all() and bool((phase_rmse(found["phase_rad"], a) < 0.25).all())


# lost pulses

LOST = {
    "one": [100],
    "ten": [7, 22, 41, 60, 61, 98, 130, 131, 160, 185],
    "ends": [0, 1, 2, 198, 199],
    "a run of 20": list(range(70, 90)),
    "every second": list(range(1, 200, 2)),
    "two of three": [k for k in range(200) if k % 3],
}


@pytest.mark.slow
@pytest.mark.parametrize("where", LOST)
@pytest.mark.parametrize("name", ["pga_sca", "entropy_fixed_point", "autofocus"])
def test_lost_pulses_are_bridged(name, where):
    x, a = scene(3, 10.0, n_pulse=200)
    whole = phase_rmse(METHODS[name](x)["phase_rad"], a)
    x[:, LOST[where]] = 0
    present = torch.ones(200, dtype=torch.bool)
    present[LOST[where]] = False
    found = METHODS[name](x)
    error = phase_rmse(found["phase_rad"], a, present)
    assert torch.equal(found.info["present"], present.expand(3, -1)) and found.ok.all()
    assert float(error.median()) < (1.3 if len(LOST[where]) <= 20 else 2.0) * float(whole.median())


def test_sca_bridges_where_the_scene_is_coherent_over_the_gap():
    """The scene occupies a fifth of the Doppler band, so pulses two apart are still coherent.

    With half of the band they are not, and no product of two pulses bridges the gap.
    """
    x, a = scene(6, 20.0, n_pulse=200, width=0.2)
    whole = float(phase_rmse(sca(x)["phase_rad"], a).median())
    x[:, LOST["ten"]] = 0
    present = (x != 0).any(-1)
    assert float(phase_rmse(sca(x)["phase_rad"], a, present).median()) < 1.5 * whole


def test_lost_pulses_may_differ_between_trials():
    x, _ = scene(3, 10.0)
    x[0, 10:14], x[2, ::5] = 0, 0
    together = autofocus(x)
    for i in range(3):
        torch.testing.assert_close(together["phase_rad"][i], autofocus(x[i])["phase_rad"], atol=1e-11, rtol=0)


# noise alone


@pytest.mark.slow
@pytest.mark.parametrize("shape", [(128, 16), (64, 48), (96, 2), (96, 3), (128, 5), (16, 16), (6, 64), (32, 100)])
@pytest.mark.parametrize("name", NAMES)
def test_noise_is_not_ok(name, shape):
    assert not METHODS[name](noise(40, *shape)).ok.any()


@pytest.mark.parametrize("oversampling", [2, 4, 8])
@pytest.mark.parametrize("name", ["sca", "entropy_fixed_point", "autofocus"])
def test_oversampled_noise_is_not_ok(name, oversampling):
    spectrum = torch.zeros(8, 96, 160, dtype=torch.complex64)
    spectrum[..., : 160 // oversampling] = noise(8, 96, 160 // oversampling)
    x = torch.fft.ifft(spectrum, dim=-1)
    torch.testing.assert_close(
        occupied_band(torch.fft.fft(x.mT, dim=-2)),
        torch.full((8,), 1 / oversampling, dtype=torch.float64),
        atol=0,
        rtol=0.05,
    )
    assert not METHODS[name](x).ok.any()


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind",
    [
        "rows of many levels",
        "pulses of many levels",
        "one bright pulse",
        "one bright sample",
        "most pulses lost",
        "7 of 8 pulses lost",
    ],
)
@pytest.mark.parametrize("name", NAMES)
def test_nonuniform_noise_is_not_ok(name, kind):
    x = noise(10, 96, 64)
    g = torch.Generator().manual_seed(2)
    if kind == "rows of many levels":
        x = x * 10 ** torch.rand(10, 1, 64, generator=g)
    elif kind == "pulses of many levels":
        x = x * 10 ** torch.randn(10, 96, 1, generator=g)
    elif kind == "one bright pulse":
        x[:, 5] *= 1e4
    elif kind == "one bright sample":
        x[:, 5, 7] *= 1e4
    elif kind == "most pulses lost":
        x[:, 20:] = 0
    else:
        x[:, torch.arange(96) % 8 > 0] = 0
    assert not METHODS[name](x).ok.any()


@pytest.mark.parametrize("rows", [4, 16, 64])
def test_fitted_sharpness_of_noise_equals_the_measured_one(rows):
    """The fit agrees with the sharpness that the entropy fixed point reaches on noise."""
    found = entropy_fixed_point(noise(12, 128, rows, DOUBLE), floors=((2.5, 120),))
    assert float(found.info["sharpness_nats"].mean() / sharpness_of_noise(torch.tensor(float(rows)))) == pytest.approx(
        1, abs=0.35
    )
    assert float((found.info["sharpness_nats"] / found.info["noise_sharpness_nats"]).max()) < 1.5


# strong scatterers


@pytest.mark.parametrize("above_db", [20, 60, 100])
@pytest.mark.parametrize("name", ["sca", "pga_sca", "entropy_fixed_point", "autofocus"])
def test_a_strong_scatterer_determines_the_phase(name, above_db):
    """It also makes all of the sharpness; the steady modulus of its echo confirms the phases."""
    x, a = still(2, width=0.8), white(2)
    k = torch.arange(128, dtype=torch.float64)
    x[..., 20] += 10 ** (above_db / 20) * x.abs().amax() * torch.exp(2j * math.pi * 0.1371 * k)
    found = METHODS[name](turned(x, a).to(torch.complex64))
    error = phase_rmse(found["phase_rad"], a)
    assert float(error.max()) < 0.6 * 10 ** (-above_db / 20) + 1e-5 and found.ok.all()
    assert (error < 1.5 * found.std["phase_rad"][:, 0] + 1e-5).all()


# layout, batches, threads


@pytest.mark.parametrize("name", NAMES)
def test_memory_layout_has_no_effect(name):
    x, _ = scene(2, n_pulse=48, n_range=24)
    expected = METHODS[name](x)["phase_rad"]
    for other in (
        x.mT.contiguous().mT,
        torch.stack([x, x], -1)[..., 0],
        torch.cat([x, x])[::2][:1].expand(2, -1, -1),
        x.conj().resolve_conj().conj(),
    ):
        want = (
            expected
            if other.shape == x.shape and torch.equal(other, x)
            else METHODS[name](other.resolve_conj().contiguous())["phase_rad"]
        )
        torch.testing.assert_close(METHODS[name](other)["phase_rad"], want, atol=1e-12, rtol=0)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_a_trial_does_not_depend_on_its_batch(name):
    x, _ = scene(5, 5.0, n_pulse=100, n_range=48)
    x = x * torch.logspace(-3, 3, 5)[:, None, None]
    together = METHODS[name](x)
    grid = METHODS[name](x[:4].reshape(2, 2, 100, 48))
    torch.testing.assert_close(grid["phase_rad"].reshape(4, 100), together["phase_rad"][:4], atol=1e-12, rtol=0)
    for i in range(5):
        for alone in (METHODS[name](x[i]), METHODS[name](x[[i, i - 1]])):
            first = alone["phase_rad"].reshape(-1, 100)[0]
            torch.testing.assert_close(first, together["phase_rad"][i], atol=1e-12, rtol=0)
            assert bool(alone.ok.reshape(-1)[0]) == bool(together.ok[i])


@pytest.mark.parametrize("name", ["sca", "pga_sca", "autofocus"])
def test_threads_have_no_effect(name):
    x, _ = scene(24, 5.0, n_pulse=64, n_range=96)
    threads = torch.get_num_threads()
    try:
        found = []
        for count in (1, 2):
            torch.set_num_threads(count)
            found.append(METHODS[name](x)["phase_rad"])
    finally:
        torch.set_num_threads(threads)
    torch.testing.assert_close(found[0], found[1], atol=1e-12, rtol=0)


@pytest.mark.parametrize("name", NAMES)
def test_many_tiny_trials(name):
    x, _ = scene(500, 20.0, n_pulse=12, n_range=6)
    x = x.repeat(4, 1, 1).to(torch.complex64)
    found = METHODS[name](x)
    assert torch.isfinite(found["phase_rad"]).all()
    torch.testing.assert_close(found["phase_rad"][:500], found["phase_rad"][1500:], atol=2e-4, rtol=0)


# gradients


@pytest.mark.parametrize(
    "find",
    [
        sca,
        lambda x: entropy_fixed_point(x, floors=((3.0, 3),), tolerance_rad=0.0),
        lambda x: pga(x, kernel="ml", iterations=2),
        lambda x: autofocus(x, search=3, polish=2, search_tolerance_rad=0.0, tolerance_rad=0.0),
    ],
    ids=["sca", "entropy_fixed_point", "pga", "autofocus"],
)
def test_gradients(find):
    x, _ = scene(2, 20.0, n_pulse=9, n_range=6)
    assert torch.autograd.gradcheck(
        lambda data: find(data)["phase_rad"], x.requires_grad_(), fast_mode=True, atol=1e-5, rtol=1e-4
    )


def test_gradients_through_lost_pulses_and_empty_trials_are_finite():
    x, _ = scene(3, n_pulse=12, n_range=6)
    x[0], x[1, 4:6] = 0, 0
    x.requires_grad_()
    for find in (sca, entropy_fixed_point):
        (gradient,) = torch.autograd.grad(find(x)["phase_rad"].square().sum(), x)
        assert torch.isfinite(gradient).all() and gradient[2].abs().max() > 0 and not gradient[0].any()


def test_gradients_of_the_corrector():
    x, a = scene(2, n_pulse=5, n_range=3)
    assert torch.autograd.gradcheck(correct_pulse_phase, (x.requires_grad_(), (40 * a).requires_grad_()))
    assert torch.autograd.gradcheck(correct_pulse_phase, (x, a[0].clone().requires_grad_()))
