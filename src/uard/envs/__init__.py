"""Environments and the panels that rate them; importing this registers the ids ``uard/...`` with Gymnasium."""

from uard.envs.grids import gym_gaming
from uard.envs.grids.gym import register
from uard.envs.locomotion import gym as gym_mujoco

register()
gym_gaming.register()
gym_mujoco.register()
