"""Environments and the panels that rate them; importing this registers the ids ``uard/...`` with Gymnasium."""

from uard.envs.gym import register

register()
