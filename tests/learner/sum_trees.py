"""Checks the inside of a sum tree."""

import numpy as np

from learner.sum_tree import FANOUT, SumTree, _sum_row


def check_valid(tree: SumTree) -> None:
    """Checks on the host that every sum is exactly that of its children and every leaf is finite and not negative.

    Raises:
        ValueError: it is not so; names the first wrong leaf or node.
    """
    for nodes in np.asarray(tree.nodes).reshape(tree.num_groups, -1):
        _check_group(nodes, tree.starts, tree.num_leaves // tree.num_groups)


def _check_group(nodes: np.ndarray, starts: list[int], num_leaves: int) -> None:
    leaves, padding = np.split(nodes[starts[-2] :], [num_leaves])
    if not (good := np.isfinite(leaves) & (leaves >= 0)).all():
        wrong = int(np.argmin(good))
        raise ValueError(f"sum tree: leaf {wrong} is {leaves[wrong]}, want a finite number of at least 0")
    if padding.any():
        raise ValueError(f"sum tree: padding after leaf {num_leaves - 1} is {padding}, want zeros")
    for start, stop, children_stop in zip(starts, starts[1:], starts[2:], strict=False):
        sums = np.zeros(stop - start, np.float32)
        sums[: (children_stop - stop) // FANOUT] = _sum_row(nodes[stop:children_stop].reshape(-1, FANOUT))
        if (wrong := np.flatnonzero(nodes[start:stop] != sums)).size:
            node = int(wrong[0])
            raise ValueError(f"sum tree: node {start + node} is {nodes[start + node]}, its children are {sums[node]}")
