"""The immersed surface: where its points are in the fluid's mesh, what acts there, and the multiplier."""
