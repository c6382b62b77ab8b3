"""How far a transfer has come: the branches under way, the policies that arrived, what every path has cost.

Paths do not depend on one another, so that each is kept as it stood when its last turn ended; the checkpoint is the collection of these.
A run that is killed while several are under way loses of each only the turn that it was in.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from threading import Lock
from typing import Any

import numpy as np

from toolkit.errors import ToolkitError
from toolkit.io.jsonfiles import json_value
from toolkit.learning.policy import GaussianPolicy, load_network, network_tensors
from toolkit.runs.run import Run
from toolkit.transfer.asking import Asking
from toolkit.transfer.branch import Branch, Cost, Ledger, path_numbers, stored_branch
from toolkit.transfer.sampling import Sampler

CHECKPOINT = "transfer"


class Frontier:
    """How far a transfer has come.

    Args:
        run: folder for the checkpoint.
        sampler: whose clock is kept, too.
        root: the first branch.
        asking: of a tree that asks; None: the tree does not.

    Attributes:
        pending: branches under way; the last is played first.
        arrived: target -> its policy.
        wall_s: wall time at the last checkpoint [s].
    """

    def __init__(self, run: Run, sampler: Sampler, root: Branch, asking: Asking | None) -> None:
        self._run, self._sampler, self._asking = run, sampler, asking
        self._policy, self._value = root.policy, root.value
        self._ledgers = {root.path: root.ledger}
        self._kept: dict[str, tuple[dict[str, np.ndarray], dict[str, Any]]] = {}
        self._keeping = Lock()
        self.pending = [root]
        self.arrived: dict[str, GaussianPolicy] = {}
        self.wall_s = 0.0

    @property
    def ledgers(self) -> dict[str, Ledger]:
        """Path -> what is known of it, whether it has ended or not; each before those into which it splits."""
        return {path: self._ledgers[path] for path in sorted(self._ledgers, key=path_numbers)}

    @property
    def spent(self) -> dict[str, float]:
        """Wall time [s] of the transfer, and of its paths' playing and learning: more than the wall's where they went side by side."""
        ledgers = self._ledgers.values()
        return {"play_s": sum(ledger.play_s for ledger in ledgers), "learn_s": sum(ledger.learn_s for ledger in ledgers),
                "wall_s": self.wall_s}

    def turn(self) -> Branch:
        """Whose turn it is: depth first. But for a tree that asks any order comes to the same."""
        return self.pending[-1]

    def replace(self, branch: Branch, after: Sequence[Branch]) -> None:
        """The turn of ``branch`` has ended: where it was are now those that it has become. Everything is on disk when this returns."""
        with self._keeping:
            index = self.pending.index(branch)
            self.pending[index : index + 1] = reversed(after)
            self._ledgers |= {other.path: other.ledger for other in self.pending}
            # A tree that asks may have looked on behalf of any path, begun others, and given some up.
            changed = [branch.path, *(other.path for other in after)] if self._asking is None else list(self._ledgers)
            self._keep(changed)
            self._save()

    def arrive(self, target: str, policy: GaussianPolicy) -> None:
        """``policy`` is the answer for that target."""
        with self._keeping:
            self.arrived[target] = policy

    def _keep(self, paths: Sequence[str]) -> None:
        """Remember these paths as they are now, by value: the others may be in the middle of a turn."""
        going = {branch.path: branch for branch in self.pending}
        for path in paths:
            branch = going.get(path)
            tensors = {} if branch is None else {key: np.array(array) for key, array in branch.tensors().items()}
            state = {"ledger": asdict(self._ledgers[path]), "branch": None if branch is None else json_value(branch.state())}
            self._kept[path] = tensors, state

    def _save(self) -> None:
        self.wall_s = self._sampler.seconds
        tensors = {key: array for arrays, _ in self._kept.values() for key, array in arrays.items()}
        for name, policy in self.arrived.items():
            tensors |= network_tensors(f"arrived.{name}", policy)
        state = {
            "pending": [branch.path for branch in self.pending], "arrived": list(self.arrived),
            "paths": {path: state for path, (_, state) in self._kept.items()}, "seconds": self.wall_s,
        }
        if self._asking is not None:
            tensors |= self._asking.tensors()
            state["asking"] = self._asking.state()
        self._run.save_checkpoint(CHECKPOINT, tensors, state)

    def restore(self) -> None:
        """Continue from the run's checkpoint, if it has one; metrics written after it are dropped, path by path.

        Raises:
            ToolkitError: the checkpoint is broken, or was made for networks or spaces of other dimensions.
        """
        if CHECKPOINT not in self._run.checkpoints():
            self._run.truncate_metrics(0)
            return
        tensors, state = self._run.load_checkpoint(CHECKPOINT)
        paths, size = state["paths"], self.pending[0].alpha.size
        self._ledgers = {path: _stored_ledger(saved["ledger"]) for path, saved in paths.items()}
        self.pending, self.arrived = [], {}
        for path in state["pending"]:
            found = tensors[f"{path}.alpha"].size
            if found != size:
                raise ToolkitError(
                    f"{self._run.path}: its checkpoint has {found} evolution dimensions, this space {size}; "
                    "the robots have changed since; start a new run"
                )
            self.pending.append(stored_branch(tensors, paths[path]["branch"], self._policy, self._value, self._ledgers[path]))
        for name in state["arrived"]:
            self.arrived[name] = self._policy.copy()
            load_network(tensors, f"arrived.{name}", self.arrived[name])
        if self._asking is not None:
            self._asking.restore(tensors, state["asking"], self._policy, self._value)
        self._keep(list(self._ledgers))
        self._sampler.earlier_seconds = self.wall_s = state["seconds"]
        self._run.truncate_metrics_by("path", {path: ledger.records for path, ledger in self._ledgers.items()})


def _stored_ledger(saved: Mapping[str, Any]) -> Ledger:
    return Ledger(**{**saved, "cost": Cost(**saved["cost"])})
