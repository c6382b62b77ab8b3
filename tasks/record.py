"""Records: what a policy observes or does, entry by entry; the one owner of an entry's name, place, unit, scale and meaning."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

Numbers = float | tuple[float, ...]
"""One for all of an entry's numbers, or one each."""


@dataclass(frozen=True)
class Entry:
    """An entry of a record.

    Attributes:
        size: how many numbers it holds.
        unit: of each.  frame: whose axes; "" where there are none.  meaning: in a phrase.
        scale: smallest scale by which a policy normalises it [unit], so that a number that hardly moves on the source is never blown up.
        explored: standard deviation with which a search begins to explore its offset (of an observation), or its response to what the
            policy meets (of an action) [unit]; 0: never.
        gain: standard deviation with which a search begins to explore the logarithm of its gain, one for all its numbers: how large it
            is seen (of an observation), or done (of an action); 0: never.
        noise: standard deviation of the noise on copied observations from which a clone learns [unit].
        jump: change per policy step that is never called a jump [unit].
    """

    size: int = 1
    unit: str = "1"
    frame: str = ""
    meaning: str = ""
    scale: Numbers = 1.0
    explored: Numbers = 0.0
    gain: float = 0.0
    noise: Numbers = 0.0
    jump: Numbers = 0.0


class Record(Mapping[str, int]):
    """Named entries in order; as a mapping, entry -> size.

    Args:
        entries: the entries by name, in order.

    Attributes:
        entries: the same.
        size: how many numbers they hold together.
        names: one per number: "name", or "name[k]" where an entry holds several.
    """

    def __init__(self, entries: Mapping[str, Entry]) -> None:
        self.entries = dict(entries)
        self.size = sum(entry.size for entry in entries.values())
        self.names = [name if entry.size == 1 else f"{name}[{k}]" for name, entry in self.entries.items() for k in range(entry.size)]
        ends = np.cumsum([entry.size for entry in self.entries.values()])
        self._slices = {name: slice(int(end) - entry.size, int(end)) for (name, entry), end in zip(self.entries.items(), ends, strict=True)}

    def __getitem__(self, name: str) -> int:
        return self.entries[name].size

    def __iter__(self) -> Iterator[str]:
        return iter(self.entries)

    def __len__(self) -> int:
        return len(self.entries)

    def slice(self, name: str) -> slice:
        """Where an entry's numbers stand."""
        return self._slices[name]

    def numbers(self, attribute: str) -> np.ndarray:
        """An attribute of the entries ("scale", "explored", "noise", "jump"), number by number (n,)."""
        values = [(np.asarray(getattr(entry, attribute), float), entry.size) for entry in self.entries.values()]
        return np.concatenate([np.broadcast_to(value, size) for value, size in values])
