"""The recommended estimator of non-uniform rotation, its steps and stages, on thirty points."""

from __future__ import annotations

import math
from functools import partial

import pytest
import torch
from torch import Tensor

from tests.compensate.turning import (
    BINS,
    F64,
    OMEGA,
    OPTIONS,
    PRF,
    PULSES,
    RADAR,
    RANGE_M,
    WAVELENGTH,
    K,
    echo,
    noise,
    noise_std,
    points,
    target,
    targets,
)
from torchsar.compensate import (
    CoarseRotation,
    CorrectPulsePhase,
    RotationAutofocus,
    UnevenRotation,
    autofocus,
    coarse_rotation,
    rotation_autofocus,
    uneven_rotation,
)
from torchsar.compensate.rotation import recommended
from torchsar.compensate.rotation.coarse import coarse_warp
from torchsar.core import Alternate, Chain, Draws, Estimate, Outcome, Signal, Turn, use
from torchsar.echo import simulate_turntable
from torchsar.focus import RangePhase
from torchsar.metrics import rotation_bounds
from torchsar.radar import LIGHT_M_S, InverseRadar
from torchsar.radar.warp import least_rate, warp
from torchsar.scene import PolynomialRotation, Satellite, TurntableWorld

ESTIMATORS = {"coarse": coarse_rotation, "phase_fit": partial(coarse_rotation, fits=4), "uneven": uneven_rotation}


def z_scores(found: Estimate, k: Tensor, yc_m: float | None = 0.0) -> Tensor:
    """Errors over predicted standard deviations, (trial, unknown); k: (order, ...)."""
    truth = {"omega_rad_s": OMEGA, **{f"k{i + 1}_per_s{i + 1 if i else ''}": value for i, value in enumerate(k)}}
    truth |= {} if yc_m is None else {"yc_m": yc_m}
    return torch.stack([(found[name] - value) / found.std[name] for name, value in truth.items()], -1)


@pytest.mark.slow
def test_any_rotation_is_found_without_a_start() -> None:
    """Rotations far outside of any box about the truth; what is wrong is not ok.

    (0, 5000) is the hardest: the rate doubles over the aperture.
    """
    k = [(10.0, 1000.0), (0.0, 0.0), (20.0, -500.0), (-5.0, 3000.0), (40.0, 0.0), (0.0, 5000.0)]
    rotations = torch.tensor(k, dtype=F64)
    found = uneven_rotation(torch.stack([targets(4, k=one) for one in rotations]), **OPTIONS)
    right = (z_scores(found, rotations[:, None].movedim(-1, 0)).abs() < 6).all(-1)
    assert (right.sum(-1) >= 3).all() and not (found.ok & ~right).any()


@pytest.mark.slow
@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("order", [1, 2, 3, 4])
def test_every_order_with_the_centre_known_or_not(order: int, known: bool) -> None:
    truth = torch.tensor([10.0, 1000.0, 2e5], dtype=F64)[: order - 1]
    found = uneven_rotation(target(4, k=truth, yc_m=1.5), **OPTIONS, order=order, yc_m=1.5 if known else None)
    assert found.ok and found["warp_k"].shape == (order - 1,)
    assert z_scores(found, truth, None if known else 1.5).abs().max() < 5
    assert found["yc_m"] == 1.5 if known else found.std["yc_m"] < 0.1


@pytest.mark.slow
def test_a_known_centre_per_trial() -> None:
    data = torch.stack([target(4, yc_m=yc) for yc in (-2.0, 0.0, 1.5)])
    centre = torch.tensor([-2.0, 0.0, 1.5], dtype=F64)
    for name, estimator in ESTIMATORS.items():
        found = estimator(data, **OPTIONS, yc_m=centre)
        assert torch.equal(found["yc_m"], centre)
        assert name == "coarse" or (found["omega_rad_s"] / OMEGA - 1).abs().max() < 0.05
    wrong = uneven_rotation(data, **OPTIONS, yc_m=0.0)
    assert (wrong["omega_rad_s"] / OMEGA - 1).abs().tolist()[0] > 0.02, "a wrong range centre biases the rate"


