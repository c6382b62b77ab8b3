"""The twin: the unmodified robosuite robot in its task, served over a socket like an arm.

By the clock, its physics follows real time in steps of robosuite's controller; in lockstep it advances one policy period
per command, and waits. Under `osc` commands robosuite's own controller moves it. Under `pose` and `joint` commands it is
a position-controlled arm: a stiff servo follows the waypoints, as an industrial controller does.
"""

import hmac
import select
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, cast

import mujoco
import numpy as np

from robots.robot import Robot
from tasks.pick import PickTask
from toolkit.deploy import wire
from toolkit.deploy.arm import FORMS, Command
from toolkit.deploy.kinematics import matrix_of, vector_of
from toolkit.deploy.runtime import Pace
from toolkit.errors import ToolkitError
from toolkit.morphology.native_scene import NativeScene, model_sha256
from toolkit.simulation.native import NativeRobot

SERVO_KP = 1600.0
"""Stiffness [1/s^2] of the position servo, critically damped: 40 rad/s, a quarter of what industrial arms reach."""
WATCHDOG = 4
"""Policy periods without a command after which the twin holds of itself."""
LONGEST = 10.0
"""[s] that a twin in lockstep may be told to wait at once."""
SLICE = 5
"""Substeps that are played before the socket is looked at again."""


