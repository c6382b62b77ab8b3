"""Every quantity of the evolution space has its meaning."""

from toolkit.morphology.quantities import QUANTITIES


def test_every_quantity_says_what_it_is(pair):
    assert list(QUANTITIES) == list(pair.space.fields), set(QUANTITIES) ^ set(pair.space.fields)
