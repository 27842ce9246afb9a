"""Alignment of envelopes: direct sums, injected shifts, and effect on the image of an aircraft."""

from __future__ import annotations

import math
from functools import partial

import pytest
import torch
from torch import Tensor

from torchsar.compensate import (
    AlignEnvelopes,
    ShiftRange,
    align_envelopes,
    correct_pulse_phase,
    envelope_assess,
    shift_range,
)
from torchsar.compensate.envelope_fit import Envelopes, robust_fit
from torchsar.core import Axis, Chain, Draws, Outcome, Recording, Signal, use
from torchsar.echo import simulate_turntable
from torchsar.echo.receiver import GateJumps
from torchsar.focus import CompressDechirped, azimuth_transform
from torchsar.metrics import entropy
from torchsar.radar import LIGHT_M_S, InverseRadar
from torchsar.scene import Aircraft, Dechirped, Polynomial, Sinusoid, TurntableWorld, UniformStartPhase
from torchsar.study.bench.profiles import aligned, noisy, turned, white

DOUBLE = torch.complex128
LADAR = InverseRadar(LIGHT_M_S / 1.55e-6, 150e9, 2000.0, 0.005, 100e-6, 20e3)


def drift(cells: Tensor) -> Tensor:
    """Slope of the line fitted by least squares, in cells per pulse."""
    k = torch.arange(cells.shape[-1], dtype=cells.dtype) - (cells.shape[-1] - 1) / 2
    return (cells * k).sum(-1) / k.square().sum()


SINGLE = {name: partial(align_envelopes, method=name) for name in ("running", "single", "amplitude")}
METHODS = {**SINGLE, "degree 2": align_envelopes, "two tones": partial(align_envelopes, tones=2)}


def circular(*shape: int, seed: int = 0, dtype: torch.dtype = DOUBLE) -> Tensor:
    return torch.randn(*shape, dtype=dtype, generator=torch.Generator().manual_seed(seed))


def aircraft(
    snr_db: float | None = None, trials: int = 2, n_pulse: int = 200, seed: int = 3, dtype: torch.dtype = DOUBLE
) -> tuple[Tensor, Tensor]:
    """Aligned pulses of random phase (trial, pulse, range), and these phases."""
    world = TurntableWorld(Aircraft(), start_phase=[UniformStartPhase()], snr_db=snr_db)
    recording, truth = simulate_turntable(LADAR, world, n_pulse, 256, Draws(seed, trials=range(trials)), dtype=dtype)
    return recording.signal.data, truth.values["phase_rad"]


def rigid(n_pulse: int = 60, n_range: int = 64, trials: int = 2) -> Tensor:
    """The same band-limited profile in every pulse, with a random phase."""
    profile = circular(trials, 1, n_range) * torch.exp(-(((torch.arange(n_range) - n_range / 2) / (n_range / 8)) ** 2))
    return profile * torch.polar(
        torch.ones(trials, n_pulse, 1, dtype=torch.float64),
        6.3 * torch.rand(trials, n_pulse, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(1)),
    )


def off(found: Tensor, true: Tensor, n: int = 256) -> Tensor:
    """Difference on the circle of n cells without its mean, (..., pulse)."""
    difference = found - true
    difference = difference - difference.median(-1, keepdim=True).values
    return difference - n * torch.round(difference / n)


def rms(x: Tensor) -> Tensor:
    return x.square().mean(-1).sqrt()


def unit_time(n: int) -> Tensor:
    return torch.linspace(-1, 1, n, dtype=torch.float64)


