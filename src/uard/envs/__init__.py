"""Environments and the panels that rate them; importing this registers the ids ``uard/...`` with Gymnasium."""

from uard.envs import gym_gaming, gym_mujoco
from uard.envs.gym import register

register()
gym_gaming.register()
gym_mujoco.register()
