"""Deployment: a bundle, a safety filter and a driver move an arm.

    arm.py          State, Command, ArmInfo and the Driver protocol: what runtime and arm say to each other
    kinematics.py   robot.xml as forward kinematics, distances and inverse kinematics (MuJoCo, mink)
    observer.py     State -> observation, by name
    motion.py       action -> command, in three forms, within the manifest's limits
    safety.py       what makes the runtime hold the arm, and stop it
    runtime.py      one tick; an episode; the log
    dry.py          what would be sent to an arm that is only read
    drivers/        arms: the simulated twin, Universal Robots, Franka, Kinova Gen3, whatever ROS 2 moves

Imports numpy, onnxruntime, mujoco and mink, never torch, robosuite, rerun or pin: a robot PC needs no more.
"""
