"""Synthetic clips with exact ground truth: models, trajectories, backgrounds, sunlight."""
