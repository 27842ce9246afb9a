"""An autofocus whose image weights come from a small trained network."""

from __future__ import annotations

import json
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, conv2d, pad, silu, softplus

from torchsar.compensate import sca
from torchsar.core import Draws, cis, unit_level

WEIGHTS = Path(__file__).with_name("learned.json")


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
        """Phase of each pulse relative to the weighted image.

        The image has two samples per Doppler cell, so that pulses at both ends of the aperture are
        no neighbours. Without the mean of the weights, a pulse is not compared with itself.
        """
        n = rows.shape[-1]
        x = rows * cis(-phase)[:, None]
        image = torch.fft.fft(x, 2 * n)
        weights = self.weights(image.real.square() + image.imag.square())
        weights = weights - weights.mean(-1, keepdim=True)
        model = torch.fft.ifft(image * weights)[..., :n]
        return self.relaxation * (x * model.conj()).sum(-2).angle()


def save_weights(network: LearnedAutofocus, path: Path) -> None:
    """Write the parameters of a network."""
    numbers = {name: x.tolist() for name, x in network.state_dict().items()}
    path.write_text(json.dumps(numbers, indent=1) + "\n", encoding="utf-8")


def trained() -> LearnedAutofocus:
    """The network with the parameters of the package."""
    network = LearnedAutofocus(Draws(0))
    numbers = json.loads(WEIGHTS.read_text(encoding="utf-8"))
    network.load_state_dict({name: torch.tensor(x) for name, x in numbers.items()})
    return network.requires_grad_(False)