@pytest.mark.slow
@pytest.mark.parametrize("snr_db", [0.0, 20.0])
def test_predicted_std_matches_the_errors_and_the_bound(snr_db: float) -> None:
    data = torch.stack([target(0, snr_db, draw=draw) for draw in range(10)])
    found = uneven_rotation(data, **OPTIONS)
    x, y, amplitude = points(0)
    std = noise_std(echo(x, y, amplitude), snr_db)
    bound = rotation_bounds(x, y, amplitude, std, OMEGA, K, wavelength_m=WAVELENGTH, prf_hz=PRF, n_pulse=PULSES)
    assert found.ok.all()
    for name, least in bound.items():
        assert 0.9 * least < found.std[name].median() < 1.4 * least, name
    rms = z_scores(found, K).square().mean(0).sqrt()
    assert (rms > 0.5).all() and (rms < 1.5).all()


@pytest.mark.slow
def test_few_scatterers_are_judged_as_well_as_many() -> None:
    """Three points contradict hardly any rotation; the noise alone then limits the errors."""
    data = []
    for seed in range(10):
        clean = echo(*points(3000 + seed, 3))
        data.append(clean + noise_std(clean, 10.0) * noise(3000 + seed, *clean.shape))
    found = uneven_rotation(torch.stack(data).to(torch.complex64), **OPTIONS)
    assert found.ok.double().mean() > 0.4
    over_std = z_scores(found, K)[found.ok, :3].square().mean(0).sqrt()
    # of a few scenes one value scatters by a third, all three by less
    assert (over_std < 1.7).all() and 0.6 < float(over_std.square().mean().sqrt()) < 1.4


@pytest.mark.slow
def test_a_target_of_many_weak_scatterers_is_fitted_with_more_of_them() -> None:
    """The usual number explains 47 % of the energy of 600 scatterers."""
    clean = echo(*points(9000, 600))
    data = (clean + noise_std(clean, 10.0) * noise(9000, *clean.shape)).to(torch.complex64)
    found = uneven_rotation(data, **OPTIONS)
    assert found.ok and found.info["scatterers"] > 200 and z_scores(found, K).abs().max() < 4


def test_a_peak_of_the_noise_does_not_show_the_rate() -> None:
    """All points lie in one range cell, and the noise has a peak in another."""
    x, y, amplitude = points(1053, 12)
    clean = echo(x, 0.0 * y, amplitude)
    found = uneven_rotation((clean + noise_std(clean, 10.0) * noise(1053, *clean.shape)).to(torch.complex64), **OPTIONS)
    assert found.info["scatterers"] > 12 and found.doubtful


@pytest.mark.slow
def test_each_step_reduces_the_error() -> None:
    data = targets(4)
    errors = {
        name: (estimator(data, **OPTIONS)["warp_k"] / K - 1).abs().median(0).values
        for name, estimator in ESTIMATORS.items()
    }
    assert (errors["coarse"] < 0.03).all() and errors["coarse"][0] > errors["phase_fit"][0]
    assert (errors["uneven"] < 2e-3).all() and (errors["phase_fit"] > errors["uneven"]).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", ESTIMATORS)
