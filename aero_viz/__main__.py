"""Run `aero-viz` as `python -m aero_viz`."""

from __future__ import annotations

from aero_viz.cli import main

if __name__ == "__main__":
    main()
