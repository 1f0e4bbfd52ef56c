"""Way out of dead ends: a tabu memory of local minima, and anchors that look around."""
