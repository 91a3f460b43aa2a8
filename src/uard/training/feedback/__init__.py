"""Models of ratings: what a learner knows of state-actions that nobody has rated."""
