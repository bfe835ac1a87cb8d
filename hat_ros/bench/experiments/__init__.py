"""Many runs, one table: comparisons of methods and ablations."""
