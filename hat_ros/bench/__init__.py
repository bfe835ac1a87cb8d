"""Laboratory equipment, not flown: data sets, synthetic clips, comparison methods, metrics, reports, experiments."""
