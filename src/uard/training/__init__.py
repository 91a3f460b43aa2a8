"""Training loops. Importing this package tells XLA how to compile and run them (see ``xla``)."""

from uard.training.xla import configure

configure()
