"""Grasp sets: their format on disk, reading and writing, and batches for training. No simulator."""