@pytest.mark.parametrize("n", [16, 15])
def test_shift_equals_direct_sums(n: int) -> None:
    x, shift = circular(3, 4, n), torch.tensor([0.3, -2.7, 5.0, 100.25], dtype=torch.float64)
    cycles = (torch.arange(n, dtype=torch.float64) - n // 2) / n
    at = torch.arange(n, dtype=torch.float64)
    kernel = torch.polar(torch.ones(4, n, n, dtype=torch.float64), torch.zeros(4, n, n, dtype=torch.float64))
    for k in range(4):
        kernel[k] = torch.exp(2j * math.pi * cycles * (at[:, None, None] - at[:, None] - shift[k])).mean(-1)
    expected = torch.einsum("kij,tkj->tki", kernel, x)
    torch.testing.assert_close(shift_range(x, shift), expected, atol=1e-12, rtol=0)


def test_shift_is_unitary_reversible_and_exact_for_whole_cells() -> None:
    x, shift = circular(2, 5, 32), 40 * circular(2, 5, seed=1).real
    moved = shift_range(x, shift)
    torch.testing.assert_close(moved.abs().square().sum(-1), x.abs().square().sum(-1), rtol=1e-12, atol=0)
    torch.testing.assert_close(shift_range(moved, -shift), x, atol=1e-12, rtol=0)
    torch.testing.assert_close(shift_range(x, 3.0), x.roll(3, -1), atol=1e-12, rtol=0)
    assert shift_range(x.to(torch.complex64), shift).dtype == torch.complex64
    with pytest.raises(ValueError, match=r"hold one shift per pulse, \(..., 5\), got shape \(2, 4\)"):
        shift_range(x, shift[:, :4])


def test_gradients_of_the_shift() -> None:
    x, shift = circular(2, 3, 8).requires_grad_(), circular(2, 3, seed=1).real.clone().requires_grad_()
    assert torch.autograd.gradcheck(shift_range, (x, shift))


def test_correlations_equal_direct_sums() -> None:
    x = circular(2, 5, 12) * torch.tensor([1.0, 2.0, 0.1, 1.0, 1.0])[:, None]
    pulses = Envelopes.of(x)
    fine = torch.stack([shift_range(x, 0.0), shift_range(x, -0.5)], -1).flatten(-2).abs().square()
    power = fine / fine.mean(-1, keepdim=True)
    torch.testing.assert_close(pulses.on_grid(pulses.spectra), power, atol=1e-12, rtol=0)
    # quarter cells: the likelihood of every shift, sum over cells of -|s|^2 / T
    finer = torch.stack([shift_range(x, -part / 4) for part in range(4)], -1).flatten(-2).abs().square()
    finer = finer / finer.mean(-1, keepdim=True)
    direct = torch.stack(
        [-(finer.roll(-lag, -1) / finer.mean(-2).clamp_min(0.01)[:, None]).mean(-1) * 24 for lag in range(48)], -1
    )
    got = pulses.on_grid(pulses.spectra * pulses.likelihood(pulses.spectra.mean(-2, keepdim=True)).conj(), 4)
    torch.testing.assert_close(got, direct, atol=1e-10 * float(direct.abs().max()), rtol=0)


def test_parabola_finds_the_peak_between_samples() -> None:
    """The peak of a smooth envelope is found to 0.001 cell at any position."""
    position = torch.linspace(-31.9, 31.9, 301, dtype=torch.float64)
    lines = torch.exp(-(((torch.arange(64) - 32) / 2.0) ** 2)).to(DOUBLE).expand(1, 301, -1)
    pulses = Envelopes.of(shift_range(lines, position))
    found = pulses.peak(pulses.spectra * Envelopes.of(lines).spectra[:, :1].conj())
    assert float((found - position).abs().max()) < 1e-3


@pytest.mark.parametrize("method", SINGLE.values(), ids=list(SINGLE))
def test_recovers_shifts_of_a_rigid_profile(method) -> None:
    x = rigid()
    true = 1.5 * unit_time(60) + 0.4 * circular(2, 60, seed=2).real
    error = off(method(shift_range(x, true))["shift_cells"], true, 64)
    assert float(error.abs().max()) < 0.03 and float(rms(error).max()) < 0.01


@pytest.mark.parametrize("method", METHODS.values(), ids=list(METHODS))
def test_a_batch_equals_single_trials(method) -> None:
    x = (
        shift_range(aircraft(5.0, 3, 60)[0], 30 * unit_time(60))
        * torch.logspace(0, 6, 3, dtype=torch.float64)[:, None, None]
    )
    together = method(x.reshape(3, 1, 60, 256))
    for i in range(3):
        alone = method(x[i])
        torch.testing.assert_close(together["shift_cells"][i, 0], alone["shift_cells"], atol=1e-8, rtol=0)
        torch.testing.assert_close(together.std["shift_cells"][i, 0], alone.std["shift_cells"], atol=1e-8, rtol=0)
        assert bool(together.ok[i, 0]) == bool(alone.ok)


@pytest.mark.parametrize("method", METHODS.values(), ids=list(METHODS))
def test_phases_and_gains_of_pulses_have_no_effect(method) -> None:
    x = shift_range(aircraft(0.0, 2, 60)[0], 30 * unit_time(60))
    turned = x * torch.polar(
        torch.rand(2, 60, 1, dtype=torch.float64) + 0.5, 1e4 * torch.rand(2, 60, 1, dtype=torch.float64)
    )
    torch.testing.assert_close(method(turned)["shift_cells"], method(x)["shift_cells"], atol=1e-8, rtol=0)


def test_single_precision_and_any_scale() -> None:
    x = shift_range(aircraft(0.0, 2, 60)[0], 30 * unit_time(60))
    expected = align_envelopes(x)["shift_cells"]
    for scale in (1.0, 1e-25, 1e25):
        found = align_envelopes((x * scale).to(torch.complex64))["shift_cells"]
        torch.testing.assert_close(found, expected, atol=2e-3, rtol=0)


def test_noise_free_data_are_not_degraded() -> None:
    """Shifts by |s| cost 0.1 nats, those by the likelihood 0.02 nats, a polynomial nothing."""
    x, phase = aircraft(n_pulse=400)
    ideal = entropy(azimuth_transform(correct_pulse_phase(x, phase)))

    def cost(method) -> float:
        aligned = shift_range(x, -method(x)["shift_cells"])
        return float((entropy(azimuth_transform(correct_pulse_phase(aligned, phase))) - ideal).mean())

    assert abs(cost(align_envelopes)) < 0.01
    assert cost(partial(align_envelopes, tones=2)) < 0.01
    assert 0 < cost(SINGLE["single"]) < 0.04 < cost(SINGLE["amplitude"])


@pytest.mark.parametrize("snr_db", [None, 0.0, -10.0])
def test_a_shift_history_over_several_windows_is_found(snr_db: float | None) -> None:
    x, _ = aircraft(snr_db, 3, 400)
    u = unit_time(400)
    true = torch.stack([0 * u, 50 * u + 20 * u**2, 340 * u - 60 * u**2])
    found = align_envelopes(shift_range(x, true))
    error = rms(off(found["shift_cells"], true))
    assert found.ok.all() and float(error.max()) < 0.1
    assert bool((error < 3 * found.std["shift_cells"][:, 0] + 0.02).all())
    torch.testing.assert_close(drift(found["shift_cells"]), drift(true), atol=1e-3, rtol=0)


def test_vibration_is_found_as_a_tone() -> None:
    x, _ = aircraft(10.0, 2, 400)
    k = torch.arange(400, dtype=torch.float64)
    true = (
        20 * unit_time(400) + 0.8 * torch.sin(2 * math.pi * 0.05 * k + 0.3) + 0.3 * torch.sin(2 * math.pi * 0.0173 * k)
    )
    error = [float(rms(off(align_envelopes(shift_range(x, true), tones=t)["shift_cells"], true)).max()) for t in (0, 2)]
    assert error[1] < 0.05 < 0.25 < error[0]


def test_failure_at_low_snr_is_reported() -> None:
    """Single pulses fail at -5 dB, the polynomial at -25 dB; both are then not ok."""
    x, _ = aircraft(-5.0, 2, 300)
    for method in SINGLE.values():
        found = method(x)
        assert float(rms(off(found["shift_cells"], torch.zeros(2, 300))).max()) > 1 and not found.ok.any()
    far, _ = aircraft(-25.0, 3, 400)
    assert not align_envelopes(far).ok.any()


@pytest.mark.parametrize("method", METHODS.values(), ids=list(METHODS))
@pytest.mark.parametrize("shape", [(4, 100, 64), (2, 30, 32)])
def test_noise_is_not_ok(method, shape: tuple[int, ...]) -> None:
    found = method(circular(*shape))
    assert not found.ok.any() and float(found.quality.max()) < 0.1 and torch.isfinite(found["shift_cells"]).all()


def test_lost_pulses_are_bridged() -> None:
    x, _ = aircraft(10.0, 2, 200)
    true = 60 * unit_time(200) + 15 * unit_time(200) ** 2
    lost = torch.rand(2, 200, generator=torch.Generator().manual_seed(4)) < 0.2
    lost[:, :3] = True
    found = align_envelopes(torch.where(lost[..., None], 0, shift_range(x, true)))
    assert torch.equal(found.info["present"], ~lost) and found.ok.all()
    assert float(rms(off(found["shift_cells"], true)).max()) < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS.values(), ids=list(METHODS))
