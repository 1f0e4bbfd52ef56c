"""The plans of AERO-MPPI, with all that it adds to what every planner tells."""

from aero_planner import Plan
from aero_viz.explain.evidence import Evidence, PlanEvidence
from aero_viz.planners.plan import ensemble
from aero_viz.session import Frame


def plan_of(frame: Frame | None) -> Plan:
    """Return the plan of a frame, whose planner must be AERO-MPPI."""
    assert frame is not None
    plan = ensemble(frame.plan)
    assert plan is not None, "the planner is not AERO-MPPI"
    return plan


def full(evidence: PlanEvidence) -> Evidence:
    """Return the evidence of a plan, whose planner must be AERO-MPPI."""
    assert isinstance(evidence, Evidence)
    return evidence
