"""A policy to be carried elsewhere: what its files say, how they are read and proven; needs neither torch nor robosuite."""
