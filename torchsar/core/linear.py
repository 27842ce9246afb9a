"""Systems of linear equations, without waiting for the device to say whether they are solvable."""

from __future__ import annotations

import torch
from torch import Tensor

from torchsar.core.host import check_value, flat_index


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
    solution, info = torch.linalg.solve_ex(matrix, right)
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
    made, info = torch.linalg.inv_ex(matrix)
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


def _check(info: Tensor, what: str) -> None:
    """Raise LinAlgError if LAPACK or its like reports a failure."""

    def check(failed: float) -> None:
        if failed:
            trial = f" at index {flat_index(int((info != 0).int().argmax()), info.shape)}" if info.ndim else ""
            text = f"{what}{trial}, or not finite; add a small multiple of the identity"
            raise torch.linalg.LinAlgError(text)  # pyright: ignore[reportPrivateImportUsage]

    if info.numel():
        check_value((info != 0).any(), check)
