"""Systems of linear equations, without waiting for the device to say whether they are solvable."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchsar.core.host import check_value

_LARGEST_IN_BATCH = 128  # largest number of rows of matrices that are factorised as a batch


def linear_solve(matrix: Tensor, right: Tensor) -> Tensor:
    """Solve matrix x = right, see `torch.linalg.solve`.

    The check that the matrix is invertible waits in a block of `gathered_checks`; until then the
    solution may hold NaN or Inf. Differentiable.

    Args:
        matrix: Matrices, shape (..., n, n).
        right: Right-hand sides, shape (..., n, k), or (..., n) as in `torch.linalg.solve`.

    Returns:
        Solutions, same shape as `right`, broadcast over the trial dimensions.

    Raises:
        torch.linalg.LinAlgError: If a matrix is singular.
    """
    if not _large_batch(matrix):
        solution, info = torch.linalg.solve_ex(matrix, right)
    else:
        vectors = right.ndim == 1 or right.shape == matrix.shape[:-1]
        columns = right[..., None] if vectors else right
        trials = torch.broadcast_shapes(matrix.shape[:-2], columns.shape[:-2])
        pairs = zip(*(x.expand(*trials, *x.shape[-2:]).flatten(0, -3) for x in (matrix, columns)), strict=True)
        solution, info = _joined([torch.linalg.solve_ex(*pair) for pair in pairs], trials)
        solution = solution.squeeze(-1) if vectors else solution
    _check(info, "linear_solve: a matrix is singular")
    return solution


def matrix_inverse(matrix: Tensor) -> Tensor:
    """Invert matrices, see `linear_solve` and `torch.linalg.inv`.

    Args:
        matrix: Matrices, shape (..., n, n).

    Returns:
        Inverse matrices, same shape.

    Raises:
        torch.linalg.LinAlgError: If a matrix is singular.
    """
    if not _large_batch(matrix):
        made, info = torch.linalg.inv_ex(matrix)
    else:
        made, info = _joined([torch.linalg.inv_ex(one) for one in matrix.flatten(0, -3)], matrix.shape[:-2])
    _check(info, "matrix_inverse: a matrix is singular")
    return made


def cholesky_factor(matrix: Tensor) -> Tensor:
    """Compute Cholesky factors, see `linear_solve` and `torch.linalg.cholesky`.

    Args:
        matrix: Hermitian matrices, shape (..., n, n).

    Returns:
        Lower triangular factors L with L L^H = matrix, same shape.

    Raises:
        torch.linalg.LinAlgError: If a matrix is not positive definite.
    """
    factor, info = torch.linalg.cholesky_ex(matrix)
    _check(info, "cholesky_factor: a matrix is not positive definite")
    return factor


def _large_batch(matrix: Tensor) -> bool:
    """True if the matrices of a batch must be factorised one by one.

    On some processors and with several threads, torch's LU factors of a batch of matrices larger
    than 150 x 150 on a CPU are wrong. An error is not always raised
    (https://github.com/pytorch/pytorch/issues/142815).
    """
    return matrix.device.type == "cpu" and matrix.shape[-1] > _LARGEST_IN_BATCH and matrix.shape[:-2].numel() > 1


def _joined(results: Sequence[tuple[Tensor, Tensor]], trials: Sequence[int]) -> tuple[Tensor, ...]:
    """Stack results that were computed matrix by matrix into a batch."""
    return tuple(torch.stack(parts).unflatten(0, trials) for parts in zip(*results, strict=True))


def _check(info: Tensor, what: str) -> None:
    """Raise LinAlgError if the status codes of a factorisation report a failure."""

    def check(failed: float) -> None:
        if failed:
            trial = f" at index {tuple((info != 0).nonzero()[0].tolist())}" if info.ndim else ""
            text = f"{what}{trial}, or not finite; add a small multiple of the identity"
            raise torch.linalg.LinAlgError(text)  # pyright: ignore[reportPrivateImportUsage]

    if info.numel():
        check_value((info != 0).any(), check)
