"""Stage 4 of the default preset: every pose is refined on its own image, with its state and covariance."""
