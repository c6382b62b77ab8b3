"""A run on paper: pictures and one self-contained page, for those without a viewer.

    stills      robots rendered off screen
    figures     tree, projections, heat map, curves; readable in black and white
    page        the HTML page with everything in it
"""
