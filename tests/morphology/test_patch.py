"""What F writes at an evolution parameter: every field of it changes the model, or is what the grasp's law asks."""

from dataclasses import fields, replace

import numpy as np

from toolkit.morphology.patch import Patch

ASKED = {"anchor", "freeze", "lock", "shape_activity", "start_target", "preshape", "rate"}
"""Written by nobody: the law of the grasp computes with them."""


def numbers(model):
    """Every array of a compiled model."""
    found = {name: getattr(model, name) for name in dir(model) if not name.startswith("_")}
    return {name: np.array(value) for name, value in found.items() if isinstance(value, np.ndarray)}


def other(value):
    """The field's values, each another one."""
    array = np.asarray(value)
    if array.dtype == bool:
        return ~array
    return np.where(array == 0, 1, 0) if array.dtype.kind == "i" else array * 1.01 + 1e-3


class Noted:
    """A patch that notes which of its fields are asked for."""

    def __init__(self, patch):
        self._patch, self.asked = patch, set()

    def __getattr__(self, name):
        self.asked.add(name)
        return getattr(self._patch, name)


def test_f_in_place_forgets_no_field(pair, monkeypatch):
    merged, alpha = pair.merged, np.full(pair.space.size, 0.4)
    model, data = merged.new()
    plain = merged.patch(alpha)
    merged.write(alpha, model, data)
    before, idle, absent = numbers(model), set(), set()
    for field in fields(Patch):
        value = getattr(plain, field.name)
        if np.size(value) == 0:
            absent.add(field.name)  # these robots have none
            continue
        changed = replace(plain, **{field.name: other(value)})
        monkeypatch.setattr(merged, "patch", lambda _, changed=changed: changed)
        merged.write(alpha, model, data)
        after = numbers(model)
        if all(np.array_equal(before[name], after[name], equal_nan=True) for name in before):
            idle.add(field.name)
    assert all(name.startswith(("coupling", "curve", "air")) for name in absent), f"these robots are too simple: {sorted(absent)}"
    assert idle == ASKED, f"{sorted(idle ^ ASKED)}: forgotten by F in place, or written and named here"


def test_the_grasps_law_asks_what_f_does_not_write(pair):
    merged, alpha = pair.merged, np.full(pair.space.size, 0.4)
    model, data = merged.new()
    patch = Noted(merged.write(alpha, model, data))
    merged.law.motors(alpha, patch, model, data)
    assert patch.asked >= ASKED, f"nobody asks for {sorted(ASKED - patch.asked)}"
