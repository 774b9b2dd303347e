"""``python -m coudalfish``: see :mod:`coudalfish.cli`."""

from coudalfish.cli.main import main

if __name__ == "__main__":
    raise SystemExit(main())
