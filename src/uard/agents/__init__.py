"""Agents as pure functions: they know no environment and no mitigation but its protocol."""
