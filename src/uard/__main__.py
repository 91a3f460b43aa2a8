"""``python -m uard`` is ``uard``."""

from uard.cli import main

if __name__ == "__main__":
    main()
