"""What a run is worth: metrics, tables, figures, reports."""
