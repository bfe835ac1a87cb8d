"""Causal refinement of poses on their own image (the paper's dense refinement, online)."""
