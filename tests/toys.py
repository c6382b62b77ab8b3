"""Two small families of robots, each with a task: a crawler with a free root and motors, and a hand on slides with position actuators."""

from dataclasses import dataclass, field

import gymnasium
import mujoco
import numpy as np

from robots.model_robot import Family, ModelRobot
from tasks.record import Entry, Record
from tasks.task import ModelTask

CRAWLER = """
<mujoco>
  <compiler inertiafromgeom="true" angle="degree"/>
  <option timestep="0.005"/>
  <default><geom density="50" condim="3" friction="1 .01 .01"/><joint armature="0.01" damping="0.5"/></default>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 1"/>
    <body name="torso" pos="0 0 0.5">
      <freejoint name="root"/>
      <geom name="torso" type="sphere" size="0.2"/>
      <body name="front" pos="0.2 0 0">
        <joint name="front" axis="0 1 0" range="-60 60" limited="true"/>
        <geom name="front" type="capsule" fromto="0 0 0 0.3 0 -0.3" size="0.05"/>
      </body>
      <body name="left" pos="-0.1 0.2 0">
        <joint name="left" axis="0 1 0" range="-60 60" limited="true"/>
        <geom name="left" type="capsule" fromto="0 0 0 -0.2 0.2 -0.3" size="0.05"/>
      </body>
      <body name="right" pos="-0.1 -0.2 0">
        <joint name="right" axis="0 1 0" range="-60 60" limited="true"/>
        <geom name="right" type="capsule" fromto="0 0 0 -0.2 -0.2 -0.3" size="0.05"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor joint="front" gear="3" ctrlrange="-1 1" ctrllimited="true"/>
    <motor joint="left" gear="3" ctrlrange="-1 1" ctrllimited="true"/>
    <motor joint="right" gear="3" ctrlrange="-1 1" ctrllimited="true"/>
  </actuator>
</mujoco>
"""
HAND = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.002" noslip_iterations="5"/>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 1"/>
    <body name="palm" pos="0 0 0.2">
      <inertial pos="0 0 0" mass="0.5" diaginertia="0.001 0.002 0.003"/>
      <joint name="lift" type="slide" axis="0 0 1" range="-0.2 0.2" limited="true" damping="20"/>
      <geom name="palm" type="box" size="0.04 0.04 0.01"/>
      <body name="thumb" pos="0.03 0 -0.01" quat="0.995004165 0 0.099833417 0">
        <inertial pos="0 0 -0.03" mass="0.05" diaginertia="2e-5 2e-5 1e-5"/>
        <joint name="thumb" axis="0 1 0" range="-0.5 1" limited="true" damping="0.05" armature="0.001"/>
        <geom name="thumb" type="capsule" fromto="0 0 0 0 0 -0.06" size="0.01"/>
      </body>
      <body name="finger" pos="-0.03 0 -0.01" quat="0.995004165 0 -0.099833417 0">
        <inertial pos="0 0 -0.03" mass="0.05" diaginertia="2e-5 2e-5 1e-5"/>
        <joint name="finger" axis="0 1 0" range="-1 0.5" limited="true" damping="0.05" armature="0.001"/>
        <geom name="finger" type="capsule" fromto="0 0 0 0 0 -0.06" size="0.01"/>
        <site name="tip" pos="0 0 -0.06"/>
      </body>
    </body>
    <body name="ball" pos="0 0 0.03"><freejoint name="ball"/><geom name="ball" size="0.03" density="300"/></body>
  </worldbody>
  <actuator>
    <position name="lift" joint="lift" kp="500" ctrlrange="-0.2 0.2" ctrllimited="true"/>
    <position name="thumb" joint="thumb" kp="2" ctrlrange="-0.5 1" ctrllimited="true"/>
    <position name="finger" joint="finger" kp="2" ctrlrange="-1 0.5" ctrllimited="true"/>
  </actuator>
