"""The learned networks in plain PyTorch, one file each, with the public checkpoints' own tensor names."""
