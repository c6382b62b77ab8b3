"""Drivers by arm; each imports its vendor's package only when it connects.

    sim.py       the simulated robosuite robot as a twin, in its own process, over a socket
    ur.py        Universal Robots e-series through ur_rtde      (tested against a fake; never run on hardware)
    franka.py    Franka through franky                          (tested against a fake; never run on hardware)
    kortex.py    Kinova Gen3 through kortex_api                 (tested against a fake; never run on hardware)
    ros2.py      any arm behind ros2_control, through rclpy     (tested against a fake; never run on hardware)

Two of these want to be told more often than the policy decides: streaming.py feeds them. stamps.py tells how old a device's states are.
"""
