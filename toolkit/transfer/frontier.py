"""How far a transfer has come: the branches under way, the policies that arrived, what every path has cost; one checkpoint of all that."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from toolkit.errors import ToolkitError
from toolkit.learning.policy import GaussianPolicy, load_network, network_tensors
from toolkit.runs.generators import generator_from_state, generator_state
from toolkit.runs.run import Run
from toolkit.transfer.asking import Asking
from toolkit.transfer.branch import Branch, Cost, Ledger, path_numbers, stored_branch
from toolkit.transfer.sampling import Sampler

CHECKPOINT = "transfer"


class Frontier:
    """How far a transfer has come.

    Args:
        run: folder for the checkpoint.
        sampler: whose random numbers and times are kept, too.
        root: the first branch.
        asking: of a tree that asks; None: the tree does not.

    Attributes:
        pending: branches under way; the last is played.
        arrived: target -> its policy.
        ledgers: path -> what is known of it, whether it has ended or not.
    """

    def __init__(self, run: Run, sampler: Sampler, root: Branch, asking: Asking | None) -> None:
        self._run, self._sampler, self._asking = run, sampler, asking
        self._policy, self._value = root.policy, root.value
        self.pending = [root]
        self.arrived: dict[str, GaussianPolicy] = {}
        self.ledgers: dict[str, Ledger] = {root.path: root.ledger}

    def replace(self, branch: Branch, after: list[Branch]) -> None:
        """Where ``branch`` was are now those that it has become; the first of them is played first."""
        index = self.pending.index(branch)
        self.pending[index : index + 1] = reversed(after)

    def save(self) -> None:
        """Everything the run needs to go on, in one atomic file."""
        ledgers = self.ledgers | {branch.path: branch.ledger for branch in self.pending}
        self.ledgers = {path: ledgers[path] for path in sorted(ledgers, key=path_numbers)}
        tensors: dict[str, np.ndarray] = {}
        for branch in self.pending:
            tensors |= branch.tensors()
        for name, policy in self.arrived.items():
            tensors |= network_tensors(f"arrived.{name}", policy)
        asking = {}
        if self._asking is not None:
            tensors |= self._asking.tensors()
            asking = {"asking": self._asking.state()}
        state = {
            "pending": [branch.state() for branch in self.pending], "arrived": list(self.arrived),
            "ledgers": {path: asdict(ledger) for path, ledger in self.ledgers.items()},
            "rng": generator_state(self._sampler.rng), "seconds": self._sampler.seconds, "spent": self._sampler.spent, **asking,
        }  # fmt: skip
        self._run.save_checkpoint(CHECKPOINT, tensors, state)

    def restore(self) -> None:
        """Continue from the run's checkpoint, if it has one; metrics written after it are dropped.

        Raises:
            ToolkitError: the checkpoint is broken, or was made for networks or spaces of other dimensions.
        """
        if CHECKPOINT not in self._run.checkpoints():
            self._run.truncate_metrics(0)
            return
        tensors, state = self._run.load_checkpoint(CHECKPOINT)
        self.ledgers = {path: _ledger(saved) for path, saved in state["ledgers"].items()}
        size = self.pending[0].alpha.size
        self.pending, self.arrived = [], {}
        for saved in state["pending"]:
            found = tensors[f"{saved['path']}.alpha"].size
            if found != size:
                raise ToolkitError(
                    f"{self._run.path}: its checkpoint has {found} evolution dimensions, this space {size}; "
                    "the robots have changed since; start a new run"
                )
            self.pending.append(stored_branch(tensors, saved, self._policy, self._value, self.ledgers[saved["path"]]))
        for name in state["arrived"]:
            self.arrived[name] = self._policy.copy()
            load_network(tensors, f"arrived.{name}", self.arrived[name])
        if self._asking is not None:
            self._asking.restore(tensors, state["asking"], self._policy, self._value)
        self._sampler.rng = generator_from_state(state["rng"])
        self._sampler.earlier_seconds, self._sampler.spent = state["seconds"], state["spent"]
        self._run.truncate_metrics(sum(ledger.records for ledger in self.ledgers.values()))


def _ledger(saved: Mapping[str, Any]) -> Ledger:
    return Ledger(saved["route"], Cost(**saved["cost"]), saved["records"])
