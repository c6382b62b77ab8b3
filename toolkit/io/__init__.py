"""The edge to the outside: files written whole, claimed and read in one way each, and names made harmless where they are shown."""
