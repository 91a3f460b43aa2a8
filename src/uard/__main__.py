"""``python -m uard`` is ``uard``."""

from uard.cli.app import main

if __name__ == "__main__":
    main()