class Twin:
    """The robot and its state of motion.

    Args:
        robot, task: what is simulated.
        pace: by the clock, or in lockstep with the commands.
    """

    def __init__(self, robot: Robot, task: PickTask, pace: Pace) -> None:
        self.native, self.robot, self.task, self.pace = NativeRobot(robot, task), robot, task, pace
        self.model, self.data, self.env = self.native.model, self.native.data, self.native.env
        model, scene = self.model, NativeScene(self.model)
        self._names, self._finger_names = scene.arm_names, scene.finger_names
        self._qpos, self._dofs, self._finger_qpos = scene.arm_qpos, scene.arm_dofs, scene.finger_qpos
        self._endless = model.jnt_limited[scene.arm] == 0
        self._motors = np.array(scene.arm_actuators)
        self._limit = np.abs(model.actuator_ctrlrange[self._motors]).max(axis=1)
        base = scene.base
        self._base, self._origin = self.data.xmat[base].reshape(3, 3).copy(), self.data.xpos[base].copy()
        self._site = scene.grip_site
        self.period = 1.0 / task.control_frequency
        self.substeps = int(round(self.period / model.opt.timestep))
        self.begin(0)

    def describe(self) -> dict[str, Any]:
        """The twin's ArmInfo, and its pace."""
        return {
            "robot": self.robot.name, "joints": self._names, "fingers": self._finger_names, "forms": FORMS,
            "rate_hz": 1.0 / self.model.opt.timestep, "model_sha256": model_sha256(self.model),
            "pace": self.pace,
        }

    def begin(self, seed: int) -> None:
        """Start an episode; its clock starts with the first command."""
        self.native.begin(seed)
        self._command: Command | None = None
        self._fresh = False  # whether the command has not yet reached the controller
        self._since = self._watched = 0  # substeps since the command came, and since the task was last judged
        self._clock, self._played = 0.0, 0
        self._stopped = self._broken = ""
        self._integrated = self.native.law.preshape
        self._posture = self.data.qpos[self._qpos].copy()
        self.behind = 0.0

    @property
    def outcome(self) -> str:
        """As the task judges."""
        return "success" if self.env.succeeded else "lost" if self.env.lost else "running"

    @property
    def time(self) -> float:
        """[s] played since the episode began, or waited for its first command."""
        return self._played * self.model.opt.timestep

    def read(self) -> dict[str, Any]:
        """The State, as JSON values."""
        self._meet_the_clock()
        data = self.data
        mujoco.mj_kinematics(self.model, data)  # after a step, MuJoCo's poses are a substep older than its angles
        found = {
            "joints": data.qpos[self._qpos], "fingers": data.qpos[self._finger_qpos], "speeds": data.qvel[self._dofs],
            "efforts": data.ctrl[self._motors], "object_position": self.env.object_position,
            "object_quaternion": data.xquat[self.env.object_body], "goal": self.env.goal,
        }
        broken = not all(np.isfinite(value).all() for value in found.values())
        values = {key: np.nan_to_num(np.asarray(value)).tolist() for key, value in found.items()}
        fault = self._stopped or self._broken or ("the simulation has diverged" if broken else "")
        return values | {"age": 0.0, "fault": fault, "outcome": self.outcome}

    def send(self, command: Command) -> None:
        """Take a command; in lockstep, play its period."""
        if self._stopped:
            raise ToolkitError(f"the twin has been stopped ({self._stopped}); begin a new episode")
        size = {"osc": 6, "pose": 7, "joint": len(self._names)}[command.form]
        rates = {"osc": 0, "pose": 6, "joint": len(self._names)}[command.form]
        rows = command.form == "osc" or (command.waypoints.ndim == 2 and command.waypoints.shape[1] == size and len(command.waypoints) > 0)
        if command.target.shape != (size,) or command.rate.shape != (rates,) or not rows:
            raise ToolkitError(f"a {command.form} command for {self.robot.name} has {size} numbers and as many in each waypoint")
        if self._command is None:
            self._clock = time.monotonic()
        self._meet_the_clock()
        self._command, self._fresh, self._since = command, True, 0
        if self.pace == "lockstep":
            self._pass(self.substeps)

    def wait(self, seconds: float) -> None:
        """In lockstep, let time pass without a command, as it does for an arm by the clock.

        Raises:
            ToolkitError: no such time, or the twin goes by the clock.
        """
        if self.pace != "lockstep":
            raise ToolkitError("this twin follows the clock, and waits for nobody; start it with --pace lockstep")
        if not 0.0 <= seconds <= LONGEST:
            raise ToolkitError(f"seconds is {seconds:.3g}; a twin waits from 0 to {LONGEST:.0f} s at once")
        self._pass(int(round(seconds / self.model.opt.timestep)))

    def stop(self, reason: str) -> None:
        """Take no command any more, and stand still."""
        self._stopped = self._stopped or f"stopped: {reason}"

    def catch_up(self) -> float:
        """Play what the clock asks for, a slice at most; returns how long [s] there is nothing to do."""
        if self._command is None or self.pace == "lockstep":
            return 0.05
        step, owed = self.model.opt.timestep, self._owed()
        if owed > 0:
            self.behind = max(self.behind, owed * step)
            self._pass(min(owed, SLICE))
            return 0.0
        return max(0.0, self._clock + (self._played + 1) * step - time.monotonic())

    def _owed(self) -> int:
        """Substeps by which the clock is ahead."""
        return int((time.monotonic() - self._clock) / self.model.opt.timestep) - self._played

    def _meet_the_clock(self) -> None:
        """Play all that the clock asks for by now. A process that woke late would else tell an old state as a new one, and obey two
        commands within the time of one."""
        if self._command is not None and self.pace == "real" and (owed := self._owed()) > 0:
            self.behind = max(self.behind, owed * self.model.opt.timestep)
            self._pass(owed)

    def _pass(self, substeps: int) -> None:
        """Let time pass; before the first command the arm waits for it."""
        if self._command is not None:
            self._play(substeps)
        self._played += substeps

    def _play(self, substeps: int) -> None:
        """Play; a simulation that its commands broke is stopped, not the twin."""
        if self._broken:
            return
        try:
            self._step(substeps)
        except (ArithmeticError, ValueError, RuntimeError, mujoco.FatalError) as error:  # LinAlgError is a ValueError
            self._broken = f"the simulation has failed ({error})"

    def _step(self, substeps: int) -> None:
        sim = self.env.sim
        for _ in range(substeps):
            sim.step1()
            self._control()
            sim.step2()
            self._since += 1
            self._watched += 1
            if self._watched == self.substeps:  # success is counted in policy periods
                self.env.reward(None)
                self._watched = 0

    def _control(self) -> None:
        """Set the controls of one substep."""
        command, fresh = self._command, self._fresh
        if command is None:  # nothing was sent yet, and nothing is played until it is
            return
        silent = self._since >= WATCHDOG * self.substeps and self._since % self.substeps == 0
        still = command.hold or bool(self._stopped) or self._since >= WATCHDOG * self.substeps
        grip = 0.0 if still else command.grip
        delta = np.zeros(6) if still or command.form != "osc" else command.target
        # robosuite's own controllers move the gripper in every form; the arm's torques are then replaced, except in osc.
        self.env._pre_action(np.append(delta, grip), fresh or silent)
        if fresh:
            self._integrated = float(np.clip(self._integrated + self.native.law.rate * np.sign(grip), -1.0, 1.0))
        self._fresh = False
        if command.form == "osc":
            return
        row = command.waypoints[min(self._since * len(command.waypoints) // self.substeps, len(command.waypoints) - 1)]
        speed = np.zeros_like(command.rate) if still or self._since >= self.substeps else command.rate
        carry, push = self._follow_joints(row, speed) if command.form == "joint" else self._follow_pose(row, speed)
        self.data.ctrl[self._motors] = saturated(carry, push, self._limit)

    def _mass(self) -> np.ndarray:
        full = np.zeros((self.model.nv, self.model.nv))
        mujoco.mj_fullM(self.model, full, self.data.qM)
        return full[np.ix_(self._dofs, self._dofs)]

    def _follow_joints(self, target: np.ndarray, speed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Torques (n,) of a computed-torque servo towards angles (n,) [rad] moving at ``speed``: what carries the arm, what pushes it."""
        data = self.data
        away = target - data.qpos[self._qpos]
        away = np.where(self._endless, (away + np.pi) % (2 * np.pi) - np.pi, away)  # the shorter way, as arms without end go
        push = SERVO_KP * away + 2 * np.sqrt(SERVO_KP) * (speed - data.qvel[self._dofs])
        return data.qfrc_bias[self._dofs], self._mass() @ push

    def _follow_pose(self, target: np.ndarray, twist: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The same torques of a servo in Cartesian space, towards a pose (7,) in the base frame.

        A redundant arm divides the motion among its joints by their inertia, as under robosuite's controller (the dynamically
        consistent inverse of Khatib 1987): the joint speeds that the manifest allows are those of that division.
        """
        data, jacobian = self.data, np.zeros((6, self.model.nv))
        mujoco.mj_jacSite(self.model, data, jacobian[:3], jacobian[3:], self._site)
        jacobian = jacobian[:, self._dofs]
        position = self._origin + self._base @ target[:3]
        rotation = self._base @ matrix_of(target[3:])
        turned = vector_of(rotation @ data.site_xmat[self._site].reshape(3, 3).T)
        error = np.append(position - data.site_xpos[self._site], turned)
        wanted = np.append(self._base @ twist[:3], self._base @ twist[3:]) - jacobian @ data.qvel[self._dofs]
        push = SERVO_KP * error + 2 * np.sqrt(SERVO_KP) * wanted
        mass = self._mass()
        yielding = np.linalg.solve(mass, jacobian.T)
        inverse = yielding @ np.linalg.pinv(jacobian @ yielding)
        posture = 10.0 * (self._posture - data.qpos[self._qpos]) - 2 * np.sqrt(10.0) * data.qvel[self._dofs]
        return mass @ (posture - inverse @ (jacobian @ posture)) + data.qfrc_bias[self._dofs], mass @ (inverse @ push)


def saturated(carry: np.ndarray, push: np.ndarray, limit: np.ndarray) -> np.ndarray:
    """Torques (n,) [N m] within their limits (n,): as large a share of ``push`` beside ``carry`` as every motor has room for.

    Where a motor is at its limit the arm so gives way along its push. Clipped each for itself, torques push elsewhere: a Jaco whose
    fingers were jammed on the table spun about its grasp, faster and faster, as it was held.
    """
    carry = np.clip(carry, -limit, limit)
    room = (limit - np.sign(push) * carry) / np.maximum(np.abs(push), 1e-9)
    return carry + min(1.0, float(room.min())) * push


PATIENCE = 30.0
"""[s] of silence after which a client gives way to a newcomer; one that has not said a sensible word yet does so at once."""
FAREWELL = 1.0
"""[s] for which the line to somebody sent away stays open: closed at once, with his words unread, it would take back what he was told."""
BUSY = "it serves another client; end that one, or start a twin on another port"


@dataclass(eq=False)
class _Client:
    """Who is served: the line to it, when it last said something that makes sense [s], and whether it has shown the token."""

    line: wire.Line
    heard: float = -np.inf
    known: bool = False


def serve(
    twin: Twin, listener: socket.socket, orphaned: Callable[[], bool] = lambda: False, token: str = ""
) -> None:
    """Answer one client after another until one asks the twin to close, or whoever started it is gone.

    With a ``token`` only a client whose first message holds it is served.

    The twin's clock goes on whatever a client does: none is waited for, in reading or in writing. Who says what makes no sense is
    told so, where it can be, and is sent away; who comes while another is served is told so at once.
    """
    listener.setblocking(False)
    client: _Client | None = None
    leaving: list[tuple[float, wire.Line]] = []
    try:
        while not orphaned():
            while leaving and leaving[0][0] < time.monotonic():
                leaving.pop(0)[1].close()
            lines: list[wire.Line] = [] if client is None else [client.line]
            reads, writes, _ = select.select([cast(Any, listener), *lines], [line for line in lines if line.waiting], [], twin.catch_up())
            if client is not None and (client.line in reads or writes):  # who has just left makes room for who has just come
                try:
                    ended, served = _answer(twin, client, token)
                except (OSError, ToolkitError) as error:
                    _send_away(client.line, str(error))
                    ended, served = False, False
                if ended:
                    return
                if not served:
                    client.line.close()
                    client = None
                    twin.stop("the runtime has gone")
            if listener in reads:
                client = _newcomer(twin, listener, client, leaving)
    finally:
        for line in [line for _, line in leaving] + ([] if client is None else [client.line]):
            line.close()


def _newcomer(
    twin: Twin, listener: socket.socket, client: _Client | None, leaving: list[tuple[float, wire.Line]]
) -> _Client | None:
    """Whoever is served once somebody has knocked; who is not goes to those that are leaving."""
    try:
        line = wire.Line(listener.accept()[0])
    except OSError:  # gone before the door was opened, or no file is left to open it with
        return client
    if client is None or time.monotonic() - client.heard > PATIENCE:
        if client is not None:
            _send_away(client.line, "another client came while it was silent")
            client.line.close()
            twin.stop("the runtime has gone")
        return _Client(line)
    _send_away(line, BUSY)
    leaving.append((time.monotonic() + FAREWELL, line))
    return client


def _send_away(line: wire.Line, why: str) -> None:
    try:
        line.post({"error": why})
    except (OSError, ToolkitError):
        pass


def _answer(twin: Twin, client: _Client, token: str) -> tuple[bool, bool]:
    """Answer what has come; returns whether the client closes the twin, and whether it is served any longer."""
    line = client.line
    line.push()
    line.pull()
    message = line.next()
    while message is not None:
        number = message.get("number")
        client.known = client.known or not token or hmac.compare_digest(str(message.get("token", "")).encode(), token.encode())
        if not client.known:
            raise ToolkitError("it serves only who knows its token; give --token with what it printed")
        if message.get("do") == "close":
            return True, False
        try:
            answer = _reply(twin, message)
            client.heard = time.monotonic()
        except ToolkitError as error:
            answer = {"error": str(error)}
        line.post(answer | ({"number": number} if isinstance(number, int) else {}))
        twin.catch_up()  # many questions at once do not stop the clock
        message = line.next()
    return False, not line.ended


def _reply(twin: Twin, message: dict[str, Any]) -> dict[str, Any]:
    do = message.get("do")
    if do == "describe":
        return twin.describe()
    if do == "begin":
        seed = message.get("seed")
        if isinstance(seed, bool) or not isinstance(seed, int) or not 0 <= seed < 2**63:
            raise ToolkitError(f"seed is {str(seed)[:40]!r}; give a whole number from 0 on")
        twin.begin(seed)
        return {"time": twin.time}
    elif do == "read":
        return twin.read() | {"time": twin.time}
    elif do == "send":
        content = message.get("command")
        command = wire.command_from_json(content if isinstance(content, dict) else {})
        twin.send(command)
        return {"sent": wire.command_to_json(command), "time": twin.time}
    elif do == "wait":
        seconds = message.get("seconds")
        twin.wait(float(seconds) if isinstance(seconds, int | float) else -1.0)
        return {"time": twin.time}
    elif do == "stop":
        twin.stop(str(message.get("reason", ""))[:200])
    elif do == "result":
        return {"success": twin.outcome == "success", "behind_s": twin.behind}
    else:
        raise ToolkitError(f"{str(do)[:40]!r} is nothing that a twin does")
    return {}
