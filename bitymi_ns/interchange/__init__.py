"""Baked scenes for other programs, as 3D Gaussians and as textured meshes."""
