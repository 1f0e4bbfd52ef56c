"""Entry point of `python -m aero_planner`, which is the same as `aero-planner`."""

from __future__ import annotations

import sys

from aero_planner.cli import main

if __name__ == "__main__":
    sys.exit(main())
