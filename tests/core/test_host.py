"""Values on the host: read where they can be, otherwise a default, and no other error is hidden."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from torchsar.core import cis, device_fault, host_largest, host_value


def test_values_are_read_with_their_type() -> None:
    x = torch.tensor([1.0, -3.0, 2.5], requires_grad=True)
    assert host_value((x > 0).any(), False) is True
    assert host_largest(x, 0.0) == 2.5 and host_largest(x[:0], -math.inf) == -math.inf
    largest = host_largest(torch.tensor([2, 7]), 0)
    assert largest == 7 and isinstance(largest, int)


def test_inside_vmap_there_is_no_value() -> None:
    seen: list[float] = []

    def look(x: Tensor) -> Tensor:
        seen.append(host_largest(x, 5.0))
        return x

    torch.func.vmap(look)(torch.ones(2, 3))
    torch.func.grad(lambda x: look(x).sum())(torch.ones(3))
    assert seen == [5.0, 1.0]


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
