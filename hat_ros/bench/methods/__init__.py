"""The ways to turn the same front ends into poses: HAT, and what to compare it with."""
