"""The laboratory: studies as data, their store, statistics, ledger and report."""
