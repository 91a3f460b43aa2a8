"""Training loops that are one compiled program, environment included."""
