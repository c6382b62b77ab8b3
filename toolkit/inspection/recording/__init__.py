"""Recordings for the Rerun viewer; the only package that imports rerun.

    programs    where the viewer is
    stream      one .rrd file, or a viewer; the timelines "film" and "iteration"
    viewer      opening, serving, taking stills, reading back
    scene       robots in 3-D, every mesh once
    evolution, learning, rollouts    one page each
    layout      the pages as tabs
    recorder    a run as a recording, record by record
    recordings  whole recordings: of a run, of a morph, of two robots side by side
    excerpt     one page at one moment, as a small recording of its own
"""

from importlib.util import find_spec

from toolkit.errors import ToolkitError

if find_spec("rerun") is None:
    raise ToolkitError("the Rerun viewer is not installed; pip install 'meta-evolve[viewer]'")
