"""Binary trees over numbered terminals, as two integer arrays that compiled code edits in place.

Terminals are leaves 0 .. n-1; Steiner nodes are n .. 2n-3. One leaf, the source unless said otherwise, is the root: it has one
child and no parent. An edge is named by its lower node.

    parent  (2n-2,)    the node above, -1 for the root and for nodes that are not in the tree yet
    kids    (2n-2, 2)  the nodes below: two for a Steiner node, one and -1 for the root, -1 and -1 for another leaf
"""

import numpy as np
from numba import njit


@njit(cache=True)
def seed_tree(n: int, first: int | np.integer) -> tuple[np.ndarray, np.ndarray]:
    """The tree of two leaves: the root 0 and ``first``, with room for n leaves."""
    parent, kids = np.empty(2 * n - 2, np.int64), np.empty((2 * n - 2, 2), np.int64)
    for node in range(2 * n - 2):
        parent[node] = kids[node, 0] = kids[node, 1] = -1
    parent[first] = 0
    kids[0, 0] = first
    return parent, kids


@njit(cache=True)
def replace_kid(kids: np.ndarray, above: int, old: int, new: int) -> None:
    """Let ``new`` hang below ``above`` where ``old`` did."""
    if kids[above, 0] == old:
        kids[above, 0] = new
    else:
        kids[above, 1] = new


@njit(cache=True)
def graft(parent: np.ndarray, kids: np.ndarray, node: int, hub: int, edge: int) -> None:
    """Hang ``node`` onto ``edge``; the Steiner node ``hub`` joins them."""
    above = parent[edge]
    replace_kid(kids, above, edge, hub)
    parent[hub], parent[edge], parent[node] = above, hub, hub
    kids[hub, 0], kids[hub, 1] = edge, node


@njit(cache=True)
def prune(parent: np.ndarray, kids: np.ndarray, node: int) -> int:
    """Cut ``node`` off with the Steiner node above it; returns that node's other child, whose edge now bridges the place."""
    hub = parent[node]
    sibling = kids[hub, 1] if kids[hub, 0] == node else kids[hub, 0]
    above = parent[hub]
    replace_kid(kids, above, hub, sibling)
    parent[sibling] = above
    return sibling


@njit(cache=True)
def postorder(kids: np.ndarray, root: int | np.integer, order: np.ndarray) -> int:
    """Write the Steiner nodes below ``root`` into ``order``, children before parents; returns how many there are."""
    count, waiting = 0, 1
    stack = np.empty(order.size + 2, np.int64)
    stack[0] = kids[root, 0]
    while waiting > 0:
        waiting -= 1
        node = stack[waiting]
        if kids[node, 0] >= 0:
            order[count] = node
            count += 1
            stack[waiting], stack[waiting + 1] = kids[node, 0], kids[node, 1]
            waiting += 2
    for i in range(count // 2):
        order[i], order[count - 1 - i] = order[count - 1 - i], order[i]
    return count


def reroot(parent: np.ndarray, kids: np.ndarray, old: int, new: int) -> None:
    """Hang the tree from leaf ``new`` instead of leaf ``old``."""
    if old == new:
        return
    top = parent[new]
    below, node = new, top
    while node >= 0:
        above = parent[node]
        if node == old:
            kids[old, 0] = -1
        else:
            replace_kid(kids, node, below, above)
        parent[node] = below
        below, node = node, above
    kids[new, 0], parent[new] = top, -1


@njit(cache=True)
def clades(kids: np.ndarray, n: int, order: np.ndarray, count: int, mask: np.ndarray, found: np.ndarray) -> None:
    """The topology's name into ``found`` (n-2,): the sets of leaves below its Steiner nodes as bit masks, sorted.

    Args:
        n: leaves, at most 62.
        order, count: the Steiner nodes in postorder.
        mask: (2n-2,) int64 to work in.
    """
    for leaf in range(n):
        mask[leaf] = np.int64(1) << leaf
    for i in range(count):
        node = order[i]
        mask[node] = mask[kids[node, 0]] | mask[kids[node, 1]]
        j = i
        while j > 0 and found[j - 1] > mask[node]:
            found[j] = found[j - 1]
            j -= 1
        found[j] = mask[node]
