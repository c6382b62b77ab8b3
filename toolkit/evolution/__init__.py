"""Where to go: the shortest tree from the current robot to all targets, and the next meta robot on it.

    tree         the records: terminals, nodes, edges, the tree
    points       points files
    geometry     distances, and which points are one
    topology     binary trees as integer arrays
    bounds       lengths that no tree undercuts
    parsimony    L1 length of a topology, local search        l1    the shortest L1 tree, with proof
    smith        L2 length of a topology                      l2    the shortest L2 tree
    median       the one meta robot of the geometric median
    solve        the choice of solver                         partition    Algorithm 2
    plot         a picture
"""

from toolkit.evolution.partition import next_meta_robot
from toolkit.evolution.plot import plot_tree
from toolkit.evolution.points import load_points
from toolkit.evolution.solve import evolution_tree, tree_from_points
from toolkit.evolution.tree import (
    ARRIVED,
    KINDS,
    MAX_TERMINALS,
    METRICS,
    Edge,
    EvolutionTree,
    Kind,
    MetaStep,
    Metric,
    Node,
    Terminal,
)

__all__ = [
    "ARRIVED", "KINDS", "MAX_TERMINALS", "METRICS", "Edge", "EvolutionTree", "Kind", "MetaStep", "Metric", "Node", "Terminal",
    "evolution_tree", "load_points", "next_meta_robot", "plot_tree", "tree_from_points",
]
