"""The live graph on the test bench: a camera that cannot wait, faults, and what became of the poses meanwhile."""