def test_empty_data_give_finite_values(method) -> None:
    x = aircraft(10.0, 2, 40)[0]
    found = method(torch.stack([x[0], 0 * x[0]]))
    assert not found.ok[1] and torch.equal(found["shift_cells"][1], torch.zeros(40, dtype=torch.float64))
    torch.testing.assert_close(found["shift_cells"][0], method(x[0])["shift_cells"], atol=1e-8, rtol=0)
    for shape in [(1, 16), (2, 4), (3, 5), (7, 1)]:
        small = method(circular(*shape))
        assert (
            torch.isfinite(small["shift_cells"]).all()
            and torch.isfinite(small.std["shift_cells"]).all()
            and small.ok.shape == ()
        )


@pytest.mark.parametrize("method", METHODS.values(), ids=list(METHODS))
def test_invalid_data_are_rejected(method) -> None:
    x = circular(2, 5, 16)
    x[1, 3, 4] = float("nan")
    with pytest.raises(ValueError, match=r"1 of 160 samples are NaN or Inf, the first at index \(1, 3, 4\)"):
        method(x)
    with pytest.raises(TypeError, match="complex range-compressed samples"):
        method(torch.ones(5, 16))


@pytest.mark.parametrize(
    "call",
    [
        partial(align_envelopes, method="power"),
        partial(align_envelopes, degree=-1),
        partial(align_envelopes, method="single", tones=1),
        partial(align_envelopes, blocks=0),
        partial(align_envelopes, degree=2.5),  # pyright: ignore[reportArgumentType]
        partial(align_envelopes, degree=None),  # pyright: ignore[reportArgumentType]
    ],
)
def test_invalid_settings_are_rejected(call) -> None:
    with pytest.raises(ValueError, match=r"^align_envelopes"):
        call(circular(5, 16))


