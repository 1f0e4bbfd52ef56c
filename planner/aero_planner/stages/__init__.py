"""The stages: what the paper does not have, one package each. `aero_planner.registry` lists them."""
