"""A run made visible: what robots and trees look like, episodes played again, and the recording and report made of them."""
