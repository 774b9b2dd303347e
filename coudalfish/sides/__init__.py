"""The two sides of the coupling, fluid and shell, and what belongs to them."""
