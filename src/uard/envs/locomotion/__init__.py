"""Robots on MuJoCo that are to run forward, and how their reward lies."""
