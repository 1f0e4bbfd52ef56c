"""Look for known vulnerabilities of the pinned packages: scripts/audit.py (make audit).

The exit code is 1 if a package has one. An index of advisories that can't be reached is reported, and is no failure.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

PINS = Path(__file__).with_name("pins")


def main() -> int:
    """Audit the pins of constraints.txt and print the result; return the exit code."""
    pins = subprocess.run(
        [PINS, "Product", "Extras", "Tests", "Release"], check=True, capture_output=True, text=True
    ).stdout
    pip_audit = Path(sys.executable).with_name("pip-audit")
    options = ["-r", "/dev/stdin", "--no-deps", "--disable-pip", "--format", "json", "--progress-spinner", "off"]
    done = subprocess.run([pip_audit, *options], capture_output=True, text=True, input=pins)
    if not done.stdout.strip():
        last = (done.stderr.strip().splitlines() or ["it printed nothing"])[-1]
        print(f"THE DEPENDENCIES WERE NOT AUDITED: pip-audit failed: {last}", file=sys.stderr)
        return 0 if "ConnectionError" in done.stderr or "ServiceError" in done.stderr else 2
    return report(json.loads(done.stdout)["dependencies"])


def report(dependencies: list[dict]) -> int:
    """Print the findings of pip-audit's JSON report; return 1 if there are any, else 0."""
    audited = [dependency for dependency in dependencies if "skip_reason" not in dependency]
    skipped = [dependency["name"] for dependency in dependencies if "skip_reason" in dependency]
    for dependency in audited:
        for finding in dependency["vulns"]:
            fixed = ", ".join(finding["fix_versions"]) or "none yet"
            print(f"{dependency['name']} {dependency['version']}: {finding['id']}; fixed in {fixed}", file=sys.stderr)
    if not audited:
        print("THE DEPENDENCIES WERE NOT AUDITED: no index of advisories can be reached.", file=sys.stderr)
    else:
        names = f"; not in the index: {', '.join(skipped)}" if skipped else ""
        print(f"{len(audited)} of {len(dependencies)} packages were audited{names}.")
    return int(any(dependency["vulns"] for dependency in audited))


if __name__ == "__main__":
    sys.exit(main())
