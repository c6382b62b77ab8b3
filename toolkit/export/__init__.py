"""A bundle made: the unmodified robot measured, described and packed, and served over a socket."""
