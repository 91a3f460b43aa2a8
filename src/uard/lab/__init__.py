"""The laboratory: a study as data, its cells, their results, the store and the runner."""

import logging

logging.getLogger("uard").addHandler(logging.NullHandler())  # whoever wants to read it adds a handler
