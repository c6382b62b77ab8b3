"""Recordings of hands in the format of DexYCB: read, placed at the table, and made up where there are none."""
