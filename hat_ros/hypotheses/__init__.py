"""Stage 2: scored pose hypotheses at keyframes."""
