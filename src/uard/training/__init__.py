"""Training loops. Importing this package tells XLA how to compile them (see ``xla``)."""

from uard.training.xla import compile_small_loops_whole

compile_small_loops_whole()
