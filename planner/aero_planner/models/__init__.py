"""The vehicle models: what the controls are, and how the state follows them."""
