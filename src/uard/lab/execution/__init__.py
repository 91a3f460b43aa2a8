"""How cells become stored results: batches, workers, clusters, the store."""
