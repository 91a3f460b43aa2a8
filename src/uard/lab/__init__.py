"""The laboratory: a study as data, its cells, their results, the store and the runner."""
