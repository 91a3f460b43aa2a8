"""The method: pure functions of NumPy, JAX and torch arrays, and frozen dataclasses."""
