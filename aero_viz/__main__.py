"""The entry point of `aero-viz` and of `python -m aero_viz`. It imports nothing before it handles Ctrl-C."""


def main() -> None:
    """Run the command line. The exit code is 130 after Ctrl-C, also while the command line is imported."""
    try:
        from aero_planner.import_path import leave_current_folder

        leave_current_folder()
        from aero_viz.cli import main as run

        run()
    except KeyboardInterrupt:
        raise SystemExit(130) from None


if __name__ == "__main__":
    main()