def test_robust_fit_ignores_outliers() -> None:
    u = unit_time(40)
    basis = torch.stack([torch.ones_like(u), u, u**2], -1).expand(2, -1, -1)
    true = torch.tensor([[1.0, -2.0, 3.0], [0.0, 5.0, 0.5]], dtype=torch.float64)
    values = (basis @ true[..., None]).squeeze(-1)
    values[:, ::4] += 50 * circular(2, 10, seed=5).real
    torch.testing.assert_close(
        robust_fit(values, basis, torch.ones(2, 40, dtype=torch.float64)), true, atol=1e-6, rtol=0
    )


def test_stages_align_a_target_with_a_tracking_error() -> None:
    """The target flies at 100.3 m/s, was compressed for 100 m/s, and vibrates.

    The chain removes the drift and returns the velocity, with the part due to range-Doppler
    coupling.
    """
    world = TurntableWorld(
        Aircraft(),
        motion=[Polynomial([100.3, 0.1]), Sinusoid(2e-6, 100.0)],
        start_phase=[UniformStartPhase()],
        snr_db=5.0,
        fidelity=Dechirped([Polynomial([100.0])]),
    )
    recording, truth = simulate_turntable(LADAR, world, 200, 256, Draws(2, trials=range(2)), dtype=DOUBLE)
    used = torch.full((2,), 100.0, dtype=torch.float64)
    chain = Chain(
        compress=use(CompressDechirped(LADAR), velocity_m_s="aux.velocity_m_s"),
        align=use(AlignEnvelopes(), velocity_m_s="aux.velocity_m_s"),
        shift=use(ShiftRange(), shift_m="align"),
    )
    trace = chain.trace(recording, given={"aux.velocity_m_s": used})
    assert trace.estimates["align"].ok.all()
    coupled = 2 * 0.1 * LADAR.carrier_hz / LADAR.chirp_rate_hz_s
    torch.testing.assert_close(
        trace.values["align.velocity_m_s"],
        torch.full((2,), 100.3 + 0.1 * 0.1 + coupled, dtype=torch.float64),
        atol=0.005,
        rtol=0,
    )
    drift_m = truth.values["displacement_m"] - 100 * torch.arange(200) / 2000
    residual = trace.values["align.shift_m"] - drift_m
    # the residual is the range-Doppler coupling: acceleration and vibration times f0 / gamma
    assert float((residual - residual.mean(-1, keepdim=True)).abs().max()) < 3e-3
    aligned = align_envelopes(trace.signal.data)["shift_cells"]
    assert float(rms(aligned).max()) < 0.05


