"""Seas and textured speckle: moments of K clutter, texture, images, draws, and errors."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from torchsar.core import Draws
from torchsar.io.plain import read_array
from torchsar.scene import ImageReflectivity, KSea, Speckle
from torchsar.scene.sea import gamma_from_normal


def grid(n: int = 40, step_m: float = 20.0) -> Tensor:
    return step_m * (torch.arange(n, dtype=torch.float64) - n // 2)


@pytest.mark.parametrize("shape", [0.5, 1.5, 5.0, 100.0, math.inf])
def test_moments_are_those_of_the_k_distribution(shape):
    """<I> = 1, <I^2> = 2 (1 + 1 / shape), and every sample circular: E[s^2] = 0."""
    s = KSea(shape).reflectivity(grid(200), grid(200), Draws(1, trials=range(25)), torch.complex128)
    intensity = s.abs().square()
    assert float(intensity.mean()) == pytest.approx(1, abs=0.01)
    assert float(intensity.square().mean() / intensity.mean() ** 2) == pytest.approx(2 * (1 + 1 / shape), rel=0.03)
    assert abs(complex(s.square().mean())) < 0.01


def test_textured_speckle_is_k_distributed_and_shares_its_texture_within_a_cell():
    shapes = torch.tensor([0.5, 2.0, math.inf])
    scene = Speckle(40_000, 80.0, 40.0, texture_shape=shapes[:, None], texture_cells=(40, 20))
    drawn = scene.scatterers(Draws(1, trials=range(4)))
    intensity = drawn.amplitude.abs().square()
    assert intensity.shape == (3, 4, 40_000)
    moment = (intensity.square().mean(-1) / intensity.mean(-1) ** 2).mean(-1)
    torch.testing.assert_close(moment, 2 * (1 + 1 / shapes.double()), rtol=0.1, atol=0)
    cell = (drawn.azimuth_m / 2.0).floor() * 100 + (drawn.range_m / 2.0).floor()
    level = torch.stack([intensity[0, 0][cell[0] == at].mean() for at in cell[0].unique()])
    # mean of 50 scatterers of a cell: the variance of the gamma texture, 2, and 1 / 50 of 2 + 1
    assert float(level.var() / level.mean() ** 2) == pytest.approx(2.0 + 3 / 50, rel=0.3)
    alone = Speckle(40_000, 80.0, 40.0, texture_shape=0.5, texture_cells=(40, 20)).scatterers(Draws(1, trials=[2]))
    assert torch.equal(alone.amplitude[0], drawn.amplitude[0, 2]) and torch.equal(alone.range_m[0], drawn.range_m[2])


@pytest.mark.parametrize("shape", [0.1, 0.5, 1.0, 1.5, 30.0, 1000.0])
def test_normal_numbers_become_gamma_numbers_rank_for_rank(shape):
    x = torch.linspace(-4.4, 6, 53, dtype=torch.float64)
    value = gamma_from_normal(x, shape)
    order = torch.full_like(x, shape)
    upper, lower = torch.special.gammaincc(order, shape * value), torch.special.gammainc(order, shape * value)
    torch.testing.assert_close(lower[x < 0], torch.special.ndtr(x[x < 0]), rtol=1e-3, atol=0)
    torch.testing.assert_close(upper[x > 0], torch.special.ndtr(-x[x > 0]), rtol=2e-3, atol=0)
    assert bool((value.diff() > 0).all())
    torch.testing.assert_close(
        gamma_from_normal(torch.tensor([-50.0, 50.0], dtype=torch.float64), shape),
        gamma_from_normal(torch.tensor([-9.0, 9.0], dtype=torch.float64), shape),
    )


def test_a_gamma_of_shape_one_is_exponential():
    x = torch.linspace(-5, 5, 41, dtype=torch.float64)
    torch.testing.assert_close(gamma_from_normal(x, 1.0), -torch.special.log_ndtr(-x), rtol=1e-5, atol=0)


def test_texture_is_shared_in_a_cell_and_only_there():
    """Cells of 10 by 30 m on a grid of 5 m have one texture each.

    The mean intensity over trials is equal within a cell, and neighbouring cells are uncorrelated.
    """
    sea = KSea(0.5, cell_m=(10.0, 30.0))
    table, row, column = sea.texture(grid(40, 5.0), grid(60, 5.0), Draws(2, trials=range(300)))
    field = table.index_select(-2, row).index_select(-1, column)
    assert field.shape == (300, 40, 60) and table.shape[-2:] == (21, 11)
    at = field[:, (grid(40, 5.0) == 0).nonzero()[0, 0]]  # along range
    same = (grid(60, 5.0).abs() < 15).nonzero()[:, 0]
    assert bool((at[:, same] == at[:, same[:1]]).all())
    pair = torch.stack([table[:, 3, 4], table[:, 4, 4], table[:, 3, 5]])
    assert float((torch.corrcoef(pair) - torch.eye(3)).abs().max()) < 0.2


def test_an_unordered_grid_has_the_same_texture():
    order = torch.randperm(40, generator=torch.Generator().manual_seed(1))
    table, row, column = KSea(cell_m=(60.0, 60.0)).texture(grid()[order], grid(), Draws(3))
    straight, straight_row, _ = KSea(cell_m=(60.0, 60.0)).texture(grid(), grid(), Draws(3))
    assert torch.equal(table, straight) and torch.equal(row, straight_row[order]) and int(column.min()) == 0


def test_draws_depend_on_their_address_only():
    whole, part, alone, other = (
        KSea().reflectivity(grid(), grid(10), d)
        for d in (Draws(5, trials=range(4)), Draws(5, trials=[3, 1]), Draws(5), Draws(6))
    )
    assert torch.equal(part, whole[[3, 1]]) and torch.equal(alone, whole[0])
    assert not torch.equal(alone, other) and not torch.equal(whole[0], whole[1])
    assert whole.dtype == torch.complex64
    torch.testing.assert_close(
        KSea().reflectivity(grid(), grid(10), Draws(5), torch.complex128).to(torch.complex64), alone
    )


def test_an_image_has_its_position_and_is_mirrored_beyond():
    """Two by four pixels of 100 by 50 m: pixels of positions, also far outside; mean one."""
    image = torch.tensor([[1.0, 2.0, 3.0, 4.0], [5.0, 6.0, 7.0, 8.0]])
    sea = ImageReflectivity(image, 200.0, 200.0)
    azimuth, distance = (
        torch.tensor([-50.0, 50.0, 150.0, -150.0, 250.0]),
        torch.tensor([-99.0, -1.0, 1.0, 99.0, 101.0, 199.0, -101.0]),
    )
    table, row, column = sea.texture(azimuth.double(), distance.double(), Draws(1))
    assert row.tolist() == [0, 1, 1, 0, 0] and column.tolist() == [0, 1, 2, 3, 3, 2, 0]
    torch.testing.assert_close(table, image.double() / 4.5)
    s = sea.reflectivity(
        torch.full((50,), 50.0, dtype=torch.float64),
        torch.full((60,), 99.0, dtype=torch.float64),
        Draws(1, trials=range(5)),
    )
    assert float(s.abs().square().mean()) == pytest.approx(8 / 4.5, rel=0.05)


def test_images_come_from_files(tmp_path):
    image = np.arange(1.0, 7.0).reshape(2, 3)
    np.save(tmp_path / "one.npy", image)
    np.savez(tmp_path / "single.npz", sea=image)
    np.savez(tmp_path / "two.npz", sea=image, complex=np.sqrt(image) * 1j)
    for path, key in (("one.npy", None), ("single.npz", None), ("two.npz", "sea"), ("two.npz", "complex")):
        sea = ImageReflectivity(read_array(tmp_path / path, key), 100.0, 100.0, power_db=3.0)
        torch.testing.assert_close(sea.intensity, torch.as_tensor(image))
        assert sea.power_db == 3.0
    (tmp_path / "text.npy").write_text("no array")
    whole = (tmp_path / "two.npz").read_bytes()
    (tmp_path / "cut.npz").write_bytes(whole[: len(whole) // 2])
    np.save(tmp_path / "words.npy", np.array([["sea", "land"]]))
    for path, key, error, sentence in (
        (
            "two.npz",
            None,
            ValueError,
            r"two.npz \(numpy\) holds the arrays sea, complex; give the name of one of them",
        ),
        ("two.npz", "land", ValueError, r"two.npz \(numpy\) has no array 'land'"),
        ("none.npy", None, FileNotFoundError, "none.npy does not exist"),
        ("cut.npz", "sea", ValueError, "cut.npz is cut off or damaged"),
        ("words.npy", None, ValueError, r"words.npy must hold numbers, got <U4"),
        (
            "text.npy",
            None,
            ValueError,
            "text.npy cannot be read as an array or a picture: it is damaged or of another kind",
        ),
    ):
        with pytest.raises(error, match=sentence):
            read_array(tmp_path / path, key)


@pytest.mark.parametrize(
    "changes, sentence",
    [
        ({"shape": 0.05}, r"shape of a K sea must lie in 0.1..1000, or be inf for pure speckle, got 0.05"),
        ({"shape": math.nan}, "shape of a K sea must lie"),
        (
            {"cell_m": (10.0, 0.0)},
            r"cell_m of a K sea must be two positive sides \(m\), along track and in range, got \(10.0, 0.0\)",
        ),
        ({"power_db": math.nan}, "power_db of a sea must be a finite number"),
        ({"margin_s": -1.0}, "margin_s of a sea must be 0 s or more, or None"),
        ({"lobes": 0}, "lobes of a sea must be a whole number of 1 or more, got 0"),
    ],
)
def test_impossible_seas_are_refused(changes, sentence):
    with pytest.raises(ValueError, match=sentence):
        KSea(**changes)


def test_impossible_textures_are_refused():
    with pytest.raises(ValueError, match=r"texture_shape of speckle must lie in 0.1..1000, or be inf .* got 0.05"):
        Speckle(10, 1.0, 1.0, texture_shape=0.05)
    with pytest.raises(ValueError, match=r"two whole numbers of 1 or more, along azimuth and range, got \(0, 3\)"):
        Speckle(10, 1.0, 1.0, texture_cells=(0, 3))


@pytest.mark.parametrize(
    "image, extent, sentence",
    [
        ([[1.0, -1.0]], 10.0, "intensity of a surface must be finite and not negative"),
        ([[1.0, math.nan]], 10.0, "intensity of a surface must be finite and not negative"),
        ([[0.0, 0.0]], 10.0, "intensity of a surface must be finite and not negative"),
        ([1.0, 2.0], 10.0, r"an array of shape \(..., azimuth, range\), got shape \(2,\)"),
        ([[1.0]], 0.0, "azimuth_extent_m of an image must be a positive number, got 0.0"),
    ],
)
def test_impossible_images_are_refused(image, extent, sentence):
    with pytest.raises(ValueError, match=sentence):
        ImageReflectivity(image, extent, 10.0)


def test_an_invalid_shape_of_gamma_numbers_is_refused():
    with pytest.raises(ValueError, match="shape of a gamma distribution must lie in 0.1..1000, got 0"):
        gamma_from_normal(torch.zeros(1, dtype=torch.float64), 0.0)
