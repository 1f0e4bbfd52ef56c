"""The entry point of `aero-planner` and of `python -m aero_planner`. It imports nothing before it handles Ctrl-C."""


def main() -> int:
    """Run the command line and return its exit code: 130 after Ctrl-C, also while the command line is imported."""
    try:
        from aero_planner.import_path import leave_current_folder

        leave_current_folder()
        from aero_planner.cli import main as run

        return run()
    except KeyboardInterrupt:
        return 130


if __name__ == "__main__":
    raise SystemExit(main())
