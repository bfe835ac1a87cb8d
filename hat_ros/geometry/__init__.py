"""Rotations, rigid motions and similarities, and the small compiled algebra of the inner loops."""
