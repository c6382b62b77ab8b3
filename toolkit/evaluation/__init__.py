"""Success where it is claimed: on F(beta), on the unmodified robosuite robot, along a tree, and under the conditions of a laboratory."""
