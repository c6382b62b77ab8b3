"""What each phase of a transfer leaves in the run folder, so that it can be watched later: `phases/<path>-<number>-<stage>`.

A phase is the way from one robot to the next: where it began and ended, and the episodes worth seeing. An episode is kept
as what determines it (policy, robot, seed, noise), a few kilobytes; playing it again gives the same episode, bit by bit.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
from safetensors.numpy import save as safetensors_bytes

from toolkit.errors import ToolkitError
from toolkit.io.atomic import write_atomically
from toolkit.io.jsonfiles import require
from toolkit.io.tensors import read_tensors
from toolkit.learning.episode import Episode
from toolkit.learning.policy import GaussianPolicy

ROLES = ("first", "last", "best", "worst", "failure")
"""Why an episode is kept. "best" and "worst" by `score`, "failure" is the first one that did not succeed."""
FOLDER = "phases"
_STATE = {
    "path": str, "number": int, "stage": str, "targets": [str],
    "takes": [{"seed": int, "noise": bool, "success": bool, "diverged": bool, "steps": int, "update": int,
               "policy": int, "roles": [str]}],
}


@dataclass
class KeptEpisode:
    """An episode worth seeing, as what determines it; "take" in the files, which every run folder has.

    Attributes:
        seed: of the start and of the noise.  noise: whether the policy explored (training) or not (checking).
        success, diverged: how it ended.  steps: policy steps.  score: see `score`.
        update: of the phase, before which it was played.
        policy: index into the phase's policies.  alpha: (D,) the robot.
        roles: why it is kept.
    """

    seed: int
    noise: bool
    success: bool
    diverged: bool
    steps: int
    score: float
    update: int
    policy: int
    alpha: np.ndarray
    roles: list[str] = field(default_factory=list)


@dataclass
class Phase:
    """One phase of one path.

    Attributes:
        path: "path 1", ...  number: from 0 on each path.  stage: "evolve" or "settle".
        targets: that the path leads to.
        start: (D,) where it began.  end: (D,) where it ended, None while it goes on.
        policies: networks of the episodes: "parameters", "shift", "scale".
        episodes: those worth seeing, in the order in which they were played.
    """

    path: str
    number: int
    stage: str
    targets: list[str]
    start: np.ndarray
    end: np.ndarray | None = None
    policies: list[dict[str, np.ndarray]] = field(default_factory=list)
    episodes: list[KeptEpisode] = field(default_factory=list)

    @property
    def name(self) -> str:
        """File name without suffix."""
        return f"{self.path.replace(' ', '-')}-{self.number:03d}-{self.stage}"

    def episode(self, role: str) -> KeptEpisode | None:
        """The episode kept for a role."""
        return next((kept for kept in self.episodes if role in kept.roles), None)

    def save(self, run: Path) -> None:
        """Write the phase into a run folder, whole or not at all."""
        tensors = {"start": self.start} | ({} if self.end is None else {"end": self.end})
        for index, policy in enumerate(self.policies):
            tensors |= {f"policy.{index}.{key}": value for key, value in policy.items()}
        for index, kept in enumerate(self.episodes):
            tensors[f"take.{index}.alpha"] = kept.alpha
        state = {key: getattr(self, key) for key in ("path", "number", "stage", "targets")}
        state["takes"] = [{k: v for k, v in asdict(kept).items() if k != "alpha"} for kept in self.episodes]
        folder = run / FOLDER
        try:
            folder.mkdir(exist_ok=True)
            arrays = {key: np.array(value, order="C") for key, value in tensors.items()}
            write_atomically(folder / f"{self.name}.safetensors", safetensors_bytes(arrays, metadata={"state": json.dumps(state)}))
        except OSError as error:
            raise ToolkitError(f"{folder} cannot be written ({error.strerror}); free space or permissions there") from None

    def policy_of(self, kept: KeptEpisode, model: GaussianPolicy) -> GaussianPolicy:
        """The policy that played an episode; ``model`` has the same networks and is left as it is.

        Raises:
            ToolkitError: its networks are of another size.
        """
        policy = model.copy()
        stored = self.policies[kept.policy]
        policy.set_parameters(stored["parameters"])
        policy.set_normalisation(stored["shift"], stored["scale"])
        return policy


def load_phase(file: Path) -> Phase:
    """A phase from its file.

    Raises:
        ToolkitError: the file is truncated, or not ours.
    """
    refuse = lambda why: ToolkitError(f"{file} is truncated or not a phase of this toolkit ({why}); delete it")  # noqa: E731
    try:
        state, tensors = read_tensors(file, "phase", "state", "delete it")
        require(state, _STATE, str(file), "delete it")
        episodes = [KeptEpisode(**kept, alpha=tensors[f"take.{index}.alpha"]) for index, kept in enumerate(state.pop("takes"))]
        used = sorted({kept.policy for kept in episodes})
        if any(isinstance(kept.score, bool) or not isinstance(kept.score, int | float) for kept in episodes):  # -inf is a score
            raise refuse("a score is no number")
        if used != list(range(len(used))) or any(set(kept.roles) - set(ROLES) or not kept.roles for kept in episodes):
            raise refuse("its episodes name policies or roles that it does not have")
        keys = ("parameters", "shift", "scale")
        policies = [{key: tensors[f"policy.{index}.{key}"] for key in keys} for index in used]
        phase = Phase(**state, start=tensors["start"], end=tensors.get("end"), policies=policies, episodes=episodes)
    except (KeyError, TypeError) as error:
        raise refuse(error) from None
    except ToolkitError as error:
        raise error if "or not a phase" in str(error) else refuse(error) from None
    shapes = {array.shape for array in (phase.start, *([] if phase.end is None else [phase.end]), *(kept.alpha for kept in episodes))}
    if phase.name != file.stem or len(shapes) > 1 or phase.start.ndim != 1:
        raise refuse("it is another phase's, or its robots are of different sizes")
    return phase


def load_phases(run: Path, tell: Callable[[str], None] = lambda why: None) -> dict[str, Phase]:
    """Name -> phase, of all phases of a run folder that can be read; ``tell`` is called with a sentence for each other one."""
    found = {}
    for file in sorted((run / FOLDER).glob("[!.]*.safetensors")):
        try:
            found[file.stem] = load_phase(file)
        except ToolkitError as error:
            tell(str(error))
    return found


def landmarks(scenes: Sequence[tuple[Phase, KeptEpisode]]) -> list[tuple[Phase, KeptEpisode]]:
    """Of all episodes that are kept, in order: of every path the first, the first failure, the best, the worst and the last."""
    found = []
    for path in dict.fromkeys(phase.path for phase, _ in scenes):
        own = {role: [scene for scene in scenes if scene[0].path == path and role in scene[1].roles] for role in ROLES}
        chosen = [own["first"][:1], own["failure"][:1], own["last"][-1:]]
        chosen += [sorted(own["best"], key=lambda scene: -scene[1].score)[:1], sorted(own["worst"], key=lambda scene: scene[1].score)[:1]]
        picked = {id(kept) for some in chosen for _, kept in some}
        found += [scene for scene in scenes if id(scene[1]) in picked]
    return found


def score(episode: Episode, miss: Callable[[np.ndarray], float]) -> float:
    """How good an episode was: success 1 to 2, the sooner the better; failure by how near success it ended, see Task.miss.

    A diverged simulation scores -inf.
    """
    if episode.diverged:
        return -np.inf
    if episode.success:
        return 1.0 + 1.0 / (1.0 + episode.steps)
    return -miss(episode.last_observation)


class PhaseRecorder:
    """Picks the episodes worth seeing while a transfer runs; what it has seen is on disk before the checkpoint is.

    Seeing the same batch again, as a resumed run does, changes nothing.

    Args:
        run: the run folder.
        miss: of the task, see Task.miss.
        phases: how many phases each path has ended; for a resumed run.
    """

    def __init__(self, run: Path, miss: Callable[[np.ndarray], float], phases: dict[str, int] | None = None) -> None:
        self.run, self._miss = run, miss
        self.ended = dict(phases or {})
        self._going: dict[str, Phase] = {}

    def record(
        self, path: str, stage: str, targets: Sequence[str], start: np.ndarray, policies: Sequence[GaussianPolicy],
        episodes: Sequence[Episode], noise: bool, update: int,
    ) -> None:
        """Judge a batch of episodes.

        Args:
            path, stage, targets, start: of the branch that plays; start (D,) is where it stands.
            policies: that played, one per episode, as they were then.
            episodes: in the order in which they were played.
            noise: whether the policy explored by noise on its actions.
            update: of the phase.
        """
        phase = self.phase(path, stage, targets, start)
        for policy, episode in zip(policies, episodes, strict=True):
            self._judge(phase, policy, episode, noise, update)
        phase.save(self.run)

    def phase(self, path: str, stage: str, targets: Sequence[str], start: np.ndarray) -> Phase:
        """The phase that a path is in; begun, or continued from its file, if need be."""
        fresh = Phase(path, self.ended.get(path, 0), stage, list(targets), np.array(start))
        if self._going.get(path) is None or self._going[path].name != fresh.name:
            file = self.run / FOLDER / f"{fresh.name}.safetensors"
            self._going[path] = load_phase(file) if file.exists() else fresh
        return self._going[path]

    def end(self, path: str, stage: str, targets: Sequence[str], start: np.ndarray, end: np.ndarray) -> Phase:
        """A phase has ended at ``end`` (D,); the next one counts on."""
        phase = self.phase(path, stage, targets, start)
        phase.end = np.array(end)
        phase.save(self.run)
        self.ended[path] = phase.number + 1
        return phase

    def _judge(self, phase: Phase, policy: GaussianPolicy, episode: Episode, noise: bool, update: int) -> None:
        value = score(episode, self._miss)
        same = next((kept for kept in phase.episodes if self._is(phase, kept, policy, episode, noise, update)), None)
        best, worst = phase.episode("best"), phase.episode("worst")
        roles = ["last"]
        if same is None:
            roles += ["first"] if phase.episode("first") is None else []
            roles += ["failure"] if not episode.success and phase.episode("failure") is None else []
            roles += ["best"] if best is None or value > best.score else []
            roles += ["worst"] if worst is None or value < worst.score else []
        for kept in phase.episodes:
            kept.roles = [role for role in kept.roles if role not in roles]
        if same is not None:
            same.roles.append("last")
        else:
            index = self._policy(phase, policy)
            phase.episodes.append(
                KeptEpisode(episode.seed, noise, episode.success, episode.diverged, episode.steps, value, update, index,
                            np.array(episode.alpha), sorted(roles, key=ROLES.index))
            )
        self._drop_unused(phase)

    @staticmethod
    def _is(phase: Phase, kept: KeptEpisode, policy: GaussianPolicy, episode: Episode, noise: bool, update: int) -> bool:
        """Whether what is kept is this episode; a mirrored pair differs in its policies alone."""
        if (kept.seed, kept.noise, kept.update) != (episode.seed, noise, update) or not np.array_equal(kept.alpha, episode.alpha):
            return False
        played = phase.policies[kept.policy]
        return np.array_equal(played["parameters"], policy.parameters) and np.array_equal(played["shift"], policy.layers().shift)

    @staticmethod
    def _policy(phase: Phase, policy: GaussianPolicy) -> int:
        layers = policy.layers()
        wanted = {"parameters": policy.parameters, "shift": np.array(layers.shift), "scale": np.array(layers.scale)}
        for index, known in enumerate(phase.policies):
            if all(np.array_equal(known[key], wanted[key]) for key in wanted):
                return index
        phase.policies.append(wanted)
        return len(phase.policies) - 1

    @staticmethod
    def _drop_unused(phase: Phase) -> None:
        phase.episodes = [kept for kept in phase.episodes if kept.roles]
        used = sorted({kept.policy for kept in phase.episodes})
        phase.policies = [phase.policies[index] for index in used]
        for kept in phase.episodes:
            kept.policy = used.index(kept.policy)