def test_a_batch_equals_single_trials(name: str) -> None:
    """Beside trials that are stronger, empty, pure noise, or that converge after another step."""
    data = torch.stack(
        [target(0), 1e4 * target(1, -5.0), torch.zeros(PULSES, 24), noise(0, PULSES, 24), 1e-4 * target(2, 40.0)]
    ).to(torch.complex128)
    together = ESTIMATORS[name](data, **OPTIONS)
    for i in (0, 2, 4):
        alone = ESTIMATORS[name](data[i], **OPTIONS)
        for key, value in alone.value.items():
            torch.testing.assert_close(together[key][i], value, rtol=1e-6, atol=1e-9)
        for key, value in alone.std.items():
            torch.testing.assert_close(together.std[key][i], value, rtol=1e-4, atol=1e-9)
        assert alone.ok == together.ok[i] and torch.allclose(alone.quality, together.quality[i], atol=1e-6)
    assert not together.ok[2:4].any() and together.ok[0] and together.ok[4]
    pair = ESTIMATORS[name](data[None, ::4], **OPTIONS)["warp_k"]
    assert pair.shape == (1, 2, 2)
    torch.testing.assert_close(pair[0], together["warp_k"][::4], rtol=1e-6, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("name", ESTIMATORS)
def test_single_precision_is_enough(name: str) -> None:
    data = targets(2)
    double, single = ESTIMATORS[name](data, **OPTIONS), ESTIMATORS[name](data.to(torch.complex64), **OPTIONS)
    torch.testing.assert_close(single["warp_k"], double["warp_k"], rtol=1e-4, atol=0)
    assert all(value.dtype == F64 for value in single.value.values())


@pytest.mark.slow
def test_the_scale_of_the_data_does_not_matter() -> None:
    scale = torch.tensor([1e-300, 1e-20, 1.0, 1e20, 1e300], dtype=F64)
    scaled = scale[:, None, None] * target(0)
    found, single = uneven_rotation(scaled, **OPTIONS), uneven_rotation(scaled[1:4].to(torch.complex64), **OPTIONS)
    wanted = found["warp_k"][2]
    torch.testing.assert_close(found["warp_k"], wanted.expand(5, 2), rtol=1e-6, atol=0)
    torch.testing.assert_close(found.std["omega_rad_s"], found.std["omega_rad_s"][2].expand(5), rtol=1e-4, atol=0)
    torch.testing.assert_close(single["warp_k"], wanted.expand(3, 2), rtol=1e-4, atol=0)


@pytest.mark.slow
def test_the_origin_of_the_range_axis_is_the_centre_deviation() -> None:
    """A shift of the whole axis is a centre deviation; a cropped axis is not."""
    data = target(4)
    usual = uneven_rotation(data, **OPTIONS)
    shifted = uneven_rotation(data, **{**OPTIONS, "range_m": RANGE_M + 700.0})
    torch.testing.assert_close(shifted["yc_m"], usual["yc_m"] - 700.0, rtol=0, atol=1e-3)
    torch.testing.assert_close(shifted["omega_rad_s"], usual["omega_rad_s"], rtol=1e-4, atol=0)
    cropped = uneven_rotation(data[:, 5:], **{**OPTIONS, "range_m": RANGE_M[5:]})
    assert (
        cropped.ok
        and (cropped["omega_rad_s"] / OMEGA - 1).abs() < 0.05
        and (cropped["warp_k"] / K - 1).abs().max() < 0.01
        and cropped["yc_m"].abs() < 0.1
    )


def test_odd_and_missing_pulses() -> None:
    for data in (target(4, n_pulse=801), with_gaps(target(4), 0.1), with_gaps(target(4), 0.5)):
        found = uneven_rotation(data, **OPTIONS)
        assert found.ok and z_scores(found, K).abs().max() < 6


def with_gaps(data: Tensor, share: float) -> Tensor:
    """Without a share of its pulses, at random positions."""
    missing = torch.rand(len(data), generator=torch.Generator().manual_seed(5)) < share
    return torch.where(missing[:, None], 0, data)


def degenerate() -> dict[str, Tensor]:
    x, y, amplitude = points(0, 1)
    one = echo(x, y, amplitude)
    row = echo(points(0)[0], torch.zeros(30, dtype=F64), points(0)[2])
    return {
        "noise": noise(1, PULSES, 24),
        "empty": torch.zeros(PULSES, 24, dtype=torch.complex128),
        "constant": torch.ones(PULSES, 24, dtype=torch.complex128),
        "one point": one + 0.1 * noise(2, PULSES, 24),
        "one range cell": row + 0.1 * noise(3, PULSES, 24),
        "one sample": torch.zeros(PULSES, 24, dtype=torch.complex128).index_put(
            (torch.tensor(7), torch.tensor(7)), torch.tensor(1.0 + 0j, dtype=torch.complex128)
        ),
    }


@pytest.mark.slow
@pytest.mark.parametrize("name", ESTIMATORS)
def test_undetermined_rotations_are_finite_and_not_ok(name: str) -> None:
    kinds = degenerate()
    for data in (torch.stack(list(kinds.values())), target(0)[None, :8]):
        found = ESTIMATORS[name](data, **OPTIONS)
        assert all(torch.isfinite(value).all() for value in (*found.value.values(), found.quality))
        assert not any(value.isnan().any() for value in (*found.std.values(), *found.info.values()))
        assert ((found.quality >= 0) & (found.quality <= 1) & (found["omega_rad_s"] >= 0)).all()
        known = {kind for kind, ok in zip(kinds if len(data) > 1 else ["8 pulses"], found.ok, strict=True) if ok}
        assert known <= (set() if name == "uneven" else {"one range cell"})


def failing(*_: object) -> None:
    raise AssertionError("the assessment was called")


@pytest.mark.slow
@pytest.mark.parametrize("name", ESTIMATORS)
def test_values_do_not_depend_on_the_assessment(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    data = torch.stack([target(0), target(1, -5.0), noise(0, PULSES, 24)]).to(torch.complex64)
    assessed = ESTIMATORS[name](data, **OPTIONS)
    for judge in ("judged_fit", "judged_motion"):
        monkeypatch.setattr(recommended, judge, failing)
    bare = ESTIMATORS[name](data, **OPTIONS, assess=False)
    assert all(torch.equal(value, bare[key]) for key, value in assessed.value.items())
    assert not bare.std and (bare.outcome == Outcome.NOT_ASSESSED).all() and bare.ok.all()


@pytest.mark.slow
@pytest.mark.parametrize("name", ESTIMATORS)
def test_outcomes_name_what_was_seen(name: str) -> None:
    kinds = degenerate()
    data = torch.stack([target(0), kinds["empty"], kinds["noise"], kinds["one point"]])
    found = ESTIMATORS[name](data, **OPTIONS)
    right, empty, nothing, alone = (Outcome(code) for code in found.outcome.tolist())
    assert (right, empty) == (Outcome.OK, Outcome.EMPTY) and nothing == Outcome.NOISE
    assert alone.is_doubtful


def test_results_are_reproducible() -> None:
    data = targets(2, snr_db=0.0).to(torch.complex64)
    once, again = uneven_rotation(data, **OPTIONS), uneven_rotation(data.clone(), **OPTIONS)
    assert all(torch.equal(value, again[name]) for name, value in once.value.items())


def test_the_coarse_warp_is_monotonic() -> None:
    """On any data: a warp that is not monotonic has no image."""
    data = torch.cat([noise(0, 4, PULSES, 24), torch.zeros(1, PULSES, 24), torch.ones(1, PULSES, 24)])
    k = coarse_warp(data, PRF)
    assert torch.isfinite(k).all() and (least_rate(k, PULSES / PRF) > 0).all()
    assert coarse_warp(data[:, :8], PRF).shape == (6, 2) and torch.isfinite(coarse_warp(data[:, :9, :1], PRF)).all()


def test_the_coarse_warp_does_not_depend_on_the_rate_or_the_pulse_rate() -> None:
    data = target(0)
    k = coarse_warp(data[None], PRF)
    torch.testing.assert_close(
        coarse_warp(data[None], 10 * PRF), k * torch.tensor([10.0, 100.0], dtype=F64), rtol=1e-9, atol=0
    )
    torch.testing.assert_close(coarse_warp(data[None].conj().resolve_conj(), PRF), k, rtol=1e-6, atol=0)


def signal_of(data: Tensor) -> Signal:
    return Signal(data, RADAR.raw_axes(*data.shape[-2:], start_s=3.0))


@pytest.mark.slow
@pytest.mark.parametrize(
    "stage",
    [
        UnevenRotation(RADAR),
        CoarseRotation(RADAR),
        CoarseRotation(RADAR, fits=4),
        UnevenRotation(RADAR, 4),
        UnevenRotation(RADAR, yc_m=0.5),
    ],
    ids=lambda s: type(s).__name__,
)
def test_stages_provide_what_they_declare(stage) -> None:
    found = stage(signal_of(targets(2).to(torch.complex64)))
    assert set(found.value) == set(stage.provides)
    assert found["warp_k"].shape == (2, stage.order - 1) and torch.equal(found["warp_k"][:, 0], found["k1_per_s"])


def test_the_third_option_of_a_coarse_rotation_is_the_assessment() -> None:
    stage = CoarseRotation(RADAR, 3, False)
    assert stage.yc_m is None and stage.options == {"fits": 0, "assess": False}


def test_stages_equal_the_functions() -> None:
    data = target(0, yc_m=0.7)
    found = UnevenRotation(RADAR)(signal_of(data), yc_m=torch.tensor(0.7, dtype=F64))
    assert torch.equal(found["warp_k"], uneven_rotation(data, **OPTIONS, yc_m=0.7)["warp_k"]) and found["yc_m"] == 0.7
    held = UnevenRotation(RADAR, yc_m=0.7)(signal_of(data))
    assert torch.equal(held["warp_k"], found["warp_k"])


@pytest.mark.slow
def test_steps_without_noise_do_not_go_back_and_forth() -> None:
    """Pairs of scatterers in one cell contradict the model. Steps of the rate of 0.5 to
    3 % reversed each other to the last, and the deviation was as large.
    """
    turning = PolynomialRotation(OMEGA, K.tolist())
    world = TurntableWorld(Satellite(60, 0.3, 2.6), rotation=turning, snr_db=40.0)
    data = simulate_turntable(RADAR, world, PULSES, BINS, Draws(7200, trials=[17, 18]))[0].signal.data
    before, after = (uneven_rotation(data, **OPTIONS, rounds=rounds)["omega_rad_s"] for rounds in (10, 11))
    assert (after / before - 1).abs().max() < 0.003


@pytest.mark.slow
def test_deviations_hold_where_scatterers_lie_side_by_side() -> None:
    """Several scatterers in a few Doppler cells of one range cell share errors of the model."""
    radar = InverseRadar(LIGHT_M_S / WAVELENGTH, LIGHT_M_S / (2 * 0.45), 24e3)
    world = TurntableWorld(Satellite(60, 0.3, 2.6), rotation=PolynomialRotation(OMEGA, K.tolist()), snr_db=20.0)
    recording, _ = simulate_turntable(radar, world, 480, 16, Draws(1175, trials=range(20)))
    found = UnevenRotation(radar)(recording.signal)
    error, std = found["k1_per_s"] - K[0], found.std["k1_per_s"]
    true, predicted = (x[found.ok].square().mean().sqrt() for x in (error, std))
    assert found.ok.sum() >= 15 and true / 1.5 < predicted < 1.5 * true


def pulse_phases() -> Tensor:
    return torch.cumsum(0.15 * torch.randn(PULSES, dtype=F64, generator=torch.Generator().manual_seed(9)), 0)


def test_the_autofocus_compensates_the_rotation() -> None:
    walk, data = pulse_phases(), target(0)
    impaired = data * torch.exp(1j * walk)[:, None]
    phi = warp(torch.arange(PULSES, dtype=F64) / PRF, K)
    flat = impaired * torch.exp(-2j * math.pi / WAVELENGTH * RANGE_M * (OMEGA * phi[:, None]).square())
    found = rotation_autofocus(flat, PRF, K[None])
    assert found.ok and off_the_warp(found["phase_rad"] - walk, phi) < 0.1
    blind = RotationAutofocus(RADAR)(signal_of(impaired))
    assert off_the_warp(blind["phase_rad"] - walk, phi) > 0.3, "an autofocus without the rotation leaves a larger error"
    known = RotationAutofocus(RADAR)(
        signal_of(impaired), omega_rad_s=torch.tensor(OMEGA, dtype=F64), warp_k=K, yc_m=torch.tensor(0.0, dtype=F64)
    )
    torch.testing.assert_close(known["phase_rad"], found["phase_rad"], atol=1e-6, rtol=0)


def test_the_autofocus_keeps_its_numbers_of_iterations_without_a_rotation() -> None:
    data = target(0, k=0 * K, n_pulse=160) * torch.exp(1j * pulse_phases()[:160])[:, None]
    found = RotationAutofocus(RADAR, 3, 0)(signal_of(data))["phase_rad"]
    assert torch.equal(found, autofocus(data, search=3, polish=0)["phase_rad"])
    assert not torch.equal(found, autofocus(data)["phase_rad"])
    for rotation in ({}, {"warp_k": K}):
        with pytest.raises(ValueError, match="search must be a whole number of 0 or more, got -1"):
            RotationAutofocus(RADAR, -1)(signal_of(data), **rotation)


def off_the_warp(error: Tensor, phi: Tensor) -> float:
    """Rms of phases (rad), on the circle, without the constant and the line in the warp.

    These do not show in an image; the line is the maximum of the spectrum over the warp.
    """
    cells = torch.linspace(-40, 40, 4001, dtype=F64)
    angle = error - 2 * math.pi * cells[:, None] * phi / phi[-1]
    best = angle[torch.exp(1j * angle).sum(-1).abs().argmax()]
    return float(torch.angle(torch.exp(1j * best) / torch.exp(1j * best).mean()).square().mean().sqrt())


@pytest.mark.slow
def test_phase_and_rotation_are_estimated_in_turn() -> None:
    """A free phase per pulse and a rotation.

    The autofocus absorbs yc, so the estimator keeps it fixed.
    """
    impaired = target(0) * torch.exp(1j * pulse_phases())[:, None]
    stage = Alternate(
        3,
        phase=Turn(RotationAutofocus(RADAR), CorrectPulsePhase()),
        rotation=Turn(UnevenRotation(RADAR, yc_m=0.0), RangePhase(RADAR)),
    )
    alone = UnevenRotation(RADAR)(signal_of(impaired))
    found = Chain(fit=stage, out=use(CorrectPulsePhase(), phase_rad="fit")).trace(signal_of(impaired)).estimates["fit"]
    assert (found["warp_k"] / K - 1).abs().max() < 0.05
    assert found.info["rotation.entropy_nats"] < alone.info["entropy_nats"] - 0.3


def test_invalid_input_is_rejected() -> None:
    data = target(0)
    with pytest.raises(ValueError, match="at least 8 pulses"):
        uneven_rotation(data[:7], **OPTIONS)
    with pytest.raises(TypeError, match="complex samples .* got torch.float64"):
        uneven_rotation(data.real, **OPTIONS)
    with pytest.raises(ValueError, match="1 of 19200 samples are NaN or Inf"):
        uneven_rotation(
            data.index_put((torch.tensor(3), torch.tensor(5)), torch.tensor(math.nan + 0j, dtype=data.dtype)), **OPTIONS
        )
    with pytest.raises(ValueError, match="range_m must be a tensor of the 24 coordinates"):
        uneven_rotation(data, **{**OPTIONS, "range_m": RANGE_M[:5]})
    with pytest.raises(ValueError, match="wavelength_m must be a positive number, got -1"):
        uneven_rotation(data, **{**OPTIONS, "wavelength_m": -1.0})
    with pytest.raises(ValueError, match="order must be a whole number of 1 or more"):
        uneven_rotation(data, **OPTIONS, order=0)
    with pytest.raises(ValueError, match=r"order of the rotation must be 1 \(uniform rotation\) or more"):
        UnevenRotation(RADAR, 0)


@pytest.mark.parametrize("snr_db", [60.0, 100.0, None])
def test_noise_below_the_errors_of_the_model_changes_no_estimate(snr_db: float | None) -> None:
    """Residuals of the model are neither scatterers nor evidence against one."""
    x, y = torch.tensor([-0.3, 0.0, 0.3], dtype=F64), torch.full((3,), 1.2, dtype=F64)
    clean = echo(x, y, torch.ones(3, dtype=torch.complex128), yc_m=10.8)
    data = clean if snr_db is None else clean + noise_std(clean, snr_db) * noise(0, *clean.shape)
    found = uneven_rotation(data.to(torch.complex64), **OPTIONS, yc_m=10.8)
    assert found.ok and abs(float(found["omega_rad_s"]) / OMEGA - 1) < 1e-3
