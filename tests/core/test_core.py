"""Axes, signals, transforms and phases."""

from __future__ import annotations

import math
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from torchsar.core import (
    Axis,
    Recording,
    Signal,
    Stage,
    best_of,
    from_frequency,
    linear_phasor,
    reduced_turns,
    take,
    to_frequency,
    transform_in_blocks,
    unit_phasor,
)


def test_transform_changes_samples_and_axis_together():
    axis = Axis("pulse", 60, 3.0, 0.01, "s")
    tone_hz = 7 / 0.6
    x = torch.polar(torch.ones(60, dtype=torch.float64), 2 * math.pi * tone_hz * axis.values())
    signal = Signal(x, (axis,))
    spectrum = to_frequency(signal, "pulse")
    assert spectrum.names == ("doppler",) and spectrum.axis("doppler").unit == "Hz"
    peak = int(spectrum.data.abs().argmax())
    assert float(spectrum.axis("doppler").values()[peak]) == pytest.approx(tone_hz)
    back = from_frequency(spectrum, "doppler")
    assert back.axes == signal.axes
    torch.testing.assert_close(back.data, signal.data)


def test_signal_rejects_data_that_is_not_a_tensor():
    with pytest.raises(TypeError, match="holds a torch.Tensor, got list"):
        Signal([1j, 2j], (Axis("range", 2, 0.0, 1.0, "m"),))


def test_signal_rejects_a_shape_that_does_not_end_in_its_axes():
    with pytest.raises(ValueError, match=r"pulse=4, range=5"):
        Signal(torch.zeros(5, 4), (Axis("pulse", 4, 0, 1, "s"), Axis("range", 5, 0, 1, "m")))


def ramp() -> Signal:
    axes = Axis("pulse", 3, 0, 1, "s"), Axis("range", 4, 100, 2, "m")
    return Signal(torch.arange(24.0).reshape(2, 3, 4), axes)


def test_isel_shortens_samples_and_axis():
    signal = ramp()
    part = signal.isel(range=slice(1, 3))
    assert part.axis("range") == Axis("range", 2, 102, 2, "m")
    assert part.data[0].tolist() == [[1, 2], [5, 6], [9, 10]]
    assert part.data.data_ptr() == signal.data[..., 1:].data_ptr()
    thinned = signal.isel(pulse=slice(None, None, 2), range=slice(-3, 99))
    assert thinned.axes == (Axis("pulse", 2, 0, 2, "s"), Axis("range", 3, 102, 2, "m"))
    assert thinned.data[1].tolist() == [[13, 14, 15], [21, 22, 23]]


def test_an_index_and_a_coordinate_remove_their_axis():
    signal = ramp()
    line = signal.isel(pulse=-1)
    assert line.names == ("range",) and line.trials == (2,) and line.data[0].tolist() == [8, 9, 10, 11]
    column = signal.sel(range=102.9)  # the nearest sample lies at 102
    assert column.names == ("pulse",) and column.data[0].tolist() == [1, 5, 9]


def test_sel_takes_the_samples_between_two_coordinates_with_both_ends():
    part = ramp().sel(range=slice(102, 104), pulse=slice(0.2, None))
    assert part.axes == (Axis("pulse", 2, 1, 1, "s"), Axis("range", 2, 102, 2, "m"))
    fine = Signal(torch.zeros(1000), (Axis("range", 1000, 4000.0, 0.1, "m"),))
    kept = fine.sel(range=slice(4000.3, 4000.7)).axes[0]  # these are no multiples of 0.1 in binary
    assert kept.n == 5 and kept.start == pytest.approx(4000.3)
    assert fine.sel(range=slice(None, math.inf)).axes == fine.axes


@pytest.mark.parametrize(
    "position", [slice(102.5, 103.5), slice(104, 102), slice(107, 200), slice(0, 99), 98.9, math.nan]
)
def test_sel_without_samples_says_where_they_are(position):
    with pytest.raises(ValueError, match="axis 'range' has no samples at .*4 from 100 to 106 m"):
        ramp().sel(range=position)


