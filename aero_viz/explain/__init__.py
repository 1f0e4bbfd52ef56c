"""Explanations of why a plan was chosen and why a flight failed, from the planner's own figures."""
