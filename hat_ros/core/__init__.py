"""The method itself: keyframes, guard, selection, alignment, fusion, priors, joins. numpy and scipy only."""
