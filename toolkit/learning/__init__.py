"""Improving a policy: episodes in, a better Gaussian policy out. Knows no robot, task or simulator."""
