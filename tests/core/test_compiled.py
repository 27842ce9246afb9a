"""Stages and chains in programs of torch.compile."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch._dynamo.backends.common import aot_autograd
from torch._functorch.aot_autograd import make_boxed_func
from torch._inductor import compile_fx

from tests.helpers import compiles_stages
from torchsar.core import Axis, Chain, Estimate, Outcome, Signal, Stage, host_value, untraced, use

pytestmark = compiles_stages


class Gain(Stage):
    """Multiply by a tunable gain; the number of steps follows from the values of `step`."""

    fixed = ("step",)

    def __init__(self) -> None:
        super().__init__()
        self.hold("gain", nn.Parameter(torch.tensor(2.0, dtype=torch.float64)))

    def forward(self, signal: Signal, step: Tensor) -> Signal:
        with untraced(step):
            steps = host_value(step.sum(), 0)
        return signal.with_data(signal.data * self.gain * steps)


class Level(Stage):
    """Estimate the level."""

    provides = ("level",)
    neutral = {"level": 1.0}

    def forward(self, signal: Signal) -> Estimate:
        level = signal.data.abs().mean((-2, -1))
        return Estimate({"level": level}, quality=torch.ones_like(level), outcome=Outcome.of(level > 0, Outcome.NOISE))


class Divide(Stage):
    """Divide by a level; `read` reads one more value than a program can hold."""

    read = False

    def forward(self, signal: Signal, level: Tensor) -> Signal:
        scale = float(level.max()) if self.read else 1.0
        return signal.with_data(signal.data / level[..., None, None] if scale > 0 else signal.data)


class Reading(Divide):
    read = True


@pytest.fixture(autouse=True)
def fresh() -> Iterator[None]:
    torch._dynamo.reset()
    yield
    torch._dynamo.reset()


def signal_of(trials: int = 2, pulses: int = 6, requires_grad: bool = False, start: float = 0.0) -> Signal:
    generator = torch.Generator().manual_seed(trials * pulses)
    data = torch.randn(trials, pulses, 4, dtype=torch.complex128, generator=generator)
    return Signal(
        data.requires_grad_(requires_grad), (Axis("pulse", pulses, start, 0.1, "s"), Axis("range", 4, 0.0, 1.0, "m"))
    )


def compiled(module: nn.Module, counts: list[int] | None = None, fullgraph: bool = True) -> Callable[..., Any]:
    """The module compiled, with the number of operations of each graph in `counts`."""
    aot = torch._dynamo.lookup_backend("aot_eager")

    def backend(graph: torch.fx.GraphModule, inputs: list[Any]) -> Any:
        if counts is not None:
            counts.append(len(graph.graph.nodes))
        return aot(graph, inputs)

    return torch.compile(module, fullgraph=fullgraph, backend=backend)


@pytest.mark.slow
def test_a_chain_is_one_graph_for_each_length() -> None:
    chain, graphs = Chain(level=Level(), divide=use(Divide(), level="level")), []
    program, counts = compiled(chain, graphs), []
    signals = [signal_of(2, 6), signal_of(3, 7, start=1.5), signal_of(3, 7, start=2.5)]
    for x in (*signals, *signals):
        found = program(x)
        torch.testing.assert_close(found.data, chain(x).data)
        assert found.axes == x.axes
        counts.append(len(graphs))
    assert counts[2] == counts[-1]  # programs are kept


def test_a_trace_has_no_times() -> None:
    chain = Chain(level=Level(), divide=use(Divide(), level="level"))
    x = signal_of()
    trace = torch.compile(chain.trace, fullgraph=True, backend="eager")(x)
    torch.testing.assert_close(trace.values["level.level"], chain.trace(x).values["level.level"])
    assert not trace.seconds and trace.bytes["divide"] == 2 * 6 * 4 * 16
    assert list(chain.trace(x).seconds) == ["level", "divide"]


@pytest.mark.slow
def test_fixed_values_are_constants_and_are_checked() -> None:
    stage, x, step = Gain(), signal_of(), torch.arange(3.0)
    chain = Chain(gain=use(stage, step="given.step"))
    program = compiled(chain)
    with torch.no_grad():
        torch.testing.assert_close(program(x, {"given.step": step}).data, 6 * x.data)
        torch.testing.assert_close(program(x, {"given.step": step.clone()}).data, 6 * x.data)
        with pytest.raises(RuntimeError, match="Gain: step is not that of the first call"):
            program(x, {"given.step": step + 1})
        # lengths are part of the program, and other lengths make another one
        torch.testing.assert_close(program(x, {"given.step": torch.arange(4.0)}).data, 12 * x.data)


@pytest.mark.slow
@pytest.mark.parametrize("stage, values", [(Gain(), {"step": torch.ones(2)}), (Reading(), {"level": torch.ones(2)})])
def test_what_one_graph_cannot_hold_runs_between_graphs(stage: Stage, values: dict[str, Tensor]) -> None:
    x, y = signal_of(requires_grad=True), signal_of(requires_grad=True)
    with pytest.raises(torch._dynamo.exc.TorchDynamoException):
        compiled(stage)(x, **values)
    found, expected = compiled(stage, fullgraph=False)(x, **values).data, stage(y, **values).data
    torch.testing.assert_close(found, expected)
    found.abs().square().sum().backward()
    expected.abs().square().sum().backward()
    torch.testing.assert_close(x.data.grad, y.data.grad)


class Table(Stage):
    """Multiplies by a table that it keeps, in place or not, or writes into it."""

    def __init__(self, writes: bool = False, inplace: bool = False) -> None:
        super().__init__()
        self.table, self.writes, self.inplace = torch.arange(1.0, 5.0), writes, inplace

    def forward(self, signal: Signal) -> Signal:
        table = self.table.add_(1) if self.writes else self.table
        return signal.with_data(signal.data.clone().mul_(table) if self.inplace else signal.data * table)


@pytest.mark.slow
@pytest.mark.parametrize(
    "chain",
    [
        Chain(level=Level(), divide=use(Divide(), level="level")),
        Chain(table=Table(), again=Table()),
        Chain(table=Table(inplace=True)),
    ],
    ids=["estimate", "table", "table in place"],
)
def test_derivatives_pass_through_a_compiled_chain(chain: Chain) -> None:
    x, y = (signal_of(requires_grad=True) for _ in "xy")
    for signal, form in ((x, compiled(chain)), (y, chain)):
        form(signal).data.abs().pow(3).sum().backward()
    torch.testing.assert_close(x.data.grad, y.data.grad)


@torch.no_grad()
def test_a_table_is_a_value_of_the_program() -> None:
    """inductor propagates shapes in this way, and takes no tensor of the host."""

    def propagated(graph: torch.fx.GraphModule, inputs: list[Any]) -> Any:
        compile_fx.fake_tensor_prop(graph, inputs)
        return make_boxed_func(graph.forward)

    x = signal_of()
    program = torch.compile(Table(), fullgraph=True, backend=aot_autograd(fw_compiler=propagated))
    for other in (x, x.with_data(2 * x.data)):
        torch.testing.assert_close(program(other).data, Table()(other).data)


@pytest.mark.slow
@torch.no_grad()
def test_a_program_does_not_write_into_its_constants() -> None:
    """What it writes would be lost; such a stage runs between two graphs."""
    x = signal_of()
    with pytest.raises(torch._dynamo.exc.TorchDynamoException):
        compiled(Table(writes=True))(x)
    program, stage = compiled(Table(writes=True), fullgraph=False), Table(writes=True)
    for _ in range(2):
        torch.testing.assert_close(program(x).data, stage(x).data)
