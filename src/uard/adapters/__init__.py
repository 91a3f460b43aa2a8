"""Adapters: the filter in other people's training."""
