"""Signals, recordings and estimates in torch.func and in data loaders."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.func import grad, jvp, vmap
from torch.utils import _pytree as pytree
from torch.utils.data import DataLoader, default_collate

from tests.helpers import small_radar, small_recording
from torchsar.compensate import CorrectPulsePhase, Sca
from torchsar.core import Axis, Estimate, Outcome, Recording, Signal, Truth
from torchsar.focus import OmegaK
from torchsar.metrics import entropy

N_PULSE, N_RANGE = 24, 32


def recording(trials: int | None = 3) -> Recording:
    made = small_recording(N_PULSE, N_RANGE, trials=trials, dtype=torch.complex128)[0]
    lead = () if trials is None else (trials,)
    return replace(made, aux={"line_number": torch.arange(N_PULSE).expand(*lead, -1).contiguous()})


def trial(of: Recording, i: int) -> Recording:
    return pytree.tree_map(lambda x: x[i], of)


def same(one: object, other: object) -> None:
    leaves, structure = pytree.tree_flatten(one)
    others, other_structure = pytree.tree_flatten(other)
    assert structure == other_structure and len(leaves) == len(others) > 0
    assert all(torch.equal(a, b) for a, b in zip(leaves, others))


def test_axes_radar_and_names_are_structure_and_tensors_are_leaves() -> None:
    made = recording()
    leaves, structure = pytree.tree_flatten(made)
    assert [leaf.shape for leaf in leaves] == [(3, N_PULSE, N_RANGE), (3, N_PULSE)]
    again = pytree.tree_unflatten(leaves, structure)
    assert again.radar is made.radar and again.signal.axes == made.signal.axes and list(again.aux) == ["line_number"]
    keys = [pytree.keystr(path) for path, _ in pytree.tree_flatten_with_path(made)[0]]
    assert keys == [".signal.data", ".aux['line_number']"]
    other = replace(made, radar=replace(made.radar, velocity_m_s=1.0))
    assert pytree.tree_structure(other) != structure
    assert pytree.tree_structure(trial(made, 0)) == structure
    truth = Truth({"doppler_hz": torch.zeros(3)}, made)
    same(truth, pytree.tree_map(lambda x: x, truth))
    assert pytree.tree_map(lambda x: x, replace(truth, clean=None)).clean is None


def test_vmap_maps_recordings_and_returns_estimates() -> None:
    made, focus = recording(), OmegaK(small_radar())
    image = vmap(lambda one: focus(one.signal))(made)
    torch.testing.assert_close(image.data, focus(made.signal).data)
    assert image.axes == focus(made.signal).axes

    def found(signal: Signal) -> Estimate:
        power = signal.data.abs().square().sum((-2, -1))
        ok, name = power > 0, "power"
        return Estimate(
            {name: power},
            quality=power / (1 + power),
            outcome=Outcome.of(ok, Outcome.NOISE),
            neutral={name: 0.5, "other": torch.zeros(())},
        )

    one, whole = vmap(found)(made.signal), found(made.signal)
    same(replace(one, neutral={}), replace(whole, neutral={}))
    assert one.neutral["power"] == 0.5 and one.neutral["other"].shape == (3,)
    torch.testing.assert_close(vmap(lambda e: e.trusted("power"))(one), whole["power"])


def test_a_tree_of_in_dims_shares_side_data_between_trials() -> None:
    made = recording()
    shared = replace(made, aux={"line_number": made.aux["line_number"][0]})
    dims = pytree.tree_map_only(Tensor, lambda x: None if x.ndim == 1 else 0, shared)
    lines = vmap(lambda one: one.aux["line_number"] + one.signal.data.real.sum() * 0, in_dims=(dims,))(shared)
    assert lines.shape == (3, N_PULSE)


def test_gradients_by_a_signal_are_signals() -> None:
    signal = recording(None).signal

    def cost(one: Signal) -> Tensor:
        return entropy(OmegaK(small_radar())(one))

    slope = grad(cost)(signal)
    assert isinstance(slope, Signal) and slope.axes == signal.axes
    step = 1e-7 * torch.randn(signal.data.shape, dtype=torch.complex128, generator=torch.Generator().manual_seed(1))
    change = cost(signal.with_data(signal.data + step)) - cost(signal.with_data(signal.data - step))
    torch.testing.assert_close(change, 2 * (slope.data.conj() * step).real.sum(), rtol=1e-5, atol=0)
    _, tangent = jvp(cost, (signal,), (signal.with_data(step),))
    torch.testing.assert_close(2 * tangent, change, rtol=1e-5, atol=0)
    each = vmap(grad(cost))(recording().signal)
    torch.testing.assert_close(each.data[1], grad(cost)(recording().signal.with_data(recording().signal.data[1])).data)


def test_the_gradient_by_an_estimated_phase_passes_through_stages() -> None:
    signal = recording(None).signal
    phase = Sca()(signal)["phase_rad"]

    def cost(phase_rad: Tensor, one: Signal) -> Tensor:
        return entropy(CorrectPulsePhase()(one, phase_rad=phase_rad))

    assert bool(torch.isfinite(grad(cost)(phase, signal)).all())


def test_a_loader_stacks_recordings_truths_and_estimates() -> None:
    made = recording()
    pairs = [(trial(made, i), Truth({"doppler_hz": torch.tensor(1.0 * i)}, trial(made, i))) for i in range(3)]
    batch, truth = next(iter(DataLoader(pairs, batch_size=3)))
    same(batch, made)
    assert truth.values["doppler_hz"].tolist() == [0.0, 1.0, 2.0]
    same(truth.clean, made)
    estimates = [Sca()(pair[0].signal) for pair in pairs]
    stacked = default_collate(estimates)
    assert stacked["phase_rad"].shape == (3, N_PULSE) and stacked.ok.shape == (3,)
    assert stacked.neutral == estimates[0].neutral


def test_recordings_that_differ_are_not_stacked() -> None:
    one = recording(None)
    for other, text in (
        (replace(one, radar=replace(one.radar, prf_hz=1.0)), "differ in radar: StripmapRadar"),
        (replace(one, aux={}), r"differ in the names in aux: \['line_number'\] and \[\]"),
        (replace(one, signal=one.signal.isel(range=slice(0, 8))), r"differ in signal.axes: \(Axis\(name='pulse'"),
    ):
        with pytest.raises(ValueError, match=rf"equal axes, radar and names, but the samples 0 and 1 {text}"):
            default_collate([one, other])


def test_a_signal_does_not_take_tensors_that_do_not_fit_its_axes() -> None:
    signal = Signal(torch.zeros(4, 5), (Axis("pulse", 4, 0.0, 1.0, "s"), Axis("range", 5, 0.0, 1.0, "m")))
    with pytest.raises(ValueError, match="pulse=4, range=5"):
        vmap(lambda one: one, out_dims=1)(Signal(torch.zeros(2, 4, 5), signal.axes))
    assert pytree.tree_map(lambda x: tuple(x.shape), signal).data == (4, 5)