def test_stages_work_in_metres() -> None:
    x = shift_range(aircraft(20.0, 2, 60)[0], 10 * unit_time(60))
    axes = (Axis("pulse", 60, 0.0, 1 / 2000, "s"), Axis("range", 256, 0.0, 0.5, "m"))
    signal = Signal(x, axes)
    found, cells = AlignEnvelopes()(signal), align_envelopes(x)
    torch.testing.assert_close(found["shift_m"], cells["shift_cells"] * 0.5)
    torch.testing.assert_close(found.std["shift_m"], cells.std["shift_cells"] * 0.5)
    torch.testing.assert_close(found["velocity_m_s"], drift(cells["shift_cells"]) * 0.5 * 2000)
    torch.testing.assert_close(
        ShiftRange()(signal, shift_m=found["shift_m"]).data, shift_range(x, -cells["shift_cells"])
    )


@pytest.mark.parametrize("settings", [{}, {"tones": 2}, {"method": "single"}])
def test_no_trials_give_no_shifts(settings: dict) -> None:
    found = align_envelopes(torch.zeros(0, 5, 16, dtype=torch.complex64), **settings)
    assert found["shift_cells"].shape == (0, 5) and found.ok.shape == (0,)


def test_a_non_finite_shift_is_rejected() -> None:
    with pytest.raises(ValueError, match="shift_range: .*NaN"):
        shift_range(torch.ones(3, 8, dtype=torch.complex64), torch.tensor([0.0, math.nan, 0.0]))


def points(rows: Tensor, snr_db: float, size: float = 2.0, n: int = 96) -> tuple[Tensor, Tensor]:
    """Pulses (trial, 96, n) of points in the given rows (trial, point), and their shifts."""
    trials, count = rows.shape
    u = unit_time(96)
    shift = size * circular(trials, 2, seed=6).real @ torch.stack([u, u**2])
    pulse = torch.arange(96, dtype=torch.float64)
    turns = torch.rand(trials, count, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(7)) - 0.5
    echo = circular(trials, count, 1, seed=8) * torch.exp(1j * math.pi * turns * pulse)
    at = torch.exp(-2j * math.pi * torch.fft.fftfreq(n, dtype=torch.float64) * rows[..., None])
    x = torch.fft.ifft(torch.einsum("tkp,tkf->tpf", echo, at))
    noise = 10 ** (-snr_db / 20) * x.abs().square().mean((-2, -1), keepdim=True).sqrt()
    return shift_range(x, shift) + noise * circular(*x.shape, seed=9), shift


@pytest.mark.parametrize("count, snr_db", [(12, 0.0), (12, 40.0), (160, 20.0), (160, 40.0)])
def test_deviation_of_single_shifts(count: int, snr_db: float) -> None:
    """It holds for separate points as for speckle, at any SNR."""
    x, shift = points(24 + 48 * torch.rand(10, count, generator=torch.Generator().manual_seed(5)).double(), snr_db)
    found = align_envelopes(x, method="single")
    error = rms(off(found["shift_cells"], shift, 96) - off(found["shift_cells"], shift, 96).mean(-1, keepdim=True))
    ok = found.ok
    ratio = float(rms(error[ok]) / rms(found.std["shift_cells"][ok, 0]))
    assert float(ok.double().mean()) >= 0.6 and 0.7 < ratio < 1.5, ratio


