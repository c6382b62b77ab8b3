"""meta-evolve: transfer a dexterous hand's policy to commercial arms by continuous robot evolution.

Data flows one way: robots and grippers -> trees -> matching -> space -> F(alpha) -> evolution tree -> rollouts ->
natural policy gradient -> transfer -> run folder -> evaluation, recording, export. See docs/architecture.md.

Conventions: SI units, radians, quaternions w first, transforms named by both frames, alpha and theta as words.
"""

__version__ = "0.1.0"
