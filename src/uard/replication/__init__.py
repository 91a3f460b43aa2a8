"""The paper: its printed numbers, its studies, its claims and what became of them."""
