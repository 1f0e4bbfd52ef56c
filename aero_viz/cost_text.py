"""Costs as text, in the same way wherever one is shown."""


def cost_text(value: float) -> str:
    """Return a cost with four digits, as a whole number where it is large, and never as a power of ten."""
    size = abs(value)
    if size == 0.0:
        return "0"
    return f"{value:.3f}" if size < 0.1 else f"{value:.4g}" if size < 9999.5 else f"{value:.0f}"
