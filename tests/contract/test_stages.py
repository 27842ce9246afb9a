"""What every stage promises: one list of stages, one family of tests. A new stage joins by one line."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import pytest
import torch
from torch import Tensor

from tests.helpers import small_radar, small_recording
from torchsar.core import Estimate, Signal, Stage
from torchsar.focus import OmegaK, RangeCompress

RADAR = small_radar()


@dataclass(frozen=True)
class Case:
    """A stage, the per-trial values it is called with (name -> trial index -> value), and what may be asked of it."""

    name: str
    build: Callable[[], Stage]
    values: Callable[[Signal], dict[str, Tensor]] = field(default=lambda signal: {})
    differentiable: bool = True
    vmap: bool = True
    tolerance: float = 1e-9


def _geometry(signal: Signal) -> dict[str, Tensor]:
    count = signal.trials.numel()
    at = torch.arange(count, dtype=torch.float64).reshape(signal.trials)
    return {"doppler_hz": 5.0 * at - 3.0, "velocity_m_s": 120.0 + at}


CASES = [
    Case("range_compress", lambda: RangeCompress(RADAR)),
    Case("omega_k", lambda: OmegaK(RADAR), _geometry),
    Case("omega_k_flat", lambda: OmegaK(RADAR, "flat"), _geometry),
]
IDS = [case.name for case in CASES]


def results(out: Signal | Estimate | tuple) -> dict[str, Tensor]:
    """Every tensor of what a stage returns, by name."""
    parts = out if isinstance(out, tuple) else (out,)
    named: dict[str, Tensor] = {}
    for part in parts:
        if isinstance(part, Signal):
            named["data"] = part.data
        else:
            named |= {**part.value, "ok": part.ok, "quality": part.quality}
    return named


def raw(trials: int | None, dtype: torch.dtype = torch.complex128, n_pulse: int = 48, n_range: int = 64) -> Signal:
    recording, _ = small_recording(n_pulse, n_range, trials=trials, dtype=dtype)
    # levels of 60 dB apart: a loud trial must not change a quiet one
    if trials is not None:
        level = torch.logspace(0, 3, trials).to(dtype)
        return recording.signal.with_data(recording.signal.data * level[:, None, None])
    return recording.signal


def single(values: dict[str, Tensor], i: int) -> dict[str, Tensor]:
    return {name: value[i] for name, value in values.items()}


@pytest.mark.parametrize("trials", [1, 3])
@pytest.mark.parametrize("case", CASES, ids=IDS)
def test_batch_equals_singles(case: Case, trials: int) -> None:
    stage, signal = case.build(), raw(trials)
    values = case.values(signal)
    together = results(stage(signal, **values))
    for i in range(trials):
        alone = results(stage(signal.with_data(signal.data[i]), **single(values, i)))
        for name, value in alone.items():
            scale = float(value.abs().max()) if value.dtype != torch.bool and value.numel() else 1.0
            torch.testing.assert_close(together[name][i], value, atol=case.tolerance * max(scale, 1e-30), rtol=0, msg=lambda m, n=name: f"{n}: {m}")


@pytest.mark.parametrize("dtype", [torch.complex64, torch.complex128])
@pytest.mark.parametrize("case", CASES, ids=IDS)
def test_dtype_and_device_are_kept(case: Case, dtype: torch.dtype) -> None:
    signal = raw(2, dtype)
    out = results(case.build()(signal, **case.values(signal)))
    if "data" in out:
        assert out["data"].dtype == dtype and out["data"].device == signal.data.device
    assert all(torch.isfinite(value).all() for value in out.values())


@pytest.mark.parametrize("case", [c for c in CASES if c.differentiable], ids=[c.name for c in CASES if c.differentiable])
def test_gradients(case: Case) -> None:
    stage, signal = case.build(), raw(2, n_pulse=6, n_range=32)
    values = case.values(signal)
    floating = {name: value.requires_grad_() for name, value in values.items() if value.is_floating_point()}

    def outputs(data: Tensor, *tensors: Tensor) -> tuple[Tensor, ...]:
        out = results(stage(signal.with_data(data), **{**values, **dict(zip(floating, tensors, strict=True))}))
        return tuple(value for value in out.values() if value.is_floating_point() or value.is_complex())

    data = signal.data / signal.data.abs().amax((-2, -1), keepdim=True)
    assert torch.autograd.gradcheck(outputs, (data.requires_grad_(), *floating.values()), fast_mode=True, atol=1e-4, rtol=1e-3)


@pytest.mark.parametrize("case", [c for c in CASES if c.vmap], ids=[c.name for c in CASES if c.vmap])
def test_vmap_equals_batch(case: Case) -> None:
    stage, signal = case.build(), raw(3)
    values = case.values(signal)
    names = list(values)

    def one(data: Tensor, *tensors: Tensor) -> dict[str, Tensor]:
        return results(stage(signal.with_data(data), **dict(zip(names, tensors, strict=True))))

    mapped = torch.vmap(one)(signal.data, *values.values())
    for name, value in results(stage(signal, **values)).items():
        scale = float(value.abs().max()) if value.dtype != torch.bool and value.numel() else 1.0
        torch.testing.assert_close(mapped[name], value, atol=case.tolerance * max(scale, 1e-30), rtol=0)


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
@pytest.mark.parametrize("case", CASES, ids=IDS)
def test_non_finite_input_is_refused(case: Case, bad: float) -> None:
    stage, signal = case.build(), raw(2)
    data = signal.data.clone()
    data[1, 3, 5] = bad
    with pytest.raises(ValueError, match=r"1 of \d+ samples are NaN or Inf, the first at index \(1, 3, 5\)"):
        stage(signal.with_data(data), **case.values(signal))


@pytest.mark.parametrize("case", CASES, ids=IDS)
def test_state_moves_and_input_is_left_alone(case: Case) -> None:
    stage, signal = case.build(), raw(2)
    before = signal.data.clone()
    stage.load_state_dict(stage.state_dict())
    stage.to("cpu")(signal, **case.values(signal))
    assert torch.equal(signal.data, before)


@pytest.mark.parametrize("case", CASES, ids=IDS)
def test_all_zero_trial_stays_finite(case: Case) -> None:
    stage, signal = case.build(), raw(2)
    data = signal.data.clone()
    data[0] = 0
    out = results(stage(signal.with_data(data), **case.values(signal)))
    assert all(torch.isfinite(value).all() for value in out.values())
