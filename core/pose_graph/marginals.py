"""Blocks of the inverse of sparse normal equations, from the conditionals that gtsam leaves.

The inverse's diagonal follows from them without the rest of the inverse (Takahashi, Fagan and Chin 1973),
from the root of the Bayes tree to its leaves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg.blas import dtrsm
from scipy.linalg.lapack import dpotri

from core.geometry import Array
from core.pose_graph.elimination import Border, Eliminated, Structure, eliminate
from core.pose_graph.residuals import IntArray


@dataclass(slots=True)
class _Clique:
    """The inverse's dense `block` of a clique, where each key begins in it, and children that still ask."""

    block: Array
    begin: dict[int, int]
    asked: int


def covariances(structure: Structure, frame: Array, pair: Array, border: Border) -> Array | None:
    """The (N, d, d) diagonal blocks of the inverse of the whole matrix, border included; None where it is not
    positive definite.
    """
    done = eliminate(structure, frame, pair, np.zeros(frame.shape[:2]), border)
    if done is None:
        return None
    sizes = np.append(np.full(len(structure), frame.shape[1]), len(border.matrix))
    return _diagonal_of_inverse(done, sizes)


def _diagonal_of_inverse(done: Eliminated, sizes: IntArray) -> Array:
    """The blocks of all frames, whose `sizes` (N + 1,) are equal; the last is the border's."""
    n, d = len(sizes) - 1, int(sizes[0])
    out, cliques, known = np.zeros((n, d, d)), dict[int, _Clique](), np.zeros(n + 1, bool)
    # what a key is conditioned on goes after it: from the last key back, parents come before children
    for key in done.order[::-1].tolist():
        if known[key]:
            continue
        clique = done.tree[key]
        conditional = clique.conditional()
        keys, pivots = conditional.keys(), conditional.R().shape[0]
        begin = dict(zip(keys, (np.cumsum(sizes[keys]) - sizes[keys]).tolist(), strict=True))
        block = _block(conditional, _above(clique, cliques, [k for k in keys if begin[k] >= pivots], sizes))
        if clique.nrChildren():
            cliques[keys[0]] = _Clique(block, begin, clique.nrChildren())
        for k in keys:
            at = begin[k]
            if at < pivots:
                known[k] = True
                if k < n:
                    out[k] = block[at : at + d, at : at + d]
    return out


def _above(clique: Any, cliques: dict[int, _Clique], stay: Sequence[int], sizes: IntArray) -> Array:
    """The inverse's block of the keys that `stay`, as the clique's parent has it."""
    if not stay:
        return np.zeros((0, 0))
    first = clique.parent().conditional().firstFrontalKey()
    parent = cliques[first]
    index = np.concatenate([np.arange(parent.begin[k], parent.begin[k] + sizes[k]) for k in stay])
    parent.asked -= 1
    if not parent.asked:
        del cliques[first]
    return np.asarray(parent.block[np.ix_(index, index)])


def _block(conditional: Any, rest: Array) -> Array:
    """The inverse's block of a clique from its conditional R·x + S·y = 0 and the block (s, s) of y."""
    R = np.asfortranarray(conditional.R())
    p, s = len(R), len(rest)
    own = dpotri(R)[0]
    own = np.triu(own) + np.triu(own, 1).T
    block = np.empty((p + s, p + s))
    if s:
        G = dtrsm(1.0, R, conditional.S())
        mixed = -G @ rest
        own = own - mixed @ G.T
        block[:p, p:], block[p:, :p], block[p:, p:] = mixed, mixed.T, rest
    block[:p, :p] = own
    return block
