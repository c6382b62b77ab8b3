"""bench: the commands that measure the toolkit itself.

A benchmark is a function with @bench.command(name=...); app.py registers `bench` as `meta-evolve bench` once it has one.
"""

import tyro

bench = tyro.extras.SubcommandApp()