def test_selections_that_do_not_exist_are_refused():
    with pytest.raises(ValueError, match="axis 'range' with 4 samples: the slice 3:1 has no samples in rising order"):
        ramp().isel(range=slice(3, 1))
    with pytest.raises(ValueError, match="has no samples in rising order"):
        ramp().isel(range=slice(None, None, -1))
    with pytest.raises(ValueError, match="has no step"):
        ramp().sel(range=slice(100, 104, 2))
    with pytest.raises(IndexError):
        ramp().isel(range=4)
    with pytest.raises(KeyError, match="not 'azimuth'"):
        ramp().sel(azimuth=0)


def test_xarray_gets_names_coordinates_and_units():
    pytest.importorskip("xarray", reason="xarray is not installed (extra `xarray`)")
    signal = ramp()
    array = replace(signal, data=signal.data.requires_grad_()).to_xarray()
    assert array.dims == ("trial", "pulse", "range") and array.range.units == "m"
    assert array.sel(range=102, pulse=2).values.tolist() == [9, 21]
    conjugate = torch.ones(2, 2, 3, 4, dtype=torch.complex64).mul(1j).conj()
    assert replace(signal, data=conjugate).to_xarray().dims[:2] == ("trial_0", "trial_1")
    assert complex(replace(signal, data=conjugate).to_xarray()[0, 0, 0, 0]) == -1j
    assert np.shares_memory(signal.to_xarray().values, signal.data.detach().numpy())


def test_xarray_that_is_missing_is_one_sentence(monkeypatch):
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(
        ModuleNotFoundError, match=r'Signal.to_xarray needs .* xarray: pip install "torchsar-lab\[xarray\]"'
    ):
        ramp().to_xarray()


def test_a_package_that_xarray_lacks_is_named(monkeypatch, tmp_path):
    (tmp_path / "xarray.py").write_text("import absent_part.of_it")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "xarray", raising=False)
    with pytest.raises(ModuleNotFoundError, match="needs the package absent_part: pip install"):
        ramp().to_xarray()


def test_errors_of_a_constructor_have_one_note_with_its_own_arguments():
    class Base(Stage):
        def __init__(self, level):
            super().__init__()
            self.level = level + 1

    class Derived(Base):
        def __init__(self, name):
            super().__init__(name * 2)

    for made in (Derived, type("Inherited", (Derived,), {})):
        with pytest.raises(TypeError) as caught:
            made("a")
        assert caught.value.__notes__ == [f"{made.__name__}(name) was given ('a',) and {{}}"]


def test_conversion_of_a_recording_changes_only_the_dtype_of_samples():
    recording = Recording(
        Signal(torch.zeros(2, 3, dtype=torch.complex64), (Axis("pulse", 2, 0, 1, "s"), Axis("range", 3, 0, 1, "m"))),
        None,
        {"line_number": torch.arange(2)},
    )
    moved = recording.to(torch.complex128)
    assert moved.signal.data.dtype == torch.complex128 and moved.aux["line_number"].dtype == torch.int64


def test_phase_of_a_long_range_is_exact():
    # 700 km at 3.2 GHz is 1.5e7 turns; a quarter turn is exact only in float64
    turns = torch.tensor([15_000_000.25, -15_000_000.25, 123_456_789.5], dtype=torch.float64)
    expected = torch.tensor([1j, -1j, -1], dtype=torch.complex64)
    torch.testing.assert_close(unit_phasor(turns, torch.complex64), expected, atol=1e-6, rtol=0)


