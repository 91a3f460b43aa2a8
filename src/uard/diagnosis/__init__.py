"""The doctor: which known traps a log of rewards and ratings is in."""
