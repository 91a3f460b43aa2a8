"""The paper's experiments, and ours, as data."""
