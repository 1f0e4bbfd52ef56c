"""Reports of a list of checks, for `aero-planner preflight` and `aero-viz doctor`."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True)
class Check:
    """Result of one check."""

    name: str
    finding: str
    ok: bool = True
    required: bool = True
    """False if a failure is only a warning."""
    advice: str = ""
    """Remedy for a check that fails."""


@dataclass(frozen=True)
class CheckReport:
    """Results of all checks, and the verdict in the last line of the table."""

    checks: tuple[Check, ...]
    passed_verdict: str = "All required checks passed."
    failed_verdict: str = "A required check failed; see above."

    @property
    def passed(self) -> bool:
        """True if every required check is ok."""
        return all(check.ok or not check.required for check in self.checks)

    def to_dict(self) -> dict[str, Any]:
        """Return {"passed": bool, "checks": [..]}, each check as a dictionary of its fields."""
        return {"passed": self.passed, "checks": [asdict(check) for check in self.checks]}

    def format_table(self) -> str:
        """Return one line per check, with the advice below each failure, and the verdict."""
        width = max((len(check.name) for check in self.checks), default=0)
        lines = []
        for check in self.checks:
            mark = "ok  " if check.ok else "FAIL" if check.required else "warn"
            lines.append(f"{mark}  {check.name:{width}}  {check.finding}")
            if not check.ok:
                lines.append(f"{'':6}{'':{width}}  -> {check.advice}")
        return "\n".join([*lines, self.passed_verdict if self.passed else self.failed_verdict])
