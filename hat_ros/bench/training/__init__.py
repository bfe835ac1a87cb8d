"""Training of the networks that the package ships: data rendered from a seed, fit, calibration, model card."""
