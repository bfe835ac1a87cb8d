"""All that depends on the CAD model alone: its mesh, the ray-casting scene, views, symmetry, renderers."""
