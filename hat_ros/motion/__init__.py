"""Target-relative motion: the stage and its backends."""
