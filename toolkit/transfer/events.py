"""What happens on a path: a record per event, and the line of metrics.jsonl that tells it."""

from dataclasses import asdict, dataclass
from typing import Any, ClassVar

from toolkit.transfer.branch import Cost


@dataclass(frozen=True)
class Event:
    """Something that happened on a path.

    Attributes:
        name: of the event in metrics.jsonl.
    """

    name: ClassVar[str]


@dataclass(frozen=True)
class Measured(Event):
    """Success was measured on a robot.

    Attributes:
        success: share of the episodes that succeeded.
        checked: episodes played.
        reach: how far ahead the robot is, L2 [alpha].
        held: whether the policy has the success that was asked for.
        noise: share of the exploration's standard deviation that the policy bears.
    """

    success: float
    checked: int
    reach: float
    held: bool
    noise: float


@dataclass(frozen=True)
class Checked(Measured):
    """Of the mean action, on the robot that is trained for."""

    name = "check"


@dataclass(frozen=True)
class Looked(Measured):
    """Of the mean action, on a robot that nothing trains for yet."""

    name = "look"


@dataclass(frozen=True)
class CheckedWithNoise(Measured):
    """Of the policy under the noise of training."""

    name = "explore"


@dataclass(frozen=True)
class Updated(Event):
    """A learner's update.

    Attributes:
        learner: which.
        train_success: share of the update's episodes that succeeded.
        mean_return: their mean discounted return.
        episodes_per_s: played per second of wall time.
        play_s: wall time of playing them [s].
    """

    name = "update"
    learner: str
    train_success: float
    mean_return: float
    episodes_per_s: float
    play_s: float


@dataclass(frozen=True)
class WeightsUpdated(Updated):
    """By the natural policy gradient.

    Attributes:
        window: share of the segment from which the next update's robots are drawn.
        kl: mean KL divergence from the old policy to the new one [nats].
        learn_s: wall time of learning [s].
    """

    window: float
    kl: float
    learn_s: float


@dataclass(frozen=True)
class SearchUpdated(Updated):
    """By the search.

    Attributes:
        turn: what is searched for, "offset", "gain" or "response".
        learned: whether there was a success to learn from.
        width: mean deviation of the search, in declared ones.
    """

    turn: str
    learned: bool
    width: float


@dataclass(frozen=True)
class Steered(Event):
    """A direction was estimated from episodes around the robot.

    Attributes:
        mean_return: of these episodes, discounted.
        slope: length of the return's Jacobian over alpha.
        straight_share: cosine between the way taken and the straight one.
    """

    name = "steered"
    mean_return: float
    slope: float
    straight_share: float


@dataclass(frozen=True)
class Moved(Event):
    """The robot has evolved.

    Attributes:
        stride: length of the step, L2 [alpha].
        distance: what is left to the meta robot, L2 [alpha].
        trained: whether the policy was trained for that robot.
    """

    name = "moved"
    stride: float
    distance: float
    trained: bool


@dataclass(frozen=True)
class Split(Event):
    """A path sets out.

    Attributes:
        parent: the path that it leaves.
        targets: names of what it leads to, with spaces between.
        rival: the path that it is raced against, if it is.
    """

    name = "split"
    parent: str
    targets: str
    rival: str | None = None


@dataclass(frozen=True)
class Left(Event):
    """A target is taken up from another robot than its tree's.

    Attributes:
        origin: that robot's name.
        target: name.
        share: of the straight way on which the policy holds already.
        left: distance from there on [alpha].
    """

    name = "left"
    origin: str
    target: str
    share: float
    left: float


@dataclass(frozen=True)
class Kept(Event):
    """A target is left with the best policy of its phase, to which nothing brought more.

    Attributes:
        success: of that policy.
    """

    name = "kept"
    success: float


@dataclass(frozen=True)
class Spent(Event):
    """The path's budget of training episodes is used up.

    Attributes:
        reach: how far the path now leaps to its end untrained, L2 [alpha]; None: it ends where it is.
    """

    name = "budget"
    reach: float | None = None


@dataclass(frozen=True)
class Overtaken(Event):
    """A path is given up: another has reached its target.

    Attributes:
        by: that path.
    """

    name = "overtaken"
    by: str


@dataclass(frozen=True)
class Arrived(Event):
    """A path has ended.

    Attributes:
        target: name of what it has reached.
    """

    name = "arrived"
    target: str


@dataclass(frozen=True)
class Entry:
    """A line of metrics.jsonl.

    Attributes:
        event: what happened.
        path, stage: where; see Branch.
        cost: of the path so far.
        seconds: wall time of the run [s].
    """

    event: Event
    path: str
    stage: str
    cost: Cost
    seconds: float

    def to_json(self) -> dict[str, Any]:
        """As written: flat, without what is not said."""
        told = {key: value for key, value in asdict(self.event).items() if value is not None}
        place = {"event": self.event.name, "path": self.path, "stage": self.stage}
        return {**place, **told, **asdict(self.cost), "seconds": self.seconds}
