"""Symmetric matrices of exchange areas, of which half is kept, in single precision."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["SymmetricMatrix"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

BLOCK = 64
"""Rows that are kept, and worked on, at once."""


class SymmetricMatrix:
    """A symmetric matrix (n, n) ``D S D``: S in blocks of rows from their diagonal on, D a diagonal of scales.

    Sums are formed in double precision, and both of a pair are one number: what is wrong with single precision
    (1e-7 of an entry) breaks neither reciprocity nor the balance of energy.

    Parameters
    ----------
    rows : int
        n.
    kept : (m,) float
        The blocks one after the other, block k of ``BLOCK`` rows and the columns from ``k * BLOCK`` on.
    """

    def __init__(self, rows: int, kept: NDArray[np.floating]) -> None:
        self.rows, self._kept = rows, kept
        self.scale = np.ones(rows)

    @classmethod
    def empty(cls, rows: int) -> SymmetricMatrix:
        """All zero, in single precision."""
        return cls(rows, np.zeros(int(_places(rows)[-1]), dtype=np.float32))

    @classmethod
    def of_dense(cls, matrix: FloatArray) -> SymmetricMatrix:
        """A symmetric (n, n) array, in its precision."""
        n = len(matrix)
        return cls(n, np.concatenate([matrix[first : first + BLOCK, first:].ravel() for first in range(0, n, BLOCK)]))

    def add(self, row: NDArray[np.int32], column: NDArray[np.int32], value: FloatArray) -> None:
        """Add values (k,) of distinct pairs to both of their places; of two parts of one row, to the one both ways."""
        _add_pairs(row, column, value, self.rows, self._kept, _places(self.rows))

    def _blocks(self) -> Iterator[tuple[int, int, NDArray[np.floating]]]:
        """First and last row of each block, and what is kept of it, without scales."""
        places = _places(self.rows)
        for k, first in enumerate(range(0, self.rows, BLOCK)):
            last = min(first + BLOCK, self.rows)
            yield first, last, self._kept[places[k] : places[k + 1]].reshape(last - first, self.rows - first)

    def __matmul__(self, other: FloatArray) -> FloatArray:
        """The product with (n,) or (n, k)."""
        scale = self.scale if other.ndim == 1 else self.scale[:, None]
        x, out = scale * other, np.zeros(other.shape)
        for first, last, kept in self._blocks():
            block = kept.astype(np.float64, copy=False)
            out[first:last] += block @ x[first:]
            out[last:] += block[:, last - first :].T @ x[first:last]
        return scale * out

    def diagonal(self) -> FloatArray:
        """(n,)."""
        parts = [kept.diagonal() for _, _, kept in self._blocks()]
        return self.scale**2 * np.concatenate(parts).astype(np.float64)

    def max(self) -> float:
        """Largest entry of S."""
        return float(self._kept.max())

    def scale_by(self, factors: FloatArray) -> float:
        """Multiply rows and columns by factors (n,); the largest change of an entry.

        The scales must have been 1.
        """
        self.scale = factors
        change = 0.0
        for first, last, kept in self._blocks():
            change = max(change, float(np.abs((np.outer(factors[first:last], factors[first:]) - 1.0) * kept).max()))
        return change

    def summed(self, start: IntArray) -> SymmetricMatrix:
        """Entries added up over groups of neighbouring rows and columns, group g from row ``start[g]`` on.

        The scales must be 1.
        """
        out = np.zeros((len(start) - 1, len(start) - 1))
        for first, last, kept in self._blocks():
            begin, columns = _edges(start, first, self.rows)
            block = np.add.reduceat(kept, columns, axis=1, dtype=np.float64)
            rows = _edges(start, first, last)[1]
            part = np.add.reduceat(block, rows, axis=0)
            out[begin : begin + len(rows), begin:] += part
            if last < self.rows:
                begin_after, after = _edges(start, last, self.rows)
                beyond = np.add.reduceat(kept[:, last - first :], after, axis=1, dtype=np.float64)
                out[begin_after:, begin : begin + len(rows)] += np.add.reduceat(beyond, rows, axis=0).T
        return SymmetricMatrix.of_dense(out)


def _places(rows: int) -> IntArray:
    """Where each block begins among what is kept, and the end."""
    first = np.arange(0, rows, BLOCK)
    sizes = np.minimum(BLOCK, rows - first) * (rows - first)
    return np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)


def _edges(start: IntArray, first: int, last: int) -> tuple[int, IntArray]:
    """First of the groups that rows ``first..last`` belong to, and where each begins among them."""
    begin = int(np.searchsorted(start, first, side="right")) - 1
    inside = start[begin + 1 : int(np.searchsorted(start, last, side="left"))]
    return begin, np.concatenate([[0], inside - first]).astype(np.int64)


@njit(nogil=True, cache=True)
def _add_pairs(row, column, value, rows, kept, places):
    """Add each pair to its place; within a block of the diagonal, where all is kept, to both."""
    for k in range(row.shape[0]):
        i, j = min(row[k], column[k]), max(row[k], column[k])
        block = i // BLOCK
        first = block * BLOCK
        width = rows - first
        kept[places[block] + (i - first) * width + j - first] += value[k]
        if j < first + BLOCK:
            kept[places[block] + (j - first) * width + i - first] += value[k]
