"""Algorithm 1: a policy taken along the tree, robot by robot, and the run around it."""
