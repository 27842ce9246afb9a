"""Autofocus by trained networks: weights of image cells, of a fixed point, and of lag products."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, conv1d, conv2d, pad, silu, softplus

from torchsar.compensate import sca
from torchsar.core import Draws, cis, unit_level

WEIGHTS = Path(__file__).with_name("weights")


class CellWeights(nn.Module):
    """Weight of each image cell, computed from its power and that of its surroundings.

    A shift of the image in Doppler shifts the weights, and a factor on the image changes nothing.

    Args:
        draws: Source of the initial parameters.
        hidden: Number of hidden units.
    """

    def __init__(self, draws: Draws, hidden: int = 12) -> None:
        super().__init__()

        def drawn(name: str, scale: float, *shape: int) -> nn.Parameter:
            return nn.Parameter(scale * draws.normal(name, shape, torch.float32))

        self.of_cell, self.of_row = drawn("of_cell", 0.5, hidden, 3), drawn("of_row", 0.5, hidden, 3)
        self.offset, self.out = nn.Parameter(torch.zeros(hidden)), drawn("out", 0.05, hidden)

    def forward(self, power: Tensor) -> Tensor:
        """Power (trial, range, Doppler) of an image to weights of the same shape.

        The network adds a term to that of ln(1 + p / 2), a weight that lowers the entropy.
        """
        row = power.mean(-1, keepdim=True)
        mean = row.mean(-2, keepdim=True).clamp_min(1e-12)
        noise = row.quantile(0.25, -2, keepdim=True)  # if the target leaves some range cells free
        sharpness = power.square().mean((-2, -1), keepdim=True) / mean.square()
        cell = [power, beside(power), around(power)]
        x = torch.stack([(part / mean + 1e-4).log() for part in cell], 1)
        context = [(row / mean).log(), (noise / mean).log().expand_as(row), sharpness.log().expand_as(row)]
        y = torch.stack(context, 1).clamp(-8, 8)
        hidden = conv2d(x, self.of_cell[..., None, None], self.offset) + conv2d(y, self.of_row[..., None, None])
        change = conv2d(silu(hidden), self.out[None, :, None, None])
        return softplus(x[:, 0] - 0.7) * change[:, 0].exp()


def beside(power: Tensor) -> Tensor:
    """Mean power of a cell and its neighbours in range."""
    return avg_pool2d(pad(power, (0, 0, 1, 1))[:, None], (3, 1), 1)[:, 0]


def around(power: Tensor) -> Tensor:
    """Mean power of 5 range cells and 9 Doppler cells; the image is circular in Doppler."""
    wide = pad(pad(power, (4, 4), mode="circular"), (0, 0, 2, 2))
    return avg_pool2d(wide[:, None], (5, 9), 1)[:, 0]


class LearnedAutofocus(nn.Module):
    """Phase of each pulse, (trial, pulse), from range-compressed data, (trial, pulse, range).

    Args:
        draws: Source of the initial parameters.
    """

    def __init__(self, draws: Draws) -> None:
        super().__init__()
        self.weights, self.relaxation = CellWeights(draws), nn.Parameter(torch.tensor(1.5))

    def forward(self, data: Tensor, rounds: int = 20) -> Tensor:
        phase = sca(data)["phase_rad"]
        rows = unit_level(data).mT
        for _ in range(rounds):
            phase = phase + self.step(rows, phase)
        return phase

    def step(self, rows: Tensor, phase: Tensor) -> Tensor:
        """Phase of each pulse relative to the weighted image."""
        return self.relaxation * fixed_point_step(rows, phase, self.weights)


def fixed_point_step(rows: Tensor, phase: Tensor, weights_of: Callable[[Tensor], Tensor]) -> Tensor:
    """Phase of each pulse, (trial, pulse), relative to an image whose cells have weights.

    The image has two samples per Doppler cell, so that pulses at both ends of the aperture are no
    neighbours. Without the mean of the weights, a pulse is not compared with itself.
    """
    n = rows.shape[-1]
    x = rows * cis(-phase)[:, None]
    image = torch.fft.fft(x, 2 * n)
    weights = weights_of(image.real.square() + image.imag.square())
    weights = weights - weights.mean(-1, keepdim=True)
    model = torch.fft.ifft(image * weights)[..., :n]
    return (x * model.conj()).sum(-2).angle()


class UnrolledAutofocus(nn.Module):
    """The fixed point of least entropy, whose rounds have a floor, an exponent and a relaxation of
    their own: ln(1 + p / floor) to the exponent is the weight of the power p over its mean.

    Args:
        rounds: Number of rounds.
    """

    def __init__(self, rounds: int = 16) -> None:
        super().__init__()
        start = torch.tensor([1.0, 0.0, 0.4])  # logarithms of the floor, the exponent, the relaxation
        self.settings = nn.Parameter(start.repeat(rounds, 1))

    def forward(self, data: Tensor) -> Tensor:
        phase, rows = sca(data)["phase_rad"], unit_level(data).mT
        for floor, exponent, relaxation in self.settings.exp().unbind(0):
            step = fixed_point_step(rows, phase, lambda p, f=floor, e=exponent: _above(p, f).pow(e))
            phase = phase + relaxation * step
        return phase


def _above(power: Tensor, floor: Tensor) -> Tensor:
    return torch.log1p(power / (floor * power.mean((-2, -1), keepdim=True)).clamp_min(1e-12)).clamp_min(1e-6)


class LagAutofocus(nn.Module):
    """Phases from the products of pulses at several lags, whose weights a network finds.

    The network sees the magnitudes of the products and how well each closes a triangle with two
    others, which phases of pulses do not change. The phases then agree with the weighted products
    as well as a number of rounds can make them.

    Args:
        draws: Source of the initial parameters.
        lags: Number of lags.
        hidden: Number of channels.
        rounds: Number of rounds.
    """

    def __init__(self, draws: Draws, lags: int = 24, hidden: int = 24, rounds: int = 30) -> None:
        super().__init__()
        self.lags, self.rounds = lags, rounds

        def drawn(name: str, *shape: int) -> nn.Parameter:
            return nn.Parameter((shape[1] * shape[2]) ** -0.5 * draws.normal(name, shape, torch.float32))

        self.first, self.second = drawn("first", hidden, 2 * lags, 5), drawn("second", hidden, hidden, 5)
        self.last = drawn("last", lags, hidden, 1)
        self.offset = nn.Parameter(torch.zeros(lags, 1))

    def forward(self, data: Tensor) -> Tensor:
        rows = unit_level(data)
        energy = rows.abs().square().sum(-1).clamp_min(1e-12).sqrt()
        unit, n = rows / energy[..., None], rows.shape[-2]
        # product of the pulses k + lag and k, zero where there is no pulse k + lag
        pairs = torch.stack(
            [pad((unit[:, lag:] * unit[:, :-lag].conj()).sum(-1), (0, lag)) for lag in range(1, self.lags + 1)], 1
        )
        chain = pairs[:, :1] * pad(pairs[:, :-1, 1:], (0, 1))
        closes = (pairs[:, 1:] * chain.conj()).real / (pairs[:, 1:].abs() * chain.abs()).clamp_min(1e-12)
        seen = torch.cat([pairs.abs(), pad(closes, (0, 0, 1, 0))], 1)
        hidden = silu(conv1d(silu(conv1d(seen, self.first, padding=2)), self.second, padding=2))
        edges = softplus(conv1d(hidden, self.last) + self.offset) * pairs
        phase = torch.cat([torch.zeros_like(energy[:, :1]), pairs[:, 0, :-1].angle().cumsum(-1)], -1)
        for _ in range(self.rounds):
            phase = self.agreed(edges, cis(phase), n)
        return phase

    def agreed(self, edges: Tensor, phasor: Tensor, n: int) -> Tensor:
        """Phase of the sum over the pairs of each pulse of what its partners ask for."""
        total = torch.zeros_like(phasor)
        for i in range(min(self.lags, n - 1)):
            edge, lag = edges[:, i, : n - i - 1], i + 1
            total = total + pad(edge * phasor[:, :-lag], (lag, 0)) + pad(edge.conj() * phasor[:, lag:], (0, lag))
        return (total + 1e-6 * phasor).angle()


def networks() -> dict[str, nn.Module]:
    """All networks by name, without their parameters."""
    return {
        "learned": LearnedAutofocus(Draws(0)),
        "unrolled": UnrolledAutofocus(),
        "lag_network": LagAutofocus(Draws(0)),
    }


def save_weights(network: nn.Module, path: Path) -> None:
    """Write the parameters of a network."""
    numbers = {name: _rounded(x.tolist()) for name, x in network.state_dict().items()}
    path.write_text(json.dumps(numbers) + "\n", encoding="utf-8")


def _rounded(x: Any) -> Any:
    return [_rounded(part) for part in x] if isinstance(x, list) else float(f"{x:.6g}")


def trained() -> dict[str, nn.Module]:
    """The networks with the parameters of the package."""
    found = networks()
    for name, network in found.items():
        numbers = json.loads((WEIGHTS / f"{name}.json").read_text(encoding="utf-8"))
        network.load_state_dict({key: torch.tensor(x) for key, x in numbers.items()})
        network.requires_grad_(False)
    return found