@pytest.mark.parametrize("method", METHODS.values(), ids=list(METHODS))
def test_outcomes_and_values_without_assessment(method, monkeypatch: pytest.MonkeyPatch) -> None:
    good = aircraft(10.0, 1, 60)[0]
    x = torch.cat([good, circular(1, 60, 256), 0 * good, good])
    x[3, 1:] = 0
    found = method(x)
    assert found.outcome.tolist() == [Outcome.OK, Outcome.NOISE, Outcome.EMPTY, Outcome.TOO_FEW]
    for part in ("deviation", "assessed"):
        monkeypatch.delattr(envelope_assess, part)
    alone = method(x, assess=False)
    assert bool((alone.outcome == Outcome.NOT_ASSESSED).all()) and not alone.std
    assert torch.equal(alone["shift_cells"], found["shift_cells"])


@pytest.mark.parametrize(("cells", "share", "lasting"), [(1.0, 1.0, False), (3.0, 0.1, False), (10.0, 0.05, True)])
def test_jumps_of_the_range_gate_cost_no_accuracy(cells: float, share: float, lasting: bool) -> None:
    batch = aligned(10.0, 5.0)(6, 3)
    recording = Recording(Signal(batch.data, LADAR.raw_axes(*batch.data.shape[-2:])), LADAR)
    moved, truth = GateJumps(cells, share, lasting)(recording, Draws(4, trials=range(6)))
    before, after = align_envelopes(batch.data), align_envelopes(moved.signal.data)
    change = after["shift_cells"] - before["shift_cells"]
    away = change - truth["shift_cells"]
    away = away - away.median(-1, keepdim=True).values
    assert after.ok.all() and away.abs().max() < 0.02


@pytest.mark.parametrize(("cells", "share", "lasting"), [(1.0, 1.0, False), (10.0, 1.0, False), (10.0, 0.1, True)])
def test_jumps_are_found_at_low_snr_or_doubted(cells: float, share: float, lasting: bool) -> None:
    """At -8 dB large jumps cannot be found, and a smooth course was ok with errors of 7 cells."""
    for snr_db in (0.0, -8.0) if cells > 1 else (0.0,):
        batch = aligned(snr_db, 3.0)(6, 6)
        recording = Recording(Signal(batch.data, LADAR.raw_axes(*batch.data.shape[-2:])), LADAR)
        moved, truth = GateJumps(cells, share, lasting)(recording, Draws(5, trials=range(6)))
        found, clean = align_envelopes(moved.signal.data), align_envelopes(batch.data)
        error = rms(off(found["shift_cells"], batch.truth["shift_cells"] + truth["shift_cells"], 128))
        assert not (found.ok & (error > 0.05)).any()
        assert snr_db < 0 or (found.ok.all() and clean.ok.all())


def test_a_gate_that_follows_the_target_is_found() -> None:
    """Without its jumps no pulse is a whole cell from the course of the others."""
    t = torch.linspace(-1, 1, 96, dtype=torch.float64)
    smooth = 3 * t + 2 * t**2
    course = (smooth - smooth.round()).expand(4, 96)
    at = torch.tensor([15.0, 21.0, 23.0], dtype=torch.float64) + course[..., None]
    frequency = torch.fft.fftfreq(48, dtype=torch.float64)
    spectrum = (torch.tensor([1.0, 0.7, 0.5]) * torch.exp(-2j * math.pi * frequency[:, None] * at[..., None, :])).sum(
        -1
    )
    x = turned(torch.fft.ifft(spectrum), white(4, 96, 1))
    found = align_envelopes(noisy(x, 10.0, 2))
    assert found.ok.all() and rms(off(found["shift_cells"], course, 48)).max() < 0.02
