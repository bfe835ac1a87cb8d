"""What runs a tracker on a stream of frames: pipeline, scheduler, overlay, self-check."""
