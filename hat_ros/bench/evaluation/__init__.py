"""What a run is worth: metrics, reports, benchmarks, ablations."""
