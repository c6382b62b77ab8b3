"""The source expert: behaviour cloning of scripted demonstrations, then natural policy gradient under the sparse reward."""

import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from tasks.pick import ACTION, OBSERVATION, OBSERVATION_SCALE
from toolkit.demonstrations import PickScript, pick_script
from toolkit.errors import ToolkitError
from toolkit.learning.cloning import CloningConfig, clone
from toolkit.learning.npg import NpgConfig, npg_step
from toolkit.learning.policy import GaussianPolicy, ValueFunction
from toolkit.morphology.build import MergedRobot
from toolkit.simulation.rollout import RolloutEngine

DEMONSTRATION_SEEDS = 3 * 10**6
EXPERT_SEEDS = 4 * 10**6
_NOISE = {
    "finger": 0.3, "closing_progress": 0.1, "grasp_position": 0.03, "grasp_rotation": 0.1, "object_from_grasp": 0.01,
    "object_rotation": 0.2, "goal_from_object": 0.03,
}  # fmt: skip
OBSERVATION_NOISE = np.concatenate([np.full(size, _NOISE[name.split("/")[0]]) for name, size in OBSERVATION.items()])
"""Standard deviation (n_obs,) of the noise on copied observations, in each entry's own unit."""


@dataclass(frozen=True)
class ExpertConfig:
    """How the expert is trained."""

    demonstrations: int = 160
    """Scripted episodes; failed ones are dropped and counted."""
    noise: float = 0.12
    """Standard deviation of the noise that perturbs the demonstrated motion (the label stays the script's action), so
    that the clone learns to come back (Laskey et al. 2017, DART)."""
    copies: int = 4
    """Copies of the demonstrations with noisy observations, labelled by the script anew: the clone then knows what to do
    beside the demonstrated way, and judges a grasp by object and progress rather than by one hand's exact posture."""
    demonstrated_tolerance: float = 0.01
    """Distance [m] from the goal that demonstrations reach: tighter than the task, so that no clone stops short of it."""
    updates: int = 6
    """Natural-gradient updates after cloning."""
    seed: int = 0
    """Of everything random."""
    cloning: CloningConfig = field(default_factory=lambda: CloningConfig(epochs=40, init_log_std=-2.5))
    """Behaviour cloning."""
    npg: NpgConfig = field(default_factory=lambda: NpgConfig(step_size=0.005, batch_size=24))
    """The learner; larger steps than in transfer, as nothing is lost if the clone changes."""


def entry_names(record: dict[str, int]) -> list[str]:
    """One name per number of a record: "name" or "name[k]"."""
    return [name if size == 1 else f"{name}[{k}]" for name, size in record.items() for k in range(size)]


def new_learner(seed: int) -> tuple[GaussianPolicy, ValueFunction]:
    """A fresh policy and value function for the pick's records."""
    rng = np.random.default_rng((seed, 7))
    policy = GaussianPolicy(entry_names(OBSERVATION), entry_names(ACTION), rng)
    return policy, ValueFunction(entry_names(OBSERVATION), rng)


