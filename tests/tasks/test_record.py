"""A record: names, places and what is declared for its entries, number by number."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tasks import MODEL_TASKS, TASKS
from tasks.record import Entry, Record


def test_a_record_by_hand():
    record = Record({"a": Entry(scale=2.0), "b": Entry(2, "m", scale=(3.0, 4.0), explored=0.5)})
    assert record.names == ["a", "b[0]", "b[1]"] and record.size == 3 and dict(record) == {"a": 1, "b": 2}
    assert record.slice("b") == slice(1, 3)
    np.testing.assert_array_equal(record.numbers("scale"), [2, 3, 4])
    np.testing.assert_array_equal(record.numbers("explored"), [0, 0.5, 0.5])


@given(sizes=st.lists(st.integers(1, 5), min_size=1, max_size=8))
def test_entries_follow_one_another(sizes):
    record = Record({f"e{k}": Entry(size) for k, size in enumerate(sizes)})
    places = np.concatenate([np.arange(record.size)[record.slice(name)] for name in record])
    np.testing.assert_array_equal(places, np.arange(sum(sizes)))
    assert len(record.names) == len(set(record.names)) == record.size


@pytest.mark.parametrize("task", [*TASKS.values(), *MODEL_TASKS.values()], ids=[*TASKS, *MODEL_TASKS])
def test_every_entry_of_every_task_says_what_it_is(task):
    assert (task.observation.numbers("scale") > 0).all() and (task.observation.numbers("explored") >= 0).all()
    for record in (task.observation, task.action):
        assert all(entry.unit and entry.meaning for entry in record.entries.values())
