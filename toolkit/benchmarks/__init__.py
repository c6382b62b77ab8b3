"""What is measured about the toolkit itself: the engine, the merge, trees, metrics, readers of files, and suites of runs."""