class NoisyScript:
    """A script whose motion is perturbed; remembers what the script itself wanted at each observation."""

    def __init__(self, script: PickScript, noise: float) -> None:
        self.script, self.noise = script, noise

    def __call__(self, observation: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """The script's action with noise on the six OSC deltas and, weaker, on the fingers."""
        action = self.script(observation)
        action[:6] += self.noise * rng.standard_normal(6)
        action[6:] += 0.3 * self.noise * rng.standard_normal(action.size - 6)
        return action


def _with_noise(
    observations: np.ndarray, script: PickScript, copies: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """The data (N, n_obs) with noisy copies, and what the script does at each (.., n_act)."""
    seen = np.tile(observations, (copies + 1, 1))
    seen[len(observations) :] += OBSERVATION_NOISE * rng.standard_normal((copies * len(observations), seen.shape[1]))
    return seen, np.array([script(observation) for observation in seen])


def train_expert(
    engine: RolloutEngine,
    source: str,
    config: ExpertConfig,
    report: Callable[[dict[str, Any]], None] = lambda record: None,
) -> tuple[GaussianPolicy, ValueFunction, dict[str, Any]]:
    """Demonstrate, clone, improve on F(beta_0).

    Returns:
        policy, value function, and statistics.

    Raises:
        ToolkitError: no demonstration succeeds.
    """
    rng = np.random.default_rng(config.seed)
    beta = engine.merged.space.beta(source)
    script = pick_script(engine.merged.task.object)
    seeds = list(range(DEMONSTRATION_SEEDS, DEMONSTRATION_SEEDS + config.demonstrations))
    strict = replace(engine.merged.task, goal_tolerance=config.demonstrated_tolerance)
    teacher = RolloutEngine(MergedRobot(engine.merged.space, strict), engine.threads)
    played = teacher.play(NoisyScript(script, config.noise), [beta] * len(seeds), seeds)
    teacher.close()
    kept = [episode for episode in played if episode.success]
    report({"event": "demonstrations", "played": len(played), "kept": len(kept)})
    if not kept:
        raise ToolkitError(f"none of {len(played)} scripted demonstrations succeeds on {source}; check its grasp posture")
    policy, value = new_learner(config.seed)
    observations = np.concatenate([episode.observations for episode in kept])
    seen, labels = _with_noise(observations, script, config.copies, rng)
    losses = clone(policy, seen, labels, config.cloning, rng, scale_floor=OBSERVATION_SCALE,
                   progress=lambda epoch, loss: report({"event": "cloning", "epoch": epoch, "loss": loss}))  # fmt: skip
    for update in range(config.updates):
        size = config.npg.batch_size
        first = EXPERT_SEEDS + update * size
        batch = engine.play(policy.act, [beta] * size, list(range(first, first + size)))
        statistics = npg_step(policy, value, batch, config.npg, rng)
        success = float(np.mean([episode.success for episode in batch]))
        report({"event": "update", "update": update, "success": success, **statistics})
    return policy, value, {"demonstrations_kept": len(kept), "demonstrations": len(played), "cloning_loss": losses[-1]}


SHIPPED = Path(__file__).parent / "experts"
"""Folder of the experts that come with the package."""


def expert_files(source: str, task: str) -> tuple[Path, Path]:
    """Files of the shipped expert's policy and value function."""
    return SHIPPED / f"{source}-{task}.policy.safetensors", SHIPPED / f"{source}-{task}.value.safetensors"


def save_expert(policy: GaussianPolicy, value: ValueFunction, folder: Path, name: str, card: dict[str, Any]) -> None:
    """Write policy, value function and a card that says how they came about."""
    folder.mkdir(parents=True, exist_ok=True)
    policy.save(folder / f"{name}.policy.safetensors")
    value.save(folder / f"{name}.value.safetensors")
    (folder / f"{name}.json").write_text(json.dumps(card, indent=1) + "\n")


def load_expert(source: str, task: str) -> tuple[GaussianPolicy, ValueFunction]:
    """The shipped expert of a source robot and a task.

    Raises:
        ToolkitError: none is shipped for the pair; the sentence gives the command that trains one.
    """
    policy_file, value_file = expert_files(source, task)
    if not policy_file.is_file():
        known = sorted(file.name.removesuffix(".policy.safetensors") for file in SHIPPED.glob("*.policy.safetensors"))
        raise ToolkitError(
            f"no expert is shipped for source {source!r} and task {task!r}; there are: {', '.join(known) or 'none'}; "
            f"train one with: meta-evolve expert --source {source} --task {task}"
        )
    policy = GaussianPolicy.load(policy_file, entry_names(OBSERVATION), entry_names(ACTION))
    return policy, ValueFunction.load(value_file, entry_names(OBSERVATION))
