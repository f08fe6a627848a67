"""Geometry kernels: no learning, no paper.  Meshes and points in, distances, signs, grids and strains out."""
