"""Images by tiles against the direct sum, over random geometries, with gradients and batches."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch
from torch import Tensor

from tests.focus.geometries import C128, F64, C, Case, case
from tests.helpers import assert_forward_equals_backward
from torchsar.focus import ImageGrid, ProcessedBeam, TilePlan, backproject, image_tiles
from torchsar.focus.tiles import sector as of_plan
from torchsar.focus.tiles.scene import _pixel_rule
from torchsar.radar import LIGHT_M_S


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1000, 1016))
def test_the_promised_error_holds_in_any_geometry(seed: int) -> None:
    drawn, wanted = case(seed), (-50.0, -70.0, -90.0)[seed % 3]
    try:
        plan = drawn.plan(wanted)
    except ValueError as refusal:
        assert "tiles reach" in str(refusal)
        return
    assert plan.choice.error_db <= wanted
    assert drawn.error_db(plan.image(drawn.history)) < wanted + 3
    assert drawn.error_db(plan.image(drawn.history.to(torch.complex64))) < wanted + 3


@pytest.mark.parametrize(
    ("seed", "wanted"),
    [(3084, -50.3), (3112, -61.5), (3120, -58.1), (3158, -53.7), (3010, -85.9)],
)
def test_the_prediction_is_close_to_the_error(seed: int, wanted: float) -> None:
    drawn = case(seed)
    plan = drawn.plan(wanted)
    history = torch.stack([drawn.history, drawn.history.flip(0, 1)])
    errors = [replace(drawn, history=h).error_db(image) for h, image in zip(history, plan.image(history), strict=True)]
    assert plan.choice.error_db - 6 < sum(errors) / 2 < plan.choice.error_db + 3


@pytest.mark.parametrize(("pixels", "size"), [(5, 8), (16, 16), (21, 16), (300, 32), (3, 8)])
def test_the_quadrature_over_pixels_is_exact(pixels: int, size: int) -> None:
    """The mean of polynomials of degree 7 over all pixels, by their positions in the tiles."""
    at = (torch.arange(pixels) % size - (size - 1) / 2).to(F64) / size
    nodes, weight = _pixel_rule(pixels, size)
    for power in range(8):
        torch.testing.assert_close((weight * (nodes / size) ** power).sum(), (at**power).mean())


def test_most_geometries_are_accepted() -> None:
    def refused(seed: int) -> bool:
        try:
            case(seed).plan(-60.0)
        except ValueError:
            return True
        return False

    assert sum(map(refused, range(1100, 1112))) <= 1


def test_a_point_has_the_number_of_samples_as_peak_and_phase_zero() -> None:
    drawn = case(1003)
    at = drawn.grid.pixels_m()[7, 11]
    receiver = drawn.transmitter_m if drawn.receiver_m is None else drawn.receiver_m
    path = sum(torch.linalg.vector_norm(place - at, dim=-1) for place in (drawn.transmitter_m, receiver))
    turns = (path - drawn.reference_m)[:, None] * drawn.frequency_hz / C
    echo = torch.exp(-2j * math.pi * (turns - turns.round()))
    assert abs(complex(drawn.plan().image(echo)[7, 11]) / echo.numel() - 1) < 1e-3


def test_the_example_of_the_tutorial_finds_its_target(capsys: pytest.CaptureFixture[str]) -> None:
    text = (Path(__file__).resolve().parents[2] / "docs" / "tutorials" / "path.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    last = next(i for i, block in enumerate(blocks) if "TilePlan" in block)
    exec(compile("".join(blocks[last - 1 : last + 1]), "path.md", "exec"), {})
    found = re.match(r"\((\d+), (\d+)\) tensor\((\d\.\d*)", capsys.readouterr().out)
    assert found and found.groups()[:2] == ("94", "56") and abs(float(found[3]) - 1) < 1e-3


def test_trials_share_a_path_or_have_their_own() -> None:
    drawn = case(1004)
    plan, histories = drawn.plan(), torch.stack([drawn.history, drawn.history.flip(0).conj(), 2j * drawn.history])
    together = plan.image(histories.view(3, 1, *drawn.history.shape))
    assert together.shape == (3, 1, *drawn.grid.counts)
    scale = float(together.abs().max())
    for one, history in zip(together[:, 0], histories, strict=True):
        torch.testing.assert_close(one, plan.image(history), rtol=0, atol=1e-12 * scale)
    moved = drawn.transmitter_m + 0.01 * torch.randn(3, *drawn.transmitter_m.shape, dtype=F64)
    own = replace(drawn, transmitter_m=moved).plan().image(histories)
    for one, path, history in zip(own, moved, histories, strict=True):
        assert replace(drawn, transmitter_m=path, history=history).error_db(one) < -67


def test_several_threads_and_a_second_image_give_the_same() -> None:
    drawn, threads = case(1006), torch.get_num_threads()
    plan = drawn.plan(-90.0)
    first = plan.image(drawn.history)
    try:
        torch.set_num_threads(2)
        assert torch.equal(first, plan.image(drawn.history))
    finally:
        torch.set_num_threads(threads)


def test_the_axis_of_the_range_may_be_the_first() -> None:
    drawn = case(1005)
    grid = drawn.grid
    turned = replace(drawn, grid=replace(grid, axes=grid.axes.flip(0), counts=grid.counts[::-1]))
    image = turned.plan().image(drawn.history)
    assert turned.error_db(image) < -67
    some = torch.arange(0, image.numel(), 31)
    exact = turned.plan().exact(drawn.history, turned.grid.pixels_m().reshape(-1, 3)[some])
    assert float((image.flatten()[some] - exact).norm() / exact.norm()) < 10 ** (-67 / 20)
    assert drawn.error_db(image.mT) < -67


def test_gradients_are_those_of_the_direct_sum() -> None:
    drawn = case(1007)
    i, j = (torch.arange(0, n, 3) for n in drawn.grid.counts)
    pixels = drawn.grid.pixels_m()[i][:, j].reshape(-1, 3)
    weight = torch.randn(len(pixels), dtype=C128)
    found = []
    for tiles in (True, False):
        given = {
            "transmitter_m": drawn.transmitter_m.clone().requires_grad_(),
            "reference_m": drawn.reference_m.clone().requires_grad_(),
            "history": drawn.history.clone().requires_grad_(),
        }
        tried = replace(drawn, **given)
        image = tried.plan().image(tried.history)[i][:, j].flatten() if tiles else tried.direct(pixels)
        cost = (image * weight).real.sum() + image.abs().square().mean()
        found.append(torch.autograd.grad(cost, list(given.values())))
    for ours, truth in zip(*found, strict=True):
        assert float((ours - truth).norm() / truth.norm()) < 1e-3


def small(drawn: Case) -> Case:
    """The same with six pulses and seven frequencies, by one antenna."""
    return replace(
        drawn,
        transmitter_m=drawn.transmitter_m[:6],
        receiver_m=None,
        reference_m=2 * torch.linalg.vector_norm(drawn.transmitter_m[:6], dim=-1),
        frequency_hz=drawn.frequency_hz[:7],
        history=drawn.history[:6, :7],
    )


@pytest.mark.slow
def test_gradcheck_in_history_and_positions() -> None:
    drawn = case(1008)
    few = replace(small(drawn), grid=replace(drawn.grid, counts=(4, 3)))
    k = 2 * math.pi * float(few.frequency_hz.mean()) / C  # positions in radians

    def image(history: Tensor, shift: Tensor) -> Tensor:
        return plan.moved(few.transmitter_m + shift / k, None, few.reference_m).image(history)

    plan = few.plan(-60.0)
    inputs = few.history.clone().requires_grad_(), torch.zeros(6, 3, dtype=F64, requires_grad=True)
    assert torch.autograd.gradcheck(image, inputs, eps=1e-3, rtol=1e-4, atol=1e-4)
    assert_forward_equals_backward(image, inputs)


def test_an_image_without_gradients_does_not_hide_those_of_the_positions() -> None:
    drawn = case(1008)
    few = replace(small(drawn), grid=replace(drawn.grid, counts=(4, 3)))
    few = replace(few, transmitter_m=few.transmitter_m.clone().requires_grad_())
    fresh, used, history = few.plan(-60.0), few.plan(-60.0), few.history.clone().requires_grad_()
    with torch.no_grad():
        used.image(few.history)
    found = [
        torch.autograd.grad(plan.image(history).abs().square().sum(), [few.transmitter_m, history])
        for plan in (fresh, used)
    ]
    torch.testing.assert_close(found[1], found[0])


def test_the_adjoint_of_several_trials_and_of_large_tables_is_that_of_each(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = case(1003)
    history = torch.randn(3, *drawn.history.shape, dtype=C128)
    found = []
    for kept in (1 << 27, 0):  # tables are kept, or computed again
        monkeypatch.setattr(of_plan, "_KEPT_BYTES", kept)
        given = history.clone().requires_grad_()
        image = drawn.plan().image(given)
        found.append(torch.autograd.grad(image.abs().square().sum(), given)[0])
    torch.testing.assert_close(found[0], found[1])


def test_a_plan_moves_with_its_path() -> None:
    drawn = case(1009)
    plan, far = drawn.plan(), torch.tensor([0.1 * float(drawn.reference_m.mean()), 0.0, 0.0], dtype=F64)
    for shift in (0.01 * torch.randn(len(drawn.transmitter_m), 3, dtype=F64), far):
        moved = replace(drawn, transmitter_m=drawn.transmitter_m + shift)
        image = plan.moved(moved.transmitter_m, moved.receiver_m, moved.reference_m).image(moved.history)
        assert moved.error_db(image) < -67
    assert drawn.error_db(plan.image(drawn.history)) < -67


@pytest.mark.parametrize("seed, size", [(1006, 1e-4), (1006, 3e-4), (1006, 1e-3), (1006, 3e-3), (1010, 3e-4)])
def test_a_bent_path_keeps_the_error(seed: int, size: float) -> None:
    """Small bends share the plan; larger ones, in ranges, do not even within its margins."""
    drawn = case(seed)
    plan = drawn.plan()
    bend = torch.linspace(-1, 1, len(drawn.transmitter_m), dtype=F64)[:, None].square()
    shift = size * float(drawn.reference_m.mean()) * bend * torch.tensor([1.0, 0.5, -0.3], dtype=F64)
    moved = replace(drawn, transmitter_m=drawn.transmitter_m + shift)
    following = plan.moved(moved.transmitter_m, moved.receiver_m, moved.reference_m)
    assert moved.error_db(following.image(moved.history)) < -67
    assert size > 1e-4 or following.sectors[0]._zones is plan.sectors[0]._zones
    assert following.choice.error_db < -68


def test_trials_with_and_without_a_path_of_their_own() -> None:
    drawn, lead = case(1004), {"path": (2, 1, 1), "history": (3, 2, 1, 2)}
    shift = 0.002 * torch.randn(*lead["path"], len(drawn.reference_m), 3, dtype=F64)
    history = torch.randn(*lead["history"], *drawn.history.shape, dtype=C128)
    moved = replace(drawn, transmitter_m=drawn.transmitter_m + shift)
    image = moved.plan().image(history)
    assert image.shape == (3, 2, 1, 2, *drawn.grid.counts)
    for at in ((0, 1, 0, 1), (2, 0, 0, 0)):
        one = replace(moved, transmitter_m=moved.transmitter_m[at[1], 0, 0], history=history[at])
        assert one.error_db(image[at]) < -67


def hilly(drawn: Case, slope: float) -> Case:
    """The same with heights of about `slope` times the extent of the image."""
    grid = drawn.grid
    i, j = (torch.arange(n, dtype=F64) / n for n in grid.counts)
    height = slope * grid.step_m * max(grid.counts) * torch.sin(3 * i + 1)[:, None] * torch.cos(4 * j)
    return replace(drawn, grid=replace(grid, height_m=height))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1000, 1008))
def test_the_promised_error_holds_on_hills(seed: int) -> None:
    drawn = hilly(case(seed), 0.02)
    plan = drawn.plan(-60.0)
    assert drawn.error_db(plan.image(drawn.history)) < -57
    assert drawn.error_db(plan.image(drawn.history.to(torch.complex64))) < -57
    if seed == 1006:
        turned = replace(drawn, grid=drawn.grid.transposed())
        torch.testing.assert_close(turned.grid.pixels_m().transpose(0, 1), drawn.grid.pixels_m())
        assert drawn.error_db(turned.plan(-60.0).image(drawn.history).mT) < -57


def test_gradients_in_heights_are_those_of_the_direct_sum() -> None:
    drawn = hilly(case(1006), 0.02)
    assert drawn.grid.height_m is not None
    start = drawn.grid.height_m[:8, :6]
    grid = replace(drawn.grid, counts=(8, 6), height_m=start)
    weight, found = torch.randn(8, 6, dtype=C128), []
    for tiles in (True, False):
        height = start.clone().requires_grad_()
        tried = replace(drawn, grid=replace(grid, height_m=height))
        image = tried.plan().image(drawn.history) if tiles else tried.direct(tried.grid.pixels_m().reshape(-1, 3))
        image = image.view(8, 6)
        found += torch.autograd.grad((image * weight).real.sum() + image.abs().square().mean(), height)
    assert float((found[0] - found[1]).norm() / found[1].norm()) < 1e-3


@pytest.mark.parametrize("error_db", [-60.0, -110.0])
def test_gradcheck_in_heights(error_db: float) -> None:
    """Each image has a plan of its own, and yet its error is a smooth function of the heights."""
    drawn = hilly(case(1008), 0.02)
    assert drawn.grid.height_m is not None
    start = drawn.grid.height_m[:2, :3]
    grid = replace(drawn.grid, counts=(2, 3), height_m=start)
    few = small(drawn)

    def image(height: Tensor) -> Tensor:
        return replace(few, grid=replace(grid, height_m=height)).plan(error_db).image(few.history)

    assert torch.autograd.gradcheck(image, start.clone().requires_grad_())


def strip(pulses: int = 400, pixels: int = 400) -> tuple[Case, Callable[[Tensor], Tensor]]:
    """A straight path beside a strip of which each pulse lights a sixth."""
    spacing, frequencies = 0.3, 64
    x = (torch.arange(pulses, dtype=F64) - pulses / 2) * spacing
    place = torch.stack([x, torch.full_like(x, -350.0), torch.full_like(x, 300.0)], -1)
    grid = ImageGrid(
        torch.tensor([-pixels / 2 * spacing, -8.0, 0.0], dtype=F64),
        torch.eye(3, dtype=F64)[:2],
        (pixels, 50),
        spacing,
    )
    step = 300e6 / frequencies
    drawn = Case(
        10e9 + step * (torch.arange(frequencies, dtype=F64) - frequencies // 2),
        place,
        None,
        2 * torch.linalg.vector_norm(place, dim=-1),
        grid,
        torch.randn(pulses, frequencies, dtype=C128),
    )

    def lit(points: Tensor) -> Tensor:
        ends = points[:, :1] + torch.tensor([-10.0, 10.0], dtype=F64)
        return torch.searchsorted(x, ends)

    return drawn, lit


@pytest.mark.slow
@pytest.mark.parametrize("weighted", [False, True])
def test_a_strip_sums_the_pulses_that_light_each_pixel(weighted: bool) -> None:
    drawn, lit = strip(pixels=390)
    x = drawn.transmitter_m[:, 0]

    def weight(points: Tensor) -> Tensor:
        return torch.cos((x - points[:, :1]) / 8)

    given = drawn.frequency_hz, drawn.transmitter_m, None, drawn.reference_m, drawn.grid
    plan = TilePlan(*given, error_db=-70, lit=lit, weight=weight if weighted else None, images=None)
    pixels = drawn.grid.pixels_m()
    rows, columns = drawn.grid.counts
    assert rows % plan.choice.width and rows > 2 * plan.choice.width
    some = torch.arange(0, rows * columns, 53)
    i, j = some // columns, some % columns
    number, ends = torch.arange(len(x))[:, None], lit(pixels[i, j])
    shares = ((ends[:, 0] <= number) & (number < ends[:, 1])).to(F64)
    if weighted:
        shares = shares * weight(pixels[i, j]).mT
    way = 2 * torch.linalg.vector_norm(pixels[i, j] - drawn.transmitter_m[:, None], dim=-1) - drawn.reference_m[:, None]
    waves = torch.exp(2j * math.pi * drawn.frequency_hz[:, None, None] * way / LIGHT_M_S)
    truth = (drawn.history.mT[..., None] * shares * waves).sum((0, 1))
    found = plan.image(drawn.history)
    assert float((found[i, j] - truth).norm() / truth.norm()) < 10 ** (-67 / 20)
    assert float((plan.exact(drawn.history, pixels[i, j]) - truth).norm() / truth.norm()) < 1e-7
    first, last = 180, 200
    history = torch.zeros_like(drawn.history)
    history[first:last] = drawn.history[first:last]
    found = plan.image(history)
    assert found.any() and not found[:40].any() and not found[-40:].any()
    moved = plan.moved(drawn.transmitter_m, None, drawn.reference_m).image(history)
    torch.testing.assert_close(moved, found)


@pytest.mark.parametrize("limit", [0, 32])
def test_a_plan_of_a_long_strip_keeps_no_more_than_its_limits(monkeypatch: pytest.MonkeyPatch, limit: int) -> None:
    """Positions and the polynomials of tiles take less than 1 MB, tables and weights of an image in
    single precision 18 and 31 MB, in double precision twice as much.
    """
    drawn, _ = strip(pulses=500, pixels=500)
    monkeypatch.setattr("torchsar.focus.tiles.sector._KEPT_BYTES", limit << 20)
    plan, single = drawn.plan(-40.0), drawn.history.to(torch.complex64)
    sizes = []
    for history in (single, single.expand(2, -1, -1), drawn.history):
        plan.image(history)
        file = io.BytesIO()
        torch.save(plan, file)
        sizes.append(file.tell() / 2**20)
    assert max(sizes) < 2 * limit + 1
    assert min(sizes[:2]) >= limit and sizes[2] < 1


def about_a_scene(turns: float, pulses: int, raised_m: float = 0.0) -> Case:
    """White noise of turns of radius 300 m about 32 x 40 pixels."""
    angle = torch.linspace(0, 2 * math.pi * turns, pulses, dtype=F64) + 0.3
    height = torch.linspace(150, 150 + raised_m, pulses, dtype=F64)
    place = torch.stack([300 * torch.cos(angle), 300 * torch.sin(angle), height], -1)
    grid = ImageGrid(torch.tensor([-1.6, -2.0, 0.0]), torch.eye(3)[:2], (32, 40), 0.1)
    frequency = 9.6e9 + 16e6 * torch.arange(32, dtype=F64)
    noise = torch.randn(pulses, 32, dtype=C128, generator=torch.Generator().manual_seed(3))
    return Case(frequency, place, None, 2 * torch.linalg.vector_norm(place, dim=-1), grid, noise)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("turns", "raised_m", "bistatic"), [(1.0, 0.0, False), (-0.4, 0.0, False), (-0.4, 0.0, True), (1.5, 60.0, False)]
)
def test_a_path_about_the_scene_keeps_the_error(turns: float, raised_m: float, bistatic: bool) -> None:
    drawn = about_a_scene(turns, round(720 * abs(turns)), raised_m)
    if bistatic:
        receiver = torch.tensor([[40.0, -500.0, 300.0]], dtype=F64).expand_as(drawn.transmitter_m)
        reference = drawn.reference_m / 2 + torch.linalg.vector_norm(receiver, dim=-1)
        drawn = replace(drawn, receiver_m=receiver, reference_m=reference)
    plan = drawn.plan(-60.0)
    assert len(plan.sectors) > 2 * abs(turns)
    assert drawn.error_db(plan.image(drawn.history)) < -57
    some = drawn.grid.pixels_m().reshape(-1, 3)[::37]
    truth = drawn.direct(some)
    assert float((plan.exact(drawn.history, some) - truth).norm() / truth.norm()) < 1e-7
    moved = replace(drawn, transmitter_m=drawn.transmitter_m + 1e-4)
    image = plan.moved(moved.transmitter_m, moved.receiver_m, moved.reference_m).image(moved.history)
    assert moved.error_db(image) < -57


@pytest.mark.parametrize(("step", "wanted"), [(0.1, -30.0), (0.3, -40.0)])
def test_pulses_at_the_ends_of_a_wide_arc_stay_within_the_window(step: float, wanted: float) -> None:
    """The carrier of a pulse with eps below 0 moves by more than eps."""
    angle, radius, carrier = torch.linspace(0, 3.445, 200, dtype=F64), 1.1e4, 4.9e9
    place = radius * torch.stack([torch.cos(angle), torch.sin(angle), torch.full_like(angle, 0.5)], -1)
    step = step * C / carrier
    grid = ImageGrid(torch.tensor([-24 * step, -24 * step, 0.0], dtype=F64), torch.eye(3)[:2], (48, 48), step)
    frequency = carrier * (1 + 0.28 / 50 * (torch.arange(50, dtype=F64) - 25))
    noise = torch.randn(200, 50, dtype=C128, generator=torch.Generator().manual_seed(3))
    drawn = Case(frequency, place, None, 2 * torch.linalg.vector_norm(place, dim=-1), grid, noise)
    assert drawn.error_db(drawn.plan(wanted).image(noise)) < wanted


def test_a_window_keeps_the_error_where_the_path_hardly_changes() -> None:
    """On a short path all pixels lie at the same places between the samples of a window."""
    along = torch.linspace(-2.2, 2.2, 83, dtype=F64)
    place = torch.stack([along, torch.full_like(along, -1000.0), torch.full_like(along, 847.4)], -1)
    grid = ImageGrid(torch.tensor([-2.98, -4.94, 0.0], dtype=F64), torch.eye(2, 3, dtype=F64), (51, 84), 0.119144)
    frequency = 9.0494e9 + 17.2077e6 * torch.arange(64, dtype=F64)
    plan = TilePlan(frequency, place, None, 2 * place.norm(dim=-1), grid, -45.0, images=None)
    noise = torch.randn(8, 83, 64, generator=torch.Generator().manual_seed(1), dtype=torch.complex64)
    exact = plan.exact(noise.to(C128), grid.pixels_m().reshape(-1, 3)[::7], eps=1e-6)
    left = (plan.image(noise).flatten(-2)[..., ::7] - exact).norm() / exact.norm()
    assert 20 * math.log10(float(left)) < -44


def test_weights_that_change_beyond_the_image_are_those_of_its_pixels() -> None:
    """The last tiles are filled in part, and the beam ends behind the last pixel."""
    along = torch.linspace(-4.85, 4.85, 160, dtype=F64)
    place = torch.stack([along, torch.full_like(along, -300.0), torch.full_like(along, 189.0)], -1)
    grid = ImageGrid(torch.tensor([-15.6, -9.4, 0.0], dtype=F64), torch.eye(2, 3, dtype=F64), (69, 42), 0.458)
    beam, frequency = ProcessedBeam(7.027), 9.458e9 + 4.442e6 * torch.arange(64, dtype=F64)
    given = grid, -30.0, partial(beam.lit_pulses, place), partial(beam.pulse_weights, place)
    plan = TilePlan(frequency, place, None, 2 * place.norm(dim=-1), *given, images=None)
    noise = torch.randn(4, 160, 64, generator=torch.Generator().manual_seed(1), dtype=torch.complex64)
    exact = plan.exact(noise.to(C128), grid.pixels_m().reshape(-1, 3), eps=1e-6)
    assert 20 * math.log10(float((plan.image(noise).flatten(-2) - exact).norm() / exact.norm())) < -28


def pointed(place: Tensor, points: Tensor, width: float, looks: Tensor | float = 0.0) -> Tensor:
    """Gaussian pattern over the sine of the angle ahead of broadside, less that of each look."""
    away = points[:, None] - place
    return torch.exp(-((away[..., 0] / torch.linalg.vector_norm(away, dim=-1) - looks) / width).square())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "wanted"),
    [("beam", -45.0), ("beam", -80.0), ("squint", -80.0), ("pointing", -60.0), ("gaps", -60.0), ("hills", -45.0)]
    + [("circle", -60.0)],
)
def test_the_promised_error_holds_with_weights_of_each_pixel(kind: str, wanted: float) -> None:
    squint = 20.0 if kind == "squint" else 0.0
    drawn = about_a_scene(1.0, 720) if kind == "circle" else beside_a_track(600, (60, 30), squint, None)
    place, lit, pulses = drawn.transmitter_m, None, len(drawn.transmitter_m)
    if kind in ("beam", "squint", "gaps", "hills"):
        beam = ProcessedBeam(3.0, squint)
        lit, weight = partial(beam.lit_pulses, place), partial(beam.pulse_weights, place)
    if kind == "pointing":
        weight = partial(pointed, place, width=0.02, looks=0.05 * torch.sin(torch.arange(pulses, dtype=F64) / 100))
    elif kind == "gaps":
        kept = (torch.rand(pulses, generator=torch.Generator().manual_seed(2)) > 0.2).to(F64)
        weight = lambda points: beam.pulse_weights(place, points) * kept  # noqa: E731
    elif kind == "hills":
        hills = 4 * torch.sin(torch.arange(60, dtype=F64) / 20)[:, None] * torch.ones(30, dtype=F64)
        drawn = replace(drawn, grid=replace(drawn.grid, height_m=hills))
    elif kind == "circle":
        weight = partial(pointed, place, width=0.01, looks=-place[:, 0] / place.norm(dim=-1))
    given = drawn.frequency_hz, place, None, drawn.reference_m, drawn.grid
    plan = TilePlan(*given, wanted, lit, weight, images=None)
    some = drawn.grid.pixels_m().reshape(-1, 3)[::17]
    shares = weight(some)
    waves = torch.linalg.vector_norm(some[:, None] - place, dim=-1) * 2 - drawn.reference_m
    turns = waves[..., None] * drawn.frequency_hz / LIGHT_M_S
    truth = (drawn.history * shares[..., None] * torch.exp(2j * math.pi * turns)).sum((-2, -1))
    assert float((plan.exact(drawn.history, some) - truth).norm() / truth.norm()) < 1e-7
    found = plan.image(drawn.history).flatten()[::17]
    assert float((found - truth).norm() / truth.norm()) < 10 ** ((wanted + 3) / 20)


def test_pixels_that_no_pulse_lights_are_zero() -> None:
    drawn, lit = strip(pulses=60)
    given = drawn.frequency_hz, drawn.transmitter_m, None, drawn.reference_m
    image = image_tiles(drawn.history, *given, drawn.grid, -60.0, lit)
    assert image[200].abs().min() > 0 and not image[:40].any()
    for wrong in (lambda points: points, lambda points: [0, 9]):
        with pytest.raises(ValueError, match="lit must return a tensor of torch.int64 of shape"):
            TilePlan(*given, drawn.grid, -60.0, wrong)
    number = len(drawn.transmitter_m)
    for dtype, match in (
        (F64, "finite weights"),
        (torch.float32, "weight must return a tensor of torch.float64 of shape"),
    ):

        def weight(points: Tensor, dtype: torch.dtype = dtype) -> Tensor:
            return torch.full((len(points), number), math.nan, dtype=dtype)

        with pytest.raises(ValueError, match=match):
            TilePlan(*given, drawn.grid, -60.0, lit, weight)
    plan = TilePlan(*given, drawn.grid, -60.0, lit, images=None)
    for pixels, match in (
        (torch.full((1, 3), 900.0, dtype=F64), "outside of it"),
        (torch.zeros(3, dtype=F64), r"\(3,\)"),
    ):
        with pytest.raises(ValueError, match=match):
            plan.exact(drawn.history, pixels)
    with pytest.raises(ValueError, match="no pulse lights"):
        TilePlan(*given, drawn.grid, -60.0, lambda points: torch.zeros(len(points), 2, dtype=torch.int64))


def test_a_small_lit_part_between_the_corners_and_the_middle_is_found() -> None:
    drawn, _ = strip(pulses=100)
    inside = (drawn.grid.pixels_m() - torch.tensor([20.0, -3.0, 0.0], dtype=F64)).abs()[..., :2].amax(-1) < 1.5

    def lit(points: Tensor) -> Tensor:
        seen = (points - torch.tensor([20.0, -3.0, 0.0], dtype=F64)).abs()[:, :2].amax(-1) < 1.5
        return seen[:, None] * torch.tensor([10, 90])

    plan = TilePlan(
        drawn.frequency_hz, drawn.transmitter_m, None, drawn.reference_m, drawn.grid, -60.0, lit, images=None
    )
    history = drawn.history.clone()
    history[:10], history[90:] = 0, 0
    found = plan.image(history)[inside]
    truth = replace(drawn, history=history).direct(drawn.grid.pixels_m()[inside])
    assert len(truth) > 50 and float((found - truth).norm() / truth.norm()) < 10 ** (-57 / 20)


def test_a_tile_whose_middle_is_dark_shows_its_lit_part() -> None:
    drawn, _ = strip(pulses=100)
    edge = drawn.grid.origin_m[0] + drawn.grid.step_m * 2.5

    def lit(points: Tensor) -> Tensor:
        return (points[:, :1] < edge) * torch.tensor([10, 90])

    found = TilePlan(
        drawn.frequency_hz, drawn.transmitter_m, None, drawn.reference_m, drawn.grid, -60.0, lit, images=None
    )
    assert found.choice.width / 2 - 1 > 2.5
    history = drawn.history.clone()
    history[:10], history[90:] = 0, 0
    truth = replace(drawn, history=history).direct(drawn.grid.pixels_m()[:3].reshape(-1, 3))
    image = found.image(drawn.history)
    # at the edge of a tile errors are larger than in the mean
    assert float((image[:3].flatten() - truth).norm() / truth.norm()) < 10 ** (-50 / 20) and not image[3:].any()


def beside_a_track(pulses: int, counts: tuple[int, int], squint_deg: float, height_m: float | None) -> Case:
    """White noise of a straight path in steps of 0.5 m, 1.1 km beside pixels of one metre."""
    x = (torch.arange(pulses, dtype=F64) - pulses / 2) / 2
    place = torch.stack([x, torch.full_like(x, -1000.0), torch.full_like(x, 500.0)], -1)
    ahead = 1118 * math.tan(math.radians(squint_deg))
    origin = torch.tensor([ahead - counts[0] / 2, -counts[1] / 2, 0.0], dtype=F64)
    height = None if height_m is None else torch.full(counts, height_m, dtype=F64)
    grid = ImageGrid(origin, torch.eye(3, dtype=F64)[:2], counts, 1.0, height)
    frequency = 9.6e9 + 3e6 * torch.arange(32, dtype=F64)
    noise = torch.randn(pulses, 32, dtype=C128, generator=torch.Generator().manual_seed(5))
    return Case(frequency, place, None, torch.full_like(x, 2236.0), grid, noise)


@pytest.mark.slow
def test_the_pulses_that_light_a_strip_decide_on_its_range_direction() -> None:
    """Most pulses of a path of 6 km see the middle of a strip at 1.1 km far ahead or behind."""
    drawn = beside_a_track(12_000, (128, 64), 0.0, None)
    lit = partial(ProcessedBeam(3.0).lit_pulses, drawn.transmitter_m)
    plan = TilePlan(
        drawn.frequency_hz, drawn.transmitter_m, None, drawn.reference_m, drawn.grid, -40.0, lit, images=None
    )
    some = drawn.grid.pixels_m().reshape(-1, 3)[::701]
    exact = plan.exact(drawn.history, some)
    found = plan.image(drawn.history).flatten()[::701]
    assert float((found - exact).norm() / exact.norm()) < 10 ** (-37 / 20)


@pytest.mark.parametrize("squint_deg", [-25.0, 25.0])
def test_raised_pixels_are_sums_over_the_pulses_that_light_them(squint_deg: float) -> None:
    drawn = beside_a_track(2400, (60, 70), squint_deg, 60.0)
    lit = partial(ProcessedBeam(1.5, squint_deg).lit_pulses, drawn.transmitter_m)
    plan = TilePlan(
        drawn.frequency_hz, drawn.transmitter_m, None, drawn.reference_m, drawn.grid, -60.0, lit, images=None
    )
    some = drawn.grid.pixels_m().reshape(-1, 3)[::97]
    exact = plan.exact(drawn.history, some)
    found = plan.image(drawn.history).flatten()[::97]
    assert float((found - exact).norm() / exact.norm()) < 10 ** (-57 / 20)


class Program(torch.nn.Module):
    """Module that images histories, with a plan or with a new one of other positions."""

    def __init__(self, drawn: Case) -> None:
        super().__init__()
        self.drawn, self.plan = drawn, drawn.plan(-60.0)

    def forward(self, history: Tensor, transmitter_m: Tensor | None = None) -> Tensor:
        if transmitter_m is None:
            return self.plan.image(history)
        return replace(self.drawn, transmitter_m=transmitter_m).plan(-60.0).image(history)


@torch.no_grad()
def test_a_plan_can_be_exported_and_is_not_changed() -> None:
    program = Program(hilly(small(case(1006)), 0.02))
    history = program.drawn.history
    exported = torch.export.export(program, (history,), strict=False).module()
    other = history.flip(0).conj() + 1
    expected = Program(program.drawn)(other)
    assert torch.equal(exported(other), expected) and torch.equal(program(other), expected)
    with pytest.raises(ValueError, match="must be constants"):
        torch.export.export(program, (history, program.drawn.transmitter_m), strict=False)


def test_an_error_that_tiles_do_not_reach_is_refused_with_the_figure_or_summed_directly() -> None:
    drawn = case(1001)
    near = replace(drawn, grid=replace(drawn.grid, step_m=float(drawn.reference_m.mean())))
    reason = r"tiles reach .* wanted were -70 dB.*sum directly"
    with pytest.raises(ValueError, match=reason):
        near.plan()
    with pytest.warns(UserWarning, match=reason):
        plan = near.plan(images=1000.0)
    assert plan.choice is None and re.search(reason, plan.direct) and plan.direct in repr(plan)
    assert near.error_db(plan.image(near.history)) < -70
    with pytest.raises(ValueError, match="error_db"):
        drawn.plan(-300.0)
    with pytest.raises(ValueError, match="0 images"):
        drawn.plan(images=0)


@pytest.mark.parametrize("hidden", [False, True])
def test_few_pixels_are_summed_directly_unless_many_images_share_the_plan(hidden: bool) -> None:
    drawn = beside_a_track(100, (40, 30), 0.0, None)
    beam = ProcessedBeam(3.0)
    place = drawn.transmitter_m
    seen = (partial(beam.lit_pulses, place), partial(beam.pulse_weights, place)) if hidden else (None, None)
    given = drawn.frequency_hz, place, None, drawn.reference_m, drawn.grid, -60.0, *seen
    plan, other = TilePlan(*given), TilePlan(*given, images=None)
    assert "the direct sum takes about" in plan.direct and not other.direct
    assert "100 of 100 pulses" in plan.direct and "tiles of" in repr(other)
    history = drawn.history.clone().requires_grad_()
    images = [one.image(history) for one in (plan, other)]
    assert float((images[0] - images[1]).detach().norm() / images[1].detach().norm()) < 10 ** (-57 / 20)
    loss = [(image.abs().square() * torch.arange(30)).sum() for image in images]
    first, second = (torch.autograd.grad(one, history)[0] for one in loss)
    assert float((first - second).norm() / second.norm()) < 2e-3
    some = drawn.grid.pixels_m().reshape(-1, 3)[::7]
    exact = plan.exact(drawn.history, some)
    assert float((plan.image(drawn.history).flatten()[::7] - exact).norm() / exact.norm()) < 1e-3
    moved = place + 0.05
    following = plan.moved(moved, None, drawn.reference_m)
    again = TilePlan(drawn.frequency_hz, moved, None, drawn.reference_m, drawn.grid, -60.0, *seen)
    assert torch.equal(following.image(drawn.history), again.image(drawn.history))


def test_paths_of_trials_are_summed_directly() -> None:
    drawn = case(1004)
    places = drawn.transmitter_m + torch.tensor([0.0, 0.2, 0.4]).double()[:, None, None]
    given = drawn.frequency_hz, places, drawn.receiver_m, drawn.reference_m, drawn.grid
    history = torch.stack([drawn.history, 2 * drawn.history])[:, None]
    images = [TilePlan(*given, -70.0, images=many).image(history) for many in (1e-6, None)]
    assert images[0].shape == (2, 3, *drawn.grid.counts)
    assert float((images[0] - images[1]).norm() / images[1].norm()) < 10 ** (-67 / 20)


@pytest.mark.parametrize(("pulses", "frequencies"), [(1, 2), (1, 40), (2, 2), (3, 3), (60, 2), (5, 64)])
def test_few_pulses_or_frequencies(pulses: int, frequencies: int) -> None:
    drawn = case(1010)
    few = replace(
        drawn,
        transmitter_m=drawn.transmitter_m[:pulses],
        receiver_m=None,
        reference_m=2 * torch.linalg.vector_norm(drawn.transmitter_m[:pulses], dim=-1),
        frequency_hz=drawn.frequency_hz[:frequencies],
        history=drawn.history[:pulses, :frequencies],
    )
    assert few.error_db(few.plan().image(few.history)) < -65


@pytest.mark.parametrize(
    ("change", "error", "text"),
    [
        ({"transmitter_m": torch.zeros(5, 3)}, TypeError, "transmitter_m must be a float64 tensor"),
        ({"frequency_hz": torch.tensor([1e9, 2e9, 4e9], dtype=F64)}, ValueError, "equal steps"),
        ({"transmitter_m": torch.zeros(5, 3, dtype=F64)}, ValueError, "positions of shape"),
        ({"transmitter_m": torch.zeros(0, 175, 3, dtype=F64)}, ValueError, "positions of shape"),
        ({"reference_m": torch.full((3,), math.nan, dtype=F64)}, ValueError, "NaN"),
    ],
)
def test_geometries_that_make_no_sense_are_refused(change: dict, error: type, text: str) -> None:
    with pytest.raises(error, match=text):
        replace(case(1002), **change).plan()


def test_histories_of_another_size_or_type_are_refused() -> None:
    drawn = case(1002)
    plan = drawn.plan(-50.0)
    with pytest.raises(ValueError, match="needs a history"):
        plan.image(drawn.history[:, 1:])
    with pytest.raises(TypeError):
        plan.image(drawn.history.real)


@pytest.mark.parametrize(
    "change",
    [
        {"origin_m": torch.zeros(2)},
        {"axes": torch.ones(2, 3)},
        {"counts": (0, 3)},
        {"step_m": 0.0},
        {"step_m": math.nan},
        {"height_m": torch.zeros(3, 2, dtype=F64)},
        {"height_m": torch.full((2, 3), math.nan, dtype=F64)},
    ],
)
def test_grids_that_make_no_sense_are_refused(change: dict) -> None:
    with pytest.raises(ValueError, match="image grid|pixel spacing|NaN"):
        replace(ImageGrid(torch.zeros(3), torch.eye(3)[:2], (2, 3), 1.0), **change)


def test_pixels_of_a_grid() -> None:
    grid = ImageGrid(torch.tensor([1.0, 2.0, 3.0]), torch.tensor([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]), (3, 4), 0.5)
    pixels = grid.pixels_m()
    assert pixels.shape == (3, 4, 3) and pixels.dtype == F64
    assert pixels[2, 3].tolist() == [2.5, 3.0, 3.0]
    assert torch.equal(grid.pixels_m(slice(1, 2), slice(0, 2)), pixels[1:2, 0:2])


def test_the_error_is_that_of_the_trial_farthest_from_the_others() -> None:
    """Of five paths the second sways: its error counts, wherever it stands."""
    pulses = 128
    angle = torch.linspace(-0.03, 0.03, pulses, dtype=torch.float64)
    path = 3000.0 * torch.stack([torch.sin(angle), -torch.cos(angle), torch.ones_like(angle)], -1)
    paths = path.repeat(5, 1, 1)
    paths[1, :, 1] += 2.0 * torch.sin(300 * angle)
    frequency = 9.5e9 + 2e6 * torch.arange(64, dtype=torch.float64)
    grid = ImageGrid(torch.tensor([-20.0, -20.0, 0.0]), torch.eye(3)[:2], (48, 48), 0.8)
    reference = 2 * torch.linalg.vector_norm(paths, dim=-1)
    plan = TilePlan(frequency, paths, None, reference, grid, -70.0, images=None)
    made = torch.Generator().manual_seed(1)
    history = torch.randn(5, pulses, 64, dtype=torch.complex128, generator=made)
    at = torch.randint(48 * 48, (200,), generator=made)
    exact = backproject(history, frequency, paths, None, reference, grid.pixels_m().reshape(-1, 3)[at])
    error = (plan.image(history).flatten(-2)[:, at] - exact).abs().square().mean(-1).sqrt()
    assert bool((20 * torch.log10(error / exact.abs().square().mean(-1).sqrt()) < -67).all())
