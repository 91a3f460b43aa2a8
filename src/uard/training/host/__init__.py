"""Training loops whose environment runs on the host."""
