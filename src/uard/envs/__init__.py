"""Environments and the panels that rate them."""
