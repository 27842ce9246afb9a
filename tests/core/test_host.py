"""Values on the host: read where they can be, otherwise a default, and no other error is hidden."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode

from tests.contract.pretended import pretended_device, to_device, to_host
from torchsar.core import (
    check_value,
    cholesky_factor,
    cis,
    device_fault,
    gathered_checks,
    host_largest,
    host_value,
    host_values,
    is_traced,
    linear_solve,
    matrix_inverse,
    numbers_on,
    refuse_non_finite,
    unit_phasor,
    untraced,
)
from torchsar.metrics import entropy


def test_values_are_read_with_their_type() -> None:
    x = torch.tensor([1.0, -3.0, 2.5], requires_grad=True)
    assert host_value((x > 0).any(), False) is True
    assert host_largest(x, 0.0) == 2.5 and host_largest(x[:0], -math.inf) == -math.inf
    largest = host_largest(torch.tensor([2, 7]), 0)
    assert largest == 7 and isinstance(largest, int)


def test_inside_vmap_there_is_no_value() -> None:
    seen: list[float | list[float]] = []

    def look(x: Tensor) -> Tensor:
        seen.extend([host_largest(x, 5.0), host_values(x, 5.0)])
        return x

    torch.func.vmap(look)(torch.ones(2, 3))
    torch.func.grad(lambda x: look(x).sum())(torch.arange(3.0))
    assert seen == [5.0, [5.0, 5.0, 5.0], 2.0, [0.0, 1.0, 2.0]]


def test_other_errors_are_not_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(RuntimeError, match="2 elements"):
        host_value(torch.ones(2), 0.0)

    def full(*_: object, **__: object) -> Tensor:
        raise torch.OutOfMemoryError("the device is full")

    with monkeypatch.context() as patched, pytest.raises(torch.OutOfMemoryError):
        patched.setattr(torch, "cos", full)
        cis(torch.ones(3))


@pytest.mark.parametrize("device", ["meta", "best", "cuda:99", ""])
def test_a_device_that_cannot_compute_says_why(device: str) -> None:
    assert device_fault("cpu") == device_fault(torch.device("cpu")) == ""
    assert device_fault(device) and "\n" not in device_fault(device)


def test_values_are_not_read_while_a_program_is_traced() -> None:
    real = torch.ones(2)
    with FakeTensorMode(allow_non_fake_inputs=True) as mode:
        x = mode.from_tensor(real)
        assert is_traced(x) and is_traced(torch.ones(2)) and is_traced(2 * real) and not is_traced(real)
        assert host_value(x.sum(), 7.0) == host_largest(x, 7.0) == 7.0
        check_value(x.sum(), at_most(0.0))
        with untraced():
            assert (2 * real).tolist() == [2.0, 2.0] and host_value(real.sum(), 7.0) == 2.0
        with untraced(1.0, None, real):
            assert not is_traced(torch.ones(2))
        with untraced(real, x):
            assert is_traced(torch.ones(2))
    with untraced(), pretended_device() as counts:
        host_value(to_device(real).sum(), 0.0)
    assert counts.waits.total() == 1
    with pretended_device() as counts, untraced():
        host_value(to_device(real).sum(), 0.0)
    assert counts.waits.total() == 1


def at_most(limit: float) -> Callable[[float], None]:
    def check(value: float) -> None:
        if value > limit:
            raise ValueError(f"{value:g} > {limit:g}")

    return check


def test_checks_wait_for_one_reading() -> None:
    x = to_device(torch.tensor([1.0, 2.0, 3.0]))
    with pretended_device() as counts, gathered_checks():
        for value in x:
            check_value(value, at_most(4.0))
        assert not counts.waits.total()
        assert host_largest(x, 0.0) == 3.0 and counts.waits.total() == 1
        check_value(x[0], at_most(4.0))
        with gathered_checks():
            check_value(x[1], at_most(4.0))
        assert counts.waits.total() == 2
    assert counts.waits.total() == 2


def test_the_first_check_that_fails_raises_with_the_next_reading_or_at_the_end() -> None:
    x = to_device(torch.tensor([1.0, 2.0, 3.0]))
    with pretended_device():
        with pytest.raises(ValueError, match="2 > 1"), gathered_checks():
            check_value(x[1], at_most(1.0))
            check_value(x[2], at_most(1.0))
            host_value(x[0], 0.0)
            pytest.fail("the check has not been made")
        with pytest.raises(ValueError, match="3 > 1"), gathered_checks():
            check_value(x[2], at_most(1.0))
        with pytest.raises(ValueError, match="3 > 1") as raised, gathered_checks():
            check_value(x[2], at_most(1.0))
            raise IndexError("of a value that is too large")
        assert isinstance(raised.value.__context__, IndexError)
        with pytest.raises(torch.OutOfMemoryError), gathered_checks():
            check_value(x[2], at_most(1.0))
            raise torch.OutOfMemoryError("the device is full")
        assert host_value(x[0], 0.0) == 1.0


def test_checks_on_the_cpu_and_outside_of_blocks_do_not_wait() -> None:
    with gathered_checks(), pytest.raises(ValueError):
        check_value(torch.tensor(2.0), at_most(1.0))
    with pretended_device(), pytest.raises(ValueError):
        check_value(to_device(torch.tensor(2.0)), at_most(1.0))
    torch.func.vmap(lambda x: check_value(x, at_most(0.0)) or x)(torch.ones(2))


def test_phases_samples_and_factorisations_are_checked_with_one_reading() -> None:
    turns, samples = torch.linspace(0, 9, 5, dtype=torch.float64), torch.ones(4, dtype=torch.complex128)
    matrix = torch.eye(3, dtype=torch.float64) + 0.1
    with pretended_device() as counts:
        there = to_device(matrix)
        with gathered_checks():
            unit_phasor(to_device(turns), torch.complex64)
            refuse_non_finite(to_device(samples), "samples")
            made = [linear_solve(there, there), matrix_inverse(there), cholesky_factor(there)]
        assert counts.waits.total() == 1
        for bad, text in ((turns * 1e12, "at most 4e"), (samples * math.inf, "4 of 4 samples are NaN or Inf")):
            with pytest.raises(ValueError, match=text), gathered_checks():
                if bad.is_complex():
                    refuse_non_finite(to_device(bad), "samples")
                else:
                    unit_phasor(to_device(bad), torch.complex64)
    expected = [torch.linalg.solve(matrix, matrix), torch.linalg.inv(matrix), torch.linalg.cholesky(matrix)]
    torch.testing.assert_close(to_host(made), expected)


def test_large_matrices_of_a_batch_are_solved() -> None:
    """LU factors of a batch of them with two threads are wrong on some processors."""
    generator = torch.Generator().manual_seed(1)
    matrix = torch.eye(160, dtype=torch.float64) + torch.randn(2, 3, 160, 160, generator=generator, dtype=torch.float64)
    right = torch.randn(3, 160, 2, generator=generator, dtype=torch.float64)
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        solution, inverse = linear_solve(matrix, right), matrix_inverse(matrix)
        vector = linear_solve(matrix, matrix[..., 0])
        slope = torch.func.jvp(matrix_inverse, (matrix,), (matrix,))[1]
    finally:
        torch.set_num_threads(threads)
    torch.testing.assert_close(matrix @ solution, right.expand(2, -1, -1, -1))
    torch.testing.assert_close(inverse @ matrix, torch.eye(160, dtype=torch.float64).expand_as(matrix))
    torch.testing.assert_close(slope, -inverse)
    torch.testing.assert_close(vector, torch.eye(160, dtype=torch.float64)[0].expand(2, 3, -1))


@pytest.mark.parametrize("factor", [matrix_inverse, cholesky_factor, lambda x: linear_solve(x, x)])
def test_singular_matrices_are_refused(factor: Callable[[Tensor], Tensor]) -> None:
    matrix = torch.zeros(2, 3, 3, dtype=torch.float64)
    with pytest.raises(torch.linalg.LinAlgError, match="a matrix is"):
        factor(matrix)
    with pretended_device(), pytest.raises(torch.linalg.LinAlgError, match="a matrix is"), gathered_checks():
        factor(to_device(matrix))


def test_numbers_reach_a_device_without_a_copy() -> None:
    with pretended_device() as counts:
        found = numbers_on("meta", 1.5, -2.0)
    assert to_host(found).tolist() == [1.5, -2.0] == numbers_on(None, 1.5, -2.0).tolist()
    assert not counts.uploads.total()


def test_a_mask_that_does_not_fit_into_memory_is_no_wrong_mask(monkeypatch: pytest.MonkeyPatch) -> None:
    image, mask = torch.ones(4, 4, dtype=torch.complex64), torch.ones(4, 4)

    to = Tensor.to

    def full(x: Tensor, *args: object, **kwargs: object) -> Tensor:
        if x is mask:
            raise torch.OutOfMemoryError("the device is full")
        return to(x, *args, **kwargs)

    with monkeypatch.context() as patched, pytest.raises(torch.OutOfMemoryError):
        patched.setattr(Tensor, "to", full)
        entropy(image, mask=mask)
