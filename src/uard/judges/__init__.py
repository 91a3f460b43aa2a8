"""Judges: several reward functions or reward models, asked together and brought to one scale."""
