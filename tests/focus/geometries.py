"""Random geometries with histories of white noise, and their images by definition."""

from __future__ import annotations

import math
import random
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from torchsar.focus import ImageGrid, TilePlan

C, F64, C128 = 299792458.0, torch.float64, torch.complex128


@dataclass(frozen=True)
class Case:
    """A geometry and a history of white noise."""

    frequency_hz: Tensor
    transmitter_m: Tensor
    receiver_m: Tensor | None
    reference_m: Tensor
    grid: ImageGrid
    history: Tensor

    def plan(self, error_db: float = -70.0, images: float | None = None) -> TilePlan:
        given = self.frequency_hz, self.transmitter_m, self.receiver_m, self.reference_m, self.grid, error_db
        return TilePlan(*given, images=images)

    def direct(self, pixels_m: Tensor) -> Tensor:
        """The sum over all samples at pixels (pixel, 3), by its definition."""
        receiver = self.transmitter_m if self.receiver_m is None else self.receiver_m
        path = sum(
            torch.linalg.vector_norm(pixels_m[:, None] - place, dim=-1) for place in (self.transmitter_m, receiver)
        )
        turns = (path - self.reference_m)[..., None] * self.frequency_hz / C
        phasor = torch.polar(torch.ones_like(turns), 2 * math.pi * (turns - turns.detach().round()))
        return (self.history.to(C128) * phasor).sum((-2, -1))

    @cached_property
    def _sampled(self) -> tuple[Tensor, Tensor, Tensor]:
        """Rows and columns of 200 random pixels, and their values."""
        source = torch.Generator().manual_seed(1)
        i, j = (torch.randint(0, n, (200,), generator=source) for n in self.grid.counts)
        return i, j, self.direct(self.grid.pixels_m()[i, j])

    def error_db(self, image: Tensor) -> float:
        """Rms error of an image at random pixels, relative to their rms, in dB."""
        i, j, truth = self._sampled
        return 10 * math.log10(float((image[i, j] - truth).abs().square().mean() / truth.abs().square().mean()))


def case(seed: int) -> Case:
    """Draw range, aperture, bandwidth, squint, path, receiver and grid."""
    draw, source = random.Random(seed), torch.Generator().manual_seed(seed)

    def log(low: float, high: float) -> float:
        return math.exp(draw.uniform(math.log(low), math.log(high)))

    range_m, aperture, carrier = log(200, 700e3), math.radians(log(1, 20)), log(1e9, 35e9)
    bandwidth, squint, grazing = carrier * log(0.01, 0.4), math.radians(draw.uniform(0, 45)), draw.uniform(0.26, 1.05)
    pulses, frequencies = draw.randrange(64, 200), draw.randrange(64, 200)
    counts = draw.randrange(20, 120), draw.randrange(20, 120)
    cells = C / 2 / bandwidth / math.cos(grazing), C / carrier / (2 * aperture)
    step = draw.uniform(0.4, 1.0) * draw.choice([min(cells), max(cells)])
    step = min(step, 0.5 * range_m / max(counts), 0.45 * C * frequencies / (2 * bandwidth) / max(counts))
    angle = (torch.arange(pulses, dtype=F64) / pulses - 0.5) * aperture
    ground = range_m * math.cos(grazing)
    x, y = ground * torch.sin(angle), -ground * torch.cos(angle)
    if draw.random() < 0.5:
        x, y = range_m * torch.tan(angle), torch.full_like(angle, -ground)
    place = torch.stack([x, y, torch.full_like(x, range_m * math.sin(grazing))], -1)
    cos, sin = math.cos(squint), math.sin(squint)
    place = place @ torch.tensor([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]], dtype=F64)
    kind, scale = draw.choice(["straight", "sway", "rough"]), min(1.0, range_m / 2000)
    if kind == "sway":
        turns, start = 4 * torch.rand(3, generator=source, dtype=F64), torch.rand(3, generator=source, dtype=F64)
        time = torch.linspace(0, 1, pulses, dtype=F64)[:, None]
        place = place + draw.uniform(0.1, 3) * scale * torch.sin(2 * math.pi * (time * turns + start))
    if kind == "rough":
        place = place + log(0.003, 0.3) * scale * torch.randn(pulses, 3, generator=source, dtype=F64)
    transmitter, receiver = place, None
    radar = draw.choice(["one antenna", "fixed transmitter", "two in motion"])
    if radar == "fixed transmitter":
        fixed = [draw.uniform(-1, 1), -draw.uniform(0.3, 1.5), draw.uniform(0.1, 1)]
        transmitter, receiver = range_m * torch.tensor(fixed, dtype=F64).expand(pulses, 3), place
    if radar == "two in motion":
        offset = [draw.uniform(-0.3, 0.3), -draw.uniform(0, 0.3), draw.uniform(0, 0.3)]
        receiver = place + range_m * torch.tensor(offset, dtype=F64)
    ends = (transmitter, place if receiver is None else receiver)
    centre = torch.tensor([-(counts[0] - 1) / 2 * step, -(counts[1] - 1) / 2 * step, 0.0], dtype=F64)
    return Case(
        carrier + (torch.arange(frequencies, dtype=F64) - frequencies // 2) * (bandwidth / frequencies),
        transmitter,
        receiver,
        torch.stack([torch.linalg.vector_norm(end, dim=-1) for end in ends]).sum(0),
        ImageGrid(centre, torch.eye(3, dtype=F64)[:2], counts, step),
        torch.randn(pulses, frequencies, generator=source, dtype=C128),
    )
