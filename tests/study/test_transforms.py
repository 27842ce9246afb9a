"""Derivatives, maps, exported and compiled programs of whole chains: torch.func, torch.export and
torch.compile through the recommended chain of every system.

Estimates are held, as in `chain.trace(recording, estimates)`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from tests.helpers import compiles_stages
from tests.study.scenes import SCENES, bench_of
from torchsar.core import Chain, Draws, Recording

STEP = 1e-5
# the stage that forms the recommended image estimates as well; held estimates would replace it
METHODS = {"geo_ocean": "conventional"}
# "aot_eager" traces the stages themselves, as inductor does, in twice the time of "eager"
BACKENDS = {"stripmap": "aot_eager"}


@dataclass(frozen=True)
class Held:
    """A chain with the recording of two trials and the estimates that it found."""

    system: str
    chain: Chain
    recording: Recording
    values: dict[str, Tensor]

    @property
    def data(self) -> Tensor:
        return self.recording.signal.data

    def image(
        self, data: Tensor, values: dict[str, Tensor] | None = None, aux: dict[str, Tensor] | None = None
    ) -> Tensor:
        """Image of other data, complex or detected."""
        signal = self.recording.signal.with_data(data)
        recording = replace(self.recording, signal=signal, aux=self.recording.aux if aux is None else aux)
        return self.chain.trace(recording, self.values if values is None else values).signal.data

    def sharpness(self, data: Tensor) -> Tensor:
        image = self.image(data)
        power = (image * image.conj()).real
        return power.square().sum() / power.sum().square()


class Program(nn.Module):
    """Module that forms the image of other data, with the values that were held or with others."""

    def __init__(self, held: Held) -> None:
        super().__init__()
        self.held, self.chain = held, held.chain

    def forward(self, data: Tensor, values: dict[str, Tensor] | None = None) -> Tensor:
        return self.held.image(data, values)


@pytest.fixture(scope="module", params=SCENES)
def held(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Held:
    folder: Path = tmp_path_factory.mktemp("transforms")
    bench = bench_of(folder, request.param, "precision=complex128")
    recording, chain = (
        bench.trials(Draws(3, trials=range(2))).recording,
        bench.chains[METHODS.get(request.param, "recommended")],
    )
    with torch.no_grad():
        estimates = chain.trace(recording).estimates
    values = {f"{stage}.{name}": v for stage, found in estimates.items() for name, v in found.value.items()}
    return Held(request.param, chain, recording, values)


def slope(of: Callable[[Tensor], Tensor], x: Tensor, along: Tensor) -> Tensor:
    """Derivative along a direction by central differences."""
    with torch.no_grad():
        return (of(x + STEP * along) - of(x - STEP * along)) / (2 * STEP)


def direction(x: Tensor) -> Tensor:
    """Random numbers of the size of the data."""
    generator = torch.Generator().manual_seed(1)
    return torch.randn(x.shape, dtype=x.dtype, generator=generator) * x.abs().square().mean().sqrt()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:at a pulse rate")
def test_forward_reverse_and_second_derivatives(held: Held) -> None:
    x, along = held.data, direction(held.data)
    expected = slope(held.image, x, along)
    _, forward = torch.func.jvp(held.image, (x,), (along,))
    assert float((forward - expected).abs().max()) < 1e-4 * float(expected.abs().max())

    gradient = torch.func.grad(held.sharpness)
    number = float(slope(held.sharpness, x, along))
    assert float((gradient(x).conj() * along).sum().real) == pytest.approx(number, rel=1e-4)
    _, second = torch.func.jvp(gradient, (x,), (along,))
    expected = slope(gradient, x, along)
    assert float((second - expected).abs().max()) < 1e-4 * float(expected.abs().max())


@pytest.mark.filterwarnings("ignore:at a pulse rate")
def test_a_mapped_chain_equals_the_batch(held: Held) -> None:
    """Side data of single trials are mapped as well; paths, which decide on the plan of an image,
    are those of the first trial for all.
    """
    count = len(held.data)
    each = {name: v for name, v in held.recording.aux.items() if v.ndim and len(v) == count}
    paths = {name: v[0] for name, v in each.items() if name.endswith("_m")}
    own = {name: v for name, v in each.items() if name not in paths}
    shared = {**held.recording.aux, **paths}

    def one(data: Tensor, values: dict[str, Tensor], own: dict[str, Tensor]) -> Tensor:
        return held.image(data, values, {**shared, **own})

    mapped = torch.vmap(one)(held.data, held.values, own)
    together = held.image(
        held.data, aux={**held.recording.aux, **{k: v.expand(count, *v.shape) for k, v in paths.items()}}
    )
    assert float((mapped - together).abs().max()) < 1e-9 * float(together.abs().max())


@pytest.mark.slow
@torch.no_grad()
@pytest.mark.parametrize("values", ["held", "given"])
def test_an_exported_chain_gives_the_same_image(held: Held, values: str) -> None:
    """Values are constants of the program, or arguments of it like the data."""
    if values == "given" and not held.values:
        pytest.skip("no stage estimates a value")
    given: list[Any] = [held.data]
    others: list[Any] = [1.7 * held.data.flip(0) + 0.5 * direction(held.data)]
    if values == "given":
        given.append(held.values)
        others.append({name: 1.001 * v for name, v in held.values.items()})
    module = Program(held)
    found = torch.export.export(module, tuple(given), strict=False).module()(*others)
    expected = module(*others)
    assert float((found - expected).abs().max()) < 1e-12 * float(expected.abs().max())


@pytest.mark.slow
@compiles_stages
@torch.no_grad()
def test_a_compiled_chain_is_one_graph(held: Held) -> None:
    """Data, values and side data are arguments of the graph, which serves other data as well."""
    torch._dynamo.reset()
    module, other = Program(held), 1.7 * held.data.flip(0) + 0.5 * direction(held.data)
    compiled = torch.compile(module, fullgraph=True, backend=BACKENDS.get(held.system, "eager"))
    compiled(held.data)
    with torch._dynamo.config.patch(error_on_recompile=True):
        found = compiled(other)
    expected = module(other)
    assert float((found - expected).abs().max()) < 1e-12 * float(expected.abs().max())