</mujoco>
"""


class ToyScene:
    """Positions and speeds are seen; the goal is a height of one body."""

    def __init__(self, model, data, body, goal):
        self.model, self.data, self.body, self.goal = model, data, model.body(body).id, goal

    def begin(self, rng):
        self.data.qpos[2] += rng.uniform(-0.01, 0.01)
        mujoco.mj_forward(self.model, self.data)

    def observe(self):
        return np.concatenate([self.data.qpos, self.data.qvel])

    def at_goal(self):
        return bool(self.data.xpos[self.body, 2] > self.goal)

    def lost(self):
        return bool(self.data.xpos[self.body, 2] < -0.5)


@dataclass(frozen=True)
class ToyTask(ModelTask):
    name: str
    family: str
    xml: str
    joints: tuple[int, int, int]
    body: str
    goal: float
    substeps: int = 5
    horizon: int = 40
    hold_steps: int = 2
    control_frequency: float = 20.0
    consecutive: bool = False
    observation: Record = field(init=False)
    action: Record = field(init=False)

    def __post_init__(self):
        nq, nv, nu = self.joints
        object.__setattr__(self, "observation", Record({"qpos": Entry(nq, scale=0.1, explored=0.01), "qvel": Entry(nv, scale=0.1)}))
        object.__setattr__(self, "action", Record({"drive": Entry(nu)}))

    def spec(self, robot):
        spec = mujoco.MjSpec.from_string(self.xml)
        robot.change(spec)
        return spec

    def scene(self, model, data):
        return ToyScene(model, data, self.body, self.goal)

    def environment(self, robot):
        return ToyEnvironment(self.spec(robot).compile(), self)


class ToyEnvironment(gymnasium.Env):
    """A gymnasium environment of its own making, with MuJoCo's own step."""

    def __init__(self, model, task):
        self.model, self.data, self.task = model, mujoco.MjData(model), task
        self.scene = task.scene(self.model, self.data)

    def reset(self, seed=None, options=None):
        mujoco.mj_resetData(self.model, self.data)
        mujoco.mj_forward(self.model, self.data)
        return self.scene.observe(), {}

    def step(self, action):
        low, high = self.model.actuator_ctrlrange.T
        self.data.ctrl[:] = 0.5 * (low + high) + 0.5 * (high - low) * np.clip(action, -1, 1)
        mujoco.mj_step(self.model, self.data, self.task.substeps)
        mujoco.mj_rnePostConstraint(self.model, self.data)
        return self.scene.observe(), 0.0, False, False, {"success": self.scene.at_goal()}


CRAWLERS = Family("crawler", lambda body, quantity: "crawler", "torso")
HANDS = Family("toy-hand", lambda body, quantity: f"{body}.{quantity}", "palm")


def _crawler(long, thick):
    """Torso of half length 0.2 long [m], its limbs at its ends; the front leg's radius grows by 0.02 thick [m]."""

    def change(spec):
        torso = spec.geom("torso")
        if long > 0:
            torso.type, torso.size, torso.quat = mujoco.mjtGeom.mjGEOM_CAPSULE, [0.2, 0.2 * long, 0], [np.sqrt(0.5), 0, np.sqrt(0.5), 0]
        spec.body("front").pos[0] += 0.2 * long
        for name in ("left", "right"):
            spec.body(name).pos[0] -= 0.2 * long
        spec.geom("front").size[0] += 0.02 * thick

    return change


def _hand(short, frozen):
    """Finger shorter by a share, and its joint's range by another; the link's mass goes with its length."""

    def change(spec):
        finger = spec.body("finger")
        spec.geom("finger").fromto = [0, 0, 0, 0, 0, -0.06 * (1 - short)]
        spec.site("tip").pos = [0, 0, -0.06 * (1 - short)]
        finger.mass *= 1 - short
        finger.ipos = [0, 0, -0.03 * (1 - short)]
        finger.inertia = np.array([2e-5, 2e-5, 1e-5]) * (1 - short) ** 3
        spec.joint("finger").range = [-1 * (1 - frozen), 0.5 * (1 - frozen)]
        spec.actuator("finger").ctrlrange = [-1 * (1 - frozen), 0.5 * (1 - frozen)]
        spec.body("thumb").quat = [np.cos(0.1 + 0.1 * short), 0, np.sin(0.1 + 0.1 * short), 0]

    return change


def crawler(name, long=0.0, thick=0.0):
    return ModelRobot(name, CRAWLERS, _crawler(long, thick), "made up", long == thick == 0)


def hand(name, short=0.0, frozen=0.0):
    return ModelRobot(name, HANDS, _hand(short, frozen), "made up", short == frozen == 0)


CRAWL = ToyTask("crawl", "crawler", CRAWLER, (10, 9, 3), "torso", 0.48)
LIFT = ToyTask("lift", "toy-hand", HAND, (10, 9, 3), "palm", 0.3, hold_steps=3)
CRAWLER_ROBOTS = (crawler("crawler"), crawler("long", long=1.0), crawler("thick", long=0.5, thick=1.0))
HAND_ROBOTS = (hand("toy-hand"), hand("short", short=0.5, frozen=0.9), hand("stiff", short=0.2, frozen=0.999))