def test_phase_rejects_single_precision_and_huge_turns():
    with pytest.raises(TypeError, match="float64 turns"):
        unit_phasor(torch.zeros(3), torch.complex64)
    with pytest.raises(ValueError, match="reference range"):
        reduced_turns(torch.tensor([5e11], dtype=torch.float64))
    with pytest.raises(ValueError, match="reference range"):
        reduced_turns(torch.tensor([float("nan")], dtype=torch.float64))


def test_linear_phasor_equals_the_phasor_of_every_element():
    turns = torch.tensor([0.123456789, -7.3, 1e4 + 1 / 3], dtype=torch.float64)
    index = -37.5 + torch.arange(101, dtype=torch.float64)
    torch.testing.assert_close(
        linear_phasor(turns, -37.5, 101, torch.complex128),
        unit_phasor(turns[:, None] * index, torch.complex128),
        atol=1e-9,
        rtol=0,
    )


def test_linear_phasor_is_differentiable():
    turns = torch.tensor([0.3, 0.7], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda t: linear_phasor(t, -2, 5, torch.complex128), (turns,))


@pytest.mark.parametrize("dim", [-1, -2])
def test_transform_in_blocks_equals_the_plain_one(dim):
    x = torch.randn(3, 50, 70, dtype=torch.complex128)
    expected = torch.fft.fft(x, dim=dim)
    torch.testing.assert_close(transform_in_blocks(x.clone(), dim, block_bytes=5000), expected)
    torch.testing.assert_close(transform_in_blocks(expected.clone(), dim, inverse=True, block_bytes=5000), x)


def test_take_and_best_of_choose_per_trial():
    costs = torch.tensor([[3.0, 1.0], [2.0, 5.0], [4.0, 1.5]])
    values = torch.tensor([[10.0, 11.0], [20.0, 21.0], [30.0, 31.0]])
    best, margin = best_of(costs, values)
    assert best.tolist() == [20.0, 11.0] and margin.tolist() == [1.0, 0.5]
    x = torch.arange(24.0).reshape(2, 3, 4)
    assert take(x, torch.tensor([2, 0]), dim=1).tolist() == [[8, 9, 10, 11], [12, 13, 14, 15]]


def test_a_recording_of_trials_is_indexed_with_its_side_data():
    axes = Axis("pulse", 4, 0.0, 0.1, "s"), Axis("range", 3, 0.0, 1.0, "m")
    aux = {"line_number": torch.arange(4), "place_m": torch.arange(24.0).view(2, 4, 3), "trigger_s": torch.arange(2.0)}
    recording = Recording(Signal(torch.arange(24.0).view(2, 4, 3), axes), None, aux)
    one = recording[1]
    assert torch.equal(one.signal.data, recording.signal.data[1]) and torch.equal(one.aux["place_m"], aux["place_m"][1])
    assert torch.equal(one.aux["line_number"], aux["line_number"]) and one.aux["trigger_s"] == 1
    with pytest.raises(IndexError, match="chooses trials"):
        one[0]
    alike = Recording(Signal(torch.zeros(4, 4, 3), axes), None, {"line_number": torch.arange(4)})
    with pytest.raises(ValueError, match="aux.line_number of shape .4,. may have an entry for each of the 4 trials"):
        alike[0]


def test_a_signal_is_multiplied_by_numbers_and_tensors() -> None:
    axes = Axis("pulse", 3, 0.0, 1.0, "s"), Axis("range", 4, 0.0, 1.0, "m")
    signal = Signal(torch.ones(2, 3, 4, dtype=torch.complex64), axes)
    phase = torch.polar(torch.ones(3), torch.arange(3.0))[:, None]
    for product in (signal * phase, phase * signal, 1 * (signal * phase)):
        assert isinstance(product, Signal) and product.axes == axes
        assert torch.equal(product.data, signal.data * phase)
    with pytest.raises(TypeError, match="for two, multiply their samples"):
        _ = signal * signal
    with pytest.raises(ValueError, match="must end in dimensions of the lengths of its axes"):
        _ = signal.isel(range=slice(0, 1)) * torch.ones(4)
