"""Networks and the one optimisation loop."""
